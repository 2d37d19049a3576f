"""What the benchmark of real scenes counts, and that it runs."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scenes import BLOCK, REGION, block, cameras, scene, truth

from benchmarks.real import (
    BUILT_IN,
    CLEARANCE,
    GIVEN,
    PAPER,
    Run,
    agreement,
    coverage,
    goals,
    near,
    outside_hidden_volume,
    planned,
    report,
    ring,
)
from benchmarks.scenes import read_scene, shadow_words
from gimp3d.camera import Camera
from gimp3d.io.cameras import write_transforms
from gimp3d.io.images import read_mask, write_png
from gimp3d.io.ply import write_gaussians
from gimp3d.pipeline import render_bytes
from gimp3d.raster import render

ROOT = Path(__file__).resolve().parents[2]


def silhouette(camera: Camera) -> np.ndarray:
    return render(block(), camera, passes=frozenset({"alpha"})).alpha > 0.5


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A scene with truth: the block on its floor, without a shadow."""
    where = tmp_path / "data" / "block"
    train = [replace(c, id=f"images/{k:03d}.png") for k, c in enumerate(cameras(9))]
    test = [replace(c, id=f"test/{k:03d}.png", split="test") for k, c in enumerate(cameras(5)[1:4])]
    write_gaussians(where / "scene.ply", scene())
    write_transforms(where / "transforms.json", [*train, *test])
    (where / "roi.json").write_text(json.dumps([box.to_json() for box in REGION]))
    for camera in (*train, *test):
        own = where / "truth" / camera.id
        write_png(own.with_suffix(".mask.png"), silhouette(camera))
        write_png(own.with_suffix(".unseen.png"), silhouette(camera))
        write_png(where / camera.id, render_bytes(scene() if camera.split == "train" else truth(), camera))
    for camera in test:
        write_png(where / "images" / f"with_test_{Path(camera.id).name}", render_bytes(scene(), camera))
    return where


def mark_shadow(where: Path) -> np.ndarray:
    """The same shadow in one training view."""
    shadow = np.zeros((90, 120), bool)
    shadow[60:70, 20:50] = True
    write_png(where / "truth" / "images" / "000.shadow.png", shadow)
    return shadow


def test_the_ring_has_the_masks_size_and_the_nearest_pixels() -> None:
    mask, left_out = np.zeros((60, 80), bool), np.zeros((60, 80), bool)
    mask[20:32, 30:44], left_out[:, 60:] = True, True
    found = ring(mask, left_out)
    y, x = np.indices(mask.shape)
    away = np.hypot(np.maximum(0, np.maximum(20 - y, y - 31)), np.maximum(0, np.maximum(30 - x, x - 43)))
    assert found.sum() == mask.sum() and not (found & left_out).any()
    assert away[found].min() > CLEARANCE
    others = (away > CLEARANCE) & ~left_out & ~found
    assert away[found].max() <= away[others].min() + 1e-5
    np.testing.assert_array_equal(near(mask, left_out), (away > CLEARANCE) & (away <= 24) & ~left_out)


def test_a_ring_takes_what_the_frame_leaves_and_an_empty_mask_has_none() -> None:
    mask = np.ones((20, 20), bool)
    mask[:, 15:] = False
    assert ring(mask, np.zeros_like(mask)).sum() == 20 * 2  # columns 15 to 17 are too close
    assert not ring(~mask & mask, mask).any() and not near(~mask & mask, mask).any()


def test_the_hidden_volume_holds_what_every_view_that_frames_it_hides() -> None:
    views = [(c, silhouette(c), np.zeros((c.height, c.width))) for c in cameras(9)]
    inside = [[0, 0, 0.02], [0.1, -0.1, BLOCK / 2]]
    beside = [[0.8, 0, 0], [0, 0, BLOCK + 0.6]]
    unframed = [[0, 0, 500.0], [1e4, 0, 0]]
    found = outside_hidden_volume(np.array([*inside, *beside, *unframed]), views)
    np.testing.assert_array_equal(found, [False] * 2 + [True] * 4)
    # what stands before all that a view frames lets it tell nothing
    wall = [(c, mask, np.full(mask.shape, 0.1)) for c, mask, _ in views]
    found = outside_hidden_volume(np.array([*inside, beside[0]]), [(c, 0 & m, d) for c, m, d in wall[:4]] + views[4:])
    np.testing.assert_array_equal(found, [False] * 2 + [True])
    assert outside_hidden_volume(np.array(inside), [(c, 0 & m, d) for c, m, d in wall]).all()


def test_tolerance_widens_the_hidden_volume_by_its_pixels() -> None:
    camera = cameras()[0]
    mask = np.zeros((camera.height, camera.width), bool)
    mask[40:50, 50:60] = True
    points = camera.unproject(np.array([[54.5, 44.5], [64.5, 44.5], [65.5, 44.5]]), np.full(3, 2.0))
    views = [(camera, mask, np.zeros(mask.shape))]
    np.testing.assert_array_equal(outside_hidden_volume(points, views, 5), [False, False, True])
    np.testing.assert_array_equal(outside_hidden_volume(points, views, 0), [False, True, True])


def test_coverage_counts_pixels_of_all_views(folder: Path, tmp_path: Path) -> None:
    shadow = mark_shadow(folder)
    there = read_scene(folder)
    masks = {c.id: there.hides(c) for c in there.train}
    first = there.train[0]
    write_png(folder / "truth" / "images" / "000.unseen.png", np.zeros_like(shadow))
    for camera in there.train:
        write_png(tmp_path / camera.id, masks[camera.id] | there.shadow(camera))
    every, own = (sum(int(m.sum()) for name, m in masks.items() if name != skip) for skip in ("", first.id))
    found, beside = coverage(there, tmp_path), int((shadow & ~masks[first.id]).sum())
    assert found["covered"] == 1 and found["invented"] == pytest.approx(masks[first.id].sum() / every)
    assert found["area"] == pytest.approx((every + beside) / own)


def test_scenes_with_a_shadow_are_planned_twice_and_told_of_it(folder: Path, tmp_path: Path) -> None:
    plain = read_scene(folder)
    assert [r.name for r in planned(plain, ("draft",))] == ["draft_given", "draft_built-in"]
    assert list(planned(replace(plain, test=()), ("best", PAPER))) == [
        Run("best", False, False),
        Run(PAPER, False, False),
    ]
    shadow = mark_shadow(folder)
    runs = list(planned(read_scene(folder), ("draft", PAPER)))
    assert sum(r.marked for r in runs) == 3 and [r for r in runs if r.preset == PAPER] == [Run(PAPER, True, True)]
    *lifted, marks = shadow_words(read_scene(folder), tmp_path)
    assert lifted == ["--shadow", "mask", "--shadow-masks"]
    assert shadow_words(read_scene(folder), tmp_path, lifted=False) == ["--extra-masks", marks]
    np.testing.assert_array_equal(read_mask(Path(marks) / "images" / "000.png"), shadow)
    assert not read_mask(Path(marks) / "images" / "001.png").any()


def row(score: float | None, error: float, **changed: Any) -> dict[str, Any]:
    made = {"scene": "tiles_mug", "method": "draft", "kind": GIVEN, "marked": True, "counts": True, "score": score}
    made |= {"error": error, "psnr mask": 30.0 - error, "near before": 30.0, "near after": 30.0, "outside": 0.0}
    made |= {"psnr mask unfilled": 27.0}
    return made | {"seconds": 1.0} | changed


def test_spearman_is_1_where_better_scores_have_smaller_errors() -> None:
    rows = [row(0.9, 0.1), row(0.5, 1.0), row(None, 0.0), row(0.2, 7.0), {"refused": "", "score": 1.0}]
    assert agreement(rows) == pytest.approx(1)
    assert agreement([row(0.1, 0.1), row(0.5, 1.0), row(0.9, 7.0)]) == pytest.approx(-1)
    assert agreement(rows[:1]) is None and agreement([row(0.5, 1.0), row(0.5, 2.0)]) is None


def test_goals_count_the_marked_shadow_and_hold_refusals_against_a_preset() -> None:
    telea = row(None, 0, method="telea", kind="", **{"psnr mask": 28.0})
    machine = {"cpu": "any", "cores": 2, "load_at_start": [0.0]}
    done = [row(0.9, 0.5), row(0.1, 5.0, kind=BUILT_IN), telea, row(0.5, 99.0, marked=False, counts=False)]
    found = {g.name: g for g in goals({"rows": done, "coverage": [], "pictures": [], "machine": machine})}
    assert found["draft, given: mask, mean over real scenes"].met
    assert not found["draft, built-in: mask, mean over real scenes"].met
    worst = found["draft: mask against the better of emptied box and Telea, worst"]
    assert not worst.met and worst.found == "-3.00 dB in tiles_mug, built-in"
    assert not found["draft: mask against its own removal, not filled, worst"].met
    refused = {"scene": "real_bed", "method": "draft", "kind": GIVEN, "marked": False, "counts": True, "refused": "no"}
    results = {"rows": [*done, refused], "coverage": [], "pictures": [], "machine": machine}
    assert not next(g for g in goals(results) if g.name.startswith("draft, given")).met
    assert "| real_bed |  | draft | given | no |" in report(results)


@pytest.mark.slow
def test_a_scene_with_a_shadow_is_measured_from_end_to_end(folder: Path, tmp_path: Path) -> None:
    mark_shadow(folder)
    out = tmp_path / "out"
    command = [
        *(sys.executable, "-m", "benchmarks.real"),
        str(folder.parent),
        "--scenes",
        "block",
        "--presets",
        "draft",
        "--out",
        str(out),
    ]
    for extra in ([], ["--reuse"]):
        done = subprocess.run([*command, *extra], cwd=ROOT, capture_output=True, text=True, timeout=500, check=False)
        assert done.returncode == 0, done.stderr[-2000:]
    rows = json.loads((out / "real.json").read_text())["rows"]
    assert [r["method"] for r in rows] == 2 * ["emptied box", "telea"] + 4 * ["draft"]
    assert all(r["psnr mask"] > rows[0]["psnr mask"] for r in rows if r["method"] == "draft")
    words = (out / "real.md").read_text()
    assert "| block | marked | draft | given |" in words and "(block/draft_given.png)" in words
    assert (out / "block" / "draft_built-in_shadow_marked.png").exists()


def test_folders_without_truth_have_no_test_views(folder: Path) -> None:
    (folder / "truth").rename(folder / "elsewhere")
    there = read_scene(folder)
    assert not there.has_truth and not there.has_shadow and len(there.train) == 9
