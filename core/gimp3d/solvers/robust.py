"""Least squares that outliers do not spoil: linear fits, and differences in colour."""

from __future__ import annotations

import numpy as np

CUT = 4.685  # σ beyond which an equation counts for nothing: Tukey's biweight at 95 % efficiency
ROUNDS = 20  # of reweighting
COLOUR_CUT = 3.0  # robust standard deviations beyond which a pair of colours counts for nothing
LEAST_NOISE = 1.0  # grey levels
MAD = 1.4826  # median absolute deviation → standard deviation


def robust_fit(rows: np.ndarray, target: np.ndarray) -> tuple[np.ndarray, float]:
    """(x [K], σ) of rows [N, K] · x ≈ target [N] by iteratively reweighted least squares (Holland & Welsch 1977).

    It starts from plain least squares: data that lie on two lines with errors are one cloud to it, where a start from
    the line nearest to most of them (least median of squares) takes the errors within one cloud for a slope. σ is the
    robust standard deviation of the residuals, from their median.
    """
    weight, exact = np.ones(len(target)), 1e-12 * np.abs(target).max() + 1e-300
    for _ in range(ROUNDS):
        x = np.linalg.lstsq(rows * weight[:, None], target * weight, rcond=None)[0]
        residual = np.abs(rows @ x - target)
        sigma = MAD * float(np.median(residual))
        # weights of the equations, whose squares are those of the squared residuals
        weight = np.maximum(1 - (residual / (CUT * sigma + exact)) ** 2, 0)
    return x, sigma


def exposure_gain(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """[3] exposure of the second grey levels [N, 3] over the first ones', by well exposed pairs; 1 where few are."""
    exposed = ((before > 16) & (after > 16) & (before < 250) & (after < 250)).T
    ratios = [after[where, c] / before[where, c].astype(np.float64) for c, where in enumerate(exposed)]
    return np.array([np.median(r) if len(r) >= 50 else 1.0 for r in ratios])


def biweight(residuals: np.ndarray, tolerance: float) -> np.ndarray:
    """[N] in [0, 1]: how much residuals [N, 3], in grey levels, count: Tukey's biweight, scaled by their median length.

    `tolerance` is in COLOUR_CUT.
    """
    squares = np.einsum("nc,nc->n", residuals, residuals)
    scale = tolerance * COLOUR_CUT * (MAD * np.sqrt(np.median(squares)) + LEAST_NOISE)
    return np.maximum(0.0, 1 - squares / scale**2) ** 2
