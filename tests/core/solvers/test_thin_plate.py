"""Thin plates: what they reproduce exactly, their independence of the grid, and outliers."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from property_tests import examples

from gimp3d.solvers import poisson as module
from gimp3d.solvers.poisson import solve_poisson, thin_plate

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
