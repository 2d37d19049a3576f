"""SH fits: the reference's colour is exact, and few or bad observations do no harm."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import sph_harm_y

from gimp3d.gaussians import SH_C0
from gimp3d.solvers.harmonics import fit_anchored_sh, residual_weights, sh_basis


def directions(count: int, seed: int = 0) -> np.ndarray:
    d = np.random.default_rng(seed).normal(size=(count, 3))
    return d / np.linalg.norm(d, axis=1, keepdims=True)


def test_the_basis_is_orthonormal_and_spans_the_complex_harmonics() -> None:
    d = directions(200_000)
    gram = 4 * np.pi * sh_basis(d, 3).T @ sh_basis(d, 3) / len(d)
    np.testing.assert_allclose(gram, np.eye(16), atol=0.03)
    d = directions(60)
    theta, phi = np.arccos(d[:, 2]), np.arctan2(d[:, 1], d[:, 0])
    for degree in range(4):
        band = sh_basis(d, 3)[:, degree**2 : (degree + 1) ** 2]
        complex_ = np.stack([sph_harm_y(degree, m, theta, phi) for m in range(-degree, degree + 1)], -1)
        _, residual, _, _ = np.linalg.lstsq(complex_, band.astype(complex), rcond=None)
        assert np.abs(residual).max() < 1e-18


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 999), degree=st.integers(0, 3), views=st.integers(0, 20), ridge=st.floats(0.01, 5))
def test_the_reference_colour_is_reproduced_exactly(seed: int, degree: int, views: int, ridge: float) -> None:
    rng = np.random.default_rng(seed)
    anchor, towards = rng.uniform(0, 1, (5, 3)), directions(5, seed)
    seen = directions(5 * max(views, 1), seed + 1).reshape(5, -1, 3)[:, :views]
    residuals = rng.normal(0, 0.2, (5, views, 3))
    sh = fit_anchored_sh(anchor, towards, residuals, seen, rng.uniform(0, 1, (5, views)), degree, ridge)
    colour = 0.5 + np.einsum("nk,nkc->nc", sh_basis(towards, degree), sh)
    np.testing.assert_allclose(colour, anchor, atol=1e-9)
    assert np.isfinite(sh).all()


def test_true_coefficients_are_found_from_enough_directions() -> None:
    rng = np.random.default_rng(3)
    true = rng.normal(0, 0.2, (4, 9, 3))
    towards, seen = directions(4, 1), directions(4 * 60, 2).reshape(4, 60, 3)

    def colour(d: np.ndarray) -> np.ndarray:
        return 0.5 + np.einsum("n...k,nkc->n...c", sh_basis(d, 2), true)

    anchor = colour(towards)
    sh = fit_anchored_sh(anchor, towards, colour(seen) - anchor[:, None], seen, np.ones((4, 60)), 2, 1e-9)
    np.testing.assert_allclose(sh, true, atol=1e-6)


@pytest.mark.parametrize("case", ["duplicate", "collinear", "all weights zero"])
def test_ill_posed_directions_stay_bounded(case: str) -> None:
    anchor, towards = np.full((1, 3), 0.6), directions(1)
    seen = np.repeat(directions(1, 4)[:, None], 8, axis=1)
    if case == "collinear":
        seen = seen + np.linspace(0, 0.3, 8)[None, :, None] * [1, 0, 0]
        seen /= np.linalg.norm(seen, axis=-1, keepdims=True)
    residuals = np.random.default_rng(0).normal(0, 0.05, (1, 8, 3))
    weights = np.zeros((1, 8)) if case == "all weights zero" else np.ones((1, 8))
    sh = fit_anchored_sh(anchor, towards, residuals, seen, weights, 3, 1.0)
    everywhere = 0.5 + sh_basis(directions(500), 3) @ sh[0]
    assert np.isfinite(everywhere).all() and np.abs(everywhere - 0.6).max() < 0.5
    if case == "all weights zero":
        np.testing.assert_allclose(sh[0, 0], (0.6 - 0.5) / SH_C0, rtol=1e-12)
        assert (sh[0, 1:] == 0).all()


def test_outliers_weigh_less_than_agreeing_observations() -> None:
    towards = directions(20)
    seen = np.repeat(towards[:, None], 10, axis=1)
    residuals = np.random.default_rng(0).normal(0, 0.01, (20, 10, 3))
    residuals[:, 0] = 0.5
    weights = residual_weights(residuals, seen, towards, np.ones((20, 10), bool))
    assert weights[:, 0].max() < 1e-6 and np.median(weights[:, 1:]) > 0.5
    hidden = residual_weights(residuals, seen, towards, np.zeros((20, 10), bool))
    assert (hidden == 0).all()
