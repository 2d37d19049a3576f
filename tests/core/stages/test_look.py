"""Boxes, windows and parts of views, and what the views together have seen."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from property_tests import examples
from scenes import cameras, scene

from gimp3d.box import Box
from gimp3d.camera import Camera
from gimp3d.geometry import window_round
from gimp3d.orbit import look_at
from gimp3d.raster import footprint, surface_depth, touched_window
from gimp3d.stages.look import ViewBefore, box_polygon, box_window, depth_agreement, fill_polygon


def some_camera(rng: np.random.Generator, eye: np.ndarray) -> Camera:
    return Camera("c", 40, 30, 30, 30, 20, 15, look_at(eye, rng.normal(size=3), np.array([0, 0, 1.0])))


@examples(60)
@given(seed=st.integers(0, 10_000))
def test_the_polygon_holds_what_rays_through_the_box_hit(seed: int) -> None:
    rng = np.random.default_rng(seed)
    box = Box.make(rng.normal(size=3), rng.uniform(0.2, 2, 3), rng.normal(size=4))
    eye = rng.normal(size=3) * 3
    if box.contains(eye[None])[0]:
        return
    camera = some_camera(rng, eye)
    polygon = box_polygon(box, camera)
    mask = np.zeros((30, 40), bool) if polygon is None else fill_polygon(polygon, camera)
    # brute force: slab test of every pixel centre's ray
    rays = camera.unproject(camera.pixel_centres(), np.ones((30, 40))) - camera.centre
    origin, direction = (eye - box.center) @ box.axes, rays @ box.axes
    with np.errstate(divide="ignore"):
        a, b = (-box.size / 2 - origin) / direction, (box.size / 2 - origin) / direction
    near, far = np.minimum(a, b).max(-1), np.maximum(a, b).min(-1)
    hit = (near <= far) & (far > 0)
    clear = np.abs(far - near) > 0.02 * np.linalg.norm(box.size)
    assert (mask == hit)[clear].mean() > 0.995
    rows, cols = box_window(box, camera)
    outside = mask.copy()
    outside[rows, cols] = False
    assert not outside.any()


def test_a_box_partly_behind_the_camera_is_clipped_not_mirrored() -> None:
    camera = Camera("c", 100, 100, 50, 50, 50, 50, np.eye(4))
    box = Box.make([0, 1.0, 0], [0.5, 0.5, 6])  # a beam below the camera, from behind to in front
    mask = fill_polygon(box_polygon(box, camera), camera)
    assert mask[60:, 40:60].any() and not mask[:50].any()
    assert box_window(box, camera) == (slice(0, 100), slice(0, 100))
    assert box_polygon(Box.make([0, 0, -3], [1, 1, 1]), camera) is None


def test_pixel_centres_decide() -> None:
    square = np.array([[1.0, 1], [3.5, 1], [3.5, 2.5], [1, 2.5]])
    expected = np.zeros((4, 5), bool)
    expected[1:2, 1:3] = True  # centres 1.5 and 2.5 lie inside, 3.5 is on the edge
    camera = Camera("c", 5, 4, 5, 5, 2.5, 2, np.eye(4))
    assert (fill_polygon(square, camera)[:2, :3] == expected[:2, :3]).all()
    assert (fill_polygon(square[::-1], camera) == fill_polygon(square, camera)).all()


def test_windows_lie_in_the_picture_and_are_never_empty() -> None:
    camera = cameras()[0]
    for points in (np.empty((0, 2)), np.array([[-50.0, -9]]), np.array([[500.0, 400], [700, 800]]), np.zeros((1, 2))):
        rows, cols = window_round(points, camera, 3)
        assert 0 <= rows.start < rows.stop <= camera.height and 0 <= cols.start < cols.stop <= camera.width
    assert window_round(np.array([[10.2, 20.7]]), camera, 2) == (slice(18, 23), slice(8, 13))


@examples(15)
@given(seed=st.integers(0, 1000))
def test_gaussians_touch_nothing_outside_their_window(seed: int) -> None:
    rng = np.random.default_rng(seed)
    g, camera = scene(), cameras()[int(rng.integers(9))]
    few = g.take(rng.choice(len(g), 8, replace=False))
    weight = footprint(few, camera, np.ones(8, bool))
    weight[touched_window(few, camera)] = 0
    assert not weight.any()


def test_windows_of_what_lies_behind_the_camera() -> None:
    camera = cameras()[0]
    g = scene().take(np.arange(3))
    g.means[:] = camera.centre - 5 * camera.forward
    rows, cols = touched_window(g, camera)
    assert (rows.stop - rows.start) * (cols.stop - cols.start) == 1


def test_views_of_one_scene_agree_and_views_of_noise_do_not() -> None:
    some = [c.scaled(f) for c, f in zip(cameras(), (1, 0.5, 1.3, 0.77, 1, 1, 1, 1, 1))]
    depths = [surface_depth(scene(), c)[0] for c in some]

    def agreement(depths: list[np.ndarray]) -> float:
        whole = [(slice(0, c.height), slice(0, c.width)) for c in some]
        views = [ViewBefore(c, [], w, d, d, None, np.nan, None) for c, w, d in zip(some, whole, depths)]
        return depth_agreement(views)

    assert agreement(depths) > 0.95
    rng = np.random.default_rng(0)
    noise = [np.where(d > 0, d * rng.uniform(0.7, 1.3, d.shape), 0).astype(np.float32) for d in depths]
    assert agreement(noise) < 0.3
    assert agreement(noise[:1]) == 1
    assert agreement([np.zeros_like(d) for d in depths]) == 1
