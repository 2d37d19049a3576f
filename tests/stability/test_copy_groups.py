"""The sketch that copies groups of Gaussians: segments, and the motions that take them along."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from copy_groups import moved, rigid, segments
from scenes import cameras, floor

from gimp3d.gaussians import quats_to_matrices
from gimp3d.pipeline import render_bytes


def test_a_segment_is_where_sources_lie_together() -> None:
    y, x = np.indices((40, 60))
    inside = (y > 9) & (y < 30)
    rows, cols = np.where(inside, y - 5, -1), np.where(inside, np.where(x < 25, x + 30, x - 20), -1)
    rows[12, 3] = 39  # a single stray source
    found = list(segments(rows, cols))
    assert [int(s.sum()) for s in found] == [20 * 25 - 1, 20 * 35]
    assert not (found[0] & found[1]).any() and not found[0][12, 3]


def test_points_moved_rigidly_are_brought_back_and_others_refused() -> None:
    rng = np.random.default_rng(0)
    points = rng.normal(size=(50, 3)) * [1, 1, 0]  # plane, as surfaces are: no mirror image may come of it
    turn = quats_to_matrices(np.array([[0.7, 0.1, -0.5, 0.3]]))[0]
    motion = rigid(points, points @ turn.T + [1, 2, 3])
    assert motion is not None
    np.testing.assert_allclose(motion[0], turn, atol=1e-9)
    np.testing.assert_allclose(motion[1], [1, 2, 3], atol=1e-9)
    assert rigid(points, rng.permutation(points)) is None


def test_a_moved_group_looks_as_before_to_a_camera_that_moves_along() -> None:
    group, camera = floor(with_hole=False, step=0.1), cameras(9)[1]
    turn, shift = quats_to_matrices(np.array([[0.9, 0.2, -0.1, 0.3]]))[0], np.array([1.0, -2.0, 0.5])
    along = np.eye(4)
    along[:3, :3], along[:3, 3] = turn.T, -turn.T @ shift
    there = replace(camera, viewmat=camera.viewmat @ along)
    difference = render_bytes(moved(group, turn, shift), there).astype(int) - render_bytes(group, camera)
    assert np.abs(difference).max() <= 2
