"""The mapping field: which source patch of the reference explains each filled one (paper 3.3, METHOD 4)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from ..camera import Camera
from ..compute.jit import exact_kernel
from ..compute.threads import run_ranges
from ..geometry import disparity_of
from ..schema import Share, Signed
from ..solvers.patchmatch import NearestNeighbourField, PatchMatchSettings, nearest_neighbour_field
from ..solvers.surface import tangent_planes

MISFIT = 25.0  # grey levels of RMS misfit at which the field's confidence has fallen to 1/e


@dataclass(frozen=True)
class MappingSettings:
    """How sources are judged."""

    visibility: Signed = 0.002  # λ_v, cost of a source that no view sees, (11 grey levels)²; sign mended
    depth_tolerance: Share = 0.02  # z-test of visibility, relative
    geometry: bool = True  # patches lie on the surface (METHOD section 4); the paper's lie in the picture
    as_printed: bool = False  # patches are compared at f(p) and copied from p + f(p): the paper's cost misses p
    patchmatch: PatchMatchSettings = field(default_factory=PatchMatchSettings)


@dataclass(frozen=True)
class MappingField:
    """f as absolute source coordinates."""

    rows: np.ndarray  # [H, W] int32, -1 where there is none
    cols: np.ndarray  # [H, W] int32
    cost: np.ndarray  # [H, W] float32, (1 − λ_s)·appearance + λ_v (1 − v)
    visibility: np.ndarray  # [H, W] float32, v(q)
    confidence: float
    reason: str


def source_visibility(
    camera: Camera,
    depth: np.ndarray,  # [H, W] z-depth of the reference, 0 = nothing
    views: Sequence[tuple[Camera, np.ndarray, np.ndarray]],  # (camera, z-depth with the object, hidden pixels)
    settings: MappingSettings = MappingSettings(),
) -> np.ndarray:
    """v(q) [H, W] float32: the share of views that show the source point at q: framed, in front, not hidden.

    One pass per view; nothing is kept of a view but its count.
    """
    height, width = depth.shape
    count = np.zeros((height, width), np.int32)
    here = np.ascontiguousarray(depth, np.float32)
    for other, there, hidden in views:
        run_ranges(
            _count_seen,
            height,
            here,
            np.linalg.inv(camera.K),
            other.K @ (other.R @ camera.R.T),
            other.K @ (other.t - other.R @ camera.R.T @ camera.t),
            np.ascontiguousarray(there, np.float32),
            np.ascontiguousarray(hidden, bool),
            settings.depth_tolerance,
            count,
        )
    return (count / max(1, len(views))).astype(np.float32)


def mapping_field(
    image: np.ndarray,  # [H, W, 3] uint8, the inpainted reference
    target: np.ndarray,  # [H, W] bool, T_0
    source: np.ndarray,  # [H, W] bool, centres of patches that may be copied
    visibility: np.ndarray,  # [H, W] float32, see source_visibility
    settings: MappingSettings = MappingSettings(),
    seed: int = 0,
    camera: Camera | None = None,
    depth: np.ndarray | None = None,  # [H, W] z-depth of the completed reference, 0 = nothing
) -> MappingField:
    """The field f* that minimises misfit, incoherence and λ_v (1 − v) over T_0 (paper eq. 8, sign mended).

    The target's colours are known (the reference is inpainted already), so no EM is needed.
    """
    penalty = (settings.visibility * (1 - visibility)).astype(np.float32)
    patchmatch = replace(settings.patchmatch, seed=settings.patchmatch.seed + seed)
    surface = None
    if settings.geometry and camera is not None and depth is not None:
        surface = tangent_planes(disparity_of(depth), camera.K)
    nearest = nearest_neighbour_field(image, target, source, penalty, patchmatch, surface)
    if settings.as_printed:
        nearest = _moved_by_places(nearest, source)
    found = nearest.found
    if not target.any():
        confidence, reason = 1.0, "nothing to map: the target region is empty in the reference"
    elif not found.any():
        confidence, reason = (
            0.0,
            "no source patch: the reference shows nothing but the hole; its own colours are warped",
        )
    else:
        rows, cols = nearest.rows[found], nearest.cols[found]
        appearance = (nearest.cost[found] - penalty[rows, cols]) / (1 - patchmatch.coherence)
        misfit = 255 * float(np.sqrt(max(0.0, appearance.mean())))
        confidence = float(np.exp(-misfit / MISFIT))
        reason = f"fill explained to {misfit:.1f} grey levels; "
        reason += f"sources seen by {visibility[rows, cols].mean():.0%} of the views"
    return MappingField(nearest.rows, nearest.cols, nearest.cost, visibility, confidence, reason)


def _moved_by_places(nearest: NearestNeighbourField, source: np.ndarray) -> NearestNeighbourField:
    """The place that was compared taken as the offset f(p); none where p + f(p) is no source."""
    places = np.argwhere(nearest.found)
    moved = places + np.stack([nearest.rows, nearest.cols], -1)[nearest.found]
    kept = (moved < source.shape).all(1)
    kept[kept] = source[tuple(moved[kept].T)]
    rows, cols = np.full((2, *source.shape), -1, np.int32)
    rows[tuple(places[kept].T)], cols[tuple(places[kept].T)] = moved[kept].T
    return replace(nearest, rows=rows, cols=cols)


@exact_kernel
def _count_seen(lo, hi, depth, inverse, turn, shift, there, hidden, tolerance, count):
    """Add one to every pixel of rows [lo, hi) whose point is the surface that the other view shows there.

    `inverse` is K⁻¹ of the reference; `turn` and `shift` take its camera axes to the other view's pixels.
    """
    h, w = there.shape
    for i in range(lo, hi):
        for j in range(depth.shape[1]):
            z = float(depth[i, j])
            if not 0 < z < np.inf:
                continue
            x = (inverse[0, 0] * (j + 0.5) + inverse[0, 2]) * z
            y = (inverse[1, 1] * (i + 0.5) + inverse[1, 2]) * z
            zt = turn[2, 0] * x + turn[2, 1] * y + turn[2, 2] * z + shift[2]
            if zt <= 0:
                continue
            u = (turn[0, 0] * x + turn[0, 1] * y + turn[0, 2] * z + shift[0]) / zt
            v = (turn[1, 0] * x + turn[1, 1] * y + turn[1, 2] * z + shift[1]) / zt
            if not (0 <= u < w and 0 <= v < h):
                continue
            a, b = int(v), int(u)
            if not hidden[a, b] and abs(there[a, b] - zt) < tolerance * zt:
                count[i, j] += 1
