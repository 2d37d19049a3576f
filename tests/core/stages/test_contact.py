"""The dark rim where an object touches a surface is found, and told from textures that are dark by chance."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import cv2
import numpy as np
import pytest
from lit_scenes import LitScene, grain, make_scene, plain
from scenes import BLOCK

from gimp3d.box import Box
from gimp3d.camera import Camera
from gimp3d.pipeline import PRESETS, View, remove_object, render_bytes
from gimp3d.srgb import encoded, linear
from gimp3d.stages.charts import Chart, Plane
from gimp3d.stages.contact import find_contact
from gimp3d.stages.shadow import Shadow

SIDE, HOLE = 240, 100  # texels of the chart, and of the hole in its middle
REGION = (Box.make([0, 0, 0.25], [0.5] * 3),)
Painted = Callable[[np.ndarray, np.ndarray], np.ndarray]  # x, y [H, W] in texels → linear colour [H, W, 3]


def chart_of(paint: Painted, taken: Callable[[np.ndarray], np.ndarray] = np.zeros_like) -> Chart:
    """A chart with a square hole; `taken` is the share of light that is missing at a distance from it, in texels."""
    y, x = np.indices((SIDE, SIDE)).astype(float)
    hole = np.maximum(np.abs(x - SIDE / 2), np.abs(y - SIDE / 2)) < HOLE / 2
    light = 1 - taken(cv2.distanceTransform((~hole).astype(np.uint8), cv2.DIST_L2, 5).astype(float))
    image = np.rint(255 * encoded(np.clip(paint(x, y) * light[..., None], 0, 1))).astype(np.uint8)
    camera = Camera("chart:1", SIDE, SIDE, 500.0, 500.0, SIDE / 2, SIDE / 2, np.eye(4))
    plane = Plane.make(np.zeros(3), np.array([0.0, 0, 1]), REGION)
    no, photos = np.zeros_like(hole), np.where(hole, 0, 9).astype(np.uint16)
    depth, there = np.full(hole.shape, 5, np.float32), np.ones_like(hole)
    return Chart(
        plane, camera, depth, "plane", 1.0, 0.0, (), "",
        there, np.where(hole[..., None], np.uint8(0), image), ~hole, hole, photos, no, no, 0.0, 0.01,
    )  # fmt: skip


def even(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return np.broadcast_to([0.5, 0.3, 0.22], (*x.shape, 3))


def noise(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Speckles of 3 texels, of a fifth of the light."""
    spots = cv2.GaussianBlur(np.random.default_rng(0).normal(size=x.shape), (0, 0), 1.5)
    return even(x, y) * np.exp(0.2 * spots / spots.std())[..., None]


def boards(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Two materials whose border runs into the hole, and dark joints that do."""
    dark = np.where((x + y) % 60 < 4, 0.3, 1.0)[..., None]
    return np.where((x > SIDE / 2)[..., None], [0.5, 0.3, 0.22], [0.2, 0.26, 0.34]) * dark


def waves(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return even(x, y) * (1 + 0.5 * np.sin(x / 11) * np.sin(y / 17))[..., None]


def rug(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Dark as far as 40 texels round the hole."""
    near = np.maximum(np.abs(x - SIDE / 2), np.abs(y - SIDE / 2)) < HOLE / 2 + 40
    return np.where(near[..., None], 0.4, 1.0) * even(x, y)


def foot(distance: np.ndarray) -> np.ndarray:
    """Half of the light is missing at the hole, a third of that 4 texels away, nothing 10 away."""
    return 0.5 * np.exp(-((distance / 4) ** 2))


@pytest.mark.parametrize("paint", [even, noise, boards])
def test_a_dark_rim_is_found_and_as_dark_as_it_is(paint: Painted) -> None:
    found = find_contact([chart_of(paint, foot)])
    assert isinstance(found, Shadow), found
    ground, (taken,) = found.grounds[0], found.taken
    far = cv2.distanceTransform((~ground.hole).astype(np.uint8), cv2.DIST_L2, 5)
    for near, beyond in ((1, 2), (2, 4)):
        ring = (far > near) & (far <= beyond) & ~ground.hole
        assert abs(np.median(taken[ring]) - np.median(foot(far[ring]))) < 0.1, (near, np.median(taken[ring]))
    assert taken[far > 12].max() < 0.02


@pytest.mark.parametrize("paint", [even, noise, boards, waves, rug])
def test_what_is_dark_by_chance_is_no_rim(paint: Painted) -> None:
    assert "no dark rim" in str(find_contact([chart_of(paint)]))


def test_a_bright_rim_is_none() -> None:
    assert isinstance(find_contact([chart_of(noise, lambda far: -foot(far))]), str)


def test_a_dimmer_picture_shows_the_same_rim() -> None:
    taken = []
    for dim in (1.0, 0.4):
        found = find_contact([chart_of(lambda x, y, dim=dim: dim * noise(x, y), foot)])  # type: ignore[misc]
        assert isinstance(found, Shadow)
        taken.append(found.taken[0])
    assert np.abs(taken[0] - taken[1]).mean() < 0.01


def test_without_a_surface_round_the_hole_there_is_none() -> None:
    assert isinstance(find_contact([]), str)


@cache
def standing(paint: Callable[[np.ndarray], np.ndarray]) -> LitScene:
    """A block on a floor that is dark within a few texels of its foot, as in no lamp's shadow."""

    def dark_at_the_foot(points: np.ndarray) -> np.ndarray:
        beside = np.maximum(np.abs(points[:, :2]) - BLOCK / 2, 0)
        light = 1 - 0.6 * np.exp(-((np.hypot(*beside.T) / 0.05) ** 2))
        return encoded(linear_of(paint(points)) * light[:, None])

    return make_scene("foot", [], dark_at_the_foot, casts=False)


def linear_of(colours: np.ndarray) -> np.ndarray:
    return linear(np.rint(255 * np.clip(colours, 0, 1)).astype(np.uint8))


@pytest.mark.parametrize("paint", [grain, plain])
def test_the_rim_goes_with_the_object(paint: Callable[[np.ndarray], np.ndarray]) -> None:
    scene, truth = standing(paint), make_scene("bare", [], paint, casts=False).truth
    views = [View(c, render_bytes(scene.gaussians, c)) for c in scene.cameras(24, 480, 360)]
    result = remove_object(scene.gaussians, views, scene.region, PRESETS["draft"])
    assert result.shadow["found"] and "dark rim" in result.shadow["reason"], result.shadow["reason"]
    final = scene.gaussians.take(result.keep)
    final = final if result.added is None else final.extended(result.added)
    left, before = [], []
    for view in views[::4]:
        true, shown = (np.log(linear(render_bytes(g, view.camera)).mean(-1) + 4e-3) for g in (truth, final))
        photo = np.log(linear(view.image).mean(-1) + 4e-3)
        block = view.image[..., 0].astype(int) - view.image[..., 1] > 70
        rim = (photo - true < -0.15) & (cv2.dilate(block.astype(np.uint8), np.ones((7, 7), np.uint8)) == 0)
        before.append((photo - true)[rim])
        left.append((shown - true)[rim])
    was, now = (float(np.concatenate(x).mean()) for x in (before, left))
    assert was < -0.1 and abs(now) < 0.4 * abs(was), (was, now)
