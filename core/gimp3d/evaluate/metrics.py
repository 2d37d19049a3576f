"""PSNR, SSIM and FLIP against true pictures, averaged inside a mask."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path, PurePosixPath
from typing import Any

import cv2
import numpy as np

from ..errors import BadInput
from ..io.images import read_image, read_mask

PIXELS_PER_DEGREE = 67.0  # FLIP's default viewing condition
PSNR_OF_EQUAL = 100.0  # dB reported for identical pictures, as JSON knows no infinity
SSIM_SIGMA, SSIM_SIDE = 1.5, 11  # Wang et al. 2004
PHOTO_SUFFIXES = {".png", ".jpg", ".jpeg", ".tif", ".tiff", ".webp", ".exr"}  # what a camera's ID may end in


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
    left_out = {e: _stem_of_id(e) for e in exclude}
    unused = set(left_out)
    views: dict[str, dict[str, float]] = {}
    warnings: list[str] = []
    for path in sorted(pred.rglob("*.png")):
        stem = path.relative_to(pred).as_posix().removesuffix(".png")
        if named := [e for e, excluded in left_out.items() if _same_view(stem, excluded)]:
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
        if missing and not any(_same_view(stem, e) for e in left_out.values()):
            warnings.append(f"{stem}: no picture in {pred}, not scored")
    mean = {k: float(np.mean([v[k] for v in views.values()])) for k in ("psnr", "ssim", "flip")}
    return {"views": views, "mean": mean, "warnings": warnings}


def _stem_of_id(camera_id: str) -> str:
    """The stem that `render` gives a camera's picture: test/000 for ./test/000.jpg."""
    path = PurePosixPath(camera_id)
    return str(path.with_suffix("") if path.suffix.lower() in PHOTO_SUFFIXES else path)


def _same_view(stem: str, excluded: str) -> bool:
    """Whether two stems name one picture, either possibly with more leading folders."""
    return stem == excluded or excluded.endswith("/" + stem) or stem.endswith("/" + excluded)
