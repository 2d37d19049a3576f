"""The paper's SH fit: the reference's colour is exact, true coefficients are found, and few directions do no harm."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from property_tests import examples
from scipy.special import sph_harm_y

from gimp3d.gaussians import SH_C0, sh_basis
from gimp3d.solvers.harmonics import HarmonicsSettings, Seen, fit_harmonics


def directions(count: int, seed: int = 0) -> np.ndarray:
    d = np.random.default_rng(seed).normal(size=(count, 3))
    return d / np.linalg.norm(d, axis=1, keepdims=True)


def near(towards: np.ndarray, views: int, spread: float, seed: int = 0) -> np.ndarray:
    """Directions [N, views, 3] about the given ones [N, 3]."""
    d = towards[:, None] + spread * np.random.default_rng(seed).normal(size=(len(towards), views, 3))
    return d / np.linalg.norm(d, axis=-1, keepdims=True)


def by_view(seen: np.ndarray, colours: np.ndarray) -> list[Seen]:
    """Every Gaussian in every view, from directions and colours [N, V, 3]."""
    return [(np.arange(len(seen)), seen[:, v], colours[:, v]) for v in range(seen.shape[1])]


def seen_colours(sh: np.ndarray, towards: np.ndarray) -> np.ndarray:
    """Colours [N, V, 3] of coefficients [N, K, 3] in directions [N, V, 3]."""
    basis = sh_basis(np.asarray(towards, float), round(sh.shape[1] ** 0.5) - 1)
    return 0.5 + np.einsum("nvk,nkc->nvc", basis, sh.astype(float))


def test_the_basis_is_the_real_form_of_the_complex_harmonics() -> None:
    """√2 times real and imaginary parts, the Condon–Shortley phase kept: 3DGS's signs."""
    d = directions(60)
    theta, phi = np.arccos(d[:, 2]), np.arctan2(d[:, 1], d[:, 0])
    for degree in range(4):
        for m in range(-degree, degree + 1):
            complex_ = sph_harm_y(degree, abs(m), theta, phi)
            real = complex_.real if m == 0 else np.sqrt(2) * (complex_.real if m > 0 else complex_.imag)
            np.testing.assert_allclose(sh_basis(d, degree)[:, degree**2 + degree + m], real, atol=1e-12)


@examples(40)
@given(seed=st.integers(0, 999), degree=st.integers(1, 3), views=st.integers(0, 20), ridge=st.floats(0, 5))
def test_the_reference_colour_is_reproduced_exactly(seed: int, degree: int, views: int, ridge: float) -> None:
    rng = np.random.default_rng(seed)
    anchors, towards = rng.uniform(0, 1, (5, 3)), directions(5, seed)
    seen = near(towards, views, 0.7, seed)
    observed = by_view(seen, rng.uniform(0, 1, (5, views, 3)))
    sh = fit_harmonics(anchors, towards, observed, degree, HarmonicsSettings(ridge=ridge))
    assert sh.shape == (5, (degree + 1) ** 2, 3)
    size = 1 + np.abs(sh).max()
    np.testing.assert_allclose(seen_colours(sh, towards[:, None])[:, 0], anchors, atol=2e-6 * size)


def test_true_coefficients_are_found_from_enough_directions() -> None:
    true = np.random.default_rng(3).normal(0, 0.1, (40, 9, 3))
    towards, seen = directions(40, 1), directions(40 * 60, 2).reshape(40, 60, 3)
    anchors = seen_colours(true, towards[:, None])[:, 0]
    views = by_view(seen, seen_colours(true, seen))
    loose = HarmonicsSettings(ridge=1e-4)
    np.testing.assert_allclose(fit_harmonics(anchors, towards, views, 2, loose), true, atol=2e-4)
    shuffled = [tuple(a[::-1] for a in view) for view in reversed(views)]
    again = fit_harmonics(anchors, towards, shuffled, 2, loose)  # type: ignore[arg-type]
    np.testing.assert_allclose(again, true, atol=2e-4)


@pytest.mark.parametrize("anchored", [True, False])
def test_the_fit_is_the_papers_weighted_least_squares(anchored: bool) -> None:
    """As printed, the basis is not anchored, and the fit misses the reference's colour."""
    rng = np.random.default_rng(5)
    anchors, towards = rng.uniform(0.3, 0.7, (4, 3)), directions(4, 1)
    seen = near(towards, 40, 1.0, 2)
    colours = anchors[:, None] + 0.1 * seen[..., :1] + rng.normal(0, 0.01, (4, 40, 3))
    sh = fit_harmonics(anchors, towards, by_view(seen, colours), 1, HarmonicsSettings(anchored, ridge=1e-4))
    residuals = colours - anchors[:, None]
    sigma = 1.4826 * np.median(np.linalg.norm(residuals, axis=-1))
    weights = np.exp(-(residuals**2).sum(-1) / (2 * (sigma * np.exp(1 - np.einsum("nvc,nc->nv", seen, towards))) ** 2))
    for n in range(4):
        basis, root = sh_basis(seen[n], 1)[:, 1:], np.sqrt(weights[n])[:, None]
        if anchored:
            basis = basis - sh_basis(towards[n], 1)[1:]
        expected = np.linalg.lstsq(root * basis, root * residuals[n], rcond=None)[0]
        np.testing.assert_allclose(sh[n, 1:], expected, atol=5e-4)
    missed = np.abs(seen_colours(sh, towards[:, None])[:, 0] - anchors).max()
    if anchored:
        assert missed < 1e-5
    else:
        assert missed > 0.02
        np.testing.assert_allclose(sh[:, 0], (anchors - 0.5) / SH_C0, atol=1e-5)


def few_directions(case: str) -> tuple[np.ndarray, np.ndarray]:
    """Directions [1, V, 3] of the observations, and the reference direction."""
    towards = directions(1, 7)
    aside = np.cross(towards, [[0.0, 0, 1]]) / np.linalg.norm(np.cross(towards, [[0.0, 0, 1]]))
    angles = {"duplicates": np.full(8, 0.5), "the reference itself": np.zeros(8)}.get(case, np.linspace(-0.6, 0.9, 8))
    seen = np.cos(angles)[:, None] * towards + np.sin(angles)[:, None] * aside
    if case == "within 0.1°":
        seen = near(towards, 8, 1e-3)[0]
    count = {"no view": 0, "one view": 1, "two views": 2}.get(case, 8)
    return seen[None, :count], towards


@pytest.mark.parametrize("ridge", [1e-3, 0.0])
@pytest.mark.parametrize(
    "case", ["no view", "one view", "two views", "duplicates", "the reference itself", "a line", "within 0.1°"]
)
def test_few_directions_leave_the_reference_colour_alone(case: str, ridge: float) -> None:
    seen, towards = few_directions(case)
    colours = 0.6 + np.random.default_rng(0).normal(0, 0.2, (*seen.shape[:2], 3))
    sh = fit_harmonics(np.full((1, 3), 0.6), towards, by_view(seen, colours), 3, HarmonicsSettings(ridge=ridge))
    np.testing.assert_allclose(sh[0, 0], (0.6 - 0.5) / SH_C0, rtol=1e-6)
    assert (sh[0, 1:] == 0).all()


def test_a_view_that_shows_another_thing_hardly_counts() -> None:
    towards = directions(30, 1)
    seen = near(towards, 20, 0.5, 2)
    anchors = np.full((30, 3), 0.4)
    colours = np.repeat((0.4 + 0.1 * (seen[..., :1] - towards[:, None, :1])), 3, -1)
    spoilt = colours.copy()
    spoilt[:, 3] += 0.5
    right, wrong = (fit_harmonics(anchors, towards, by_view(seen, c), 1) for c in (colours, spoilt))
    assert np.abs(wrong - right).max() < 0.15 * np.abs(right[:, 1:]).max()
