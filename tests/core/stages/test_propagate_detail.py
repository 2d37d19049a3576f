"""The fill is as sharp as the scene is drawn beside it."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from property_tests import examples

from gimp3d.stages.propagate.detail import ROUND, as_drawn

SIDE = 96
HOLE = np.zeros((SIDE, SIDE), bool)
HOLE[36:60, 36:60] = True
BESIDE = (cv2.dilate(HOLE.astype(np.uint8), np.ones((2 * ROUND + 1,) * 2)) > 0) & ~HOLE
ALL = np.ones_like(HOLE)


def grain(seed: int, channels: int = 3) -> np.ndarray:
    """[SIDE, SIDE, 3] uint8 of all frequencies."""
    rng = np.random.default_rng(seed)
    rough = sum(cv2.resize(rng.normal(0, 14, (n, n, channels)), (SIDE, SIDE)) for n in (SIDE, 48, 24, 12))
    return np.clip(128 + rough, 0, 255).astype(np.uint8)


def blurred(picture: np.ndarray, sigma: float) -> np.ndarray:
    return cv2.GaussianBlur(picture, (0, 0), sigma) if sigma else picture.copy()


def energy(picture: np.ndarray, sigma: float = 1.2) -> float:
    """Of detail in the hole, well inside."""
    values = picture.astype(np.float64)
    return float(((values - cv2.GaussianBlur(values, (0, 0), sigma))[42:54, 42:54] ** 2).mean())


@examples(20)
@given(seed=st.integers(0, 10_000), sigma=st.sampled_from([0.7, 1.0, 1.5, 2.5]))
def test_a_sharp_fill_is_made_as_blurred_as_the_scene(seed: int, sigma: float) -> None:
    photo, fill = grain(seed), grain(seed + 1).astype(np.float32)
    found = as_drawn(fill, ALL, photo, blurred(photo, sigma), BESIDE)
    wanted = blurred(fill, sigma)
    sharp, now, right = energy(fill), energy(found), energy(wanted)
    assert now < 0.7 * sharp and right / 3 < now < 3 * right + 1
    off = [np.abs(p - wanted)[HOLE].mean() for p in (fill, found)]
    assert off[1] < 0.5 * off[0]


@examples(20)
@given(seed=st.integers(0, 10_000))
def test_where_the_scene_is_drawn_as_sharp_as_photos_nothing_changes(seed: int) -> None:
    photo, fill = grain(seed), grain(seed + 1).astype(np.float32)
    np.testing.assert_allclose(as_drawn(fill, ALL, photo, photo, BESIDE), fill, atol=1e-2)
    assert as_drawn(fill, ALL, photo, blurred(photo, 2.0), np.zeros_like(BESIDE)) is fill  # nothing tells


def test_detail_that_photos_do_not_show_is_none_of_the_scenes() -> None:
    """Splats draw detail of their own: none of it is the photo's."""
    photo, fill = grain(1), grain(2).astype(np.float32)
    found = as_drawn(fill, ALL, photo, grain(3), BESIDE)
    assert energy(found) < 0.1 * energy(fill)
    assert np.abs(cv2.GaussianBlur(found - fill, (0, 0), 12)[HOLE]).max() < 3  # its light stays


@pytest.mark.parametrize("light", [-30, 30])
def test_the_scenes_light_is_no_detail(light: int) -> None:
    photo, fill = grain(4) // 2 + 64, grain(5).astype(np.float32)
    np.testing.assert_allclose(as_drawn(fill, ALL, photo, photo + np.uint8(light % 256), BESIDE), fill, atol=0.5)


def test_what_is_not_known_counts_nothing() -> None:
    photo, fill = grain(6), grain(7).astype(np.float32)
    known = HOLE | BESIDE
    holed = np.where(known[..., None], fill, np.nan).astype(np.float32)
    found = as_drawn(holed, known, photo, blurred(photo, 1.5), BESIDE)
    assert np.isfinite(found[known]).all() and np.isnan(found[~known]).all()
    spoiled = np.where(BESIDE[..., None], photo, np.uint8(255))
    again = as_drawn(holed, known, spoiled, blurred(photo, 1.5), BESIDE)
    np.testing.assert_array_equal(found, again)
