"""The surfaces round the object, seen straight on and coarsely: what its shadow may fall on."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ..box import Region
from ..compute.threads import parallel_map
from ..geometry import dilated
from .charts import scatter_about, shown_there, usual_spread
from .charts.find import TOLERANCE, surface_beside
from .charts.lay import flat_surface, lay_surface, pixel_size
from .charts.plane import Facing, Plane, extent, largest_plane
from .witness import Says, Textures, Witness, ask, mosaic

REACH = 2.0  # diagonals of the region round the object in which a shadow is looked for
DENSITY = 48  # texels per diagonal in which lights are settled; they are sought in half as many
ENOUGH = 64  # points that tell where a few texels lie
FEWEST = 100  # texels of a surface that is looked at
BESIDE = 2  # texels beside what the object hides that may show some of it, at least
BLURRED = 3.0  # pixels of the views that show the place best; so much beside it may show some of the object, too
WALL_POINTS = 60_000  # points of surface, about, among which walls are sought
WALL_INLIER = 0.03  # diagonals of the region from a plane within which a point lies on it
WALL_SHARE = 0.25  # share of the points above the known planes that a wall holds
VIEWED = 1.25  # times the usual spread of photos beyond which they show something else

Ground = Facing  # what photos show of a surface round the object, coarsely


def look_at(planes: Sequence[Plane], witnesses: Sequence[Witness], region: Region) -> list[Ground]:
    """What photos show of the surfaces round the object, where they show enough, and of walls beside it."""
    planes = (*planes, *_walls(planes, witnesses, region))
    looked = (_look_at(plane, planes, witnesses, region) for plane in planes)
    return [ground for ground in looked if ground.known.sum() >= FEWEST]


def _walls(planes: Sequence[Plane], witnesses: Sequence[Witness], region: Region) -> list[Plane]:
    """Planes beside the object, which it hides nowhere, that hold most of what stands round it."""
    diagonal = extent(region)
    points = surface_beside(witnesses, WALL_POINTS).points
    points = points[(np.abs(points - planes[0].origin) < REACH * diagonal).all(1)]
    for plane in planes:
        points = points[plane.local(points)[:, 2] > WALL_INLIER * diagonal]
    cameras, rng = np.array([w.camera.centre for w in witnesses]), np.random.default_rng(0)
    found: list[Plane] = []
    least = WALL_SHARE * len(points)
    while candidate := largest_plane(points, np.ones(len(points)), WALL_INLIER * diagonal, cameras, region, rng):
        plane, on = candidate
        if on.sum() < max(least, FEWEST):
            break
        points = points[~on]
        if all(plane.crosses(other) for other in (*planes, *found)):  # or it is a rough ground's haze
            found.append(plane)
    return found


def _look_at(plane: Plane, planes: Sequence[Plane], witnesses: Sequence[Witness], region: Region) -> Ground:
    diagonal = extent(region)
    texel = diagonal / DENSITY
    flat = flat_surface(plane, plane.origin, np.full(2, 2 * REACH * diagonal), texel)
    beside = max(BESIDE, math.ceil(BLURRED * pixel_size(plane.origin, plane.normal, witnesses) / texel))
    witnesses = parallel_map(lambda w: _shrunk(w, plane.origin, texel), witnesses)
    textures = Textures.make(witnesses)
    crossing = tuple(other for other in planes if plane.crosses(other))
    surface = lay_surface(flat, region, witnesses, textures, enough=ENOUGH, others=crossing)
    points = surface.points()
    tolerance = max(TOLERANCE, scatter_about(surface, crossing, witnesses))
    said = ask(witnesses, points.reshape(-1, 3), tolerance).reshape(-1, *flat.depth.shape)
    image, spread, _ = mosaic(points, plane.normal, witnesses, said)
    photos, hidden = ((said == s).sum(0) for s in (Says.SEEN, Says.HIDDEN))
    there = np.ones(photos.shape, bool)
    for other in crossing:
        there &= other.local(points.reshape(-1, 3))[:, 2].reshape(there.shape) > 0
    known = shown_there(said) & (photos > 1) & there
    known &= spread < VIEWED * usual_spread(spread[known])
    hole = dilated((photos <= 1) & (hidden > 0), beside)
    return Ground(plane, flat.camera, surface.depth, there, image, known & ~hole, hole, tolerance)


def _shrunk(witness: Witness, place: np.ndarray, texel: float) -> Witness:
    """The view at about a texel's resolution at a place; colours are those beside the object."""
    camera = witness.camera
    z = float(camera.project(place[None])[1][0])
    factor = min(int(0.5 * texel * camera.fx / z) if z > 0 else 1, camera.width // 2, camera.height // 2)
    if factor < 2:
        return witness
    h, w = camera.height // factor, camera.width // factor
    lens = {name: getattr(camera, name) / factor for name in ("fx", "fy", "cx", "cy")}
    small = replace(camera, width=w, height=h, **lens)
    middle = slice(factor // 2, h * factor, factor), slice(factor // 2, w * factor, factor)

    def blocks(values: np.ndarray) -> np.ndarray:
        return values[: h * factor, : w * factor].reshape(h, factor, w, factor, *values.shape[2:])

    maps = (witness.hidden, witness.beside, witness.veiled, witness.depth)
    shown = ~(witness.hidden | witness.beside)
    count = blocks(shown).sum((1, 3))
    total = blocks(np.where(shown[..., None], witness.photo, 0)).sum((1, 3), dtype=np.int32)
    mean = (total / np.maximum(count, 1)[..., None]).astype(np.uint8)
    photo = np.where(count[..., None] > 0, mean, witness.photo[middle])
    return Witness(small, photo, *(np.ascontiguousarray(m[middle]) for m in maps))
