"""`python -m ct2hair_addon`: the command line."""

import sys

from .cli import main
from .groom import add_groom

sys.exit(main(sys.argv[1:], [add_groom]))
