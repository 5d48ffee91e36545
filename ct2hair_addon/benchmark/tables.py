"""Tables of results in Markdown: a header, rows of numbers, and what to know of them."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

PRINTED = {
    "short": ((0.538, 0.713, 0.686, 3.5944), (0.609, 0.833, 0.694, 3.4747)),
    "ponytail": ((0.599, 0.722, 0.779, 3.8924), (0.666, 0.799, 0.800, 3.8033)),
    "complex": ((0.463, 0.588, 0.686, 6.7203), (0.533, 0.676, 0.715, 6.6963)),
    "curly": ((0.392, 0.502, 0.641, 1.9718), (0.458, 0.596, 0.664, 1.9181)),
}
"""The paper's Table 1: (IoU, precision, recall, MSE in 10^-2) without and with its optimisation."""

PER_VOXEL = {"guides": ("guides",), "dense and refinement": ("dense", "refinement")}
"""Stages whose time is told for 10^7 hair voxels as well: title -> their names."""


@dataclass
class Table:
    """A title, column names, rows of values (numbers, text or None), and a note under it."""

    title: str
    columns: Sequence[str]
    rows: list[Sequence[Any]] = field(default_factory=list)
    note: str = ""

    def markdown(self) -> str:
        lines = [f"### {self.title}", ""]
        lines += ["| " + " | ".join(self.columns) + " |", "|" + "|".join(["---"] + ["---:"] * (len(self.columns) - 1)) + "|"]
        lines += ["| " + " | ".join(shown(value) for value in row) + " |" for row in self.rows]
        return "\n".join([*lines, *(["", self.note] if self.note else []), ""])


def shown(value: Any) -> str:
    """A value as a table shows it: three or so digits that mean something; a dash for none."""
    if value is None or (isinstance(value, float) and not math.isfinite(value)):
        return "–"
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return str(value)
    if isinstance(value, int):
        return f"{value:,}"
    size = abs(value)
    return f"{value:,.0f}" if size >= 1000 else f"{value:.1f}" if size >= 10 else f"{value:.3f}" if size < 1 else f"{value:.2f}"


def voxel_row(scores: dict[str, Any], size: str = "fine") -> list[float]:
    """IoU, precision, recall and MSE (10^-2) of a scored set."""
    table = scores["voxel"][size]
    return [table["iou"], table["precision"], table["recall"], 100.0 * table["mse"]]


def table1(results: dict[tuple[str, str], dict[str, Any]], names: dict[str, str]) -> Table:
    """The paper's Table 1: its printed rows beside each method's dense and refined strands.

    results: (row of the table, method) -> result. names: row -> the hairstyle that stands for it.
    """
    table = Table(
        "Table 1: voxels of 1.25 times the scan's",
        ("style", "strands", "IoU", "precision", "recall", "MSE (10^-2)", "2.5 voxels: IoU", "precision", "recall"),
        note="Printed: the paper's own table, on its own hair and its own voxel size, which it does not state; read the rows "
        "of one hairstyle against each other.",
    )
    for row, style in names.items():
        title = f"{row} ({style})"
        if row in PRINTED:
            without, with_ = PRINTED[row]
            table.rows.append((title, "printed, without optimisation", *without, None, None, None))
            table.rows.append((title, "printed, with", *with_, None, None, None))
        for (known, method), result in results.items():
            if known == row:
                for stage, scores in result["scores"].items():
                    coarse = voxel_row(scores, "coarse")[:3]
                    table.rows.append((title, f"{method}: {stage}", *voxel_row(scores), *coarse))
    return table


def strand_table(results: dict[tuple[str, str], dict[str, Any]]) -> Table:
    """F scores, consistency, roots and points inside of each method's strands."""
    table = Table(
        "Strands (F at mm / degrees)",
        ("style", "strands", "count", "0.5/10", "1/10", "2/20", "4/40", "consistency", "bends", "on scalp", "inside"),
        note="Bends: the curvature's root mean square over the truth's, in waves of 10 to 25, 25 to 60 and 60 to 150 mm.",
    )
    for (row, method), result in results.items():
        for stage, scores in result["scores"].items():
            f = [scores["strand"][name]["f"] for name in ("0.5/10", "1/10", "2/20", "4/40")]
            count = scores["counts"]["result_strands"]
            bends = " / ".join(f"{rms['result'] / max(rms['truth'], 1e-9):.2f}" for rms in scores["curvature"].values())
            ends = (scores["consistency"], bends, scores["roots_on_scalp"], scores["inside_head"])
            table.rows.append((row, f"{method}: {stage}", count, *f, *ends))
    return table


def stage_table(results: dict[tuple[str, str], dict[str, Any]]) -> Table:
    """What each stage is held to by itself: registration, orientation, guides."""
    table = Table(
        "Stages by themselves",
        (
            "style", "method", "scalp off (median mm)", "orientation off (median / 90 %, degrees)", "once traced",
            "centre line off (voxels)", "covered", "direction right", "length on scalp", "guides",
        ),
        note="Orientation at hair voxels, by gradients, and with the guides' directions in it; centre line of guides, median; "
        "covered: hair voxels with a guide within 2.5 voxels; direction root to tip and length on strands that reach the "
        "scalp, of the guides' length.",
    )  # fmt: skip
    for (row, method), result in results.items():
        guides, off = result["scores"]["guides"], result["orientation"]
        table.rows.append(
            (
                row, method, result["registration_mm"]["median"], f"{off['median']:.1f} / {off['p90']:.1f}",
                f"{off['traced']['median']:.1f} / {off['traced']['p90']:.1f}",
                guides["centre_line_mm"]["median"] / result["case"]["spacing"], guides["coverage"],
                guides["direction"]["right"], guides["rooted_length"], guides["counts"]["result_strands"],
            )
        )  # fmt: skip
    return table


def head_table(results: Iterable[dict[str, Any]]) -> Table:
    """What is found of scans before any strand is: thresholds, axes, scalp."""
    table = Table(
        "Thresholds, scalp and head",
        (
            "style", "mannequin", "SNR", "face, up", "found", "certainty", "scalp off (median / 90 %, mm)",
            "air off (of the noise)", "lone strand over the true one", "hair kept", "knots seen",
        ),
        note="Hair kept: of the true strands' length, what neither went with the mannequin and the net nor passed for air. "
        "Knots seen, of the strands: two that lie closer than the scan shows are one.",
    )  # fmt: skip
    for result in results:
        case = result["case"]
        row = (case["style"], "yes" if case["mannequin"] else "no", case["snr"], " ".join(case["axes"]))
        if "refused" in result:
            table.rows.append((*row, "refused", *[None] * 6))
            continue
        head, off, found, true = result["head"], result["registration_mm"], result["thresholds"], result["scan"]
        table.rows.append(
            (
                *row, f"{head['face_axis']} {head['up_axis']}", head["certainty"], f"{off['median']:.2f} / {off['p90']:.2f}",
                (found["air"] - true["value_of_air"]) / max(found["noise"], 1e-9),
                found["strand"] / true["lone_strand_above_air"], result["hair_kept"],
                result["tallies"]["scan"]["knot points"] / case["strands"],
            )
        )  # fmt: skip
    return table


def cost_table(results: dict[tuple[str, str], dict[str, Any]]) -> Table:
    """Seconds and peak memory of each stage, and of all."""
    names = [stage["name"] for stage in next(iter(results.values()))["stages"]] if results else []
    table = Table(
        "Seconds (peak GB) of each stage",
        ("style", "method", "hair voxels", *names, "all", *(f"{title}, for 10^7" for title in PER_VOXEL)),
        note="A dash: taken from a run before, whose stage is the same. For 10^7: seconds for as many hair voxels.",
    )
    for (row, method), result in results.items():
        run = {stage["name"]: stage for stage in result["stages"] if not stage["resumed"]}
        cells = [f"{run[name]['seconds']:.1f} ({run[name]['peak_memory']:.1f})" if name in run else None for name in names]
        total = sum(stage["seconds"] for stage in result["stages"])
        peak = max(stage["peak_memory"] for stage in result["stages"])
        rates = []
        for group in PER_VOXEL.values():
            seconds = sum(run[name]["seconds"] for name in group) if run.keys() >= set(group) else None
            rates.append(None if seconds is None else 1e7 * seconds / max(result["hair_voxels"], 1))
        table.rows.append((row, method, result["hair_voxels"], *cells, f"{total:.0f} ({peak:.1f})", *rates))
    return table
