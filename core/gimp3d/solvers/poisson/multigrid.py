"""Conjugate gradients preconditioned by a geometric multigrid cycle, on the pixels of an irregular hole.

More than 500 lines, as its kernels share one layout of the grids. What could stand in is slower: pyamg 15–27 times
(`make bench-poisson`), SciPy's sparse LU 40 times at 11,000 pixels and 120 times at 300,000.

A·u = right, where A is a diagonal D less the adjacency of the hole's pixels (4 neighbours): the discrete Poisson
equation. Multigrid as a preconditioner: Tatebe 1993; on irregular domains: McAdams et al. 2010.

**Black pixels only.** Pixels whose row and column add up to an even number are black, the others red; all neighbours
of a pixel have the other colour. Red unknowns are eliminated, u_r = (right_r + Σ u_b) / D_r, and conjugate gradients
run on black ones. Red-black Gauss–Seidel smoothing does the same with twice the work: with nothing left on red pixels,
relaxing black ones from zero is a division by D, and leaves a residual on red ones only. So on the finest grid a cycle
is: the residual on red, restricted; the correction interpolated to red, and one half-sweep over black. Each colour
lies in an array of its own, pixel (i, j) at [i, j // 2], so that loops run over neighbouring memory.

**Coarser grids.** Node (I, J) lies on node (2I−1, 2J−1) of the next finer grid. Bilinear interpolation P, Galerkin
operators PᵀAP: symmetric nine-point stencils, of which the centre and the links to the right and below are stored.
A node is used as soon as any finer unknown interpolates from it, so that thin parts of the hole keep a coarse
counterpart. Operators may then be singular, which does no harm: right-hand sides Pᵀr are consistent, and what lies in
the null space has no effect on the finest grid. The smoother is one Jacobi step; W-cycles, where grids are large, make
up for what it leaves near irregular rims: without them iterations grow with the hole.

**Two precisions.** Iterations are in float32. What they find is gathered, and the residual found anew, in
float64 (van der Vorst and Ye 2000): the result is as accurate as if all was done in that.

Only the stretches of rows that hold unknowns ("spans") are visited. Everything outside the hole is zero at all times,
which is why kernels need no tests. They are serial: views run in parallel.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ...compute.jit import inline_kernel, kernel

DIGITS = 5e-6  # by which float32 may lower the residual before it is found anew
COARSEST = 16  # nodes of the last grid, solved directly
MANY = 1000  # grids of more nodes are visited twice
GAP = 8  # spans go on over gaps of so many places
DAMPING = 0.9  # of the Jacobi step, against one that could just diverge
INSIDE, PLAIN = 1, 2  # flags of pixels and nodes: an unknown; its stencil is that of the inner hole
# PᵀAP in one dimension: what the link d − 1 of the finer node a − 1 gives to the link J − 1 of the node in the middle
NEAR = (-1, 0, 1)
SHARES = np.array([[[(1 - abs(a) / 2) * max(0, 1 - abs(a + d - 2 * J) / 2) for J in NEAR] for d in NEAR] for a in NEAR])
DESCEND, DESCEND_AGAIN, ASCEND, SOLVE = range(4)  # tasks of a cycle
ONE, TWO = np.uint64(1), np.uint64(2)  # places are unsigned: numba would wrap signed ones, and not vectorise


class Fine(NamedTuple):
    """The finest grid. Its arrays hold one colour, [rows · stride]."""

    rows: int
    stride: int
    diagonal: np.ndarray  # float32, D of black pixels
    inverse: np.ndarray  # [2, ·] float32, 1 / D of black and red, 0 outside the hole
    first: np.ndarray  # [rows + 1] int64: row i has the spans first[i] … first[i + 1] − 1
    spans: np.ndarray  # [·, 2] uint64, from and to which place; for both colours


class Coarse(NamedTuple):
    """All coarser grids, one behind the other in flat arrays; grid 0 is the finest of them."""

    rows: np.ndarray  # [grids] int64
    strides: np.ndarray  # [grids] uint64
    offsets: np.ndarray  # [grids] uint64, places where they begin
    first_rows: np.ndarray  # [grids] int64, where they begin in `first`
    first: np.ndarray  # as in Fine
    spans: np.ndarray  # as in Fine; from odd to odd columns
    stencils: np.ndarray  # [5, places] float32: centre, right, below left, below, below right
    steps: np.ndarray  # [places] float32, of the Jacobi smoother
    nodes: np.ndarray  # [N] uint64, unknowns of the last grid
    inverse: np.ndarray  # [N, N] float32
    tasks: np.ndarray  # [·, 2] int64, (grid, what is done there) of a cycle


class Work(NamedTuple):
    """Vectors, float32: five on the black pixels of the finest grid, three on all coarser grids."""

    x: np.ndarray  # what was found since the residual was last found anew
    t: np.ndarray  # the residual over D
    p: np.ndarray  # the direction of search
    q: np.ndarray  # A·p over D
    z: np.ndarray  # t after a cycle
    b: np.ndarray  # right-hand sides
    v: np.ndarray  # solutions half-way
    w: np.ndarray  # solutions


class Multigrid:
    """The system of a hole, for any number of right-hand sides.

    `inside` [rows, columns] uint8 has bit 0 set in the hole, odd sides, and a border outside the hole; `runs` [R, ≥ 3]
    int64 are row, first and end column of each run of pixels in it. At `places` [T] int64 (places_of), D is above the
    number of neighbours in the hole by `strengths` [T].
    """

    def __init__(self, inside: np.ndarray, runs: np.ndarray, places: np.ndarray, strengths: np.ndarray) -> None:
        rows, columns = inside.shape
        stride = row_stride(columns // 2 + 1)
        self.inverse, self.right, self.u = np.zeros((3, 2, rows * stride))
        inverse = np.zeros(self.inverse.shape, np.float32)
        diagonal, *fine_vectors = np.zeros((6, rows * stride), np.float32)
        np.add.at(self.inverse.reshape(-1), places, strengths)
        first, spans = _find_spans(runs, rows, stride)
        flags = np.zeros(inside.shape, np.uint8)
        _fill(inside, first, spans, stride, self.inverse, inverse, diagonal, flags)
        self.fine = Fine(rows, stride, diagonal, inverse, first, spans)
        self.coarse = _coarsen(flags, self.fine)
        self.work = Work(*fine_vectors, *np.zeros((3, self.coarse.steps.size), np.float32))

    def solve(
        self, places: np.ndarray, amounts: np.ndarray, tolerance: float, most_iterations: int
    ) -> tuple[int, bool]:
        """Set `u` [2, rows · stride]; the iterations taken, and whether they converged.

        On the right are `amounts` [T], of about unit size, at `places` (always the same), elsewhere 0. They have
        converged when the residual, each equation divided by its D, is at most `tolerance` times the first one
        (Euclidean norms), or when rounding lets it fall no further.
        """
        self.u[...] = 0
        self.right.reshape(-1)[places] = 0
        np.add.at(self.right.reshape(-1), places, amounts.astype(self.right.dtype))
        norm = _find_residual(self.fine, self.inverse, self.right, self.u, self.work)
        enough, iterations, steepness = tolerance * norm, 0, 0.0
        while norm > enough:
            left = most_iterations - iterations
            if left == 0:
                return iterations, False
            target = max(0.9 * enough, DIGITS * norm)  # 0.9: what float32 follows is not quite the true residual
            taken, steepness = _iterate(self.fine, self.coarse, self.work, steepness, target, left)
            iterations += taken
            before, norm = norm, _find_residual(self.fine, self.inverse, self.right, self.u, self.work)
            if norm > 0.5 * before and taken < left:
                break
        return iterations, True


def places_of(rows: np.ndarray, columns: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Where pixels of an image of this shape lie in arrays [2, rows · stride], flattened."""
    stride = row_stride(shape[1] // 2 + 1)
    return ((rows + columns) & 1) * (shape[0] * stride) + rows * stride + columns // 2


def row_stride(columns: int) -> int:
    """Places for a row: two more than columns, because restriction looks beyond the last one; whole cache lines, an
    odd number of them so that rows do not compete for the same part of the cache."""
    return 16 * (-(-(columns + 2) // 16) | 1)


@kernel
def _find_residual(fine, inverse, right, u, work):
    """u ← u + x on black pixels, x ← 0; red ones follow. t ← (right − A·u) / D, which is on black only; its norm."""
    n, x, t = np.uint64(fine.stride), work.x, work.t
    squares = 0.0
    for i in range(1, fine.rows + 1):
        if i < fine.rows - 1:
            for s in range(fine.first[i], fine.first[i + 1]):
                for k in range(fine.spans[s, 0], fine.spans[s, 1]):
                    u[0, k] += x[k]
                    x[k] = 0
        if 1 < i < fine.rows:
            odd = np.uint64((i - 1) & 1)
            for s in range(fine.first[i - 1], fine.first[i]):
                for k in range(fine.spans[s, 0], fine.spans[s, 1]):
                    around = u[0, k - n] + u[0, k + n] + u[0, k - odd] + u[0, k + ONE - odd]
                    u[1, k] = inverse[1, k] * (right[1, k] + around)
        if i > 2:
            odd = np.uint64(i & 1)
            for s in range(fine.first[i - 2], fine.first[i - 1]):
                for k in range(fine.spans[s, 0], fine.spans[s, 1]):
                    around = u[1, k - n] + u[1, k + n] + u[1, k - ONE + odd] + u[1, k + odd]
                    residual = inverse[0, k] * (right[0, k] + around) - u[0, k]
                    t[k] = residual
                    squares += residual * residual
    return np.sqrt(squares)


@kernel
def _iterate(fine, coarse, work, steepness, target, most):
    """Conjugate gradients until the norm of t is at most `target`, or `most` iterations; their number.

    x gains what is found. p and `steepness`, t·z in D, go from call to call: directions stay conjugate.
    """
    alpha = np.float32(0)
    for iteration in range(most + 1):
        squares = _advance(fine, coarse, work, alpha)
        if iteration == most or squares <= target * target:
            break
        for s in range(len(coarse.tasks)):
            g, task = coarse.tasks[s]
            if task == SOLVE:
                _solve_coarsest(coarse, work)
            elif task == ASCEND:
                _ascend(coarse, work, g)
            else:
                _descend(coarse, work, g, task == DESCEND_AGAIN)
        before, steepness = steepness, _correct(fine, coarse, work)
        # No direction is kept where float32 had followed the residual down to a wrong one
        keep = before > 0 and (iteration > 0 or steepness < before)
        curvature = _turn(fine, work, np.float32(steepness / before if keep else 0))
        alpha = np.float32(steepness / curvature if curvature > 0 else 0)
    return iteration, steepness


@inline_kernel
def _advance(fine, coarse, work, alpha):
    """x ← x + αp, t ← t − αq; the squares of t. b ← what is then left on red pixels, restricted; q is used up."""
    x, t, p, q, b = work.x, work.t, work.p, work.q, work.b
    n, half = np.uint64(fine.stride), np.float32(0.5)
    squares = 0.0
    for i in range(1, fine.rows + 1):
        if i < fine.rows - 1:
            for s in range(fine.first[i], fine.first[i + 1]):
                total = np.float32(0)
                for k in range(fine.spans[s, 0], fine.spans[s, 1]):
                    x[k] += alpha * p[k]
                    value = t[k] - alpha * q[k]
                    t[k] = value
                    total += value * value
                squares += float(total)
        if 1 < i < fine.rows:
            odd = np.uint64((i - 1) & 1)
            for s in range(fine.first[i - 1], fine.first[i]):
                for k in range(fine.spans[s, 0], fine.spans[s, 1]):
                    around = t[k - n] + t[k + n] + t[k - odd] + t[k + ONE - odd]
                    q[k] = around if fine.inverse[1, k] > 0 else np.float32(0)
        if i > 2 and i & 1:
            I = i // 2
            r = coarse.first_rows[0] + I
            shift = np.uint64(2 * I - 1) * n - coarse.offsets[0] - np.uint64(I) * coarse.strides[0]
            for s in range(coarse.first[r], coarse.first[r + 1]):
                for k in range(coarse.spans[s, 0], coarse.spans[s, 1]):
                    f = k + shift
                    b[k] = half * (q[f - n - ONE] + q[f + n - ONE] + q[f - ONE] + q[f])
    return squares


@inline_kernel
def _descend(coarse, work, g, again):
    """v ← a Jacobi step from zero, or w; w ← its residual, restricted to the next grid's b."""
    b, v, w, steps = work.b, work.v, work.w, coarse.steps
    n, half, quarter = coarse.strides[g], np.float32(0.5), np.float32(0.25)
    for i in range(1, coarse.rows[g] + 1):
        r = coarse.first_rows[g] + i
        if i < coarse.rows[g] - 1:
            for s in range(coarse.first[r], coarse.first[r + 1]):
                for k in range(coarse.spans[s, 0], coarse.spans[s, 1]):
                    v[k] = w[k] if again else steps[k] * b[k]
        if 1 < i < coarse.rows[g]:
            for s in range(coarse.first[r - 1], coarse.first[r]):
                for k in range(coarse.spans[s, 0], coarse.spans[s, 1]):
                    w[k] = b[k] - _times(coarse.stencils, v, k, n)
        if i > 2 and i & 1:
            I = i // 2
            R = coarse.first_rows[g + 1] + I
            shift = coarse.offsets[g] + np.uint64(2 * I - 1) * n - ONE
            base = coarse.offsets[g + 1] + np.uint64(I) * coarse.strides[g + 1]
            for s in range(coarse.first[R], coarse.first[R + 1]):
                for k in range(coarse.spans[s, 0], coarse.spans[s, 1]):
                    f = shift + (k - base) + (k - base)
                    beside = w[f - ONE] + w[f + ONE] + w[f - n] + w[f + n]
                    corners = w[f - n - ONE] + w[f - n + ONE] + w[f + n - ONE] + w[f + n + ONE]
                    b[k] = w[f] + half * beside + quarter * corners


@inline_kernel
def _solve_coarsest(coarse, work):
    for i in range(len(coarse.nodes)):
        total = np.float32(0)
        for j in range(len(coarse.nodes)):
            total += coarse.inverse[i, j] * work.b[coarse.nodes[j]]
        work.w[coarse.nodes[i]] = total


@inline_kernel
def _ascend(coarse, work, g):
    """v ← v + the next grid's w, interpolated; w ← v after a Jacobi step."""
    b, v, w, steps = work.b, work.v, work.w, coarse.steps
    n, m, half = coarse.strides[g], coarse.strides[g + 1], np.float32(0.5)
    for i in range(1, coarse.rows[g]):
        r = coarse.first_rows[g] + i
        if i < coarse.rows[g] - 1:
            base = coarse.offsets[g] + np.uint64(i) * n
            above = coarse.offsets[g + 1] + np.uint64((i + 1) // 2) * m
            below = coarse.offsets[g + 1] + np.uint64(i // 2 + 1) * m
            for s in range(coarse.first[r], coarse.first[r + 1]):
                k0 = coarse.spans[s, 0]
                pairs, J = (coarse.spans[s, 1] - k0) // TWO, (k0 - base + ONE) // TWO
                for e in range(pairs):
                    left = half * (w[above + J + e] + w[below + J + e])
                    right = half * (w[above + J + e + ONE] + w[below + J + e + ONE])
                    v[k0 + e + e] += left
                    v[k0 + e + e + ONE] += half * (left + right)
        if i > 1:
            for s in range(coarse.first[r - 1], coarse.first[r]):
                for k in range(coarse.spans[s, 0], coarse.spans[s, 1]):
                    w[k] = v[k] + steps[k] * (b[k] - _times(coarse.stencils, v, k, n))


@inline_kernel
def _correct(fine, coarse, work):
    """z ← t after a cycle; the product of t and z in D. q is used up."""
    t, q, z, w = work.t, work.q, work.z, work.w
    n, m, half = np.uint64(fine.stride), coarse.strides[0], np.float32(0.5)
    product = 0.0
    for i in range(1, fine.rows):
        if i < fine.rows - 1:
            # A red pixel lies between two nodes: side by side in odd rows, one above the other in even ones.
            odd = np.uint64(i & 1)
            shift = coarse.offsets[0] + np.uint64((i + 1) // 2) * m + ONE - odd - np.uint64(i) * n
            other = shift + (ONE if odd else m)
            for s in range(fine.first[i], fine.first[i + 1]):
                for k in range(fine.spans[s, 0], fine.spans[s, 1]):
                    between = half * (w[k + shift] + w[k + other])
                    q[k] = between if fine.inverse[1, k] > 0 else np.float32(0)
        if i > 1:
            odd = np.uint64((i - 1) & 1)
            for s in range(fine.first[i - 1], fine.first[i]):
                total = np.float32(0)
                for k in range(fine.spans[s, 0], fine.spans[s, 1]):
                    around = q[k - n] + q[k + n] + q[k - ONE + odd] + q[k + odd]
                    value = t[k] + fine.inverse[0, k] * around
                    z[k] = value
                    total += fine.diagonal[k] * t[k] * value
                product += float(total)
    return product


@inline_kernel
def _turn(fine, work, beta):
    """p ← z + βp, q ← A·p / D with red pixels eliminated; the product of p and q in D. z is used up."""
    z, p, q = work.z, work.p, work.q
    n = np.uint64(fine.stride)
    product = 0.0
    for i in range(1, fine.rows + 1):
        if i < fine.rows - 1:
            for s in range(fine.first[i], fine.first[i + 1]):
                for k in range(fine.spans[s, 0], fine.spans[s, 1]):
                    p[k] = z[k] + beta * p[k]
        if 1 < i < fine.rows:
            odd = np.uint64((i - 1) & 1)
            for s in range(fine.first[i - 1], fine.first[i]):
                for k in range(fine.spans[s, 0], fine.spans[s, 1]):
                    z[k] = fine.inverse[1, k] * (p[k - n] + p[k + n] + p[k - odd] + p[k + ONE - odd])
        if i > 2:
            odd = np.uint64(i & 1)
            for s in range(fine.first[i - 2], fine.first[i - 1]):
                total = np.float32(0)
                for k in range(fine.spans[s, 0], fine.spans[s, 1]):
                    around = z[k - n] + z[k + n] + z[k - ONE + odd] + z[k + odd]
                    value = p[k] - fine.inverse[0, k] * around
                    q[k] = value
                    total += fine.diagonal[k] * p[k] * value
                product += float(total)
    return product


@inline_kernel
def _times(stencils, u, k, n):
    """A·u at node k."""
    total = stencils[0, k] * u[k] + stencils[1, k] * u[k + ONE] + stencils[1, k - ONE] * u[k - ONE]
    total = total + stencils[2, k] * u[k + n - ONE] + stencils[2, k - n + ONE] * u[k - n + ONE]
    total = total + stencils[3, k] * u[k + n] + stencils[3, k - n] * u[k - n]
    return total + stencils[4, k] * u[k + n + ONE] + stencils[4, k - n - ONE] * u[k - n - ONE]


@kernel
def _find_spans(runs, rows, stride):
    first = np.zeros(rows + 1, np.int64)
    spans = np.empty((len(runs), 2), np.uint64)
    count, r = 0, 0
    for i in range(rows):
        first[i] = count
        while r < len(runs) and runs[r, 0] == i:
            start, end = i * stride + runs[r, 1] // 2, i * stride + (runs[r, 2] + 1) // 2
            if count == first[i] or start > np.int64(spans[count - 1, 1]) + GAP:
                spans[count, 0] = start
                count += 1
            spans[count - 1, 1] = end
            r += 1
    first[rows] = count
    return first, spans


@kernel
def _fill(inside, first, spans, stride, inverse, inverse32, diagonal, flags):
    """`inverse` holds what D is above the number of neighbours, and then 1 / D."""
    for i in range(1, inside.shape[0] - 1):
        for s in range(first[i], first[i + 1]):
            for half in range(2):
                colour = (i + half) & 1
                for k in range(spans[s, 0], spans[s, 1]):
                    j = 2 * (np.int64(k) - i * stride) + half
                    if not inside[i, j] & 1:
                        continue
                    around = (inside[i - 1, j] & 1) + (inside[i + 1, j] & 1) + (inside[i, j - 1] & 1)
                    around += inside[i, j + 1] & 1
                    d = around + inverse[colour, k]
                    flags[i, j] = INSIDE | PLAIN if around == 4 and d == 4 else INSIDE
                    inverse[colour, k] = 1 / d
                    inverse32[colour, k] = inverse[colour, k]
                    if colour == 0:
                        diagonal[k] = d


def _coarsen(flags: np.ndarray, fine: Fine) -> Coarse:
    """The hierarchy of grids over that of the pixels with these flags."""
    sides: list[tuple[int, ...]] = [flags.shape]
    nodes: list[tuple[int, ...]] = []
    while not nodes or nodes[-1][0] * nodes[-1][1] > COARSEST:
        nodes.append(tuple((n - 1) // 2 for n in sides[-1]))
        sides.append(tuple(n + 3 - n % 2 for n in nodes[-1]))
    rows = np.array([r for r, _ in sides[1:]])
    strides = np.array([row_stride(c) for _, c in sides[1:]])
    ends, row_ends = np.cumsum(rows * strides), np.cumsum(rows)
    offsets, first_rows = np.append(0, ends[:-1]), np.append(0, row_ends[:-1])
    first = np.zeros(row_ends[-1] + 1, np.int64)
    spans = np.empty((sum(r * (c // GAP + 1) for r, c in nodes), 2), np.uint64)
    marks = np.zeros(ends[-1], np.uint8)
    stencils = np.zeros((6, ends[-1] + strides[-1]), np.float32)
    places = strides.astype(np.uint64), offsets.astype(np.uint64)
    _build(flags, fine, np.array(nodes), rows, *places, first_rows, first, spans, marks, stencils[:5], stencils[5])
    last = (np.flatnonzero(marks[offsets[-1] :]) + offsets[-1]).astype(np.uint64)
    inverse = _invert(stencils, last, strides[-1])
    tasks = np.array(_cycle([r * c > MANY for r, c in nodes[1:]]))
    return Coarse(rows, *places, first_rows, first, spans, stencils[:5], stencils[5], last, inverse, tasks)


def _cycle(twice: list[bool], grid: int = 0, task: int = DESCEND) -> list[tuple[int, int]]:
    """The tasks of a cycle that begins with `task` on a grid; the grid below is visited twice or once."""
    if grid == len(twice):
        return [(grid, SOLVE)]
    below = _cycle(twice, grid + 1) + (_cycle(twice, grid + 1, DESCEND_AGAIN) if twice[grid] else [])
    return [(grid, task), *below, (grid, ASCEND)]


@kernel
def _build(flags, fine, nodes, rows, strides, offsets, first_rows, first, spans, marks, stencils, steps):
    """Marks (the flags of nodes), spans, stencils and steps, grid by grid."""
    count, around, scratch = 0, np.zeros((3, 3)), np.zeros((2, 3, 3))
    for g in range(len(rows)):
        finer = flags.reshape(-1) if g == 0 else marks
        m = np.uint64(flags.shape[1]) if g == 0 else strides[g - 1]
        origin = np.uint64(0) if g == 0 else offsets[g - 1]
        plain = np.uint64(0)  # a node with the stencil of the inner hole
        for i in range(1, nodes[g, 0] + 1):
            base, r, end = offsets[g] + np.uint64(i) * strides[g], first_rows[g] + i, 0
            below = origin + np.uint64(2 * i - 1) * m
            _mark(finer, below, m, marks, base, nodes[g, 1])
            first[r] = count
            for j in range(1, nodes[g, 1] + 1):
                if marks[base + np.uint64(j)]:
                    if end == 0 or j > end + GAP:
                        spans[count, 0] = base + np.uint64((j - 1) // 2 * 2 + 1)
                        count += 1
                    end = (j + 1) // 2 * 2 + 1
                    spans[count - 1, 1] = base + np.uint64(end)
            for s in range(first[r], count):
                for k in range(spans[s, 0], spans[s, 1]):
                    if marks[k] & PLAIN and plain > 0:
                        for d in range(5):
                            stencils[d, k] = stencils[d, plain]
                        steps[k] = steps[plain]
                    elif marks[k]:
                        _collapse(g == 0, finer, fine, stencils, below + TWO * (k - base) - ONE, m, around, scratch)
                        size = 0.0
                        for d in range(9):
                            size += abs(around[d // 3, d % 3])
                        for d in range(5):
                            stencils[d, k] = around[(4 + d) // 3, (4 + d) % 3]
                        # Gershgorin: an eigenvalue of 2 would diverge
                        steps[k] = min(2 * DAMPING / size, 1 / around[1, 1])
                        if marks[k] & PLAIN:
                            plain = np.uint64(k)
        first[first_rows[g] + nodes[g, 0] + 1 : first_rows[g] + rows[g] + 1] = count


@kernel
def _collapse(finest, finer, fine, stencils, f, m, around, scratch):
    """around ← the entries [3, 3] of PᵀAP at the node that lies on the finer place f, from the equations [3, 3]
    there."""
    equation, beside = scratch[0], scratch[1]
    equation[:], around[:] = 0, 0
    for y in range(3):
        beside[:] = 0
        for x in range(3):
            k = f + np.uint64(y) * m + np.uint64(x) - m - ONE
            if finer[k]:
                if finest:
                    i, j = np.int64(k // m), np.int64(k % m)
                    equation[1, 1] = 1 / fine.inverse[(i + j) & 1, i * fine.stride + j // 2]
                    equation[0, 1], equation[2, 1] = -(finer[k - m] & INSIDE), -(finer[k + m] & INSIDE)
                    equation[1, 0], equation[1, 2] = -(finer[k - ONE] & INSIDE), -(finer[k + ONE] & INSIDE)
                else:
                    equation[0, 0], equation[0, 1] = stencils[4, k - m - ONE], stencils[3, k - m]
                    equation[0, 2], equation[1, 0] = stencils[2, k - m + ONE], stencils[1, k - ONE]
                    equation[1, 1], equation[1, 2] = stencils[0, k], stencils[1, k]
                    equation[2, 0], equation[2, 1], equation[2, 2] = stencils[2, k], stencils[3, k], stencils[4, k]
                for d in range(3):
                    for e in range(3):
                        for J in range(3):
                            beside[d, J] += SHARES[x, e, J] * equation[d, e]
        for d in range(3):
            for I in range(3):
                for J in range(3):
                    around[I, J] += SHARES[y, d, I] * beside[d, J]


@kernel
def _mark(finer, start, n, marks, base, count):
    """A row of nodes: used if any finer one is that depends on it, plain if all are."""
    for J in range(ONE, np.uint64(count + 1)):
        f = start + J + J - ONE
        a, b, c = finer[f - n - ONE], finer[f - n], finer[f - n + ONE]
        d, e, g = finer[f - ONE], finer[f], finer[f + ONE]
        h, i, j = finer[f + n - ONE], finer[f + n], finer[f + n + ONE]
        some, every = a | b | c | d | e | g | h | i | j, a & b & c & d & e & g & h & i & j
        marks[base + J] = some & INSIDE | every & PLAIN


@kernel
def _invert(stencils, nodes, stride):
    """A generalised inverse [N, N] of the last grid's operator: what has no pivot stays zero."""
    count = len(nodes)
    a = np.zeros((count, count))
    least = np.zeros(count)
    for i in range(count):
        a[i, i] = stencils[0, nodes[i]]
        least[i] = 1e-5 * a[i, i]
        for j in range(i + 1, count):
            apart = np.int64(nodes[j] - nodes[i])
            which = 1 if apart == 1 else apart - stride + 3
            if apart == 1 or 2 <= which <= 4:
                a[i, j] = a[j, i] = stencils[which, nodes[i]]
    for k in range(count):  # Gauss–Jordan; the sweep operator of Goodnight 1979
        pivot = a[k, k]
        usable = pivot > least[k]
        for i in range(count):
            factor = a[i, k] / pivot if usable else 0.0
            if i != k:
                for j in range(count):
                    a[i, j] -= factor * a[k, j]
                a[i, k] = -factor
        for j in range(count):
            a[k, j] = a[k, j] / pivot if usable else 0.0
        a[k, k] = 1 / pivot if usable else 0.0
    return a.astype(np.float32)
