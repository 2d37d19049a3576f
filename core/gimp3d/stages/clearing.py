"""What the removal must not leave in the air, and which pixels the charts' holes are, once it is gone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from ..box import Region
from ..compute.threads import parallel_map
from ..gaussians import Gaussians
from ..geometry import dilated, framed, window_mask
from ..raster import drawing, label_weights, touched_window
from ..schema import Share
from .charts import Chart, Hits, Laid, extent, first_hits
from .masks import ViewMasks
from .selection import Fate, Selection, near_region
from .witness import Witness, total_over

OBJECT, ELSE = 1, 2  # labels of a view's pixels
SOME_WEIGHT = 0.1  # blend weight of the removed Gaussians from which a photo may show some of the object
RIM = 1  # px by which the object is larger in the photo than in the splats
SPECK = 3  # px; smaller spots are splats of the floor that went along
HAZE_WEIGHT = 0.5  # px of blend weight, over all views, below which a Gaussian draws nothing
LEAST_SEEN = 0.5  # px of blend weight in a photo, below which it shows nothing of a Gaussian
LOW = 0.1  # diagonals of the region over or below a surface up to which a Gaussian may be its
REACH = 24  # px round the removed Gaussians in which the scene is drawn anew: their dilated surroundings
TOUCHED = 0.05  # blend weight of the removed Gaussians from which a pixel changes
SURFACE = 0.5  # opacity below which the scene has no surface


@dataclass(frozen=True)
class ClearingSettings:
    """What counts as the object in photos, and as haze."""

    object_weight: Share = 0.25  # blend weight of the object in a pixel that shows it; rests left against more to fill
    observed: Share = 0.2  # share of its weight in a view that a photo must show; haze left against true surface lost


def object_pixels(
    scene: Gaussians, views: Sequence[ViewMasks], settings: ClearingSettings, *sets: np.ndarray
) -> tuple[Sequence[tuple[np.ndarray, np.ndarray]], ...]:
    """What each photo shows of removed Gaussians, for each of up to three sets, [N] bool; see pixels_of."""
    gone = scene.take(np.logical_or.reduce(sets))

    def of(view: ViewMasks) -> list[tuple[np.ndarray, np.ndarray]]:
        window = window_mask(touched_window(gone, view.camera), view.camera)
        drawn = drawing(scene, view.camera, with_colour=False, pixels=window)
        return [pixels_of(weight, settings) for weight in drawn.footprints(*sets)]

    return tuple(zip(*parallel_map(of, views)))


def pixels_of(weight: np.ndarray, settings: ClearingSettings) -> tuple[np.ndarray, np.ndarray]:
    """Where a photo shows the object, and where it may show some of it, [H, W] bool each, by its blend weight."""
    shown, some = (
        dilated(cv2.morphologyEx((weight > least).astype(np.uint8), cv2.MORPH_OPEN, np.ones((SPECK, SPECK))), RIM)
        for least in (settings.object_weight, SOME_WEIGHT)
    )
    return shown, some


def over_surfaces(scene: Gaussians, region: Region, laid: Sequence[Laid]) -> tuple[np.ndarray, np.ndarray]:
    """What lies low over a surface or as little below it, and what lies below one; [N] bool each."""
    low, sunk = np.zeros((2, len(scene)), bool)
    means = scene.means.astype(np.float64)
    for one in laid:
        index, *at, z = framed(one.camera, means)
        above = one.depth[tuple(at)] - z
        low[index] |= np.abs(above) < LOW * extent(region)
        sunk[index] |= above < 0
    return low, sunk


def clear_air(
    scene: Gaussians,
    region: Region,
    selection: Selection,
    witnesses: Sequence[Witness],
    beside: np.ndarray,  # [N] bool, what photos show beside the object by its colours: no haze
    settings: ClearingSettings = ClearingSettings(),
) -> Selection:
    """Remove what only the removal reveals and no photo shows.

    A photo shows a Gaussian by a share of what that draws in the emptied scene: not what lies where the object is, and
    it does not tell what is right beside that.
    """
    stays, near = ~selection.removed, scene.usable & near_region(scene, region, 1.0)
    kept, rows, fates = scene.take(stays), np.flatnonzero(stays & near), selection.fates.copy()

    def of(witness: Witness) -> np.ndarray:
        labels = np.where(witness.hidden, OBJECT, np.where(witness.beside, 0, ELSE)).astype(np.uint8)
        hidden, seen = label_weights(kept, witness.camera, labels, ELSE, near[stays])
        return np.stack([(seen > LEAST_SEEN) & (seen >= settings.observed * (seen + hidden)), hidden])

    photos, hidden = total_over(witnesses, of, (2, len(kept)))[:, near[stays]]
    fates[rows[(photos == 0) & (hidden > HAZE_WEIGHT) & ~beside[rows]]] = Fate.REMOVED_REVEALED
    return Selection(fates)


def chart_targets(
    scene: Gaussians,
    selection: Selection,
    views: Sequence[ViewMasks],
    witnesses: Sequence[Witness],
    charts: Sequence[Chart],
    marked: Sequence[np.ndarray],  # [H, W] bool each: to be filled too
) -> list[tuple[ViewMasks, Hits]]:
    """T of every view: rays that meet a chart's hole, or a chart where the emptied scene has no surface. And what of
    the charts its rays meet.

    What the scene, emptied, shows clearly before a chart is not filled: other photos saw it.
    """
    removed, tolerance = selection.removed, max(c.tolerance for c in charts)
    gone, holes = scene.take(removed), [c.hole for c in charts]

    def of(k: int) -> tuple[ViewMasks, Hits]:
        view, hidden = views[k], witnesses[k].hidden
        window = window_mask(touched_window(gone, view.camera, REACH), view.camera) | hidden
        drawn = drawing(scene, view.camera, with_colour=False, pixels=window)
        with_object = view.depth_before, view.alpha_before
        depth, alpha = (np.where(window, a, b) for a, b in zip(drawn.surface_depth(gone=removed), with_object))
        hits = first_hits(charts, view.camera, window)
        unseen, met = hits.of(holes), hits.depth > 0
        before = (alpha >= SURFACE) & hits.behind(depth, tolerance)
        gone_from = hidden | (drawn.footprint(removed) > TOUCHED)
        target = (hidden & unseen & ~before) | (gone_from & met & (alpha < SURFACE) & (view.alpha_before >= SURFACE))
        target = dilated(cv2.morphologyEx(target.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((3, 3))), RIM)
        target = (target & met & ~before & gone_from & ~view.occluder) | marked[k]
        touched = hidden | witnesses[k].beside
        return replace(view, silhouette=touched, target=target, depth_after=depth, alpha_after=alpha), hits

    return parallel_map(of, range(len(views)))
