"""What stays open after a reference was completed, and what is drawn anew then."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import cv2
import numpy as np
from scenes import BLOCK, REGION, cameras, charted, floor, floor_colours, scene
from scenes import discs as discs_on

from gimp3d.gaussians import Gaussians
from gimp3d.geometry import window_mask
from gimp3d.raster import footprint, render_bytes, surface_depth, touched_window
from gimp3d.stages.masks import ViewMasks
from gimp3d.stages.propagate import Rule
from gimp3d.steps.carrying import MARGIN, redrawn, still_open


@cache
def view() -> ViewMasks:
    """A view of the block; T is the hole in the floor under it, and the margin."""
    seen = max(charted(scene(), REGION, cameras(9, 160, 120)).masks.views, key=lambda v: int(v.target.sum()))
    depth, alpha = surface_depth(floor(with_hole=True), seen.camera)
    emptied = replace(seen, depth_after=depth, alpha_after=alpha)
    side = 2 * MARGIN + 1
    return replace(emptied, target=cv2.dilate(hole_of(emptied).astype(np.uint8), np.ones((side, side), np.uint8)) > 0)


def hole_of(seen: ViewMasks) -> np.ndarray:
    return seen.polygon & (seen.alpha_after < 0.5)


def floor_at_pixels() -> np.ndarray:
    """[H, W, 3]: the point of the floor z = 0 that each pixel shows."""
    camera = view().camera
    rays = camera.unproject(camera.pixel_centres(), np.ones((camera.height, camera.width))) - camera.centre
    return camera.centre + rays * (-camera.centre[2] / rays[..., 2])[..., None]


def patch(least_x: float = -BLOCK / 2) -> Gaussians:
    """The floor under the block, from an x on."""
    step = 0.02
    grid = np.arange(-BLOCK / 2, BLOCK / 2 + 1e-6, step)
    points = np.stack(
        [
            *(g.ravel() for g in np.meshgrid(grid[grid >= least_x], grid)),
        ],
        -1,
    )
    points = np.concatenate([points, np.zeros((len(points), 1))], 1)
    return discs_on(points, (0, 0, 1), floor_colours(points), 0.7 * step)


def opened(new: Gaussians, rules: np.ndarray) -> ViewMasks:
    camera = view().camera
    touched = window_mask(touched_window(new, camera), camera)
    return still_open(view(), floor(with_hole=True).extended(new), len(new), rules, touched)


def told() -> np.ndarray:
    return np.where(view().target, Rule.OWN_PIXELS, Rule.UNTOUCHED).astype(np.uint8)


def test_a_hole_that_is_covered_and_coloured_is_closed_with_its_margin() -> None:
    new = patch()
    filled = floor(with_hole=True).extended(new)
    rows = np.arange(len(filled)) >= len(filled) - len(new)
    margin = view().target & (footprint(filled, view().camera, rows) <= 0.5)
    assert margin.any()  # coverage alone would not close it
    after = opened(new, told())
    assert not after.target.any()
    depth, alpha = surface_depth(filled, view().camera)
    np.testing.assert_array_equal(after.depth_after, depth)
    np.testing.assert_array_equal(after.alpha_after, alpha)
    np.testing.assert_array_equal(after.depth_before, view().depth_before)


def test_what_the_new_surface_does_not_cover_stays_open() -> None:
    after, x = opened(patch(least_x=0.0), told()), floor_at_pixels()[..., 0]
    assert not (after.target & ~view().target).any()
    inside = np.abs(floor_at_pixels()[..., :2]).max(-1) < 0.8 * BLOCK / 2  # away from the floor round the hole
    missing, covered = (view().target & inside & side for side in (x < -0.06, x > 0.06))
    assert missing.sum() > 50 and after.target[missing].all()
    assert covered.sum() > 50 and not after.target[covered].any()


def test_covered_pixels_that_got_no_colour_stay_open() -> None:
    in_hole = hole_of(view())
    rows, cols = np.nonzero(in_hole)
    square = np.zeros_like(in_hole)
    middle = len(rows) // 2
    square[rows[middle] - 4 : rows[middle] + 4, cols[middle] - 4 : cols[middle] + 4] = True
    square &= in_hole
    after = opened(patch(), np.where(square, np.uint8(Rule.UNREACHED), told()))
    assert square.sum() > 30
    np.testing.assert_array_equal(after.target, square)


def test_nothing_new_leaves_the_hole_as_it_was() -> None:
    far = patch()
    far = replace(far, means=far.means + np.float32([0, 0, -50]))  # below the floor, seen through the hole
    after = opened(far, told())
    hole = hole_of(view())
    assert after.target[hole].mean() > 0.95


def test_gaps_that_were_no_target_are_drawn_from_the_filled_scene() -> None:
    camera = view().camera
    grey = np.full((camera.height, camera.width, 3), 128, np.uint8)
    gap = np.zeros((camera.height, camera.width), bool)
    gap[40:45, 50:60] = True
    one = replace(
        view(),
        silhouette=gap | view().silhouette,
        target=view().target & ~gap,
        alpha_after=np.where(gap | view().target, np.float32(0.5), np.float32(1.0)),
    )
    filled, everywhere, elsewhere = floor(with_hole=False), np.s_[:, :], np.s_[60:, :]
    done = redrawn(grey, filled, one, everywhere)
    np.testing.assert_array_equal(done[gap], render_bytes(filled, camera)[gap])
    np.testing.assert_array_equal(done[~gap], grey[~gap])
    assert (done[gap] != 128).any()
    assert redrawn(grey, filled, one, elsewhere) is grey


def test_views_without_gaps_are_not_drawn_anew() -> None:
    camera = view().camera
    solid = replace(view(), alpha_after=np.ones_like(view().alpha_after))
    grey = np.full((camera.height, camera.width, 3), 128, np.uint8)
    assert redrawn(grey, floor(with_hole=False), solid, np.s_[:, :]) is grey
