"""Given pictures: those of the view agree however poorly it is drawn, others do not, and levels come from the ring."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from gimp3d.priors.likeness import likeness, ring_gain, shift_between

H, W = 180, 240
Y, X = np.mgrid[:H, :W]
HOLE = np.hypot(Y - 95, X - 125) < 30
KNOWN = cv2.dilate(HOLE.astype(np.uint8), np.ones((9, 9), np.uint8)) == 0


def scenery(seed: int = 0) -> np.ndarray:
    """Things of several sizes before a sky that is brighter than the ground, [H, W, 3] uint8."""
    random = np.random.default_rng(seed)
    layers = [cv2.GaussianBlur(random.normal(size=(H, W, 3)), (0, 0), s) * s for s in (1.5, 4, 12)]
    return np.clip(120 + 60 * np.tanh((60 - Y[..., None]) / 20) + 60 * sum(layers), 10, 245).astype(np.uint8)


def drawn_badly(picture: np.ndarray) -> np.ndarray:
    """As splats of few views show it: blurred, with haze in patches."""
    haze = cv2.GaussianBlur(np.random.default_rng(7).normal(size=picture.shape), (0, 0), 12) * 500
    return np.clip(0.5 * cv2.GaussianBlur(picture, (0, 0), 3) + 80 + haze, 0, 255).astype(np.uint8)


def altered(picture: np.ndarray, what: str) -> np.ndarray:
    h, w = picture.shape[:2]
    if what == "re-lit":
        return np.clip(picture * [1.5, 1.3, 1.1], 0, 255).astype(np.uint8)
    if what == "noisy":
        noise = np.random.default_rng(3).normal(0, 15, picture.shape)
        return np.clip(picture + noise, 0, 255).astype(np.uint8)
    if what == "shifted":
        return cv2.warpAffine(picture, np.float32([[1, 0, 3], [0, 1, -2]]), (w, h), borderMode=cv2.BORDER_REFLECT)
    if what == "smaller":
        half = cv2.resize(picture, (w // 2, h // 2), interpolation=cv2.INTER_AREA)
        return cv2.resize(half, (w, h), interpolation=cv2.INTER_CUBIC)
    return picture


@pytest.mark.parametrize("what", ["as it is", "re-lit", "noisy", "shifted", "smaller"])
def test_the_view_itself_agrees_however_poorly_it_is_drawn(what: str) -> None:
    for view, least in ((scenery(), 0.8), (drawn_badly(scenery()), 0.45)):
        like = likeness(np.where(HOLE[..., None], 0, view).astype(np.uint8), altered(scenery(), what), KNOWN)
        assert like.agreement > least and like.agreement > 10 * like.chance


@pytest.mark.parametrize("view", [scenery(), drawn_badly(scenery())])
def test_other_pictures_agree_no_better_than_chance(view: np.ndarray) -> None:
    """Though their sky and ground lie where the view's do, by which blurred luminances correlate."""
    others = [scenery(5), scenery()[:, ::-1], np.roll(scenery(), 40, axis=1)]
    for other in others:
        like = likeness(view, np.ascontiguousarray(other), KNOWN)
        assert like.agreement < 0.25 and like.agreement < 6 * like.chance
    a, b = (cv2.GaussianBlur(cv2.cvtColor(p, cv2.COLOR_RGB2GRAY), (0, 0), 2)[KNOWN] for p in (view, others[0]))
    assert np.corrcoef(a, b)[0, 1] > 0.3


def test_chance_is_what_other_places_reach() -> None:
    """A pattern that repeats itself fits elsewhere nearly as well."""
    checks = np.repeat(np.where((X // 9 + Y // 9) % 2, 200, 60)[..., None], 3, 2).astype(np.uint8)
    assert likeness(checks, checks, KNOWN).chance > 4 * likeness(scenery(), scenery(), KNOWN).chance


@pytest.mark.parametrize("size", [(1, 1), (1, 9), (9, 1), (6, 8), (40, 30)])
def test_pictures_of_any_size_and_without_texture_are_compared(size: tuple[int, int]) -> None:
    grey = np.full((*size, 3), 90, np.uint8)
    like = likeness(grey, grey, np.ones(size, bool))
    assert abs(like.agreement) < 1e-6 and like.chance < 1e-6
    assert (ring_gain(grey, grey, np.zeros(size, bool), np.ones(size, bool)) == 1).all()


# Levels


@pytest.mark.parametrize("gain", [(1.3, 1.3, 1.3), (0.7, 0.7, 0.7), (1.1, 1.0, 0.9)])
def test_exposure_and_white_balance_are_measured_on_the_ring(gain: tuple[float, ...]) -> None:
    picture, rng = scenery(), np.random.default_rng(1)
    lit = 0.6 * picture * np.array(gain) + rng.normal(0, 8, picture.shape)
    far = np.hypot(Y - 95, X - 125) > 65
    view = np.clip(np.where(far[..., None], picture, lit), 0, 255).astype(np.uint8)  # elsewhere in another light
    found = ring_gain(view, (0.6 * picture).astype(np.uint8), HOLE, KNOWN)
    np.testing.assert_allclose(found, gain, rtol=0.02)


def test_a_shadow_on_a_part_of_the_ring_is_no_exposure() -> None:
    view = scenery()
    shadow = (X > 125) & (Y > 80)
    view = np.where(shadow[..., None], 0.6 * view, view).astype(np.uint8)
    assert (ring_gain(view, scenery(), HOLE, KNOWN) == 1).all()


def test_a_picture_at_the_views_levels_keeps_them_bit_for_bit() -> None:
    for seed in range(5):
        noise = np.random.default_rng(seed).normal(0, 12, scenery().shape)
        noisy = np.rint(np.clip(cv2.GaussianBlur(scenery(seed), (0, 0), 1) + noise, 0, 255)).astype(np.uint8)
        assert (ring_gain(noisy, scenery(seed), HOLE, KNOWN) == 1).all()


def test_a_shift_is_found_in_a_poor_drawing() -> None:
    found = shift_between(drawn_badly(scenery()), altered(scenery(), "shifted"), KNOWN)
    np.testing.assert_allclose(found, (3, -2), atol=0.5)
