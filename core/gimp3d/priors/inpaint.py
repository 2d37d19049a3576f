"""Providers of appearance: what the reference looks like without the object (METHOD section 2).

A provider is a function (image, hole, seed) → image. To add one: write it and name it in PROVIDERS, or, if it takes
an argument after a colon, in `inpaint_reference`.
"""

from __future__ import annotations

import shlex
import subprocess
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from ..errors import BadInput, IllPosed
from ..io.images import read_image, write_png
from ..solvers.patchmatch import (
    PatchMatchSettings,
    nearest_neighbour_field,
    source_centres,
    vote_range,
)
from ..threads import run_ranges

TINY = 4  # px; smaller holes are interpolated
MISMATCH = 24.0  # grey levels of median difference outside the hole from which a picture is of another view
COARSEST = 40  # px, the exemplar pyramid's smallest side
MAX_SHIFT = 0.02  # of the picture's width; a larger misalignment is not an edited copy of the view


@dataclass(frozen=True)
class Appearance:
    """The reference without the object."""

    image: np.ndarray  # [H, W, 3] uint8; outside the hole it is the input, bit for bit
    confidence: float
    reason: str


def inpaint_reference(
    spec: str,
    image: np.ndarray,  # [H, W, 3] uint8
    hole: np.ndarray,  # [H, W] bool
    seed: int = 0,
) -> Appearance:
    """Fill the hole by the provider that `spec` names (CONTRACT: Providers).

    Raises
    ------
    BadInput
        If the provider is unknown, or its file or command fails.
    IllPosed
        If the hole is the whole image.
    """
    if not hole.any():
        return Appearance(image.copy(), 1.0, "nothing to fill in the reference")
    name, _, argument = spec.partition(":")
    if name == "file" and argument:
        return paste_picture(image, hole, read_image(argument), argument)
    if hole.all():
        raise IllPosed("appearance: the hole covers the whole reference; give a picture of it or choose another view")
    if name == "command" and argument:
        return Appearance(*_composed(image, hole, _run_command(argument, image, hole)), f"filled by {argument.split()[0]}")
    if name == "onnx":
        raise BadInput("--inpaint onnx: not in this version; use exemplar, telea, ns, shiftmap, file: or command:")
    if spec not in PROVIDERS:
        raise BadInput(f"--inpaint: unknown provider {spec!r}; use {', '.join(PROVIDERS)}, file:PATH or command:CMD")
    if hole.sum() <= TINY:
        return Appearance(*_composed(image, hole, telea(image, hole, seed)), "hole of a few pixels: interpolated")
    return Appearance(*_composed(image, hole, PROVIDERS[spec](image, hole, seed)), f"filled by {spec}")


def paste_picture(
    image: np.ndarray,  # [H, W, 3] uint8, the view
    hole: np.ndarray,  # [H, W] bool
    picture: np.ndarray,  # [H', W', 3] uint8, the view without the object
    name: str = "the picture",
) -> Appearance:
    """A given picture, registered to the view (size, shift, gain) and pasted inside the hole only.

    Shift and gain are applied only if they clearly lower the difference outside the hole.

    Raises
    ------
    BadInput
        If it has another shape or shows something else.
    """
    h, w = hole.shape
    if abs(picture.shape[1] * h - picture.shape[0] * w) > 1.5 * max(picture.shape[:2] + (h, w)):
        raise BadInput(f"{name} has {picture.shape[1]}×{picture.shape[0]} pixels, which is not the shape of the view ({w}×{h})")
    if picture.shape[:2] != (h, w):
        way = cv2.INTER_AREA if picture.shape[0] > h else cv2.INTER_CUBIC
        picture = cv2.resize(picture, (w, h), interpolation=way)
    outside = cv2.dilate(hole.astype(np.uint8), np.ones((9, 9), np.uint8)) == 0
    if outside.sum() < 0.02 * hole.size:
        return Appearance(_paste(image, hole, picture), 0.5, "picture pasted; too little of the view is left to check it")
    plain = _difference(image, picture, outside)
    registered, words = _register(image, picture, outside)
    residual = _difference(image, registered, outside)
    if residual < 0.8 * plain - 0.25:
        picture, plain = registered, residual
    else:
        words = "as it is"
    if plain > MISMATCH:
        raise BadInput(f"{name} does not show the reference view (median difference {plain:.0f} grey levels outside the hole)")
    return Appearance(_paste(image, hole, picture), float(np.exp(-plain / 20)), f"picture pasted {words}, residual {plain:.1f} grey levels")


def _difference(image: np.ndarray, picture: np.ndarray, where: np.ndarray) -> float:
    """Median over pixels of the mean absolute difference: a few changed objects do not count."""
    return float(np.median(np.abs(image[where].astype(np.float32) - picture[where]).mean(-1)))


def _register(image: np.ndarray, picture: np.ndarray, outside: np.ndarray) -> tuple[np.ndarray, str]:
    """The picture shifted and brightened to the view, by what lies outside the hole."""
    h, w = outside.shape
    grey = [cv2.cvtColor(p, cv2.COLOR_RGB2GRAY).astype(np.float32) for p in (image, picture)]
    warp = np.eye(2, 3, dtype=np.float32)
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 50, 1e-4)
    try:
        _, warp = cv2.findTransformECC(
            grey[0], grey[1], warp, cv2.MOTION_TRANSLATION, criteria, outside.astype(np.uint8) * 255, 5
        )
    except cv2.error:
        warp = np.eye(2, 3, dtype=np.float32)  # no texture to align by
    shift = warp[:, 2]
    if np.abs(shift).max() > MAX_SHIFT * w:
        shift = np.zeros(2, np.float32)
    matrix = np.array([[1, 0, shift[0]], [0, 1, shift[1]]], np.float32)
    moved = cv2.warpAffine(
        picture, matrix, (w, h), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP, borderMode=cv2.BORDER_REPLICATE
    )
    inside = moved[outside].astype(np.float32)
    gain = np.median(image[outside].astype(np.float32), axis=0) / np.maximum(np.median(inside, axis=0), 1.0)
    gain = np.clip(gain, 0.5, 2.0)
    lit = np.clip(np.rint(moved * gain), 0, 255).astype(np.uint8)
    words = f"after a shift of ({shift[0]:.1f}, {shift[1]:.1f}) px and gain {gain.mean():.2f}"
    return lit, words


def _paste(image: np.ndarray, hole: np.ndarray, picture: np.ndarray) -> np.ndarray:
    return np.where(hole[..., None], picture, image)


def _composed(image: np.ndarray, hole: np.ndarray, filled: np.ndarray) -> tuple[np.ndarray, float]:
    return _paste(image, hole, filled), 0.5


def telea(image: np.ndarray, hole: np.ndarray, seed: int) -> np.ndarray:
    """Fast marching (Telea 2004), OpenCV."""
    return cv2.inpaint(image, hole.astype(np.uint8), 3, cv2.INPAINT_TELEA)


def navier_stokes(image: np.ndarray, hole: np.ndarray, seed: int) -> np.ndarray:
    """Isophotes continued (Bertalmio 2001), OpenCV."""
    return cv2.inpaint(image, hole.astype(np.uint8), 3, cv2.INPAINT_NS)


def shiftmap(image: np.ndarray, hole: np.ndarray, seed: int) -> np.ndarray:
    """Shift maps (Pritch 2009), OpenCV's xphoto."""
    if not hasattr(cv2, "xphoto"):
        raise BadInput("--inpaint shiftmap needs OpenCV's contrib modules (opencv-contrib-python-headless)")
    lab = cv2.cvtColor(image, cv2.COLOR_RGB2Lab)
    filled = np.zeros_like(lab)
    cv2.xphoto.inpaint(lab, (~hole).astype(np.uint8) * 255, filled, cv2.xphoto.INPAINT_SHIFTMAP)
    return cv2.cvtColor(filled, cv2.COLOR_Lab2RGB)


def exemplar(image: np.ndarray, hole: np.ndarray, seed: int) -> np.ndarray:
    """Multi-scale exemplar completion: nearest-neighbour field and voting in turns (Wexler 2007, Barnes 2009)."""
    settings = PatchMatchSettings(seed=seed, levels=1, coherence=0.0)
    radius = settings.patch // 2
    pyramid = [(image.astype(np.float32), hole)]
    while min(pyramid[-1][1].shape) > COARSEST and _thickness(pyramid[-1][1]) > radius:
        pyramid.append(_halved_outside(*pyramid[-1]))
    filled: np.ndarray | None = None
    for level in range(len(pyramid) - 1, -1, -1):
        picture, open_ = pyramid[level]
        if filled is None:
            current = telea(_bytes(picture), open_, seed).astype(np.float32)
        else:
            up = cv2.resize(filled, (open_.shape[1], open_.shape[0]), interpolation=cv2.INTER_LINEAR)
            current = np.where(open_[..., None], up, picture)
        filled = _expectation_maximisation(picture, open_, current, radius, len(pyramid) - level, settings)
    assert filled is not None
    return _bytes(filled)


def _expectation_maximisation(
    picture: np.ndarray, hole: np.ndarray, current: np.ndarray, radius: int, rounds: int, settings: PatchMatchSettings
) -> np.ndarray:
    """Match the patches that touch the hole, let them vote for its pixels, and again; fewer rounds on fine levels."""
    size = 2 * radius + 1
    touching = cv2.dilate(hole.astype(np.uint8), np.ones((size, size), np.uint8)) > 0
    if not source_centres(touching, ~hole, radius).any():
        return current
    depth_in_hole = cv2.distanceTransform(hole.astype(np.uint8), cv2.DIST_L2, 5)
    trust = (1.3 ** -np.minimum(depth_in_hole, 40)).astype(np.float32)  # the rim knows more than the middle
    for _ in range(max(2, 12 - 3 * rounds + 3)):
        field = nearest_neighbour_field(_bytes(current), touching, ~hole, None, settings)
        sharpness = 1.0 / max(float(np.percentile(field.cost[touching], 75)), (1.0 / 255) ** 2)
        voted = current.copy()
        run_ranges(
            vote_range,
            hole.shape[0],
            current,
            hole,
            field.rows,
            field.cols,
            field.cost,
            trust,
            np.float32(sharpness),
            radius,
            voted,
        )
        change = np.abs(voted[hole] - current[hole]).mean()
        current = voted
        if change < 0.3:
            break
    return current


def _thickness(hole: np.ndarray) -> float:
    return float(cv2.distanceTransform(hole.astype(np.uint8), cv2.DIST_L2, 5).max())


def _halved_outside(picture: np.ndarray, hole: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Half the resolution; hole pixels do not mix into their neighbours."""
    size = ((hole.shape[1] + 1) // 2, (hole.shape[0] + 1) // 2)
    weight = (~hole).astype(np.float32)
    total = cv2.resize(picture * weight[..., None], size, interpolation=cv2.INTER_AREA)
    share = cv2.resize(weight, size, interpolation=cv2.INTER_AREA)
    return total / np.maximum(share, 1e-6)[..., None], share < 0.5


def _bytes(picture: np.ndarray) -> np.ndarray:
    return np.clip(np.rint(picture), 0, 255).astype(np.uint8)


def _run_command(command: str, image: np.ndarray, hole: np.ndarray) -> np.ndarray:
    """What a program makes of {image} and {mask} in {out}; no shell is involved."""
    with tempfile.TemporaryDirectory(prefix="gimp3d-") as folder:
        paths = {k: str(Path(folder) / f"{k}.png") for k in ("image", "mask", "out")}
        write_png(paths["image"], image)
        write_png(paths["mask"], hole)
        try:
            words = [w.format(**paths) for w in shlex.split(command)]
        except (ValueError, KeyError, IndexError) as error:
            raise BadInput(f"--inpaint command: cannot read {command!r} ({error}); use {{image}} {{mask}} {{out}}") from None
        try:
            done = subprocess.run(words, capture_output=True, text=True, check=False)
        except OSError as error:
            raise BadInput(f"--inpaint command: cannot start {words[0]} ({error.strerror})") from None
        if done.returncode != 0:
            said = done.stderr.strip().splitlines()[-1:] or ["no message"]
            raise BadInput(f"--inpaint command: {words[0]} ended with {done.returncode}: {said[0][:200]}")
        if not Path(paths["out"]).exists():
            raise BadInput(f"--inpaint command: {words[0]} wrote no {{out}} picture")
        filled = read_image(paths["out"])
    if filled.shape != image.shape:
        raise BadInput(f"--inpaint command: the picture has shape {filled.shape[1]}×{filled.shape[0]}, not the view's")
    return filled


PROVIDERS: dict[str, Callable[[np.ndarray, np.ndarray, int], np.ndarray]] = {
    "exemplar": exemplar,
    "telea": telea,
    "ns": navier_stokes,
    "shiftmap": shiftmap,
}
