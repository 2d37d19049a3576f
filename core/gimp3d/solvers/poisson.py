"""Poisson's equation on irregular holes of an image: depth completion and seamless blending stand on it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.ndimage
import scipy.sparse
import scipy.sparse.linalg


@dataclass(frozen=True)
class PoissonSolution:
    """A filled array."""

    values: np.ndarray  # [H, W] or [H, W, C] float64, the input with the hole replaced
    unanchored: np.ndarray  # [H, W] bool, hole pixels of components that touch no known pixel


def solve_poisson(
    hole: np.ndarray,  # [H, W] bool, unknown pixels
    known: np.ndarray,  # [H, W] bool, Dirichlet pixels; only those beside the hole matter
    values: np.ndarray,  # [H, W] or [H, W, C], fixed where known
    guidance: np.ndarray | None = None,  # like values: its 4-neighbour differences are the wanted gradients
) -> PoissonSolution:
    """Solve Σ_q (u(q) − u(p)) = Σ_q (g(q) − g(p)) over the 4-neighbours q of p in hole ∪ known (paper 3.3).

    Neighbours that are neither, and the image's border, are natural (Neumann): they are dropped on both sides.
    A pair of pixels of which one has no finite guidance wants no gradient. A component of the hole that touches no
    known pixel takes the guidance as it is (0 without) and is reported as unanchored.
    """
    hole = np.asarray(hole, bool)
    known = np.asarray(known, bool) & ~hole
    result = np.array(values, dtype=np.float64)
    unanchored = np.zeros(hole.shape, bool)
    if not hole.any():
        return PoissonSolution(result, unanchored)
    components, count = scipy.ndimage.label(hole)
    touching = np.unique(components[hole & scipy.ndimage.binary_dilation(known)])
    free = np.setdiff1d(np.arange(1, count + 1), touching)
    unanchored = np.isin(components, free)
    if unanchored.any():
        result[unanchored] = 0.0 if guidance is None else np.nan_to_num(guidance[unanchored])
    solved = hole & ~unanchored
    if solved.any():
        result[solved] = _solve(solved, known, result, guidance)
    return PoissonSolution(result, unanchored)


def _solve(hole: np.ndarray, known: np.ndarray, values: np.ndarray, guidance: np.ndarray | None) -> np.ndarray:
    """The unknowns [M(, C)] of an anchored hole, by a sparse direct solve: exact, one factor for all channels."""
    rows, cols = np.nonzero(hole)
    index = np.full(hole.shape, -1)
    index[rows, cols] = np.arange(len(rows))
    diagonal = np.zeros(len(rows))
    right = np.zeros((len(rows), *values.shape[2:]))
    neighbours: list[np.ndarray] = []
    for dy, dx in ((-1, 0), (1, 0), (0, -1), (0, 1)):
        y, x = rows + dy, cols + dx
        inside = (y >= 0) & (x >= 0) & (y < hole.shape[0]) & (x < hole.shape[1])
        p = np.flatnonzero(inside)
        q = (y[p], x[p])
        used = hole[q] | known[q]
        p, q = p[used], (q[0][used], q[1][used])
        diagonal[p] += 1
        fixed = known[q]
        right[p[fixed]] += values[q[0][fixed], q[1][fixed]]
        if guidance is not None:
            wanted = guidance[rows[p], cols[p]].astype(np.float64) - guidance[q]
            right[p] += np.where(np.isfinite(wanted), wanted, 0.0)
        unknown = ~fixed
        neighbours.append(np.stack([p[unknown], index[q[0][unknown], q[1][unknown]]]))
    pairs = np.concatenate(neighbours, axis=1)
    n = len(rows)
    matrix = scipy.sparse.coo_matrix((-np.ones(pairs.shape[1]), pairs), (n, n)) + scipy.sparse.diags(diagonal)
    factor = scipy.sparse.linalg.splu(
        matrix.tocsc(), permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True, "DiagPivotThresh": 0.0}
    )
    return factor.solve(right)
