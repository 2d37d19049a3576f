"""The grids against sparse matrices, and what conjugate gradients ask of a preconditioner."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.ndimage
import scipy.sparse
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from property_tests import examples

from gimp3d.solvers.poisson import multigrid
from gimp3d.solvers.poisson.multigrid import Multigrid, places_of

MASKS = hnp.arrays(np.bool_, st.tuples(st.integers(1, 25), st.integers(1, 25)))


def system(mask, seed=0):
    """The grids of a hole with random ties, its matrix, and where the unknowns lie."""
    rng = np.random.default_rng(seed)
    inside = np.zeros([n + 3 - n % 2 for n in mask.shape], np.uint8)
    inside[1 : mask.shape[0] + 1, 1 : mask.shape[1] + 1] = mask
    rows, columns = np.nonzero(inside)
    runs = [
        (i, start, end)
        for i, row in enumerate(inside)
        for start, end in zip(np.flatnonzero(np.diff(row, prepend=0) == 1), np.flatnonzero(np.diff(row) == 255) + 1)
    ]
    components, _ = scipy.ndimage.label(inside)
    strengths = rng.integers(0, 4, len(rows)).astype(float)
    strengths[np.unique(components[rows, columns], return_index=True)[1]] += 1  # nothing is loose
    places = places_of(rows, columns, inside.shape)
    grids = Multigrid(inside, np.array(runs), places, strengths)
    index = np.full(inside.shape, -1)
    index[rows, columns] = np.arange(len(rows))
    matrix = scipy.sparse.lil_matrix((len(rows), len(rows)))
    for k, (i, j) in enumerate(zip(rows, columns)):
        near = [index[q] for q in ((i - 1, j), (i + 1, j), (i, j - 1), (i, j + 1)) if index[q] >= 0]
        matrix[k, near] = -1
        matrix[k, k] = len(near) + strengths[k]
    return grids, matrix.tocsr(), inside, places


def interpolation(inside):
    """P from nodes (I, J), at (2I−1, 2J−1), to the pixels in the hole, as [pixels, rows · columns of nodes]."""
    shape = [n // 2 + 2 for n in inside.shape]
    rows, columns = np.nonzero(inside)
    matrix = scipy.sparse.lil_matrix((len(rows), shape[0] * shape[1]))
    for k, (i, j) in enumerate(zip(rows, columns)):
        for I in {(i + 1) // 2, i // 2 + 1}:
            for J in {(j + 1) // 2, j // 2 + 1}:
                matrix[k, I * shape[1] + J] = (1 - abs(i - 2 * I + 1) / 2) * (1 - abs(j - 2 * J + 1) / 2)
    return matrix.tocsr(), shape


def operator(coarse, g, shape):
    """A grid's operator from its stencils, as a sparse matrix over nodes [rows, columns] = shape."""
    offset, stride = int(coarse.offsets[g]), int(coarse.strides[g])
    places = offset + np.arange(shape[0])[:, None] * stride + np.arange(shape[1])
    node = np.full(coarse.steps.size + stride, -1)
    node[places] = np.arange(shape[0] * shape[1]).reshape(shape)
    half = scipy.sparse.csr_matrix((shape[0] * shape[1],) * 2)
    for stencil, apart in zip(coarse.stencils[1:], (1, stride - 1, stride, stride + 1)):
        linked = places[stencil[places] != 0]
        half += scipy.sparse.csr_matrix((stencil[linked], (node[linked], node[linked + apart])), half.shape)
    return half + half.T + scipy.sparse.diags(coarse.stencils[0][places].ravel())


def precondition(grids, residual):
    """z [places] float32 for a residual over D."""
    work = grids.work
    for vector in work:
        vector[:] = 0
    work.t[:] = residual
    multigrid._iterate(grids.fine, grids.coarse, work, 0.0, 0.0, 1)
    return work.p.copy()  # the first direction


@examples(60)
@given(mask=MASKS.filter(np.any), seed=st.integers(0, 9))
def test_coarse_operators_are_galerkin_operators(mask, seed):
    grids, matrix, inside, _ = system(mask, seed)
    marks = inside
    for g in range(min(3, len(grids.coarse.rows))):
        P, shape = interpolation(marks)
        matrix = (P.T @ matrix @ P).tocsr()
        np.testing.assert_allclose(operator(grids.coarse, g, shape).toarray(), matrix.toarray(), atol=1e-4)
        used = np.asarray(P.sum(0)).reshape(shape) > 0
        marks = np.pad(used, [(0, 1 - n % 2) for n in shape]).astype(np.uint8)
        matrix = matrix[used.ravel()][:, used.ravel()]


@examples(40)
@given(mask=MASKS.filter(np.any), seed=st.integers(0, 9))
def test_no_smoother_diverges(mask, seed):
    """The largest eigenvalue of steps · A stays below 2, whatever the shape of the hole."""
    grids, _, _, _ = system(mask, seed)
    coarse = grids.coarse
    for g in range(len(coarse.rows)):
        shape = int(coarse.rows[g]), int(coarse.strides[g]) - 2
        steps = coarse.steps[
            int(coarse.offsets[g]) + np.arange(shape[0])[:, None] * int(coarse.strides[g]) + np.arange(shape[1])
        ].ravel()
        root = scipy.sparse.diags(np.sqrt(steps))
        assert np.linalg.eigvalsh((root @ operator(coarse, g, shape) @ root).toarray()).max(initial=0) < 1.9


@pytest.mark.parametrize("many", [2, 1000])
@pytest.mark.parametrize("sigma", [0, 1, 4])
def test_a_cycle_is_symmetric_and_positive(sigma, many, monkeypatch):
    """As conjugate gradients need it, in the product with D; V-cycles, and W-cycles on all grids."""
    monkeypatch.setattr(multigrid, "MANY", many)
    rng = np.random.default_rng(sigma)
    field = scipy.ndimage.gaussian_filter(rng.standard_normal((60, 70)), sigma)
    grids, _, _, places = system(field > np.quantile(field, 0.4))
    D = grids.fine.diagonal.astype(np.float64)
    black = places[places < D.size]
    first, second = np.zeros((2, D.size), np.float32)
    first[black] = 1 + rng.standard_normal(len(black))  # smooth parts, for the coarse grids
    second[black] = np.sin(black / D.size * 5) + rng.standard_normal(len(black))
    of_first, of_second = precondition(grids, first), precondition(grids, second)
    assert (D * first) @ of_first > 0
    scale = np.sqrt(((D * first) @ of_first) * ((D * second) @ of_second))
    assert abs((D * first) @ of_second - (D * second) @ of_first) < 1e-5 * scale


def test_the_residual_falls_tenfold_per_iteration():
    rng = np.random.default_rng(1)
    field = scipy.ndimage.gaussian_filter(rng.standard_normal((200, 230)), 9)
    grids, matrix, _, places = system(field > np.quantile(field, 0.5))
    amounts = rng.standard_normal(len(places))
    iterations, converged = grids.solve(places, amounts, 1e-5, 50)
    left = amounts - matrix @ grids.u.reshape(-1)[places].astype(np.float64)
    assert converged and iterations <= 5
    assert np.linalg.norm(left / matrix.diagonal()) < 1.5e-5 * np.linalg.norm(amounts / matrix.diagonal())


def test_the_last_grid_is_solved_without_what_has_no_pivot():
    """A generalised inverse G of a singular operator A: symmetric, A·G·A = A."""
    grids, _, _, _ = system(np.eye(3, dtype=bool))
    coarse = grids.coarse
    g = len(coarse.rows) - 1
    shape = int(coarse.rows[g]), int(coarse.strides[g]) - 2
    kept = operator(coarse, g, shape).toarray()
    used = np.flatnonzero(np.diag(kept))
    A, G = kept[np.ix_(used, used)], coarse.inverse
    assert np.linalg.matrix_rank(A, tol=1e-5) < len(A) == len(G)
    np.testing.assert_allclose(A @ G @ A, A, atol=1e-5)
    np.testing.assert_allclose(G, G.T, atol=1e-6)
