"""The object's shadow: the light that it keeps from surfaces, found by casting its own Gaussians from all sides."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import cv2
import numpy as np
import scipy.ndimage

from ..box import Region
from ..gaussians import Gaussians
from ..geometry import colours_at, dilated
from ..solvers.lights import Shading
from .charts.plane import Plane, extent
from .ground import FEWEST, ROUGH, Ground
from .light_search import BROAD, DARK, FAINT, FINEST, LEVELS, Light, Receiver, Scenery, search, taken_from
from .occluder import Occluder
from .witness import Says, Witness, ask

DULL = 0.5  # share of the light that the object takes from a surface and does not give back
UNTOUCHED = 0.99  # share of light from which nothing is in the shadow
FINER = 2  # times as many along a side, in which it is stored
EDGES = (0.7, 1.5, 3.0, 6.0)  # texels, σ of the edges that a marked shadow may have


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
            return 1 - colours_at(taken, uv * [taken.shape[1] / w, taken.shape[0] / h]).astype(np.float64)
        light = np.ones((len(points), 3))
        if self.occluder is not None:
            uv, _ = self.grounds[0].camera.project(points)
            near = ((uv >= 0) & (uv < self.grounds[0].known.shape[::-1])).all(1)  # no shadow is looked for elsewhere
            light[near] -= taken_from(self.occluder, self.lights, points[near])
        return light

    @cached_property
    def reach(self) -> np.ndarray:
        """[N, 3] points round the space that it may reach: where it falls on grounds, and as high as the object."""
        points = []
        for ground, taken in zip(self.grounds, self.taken):
            there = cv2.resize(taken, ground.known.shape[::-1], interpolation=cv2.INTER_AREA).max(-1) > 1 - UNTOUCHED
            points.append(ground.points()[::2, ::2][there[::2, ::2] & ground.there[::2, ::2]])
        low = np.concatenate(points)
        if self.occluder is None:
            return low
        return np.concatenate([low, low + self.occluder.top * self.occluder.plane.normal])

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


def find_shadow(
    gone: Gaussians,  # the object
    planes: Sequence[Plane],  # of the surfaces round it, the support first
    grounds: Sequence[Ground],  # of those planes, as far as photos show them
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
    occluder = Occluder.make(gone, planes[0], extent(region), [g.plane for g in grounds])
    if occluder is None:
        return "no shadow found: nothing stands on the surface"
    receivers = [half for half in (Receiver.make(g).halved() for g in grounds) if half.surface.shown.sum() >= FEWEST]
    if not receivers:
        return "no shadow found: photos do not show the surface round the object"
    scenery = Scenery.make(occluder, receivers)
    lights, told = search(scenery)
    if not lights:
        return (
            f"no shadow found: the best light explains {told.over_chance:.1f} times what chance does, "
            f"{told.share:.0%} of what is uneven where its shadow would fall"
        )
    sky = Light(np.array([0.0, 0.0, 1.0]), math.inf, np.ones(3))
    lights = [*scenery.settled(lights, [sky], FINEST), sky]
    fine = [Receiver.make(g) for g in grounds]
    casts = replace(scenery, receivers=fine).casts(lights)
    broad = Shading.make([r.surface for r in fine], BROAD, bent=False)
    # what comes from no light comes from the sky: wide shadows of that are hardly told from paint
    suns, skies = casts[:, :-1] - DULL * casts[:, -1:], casts[:, -1:]
    strength, _, _ = broad.fit(np.concatenate([suns, skies], 1), np.array([*[0.0] * suns.shape[1], DULL]))
    strength[-1] -= DULL * strength[:-1].sum()
    tints = broad.tints(casts, strength)
    coarse = scenery.casts(lights)
    explained = scenery.lit.explained(coarse @ strength, scenery.lit.fit(coarse)[1])
    if explained < FAINT:
        return "no shadow found: light is missing close to the object, as if in its shadow, but not round it"
    lights = [replace(light, strength=s * t) for light, s, t in zip(lights, strength, tints)]
    words = ", ".join(
        f"{light.strength.mean():.0%} of the light comes from {light.elevation:.0f}° above the surface"
        f" (soft by {light.softness:.0f}°)"
        for light in lights[:-1]
    )
    words += f", {lights[-1].strength.mean():.0%} from the sky; {explained:.0%} of the unevenness is explained"
    maps = [g.points(FINER) for g in grounds]
    taken = tuple(
        taken_from(occluder, lights, p.reshape(-1, 3), g.plane.normal).reshape(p.shape).astype(np.float32)
        for g, p in zip(grounds, maps)
    )
    confidence = told.share * (1 - 1 / told.over_chance)
    return Shadow(tuple(grounds), occluder, tuple(lights), taken, explained, confidence, words)


def marked_shadow(
    masks: Sequence[np.ndarray | None],  # [H, W] bool of the witnesses' views; None where the user marked none
    grounds: Sequence[Ground],
    witnesses: Sequence[Witness],
) -> Shadow | str:
    """The shadow that a user marked: where most of the masks see it on a ground, as dark as photos show it there.

    Its edge is as soft as photos show it: shapes of several softnesses share the strength.
    """
    if not grounds:
        return "the marked shadow falls on no surface that photos show: nothing is lifted"
    receivers = [Receiver.make(g) for g in grounds]
    shapes = [_marked_on(ground, masks, witnesses) for ground in grounds]
    shadows = np.concatenate([s[g.known] for s, g in zip(shapes, grounds)])
    lit = Shading.make([r.surface for r in receivers], LEVELS)
    strength, besides, _ = lit.fit(shadows)
    if strength.sum() < FAINT:
        return "what is marked as shadow is not darker than what is round it: nothing is lifted"
    explained = lit.explained(shadows @ strength, besides)
    tints = strength[:, None] * lit.tints(shadows, strength)
    words = f"{strength.sum():.0%} of the light is missing where it is marked; {explained:.0%} is explained"
    taken = tuple(np.minimum(s @ tints, 1 - DARK).astype(np.float32) for s in shapes)
    return Shadow(tuple(grounds), None, (), taken, explained, 1.0, words)


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
    labels, _ = scipy.ndimage.label(hole)
    marked[np.isin(labels, np.unique(labels[hole & dilated(marked > 0, 2)]))] = 1.0
    return np.stack([cv2.GaussianBlur(marked, (0, 0), sigma) for sigma in EDGES], -1)
