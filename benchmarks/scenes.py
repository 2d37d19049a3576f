"""Scenes with and without the object, read in one way; removals of them, and scores against the truth."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import cache, cached_property
from multiprocessing import get_context
from pathlib import Path

import numpy as np

from gimp3d.box import Box, Region, read_region
from gimp3d.camera import Camera, output_name
from gimp3d.commands import select_cameras
from gimp3d.compute.threads import available_cores, set_thread_count
from gimp3d.errors import BadInput
from gimp3d.evaluate import photo_with_object, psnr, score
from gimp3d.gaussians import Gaussians
from gimp3d.io.cameras import read_cameras
from gimp3d.io.formats import read_scene as read_splats
from gimp3d.io.images import load_view, read_image, read_mask, write_png
from gimp3d.pipeline import RemovalResult, RemovalSettings, View, remove_object, render_bytes
from gimp3d.run import Observer

MADE = ("desk", "corner", "gloss", "rocks")  # rendered, without shadows
REAL = ("real_table", "real_bed", "kitchen_monkey", "tiles_mug")
SHADOW = "_shadow"  # what a made scene's name ends in whose photos show the object's shadows and reflections
MASKS = ("mask", "unseen")  # what the object hides, and what of it no training view sees
GIVEN, BUILT_IN = "given", "built-in"  # the first test view's true picture is the reference, or none is given
MOVED, GROWN = 0.015, 0.03  # of a box's edges, by which another user's may lie beside it, and be larger
AT_ONCE = 2  # removals; each has long parts that use a single core


@dataclass(frozen=True)
class Scene:
    """A scene's folder as the data's own README describes it; `test` is empty where the scene has no truth."""

    folder: Path
    cameras: tuple[Camera, ...]  # as in the file
    train: tuple[Camera, ...]  # pinhole, as those of `views`
    test: tuple[Camera, ...]  # the first is the reference of the protocol, the others are scored

    @property
    def name(self) -> str:
        return self.folder.name

    @property
    def has_truth(self) -> bool:
        return bool(self.test)

    @property
    def has_shadow(self) -> bool:
        """Whether the truth marks the object's shadow."""
        return any(self._truth(c, "shadow.png").exists() for c in (*self.train, *self.test))

    @cached_property
    def gaussians(self) -> Gaussians:
        return read_splats(self.folder / "scene.ply").gaussians

    @cached_property
    def region(self) -> Region:
        return read_region(self.folder / "roi.json")

    @cached_property
    def views(self) -> list[View]:
        """The training views with their photos, which show the object."""
        loaded = [load_view(c) for c in self.cameras if c.split == "train"]
        return [View(camera, photo) for photo, camera in loaded]

    @property
    def photos(self) -> dict[str, np.ndarray]:
        return {v.camera.id: v.image for v in self.views}

    def hides(self, camera: Camera) -> np.ndarray:
        """[H, W] bool: pixels where the object hides the background."""
        return _mask(self._truth(camera, "mask.png"))

    def unseen(self, camera: Camera) -> np.ndarray:
        """[H, W] bool: the part of `hides` that no training view sees past the object."""
        return _mask(self._truth(camera, "unseen.png"))

    def judged(self, camera: Camera) -> dict[str, np.ndarray]:
        """Where a view is scored: those of MASKS that are not empty."""
        return {name: m for name, m in zip(MASKS, (self.hides(camera), self.unseen(camera))) if m.any()}

    def shadow(self, camera: Camera) -> np.ndarray:
        """[H, W] bool: pixels that only the object's shadow darkens; none where no shadow is known."""
        path = self._truth(camera, "shadow.png")
        return _mask(path) if path.exists() else np.zeros((camera.height, camera.width), bool)

    def depth(self, camera: Camera) -> np.ndarray:
        """[H, W] z-depth without the object, of a test view."""
        return np.load(self._truth(camera, "depth.npy"), allow_pickle=False).astype(np.float64)

    def truth(self, camera: Camera) -> np.ndarray:
        """A test view's picture without the object."""
        return read_image(self.folder / camera.id)

    def with_object(self, camera: Camera) -> np.ndarray:
        """A test view's photo with the object: for baselines, never input to a removal."""
        return photo_with_object(self.folder, camera.id)

    def drawn(self, camera: Camera) -> View:
        """A view that has no photo: it shows the scene as drawn, as in `gimp3d remove`."""
        return View(camera, render_bytes(self.gaussians, camera), is_photo=False)

    def _truth(self, camera: Camera, ending: str) -> Path:
        return self.folder / "truth" / f"{output_name(camera.id)}.{ending}"


_mask = cache(read_mask)


def read_scene(folder: Path, needs_truth: bool = False) -> Scene:
    """A scene's folder; BadInput if it holds no scene, or no truth where that is needed."""
    if needs_truth and not (folder / "truth").is_dir():
        raise BadInput(f"{folder} has no truth/; give the folder of scenes with and without the object")
    if not (folder / "scene.ply").is_file():
        raise BadInput(f"{folder} holds no scene.ply, transforms.json and roi.json")
    cameras = tuple(read_cameras(folder / "transforms.json"))
    pinhole = tuple(replace(c, distortion=None) for c in cameras)
    test = select_cameras(pinhole, "test") if (folder / "truth").is_dir() else ()
    return Scene(folder, cameras, select_cameras(pinhole, "train"), test)


cached_scene = cache(read_scene)


def read_scenes(data: Path, names: str, needs_truth: bool = False) -> list[Scene]:
    """Scenes by their names, separated by commas: folders of `data`, or of real/ beside it."""
    asked = [(data / name, data.parent / "real" / name) for name in filter(None, names.split(","))]
    return [read_scene(beside if beside.is_dir() and not own.is_dir() else own, needs_truth) for own, beside in asked]


# ------------------------------------------------------------------------------------------------------------- removals


def removal(
    scene: Scene,
    settings: RemovalSettings,
    reference: Camera | None = None,
    picture: np.ndarray | None = None,
    views: Sequence[View] | None = None,
    observer: Observer | None = None,
    region: Region | None = None,  # where another than the scene's is drawn round the object
) -> RemovalResult:
    """A removal of the scene's object with the training or other views; a reference that is none of them is drawn."""
    given = list(scene.views if views is None else views)
    if reference is not None and reference.id not in {v.camera.id for v in given}:
        given.append(scene.drawn(reference))
    name = None if reference is None else reference.id
    return remove_object(scene.gaussians, given, region or scene.region, settings, name, picture, observer=observer)


def redrawn(region: Region, number: int) -> Region:
    """The boxes as the user `number` may draw them: up to MOVED beside them and GROWN larger; those of 0 are given."""
    if not number:
        return region
    rng = np.random.default_rng(number)

    def of(box: Box) -> Box:
        move, growth = rng.uniform(-MOVED, MOVED, 3), rng.uniform(0, GROWN, 3)
        return Box(box.center + box.axes @ (move * box.size), box.size * (1 + growth), box.rotation_wxyz)

    return tuple(of(box) for box in region)


def filled(gaussians: Gaussians, result: RemovalResult) -> Gaussians:
    """The scene after a removal."""
    return gaussians.take(result.keep).extended(result.added)


def new_gaussians(result: RemovalResult) -> Gaussians | None:
    """What a removal adds and was not there before."""
    return result.added and result.added.take(np.arange(result.changed, len(result.added)))


def scores(scene: Scene, pictures: Mapping[str, np.ndarray]) -> dict[str, float]:
    """Means over test views (by ID) of PSNR, SSIM and FLIP: "psnr mask", "flip unseen" and so on."""
    rows: dict[str, list[float]] = {}
    for camera in scene.test:
        if camera.id in pictures:
            truth = scene.truth(camera)
            for name, mask in scene.judged(camera).items():
                for metric, value in score(pictures[camera.id], truth, mask).items():
                    rows.setdefault(f"{metric} {name}", []).append(value)
    return {key: float(np.mean(found)) for key, found in rows.items()}


def mean_psnrs(scene: Scene, splats: Gaussians, cameras: Iterable[Camera]) -> dict[str, float]:
    """Means over test views of PSNR in what the object hides, and in what no training view sees of it."""
    found: dict[str, list[float]] = {name: [] for name in MASKS}
    for camera in cameras:
        drawn, truth = render_bytes(splats, camera), scene.truth(camera)
        for name, mask in scene.judged(camera).items():
            found[name].append(psnr(drawn, truth, mask))
    return {name: float(np.mean(of)) for name, of in found.items()}


def side_by_side() -> ProcessPoolExecutor:
    """Processes that run removals side by side and share the cores."""
    threads = max(1, available_cores() // AT_ONCE)
    return ProcessPoolExecutor(AT_ONCE, get_context("spawn"), set_thread_count, (threads,))


# ---------------------------------------------------------------------------------------------------------- the program


def gimp3d(words: Sequence[str]) -> str:
    """Run the program in a process of its own; what it said if it failed, else nothing."""
    done = subprocess.run([sys.executable, "-m", "gimp3d", *words], stderr=subprocess.PIPE, text=True, check=False)
    said = done.stderr.strip().splitlines() or [f"gimp3d {words[0]} ended with {done.returncode}"]
    return said[-1].removeprefix("gimp3d: error: ") if done.returncode else ""


def scene_words(scene: Scene) -> list[str]:
    cameras, roi = scene.folder / "transforms.json", scene.folder / "roi.json"
    return [str(scene.folder / "scene.ply"), "--cameras", str(cameras), "--roi", str(roi), "--quiet"]


def remove_words(scene: Scene, out: Path) -> list[str]:
    return ["remove", *scene_words(scene), "--out", str(out)]


def marked_words(masks: Mapping[str, np.ndarray], folder: Path, lifted: bool) -> list[str]:
    """How a command is told of the shadow's masks, ID → [H, W] bool: it is lifted there, or filled as well."""
    marks = folder / "shadows"
    for name, mask in masks.items():
        write_png(marks / f"{output_name(name)}.png", mask)
    return ["--shadow", "mask", "--shadow-masks", str(marks)] if lifted else ["--extra-masks", str(marks)]


def shadow_words(scene: Scene, folder: Path, lifted: bool = True) -> list[str]:
    """How a command is told of the true shadow: the only place that knows."""
    return marked_words({c.id: scene.shadow(c) for c in scene.train}, folder, lifted)
