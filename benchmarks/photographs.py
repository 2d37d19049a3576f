"""Photographs with holes for the benchmarks, and what other programs make of them: scikit-image's pictures and its
biharmonic fill, and PyPatchMatch, in an interpreter of their own (build/others), as they are no dependencies."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from gimp3d.io.images import read_image, write_png

from .command import ROOT

NAMES = ("astronaut", "brick", "chelsea", "coffee", "grass", "gravel", "motorcycle", "rocket")
LARGE = ("astronaut", "chelsea", "coffee", "hubble_deep_field", "motorcycle", "retina")  # 1080p, most enlarged
REPETITIONS, SLOW_S = 3, 2.0  # what takes longer than SLOW_S is not repeated
SHARE = 0.08  # of the picture
OTHERS_PYTHON = ROOT / "build" / "others" / "bin" / "python"

FETCH = """
import sys, imageio, numpy, skimage.data
for name in sys.argv[2:]:
    picture = skimage.data.stereo_motorcycle()[0] if name == "motorcycle" else getattr(skimage.data, name)()
    picture = numpy.repeat(picture[..., None], 3, 2) if picture.ndim == 2 else picture[..., :3]
    imageio.imwrite(f"{sys.argv[1]}/{name}.png", picture)
"""

FILL = """
import sys, time, imageio, numpy
method, folder, repetitions, slow = sys.argv[1:]
picture, hole = imageio.imread(f"{folder}/picture.png"), imageio.imread(f"{folder}/hole.png") > 0
if method == "biharmonic":
    from skimage.restoration import inpaint_biharmonic
    run = lambda: inpaint_biharmonic(picture, hole, channel_axis=-1)
else:
    from patchmatch import patch_match
    run = lambda: patch_match.inpaint(picture, hole, patch_size=int(method))
times = []
while not times or (len(times) < int(repetitions) and times[0] < float(slow)):
    start = time.process_time()
    filled = run()
    times.append(time.process_time() - start)
if filled.dtype != numpy.uint8:
    filled = numpy.clip(numpy.rint(255 * filled), 0, 255).astype(numpy.uint8)
imageio.imwrite(f"{folder}/filled.png", filled)
print(min(times))
"""


def photographs(others: Path, folder: Path, large: bool) -> dict[str, np.ndarray]:
    """Name → [512, 512, 3] or [1080, 1920, 3] uint8: the middle of each picture, scaled to cover that."""
    wanted = LARGE if large else NAMES
    missing = [name for name in wanted if not (folder / f"{name}.png").exists()]
    if missing:
        folder.mkdir(parents=True, exist_ok=True)
        done = run_in(others, FETCH, str(folder), *missing)
        if done.returncode:
            sys.exit(f"no photographs: {others} needs scikit-image and imageio ({last_line(done.stderr)})")
    size = (1920, 1080) if large else (512, 512)
    return {name: covering(read_image(folder / f"{name}.png"), *size) for name in wanted}


def covering(picture: np.ndarray, width: int, height: int) -> np.ndarray:
    scale = max(width / picture.shape[1], height / picture.shape[0])
    size = (max(width, round(picture.shape[1] * scale)), max(height, round(picture.shape[0] * scale)))
    grown = cv2.resize(picture, size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_LANCZOS4)
    top, left = (size[1] - height) // 2, (size[0] - width) // 2
    return np.ascontiguousarray(grown[top : top + height, left : left + width])


def blob(height: int, width: int, seed: int, share: float = SHARE) -> np.ndarray:
    """[H, W] bool: an irregular hole near the middle."""
    random = np.random.default_rng(seed)
    y, x = np.mgrid[:height, :width].astype(np.float32)
    cy, cx = height * random.uniform(0.42, 0.58), width * random.uniform(0.42, 0.58)
    angle, away = np.arctan2(y - cy, x - cx), np.hypot(y - cy, x - cx)
    waves = zip((2, 3, 7), (0.25, 0.15, 0.08), random.uniform(0, 6, 3))
    outline = 1 + sum(height_ * np.sin(count * angle + phase) for count, height_, phase in waves)
    return away / outline <= np.quantile(away / outline, share)


def filled_by(others: Path, method: str, picture: np.ndarray, hole: np.ndarray, folder: Path) -> tuple[Any, Any]:
    """(filled picture, CPU seconds) of `biharmonic`, or of PyPatchMatch with this radius; (None, why) if it fails."""
    write_png(folder / "picture.png", picture)
    write_png(folder / "hole.png", hole)
    done = run_in(others, FILL, method, str(folder), str(REPETITIONS), str(SLOW_S))
    if done.returncode:
        return None, last_line(done.stderr)
    return np.where(hole[..., None], read_image(folder / "filled.png"), picture), float(done.stdout)


def run_in(others: Path, program: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    try:
        return subprocess.run([str(others), "-c", program, *arguments], capture_output=True, text=True, check=False)
    except OSError as error:
        return subprocess.CompletedProcess([], 1, "", f"{others}: {error.strerror}")


def last_line(words: str) -> str:
    return (words.strip().splitlines() or ["no message"])[-1]
