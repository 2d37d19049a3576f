"""Depths that other views measured in the hole, on analytic scenes."""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
import pytest

from gimp3d.box import Box
from gimp3d.camera import Camera
from gimp3d.orbit import orbit_cameras
from gimp3d.stages.depth import DepthSettings, complete_depth
from gimp3d.stages.depth.evidence import gather_depth_evidence
from gimp3d.stages.masks import ViewMasks

REGION = (Box.make([0, 0, 0.2], [0.45, 0.45, 0.45]),)
CAMERAS = orbit_cameras(REGION, 12, (0, 0, 1), 160, 120, 50)
RADIUS = 0.4


def floor(x, y):
    return 0 * x


def mound(x, y):
    """A bump beside the object, and one under it that no view sees."""
    return 0.25 * np.exp(-((x - 0.45) ** 2 + y**2) / 0.05)


def ground_depth(camera, height):
    """z-depth of the surface z = height(x, y), by stepping along the rays and halving; far ground ends at 12."""
    uv = camera.pixel_centres()
    low, high = np.full(uv.shape[:2], 0.05), np.full(uv.shape[:2], 12.0)
    reached = np.zeros(uv.shape[:2], bool)
    for z in np.geomspace(0.2, 12, 240):
        points = camera.unproject(uv, np.full(uv.shape[:2], z))
        under = (points[..., 2] < height(points[..., 0], points[..., 1])) & ~reached
        high[under], reached = z, reached | under
        low[~reached] = z
    for _ in range(16):
        middle = (low + high) / 2
        points = camera.unproject(uv, middle)
        under = points[..., 2] < height(points[..., 0], points[..., 1])
        low, high = np.where(under, low, middle), np.where(under, middle, high)
    return np.where(reached, high, 0).astype(np.float32)


def sphere_depth(camera):
    """z-depth of the object, a ball that stands on the floor; 0 beside it."""
    uv = camera.pixel_centres()
    start = camera.centre - [0, 0, RADIUS]
    ray = camera.unproject(uv, np.ones(uv.shape[:2])) - camera.centre
    a, b, c = (ray**2).sum(-1), ray @ start, start @ start - RADIUS**2
    root = b**2 - a * c
    return np.where(root > 0, (-b - np.sqrt(np.maximum(root, 0))) / a, 0).astype(np.float32)


def view_of(camera, height):
    """As `find_masks` would give it; T is all that the object hides."""
    after, ball = ground_depth(camera, height), sphere_depth(camera)
    hit = (ball > 0) & ((after == 0) | (ball < after))
    silhouette = cv2.dilate(hit.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    alpha = (after > 0).astype(np.float32)
    none = np.zeros_like(silhouette)
    target = silhouette & (after > 0)
    return ViewMasks(camera, silhouette, silhouette, none, target, np.where(hit, ball, after), alpha, after, alpha)


@pytest.fixture(scope="module", params=[floor, mound], ids=["floor", "mound"])
def views(request):
    return [view_of(c, request.param) for c in CAMERAS]


def test_what_other_views_measured_is_true(views):
    view = views[0]
    found = gather_depth_evidence(view, views)
    there = found.weight > 0
    assert not (there & ~view.target).any() and (found.disparity[~there] == 0).all()
    assert there.sum() > 0.3 * view.target.sum()
    errors = np.abs(view.depth_after[there] * found.disparity[there] - 1)
    assert np.median(errors) < 0.005 and np.percentile(errors, 95) < 0.03


def test_no_evidence_comes_from_under_the_object(views):
    """No view sees where the ball touches the floor."""
    view = views[0]
    points = view.camera.unproject(view.camera.pixel_centres(), view.depth_after.astype(np.float64))
    contact = view.target & (np.linalg.norm(points[..., :2], axis=-1) < 0.12)
    assert contact.any() and not (gather_depth_evidence(view, views).weight[contact] > 0).any()


def test_one_view_alone_is_no_evidence(views):
    assert not gather_depth_evidence(views[0], [views[0]]).weight.any()
    assert not gather_depth_evidence(views[0], views[:2]).weight.any()  # two must agree


def test_a_lone_wrong_view_does_not_decide(views):
    wrong = [*views[:5], view_of(CAMERAS[5], lambda x, y: 0 * x - 0.1), *views[6:]]
    view = views[0]
    there = (found := gather_depth_evidence(view, wrong)).weight > 0
    errors = np.abs(view.depth_after[there] * found.disparity[there] - 1)
    assert np.median(errors) < 0.01


def test_the_whole_completion_uses_what_views_saw():
    """The mound beside the object is hidden in some references, and no slope on the rim tells of it."""
    views = [view_of(c, mound) for c in CAMERAS]
    alone, together = [], []
    for view in views:
        disparity = np.divide(1, view.depth_after, out=np.zeros_like(view.depth_after), where=view.depth_after > 0)
        known = ~view.target & (view.depth_after > 0)
        for errors, others in ((alone, [view]), (together, views)):
            found = complete_depth(view, others, disparity, known)
            errors.append(np.abs(found.depth[view.target] / view.depth_after[view.target] - 1).mean())
    assert np.mean(together) < 0.7 * np.mean(alone)
    assert np.max(np.array(together) / np.array(alone)) < 1.5


def test_what_shows_from_under_a_table_is_no_evidence():
    """Views from below see the floor under the table that the object stands on; the table is what was hidden."""
    low = []
    for k, angle in enumerate(np.arange(6) * np.pi / 3):
        back = np.array([np.cos(angle), np.sin(angle), 0.25]) / np.hypot(1, 0.25)
        right = np.array([-np.sin(angle), np.cos(angle), 0])
        turn = np.stack([right, np.cross(-back, right), -back])
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = turn, -turn @ (1.5 * back + [0, 0, -0.8])
        low.append(Camera(f"low {k}", 160, 120, 150, 150, 80, 60, pose))

    def table(camera):
        """The table top z = 0 with a hole under the object, and the ground at −0.8, after the removal."""
        rays = camera.unproject(camera.pixel_centres(), np.ones((120, 160))) - camera.centre
        steep = np.where(np.abs(rays[..., 2]) > 1e-6, rays[..., 2], 1e-6)
        top, ground = -camera.centre[2] / steep, np.maximum((-0.8 - camera.centre[2]) / steep, 0)
        place = camera.centre + top[..., None] * rays
        on_top = (top > 0) & (np.abs(place[..., :2]).max(-1) < 1.2)
        whole = np.where(on_top, top, ground).astype(np.float32)
        gap = on_top & (np.abs(place[..., :2]).max(-1) < 0.2)
        return whole, np.where(gap, ground, whole).astype(np.float32), gap

    whole, after, gap = table(CAMERAS[0])
    ball = sphere_depth(CAMERAS[0])
    before = np.where((ball > 0) & (ball < whole), ball, whole)
    alpha, none = np.ones_like(whole), np.zeros_like(gap)
    view = ViewMasks(CAMERAS[0], gap, gap, none, gap, before, alpha, after, alpha)
    others = []
    for camera in low:
        _, ground, _ = table(camera)
        others.append(ViewMasks(camera, none, none, none, none, ground, alpha, ground, alpha))
    known = ~gap & (after > 0)
    assert (gather_depth_evidence(view, others).weight > 0).sum() > 0.1 * gap.sum()  # the trap is there
    found = complete_depth(view, [view, *others], 1 / np.maximum(after, 1e-3), known)
    assert np.percentile(np.abs(found.depth[gap] / whole[gap] - 1), 95) < 0.02


def test_remains_of_the_object_are_no_evidence():
    """Splats of the object that were kept are there with and without it: a small island before the surface."""
    views = [view_of(c, floor) for c in CAMERAS]
    spoilt = []
    for view in views:
        start = view.camera.centre - [0, 0, 0.1]
        rays = view.camera.unproject(view.camera.pixel_centres(), np.ones((120, 160))) - view.camera.centre
        nearest = -(rays @ start) / (rays**2).sum(-1)
        hit = np.linalg.norm(start + nearest[..., None] * rays, axis=-1) < 0.11
        before, after = (np.where(hit, nearest, d).astype(np.float32) for d in (view.depth_before, view.depth_after))
        spoilt.append(dataclasses.replace(view, depth_before=before, depth_after=after))
    view = dataclasses.replace(views[0], depth_before=spoilt[0].depth_before)
    assert (gather_depth_evidence(view, spoilt).disparity * view.depth_after > 1.05).sum() > 5  # the trap is there
    known = ~view.target & (view.depth_after > 0)
    disparity = np.divide(1, view.depth_after, out=np.zeros_like(view.depth_after), where=view.depth_after > 0)
    found = complete_depth(view, [view, *spoilt[1:]], disparity, known, None, DepthSettings(surface="smooth"))
    assert np.abs(found.depth[view.target] / view.depth_after[view.target] - 1).max() < 0.03


def test_what_falls_through_a_surface_round_the_hole_is_not_continued():
    """A scan's floor leaks: in one view it shows what lies far below. Others see the floor there."""
    views = [view_of(c, floor) for c in CAMERAS]
    rows, cols = np.nonzero(views[0].target)
    leak = ~views[0].target & (np.arange(160) > cols.mean() - 5) & (np.arange(120)[:, None] > rows.mean())
    leaking = [np.where(leak, 2 * d, d).astype(np.float32) for d in (views[0].depth_before, views[0].depth_after)]
    view = dataclasses.replace(views[0], depth_before=leaking[0], depth_after=leaking[1])
    disparity = np.divide(1, view.depth_after, out=np.zeros_like(view.depth_after), where=view.depth_after > 0)
    known = ~view.target & (view.depth_after > 0)

    def beside(other):
        """A view that saw nothing of the hole itself."""
        points = other.camera.unproject(other.camera.pixel_centres(), other.depth_before)
        uv, _ = view.camera.project(points)
        cols, rows = np.clip(np.nan_to_num(uv), 0, [159, 119]).astype(int).transpose(2, 0, 1)
        return dataclasses.replace(other, depth_before=np.where(view.target[rows, cols], 0, other.depth_before))

    def worst(others):
        depth = complete_depth(view, others, disparity, known).depth
        return np.percentile(np.abs(depth[view.target] / views[0].depth_after[view.target] - 1), 95)

    assert worst([view]) > 0.2  # the trap is there
    assert worst([view, *map(beside, views[1:])]) < 0.02
