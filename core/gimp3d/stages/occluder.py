"""The object as a small volume that blocks light: its Gaussians, spread over cells."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import norm, qmc

from ..compute.jit import kernel
from ..compute.threads import run_ranges
from ..gaussians import Gaussians, quats_to_matrices
from .charts.plane import Plane

CELLS = 40  # along the longest side
SAMPLES = 16  # of every Gaussian, by which it is spread over cells
FAINT = 0.05  # opacity below which a Gaussian blocks nothing worth telling
LARGE = 0.25  # of the region's diagonal, from which a Gaussian is no part of an object that size
LOW = 0.03  # of the diagonal: what is lower is the surface that went along
LOWEST = 5.0  # percentile of what is removed that is its lowest part; a box cuts into the floor
STANDS = 0.1  # of the diagonal: an object whose lowest parts are no higher stands on the surface
STEP = 0.8  # cells that a ray goes at once


def standing(gaussians: Gaussians, plane: Plane, diagonal: float) -> Gaussians:
    """Those of the removed Gaussians that are an object on the plane: solid, and no haze or surface that went along."""
    height = plane.local(gaussians.means.astype(np.float64))[:, 2]
    solid = gaussians.usable & (gaussians.opacity > FAINT) & (gaussians.scales.max(1) < LARGE * diagonal)
    return gaussians.take(solid & (height > LOW * diagonal))


def support_first(planes: Sequence[Plane], gone: Gaussians) -> list[Plane]:
    """Planes, first what the object stands on: where its lowest part is nearest to it."""

    def gap(plane: Plane) -> float:
        return abs(float(np.percentile(plane.local(gone.means.astype(np.float64))[:, 2], LOWEST)))

    return sorted(planes, key=gap)


@dataclass(frozen=True)
class Occluder:
    """What blocks light, in the axes of a plane: x and y along it, z its height."""

    plane: Plane
    low: np.ndarray  # [3] corner of the volume
    cell: float  # side of a cell
    thickness: np.ndarray  # [X, Y, Z] float32: optical depth of a way of one cell's length
    walls: np.ndarray  # [W, 3] normals of what it stands before, in the plane's axes: no sky is seen behind them

    @classmethod
    def make(cls, gaussians: Gaussians, plane: Plane, diagonal: float, others: Sequence[Plane] = ()) -> Occluder | None:
        """Of the Gaussians that stand above the plane, and before some of the others; None if none does.

        A Gaussian blocks as much as an opaque disk of area 2π σ₁ σ₂ · opacity, whichever way it lies.
        """
        g = standing(gaussians, plane, diagonal)
        if len(g) < SAMPLES:
            return None
        means = plane.local(g.means.astype(np.float64))
        scales = np.pad(g.scales.astype(np.float64), ((0, 0), (0, 3 - g.scales.shape[1])))
        axes = plane.axes @ quats_to_matrices(g.quats.astype(np.float64)) * scales[:, None]
        normal = norm.ppf((qmc.Sobol(3, scramble=False).random(SAMPLES) + 0.5 / SAMPLES) % 1)
        points = means[:, None] + np.einsum("nij,sj->nsi", axes, normal)
        low, high = np.percentile(means, (0.5, 99.5), axis=0)
        low, high = low - 0.02 * diagonal, high + 0.02 * diagonal
        low[2] = 0.0 if low[2] < STANDS * diagonal else low[2]
        cell = float((high - low).max()) / CELLS
        shape = np.maximum(1, np.ceil((high - low) / cell)).astype(int)
        index = np.floor((points - low) / cell).astype(int)
        inside = ((index >= 0) & (index < shape)).all(-1)
        _, second, first = np.sort(scales, axis=1).T
        area = 2 * np.pi * first * second * g.opacity / SAMPLES
        weights = np.broadcast_to(area[:, None], inside.shape)[inside]
        cells = np.bincount(np.ravel_multi_index(tuple(index[inside].T), tuple(shape)), weights, int(shape.prod()))
        thickness = (cells / cell**2).reshape(shape).astype(np.float32)
        foot = int(np.ceil((LOW * diagonal - low[2]) / cell))
        if 0 < foot < shape[2] and low[2] < LOW * diagonal:
            thickness[:, :, :foot] = thickness[:, :, foot : foot + 1]  # it stands on the plane: no light goes below
        centre = np.median(g.means.astype(np.float64), axis=0, keepdims=True)
        walls = [o.normal for o in others if o.crosses(plane) and o.local(centre)[0, 2] > 0]
        return cls(plane, low, cell, thickness, np.reshape(walls, (-1, 3)) @ plane.axes.T)

    @property
    def size(self) -> np.ndarray:
        """[3] sides of the volume."""
        return np.array(self.thickness.shape) * self.cell

    @property
    def top(self) -> float:
        """Its height above the plane."""
        return float(self.low[2] + self.size[2])

    def moved(self, x: float, y: float) -> Occluder:
        """The same object elsewhere on the plane."""
        return replace(self, low=self.low + np.array([x, y, 0.0]))

    def blocked(self, points: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """[N, D] float32: the share of light from far away that does not arrive at points [N, 3] of the scene (Beer and
        Lambert); directions [D, 3] are unit vectors towards the light, in the plane's axes.
        """
        out = np.zeros((len(points), len(directions)), np.float32)
        start = (self.plane.local(points) - self.low) / self.cell
        run_ranges(_march_range, len(points), start, np.ascontiguousarray(directions), self.thickness, STEP, out)
        return out


@kernel
def _march_range(lo, hi, points, directions, thickness, step, out):
    nx, ny, nz = thickness.shape
    for i in range(lo, hi):
        for k in range(len(directions)):
            enter, leave = 0.5, 1e9  # a cell's own matter is no shadow on it
            for axis in range(3):
                p, d, n = points[i, axis], directions[k, axis], thickness.shape[axis]
                if abs(d) < 1e-9:
                    if p < 0 or p >= n:
                        leave = -1.0
                else:
                    a, b = -p / d, (n - p) / d
                    enter, leave = max(enter, min(a, b)), min(leave, max(a, b))
            depth = 0.0
            t = enter + 0.5 * step
            while t < leave and depth * step < 10:
                x = int(points[i, 0] + t * directions[k, 0])
                y = int(points[i, 1] + t * directions[k, 1])
                z = int(points[i, 2] + t * directions[k, 2])
                if 0 <= x < nx and 0 <= y < ny and 0 <= z < nz:
                    depth += thickness[x, y, z]
                t += step
            out[i, k] = 1 - np.exp(-depth * step)
