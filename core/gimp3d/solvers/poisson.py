"""Poisson's equation on irregular holes of an image: depth completion and seamless blending stand on it.

Conjugate gradients, preconditioned by one geometric multigrid V-cycle: the number of iterations does not grow with
the hole (Tatebe 1993; McAdams et al. 2010 for irregular domains). Kernels are serial: views run in parallel.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.ndimage
import scipy.sparse
import scipy.sparse.linalg

from ..jit import exact_kernel, kernel


@dataclass(frozen=True)
class PoissonSettings:
    """When to stop, and when another solver is better."""

    tolerance: float = 1e-5  # residual over the first residual, Euclidean norms
    most_iterations: int = 40  # then a direct solve: only mazes of one-pixel walls get there (6 are usual)
    direct_below: int = 200  # unknowns from which multigrid pays
    coarsest: int = 100  # unknowns of the coarsest grid, solved densely


@dataclass(frozen=True)
class PoissonSolution:
    """A filled array."""

    values: np.ndarray  # [H, W] or [H, W, C] float64, the input with the hole replaced
    iterations: int  # most of any channel; 0 = solved directly, or nothing to solve
    unanchored: np.ndarray  # [H, W] bool, hole pixels of components that touch no known pixel


def solve_poisson(
    hole: np.ndarray,  # [H, W] bool, unknown pixels
    known: np.ndarray,  # [H, W] bool, Dirichlet pixels; only those beside the hole matter
    values: np.ndarray,  # [H, W] or [H, W, C], fixed where known
    guidance: np.ndarray | None = None,  # like values: its 4-neighbour differences are the wanted gradients
    settings: PoissonSettings = PoissonSettings(),
    *,
    weight: np.ndarray | None = None,  # [H, W] ≥ 0, how strongly each pixel is drawn to `anchor`
    anchor: np.ndarray | None = None,  # like values, soft data (screened Poisson)
) -> PoissonSolution:
    """Solve Σ_q (u(q) − u(p)) + w(p)(a(p) − u(p)) = Σ_q (g(q) − g(p)) over the 4-neighbours q of p in hole ∪ known.

    This is paper 3.3 with its sign mended (METHOD section 3). Neighbours that are neither hole nor known, and the
    image's border, are natural (Neumann): they are dropped on both sides. A pair of pixels of which one has no finite
    guidance wants no gradient; known pixels that are not finite are not known.

    A component of the hole that touches no known pixel (and is drawn to no anchor) is reported as unanchored. It takes
    the guidance as it is: that has the wanted gradients and settles the free constant. Where there is none, it is NaN.
    """
    hole = np.asarray(hole, bool)
    result = np.array(values, dtype=np.float64)
    unanchored = np.zeros(hole.shape, bool)
    if not hole.any():
        return PoissonSolution(result, 0, unanchored)
    window = _window(hole)
    fixed, given, wanted = result[window], hole[window].copy(), None if guidance is None else guidance[window]
    rim = np.asarray(known, bool)[window] & ~given & _finite(fixed)
    drawn = None if weight is None else weight[window]
    free = _unanchored(given, rim, drawn)
    unanchored[window] = free
    if free.any() and wanted is not None:
        taken = free & _finite(wanted)
        fixed[taken] = wanted[taken]
        rim, given = rim | taken, given & ~taken
        free = _unanchored(given, rim, drawn)
    fixed[free] = np.nan
    given &= ~free
    iterations = 0
    if given.any():
        system = _system(given, rim, fixed, wanted, drawn, None if anchor is None else anchor[window])
        fixed[given], iterations = _solve(system, settings)
    return PoissonSolution(result, iterations, unanchored)


def _window(hole: np.ndarray) -> tuple[slice, slice]:
    """The hole's bounding box and one pixel round it."""
    rows, cols = np.flatnonzero(hole.any(1)), np.flatnonzero(hole.any(0))
    return slice(max(rows[0] - 1, 0), rows[-1] + 2), slice(max(cols[0] - 1, 0), cols[-1] + 2)


def _finite(values: np.ndarray) -> np.ndarray:
    """[H, W] bool: pixels finite in every channel."""
    return np.isfinite(values).reshape(*values.shape[:2], -1).all(-1)


def _unanchored(hole: np.ndarray, known: np.ndarray, weight: np.ndarray | None) -> np.ndarray:
    """[H, W] bool: components of the hole (4-connected) that nothing ties to a value."""
    components, count = scipy.ndimage.label(hole)
    tied = (
        scipy.ndimage.binary_dilation(known) if weight is None else scipy.ndimage.binary_dilation(known) | (weight > 0)
    )
    is_free = np.ones(count + 1, bool)
    is_free[components[tied]] = False
    is_free[0] = False
    return is_free[components]


@dataclass(frozen=True)
class _System:
    """A·u = right on the hole: A is `diagonal` minus the adjacency of hole pixels.

    Arrays have a border of one pixel outside the hole, and odd sides, so that every grid nests in the next finer one.
    """

    hole: np.ndarray  # [h, w] float32, 1 on unknowns
    diagonal: np.ndarray  # [h, w] float64, neighbours in hole ∪ known, plus the weight
    right: np.ndarray  # [C, h, w] float64
    shape: tuple[int, ...]  # (M,) or (M, C) of the answer


def _system(
    hole: np.ndarray,
    known: np.ndarray,
    values: np.ndarray,
    guidance: np.ndarray | None,
    weight: np.ndarray | None,
    anchor: np.ndarray | None,
) -> _System:
    h, w = hole.shape
    channels = values.shape[2] if values.ndim == 3 else 1

    def padded(array: np.ndarray | None, dtype: type, *more: int) -> np.ndarray:
        out: np.ndarray = np.zeros((h + 3 - h % 2, w + 3 - w % 2, *more), dtype)
        if array is not None:
            out[1 : h + 1, 1 : w + 1] = array.reshape(h, w, *more)
        return out

    inside = padded(hole, np.bool_)
    diagonal = np.zeros(inside.shape)
    right = np.zeros((channels, *inside.shape))
    _assemble(
        inside,
        padded(known, np.bool_),
        padded(values, np.float64, channels),
        padded(guidance, np.float64, channels),
        padded(weight, np.float64),
        padded(anchor, np.float64, channels),
        diagonal,
        right,
    )
    return _System(inside.astype(np.float32), diagonal, right, (int(hole.sum()), *values.shape[2:]))


def _solve(system: _System, settings: PoissonSettings) -> tuple[np.ndarray, int]:
    """The unknowns in row order, [M] or [M, C], and the iterations."""
    rows, cols = np.nonzero(system.hole)
    if len(rows) < settings.direct_below:
        return _solve_directly(system, rows, cols), 0
    grids = _Multigrid(system, settings.coarsest)
    answers, most = [], 0
    for right in system.right:
        u, iterations = _conjugate_gradients(system, grids, right, settings)
        if iterations > settings.most_iterations:
            return _solve_directly(system, rows, cols), 0
        answers.append(u[rows, cols])
        most = max(most, iterations)
    return np.stack(answers, -1).reshape(system.shape), most


def _solve_directly(system: _System, rows: np.ndarray, cols: np.ndarray) -> np.ndarray:
    """One sparse factor for all channels."""
    index = np.full(system.hole.shape, -1)
    index[rows, cols] = np.arange(len(rows))
    pairs = []
    for dy, dx in ((-1, 0), (1, 0), (0, -1), (0, 1)):
        neighbour = index[rows + dy, cols + dx]
        pairs.append(np.stack([np.flatnonzero(neighbour >= 0), neighbour[neighbour >= 0]]))
    links = np.concatenate(pairs, axis=1)
    adjacency = scipy.sparse.coo_matrix((np.ones(links.shape[1]), links), (len(rows), len(rows)))
    matrix = scipy.sparse.diags(system.diagonal[rows, cols]) - adjacency
    factor = scipy.sparse.linalg.splu(
        matrix.tocsc(), permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True, "DiagPivotThresh": 0.0}
    )
    return factor.solve(system.right[:, rows, cols].T).reshape(system.shape)


def _conjugate_gradients(
    system: _System,
    grids: _Multigrid,
    right: np.ndarray,  # [h, w] float64
    settings: PoissonSettings,
) -> tuple[np.ndarray, int]:
    """u [h, w] float64, and the iterations taken; one more than allowed if it did not converge."""
    hole, diagonal = system.hole, system.diagonal
    product = np.zeros(right.shape)
    # From the best constant on, so that neither the tolerance nor rounding depends on the data's offset.
    u = hole.astype(np.float64)
    _apply(u, hole, diagonal, product)
    u *= right.sum() / product.sum()
    _apply(u, hole, diagonal, product)
    residual = right - product
    enough = settings.tolerance * np.sqrt(_dot(residual, residual)) + 1e-13 * np.sqrt(_dot(right, right))
    direction, old = np.zeros(right.shape), 1.0
    for iteration in range(settings.most_iterations + 1):
        if np.sqrt(_dot(residual, residual)) <= enough:
            return u, iteration
        correction = grids.v_cycle(residual.astype(np.float32))
        new = _dot(residual, correction)
        _turn(direction, correction, 0.0 if iteration == 0 else new / old)
        old = new
        step = new / _apply(direction, hole, diagonal, product)
        _advance(u, residual, direction, product, step)
    return u, settings.most_iterations + 1


class _Multigrid:
    """Nested grids with bilinear interpolation P and Galerkin operators PᵀAP, float32.

    Coarse node (I, J) lies on fine node (2I−1, 2J−1). It is used as soon as any fine unknown interpolates from it, so
    that thin parts of the hole keep a coarse counterpart. Operators may then be singular, which does no harm: the
    right-hand sides Pᵀr are consistent, and what lies in the null space has no effect on the fine grid.
    """

    def __init__(self, system: _System, coarsest: int) -> None:
        mask, self.diagonal = system.hole, system.diagonal.astype(np.float32)
        stencil = _five_point(mask, self.diagonal)
        self.masks, self.stencils = [mask], [stencil]
        while mask.sum() > coarsest:
            sides = [(n - 1) // 2 for n in mask.shape]
            coarse = np.zeros([n + 3 - n % 2 for n in sides], np.float32)
            _restrict(mask, coarse)
            stencil = _galerkin(stencil, mask, coarse)
            mask = (coarse > 0).astype(np.float32)
            self.masks.append(mask)
            self.stencils.append(stencil)
        self.inverses = [np.where(m > 0, 1 / np.where(m > 0, s[4], 1), 0) for m, s in zip(self.masks, self.stencils)]
        self.stencils[0] = stencil[:, :0, :0]  # the finest is applied from its diagonal alone
        self.solutions, self.rights, self.residuals = ([np.zeros_like(m) for m in self.masks] for _ in range(3))
        self.nodes = np.nonzero(mask)
        self.inverse = _pseudo_inverse(stencil, mask)

    def v_cycle(self, right: np.ndarray) -> np.ndarray:
        """An approximate solution for `right` [h, w] float32: symmetric, as conjugate gradients need it."""
        last = len(self.masks) - 1
        self.rights[0] = right
        for level in range(last):
            self.solutions[level][:] = 0
            self._smooth(level, backwards=False)
            self._find_residual(level)
            _restrict(self.residuals[level], self.rights[level + 1])
        self.solutions[last][self.nodes] = self.inverse @ self.rights[last][self.nodes]
        for level in reversed(range(last)):
            _prolong(self.solutions[level + 1], self.masks[level], self.solutions[level])
            self._smooth(level, backwards=True)
        return self.solutions[0]

    def _smooth(self, level: int, backwards: bool) -> None:
        u, right, inverse = self.solutions[level], self.rights[level], self.inverses[level]
        colours = range(2 if level == 0 else 4)
        for colour in reversed(colours) if backwards else colours:
            if level == 0:
                _relax_five(u, right, inverse, colour)
            else:
                _relax_nine(u, right, self.stencils[level], inverse, colour // 2, colour % 2)

    def _find_residual(self, level: int) -> None:
        if level == 0:
            _residual_five(self.solutions[0], self.rights[0], self.masks[0], self.diagonal, self.residuals[0])
        else:
            _residual_nine(self.solutions[level], self.rights[level], self.stencils[level], self.residuals[level])


def _pseudo_inverse(stencil: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """The coarsest operator's inverse [M, M] float32 on its used nodes."""
    rows, cols = np.nonzero(mask)
    index = np.full(mask.shape, -1)
    index[rows, cols] = np.arange(len(rows))
    matrix = np.zeros((len(rows), len(rows)))
    for k in range(9):
        neighbour = index[rows + k // 3 - 1, cols + k % 3 - 1]
        linked = neighbour >= 0
        matrix[np.flatnonzero(linked), neighbour[linked]] = stencil[k, rows, cols][linked]
    # Between the rounding of float32 and the softest mode of a grid that hangs on one pixel.
    return np.linalg.pinv(matrix, rcond=1e-5, hermitian=True).astype(np.float32)


@exact_kernel
def _assemble(hole, known, values, guidance, weight, anchor, diagonal, right):
    for i in range(1, hole.shape[0] - 1):
        for j in range(1, hole.shape[1] - 1):
            if not hole[i, j]:
                continue
            diagonal[i, j] = weight[i, j]
            if weight[i, j] > 0:
                for c in range(right.shape[0]):
                    right[c, i, j] = weight[i, j] * anchor[i, j, c]
            for k in range(4):
                y = i + (k == 0) - (k == 1)
                x = j + (k == 2) - (k == 3)
                if not (hole[y, x] or known[y, x]):
                    continue
                diagonal[i, j] += 1
                for c in range(right.shape[0]):
                    wanted = guidance[i, j, c] - guidance[y, x, c]
                    if np.isfinite(wanted):
                        right[c, i, j] += wanted
                    if known[y, x]:
                        right[c, i, j] += values[y, x, c]


@kernel
def _five_point(hole, diagonal):
    """The system's stencils [9, h, w] float32, row by row round the centre 4."""
    h, w = hole.shape
    stencil = np.zeros((9, h, w), np.float32)
    for i in range(1, h - 1):
        for j in range(1, w - 1):
            if hole[i, j] > 0:
                stencil[4, i, j] = diagonal[i, j]
                stencil[1, i, j] = -hole[i - 1, j]
                stencil[3, i, j] = -hole[i, j - 1]
                stencil[5, i, j] = -hole[i, j + 1]
                stencil[7, i, j] = -hole[i + 1, j]
    return stencil


@kernel
def _galerkin(stencil, mask, coarse):
    """PᵀAP as stencils [9, H, W] float32 on the nodes where `coarse` > 0."""
    h, w = coarse.shape
    product = np.zeros((9, h, w), np.float32)
    total = np.zeros(9)
    for I in range(1, h - 1):
        for J in range(1, w - 1):
            if coarse[I, J] == 0:
                continue
            total[:] = 0
            for di in range(-1, 2):
                for dj in range(-1, 2):
                    i, j = 2 * I - 1 + di, 2 * J - 1 + dj
                    if mask[i, j] == 0:
                        continue
                    share = (1.0 if di == 0 else 0.5) * (1.0 if dj == 0 else 0.5)
                    for k in range(9):
                        link = stencil[k, i, j]
                        if link == 0:
                            continue
                        y, x = i + k // 3 - 1, j + k % 3 - 1
                        between_rows, between_cols = (y + 1) & 1, (x + 1) & 1
                        link *= share * (0.5 if between_rows else 1.0) * (0.5 if between_cols else 1.0)
                        for a in range(between_rows + 1):
                            for b in range(between_cols + 1):
                                total[((y + 1) // 2 + a - I + 1) * 3 + (x + 1) // 2 + b - J + 1] += link
            for k in range(9):
                product[k, I, J] = total[k]
    return product


@kernel
def _restrict(fine, coarse):
    """coarse ← Pᵀ fine."""
    for I in range(1, (fine.shape[0] + 1) // 2):
        i = 2 * I - 1
        for J in range(1, (fine.shape[1] + 1) // 2):
            j = 2 * J - 1
            coarse[I, J] = (
                fine[i, j]
                + np.float32(0.5) * (fine[i - 1, j] + fine[i + 1, j] + fine[i, j - 1] + fine[i, j + 1])
                + np.float32(0.25) * (fine[i - 1, j - 1] + fine[i - 1, j + 1] + fine[i + 1, j - 1] + fine[i + 1, j + 1])
            )


@kernel
def _prolong(coarse, mask, fine):
    """fine ← fine + P coarse."""
    half, quarter = np.float32(0.5), np.float32(0.25)
    for i in range(1, mask.shape[0] - 1):
        I, I1 = (i + 1) // 2, i // 2 + 1
        for j in range(1, mask.shape[1] - 1, 2):
            J = (j + 1) // 2
            fine[i, j] += mask[i, j] * half * (coarse[I, J] + coarse[I1, J])
        for j in range(2, mask.shape[1] - 1, 2):
            J = j // 2
            fine[i, j] += mask[i, j] * quarter * (coarse[I, J] + coarse[I1, J] + coarse[I, J + 1] + coarse[I1, J + 1])


@kernel
def _relax_five(u, right, inverse, colour):
    """One colour of a red-black Gauss–Seidel sweep; `inverse` is 0 outside the hole."""
    for i in range(1, u.shape[0] - 1):
        for j in range(1 + ((i + colour) & 1), u.shape[1] - 1, 2):
            u[i, j] = inverse[i, j] * (right[i, j] + u[i - 1, j] + u[i + 1, j] + u[i, j - 1] + u[i, j + 1])


@kernel
def _residual_five(u, right, mask, diagonal, residual):
    for i in range(1, u.shape[0] - 1):
        for j in range(1, u.shape[1] - 1):
            around = u[i - 1, j] + u[i + 1, j] + u[i, j - 1] + u[i, j + 1]
            residual[i, j] = mask[i, j] * (right[i, j] - diagonal[i, j] * u[i, j] + around)


@kernel
def _relax_nine(u, right, s, inverse, first_row, first_col):
    """One of the four colours of a Gauss–Seidel sweep."""
    for i in range(1 + first_row, u.shape[0] - 1, 2):
        for j in range(1 + first_col, u.shape[1] - 1, 2):
            above = s[0, i, j] * u[i - 1, j - 1] + s[1, i, j] * u[i - 1, j] + s[2, i, j] * u[i - 1, j + 1]
            beside = s[3, i, j] * u[i, j - 1] + s[5, i, j] * u[i, j + 1]
            below = s[6, i, j] * u[i + 1, j - 1] + s[7, i, j] * u[i + 1, j] + s[8, i, j] * u[i + 1, j + 1]
            u[i, j] = inverse[i, j] * (right[i, j] - above - beside - below)


@kernel
def _residual_nine(u, right, s, residual):
    for i in range(1, u.shape[0] - 1):
        for j in range(1, u.shape[1] - 1):
            above = s[0, i, j] * u[i - 1, j - 1] + s[1, i, j] * u[i - 1, j] + s[2, i, j] * u[i - 1, j + 1]
            beside = s[3, i, j] * u[i, j - 1] + s[4, i, j] * u[i, j] + s[5, i, j] * u[i, j + 1]
            below = s[6, i, j] * u[i + 1, j - 1] + s[7, i, j] * u[i + 1, j] + s[8, i, j] * u[i + 1, j + 1]
            residual[i, j] = right[i, j] - above - beside - below


@kernel
def _apply(u, hole, diagonal, product):
    """product ← A·u; returns uᵀA·u."""
    total = 0.0
    for i in range(1, u.shape[0] - 1):
        for j in range(1, u.shape[1] - 1):
            around = u[i - 1, j] + u[i + 1, j] + u[i, j - 1] + u[i, j + 1]
            product[i, j] = hole[i, j] * (diagonal[i, j] * u[i, j] - around)
            total += u[i, j] * product[i, j]
    return total


@kernel
def _dot(a, b):
    total = 0.0
    for i in range(a.shape[0]):
        for j in range(a.shape[1]):
            total += a[i, j] * b[i, j]
    return total


@kernel
def _turn(direction, correction, keep):
    for i in range(direction.shape[0]):
        for j in range(direction.shape[1]):
            direction[i, j] = correction[i, j] + keep * direction[i, j]


@kernel
def _advance(u, residual, direction, product, step):
    for i in range(u.shape[0]):
        for j in range(u.shape[1]):
            u[i, j] += step * direction[i, j]
            residual[i, j] -= step * product[i, j]
