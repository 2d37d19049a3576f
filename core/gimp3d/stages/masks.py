"""Where each view has to be filled once the object is gone (paper 3.2, METHOD section 1)."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, TypeVar

import cv2
import numpy as np
import scipy.sparse
import scipy.sparse.csgraph

from ..box import Region, in_region
from ..camera import Camera
from ..compute.threads import parallel_map
from ..errors import BadInput, IllPosed
from ..gaussians import Gaussians
from ..geometry import cropped, surface_points, window_mask, window_round
from ..progress import Progress, silent
from ..raster import drawing, render, touched_window
from ..schema import Positive, Share
from .growth import NOTHING, Growth, GrowthSettings, find_growth
from .outline import Window, box_polygon, fill_polygon, guard_gaussians
from .selection import (
    Fate,
    Selection,
    SelectionSettings,
    Shows,
    Sighting,
    boxes_of,
    by_centre,
    near_region,
    object_and_rim,
    select,
    select_removed,
    standing,
    surface_in,
    weigh,
    weigh_revealed,
    without_revealed,
)
from .surroundings import follow_surroundings
from .visibility import HIDES, SHOWN, Sight, depth_agreement

T = TypeVar("T")
R = TypeVar("R")


@dataclass(frozen=True)
class MaskSettings:
    """How target regions are found. Lengths in pixels, depths relative."""

    mode: Literal["need", "paper"] = "need"  # "need": only what no view shows; "paper": polygon minus guard footprints
    guard_scale: Positive = 1.2  # the guard band's size over the polygon's (paper 3.2, s)
    guard_footprint: Share = 0.5  # accumulated alpha of guard Gaussians above which a pixel needs no fill
    changed: Share = 0.02  # blend weight of removed Gaussians above which the object touched a pixel
    hides: Share = 0.5  # blend weight of removed Gaussians above which a pixel shows nothing else
    solid: Share = 0.9  # alpha after removal from which a surface counts as there
    void: Share = 0.1  # alpha after removal below which there is nothing
    depth_tolerance: Share = 0.02  # relative z difference within which two views see the same surface
    near: Positive = 1e-3  # near plane for clipping the box, as a share of the box's diagonal
    layer_step: Share = 0.05  # relative z step between neighbouring pixels that parts two surfaces
    occluder_step: Share = 0.03  # of disparity (relative) by which a kept surface, continued, lies before the object
    infinity: Positive = 10.0  # distances of the object from which a surface is sky
    least_outside: int = 20  # px of a surface that must lie beyond the object for it to count as continuing there
    least_border: float = (
        0.25  # and times `around` and the root of what the object covers of it: leaks have a narrow rim
    )
    margin: int = 2  # px by which a target grows, against the rim's mixed pixels
    around: int = 24  # px round what the object touched that are drawn anew without it
    usual_agreement: Share = 0.97  # share of surface that two views of a good scan place alike
    least_agreement: Share = 0.5  # share of surface that two views must place alike, else the mode is "paper"
    least_likeness: Share = 0.5  # correlation of photos with what the scene shows, else the mode is "paper"
    selection: SelectionSettings = SelectionSettings()
    grow: bool = False  # take along what of the object the boxes cut off
    growth: GrowthSettings = GrowthSettings()


@dataclass(frozen=True)
class ViewMasks:
    """What a view shows before and after the removal; all arrays [H, W] of the view.

    Hundreds of these are held at once, so all but `depth_before` and `alpha_before` are kept small and made anew each
    time they are read.
    """

    camera: Camera
    polygon: np.ndarray  # bool, the projected boxes
    silhouette: np.ndarray  # bool, pixels that the removed Gaussians touched, and those of the extra mask
    occluder: np.ndarray  # bool, kept surfaces in front of the object, at its outline
    target: np.ndarray  # bool, T: the pixels to fill
    depth_before: np.ndarray  # float32 z of the scene with the object, 0 = nothing, or nothing to be trusted
    alpha_before: np.ndarray  # float32
    depth_after: np.ndarray  # float32 z without it
    alpha_after: np.ndarray  # float32


class _Bits:
    """A field of ViewMasks that is a bool picture: kept as bits."""

    def __init__(self, name: str) -> None:
        self.name = name

    def __set__(self, view: ViewMasks, mask: np.ndarray) -> None:
        view.__dict__[self.name] = np.packbits(mask, axis=1), mask.shape[1]

    def __get__(self, view: ViewMasks, owner: type) -> np.ndarray:
        bits, width = view.__dict__[self.name]
        return np.unpackbits(bits, axis=1, count=width).view(bool)


class _Like:
    """A field of ViewMasks that is mostly as another one: only the rectangle is kept in which it is not."""

    def __init__(self, name: str, base: str) -> None:
        self.name, self.base = name, base

    def __set__(self, view: ViewMasks, picture: np.ndarray) -> None:
        other = picture != getattr(view, self.base)
        rows, cols = np.flatnonzero(other.any(1)), np.flatnonzero(other.any(0))
        window = np.s_[rows[0] : rows[-1] + 1, cols[0] : cols[-1] + 1] if len(rows) else np.s_[:0, :0]
        view.__dict__[self.name] = window, picture[window].copy()

    def __get__(self, view: ViewMasks, owner: type) -> np.ndarray:
        window, values = view.__dict__[self.name]
        picture = getattr(view, self.base).copy()
        picture[window] = values
        return picture


for _name in ("polygon", "silhouette", "occluder", "target"):
    setattr(ViewMasks, _name, _Bits(_name))
for _what in ("depth", "alpha"):
    setattr(ViewMasks, f"{_what}_after", _Like(f"{_what}_after", f"{_what}_before"))


@dataclass(frozen=True)
class Masks:
    """The removal's masks in every usable view."""

    selection: Selection
    views: tuple[ViewMasks, ...]
    left_out: tuple[str, ...]  # IDs of cameras inside the region, or whose frame misses it
    mode: str  # the mode really used
    confidence: float
    reason: str
    warnings: tuple[str, ...] = ()
    growth: Growth | None = None  # what the boxes cut off; None if nothing was looked for, as in the preset paper

    @property
    def removed(self) -> np.ndarray:
        """[N] bool."""
        return self.selection.removed

    @property
    def proposed(self) -> dict[str, Any]:
        """What else of the object there is, see Growth.facts."""
        return self.growth.facts if self.growth else NOTHING

    def grown(self, region: Region) -> Region:
        """The boxes that hold what goes: larger ones if what they cut off goes too."""
        return self.growth.region if self.growth and self.growth.taken else region

    @property
    def hole_pixels(self) -> int:
        return int(sum(v.target.sum() for v in self.views))


def find_masks(
    gaussians: Gaussians,
    region: Region,
    cameras: Sequence[Camera],
    settings: MaskSettings = MaskSettings(),
    progress: Progress = silent,
    photos: Mapping[str, np.ndarray] | None = None,  # ID → [H, W, 3] uint8, with the object
    extra: Mapping[str, np.ndarray] | None = None,  # ID → [H, W] bool, to be filled too: shadows, reflections
) -> Masks:
    """Select the object's Gaussians and find the target region T of every view (paper 3.2; METHOD section 1).

    Every view is drawn a fixed number of times. What appears behind the object is judged as points of space, by all
    views together, so that all targets agree.

    Raises
    ------
    BadInput
        If the mode is unknown, or a photo or an extra mask has not its view's size.
    IllPosed
        If every Gaussian is selected, or no camera sees the region from outside.
    """
    if settings.mode not in ("need", "paper"):
        raise BadInput(f"masks: unknown mode {settings.mode!r}; use need or paper")
    inside = select_removed(gaussians, region)
    if not inside.any():
        return Masks(by_centre(inside), (), (), settings.mode, 1.0, "the region holds no Gaussian: nothing to remove")
    if inside[gaussians.usable].all():
        raise IllPosed("ROI: it holds the whole scene; nothing would be left to fill from, make it smaller")
    usable = [c for c in cameras if not any(b.contains(c.centre[None])[0] for b in region)]
    polygons = {c.id: _polygons(region, c, settings) for c in usable}
    seeing = [c for c in usable if any(fill_polygon(p, c.width, c.height).any() for p in polygons[c.id])]
    if not seeing:
        within = len(cameras) - len(usable)
        raise IllPosed(
            f"no usable view: of {len(cameras)} cameras {within} are inside the ROI and the others do not frame it; "
            "add views that look at it from outside"
        )
    passes = _Passes(progress, 3 * len(seeing))
    before = passes.over(lambda c: _look(gaussians, c, polygons[c.id], photos or {}, extra or {}, settings), seeing)
    agreement = depth_agreement(seeing, [b.depth for b in before], [b.window for b in before], settings.depth_tolerance)
    selection, growth = by_centre(inside), None
    if not settings.selection.by_centre:
        # Where views disagree on what they see, trainers have left that much more smears behind the object.
        lacking = max(0.0, settings.usual_agreement - agreement)
        rough = replace(settings.selection, support=settings.selection.support and settings.selection.support + lacking)
        selection, before, growth = _choose(gaussians, region, before, passes, replace(settings, selection=rough))
    gone = gaussians.take(selection.removed)
    after = passes.over(lambda b: _without(gaussians, gone, selection.removed, b, settings), before)
    centre = np.mean([box.center for box in region], axis=0)
    sight = Sight.make([(b.camera, b.depth, _untrusted(b, a, settings)) for b, a in zip(before, after)], centre)
    mode, warnings = settings.mode, _inconsistencies(before, agreement, settings) if settings.mode == "need" else ()
    if warnings:
        mode = "paper"

    def view_masks(k: int) -> ViewMasks:
        if mode == "paper":
            needed = _uncovered(gaussians, selection.removed, before[k], settings)
        else:
            needed = _needed(before[k].camera, after[k], sight, centre, settings)
        return _view_masks(before[k], after[k], needed, not warnings, settings)

    views = tuple(parallel_map(view_masks, range(len(before))))
    left_out = tuple(c.id for c in cameras if c not in seeing)
    share = sum(v.target.sum() for v in views) / max(1, sum(v.polygon.sum() for v in views))
    reason = f"{selection.words}; {len(views)} views see the region, {share:.0%} of its projection needs filling"
    confidence = len(views) / len(cameras) * (0.5 if warnings else 1.0)
    told = [growth.words] if growth and growth.words else []
    if settings.grow and growth is None:
        told = ["--grow does nothing here: the boxes alone tell what goes, as always in the preset paper"]
    return Masks(
        selection, views, left_out, mode, confidence, "; ".join([*warnings, reason]), (*warnings, *told), growth
    )


def _inconsistencies(before: Sequence[_Before], agreement: float, settings: MaskSettings) -> tuple[str, ...]:
    """Why what one view shows says nothing about the others, in words."""
    instead = "every pixel of the box's outline is filled (mode paper)"
    likeness = [b.likeness for b in before if np.isfinite(b.likeness)]
    found = []
    if agreement < settings.least_agreement:
        found.append(f"views place only {agreement:.0%} of the surface alike: {instead}")
    if likeness and np.median(likeness) < settings.least_likeness:
        found.append(
            f"photos and scene do not match (correlation {np.median(likeness):.2f}), check the poses: {instead}"
        )
    return tuple(found)


def _polygons(region: Region, camera: Camera, settings: MaskSettings) -> list[np.ndarray]:
    found = (box_polygon(b, camera, settings.near * float(np.linalg.norm(b.size))) for b in region)
    return [p for p in found if p is not None]


class _Passes:
    """Work on all views, several times over, with progress."""

    def __init__(self, progress: Progress, total: int) -> None:
        self.progress, self.total, self.done = progress, total, 0

    def over(self, work: Callable[[T], R], views: Iterable[T]) -> list[R]:
        def counted(view: T) -> R:
            result = work(view)
            self.done += 1
            self.progress("masks", self.done, self.total)
            return result

        return parallel_map(counted, views)


@dataclass(frozen=True)
class _Before:
    """A view with the object; arrays [H, W]."""

    camera: Camera
    polygons: list[np.ndarray]
    window: Window  # of the region and a margin
    depth: np.ndarray
    alpha: np.ndarray
    agrees: np.ndarray | None  # bool, of the window: the photo shows what the scene shows; None if there is none
    likeness: float  # correlation of photo and scene in the window; NaN if it cannot be told
    extra: np.ndarray | None  # bool, the extra mask

    @property
    def misfit(self) -> np.ndarray:
        """[H, W] bool: the photo shows something else, as far as it was looked at."""
        found = np.zeros(self.depth.shape, bool)
        if self.agrees is not None:
            found[self.window] = ~self.agrees
        return found


@dataclass(frozen=True)
class _After:
    """The part of a view that the object touched, and a margin, without the object; arrays of the window's size."""

    window: Window
    depth: np.ndarray
    alpha: np.ndarray
    weight: np.ndarray  # blend weight of the removed Gaussians, with the object in place


def _look(
    gaussians: Gaussians,
    camera: Camera,
    polygons: list[np.ndarray],
    photos: Mapping[str, np.ndarray],
    extra: Mapping[str, np.ndarray],
    settings: MaskSettings,
) -> _Before:
    size = (camera.height, camera.width)
    photo, mask = photos.get(camera.id), extra.get(camera.id)
    for kind, picture in (("photo", photo), ("extra mask", mask)):
        if picture is not None and picture.shape[:2] != size:
            raise BadInput(
                f"masks: the {kind} of {camera.id} is {picture.shape[1]}×{picture.shape[0]}, not {size[1]}×{size[0]}"
            )
    window = window_round(np.concatenate(polygons), camera, settings.around)
    agrees, likeness = None, np.nan
    compare = photo is not None and not settings.selection.by_centre
    scene = drawing(gaussians, camera, with_colour=compare)
    depth, alpha = scene.surface_depth()
    if photo is not None and compare:
        drawn = np.clip(scene.render(frozenset({"rgb"}), window_mask(window, camera)).rgb[window], 0, 1)
        shown = photo[window] / np.float32(255)
        misfit = np.abs(drawn - shown).max(-1)
        limit = max(settings.selection.least_misfit, settings.selection.misfit * float(np.median(misfit)))
        agrees, likeness = misfit <= limit, _correlation(drawn.mean(-1), shown.mean(-1))
    return _Before(camera, polygons, window, depth, alpha, agrees, likeness, mask)


def _correlation(a: np.ndarray, b: np.ndarray) -> float:
    """Pearson's; NaN where either is constant."""
    a, b = a - a.mean(), b - b.mean()
    spread = float(np.sqrt((a * a).sum() * (b * b).sum()))
    return float((a * b).sum()) / spread if spread > 1e-6 * a.size else np.nan


def _choose(
    gaussians: Gaussians, region: Region, before: Sequence[_Before], passes: _Passes, masks: MaskSettings
) -> tuple[Selection, list[_Before], Growth | None]:
    """Which Gaussians go, by what views show of them; the views, what else the user named masked out; what was cut off.

    Where nothing stands out of the surface in a box, the surface itself is meant: a shadow, a picture on the floor.
    """
    settings, depths = masks.selection, [(b.camera, b.depth) for b in before]
    surroundings = [follow_surroundings(box, region, depths, settings.surroundings) for box in region]
    centre = by_centre(select_removed(gaussians, region))
    if all(box.size.max() < settings.least_cells * s.cell for box, s in zip(region, surroundings)):
        return centre, list(before), None  # pictures this small show no surface to follow
    seen = passes.over(lambda b: object_and_rim(b.camera, b.depth, region, surroundings, settings), before)
    members = [boxes_of(b.camera, np.where(o, b.depth, 0), region, surroundings) for b, (o, _) in zip(before, seen)]
    stands = standing(members, [int(_polygon_pixels(b).sum()) for b in before], settings.least_object)
    objects = tuple(box for box, s in zip(region, stands) if s)
    named = tuple(box for box, s in zip(region, stands) if not s)

    def with_named(view: _Before) -> _Before:
        mask = surface_in(view.camera, view.depth, named) & ~surface_in(view.camera, view.depth, objects)
        return replace(view, extra=mask if view.extra is None else mask | view.extra)

    views = parallel_map(with_named, before) if named else list(before)
    if not objects:
        return centre, views, None

    def sighting(view: _Before, object_: np.ndarray, ring: np.ndarray) -> Sighting:
        shows = np.full(object_.shape, Shows.CLEAR, np.uint8)
        shows[ring | view.misfit] = Shows.NOTHING
        shows[object_] = Shows.OBJECT
        if view.extra is not None:
            shows[view.extra] = Shows.MASKED
        return Sighting(view.camera, shows, view.extra is not None)

    sightings = parallel_map(lambda k: sighting(views[k], *seen[k]), range(len(views)))
    near = near_region(gaussians, objects)
    weights = weigh(gaussians, near, sightings)
    selection = select(gaussians, objects, weights, [s for s, o in zip(surroundings, stands) if o], settings)
    if settings.support > 0:
        revealed = weigh_revealed(gaussians, selection, near, sightings)
        selection = without_revealed(gaussians, selection, objects, weights.clear, revealed, settings)
    growth = find_growth(gaussians, objects, selection, weights, depths, masks.growth)
    fates = np.where(growth.rows & masks.grow, np.uint8(Fate.REMOVED_GROWN), selection.fates)
    alone = select_removed(gaussians, named) & ~in_region(objects, gaussians.means.astype(np.float64))
    growth = replace(growth, region=growth.region + named, taken=masks.grow and growth.box is not None)
    return Selection(np.where(alone, np.uint8(Fate.REMOVED_INSIDE), fates)), views, growth


def _without(
    gaussians: Gaussians,
    gone: Gaussians,
    removed: np.ndarray,  # [N] bool
    view: _Before,
    settings: MaskSettings,
) -> _After:
    """A view without the object; only the part that the object touched is drawn anew."""
    window = touched_window(gone, view.camera, settings.around)
    scene = drawing(gaussians, view.camera, with_colour=False, pixels=window_mask(window, view.camera))
    depth, alpha, weight = (*scene.surface_depth(gone=removed), scene.footprint(removed))
    return _After(window, depth[window].copy(), alpha[window].copy(), weight[window].copy())


def _untrusted(before: _Before, after: _After, settings: MaskSettings) -> np.ndarray:
    """[H, W] bool: pixels that are no evidence of what is behind the object."""
    hidden = before.misfit
    hidden[after.window] |= after.weight > settings.hides
    return hidden if before.extra is None else hidden | before.extra


def _needed(view: Camera, after: _After, sight: Sight, centre: np.ndarray, settings: MaskSettings) -> np.ndarray:
    """[H, W] bool: pixels that the object touched and that now show nothing that a view saw (METHOD section 1).

    A sky that goes on beyond the object is as little a hole as a void. Half covered pixels at a void that counts as
    seen are the edge of what stands before it, as splats blur it. Parts thinner than 3 px are mostly depth edges, where
    a pixel's depth is of neither side, or surface that views place a little differently. They count only where that is
    excluded: no view sees past what appears there or shows it within twice the tolerance, and the object hides it from
    more views than other surfaces do.
    """
    camera = cropped(view, after.window)
    touched = after.weight > settings.changed
    solid = touched & (after.alpha >= settings.solid)
    window = window_round(np.argwhere(touched)[:, ::-1], camera, settings.around)
    rows, cols, points = surface_points(camera, np.where(solid, after.depth, 0), window)
    evidence = touched & (after.alpha < settings.void)
    distance = float(np.linalg.norm(camera.centre - centre))
    shown = sight.of(points, settings.depth_tolerance) == SHOWN
    evidence[rows, cols] = shown | (after.depth[rows, cols] > settings.infinity * distance)
    continues = np.zeros_like(touched)
    continues[window] = _continues_outside(
        after.depth[window], after.alpha[window], touched[window], distance, settings
    )
    evidence &= continues
    void = (continues & (after.alpha < settings.void)).astype(np.uint8)
    evidence |= touched & ~solid & (cv2.dilate(void, np.ones((7, 7), np.uint8)) > 0)
    certain = after.weight > settings.hides
    certain[rows, cols] &= sight.of(points, 2 * settings.depth_tolerance) == HIDES
    needed = np.zeros((view.height, view.width), bool)
    needed[after.window] = _tidy(touched & ~evidence, certain, touched, settings.margin)
    return needed


def _uncovered(gaussians: Gaussians, removed: np.ndarray, view: _Before, settings: MaskSettings) -> np.ndarray:
    """[H, W] bool: T as the paper defines it, the polygon less the guard Gaussians' footprints."""
    camera, usable = view.camera, ~removed & gaussians.usable
    guards = [guard_gaussians(gaussians, usable, p, camera, settings.guard_scale) for p in view.polygons]
    covered = render(gaussians.take(np.any(guards, axis=0)), camera, passes=frozenset({"alpha"})).alpha
    return _polygon_pixels(view) & (covered <= settings.guard_footprint)


def _polygon_pixels(view: _Before) -> np.ndarray:
    return np.any([fill_polygon(p, view.camera.width, view.camera.height) for p in view.polygons], axis=0)


def _view_masks(
    before: _Before, after: _After, needed: np.ndarray, consistent: bool, settings: MaskSettings
) -> ViewMasks:
    window, depth = after.window, before.depth
    silhouette, occluder, beside = np.zeros((3, *depth.shape), bool)
    silhouette[window] = after.weight > settings.changed
    if consistent:  # else depths say nothing
        occluder[window] = _in_front(depth[window], after.weight > 0.5, settings)
    beside[window] = cv2.dilate(occluder[window].astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    target = needed & ~occluder & (silhouette | ~beside)  # beside what is in front T must not outgrow the object
    if before.extra is not None:
        target, silhouette, depth = target | before.extra, silhouette | before.extra, np.where(before.extra, 0, depth)
    depth_after, alpha_after = before.depth.copy(), before.alpha.copy()
    depth_after[window], alpha_after[window] = after.depth, after.alpha
    return ViewMasks(
        before.camera,
        _polygon_pixels(before),
        silhouette,
        occluder,
        target,
        depth,
        before.alpha,
        depth_after,
        alpha_after,
    )


def _in_front(depth: np.ndarray, object_: np.ndarray, settings: MaskSettings) -> np.ndarray:
    """[H, W] bool: surface at the object's outline behind whose continuation the object lies, and a pixel round it.

    The continuation is a plane in disparity, level where the surface falls off on its other side. The floor before the
    object's foot rises to it and is not in front, however flat the view; a thin rod is, close as it may stand.
    """
    reach = max(1, settings.margin)
    disparity = np.divide(1, depth, out=np.zeros_like(depth), where=depth > 0)
    padded = np.pad(disparity, reach, "reflect", reflect_type="odd")  # slopes go on beyond the frame
    there = np.pad(object_ & (depth > 0), reach)
    (h, w), front = depth.shape, np.zeros_like(object_)
    for dy, dx in ((dy, dx) for dy in (-reach, 0, reach) for dx in (-reach, 0, reach) if dy or dx):
        ahead = np.s_[reach + dy : reach + dy + h, reach + dx : reach + dx + w]
        behind = np.s_[reach - dy : reach - dy + h, reach - dx : reach - dx + w]
        continued = np.minimum(disparity, 2 * disparity - padded[behind])
        front |= there[ahead] & (padded[ahead] < (1 - settings.occluder_step) * continued)
    return cv2.dilate((front & ~object_).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0


def _continues_outside(
    depth: np.ndarray,  # [H, W] z without the object, 0 = nothing
    alpha: np.ndarray,  # [H, W]
    touched: np.ndarray,  # [H, W] bool, by the object
    distance: float,  # of the object, beyond which steps are of disparity, as for Sight
    settings: MaskSettings,
) -> np.ndarray:
    """[H, W] bool: surfaces, and the void of scans without a background, that go on beyond what the object touched.

    What shows through a gap that a nearer surface encloses (the sky below a table that the box cut open) may be seen
    by other views past the table's edge, but it is not what was behind the object. Tables of rough scans leak beside
    the object too, but little, for all that shows behind it.
    """
    z, void = depth, alpha < settings.void
    there = (z > 0) & (alpha >= settings.solid) | void
    index = np.arange(z.size).reshape(z.shape)
    pairs = []
    for near, far in ((np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1], np.s_[1:])):
        low, high = np.minimum(z[near], z[far]), np.maximum(z[near], z[far])
        close = high - low < settings.layer_step * low * np.maximum(1, high / distance)
        same = there[near] & there[far] & np.where(void[near], void[far], close & ~void[far])
        pairs.append(np.stack([index[near][same], index[far][same]]))
    a, b = np.concatenate(pairs, axis=1)
    graph = scipy.sparse.coo_matrix((np.ones(len(a), bool), (a, b)), (z.size, z.size))
    count, surface = scipy.sparse.csgraph.connected_components(graph, directed=False)
    surface = surface.reshape(z.shape)
    outside = np.bincount(surface[there & ~touched], minlength=count)
    covered = np.bincount(surface[there & touched], minlength=count)
    enough = np.maximum(settings.least_outside, settings.least_border * settings.around * np.sqrt(covered))
    return there & (outside >= enough)[surface]


def _tidy(
    target: np.ndarray,  # [H, W] bool
    certain: np.ndarray,  # [H, W] bool, where thin parts are no noise
    allowed: np.ndarray,  # [H, W] bool, what the object touched
    margin: int,
) -> np.ndarray:
    """Close pinholes, drop thin parts that are not certain, and grow by a margin within what the object touched."""
    kernel = np.ones((3, 3), np.uint8)
    solid = cv2.morphologyEx(target.astype(np.uint8), cv2.MORPH_OPEN, kernel)
    solid = cv2.morphologyEx(solid, cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8))
    grown = cv2.dilate(solid, kernel, iterations=margin)
    thin = target & certain & (grown == 0)
    grown |= cv2.dilate(thin.astype(np.uint8), kernel, iterations=margin)
    return (grown > 0) & cv2.dilate(allowed.astype(np.uint8), kernel).astype(bool)
