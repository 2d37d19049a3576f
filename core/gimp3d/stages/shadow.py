"""The object's shadow: the light that it keeps from surfaces, found by casting its own Gaussians from all sides.

Lamps cast shadows that have a shape; what the object keeps from its nearest surroundings of the light of a whole room
has none but that of its own foot: a dark rim round what it hides. That is narrow, so it is looked for on charts, and
only beside the hole.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import cv2
import numpy as np
import scipy.ndimage
from scipy.spatial import cKDTree

from ..box import Region
from ..gaussians import Gaussians
from ..geometry import colours_at, dilated
from ..solvers.lights import Shading
from ..srgb import linear
from .charts import Chart
from .charts.plane import Plane, extent
from .ground import FEWEST, Ground
from .light_search import BROAD, DARK, FAINT, FINEST, LEVELS, Light, Receiver, Scenery, search, taken_from
from .occluder import Occluder
from .witness import Says, Witness, ask

DULL = 0.5  # share of the light that the object takes from a surface and does not give back
UNTOUCHED = 0.99  # share of light from which nothing is in the shadow
FINER = 2  # times as many along a side, in which it is stored
EDGES = (0.7, 1.5, 3.0, 6.0)  # texels, σ of the edges that a marked shadow may have
MOSTLY = 0.5  # share of a lamp's shadow that is marked, if it is the one that is meant
MIXED = 0.75  # share of light below which pixels beside the object are filled: its colours would be lifted too (3 dB)
# Of the rim:
WIDTH = 0.1  # of the hole's size: as far as such a shadow is sought; as far again lies what it is compared with
LEAST_WIDTH = 3.0  # texels of that
STRIPS = 4  # of equal distance from the hole, each of which may be dark
LIKE = 0.3  # log of a ratio of channels by which a surface's colours differ as much as one width away
COMPARED = 15  # texels of like colour with which one is compared
VISIBLE = 0.1  # of log luminance, below which nobody sees a rim
CHANCE = 3.0  # times as much of the outline must be dark as farther out, where nothing touches anything
TOO_DARK = 1.01 - MIXED  # share of light; what only pixels show that may be the object's, in its shadow, is filled
SOME = 0.05  # share of the outline that chance makes dark at least


@dataclass(frozen=True)
class Shadow:
    """What the object keeps from its surroundings: told by lights that it stands before, or by a user's masks."""

    grounds: tuple[Ground, ...]  # what it may fall on
    occluder: Occluder | None  # None: masks tell
    lights: tuple[Light, ...]
    taken: tuple[np.ndarray, ...]  # [h, w, 3] float32 each: the share of light taken from a ground, in all its picture
    explained: float  # share of the unevenness of light, where it falls, that it explains
    confidence: float  # 1 less what chance explains over what the lights do
    reason: str

    def arriving(self, points: np.ndarray, ground: int) -> np.ndarray:
        """[N, 3] the share of light, per channel, that the object lets through; 1 far from it. The points [N, 3], scene
        coordinates, are on the ground of an index; −1: on none."""
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
        suns = [light for light in self.lights if math.isfinite(light.softness)]
        sky = [light.strength for light in self.lights if not math.isfinite(light.softness)]
        return {
            "found": True,
            "lights": [light.facts(self.occluder.plane) for light in suns] if self.occluder is not None else [],
            "sky": [round(float(x), 3) for x in sky[0]] if sky else None,
            "explained": round(self.explained, 3),
            "confidence": round(self.confidence, 3),
        }


def find_shadow(gone: Gaussians, support: Plane, grounds: Sequence[Ground], region: Region) -> Shadow | str:
    """The lights whose shadows of the object, `gone`, explain what is dark round it; or why there is none.

    Candidates are lobes of light all over the sky. The one that explains most of the differences of luminance round
    the object is taken, then the next. Texture is explained a little by any shape: a light must explain clearly more
    than brightness of any such shape does, here or where the object might as well stand. And a stain is dark, too: a
    light must explain most of what is uneven where its shadow falls.
    """
    occluder = Occluder.make(gone, support, extent(region), [g.plane for g in grounds])
    if occluder is None:
        return "no shadow found: nothing stands on the surface"
    fine = [Receiver.make(g) for g in grounds]
    receivers = [half for half in (r.halved() for r in fine) if half.shown.sum() >= FEWEST]
    if not receivers:
        return "no shadow found: photos do not show the surface round the object"
    scenery = Scenery(occluder, receivers)
    lights, (over_chance, share) = search(scenery)
    if not lights:
        return (
            f"no shadow found: the best light explains {over_chance:.1f} times what chance does, "
            f"{share:.0%} of what is uneven where its shadow would fall"
        )
    sky = Light(np.array([0.0, 0.0, 1.0]), math.inf, np.ones(3))
    lights = [*scenery.settled(lights, [sky], FINEST), sky]
    casts, broad = Scenery(occluder, fine).casts(lights), Shading.make(fine, BROAD, bent=False)
    # what comes from no light comes from the sky: wide shadows of that are hardly told from paint
    suns, skies = casts[:, :-1] - DULL * casts[:, -1:], casts[:, -1:]
    strength, _ = broad.fit(np.concatenate([suns, skies], 1), np.array([*[0.0] * suns.shape[1], DULL]))
    strength[-1] -= DULL * strength[:-1].sum()
    tints = broad.tints(casts, strength)
    coarse = scenery.casts(lights)
    explained = scenery.lit.explained(coarse @ strength, scenery.lit.fit(coarse)[1])
    if explained < FAINT:
        return "no shadow found: light is missing close to the object, as if in its shadow, but not round it"
    lights = [replace(light, strength=s * t) for light, s, t in zip(lights, strength, tints)]
    confidence = float(share * (1 - 1 / over_chance))
    taken = _taken(occluder, lights, grounds, FINER)
    return Shadow(tuple(grounds), occluder, tuple(lights), taken, explained, confidence, _told(lights, explained))


def _told(lights: Sequence[Light], explained: float) -> str:
    """Lamps, and the sky as the last one, in words."""
    words = ", ".join(
        f"{light.strength.mean():.0%} of the light comes from {light.elevation:.0f}° above the surface"
        f" (soft by {light.softness:.0f}°)"
        for light in lights[:-1]
    )
    return f"{words}, {lights[-1].strength.mean():.0%} from the sky; {explained:.0%} of the unevenness is explained"


def _taken(
    occluder: Occluder, lights: Sequence[Light], grounds: Sequence[Ground], finer: int
) -> tuple[np.ndarray, ...]:
    """What an occluder takes of lights, [h, w, 3] float32 each, in pictures of the grounds that are so much finer."""

    def of(ground: Ground) -> np.ndarray:
        points = ground.points(finer)
        whole = taken_from(occluder, lights, points.reshape(-1, 3), ground.plane.normal)
        return whole.reshape(points.shape).astype(np.float32)

    return tuple(map(of, grounds))


def marked_shadow(
    masks: Sequence[np.ndarray | None],
    grounds: Sequence[Ground],
    witnesses: Sequence[Witness],
    cast: Shadow | str,  # what the object casts, see find_shadow
) -> Shadow | str:
    """The shadow that a user marked, in masks [H, W] bool of the witnesses' views, None where there is none: where most
    of them see it on a ground, as dark as photos show it there.

    What the object casts by a lamp whose shadow is mostly marked is darker in some places than in others, and its edge
    fades beyond any mark: it is undone whole. If it explains less than evenly dark shapes do, or no lamp is known, they
    tell. Their edge is as soft as photos show it: several softnesses share the strength.
    """
    if not grounds:
        return "the marked shadow falls on no surface that photos show: nothing is lifted"
    shapes = [_marked_on(ground, masks, witnesses) for ground in grounds]
    lit = Shading.make([Receiver.make(g) for g in grounds], LEVELS)

    def fitted(of: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
        """Shadows [T, S] where grounds are known, strengths, what is besides, and the loss."""
        shadows = np.concatenate([s[g.known] for s, g in zip(of, grounds)])
        strength, besides = lit.fit(shadows)
        return shadows, strength, besides, lit.loss(lit.residual(shadows @ strength, besides))

    shadows, strength, besides, loss = fitted(shapes)
    own = _of_marked_lamps(cast, shapes) if isinstance(cast, Shadow) else None
    if own is not None:
        sizes = [g.known.shape[::-1] for g in grounds]
        whole = [cv2.resize(t.mean(-1), s, interpolation=cv2.INTER_AREA)[..., None] for t, s in zip(own.taken, sizes)]
        own_shadows, own_strength, own_besides, own_loss = fitted(whole)
        if own_loss < loss:
            explained = lit.explained(own_shadows @ own_strength, own_besides)
            return replace(own, explained=explained, reason=f"as it is marked: {_told(own.lights, explained)}")
    if strength.sum() < FAINT:
        return "what is marked as shadow is not darker than what is round it: nothing is lifted"
    explained = lit.explained(shadows @ strength, besides)
    tints = strength[:, None] * lit.tints(shadows, strength)
    words = f"{strength.sum():.0%} of the light is missing where it is marked; {explained:.0%} is explained"
    taken = tuple(np.minimum(s @ tints, 1 - DARK).astype(np.float32) for s in shapes)
    return Shadow(tuple(grounds), None, (), taken, explained, 1.0, words)


def _of_marked_lamps(cast: Shadow, shapes: Sequence[np.ndarray]) -> Shadow | None:
    """The shadow of those lamps alone that cast most of what photos show of it into marks [H, W, S] on its grounds, and
    of the sky: whoever marks a shadow sees no more of it."""
    occluder, grounds = cast.occluder, cast.grounds
    assert occluder is not None

    def meant(lamp: Light) -> bool:
        taken = [t.mean(-1) * g.known for t, g in zip(_taken(occluder, [lamp], grounds, 1), grounds)]
        within = sum(float((t * shape[..., 0]).sum()) for t, shape in zip(taken, shapes))
        return within > MOSTLY * sum(float(t.sum()) for t in taken)

    lights = tuple(light for light in cast.lights if math.isinf(light.softness) or meant(light))
    if all(math.isinf(light.softness) for light in lights):
        return None
    taken = cast.taken if len(lights) == len(cast.lights) else _taken(occluder, lights, grounds, FINER)
    return replace(cast, lights=lights, taken=taken, confidence=1.0)


def _marked_on(ground: Ground, masks: Sequence[np.ndarray | None], witnesses: Sequence[Witness]) -> np.ndarray:
    """[H, W, S] float32: where most masks mark a ground, with edges of several softnesses."""
    points = ground.points().reshape(-1, 3)
    said = ask(witnesses, points, ground.tolerance)
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
    marked[scipy.ndimage.binary_propagation(hole & dilated(marked > 0, 2), mask=hole)] = 1.0
    return np.stack([cv2.GaussianBlur(marked, (0, 0), sigma) for sigma in EDGES], -1)


def find_contact(charts: Sequence[Chart]) -> Shadow | str:
    """The dark rims round the charts' holes; or why they count for none.

    Each channel by itself: in place of the light that it blocks, the object gives off some in its own colour. A texel
    beside the hole is compared with the nearest ones of its colour a little farther out. It is in the shadow
    if most of what lies as near to the hole as it does, and not far from it, is darker than there. Textures are dark by
    chance as well: as often where nothing stands, one width away.
    """
    found = [(c, *_rim(c)) for c in charts]
    rims = [(chart, taken, share) for chart, taken, share in found if taken.any()]
    if not rims:
        return "no dark rim found where it touches a surface"
    share = max(share for _, _, share in rims)
    most = max(float(np.percentile(taken[taken > 0], 90)) for _, taken, _ in rims)
    words = f"a dark rim round {share:.0%} of its outline, where up to {most:.0%} of the light is missing"
    shown = ((c.plane, c.camera, c.depth, c.there, c.image, c.known, c.hole, c.tolerance) for c, _, _ in rims)
    grounds = tuple(Ground(*of) for of in shown)
    return Shadow(grounds, None, (), tuple(taken for _, taken, _ in rims), share, 1 - 1 / CHANCE, words)


def _rim(chart: Chart) -> tuple[np.ndarray, float]:
    """[H, W, 3] float32 the share of light that is taken, and of what share of the outline; as far as it is more than
    what chance makes of that."""
    width = max(LEAST_WIDTH, WIDTH * float(np.sqrt(chart.hole.sum())))
    # what photos show beside the hole only where they may show the object as well counts as hole
    unseen = chart.hole | (chart.there & (chart.photos == 0))
    near = cv2.distanceTransform((~chart.hole).astype(np.uint8), cv2.DIST_L2, 5) <= width
    hole = chart.hole | (near & scipy.ndimage.binary_propagation(chart.hole, mask=unseen))
    far = cv2.distanceTransform((~hole).astype(np.uint8), cv2.DIST_L2, 5)
    logs = np.log(linear(chart.image) + DARK).astype(np.float32)
    hue = logs[..., [0, 2]] - logs[..., 1:2]
    shown = chart.there & (chart.photos > 0) & ~hole

    def darker(start: float) -> tuple[np.ndarray, np.ndarray]:
        """Texels within a width of a distance, and by how much they are brighter than those beyond, [H, W, 3]."""
        here = shown & (far > start) & (far <= start + width)
        beyond = shown & (far > start + width) & (far <= start + 2.5 * width)
        change = np.zeros(logs.shape, np.float32)
        if here.any() and beyond.sum() >= COMPARED:
            places = [np.column_stack([np.argwhere(on) / width, hue[on] / LIKE]) for on in (beyond, here)]
            nearest = cKDTree(places[0]).query(places[1], k=COMPARED)[1]
            change[here] = logs[here] - np.median(logs[beyond][nearest], axis=1)
        return here, change

    elsewhere, by_chance = darker(width)
    here, changes = darker(0.0)
    taken, most = np.zeros(logs.shape, np.float32), 0.0
    if not elsewhere.any():
        return taken, most
    outside = elsewhere & (far <= width + width / STRIPS)
    filled = np.zeros_like(hole)
    for channel in range(3):
        change, usual = changes[..., channel], by_chance[..., channel]
        limit = max(VISIBLE, 1.4826 * float(np.median(np.abs(usual[elsewhere]))))
        level, inside, share = np.zeros(far.shape, np.float32), hole, 0.0
        for k in range(STRIPS):
            strip = here & (far > k * width / STRIPS) & (far <= (k + 1) * width / STRIPS)
            dark, mean = _mostly_dark(strip, change, limit, width)
            inside = dark & dilated(inside, max(1, round(width / STRIPS)))
            level[inside] = mean[inside]
            if k == 0:
                share = float(inside.sum() / max(1, strip.sum()))
        chance = float(_mostly_dark(outside, usual, limit, width)[0].sum() / max(1, outside.sum()))
        if share > CHANCE * max(chance, SOME):
            # without steps, and beside the object so much that it is filled
            taken[..., channel] = 1 - np.exp(cv2.GaussianBlur(level, (0, 0), width / (2 * STRIPS)))
            filled |= hole & dilated(level < 0, round(width))
            most = max(most, share)
    taken[filled] = np.maximum(taken[filled], TOO_DARK)
    return taken, most


def _mostly_dark(strip: np.ndarray, change: np.ndarray, limit: float, width: float) -> tuple[np.ndarray, np.ndarray]:
    """[H, W] bool: parts of a strip, bool, most of whose surroundings along it are darker, by the change of their log
    luminance; and by how much."""
    side = (2 * round(width) + 1,) * 2

    def along(values: np.ndarray) -> np.ndarray:
        return cv2.boxFilter(values.astype(np.float32), -1, side, normalize=False, borderType=cv2.BORDER_CONSTANT)

    shaded = strip & (change < -limit)
    count = along(shaded)
    return strip & (count > 0.5 * along(strip)), along(np.where(shaded, change, 0)) / np.maximum(count, 1)
