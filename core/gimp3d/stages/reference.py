"""Which view explains the hole best, and is completed first (docs/method.md)."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..camera import Camera
from ..compute.threads import parallel_map
from ..errors import IllPosed
from ..geometry import SOLID, bounds, dilated, directions, disparity_of, framed, surface_normals, surface_points
from .depth import RING, complete_depth
from .masks import ViewMasks

SAMPLES = 2000  # of the hidden surface from each view, about
SURFACE_VIEWS = 12  # views, evenly chosen, that say where the hidden surface may be: each costs a completion
NO_SURFACE = np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 1))  # points, normals, spacing


@dataclass(frozen=True)
class ViewScore:
    """What a view would explain of the hidden surface; shares of its area, 0 to 1."""

    camera_id: str
    score: float  # Σ over the surface of visible × cos θ × pixels per area, relative to the best view of each place
    covered: float  # share of the surface that the view shows
    facing: float  # mean cos θ where it does
    detail: float  # mean pixels per area there, relative to the view that shows most


@dataclass(frozen=True)
class ReferenceChoice:
    """The chosen view and why."""

    camera_id: str
    scores: tuple[ViewScore, ...]  # of every candidate, best first
    confidence: float
    reason: str


def rim(view: ViewMasks) -> np.ndarray:
    """[H, W] bool: pixels whose depth after the removal is trusted."""
    return ~view.target & (view.alpha_after > SOLID) & (view.depth_after > 0)


def needed_surface(views: Sequence[ViewMasks], samples: int = SAMPLES) -> tuple[np.ndarray, np.ndarray]:
    """Where the hidden surface probably is: the holes of some views, provisionally completed and put together.

    Points [S, 3] float64 in the world, one per patch of equal area, of as many `samples` from each view, and unit
    normals [S, 3] facing the view they come from.
    """
    seeing = [v for v in views if v.target.any()]
    step = max(1, -(-len(seeing) // SURFACE_VIEWS))
    parts = parallel_map(lambda v: _surface_in(v, samples), seeing[::step], most=2)  # mostly Python's work
    points, normals, sizes = map(np.concatenate, zip(*(parts or [NO_SURFACE])))
    if not len(points):
        return points, normals
    cell = float(np.median(sizes))
    # The first sample in each cell stands for it, so that views do not count by the number of their pixels.
    _, first = np.unique(np.floor(points / cell).astype(np.int64), axis=0, return_index=True)
    return points[np.sort(first)], normals[np.sort(first)]


def _surface_in(view: ViewMasks, samples: int) -> tuple[np.ndarray, ...]:
    """Points and normals [M, 3] in the world and their spacing [M, 1], from one view's hole; none if it has no rim."""
    camera, part = _coarse(view, max(1, round(math.sqrt(view.target.sum() / samples))))
    target, depth = view.target[part], view.depth_after[part]
    try:
        completed = complete_depth(disparity_of(depth), rim(view)[part], target)
    except IllPosed:
        return NO_SURFACE
    depth = np.where(target, completed.depth, depth)
    normals = surface_normals(camera, depth)
    rows, cols, points = surface_points(camera, np.where(target & (np.abs(normals).sum(-1) > 0), depth, 0))
    spacing = 2 * depth[rows, cols].astype(np.float64) / np.sqrt(camera.fx * camera.fy)
    return points, normals[rows, cols] @ camera.R, spacing[:, None]


def _coarse(view: ViewMasks, step: int) -> tuple[Camera, tuple[slice, slice]]:
    """Every step-th row and column of a view round its hole, which is not empty, and the camera that sees just these.

    A surface that is only sampled need not be completed at every pixel.
    """
    margin = step * (RING + 2)
    rows, cols = (slice(s.start, s.stop, step) for s in bounds(view.target, margin))
    height, width = view.target[rows, cols].shape
    c = view.camera
    cx, cy = (c.cx - cols.start - 0.5) / step + 0.5, (c.cy - rows.start - 0.5) / step + 0.5
    camera = replace(c, width=width, height=height, fx=c.fx / step, fy=c.fy / step, cx=cx, cy=cy)
    return camera, (rows, cols)


def choose_reference(
    views: Sequence[ViewMasks],
    wanted: str | None = None,
    tried: Collection[str] = (),  # views completed before: what is open in them still, they do not reach
) -> ReferenceChoice:
    """The view that shows most of the hidden surface, square on, in detail, and not cut off by the frame (ViewScore).

    Raises
    ------
    IllPosed
        If the wanted view does not see the hole, or no view does.
    """
    surface = needed_surface(views)
    seen = parallel_map(lambda v: _seen(v, *surface) if v.target.any() else None, views, most=2)
    untried = ((v, s) for v, s in zip(views, seen) if v.camera.id not in tried)
    candidates = [(v, *s) for v, s in untried if s is not None and s[0].any() and (dilated(v.target, 1) & rim(v)).any()]
    if not candidates:
        raise IllPosed("no view shows the surface behind the object; add views from which its surroundings are seen")
    best_worth = np.max([cosine * density for _, cosine, density in candidates], axis=0)
    best_density = np.max([density for _, _, density in candidates], axis=0)

    def score(view: ViewMasks, cosine: np.ndarray, density: np.ndarray) -> ViewScore:
        shown = cosine > 0
        worth = (cosine * density)[shown] / best_worth[shown]
        detail = float((density[shown] / best_density[shown]).mean())
        return ViewScore(view.camera.id, worth.sum() / len(shown), shown.mean(), float(cosine[shown].mean()), detail)

    scores = sorted((score(*c) for c in candidates), key=lambda s: (-s.score, s.camera_id))
    chosen = next((s for s in scores if wanted in (None, s.camera_id)), None)
    if chosen is None:
        raise IllPosed(f"reference {wanted} does not see the hole; leave --reference out and one is chosen")
    how = "as asked" if wanted else "explains most of the hidden surface"
    reason = (
        f"{chosen.camera_id}: {how}: shows {chosen.covered:.0%} of it, facing it by cos {chosen.facing:.2f}, with "
        f"{chosen.detail:.0%} of the finest detail (score {chosen.score:.2f}, best {scores[0].score:.2f})"
    )
    return ReferenceChoice(chosen.camera_id, tuple(scores), chosen.score / scores[0].score, reason)


def _seen(view: ViewMasks, points: np.ndarray, normals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """cos θ and pixels per area [S] of each sample in a view's hole; both 0 where it does not show it."""
    camera = view.camera
    index, rows, cols, z = framed(camera, points)
    cosine = -(normals * directions(points, camera)).sum(-1)
    shown = view.target[rows, cols] & (cosine[index] > 0)
    index, z = index[shown], z[shown]
    found = np.zeros((2, len(cosine)))
    found[:, index] = cosine[index], cosine[index] * camera.fx * camera.fy / z**2
    return found[0], found[1]
