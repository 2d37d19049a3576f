"""What must happen where a removal is ill-posed: the table "Ill-posed cases" of docs/method.md, its rows in its order.

Through the command line, on small made scenes. Other cases of the rows stand where their stage is tested.
"""

from __future__ import annotations

import errno
import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from plyfile import PlyData
from removals import RED, Removal, Remove, assert_filled, assert_legal, assert_refused, command
from scenes import REGION, block, cameras, charted, discs, scene, truth

from gimp3d import pipeline
from gimp3d.box import Box, Region
from gimp3d.camera import Camera, Distortion
from gimp3d.cli import Reporter, main
from gimp3d.gaussians import SH_C0, Gaussians, sh_basis
from gimp3d.io.cameras import write_transforms
from gimp3d.orbit import look_at
from gimp3d.pipeline import render_bytes
from gimp3d.raster import footprint, render
from gimp3d.stages.masks import find_masks
from gimp3d.stages.propagate.paper import mapping_field
from gimp3d.stages.reference import choose_reference

UP = np.array([0, 0, 1.0])


def turned_away(camera: Camera) -> Camera:
    return replace(camera, viewmat=np.diag([-1.0, 1, -1, 1]) @ camera.viewmat)


def zoomed(camera: Camera, factor: float) -> Camera:
    return replace(camera, fx=factor * camera.fx, fy=factor * camera.fy)


def camera_at(name: str, eye: Sequence[float], target: Sequence[float], focal: float = 110) -> Camera:
    return Camera(name, 120, 90, focal, focal, 60, 45, look_at(np.array(eye, float), np.array(target, float), UP))


# T empty / nothing selected


def test_an_empty_region_changes_no_byte_and_warns(remove: Remove) -> None:
    done = remove(region=(Box.make([0, 0, 50], [1, 1, 1]),))
    assert (done.folder / "out.ply").read_bytes() == (done.folder / "scene.ply").read_bytes()
    assert "nothing to remove" in done.errors[0]


def test_an_object_that_hides_nothing_is_taken_out_and_nothing_filled(remove: Remove) -> None:
    above = block()
    above.means[:, 2] += 1.0  # every view sees past it what another hides
    done = remove(truth().extended(above), cameras(12), (Box.make([0, 0, 1.26], [0.62, 0.62, 0.56]),))
    assert done.code == 0 and "nothing to fill" in done.errors[0]
    assert done.after.table.rows.tobytes() == done.before.table.rows[: len(truth())].tobytes()


# Everything selected, ROI behind every camera, no usable view


def test_everything_selected_is_refused(remove: Remove) -> None:
    assert_refused(remove(region=(Box.make([0, 0, 0], [99, 99, 99]),)), "whole scene")


def test_a_region_behind_every_camera_is_refused(remove: Remove) -> None:
    assert_refused(remove(views=[turned_away(c) for c in cameras()]), "no usable view")


def test_views_that_all_lie_inside_the_region_are_refused(remove: Remove) -> None:
    inside = [camera_at(f"inside{k}", (0.1 * k, 0, 0.3), (1, 1, 0)) for k in range(3)]
    assert_refused(remove(views=inside), "3 are inside the ROI")


# T touches the border / covers the image / has a component with no boundary / encloses islands


def test_a_hole_at_the_border_is_filled(remove: Remove) -> None:
    shifted = [replace(c, cx=c.cx - 55) for c in cameras()]
    assert all(v.target[:, 0].any() for v in charted(scene(), REGION, shifted).masks.views)
    assert_filled(remove(views=shifted), truth())


def test_a_view_that_is_all_hole_is_filled_from_the_others(remove: Remove) -> None:
    close = zoomed(replace(cameras()[8], id="close"), 6)
    (view,) = (v for v in charted(scene(), REGION, [*cameras(), close]).masks.views if v.camera is close)
    assert view.silhouette.all() and view.target.any()
    assert_filled(remove(views=[*cameras(), close]), truth())


def test_views_that_are_all_hole_are_refused(remove: Remove) -> None:
    assert_refused(remove(views=[zoomed(c, 6) for c in cameras()]), "add views")


def test_a_part_of_the_hole_with_nothing_known_round_it_is_filled(remove: Remove) -> None:
    far = block()  # a second one beyond the floor's edge, framed tightly
    far.means[:, 0] += 3.0
    region = (*REGION, Box.make([3, 0, 0.26], [0.62, 0.62, 0.56]))
    assert_filled(remove(scene().extended(far), region=region), truth())


def test_a_hole_round_an_island_is_filled(remove: Remove) -> None:
    whole, boxes = floor_with_a_frame()
    views = cameras(9, 240, 180)
    outside = [(~v.target).astype(np.uint8) for v in charted(whole, boxes, views).masks.views]
    sizes = [cv2.connectedComponentsWithStats(o, connectivity=4)[2][1:, cv2.CC_STAT_AREA] for o in outside]
    assert max(int((s > 100).sum()) for s in sizes) == 2  # what is round T, and the island; single pixels are specks
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


# T of 1–4 px, T or image smaller than a patch


def test_a_hole_of_a_few_pixels_is_filled(remove: Remove) -> None:
    assert_legal(remove(views=[zoomed(c, 0.1) for c in cameras()]))


def test_views_of_12_by_9_pixels_are_filled(remove: Remove) -> None:
    assert_legal(remove(views=[c.scaled(0.1) for c in cameras()]))


def test_a_patch_larger_than_the_image_maps_known_pixels_or_nothing() -> None:
    image = np.random.default_rng(0).integers(0, 255, (4, 5, 3), dtype=np.uint8)
    hole = np.zeros((4, 5), bool)
    hole[1, 2] = True
    found = mapping_field(image, hole, ~hole, np.ones((4, 5), np.float32))
    assert np.isfinite(found.confidence) and (found.rows[~hole] == -1).all()
    assert not hole[found.rows[1, 2], found.cols[1, 2]] or found.rows[1, 2] == -1


# No source pixels, constant texture


def test_a_constant_texture_is_continued_the_same_way_every_time(remove: Remove) -> None:
    plain = scene()
    red = (np.abs(0.5 + SH_C0 * plain.sh[:, 0] - RED) < 0.01).all(1)
    plain.sh[~red, 0] = 0.1
    runs = [remove(plain, options=("--preset", "draft"), folder=name) for name in ("first", "second")]
    colours = 0.5 + SH_C0 * runs[0].added.sh[:, 0]
    assert len(colours) and np.abs(colours - (0.5 + SH_C0 * 0.1)).max() < 2 / 255
    assert (runs[0].folder / "out.ply").read_bytes() == (runs[1].folder / "out.ply").read_bytes()


def test_ties_are_broken_by_whole_patches_the_same_way_every_time() -> None:
    hole = np.zeros((40, 50), bool)
    hole[12:26, 15:33] = True
    image = np.full((40, 50, 3), 90, np.uint8)
    first, second = (mapping_field(image, hole, ~hole, np.ones((40, 50), np.float32)) for _ in range(2))
    assert (first.rows == second.rows).all() and (first.cols == second.cols).all()
    offsets = np.stack([first.rows, first.cols], -1) - np.moveaxis(np.indices(hole.shape), 0, -1)
    both = hole[:, 1:] & hole[:, :-1]
    assert (offsets[:, 1:] == offsets[:, :-1]).all(-1)[both].mean() > 0.5  # not single pixels from everywhere


# Prior constant / NaN / inverted / unrelated


def prior_of(kind: str, camera: Camera) -> np.ndarray:
    """A useless relative disparity of a view; `true` is right."""
    depth = render(truth(), camera).median_depth
    true = np.where(depth > 0, 1 / np.where(depth > 0, depth, 1), 0)
    if kind == "NaN round the hole":
        (view,) = (v for v in charted(scene(), REGION, cameras()).masks.views if v.camera.id == camera.id)
        return np.where(cv2.dilate(view.target.astype(np.uint8), np.ones((61, 61), np.uint8)) > 0, np.nan, true)
    noise = np.random.default_rng(0).normal(size=true.shape)
    return {"constant": np.full_like(true, 2), "inverted": -true, "unrelated": noise, "true": true}[kind]


def guided_by(prior: np.ndarray, folder: Path, reference: Camera) -> tuple[str, ...]:
    """Options for a removal with this depth prior of its reference."""
    np.save(folder / "prior.npy", prior.astype(np.float32))
    return ("--reference", reference.id, "--depth-prior", f"file:{folder / 'prior.npy'}")


@pytest.mark.parametrize("kind", ["constant", "NaN round the hole", "inverted", "unrelated"])
def test_a_useless_prior_is_not_used_and_that_is_said(kind: str, remove: Remove, tmp_path: Path) -> None:
    reference = cameras()[1]
    done = remove(options=guided_by(prior_of(kind, reference), tmp_path, reference))
    depth = done.stage("depth")
    assert "prior" in depth["reason"] and "guided" not in depth["reason"]
    assert depth["confidence"] <= 0.3 or "planar" in depth["reason"]  # planes may still say what the prior cannot
    assert_filled(done, truth())


def test_a_prior_guides_the_view_it_is_of_alone(remove: Remove, tmp_path: Path) -> None:
    views = list(cameras())
    views[1] = replace(views[1], cx=views[1].cx - 60)  # it shows half of the hole, so that there is a second reference
    done = remove(views=views, options=guided_by(prior_of("true", views[1]), tmp_path, views[1]))
    assert done.stage("depth")["reason"].startswith("guided")
    others = [s for s in done.summary["stages"] if re.fullmatch(r"depth \d", s["name"])]
    assert others and not any("prior" in s["reason"] or "guided" in s["reason"] for s in others)


# Depth 0 / NaN / sky


def test_a_floor_that_ends_beside_the_object_is_not_continued_into_the_void(remove: Remove) -> None:
    whole, true = (g.take(g.means[:, 0] > -0.4) for g in (scene(), truth()))
    assert_filled_on_the_floor(remove(whole), true)


def test_the_fill_lies_on_the_floor_and_not_halfway_to_a_sky_of_splats(remove: Remove) -> None:
    directions = np.random.default_rng(0).normal(size=(3000, 3))
    points = 60 * directions / np.linalg.norm(directions, axis=1, keepdims=True)
    sky = discs(points, (0, 0, 1), np.tile([0.5, 0.7, 0.95], (len(points), 1)), 4.0)
    sky.log_scales[:] = np.log(4.0)
    assert_filled_on_the_floor(remove(scene().extended(sky)), truth().extended(sky))


def assert_filled_on_the_floor(done: Removal, true: Gaussians) -> None:
    assert np.abs(done.added.means[:, 2]).max() < 0.05
    assert_filled(done, true, psnr=33.9)  # a fringe of a pixel at the floor's edge takes the void's colour


# Large disparity jump on the ring, thin structures across the hole


def with_a_rod(gaussians: Gaussians) -> Gaussians:
    points = np.stack([np.full(60, 0.55), np.zeros(60), np.linspace(0, 1.2, 60)], -1)
    return gaussians.extended(discs(points, (1, 0, 0), np.tile([0.1, 0.2, 0.9], (60, 1)), 0.03))


def test_a_rod_before_the_hole_is_not_filled() -> None:
    views, whole = cameras(9, 240, 180), with_a_rod(scene())
    on_rod = {c.id: footprint(whole, c, np.arange(len(whole)) >= len(scene())) > 0.6 for c in views}
    assert sum(m.sum() for m in on_rod.values()) > 1000
    for view in charted(whole, REGION, views).masks.views:
        assert not (view.target & on_rod[view.camera.id]).any(), view.camera.id


def test_a_rod_before_the_hole_is_not_painted_elsewhere(remove: Remove) -> None:
    views = cameras(9, 240, 180)
    result = remove(with_a_rod(scene()), views).after.gaussians
    for camera in views:
        error = np.abs(render_bytes(result, camera).astype(float) - render_bytes(with_a_rod(truth()), camera)).max(-1)
        assert (error > 80).sum() < 10, camera.id  # the rod's blue is 150 grey levels off the floor's colours


# Camera inside ROI; ROI partly behind the camera


def test_a_camera_inside_the_region_is_left_out(remove: Remove) -> None:
    done = remove(views=[*cameras(), camera_at("inside", (0.1, 0, 0.2), (1, 1, 1))])
    assert any(w.startswith("1 views do not frame the region or lie inside it") for w in done.summary["warnings"])
    assert done.summary["counts"]["views"] == 9
    assert_filled(done, truth())


def test_a_region_partly_behind_a_camera_is_filled_there_too(remove: Remove) -> None:
    beside = camera_at("beside", (0.45, 0, 0.4), (0.45, 0.9, 0.1), 60)
    corners = beside.to_camera(REGION[0].corners())[:, 2]
    assert corners.min() < 0 < corners.max()
    done = remove(views=[*cameras(), beside])
    assert done.summary["counts"]["views"] == 10
    assert_filled(done, truth())


# Reference does not see ROI, or sees it behind an occluder


def wall_before(camera: Camera, half: float = 0.5, step: float = 0.05) -> Gaussians:
    """A grey wall between a camera and the block, across its view."""
    along = np.arange(-half, half + 1e-6, step)
    a, b = (g.ravel() for g in np.meshgrid(along, along))
    middle = camera.centre + 0.4 * (REGION[0].center - camera.centre)
    points = middle + a[:, None] * camera.R[0] + b[:, None] * camera.R[1]
    wall = discs(points, (0, 0, 1), np.full((len(points), 3), 0.4), 0.7 * step)
    wall.log_scales[:] = np.log(0.7 * step)
    return wall


def test_a_reference_that_looks_away_is_refused(remove: Remove) -> None:
    away = turned_away(replace(cameras()[0], id="away"))
    assert_refused(remove(views=[*cameras(), away], options=("--reference", "away")), "away does not see")


def test_a_reference_behind_an_occluder_is_refused_and_never_chosen(remove: Remove) -> None:
    best = choose_reference(charted(scene(), REGION, cameras()).masks.views).camera_id
    wall = wall_before(next(c for c in cameras() if c.id == best))
    blocked = scene().extended(wall)
    assert_refused(remove(blocked, options=("--reference", best)), f"{best} does not see")
    done = remove(blocked, options=("--depth-prior", "planar"))  # a depth of its own needs a photo as reference
    assert not done.stage("reference")["reason"].startswith(best)
    assert_filled(done, truth().extended(wall))


# One view only; duplicate or collinear directions


FEW_DIRECTIONS = {
    "one view only": cameras()[1:2],
    "duplicates of one view": [replace(cameras()[1], id=f"same{k}") for k in range(5)],
    "duplicates of two views": [replace(cameras()[1 + k % 2], id=f"pair{k}") for k in range(6)],
    "views in a line": [camera_at(f"line{k}", (1.6, -0.6 + 0.15 * k, 1.2), (0, 0, 0)) for k in range(9)],
}


@pytest.mark.parametrize("case", FEW_DIRECTIONS)
def test_colours_from_few_directions_stay_bounded(case: str, remove: Remove) -> None:
    whole = replace(scene(), sh=np.pad(scene().sh, ((0, 0), (0, 8), (0, 0))))  # of degree 2
    added = remove(whole, FEW_DIRECTIONS[case], options=("--set", "seed.sh_degree=2", "--preset", "draft")).added
    if case in ("one view only", "duplicates of one view"):
        assert np.abs(added.sh[:, 1:]).max() < 1e-6  # c_0 alone
    directions = np.random.default_rng(0).normal(size=(200, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    everywhere = 0.5 + np.einsum("dk,nkc->ndc", sh_basis(directions, 2), added.sh.astype(float))
    from_reference = 0.5 + SH_C0 * added.sh[:, :1]
    assert np.median(np.abs(everywhere - from_reference).max((1, 2))) < 0.15
    assert np.abs(everywhere - from_reference).max() < 1.0


# Gaussians with NaN/inf, zero quaternions, ±inf logits, underflowing scales


def test_broken_gaussians_stay_as_they_are_and_harm_nothing(remove: Remove) -> None:
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


# Views of mixed size and intrinsics; portrait; odd sizes; lens shift; pixel aspect


def test_views_of_any_size_and_lens_fill_the_same_hole(remove: Remove) -> None:
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


# Distorted / fisheye / orthographic / panoramic cameras


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


def test_photos_through_a_lens_that_distorts_are_used_exactly(remove: Remove) -> None:
    lens = Distortion(k1=-0.12, k2=0.03, p1=0.001, p2=-0.002)
    done = remove(views=[replace(c, distortion=lens) for c in cameras()], photo=distorted_photo)
    assert not any("missing" in w for w in done.summary["warnings"])
    assert_filled(done, truth())


@pytest.mark.parametrize(
    ("model", "word"),
    [("OPENCV_FISHEYE", "fisheye"), ("ORTHOGRAPHIC", "orthographic"), ("EQUIRECTANGULAR", "panoramic")],
)
def test_lenses_without_a_pinhole_picture_are_refused_by_name(model: str, word: str, remove: Remove) -> None:
    def other_model(folder: Path) -> None:
        document = json.loads((folder / "cameras.json").read_text())
        (folder / "cameras.json").write_text(json.dumps({**document, "camera_model": model}))

    assert_refused(remove(change=other_model), word, code=2)


# Exposure differs between views: photos 20 % brighter or darker than the splats


def test_the_fill_has_the_exposure_of_what_is_round_it(remove: Remove) -> None:
    gains = {c.id: 1 + 0.2 * np.sin(2.1 * k) for k, c in enumerate(cameras())}
    done = remove(photo=lambda c: np.clip(gains[c.id] * render_bytes(scene(), c), 0, 255).astype(np.uint8))
    even = remove(photo=lambda c: render_bytes(scene(), c), folder="even").after.gaussians
    result = done.after.gaussians
    chosen = np.arange(len(result)) >= len(result) - done.summary["counts"]["added"]
    for camera in cameras(4):
        new = footprint(result, camera, chosen) > 0.9
        mean = render_bytes(result, camera)[new].mean() / render_bytes(even, camera)[new].mean()
        assert abs(mean - 1) < 0.02, camera.id


# Shadow and reflection of the object outside R


def with_shadow() -> Gaussians:
    """The scene with a dark place beside the block, baked into the floor as trainers do."""
    whole = scene()
    x, y, z = whole.means.T
    whole.sh[(np.hypot(x - 0.5, y) < 0.22) & (z < 0.02), 0] -= 1.0
    return whole


def test_an_extra_mask_takes_a_shadow_along() -> None:
    dark = np.flatnonzero((with_shadow().sh[:, 0] != scene().sh[:, 0]).any(1))
    chosen = np.isin(np.arange(len(scene())), dark)
    extra = {c.id: footprint(with_shadow(), c, chosen) > 0.5 for c in cameras()}
    masks = find_masks(with_shadow(), REGION, cameras(), extra=extra)
    assert masks.removed[dark].mean() > 0.9
    assert all((v.target & extra[v.camera.id]).sum() > 0.9 * extra[v.camera.id].sum() for v in masks.views)


def test_a_dark_place_that_the_object_does_not_cast_is_said_to_be_none_of_its_shadow(remove: Remove) -> None:
    assert "no shadow found" in remove(with_shadow()).words


def test_an_extra_box_takes_a_shadow_along(remove: Remove) -> None:
    done = remove(with_shadow(), region=(*REGION, Box.make([0.5, 0, 0], [0.46, 0.46, 0.1])))
    left = remove(with_shadow(), folder="without")
    assert_legal(done)
    pose = look_at(np.array([0.5, 0, 1.6]), np.array([0.5, 0, 0]), np.array([0, 1.0, 0]))
    above = Camera("above", 60, 60, 200, 200, 30, 30, pose)
    gone, kept, true = (render_bytes(g, above).mean() for g in (done.after.gaussians, left.after.gaussians, truth()))
    assert kept < 0.8 * true and abs(gone - true) < 0.1 * (true - kept)


# Out of memory, cancel, crash, disk full

OLD = b"an older result"


def old_result(folder: Path) -> None:
    (folder / "out.ply").write_bytes(OLD)


def assert_as_before(folder: Path) -> None:
    assert (folder / "out.ply").read_bytes() == OLD
    assert {p.name for p in folder.iterdir()} == {"scene.ply", "cameras.json", "roi.json", "out.ply"}


@pytest.mark.parametrize("stage", ["read", "masks", "charts", "appearance", "seed", "propagate", "settle"])
def test_files_are_as_before_a_run_that_is_cancelled(
    stage: str, remove: Remove, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupt(reporter: Reporter, now: str, *_: object) -> None:
        if now == stage:
            raise KeyboardInterrupt

    monkeypatch.setattr(Reporter, "__call__", interrupt)
    done = remove(change=old_result)
    assert done.code == 130 and len(done.errors) == 1 and "interrupted" in done.errors[0]
    assert_as_before(done.folder)


def test_files_are_as_before_a_run_that_fills_the_disk(remove: Remove, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    def prepare(folder: Path) -> None:
        old_result(folder)
        monkeypatch.setattr(os, "fsync", full)

    done = remove(change=prepare)
    assert done.code == 2 and len(done.errors) == 1 and os.strerror(errno.ENOSPC) in done.errors[0]
    assert_as_before(done.folder)


def in_a_child(folder: Path, first: str, options: Sequence[object] = ()) -> subprocess.CompletedProcess[str]:
    """The command in a process of its own, which runs `first` before."""
    code = f"import sys; {first}; from gimp3d.cli import main; sys.exit(main(sys.argv[1:]))"
    arguments = [str(a) for a in command(folder, options)]
    return subprocess.run([sys.executable, "-c", code, *arguments], capture_output=True, text=True, timeout=120)


def test_a_crashed_run_goes_on_where_it_was(remove: Remove, monkeypatch: pytest.MonkeyPatch) -> None:
    def again(*_: object) -> None:
        raise AssertionError("a finished stage ran again")

    undisturbed = remove(change=old_result)
    folder = undisturbed.folder
    expected = (folder / "out.ply").read_bytes()
    (folder / "summary.json").unlink()
    old_result(folder)
    job = folder.parent / "job"
    crash = "import os, gimp3d.steps.references as f; f.paint_views = lambda *a, **b: os._exit(9)"
    assert in_a_child(folder, crash, ("--job", job)).returncode == 9
    assert_as_before(folder)
    monkeypatch.setattr(pipeline, "find_masks", again)
    assert main([str(a) for a in command(folder, ("--job", job, "--resume"))]) == 0
    assert (folder / "out.ply").read_bytes() == expected


def test_views_that_no_memory_holds_are_refused(remove: Remove) -> None:
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


# Run again on its own output; overlapping ROIs


def test_boxes_that_overlap_are_their_union(remove: Remove) -> None:
    halves = (Box.make([-0.1, 0, 0.26], [0.42, 0.62, 0.56]), Box.make([0.1, 0, 0.26], [0.42, 0.62, 0.56]))
    assert_filled(remove(region=halves), truth())


def test_a_second_run_on_the_result_works(remove: Remove) -> None:
    once = remove()

    def take_result(folder: Path) -> None:
        shutil.copy2(once.folder / "out.ply", folder / "scene.ply")

    twice = remove(change=take_result, folder="again")
    assert_filled(twice, truth(), psnr=32)  # the box cuts into the new floor: it is made up a second time
