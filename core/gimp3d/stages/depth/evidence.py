"""What other views measured of the surface behind the object."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from ...compute.threads import at_once, parallel_map
from ...geometry import SOLID, dilated, disparity_of, framed, surface_points
from ..masks import ViewMasks
from .layers import STEP, steps

# Depths and disparities are relative.
UNCHANGED = 0.01  # a view sees the background where removing the object moves its first surface by less
AGREEMENT = 0.03  # samples of one pixel that lie closer are of one surface
LEAST_VIEWS = 2  # that must agree on a surface
FULL = 4  # views that make a pixel as sure as one of the reference's own
BEFORE = 0.03  # how far before the object a sample must lie to be wrong
STRIDE = 4  # px at which it is asked which parts of a view may show the hole


@dataclass(frozen=True)
class DepthEvidence:
    """Soft data in the reference's hole."""

    disparity: np.ndarray  # [H, W] float32, 0 = none
    weight: np.ndarray  # [H, W] float32 in [0, 1], 0 = none


def gather_depth_evidence(view: ViewMasks, views: Sequence[ViewMasks], ring: np.ndarray | None = None) -> DepthEvidence:
    """Disparities of the hole of `view`, the reference, that others measured: the nearest surface on which views agree.

    The reference among `views` does not count; `ring` [H, W] bool are pixels off the hole asked about too. Taken are
    the pixels of other views whose first surface is there with and without the object, off depth edges. They are
    carried into the reference; the samples of a pixel fall into groups that agree, and the nearest group of enough
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
    front = np.where(view.target, (1 - BEFORE) * view.depth_before, 0)[rows, cols]
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
