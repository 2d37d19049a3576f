"""Target regions: exactly what the object hid, from every view."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes import BLOCK, REGION, block, cameras, floor, scene, truth

from gimp3d.box import Box
from gimp3d.camera import Camera
from gimp3d.errors import BadInput, IllPosed
from gimp3d.orbit import look_at
from gimp3d.raster import render
from gimp3d.stages.masks import MaskSettings, box_polygon, fill_polygon, find_masks, sees, select_removed


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_the_polygon_holds_what_rays_through_the_box_hit(seed: int) -> None:
    rng = np.random.default_rng(seed)
    box = Box.make(rng.normal(size=3), rng.uniform(0.2, 2, 3), rng.normal(size=4))
    eye = rng.normal(size=3) * 3
    if box.contains(eye[None])[0]:
        return
    camera = Camera("c", 40, 30, 30, 30, 20, 15, look_at(eye, rng.normal(size=3), np.array([0, 0, 1.0])))
    polygon = box_polygon(box, camera, 1e-4)
    mask = np.zeros((30, 40), bool) if polygon is None else fill_polygon(polygon, 40, 30)
    # brute force: slab test of every pixel centre's ray
    rays = camera.unproject(camera.pixel_centres(), np.ones((30, 40))) - camera.centre
    origin, direction = (eye - box.center) @ box.axes, rays @ box.axes
    with np.errstate(divide="ignore"):
        a, b = (-box.size / 2 - origin) / direction, (box.size / 2 - origin) / direction
    near, far = np.minimum(a, b).max(-1), np.maximum(a, b).min(-1)
    hit = (near <= far) & (far > 0)
    clear = np.abs(far - near) > 0.02 * np.linalg.norm(box.size)
    assert (mask == hit)[clear].mean() > 0.995


def test_a_box_partly_behind_the_camera_is_clipped_not_mirrored() -> None:
    camera = Camera("c", 100, 100, 50, 50, 50, 50, np.eye(4))
    box = Box.make([0, 1.0, 0], [0.5, 0.5, 6])  # a beam below the camera, from behind to in front
    mask = fill_polygon(box_polygon(box, camera, 1e-3), 100, 100)
    assert mask[60:, 40:60].any() and not mask[:50].any()
    assert box_polygon(Box.make([0, 0, -3], [1, 1, 1]), camera, 1e-3) is None


def test_pixel_centres_decide() -> None:
    square = np.array([[1.0, 1], [3.5, 1], [3.5, 2.5], [1, 2.5]])
    expected = np.zeros((4, 5), bool)
    expected[1:2, 1:3] = True  # centres 1.5 and 2.5 lie inside, 3.5 is on the edge
    assert (fill_polygon(square, 5, 4)[:2, :3] == expected[:2, :3]).all()
    assert (fill_polygon(square[::-1], 5, 4) == fill_polygon(square, 5, 4)).all()


def test_the_target_covers_the_hole_and_little_more() -> None:
    masks = find_masks(scene(), REGION, cameras())
    assert masks.removed.sum() >= len(block())
    for view in masks.views:
        true = render(truth(), view.camera).median_depth
        points = view.camera.unproject(view.camera.pixel_centres(), true.astype(float))
        under = (true > 0) & (np.abs(points[..., :2]) < BLOCK / 2 - 0.02).all(-1)
        assert (view.target & under).sum() >= 0.97 * under.sum(), view.camera.id
        assert view.target.sum() <= view.silhouette.sum()
        assert not view.target[true == 0].any() or view.target[true == 0].sum() < 0.1 * view.target.sum()


def test_need_is_smaller_than_paper_and_both_lie_where_the_object_was() -> None:
    need = find_masks(scene(), REGION, cameras())
    paper = find_masks(scene(), REGION, cameras(), MaskSettings(mode="paper"))
    assert 0 < need.hole_pixels < paper.hole_pixels
    for view in paper.views:
        assert not (view.target & ~view.polygon).any()


def test_what_only_the_removal_reveals_goes_too() -> None:
    smear = block().take(np.arange(40))
    smear.means[:] = np.random.default_rng(0).uniform(-0.2, 0.2, (40, 3)) * [1, 1, 0] - [0, 0, 0.12]
    whole = scene().extended(smear)  # object colour under the floor, where no view ever saw it
    masks = find_masks(whole, REGION, cameras())
    assert masks.removed[-40:].mean() > 0.9
    kept_floor = ~masks.removed[: len(floor(True))]
    assert kept_floor.mean() > 0.95


def test_cameras_inside_the_region_are_left_out() -> None:
    inside = Camera(
        "inside", 60, 40, 50, 50, 30, 20, look_at(np.array([0.1, 0, 0.2]), np.ones(3), np.array([0, 0, 1.0]))
    )
    masks = find_masks(scene(), REGION, [*cameras(), inside])
    assert masks.left_out == ("inside",) and len(masks.views) == 9


def test_nothing_selected_everything_selected_no_view_and_unknown_mode() -> None:
    far = (Box.make([0, 0, 50], [1, 1, 1]),)
    empty = find_masks(scene(), far, cameras())
    assert not empty.removed.any() and empty.hole_pixels == 0
    with pytest.raises(IllPosed, match="whole scene"):
        find_masks(scene(), (Box.make([0, 0, 0], [99, 99, 99]),), cameras())
    behind = [replace(c, viewmat=np.diag([-1.0, 1, -1, 1]) @ c.viewmat) for c in cameras()]
    with pytest.raises(IllPosed, match="no usable view"):
        find_masks(scene(), REGION, behind)
    with pytest.raises(BadInput, match="unknown mode"):
        find_masks(scene(), REGION, cameras(), MaskSettings(mode="other"))


def test_unusable_rows_are_never_removed() -> None:
    g = scene()
    row = int(np.flatnonzero(select_removed(g, REGION))[0])
    g.sh[row, 0, 0] = np.nan
    assert not select_removed(g, REGION)[row]


def test_overlapping_boxes_are_their_union() -> None:
    halves = (Box.make([-0.1, 0, 0.26], [0.42, 0.62, 0.56]), Box.make([0.1, 0, 0.26], [0.42, 0.62, 0.56]))
    assert (select_removed(scene(), halves) == select_removed(scene(), REGION)).all()


def test_views_of_mixed_sizes_and_intrinsics() -> None:
    mixed = [c.scaled(f) for c, f in zip(cameras(), (1, 0.5, 1.3, 0.77, 1, 1, 1, 1, 1))]
    masks = find_masks(scene(), REGION, mixed)
    for view in masks.views:
        assert view.target.shape == (view.camera.height, view.camera.width) and view.target.any()


def test_sees_is_a_depth_test() -> None:
    camera = Camera("c", 10, 10, 10, 10, 5, 5, np.eye(4))
    depth = np.full((10, 10), 2.0)
    depth[0, 0] = 0
    points = np.array([[0, 0, 2.0], [0, 0, 2.5], [0, 0, 1.5], [0, 0, -2], [9, 0, 2], [-0.9, -0.9, 2.0]])
    assert sees(camera, depth, points, 0.02).tolist() == [True, False, False, False, False, False]
