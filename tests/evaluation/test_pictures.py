"""Pictures of strands by hand: what is drawn lies where the camera sees it."""

import numpy as np

from ct2hair_addon.evaluation import strip_picture
from ct2hair_addon.evaluation.pictures import ENLARGED
from ct2hair_addon.strands import Strands

P = 100


def drawn(picture: np.ndarray, empty: np.ndarray) -> np.ndarray:
    """(P, P) bool: pixels that aren't as in a picture of nothing."""
    return (picture != empty).any(axis=2)


def test_a_strip_shows_each_set_whole_and_a_part_of_it_larger():
    # seen from the left: the picture's right is y, its up z
    across = Strands.from_polylines([[[0.0, -50.0, 0.0], [0.0, 50.0, 0.0]]])
    short = Strands.from_polylines([[[0.0, 0.0, -6.0], [0.0, 0.0, 6.0]]])
    picture = strip_picture([across, short, Strands.from_polylines([])], np.eye(4), pixels=P)
    assert picture.shape == (2 * P, 3 * P, 3) and picture.dtype == np.uint8
    views = [np.split(row, 3, axis=1) for row in np.split(picture, 2)]
    assert all((empty == empty[0, 0]).all() for *_, empty in views)
    whole, part = ([drawn(view, row[2]) for view in row] for row in views)
    pixel = 2 * 0.52 * 100.0 / P
    assert abs(whole[0].sum() - 100.0 / pixel) <= 3 and np.ptp(np.nonzero(whole[0])[0]) <= 1
    assert abs(whole[1].sum() - 12.0 / pixel) <= 2 and np.ptp(np.nonzero(whole[1])[1]) <= 1
    assert part[0].any(axis=0).all()  # longer than what is seen of it
    assert abs(part[1].sum() - 12.0 * ENLARGED / pixel) <= 3


def test_what_lies_nearer_hides_what_lies_behind():
    # from the left, +x to the wearer's left, is nearer
    steps = np.arange(-10.0, 10.0, 0.05)
    near, far = [[[5.0, -10.0, z], [5.0, 10.0, z]] for z in steps], [[[-5.0, y, -10.0], [-5.0, y, 10.0]] for y in steps]
    sets = [Strands.from_polylines(lines) for lines in (near, near + far, far)]
    whole = np.split(strip_picture(sets, np.eye(4), pixels=P)[:P], 3, axis=1)
    assert drawn(whole[0], whole[0][0, 0]).mean() > 0.8
    alone, both, behind = (view[20:80, 20:80] for view in whole)  # not their edges, which what lies behind them shades
    np.testing.assert_array_equal(alone, both)
    assert (alone != behind).mean() > 0.5
