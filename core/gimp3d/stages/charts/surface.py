"""Where the surface at a plane lies: on the plane, or on the relief that the views draw over it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from ...box import Region
from ...camera import Camera
from ...compute.threads import parallel_map
from ...geometry import WHOLE, framed, surface_points, window_round
from ...solvers.thin_plate import thin_plate
from ..masks import ViewMasks
from ..witness import Textures, Witness
from .find import ChartSettings, surface_depth_beside
from .plane import Plane, extent

CHART = "chart"  # split of the cameras that face surfaces
MARGIN = 8  # px of a view round the part that may show the surface
CELL = 2  # px of such a camera, side of the cells in which drawn surface is gathered
ENOUGH_POINTS = 3  # of a cell
TELLING = 100  # cells or texels that tell how depths lie
HEIGHT = 0.25  # diagonals of the region, of a relief at most: what is higher stands on the surface
SINKS = 0.01  # diagonals by which splats are drawn behind their surface at most


@dataclass(frozen=True)
class Laid:
    """Where a surface lies; arrays of the camera that faces it."""

    kind: str  # plane | relief
    depth: np.ndarray  # [H, W] float32 z
    points: np.ndarray  # [H, W, 3] scene coordinates
    agreement: float  # of photos on it, see Textures
    reason: str
    noise: float = np.nan  # median distance of the views' drawn surfaces from the plane, scene units

    @property
    def texels(self) -> np.ndarray:
        """[H·W, 3] scene coordinates."""
        return self.points.reshape(-1, 3)


def facing_camera(plane: Plane, place: np.ndarray, size: np.ndarray, texel: float) -> tuple[Camera, float]:
    """The camera that faces a rectangle [2] of a plane round a place, with texels of one side, and the plane's z."""
    width, height = (int(n) for n in np.ceil(size / texel))
    away = 4 * float(np.linalg.norm(size))
    rotation = np.stack([plane.right, -plane.down, -plane.normal])
    viewmat = np.eye(4)
    viewmat[:3, :3], viewmat[:3, 3] = rotation, -rotation @ (place + away * plane.normal)
    return Camera("chart", width, height, away / texel, away / texel, width / 2, height / 2, viewmat, CHART), away


def pixel_size(place: np.ndarray, normal: np.ndarray, views: Sequence[ViewMasks]) -> float:
    """Side of a pixel on a surface, scene units, in the views that show the place best; infinite if none faces it."""
    density = []
    for v in views:
        _, z = v.camera.project(place[None])
        cosine = float(((v.camera.centre - place) @ normal) / np.linalg.norm(v.camera.centre - place))
        if z[0] > 0 and cosine > 0:
            density.append(v.camera.fx * v.camera.fy * cosine / z[0] ** 2)
    return 1 / math.sqrt(float(np.percentile(density, 90))) if density else math.inf


def lay_surface(
    camera: Camera,
    away: float,  # z of the plane
    plane: Plane,
    region: Region,
    views: Sequence[ViewMasks],
    witnesses: Sequence[Witness],
    textures: Textures,
    settings: ChartSettings = ChartSettings(),
    enough: float = math.inf,  # points that tell where a few texels lie, where views show more
) -> Laid:
    """A relief if photos agree clearly better on it than on the plane; else the plane, laid onto the drawn surface."""
    flat = np.full((camera.height, camera.width), away, np.float32)

    def at(offset: np.ndarray | float, kind: str) -> Laid:
        depth = (flat + offset).astype(np.float32)
        points = camera.unproject(camera.pixel_centres(), depth.astype(np.float64))
        agreement = textures.agreement(points.reshape(-1, 3))
        return Laid(kind, depth, points, agreement, f"photos agree by {agreement:.2f}")

    level = at(0.0, "plane")
    drawn = _drawn_surface(camera, away, plane, views, witnesses, extent(region), enough)
    if drawn is None:
        return level
    offset, known = drawn
    completed = np.nan_to_num(thin_plate(offset, known.astype(float), np.ones(known.shape, bool))).astype(np.float32)
    relief = at(cv2.resize(completed, flat.shape[::-1], interpolation=cv2.INTER_LINEAR), "relief")
    # splats are drawn a little behind the surface that they show: new ones must lie where they do
    near = offset[known & (np.abs(offset) < SINKS * extent(region))]
    sunk = at(float(np.median(near)) if len(near) > TELLING else 0.0, "plane")
    return replace(
        relief if 1 - relief.agreement < settings.relief * (1 - level.agreement) else sunk,
        reason=f"{level.reason} on the plane, {relief.agreement:.2f} on the relief",
        noise=float(np.median(np.abs(offset[known]))),
    )


def _drawn_surface(
    camera: Camera,
    away: float,
    plane: Plane,
    views: Sequence[ViewMasks],
    witnesses: Sequence[Witness],
    diagonal: float,
    enough: float,
) -> tuple[np.ndarray, np.ndarray] | None:
    """z of what the views draw near a plane less the plane's, in cells of a few texels, and where that is known.

    Both [h, w]; the median over the views' points. None where the views show too little of it.
    """
    h, w = -(-camera.height // CELL), -(-camera.width // CELL)
    ends = np.array([[0, 0], [camera.width, 0], [0, camera.height], [camera.width, camera.height]], float)
    corners = camera.unproject(ends, np.full(4, np.float32(away), float))
    middle = corners.mean(0)

    def of(view: ViewMasks, witness: Witness) -> np.ndarray:
        uv, front = view.camera.project(corners)
        window = window_round(uv, view.camera, MARGIN) if (front > 0).all() else WHOLE
        z_there = float(view.camera.project(middle[None])[1][0])
        side = CELL * np.float32(away) / camera.fx * view.camera.fx / z_there if z_there > 0 else 1  # of a cell, in px
        step = max(1, int(side * math.sqrt(len(views) / enough)))
        points = surface_points(view.camera, surface_depth_beside(view, witness), window, step)[2]
        points = points[np.abs(plane.local(points)[:, 2]) < HEIGHT * diagonal]
        _, rows, cols, z = framed(camera, points)
        return np.stack([rows // CELL * w + cols // CELL, z], -1)

    found = np.concatenate(parallel_map(lambda p: of(*p), list(zip(views, witnesses))))
    order = np.lexsort((found[:, 1], found[:, 0]))
    key, z = found[order, 0].astype(int), found[order, 1]
    count = np.bincount(key, minlength=h * w)
    start = np.cumsum(count) - count
    known = count >= ENOUGH_POINTS
    value = np.zeros(h * w)
    value[known] = z[start[known] + count[known] // 2]
    value, known = value.reshape(h, w), known.reshape(h, w)
    if known.sum() < TELLING:
        return None
    return np.where(known, value - np.float32(away), 0), known
