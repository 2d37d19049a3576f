"""Charts: the surfaces that the object hid, each seen straight on by a camera that nobody stood at.

A chart's picture is made of all photos with the object left out; what no photo shows is its hole.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import scipy.ndimage

from ...box import Region, in_region
from ...compute.threads import parallel_map
from ...geometry import blurred, dilated, framed, specks
from ...solvers.kriging import carried
from ..witness import Says, Textures, Witness, ask, mosaic
from .find import MOST_SCATTER, TOLERANCE, ChartSettings, depth_scatter
from .find import find_planes as find_planes
from .lay import CHART as CHART
from .lay import (
    HEIGHT,
    TELLING,
    Laid,
    flat_surface,
    lay_surface,
    pixel_density,
    pixel_size,
    places_drawn,
)
from .plane import Facing, Plane, Surface, extent
from .plane import Hits as Hits
from .plane import first_hits as first_hits
from .plane import pictured as pictured

VOTERS = 4.0  # px, σ of the neighbourhood that says whether the surface is there
UNLIKE = 3.0  # times what photos of the surface differ by, from which they show different things
MISPLACED = 0.4  # share of a texture that they have in common by which they may differ besides, and be copied from
LEAST_SPREAD = 6.0  # grey levels of texture that photos may always differ by
MIXED = 2  # texels round the object whose pixels show some of it
GRAIN = 4.0  # grey levels, σ by which colours of one kind differ at least
LEAST_SHARE = 0.3  # of the object in a colour that shows it: its edges are mixed with the surface
SAMPLES = 128  # colours of each kind, squared, that the models of both are made of
SOFT = 8  # texels round a hole that may show some of the object
ALONG = 16.0  # texels, σ of the neighbourhood that says which of two close surfaces is there
CLEARLY = 0.9  # share of what photos differ by on one surface, below which the other one is there
MEETING = 0.25  # share of what photos show of a chart that may lie behind another one which bounds it
PLACES = 200  # along a side of four diagonals, at which what the object hides is sought
TRIMMED = np.linspace(0, 0.2, 21)  # shares of the hidden pixels, on each side, without which a chart is tried
MARGIN, LEAST_MARGIN = 0.75, 0.15  # of a hole's size, and diagonals: surface round it to fill it from


@dataclass(frozen=True)
class Chart(Facing, Laid):
    """A surface seen straight on, its object left out; arrays [H, W] of its camera."""

    photos: np.ndarray  # uint16, how many show it
    scatter: float  # relative z by which the views' drawn surfaces scatter about it

    @property
    def shown(self) -> np.ndarray:
        """[H, W] bool, where photos show it, whether they agree or not."""
        return (self.photos > 0) & ~self.hole


def chart_number(reference: str | None) -> int | None:
    """N of the reference chart:N, counted from 1; None for a view's ID."""
    found = re.fullmatch(rf"{CHART}:(\d+)", reference or "")
    return int(found[1]) if found else None


def lay_planes(
    planes: Sequence[Plane], witnesses: Sequence[Witness], region: Region, settings: ChartSettings = ChartSettings()
) -> tuple[Laid, ...]:
    """Where the surfaces at the planes lie; those of which the object hides nothing are left out.

    On a ball the plane lies below the surface where the object stands, out of sight: if that hides nothing of any
    plane, it may of what is drawn over it.
    """
    textures, flats = Textures.make(witnesses), [_placed(p, region, witnesses, settings.largest) for p in planes]
    if not any(flats):
        flats = [_placed(p, region, witnesses, settings.largest, drawn=True) for p in planes]

    def laid(flat: Surface) -> Laid:
        others = tuple(p for p in planes if flat.plane.crosses(p))
        return lay_surface(flat, region, witnesses, textures, settings, others=others)

    return tuple(laid(flat) for flat in flats if flat is not None)


def draw_charts(laid: Sequence[Laid], witnesses: Sequence[Witness], region: Region) -> tuple[Chart, ...]:
    """What photos show of the surfaces at the planes; those without a hole are left out."""
    charts = _parted([_chart(one, region, witnesses) for one in laid], witnesses)
    bounded = [c for c in (_bounded(c, charts) for c in charts) if c.hole.any()]
    return tuple(replace(c, camera=replace(c.camera, id=f"chart:{k + 1}")) for k, c in enumerate(bounded))


def _bounded(chart: Chart, charts: Sequence[Chart]) -> Chart:
    """The chart, ended where it goes through another one that all photos show it before: a floor at a wall."""
    points, there = chart.points().reshape(-1, 3), chart.there
    shown = there & (chart.photos > 0)
    for other in charts:
        if chart.plane.crosses(other.plane):
            behind = (other.plane.local(points)[:, 2] < 0).reshape(there.shape)
            if shown.any() and behind[shown].mean() < MEETING:
                there = there & ~behind
    return replace(chart, there=there, hole=chart.hole & there)


def _parted(drawn: Sequence[tuple[Chart, np.ndarray]], witnesses: Sequence[Witness]) -> list[Chart]:
    """Charts that lie too close to each other for rough depths to tell which is drawn, such as a wall and a picture on
    it, each where photos agree on it; with every chart, see _chart, by how much they differ.

    The first is there, but where photos' textures differ clearly less on another; there that one hangs together with
    texels that led to it, or with what is undisputed.
    """
    there = [chart.there for chart, _ in drawn]
    for k, (later, spread) in enumerate(drawn):
        for j, (first, spread_on_first) in enumerate(drawn[:k]):
            if later.plane.crosses(first.plane):
                continue
            points = later.points()
            away = np.median([np.linalg.norm(w.camera.centre - later.plane.origin) for w in witnesses])
            gap = np.abs((points - first.plane.origin) @ first.plane.normal)
            disputed = gap < max(first.tolerance, later.tolerance) * away
            (rows, cols), inside = _texels_at(first, points)
            others = np.where(inside, spread_on_first[rows, cols], np.nan)
            own = there[k] & (_agree_better(spread, others, disputed) | ~disputed)
            there[k] = _hanging_together(own, _told(later) | ~disputed)
            (rows, cols), inside = _texels_at(later, first.points())
            there[j] = there[j] & ~(inside & (there[k] & disputed)[rows, cols])
    return [replace(c, there=t, known=c.known & t, hole=c.hole & t) for (c, _), t in zip(drawn, there)]


def _texels_at(chart: Chart, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns, [2, H, W], of a chart over or under which points [H, W, 3] lie, and [H, W] bool, where any."""
    index, rows, cols, _ = framed(chart.camera, points.reshape(-1, 3))
    found, inside = np.zeros((2, points[..., 0].size), int), np.zeros(points[..., 0].size, bool)
    found[:, index], inside[index] = (rows, cols), True
    return found.reshape(2, *points.shape[:2]), inside.reshape(points.shape[:2])


def _agree_better(spread: np.ndarray, others: np.ndarray, disputed: np.ndarray) -> np.ndarray:
    """[H, W] bool: where photos' textures differ clearly less than on the other surface, see _Shown.spread; what no
    photos tell is as what is round it."""
    told = disputed & np.isfinite(spread) & np.isfinite(others)
    if not told.any():
        return told
    own, other = (cv2.GaussianBlur(np.where(told, s, 0).astype(np.float32), (0, 0), ALONG) for s in (spread, others))
    votes = np.sign(CLEARLY * other - own)
    return carried(votes[..., None].repeat(3, -1), told)[..., 0] > 0


@dataclass(frozen=True)
class _Shown:
    """What photos show of a surface, as far as the object's masks tell; arrays [H, W]."""

    there: np.ndarray  # bool
    image: np.ndarray  # [H, W, 3] uint8; in the hole it is what they show of the object
    photos: np.ndarray  # uint16, how many show it
    hiding: np.ndarray  # uint16, in how many the object's mask covers it
    known: np.ndarray  # bool
    alike: np.ndarray  # bool, known without allowing for misplaced texture
    hole: np.ndarray  # bool
    spread: np.ndarray  # float32, grey levels by which photos' textures differ; NaN where fewer than two show it


def _chart(laid: Laid, region: Region, witnesses: Sequence[Witness]) -> tuple[Chart, np.ndarray]:
    """The chart, and by how much photos' textures differ, [H, W]; NaN where fewer than two show it."""
    points, scatter = laid.points(), scatter_about(laid, laid.others, witnesses)
    tolerance = max(TOLERANCE, scatter)
    shown = _shown(points, laid.plane, witnesses, tolerance, _told(laid))
    colours = _object_colours(laid.plane, witnesses, tolerance)
    inside = in_region(region, points.reshape(-1, 3)).reshape(laid.depth.shape)
    rests, foreign = _told_by_colours(shown, colours, inside)
    hole = shown.hole | rests
    erred = specks(hole)  # photos err: what they show hangs together
    erred &= (hole & ~erred).any()  # all of it may be as small, of a thin rod
    image = np.where(erred[..., None], blurred(shown.image, ~hole, 1.0), shown.image).astype(np.uint8)
    hole &= ~erred
    chart = Chart(
        **vars(laid),
        there=shown.there,
        image=np.where(hole[..., None], np.uint8(0), image),
        known=shown.known & ~hole & ~erred & ~foreign,
        hole=hole,
        photos=shown.photos,
        scatter=scatter,
        tolerance=tolerance,
    )
    return chart, shown.spread


def _placed(
    plane: Plane, region: Region, witnesses: Sequence[Witness], largest: float, drawn: bool = False
) -> Surface | None:
    """What the object hides of a plane and a margin to fill it from, at most `largest` texels wide and high; `drawn`:
    of the surface that views draw over it.

    None if the object hides nothing of it, or no view faces what it hides. What few pixels of the views look at, such
    as a plane's far end, is left out rather than to show the rest with less detail than photos.
    """
    diagonal = extent(region)
    around = flat_surface(plane, plane.origin, np.full(2, 4 * diagonal), 4 * diagonal / PLACES)
    places = places_drawn(plane, 2 * diagonal, PLACES, witnesses, HEIGHT * diagonal) if drawn else around.points()
    x, y = np.moveaxis(plane.local(places)[..., :2], -1, 0)
    places = places.reshape(-1, 3)
    said = ask(witnesses, places, TOLERANCE)
    of_views = said.reshape(-1, *x.shape)
    hole = _unseen(of_views) & _hides_from_most(of_views) & _hanging_together(shown_there(of_views), _told(around))
    labels, _ = scipy.ndimage.label(hole)
    hole &= np.isin(labels, np.unique(labels[(np.hypot(x, y) < diagonal) & hole]))
    if not hole.any():
        return None
    there, cell = np.stack([x[hole], y[hole]], 1), 4 * diagonal / PLACES
    pixels = np.zeros(len(there))  # that the object hides
    for witness, hidden in zip(witnesses, said[:, hole.ravel()] == Says.HIDDEN):
        pixels += np.where(hidden, pixel_density(places[hole.ravel()], plane.normal, witness.camera), 0)
    best, found = 0.0, None
    for trimmed in TRIMMED:
        low, high = (_quantiles(there, pixels, q) for q in (trimmed, 1 - trimmed))
        shown = pixels[((there >= low) & (there <= high)).all(1)].sum()
        size = high - low + 2 * cell
        size = np.minimum(size + 2 * np.maximum(MARGIN * size.max(), LEAST_MARGIN * diagonal), 4 * diagonal)
        place = plane.points(*((low + high) / 2)[:, None])[0]
        pixel = pixel_size(place, plane.normal, witnesses)
        texel = max(pixel, float(size.max()) / largest)
        if pixel < math.inf and shown * pixel / texel > best:
            best, found = shown * pixel / texel, (place, size, texel)
        if pixel == texel < math.inf:
            break  # it is as fine as photos
    return flat_surface(plane, *found) if found else None


def _quantiles(there: np.ndarray, weight: np.ndarray, share: float) -> np.ndarray:
    """[2]: x and y of places [N, 2] below which a share of the weight [N] lies."""
    order = np.argsort(there, axis=0)
    below = np.cumsum(weight[order], axis=0) < share * weight.sum()
    k = np.minimum(below.sum(0), len(there) - 1)
    return there[order[k, [0, 1]], [0, 1]]


def _shown(
    points: np.ndarray, plane: Plane, witnesses: Sequence[Witness], tolerance: float, told: np.ndarray
) -> _Shown:
    """What photos show at points [H, W, 3] of a surface; it is what hangs together with texels that led to it [H, W]
    bool, and does not begin anew where it goes through another one."""
    said = ask(witnesses, points.reshape(-1, 3), tolerance).reshape(-1, *points.shape[:2])
    there = _hanging_together(shown_there(said), told)
    hole = _unseen(said) & there
    image, spread, loud = mosaic(points, plane.normal, witnesses, said)
    photos, hiding = ((said == s).sum(0).astype(np.uint16) for s in (Says.SEEN, Says.HIDDEN))
    limit = usual_spread(spread[there & (photos > 1) & ~hole])
    alike = spread <= limit
    # few photos claim to show what the object hides from most, and they do not agree: they show something before it
    hole |= there & (photos > 0) & ~alike & _hides_from_most(said)
    beneath = np.where(hole & (said == Says.HIDDEN), np.uint8(Says.SEEN), np.uint8(Says.NOTHING))
    several = there & (photos > 1) & ~hole
    known = several & (spread <= limit + MISPLACED * loud)
    image = np.where(hole[..., None], mosaic(points, plane.normal, witnesses, beneath)[0], image)
    spread = np.where(several, spread, np.float32(np.nan))
    return _Shown(there, image, photos, hiding, known, several & alike, hole, spread)


def _hides_from_most(said: np.ndarray) -> np.ndarray:
    """[H, W] bool: the object hides it in more photos than show it, and than have something else before it."""
    hiding, photos, behind = ((said == s).sum(0) for s in (Says.HIDDEN, Says.SEEN, Says.BEHIND))
    return hiding > np.maximum(photos, behind)


def _told_by_colours(s: _Shown, object_colours: np.ndarray, inside: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """[H, W] bool each: rests, which are hole though the object's mask, which is rough, does not cover them in all
    photos. And what looks like the object, though photos do not agree that it lies there: it stands before the surface.

    `object_colours` are [N, 3] uint8; texels [H, W] bool are `inside` the region.
    """
    far = cv2.distanceTransform((~s.hole).astype(np.uint8), cv2.DIST_L2, 5)
    doubtful = s.hole | (s.there & (s.photos + s.hiding > 0) & (inside | (far < SOFT)))
    around = s.alike & ~doubtful & (far < math.sqrt(s.hole.sum()))
    object_ = shows_object(s.image, doubtful, s.hole, object_colours, s.image[around])
    rests = object_ & s.alike  # photos would not agree on something else that stands there
    spots = scipy.ndimage.binary_opening(rests, np.ones((2, 2)))  # OpenCV's would move them by half a texel
    return (rests | dilated(spots, MIXED)) & (s.photos > 0), object_ & ~s.alike


def usual_spread(spread: np.ndarray) -> float:
    """By how much photos' textures may differ and still show the surface: else they show what stands on it.

    A quarter of what several photos show is taken for the surface itself.
    """
    return max(LEAST_SPREAD, UNLIKE * float(np.percentile(spread, 25))) if len(spread) else LEAST_SPREAD


def _object_colours(plane: Plane, witnesses: Sequence[Witness], tolerance: float) -> np.ndarray:
    """[N, 3] uint8: what photos show of the object where it is clearly nearer than the plane."""

    def of(witness: Witness) -> np.ndarray:
        c = witness.camera
        rays = c.unproject(c.pixel_centres(), np.ones(witness.hidden.shape)) - c.centre
        with np.errstate(divide="ignore"):
            z = ((plane.origin - c.centre) @ plane.normal) / (rays @ plane.normal)
        before = witness.depth < (1 - tolerance) * np.where(z > 0, z, np.inf)
        return witness.photo[witness.hidden & (witness.depth > 0) & before]

    return np.concatenate(parallel_map(of, witnesses))


def scatter_about(surface: Surface, others: Sequence[Plane], witnesses: Sequence[Witness]) -> float:
    """Relative z by which the views' drawn surfaces scatter about this one, before the others that it may meet.

    What lies behind those, such as a wall, says nothing of how a floor's depths scatter; and where most of it is
    another surface, only the texels that led to it do.
    """
    points = surface.points()
    texels = points.reshape(-1, 3)
    before = np.all([other.local(texels)[:, 2] > 0 for other in others], axis=0) if others else np.ones(1, bool)
    scatter = depth_scatter(texels[before] if before.sum() > TELLING else texels, witnesses)
    return depth_scatter(points[_told(surface)], witnesses) if scatter == MOST_SCATTER else scatter


def _hanging_together(there: np.ndarray, told: np.ndarray) -> np.ndarray:
    """[H, W] bool: the parts of a surface that texels which led to it lie on."""
    parts, _ = scipy.ndimage.label(there)
    return there & np.isin(parts, parts[told])


def _told(surface: Surface) -> np.ndarray:
    """[H, W] bool: texels at the pixels that led to the plane; all if they are few, or not known."""
    told = np.zeros(surface.depth.shape, bool)
    if surface.plane.told is not None:
        _, rows, cols, _ = framed(surface.camera, surface.plane.told[np.isfinite(surface.plane.told).all(1)])
        told[rows, cols] = True
    return told if told.sum() > TELLING else np.ones_like(told)


def _unseen(said: np.ndarray) -> np.ndarray:
    """[H, W] bool: hidden by the object in some photos, and shown by none."""
    seen = np.isin(said, (Says.SEEN, Says.BESIDE)).any(0) | (_through(said) > 0)
    return ~seen & (said == Says.HIDDEN).any(0)


def _through(said: np.ndarray) -> np.ndarray:
    """[H, W] in how many photos something behind it is seen: not one alone, where others have the object in the way,
    as its mask may have a gap."""
    count, hidden = ((said == s).sum(0) for s in (Says.THROUGH, Says.HIDDEN))
    return np.where((count == 1) & (hidden > 1), 0, count)


def shown_there(said: np.ndarray) -> np.ndarray:
    """[H, W] bool: where the surface is: photos show it there rather than what lies behind it, or do so round it."""
    seen = (said == Says.SEEN).sum(0) + (said == Says.BESIDE).sum(0)
    through = _through(said)
    known = seen + through > 0
    if not known.any():
        return np.ones(known.shape, bool)
    # single texels beside the object's foot err; edges of tables are long
    votes = cv2.GaussianBlur(np.sign(seen - through).astype(np.float32), (0, 0), VOTERS)
    return carried(votes[..., None].repeat(3, -1), known)[..., 0] >= 0


def shows_object(
    picture: np.ndarray,  # [H, W, 3] uint8
    doubtful: np.ndarray,  # [H, W] bool, texels that may show either; all others show the surface
    presumed: np.ndarray,  # [H, W] bool, those that show the object as far as is known without colours
    object_colours: np.ndarray,  # [N, 3] uint8
    surface_colours: np.ndarray,  # [M, 3] uint8
) -> np.ndarray:
    """[H, W] bool: doubtful texels that look like the object; the presumed ones where there is nothing to compare.

    Two Gaussian mixtures and a minimum cut along edges of the picture (GrabCut: Rother 2004). The models stay as they
    are learned from what is certain: in the doubtful texels either kind may be missing. The object's is of its colours
    mixed with the surface's, as its edges are.
    """
    if not doubtful.any() or not len(object_colours) or not len(surface_colours):
        return doubtful & presumed
    rng = np.random.default_rng(0)
    shown, surface = (
        c[rng.integers(0, len(c), (SAMPLES, SAMPLES))].astype(float) for c in (object_colours, surface_colours)
    )
    share = rng.uniform(LEAST_SHARE, 1, (SAMPLES, SAMPLES, 1))
    drawn = share * shown + (1 - share) * surface, surface
    # a colour without any spread would be a model that nothing else fits, however near
    certain = [np.clip(c + rng.normal(0, GRAIN, c.shape), 0, 255).astype(np.uint8) for c in drawn]
    labels = np.repeat(np.array([cv2.GC_FGD, cv2.GC_BGD], np.uint8), SAMPLES)[:, None].repeat(SAMPLES, 1)
    labels[[0, -1], [0, -1]] = cv2.GC_PR_FGD, cv2.GC_PR_BGD  # it refuses to work where nothing is in doubt
    models = np.zeros((2, 1, 65))
    cv2.setRNGSeed(0)
    cv2.grabCut(np.concatenate(certain), labels, None, models[1], models[0], 1, cv2.GC_INIT_WITH_MASK)
    labels = np.where(doubtful, np.uint8(cv2.GC_PR_FGD), np.uint8(cv2.GC_BGD))
    cv2.grabCut(np.ascontiguousarray(picture), labels, None, models[1], models[0], 1, cv2.GC_EVAL_FREEZE_MODEL)
    return labels == cv2.GC_PR_FGD
