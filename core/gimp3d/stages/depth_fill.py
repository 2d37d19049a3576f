"""Continuing what is measured round a hole into it: planes, thin plates, membranes (METHOD section 3)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, Literal

import cv2
import numpy as np
import scipy.ndimage

from ..errors import IllPosed
from ..schema import Between, Many, Positive, Share, Signed
from ..solvers.planes import PlaneSettings, Surface, planar_surfaces
from ..solvers.poisson import solve_poisson
from ..solvers.thin_plate import ThinPlateSettings, thin_plate
from .depth_evidence import DepthEvidenceSettings
from .layers import LayerSettings, background_rim, distance_to, divided, separated


@dataclass(frozen=True)
class DepthSettings:
    """Lengths in pixels; differences of disparity are relative to the disparity itself."""

    # "auto": planes where the ring lies on planes, else smooth; "planar", "smooth" (thin plate), "harmonic" insist
    surface: Literal["auto", "planar", "smooth", "harmonic"] = "auto"
    planes: PlaneSettings = PlaneSettings()
    plate: ThinPlateSettings = ThinPlateSettings()
    layers: LayerSettings = LayerSettings()
    evidence: DepthEvidenceSettings = DepthEvidenceSettings()
    plane_share: Share = 0.65  # of the ring that must lie on planes
    tolerances: tuple[float, ...] = (1.0, 2.0, 4.0)  # of planes.inlier, tried until so much does
    plane_trust: float = 1.4  # planes are taken if they miss a withheld band by this many times a plate's miss
    smoothing: Positive = 12.0  # σ of the average of what the ring deviates from a plane
    skin: float = 1.5  # width of the part of the ring next to the hole that the object's haze bends
    withheld: int = 12  # width of the band by which planes and plate are compared
    plate_ring: int = 12  # width of the ring that a plate continues
    scale_factor: Signed | None = None  # s_f; None: measured on the ring. The paper uses 0.1
    ring: int = 12  # width of the ring on which s_f is measured
    minimum_ring: int = 10  # ring pixels below which nothing can be measured
    # Times the miss of a withheld band without a prior, at which it is believed by half: as its fit allows, or anyhow
    prior_miss: float = 3.0
    prior_gain: float = 0.8
    least_island: Share = 0.02  # share of the hole that evidence must hold to stand alone before the surface
    small_part: Many = 64  # pixels up to which a part of the hole is just interpolated
    low: Share = 0.25  # completed disparities are clamped to [low · ring's least, high · ring's greatest]
    high: Annotated[float, Between(1)] = 4.0
    expected: Positive = 0.02  # relative error at which a pixel's confidence is one half


@dataclass(frozen=True)
class Surroundings:
    """A hole and what is measured round and in it."""

    disparity: np.ndarray  # [H, W] float64: the scene's on the rim, the evidence's in the hole
    rim: np.ndarray  # [H, W] bool, known pixels of the background
    hole: np.ndarray  # [H, W] bool
    weight: np.ndarray  # [H, W] of the evidence in the hole, 0 = none
    distance: np.ndarray  # [H, W] px to the hole
    guide: np.ndarray | None = None  # [H, W] the prior in the scene's scale; only the difference to it is continued

    @property
    def measured(self) -> np.ndarray:
        """[H, W] bool: the background's known pixels, and evidence."""
        return self.rim | (self.weight > 0)

    @property
    def touching(self) -> np.ndarray:
        """[H, W] bool: what bounds the hole's unknown pixels."""
        return (self.rim & scipy.ndimage.binary_dilation(self.hole)) | (self.weight > 0)


def surroundings(
    disparity: np.ndarray,  # [H, W] float64
    known: np.ndarray,  # [H, W] bool
    hole: np.ndarray,  # [H, W] bool
    weight: np.ndarray,  # [H, W], 0 off the hole
    settings: DepthSettings,
    guide: np.ndarray | None = None,
) -> Surroundings:
    """What bounds a hole, occluders left out (`background_rim`)."""
    rim = background_rim(disparity, known, hole, settings.layers)
    return Surroundings(disparity, rim, hole, weight, distance_to(hole), guide)


@dataclass(frozen=True)
class _Layer:
    """A surface that goes on behind the object."""

    on: np.ndarray  # [H, W] bool, measured pixels that lie on it
    surface: Surface | None = None  # its planes, if it has some


@dataclass(frozen=True)
class Plan:
    """How a hole is to be filled."""

    layers: tuple[_Layer, ...]
    kind: str  # of layers that are not planar: smooth | harmonic | averaged (with a guide)
    reason: str


def choose_plan(
    around: Surroundings,
    settings: DepthSettings,
    insist: bool = True,  # on planes, if the settings do
) -> Plan:
    """Planes, a thin plate or a membrane, as the settings say; "auto" takes what misses a withheld band by less.

    Raises
    ------
    IllPosed
        If planes are insisted on and there are none.
    """
    kind = "harmonic" if settings.surface == "harmonic" else "smooth"
    if around.guide is not None:  # it knows of steps itself
        plan = Plan(_layers(around, (), False, settings), kind, "")
        if kind == "harmonic":
            return plan
        averaged = replace(plan, kind="averaged")
        misses = [withheld_miss(around, p, settings, around.rim) for p in (averaged, plan)]
        return averaged if misses[0] < misses[1] else plan
    words = "harmonic" if kind == "harmonic" else "smooth: the surroundings' slopes are continued"
    plain = Plan(_layers(around, (), kind == "smooth", settings), kind, words)
    if settings.surface not in ("auto", "planar") or not around.touching.any():
        return plain
    share = 0.0
    for tolerance in settings.tolerances:  # a rough scan's table is a plane too, and its lesser steps are noise
        own = replace(settings.planes, inlier=tolerance * settings.planes.inlier)
        planar = planar_surfaces(around.disparity, around.measured, around.distance, own)
        share = max(share, planar.share)
        if planar.share < settings.plane_share:
            continue
        rough = replace(settings, layers=replace(settings.layers, step=tolerance * settings.layers.step))
        planes = Plan(_layers(around, planar.surfaces, True, rough), kind, planar.reason)
        if settings.surface == "planar":
            return planes
        on_planes = np.any([layer.on for layer in planes.layers if layer.surface is not None], axis=0)
        misses = [withheld_miss(around, plan, settings, on_planes) for plan in (planes, plain)]
        if not misses[0] > settings.plane_trust * misses[1]:
            return planes
    if settings.surface == "planar" and insist:
        raise IllPosed(f"depth: only {share:.0%} of the surroundings lie on planes; use --depth-prior auto")
    return plain


def _layers(
    around: Surroundings, surfaces: tuple[Surface, ...], split: bool, settings: DepthSettings
) -> tuple[_Layer, ...]:
    """The planar surfaces, the sky, and what of the surroundings lies on none of them, parted at steps."""
    d = around.disparity
    sky = around.measured & (d == 0)
    if not surfaces and (sky & around.touching).any():
        surfaces = (Surface(np.zeros(d.shape), sky, 0),)
    index = np.where(around.measured, len(surfaces), -1)
    for k, surface in reversed(list(enumerate(surfaces))):
        step = settings.layers.step * np.maximum(d, surface.disparity)
        index[around.measured & (np.abs(d - surface.disparity) <= step)] = k
    layers = [_Layer(index == k, surface) for k, surface in enumerate(surfaces)]
    loose = index == len(surfaces)
    touching = around.touching
    if (loose & touching).any() and (
        not surfaces or (loose & touching).sum() >= settings.layers.least * touching.sum()
    ):
        parts = separated(d, loose, loose & touching, settings.layers) if split else [loose]
        layers += [_Layer(part) for part in parts]
    return tuple(layers)


def fill(around: Surroundings, plan: Plan, settings: DepthSettings) -> np.ndarray:
    """Disparity [H, W] float64 of the hole, NaN where nothing says anything."""
    seeds = np.full(around.hole.shape, -1)
    touching = around.touching
    for k, layer in enumerate(plan.layers):
        seeds[layer.on & touching] = k
    near = around.distance <= settings.planes.ring
    part = divided(around.hole, seeds, [layer.on & near for layer in plan.layers], settings.layers)
    filled = np.full(around.hole.shape, np.nan)
    for k, layer in enumerate(plan.layers):
        own = around.hole & (part == k)
        if not own.any():
            continue
        if layer.surface is not None:
            on, surface = layer.on & layer.surface.on, layer.surface.disparity
            values = surface + _deviation(around, layer, on, surface, own, settings)
        else:
            values = _continued(around, layer, own, plan.kind, settings)
        filled[own] = values[own]
    return filled


def _continued(around: Surroundings, layer: _Layer, own: np.ndarray, kind: str, settings: DepthSettings) -> np.ndarray:
    """[H, W]: a layer without planes in its part of the hole. With a guide, its error is what is continued."""
    guide = np.zeros(own.shape) if around.guide is None else around.guide
    values = around.disparity - guide
    weight = np.where(around.hole, around.weight, 1.0) * layer.on
    if kind == "harmonic":
        inside = weight * around.hole
        return guide + solve_poisson(own, layer.on & around.rim, values, weight=inside, anchor=values).values
    if kind == "averaged":
        return guide + _deviation(around, layer, layer.on, guide, own, settings)
    near = layer.on & (around.distance <= settings.plate_ring)
    clean = near & ((around.distance >= settings.skin) | around.hole)
    taken = clean if clean.sum() >= settings.minimum_ring else near
    plate = thin_plate(values, weight * taken, own | near, settings.plate)
    if not (weight * own).any():
        return guide + plate
    # What only other views saw, a mound or a ledge, is an outlier to the plate; a membrane leads there and back.
    lacking = np.where(around.hole, values - plate, 0.0)
    rest = solve_poisson(own, layer.on & around.rim, lacking, weight=weight * own, anchor=lacking).values
    return guide + plate + np.nan_to_num(rest)


def _deviation(
    around: Surroundings,
    layer: _Layer,
    on: np.ndarray,  # [H, W] bool, what of the layer lies on the surface
    surface: np.ndarray,  # [H, W] disparity
    own: np.ndarray,
    settings: DepthSettings,
) -> np.ndarray:
    """[H, W]: what the ring deviates from a surface, averaged along it and extended harmonically into the hole.

    The pixels that touch the hole are biased by the object's haze: averaging over the whole ring is 4 to 6 times as
    accurate as meeting them exactly, measured on scenes with known truth. On real scans, whose depths swirl, a plate
    leads the deviations' slopes into the hole: averaging is 4 times as accurate with a prior that is right.
    """
    counted = (on & around.measured).astype(np.float64)
    weight = cv2.GaussianBlur(counted, (0, 0), settings.smoothing)
    total = cv2.GaussianBlur(counted * (around.disparity - surface), (0, 0), settings.smoothing)
    average = np.divide(total, weight, out=np.zeros_like(total), where=weight > 0.01)
    rim = layer.on & around.rim & (weight > 0.01)
    return np.nan_to_num(solve_poisson(own, rim, average, weight=around.weight * layer.on, anchor=average).values)


def withheld_miss(around: Surroundings, plan: Plan, settings: DepthSettings, where: np.ndarray) -> float:
    """Mean relative error of a plan's best 80 % on the band next to the hole, when only what lies farther out is told.

    Evidence does not count, since the band has it beside it. NaN where too little is left to tell.
    """
    band = around.rim & (around.distance <= settings.withheld) & (around.disparity > 0)
    wider = around.hole | (around.distance <= settings.withheld) & ~(around.rim & ~band)
    none = np.zeros(wider.shape)
    held = replace(around, rim=around.rim & ~band, hole=wider, distance=distance_to(wider), weight=none)
    tested = band & (around.distance >= settings.skin) & where
    if min(held.rim.sum(), tested.sum()) < settings.minimum_ring:
        return float("nan")
    layers = tuple(replace(layer, on=layer.on & ~band) for layer in plan.layers)
    found = fill(held, replace(plan, layers=layers), settings)[tested]
    errors = np.sort(np.minimum(np.nan_to_num(np.abs(found / around.disparity[tested] - 1), nan=1.0), 1.0))
    return float(errors[: round(0.8 * len(errors))].mean())  # things that stand about are no test of what lies behind
