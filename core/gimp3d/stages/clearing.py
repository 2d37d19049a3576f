"""What the removal must not leave in the air, and which pixels the charts' holes are, once it is gone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from ..box import Region
from ..compute.threads import parallel_map
from ..gaussians import Gaussians
from ..geometry import sees, window_mask
from ..raster import drawing, footprint, label_weights, touched_window
from ..schema import Share
from .charts import Chart, Hits, extent, first_hits
from .masks import ViewMasks
from .selection import Fate, Selection, near_region
from .witness import Says, Witness, ask

OBJECT, ELSE = 1, 2  # labels of a view's pixels


@dataclass(frozen=True)
class ClearingSettings:
    """When a Gaussian is haze, and what a view's target is."""

    object_weight: Share = 0.25  # blend weight of the removed Gaussians from which a photo shows the object
    some_weight: Share = 0.1  # and from which it may show some of it
    rim: int = 1  # px by which the object is larger in the photo than in the splats
    observed: Share = 0.5  # share of a Gaussian's weight that photos must show
    shown: float = 0.5  # px of blend weight below which a Gaussian draws nothing
    solid: Share = 0.5  # alpha below which the scene has no surface
    low: float = 0.1  # diagonals above the surface up to which a rest of the object may stand
    margin: int = 1  # px by which a target grows within what the object hides


def object_pixels(
    scene: Gaussians, removed: np.ndarray, views: Sequence[ViewMasks], settings: ClearingSettings
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Where each photo shows the object, and where it may show some of it, [H, W] bool each."""
    gone = scene.take(removed)
    kernel = np.ones((2 * settings.rim + 1,) * 2, np.uint8)

    def of(view: ViewMasks) -> tuple[np.ndarray, np.ndarray]:
        window = window_mask(touched_window(gone, view.camera), view.camera)
        weight = footprint(scene, view.camera, removed, pixels=window)
        shown, some = (
            # specks are splats of the floor that went along
            cv2.morphologyEx((weight > least).astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
            for least in (settings.object_weight, settings.some_weight)
        )
        return cv2.dilate(shown, kernel) > 0, cv2.dilate(some, kernel) > 0

    return parallel_map(of, views)


def observed_share(
    kept: Gaussians, rows: np.ndarray, views: Sequence[ViewMasks], witnesses: Sequence[Witness]
) -> tuple[np.ndarray, np.ndarray]:
    """Of each kept Gaussian in `rows` [N] bool: the share of its weight that photos show, and the weight they do not.

    Weights are blend weights in the emptied scene, summed over the pixels of all views; a photo does not show what
    lies where the object is. What only the removal reveals has a share near 0: haze (both [N]).
    """

    def of(pair: tuple[ViewMasks, Witness]) -> np.ndarray:
        view, witness = pair
        labels = np.where(witness.hidden, OBJECT, ELSE).astype(np.uint8)
        return label_weights(kept, view.camera, labels, ELSE, rows)

    total = np.zeros((2, len(kept)))
    pairs = list(zip(views, witnesses))
    for start in range(0, len(pairs), 8):  # few results at a time are in memory
        for part in parallel_map(of, pairs[start : start + 8]):
            total += part
    hidden, seen = total
    return np.where(rows, seen / np.maximum(seen + hidden, 1e-9), 1.0), np.where(rows, hidden, 0.0)


def clear_air(
    scene: Gaussians,
    region: Region,
    selection: Selection,
    views: Sequence[ViewMasks],
    witnesses: Sequence[Witness],
    charts: Sequence[Chart],
    tolerance: float,
    settings: ClearingSettings = ClearingSettings(),
) -> Selection:
    """Remove what only the removal reveals, where no photo shows that anything is; and rests of the object."""
    stays = ~selection.removed
    kept = scene.take(stays)
    near = near_region(scene, region, 1.0)[stays]
    share, hidden = observed_share(kept, near, views, witnesses)
    haze = near & kept.usable & (share < settings.observed) & (hidden > settings.shown)
    candidates = np.flatnonzero(haze)
    said = ask(witnesses, kept.means[candidates].astype(np.float64), tolerance)
    vouched = np.isin(said, (Says.SEEN, Says.BESIDE)).any(0)
    fates = selection.fates.copy()
    fates[np.flatnonzero(stays)[candidates[~vouched]]] = Fate.REMOVED_REVEALED
    rows = np.flatnonzero(stays)[near & kept.usable]
    means = scene.means[rows].astype(np.float64)
    for chart in charts:
        rest = sees(chart.camera, chart.rests.astype(np.float32), means, np.inf)
        low = np.abs(chart.plane.local(means)[:, 2]) < settings.low * extent(region)
        fates[rows[rest & low]] = Fate.REMOVED_REVEALED
    return Selection(fates)


@dataclass(frozen=True)
class Targets:
    """Views without the object, and where charts are in them."""

    views: tuple[ViewMasks, ...]
    hits: tuple[Hits, ...]  # of the same views


def chart_targets(
    scene: Gaussians,
    selection: Selection,
    views: Sequence[ViewMasks],
    witnesses: Sequence[Witness],
    charts: Sequence[Chart],
    tolerance: float,
    marked: Sequence[np.ndarray],  # [H, W] bool each: to be filled too
    settings: ClearingSettings = ClearingSettings(),
) -> Targets:
    """T of every view: rays that meet a chart's hole, or a chart where the emptied scene has no surface.

    What the scene, emptied, shows clearly before a chart is not filled: other photos saw it.
    """
    removed = selection.removed
    gone = scene.take(removed)
    kernel = np.ones((3, 3), np.uint8)

    def of(k: int) -> tuple[ViewMasks, Hits]:
        view, hidden = views[k], witnesses[k].hidden
        window = window_mask(touched_window(gone, view.camera, 24), view.camera) | hidden
        drawn = drawing(scene, view.camera, with_colour=False, pixels=window)
        depth, alpha = drawn.surface_depth(gone=removed)
        touched = drawn.footprint(removed) > 0.05
        depth_after = np.where(window, depth, view.depth_before)
        alpha_after = np.where(window, alpha, view.alpha_before)
        hits = first_hits(charts, view.camera, window)
        unseen = np.zeros(window.shape, bool)
        for number, chart in enumerate(charts):
            there = hits.chart == number
            unseen[there] = (chart.hole | chart.below)[hits.rows[there], hits.cols[there]]
        met = hits.depth > 0
        bare = met & (alpha_after < settings.solid)
        before = (alpha_after >= settings.solid) & (depth_after > 0) & (depth_after < (1 - tolerance) * hits.depth)
        gone_from = hidden | touched
        target = (hidden & unseen & ~before) | (gone_from & bare & (view.alpha_before >= settings.solid))
        target = cv2.morphologyEx(target.astype(np.uint8), cv2.MORPH_CLOSE, kernel)
        target = cv2.dilate(target, kernel, iterations=settings.margin) > 0
        target &= met & ~before & gone_from & ~view.occluder
        return replace(
            view,
            silhouette=hidden | witnesses[k].beside,
            target=target | marked[k],
            depth_after=depth_after,
            alpha_after=alpha_after,
        ), hits

    found = parallel_map(of, range(len(views)))
    return Targets(tuple(v for v, _ in found), tuple(h for _, h in found))
