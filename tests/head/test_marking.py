"""A scalp for a head that has none marked: where the roots of its hair are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ct2hair_addon.errors import HeadError
from ct2hair_addon.head import Head, mark_scalp


def test_the_scalp_is_where_the_roots_are(ball, ball_queries):
    roots = ball_queries.sample_scalp(4000, 0).position
    roots = roots[roots[:, 2] > 25.0]
    bare = replace(ball, scalp=np.zeros(len(ball.vertices), bool))
    marked = mark_scalp(bare, roots)
    assert marked.scalp[ball.vertices[:, 2] > 27.0].all() and not marked.scalp[ball.vertices[:, 2] < 10.0].any()
    assert Head(marked).closest_scalp(roots).distance.max() < 0.01
    assert np.isfinite(marked.uv[marked.scalp]).all()


def test_roots_of_another_head_are_refused(ball, ball_queries):
    with pytest.raises(HeadError, match=r"roots lie \d+ mm from the mesh .*same coordinates, in mm"):
        mark_scalp(ball, ball_queries.sample_scalp(500, 0).position + [0, 0, 300])
