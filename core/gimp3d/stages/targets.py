"""T as the paper defines it, and what stands in front of the object. Charts tell T otherwise: `clearing`."""

from __future__ import annotations

import numpy as np

from ..gaussians import Gaussians
from ..geometry import dilated
from ..raster import render
from .look import ViewBefore
from .outline import guard_gaussians

GUARD_FOOTPRINT = 0.5  # accumulated alpha of guard Gaussians above which a pixel needs no fill (paper 3.2)
CHANGED = 0.02  # blend weight of removed Gaussians above which the object touched a pixel: five grey levels of 255
OCCLUDER_STEP = 0.03  # of disparity (relative) by which a kept surface, continued, lies before the object


def uncovered(gaussians: Gaussians, removed: np.ndarray, view: ViewBefore) -> np.ndarray:
    """[H, W] bool: T as the paper defines it (3.2), the polygon less the guard Gaussians' footprints."""
    usable = ~removed & gaussians.usable
    guards = [guard_gaussians(gaussians, usable, p, view.camera) for p in view.polygons]
    covered = render(gaussians.take(np.any(guards, axis=0)), view.camera, passes=frozenset({"alpha"})).alpha
    return view.polygon & (covered <= GUARD_FOOTPRINT)


def in_front(depth: np.ndarray, object_: np.ndarray, reach: int = 2) -> np.ndarray:
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
