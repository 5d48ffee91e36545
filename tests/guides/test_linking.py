"""Joining segments: the assignment is the best there is, hops are undone, gaps bridged, curls kept apart by their bend."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import min_weight_full_bipartite_matching

from ct2hair_addon.evaluation import render_density, strand_peak
from ct2hair_addon.guides import joints, linking
from ct2hair_addon.guides.assignment import BID, assign
from ct2hair_addon.guides.joints import meeting_ends, weighed_joints
from ct2hair_addon.guides.linking import link_segments
from ct2hair_addon.guides.pieces import cut_segments
from ct2hair_addon.strands import Strands

SPACING, BLUR = 0.4, 0.85
SEEN = strand_peak(BLUR) * BLUR**2 / (BLUR**2 + 1.0 / 6.0)


def joined(lines, truth, rooted=(), **known):
    """The chains of directed lines (mm) in a scan of the `truth`; `rooted`: those that begin on the scalp."""
    density = render_density(Strands.from_polylines(truth), SPACING, BLUR)
    pieces = cut_segments(Strands.from_polylines(lines), SPACING)
    fine = np.isin(np.arange(len(lines)), rooted).astype(np.int8)
    return link_segments(pieces, pieces.ends(fine) != 0, density, SEEN, **known)


def crossing():
    """Two strands that touch in the middle, 60 mm long, 0.1 mm apart there and 7 mm at the ends."""
    x = np.arange(0.0, 60.0, 0.25)
    rise = 0.05 + 0.12 * np.sqrt((x - 30.0) ** 2 + 4.0) - 0.24
    one = np.stack([x, rise * np.sign(x - 30.0), 0.0 * x], axis=1)
    return one, one * [1.0, -1.0, 1.0]


def farthest(chain, truth):
    """The largest distance (mm) of a chain's points from a true strand."""
    return np.linalg.norm(chain[:, None] - truth[None], axis=2).min(axis=1).max()


@pytest.mark.parametrize("prices", [(20.0,), (2.0, 7.0, 8.0, 20.0)])
@pytest.mark.parametrize(("rows", "seed"), [(6, 0), (40, 1), (400, 2), (3000, 3)])
def test_the_assignment_is_the_cheapest(rows, seed, prices):
    """To BID a row, at once, and going on from what was cheapest when a row without a column cost less."""
    generator, loose = np.random.default_rng(seed), prices[-1]
    key = np.unique(generator.integers(0, rows * rows, 6 * rows))
    row, column = key // rows, key % rows
    cost = generator.uniform(0, 30, len(key))
    starts, chosen = np.searchsorted(row, np.arange(rows + 1)), np.empty(rows, np.int64)
    assert assign(starts, column, cost, dict.fromkeys(prices, 0), chosen) == loose
    has = np.flatnonzero(chosen >= 0)
    assert len(np.unique(chosen[has])) == len(has)
    found = cost[np.searchsorted(key, has * rows + chosen[has])].sum() + loose * (rows - len(has))
    # the same by scipy, which wants a column for each row and no cost of 0
    entries = np.append(cost, np.full(rows, loose)) + 1.0
    places = np.append(row, np.arange(rows)), np.append(column, rows + np.arange(rows))
    graph = coo_matrix((entries, places), shape=(rows, 2 * rows)).tocsr()
    best = np.asarray(graph[min_weight_full_bipartite_matching(graph)]).sum() - rows
    assert best - 1e-3 < found < best + BID * rows
    assert found == pytest.approx(best, rel=1e-4)


def test_the_price_of_a_loose_row_is_the_first_that_leaves_few_enough():
    # row 0 has only a dear column, row 1 a cheap one, row 2 none
    starts, columns, costs = np.array([0, 1, 2, 2]), np.array([0, 1]), np.array([15.0, 3.0])
    for most, price, expected in ((3, 2.0, [-1, -1, -1]), (2, 10.0, [-1, 1, -1]), (1, 20.0, [0, 1, -1]), (0, 20.0, [0, 1, -1])):
        chosen = np.empty(3, np.int64)
        assert assign(starts, columns, costs, dict.fromkeys((2.0, 10.0, 20.0), most), chosen) == price
        assert chosen.tolist() == expected


def test_where_it_is_known_how_many_strands_there_are_joints_are_as_dear_as_need_be(monkeypatch):
    """Three ends that one strand may run through, the second gap longer, farther aside and with a kink."""
    x = np.arange(0.0, 20.0, 0.25)[:, None]
    along, bent = x * [1.0, 0, 0], x * [np.cos(0.6), np.sin(0.6), 0]
    lines = [along, along + [25.75, 1.2, 0.0], bent + [55.5, 4.2, 0.0]]
    monkeypatch.setattr(linking, "LOOSE_ENDS", (12.0, 15.0, 25.0))
    monkeypatch.setattr(linking, "LOWEST", 8.0)
    for known, price in ((4, 8), (3, 12), (2, 15), (1, 25)):
        chains, _, _, tally = joined(lines, lines, known=known)
        assert len(chains) == min(known, 3) and tally["dearest joint allowed"] == price
    assert len(joined(lines, lines)[0]) == 1, "where it is not known, the usual price"
    for known in (1, 4):
        chains, _, _, tally = joined(lines, lines, known=known, at_least=True)
        assert len(chains) == 3 and tally["dearest joint allowed"] == 12, "there may be more strands: one price"


def test_a_gap_is_bridged_along_the_bend():
    angle = np.linspace(0, 2.0, 200)
    arc = 20.0 * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    chains, rooted, bridged, tally = joined([arc[:90], arc[110:]], [arc], rooted=[0])
    assert len(chains) == 1 and rooted.tolist() == [True] and tally["joints made"] == 1
    assert farthest(chains.points, arc) < 0.15
    assert chains.lengths()[0] == pytest.approx(40.0, rel=0.02)
    assert 3.0 < bridged[0] < 12.0


def coil(turns, radius=3.2, pitch=4.0):
    """A helix, mm: 8 voxels of radius, about which hair turns right after its root in the tightest curls."""
    angle = np.arange(0.0, 2.0 * np.pi * turns, 0.25 / radius)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), pitch / (2.0 * np.pi) * angle], axis=1)


def test_a_gap_in_a_coil_is_bridged_around_it():
    """A radian and a half of it: straight on from both ends lies 4 mm beside."""
    whole = coil(3.0)
    chains, _, bridged, tally = joined([whole[:90], whole[110:]], [whole], rooted=[0])
    assert len(chains) == 1 and tally["joints made"] == 1
    assert farthest(chains.points, whole) < 0.4
    assert 4.0 < bridged[0] < 6.0


def test_a_coil_costs_little_more_to_go_on_in_than_straight_hair():
    """Along parabolas nothing was found 5 mm ahead, which is 12 voxels and half again a radian."""
    whole, straight = coil(3.0), np.arange(0.0, 60.0, 0.25)[:, None] * [1.0, 0.0, 0.0]
    for gap in (8, 20):
        cost = []
        for line in (straight, whole):
            pieces = Strands.from_polylines([line[:90], line[90 + gap :]]).resampled_by_step(SPACING)
            density = render_density(Strands.from_polylines([line]), SPACING, BLUR)
            none = np.full(2, -1)
            found = weighed_joints(pieces, np.zeros(2, bool), none, density, SEEN, 60.0)
            cost.append(found.cost[(found.tip == 0) & (found.root == 1)].min())
        assert cost[1] < cost[0] + 4.0


def test_two_that_do_not_go_on_in_each_other_stay_apart():
    x = np.arange(0.0, 20.0, 0.25)[:, None]
    one, other = x * [1.0, 0, 0], [30.0, 0, 0] + x * [0, 1.0, 0]
    far = [25.0, 8.0, 0] + x * [1.0, 0, 0]
    chains, _, bridged, _ = joined([one, other, far], [one, other, far])
    assert len(chains) == 3 and not bridged.any()


def test_a_trace_that_hopped_is_cut_and_each_strand_gets_its_own():
    """A trace that changed strands at the contact, the other strand's halves loose beside it: two whole strands come out."""
    one, other = crossing()
    middle = len(one) // 2
    hopped = np.concatenate([one[:middle], other[middle:]])
    chains, rooted, _, _ = joined([hopped, other[: middle - 6], one[middle + 6 :]], [one, other], rooted=[0, 1])
    whole = np.flatnonzero(chains.lengths() > 50.0)
    assert len(whole) == 2 and rooted[whole].all()
    # none of the loose ends is left
    assert len(chains) == 2


def test_of_each_tip_the_cheapest_joints_are_held(monkeypatch):
    """A bundle that is cut through: each tip may go on in many root ends; one strand in it has a cut of its own to heal."""
    generator = np.random.default_rng(5)
    x = np.arange(0.0, 16.0, 0.25)[:, None]
    places = np.concatenate([np.zeros((40, 1)), generator.uniform(0.0, 3.0, (40, 2))], axis=1)
    lines = [place + x * [1.0, 0, 0] + shift for shift in ([0.0, 0, 0], [17.0, 0, 0]) for place in places]
    density = render_density(Strands.from_polylines(lines), SPACING, BLUR)
    strands = Strands.from_polylines(lines).resampled_by_step(SPACING)
    onward = np.full(len(lines), -1)
    onward[3] = 60  # no neighbour of its own place: dear, and yet kept

    def found():
        return weighed_joints(strands, np.zeros(len(lines), bool), onward, density, SEEN, 30.0)

    whole = found()
    many = np.bincount(whole.tip, minlength=len(lines))
    assert many[:40].max() <= joints.HELD and np.median(many[:40]) > 8
    assert (np.diff(whole.tip * len(lines) + whole.root) > 0).all(), "each pair once, in order"
    monkeypatch.setattr(joints, "BLOCK", 7)
    for field in ("tip", "root", "cut", "cost"):
        np.testing.assert_array_equal(getattr(found(), field), getattr(whole, field))
    monkeypatch.setattr(joints, "HELD", 5)
    few = found()
    for tip in range(40):
        of_all, of_few = whole.tip == tip, few.tip == tip
        if tip == 3:
            assert 60 in few.root[of_few] and of_few.sum() == 5
            healed = of_few & (few.root == 60)
            assert few.cut[healed].tolist() == [[0, 0]]
            of_all, of_few = of_all & (whole.root != 60), of_few & (few.root != 60)
        cheapest = np.sort(whole.cost[of_all])[: 4 if tip == 3 else 5]
        np.testing.assert_array_equal(np.sort(few.cost[of_few]), cheapest)


def test_a_curl_that_turns_over_at_once_is_cut_there():
    angle = np.linspace(0, 3.0, 160)
    arc = 6.0 * np.stack([np.sin(angle), 1.0 - np.cos(angle), 0.3 * angle], axis=1)
    over = arc[-1] + (arc[-1] - arc[::-1])  # bends the other way from its end on
    pieces = cut_segments(Strands.from_polylines([np.concatenate([arc, over[1:]])]), SPACING)
    assert len(pieces.strands) == 2 and pieces.onward.tolist() == [1, -1]
    np.testing.assert_allclose(pieces.strands.roots[1], arc[-1], atol=1.0)
    assert len(cut_segments(Strands.from_polylines([arc]), SPACING).strands) == 1
    assert len(cut_segments(Strands.from_polylines([coil(4.0)]), SPACING).strands) == 1, "its bend turns on, as it did"


def test_of_those_beside_an_end_the_nearest_is_cut():
    x = np.arange(0.0, 40.0, 0.25)[:, None]
    near, far, short = x * [1.0, 0, 0], [0.0, 1.0, 0] + x * [1.0, 0, 0], [14.0, 0.4, 0] + x[:50] * [1.0, 0, 0]
    pieces = cut_segments(Strands.from_polylines([far, near, short]), SPACING)
    assert pieces.parent.tolist() == [0, 1, 1, 1, 2]
    np.testing.assert_allclose(pieces.strands.roots[2:4, 0], [14.0, 14.0 + x[49, 0]], atol=SPACING)


def test_pieces_turned_against_each_other_do_not_go_on_in_each_other():
    x = np.arange(0.0, 40.0, 0.25)[:, None]
    line, beside = x * [1.0, 0, 0], [20.0, 0.5, 0] + x[:40] * [1.0, 0, 0]
    pieces = cut_segments(Strands.from_polylines([line, beside]), SPACING)
    cut = int((pieces.parent == 0).sum())
    assert cut >= 2 and pieces.onward[:cut].tolist() == [*range(1, cut), -1]
    back = np.ones(len(pieces.parent), bool)
    turned = pieces.turned(back)
    assert turned.onward[:cut].tolist() == [-1, *range(cut - 1)]
    np.testing.assert_array_equal(turned.strands.roots[1], pieces.strands.tips[1])
    back[0] = False
    assert pieces.turned(back).onward[:cut].tolist() == [-1, -1, *range(1, cut - 1)]
    # the root of the whole is that of its first piece, or the last one's tip
    assert pieces.ends(np.array([1, 0], np.int8))[:cut].tolist() == [1] + [0] * (cut - 1)
    assert pieces.ends(np.array([-1, 0], np.int8))[:cut].tolist() == [0] * (cut - 1) + [-1]


def test_pieces_cut_go_on_in_what_is_cut_off():
    x = np.arange(0.0, 40.0, 0.25)[:, None]
    line, beside = x * [1.0, 0, 0], [20.0, 0.5, 0] + x[:40] * [1.0, 0, 0]
    pieces = cut_segments(Strands.from_polylines([line, beside]), SPACING)
    count, chain = len(pieces.strands), int((pieces.parent == 0).sum())
    place = pieces.strands.offsets[[0, 1, count - 1]] + [10, 15, 8]
    cut = pieces.cut(place)
    assert cut.onward.tolist() == [*range(1, chain + 2), -1, chain + 3, -1]
    assert cut.parent.tolist() == [0] * (chain + 2) + [1] * 2
    np.testing.assert_array_equal(cut.strands.points, pieces.strands.points)
    np.testing.assert_array_equal(cut.strands.roots[[1, 3]], pieces.strands.points[place[:2]])
    same = pieces.cut(place[:0])
    assert same.onward.tolist() == pieces.onward.tolist() and same.parent.tolist() == pieces.parent.tolist()


def test_ends_that_meet_say_whether_they_run_the_same_way():
    angle = np.linspace(0, 2.0, 200)
    arc = 20.0 * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    density = render_density(Strands.from_polylines([arc]), SPACING, BLUR)
    for second, expected in ((arc[105:], 1.0), (arc[:104:-1], -1.0)):
        pieces = cut_segments(Strands.from_polylines([arc[:95], second]), SPACING)
        pairs, sign, cost = meeting_ends(pieces, density, SEEN)
        assert sorted(pairs[0]) == [0, 1] and sign.tolist() == [expected] and cost[0] < 5.0
