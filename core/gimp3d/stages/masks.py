"""Where each view has to be filled once the object is gone (paper 3.2, METHOD section 1)."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import cv2
import numpy as np
import scipy.sparse
import scipy.sparse.csgraph

from ..box import Box, Region
from ..camera import Camera
from ..errors import BadInput, IllPosed
from ..gaussians import Gaussians
from ..progress import Progress, silent
from ..raster import contributions, footprint, render, surface_depth
from ..threads import parallel_map
from .selection import (
    Selection,
    SelectionSettings,
    Sighting,
    Weights,
    by_centre,
    object_and_rim,
    select,
    select_removed,
    weigh,
    without_revealed,
)
from .surroundings import follow_surroundings
from .visibility import Sight

T = TypeVar("T")
R = TypeVar("R")

EDGES = [(a, a | 1 << b) for a in range(8) for b in range(3) if not a >> b & 1]  # a box's 12 edges, see Box.corners


@dataclass(frozen=True)
class MaskSettings:
    """How target regions are found. Lengths in pixels, depths relative."""

    mode: str = "need"  # "need": only what no view shows; "paper": polygon minus guard footprints
    guard_scale: float = 1.2  # the guard band's size over the polygon's (paper 3.2, s)
    guard_footprint: float = 0.5  # accumulated alpha of guard Gaussians above which a pixel needs no fill
    changed: float = 0.02  # blend weight of removed Gaussians above which the object touched a pixel
    hides: float = 0.3  # blend weight of removed Gaussians above which a pixel shows nothing else
    solid: float = 0.9  # alpha after removal from which a surface counts as there
    void: float = 0.1  # alpha after removal below which there is nothing
    depth_tolerance: float = 0.02  # relative z difference within which two views see the same surface
    near: float = 1e-3  # near plane for clipping the box, as a share of the box's diagonal
    layer_step: float = 0.05  # relative z step between neighbouring pixels that parts two surfaces
    occluder_step: float = 0.06  # how much nearer (relative) a kept surface counts as in front
    least_outside: int = 20  # px of a surface that must lie beyond the object for it to count as continuing there
    margin: int = 2  # px by which a target grows, against the rim's mixed pixels
    around: int = 24  # px round what the object touched that are drawn anew without it
    selection: SelectionSettings = SelectionSettings()


@dataclass(frozen=True)
class ViewMasks:
    """What a view shows before and after the removal; all arrays [H, W] of the view."""

    camera: Camera
    polygon: np.ndarray  # bool, the projected boxes
    silhouette: np.ndarray  # bool, pixels that the removed Gaussians touched, and those of the extra mask
    occluder: np.ndarray  # bool, kept surfaces in front of the object, at its outline
    target: np.ndarray  # bool, T: the pixels to fill
    depth_before: np.ndarray  # float32 z of the scene with the object, 0 = nothing, or nothing to be trusted
    depth_after: np.ndarray  # float32 z without it
    alpha_after: np.ndarray  # float32


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

    @property
    def removed(self) -> np.ndarray:
        """[N] bool."""
        return self.selection.removed

    @property
    def hole_pixels(self) -> int:
        return int(sum(v.target.sum() for v in self.views))


def box_polygon(
    box: Box,
    camera: Camera,
    near: float,  # z below which the box is cut away, scene units
) -> np.ndarray | None:
    """The convex outline of a box in a view, [M, 2] pixels, clipped against the near plane before projecting.

    None if nothing of the box lies in front of the camera.
    """
    points = camera.to_camera(box.corners())
    in_front = points[:, 2] >= near
    visible = [points[in_front]]
    for a, b in EDGES:
        if in_front[a] != in_front[b]:
            s = (near - points[a, 2]) / (points[b, 2] - points[a, 2])
            visible.append((points[a] + s * (points[b] - points[a]))[None])
    cut = np.concatenate(visible)
    if len(cut) < 3:
        return None
    uv = cut[:, :2] / cut[:, 2:] * [camera.fx, camera.fy] + [camera.cx, camera.cy]
    hull = cv2.convexHull(uv.astype(np.float32))[:, 0]
    return hull if len(hull) >= 3 else None


def fill_polygon(
    polygon: np.ndarray,  # [M, 2] convex, pixels
    width: int,
    height: int,
) -> np.ndarray:
    """[H, W] bool: pixels whose centre lies inside a convex polygon of either orientation."""
    mask = np.zeros((height, width), dtype=bool)
    low = np.clip(np.floor(polygon.min(0)), 0, [width, height]).astype(int)
    high = np.clip(np.ceil(polygon.max(0)), 0, [width, height]).astype(int)
    if (high <= low).any():
        return mask
    x, y = np.meshgrid(np.arange(low[0], high[0]) + 0.5, np.arange(low[1], high[1]) + 0.5)
    start, end = polygon.astype(np.float64), np.roll(polygon.astype(np.float64), -1, axis=0)
    sides = [(b[0] - a[0]) * (y - a[1]) - (b[1] - a[1]) * (x - a[0]) for a, b in zip(start, end)]
    inside = np.all([s >= 0 for s in sides], axis=0) | np.all([s <= 0 for s in sides], axis=0)
    mask[low[1] : high[1], low[0] : high[0]] = inside
    return mask


def guard_gaussians(
    gaussians: Gaussians,
    candidates: np.ndarray,  # [N] bool, the kept ones
    polygon: np.ndarray,  # [M, 2]
    camera: Camera,
    scale: float,
) -> np.ndarray:
    """[N] bool: candidates whose centre projects into the guard band (paper 3.2, steps 2 and 3)."""
    uv, _ = camera.project(gaussians.means.astype(np.float64))
    centre = polygon.mean(0)

    def inside(outline: np.ndarray) -> np.ndarray:
        rows = np.flatnonzero(candidates & np.isfinite(uv).all(1))
        start, end = outline, np.roll(outline, -1, axis=0)
        u, v = uv[rows, 0, None], uv[rows, 1, None]
        side = (end - start)[:, 0] * (v - start[:, 1]) - (end - start)[:, 1] * (u - start[:, 0])
        result = np.zeros(len(uv), dtype=bool)
        result[rows] = (side >= 0).all(1) | (side <= 0).all(1)
        return result

    return inside(centre + scale * (polygon - centre)) & ~inside(polygon)


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
    passes = _Passes(progress, 5 * len(seeing))
    before = passes.over(lambda c: _look(gaussians, c, polygons[c.id], photos or {}, extra or {}, settings), seeing)
    selection, weights = by_centre(inside), None
    if not settings.selection.by_centre:
        selection, weights = _choose(gaussians, region, before, passes, settings.selection)
    after, needed = _empty(gaussians, selection, before, passes, settings)
    if weights is not None and settings.selection.support > 0:
        unseen = _weight_on(gaussians, selection, before, needed, passes)
        revised = without_revealed(gaussians, selection, region, weights.clear, unseen, settings.selection)
        if revised.removed.sum() > selection.removed.sum():
            selection = revised
            after, needed = _empty(gaussians, selection, before, passes, settings)
    if settings.mode == "paper":
        needed = [_uncovered(gaussians, selection.removed, b, settings) for b in before]
    views = tuple(_view_masks(b, a, n, settings) for b, a, n in zip(before, after, needed))
    left_out = tuple(c.id for c in cameras if c not in seeing)
    share = sum(v.target.sum() for v in views) / max(1, sum(v.polygon.sum() for v in views))
    reason = f"{selection.words}; {len(views)} views see the region, {share:.0%} of its projection needs filling"
    return Masks(selection, views, left_out, settings.mode, len(views) / len(cameras), reason)


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
    depth: np.ndarray
    alpha: np.ndarray
    agrees: np.ndarray  # bool, the photo shows what the scene shows, as far as it was looked at
    extra: np.ndarray | None  # bool, the extra mask


@dataclass(frozen=True)
class _After:
    """A view without the object; arrays [H, W]."""

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
    depth, alpha = surface_depth(gaussians, camera)
    agrees = np.ones(size, bool)
    if photo is not None and not settings.selection.by_centre:
        window = _window(np.concatenate(polygons), camera, settings.around)
        drawn = render(gaussians, _cropped(camera, window), passes=frozenset({"rgb"})).rgb
        misfit = np.abs(np.clip(drawn, 0, 1) - photo[window] / np.float32(255)).max(-1)
        limit = max(settings.selection.least_misfit, settings.selection.misfit * float(np.median(misfit)))
        agrees[window] = misfit <= limit
    return _Before(camera, polygons, depth, alpha, agrees, mask)


def _choose(
    gaussians: Gaussians, region: Region, before: Sequence[_Before], passes: _Passes, settings: SelectionSettings
) -> tuple[Selection, Weights]:
    """Which Gaussians go, by what the views show of them."""
    depths = [(b.camera, b.depth) for b in before]
    surroundings = [follow_surroundings(box, region, depths, settings.surroundings) for box in region]

    def sighting(view: _Before) -> Sighting:
        object_, ring = object_and_rim(view.camera, view.depth, region, surroundings, settings)
        clear = view.agrees & ~object_ & ~ring
        if view.extra is not None:
            object_, clear = object_ & ~view.extra, clear & ~view.extra
        return Sighting(view.camera, object_, clear, view.extra)

    weights = weigh(gaussians, passes.over(sighting, before))
    return select(gaussians, region, weights, surroundings, settings), weights


def _empty(
    gaussians: Gaussians,
    selection: Selection,
    before: Sequence[_Before],
    passes: _Passes,
    settings: MaskSettings,
) -> tuple[list[_After], list[np.ndarray]]:
    """Every view without the object, and where it shows what no view saw."""
    removed = selection.removed
    kept, gone = gaussians.take(~removed), gaussians.take(removed)

    def without(view: _Before) -> _After:
        """Only the part that the object touched is drawn anew."""
        window = _window(_extent(gone, view.camera), view.camera, settings.around)
        part = _cropped(view.camera, window)
        depth, alpha = view.depth.copy(), view.alpha.copy()
        depth[window], alpha[window] = surface_depth(kept, part)
        weight = np.zeros_like(alpha)
        weight[window] = footprint(gaussians, part, removed)
        return _After(depth, alpha, weight)

    after = passes.over(without, before)
    hidden = [a.weight > settings.hides for a in after]
    hidden = [h if b.extra is None else h | b.extra for h, b in zip(hidden, before)]
    sight = Sight.make([(b.camera, b.depth, h) for b, h in zip(before, hidden)])
    return after, parallel_map(lambda k: _needed(before[k].camera, after[k], sight, settings), range(len(after)))


def _needed(camera: Camera, after: _After, sight: Sight, settings: MaskSettings) -> np.ndarray:
    """[H, W] bool: pixels that the object touched and that now show nothing that a view saw (METHOD section 1)."""
    touched = after.weight > settings.changed
    solid = touched & (after.alpha >= settings.solid) & (after.depth > 0)
    rows, cols = np.nonzero(solid)
    points = camera.unproject(np.stack([cols + 0.5, rows + 0.5], -1), after.depth[rows, cols].astype(np.float64))
    evidence = touched & (after.alpha < settings.void)
    evidence[rows, cols] = sight.shows(points, settings.depth_tolerance)
    window = _window(np.argwhere(touched)[:, ::-1], camera, settings.around)
    evidence[window] &= _continues_outside(after.depth[window], after.alpha[window], touched[window], settings)
    return touched & ~evidence


def _weight_on(
    gaussians: Gaussians,
    selection: Selection,
    before: Sequence[_Before],
    needed: Sequence[np.ndarray],
    passes: _Passes,
) -> np.ndarray:
    """[N]: blend weight of the kept Gaussians on the needed pixels of all views, without the object."""
    stays = ~selection.removed
    kept = gaussians.take(stays)
    core = [cv2.erode(n.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0 for n in needed]
    total = np.zeros(len(gaussians))
    for part in passes.over(lambda k: contributions(kept, before[k].camera, pixels=core[k]).total, range(len(core))):
        total[stays] += part
    return total


def _uncovered(gaussians: Gaussians, removed: np.ndarray, view: _Before, settings: MaskSettings) -> np.ndarray:
    """[H, W] bool: T as the paper defines it, the polygon less the guard Gaussians' footprints."""
    camera, usable = view.camera, ~removed & gaussians.usable
    guards = [guard_gaussians(gaussians, usable, p, camera, settings.guard_scale) for p in view.polygons]
    covered = render(gaussians.take(np.any(guards, axis=0)), camera, passes=frozenset({"alpha"})).alpha
    return _polygon_pixels(view) & (covered <= settings.guard_footprint)


def _polygon_pixels(view: _Before) -> np.ndarray:
    return np.any([fill_polygon(p, view.camera.width, view.camera.height) for p in view.polygons], axis=0)


def _view_masks(before: _Before, after: _After, needed: np.ndarray, settings: MaskSettings) -> ViewMasks:
    silhouette = after.weight > settings.changed
    occluder = _in_front(before.depth, after.weight > 0.5, settings)
    target = needed if settings.mode == "paper" else _tidy(needed, silhouette, settings.margin)
    target, depth = target & ~occluder, before.depth
    if before.extra is not None:
        target, silhouette, depth = target | before.extra, silhouette | before.extra, np.where(before.extra, 0, depth)
    return ViewMasks(
        before.camera, _polygon_pixels(before), silhouette, occluder, target, depth, after.depth, after.alpha
    )


def _extent(gaussians: Gaussians, camera: Camera) -> np.ndarray:
    """[2, 2] pixels: corners of a rectangle round all that the Gaussians can touch; the picture's where they reach
    behind the camera."""
    usable = gaussians.usable
    x = camera.to_camera(gaussians.means[usable].astype(np.float64))
    reach = 3.5 * gaussians.scales[usable].max(1)[:, None]
    x, reach = x[x[:, 2] + reach[:, 0] > 0], reach[x[:, 2] + reach[:, 0] > 0]
    near, far = x[:, 2:] - reach, x[:, 2:] + reach
    if len(x) == 0 or (near <= 0).any():
        return np.array([[0.0, 0.0], [camera.width, camera.height]])
    low = np.minimum((x[:, :2] - reach) / near, (x[:, :2] - reach) / far).min(0)
    high = np.maximum((x[:, :2] + reach) / near, (x[:, :2] + reach) / far).max(0)
    return np.stack([low, high]) * [camera.fx, camera.fy] + [camera.cx, camera.cy]


def _window(
    points: np.ndarray,  # [N, 2] pixels
    camera: Camera,
    margin: int,
) -> tuple[slice, slice]:
    """Rows and columns of the rectangle round the points and a margin, within the picture; never empty."""
    size = np.array([camera.width, camera.height])
    ends = [points.min(0), points.max(0)] if len(points) else [size / 2, size / 2]
    low = np.clip(np.floor(ends[0]) - margin, 0, size - 1).astype(int)
    high = np.clip(np.ceil(ends[1]) + margin, low + 1, size).astype(int)
    return slice(low[1], high[1]), slice(low[0], high[0])


def _cropped(camera: Camera, window: tuple[slice, slice]) -> Camera:
    """The part of a view in a window, with exact intrinsics."""
    rows, cols = window
    return replace(
        camera,
        width=cols.stop - cols.start,
        height=rows.stop - rows.start,
        cx=camera.cx - cols.start,
        cy=camera.cy - rows.start,
    )


def _in_front(depth: np.ndarray, object_: np.ndarray, settings: MaskSettings) -> np.ndarray:
    """[H, W] bool: pixels at the object's outline whose first surface lies clearly in front of it, and their rim."""
    size = 2 * settings.margin + 1
    nearest = cv2.erode(np.where(object_ & (depth > 0), depth, np.inf).astype(np.float32), np.ones((size, size)))
    front = ~object_ & (depth > 0) & (depth < (1 - settings.occluder_step) * np.where(np.isfinite(nearest), nearest, 0))
    return cv2.dilate(front.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0


def _continues_outside(
    depth: np.ndarray,  # [H, W] z without the object, 0 = nothing
    alpha: np.ndarray,  # [H, W]
    touched: np.ndarray,  # [H, W] bool, by the object
    settings: MaskSettings,
) -> np.ndarray:
    """[H, W] bool: surfaces, and the void of scans without a background, that go on beyond what the object touched.

    What shows through a gap that a nearer surface encloses (the sky below a table that the box cut open) may be seen
    by other views past the table's edge, but it is not what was behind the object.
    """
    z, void = depth, alpha < settings.void
    there = (z > 0) & (alpha >= settings.solid) | void
    index = np.arange(z.size).reshape(z.shape)
    pairs = []
    for near, far in ((np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1], np.s_[1:])):
        close = np.abs(z[near] - z[far]) < settings.layer_step * np.minimum(z[near], z[far])
        same = there[near] & there[far] & np.where(void[near], void[far], close & ~void[far])
        pairs.append(np.stack([index[near][same], index[far][same]]))
    a, b = np.concatenate(pairs, axis=1)
    graph = scipy.sparse.coo_matrix((np.ones(len(a), bool), (a, b)), (z.size, z.size))
    count, surface = scipy.sparse.csgraph.connected_components(graph, directed=False)
    surface = surface.reshape(z.shape)
    outside = np.bincount(surface[there & ~touched], minlength=count)
    return there & (outside[surface] >= settings.least_outside)


def sees(
    camera: Camera,
    depth: np.ndarray,  # [H, W] z of the first surface, 0 = nothing
    points: np.ndarray,  # [N, 3] world
    tolerance: float,  # relative
) -> np.ndarray:
    """[N] bool: the point is framed and is the surface seen there (z-test)."""
    uv, z = camera.project(points)
    with np.errstate(invalid="ignore"):
        framed = (z > 0) & (uv >= 0).all(-1) & (uv[..., 0] < camera.width) & (uv[..., 1] < camera.height)
    result = np.zeros(len(points), dtype=bool)
    cols, rows = uv[framed].astype(int).T
    there = depth[rows, cols]
    result[framed] = (there > 0) & (np.abs(there - z[framed]) < tolerance * z[framed])
    return result


def _tidy(target: np.ndarray, allowed: np.ndarray, margin: int) -> np.ndarray:
    """Close pinholes, drop single pixels, and grow by a margin within what the object touched."""
    kernel = np.ones((3, 3), np.uint8)
    solid = cv2.morphologyEx(target.astype(np.uint8), cv2.MORPH_OPEN, kernel)
    solid = cv2.morphologyEx(solid, cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8))
    if margin:
        solid = cv2.dilate(solid, kernel, iterations=margin)
    return (solid > 0) & cv2.dilate(allowed.astype(np.uint8), kernel).astype(bool)
