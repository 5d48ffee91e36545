"""From segments to rooted strands on a ball of a head: fine and poor, directions, growing, roots on the scalp."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from ct2hair_addon.evaluation import render_density
from ct2hair_addon.guides import Habit, direction, root_segments
from ct2hair_addon.guides.direction import cut_where_turned, fine_ends, neighbour_votes, roots_seen, signs
from ct2hair_addon.guides.growing import follow_to_scalp, grow_to_root
from ct2hair_addon.guides.pieces import cut_segments
from ct2hair_addon.guides.roots import lead_into_scalp, push_out
from ct2hair_addon.head import Head
from ct2hair_addon.settings import GuideSettings
from ct2hair_addon.strands import Strands

RADIUS = 80.0


@pytest.fixture(scope="module")
def ball(make_ball) -> Head:
    """A sphere whose upper half is scalp."""
    return Head(make_ball(RADIUS, 10.0, sides=80))


def hair(azimuth: float, start: float, end: float, lift=0.5) -> np.ndarray:
    """A stretch [start, end] mm of a hair that leaves the ball at 45 degrees up and hangs over outwards."""
    s = np.arange(start, end, 0.5)
    outwards = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    root = RADIUS * (np.cos(np.pi / 4) * outwards + [0, 0, np.sin(np.pi / 4)])
    away = root / RADIUS
    return root + s[:, None] * away + (s**2 * 0.004)[:, None] * (outwards - [0, 0, 1.0])


def votes_of(strands: Strands) -> direction.Votes:
    return neighbour_votes(strands, GuideSettings().neighbour_radius)


def test_a_long_segment_from_the_scalp_is_fine_and_a_far_one_poor(ball):
    lines = [hair(0.0, 2, 90), hair(0.1, 2, 90)[::-1], hair(0.2, 30, 90), hair(0.3, 5, 25), hair(0.4, 2, 12)]
    strands = Strands.from_polylines(lines)
    assert fine_ends(strands, ball, GuideSettings()).tolist() == [1, -1, 0, 0, 1]


def test_poor_segments_take_the_direction_of_their_neighbours(ball):
    lines = [hair(a, 2, 80) for a in np.linspace(0, 0.3, 12)]
    lines += [hair(a, 30, 70)[:: (-1 if n % 2 else 1)] for n, a in enumerate(np.linspace(0.01, 0.29, 11))]
    strands = Strands.from_polylines(lines)
    fine = fine_ends(strands, ball, GuideSettings())
    value = signs(strands, fine, ball, roots_seen(strands, fine, ball), votes_of(strands))
    assert (value[:12] > 0).all()
    assert (np.sign(value[12:]) == [-1 if n % 2 else 1 for n in range(11)]).all()


def test_what_crosses_at_an_angle_has_no_say_against_what_runs_alongside(ball):
    """In curls most of the nearest hair crosses: many hairs at 35 degrees, one after the other, and two alongside."""
    along = np.arange(0.0, 40.1, 0.5)[:, None] * [0.0, 0.0, 1.0] + [0.0, 0.0, RADIUS + 20.0]
    t = np.arange(-12.0, 12.1, 0.5)[:, None]
    slope = np.radians(35.0)
    across = t * [0.0, np.sin(slope), -np.cos(slope)] + [0.2, 0.0, RADIUS + 20.0]
    crossing = [across + [0.0, 0.0, z] for z in np.arange(0.0, 40.0)]
    strands = Strands.from_polylines([along, along + [1.5, 0.0, 0.0], along - [1.5, 0.0, 0.0], *crossing])
    known = np.array([0, 1, 1, *[1] * len(crossing)], np.int8)
    assert signs(strands, known, ball, True, votes_of(strands))[0] > 0.1


def test_what_stands_alone_goes_by_its_climb_the_surer_the_more_that_is_worth_in_the_wig(ball):
    """Where all hair runs away from the head, and where that of one tuft in three is known to run towards it."""
    lines = [hair(0.4 * n, 2, 60) for n in range(12)] + [hair(0.4 * n + 0.01, 5, 60) for n in range(12)] + [hair(0.2, 20, 60)]
    strands, votes = Strands.from_polylines(lines), votes_of(Strands.from_polylines(lines))
    assert votes.bonds[24].nnz == 0
    alone = []
    for falling in (0, 4):
        fine = np.array([-1] * falling + [1] * (12 - falling) + [0] * 13, np.int8)
        value = signs(strands, fine, ball, True, votes)
        assert (np.sign(value[12:24]) == fine[:12]).all()
        alone.append(value[24])
    assert alone[0] > 0.5 > alone[1] > 0.0


def test_the_worth_of_a_climb_is_the_slope_of_its_log_odds():
    generator = np.random.default_rng(0)
    climb, lengths = generator.uniform(-1.0, 1.0, 40_000), generator.uniform(1.0, 60.0, 40_000)
    for slope in (0.0, 3.0, 9.0):
        sign = np.where(generator.random(40_000) < 1.0 / (1.0 + np.exp(-slope * climb)), 1.0, -1.0)
        assert direction._worth(climb, sign, lengths) == pytest.approx(slope, abs=0.05 * slope + 0.06)
    assert direction._worth(climb, np.sign(climb), lengths) > 0.8 * direction.WORTH
    assert direction._worth(climb, -np.sign(climb), lengths) == 0.0
    assert direction._worth(climb[:0], climb[:0], lengths[:0]) <= direction.WORTH


def test_a_trace_that_goes_over_to_hair_that_runs_the_other_way_is_cut_there(ball):
    """Two tufts whose tips meet head-on, and a trace through both; one that stays in its own is left whole."""
    x = np.arange(0.0, 80.1, 0.4)[:, None] * [1.0, 0.0, 0.0]
    beside = [[0.0, 1.1 * n, 0.0] for n in (-3, -2, -1, 1, 2, 3)]
    tufts = [x[:100] + over for over in beside] + [x[:99:-1] + over for over in beside]
    lines = [line + [0.0, 0.0, RADIUS + 20.0] for line in [x, x[:100] + [0.0, 0.0, 1.1], *tufts]]
    pieces = cut_segments(Strands.from_polylines(lines), 0.4)
    assert pieces.parent.tolist() == [*range(14)]
    fine = np.array([0, 0] + [1] * 12, np.int8)
    votes = votes_of(pieces.strands)
    value = signs(pieces.strands, fine, ball, True, votes)
    cut, heard = cut_where_turned(pieces, value, votes)
    assert cut.parent.tolist() == [0, *range(14)] and cut.onward.tolist() == [1] + [-1] * 14
    assert cut.strands.roots[1, 0] == pytest.approx(40.0, abs=1.5)
    # what was heard is the same, and is now heard by one part or the other
    assert len(heard.strand) == len(votes.strand)
    onto = np.zeros((15, 14))
    onto[np.arange(15), cut.parent] = 1.0
    np.testing.assert_allclose(onto.T @ heard.bonds.toarray() @ onto, votes.bonds.toarray(), atol=1e-4)
    told = signs(cut.strands, cut.ends(fine), ball, True, heard)
    assert told[0] > 0.5 and told[1] < -0.5
    turned = cut.turned(told < 0)
    assert turned.onward.tolist() == [-1] * 15
    whole, same = cut_where_turned(cut, told, heard)
    assert len(whole.strands) == 15 and (same.bonds != heard.bonds).nnz == 0


def coiled(azimuth: float, lands: bool) -> np.ndarray:
    """A hair that lies on the ball from near its top on, rises off it, and ends high or comes down on the scalp steeply."""
    s = np.arange(0.0, 110.0, 0.5)
    polar = 0.2 + np.minimum(s, 80.0) / (RADIUS + 10.0)
    over = 1.5 + 22.0 * np.clip((s - 20.0) / 30.0, 0.0, 1.0) ** 2
    over -= np.clip(s - 80.0, 0.0, 22.0) if lands else 0.0
    polar += 0.002 * np.clip(s - 80.0, 0.0, None) if lands else np.clip(s - 80.0, 0.0, None) / (RADIUS + 20.0)
    outwards = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    return (RADIUS + over)[:, None] * (np.sin(polar)[:, None] * outwards + np.cos(polar)[:, None] * [0, 0, 1.0])


def test_where_hair_lies_flat_and_comes_back_to_the_scalp_all_of_it_together_tells_its_roots(ball):
    generator = np.random.default_rng(5)
    pieces, turned = [], []
    for n in range(40):
        cuts = np.sort(generator.integers(20, 190, 2))
        for part in np.split(coiled(0.05 * n, lands=n % 3 == 0), cuts):
            turned.append(generator.random() < 0.5)
            pieces.append(part[::-1] if turned[-1] else part)
    strands = Strands.from_polylines(pieces)
    fine = fine_ends(strands, ball, GuideSettings())
    true = np.where(turned, -1, 1)
    assert (fine * true < 0).sum() > 3 * (fine * true > 0).sum()  # tips that land look like roots, and roots don't
    value = signs(strands, fine, ball, roots_seen(strands, fine, ball), votes_of(strands))
    assert np.mean(np.sign(value) == true) > 0.97
    # fitted guides have been led to the scalp, and their roots are no more to be trusted: it is said which wig it is
    assert not roots_seen(strands, fine, ball)
    landed = "seemingly rooted pieces that run the other way"
    for habit in (Habit(seen=True, followed=7.0), Habit(seen=False, followed=7.0), None):
        _, tally, told = root_segments(strands, 0.4, ball, GuideSettings(), habit=habit)
        assert (tally[landed] > 0) == (habit is None or not habit.seen)
        assert told == habit or (habit is None and not told.seen)


def test_growing_follows_the_neighbours_in_rounds(ball):
    # Each hair is farther from the only rooted one: the last is out of its reach, not out of its neighbours'.
    lines = [hair(0.0, 2, 80)] + [hair(0.025 * n, 40, 80) for n in range(1, 6)] + [hair(2.5, 40, 80)]
    strands = Strands.from_polylines(lines)
    grown, reached, added = grow_to_root(strands, np.arange(7) == 0, GuideSettings())
    assert reached.tolist() == [True] * 6 + [False]
    np.testing.assert_allclose(added[1:6], 38, atol=4)
    scalp = ball.closest_scalp(grown.roots[:6])
    assert scalp.distance.max() < 5
    np.testing.assert_array_equal(grown.tips, strands.tips)


def test_what_grows_comes_close_to_the_hair_that_it_follows(ball):
    fine, far = hair(0.0, 2, 80), hair(0.035, 60, 80)
    strands = Strands.from_polylines([fine, far])
    grown, reached, added = grow_to_root(strands, np.array([True, False]), GuideSettings())
    line = grown.polylines()[1]
    beside = cKDTree(fine).query(line)[0]
    assert reached.all() and added[1] == pytest.approx(60, abs=4)
    made = beside[: -len(far)]
    assert cKDTree(fine).query(far[:1])[0] > 3.0, "it begins too far from any hair"
    assert made[: len(made) // 3].max() < 1.1 and made[-1] > 2.5
    assert np.linalg.norm(np.diff(line, axis=0), axis=1).max() < 1.2, "and it comes there smoothly"


def lying(azimuth: float, start: float, end: float, over=0.0) -> np.ndarray:
    """A stretch of hair that lies on the ball from near its top down, and rises by 1 mm in 20."""
    s = np.arange(start, end, 0.5)
    polar, radius = 0.3 + s / RADIUS, RADIUS + 1.0 + over + 0.05 * s
    outwards = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    return radius[:, None] * (np.sin(polar)[:, None] * outwards + np.cos(polar)[:, None] * [0, 0, 1.0])


def test_hair_that_begins_over_others_is_followed_back_beside_them(ball):
    lines = [lying(0.03 * n, 0.0, 60.0) for n in range(12)]
    late = [lying(0.03 * n + 0.015, 40.0, 60.0, over=0.3) for n in range(2, 10, 3)]
    strands = Strands.from_polylines([*lines, *late])
    followed, low, walked = follow_to_scalp(strands, ball, 2.0)
    assert low.all() and (walked[:12] == 0).all()
    np.testing.assert_allclose(walked[12:], 26.0, atol=4.0)  # from 3.3 mm down to 2
    np.testing.assert_array_equal(followed.tips, strands.tips)
    for n, line in enumerate(followed.select(np.arange(12, 15)).polylines()):
        assert np.degrees(np.arctan2(line[0, 1], line[0, 0])) == pytest.approx(np.degrees(0.03 * (3 * n + 2) + 0.015), abs=1.5)


def test_hair_with_none_around_is_not_followed(ball):
    strands = Strands.from_polylines([hair(0.0, 1.0, 80), hair(2.0, 30.0, 80)])
    followed, low, walked = follow_to_scalp(strands, ball, 2.0)
    assert low.tolist() == [True, False] and not walked.any()
    np.testing.assert_array_equal(followed.points, strands.points)


def test_the_lead_starts_on_the_scalp_and_goes_on_smoothly(ball):
    strands = Strands.from_polylines([hair(a, 6, 60) for a in np.linspace(0, 6, 40)])
    led, tied, late = lead_into_scalp(strands, ball)
    added = led.lengths() - strands.lengths()
    assert tied == late == 0
    assert ball.closest_scalp(led.roots).distance.max() < 1e-3
    assert (added > 4).all() and (added < 12).all()
    for line in led.resampled_by_step(1.0).polylines():
        steps = np.diff(line, axis=0)
        steps /= np.linalg.norm(steps, axis=1, keepdims=True)
        assert (steps[1:] * steps[:-1]).sum(1).min() > np.cos(np.radians(25))


def test_points_inside_are_pushed_out(ball):
    line = np.stack([np.linspace(-40, 40, 80), np.zeros(80), np.full(80, 75.0)], 1)
    out, count = push_out(Strands.from_polylines([line]), ball)
    assert count > 40
    assert ball.signed_distance(out.points[1:]).min() > 0


def test_rooted_strands_have_all_that_is_promised(ball):
    rng = np.random.default_rng(0)
    lines = [hair(a, 2, 80) for a in np.linspace(0, 1, 60)]
    lines += [hair(a, 30, 75)[:: rng.choice([-1, 1])] for a in rng.uniform(0, 1, 40)] + [hair(3.0, 40, 60)]
    guides, tally, _ = root_segments(Strands.from_polylines(lines), 0.4, ball, GuideSettings())
    assert len(guides) == 100 and tally["dropped: no rooted hair near"] == 1
    root = ball.closest_scalp(guides.roots)
    assert root.distance.max() < 0.05
    np.testing.assert_allclose(guides.strand_attributes["root_uv"], root.uv, atol=1e-5)
    support = guides.strand_attributes["support"]
    assert support.dtype == np.float32 and support.min() > 0.4 and support.max() <= 1
    assert support[:60].min() > support[60:].max()
    inner = np.ones(len(guides.points), bool)
    inner[guides.offsets[:-1]] = False
    assert ball.signed_distance(guides.points[inner]).min() > 0
    assert guides.tips[:, 2].max() < guides.roots[:, 2].min() + 80
    assert (np.linalg.norm(guides.tips, axis=1) > np.linalg.norm(guides.roots, axis=1)).all()


@pytest.mark.parametrize(("counted", "known", "price"), [(True, 60, 14), (False, 0, 30)])
def test_knots_say_how_many_strands_there_are_only_where_all_of_them_are_found(ball, counted, known, price):
    lines = [hair(a, 2, 40) for a in np.linspace(0, 6, 60)]
    knots = np.array([hair(a, 0, 1)[0] for a in np.linspace(0, 6, 60)])
    scan = render_density(Strands.from_polylines(lines), 1.0, 1.0)
    made = Strands.from_polylines(lines)
    guides, tally, _ = root_segments(made, 1.0, ball, GuideSettings(), scan=scan, strand=1.0, knots=knots, counted=counted)
    assert (tally["strands by the knots"], tally["dearest joint allowed"]) == (known, price)
    assert tally["roots at knots of the net"] == len(guides) == 60


def test_nothing_found_is_no_guides(ball):
    empty = Strands(np.zeros((0, 3), np.float32), np.zeros(1, np.int64))
    guides, tally, _ = root_segments(empty, 0.4, ball, GuideSettings())
    assert len(guides) == 0 and tally["guides"] == 0
    assert set(guides.strand_attributes) == {"support", "root_uv"}
