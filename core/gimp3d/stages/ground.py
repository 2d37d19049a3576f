"""The surfaces round the object, seen straight on and coarsely: what its shadow may fall on."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import cv2
import numpy as np

from ..box import Region
from ..camera import Camera
from ..compute.threads import parallel_map
from ..geometry import surface_points
from .charts import (
    PARALLEL,
    ChartSettings,
    Plane,
    extent,
    facing_camera,
    largest_plane,
    pixel_size,
    shown_there,
    surface_at,
    usual_spread,
)
from .masks import ViewMasks
from .mosaic import mosaic
from .witness import Says, Textures, Witness, ask

REACH = 2.0  # diagonals of the region round the object in which a shadow is looked for
DENSITY = 48  # texels per diagonal in which lights are settled; they are sought in half as many
ENOUGH = 64  # points that tell where a few texels lie
ROUGH = 0.2  # relative z by which drawn depths of rough splats may lie off the ground that they show
FEWEST = 100  # texels of a surface that is looked at
BESIDE = 2  # texels beside what the object hides that may show some of it, at least …
BLURRED = 3.0  # … and pixels of the views that show the place best
POINTS = 60_000  # of what views show, in which walls are sought …
FLAT = 0.03  # … diagonals from a plane within which they lie on it …
MUCH = 0.25  # … and the share of those that stand round the object that a wall holds
SOLID = 0.9  # alpha from which a view shows a surface
VIEWED = 1.25  # times the usual spread of photos beyond which they show something else


@dataclass(frozen=True)
class Ground:
    """What photos show of a surface round the object, coarsely; arrays [H, W] of a camera that faces it."""

    plane: Plane
    camera: Camera
    depth: np.ndarray  # float32 z
    there: np.ndarray  # bool, it is not behind another one
    image: np.ndarray  # [H, W, 3] uint8
    known: np.ndarray  # bool, several photos show it, and much the same
    hole: np.ndarray  # bool, the object hides it, or photos may show some of the object there

    def points(self, scale: float = 1) -> np.ndarray:
        """[h, w, 3] scene coordinates of its texels, or of smaller ones."""
        camera = self.camera.scaled(scale)
        z = cv2.resize(self.depth, (camera.width, camera.height), interpolation=cv2.INTER_LINEAR)
        return camera.unproject(camera.pixel_centres(), z.astype(np.float64))


def look_at(
    planes: Sequence[Plane], views: Sequence[ViewMasks], witnesses: Sequence[Witness], region: Region
) -> list[Ground]:
    """What photos show of the surfaces round the object, where they show enough, and of walls beside it."""
    planes = (*planes, *_walls(planes, views, witnesses, region))
    looked = (_look_at(plane, planes, views, witnesses, region) for plane in planes)
    return [ground for ground in looked if ground.known.sum() >= FEWEST]


def _walls(
    planes: Sequence[Plane], views: Sequence[ViewMasks], witnesses: Sequence[Witness], region: Region
) -> list[Plane]:
    """Planes beside the object, which it hides nowhere, that hold most of what stands round it."""
    diagonal = extent(region)

    def of(view: ViewMasks, witness: Witness) -> np.ndarray:
        shown = np.where(witness.hidden | (view.alpha_before < SOLID) | view.occluder, 0, view.depth_before)
        window = slice(0, view.camera.height), slice(0, view.camera.width)
        step = max(1, round(math.sqrt((shown > 0).sum() * len(views) / POINTS)))
        return surface_points(view.camera, shown, window, step)[2]

    points = np.concatenate(parallel_map(lambda p: of(*p), list(zip(views, witnesses))))
    points = points[(np.abs(points - planes[0].origin) < REACH * diagonal).all(1)]
    for plane in planes:
        points = points[plane.local(points)[:, 2] > FLAT * diagonal]
    cameras, rng = np.array([v.camera.centre for v in views]), np.random.default_rng(0)
    found: list[Plane] = []
    least = MUCH * len(points)
    while candidate := largest_plane(points, np.ones(len(points)), FLAT * diagonal, rng):
        point, normal, on = candidate
        if on.sum() < max(least, FEWEST):
            break
        points = points[~on]
        if all(abs(normal @ other.normal) <= PARALLEL for other in (*planes, *found)):  # or it is a rough ground's haze
            facing = normal if np.median((cameras - point) @ normal) > 0 else -normal
            found.append(Plane.make(point, facing, region))
    return found


def _look_at(
    plane: Plane, planes: Sequence[Plane], views: Sequence[ViewMasks], witnesses: Sequence[Witness], region: Region
) -> Ground:
    diagonal = extent(region)
    texel = diagonal / DENSITY
    camera, away = facing_camera(plane, plane.origin, np.full(2, 2 * REACH * diagonal), texel)
    beside = max(BESIDE, math.ceil(BLURRED * pixel_size(plane.origin, plane.normal, views) / texel))
    views, witnesses = zip(*parallel_map(lambda p: _shrunk(*p, plane.origin, texel), list(zip(views, witnesses))))
    textures = Textures.make(witnesses)
    surface = surface_at(camera, away, plane, region, views, witnesses, textures, ChartSettings(), ENOUGH)
    said = ask(witnesses, surface.texels, ROUGH).reshape(-1, camera.height, camera.width)
    image, spread = mosaic(surface.points, plane.normal, witnesses, said)
    photos, hidden = ((said == s).sum(0) for s in (Says.SEEN, Says.HIDDEN))
    there = np.ones(photos.shape, bool)
    for other in planes:
        if abs(other.normal @ plane.normal) <= PARALLEL:
            there &= other.local(surface.texels)[:, 2].reshape(there.shape) > 0
    known = shown_there(said) & (photos > 1) & there
    known &= spread < VIEWED * usual_spread(spread[known])
    hole = ((photos <= 1) & (hidden > 0)).astype(np.uint8)
    hole = cv2.dilate(hole, np.ones((2 * beside + 1,) * 2, np.uint8)) > 0
    return Ground(plane, camera, surface.depth, there, image, known & ~hole, hole)


def _shrunk(view: ViewMasks, witness: Witness, place: np.ndarray, texel: float) -> tuple[ViewMasks, Witness]:
    """The view at about a texel's resolution at a place; colours are those beside the object."""
    camera = view.camera
    z = float(camera.project(place[None])[1][0])
    factor = int(0.5 * texel * camera.fx / z) if z > 0 else 1
    factor = min(factor, camera.width // 2, camera.height // 2)
    if factor < 2:
        return view, witness
    h, w = camera.height // factor, camera.width // factor
    sizes = {"width": w, "height": h, **{k: getattr(camera, k) / factor for k in ("fx", "fy", "cx", "cy")}}
    small = replace(camera, **sizes)
    middle = slice(factor // 2, h * factor, factor), slice(factor // 2, w * factor, factor)

    def blocks(values: np.ndarray) -> np.ndarray:
        return values[: h * factor, : w * factor].reshape(h, factor, w, factor, *values.shape[2:])

    hidden, beside = (np.ascontiguousarray(m[middle]) for m in (witness.hidden, witness.beside))
    shown = ~(witness.hidden | witness.beside)
    count = blocks(shown).sum((1, 3))
    total = blocks(np.where(shown[..., None], witness.photo, 0)).sum((1, 3), dtype=np.int32)
    mean = (total / np.maximum(count, 1)[..., None]).astype(np.uint8)
    photo = np.where(count[..., None] > 0, mean, witness.photo[middle])
    depth = np.ascontiguousarray(witness.depth[middle])
    maps = {f.name: getattr(view, f.name)[middle] for f in fields(view) if f.name != "camera"}
    return replace(view, camera=small, **maps), Witness(small, photo, hidden, beside, depth)
