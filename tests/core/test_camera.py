"""The pinhole camera."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from property_tests import examples

from gimp3d.camera import Camera
from gimp3d.gaussians import matrices_to_quats, quats_to_matrices
from gimp3d.orbit import look_at

VALUES = st.floats(-4, 4)


@examples(60)
@given(eye=st.tuples(*[VALUES] * 3), fx=st.floats(20, 900), cx=st.floats(-50, 300), depth=st.floats(0.1, 50))
def test_unproject_inverts_project(eye, fx, cx, depth) -> None:
    if np.linalg.norm(eye[:2]) < 0.1:
        return
    camera = Camera("c", 200, 100, fx, 1.1 * fx, cx, 40, look_at(np.array(eye), np.zeros(3), np.array([0, 0, 1.0])))
    uv = np.array([[0.5, 0.5], [199.5, 3.2], [77.0, 99.5]])
    points = camera.unproject(uv, np.full(3, depth))
    back, z = camera.project(points)
    np.testing.assert_allclose(back, uv, atol=1e-6 * max(1, fx))
    np.testing.assert_allclose(z, depth, rtol=1e-9)


def test_points_behind_have_no_pixel() -> None:
    camera = Camera("c", 10, 10, 5, 5, 5, 5, np.eye(4))
    uv, z = camera.project(np.array([[0, 0, -1.0], [0, 0, 0.0]]))
    assert np.isnan(uv).all() and (z <= 0).all()


def test_the_centre_of_pixel_zero_is_half() -> None:
    camera = Camera("c", 4, 2, 10, 10, 2, 1, np.eye(4))
    np.testing.assert_array_equal(camera.pixel_centres()[0, 0], [0.5, 0.5])
    np.testing.assert_array_equal(camera.pixel_centres()[1, 3], [3.5, 1.5])


@examples(30)
@given(factor=st.floats(0.1, 4))
def test_scaling_moves_pixels_with_the_size(factor: float) -> None:
    camera = Camera("c", 101, 67, 90, 95, 48, 30, np.eye(4))
    scaled = camera.scaled(factor)
    points = np.array([[0.1, 0.2, 2.0], [-0.3, 0.1, 1.0]])
    ratio = np.array([scaled.width / camera.width, scaled.height / camera.height])
    np.testing.assert_allclose(scaled.project(points)[0], camera.project(points)[0] * ratio, rtol=1e-12)


@examples(50)
@given(quat=st.tuples(*[VALUES] * 4))
def test_quaternions_and_matrices_invert_each_other(quat) -> None:
    if np.linalg.norm(quat) < 0.1:
        return
    matrix = quats_to_matrices(np.array([quat]))
    np.testing.assert_allclose(matrix[0] @ matrix[0].T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(quats_to_matrices(matrices_to_quats(matrix)), matrix, atol=1e-7)


@pytest.mark.parametrize(
    "wrong",
    [{"width": -1}, {"height": -1}, {"viewmat": np.full((4, 4), np.nan)}, {"viewmat": np.eye(3)}, {"fx": np.inf}],
)
def test_a_camera_that_no_picture_can_have_is_refused(wrong: dict[str, Any]) -> None:
    good = Camera("a", 4, 3, 5.0, 5.0, 2.0, 1.5, np.eye(4))
    with pytest.raises(ValueError, match="camera a: "):
        replace(good, **wrong)
