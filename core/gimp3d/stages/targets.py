"""T, the pixels of a view to fill, from depths alone; where charts are found, `clearing` decides (docs/method.md)."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from ..camera import Camera
from ..compute.threads import parallel_map
from ..gaussians import Gaussians
from ..geometry import SAME_DEPTH, SOLID, cropped, dilated, surface_points, window_round
from ..raster import render
from .growth import components
from .look import AROUND, MOSTLY_OBJECT, ViewAfter, ViewBefore
from .outline import guard_gaussians
from .visibility import HIDES, SHOWN, Sight

GUARD_FOOTPRINT = 0.5  # accumulated alpha of guard Gaussians above which a pixel needs no fill (paper 3.2)
CHANGED = 0.02  # blend weight of removed Gaussians above which the object touched a pixel: five grey levels of 255
VOID = 0.1  # alpha after removal below which there is nothing
LAYER_STEP = 0.05  # relative z step between neighbouring pixels that parts two surfaces
OCCLUDER_STEP = 0.03  # of disparity (relative) by which a kept surface, continued, lies before the object
INFINITY = 10.0  # distances of the object from which a surface is sky: else T is 19 % larger before a made one
LEAST_OUTSIDE = 20  # px of a surface that must lie beyond the object for it to count as continuing there
EDGE = 3  # px that splats blur the edge of what stands before a void: else T is 8 % larger where a floor ends in one


def all_needed(
    before: Sequence[ViewBefore], after: Sequence[ViewAfter], centre: np.ndarray, margin: int
) -> list[np.ndarray]:
    """[H, W] bool each: the pixels to fill, judged by all views; T grows by `margin` px; `centre` [3], the region's."""
    sight = Sight.make([(b.camera, b.depth, a.untrusted(b)) for b, a in zip(before, after)], centre)
    return parallel_map(lambda v: _needed(v[0].camera, v[1], sight, centre, margin), list(zip(before, after)))


def _needed(view: Camera, after: ViewAfter, sight: Sight, centre: np.ndarray, margin: int) -> np.ndarray:
    """[H, W] bool: pixels that the object touched and that now show nothing that a view saw.

    A sky that goes on beyond the object is as little a hole as a void. Half covered pixels at a void that counts as
    seen are the edge of what stands before it, as splats blur it. Parts thinner than 3 px are mostly depth edges, where
    a pixel's depth is of neither side, or surface that views place a little differently. Such parts count only if no
    view sees past the point or shows it within twice the tolerance, and the object hides it from more views than other
    surfaces do.
    """
    camera = cropped(view, after.window)
    touched = after.weight > CHANGED
    solid = touched & (after.alpha >= SOLID)
    window = window_round(np.argwhere(touched)[:, ::-1], camera, AROUND)
    rows, cols, points = surface_points(camera, np.where(solid, after.depth, 0), window)
    evidence = touched & (after.alpha < VOID)
    distance = float(np.linalg.norm(camera.centre - centre))
    shown = sight.of(points, SAME_DEPTH) == SHOWN
    evidence[rows, cols] = shown | (after.depth[rows, cols] > INFINITY * distance)
    continues = np.zeros_like(touched)
    continues[window] = continues_outside(after.depth[window], after.alpha[window], touched[window], distance)
    evidence &= continues
    evidence |= touched & ~solid & dilated(continues & (after.alpha < VOID), EDGE)
    certain = after.weight > MOSTLY_OBJECT
    certain[rows, cols] &= sight.of(points, 2 * SAME_DEPTH) == HIDES
    found = np.zeros((view.height, view.width), bool)
    found[after.window] = _tidy(touched & ~evidence, certain, touched, margin)
    return found


def uncovered(gaussians: Gaussians, removed: np.ndarray, view: ViewBefore) -> np.ndarray:
    """[H, W] bool: T as the paper defines it (3.2), the polygon less the guard Gaussians' footprints."""
    usable = ~removed & gaussians.usable
    guards = [guard_gaussians(gaussians, usable, p, view.camera) for p in view.polygons]
    covered = render(gaussians.take(np.any(guards, axis=0)), view.camera, passes=frozenset({"alpha"})).alpha
    return view.polygon & (covered <= GUARD_FOOTPRINT)


def in_front(depth: np.ndarray, object_: np.ndarray, reach: int) -> np.ndarray:
    """[H, W] bool: surface at the outline of the object (`object_` [H, W] bool, z with it in `depth` [H, W]) behind
    whose continuation the object lies, and a pixel round it. `reach` px round the outline are looked at.

    The continuation is a plane in disparity, level where the surface falls off on its other side. The floor before the
    object's foot rises to it and is not in front, however flat the view; a thin rod is, close as it may stand.
    """
    disparity = np.divide(1, depth, out=np.zeros_like(depth), where=depth > 0)
    padded = np.pad(disparity, reach, "reflect", reflect_type="odd")  # slopes go on beyond the frame
    there = np.pad(object_ & (depth > 0), reach)
    (h, w), front = depth.shape, np.zeros_like(object_)
    for dy, dx in ((dy, dx) for dy in (-reach, 0, reach) for dx in (-reach, 0, reach) if dy or dx):
        ahead = np.s_[reach + dy : reach + dy + h, reach + dx : reach + dx + w]
        behind = np.s_[reach - dy : reach - dy + h, reach - dx : reach - dx + w]
        continued = np.minimum(disparity, 2 * disparity - padded[behind])
        front |= there[ahead] & (padded[ahead] < (1 - OCCLUDER_STEP) * continued)
    return dilated(front & ~object_, 1)


def continues_outside(depth: np.ndarray, alpha: np.ndarray, touched: np.ndarray, distance: float) -> np.ndarray:
    """[H, W] bool: surfaces (z without the object, 0 = nothing, in `depth` [H, W]), and the void of scans without a
    background, that go on beyond what the object `touched` [H, W] bool. Beyond the object's `distance` steps are of
    disparity, as for Sight.

    What shows through a gap that a nearer surface encloses (the sky below a table that the box cut open) may be seen
    by other views past the table's edge, but it is not what was behind the object.
    """
    z, void = depth, alpha < VOID
    there = (z > 0) & (alpha >= SOLID) | void
    index = np.arange(z.size).reshape(z.shape)
    pairs = []
    for near, far in ((np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1], np.s_[1:])):
        low, high = np.minimum(z[near], z[far]), np.maximum(z[near], z[far])
        close = high - low < LAYER_STEP * low * np.maximum(1, high / distance)
        same = there[near] & there[far] & np.where(void[near], void[far], close & ~void[far])
        pairs.append(np.stack([index[near][same], index[far][same]], axis=1))
    surface = components(np.concatenate(pairs), z.size).reshape(z.shape)
    outside = np.bincount(surface[there & ~touched], minlength=z.size)
    return there & (outside >= LEAST_OUTSIDE)[surface]


def _tidy(target: np.ndarray, certain: np.ndarray, allowed: np.ndarray, margin: int) -> np.ndarray:
    """Close a target's pinholes, drop thin parts that are not `certain`, and grow by a margin within what the object
    touched (`allowed`); all [H, W] bool.
    """
    solid = cv2.morphologyEx(target.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    solid = cv2.morphologyEx(solid, cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8))
    grown = dilated(solid, margin)
    grown |= dilated(target & certain & ~grown, margin)
    return grown & dilated(allowed, 1)
