"""The contract of the command line: results, exit codes, and that nothing half-written stays."""

from __future__ import annotations

import json
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from scenes import REGION, cameras, scene, truth

from gimp3d import behind, commands, filling, pipeline
from gimp3d.camera import output_name
from gimp3d.cli import main
from gimp3d.io.cameras import write_transforms
from gimp3d.io.images import read_image, write_png
from gimp3d.io.ply import read_ply, write_gaussians
from gimp3d.pipeline import render_bytes
from gimp3d.stages.masks import spread_views
from gimp3d.steps import references


@pytest.fixture(scope="module")
def scene_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """scene.ply, transforms.json, roi.json and photos of the block scene."""
    folder = tmp_path_factory.mktemp("scene")
    write_gaussians(folder / "scene.ply", scene(), ["made by the tests"])
    views = cameras()
    write_transforms(folder / "transforms.json", views)
    (folder / "roi.json").write_text(json.dumps(REGION[0].to_json()))
    for camera in views:
        write_png(folder / f"{camera.id}.png", render_bytes(scene(), camera))
    return folder


def run(*words: object, expect: int = 0) -> None:
    assert main([str(w) for w in words]) == expect


def files_of(folder: Path) -> tuple[object, ...]:
    """A command's scene, cameras and region."""
    return (folder / "scene.ply", "--cameras", folder / "transforms.json", "--roi", folder / "roi.json")


def remove(folder: Path, out: Path, *more: object, expect: int = 0) -> None:
    run("remove", *files_of(folder), "--out", out, "--progress", "none", *more, expect=expect)


def read_json(path: Path) -> Any:
    return json.loads(path.read_text())


@pytest.fixture(scope="module")
def completed(scene_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """out.ply of a removal, its summary s.json, its views and charts, and report/."""
    folder = tmp_path_factory.mktemp("completed")
    written = ("--views-out", folder, "--summary", folder / "s.json", "--report", folder / "report")
    remove(scene_folder, folder / "out.ply", *written)
    return folder


def test_kept_rows_stay_byte_for_byte_in_front_of_new_ones(scene_folder: Path, completed: Path) -> None:
    before, after = read_ply(scene_folder / "scene.ply"), read_ply(completed / "out.ply")
    counts = read_json(completed / "s.json")["counts"]
    kept = counts["gaussians_in"] - counts["removed"]
    rows = {r.tobytes() for r in before.table.rows}
    assert all(r.tobytes() in rows for r in after.table.rows[:kept])
    assert counts["gaussians_out"] == len(after.gaussians) == kept + counts["added"]
    assert after.table.comments == before.table.comments
    assert np.isfinite(after.gaussians.means).all()


def test_the_hole_is_filled_with_what_is_behind_the_object(completed: Path) -> None:
    after, counts = read_ply(completed / "out.ply").gaussians, read_json(completed / "s.json")["counts"]
    without_fill = after.take(np.arange(counts["gaussians_in"] - counts["removed"]))
    for camera in cameras(4):
        filled, opened, true = (render_bytes(g, camera).astype(float) for g in (after, without_fill, truth()))
        error = ((filled - true) ** 2).mean()
        assert 10 * np.log10(255**2 / error) > 36, camera.id
        assert error < 0.1 * ((opened - true) ** 2).mean()


def test_the_summary_holds_what_callers_rely_on(scene_folder: Path, completed: Path) -> None:
    summary = read_json(completed / "s.json")
    words = "version command seconds_total stages counts settings warnings peak_memory_mb"
    assert set(summary) >= set(words.split())
    assert {"name", "seconds", "confidence", "reason"} <= set(summary["stages"][0])
    verdict, counts = summary["verdict"], summary["counts"]
    assert set(verdict) >= {"open_share", "remains", "haze", "ring_fidelity", "sharpness", "agreement", "words"}
    assert 0 < verdict["score"] < 1 and verdict["words"]
    assert sum(v for k, v in counts.items() if k.startswith("added_of_degree_")) == counts["added"]
    row = (scene_folder / "scene.ply").stat().st_size // counts["gaussians_in"]  # the header is shorter than a row each
    assert counts["added_bytes"] == counts["added"] * row
    assert (completed / "report" / "index.html").read_text().startswith("<!doctype html>")


def test_result_does_not_depend_on_the_number_of_threads(scene_folder: Path, tmp_path: Path) -> None:
    outs = [tmp_path / f"{n}.ply" for n in (1, 3)]
    for threads, out in zip(("1", "3"), outs):
        remove(scene_folder, out, "--threads", threads)
    assert outs[0].read_bytes() == outs[1].read_bytes()


def test_json_progress_ends_with_the_summary(
    scene_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    remove(scene_folder, tmp_path / "out.ply", "--progress", "json")
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert all({"stage", "done", "total", "message"} <= set(line) for line in lines[:-1])
    assert {"masks", "charts", "propagate", "seed", "settle"} <= {line["stage"] for line in lines}
    assert lines[-1]["stage"] == "done" and lines[-1]["summary"]["counts"]["removed"] > 0


def test_a_job_runs_alone_moves_and_resumes(
    scene_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def again(*_: object) -> None:
        raise AssertionError("a finished stage ran again")

    job = tmp_path / "job"
    shutil.copytree(scene_folder, job)
    remove(job, job / "out.ply", "--job", job)
    first = (job / "out.ply").read_bytes()
    (job / "out.ply").unlink()
    moved = tmp_path / "moved"
    job.rename(moved)
    for stage in ("find_masks", "judge"):
        monkeypatch.setattr(pipeline, stage, again)
    for stage in ("exposures_of", "find_surfaces", "find_light", "chart_surfaces", "clear_round"):
        monkeypatch.setattr(behind, stage, again)
    for stage in ("paint_chart", "paint_views"):
        monkeypatch.setattr(references, stage, again)
    for stage in ("seed_gaussians", "settle_gaussians", "refine_gaussians"):
        monkeypatch.setattr(filling, stage, again)
    run("remove", "--job", moved, "--resume", "--progress", "none")
    assert (moved / "out.ply").read_bytes() == first
    assert read_json(moved / "summary.json")["counts"]["added"] > 0


def test_stages_that_were_emptied_or_exchanged_run_again(scene_folder: Path, tmp_path: Path) -> None:
    """A full disk leaves files of 0 bytes; they ended the next run with EOFError."""
    job = tmp_path / "job"
    remove(scene_folder, tmp_path / "first.ply", "--job", job)
    stages = sorted((job / "stages").glob("*.npz"))
    assert len(stages) > 5
    for k, stage in enumerate(stages):
        stage.write_bytes(b"" if k % 2 else stages[0].read_bytes()[:-1])
    remove(scene_folder, tmp_path / "second.ply", "--job", job, "--resume")
    assert (tmp_path / "second.ply").read_bytes() == (tmp_path / "first.ply").read_bytes()


def test_variants_are_other_fills_of_the_same_hole(
    scene_folder: Path, completed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def again(*_: object) -> None:
        raise AssertionError("the stage ran again")

    out, job = tmp_path / "out.ply", ("--job", tmp_path / "job", "--summary", tmp_path / "s.json")
    remove(scene_folder, out, *job, "--variants", 3, "--report", tmp_path / "report")
    facts = read_json(tmp_path / "s.json")["variants"]
    paths = [out, tmp_path / "out.2.ply", tmp_path / "out.3.ply"]
    assert [f["out"] for f in facts] == [str(p) for p in paths]
    scenes = [p.read_bytes() for p in paths]
    assert scenes[0] == (completed / "out.ply").read_bytes()  # the first is what there is without variants
    assert len(set(scenes)) == 3
    stays = len(read_ply(out).gaussians) - facts[0]["added"] + facts[0]["changed"]
    for path, fact in zip(paths, facts):  # what is drawn before a fill takes its colours: each changes other rows
        assert len(read_ply(path).gaussians) - fact["added"] == stays - fact["changed"]
        assert fact["added"] > fact["changed"]
        assert 0 <= fact["score"] <= 1
        assert str(path) in (tmp_path / "report" / "index.html").read_text()
    for path in paths:
        path.unlink()
    monkeypatch.setattr(pipeline, "find_masks", again)
    remove(scene_folder, out, *job, "--variants", 3, "--resume")
    assert [p.read_bytes() for p in paths] == scenes
    remove(scene_folder, out, *job, "--resume")  # the first of them is the same whatever their number
    assert out.read_bytes() == scenes[0]


@pytest.mark.parametrize(("number", "out"), [(0, "out.ply"), (17, "out.ply"), (2, "/dev/null")])
def test_variants_that_cannot_be_are_refused(
    number: int, out: str, scene_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    remove(scene_folder, tmp_path / out, "--variants", number, expect=2)
    assert "variants" in capsys.readouterr().err
    assert not any(tmp_path.iterdir())


def test_of_many_views_some_are_used_those_that_are_named_among_them(scene_folder: Path, tmp_path: Path) -> None:
    last = cameras()[-1].id
    marks = {c.id: np.zeros((c.height, c.width), bool) for c in cameras()}
    marks[cameras()[-2].id][5:9, 5:9] = True
    for name, mask in marks.items():
        write_png(tmp_path / "marks" / f"{output_name(name)}.png", mask)
    written = ("--views-out", tmp_path / "v", "--summary", tmp_path / "s.json")
    words = ("--set", "views=3", "--reference", last, "--extra-masks", tmp_path / "marks")
    remove(scene_folder, tmp_path / "o.ply", "--preset", "draft", *words, *written)
    masks = next(s for s in read_json(tmp_path / "s.json")["stages"] if s["name"] == "masks")
    assert "3 views see the region" in masks["reason"]
    painted = {str(p.relative_to(tmp_path / "v")) for p in (tmp_path / "v").rglob("*.png")}
    assert {f"{output_name(c.id)}.png" for c in cameras()[-2:]} <= painted


def test_a_given_reference_picture_is_used(scene_folder: Path, tmp_path: Path) -> None:
    reference = cameras()[0]
    true = render_bytes(truth(), reference)
    write_png(tmp_path / "true.png", true)
    out = tmp_path / "out.ply"
    given = ("--reference", reference.id, "--reference-image", tmp_path / "true.png")
    remove(scene_folder, out, *given, "--views-out", tmp_path / "views", "--summary", tmp_path / "s.json")
    completed = read_image(tmp_path / "views" / f"{reference.id}.png")
    hidden = (np.abs(render_bytes(scene(), reference).astype(int) - true) > 20).any(-1)
    assert completed.shape == (90, 120, 3) and np.abs(completed.astype(int) - true)[hidden].mean() < 2
    assert not [w for w in read_json(tmp_path / "s.json")["warnings"] if "--reference-image" in w]


def test_a_given_picture_that_matches_poorly_is_a_warning(scene_folder: Path, tmp_path: Path) -> None:
    reference = cameras()[0]
    true = render_bytes(truth(), reference)
    scratches = 300 * cv2.GaussianBlur(np.random.default_rng(0).normal(size=(90, 120, 1)), (0, 0), 1.5)
    write_png(tmp_path / "scratched.png", np.clip(true + scratches[..., None], 0, 255).astype(np.uint8))
    given = ("--reference", reference.id, "--reference-image", tmp_path / "scratched.png")
    remove(scene_folder, tmp_path / "out.ply", *given, "--summary", tmp_path / "s.json")
    warnings = [w for w in read_json(tmp_path / "s.json")["warnings"] if "--reference-image" in w]
    assert len(warnings) == 1 and "agrees by 0." in warnings[0]


def test_charts_are_written_for_painting(scene_folder: Path, completed: Path, tmp_path: Path) -> None:
    """Before the removal and by it they are the same but for the fill."""
    shown = ("--pictures", tmp_path, "--frames", "orbit/004", "--progress", "none")
    run("masks", *files_of(scene_folder), "--out", tmp_path / "masks", *shown)
    before, after = tmp_path / "charts", completed / "charts"
    assert {p.name for p in before.iterdir()} == {p.name for p in after.iterdir()}
    for name in ("transforms.json", "1.hole.png"):
        assert (before / name).read_bytes() == (after / name).read_bytes(), name
    hole = read_image(before / "1.hole.png")[..., 0] > 127
    facts = read_json(completed / "s.json")["charts"]
    assert len(facts) == 1 and facts[0]["hole_texels"] == hole.sum() > 0
    pictures = [read_image(f / "1.png") for f in (before, after)]
    np.testing.assert_array_equal(pictures[0][~hole], pictures[1][~hole])
    assert (pictures[0] != pictures[1]).any()
    seen = ("--cameras", after / "transforms.json", "--out", tmp_path / "seen", "--progress", "none")
    run("render", completed / "out.ply", *seen)
    drawn = read_image(tmp_path / "seen" / "1.png").astype(float)
    assert np.abs(drawn - pictures[1])[hole].mean() < 12  # the cameras are those of the pictures


def test_charts_for_painting_are_of_the_views_that_a_removal_uses(
    scene_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    few = lambda available, region, most, needed: spread_views(available, region, 4, needed)  # noqa: E731
    monkeypatch.setattr(commands, "spread_views", few)
    run("masks", *files_of(scene_folder), "--out", tmp_path / "t", "--pictures", tmp_path, "--progress", "none")
    remove(scene_folder, tmp_path / "o.ply", "--preset", "draft", "--views-out", tmp_path / "v")
    assert len(list((tmp_path / "t").rglob("*.png"))) == len(cameras())
    assert len(list((tmp_path / "v" / "orbit").iterdir())) == 4
    for name in ("transforms.json", "1.hole.png"):
        assert (tmp_path / "charts" / name).read_bytes() == (tmp_path / "v" / "charts" / name).read_bytes()


def test_a_painted_chart_rules_its_hole(scene_folder: Path, completed: Path, tmp_path: Path) -> None:
    hole = read_image(completed / "charts" / "1.hole.png")[..., 0] > 127
    painted = np.where(hole[..., None], np.uint8((20, 200, 40)), read_image(completed / "charts" / "1.png"))
    write_png(tmp_path / "painted.png", painted)
    given = ("--reference", "chart:1", "--reference-image", tmp_path / "painted.png")
    job = ("--job", tmp_path / "job", "--summary", tmp_path / "s.json", "--report", tmp_path / "report")
    remove(scene_folder, tmp_path / "out.ply", *given, *job, "--views-out", tmp_path)
    np.testing.assert_array_equal(read_image(tmp_path / "charts" / "1.png"), painted)
    summary = read_json(tmp_path / "s.json")
    assert not summary["warnings"]
    assert "picture pasted as it is" in next(s["reason"] for s in summary["stages"] if s["name"] == "appearance")
    page = (tmp_path / "report" / "index.html").read_text()
    assert "<td>chart:1</td>" in page
    np.testing.assert_array_equal(read_image(tmp_path / "report" / "charts" / "1.png"), painted)
    assert (read_image(tmp_path / "report" / "chart_1.png")[hole][:, 0] > 100).all()  # the hole is marked in red
    filled = read_ply(tmp_path / "out.ply").gaussians
    green = [render_bytes(filled, c).astype(int) @ [-1, 2, -1] > 120 for c in cameras()]
    bare = [
        render_bytes(read_ply(completed / "out.ply").gaussians, c).astype(int) @ [-1, 2, -1] > 120 for c in cameras()
    ]
    assert min(g.sum() for g in green) > 100 and not np.any(bare)
    first = (tmp_path / "out.ply").read_bytes()
    (tmp_path / "out.ply").unlink()
    run("remove", "--job", tmp_path / "job", "--progress", "none")
    assert (tmp_path / "out.ply").read_bytes() == first


def test_what_the_box_cuts_is_proposed_and_grow_takes_it_along(scene_folder: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(scene_folder, tmp_path / "cut")
    (folder / "roi.json").write_text(json.dumps({"center": [-0.08, 0, 0.26], "size": [0.46, 0.62, 0.56]}))
    summaries = []
    for name, more in (("plain", ()), ("grown", ("--grow",))):
        written = ("--summary", tmp_path / f"{name}.json")
        remove(folder, tmp_path / f"{name}.ply", "--preset", "draft", *written, *more)
        summaries.append(read_json(tmp_path / f"{name}.json"))
    plain, grown = summaries
    assert plain["proposed"]["gaussians"] > 100 and set(plain["proposed"]["box"]) == {"center", "size", "rotation_wxyz"}
    assert any("--grow" in w for w in plain["warnings"]) and not any("--grow" in w for w in grown["warnings"])
    assert grown["proposed"] == {"gaussians": 0, "box": None}
    assert grown["selection"]["removed_grown"] == plain["proposed"]["gaussians"]
    high = [int((read_ply(tmp_path / f"{n}.ply").gaussians.means[:, 2] > 0.3).sum()) for n in ("plain", "grown")]
    assert high[1] < 0.1 * high[0]


def test_extra_masks_are_filled_too(scene_folder: Path, tmp_path: Path) -> None:
    camera = cameras()[4]
    shadow = np.zeros((camera.height, camera.width), bool)
    shadow[70:80, 20:40] = True  # floor beside the block
    write_png(tmp_path / "extra" / f"{output_name(camera.id)}.png", shadow)
    extra = ("--extra-masks", tmp_path / "extra")
    remove(scene_folder, tmp_path / "out.ply", *extra, "--summary", tmp_path / "s.json", "--job", tmp_path / "job")
    summary = read_json(tmp_path / "s.json")
    selection, counts = summary["selection"], summary["counts"]
    assert selection["removed_inside"] > 1000 and selection["removed_masked"] > 0
    assert len(read_ply(tmp_path / "out.ply").gaussians) == counts["gaussians_out"]
    assert counts["removed"] >= selection["removed_inside"] + selection["removed_masked"]
    run("masks", *files_of(scene_folder), "--progress", "none", "--out", tmp_path / "masks", *extra)
    drawn = read_image(tmp_path / "masks" / f"{output_name(camera.id)}.png").max(-1) > 0
    assert drawn[shadow].all() and not drawn.all()


def test_a_folder_without_a_mask_is_refused(
    scene_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "empty").mkdir()
    options = ("--progress", "none", "--out", tmp_path / "m", "--extra-masks", tmp_path / "empty")
    run("masks", *files_of(scene_folder), *options, expect=2)
    assert "--extra-masks" in capsys.readouterr().err and not (tmp_path / "m").exists()


@pytest.mark.parametrize("preset", ["draft", "balanced", "best", "paper", "paper-literal"])
def test_every_preset_runs_and_its_summary_is_strict_json(preset: str, scene_folder: Path, tmp_path: Path) -> None:
    few = ("--set", "refine.steps=20") if preset.startswith("paper") else ()
    remove(scene_folder, tmp_path / "out.ply", "--preset", preset, "--summary", tmp_path / "s.json", *few)

    def refuse(word: str) -> None:
        raise AssertionError(f"{word} is not JSON")

    summary = json.loads((tmp_path / "s.json").read_text(), parse_constant=refuse)
    assert summary["counts"]["added"] > 0 and summary["settings"]["preset"] == preset


def test_render_writes_every_pass(scene_folder: Path, tmp_path: Path) -> None:
    scene_, cams = files_of(scene_folder)[0], ("--cameras", scene_folder / "transforms.json")
    drawn = ("--frames", "orbit/000,orbit/001", "--passes", "rgb,alpha,depth,normal", "--scale", "0.5")
    run("render", scene_, *cams, "--out", tmp_path, *drawn, "--progress", "none")
    made = {p.relative_to(tmp_path).as_posix() for p in tmp_path.rglob("*.*")}
    assert made == {f"orbit/00{k}{e}" for k in (0, 1) for e in (".png", ".alpha.png", ".depth.npy", ".normal.npy")}
    depth = np.load(tmp_path / "orbit" / "000.depth.npy")
    assert depth.shape == (45, 60) and depth.dtype == np.float32 and depth.max() > 0


@pytest.mark.parametrize("mode", ["need", "paper"])
def test_masks_are_0_and_255(mode: str, scene_folder: Path, tmp_path: Path) -> None:
    run("masks", *files_of(scene_folder), "--out", tmp_path, "--mode", mode, "--progress", "none")
    assert set(np.unique(read_image(tmp_path / "orbit" / "000.png"))) == {0, 255}


def test_masks_show_what_a_removal_would_do(scene_folder: Path, tmp_path: Path) -> None:
    shown = ("--frames", "orbit/000", "--pictures", tmp_path / "shown", "--progress", "none")
    run("masks", *files_of(scene_folder), "--out", tmp_path / "need", *shown)
    assert {p.name for p in (tmp_path / "shown" / "orbit").iterdir()} == {"000.mask.png", "000.depth.png"}


def test_orbit_writes_so_many_cameras(scene_folder: Path, tmp_path: Path) -> None:
    scene_, roi = files_of(scene_folder)[0], ("--roi", scene_folder / "roi.json")
    run("orbit", scene_, *roi, "--out", tmp_path / "c.json", "--views", "5", "--size", "64x48")
    assert len(read_json(tmp_path / "c.json")["frames"]) == 5


def test_evaluate_leaves_out_what_is_excluded(scene_folder: Path, tmp_path: Path) -> None:
    scene_, cams = files_of(scene_folder)[0], ("--cameras", scene_folder / "transforms.json")
    run("render", scene_, *cams, "--out", tmp_path / "t", "--progress", "none")
    run("masks", *files_of(scene_folder), "--out", tmp_path / "m", "--progress", "none")
    folders = ("--pred", tmp_path / "t", "--truth", tmp_path / "t", "--masks", tmp_path / "m")
    run("evaluate", *folders, "--exclude", "orbit/003.png", "--json", tmp_path / "e.json")
    scores = read_json(tmp_path / "e.json")
    assert len(scores["views"]) == 8 and scores["mean"]["ssim"] == pytest.approx(1) and scores["mean"]["flip"] < 1e-6


def test_info_as_json(scene_folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run("info", scene_folder / "scene.ply", "--json")
    assert json.loads(capsys.readouterr().out)["gaussians"] == len(scene())


RENDER = "render scene.ply --cameras transforms.json --out r"
VIEWS = "remove scene.ply --cameras transforms.json"
REMOVE = f"{VIEWS} --roi roi.json"
BAD = {  # the command, its exit code, and what its error says
    "missing scene": ("info nowhere.ply", 2, "cannot read"),
    "mesh": ("info mesh.ply", 2, "not a Gaussian scene"),
    "compressed": ("info compressed.ply", 2, "compressed"),
    "truncated": ("info truncated.ply", 2, "truncated"),
    "absurd count": ("info absurd.ply", 2, "truncated"),
    "no end of header": ("info endless.ply", 2, "end_header"),
    "not a PLY": ("info roi.json", 2, "not a PLY"),
    "no command": ("", 2, "required"),
    "unknown command": ("fill", 2, "invalid choice"),
    "missing options": ("remove scene.ply", 2, "remove needs"),
    "roi not JSON": (f"{VIEWS} --roi scene.ply", 2, "ROI"),
    "roi missing": (f"{VIEWS} --roi no.json", 2, "ROI"),
    "roi flat": (f"{VIEWS} --roi flat.json", 2, "positive"),
    "everything selected": (f"{VIEWS} --roi all.json", 3, "whole scene"),
    "no view sees it": ("remove scene.ply --cameras away.json --roi roi.json", 3, "no usable view"),
    "cameras not JSON": ("remove scene.ply --cameras mesh.ply --roi roi.json", 2, "not JSON"),
    "cameras of another kind": ("remove scene.ply --cameras roi.json --roi roi.json", 2, "no cameras"),
    "fisheye": ("remove scene.ply --cameras fisheye.json --roi roi.json", 2, "fisheye"),
    "panoramic": ("remove scene.ply --cameras pano.json --roi roi.json", 2, "panoramic"),
    "orthographic": ("remove scene.ply --cameras ortho.json --roi roi.json", 2, "orthographic"),
    "climbing ID": ("remove scene.ply --cameras climb.json --roi roi.json", 2, "leads out"),
    "unknown reference": (f"{REMOVE} --reference x", 2, "no camera x"),
    "unknown chart": (f"{REMOVE} --reference chart:9", 2, "there is 1 chart, chart:1"),
    "no chart zero": (f"{REMOVE} --reference chart:0", 2, "there is 1 chart, chart:1"),
    "chart of a preset without": (f"{REMOVE} --reference chart:1 --preset paper", 2, "photos are the only"),
    "chart where none is found": (
        f"{REMOVE} --reference chart:1 --set charts.least=2",
        2,
        "no chart is found here; name a view",
    ),
    "picture of another surface than the chart's": (
        f"{REMOVE} --reference chart:1 --reference-image square.png",
        2,
        "does not match",
    ),
    "picture of another shape than the chart's": (
        f"{REMOVE} --reference chart:1 --reference-image wide.png",
        2,
        "shape",
    ),
    "picture of another view": (f"{REMOVE} --reference orbit/000 --reference-image noise.png", 2, "does not match"),
    "picture of another shape": (f"{REMOVE} --reference orbit/000 --reference-image square.png", 2, "shape"),
    "picture without its view": (f"{REMOVE} --reference-image noise.png", 2, "--reference"),
    "unknown provider": (f"{REMOVE} --inpaint magic", 2, "unknown provider"),
    "unknown prior": (f"{REMOVE} --depth-prior magic", 2, "unknown provider"),
    "failing command": (f"{REMOVE} --inpaint 'command:false {{out}}'", 2, "ended with 1"),
    "unknown setting": (f"{REMOVE} --set a.b=1", 2, "no setting"),
    "setting of a wrong type": (f"{REMOVE} --set seed.opacity=much", 2, "takes a float"),
    "negative number": (f"{REMOVE} --set extra_references=-1", 2, "extra_references: must be from 0 to 1000, got -1"),
    "NaN for a setting": (f"{REMOVE} --set masks.selection.support=nan", 2, "a finite number"),
    "a huge setting": (f"{REMOVE} --set extra_references=1000000000", 2, "from 0 to 1000"),
    "charts of no pixels": (f"{REMOVE} --set charts.largest=0", 2, "charts.largest: must be from 1 to 1000, got 0"),
    "surroundings of no cells": (f"{REMOVE} --set surroundings.cells=0", 2, "no setting"),
    "an unknown word for a setting": (f"{REMOVE} --set masks.mode=some", 2, "need or paper expected"),
    "a file for a job": ("remove --job roi.json", 2, "job.json"),
    "a file for a new job": (f"{REMOVE} --job roi.json", 2, "cannot make the folder"),
    "one pixel for a photo": ("remove scene.ply --cameras pixel.json --roi roi.json", 2, "far fewer"),
    "a preset of a later version": (f"{REMOVE} --preset someday", 2, "not in this version"),
    "negative seed": (f"{REMOVE} --seed -1", 2, "--seed"),
    "no CUDA": (f"{REMOVE} --device cuda", 2, "CUDA"),
    "no job there": ("remove --job nowhere", 2, "job.json"),
    "no threads": (f"{RENDER} --threads 0", 2, "--threads"),
    "unknown pass": (f"{RENDER} --passes rgb,smell", 2, "unknown pass"),
    "unknown frame": (f"{RENDER} --frames nobody", 2, "no camera nobody"),
    "up is zero": ("orbit scene.ply --roi roi.json --out c.json --up 0,0,0", 2, "up direction"),
    "nothing to score": ("evaluate --pred a --truth b --masks c", 2, "not a folder"),
}


@pytest.fixture(scope="module")
def bad_folder(scene_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("bad")
    for name in ("scene.ply", "transforms.json", "roi.json"):
        shutil.copy2(scene_folder / name, folder)
    whole = (folder / "scene.ply").read_bytes()
    (folder / "truncated.ply").write_bytes(whole[: len(whole) // 2])
    head = "ply\nformat binary_little_endian 1.0\nelement vertex {}\nproperty float x\nproperty float f_dc_0\n"
    (folder / "absurd.ply").write_text(head.format(10**17) + "end_header\n")
    (folder / "endless.ply").write_text(head.format(1))
    (folder / "mesh.ply").write_text("ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n0\n")
    (folder / "compressed.ply").write_text(
        "ply\nformat binary_little_endian 1.0\nelement chunk 1\nproperty float min_x\nelement vertex 1\n"
        "property uint packed_position\nend_header\n"
    )
    (folder / "flat.json").write_text('{"center": [0,0,0], "size": [1,0,1]}')
    (folder / "all.json").write_text('{"center": [0,0,0], "size": [99,99,99]}')
    document = read_json(folder / "transforms.json")
    models = {"fisheye": "OPENCV_FISHEYE", "pano": "EQUIRECTANGULAR", "ortho": "ORTHOGRAPHIC"}
    for name, model in models.items():
        (folder / f"{name}.json").write_text(json.dumps({**document, "camera_model": model}))
    (folder / "pixel.json").write_text(
        json.dumps({**document, "frames": [{**document["frames"][0], "file_path": "1"}]})
    )
    write_png(folder / "1.png", np.zeros((1, 1, 3), np.uint8))
    climbing = [{**f, "file_path": "../" + f["file_path"]} for f in document["frames"]]
    (folder / "climb.json").write_text(json.dumps({**document, "frames": climbing}))
    turned = [dict(f) for f in document["frames"]]
    for frame in turned:
        frame["transform_matrix"] = (np.array(frame["transform_matrix"]) @ np.diag([-1, 1, -1, 1])).tolist()
    (folder / "away.json").write_text(json.dumps({**document, "frames": turned}))
    noise = np.random.default_rng(0).integers(0, 255, (90, 120, 3), dtype=np.uint8)
    write_png(folder / "noise.png", noise)
    write_png(folder / "square.png", noise[:, :90])
    write_png(folder / "wide.png", noise[:30])
    return folder


@pytest.mark.parametrize("name", BAD)
def test_bad_input_gives_one_line_the_right_code_and_no_output(
    name: str, bad_folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    words, code, says = BAD[name]
    monkeypatch.chdir(bad_folder)
    before = set(bad_folder.rglob("*"))
    to = ("--out", "out.ply", "--progress", "none") if words.startswith("remove") and "--roi" in words else ()
    run(*shlex.split(words), *to, expect=code)
    said = capsys.readouterr().err.strip().splitlines()
    assert len(said) == 1 and said[0].startswith("gimp3d: error: ") and says in said[0], said
    assert set(bad_folder.rglob("*")) == before


def test_an_output_that_cannot_be_written_is_one_line(
    scene_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").write_text("in the way")
    remove(scene_folder, tmp_path / "file" / "out.ply", expect=2)
    assert "cannot write" in capsys.readouterr().err


def test_an_interrupted_run_ends_with_130_and_leaves_nothing(scene_folder: Path, tmp_path: Path) -> None:
    code = (
        "import gimp3d.cli as c, gimp3d.commands as k\n"
        "def stop(*a, **b): raise KeyboardInterrupt\n"
        "k.remove_object = stop\n"
        "import sys; sys.exit(c.main(sys.argv[1:]))"
    )
    arguments = ["remove", *files_of(scene_folder), "--out", tmp_path / "out.ply", "--progress", "none"]
    done = subprocess.run([sys.executable, "-c", code, *map(str, arguments)], capture_output=True, text=True)
    assert done.returncode == 130 and done.stderr.startswith("gimp3d: error: interrupted")
    assert not list(tmp_path.iterdir())


def test_output_names_drop_the_extension_only() -> None:
    assert output_name("images/000.png") == "images/000"
    assert output_name("a.b/c") == "a.b/c"
    assert output_name("photo.v2.jpg") == "photo.v2"
