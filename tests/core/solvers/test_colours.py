"""Learning how colours change."""

from __future__ import annotations

import numpy as np
import pytest

from gimp3d.solvers.colours import NO_CHANGE, learn_change

GAIN = np.array([[-0.3, 0.02, 0.0], [0.0, -0.2, 0.05], [0.01, 0.0, 0.1]])


def pairs(noise: float, seed: int = 0, count: int = 2000) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Colours, their linear change with a place's offset and noise, places, weights."""
    rng = np.random.default_rng(seed)
    colours = rng.uniform(20, 230, (count, 3))
    places = rng.integers(0, 8, count)
    offsets = rng.normal(0, 15, (8, 3))[places]
    return colours, (colours - 120) @ GAIN + offsets + rng.normal(0, noise, (count, 3)), places, np.ones(count)


def test_a_linear_change_is_found_whatever_the_places_add() -> None:
    colours, change, places, weights = pairs(noise=0.0)
    learned = learn_change(colours, change, places, weights, ridge=0.0)
    assert learned.trust > 0.999
    np.testing.assert_allclose(learned.matrix, GAIN, atol=1e-9)
    difference = learned.of(colours[:1] + 50) - learned.of(colours[:1])
    np.testing.assert_allclose(difference, learned.trust * np.full((1, 3), 50) @ GAIN, atol=1e-9)


def test_the_mean_colour_does_not_change() -> None:
    learned = learn_change(*pairs(noise=2.0))
    np.testing.assert_allclose(learned.of(learned.centre), 0.0, atol=1e-12)


@pytest.mark.parametrize("seed", range(5))
def test_change_that_colour_does_not_explain_is_not_trusted(seed: int) -> None:
    rng = np.random.default_rng(seed)
    colours, places = rng.uniform(20, 230, (2000, 3)), rng.integers(0, 8, 2000)
    learned = learn_change(colours, rng.normal(0, 10, (2000, 3)), places, np.ones(2000))
    assert np.abs(learned.of(colours)).max() < 1.0


def test_places_that_disagree_take_the_trust_away() -> None:
    colours, _, places, weights = pairs(noise=0.0)
    signs = np.where(places % 2 == 0, 1, -1)[:, None]
    assert learn_change(colours, signs * ((colours - 120) @ GAIN), places, weights).trust < 0.2


def test_a_tenth_of_wrong_pairs_does_no_harm() -> None:
    colours, change, places, weights = pairs(noise=1.0)
    change[::10] = np.random.default_rng(1).uniform(-200, 200, change[::10].shape)
    learned = learn_change(colours, change, places, weights)
    assert learned.trust > 0.9
    np.testing.assert_allclose(learned.matrix, GAIN, atol=0.02)


def test_an_exposure_is_found_in_full() -> None:
    colours, _, places, weights = pairs(noise=0.0)
    change = -0.4 * colours + np.random.default_rng(2).normal(0, 2, colours.shape)
    learned = learn_change(colours, change, places, weights)
    np.testing.assert_allclose(learned.trust * learned.matrix, -0.4 * np.eye(3), atol=0.02)
    np.testing.assert_allclose(learned.offset, np.median(change, axis=0), rtol=0.1)


def test_pairs_without_weight_count_for_nothing() -> None:
    colours, change, places, weights = pairs(noise=1.0)
    weights[:500], change[:500] = 0.0, 255.0
    with_them, without = (
        learn_change(*x)
        for x in ((colours, change, places, weights), [a[500:] for a in (colours, change, places, weights)])
    )
    np.testing.assert_allclose(with_them.matrix, without.matrix, atol=1e-3)
    assert abs(with_them.trust - without.trust) < 1e-3


@pytest.mark.parametrize("count", [0, 1, 39])
def test_few_pairs_teach_nothing(count: int) -> None:
    assert learn_change(*(x[:count] for x in pairs(noise=0.0))) is NO_CHANGE


def test_a_highlight_is_no_exposure() -> None:
    """All colours became lighter by the same: that may end where the pairs do."""
    colours, _, places, weights = pairs(noise=0.0)
    change = 40 + np.random.default_rng(3).normal(0, 2, colours.shape)
    np.testing.assert_allclose(learn_change(colours, change, places, weights).offset, 0.0, atol=1.0)


def test_colours_that_do_not_vary_teach_nothing_of_others() -> None:
    colours = np.full((500, 3), 90.0)
    places = np.arange(500) % 8
    learned = learn_change(colours, np.full((500, 3), -12.0), places, np.ones(500))
    np.testing.assert_allclose(learned.of(np.array([10.0, 90.0, 200.0])), 0.0, atol=1e-9)
    np.testing.assert_allclose(learned.offset, 0.0, atol=1e-9)
