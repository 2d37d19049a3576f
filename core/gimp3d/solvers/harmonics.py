"""Fitting real spherical harmonics, as 3DGS uses them, to colours seen from several directions.

The fit (paper supplementary; docs/method.md) is weighted least squares on the residuals c_ω − c_0 in the basis
Y_k(ω) − Y_k(ω_0), so that the reference's colour c_0 comes out exactly in its own direction ω_0. Gaussians that are
seen equally often are solved together: a Gaussian's result depends neither on its neighbours nor on the threads.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple

import numpy as np

from ..compute.threads import parallel_map
from ..errors import BadInput
from ..gaussians import SH_C0
from ..sh import C1, sh_basis

HIGHEST = 3  # degree of 3DGS's files

# Of the ridge, in observations, for a cone of directions of about 60° (see fit_harmonics): 0.2 is best where colours
# have noise alone, but painted views are wrong together (`make bench-harmonics`)
FLOOR = 20.0
STEPS = (1, 16)  # ridges tried, in units of the least one
FIRST_STEP = 4  # ridge of the first fit, whose errors give the robust weights
FEW = 10  # observations; below it the least ridge grows: one wrong among five would lead it astray
NARROW = 0.1  # radians: of a much narrower cone, differences are noise that slopes would blow up
CUT = 3  # robust scale in σ
POOLED = 10  # observations' worth of σ_0 in a Gaussian's own σ
GAIN = 1.02  # the constant's squared error must exceed a fit's by this
COLLINEAR = 1e-3  # least ratio of the variances of the directions across and along their main axis
SAME = 1e-5  # scatter of directions, C1² square radians: below it (0.4°), they are one
LEAST_RIDGE = 2e-6  # of A's largest diagonal term
LEAST_LEFT = 1e-3  # of 1 − leverage
TINY = 1e-12  # sum of weights: nothing was observed
MAD = 1.4826  # median absolute deviation → standard deviation
LEAST_SIGMA = 1.0 / 255  # of 8-bit colours
SAMPLE = 1 << 14  # observations that suffice for σ_0: its error is about 1 %
ROUNDED = 4  # numbers of observations are rounded up to its multiples, so that more Gaussians are solved together
AT_ONCE = 1 << 14  # observations that are solved together at most: 2 MB of basis values


class Reason(IntEnum):
    """Why a Gaussian got its degree."""

    VIEW_DEPENDENT = 0  # the colour is predicted better with the direction than without
    CONSTANT = 1  # it is not
    ONE_DIRECTION = 2  # one view, or duplicate or collinear directions: nothing can be said of others
    UNOBSERVED = 3  # no observation of any weight


@dataclass(frozen=True)
class HarmonicsSettings:
    """How strongly the colours of few directions are held to the reference's colour."""

    offset: bool = False  # fit along, and leave out, what all views are off by; bears wrong light, costs accuracy
    anchored: bool = True  # the basis is Y(ω) − Y(ω_0); False: Y(ω), as printed, which misses c_0 in ω_0 itself
    ridge: float | None = None  # observations; this and the highest degree for all, chosen per Gaussian if None


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
    floor: float = FLOOR,
) -> HarmonicsFit:
    """SH coefficients by robust, anchored, regularised least squares (paper supplementary; docs/method.md).

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
    padded = np.maximum(-(-counts // ROUNDED), 1) * ROUNDED
    if not m:  # one that no Gaussian has
        directions, colours, weights = (np.zeros((1, *a.shape[1:]), np.float32) for a in (directions, colours, weights))

    def solve(rows: np.ndarray) -> None:
        batch = _gathered(rows, padded[rows[0]], offsets, directions, colours, weights)
        _fit_batch(rows, batch, anchors[rows], anchor_directions[rows], degree, settings, floor, fit)

    parallel_map(solve, _batches(padded))
    return fit


def _batches(padded: np.ndarray) -> list[np.ndarray]:
    """Rows of Gaussians with as many observations, a part of them at a time."""
    order = np.argsort(padded, kind="stable")
    alike = np.split(order, np.flatnonzero(np.diff(padded[order])) + 1) if len(order) else []
    sizes = [max(1, AT_ONCE // int(padded[rows[0]])) for rows in alike]
    return [rows[at : at + size] for rows, size in zip(alike, sizes) for at in range(0, len(rows), size)]


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


class _Batch(NamedTuple):
    """Observations of B Gaussians, V of each; those that do not count have the weight 0."""

    directions: np.ndarray  # [B, V, 3] float64
    colours: np.ndarray  # [B, V, 3]
    weights: np.ndarray  # [B, V]


def _gathered(
    rows: np.ndarray,
    count: int,  # V
    offsets: np.ndarray,
    directions: np.ndarray,
    colours: np.ndarray,
    weights: np.ndarray,
) -> _Batch:
    places = offsets[rows, None] + np.arange(count)
    there = places < offsets[rows + 1, None]
    places = np.where(there, places, 0)
    towards, seen, given = directions[places], colours[places], weights[places]
    there &= np.isfinite(given) & (given > 0) & np.isfinite(towards).all(-1) & np.isfinite(seen).all(-1)
    towards, seen = (np.where(there[..., None], a, 0).astype(np.float64) for a in (towards, seen))
    return _Batch(towards, seen, np.where(there, given, 0).astype(np.float64))


class _Equations(NamedTuple):
    """Weighted least squares of a batch; with an offset, everything is taken from its weighted mean."""

    x: np.ndarray  # [B, V, K] basis differences
    r: np.ndarray  # [B, V, 3] residual colours
    weight: np.ndarray  # [B, V]
    total: np.ndarray  # [B] Σ weight
    share: np.ndarray  # [B] 1 / Σ weight with an offset, else 0
    matrix: np.ndarray  # [B, K, K] A = Σ w x xᵀ
    right: np.ndarray  # [B, K, 3] b = Σ w x rᵀ


def _equations(basis: np.ndarray, residuals: np.ndarray, weight: np.ndarray, offset: bool) -> _Equations:
    total = np.maximum(weight.sum(1), TINY)
    share = offset / total
    if offset:
        means = (weight * share[:, None])[:, None]
        basis, residuals = basis - means @ basis, residuals - means @ residuals
    weighted = np.swapaxes(basis * weight[..., None], 1, 2)
    return _Equations(basis, residuals, weight, total, share, weighted @ basis, weighted @ residuals)


class _Fits(NamedTuple):
    """Fits of all degrees from 1 on at one ridge."""

    errors: list[np.ndarray]  # [B, V] of each degree: length of the leave-one-out error of the colour
    ranks: list[np.ndarray]  # [B] Σ leverage
    inverse: np.ndarray  # [B, K, K] of the Cholesky factor L of A + ridge
    projected: np.ndarray  # [B, K, 3] L⁻¹ b

    def coefficients(self, degree: int) -> np.ndarray:
        """[B, (degree + 1)² − 1, 3]."""
        k = (degree + 1) ** 2 - 1
        return np.swapaxes(self.inverse[:, :k, :k], 1, 2) @ self.projected[:, :k]


def _fits(equations: _Equations, ridge: np.ndarray, degree: int) -> _Fits:
    """Solve for all degrees with a ridge [B] each."""
    matrix = equations.matrix.copy()
    diagonal = np.einsum("bkk->bk", matrix)
    diagonal += np.maximum(np.maximum(ridge, LEAST_RIDGE * diagonal.max(1)), TINY)[:, None]
    inverse = _inverse(np.linalg.cholesky(matrix))
    projected = inverse @ equations.right
    t = equations.x @ np.swapaxes(inverse, 1, 2)
    left, squares = equations.r, np.broadcast_to(equations.share[:, None], equations.weight.shape)
    errors, ranks = [], []
    for d in range(1, degree + 1):
        band = slice(d * d - 1, (d + 1) ** 2 - 1)
        squares = squares + (t[..., band] ** 2).sum(-1)
        left = left - t[..., band] @ projected[:, band]
        errors.append(_left_out(left, equations.weight * squares))
        ranks.append((equations.weight * squares).sum(1))
    return _Fits(errors, ranks, inverse, projected)


def _inverse(lower: np.ndarray) -> np.ndarray:
    """[B, K, K] of lower triangular matrices; LAPACK, called for each, takes several times as long."""
    inverse = np.zeros_like(lower)
    for i in range(lower.shape[1]):
        inverse[:, i, i] = 1
        inverse[:, i, :i] = -(lower[:, i, None, :i] @ inverse[:, :i, :i])[:, 0]
        inverse[:, i] /= lower[:, i, i, None]
    return inverse


def _left_out(residuals: np.ndarray, leverage: np.ndarray) -> np.ndarray:
    """[B, V] length of the error that a fit without the observation would make at it."""
    return np.linalg.norm(residuals, axis=-1) / np.maximum(1 - leverage, LEAST_LEFT)


def _fit_batch(
    rows: np.ndarray,
    batch: _Batch,
    anchors: np.ndarray,  # [B, 3]
    towards: np.ndarray,  # [B, 3]
    degree: int,
    settings: HarmonicsSettings,
    floor: float,
    fit: HarmonicsFit,  # gets the rows
) -> None:
    anchors, towards = anchors.astype(np.float64), towards.astype(np.float64)
    at_anchor = sh_basis(towards, degree)[:, 1:]
    basis = sh_basis(batch.directions, degree)[..., 1:]
    if settings.anchored:
        basis = basis - at_anchor[:, None]
    residuals = batch.colours - anchors[:, None]
    # the paper's weights e_ω; |ω − ω_0|² = 2 (1 − ω·ω_0)
    apart = ((batch.directions - towards[:, None]) ** 2).sum(-1)
    weight = batch.weights * np.exp(-0.5 * (residuals**2).sum(-1) / fit.sigma**2 * np.exp(-apart))
    choose = settings.ridge is None
    equations = _equations(basis, residuals, weight, settings.offset)
    if choose and degree:
        first = _fits(equations, FIRST_STEP * _least_ridge(equations, floor), degree)
        weight = batch.weights * _robust(first.errors[-1], batch.weights, fit.sigma)
        equations = _equations(basis, residuals, weight, settings.offset)

    def mean(errors: np.ndarray) -> np.ndarray:
        return (equations.weight * errors**2).sum(1) / equations.total

    error = mean(_left_out(equations.r, equations.weight * equations.share[:, None]))
    best = error / GAIN if choose else np.full(len(rows), np.inf)
    posed = _spans_a_patch(equations, towards) if degree else np.ones(len(rows), bool)
    found, chosen, rank = np.zeros((*basis.shape[::2], 3)), np.zeros(len(rows), int), np.zeros(len(rows))
    for step in (STEPS if choose else (1,)) if degree else ():
        ridge = step * _least_ridge(equations, floor) if choose else np.full(len(rows), settings.ridge, float)
        fits = _fits(equations, ridge, degree)
        for d in range(1 if choose else degree, degree + 1):
            here = mean(fits.errors[d - 1])
            better = posed & (here < best)
            best[better], error[better], chosen[better] = here[better], here[better], d
            rank[better] = fits.ranks[d - 1][better]
            found[better] = 0
            found[better, : (d + 1) ** 2 - 1] = fits.coefficients(d)[better]
    fit.sh[rows, 1:] = found
    level = anchors - 0.5
    fit.sh[rows, 0] = (level - np.einsum("bk,bkc->bc", at_anchor, found) if settings.anchored else level) / SH_C0
    fit.degree[rows], fit.error[rows], fit.rank[rows] = chosen, np.sqrt(error), rank
    fit.reasons[rows] = np.select(
        [equations.total <= TINY, chosen > 0, ~posed],
        [Reason.UNOBSERVED, Reason.VIEW_DEPENDENT, Reason.ONE_DIRECTION],
        Reason.CONSTANT,
    )


def _least_ridge(equations: _Equations, floor: float) -> np.ndarray:
    """[B], from the directions' RMS distance from ω_0, or from their mean if there is an offset."""
    squares = np.einsum("bkk->b", equations.matrix[:, :3, :3]) / C1**2  # degree 1 holds the direction's coordinates
    distance = np.sqrt(squares / equations.total)
    return floor * (distance + NARROW) * (1 + FEW / equations.total)


def _robust(errors: np.ndarray, given: np.ndarray, sigma: float) -> np.ndarray:
    """[B, V] weights from the errors and each Gaussian's own σ, drawn to σ_0 where observations are few."""
    errors = np.where(given > 0, errors, 0)
    order, total = np.argsort(errors, axis=1), given.sum(1)
    middle = (np.cumsum(np.take_along_axis(given, order, 1), 1) >= total[:, None] / 2).argmax(1)  # weighted median
    own = MAD * errors[np.arange(len(errors)), order[np.arange(len(order)), middle]]
    square = CUT**2 * (total * own**2 + POOLED * sigma**2) / (total + POOLED)
    return 1 / (1 + errors**2 / square[:, None]) ** 2


def _spans_a_patch(equations: _Equations, towards: np.ndarray) -> np.ndarray:
    """[B] bool: the directions, seen along ω_0, lie neither in a point nor on a line.

    A's first three rows are their scatter about ω_0 (about their mean if there is an offset). Seen along ω_0, it has
    one eigenvalue 0, the sum of the others in its trace and their product in its principal minors.
    """
    along = towards[:, [1, 2, 0]] * [-1, 1, -1]  # as Y_1 … Y_3 order and sign the coordinates
    across = np.eye(3) - along[:, :, None] * along[:, None]
    scatter = across @ equations.matrix[:, :3, :3] @ across
    trace = np.einsum("bkk->b", scatter)
    minors = (trace**2 - np.einsum("bkl,blk->b", scatter, scatter)) / 2
    return (minors > COLLINEAR * trace**2) & (trace > SAME * equations.total)
