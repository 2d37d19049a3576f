"""What is continued into a hole: by Poisson's equation, with wanted gradients or as a membrane, or as a thin plate.

A membrane is fixed at the rim and forgets how the surface came to it; a thin plate keeps its slope and bends.

Poisson's equation is solved by conjugate gradients and a multigrid cycle. A cell of a coarser grid stands for 2×2 finer
ones, and links to its neighbours by the sum of the links that cross their border: so every grid is a graph of four
neighbours, and one relaxation serves all. A correction that is constant in each cell climbs in steps, which costs twice
the energy of a slope; halved links make up for that (Braess 1995). Times beside other solvers: `make bench-poisson`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
import scipy.ndimage
import scipy.sparse
import scipy.sparse.linalg

from ..compute.jit import exact_kernel
from ..geometry import bounds

LEAST_WEIGHT, MOST_WEIGHT = 1e-30, 1e30  # weaker ones do not count, stronger ones count as this
STEPS = 0.5  # by which links of a coarser grid count
MOST_ITERATIONS = 5000  # 10 are usual, hundreds are taken by mazes of one-pixel walls
AXES = ((np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1], np.s_[1:]))  # pixels and their neighbours to the right, and below
SMOOTHING = 1.5  # px, σ below which the values' own noise is smoothed away
TENSION = 1.0  # length, in radii of the hole, beyond which the plate is a membrane
UNKNOWNS = 4000  # at most; larger domains are solved on a coarser grid
STIFF = 15.0  # px, smoothing of a first plate that tells outliers: a soft one bends to clusters of them
OUTLIER = 4.7  # standard deviations off the stiff plate at which a value does not count (Tukey: 95 % efficient)


@dataclass(frozen=True)
class PoissonSolution:
    """A filled array."""

    values: np.ndarray  # [H, W] or [H, W, C], the input with the hole replaced
    iterations: int  # most of any channel
    unanchored: np.ndarray  # [H, W] bool, hole pixels of components that touch no known pixel


def solve_poisson(
    hole: np.ndarray,  # [H, W] bool, unknown pixels
    known: np.ndarray,  # [H, W] bool, Dirichlet pixels; only those beside the hole matter
    values: np.ndarray,  # [H, W] or [H, W, C], fixed where known
    guidance: np.ndarray | None = None,  # like values: its 4-neighbour differences are the wanted gradients
    tolerance: float = 1e-5,  # residual over that of the guidance plus one constant per component, over the diagonal
    *,
    weight: np.ndarray | None = None,  # [H, W] ≥ 0, how strongly each pixel is drawn to `anchor` (or to 0)
    anchor: np.ndarray | None = None,  # like values, soft data (screened Poisson)
) -> PoissonSolution:
    """Solve Σ_q (u(q) − u(p)) + w(p)(a(p) − u(p)) = Σ_q (g(q) − g(p)) over the 4-neighbours q of p in hole ∪ known.

    This is paper 3.3 with its sign mended (docs/method.md): the solution's gradients are the guidance's, not their
    opposites. Neighbours that are neither hole nor known, and the image's border, are natural (Neumann): they are
    dropped on both sides. A pair of pixels of which one has no finite guidance wants no gradient; known pixels, weights
    and anchors that are not finite do not count, nor weights below 1e-30; 1e30 is the most.

    A component of the hole that touches no known pixel (and is drawn to no anchor) is unanchored: it takes the guidance
    as it is, which settles the free constant. Where there is none, it is NaN.
    """
    hole = np.asarray(hole, bool)
    window = bounds(hole, 1)

    def cut(array: np.ndarray) -> np.ndarray:
        part = np.pad(np.asarray(array)[window], ((1, 1), (1, 1), *[(0, 0)] * (np.ndim(array) - 2)))
        return part if part.dtype == bool else part.astype(np.float64).reshape(*part.shape[:2], -1)

    fixed = cut(values)
    guide = np.full(fixed.shape, np.nan) if guidance is None else cut(guidance)
    aim = np.zeros(fixed.shape) if anchor is None else cut(anchor)
    pull = np.zeros(fixed.shape[:2]) if weight is None else cut(weight)[..., 0]
    pull[~((pull > LEAST_WEIGHT) & np.isfinite(pull) & np.isfinite(aim).all(-1))] = 0
    aim[pull == 0] = 0
    task = _Task(cut(hole), cut(np.asarray(known, bool)), fixed, guide, np.minimum(pull, MOST_WEIGHT), aim)
    found, iterations, loose = _solve(task, tolerance)
    filled, unanchored = np.array(values, dtype=np.float64), np.zeros(hole.shape, bool)
    filled[hole], unanchored[hole] = found[task.hole].reshape(-1, *np.shape(values)[2:]), loose[task.hole]
    return PoissonSolution(filled, iterations, unanchored)


class _Task(NamedTuple):
    """What is given, in the window and an empty border; pull is 0 where there is no anchor."""

    hole: np.ndarray  # [h, w] bool
    known: np.ndarray  # [h, w] bool
    values: np.ndarray  # [h, w, C]
    guidance: np.ndarray  # [h, w, C], NaN where there is none
    pull: np.ndarray  # [h, w]
    anchor: np.ndarray  # [h, w, C]


def _solve(task: _Task, tolerance: float) -> tuple[np.ndarray, int, np.ndarray]:
    """[h, w, C] of the hole, the iterations taken, and what is unanchored [h, w] bool."""
    hole, given = task.hole, task.guidance
    known = task.known & ~hole & np.isfinite(task.values).all(-1)
    guided, values = np.isfinite(given), np.where(known[..., None], task.values, 0)
    # SIGN OF THE GUIDANCE: u = + guidance + a constant for each part of the hole + what is solved for.
    start = np.where(guided & hole[..., None], given, 0)
    tie, amount = np.where(hole, task.pull, 0), np.zeros(start.shape)
    amount[hole] = task.pull[hole, None] * (task.anchor - start)[hole]
    flat = np.zeros(start.shape)  # pairs of which one has no guidance want no gradient, not the start's
    links = []
    for a, b in AXES:
        linked, wanted = hole[a] & hole[b], guided[a] & guided[b]
        links.append(np.zeros(hole.shape))
        links[-1][a] = linked
        for p, q in ((a, b), (b, a)):
            tied = hole[p] & known[q]
            tie[p] += tied
            beyond = values[q] - np.where(wanted, given[q], start[p])
            amount[p] += np.where(tied[..., None], beyond, 0)
            flat[p] += np.where(linked[..., None] & ~wanted, start[q] - start[p], 0)
    count, parts = cv2.connectedComponents(hole.astype(np.uint8), connectivity=4)
    strength = np.bincount(parts.ravel(), tie.ravel(), count)
    loose = hole & (strength == 0)[parts]
    if loose.any():  # what is unanchored takes its guidance; its pixels without guidance hang on those with
        taken = loose & guided.all(-1)
        lost = loose & (np.bincount(parts.ravel(), taken.ravel()) == 0)[parts]
        filled, anchored = np.where(taken[..., None], given, task.values), (task.known & ~loose) | taken
        rest = task._replace(hole=hole & ~taken & ~lost, known=anchored, values=filled)
        result, iterations, _ = _solve(rest, tolerance)
        result[taken], result[lost] = given[taken], np.nan
        return result, iterations, loose
    strength[0] = 1

    def mean(of_ties: np.ndarray) -> np.ndarray:
        """[h, w]: a part's value that balances its ties."""
        return (np.bincount(parts.ravel(), of_ties.ravel(), count) / strength)[parts]

    grids = _grids(tie, *links)
    result, most = start, 0
    for c in range(start.shape[2]):
        shift = mean(amount[..., c])
        found, iterations = _iterated(grids, amount[..., c] - tie * shift + flat[..., c], tolerance)
        # Right-hand sides add up to zero in each part. So do ties times the solution, on however few or weak ties.
        result[..., c] += np.where(hole, shift + found - mean(tie * found), 0)
        most = max(most, iterations)
    return result, most, loose


class _Grid(NamedTuple):
    """A graph of four neighbours, [h, w] each, with a border of empty cells."""

    diagonal: np.ndarray  # sum of a cell's links and ties; 0 outside the hole
    right: np.ndarray  # links to the next column
    down: np.ndarray  # links to the next row


def _grids(tie: np.ndarray, right: np.ndarray, down: np.ndarray) -> list[_Grid]:
    """From fine to coarse, down to a single cell."""
    grids: list[_Grid] = []
    while not grids or max(tie.shape) > 3:
        if grids:
            crossing = right.copy(), down.copy()
            crossing[0][:, 1::2], crossing[1][1::2] = 0, 0
            tie, right, down = _by_four(tie), *(STEPS * _by_four(links) for links in crossing)
        diagonal = tie + right + down
        diagonal[:, 1:] += right[:, :-1]
        diagonal[1:] += down[:-1]
        grids.append(_Grid(diagonal, right, down))
    return grids


def _by_four(cells: np.ndarray) -> np.ndarray:
    """Sums over 2×2 cells."""
    h, w = cells.shape
    padded = np.pad(cells[1:-1, 1:-1], ((2, 2 + h % 2), (2, 2 + w % 2)))
    return padded[::2, ::2] + padded[1::2, ::2] + padded[::2, 1::2] + padded[1::2, 1::2]


def _iterated(grids: Sequence[_Grid], right_side: np.ndarray, tolerance: float) -> tuple[np.ndarray, int]:
    """Conjugate gradients, preconditioned by a cycle (Tatebe 1993), and how many steps they took."""
    found, left = np.zeros_like(right_side), right_side.copy()
    direction, product, before = np.zeros_like(left), np.zeros_like(left), 1.0
    error = _advance(0.0, direction, product, grids[0].diagonal, found, left)
    wanted = tolerance**2 * error
    for iteration in range(MOST_ITERATIONS):
        if error <= wanted:
            return found, iteration
        correction = _cycle(grids, left)
        now = float((left * correction).sum())
        direction *= now / before
        direction += correction
        energy = _times(direction, *grids[0], product)
        if not energy > 0:  # there is nothing left that float64 can tell
            return found, iteration
        error, before = _advance(now / energy, direction, product, grids[0].diagonal, found, left), now
    return found, MOST_ITERATIONS


def _cycle(grids: Sequence[_Grid], right_side: np.ndarray) -> np.ndarray:
    """About the solution for a right-hand side: red-black relaxation down to the coarsest grid and up again."""
    sides, found = [right_side], []
    for grid in grids:
        h, w = grid.diagonal.shape
        found.append(np.zeros((h, w)))
        sides.append(np.zeros((h // 2 + 1 + h % 2, w // 2 + 1 + w % 2)))
        _descend(sides[-2], *grid, found[-1], sides[-1])
    for k in range(len(grids) - 1)[::-1]:
        _ascend(sides[k], *grids[k], found[k + 1], found[k])
    return found[0]


# What comes from a cell's neighbours is written out each time: a helper that takes arrays would count references.


@exact_kernel
def _descend(side, diagonal, right, down, u, coarser):
    """u ← relaxed from 0, red cells first; coarser += what is left then, which is nothing on black cells."""
    h, w = u.shape
    for i in range(1, h - 1):
        for j in range(1 + (i & 1), w - 1, 2):
            if diagonal[i, j] > 0:
                u[i, j] = side[i, j] / diagonal[i, j]
    for i in range(1, h - 1):
        for j in range(2 - (i & 1), w - 1, 2):
            if diagonal[i, j] > 0:
                around = right[i, j - 1] * u[i, j - 1] + right[i, j] * u[i, j + 1]
                around += down[i - 1, j] * u[i - 1, j] + down[i, j] * u[i + 1, j]
                u[i, j] = (side[i, j] + around) / diagonal[i, j]
    for i in range(1, h - 1):
        for j in range(1 + (i & 1), w - 1, 2):
            if diagonal[i, j] > 0:
                around = right[i, j - 1] * u[i, j - 1] + right[i, j] * u[i, j + 1]
                around += down[i - 1, j] * u[i - 1, j] + down[i, j] * u[i + 1, j]
                coarser[(i + 1) // 2, (j + 1) // 2] += around


@exact_kernel
def _ascend(side, diagonal, right, down, coarser, u):
    """u ← with the coarser correction, relaxed, black cells first, which need no correction of their own for that."""
    h, w = u.shape
    for i in range(1, h - 1):
        for j in range(1 + (i & 1), w - 1, 2):
            if diagonal[i, j] > 0:
                u[i, j] += coarser[(i + 1) // 2, (j + 1) // 2]
    for colour in range(2):
        for i in range(1, h - 1):
            for j in range(1 + ((i + 1 + colour) & 1), w - 1, 2):
                if diagonal[i, j] > 0:
                    around = right[i, j - 1] * u[i, j - 1] + right[i, j] * u[i, j + 1]
                    around += down[i - 1, j] * u[i - 1, j] + down[i, j] * u[i + 1, j]
                    u[i, j] = (side[i, j] + around) / diagonal[i, j]


@exact_kernel
def _times(u, diagonal, right, down, out):
    """out ← A·u; u·A·u."""
    energy = 0.0
    for i in range(1, u.shape[0] - 1):
        for j in range(1, u.shape[1] - 1):
            around = right[i, j - 1] * u[i, j - 1] + right[i, j] * u[i, j + 1]
            around += down[i - 1, j] * u[i - 1, j] + down[i, j] * u[i + 1, j]
            out[i, j] = diagonal[i, j] * u[i, j] - around
            energy += u[i, j] * out[i, j]
    return energy


@exact_kernel
def _advance(step, direction, product, diagonal, found, left):
    """found += step · direction, left −= step · product; the square of what is left over the diagonal."""
    total = 0.0
    for i in range(found.shape[0]):
        for j in range(found.shape[1]):
            if diagonal[i, j] > 0:
                found[i, j] += step * direction[i, j]
                left[i, j] -= step * product[i, j]
                total += (left[i, j] / diagonal[i, j]) ** 2
    return total


def thin_plate(values: np.ndarray, known: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """The surface u [H, W] float64 that is smoothest and nearest to the values v; NaN off its domain.

    Values are `known` and the surface `wanted` where these [H, W] bool are true; both are the domain. Minimises
    Σ w (u − v)² + λ ∫ (u_xx² + 2 u_xy² + u_yy² + |∇u − s|²/ℓ²), s the values' common slope, w 0 for outliers (Wahba
    1990: thin-plate smoothing; Franke 1985: tension), with natural boundaries, by a sparse factorisation. On curved
    ground its error is a half to a quarter of a membrane's, measured on random scenes. Parts without a value are NaN.
    """
    domain = wanted | known
    result = np.full(domain.shape, np.nan)
    if not known.any():
        return result
    window = bounds(domain)
    domain, known = domain[window], known[window]
    # Less their common slope: tension pulls at bends only, and cells that are half empty stand for their middle.
    points = np.concatenate([np.argwhere(known), np.ones((known.sum(), 1))], axis=1)
    slope = np.linalg.lstsq(points, values[window][known], rcond=None)[0]
    y, x = np.indices(domain.shape)
    trend = slope[0] * y + slope[1] * x + slope[2]
    stride = int(np.ceil(np.sqrt(domain.sum() / UNKNOWNS)))
    count = _cells(known.astype(np.float64), stride)
    mean = _cells(np.where(known, values[window] - trend, 0.0), stride) / np.maximum(count, 1)
    cells = _cells(domain.astype(np.float64), stride) > 0
    parts, _ = scipy.ndimage.label(cells)
    cells &= np.isin(parts, parts[count > 0])
    radius = max(np.sqrt(wanted.sum() / np.pi), 1.0)
    pull = (TENSION * radius / stride) ** -2
    coarse, weights, (h, w) = np.full(cells.shape, np.nan), count, domain.shape
    for smoothing in (STIFF, SMOOTHING):
        system = _energy(cells, smoothing**4 / stride**2, pull) + scipy.sparse.diags(weights[cells])
        options = {"SymmetricMode": True, "DiagPivotThresh": 0.0}
        factors = scipy.sparse.linalg.splu(system.tocsc(), permc_spec="MMD_AT_PLUS_A", options=options)
        coarse[cells] = factors.solve((weights * mean)[cells])
        # Tukey's weights of the residuals; never 0, lest a part of the domain lose all.
        off = np.where(count > 0, np.abs(coarse - mean), 0.0)
        share = off / (OUTLIER * (1.4826 * float(np.median(off[count > 0]))) + 1e-300)
        weights = count * np.maximum(1 - np.minimum(share, 1.0) ** 2, 1e-3) ** 2
    inside = domain & cells.repeat(stride, 0).repeat(stride, 1)[:h, :w]
    result[window] = np.where(inside, _refined(coarse, cells, stride)[:h, :w] + trend, np.nan)
    return result


def _cells(values: np.ndarray, stride: int) -> np.ndarray:
    """Sums over cells of stride × stride pixels."""
    h, w = (-(-n // stride) for n in values.shape)
    padded = np.pad(values, ((0, h * stride - values.shape[0]), (0, w * stride - values.shape[1])))
    return padded.reshape(h, stride, w, stride).sum((1, 3))


def _energy(cells: np.ndarray, stiffness: float, tension: float) -> scipy.sparse.csr_matrix:
    """The matrix [n, n] of the bending energy; differences that leave the domain are dropped (natural boundary)."""
    index = np.where(cells, np.cumsum(cells).reshape(cells.shape) - 1, -1)
    h, w = cells.shape
    n = int(cells.sum())
    energy = scipy.sparse.csr_matrix((n, n))
    for share, stencil in (
        (1.0, {(0, 0): 1, (0, 1): -2, (0, 2): 1}),
        (1.0, {(0, 0): 1, (1, 0): -2, (2, 0): 1}),
        (2.0, {(0, 0): 1, (0, 1): -1, (1, 0): -1, (1, 1): 1}),
        (tension, {(0, 0): -1, (0, 1): 1}),
        (tension, {(0, 0): -1, (1, 0): 1}),
    ):
        down, right = max(y for y, _ in stencil), max(x for _, x in stencil)
        if h <= down or w <= right:
            continue
        taken = np.stack([index[y : h - down + y, x : w - right + x].ravel() for y, x in stencil])
        taken = taken[:, (taken >= 0).all(0)]
        rows = np.broadcast_to(np.arange(taken.shape[1]), taken.shape)
        factors = np.repeat(np.sqrt(stiffness * share) * np.array(list(stencil.values()), float), taken.shape[1])
        difference = scipy.sparse.csr_matrix((factors, (rows.ravel(), taken.ravel())), (taken.shape[1], n))
        energy = energy + difference.T @ difference
    return energy


def _refined(coarse: np.ndarray, cells: np.ndarray, stride: int) -> np.ndarray:
    """Bicubic, from cells to pixels."""
    if stride == 1:
        return coarse
    nearest = scipy.ndimage.distance_transform_edt(~cells, return_distances=False, return_indices=True)
    size = coarse.shape[1] * stride, coarse.shape[0] * stride
    to_cells = np.array([[1, 0, 0.5], [0, 1, 0.5]]) / stride - [[0, 0, 0.5], [0, 0, 0.5]]
    flags, border = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP, cv2.BORDER_REPLICATE
    return cv2.warpAffine(coarse[tuple(nearest)], to_cells, size, flags=flags, borderMode=border)
