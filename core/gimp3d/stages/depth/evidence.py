"""What other views measured of the surface behind the object, and what they see past."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from ...compute.jit import exact_kernel
from ...compute.threads import at_once, parallel_map
from ...geometry import SOLID, dilated, disparity_of, framed, surface_points
from ..masks import ViewMasks
from .layers import STEP, steps

# Depths and disparities are relative.
UNCHANGED = 0.01  # a view sees the background where removing the object moves its first surface by less
AGREEMENT = 0.03  # samples of one pixel that lie closer are of one surface
LEAST_VIEWS = 2  # that must agree on a surface, or on there being none
FULL = 4  # views that make a pixel as sure as one of the reference's own
BEYOND = 0.03  # how far behind a point a view must see to see past it
FAR = 0.75  # of the object's depth: what is nearer than that says that the depths are wrong, not the surface
STRIDE = 4  # px at which it is asked which parts of a view may show the hole
PUSH, LONGER = 0.01, 1.1  # first step by which a contradicted surface is pushed back; growth of each further one
PUSHES = 40  # steps at most: to 50 times the distance


@dataclass(frozen=True)
class DepthEvidence:
    """Soft data in the reference's hole."""

    disparity: np.ndarray  # [H, W] float32, 0 = none
    weight: np.ndarray  # [H, W] float32 in [0, 1], 0 = none


def gather_depth_evidence(
    view: ViewMasks,  # the reference
    views: Sequence[ViewMasks],  # the others; the reference among them does not count
    ring: np.ndarray | None = None,  # [H, W] bool, pixels off the hole that are asked about too
) -> DepthEvidence:
    """Disparities of the reference's hole that other views measured, the nearest surface on which views agree.

    Taken are the pixels of other views whose first surface is there with and without the object, off depth edges. They
    are carried into the reference; the samples of a pixel fall into groups that agree, and the nearest group of enough
    views gives its median. What lies just behind a nearer neighbour shows through a gap between samples: dropped.
    """
    others = [v for v in views if v.camera.id != view.camera.id]
    asked = view.target if ring is None else view.target | ring
    samples = parallel_map(lambda v: _samples(v, view, asked), others, at_once(asked.size))
    h, w = view.target.shape
    found, count = np.zeros(h * w), np.zeros(h * w)
    pixels, disparities = np.concatenate([np.zeros((2, 0)), *samples], axis=1)
    origin = np.repeat(np.arange(len(samples)), [s.shape[1] for s in samples])
    if len(pixels):
        order = np.lexsort((-disparities, pixels))
        pixels, disparities, origin = pixels[order].astype(int), disparities[order], origin[order]
        apart = (np.diff(pixels) > 0) | (disparities[1:] < (1 - AGREEMENT) * disparities[:-1])
        start = np.flatnonzero(np.r_[True, apart])
        group = np.cumsum(np.r_[0, apart])
        agreeing = np.bincount(np.unique(group * len(samples) + origin) // len(samples), minlength=len(start))
        middle = disparities[start + np.bincount(group) // 2]
        enough = agreeing >= LEAST_VIEWS
        taken, first = np.unique(pixels[start[enough]], return_index=True)
        found[taken], count[taken] = middle[enough][first], agreeing[enough][first]
    found, count = found.reshape(h, w), count.reshape(h, w)
    nearest = cv2.dilate(found, np.ones((5, 5), np.uint8))
    count[found < (1 - STEP) * nearest] = 0
    weight = np.minimum(count / FULL, 1)
    return DepthEvidence(np.where(weight > 0, found, 0).astype(np.float32), weight.astype(np.float32))


def _samples(other: ViewMasks, view: ViewMasks, asked: np.ndarray) -> np.ndarray:
    """[2, M]: pixels asked about in the reference (flat indices) and the disparities that a view measured there."""
    shown = np.where(_background(other) & _may_reach(other, view), other.depth_before, 0)
    _, rows, cols, z = framed(view.camera, surface_points(other.camera, shown)[2])
    # Nothing that the object hides lies before the object itself.
    front = np.where(view.target, (1 - BEYOND) * view.depth_before, 0)[rows, cols]
    there = asked[rows, cols] & (z > front)
    return np.stack([rows[there] * asked.shape[1] + cols[there], 1 / z[there]])


def _may_reach(other: ViewMasks, view: ViewMasks) -> np.ndarray:
    """[H, W] bool: blocks of a view that may show something of the reference's hole; most do not, which saves time."""
    coarse = other.depth_before[STRIDE // 2 :: STRIDE, STRIDE // 2 :: STRIDE]
    rows, cols = np.nonzero(coarse > 0)
    uv = (np.stack([cols, rows], -1) + 0.5) * STRIDE
    inside, y, x, _ = framed(view.camera, other.camera.unproject(uv, coarse[rows, cols].astype(float)))
    near_hole = dilated(view.target, 4 * STRIDE)
    found = np.zeros(coarse.shape, bool)
    found[rows[inside], cols[inside]] = near_hole[y, x]
    whole = np.pad(dilated(found, 1), ((0, 1), (0, 1)), "edge").repeat(STRIDE, 0).repeat(STRIDE, 1)
    return whole[: other.target.shape[0], : other.target.shape[1]]


def _background(view: ViewMasks) -> np.ndarray:
    """[H, W] bool: pixels whose first surface is not the object's, off depth edges, whose depths are uncertain."""
    depth = view.depth_before
    there = (depth > 0) & (view.alpha_after > SOLID)
    same = there & (np.abs(view.depth_after - depth) <= UNCHANGED * depth)
    doubtful = there & ~same | steps(np.where(there, disparity_of(depth), 0), there)
    return same & ~dilated(doubtful, 1)


@dataclass(frozen=True)
class FreeSpace:
    """Where views see through: no surface of the background can stand there."""

    view: ViewMasks  # the reference
    others: tuple[ViewMasks, ...]
    margin: int  # views by which those that see past must outnumber those that see a surface

    def seen_past(
        self,
        depth: np.ndarray,  # [H, W] completed z-depth
        pixels: np.ndarray,  # [H, W] bool, those asked about
    ) -> np.ndarray:
        """[H, W] bool: pixels whose completed surface stands where views see through.

        The reference sees the object, and nothing in front of it. Another view sees past a point if all it sees round
        its pixel lies clearly behind; enough others must. Where a view sees nothing (alpha below ½), it says nothing.
        """
        rows, cols = np.nonzero(pixels & (depth > 0))
        past, excess = self._votes(depth, rows, cols)
        view, tolerance = self.view, 1 - BEYOND
        object_there = (view.depth_after <= 0) | (view.depth_before < tolerance * view.depth_after)
        before_object = (depth < tolerance * view.depth_before) & (depth > FAR * view.depth_before)
        found = np.zeros(pixels.shape, bool)
        found[rows, cols] = (past >= LEAST_VIEWS) & (excess > self.margin)
        return found | (before_object & object_there & pixels & (depth > 0))

    def pushed_back(
        self,
        depth: np.ndarray,  # [H, W] completed z-depth
        contradicted: np.ndarray,  # [H, W] bool
    ) -> np.ndarray:
        """[H, W] z-depth: contradicted pixels moved away along their rays to where no view sees through any more.

        0 elsewhere, and where there is no such place within reach.
        """
        moved, left = np.where(contradicted, depth, 0.0).astype(np.float64), contradicted
        for k in range(PUSHES):
            if not left.any():
                break
            moved = np.where(left, moved * (1 + PUSH * LONGER**k), moved)
            left = self.seen_past(moved, left)
        return np.where(left, 0.0, moved).astype(np.float32)

    def _votes(self, depth: np.ndarray, rows: np.ndarray, cols: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """[N] each: how many other views see past a pixel's point, and that number less those that show it."""
        uv = np.stack([cols + 0.5, rows + 0.5], -1)
        points = self.view.camera.unproject(uv, depth[rows, cols].astype(np.float64))
        past, there = np.zeros(len(points), int), np.zeros(len(points), int)
        for other in self.others:
            index, y, x, z = framed(other.camera, points)
            near, far = np.empty((2, len(index)), np.float32)
            _extremes(np.ascontiguousarray(other.depth_before), x, y, near, far)
            past[index] += near > (1 + BEYOND) * z
            there[index] += (near <= (1 + BEYOND) * z) & (far >= (1 - BEYOND) * z)
        return past, past - there


def free_space(
    view: ViewMasks,  # the reference
    views: Sequence[ViewMasks],
    trusted: np.ndarray,  # [H, W] bool, the reference's own surfaces: what views say of them shows how far to trust it
) -> FreeSpace:
    """What other views see through. The margin is what 95 % of the reference's own surfaces stay below.

    In scans with poor depths, views "see past" tables; they must then say so more clearly of the hole than of these.
    """
    space = FreeSpace(view, tuple(v for v in views if v.camera.id != view.camera.id), 0)
    rows, cols = np.nonzero(trusted & (view.depth_after > 0))
    if len(rows) == 0:
        return space
    excess = space._votes(view.depth_after, rows, cols)[1]
    return replace(space, margin=max(0, int(np.percentile(excess, 95))))


@exact_kernel
def _extremes(depth, cols, rows, near, far):
    """The least z (0: void is near) and the greatest within a pixel of each (col, row)."""
    height, width = depth.shape
    for i in range(len(rows)):
        near[i] = far[i] = depth[rows[i], cols[i]]
        for v in range(max(0, rows[i] - 1), min(height, rows[i] + 2)):
            for u in range(max(0, cols[i] - 1), min(width, cols[i] + 2)):
                near[i], far[i] = min(near[i], depth[v, u]), max(far[i], depth[v, u])
