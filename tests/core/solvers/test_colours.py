"""How colours of the same points differ between pictures."""

from __future__ import annotations

import numpy as np

from gimp3d.solvers.colours import biweight, exposure_gain


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
    weights = biweight(residuals)
    assert (weights[:50] == 0).all() and weights[50:].mean() > 0.7 and (weights <= 1).all()
