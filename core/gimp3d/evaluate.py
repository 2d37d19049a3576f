"""Scores against true pictures: PSNR, SSIM and FLIP inside a mask; and the removal benchmark beside baselines.

The benchmark's scenes are rendered with and without the object. The true picture of the first test view is the
reference (as in the paper) and is left out of the scores; the others are averaged in the mask of what the object hid
and in the part of it that no training view sees. What it runs is imported there: scores alone need no kernels.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path, PurePosixPath
from typing import Any

import cv2
import numpy as np

from .box import in_region, read_region
from .camera import output_name
from .errors import BadInput
from .io.cameras import read_cameras
from .io.images import read_image, read_mask, write_png
from .io.ply import read_ply, write_ply
from .job import RemovalJob
from .progress import Progress, silent

PIXELS_PER_DEGREE = 67.0  # FLIP's default viewing condition
PSNR_OF_EQUAL = 100.0  # dB reported for identical pictures, as JSON knows no infinity
SSIM_SIGMA, SSIM_SIDE = 1.5, 11  # Wang et al. 2004
PHOTO_SUFFIXES = {".png", ".jpg", ".jpeg", ".tif", ".tiff", ".webp", ".exr"}  # what a camera's ID may end in
MASKS = {"mask": ".mask.png", "unseen": ".unseen.png"}
DILATION = 3  # px by which Telea's mask is grown on the photo with the object
BASELINES = ("hole open", "telea")


def psnr(pred: np.ndarray, truth: np.ndarray, mask: np.ndarray) -> float:
    """Peak signal-to-noise ratio in dB of pictures [H, W, 3] uint8 over a mask's pixels, [H, W] bool, not empty.

    Examples
    --------
    >>> truth, mask = np.zeros((4, 4, 3), np.uint8), np.ones((4, 4), bool)
    >>> round(psnr(truth + np.uint8(16), truth, mask), 2)
    24.05
    """
    error = ((pred[mask].astype(np.float64) - truth[mask]) ** 2).mean()
    return PSNR_OF_EQUAL if error == 0 else min(PSNR_OF_EQUAL, 10 * float(np.log10(255.0**2 / error)))


def ssim_map(pred: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """[H, W] structural similarity of pictures [H, W, 3] uint8, mean of the channels (Wang et al. 2004)."""
    a, b = pred.astype(np.float64) / 255, truth.astype(np.float64) / 255

    def blur(x: np.ndarray) -> np.ndarray:
        return cv2.GaussianBlur(x, (SSIM_SIDE, SSIM_SIDE), SSIM_SIGMA, borderType=cv2.BORDER_REFLECT_101)

    c1, c2 = 0.01**2, 0.03**2
    mean_a, mean_b = blur(a), blur(b)
    var_a, var_b = blur(a * a) - mean_a**2, blur(b * b) - mean_b**2
    covariance = blur(a * b) - mean_a * mean_b
    top = (2 * mean_a * mean_b + c1) * (2 * covariance + c2)
    return (top / ((mean_a**2 + mean_b**2 + c1) * (var_a + var_b + c2))).mean(-1)


def flip_map(pred: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """[H, W] LDR-FLIP in [0, 1] of pictures [H, W, 3] uint8 (Andersson et al. 2020), by NVIDIA's flip-evaluator.

    Raises
    ------
    BadInput
        If flip-evaluator is not installed.
    """
    try:
        import flip_evaluator
    except ImportError:
        raise BadInput("evaluate: FLIP needs the package flip-evaluator (pip install 'gimp3d[evaluate]')") from None
    pair, options = (p.astype(np.float32) / 255 for p in (truth, pred)), {"ppd": PIXELS_PER_DEGREE}
    error, _, _ = flip_evaluator.evaluate(*pair, "LDR", applyMagma=False, computeMeanError=False, parameters=options)
    return np.asarray(error, np.float64).reshape(pred.shape[:2])


def score(pred: np.ndarray, truth: np.ndarray, mask: np.ndarray) -> dict[str, float]:
    """PSNR, SSIM and FLIP in the mask. What lies outside does not count (windows reach out by their radius)."""
    return {
        "psnr": psnr(pred, truth, mask),
        "ssim": float(ssim_map(pred, truth)[mask].mean()),
        "flip": float(flip_map(pred, truth)[mask].mean()),
    }


def evaluate_folders(
    pred: Path, truth: Path, masks: Path, mask_suffix: str = ".mask.png", exclude: Sequence[str] = ()
) -> dict[str, Any]:
    """Scores of every picture that both folders have: {"views": {stem: {psnr, ssim, flip}}, "mean", "warnings"}.

    A picture's stem is its path below `pred` without .png; its mask is stem + suffix, else stem.png. Excluded are
    stems or camera IDs, with or without extension and leading folders (test/000.jpg, test/000 and 000 all name
    000.png). A true picture with a mask that nobody predicted is a warning: a mean must not rise by leaving views out.

    Raises
    ------
    BadInput
        If a folder is missing, nothing pairs up, or sizes differ.
    """
    for folder in (pred, truth, masks):
        if not folder.is_dir():
            raise BadInput(f"evaluate: {folder} is not a folder")
    unused = set(exclude)
    views: dict[str, dict[str, float]] = {}
    warnings: list[str] = []
    for path in sorted(pred.rglob("*.png")):
        stem = path.relative_to(pred).as_posix().removesuffix(".png")
        if named := [e for e in exclude if _names(e, stem)]:
            unused.difference_update(named)
            continue
        true = truth / f"{stem}.png"
        mask_path = next((m for m in (masks / f"{stem}{mask_suffix}", masks / f"{stem}.png") if m.exists()), None)
        if not true.exists() or mask_path is None:
            continue
        picture, answer, mask = read_image(path), read_image(true), read_mask(mask_path)
        if not picture.shape[:2] == answer.shape[:2] == mask.shape:
            sizes = ", ".join(f"{s[1]}×{s[0]}" for s in (picture.shape, answer.shape, mask.shape))
            raise BadInput(f"evaluate: {stem}: picture, truth and mask differ in size ({sizes})")
        if not mask.any():
            warnings.append(f"{stem}: the mask is empty, not scored")
            continue
        views[stem] = score(picture, answer, mask)
    if not views:
        raise BadInput(f"evaluate: no picture of {pred} has a truth in {truth} and a mask in {masks}")
    warnings += [f"exclude: {e} names no picture of {pred}" for e in sorted(unused)]
    for path in sorted(truth.rglob("*.png")):
        stem = path.relative_to(truth).as_posix().removesuffix(".png")
        missing = (masks / f"{stem}{mask_suffix}").exists() and not (pred / f"{stem}.png").exists()
        if missing and not any(_names(e, stem) for e in exclude):
            warnings.append(f"{stem}: no picture in {pred}, not scored")
    mean = {k: float(np.mean([v[k] for v in views.values()])) for k in ("psnr", "ssim", "flip")}
    return {"views": views, "mean": mean, "warnings": warnings}


def _names(excluded: str, stem: str) -> bool:
    """Whether a stem or a camera ID (`render` makes test/000 of ./test/000.jpg) is a picture's, but for folders."""
    path = PurePosixPath(excluded)
    name = str(path.with_suffix("") if path.suffix.lower() in PHOTO_SUFFIXES else path)
    return stem == name or name.endswith("/" + stem) or stem.endswith("/" + name)


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
    from .commands import render_views, run_removal, select_cameras

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
    inside = in_region(read_region(scene / "roi.json"), file.gaussians.means.astype(np.float64))
    write_ply(out, file, ~(inside & file.gaussians.usable))


def photo_with_object(scene: Path, camera_id: str) -> np.ndarray:
    """A test view's photo with the object [H, W, 3] uint8: for baselines, never input to a removal."""
    stem = Path(camera_id).stem
    return read_image(next((scene / "images").glob(f"with_test_{stem}.*"), scene / "images" / f"with_test_{stem}.png"))


def telea(photo: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """OpenCV's Telea on a photo [H, W, 3] uint8, the mask [H, W] bool dilated; [H, W, 3] uint8."""
    from .geometry import dilated

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
