"""What a rim lets expect of what it encloses."""

from __future__ import annotations

import numpy as np
import pytest

from gimp3d.solvers.variogram import at_lag, carried, foretell, variogram


def waves(period: float) -> np.ndarray:
    """[96, 96, 3] stripes of amplitude 50 about 100."""
    x = np.arange(96) * 2 * np.pi / period
    return np.broadcast_to((100 + 50 * np.sin(x))[None, :, None], (96, 96, 3)).astype(np.float32)


def hole(radius: float) -> np.ndarray:
    y, x = np.mgrid[:96, :96]
    return (x - 48) ** 2 + (y - 48) ** 2 <= radius**2


def test_the_variogram_of_noise_is_its_variance() -> None:
    noise = np.random.default_rng(0).normal(0, 10, (96, 96, 3)).astype(np.float32)
    lags = variogram(noise, np.ones((96, 96), bool), 16)
    assert lags[0] == (0, 0)
    np.testing.assert_allclose([value for _, value in lags[1:]], 100, rtol=0.05)
    assert at_lag(lags, np.array([0.5]))[0] == pytest.approx(50, rel=0.05)


def test_it_rises_with_the_lag_and_looks_at_known_pixels_only() -> None:
    picture, known = waves(64), ~hole(20)
    spoiled = np.where(known[..., None], picture, 1e6)
    lags = variogram(spoiled, known, 16)
    values = [value for _, value in lags]
    assert values == sorted(values) and values[-1] < 2500
    assert variogram(picture, np.zeros((96, 96), bool), 16) == [(0.0, 0.0)]


def test_an_even_rim_leaves_no_doubt_and_its_colour_is_expected() -> None:
    picture = np.full((96, 96, 3), [10.0, 20, 30], np.float32)
    expected, variance, _ = foretell(np.where(hole(20)[..., None], 0, picture).astype(np.float32), ~hole(20))
    np.testing.assert_allclose(expected, picture, atol=0.1)
    assert (variance < 1e-3).all()


def test_doubt_grows_inwards_and_with_texture() -> None:
    known = ~hole(20)
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
