"""How good a removal probably is, told without the truth.

Where the object was, a pixel's true colour is what photos, or a picture that was given, show of the surface there.
Where none does, all that is known is what the rim lets expect: its colours carried inwards, and how far apart they are
at such a distance. From both follows the squared error to be expected of whatever is drawn: a fill, mud, haze, rests of
the object, an open hole. The score compares it with the error of the surroundings before the removal.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, NamedTuple

import cv2
import numpy as np

from ..camera import Camera
from ..compute.threads import parallel_map
from ..gaussians import Gaussians
from ..geometry import SAME_DEPTH, colours_at, framed, sees
from ..raster import drawing, render
from ..solvers.kriging import foretell, variogram
from .charts import Chart, Hits
from .masks import ViewMasks
from .propagate import Reference
from .witness import Says, Witness, ask, spread

VIEWS = 8  # that are looked at, spread evenly
POINTS = 24_000  # pixels of the object in these views
RING = 24  # px round the object
EDGE = 3  # px next to the object that are mixed
SCATTER = 4.0  # median distances of the drawn surface from a chart, from which something is before the chart
UNLIKE = 24.0  # grey levels from which the object differs from what is behind it
USUAL_ERROR = 65.0  # squared grey levels by which scenes miss photos, where there are none (30 dB)
LEAST_ERROR = 1.0  # of 8-bit pictures
HALF = 9.0  # times the error of the surroundings that scores ½ when it is added: 10 dB worse
GOOD, FAIR = 2 / 3, 0.5  # scores
FINE = 2.0  # px, σ of the blur that leaves no detail
OTHER_DETAIL = "the fill has {:.1f} times the detail of its surroundings: paint one view, or try another seed"
SOUND = (  # figures of the verdict, between which values nothing is amiss, and words for what is
    ("open_share", 0, 0.02, "{:.0%} of the hole is open: add views from other sides, or take the preset best"),
    ("remains", 0, 0.05, "{:.0%} of the object's place still looks like it: enlarge the box until all of it is inside"),
    ("haze", 0, 0.05, "haze covers {:.0%} of what was behind the object: enlarge the box, or add one round the haze"),
    ("ring_fidelity", -0.5, math.inf, "the surroundings lost {:.1f} dB against the photos: make the box tighter"),
    ("sharpness", 0.5, 2, OTHER_DETAIL),
    ("agreement", 0.7, 1, "only {:.0%} of the object's place looks as photos show it: mark shadows and reflections"),
    ("invented", 0, 0.3, "no photo shows {:.0%} of the object's place: paint one view if the fill does not convince"),
)
Told = float | None  # None: nothing tells


@dataclass(frozen=True)
class Verdict:
    """What the removal is worth (docs/method.md, the verdict), and what its figures mean."""

    score: float  # 0 bad … 1 good
    open_share: Annotated[float, "share of the hole that stays open"]
    remains: Annotated[float, "share of the object's pixels that still look like it"]
    haze: Annotated[Told, "blend weight before the surface behind the object"]
    ring_fidelity: Annotated[Told, "dB that the surroundings gained or lost against photos"]
    sharpness: Annotated[Told, "detail of what was filled over that of its surroundings"]
    agreement: Annotated[Told, "share of the object's pixels that look as photos, or other views, show the place"]
    invented: Annotated[float, "share of the object's pixels that no photo and no picture shows"]
    expected_error: Annotated[float, "dB by which the object's pixels are probably worse than its surroundings were"]
    words: tuple[str, ...]


@dataclass(frozen=True)
class _Look:
    """A view of the removal; arrays [H, W], pictures [H, W, 3] float32 in grey levels, near the object only."""

    view: ViewMasks
    photo: np.ndarray
    ring: np.ndarray  # bool
    before: np.ndarray
    after: np.ndarray
    depth: np.ndarray  # z of what is drawn, 0 = nothing
    chart: np.ndarray  # z of the charts, 0 = none
    unsure: np.ndarray  # height by which the charts may be off, scene units
    haze: np.ndarray  # blend weight before the charts
    error: float  # mean squared error before the removal in as many pixels round the object as it has


class _Sample(NamedTuple):
    """Pixels of looks' every n-th row and column, [N]: the object's, and beside it those whose colours are told."""

    object: np.ndarray  # bool, of the object; the others lie beside it
    told: np.ndarray  # bool, by photos
    given: np.ndarray  # bool, by the given picture
    remains: np.ndarray  # bool, of the object, and drawn like it
    usual: np.ndarray  # squared error before the removal
    missed: np.ndarray  # squared error of what is drawn
    variance: np.ndarray  # of true colours about those that are expected
    points: np.ndarray  # [N, 3]
    drawn: np.ndarray  # [N, 3] float32, grey levels

    @property
    def unseen(self) -> np.ndarray:
        """Pixels of the object whose colours nothing tells."""
        return self.object & ~self.told & ~self.given


def judge(
    scene: Gaussians,  # with the object
    final: Gaussians,  # without it, filled
    views: Sequence[ViewMasks],  # as they were to be filled
    still_open: Sequence[np.ndarray],  # [H, W] bool each: what no reference reached
    photos: Mapping[str, np.ndarray],  # ID → [H, W, 3] uint8, with the object, at the splats' exposure
    photographed: Collection[str],  # IDs of those that are photos; others are drawn
    charts: Sequence[Chart],
    hits: Mapping[str, Hits],  # by ID
    given: Reference | None,  # that a picture was given for
) -> Verdict | None:
    """What a few views, drawn near the object, tell of a removal; None if no view shows the object."""
    asked = [v for v in views if v.camera.id in photographed] or list(views)
    witnesses = [_witness(v.camera, photos[v.camera.id], v.silhouette, v.depth_before) for v in asked]
    floats, unsure = _floating(final, charts, witnesses), [_height_doubt(c) for c in charts]
    showing = [v for v in asked if v.silhouette.any()]
    if not showing:
        return None

    def look(view: ViewMasks) -> _Look:
        photo = photos[view.camera.id].astype(np.float32)
        away = cv2.distanceTransform((~view.silhouette).astype(np.uint8), cv2.DIST_L2, 5)
        near, around = away <= RING, away > EDGE
        ring = near & around
        # as many pixels as the object has
        beside = around & (away <= np.sort(away[around])[: view.silhouette.sum()].max(initial=0))
        before, after = _drawn(scene, view.camera, ring | beside), _drawn(final, view.camera, near)
        error = _mean(_squared(before, photo)[beside])
        weights = drawing(final, view.camera, with_colour=False, pixels=near)
        depth, haze = weights.surface_depth()[0], weights.footprint(floats)
        chart, off = np.zeros((2, *near.shape), np.float32)
        if met := hits.get(view.camera.id):
            chart, off = met.depth, met.of(unsure)
        return _Look(view, photo, ring, before, after, depth, chart, off, haze, error)

    looks = parallel_map(look, spread(showing, VIEWS))
    total = sum(int(look.view.silhouette.sum()) for look in looks)
    step = max(1, round(math.sqrt(total / POINTS)))
    tolerance = max([c.tolerance for c in charts], default=SAME_DEPTH)
    parts = parallel_map(lambda look: _sampled(look, step, witnesses, tolerance, given), looks)
    open_share = sum(int(m.sum()) for m in still_open) / max(1, sum(int(v.target.sum()) for v in views))
    return _summed(looks, parts, open_share, bool(photographed), bool(charts))


def _summed(
    looks: Sequence[_Look], parts: Sequence[_Sample], open_share: float, with_photos: bool, with_charts: bool
) -> Verdict:
    sample = _Sample(*map(np.concatenate, zip(*parts)))
    error = max(LEAST_ERROR, float(np.mean([look.error for look in looks]))) if with_photos else USUAL_ERROR
    before = _mean(*(_squared(look.before, look.photo)[look.ring] for look in looks))
    after = _mean(*(_squared(look.after, look.photo)[look.ring] for look in looks))
    added, alike = max(0.0, _expected_error(sample) - error), _alike(looks, parts, sample)
    verdict = Verdict(
        score=1 / (1 + added / (HALF * error)),
        open_share=open_share,
        remains=int(sample.remains.sum()) / int(sample.object.sum()),
        haze=_mean(*(look.haze[look.view.silhouette] for look in looks)) if with_charts else None,
        ring_fidelity=10 * math.log10(max(before, LEAST_ERROR) / max(after, LEAST_ERROR)) if with_photos else None,
        sharpness=_sharpness(looks),
        agreement=float(alike.mean()) if with_photos and len(alike) else None,
        invented=int(sample.unseen.sum()) / int(sample.object.sum()),
        expected_error=10 * math.log10(1 + added / error),
        words=(),
    )
    return replace(verdict, words=_words(verdict))


def _expected_error(sample: _Sample) -> float:
    """The mean squared error to be expected of the object's pixels, grey levels²."""
    photo, picture, unseen = sample.object & sample.told, sample.object & sample.given, sample.unseen
    missed, variance = sample.missed, sample.variance
    # Where nothing shows a place, the truth differs from what is expected as texture does, however little the fill.
    errors = (
        _mean(missed[photo]),
        _mean(missed[picture]) + _mean(variance[picture]),
        max(_mean(missed[unseen]), _mean(variance[unseen])),
    )
    return float(np.average(errors, weights=[int(where.sum()) for where in (photo, picture, unseen)]))


def _alike(looks: Sequence[_Look], parts: Sequence[_Sample], sample: _Sample) -> np.ndarray:
    """[N] bool: pixels of the object that differ from photos, else from other views, as is usual round it."""
    usual = sample.usual[~sample.object]
    limit = max(LEAST_ERROR, float(np.percentile(usual, 95)) if len(usual) else 0.0)
    drawn = [
        _witness(look.view.camera, np.rint(look.after).astype(np.uint8), np.zeros(look.depth.shape, bool), look.depth)
        for look in looks
    ]
    found = [sample.missed[sample.object & sample.told] <= limit]
    for k, part in enumerate(parts):
        colours, seen = shown([*drawn[:k], *drawn[k + 1 :]], part.points[part.unseen])
        found.append((_squared(part.drawn[part.unseen], colours) <= limit)[seen])
    return np.concatenate(found)


def _witness(camera: Camera, picture: np.ndarray, hidden: np.ndarray, depth: np.ndarray) -> Witness:
    no = np.zeros_like(hidden)
    return Witness(camera, picture, hidden, no, no, depth)


def _squared(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """[h, w]: mean of the channels' squared differences."""
    return np.asarray(((a - b) ** 2).mean(-1))


def _mean(*parts: np.ndarray) -> float:
    """Of all numbers in the arrays; 0 of none."""
    all_ = np.concatenate(parts)
    return float(all_.mean(dtype=np.float64)) if len(all_) else 0.0


def _sharpness(looks: Sequence[_Look]) -> Told:
    """Median detail of what was filled, over that of the same surfaces round the object."""
    filled, beside = [], []
    for look in looks:
        grey = cv2.cvtColor(look.after, cv2.COLOR_RGB2GRAY)
        detail = np.abs(grey - cv2.GaussianBlur(grey, (0, 0), FINE))
        inner = cv2.erode(look.view.target.astype(np.uint8), np.ones((2 * EDGE - 1,) * 2, np.uint8)) > 0
        on_chart = (look.chart == 0) | (np.abs(look.depth - look.chart) < SAME_DEPTH * look.chart)
        filled.append(detail[inner])
        beside.append(detail[look.ring & on_chart & (look.depth > 0)])
    if not any(map(np.size, filled)) or not any(map(np.size, beside)):
        return None
    return float(np.median(np.concatenate(filled)) / max(1e-3, np.median(np.concatenate(beside))))


def _sampled(
    look: _Look, step: int, witnesses: Sequence[Witness], tolerance: float, given: Reference | None
) -> _Sample:
    thin, camera = np.s_[::step, ::step], look.view.camera
    object_ = look.view.silhouette[thin]
    ring, photo, after, depth, chart = (a[thin] for a in (look.ring, look.photo, look.after, look.depth, look.chart))
    others = [w for w in witnesses if w.camera.id != camera.id]
    centres = camera.pixel_centres()[thin]
    # charts are what was behind the object, unless photos show what is drawn before them
    standing = object_ & (depth > 0) & (depth < (1 - tolerance) * chart)
    standing[standing] = shown(others, camera.unproject(centres[standing], depth[standing].astype(np.float64)))[1]
    off_chart = (chart == 0) | standing | (ring & (np.abs(depth - chart) > tolerance * chart))
    surface = np.where(off_chart, depth, chart)
    points = camera.unproject(centres, surface.astype(np.float64))
    asked = (object_ | ring) & (surface > 0)
    told, by_picture = np.zeros((2, *asked.shape), bool)
    expected = photo.copy()
    colours, told[asked] = shown(others, points[asked], tolerance)
    expected[told] = colours[told[asked]]
    if given is not None:
        left = object_ & asked & ~told
        depth_given = np.where(given.target, given.depth, 0)
        by_picture[left] = sees(given.camera, depth_given, points[left], tolerance)
        expected[by_picture] = colours_at(given.image, given.camera.project(points[by_picture])[0])
    unknown = object_ & ~told & ~by_picture
    foretold, variance, lags = foretell(np.where(object_[..., None], expected, photo), ~unknown)
    expected[unknown] = foretold[unknown]
    if given is not None:
        here, there = points - camera.centre, points - given.camera.centre
        lengths = np.linalg.norm(here, axis=-1) * np.linalg.norm(there, axis=-1)
        sine = np.linalg.norm(np.cross(here, there), axis=-1) / np.maximum(lengths, 1e-12)
        # px by which this view may see the picture's pixels elsewhere, as the surface's height is not known
        shift = camera.fx * look.unsure[thin] * sine / np.maximum(surface, 1e-9)
        variance += by_picture * 2 * np.interp(shift / step, *lags)
    change, made = photo - expected, after - expected
    along = cv2.blur((made * change).sum(-1), (3, 3)) > 0.5 * cv2.blur((change**2).sum(-1), (3, 3))
    remains = object_ & along & (_squared(photo, expected) > UNLIKE**2)
    errors = (_squared(drawn, expected) for drawn in (look.before[thin], after))
    kept = object_ | (ring & told)
    maps = object_, told, by_picture, remains, *errors, variance, points, after
    return _Sample(*(m[kept] for m in maps))


def shown(
    witnesses: Sequence[Witness],
    points: np.ndarray,  # [N, 3]
    farther: float = SAME_DEPTH,  # relative z by which what a view shows may lie behind; before, it is SAME_DEPTH
) -> tuple[np.ndarray, np.ndarray]:
    """The median colour of the views that show a point [N, 3] float32, 0 of none; and whether any does [N]."""
    seen = (ask(witnesses, points, farther) == Says.SEEN) & (ask(witnesses, points, SAME_DEPTH) != Says.BEHIND)
    colours = np.full((len(witnesses), len(points), 3), np.nan, np.float32)
    for k, witness in enumerate(witnesses):
        colours[k, seen[k]] = colours_at(witness.photo, witness.camera.project(points[seen[k]])[0])
    told, median = seen.any(0), np.zeros((len(points), 3), np.float32)
    median[told] = np.nanmedian(colours[:, told], axis=0)
    return median, told


def _height_doubt(chart: Chart) -> np.ndarray:
    """[H, W] standard deviation of the surface's height, scene units: as drawn depths scatter, and where no photo
    shows a relief it may be higher or lower besides."""
    variance = np.full(chart.depth.shape, chart.noise**2)
    if chart.kind != "plane" and chart.known.any():
        away = cv2.distanceTransform((~chart.known).astype(np.uint8), cv2.DIST_L2, 5)
        lags = variogram(chart.depth[..., None], chart.known, float(away[chart.hole].max(initial=0)))
        variance += np.interp(away, *lags)
    return np.sqrt(variance).astype(np.float32)


def _floating(gaussians: Gaussians, charts: Sequence[Chart], witnesses: Sequence[Witness]) -> np.ndarray:
    """[N] bool: Gaussians before all charts that lie there, in the object's way and shown by no photo."""
    points = gaussians.means.astype(np.float64)
    before, other = np.zeros((2, len(points)), bool)
    for chart in charts:
        index, rows, cols, z = framed(chart.camera, points)
        there, nearer = chart.there[rows, cols], z < chart.depth[rows, cols] - SCATTER * chart.noise
        before[index] |= there & nearer
        other[index] |= there & ~nearer
    found = before & ~other & gaussians.usable
    said = ask(witnesses, points[found], max([c.tolerance for c in charts], default=SAME_DEPTH))
    found[found] = (said == Says.HIDDEN).any(0) & ~np.isin(said, (Says.SEEN, Says.BESIDE)).any(0)
    return found


def _drawn(gaussians: Gaussians, camera: Camera, pixels: np.ndarray) -> np.ndarray:
    """[H, W, 3] float32, grey levels."""
    rgb = render(gaussians, camera, passes=frozenset({"rgb"}), pixels=pixels).rgb
    return np.clip(255 * rgb, 0, 255).astype(np.float32)


def _words(v: Verdict) -> tuple[str, ...]:
    """What it comes to; then, of each thing that is amiss, how much, and what to do."""
    level = "good" if v.score >= GOOD else "fair" if v.score >= FAIR else "poor"
    times = 10 ** (v.expected_error / 20)
    figures = ((getattr(v, name), low, high, words) for name, low, high, words in SOUND)
    amiss = (words.format(abs(x)) for x, low, high, words in figures if x is not None and not low <= x <= high)
    return f"{level}: errors where the object was are probably {times:.1f} times those round it", *amiss
