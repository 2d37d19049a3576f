"""Planes with axes of their own, surfaces that a camera faces, and where rays of a view meet those."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from ...box import Region
from ...camera import Camera
from ...compute.jit import exact_kernel
from ...compute.threads import run_ranges
from ...geometry import pack_camera, project

PARALLEL = 0.9  # cosine of two planes' normals above which they do not bound each other
TRIES = 512  # of RANSAC: of a plane that holds a quarter of the points, one in 64 tries is on it
JUDGES = 4000  # points that vote on each try, for speed
ROUNDS = 5  # of least squares, each on the points that lie on the last plane


@dataclass(frozen=True)
class Plane:
    """A plane with axes; all [3], scene coordinates."""

    origin: np.ndarray  # the region's foot on it
    right: np.ndarray
    down: np.ndarray
    normal: np.ndarray  # unit, towards the cameras
    told: np.ndarray | None = None  # [N, 3] places on it that views show, if it was found

    @classmethod
    def make(cls, point: np.ndarray, normal: np.ndarray, region: Region) -> Plane:
        """Through a point; the axes follow the box whose edges lie nearest to the plane."""
        centre = np.mean([box.center for box in region], axis=0)
        edges = region[0].axes.T
        along = edges - np.outer(edges @ normal, normal)
        right = along[int(np.argmax(np.linalg.norm(along, axis=1)))]
        right = right / np.linalg.norm(right)
        return cls(centre - normal * ((centre - point) @ normal), right, np.cross(right, normal) * -1, normal)

    @property
    def axes(self) -> np.ndarray:
        """[3, 3] rows: right, down, normal."""
        return np.stack([self.right, self.down, self.normal])

    def points(self, x: np.ndarray, y: np.ndarray, height: np.ndarray | float = 0.0) -> np.ndarray:
        """Scene coordinates [..., 3] of places on the plane, or above it."""
        h = np.broadcast_to(height, np.shape(x))
        return self.origin + x[..., None] * self.right + y[..., None] * self.down + h[..., None] * self.normal

    def under(self, points: np.ndarray) -> np.ndarray:
        """Feet of points [N, 3] on the plane, along its normal."""
        return points - self.local(points)[:, 2:] * self.normal

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

    def crosses(self, other: Plane) -> bool:
        """Whether the planes are far from parallel, so that one may end at the other."""
        return abs(self.normal @ other.normal) <= PARALLEL


def extent(region: Region) -> float:
    """The diagonal of the region's box, or of what holds all its boxes."""
    corners = np.concatenate([b.corners() for b in region])
    return float(np.linalg.norm(region[0].size if len(region) == 1 else np.ptp(corners, axis=0)))


def largest_plane(
    points: np.ndarray,  # [N, 3]
    weight: np.ndarray,  # [N]
    tolerance: float,  # distance up to which a point lies on it
    cameras: np.ndarray,  # [V, 3] where views stand
    region: Region,
    rng: np.random.Generator,
) -> tuple[Plane, np.ndarray] | None:
    """The plane that holds most weight, facing the cameras, and which points lie on it [N] bool.

    RANSAC (Fischler & Bolles 1981), points drawn by their weight; then least squares.
    """
    if len(points) < 3 or weight.sum() <= 0:
        return None
    chance = weight / weight.sum()
    drawn = points[rng.choice(len(points), (TRIES, 3), p=chance)]
    normals = np.cross(drawn[:, 1] - drawn[:, 0], drawn[:, 2] - drawn[:, 0])
    length = np.linalg.norm(normals, axis=1)
    proper = length > 1e-12
    if not proper.any():
        return None
    normals, origins = normals[proper] / length[proper, None], drawn[proper, 0]
    judges = points[rng.choice(len(points), min(len(points), JUDGES), p=chance)]
    votes = (np.abs(judges @ normals.T - (normals * origins).sum(1)) < tolerance).sum(0)
    normal, point = normals[votes.argmax()], origins[votes.argmax()]
    for _ in range(ROUNDS):
        on = np.abs((points - point) @ normal) < tolerance
        w = weight[on]
        if len(w) < 3:
            return None
        point = (points[on] * w[:, None]).sum(0) / w.sum()
        normal = np.linalg.svd((points[on] - point) * np.sqrt(w)[:, None], full_matrices=False)[2][2]
    facing = normal if np.median((cameras - point) @ normal) > 0 else -normal
    return Plane.make(point, facing, region), np.abs((points - point) @ normal) < tolerance


@dataclass(frozen=True)
class Surface:
    """A surface at a plane, seen straight on."""

    plane: Plane
    camera: Camera
    depth: np.ndarray  # [H, W] float32 z of it

    def points(self, scale: float = 1) -> np.ndarray:
        """[h, w, 3] scene coordinates of its texels, or of smaller ones."""
        camera = self.camera.scaled(scale)
        z = cv2.resize(self.depth, (camera.width, camera.height), interpolation=cv2.INTER_LINEAR)
        return camera.unproject(camera.pixel_centres(), z.astype(np.float64))


@dataclass(frozen=True)
class Facing(Surface):
    """The same as photos show it; arrays [H, W] of its camera."""

    there: np.ndarray  # bool, the surface is there: beyond its edges, what lies behind it shows
    image: np.ndarray  # [H, W, 3] uint8, from photos; 0 where none shows it
    known: np.ndarray  # bool, photos show it, and much the same
    hole: np.ndarray  # bool, the object hides it, or photos may show some of the object there
    tolerance: float  # relative z within which a surface that views draw is this one


@dataclass(frozen=True)
class Hits:
    """What a view's rays meet of surfaces; arrays [H, W] of the view."""

    chart: np.ndarray  # int8, index of the surface met first; −1: none
    depth: np.ndarray  # float32, z there; 0: none
    rows: np.ndarray  # int32, the surface's texel
    cols: np.ndarray

    def behind(self, depth: np.ndarray, tolerance: float) -> np.ndarray:
        """[H, W] bool: the surface lies behind what the view draws (z or 0), by more than a relative tolerance."""
        return (depth > 0) & (depth < (1 - tolerance) * self.depth)

    def of(self, maps: Sequence[np.ndarray]) -> np.ndarray:
        """[H, W, ...] what maps of the surfaces, one each, hold where they are met; 0 elsewhere."""
        found = np.zeros((*self.chart.shape, *maps[0].shape[2:]), maps[0].dtype)
        for number, values in enumerate(maps):
            on = self.chart == number
            found[on] = values[self.rows[on], self.cols[on]]
        return found


def pictured(surfaces: Sequence[Facing], hits: Hits) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What the surfaces show where a view meets them, [H, W, 3] uint8, where that is known, and holes, [H, W] bool."""
    image, known, hole = (hits.of([getattr(s, name) for s in surfaces]) for name in ("image", "known", "hole"))
    return image, known, hole


def first_hits(surfaces: Sequence[Facing], camera: Camera, pixels: np.ndarray) -> Hits:
    """Where the rays of pixels [H, W] bool meet the first of the surfaces: seen from inside a room, that is shown."""
    shape = pixels.shape
    hits = Hits(np.full(shape, -1, np.int8), np.zeros(shape, np.float32), *np.zeros((2, *shape), np.int32))
    rows, cols = np.nonzero(pixels)
    for k, surface in enumerate(surfaces):
        where = pack_camera(camera), pack_camera(surface.camera), surface.depth, surface.there
        run_ranges(_meet_range, len(rows), rows, cols, *where, k, hits.chart, hits.depth, hits.rows, hits.cols)
    return hits


@exact_kernel
def _meet_range(lo, hi, rows, cols, c, m, depth, there, number, chart, met, texel_rows, texel_cols):
    """Rays of camera c against the surface of camera m, whose z is near constant: fixed-point steps along the ray."""
    ox = -(c[0] * c[9] + c[3] * c[10] + c[6] * c[11])
    oy = -(c[1] * c[9] + c[4] * c[10] + c[7] * c[11])
    oz = -(c[2] * c[9] + c[5] * c[10] + c[8] * c[11])
    height, width = depth.shape
    for i in range(lo, hi):
        a, b = (cols[i] + 0.5 - c[14]) / c[12], (rows[i] + 0.5 - c[15]) / c[13]
        dx = c[0] * a + c[3] * b + c[6]
        dy = c[1] * a + c[4] * b + c[7]
        dz = c[2] * a + c[5] * b + c[8]
        speed = m[6] * dx + m[7] * dy + m[8] * dz
        start = m[6] * ox + m[7] * oy + m[8] * oz + m[11]
        if not speed > 1e-9:
            continue
        z, row, col, inside = depth[height // 2, width // 2] * 1.0, 0, 0, False
        for _ in range(12):
            t = (z - start) / speed
            x, y, w = ox + t * dx, oy + t * dy, oz + t * dz
            u, v, _ = project(m, x, y, w)
            inside = 0 <= u < width and 0 <= v < height
            if not inside:
                break
            row, col = int(v), int(u)
            if abs(depth[row, col] - z) < 1e-6 * z:
                break
            z += 0.7 * (depth[row, col] - z)
        t = (z - start) / speed
        if not inside or not t > 0 or not there[row, col]:
            continue
        before = met[rows[i], cols[i]]
        if before == 0 or t < before:
            chart[rows[i], cols[i]], met[rows[i], cols[i]] = number, t
            texel_rows[rows[i], cols[i]], texel_cols[rows[i], cols[i]] = row, col
