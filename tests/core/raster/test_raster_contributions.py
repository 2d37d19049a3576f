"""Footprints and contributions: which Gaussian made which pixel."""

from __future__ import annotations

import numpy as np
import pytest
from brute_force import draw
from hypothesis import given
from hypothesis import strategies as st
from property_tests import examples
from test_raster_render import CAMERA, one, random_scene

from gimp3d.raster import RasterSettings, contributions, footprint, render

EVERY_ALPHA = RasterSettings(alpha_min=1e-5, stop=1e-9)  # no threshold large enough to flip visibly


def test_contributions_match_the_reference() -> None:
    gaussians = random_scene(20)
    share, reference = contributions(gaussians, CAMERA, EVERY_ALPHA), draw(gaussians, CAMERA, EVERY_ALPHA)
    np.testing.assert_allclose(share.total, reference.weights.sum((1, 2)), rtol=1e-3, atol=2e-3)
    np.testing.assert_allclose(share.peak, reference.weights.max((1, 2)), atol=2e-5)


def test_contributions_are_counted_in_the_given_pixels_only() -> None:
    gaussians, reference = random_scene(21), draw(random_scene(21), CAMERA, EVERY_ALPHA)
    pixels = np.zeros((CAMERA.height, CAMERA.width), bool)
    pixels[3:9, 5:14] = True  # a part of one tile; the others have none
    share = contributions(gaussians, CAMERA, EVERY_ALPHA, pixels)
    inside = reference.weights[:, pixels]
    np.testing.assert_allclose(share.total, inside.sum(1), rtol=1e-3, atol=1e-3)
    np.testing.assert_allclose(share.peak, inside.max(1), atol=2e-5)


def test_contributions_agree_with_the_picture() -> None:
    gaussians = random_scene(22)
    total = contributions(gaussians, CAMERA).total
    np.testing.assert_allclose(total.sum(), render(gaussians, CAMERA).alpha.sum(), rtol=1e-5)


@pytest.mark.parametrize("seed", range(3))
def test_a_footprint_matches_the_reference(seed: int) -> None:
    gaussians = random_scene(30 + seed)
    chosen = np.random.default_rng(seed).random(len(gaussians)) < 0.3
    expected = draw(gaussians, CAMERA, EVERY_ALPHA).weights[chosen].sum(0)
    np.testing.assert_allclose(footprint(gaussians, CAMERA, chosen, EVERY_ALPHA), expected, atol=1e-4)


@examples(15)
@given(st.integers(0, 10**6), st.integers(1, 5))
def test_the_footprints_of_a_partition_sum_to_alpha(seed: int, parts: int) -> None:
    gaussians = random_scene(seed, 40, 0)
    part = np.random.default_rng(seed).integers(0, parts, len(gaussians))
    total = sum(footprint(gaussians, CAMERA, part == k) for k in range(parts))
    np.testing.assert_allclose(total, render(gaussians, CAMERA).alpha, atol=1e-5)


def test_a_hidden_gaussian_has_a_small_footprint() -> None:
    wall, behind = one((0, 0, 1), scale=(2.0, 2.0, 1e-3), logit=20.0), one((0, 0, 3))
    both = wall.extended(behind)
    last = np.array([False, True])
    assert footprint(both, CAMERA, last).max() == pytest.approx(
        0.01 * footprint(behind, CAMERA, last[1:]).max(), rel=0.01
    )


def test_the_background_is_not_part_of_a_footprint() -> None:
    white = RasterSettings(background=(1.0, 1.0, 1.0))
    assert footprint(one(), CAMERA, np.array([True]), white)[0, 0] == 0


def test_wrong_shapes_are_named() -> None:
    with pytest.raises(ValueError, match=r"chosen: expected shape \(1,\), got \(2,\)"):
        footprint(one(), CAMERA, np.ones(2, bool))
    with pytest.raises(ValueError, match=r"pixels: expected shape \(29, 41\), got \(2, 2\)"):
        contributions(one(), CAMERA, pixels=np.ones((2, 2), bool))
