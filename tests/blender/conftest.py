"""What the tests in Blender share: an empty file, the extension registered from the sources, a small head with hair."""

from __future__ import annotations

import hashlib
import importlib.util
import json
import sys
from pathlib import Path
from types import ModuleType

import bpy
import numpy as np
import pytest

from ct2hair_addon.cache import cache_folder
from ct2hair_addon.head import HeadMesh
from ct2hair_addon.strands import Strands
from ct2hair_addon.volume import BrickVolume, Inspection, Thresholds, save_vdb

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = "ct2hair_extension"


@pytest.fixture(scope="session")
def extension() -> ModuleType:
    """The extension as Blender loads it: the repository as a package whose name it does not know, registered.

    It is loaded through a link, since numba keeps compiled kernels by their source's path and not by their package's name:
    those of `ct2hair_addon`, which other tests load in the same process, must stay apart.
    """
    place = cache_folder() / "tests" / hashlib.sha256(str(ROOT).encode()).hexdigest()[:12]
    place.parent.mkdir(parents=True, exist_ok=True)
    if not place.is_symlink():
        place.symlink_to(ROOT, target_is_directory=True)
    spec = importlib.util.spec_from_file_location(PACKAGE, place / "__init__.py", submodule_search_locations=[str(place)])
    module = importlib.util.module_from_spec(spec)
    sys.modules[PACKAGE] = module
    spec.loader.exec_module(module)
    module.register()
    yield module
    module.unregister()


@pytest.fixture(autouse=True)
def empty_file():
    """Every test starts with an empty file."""
    bpy.ops.wm.read_factory_settings(use_empty=True)


@pytest.fixture(scope="session")
def dome() -> HeadMesh:
    """A ball of 90 mm, scalp on the upper half, of quads with triangles at the poles; scalp UV from above. Head frame, mm."""
    rings, segments, radius = 24, 36, 90.0
    polar = np.pi * np.arange(1, rings) / rings
    around = 2 * np.pi * np.arange(segments) / segments
    ring = np.stack(
        [
            np.outer(np.sin(polar), np.cos(around)),
            np.outer(np.sin(polar), np.sin(around)),
            np.outer(np.cos(polar), np.ones(segments)),
        ],
        axis=-1,
    ).reshape(-1, 3)
    vertices = np.concatenate([[[0, 0, 1]], ring, [[0, 0, -1]]]) * radius
    last = len(vertices) - 1
    at = lambda r, s: 1 + r * segments + s % segments  # noqa: E731
    polygons = [[0, at(0, s), at(0, s + 1)] for s in range(segments)]
    polygons += [[at(r, s), at(r + 1, s), at(r + 1, s + 1), at(r, s + 1)] for r in range(rings - 2) for s in range(segments)]
    polygons += [[at(rings - 2, s), last, at(rings - 2, s + 1)] for s in range(segments)]
    # every other quad is split along its other diagonal, as a head's may be
    faces = []
    for number, p in enumerate(polygons):
        if len(p) == 3:
            faces.append(p)
        elif number % 2:
            faces += [[p[0], p[1], p[2]], [p[0], p[2], p[3]]]
        else:
            faces += [[p[0], p[1], p[3]], [p[1], p[2], p[3]]]
    scalp = vertices[:, 2] > 5.0
    angle = np.arccos(np.clip(vertices[:, 2] / radius, -1, 1)) / (np.pi / 2)
    turn = np.arctan2(vertices[:, 1], vertices[:, 0])
    uv = 0.5 + 0.45 * (angle * np.stack([np.cos(turn), np.sin(turn)])).T
    uv[~scalp] = np.nan
    offsets = np.concatenate([[0], np.cumsum([len(p) for p in polygons])])
    return HeadMesh(vertices, np.array(faces), scalp, uv, offsets.astype(np.int32), np.concatenate(polygons).astype(np.int32))


def strands_on(head: HeadMesh, count: int, points: int = 8, seed: int = 0) -> tuple[Strands, np.ndarray, np.ndarray]:
    """Curved strands rooted on the scalp's triangles: strands, triangle and weights of each root."""
    rng = np.random.default_rng(seed)
    face = rng.choice(head.scalp_faces, count)
    bary = rng.dirichlet(np.ones(3), count)
    corners = head.faces[face]
    root = np.einsum("nc,ncx->nx", bary, head.vertices[corners])
    uv = np.einsum("nc,ncx->nx", bary, head.uv[corners])
    t = np.linspace(0, 1, points)[None, :, None]
    outward = root / np.linalg.norm(root, axis=1, keepdims=True)
    along = root[:, None] + 60 * t * outward[:, None] + np.array([0, 10, -40]) * t**2
    strands = Strands.from_array(
        along.astype(np.float32), root_uv=uv.astype(np.float32), support=rng.random(count).astype(np.float32)
    )
    return strands, face, bary


@pytest.fixture
def job_folder(tmp_path, dome) -> Path:
    """The folder of a finished job: hair on the dome, seen by a scanner that stood askew, in its scan frame."""
    folder = tmp_path / "job"
    folder.mkdir()
    place = head_to_scan()
    rigid = place.copy()
    rigid[:3, :3] /= SCALE
    strands, *_ = strands_on(dome, 200)
    # as the refinement leaves it: a support per strand and one per point
    backed = np.random.default_rng(2).random(len(strands.points)).astype(np.float32)
    strands = Strands(strands.points, strands.offsets, strands.strand_attributes, {"support": backed})
    strands.transformed(rigid).save(folder / "hair.npz")
    strands_on(dome, 20, seed=1)[0].transformed(rigid).save(folder / "guides.npz")
    dome.transformed(rigid).save(folder / "head.obj")
    report = {
        "program": {"version": "0.1.0"},
        "scan": {"file": "wig.nii.gz", "hair_level": 0.3},
        "head": {"head_to_scan": place.tolist()},
        "settings": {"run": {"seed": 3}},
    }
    (folder / "report.json").write_text(json.dumps(report))
    (folder / "report.html").write_text("<html></html>")
    dense = np.zeros((40, 30, 20), np.float32)
    dense[3, 5, 7], dense[30, 20, 10] = 1.0, 0.5  # an asymmetric phantom: where these two voxels land tells axis slips
    save_vdb(BrickVolume.from_dense(dense, 0.5, (10.0, 20.0, 30.0)), folder / "volume.vdb")
    return folder


SCALE = 1.04
"""What the registration made of the template's size."""


def head_to_scan() -> np.ndarray:
    """Head lying on its back, face up, turned by 30 degrees, the template grown to 1.04."""
    a = np.radians(30.0)
    turn = np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]])
    lie = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    matrix = np.eye(4)
    matrix[:3, :3] = SCALE * turn @ lie
    matrix[:3, 3] = 300.0, 200.0, 150.0
    return matrix


def block_counts() -> dict[str, int]:
    """How many data-blocks of each kind the file holds: the same before and after what must leave the scene alone."""
    kinds = ("objects", "meshes", "hair_curves", "volumes", "materials", "collections", "node_groups", "scenes", "worlds")
    return {kind: len(getattr(bpy.data, kind)) for kind in (*kinds, "cameras", "lights")}


class Window:
    """A context with a window, whose timer and status bar the test looks at, since bpy has none."""

    def __init__(self):
        self.status, self.timers, self.handlers = None, [], []
        self.scene, self.view_layer, self.window = bpy.context.scene, bpy.context.view_layer, None
        self.window_manager = self.workspace = self

    def event_timer_add(self, interval, window=None):
        assert 0.01 <= interval <= 0.2
        self.timers.append(interval)
        return interval

    def event_timer_remove(self, timer):
        self.timers.remove(timer)

    def modal_handler_add(self, operator):
        self.handlers.append(operator)

    def status_text_set(self, text):
        self.status = text


@pytest.fixture
def inspection():
    rng = np.random.default_rng(0)
    look = rng.normal(1000, 30, (30, 40, 50)).astype(np.float32)
    look[5:9, 30:34, 40:44] = 1400  # an asymmetric lump of hair
    counts, edges = np.histogram(look, 256)
    found = Thresholds(1000.0, 30.0, 130.0, 1200.0, 1600.0, None, 500)
    return Inspection(counts, edges, look, (60, 80, 100), (0.5, 0.5, 0.5), 2_000_000, found)
