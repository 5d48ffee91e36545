"""Tracing and subtracting on phantoms: a lone strand, a bundle, a crossing, a helix, noise, threads."""

import weakref
from itertools import pairwise

import numba
import numpy as np
import pytest

from ct2hair_addon.errors import Cancelled
from ct2hair_addon.guides import find_segments, stage, trace_guides
from ct2hair_addon.guides.sampling import centred, course_at
from ct2hair_addon.guides.seeds import seed_voxels
from ct2hair_addon.guides.trace import add_strand, smoothed
from ct2hair_addon.orientation import orientation_field
from ct2hair_addon.settings import GuideSettings, OrientationSettings
from ct2hair_addon.volume import BrickVolume

PEAK, BLUR, SPACING = 100.0, 0.85, 0.4
ORIGIN = np.array([3.0, -7.0, 11.0])


def scan(curves, shape, snr=None, seed=0) -> BrickVolume:
    """Strands (voxels, points about a voxel apart) as the scanner sees them; every brick stored."""
    size = tuple(-(-n // 16) for n in shape)
    table = np.arange(np.prod(size), dtype=np.int32).reshape(size)
    bricks = np.zeros((table.size, 16, 16, 16), np.float32)
    for curve in curves:
        add_strand(table, bricks, np.asarray(curve, np.float32), np.full(len(curve), PEAK), BLUR)
    if snr:
        bricks += np.random.default_rng(seed).normal(0, PEAK / snr, bricks.shape).astype(np.float32)
    return BrickVolume(table, bricks, SPACING, ORIGIN)


def straight(start, end):
    start, end = np.array(start, float), np.array(end, float)
    count = int(np.linalg.norm(end - start)) + 1
    return start + np.linspace(0, 1, count)[:, None] * (end - start)


def seeds_of(field):
    return seed_voxels(field.confidence, field.direction, 0)


def traced(volume, unsure=False, **changes):
    """The segments, in voxels. unsure: without heed to the hair's course."""
    field = orientation_field(volume, 0.35 * PEAK, OrientationSettings())
    course = field.direction.like(np.int8, (3,)) if unsure else field.course()
    segments, profile, tally = find_segments(volume, 0.35 * PEAK, course, seeds_of(field), GuideSettings(**changes))
    return [volume.to_voxel(line) for line in segments.polylines()], profile, tally


def distances(line, curve):
    """Distance of each point of `line` from the polyline `curve`, sampled densely."""
    fine = np.concatenate([a + np.linspace(0, 1, 9)[:, None] * (b - a) for a, b in pairwise(curve)])
    return np.sqrt(((line[:, None] - fine[None]) ** 2).sum(-1).min(1))


@pytest.mark.parametrize("snr", [None, 4.0])
def test_a_lone_strand_is_one_segment_on_its_centre_line(snr):
    curve = straight((10, 12, 8), (52, 40, 56))
    lines, profile, tally = traced(scan([curve], (64, 64, 64), snr))
    assert len(lines) == 1
    assert distances(lines[0], curve).max() < (0.1 if snr is None else 0.6)
    assert np.linalg.norm(lines[0][-1] - lines[0][0]) == pytest.approx(np.linalg.norm(curve[-1] - curve[0]), abs=5)
    assert profile.blur == pytest.approx(BLUR, abs=0.15)
    assert profile.peak == pytest.approx(PEAK, rel=0.2)
    assert sum(count for name, count in tally.items() if name.startswith("ended")) == 2


@pytest.mark.parametrize(("apart", "pieces"), [(2.2, 3), (2.5, 1)])
def test_neighbours_that_touch_are_both_found(apart, pieces):
    """In one piece each; closer than 2.5 voxels the second one in several, with gaps: what the first left of it is faint."""
    beside = straight((8, 20 + apart, 20), (56, 20 + apart, 20))
    curves = [straight((8, 20, 20), (56, 20, 20)), beside, straight((8, 40, 40), (56, 44, 40))]
    lines, _, _ = traced(scan(curves, (64, 64, 64)))
    assert len(lines) <= 2 + pieces
    for curve in curves:
        near = np.array([distances(curve, line) < 0.7 for line in lines])
        assert np.mean(near.any(axis=0)) > (0.8 if pieces == 1 else 0.7)
        assert pieces > 1 or near.mean(axis=1).max() > 0.8
    assert sum(len(line) for line in lines) < 1.2 * sum(len(curve) for curve in curves)


def test_a_crossing_is_gone_through_straight():
    curves = [straight((8, 32, 32), (56, 32, 32)), straight((14, 14, 32), (50, 50, 32))]
    lines, _, _ = traced(scan(curves, (64, 64, 64)))
    assert len(lines) == 2
    for curve in curves:
        assert min(distances(line, curve).max() for line in lines) < 0.8


def test_a_helix_is_followed():
    t = np.linspace(0, 4 * np.pi, 330)
    curve = np.stack([32 + 14 * np.cos(t), 32 + 14 * np.sin(t), 8 + 3.5 * t], 1)
    lines, _, _ = traced(scan([curve], (64, 64, 64), snr=4.0))
    found = max(lines, key=len)
    assert np.median(distances(found, curve)) < 0.5
    assert len(found) > 0.8 * np.linalg.norm(np.diff(curve, axis=0), axis=1).sum()


@pytest.mark.parametrize("radius", [11.0, 14.0])
def test_a_curl_keeps_its_radius(radius):
    """Following and smoothing alone ran a fifth of a voxel inside of it."""
    t = np.linspace(0, 4 * np.pi, int(4.2 * np.pi * radius))
    curve = np.stack([32 + radius * np.cos(t), 32 + radius * np.sin(t), 8 + 3.5 * t], 1)
    found = max(traced(scan([curve], (64, 64, 64), snr=4.0))[0], key=len)[8:-8]
    assert len(found) > 100
    assert np.hypot(found[:, 0] - 32, found[:, 1] - 32).mean() == pytest.approx(radius, abs=0.1)


@pytest.mark.parametrize("radius", [7.0, 8.0])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_tight_coil_is_one_segment(radius, seed):
    """Within what is looked ahead it turns by a radian and more: a parabola would leave it, and traces ended on the way."""
    t = np.linspace(0, 4 * np.pi, int(4.2 * np.pi * radius))
    curve = np.stack([32 + radius * np.cos(t), 32 + radius * np.sin(t), 8 + 3.5 * t], 1)
    whole = np.linalg.norm(np.diff(curve, axis=0), axis=1).sum()
    found = traced(scan([curve], (64, 64, 64), snr=4.0, seed=seed))[0]
    assert len(found) == 1
    assert np.linalg.norm(np.diff(found[0], axis=0), axis=1).sum() > whole - 5.0
    assert distances(found[0][3:-3], curve).mean() < 0.4  # it may run over the ends


def test_noise_alone_gives_no_strand():
    lines, _, _ = traced(scan([straight((8, 8, 8), (8, 8, 56))], (64, 64, 64), snr=4.0))
    assert len(lines) == 1


def test_threads_change_nothing():
    generator = np.random.default_rng(5)
    curves = [straight(generator.uniform(4, 60, 3), generator.uniform(4, 60, 3)) for _ in range(25)]
    volume = scan(curves, (64, 64, 64), snr=4.0)
    many = traced(volume)[0]
    threads = numba.get_num_threads()
    numba.set_num_threads(1)
    try:
        one = traced(volume)[0]
    finally:
        numba.set_num_threads(threads)
    assert len(one) == len(many) > 10
    for a, b in zip(one, many, strict=True):
        np.testing.assert_array_equal(a, b)


def test_cancelling_passes_through():
    volume = scan([straight((8, 8, 8), (8, 8, 56))], (64, 64, 64))
    field = orientation_field(volume, 0.35 * PEAK)

    def stop(done, total):
        raise Cancelled

    with pytest.raises(Cancelled):
        find_segments(volume, 0.35 * PEAK, field.course(), seeds_of(field), GuideSettings(), stop)


def test_traces_in_a_bundle_keep_to_the_course_of_the_hair():
    apart = np.arange(-3, 4) * 1.2
    bundle = [straight((8, 30 + a, 30 + b), (120, 30 + a, 30 + b)) for a in apart for b in apart]
    volume = scan(bundle, (128, 64, 64), snr=4.0)

    def off_course(unsure):
        lines = [np.diff(line[::4], axis=0) for line in traced(volume, unsure)[0] if len(line) > 20]
        steps = np.concatenate(lines)
        return np.degrees(np.mean(np.arccos(np.abs(steps[:, 0]) / np.linalg.norm(steps, axis=1))))

    assert off_course(False) < 0.6 * off_course(True)


def test_centring_moves_onto_the_line():
    volume = scan([straight((4, 20, 20), (44, 20, 20))], (48, 48, 48))
    x, y, z = 24.0, 20.9, 19.4
    for _ in range(3):
        x, y, z, _ = centred(volume.table, volume.bricks, x, y, z, 1.0, 0.0, 0.0, 2, 0.7)
    assert abs(y - 20) < 0.1 and abs(z - 20) < 0.1 and x == 24.0


def test_a_strand_taken_out_leaves_nothing():
    curve = straight((8, 20, 12), (40, 28, 36))
    volume = scan([curve], (48, 48, 48))
    add_strand(volume.table, volume.bricks, curve.astype(np.float32), np.full(len(curve), -PEAK), BLUR)
    assert np.abs(volume.bricks).max() < 1e-3 * PEAK


def test_smoothing_keeps_quadratics_and_tames_noise():
    t = np.arange(60.0)
    parabola = np.stack([t, 0.01 * t**2, 5 - 0.02 * t**2], 1).astype(np.float32)
    widths = np.array([4, 8, 16], np.int64)
    np.testing.assert_allclose(smoothed(parabola, widths, 0.3), parabola, atol=1e-3)
    noisy = parabola + np.random.default_rng(0).normal(0, 0.15, parabola.shape).astype(np.float32)
    assert np.std(smoothed(noisy, widths, 0.5) - parabola) < 0.6 * np.std(noisy - parabola)


def test_the_orientation_field_is_let_go_of_before_tracing(monkeypatch):
    volume = scan([straight((10, 20, 20), (60, 20, 20))], (80, 40, 40))
    fields = [orientation_field(volume, 0.35 * PEAK, OrientationSettings())]
    alive = weakref.ref(fields[0])

    def find(*arguments):
        assert alive() is None
        raise Cancelled

    monkeypatch.setattr(stage, "find_segments", find)
    with pytest.raises(Cancelled):
        trace_guides(volume, 0.35 * PEAK, fields.pop(), None)


def test_the_course_is_read_at_the_nearest_voxel_with_how_far_it_is_trusted():
    course = scan([straight((8, 8, 8), (8, 8, 24))], (32, 32, 32)).like(np.int8, (3,))
    row = int(course.table[0, 0, 0])
    course.bricks[row, 8, 8, 8], course.bricks[row, 8, 8, 9] = (0, 0, 127), (0, 0, 64)
    for place, expected in (((8.3, 7.6, 8.0), 1.0), ((8, 8, 9), 0.5), ((8, 8, 10), 0.0), ((-9, 0, 0), 0.0), ((900, 0, 0), 0.0)):
        x, y, z, trust = course_at(course.table, course.bricks, *map(float, place))
        assert abs(trust - expected) < 0.01
        assert (x, y, z) == (0.0, 0.0, 1.0 if expected else 0.0)
