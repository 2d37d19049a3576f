"""Learning how colours change."""

from __future__ import annotations

import numpy as np
import pytest

from gimp3d.solvers.colours import NO_CHANGE, learn_change

GAIN = np.array([[-0.3, 0.02, 0.0], [0.0, -0.2, 0.05], [0.01, 0.0, 0.1]])


def pairs(noise: float, seed: int = 0, count: int = 2000) -> tuple[np.ndarray, np.ndarray]:
    """Colours, and their linear change with noise."""
    rng = np.random.default_rng(seed)
    colours = rng.uniform(20, 230, (count, 3))
    return colours, (colours - 120) @ GAIN + 15 + rng.normal(0, noise, (count, 3))


def test_a_linear_change_is_found_whatever_is_added() -> None:
    colours, change = pairs(noise=0.0)
    learned = learn_change(colours, change, ridge=0.0)
    np.testing.assert_allclose(learned.matrix, GAIN, atol=1e-9)
    difference = learned.of(colours[:1] + 50) - learned.of(colours[:1])
    np.testing.assert_allclose(difference, np.full((1, 3), 50) @ GAIN, atol=1e-9)


def test_the_mean_colour_does_not_change() -> None:
    learned = learn_change(*pairs(noise=2.0))
    np.testing.assert_allclose(learned.of(learned.centre), 0.0, atol=1e-12)


@pytest.mark.parametrize("seed", range(5))
def test_change_that_colour_does_not_explain_teaches_nothing(seed: int) -> None:
    rng = np.random.default_rng(seed)
    colours = rng.uniform(20, 230, (2000, 3))
    learned = learn_change(colours, rng.normal(0, 10, (2000, 3)))
    assert np.abs(learned.of(colours)).max() < 2.0


def test_a_tenth_of_wrong_pairs_does_no_harm() -> None:
    colours, change = pairs(noise=1.0)
    change[::10] = np.random.default_rng(1).uniform(-200, 200, change[::10].shape)
    np.testing.assert_allclose(learn_change(colours, change).matrix, GAIN, atol=0.02)


def test_an_exposure_is_found_in_full() -> None:
    colours, _ = pairs(noise=0.0)
    change = -0.4 * colours + np.random.default_rng(2).normal(0, 2, colours.shape)
    learned = learn_change(colours, change)
    np.testing.assert_allclose(learned.matrix, -0.4 * np.eye(3), atol=0.02)
    np.testing.assert_allclose(learned.offset, np.median(change, axis=0), rtol=0.1)


@pytest.mark.parametrize("count", [0, 1, 39])
def test_few_pairs_teach_nothing(count: int) -> None:
    assert learn_change(*(x[:count] for x in pairs(noise=0.0))) is NO_CHANGE


def test_a_highlight_is_no_exposure() -> None:
    """All colours became lighter by the same: that may end where the pairs do."""
    colours, _ = pairs(noise=0.0)
    change = 40 + np.random.default_rng(3).normal(0, 2, colours.shape)
    np.testing.assert_allclose(learn_change(colours, change).offset, 0.0, atol=1.0)


def test_colours_that_do_not_vary_teach_nothing_of_others() -> None:
    colours = np.full((500, 3), 90.0)
    learned = learn_change(colours, np.full((500, 3), -12.0))
    np.testing.assert_allclose(learned.of(np.array([10.0, 90.0, 200.0])), 0.0, atol=1e-9)
    np.testing.assert_allclose(learned.offset, 0.0, atol=1e-9)
