"""What a picture's statistics let expect of a hole."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest

from gimp3d.solvers import kriging
from gimp3d.solvers.edges import Edge
from gimp3d.solvers.kriging import carried, expect, foretell, variogram

SIDE = 56
Y, X = np.indices((SIDE, SIDE))
HOLE = np.hypot(Y - 27, X - 29) < 9


def grey(picture: np.ndarray) -> np.ndarray:
    return np.broadcast_to(picture[..., None], (*picture.shape, 3)).astype(np.float32)


def test_it_is_the_best_linear_guess_of_a_stationary_texture() -> None:
    """Against the definition, pixel by pixel in float64."""
    rng = np.random.default_rng(0)
    picture = np.clip(rng.normal(0.5, 0.1, (SIDE, SIDE, 3)), 0, 1)
    picture = (picture + np.roll(picture, 1, 0) + np.roll(picture, 1, 1)).astype(np.float32) / 3
    hole = np.hypot(Y - 27, X - 29) < 4
    known = ~hole
    found = expect(picture, hole, known)  # the picture is so small that it is looked at as it is
    thickness = 2 * 4.0
    away = np.array([np.hypot(Y - y, X - x) for y, x in np.argwhere(hole)]).min(0)
    near = known & (away <= kriging.TELLING * thickness - 1)
    given = known & (away <= kriging.LEAST_GIVEN)
    mean = picture[near].mean(0, dtype=np.float64)
    deviations = {tuple(p): picture[tuple(p)].astype(np.float64) - mean for p in np.argwhere(near)}

    def covariance(dy: int, dx: int) -> float:
        pairs = (d @ deviations[y + dy, x + dx] for (y, x), d in deviations.items() if (y + dy, x + dx) in deviations)
        return sum(pairs) / near.sum() / 3

    table = {(dy, dx): covariance(dy, dx) for dy in range(-17, 18) for dx in range(-17, 18)}
    g, u = np.argwhere(given), np.argwhere(hole)
    between = np.array([[table[tuple(b - a)] for b in g] for a in g]) + kriging.NUGGET * table[0, 0] * np.eye(len(g))
    across = np.array([[table[tuple(b - a)] for b in g] for a in u])
    weights = np.linalg.solve(between, across.T).T
    guess = mean + weights @ (picture[given] - mean)
    # how far `near` reaches is told by OpenCV's chamfer distance, which is off by a few per cent
    assert np.abs(found.colours[hole] - guess).max() < 0.02 < 0.5 * picture[hole].std()
    np.testing.assert_allclose(found.variance[hole], table[0, 0] - (weights * across).sum(1), rtol=0.1)


def test_what_an_edge_parts_has_a_mean_of_its_own_on_either_side() -> None:
    """A border that runs into the hole and on to where nothing is known."""
    grain = cv2.GaussianBlur(np.random.default_rng(0).normal(0, 1, (SIDE, SIDE)), (0, 0), 1)
    picture = grey(np.where(X + 0.3 * Y > 35, 0.8, 0.3) + 0.03 * grain / grain.std())
    known = ~HOLE & (Y > 20)
    along = np.array([-0.3, 1.0]) / math.hypot(0.3, 1)
    edge = Edge(np.array([27.5, 25.0]), along, (-25.0, 35.0), np.full(3, 127.0), np.full(3, 140.0))
    shown, clear = np.where(known[..., None], picture, 0), HOLE & (np.abs(X + 0.3 * Y - 35) > 2)
    found = [expect(shown, HOLE, known, edges).colours for edges in ((edge,), ())]
    with_edge, without = (np.sqrt(((colours - picture)[clear] ** 2).mean()) for colours in found)
    assert with_edge < 0.5 * without


@pytest.mark.parametrize("period", [9.0, 14.0])
def test_stripes_run_on(period: float) -> None:
    picture = grey(0.5 + 0.3 * np.sin(2 * np.pi * (X + 0.2 * Y) / period))
    found = expect(np.where(HOLE[..., None], 0, picture), HOLE, ~HOLE)
    off = np.sqrt(((found.colours - picture)[HOLE] ** 2).mean())
    assert off < 0.25 * picture[HOLE].std()
    assert found.variance[HOLE].max() < 0.3 * picture.var()


def test_of_noise_nothing_but_its_mean_is_expected() -> None:
    picture = np.random.default_rng(0).normal(0.5, 0.1, (SIDE, SIDE, 3)).astype(np.float32)
    found = expect(picture, HOLE, ~HOLE)
    assert np.abs(found.colours[HOLE] - 0.5).mean() < 0.03
    assert np.median(found.variance[HOLE]) == pytest.approx(0.01, rel=0.2)
    assert (found.variance[~HOLE] == 0).all()


def test_even_surroundings_leave_no_doubt_and_what_is_unknown_has_no_say() -> None:
    beside = (np.abs(X - 45) < 4) & ~HOLE
    picture = np.where((HOLE | beside)[..., None], np.float32(0), np.float32([0.25, 0.5, 0.75]))
    found = expect(picture, HOLE, ~HOLE & ~beside)
    np.testing.assert_allclose(found.colours[HOLE], np.broadcast_to([0.25, 0.5, 0.75], (HOLE.sum(), 3)), atol=1e-3)
    assert found.variance.max() < 1e-6


def test_a_large_hole_is_looked_at_from_afar_and_a_speck_in_a_sliver_of_a_picture_too() -> None:
    large = np.hypot(*(np.indices((700, 500)) - 250)) < 200
    picture = grey(np.where(np.indices((700, 500))[0] < 250, 0.2, 0.8))
    found = expect(picture, large, ~large)
    assert found.colours.shape == (700, 500, 3) and found.variance.shape == (700, 500)
    assert found.colours[120, 250, 0] < 0.35 and found.colours[380, 250, 0] > 0.65
    thin = np.zeros((2, 40), bool)
    thin[1, 20] = True
    assert np.isfinite(expect(grey(np.full((2, 40), 0.4)), thin, ~thin).colours).all()


def test_what_is_known_may_begin_far_from_the_hole_or_nowhere() -> None:
    far = np.hypot(Y - 27, X - 29) > 25
    found = expect(np.where(far[..., None], np.float32(0.4), np.float32(0)).repeat(3, -1), HOLE, far)
    np.testing.assert_allclose(found.colours[HOLE], 0.4, atol=1e-3)
    nothing = expect(np.zeros((SIDE, SIDE, 3), np.float32), HOLE, np.zeros_like(HOLE))
    assert np.isfinite(nothing.colours).all() and (nothing.variance[HOLE] == kriging.NO_GUESS).all()


def test_it_can_be_had_at_another_size() -> None:
    found = expect(grey(X / SIDE), HOLE, ~HOLE).sized((28, 28), 3)
    assert found.colours.shape == (28, 28, 3) and found.variance.shape == (28, 28)
    assert found.colours[14, 20, 0] == pytest.approx(41 / SIDE, abs=0.01)


def waves(period: float) -> np.ndarray:
    """[96, 96, 3] stripes of amplitude 50 about 100."""
    x = np.arange(96) * 2 * np.pi / period
    return np.broadcast_to((100 + 50 * np.sin(x))[None, :, None], (96, 96, 3)).astype(np.float32)


def disc(radius: float) -> np.ndarray:
    y, x = np.mgrid[:96, :96]
    return (x - 48) ** 2 + (y - 48) ** 2 <= radius**2


def test_the_variogram_of_noise_is_its_variance() -> None:
    noise = np.random.default_rng(0).normal(0, 10, (96, 96, 3)).astype(np.float32)
    lags = variogram(noise, np.ones((96, 96), bool), 16)
    assert lags[0][0] == lags[1][0] == 0
    np.testing.assert_allclose(lags[1][1:], 100, rtol=0.05)
    assert np.interp(0.5, *lags) == pytest.approx(50, rel=0.05)


def test_it_rises_with_the_lag_and_looks_at_known_pixels_only() -> None:
    picture, known = waves(64), ~disc(20)
    spoiled = np.where(known[..., None], picture, 1e6)
    _, values = variogram(spoiled, known, 16)
    assert values == sorted(values) and values[-1] < 2500
    assert variogram(picture, np.zeros((96, 96), bool), 16) == ([0.0], [0.0])


def test_an_even_rim_leaves_no_doubt_and_its_colour_is_expected() -> None:
    picture = np.full((96, 96, 3), [10.0, 20, 30], np.float32)
    expected, variance, _ = foretell(np.where(disc(20)[..., None], 0, picture).astype(np.float32), ~disc(20))
    np.testing.assert_allclose(expected, picture, atol=0.1)
    assert (variance < 1e-3).all()


def test_doubt_grows_inwards_and_with_texture() -> None:
    known = ~disc(20)
    rough = foretell(waves(16), known)[1]
    smooth = foretell(waves(200), known)[1]
    assert (rough[known] == 0).all() and rough[48, 48] > 500 > 5 * smooth[48, 30]
    assert smooth[48, 48] > smooth[48, 30] > 0


def test_colours_are_carried_from_where_they_are_known() -> None:
    known = np.zeros((96, 96), bool)
    known[:, :8] = known[:, -8:] = True
    picture = np.zeros((96, 96, 3), np.float32)
    picture[:, -8:] = 100
    found = carried(picture, known)
    np.testing.assert_allclose(found[known], picture[known], atol=1e-3)
    middle = found[48, :, 0]
    assert middle[20] < 40 < 60 < middle[75] and 45 < middle[47:49].mean() < 55
