"""SH fits: the reference's colour is exact, the choice is what leave-one-out says, and bad observations do no harm."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from property_tests import examples
from scipy.special import sph_harm_y

from gimp3d.compute.threads import set_thread_count
from gimp3d.errors import BadInput
from gimp3d.gaussians import SH_C0
from gimp3d.sh import sh_basis
from gimp3d.solvers import harmonics
from gimp3d.solvers.harmonics import (
    HarmonicsFit,
    HarmonicsSettings,
    Observations,
    Reason,
    gather_observations,
)

seeds = st.integers(0, 999)
fit_harmonics = partial(harmonics.fit_harmonics, floor=0.2)  # these colours have noise, and few are wrong


def directions(count: int, seed: int = 0) -> np.ndarray:
    d = np.random.default_rng(seed).normal(size=(count, 3))
    return d / np.linalg.norm(d, axis=1, keepdims=True)


def near(towards: np.ndarray, views: int, spread: float, seed: int = 0) -> np.ndarray:
    """Directions [N, views, 3] about the given ones [N, 3]."""
    d = towards[:, None] + spread * np.random.default_rng(seed).normal(size=(len(towards), views, 3))
    return d / np.linalg.norm(d, axis=-1, keepdims=True)


def dense(seen: np.ndarray, colours: np.ndarray, weights: np.ndarray | None = None) -> Observations:
    """As many observations [N, V, 3] for every Gaussian; those of weight 0 are left out."""
    weights = np.ones(seen.shape[:2]) if weights is None else weights
    used = weights > 0
    return Observations(np.concatenate([[0], np.cumsum(used.sum(1))]), seen[used], colours[used], weights[used])


def seen_colours(sh: np.ndarray, towards: np.ndarray) -> np.ndarray:
    """Colours [N, V, 3] of coefficients [N, K, 3] in directions [N, V, 3]."""
    basis = sh_basis(np.asarray(towards, float), round(sh.shape[1] ** 0.5) - 1)
    return 0.5 + np.einsum("nvk,nkc->nvc", basis, sh.astype(float))


def lobes(towards: np.ndarray, peaks: np.ndarray) -> np.ndarray:
    """Grey highlights [N, V, 3] about `peaks` [N, 3]."""
    value = 0.3 + 0.4 * np.exp((np.einsum("nvk,nk->nv", towards, peaks) - 1) / 0.1)
    return np.repeat(value[..., None], 3, -1)


def simulated(
    count: int, views: int, spread: float, seed: int, wrong: float = 0.1
) -> tuple[np.ndarray, np.ndarray, Observations, np.ndarray]:
    """Highlights with noise and wrong observations; anchors, reference directions, observations, peaks."""
    rng = np.random.default_rng(seed)
    towards = directions(count, seed)
    peaks, seen = near(towards, 1, spread, seed + 1)[:, 0], near(towards, views, spread, seed + 2)
    colours = lobes(seen, peaks) + rng.normal(0, 0.02, (count, views, 3))
    colours[rng.random((count, views)) < wrong] += 0.4
    return lobes(towards[:, None], peaks)[:, 0], towards, dense(seen, colours), peaks


# ----------------------------------------------------------------------------------------------- ------- the basis


def test_the_basis_is_the_real_form_of_the_complex_harmonics() -> None:
    """√2 times real and imaginary parts, the Condon–Shortley phase kept: 3DGS's signs."""
    d = directions(60)
    theta, phi = np.arccos(d[:, 2]), np.arctan2(d[:, 1], d[:, 0])
    for degree in range(4):
        for m in range(-degree, degree + 1):
            complex_ = sph_harm_y(degree, abs(m), theta, phi)
            real = complex_.real if m == 0 else np.sqrt(2) * (complex_.real if m > 0 else complex_.imag)
            np.testing.assert_allclose(sh_basis(d, degree)[:, degree**2 + degree + m], real, atol=1e-12)


# ------------------------------------------------------------------------------------------------- what a fit must be


@examples(40)
@given(seed=seeds, degree=st.integers(0, 3), views=st.integers(0, 20), ridge=st.one_of(st.none(), st.floats(0.01, 5)))
def test_the_reference_colour_is_reproduced_exactly(seed: int, degree: int, views: int, ridge: float | None) -> None:
    rng = np.random.default_rng(seed)
    anchors, towards = rng.uniform(0, 1, (5, 3)), directions(5, seed)
    seen = near(towards, views, 0.7, seed)
    observed = dense(seen, rng.uniform(0, 1, (5, views, 3)), rng.uniform(0, 1, (5, views)))
    fit = fit_harmonics(anchors, towards, observed, degree, HarmonicsSettings(ridge=ridge))
    np.testing.assert_allclose(seen_colours(fit.sh, towards[:, None])[:, 0], anchors, atol=2e-6)
    assert (fit.degree <= degree).all() and fit.sh.shape == (5, (degree + 1) ** 2, 3)
    for n, used in enumerate(fit.degree):
        assert (fit.sh[n, (used + 1) ** 2 :] == 0).all()


def test_true_coefficients_are_found_from_enough_directions() -> None:
    rng = np.random.default_rng(3)
    true = rng.normal(0, 0.1, (40, 9, 3))
    towards = directions(40, 1)
    seen = directions(40 * 60, 2).reshape(40, 60, 3)
    anchors = seen_colours(true, towards[:, None])[:, 0]
    observed = dense(seen, seen_colours(true, seen))
    fixed = fit_harmonics(anchors, towards, observed, 2, HarmonicsSettings(ridge=1e-4))
    np.testing.assert_allclose(fixed.sh, true, atol=2e-4)
    chosen = fit_harmonics(anchors, towards, observed, floor=0.01)
    assert (chosen.degree == 2).mean() > 0.9 and (chosen.reasons == Reason.VIEW_DEPENDENT).all()
    np.testing.assert_allclose(chosen.sh[:, :9], true, atol=5e-3)


def test_as_printed_the_basis_is_not_anchored_and_misses_the_references_colour() -> None:
    rng = np.random.default_rng(5)
    anchors, towards = rng.uniform(0.3, 0.7, (4, 3)), directions(4, 1)
    seen = near(towards, 40, 1.0, 2)
    colours = anchors[:, None] + 0.1 * seen[..., :1]
    printed = fit_harmonics(anchors, towards, dense(seen, colours), 1, HarmonicsSettings(ridge=1e-4, anchored=False))
    np.testing.assert_allclose(printed.sh[:, 0], (anchors - 0.5) / SH_C0, atol=1e-5)
    residuals = colours - anchors[:, None]
    weights = np.exp(
        -(residuals**2).sum(-1) / (2 * (printed.sigma * np.exp(1 - np.einsum("nvc,nc->nv", seen, towards))) ** 2)
    )
    for n in range(4):
        basis, root = sh_basis(seen[n], 1)[:, 1:], np.sqrt(weights[n])[:, None]
        expected = np.linalg.lstsq(root * basis, root * residuals[n], rcond=None)[0]
        np.testing.assert_allclose(printed.sh[n, 1:], expected, atol=2e-4)
    there = seen_colours(printed.sh, towards[:, None])[:, 0]
    assert np.abs(there - anchors).max() > 0.02


def reference_fit(
    anchors: np.ndarray,  # [N, 3]
    towards: np.ndarray,  # [N, 3]
    seen: np.ndarray,  # [N, V, 3]
    colours: np.ndarray,  # [N, V, 3]
    given: np.ndarray,  # [N, V]
    degree: int,
    floor: float,
    offset: bool,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """The rule of fit_harmonics in dense float64: coefficients above 0, degrees, errors, ranks.

    The offset that the fit eliminates is a column of ones here.
    """
    r, apart = colours - anchors[:, None], seen - towards[:, None]
    size = np.linalg.norm(r, axis=-1)
    basis = sh_basis(seen, degree) - sh_basis(towards, degree)[:, None]
    basis[..., 0] = offset
    sigma = 1.4826 * np.median(size[given > 0])

    def least_ridge(w: np.ndarray) -> np.ndarray:
        total = w.sum(1)
        mean = np.einsum("nv,nvk->nk", w, apart) / total[:, None] * offset
        distance = np.sqrt((w * ((apart - mean[:, None]) ** 2).sum(-1)).sum(1) / total)
        return floor * (distance + 0.1) * (1 + 10 / total)

    def solve(w: np.ndarray, k: int, ridge: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        x, y = basis[..., :k], basis[..., :k] * w[..., None]
        penalty = ridge[:, None, None] * np.eye(k)
        penalty[:, 0, 0] = 1e-9 if offset else 1
        inverse = np.linalg.inv(np.einsum("nvk,nvl->nkl", y, x) + penalty)
        found = inverse @ np.einsum("nvk,nvc->nkc", y, r)
        leverage = np.einsum("nvk,nkl,nvl->nv", y, inverse, x)
        return found, np.linalg.norm(r - np.einsum("nvk,nkc->nvc", x, found), axis=-1) / (1 - leverage), leverage

    w = given * np.exp(-(size**2) / (2 * (sigma * np.exp((apart**2).sum(-1) / 2)) ** 2))
    _, error, _ = solve(w, (degree + 1) ** 2, 4 * least_ridge(w))
    total = given.sum(1)
    rows = zip(error, given)
    own = 1.4826 * np.array([np.sort(e)[np.searchsorted(np.cumsum(g[np.argsort(e)]), g.sum() / 2)] for e, g in rows])
    scale = 3 * np.sqrt((total * own**2 + 10 * sigma**2) / (total + 10))
    w = given / (1 + (error / scale[:, None]) ** 2) ** 2
    _, error, _ = solve(w, 1, least_ridge(w))
    best = (w * error**2).sum(1) / w.sum(1) / 1.02
    errors, ranks = np.sqrt(best * 1.02), np.zeros(len(r))
    found, degrees = np.zeros((len(r), (degree + 1) ** 2 - 1, 3)), np.zeros(len(r), int)
    for step in (1, 16):
        for d in range(1, degree + 1):
            k = (d + 1) ** 2
            here, error, leverage = solve(w, k, step * least_ridge(w))
            left_out = (w * error**2).sum(1) / w.sum(1)
            better = left_out < best
            best[better], errors[better] = left_out[better], np.sqrt(left_out[better])
            found[better], degrees[better] = 0, d
            found[better, : k - 1] = here[better, 1:]
            ranks[better] = leverage.sum(1)[better]
    return found, degrees, errors, ranks


@pytest.mark.parametrize(("views", "spread"), [(6, 0.8), (25, 0.2), (60, 0.5), (130, 0.1)])
def test_the_fit_does_what_the_rule_says(views: int, spread: float) -> None:
    anchors, towards, observed, _ = simulated(75, views, spread, views)
    seen, colours = observed.directions.reshape(75, views, 3), observed.colours.reshape(75, views, 3)
    rng = np.random.default_rng(1)
    weights = rng.uniform(0.3, 1.5, (75, views)) * (rng.random((75, views)) < rng.uniform(0.5, 1, (75, 1)))  # ragged
    for degree, floor, offset in ((3, 0.2, False), (2, 5.0, True), (1, 0.05, False), (3, 1.0, True)):
        asked = HarmonicsSettings(offset)
        fit = fit_harmonics(anchors, towards, dense(seen, colours, weights), degree, asked, floor=floor)
        found, degrees, errors, ranks = reference_fit(anchors, towards, seen, colours, weights, degree, floor, offset)
        posed = fit.reasons < Reason.ONE_DIRECTION
        same = posed & (fit.degree == degrees)
        assert posed.mean() > 0.8 and same.sum() == posed.sum()
        everywhere = directions(100)
        basis = sh_basis(everywhere, degree)[:, 1:]
        ours = np.einsum("vk,nkc->nvc", basis, fit.sh[same, 1:])
        np.testing.assert_allclose(ours, np.einsum("vk,nkc->nvc", basis, found[same]), atol=1e-6)
        np.testing.assert_allclose(fit.error[same], errors[same], rtol=1e-5)
        np.testing.assert_allclose(fit.rank[same], ranks[same], rtol=1e-5)


def test_errors_are_those_of_fits_without_the_observation() -> None:
    rng = np.random.default_rng(5)
    anchors, towards = rng.uniform(0.3, 0.6, (1, 3)), directions(1, 5)
    seen = near(towards, 12, 0.5, 5)
    colours = anchors[:, None] + rng.normal(0, 0.05, (1, 12, 3))
    fit = fit_harmonics(anchors, towards, dense(seen, colours), 2, HarmonicsSettings(ridge=0.3))
    r, x = (colours - anchors[:, None])[0], (sh_basis(seen, 2) - sh_basis(towards, 2)[:, None])[0, :, 1:]
    weight = np.exp(-(r**2).sum(-1) / (2 * (fit.sigma * np.exp(1 - seen[0] @ towards[0])) ** 2))
    squares = []
    for left_out in range(12):
        w = np.where(np.arange(12) == left_out, 0, weight)[:, None]
        without = np.linalg.solve(x.T @ (w * x) + 0.3 * np.eye(8), x.T @ (w * r))
        squares.append(((r[left_out] - x[left_out] @ without) ** 2).sum())
    assert fit.error[0] == pytest.approx(np.sqrt(np.average(squares, weights=weight)), rel=1e-4)
    hat = x @ np.linalg.solve(x.T @ (weight[:, None] * x) + 0.3 * np.eye(8), (weight[:, None] * x).T)
    assert fit.rank[0] == pytest.approx(np.trace(hat), rel=1e-4)


def test_a_colour_without_view_dependence_stays_constant() -> None:
    towards = directions(400, 1)
    anchors = np.full((400, 3), 0.4)
    colours = anchors[:, None] + np.random.default_rng(2).normal(0, 0.03, (400, 20, 3))
    fit = fit_harmonics(anchors, towards, dense(near(towards, 20, 0.5, 3), colours))
    assert fit.counts["constant"] > 250 and sum(fit.counts.values()) == 400
    anywhere = seen_colours(fit.sh, near(towards, 20, 1.0, 4))
    assert np.sqrt(np.mean((anywhere - 0.4) ** 2)) < 0.01  # three times below the noise


# ---------------------------------------------------------------------------------------------- ill-posed, stability


def ill_posed(case: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Directions and weights of eight observations, and the reference direction."""
    towards = directions(1, 7)
    aside = np.cross(towards, [[0.0, 0, 1]]) / np.linalg.norm(np.cross(towards, [[0.0, 0, 1]]))
    angles = {"duplicate": np.full(8, 0.5), "reference itself": np.zeros(8)}.get(case, np.linspace(-0.6, 0.9, 8))
    seen = np.cos(angles)[:, None] * towards + np.sin(angles)[:, None] * aside
    if case == "within 0.1°":
        seen = near(towards, 8, 1e-3)[0]
    weights = np.ones(8)
    if case == "one view":
        weights[1:] = 0
    if case == "two views on a line":
        weights[2:] = 0
    if case == "all weights zero":
        weights[:] = 0
    if case == "not finite":
        seen[:4] = np.nan
        weights[4:] = np.nan
    return seen[None], weights[None], towards


@pytest.mark.parametrize("offset", [False, True])
@pytest.mark.parametrize("ridge", [None, 1e-3, 0.0])
@pytest.mark.parametrize(
    ("case", "reason"),
    [
        ("no observation", Reason.UNOBSERVED),
        ("all weights zero", Reason.UNOBSERVED),
        ("not finite", Reason.UNOBSERVED),
        ("one view", Reason.ONE_DIRECTION),
        ("two views on a line", Reason.ONE_DIRECTION),
        ("duplicate", Reason.ONE_DIRECTION),
        ("reference itself", Reason.ONE_DIRECTION),
        ("collinear", Reason.ONE_DIRECTION),
        ("within 0.1°", Reason.ONE_DIRECTION),
    ],
)
def test_ill_posed_observations_leave_the_reference_colour_alone(
    case: str, reason: Reason, ridge: float | None, offset: bool
) -> None:
    seen, weights, towards = ill_posed(case)
    anchors = np.full((1, 3), 0.6)
    colours = 0.6 + np.random.default_rng(0).normal(0, 0.2, (8, 3))
    count = 0 if case == "no observation" else 8
    observed = Observations(np.array([0, count]), seen[0, :count], colours[:count], weights[0, :count])
    fit = fit_harmonics(anchors, towards, observed, 3, HarmonicsSettings(offset=offset, ridge=ridge))
    assert fit.reasons[0] == reason and fit.degree[0] == 0 and fit.rank[0] == 0
    np.testing.assert_allclose(fit.sh[0, 0], (0.6 - 0.5) / SH_C0, rtol=1e-6)
    assert (fit.sh[0, 1:] == 0).all() and np.isfinite(fit.error).all()


def test_bad_observations_are_left_out() -> None:
    anchors, towards, observed, _ = simulated(30, 12, 0.4, 0)
    bad = np.arange(len(observed.weights)) % 7 == 3
    weights, colours, seen = np.array(observed.weights), np.array(observed.colours), np.array(observed.directions)
    without = dense(*(a.reshape(30, 12, -1) for a in (seen, colours)), np.where(bad, 0, weights).reshape(30, 12))
    k = np.flatnonzero(bad)
    weights[k[0::4]], colours[k[1::4], 1], seen[k[2::4], 2], weights[k[3::4]] = -1, np.nan, np.inf, np.inf
    spoilt = fit_harmonics(anchors, towards, Observations(observed.offsets, seen, colours, weights))
    clean = fit_harmonics(anchors, towards, without)
    np.testing.assert_array_equal(spoilt.degree, clean.degree)
    np.testing.assert_allclose(spoilt.sh, clean.sh, atol=1e-5)


@examples(60)
@given(
    seed=seeds,
    views=st.integers(1, 40),
    spread=st.sampled_from([1e-4, 1e-2, 0.1, 0.5, 3.0]),
    away=st.floats(0, 3.1),
    asked=st.sampled_from([HarmonicsSettings(), HarmonicsSettings(offset=True), HarmonicsSettings(ridge=1.0)]),
)
def test_nothing_explodes(seed: int, views: int, spread: float, away: float, asked: HarmonicsSettings) -> None:
    rng = np.random.default_rng(seed)
    towards = directions(64, seed)
    aside = np.cross(towards, directions(64, seed + 1))
    cluster = np.cos(away) * towards + np.sin(away) * aside / np.linalg.norm(aside, axis=1, keepdims=True)
    seen = near(cluster, views, spread, seed)
    colours, anchors = rng.uniform(0, 1, (64, views, 3)), rng.uniform(0, 1, (64, 3))
    fit = fit_harmonics(anchors, towards, dense(seen, colours), 3, asked)
    everywhere = seen_colours(fit.sh, np.broadcast_to(directions(300), (64, 300, 3)))
    largest = np.abs(everywhere - anchors[:, None]).max()
    assert largest < 12  # of noise as large as colours get; without a ridge 1e4 … 1e9


def test_absurd_colours_stay_finite() -> None:
    anchors, towards, observed, _ = simulated(20, 12, 0.4, 1)
    colours = np.array(observed.colours)
    colours[::5] = 1e25
    fit = fit_harmonics(anchors, towards, replace(observed, colours=colours))
    assert np.isfinite(fit.sh).all()


def error_of(fit: HarmonicsFit, towards: np.ndarray, peaks: np.ndarray, spread: float) -> float:
    where = near(towards, 40, spread, 77)
    return float(np.sqrt(np.mean((seen_colours(fit.sh, where) - lobes(where, peaks)) ** 2)))


def test_one_wrong_observation_in_ten_costs_little() -> None:
    errors = []
    for wrong in (0.0, 0.1):
        anchors, towards, observed, peaks = simulated(300, 30, 0.35, 11, wrong)
        errors.append(error_of(fit_harmonics(anchors, towards, observed), towards, peaks, 0.35))
        constant = error_of(fit_harmonics(anchors, towards, observed, 0), towards, peaks, 0.35)
    assert errors[1] < 1.4 * errors[0] and errors[1] < 0.6 * constant
    plain = fit_harmonics(anchors, towards, observed, 3, HarmonicsSettings(ridge=0.01))
    assert errors[1] < 0.85 * error_of(plain, towards, peaks, 0.35)


def test_the_floor_holds_where_no_view_has_looked() -> None:
    anchors, towards, observed, peaks = simulated(400, 10, 0.15, 21)
    bold, usual = (fit_harmonics(anchors, towards, observed, floor=floor) for floor in (1e-4, 0.2))
    assert error_of(usual, towards, peaks, 0.5) < 0.8 * error_of(bold, towards, peaks, 0.5)


def with_gain(observed: Observations, gains: np.ndarray) -> Observations:
    """Views of other exposures."""
    views = len(gains)
    colours = observed.colours.reshape(-1, views, 3) * gains[:, None]
    return replace(observed, colours=colours.reshape(-1, 3))


def test_an_exposure_jump_of_some_views_costs_little() -> None:
    anchors, towards, observed, peaks = simulated(300, 30, 0.35, 31, wrong=0.0)
    jumped = with_gain(observed, np.where(np.arange(30) % 5, 1.0, 1.4))
    before = error_of(fit_harmonics(anchors, towards, observed), towards, peaks, 0.35)
    after = error_of(fit_harmonics(anchors, towards, jumped), towards, peaks, 0.35)
    plain = fit_harmonics(anchors, towards, jumped, 3, HarmonicsSettings(ridge=0.01))
    assert after < 1.5 * before and after < 0.9 * error_of(plain, towards, peaks, 0.35)


def test_a_reference_lit_otherwise_than_all_views_does_not_bend_the_colour() -> None:
    """A shadow on all views, gone in the reference: the new surface has none."""
    anchors, towards, observed, peaks = simulated(300, 30, 0.35, 41, wrong=0.05)
    darker = with_gain(observed, np.full(30, 0.6))
    trusting, wary = (
        error_of(fit_harmonics(anchors, towards, darker, 3, HarmonicsSettings(offset=offset)), towards, peaks, 0.35)
        for offset in (False, True)
    )
    constant = error_of(fit_harmonics(anchors, towards, darker, 0), towards, peaks, 0.35)
    assert wary < 0.8 * constant < trusting


# --------------------------------------------------------------------------------------------------- how it is called


def test_results_depend_neither_on_threads_nor_on_neighbours() -> None:
    anchors, towards, observed, _ = simulated(203, 17, 0.4, 2)
    rng = np.random.default_rng(0)
    weights = (rng.random((203, 17)) < rng.uniform(0, 1, (203, 1))).astype(float)
    seen, colours = (a.reshape(203, 17, 3) for a in (observed.directions, observed.colours))
    ragged = dense(seen, colours, weights)
    fits = []
    for threads in (1, 2, 4):
        set_thread_count(threads)
        fits.append(fit_harmonics(anchors, towards, ragged))
    set_thread_count(None)
    assert len({f.sh.tobytes() + f.degree.tobytes() + f.error.tobytes() for f in fits}) == 1
    order = rng.permutation(203)
    moved = fit_harmonics(anchors[order], towards[order], dense(seen[order], colours[order], weights[order]))
    assert moved.sigma == fits[0].sigma
    np.testing.assert_array_equal(moved.sh, fits[0].sh[order])


@pytest.mark.parametrize("views", [8, 10, 16])
def test_sigma_is_that_of_all_views(views: int) -> None:
    """Every Gaussian's first observation is the reference itself."""
    count = 80_000 // views
    colours = 0.5 + np.random.default_rng(0).normal(0, 0.05, (count, views, 3))
    colours[:, 0] = 0.5
    towards = directions(count)
    fit = fit_harmonics(np.full((count, 3), 0.5), towards, dense(near(towards, views, 0.3), colours), 0)
    assert fit.sigma == pytest.approx(1.4826 * np.median(np.linalg.norm(colours - 0.5, axis=-1)), rel=0.05)


def test_observations_of_several_views_are_sorted_by_gaussian() -> None:
    rng = np.random.default_rng(4)
    rows = [rng.permutation(9)[: rng.integers(0, 9)] for _ in range(6)]
    views = [(r, rng.normal(size=(len(r), 3)), rng.random((len(r), 3))) for r in rows]
    gathered = gather_observations(9, views)
    for n in range(9):
        expected = [(d[r == n], c[r == n]) for r, d, c in views if (r == n).any()]
        here = slice(gathered.offsets[n], gathered.offsets[n + 1])
        np.testing.assert_allclose(gathered.directions[here], np.reshape([d for d, _ in expected], (-1, 3)), rtol=1e-6)
        np.testing.assert_allclose(gathered.colours[here], np.reshape([c for _, c in expected], (-1, 3)), rtol=1e-6)
    assert gathered.offsets[-1] == len(gathered.weights) == sum(map(len, rows))
    assert len(gather_observations(3, []).offsets) == 4


def test_wrong_shapes_are_refused() -> None:
    anchors, towards, observed, _ = simulated(4, 5, 0.4, 0)
    empty = Observations(np.zeros(1, np.int64), np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0))
    assert len(fit_harmonics(np.zeros((0, 3)), np.zeros((0, 3)), empty).sh) == 0
    with pytest.raises(BadInput, match="do not match"):
        fit_harmonics(anchors[:3], towards[:3], observed)
    with pytest.raises(BadInput, match="degree"):
        fit_harmonics(anchors, towards, observed, 4)
    with pytest.raises(BadInput, match="fall"):
        fit_harmonics(anchors, towards, replace(observed, offsets=observed.offsets[[0, 2, 1, 3, 4]]))
    with pytest.raises(BadInput, match="finite"):
        fit_harmonics(np.where(np.eye(4, 3) > 0, np.nan, anchors), towards, observed)
