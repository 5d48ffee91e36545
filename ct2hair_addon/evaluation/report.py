"""The report of a reconstruction: report.json for programs, report.html for people; one file, no network."""

from __future__ import annotations

import base64
import html
import io
import json
import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ..head import Head
from ..progress import Progress, silent
from ..strands import Strands
from ..volume import BrickVolume
from .pictures import PIXELS, cameras, slice_picture, strand_picture, volume_picture

MAP_CELLS = 64
"""Cells along an edge of the coverage map."""
BARS = 28

_STYLE = """
:root { color-scheme: light dark; --ink: #1c1d21; --dim: #62656e; --line: #d9dbe1; --card: #fff; --page: #f4f5f7;
  --accent: #c8641e; --second: #2b7fb8; }
@media (prefers-color-scheme: dark) { :root { --ink: #e7e8ec; --dim: #9a9da8; --line: #33353c; --card: #202126;
  --page: #17181b; --accent: #ff9a4d; --second: #5cb8f0; } }
body { margin: 0; background: var(--page); color: var(--ink); font: 15px/1.5 system-ui, sans-serif; }
main { max-width: 1080px; margin: 0 auto; padding: 28px 20px 60px; }
h1 { font-size: 26px; margin: 0 0 4px; } h2 { font-size: 18px; margin: 34px 0 10px; } p { margin: 6px 0; }
.dim { color: var(--dim); }
.warn { border-left: 4px solid var(--accent); padding: 4px 12px; background: var(--card); margin: 6px 0; }
.facts { display: grid; grid-template-columns: repeat(auto-fit, minmax(150px, 1fr)); gap: 10px; margin-top: 16px; }
.facts div { background: var(--card); border: 1px solid var(--line); border-radius: 8px; padding: 10px 12px; }
.facts b { display: block; font-size: 20px; } table { border-collapse: collapse; width: 100%; background: var(--card); }
th, td { text-align: left; padding: 6px 10px; border-bottom: 1px solid var(--line); vertical-align: top; }
td.n, th.n { text-align: right; font-variant-numeric: tabular-nums; white-space: nowrap; }
.pictures { display: grid; grid-template-columns: repeat(auto-fit, minmax(280px, 1fr)); gap: 10px; }
figure { margin: 0; } figure img { width: 100%; border-radius: 8px; display: block; }
figcaption { color: var(--dim); font-size: 13px; padding: 4px 2px; }
details summary { cursor: pointer; } pre { overflow: auto; background: var(--card); padding: 12px; border-radius: 8px; }
svg { width: 100%; height: auto; background: var(--card); border: 1px solid var(--line); border-radius: 8px; }
ul.tally { margin: 0; padding-left: 18px; }
"""


def write_report(
    folder: Path,
    summary: Mapping[str, Any],
    density: BrickVolume,
    hair: Strands,
    guides: Strands,
    head: Head,
    progress: Progress = silent,
) -> None:
    """Write report.json (`summary`, plain values) and report.html (with pictures) into `folder`, each whole or not at all.

    density: the wig as it was reconstructed from; hair, guides: the result; head: the registered one; all scan frame, mm.
    summary: as `pipeline.reconstruct` makes it.
    """
    folder = Path(folder)
    _write(folder / "report.json", json.dumps(_plain(summary), indent=2))
    parts = [_opening(summary), _warnings(summary.get("warnings", ()))]
    parts += [_pictures(summary, density, hair, guides, head, progress)]
    parts += [_scores(summary.get("scores", {})), _found(summary), _stages(summary.get("stages", ()))]
    parts += [_distributions(hair, guides, head), _settings(summary)]
    title = f"CT2Hair: {summary['scan']['file']}"
    page = (
        f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><title>{html.escape(title)}</title>'
        f'<meta name="viewport" content="width=device-width"><style>{_STYLE}</style></head><body><main>'
        + "".join(parts)
        + "</main></body></html>\n"
    )
    _write(folder / "report.html", page)
    progress(1.0, 1.0)


def _write(path: Path, text: str) -> None:
    beside = path.with_name(f".{path.name}.part")
    try:
        beside.write_text(text, encoding="utf-8")
        beside.replace(path)
    finally:
        beside.unlink(missing_ok=True)


def _plain(value: Any) -> Any:
    """`value` as JSON can hold it: numpy numbers as Python's, no NaN."""
    if isinstance(value, Mapping):
        return {str(name): _plain(item) for name, item in value.items()}
    if isinstance(value, np.ndarray):
        return _plain(value.tolist())
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    if isinstance(value, np.generic):
        value = value.item()
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _opening(summary: Mapping[str, Any]) -> str:
    scan, hair, stages = summary["scan"], summary["hair"], summary.get("stages", ())
    seconds = sum(stage["seconds"] for stage in stages)
    peak = max((stage["peak_memory"] for stage in stages), default=0.0)
    facts = (
        (f"{hair['strands']:,}", "strands"),
        (f"{hair['guides']:,}", "guides traced"),
        (f"{hair['mean_length_mm']:.0f} mm", "mean length"),
        (f"{hair['mean_support']:.0%}", "backed by the scan"),
        (f"{scan['hair_voxels'] / 1e6:.1f} M", f"hair voxels of {scan['spacing_mm']:g} mm"),
        (f"{seconds / 60:.1f} min", f"on {summary['machine']['threads']} threads"),
        (f"{peak:.1f} GB", "peak memory"),
    )
    boxes = "".join(f"<div><b>{html.escape(value)}</b>{html.escape(name)}</div>" for value, name in facts)
    program = summary["program"]
    by = f"{program['name']} {program['version']}, Python {program['python']}"
    return f'<h1>{html.escape(scan["file"])}</h1><p class="dim">{html.escape(by)}</p><div class="facts">{boxes}</div>'


def _warnings(warnings: Iterable[str]) -> str:
    return "".join(f'<p class="warn">{html.escape(text)}</p>' for text in warnings)


def _pictures(summary, density: BrickVolume, hair: Strands, guides: Strands, head: Head, progress: Progress) -> str:
    points = hair.points if len(hair) else head.mesh.vertices
    low, high = points.min(axis=0), points.max(axis=0)
    scalp = head.mesh.vertices[head.mesh.scalp] if head.mesh.scalp.any() else head.mesh.vertices
    low, high = np.minimum(low, scalp.min(axis=0)), np.maximum(high, scalp.max(axis=0))
    views = cameras(np.array(summary["head"]["head_to_scan"]), low, high)
    level = float(summary["scan"]["hair_level"])
    side_by_side, done = [], 0
    total = 3 * len(views) + 6
    for name, camera in views.items():
        for picture, text in (
            (volume_picture(density, 1.6 * level, camera), f"the scan, {name}"),
            (strand_picture(hair, camera, head.mesh), f"the strands, {name}"),
        ):
            side_by_side.append(_figure(picture, text))
            done += 1
            progress(done, total)
    slices = []
    for name in ("left", "front"):
        camera = views[name]
        slices.append(_figure(slice_picture(density, level, camera), f"slice through the middle, seen from {name}"))
        slices.append(
            _figure(
                slice_picture(density, level, camera, hair),
                "the same with strands: orange backed by the scan, blue made up between",
            )
        )
        done += 2
        progress(done, total)
    only = _figure(strand_picture(guides, views["left"], head.mesh), "guides alone, left")
    coverage = _figure(_coverage_map(hair), "roots over the scalp's texture, brighter is denser", pixelated=True)
    return (
        f'<h2>Scan and strands</h2><div class="pictures">{"".join(side_by_side)}</div>'
        f'<h2>Inside</h2><div class="pictures">{"".join(slices)}</div>'
        f'<h2>Guides and roots</h2><div class="pictures">{only}{coverage}</div>'
    )


def _coverage_map(hair: Strands) -> np.ndarray:
    """(C, C, 3) uint8: strands per cell of the scalp's texture, v up."""
    uv = np.asarray(hair.strand_attributes.get("root_uv", np.zeros((0, 2))))
    counts, _, _ = np.histogram2d(uv[:, 1], uv[:, 0], MAP_CELLS, ((0.0, 1.0), (0.0, 1.0)))
    full = np.quantile(counts[counts > 0], 0.95) if (counts > 0).any() else 1.0
    share = np.clip(counts[::-1] / max(full, 1.0), 0.0, 1.0)[:, :, None]
    # from a dark blue over red to a light yellow
    stops = np.array([[0.05, 0.05, 0.12], [0.45, 0.10, 0.35], [0.90, 0.40, 0.15], [1.0, 0.92, 0.65]])
    at = share * (len(stops) - 1)
    lower = np.minimum(at.astype(np.int64), len(stops) - 2)[:, :, 0]
    mix = stops[lower] * (1.0 - (at - lower[:, :, None])) + stops[lower + 1] * (at - lower[:, :, None])
    return (255.0 * mix).astype(np.uint8)


def _figure(picture: np.ndarray, text: str, pixelated: bool = False) -> str:
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(picture).save(buffer, "PNG", optimize=True)
    data = base64.b64encode(buffer.getvalue()).decode("ascii")
    style = ' style="image-rendering:pixelated"' if pixelated else ""
    width = max(picture.shape[1], PIXELS)
    return (
        f'<figure><img{style} width="{width}" alt="{html.escape(text)}" src="data:image/png;base64,{data}">'
        f"<figcaption>{html.escape(text)}</figcaption></figure>"
    )


def _scores(scores: Mapping[str, Any]) -> str:
    if not scores:
        return ""
    rows = []
    for voxel in scores.get("after", {}):
        before, after = scores["before"][voxel], scores["after"][voxel]
        cells = "".join(f'<td class="n">{before[key]:.3f}</td><td class="n">{after[key]:.3f}</td>' for key in after)
        rows.append(f"<tr><td>{html.escape(voxel)} mm</td>{cells}</tr>")
    names = {"iou": "IoU", "precision": "precision", "recall": "recall"}
    any_voxel = next(iter(scores["after"].values()))
    heads = "".join(f'<th class="n" colspan="2">{names.get(key, key)}</th>' for key in any_voxel)
    below = "".join('<th class="n">before</th><th class="n">after</th>' for _ in any_voxel)
    return (
        "<h2>Against the scan itself, before and after refinement</h2>"
        f"<table><tr><th>voxel</th>{heads}</tr><tr><th></th>{below}</tr>{''.join(rows)}</table>"
        '<p class="dim">Noise in the scan counts against the strands: read these as lower bounds.</p>'
    )


def _found(summary: Mapping[str, Any]) -> str:
    """The automatic choices, and what overrules each."""
    levels, head = summary.get("thresholds", {}), summary["head"]
    chosen = levels.get("chosen", ())
    rows = []
    for name, what, setting in (
        ("air", "value of air", "scan.air"),
        ("noise", "standard deviation of the noise", ""),
        ("strand", "peak of a lone strand above air", ""),
        ("hair", "hair from this value on", "scan.hair"),
        ("knots", "knots of the net from this value on", "scan.knots"),
        ("solid", "the mannequin from this value on", "scan.solid"),
    ):
        if name in levels:
            value = "none found" if levels[name] is None else f"{levels[name]:.5g}"
            how = "given" if name in chosen else "found"
            rows.append((what, value, how, setting))
    sure = f"{head['certainty']:.0%} sure"
    rows.append(("the face looks along", head["face_axis"], sure, "head.face"))
    rows.append(("the crown points along", head["up_axis"], sure, "head.up"))
    rows.append(("knots to the fitted scalp, median", f"{head['residual_mm']:.2f} mm", "", "head.mesh"))
    body = "".join(
        f'<tr><td>{html.escape(what)}</td><td class="n">{html.escape(value)}</td><td>{how}</td>'
        f"<td>{f'<code>{setting}</code>' if setting else ''}</td></tr>"
        for what, value, how, setting in rows
    )
    return (
        '<h2>Found by itself</h2><table><tr><th>what</th><th class="n">value</th><th>how</th><th>overruled by</th></tr>'
        f"{body}</table>"
    )


def _stages(stages: Iterable[Mapping[str, Any]]) -> str:
    rows = []
    for stage in stages:
        tally = "".join(f"<li>{html.escape(name)}: {_number(count)}</li>" for name, count in stage.get("tally", {}).items())
        resumed = " (from its checkpoint)" if stage.get("resumed") else ""
        rows.append(
            f'<tr><td>{html.escape(stage["name"])}{resumed}</td><td class="n">{stage["seconds"]:.1f} s</td>'
            f'<td class="n">{stage["peak_memory"]:.2f} GB</td><td><ul class="tally">{tally}</ul></td></tr>'
        )
    return (
        '<h2>Stages</h2><table><tr><th>stage</th><th class="n">time</th><th class="n">peak memory</th><th>kept and dropped</th>'
        f"</tr>{''.join(rows)}</table>"
    )


def _number(value: Any) -> str:
    return f"{value:,}" if isinstance(value, int) else f"{value:,.3g}" if isinstance(value, float) else html.escape(str(value))


def _distributions(hair: Strands, guides: Strands, head: Head) -> str:
    charts = [
        _histogram("length, mm", hair.lengths(), guides.lengths()),
        _histogram("curvature, 1/cm", 10.0 * curvature(hair), 10.0 * curvature(guides), top=0.98),
    ]
    area = head.scalp_area / 100.0
    text = f"{len(hair) / max(area, 1e-9):.0f} strands a cm² of scalp ({area:.0f} cm²)."
    return f'<h2>Strands</h2><p>{text}</p><div class="pictures">{"".join(charts)}</div>'


def curvature(strands: Strands, step: float = 2.0) -> np.ndarray:
    """(K,) 1/mm: curvature at points `step` mm apart, by the circle through neighbouring points; strand ends left out."""
    if not len(strands):
        return np.zeros(0)
    even = strands.resampled_by_step(step)
    points, index = even.points.astype(np.float64), even.strand_index
    if len(points) < 3:
        return np.zeros(0)
    a, b, c = points[:-2], points[1:-1], points[2:]
    inside = (index[:-2] == index[1:-1]) & (index[1:-1] == index[2:])
    ab, bc, ca = (np.linalg.norm(v, axis=1) for v in (b - a, c - b, a - c))
    twice_area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    return (2.0 * twice_area / np.maximum(ab * bc * ca, 1e-12))[inside]


def _histogram(name: str, hair: np.ndarray, guides: np.ndarray, top: float = 1.0) -> str:
    """An SVG of two densities: bars for the hair, a line for the guides."""
    if not len(hair):
        return ""
    high = float(np.quantile(hair, top)) or 1.0
    edges = np.linspace(0.0, high * 1.0001, BARS + 1)
    bars = np.histogram(hair, edges)[0] / len(hair)
    line = np.histogram(guides, edges)[0] / max(len(guides), 1)
    tallest = max(bars.max(), line.max(), 1e-9)
    width, height, base = 460, 200, 170
    each = (width - 40) / BARS
    shapes = "".join(
        f'<rect x="{20 + n * each + 1:.1f}" y="{base - 140 * v / tallest:.1f}" width="{each - 2:.1f}" '
        f'height="{140 * v / tallest:.1f}" fill="var(--accent)"/>'
        for n, v in enumerate(bars)
    )
    course = " ".join(f"{20 + (n + 0.5) * each:.1f},{base - 140 * v / tallest:.1f}" for n, v in enumerate(line))
    ticks = "".join(
        f'<text x="{20 + s * (width - 40):.0f}" y="{base + 18}" text-anchor="middle" font-size="12" fill="var(--dim)">'
        f"{s * high:.3g}</text>"
        for s in (0.0, 0.25, 0.5, 0.75, 1.0)
    )
    return (
        f'<figure><svg viewBox="0 0 {width} {height}" role="img" aria-label="{html.escape(name)}">{shapes}'
        f'<polyline points="{course}" fill="none" stroke="var(--second)" stroke-width="2"/>{ticks}</svg>'
        f"<figcaption>{html.escape(name)}: bars all strands, line the guides</figcaption></figure>"
    )


def _settings(summary: Mapping[str, Any]) -> str:
    text = html.escape(json.dumps(_plain(summary.get("settings", {})), indent=2))
    return f"<h2>Settings</h2><details><summary>All settings of this run</summary><pre>{text}</pre></details>"
