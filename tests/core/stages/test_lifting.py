"""Where light is given back: on what a photo can show."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import cv2
import numpy as np
import pytest
from lit_scenes import Lamp, make_scene

from gimp3d.camera import Camera
from gimp3d.gaussians import Gaussians
from gimp3d.presets import PRESETS
from gimp3d.raster import render_bytes
from gimp3d.run import ViewState
from gimp3d.stages import lifting
from gimp3d.stages.exposure import exposures_of
from gimp3d.stages.lifting import Arriving, _lifted, light_in, recoloured
from gimp3d.stages.masks import find_masks
from gimp3d.stages.shadow import Shadow
from gimp3d.stages.witness import Witness
from gimp3d.steps.behind import find_light, find_surfaces

LEVELS = np.zeros(256, int)  # of lit ground


@cache
def prepared() -> tuple[list[Witness], Shadow]:
    """A made scene's views as evidence, and the shadow that is found in them."""
    lit, settings = make_scene("waves", [Lamp(40, 110, 3)]), PRESETS["draft"]
    photos = {c.id: render_bytes(lit.gaussians, c) for c in lit.cameras()}
    masks = find_masks(lit.gaussians, lit.region, lit.cameras(), photos=photos)
    exposures = exposures_of(lit.gaussians.take(~masks.removed), masks.views, photos)
    views = [ViewState.first(v, photos[v.camera.id], e) for v, e in zip(masks.views, exposures)]
    surfaces = find_surfaces(lit.gaussians, lit.region, masks, views, settings)
    found = find_light(lit.region, surfaces, views, {}, settings)
    assert not isinstance(found.shadow, str)
    return surfaces.witnesses(views), found.shadow


def light(witness: Witness) -> np.ndarray:
    """[H, W] the mean share of light that arrives, 1 where nothing is told."""
    arriving = light_in(prepared()[1], witness)
    out = np.ones(witness.hidden.shape)
    out[arriving.window] = arriving.light.mean(-1)
    return out


def test_what_is_drawn_below_the_ground_is_lifted_nowhere() -> None:
    """Nothing can be seen there: rough splats err, and light does not arrive below the object."""
    shaded = strange = 0
    for witness in prepared()[0][::3]:
        far = cv2.dilate((witness.hidden | witness.beside).astype(np.uint8), np.ones((9, 9), np.uint8)) == 0
        below = replace(witness, depth=np.float32(1.5) * witness.depth, photo=255 - witness.photo)
        shaded += int((light(witness) < 0.9)[far].sum())
        strange += int((light(below) < 0.99)[far].sum())
    assert shaded > 1000 and strange < 0.2 * shaded


def test_dim_pixels_right_beside_the_object_are_filled_and_not_lifted() -> None:
    """They hold some of the object's own colours, which would be lifted with the ground's."""
    camera = Camera("0", 40, 30, 40.0, 40.0, 20.0, 15.0, np.eye(4))
    hidden, beside, no = np.zeros((3, 30, 40), bool)
    hidden[10:20, 10:20], beside[10:20, 20:22] = True, True
    photo = np.full((30, 40, 3), 60, np.uint8)
    witness = Witness(camera, photo, hidden, beside, no, np.ones((30, 40), np.float32))
    window = slice(0, 30), slice(0, 40)
    near = cv2.dilate((hidden | beside).astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    for light, filled in ((0.9, near & False), (0.6, near & ~hidden), (0.2, ~hidden)):
        arriving = Arriving(window, np.full((30, 40, 3), light, np.float32), ~hidden, LEVELS)
        photo, shaded, dark, _ = _lifted(witness, arriving, 255)
        np.testing.assert_array_equal(dark, filled)
        np.testing.assert_array_equal(shaded, ~hidden)
        assert (photo[shaded] > 60).all() and (photo[hidden] == 60).all()


def test_what_would_be_brighter_than_lit_ground_is_filled_and_not_lifted() -> None:
    """Light reaches the foot of an object in ways that its shadow's model does not know. What stands on ground may."""
    camera = Camera("0", 40, 30, 40.0, 40.0, 20.0, 15.0, np.eye(4))
    no, photo = np.zeros((30, 40), bool), np.full((30, 40, 3), 190, np.uint8)
    light = np.ones((30, 40, 3), np.float32)
    light[5:25, 5:35] = 0.5
    photo[5:25, 5:20] = 140  # what half the light leaves of it, about
    photo[5:25, 20:35] = 180  # nearly all of it arrives
    photo[15, 10] = 185  # grain
    ground = np.ones((30, 40), bool)
    ground[:10] = False
    window = slice(0, 30), slice(0, 40)
    witness = Witness(camera, photo, no, no, no, np.ones((30, 40), np.float32))
    lifted, shaded, filled, _ = _lifted(witness, Arriving(window, light, ground, LEVELS), 192)
    assert shaded.sum() == 600 and abs(int(lifted[20, 8, 0]) - 190) < 8
    expected = no.copy()
    expected[10:25, 20:35] = True
    np.testing.assert_array_equal(filled, expected)


def test_a_line_whose_lit_part_only_other_views_show_is_lifted(monkeypatch: pytest.MonkeyPatch) -> None:
    """A white line beside a van: where a view shows it in shade alone, lit ground seemed darker, and it was filled."""
    camera = Camera("0", 40, 30, 40.0, 40.0, 20.0, 15.0, np.eye(4))
    no, ones = np.zeros((30, 40), bool), np.ones((30, 40), np.float32)
    photo, light = np.full((30, 40, 3), 90, np.uint8), np.ones((30, 40, 3), np.float32)
    light[:, :20] = 0.9
    photo[:, :20] = 86  # what nine tenths of the light leave of it
    photo[10:14], photo[10:14, :20] = 230, 220  # the line
    across = Witness(camera, photo.copy(), no, no, no, ones)
    photo[10:14, 20:] = 90
    shaded = replace(across, photo=photo)
    monkeypatch.setattr(lifting, "light_in", lambda _, w: arriving_in(w, light))
    for views, filled in (([across, shaded], 0), ([shaded], 4 * 20)):
        undone = lifting.lifted_photos(prepared()[1], views)
        assert [int(dark.sum()) for _, _, dark, _ in undone] == [0] * (len(views) - 1) + [filled]
        assert (undone[-1][0][10:14, :20] > 225).all()


def arriving_in(witness: Witness, light: np.ndarray) -> Arriving:
    """Light [H, W, 3] on a view that shows nothing but ground."""
    lit = witness.photo[light.min(-1) == 1].max(-1)
    whole = slice(0, witness.camera.height), slice(0, witness.camera.width)
    return Arriving(whole, light, ~witness.hidden, np.bincount(lit, minlength=256))


def test_light_is_told_at_more_points_than_opencv_samples_at_once() -> None:
    shadow = prepared()[1]
    points = shadow.grounds[0].points().reshape(-1, 3)
    assert len(points) > 1 << 15
    parts = [shadow.arriving(p, 0) for p in np.array_split(points, 2)]
    np.testing.assert_array_equal(shadow.arriving(points, 0), np.concatenate(parts))


def test_a_channel_that_a_gaussian_cannot_show_is_left_alone() -> None:
    """Trained black is often below 0 in a channel, where a Gaussian has no weight: its other channels still have one.

    What red weighs was taken for all three, and blue grew by the missing light over nothing, step after step.
    """
    camera = Camera("0", 40, 30, 40.0, 40.0, 20.0, 15.0, np.eye(4))
    rng, count = np.random.default_rng(4), 60
    means = np.column_stack([rng.uniform(-0.6, 0.6, (count, 2)), rng.uniform(1.5, 2, count)]).astype(np.float32)
    black = Gaussians(
        means,
        np.full((count, 3), np.log(0.1), np.float32),
        np.tile(np.float32([1, 0, 0, 0]), (count, 1)),
        np.full(count, 1.0, np.float32),
        np.tile(np.float32([-3, -1.5, -1.2]), (count, 1))[:, None],
    )
    no = np.zeros((30, 40), bool)
    drawn = render_bytes(black, camera)
    witness = Witness(camera, drawn, no, no, no, np.full(no.shape, 1.7, np.float32))
    lifted = np.clip(drawn.astype(int) + 40, 0, 255).astype(np.uint8)
    rows, sh = recoloured(black, no.ravel()[:count], [witness], [lifted], [~no], [~no], 0)
    assert len(rows) > count / 2 and (sh[:, 0, 0] == -3).all()
    assert np.abs(sh - black.sh[rows]).max() < 3
    shown = black.sh.copy()
    shown[rows] = sh
    assert (
        np.abs(render_bytes(replace(black, sh=shown), camera)[..., 2].astype(int) - lifted[..., 2])[8:22, 8:32].mean()
        < 20
    )
