"""Scenes with truth as bench_real.py measures them: rings round the object, its hidden volume, and coverage of T."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from gimp3d.camera import Camera, output_name
from gimp3d.commands import select_cameras
from gimp3d.errors import BadInput
from gimp3d.evaluate.metrics import psnr
from gimp3d.io.cameras import read_cameras
from gimp3d.io.images import read_image, read_mask, undistorted

CLEARANCE = 3.0  # px between the object and what counts as round it: pixels nearer to it are mixed
NEAR = 24.0  # px from the object within which a removal must do no harm
TOLERANCE = 5  # px by which the object's masks are dilated for its hidden volume


@dataclass(frozen=True)
class Scene:
    """A scene's folder and its cameras; `test` is empty where the scene has no truth."""

    folder: Path
    train: tuple[Camera, ...]
    test: tuple[Camera, ...]  # the first is the reference of the protocol, the others are scored

    @property
    def name(self) -> str:
        return self.folder.name

    @property
    def has_truth(self) -> bool:
        return bool(self.test)

    @property
    def has_shadow(self) -> bool:
        return any(self._truth(c, "shadow").exists() for c in (*self.train, *self.test))

    def hides(self, camera: Camera) -> np.ndarray:
        """[H, W] bool: pixels where the object hides the background."""
        return read_mask(self._truth(camera, "mask"))

    def unseen(self, camera: Camera) -> np.ndarray:
        """[H, W] bool: the part of `hides` that no training view sees past the object."""
        return read_mask(self._truth(camera, "unseen"))

    def shadow(self, camera: Camera) -> np.ndarray:
        """[H, W] bool: pixels that only the object's shadow darkens; none where no shadow is known."""
        path = self._truth(camera, "shadow")
        return read_mask(path) if path.exists() else np.zeros((camera.height, camera.width), bool)

    def covered(self, camera: Camera, marked: bool) -> np.ndarray:
        """[H, W] bool: what the object hides, and its shadow where that is marked."""
        return self.hides(camera) | self.shadow(camera) if marked else self.hides(camera)

    def _truth(self, camera: Camera, kind: str) -> Path:
        return self.folder / "truth" / f"{output_name(camera.id)}.{kind}.png"


def read_scene(folder: Path) -> Scene:
    """A scene's folder, as the data's own README describes it.

    Raises
    ------
    BadInput
        If it holds no scene.
    """
    if not (folder / "scene.ply").is_file():
        raise BadInput(f"{folder} holds no scene.ply, transforms.json and roi.json")
    cameras = tuple(undistorted(c) for c in read_cameras(folder / "transforms.json"))
    test = select_cameras(cameras, "test") if (folder / "truth").is_dir() else ()
    return Scene(folder, select_cameras(cameras, "train"), test)


def ring(
    mask: np.ndarray,  # [H, W] bool, what the object hides
    left_out: np.ndarray,  # [H, W] bool
) -> np.ndarray:
    """[H, W] bool: the pixels nearest to the mask but not close to it, as many as it has, or all there are."""
    away = _distance(mask)
    allowed = np.flatnonzero((away > CLEARANCE) & ~left_out)
    nearest = allowed[np.argsort(away.ravel()[allowed], kind="stable")[: mask.sum()]]
    found = np.zeros(mask.shape, bool)
    found.flat[nearest] = True
    return found


def near(mask: np.ndarray, left_out: np.ndarray) -> np.ndarray:
    """[H, W] bool: pixels within NEAR of the mask but not close to it."""
    away = _distance(mask)
    return (away > CLEARANCE) & (away <= NEAR) & ~left_out


def _distance(mask: np.ndarray) -> np.ndarray:
    """Pixels to the nearest one of the mask, [H, W]; infinite where the mask is empty."""
    if not mask.any():
        return np.full(mask.shape, np.inf)
    return cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)


def round_the_object(scene: Scene, renders: Path) -> dict[str, float]:
    """PSNR of drawn test views outside the object, means over them: "ring", "near", and in the true "shadow".

    Ring and near never hold the shadow: the truth has none, so a scene that was drawn perfectly would fail there.
    """
    found: dict[str, list[float]] = {}
    for camera in scene.test[1:]:
        drawn, truth = read_image(renders / f"{output_name(camera.id)}.png"), read_image(scene.folder / camera.id)
        mask, shadow = scene.hides(camera), scene.shadow(camera)
        regions = {"ring": ring(mask, shadow), "near": near(mask, shadow), "shadow": shadow}
        for name, region in regions.items():
            if region.any():
                found.setdefault(name, []).append(psnr(drawn, truth, region))
    return {name: float(np.mean(values)) for name, values in found.items()}


def outside_hidden_volume(
    points: np.ndarray,  # [N, 3] world
    views: Sequence[tuple[Camera, np.ndarray]],  # with what the object hides there, [H, W] bool
    tolerance: int = TOLERANCE,
) -> np.ndarray:
    """[N] bool: points that some view frames beside the object, or that no view frames."""
    framed, beside = np.zeros(len(points), bool), np.zeros(len(points), bool)
    kernel = np.ones((2 * tolerance + 1,) * 2, np.uint8)
    for camera, mask in views:
        hidden = cv2.dilate(mask.astype(np.uint8), kernel) > 0
        uv, z = camera.project(points.astype(np.float64))
        within = (z > 0) & (uv >= 0).all(-1) & (uv < [camera.width, camera.height]).all(-1)
        cols, rows = uv[within].astype(int).T
        framed |= within
        beside[within] |= ~hidden[rows, cols]
    return beside | ~framed


def coverage(scene: Scene, targets: Path, marked: bool) -> dict[str, float]:
    """T in the training views, as `gimp3d masks` wrote it, against what no view sees.

    "covered": share of never-seen pixels that T holds; "area": T's over theirs, without a marked shadow, which is T as
    it was asked for; "invented": share of what the object hides that is in T although some view sees it.
    """
    sums: dict[str, int] = dict.fromkeys(("covered", "target", "invented", "unseen", "mask"), 0)
    for camera in scene.train:
        target = read_mask(targets / f"{output_name(camera.id)}.png")
        mask, unseen = scene.hides(camera), scene.unseen(camera)
        own = target & ~scene.shadow(camera) if marked else target
        counted: dict[str, Any] = {"covered": target & unseen, "target": own, "unseen": unseen, "mask": mask}
        for name, pixels in (counted | {"invented": target & mask & ~unseen}).items():
            sums[name] += int(pixels.sum())
    return {
        "covered": sums["covered"] / max(1, sums["unseen"]),
        "area": sums["target"] / max(1, sums["unseen"]),
        "invented": sums["invented"] / max(1, sums["mask"]),
    }
