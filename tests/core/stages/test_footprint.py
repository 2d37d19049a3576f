"""A red object on a wooden floor, told apart by colour."""

from __future__ import annotations

import numpy as np
import pytest

from gimp3d.stages.charts import shows_object

RNG = np.random.default_rng(5)
WOOD, RED = np.array([170.0, 130, 90]), np.array([190.0, 40, 40])


def around(colour: np.ndarray, *shape: int) -> np.ndarray:
    return np.clip(colour + RNG.normal(0, 8, (*shape, 3)), 0, 255).astype(np.uint8)


@pytest.fixture(scope="module")
def scene() -> tuple[np.ndarray, np.ndarray]:
    """The picture, and where it is red."""
    red = np.zeros((60, 80), bool)
    red[20:40, 30:55] = True
    return np.where(red[..., None], around(RED, 60, 80), around(WOOD, 60, 80)), red


def test_a_mask_that_is_too_large_shrinks_to_the_object(scene: tuple[np.ndarray, np.ndarray]) -> None:
    picture, red = scene
    doubtful = np.zeros_like(red)
    doubtful[10:50, 20:70] = True
    np.testing.assert_array_equal(shows_object(picture, doubtful, doubtful, around(RED, 500), around(WOOD, 500)), red)


def test_a_rest_beside_the_mask_is_found_among_the_doubtful_only(scene: tuple[np.ndarray, np.ndarray]) -> None:
    picture, red = scene
    doubtful = np.zeros_like(red)
    doubtful[:, 35:] = True
    presumed = doubtful & red & (np.arange(80) < 45)
    found = shows_object(picture, doubtful, presumed, around(RED, 500), around(WOOD, 500))
    np.testing.assert_array_equal(found, red & doubtful)


def test_floor_alone_is_no_object(scene: tuple[np.ndarray, np.ndarray]) -> None:
    """Though nothing but the mask says that the object should be there."""
    _, red = scene
    assert not shows_object(around(WOOD, 60, 80), red, red, around(RED, 500), around(WOOD, 500)).any()


@pytest.mark.parametrize("missing", [0, 1])
def test_without_colours_to_compare_with_what_was_presumed_stays(
    scene: tuple[np.ndarray, np.ndarray], missing: int
) -> None:
    picture, red = scene
    doubtful = np.ones_like(red)
    colours = [around(RED, 500), around(WOOD, 500)]
    colours[missing] = np.zeros((0, 3), np.uint8)
    np.testing.assert_array_equal(shows_object(picture, doubtful, red, *colours), red)


def test_the_same_twice(scene: tuple[np.ndarray, np.ndarray]) -> None:
    picture, red = scene
    doubtful, colours = np.ones_like(red), (around(RED, 500), around(WOOD, 500))
    first, second = (shows_object(picture, doubtful, red, *colours) for _ in range(2))
    np.testing.assert_array_equal(first, second)


def test_a_mixed_edge_is_the_object_s(scene: tuple[np.ndarray, np.ndarray]) -> None:
    """Half red, half wood: neither of the two looks like it. A tenth of red is wood."""
    picture, red = scene
    share = np.where(red, 0.5, 0.1)[..., None]
    picture = np.clip(share * RED + (1 - share) * WOOD + RNG.normal(0, 4, picture.shape), 0, 255).astype(np.uint8)
    found = shows_object(picture, np.ones_like(red), red, around(RED, 500), around(WOOD, 500))
    assert found[red].mean() > 0.95 and found[~red].mean() < 0.02
