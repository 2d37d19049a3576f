"""Perturbations are as large as they say, the same every time, and leave nothing behind."""

from __future__ import annotations

import numpy as np
import pytest
from scenes import REGION, cameras, scene

from benchmarks.perturbations import depth_errors, moved, noisy_depths, resized, turned
from gimp3d.box import Box
from gimp3d.raster import current_backend, render, surface_depth


@pytest.mark.parametrize("pixels", [0.0, 0.1, 2.0, 10.0])
@pytest.mark.parametrize("z", [0.5, 20.0])
def test_a_turned_camera_moves_pictures_of_near_and_far_by_the_pixels_asked_for(pixels: float, z: float) -> None:
    camera = cameras()[3]
    other = turned(camera, pixels, np.random.default_rng(5))
    points = camera.unproject(camera.pixel_centres(), np.full((camera.height, camera.width), z))
    steps = other.project(points)[0] - camera.project(points)[0]
    assert np.sqrt((steps**2).sum(-1).mean()) == pytest.approx(pixels, rel=0.02, abs=1e-9)
    np.testing.assert_allclose(other.centre, camera.centre, atol=1e-12)
    np.testing.assert_allclose(other.R @ other.R.T, np.eye(3), atol=1e-12)


def test_depths_are_off_by_the_share_asked_for_in_every_kind_of_rendering() -> None:
    camera, before = cameras(2, 240, 180)[1], current_backend()
    exact = render(scene(), camera, passes=frozenset({"depth", "rgb"}))
    exact_surface, _ = surface_depth(scene(), camera)
    with noisy_depths(0.01, seed=3):
        noisy = render(scene(), camera, passes=frozenset({"depth", "rgb"}))
        noisy_surface, _ = surface_depth(scene(), camera)
        again, _ = surface_depth(scene(), camera)
    assert current_backend() is before
    np.testing.assert_array_equal(noisy_surface, again)
    np.testing.assert_array_equal(noisy.rgb, exact.rgb)
    for a, b in ((noisy.median_depth, exact.median_depth), (noisy_surface, exact_surface)):
        assert ((a > 0) == (b > 0)).all()
        relative = a[b > 0] / b[b > 0] - 1
        assert relative.std() == pytest.approx(0.01, rel=0.2) and abs(relative.mean()) < 0.003


def test_views_and_seeds_have_errors_of_their_own() -> None:
    fields = [depth_errors(name, 90, 120, seed) for name, seed in (("a", 0), ("b", 0), ("a", 1))]
    for k, a in enumerate(fields):
        assert a.std() == pytest.approx(1, rel=1e-5)
        for b in fields[k + 1 :]:
            assert abs((a * b).mean()) < 0.1


def test_the_backend_comes_back_after_an_error() -> None:
    before = current_backend()
    with pytest.raises(RuntimeError), noisy_depths(0.1, 0):
        raise RuntimeError
    assert current_backend() is before


def test_regions_grow_about_their_centres_and_move_along_their_own_axes() -> None:
    turned_box = (Box.make([1, 2, 3], [2, 1, 1], [np.cos(np.pi / 4), 0, 0, np.sin(np.pi / 4)]),)  # x becomes y
    np.testing.assert_allclose(resized(turned_box, 1.2)[0].size, [2.4, 1.2, 1.2])
    np.testing.assert_allclose(resized(turned_box, 1.2)[0].center, [1, 2, 3])
    np.testing.assert_allclose(moved(turned_box, 0, 0.1)[0].center, [1, 2.2, 3], atol=1e-12)
    assert resized(REGION, 1.0)[0].contains(REGION[0].corners() * 0.999).sum() == 8
