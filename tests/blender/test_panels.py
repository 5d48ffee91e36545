"""The panels, drawn on a layout that checks what it is given: every property and operator is there, every icon known."""

from __future__ import annotations

from types import SimpleNamespace

import bpy
import pytest

pytestmark = pytest.mark.usefixtures("extension")

ICONS = set(bpy.types.UILayout.bl_rna.functions["label"].parameters["icon"].enum_items.keys())


class Layout:
    """Stands in for UILayout, which only a window hands out: notes what is drawn, and refuses what Blender would."""

    def __init__(self, drawn: list[str]) -> None:
        self.drawn = drawn
        self.enabled = True
        self.use_property_split = self.use_property_decorate = False
        self.scale_y = 1.0

    def column(self, align=False):
        return Layout(self.drawn)

    row = box = column

    def prop(self, data, name, text=None, icon="NONE", **how):
        assert name in data.bl_rna.properties, f"{data.bl_rna.identifier} has no property {name}"
        assert icon in ICONS
        self.drawn.append(name)

    def label(self, text="", icon="NONE"):
        assert icon in ICONS, icon
        self.drawn.append(text)

    def operator(self, name, text=None, icon="NONE"):
        module, _, operator = name.partition(".")
        getattr(getattr(bpy.ops, module), operator).get_rna_type()  # KeyError where there is no such operator
        assert icon in ICONS, icon
        self.drawn.append(name)
        return SimpleNamespace()

    def template_icon(self, icon_value=0, scale=1.0):
        assert isinstance(icon_value, int) and scale > 0
        self.drawn.append("picture")

    def menu(self, name, text=None):
        assert hasattr(bpy.types, name)
        self.drawn.append(name)

    def separator(self):
        pass

    def progress(self, text="", factor=0.0, type="BAR"):
        assert 0 <= factor <= 1 and type in ("BAR", "RING")
        self.drawn.append(f"{factor:.0%} {text}")

    def panel(self, name, default_closed=False):
        return Layout(self.drawn), Layout(self.drawn)


def draw(extension) -> dict[str, list[str]]:
    """What each panel draws now."""
    out = {}
    for cls in extension.panels.sidebar.CLASSES:
        if hasattr(cls, "poll") and not cls.poll(bpy.context):
            continue
        drawn = out[cls.__name__.removeprefix("CT2HAIR_PT_")] = []
        methods = {key: getattr(cls, key) for key in dir(cls) if key.startswith("_draw")}
        panel = SimpleNamespace(layout=Layout(drawn), **methods)
        panel.column = lambda panel=panel, cls=cls: cls.column(panel)
        cls.draw(panel, bpy.context)
    return out


def test_before_anything_is_done(extension):
    drawn = draw(extension)
    assert {"ct2hair.import_scan", "scan", "spacing"} <= set(drawn["scan"])
    assert {"preset", "strands", "seed", "ct2hair.reconstruct", "CT2HAIR_MT_presets"} <= set(drawn["reconstruct"])
    assert {"head", "face", "up", "ct2hair.place_head", "ct2hair.paint_scalp"} <= set(drawn["head"])
    assert "material" not in drawn and "ct2hair.simulate" in drawn["simulate"]
    assert "No result in the scene" in drawn["result"] and "ct2hair.load_result" in drawn["result"]


def test_all_parameters_are_within_reach(extension):
    from ct2hair_addon.settings import parameters

    drawn = draw(extension)
    everywhere = {name for panel in drawn.values() for name in panel}
    assert {name.split(".")[1] for name, _ in parameters()} - {"place"} <= everywhere


def test_raw_scans_are_asked_for_their_shape(extension):
    bpy.context.scene.ct2hair.scan = "/tmp/wig.raw"
    assert {"raw_shape", "raw_type"} <= set(draw(extension)["scan"])


def test_while_a_job_runs(extension, tmp_path):
    current = extension.operators.running.current
    job = SimpleNamespace(
        text="tracing guide strands",
        fraction=0.42,
        remaining=100.0,
        log_path=tmp_path / "log.txt",
        close=lambda: None,
        warnings=[],
    )
    current.begin(job, tmp_path)
    try:
        drawn = draw(extension)["reconstruct"]
        assert "Tracing guide strands" in drawn and "42% 42%  2 min left" in drawn
        assert "ct2hair.cancel" in drawn and "ct2hair.reconstruct" in drawn  # the next one waits in line
    finally:
        current.end("no hair was found in the scan, whose values run from 0 to 12 where hair has 300", failed=True)
    (tmp_path / "log.txt").write_text("log")
    drawn = draw(extension)["reconstruct"]
    assert "ct2hair.reconstruct" in drawn and "wm.path_open" in drawn
    assert any("no hair was found" in text for text in drawn)
    current.end("", failed=False)


def test_with_a_result(extension, job_folder):
    extension.ct2hair_addon.scene.load_result(job_folder)
    drawn = draw(extension)
    assert "CT2Hair wig" in drawn["result"] and "200 strands" in drawn["result"] and "ct2hair.show" in drawn["result"]
    assert "ct2hair.export" in drawn["export"] and "default_value" in drawn["material"]
    assert not any("cm²" in text for text in drawn["regions"])
    bpy.ops.ct2hair.measure()
    assert sum("cm²" in text for text in draw(extension)["regions"]) == 6
