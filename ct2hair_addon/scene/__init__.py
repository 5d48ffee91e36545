"""The one package of the engine that knows Blender: scans and results in the scene, and out of it.

`frames` says where things stand; `session` is the scripting API that the operators and the command line share.
"""

from .editing import (
    REGIONS,
    RegionMeasure,
    confidence_shown,
    mark_scalp_by_selection,
    measure_regions,
    measured_regions,
    regrow,
    show_confidence,
    trim,
)
from .export import write_alembic, write_blend, write_strand_file, write_usd
from .frames import MM, head_from_scan, scene_from_scan
from .hair import NewHair, full_width_factor, new_hair, set_width_factor, strands_of
from .head import SCALP_GROUP, SCALP_UV, add_scalp_uv, head_mesh, new_head, save_head
from .looks import histogram_picture, slice_picture, threshold_values
from .materials import DENSITY_PRESETS, HAIR_COLOURS, set_density_colours, set_hair_colour
from .picture import render_picture, render_turntable
from .placing import LANDMARK_OF, add_landmarks, fit_to_landmarks, landmarks_of, placement
from .quiet import quiet
from .results import ROLE, HairResult, ScanResult, active_result, result_of, results
from .session import (
    FORMATS,
    STRAND_FORMATS,
    STRAND_UNITS,
    add_template_head,
    check_job,
    default_folder,
    export_all,
    import_scan,
    import_strands,
    load_result,
    load_stage,
    new_file,
    reconstruct,
    scan_name,
    show_strands,
    start_inspection,
    start_job,
)
from .simulation import SimulationResult, clear_simulation, simulate, simulated_frames, simulation_steps
from .staging import NewData, remove_collection
from .volume import GridSummary, new_volume, summarize

__all__ = [
    "DENSITY_PRESETS",
    "FORMATS",
    "HAIR_COLOURS",
    "LANDMARK_OF",
    "MM",
    "REGIONS",
    "ROLE",
    "SCALP_GROUP",
    "SCALP_UV",
    "STRAND_FORMATS",
    "STRAND_UNITS",
    "GridSummary",
    "HairResult",
    "NewData",
    "NewHair",
    "RegionMeasure",
    "ScanResult",
    "SimulationResult",
    "active_result",
    "add_landmarks",
    "add_scalp_uv",
    "add_template_head",
    "check_job",
    "clear_simulation",
    "confidence_shown",
    "default_folder",
    "export_all",
    "fit_to_landmarks",
    "full_width_factor",
    "head_from_scan",
    "head_mesh",
    "histogram_picture",
    "import_scan",
    "import_strands",
    "landmarks_of",
    "load_result",
    "load_stage",
    "mark_scalp_by_selection",
    "measure_regions",
    "measured_regions",
    "new_file",
    "new_hair",
    "new_head",
    "new_volume",
    "placement",
    "quiet",
    "reconstruct",
    "regrow",
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
    "show_confidence",
    "show_strands",
    "simulate",
    "simulated_frames",
    "simulation_steps",
    "slice_picture",
    "start_inspection",
    "start_job",
    "strands_of",
    "summarize",
    "threshold_values",
    "trim",
    "write_alembic",
    "write_blend",
    "write_strand_file",
    "write_usd",
]
