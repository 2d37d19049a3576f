"""The lights whose shadows of the object explain what is dark round it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from ..compute.threads import parallel_map
from ..solvers.lights import LitSurface, Shading
from ..srgb import linear
from .charts.plane import Plane
from .ground import Ground
from .occluder import Occluder

DARK = 2e-3  # of linear light, noise of a photo's
LEVELS = (2, 4, 8, 16)  # texels of halved grounds: sides of the blocks whose luminance is compared
BROAD = (8, 16)  # texels of whole grounds: sides of the blocks that tell strengths; no cast meets finer edges exactly
DIRECTIONS = 384  # about 8° apart
LOWEST = 8.0  # degrees above the support: light that comes from lower down is no light's
SOFTNESS = (4.0, 10.0, 25.0)  # degrees, σ of lobes of light that are tried
LOBES = (384, 160, 32)  # directions in which lobes of each softness are tried
SOFT_RANGE = (0.5, 45.0)  # degrees between which softness is settled
SAMPLES = 48  # rays to a light
SKY = 96  # and to the sky, about
MOST = 3  # lights
COARSEST, FINEST = 4.0, 1.0  # degrees, first and last step by which lights are settled
MOST_ROUNDS = 8  # of settling by each step
ELSEWHERE = 8  # other places of the object, which tell what chance explains
ASIDE = 1.1  # widths of the object from its place to those
EARNS = 2.1  # times what chance explains that a light must explain: those that are there 2.4 to 12, others up to 1.8
FITS = 0.52  # share of what is uneven where its shadow falls that a light must explain
STARTS = False, True  # a long faint shadow may explain most, but little of what is uneven there: then those that fit
TOLD = 0.25  # of what a difference usually is, from which a shadow changes it
FAINT = 0.03  # share of light below which nothing is a shadow


@dataclass(frozen=True)
class Light:
    """A lobe of light from far away, or the whole sky's."""

    towards: np.ndarray  # [3] unit, in the axes of the support: right, down, normal
    softness: float  # degrees, σ; infinite: the sky, evenly
    strength: np.ndarray  # [3] share of a surface's light that comes from it, per channel

    @property
    def elevation(self) -> float:
        """Degrees above the support."""
        return math.degrees(math.asin(float(np.clip(self.towards[2], -1, 1))))

    def facts(self, plane: Plane) -> dict[str, Any]:
        """For the summary: degrees, the direction in scene coordinates, the azimuth from the scene's x axis towards y
        (where the plane is level in z; y to z, or z to x, else), strengths in shares of light."""
        up, towards = int(np.argmax(np.abs(plane.normal))), self.towards @ plane.axes
        return {
            "elevation": round(self.elevation, 2),
            "azimuth": round(math.degrees(math.atan2(towards[(up + 2) % 3], towards[(up + 1) % 3])), 2),
            "softness": round(self.softness, 2),
            "direction": [round(float(x), 4) for x in towards],
            "strength": [round(float(x), 3) for x in self.strength],
        }

    def rays(self, count: int = SAMPLES) -> np.ndarray:
        """[count, 3] directions, evenly drawn from the lobe (a sunflower's seeds)."""
        k = np.arange(count)
        radius = math.radians(self.softness) * np.sqrt(-2 * np.log(1 - (k + 0.5) / count))
        angle = k * math.pi * (3 - math.sqrt(5))
        a, b = _across(self.towards)
        across = np.cos(angle)[:, None] * a + np.sin(angle)[:, None] * b
        rays = self.towards + np.tan(np.minimum(radius, 1.3))[:, None] * across
        return rays / np.linalg.norm(rays, axis=1, keepdims=True)


def taken_from(
    occluder: Occluder, lights: Sequence[Light], points: np.ndarray, normal: np.ndarray | None = None
) -> np.ndarray:
    """[N, 3] the share of light, per channel, that does not arrive at points of a surface."""
    taken = sum(_cast(occluder, points, normal, light)[:, None] * light.strength for light in lights)
    return np.minimum(taken, 1 - DARK)


@dataclass(frozen=True)
class Receiver(LitSurface):
    """A surface that a shadow may fall on, to be told from its colours."""

    places: np.ndarray  # [H, W, 3] of its texels
    normal: np.ndarray  # [3]

    @classmethod
    def make(cls, ground: Ground) -> Receiver:
        return cls(ground.known, np.log(linear(ground.image) + DARK), ground.points(), ground.plane.normal)

    @property
    def points(self) -> np.ndarray:
        """[T, 3] of known texels."""
        return self.places[self.shown]

    def halved(self) -> Receiver:
        """Blocks of four texels, where half of them are known."""
        h, w = (n // 2 for n in self.shown.shape)
        shown = self.shown[: 2 * h, : 2 * w]

        def blocks(values: np.ndarray) -> np.ndarray:
            return values.reshape(h, 2, w, 2, -1).sum((1, 3))

        count = blocks(shown)
        colours, places = (
            blocks(np.where(shown[..., None], v[: 2 * h, : 2 * w], 0)) / np.maximum(count, 1)
            for v in (self.colours, self.places)
        )
        return replace(self, shown=count[..., 0] >= 2, colours=colours, places=places)


@dataclass(frozen=True)
class Scenery:
    """The object before its surroundings, to be lit."""

    occluder: Occluder
    receivers: Sequence[Receiver]

    @cached_property
    def lit(self) -> Shading:
        return Shading.make(self.receivers, LEVELS)

    def casts(self, lights: Sequence[Light]) -> np.ndarray:
        """[T, L] the share of each light that does not arrive."""
        parts = [[_cast(self.occluder, r.points, r.normal, light) for r in self.receivers] for light in lights]
        return np.stack([np.concatenate(p) for p in parts], 1)

    def settled(self, lights: Sequence[Light], others: Sequence[Light], finest: float) -> list[Light]:
        """Directions and softness, precisely: a pattern search, each light for what the rest does not explain."""
        lights, lit = list(lights), self.lit
        shadows = self.casts([*lights, *others])
        step, rounds = COARSEST, 0
        while step >= finest:
            moved, rounds = False, rounds + 1
            strength, besides = lit.fit(shadows)
            for k in range(len(lights)):
                rest = np.delete(shadows, k, axis=1) @ np.delete(strength, k)
                tries = [lights[k], *_near(lights[k], step)]
                casts = np.concatenate([shadows[:, [k]], self.casts(tries[1:])], axis=1)
                best = int(lit.gains(lit.changes(casts), lit.residual(rest, besides)).argmax())
                moved |= best > 0
                lights[k], shadows[:, k] = tries[best], casts[:, best]
            if not moved or rounds == MOST_ROUNDS:  # lights that share a shadow might follow one another for ever
                step, rounds = step / 2, 0
        return lights

    def most(self, tried: Sequence[tuple[np.ndarray, np.ndarray]]) -> float:
        """What the best of all shadows explains, given what they change, [K, S], and what is left, [K]; above 0."""
        return max(1e-12, *parallel_map(lambda by: float(self.lit.gains(*by).max()), tried))

    def told(self, lights: Sequence[Light], bright: Sequence[np.ndarray]) -> np.ndarray:
        """[L, 2] what speaks for each light beside the others: what it explains over what chance does, and what share
        of what is uneven where its shadow falls, texture left out. `bright`: changes that shapes make, first the
        object's where it stands.

        Chance explains brightness by any of them, or what these lights leave by yet another shadow of the object.
        """
        lit, shadows = self.lit, self.casts(lights)
        changes = lit.changes(shadows)
        strength, besides = lit.fit(shadows)
        left = lit.residual(shadows @ strength, besides)
        chance = self.most([(bright[0], left), *((b, -left) for b in bright)])
        found = []
        for k in range(len(lights)):
            others = np.delete(shadows, k, axis=1)
            rest, besides = lit.fit(others)
            without = lit.residual(others @ rest, besides)
            gain = float(lit.gains(changes[:, [k]], without)[0]) if strength[k] > FAINT else 0.0
            there = replace(lit, weight=lit.weight * (np.abs(changes[:, k]) * strength[k] > TOLD * lit.noise))
            # lights that take more than all light are none
            share = there.share(without, left) / max(1.0, float(strength.sum()))
            found.append((gain / chance, share))
        return np.array(found)


def search(scenery: Scenery) -> tuple[list[Light], np.ndarray]:
    """The lights, and what speaks for the weakest, see told; or for the best candidate, if there is none."""
    lit, (rays, shares, lobes) = scenery.lit, _candidates()

    def cast(by: Occluder) -> np.ndarray:
        """[T, A] float32: the share of each lobe that the object keeps from every texel."""
        kept = (by.blocked(r.points, rays) * _faces(by.plane, r.normal, rays) for r in scenery.receivers)
        return np.concatenate([share @ shares for share in kept])

    shadows = cast(scenery.occluder)
    own = lit.changes(shadows)
    moved = [scenery.occluder.moved(x, y) for x, y in places_elsewhere(float(max(scenery.occluder.size[:2])))]
    bright = [own, *parallel_map(lambda m: lit.changes(cast(m)), moved)]

    def first(fitting: bool) -> list[Light]:
        """One by one those that explain most, or that explain much and fit."""
        found: list[int] = []
        for _ in range(MOST):
            strength, besides = lit.fit(shadows[:, found])
            residual = lit.residual(shadows[:, found] @ strength, besides)
            scores = lit.gains(own, residual)
            if fitting:
                chance = scenery.most([(b, -residual) for b in bright])
                scores = np.minimum(scores / (EARNS * chance), lit.shares(own, residual, TOLD) / FITS)
            found.append(int(scores.argmax()))
        return [lobes[k] for k in found]

    for fitting in STARTS:
        lights, told = _kept(scenery, first(fitting), bright)
        if lights or told[0] <= EARNS:
            break
    return lights, told


def _kept(scenery: Scenery, lights: Sequence[Light], bright: Sequence[np.ndarray]) -> tuple[list[Light], np.ndarray]:
    """Those lights that speak for themselves beside the others, settled; see search."""
    lights, settled = list(lights), False
    while True:
        told = scenery.told(lights, bright)
        scores = (told / [EARNS, FITS]).min(1) if settled else told[:, 0]
        worst = int(np.argmin(scores))
        if scores[worst] >= 1:
            if settled:
                return lights, told[worst]
            settled = True
        elif len(lights) == 1:
            return [], told[0]
        else:
            lights.pop(worst)
        if settled:
            lights = scenery.settled(lights, [], COARSEST / 2)


def _candidates() -> tuple[np.ndarray, np.ndarray, list[Light]]:
    """Rays [D, 3], what share of a lobe each of them is [D, A] float32, and the lobes: of several widths."""
    rays, shares, lobes = _hemisphere(DIRECTIONS), [], list[Light]()
    for width, count in zip(SOFTNESS, LOBES):
        middle = _hemisphere(count)
        apart = np.degrees(np.arccos(np.clip(rays @ middle.T, -1, 1)))
        lobe = np.exp(-0.5 * (apart / width) ** 2)
        shares.append(lobe / lobe.sum(0))
        lobes += [Light(towards, width, np.ones(3)) for towards in middle]
    return rays, np.concatenate(shares, 1).astype(np.float32), lobes


def places_elsewhere(width: float) -> list[tuple[float, float]]:
    """Ways along the plane to where an object of some width might as well stand."""
    around = [2 * math.pi * k / ELSEWHERE for k in range(ELSEWHERE)]
    return [(ASIDE * width * math.cos(a), ASIDE * width * math.sin(a)) for a in around]


def _near(light: Light, step: float) -> list[Light]:
    """Lights a step aside, softer and harder."""
    a, b = _across(light.towards)
    found = []
    for way in (a, -a, b, -b):
        towards = light.towards + math.tan(math.radians(step)) * way
        towards /= np.linalg.norm(towards)
        if towards[2] > math.sin(math.radians(LOWEST)):
            found.append(replace(light, towards=towards))
    factor = 1 + step / 8
    softer = (np.clip(light.softness * f, *SOFT_RANGE) for f in (factor, 1 / factor))
    return [*found, *(replace(light, softness=float(s)) for s in softer)]


def _cast(occluder: Occluder, points: np.ndarray, normal: np.ndarray | None, light: Light) -> np.ndarray:
    """[N] the share of a light that does not arrive."""
    if math.isfinite(light.softness):
        rays = light.rays()
        rays = rays[rays[:, 2] > 0]
        facing = np.ones(len(rays)) if normal is None else _faces(occluder.plane, normal, rays)
        total: float = len(rays)
    else:
        rays = _open_sky(occluder.walls)
        facing = np.maximum(rays[:, 2] if normal is None else rays @ (occluder.plane.axes @ normal), 0)
        total = max(float(facing.sum()), 1e-6)
    return occluder.blocked(points, rays) @ (facing / total).astype(np.float32)


def _open_sky(walls: np.ndarray) -> np.ndarray:
    """[D, 3] directions of the sky that no wall, by its normal [W, 3], hides; D is at least SKY in most corners."""
    for finer in (1, 2, 4, 8):
        rays = _hemisphere(finer * SKY)
        rays = rays[(rays @ walls.T > 0).all(1)]
        if len(rays) >= SKY:
            break
    return rays


def _faces(plane: Plane, normal: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """[D]: a wall gets no light from behind."""
    return (rays @ (plane.axes @ normal) > 0.02).astype(np.float32)


def _across(towards: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two unit vectors across a direction."""
    aside = np.eye(3)[int(np.argmin(np.abs(towards)))]
    a = np.cross(towards, aside)
    a /= np.linalg.norm(a)
    return a, np.cross(towards, a)


def _hemisphere(count: int) -> np.ndarray:
    """[count, 3] directions, evenly spread (Fibonacci's spiral), from LOWEST up."""
    k = np.arange(count)
    low = math.sin(math.radians(LOWEST))
    z = low + (1 - low) * (k + 0.5) / count
    r, angle = np.sqrt(1 - z * z), k * math.pi * (3 - math.sqrt(5))
    return np.stack([r * np.cos(angle), r * np.sin(angle), z], 1)
