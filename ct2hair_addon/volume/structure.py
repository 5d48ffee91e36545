"""Local structure of a scan, block by block: smoothed density, local mean, and peaks told apart as line, sheet or blob.

Hair is a line: along it density goes on, across it density falls. A knot is a blob: it falls on all sides. The skin of a
body is a sheet. Smoothing by one voxel lets a lone strand stand out of noise by nearly three times as much.
"""

from __future__ import annotations

import numba
import numpy as np

SMOOTHING = 1.0
"""Gaussian, voxels, under which structure is looked at."""
STRAND_BLUR = 0.85
"""Gaussian blur of a strand in a scan, voxels (0.8 to 0.9 in the paper's scans)."""
LINE_SHARE = STRAND_BLUR**2 / (STRAND_BLUR**2 + SMOOTHING**2)
"""What smoothing leaves of a lone straight strand's peak."""
NOISE_SHARE = float((2.0 * np.sqrt(np.pi) * SMOOTHING) ** -1.5)
"""What smoothing leaves of white noise's standard deviation."""
MEAN_REACH = 4
"""The local mean is taken over a cube of 9 voxels: wider than a strand, narrower than a mannequin's wall."""
PEAK_REACH = 4
"""A peak is held against the density this many voxels to either side of it, three blurs away from a strand."""
PERSISTS = 0.6
"""A peak goes on in a direction where both sides keep this share of it."""
BLOB_VARIANCE = STRAND_BLUR**2 + SMOOTHING**2
"""voxel^2; a knot's width after smoothing, squared: its second derivatives are its height over this."""
HALO = 9
"""Voxels around a block that its structure depends on."""
RIPPLE_REACH = 2
"""Ripple is taken over a cube of 5 voxels."""
FLAT = 0.025
"""A body's material ripples less than this. A noisy mannequin has 0.006 at 0.4 mm; a tail of hair so dense that it reaches the
mannequin's values has 0.06, and over 0.024 in 99 places of 100."""
FLAT_SPACING, BLURRED_SPACING = 0.8, 1.4
"""mm. In coarser scans a mannequin's wall is so few voxels thick that half of it ripples by 0.03 (at 1.2 mm), and from the
second on ripple tells nothing."""
MOST_PEAKS = 8192
"""Peaks of a block of 48^3 voxels that are noted."""


def _taps() -> np.ndarray:
    taps = np.exp(-0.5 * (np.arange(-3, 4) / SMOOTHING) ** 2)
    return (taps / taps.sum()).astype(np.float32)


TAPS = _taps()


def _directions() -> np.ndarray:
    """(13, 3): offsets of about PEAK_REACH voxels along the axes, the face and the space diagonals, one of each pair."""
    found = []
    for i in (-1, 0, 1):
        for j in (-1, 0, 1):
            for k in (-1, 0, 1):
                if (i, j, k) > (0, 0, 0):
                    scale = PEAK_REACH / np.sqrt(i * i + j * j + k * k)
                    found.append([round(scale * i), round(scale * j), round(scale * k)])
    return np.array(found, np.int64)


DIRECTIONS = _directions()


@numba.njit(cache=True, nogil=True)
def cut_block(slab, low, halo, air, out):
    """Fill `out` (n, n, n) with `slab` less `air` from `low - halo` on; 0 beyond the slab."""
    for a in range(out.shape[0]):
        i = low[0] - halo + a
        for b in range(out.shape[1]):
            j = low[1] - halo + b
            if i < 0 or j < 0 or i >= slab.shape[0] or j >= slab.shape[1]:
                out[a, b, :] = 0.0
                continue
            for c in range(out.shape[2]):
                k = low[2] - halo + c
                out[a, b, c] = slab[i, j, k] - air if 0 <= k < slab.shape[2] else np.float32(0.0)


@numba.njit(cache=True, nogil=True, fastmath=True)
def smoothed(block, taps):
    """The Gaussian blur (n - 6)^3 of a block (n)^3, float32."""
    reach = len(taps) // 2
    x, y, z = block.shape
    a = np.zeros((x - 2 * reach, y, z), np.float32)
    for i in range(a.shape[0]):
        for t in range(len(taps)):
            for j in range(y):
                for k in range(z):
                    a[i, j, k] += taps[t] * block[i + t, j, k]
    b = np.zeros((a.shape[0], y - 2 * reach, z), np.float32)
    for i in range(b.shape[0]):
        for j in range(b.shape[1]):
            for t in range(len(taps)):
                for k in range(z):
                    b[i, j, k] += taps[t] * a[i, j + t, k]
    c = np.zeros((b.shape[0], b.shape[1], z - 2 * reach), np.float32)
    for i in range(c.shape[0]):
        for j in range(c.shape[1]):
            for t in range(len(taps)):
                for k in range(c.shape[2]):
                    c[i, j, k] += taps[t] * b[i, j, k + t]
    return c


@numba.njit(cache=True, nogil=True, fastmath=True)
def local_mean(block, reach):
    """The mean (n - 2 reach)^3 over cubes of 2 reach + 1 voxels of a block (n)^3, float32, by running sums."""
    # voxel by voxel: whole rows and layers set at once take numba seconds longer to compile, here and wherever this is called
    width = 2 * reach + 1
    x, y, z = block.shape
    a = np.empty((x - 2 * reach, y, z), np.float32)
    total = np.zeros((y, z), np.float32)
    for i in range(x):
        for j in range(y):
            for k in range(z):
                total[j, k] += block[i, j, k]
        if i >= width:
            for j in range(y):
                for k in range(z):
                    total[j, k] -= block[i - width, j, k]
        if i >= width - 1:
            for j in range(y):
                for k in range(z):
                    a[i - width + 1, j, k] = total[j, k]
    b = np.empty((a.shape[0], y - 2 * reach, z), np.float32)
    row = np.zeros(z, np.float32)
    for i in range(a.shape[0]):
        for k in range(z):
            row[k] = 0.0
        for j in range(y):
            for k in range(z):
                row[k] += a[i, j, k]
            if j >= width:
                for k in range(z):
                    row[k] -= a[i, j - width, k]
            if j >= width - 1:
                for k in range(z):
                    b[i, j - width + 1, k] = row[k]
    c = np.empty((b.shape[0], b.shape[1], z - 2 * reach), np.float32)
    share = np.float32(1.0 / width**3)
    for i in range(c.shape[0]):
        for j in range(c.shape[1]):
            run = np.float32(0.0)
            for k in range(z):
                run += b[i, j, k]
                if k >= width:
                    run -= b[i, j, k - width]
                if k >= width - 1:
                    c[i, j, k - width + 1] = share * run
    return c


@numba.njit(cache=True, nogil=True)
def find_peaks(smooth, mean, margin, least, directions, persists, place, value, goes_on):
    """Local maxima of `smooth` that exceed the local mean by `least`; returns how many.

    smooth: has `margin` voxels more than `mean` on every side. place (P, 3): voxel in `mean`; value (P, 2): smoothed
    density and the local mean; goes_on (P, 2): in how many of the directions the peak persists, and the best share that
    both sides keep of it, in percent.
    """
    count = 0
    for i in range(mean.shape[0]):
        for j in range(mean.shape[1]):
            for k in range(mean.shape[2]):
                a, b, c = i + margin, j + margin, k + margin
                centre = smooth[a, b, c]
                if centre - mean[i, j, k] <= least:
                    continue
                if smooth[a - 1, b, c] > centre or smooth[a + 1, b, c] >= centre:
                    continue
                highest = True
                for da in range(-1, 2):
                    for db in range(-1, 2):
                        for dc in range(-1, 2):
                            before = da < 0 or (da == 0 and (db < 0 or (db == 0 and dc < 0)))
                            other = smooth[a + da, b + db, c + dc]
                            if (other > centre) or (not before and other == centre and (da != 0 or db != 0 or dc != 0)):
                                highest = False
                if not highest or count == len(place):
                    continue
                on, best = 0, np.float32(-1e9)
                for d in range(len(directions)):
                    x, y, z = directions[d, 0], directions[d, 1], directions[d, 2]
                    both = min(smooth[a + x, b + y, c + z], smooth[a - x, b - y, c - z])
                    if both > persists * centre:
                        on += 1
                    best = max(best, both)
                place[count, 0], place[count, 1], place[count, 2] = i, j, k
                value[count, 0], value[count, 1] = centre, mean[i, j, k]
                goes_on[count, 0], goes_on[count, 1] = on, np.int64(100.0 * max(best, 0.0) / centre)
                count += 1
    return count


@numba.njit(cache=True, inline="always")
def top_of(before, here, after):
    """How far, in voxels, the top of the parabola through three values lies from the middle one, which is the largest; in whole
    64ths, so that a place comes to the same wherever it is counted from."""
    bend = before - 2.0 * here + after
    return np.rint(64.0 * min(max(0.5 * (before - after) / bend, -0.5), 0.5)) / 64.0 if bend < 0.0 else 0.0


@numba.njit(cache=True, inline="always")
def top_around(values, i, j, k):
    """Where between voxels the largest value around voxel (i, j, k) lies, axis by axis."""
    here = values[i, j, k]
    return (
        i + top_of(values[i - 1, j, k], here, values[i + 1, j, k]),
        j + top_of(values[i, j - 1, k], here, values[i, j + 1, k]),
        k + top_of(values[i, j, k - 1], here, values[i, j, k + 1]),
    )


@numba.njit(cache=True, nogil=True)
def bump(smooth, a, b, c):
    """How far density bulges within the tangent plane at voxel (a, b, c): the weaker of minus its two second derivatives.

    The plane is normal to the gradient. A flat or gently curved skin gives near 0 however steep its edge, a line that lies on
    it 0 along itself, a knot on it the knot's own height over `BLOB_VARIANCE`.
    """
    gx = 0.5 * (smooth[a + 1, b, c] - smooth[a - 1, b, c])
    gy = 0.5 * (smooth[a, b + 1, c] - smooth[a, b - 1, c])
    gz = 0.5 * (smooth[a, b, c + 1] - smooth[a, b, c - 1])
    norm = np.sqrt(gx * gx + gy * gy + gz * gz)
    if norm <= 0.0:
        return 0.0
    nx, ny, nz = gx / norm, gy / norm, gz / norm
    centre = 2.0 * smooth[a, b, c]
    xx = smooth[a + 1, b, c] + smooth[a - 1, b, c] - centre
    yy = smooth[a, b + 1, c] + smooth[a, b - 1, c] - centre
    zz = smooth[a, b, c + 1] + smooth[a, b, c - 1] - centre
    xy = 0.25 * (smooth[a + 1, b + 1, c] + smooth[a - 1, b - 1, c] - smooth[a + 1, b - 1, c] - smooth[a - 1, b + 1, c])
    xz = 0.25 * (smooth[a + 1, b, c + 1] + smooth[a - 1, b, c - 1] - smooth[a + 1, b, c - 1] - smooth[a - 1, b, c + 1])
    yz = 0.25 * (smooth[a, b + 1, c + 1] + smooth[a, b - 1, c - 1] - smooth[a, b + 1, c - 1] - smooth[a, b - 1, c + 1])
    # H n, then the trace and the sum of squares of H within the plane
    hx, hy, hz = xx * nx + xy * ny + xz * nz, xy * nx + yy * ny + yz * nz, xz * nx + yz * ny + zz * nz
    along = nx * hx + ny * hy + nz * hz
    trace = xx + yy + zz - along
    squares = xx * xx + yy * yy + zz * zz + 2.0 * (xy * xy + xz * xz + yz * yz)
    squares += along * along - 2.0 * (hx * hx + hy * hy + hz * hz)
    apart = np.sqrt(max(2.0 * squares - trace * trace, 0.0))
    return -0.5 * (trace + apart)


def flat_limit(spacing: float) -> float:
    """The ripple below which a scan of `spacing` mm shows a body's material and no hair; infinite where that can't be told."""
    return FLAT * max(spacing / FLAT_SPACING, 1.0) if spacing < BLURRED_SPACING else float("inf")


@numba.njit(cache=True, nogil=True)
def ripple(smooth, a, b, c):
    """How much density changes round voxel (a, b, c) in more than one direction, per voxel, as a share of the density there.

    The square root of lambda_2 + lambda_3 of the mean structure tensor (nearly: the sum of its principal 2 x 2 minors over its
    trace), over `smooth`: 0 inside a material and on a flat skin, where all change is along one direction, and high in a bundle
    of strands however dense it is, since it changes across the strands in two.
    """
    xx = yy = zz = xy = xz = yz = 0.0
    for i in range(a - RIPPLE_REACH, a + RIPPLE_REACH + 1):
        for j in range(b - RIPPLE_REACH, b + RIPPLE_REACH + 1):
            for k in range(c - RIPPLE_REACH, c + RIPPLE_REACH + 1):
                gx = 0.5 * (smooth[i + 1, j, k] - smooth[i - 1, j, k])
                gy = 0.5 * (smooth[i, j + 1, k] - smooth[i, j - 1, k])
                gz = 0.5 * (smooth[i, j, k + 1] - smooth[i, j, k - 1])
                xx, yy, zz = xx + gx * gx, yy + gy * gy, zz + gz * gz
                xy, xz, yz = xy + gx * gy, xz + gx * gz, yz + gy * gz
    trace = xx + yy + zz
    centre = smooth[a, b, c]
    if trace <= 0.0 or centre <= 0.0:
        return 0.0
    minors = xx * yy + xx * zz + yy * zz - xy * xy - xz * xz - yz * yz
    return np.sqrt(max(minors, 0.0) / trace / (2 * RIPPLE_REACH + 1) ** 3) / centre
