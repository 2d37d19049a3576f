"""Robust least squares: exact, indifferent to outliers, and one line for what is one cloud."""

from __future__ import annotations

import numpy as np
import pytest

from gimp3d.solvers.robust import biweight, exposure_gain, robust_fit


def line(m: np.ndarray) -> np.ndarray:
    return np.stack([m, np.ones_like(m)], -1)


def test_without_errors_the_fit_is_exact() -> None:
    rng = np.random.default_rng(0)
    rows, x = rng.normal(size=(50, 3)), np.array([2.0, -1, 0.5])
    found, sigma = robust_fit(rows, rows @ x)
    np.testing.assert_allclose(found, x, rtol=1e-9)
    assert sigma < 1e-9
    np.testing.assert_array_equal(robust_fit(rows, np.zeros(50))[0], 0)


def test_sigma_is_the_standard_deviation_of_normal_errors() -> None:
    rng = np.random.default_rng(1)
    m = rng.normal(size=4000)
    found, sigma = robust_fit(line(m), 3 * m + 1 + 0.2 * rng.normal(size=4000))
    np.testing.assert_allclose(found, [3, 1], atol=0.02)
    assert sigma == pytest.approx(0.2, rel=0.05)


@pytest.mark.parametrize("share", [0.1, 0.3])
def test_outliers_to_one_side_do_not_matter(share: float) -> None:
    rng = np.random.default_rng(2)
    m = rng.uniform(0, 1, 3000)
    d = 2 * m + 1 + 0.01 * rng.normal(size=3000)
    far = rng.random(3000) < share
    d[far] += rng.uniform(0.5, 3, far.sum())
    found, _ = robust_fit(line(m), d)
    np.testing.assert_allclose(found, [2, 1], atol=0.01)
    assert abs(np.polyfit(m, d, 1)[1] - 1) > 0.1  # plain least squares is led astray


def test_two_clouds_of_errors_on_one_line_give_that_line() -> None:
    """Within a cloud the prior's errors are all there is: a slope fitted to the larger one alone would be 0."""
    rng = np.random.default_rng(3)
    level = np.repeat([0.0, 1.0], [1300, 700])
    found, _ = robust_fit(line(level + 0.15 * rng.normal(size=2000)), level + 0.01 * rng.normal(size=2000))
    assert found[0] > 0.8


def test_the_gain_is_found_though_some_pairs_are_of_other_surfaces() -> None:
    rng = np.random.default_rng(0)
    before = rng.uniform(30, 200, (1000, 3))
    after = before * [0.8, 1.0, 1.2]
    after[:200] = rng.uniform(30, 200, (200, 3))
    np.testing.assert_allclose(exposure_gain(before, after), [0.8, 1.0, 1.2], rtol=0.05)


def test_burnt_or_few_pairs_tell_no_gain() -> None:
    burnt, dim = np.full((1000, 3), 255.0), np.full((1000, 3), 120.0)
    np.testing.assert_array_equal(exposure_gain(burnt, dim), 1)
    np.testing.assert_array_equal(exposure_gain(dim[:49], dim[:49] / 2), 1)


def test_outliers_count_for_nothing() -> None:
    residuals = np.random.default_rng(0).normal(0, 2, (500, 3))
    residuals[:50] = 100
    weights = biweight(residuals, 1.0)
    assert (weights[:50] == 0).all() and weights[50:].mean() > 0.7 and (weights <= 1).all()
