"""Colours that a scene needs to show other pictures."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gimp3d.camera import Camera
from gimp3d.gaussians import Gaussians
from gimp3d.raster import render_bytes
from gimp3d.stages.recolour import recoloured
from gimp3d.stages.witness import Witness


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
    witness = Witness(camera, drawn, no, no, np.full(no.shape, 1.7, np.float32))
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
