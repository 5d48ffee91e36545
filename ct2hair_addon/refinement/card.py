"""The fit's work on voxels on a graphics card, by torch: strands rendered, the misfit blurred, forces read from it.

The same sums as `splat.py` and `forces.py`, in float32 and in no fixed order: results agree to rounding, not to the
bit. Bricks lie on the card with a ring of empty ones around them, so that what is blurred across an edge is not lost, and a
Gaussian along an axis is a product with a banded matrix.
"""

from __future__ import annotations

import numpy as np
import torch
from scipy import ndimage

from ..progress import Progress, part, silent
from ..volume import BRICK, BrickVolume
from .blur import REACH, gaussian_taps
from .curves import SAMPLES_PER_VOXEL
from .forces import shares_seen
from .splat import splat_taps

SAMPLES = 1 << 22
"""Samples along strands that are worked on at a time: some 600 MB."""
ROWS = 2048
"""Bricks that are blurred at a time: some 150 MB."""
WORKSPACE = 2e9
"""Bytes that the two take at most, beside the bricks themselves."""
CUDA = torch.device("cuda")
PADDING = 2
"""Bricks around the table: one for the ring, one that stays empty, where everything farther out is looked up."""


def bytes_needed(volume: BrickVolume) -> float:
    """What a fit to `volume` takes on the card: the scan's bricks, two of float32 with a ring around them, and room to work."""
    stored = int(np.count_nonzero(_ringed(_padded(volume.table))))
    return WORKSPACE + BRICK**3 * (len(volume.bricks) * volume.bricks.itemsize + 8.0 * (stored + 1))


class CardPotential:
    """What a scan asks of strands, worked out on a torch device; see `fit.Potential`, whose place it takes."""

    def __init__(self, scan: BrickVolume, blur: float, gain: float, device: torch.device) -> None:
        self.device, self.gain, self.peak = device, gain, gain / (2.0 * np.pi * blur**2)
        table = _padded(scan.table)
        ring = _ringed(table) & (table < 0)
        self.own, self.empty = len(scan.bricks), len(scan.bricks) + int(np.count_nonzero(ring))
        table[ring] = np.arange(self.own, self.empty, dtype=np.int32)
        table[table < 0] = self.empty
        index = np.empty((self.empty, 3), np.int64)
        where = np.argwhere(table < self.empty)
        index[table[tuple(where.T)]] = where
        self.neighbours = [
            [self._tensor(table[tuple((index + np.eye(3, dtype=np.int64)[axis] * side).T)], torch.int64) for side in (-1, 1)]
            for axis in range(3)
        ]
        self.table = self._tensor(table, torch.int64)
        self.target = torch.as_tensor(scan.bricks).to(device)
        self.splat_band, self.blur_band = (_band(taps).to(device) for taps in (splat_taps(blur), gaussian_taps(blur)))
        self.values, self.spare = (
            torch.zeros((self.empty + 1, BRICK, BRICK, BRICK), dtype=torch.float32, device=device) for _ in range(2)
        )

    def forces(
        self,
        voxels: np.ndarray,
        offsets: np.ndarray,
        visible: np.ndarray,
        forces: np.ndarray,
        weights: np.ndarray,
        progress: Progress = silent,
    ) -> float:
        """Write what is asked of each control point, and return half the weighted square sum of the misfit, as there."""
        error = self._update(voxels, offsets, visible, part(progress, 0.0, 0.5))
        self._gather(voxels, offsets, visible, forces, weights, part(progress, 0.5, 1.0))
        return error

    def _update(self, voxels, offsets, visible, progress: Progress) -> float:
        """Take the potential of strands; half the weighted square sum of the misfit."""
        self.values.zero_()
        flat = self.values.view(-1)
        for done, samples in self._samples(voxels, offsets, visible):
            progress(0.5 * done, 1.0)
            length = samples.length * samples.seen
            for row, inside, weight in self._corners(samples.middle):
                flat.index_add_(0, row * BRICK**3 + inside, length * weight)
        self.values[self.empty].zero_()
        self._blur(self.splat_band)
        progress(0.6, 1.0)
        error = 0.0
        for low in range(0, self.own, ROWS):
            model = self.values[low : min(low + ROWS, self.own)].mul_(self.gain)
            weight = 1.0 / (1.0 + model / self.peak)
            scan = self.target[low : low + len(model)]
            difference = torch.where(scan != 0, model - scan.float(), 0.0)
            error = error + 0.5 * (weight * difference.square()).double().sum()
            torch.mul(weight, difference, out=model)
        self.values[self.own :].zero_()
        self._blur(self.blur_band)
        self.values[self.own :].zero_()  # the scan says nothing there
        progress(1.0, 1.0)
        return float(error)

    def _gather(self, voxels, offsets, visible, forces, weights, progress: Progress) -> None:
        """Read forces and weights from the potential."""
        count = len(voxels)
        pull = torch.zeros((count, 3), dtype=torch.float32, device=self.device)
        shown = torch.zeros(count, dtype=torch.float32, device=self.device)
        for done, samples in self._samples(voxels, offsets, visible):
            progress(done, 1.0)
            slope = self._gradient(samples.middle)
            tangent = samples.tangent / samples.length.clamp_min(1e-12)[:, None]
            slope -= (slope * tangent).sum(1, keepdim=True) * tangent
            for point, weight in ((samples.first, 1.0 - samples.share), (samples.first + 1, samples.share)):
                weight = weight * samples.length * samples.seen
                shown.index_add_(0, point, weight)
                pull.index_add_(0, point, weight[:, None] * slope, alpha=-1.0)
        shares_seen(voxels, offsets, visible, weights)
        forces[:] = (pull / shown.clamp_min(1e-9)[:, None]).cpu().numpy()

    def _tensor(self, array: np.ndarray, dtype: torch.dtype) -> torch.Tensor:
        return torch.as_tensor(np.ascontiguousarray(array)).to(self.device, dtype)

    def _samples(self, voxels: np.ndarray, offsets: np.ndarray, visible: np.ndarray):
        """Samples of all segments that show, some at a time, each time with the share of them that is done."""
        points = self._tensor(voxels, torch.float32) + float(BRICK * PADDING)
        seen = self._tensor(visible, torch.float32)
        ends = self._tensor(offsets[1:] - 1, torch.int64)
        last = torch.zeros(len(points), dtype=torch.bool, device=self.device)
        last[ends[ends >= 0]] = True
        first = torch.roll(last, 1)
        first[0] = True
        start = torch.nonzero(~last)[:, 0]
        p, q = points[start], points[start + 1]
        before = torch.where(first[start, None], 2.0 * p - q, points[start - 1])
        after = torch.where(last[start + 1, None], 2.0 * q - p, points[(start + 2).clamp_max(len(points) - 1)])
        counts = torch.ceil(SAMPLES_PER_VOXEL * (q - p).norm(dim=1)).clamp_min(1.0).long()
        ended = torch.cumsum(counts, 0)
        total = int(ended[-1]) if len(ended) else 0
        marks = torch.arange(SAMPLES, total + SAMPLES, SAMPLES, device=self.device)
        low = 0
        for high in (torch.searchsorted(ended, marks, right=True)).tolist():
            high = min(max(high, low + 1), len(start))
            if low >= high:
                continue
            some = slice(low, high)
            yield high / len(start), _Samples(start[some], counts[some], (before[some], p[some], q[some], after[some]), seen)
            low = high

    def _corners(self, places: torch.Tensor):
        """The eight voxels around `places` (S, 3): brick's row, place inside it and trilinear weight, (S,) each."""
        base = torch.floor(places)
        share = places - base
        base = base.long()
        size = self.table.shape
        brick, inside, weight = [], [], []
        for axis in range(3):
            sides = [base[:, axis] + side for side in (0, 1)]
            brick.append([(at >> 4).clamp(0, size[axis] - 1) for at in sides])
            inside.append([at & (BRICK - 1) for at in sides])
            weight.append([1.0 - share[:, axis], share[:, axis]])
        for a in range(2):
            for b in range(2):
                for c in range(2):
                    row = self.table[brick[0][a], brick[1][b], brick[2][c]]
                    place = (inside[0][a] * BRICK + inside[1][b]) * BRICK + inside[2][c]
                    yield row, place, weight[0][a] * weight[1][b] * weight[2][c]

    def _gradient(self, places: torch.Tensor) -> torch.Tensor:
        """(S, 3): the gradient of the potential's trilinear interpolant, per voxel."""
        flat = self.values.view(-1)
        v = [flat[row * BRICK**3 + inside] for row, inside, _ in self._corners(places)]
        v = torch.stack(v, 1).view(-1, 2, 2, 2)
        fx, fy, fz = (places - torch.floor(places)).unbind(1)
        gx, gy, gz = v[:, 1] - v[:, 0], v[:, :, 1] - v[:, :, 0], v[:, :, :, 1] - v[:, :, :, 0]
        return torch.stack([_bilinear(gx, fy, fz), _bilinear(gy, fx, fz), _bilinear(gz, fx, fy)], 1)

    def _blur(self, band: torch.Tensor) -> None:
        """`values` under a Gaussian along each axis in turn, `band` (16, 22) being its matrix."""
        for axis in range(3):
            before, after = self.neighbours[axis]
            low, high = (self.values.narrow(axis + 1, at, REACH) for at in (BRICK - REACH, 0))
            for at in range(0, self.empty, ROWS):
                rows = slice(at, min(at + ROWS, self.empty))
                wide = torch.cat([low[before[rows]], self.values[rows], high[after[rows]]], axis + 1)
                shape = self.spare[rows].shape
                if axis == 0:
                    self.spare[rows] = (band @ wide.reshape(len(wide), BRICK + 2 * REACH, -1)).view(shape)
                elif axis == 1:
                    self.spare[rows] = band @ wide
                else:
                    self.spare[rows] = wide @ band.T
            self.values, self.spare = self.spare, self.values
            self.values[self.empty].zero_()


class _Samples:
    """Samples along segments: `first` (S,) the segment's first control point, `share` (S,) of the way to its second, `middle`
    (S, 3) voxels of the padded table, `tangent` (S, 3) and `length` (S,) of the piece, `seen` (S,) how much of it shows."""

    def __init__(self, start, counts, control, seen) -> None:
        segment = torch.repeat_interleave(torch.arange(len(start), device=start.device), counts)
        number = torch.arange(len(segment), device=start.device) - (torch.cumsum(counts, 0) - counts)[segment]
        step = 1.0 / counts[segment].float()
        corners = [corner[segment] for corner in control]
        here, there = (_cubic(corners, (number + ahead) * step) for ahead in (0, 1))
        self.first, self.share = start[segment], (number + 0.5) * step
        self.middle, self.tangent = 0.5 * (here + there), there - here
        self.length = self.tangent.norm(dim=1)
        self.seen = (1.0 - self.share) * seen[self.first] + self.share * seen[self.first + 1]


def _cubic(corners, t: torch.Tensor) -> torch.Tensor:
    """Points of Catmull-Rom segments from their four corners (S, 3) at t (S,)."""
    a, b, c, d = corners
    t = t[:, None]
    return b + 0.5 * t * (c - a + t * (2.0 * a - 5.0 * b + 4.0 * c - d + t * (3.0 * (b - c) + d - a)))


def _bilinear(values: torch.Tensor, u: torch.Tensor, v: torch.Tensor) -> torch.Tensor:
    """(S,): values (S, 2, 2) at u, v (S,) in [0, 1]."""
    low = values[:, 0, 0] + v * (values[:, 0, 1] - values[:, 0, 0])
    high = values[:, 1, 0] + v * (values[:, 1, 1] - values[:, 1, 0])
    return low + u * (high - low)


def _band(taps: np.ndarray) -> torch.Tensor:
    """(16, 22): the matrix that convolves 22 voxels with seven taps into the 16 in the middle."""
    band = np.zeros((BRICK, BRICK + 2 * REACH), np.float32)
    for row in range(BRICK):
        band[row, row : row + len(taps)] = taps
    return torch.as_tensor(band)


def _padded(table: np.ndarray) -> np.ndarray:
    """The table with PADDING bricks around it that hold nothing."""
    return np.pad(table, PADDING, constant_values=-1)


def _ringed(table: np.ndarray) -> np.ndarray:
    """Which bricks of a padded table are stored on the card: those of the scan and a ring of one around them."""
    return ndimage.binary_dilation(table >= 0, np.ones((3, 3, 3)))
