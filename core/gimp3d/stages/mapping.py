"""The mapping field: which source patch of the reference explains each filled one (paper 3.3; docs/method.md)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from ..camera import Camera
from ..geometry import SAME_DEPTH, surface_points
from ..schema import Signed
from ..solvers.patchmatch import PatchMatchSettings, nearest_neighbour_field
from .witness import Says, Witness, ask, total_over

MISFIT = 25.0  # grey levels of RMS misfit at which the field's confidence has fallen to 1/e


@dataclass(frozen=True)
class MappingSettings:
    """How sources are judged."""

    visibility: Signed = 0.002  # squared colour difference, λ_v of eq. 8, (11 grey levels)²; likeness, what views see
    as_printed: bool = False  # compared at f(p), copied from p + f(p); nothing: the paper's cost misses p
    patchmatch: PatchMatchSettings = field(default_factory=PatchMatchSettings)


@dataclass(frozen=True)
class MappingField:
    """f as absolute source coordinates."""

    rows: np.ndarray  # [H, W] int32, -1 where there is none
    cols: np.ndarray  # [H, W] int32
    confidence: float
    reason: str


def source_visibility(
    camera: Camera,
    depth: np.ndarray,  # [H, W] z-depth of the reference, 0 = nothing
    views: Sequence[tuple[Camera, np.ndarray, np.ndarray]],  # (camera, z-depth with the object, hidden pixels)
) -> np.ndarray:
    """v(q) [H, W] float32: the share of views that show the source point at q: framed, in front, not hidden."""
    rows, cols, points = surface_points(camera, np.where(np.isfinite(depth), depth, 0))

    def shown(view: tuple[Camera, np.ndarray, np.ndarray]) -> np.ndarray:
        other, z, hidden = view
        witness = Witness(other, np.empty((0, 0, 3), np.uint8), hidden, np.zeros_like(hidden), z)
        return ask([witness], points, SAME_DEPTH)[0] == Says.SEEN

    share = np.zeros(depth.shape, np.float32)
    share[rows, cols] = total_over(views, shown, rows.shape) / max(1, len(views))
    return share


def mapping_field(
    image: np.ndarray,  # [H, W, 3] uint8, the inpainted reference
    target: np.ndarray,  # [H, W] bool, T_0
    source: np.ndarray,  # [H, W] bool, centres of patches that may be copied
    visibility: np.ndarray,  # [H, W] float32, see source_visibility
    settings: MappingSettings = MappingSettings(),
    seed: int = 0,
) -> MappingField:
    """The field f* that minimises misfit, incoherence and λ_v (1 − v) over T_0 (paper eq. 8, sign mended).

    The target's colours are known (the reference is inpainted already), so no EM is needed.
    """
    penalty = (settings.visibility * (1 - visibility)).astype(np.float32)
    patchmatch = replace(settings.patchmatch, seed=settings.patchmatch.seed + seed)
    nearest = nearest_neighbour_field(image, target, source, penalty, patchmatch)
    if settings.as_printed:  # the place that was compared is taken as the offset f(p); none where p + f(p) is no source
        moved = np.stack([nearest.rows, nearest.cols]) + np.indices(source.shape)
        kept = nearest.found & (moved[0] < source.shape[0]) & (moved[1] < source.shape[1])
        kept[kept] = source[tuple(moved[:, kept])]
        rows, cols = np.where(kept, moved, -1).astype(np.int32)
        nearest = nearest._replace(rows=rows, cols=cols)
    found = nearest.found
    if not target.any():
        confidence, reason = 1.0, "nothing to map: the target region is empty in the reference"
    elif not found.any():
        confidence = 0.0
        reason = "no source patch: the reference shows nothing but the hole; its own colours are warped"
    else:
        rows, cols = nearest.rows[found], nearest.cols[found]
        appearance = (nearest.cost[found] - penalty[rows, cols]) / (1 - patchmatch.coherence)
        misfit = 255 * float(np.sqrt(max(0.0, appearance.mean())))
        confidence = float(np.exp(-misfit / MISFIT))
        reason = f"fill explained to {misfit:.1f} grey levels; "
        reason += f"sources seen by {visibility[rows, cols].mean():.0%} of the views"
    return MappingField(nearest.rows, nearest.cols, confidence, reason)
