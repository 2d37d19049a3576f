"""The removal benchmark: scenes rendered with and without the object, scored against the truth, beside baselines.

Protocol: the true picture of the first test view is the reference (as in the paper) and is left out of the scores; the
others are averaged in the mask of what the object hid and in the part of it that no training view sees.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from ..box import read_region
from ..camera import output_name
from ..commands import render_views, run_removal, select_cameras
from ..errors import BadInput
from ..geometry import dilated
from ..io.cameras import read_cameras
from ..io.images import read_image, read_mask, write_png
from ..io.ply import read_ply, write_ply
from ..job import RemovalJob
from ..progress import Progress, silent
from ..stages.selection import select_removed
from .metrics import evaluate_folders

MASKS = {"mask": ".mask.png", "unseen": ".unseen.png"}
DILATION = 3  # px by which Telea's mask is grown on the photo with the object
BASELINES = ("hole open", "telea")


def run_benchmark(
    data: Path, out: Path, scenes: Sequence[str], presets: Sequence[str], progress: Progress = silent
) -> list[dict[str, Any]]:
    """Run scenes below `data`, all if none is named, with every preset and baseline; one row of scores each.

    Raises
    ------
    BadInput
        If `data` holds no scene with `truth/`.
    """
    names = list(scenes) or sorted(p.parent.name for p in data.glob("*/truth") if (p.parent / "scene.ply").exists())
    if not names or not all((data / n / "truth").is_dir() for n in names):
        raise BadInput(f"bench: {data} holds no scene folders with scene.ply, transforms.json, roi.json and truth/")
    runs, rows = [(name, method) for name in names for method in (*BASELINES, *presets)], []
    for k, (name, method) in enumerate(runs):
        progress("bench", k, len(runs), f"{name}: {method}")
        rows.append(_run(data / name, out / name / method.replace(" ", "_"), method))
    progress("bench", 1, 1, "done")
    return rows


def _run(scene: Path, out: Path, method: str) -> dict[str, Any]:
    cameras = select_cameras(read_cameras(scene / "transforms.json"), "test")
    reference, start, added = cameras[0], time.perf_counter(), 0
    if method == "telea":
        for camera in cameras[1:]:
            name = output_name(camera.id)
            mask = read_mask(scene / "truth" / f"{name}{MASKS['mask']}")
            write_png(out / "render" / f"{name}.png", telea(photo_with_object(scene, camera.id), mask))
    elif method == "hole open":
        empty_region(scene, out / "out.ply")
    else:
        ply, cams, roi, picture = (str(scene / n) for n in ("scene.ply", "transforms.json", "roi.json", reference.id))
        target = str(out / "out.ply")
        job = RemovalJob(ply, cams, roi, target, reference=reference.id, reference_image=picture, preset=method)
        counts = run_removal(job)["counts"]
        added = counts["added"] - counts["changed"]
    seconds = time.perf_counter() - start
    if method != "telea":
        render_views(out / "out.ply", scene / "transforms.json", out / "render", split="test")
    row: dict[str, Any] = {"scene": scene.name, "method": method, "seconds": seconds, "added": added}
    return row | score_renders(scene, out / "render", reference.id)


def score_renders(scene: Path, renders: Path, reference: str) -> dict[str, float]:
    """Means over the drawn test views but the reference: "psnr mask", "ssim unseen" and so on."""
    folder = Path(output_name(reference)).parent
    row: dict[str, float] = {}
    folders = (renders / folder, scene / folder, scene / "truth" / folder)
    for key, suffix in MASKS.items():
        scores = evaluate_folders(*folders, suffix, (Path(reference).name,))
        row |= {f"{metric} {key}": value for metric, value in scores["mean"].items()}
    return row


def empty_region(scene: Path, out: Path) -> None:
    """Write the scene without the Gaussians whose centre lies in the region; nothing is filled."""
    file = read_ply(scene / "scene.ply")
    write_ply(out, file, ~select_removed(file.gaussians, read_region(scene / "roi.json")))


def photo_with_object(scene: Path, camera_id: str) -> np.ndarray:
    """A test view's photo with the object [H, W, 3] uint8: for baselines, never input to a removal."""
    stem = Path(camera_id).stem
    return read_image(next((scene / "images").glob(f"with_test_{stem}.*"), scene / "images" / f"with_test_{stem}.png"))


def telea(photo: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """OpenCV's Telea on a photo [H, W, 3] uint8, the mask [H, W] bool dilated; [H, W, 3] uint8."""
    return cv2.inpaint(photo, dilated(mask, DILATION).astype(np.uint8), 3, cv2.INPAINT_TELEA)


def table(rows: Sequence[dict[str, Any]]) -> str:
    """The scores as a Markdown table, with the mean over scenes of each method."""
    keys = [f"{metric} {mask}" for mask in MASKS for metric in ("psnr", "ssim", "flip")]
    lines = [
        "| scene | method | PSNR mask | SSIM | FLIP | PSNR unseen | SSIM | FLIP | added | seconds |",
        "|---|---|---:|---:|---:|---:|---:|---:|---:|---:|",
    ]
    means = []
    for method in dict.fromkeys(r["method"] for r in rows):
        own = [r for r in rows if r["method"] == method]
        numbers = {k: float(np.mean([r[k] for r in own])) for k in (*keys, "added", "seconds")}
        means.append({"scene": "**mean**", "method": method, **numbers})
    for row in [*rows, *means]:
        cells = [f"{row[k]:.2f}" if k.startswith("psnr") else f"{row[k]:.3f}" for k in keys]
        removed = row["method"] not in BASELINES  # else no removal was run: times would compare nothing
        extra = [f"{row['added']:.0f}", f"{row['seconds']:.1f}"] if removed else ["", ""]
        lines.append(f"| {row['scene']} | {row['method']} | {' | '.join([*cells, *extra])} |")
    return "\n".join(lines)
