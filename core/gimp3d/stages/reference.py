"""Which view explains the hole best, and what can be seen of the hole's surface in the photos (METHOD section 2)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from ..camera import Camera
from ..errors import IllPosed
from .depth import complete_disparity
from .masks import ViewMasks, sees


@dataclass(frozen=True)
class ReferenceSettings:
    """What makes a reference acceptable."""

    minimum_pixels: int = 1  # a view with fewer hole pixels cannot be the reference
    truncation_power: float = 2.0  # how hard a hole cut by the frame is punished


@dataclass(frozen=True)
class ReferenceChoice:
    """The chosen view and why; `scores` holds (camera ID, score) of every candidate, best first."""

    camera_id: str
    scores: tuple[tuple[str, float], ...]
    confidence: float
    reason: str


def surface_normals(
    camera: Camera,
    depth: np.ndarray,  # [H, W] z-depth, 0 = nothing
) -> np.ndarray:
    """Unit normals [H, W, 3] of a depth map in camera axes, facing the camera; 0 where depth is missing."""
    points = camera.unproject(camera.pixel_centres(), depth.astype(np.float64)) @ camera.R.T
    right, down = _difference(points, 1), _difference(points, 0)
    normals = np.cross(down, right)
    length = np.linalg.norm(normals, axis=-1, keepdims=True)
    valid = (depth > 0)[..., None] & (length > 0)
    return np.where(valid, normals / np.where(length > 0, length, 1), 0.0)


def _difference(points: np.ndarray, axis: int) -> np.ndarray:
    """One-sided differences of [H, W, 3] points, to the side where depth changes less: edges do not tilt normals."""
    if points.shape[axis] < 2:
        return np.zeros_like(points)
    step = np.diff(points, axis=axis)
    first, last = np.take(step, [0], axis), np.take(step, [-1], axis)
    forward, backward = np.concatenate([step, last], axis), np.concatenate([first, step], axis)
    return np.where(np.abs(forward[..., 2:]) <= np.abs(backward[..., 2:]), forward, backward)


def facing(
    camera: Camera,
    depth: np.ndarray,  # [H, W]
) -> np.ndarray:
    """cos θ between each surface element and its viewing ray, [H, W] in [0, 1]."""
    rays = np.concatenate(
        [
            (camera.pixel_centres() - [camera.cx, camera.cy]) / [camera.fx, camera.fy],
            np.ones(depth.shape)[..., None],
        ],
        -1,
    )
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    return np.clip(-(surface_normals(camera, depth) * rays).sum(-1), 0.0, 1.0)


def disparity_of(depth: np.ndarray) -> np.ndarray:
    """1/z [H, W] float32, 0 where there is nothing (METHOD section 0)."""
    return np.where(depth > 0, 1.0 / np.where(depth > 0, depth, 1.0), 0.0).astype(np.float32)


def rim(view: ViewMasks, solid: float) -> np.ndarray:
    """[H, W] bool: pixels whose depth after the removal is trusted (METHOD section 3, boundary)."""
    return ~view.target & (view.alpha_after > solid) & (view.depth_after > 0)


def choose_reference(
    views: Sequence[ViewMasks],
    wanted: str | None = None,
    solid: float = 0.9,
    settings: ReferenceSettings = ReferenceSettings(),
) -> ReferenceChoice:
    """The view that shows most of the needed surface, square on and not cut off by the frame.

    Score: the sum over the hole's pixels of cos θ to the provisionally completed surface, which is the surface
    integral of visible × cos θ × pixels per area, times the framed share of the hole (METHOD section 2).

    Raises
    ------
    IllPosed
        If the wanted view does not see the hole, or no view does.
    """
    scores = sorted(((v.camera.id, _score(v, solid, settings)) for v in views), key=lambda s: (-s[1], s[0]))
    usable = [s for s in scores if s[1] > 0]
    if wanted is not None:
        if wanted not in dict(usable):
            raise IllPosed(f"reference {wanted} does not see the hole; leave --reference out and one is chosen")
        chosen = wanted
    elif usable:
        chosen = usable[0][0]
    else:
        raise IllPosed("no view shows the surface behind the object; add views from which its surroundings are seen")
    best, score = usable[0][1], dict(usable)[chosen]
    how = "as asked" if wanted else "sees most of the hidden surface"
    return ReferenceChoice(chosen, tuple(scores), score / best, f"{chosen}: {how} (score {score:.0f}, best {best:.0f})")


def _score(view: ViewMasks, solid: float, settings: ReferenceSettings) -> float:
    if view.target.sum() < settings.minimum_pixels:
        return 0.0
    try:
        completed = complete_disparity(disparity_of(view.depth_after), rim(view, solid), view.target)
    except IllPosed:
        return 0.0
    cosine = facing(view.camera, np.where(view.target, completed.depth, view.depth_after))[view.target].sum()
    on_border = view.target[0].sum() + view.target[-1].sum() + view.target[:, 0].sum() + view.target[:, -1].sum()
    framed = max(0.0, 1.0 - on_border / max(1.0, 2 * np.sqrt(view.target.sum())))
    return float(cosine * framed**settings.truncation_power)


@dataclass(frozen=True)
class EvidenceSettings:
    """When a photo counts as a true picture of the surface behind the object. Depths relative, lengths in pixels."""

    tolerance: float = 0.006  # how near a view's first surface must be to the completed one
    margin: int = 3  # px round the sample that must not hold something nearer
    contact: int = 4  # px that evidence keeps away from what no photo shows: where the object touches the surface
    nearer: float = 0.03  # how much nearer counts as an occluder


@dataclass(frozen=True)
class Evidence:
    """What photos show of the reference's hole."""

    image: np.ndarray  # [H, W, 3] uint8, meaningful where `seen`
    seen: np.ndarray  # [H, W] bool


def gather_evidence(
    camera: Camera,  # the reference
    depth: np.ndarray,  # [H, W] its completed z-depth
    target: np.ndarray,  # [H, W] bool, T_0
    views: Sequence[tuple[Camera, np.ndarray, np.ndarray]],  # (camera, photo [H, W, 3], z with the object [H, W])
    settings: EvidenceSettings = EvidenceSettings(),
) -> Evidence:
    """Colours of the hidden surface from the view that sees it unhidden under the most similar angle.

    What some view saw is copied from that view, never invented (METHOD section 1, `ours`).
    """
    rows, cols = np.nonzero(target & (depth > 0))
    points = camera.unproject(np.stack([cols + 0.5, rows + 0.5], -1), depth[rows, cols].astype(np.float64))
    rays = _directions(points, camera)
    best = np.full(len(points), -1.0)
    colours = np.zeros((len(points), 3), np.uint8)
    for other, photo, seen_depth in views:
        cosine = (rays * _directions(points, other)).sum(-1)
        open_points = np.flatnonzero(cosine > best)
        clear = sees(other, _without_occluders(seen_depth, settings), points[open_points], settings.tolerance)
        found = open_points[clear]
        if len(found):
            uv, _ = other.project(points[found])
            x, y = (uv.astype(np.float32) - 0.5).T[:, :, None]
            colours[found] = cv2.remap(photo, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)[:, 0]
        best[found] = cosine[found]
    image = np.zeros((*target.shape, 3), np.uint8)
    image[rows, cols] = colours
    seen = np.zeros(target.shape, bool)
    seen[rows, cols] = best > -1
    unseen = (target & ~seen).astype(np.uint8)
    seen &= cv2.dilate(unseen, np.ones((2 * settings.contact + 1,) * 2, np.uint8)) == 0
    return Evidence(image, seen)


def _directions(points: np.ndarray, camera: Camera) -> np.ndarray:
    towards = points - camera.centre
    return towards / np.maximum(np.linalg.norm(towards, axis=-1, keepdims=True), 1e-12)


def _without_occluders(depth: np.ndarray, settings: EvidenceSettings) -> np.ndarray:
    """The depth map with the surroundings of depth edges taken out (0): photos mix colours there."""
    size = 2 * settings.margin + 1
    filled = np.where(depth > 0, depth, np.inf).astype(np.float32)
    nearest = cv2.erode(filled, np.ones((size, size), np.uint8))
    return np.where(nearest < (1 - settings.nearer) * depth, 0, depth).astype(np.float32)
