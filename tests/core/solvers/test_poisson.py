"""The Poisson solver against sparse direct solves and algebraic multigrid of independently written equations, and
against closed forms."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pyamg
import pytest
import scipy.ndimage
import scipy.sparse
import scipy.sparse.linalg
from hypothesis import given
from hypothesis import strategies as st
from property_tests import examples

from gimp3d.compute.threads import parallel_map, set_thread_count
from gimp3d.solvers import poisson as module
from gimp3d.solvers.poisson import solve_poisson, thin_plate

EXACT = 1e-10


def equations(hole, known, values, guidance=None, weight=None, anchor=None):
    """Matrix and right-hand side, one equation per pixel, written out pixel by pixel."""
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
    return matrix.tocsc(), right


def reference(hole, known, values, guidance=None, weight=None, anchor=None):
    """Every component must be anchored."""
    result = values.astype(float).copy()
    matrix, right = equations(hole, known, values, guidance, weight, anchor)
    result[hole] = scipy.sparse.linalg.spsolve(matrix, right)
    return result


def smooth(rng, shape, sigma=6.0):
    return 10 * scipy.ndimage.gaussian_filter(rng.standard_normal(shape), sigma)


def disc(n, radius=0.42):
    y, x = np.mgrid[:n, :n] / n - 0.5
    return np.hypot(x, y) < radius * (1 + 0.2 * np.sin(5 * np.arctan2(y, x)))


def blots(rng, shape, sigma, share):
    """A share of the image in several irregular parts with islands, some at the border."""
    field = scipy.ndimage.gaussian_filter(rng.standard_normal(shape), sigma)
    return field > np.quantile(field, 1 - share)


def maze(rng, rows, columns):
    """Corridors one pixel wide between walls one pixel thick: a random spanning tree."""
    open_ = np.zeros((2 * rows + 1, 2 * columns + 1), bool)
    cell, path = (0, 0), [(0, 0)]
    open_[1, 1] = True
    while path:
        i, j = cell = path[-1]
        ways = [(i + a, j + b) for a, b in ((0, 1), (1, 0), (0, -1), (-1, 0))]
        ways = [(a, b) for a, b in ways if 0 <= a < rows and 0 <= b < columns and not open_[2 * a + 1, 2 * b + 1]]
        if not ways:
            path.pop()
            continue
        a, b = ways[rng.integers(len(ways))]
        open_[2 * a + 1, 2 * b + 1] = open_[cell[0] + a + 1, cell[1] + b + 1] = True
        path.append((a, b))
    return open_


def anchored_parts(hole, known, weight=0.0):
    """The components of the hole that touch a known pixel or contain a weight."""
    components, _ = scipy.ndimage.label(hole)
    return np.isin(components, np.setdiff1d(components[scipy.ndimage.binary_dilation(known) | (weight > 0)], [0]))


def any_mask(height, width, hole, known, seed):
    """Holes (1), known pixels (2) and neither (0) at random: islands, lines, borders, loose parts."""
    drawn = np.random.default_rng(seed).random((height, width))
    return np.where(drawn < hole, 1, np.where(drawn < hole + known * (1 - hole), 2, 0))


SHARES = st.sampled_from([0.0, 0.1, 0.3, 0.5, 0.7, 0.9, 1.0])
SMALL_MASKS = st.builds(any_mask, st.integers(1, 14), st.integers(1, 14), SHARES, SHARES, st.integers(0, 10_000))


@examples(150)
@given(kinds=SMALL_MASKS, seed=st.integers(0, 99), channels=st.integers(1, 3))
def test_any_mask_solves_as_the_equations_say(kinds, seed, channels):
    rng = np.random.default_rng(seed)
    hole, known = kinds == 1, kinds == 2
    values, guidance = rng.standard_normal((2, *kinds.shape, channels))
    guidance[rng.random(guidance.shape) < 0.1] = np.nan
    solution = solve_poisson(hole, known, values, guidance, EXACT)
    anchored = anchored_parts(hole, known)
    np.testing.assert_array_equal(solution.unanchored, hole & ~anchored)
    for c in range(channels):
        if anchored.any():
            # What is loose is no neighbour of what is anchored, so the reference may leave it out.
            expected = reference(anchored, known, values[..., c], guidance[..., c])
            np.testing.assert_allclose(solution.values[anchored, c], expected[anchored], atol=1e-8)
    np.testing.assert_array_equal(solution.values[~hole], values[~hole].astype(solution.values.dtype))


@examples(60)
@given(kinds=SMALL_MASKS, seed=st.integers(0, 99), guided=st.booleans(), density=st.sampled_from([0.05, 0.5, 1.0]))
def test_any_mask_with_soft_data_solves_as_the_equations_say(kinds, seed, guided, density):
    """Weights over eight orders of magnitude."""
    rng = np.random.default_rng(seed)
    hole, known = kinds == 1, kinds == 2
    values, guidance, anchor = rng.standard_normal((3, *kinds.shape))
    weight = np.where(rng.random(hole.shape) < density, 10.0 ** rng.uniform(-4, 4, hole.shape), 0.0)
    guidance = guidance if guided else None
    solution = solve_poisson(hole, known, values, guidance, EXACT, weight=weight, anchor=anchor)
    anchored = anchored_parts(hole, known, weight)
    np.testing.assert_array_equal(solution.unanchored, hole & ~anchored)
    if anchored.any():
        expected = reference(anchored, known, values, guidance, weight, anchor)
        np.testing.assert_allclose(solution.values[anchored], expected[anchored], atol=1e-7)


@pytest.mark.parametrize("seed", range(4))
def test_large_irregular_holes_match_the_direct_solve_and_algebraic_multigrid(seed):
    rng = np.random.default_rng(seed)
    shape = (90, 120)
    hole = blots(rng, shape, sigma=3, share=0.4)
    known = ~hole & (rng.random(shape) < 0.9)
    values, guidance = smooth(rng, shape, 2.0), smooth(rng, shape)
    hole &= anchored_parts(hole, known)
    solution = solve_poisson(hole, known, values, guidance, EXACT)
    assert solution.iterations > 0
    matrix, right = equations(hole, known, values, guidance)
    found = solution.values[hole]
    np.testing.assert_allclose(found, scipy.sparse.linalg.spsolve(matrix, right), atol=1e-8)
    algebraic = pyamg.ruge_stuben_solver(matrix.tocsr()).solve(right, tol=1e-12, accel="cg")
    np.testing.assert_allclose(found, algebraic, atol=1e-8)


@pytest.mark.parametrize("tolerance", [1e-2, 1e-4, 1e-6, 1e-8])
def test_the_tolerance_is_that_of_the_true_residual(tolerance):
    """Measured from the equations; the first residual is that of the guidance plus the constant that fits best."""
    rng = np.random.default_rng(0)
    hole = blots(rng, (80, 90), sigma=6, share=0.3)
    hole &= scipy.ndimage.label(hole)[0] == 1
    values, guidance = rng.standard_normal((2, *hole.shape))
    matrix, right = equations(hole, ~hole, values, guidance)
    ones = np.ones(len(right))
    first = right - matrix @ guidance[hole]
    first -= matrix @ ones * (first.sum() / (matrix @ ones).sum())
    solution = solve_poisson(hole, ~hole, values, guidance, tolerance)
    left = right - matrix @ solution.values[hole]
    diagonal = matrix.diagonal()
    assert np.linalg.norm(left / diagonal) < 1.5 * tolerance * np.linalg.norm(first / diagonal)


def test_the_default_tolerance_is_far_below_a_grey_level_of_the_range():
    rng = np.random.default_rng(1)
    values, hole = smooth(rng, (160, 160)), disc(160)
    error = solve_poisson(hole, ~hole, values).values - solve_poisson(hole, ~hole, values, tolerance=EXACT).values
    assert np.abs(error).max() < 1e-4 * np.ptp(values)


@pytest.mark.parametrize(("tolerance", "most"), [(1e-3, 7), (1e-6, 12), (1e-9, 18)])
@pytest.mark.parametrize("irregular", [False, True])
def test_iterations_do_not_grow_with_the_hole(irregular, tolerance, most):
    rng, taken = np.random.default_rng(2), []
    for side in (60, 250, 1000):
        hole = blots(rng, (side, side), sigma=side / 20, share=0.3) if irregular else disc(side)
        values = rng.standard_normal(hole.shape)
        taken.append(solve_poisson(hole, ~hole, values, tolerance=tolerance).iterations)
    assert min(taken) > 0 and max(taken) <= most


@pytest.mark.parametrize("offset", [0.0, 1e6])
def test_planes_are_reproduced_whatever_their_offset(offset):
    y, x = np.mgrid[:150, :130].astype(float)
    plane = 0.3 * x - 0.7 * y + offset
    hole = np.pad(disc(120), ((15, 15), (5, 5)))
    found = solve_poisson(hole, ~hole, np.where(hole, np.nan, plane), tolerance=EXACT).values
    np.testing.assert_allclose(found, plane, atol=1e-7)


def test_a_discrete_harmonic_function_is_reproduced():
    y, x = np.mgrid[:100, :100].astype(float) - 40
    saddle = x**2 - y**2  # its five-point Laplacian is 0
    hole = np.pad(disc(80), 10)
    np.testing.assert_allclose(solve_poisson(hole, ~hole, saddle, tolerance=EXACT).values, saddle, atol=1e-6)


def test_a_bump_in_the_guidance_becomes_a_bump():
    """The paper prints the divergence with the wrong sign, which makes it a dent (docs/method.md)."""
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
    np.testing.assert_allclose(solve_poisson(hole, ~hole, values, tolerance=EXACT).values, expected, atol=1e-6)


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


@pytest.mark.parametrize(
    "shape", [["1"], ["11"], ["1", "1"], ["111"], ["11", "10"], ["11", "11"], ["1111"], ["110", "011"], ["10", "01"]]
)
def test_the_smallest_holes_average_their_rim(shape):
    hole = np.zeros((7, 8), bool)
    pixels = np.array([[c == "1" for c in row] for row in shape])
    hole[2 : 2 + pixels.shape[0], 3 : 3 + pixels.shape[1]] = pixels
    y, x = np.mgrid[:7, :8].astype(float)
    found = solve_poisson(hole, ~hole, x + 2 * y, tolerance=1e-9).values
    np.testing.assert_allclose(found, x + 2 * y, atol=1e-9)


def test_a_single_known_pixel_amid_the_hole_is_met():
    hole = np.ones((40, 50), bool)
    hole[17, 30] = False
    guidance = smooth(np.random.default_rng(3), hole.shape)
    solution = solve_poisson(hole, ~hole, np.full(hole.shape, 5.0), guidance, EXACT)
    np.testing.assert_allclose(solution.values, guidance - guidance[17, 30] + 5, atol=1e-7)


def test_parts_are_solved_each_for_itself():
    """One of values around 1e6, one of values around 1: neither spoils the other's digits."""
    rng = np.random.default_rng(4)
    hole = np.zeros((60, 140), bool)
    hole[5:55, 5:65], hole[5:55, 75:135] = disc(60)[5:55], disc(60)[5:55]
    values = smooth(rng, hole.shape) + np.where(np.arange(140) < 70, 1e6, 0)
    together = solve_poisson(hole, ~hole, values, tolerance=EXACT).values
    for part in (slice(0, 70), slice(70, 140)):
        alone = solve_poisson(hole[:, part], ~hole[:, part], values[:, part], tolerance=EXACT).values
        np.testing.assert_allclose(together[:, part], alone, atol=1e-7)


def test_parts_far_apart_cost_no_more_than_near_ones():
    """Rows and columns between them are left out."""
    rng = np.random.default_rng(5)
    hole = np.zeros((700, 900), bool)
    hole[20:60, 30:70] = hole[640:680, 800:840] = disc(40)
    hole[300, 899] = hole[0, 450] = True
    values, guidance = rng.standard_normal((2, *hole.shape))
    solution = solve_poisson(hole, ~hole, values, guidance, EXACT)
    for part in (np.s_[10:70, 20:80], np.s_[630:690, 790:850], np.s_[298:303, 896:900], np.s_[0:3, 445:455]):
        expected = reference(hole[part], ~hole[part], values[part], guidance[part])
        np.testing.assert_allclose(solution.values[part], expected, atol=1e-8)


@pytest.mark.parametrize("seed", range(3))
def test_mazes_are_solved(seed):
    """Corridors one pixel wide in walls that are neither hole nor known, with a few known pixels."""
    rng = np.random.default_rng(seed)
    hole = maze(rng, 20, 25)
    known = hole & (rng.random(hole.shape) < 0.02)
    known[1, 1] = True
    hole &= ~known
    values, guidance = rng.standard_normal((2, *hole.shape))
    solution = solve_poisson(hole, known, values, guidance, EXACT)
    np.testing.assert_allclose(solution.values, reference(hole, known, values, guidance), atol=1e-7)


def test_a_corridor_that_winds_to_and_fro_is_solved():
    """Parallel stretches share their coarse counterparts, so that many iterations are taken."""
    hole = np.zeros((81, 83), bool)
    hole[::2] = True
    hole[1::4, 0] = hole[3::4, -1] = True
    known = np.zeros_like(hole)
    known[0, -1] = known[-1, -1] = True
    hole &= ~known
    values = np.where(known, np.arange(81)[:, None], 0.0)[..., None] * [1.0, -2.0]
    solution = solve_poisson(hole, known, values, tolerance=1e-12)
    for c in range(2):
        np.testing.assert_allclose(solution.values[..., c], reference(hole, known, values[..., c]), atol=1e-6)


def test_channels_are_solved_each_for_itself():
    rng = np.random.default_rng(5)
    hole = disc(70)
    values, guidance = rng.standard_normal((2, 70, 70, 3))
    together = solve_poisson(hole, ~hole, values, guidance).values
    for c in range(3):
        alone = solve_poisson(hole, ~hole, values[..., c], guidance[..., c]).values
        np.testing.assert_array_equal(together[..., c], alone)


def test_what_lies_off_the_hole_stays():
    rng = np.random.default_rng(6)
    hole = blots(rng, (60, 70), sigma=3, share=0.3)
    known = ~hole & (rng.random(hole.shape) < 0.5)
    values = rng.standard_normal((60, 70, 2))
    whole = solve_poisson(hole, known, values)
    np.testing.assert_array_equal(whole.values[~hole], values[~hole])
    assert whole.values.dtype == np.float64 and not whole.unanchored[~hole].any()


def test_the_layout_and_type_of_the_input_do_not_matter():
    rng = np.random.default_rng(7)
    hole = disc(50)
    values, guidance = rng.integers(0, 256, (2, 50, 50, 3)).astype(np.uint8)
    expected = solve_poisson(hole, ~hole, values.astype(float), guidance.astype(float)).values
    flipped = [np.asfortranarray(a) for a in (hole, ~hole, values, guidance)]
    for arrays in ((hole, ~hole, values, guidance), flipped, [a.tolist() for a in (hole, ~hole, values, guidance)]):
        np.testing.assert_array_equal(solve_poisson(*arrays).values, expected)


# ------------------------------------------------------------------------------------------------------- invariances


def test_the_solution_is_linear_in_its_data():
    """With the guidance d_m scaled by s, d = L[d_g] + s · (d_m − L[d_m]): two solves give every s."""
    rng = np.random.default_rng(8)
    hole = blots(rng, (90, 80), sigma=5, share=0.3)
    hole &= anchored_parts(hole, ~hole)
    d_g, d_m = smooth(rng, hole.shape), smooth(rng, hole.shape, 2.0)
    harmonic, of_prior = (solve_poisson(hole, ~hole, d, tolerance=EXACT).values for d in (d_g, d_m))
    for s in (-0.7, 0.1, 3.0):
        guided = solve_poisson(hole, ~hole, d_g, s * d_m, EXACT).values
        np.testing.assert_allclose(guided, harmonic + s * (d_m - of_prior), atol=1e-8)


@pytest.mark.parametrize("scale", [2.0**-120, 2.0**-20, 2.0**100])
def test_the_scale_of_the_data_changes_no_bit(scale):
    rng = np.random.default_rng(9)
    hole = disc(60)
    values, guidance = rng.standard_normal((2, 60, 60))
    expected = scale * solve_poisson(hole, ~hole, values, guidance).values
    np.testing.assert_array_equal(solve_poisson(hole, ~hole, scale * values, scale * guidance).values, expected)


@pytest.mark.parametrize("offset", [-3.0, 1e5])
def test_offsets_of_values_and_of_the_guidance(offset):
    """Those of the values are those of the solution; those of the guidance are without effect."""
    rng = np.random.default_rng(10)
    hole = blots(rng, (90, 80), sigma=5, share=0.3)
    hole &= anchored_parts(hole, ~hole)
    values, guidance = smooth(rng, hole.shape), smooth(rng, hole.shape)
    expected = solve_poisson(hole, ~hole, values, guidance, EXACT).values
    moved = solve_poisson(hole, ~hole, values + offset, guidance, EXACT).values
    np.testing.assert_allclose(moved - offset, expected, atol=1e-8)
    np.testing.assert_allclose(solve_poisson(hole, ~hole, values, guidance + offset, EXACT).values, expected, atol=1e-8)


def test_turned_and_mirrored_images_have_turned_and_mirrored_solutions():
    rng = np.random.default_rng(11)
    hole = blots(rng, (50, 61), sigma=4, share=0.4)
    hole &= anchored_parts(hole, ~hole)
    values, guidance = rng.standard_normal((2, *hole.shape))
    expected = solve_poisson(hole, ~hole, values, guidance, EXACT).values
    for turn in (np.transpose, np.flipud, np.fliplr, np.rot90):
        turned = solve_poisson(turn(hole), turn(~hole), turn(values), turn(guidance), EXACT).values
        np.testing.assert_allclose(turned, turn(expected), atol=1e-8)


def test_the_same_input_gives_the_same_bits_on_any_thread():
    rng = np.random.default_rng(12)
    tasks = [(disc(n), rng.standard_normal((n, n, 2)), rng.standard_normal((n, n, 2))) for n in (300, 120, 40, 200)]

    def solve(task):
        hole, values, guidance = task
        return solve_poisson(hole, ~hole, values, guidance).values.tobytes()

    alone = [solve(task) for task in tasks]
    set_thread_count(4)
    try:
        assert parallel_map(solve, tasks * 8) == alone * 8
    finally:
        set_thread_count(None)


# ----------------------------------------------------------------------------------------------------------- soft data


def test_soft_data_draw_the_solution():
    rng = np.random.default_rng(6)
    hole = disc(40)
    values, anchor = rng.standard_normal((2, 40, 40))
    weight = np.where(rng.random(hole.shape) < 0.2, 3.0, 0.0)
    solution = solve_poisson(hole, ~hole, values, tolerance=EXACT, weight=weight, anchor=anchor)
    expected = reference(hole, ~hole, values, weight=weight, anchor=anchor)
    np.testing.assert_allclose(solution.values, expected, atol=1e-8)


@pytest.mark.parametrize("strength", [1e-25, 1e-12, 1e-6, 0.1, 1e6, 1e12, 1e35])
def test_soft_data_anchor_a_hole_without_a_rim_however_weak_or_strong(strength):
    hole = np.ones((30, 30), bool)
    weight = np.zeros(hole.shape)
    weight[4, 5] = strength
    anchor, guidance = np.full(hole.shape, 7.0), smooth(np.random.default_rng(14), hole.shape)
    solution = solve_poisson(hole, ~hole, np.zeros(hole.shape), guidance, 1e-7, weight=weight, anchor=anchor)
    assert not solution.unanchored.any()
    np.testing.assert_allclose(solution.values, guidance - guidance[4, 5] + 7, atol=1e-5)


@pytest.mark.parametrize("tolerance", [1e-6, 1e-9, 1e-12, 0.0])
def test_a_handful_of_pixels_on_a_weak_anchor(tolerance):
    """One black unknown: float32 follows its residual to nothing, far below the true one."""
    hole, guidance = np.ones((3, 1), bool), np.array([[0.3], [np.nan], [2.0]])
    weight, anchor = np.array([[0.00358], [0.0], [0.0]]), np.array([[-578.4], [0.0], [0.0]])
    given = hole, ~hole, np.zeros((3, 1)), guidance
    solution = solve_poisson(*given, tolerance, weight=weight, anchor=anchor)
    assert solution.iterations < 20
    np.testing.assert_allclose(solution.values, -578.4, rtol=1e-5 if tolerance > 1e-9 else 1e-12)


def test_several_weak_anchors_settle_the_constant():
    """Without a rim, weights that go to zero leave their weighted mean."""
    hole = np.ones((25, 31), bool)
    rng = np.random.default_rng(15)
    weight, anchor = 1e-14 * rng.random(hole.shape), rng.standard_normal(hole.shape)
    solution = solve_poisson(hole, ~hole, np.zeros(hole.shape), weight=weight, anchor=anchor, tolerance=EXACT)
    np.testing.assert_allclose(solution.values, np.average(anchor, weights=weight), atol=1e-9)


def test_huge_weights_are_known_pixels_and_spoil_nothing_else():
    rng = np.random.default_rng(16)
    hole = disc(60)
    values, anchor = smooth(rng, hole.shape), smooth(rng, hole.shape)
    strong = hole & (rng.random(hole.shape) < 0.05)
    solution = solve_poisson(hole, ~hole, values, tolerance=EXACT, weight=np.where(strong, 1e14, 0), anchor=anchor)
    expected = reference(hole & ~strong, ~hole | strong, np.where(strong, anchor, values))
    np.testing.assert_allclose(solution.values, expected, atol=1e-7)


def test_weights_and_anchors_that_are_not_finite_or_not_positive_do_not_count():
    rng = np.random.default_rng(17)
    hole = disc(30)
    values, anchor = rng.standard_normal((2, 30, 30))
    weight = np.zeros(hole.shape)
    weight[10, 10:13] = np.nan, np.inf, -1
    weight[20, 10:13] = 1
    anchor[20, 10:13] = np.nan, np.inf, -np.inf
    found = solve_poisson(hole, ~hole, values, weight=weight, anchor=anchor).values
    np.testing.assert_array_equal(found, solve_poisson(hole, ~hole, values).values)


def test_a_part_with_gaps_in_its_guidance_and_no_rim_is_continued_from_the_guidance():
    hole = np.ones((20, 24), bool)
    guidance = np.arange(24.0) * np.ones((20, 1))
    guidance[5:15, 10:20] = np.nan
    solution = solve_poisson(hole, ~hole, np.zeros(hole.shape), guidance, EXACT)
    assert solution.unanchored.all()
    gap = np.isnan(guidance)
    np.testing.assert_array_equal(solution.values[~gap], guidance[~gap])
    np.testing.assert_allclose(solution.values[gap], reference(gap, ~gap, guidance)[gap], atol=1e-8)


ONCE = """
import hashlib, numpy as np
from gimp3d.solvers.poisson import solve_poisson
rows, cols = np.mgrid[:120, :150]
hole = np.hypot(rows - 60, cols - 75) < 45
picture = np.random.default_rng(0).random(hole.shape)
print(hashlib.sha256(solve_poisson(hole, ~hole, picture).values.tobytes()).hexdigest())
"""


@pytest.mark.slow
def test_the_run_that_compiles_solves_as_those_that_load(tmp_path: Path) -> None:
    """A kernel that calls another, not inlined, runs that one's own code where both were compiled, else its copy."""
    environment = {**os.environ, "GIMP3D_CACHE": str(tmp_path)}
    runs = [subprocess.run([sys.executable, "-c", ONCE], env=environment, capture_output=True) for _ in range(2)]
    assert runs[0].returncode == 0 and runs[0].stdout == runs[1].stdout


H, W = 90, 120
V, U = np.mgrid[:H, :W].astype(float)
HOLE = np.hypot(V - 45, U - 60) < 25
RING = ~HOLE & (np.hypot(V - 45, U - 60) < 37)


@examples(30)
@given(st.floats(-5, 5), st.floats(-0.1, 0.1), st.floats(-0.1, 0.1))
def test_slopes_are_continued_exactly(level, across, down):
    plane = level + across * U + down * V
    np.testing.assert_allclose(thin_plate(plane, RING, HOLE)[HOLE], plane[HOLE], atol=1e-5)


@pytest.mark.parametrize("unknowns", [100000, 1500, 400])
def test_a_saddle_is_continued_on_any_grid(unknowns, monkeypatch):
    """x² − y² and xy bend without a force: they are minima of the bending energy."""
    saddle = ((U - 60) ** 2 - (V - 45) ** 2 + 2 * (U - 60) * (V - 45)) / 1000
    monkeypatch.setattr(module, "TENSION", 1e6)
    monkeypatch.setattr(module, "UNKNOWNS", unknowns)
    found = thin_plate(saddle, RING, HOLE)
    assert np.abs(found - saddle)[HOLE].max() < 0.02 * np.ptp(saddle)


def test_a_bump_is_continued_better_than_by_a_membrane():
    bump = np.exp(-((U - 64) ** 2 + (V - 42) ** 2) / 1500)
    plate = np.abs(thin_plate(bump, RING, HOLE) - bump)[HOLE].mean()
    membrane = np.abs(solve_poisson(HOLE, ~HOLE, bump).values - bump)[HOLE].mean()
    assert plate < 0.4 * membrane


def test_tension_makes_a_membrane_of_it(monkeypatch):
    """The tighter, the nearer to Laplace's equation; only the rim's smoothing is left."""
    bump = np.exp(-((U - 64) ** 2 + (V - 42) ** 2) / 1500)
    membrane = solve_poisson(HOLE, ~HOLE, bump).values[HOLE]
    monkeypatch.setattr(module, "SMOOTHING", 0.5)
    apart = []
    for tension in (3.0, 0.3, 0.1):
        monkeypatch.setattr(module, "TENSION", tension)
        apart.append(np.abs(thin_plate(bump, RING, HOLE)[HOLE] - membrane).max())
    assert apart == sorted(apart, reverse=True) and apart[-1] < 0.25 * apart[0]


def test_outliers_do_not_count(monkeypatch):
    rng = np.random.default_rng(0)
    plane = 1 + 0.01 * U
    spoilt = np.where(rng.random((H, W)) < 0.05, plane + rng.uniform(-3, 3, (H, W)), plane)
    spoilt += 0.001 * rng.standard_normal((H, W))
    assert np.abs(thin_plate(spoilt, RING, HOLE) - plane)[HOLE].mean() < 0.01
    monkeypatch.setattr(module, "OUTLIER", np.inf)
    trusting = thin_plate(spoilt, RING, HOLE)
    assert np.abs(trusting - plane)[HOLE].mean() > 0.03


def test_a_cluster_of_outliers_does_not_count(monkeypatch):
    """Remains of the object, an island in the hole: a plate that bends to them would make a mound."""
    island = np.hypot(V - 48, U - 66) < 4
    plane = 1 + 0.01 * U
    values = np.where(island, 1.3 * plane, plane) + 0.002 * np.random.default_rng(0).standard_normal((H, W))
    hole = HOLE & ~island
    found = thin_plate(values, RING | island, hole)
    assert np.abs(found / plane - 1)[hole].max() < 0.02
    monkeypatch.setattr(module, "OUTLIER", np.inf)
    bent = thin_plate(values, RING | island, hole)
    assert np.abs(bent / plane - 1)[hole].max() > 0.2


def test_noise_is_smoothed():
    noise = 0.01 * np.random.default_rng(0).standard_normal((H, W))
    assert np.abs(thin_plate(1 + noise, RING, HOLE)[HOLE] - 1).mean() < 0.005


def test_parts_without_a_value_are_nan():
    wanted = HOLE | (np.hypot(V - 10, U - 110) < 5)
    found = thin_plate(np.ones((H, W)), RING, wanted)
    assert np.isnan(found[8:12, 108:112]).all() and np.isfinite(found[HOLE]).all()
    assert np.isnan(thin_plate(np.ones((H, W)), np.zeros((H, W), bool), wanted)).all()


@pytest.mark.parametrize("shape", [(1, 1), (1, 9), (2, 2), (9, 1)])
def test_pictures_of_a_few_pixels(shape):
    known = np.ones(shape, bool)
    known.flat[0] = False
    values = np.full(shape, 3.0)
    found = thin_plate(values, known, ~known)
    if known.any():
        np.testing.assert_allclose(found, 3.0, rtol=1e-6)
    else:
        assert np.isnan(found).all()
