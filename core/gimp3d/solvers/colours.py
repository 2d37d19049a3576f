"""How colours change from one picture to another, learned from pairs of the same surface point in both."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

ROUNDS = 5  # of reweighting
MORE_ROUNDS = 2  # the same from the weights of all pairs on, without one place
CUT = 3.0  # robust standard deviations beyond which a pair counts for nothing (Tukey's biweight)
LEAST_NOISE = 1.0  # grey levels
LEAST_PAIRS = 20  # that a place must have to be asked


@dataclass(frozen=True)
class ColourChange:
    """Change of a colour c: trust · (c − centre) · matrix, and `offset` on top where nothing else tells the level."""

    centre: np.ndarray  # [3] grey levels
    matrix: np.ndarray  # [3, 3]
    offset: np.ndarray  # [3] change of the centre, if that is one of exposure
    trust: float  # 0 to 1

    def of(
        self,
        colours: np.ndarray,  # [..., 3]
    ) -> np.ndarray:
        """The change of these colours, [..., 3], without the offset."""
        return self.trust * ((colours - self.centre) @ self.matrix)


NO_CHANGE = ColourChange(np.zeros(3), np.zeros((3, 3)), np.zeros(3), 0.0)


def learn_change(
    colours: np.ndarray,  # [N, 3] grey levels in the first picture
    change: np.ndarray,  # [N, 3] grey levels, second minus first
    places: np.ndarray,  # [N] int ≥ 0, where the pair lies
    weights: np.ndarray,  # [N] ≥ 0
    ridge: float = 100.0,  # squared grey levels: colours that vary less than its root teach little
) -> ColourChange:
    """The change as a linear function of colour, by robust ridge regression; each place has an offset of its own.

    How far that is to be trusted is measured, not assumed: every place is predicted from all the others. Trust is the
    factor that makes the predictions fit best, less one standard error over places; where colour tells nothing of the
    change it is 0.
    """
    if len(colours) < 2 * LEAST_PAIRS:
        return NO_CHANGE
    x, y = _within_places(colours, places, weights), _within_places(change, places, weights)
    matrix = _fit(x, y, weights, weights, ridge, ROUNDS)
    kept = weights * biweight(y - x @ matrix)
    slopes = (kept[:, None] * x * y).sum(0) / ((kept[:, None] * x * x).sum(0) + LEAST_NOISE**2 * kept.sum() + 1e-9)
    explained, wanted = [], []
    for place in np.unique(places):
        here = (places == place) & (weights > 0)
        if here.sum() < LEAST_PAIRS or (~here).sum() < LEAST_PAIRS:
            continue
        without = _fit(x[~here], y[~here], weights[~here], kept[~here], ridge, MORE_ROUNDS)
        predicted = x[here] @ without
        counted = (weights[here] * biweight(y[here] - predicted))[:, None]
        explained.append((counted * predicted * y[here]).sum())
        wanted.append((counted * predicted**2).sum())
    trust = 0.0
    if len(explained) >= 3 and sum(wanted) > 0:
        best = sum(explained) / sum(wanted)
        error = np.sqrt(np.sum((np.array(explained) - best * np.array(wanted)) ** 2)) / sum(wanted)
        trust = float(np.clip(best - error, 0.0, 1.0))
    centre = np.average(colours, axis=0, weights=weights)
    level = np.median(change[weights > 0], axis=0)
    return ColourChange(centre, matrix, _exposure(level, trust * slopes * centre), trust)


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


def _within_places(values: np.ndarray, places: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Values less their place's weighted mean."""
    total = np.maximum(np.bincount(places, weights), 1e-12)
    means = np.stack([np.bincount(places, weights * v) / total for v in values.T], -1)
    return values - means[places]


def _fit(
    x: np.ndarray,
    y: np.ndarray,
    weights: np.ndarray,
    kept: np.ndarray,  # [N], the weights to begin with
    ridge: float,
    rounds: int,
) -> np.ndarray:
    """[3, 3] M of y ≈ x M."""
    for _ in range(rounds):
        scaled = x * kept[:, None]
        matrix = np.linalg.solve(scaled.T @ x + (ridge * kept.sum() + 1e-9) * np.eye(x.shape[1]), scaled.T @ y)
        kept = weights * biweight(y - x @ matrix)
    return matrix


def biweight(
    residuals: np.ndarray,  # [N, 3] grey levels
) -> np.ndarray:
    """[N] in [0, 1]: how much each counts (Tukey's biweight, scaled by their median length)."""
    squares = np.einsum("nc,nc->n", residuals, residuals)
    scale = CUT * (1.4826 * np.sqrt(np.median(squares)) + LEAST_NOISE)
    return np.maximum(0.0, 1 - squares / scale**2) ** 2
