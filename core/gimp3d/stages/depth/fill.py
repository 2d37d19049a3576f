"""Continuing what is measured round a hole into it: planes, thin plates, membranes."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import cv2
import numpy as np
import scipy.ndimage

from ...errors import IllPosed
from ...schema import Many, Positive, Signed
from ...solvers.planes import INLIER, RING, PlanarPart, planar_surfaces
from ...solvers.poisson import solve_poisson
from ...solvers.thin_plate import UNKNOWNS, thin_plate
from .layers import LEAST_LAYER, STEP, distance_to, divided, separated

PLANE_SHARE = 0.65  # of the ring that must lie on planes for planes to be continued
ROUGH = (1.0, 2.0, 4.0)  # times INLIER, tried until so much does: depths of real scans scatter by 9 %, of made ones 1 %
PLANE_TRUST = 1.4  # planes are taken if they miss a hold-out band by this many times a plate's miss; it bends to noise
AVERAGE = 12.0  # px, σ of the average of what the ring deviates from a plane
SKIN = 1.5  # px, width of the part of the ring next to the hole that the object's haze bends
HOLD_OUT = 12  # px, width of the band by which planes and plate are compared
PLATE_RING = 12  # px, width of the ring that a plate continues
LEAST_PIXELS = 10  # of the ring below which nothing can be measured
KEPT_ERRORS = 0.8  # share of the hold-out band that counts, the best: things that stand about test nothing behind them


@dataclass(frozen=True)
class DepthSettings:
    """How the surface behind the object is continued."""

    # auto: planes where the ring lies on planes, else smooth; planar, smooth (thin plate), harmonic insist
    surface: Literal["auto", "planar", "smooth", "harmonic"] = "auto"  # kind; what is known of the surface
    scale_factor: Signed | None = None  # disparity per unit of the prior, s_f; none: measured (paper: 0.1)
    layer_step: Positive = STEP  # relative step of disparity that parts layers; rough scans against low steps
    unknowns: Many = UNKNOWNS  # of a plate, at most; time against detail
    small_part: Many = 64  # pixels up to which a part of the hole is just interpolated; time against slopes


@dataclass(frozen=True)
class Measured:
    """A hole and what is measured round and in it."""

    disparity: np.ndarray  # [H, W] float64: the scene's on the rim, the evidence's in the hole
    rim: np.ndarray  # [H, W] bool, known pixels of the background (`background_rim`)
    hole: np.ndarray  # [H, W] bool
    weight: np.ndarray  # [H, W] of the evidence in the hole, 0 = none
    guide: np.ndarray | None = None  # [H, W] the prior in the scene's scale; only the difference to it is continued

    @cached_property
    def distance(self) -> np.ndarray:
        """[H, W] px to the hole."""
        return distance_to(self.hole)

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
    surface: PlanarPart | None = None  # its planes, if it has some


@dataclass(frozen=True)
class Plan:
    """How a hole is to be filled."""

    layers: tuple[_Layer, ...]
    kind: str  # of layers that are not planar: smooth | harmonic | averaged (with a guide)
    reason: str


def choose_plan(around: Measured, settings: DepthSettings, insist: bool) -> Plan:
    """Planes, a thin plate or a membrane, as the settings say; "auto" takes what misses a hold-out band by less.

    Raises IllPosed if the settings and `insist` insist on planes and there are none.
    """
    kind = "harmonic" if settings.surface == "harmonic" else "smooth"
    if around.guide is not None:  # it knows of steps itself
        plan = Plan(_layers(around, (), False, settings.layer_step), kind, "")
        if kind == "harmonic":
            return plan
        averaged = replace(plan, kind="averaged")
        misses = [hold_out_miss(around, p, settings, around.rim) for p in (averaged, plan)]
        return averaged if misses[0] < misses[1] else plan
    words = "harmonic" if kind == "harmonic" else "smooth: the surroundings' slopes are continued"
    plain = Plan(_layers(around, (), kind == "smooth", settings.layer_step), kind, words)
    if settings.surface not in ("auto", "planar") or not around.touching.any():
        return plain
    share = 0.0
    for rough in ROUGH:  # a rough scan's table is a plane too, and its lesser steps are noise
        planar = planar_surfaces(around.disparity, around.measured, around.distance, rough * INLIER)
        share = max(share, planar.share)
        if planar.share < PLANE_SHARE:
            continue
        planes = Plan(_layers(around, planar.surfaces, True, rough * settings.layer_step), kind, planar.reason)
        if settings.surface == "planar":
            return planes
        on_planes = np.any([layer.on for layer in planes.layers if layer.surface is not None], axis=0)
        misses = [hold_out_miss(around, plan, settings, on_planes) for plan in (planes, plain)]
        if not misses[0] > PLANE_TRUST * misses[1]:
            return planes
    if settings.surface == "planar" and insist:
        raise IllPosed(f"depth: only {share:.0%} of the surroundings lie on planes; use --depth-prior auto")
    return plain


def _layers(around: Measured, surfaces: tuple[PlanarPart, ...], split: bool, step: float) -> tuple[_Layer, ...]:
    """The planar surfaces, the sky, and what of the surroundings lies on none of them, parted at steps."""
    d = around.disparity
    sky = around.measured & (d == 0)
    if not surfaces and (sky & around.touching).any():
        surfaces = (PlanarPart(np.zeros(d.shape), sky, 0),)
    index = np.where(around.measured, len(surfaces), -1)
    for k, surface in reversed(list(enumerate(surfaces))):
        index[around.measured & (np.abs(d - surface.disparity) <= step * np.maximum(d, surface.disparity))] = k
    layers = [_Layer(index == k, surface) for k, surface in enumerate(surfaces)]
    loose = index == len(surfaces)
    touching = around.touching
    if (loose & touching).any() and (not surfaces or (loose & touching).sum() >= LEAST_LAYER * touching.sum()):
        layers += map(_Layer, separated(d, loose, loose & touching, step) if split else [loose])
    return tuple(layers)


def fill(around: Measured, plan: Plan, settings: DepthSettings) -> np.ndarray:
    """Disparity [H, W] float64 of the hole, NaN where nothing says anything."""
    seeds = np.full(around.hole.shape, -1)
    touching = around.touching
    for k, layer in enumerate(plan.layers):
        seeds[layer.on & touching] = k
    near = around.distance <= RING
    part = divided(around.hole, seeds, [layer.on & near for layer in plan.layers])
    filled = np.full(around.hole.shape, np.nan)
    for k, layer in enumerate(plan.layers):
        own = around.hole & (part == k)
        if not own.any():
            continue
        if layer.surface is None:
            values = _continued(around, layer, own, plan.kind, settings)
        else:
            surface = layer.surface.disparity
            values = surface + _deviation(around, layer, layer.on & layer.surface.on, surface, own)
        filled[own] = values[own]
    return filled


def _continued(around: Measured, layer: _Layer, own: np.ndarray, kind: str, settings: DepthSettings) -> np.ndarray:
    """[H, W]: a layer without planes in its part of the hole. With a guide, its error is what is continued."""
    guide = np.zeros(own.shape) if around.guide is None else around.guide
    values = around.disparity - guide
    weight = np.where(around.hole, around.weight, 1.0) * layer.on
    if kind == "harmonic":
        inside = weight * around.hole
        return guide + solve_poisson(own, layer.on & around.rim, values, weight=inside, anchor=values).values
    if kind == "averaged":
        return guide + _deviation(around, layer, layer.on, guide, own)
    near = layer.on & (around.distance <= PLATE_RING)
    clean = near & ((around.distance >= SKIN) | around.hole)
    taken = clean if clean.sum() >= LEAST_PIXELS else near
    plate = thin_plate(values, weight * taken, own | near, settings.unknowns)
    if not (weight * own).any():
        return guide + plate
    # What only other views saw, a mound or a ledge, is an outlier to the plate; a membrane leads there and back.
    lacking = np.where(around.hole, values - plate, 0.0)
    rest = solve_poisson(own, layer.on & around.rim, lacking, weight=weight * own, anchor=lacking).values
    return guide + plate + np.nan_to_num(rest)


def _deviation(around: Measured, layer: _Layer, on: np.ndarray, surface: np.ndarray, own: np.ndarray) -> np.ndarray:
    """[H, W]: what the ring deviates from a surface, averaged along it and extended harmonically into the hole.

    What of the layer lies on the surface, a disparity, is `on`. The pixels that touch the hole are biased by the
    object's haze: averaging over the whole ring is 4 to 6 times as accurate as meeting them exactly, measured on scenes
    with known truth. On real scans, whose depths swirl, a plate leads the deviations' slopes into the hole: averaging
    is 4 times as accurate with a prior that is right.
    """
    counted = (on & around.measured).astype(np.float64)
    weight = cv2.GaussianBlur(counted, (0, 0), AVERAGE)
    total = cv2.GaussianBlur(counted * (around.disparity - surface), (0, 0), AVERAGE)
    average = np.divide(total, weight, out=np.zeros_like(total), where=weight > 0.01)
    rim = layer.on & around.rim & (weight > 0.01)
    return np.nan_to_num(solve_poisson(own, rim, average, weight=around.weight * layer.on, anchor=average).values)


def hold_out_miss(around: Measured, plan: Plan, settings: DepthSettings, where: np.ndarray) -> float:
    """Mean relative error of a plan's best pixels on a hold-out band, when only what lies farther out is told.

    Evidence does not count, since the band has it beside it. NaN where too little is left to tell.
    """
    band = around.rim & (around.distance <= HOLD_OUT) & (around.disparity > 0)
    wider = around.hole | (around.distance <= HOLD_OUT) & ~(around.rim & ~band)
    held = replace(around, rim=around.rim & ~band, hole=wider, weight=np.zeros(wider.shape))
    tested = band & (around.distance >= SKIN) & where
    if min(held.rim.sum(), tested.sum()) < LEAST_PIXELS:
        return float("nan")
    layers = tuple(replace(layer, on=layer.on & ~band) for layer in plan.layers)
    found = fill(held, replace(plan, layers=layers), settings)[tested]
    errors = np.sort(np.minimum(np.nan_to_num(np.abs(found / around.disparity[tested] - 1), nan=1.0), 1.0))
    return float(errors[: round(KEPT_ERRORS * len(errors))].mean())
