"""Where light is given back: on what a photo can show."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import cv2
import numpy as np
from light_ablation import Prepared, found_in, made
from light_scenes import Lamp, make_scene

from gimp3d.stages.lifting import light_in
from gimp3d.stages.shadow import Shadow
from gimp3d.stages.witness import Witness


@cache
def prepared() -> tuple[Prepared, Shadow]:
    scene = made(make_scene("waves", [Lamp(40, 110, 3)]))
    found = found_in(scene)
    assert isinstance(found, Shadow)
    return scene, found


def light(witness: Witness) -> np.ndarray:
    """[H, W] the mean share of light that arrives, 1 where nothing is told."""
    arriving = light_in(prepared()[1], witness)
    out = np.ones(witness.hidden.shape)
    out[arriving.window] = arriving.light.mean(-1)
    return out


def test_what_is_drawn_below_the_ground_is_lifted_nowhere() -> None:
    """Nothing can be seen there: rough splats err, and light does not arrive below the object."""
    shaded = strange = 0
    for witness in prepared()[0].witnesses[::3]:
        far = cv2.dilate((witness.hidden | witness.beside).astype(np.uint8), np.ones((9, 9), np.uint8)) == 0
        below = replace(witness, depth=np.float32(1.5) * witness.depth, photo=255 - witness.photo)
        shaded += int((light(witness) < 0.9)[far].sum())
        strange += int((light(below) < 0.99)[far].sum())
    assert shaded > 1000 and strange < 0.2 * shaded
