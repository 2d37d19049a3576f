"""Planes in space with axes of their own, and the one that holds most of a set of points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...box import Region

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
