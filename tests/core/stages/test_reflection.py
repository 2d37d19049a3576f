"""What the object's mirror image adds to photos is found by how they differ, and taken out of them and the scene."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from lit_scenes import Lamp, LitScene, cube, glossy_scene, grain, make_scene, reflected
from scenes import BLOCK, REGION

from gimp3d.box import Box
from gimp3d.evaluate import psnr
from gimp3d.pipeline import PRESETS, RemovalResult, View, remove_object, render_bytes
from gimp3d.raster import render
from gimp3d.stages import reflection
from gimp3d.stages.charts import Plane
from gimp3d.stages.reflection import mirror_image


@cache
def glossy(strength: float, lit: bool = False) -> LitScene:
    return glossy_scene(strength, [Lamp(40, 110, 3)] if lit else [])


@cache
def views(scene: LitScene) -> tuple[View, ...]:
    return tuple(View(c, render_bytes(scene.gaussians, c)) for c in scene.cameras())


@cache
def removed(scene: LitScene, shadow: str = "auto") -> RemovalResult:
    return remove_object(scene.gaussians, views(scene), scene.region, replace(PRESETS["draft"], shadow=shadow))


def error(scene: LitScene, result: RemovalResult) -> float:
    """Mean PSNR, dB, where photos differ from the truth but do not show the object: reflection and shadow."""
    final = scene.gaussians.take(result.keep)
    final = final if result.added is None else final.extended(result.added)
    scores = []
    for view in views(scene)[::3]:
        drawn, truth = (render_bytes(g, view.camera) for g in (final, scene.truth))
        scores.append(psnr(drawn, truth, reflected(scene, view.camera)))
    return float(np.mean(scores))


def test_a_mirror_image_is_what_stands_below_the_plane() -> None:
    above = cube(Box.make([0.1, 0.2, 0.4], [BLOCK] * 3), (0.8, 0.3, 0.1))
    below = replace(above, means=above.means * np.float32([1, 1, -1]))
    plane = Plane.make(np.zeros(3), np.array([0.0, 0.0, 1.0]), REGION)
    for camera in make_scene("bare", []).cameras()[:6]:
        alpha, light = mirror_image(above, plane, camera)
        drawn = render(below, camera, passes=frozenset({"rgb"}))
        np.testing.assert_allclose(alpha, drawn.alpha, atol=2e-3)
        assert alpha.max() > 0.9 and light.shape == (*alpha.shape, 3)


@pytest.mark.parametrize(("strength", "gain"), [(0.1, 0.3), (0.4, 6.0)])
def test_reflections_go_with_the_object(strength: float, gain: float) -> None:
    scene = glossy(strength)
    result = removed(scene)
    assert result.reflection["found"] and result.reflection["explained"] > 0.5, result.reflection["reason"]
    assert not result.shadow["found"]
    assert error(scene, result) > error(scene, removed(scene, "off")) + gain


def test_reflection_and_shadow_go_together() -> None:
    scene = glossy(0.3, lit=True)
    result = removed(scene)
    assert result.reflection["found"] and result.shadow["found"]
    towards = np.array(result.shadow["lights"][0]["direction"])
    assert np.degrees(np.arccos(towards @ scene.lamps[0].direction)) < 10
    assert error(scene, result) > error(scene, removed(scene, "off")) + 5


@pytest.mark.parametrize("lit", [False, True])
def test_a_dull_floor_mirrors_nothing(lit: bool) -> None:
    result = removed(make_scene("dull", [Lamp(40, 110, 3)] if lit else [], grain))
    assert not result.reflection["found"] and "no reflection found" in result.reflection["reason"]


def test_what_else_differs_between_views_is_no_reflection() -> None:
    """Photos of other exposures, and noise."""
    scene = make_scene("dull", [])
    rng = np.random.default_rng(3)
    uneven = []
    for view in views(scene):
        level = rng.uniform(0.8, 1.1)
        image = np.clip(view.image * level + rng.normal(0, 6, view.image.shape), 0, 255).astype(np.uint8)
        uneven.append(replace(view, image=image))
    result = remove_object(scene.gaussians, uneven, scene.region, PRESETS["draft"])
    assert not result.reflection["found"]


@pytest.mark.parametrize(("image", "sheen"), [(0.0, 0.1), (0.0, -0.1), (0.2, 0.1), (0.2, 0.0)])
def test_a_sheen_on_every_viewer_s_side_is_no_image(image: float, sheen: float) -> None:
    """On a plinth's top the image of what stands there lies on the viewer's side, and so does what is seen steeper."""
    x, y = (g.ravel() for g in np.meshgrid(*[np.linspace(-1, 1, 41)] * 2))
    places = np.stack([x, y], 1)[np.hypot(x, y) < 1]
    angles = np.radians(np.arange(0, 360, 20))[:, None]
    near, across = (np.cos(a) * places[:, 0] + np.sin(a) * places[:, 1] for a in (angles, angles + np.pi / 2))
    alpha = ((near > 0.2) & (np.abs(across) < 0.4)).astype(float)
    light = 0.8 * alpha[..., None] * np.ones(3)
    noise = np.random.default_rng(1).normal(0, 0.002, (*alpha.shape, 3))
    photo = 0.4 + sheen * near[..., None] + image * light + noise
    strength, _, share = reflection._fitted(np.ones(alpha.shape, bool), places, photo, alpha, light)
    if image:
        assert share > 0.8 and strength[0].mean() == pytest.approx(image, rel=0.1)
    else:
        assert share < 0.3


def test_left_alone_nothing_changes() -> None:
    scene = glossy(0.4)
    result = removed(scene, "off")
    assert result.lifted == 0 and result.reflection["reason"] == "not looked for"
