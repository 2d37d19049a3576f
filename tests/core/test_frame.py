"""The frame that suits a scene."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scenes import cameras, scene

from gimp3d.frame import Frame, frame_of


@pytest.mark.parametrize("shift", [0.0, 3.0, 40.0, 1e5])
@pytest.mark.parametrize("scale", [10.0**k for k in range(-6, 7)])
def test_in_the_frame_that_suits_a_scene_it_keeps_its_own(scale: float, shift: float) -> None:
    """A removal's files are brought into a frame once, though the command and the library both ask for one."""
    elsewhere = Frame(-shift * np.array([0.6, -0.5, 0.64]), scale)
    means = (scene().means.astype(np.float64) - elsewhere.origin) * scale
    moved = replace(scene(), means=means, log_scales=scene().log_scales + np.float32(np.log(scale)))
    views = [elsewhere.camera(c) for c in cameras()]
    frame = frame_of(moved, views)
    there = frame.scene(moved)
    assert there.means.dtype == np.float32
    assert frame_of(there, [frame.camera(c) for c in views]).is_files
    assert not (frame.is_files and (shift > 1e4 or not 0.1 < scale < 1000))
