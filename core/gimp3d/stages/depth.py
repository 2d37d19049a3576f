"""The surface behind the object: completing the reference's disparity (paper 3.3, METHOD section 3)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
import scipy.ndimage

from ..errors import IllPosed
from ..priors.monodepth import DepthPrior, relative_disparity
from ..solvers.planes import PlaneSettings, Surface, planar_surfaces
from ..solvers.poisson import solve_poisson
from ..solvers.thin_plate import ThinPlateSettings, thin_plate
from .depth_evidence import DepthEvidence, DepthEvidenceSettings, gather_depth_evidence, pushed_back, seen_past
from .layers import LayerSettings, background_rim, distance_to, divided, separated
from .masks import ViewMasks

SHOWN = 1500  # pairs of gradients kept for the fit's picture


@dataclass(frozen=True)
class DepthSettings:
    """Lengths in pixels; differences of disparity are relative to the disparity itself."""

    # "auto": planes where the ring lies on planes, else smooth; "planar", "smooth" (thin plate), "harmonic" insist
    surface: str = "auto"
    planes: PlaneSettings = PlaneSettings()
    plate: ThinPlateSettings = ThinPlateSettings()
    layers: LayerSettings = LayerSettings()
    evidence: DepthEvidenceSettings = DepthEvidenceSettings()
    plane_share: float = 0.65  # of the ring that must lie on planes
    plane_trust: float = 1.1  # planes are taken if they miss a withheld band by this many times a plate's miss
    smoothing: float = 12.0  # σ of the average of what the ring deviates from a plane
    skin: float = 1.5  # width of the part of the ring next to the hole that the object's haze bends
    withheld: int = 12  # width of the band by which planes and plate are compared
    plate_ring: int = 12  # width of the ring that a plate continues
    scale_factor: float | None = None  # s_f; None: measured on the ring. The paper uses 0.1
    ring: int = 12  # width of the ring on which s_f is measured
    gradient_step: int = 6  # differences over this distance suffer least from a prior's noise (research, K2)
    minimum_ring: int = 10  # ring pixels below which nothing can be measured
    minimum_correlation: float = 0.2  # between the prior's and the scene's gradients
    full_correlation: float = 0.7  # from which the measured s_f is used whole; below, its square shares it
    low: float = 0.25  # completed disparities are clamped to [low · ring's least, high · ring's greatest]
    high: float = 4.0
    expected: float = 0.02  # relative error at which a pixel's confidence is one half


@dataclass(frozen=True)
class DepthCompletion:
    """A completed disparity map."""

    disparity: np.ndarray  # [H, W] float32; 0 = infinitely far or nothing
    depth: np.ndarray  # [H, W] float32 z-depth; 0 where disparity is 0
    trust: np.ndarray  # [H, W] float32, each pixel's confidence; 1 off the hole
    scale_factor: float  # s_f used; 0 = no guidance
    gradients: np.ndarray  # [N, 2] float32 (prior's, scene's) differences on the ring that s_f was measured by
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
    surface that views do see past is pushed back along its rays to where they do not, and completed again with those
    places as data. What is contradicted even then is counted and has low confidence.

    Raises
    ------
    IllPosed
        As `complete_disparity`.
    """
    relative = None if prior is None else relative_disparity(prior, disparity, known)
    evidence = gather_depth_evidence(view, views, settings.evidence)

    def complete(evidence: DepthEvidence | None) -> DepthCompletion:
        return complete_disparity(disparity, known, view.target, relative, settings, evidence)

    def past(completed: DepthCompletion, where: np.ndarray) -> np.ndarray:
        return seen_past(view.camera, completed.depth, where, views, settings.evidence)

    done = complete(None)
    behind = (evidence.weight > 0) & (evidence.disparity < (1 - settings.layers.step) * done.disparity)
    evidence = _without(evidence, behind & ~past(done, behind))
    if (evidence.weight > 0).any():
        done = complete(evidence)
    contradicted = past(done, view.target)
    pushed = int(contradicted.sum())
    if pushed:
        moved = pushed_back(view.camera, done.depth, contradicted, views, settings.evidence)
        taken = moved > 0
        evidence = DepthEvidence(
            np.where(contradicted & taken, 1 / np.where(taken, moved, 1), evidence.disparity).astype(np.float32),
            np.where(contradicted & taken, 1, evidence.weight).astype(np.float32),
        )
        done = complete(evidence)
        contradicted = past(done, view.target)
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
    natural boundaries elsewhere; the printed divergence has the opposite sign (METHOD section 3). Without one, planes
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
        return _completion(scene, hole, PriorFit(0.0, 0.0, 1.0, "nothing to fill"), np.ones(hole.shape), 0)
    weight = np.zeros(hole.shape)
    if evidence is not None:
        usable = hole & np.isfinite(evidence.disparity) & (evidence.disparity > 0) & (evidence.weight > 0)
        weight[usable], scene[usable] = evidence.weight[usable], evidence.disparity[usable]
    anchored = bool((trusted & scipy.ndimage.binary_dilation(hole)).any() or weight.any())
    window = _window(hole, settings.planes.ring + 1) if anchored else np.s_[:, :]
    around, inside = scene[window], hole[window]
    rim = background_rim(around, trusted[window], inside, settings.layers)
    problem = _Problem(around, rim, inside, weight[window], distance_to(inside))
    if prior is not None:
        fit = fit_prior(around, problem.measured, inside, prior[window], settings, on_ring=anchored)
        plan = _Plan(fit, _layers(problem, (), False, settings), "harmonic", prior[window] if fit.scale else None)
    else:
        plan = _plan(problem, settings, anchored)
    if not anchored and plan.prior is None:
        raise IllPosed("depth: the hole has no rim of known depth; choose a reference that shows more surroundings")
    missed = _withheld_miss(problem, plan, np.any([layer.on for layer in plan.layers], axis=0), settings)
    filled, clamped, fit = _settle(_fill(problem, plan, settings), problem, plan.fit, settings)
    scene[window] = np.where(inside, filled, around)
    trust = np.ones(hole.shape)
    trust[window] = _trust(problem, missed, fit, settings)
    return _completion(scene, hole, fit, trust, clamped)


@dataclass(frozen=True)
class PriorFit:
    """How a relative prior turns into the scene's disparity: scale · prior + shift. Scale 0: not at all."""

    scale: float  # s_f
    shift: float  # matters only where the hole has no rim
    confidence: float
    reason: str
    gradients: np.ndarray = field(default_factory=lambda: np.zeros((0, 2), np.float32))  # [N, 2] (prior's, scene's)


def fit_prior(
    disparity: np.ndarray,  # [H, W]
    known: np.ndarray,  # [H, W] bool
    hole: np.ndarray,  # [H, W] bool
    prior: np.ndarray,  # [H, W] relative disparity
    settings: DepthSettings = DepthSettings(),
    on_ring: bool = True,  # else on everything known
) -> PriorFit:
    """Measure s_f by least squares between gradients on the ring (METHOD section 3).

    Mean gradients are left out: a slope is harmonic, so it needs no prior and says nothing about one. With a noisy
    prior the best s_f is below the true gain, which is what least squares gives; where ring and prior agree poorly it
    is lowered further, so that guidance hardly ever does worse than none. 0 where the prior says nothing: too few
    pixels, no variance, no or negative agreement.
    """
    ring = known & (disparity > 0) & np.isfinite(prior)
    if on_ring:
        ring &= distance_to(hole) <= settings.ring
    k, pairs = settings.gradient_step, []
    for near, far in ((np.s_[:, :-k], np.s_[:, k:]), (np.s_[:-k], np.s_[k:])):
        both = ring[near] & ring[far]
        if both.any():
            steps = np.stack([(prior[far] - prior[near])[both], (disparity[far] - disparity[near])[both]])
            pairs.append(steps - steps.mean(axis=1, keepdims=True))
    m, d = np.concatenate([np.zeros((2, 0)), *pairs], axis=1)
    if len(m) < settings.minimum_ring:
        return PriorFit(0.0, 0.0, 0.3, "harmonic: too little is known round the hole to scale the prior")
    shown = np.stack([m, d], -1)[:: max(1, len(m) // SHOWN)].astype(np.float32)

    def fitted(scale: float, confidence: float, reason: str) -> PriorFit:
        shift = float(np.median((disparity - scale * prior)[ring])) if scale else 0.0
        return PriorFit(scale, shift, confidence, reason, shown)

    if settings.scale_factor is not None:
        return fitted(settings.scale_factor, 0.5, f"guided, s_f = {settings.scale_factor:g} as set")
    if (m**2).mean() < 1e-12 * max(float(np.abs(prior[ring]).max()) ** 2, 1e-300):
        return fitted(0.0, 0.3, "harmonic: the prior is constant round the hole")
    correlation = float((m * d).sum() / np.sqrt((m**2).sum() * max((d**2).sum(), 1e-300)))
    if correlation < settings.minimum_correlation:
        return fitted(0.0, 0.3, f"harmonic: the prior does not fit the scene (correlation {correlation:.2f})")
    share = min(1.0, correlation / settings.full_correlation) ** 2
    scale = share * float((m * d).sum() / (m**2).sum())
    return fitted(scale, correlation, f"guided, s_f = {scale:.3g} measured on the ring (correlation {correlation:.2f})")


@dataclass(frozen=True)
class _Problem:
    """A hole and what is measured round and in it."""

    disparity: np.ndarray  # [H, W] float64: the scene's on the rim, the evidence's in the hole
    rim: np.ndarray  # [H, W] bool, known pixels of the background
    hole: np.ndarray  # [H, W] bool
    weight: np.ndarray  # [H, W] of the evidence in the hole, 0 = none
    distance: np.ndarray  # [H, W] px to the hole

    @property
    def measured(self) -> np.ndarray:
        """[H, W] bool: the background's known pixels, and evidence."""
        return self.rim | (self.weight > 0)

    @property
    def touching(self) -> np.ndarray:
        """[H, W] bool: what bounds the hole's unknown pixels."""
        return (self.rim & scipy.ndimage.binary_dilation(self.hole)) | (self.weight > 0)


@dataclass(frozen=True)
class _Layer:
    """A surface that goes on behind the object."""

    on: np.ndarray  # [H, W] bool, measured pixels that lie on it
    surface: Surface | None = None  # its planes, if it has some


@dataclass(frozen=True)
class _Plan:
    """How a hole is to be filled."""

    fit: PriorFit
    layers: list[_Layer]
    kind: str  # of layers that are not planar: smooth | harmonic
    prior: np.ndarray | None = None  # [H, W] guidance of harmonic layers


def _plan(problem: _Problem, settings: DepthSettings, anchored: bool) -> _Plan:
    """Planes, a thin plate or a membrane, as the settings say; "auto" takes what misses a withheld band by less."""
    kind = "harmonic" if settings.surface == "harmonic" else "smooth"
    words = "harmonic" if kind == "harmonic" else "smooth: the surroundings' slopes are continued"
    plain = _Plan(PriorFit(0.0, 0.0, 1.0, words), _layers(problem, (), kind == "smooth", settings), kind)
    if settings.surface not in ("auto", "planar") or not anchored:
        return plain
    planar = planar_surfaces(problem.disparity, problem.measured, problem.distance, settings.planes)
    if planar.share < settings.plane_share:
        if settings.surface == "planar":
            raise IllPosed(f"depth: only {planar.share:.0%} of the surroundings lie on planes; use --depth-prior auto")
        return plain
    planes = _Plan(PriorFit(0.0, 0.0, 1.0, planar.reason), _layers(problem, planar.surfaces, True, settings), kind)
    if settings.surface == "planar":
        return planes
    on_planes = np.any([layer.on for layer in planes.layers if layer.surface is not None], axis=0)
    misses = [_withheld_miss(problem, p, on_planes, settings) for p in (planes, plain)]
    return plain if misses[0] > settings.plane_trust * misses[1] else planes


def _layers(problem: _Problem, surfaces: tuple[Surface, ...], split: bool, settings: DepthSettings) -> list[_Layer]:
    """The planar surfaces, the sky, and what of the surroundings lies on none of them, parted at steps."""
    d = problem.disparity
    sky = problem.measured & (d == 0)
    if not surfaces and (sky & problem.touching).any():
        surfaces = (Surface(np.zeros(d.shape), sky, 0),)
    index = np.where(problem.measured, len(surfaces), -1)
    for k, surface in reversed(list(enumerate(surfaces))):
        step = settings.layers.step * np.maximum(d, surface.disparity)
        index[problem.measured & (np.abs(d - surface.disparity) <= step)] = k
    layers = [_Layer(index == k, surface) for k, surface in enumerate(surfaces)]
    loose = index == len(surfaces)
    touching = problem.touching
    if (loose & touching).any() and (
        not surfaces or (loose & touching).sum() >= settings.layers.least * touching.sum()
    ):
        parts = separated(d, loose, loose & touching, settings.layers) if split else [loose]
        layers += [_Layer(part) for part in parts]
    return layers


def _fill(problem: _Problem, plan: _Plan, settings: DepthSettings) -> np.ndarray:
    """Disparity [H, W] float64 of the hole, NaN where nothing says anything."""
    seeds = np.full(problem.hole.shape, -1)
    touching = problem.touching
    for k, layer in enumerate(plan.layers):
        seeds[layer.on & touching] = k
    near = problem.distance <= settings.planes.ring
    part = divided(problem.hole, seeds, [layer.on & near for layer in plan.layers], settings.layers)
    filled = np.full(problem.hole.shape, np.nan)
    for k, layer in enumerate(plan.layers):
        own = problem.hole & (part == k)
        if own.any():
            filled[own] = _fill_layer(problem, plan, layer, own, settings)[own]
    if not plan.layers and plan.prior is not None:
        filled = _guided(problem, problem.hole, plan, np.zeros_like(problem.hole))
    return filled


def _fill_layer(problem: _Problem, plan: _Plan, layer: _Layer, own: np.ndarray, settings: DepthSettings) -> np.ndarray:
    if layer.surface is not None:
        return layer.surface.disparity + _deviation(problem, layer, layer.surface, own, settings)
    if plan.kind == "smooth":
        near = layer.on & (problem.distance <= settings.plate_ring)
        clean = near & ((problem.distance >= settings.skin) | problem.hole)
        taken = clean if clean.sum() >= settings.minimum_ring else near
        weight = np.where(problem.hole, problem.weight, 1.0) * taken
        return thin_plate(problem.disparity, weight, own | near, settings.plate)
    return _guided(problem, own, plan, layer.on)


def _guided(problem: _Problem, own: np.ndarray, plan: _Plan, on: np.ndarray) -> np.ndarray:
    """Paper 3.3 by two solves that give every s_f (METHOD section 3): d = L[d_g] + s_f (d_m − L[d_m])."""
    prior = np.zeros(own.shape) if plan.prior is None else plan.prior
    zero = np.zeros(own.shape)
    solution = solve_poisson(
        own,
        on & problem.rim,
        np.stack([problem.disparity, zero], -1),
        np.stack([zero, prior], -1) if plan.prior is not None else None,
        weight=problem.weight * on,
        anchor=np.stack([problem.disparity, zero], -1),
    )
    base, detail = np.moveaxis(solution.values, -1, 0)
    if plan.prior is None:
        return base
    return base + plan.fit.scale * detail + np.where(solution.unanchored, plan.fit.shift, 0.0)


def _deviation(
    problem: _Problem, layer: _Layer, surface: Surface, own: np.ndarray, settings: DepthSettings
) -> np.ndarray:
    """[H, W]: what the ring deviates from the surface, averaged along it and extended harmonically into the hole.

    The pixels that touch the hole are biased by the object's haze: averaging over the whole ring is 4 to 6 times as
    accurate as meeting them exactly, measured on scenes with known truth.
    """
    on = (surface.on & problem.measured & layer.on).astype(np.float64)
    weight = cv2.GaussianBlur(on, (0, 0), settings.smoothing)
    total = cv2.GaussianBlur(on * (problem.disparity - surface.disparity), (0, 0), settings.smoothing)
    average = np.divide(total, weight, out=np.zeros_like(total), where=weight > 0.01)
    rim = layer.on & problem.rim & (weight > 0.01)
    return np.nan_to_num(solve_poisson(own, rim, average, weight=problem.weight * layer.on, anchor=average).values)


def _withheld_miss(problem: _Problem, plan: _Plan, where: np.ndarray, settings: DepthSettings) -> float:
    """Mean relative error of a plan on the band next to the hole when only what lies farther out is told, its best 80 %.

    NaN where too little is left to tell.
    """
    band = problem.rim & (problem.distance <= settings.withheld) & (problem.disparity > 0)
    wider = problem.hole | (problem.distance <= settings.withheld) & ~(problem.rim & ~band)
    held = replace(problem, rim=problem.rim & ~band, hole=wider, distance=distance_to(wider))
    tested = band & (problem.distance >= settings.skin) & where
    if min(held.rim.sum(), tested.sum()) < settings.minimum_ring:
        return float("nan")
    layers = [replace(layer, on=layer.on & ~band) for layer in plan.layers]
    found = _fill(held, replace(plan, layers=layers), settings)[tested]
    errors = np.sort(np.minimum(np.nan_to_num(np.abs(found / problem.disparity[tested] - 1), nan=1.0), 1.0))
    return float(errors[: round(0.8 * len(errors))].mean())  # things that stand about are no test of what lies behind


def _trust(problem: _Problem, missed: float, fit: PriorFit, settings: DepthSettings) -> np.ndarray:
    """[H, W]: each pixel's confidence, from the miss on a withheld band and the distance to what is measured."""
    far = cv2.distanceTransform((~problem.measured).astype(np.uint8), cv2.DIST_L2, 5)
    expected = (settings.expected if np.isnan(missed) else missed) * (0.5 + far / settings.withheld)
    return np.where(problem.hole, fit.confidence / (1 + expected / settings.expected), 1.0)


def _settle(
    filled: np.ndarray, problem: _Problem, fit: PriorFit, settings: DepthSettings
) -> tuple[np.ndarray, int, PriorFit]:
    """Every pixel decided and kept to the ring's range: (disparity, pixels clamped, the fit with what that costs)."""
    undecided = problem.hole & ~np.isfinite(filled)
    if undecided.any():
        nearest = scipy.ndimage.distance_transform_edt(~problem.measured, return_distances=False, return_indices=True)
        filled = np.where(undecided, problem.disparity[tuple(nearest)], filled)
        words = f"{fit.reason}; a part of the hole has no rim: nearest depth used"
        fit = replace(fit, confidence=min(fit.confidence, 0.3), reason=words)
    ring = problem.measured & (problem.distance <= settings.layers.band)
    around = problem.disparity[ring if ring.any() else problem.measured]
    finite = around[around > 0]
    low, high = (settings.low * finite.min(), settings.high * finite.max()) if len(finite) else (0.0, 0.0)
    if (around == 0).any():  # where the ring shows sky, so far means infinitely far
        filled = np.where(filled < low, 0.0, filled)
        low = 0.0
    clamped = int((problem.hole & ((filled < low) | (filled > high))).sum())
    if clamped > 0.05 * problem.hole.sum():
        words = f"{fit.reason}; {clamped} pixels clamped to the ring's range"
        fit = replace(fit, confidence=0.5 * fit.confidence, reason=words)
    return np.clip(filled, low, high), clamped, fit


def _completion(
    disparity: np.ndarray, hole: np.ndarray, fit: PriorFit, trust: np.ndarray, clamped: int
) -> DepthCompletion:
    disparity = disparity.astype(np.float32)
    depth = np.divide(1, disparity, out=np.zeros_like(disparity), where=disparity > 0)
    confidence = float(trust[hole].mean()) if hole.any() else fit.confidence
    return DepthCompletion(
        disparity, depth, trust.astype(np.float32), fit.scale, fit.gradients, clamped, 0, confidence, fit.reason
    )


def _window(hole: np.ndarray, margin: int) -> tuple[slice, slice]:
    """The hole's bounding box and what is round it."""
    rows, cols = np.flatnonzero(hole.any(1)), np.flatnonzero(hole.any(0))
    return (
        slice(max(rows[0] - margin, 0), rows[-1] + margin + 1),
        slice(max(cols[0] - margin, 0), cols[-1] + margin + 1),
    )
