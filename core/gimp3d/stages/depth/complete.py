"""The surface behind the object: completing the reference's disparity (paper 3.3; docs/method.md)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import scipy.ndimage

from ...errors import IllPosed
from ...geometry import bounds
from ...priors.monodepth import DepthPrior, relative_disparity
from ...solvers.planes import RING
from ...solvers.poisson import solve_poisson
from ..masks import ViewMasks
from .evidence import AGREEMENT, DepthEvidence, free_space, gather_depth_evidence
from .fill import WITHHELD, DepthSettings, Surroundings, choose_plan, fill, surroundings, withheld_miss
from .layers import AROUND, BAND, distance_to, without_front
from .prior import PriorFit, fit_prior

LEAST_ISLAND = 0.02  # share of the hole that evidence must hold to stand alone before the surface
MOSTLY = 0.5  # share of a part of the ring that must be below what other views see there for it to be a leak
# Times the miss of a withheld band without a prior, at which it is believed by half: as its fit allows, or anyhow
PRIOR_MISS, PRIOR_GAIN = 3.0, 0.8
LOW, HIGH = 0.25, 4.0  # completed disparities are clamped to [LOW · ring's least, HIGH · ring's greatest]
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
    contradicted: int  # pixels that other views see past
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

    Evidence clearly behind a surface that no view sees past is seen from under that surface, and dropped. A completed
    surface that views do see past is pushed back along its rays to where they do not. What is contradicted even then
    is counted and has low confidence. Round the hole, pixels whose depth falls through a surface that other views agree
    on are not trusted: scans have leaks.

    Raises
    ------
    IllPosed
        As `complete_disparity`.
    """
    known = without_front(disparity, known, view.target, view.occluder, step=settings.layer_step)
    ring = known & (distance_to(view.target) <= RING)
    measured = gather_depth_evidence(view, views, ring)
    fallen = ring & (disparity < (1 - AGREEMENT) * measured.disparity)
    known = without_front(disparity, known, view.target, fallen, MOSTLY, settings.layer_step) & ~fallen
    evidence = _without(measured, ~view.target)
    relative = None if prior is None else relative_disparity(prior, disparity, known)
    space = free_space(view, views, ring & known)

    def complete(evidence: DepthEvidence | None) -> DepthCompletion:
        return complete_disparity(disparity, known, view.target, relative, settings, evidence)

    done = complete(None)
    behind = (evidence.weight > 0) & (evidence.disparity < (1 - settings.layer_step) * done.disparity)
    evidence = _without(evidence, behind & ~space.seen_past(done.depth, behind))
    evidence = _without(evidence, _remains(evidence, done.disparity, view.target, settings))
    if (evidence.weight > 0).any():
        done = complete(evidence)
    contradicted = space.seen_past(done.depth, view.target)
    pushed = int(contradicted.sum())
    if pushed:
        moved = space.pushed_back(done.depth, contradicted)
        there = moved > 0
        depth = np.where(there, moved, done.depth)
        done = replace(done, depth=depth, disparity=np.divide(1, depth, out=done.disparity.copy(), where=there))
        contradicted &= ~there
    left = int(contradicted.sum())
    seen = float((evidence.weight > 0).sum() / max(1, view.target.sum()))
    words = [done.reason]
    if seen >= 0.005:
        words.append(f"{seen:.0%} of the hole measured by other views")
    if pushed:
        words.append(f"{pushed} pixels pushed back from where other views see through, {left} left")
    share = left / max(1, view.target.sum())
    return replace(
        done,
        trust=np.where(contradicted, np.minimum(done.trust, 0.1), done.trust),
        contradicted=left,
        confidence=done.confidence * (1 - share),
        reason="; ".join(words),
    )


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

    Raises
    ------
    IllPosed
        If the hole has no known rim at all and no prior that fits what is known; or if planes were insisted
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
    around = surroundings(scene, trusted, hole, weight, settings)
    guide, fit, on_line = None, PriorFit(0.0, 0.0, 1.0, ""), trusted
    if prior is not None:
        fit = fit_prior(scene, around.measured, hole, prior, settings, on_ring=bool(around.touching.any()))
        if fit.scale:
            guide, on_line = fit.guide_scale * _without_gaps(prior), trusted & fit.agrees(prior, scene)
    if guide is None and not around.touching.any():
        raise IllPosed("depth: the hole has no rim of known depth; choose a reference that shows more surroundings")
    result, trust = scene.copy(), np.ones(hole.shape)
    done: list[_Settled] = []
    most_sure, used = 1.0, fit.scale
    reasons: list[str] = [fit.reason]
    for part in _parts(hole, settings.small_part):
        near = (trusted & scipy.ndimage.binary_dilation(part)).any() or weight[part].any()
        window = bounds(part, RING + 1) if near else np.s_[:, :]
        inside, evident = part[window], (weight * part)[window]
        around = surroundings(scene[window], trusted[window], inside, evident, settings)
        own = replace(settings, surface="harmonic" if part.sum() <= settings.small_part else settings.surface)
        sure = fit.confidence
        if guide is None:
            plan = choose_plan(around, own, insist=not done)
            missed, filled = withheld_miss(around, plan, settings, around.rim), fill(around, plan, settings)
        else:
            guided = surroundings(scene[window], on_line[window], inside, evident, settings, guide[window])
            if not guided.touching.any():
                guided = replace(around, guide=guide[window])
            plan = choose_plan(guided, own)
            missed = withheld_miss(guided, plan, settings, guided.rim)
            filled, believed = _as_far_as_believed(fill(guided, plan, settings), missed, fit, guided, around, own)
            if not done:  # the largest part's
                used = believed * fit.guide_scale
                reasons.append("" if believed > 0.95 else f"prior believed by {believed:.0%}")
            around, sure = guided, max(sure, believed)
        settled = _settle(filled, around, fit.shift)
        result[window][inside] = settled.disparity[inside]
        trust[window][inside] = (settled.share * sure * _trust(around, missed))[inside]
        reasons += [*([] if done else [plan.reason]), *settled.notes]
        done.append(settled)
        if part.sum() > 0.05 * hole.sum():
            most_sure = min(most_sure, settled.share, sure)
    confidence = min(float(trust[hole].mean()), most_sure)
    reason = "; ".join(r for r in dict.fromkeys(reasons) if r)
    clamped = sum(s.clamped for s in done)
    return _completion(result, replace(fit, scale=used, confidence=confidence, reason=reason), trust, clamped)


def _as_far_as_believed(
    filled: np.ndarray,  # [H, W] the hole's disparity with the prior
    missed: float,  # by it on the withheld band
    fit: PriorFit,
    guided: Surroundings,
    alone: Surroundings,  # without the prior
    settings: DepthSettings,
) -> tuple[np.ndarray, float]:
    """The hole with as much of the prior as its fit and its miss on a withheld band allow, and how much that is.

    The fit tells a prior's scale, but not that its error is larger than what planes or a plate miss without it.
    """
    if settings.scale_factor is not None:
        return filled, fit.believed
    plan, believed = choose_plan(alone, settings, insist=False), fit.believed
    if settings.surface not in ("harmonic", "planar"):
        ratio = missed / max(withheld_miss(alone, plan, settings, guided.rim), 1e-9)
        if not np.isnan(ratio):
            believed = max(believed, _falling(ratio / PRIOR_GAIN)) * _falling(ratio / PRIOR_MISS)
    if believed >= 0.99:
        return filled, 1.0
    return believed * filled + (1 - believed) * fill(alone, plan, settings), believed


def _falling(ratio: float) -> float:
    """From 1 to 0, ½ at a ratio of 1."""
    return 1 / (1 + ratio**8)


def _without_gaps(prior: np.ndarray) -> np.ndarray:
    """The prior with its NaN pixels interpolated."""
    gaps = ~np.isfinite(prior)
    return solve_poisson(gaps, ~gaps, prior).values


def _parts(hole: np.ndarray, small: int) -> list[np.ndarray]:
    """The hole's connected parts, the largest first: each has its own surroundings. Small ones together come last."""
    labels, count = scipy.ndimage.label(hole, AROUND)
    sizes = np.bincount(labels.ravel(), minlength=count + 1)
    sizes[0] = 0
    large = [labels == k for k in np.argsort(-sizes, kind="stable") if sizes[k] > small]
    rest = hole & (sizes[labels] <= small)
    return [*large, rest] if rest.any() else large


def _trust(around: Surroundings, missed: float) -> np.ndarray:
    """[H, W]: each pixel's confidence, from the miss on a withheld band and the distance to what is measured."""
    far = cv2.distanceTransform((~around.measured).astype(np.uint8), cv2.DIST_L2, 5)
    expected = (EXPECTED if np.isnan(missed) else missed) * (0.5 + far / WITHHELD)
    return 1 / (1 + expected / EXPECTED)


@dataclass(frozen=True)
class _Settled:
    """A part of the hole with every pixel decided."""

    disparity: np.ndarray  # [H, W]
    clamped: int
    share: float  # of the confidence that is left
    notes: list[str]


def _settle(filled: np.ndarray, around: Surroundings, shift: float) -> _Settled:
    """Every pixel decided and kept to the ring's range."""
    share, notes = 1.0, []
    undecided = around.hole & ~np.isfinite(filled)
    if undecided.any() and around.guide is not None:
        filled, share = np.where(undecided, around.guide + shift, filled), 0.5
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
        filled = np.where(filled < low, 0.0, filled)
        low = 0.0
    clamped = int((around.hole & ((filled < low) | (filled > high))).sum())
    if clamped > 0.05 * around.hole.sum():
        share *= 0.5
        notes.append(f"{clamped} pixels clamped to the ring's range")
    return _Settled(np.clip(filled, low, high), clamped, share, notes)


def _completion(disparity: np.ndarray, fit: PriorFit, trust: np.ndarray, clamped: int) -> DepthCompletion:
    disparity = disparity.astype(np.float32)
    depth = np.divide(1, disparity, out=np.zeros_like(disparity), where=disparity > 0)
    trust = trust.astype(np.float32)
    return DepthCompletion(
        disparity, depth, trust, fit.scale, fit.ring, fit.line, clamped, 0, fit.confidence, fit.reason
    )
