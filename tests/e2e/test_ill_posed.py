"""METHOD section 8, row by row: what must happen where a removal is ill-posed. A test's ID begins with its row's words.

Most rows run through the command line on small made scenes. What other modules test at their own level already is named
in `ELSEWHERE` and must exist there. A case that does not meet the table yet is an xfail that says what is missing.
"""

from __future__ import annotations

import ast
import errno
import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from plyfile import PlyData
from scenes import REGION, block, cameras, discs, scene, truth

from gimp3d import pipeline
from gimp3d.box import Box, Region
from gimp3d.camera import Camera, Distortion
from gimp3d.cli import Reporter, main
from gimp3d.gaussians import SH_C0, Gaussians
from gimp3d.io.cameras import write_transforms
from gimp3d.io.images import write_png
from gimp3d.io.ply import SplatFile, read_ply, write_gaussians
from gimp3d.orbit import look_at
from gimp3d.pipeline import render_bytes
from gimp3d.raster import footprint, render
from gimp3d.solvers.harmonics import sh_basis
from gimp3d.stages.mapping import mapping_field
from gimp3d.stages.masks import find_masks
from gimp3d.stages.reference import choose_reference

ROOT = Path(__file__).resolve().parents[2]
METHOD = ROOT.parent / "shared" / "METHOD.md"
UP = np.array([0, 0, 1.0])
RED = np.array([0.85, 0.12, 0.1])  # the block's colour, which no fill may have

# METHOD section 8, word for word
EMPTY = "T empty / nothing selected"
NO_USE = "everything selected, ROI behind every camera, no usable view"
NO_RIM = "T touches the border / covers the image / has a component with no boundary / encloses islands"
TINY = "T of 1–4 px, T or image smaller than a patch"
NO_SOURCE = "no source pixels, constant texture"
BAD_PRIOR = "prior constant / NaN / inverted / unrelated; ring < 10 px or zero variance"
BAD_DEPTH = "depth 0 / NaN / sky; disparity ≤ 0 after the solve"
JUMP = "large disparity jump on the ring, thin structures across the hole"
CAMERA_INSIDE = "camera inside ROI; ROI partly behind the camera"
BLIND_REFERENCE = "reference does not see ROI, or sees it behind an occluder"
FEW_DIRECTIONS = "one view only; duplicate or collinear directions; all weights zero"
BAD_ROWS = "Gaussians with NaN/inf, zero quaternions, ±inf logits, underflowing scales"
MIXED_VIEWS = "views of mixed size and intrinsics; portrait; odd sizes; lens shift; pixel aspect"
OTHER_LENSES = "distorted / fisheye / orthographic / panoramic cameras"
EXPOSURE = "exposure differs between views"
SHADOW = "shadow and reflection of the object outside R"
BLENDER = "Blender object with scale/rotation; negative or non-uniform scale"
BREAKDOWN = "out of memory, cancel, crash, disk full"
AGAIN = "run again on its own output; overlapping ROIs"

ELSEWHERE = {
    EMPTY: {"e2e/test_command_line.py": ["test_an_empty_region_changes_no_byte_and_warns"]},
    NO_USE: {
        "e2e/test_command_line.py": ["test_bad_input_gives_one_line_the_right_code_and_no_output"],
        "core/stages/test_masks.py": ["test_nothing_selected_everything_selected_no_view_and_unknown_mode"],
    },
    NO_RIM: {
        "core/stages/test_depth.py": [
            "test_a_hole_at_the_border_is_natural_there",
            "test_a_hole_that_covers_the_image_is_refused",
            "test_a_part_without_a_rim_takes_the_nearest_depth_with_low_confidence",
            "test_a_part_without_a_rim_takes_the_aligned_prior",
            "test_islands_are_boundary",
        ],
        "core/priors/test_inpaint.py": ["test_exemplar_fills_holes_at_the_border_with_islands_and_in_many_parts"],
    },
    TINY: {
        "core/stages/test_depth.py": [
            "test_holes_of_one_to_four_pixels_are_interpolated",
            "test_images_smaller_than_the_ring_are_completed",
        ],
        "core/priors/test_inpaint.py": [
            "test_specks_are_interpolated",
            "test_pictures_smaller_than_a_patch_are_filled",
        ],
    },
    NO_SOURCE: {
        "core/stages/test_mapping.py": ["test_a_reference_that_is_all_hole_maps_nothing_and_says_so"],
        "core/stages/test_propagate.py": ["test_without_sources_the_warped_reference_is_used"],
    },
    BAD_PRIOR: {
        "core/stages/test_depth.py": [
            "test_a_useless_prior_leaves_the_completion_unguided",
            "test_a_ring_of_fewer_than_ten_pixels_measures_nothing",
            "test_a_prior_on_a_flat_ring_says_nothing",
            "test_gaps_in_the_prior_do_not_spread",
        ]
    },
    BAD_DEPTH: {
        "core/stages/test_depth.py": [
            "test_pixels_without_a_depth_are_not_known",
            "test_sky_stays_infinitely_far",
            "test_disparities_outside_the_rings_range_are_clamped_and_counted",
        ]
    },
    JUMP: {"core/stages/test_depth.py": ["test_an_occluder_on_the_rim_does_not_smear"]},
    CAMERA_INSIDE: {
        "core/stages/test_masks.py": [
            "test_cameras_inside_the_region_are_left_out",
            "test_a_box_partly_behind_a_camera",
        ],
        "core/stages/test_outline.py": ["test_a_box_partly_behind_the_camera_is_clipped_not_mirrored"],
    },
    BLIND_REFERENCE: {"core/stages/test_reference.py": ["test_a_wanted_view_is_taken_unless_it_does_not_see_the_hole"]},
    FEW_DIRECTIONS: {
        "core/solvers/test_harmonics.py": ["test_ill_posed_observations_leave_the_reference_colour_alone"],
        "core/stages/test_seed.py": ["test_one_view_gives_sh_degree_zero"],
    },
    BAD_ROWS: {
        "core/raster/test_raster_robustness.py": ["test_odd_rows_are_ignored_as_usable_says_and_harm_nothing"],
        "core/io/test_ply.py": ["test_a_new_gaussian_that_is_not_finite_is_never_written"],
        "core/stages/test_selection.py": ["test_unusable_rows_are_never_removed_and_never_counted"],
    },
    MIXED_VIEWS: {
        "core/stages/test_masks.py": ["test_views_of_mixed_sizes_and_intrinsics"],
        "core/raster/test_raster_render.py": ["test_pixel_centres_lie_at_one_half"],
        "core/test_camera.py": ["test_the_centre_of_pixel_zero_is_half", "test_scaling_moves_pixels_with_the_size"],
        "addon/test_addon_user_actions.py": ["test_a_camera_is_exact_to_a_thousandth_pixel"],
    },
    OTHER_LENSES: {
        "core/io/test_cameras.py": [
            "test_photos_are_undistorted_to_the_same_pinhole",
            "test_bad_camera_files_are_refused_in_one_line",
        ],
        "addon/test_bridge.py": ["test_cameras_without_perspective_are_refused_by_name"],
    },
    EXPOSURE: {"core/stages/test_propagate.py": ["test_exposure_of_the_view_is_met"]},
    BLENDER: {
        "addon/test_remove.py": ["test_a_rotated_and_scaled_splat_object_gives_the_same_rows_and_pixels"],
        "addon/test_bridge.py": [
            "test_uneven_or_mirrored_splat_objects_are_refused",
            "test_a_cube_is_the_same_points_in_the_splats_frame",
        ],
        "core/test_box.py": ["test_a_matrix_and_its_box_hold_the_same_points"],
    },
    BREAKDOWN: {
        "e2e/test_command_line.py": [
            "test_an_interrupted_run_ends_with_130_and_leaves_nothing",
            "test_an_output_that_cannot_be_written_is_one_line",
        ],
        "core/test_job.py": ["test_a_failing_write_leaves_the_old_file_and_nothing_else"],
        "addon/test_remove.py": ["test_a_cancelled_worker_ends_at_once", "test_a_killed_worker_says_so"],
    },
    AGAIN: {
        "e2e/test_command_line.py": ["test_running_again_on_the_result_works"],
        "core/stages/test_masks.py": ["test_running_again_on_the_result_is_calm"],
        "core/stages/test_selection.py": ["test_overlapping_boxes_are_their_union"],
    },
}
HERE: list[str] = []  # the rows that have a test in this module, filled by `row`


def row(words: str, *cases: Any) -> Any:
    """Runs a test once per case of a row; a case is a word or a pytest.param with an ID."""
    HERE.append(words)
    params = [c if hasattr(c, "values") else pytest.param(c, id=str(c)) for c in cases or ("",)]
    named = [pytest.param(*p.values, marks=p.marks, id=f"{words}: {p.id}" if p.id else words) for p in params]
    return pytest.mark.parametrize("case", named)


def missing(case: str, reason: str) -> Any:
    """A case that does not meet the table yet."""
    return pytest.param(case, id=case, marks=pytest.mark.xfail(strict=True, reason=reason))


@dataclass(frozen=True)
class Removal:
    """What `gimp3d remove` did."""

    folder: Path
    code: int
    errors: list[str]  # lines on stderr

    @property
    def summary(self) -> dict[str, Any]:
        return json.loads((self.folder / "summary.json").read_text())

    @property
    def before(self) -> SplatFile:
        return read_ply(self.folder / "scene.ply")

    @property
    def after(self) -> SplatFile:
        return read_ply(self.folder / "out.ply")

    @property
    def added(self) -> Gaussians:
        count = self.summary["counts"]["added"]
        return self.after.gaussians.take(np.arange(len(self.after.gaussians))[-count or len(self.after.gaussians) :])

    def stage(self, name: str) -> dict[str, Any]:
        return next(s for s in self.summary["stages"] if s["name"] == name)

    @property
    def words(self) -> str:
        """All that it said."""
        return " | ".join([*self.summary["warnings"], *(s["reason"] for s in self.summary["stages"])])


Remove = Callable[..., Removal]


@pytest.fixture
def remove(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Remove:
    """Writes a scene's files, changes them where the test wants to, and runs the command."""

    def run(
        gaussians: Gaussians | None = None,
        views: Sequence[Camera] = (),
        region: Region = REGION,
        options: Sequence[object] = (),
        photo: Callable[[Camera], np.ndarray] | None = None,  # None: views are rendered from the scene
        change: Callable[[Path], None] = lambda folder: None,
        folder: str = "scene",
    ) -> Removal:
        place = tmp_path / folder
        place.mkdir(exist_ok=True)
        write_gaussians(place / "scene.ply", scene() if gaussians is None else gaussians)
        write_transforms(place / "cameras.json", views or cameras())
        (place / "roi.json").write_text(json.dumps([b.to_json() for b in region]))
        if photo:
            for camera in views or cameras():
                write_png(place / f"{camera.id}.png", photo(camera))
        change(place)
        capsys.readouterr()
        options = options if photo else ("--images", "none", *options)
        code = main([str(a) for a in command(place, options)])
        return Removal(place, code, capsys.readouterr().err.strip().splitlines())

    return run


def command(folder: Path, options: Sequence[object]) -> list[object]:
    cams, roi, out = folder / "cameras.json", folder / "roi.json", folder / "out.ply"
    files = ["remove", folder / "scene.ply", "--cameras", cams, "--roi", roi, "--out", out]
    return [*files, "--summary", folder / "summary.json", "--progress", "none", *options]


def assert_refused(removal: Removal, words: str, code: int = 3) -> None:
    """One line that says why, and no output."""
    assert removal.code == code
    assert len(removal.errors) == 1 and removal.errors[0].startswith("gimp3d: error: "), removal.errors
    assert words in removal.errors[0]
    assert not (removal.folder / "out.ply").exists() and not (removal.folder / "summary.json").exists()


def assert_filled(removal: Removal, true: Gaussians, views: Sequence[Camera] = (), psnr: float = 36.0) -> None:
    """Nearly the true picture, from the views of the command line's own test unless others are given."""
    assert removal.code == 0, removal.errors
    result = removal.after.gaussians
    for camera in views or cameras(4):
        error = render_bytes(result, camera).astype(float) - render_bytes(true, camera)
        assert 10 * np.log10(255**2 / (error**2).mean()) > psnr, camera.id


def assert_legal(removal: Removal) -> None:
    """New Gaussians can be drawn, and none has the object's colour."""
    assert removal.code == 0, removal.errors
    added = removal.added
    assert len(added) > 0 and added.usable.all() and np.isfinite(added.opacity_logits).all()
    assert (np.abs(0.5 + SH_C0 * added.sh[:, 0] - RED).max(1) > 0.1).all()


# ---------------------------------------------------------------------------------------------------------- the rows


@row(EMPTY, "nothing selected", "T empty")
def test_nothing_to_do_is_a_no_op_with_a_warning(case: str, remove: Remove) -> None:
    if case == "nothing selected":
        done = remove(region=(Box.make([0, 0, 50], [1, 1, 1]),))
        assert (done.folder / "out.ply").read_bytes() == (done.folder / "scene.ply").read_bytes()
        assert "nothing to remove" in done.errors[0]
        return
    assert case == "T empty"
    above = block()
    above.means[:, 2] += 1.0  # every view sees past it what another hides
    done = remove(truth().extended(above), cameras(12), (Box.make([0, 0, 1.26], [0.62, 0.62, 0.56]),))
    assert done.code == 0 and "nothing to fill" in done.errors[0]
    assert done.after.table.rows.tobytes() == done.before.table.rows[: len(truth())].tobytes()


def turned_away(camera: Camera) -> Camera:
    return replace(camera, viewmat=np.diag([-1.0, 1, -1, 1]) @ camera.viewmat)


def camera_at(name: str, eye: Sequence[float], target: Sequence[float], focal: float = 110) -> Camera:
    return Camera(name, 120, 90, focal, focal, 60, 45, look_at(np.array(eye, float), np.array(target, float), UP))


@row(NO_USE, "everything selected", "ROI behind every camera", "no usable view")
def test_what_cannot_be_done_is_refused_with_the_reason(case: str, remove: Remove) -> None:
    if case == "everything selected":
        assert_refused(remove(region=(Box.make([0, 0, 0], [99, 99, 99]),)), "whole scene")
    elif case == "ROI behind every camera":
        assert_refused(remove(views=[turned_away(c) for c in cameras()]), "no usable view")
    else:
        assert case == "no usable view"
        inside = [camera_at(f"inside{k}", (0.1 * k, 0, 0.3), (1, 1, 0)) for k in range(3)]
        assert_refused(remove(views=inside), "3 are inside the ROI")


def zoomed(camera: Camera, factor: float) -> Camera:
    return replace(camera, fx=factor * camera.fx, fy=factor * camera.fy)


@row(NO_RIM, "touches the border", "covers an image", "covers every image", "a component with no boundary", "islands")
def test_holes_without_a_whole_rim(case: str, remove: Remove) -> None:
    if case == "touches the border":
        shifted = [replace(c, cx=c.cx - 55) for c in cameras()]
        masks = find_masks(scene(), REGION, shifted)
        assert all(v.target[:, 0].any() for v in masks.views)
        assert_filled(remove(views=shifted), truth())
    elif case == "covers an image":
        close = zoomed(replace(cameras()[8], id="close"), 6)
        (view,) = (v for v in find_masks(scene(), REGION, [*cameras(), close]).views if v.camera is close)
        assert view.target.all()
        assert_filled(remove(views=[*cameras(), close]), truth())
    elif case == "covers every image":
        assert_refused(remove(views=[zoomed(c, 6) for c in cameras()]), "add views")
    elif case == "a component with no boundary":
        # A second block beyond the floor's edge, framed tightly: nothing is known round it.
        far = block()
        far.means[:, 0] += 3.0
        region = (*REGION, Box.make([3, 0, 0.26], [0.62, 0.62, 0.56]))
        assert_filled(remove(scene().extended(far), region=region), truth())
    else:
        assert case == "islands"
        whole, boxes = floor_with_a_frame()
        views = cameras(9, 240, 180)
        parts = [
            cv2.connectedComponents((~v.target).astype(np.uint8), connectivity=4)[0]
            for v in find_masks(whole, boxes, views).views
        ]
        assert max(parts) == 3  # T itself, what is round it, and the island
        assert_filled(remove(whole, views, boxes), truth())


def floor_with_a_frame(inner: float = 0.3, outer: float = 0.55, height: float = 0.15) -> tuple[Gaussians, Region]:
    """A red square frame lying on the floor, and boxes round its sides."""
    step = 0.03

    def red(points: np.ndarray, normal: tuple[float, float, float]) -> Gaussians:
        return discs(points, normal, np.tile(RED, (len(points), 1)), 0.7 * step)

    whole = truth()
    reach = np.abs(whole.means[:, :2]).max(1)
    whole = whole.take((reach > outer) | (reach < inner))
    along = np.arange(-outer, outer + 1e-6, step)
    top = np.stack([*(g.ravel() for g in np.meshgrid(along, along, height))], -1)
    whole = whole.extended(red(top[np.abs(top[:, :2]).max(1) >= inner], (0, 0, 1)))
    for side in (-outer, -inner, inner, outer):
        along = np.arange(-abs(side), abs(side) + 1e-6, step)
        wall = np.stack([*(g.ravel() for g in np.meshgrid(side, along, np.arange(0, height, step)))], -1)
        whole = whole.extended(red(wall, (1, 0, 0))).extended(red(wall[:, [1, 0, 2]], (0, 1, 0)))
    middle, wide, long = (inner + outer) / 2, outer - inner + 0.04, 2 * outer + 0.04
    boxes = [Box.make([x, 0, 0.08], [wide, long, 0.2]) for x in (-middle, middle)]
    boxes += [Box.make([0, y, 0.08], [long, wide, 0.2]) for y in (-middle, middle)]
    return whole, tuple(boxes)


@row(
    TINY,
    "T of a few pixels",
    "an image of 12×9 pixels",
    "a patch larger than the image",
)
def test_the_smallest_holes_and_pictures(case: str, remove: Remove) -> None:
    if case == "T of a few pixels":
        done = remove(views=[zoomed(c, 0.05) for c in cameras()])
        assert_legal(done)
    elif case == "an image of 12×9 pixels":
        assert_legal(remove(views=[c.scaled(0.1) for c in cameras()]))
    else:
        assert case == "a patch larger than the image"
        image = np.random.default_rng(0).integers(0, 255, (4, 5, 3), dtype=np.uint8)
        hole = np.zeros((4, 5), bool)
        hole[1, 2] = True
        found = mapping_field(image, hole, ~hole, np.ones((4, 5), np.float32))
        assert np.isfinite(found.confidence) and (found.rows[~hole] == -1).all()
        assert not hole[found.rows[1, 2], found.cols[1, 2]] or found.rows[1, 2] == -1


@row(NO_SOURCE, "constant texture", "ties")
def test_a_constant_texture_is_continued_the_same_way_every_time(case: str, remove: Remove) -> None:
    if case == "constant texture":
        plain = scene()
        red = (np.abs(0.5 + SH_C0 * plain.sh[:, 0] - RED) < 0.01).all(1)
        plain.sh[~red, 0] = 0.1
        runs = [remove(plain, options=("--preset", "draft"), folder=name) for name in ("first", "second")]
        colours = 0.5 + SH_C0 * runs[0].added.sh[:, 0]
        assert len(colours) and np.abs(colours - (0.5 + SH_C0 * 0.1)).max() < 2 / 255
        assert (runs[0].folder / "out.ply").read_bytes() == (runs[1].folder / "out.ply").read_bytes()
        return
    assert case == "ties"
    hole = np.zeros((40, 50), bool)
    hole[12:26, 15:33] = True
    image = np.full((40, 50, 3), 90, np.uint8)
    fields = [mapping_field(image, hole, ~hole, np.ones((40, 50), np.float32)) for _ in range(2)]
    rows, cols = np.nonzero(hole)
    offsets = np.stack([fields[0].rows[hole] - rows, fields[0].cols[hole] - cols], -1)
    picture = np.zeros((40, 50, 2), int)
    picture[hole] = offsets
    same = (picture[:, 1:] == picture[:, :-1]).all(-1)[hole[:, 1:] & hole[:, :-1]]
    assert (fields[0].rows == fields[1].rows).all() and (fields[0].cols == fields[1].cols).all()
    assert same.mean() > 0.5  # whole patches are copied, not single pixels from everywhere


def prior_of(kind: str, camera: Camera) -> np.ndarray:
    """A useless relative disparity of a view; `true` is right."""
    depth = render(truth(), camera).median_depth
    true = np.where(depth > 0, 1 / np.where(depth > 0, depth, 1), 0)
    if kind == "NaN round the hole":
        (view,) = (v for v in find_masks(scene(), REGION, cameras()).views if v.camera.id == camera.id)
        return np.where(cv2.dilate(view.target.astype(np.uint8), np.ones((61, 61), np.uint8)) > 0, np.nan, true)
    noise = np.random.default_rng(0).normal(size=true.shape)
    return {"constant": np.full_like(true, 2), "inverted": -true, "unrelated": noise, "true": true}[kind]


@row(
    BAD_PRIOR,
    "constant",
    "NaN round the hole",
    "inverted",
    "unrelated",
    "of another view",
)
def test_a_useless_prior_is_not_used_and_that_is_said(case: str, remove: Remove, tmp_path: Path) -> None:
    reference = cameras()[1]
    kind = "true" if case == "of another view" else case
    np.save(tmp_path / "prior.npy", prior_of(kind, reference).astype(np.float32))
    options = ("--reference", reference.id, "--depth-prior", f"file:{tmp_path / 'prior.npy'}")
    views = list(cameras())
    if case == "of another view":  # the first reference shows half of the hole, so that there is a second one
        views[1] = reference = replace(reference, cx=reference.cx - 60)
        np.save(tmp_path / "prior.npy", prior_of(kind, reference).astype(np.float32))
    done = remove(views=views, options=options)
    depth = done.stage("depth")
    if case == "of another view":
        assert depth["reason"].startswith("guided")
        others = [s for s in done.summary["stages"] if re.fullmatch(r"depth \d", s["name"])]
        assert others and not any("prior" in s["reason"] or "guided" in s["reason"] for s in others)
        return
    assert "prior" in depth["reason"] and "guided" not in depth["reason"]
    assert depth["confidence"] <= 0.3 or "planar" in depth["reason"]  # planes may still say what the prior cannot
    assert_filled(done, truth())


@row(
    BAD_DEPTH,
    missing(
        "the floor ends beside the object", "a chart's edge beside the hole is placed by the nearest texels: 32 dB"
    ),
    "a sky of splats",
)
def test_the_far_and_the_void_are_no_surface(case: str, remove: Remove) -> None:
    if case == "the floor ends beside the object":
        whole, true = (g.take(g.means[:, 0] > -0.4) for g in (scene(), truth()))
    else:
        assert case == "a sky of splats"
        rng = np.random.default_rng(0)
        directions = rng.normal(size=(3000, 3))
        points = 60 * directions / np.linalg.norm(directions, axis=1, keepdims=True)
        sky = discs(points, (0, 0, 1), np.tile([0.5, 0.7, 0.95], (len(points), 1)), 4.0)
        sky.log_scales[:] = np.log(4.0)
        whole, true = scene().extended(sky), truth().extended(sky)
    done = remove(whole)
    assert np.abs(done.added.means[:, 2]).max() < 0.05  # on the floor, not halfway to the sky
    assert_filled(done, true, psnr=34)  # a fringe of a pixel at the floor's edge takes the void's colour


@row(JUMP, "a rod before the hole is not filled", "nor painted elsewhere")
def test_what_stands_before_the_hole_stays_alone(case: str, remove: Remove) -> None:
    points = np.stack([np.full(60, 0.55), np.zeros(60), np.linspace(0, 1.2, 60)], -1)
    rod = discs(points, (1, 0, 0), np.tile([0.1, 0.2, 0.9], (60, 1)), 0.03)
    views, whole, true = cameras(9, 240, 180), scene().extended(rod), truth().extended(rod)
    on_rod = {c.id: footprint(whole, c, np.arange(len(whole)) >= len(scene())) > 0.6 for c in views}
    assert sum(m.sum() for m in on_rod.values()) > 1000
    if case == "a rod before the hole is not filled":
        for view in find_masks(whole, REGION, views).views:
            assert not (view.target & on_rod[view.camera.id]).any(), view.camera.id
        return
    assert case == "nor painted elsewhere"
    result = remove(whole, views).after.gaussians
    for camera in views:
        error = np.abs(render_bytes(result, camera).astype(float) - render_bytes(true, camera)).max(-1)
        assert (error > 80).sum() < 10, camera.id  # the rod's blue is 150 grey levels off the floor's colours


@row(CAMERA_INSIDE, "camera inside ROI", "ROI partly behind the camera")
def test_cameras_in_and_at_the_region(case: str, remove: Remove) -> None:
    if case == "camera inside ROI":
        done = remove(views=[*cameras(), camera_at("inside", (0.1, 0, 0.2), (1, 1, 1))])
        assert any(w.startswith("1 views do not frame the region or lie inside it") for w in done.summary["warnings"])
        assert done.summary["counts"]["views"] == 9
    else:
        assert case == "ROI partly behind the camera"
        beside = camera_at("beside", (0.45, 0, 0.4), (0.45, 0.9, 0.1), 60)
        corners = beside.to_camera(REGION[0].corners())[:, 2]
        assert corners.min() < 0 < corners.max()
        done = remove(views=[*cameras(), beside])
        assert done.summary["counts"]["views"] == 10
    assert_filled(done, truth())


def wall_before(camera: Camera, half: float = 0.5, step: float = 0.05) -> Gaussians:
    """A grey wall between a camera and the block, across its view."""
    along = np.arange(-half, half + 1e-6, step)
    a, b = (g.ravel() for g in np.meshgrid(along, along))
    middle = camera.centre + 0.4 * (REGION[0].center - camera.centre)
    points = middle + a[:, None] * camera.R[0] + b[:, None] * camera.R[1]
    wall = discs(points, (0, 0, 1), np.full((len(points), 3), 0.4), 0.7 * step)
    wall.log_scales[:] = np.log(0.7 * step)
    return wall


@row(BLIND_REFERENCE, "does not see ROI", "behind an occluder", "chosen behind an occluder")
def test_a_reference_that_does_not_see_the_hole_is_rejected(case: str, remove: Remove) -> None:
    if case == "does not see ROI":
        away = turned_away(replace(cameras()[0], id="away"))
        assert_refused(remove(views=[*cameras(), away], options=("--reference", "away")), "away does not see")
        return
    best = choose_reference(find_masks(scene(), REGION, cameras()).views).camera_id
    (camera,) = (c for c in cameras() if c.id == best)
    blocked = scene().extended(wall_before(camera))
    if case == "behind an occluder":
        assert_refused(remove(blocked, options=("--reference", best)), f"{best} does not see")
        return
    assert case == "chosen behind an occluder"
    done = remove(blocked, options=("--depth-prior", "planar"))  # a depth of its own needs a photo as reference
    assert not done.stage("reference")["reason"].startswith(best)
    assert_filled(done, truth().extended(wall_before(camera)))


@row(FEW_DIRECTIONS, "one view only", "duplicates of one view", "duplicates of two views", "views in a line")
def test_colours_from_few_directions_stay_bounded(case: str, remove: Remove) -> None:
    views = {
        "one view only": cameras()[1:2],
        "duplicates of one view": [replace(cameras()[1], id=f"same{k}") for k in range(5)],
        "duplicates of two views": [replace(cameras()[1 + k % 2], id=f"pair{k}") for k in range(6)],
        "views in a line": [camera_at(f"line{k}", (1.6, -0.6 + 0.15 * k, 1.2), (0, 0, 0)) for k in range(9)],
    }[case]
    whole = replace(scene(), sh=np.pad(scene().sh, ((0, 0), (0, 8), (0, 0))))  # of degree 2
    done = remove(whole, views, options=("--set", "seed.sh_degree=2", "--preset", "draft"))
    added = done.added
    if case in ("one view only", "duplicates of one view"):
        assert np.abs(added.sh[:, 1:]).max() < 1e-6  # c_0 alone
    directions = np.random.default_rng(0).normal(size=(200, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    everywhere = 0.5 + np.einsum("dk,nkc->ndc", sh_basis(directions, 2), added.sh.astype(float))
    from_reference = 0.5 + SH_C0 * added.sh[:, :1]
    assert np.median(np.abs(everywhere - from_reference).max((1, 2))) < 0.15
    assert np.abs(everywhere - from_reference).max() < 1.0


@row(BAD_ROWS)
def test_broken_gaussians_stay_as_they_are_and_harm_nothing(case: str, remove: Remove) -> None:
    means = scene().means
    inside = np.flatnonzero((np.abs(means[:, :2]) < 0.2).all(1) & (means[:, 2] > 0.1))[:6]
    outside = np.flatnonzero(np.abs(means[:, 0]) > 1)[:6]

    def spoil(folder: Path) -> None:
        file = PlyData.read(str(folder / "scene.ply"), mmap=False)
        vertex = file["vertex"].data
        for a, b, c, d, e, f in (inside, outside):
            vertex["x"][a], vertex["f_dc_1"][f] = np.nan, np.inf
            vertex["opacity"][c], vertex["opacity"][d], vertex["scale_0"][e] = np.inf, -np.inf, -200
            for k in range(4):
                vertex[f"rot_{k}"][b] = 0
        file.write(str(folder / "scene.ply"))

    done = remove(change=spoil)
    assert any(w.startswith("6 Gaussians hold NaN, infinity or a zero") for w in done.summary["warnings"])
    counts = done.summary["counts"]
    kept = done.after.table.rows[: counts["gaussians_in"] - counts["removed"]]
    remaining = {r.tobytes() for r in kept}
    broken = np.concatenate([inside[[0, 1, 5]], outside])
    assert all(done.before.table.rows[k].tobytes() in remaining for k in broken)
    assert_legal(done)
    assert_filled(done, truth())


@row(MIXED_VIEWS)
def test_views_of_any_size_and_lens_fill_the_same_hole(case: str, remove: Remove) -> None:
    a, b, c, d, e, *rest = cameras()
    views = [
        a.scaled(1.5),
        replace(b, width=90, height=120, cx=45, cy=60),
        replace(c, cx=c.cx + 9.3, cy=c.cy - 6.1),
        replace(d, fx=1.3 * d.fx),
        replace(e, width=119, height=91, cx=59.5, cy=45.5),
        *(v.scaled(0.77) for v in rest),
    ]
    done = remove(views=views)
    assert done.summary["counts"]["views"] == len(views)
    assert_filled(done, truth())
    assert_filled(done, truth(), views)


def distorted_photo(camera: Camera) -> np.ndarray:
    """What the camera's lens makes of the scene, sampled from a pinhole's larger picture."""
    margin = 40
    wide = replace(
        camera,
        width=camera.width + 2 * margin,
        height=camera.height + 2 * margin,
        cx=camera.cx + margin,
        cy=camera.cy + margin,
        distortion=None,
    )
    pixels = camera.pixel_centres().reshape(-1, 1, 2)
    rays = cv2.undistortPoints(pixels, camera.K, camera.distortion.coefficients).reshape(camera.height, camera.width, 2)
    u, v = np.moveaxis(rays * [wide.fx, wide.fy] + [wide.cx, wide.cy] - 0.5, -1, 0).astype(np.float32)
    return cv2.remap(render_bytes(scene(), wide), u, v, cv2.INTER_LINEAR)


@row(OTHER_LENSES, "distorted", "OPENCV_FISHEYE", "ORTHOGRAPHIC", "EQUIRECTANGULAR")
def test_lenses_are_exact_or_refused_by_name(case: str, remove: Remove) -> None:
    if case == "distorted":
        lens = Distortion(k1=-0.12, k2=0.03, p1=0.001, p2=-0.002)
        done = remove(views=[replace(c, distortion=lens) for c in cameras()], photo=distorted_photo)
        assert not any("missing" in w for w in done.summary["warnings"])
        assert_filled(done, truth())
        return

    def other_model(folder: Path) -> None:
        document = json.loads((folder / "cameras.json").read_text())
        (folder / "cameras.json").write_text(json.dumps({**document, "camera_model": case}))

    word = {"OPENCV_FISHEYE": "fisheye", "ORTHOGRAPHIC": "orthographic", "EQUIRECTANGULAR": "panoramic"}[case]
    assert_refused(remove(change=other_model), word, code=2)


@row(
    EXPOSURE,
    "photos 20 % brighter or darker than the splats",
)
def test_the_fill_has_the_exposure_of_what_is_round_it(case: str, remove: Remove) -> None:
    gains = {c.id: 1 + 0.2 * np.sin(2.1 * k) for k, c in enumerate(cameras())}
    done = remove(photo=lambda c: np.clip(gains[c.id] * render_bytes(scene(), c), 0, 255).astype(np.uint8))
    even = remove(photo=lambda c: render_bytes(scene(), c), folder="even").after.gaussians
    result = done.after.gaussians
    chosen = np.arange(len(result)) >= len(result) - done.summary["counts"]["added"]
    for camera in cameras(4):
        new = footprint(result, camera, chosen) > 0.9
        mean = render_bytes(result, camera)[new].mean() / render_bytes(even, camera)[new].mean()
        assert abs(mean - 1) < 0.02, camera.id


def with_shadow() -> Gaussians:
    """The scene with a dark place beside the block, baked into the floor as trainers do."""
    whole = scene()
    x, y, z = whole.means.T
    whole.sh[(np.hypot(x - 0.5, y) < 0.22) & (z < 0.02), 0] -= 1.0
    return whole


@row(
    SHADOW,
    "an extra ROI",
    "an extra mask",
    "reported",
)
def test_shadows_can_be_named_and_go(case: str, remove: Remove) -> None:
    dark = np.flatnonzero((with_shadow().sh[:, 0] != scene().sh[:, 0]).any(1))
    if case == "an extra mask":
        chosen = np.isin(np.arange(len(scene())), dark)
        extra = {c.id: footprint(with_shadow(), c, chosen) > 0.5 for c in cameras()}
        masks = find_masks(with_shadow(), REGION, cameras(), extra=extra)
        assert masks.removed[dark].mean() > 0.9
        assert all((v.target & extra[v.camera.id]).sum() > 0.9 * extra[v.camera.id].sum() for v in masks.views)
    elif case == "reported":
        # a dark place that the block does not cast: said not to be its shadow, and left as it is
        assert "no shadow found" in remove(with_shadow()).words
    else:
        assert case == "an extra ROI"
        done = remove(with_shadow(), region=(*REGION, Box.make([0.5, 0, 0], [0.46, 0.46, 0.1])))
        left = remove(with_shadow(), folder="without")
        assert_legal(done)
        pose = look_at(np.array([0.5, 0, 1.6]), np.array([0.5, 0, 0]), np.array([0, 1.0, 0]))
        above = Camera("above", 60, 60, 200, 200, 30, 30, pose)
        gone, kept, true = (
            render_bytes(g, above).mean() for g in (done.after.gaussians, left.after.gaussians, truth())
        )
        assert kept < 0.8 * true and abs(gone - true) < 0.1 * (true - kept)


STAGES = ("read", "masks", "charts", "appearance", "seed", "mapping", "propagate", "settle")
OLD = b"an older result"


def old_result(folder: Path) -> None:
    (folder / "out.ply").write_bytes(OLD)


def assert_as_before(folder: Path) -> None:
    assert (folder / "out.ply").read_bytes() == OLD
    assert {p.name for p in folder.iterdir()} == {"scene.ply", "cameras.json", "roi.json", "out.ply"}


@row(BREAKDOWN, "disk full", *(f"cancel, {stage}" for stage in STAGES))
def test_files_are_as_before_a_run_that_stops(case: str, remove: Remove, monkeypatch: pytest.MonkeyPatch) -> None:
    assert case == "disk full" or case.removeprefix("cancel, ") in STAGES

    def interrupt(reporter: Reporter, stage: str, *_: object) -> None:
        if stage == case.removeprefix("cancel, "):
            raise KeyboardInterrupt

    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    def prepare(folder: Path) -> None:
        old_result(folder)
        if case == "disk full":
            monkeypatch.setattr(os, "fsync", full)
        else:
            monkeypatch.setattr(Reporter, "__call__", interrupt)

    done = remove(change=prepare)
    code, words = (2, os.strerror(errno.ENOSPC)) if case == "disk full" else (130, "interrupted")
    assert done.code == code and len(done.errors) == 1 and words in done.errors[0]
    assert_as_before(done.folder)


def in_a_child(folder: Path, first: str, options: Sequence[object] = ()) -> subprocess.CompletedProcess[str]:
    """The command in a process of its own, which runs `first` before."""
    code = f"import sys; {first}; from gimp3d.cli import main; sys.exit(main(sys.argv[1:]))"
    arguments = [str(a) for a in command(folder, options)]
    return subprocess.run([sys.executable, "-c", code, *arguments], capture_output=True, text=True, timeout=120)


@row(BREAKDOWN, "crash")
def test_a_crashed_run_goes_on_where_it_was(case: str, remove: Remove, monkeypatch: pytest.MonkeyPatch) -> None:
    def again(*_: object) -> None:
        raise AssertionError("a finished stage ran again")

    undisturbed = remove(change=old_result)
    folder = undisturbed.folder
    expected = (folder / "out.ply").read_bytes()
    (folder / "summary.json").unlink()
    old_result(folder)
    job = folder.parent / "job"
    crash = "import os, gimp3d.filling as f; f.map_reference = lambda *a, **b: os._exit(9)"
    assert in_a_child(folder, crash, ("--job", job)).returncode == 9
    assert_as_before(folder)
    monkeypatch.setattr(pipeline, "find_masks", again)
    assert main([str(a) for a in command(folder, ("--job", job, "--resume"))]) == 0
    assert (folder / "out.ply").read_bytes() == expected


@row(BREAKDOWN, "out of memory")
def test_views_that_no_memory_holds_are_refused(case: str, remove: Remove) -> None:
    pytest.importorskip("resource", reason="this system knows no memory limits")
    folder = remove(change=old_result).folder
    (folder / "summary.json").unlink()
    old_result(folder)
    write_transforms(folder / "cameras.json", [c.scaled(80) for c in cameras()])
    limit = "import resource as r; r.setrlimit(r.RLIMIT_AS, (2 << 30, 2 << 30))"
    done = in_a_child(folder, limit)
    assert done.returncode == 3 and done.stderr.startswith("gimp3d: error: out of memory")
    assert len(done.stderr.splitlines()) == 1
    assert_as_before(folder)


@row(AGAIN, "run again", "overlapping ROIs")
def test_a_second_run_and_overlapping_boxes(case: str, remove: Remove) -> None:
    once = remove()
    if case == "overlapping ROIs":
        halves = (Box.make([-0.1, 0, 0.26], [0.42, 0.62, 0.56]), Box.make([0.1, 0, 0.26], [0.42, 0.62, 0.56]))
        both = remove(region=halves, folder="halves")
        assert_filled(both, truth())
        return
    assert case == "run again"

    def take_result(folder: Path) -> None:
        shutil.copy2(once.folder / "out.ply", folder / "scene.ply")

    twice = remove(change=take_result, folder="again")
    assert_filled(twice, truth(), psnr=32)  # the box cuts into the new floor: it is made up a second time


# ---------------------------------------------------------------------------------------------------- the whole table


@pytest.mark.parametrize("words", ELSEWHERE)
def test_other_tests_of_a_row_exist(words: str) -> None:
    for name, wanted in ELSEWHERE[words].items():
        found = {n.name for n in ast.walk(ast.parse((ROOT / "tests" / name).read_text())) if hasattr(n, "name")}
        assert not set(wanted) - found, f"{name} has no longer what {words!r} relies on"


def test_every_row_of_the_method_has_a_test() -> None:
    if not METHOD.is_file():
        pytest.skip("../shared/METHOD.md is not here")
    section = METHOD.read_text(encoding="utf-8").partition("## 8.")[2].partition("## 9.")[0]
    rows = [line.split("|")[1].strip() for line in section.splitlines() if line.startswith("|")][2:]
    assert set(rows) == {*HERE, *ELSEWHERE}
    assert set(rows) - set(HERE) == {BLENDER}  # tests/addon runs it, in Blender
