"""The kernels that tell lines, sheets and blobs apart, against scipy and on phantoms drawn for them."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage, special

from ct2hair_addon.volume.structure import (
    BLOB_VARIANCE,
    DIRECTIONS,
    HALO,
    LINE_SHARE,
    MEAN_REACH,
    NOISE_SHARE,
    PEAK_REACH,
    PERSISTS,
    STRAND_BLUR,
    TAPS,
    bump,
    cut_block,
    find_peaks,
    flat_limit,
    local_mean,
    ripple,
    smoothed,
)
from ct2hair_addon.volume.thresholds import LINE_DIRECTIONS

SIZE = 48 + 2 * HALO
MIDDLE = SIZE // 2


@pytest.fixture(scope="module")
def noise() -> np.ndarray:
    return np.random.default_rng(2).normal(size=(40, 34, 37)).astype(np.float32)


def test_smoothed_is_scipys_gaussian(noise):
    expected = ndimage.gaussian_filter(noise.astype(np.float64), 1.0, truncate=3.0)[3:-3, 3:-3, 3:-3]
    np.testing.assert_allclose(smoothed(noise, TAPS), expected, atol=1e-5)


def test_local_mean_is_scipys_uniform_filter(noise):
    expected = ndimage.uniform_filter(noise.astype(np.float64), 2 * MEAN_REACH + 1)[4:-4, 4:-4, 4:-4]
    np.testing.assert_allclose(local_mean(noise, MEAN_REACH), expected, atol=1e-5)


def test_the_shares_are_what_smoothing_leaves_of_a_strand_and_of_noise(noise):
    assert smoothed(noise, TAPS).std() == pytest.approx(NOISE_SHARE, rel=0.06)
    at = np.arange(31) - 15.0
    line = np.exp(-0.5 * (at[:, None] ** 2 + at[None] ** 2) / STRAND_BLUR**2)
    line = np.repeat(line[:, :, None], 20, axis=2).astype(np.float32)
    assert smoothed(line, TAPS).max() == pytest.approx(LINE_SHARE, rel=0.03)


def test_the_directions_are_one_of_each_opposite_pair_and_about_as_long():
    assert len(DIRECTIONS) == 13
    assert not {tuple(row) for row in DIRECTIONS.tolist()} & {tuple(row) for row in (-DIRECTIONS).tolist()}
    assert np.abs(np.linalg.norm(DIRECTIONS, axis=1) - PEAK_REACH).max() < 0.7


def test_a_block_is_cut_with_its_halo_and_nothing_beyond_the_slab(noise):
    out = np.full((16, 16, 16), np.nan, np.float32)
    cut_block(noise, np.array([30, -2, 10]), 4, np.float32(0.5), out)
    expected = np.zeros((16, 16, 16), np.float32)
    expected[:14, 6:, :] = noise[26:40, :10, 6:22] - np.float32(0.5)
    np.testing.assert_array_equal(out, expected)


def grid() -> np.ndarray:
    return np.stack(np.meshgrid(*[np.arange(SIZE, dtype=float)] * 3, indexing="ij"), axis=-1) - MIDDLE - [0.2, -0.3, 0.1]


def drawn(kind: str, along=(1.0, 1.0, 0.3)) -> np.ndarray:
    """A strand along a direction, a sheet across it or a knot, through the middle, in peaks of 100."""
    p = grid()
    across = (p @ (np.asarray(along) / np.linalg.norm(along))) ** 2
    whole = (p**2).sum(axis=-1)
    far = {"line": whole - across, "sheet": across, "blob": whole}[kind]
    return (100.0 * np.exp(-0.5 * far / STRAND_BLUR**2)).astype(np.float32)


def peaks_of(block: np.ndarray, least: float = 5.0):
    """(places within the inner 48^3, values, directions in which they go on)."""
    inner = HALO - MEAN_REACH
    mean = local_mean(block[inner:-inner, inner:-inner, inner:-inner], MEAN_REACH)
    place, value = np.empty((8192, 3), np.int16), np.empty((8192, 2), np.float32)
    goes_on = np.empty((8192, 2), np.int16)
    count = find_peaks(smoothed(block, TAPS), mean, HALO - 3, least, DIRECTIONS, PERSISTS, place, value, goes_on)
    return place[:count], value[:count], goes_on[:count]


@pytest.mark.parametrize("along", [(1.0, 1.0, 0.3), (0.2, 1.0, -0.1), (-1.0, 0.9, 1.2), (0.1, -0.05, 1.0)])
def test_a_strand_goes_on_in_one_direction_or_a_few_next_to_it(along):
    place, value, goes_on = peaks_of(drawn("line", along))
    assert len(place) > 3
    assert (goes_on[:, 0] >= 1).all() and (goes_on[:, 0] <= LINE_DIRECTIONS).all()
    np.testing.assert_allclose(value[:, 0].max(), 100.0 * LINE_SHARE, rtol=0.06)
    along = np.asarray(along) / np.linalg.norm(along)
    off = place - (MIDDLE - HALO + np.array([0.2, -0.3, 0.1]))
    assert np.linalg.norm(off - (off @ along)[:, None] * along, axis=1).max() < 1.0


@pytest.mark.parametrize("normal", [(0.04, -0.03, 1.0), (1.0, 0.05, 0.02), (1.0, 0.9, 0.05)])
def test_a_sheet_goes_on_in_more_directions_than_a_line(normal):
    _, _, goes_on = peaks_of(drawn("sheet", normal))
    assert len(goes_on) > 20
    assert np.mean(goes_on[:, 0] > LINE_DIRECTIONS) > 0.9


def test_a_knot_goes_on_in_none_and_is_found_once():
    place, value, goes_on = peaks_of(drawn("blob"))
    assert place.tolist() == [[MIDDLE - HALO] * 3]
    assert goes_on[0, 0] == 0 and goes_on[0, 1] < 20
    assert value[0, 0] == pytest.approx(100.0 * LINE_SHARE**1.5, rel=0.06)


def test_a_flat_top_is_one_peak_and_nothing_stands_out_of_a_constant():
    block = np.zeros((SIZE, SIZE, SIZE), np.float32)
    assert not len(peaks_of(block + 7.0)[0])
    block[MIDDLE : MIDDLE + 2, MIDDLE : MIDDLE + 2, MIDDLE] = 100.0
    assert len(peaks_of(block)[0]) == 1


def test_no_more_peaks_are_noted_than_there_is_room_for():
    block = drawn("line")
    inner = HALO - MEAN_REACH
    mean = local_mean(block[inner:-inner, inner:-inner, inner:-inner], MEAN_REACH)
    room = np.empty((2, 3), np.int16), np.empty((2, 2), np.float32), np.empty((2, 2), np.int16)
    assert find_peaks(smoothed(block, TAPS), mean, HALO - 3, 5.0, DIRECTIONS, PERSISTS, *room) == 2


def test_a_bump_is_a_knot_on_the_skin_and_neither_the_skin_nor_a_strand_on_it():
    p = grid()
    # a body below z = -2 with an edge blurred like a scan's, a strand and a knot that lie on it
    skin = 1000.0 / (1.0 + np.exp(1.7 * (p[..., 2] + 2.0) / STRAND_BLUR))
    strand = 100.0 * np.exp(-0.5 * (p[..., 0] ** 2 + p[..., 2] ** 2) / STRAND_BLUR**2)
    knot = 400.0 * np.exp(-0.5 * (p**2).sum(axis=-1) / STRAND_BLUR**2)

    def strongest(values):
        smooth = smoothed(values.astype(np.float32), TAPS)
        at = MIDDLE - 3
        return max(bump(smooth, at, at, at + dz) for dz in (-2, -1, 0, 1))

    height = 400.0 * LINE_SHARE**1.5
    with_knot = strongest(skin + knot)
    assert with_knot == pytest.approx(height / BLOB_VARIANCE, rel=0.35)
    assert abs(strongest(skin)) < 0.02 * with_knot
    assert strongest(skin + strand) < 0.12 * with_knot


def test_a_material_and_its_edge_are_flat_and_a_bundle_is_not():
    at = np.arange(24) - 12.0
    x, y, _ = np.meshgrid(at, at, at, indexing="ij")
    edge = special.ndtr((0.6 * x + 0.8 * y) / STRAND_BLUR).astype(np.float32)
    slope = smoothed(edge, TAPS)
    assert ripple(slope, 9, 9, 9) < 0.2 * flat_limit(0.4)
    assert ripple(np.ones((18, 18, 18), np.float32), 9, 9, 9) == 0.0
    random = np.random.default_rng(3)
    lines = sum(np.exp(-0.5 * ((x - u) ** 2 + (y - v) ** 2) / STRAND_BLUR**2) for u, v in random.uniform(-14, 14, (1400, 2)))
    bundle = smoothed(lines.astype(np.float32), TAPS)
    assert bundle.mean() > 7.0
    found = [ripple(bundle, i, j, 9) for i in range(4, 14) for j in range(4, 14)]
    assert np.quantile(found, 0.02) > flat_limit(0.4) and np.median(found) > 1.5 * flat_limit(0.4)


def test_coarse_scans_have_rougher_bodies():
    assert flat_limit(0.1) == flat_limit(0.8) < flat_limit(1.2) < flat_limit(1.5) == np.inf
