"""Scenes rendered with and without the object, and how far what the stages say of them is from the truth."""

from __future__ import annotations

import inspect
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from gimp3d.box import Region, read_region
from gimp3d.camera import Camera, output_name
from gimp3d.commands import select_cameras
from gimp3d.errors import BadInput, IllPosed
from gimp3d.gaussians import Gaussians
from gimp3d.geometry import SOLID, disparity_of
from gimp3d.io.cameras import read_cameras
from gimp3d.io.images import load_view, read_mask
from gimp3d.io.ply import read_ply
from gimp3d.stages import depth as depth_stage
from gimp3d.stages.depth import DepthCompletion, DepthSettings, complete_disparity
from gimp3d.stages.masks import Masks, MaskSettings, ViewMasks, find_masks
from gimp3d.stages.reference import choose_reference, rim

SHADOW = "_shadow"  # what a scene's name ends in whose photos show the object's shadows and reflections
SEES_PHOTOS = "photos" in inspect.signature(find_masks).parameters
COMPLETE_DEPTH = getattr(depth_stage, "complete_depth", None)  # with what other views know of the hole, where it can


@dataclass(frozen=True)
class Scene:
    """A splat with the object, its views, and what is behind the object."""

    folder: Path
    gaussians: Gaussians
    region: Region
    train: tuple[Camera, ...]  # with photos that show the object
    test: tuple[Camera, ...]  # cameras only: what they see without the object is the truth
    photos: dict[str, np.ndarray]  # of the training views

    @property
    def name(self) -> str:
        return self.folder.name

    def hides(self, camera: Camera) -> np.ndarray:
        """[H, W] bool: pixels where the object hides the background."""
        return self._truth(camera, "mask")

    def unseen(self, camera: Camera) -> np.ndarray:
        """[H, W] bool: the part of `hides` that no training view sees past the object."""
        return self._truth(camera, "unseen")

    def depth(self, camera: Camera) -> np.ndarray:
        """[H, W] z-depth without the object, of a test view."""
        path = self.folder / "truth" / f"{output_name(camera.id)}.depth.npy"
        return np.load(path, allow_pickle=False).astype(np.float64)

    def _truth(self, camera: Camera, kind: str) -> np.ndarray:
        return _mask(self.folder / "truth" / f"{output_name(camera.id)}.{kind}.png")


_mask = cache(read_mask)


def read_scene(folder: Path) -> Scene:
    """A scene's folder, as the data's own README describes it.

    Raises
    ------
    BadInput
        If something is missing.
    """
    if not (folder / "truth").is_dir():
        raise BadInput(f"{folder} has no truth/; give the folder of scenes with and without the object")
    cameras = read_cameras(folder / "transforms.json")
    train = select_cameras(cameras, "train")
    photos = {c.id: load_view(c)[0] for c in train}
    return Scene(
        folder,
        read_ply(folder / "scene.ply").gaussians,
        read_region(folder / "roi.json"),
        train,
        select_cameras(cameras, "test"),
        photos,
    )


def scene_masks(
    scene: Scene,
    cameras: Sequence[Camera],
    settings: MaskSettings = MaskSettings(),
    region: Region | None = None,
) -> Masks:
    """The stage as a removal calls it."""
    photos = {"photos": scene.photos} if SEES_PHOTOS else {}
    return find_masks(scene.gaussians, region or scene.region, cameras, settings, **photos)


def targets(masks: Masks, cameras: Sequence[Camera]) -> dict[str, np.ndarray]:
    """T [H, W] of every camera; a view that was left out has none."""
    found = {v.camera.id: v.target for v in masks.views}
    return {c.id: found.get(c.id, np.zeros((c.height, c.width), bool)) for c in cameras}


def shares(pairs: Sequence[tuple[np.ndarray, np.ndarray]], least: int = 50) -> tuple[float, float]:
    """Share of the second masks' pixels that the first ones hold: over all pairs, and in the worst pair.

    Pairs whose second mask has fewer than `least` pixels say little and cannot be the worst.
    """
    counts = np.array([[(a & b).sum(), b.sum()] for a, b in pairs], float)
    large = counts[counts[:, 1] >= least]
    return counts[:, 0].sum() / max(1, counts[:, 1].sum()), float((large[:, 0] / large[:, 1]).min(initial=1.0))


def overlap(a: dict[str, np.ndarray], b: dict[str, np.ndarray]) -> tuple[float, float]:
    """Intersection over union of two sets of masks: over all views, and in the worst view."""
    return shares([(a[name] & b[name], a[name] | b[name]) for name in a])


def without_rim(mask: np.ndarray) -> np.ndarray:
    """The mask [H, W] without its outermost pixels, which show both sides; the frame is no rim."""
    return cv2.erode(mask.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0


def mask_scores(scene: Scene, masks: Masks) -> dict[str, float]:
    """T of the training views against what no view sees, and the silhouettes against what the object hides."""
    found = targets(masks, scene.train)
    unseen = {c.id: scene.unseen(c) for c in scene.train}
    covered, worst = shares([(found[name], without_rim(unseen[name])) for name in found])
    hidden = {v.camera.id: scene.hides(v.camera) for v in masks.views if v.camera.id in found}
    silhouettes = {v.camera.id: v.silhouette for v in masks.views if v.camera.id in found}
    return {
        "covered": covered,
        "worst_view_covered": worst,
        "area": sum(t.sum() for t in found.values()) / max(1, sum(u.sum() for u in unseen.values())),
        "silhouette_iou": overlap(silhouettes, hidden)[0],
        "hole_pixels": int(sum(t.sum() for t in found.values())),
    }


def completed(
    view: ViewMasks, views: Sequence[ViewMasks], settings: DepthSettings = DepthSettings()
) -> DepthCompletion:
    """The surface behind the object in a view, as a removal with these training views completes it."""
    disparity, known = disparity_of(view.depth_after), rim(view, SOLID)
    if COMPLETE_DEPTH is None:
        return complete_disparity(disparity, known, view.target, None, settings)
    used = [v for v in views if v is view or v.camera.split == "train"]
    return COMPLETE_DEPTH(view, used, disparity, known, settings=settings)


def surface(view: ViewMasks, completion: DepthCompletion) -> np.ndarray:
    """[H, W] z of the view without the object: completed in T, the scene's own elsewhere."""
    return np.where(view.target, completion.depth, view.depth_after).astype(np.float32)


def depth_scores(scene: Scene, view: ViewMasks, depth: np.ndarray) -> dict[str, float]:
    """Relative errors of z where no view sees the surface, also where T missed it; nothing there is an error of 1."""
    error = depth_errors(scene, view.camera, depth)[without_rim(scene.unseen(view.camera))]
    return {"median": float(np.median(error)), "p95": float(np.percentile(error, 95))}


def depth_errors(scene: Scene, camera: Camera, depth: np.ndarray) -> np.ndarray:
    """[H, W] |z − truth| / truth, infinitely far is an error of 1."""
    truth = scene.depth(camera)
    return np.minimum(np.abs(depth - truth) / truth, 1.0)


def surface_scores(scene: Scene, masks: Masks, settings: DepthSettings = DepthSettings()) -> list[dict[str, Any]]:
    """Every test view as the reference: its T against the truth, and its completed surface. Refusals say why."""
    views = {v.camera.id: v for v in masks.views}
    rows = []
    for camera in scene.test:
        row: dict[str, Any] = {"view": camera.id}
        rows.append(row)
        if camera.id not in views:
            row["refused"] = "the view does not frame the region"
            continue
        view, unseen = views[camera.id], scene.unseen(camera)
        row["covered"] = shares([(view.target, without_rim(unseen))])[0]
        row["area"] = float(view.target.sum() / max(1, unseen.sum()))
        try:
            completion = completed(view, masks.views, settings)
        except IllPosed as error:
            row["refused"] = str(error)
            continue
        row |= depth_scores(scene, view, surface(view, completion))
        row |= {"confidence": completion.confidence, "reason": completion.reason}
    return rows


def reference_scores(masks: Masks) -> dict[str, Any]:
    """The chosen reference with its runners-up, and what share of the needed surface each further one adds."""
    try:
        choice = choose_reference(masks.views)
    except IllPosed as error:
        return {"refused": str(error)}
    covered = [share for _, share in choice.plan]
    return {
        "chosen": asdict(choice.scores[0]),
        "reason": choice.reason,
        "runners_up": [{"view": s.camera_id, "score": s.score} for s in choice.scores[1:4]],
        "plan": [{"view": name, "adds": share - before} for (name, share), before in zip(choice.plan, [0.0, *covered])],
    }
