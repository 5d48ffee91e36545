"""The scripting API of the extension: scans and results as objects of the scene, jobs in the background.

The operators are thin faces of these functions; a script calls them directly::

    from ct2hair_addon import scene           # in Blender: bl_ext.<repository>.ct2hair.ct2hair_addon.scene
    scan = scene.import_scan("wig.tif", settings)
    result = scene.reconstruct("wig.tif", "out/wig", settings, progress=print)
    scene.export_all(result, "out/wig", formats=("blend", "alembic", "usd", "picture"))

Every function builds its data first and links it last: where one fails, the scene is as it was.
"""

from __future__ import annotations

import json
import subprocess
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from mathutils import Matrix

from .. import __version__, jobs
from ..cache import cache_folder
from ..errors import Cancelled, CT2HairError, ScanError
from ..head import Head, HeadMesh, fit_to_roots, load_obj, mark_scalp, template_head, unwrap
from ..progress import Progress, silent
from ..settings import Settings
from ..strand_files import read_strands
from ..strands import Strands
from .export import write_alembic, write_blend, write_strand_file, write_usd
from .frames import MM, head_from_scan, scene_from_scan, scene_from_unregistered_scan
from .hair import DIAMETER, new_hair, new_lines
from .head import attach, head_mesh, new_head, save_head
from .materials import guide_material, hair_material, orientation_material
from .picture import render_picture
from .results import KIND, ROLE, HairResult, ScanResult
from .staging import NewData
from .volume import new_volume, summarize

PREFIX = "CT2Hair"
_SUFFIXES = (".nii.gz", ".ome.tiff", ".ome.tif")


def scan_name(path: str | Path) -> str:
    """The name of a scan from its path: `wig` from wig.tif, wig.nii.gz or the folder wig of a series."""
    name = Path(path).name
    for suffix in _SUFFIXES:
        if name.lower().endswith(suffix):
            return name[: -len(suffix)]
    return Path(name).stem or "scan"


def default_folder(scan: str | Path) -> Path:
    """Where the results of a scan go unless told otherwise: beside the saved .blend, else in the user's cache folder."""
    base = Path(bpy.path.abspath("//")) / "ct2hair" if bpy.data.filepath else cache_folder() / "jobs"
    return base / scan_name(scan)


def new_file(frames: tuple[int, int] | None = None) -> None:
    """An empty file in place of the one that is open, whose changes are lost; add-ons and preferences stay.

    frames: (first, last) of its scene, which stands at the first.
    """
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    if frames is not None:
        scene = bpy.context.scene
        scene.frame_start, scene.frame_end = frames
        scene.frame_set(frames[0])


def import_scan(
    path: str | Path,
    settings: Settings | None = None,
    *,
    folder: str | Path | None = None,
    context: bpy.types.Context | None = None,
    progress: Progress = silent,
) -> ScanResult:
    """Bring a scan into the scene as a Volume object in the collection 'CT2Hair <name> import'.

    A .vdb is shown as it is (its units are read as mm). From any other format the wig alone (air and mannequin left out) is
    written to `folder`/scan.vdb first. The scan stands on the ground until a reconstruction knows where the head is.
    Raises ScanError for what can't be read or holds no hair; the scene is then untouched.
    """
    path, settings = Path(path), settings or Settings()
    name, warnings, low = f"{scan_name(path)} import", (), None
    if path.suffix.lower() == ".vdb":
        grid = path
    else:
        from ..volume import find_thresholds, open_scan, save_vdb
        from ..volume import import_scan as read_wig

        _expose_bundled_modules()
        grid = Path(folder or default_folder(path)) / "scan.vdb"
        reader = open_scan(path, settings.scan)
        thresholds = find_thresholds(reader, settings.scan, progress=lambda done, total: progress(0.3 * done / total, 1.0))
        wig = read_wig(reader, thresholds, settings.scan, progress=lambda done, total: progress(0.3 + 0.6 * done / total, 1.0))
        grid.parent.mkdir(parents=True, exist_ok=True)
        save_vdb(wig.density, grid)
        warnings, low = tuple(wig.warnings), float(wig.hair_level)
    summary = summarize(grid, low)
    with NewData() as new:
        collection, root = _new_collection(new, name, "scan")
        scan = _new_empty(new, f"{name} Scan", "scan", root)
        scan.matrix_basis = Matrix(scene_from_unregistered_scan(summary.low_corner, summary.high_corner).tolist())
        volume = new_volume(new, f"{name} Volume", grid, summary)
        _enrol(collection, volume, "volume", scan)
        collection.objects.link(scan)
        collection["ct2hair_scan"] = str(path.resolve())
        collection["ct2hair_version"] = __version__
    _link(collection, context)
    progress(1.0, 1.0)
    return ScanResult(collection, root, scan, volume, warnings)


def load_result(
    folder: str | Path,
    *,
    name: str | None = None,
    colour: str = "brown",
    diameter: float = DIAMETER,
    group_id: int = 0,
    context: bpy.types.Context | None = None,
) -> HairResult:
    """Bring the result of a job (hair.npz, guides.npz, head.obj, report.json, volume.vdb) into the scene.

    Everything arrives as new data in a new collection 'CT2Hair <name>'; nothing that is there changes. guides.npz and
    volume.vdb may be missing. colour: one of `HAIR_COLOURS`. diameter: mean strand diameter, mm. Raises CT2HairError (or its
    kinds) where a file is missing or damaged; the scene is then untouched.
    """
    folder = Path(folder)
    report = _read_report(folder)
    head_to_scan = np.array(report["head"]["head_to_scan"], np.float64)
    try:
        to_head = head_from_scan(head_to_scan)
    except ValueError as error:
        raise CT2HairError(f"{folder / 'report.json'}: {error}; run the reconstruction again") from None
    scan, guides = report.get("scan", {}), folder / "guides.npz"
    return show_strands(
        Strands.load(folder / "hair.npz").transformed(to_head),
        load_obj(folder / "head.obj").transformed(to_head),
        name or scan_name(scan.get("file", folder.name)),
        guides=Strands.load(guides).transformed(to_head) if guides.is_file() else None,
        grid=folder / "volume.vdb",
        head_to_scan=head_to_scan,
        hair_level=scan.get("hair_level"),
        colour=colour,
        diameter=diameter,
        group_id=group_id,
        seed=report.get("settings", {}).get("run", {}).get("seed", 0),
        properties={
            "ct2hair_folder": str(folder.resolve()),
            "ct2hair_report": json.dumps(report),
            "ct2hair_settings": json.dumps(report.get("settings", {}), sort_keys=True),
            "ct2hair_version": report.get("program", {}).get("version", __version__),
        },
        context=context,
    )


def show_strands(
    hair: Strands,
    head: HeadMesh,
    name: str,
    *,
    guides: Strands | None = None,
    grid: Path | None = None,
    head_to_scan: np.ndarray | None = None,
    hair_level: float | None = None,
    colour: str = "brown",
    diameter: float = DIAMETER,
    group_id: int = 0,
    seed: int = 0,
    properties: Mapping[str, Any] | None = None,
    context: bpy.types.Context | None = None,
) -> HairResult:
    """Bring strands on a head (both mm, head frame) into the scene, in the layout of `frames`, as a result of their own.

    grid: the scan's .vdb, shown where the file and its place `head_to_scan` are there; hair_level: of its material.
    properties: custom properties of the collection. The rest as in `load_result`.
    """
    shown = grid is not None and grid.is_file() and head_to_scan is not None
    summary = summarize(grid, hair_level) if shown else None
    common = {"group_id": group_id, "seed": seed, "head_data": head}
    with NewData() as new:
        collection, root = _new_collection(new, name, "result")
        head_object = new_head(new, f"{name} Head", head)
        _enrol(collection, head_object, "head", root)
        material = hair_material(new, f"{name} Hair", colour)
        made = new_hair(new, f"{name} Hair", hair, head_object, material=material, diameter=diameter, **common)
        _enrol(collection, made.object, "hair", head_object)
        tally = {f"hair, {reason}": count for reason, count in made.tally.items() if count}
        guide = volume = scan = None
        if guides is not None and len(guides):
            material = guide_material(new, f"{name} Guides")
            # twice as wide: to be seen among the hair
            made_guides = new_hair(
                new, f"{name} Guides", guides, head_object, material=material, diameter=2 * diameter, **common
            )
            guide = made_guides.object
            guide.hide_render = True
            _enrol(collection, guide, "guides", head_object)
            tally |= {f"guides, {reason}": count for reason, count in made_guides.tally.items() if count}
        if summary is not None:
            scan = _new_empty(new, f"{name} Scan", "scan", root)
            scan.matrix_basis = Matrix(scene_from_scan(head_to_scan).tolist())
            collection.objects.link(scan)
            volume = new_volume(new, f"{name} Volume", grid, summary)
            volume.hide_render = True  # the hair stands where the cloud does
            _enrol(collection, volume, "volume", scan)
        collection["ct2hair_version"] = __version__
        collection["ct2hair_blender"] = bpy.app.version_string
        collection["ct2hair_tally"] = tally
        for key, value in (properties or {}).items():
            collection[key] = value
    view_layer = _link(collection, context)
    for ob in (guide, volume):
        if ob is not None and ob.name in view_layer.objects:
            ob.hide_set(True, view_layer=view_layer)
    return HairResult(collection, root, head_object, made.object, guide, scan, volume)


def start_job(
    scan: str | Path,
    folder: str | Path,
    settings: Settings,
    *,
    head: bpy.types.Object | None = None,
    python: str | None = None,
    environment: Mapping[str, str] | None = None,
    until: str | None = None,
) -> jobs.Job:
    """Start the reconstruction of `scan` into `folder` in a background process that Blender's own modules are known to.

    head: a mesh object of the user's, with a vertex group 'scalp', in place of the built-in mannequin. python: another
    interpreter for the worker. environment: variables for it. until: the stage to stop after (`STOPS`). Raises ScanError or
    HeadError before anything is started.
    """
    if not Path(scan).exists():
        raise ScanError(f"{scan}: there is no such file; choose the scan again")
    if head is not None:
        settings = settings.changed({"head.mesh": str(save_head(head, Path(folder) / "template.obj").resolve())})
    _expose_bundled_modules()
    return jobs.start(scan, folder, settings, python=python, environment=environment, until=until)


def start_inspection(
    scan: str | Path,
    folder: str | Path,
    settings: Settings,
    *,
    python: str | None = None,
    environment: Mapping[str, str] | None = None,
) -> subprocess.Popen:
    """Start looking at `scan` in the background; `folder`/inspection.npz is there when the process ends with 0.

    What it says, an error too, is in `folder`/inspection.txt. Raises ScanError where there is no such scan.
    """
    if not Path(scan).exists():
        raise ScanError(f"{scan}: there is no such file; choose the scan again")
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    chosen = folder / "inspection.json"
    chosen.write_text(json.dumps({"scan": settings.to_dict()["scan"]}), encoding="utf-8")
    _expose_bundled_modules()
    arguments = ["inspect", str(Path(scan).resolve()), "--out", str((folder / "inspection.npz").resolve())]
    arguments += ["--settings", str(chosen.resolve())]
    return jobs.start_command(arguments, folder / "inspection.txt", python=python, environment=environment)


def load_stage(folder: str | Path, *, colour: str = "brown", context: bpy.types.Context | None = None) -> bpy.types.Collection:
    """Bring what a job has that was stopped after a stage: the wig, the head in it, guides or dense hair; a new collection.

    Raises CT2HairError where there is nothing; the scene is then untouched.
    """
    folder = Path(folder)
    path = folder / "stage.json"
    try:
        known = json.loads(path.read_text(encoding="utf-8"))
        until, level = known["until"], known["scan"]["hair_level"]
        name = f"{scan_name(known['scan']['file'])} {until}"
        matrix = np.array(known["head"]["head_to_scan"], np.float64).reshape(4, 4) if known["head"] else None
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise CT2HairError(f"{path}: not the state of a job ({error}); run the stage again") from None
    properties = {
        "ct2hair_folder": str(folder.resolve()),
        "ct2hair_report": json.dumps(known),
        "ct2hair_settings": json.dumps(known["settings"], sort_keys=True),
        "ct2hair_version": known["program"]["version"],
    }
    if matrix is None:
        return _show_wig(folder / "volume.vdb", name, level, properties, context)
    to_head = head_from_scan(matrix)
    mesh = load_obj(folder / "head.obj").transformed(to_head)
    if until in ("head", "orientation"):
        lines = Strands.load(folder / "orientation.npz").transformed(to_head) if until == "orientation" else None
        return _show_wig(folder / "volume.vdb", name, level, properties, context, mesh, matrix, lines)
    guides = Strands.load(folder / "guides.npz").transformed(to_head)
    hair = Strands.load(folder / "dense.npz").transformed(to_head) if until == "dense" else guides
    return show_strands(
        hair,
        mesh,
        name,
        guides=guides,
        grid=folder / "volume.vdb",
        head_to_scan=matrix,
        hair_level=level,
        colour=colour,
        properties=properties,
        context=context,
    ).collection


def _show_wig(grid, name, level, properties, context, mesh=None, head_to_scan=None, orientation=None) -> bpy.types.Collection:
    """The wig's volume, the head in it and its hair's orientation (lines, mm, head frame) where they are known, as a collection
    of the kind `scan`."""
    summary = summarize(grid, level)
    with NewData() as new:
        collection, root = _new_collection(new, name, "scan")
        scan = _new_empty(new, f"{name} Scan", "scan", root)
        place = (
            scene_from_unregistered_scan(summary.low_corner, summary.high_corner)
            if head_to_scan is None
            else scene_from_scan(head_to_scan)
        )
        scan.matrix_basis = Matrix(place.tolist())
        collection.objects.link(scan)
        volume = new_volume(new, f"{name} Volume", grid, summary)
        _enrol(collection, volume, "volume", scan)
        if mesh is not None:
            _enrol(collection, new_head(new, f"{name} Head", mesh), "head", root)
        if orientation is not None:
            material = orientation_material(new, f"{name} Lines")
            lines = new_lines(new, f"{name} Lines", orientation, material, 0.2 * summary.spacing)
            _enrol(collection, lines, "orientation", root)
            volume.hide_render = True  # the lines stand where the cloud does
        for key, value in properties.items():
            collection[key] = value
    view_layer = _link(collection, context)
    if orientation is not None and volume.name in view_layer.objects:
        volume.hide_set(True, view_layer=view_layer)
    return collection


def add_template_head(name: str = "CT2Hair Head", context: bpy.types.Context | None = None) -> bpy.types.Object:
    """Add the built-in mannequin, its scalp marked and flattened, to the scene at the 3D cursor; returns the object."""
    context = context or bpy.context
    with NewData() as new:
        ob = new_head(new, name, template_head())
    ob.location = context.scene.cursor.location
    (context.collection or context.scene.collection).objects.link(ob)
    context.view_layer.update()
    return ob


def reconstruct(
    scan: str | Path,
    folder: str | Path,
    settings: Settings | None = None,
    *,
    progress: Callable[[str, float, float | None], None] | None = None,
    head: bpy.types.Object | None = None,
    python: str | None = None,
    **options,
) -> HairResult:
    """Reconstruct `scan` in a background process, wait for it, and load the result: for scripts and headless Blender.

    progress(text, fraction, remaining seconds or None) is called a few times a second and may raise Cancelled. head, python:
    see `start_job`. options: of `load_result`. Raises CT2HairError with the reason and the log's path.
    """
    job = start_job(scan, folder, settings or Settings(), head=head, python=python)
    try:
        while job.running:
            job.poll()
            if progress is not None:
                progress(job.text, job.fraction, job.remaining)
            time.sleep(0.1)
        job.poll()
    except BaseException:
        job.close()
        raise
    check_job(job)
    return load_result(folder, **options)


def check_job(job: jobs.Job) -> None:
    """Raise what a finished job ended with: Cancelled, CT2HairError with the reason and the log's path, or nothing."""
    if job.cancelled:
        raise Cancelled(f"cancelled; finished stages are kept in {job.folder.path.parent}")
    if job.error or job.result is None:
        raise CT2HairError(f"{job.error or 'the worker ended without a result'} (log: {job.log_path})")


STRAND_FORMATS = ("bin", "data", "hair", "npz")
"""Strand files of other programs and our own; each is also its file's ending."""
FORMATS = ("blend", "alembic", "usd", "picture", *STRAND_FORMATS)
USUAL_FORMATS = ("blend", "alembic", "usd", "picture")


def export_all(
    result: HairResult,
    folder: str | Path,
    *,
    formats: tuple[str, ...] = USUAL_FORMATS,
    name: str = "hair",
    unit: str = "m",
    up: str = "y",
    strand_unit: str = "mm",
    strand_up: str = "z",
    frames: tuple[int, int] | None = None,
    samples: int = 64,
    size: int = 800,
) -> dict[str, Path]:
    """Write a result into `folder`: <name>.blend, <name>.abc, <name>.usda, <name>.bin ..., render.png; format -> path.

    The job's report.html and report.json come along where the folder is another one than the job's. unit, up: of Alembic.
    strand_unit, strand_up: of strand files. frames: (first, last) that Alembic and USD are animated over. samples, size: of
    the picture.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    unknown = set(formats) - set(FORMATS)
    if unknown:
        raise CT2HairError(f"unknown format {', '.join(sorted(unknown))}; there are {', '.join(FORMATS)}")
    written = {}
    if "alembic" in formats:
        written["alembic"] = write_alembic(result, folder / f"{name}.abc", unit, up, frames=frames)
    if "usd" in formats:
        written["usd"] = write_usd(result, folder / f"{name}.usda", frames=frames)
    for ending in STRAND_FORMATS:
        if ending in formats:
            written[ending] = write_strand_file(result, folder / f"{name}.{ending}", strand_unit, strand_up)
    if "picture" in formats:
        written["picture"] = render_picture(result, folder / "render.png", samples=samples, size=size)
    if "blend" in formats:
        written["blend"] = write_blend(folder / f"{name}.blend")
    for report in ("report.html", "report.json"):
        source = result.folder / report
        if source.is_file() and source.resolve() != (folder / report).resolve():
            (folder / report).write_bytes(source.read_bytes())
            written[report] = folder / report
    return written


STRAND_UNITS = {"mm": 1.0, "cm": 10.0, "m": 1000.0}
"""Units of strand files, in millimetres."""


def import_strands(
    path: str | Path,
    *,
    unit: str = "auto",
    up: str = "z",
    head: bpy.types.Object | HeadMesh | None = None,
    name: str | None = None,
    colour: str = "brown",
    diameter: float = DIAMETER,
    context: bpy.types.Context | None = None,
) -> HairResult:
    """Bring strands of a file (.npz .bin .data .hair) into the scene, as hair on a head.

    unit: mm, cm, m, or auto, which takes the one by which the hair is as large as hair is. up: z (face to -y), or y (face to
    +z) as in USC-HairSalon's and Cem Yuksel's files. head: a mesh with a vertex group 'scalp' that the strands, in the scene's
    coordinates, already fit; or a HeadMesh in the file's own unit and axes, its scalp where the roots are if it has none; None
    fits the built-in mannequin to the roots. Raises CT2HairError; the scene is then untouched.
    """
    path = Path(path)
    strands = read_strands(path)
    if up not in ("y", "z"):
        raise CT2HairError(f"up axis '{up}' is not known; choose y or z")
    if not len(strands) or not (strands.counts > 0).all():
        raise CT2HairError(f"{path}: holds no strands, or empty ones; export the file again")
    scale = _strand_scale(path, strands) if unit == "auto" else STRAND_UNITS.get(unit)
    if scale is None:
        raise CT2HairError(f"unit '{unit}' is not known; choose auto, {', '.join(STRAND_UNITS)}")
    place = np.diag([scale, scale, scale, 1.0])
    if up == "y":
        place = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]]) @ place
    strands = strands.transformed(place)
    if isinstance(head, HeadMesh):
        mesh = head.transformed(place)
        mesh = mesh if len(mesh.scalp_faces) else mark_scalp(mesh, strands.roots)
    elif head is not None:
        mesh = head_mesh(head, evaluated=True)
        world = np.diag([1 / MM, 1 / MM, 1 / MM, 1.0]) @ np.array(head.matrix_world) @ np.diag([MM, MM, MM, 1.0])
        mesh = mesh.transformed(world)
        if not np.isfinite(mesh.uv[mesh.scalp]).all():
            mesh = unwrap(mesh)
    else:
        fitted = fit_to_roots(template_head(), strands.roots)
        to_head = head_from_scan(np.asarray(fitted.matrix))
        mesh, strands = fitted.head.transformed(to_head), strands.transformed(to_head)
    distance = float(np.median(np.abs(Head(mesh).signed_distance(strands.roots))))
    if distance > ROOTS_OFF:
        raise CT2HairError(
            f"{path}: the roots lie {distance:.0f} mm from the head (median); check the unit and the axis up, or choose the "
            "head that the hair was made on"
        )
    properties = {"ct2hair_source": str(path.resolve()), "ct2hair_unit": unit, "ct2hair_up": up}
    return show_strands(
        strands, mesh, name or scan_name(path), colour=colour, diameter=diameter, properties=properties, context=context
    )


ROOTS_OFF = 25.0
"""mm; roots farther from the head than this, in the median, are of another head, unit or axis."""


def _strand_scale(path: Path, strands: Strands) -> float:
    """Millimetres a unit of the file, by which the hair's box is 0.12 to 1.2 m large."""
    extent = float(np.ptp(strands.points, axis=0).max())
    for scale in STRAND_UNITS.values():
        if 120.0 <= extent * scale < 1200.0:
            return scale
    raise CT2HairError(f"{path}: the hair is {extent:.3g} units large, as no head of hair is in mm, cm or m; choose the unit")


def _read_report(folder: Path) -> dict[str, Any]:
    path = folder / "report.json"
    try:
        report = json.loads(path.read_text(encoding="utf-8"))
        np.array(report["head"]["head_to_scan"], np.float64).reshape(4, 4)
        return report
    except FileNotFoundError:
        raise CT2HairError(f"{folder}: no report.json, so no result here; choose the folder of a finished job") from None
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise CT2HairError(f"{path}: not a report of CT2Hair ({error}); run the reconstruction again") from None


def _new_collection(new: NewData, name: str, kind: str) -> tuple[bpy.types.Collection, bpy.types.Object]:
    """A collection 'CT2Hair <name>' with its handle, linked to nothing yet."""
    collection = new.add(bpy.data.collections.new(f"{PREFIX} {name}"))
    collection[KIND] = kind
    root = _new_empty(new, f"{PREFIX} {name}", "root", None)
    root.empty_display_type, root.empty_display_size = "ARROWS", 0.05
    collection.objects.link(root)
    return collection, root


def _new_empty(new: NewData, name: str, role: str, parent: bpy.types.Object | None) -> bpy.types.Object:
    empty = new.add(bpy.data.objects.new(name, None))
    empty.empty_display_type, empty.empty_display_size = "PLAIN_AXES", 20.0 if role == "scan" else 0.05
    empty[ROLE] = role
    if parent is not None:
        attach(empty, parent)
    return empty


def _enrol(collection: bpy.types.Collection, ob: bpy.types.Object, role: str, parent: bpy.types.Object) -> None:
    """Put an object into its place in the layout of `frames`."""
    ob[ROLE] = role
    attach(ob, parent)
    collection.objects.link(ob)


def _link(collection: bpy.types.Collection, context: bpy.types.Context | None) -> bpy.types.ViewLayer:
    """Show a finished collection in the scene of `context`: the only step that the user sees."""
    context = context or bpy.context
    context.scene.collection.children.link(collection)
    context.view_layer.update()  # until then the view layer does not know the new objects
    return context.view_layer


def _expose_bundled_modules() -> None:
    """Put Blender's own Python modules (OpenVDB) on `sys.path`, from where the worker is told of them, too."""
    bpy.utils.expose_bundled_modules()
