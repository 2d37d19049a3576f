"""What is filled, and on what surface, bends under small errors of the input and does not break.

The fast tests use the made scene, whose truth is known; the slow one runs the benchmark (`make bench-surface`).
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Sequence
from functools import cache
from itertools import pairwise
from pathlib import Path
from xml.etree import ElementTree

import cv2
import numpy as np
import pytest
from scenes import BLOCK, REGION, cameras, scene, truth

from benchmarks.perturbations import moved, noisy_depths, resized, turned
from benchmarks.surface import completed, overlap, shares, surface, targets
from gimp3d.box import Box
from gimp3d.camera import Camera
from gimp3d.gaussians import Gaussians
from gimp3d.pipeline import render_bytes
from gimp3d.raster import surface_depth
from gimp3d.stages.masks import Masks, find_masks

ROOT = Path(__file__).resolve().parents[2]
VIEWS = cameras(9, 240, 180)
REFERENCES = VIEWS[:3]  # one of each elevation; never turned, as the truth is known in them
ROOMY = (Box.make([0, 0, 0.31], [0.78, 0.78, 0.68]),)  # holds the block at 0.8 times its size too
DEPTH = 0.01  # relative; unperturbed it is 0.4 %, for the made floor is as thick as its splats


@cache
def true_depth(index: int) -> np.ndarray:
    return surface_depth(truth(), VIEWS[index])[0]


@cache
def under_the_block(index: int) -> np.ndarray:
    """[H, W] bool: floor that no view sees, without its rim."""
    z = true_depth(index)
    points = VIEWS[index].unproject(VIEWS[index].pixel_centres(), z.astype(np.float64))
    return (z > 0) & (np.abs(points[..., :2]) < BLOCK / 2 - 0.02).all(-1)


@cache
def unperturbed() -> Masks:
    return find_masks(scene(), REGION, VIEWS)


def covered(masks: Masks) -> float:
    """Share of the floor that no view sees in T, in the worst view."""
    found = targets(masks, VIEWS)
    return shares([(found[c.id], under_the_block(k)) for k, c in enumerate(VIEWS)])[1]


def area(masks: Masks) -> float:
    return float(sum(t.sum() for t in targets(masks, VIEWS).values()))


def changed(masks: Masks, before: Masks) -> float:
    """1 − overlap of all T with those before."""
    return 1 - overlap(targets(masks, VIEWS), targets(before, VIEWS))[0]


def depth_error(masks: Masks, references: Sequence[Camera] = REFERENCES) -> float:
    """The worst reference's median relative error on the floor that no view sees."""
    errors = []
    for view in masks.views:
        if view.camera in references:
            index = VIEWS.index(view.camera)
            there = under_the_block(index)
            z = true_depth(index)[there]
            errors.append(float(np.median(np.abs(surface(view, completed(view, masks.views))[there] - z) / z)))
    assert len(errors) == len(references)
    return max(errors)


def outline_per_area(masks: Masks) -> float:
    """px of outline per px of T: T moved by d px differs from itself by at most d times that."""
    outlines = [
        cv2.findContours(v.target.astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)[0] for v in masks.views
    ]
    return sum(cv2.arcLength(c, True) for o in outlines for c in o) / area(masks)


def assert_grows(losses: Sequence[float], slack: float) -> None:
    """Never clearly less for a larger perturbation."""
    assert all(b >= a - slack for a, b in pairwise(losses)), losses


@pytest.mark.parametrize("seed", [0, 1])
def test_wrong_poses_move_the_target_no_farther_than_the_picture(seed: int) -> None:
    losses = []
    for pixels in (0.1, 0.3, 1.0, 2.0):
        rng = np.random.default_rng(seed)
        masks = find_masks(scene(), REGION, [c if c in REFERENCES else turned(c, pixels, rng) for c in VIEWS])
        losses.append(changed(masks, unperturbed()))
        # 2 %: single pixels at thresholds, and what the z-tests between views no longer agree on
        assert losses[-1] <= pixels * outline_per_area(unperturbed()) + 0.02
        assert covered(masks) >= 0.99
        assert depth_error(masks) < DEPTH  # the reference's own pose is right, its surface comes from its own ring
    assert_grows(losses, slack=0.005)


@pytest.mark.parametrize("seed", [0, 1])
def test_noisy_depths_change_little_within_the_tolerance_of_the_tests(seed: int) -> None:
    losses = []
    for share in (0.001, 0.003, 0.01, 0.03):
        with noisy_depths(share, seed):
            masks = find_masks(scene(), REGION, VIEWS)
        losses.append(changed(masks, unperturbed()))
        # In proportion: a fifth of T per per cent. z-tests between views tolerate 2 %, and two views differ by √2 times
        # the noise: at 1 % one test in six fails, at 3 % two in three, but a pixel is judged by more than one.
        assert losses[-1] <= 20 * share + 0.02
        assert covered(masks) >= 0.99
        # The surface is fitted to hundreds of pixels of the ring, so it is never as wrong as they are.
        assert depth_error(masks) < DEPTH + share
    assert_grows(losses, slack=0.005)


def test_boxes_of_any_size_fill_the_hole_and_little_of_the_floor_in_them() -> None:
    before = find_masks(scene(), ROOMY, VIEWS)
    for factor in (0.8, 0.9, 1.1, 1.2):
        masks = find_masks(scene(), resized(ROOMY, factor), VIEWS)
        assert covered(masks) >= 0.99
        assert depth_error(masks) < DEPTH
        # At worst all floor in the box is filled anew, which grows with the square of its size; a tenth for the rims.
        assert area(masks) <= 1.1 * max(1.0, factor) ** 2 * area(before)


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("share", [-0.1, 0.1])
def test_a_box_that_is_off_by_a_tenth_still_fills_the_hole(axis: int, share: float) -> None:
    masks = find_masks(scene(), moved(ROOMY, axis, share), VIEWS)
    before = find_masks(scene(), ROOMY, VIEWS)
    assert covered(masks) >= 0.99
    assert depth_error(masks) < DEPTH
    assert area(masks) <= 1.15 * area(before)  # at most a tenth of the box's floor is another one


def test_any_view_serves_as_the_reference() -> None:
    assert depth_error(unperturbed(), VIEWS) < DEPTH


def with_shadow() -> Gaussians:
    """Dark floor on one side of the block and a red gleam on the other, as photos of a lit object show them."""
    whole = scene()
    x, y, z = whole.means.T
    floor = z < 0.02
    whole.sh[floor & (np.hypot(x - 0.35, y) < 0.3), 0] -= 1.0
    whole.sh[floor & (np.hypot(x + 0.4, y) < 0.2), 0, 0] += 0.5
    return whole


def test_shadows_and_reflections_do_not_move_the_target() -> None:
    photos = {c.id: render_bytes(with_shadow(), c) for c in VIEWS}
    masks = find_masks(with_shadow(), REGION, VIEWS, photos=photos)
    assert changed(masks, unperturbed()) < 0.02  # they have no shape: only colours differ
    assert covered(masks) >= 0.99
    assert depth_error(masks) < DEPTH


# ------------------------------------------------------------------------------------------------------ the benchmark

SCENES = ("desk", "desk_shadow")


@pytest.fixture(scope="module")
def quick(shared_data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("bench_surface")
    command = [sys.executable, "-m", "benchmarks.surface", str(shared_data / "withwithout"), "--quick"]
    done = subprocess.run([*command, "--out", str(out)], cwd=ROOT, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr
    return out


@pytest.mark.slow
def test_the_benchmark_writes_tables_charts_and_pictures(quick: Path) -> None:
    results = json.loads((quick / "surface.json").read_text())
    assert tuple(results["scenes"]) == SCENES and all(results[key] for key in ("shadows", "pictures"))
    assert {(r["scene"], r["mode"]) for r in results["masks"]} == {(s, m) for s in SCENES for m in ("need", "paper")}
    assert len({(r["scene"], r["view"]) for r in results["depths"]}) == 12
    for name in ("surface_masks.svg", "surface_references.svg", "surface_stability.svg"):
        drawn = ElementTree.parse(quick / name).getroot()
        assert "desk" in {t.text for t in drawn.iter("{http://www.w3.org/2000/svg}text")}
    words = (quick / "surface.md").read_text()
    assert "| desk | need |" in words and all(f"]({name})" in words for name in results["pictures"])
    assert all((quick / name).is_file() for name in results["pictures"])


@pytest.mark.slow
def test_on_rendered_scenes_it_bends_too(quick: Path) -> None:
    rows = json.loads((quick / "surface.json").read_text())["stability"]
    assert not [r for r in rows if "refused" in r]
    for scene_ in SCENES:
        found = {(r["kind"], r["label"]): r for r in rows if r["scene"] == scene_}
        still = found["none", "0"]
        assert still["iou"] == 1 and still["covered"] > 0.99
        # 2 px off: T of some 60 px across moves by its rim. Noise of 3 % is beyond what z-tests tolerate (2 %).
        for kind, small, large, least in (("poses", "0.3", "2", 0.85), ("depths", "0.3", "3", 0.5)):
            a, b = found[kind, small], found[kind, large]
            assert 1 > a["iou"] > b["iou"] > least and a["covered"] > 0.99 and b["covered"] > 0.95
        # a wrong pose of another view cannot spoil the reference's own surface; noise may, by its own size
        assert found["poses", "2"]["median"] < still["median"] + 0.002
        assert found["depths", "3"]["median"] < still["median"] + 0.03
        assert found["size", "1.2"]["covered"] > 0.99 and found["size", "0.8"]["covered"] > 0.8


def test_without_scenes_the_benchmark_says_so_in_one_line(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "benchmarks.surface", str(tmp_path), "--out", str(tmp_path / "out")]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120)
    assert done.returncode == 2 and len(done.stderr.splitlines()) == 1 and "holds no scenes" in done.stderr
    assert not (tmp_path / "out").exists()
