"""Which Gaussians go, and where each view has to be filled (paper 3.2, METHOD section 1)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import scipy.sparse
import scipy.sparse.csgraph

from ..box import Box, Region, in_region
from ..camera import Camera
from ..errors import BadInput, IllPosed
from ..gaussians import Gaussians
from ..progress import Progress, silent
from ..raster import RasterSettings, contributions, footprint, render, surface_depth
from ..threads import parallel_map

EDGES = [(a, a | 1 << b) for a in range(8) for b in range(3) if not a >> b & 1]  # a box's 12 edges, see Box.corners


@dataclass(frozen=True)
class MaskSettings:
    """How target regions are found. Lengths in pixels, depths relative."""

    mode: str = "need"  # "need": only what no view shows; "paper": polygon minus guard footprints
    guard_scale: float = 1.2  # the guard band's size over the polygon's (paper 3.2, s)
    guard_footprint: float = 0.5  # accumulated alpha of guard Gaussians above which a pixel needs no fill
    changed: float = 0.02  # blend weight of removed Gaussians above which the object touched a pixel
    solid: float = 0.9  # alpha after removal from which a surface counts as there
    void: float = 0.1  # alpha after removal below which there is nothing
    depth_tolerance: float = 0.02  # relative z difference within which two views see the same surface
    near: float = 1e-3  # near plane for clipping the box, as a share of the box's diagonal
    support: float = 0.3  # share of a Gaussian's weight that views must have seen with the object there; 0 keeps all
    support_pixels: float = 0.5  # summed weight below which a Gaussian does not matter
    layer_step: float = 0.05  # relative z step between neighbouring pixels that parts two surfaces
    occluder_step: float = 0.06  # how much nearer (relative) a kept surface counts as in front
    least_outside: int = 20  # px of a surface that must lie beyond the object for it to count as continuing there
    margin: int = 2  # px by which a target grows, against the rim's mixed pixels


@dataclass(frozen=True)
class ViewMasks:
    """What a view shows before and after the removal; all arrays [H, W] of the view."""

    camera: Camera
    polygon: np.ndarray  # bool, the projected boxes
    silhouette: np.ndarray  # bool, pixels that the removed Gaussians touched
    occluder: np.ndarray  # bool, kept surfaces in front of the object, at its outline
    target: np.ndarray  # bool, T: the pixels to fill
    depth_before: np.ndarray  # float32 z of the scene with the object, 0 = nothing
    depth_after: np.ndarray  # float32 z without it
    alpha_after: np.ndarray  # float32


@dataclass(frozen=True)
class Masks:
    """The removal's masks in every usable view."""

    removed: np.ndarray  # [N] bool
    views: tuple[ViewMasks, ...]
    left_out: tuple[str, ...]  # IDs of cameras inside the region, or whose frame misses it
    mode: str  # the mode really used
    confidence: float
    reason: str

    @property
    def hole_pixels(self) -> int:
        return int(sum(v.target.sum() for v in self.views))


def select_removed(gaussians: Gaussians, region: Region) -> np.ndarray:
    """[N] bool: Gaussians whose centre lies in the region (METHOD section 1). Unusable rows are never removed."""
    return in_region(region, gaussians.means.astype(np.float64)) & gaussians.usable


def unsupported_gaussians(
    gaussians: Gaussians,
    removed: np.ndarray,  # [N] bool
    cameras: Sequence[Camera],
    settings: MaskSettings,
) -> np.ndarray:
    """[N] bool: kept Gaussians that only the removal reveals (METHOD section 1, contamination).

    Trainers leave smears of the object's colour under and behind its surface, where no photo ever saw them. Their blend
    weight over all views is small while the object is there and large once it is gone. What really lies behind the
    object was seen past it in other views, and stays.
    """
    if settings.support <= 0:
        return np.zeros(len(gaussians), bool)
    kept = gaussians.take(~removed)

    def weights(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
        raster = RasterSettings()
        before = contributions(gaussians, camera, raster).total[~removed]
        return before, contributions(kept, camera, raster).total

    sums = parallel_map(weights, cameras)
    before, after = np.sum([b for b, _ in sums], axis=0), np.sum([a for _, a in sums], axis=0)
    found = np.zeros(len(gaussians), bool)
    found[~removed] = (after > settings.support_pixels) & (before < settings.support * after)
    return found


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
) -> Masks:
    """Select the object's Gaussians and find the target region T of every view (paper 3.2; METHOD section 1).

    Raises
    ------
    BadInput
        If the mode is unknown.
    IllPosed
        If every Gaussian is selected, or no camera sees the region from outside.
    """
    if settings.mode not in ("need", "paper"):
        raise BadInput(f"masks: unknown mode {settings.mode!r}; use need or paper")
    removed = select_removed(gaussians, region)
    if not removed.any():
        return Masks(removed, (), (), settings.mode, 1.0, "the region holds no Gaussian: nothing to remove")
    if removed[gaussians.usable].all():
        raise IllPosed("ROI: it holds the whole scene; nothing would be left to fill from, make it smaller")
    usable = [c for c in cameras if not any(b.contains(c.centre[None])[0] for b in region)]
    polygons = {c.id: _polygons(region, c, settings) for c in usable}
    seeing = [c for c in usable if any(fill_polygon(p, c.width, c.height).any() for p in polygons[c.id])]
    if not seeing:
        inside = len(cameras) - len(usable)
        raise IllPosed(
            f"no usable view: of {len(cameras)} cameras {inside} are inside the ROI and the others do not frame it; "
            "add views that look at it from outside"
        )
    revealed = unsupported_gaussians(gaussians, removed, seeing, settings)
    removed = removed | revealed
    kept = gaussians.take(~removed)
    done = 0

    def measure(camera: Camera) -> ViewMasks:
        nonlocal done
        view = _measure_view(gaussians, kept, removed, camera, polygons[camera.id], settings)
        done += 1
        progress("masks", done, len(seeing), camera.id)
        return view

    views = parallel_map(measure, seeing)
    if settings.mode == "need":
        views = parallel_map(lambda v: _need_only(v, views, settings), views)
    left_out = tuple(c.id for c in cameras if c not in seeing)
    share = sum(v.target.sum() for v in views) / max(1, sum(v.polygon.sum() for v in views))
    reason = (
        f"{len(views)} views see the region; {share:.0%} of its projection needs filling; "
        f"{int(revealed.sum())} Gaussians outside the box go as well: no view saw them unhidden"
    )
    return Masks(removed, tuple(views), left_out, settings.mode, len(views) / len(cameras), reason)


def _polygons(region: Region, camera: Camera, settings: MaskSettings) -> list[np.ndarray]:
    found = (box_polygon(b, camera, settings.near * float(np.linalg.norm(b.size))) for b in region)
    return [p for p in found if p is not None]


def _measure_view(
    gaussians: Gaussians,
    kept: Gaussians,
    removed: np.ndarray,
    camera: Camera,
    polygons: list[np.ndarray],
    settings: MaskSettings,
) -> ViewMasks:
    """A view before and after the removal, with T as the paper defines it."""
    raster = RasterSettings()
    polygon = np.any([fill_polygon(p, camera.width, camera.height) for p in polygons], axis=0)
    before, _ = surface_depth(gaussians, camera, raster)
    after, alpha_after = surface_depth(kept, camera, raster)
    weight = footprint(gaussians, camera, removed, raster)
    silhouette = weight > settings.changed
    occluder = _in_front(before, weight > 0.5, settings)
    if settings.mode == "paper":
        guards = np.any(
            [
                guard_gaussians(gaussians, ~removed & gaussians.usable, p, camera, settings.guard_scale)
                for p in polygons
            ],
            axis=0,
        )
        covered = render(gaussians.take(guards), camera, raster, frozenset({"alpha"})).alpha
        target = polygon & (covered <= settings.guard_footprint)
    else:
        target = silhouette
    return ViewMasks(
        camera,
        polygon,
        silhouette,
        occluder,
        target & ~occluder,
        before,
        after,
        alpha_after,
    )


def _in_front(depth: np.ndarray, object_: np.ndarray, settings: MaskSettings) -> np.ndarray:
    """[H, W] bool: pixels at the object's outline whose first surface lies clearly in front of it, and their rim."""
    size = 2 * settings.margin + 1
    object_depth = np.where(object_ & (depth > 0), depth, np.inf).astype(np.float32)
    nearest = cv2.erode(
        object_depth, np.ones((size, size)), borderType=cv2.BORDER_REPLICATE
    )  # its own border is finite
    front = ~object_ & (depth > 0) & (depth < (1 - settings.occluder_step) * np.where(np.isfinite(nearest), nearest, 0))
    return cv2.dilate(front.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0


def _need_only(view: ViewMasks, views: Sequence[ViewMasks], settings: MaskSettings) -> ViewMasks:
    """T without the pixels whose revealed surface some other view really saw (METHOD section 1, `ours`)."""
    solid = view.silhouette & (view.alpha_after >= settings.solid) & (view.depth_after > 0)
    rows, cols = np.nonzero(solid)
    uv = np.stack([cols + 0.5, rows + 0.5], -1)
    points = view.camera.unproject(uv, view.depth_after[rows, cols].astype(np.float64))
    seen = np.zeros(len(points), dtype=bool)
    for other in views:
        if other is not view:
            open_points = np.flatnonzero(~seen)
            seen[open_points] = sees(other.camera, other.depth_before, points[open_points], settings.depth_tolerance)
    evidence = np.zeros_like(view.silhouette)
    evidence[rows[seen], cols[seen]] = True
    evidence |= view.alpha_after < settings.void
    target = view.silhouette & ~(evidence & _continues_outside(view, settings))
    return replace(view, target=_tidy(target, view.silhouette, settings.margin) & ~view.occluder)


def _continues_outside(view: ViewMasks, settings: MaskSettings) -> np.ndarray:
    """[H, W] bool: surfaces, and the void of scans without a background, that go on beyond what the object touched.

    What shows through a gap that a nearer surface encloses (the sky below a table that the box cut open) may be seen
    by other views past the table's edge, but it is not what was behind the object.
    """
    z = view.depth_after
    void = view.alpha_after < settings.void
    there = (z > 0) & (view.alpha_after >= settings.solid) | void
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
    outside = np.bincount(surface[there & ~view.silhouette], minlength=count)
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
