"""Real spherical harmonics as 3DGS uses them, and fitting them to colours seen from several directions.

The fit (paper supplementary, METHOD section 6) is weighted least squares on the residuals c_ω − c_0 in the basis
Y_k(ω) − Y_k(ω_0), so that the reference's colour c_0 comes out exactly in its own direction ω_0. Kernels take 16
Gaussians at a time, one per lane: results depend neither on the number of threads nor on a lane's neighbours.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numba import float32, int64

from ..compute.jit import exact_kernel
from ..compute.simd import exp2_16, fma16, load1, load16, max16, min16, splat16, sqrt16, store1, store16, where_greater
from ..compute.threads import run_ranges
from ..errors import BadInput
from ..gaussians import SH_C0
from ..sh import C1, C2, C3, sh_basis

HIGHEST = 3  # degree of 3DGS's files

STEPS = (np.float32(1), np.float32(16))  # ridges tried, in units of the least one
FIRST_STEP = np.float32(4)  # ridge of the first fit, whose errors give the robust weights
FEW = np.float32(10)  # observations; below it the least ridge grows: one wrong among five would lead it astray
NARROW = np.float32(0.1)  # radians: of a much narrower cone, differences are noise that slopes would blow up
CUT = np.float32(3)  # robust scale in σ
POOLED = np.float32(10)  # observations' worth of σ_0 in a Gaussian's own σ
GAIN = np.float32(1.02)  # the constant's squared error must exceed a fit's by this
COLLINEAR = np.float32(1e-3)  # least ratio of the variances of the directions across and along their main axis
SAME = np.float32(1e-5)  # scatter of directions, C1² square radians: below it (0.4°), they are one
LEAST_RIDGE = np.float32(2e-6)  # of A's largest diagonal term, for float32
LEAST_LEFT = np.float32(1e-3)  # of 1 − leverage
HALVINGS = 20  # of the interval that holds a median
MAD = 1.4826  # median absolute deviation → standard deviation
LEAST_SIGMA = 1.0 / 255  # of 8-bit colours
SAMPLE = 1 << 14  # observations that suffice for σ_0: its error is about 1 %

LANES = 16
K = 15  # coefficients above degree 0
# Scratch planes of 16 lanes. Per observation: basis differences, residual colour, weights, leave-one-out error
RESIDUAL, GIVEN, WEIGHT, ERROR, STAGED = 15 * LANES, 18 * LANES, 19 * LANES, 20 * LANES, 21 * LANES
# Per group: A (packed rows), b, then what is made of them
NORMAL, RIGHT = 0, 120 * LANES
LOW, INVERSE, PROJECTED = 165 * LANES, 285 * LANES, 405 * LANES
COEFFICIENTS, ANCHOR, TOWARDS, COLOUR = 450 * LANES, 495 * LANES, 510 * LANES, 513 * LANES
SUM_ERROR, SUM_LEVERAGE = 516 * LANES, 519 * LANES  # a plane per degree
MOMENT, MEAN = 522 * LANES, 537 * LANES  # Σ w x, and L⁻¹ of their mean
OFFSET = 552 * LANES  # of the views' colours
TOTAL, SHARE, RIDGE, BEST, FOUND, CHOSEN, RANK, GROUP = range(555 * LANES, 563 * LANES, LANES)

ZERO, HALF, ONE, HUGE, TINY = np.float32(0), np.float32(0.5), np.float32(1), np.float32(1e30), np.float32(1e-12)
F1 = np.float32(C1)
F2, F3 = tuple(np.float32(c) for c in C2), tuple(np.float32(c) for c in C3)
TWO, THREE, FOUR = np.float32(2), np.float32(3), np.float32(4)
LOG2E = np.float32(math.log2(math.e))


class Reason(IntEnum):
    """Why a Gaussian got its degree."""

    VIEW_DEPENDENT = 0  # the colour is predicted better with the direction than without
    CONSTANT = 1  # it is not
    ONE_DIRECTION = 2  # one view, or duplicate or collinear directions: nothing can be said of others
    UNOBSERVED = 3  # no observation of any weight


@dataclass(frozen=True)
class HarmonicsSettings:
    """How strongly the colours of few directions are held to the reference's colour."""

    floor: float = 0.2  # of the ridge, in observations, for a cone of directions of about 60° (see fit_harmonics)
    offset: bool = False  # fit along, and leave out, what all views are off by against the reference
    anchored: bool = True  # the basis is Y(ω) − Y(ω_0); False: Y(ω), as printed, which misses c_0 in ω_0 itself
    ridge: float | None = None  # this ridge and the highest degree for all, the paper's weights: nothing is chosen


@dataclass(frozen=True)
class Observations:
    """Colours of N Gaussians from several directions, ragged: those of Gaussian i are offsets[i] … offsets[i + 1]."""

    offsets: np.ndarray  # [N + 1] int64
    directions: np.ndarray  # [M, 3] float32, unit, from the camera to the point
    colours: np.ndarray  # [M, 3] float32
    weights: np.ndarray  # [M] float32, 1 = an independent observation; what is not > 0 or not finite is left out


@dataclass(frozen=True)
class HarmonicsFit:
    """Coefficients of N Gaussians, and how they came about."""

    sh: np.ndarray  # [N, (degree + 1)², 3] float32, as 3DGS stores them
    degree: np.ndarray  # [N] uint8, the highest with coefficients ≠ 0
    error: np.ndarray  # [N] float32, weighted RMS length of the leave-one-out colour errors
    rank: np.ndarray  # [N] float32, effective: the trace of the hat matrix, 0 for a constant
    reasons: np.ndarray  # [N] uint8, see Reason
    sigma: float  # σ_0

    @property
    def counts(self) -> dict[str, int]:
        """Gaussians by reason."""
        found = np.bincount(self.reasons, minlength=len(Reason))
        return {reason.name.lower().replace("_", " "): int(found[reason]) for reason in Reason}


def rotate_sh(
    sh: np.ndarray,  # [N, K, 3], K = 1, 4, 9 or 16
    rotation: np.ndarray,  # [3, 3] or [N, 3, 3] proper or improper, from the old frame to the new one
) -> np.ndarray:
    """Coefficients [N, K, 3], of `sh`'s type, of the colours that are seen along R ω as `sh`'s are along ω.

    A rotation maps every band to itself (Wigner 1931): Y(R ω) = D(R) Y(ω). Evaluated in fixed directions, that is a
    small exact system for the orthogonal matrix D; no recursion is needed up to degree 3.
    """
    degree = round(sh.shape[1] ** 0.5) - 1
    points = _spread_directions(32)
    before = sh_basis(points, degree)
    after = sh_basis(points @ np.swapaxes(np.asarray(rotation, np.float64), -1, -2), degree)
    rotated = np.array(sh)
    for d in range(1, degree + 1):
        band = slice(d * d, (d + 1) ** 2)
        wigner = np.swapaxes(np.linalg.pinv(before[:, band]) @ after[..., band], -1, -2)
        rotated[:, band] = wigner @ sh[:, band]
    return rotated


def _spread_directions(count: int) -> np.ndarray:
    """[count, 3] unit vectors all round (a Fibonacci spiral)."""
    k = np.arange(count) + 0.5
    z, turn = 1 - 2 * k / count, k * math.pi * (3 - math.sqrt(5))
    across = np.sqrt(1 - z * z)
    return np.stack([across * np.cos(turn), across * np.sin(turn), z], -1)


def gather_observations(
    count: int,  # Gaussians
    views: Sequence[tuple[np.ndarray, np.ndarray, np.ndarray]],  # rows [m] without repetition, directions, colours
) -> Observations:
    """Observations view by view, sorted by Gaussian; each has the weight 1. Only what was seen takes memory."""
    seen = np.zeros(count + 1, np.int64)
    for rows, _, _ in views:
        seen[rows + 1] += 1
    offsets = np.cumsum(seen)
    directions, colours = np.empty((offsets[-1], 3), np.float32), np.empty((offsets[-1], 3), np.float32)
    free = offsets[:-1].copy()
    for rows, towards, colour in views:
        directions[free[rows]], colours[free[rows]] = towards, colour
        free[rows] += 1
    return Observations(offsets, directions, colours, np.ones(offsets[-1], np.float32))


def fit_harmonics(
    anchors: np.ndarray,  # [N, 3] colours c_0 that must be reproduced in the reference direction
    anchor_directions: np.ndarray,  # [N, 3] unit ω_0
    observations: Observations,
    degree: int = HIGHEST,  # the highest that is tried
    settings: HarmonicsSettings = HarmonicsSettings(),
) -> HarmonicsFit:
    """SH coefficients by robust, anchored, regularised least squares (paper supplementary, METHOD section 6).

    1. The paper's weights e_ω, with σ_0 from the median of all residuals.
    2. A first fit. Its leave-one-out errors give each Gaussian's own σ and weights 1 / (1 + (error / CUT σ)²)²
       (Geman and McClure 1987).
    3. Fits of every degree and of STEPS × the least ridge; the one with the least leave-one-out error is kept. Of a
       Cholesky factor of the highest degree, the leading blocks are those of the lower ones: one factorisation per
       ridge gives all degrees, and the errors come in closed form, (c − ĉ) / (1 − leverage).

    Leave-one-out sees nothing outside the cone of directions, where a fit goes on. The ridge therefore never falls
    below floor · (s + NARROW) · (1 + FEW / n) observations: n is the sum of the weights, s the RMS distance of the
    unit vectors ω from ω_0.

    Where the reference is lit otherwise than the views (another exposure, a shadow that is gone), every residual
    holds the same offset, and a fit through c_0 would bend the colour towards it. With `offset`, it is fitted along
    (eliminated from the normal equations) and left out of the result. That costs accuracy where c_0 is right.

    Degree 0, c_0 alone, for Gaussians without observations and where the directions, seen from ω_0, do not span a
    patch of the sphere (rank test: one view, duplicates, a line).

    Raises
    ------
    BadInput
        If an array has the wrong shape, an anchor is not finite, or the degree is not 0–3.
    """
    n = len(anchors)
    if not 0 <= degree <= HIGHEST:
        raise BadInput(f"SH degree must be from 0 to {HIGHEST}, got {degree}")
    offsets = np.ascontiguousarray(observations.offsets, np.int64)
    anchors, anchor_directions, directions, colours, weights = (
        np.ascontiguousarray(a, np.float32)
        for a in (anchors, anchor_directions, observations.directions, observations.colours, observations.weights)
    )
    shapes = (anchors.shape, anchor_directions.shape, offsets.shape, directions.shape, colours.shape)
    m = len(weights)
    if shapes != ((n, 3), (n, 3), (n + 1,), (m, 3), (m, 3)) or offsets[0] != 0 or offsets[-1] != m:
        raise BadInput(f"SH fit: {n} Gaussians and {m} observations do not match arrays of shape {shapes}")
    counts = np.diff(offsets)
    if (counts < 0).any() or not (np.isfinite(anchors).all() and np.isfinite(anchor_directions).all()):
        raise BadInput("SH fit: offsets must not fall, and anchors must be finite")
    sigma = _sigma_of(anchors, offsets, directions, colours, weights)
    fit = HarmonicsFit(
        np.zeros((n, (degree + 1) ** 2, 3), np.float32),
        np.zeros(n, np.uint8),
        np.zeros(n, np.float32),
        np.zeros(n, np.float32),
        np.zeros(n, np.uint8),
        sigma,
    )
    order = np.argsort(counts, kind="stable")  # lanes of one group have about as many observations
    run_ranges(
        _fit_groups,
        -(-n // LANES),
        order,
        offsets,
        directions,
        colours,
        weights,
        anchors,
        anchor_directions,
        degree,
        np.float32(sigma),
        np.float32(settings.floor),
        settings.offset,
        settings.anchored,
        np.float32(-1 if settings.ridge is None else settings.ridge),
        fit.sh,
        fit.degree,
        fit.error,
        fit.rank,
        fit.reasons,
    )
    return fit


def _sigma_of(
    anchors: np.ndarray, offsets: np.ndarray, directions: np.ndarray, colours: np.ndarray, weights: np.ndarray
) -> float:
    """σ_0: the robust size of all residuals, from random ones if there are very many."""
    rows = np.arange(len(weights))
    if len(rows) > SAMPLE:  # evenly spaced ones may all be of one view
        rows = np.random.default_rng(0).integers(0, len(weights), SAMPLE)
    finite = np.isfinite(weights[rows]) & np.isfinite(directions[rows]).all(1) & np.isfinite(colours[rows]).all(1)
    rows = rows[finite & (weights[rows] > 0)]
    if len(rows) == 0:
        return LEAST_SIGMA
    owners = np.searchsorted(offsets, rows, side="right") - 1
    sizes = np.linalg.norm(colours[rows].astype(np.float64) - anchors[owners], axis=-1)
    return max(MAD * float(np.median(sizes)), LEAST_SIGMA)


@exact_kernel
def _fit_groups(
    lo,
    hi,
    order,
    offsets,
    directions,
    colours,
    weights,
    anchors,
    anchor_directions,
    degree,
    sigma,
    floor,
    offset,
    anchored,
    ridge,  # < 0: chosen per Gaussian
    sh,
    degrees,
    errors,
    ranks,
    reasons,
):
    """Fit groups lo … hi of 16 Gaussians in `order`."""
    k = (degree + 1) * (degree + 1) - 1
    last = order[min(hi * LANES, len(order)) - 1]
    staged = np.zeros(max(1, offsets[last + 1] - offsets[last]) * STAGED, np.float32)
    s = np.zeros(GROUP, np.float32)
    for group in range(lo, hi):
        rows = order[group * LANES : (group + 1) * LANES]
        count = _stage(rows, offsets, directions, colours, weights, anchors, anchor_directions, staged, s)
        _expand(count, degree, sigma, anchored, staged, s)
        _normal_equations(count, k, offset, staged, s)
        if ridge < ZERO and degree > 0:
            _set_ridge(FIRST_STEP * floor, s)
            _factorise(k, ONE, s)
            _leave_one_out(count, degree, staged, s)
            _reweigh(count, sigma, staged, s)
            _normal_equations(count, k, offset, staged, s)
        _start_constant(count, ridge < ZERO, staged, s)
        if degree > 0:
            _rank_test(s)
        if degree > 0 and ridge < ZERO:
            _set_ridge(floor, s)
            for step in STEPS:
                _factorise(k, step, s)
                _leave_one_out(count, degree, staged, s)
                for d in range(1, degree + 1):
                    _keep_better(d, s)
        elif degree > 0:
            store16(s, RIDGE, splat16(ridge))
            _factorise(k, ONE, s)
            _leave_one_out(count, degree, staged, s)
            _keep_better(degree, s)
        for lane in range(len(rows)):
            i = rows[lane]
            for c in range(3):
                constant = anchors[i, c] - float32(0.5)
                for j in range(k):
                    h = s[COEFFICIENTS + (3 * j + c) * LANES + lane]
                    sh[i, 1 + j, c] = h
                    constant -= h * s[ANCHOR + j * LANES + lane]
                sh[i, 0, c] = constant / float32(SH_C0)
            degrees[i] = s[CHOSEN + lane]
            ranks[i] = s[RANK + lane]
            errors[i] = math.sqrt(s[FOUND + lane])
            if s[TOTAL + lane] <= TINY:
                reasons[i] = Reason.UNOBSERVED
            elif s[CHOSEN + lane] > ZERO:
                reasons[i] = Reason.VIEW_DEPENDENT
            elif s[BEST + lane] < ZERO:
                reasons[i] = Reason.ONE_DIRECTION
            else:
                reasons[i] = Reason.CONSTANT


@exact_kernel
def _stage(rows, offsets, directions, colours, weights, anchors, anchor_directions, staged, s):
    """Observations into lanes: directions (in the place of the basis), residuals, weights. The most of any lane."""
    first, end = np.zeros(LANES, np.int64), np.zeros(LANES, np.int64)  # lanes without a Gaussian stay empty
    count = int64(0)
    for lane in range(len(rows)):
        i = rows[lane]
        first[lane], end[lane] = offsets[i], offsets[i + 1]
        count = max(count, offsets[i + 1] - offsets[i])
        for c in range(3):
            store1(s, TOWARDS + c * LANES + lane, anchor_directions[i, c])
            store1(s, COLOUR + c * LANES + lane, anchors[i, c])
    for v in range(count):
        for lane in range(LANES):
            at, o = v * STAGED + lane, load1(first, lane) + v
            used = o < load1(end, lane) and weights[o] > ZERO
            if used:
                x, y, z = directions[o, 0], directions[o, 1], directions[o, 2]
                r, g, b = colours[o, 0], colours[o, 1], colours[o, 2]
                used = math.isfinite(x + y + z + r + g + b + weights[o])
            if used:
                store1(staged, at, x)
                store1(staged, at + LANES, y)
                store1(staged, at + 2 * LANES, z)
                store1(staged, at + RESIDUAL, r)
                store1(staged, at + RESIDUAL + LANES, g)
                store1(staged, at + RESIDUAL + 2 * LANES, b)
                store1(staged, at + GIVEN, weights[o])
            else:
                for c in range(3):
                    store1(staged, at + c * LANES, load1(s, TOWARDS + c * LANES + lane))
                    store1(staged, at + RESIDUAL + c * LANES, load1(s, COLOUR + c * LANES + lane))
                store1(staged, at + GIVEN, ZERO)
    return count


@exact_kernel
def _expand(count, degree, sigma, anchored, staged, s):
    """Y(ω) − Y(ω_0) in the place of the directions, and the paper's weights e_ω times the given ones."""
    _basis(degree, s, TOWARDS, s, ANCHOR)
    k = (degree + 1) * (degree + 1) - 1
    for j in range(0 if anchored else k):
        store16(s, ANCHOR + j * LANES, splat16(ZERO))
    scale = -float32(0.5) * LOG2E / (sigma * sigma)
    for v in range(count):
        at = v * STAGED
        x = load16(staged, at) - load16(s, TOWARDS)
        y = load16(staged, at + LANES) - load16(s, TOWARDS + LANES)
        z = load16(staged, at + 2 * LANES) - load16(s, TOWARDS + 2 * LANES)
        apart = fma16(x, x, fma16(y, y, z * z)) * -LOG2E  # |ω − ω_0|² = 2 (1 − ω·ω_0)
        r = load16(staged, at + RESIDUAL) - load16(s, COLOUR)
        g = load16(staged, at + RESIDUAL + LANES) - load16(s, COLOUR + LANES)
        b = load16(staged, at + RESIDUAL + 2 * LANES) - load16(s, COLOUR + 2 * LANES)
        store16(staged, at + RESIDUAL, r)
        store16(staged, at + RESIDUAL + LANES, g)
        store16(staged, at + RESIDUAL + 2 * LANES, b)
        size = fma16(r, r, fma16(g, g, b * b))
        weight = exp2_16(size * scale * exp2_16(apart))
        store16(staged, at + WEIGHT, load16(staged, at + GIVEN) * weight)
        _basis(degree, staged, at, staged, at)
        for j in range(k):
            store16(staged, at + j * LANES, load16(staged, at + j * LANES) - load16(s, ANCHOR + j * LANES))


@exact_kernel
def _basis(degree, source, start, out, at):
    """Planes of Y_k, k ≥ 1, of three planes of directions, which may lie where the first three of them go."""
    x, y, z = load16(source, start), load16(source, start + LANES), load16(source, start + 2 * LANES)
    if degree > 0:
        store16(out, at, y * -F1)
        store16(out, at + LANES, z * F1)
        store16(out, at + 2 * LANES, x * -F1)
    if degree > 1:
        xx, yy, zz = x * x, y * y, z * z
        store16(out, at + 3 * LANES, x * y * F2[0])
        store16(out, at + 4 * LANES, y * z * F2[1])
        store16(out, at + 5 * LANES, (zz * TWO - xx - yy) * F2[2])
        store16(out, at + 6 * LANES, x * z * F2[3])
        store16(out, at + 7 * LANES, (xx - yy) * F2[4])
        if degree > 2:
            store16(out, at + 8 * LANES, y * (xx * THREE - yy) * F3[0])
            store16(out, at + 9 * LANES, x * y * z * F3[1])
            store16(out, at + 10 * LANES, y * (zz * FOUR - xx - yy) * F3[2])
            store16(out, at + 11 * LANES, z * (zz * TWO - (xx + yy) * THREE) * F3[3])
            store16(out, at + 12 * LANES, x * (zz * FOUR - xx - yy) * F3[4])
            store16(out, at + 13 * LANES, z * (xx - yy) * F3[5])
            store16(out, at + 14 * LANES, x * (xx - yy * THREE) * F3[6])


@exact_kernel
def _normal_equations(count, k, offset, staged, s):
    """A = Σ w x xᵀ (packed rows), b = Σ w x rᵀ, Σ w, with the views' common offset, if any, eliminated."""
    for p in range(NORMAL, LOW, LANES):
        store16(s, p, splat16(ZERO))
    for p in range(MOMENT, MOMENT + K * LANES, LANES):
        store16(s, p, splat16(ZERO))
    total, red, green, blue = splat16(ZERO), splat16(ZERO), splat16(ZERO), splat16(ZERO)
    for v in range(count):
        at = v * STAGED
        w = load16(staged, at + WEIGHT)
        r = load16(staged, at + RESIDUAL)
        g = load16(staged, at + RESIDUAL + LANES)
        b = load16(staged, at + RESIDUAL + 2 * LANES)
        total, red, green, blue = total + w, fma16(w, r, red), fma16(w, g, green), fma16(w, b, blue)
        p, q, m = NORMAL, RIGHT, MOMENT
        for i in range(k):
            wx = w * load16(staged, at + i * LANES)
            for j in range(i + 1):
                store16(s, p, fma16(wx, load16(staged, at + j * LANES), load16(s, p)))
                p += LANES
            store16(s, q, fma16(wx, r, load16(s, q)))
            store16(s, q + LANES, fma16(wx, g, load16(s, q + LANES)))
            store16(s, q + 2 * LANES, fma16(wx, b, load16(s, q + 2 * LANES)))
            store16(s, m, wx + load16(s, m))
            q += 3 * LANES
            m += LANES
    total = max16(total, TINY)
    share = splat16(ONE if offset else ZERO) / total
    red, green, blue = red * share, green * share, blue * share
    store16(s, TOTAL, total)
    store16(s, SHARE, share)
    store16(s, OFFSET, red)
    store16(s, OFFSET + LANES, green)
    store16(s, OFFSET + 2 * LANES, blue)
    p, q = NORMAL, RIGHT
    for i in range(k):
        moment = load16(s, MOMENT + i * LANES)
        for j in range(i + 1):
            store16(s, p, load16(s, p) - moment * load16(s, MOMENT + j * LANES) * share)
            p += LANES
        store16(s, q, load16(s, q) - moment * red)
        store16(s, q + LANES, load16(s, q + LANES) - moment * green)
        store16(s, q + 2 * LANES, load16(s, q + 2 * LANES) - moment * blue)
        q += 3 * LANES


@exact_kernel
def _set_ridge(floor, s):
    """The least ridge, from the directions' RMS distance from ω_0, or from their mean if there is an offset."""
    # the first three basis functions are the direction's coordinates times ±C1
    squares = load16(s, NORMAL) + load16(s, NORMAL + 2 * LANES) + load16(s, NORMAL + 5 * LANES)
    total = load16(s, TOTAL)
    distance = sqrt16(max16(squares * (ONE / (F1 * F1)) / total, TINY))
    store16(s, RIDGE, (distance + NARROW) * floor * (splat16(FEW) / total + ONE))


@exact_kernel
def _factorise(k, step, s):
    """The inverse of the Cholesky factor L of A + ridge, L⁻¹ b, and L⁻¹ of the mean basis values."""
    largest = splat16(ZERO)
    for i in range(k):
        largest = max16(largest, load16(s, NORMAL + (i * (i + 3) // 2) * LANES))
    ridge = max16(load16(s, RIDGE) * step, largest * LEAST_RIDGE)
    for i in range(k):
        row = i * (i + 1) // 2 * LANES
        squares = splat16(ZERO)
        for j in range(i):
            column = j * (j + 1) // 2 * LANES
            dot = splat16(ZERO)
            for m in range(0, j * LANES, LANES):
                dot = fma16(load16(s, LOW + row + m), load16(s, LOW + column + m), dot)
            term = load16(s, NORMAL + row + j * LANES) - dot
            term = term * load16(s, INVERSE + column + j * LANES)
            store16(s, LOW + row + j * LANES, term)
            squares = fma16(term, term, squares)
        pivot = load16(s, NORMAL + row + i * LANES) + ridge - squares
        inverse = splat16(ONE) / sqrt16(max16(pivot, ridge))  # exactly, no pivot is below the ridge
        store16(s, INVERSE + row + i * LANES, inverse)
        for j in range(i):
            dot = splat16(ZERO)
            for m in range(j, i):
                dot = fma16(load16(s, LOW + row + m * LANES), load16(s, INVERSE + (m * (m + 1) // 2 + j) * LANES), dot)
            store16(s, INVERSE + row + j * LANES, dot * inverse * -ONE)
        for c in range(0, 3 * LANES, LANES):
            dot = splat16(ZERO)
            for j in range(i + 1):
                dot = fma16(load16(s, INVERSE + row + j * LANES), load16(s, RIGHT + 3 * j * LANES + c), dot)
            store16(s, PROJECTED + 3 * i * LANES + c, dot)
        dot = splat16(ZERO)
        for j in range(0, (i + 1) * LANES, LANES):
            dot = fma16(load16(s, INVERSE + row + j), load16(s, MOMENT + j), dot)
        store16(s, MEAN + i * LANES, dot * load16(s, SHARE))


@exact_kernel
def _leave_one_out(count, degree, staged, s):
    """Per degree: Σ w error² and Σ leverage. The errors' lengths at the highest degree are kept."""
    for d in range(degree):
        store16(s, SUM_ERROR + d * LANES, splat16(ZERO))
        store16(s, SUM_LEVERAGE + d * LANES, splat16(ZERO))
    for v in range(count):
        at = v * STAGED
        w = load16(staged, at + WEIGHT)
        r = load16(staged, at + RESIDUAL) - load16(s, OFFSET)
        g = load16(staged, at + RESIDUAL + LANES) - load16(s, OFFSET + LANES)
        b = load16(staged, at + RESIDUAL + 2 * LANES) - load16(s, OFFSET + 2 * LANES)
        squares = load16(s, SHARE)
        p, q, i = INVERSE, PROJECTED, 0
        for d in range(degree):
            for _ in range(2 * d + 3):
                t = load16(s, MEAN + i * LANES) * -ONE  # becomes (L⁻¹ (x − mean))_i
                for j in range(0, (i + 1) * LANES, LANES):
                    t = fma16(load16(s, p + j), load16(staged, at + j), t)
                squares = fma16(t, t, squares)
                r = r - t * load16(s, q)
                g = g - t * load16(s, q + LANES)
                b = b - t * load16(s, q + 2 * LANES)
                i += 1
                p += i * LANES
                q += 3 * LANES
            leverage = w * squares
            left = max16(splat16(ONE) - leverage, LEAST_LEFT)
            error = fma16(r, r, fma16(g, g, b * b)) / (left * left)
            store16(s, SUM_ERROR + d * LANES, fma16(w, error, load16(s, SUM_ERROR + d * LANES)))
            store16(s, SUM_LEVERAGE + d * LANES, leverage + load16(s, SUM_LEVERAGE + d * LANES))
            store16(staged, at + ERROR, sqrt16(error))


@exact_kernel
def _reweigh(count, sigma, staged, s):
    """Robust weights from the errors and each Gaussian's own σ, drawn to σ_0 where observations are few."""
    total, high = splat16(ZERO), splat16(ZERO)
    for v in range(count):
        total = total + load16(staged, v * STAGED + GIVEN)
        high = max16(high, load16(staged, v * STAGED + ERROR))
    low, half = splat16(ZERO), total * HALF
    for _ in range(HALVINGS):  # towards the weighted median
        middle, below = (low + high) * HALF, splat16(ZERO)
        for v in range(count):
            error, given = load16(staged, v * STAGED + ERROR), load16(staged, v * STAGED + GIVEN)
            below = below + where_greater(middle, error, given, splat16(ZERO))
        low, high = where_greater(half, below, middle, low), where_greater(half, below, high, middle)
    own = high * float32(MAD)
    square = (total * own * own + splat16(POOLED * sigma * sigma)) / (total + POOLED) * (CUT * CUT)
    for v in range(count):
        error = load16(staged, v * STAGED + ERROR)
        t = error * error / square + ONE
        store16(staged, v * STAGED + WEIGHT, load16(staged, v * STAGED + GIVEN) / (t * t))


@exact_kernel
def _start_constant(count, choose, staged, s):
    """The constant colour as the first candidate."""
    sum_ = splat16(ZERO)
    for v in range(count):
        at = v * STAGED
        r = load16(staged, at + RESIDUAL) - load16(s, OFFSET)
        g = load16(staged, at + RESIDUAL + LANES) - load16(s, OFFSET + LANES)
        b = load16(staged, at + RESIDUAL + 2 * LANES) - load16(s, OFFSET + 2 * LANES)
        w = load16(staged, at + WEIGHT)
        left = max16(splat16(ONE) - w * load16(s, SHARE), LEAST_LEFT)
        sum_ = fma16(w, fma16(r, r, fma16(g, g, b * b)) / (left * left), sum_)
    error = sum_ / load16(s, TOTAL)
    store16(s, FOUND, error)
    store16(s, BEST, error * (ONE / GAIN) if choose else splat16(HUGE))
    store16(s, CHOSEN, splat16(ZERO))
    store16(s, RANK, splat16(ZERO))
    for p in range(COEFFICIENTS, ANCHOR, LANES):
        store16(s, p, splat16(ZERO))


@exact_kernel
def _rank_test(s):
    """No candidate can win where the directions, seen along ω_0, lie in a point or on a line.

    A's first three rows are the scatter of ω about ω_0 (about their mean if there is an offset). Seen along ω_0, it
    has one eigenvalue 0, the sum of the others in its trace and their product in its principal minors.
    """
    a, b, c = load16(s, TOWARDS + LANES) * -ONE, load16(s, TOWARDS + 2 * LANES), load16(s, TOWARDS) * -ONE
    aa, ab, bb = load16(s, NORMAL), load16(s, NORMAL + LANES), load16(s, NORMAL + 2 * LANES)
    ac, bc, cc = load16(s, NORMAL + 3 * LANES), load16(s, NORMAL + 4 * LANES), load16(s, NORMAL + 5 * LANES)
    p = fma16(aa, a, fma16(ab, b, ac * c))
    q = fma16(ab, a, fma16(bb, b, bc * c))
    r = fma16(ac, a, fma16(bc, b, cc * c))
    along = fma16(p, a, fma16(q, b, r * c))
    aa, ab = aa - a * p * TWO + a * a * along, ab - a * q - b * p + a * b * along
    bb, ac = bb - b * q * TWO + b * b * along, ac - a * r - c * p + a * c * along
    cc, bc = cc - c * r * TWO + c * c * along, bc - b * r - c * q + b * c * along
    trace = aa + bb + cc
    minors = aa * bb - ab * ab + aa * cc - ac * ac + bb * cc - bc * bc
    best = where_greater(minors, trace * trace * COLLINEAR, load16(s, BEST), splat16(-ONE))
    store16(s, BEST, where_greater(trace, load16(s, TOTAL) * SAME, best, splat16(-ONE)))


@exact_kernel
def _keep_better(degree, s):
    """Take this degree's fit where it predicts better than what was best so far."""
    k = (degree + 1) * (degree + 1) - 1
    error, best = load16(s, SUM_ERROR + (degree - 1) * LANES) / load16(s, TOTAL), load16(s, BEST)
    store16(s, BEST, min16(error, best))
    store16(s, FOUND, where_greater(best, error, error, load16(s, FOUND)))
    store16(s, CHOSEN, where_greater(best, error, splat16(float32(degree)), load16(s, CHOSEN)))
    leverage = load16(s, SUM_LEVERAGE + (degree - 1) * LANES)
    store16(s, RANK, where_greater(best, error, leverage, load16(s, RANK)))
    for j in range(K):
        for c in range(0, 3 * LANES, LANES):
            dot = splat16(ZERO)
            for i in range(j, k):
                row = i * (i + 1) // 2 * LANES
                dot = fma16(load16(s, INVERSE + row + j * LANES), load16(s, PROJECTED + 3 * i * LANES + c), dot)
            at = COEFFICIENTS + 3 * j * LANES + c
            store16(s, at, where_greater(best, error, dot, load16(s, at)))
