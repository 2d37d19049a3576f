"""How colours of the same surface points differ between two pictures, robustly."""

from __future__ import annotations

import numpy as np

CUT = 3.0  # robust standard deviations beyond which a pair counts for nothing (Tukey's biweight)
LEAST_NOISE = 1.0  # grey levels


def exposure_gain(
    before: np.ndarray,  # [N, 3] grey levels
    after: np.ndarray,  # [N, 3] of the same points
) -> np.ndarray:
    """[3] exposure of the second colours over the first ones', by well exposed pairs; 1 where there are few."""
    gain = np.ones(3)
    for channel in range(3):
        a, b = before[:, channel].astype(np.float64), after[:, channel]
        exposed = (a > 16) & (b > 16) & (a < 250) & (b < 250)
        if exposed.sum() >= 50:
            gain[channel] = np.median(b[exposed] / a[exposed])
    return gain


def biweight(
    residuals: np.ndarray,  # [N, 3] grey levels
    tolerance: float = 1.0,  # times CUT
) -> np.ndarray:
    """[N] in [0, 1]: how much each counts (Tukey's biweight, scaled by their median length)."""
    squares = np.einsum("nc,nc->n", residuals, residuals)
    scale = tolerance * CUT * (1.4826 * np.sqrt(np.median(squares)) + LEAST_NOISE)
    return np.maximum(0.0, 1 - squares / scale**2) ** 2
