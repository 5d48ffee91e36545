"""Pictures that a panel shows: the scan's histogram with its thresholds, slices of the scan; drawn as arrays of pixels.

Pixels are (height, width, 4) float32 RGBA, the lowest row first, as Blender has them.
"""

from __future__ import annotations

import numpy as np

from ..settings import ScanSettings
from ..volume import Inspection

THRESHOLD_COLOURS = {
    "air": (0.45, 0.65, 1.0),
    "hair": (1.0, 0.75, 0.25),
    "knots": (0.95, 0.4, 0.75),
    "solid": (0.55, 0.9, 0.5),
}
"""Colours of the thresholds in the histogram."""
_GROUND, _BAR = np.array([0.11, 0.11, 0.12, 1.0], np.float32), np.array([0.62, 0.62, 0.65, 1.0], np.float32)


def threshold_values(inspection: Inspection, settings: ScanSettings) -> dict[str, float]:
    """The thresholds in force by name: those that the settings give, else those that were found."""
    found = inspection.thresholds
    values = {}
    for name in THRESHOLD_COLOURS:
        value = getattr(settings, name) or (getattr(found, name) if found is not None else None)
        if value is not None:
            values[name] = float(value)
    return values


def histogram_picture(inspection: Inspection, settings: ScanSettings, width: int = 512, height: int = 512) -> np.ndarray:
    """The histogram, its counts on a logarithmic scale, with a line for each threshold: dashed where it was found, whole
    where the settings give it."""
    picture = np.tile(_GROUND, (height, width, 1))
    values = threshold_values(inspection, settings)
    low, high = value_range(inspection, values)
    column = low + (np.arange(width) + 0.5) / width * (high - low)
    index = np.searchsorted(inspection.edges, column, side="right") - 1
    inside = (index >= 0) & (index < len(inspection.counts))
    counts = np.where(inside, inspection.counts[np.clip(index, 0, len(inspection.counts) - 1)], 0)
    tall = np.log1p(counts) / max(float(np.log1p(inspection.counts.max())), 1e-9) * (height - 1)
    picture[np.arange(height)[:, None] < tall[None, :]] = _BAR
    for name, value in values.items():
        at = int((value - low) / (high - low) * (width - 1))
        if 0 <= at < width:
            rows = np.arange(height)
            if not getattr(settings, name):
                rows = rows[rows % 16 < 10]
            picture[rows[:, None], np.clip(np.arange(at - 1, at + 2), 0, width - 1)[None, :]] = (*THRESHOLD_COLOURS[name], 1.0)
    return picture


def value_range(inspection: Inspection, values: dict[str, float]) -> tuple[float, float]:
    """The scan values that the histogram runs over: its own bins, and all thresholds."""
    low, high = float(inspection.edges[0]), float(inspection.edges[-1])
    low, high = min([low, *values.values()]), max([high, *values.values()])
    margin = 0.02 * (high - low)
    return low - margin, high + margin


def slice_picture(inspection: Inspection, axis: int, fraction: float, settings: ScanSettings, size: int = 320) -> np.ndarray:
    """A slice across `axis` (0, 1, 2) at a share of the way, grey from air to knots, hair tinted; true proportions."""
    values = inspection.slice(axis, fraction)
    levels = threshold_values(inspection, settings)
    low = levels.get("air", float(inspection.edges[0]))
    high = max(levels.get("knots", float(inspection.edges[-1])), low + 1e-6)
    grey = np.clip((values - low) / (high - low), 0.0, 1.0) ** 0.7
    colour = np.repeat(grey[..., None], 3, axis=-1)
    if "hair" in levels:
        upper = levels.get("solid", np.inf)
        hair = (values > levels["hair"]) & (values < upper)
        colour[hair] = colour[hair] * 0.4 + 0.6 * np.array(THRESHOLD_COLOURS["hair"]) * (0.4 + 0.6 * grey[hair][:, None])
    steps = np.array(inspection.spacing) * np.array(inspection.shape) / np.array(inspection.look.shape)
    across, up = np.delete(steps, axis) * values.shape
    scale = size / max(across, up)
    width, height = max(int(across * scale), 1), max(int(up * scale), 1)
    columns = np.minimum(np.arange(width) * values.shape[0] // width, values.shape[0] - 1)
    rows = np.minimum(np.arange(height) * values.shape[1] // height, values.shape[1] - 1)
    picture = np.tile(_GROUND, (size, size, 1))
    left, bottom = (size - width) // 2, (size - height) // 2
    picture[bottom : bottom + height, left : left + width, :3] = colour[columns[None, :], rows[:, None]]
    return picture
