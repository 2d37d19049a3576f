"""The surface behind the object where no chart tells it: completing a view's disparity (paper 3.3; docs/method.md)."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import cv2
import numpy as np
import scipy.ndimage

from ..errors import IllPosed
from ..geometry import disparity_of
from ..priors.monodepth import DepthPrior, relative_disparity
from ..schema import Signed
from ..solvers.poisson import solve_poisson, thin_plate
from ..solvers.robust import CUT, robust_fit

RING = 12  # px, width of the ring round the hole that is continued, and on which s_f is measured
LEAST_PIXELS = 10  # of the ring below which nothing can be measured
LOW, HIGH = 0.25, 4.0  # completed disparities are clamped to [LOW · ring's least, HIGH · ring's greatest]
LARGE = 0.05  # share of the hole above which clamping or guessing has a say in the confidence
EXPECTED = 0.02  # relative difference between the ring and what is continued at which the confidence is one half
SHOWN = 1500  # ring pixels kept for the fit's picture
RELIEF = 6  # px; differences over this distance tell relief from a prior's smooth errors best (research)
FULL = 0.7  # correlation of relief from which it is believed whole; below, its square shares it
DOUBT = 2.0  # times the variance that the prior's error takes of its relief in the hole
SAME = 1e-3  # relative difference of disparities that is never held against a pixel
LEAST = 0.05  # share of the fitted scale below which a prior says nothing
MOST = 2.0  # times the fitted scale; a prior's errors flatten the fit, which its relief may set right
SURE = 0.95  # share of the fitted scale from which it is not worth a word that a prior is believed by less


@dataclass(frozen=True)
class DepthSettings:
    """How the surface behind the object is continued where no chart shows it."""

    surface: Literal["smooth", "planar", "harmonic"] = "smooth"  # kind; a thin plate, one plane, or a membrane (paper)
    scale_factor: Signed | None = None  # disparity per unit of the prior, s_f; none: measured (paper: 0.1)


@dataclass(frozen=True)
class DepthCompletion:
    """A completed depth map."""

    depth: np.ndarray  # [H, W] float32 z-depth; 0 = infinitely far or nothing
    confidence: float  # 0 to 1
    reason: str
    fit: PriorFit  # how the prior was scaled, if there is one


def complete_depth(
    disparity: np.ndarray,  # [H, W] float32, 1/z of the view without the object; 0 = infinitely far (sky)
    known: np.ndarray,  # [H, W] bool, where that is trusted
    hole: np.ndarray,  # [H, W] bool, the target region T
    prior: DepthPrior | None = None,
    settings: DepthSettings = DepthSettings(),
) -> DepthCompletion:
    """Fill a hole in a disparity map.

    With a prior, in the gradient domain (paper 3.3): Δd = s_f Δd_m on the hole with d fixed on its known rim and
    natural boundaries elsewhere (printed with the opposite sign: docs/method.md). Without, what is round the hole is
    continued. Pixels that are NaN, infinite or negative are not known, pixels that do not agree with a prior that does
    fit are no rim. A part of the hole that has no rim takes the prior, aligned to the ring, or the nearest depth.

    Raises
    ------
    IllPosed
        If the hole has no known rim at all and no prior that fits what is known.
    """
    with np.errstate(invalid="ignore"):
        trusted = known & ~hole & np.isfinite(disparity) & (disparity >= 0)
    scene = np.where(trusted, disparity, 0.0).astype(np.float64)
    if not hole.any():
        return DepthCompletion(disparity_of(scene.astype(np.float32)), 1.0, "nothing to fill", PriorFit())
    ring = trusted & (cv2.distanceTransform((~hole).astype(np.uint8), cv2.DIST_L2, 5) <= RING)
    around, fit, guide = ring if ring.any() else trusted, PriorFit(), None
    if prior is not None:
        guide = relative_disparity(prior, disparity, trusted).astype(np.float64)
        fit = fit_prior(scene, around, hole, guide, settings.scale_factor)
    if guide is not None and fit.scale:
        gaps = ~np.isfinite(guide)
        whole = fit.shift + fit.scale * solve_poisson(gaps, ~gaps, guide).values
        agrees = np.nan_to_num(np.abs(fit.line[0] * guide + fit.line[1] - scene)) <= fit.error  # or says nothing
        filled = solve_poisson(hole, trusted & agrees, scene, whole).values
        confidence, reason = fit.confidence, ""
    elif not ring.any():
        raise IllPosed("depth: the hole has no rim of known depth; choose a reference that shows more surroundings")
    else:
        filled, reason = _continued(scene, ring, hole, settings.surface)
        told = ring & (scene > 0) & np.isfinite(filled)
        missed = float(np.median(np.abs(filled[told] / scene[told] - 1))) if told.any() else EXPECTED
        confidence = min(fit.confidence, 1 / (1 + missed / EXPECTED))
    reasons = [r for r in (fit.reason, reason) if r]
    unknown = hole & ~np.isfinite(filled)
    if unknown.any():
        nearest = scipy.ndimage.distance_transform_edt(~around, return_distances=False, return_indices=True)
        filled = np.where(unknown, scene[tuple(nearest)], filled)
        reasons.append("a part of the hole has no rim: nearest depth used")
    finite = scene[around & (scene > 0)]
    low, high = (LOW * finite.min(), HIGH * finite.max()) if len(finite) else (0.0, 0.0)
    if (scene[around] == 0).any():  # where the ring shows sky, so far means infinitely far
        filled, low = np.where(filled < low, 0.0, filled), 0.0
    clamped = int((hole & ((filled < low) | (filled > high))).sum())
    if clamped > LARGE * hole.sum():
        reasons.append(f"{clamped} pixels clamped to the ring's range")
        confidence *= 0.5
    if unknown.sum() > LARGE * hole.sum():
        confidence *= 0.3
    result = np.where(hole, np.clip(filled, low, high), scene).astype(np.float32)
    return DepthCompletion(disparity_of(result), confidence, "; ".join(reasons), fit)


def _continued(scene: np.ndarray, ring: np.ndarray, hole: np.ndarray, surface: str) -> tuple[np.ndarray, str]:
    """[H, W]: the disparity continued over the ring and the hole, NaN elsewhere, and how; sky as sky."""
    ground = ring & (scene > 0)
    if surface == "planar" and ground.sum() >= LEAST_PIXELS:
        rows, cols = np.nonzero(ground)
        here = np.stack([rows, cols, np.ones(len(rows))], -1)
        (a, b, c), _ = robust_fit(here / scene[ground][:, None], np.ones(len(rows)))
        v, u = np.indices(scene.shape)
        filled = np.where(ring | hole, a * v + b * u + c, np.nan)
        words = "planar: the plane that most of the ring lies on"
    elif surface == "harmonic" or not ground.any():
        filled, words = solve_poisson(hole, ground if ground.any() else ring, scene).values, "harmonic"
    else:
        filled = thin_plate(scene, ground, hole)
        words = "smooth: the surroundings' slopes are continued"
    if ground.any() and (ring & ~ground).any():
        sky = solve_poisson(hole, ring, (~ground).astype(float)).values
        filled = np.where(hole & (sky > 0.5), 0.0, filled)
    return filled, words


@dataclass(frozen=True)
class PriorFit:
    """How a relative prior turns into the scene's disparity: scale · prior + shift. Scale 0: not at all."""

    scale: float = 0.0  # s_f: the slope of the line as far as the prior is believed
    shift: float = 0.0  # matters only where the hole has no rim
    confidence: float = 1.0
    reason: str = ""
    ring: np.ndarray = field(default_factory=lambda: np.zeros((0, 2), np.float32))  # [N, 2] (prior, scene's disparity)
    line: tuple[float, float] = (0.0, 0.0)  # (slope, offset) fitted to `ring`
    error: float = float("inf")  # in disparity, beyond which a pixel is not on the line


def fit_prior(
    disparity: np.ndarray, around: np.ndarray, hole: np.ndarray, prior: np.ndarray, scale_factor: float | None = None
) -> PriorFit:
    """Measure s_f by a robust affine fit of the scene's disparity to the prior round the hole (docs/method.md), unless
    it is given. Maps are [H, W]: `around` bool, where disparity is known round the hole; NaN is no value of a prior.

    The fit tells the prior's units. It is believed as far as its relief on the ring is the scene's, or as far as its
    relief in the hole is larger than its error on the ring, whichever is more: foliage and the swirls of rough scans
    drown the first of a prior that is right, and smooth errors, which the hole's rim takes away, the second. s_f is 0
    where the prior says nothing: too few pixels, no variance, a slope ≤ 0.
    """
    ring = around & (disparity > 0) & np.isfinite(prior)
    m, d = prior[ring].astype(np.float64), disparity[ring].astype(np.float64)
    if len(m) < LEAST_PIXELS:
        return PriorFit(0.0, 0.0, 0.3, "prior not used, too little is known round the hole to scale it")
    shown = np.stack([m, d], -1)[:: max(1, len(m) // SHOWN)].astype(np.float32)

    def unused(line: tuple[float, float], reason: str) -> PriorFit:
        return PriorFit(0.0, 0.0, 0.3, f"prior not used, {reason}", shown, line)

    if scale_factor is not None:
        shift = float(np.median(d - scale_factor * m))
        return PriorFit(
            scale_factor, shift, 0.5, f"guided, s_f = {scale_factor:g} as set", shown, (scale_factor, shift)
        )
    middle, spread = m.mean(), m.std()
    if spread < 1e-6 * max(float(np.abs(m).max()), 1e-150):
        return unused((0.0, float(np.median(d))), "it is constant round the hole")
    (slope, level), sigma = robust_fit(np.stack([(m - middle) / spread, np.ones_like(m)], -1), d)
    line = float(slope / spread), float(level - slope / spread * middle)
    off, error = sigma / float(np.median(d)), CUT * sigma + SAME * float(np.median(d))
    share = 0.0
    if line[0] > 0:
        guide, agreeing = line[0] * prior, ring.copy()
        agreeing[ring] = np.abs(line[0] * m + line[1] - d) <= error
        share = max(_shared_relief(guide, disparity, agreeing), _certain_relief(guide, hole, sigma))
    if share < LEAST:
        return unused(line, f"it does not fit the scene (off by {off:.1%} round the hole)")
    scale = share * line[0]
    words = f"guided, {line[0]:.3g} × the prior is the disparity round the hole to {off:.1%}"
    if share < SURE:
        words += f", believed by {share:.0%}"
    return PriorFit(scale, float(np.median(d - scale * m)), max(0.3, min(1.0, share)), words, shown, line, error)


def _shared_relief(guide: np.ndarray, disparity: np.ndarray, agreeing: np.ndarray) -> float:
    """How much of the guide's relief on the ring is the scene's: 1 all of it, 0 none.

    Mean differences are left out: a slope is harmonic, so it needs no prior and says nothing about one.
    """
    pairs = []
    for near, far in ((np.s_[:, :-RELIEF], np.s_[:, RELIEF:]), (np.s_[:-RELIEF], np.s_[RELIEF:])):
        both = agreeing[near] & agreeing[far]
        if both.any():
            steps = np.stack([(guide[far] - guide[near])[both], (disparity[far] - disparity[near])[both]])
            pairs.append(steps - steps.mean(axis=1, keepdims=True))
    g, d = np.concatenate([np.zeros((2, 0)), *pairs], axis=1)
    if (g**2).sum() <= 1e-12 * (guide[agreeing] ** 2).sum():
        return 0.0
    correlation = float((g * d).sum() / np.sqrt((g**2).sum() * max((d**2).sum(), 1e-300)))
    gain = float((g * d).sum() / (g**2).sum())
    return min(max(gain, 0.0), MOST) * min(1.0, max(correlation, 0.0) / FULL) ** 2


def _certain_relief(guide: np.ndarray, hole: np.ndarray, sigma: float) -> float:
    """How much of the guide's relief in the hole its error leaves: 1 all of it, 0 none."""
    there = hole & np.isfinite(guide)
    if not there.any():
        return 0.0
    open_ = hole | ~np.isfinite(guide)
    relief = (guide - solve_poisson(open_, ~open_, guide).values)[there]
    variance = float(np.mean(relief**2))
    return max(0.0, 1 - DOUBT * sigma**2 / variance) if variance > 0 else 0.0
