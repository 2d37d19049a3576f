"""What views look like before anything is filled, and what stays open once a reference was carried into them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np

from ..compute.threads import parallel_map
from ..gaussians import Gaussians
from ..geometry import SOLID, dilated, window_mask
from ..raster import Window, drawing, render_bytes, touched_window
from ..stages.masks import ViewMasks
from ..stages.propagate import PaintedView, Reference, Rule
from ..view_state import ViewState

OPAQUE = 0.99  # alpha of the emptied scene below which a gap shows through
LAYER_STEP = 0.05  # relative z step that parts two surfaces
MARGIN = 2  # px round T in which splats mix what is old and new
DRAWN = 0.5  # blend weight of new Gaussians from which they cover a pixel


def emptied(kept: Gaussians, views: Sequence[ViewState]) -> tuple[ViewState, ...]:
    """The views' photos with the emptied scene in the object's place."""

    def empty(view: ViewState) -> ViewState:
        silhouette = view.masks.silhouette
        drawn = render_bytes(kept, view.camera, pixels=silhouette)
        return replace(view, painted=np.where(silhouette[..., None], drawn, view.bare))

    return tuple(parallel_map(empty, views))


def after_reference(
    views: Sequence[ViewState],
    painted: Sequence[PaintedView],
    reference: Reference,
    filled: Gaussians,  # the scene with the new Gaussians, which are its last rows
    new: Gaussians,  # that this reference brought
    added: int,  # all new ones
) -> tuple[ViewState, ...]:
    """The views with what a reference painted, and what of them it left open."""
    by_id = {p.camera_id: p for p in painted}

    def after(view: ViewState) -> ViewState:
        part, touched = by_id[view.id], touched_window(new, view.camera)
        rules = part.rule_map(*view.painted.shape[:2])
        coloured = (rules != Rule.UNTOUCHED) & (rules != Rule.UNREACHED)
        best = max(view.best or (0, reference), (int(coloured.sum()), reference), key=lambda found: found[0])
        told = rules if view.rules is None else np.where(coloured, rules, view.rules)
        picture = redrawn(part.pasted(view.painted), filled, view.masks, touched)
        left = view.left
        if left.target.any():
            left = still_open(left, filled, added, rules, window_mask(touched, view.camera))
        return replace(view, painted=picture, rules=told, best=best, left=left)

    return tuple(parallel_map(after, views))


def redrawn(
    picture: np.ndarray,  # [H, W, 3] uint8
    filled: Gaussians,
    view: ViewMasks,
    touched: Window,  # where the last new Gaussians may be
) -> np.ndarray:
    """A painted view, with the filled scene where the removal left a gap that was never to be filled.

    Beside what is in front, its soft edge is no target, but the emptied scene shows through it.
    """
    gap = view.silhouette & ~view.target & (view.alpha_after < OPAQUE) & window_mask(touched, view.camera)
    if not gap.any():
        return picture
    return np.where(gap[..., None], render_bytes(filled, view.camera, pixels=gap), picture)


def still_open(
    view: ViewMasks,
    filled: Gaussians,
    added: int,
    rules: np.ndarray,
    touched: np.ndarray,  # [H, W] bool, where the last new Gaussians may be: elsewhere the view is as it was
) -> ViewMasks:
    """A view's masks once the new Gaussians (the last `added` rows) are there: T is what they do not cover.

    A pixel that a splat's edge covers but that got no colour stays open, or the next fill would continue its old one.
    What is left of the margin round T is closed where the scene's own surface joins the new one, and beside what is
    in front, where a splat's soft edge has the depth of neither.
    """
    new = np.zeros(len(filled), bool)
    new[-added:] = True
    side = 2 * MARGIN + 1
    near = touched | dilated(view.target, MARGIN)
    scene = drawing(filled, view.camera, with_colour=False, pixels=near)
    before = view.depth_after, view.alpha_after
    depth, alpha = (np.where(touched, d, b) for d, b in zip(scene.surface_depth(), before))
    covered = scene.footprint(new) > DRAWN
    coloured = (rules != Rule.UNREACHED) | (view.alpha_after > SOLID)
    target = view.target & (~covered | (rules == Rule.UNREACHED))
    farthest = cv2.dilate(np.where(covered, depth, 0).astype(np.float32), np.ones((side, side), np.uint8))
    nearest = cv2.erode(np.where(depth > 0, depth, np.inf).astype(np.float32), np.ones((side, side), np.uint8))
    at_edge = nearest < (1 - LAYER_STEP) * depth
    joined = coloured & (alpha > SOLID) & (at_edge | (depth < (1 + LAYER_STEP) * farthest))
    wide = cv2.morphologyEx(target.astype(np.uint8), cv2.MORPH_OPEN, np.ones((side - 1, side - 1), np.uint8)) > 0
    return replace(view, target=target & (wide | ~joined), depth_after=depth, alpha_after=alpha)
