"""The mapping field: which source patch of the reference explains each filled one (paper 3.3, METHOD section 4)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..camera import Camera
from ..solvers.patchmatch import PatchMatchSettings, nearest_neighbour_field
from .masks import sees


@dataclass(frozen=True)
class MappingSettings:
    """How sources are judged."""

    visibility: float = 0.01  # λ_v, cost of a source that no view sees (printed with the wrong sign)
    depth_tolerance: float = 0.02  # z-test of visibility, relative
    patchmatch: PatchMatchSettings = PatchMatchSettings()


@dataclass(frozen=True)
class MappingField:
    """f as absolute source coordinates."""

    rows: np.ndarray  # [H, W] int32, -1 where there is none
    cols: np.ndarray  # [H, W] int32
    cost: np.ndarray  # [H, W] float32
    visibility: np.ndarray  # [H, W] float32, v(q)
    confidence: float
    reason: str


def source_visibility(
    camera: Camera,
    depth: np.ndarray,  # [H, W] z-depth of the reference, 0 = nothing
    views: Sequence[tuple[Camera, np.ndarray, np.ndarray]],  # (camera, z-depth with the object, hidden pixels) each
    settings: MappingSettings = MappingSettings(),  # noqa: B008
) -> np.ndarray:
    """v(q) [H, W] float32: the share of views in which the source point at q is framed, unoccluded and not in T_t."""
    rows, cols = np.nonzero(depth > 0)
    points = camera.unproject(np.stack([cols + 0.5, rows + 0.5], -1), depth[rows, cols].astype(np.float64))
    count = np.zeros(len(points), np.float32)
    for other, seen_depth, hidden in views:
        count += sees(other, np.where(hidden, 0, seen_depth), points, settings.depth_tolerance)
    visibility = np.zeros(depth.shape, np.float32)
    visibility[rows, cols] = count / max(1, len(views))
    return visibility


def mapping_field(
    image: np.ndarray,  # [H, W, 3] uint8, the inpainted reference
    target: np.ndarray,  # [H, W] bool, T_0
    source: np.ndarray,  # [H, W] bool, where patches may come from
    visibility: np.ndarray,  # [H, W] float32, see source_visibility
    settings: MappingSettings = MappingSettings(),  # noqa: B008
    seed: int = 0,
) -> MappingField:
    """The field f* that minimises appearance, incoherence and λ_v (1 − v) over T_0 (paper eq. 7 and 8, signs mended).

    The target's colours are known (the reference is inpainted already), so no EM is needed.
    """
    penalty = settings.visibility * (1.0 - visibility)
    patchmatch = replace(settings.patchmatch, seed=settings.patchmatch.seed + seed)
    field = nearest_neighbour_field(image, target, source, penalty, patchmatch)
    found = target & (field.rows >= 0)
    if not found.any():
        words = "no source patch: the reference shows nothing but the hole; its own colours are warped"
        return MappingField(field.rows, field.cols, field.cost, visibility, 0.0, words)
    appearance = field.cost[found] - penalty[field.rows[found], field.cols[found]]
    error = 255 * float(np.sqrt(max(0.0, appearance.mean())))
    seen = float(visibility[field.rows[found], field.cols[found]].mean())
    words = f"fill explained to {error:.1f} grey levels; sources seen by {seen:.0%} of the views"
    return MappingField(field.rows, field.cols, field.cost, visibility, float(np.exp(-error / 25)), words)
