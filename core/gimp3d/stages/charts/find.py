"""The planes that run into what the object hid, settled where photos agree on them, and where the surface at each lies.

Planes are sought among drawn depths. Their surfaces lie on them, or on the relief that the views draw over them.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from ...box import Region, in_region
from ...compute.threads import parallel_map
from ...geometry import framed, surface_points
from ...schema import AtLeastOne, Share
from ..witness import AGREEING, Says, Textures, Witness, ask
from .plane import Plane, extent, largest_plane

TOLERANCE = 0.05  # relative z by which a view's surface must be nearer to hide a point: rough scans scatter by 3 to 9 %
MIXED_RIM = 2.0  # px beside the object whose depths may be its own
RING = 24.0  # px round the object from which surface is gathered
GATHERED = 100_000  # points of surface at most, of all views
HIDDEN = 0.15  # share of the views by which the object hides a point of surface that tells of what it hid
INLIER = 0.03  # diagonals of the region up to which such a point lies on a plane
MOST = 4  # planes that are tried: a floor, two walls, and one that rough depths make up
LEVELS = (4, 2, 1)  # by which pictures are shrunk in which a plane is settled
POINTS = 96  # along a side, at which photos are compared at the finest level …
OWN = 4  # … and one for so many of these that led to the plane: more of them tilt it (two planes on real_bed)
SHARED = 2  # times that planes are settled again, each by its own pixels of photos
MADE_UP = 0.5  # agreement of photos on a plane, over that where splats draw its pixels, below which it is none
ABOUT = 2.0  # of these points, σ of the neighbourhood by which such pixels are told
ONE_SIDED = 0.9  # share of a plane's points that lie on one side of another one if it ends there
SEARCH, SWEEP = 0.12, 25  # diagonals along its normal in which a plane is sought, and offsets that are tried
TILT = 0.2  # slope by which it is tilted to begin with: rough depths were 8° off (kitchen_monkey)
TRIED = 3  # planes of the coarsest level that are followed up
STEP, COARSE_STEP, FINE_STEP = 0.01, 0.0025, 1e-4  # the pattern search's first and last ones: offset in diagonals
SURFACE = 5000  # points of a surface at which drawn depths are compared
SCATTER = 3 * 1.4826  # median absolute deviations within which drawn depths scatter: three standard deviations
MOST_SCATTER = 4 * TOLERANCE  # relative z; depths that scatter more than that lie on another surface


@dataclass(frozen=True)
class ChartSettings:
    """How surfaces are found and shown."""

    least: float = 0.05  # share of the points round the object; fewer planes against missed ones
    relief: Share = 0.9  # share of what photos disagree on, on a plane; rather it alone, or reliefs and further planes
    largest: AtLeastOne = 900  # px, side of a chart at most; detail against time


@dataclass(frozen=True)
class Beside:
    """Points of the solid surfaces that views show beside the object."""

    points: np.ndarray  # [N, 3]
    eyes: np.ndarray  # [N, 3] where the view stood that shows it
    weight: np.ndarray  # [N], how much it tells of what the object hid

    def take(self, rows: np.ndarray) -> Beside:
        return Beside(self.points[rows], self.eyes[rows], self.weight[rows])

    def some(self, count: int) -> Beside:
        """At most so many, drawn by what they tell."""
        if len(self.points) <= count:
            return self
        chance = self.weight / self.weight.sum()
        return self.take(np.sort(np.random.default_rng(0).choice(len(chance), count, replace=False, p=chance)))

    def on(self, plane: Plane) -> np.ndarray:
        """[N, 3]: where the same rays meet a plane."""
        rays = self.points - self.eyes
        along = rays @ plane.normal
        reach = ((plane.origin - self.eyes) @ plane.normal) / np.where(np.abs(along) > 1e-12, along, np.nan)
        return self.eyes + np.where(reach > 0, reach, np.nan)[:, None] * rays


def surface_beside(witnesses: Sequence[Witness], most: int, within: tuple[float, float] = (0.0, math.inf)) -> Beside:
    """About as many points as are asked for, all of the same weight, within so many px from the object."""

    def of(witness: Witness) -> tuple[np.ndarray, np.ndarray]:
        far = cv2.distanceTransform((~witness.hidden).astype(np.uint8), cv2.DIST_L2, 5)
        depth = np.where((far > within[0]) & (far <= within[1]), witness.depth_beside, 0)
        step = max(1, round(math.sqrt((depth > 0).sum() * len(witnesses) / most)))
        points = surface_points(witness.camera, depth, step=step)[2]
        return points, np.broadcast_to(witness.camera.centre, points.shape)

    points, eyes = (np.concatenate(p) for p in zip(*parallel_map(of, witnesses)))
    return Beside(points, eyes, np.ones(len(points)))


def _surface_round(witnesses: Sequence[Witness], region: Region) -> Beside:
    beside = surface_beside(witnesses, GATHERED, (MIXED_RIM, RING))
    beside = beside.take(~in_region(region, beside.points))
    said = ask(witnesses, beside.points, TOLERANCE)
    share = (said == Says.HIDDEN).sum(0) / np.maximum((said != Says.NOTHING).sum(0), 1)
    near = share > HIDDEN
    # few views, or all from one place: what is beside the object is all that tells
    if len(witnesses) < AGREEING or not near.any():
        return beside
    return replace(beside, weight=share**2).take(near)


def find_planes(
    witnesses: Sequence[Witness],
    region: Region,
    settings: ChartSettings = ChartSettings(),
    settled: bool = True,  # by photos; else as splats draw them
) -> tuple[Plane, ...]:
    """The planes nearest to the surfaces that run into what the object hid, sought among points of surface round it.

    Each counts by the square of the share of views in which the object hides it: what is hidden often lies near what is
    hidden always. Planes are then settled where photos' textures agree best, as rough splats' depths do not tell: at
    the pixels that led to them, and round the object on their side of the others, or they would tilt towards what is
    painted on those. Of two planes that could both be what some pixels show photos choose as well, and where several
    stay, each is settled again by the pixels that show it, and a further one on which they agree far less than where
    splats draw them is none. Fewer than three photos cannot judge: the planes are as they are drawn then.
    """
    diagonal, cameras = extent(region), np.array([w.camera.centre for w in witnesses])
    left, rng = _surface_round(witnesses, region), np.random.default_rng(0)
    least, sought = settings.least * left.weight.sum(), list[tuple[Plane, Beside]]()
    for _ in range(MOST):
        candidate = largest_plane(left.points, left.weight, INLIER * diagonal, cameras, region, rng)
        if candidate is None or left.weight[candidate[1]].sum() < least:
            break
        plane, on = candidate
        sought.append((plane, left.take(on)))
        left = left.take(~on)
    all_planes = [plane for plane, _ in sought]
    if not settled:
        return tuple(all_planes)
    if len(witnesses) < AGREEING:  # photos do not tell; of rough depths, parallel planes are mostly one surface
        crossing = [all(plane.crosses(before) for before in all_planes[:k]) for k, plane in enumerate(all_planes)]
        return tuple(itertools.compress(all_planes, crossing))
    levels = [Textures.make(witnesses, shrink=shrink) for shrink in LEVELS]
    textures = levels[-1]
    claims = [_Claim(plane, own, _bounds(plane, own, all_planes), witnesses, diagonal) for plane, own in sought]
    found = sorted(((*_settled(claim, levels), claim) for claim in claims), key=lambda f: -f[0])
    kept = _kept([(plane, claim) for _, plane, claim in found], textures, settings)
    for _ in range(SHARED if len(kept) > 1 else 0):
        kept = _kept(_settled_by_own_pixels(kept, textures), textures, settings)
    kept = [(plane, claim) for k, (plane, claim) in enumerate(kept) if k == 0 or not _made_up(plane, claim, textures)]
    return tuple(replace(plane, told=claim.own.some(SURFACE).on(plane)) for plane, claim in kept)


def _kept(
    found: Sequence[tuple[Plane, _Claim]], textures: Textures, settings: ChartSettings
) -> list[tuple[Plane, _Claim]]:
    """Those on which photos of their own pixels agree clearly better than on the planes before."""
    kept: list[tuple[Plane, _Claim]] = []
    for plane, claim in found:
        free = _free(claim.own.points, textures)
        before = max((textures.agreement(claim.own.on(p), free) for p, _ in kept), default=0.0)
        if not kept or 1 - textures.agreement(claim.own.on(plane), free) < settings.relief * (1 - before):
            kept.append((plane, claim))
    return kept


def _made_up(plane: Plane, claim: _Claim, textures: Textures) -> bool:
    """What is drawn near it is rather the truth, such as of a table's end, its legs, and the floor between them."""
    drawn = claim.own.points
    free = _free(drawn, textures)
    return textures.agreement(claim.own.on(plane), free) < MADE_UP * textures.agreement(drawn, free)


def depth_scatter(points: np.ndarray, witnesses: Sequence[Witness]) -> float:
    """Three standard deviations, relative to z, of the views' drawn surfaces about points [N, 3] of one.

    Of the nearer ones, or of the farther ones, if these are closer: some views show what stands before the points, some
    what lies beyond the surface's end, and that may be most of them.
    """
    off = _depths_off(points, witnesses)
    sides = [np.abs(side) for side in (off[off < 0], off[off > 0]) if len(side)]
    return min(MOST_SCATTER, *(SCATTER * float(np.median(side)) for side in sides)) if sides else 0.0


def _depths_off(points: np.ndarray, witnesses: Sequence[Witness]) -> np.ndarray:
    """[M]: z of the views' drawn surfaces over that of points [N, 3], less 1; the object's left out."""
    some, off = points[:: max(1, len(points) // SURFACE)], [np.zeros(0)]
    for witness in witnesses:
        _, rows, cols, z = framed(witness.camera, some)
        front = witness.depth[rows, cols]
        shown = ~witness.hidden[rows, cols] & (front > 0)
        off.append(front[shown] / z[shown] - 1)
    return np.concatenate(off)


def _same_surface(points: np.ndarray, witnesses: Sequence[Witness]) -> float:
    """Relative z within which views draw the surface that points [N, 3] lie on."""
    return max(TOLERANCE, depth_scatter(points, witnesses))


def _free(points: np.ndarray, textures: Textures) -> np.ndarray:
    """[N, V] bool: in which of the photos nothing stands before points [N, 3] of a surface."""
    said = ask(textures.witnesses, points, _same_surface(points, textures.witnesses))
    return np.ascontiguousarray((said != Says.BEHIND).T)


def grid(half: float, count: int) -> np.ndarray:
    """x and y of places on a square, [2, count, count]."""
    side = ((np.arange(count) + 0.5) / count * 2 - 1) * half
    return np.array(np.meshgrid(side, side))


def _bounds(plane: Plane, own: Beside, others: Sequence[Plane]) -> list[tuple[Plane, int]]:
    """The planes that a plane ends at, and on which side of them its own points lie: 1 above, −1 below."""

    def share(other: Plane, side: int) -> float:
        return float(own.weight @ (side * other.local(own.points)[:, 2] > 0) / own.weight.sum())

    crossed = [other for other in others if plane.crosses(other)]
    return [(other, side) for other in crossed for side in (1, -1) if share(other, side) > ONE_SIDED]


@dataclass(frozen=True)
class _Claim:
    """Pixels that seem to show one plane, and a rough guess of it."""

    plane: Plane
    own: Beside
    bounds: list[tuple[Plane, int]]  # see _bounds
    witnesses: Sequence[Witness]
    half: float  # diagonals of the region

    def agreement(
        self, textures: Textures, shrink: int = 1, near: Plane | None = None
    ) -> Callable[[np.ndarray], float]:
        """What is to be greatest: how alike photos look on the plane, by its pose; 0 where it is not sought.

        Where most views see through a plane `near` it, such as beyond a shelf's edge, they show other things. And so
        do those in which something stands before what they draw of it: which these are, its pose does not tell, or a
        false one would agree with itself.
        """
        count = POINTS // shrink
        x, y = (g.ravel() for g in grid(self.half, count))
        points = self.plane.points(x, y)
        there = self.inside(points)
        if near is not None:
            tolerance = _same_surface(self.own.some(SURFACE).on(near), self.witnesses)
            said = ask(self.witnesses, near.under(points), tolerance)
            there &= (said == Says.THROUGH).sum(0) <= np.isin(said, (Says.SEEN, Says.BESIDE)).sum(0)
        x, y, own = x[there], y[there], self.own.some(count**2 // OWN)
        free = _free(np.concatenate([points[there], own.points]), textures)

        def by(pose: np.ndarray) -> float:
            if not _sought(pose):
                return 0.0
            round_it = self.plane.points(x, y, pose[0] * self.half + pose[1] * x + pose[2] * y)
            return textures.agreement(np.concatenate([round_it, own.on(self.at(pose))]), free)

        return by

    def inside(self, points: np.ndarray) -> np.ndarray:
        """[N] bool, which of points [N, 3] lie on its side of the planes that it ends at."""
        there = np.ones(len(points), bool)
        for other, side in self.bounds:
            there &= side * other.local(points)[:, 2] > 0
        return there

    def at(self, pose: np.ndarray) -> Plane:
        """The guess moved and tilted by [3]: offset over `half`, two slopes."""
        return self.plane.tilted(pose[0] * self.half, pose[1], pose[2])

    def pose_of(self, other: Plane) -> np.ndarray:
        """By what the guess is moved and tilted to become another plane that does not cross it."""
        right, down, along = self.plane.axes @ other.normal
        offset = (other.origin - self.plane.origin) @ other.normal / along
        return np.array([offset / self.half, -right / along, -down / along])


def _sought(pose: np.ndarray) -> bool:
    """Beyond, photos may agree on something else that they show there, such as the ground round a plinth."""
    return abs(pose[0]) <= SEARCH


def _settled(claim: _Claim, levels: Sequence[Textures]) -> tuple[float, Plane]:
    """The plane where photos agree best, and how much: plane sweeps, then pattern searches with tilts (Hooke 1961).

    Coarse to fine: coarse pictures are matched from far off, fine ones precisely. What is best in coarse ones may be a
    compromise of several surfaces, so every level also starts anew, the finest from offsets only.
    """
    sweep, tilts = np.linspace(-1, 1, SWEEP) * SEARCH, (-TILT, 0.0, TILT)
    anywhere = [np.array(at) for at in itertools.product(sweep[::2], tilts, tilts)]
    best, reached, near = 0.0, list[np.ndarray](), None
    for shrink, textures in zip(LEVELS, levels):
        finest = shrink == LEVELS[-1]
        agreement = claim.agreement(textures, shrink, near)
        anew = ([np.array([o, 0.0, 0.0]) for o in sweep], 1) if finest else (anywhere, TRIED)
        starts, least = (*reached, *_best_of(agreement, *anew)), FINE_STEP if finest else COARSE_STEP
        best, at = max((_climbed(agreement, start, least) for start in starts), key=lambda climbed: climbed[0])
        reached, near = [at], claim.at(at)
    return best, claim.at(reached[0]) if best > 0 else claim.plane


def _settled_by_own_pixels(found: Sequence[tuple[Plane, _Claim]], textures: Textures) -> list[tuple[Plane, _Claim]]:
    """Settled again, from where they are and from the guesses, each by the pixels of photos that show it: on which
    photos agree less about any other plane. In the order of how well they agree in all.

    Else one that meets others, or lies close to them, is a compromise: tilted from a pavement to the street before it.
    """
    alike = [_alike_by_view(plane, claim, textures) for plane, claim in found]
    again = list[tuple[float, Plane, _Claim]]()
    for k, (plane, claim) in enumerate(found):
        others = alike[:k] + alike[k + 1 :]
        of_others = (np.max([a[v] for a in others], axis=0, initial=0) > own for v, own in enumerate(alike[k]))
        views = [replace(view, hidden=view.hidden | mask) for view, mask in zip(textures.witnesses, of_others)]
        agreement = claim.agreement(Textures.make(views), near=plane)
        starts = [np.zeros(3)] + ([] if plane.crosses(claim.plane) else [claim.pose_of(plane)])
        best, at = max((_climbed(agreement, start, FINE_STEP) for start in starts), key=lambda climbed: climbed[0])
        if best > 0:
            again.append((claim.agreement(textures, near=plane)(at), claim.at(at), claim))
    again.sort(key=lambda f: -f[0])
    return [(plane, claim) for _, plane, claim in again]


def _alike_by_view(plane: Plane, claim: _Claim, textures: Textures) -> list[np.ndarray]:
    """[H, W] float32 of each view: how alike photos look about the place of a plane at a pixel; 0 where none is."""
    x, y = (g.ravel() for g in grid(claim.half, POINTS))
    points = plane.points(x, y)
    energies = textures.energies(points, _free(points, textures)) * claim.inside(points)[:, None]
    common, total = (cv2.GaussianBlur(e.reshape(POINTS, POINTS), (0, 0), ABOUT) for e in energies.T)
    alike = np.where(total > 0, common / np.where(total > 0, total, 1), 0).astype(np.float32)
    tolerance = _same_surface(claim.own.some(SURFACE).on(plane), textures.witnesses)
    side = 2 * claim.half / POINTS
    place = np.array([[side, 0, side / 2 - claim.half], [0, side, side / 2 - claim.half], [0, 0, 1]])  # of a cell

    def of(view: Witness) -> np.ndarray:
        h, w = view.depth.shape
        c = view.camera
        frame = c.R @ np.stack([plane.right, plane.down, plane.origin], axis=1) + np.outer(c.t, [0, 0, 1])
        shown = c.K @ frame - 0.5 * np.outer([1, 1, 0], frame[2])  # pixels of places, times z
        u, v, one = np.linalg.inv(shown)[2]
        with np.errstate(divide="ignore"):
            z = 1 / (u * np.arange(w) + v * np.arange(h)[:, None] + one)
        met = (z > 0) & ((view.depth == 0) | (view.depth >= (1 - tolerance) * z))
        return np.where(met, cv2.warpPerspective(alike, shown @ place, (w, h), flags=cv2.INTER_NEAREST), 0)

    return parallel_map(of, textures.witnesses)


def _best_of(agreement: Callable[[np.ndarray], float], starts: Sequence[np.ndarray], count: int) -> list[np.ndarray]:
    told = parallel_map(agreement, starts)
    return [starts[k] for k in np.argsort(told)[::-1][:count]]


def _climbed(agreement: Callable[[np.ndarray], float], start: np.ndarray, least: float) -> tuple[float, np.ndarray]:
    """The greatest value near a start, and where it is: pattern search down to a step."""
    at, best, step = start, agreement(start), STEP
    while step > least:
        moves = [at + step * sign * np.eye(3)[k] * (1 if k == 0 else 2) for k in range(3) for sign in (1, -1)]
        told = parallel_map(agreement, moves)
        k = int(np.argmax(told))
        if told[k] > best:
            at, best = moves[k], told[k]
        else:
            step /= 2
    return best, at
