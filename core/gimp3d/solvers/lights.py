"""Which lights explain the darkness of surfaces, given what each of them would leave in shadow.

Illumination from shadows (Sato, Sato and Ikeuchi 2003), on surfaces whose own colours are not known: what is compared
are differences between neighbours, coarse and fine, robustly, as edges of texture are no shadow's.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg
import scipy.sparse as sparse
from scipy.optimize import lsq_linear, minimize

from ..compute.threads import parallel_map

LEAST_NOISE = 0.01  # of log luminance
CHROMA = 3.0  # times the usual difference of colour, from which an edge is hardly one of light
DARKEST = 0.95  # share of light that shadows may take together
ROUNDS = 6  # of reweighting
STEPS, HALVINGS, ENOUGH = 20, 6, 1e-5  # of a fit, and the share of the loss by which another one must help
NORMAL = 0.265  # mean of √(1 + u²) − 1 for normal u
TINTS, TINTLESS = (0.7, 1.3), 40.0  # by which channels' strengths may differ, and how far that is held at 1
SPREAD = 3.0  # standard deviations of colour beyond which more does not tell more


@dataclass(frozen=True)
class LitSurface:
    """A lit surface, on a grid."""

    shown: np.ndarray  # [H, W] bool, where it is known
    colours: np.ndarray  # [H, W, 3] log of linear colour


@dataclass(frozen=True)
class Shading:
    """Differences of log luminance between neighbouring blocks of all surfaces, and how to weigh them.

    T texels that are known, all surfaces one after the other; K differences; B things besides shadow that may explain
    them: light that changes evenly over a surface, and what goes with its hue.
    """

    operator: sparse.csr_matrix  # [K, T] takes differences
    observed: np.ndarray  # [K]
    besides: np.ndarray  # [K, B]
    noise: np.ndarray  # [K] what differences usually are
    weight: np.ndarray  # [K]
    hues: np.ndarray  # [K, 3] differences of a channel's log less that of luminance

    @classmethod
    def make(cls, surfaces: Sequence[LitSurface], levels: Sequence[int], bent: bool = True) -> Shading:
        """`levels` are sides of blocks, in texels; `bent`: light may change over a surface as a quadratic does.

        A light nearby makes that, and is no shadow; but wide shadows of the sky, to be measured, look like it.
        """
        operators, groups = zip(*(_differences(s.shown, levels) for s in surfaces))
        operator = sparse.block_diag(operators).tocsr()
        group = np.concatenate([kinds + 1000 * number for number, kinds in enumerate(groups)])
        colours = np.concatenate([s.colours[s.shown] for s in surfaces])
        observed = operator @ np.log(np.exp(colours).mean(1))  # of luminance
        hues = operator @ colours - observed[:, None]
        other = operator @ scipy.linalg.block_diag(*(_besides(s, bent) for s in surfaces))
        noise = _usual(observed - other @ _explained(observed, other, group), group)
        colourful = np.abs(hues).max(1)
        weight = 1 / (1 + (colourful / (CHROMA * _usual(colourful, group))) ** 2)
        scaled = other * (np.sqrt(weight) / noise)[:, None]
        root = np.linalg.qr(np.concatenate([scaled, 1e-6 * np.eye(scaled.shape[1])]), mode="r")
        other = scipy.linalg.solve_triangular(root, other.T, trans="T").T  # orthogonal
        return cls(operator, observed, other, noise, weight, hues)

    def fit(self, shadows: np.ndarray, least: np.ndarray | float = 0.0) -> tuple[np.ndarray, np.ndarray]:
        """Strengths [S] of shadows [T, S], no less than `least`, and coefficients of what is besides [B].

        They minimise Σ weight (√(1 + u²) − 1), u the residual over its noise; luminance is 1 − Σ strength · shadow.
        """
        count, shadows = shadows.shape[1], shadows.astype(np.float64)
        x = np.concatenate([np.full(count, least), self.besides.T @ (self.weight * self.observed / self.noise**2)])
        low = np.concatenate([x[:count], np.full(len(x) - count, -np.inf)])
        high = np.where(np.isfinite(low), 1.0, np.inf)
        loss = self.loss(self.residual(shadows @ x[:count], x[count:]))
        for _ in range(STEPS):  # Gauss and Newton's, reweighted; bounded, and halved until it helps
            residual = self.residual(shadows @ x[:count], x[count:])
            curve = self.weight / np.sqrt(1 + (residual / self.noise) ** 2) / self.noise**2
            steep = _log_lit(shadows @ x[:count])[1]
            slopes = np.concatenate([self.operator @ (-steep[:, None] * shadows), self.besides], axis=1)
            scaled = slopes * curve[:, None]
            bends = scaled.T @ slopes
            root = np.linalg.cholesky(bends + (1e-9 * np.trace(bends) + 1e-12) * np.eye(len(x)))
            aim = scipy.linalg.solve_triangular(root, scaled.T @ residual, lower=True)
            step = lsq_linear(root.T, aim, (low - x, high - x + 1e-12)).x
            for _ in range(HALVINGS):
                tried = x + step
                after = self.loss(self.residual(shadows @ tried[:count], tried[count:]))
                if after < loss:
                    break
                step = step / 2
            gained = loss - after
            if gained > 0:
                x, loss = np.clip(tried, low, high), after
            if gained <= ENOUGH * loss:
                break
        return x[:count], x[count:]

    def tints(self, shadows: np.ndarray, strengths: np.ndarray) -> np.ndarray:
        """[S, 3] by what strengths [S] of shadows [T, S] differ between the channels: their mean is about 1."""
        grey = self.operator @ _log_lit(shadows @ strengths)[0]
        noise = self.hues.std(0) + LEAST_NOISE
        scaled = shadows.astype(np.float64) * strengths

        def loss(x: np.ndarray, channel: int) -> tuple[float, np.ndarray]:
            lit, steep = _log_lit(scaled @ x)
            u = (self.hues[:, channel] + grey - self.operator @ lit) / noise[channel]
            root = np.sqrt(1 + u * u)
            slope = scaled.T @ ((self.operator.T @ (u / root / noise[channel])) * steep)
            held = TINTLESS * (x - 1)
            return float((root - 1).sum() + 0.5 * held @ (x - 1)), slope + held

        start, bounds = np.ones(len(strengths)), [TINTS] * len(strengths)
        found = [minimize(loss, start, (c,), jac=True, method="L-BFGS-B", bounds=bounds).x for c in range(3)]
        return np.stack(found, 1)

    def loss(self, residual: np.ndarray) -> float:
        """See fit."""
        return float((self.weight * (np.sqrt(1 + (residual / self.noise) ** 2) - 1)).sum())

    @property
    def usual_loss(self) -> float:
        """Of residuals that are noise."""
        return NORMAL * float(self.weight.sum())

    def residual(self, darkness: np.ndarray, coefficients: np.ndarray) -> np.ndarray:
        """[K] what is left of the differences; `darkness` [T] is the share of light that shadows take."""
        return self.observed - self.operator @ _log_lit(darkness)[0] - self.besides @ coefficients

    def explained(self, darkness: np.ndarray, coefficients: np.ndarray) -> float:
        """Share of the squared differences that the darkness explains, where it makes any."""
        made = self.operator @ _log_lit(darkness)[0]
        there = np.abs(made) > LEAST_NOISE
        before = self.observed - self.besides @ coefficients
        squares = [(self.weight * there * d**2).sum() for d in (before - made, before)]
        return float(np.clip(1 - squares[0] / max(squares[1], 1e-12), 0, 1))

    def changes(self, shadows: np.ndarray) -> np.ndarray:
        """[K, S] float32: how differences change, about, with the strength of shadows [T, S]."""
        return self.operator.astype(np.float32) @ shadows.astype(np.float32, copy=False)

    def gains(self, changes: np.ndarray, residual: np.ndarray) -> np.ndarray:
        """[S]: by how much each of more shadows, see changes, would lower the loss at its best strength, about."""
        strength, down, bend = self._best(changes, residual)
        return strength * down - 0.5 * strength**2 * bend

    def shares(self, changes: np.ndarray, residual: np.ndarray, told: float) -> np.ndarray:
        """[S]: what share of the loss, noise left out, each of more shadows would explain at its best strength, about,
        where it makes differences `told` times as large as they usually are."""
        strengths, *_ = self._best(changes, residual)

        def of(k: int) -> float:
            made = strengths[k] * changes[:, k]
            there = np.flatnonzero(np.abs(made) > told * self.noise)
            part = replace(self, noise=self.noise[there], weight=self.weight[there])
            return part.share(residual[there], residual[there] + made[there])

        return np.array(parallel_map(of, range(changes.shape[1])))

    def share(self, before: np.ndarray, after: np.ndarray) -> float:
        """What share of the loss of a residual, noise left out, another has less."""
        lost = self.loss(before)
        return float(np.clip((lost - self.loss(after)) / max(lost - self.usual_loss, 1e-12), 0, 1))

    def _best(self, changes: np.ndarray, residual: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """[S] each: best strengths of shadows, see gains, and how the loss falls with them, and bends."""
        root = np.sqrt(1 + (residual / self.noise) ** 2)
        curve = self.weight / root / self.noise**2
        down = -((curve * residual).astype(np.float32) @ changes).astype(np.float64)
        bend = np.einsum("ks,ks,k->s", changes, changes, curve.astype(np.float32)) + 1e-9
        return np.clip(down / bend, 0, 1), down, bend


def _log_lit(darkness: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """log(1 − d), and by how much it falls with d, [T] each; past DARKEST a straight line, or no line search ends."""
    left = 1 - np.minimum(darkness, DARKEST)
    return np.log(left) - np.maximum(darkness - DARKEST, 0) / left, 1 / left


def _differences(shown: np.ndarray, levels: Sequence[int]) -> tuple[sparse.csr_matrix, np.ndarray]:
    """The operator on known texels, and which differences are of a kind: of one side of blocks and one direction."""
    h, w = shown.shape
    index = np.cumsum(shown.ravel()).reshape(h, w) - 1
    count = int(shown.sum())
    parts, kinds = [], []
    for level, side in enumerate(levels):
        high, wide = h // side, w // side
        rows, cols = np.nonzero(shown[: high * side, : wide * side])
        block = (rows // side) * wide + cols // side
        members = np.bincount(block, minlength=high * wide)
        mean = sparse.csr_matrix((1 / members[block], (block, index[rows, cols])), (high * wide, count))
        known = (2 * members >= side * side).reshape(high, wide)
        for direction, (pair, step) in enumerate(((known[:, 1:] & known[:, :-1], 1), (known[1:] & known[:-1], wide))):
            first = np.flatnonzero(np.pad(pair, ((0, high - pair.shape[0]), (0, wide - pair.shape[1]))).ravel())
            parts.append(mean[first + step] - mean[first])
            kinds.append(np.full(len(first), 2 * level + direction))
    return sparse.vstack(parts).tocsr(), np.concatenate(kinds)


def _besides(surface: LitSurface, bent: bool) -> np.ndarray:
    """[T, B]: linear or quadratic in place, and quadratic in hue: light keeps it, so what goes with it is paint."""
    y, x = (2 * i[surface.shown] / max(surface.shown.shape) - 1 for i in np.indices(surface.shown.shape))
    colours = surface.colours[surface.shown]
    hues = colours[:, [0, 2]] - colours[:, 1:2]
    spread = hues.std(0) + 1e-3
    a, b = np.clip((hues - np.median(hues, axis=0)) / spread, -SPREAD, SPREAD).T
    curves = [x * x, x * y, y * y] if bent else []
    return np.stack([x, y, *curves, a, b, a * a, a * b, b * b], axis=1)


def _usual(values: np.ndarray, group: np.ndarray) -> np.ndarray:
    """[K]: the robust standard deviation of a value's group."""
    out = np.empty(len(values))
    for kind in np.unique(group):
        on = group == kind
        out[on] = max(1.4826 * float(np.median(np.abs(values[on]))), LEAST_NOISE)
    return out


def _explained(observed: np.ndarray, other: np.ndarray, group: np.ndarray) -> np.ndarray:
    """[B] robust least squares, each group by its own noise."""
    if not len(observed):
        return np.zeros(other.shape[1])
    noise, found = np.full(len(observed), max(float(np.std(observed)), LEAST_NOISE)), np.zeros(other.shape[1])
    for _ in range(ROUNDS):
        weight = 1 / np.sqrt(1 + ((observed - other @ found) / noise) ** 2) / noise**2
        scaled = other * weight[:, None]
        found = np.linalg.solve(scaled.T @ other + 1e-6 * np.eye(other.shape[1]), scaled.T @ observed)
        noise = _usual(observed - other @ found, group)
    return found
