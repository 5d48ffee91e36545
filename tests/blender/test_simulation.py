"""Hair in motion: roots stay, tips move, nothing goes through the head; it plays and leaves by export."""

import time
from types import MethodType, SimpleNamespace

import bpy
import numpy as np
import pytest

from ct2hair_addon import scene
from ct2hair_addon.errors import CT2HairError
from ct2hair_addon.head import Head
from ct2hair_addon.scene.dynamics import Obstacle, Simulation
from ct2hair_addon.settings import SimulationSettings

from .conftest import Window, block_counts, strands_on


@pytest.fixture
def result(dome):
    return scene.show_strands(strands_on(dome, 400, 16)[0], dome, "moving", guides=strands_on(dome, 60, 16, seed=1)[0])


def now(result):
    return scene.strands_of(result.hair, evaluated=True)


def test_thirty_frames_keep_the_roots_move_the_tips_and_spare_the_head(result, dome, tmp_path):
    rest = scene.strands_of(result.hair)
    frame = bpy.context.scene.frame_current
    done = scene.simulate(result, SimulationSettings(hold=0.0), frames=(1, 30), cache=tmp_path / "motion.pc2")
    assert bpy.context.scene.frame_current == frame and done.frames == (1, 30) and done.guides == 60
    head = Head(dome)
    bpy.context.scene.frame_set(1)
    np.testing.assert_allclose(now(result).points, rest.points, atol=0.02)
    for number in (10, 30):
        bpy.context.scene.frame_set(number)
        moved = now(result)
        np.testing.assert_allclose(moved.roots, rest.roots, atol=0.01)
        assert np.mean(head.signed_distance(moved.points) < -0.01) <= 0.01
    assert np.linalg.norm(moved.tips - rest.tips, axis=1).mean() > 5.0 and done.tip > 5.0
    assert moved.tips[:, 2].mean() < rest.tips[:, 2].mean() - 3.0  # gravity pulls down, and nowhere else
    assert np.median(moved.lengths() / rest.lengths()) == pytest.approx(1.0, abs=0.08)
    assert scene.simulated_frames(result) == (1, 30)


def test_roots_stay_on_a_head_that_turns(result, dome, tmp_path):
    result.root.rotation_euler.z = 0.0
    result.root.keyframe_insert("rotation_euler", frame=1)
    result.root.rotation_euler.z = 1.2
    result.root.keyframe_insert("rotation_euler", frame=8)
    scene.simulate(result, SimulationSettings(gravity=0.0), frames=(1, 8), cache=tmp_path / "turn.pc2")
    rest = scene.strands_of(result.hair)
    for frame in (8, 4):
        bpy.context.scene.frame_set(frame)
        np.testing.assert_allclose(now(result).roots, rest.roots, atol=0.01)  # in the head's own frame
    behind = now(result).tips - rest.tips
    tangent = np.cross([0, 0, 1], rest.tips)
    far = np.linalg.norm(rest.tips[:, :2], axis=1) > 60
    assert np.einsum("nx,nx->n", behind, tangent)[far].mean() < 0  # half way, hair lags behind


def test_a_simulation_is_replaced_and_removed_whole(result, tmp_path):
    before = block_counts()
    for _ in range(2):
        scene.simulate(result, SimulationSettings(), frames=(1, 3), cache=tmp_path / "m.pc2")
    assert [m.name for m in result.hair.modifiers] == ["Follow Head", "Follow Guides"]
    assert scene.clear_simulation(result) and not scene.clear_simulation(result)
    after = block_counts()
    after["node_groups"] = before["node_groups"]  # the shared group stays
    assert after == before and [m.name for m in result.hair.modifiers] == ["Follow Head"]
    assert not any(attribute.name.startswith("ct2hair") for attribute in result.hair.data.attributes)


def test_what_cannot_be_simulated_is_refused(result, tmp_path):
    before = block_counts()
    with pytest.raises(CT2HairError, match="two frames or more"):
        scene.simulate(result, frames=(5, 5), cache=tmp_path / "m.pc2")
    with pytest.raises(CT2HairError, match="no job folder"):
        scene.simulate(result, frames=(1, 3))
    result.head.scale = 2, 1, 1
    with pytest.raises(CT2HairError, match="scaled"):
        scene.simulate(result, frames=(1, 3), cache=tmp_path / "m.pc2")
    assert block_counts() == before


def test_the_solver_does_not_depend_on_its_neighbours(dome):
    rest = strands_on(dome, 50, 12)[0].points.reshape(50, 12, 3)
    obstacle, place = Obstacle.of(Head(dome)), np.eye(4)
    whole, alone = Simulation(rest, SimulationSettings()), Simulation(rest[:7], SimulationSettings())
    for _ in range(3):
        whole.step(rest, obstacle, place, 1 / 24, (0, 0, -9.81))
        alone.step(rest[:7], obstacle, place, 1 / 24, (0, 0, -9.81))
    np.testing.assert_array_equal(whole.points[:7], alone.points)
    assert np.abs(obstacle.distances(dome.vertices)).max() < 0.2


def test_alembic_and_usd_hold_the_motion(result, tmp_path):
    AbcGeom = pytest.importorskip("alembic3d").AbcGeom
    from alembic3d import Abc

    scene.simulate(result, SimulationSettings(hold=0.0), frames=(1, 4), cache=tmp_path / "m.pc2")
    path = scene.write_alembic(result, tmp_path / "a.abc", "cm", "z", frames=(1, 4))
    groom = Abc.IArchive(str(path)).getTop().children[0]
    node = next(child for child in groom.children if child.getName() == "hair")
    schema = AbcGeom.ICurves(node, "hairShape").getSchema()
    assert schema.getNumSamples() == 4
    fps = bpy.context.scene.render.fps
    assert schema.getTimeSampling().getSampleTime(3) == pytest.approx(4 / fps)
    stage = pytest.importorskip("pxr.Usd").Stage.Open(str(scene.write_usd(result, tmp_path / "a.usdc", frames=(1, 4))))
    from pxr import UsdGeom

    every = [UsdGeom.BasisCurves(prim) for prim in stage.Traverse() if prim.IsA(UsdGeom.BasisCurves)]
    curves = max(every, key=lambda some: len(some.GetCurveVertexCountsAttr().Get()))
    for frame in (1, 4):
        bpy.context.scene.frame_set(frame)
        metres = now(result).points / 1000
        positions = np.asarray(memoryview(schema.getValue(Abc.ISampleSelector(frame - 1)).getPositions()))
        np.testing.assert_allclose(positions, 100 * metres, atol=1e-4)
        np.testing.assert_allclose(curves.GetPointsAttr().Get(frame), metres, atol=1e-6)


@pytest.fixture
def modal(extension, result, tmp_path, monkeypatch):
    """Run the operator as a window would: `start()`, then `step(event type)` -> what modal() returned."""
    module = extension.operators.simulation
    monkeypatch.setattr(module, "headless", lambda: False)
    owner = bpy.context.scene
    owner.frame_start, owner.frame_end = 1, 8
    cls, context, reports = module.CT2HAIR_OT_simulate, Window(), []
    operator = SimpleNamespace(cache=str(tmp_path / "motion.pc2"), report=lambda kind, text: reports.append((*kind, text)))
    for name in ("_say", "_leave", "_go_on"):
        setattr(operator, name, MethodType(getattr(cls, name), operator))

    def step(kind, value="NOTHING"):
        return cls.modal(operator, context, SimpleNamespace(type=kind, value=value))

    start = lambda: cls.execute(operator, context)  # noqa: E731
    return SimpleNamespace(start=start, step=step, context=context, reports=reports, operator=operator, cls=cls, module=module)


def through(modal) -> set[str]:
    end = time.monotonic() + 120
    while (outcome := modal.step("TIMER")) == {"RUNNING_MODAL"} and time.monotonic() < end:
        time.sleep(0.005)
    return outcome


def test_in_a_window_it_runs_beside_the_events_and_gives_the_very_same(modal, result, tmp_path):
    assert modal.start() == {"RUNNING_MODAL"} and modal.context.timers and modal.context.handlers
    assert modal.step("MOUSEMOVE") == {"PASS_THROUGH"} and modal.step("LEFTMOUSE", "PRESS") == {"RUNNING_MODAL"}
    assert through(modal) == {"FINISHED"}
    assert not modal.context.timers and modal.context.status is None
    assert modal.reports[-1][0] == "INFO" and "Simulated 60 guides, frames 1 to 8" in modal.reports[-1][1]
    motion = (tmp_path / "motion.pc2").read_bytes()
    assert scene.simulated_frames(result) == (1, 8)
    scene.simulate(result, frames=(1, 8), cache=tmp_path / "again.pc2")
    assert (tmp_path / "again.pc2").read_bytes() == motion


def test_escape_leaves_all_as_it_was(modal, result, tmp_path):
    before = block_counts()
    modal.start()
    while modal.operator._share < 0.3:
        assert modal.step("TIMER") == {"RUNNING_MODAL"}
        time.sleep(0.002)
    done = modal.operator._share
    assert modal.step("ESC", "PRESS") == {"RUNNING_MODAL"}
    assert through(modal) == {"CANCELLED"} and modal.operator._share == done < 1.0
    assert block_counts() == before and not modal.context.timers and scene.simulated_frames(result) is None
    assert bpy.context.scene.frame_current == 1 and not list(tmp_path.iterdir())
    assert modal.reports[-1][0] == "WARNING"


def test_escape_at_the_very_end_leaves_the_simulation_before_and_its_file(modal, result, tmp_path):
    scene.simulate(result, SimulationSettings(wind_y=5.0), frames=(1, 3), cache=tmp_path / "motion.pc2")
    before = block_counts(), (tmp_path / "motion.pc2").read_bytes()
    modal.start()
    while modal.operator._share < 0.95:
        assert modal.step("TIMER") == {"RUNNING_MODAL"}
        time.sleep(0.002)
    modal.step("ESC", "PRESS")
    assert through(modal) == {"CANCELLED"}
    assert (block_counts(), (tmp_path / "motion.pc2").read_bytes()) == before
    assert scene.simulated_frames(result) == (1, 3)


def test_a_fault_in_a_step_leaves_all_as_it_was(modal, result, tmp_path, monkeypatch):
    def broken(*_):
        raise ZeroDivisionError("a fault of ours")

    before = block_counts()
    monkeypatch.setattr(modal.module.scene.simulation.Simulation, "step", broken)
    modal.start()
    with pytest.raises(ZeroDivisionError):
        through(modal)
    assert block_counts() == before and not modal.context.timers and not list(tmp_path.iterdir())


def test_closing_the_window_ends_it(modal, result):
    before = block_counts()
    modal.start()
    modal.cls.cancel(modal.operator, modal.context)
    assert block_counts() == before and not modal.context.timers


def test_an_error_in_the_middle_is_told_and_leaves_all_as_it_was(modal, result, tmp_path):
    before = block_counts()
    modal.start()
    result.head.scale = (2.0, 1.0, 1.0)
    bpy.context.view_layer.update()
    assert through(modal) == {"CANCELLED"}
    assert ("ERROR", "the head is scaled: apply its scale (Ctrl A) before a simulation") in modal.reports
    assert block_counts() == before and not modal.context.timers and not list(tmp_path.iterdir())
