"""The wig out of a raw scan of a ball with hair on it: what is kept, what is left out, and where knots and surface lie."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, label
from scipy.spatial import cKDTree

from ct2hair_addon.errors import ScanError
from ct2hair_addon.evaluation import render_density, strand_peak, synthesize
from ct2hair_addon.settings import ScanSettings
from ct2hair_addon.strands import Strands, concatenate
from ct2hair_addon.volume import Thresholds, find_thresholds, import_scan, open_scan, wig, write_scan
from ct2hair_addon.volume.grid import BRICK
from ct2hair_addon.volume.structure import SMOOTHING

SPACING = 0.7
RADIUS = 40.0
BY_HAND = Thresholds(air=1000.0, noise=32.5, strand=130.0, hair=1052.0, knots=1286.0, solid=1780.0, lines=5000)
NO_BODY = replace(BY_HAND, solid=None)


@pytest.fixture(scope="module")
def scan(ball, spikes, tmp_path_factory):
    """The ball as a shell of 3 mm with net, a knot at each of 1000 roots, and hair; SNR 4."""
    path = tmp_path_factory.mktemp("scan") / "scan.nrrd"
    return synthesize(spikes, ball, path, SPACING, seed=4)


@pytest.fixture(scope="module")
def dense(scan):
    """(the scan's values [x, y, z], its origin)."""
    with open_scan(scan.files["scan"]) as reader:
        return reader.slab(0, reader.shape[2]), reader.origin


@pytest.fixture(scope="module")
def result(scan):
    with open_scan(scan.files["scan"]) as reader:
        return import_scan(reader, find_thresholds(reader, ScanSettings()))


def assert_shown(found, expected):
    """Whole densities are as expected, but the least there is for 0, which stands for what was cleared."""
    np.testing.assert_allclose(found[expected != 0], expected[expected != 0], atol=1e-3)
    assert (np.abs(found[expected == 0]) == 1).all()


def distance_to_ball(volume_shape, origin):
    axes = [o + SPACING * np.arange(n) for n, o in zip(volume_shape, origin, strict=True)]
    x, y, z = np.meshgrid(*axes, indexing="ij", sparse=True)
    return np.sqrt(x * x + y * y + z * z) - RADIUS


def test_what_is_kept_are_the_scans_values_over_air_in_their_place(result, dense):
    values, origin = dense
    found = result.density.block((0, 0, 0), values.shape)
    np.testing.assert_allclose(result.density.origin, origin)
    assert result.density.spacing == pytest.approx(SPACING)
    kept = found != 0.0
    assert found.dtype == np.int16
    assert_shown(found[kept], np.rint(values[kept] - np.float32(result.thresholds.air)))


def test_units_too_coarse_or_too_fine_for_whole_numbers_are_kept_as_they_are(piece, tmp_path):
    for name, unit in (("fine", 1.0 / 4096.0), ("coarse", 40.0)):
        np.save(tmp_path / f"{name}.npy", piece.astype(np.float32) * np.float32(unit))
        levels = {field: getattr(BY_HAND, field) * unit for field in ("air", "noise", "strand", "hair", "knots", "solid")}
        found = imported(tmp_path / f"{name}.npy", replace(BY_HAND, **levels)).density.bricks
        assert found.dtype == np.float32
        np.save(tmp_path / "whole.npy", piece)
        whole = imported(tmp_path / "whole.npy").density.bricks
        none = np.abs(whole) == 1  # or 0, which whole numbers leave to what is cleared
        np.testing.assert_allclose((found / unit)[~none], whole[~none], atol=0.01)
        assert (np.abs(found[none] / unit) <= 1.0).all()
        np.testing.assert_array_equal(found != 0.0, whole != 0)


def test_values_past_the_range_of_whole_numbers_end_at_it(piece, tmp_path):
    high = piece.astype(np.float32)
    at = np.unravel_index(np.argmax(np.where(high < 1500, high, 0)), high.shape)  # hair, not mannequin
    high[at] = 90000.0
    np.save(tmp_path / "scan.npy", high)
    found = imported(tmp_path / "scan.npy", NO_BODY).density
    assert found.bricks.dtype == np.int16
    assert found.block(at, np.add(at, 1))[0, 0, 0] == np.iinfo(np.int16).max


def test_the_hair_is_kept_and_most_of_the_air_is_not(result, scan, dense):
    values, origin = dense
    clean = render_density(scan.truth, SPACING, 0.85, origin, values.shape).block((0, 0, 0), values.shape)
    outside = distance_to_ball(values.shape, origin)
    hair = (clean > 0.35 * strand_peak(0.85)) & (outside > 4.0)
    found = result.density.block((0, 0, 0), values.shape)
    assert np.mean(found[hair] != 0.0) > 0.985
    # the mean along true strands is a strand's, as in the scan itself
    assert found[hair].mean() == pytest.approx((values[hair] - result.thresholds.air).mean(), rel=0.02)
    # bricks far from all hair and from the ball hold noise
    far = clean == 0.0
    assert np.mean(found[far] == 0.0) > 0.6
    assert result.hair_level == pytest.approx(result.thresholds.hair - result.thresholds.air)
    tally = result.tally
    bricks = tally["bricks kept"] + tally["bricks left out: air"] + tally["bricks left out: mannequin"]
    assert bricks == result.density.table.size and tally["bricks kept"] == len(result.density.bricks)
    assert tally["voxels of the scan"] == values.size


@pytest.mark.parametrize("whole", [True, False])
def test_exactly_0_is_only_what_was_cleared(result, dense, whole, tmp_path):
    values, origin = dense
    density = result.density
    if not whole:  # a strand is 8 units, too few to be kept whole: a fifth of all air is 0
        air, strand = result.thresholds.air, result.thresholds.strand
        write_scan(tmp_path / "coarse.nrrd", np.rint((values - air) / strand * 8.0) + 100.0, SPACING, origin)
        with open_scan(tmp_path / "coarse.nrrd") as reader:
            density = import_scan(reader, find_thresholds(reader, ScanSettings())).density
    assert (density.bricks.dtype == np.int16) == whole
    row, *inside = np.nonzero(density.bricks == 0)
    points = density.to_scan(16 * density.brick_index[row] + np.stack(inside, axis=1))
    assert len(points) > 1000
    assert np.linalg.norm(points, axis=1).max() < RADIUS + 4.0
    least = np.abs(density.bricks).astype(np.float64).min(where=density.bricks != 0, initial=np.inf)
    faint = density.bricks[np.abs(density.bricks) <= 1.0001 * least]
    assert abs(np.sign(faint, dtype=np.float64).mean()) < 0.1, "as many above 0 as below"


def test_at_half_the_signal_noise_is_left_out_and_hair_is_kept(spikes, ball, tmp_path):
    made = synthesize(spikes, ball, tmp_path / "scan.nrrd", SPACING, seed=4, snr=2.0)
    with open_scan(made.files["scan"]) as reader:
        values, origin = reader.slab(0, reader.shape[2]), reader.origin
        found = import_scan(reader, find_thresholds(reader, ScanSettings())).density.block((0, 0, 0), values.shape)
    clean = render_density(made.truth, SPACING, 0.85, origin, values.shape).block((0, 0, 0), values.shape)
    hair = (clean > 0.35 * strand_peak(0.85)) & (distance_to_ball(values.shape, origin) > 4.0)
    assert np.mean(found[hair] != 0.0) > 0.975
    assert np.mean(found[clean == 0.0] == 0.0) > 0.6


@pytest.mark.parametrize("level", [2.4, 2.8, 3.3])
def test_noise_makes_a_cluster_that_large_in_less_than_a_brick_of_a_hundred(level):
    noise = gaussian_filter(np.random.default_rng(6).normal(size=(180, 180, 180)).astype(np.float32), SMOOTHING, truncate=3.0)
    clusters, _ = label(noise > level * noise.std())
    size = np.bincount(clusters.ravel())[1:]
    bricks = noise.size / (BRICK + 2 * wig.MARGIN) ** 3
    least = wig.noise_cluster(level)
    assert np.count_nonzero(size >= least) < wig.FALSE_BRICKS * bricks
    # and much smaller ones are no rarity
    assert np.count_nonzero(size >= 0.6 * least) > wig.FALSE_BRICKS * bricks


def test_a_clear_signal_needs_no_clusters():
    assert wig.noise_cluster(4.3) == wig.noise_cluster(1e30) == 1


def test_only_small_clusters_are_left():
    where = np.zeros((12, 12, 12), np.bool_)
    where[1, 1, 1:5] = where[1, 2, 4] = True
    where[3, 2, 4] = where[8, 8, 2:6] = where[11, 11, 11] = True
    whole = where.copy()
    wig._leave_small(where, 5)
    whole[1, 1, 1:5] = whole[1, 2, 4] = False
    np.testing.assert_array_equal(where, whole)


def test_where_thresholds_are_in_doubt_the_mannequins_knots_decide(scan, piece, tmp_path):
    with open_scan(scan.files["scan"]) as reader:
        thresholds = find_thresholds(reader, ScanSettings())
        assert not thresholds.doubt
        taken = import_scan(reader, replace(thresholds, doubt="no hair was found"))
    assert len(taken.knots) > 500
    assert any(f"taken for a wig by the {len(taken.knots):,} knots on its mannequin" in text for text in taken.warnings)
    np.save(tmp_path / "scan.npy", piece)
    for levels in (BY_HAND, NO_BODY):
        with pytest.raises(ScanError, match="no hair was found: few lines"):
            imported(tmp_path / "scan.npy", replace(levels, doubt="no hair was found: few lines"))


def test_the_mannequin_is_cleared_from_its_wall_inwards(result, dense):
    values, origin = dense
    found = result.density.block((0, 0, 0), values.shape)
    outside = distance_to_ball(values.shape, origin)
    wall = (outside < 0.0) & (outside > -3.0)
    assert np.mean(found[wall] == 0.0) > 0.999
    # some blurred edge is cleared with it, hair two millimetres and more over it is not
    assert np.mean(found[(outside > 0) & (outside < 1.0)] == 0.0) > 0.95
    assert result.tally["voxels cleared: mannequin"] > 0.9 * np.count_nonzero(wall & (values > 1780))


def test_knots_lie_at_the_roots(result, scan):
    roots = scan.truth.roots
    off, _ = cKDTree(roots).query(result.knots)
    assert len(result.knots) > 500
    assert np.mean(off < 0.5) > 0.6 and np.median(off) < 0.45
    # along the ball they are less far off than the middles of their voxels are: 0.28 and 0.36 voxel
    near = off < SPACING
    true = roots[cKDTree(roots).query(result.knots)[1]][near]
    outwards = true / np.linalg.norm(true, axis=1, keepdims=True)
    apart = result.knots[near] - true
    apart -= (apart * outwards).sum(axis=1, keepdims=True) * outwards
    assert np.median(np.linalg.norm(apart, axis=1)) < 0.32 * SPACING
    found, _ = cKDTree(result.knots).query(roots)
    assert np.mean(found < 1.0) > 0.6
    assert np.abs(np.linalg.norm(result.knots, axis=1) - RADIUS).max() < 4.0


def test_solid_points_lie_on_the_balls_outer_surface(result):
    radius = np.linalg.norm(result.solid_points, axis=1)
    assert len(result.solid_points) > 10_000
    assert np.median(np.abs(radius - RADIUS)) < SPACING
    assert np.mean(np.abs(radius - RADIUS) < 1.5) > 0.97  # and not on the wall's inner side, at 37
    direction = result.solid_points / radius[:, None]
    # all round, and evenly so
    assert np.abs(direction.mean(axis=0)).max() < 0.1


@pytest.fixture(scope="module")
def piece(dense):
    """A corner of the scan, no two sizes alike: wall, net, knots and hair."""
    values, _ = dense
    middle = np.array(values.shape) // 2
    return values[middle[0] - 40 : middle[0] + 70, middle[1] - 20 : middle[1] + 60, middle[2] - 30 : middle[2] + 66].astype(
        np.uint16
    )


def imported(path, thresholds=BY_HAND, **settings):
    with open_scan(path, ScanSettings(spacing=SPACING, **settings)) as reader:
        return import_scan(reader, thresholds, ScanSettings(**settings))


def in_order(points):
    return points[np.lexsort(points.T)]


@pytest.mark.parametrize("name", ["x slowest", "z slowest", "Fortran order", "y slowest"])
def test_the_order_of_the_file_makes_no_difference(name, piece, tmp_path):
    write_scan(tmp_path / "scan.mha", piece, SPACING)
    expected = imported(tmp_path / "scan.mha")
    if name == "z slowest":
        path = tmp_path / "scan.nrrd"
        write_scan(path, piece, SPACING)
    elif name == "y slowest":
        import SimpleITK as sitk

        path = tmp_path / "turned.nrrd"
        image = sitk.GetImageFromArray(np.ascontiguousarray(piece.transpose(1, 2, 0)))  # fast x, then z, then y
        image.SetSpacing([SPACING] * 3)
        image.SetDirection(np.eye(3)[:, [0, 2, 1]].ravel().tolist())
        sitk.WriteImage(image, str(path))
    else:
        path = tmp_path / "scan.npy"
        np.save(path, piece if name == "x slowest" else np.asfortranarray(piece))
    found = imported(path)
    assert found.density.table.shape == expected.density.table.shape
    # rounding in another order may tip a brick of noise in or out, no more
    assert np.mean((found.density.table >= 0) != (expected.density.table >= 0)) < 0.005
    ours, theirs = (each.density.block((0, 0, 0), piece.shape) for each in (found, expected))
    both = (ours != 0) & (theirs != 0)
    np.testing.assert_array_equal(ours[both], theirs[both])
    assert np.mean((ours != 0) != (theirs != 0)) < 0.005
    near, _ = cKDTree(expected.knots).query(found.knots)
    assert len(found.knots) > 100 and np.mean(near < 1e-3) > 0.99
    assert len(found.solid_points) == len(expected.solid_points) > 1000
    np.testing.assert_allclose(in_order(found.solid_points), in_order(expected.solid_points), atol=1e-3)


@pytest.mark.parametrize("slices", [110, 105, 97, 96])
def test_the_size_of_the_slabs_changes_no_bit(slices, piece, tmp_path, monkeypatch):
    # the last slab has 14 slices, 9, 1 and all of 48
    np.save(tmp_path / "scan.npy", piece[-slices:])
    whole = imported(tmp_path / "scan.npy")
    monkeypatch.setattr(wig, "SLAB_BYTES", 1)
    slabs = imported(tmp_path / "scan.npy")
    np.testing.assert_array_equal(slabs.density.table, whole.density.table)
    np.testing.assert_array_equal(slabs.density.bricks, whole.density.bricks)
    np.testing.assert_array_equal(in_order(slabs.knots), in_order(whole.knots))
    np.testing.assert_array_equal(slabs.solid_points, whole.solid_points)
    assert slabs.tally == whole.tally


def test_without_a_mannequin_nothing_is_cleared_and_blobs_are_the_knots(scan, piece, tmp_path):
    hair = np.clip(piece, 0, 1600).astype(np.uint16)
    np.save(tmp_path / "scan.npy", hair)
    found = imported(tmp_path / "scan.npy", NO_BODY)
    assert not len(found.solid_points) and not found.warnings
    assert found.tally["voxels cleared: mannequin"] == 0
    values = found.density.block((0, 0, 0), hair.shape)
    kept = values != 0
    assert_shown(values[kept], hair[kept] - np.float32(1000.0))


@pytest.fixture(scope="module")
def tail(spikes):
    """Lone strands, and a tail on the ball's top, 24 mm thick and eight times as dense: over the mannequin's threshold."""
    random = np.random.default_rng(7)
    across = random.uniform(-12.0, 12.0, (2100, 2))
    across = across[np.hypot(*across.T) < 12.0].astype(np.float32)
    along = np.linspace(RADIUS + 0.5, RADIUS + 70.0, 40, dtype=np.float32)
    points = np.concatenate(
        [np.repeat(across[:, None], len(along), axis=1), np.tile(along[:, None], (len(across), 1, 1))], axis=2
    )
    return concatenate([Strands(spikes.points, spikes.offsets), Strands.from_array(points)])


def of_tail(points, low, high):
    return points[(np.hypot(points[:, 0], points[:, 1]) < 10.0) & (points[:, 2] > low) & (points[:, 2] < high)]


@pytest.mark.parametrize("mannequin", ["shell", "none"])
def test_hair_as_dense_as_the_mannequin_is_no_body(mannequin, tail, ball, tmp_path):
    made = synthesize(tail, ball, tmp_path / "scan.nrrd", SPACING, mannequin=mannequin, seed=8)
    with open_scan(made.files["scan"]) as reader:
        thresholds = find_thresholds(reader, ScanSettings())
        found = import_scan(reader, thresholds)
    assert (thresholds.solid is None) == (mannequin == "none")
    high = found.density.sample(of_tail(made.truth.points, RADIUS + 6.0, RADIUS + 68.0))
    assert np.quantile(high, 0.3) > 773.0, "the tail should be as dense as a mannequin"
    assert np.mean(high == 0.0) < 0.002
    # and the wall is gone under it, too
    under = of_tail(made.truth.points, RADIUS, RADIUS + 1.0) - [0.0, 0.0, 2.5]
    assert mannequin == "none" or np.mean(found.density.sample(under) == 0.0) > 0.99


def test_a_mannequins_level_that_is_set_decides_alone(tail, ball, tmp_path):
    settings = ScanSettings(solid=1500.0)
    made = synthesize(tail, ball, tmp_path / "scan.nrrd", SPACING, seed=8)
    with open_scan(made.files["scan"], settings) as reader:
        found = import_scan(reader, find_thresholds(reader, settings))
    high = found.density.sample(of_tail(made.truth.points, RADIUS + 6.0, RADIUS + 68.0))
    assert np.mean(high == 0.0) > 0.5


def test_a_level_for_a_mannequin_that_is_not_there_is_a_warning(piece, tmp_path):
    np.save(tmp_path / "scan.npy", piece)
    found = imported(tmp_path / "scan.npy", replace(BY_HAND, solid=9000.0))
    assert any("no body of at least 10 cm3 lies above scan.solid (9000)" in text for text in found.warnings)
    assert not len(found.solid_points)


def test_voxels_that_are_no_cubes_are_said_and_resampled(piece, tmp_path):
    write_scan(tmp_path / "scan.mha", piece[:, :, ::2], (SPACING, SPACING, 2 * SPACING))
    with open_scan(tmp_path / "scan.mha") as reader:
        found = import_scan(reader, BY_HAND)
    assert any("resampled to cubes of 0.7 mm" in text for text in found.warnings)
    assert found.density.spacing == pytest.approx(SPACING)
    values = found.density.block((0, 0, 0), piece.shape)[:, :, ::2]
    kept = values != 0
    assert kept.any()
    assert_shown(values[kept], piece[:, :, ::2][: values.shape[0]][kept] - np.float32(1000.0))


def test_no_hair_left_is_refused_with_what_to_do(tmp_path):
    noise = np.random.default_rng(0).normal(1000.0, 20.0, (64, 64, 64)).astype(np.uint16)
    np.save(tmp_path / "scan.npy", noise)
    with pytest.raises(ScanError, match=r"scan\.npy: no hair is left above air \(1000\) .*set scan\.hair lower"):
        imported(tmp_path / "scan.npy", NO_BODY)
