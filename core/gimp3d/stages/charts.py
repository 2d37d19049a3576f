"""Charts: the surfaces that the object hid, each seen straight on by a camera that nobody stood at.

A chart's picture is made of all photos with the object left out; what no photo shows is its hole.
"""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Protocol

import cv2
import numpy as np
import scipy.ndimage

from ..box import Region, in_region
from ..camera import Camera
from ..compute.threads import parallel_map, run_ranges
from ..geometry import sees, surface_points, window_round
from ..schema import AtLeastOne
from ..solvers.thin_plate import thin_plate
from .footprint import shows_object
from .masks import ViewMasks
from .mosaic import mosaic
from .witness import Says, Textures, Witness, ask, meet_range, pack

VOTERS = 4.0  # px, σ of the neighbourhood that says whether the surface is there
SINKS = 0.01  # diagonals by which splats are drawn behind their surface at most
TELLING = 100  # texels that tell how depths scatter
CHART = "chart"  # split of their cameras
PARALLEL = 0.9  # cosine of two planes' normals above which they do not bound each other
UNLIKE = 3.0  # times what photos of the surface differ by, from which they show different things
LEAST_SPREAD = 6.0  # grey levels of texture that photos may always differ by
MIXED = 2  # texels round the object whose pixels show some of it
SOFT = 8  # texels round a hole that may show some of the object
LEVELS = (4, 2, 1)  # by which pictures are shrunk in which a plane is settled
POINTS = 96  # along a side, at which photos are compared at the finest level
SWEEP = 25  # offsets of a plane that are tried
TRIED = 3  # planes of the coarsest level that are followed up
STEP = 0.01  # the first of a pattern search
MEETING = 0.25  # share of what photos show of a chart that may lie behind another one which bounds it


def chart_number(reference: str | None) -> int | None:
    """N of the reference chart:N, counted from 1; None for a view's ID."""
    found = re.fullmatch(rf"{CHART}:(\d+)", reference or "")
    return int(found[1]) if found else None


@dataclass(frozen=True)
class ChartSettings:
    """How surfaces are found. Lengths in diagonals of the region's boxes unless said otherwise."""

    tolerance: float = 0.05  # relative z by which a view's surface must be nearer to hide a point
    ring: int = 24  # px round the object from which surface is gathered
    hidden: float = 0.15  # share of the views by which the object hides a point of surface that tells of what it hid
    inlier: float = 0.03  # distance up to which such a point lies on a plane
    least: float = 0.1  # share of the points that a plane must hold
    most: int = 4  # planes that are tried: a floor, two walls, and one that rough depths make up
    search: float = 0.12  # how far photos may move a plane along its normal, to begin with
    tilt: float = 0.2  # slope by which they may tilt it, to begin with
    precise: float = 1e-4  # to what it is settled
    rival: float = 1.1  # how much better photos must agree on a plane of its own than on a better one, for its points
    relief: float = 0.9  # share of what photos disagree on, on the plane, that a relief may leave
    sunk: float = 0.97  # share of the photos' agreement that a plane keeps where it is laid onto the drawn surface
    height: float = 0.25  # of a relief at most; what is higher stands on the surface
    largest: AtLeastOne = 900  # px, side of a chart at most


@dataclass(frozen=True)
class Plane:
    """A plane with axes; all [3], scene coordinates."""

    origin: np.ndarray  # the region's foot on it
    right: np.ndarray
    down: np.ndarray
    normal: np.ndarray  # unit, towards the cameras

    @classmethod
    def make(cls, point: np.ndarray, normal: np.ndarray, region: Region) -> Plane:
        """Through a point; the axes follow the box whose edges lie nearest to the plane."""
        centre = np.mean([box.center for box in region], axis=0)
        edges = region[0].axes.T
        along = edges - np.outer(edges @ normal, normal)
        right = along[int(np.argmax(np.linalg.norm(along, axis=1)))]
        right = right / np.linalg.norm(right)
        return cls(centre - normal * ((centre - point) @ normal), right, np.cross(right, normal) * -1, normal)

    def points(self, x: np.ndarray, y: np.ndarray, height: np.ndarray | float = 0.0) -> np.ndarray:
        """Scene coordinates [..., 3] of places on the plane, or above it."""
        h = np.broadcast_to(height, np.shape(x))
        return self.origin + x[..., None] * self.right + y[..., None] * self.down + h[..., None] * self.normal

    def local(self, points: np.ndarray) -> np.ndarray:
        """[N, 3]: x, y and height of points."""
        return (points - self.origin) @ np.stack([self.right, self.down, self.normal], axis=1)

    def tilted(self, offset: float, slope_x: float, slope_y: float) -> Plane:
        """Moved along the normal and tilted about the origin."""
        normal = self.normal - slope_x * self.right - slope_y * self.down
        normal /= np.linalg.norm(normal)
        right = self.right - normal * (self.right @ normal)
        right /= np.linalg.norm(right)
        return Plane(self.origin + offset * self.normal, right, np.cross(normal, right), normal)


@dataclass(frozen=True)
class Chart:
    """A surface seen straight on; arrays [H, W] of its camera."""

    camera: Camera
    plane: Plane
    kind: str  # plane | relief
    depth: np.ndarray  # float32 z of the completed surface
    there: np.ndarray  # bool, the surface is there: beyond its edges, what lies behind it shows
    image: np.ndarray  # [H, W, 3] uint8, from photos; 0 where none shows it
    photos: np.ndarray  # uint16, how many show it
    known: np.ndarray  # bool, photos show it, and much the same
    hole: np.ndarray  # bool, the object hides it in some photos, and none shows it, or they show its rests
    below: np.ndarray  # bool, known only from what the object's rough mask covers
    rests: np.ndarray  # bool, part of the hole: photos show the object there, though its mask does not cover it in all
    agreement: float  # of the photos round the hole, see Textures
    noise: float  # median distance of the views' drawn surfaces from it, scene units
    scatter: float  # relative z by which the views' drawn surfaces scatter about it
    tolerance: float  # the same, but never very small: within it a drawn surface is this one
    reason: str


@dataclass(frozen=True)
class _Round:
    """Surface that the views show round the object."""

    points: np.ndarray  # [N, 3]
    eyes: np.ndarray  # [N, 3] where the view stood that shows it
    weight: np.ndarray  # [N], how much it tells of what the object hid

    def take(self, rows: np.ndarray) -> _Round:
        return _Round(self.points[rows], self.eyes[rows], self.weight[rows])

    def on(self, plane: Plane) -> np.ndarray:
        """[N, 3]: where the same rays meet a plane."""
        rays = self.points - self.eyes
        along = rays @ plane.normal
        reach = ((plane.origin - self.eyes) @ plane.normal) / np.where(np.abs(along) > 1e-12, along, np.nan)
        return self.eyes + np.where(reach > 0, reach, np.nan)[:, None] * rays


def _surface_round(
    views: Sequence[ViewMasks], witnesses: Sequence[Witness], region: Region, settings: ChartSettings
) -> _Round:
    def of(view: ViewMasks, witness: Witness) -> tuple[np.ndarray, np.ndarray]:
        far = cv2.distanceTransform((~witness.hidden).astype(np.uint8), cv2.DIST_L2, 5)
        ring = (far > 2) & (far <= settings.ring) & (view.alpha_before > 0.9) & ~view.occluder
        window = (slice(0, view.camera.height), slice(0, view.camera.width))
        step = max(1, round(math.sqrt(ring.sum() * len(views) / 100_000)))
        points = surface_points(view.camera, np.where(ring, view.depth_before, 0), window, step)[2]
        return points, np.broadcast_to(view.camera.centre, points.shape)

    parts = parallel_map(lambda p: of(*p), list(zip(views, witnesses)))
    points, eyes = (np.concatenate([p[k] for p in parts]) for k in (0, 1))
    outside = ~in_region(region, points)
    points, eyes = points[outside], eyes[outside]
    said = ask(witnesses, points, settings.tolerance)
    share = (said == Says.HIDDEN).sum(0) / np.maximum((said != Says.NOTHING).sum(0), 1)
    near = share > settings.hidden
    return _Round(points[near], eyes[near], share[near] ** 2)


def find_planes(
    views: Sequence[ViewMasks],
    witnesses: Sequence[Witness],  # of the same views
    region: Region,
    settings: ChartSettings = ChartSettings(),
) -> tuple[Plane, ...]:
    """The planes nearest to the surfaces that run into what the object hid.

    Planes are sought among the points of surface round the object, each counting by the square of the share of views
    in which the object hides it: what is hidden often lies near what is hidden always. Each is then settled where the
    photos' textures agree best, since the depths of rough splats do not tell; and of two planes that could both be
    what some pixels show, photos choose as well.
    """
    diagonal = extent(region)
    around = _surface_round(views, witnesses, region, settings)
    levels = [Textures.make(witnesses, shrink=shrink) for shrink in LEVELS]
    textures = levels[-1]
    cameras = np.array([v.camera.centre for v in views])
    rng, left = np.random.default_rng(0), around
    found: list[tuple[float, Plane, _Round]] = []
    while len(found) < settings.most:
        candidate = largest_plane(left.points, left.weight, settings.inlier * diagonal, rng)
        if candidate is None or left.weight[candidate[2]].sum() < settings.least * around.weight.sum():
            break
        point, normal, on = candidate
        facing = normal if np.median((cameras - point) @ normal) > 0 else -normal
        plane = _settled(Plane.make(point, facing, region), diagonal, levels, settings)
        own = left.take(on)
        found.append((float(textures.agreement(own.on(plane))), plane, own))
        left = left.take(~on)
    found.sort(key=lambda f: -textures.agreement(around.on(f[1])))
    planes: list[Plane] = []
    for told, plane, own in found:
        if not planes or told >= settings.rival * max(textures.agreement(own.on(p)) for p in planes):
            planes.append(plane)
    return tuple(planes)


def draw_charts(
    planes: Sequence[Plane],
    views: Sequence[ViewMasks],
    witnesses: Sequence[Witness],  # of the same views
    region: Region,
    settings: ChartSettings = ChartSettings(),
    marked: Sequence[np.ndarray] = (),  # [H, W] bool, of the same views: to be filled whatever they show
) -> tuple[Chart, ...]:
    """What photos show of the surfaces at the planes; those without a hole are left out."""
    textures = Textures.make(witnesses)
    charts: list[Chart] = []
    for plane in planes:
        others = [p for p in planes if abs(p.normal @ plane.normal) <= PARALLEL]
        chart = _chart(plane, others, region, views, witnesses, marked, textures, settings)
        if chart is not None:
            charts.append(chart)
    bounded = [c for c in (_bounded(c, charts) for c in charts) if c.hole.any()]
    return tuple(replace(c, camera=replace(c.camera, id=f"chart:{k + 1}")) for k, c in enumerate(bounded))


def _bounded(chart: Chart, charts: Sequence[Chart]) -> Chart:
    """The chart, ended where it goes through another one that all photos show it before: a floor at a wall."""
    x, y = chart.camera.pixel_centres().reshape(-1, 2).T
    points = chart.camera.unproject(np.stack([x, y], -1), chart.depth.ravel().astype(np.float64))
    there = chart.there
    shown = there & (chart.photos > 0)
    for other in charts:
        if other is chart or abs(other.plane.normal @ chart.plane.normal) > PARALLEL:
            continue
        behind = (other.plane.local(points)[:, 2] < 0).reshape(there.shape)
        if shown.any() and behind[shown].mean() < MEETING:
            there = there & ~behind
    return replace(chart, there=there, hole=chart.hole & there)


def extent(region: Region) -> float:
    """The diagonal of the region's box, or of what holds all its boxes."""
    corners = np.concatenate([b.corners() for b in region])
    return float(np.linalg.norm(region[0].size if len(region) == 1 else np.ptp(corners, axis=0)))


def largest_plane(
    points: np.ndarray,  # [N, 3]
    weight: np.ndarray,  # [N]
    tolerance: float,
    rng: np.random.Generator,
    tries: int = 512,
) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """A point of the plane that holds most weight, its unit normal, and which points lie on it [N] bool.

    RANSAC (Fischler & Bolles 1981), points drawn by their weight; then least squares.
    """
    if len(points) < 3 or weight.sum() <= 0:
        return None
    chance = weight / weight.sum()
    drawn = points[rng.choice(len(points), (tries, 3), p=chance)]
    normals = np.cross(drawn[:, 1] - drawn[:, 0], drawn[:, 2] - drawn[:, 0])
    length = np.linalg.norm(normals, axis=1)
    proper = length > 1e-12
    if not proper.any():
        return None
    normals, origins = normals[proper] / length[proper, None], drawn[proper, 0]
    judges = points[rng.choice(len(points), min(len(points), 4000), p=chance)]
    votes = (np.abs(judges @ normals.T - (normals * origins).sum(1)) < tolerance).sum(0)
    normal, point = normals[votes.argmax()], origins[votes.argmax()]
    for _ in range(5):
        on = np.abs((points - point) @ normal) < tolerance
        w = weight[on]
        if len(w) < 3:
            return None
        point = (points[on] * w[:, None]).sum(0) / w.sum()
        normal = np.linalg.svd((points[on] - point) * np.sqrt(w)[:, None], full_matrices=False)[2][2]
    return point, normal, np.abs((points - point) @ normal) < tolerance


def _grid(half: float, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Places on a square, [count, count] each."""
    side = ((np.arange(count) + 0.5) / count * 2 - 1) * half
    x, y = np.meshgrid(side, side)
    return x, y


def _settled(plane: Plane, half: float, levels: Sequence[Textures], settings: ChartSettings) -> Plane:
    """The plane where photos agree best (plane sweep, then a pattern search with tilts: Hooke 1961), coarse to fine.

    Coarse pictures are matched from far off, fine ones precisely. What is best in coarse ones may be a compromise of
    several surfaces: the fine level also starts from a sweep of its own.
    """
    sweep = np.linspace(-1, 1, SWEEP) * settings.search
    tilts = (-settings.tilt, 0.0, settings.tilt)
    starts = [np.array(at) for at in itertools.product(sweep[::2], tilts, tilts)]
    for level, textures in enumerate(levels):
        finest = level == len(levels) - 1
        x, y = _grid(half, POINTS // 2 ** (len(levels) - 1 - level))

        agreement = partial(_agreement_at, plane, half, x, y, textures)
        if level == 0:
            starts = _best_of(agreement, starts, TRIED)
        if finest:
            starts = [*starts, *_best_of(agreement, [np.array([o, 0.0, 0.0]) for o in sweep], 1)]
        least = settings.precise if finest else STEP / 4
        found = [_climbed(agreement, start, STEP, least) for start in starts]
        starts = [max(found, key=lambda f: f[0])[1]]
    offset, slope_x, slope_y = starts[0]
    return plane.tilted(offset * half, slope_x, slope_y)


def _agreement_at(plane: Plane, half: float, x: np.ndarray, y: np.ndarray, textures: Textures, at: np.ndarray) -> float:
    """Of photos on the plane moved and tilted by `at` [3]: offset over `half`, two slopes."""
    height = at[0] * half + at[1] * x + at[2] * y
    return textures.agreement(plane.points(x, y, height).reshape(-1, 3))


def _best_of(agreement: Callable[[np.ndarray], float], starts: Sequence[np.ndarray], count: int) -> list[np.ndarray]:
    told = [agreement(s) for s in starts]
    return [starts[k] for k in np.argsort(told)[::-1][:count]]


def _climbed(
    agreement: Callable[[np.ndarray], float], start: np.ndarray, step: float, least: float
) -> tuple[float, np.ndarray]:
    """The greatest value near a start, and where it is: pattern search down to a step."""
    at, best = start, agreement(start)
    while step > least:
        moves = [at + step * sign * np.eye(3)[k] * (1 if k == 0 else 2) for k in range(3) for sign in (1, -1)]
        told = [agreement(m) for m in moves]
        k = int(np.argmax(told))
        if told[k] > best:
            at, best = moves[k], told[k]
        else:
            step /= 2
    return best, at


@dataclass(frozen=True)
class _Surface:
    """Where a chart's surface lies; arrays of its camera."""

    kind: str  # plane | relief
    depth: np.ndarray  # [H, W] float32 z
    points: np.ndarray  # [H, W, 3] scene coordinates
    agreement: float
    reason: str
    noise: float = np.nan  # see Chart

    @property
    def texels(self) -> np.ndarray:
        """[H·W, 3] scene coordinates."""
        return self.points.reshape(-1, 3)


@dataclass(frozen=True)
class _Shown:
    """What photos show of a surface, as far as the object's masks tell; arrays [H, W]."""

    there: np.ndarray  # bool
    image: np.ndarray  # [H, W, 3] uint8; in the hole it is what they show below the masks
    photos: np.ndarray  # uint16, how many show it
    hiding: np.ndarray  # uint16, in how many the object's mask covers it
    known: np.ndarray  # bool
    hole: np.ndarray  # bool
    alike_below: np.ndarray  # bool, they differ no more below the masks than elsewhere on the surface


def _chart(
    plane: Plane,
    others: Sequence[Plane],  # that it may meet
    region: Region,
    views: Sequence[ViewMasks],
    witnesses: Sequence[Witness],
    marked: Sequence[np.ndarray],
    textures: Textures,
    settings: ChartSettings,
) -> Chart | None:
    """The chart at a plane; None if the object hides nothing of it, or no view faces what it hides."""
    placed = _placed(plane, region, views, witnesses, settings)
    if placed is None:
        return None
    camera, away = placed
    surface = surface_at(camera, away, plane, region, views, witnesses, textures, settings)
    scatter = _scatter(surface.texels, others, witnesses, settings)
    tolerance = max(settings.tolerance, scatter)
    shown = _shown(surface.points, plane, witnesses, tolerance)
    below, rests = _told_by_colours(
        shown,
        _object_colours(plane, witnesses, tolerance),
        in_region(region, surface.texels).reshape(surface.depth.shape),
        _marked(surface.texels, witnesses, marked, surface.depth.shape),
    )
    hole = (shown.hole & ~below) | rests
    return Chart(
        camera,
        plane,
        surface.kind,
        surface.depth,
        shown.there,
        image=np.where(hole[..., None], np.uint8(0), shown.image),
        photos=np.where(below, shown.hiding, shown.photos),
        known=(shown.known | below) & ~hole,
        hole=hole,
        below=below,
        rests=rests,
        agreement=surface.agreement,
        noise=surface.noise,
        scatter=scatter,
        tolerance=tolerance,
        reason=surface.reason,
    )


def _placed(
    plane: Plane, region: Region, views: Sequence[ViewMasks], witnesses: Sequence[Witness], settings: ChartSettings
) -> tuple[Camera, float] | None:
    """The camera that faces what the object hides of a plane, and the plane's z there; None if there is none."""
    part = _hidden_part(plane, region, witnesses, settings)
    if part is None:
        return None
    centre, size = part
    place = plane.points(*centre[:, None])[0]
    texel = pixel_size(place, plane.normal, views)
    if not math.isfinite(texel):
        return None
    return facing_camera(plane, place, size, max(texel, float(size.max()) / settings.largest))


def facing_camera(plane: Plane, place: np.ndarray, size: np.ndarray, texel: float) -> tuple[Camera, float]:
    """The camera that faces a rectangle [2] of a plane round a place, with texels of one side, and the plane's z."""
    width, height = (int(n) for n in np.ceil(size / texel))
    away = 4 * float(np.linalg.norm(size))
    rotation = np.stack([plane.right, plane.down, -plane.normal])
    if np.linalg.det(rotation) < 0:
        rotation[1] *= -1
    viewmat = np.eye(4)
    viewmat[:3, :3], viewmat[:3, 3] = rotation, -rotation @ (place + away * plane.normal)
    return Camera("chart", width, height, away / texel, away / texel, width / 2, height / 2, viewmat, CHART), away


def _hidden_part(
    plane: Plane, region: Region, witnesses: Sequence[Witness], settings: ChartSettings, count: int = 200
) -> tuple[np.ndarray, np.ndarray] | None:
    """The rectangle of a plane that holds what the object hides and a margin to fill it from: centre, size [2] each.

    What is hidden is sought on a grid of `count` places along a side. None if nothing is.
    """
    diagonal = extent(region)
    x, y = _grid(2 * diagonal, count)
    said = ask(witnesses, plane.points(x, y).reshape(-1, 3), settings.tolerance).reshape(-1, count, count)
    hole = _unseen(said)
    labels, _ = scipy.ndimage.label(hole)
    near = np.hypot(x, y) < diagonal
    hole &= np.isin(labels, np.unique(labels[near & hole]))
    if not hole.any():
        return None
    cell = 4 * diagonal / count
    low, high = (np.array([x[hole], y[hole]]).min(1) - cell, np.array([x[hole], y[hole]]).max(1) + cell)
    size = high - low
    size = np.minimum(size + 2 * np.maximum(0.75 * size.max(), 0.15 * diagonal), 4 * diagonal)
    return (low + high) / 2, size


def pixel_size(place: np.ndarray, normal: np.ndarray, views: Sequence[ViewMasks]) -> float:
    """Side of a pixel on a surface, scene units, in the views that show the place best; infinite if none faces it."""
    density = []
    for v in views:
        _, z = v.camera.project(place[None])
        cosine = float(((v.camera.centre - place) @ normal) / np.linalg.norm(v.camera.centre - place))
        if z[0] > 0 and cosine > 0:
            density.append(v.camera.fx * v.camera.fy * cosine / z[0] ** 2)
    return 1 / math.sqrt(float(np.percentile(density, 90))) if density else math.inf


def surface_at(
    camera: Camera,
    away: float,  # z of the plane
    plane: Plane,
    region: Region,
    views: Sequence[ViewMasks],
    witnesses: Sequence[Witness],
    textures: Textures,
    settings: ChartSettings,
    enough: float = math.inf,  # points that tell where a few texels lie, where views show more
) -> _Surface:
    """A relief if photos agree clearly better on it than on the plane; else the plane, laid onto the drawn surface."""
    flat = np.full((camera.height, camera.width), away, np.float32)

    def at(offset: np.ndarray | float, kind: str) -> _Surface:
        depth = (flat + offset).astype(np.float32)
        points = camera.unproject(camera.pixel_centres(), depth.astype(np.float64))
        agreement = textures.agreement(points.reshape(-1, 3))
        return _Surface(kind, depth, points, agreement, f"photos agree by {agreement:.2f}")

    level = at(0.0, "plane")
    drawn = _drawn_surface(camera, flat, plane, views, witnesses, settings, extent(region), enough)
    if drawn is None:
        return level
    relief = at(drawn.completed, "relief")
    if 1 - relief.agreement < settings.relief * (1 - level.agreement):
        chosen = relief
    else:
        # splats are drawn a little behind the surface that they show: new ones must lie where they do
        near = drawn.offset[drawn.known & (np.abs(drawn.offset) < SINKS * extent(region))]
        sunk = at(float(np.median(near)) if len(near) > TELLING else 0.0, "plane")
        chosen = sunk if sunk.agreement >= settings.sunk * level.agreement else level
    return replace(
        chosen,
        reason=f"{level.reason} on the plane, {relief.agreement:.2f} on the relief",
        noise=float(np.median(np.abs(drawn.offset[drawn.known]))),
    )


def _shown(points: np.ndarray, plane: Plane, witnesses: Sequence[Witness], tolerance: float) -> _Shown:
    """What photos show at points [H, W, 3] of a surface."""
    said = ask(witnesses, points.reshape(-1, 3), tolerance).reshape(-1, *points.shape[:2])
    there = shown_there(said)
    hole = _unseen(said) & there
    image, spread = mosaic(points, plane.normal, witnesses, said)
    photos, hiding = ((said == s).sum(0).astype(np.uint16) for s in (Says.SEEN, Says.HIDDEN))
    limit = usual_spread(spread[there & (photos > 1) & ~hole])
    alike = spread <= limit
    # few photos claim to show what the object hides from most, and they do not agree: they show something before it
    hole |= there & (photos > 0) & ~alike & (hiding > photos)
    beneath = np.where(hole & (said == Says.HIDDEN), np.uint8(Says.SEEN), np.uint8(Says.NOTHING))
    below, spread_below = mosaic(points, plane.normal, witnesses, beneath)
    known = alike & there & (photos > 1) & ~hole
    image = np.where(hole[..., None], below, image)
    return _Shown(there, image, photos, hiding, known, hole, spread_below <= limit)


def _told_by_colours(
    shown: _Shown,
    object_colours: np.ndarray,  # [N, 3] uint8
    inside: np.ndarray,  # [H, W] bool, texels in the region
    marked: np.ndarray,  # [H, W] bool, texels that are filled whatever photos show
) -> tuple[np.ndarray, np.ndarray]:
    """Chart.below and Chart.rests, [H, W] bool: the object's mask is rough, too large here and too small there.

    Where photos agree below it, and on the surface's colours, they show the surface.
    """
    s = shown
    far = cv2.distanceTransform((~s.hole).astype(np.uint8), cv2.DIST_L2, 5)
    doubtful = s.hole | (s.there & (s.photos + s.hiding > 0) & (inside | (far < SOFT)))
    around = s.known & ~doubtful & (far < math.sqrt(s.hole.sum()))
    object_ = shows_object(s.image, doubtful, s.hole, object_colours, s.image[around])
    touched = cv2.dilate(object_.astype(np.uint8), np.ones((2 * MIXED + 1,) * 2, np.uint8)) > 0
    below = (s.hole & ~touched & (s.hiding > 1) & s.alike_below & ~marked).astype(np.uint8)
    below = cv2.morphologyEx(below, cv2.MORPH_OPEN, np.ones((SOFT + 1,) * 2, np.uint8)) > 0
    return below, object_ & (s.photos > 0)


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


def _marked(
    points: np.ndarray, witnesses: Sequence[Witness], marked: Sequence[np.ndarray], shape: tuple[int, ...]
) -> np.ndarray:
    """[H, W] bool: texels at points [H·W, 3] that the user marked in some view."""
    found = np.zeros(len(points), bool)
    for witness, mask in zip(witnesses, marked):
        if mask.any():
            found |= sees(witness.camera, mask.astype(np.float32), points, np.inf)
    return found.reshape(shape)


def _scatter(
    surface: np.ndarray,  # [N, 3]
    others: Sequence[Plane],  # that it may meet
    witnesses: Sequence[Witness],
    settings: ChartSettings,
) -> float:
    """How far, relative to z, the views' drawn surfaces scatter about this one: three standard deviations."""
    before = np.all([other.local(surface)[:, 2] > 0 for other in others], axis=0) if others else np.ones(1, bool)
    # what lies behind a wall says nothing of how the floor's depths scatter
    surface = surface[before] if before.sum() > TELLING else surface
    some = surface[:: max(1, len(surface) // 5000)]
    off = []
    for witness in witnesses:
        uv, z = witness.camera.project(some)
        with np.errstate(invalid="ignore"):
            framed = (z > 0) & (uv >= 0).all(1) & (uv < [witness.camera.width, witness.camera.height]).all(1)
        cols, rows = uv[framed].astype(int).T
        front = witness.depth[rows, cols]
        shown = ~witness.hidden[rows, cols] & (front > 0)
        off.append(front[shown] / z[framed][shown] - 1)
    all_ = np.abs(np.concatenate(off)) if off else np.zeros(0)
    spread = 3 * 1.4826 * float(np.median(all_)) if len(all_) else 0.0
    return min(spread, 4 * settings.tolerance)


def _unseen(said: np.ndarray) -> np.ndarray:
    """[H, W] bool: hidden by the object, rather than by other things, and shown by no photo."""
    seen = np.isin(said, (Says.SEEN, Says.BESIDE, Says.THROUGH)).sum(0)
    hidden, behind = ((said == s).sum(0) for s in (Says.HIDDEN, Says.BEHIND))
    return (seen == 0) & (hidden > behind)


def shown_there(said: np.ndarray) -> np.ndarray:
    """[H, W] bool: where the surface is: photos show it there rather than what lies behind it, or do so nearest."""
    seen = (said == Says.SEEN).sum(0) + (said == Says.BESIDE).sum(0)
    through = (said == Says.THROUGH).sum(0)
    known = seen + through > 0
    if not known.any():
        return np.ones(known.shape, bool)
    # single texels beside the object's foot err; edges of tables are long
    votes = cv2.GaussianBlur(np.sign(seen - through).astype(np.float32), (0, 0), VOTERS)
    rows, cols = scipy.ndimage.distance_transform_edt(~known, return_distances=False, return_indices=True)
    return (np.where(known, votes, 0) >= 0)[rows, cols]


@dataclass(frozen=True)
class _Drawn:
    """Where the views' depth maps have a chart's surface; z less that of the plane."""

    offset: np.ndarray  # [h, w] on a coarser grid, median over the views' points
    known: np.ndarray  # [h, w] bool
    completed: np.ndarray  # [H, W] float32, continued where there is none


def _drawn_surface(
    camera: Camera,
    flat: np.ndarray,  # [H, W] z of the plane
    plane: Plane,
    views: Sequence[ViewMasks],
    witnesses: Sequence[Witness],
    settings: ChartSettings,
    diagonal: float,
    enough: float,  # points of a cell
) -> _Drawn | None:
    """None where the views show too little of it."""
    cells = 2  # px of a chart that share their points
    h, w = -(-camera.height // cells), -(-camera.width // cells)

    ends = np.array([[0, 0], [camera.width, 0], [0, camera.height], [camera.width, camera.height]], float)
    corners = camera.unproject(ends, np.full(4, flat.max(), float))
    middle = corners.mean(0)

    def of(view: ViewMasks, witness: Witness) -> np.ndarray:
        z = np.where(witness.hidden | (view.alpha_before < 0.9) | view.occluder, 0, view.depth_before)
        uv, front = view.camera.project(corners)
        window = (slice(0, view.camera.height), slice(0, view.camera.width))
        if (front > 0).all():
            window = window_round(uv, view.camera, 8)
        away = float(view.camera.project(middle[None])[1][0])
        side = cells * flat.max() / camera.fx * view.camera.fx / away if away > 0 else 1  # of a cell, in its pixels
        points = surface_points(view.camera, z, window, max(1, int(side * math.sqrt(len(views) / enough))))[2]
        uv, z = camera.project(points)
        with np.errstate(invalid="ignore"):
            ok = (z > 0) & (uv >= 0).all(1) & (uv[:, 0] < camera.width) & (uv[:, 1] < camera.height)
            ok &= np.abs(plane.local(points)[:, 2]) < settings.height * diagonal
        col, row = (uv[ok] / cells).astype(int).T
        return np.stack([row * w + col, z[ok]], -1)

    found = np.concatenate(parallel_map(lambda p: of(*p), list(zip(views, witnesses))))
    order = np.lexsort((found[:, 1], found[:, 0]))
    key, z = found[order, 0].astype(int), found[order, 1]
    count = np.bincount(key, minlength=h * w)
    start = np.cumsum(count) - count
    there = count >= 3
    value = np.zeros(h * w)
    value[there] = z[start[there] + count[there] // 2]
    value, there = value.reshape(h, w), there.reshape(h, w)
    if there.sum() < 100:
        return None
    offset = np.where(there, value - flat.max(), 0)
    done = np.nan_to_num(thin_plate(offset, there.astype(float), np.ones((h, w), bool))).astype(np.float32)
    size = (camera.width, camera.height)
    return _Drawn(offset, there, cv2.resize(done, size, interpolation=cv2.INTER_LINEAR))


@dataclass(frozen=True)
class Hits:
    """What a view's rays meet of charts; arrays [H, W] of the view."""

    chart: np.ndarray  # int8, the chart met first; −1: none
    depth: np.ndarray  # float32, z there; 0: none
    rows: np.ndarray  # int32, the chart's texel
    cols: np.ndarray


class Facing(Protocol):
    """A surface seen straight on, as rays meet it; see Chart."""

    @property
    def camera(self) -> Camera: ...
    @property
    def depth(self) -> np.ndarray: ...
    @property
    def there(self) -> np.ndarray: ...


def first_hits(
    charts: Sequence[Facing],
    camera: Camera,
    pixels: np.ndarray,  # [H, W] bool, the rays that are asked for
) -> Hits:
    """Where rays meet the first of the charts: in a room seen from inside, that is the surface."""
    shape = pixels.shape
    hits = Hits(np.full(shape, -1, np.int8), np.zeros(shape, np.float32), *np.zeros((2, *shape), np.int32))
    rows, cols = np.nonzero(pixels)
    for k, chart in enumerate(charts):
        where = pack(camera), pack(chart.camera), chart.depth, chart.there
        run_ranges(meet_range, len(rows), rows, cols, *where, k, hits.chart, hits.depth, hits.rows, hits.cols)
    return hits
