"""Floor and walls inside a user's box: surface that runs on smoothly from outside it (docs/method.md).

The views' depth maps are gathered as points in small cells round the box. Growth starts where the surface leaves the
cells, well outside the box, and goes on to a neighbouring cell if that lies in the plane of what was reached before it.
At the crease where an object stands it stops. Things stand on top of a plinth that the box cuts into: near the box's
faces growth goes over its edge, too, as parts that meet convexly are of one thing (Stein et al. 2014).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import scipy.ndimage

from ..box import Box, Region, in_region
from ..camera import Camera
from ..compute.jit import exact_kernel
from ..compute.threads import parallel_map, run_ranges
from ..geometry import surface_points
from .look import box_window

# Each of a fine grid, and of a coarse one.
CELLS = 800_000, 200_000  # of the grid round one box at most: more take seconds and hold too few points each
VIEWS = 60, 20  # at most so many, spread evenly, are gathered: further ones show the same surface
BEYOND = 0.25, 0.1  # how far the grid reaches beyond each face of the box, as a share of its size across
SEEDS = 0.1, 0.05  # width of the grid's outer layer, where growth starts, as such a share; boxes cut in no deeper
LEAST_CELL = 1.5  # edge of a cell, pixels of a usual view: narrower ones stay empty between pixels
LEAST_POINTS = 3  # in a cell that counts as surface: as many as span a plane
# Of a cell against the plane of those reached before it; test_surroundings holds them against shapes that are known.
STEP = 0.6  # cells off it at most
TURN = math.cos(math.radians(50))  # least cosine between both normals
STEADY = math.cos(math.radians(20))  # from this cosine on its own normal bends the plane that it hands on …
ADAPT = 0.25  # … with this weight
SUPPORT = 4  # cells within MARGIN that must have been reached before
WIDE = 0.5  # of the box, across which a top reaches that something in it stands on
THICKNESS = 0.5  # cells off its plane up to which a point belongs to the surface
SLANTED = 0.3  # a floor's size in a picture, over that of a surface that faces the camera
MARGIN = 2  # empty cells round the grid, so that none looks beyond it: SUPPORT's reach
PAIRS = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))  # of a symmetric 3×3 matrix


@dataclass(frozen=True)
class FollowedSurface:
    """The surface that was followed into a box; all in the box's axes, from its centre."""

    box: Box
    half: np.ndarray  # [3] half the grid's size
    cell: float  # edge length of a cell, scene units
    nearest: np.ndarray  # grid of int32: the row of the nearest cell of the surface, −1 beyond two cells
    points: np.ndarray  # [M, 3] on the surface
    normals: np.ndarray  # [M, 3] unit

    def distance(self, points: np.ndarray) -> np.ndarray:
        """[N]: how far points [N, 3] of the scene lie off the surface's plane nearby; infinite where there is none."""
        with np.errstate(invalid="ignore"):
            local = (points - self.box.center) @ self.box.axes
            index = np.floor((local + self.half) / self.cell)
            inside = ((index >= 0) & (index < self.nearest.shape)).all(1)
        rows = np.full(len(points), -1, np.int32)
        rows[inside] = self.nearest[tuple(index[inside].astype(int).T)]
        found = rows >= 0
        distance = np.full(len(points), np.inf)
        distance[found] = np.abs(((local[found] - self.points[rows[found]]) * self.normals[rows[found]]).sum(1))
        return distance


def follow_surface(
    box: Box,
    region: Region,  # where growth cannot start
    views: Sequence[tuple[Camera, np.ndarray]],  # (camera, z-depth [H, W] with the object, 0 = nothing)
    coarse: bool = False,
) -> FollowedSurface:
    """Follow the surface round a box into it."""
    half = box.size * (0.5 + BEYOND[coarse])
    pixel = float(np.median([abs(c.to_camera(box.center)[2]) / c.fx for c, _ in views]))
    points_per_cell = SLANTED * len(views)  # of cells as large as a pixel
    least = pixel * max(LEAST_CELL, math.sqrt(LEAST_POINTS / points_per_cell))
    cell = max(least, float((8 * half.prod() / CELLS[coarse]) ** (1 / 3)))
    dims = tuple(int(n) + 2 * MARGIN for n in np.ceil(2 * half / cell))

    def points_in(view: tuple[Camera, np.ndarray]) -> np.ndarray:
        """The view's points in the grid, [N, 6] in the box's axes, and unit vectors from them towards the camera; of
        large pictures no more than two per cell."""
        camera, depth = view
        distance = max(float(camera.to_camera(box.center)[2]), 1e-9)
        step = max(1, int(0.5 * cell * camera.fx / distance))
        _, _, points = surface_points(camera, depth, box_window(replace(box, size=2 * half), camera), step)
        local = (points - box.center) @ box.axes
        local = local[(np.abs(local) < half).all(1)]
        towards = (camera.centre - box.center) @ box.axes - local
        return np.concatenate([local, towards / np.linalg.norm(towards, axis=1, keepdims=True)], axis=1)

    count = min(len(views), VIEWS[coarse])
    gathered = np.concatenate(parallel_map(points_in, [views[k * len(views) // count] for k in range(count)]))
    local, towards = gathered[:, :3], gathered[:, 3:]
    keys = np.ravel_multi_index(tuple(np.floor((local + half) / cell).astype(np.int64).T + MARGIN), dims)
    filled = np.bincount(keys, minlength=math.prod(dims)) > 0
    numbers = np.where(filled, np.cumsum(filled, dtype=np.int32) - np.int32(1), np.int32(-1))  # of cells with points
    x, rows = local.T, numbers[keys]
    values = [None, *x, *(x[a] * x[b] for a, b in PAIRS), *towards.T]
    sums = np.stack([np.bincount(rows, v, np.count_nonzero(filled)) for v in values], axis=1)
    moments, seen_from = np.ascontiguousarray(sums[:, :-3]), sums[:, -3:]
    enough = moments[:, 0] >= LEAST_POINTS
    cells = np.flatnonzero(filled)[enough]
    points = moments[enough, 1:4] / moments[enough, :1]
    normals = _normals(moments, numbers, cells, _steps(dims, 1))
    normals *= np.where((normals * seen_from[enough]).sum(1) < 0, -1.0, 1.0)[:, None]  # outwards
    numbers = np.full(len(numbers), -1, np.int32)
    numbers[cells] = np.arange(len(points))
    places, deep = box.center + points @ box.axes.T, SEEDS[coarse]
    reached = (np.abs(points) > half - deep * box.size).any(1) & ~in_region(region, places)
    at_faces = ~in_region([replace(b, size=(1 - 2 * deep) * b.size) for b in region], places)
    planes = np.concatenate([points, normals], axis=1)
    grow = partial(_grow, numbers, cells, _steps(dims, 1), _steps(dims, MARGIN), points, normals, STEP * cell)
    grow(np.zeros_like(at_faces), reached, planes)
    over = reached.copy()
    grow(at_faces, over, planes)
    reached |= _tops(over & ~reached, cells, dims, points, box, deep)
    numbers[cells] = np.where(reached, np.cumsum(reached) - 1, -1)
    inner = slice(MARGIN, -MARGIN)
    nearest = numbers.reshape(dims)[inner, inner, inner]
    far, (i, j, k) = scipy.ndimage.distance_transform_edt(nearest < 0, return_indices=True)
    nearest = np.where(far <= 2, nearest[i, j, k], -1).astype(np.int32)
    return FollowedSurface(box, half, cell, nearest, planes[reached, :3], planes[reached, 3:])


def _tops(
    over: np.ndarray,  # [M] bool
    cells: np.ndarray,  # [M], see _normals
    dims: tuple[int, ...],  # of the grid
    points: np.ndarray,  # [M, 3]
    box: Box,
    deep: float,  # share of its size
) -> np.ndarray:
    """[M] bool: of the cells `over` edges those parts that may be the top of what stands in the box: they lie at one of
    its faces, no deeper than boxes cut into floors, and reach across most of it."""
    grid = np.zeros(math.prod(dims), bool)
    grid[cells[over]] = True
    parts = scipy.ndimage.label(grid.reshape(dims), np.ones((3, 3, 3)))[0].ravel()[cells]
    within = over & (np.abs(points) < box.size / 2).all(1)
    found = []
    for part in np.unique(parts[within]):
        places = points[within & (parts == part)] / box.size
        low, high = places.min(0), places.max(0)
        at_face = np.minimum(high + 0.5, 0.5 - low) < deep
        if at_face.any() and np.sort(high - low)[1] > WIDE:
            found.append(part)
    return over & np.isin(parts, found)


def _steps(dims: tuple[int, ...], reach: int) -> np.ndarray:
    """From a cell's index in the flat grid to those of the cells round it, and to itself."""
    around = np.indices((2 * reach + 1,) * 3).reshape(3, -1) - reach
    return around[0] * dims[1] * dims[2] + around[1] * dims[2] + around[2]


def _normals(
    moments: np.ndarray,  # [C, 10] of the cells with points: their number, sums of coordinates, sums of products
    numbers: np.ndarray,  # flat grid of int32: such a cell's row, −1 elsewhere
    cells: np.ndarray,  # [M] those that are asked for
    steps: np.ndarray,  # to those round them
) -> np.ndarray:
    """The direction in which the points of a cell and its neighbours spread least, [M, 3] (Hoppe 1992)."""
    normals = np.empty((len(cells), 3))

    def work(lo: int, hi: int) -> None:
        total = np.zeros((hi - lo, moments.shape[1]))
        _add_neighbours(cells[lo:hi], numbers, steps, moments, total)
        mean = total[:, 1:4] / total[:, :1]
        covariance = np.empty((hi - lo, 3, 3))
        for k, (a, b) in enumerate(PAIRS):
            covariance[:, a, b] = covariance[:, b, a] = total[:, 4 + k] / total[:, 0] - mean[:, a] * mean[:, b]
        normals[lo:hi] = np.linalg.eigh(covariance)[1][:, :, 0]

    run_ranges(work, len(cells))
    return normals


@exact_kernel
def _add_neighbours(cells, numbers, steps, moments, total):
    """total[i]: the sum of the moments of cell i and its 26 neighbours."""
    for i in range(len(cells)):
        for step in steps:
            other = numbers[cells[i] + step]
            if other >= 0:
                for k in range(total.shape[1]):
                    total[i, k] += moments[other, k]


@exact_kernel
def _grow(numbers, cells, near, around, points, normals, most_off, may_turn, reached, planes):
    """Reach cells that continue the plane of those reached before, in rounds; `reached` and `planes` are updated.

    A cell hands on the plane that it was reached by, hardly bent by its own normal: at the foot of an object cells
    hold both surfaces, and their normals would lead growth up its side. Over an edge, where each of both lies behind
    the other's plane, it hands on its own.
    """
    touched = np.zeros(len(cells), np.bool_)
    front = np.flatnonzero(reached)
    while len(front):
        for row in front:
            for step in near:
                other = numbers[cells[row] + step]
                if other >= 0 and not reached[other]:
                    touched[other] = True
        waiting = np.flatnonzero(touched)
        touched[:] = False
        accepted = np.zeros(len(waiting), np.bool_)
        for w in range(len(waiting)):
            row = waiting[w]
            count, px, py, pz, nx, ny, nz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
            for step in around:
                other = numbers[cells[row] + step]
                if other < 0 or not reached[other]:
                    continue
                p, n = planes[other, :3], planes[other, 3:]
                sign = -1.0 if nx * n[0] + ny * n[1] + nz * n[2] < 0 else 1.0
                count += 1
                px, py, pz = px + p[0], py + p[1], pz + p[2]
                nx, ny, nz = nx + sign * n[0], ny + sign * n[1], nz + sign * n[2]
            length = math.sqrt(nx * nx + ny * ny + nz * nz)
            if count < SUPPORT or length == 0:
                continue
            nx, ny, nz = nx / length, ny / length, nz / length
            px, py, pz = px / count, py / count, pz / count
            p, n = points[row], normals[row]
            off = nx * (p[0] - px) + ny * (p[1] - py) + nz * (p[2] - pz)
            agreement = nx * n[0] + ny * n[1] + nz * n[2]
            if abs(off) < most_off and abs(agreement) > TURN:
                accepted[w] = True
                gain = math.copysign(ADAPT, agreement) if abs(agreement) > STEADY else 0.0
                nx, ny, nz = nx + gain * n[0], ny + gain * n[1], nz + gain * n[2]
                length = math.sqrt(nx * nx + ny * ny + nz * nz)
                planes[row, 3], planes[row, 4], planes[row, 5] = nx / length, ny / length, nz / length
            elif may_turn[row] and off < 0:
                accepted[w] = n[0] * (px - p[0]) + n[1] * (py - p[1]) + n[2] * (pz - p[2]) < 0
        front = waiting[accepted]
        reached[front] = True
