"""The hairstyles hold what they promise: rooted, outside the head, of sensible length and curl, the same for the same seed."""

import numpy as np
import pytest

from ct2hair_addon.errors import SettingsError
from ct2hair_addon.evaluation.hairstyles import STYLES, curl_radius, describe, hairstyle
from ct2hair_addon.evaluation.hairstyles.tied import TIED
from ct2hair_addon.head import Head, load_obj, mark_scalp, template_head
from ct2hair_addon.strand_files import read_strands
from ct2hair_addon.strands import Strands

COUNT = 300
INSIDE = -0.6
"""mm: deeper than this is inside the head; the lattice that hair is pushed out by is 1.5 mm wide, as ears are curved."""

LENGTHS = {
    "bangs": (170, 290), "blowout": (170, 270), "bob": (120, 220), "curly": (170, 320), "jewfro": (90, 240),
    "jheri_curl": (110, 230), "mop_top": (80, 190), "pixie": (30, 75), "wavy": (220, 340), "wings": (100, 200),
    "ponytail": (240, 400), "braid": (200, 480), "bun": (180, 400),
}  # fmt: skip
"""Bounds (mm) of the mean length."""

CURLS = {"curly": (4.0, 8.0), "jewfro": (4.0, 8.0), "jheri_curl": (4.0, 8.0)}
"""Bounds (mm) of the median radius of curls."""


@pytest.fixture(scope="module")
def head():
    return template_head()


@pytest.fixture(scope="module")
def surface(head):
    return Head(head)


@pytest.fixture(scope="module")
def made(head):
    kept = {}

    def make(name):
        if name not in kept:
            kept[name] = hairstyle(name, head, COUNT, 3)
        return kept[name]

    return make


@pytest.mark.parametrize("name", STYLES)
def test_hair_is_rooted_outside_the_head_and_of_sensible_length(name, made, surface):
    hair = made(name)
    assert len(hair) == COUNT
    assert np.isfinite(hair.points).all()
    check_on_head(hair, surface)
    low, high = LENGTHS[name]
    assert low < hair.lengths().mean() < high
    assert hair.lengths().min() > 4.0
    # no two strands alike, and no strand folded onto itself in a zigzag
    assert len(np.unique(hair.tips.round(2), axis=0)) == COUNT
    np.testing.assert_allclose(surface.on_scalp(hair.strand_attributes["root_uv"]).position, hair.roots, atol=0.2)


def check_on_head(hair, surface):
    assert surface.closest_scalp(hair.roots).distance.max() < 0.2
    distance = surface.signed_distance(hair.resampled_by_step(2.0).points)
    assert distance.min() > INSIDE
    assert (distance < -0.1).mean() < 0.001


@pytest.mark.parametrize("name", ["pixie", "braid"])
def test_the_seed_decides_and_nothing_else(name, made, head):
    hair = made(name)
    np.testing.assert_array_equal(hairstyle(name, head, COUNT, 3).points, hair.points)
    other = hairstyle(name, head, COUNT, 4)
    assert len(other) == COUNT
    assert np.abs(other.points - hair.points).max() > 1.0


@pytest.mark.parametrize("name", CURLS)
def test_curls_have_their_radius(name, made):
    low, high = CURLS[name]
    assert low < np.median(curl_radius(made(name))) < high


def test_curl_radius_of_a_known_helix():
    turn = np.linspace(0.0, 12.0 * np.pi, 400)
    helix = np.stack([5.0 * np.cos(turn), 5.0 * np.sin(turn), 20.0 * turn / (2.0 * np.pi)], axis=1)
    assert np.median(curl_radius(Strands.from_array(helix[None]), 1.0)) == pytest.approx(5.0, rel=0.03)


@pytest.mark.parametrize("name", TIED)
def test_tied_hair_has_room(name, head):
    """A full head of such hair would not pack its 0.08 mm strands closer than they fit."""
    count, cell = 6000, 4.0
    fine = hairstyle(name, head, count, 3).resampled_by_step(1.0)
    _, points = np.unique(np.floor(fine.points / cell), axis=0, return_counts=True)
    each = fine.lengths().sum() / len(fine.points)
    packed = points * each / cell**3 * 100_000 / count
    # by length: how much of the hair lies where more than 60 % is hair
    assert np.average(packed > 120.0, weights=points) < 0.16
    assert np.average(packed, weights=points) < 100.0


def test_a_tie_gathers_all_that_is_not_loose(made):
    hair = made("ponytail")
    behind = np.array([line[:, 1].max() for line in hair.polylines()])
    tied = behind > hair.roots[:, 1].max() + 20.0
    assert 0.9 < tied.mean() < 1.0


def test_unknown_names_and_bad_counts_are_refused(head):
    with pytest.raises(SettingsError, match="mullet"):
        hairstyle("mullet", head)
    with pytest.raises(SettingsError, match="at least 1"):
        hairstyle("bob", head, 0)


def test_every_style_says_what_it_is():
    assert all(describe(name).endswith(".") for name in STYLES)
    assert len({describe(name) for name in STYLES}) == len(STYLES) == 13


@pytest.mark.parametrize("name", ["bob", "ponytail"])
def test_on_the_head_of_sintel(name, shared_data):
    roots = read_strands(shared_data / "sintel" / "strands.data").roots
    head = mark_scalp(load_obj(shared_data / "sintel" / "head.obj", align=False, need_scalp=False), roots)
    check_other_head(name, head)


@pytest.mark.parametrize("name", ["wavy", "bun"])
def test_on_the_head_of_mpfb(name, shared_data):
    check_other_head(name, load_obj(shared_data / "mpfb_head" / "base.obj"))


def check_other_head(name, head):
    hair = hairstyle(name, head, COUNT, 1)
    assert len(hair) == COUNT
    check_on_head(hair, Head(head))
