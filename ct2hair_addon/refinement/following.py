"""Strands drawn along the orientation field before they are fitted.

A trace in dense hair hops from strand to strand: it lies in hair all along, but runs askew from one to the next. The field,
gathered over more hair than one strand, still shows which way all of it runs there; so tangents follow the field, as eq. 5
has them follow what they were, while places stay near the trace.
"""

from __future__ import annotations

from collections.abc import Callable

import numba
import numpy as np

from ..progress import Progress, silent
from ..strands import Strands, offsets_from_counts

Field = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
"""Points (M, 3), mm, scan frame -> unit directions (M, 3), sign without meaning, and confidences (M,), 0 to 1."""
ROUNDS = 2
"""Times that directions are looked up: where strands lie now."""
AGREES = 0.7
"""Cosine to the field below which it shows other hair than the strand."""
OWN = 0.1
"""Weight of a strand's own direction there, by that of the field's."""
HELD = 1e6
CHUNK = 2000
"""Strands at a time: memory."""


def along_field(strands: Strands, lengths: np.ndarray, field: Field, voxel: float, progress: Progress = silent) -> Strands:
    """The strands, points a voxel apart, where |x - p|^2 + length^2 |x' - field|^2 is least along each; roots stay.

    strands: mm, scan frame. lengths (N,) mm, waves shorter than which give way to the field; 0 leaves a strand as it is.
    """
    parts, counts = [], []
    for start in range(0, len(strands), CHUNK):
        progress(start, len(strands))
        rows = np.arange(start, min(start + CHUNK, len(strands)))
        even = strands.select(rows).resampled_by_step(voxel)
        counts.append(even.counts)
        parts.append(_followed(even, lengths[rows] / voxel, field) if (lengths[rows] > 0.0).any() else even.points)
    progress(1.0, 1.0)
    points = np.concatenate(parts) if parts else strands.points
    offsets = offsets_from_counts(np.concatenate(counts)) if counts else strands.offsets
    return Strands(np.asarray(points, np.float32), offsets, strands.strand_attributes)


def _followed(even: Strands, reach: np.ndarray, field: Field) -> np.ndarray:
    """(M, 3) float64: the points of `even` along the field; reach (N,) in points."""
    rest = even.points.astype(np.float64)
    now = rest.copy()
    middles = np.empty_like(rest)
    for _ in range(ROUNDS):
        middles[:-1] = 0.5 * (now[:-1] + now[1:])  # those from one strand to the next are not used
        middles[-1] = now[-1]
        directions, confidence = field(middles.astype(np.float32))
        _solve(rest, now, even.offsets, reach, directions, confidence)
    return now


@numba.njit(cache=True, parallel=True)
def _solve(rest, now, offsets, reach, directions, confidence):
    """`now` (M, 3) after one round: per strand a tridiagonal system in each axis, (1 + L) x = p + what directions ask for."""
    for n in numba.prange(len(offsets) - 1):
        start, size = offsets[n], offsets[n + 1] - offsets[n]
        if size < 3 or reach[n] <= 0.0:
            continue
        most = reach[n] * reach[n]
        diagonal, beside, right = np.ones(size), np.zeros(size), np.empty((size, 3))
        diagonal[0] = HELD
        for i in range(size):
            for axis in range(3):
                right[i, axis] = diagonal[i] * rest[start + i, axis]
        for i in range(size - 1):
            m = start + i
            ux, uy, uz = now[m + 1, 0] - now[m, 0], now[m + 1, 1] - now[m, 1], now[m + 1, 2] - now[m, 2]
            norm = max(np.sqrt(ux * ux + uy * uy + uz * uz), 1e-12)
            length = np.sqrt(
                (rest[m + 1, 0] - rest[m, 0]) ** 2 + (rest[m + 1, 1] - rest[m, 1]) ** 2 + (rest[m + 1, 2] - rest[m, 2]) ** 2
            )
            cosine = (ux * directions[m, 0] + uy * directions[m, 1] + uz * directions[m, 2]) / norm
            if abs(cosine) > AGREES and confidence[m] > 0.0:
                w = most * confidence[m]
                turned = length if cosine > 0.0 else -length
                ux, uy, uz = turned * directions[m, 0], turned * directions[m, 1], turned * directions[m, 2]
            else:
                w = OWN * most
                ux, uy, uz = ux * length / norm, uy * length / norm, uz * length / norm
            diagonal[i] += w
            diagonal[i + 1] += w
            beside[i] = -w
            right[i, 0] -= w * ux
            right[i, 1] -= w * uy
            right[i, 2] -= w * uz
            right[i + 1, 0] += w * ux
            right[i + 1, 1] += w * uy
            right[i + 1, 2] += w * uz
        for i in range(1, size):
            f = beside[i - 1] / diagonal[i - 1]
            diagonal[i] -= f * beside[i - 1]
            for axis in range(3):
                right[i, axis] -= f * right[i - 1, axis]
        for i in range(size - 1, -1, -1):
            for axis in range(3):
                value = right[i, axis]
                if i + 1 < size:
                    value -= beside[i] * right[i + 1, axis]
                right[i, axis] = value / diagonal[i]
        for i in range(1, size):
            for axis in range(3):
                now[start + i, axis] = right[i, axis]
