"""A completed reference carried into the scene: seeds, mapping field, painted views, and Gaussians that show them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from ..gaussians import Gaussians
from ..geometry import window_mask
from ..presets import RemovalSettings
from ..progress import Progress
from ..raster import surface_depth
from ..stages.charts import CHART, Chart
from ..stages.mapping import MappingField, mapping_field, source_visibility
from ..stages.propagate import PaintedView, Propagation, Reference, Rule, ViewToPaint, near_hole, propagate
from ..stages.seed import seed_gaussians, settle_gaussians
from ..view_state import ViewState
from .completion import Completed


def seed_surface(completed: Completed, surfels: bool, settings: RemovalSettings) -> Gaussians:
    """Gaussians that tile the completed surface."""
    c = completed
    at_chart = c.camera.split == CHART
    return seed_gaussians(c.camera, c.appearance.image, c.depth, c.target, surfels, settings.seed, at_chart)


def map_reference(completed: Completed, views: Sequence[ViewState], settings: RemovalSettings) -> MappingField:
    """Where each pixel of the reference's hole has its like, in what the views show: the paper's sampling asks."""
    c = completed
    seen = [(v.camera, v.left.depth_before, v.left.silhouette) for v in views]
    visibility = source_visibility(c.camera, c.depth, seen)
    return mapping_field(
        c.appearance.image,
        c.target,
        c.source,
        visibility,
        settings.mapping,
        settings.random_seed,
    )


def as_reference(completed: Completed) -> Reference:
    c = completed
    return Reference(c.camera, c.appearance.image, c.depth, c.target, c.source)


def paint_views(
    completed: Completed,
    field: MappingField | None,
    views: Sequence[ViewState],
    with_seeds: Gaussians,  # the scene without the object, the seeds in it
    settings: RemovalSettings,
    progress: Progress,
) -> Propagation:
    """Every view with the completed reference in its hole."""

    def load(view: ViewState) -> ViewToPaint:
        if completed.charts:
            return _on_charts(view, completed.charts)
        return _as_drawn(view, with_seeds)

    loaders = [partial(load, v) for v in views]
    sources = None if field is None else (field.rows, field.cols)
    return propagate(as_reference(completed), loaders, settings.propagate, progress, sources)


def with_own_picture(painted: PaintedView, completed: Completed) -> PaintedView:
    """The painted view; the reference's own shows its completed picture, not a mapped one."""
    if painted.camera_id != completed.camera.id:
        return painted
    h, w = painted.rules.shape
    part = slice(painted.top, painted.top + h), slice(painted.left, painted.left + w)
    rules = np.where(completed.target[part], Rule.EVIDENCE, Rule.UNTOUCHED).astype(np.uint8)
    image = completed.appearance.image[part]
    return replace(painted, image=image, raw=image, rules=rules)


def settle_seeds(
    completed: Completed,
    seeds: Gaussians,
    filled: Gaussians,  # the scene without the object and without the seeds
    views: Sequence[ViewState],
    painting: Propagation,
    settings: RemovalSettings,
) -> Gaussians:
    """The seeds that are needed, in the colours of the painted views."""
    looks = [(v.camera, paint) for v, paint in zip(views, painting.views)]
    return settle_gaussians(filled, seeds, completed.camera, looks, settings.seed)


def snapped(
    depth: np.ndarray,  # [H, W] z, 0 = nothing
    there: np.ndarray,  # [H, W] z of a chart, 0 = none
    tolerance: float,  # relative
) -> np.ndarray:
    """The depth, but the chart's where it is the chart's surface: splats' depths are rough, photos place charts."""
    same = (there > 0) & (np.abs(depth - there) < tolerance * there)
    return np.where(same, there, depth)


def _on_charts(view: ViewState, charts: Sequence[Chart]) -> ViewToPaint:
    """The view with the charts for its depth, where its own is theirs or none."""
    assert view.hits is not None
    v, there = view.left, view.hits.depth
    tolerance, scatter = max(c.tolerance for c in charts), max(c.scatter for c in charts)
    behind = (v.depth_after == 0) | (v.depth_after > (1 - tolerance) * there)
    after = np.where(v.target & (there > 0) & behind, there, snapped(v.depth_after, there, scatter))
    before = snapped(v.depth_before, there, scatter)
    return ViewToPaint(v.camera, view.bare, view.painted, v.silhouette, v.target, before, after)


def _as_drawn(view: ViewState, with_seeds: Gaussians) -> ViewToPaint:
    """The view with the depth of its splats, the new ones among them."""
    v = view.left
    after = np.zeros_like(v.depth_before)
    if v.target.any():
        window = window_mask(near_hole(v.target), v.camera)
        after = surface_depth(with_seeds, v.camera, pixels=window)[0]
    return ViewToPaint(v.camera, view.bare, view.painted, v.silhouette, v.target, v.depth_before, after)
