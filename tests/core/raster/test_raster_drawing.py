"""A view that is projected once and drawn in several ways, and parts of views."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from property_tests import examples
from test_raster_render import CAMERA, random_scene

from gimp3d.raster import (
    contributions,
    drawing,
    footprint,
    label_weights,
    render,
    surface_depth,
    touched_window,
)

WIDE = replace(CAMERA, width=150, height=101, cx=70.0, cy=55.0)  # 5×4 tiles, those at the ends cut
RGB = frozenset({"rgb"})


def rectangle(rng: np.random.Generator) -> np.ndarray:
    """[H, W] bool of WIDE."""
    (top, bottom), (left, right) = (np.sort(rng.integers(0, n + 1, 2)) for n in (WIDE.height, WIDE.width))
    pixels = np.zeros((WIDE.height, WIDE.width), bool)
    pixels[top:bottom, left:right] = True
    return pixels


@examples(25)
@given(st.integers(0, 10**6), st.booleans())
def test_a_part_of_a_view_has_the_whole_views_pixels(seed: int, surfels: bool) -> None:
    rng = np.random.default_rng(seed)
    gaussians, pixels = random_scene(seed, 300, 1, surfels=surfels), rectangle(rng)
    chosen = rng.random(len(gaussians)) < 0.3
    part = drawing(gaussians, WIDE, with_colour=False, pixels=pixels)
    found = [*part.surface_depth(), part.footprint(chosen), render(gaussians, WIDE, passes=RGB, pixels=pixels).rgb]
    whole = [*surface_depth(gaussians, WIDE), footprint(gaussians, WIDE, chosen), render(gaussians, WIDE).rgb]
    for a, b in zip(found, whole):
        np.testing.assert_array_equal(a[pixels], b[pixels])


@examples(15)
@given(st.integers(0, 10**6), st.booleans())
def test_what_is_gone_might_never_have_been_there(seed: int, surfels: bool) -> None:
    gaussians = random_scene(seed, 200, 0, surfels=surfels)
    gone = np.random.default_rng(seed).random(len(gaussians)) < 0.4
    found = drawing(gaussians, WIDE).surface_depth(gone)
    for a, b in zip(found, surface_depth(gaussians.take(~gone), WIDE)):
        np.testing.assert_array_equal(a, b)


def test_up_to_three_footprints_at_once() -> None:
    gaussians = random_scene(5, 200, 0)
    sets = np.random.default_rng(5).random((3, len(gaussians))) < 0.4
    for some in (sets, sets[:2], sets[:1]):
        for found, chosen in zip(drawing(gaussians, WIDE, with_colour=False).footprints(*some), some, strict=True):
            np.testing.assert_array_equal(found, footprint(gaussians, WIDE, chosen))
    with pytest.raises(ValueError, match="expected shape"):
        drawing(gaussians, WIDE, with_colour=False).footprints(sets[0], sets[1, :-1])
    for count in (0, 4):
        with pytest.raises(ValueError, match="one to three"):
            drawing(gaussians, WIDE, with_colour=False).footprints(*[sets[0]] * count)


def test_one_way_of_drawing_does_not_disturb_the_others() -> None:
    gaussians, pixels = random_scene(3, 200, 2), np.zeros((WIDE.height, WIDE.width), bool)
    pixels[20:50, 30:90] = True
    scene = drawing(gaussians, WIDE)
    depth, alpha = scene.surface_depth()
    part = scene.render(RGB, pixels).rgb
    np.testing.assert_array_equal(part[pixels], render(gaussians, WIDE).rgb[pixels])
    assert not part[:16].any()
    np.testing.assert_array_equal(scene.render(RGB).rgb, render(gaussians, WIDE).rgb)
    again = scene.surface_depth()
    np.testing.assert_array_equal(depth, again[0]), np.testing.assert_array_equal(alpha, again[1])


def test_colours_and_footprints_need_drawings_of_their_own() -> None:
    gaussians = random_scene(4, 20, 0)
    with pytest.raises(ValueError, match="no colours"):
        drawing(gaussians, WIDE, with_colour=False).render(RGB)
    with pytest.raises(ValueError, match="has colours"):
        drawing(gaussians, WIDE).footprint(np.ones(20, bool))


@examples(15)
@given(st.integers(0, 10**6), st.booleans())
def test_weights_by_label_are_those_of_each_labels_pixels(seed: int, surfels: bool) -> None:
    rng = np.random.default_rng(seed)
    gaussians, rows = random_scene(seed, 200, 0, surfels=surfels), rng.random(200) < 0.1
    labels = (rectangle(rng) * np.uint8(2)).astype(np.uint8)
    labels[rectangle(rng)] = 1
    labels[rectangle(rng)] = 200  # beyond the count: nothing
    found, of_rows = label_weights(gaussians, WIDE, labels, 2), label_weights(gaussians, WIDE, labels, 2, rows)
    for k in (1, 2):
        np.testing.assert_array_equal(found[k - 1], contributions(gaussians, WIDE, pixels=labels == k).total)
    np.testing.assert_array_equal(of_rows[:, rows], found[:, rows])


@examples(25)
@given(st.integers(0, 10**6), st.booleans(), st.floats(-6, 1))
def test_nothing_is_drawn_outside_the_touched_window(seed: int, surfels: bool, log_scale: float) -> None:
    gaussians = random_scene(seed, 5, 0, surfels=surfels)
    gaussians = replace(gaussians, log_scales=gaussians.log_scales + np.float32(log_scale))
    weight = footprint(gaussians, WIDE, np.ones(5, bool))
    weight[touched_window(gaussians, WIDE)] = 0
    assert not weight.any()
