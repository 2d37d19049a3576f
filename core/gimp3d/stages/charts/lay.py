"""Where the surface at a plane lies: on it, or on the relief that the views draw over it; and cameras that face it."""

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
from ...solvers.poisson import thin_plate
from ..witness import Textures, Witness
from .find import INLIER, ChartSettings
from .plane import Plane, Surface, extent

CHART = "chart"  # split of the cameras that face surfaces
MARGIN = 8  # px of a view round the part that may show the surface
CELL = 2  # px of such a camera, side of the cells in which drawn surface is gathered
ENOUGH_POINTS = 3  # of a cell
TELLING = 100  # cells or texels that tell how depths lie
HEIGHT = 0.25  # diagonals of the region, of a relief at most: what is higher stands on the surface
SINKS = 0.01  # diagonals by which splats are drawn behind their surface at most


@dataclass(frozen=True)
class Laid(Surface):
    """A surface where it lies as far as photos tell."""

    kind: str  # plane | relief
    agreement: float  # of photos on it, see Textures
    noise: float  # median distance of the views' drawn surfaces from the plane, scene units
    others: tuple[Plane, ...]  # planes that it may meet
    reason: str


def flat_surface(plane: Plane, place: np.ndarray, size: np.ndarray, texel: float) -> Surface:
    """A rectangle of a plane, of a size [2] and round a place, as a camera faces it, with texels of one side."""
    width, height = (int(n) for n in np.ceil(size / texel))
    away = 4 * float(np.linalg.norm(size))
    rotation = np.stack([plane.right, -plane.down, -plane.normal])
    viewmat = np.eye(4)
    viewmat[:3, :3], viewmat[:3, 3] = rotation, -rotation @ (place + away * plane.normal)
    camera = Camera("chart", width, height, away / texel, away / texel, width / 2, height / 2, viewmat, CHART)
    return Surface(plane, camera, np.full((height, width), away, np.float32))


def pixel_density(points: np.ndarray, normal: np.ndarray, camera: Camera) -> np.ndarray:
    """[N]: pixels of a view on a unit of surface at points [N, 3]; 0 where it does not face the view."""
    z, towards = camera.project(points)[1], camera.centre - points
    cosine = (towards @ normal) / np.linalg.norm(towards, axis=1)
    facing = (z > 0) & (cosine > 0)
    return np.where(facing, camera.fx * camera.fy * cosine / np.where(facing, z, 1) ** 2, 0)


def pixel_size(place: np.ndarray, normal: np.ndarray, views: Sequence[Witness]) -> float:
    """Side of a pixel on a surface, scene units, in the views that show the place best; infinite if none faces it."""
    density = np.array([pixel_density(place[None], normal, v.camera)[0] for v in views])
    facing = density[density > 0]
    return 1 / math.sqrt(float(np.percentile(facing, 90))) if len(facing) else math.inf


def lay_surface(
    flat: Surface,  # at the plane
    region: Region,
    witnesses: Sequence[Witness],
    textures: Textures,
    settings: ChartSettings = ChartSettings(),
    enough: float = math.inf,  # points that tell where a few texels lie, where views show more
    others: tuple[Plane, ...] = (),  # that it may meet
) -> Laid:
    """A relief if photos agree clearly better on it than on the plane; else the plane, laid onto the drawn surface."""

    def at(offset: np.ndarray | float, kind: str) -> Laid:
        laid = Laid(flat.plane, flat.camera, (flat.depth + offset).astype(np.float32), kind, 0.0, np.nan, others, "")
        agreement = textures.agreement(laid.points().reshape(-1, 3))
        return replace(laid, agreement=agreement, reason=f"photos agree by {agreement:.2f}")

    level, diagonal = at(0.0, "plane"), extent(region)
    offset, known = _drawn_surface(flat, witnesses, HEIGHT * diagonal, enough, others, INLIER * diagonal)
    if known.sum() < TELLING:
        return level
    relief = at(_completed(offset, known, flat), "relief")
    # near splats cover far ones, so all seem to stand higher: trained ones lie as much lower, and so must new ones
    near = offset[known & (np.abs(offset) < SINKS * diagonal)]
    sunk = at(float(np.median(near)) if len(near) > TELLING else 0.0, "plane")
    return replace(
        relief if 1 - relief.agreement < settings.relief * (1 - level.agreement) else sunk,
        reason=f"{level.reason} on the plane, {relief.agreement:.2f} on the relief",
        noise=float(np.median(np.abs(offset[known]))),
    )


def places_drawn(plane: Plane, half: float, count: int, witnesses: Sequence[Witness], height: float) -> np.ndarray:
    """[count, count, 3] places on what views draw no higher than so much over a square of a plane, completed."""
    flat = flat_surface(plane, plane.origin, np.full(2, 2 * half), 2 * half / count)
    offset, known = _drawn_surface(flat, witnesses, height, math.inf)
    if known.sum() < TELLING:
        return flat.points()
    return replace(flat, depth=flat.depth + _completed(offset, known, flat)).points()


def _completed(offset: np.ndarray, known: np.ndarray, flat: Surface) -> np.ndarray:
    """[H, W] float32: offsets, see _drawn_surface, smoothly where they are not known."""
    completed = np.nan_to_num(thin_plate(offset, known, np.ones(known.shape, bool))).astype(np.float32)
    return cv2.resize(completed, flat.depth.shape[::-1], interpolation=cv2.INTER_LINEAR)


def _drawn_surface(
    flat: Surface,
    witnesses: Sequence[Witness],
    height: float,
    enough: float,
    others: Sequence[Plane] = (),
    on_others: float = 0.0,
) -> tuple[np.ndarray, np.ndarray]:
    """z of what views draw no higher than so much over a plane less the plane's, in cells of a few texels, and where
    that is known. Both [h, w]; the median over the views' points.

    Points that lie within a distance on another plane, and nearer to it than to this one, tell of that.
    """
    camera, away = flat.camera, flat.depth[0, 0]
    h, w = -(-camera.height // CELL), -(-camera.width // CELL)
    ends = np.array([[0, 0], [camera.width, 0], [0, camera.height], [camera.width, camera.height]], float)
    corners = camera.unproject(ends, np.full(4, away, float))
    middle = corners.mean(0)

    def of(view: Witness) -> np.ndarray:
        uv, front = view.camera.project(corners)
        window = window_round(uv, view.camera, MARGIN) if (front > 0).all() else WHOLE
        z_there = float(view.camera.project(middle[None])[1][0])
        side = CELL * away / camera.fx * view.camera.fx / z_there if z_there > 0 else 1  # of a cell, in px
        step = max(1, int(side * math.sqrt(len(witnesses) / enough)))
        points = surface_points(view.camera, view.depth_beside, window, step)[2]
        off = np.abs(flat.plane.local(points)[:, 2])
        own = off < height
        for other in others:
            beside = np.abs(other.local(points)[:, 2])
            own &= (beside > on_others) | (beside > off)
        points = points[own]
        _, rows, cols, z = framed(camera, points)
        # sorted as one number: the cell, then z, whose bits are in order as it is positive
        return (rows // CELL * w + cols // CELL).astype(np.uint64) << 32 | z.astype(np.float32).view(np.uint32)

    found = np.sort(np.concatenate(parallel_map(of, witnesses)))
    count = np.bincount((found >> 32).astype(np.int64), minlength=h * w)
    known, value = count >= ENOUGH_POINTS, np.zeros(h * w)
    middle = found[(np.cumsum(count) - count + count // 2)[known]]
    value[known] = middle.astype(np.uint32).view(np.float32)
    return np.where(known, value - away, 0).reshape(h, w), known.reshape(h, w)
