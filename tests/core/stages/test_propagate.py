"""Carrying the reference into other views."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scenes import cameras, truth

from gimp3d.pipeline import render_bytes
from gimp3d.raster import render
from gimp3d.stages.propagate import PropagateSettings, Reference, Rule, ViewToPaint, blend, propagate


def whole(camera) -> tuple[np.ndarray, np.ndarray]:
    return render_bytes(truth(), camera), render(truth(), camera).median_depth


@pytest.fixture(scope="module")
def reference() -> Reference:
    """A view whose hole is completed truly; every hole pixel maps to itself shifted by 30 columns."""
    camera = cameras(9)[1]
    image, depth = whole(camera)
    target = np.zeros(depth.shape, bool)
    target[40:60, 40:65] = True
    target &= depth > 0
    rows, cols = np.mgrid[:90, :120]
    return Reference(
        camera,
        image,
        depth,
        target,
        np.where(target, rows, -1).astype(np.int32),
        np.where(target, cols + 30, -1).astype(np.int32),
    )


def view(reference: Reference, index: int, gain: float = 1.0) -> ViewToPaint:
    """Another view whose hole is what the reference's hole looks like from there."""
    camera = cameras(9)[index]
    image, depth = whole(camera)
    image = np.clip(image * gain, 0, 255).astype(np.uint8)
    points = camera.unproject(camera.pixel_centres(), depth.astype(float))
    uv, _ = reference.camera.project(points)
    with np.errstate(invalid="ignore"):
        inside = (uv[..., 0] > 40) & (uv[..., 0] < 65) & (uv[..., 1] > 40) & (uv[..., 1] < 60) & (depth > 0)
    photo = image.copy()
    photo[inside] = [200, 0, 0]
    before = np.where(inside, 0.5 * depth, depth).astype(np.float32)
    return ViewToPaint(
        camera, photo, np.where(inside[..., None], 0, photo).astype(np.uint8), inside, inside, before, depth
    )


@pytest.mark.parametrize("index", [0, 2, 4])
def test_the_hole_is_painted_with_the_true_picture(reference: Reference, index: int) -> None:
    target = view(reference, index)
    (painted,) = propagate(reference, [target]).views
    hole = target.target & (painted.rules != Rule.UNREACHED)
    assert hole.sum() > 0.8 * target.target.sum()
    error = np.abs(painted.image[hole].astype(float) - whole(target.camera)[0][hole])
    assert np.sqrt((error**2).mean()) < 12


def test_nothing_outside_the_hole_changes(reference: Reference) -> None:
    target = view(reference, 2)
    (painted,) = propagate(reference, [target]).views
    assert (painted.image[~target.target] == target.base[~target.target]).all()
    assert (painted.rules[~target.target] == Rule.UNTOUCHED).all()


def test_the_order_and_company_of_views_does_not_matter(reference: Reference) -> None:
    views = [view(reference, k) for k in (0, 2, 4)]
    forward, backward = propagate(reference, views), propagate(reference, views[::-1])
    for a, b in zip(forward.views, backward.views[::-1]):
        assert a.camera_id == b.camera_id and (a.image == b.image).all() and (a.rules == b.rules).all()


def test_exposure_of_the_view_is_met(reference: Reference) -> None:
    target = view(reference, 2, gain=0.7)
    (painted,) = propagate(reference, [target]).views
    hole = target.target & (painted.rules != Rule.UNREACHED)
    expected = np.clip(whole(target.camera)[0][hole] * 0.7, 0, 255)
    assert abs(painted.image[hole].mean() - expected.mean()) < 6


def test_what_the_reference_does_not_see_is_said_to_be_unreached(reference: Reference) -> None:
    target = view(reference, 2)
    shifted = replace(target, depth_new=0.6 * target.depth_new)
    (painted,) = propagate(reference, [shifted]).views
    assert (painted.rules[target.target] == Rule.UNREACHED).all()
    assert (painted.image[target.target] == target.base[target.target]).all()


def test_a_view_without_a_hole_is_left_alone(reference: Reference) -> None:
    target = view(reference, 2)
    nothing = replace(target, target=np.zeros_like(target.target), silhouette=np.zeros_like(target.target))
    (painted,) = propagate(reference, [nothing]).views
    assert (painted.image == nothing.base).all()


def test_without_sources_the_warped_reference_is_used(reference: Reference) -> None:
    none = replace(reference, rows=np.full_like(reference.rows, -1))
    target = view(reference, 2)
    (painted,) = propagate(none, [target]).views
    assert (painted.rules == Rule.REFERENCE).sum() > 0.8 * target.target.sum()


def test_the_papers_transfer_samples_the_views_own_pixels(reference: Reference) -> None:
    target = view(reference, 2)
    sampled = propagate(reference, [target], PropagateSettings(transfer="sample")).views[0]
    carried = propagate(reference, [target]).views[0]
    own = (sampled.rules == Rule.OWN_PIXELS) & (carried.rules == Rule.OWN_PIXELS)
    true = whole(target.camera)[0]
    errors = [np.abs(p.raw[own].astype(float) - true[own]).mean() for p in (carried, sampled)]
    assert errors[0] < errors[1]  # the sources here are 30 px off: only the change between views may be taken


def test_blending_takes_no_boundary_across_a_depth_seam() -> None:
    base = np.full((30, 40, 3), 100, np.uint8)
    base[:, 20:] = 250  # a nearer thing on the right
    depth = np.full((30, 40), 4.0)
    depth[:, 20:] = 2.0
    painted = np.zeros((30, 40), bool)
    painted[8:22, 8:20] = True
    raw = np.full((30, 40, 3), 60.0, np.float32)
    blended = blend(base, raw, painted, np.zeros_like(painted), depth, PropagateSettings())
    assert (blended[painted] == 100).all() and (blended[~painted] == base[~painted]).all()
