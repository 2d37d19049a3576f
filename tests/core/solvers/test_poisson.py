"""Poisson's equation against a plain sparse solve, and where it has no boundary."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gimp3d.solvers.poisson import PoissonSettings, solve_poisson


def oracle(hole: np.ndarray, known: np.ndarray, values: np.ndarray, guidance: np.ndarray | None) -> np.ndarray:
    """Least squares over all pairs: row by row, no cleverness; components without a rim stay NaN."""
    index = np.full(hole.shape, -1)
    index[hole] = np.arange(hole.sum())
    rows, right = [], []
    h, w = hole.shape
    for y, x in np.argwhere(hole):
        row, b = np.zeros(hole.sum()), 0.0
        for dy, dx in ((0, 1), (1, 0), (0, -1), (-1, 0)):
            v, u = y + dy, x + dx
            if not (0 <= v < h and 0 <= u < w) or not (hole[v, u] or known[v, u]):
                continue
            row[index[y, x]] += 1
            if hole[v, u]:
                row[index[v, u]] -= 1
            else:
                b += values[v, u]
            if guidance is not None and np.isfinite(guidance[y, x] - guidance[v, u]):
                b += guidance[y, x] - guidance[v, u]
        rows.append(row)
        right.append(b)
    result = values.astype(float).copy()
    result[hole] = np.linalg.lstsq(np.array(rows), np.array(right), rcond=None)[0]
    return result


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 10_000), share=st.floats(0.05, 0.9), guided=st.booleans())
def test_random_holes_match_a_plain_solve(seed: int, share: float, guided: bool) -> None:
    rng = np.random.default_rng(seed)
    hole = rng.random((14, 17)) < share
    known = ~hole & (rng.random(hole.shape) < 0.8)
    values = rng.normal(size=hole.shape)
    guidance = rng.normal(size=hole.shape) if guided else None
    solution = solve_poisson(hole, known, values, guidance, PoissonSettings(tolerance=1e-9))
    solved = hole & ~solution.unanchored
    np.testing.assert_allclose(solution.values[solved], oracle(hole, known, values, guidance)[solved], atol=1e-6)
    np.testing.assert_array_equal(solution.values[~hole], values[~hole])


def blob(n: int) -> np.ndarray:
    y, x = np.mgrid[:n, :n] / n - 0.5
    return np.hypot(x, 1.3 * y) + 0.06 * np.sin(9 * np.arctan2(y, x)) < 0.33


@pytest.mark.parametrize("n", [60, 240, 700])
def test_planes_are_exact_and_iterations_do_not_grow(n: int) -> None:
    y, x = np.mgrid[:n, :n].astype(float)
    plane, hole = 0.3 * x - 0.7 * y + 5, blob(n)
    solution = solve_poisson(hole, ~hole, np.where(hole, 0, plane), None, PoissonSettings(tolerance=1e-8))
    np.testing.assert_allclose(solution.values, plane, atol=1e-4 * n)
    assert solution.iterations <= 12


def test_a_bump_in_the_guidance_is_a_bump_in_the_result() -> None:
    """The printed divergence has the other sign: a bump would become a dent (METHOD section 3)."""
    hole = blob(80)
    y, x = np.mgrid[:80, :80] - 40.0
    guidance = np.exp(-(x**2 + y**2) / 100)
    assert solve_poisson(hole, ~hole, np.zeros((80, 80)), guidance).values[40, 40] > 0.5


def test_the_border_is_free_islands_are_boundary_and_channels_are_independent() -> None:
    hole = np.ones((30, 40), bool)
    hole[:, 0] = False  # known only on the left: everything takes its value
    values = np.zeros((30, 40, 2))
    values[:, 0] = [3.0, -1.0]
    filled = solve_poisson(hole, ~hole, values).values
    np.testing.assert_allclose(filled, np.broadcast_to([3.0, -1.0], filled.shape), atol=1e-4)
    hole[15, 20] = False  # an island
    values[15, 20] = [9.0, -1.0]
    filled = solve_poisson(hole, ~hole, values).values
    assert 3.5 < filled[15, 21, 0] < 9 and np.abs(filled[..., 1] + 1).max() < 1e-4


def test_components_without_a_rim_are_reported_and_take_the_guidance() -> None:
    hole = np.zeros((20, 20), bool)
    hole[2:6, 2:6] = hole[10:15, 10:15] = True
    known = np.zeros_like(hole)
    known[1, 2:6] = True
    guidance = np.random.default_rng(0).normal(size=(20, 20))
    solution = solve_poisson(hole, known, np.ones((20, 20)), guidance)
    assert (solution.unanchored == (hole & (np.arange(20)[:, None] > 8))).all()
    np.testing.assert_allclose(solution.values[10:15, 10:15], guidance[10:15, 10:15])


@pytest.mark.parametrize("pixels", [1, 2, 4])
def test_tiny_holes(pixels: int) -> None:
    hole = np.zeros((9, 9), bool)
    hole[4, 2 : 2 + pixels] = True
    filled = solve_poisson(hole, ~hole, np.where(hole, 99.0, 7.0)).values
    np.testing.assert_allclose(filled, 7.0, atol=1e-9)


def test_no_hole_changes_nothing() -> None:
    values = np.random.default_rng(0).normal(size=(5, 6))
    np.testing.assert_array_equal(solve_poisson(np.zeros((5, 6), bool), np.ones((5, 6), bool), values).values, values)
