"""The surface behind the object: completing the reference's disparity (paper 3.3; docs/method.md)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.ndimage

from ...errors import IllPosed
from ...geometry import bounds
from ...priors.monodepth import DepthPrior, relative_disparity
from ...solvers.planes import RING
from ...solvers.poisson import solve_poisson
from ..masks import ViewMasks
from .evidence import AGREEMENT, DepthEvidence, gather_depth_evidence
from .fill import HOLD_OUT, DepthSettings, Measured, choose_plan, fill, hold_out_miss
from .layers import AROUND, BAND, background_rim, distance_to, without_front
from .prior import PriorFit, fit_prior

LEAST_ISLAND = 0.02  # share of the hole that evidence must hold to stand alone before the surface
MOSTLY = 0.5  # share of a part of the ring that must be below what other views see there for it to be a leak
# Times the miss of a hold-out band without a prior, at which it is believed by half: as its fit allows, or anyhow
PRIOR_MISS, PRIOR_GAIN = 3.0, 0.8
LOW, HIGH = 0.25, 4.0  # completed disparities are clamped to [LOW · ring's least, HIGH · ring's greatest]
LARGE = 0.05  # share of the hole or of a part of it that has a say in the confidence
EXPECTED = 0.02  # relative error at which a pixel's confidence is one half


@dataclass(frozen=True)
class DepthCompletion:
    """A completed disparity map."""

    disparity: np.ndarray  # [H, W] float32; 0 = infinitely far or nothing
    depth: np.ndarray  # [H, W] float32 z-depth; 0 where disparity is 0
    trust: np.ndarray  # [H, W] float32, each pixel's confidence; 1 off the hole
    scale_factor: float  # s_f used; 0 = no guidance
    ring: np.ndarray  # [N, 2] float32 (prior, scene's disparity) of ring pixels, to which s_f was fitted
    line: tuple[float, float]  # (slope, offset) of that fit; s_f is the slope as far as the prior is believed
    clamped: int  # pixels whose disparity had to be clamped
    confidence: float  # 0 to 1
    reason: str


def complete_depth(
    view: ViewMasks,  # the reference
    views: Sequence[ViewMasks],  # all views; what they measured in the reference's hole is soft data
    disparity: np.ndarray,  # [H, W] float32, the reference's without the object
    known: np.ndarray,  # [H, W] bool, where that is trusted
    prior: DepthPrior | None = None,
    settings: DepthSettings = DepthSettings(),
) -> DepthCompletion:
    """Complete a view's depth (`complete_disparity`) with what other views saw of the hole.

    Evidence clearly behind the surface that the surroundings tell is seen from under it, and dropped. Round the hole,
    pixels whose depth falls through a surface that other views agree on are not trusted: scans have leaks.
    Raises IllPosed as `complete_disparity` does.
    """
    known = without_front(disparity, known, view.target, view.occluder, settings.layer_step)
    ring = known & (distance_to(view.target) <= RING)
    measured = gather_depth_evidence(view, views, ring)
    fallen = ring & (disparity < (1 - AGREEMENT) * measured.disparity)
    known = without_front(disparity, known, view.target, fallen, settings.layer_step, MOSTLY) & ~fallen
    evidence = _without(measured, ~view.target)
    relative = None if prior is None else relative_disparity(prior, disparity, known)

    def complete(evidence: DepthEvidence | None) -> DepthCompletion:
        return complete_disparity(disparity, known, view.target, relative, settings, evidence)

    done = complete(None)
    evidence = _without(evidence, evidence.disparity < (1 - settings.layer_step) * done.disparity)
    evidence = _without(evidence, _remains(evidence, done.disparity, view.target, settings))
    if not (evidence.weight > 0).any():
        return done
    done = complete(evidence)
    seen = float((evidence.weight > 0).sum() / max(1, view.target.sum()))
    words = f"; {seen:.0%} of the hole measured by other views" if seen >= 0.005 else ""
    return replace(done, reason=done.reason + words)


def _remains(evidence: DepthEvidence, disparity: np.ndarray, hole: np.ndarray, settings: DepthSettings) -> np.ndarray:
    """[H, W] bool: small islands of evidence before the completed surface: splats of the object that were kept."""
    before = (evidence.weight > 0) & (evidence.disparity > (1 + settings.layer_step / 2) * disparity)
    islands, count = scipy.ndimage.label(scipy.ndimage.binary_dilation(before, AROUND), AROUND)
    area = np.bincount(islands[before], minlength=count + 1)
    beside_rim = np.bincount(islands[~hole], minlength=count + 1) > 0
    return before & (area < LEAST_ISLAND * hole.sum())[islands] & ~beside_rim[islands]


def _without(evidence: DepthEvidence, dropped: np.ndarray) -> DepthEvidence:
    return DepthEvidence(np.where(dropped, 0, evidence.disparity), np.where(dropped, 0, evidence.weight))


def complete_disparity(
    disparity: np.ndarray,  # [H, W] float32, 1/z of the scene, valid where `known`; 0 = infinitely far (sky)
    known: np.ndarray,  # [H, W] bool, Dirichlet pixels
    hole: np.ndarray,  # [H, W] bool, the target region T
    prior: np.ndarray | None = None,  # [H, W] float32 relative disparity, any scale and shift
    settings: DepthSettings = DepthSettings(),
    evidence: DepthEvidence | None = None,  # soft data in the hole
) -> DepthCompletion:
    """Fill a hole in a disparity map.

    With a prior, in the gradient domain (paper 3.3): Δd = s_f Δd_m on the hole with d fixed on its known rim and
    natural boundaries elsewhere; the printed divergence has the opposite sign (docs/method.md). Without one, planes
    on which the surroundings lie are continued (`planar_surfaces`), and what lies on none by a thin plate. Nothing
    smears across layers: rims of occluders are no boundary (`background_rim`), layers that a step parts keep their
    parts of the hole, and so does sky. Evidence screens the solves (Σ_q (d_q − d_p) + w (e − d_p) = …) and takes part
    in telling planes and layers. Known pixels that are NaN, infinite or negative are not known. A part of the hole
    that has no rim takes the prior, aligned to the ring, or the nearest depth.

    Raises IllPosed if the hole has no known rim at all and no prior that fits what is known; or if planes were insisted
    on and there are none.
    """
    with np.errstate(invalid="ignore"):
        trusted = known & ~hole & np.isfinite(disparity) & (disparity >= 0)
    scene = np.where(trusted, disparity, 0.0).astype(np.float64)
    if not hole.any():
        return _completion(scene, PriorFit(0.0, 0.0, 1.0, "nothing to fill"), np.ones(hole.shape), 0)
    weight = np.zeros(hole.shape)
    if evidence is not None:
        usable = hole & np.isfinite(evidence.disparity) & (evidence.disparity > 0) & (evidence.weight > 0)
        weight[usable], scene[usable] = evidence.weight[usable], evidence.disparity[usable]
    around = Measured(scene, background_rim(scene, trusted, hole, settings.layer_step), hole, weight)
    guide, fit, sources = None, PriorFit(0.0, 0.0, 1.0, ""), [trusted]
    if prior is not None:
        fit = fit_prior(scene, around.measured, hole, prior, settings, on_ring=bool(around.touching.any()))
        if fit.scale:
            gaps = ~np.isfinite(prior)
            whole = solve_poisson(gaps, ~gaps, prior).values
            guide, sources = fit.scale / fit.believed * whole, [trusted, trusted & fit.agrees(prior, scene)]
    if guide is None and not around.touching.any():
        raise IllPosed("depth: the hole has no rim of known depth; choose a reference that shows more surroundings")
    result, trust = scene.copy(), np.ones(hole.shape)
    done: list[_Part] = []
    for part in _parts(hole, settings.small_part):
        near = (trusted & scipy.ndimage.binary_dilation(part)).any() or weight[part].any()
        window = bounds(part, RING + 1) if near else np.s_[:, :]
        inside, evident = part[window], (weight * part)[window]
        rims = [background_rim(scene[window], a[window], inside, settings.layer_step) for a in sources]
        alone = Measured(scene[window], rims[0], inside, evident)
        guided = None if guide is None else replace(alone, rim=rims[1], guide=guide[window])
        own = replace(settings, surface="harmonic") if part.sum() <= settings.small_part else settings
        found = _completed_part(alone, guided, fit, own, first=not done)
        result[window][inside], trust[window][inside] = found.disparity[inside], found.trust[inside]
        done.append(found)
    confidence = min([float(trust[hole].mean()), *(p.sure for p in done if p.pixels > LARGE * hole.sum())])
    reasons = [fit.reason, *(note for part in done for note in part.notes)]
    reason = "; ".join(r for r in dict.fromkeys(reasons) if r)
    used = fit.scale if guide is None else done[0].believed * (fit.scale / fit.believed)
    fit = replace(fit, scale=used, confidence=confidence, reason=reason)
    return _completion(result, fit, trust, sum(part.clamped for part in done))


@dataclass(frozen=True)
class _Part:
    """A connected part of the hole with every pixel decided."""

    disparity: np.ndarray  # [H, W]
    trust: np.ndarray  # [H, W], each pixel's confidence
    pixels: int
    sure: float  # confidence of the whole part, at most
    believed: float  # how much of it is the prior's
    clamped: int  # pixels
    notes: list[str]


def _completed_part(
    alone: Measured, guided: Measured | None, fit: PriorFit, settings: DepthSettings, first: bool
) -> _Part:
    """What is round one part continued into it, with the prior as far as that is believed."""
    around = alone
    if guided is not None:
        around = guided if guided.touching.any() else replace(alone, guide=guided.guide)
    plan = choose_plan(around, settings, insist=first)
    missed, filled = hold_out_miss(around, plan, settings, around.rim), fill(around, plan, settings)
    believed, share, pixels = 0.0, 1.0, int(around.hole.sum())
    notes = [plan.reason] if first else []
    if guided is not None:
        filled, believed = _as_far_as_believed(filled, missed, fit, around, alone, settings)
        if first and believed <= 0.95:
            notes.insert(0, f"prior believed by {believed:.0%}")
    undecided = around.hole & ~np.isfinite(filled)
    if undecided.any() and around.guide is not None:
        filled, share = np.where(undecided, around.guide + fit.shift, filled), 0.5
        notes.append("a part of the hole has no rim: the prior used as it is aligned")
    elif undecided.any():
        nearest = scipy.ndimage.distance_transform_edt(~around.measured, return_distances=False, return_indices=True)
        filled, share = np.where(undecided, around.disparity[tuple(nearest)], filled), 0.3
        notes.append("a part of the hole has no rim: nearest depth used")
    ring = around.measured & (around.distance <= BAND)
    beside = around.disparity[ring if ring.any() else around.measured]
    finite = beside[beside > 0]
    low, high = (LOW * finite.min(), HIGH * finite.max()) if len(finite) else (0.0, 0.0)
    if (beside == 0).any():  # where the ring shows sky, so far means infinitely far
        filled, low = np.where(filled < low, 0.0, filled), 0.0
    clamped = int((around.hole & ((filled < low) | (filled > high))).sum())
    if clamped > LARGE * pixels:
        share *= 0.5
        notes.append(f"{clamped} pixels clamped to the ring's range")
    sure = max(fit.confidence, believed)
    # From the miss on a hold-out band and the distance to what is measured
    expected = (EXPECTED if np.isnan(missed) else missed) * (0.5 + distance_to(around.measured) / HOLD_OUT)
    trust = share * sure * (1 / (1 + expected / EXPECTED))
    return _Part(np.clip(filled, low, high), trust, pixels, min(share, sure), believed, clamped, notes)


def _as_far_as_believed(
    filled: np.ndarray, missed: float, fit: PriorFit, guided: Measured, alone: Measured, settings: DepthSettings
) -> tuple[np.ndarray, float]:
    """The hole with as much of the prior as its fit and its miss on a hold-out band allow, and how much that is.

    `filled` [H, W] is the hole's disparity with the prior, `alone` what is measured without it. The fit tells a prior's
    scale, but not that its error is larger than what planes or a plate miss without it.
    """
    if settings.scale_factor is not None:
        return filled, fit.believed
    plan, believed = choose_plan(alone, settings, insist=False), fit.believed
    if settings.surface not in ("harmonic", "planar"):
        ratio = missed / max(hold_out_miss(alone, plan, settings, guided.rim), 1e-9)
        if not np.isnan(ratio):
            believed = max(believed, _falling(ratio / PRIOR_GAIN)) * _falling(ratio / PRIOR_MISS)
    if believed >= 0.99:
        return filled, 1.0
    return believed * filled + (1 - believed) * fill(alone, plan, settings), believed


def _falling(ratio: float) -> float:
    """From 1 to 0, ½ at a ratio of 1."""
    return 1 / (1 + ratio**8)


def _parts(hole: np.ndarray, small: int) -> list[np.ndarray]:
    """The hole's connected parts, the largest first: each has its own surroundings. Small ones together come last."""
    labels, count = scipy.ndimage.label(hole, AROUND)
    sizes = np.bincount(labels.ravel(), minlength=count + 1)
    sizes[0] = 0
    large = [labels == k for k in np.argsort(-sizes, kind="stable") if sizes[k] > small]
    rest = hole & (sizes[labels] <= small)
    return [*large, rest] if rest.any() else large


def _completion(disparity: np.ndarray, fit: PriorFit, trust: np.ndarray, clamped: int) -> DepthCompletion:
    disparity, trust = disparity.astype(np.float32), trust.astype(np.float32)
    depth = np.divide(1, disparity, out=np.zeros_like(disparity), where=disparity > 0)
    return DepthCompletion(disparity, depth, trust, fit.scale, fit.ring, fit.line, clamped, fit.confidence, fit.reason)
