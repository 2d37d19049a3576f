"""What each view shows of the user's boxes, and of the whole scene beside its photo."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from ..box import Box
from ..camera import Camera
from ..compute.threads import parallel_map
from ..errors import BadInput
from ..gaussians import Gaussians
from ..geometry import SAME_DEPTH, Window, dilated, framed, surface_points, window_mask, window_round
from ..raster import drawing, render

AROUND = 24  # px round a box, or what the object touched, that are looked at too: depths and edges there tell
NEAR_PLANE = 1e-3  # z below which a box is cut away, as a share of its diagonal
GUARD_SCALE = 1.2  # the guard band's size over the polygon's (paper 3.2, s)
GUARD_FOOTPRINT = 0.5  # accumulated alpha of guard Gaussians above which a pixel needs no fill (paper 3.2)
REACH = 2  # px round the object's outline in which surface before it is sought
OCCLUDER_STEP = 0.03  # of disparity (relative) by which a kept surface, continued, lies before the object
MISFIT = 4.0  # a photo is not what the scene shows where they differ by so many times the view's median …
LEAST_MISFIT = 0.1  # … and by so much, colours in [0, 1]
SAMPLES = 1000  # of each view's surface that are compared with another's, about
# A box's 12 edges, from and to which of Box.corners.
EDGES = np.array([(a, a | 1 << b) for a in range(8) for b in range(3) if not a >> b & 1]).T


@dataclass(frozen=True)
class ViewBefore:
    """A view with the object; arrays [H, W]."""

    camera: Camera
    polygons: list[np.ndarray]  # each box's outline, see box_polygon
    window: Window  # of the region and a margin
    depth: np.ndarray  # float32 z, 0 = nothing
    alpha: np.ndarray  # float32
    agrees: np.ndarray | None  # bool, of the window: the photo shows what the scene shows; None if there is none
    likeness: float  # correlation of photo and scene in the window; NaN if it cannot be told
    extra: np.ndarray | None  # bool, the extra mask

    @property
    def polygon(self) -> np.ndarray:
        """[H, W] bool: the boxes' outlines, filled."""
        return np.any([fill_polygon(p, self.camera) for p in self.polygons], axis=0)


def look(
    gaussians: Gaussians,
    camera: Camera,
    polygons: list[np.ndarray],  # the boxes' outlines
    photo: np.ndarray | None,  # [H, W, 3] uint8, with the object
    extra: np.ndarray | None,  # [H, W] bool
    compare: bool,  # the photo with the scene
) -> ViewBefore:
    """A view with the object.

    Raises
    ------
    BadInput
        If the photo or the extra mask has not the view's size.
    """
    for kind, picture in (("photo", photo), ("extra mask", extra)):
        if picture is not None and picture.shape[:2] != (camera.height, camera.width):
            sizes = f"{picture.shape[1]}×{picture.shape[0]}, not {camera.width}×{camera.height}"
            raise BadInput(f"masks: the {kind} of {camera.id} is {sizes}")
    window = window_round(np.concatenate(polygons), camera, AROUND)
    agrees, likeness = None, np.nan
    scene = drawing(gaussians, camera, with_colour=photo is not None and compare)
    depth, alpha = scene.surface_depth()
    if photo is not None and compare:
        drawn = np.clip(scene.render(frozenset({"rgb"}), window_mask(window, camera)).rgb[window], 0, 1)
        shown = photo[window] / np.float32(255)
        misfit = np.abs(drawn - shown).max(-1)
        agrees = misfit <= max(LEAST_MISFIT, MISFIT * float(np.median(misfit)))
        likeness = _correlation(drawn.mean(-1), shown.mean(-1))
    return ViewBefore(camera, polygons, window, depth, alpha, agrees, likeness, extra)


def _correlation(a: np.ndarray, b: np.ndarray) -> float:
    """Pearson's; NaN where either is constant."""
    a, b = a - a.mean(), b - b.mean()
    spread = float(np.sqrt((a * a).sum() * (b * b).sum()))
    return float((a * b).sum()) / spread if spread > 1e-6 * a.size else np.nan


def box_polygon(box: Box, camera: Camera) -> np.ndarray | None:
    """The convex outline of a box in a view, [M, 2] pixels; None if nothing of the box lies in front of the camera."""
    points, near = camera.to_camera(box.corners()), NEAR_PLANE * float(np.linalg.norm(box.size))
    in_front = points[:, 2] >= near
    a, b = points[EDGES[:, in_front[EDGES[0]] != in_front[EDGES[1]]]]
    s = (near - a[:, 2:]) / (b[:, 2:] - a[:, 2:])
    cut = np.concatenate([points[in_front], a + s * (b - a)])
    if len(cut) < 3:
        return None
    uv = cut[:, :2] / cut[:, 2:] * [camera.fx, camera.fy] + [camera.cx, camera.cy]
    hull = cv2.convexHull(uv.astype(np.float32))[:, 0]
    return hull if len(hull) >= 3 else None


def fill_polygon(polygon: np.ndarray, camera: Camera) -> np.ndarray:
    """[H, W] bool: pixels whose centre lies inside a convex polygon [M, 2] of either orientation, in pixels."""
    mask, (rows, cols) = np.zeros((camera.height, camera.width), bool), window_round(polygon, camera)
    x, y = np.meshgrid(*(np.arange(s.start, s.stop) + 0.5 for s in (cols, rows)))
    mask[rows, cols] = _inside(polygon.astype(np.float64), x, y)
    return mask


def _inside(polygon: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Bool of x's shape: points on one side of all edges of a convex polygon [M, 2]."""
    edges = list(zip(polygon, np.roll(polygon, -1, axis=0)))
    sides = [(b[0] - a[0]) * (y - a[1]) - (b[1] - a[1]) * (x - a[0]) for a, b in edges]
    return np.all([s >= 0 for s in sides], axis=0) | np.all([s <= 0 for s in sides], axis=0)


def box_window(box: Box, camera: Camera) -> Window:
    """The rectangle that holds a box; the whole picture if the box reaches behind the camera."""
    corners = box.corners()
    if (camera.to_camera(corners)[:, 2] <= 0).any():
        return slice(0, camera.height), slice(0, camera.width)
    return window_round(camera.project(corners)[0], camera, 1)


def depth_agreement(views: Sequence[ViewBefore]) -> float:
    """Share of the surface in the views' windows which, framed by a neighbouring view and not hidden there, is that
    view's surface too; 1 where nothing can be compared.
    """
    centres = np.array([v.camera.centre for v in views])
    forwards = np.array([v.camera.forward for v in views])
    spread = max(1e-12, float(np.median(np.linalg.norm(centres - centres.mean(0), axis=1))))

    def compared(k: int) -> np.ndarray:
        apart = np.linalg.norm(centres - centres[k], axis=1) / spread + 1 - forwards @ forwards[k]
        apart[k] = np.inf
        other = views[int(apart.argmin())]
        _, _, points = surface_points(views[k].camera, views[k].depth, views[k].window)
        _, rows, cols, z = framed(other.camera, points[:: max(1, len(points) // SAMPLES)])
        there = other.depth[rows, cols]
        coarse = max(SAME_DEPTH, 1 / other.camera.fx)  # a pixel of a small picture holds many depths
        through = (there > z * (1 + coarse)) | (there == 0)
        return np.array([(np.abs(there - z) <= coarse * z).sum(), through.sum()])

    same, through = np.sum(parallel_map(compared, range(len(views))), axis=0)
    return float(same / (same + through)) if same + through else 1.0


def uncovered(gaussians: Gaussians, removed: np.ndarray, view: ViewBefore) -> np.ndarray:
    """[H, W] bool: T as the paper defines it (3.2), the polygon less the footprints of guard Gaussians: those that stay
    and whose centres lie in the guard band of a box's outline. Charts tell T otherwise: `clearing`.
    """
    uv, _ = view.camera.project(gaussians.means.astype(np.float64))
    rows = np.flatnonzero(~removed & gaussians.usable & np.isfinite(uv).all(1))
    u, v = uv[rows].T
    guards = np.zeros(len(rows), bool)
    for polygon in view.polygons:
        centre = polygon.mean(0)
        guards |= _inside(centre + GUARD_SCALE * (polygon - centre), u, v) & ~_inside(polygon, u, v)
    covered = render(gaussians.take(rows[guards]), view.camera, passes=frozenset({"alpha"})).alpha
    return view.polygon & (covered <= GUARD_FOOTPRINT)


def in_front(depth: np.ndarray, object_: np.ndarray) -> np.ndarray:
    """[H, W] bool: surface at the outline of the object (`object_` [H, W] bool, z with it in `depth` [H, W]) behind
    whose continuation the object lies, and a pixel round it.

    The continuation is a plane in disparity, level where the surface falls off on its other side. The floor before the
    object's foot rises to it and is not in front, however flat the view; a thin rod is, close as it may stand.
    """
    disparity = np.divide(1, depth, out=np.zeros_like(depth), where=depth > 0)
    padded = np.pad(disparity, REACH, "reflect", reflect_type="odd")  # slopes go on beyond the frame
    there = np.pad(object_ & (depth > 0), REACH)
    (h, w), front = depth.shape, np.zeros_like(object_)
    for dy, dx in ((dy, dx) for dy in (-REACH, 0, REACH) for dx in (-REACH, 0, REACH) if dy or dx):
        ahead = np.s_[REACH + dy : REACH + dy + h, REACH + dx : REACH + dx + w]
        behind = np.s_[REACH - dy : REACH - dy + h, REACH - dx : REACH - dx + w]
        continued = np.minimum(disparity, 2 * disparity - padded[behind])
        front |= there[ahead] & (padded[ahead] < (1 - OCCLUDER_STEP) * continued)
    return dilated(front & ~object_, 1)
