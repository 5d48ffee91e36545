"""Stage 1, the scan: readers, the sparse grid, thresholds and clipping."""

from .grid import BRICK, BrickVolume
from .inspection import Inspection, inspect_scan
from .readers import ScanReader, open_scan
from .thresholds import Thresholds, find_thresholds
from .vdb import as_grid, load_vdb, save_vdb, write_grids
from .wig import WigScan, import_scan
from .writers import ScanWriter, write_scan

__all__ = [
    "BRICK",
    "BrickVolume",
    "Inspection",
    "ScanReader",
    "ScanWriter",
    "Thresholds",
    "WigScan",
    "as_grid",
    "find_thresholds",
    "import_scan",
    "inspect_scan",
    "load_vdb",
    "open_scan",
    "save_vdb",
    "write_grids",
    "write_scan",
]
