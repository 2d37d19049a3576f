"""Cameras round a region: for a scene that comes without any, and in the gaps between those that it has."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from .box import Box, in_region
from .camera import Camera
from .errors import BadInput
from .gaussians import Gaussians

ELEVATIONS = (15.0, 35.0, 60.0)  # degrees above the floor; each ring's cameras stand between the last ring's
FILL = 0.4  # share of the smaller image side that the region's bounding sphere takes
NEARBY = 4.0  # radii of the region round its centre within which its floor is sought
FLAT = 0.03  # of the radius: distance up to which a Gaussian lies on a plane
SUNK = 0.25  # share of a region's height that its boxes may reach below its floor
LEAST_FLOOR = 0.15  # share of the Gaussians round the region that a floor holds
GAP = 20.0  # degrees to the next camera: harmonics of degree 2 turn their sign within 45
PAIRED = 64  # cameras; memory goes with its square
SAMPLED, TRIES = 4000, 500  # Gaussians looked at, planes tried


def orbit_cameras(
    region: Sequence[Box],
    count: int = 24,
    up: tuple[float, float, float] = (0.0, 0.0, 1.0),
    width: int = 960,  # pixels
    height: int = 540,
    fov_degrees: float = 50.0,  # horizontal
) -> tuple[Camera, ...]:
    """Cameras that look at a region's centre from rings above it, IDs orbit/000, orbit/001 …

    The rings stand round `up`, a direction in the scene of any length.

    Raises
    ------
    BadInput
        If the up direction is zero, the region is empty, or a count, size or angle makes no sense.

    Examples
    --------
    >>> cameras = orbit_cameras([Box.make([0, 0, 0.5], [1, 1, 1])], count=6, width=60, height=45)
    >>> [camera.id for camera in cameras][:2]
    ['orbit/000', 'orbit/001']
    """
    axis = np.asarray(up, dtype=np.float64)
    if axis.shape != (3,) or not np.isfinite(axis).all() or np.linalg.norm(axis) < 1e-9:
        raise BadInput("orbit: the up direction must be three numbers, not all zero")
    if not 1 <= count <= 10_000:
        raise BadInput(f"orbit: between 1 and 10000 views, got {count}")
    if not 1 < fov_degrees < 170:
        raise BadInput(f"orbit: the field of view must lie between 1 and 170 degrees, got {fov_degrees}")
    if not (0 < width < 1 << 16 and 0 < height < 1 << 16):
        raise BadInput(f"orbit: an image of {width}×{height} pixels makes no sense")
    if not region:
        raise BadInput("orbit: no region to look at; give at least one box")
    axis = _unit(axis)
    _, centre, radius = _extent(region)
    focal = 0.5 * width / math.tan(math.radians(fov_degrees) / 2)
    half_picture = FILL * min(width, height) / 2
    # where a sphere's outline has that size; unlike size · focal / pixels it stays outside the sphere with wide lenses
    distance = radius * math.hypot(1, focal / half_picture)
    side = _unit(np.cross(axis, [1.0, 0, 0] if abs(axis[0]) < 0.9 else [0, 1.0, 0]))
    front = np.cross(axis, side)
    cameras = []
    for k in range(count):
        elevation = math.radians(ELEVATIONS[k % len(ELEVATIONS)])
        azimuth = 2 * math.pi * k / count
        away = math.cos(elevation) * (math.cos(azimuth) * side + math.sin(azimuth) * front) + math.sin(elevation) * axis
        viewmat = look_at(centre + distance * away, centre, axis)
        cameras.append(Camera(f"orbit/{k:03d}", width, height, focal, focal, width / 2, height / 2, viewmat, "train"))
    return tuple(cameras)


def cameras_between(cameras: Sequence[Camera], centre: np.ndarray) -> tuple[Camera, ...]:
    """Cameras that look at the centre [3] from where GAP degrees round it no other stands, IDs between/000 …

    Each stands half way between two of those given that are less than 120° apart, the emptiest place first, and has
    the lens of the one next to it. Of many cameras only some, evenly, are paired.
    """
    away = np.array([c.centre for c in cameras]) - centre
    distance = np.linalg.norm(away, axis=1)
    towards = away / np.maximum(distance, 1e-9)[:, None]
    paired = np.arange(len(cameras))[:: math.ceil(len(cameras) / PAIRED)]
    one, other = paired[np.array(np.triu_indices(len(paired), 1))]
    middle = towards[one] + towards[other]
    length, far = np.linalg.norm(middle, axis=1), (distance[one] + distance[other]) / 2
    proper = length > 1
    middle, far = middle[proper] / length[proper, None], far[proper]
    found: list[Camera] = []
    # rounded, so that the first of equal ones is taken with every BLAS
    nearest = (middle @ towards.T).max(1).round(9)
    while len(nearest) and nearest.min() < math.cos(math.radians(GAP)):
        k = int(nearest.argmin())
        lens = cameras[int((towards @ middle[k]).round(9).argmax())]
        viewmat = look_at(centre + far[k] * middle[k], centre, -lens.R[1])
        found.append(replace(lens, id=f"between/{len(found):03d}", viewmat=viewmat, image=None))
        nearest = np.maximum(nearest, (middle @ middle[k]).round(9))
    return tuple(found)


def _extent(region: Sequence[Box]) -> tuple[np.ndarray, np.ndarray, float]:
    """A region's corners [N, 3], their middle [3], and the radius of the sphere round it that holds them."""
    corners = np.concatenate([box.corners() for box in region])
    centre = (corners.min(0) + corners.max(0)) / 2
    return corners, centre, math.sqrt(((corners - centre) ** 2).sum(1).max())


def measured_up(scene: Gaussians, region: Sequence[Box]) -> np.ndarray | None:
    """The unit normal, towards the region, of the floor under it; None where no plane is found that it stands clear of.

    It has six decimals, which is more than a floor has, and the same with every LAPACK.
    RANSAC (Fischler & Bolles 1981) with a fixed seed over the solid Gaussians round the region. Of the planes that hold
    at least half as many as the best one the nearest is the floor: an object touches it rather than the walls.
    """
    corners, centre, radius = _extent(region)
    means = scene.means.astype(np.float64)
    near = (np.linalg.norm(means - centre, axis=1) < NEARBY * radius) & ~in_region(region, means)
    points = means[near & (scene.opacity_logits > 0)]
    points = (points[:: len(points) // SAMPLED + 1] - centre) / radius
    if len(points) < 10:
        return None
    picks = points[np.random.default_rng(0).integers(len(points), size=(TRIES, 3))]
    normals = np.cross(picks[:, 1] - picks[:, 0], picks[:, 2] - picks[:, 0])
    lengths = np.linalg.norm(normals, axis=1)
    proper = lengths > 1e-6
    normals = normals[proper] / lengths[proper, None]
    offsets = (normals * picks[proper, 0]).sum(1)
    towards = np.where(offsets > 0, -1.0, 1.0)  # the region's centre is the origin
    normals, offsets = normals * towards[:, None], offsets * towards
    heights = normals @ ((corners - centre) / radius).T - offsets[:, None]
    lowest = heights.min(1)
    stands = lowest >= -SUNK * (heights.max(1) - lowest)
    held = np.array([(np.abs(points @ n - d) < FLAT).mean() for n, d in zip(normals, offsets)])
    held = np.where(stands, held, 0.0)
    if not held.size or held.max() < LEAST_FLOOR:
        return None
    large = np.flatnonzero(held >= held.max() / 2)
    best = large[np.argmin(np.abs(lowest[large]))]
    on = points[np.abs(points @ normals[best] - offsets[best]) < FLAT]
    normal = np.linalg.svd(on - on.mean(0), full_matrices=False)[2][2]
    return np.round(normal * (1.0 if normal @ normals[best] > 0 else -1.0), 6)


def look_at(eye: np.ndarray, target: np.ndarray, up: np.ndarray) -> np.ndarray:
    """The world→camera matrix [4, 4] (OpenCV axes) of a camera at `eye` that looks at `target`, `up` not along it."""
    forward = _unit(target - eye)
    right = _unit(np.cross(forward, up))
    rotation = np.stack([right, np.cross(forward, right), forward])
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, -(rotation * eye).sum(1)
    return matrix


def _unit(vector: np.ndarray) -> np.ndarray:
    """Without BLAS, whose last bits differ between NumPys: Blender's and the command's orbits are the same."""
    return vector / math.sqrt((vector * vector).sum())
