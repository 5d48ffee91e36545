"""Scores: neighbours against SciPy's tree, and every score on phantoms whose value is worked out by hand."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from ct2hair_addon.evaluation import (
    centre_line_error,
    coverage,
    direction_share,
    evaluate,
    format_scores,
    hair_kept,
    orientation_error,
    registration_error,
    render_density,
    rooted_length,
    scan_scores,
    strand_peak,
)
from ct2hair_addon.evaluation.curves import sample_curves
from ct2hair_addon.evaluation.scores import head_scores, strand_scores, voxel_scores
from ct2hair_addon.strands import Strands
from ct2hair_addon.volume import BrickVolume


def lines(*ends) -> Strands:
    """Straight strands from pairs of ends."""
    t = np.linspace(0.0, 1.0, 41)[:, None]
    return Strands.from_polylines([(np.array(a) * (1 - t) + np.array(b) * t).astype(np.float32) for a, b in ends])


def waves(count=150, seed=4) -> Strands:
    generator = np.random.default_rng(seed)
    z = np.linspace(0, 60, 40)
    root = generator.uniform(-15, 15, size=(count, 1, 2))
    phase = generator.uniform(0, 2 * np.pi, size=(count, 1, 2))
    across = root + 2.0 * np.sin(z[None, :, None] / 6.0 + phase)
    points = np.concatenate([across, np.broadcast_to(z[None, :, None], (count, len(z), 1))], axis=-1)
    return Strands.from_array(points.astype(np.float32))


def test_a_set_scores_one_against_itself(ball, spikes):
    for strands in (waves(), spikes):
        scores = evaluate(strands, strands, ball)
        assert scores["consistency"] == 1.0
        for table in (*scores["voxel"].values(), *scores["strand"].values()):
            for name in ("iou", "precision", "recall", "f"):
                assert table.get(name, 1.0) == 1.0
        assert all(table["mse"] == 0.0 for table in scores["voxel"].values())
    assert scores["roots_on_scalp"] == 1.0 and scores["inside_head"] == 0.0
    assert "1.000" in format_scores(scores)


def test_voxel_scores_equal_dense_arrays():
    truth, result = waves(), waves(seed=5)
    scores = voxel_scores(truth, result, 0.7)
    dense = []
    for strands in (truth, result):
        index = np.floor(sample_curves(strands, 0.35, 0.5).points.astype(np.float64) / 0.7 + 0.5).astype(int) + [40, 40, 10]
        counts = np.zeros((80, 80, 110))
        np.add.at(counts, tuple(index.T), 1.0)
        dense.append(gaussian_filter(counts, 0.8, mode="constant"))
    true, found = (volume > 0.35 * 2 / (2 * np.pi * 0.8**2) for volume in dense)
    top = np.percentile(dense[0][true], 99)
    squared = (np.minimum(dense[0] / top, 1) - np.minimum(dense[1] / top, 1)) ** 2
    assert scores["iou"] == pytest.approx((true & found).sum() / (true | found).sum(), rel=2e-3)
    assert scores["precision"] == pytest.approx((true & found).sum() / found.sum(), rel=2e-3)
    assert scores["recall"] == pytest.approx((true & found).sum() / true.sum(), rel=2e-3)
    assert scores["mse"] == pytest.approx(squared[true | found].mean(), rel=5e-3)


@pytest.mark.parametrize(
    ("voxel", "count", "page"), [(0.5, 240, (0.85, 0.71, 0.54, 0.33)), (1.0, 150, (0.95, 0.89, 0.82, 0.70))]
)
def test_a_known_position_error_costs_the_pages_iou(voxel, count, page):
    # EVALUATION.md's figures; they hold for one density of hair, here 0.27 and 0.17 strands a square millimetre
    truth = waves(count)
    generator = np.random.default_rng(0)
    for error, expected in zip((0.1, 0.25, 0.5, 1.0), page, strict=True):
        direction = generator.normal(size=(count, 3))
        direction *= error / np.linalg.norm(direction, axis=1, keepdims=True)
        shifted = truth.with_points(truth.points + direction[truth.strand_index].astype(np.float32))
        assert voxel_scores(truth, shifted, voxel)["iou"] == pytest.approx(expected, abs=0.02)


def test_half_a_result_has_full_precision_and_half_the_recall():
    # 40 mm of truth 20 mm apart; the result has one of the two strands
    truth = lines(([0, 0, 0], [0, 0, 40]), ([20, 0, 0], [20, 0, 40]))
    result = lines(([0, 0, 0], [0, 0, 40]))
    scores = strand_scores(truth, result)
    for table in scores["strand"].values():
        assert (table["precision"], table["recall"]) == (1.0, 0.5)
        assert table["f"] == pytest.approx(2 / 3)
    assert scores["consistency"] == 0.5
    voxels = voxel_scores(truth, result, 1.0)
    assert voxels["precision"] == 1.0
    assert voxels["iou"] == voxels["recall"] == pytest.approx(0.5, abs=0.02)


def test_distance_and_angle_decide_together():
    truth = lines(([0, 0, 0], [0, 0, 40]))
    # 1.5 mm beside, parallel and pointing the other way: out at 0.5 and 1 mm, in from 2 mm on; the sign is ignored
    beside = strand_scores(truth, lines(([1.5, 0, 40], [1.5, 0, 0])))["strand"]
    assert [beside[name]["recall"] for name in ("0.5/10", "1/10", "2/20", "3/30", "4/40")] == [0, 0, 1, 1, 1]
    # through the same place at 25 degrees: nothing within 10 or 20 degrees
    angle = np.radians(25.0)
    tilted = lines(([-20 * np.sin(angle), 0, 20 - 20 * np.cos(angle)], [20 * np.sin(angle), 0, 20 + 20 * np.cos(angle)]))
    table = strand_scores(truth, tilted)["strand"]
    assert table["1/10"]["recall"] == table["2/20"]["recall"] == 0.0
    # within 3 mm of the truth's line: z from 20 - 3 / sin 25 to 20 + 3 / sin 25, 12.9 to 27.1
    assert table["3/30"]["recall"] == pytest.approx(14.2 / 40, abs=0.05)


def test_consistency_is_the_best_single_strand():
    truth = lines(([0, 0, 0], [0, 0, 40]))
    # 25 mm by one strand and 15 mm by another: the points within 2 mm of an end belong to both
    parts = lines(([0, 0, 0], [0, 0, 25]), ([0, 0, 25], [0, 0, 40]))
    scores = strand_scores(truth, parts)
    assert scores["strand"]["0.5/10"]["recall"] == 1.0
    assert scores["consistency"] == pytest.approx(26 / 40, abs=0.03)


def test_roots_and_points_inside_are_counted(ball):
    on = lines(([0, 0, 40], [0, 0, 60]))
    above = lines(([0, 0, 41], [0, 0, 60]))
    # from the surface 10 mm in, then back out: of 10 + 20 mm a third is inside
    into = Strands.from_polylines([np.array([[0, 0, 40], [0, 0, 30], [10, 0, 30], [10, 0, 20]], np.float32)])
    scores = head_scores(Strands.from_polylines([*on.polylines(), *above.polylines(), *into.polylines()]), ball)
    assert scores["roots_on_scalp"] == pytest.approx(2 / 3)
    # 20 + 19 millimetres outside, 30 inside but for the root
    assert scores["inside_head"] == pytest.approx(29 / 69, abs=0.03)


def test_drawing_strands_changes_little_and_is_repeatable():
    truth, result = waves(400), waves(400, seed=6)
    whole = strand_scores(truth, result)
    drawn = strand_scores(truth, result, queries=8000)
    assert drawn["asked"]["truth_points_asked"] < 9000 < whole["asked"]["truth_points_asked"]
    assert drawn == strand_scores(truth, result, queries=8000)
    assert drawn["strand"]["2/20"]["recall"] == pytest.approx(whole["strand"]["2/20"]["recall"], abs=0.05)


def test_empty_results_score_nothing():
    empty = Strands(np.zeros((0, 3), np.float32), np.zeros(1, np.int64))
    scores = evaluate(waves(10), empty)
    assert scores["voxel"]["1"]["iou"] == 0.0 and scores["strand"]["4/40"]["f"] == 0.0 and scores["consistency"] == 0.0


def test_orientation_and_centre_line_errors():
    truth = lines(([0, 0, 0], [0, 0, 40]))
    points = np.array([[0.3, 0, 10.0], [0.3, 0, 20.0], [0.3, 0, 30.0], [9.0, 0, 20.0]])
    angle = np.radians(12.0)
    directions = np.tile([np.sin(angle), 0, -np.cos(angle)], (4, 1))
    error = orientation_error(points, directions, truth)
    assert error["median"] == pytest.approx(12.0, abs=1e-3) and error["compared"] == 0.75
    shifted = lines(([0.3, 0.4, 0.13], [0.3, 0.4, 39]))
    assert centre_line_error(shifted, truth)["median"] == pytest.approx(0.5, abs=1e-3)


def test_direction_is_the_share_of_length_that_runs_as_the_truth_does():
    truth = lines(([0, 0, 0], [0, 0, 40]), ([20, 0, 0], [20, 0, 40]))
    # 30 mm the right way, 10 mm the wrong one, 40 mm with nothing near, 40 mm across the truth
    result = lines(
        ([0.5, 0, 5], [0.5, 0, 35]),
        ([20, 0.5, 30], [20, 0.5, 20]),
        ([50, 0, 0], [50, 0, 40]),
        ([-20, 0, 20], [19, 0, 20]),
    )
    share = direction_share(result, truth)
    assert share["right"] == pytest.approx(0.75, abs=0.03)
    assert share["compared"] == pytest.approx(40 / 119, abs=0.02)
    assert direction_share(truth, truth) == {"right": 1.0, "compared": 1.0}
    assert direction_share(truth.reversed(), truth)["right"] == 0.0


def test_rooted_length_weighs_strands_by_length(ball):
    # 60 mm from the scalp, 30 mm that starts 2 mm over it
    strands = lines(([0, 0, 40], [0, 0, 100]), ([0, 42, 0.5], [0, 72, 0.5]))
    assert rooted_length(strands, ball) == pytest.approx(60 / 90, abs=1e-3)
    assert rooted_length(strands.select(np.zeros(0, np.int64)), ball) == 0.0


def test_registration_error_is_the_scalps_distance(ball):
    assert registration_error(ball, ball)["median"] < 1e-3
    # a scalp grown by a twentieth lies 2 mm out everywhere
    larger = ball.transformed(np.diag([1.05, 1.05, 1.05, 1.0]))
    error = registration_error(larger, ball)
    assert error["median"] == pytest.approx(2.0, abs=0.05) and error["p90"] == pytest.approx(2.0, abs=0.05)
    assert error["beyond"] == pytest.approx(2.0, abs=0.05)


def test_coverage_is_the_share_of_hair_with_a_strand_near():
    density = np.zeros((64, 16, 16), np.float32)
    density[4:60, 8, 8] = 1.0
    volume = BrickVolume.from_dense(density, 1.0)
    guide = lines(([4, 8, 8], [31.5, 8, 8]))
    assert coverage(guide, volume, 0.5, 1.0) == pytest.approx(0.5, abs=0.02)


def test_hair_is_kept_where_the_density_is_not_cleared():
    density = np.ones((64, 16, 16), np.float32)
    density[:20] = 0.0
    volume = BrickVolume.from_dense(density, 1.0)
    assert hair_kept(lines(([4, 8, 8], [36, 8, 8])), volume) == pytest.approx(0.5, abs=0.05)
    assert hair_kept(lines(([24, 8, 8], [60, 8, 8])), volume) == 1.0


def test_strands_fit_their_own_noisy_scan_and_no_other():
    strands = waves(60)
    clean = render_density(strands, 0.8, 0.85)
    noise = np.random.default_rng(1).normal(size=clean.bricks.shape).astype(np.float32) * (130 / 4)
    scan = BrickVolume(clean.table, clean.bricks * np.float32(130 / strand_peak(0.85)) + noise, 0.8, clean.origin)
    assert scan_scores(strands, scan, 130.0)["iou"] > 0.8
    assert scan_scores(waves(60, seed=9), scan, 130.0)["iou"] < 0.4
