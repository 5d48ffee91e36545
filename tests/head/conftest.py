"""The heads of these tests: the built-in mannequin, and a ball with every distance known."""

from __future__ import annotations

import pytest

from ct2hair_addon.head import Head, HeadMesh, template_head

RADIUS = 80.0


@pytest.fixture(scope="session")
def template() -> HeadMesh:
    return template_head()


@pytest.fixture(scope="session")
def template_queries(template) -> Head:
    return Head(template)


@pytest.fixture(scope="session")
def ball(make_ball) -> HeadMesh:
    """A ball of 80 mm, its scalp the upper half."""
    return make_ball(RADIUS)


@pytest.fixture(scope="session")
def ball_queries(ball) -> Head:
    return Head(ball)
