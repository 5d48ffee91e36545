"""Stage 1, the scan: readers, the sparse grid, thresholds and clipping."""

from .grid import BRICK, BrickVolume
from .readers import ScanReader, open_scan
from .vdb import load_vdb, save_vdb
from .writers import ScanWriter, write_scan

__all__ = ["BRICK", "BrickVolume", "ScanReader", "ScanWriter", "load_vdb", "open_scan", "save_vdb", "write_scan"]
