"""Shadows of known strength are found on textured surfaces, and what is no shadow is not."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gimp3d.solvers.lights import LitSurface, Shading

SIZE = 64
Y, X = np.indices((SIZE, SIZE))
LEVELS = (2, 4, 8)


def blot(x: float, y: float, radius: float) -> np.ndarray:
    return np.exp(-(((X - x) ** 2 + (Y - y) ** 2) / (2 * radius**2)))


def painted(darkness: np.ndarray, rng: np.random.Generator, noise: float = 0.03) -> LitSurface:
    """A grey surface with speckles, in shadow."""
    luminance = np.log(0.5) + noise * rng.standard_normal((SIZE, SIZE)) + np.log(1 - darkness)
    return LitSurface(np.ones((SIZE, SIZE), bool), np.repeat(luminance[..., None], 3, axis=2))


@given(st.integers(0, 2**31), st.floats(0.1, 0.8), st.floats(0.0, 0.6))
def test_strengths_of_shadows_are_those_that_were_cast(seed: int, first: float, second: float) -> None:
    shapes = np.stack([blot(20, 24, 6), blot(44, 40, 5)], -1)
    lit = Shading.make([painted(shapes @ [first, second], np.random.default_rng(seed))], LEVELS)
    strengths, besides = lit.fit(shapes.reshape(-1, 2))
    np.testing.assert_allclose(strengths, [first, second], atol=0.05)
    darkness = shapes.reshape(-1, 2) @ strengths
    assert lit.loss(lit.residual(darkness, besides)) < 2 * lit.usual_loss


def test_light_that_changes_evenly_is_no_shadow() -> None:
    rng = np.random.default_rng(1)
    surface = painted(np.zeros((SIZE, SIZE)), rng)
    slope = 0.4 * X / SIZE + 0.3 * (Y / SIZE) ** 2
    lit = Shading.make([LitSurface(surface.shown, surface.colours + slope[..., None])], LEVELS)
    strengths, _ = lit.fit(blot(32, 32, 8).reshape(-1, 1))
    assert strengths[0] < 0.03


def test_what_goes_with_hue_is_paint() -> None:
    """A red blot that is darker than its grey surroundings, as red paint often is on this surface: three more of it."""
    rng = np.random.default_rng(2)
    red = blot(32, 32, 5) + blot(12, 12, 5) + blot(52, 14, 5) + blot(14, 50, 5)
    surface = painted(np.zeros((SIZE, SIZE)), rng, 0.01)
    colours = surface.colours - 0.6 * red[..., None] * np.array([0.2, 1.2, 1.2])
    lit = Shading.make([LitSurface(surface.shown, colours)], LEVELS)
    shape = blot(32, 32, 5).reshape(-1, 1)
    grey = Shading.make([LitSurface(surface.shown, np.repeat(colours.mean(-1, keepdims=True), 3, axis=2))], LEVELS)
    assert lit.fit(shape)[0][0] < 0.5 * grey.fit(shape)[0][0]


def test_tints_are_told_channel_by_channel() -> None:
    rng = np.random.default_rng(3)
    shape, tint = blot(32, 32, 7), np.array([1.15, 1.0, 0.85])
    noise = 0.01 * rng.standard_normal((SIZE, SIZE, 1))
    colours = np.log(0.5) + noise + np.log(1 - 0.5 * shape[..., None] * tint)
    lit = Shading.make([LitSurface(np.ones((SIZE, SIZE), bool), colours)], LEVELS)
    strengths, _ = lit.fit(shape.reshape(-1, 1))
    np.testing.assert_allclose(strengths[0] * lit.tints(shape.reshape(-1, 1), strengths)[0], 0.5 * tint, atol=0.04)


def test_texels_that_are_not_known_say_nothing() -> None:
    rng = np.random.default_rng(4)
    surface = painted(0.5 * blot(32, 32, 6), rng)
    shown = surface.shown & ((X - 32) ** 2 + (Y - 32) ** 2 > 16)
    spoilt = np.where(shown[..., None], surface.colours, rng.standard_normal((SIZE, SIZE, 3)))
    lit = Shading.make([LitSurface(shown, spoilt)], LEVELS)
    assert lit.fit(blot(32, 32, 6)[shown][:, None])[0][0] == pytest.approx(0.5, abs=0.05)


def test_the_candidate_that_was_cast_gains_most() -> None:
    rng = np.random.default_rng(5)
    shapes = np.stack([blot(x, y, 5).ravel() for x in (16, 32, 48) for y in (16, 32, 48)], -1)
    lit = Shading.make([painted(0.4 * shapes[:, 5].reshape(SIZE, SIZE), rng)], LEVELS)
    _, besides = lit.fit(shapes[:, :0])
    residual = lit.residual(np.zeros(SIZE * SIZE), besides)
    assert lit.gains(lit.changes(shapes), residual).argmax() == 5
    assert lit.gains(lit.changes(shapes), -residual)[5] == 0.0  # brightness is no shadow


def test_what_was_cast_explains_what_is_uneven_and_a_longer_shadow_of_the_kind_less() -> None:
    rng = np.random.default_rng(6)
    long = np.maximum(blot(24, 30, 6), np.maximum(blot(38, 30, 6), blot(52, 30, 6)))
    shapes = np.stack([blot(24, 30, 6).ravel(), long.ravel(), blot(50, 52, 6).ravel()], -1)
    lit = Shading.make([painted(0.4 * shapes[:, 0].reshape(SIZE, SIZE), rng)], LEVELS)
    _, besides = lit.fit(shapes[:, :0])
    cast, longer, elsewhere = lit.shares(lit.changes(shapes), lit.residual(np.zeros(SIZE * SIZE), besides), 0.25)
    assert cast > 0.8 > longer > elsewhere


@given(st.integers(0, 2**31), st.integers(1, 60))
def test_hardly_known_surfaces_are_no_error(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    shown = np.zeros((SIZE, SIZE), bool)
    shown.flat[rng.choice(SIZE * SIZE, count, replace=False)] = True
    lit = Shading.make([LitSurface(shown, rng.normal(size=(SIZE, SIZE, 3)))], LEVELS)
    shape = blot(32, 32, 8)[shown][:, None]
    strengths, besides = lit.fit(shape)
    loss = lit.loss(lit.residual(shape @ strengths, besides))
    assert 0 <= strengths[0] <= 1 and np.isfinite(besides).all() and np.isfinite(loss)
