"""The object's shadow: the light that it keeps from surfaces, found by casting its own Gaussians from all sides."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
import scipy.ndimage

from ..box import Region
from ..camera import Camera
from ..gaussians import Gaussians
from ..solvers.lights import Lit, Surface
from ..threads import parallel_map
from .charts import PARALLEL, ChartSettings, Plane, extent, facing_camera, shown_there, surface_at, usual_spread
from .masks import ViewMasks
from .mosaic import mosaic
from .occluder import Occluder
from .witness import Says, Textures, Witness, ask

FINER = 2  # times as many along a side, in which it is stored
REACH = 2.0  # diagonals of the region round the object in which a shadow is looked for
DENSITY = 48  # texels per diagonal in which lights are settled; they are sought in half as many
LEVELS = (2, 4, 8, 16)  # texels: sides of blocks whose luminance is compared …
BROAD = (8, 16)  # … to tell how strong lights are: finer ones see edges, which no cast meets exactly
DIRECTIONS = 384  # about 8° apart
LOWEST = 8.0  # degrees above the support: light that comes from lower down is no light's
SOFTNESS = (4.0, 10.0, 25.0)  # degrees, σ of lobes of light that are tried …
ROUND = (384, 160, 32)  # … and how many of each
SAMPLES = 48  # rays to a light
SKY = 96  # and to the sky
MOST = 3  # lights
COARSEST, FINEST = 4.0, 1.0  # degrees, steps by which they are settled …
MOST_ROUNDS = 8  # … each so often at most
ELSEWHERE = 8  # places of the object that it might as well have …
ASIDE = 1.1  # … so many of its widths away
EARNS = 1.3  # times what chance explains, that a light must explain …
FITS = 0.52  # … and the share of what is uneven where its shadow falls
TOLD = 0.25  # of what a difference usually is, from which a shadow changes it
DARK = 2e-3  # of linear light, noise of a photo's
FAINT = 0.03  # share of light below which nothing is a shadow
EDGES = (0.7, 1.5, 3.0, 6.0)  # texels, σ of the edges that a marked shadow may have
ROUGH = 0.2  # relative z by which drawn depths of rough splats may lie off the ground that they show
FEWEST = 50  # texels of a surface that is looked at
BESIDE = 2  # texels beside what the object hides that may show some of it
VIEWED = 1.25  # times the usual spread of photos beyond which they show something else


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

    def direction(self, plane: Plane) -> np.ndarray:
        """[3] unit, scene coordinates, towards the light."""
        return self.towards @ np.stack([plane.right, plane.down, plane.normal])

    def azimuth(self, plane: Plane) -> float:
        """Degrees from the scene's x axis towards y (where the support is level in z; y to z, or z to x, else)."""
        up = int(np.argmax(np.abs(plane.normal)))
        direction = self.direction(plane)
        return math.degrees(math.atan2(direction[(up + 2) % 3], direction[(up + 1) % 3]))

    def rays(self, count: int = SAMPLES) -> np.ndarray:
        """[count, 3] directions, evenly drawn from the lobe (a sunflower's seeds)."""
        if not math.isfinite(self.softness):
            return _hemisphere(SKY)
        k = np.arange(count)
        radius = math.radians(self.softness) * np.sqrt(-2 * np.log(1 - (k + 0.5) / count))
        angle = k * math.pi * (3 - math.sqrt(5))
        a, b = _across(self.towards)
        rays = self.towards + np.tan(np.minimum(radius, 1.3))[:, None] * (
            np.cos(angle)[:, None] * a + np.sin(angle)[:, None] * b
        )
        return rays / np.linalg.norm(rays, axis=1, keepdims=True)


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


@dataclass(frozen=True)
class Shadow:
    """What the object keeps from its surroundings: told by lights that it stands before, or by a user's masks."""

    grounds: tuple[Ground, ...]  # what it may fall on
    occluder: Occluder | None  # None: masks tell
    lights: tuple[Light, ...]
    taken: tuple[
        np.ndarray, ...
    ]  # [h, w, 3] float32 each: the share of light taken from a ground, all over its picture
    explained: float  # share of the unevenness of light, where it falls, that it explains
    confidence: float  # 1 less what chance explains over what the lights do
    reason: str

    def arriving(
        self,
        points: np.ndarray,  # [N, 3] scene coordinates
        ground: int = -1,  # that they are on: its index; −1: none
    ) -> np.ndarray:
        """[N, 3] the share of light, per channel, that the object lets through; 1 far from it."""
        if ground >= 0:
            taken, (h, w) = self.taken[ground], self.grounds[ground].known.shape
            uv, _ = self.grounds[ground].camera.project(points)
            at = uv * [taken.shape[1] / w, taken.shape[0] / h] - 0.5
            x, y = at.astype(np.float32).T[:, :, None]
            return 1 - cv2.remap(taken, x, y, cv2.INTER_LINEAR)[:, 0].astype(np.float64)
        if self.occluder is None:
            return np.ones((len(points), 3))
        return 1 - _taken(self.occluder, self.lights, points)

    def facts(self) -> dict[str, Any]:
        """For the summary: lights by degrees, strengths in shares of light."""
        lights = [
            {
                "elevation": round(light.elevation, 2),
                "azimuth": round(light.azimuth(self.occluder.plane), 2),
                "softness": round(light.softness, 2),
                "direction": [round(float(x), 4) for x in light.direction(self.occluder.plane)],
                "strength": [round(float(x), 3) for x in light.strength],
            }
            for light in self.lights
            if self.occluder is not None and math.isfinite(light.softness)
        ]
        sky = [light.strength for light in self.lights if not math.isfinite(light.softness)]
        return {
            "found": True,
            "lights": lights,
            "sky": [round(float(x), 3) for x in sky[0]] if sky else None,
            "explained": round(self.explained, 3),
            "confidence": round(self.confidence, 3),
        }


def _taken(
    occluder: Occluder, lights: Sequence[Light], points: np.ndarray, normal: np.ndarray | None = None
) -> np.ndarray:
    """[N, 3] the share of light, per channel, that does not arrive at points of a surface."""
    taken = np.zeros((len(points), 3))
    for light in lights:
        taken += _cast(occluder, points, normal, light)[:, None] * light.strength
    return np.minimum(taken, 1 - DARK)


@dataclass(frozen=True)
class _Receiver:
    """A surface that a shadow may fall on, to be told from its colours."""

    surface: Surface
    points: np.ndarray  # [T, 3] of its known texels
    normal: np.ndarray  # [3]

    @classmethod
    def make(cls, ground: Ground) -> _Receiver:
        camera = ground.camera
        z = float(camera.project(ground.plane.origin[None])[1][0])
        points = camera.unproject(camera.pixel_centres(), np.full(ground.known.shape, z))
        return cls(
            Surface(ground.known, np.log(linear(ground.image) + DARK)), points[ground.known], ground.plane.normal
        )

    def halved(self) -> _Receiver:
        """Blocks of four texels, where half of them are known."""
        h, w = (2 * (n // 2) for n in self.surface.shown.shape)
        shown = self.surface.shown[:h, :w]
        points = np.zeros((*self.surface.shown.shape, 3))
        points[self.surface.shown] = self.points

        def blocks(values: np.ndarray) -> np.ndarray:
            return values[:h, :w].reshape(h // 2, 2, w // 2, 2, -1).sum((1, 3))

        count = blocks(shown)
        known = count[..., 0] >= 2
        colours, points = (
            blocks(np.where(shown[..., None], v[:h, :w], 0)) / np.maximum(count, 1)
            for v in (self.surface.colours, points)
        )
        return replace(self, surface=Surface(known, colours), points=points[known])


def find_shadow(
    gone: Gaussians,  # the object
    planes: Sequence[Plane],  # of the surfaces round it, the support first
    views: Sequence[ViewMasks],
    witnesses: Sequence[Witness],  # of the same views
    region: Region,
) -> Shadow | str:
    """The lights whose shadows of the object explain what is dark round it; or why there is none.

    Candidates are lobes of light all over the sky. The one that explains most of the differences of luminance round
    the object is taken, then the next. Texture is explained a little by any shape: a light must explain clearly more
    than brightness of any such shape does, here or where the object might as well stand. And a stain is dark, too: a
    light must explain most of what is uneven where its shadow falls.
    """
    if not planes:
        return "no shadow found: no surface is known that it could fall on"
    occluder = Occluder.make(gone, planes[0], extent(region))
    if occluder is None:
        return "no shadow found: nothing stands on the surface"
    grounds = look_at(planes, views, witnesses, region)
    fine = [_Receiver.make(g) for g in grounds]
    receivers = [half for half in (r.halved() for r in fine) if half.surface.shown.sum() >= FEWEST]
    if not receivers:
        return "no shadow found: photos do not show the surface round the object"
    lights, told = _search(_Stage.make(occluder, receivers))
    if not lights:
        return (
            f"no shadow found: the best light explains {told.over_chance:.1f} times what chance does, "
            f"{told.share:.0%} of what is uneven where its shadow would fall"
        )
    stage = _Stage.make(occluder, fine)
    sky = Light(np.array([0.0, 0.0, 1.0]), math.inf, np.ones(3))
    lights = [*stage.settled(lights, [sky], FINEST), sky]
    casts = stage.casts(lights)
    broad = Lit.make([r.surface for r in fine], BROAD, bent=False)
    strength, besides, _ = broad.fit(casts)
    tints = broad.tints(casts, strength)
    explained = broad.explained(casts @ strength, besides)
    lights = [replace(light, strength=s * t) for light, s, t in zip(lights, strength, tints)]
    words = ", ".join(
        f"{light.strength.mean():.0%} of the light comes from {light.elevation:.0f}° above the surface"
        f" (soft by {light.softness:.0f}°)"
        for light in lights[:-1]
    )
    words += f", {lights[-1].strength.mean():.0%} from the sky; {explained:.0%} of the unevenness is explained"
    maps = [g.points(FINER) for g in grounds]
    taken = tuple(
        _taken(occluder, lights, p.reshape(-1, 3), g.plane.normal).reshape(p.shape).astype(np.float32)
        for g, p in zip(grounds, maps)
    )
    confidence = told.share * (1 - 1 / told.over_chance)
    return Shadow(tuple(grounds), occluder, tuple(lights), taken, explained, confidence, words)


def marked_shadow(
    masks: Sequence[np.ndarray | None],  # [H, W] bool of the witnesses' views; None where the user marked none
    planes: Sequence[Plane],
    views: Sequence[ViewMasks],
    witnesses: Sequence[Witness],
    region: Region,
) -> Shadow | str:
    """The shadow that a user marked: where most of the masks see it on a ground, as dark as photos show it there.

    Its edge is as soft as photos show it: shapes of several softnesses share the strength.
    """
    grounds = look_at(planes, views, witnesses, region)
    if not grounds:
        return "the marked shadow falls on no surface that photos show: nothing is lifted"
    receivers = [_Receiver.make(g) for g in grounds]
    shapes = [_marked_on(ground, masks, witnesses) for ground in grounds]
    shadows = np.concatenate([s[g.known] for s, g in zip(shapes, grounds)])
    lit = Lit.make([r.surface for r in receivers], LEVELS)
    strength, besides, _ = lit.fit(shadows)
    if strength.sum() < FAINT:
        return "what is marked as shadow is not darker than what is round it: nothing is lifted"
    explained = lit.explained(shadows @ strength, besides)
    tints = strength[:, None] * lit.tints(shadows, strength)
    words = f"{strength.sum():.0%} of the light is missing where it is marked; {explained:.0%} is explained"
    return Shadow(
        tuple(grounds), None, (), tuple((s @ tints).astype(np.float32) for s in shapes), explained, 1.0, words
    )


def _marked_on(ground: Ground, masks: Sequence[np.ndarray | None], witnesses: Sequence[Witness]) -> np.ndarray:
    """[H, W, S] float32: where most masks mark a ground, with edges of several softnesses."""
    points = ground.points().reshape(-1, 3)
    said = ask(witnesses, points, ROUGH)
    votes, voters = np.zeros(len(points)), np.zeros(len(points))
    for mask, witness, says in zip(masks, witnesses, said):
        if mask is None:
            continue
        sees = np.isin(says, (Says.SEEN, Says.BESIDE))
        cols, rows = witness.camera.project(points[sees])[0].astype(int).T
        votes[sees] += mask[rows, cols]
        voters[sees] += 1
    marked = ((2 * votes > voters) & (voters > 0)).reshape(ground.known.shape).astype(np.float32)
    # what the object hides lies in its shadow, or the edge of the mask beside it would be one of light
    hole = ((said == Says.HIDDEN).any(0) & (voters == 0)).reshape(ground.known.shape)
    near = cv2.dilate(marked, np.ones((5, 5), np.uint8)) > 0
    labels, _ = scipy.ndimage.label(hole)
    marked[np.isin(labels, np.unique(labels[hole & near]))] = 1.0
    return np.stack([cv2.GaussianBlur(marked, (0, 0), sigma) for sigma in EDGES], -1)


@dataclass(frozen=True)
class _Sky:
    """Candidates for lights: lobes of several widths, in the support's axes."""

    rays: np.ndarray  # [D, 3]
    lobes: np.ndarray  # [D, A] float32, what share of a lobe each ray is
    towards: np.ndarray  # [A, 3]
    softness: np.ndarray  # [A] degrees

    @classmethod
    def make(cls) -> _Sky:
        rays = _hemisphere(DIRECTIONS)
        lobes, towards, softness = [], [], []
        for width, count in zip(SOFTNESS, ROUND):
            middle = _hemisphere(count)
            apart = np.degrees(np.arccos(np.clip(rays @ middle.T, -1, 1)))
            lobe = np.exp(-0.5 * (apart / width) ** 2)
            lobes.append(lobe / lobe.sum(0))
            towards.append(middle)
            softness.append(np.full(count, width))
        return cls(rays, np.concatenate(lobes, 1).astype(np.float32), np.concatenate(towards), np.concatenate(softness))

    def cast(self, occluder: Occluder, receivers: Sequence[_Receiver]) -> np.ndarray:
        """[T, A] float32: the share of each lobe that the object keeps from every texel."""
        return np.concatenate(
            [
                (occluder.blocked(r.points, self.rays) * _faces(occluder.plane, r.normal, self.rays)) @ self.lobes
                for r in receivers
            ]
        )


@dataclass(frozen=True)
class _Told:
    """What speaks for a light."""

    over_chance: float  # what it explains over what chance does
    share: float  # of what is uneven where its shadow falls that it explains, texture left out

    @property
    def enough(self) -> float:
        """1 or more if it is a light."""
        return min(self.over_chance / EARNS, self.share / FITS)


@dataclass(frozen=True)
class _Stage:
    """The object before its surroundings, to be lit."""

    occluder: Occluder
    receivers: Sequence[_Receiver]
    lit: Lit

    @classmethod
    def make(cls, occluder: Occluder, receivers: Sequence[_Receiver]) -> _Stage:
        return cls(occluder, receivers, Lit.make([r.surface for r in receivers], LEVELS))

    def cast(self, light: Light) -> np.ndarray:
        """[T] the share of its light that does not arrive."""
        return np.concatenate([_cast(self.occluder, r.points, r.normal, light) for r in self.receivers])

    def casts(self, lights: Sequence[Light]) -> np.ndarray:
        return np.stack([self.cast(light) for light in lights], 1)

    def settled(self, lights: Sequence[Light], others: Sequence[Light], finest: float) -> list[Light]:
        """Directions and softness, precisely: a pattern search, each light for what the rest does not explain."""
        lights, lit = list(lights), self.lit
        shadows = self.casts([*lights, *others])
        step, rounds = COARSEST, 0
        while step >= finest:
            moved, rounds = False, rounds + 1
            strength, besides, _ = lit.fit(shadows)
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

    def told(self, lights: Sequence[Light], bright: Sequence[np.ndarray]) -> list[_Told]:
        """Of each light beside the others; `bright`: changes that shapes make, first the object's where it stands.

        Chance explains brightness by any of them, or what these lights leave by yet another shadow of the object.
        """
        lit, shadows = self.lit, self.casts(lights)
        changes = lit.changes(shadows)
        strength, besides, _ = lit.fit(shadows)
        left = lit.residual(shadows @ strength, besides)
        chance = max(float(lit.gains(bright[0], left).max()), *(float(lit.gains(b, -left).max()) for b in bright))
        found = []
        for k in range(len(lights)):
            others = np.delete(shadows, k, axis=1)
            rest, besides, _ = lit.fit(others)
            without = lit.residual(others @ rest, besides)
            gain = float(lit.gains(changes[:, [k]], without)[0]) if strength[k] > FAINT else 0.0
            there = lit.only(np.abs(changes[:, k]) * strength[k] > TOLD * lit.noise)
            before, after, usual = there.loss(without), there.loss(left), there.usual_loss
            share = float(np.clip((before - after) / max(before - usual, 1e-12), 0, 1))
            # lights that take more than all light are none
            found.append(_Told(gain / max(chance, 1e-12), share / max(1.0, float(strength.sum()))))
        return found


def _search(stage: _Stage) -> tuple[list[Light], _Told]:
    """The lights, and what speaks for the weakest; or for the best candidate, if there is none."""
    lit, sky = stage.lit, _Sky.make()
    shadows = sky.cast(stage.occluder, stage.receivers)
    own = lit.changes(shadows)
    step = ASIDE * float(max(stage.occluder.size[:2]))
    around = [2 * math.pi * k / ELSEWHERE for k in range(ELSEWHERE)]
    moved = [stage.occluder.moved(step * math.cos(a), step * math.sin(a)) for a in around]
    bright = [own, *(lit.changes(sky.cast(m, stage.receivers)) for m in moved)]
    found: list[int] = []
    for _ in range(MOST):
        strength, besides, _ = lit.fit(shadows[:, found])
        residual = lit.residual(shadows[:, found] @ strength, besides)
        found.append(int(lit.gains(own, residual).argmax()))
    lights = [Light(sky.towards[k], float(sky.softness[k]), np.ones(3)) for k in found]
    settled = False
    while True:
        told = stage.told(lights, bright)
        worst = min(range(len(lights)), key=lambda k: told[k].enough if settled else told[k].over_chance)
        if told[worst].enough >= 1 if settled else told[worst].over_chance >= 1:
            if settled:
                return lights, told[worst]
            lights, settled = stage.settled(lights, [], COARSEST / 2), True
            continue
        if len(lights) == 1:
            return [], told[0]
        lights.pop(worst)
        if settled:
            lights = stage.settled(lights, [], COARSEST / 2)


def _near(light: Light, step: float) -> list[Light]:
    """Lights a step aside, softer and harder."""
    a, b = _across(light.towards)
    found = []
    for x, y in ((1, 0), (-1, 0), (0, 1), (0, -1)):
        towards = light.towards + math.tan(math.radians(step)) * (x * a + y * b)
        towards /= np.linalg.norm(towards)
        if towards[2] > math.sin(math.radians(LOWEST)):
            found.append(replace(light, towards=towards))
    factor = 1 + step / 8
    return [
        *found,
        *(replace(light, softness=float(np.clip(light.softness * f, 0.5, 45.0))) for f in (factor, 1 / factor)),
    ]


def _cast(occluder: Occluder, points: np.ndarray, normal: np.ndarray | None, light: Light) -> np.ndarray:
    """[N] the share of a light that does not arrive."""
    rays = light.rays()
    rays = rays[rays[:, 2] > 0]
    blocked = occluder.blocked(points, rays)
    facing = np.ones(len(rays)) if normal is None else _faces(occluder.plane, normal, rays)
    if not math.isfinite(light.softness):
        up = rays[:, 2] if normal is None else rays @ _turned(occluder.plane, normal)
        facing = facing * np.maximum(up, 0) / max(float(np.maximum(up, 0).mean()), 1e-6)
    return blocked @ (facing / len(rays)).astype(np.float32)


def _faces(plane: Plane, normal: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """[D]: a wall gets no light from behind."""
    return (rays @ _turned(plane, normal) > 0.02).astype(np.float32)


def _turned(plane: Plane, direction: np.ndarray) -> np.ndarray:
    """[3] in the plane's axes."""
    return np.stack([plane.right, plane.down, plane.normal]) @ direction


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


def look_at(
    planes: Sequence[Plane], views: Sequence[ViewMasks], witnesses: Sequence[Witness], region: Region
) -> list[Ground]:
    """What photos show of the surfaces round the object, where they show enough."""
    textures = Textures.make(witnesses, shrink=LEVELS[0])
    looked = (_look_at(plane, planes, views, witnesses, textures, region) for plane in planes)
    return [ground for ground in looked if ground.known.sum() >= FEWEST]


def _look_at(
    plane: Plane,
    planes: Sequence[Plane],
    views: Sequence[ViewMasks],
    witnesses: Sequence[Witness],
    textures: Textures,
    region: Region,
) -> Ground:
    diagonal = extent(region)
    camera, away = facing_camera(plane, plane.origin, np.full(2, 2 * REACH * diagonal), diagonal / DENSITY)
    softened = parallel_map(lambda w: _softened(w, plane.origin, diagonal / DENSITY), witnesses)
    surface = surface_at(camera, away, plane, region, views, witnesses, textures, ChartSettings())
    said = ask(softened, surface.texels, ROUGH).reshape(-1, camera.height, camera.width)
    image, spread = mosaic(surface.points, plane.normal, softened, said)
    photos, hidden = ((said == s).sum(0) for s in (Says.SEEN, Says.HIDDEN))
    there = np.ones(photos.shape, bool)
    for other in planes:
        if abs(other.normal @ plane.normal) <= PARALLEL:
            there &= other.local(surface.texels)[:, 2].reshape(there.shape) > 0
    known = shown_there(said) & (photos > 1) & there
    known &= spread < VIEWED * usual_spread(spread[known])
    hole = ((photos <= 1) & (hidden > 0)).astype(np.uint8)
    hole = cv2.dilate(hole, np.ones((2 * BESIDE + 1,) * 2, np.uint8)) > 0
    return Ground(plane, camera, surface.depth, there, image, known & ~hole, hole)


def _softened(witness: Witness, place: np.ndarray, texel: float) -> Witness:
    """The photo blurred to a texel's size at a place, without the object."""
    z = float(witness.camera.project(place[None])[1][0])
    sigma = 0.35 * texel * witness.camera.fx / z if z > 0 else 0.0
    if sigma < 0.6:
        return witness
    shown = (~(witness.hidden | witness.beside)).astype(np.float32)
    total = cv2.GaussianBlur(witness.photo * shown[..., None], (0, 0), sigma)
    weight = cv2.GaussianBlur(shown, (0, 0), sigma)
    return replace(witness, photo=np.clip(total / np.maximum(weight, 1e-3)[..., None], 0, 255).astype(np.uint8))


def linear(
    picture: np.ndarray,  # [..., 3] uint8 sRGB
) -> np.ndarray:
    """Linear light in [0, 1] (IEC 61966-2-1)."""
    x = np.arange(256) / 255.0
    return np.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4)[picture]
