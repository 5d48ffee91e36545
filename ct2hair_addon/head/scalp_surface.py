"""The scalp's surface from the knots alone: a robust radial surface around their sphere (supplement 1, before registration).

The supplement estimates normals from the bounding sphere's centre and reconstructs by Poisson; a radius over the
directions from that centre, in spherical harmonics, says the same for a star-shaped cap, fills its gaps, and is little moved by
loose strands.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..errors import HeadError

DEGREE = 8
"""Highest degree of the harmonics: features down to some 35 mm on a scalp; finer ones follow noise and hair."""
SMOOTHNESS = 1e-4
"""Weight of the surface's squared Laplacian against the points' mean square: gaps of 60 degrees stay round."""
RADII = (60.0, 125.0)
"""Radius of a sphere around a scalp, mm, from a child's to the largest adult's."""
SPHERE_REACH = 10.0
"""A scalp departs this far from its sphere, mm."""
TRIALS = 600
"""Spheres tried: one in 150 is through four good points even where 70 % of the points are junk."""
SHELLS = (10.0, 6.0, 4.0, 2.5, 2.0, 2.0)
"""Reach of the robust weight (Geman-McClure), mm, round by round."""


@dataclass(frozen=True)
class ScalpSurface:
    """A radius over the directions around `centre` (3,), mm; coefficients ((DEGREE + 1)^2,) of real harmonics."""

    centre: np.ndarray
    coefficients: np.ndarray

    def radius(self, directions: np.ndarray) -> np.ndarray:
        """(M,) mm: the surface's radius along unit `directions` (M, 3)."""
        return np.einsum("ij,j->i", harmonics(directions), self.coefficients)

    def distance(self, points: np.ndarray) -> np.ndarray:
        """(M,) mm, positive outside: along the ray from the centre, which is at most some 15 % more than the distance."""
        apart = np.asarray(points, np.float64) - self.centre
        length = np.linalg.norm(apart, axis=1)
        return length - self.radius(apart / np.maximum(length, 1e-9)[:, None])


def harmonics(directions: np.ndarray) -> np.ndarray:
    """(M, (DEGREE + 1)^2) real spherical harmonics at unit `directions` (M, 3), orthonormal, ordered by degree then order."""
    x, y, z = np.asarray(directions, np.float64).T
    out = np.empty((len(x), (DEGREE + 1) ** 2))
    # sin^m(t) cos(m p) and sin^m(t) sin(m p) by complex powers, associated Legendre by recurrence in the degree
    turning = np.ones(len(x), complex)
    first = np.full(len(x), np.sqrt(1.0 / (4.0 * np.pi)))
    for m in range(DEGREE + 1):
        if m > 0:
            turning = turning * (x + 1j * y)
            first = first * -np.sqrt((2.0 * m + 1.0) / (2.0 * m))
        before, current = np.zeros(len(x)), first
        for l in range(m, DEGREE + 1):
            if l > m:
                a = np.sqrt((4.0 * l * l - 1.0) / (l * l - m * m))
                b = np.sqrt(((l - 1.0) ** 2 - m * m) / (4.0 * (l - 1.0) ** 2 - 1.0))
                before, current = current, a * (z * current - b * before)
            middle = l * l + l
            if m == 0:
                out[:, middle] = current
            else:
                out[:, middle + m] = np.sqrt(2.0) * current * turning.real
                out[:, middle - m] = np.sqrt(2.0) * current * turning.imag
    return out


def scalp_sphere(points: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, float, float]:
    """(centre (3,), radius, share): the sphere that most of the points (by weight) lie near, and their share, 0 to 1.

    The bounding sphere of supplement 1, found by trials of four points (RANSAC), so that loose strands don't blow it up.
    """
    generator = np.random.default_rng(0)
    points = np.asarray(points, np.float64)
    middle = np.median(points, axis=0)
    q = points - middle
    chosen = q[generator.integers(0, len(q), (TRIALS * 4, 4))]
    rows = np.concatenate([2.0 * chosen, np.ones((len(chosen), 4, 1))], axis=2)
    rows = rows[np.abs(np.linalg.det(rows)) > 1e3]
    right = 0.25 * (rows[:, :, :3] ** 2).sum(axis=2, keepdims=True)
    solution = np.linalg.solve(rows, right)[:, :, 0]
    centres = solution[:, :3]
    radii = np.sqrt(np.maximum(solution[:, 3] + (centres**2).sum(axis=1), 0.0))
    kept = np.flatnonzero((radii > RADII[0]) & (radii < RADII[1]))[:TRIALS]
    best = (-1.0, np.zeros(3), 0.0)
    for trial in kept:
        off = np.linalg.norm(q - centres[trial], axis=1) - radii[trial]
        # no hair grows inside a head: what lies within the sphere speaks against it
        score = (weights * ((np.abs(off) < SPHERE_REACH) - 0.5 * (off < -2.0 * SPHERE_REACH))).sum()
        if score > best[0]:
            best = (score, centres[trial], radii[trial])
    _, centre, radius = best
    if radius == 0.0:
        return middle, 0.0, 0.0
    for _ in range(10):
        apart = q - centre
        length = np.linalg.norm(apart, axis=1)
        weight = weights * _robust(length - radius, SPHERE_REACH)
        # least squares for centre and radius, with the directions held
        rows = np.concatenate([apart / length[:, None], np.ones((len(q), 1))], axis=1)
        normal = np.einsum("ij,i,ik->jk", rows, weight, rows) + 1e-9 * np.eye(4)
        step = np.linalg.solve(normal, np.einsum("ij,i,i->j", rows, weight, length - radius))
        centre, radius = centre + step[:3], radius + step[3]
    off = np.linalg.norm(q - centre, axis=1) - radius
    share = float((weights * (np.abs(off) < SPHERE_REACH)).sum() / weights.sum())
    return np.round(centre + middle, 6), round(float(radius), 6), share


def scalp_surface(points: np.ndarray, weights: np.ndarray | None = None) -> ScalpSurface:
    """The radial surface through the scalp's points (K, 3) (knots and hairnet, up to half of them junk), mm.

    weights: (K,), 1 by default; area rather than count, where the points are unevenly dense. Raises HeadError where most
    of the points lie on no sphere of a head's size.
    """
    weights = np.ones(len(points)) if weights is None else np.asarray(weights, np.float64)
    centre, radius, share = scalp_sphere(points, weights)
    if share < 0.2:
        raise HeadError(
            f"no scalp was found: only {share:.0%} of the {len(points)} knot and hairnet points lie near any sphere of a "
            f"head's size (radius {RADII[0]:.0f} to {RADII[1]:.0f} mm). Check the scan's spacing, and set scan.knots to a "
            "value that leaves the hairnet and its knots"
        )
    apart = np.asarray(points, np.float64) - centre
    length = np.maximum(np.linalg.norm(apart, axis=1), 1e-9)
    basis = harmonics(apart / length[:, None])
    degree = np.repeat(np.arange(DEGREE + 1), 2 * np.arange(DEGREE + 1) + 1)
    stiffness = np.diag((degree * (degree + 1.0)) ** 2) * SMOOTHNESS
    coefficients = np.zeros(len(degree))
    coefficients[0] = radius * np.sqrt(4.0 * np.pi)
    for reach in SHELLS:
        off = length - np.einsum("ij,j->i", basis, coefficients)
        weight = weights * _robust(off, reach)
        # the junk is hair, over the scalp: below it a point counts from twice as far
        weight = np.where(off < 0.0, weights * _robust(off, 2.0 * reach), weight)
        total = max(weight.sum(), 1e-9)
        normal = np.einsum("ij,i,ik->jk", basis, weight / total, basis) + stiffness
        coefficients = np.linalg.solve(normal, np.einsum("ij,i,i->j", basis, weight / total, length))
    return ScalpSurface(centre, np.round(coefficients, 6))


def _robust(residual, reach):
    """Geman-McClure weights: 1 at 0, a quarter at `reach`."""
    return 1.0 / (1.0 + (residual / reach) ** 2) ** 2
