"""The one package of the engine that knows Blender: scans and results in the scene, and out of it.

`frames` says where things stand; `session` is the scripting API that the operators and the command line share.
"""

from .export import write_alembic, write_blend, write_strand_file, write_usd
from .frames import MM, head_from_scan, scene_from_scan
from .hair import NewHair, full_width_factor, new_hair, set_width_factor, strands_of
from .head import SCALP_GROUP, SCALP_UV, add_scalp_uv, head_mesh, new_head, save_head
from .materials import DENSITY_PRESETS, HAIR_COLOURS, set_density_colours, set_hair_colour
from .picture import render_picture, render_turntable
from .results import ROLE, HairResult, ScanResult, active_result, result_of, results
from .session import (
    FORMATS,
    STRAND_FORMATS,
    STRAND_UNITS,
    check_job,
    default_folder,
    export_all,
    import_scan,
    import_strands,
    load_result,
    reconstruct,
    scan_name,
    show_strands,
    start_job,
)
from .simulation import SimulationResult, clear_simulation, simulate, simulated_frames
from .staging import NewData, remove_collection
from .volume import GridSummary, new_volume, summarize

__all__ = [
    "DENSITY_PRESETS",
    "FORMATS",
    "HAIR_COLOURS",
    "MM",
    "ROLE",
    "SCALP_GROUP",
    "SCALP_UV",
    "STRAND_FORMATS",
    "STRAND_UNITS",
    "GridSummary",
    "HairResult",
    "NewData",
    "NewHair",
    "ScanResult",
    "SimulationResult",
    "active_result",
    "add_scalp_uv",
    "check_job",
    "clear_simulation",
    "default_folder",
    "export_all",
    "full_width_factor",
    "head_from_scan",
    "head_mesh",
    "import_scan",
    "import_strands",
    "load_result",
    "new_hair",
    "new_head",
    "new_volume",
    "reconstruct",
    "remove_collection",
    "render_picture",
    "render_turntable",
    "result_of",
    "results",
    "save_head",
    "scan_name",
    "scene_from_scan",
    "set_density_colours",
    "set_hair_colour",
    "set_width_factor",
    "show_strands",
    "simulate",
    "simulated_frames",
    "start_job",
    "strands_of",
    "summarize",
    "write_alembic",
    "write_blend",
    "write_strand_file",
    "write_usd",
]
