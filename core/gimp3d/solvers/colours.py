"""How colours change from one picture to another, learned from pairs of the same surface point in both."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

ROUNDS = 5  # of reweighting
CUT = 3.0  # robust standard deviations beyond which a pair counts for nothing (Tukey's biweight)
LEAST_NOISE = 1.0  # grey levels
LEAST_PAIRS = 40
RIDGE = 100.0  # squared grey levels: colours that vary less than its root teach little


@dataclass(frozen=True)
class ColourChange:
    """Change of a colour c: (c − centre) · matrix, and `offset` on top where nothing else tells the level."""

    centre: np.ndarray  # [3] grey levels
    matrix: np.ndarray  # [3, 3]
    offset: np.ndarray  # [3] change of the centre, if that is one of exposure

    def of(
        self,
        colours: np.ndarray,  # [..., 3]
    ) -> np.ndarray:
        """The change of these colours, [..., 3], without the offset."""
        return (colours - self.centre) @ self.matrix


NO_CHANGE = ColourChange(np.zeros(3), np.zeros((3, 3)), np.zeros(3))


def learn_change(
    colours: np.ndarray,  # [N, 3] grey levels in the first picture
    change: np.ndarray,  # [N, 3] grey levels, second minus first
    ridge: float = RIDGE,
) -> ColourChange:
    """The change as a linear function of colour, by robust ridge regression."""
    if len(colours) < LEAST_PAIRS:
        return NO_CHANGE
    centre = colours.mean(0)
    x, y = colours - centre, change - change.mean(0)
    kept = np.ones(len(x))
    for _ in range(ROUNDS):
        scaled = x * kept[:, None]
        matrix = np.linalg.solve(scaled.T @ x + (ridge * kept.sum() + 1e-9) * np.eye(3), scaled.T @ y)
        kept = biweight(y - x @ matrix)
    slopes = (kept[:, None] * x * y).sum(0) / ((kept[:, None] * x * x).sum(0) + LEAST_NOISE**2 * kept.sum() + 1e-9)
    return ColourChange(centre, matrix, _exposure(np.median(change, axis=0), slopes * centre))


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


def _exposure(level: np.ndarray, proportional: np.ndarray) -> np.ndarray:
    """[3] the median change, if it is that of another exposure: twice as much for colours twice as bright.

    Any other level (a highlight, a reflection, pairs of different surfaces) belongs to its place and not to others.
    """
    return level * np.clip(1 - 2 * np.abs(level - proportional) / np.maximum(np.abs(level), 1e-12), 0.0, 1.0)


def biweight(
    residuals: np.ndarray,  # [N, 3] grey levels
) -> np.ndarray:
    """[N] in [0, 1]: how much each counts (Tukey's biweight, scaled by their median length)."""
    squares = np.einsum("nc,nc->n", residuals, residuals)
    scale = CUT * (1.4826 * np.sqrt(np.median(squares)) + LEAST_NOISE)
    return np.maximum(0.0, 1 - squares / scale**2) ** 2
