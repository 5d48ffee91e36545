"""How many strands a scan holds: its length of hair over that of one strand (in place of the paper's fixed 100,000)."""

from __future__ import annotations

import numpy as np

from ..progress import Progress, part, silent
from ..strands import Strands
from ..volume import BrickVolume
from ..volume.strand_signal import StrandProfile, data_floor, hair_mass, lone_profile, support_along

FEWEST, MOST = 100, 400_000
"""Bounds of the estimate: a human scalp has 80,000 to 150,000 hairs, a wig a tenth of that to twice it."""
LEAST_SUPPORT = 0.05


def estimate_strand_count(
    density: BrickVolume,
    hair_level: float,
    guides: Strands,
    head,
    profile: StrandProfile | None = None,
    progress: Progress = silent,
    peak: float = 0.0,
) -> int:
    """The number of strands in a scan, from its density and the guides found in it (mm, scan frame, root first).

    All hair weighs `hair_mass`; a lone strand weighs `line_mass` per mm, measured on guides that run alone, or as one of
    `peak`, the thresholds', does where none does; together, the
    scan's length of hair. A piece of hair is as likely to be found as it is long, so the mean length of a strand is
    that of the guides with the share that the scan backs (`support`) as weight. The net's zone, where hair was cut away
    with the net, counts in neither length. `head` answers `signed_distance`. Clamped to FEWEST..MOST; no more than 0.1 mm
    of hair a strand is ever assumed.
    """
    if not len(guides):
        return FEWEST
    profile = profile or lone_profile(density, hair_level, guides, peak, part(progress, 0.0, 0.6))
    length = hair_mass(density, part(progress, 0.6, 0.8)) / profile.line_mass
    floor = data_floor(density, hair_level, head)
    support = guides.strand_attributes.get("support")
    if support is None:
        support = support_along(guides, density, hair_level)[1]
    weight = np.clip(np.asarray(support, np.float64), 0.0, 1.0) * (np.asarray(support) > LEAST_SUPPORT)
    if not weight.any():
        weight = np.ones(len(guides))
    shown = shown_lengths(guides, head, floor)
    mean = float((weight * shown).sum() / weight.sum())
    progress(1.0, 1.0)
    return int(np.clip(round(length / max(mean, 0.1)), FEWEST, MOST))


def shown_lengths(strands: Strands, head, floor: float) -> np.ndarray:
    """(N,) float64: the length of each strand, mm, outside the zone over the head that the scan does not show."""
    lengths = strands.lengths().astype(np.float64)
    if floor <= 0.0:
        return lengths
    steps = strands.resampled_by_step(max(0.25 * floor, 0.5))
    outside = (np.asarray(head.signed_distance(steps.points, floor)) >= floor).astype(np.float64)
    # a step counts by its two ends: without that, the root alone would take half a step from every strand
    ends = 0.5 * (outside[steps.offsets[:-1]] + outside[steps.offsets[1:] - 1])
    share = (np.bincount(steps.strand_index, outside, len(steps)) - ends) / np.maximum(steps.counts - 1, 1)
    return lengths * share
