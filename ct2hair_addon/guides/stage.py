"""Stage 4: guide strands from the density, rooted on the scalp, root first (paper 3.2.2, supplement 2)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from ..head import Head
from ..progress import Progress, part, silent
from ..settings import GuideSettings
from ..strands import Strands, concatenate
from ..volume.grid import BrickVolume
from ..volume.strand_signal import StrandProfile, data_floor, support_along
from .direction import cut_where_turned, fine_ends, neighbour_votes, roots_seen, signs
from .free_knots import usually_followed
from .growing import follow_to_scalp, grow_to_root
from .joints import meeting_ends
from .knots import strands_by_knots
from .linking import link_segments
from .paper import paper_guides
from .pieces import cut_segments
from .profile import strand_profile
from .roots import lead_into_scalp, push_out
from .seeds import Seeds, seed_order, seed_voxels
from .trace import trace_segments

PROFILED = 8000
"""Candidates that the strand's profile is measured on."""
SHOWN = 2.0
"""voxel; hair is traced down to about this far over what was cleared with the net."""
COARSEST = 1.0
"""mm; points of a guide are at most this far apart, or two voxels where that is less."""


class HairField(Protocol):
    """What tracing needs of the orientation field: `direction` int8 (B, 16, 16, 16, 3), UNIT long, and `confidence` uint8
    (B, 16, 16, 16), above 0 where there is hair, in the density's bricks; and `course`, the former as long as each is to be
    trusted by the latter, UNIT at most."""

    direction: BrickVolume
    confidence: BrickVolume

    def course(self) -> BrickVolume: ...


@dataclass(frozen=True)
class Habit:
    """How a wig's hair leaves the scalp, as its first traces tell: fitted guides have been led there and tell nothing of it.

    seen: whether roots are seen (`direction.roots_seen`). followed: how far they had to be followed back to the scalp, mm, the
    median of those that had; 0 where none had.
    """

    seen: bool = True
    followed: float = 0.0


@dataclass(frozen=True)
class Guides:
    """Guide strands: scan frame, mm, root first and on the scalp.

    strands: with `support` (N,) float32, the share of the length that was traced in the scan and not grown, and
    `root_uv` (N, 2) float32. profile: what a lone strand looks like in this scan. tally: what was kept and dropped, and why.
    habit: how the hair leaves the scalp.
    """

    strands: Strands
    profile: StrandProfile
    tally: dict[str, int]
    habit: Habit = Habit()


def find_segments(
    density: BrickVolume,
    hair_level: float,
    course: BrickVolume,
    seeds: Seeds,
    settings: GuideSettings,
    progress: Progress = silent,
    peak: float = 0.0,
) -> tuple[Strands, StrandProfile, dict[str, int]]:
    """The pieces of strands that the scan shows, in mm, without a direction; the strand's profile; the tally of the tracing.

    course: which way hair goes, in the density's bricks (`HairField.course`). peak: a lone strand's, by the thresholds.
    """
    profile = _profile(density, hair_level, seeds, peak)
    order = seed_order(density, *seeds, profile, part(progress, 0.0, 0.15))
    rest = [BrickVolume(density.table, density.bricks.astype(np.float32), density.spacing, density.origin)]
    segments, tally = _traced(rest, density, course, seeds, order, profile, settings, part(progress, 0.15, 1.0))
    return segments, profile, tally


def _traced(rest, density, course, seeds, order, profile, settings, progress) -> tuple[Strands, dict[str, int]]:
    """The pieces that a volume in the bricks of `density` shows, mm, and the tally of the tracing.

    rest: a list of that volume alone, which is used up and let go of: points in millimetres are made in float64, and together
    they were of the peak of memory.
    """
    found = trace_segments(rest.pop(), course, seeds.voxels, seeds.directions, order, profile, settings, progress)
    return Strands(density.to_scan(found.points), found.offsets), found.tally


def _profile(density: BrickVolume, hair_level: float, seeds: Seeds, peak: float) -> StrandProfile:
    """A lone strand's profile, measured on the first PROFILED of the shuffled seeds."""
    chosen = np.argsort(seeds.shuffle, kind="stable")[:PROFILED]
    axes = seeds.directions[chosen].astype(np.float64)
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    return strand_profile(density, hair_level, seeds.voxels[chosen], axes, peak)


def trace_guides(
    density: BrickVolume,
    hair_level: float,
    field: HairField,
    head: Head,
    settings: GuideSettings | None = None,
    seed: int = 0,
    progress: Progress = silent,
    knots: np.ndarray | None = None,
    peak: float = 0.0,
    counted: bool = True,
) -> Guides:
    """Guide strands of the hair in `density` (air at 0, hair above `hair_level`) on `head`.

    Segments are traced (`trace`), the fine ones told from the poor (Algorithm 1), all directed root to tip, those that begin
    over the scalp followed back through the hair to it or grown along rooted neighbours, each root led into the scalp, to a
    knot (`knots` (K, 3), mm) where there is one by it, no point left inside the head. With `settings.method` "paper" all of it
    goes the paper's way instead (`paper`). peak: density of a lone strand by the thresholds, which stands in where none runs
    alone. counted: whether the knots are as many as the strands, as they are found by a mannequin's skin; without one they are
    few and unsure. The same seed gives the same strands, on any number of threads.
    """
    settings = settings or GuideSettings()
    seeds = seed_voxels(field.confidence, field.direction, seed)
    if settings.method == "paper":
        strands, tally = paper_guides(density, field.direction, field.confidence, head, settings, seed, progress)
        return Guides(strands, _profile(density, hair_level, seeds, peak), tally)
    way = field.course()
    del field  # as large as the density in float32: its memory is free from here on if the caller, too, has let go of it
    segments, profile, tally = find_segments(density, hair_level, way, seeds, settings, part(progress, 0.0, 0.85), peak)
    del seeds, way
    floor = data_floor(density, hair_level, head)
    step = part(progress, 0.85, 1.0)
    strands, more, habit = root_segments(
        segments, density.spacing, head, settings, step, density, profile.seen, knots, floor, counted
    )
    progress(1, 1)
    return Guides(strands, profile, tally | more, habit)


def amend_guides(
    pieces: Strands,
    unexplained: Callable[[Progress], BrickVolume],
    density: BrickVolume,
    hair_level: float,
    field: HairField,
    head: Head,
    profile: StrandProfile,
    settings: GuideSettings | None = None,
    seed: int = 0,
    progress: Progress = silent,
    knots: np.ndarray | None = None,
    counted: bool = True,
    habit: Habit | None = None,
) -> Guides:
    """Guide strands from `pieces` of fitted ones (mm) and what is traced in the rest of the scan: both are joined and rooted as
    in `trace_guides`, where the other arguments are explained. Their support is what the scan backs.

    unexplained: makes the scan without what the pieces explain, once the orientation field is needed no more. habit: the
    traced guides' own.
    """
    settings = settings or GuideSettings()
    seeds, way = seed_voxels(field.confidence, field.direction, seed), field.course()
    del field
    rest = [unexplained(part(progress, 0.0, 0.1))]
    order = seed_order(rest[0], *seeds, profile, part(progress, 0.1, 0.2))
    traced, _ = _traced(rest, density, way, seeds, order, profile, settings, part(progress, 0.2, 0.5))
    del seeds, way
    segments = concatenate([pieces.resampled_by_step(density.spacing), traced])
    floor = data_floor(density, hair_level, head)
    step = part(progress, 0.5, 1.0)
    strands, tally, habit = root_segments(
        segments, density.spacing, head, settings, step, density, profile.seen, knots, floor, counted, habit
    )
    support = support_along(strands, density, hair_level)[1] if len(strands) else np.zeros(0, np.float32)
    progress(1, 1)
    tally = {"pieces": len(pieces), "traced beside them": len(traced)} | tally
    return Guides(strands.with_attributes(support=support), profile, tally, habit)


def root_segments(
    segments: Strands,
    spacing: float,
    head: Head,
    settings: GuideSettings,
    progress: Progress = silent,
    scan: BrickVolume | None = None,
    strand: float = 0.0,
    knots: np.ndarray | None = None,
    floor: float = 0.0,
    counted: bool = True,
    habit: Habit | None = None,
) -> tuple[Strands, dict[str, int], Habit]:
    """Directed and rooted strands from undirected segments (mm): Algorithm 1, joints, growing, roots; what became of them; and
    how they leave the scalp (`habit`, where given).

    scan, strand: the density and a lone strand's value in it, by which segments are joined; without them they are not.
    knots: (K, 3) mm, where strands are tied to the net; counted: they are as many as the strands. floor: mm over the scalp
    below which the scan shows no hair.
    """
    tally: dict[str, int] = {}
    knots = knots if settings.knots else None
    fine = fine_ends(segments, head, settings)
    tally["fine segments"] = int((fine != 0).sum())
    tally["poor segments"] = int((fine == 0).sum())
    progress(0.1, 1.0)
    if scan is not None and settings.link and len(segments):
        pieces, fine_segments = cut_segments(segments, spacing), fine
        fine = pieces.ends(fine_segments)
        seen = habit.seen if habit else roots_seen(pieces.strands, fine, head)
        votes = neighbour_votes(pieces.strands, settings.neighbour_radius)
        value = signs(pieces.strands, fine, head, seen, votes)
        pieces, votes = cut_where_turned(pieces, value, votes)
        fine = pieces.ends(fine_segments)
        value = signs(pieces.strands, fine, head, seen, votes, meeting_ends(pieces, scan, strand))
        del votes
        progress(0.3, 1.0)
        known, merged = strands_by_knots(knots if counted else None, head, spacing)
        directed, rooted, bridged, joints = link_segments(
            pieces.turned(value < 0), fine * value > 0.0, scan, strand, part(progress, 0.3, 0.5), known, merged
        )
        tally |= {"strands by the knots": known} | joints
    else:
        seen = habit.seen if habit else roots_seen(segments, fine, head)
        value = signs(segments, fine, head, seen, neighbour_votes(segments, settings.neighbour_radius))
        directed, rooted, bridged = segments.reversed(value < 0), fine * value > 0.0, np.zeros(len(segments), np.float32)
    tally["seemingly rooted pieces that run the other way"] = int((fine * value < 0.0).sum())
    tally["pieces without a sure direction"] = int(((fine == 0) & (np.abs(value) < 0.1)).sum())
    traced = directed.lengths() - bridged
    coarse = directed.resampled_by_step(_step(spacing))
    bodies, low, walked = follow_to_scalp(coarse, head, floor + SHOWN * spacing, part(progress, 0.5, 0.6))
    tally["followed back through the hair"] = int((walked > 0).sum())
    bodies, reached, grown = grow_to_root(bodies, rooted | low, settings)
    grown += walked
    progress(0.7, 1.0)
    tally["dropped: no rooted hair near"] = int((~reached).sum())
    backed = traced / np.maximum(traced + bridged + grown, 1e-6)
    enough = reached & (backed >= settings.min_support)
    tally["dropped: mostly grown"] = int((reached & ~enough).sum())
    kept, backed_length = bodies.select(enough), traced[enough]
    made = (bodies.counts - coarse.counts)[enough]
    habit = habit or Habit(seen, usually_followed(kept, made))
    rooted, tied, late = lead_into_scalp(kept, head, knots, made, part(progress, 0.7, 0.85), habit.followed)
    tally["roots at knots of the net"] = tied
    tally["led to knots that were left"] = late
    progress(0.85, 1.0)
    rooted, pushed = push_out(rooted, head)
    rooted = rooted.resampled_by_step(_step(spacing))
    rooted, again = push_out(rooted, head)
    tally["points pushed out of the head"] = pushed + again
    tally["guides"] = len(rooted)
    root = head.closest_scalp(rooted.roots) if len(rooted) else None
    support = np.clip(backed_length / np.maximum(rooted.lengths(), 1e-6), 0.0, 1.0).astype(np.float32)
    uv = root.uv.astype(np.float32) if root is not None else np.zeros((0, 2), np.float32)
    progress(1.0, 1.0)
    return Strands(rooted.points, rooted.offsets, {"support": support, "root_uv": uv}), tally, habit


def _step(spacing: float) -> float:
    return max(min(COARSEST, 2.0 * spacing), spacing)
