"""Background jobs: the worker process, the messages it speaks and the job folder that both sides share."""

from .client import Job, PythonFound, check_python, start, start_command
from .folder import JobFolder
from .messages import Message

__all__ = ["Job", "JobFolder", "Message", "PythonFound", "check_python", "start", "start_command"]
