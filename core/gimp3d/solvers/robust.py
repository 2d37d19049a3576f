"""Linear least squares that outliers do not spoil."""

from __future__ import annotations

import numpy as np

CUT = 4.685  # σ beyond which an equation counts for nothing: Tukey's biweight at 95 % efficiency
ROUNDS = 20  # of reweighting


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
        sigma = 1.4826 * float(np.median(residual))
        # weights of the equations, whose squares are those of the squared residuals
        weight = np.maximum(1 - (residual / (CUT * sigma + exact)) ** 2, 0)
    return x, sigma
