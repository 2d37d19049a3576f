"""Planes in a disparity map. A plane in space is affine in disparity, d = a·u + b·v + c, whatever the camera."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import cv2
import numpy as np

# Differences of disparity are relative to the disparity itself.
RING = 24  # px, width of the ring round a hole on which planes are sought
INLIER = 0.008  # difference up to which a pixel lies on a plane: what settled splats of made scenes scatter by
MOST = 4  # planes: a floor, two walls and a step
LEAST = 0.08  # share of the ring that a plane must hold
TOUCHING = 0.03  # share of the rim that a plane must hold to touch the hole
DENSE = 0.6  # share of the pixels in a square of 7 px that lie on a plane where it does not merely cut through
TRIES = 256  # RANSAC samples per plane: half of the ring on a plane is found with certainty, a fifth in 7 of 8 cases
JUNCTION = 0.95  # share of two planes' ring pixels that max or min must explain for them to meet
LEAST_PIXELS = 10  # of the ring below which no plane is sought


@dataclass(frozen=True)
class PlanarPart:
    """A part of the background that planes describe: one, or some that meet in a line."""

    disparity: np.ndarray  # [H, W] float64, continued over the whole image
    on: np.ndarray  # [H, W] bool, the ring's pixels on it
    planes: int = 1  # 0: the sky


@dataclass(frozen=True)
class PlanarSurfaces:
    """What of the hole's surroundings is planar."""

    surfaces: tuple[PlanarPart, ...]
    share: float  # of the ring that lies on them
    reason: str


def planar_surfaces(
    disparity: np.ndarray, known: np.ndarray, distance: np.ndarray, inlier: float = INLIER
) -> PlanarSurfaces:
    """The planes on which the ring round the hole lies, largest first; sky is the plane d = 0.

    `distance` [H, W] are px to the hole; 0 at pixels in the hole that are `known` all the same. Sequential RANSAC
    (Fischler & Bolles 1981) with a fixed seed, each plane refined by least squares. Only planes that touch the hole
    count. Two that the ring shows to meet become one surface: the nearer one where they are concave (a room seen from
    inside: max of disparities), the farther where convex (min). Two that do not, a step, stay two.
    """
    ring = known & (distance <= RING)
    rim = known & (distance < 2)
    sky = ring & (disparity == 0)
    left = ring & ~sky
    rng = np.random.default_rng(0)
    found = [PlanarPart(np.zeros(disparity.shape), sky, 0)] if sky.any() else []
    for _ in range(MOST):
        plane = _largest_plane(disparity, left, inlier, rng)
        if plane is None:
            break
        near = left & (np.abs(plane - disparity) < inlier * disparity)
        # Where a plane merely cuts through rough ground, its inliers are scattered.
        inliers, candidates = (cv2.boxFilter(a.astype(np.float32), -1, (7, 7)) for a in (near, left))
        on = near & (inliers > DENSE * candidates)
        left &= ~near
        if on.sum() < LEAST * ring.sum():
            break
        found.append(PlanarPart(plane, on))
    share = float(sum(s.on.sum() for s in found) / max(1, ring.sum()))
    planes = sum(s.planes for s in found)
    reason = f"planar: {share:.0%} of the surroundings lie on {planes} plane{'s' if planes != 1 else ''}"
    touching = [s for s in found if (s.on & rim).sum() > TOUCHING * rim.sum()]
    return PlanarSurfaces(tuple(_joined(touching, inlier)), share, reason)


def _largest_plane(
    disparity: np.ndarray, ring: np.ndarray, inlier: float, rng: np.random.Generator
) -> np.ndarray | None:
    """The plane [H, W] that most ring pixels lie on."""
    rows, cols = np.nonzero(ring)
    if len(rows) < LEAST_PIXELS:
        return None
    # Divided by d, residuals are relative.
    d = disparity[rows, cols]
    points = np.stack([cols, rows, np.ones(len(rows))], -1) / d[:, None]
    samples = rng.integers(0, len(rows), (TRIES, 3))
    solvable = np.abs(np.linalg.det(points[samples] * d[samples][..., None])) > 1.0  # not three pixels in a line
    if not solvable.any():
        return None
    candidates = np.linalg.solve(points[samples[solvable]], np.ones((solvable.sum(), 3, 1)))[..., 0]
    thinned = points[:: max(1, len(points) // 2000)]
    votes = (np.abs(thinned @ candidates.T - 1) < inlier).sum(0)
    best = candidates[int(votes.argmax())]
    for _ in range(3):
        on = np.abs(points @ best - 1) < inlier
        if on.sum() < 3:
            return None
        best = np.linalg.lstsq(points[on], np.ones(on.sum()), rcond=None)[0]
    v, u = np.mgrid[: ring.shape[0], : ring.shape[1]]
    return best[0] * u + best[1] * v + best[2]


def _joined(surfaces: list[PlanarPart], inlier: float) -> list[PlanarPart]:
    """The surfaces, with those that meet made one."""
    for a, b in combinations(surfaces, 2):
        for meet in (np.maximum, np.minimum):
            joint = meet(a.disparity, b.disparity)
            kept = [(np.abs(joint - s.disparity) <= inlier * np.abs(s.disparity))[s.on].mean() for s in (a, b)]
            if min(kept) >= JUNCTION:
                others = [s for s in surfaces if s is not a and s is not b]
                return _joined([PlanarPart(joint, a.on | b.on, a.planes + b.planes), *others], inlier)
    return surfaces
