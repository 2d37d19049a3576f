"""The surface behind the object: completing the reference's disparity (paper 3.3, METHOD section 3)."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import scipy.ndimage

from ..errors import IllPosed
from ..solvers.poisson import solve_poisson

SQUARE = np.ones((3, 3), bool)  # 8-neighbours


@dataclass(frozen=True)
class DepthSettings:
    """Lengths in pixels; differences of disparity are relative to the disparity itself."""

    surface: str = "auto"  # "auto": planes where the ring shows them, else harmonic; "planar", "harmonic" insist
    plane_ring: int = 24  # width of the ring on which planes are sought
    plane_inlier: float = 0.008  # difference up to which a ring pixel lies on a plane
    plane_share: float = 0.5  # of the ring that must lie on planes
    planes: int = 3  # at most: a floor and two walls
    least_plane: float = 0.08  # of the ring that a plane must hold
    plane_tries: int = 256  # RANSAC samples per plane
    junction: float = 0.95  # of two planes' ring pixels that max (or min) must explain for them to meet in the hole
    least_layer: float = 0.1  # of the rim that something off the planes must hold to reach into the hole
    scale_factor: float | None = None  # s_f; None: measured on the ring. The paper uses 0.1
    ring: int = 12  # width of the ring on which s_f is measured
    gradient_step: int = 6  # differences over this distance suffer least from a prior's noise (research, K2)
    minimum_ring: int = 10  # ring pixels below which nothing can be measured
    minimum_correlation: float = 0.3  # between the prior's and the scene's gradients
    layer_jump: float = 0.06  # step between neighbours on the rim that parts two layers
    layer_band: int = 4  # width of the ring on which layers are told apart
    occluder_share: float = 0.4  # of the rim: a nearer layer that holds more is what the object stood on
    low: float = 0.25  # completed disparities are clamped to [low · ring's least, high · ring's greatest]
    high: float = 4.0


@dataclass(frozen=True)
class DepthCompletion:
    """A completed disparity map."""

    disparity: np.ndarray  # [H, W] float32; 0 = infinitely far or nothing
    depth: np.ndarray  # [H, W] float32 z-depth; 0 where disparity is 0
    scale_factor: float  # s_f used; 0 = no guidance
    clamped: int  # pixels whose disparity had to be clamped
    confidence: float  # 0 to 1
    reason: str


def complete_disparity(
    disparity: np.ndarray,  # [H, W] float32, 1/z of the scene, valid where `known`; 0 = infinitely far (sky)
    known: np.ndarray,  # [H, W] bool, Dirichlet pixels
    hole: np.ndarray,  # [H, W] bool, the target region T
    prior: np.ndarray | None = None,  # [H, W] float32 relative disparity, any scale and shift
    settings: DepthSettings = DepthSettings(),
) -> DepthCompletion:
    """Fill a hole in a disparity map in the gradient domain (paper 3.3).

    Solves Δd = s_f Δd_m on the hole with d fixed on its known rim and natural boundaries elsewhere; the printed
    divergence has the opposite sign (METHOD section 3). Without a prior, planes that the surroundings lie on are
    continued (`planar_surfaces`), and what is on none of them is completed harmonically. Sky on the rim keeps its
    own part of the hole, and layers in front of it are no boundary (`background_rim`): nothing smears.
    Known pixels that are NaN, infinite or negative are not known.

    A part of the hole without a known rim takes the aligned prior, or else the nearest depth.

    Raises
    ------
    IllPosed
        If the hole has no known rim at all and no prior that fits what is known; or if planes were insisted on and
        there are none.
    """
    with np.errstate(invalid="ignore"):
        trusted = known & ~hole & np.isfinite(disparity) & (disparity >= 0)
    scene = np.where(trusted, disparity, 0.0).astype(np.float64)
    if not hole.any():
        return _report(scene, 0.0, 0, 1.0, "nothing to fill")
    window = _window(hole, settings.plane_ring + 2)
    if not (trusted[window] & scipy.ndimage.binary_dilation(hole[window])).any():
        return _align_prior(scene, trusted, hole, prior, settings)
    view = scene[window], trusted[window], hole[window]
    rim = background_rim(*view, settings)
    if prior is not None:
        scale, confidence, reason = measure_scale(view[0], rim, view[2], prior[window], settings)
        filled = _fill(view[0], rim, view[2], [], scale * prior[window] if scale else None, settings)
    else:
        surfaces, share = [], 0.0
        if settings.surface != "harmonic":
            surfaces, share = planar_surfaces(view[0], rim, view[2], settings)
        if settings.surface == "planar" and share < settings.plane_share:
            raise IllPosed(f"depth: only {share:.0%} of the surroundings lie on planes; use --depth-prior auto")
        scale, confidence, reason = 0.0, 0.7, "harmonic"
        if share >= settings.plane_share:
            confidence, reason = share, f"planar: {share:.0%} of the surroundings lie on {_counted(surfaces)}"
        filled = _fill(view[0], rim, view[2], surfaces if share >= settings.plane_share else [], None, settings)
    return None


def background_rim(
    disparity: np.ndarray,  # [H, W] float64
    known: np.ndarray,  # [H, W] bool
    hole: np.ndarray,  # [H, W] bool
    settings: DepthSettings = DepthSettings(),
) -> np.ndarray:
    """[H, W] bool: the known pixels that may bound the hole, without the rims of occluders in front of it."""
    ...
