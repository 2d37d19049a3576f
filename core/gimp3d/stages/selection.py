"""Which Gaussians go: the object in the user's boxes, not the floor that they cut into (docs/method.md)."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import Any

import cv2
import numpy as np

from ..box import Box, Region, in_region
from ..compute.threads import parallel_map
from ..gaussians import Gaussians
from ..geometry import dilated, surface_points
from ..raster import label_weights
from ..schema import Share
from .growth import LEAST_WEIGHT, Growth, find_growth
from .look import ViewBefore, box_window
from .surroundings import THICKNESS, FollowedSurface, follow_surface
from .witness import total_over

MOSTLY = 0.5  # share of a Gaussian's weight that decides: the majority
LARGE = 0.5  # longest standard deviation of a giant, as a share of the shortest edge of the boxes
SLACK = 1.0  # how far outside the boxes surface may still be the object's, cells of the followed surface
RIM = 2.0  # width of the ring round the object where its colours may have run, cells of the followed surface
LEAST_OBJECT = 0.002  # share of the region's outline that an object fills in some view to stand in a box
LEAST_CELLS = 4.0  # of the followed surface along a box; in coarser ones a Gaussian's centre decides
NEAR = 0.5  # how far from a box what only the removal reveals is looked for, as a share of the box's longest edge


class Fate(IntEnum):
    """What becomes of a Gaussian and why; from REMOVED_INSIDE on it goes."""

    OUTSIDE = 0  # stays: does not reach the region, or cannot be drawn
    KEPT_STRADDLING = 1  # stays: reaches in, but shows elsewhere
    KEPT_SURFACE = 2  # stays: inside, but seen unhidden on surface that runs on from outside, or a giant
    REMOVED_INSIDE = 3  # goes: inside
    REMOVED_STRADDLING = 4  # goes: reaches in and shows on the object
    REMOVED_REVEALED = 5  # goes: near, and only the removal would show it
    REMOVED_MASKED = 6  # goes: shows under the extra masks
    REMOVED_GROWN = 7  # goes: of the object, though the region cut it off


@dataclass(frozen=True)
class SelectionSettings:
    """What counts as the object."""

    by_centre: bool = False  # yes or no; the paper's rule, nothing but centres in the boxes, against what views show
    support: Share = 0.05  # share; photos must have shown so much of what the removal reveals: smears go, floor may too


@dataclass(frozen=True)
class Selection:
    """Every Gaussian's fate."""

    fates: np.ndarray  # [N] uint8, see Fate

    @property
    def removed(self) -> np.ndarray:
        """[N] bool."""
        return self.fates >= Fate.REMOVED_INSIDE

    @property
    def counts(self) -> dict[str, int]:
        return {f.name.lower(): self.count(f) for f in Fate if f != Fate.OUTSIDE}

    def count(self, fate: Fate) -> int:
        return int((self.fates == fate).sum())

    @property
    def words(self) -> str:
        """What went and what stayed, for people."""
        gone = [
            f"{self.count(Fate.REMOVED_INSIDE)} inside",
            f"{self.count(Fate.REMOVED_STRADDLING)} straddlers",
            f"{self.count(Fate.REMOVED_REVEALED)} that only the removal would show",
            f"{self.count(Fate.REMOVED_MASKED)} under extra masks",
            f"{self.count(Fate.REMOVED_GROWN)} that the box cut off",
        ]
        stay = [f"{self.count(Fate.KEPT_SURFACE)} of floor or wall", f"{self.count(Fate.KEPT_STRADDLING)} straddlers"]
        parts = [", ".join(p for p in part if not p.startswith("0 ")) or "none" for part in (gone, stay)]
        return f"{int(self.removed.sum())} Gaussians go ({parts[0]}), in the region stay {parts[1]}"


class Shows(IntEnum):
    """What a pixel shows of the scene with the object, for the selection."""

    NOTHING = 0  # that could be told: the object's rim, or the photo disagrees
    OBJECT = 1  # the first surface is the object
    CLEAR = 2  # it is something else
    MASKED = 3  # under the user's extra mask


Sightings = Sequence[tuple[ViewBefore, np.ndarray]]  # views and what their pixels show, [H, W] uint8, see Shows


def select_removed(gaussians: Gaussians, region: Region) -> np.ndarray:
    """[N] bool: Gaussians whose centre lies in the region. Unusable rows are never removed."""
    inside = in_region(region, gaussians.means.astype(np.float64))
    inside[inside] = gaussians.take(inside).usable
    return inside


def by_centre(inside: np.ndarray) -> Selection:
    """The paper's rule, of rows `inside` [N] bool (`select_removed`)."""
    return Selection(np.where(inside, Fate.REMOVED_INSIDE, Fate.OUTSIDE).astype(np.uint8))


def choose(
    gaussians: Gaussians,
    region: Region,
    before: Sequence[ViewBefore],
    support: float,  # see SelectionSettings
    grow: bool,  # what of the object the boxes cut off goes too
    over: Callable[[Callable[[Any], Any], Iterable[Any]], list[Any]],  # parallel_map, or one that tells how far it is
) -> tuple[Selection, list[ViewBefore], Growth | None]:
    """Which Gaussians go, by what views show of them; the views, what else the user named masked out; what was cut off.

    Where nothing stands out of the surface in a box, the surface itself is meant: a shadow, a picture on the floor.
    """
    depths = [(b.camera, b.depth) for b in before]
    surroundings = [follow_surface(box, region, depths) for box in region]
    centre = by_centre(select_removed(gaussians, region))
    cell = max(part.cell for part in surroundings)
    if all(box.size.max() < LEAST_CELLS * s.cell for box, s in zip(region, surroundings)):
        return centre, list(before), None  # pictures this small show no surface to follow
    reach = [replace(box, size=box.size + 2 * SLACK * cell) for box in region]
    shown = over(lambda b: shown_in(b, reach, surroundings), before)
    object_points = [surface_points(b.camera, b.depth * (s == Shows.OBJECT))[2] for b, s in zip(before, shown)]
    members = [np.stack([box.contains(points) for box in reach], axis=1) for points in object_points]
    stands = standing(members, [int(b.polygon.sum()) for b in before])
    objects = tuple(box for box, s in zip(region, stands) if s)
    named = tuple(box for box, s in zip(region, stands) if not s)

    def with_named(view: ViewBefore) -> ViewBefore:
        mask = surface_in(view, named) & ~surface_in(view, objects)
        return replace(view, extra=mask if view.extra is None else mask | view.extra)

    views = parallel_map(with_named, before) if named else list(before)
    if not objects:
        return centre, views, None
    sightings = list(zip(views, shown))
    for view, shows in sightings:
        if view.extra is not None:
            shows[view.extra] = Shows.MASKED
    reaches, surrounds = _near(gaussians, objects, NEAR)
    weights = weigh(gaussians, reaches | surrounds, sightings)
    selection = select(gaussians, objects, reaches, weights, [s for s, o in zip(surroundings, stands) if o])
    object_, clear, *_ = weights
    if support > 0:
        selection = without_revealed(gaussians, selection, surrounds, clear, sightings, support)
    of_object = selection.removed & (selection.fates != Fate.REMOVED_MASKED)
    growth = find_growth(gaussians, objects, of_object, ~selection.removed, object_ + clear, depths)
    fates = np.where(growth.rows & grow, np.uint8(Fate.REMOVED_GROWN), selection.fates)
    alone = select_removed(gaussians, named) & ~in_region(objects, gaussians.means.astype(np.float64))
    growth = replace(growth, region=growth.region + named, taken=grow and growth.box is not None)
    return Selection(np.where(alone, np.uint8(Fate.REMOVED_INSIDE), fates)), views, growth


def surface_in(view: ViewBefore, region: Sequence[Box], surroundings: Sequence[FollowedSurface] = ()) -> np.ndarray:
    """[H, W] bool: pixels whose first surface lies in the region and is not the surroundings'."""
    found = np.zeros(view.depth.shape, bool)
    for box in region:
        rows, cols, points = surface_points(view.camera, view.depth, box_window(box, view.camera))
        inside = np.flatnonzero(box.contains(points))
        for part in surroundings:
            inside = inside[part.distance(points[inside]) > THICKNESS * part.cell]
        found[rows[inside], cols[inside]] = True
    return found


def shown_in(view: ViewBefore, region: Sequence[Box], surroundings: Sequence[FollowedSurface]) -> np.ndarray:
    """[H, W] uint8, see Shows: what a view shows, but for its extra mask; the object stands in the region.

    In a ring round it the colours of splats that stand where it meets the floor run together.
    """
    shows = np.full(view.depth.shape, Shows.CLEAR, np.uint8)
    found = surface_in(view, region, surroundings).astype(np.uint8)
    object_ = cv2.morphologyEx(found, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8)) > 0
    if object_.any():
        rim = RIM * max(part.cell for part in surroundings) / float(np.median(view.depth[object_]))
        shows[dilated(object_, max(1, round(view.camera.fx * rim)))] = Shows.NOTHING
    if view.agrees is not None:
        shows[view.window][~view.agrees] = Shows.NOTHING
    shows[object_] = Shows.OBJECT
    return shows


def standing(members: Sequence[np.ndarray], outlines: Sequence[int]) -> list[bool]:
    """Which boxes something stands in: greedily those that hold most of it, as long as they add enough in some view to
    `outlines`, the region's pixels; `members` [M, B] bool of each view: in which boxes its pixels of the object lie.

    A box round a shadow also holds the object's foot; that is the object's box's already.
    """
    found = [False] * members[0].shape[1]
    left = list(members)
    while True:
        counts = np.array([m.sum(0) for m in left])
        enough = (counts > LEAST_OBJECT * np.array(outlines)[:, None]).any(0)
        if not enough.any():
            return found
        best = int(np.argmax(np.where(enough, counts.sum(0), -1)))
        found[best] = True
        left = [m[~m[:, best]] for m in left]


def weigh(gaussians: Gaussians, near: np.ndarray, sightings: Sightings) -> np.ndarray:
    """[4, N]: each Gaussian's blend weight summed over pixels and views, with the object in place: on the object, on
    what is clear of it – both whole for the rows `near` [N] bool only –, and, in the views that have an extra mask,
    under it and beside it.
    """

    def of(sighting: tuple[ViewBefore, np.ndarray]) -> np.ndarray:
        view, shows = sighting
        rows = near if view.extra is None else None
        object_, clear, masked = label_weights(gaussians, view.camera, shows, Shows.MASKED, rows)
        unmasked = np.zeros_like(clear) if view.extra is None else object_ + clear
        return np.stack([object_, clear, masked, unmasked])

    return total_over(sightings, of, (4, len(gaussians)))


def select(
    gaussians: Gaussians,
    region: Region,
    reaches: np.ndarray,  # [N] bool, see _near
    weights: np.ndarray,  # [4, N], see weigh
    surroundings: Sequence[FollowedSurface],
) -> Selection:
    """Every Gaussian's fate from where it lies and where it shows.

    Inside, it goes unless it shows mostly elsewhere and is surface that runs on from outside, or a giant of the
    background. What else reaches in goes if it shows mostly on the object: neither a halo is left nor a black hole
    opened.
    """
    object_, clear, masked, unmasked = weights
    on_object = object_ > MOSTLY * (object_ + clear)
    visible = object_ + clear > LEAST_WEIGHT
    centre, usable = select_removed(gaussians, region), gaussians.usable
    fates = np.zeros(len(gaussians), np.uint8)
    astride = reaches & usable & ~centre
    fates[astride] = np.where((visible & on_object)[astride], Fate.REMOVED_STRADDLING, Fate.KEPT_STRADDLING)
    fates[centre] = Fate.REMOVED_INSIDE
    elsewhere = np.flatnonzero(centre & visible & ~on_object)
    stays = gaussians.scales[elsewhere].max(1) > LARGE * min(box.size.min() for box in region)
    for part in surroundings:
        stays |= np.isfinite(part.distance(gaussians.means[elsewhere].astype(np.float64)))
    fates[elsewhere[stays]] = Fate.KEPT_SURFACE
    under_masks = masked > np.maximum(LEAST_WEIGHT, MOSTLY * (masked + unmasked))
    fates[under_masks & usable & (fates < Fate.REMOVED_INSIDE)] = Fate.REMOVED_MASKED
    return Selection(fates)


def without_revealed(
    gaussians: Gaussians,
    selection: Selection,
    near: np.ndarray,  # [N] bool, so near a box that a smear of the object may reach it
    clear: np.ndarray,  # [N] the weight on what views showed unhidden, see weigh
    sightings: Sightings,
    support: float,  # see SelectionSettings
) -> Selection:
    """Remove what the removal reveals near the region and no photo vouches for (docs/method.md).

    Trainers leave smears of the object's colour and haze under and behind it, where no photo ever saw them. Without
    this rule 21 to 63 of them stay in tiles_mug, desk, rocks and real_bed, which `clear_air` does not find either.
    """
    stays = np.flatnonzero(~selection.removed)
    kept = gaussians.take(stays)

    def of(sighting: tuple[ViewBefore, np.ndarray]) -> np.ndarray:
        view, shows = sighting
        return label_weights(kept, view.camera, shows == Shows.OBJECT, 1, near[stays])[0]

    revealed = total_over(sightings, of, (len(kept),))  # weight where the object was, without it
    fates = selection.fates.copy()
    fates[stays[near[stays] & (revealed > LEAST_WEIGHT) & (clear[stays] < support * revealed)]] = Fate.REMOVED_REVEALED
    return Selection(fates)


def near_region(gaussians: Gaussians, region: Region, near: float) -> np.ndarray:
    """[N] bool: within three standard deviations of a box, or the centre within so many of the box's longest edge."""
    return np.any(_near(gaussians, region, near), axis=0)


def _near(gaussians: Gaussians, region: Region, near: float) -> tuple[np.ndarray, np.ndarray]:
    """[N] bool both: which reach a box, and whose centres lie in or near one, see near_region."""
    longest = gaussians.scales.max(1)
    reaches, surrounds = np.zeros((2, len(gaussians)), bool)
    for box in region:
        away = np.abs((gaussians.means - box.center) @ box.axes)
        surrounds |= (away < box.size / 2 + near * box.size.max()).all(1)
        with np.errstate(over="ignore", invalid="ignore"):
            reaches |= (np.maximum(away - box.size / 2, 0) ** 2).sum(1) <= (3 * longest) ** 2
    return reaches, surrounds
