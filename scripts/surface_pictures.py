"""Sheets of pictures for bench_surface.py: target regions and completed surfaces, against the truth."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from pages import fitted, sheet, titled
from surface_scenes import Scene, completed, depth_errors, surface, targets

from gimp3d.camera import Camera, output_name
from gimp3d.errors import IllPosed
from gimp3d.io.images import read_image
from gimp3d.report import relief, tinted
from gimp3d.stages.masks import Masks, ViewMasks

COLUMNS = 6
SMALL = 0.5  # scale of a picture on the sheet of masks
WORST = 0.05  # relative depth error that is shown as brightest
# colours of the overlays; the page explains them
COVERED, MISSED, MORE = (46, 160, 67), (255, 0, 200), (250, 140, 20)


def mask_sheet(scene: Scene, masks: Masks) -> np.ndarray:
    """All training views, [H, W, 3] uint8: T and what no view sees as colours, what the object hides as an outline."""
    found = targets(masks, scene.train)
    return sheet([overlay(scene, c, found[c.id]) for c in scene.train], COLUMNS)


def overlay(scene: Scene, camera: Camera, target: np.ndarray) -> np.ndarray:
    unseen, photo = scene.unseen(camera), scene.photos[camera.id] // 2 + 60
    for mask, colour in ((target & unseen, COVERED), (unseen & ~target, MISSED), (target & ~unseen, MORE)):
        photo = tinted(photo, mask, colour, 0.65)
    contours, _ = cv2.findContours(scene.hides(camera).astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(photo, contours, -1, (255, 255, 255), 1)
    small = cv2.resize(photo, None, fx=SMALL, fy=SMALL, interpolation=cv2.INTER_AREA)
    return titled(small, output_name(camera.id))


def depth_sheet(scene: Scene, masks: Masks) -> np.ndarray:
    """A row per test view, [H, W, 3] uint8: true picture, completed surface, true surface, relative error."""
    views = {v.camera.id: v for v in masks.views}
    return sheet([t for c in scene.test if c.id in views for t in surface_tiles(scene, views[c.id], masks.views)], 4)


def surface_tiles(scene: Scene, view: ViewMasks, views: Sequence[ViewMasks]) -> list[np.ndarray]:
    camera = view.camera
    picture, unseen, truth = read_image(scene.folder / camera.id), scene.unseen(camera), scene.depth(camera)
    try:
        completion = completed(view, views)
        depth, words = surface(view, completion), completion.reason
    except IllPosed as error:
        depth, words = view.depth_after, str(error)
    # One relief of both, so that the colours are the same; each shows the nearest of what lies round the hole.
    rows, cols = (np.flatnonzero(view.target.any(axis)) for axis in (1, 0))
    window = tuple(slice(max(0, i[0] - 40), i[-1] + 41) for i in (rows, cols))
    pair = np.hstack([depth[window], truth[window]]), np.hstack([view.target[window], unseen[window]])
    both = relief(*pair)
    error = depth_errors(scene, camera, depth)[window]
    colours = cv2.applyColorMap((255 * np.clip(error / WORST, 0, 1)).astype(np.uint8), cv2.COLORMAP_INFERNO)[..., ::-1]
    shown = np.where((view.target | unseen)[window][..., None], colours, 90)
    half = both.shape[1] // 2
    tiles = [picture[window], both[:, :half], both[:, half:], shown.astype(np.uint8)]
    size = (picture.shape[1], picture.shape[0])
    names = [output_name(camera.id), words, "truth", f"relative error, 0 to {WORST:.0%}"]
    return [titled(fitted(tile, size), name) for tile, name in zip(tiles, names)]
