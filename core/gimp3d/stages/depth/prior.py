"""How a relative depth prior turns into the scene's disparity (docs/method.md)."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ...solvers.poisson import solve_poisson
from ...solvers.robust import CUT, robust_fit
from .fill import LEAST_PIXELS, DepthSettings
from .layers import distance_to

RING = 12  # px, width of the ring round the hole on which s_f is measured
SHOWN = 1500  # ring pixels kept for the fit's picture
RELIEF = 6  # px; differences over this distance tell relief from a prior's smooth errors best (research)
FULL = 0.7  # correlation of relief from which it is believed whole; below, its square shares it
DOUBT = 2.0  # times the variance that the prior's error takes of its relief in the hole
SAME = 1e-3  # relative difference of disparities that is never held against a pixel
LEAST = 0.05  # share of the fitted scale below which a prior says nothing
MOST = 2.0  # times the fitted scale; a prior's errors flatten the fit, which its relief may set right


@dataclass(frozen=True)
class PriorFit:
    """How a relative prior turns into the scene's disparity: scale · prior + shift. Scale 0: not at all."""

    scale: float  # s_f; the prior's own, where it is believed, is scale / believed
    shift: float  # matters only where the hole has no rim
    confidence: float
    reason: str
    ring: np.ndarray = field(default_factory=lambda: np.zeros((0, 2), np.float32))  # [N, 2] (prior, scene's disparity)
    line: tuple[float, float] = (0.0, 0.0)  # (slope, offset) fitted to `ring`
    believed: float = 1.0  # how much of the hole is the prior's; the rest is what is filled in without it
    error: float = float("inf")  # in disparity, beyond which a pixel is not on the line

    def agrees(self, prior: np.ndarray, disparity: np.ndarray) -> np.ndarray:
        """Bool, of any shape: what lies on the line, or what the prior says nothing of."""
        with np.errstate(invalid="ignore"):
            return ~(np.abs(self.line[0] * prior + self.line[1] - disparity) > self.error)


def fit_prior(
    disparity: np.ndarray,  # [H, W]
    known: np.ndarray,  # [H, W] bool
    hole: np.ndarray,  # [H, W] bool
    prior: np.ndarray,  # [H, W] relative disparity, NaN = no value
    settings: DepthSettings = DepthSettings(),
    on_ring: bool = True,  # else on everything known
) -> PriorFit:
    """Measure s_f by a robust affine fit of the scene's disparity to the prior on the ring (docs/method.md).

    The fit tells the prior's units. Whether to follow it into the hole is another question: what a plane tells as well
    needs no prior. It is believed as far as its relief on the ring is the scene's, or as far as its relief in the hole
    is larger than its error on the ring, whichever is more: foliage and the swirls of rough scans drown the first of a
    prior that is right, and smooth errors, which the hole's rim takes away, the second. s_f is 0 where the prior says
    nothing: too few pixels, no variance, a slope ≤ 0.
    """
    ring = known & (disparity > 0) & np.isfinite(prior)
    if on_ring:
        ring &= distance_to(hole) <= RING
    m, d = prior[ring].astype(np.float64), disparity[ring].astype(np.float64)
    if len(m) < LEAST_PIXELS:
        return PriorFit(0.0, 0.0, 0.3, "prior not used, too little is known round the hole to scale it")
    shown = np.stack([m, d], -1)[:: max(1, len(m) // SHOWN)].astype(np.float32)

    def unused(line: tuple[float, float], reason: str) -> PriorFit:
        return PriorFit(0.0, 0.0, 0.3, f"prior not used, {reason}", shown, line)

    if settings.scale_factor is not None:
        scale = settings.scale_factor
        shift = float(np.median(d - scale * m))
        return PriorFit(scale, shift, 0.5, f"guided, s_f = {scale:g} as set", shown, (scale, shift))
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
    scale, believed = share * line[0], min(1.0, share)
    shift = float(np.median(d - scale / believed * m))
    words = f"guided, {line[0]:.3g} × the prior is the disparity round the hole to {off:.1%}"
    return PriorFit(scale, shift, max(0.3, believed), words, shown, line, believed, error)


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
