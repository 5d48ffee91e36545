"""The command line inside Blender: `blender -b --python ct2hair_addon/batch.py -- reconstruct SCAN --out DIR ...`."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from ct2hair_addon.cli import main
from ct2hair_addon.groom import add_groom

sys.exit(main(sys.argv[sys.argv.index("--") + 1 :] if "--" in sys.argv else [], [add_groom]))
