"""A completed reference carried into the scene and into every view, and what it leaves open.

It is tiled with Gaussians; views are painted with it, and the Gaussians take the colours that views were painted with.
A painter that the user named may refine painted views.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import cv2
import numpy as np

from ..compute.threads import parallel_map
from ..gaussians import Gaussians
from ..geometry import SOLID, dilated, window_mask
from ..presets import RemovalSettings
from ..priors.calls import Call
from ..priors.inpaint import painter
from ..progress import Progress
from ..raster import Window, drawing, render_bytes, surface_depth, touched_window
from ..stages.charts import CHART, Chart
from ..stages.mapping import MappingField, mapping_field, source_visibility
from ..stages.masks import ViewMasks
from ..stages.propagate import PaintedView, Propagation, Rule, ViewToPaint, near_hole, propagate
from ..stages.refine import looked_at
from ..stages.seed import colour_gaussians, seed_gaussians, settle_gaussians
from ..stages.view_refinement import ViewRefinement, ViewToRefine, refine_views
from ..view_state import ViewState
from .completion import Completed

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


def seed_surface(completed: Completed, surfels: bool, settings: RemovalSettings) -> Gaussians:
    """Gaussians that tile the completed surface."""
    c = completed
    return seed_gaussians(c.camera, c.image, c.depth, c.target, surfels, settings.seed, c.camera.split == CHART)


def map_reference(completed: Completed, views: Sequence[ViewState], settings: RemovalSettings) -> MappingField:
    """Where each pixel of the reference's hole has its like, in what the views show: the paper's sampling asks."""
    c = completed
    seen = [(v.camera, v.left.depth_before, v.left.silhouette) for v in views]
    visibility = source_visibility(c.camera, c.depth, seen)
    return mapping_field(c.image, c.target, c.source, visibility, settings.mapping, settings.random_seed)


def paint_views(
    completed: Completed,
    field: MappingField | None,
    views: Sequence[ViewState],
    with_seeds: Gaussians,  # the scene without the object, the seeds in it
    settings: RemovalSettings,
    progress: Progress,
) -> Propagation:
    """Every view with the completed reference in its hole."""
    loaders = [partial(_to_paint, v, completed.charts, with_seeds) for v in views]
    sources = None if field is None else (field.rows, field.cols)
    return propagate(completed, loaders, settings.propagate, progress, sources)


def _to_paint(view: ViewState, charts: Sequence[Chart], with_seeds: Gaussians) -> ViewToPaint:
    """The view with the depth of its splats, the new ones among them; or with the charts', where its own is theirs or
    none.
    """
    v = view.left
    before, after = v.depth_before, np.zeros_like(v.depth_before)
    if charts:
        assert view.hits is not None
        there, after = view.hits.depth, v.depth_after
        tolerance, scatter = max(c.tolerance for c in charts), max(c.scatter for c in charts)
        behind = (after == 0) | (after > (1 - tolerance) * there)
        after = np.where(v.target & (there > 0) & behind, there, snapped(after, there, scatter))
        before = snapped(before, there, scatter)
    elif v.target.any():
        window = window_mask(near_hole(v.target), v.camera)
        after = surface_depth(with_seeds, v.camera, pixels=window)[0]
    return ViewToPaint(v.camera, view.bare, view.painted, v.silhouette, v.target, before, after)


def snapped(
    depth: np.ndarray,  # [H, W] z, 0 = nothing
    there: np.ndarray,  # [H, W] z of a chart, 0 = none
    tolerance: float,  # relative
) -> np.ndarray:
    """The depth, but the chart's where it is the chart's surface: splats' depths are rough, photos place charts."""
    same = (there > 0) & (np.abs(depth - there) < tolerance * there)
    return np.where(same, there, depth)


def settle_seeds(
    completed: Completed,
    seeds: Gaussians,
    filled: Gaussians,  # the scene without the object and without the seeds
    views: Sequence[ViewState],
    painting: Propagation,
    settings: RemovalSettings,
) -> Gaussians:
    """The seeds that are needed, in the colours of the painted views."""
    camera, cameras = completed.camera, [v.camera for v in views]
    coloured = colour_gaussians(seeds, camera, cameras, painting.views, filled.sh_degree, settings.seed)
    return settle_gaussians(filled, coloured, camera, cameras, painting.views, settings.seed)


def after_reference(
    views: Sequence[ViewState],
    painted: Sequence[PaintedView],  # the same
    completed: Completed,
    filled: Gaussians,  # the scene with the new Gaussians, which are its last rows
    new: Gaussians,  # that this reference brought
    added: int,  # all new ones
) -> tuple[ViewState, ...]:
    """The views with what a reference painted, and what of them it left open."""

    def after(view: ViewState, part: PaintedView) -> ViewState:
        part, touched = _with_own_picture(part, completed), touched_window(new, view.camera)
        rules = part.rule_map(*view.painted.shape[:2])
        coloured = (rules != Rule.UNTOUCHED) & (rules != Rule.UNREACHED)
        best = max(view.best or (0, completed), (int(coloured.sum()), completed), key=lambda found: found[0])
        told = rules if view.rules is None else np.where(coloured, rules, view.rules)
        picture = redrawn(part.pasted(view.painted), filled, view.masks, touched)
        left = view.left
        if left.target.any():
            left = still_open(left, filled, added, rules, window_mask(touched, view.camera))
        return replace(view, painted=picture, rules=told, best=best, left=left)

    return tuple(parallel_map(lambda pair: after(*pair), zip(views, painted)))


def _with_own_picture(painted: PaintedView, completed: Completed) -> PaintedView:
    """The painted view; the reference's own shows its completed picture, not a mapped one."""
    if painted.camera_id != completed.camera.id:
        return painted
    h, w = painted.rules.shape
    part = slice(painted.top, painted.top + h), slice(painted.left, painted.left + w)
    rules = np.where(completed.target[part], Rule.EVIDENCE, Rule.UNTOUCHED).astype(np.uint8)
    return replace(painted, image=completed.image[part], rules=rules)


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
    around = np.ones((2 * MARGIN + 1,) * 2, np.uint8)
    scene = drawing(filled, view.camera, with_colour=False, pixels=touched | dilated(view.target, MARGIN))
    before, uncoloured = (view.depth_after, view.alpha_after), rules == Rule.UNREACHED
    depth, alpha = (np.where(touched, d, b) for d, b in zip(scene.surface_depth(), before))
    covered = scene.footprint(new) > DRAWN
    target = view.target & (~covered | uncoloured)
    farthest = cv2.dilate(np.where(covered, depth, 0).astype(np.float32), around)
    nearest = cv2.erode(np.where(depth > 0, depth, np.inf).astype(np.float32), around)
    at_edge = nearest < (1 - LAYER_STEP) * depth
    joined = (~uncoloured | (before[1] > SOLID)) & (alpha > SOLID)
    joined &= at_edge | (depth < (1 + LAYER_STEP) * farthest)
    wide = cv2.morphologyEx(target.astype(np.uint8), cv2.MORPH_OPEN, np.ones((2 * MARGIN,) * 2, np.uint8)) > 0
    return replace(view, target=target & (wide | ~joined), depth_after=depth, alpha_after=alpha)


def ask_to_refine(views: Sequence[ViewState], settings: RemovalSettings, call: Call) -> ViewRefinement:
    """Ask the painter that the settings name about as many painted views as refinement looks at."""
    asked = [
        ViewToRefine(v.id, v.painted, v.rules, v.best[1].image, v.best[1].target)
        for v in views
        if v.rules is not None and v.best is not None
    ]
    who = painter(settings.refine_views, call)
    return refine_views(who, looked_at(asked, settings.refine), settings.random_seed, call)


def with_answers(views: Sequence[ViewState], asked: ViewRefinement) -> tuple[ViewState, ...]:
    """The views with the answers that were accepted."""
    answers = {a.camera_id: a.image for a in asked.views if a.image is not None}

    def answered(view: ViewState) -> ViewState:
        image = answers.get(view.id)
        if image is None or view.rules is None:
            return view
        rules = np.where((image != view.painted).any(-1), np.uint8(Rule.REFINED), view.rules)
        return replace(view, painted=image, rules=rules)

    return tuple(map(answered, views))
