"""The equations of a hole: what its pixels are tied to, and how strongly; `multigrid.py` solves them.

What is solved for is the difference to the guidance plus a constant for each component of the hole. It is smooth, and
its right-hand side is the mismatch along the rim.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import scipy.ndimage
import scipy.sparse
import scipy.sparse.linalg

from ...compute.jit import exact_kernel, kernel
from .multigrid import Multigrid, places_of

HOLE, KNOWN = 1, 16  # kinds of pixels: a sum over the four neighbours counts both
LEAST_WEIGHT, MOST_WEIGHT = 1e-30, 1e30  # what float32 can hold


@dataclass(frozen=True)
class PoissonSettings:
    """When to stop."""

    # Residual over that of the guidance plus one constant per component, each equation divided by its diagonal
    tolerance: float = 1e-5
    # Then a direct solve, as in mazes of one-pixel walls. 5 are usual; 280, among many seams, are still faster
    most_iterations: int = 600


@dataclass(frozen=True)
class PoissonSolution:
    """A filled array, or only the M pixels of the hole, in the order of array[hole]."""

    values: np.ndarray  # [H, W] or [H, W, C], the input with the hole replaced; or [M] or [M, C]
    iterations: int  # most of any channel; 0 = solved directly, or nothing to solve
    unanchored: np.ndarray  # [H, W] or [M] bool, hole pixels of components that touch no known pixel


def solve_poisson(
    hole: np.ndarray,  # [H, W] bool, unknown pixels
    known: np.ndarray,  # [H, W] bool, Dirichlet pixels; only those beside the hole matter
    values: np.ndarray,  # [H, W] or [H, W, C], fixed where known
    guidance: np.ndarray | None = None,  # like values: its 4-neighbour differences are the wanted gradients
    settings: PoissonSettings = PoissonSettings(),
    *,
    weight: np.ndarray | None = None,  # [H, W] ≥ 0, how strongly each pixel is drawn to `anchor` (or to 0)
    anchor: np.ndarray | None = None,  # like values, soft data (screened Poisson)
    only_hole: bool = False,  # for large images with small holes: nothing else is made and returned
) -> PoissonSolution:
    """Solve Σ_q (u(q) − u(p)) + w(p)(a(p) − u(p)) = Σ_q (g(q) − g(p)) over the 4-neighbours q of p in hole ∪ known.

    This is paper 3.3 with its sign mended (docs/method.md): the solution's gradients are the guidance's, not their
    opposites. Neighbours that are neither hole nor known, and the image's border, are natural (Neumann): they are
    dropped on both sides. A pair of pixels of which one has no finite guidance wants no gradient; known pixels that are
    not finite are not known; weights and anchors that are not finite do not count, nor weights below 1e-30; 1e30 is the
    most.

    A component of the hole that touches no known pixel (and is drawn to no anchor) is reported as unanchored. It takes
    the guidance as it is: that has the wanted gradients and settles the free constant. Where there is none, it is NaN.
    """
    hole = np.asarray(hole, bool)
    window = _window(hole)

    def cut(array: np.ndarray | None) -> Any:
        return None if array is None else np.asarray(array).reshape(*hole.shape, -1)[window]

    soft = None if weight is None else np.asarray(weight)[window]
    task = _Task(hole[window], np.asarray(known, bool)[window], cut(values), cut(guidance), soft, cut(anchor))
    solution = _solve(task, settings)
    inside = solution.values.reshape(-1, *np.shape(values)[2:])
    if only_hole:
        return replace(solution, values=inside)
    filled, unanchored = np.array(values, dtype=np.float64), np.zeros(hole.shape, bool)
    filled[hole], unanchored[hole] = inside, solution.unanchored
    return PoissonSolution(filled, solution.iterations, unanchored)


def _window(hole: np.ndarray) -> tuple[Any, ...]:
    """An index of the rows and columns with hole pixels, and of one more on either side.

    If it saves much, rows and columns between parts of the hole are left out: at least two empty ones still part them.
    """
    kept = [np.flatnonzero(scipy.ndimage.binary_dilation(hole.any(axis), np.ones(3))) for axis in (1, 0)]
    box = tuple(slice(k[0], k[-1] + 1) if len(k) else slice(0, 0) for k in kept)
    area = (box[0].stop - box[0].start) * (box[1].stop - box[1].start)
    return np.ix_(*kept) if 2 * len(kept[0]) * len(kept[1]) < area else box


class _Task(NamedTuple):
    """What is given, in the window."""

    hole: np.ndarray  # [h, w] bool
    known: np.ndarray  # [h, w] bool
    values: np.ndarray  # [h, w, C]
    guidance: np.ndarray | None  # [h, w, C]
    weight: np.ndarray | None  # [h, w]
    anchor: np.ndarray | None  # [h, w, C]


class _Ties(NamedTuple):
    """What equations hold beside the differences between neighbours in the hole."""

    unknowns: np.ndarray  # [T] int64
    strengths: np.ndarray  # [T] float64, on the diagonal
    amounts: np.ndarray  # [T, C] float64, on the right


def _solve(task: _Task, settings: PoissonSettings) -> PoissonSolution:
    h, w = task.hole.shape
    kind = np.zeros((h + 3 - h % 2, w + 3 - w % 2), np.uint8)  # a border, and odd sides: grids nest
    np.multiply(task.known, np.uint8(KNOWN), out=kind[1 : h + 1, 1 : w + 1])
    kind[1 : h + 1, 1 : w + 1][task.hole] = HOLE
    runs, parts, rim = _find_runs(kind)
    count, channels = int((runs[:, 2] - runs[:, 1]).sum()), task.values.shape[2]
    result = np.zeros((count, channels))
    if not count:
        return PoissonSolution(result, 0, np.zeros(0, bool))

    # SIGN OF THE GUIDANCE: u = + guidance + a constant for each part of the hole + what is solved for. `result` begins
    # as the guidance, and a rim pixel is tied to (known − guidance): see _known_ties.
    absent = None
    if task.guidance is not None and not _take(task.guidance.reshape(h, -1), runs, channels, result.reshape(-1)):
        absent = ~np.isfinite(result)
        result[absent] = 0
    found = [_known_ties(task, rim, result, absent)]
    if task.weight is not None:
        found.append(_soft_ties(task, task.weight, result))
    if absent is not None:
        found += _flat_ties(kind, result, absent)
    ties = _Ties(*(np.concatenate(arrays) for arrays in zip(*found)))
    run = np.searchsorted(runs[:, 3], ties.unknowns, "right") - 1
    part = parts[run]
    strength = np.bincount(part, ties.strengths, parts.max() + 1)
    if not strength.all():
        return _settle(np.repeat(parts, runs[:, 2] - runs[:, 1]), strength == 0, result, absent, task, settings)
    sums = [np.bincount(part, amount, len(strength)) for amount in ties.amounts.T]
    shift = np.stack(sums, 1) / strength[:, None]
    amounts = ties.amounts - ties.strengths[:, None] * shift[part]

    places = places_of(runs[run, 0], ties.unknowns - runs[run, 3] + runs[run, 1], kind.shape)
    grids, solve_directly, most = Multigrid(kind, runs, places, ties.strengths), None, 0
    for c in range(channels):
        # A power of two, so that nothing is rounded: float32 must not underflow
        scale = 2.0 ** np.frexp(np.abs(amounts[:, c] * grids.inverse.reshape(-1)[places]).max())[1]
        converged = False
        right = amounts[:, c] / scale
        if solve_directly is None:
            iterations, converged = grids.solve(places, right, settings.tolerance, settings.most_iterations)
            most = max(most, iterations)
        if not converged:
            solve_directly = solve_directly or _factorise(kind, grids.inverse)
            grids.u.reshape(-1)[...] = solve_directly(places, right)
            most = 0
        # The right-hand sides add up to zero in each part. So do strengths times the solution, whatever hangs on
        # how few or weak ties.
        error = np.bincount(part, ties.strengths * grids.u.reshape(-1)[places], len(strength)) / strength
        _add(grids.u, runs, parts, grids.fine.stride, scale, shift[:, c] - scale * error, result[:, c])
    return PoissonSolution(result, most, np.zeros(count, bool))


def _known_ties(task: _Task, rim: np.ndarray, start: np.ndarray, absent: np.ndarray | None) -> _Ties:
    """The hole's pixels to their known neighbours, where those are finite."""
    unknowns, rows, columns = rim.T
    known = task.values[rows - 1, columns - 1].astype(np.float64)
    sound = np.isfinite(known).all(1)
    unknowns, rows, columns, known = (a[sound] for a in (unknowns, rows, columns, known))
    amounts = known - start[unknowns]
    if task.guidance is not None:
        beyond = task.guidance[rows - 1, columns - 1]
        wanted = np.isfinite(beyond) if absent is None else np.isfinite(beyond) & ~absent[unknowns]
        amounts = np.where(wanted, known - beyond, amounts)
    return _Ties(unknowns, np.ones(len(unknowns)), amounts)


def _soft_ties(task: _Task, weight: np.ndarray, start: np.ndarray) -> _Ties:
    """Pixels to their anchors, as strongly as `weight` says."""
    pull = weight[task.hole].astype(np.float64)
    anchor = np.zeros(start.shape) if task.anchor is None else task.anchor[task.hole].astype(np.float64)
    unknowns = np.flatnonzero((pull > LEAST_WEIGHT) & np.isfinite(pull) & np.isfinite(anchor).all(1))
    pull = np.minimum(pull[unknowns], MOST_WEIGHT)
    return _Ties(unknowns, pull, pull[:, None] * (anchor[unknowns] - start[unknowns]))


def _flat_ties(kind: np.ndarray, start: np.ndarray, absent: np.ndarray) -> Iterator[_Ties]:
    """Pairs of neighbours of which one has no guidance are guided by a gradient of 0, not by the start's."""
    index = np.full(kind.shape, -1)
    index[kind == HOLE] = np.arange(len(start))
    for neighbour in (np.roll(index, -1, 0), np.roll(index, -1, 1)):
        p, q = (a[(index >= 0) & (neighbour >= 0)] for a in (index, neighbour))
        step = np.where(absent[p] | absent[q], start[q].astype(np.float64) - start[p], 0)
        used = step.any(1)
        yield _Ties(p[used], np.zeros(used.sum()), step[used])
        yield _Ties(q[used], np.zeros(used.sum()), -step[used])


def _settle(
    parts: np.ndarray,  # [M] component of each unknown
    free: np.ndarray,  # [components] bool, tied to nothing
    start: np.ndarray,  # [M, C] guidance, 0 where absent
    absent: np.ndarray | None,  # [M, C] bool
    task: _Task,
    settings: PoissonSettings,
) -> PoissonSolution:
    """Unanchored components take their guidance, the rest is solved; pixels without guidance hang on those with."""
    loose = free[parts]
    usable = np.full(len(parts), task.guidance is not None) if absent is None else ~absent.any(1)
    taken = loose & usable
    settled = taken | (loose & (np.bincount(parts, usable) == 0)[parts])
    hole, known, values = task.hole.copy(), task.known.copy(), task.values.astype(np.float64)
    hole[task.hole], known[task.hole] = ~settled, taken
    values[task.hole] = np.where(taken[:, None], start, np.nan)
    rest = _solve(task._replace(hole=hole, known=known, values=values), settings)
    result = np.where(taken[:, None], start, start.dtype.type(np.nan))
    result[~settled] = rest.values
    return PoissonSolution(result, rest.iterations, loose)


def _factorise(kind: np.ndarray, inverse: np.ndarray) -> Any:
    """A sparse factor of the system, as a function of right-hand sides (places, amounts) that gives u at all places."""
    rows, columns = np.nonzero(kind == HOLE)
    places = places_of(rows, columns, kind.shape)
    index = np.full(kind.shape, -1)
    index[rows, columns] = np.arange(len(rows))
    matrix = scipy.sparse.diags(1 / inverse.reshape(-1)[places].astype(np.float64)).tocsc()
    for dy, dx in ((-1, 0), (1, 0), (0, -1), (0, 1)):
        neighbour = index[rows + dy, columns + dx]
        linked = np.flatnonzero(neighbour >= 0)
        matrix -= scipy.sparse.csc_matrix((np.ones(len(linked)), (linked, neighbour[linked])), matrix.shape)
    options = {"SymmetricMode": True, "DiagPivotThresh": 0.0}
    factor = scipy.sparse.linalg.splu(matrix, permc_spec="MMD_AT_PLUS_A", options=options)

    def solve(at: np.ndarray, amounts: np.ndarray) -> np.ndarray:
        right, u = np.bincount(at, amounts, inverse.size), np.zeros(inverse.size)
        u[places] = factor.solve(right[places])
        return u

    return solve


@kernel
def _find_runs(kind):
    """Runs of hole pixels in rows [R, 4]: row, first and end column, first unknown; their 4-connected components [R];
    and all pairs of an unknown and a known neighbour [T, 3]: the unknown, row and column of the known pixel."""
    count, pairs = 0, 0
    for i in range(1, kind.shape[0] - 1):
        for j in range(1, kind.shape[1] - 1):
            around = kind[i - 1, j] + kind[i + 1, j] + kind[i, j - 1] + kind[i, j + 1]
            if kind[i, j] == HOLE:
                pairs += around // KNOWN
                count += kind[i, j - 1] != HOLE
    runs = np.empty((count, 4), np.int64)
    rim = np.empty((pairs, 3), np.int64)
    parent = np.arange(count)
    r, unknown, t, here = 0, 0, 0, 0
    for i in range(1, kind.shape[0] - 1):
        above, here = here, r
        end_above = r
        j = 1
        while j < kind.shape[1] - 1:
            if kind[i, j] != HOLE:
                j += 1
                continue
            start, first = j, unknown
            while kind[i, j] == HOLE:
                if kind[i - 1, j] + kind[i + 1, j] + kind[i, j - 1] + kind[i, j + 1] >= KNOWN:
                    for d in range(4):
                        y, x = i + (d == 0) - (d == 1), j + (d == 2) - (d == 3)
                        if kind[y, x] == KNOWN:
                            rim[t, 0], rim[t, 1], rim[t, 2] = unknown, y, x
                            t += 1
                unknown += 1
                j += 1
            runs[r, 0], runs[r, 1], runs[r, 2], runs[r, 3] = i, start, j, first
            while above < end_above and runs[above, 2] <= start:
                above += 1
            touching = above
            while touching < end_above and runs[touching, 1] < j:
                a, b = _root(parent, touching), _root(parent, r)
                parent[max(a, b)] = min(a, b)
                touching += 1
            r += 1
    parts = np.empty(count, np.int64)
    found = 0
    for r in range(count):
        root = _root(parent, r)
        if root == r:
            parts[r] = found
            found += 1
        else:
            parts[r] = parts[root]
    return runs, parts, rim


@kernel
def _root(parent, r):
    while parent[r] != r:
        parent[r] = parent[parent[r]]
        r = parent[r]
    return r


@exact_kernel
def _take(rows, runs, channels, out):
    """out [M · channels] ← the unknowns' values in rows [h, w · channels]; whether all are finite."""
    finite = True
    for r in range(len(runs)):
        row = rows[runs[r, 0] - 1, (runs[r, 1] - 1) * channels : (runs[r, 2] - 1) * channels]
        to = out[runs[r, 3] * channels :]
        for k in range(len(row)):
            to[k] = row[k]
            finite &= np.isfinite(row[k])
    return finite


@kernel
def _add(u, runs, parts, stride, scale, shift, out):
    """out [M] += scale · u + the part's shift."""
    for r in range(len(runs)):
        i, base = runs[r, 0], shift[parts[r]]
        for first in range(min(2, runs[r, 2] - runs[r, 1])):
            j = runs[r, 1] + first
            of_colour = u[(i + j) & 1, i * stride + j // 2 :]
            to = out[runs[r, 3] + first :]
            for k in range((runs[r, 2] - j + 1) // 2):
                to[2 * k] += base + scale * of_colour[k]
