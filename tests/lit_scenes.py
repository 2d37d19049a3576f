"""Made scenes whose light is known: a block on a floor, lit from given directions, its shadow worked out exactly.

The block's shadow is that of its six planes, not of its splats: what the program finds is measured against geometry.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import reduce

import numpy as np
from scenes import BLOCK, REGION, discs, floor_colours

from gimp3d.box import Box, Region
from gimp3d.camera import Camera
from gimp3d.gaussians import SH_C0, Gaussians
from gimp3d.orbit import orbit_cameras
from gimp3d.pipeline import render_bytes
from gimp3d.raster import render
from gimp3d.srgb import decoded, encoded

STEP = 0.025  # between splats
RAYS = 64  # to a soft light
SKY = 256  # and to all sides
WALL = 0.7  # x of the wall beside the block
SIDE = 1.6  # half of the floor's
DIFFERS = 8  # grey levels by which a reflection is seen


@dataclass(frozen=True)
class Lamp:
    """Light from far away."""

    elevation: float  # degrees
    azimuth: float
    softness: float  # degrees, σ; infinite: light from all sides, as in a room
    strength: float = 0.6  # share of a surface's light

    @property
    def direction(self) -> np.ndarray:
        e, a = math.radians(self.elevation), math.radians(self.azimuth)
        return np.array([math.cos(e) * math.cos(a), math.cos(e) * math.sin(a), math.sin(e)])

    def rays(self) -> np.ndarray:
        """[N, 3] directions of the lobe, at random but always the same; of the whole sky if it is endlessly soft."""
        if math.isinf(self.softness):
            a, b = np.random.default_rng(0).random((2, SKY))
            return np.stack([np.sqrt(a) * np.cos(2 * np.pi * b), np.sqrt(a) * np.sin(2 * np.pi * b), np.sqrt(1 - a)], 1)
        spread = np.random.default_rng(0).normal(size=(RAYS, 3)) * math.radians(self.softness)
        rays = self.direction + spread
        return rays / np.linalg.norm(rays, axis=1, keepdims=True)


@dataclass(frozen=True, eq=False)  # a scene is itself
class LitScene:
    """A scene with the object and its shadow, and what it is without."""

    name: str
    gaussians: Gaussians
    truth: Gaussians  # the ground alone, in full light but for what other things keep from it
    lamps: tuple[Lamp, ...]
    region: Region = REGION

    def cameras(self, count: int = 18, width: int = 240, height: int = 180) -> tuple[Camera, ...]:
        return orbit_cameras(self.region, count, (0, 0, 1), width, height, 60)


def blocked(points: np.ndarray, rays: np.ndarray, box: Box) -> np.ndarray:
    """[N] the share of rays from the points that meet a box (the slab test)."""
    low, high = box.corners().min(0), box.corners().max(0)
    met = np.zeros(len(points))
    for ray in rays:
        with np.errstate(divide="ignore", invalid="ignore"):
            a, b = (low - points) / ray, (high - points) / ray
        enter, leave = np.minimum(a, b).max(1), np.maximum(a, b).min(1)
        met += (leave > np.maximum(enter, 1e-6)) & (leave > 1e-6)
    return met / len(rays)


def lit(ground: Gaussians, normal: np.ndarray, lamps: Sequence[Lamp], boxes: Sequence[Box]) -> Gaussians:
    """A surface's splats in the shadow of boxes."""
    points, share = ground.means.astype(np.float64) + 1e-4 * normal, np.ones(len(ground))
    for lamp in lamps:
        rays = lamp.rays()
        rays = rays[rays @ normal > 0]
        if len(rays):
            share -= lamp.strength * np.max([blocked(points, rays, box) for box in boxes], axis=0)
    colours = np.clip(0.5 + SH_C0 * ground.sh[:, 0].astype(np.float64), 0.0, 1.0)
    sh = (encoded(decoded(colours) * share[:, None]) - 0.5) / SH_C0
    return replace(ground, sh=sh[:, None].astype(np.float32))


def plain(points: np.ndarray) -> np.ndarray:
    return np.full((len(points), 3), [0.7, 0.66, 0.6])


def tiles(points: np.ndarray) -> np.ndarray:
    """Light and dark tiles that meet under the block."""
    dark = (np.floor(points[:, 0] / 0.6) + np.floor(points[:, 1] / 0.6)) % 2 > 0
    return np.where(dark[:, None], [0.35, 0.38, 0.42], [0.75, 0.74, 0.7])


def grain(points: np.ndarray) -> np.ndarray:
    """Fine speckles of two sizes."""
    x, y = points[:, 0], points[:, 1]
    fine = np.sin(37 * x + 5 * np.sin(11 * y)) * np.sin(41 * y + 4 * np.sin(13 * x))
    return np.clip(0.6 + 0.12 * fine + 0.08 * np.sin(17 * x) * np.sin(19 * y), 0, 1)[:, None] * [1.0, 0.95, 0.88]


def rug(points: np.ndarray) -> np.ndarray:
    """A dark round rug under the block, on stripes."""
    on = np.hypot(points[:, 0], points[:, 1]) < 0.55
    return np.where(on[:, None], 0.45 * floor_colours(points), floor_colours(points))


def stain(points: np.ndarray) -> np.ndarray:
    """A dark blot that touches the block's foot on one side, as a shadow would."""
    away = np.hypot((points[:, 0] - 0.45) / 1.5, points[:, 1] - 0.1)
    return floor_colours(points) * (1 - 0.5 * np.exp(-((away / 0.2) ** 4)))[:, None]


def flat(points: np.ndarray) -> np.ndarray:
    return np.zeros(len(points))


def bent(points: np.ndarray) -> np.ndarray:
    """A gentle hill under the block."""
    return -0.08 * (points[:, 0] ** 2 + points[:, 1] ** 2)


def make_scene(
    name: str,
    lamps: Sequence[Lamp],
    paint: Callable[[np.ndarray], np.ndarray] = floor_colours,
    height: Callable[[np.ndarray], np.ndarray] = flat,
    wall: bool = False,
    neighbour: bool = False,  # another block, whose shadow has to stay
    casts: bool = True,  # the object
) -> LitScene:
    grid = np.arange(-SIDE, SIDE, STEP)
    x, y = (g.ravel() for g in np.meshgrid(grid, grid))
    points = np.stack([x, y, np.zeros_like(x)], -1)
    if wall:
        points = points[points[:, 0] < WALL]
    points[:, 2] = height(points)
    ground = [(discs(points, (0, 0, 1), paint(points), 0.7 * STEP), np.array([0.0, 0.0, 1.0]))]
    if wall:
        up, along = (g.ravel() for g in np.meshgrid(np.arange(0, 1.2, STEP), grid))
        points = np.stack([np.full_like(up, WALL), along, up], -1)
        colours = paint(np.stack([along, up, np.zeros_like(up)], -1))
        ground.append((discs(points, (1, 0, 0), colours, 0.7 * STEP), np.array([-1.0, 0.0, 0.0])))
    own = Box.make([0, 0, BLOCK / 2], [BLOCK] * 3)
    other = Box.make([-0.95, 0.55, 0.2], [0.4, 0.4, 0.4])
    others = [other] if neighbour else []
    things = cube(other, (0.2, 0.3, 0.8)) if neighbour else None

    def under(casters: Sequence[Box]) -> Gaussians:
        parts = [lit(splats, normal, lamps, casters) if casters else splats for splats, normal in ground]
        return reduce(Gaussians.extended, [*parts, *([things] if things is not None else [])])

    with_shadow = under([*others, own] if casts else others)
    hidden = (np.abs(with_shadow.means[:, :2]) < BLOCK / 2).all(1) & (np.abs(with_shadow.means[:, 2]) < 0.05)
    scene = with_shadow.take(~hidden).extended(cube(own, (0.85, 0.12, 0.1)))
    return LitScene(name, scene, under(others), tuple(lamps) if casts else ())


def glossy_scene(strength: float, lamps: Sequence[Lamp] = ()) -> LitScene:
    """A block on a floor that mirrors it, as trained splats hold that: seen through the floor, above another sky."""
    scene = make_scene("glossy", lamps)
    low = Box.make([0, 0, -BLOCK / 2 - 0.02], [BLOCK] * 3)
    image = cube(low, (0.85, 0.12, 0.1))
    top = image.means[:, 2] > -0.03  # cubes are open below, their mirror images above
    image.means[top, 2] = -BLOCK - 0.02
    x, y = (g.ravel() for g in np.meshgrid(*[np.arange(-6, 6, 0.25)] * 2))
    sky = discs(np.stack([x, y, np.full_like(x, -2.5)], -1), (0, 0, 1), np.tile([0.55, 0.7, 0.85], (len(x), 1)), 0.25)

    def seen_through(ground: Gaussians, opacity: float) -> Gaussians:
        floor_ = np.abs(ground.means[:, 2]) < 0.01
        logits = np.where(floor_, math.log(opacity / (1 - opacity)), ground.opacity_logits)
        return replace(ground, opacity_logits=logits.astype(np.float32))

    camera = scene.cameras()[0]
    below = np.s_[-40:, 80:160]  # pixels that show the floor alone
    tried = np.linspace(0.02, 0.9, 45)
    alpha = [render(seen_through(scene.truth, o), camera, passes=frozenset({"rgb"})).alpha[below].mean() for o in tried]
    opacity = float(np.interp(1 - strength, alpha, tried))
    truth = seen_through(scene.truth, opacity).extended(sky)
    return replace(scene, gaussians=seen_through(scene.gaussians, opacity).extended(image).extended(sky), truth=truth)


def reflected(scene: LitScene, camera: Camera) -> np.ndarray:
    """[H, W] bool: where a view of a glossy scene differs from the truth, but does not show the block."""
    block = cube(Box.make([0, 0, BLOCK / 2], [BLOCK] * 3), (1, 1, 1))
    shown = render(block, camera, passes=frozenset({"rgb"})).alpha > 0.01
    drawn, truth = (render_bytes(g, camera).astype(int) for g in (scene.gaussians, scene.truth))
    return (np.abs(drawn - truth).max(-1) > DIFFERS) & ~shown


def cube(box: Box, colour: tuple[float, float, float]) -> Gaussians:
    """Five sides of a box, open below."""
    half, centre = np.asarray(box.size) / 2, np.asarray(box.center)
    parts = []
    for axis, sign in ((0, 1), (0, -1), (1, 1), (1, -1), (2, 1)):
        a, b = (k for k in range(3) if k != axis)
        grid = [np.arange(-half[k], half[k] + 1e-6, STEP) for k in (a, b)]
        u, v = (g.ravel() for g in np.meshgrid(*grid))
        points = np.zeros((len(u), 3))
        points[:, a], points[:, b], points[:, axis] = u, v, sign * half[axis]
        normal = tuple(float(k == axis) for k in range(3))
        parts.append(discs(points + centre, normal, np.tile(colour, (len(u), 1)), 0.7 * STEP))  # type: ignore[arg-type]
    return reduce(Gaussians.extended, parts)


def shadowed_scenes() -> Iterator[LitScene]:
    """Suns of five heights, hard and soft, on several grounds; a room; two lights; a hill; a wall; a neighbour."""
    paints = (floor_colours, grain, tiles, plain, floor_colours)
    for k, elevation in enumerate((20, 32, 45, 58, 70)):
        for softness in (1.0, 8.0):
            lamp = Lamp(elevation, 40 + 67 * k, softness)
            yield make_scene(f"sun {elevation} {'hard' if softness < 2 else 'soft'}", [lamp], paints[k])
    yield make_scene("room", [Lamp(90, 0, math.inf, 0.9)], tiles)
    yield make_scene("two lights", [Lamp(40, 20, 3, 0.45), Lamp(50, 160, 3, 0.35)], grain)
    yield make_scene("hill", [Lamp(40, 110, 3)], floor_colours, bent)
    yield make_scene("wall", [Lamp(30, 180, 4)], floor_colours, wall=True)
    yield make_scene("neighbour", [Lamp(42, -60, 3)], grain, neighbour=True)


def unshadowed_scenes() -> Iterator[LitScene]:
    """What looks like a shadow, or could."""
    for paint in (floor_colours, grain, tiles, plain, rug, stain):
        yield make_scene(f"{paint.__name__}, no shadow", [], paint, casts=False)
    yield make_scene("wall, no shadow", [], floor_colours, wall=True, casts=False)
    yield make_scene("neighbour's shadow", [Lamp(42, -60, 3)], grain, neighbour=True, casts=False)
