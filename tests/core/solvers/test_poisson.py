"""The Poisson solver against a sparse direct solve of independently written equations, and against closed forms."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.ndimage
import scipy.sparse
import scipy.sparse.linalg
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from gimp3d.solvers.poisson import PoissonSettings, solve_poisson

EXACT = PoissonSettings(tolerance=1e-10)
ALWAYS_MULTIGRID = PoissonSettings(tolerance=1e-10, most_iterations=500)


def reference(hole, known, values, guidance=None, weight=None, anchor=None):
    """One equation per pixel, written out pixel by pixel; every component must be anchored."""
    unknowns = {p: k for k, p in enumerate(map(tuple, np.argwhere(hole)))}
    matrix, right = scipy.sparse.lil_matrix((len(unknowns), len(unknowns))), np.zeros(len(unknowns))
    for (i, j), k in unknowns.items():
        if weight is not None:
            matrix[k, k] += weight[i, j]
            right[k] += weight[i, j] * anchor[i, j]
        for q in ((i - 1, j), (i + 1, j), (i, j - 1), (i, j + 1)):
            if not (0 <= q[0] < hole.shape[0] and 0 <= q[1] < hole.shape[1]) or not (hole[q] or known[q]):
                continue
            matrix[k, k] += 1
            if hole[q]:
                matrix[k, unknowns[q]] -= 1
            else:
                right[k] += values[q]
            if guidance is not None and np.isfinite(guidance[i, j]) and np.isfinite(guidance[q]):
                right[k] += guidance[i, j] - guidance[q]
    result = values.astype(float).copy()
    result[hole] = scipy.sparse.linalg.spsolve(matrix.tocsc(), right)
    return result


def smooth(rng, shape, sigma=6.0):
    return 10 * scipy.ndimage.gaussian_filter(rng.standard_normal(shape), sigma)


def disc(n, radius=0.42):
    y, x = np.mgrid[:n, :n] / n - 0.5
    return np.hypot(x, y) < radius * (1 + 0.2 * np.sin(5 * np.arctan2(y, x)))


def anchored_parts(hole, known):
    components, _ = scipy.ndimage.label(hole)
    return np.isin(components, np.setdiff1d(components[scipy.ndimage.binary_dilation(known)], [0]))


SMALL_MASKS = hnp.arrays(np.int8, st.tuples(st.integers(1, 14), st.integers(1, 14)), elements=st.integers(0, 2))


@settings(max_examples=80, deadline=None)
@given(kinds=SMALL_MASKS, seed=st.integers(0, 99), multigrid=st.booleans())
def test_any_mask_solves_as_the_equations_say(kinds, seed, multigrid):
    """Holes (1), known pixels (2) and neither (0) in any arrangement: islands, lines, borders, loose parts."""
    rng = np.random.default_rng(seed)
    hole, known = kinds == 1, kinds == 2
    values, guidance = rng.standard_normal((2, *kinds.shape))
    guidance[rng.random(kinds.shape) < 0.1] = np.nan
    solution = solve_poisson(hole, known, values, guidance, ALWAYS_MULTIGRID if multigrid else EXACT)
    anchored = anchored_parts(hole, known)
    np.testing.assert_array_equal(solution.unanchored, hole & ~anchored)
    if anchored.any():
        # What is loose is no neighbour of what is anchored, so the reference may leave it out.
        expected = reference(anchored, known, values, guidance)
        np.testing.assert_allclose(solution.values[anchored], expected[anchored], atol=1e-7)
    np.testing.assert_array_equal(solution.values[~hole], values[~hole])


def test_large_irregular_holes_match_the_direct_solve():
    rng = np.random.default_rng(0)
    field = scipy.ndimage.gaussian_filter(rng.standard_normal((90, 120)), 3)
    hole = field > np.quantile(field, 0.6)  # touches the border, several parts, islands
    known = ~hole & (rng.random(hole.shape) < 0.9)
    values, guidance = smooth(rng, hole.shape, 2.0), smooth(rng, hole.shape)
    hole &= anchored_parts(hole, known)
    solution = solve_poisson(hole, known, values, guidance, EXACT)
    assert solution.iterations > 0
    np.testing.assert_allclose(solution.values, reference(hole, known, values, guidance), atol=1e-8)


def test_the_default_tolerance_is_far_below_a_grey_level_of_the_range():
    rng = np.random.default_rng(1)
    values, hole = smooth(rng, (160, 160)), disc(160)
    error = solve_poisson(hole, ~hole, values).values - solve_poisson(hole, ~hole, values, settings=EXACT).values
    assert np.abs(error).max() < 1e-4 * np.ptp(values)


@pytest.mark.parametrize("side", [100, 400, 1000])
def test_iterations_do_not_grow_with_the_hole(side):
    hole = disc(side)
    y, x = np.mgrid[:side, :side] / side
    values = np.sin(9 * x) + np.cos(7 * y * x)
    assert 0 < solve_poisson(hole, ~hole, values).iterations <= 8


@pytest.mark.parametrize("offset", [0.0, 1e6])
def test_planes_are_reproduced_whatever_their_offset(offset):
    y, x = np.mgrid[:150, :130].astype(float)
    plane = 0.3 * x - 0.7 * y + offset
    hole = np.pad(disc(120), ((15, 15), (5, 5)))
    found = solve_poisson(hole, ~hole, np.where(hole, np.nan, plane), settings=EXACT).values
    np.testing.assert_allclose(found, plane, atol=1e-7)


def test_a_discrete_harmonic_function_is_reproduced():
    y, x = np.mgrid[:100, :100].astype(float) - 40
    saddle = x**2 - y**2  # its five-point Laplacian is 0
    hole = np.pad(disc(80), 10)
    np.testing.assert_allclose(solve_poisson(hole, ~hole, saddle, settings=EXACT).values, saddle, atol=1e-6)


def test_a_bump_in_the_guidance_becomes_a_bump():
    """The paper prints the divergence with the wrong sign, which makes it a dent (METHOD section 3)."""
    y, x = np.mgrid[:61, :61] - 30.0
    bump = np.exp(-(x**2 + y**2) / 60)
    hole = np.hypot(x, y) < 25
    filled = solve_poisson(hole, ~hole, np.zeros_like(bump), bump).values
    assert filled[30, 30] == pytest.approx(1, abs=0.01)
    assert (filled[hole] > -1e-3).all()


def test_the_image_border_is_natural():
    """A hole across the whole image, known at its two ends: the profile is linear, nothing bends at the borders."""
    hole = np.zeros((20, 60), bool)
    hole[:, 1:-1] = True
    values = np.zeros(hole.shape)
    values[:, -1] = 59
    expected = np.broadcast_to(np.arange(60.0), hole.shape)
    np.testing.assert_allclose(solve_poisson(hole, ~hole, values, settings=EXACT).values, expected, atol=1e-6)


def test_pixels_that_are_neither_hole_nor_known_do_not_count():
    hole = np.zeros((40, 40), bool)
    hole[10:30, 10:30] = True
    known = np.zeros_like(hole)
    known[10:30, 9] = True
    values = np.full(hole.shape, 1e30)
    values[known] = 5.0
    np.testing.assert_allclose(solve_poisson(hole, known, values).values[hole], 5.0)


def test_known_pixels_that_are_not_finite_are_not_known():
    hole = disc(30)
    values = np.where(np.arange(30) < 15, 2.0, np.nan) * np.ones((30, 1))
    np.testing.assert_allclose(solve_poisson(hole, ~hole, values).values[hole], 2.0)


def test_a_part_without_a_rim_takes_the_guidance():
    hole = np.zeros((12, 30), bool)
    hole[2:8, 2:10] = hole[2:8, 15:25] = True
    known = np.zeros_like(hole)
    known[:, 1] = True
    guidance = np.random.default_rng(2).standard_normal(hole.shape)
    solution = solve_poisson(hole, known, np.zeros(hole.shape), guidance)
    np.testing.assert_array_equal(np.argwhere(solution.unanchored), np.argwhere(hole & (np.arange(30) >= 15)))
    np.testing.assert_array_equal(solution.values[solution.unanchored], guidance[solution.unanchored])


def test_a_part_without_rim_and_guidance_is_nan():
    hole = disc(20)
    solution = solve_poisson(hole, np.zeros_like(hole), np.ones(hole.shape))
    assert np.isnan(solution.values[hole]).all() and (solution.unanchored == hole).all()
    assert (solution.values[~hole] == 1).all()


def test_a_hole_that_covers_the_image_is_unanchored():
    hole = np.ones((25, 31), bool)
    guidance = np.random.default_rng(3).standard_normal(hole.shape)
    solution = solve_poisson(hole, ~hole, np.zeros(hole.shape), guidance)
    assert solution.unanchored.all()
    np.testing.assert_array_equal(solution.values, guidance)


def test_an_empty_hole_changes_nothing():
    values = np.random.default_rng(4).standard_normal((5, 6))
    solution = solve_poisson(np.zeros((5, 6), bool), np.ones((5, 6), bool), values)
    np.testing.assert_array_equal(solution.values, values)


@pytest.mark.parametrize("size", [(1, 1), (1, 2), (2, 2)])
def test_the_smallest_holes_average_their_rim(size):
    hole = np.zeros((7, 8), bool)
    hole[3 : 3 + size[0], 3 : 3 + size[1]] = True
    y, x = np.mgrid[:7, :8].astype(float)
    np.testing.assert_allclose(solve_poisson(hole, ~hole, x + 2 * y).values, x + 2 * y, atol=1e-9)


def test_a_one_pixel_maze_is_solved():
    """Walls one pixel wide have no coarse counterpart: the direct solver takes over where multigrid stalls."""
    hole = np.zeros((81, 83), bool)
    hole[::2] = True
    hole[1::4, 0] = hole[3::4, -1] = True
    known = np.zeros_like(hole)
    known[0, -1] = known[-1, -1] = True
    hole &= ~known
    values = np.where(known, np.arange(81)[:, None], 0.0)
    np.testing.assert_allclose(
        solve_poisson(hole, known, values, settings=EXACT).values, reference(hole, known, values), atol=1e-6
    )


def test_channels_are_solved_each_for_itself():
    rng = np.random.default_rng(5)
    hole = disc(70)
    values, guidance = rng.standard_normal((2, 70, 70, 3))
    together = solve_poisson(hole, ~hole, values, guidance).values
    for c in range(3):
        alone = solve_poisson(hole, ~hole, values[..., c], guidance[..., c]).values
        np.testing.assert_array_equal(together[..., c], alone)


def test_soft_data_draw_the_solution():
    rng = np.random.default_rng(6)
    hole = disc(40)
    values, anchor = rng.standard_normal((2, 40, 40))
    weight = np.where(rng.random(hole.shape) < 0.2, 3.0, 0.0)
    solution = solve_poisson(hole, ~hole, values, settings=EXACT, weight=weight, anchor=anchor)
    expected = reference(hole, ~hole, values, weight=weight, anchor=anchor)
    np.testing.assert_allclose(solution.values, expected, atol=1e-8)


def test_soft_data_anchor_a_hole_without_a_rim():
    hole = np.ones((30, 30), bool)
    weight = np.zeros(hole.shape)
    weight[4, 5] = 0.1
    solution = solve_poisson(hole, ~hole, np.zeros(hole.shape), weight=weight, anchor=np.full(hole.shape, 7.0))
    assert not solution.unanchored.any()
    np.testing.assert_allclose(solution.values, 7.0)


def test_the_same_input_gives_the_same_bits():
    rng = np.random.default_rng(7)
    values, hole = rng.standard_normal((300, 300)), disc(300)
    first, second = (solve_poisson(hole, ~hole, values).values for _ in range(2))
    assert first.tobytes() == second.tobytes()
