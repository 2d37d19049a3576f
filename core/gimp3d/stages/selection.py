"""Which Gaussians go: the object in the user's boxes, not the floor that they cut into (docs/method.md)."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import Any

import cv2
import numpy as np
import scipy.ndimage
import scipy.sparse.csgraph
from scipy.spatial import cKDTree

from ..box import Box, Region, in_region
from ..camera import Camera
from ..compute.threads import parallel_map
from ..gaussians import SH_C0, Gaussians
from ..geometry import dilated, surface_points
from ..raster import label_weights
from ..schema import Share
from .look import ViewBefore, box_window
from .surroundings import THICKNESS, FollowedSurface, follow_surface
from .witness import total_over

MOSTLY = 0.5  # share of a Gaussian's weight that decides: the majority
LARGE = 0.5  # longest standard deviation of a giant, as a share of the shortest edge of the boxes
SLACK = 1.0  # how far outside the boxes surface may still be the object's, cells of the followed surface
RIM = 2.0  # width of the ring round the object where its colours may have run, cells of the followed surface
LEAST_OBJECT = 0.002  # share of the region's outline that an object fills in some view to stand in a box
LEAST_CELLS = 4.0  # of the followed surface along a box; in coarser ones a Gaussian's centre decides
NEAR = 0.5  # how far from a box its rest and what only the removal reveals may lie, as a share of its longest edge
LEAST_WEIGHT = 0.5  # blend weight, summed over pixels and views, up to which a Gaussian shows nothing: half a pixel
SMALL = 0.25  # longest standard deviation of a small Gaussian, as a share of the shortest edge of the boxes
TOUCH = 4.0  # centres so near touch, times the median distance of an object's Gaussian from its fifth nearest
COLOUR = 0.25  # largest difference of a channel between Gaussians that look alike, colours in [0, 1]
BINS = 12  # of each channel in the histograms of both their colours
LIKELY = 0.9  # probability by colour from which a Gaussian on the surface is the object's all the same
UNLIKELY = 0.1  # probability up to which one off the surface is something else
SHARE = 0.1  # of a part's Gaussians that the boxes must hold
LEAST = 10  # Gaussians of a piece that is worth proposing
GONE = "inside", "straddlers", "that only the removal would show", "under extra masks", "that the box cut off"


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
        return {f.name.lower(): int((self.fates == f).sum()) for f in Fate if f != Fate.OUTSIDE}

    @property
    def words(self) -> str:
        """What went and what stayed, for people."""
        straddling, surface, *gone = self.counts.values()
        told = zip(gone, GONE), zip((surface, straddling), ("of floor or wall", "straddlers"))
        parts = [", ".join(f"{count} {what}" for count, what in part if count) or "none" for part in told]
        return f"{int(self.removed.sum())} Gaussians go ({parts[0]}), in the region stay {parts[1]}"


@dataclass(frozen=True)
class Growth:
    """What the boxes cut off."""

    rows: np.ndarray  # [N] bool: the object's, but kept
    region: Region  # the boxes, one of them enlarged to hold these
    box: Box | None  # that one; None if nothing was cut
    taken: bool = False  # they go, and `region` counts
    endless: bool = False  # a part of what the boxes cut goes on too far to be the object's rest

    @property
    def words(self) -> str:
        """The proposal for people; empty if there is none."""
        if self.box is None or self.taken:
            larger = "the box cuts something larger than what it holds: nothing is proposed; is the box too small?"
            return larger if self.endless else ""
        size, centre = (", ".join(f"{v:.4g}" for v in values) for values in (self.box.size, self.box.center))
        return (
            f"the box cuts the object: {int(self.rows.sum())} Gaussians of it stay; "
            f"use --grow or a box of size {size} at {centre}"
        )


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
    growth = find_growth(gaussians, objects, selection, object_ + clear, depths)
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


def find_growth(
    gaussians: Gaussians,
    region: Region,  # boxes round the object
    selection: Selection,
    shown: np.ndarray,  # [N] blend weight summed over pixels and views, whole as far round the boxes as NEAR
    views: Sequence[tuple[Camera, np.ndarray]],  # (camera, z-depth [H, W] with the object, 0 = nothing)
) -> Growth:
    """Which kept Gaussians are the object's, though the boxes or the surface under it kept them.

    Those that touch and have about the same colour are one part, and the object's if the boxes hold a share of it, and
    it does not go on without end.
    """
    none = Growth(np.zeros(len(gaussians), bool), region, None)
    of_object = selection.removed & (selection.fates != Fate.REMOVED_MASKED)
    outer = tuple(replace(box, size=box.size + 2 * NEAR * box.size.max()) for box in region)
    longest = gaussians.scales.max(1)
    small = longest < SMALL * min(box.size.min() for box in region)
    there = gaussians.usable & (shown > LEAST_WEIGHT) & in_region(outer, gaussians.means.astype(np.float64))
    rows = np.flatnonzero(there & (of_object | (small & ~selection.removed)))
    points, object_ = gaussians.means[rows].astype(np.float64), of_object[rows]
    if object_.sum() < LEAST or object_.all():
        return none
    on_surface = np.zeros(len(rows), bool)
    for box in outer:
        part = follow_surface(box, outer, views, coarse=True)  # a proposal needs no more
        on_surface |= part.distance(points) <= part.cell + longest[rows]
    colours = np.clip(0.5 + SH_C0 * gaussians.sh[rows, 0], 0, 1)
    like = _likelihood(colours, shown[rows], object_ & ~on_surface, ~object_ & on_surface)
    nodes = object_ | (like > np.where(on_surface, LIKELY, UNLIKELY))
    rows, points, object_ = rows[nodes], points[nodes], object_[nodes]
    colours, like = colours[nodes], like[nodes]
    tree = cKDTree(points[object_])
    spacing = float(np.median(tree.query(points[object_], k=min(6, tree.n))[0][:, -1]))
    radius = TOUCH * spacing
    pairs = cKDTree(points).query_pairs(radius, output_type="ndarray")
    pairs = pairs[(np.abs(colours[pairs[:, 0]] - colours[pairs[:, 1]]) < COLOUR).all(1)]
    parts = components(pairs, len(rows))
    held, cut = np.bincount(parts[object_], minlength=len(rows)), np.bincount(parts[~object_], minlength=len(rows))
    known = in_region([replace(box, size=np.maximum(box.size - 2 * spacing, 0)) for box in outer], points)
    endless = np.bincount(parts[~object_ & ~known], minlength=len(rows)) > 0
    ours = held >= np.maximum(1, SHARE * (held + cut))
    rest = (ours & ~endless)[parts] & ~object_
    pieces = components(pairs[rest[pairs].all(1)], len(rows))[rest]
    sizes, likes = np.bincount(pieces, minlength=1), np.bincount(pieces, like[rest], minlength=1)
    grown = np.flatnonzero(rest)[((sizes >= LEAST) & (likes > sizes / 2))[pieces]]
    outside = int((~in_region(region, points[grown])).sum())
    too_much = outside > object_.sum() + len(grown) - outside
    if not len(grown) or too_much:
        return replace(none, endless=bool(too_much or (ours & endless & (cut >= LEAST)).any()))
    none.rows[rows[grown]] = True
    holding = [_holding(box, points[grown], radius) for box in region]
    least = int(np.argmin([new.size.prod() - old.size.prod() for new, old in zip(holding, region)]))
    return Growth(none.rows, (*region[:least], holding[least], *region[least + 1 :]), holding[least])


def _likelihood(colours: np.ndarray, weights: np.ndarray, object_: np.ndarray, surface: np.ndarray) -> np.ndarray:
    """[M]: the probability by colour [M, 3] in [0, 1] that a Gaussian is the object's, from smoothed histograms,
    weighted [M], of what is the object's for sure and what is mostly surface, [M] bool each.
    """
    index = np.minimum(colours * BINS, BINS - 1).astype(int) @ np.array([BINS * BINS, BINS, 1])

    def density(rows: np.ndarray) -> np.ndarray:
        counts = np.bincount(index[rows], weights[rows], BINS**3).reshape(BINS, BINS, BINS)
        return scipy.ndimage.gaussian_filter(counts / max(float(counts.sum()), 1e-9), 0.7).ravel()[index]

    of_object, of_surface = density(object_), density(surface)
    return of_object / np.maximum(of_object + of_surface, 1e-12)


def components(pairs: np.ndarray, count: int) -> np.ndarray:
    """[count]: the number of each node's connected component, of the graph with edges [E, 2]."""
    graph = scipy.sparse.coo_matrix((np.ones(len(pairs), bool), pairs.T), (count, count))
    return scipy.sparse.csgraph.connected_components(graph, directed=False)[1]


def _holding(box: Box, points: np.ndarray, margin: float) -> Box:
    """The box, its faces moved outwards to hold points and a margin round those that it did not hold."""
    local, half = (points - box.center) @ box.axes, box.size / 2
    low = np.where(local.min(0) < -half, local.min(0) - margin, -half)
    high = np.where(local.max(0) > half, local.max(0) + margin, half)
    return replace(box, center=box.center + box.axes @ ((low + high) / 2), size=high - low)
