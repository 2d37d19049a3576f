"""Whole removals on real scenes with truth, and on a real scan without: scores, rings, T, verdicts and pictures.

    python scripts/bench_real.py [DATA] [--scenes a,b] [--presets draft,balanced] [--reuse] [--out build/bench_real]

Each scene is run with the true picture of its first test view and without any, as `gimp3d` in a process of its own.
Scenes with a shadow are run as they are, and with the true shadow marked. Writes OUT/table.md, OUT/results.json and
OUT/index.html with a sheet of pictures per run. Run by `make bench-real`.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from bench_raster import ROOT, machine, say, write
from pages import fitted, sheet, titled
from real_report import BUILT_IN, EMPTIED, GIVEN, PAPER, REAL, TELEA, markdown, page
from real_scenes import (
    Scene,
    coverage,
    outside_hidden_volume,
    read_scene,
    round_the_object,
)

from gimp3d.camera import Camera, output_name
from gimp3d.commands import render_views
from gimp3d.errors import BadInput
from gimp3d.evaluate.benchmark import empty_region, photo_with_object, score_renders, telea
from gimp3d.evaluate.metrics import psnr
from gimp3d.io.cameras import read_cameras
from gimp3d.io.images import load_view, read_image, write_png
from gimp3d.io.ply import read_ply, write_ply

SCENES = (*REAL, "kitchen_480")
PRESETS = ("draft", "balanced", "best", PAPER)
SHOWN = 8  # views of a scene without truth
AMPLIFIED = 4  # times the difference
OUTLINE = (255, 255, 255)


@dataclass(frozen=True)
class Run:
    """One removal of a scene."""

    preset: str
    given: bool  # the true picture of the first test view
    marked: bool  # the true shadow

    @property
    def kind(self) -> str:
        return GIVEN if self.given else BUILT_IN

    @property
    def name(self) -> str:
        return "_".join([self.preset, self.kind, *["shadow_marked"] * self.marked])


def planned(scene: Scene, presets: Sequence[str]) -> Iterator[Run]:
    """The scene's removals. The paper's preset is a baseline: run once, with the picture that its protocol gives.

    Without truth there is no picture to give, and nothing marked.
    """
    for marked in (False, True)[: 1 + scene.has_shadow]:
        for preset in presets:
            for given in (True, False)[not scene.has_truth :]:
                if preset != PAPER or (given, marked) == (scene.has_truth, scene.has_shadow):
                    yield Run(preset, given, marked)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", nargs="?", type=Path, default=ROOT.parent / "shared" / "data" / "withwithout")
    parser.add_argument("--scenes", default=",".join(SCENES), help="folders of DATA, or of real/ beside it")
    parser.add_argument("--presets", default=",".join(PRESETS))
    parser.add_argument("--reuse", action="store_true", help="score removals that lie in OUT instead of running them")
    parser.add_argument("--out", type=Path, default=ROOT / "build" / "bench_real")
    given = parser.parse_args()
    presets = tuple(given.presets.split(","))
    results: dict[str, Any] = {"machine": machine(), "rows": [], "coverage": [], "pictures": []}
    try:
        scenes = [read_scene(folder_of(given.data, name)) for name in given.scenes.split(",")]
        if not given.reuse:
            compile_kernels(scenes[0], given.out)
        for scene in scenes:
            bench_scene(scene, presets, given.out, given.reuse, results)
            write(given.out / "results.json", json.dumps(results, indent=1))
    except BadInput as error:
        print(f"bench_real: error: {error}", file=sys.stderr)
        return error.exit_code
    say("\n" + markdown(results))
    write(given.out / "table.md", markdown(results))
    write(given.out / "index.html", page(results))
    return 0


def folder_of(data: Path, name: str) -> Path:
    return next((f for f in (data / name, data.parent / "real" / name) if f.is_dir()), data / name)


def compile_kernels(scene: Scene, out: Path) -> None:
    """A removal with a single step of refinement, refused or not, so that nothing that is timed compiles."""
    gimp3d([*remove_words(scene, out / "compiled.ply"), "--preset", "balanced", "--set", "refine.steps=1"])


def bench_scene(scene: Scene, presets: Sequence[str], out: Path, reuse: bool, results: dict[str, Any]) -> None:
    """Add a scene's rows, its coverage and its sheets of pictures to the results."""
    folder, shadows, before = out / scene.name, [False, True][: 1 + scene.has_shadow], {}
    if scene.has_truth:
        render_views(scene.folder / "scene.ply", scene.folder / "transforms.json", folder / "before", split="test")
        before = {f"{name} before": value for name, value in round_the_object(scene, folder / "before").items()}
        for marked in shadows:
            counts = {"marked": marked, "counts": marked == scene.has_shadow}
            results["coverage"].append({"scene": scene.name, **counts, **masks(scene, marked, folder, reuse)})
            for method, renders in baselines(scene, marked, folder).items():
                row = {"scene": scene.name, "method": method, "kind": "", **counts, **before}
                results["rows"].append(row | scored(scene, renders))
    for run in planned(scene, presets):
        row = {"scene": scene.name, "method": run.preset, "kind": run.kind, "marked": run.marked, **before}
        row |= {"counts": run.marked == scene.has_shadow, **measured(scene, run, folder / run.name, reuse)}
        if "psnr mask" in row:
            row["error"] = row["ring before"] - row["psnr mask"]
        if "refused" not in row:
            for name, picture in sheets(scene, folder / run.name / "render").items():
                write_png(folder / f"{run.name}{name}.png", picture)
                results["pictures"].append(f"{scene.name}/{run.name}{name}.png")
        results["rows"].append(row)
        numbers = "".join(f"{row[key]:8.2f}" for key in ("psnr mask", "psnr unseen", "seconds") if key in row)
        say(f"{scene.name:16}{run.name:32}{numbers}{row.get('refused', '')}")


def masks(scene: Scene, marked: bool, folder: Path, reuse: bool) -> dict[str, float]:
    """Coverage of T as `gimp3d masks` writes it."""
    targets = folder / ("masks_shadow_marked" if marked else "masks")
    if not (reuse and targets.is_dir()):
        words = ["masks", *scene_words(scene), "--out", str(targets)]
        if message := gimp3d([*words, *(shadow_words(scene, folder) if marked else [])]):
            raise BadInput(message)
    return coverage(scene, targets, marked)


def baselines(scene: Scene, marked: bool, folder: Path) -> dict[str, Path]:
    """Pictures of the emptied box, and of Telea's fill of the photos with the object (and the shadow, if marked)."""
    emptied, filled = folder / "emptied", folder / ("telea_shadow_marked" if marked else "telea")
    empty_region(scene.folder, emptied / "out.ply")
    render_views(emptied / "out.ply", scene.folder / "transforms.json", emptied / "render", split="test")
    for camera in scene.test:
        picture = telea(photo_with_object(scene.folder, camera.id), scene.covered(camera, marked))
        write_png(filled / f"{output_name(camera.id)}.png", picture)
    return {EMPTIED: emptied / "render", TELEA: filled}


def measured(scene: Scene, run: Run, folder: Path, reuse: bool) -> dict[str, Any]:
    """A removal's scores, or why it was refused."""
    out, refused, summary_path = folder / "out.ply", folder / "refused.txt", folder / "summary.json"
    if not (reuse and (summary_path.exists() or refused.exists())):
        for path in (out, refused, summary_path):
            path.unlink(missing_ok=True)
        words = [*remove_words(scene, out), "--summary", str(summary_path), "--preset", run.preset]
        if run.given:
            reference = scene.test[0].id
            words += ["--reference", reference, "--reference-image", str(scene.folder / reference)]
        if message := gimp3d([*words, *(shadow_words(scene, folder.parent) if run.marked else [])]):
            write(refused, message)
    if refused.exists():
        return {"refused": refused.read_text()}
    summary = json.loads(summary_path.read_text())
    counts = summary["counts"]
    row: dict[str, Any] = {"seconds": summary["seconds_total"], "score": (summary.get("verdict") or {}).get("score")}
    row |= {key: counts[key] for key in ("removed", "added", "hole_pixels", "open_pixels")}
    drawn = {"split": "test"} if scene.has_truth else {"frames": [c.id for c in shown(scene)]}
    render_views(out, scene.folder / "transforms.json", folder / "render", **drawn)
    if scene.has_truth:
        file = read_ply(out)
        new = np.arange(len(file.gaussians)) >= counts["gaussians_out"] - counts["added"] + counts["lifted"]
        views = [(c, scene.covered(c, run.marked)) for c in scene.train]
        astray = outside_hidden_volume(file.gaussians.means[new], views)
        row |= {"outside": float(astray.mean()) if new.any() else 0.0, **scored(scene, folder / "render")}
        write_ply(folder / "unfilled.ply", file, ~new)
        render_views(folder / "unfilled.ply", scene.folder / "transforms.json", folder / "unfilled", split="test")
        unfilled = score_renders(scene.folder, folder / "unfilled", scene.test[0].id)
        row |= {f"{key} unfilled": value for key, value in unfilled.items()}
    return row


def scored(scene: Scene, renders: Path) -> dict[str, float]:
    after = {f"{name} after": value for name, value in round_the_object(scene, renders).items()}
    return score_renders(scene.folder, renders, scene.test[0].id) | after


def shadow_words(scene: Scene, folder: Path) -> list[str]:
    """How a command is told of the true shadow: the only place that knows."""
    marks = folder / "shadows"
    for camera in scene.train:
        write_png(marks / f"{output_name(camera.id)}.png", scene.shadow(camera))
    return ["--extra-masks", str(marks)]


def scene_words(scene: Scene) -> list[str]:
    cameras, roi = scene.folder / "transforms.json", scene.folder / "roi.json"
    return [str(scene.folder / "scene.ply"), "--cameras", str(cameras), "--roi", str(roi), "--quiet"]


def remove_words(scene: Scene, out: Path) -> list[str]:
    return ["remove", *scene_words(scene), "--out", str(out)]


def gimp3d(words: Sequence[str]) -> str:
    """Run the program; what it said if it failed, else nothing."""
    done = subprocess.run([sys.executable, "-m", "gimp3d", *words], stderr=subprocess.PIPE, text=True, check=False)
    said = done.stderr.strip().splitlines() or [f"gimp3d {words[0]} ended with {done.returncode}"]
    return said[-1].removeprefix("gimp3d: error: ") if done.returncode else ""


def shown(scene: Scene) -> list[Camera]:
    """Views that are looked at where there is no truth, spread over all."""
    chosen = np.unique(np.linspace(0, len(scene.train) - 1, SHOWN).round().astype(int))
    return [scene.train[k] for k in chosen]


def sheets(scene: Scene, renders: Path) -> dict[str, np.ndarray]:
    """End of the file's name → a run's sheet, [H, W, 3] uint8: a row per view, whole and close up."""
    if not scene.has_truth:
        return {"": stacked([without_truth(scene, c, renders) for c in shown(scene)])}
    rows = [with_truth(scene, c, renders) for c in scene.test]
    windows = [window_round(scene.hides(c)) for c in scene.test]
    close = [{words: picture[window] for words, picture in row.items()} for row, window in zip(rows, windows)]
    return {"": stacked(rows), ".close": stacked(close)}


def stacked(rows: Sequence[dict[str, np.ndarray]]) -> np.ndarray:
    """Rows of pictures under their words, each as large as it gets where the largest one fits."""
    height, width = np.max([picture.shape[:2] for row in rows for picture in row.values()], axis=0)
    tiles = [titled(fitted(picture, (width, height)), words) for row in rows for words, picture in row.items()]
    return sheet(tiles, len(rows[0]))


def window_round(mask: np.ndarray) -> tuple[slice, slice]:
    """The mask's bounds with half their size more on each side, within the picture; all of it for an empty mask."""
    if not mask.any():
        return slice(None), slice(None)
    bounds = [np.flatnonzero(mask.any(axis)) for axis in (1, 0)]
    sizes = [int(np.ptp(b)) + 1 for b in bounds]
    row, col = (slice(max(0, b[0] - n // 2), b[-1] + n // 2 + 1) for b, n in zip(bounds, sizes))
    return row, col


def with_truth(scene: Scene, camera: Camera, renders: Path) -> dict[str, np.ndarray]:
    """Photo with the object, truth, result, and how they differ, with the outline of what the object hides."""
    name, truth = output_name(camera.id), read_image(scene.folder / camera.id)
    drawn, mask = read_image(renders / f"{name}.png"), scene.hides(camera)
    wrong = np.clip(AMPLIFIED * np.abs(drawn.astype(int) - truth), 0, 255).astype(np.uint8)
    contours, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(wrong, contours, -1, OUTLINE, 1)
    words = f"result: {psnr(drawn, truth, mask):.2f} dB"
    photo, title = photo_with_object(scene.folder, camera.id), name + " (not scored)" * (camera is scene.test[0])
    return {title: photo, "truth": truth, words: drawn, f"{AMPLIFIED} x difference": wrong}


def without_truth(scene: Scene, camera: Camera, renders: Path) -> dict[str, np.ndarray]:
    """Photo, and result drawn."""
    name = output_name(camera.id)
    distorted = next(c for c in read_cameras(scene.folder / "transforms.json") if c.id == camera.id)
    return {name: load_view(distorted)[0], "result": read_image(renders / f"{name}.png")}


if __name__ == "__main__":
    sys.exit(main())
