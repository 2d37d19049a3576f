"""The scene's noun."""

from __future__ import annotations

import numpy as np
import pytest

from gimp3d.gaussians import ARRAYS, Gaussians, pad_sh


def test_rows_that_cannot_be_drawn_are_marked(block_scene: Gaussians) -> None:
    g = block_scene.take(np.arange(8))
    g.means[0, 1] = np.nan
    g.quats[1] = 0
    g.opacity_logits[2] = np.inf  # legal: fully opaque
    g.log_scales[3, 0] = -np.inf  # legal: flat
    g.log_scales[4, 0] = np.nan
    g.sh[5, 0, 0] = np.inf
    g.means[6, 0] = np.inf
    g.log_scales[7, 2] = 200  # overflows
    assert g.usable.tolist() == [False, False, True, True, False, False, False, False]
    assert g.opacity[2] == 1 and g.scales[3, 0] == 0


def test_rows_are_replaced_and_the_others_stay(block_scene: Gaussians) -> None:
    rows = np.array([5, 2])
    changed = block_scene.with_rows(rows, block_scene.take(np.array([0, 1])))
    for name in ARRAYS:
        before, after = getattr(block_scene, name), getattr(changed, name)
        np.testing.assert_array_equal(after[rows], before[:2])
        np.testing.assert_array_equal(np.delete(after, rows, 0), np.delete(before, rows, 0))


def test_joining_pads_the_lower_sh_degree(block_scene: Gaussians) -> None:
    low = block_scene.take(np.arange(3))
    high = Gaussians(low.means, low.log_scales, low.quats, low.opacity_logits, pad_sh(low.sh, 9))
    joined = low.extended(high)
    assert joined.sh_degree == 2 and len(joined) == 6 and (joined.sh[:3, 1:] == 0).all()


def test_surfels_and_gaussians_do_not_mix(block_scene: Gaussians) -> None:
    g = block_scene.take(np.arange(3))
    flat = Gaussians(g.means, g.log_scales[:, :2], g.quats, g.opacity_logits, g.sh)
    assert flat.is_surfels
    with pytest.raises(ValueError, match="surfels"):
        g.extended(flat)


def test_wrong_shapes_are_refused(block_scene: Gaussians) -> None:
    g = block_scene.take(np.arange(3))
    with pytest.raises(ValueError, match="quats"):
        Gaussians(g.means, g.log_scales, g.quats[:2], g.opacity_logits, g.sh)
