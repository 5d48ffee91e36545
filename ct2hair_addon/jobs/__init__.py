"""Background jobs: the worker process, the messages it speaks and the job folder that both sides share."""

from .client import Job, start
from .folder import JobFolder
from .messages import Message

__all__ = ["Job", "JobFolder", "Message", "start"]
