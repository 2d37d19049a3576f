"""What photos show of the surface behind the object: copied from the view that sees it best, never invented."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np

from ..camera import Camera
from ..geometry import EVIDENCE_DEPTH, colours_at, dilated, directions, sees, surface_points

MARGIN = 3  # px round the sample that must not hold something nearer: photos mix colours at depth edges
CONTACT = 4  # px that evidence keeps away from what no photo shows: where the object touches the surface
NEARER = 0.03  # relative z by which a surface must be nearer to be one that mixes in: more than two splats' scatter


@dataclass(frozen=True)
class Evidence:
    """What photos show of the reference's hole."""

    image: np.ndarray  # [H, W, 3] uint8, meaningful where `seen`
    seen: np.ndarray  # [H, W] bool


def gather_evidence(
    camera: Camera,  # the reference
    depth: np.ndarray,  # [H, W] its completed z-depth
    target: np.ndarray,  # [H, W] bool, T_0
    views: Iterable[tuple[Camera, np.ndarray, np.ndarray]],  # (camera, photo [H, W, 3], z with the object [H, W])
    tolerance: float = EVIDENCE_DEPTH,  # relative z, how near a photo must show the surface
) -> Evidence:
    """Colours of the hidden surface from the view that sees it unhidden under the most similar angle.

    What some view saw is copied from that view, never invented (docs/method.md).
    """
    rows, cols, points = surface_points(camera, np.where(target, depth, 0))
    rays = directions(points, camera)
    best = np.full(len(points), -1.0)
    colours = np.zeros((len(points), 3), np.uint8)
    for other, photo, seen_depth in views:
        cosine = (rays * directions(points, other)).sum(-1)
        open_points = np.flatnonzero(cosine > best)
        clear = sees(other, _off_edges(seen_depth), points[open_points], tolerance)
        found = open_points[clear]
        if len(found):
            colours[found] = colours_at(photo, other.project(points[found])[0])
        best[found] = cosine[found]
    image = np.zeros((*target.shape, 3), np.uint8)
    image[rows, cols] = colours
    seen = np.zeros(target.shape, bool)
    seen[rows, cols] = best > -1
    seen &= ~dilated(target & ~seen, CONTACT)
    return Evidence(image, seen)


def _off_edges(depth: np.ndarray) -> np.ndarray:
    """The depth map [H, W] float32, 0 where something nearer stands within the margin."""
    nearest = cv2.erode(np.where(depth > 0, depth, np.inf).astype(np.float32), np.ones((2 * MARGIN + 1,) * 2, np.uint8))
    return np.where(nearest < (1 - NEARER) * depth, 0, depth).astype(np.float32)
