"""What the new Gaussians are worth: presets, ablations and baselines by quality, time and count, on scenes with truth.

    python scripts/bench_refine.py ../shared/data/withwithout [--quick] [--scenes desk,gloss] [--out build/bench_refine]

Presets run whole. Ablations share stages: each is run once and counted for all. Kernels are compiled before anything
is timed. Seconds hold all that a removal does; CPU seconds, of all threads, mean the same on a busy machine.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from refine_report import write_report

from gimp3d.box import Region, read_region
from gimp3d.camera import Camera
from gimp3d.evaluate.benchmark import DILATION
from gimp3d.evaluate.metrics import score
from gimp3d.gaussians import Gaussians
from gimp3d.io.cameras import read_cameras
from gimp3d.io.images import load_view, read_image, read_mask
from gimp3d.io.ply import read_ply
from gimp3d.pipeline import PRESETS, RemovalResult, RemovalSettings, View, remove_object, render_bytes
from gimp3d.stages.refine import RefineSettings

SCENES = ("desk", "corner", "gloss", "rocks")
DRAFT, BALANCED = PRESETS["draft"], PRESETS["balanced"]
EVERY_PIXEL = replace(DRAFT.seed, largest=1, needed=0.0, sink=0.0, corrections=0)


def seeded(**changed: Any) -> RemovalSettings:
    return replace(BALANCED, seed=replace(BALANCED.seed, **changed), refine=RefineSettings())


def refined(steps: int, **changed: Any) -> RemovalSettings:
    return replace(BALANCED, refine=replace(BALANCED.refine, steps=steps, **changed))


COLOURS_ALONE = {f"rate_{name}": 0.0 for name in ("means", "scales", "quats", "opacity", "view_dependence")}
PAPER = {name: PRESETS[name] for name in ("paper-literal", "paper")}
OURS = {name: PRESETS[name] for name in ("draft", "balanced", "best")}
ABLATIONS = {
    "not refined": seeded(),
    "… one per pixel, as seeded": replace(seeded(), seed=EVERY_PIXEL),
    "… colours as seeded": seeded(corrections=0),
    "… on the surface": seeded(sink=0.0),
    "… all patches kept": seeded(needed=0.0),
    "colours alone refined": refined(100, **COLOURS_ALONE),
}
COUNTS = {
    f"detail {detail:g}, patch {largest}": seeded(detail=detail, largest=largest)
    for detail, largest in ((0, 1), (5, 4), (20, 4), (100, 4), (500, 8), (5000, 8))
}
DEGREES = {f"degree {degree}": seeded(sh_degree=degree) for degree in range(4)}
STEPS = {f"{steps} steps": refined(steps) for steps in (25, 200)}
GROUPS = {"paper": PAPER, "presets": OURS, "ablations": ABLATIONS, "counts": COUNTS, "degrees": DEGREES, "steps": STEPS}
WHOLE = ("paper", "presets")  # groups whose methods share nothing
# Settings of these make a stage's result; what comes before them is the same for all of ours.
OWN_STAGES = ("seed", "refine")


def now() -> np.ndarray:
    """Wall and CPU seconds, [2]."""
    return np.array([time.perf_counter(), time.process_time()])


@dataclass
class SharedStages:
    """Keeps stages' results and seconds; those that a method makes for itself are made anew."""

    kept: dict[str, tuple[Any, np.ndarray]] = field(default_factory=dict)
    seconds: dict[str, np.ndarray] = field(default_factory=dict)  # stage → wall and CPU seconds, [2]
    borrowed: np.ndarray = field(default_factory=lambda: np.zeros(2))  # of stages that another method has run
    started: np.ndarray = field(default_factory=now)

    def load(self, name: str) -> Any | None:
        self.started = now()
        if name in self.kept and not name.startswith(OWN_STAGES):
            result, self.seconds[name] = self.kept[name]
            self.borrowed = self.borrowed + self.seconds[name]
            return result
        return None

    def save(self, name: str, result: Any) -> None:
        self.seconds[name] = now() - self.started
        self.kept[name] = (result, self.seconds[name])


@dataclass(frozen=True)
class Scene:
    """A scene with ground truth in its test views."""

    name: str
    gaussians: Gaussians
    region: Region
    views: list[View]
    reference: Camera
    picture: np.ndarray  # the reference without the object
    tests: list[tuple[Camera, np.ndarray, np.ndarray, np.ndarray]]  # with the photo and masks
    with_object: list[np.ndarray]


def load_scene(folder: Path) -> Scene:
    gaussians = read_ply(folder / "scene.ply").gaussians
    cameras = read_cameras(folder / "transforms.json")
    views = [View(camera, image) for image, camera in (load_view(c) for c in cameras if c.split == "train")]
    reference, *others = (c for c in cameras if c.split == "test")
    views.append(View(reference, render_bytes(gaussians, reference)))
    tests, with_object = [], []
    for camera in others:
        stem = Path(camera.id).stem
        masks = (read_mask(folder / "truth" / "test" / f"{stem}.{kind}.png") for kind in ("mask", "unseen"))
        tests.append((camera, read_image(folder / camera.id), *masks))
        with_object.append(read_image(folder / "images" / f"with_test_{stem}.png"))
    region = read_region(folder / "roi.json")
    picture = read_image(folder / reference.id)
    return Scene(folder.name, gaussians, region, views, reference, picture, tests, with_object)


def scores(pictures: list[np.ndarray], scene: Scene) -> dict[str, float]:
    """PSNR, SSIM and FLIP in what the object hid and in what no training view sees of it, means over test views."""
    row: dict[str, float] = {}
    for k, kind in enumerate(("mask", "unseen")):
        rows = [score(p, t[1], t[2 + k]) for p, t in zip(pictures, scene.tests) if t[2 + k].any()]
        row |= {f"{metric} {kind}": float(np.mean([r[metric] for r in rows])) for metric in rows[0]}
    return row


def agreement(scene: Scene, filled: Gaussians, result: RemovalResult) -> float:
    """PSNR of the drawn scene against the painted training views, where they differ from the photos: consistency."""
    errors = []
    for view in scene.views[:-1:3]:
        painted = result.painted.get(view.camera.id)
        if painted is None or not (there := (painted != view.image).any(-1)).any():
            continue
        wrong = render_bytes(filled, view.camera)[there].astype(float) - painted[there]
        errors.append(10 * np.log10(255**2 / max(1e-9, (wrong**2).mean())))
    return float(np.mean(errors))


def measure(scene: Scene, name: str, settings: RemovalSettings, shared: SharedStages) -> dict[str, Any]:
    shared.seconds, shared.borrowed = {}, np.zeros(2)
    before = now()
    result = remove_object(
        scene.gaussians, scene.views, scene.region, settings, scene.reference.id, scene.picture, store=shared
    )
    wall, cpu = now() - before + shared.borrowed
    kept = scene.gaussians.take(result.keep)
    filled = kept.extended(result.added) if result.added else kept
    reached = max(1, sum(int(v.sum()) for v in _targets(shared)))
    row: dict[str, Any] = {"scene": scene.name, "method": name, "added": len(filled) - len(kept)}
    row |= {"stages": {s: spent[0] for s, spent in shared.seconds.items()}, "seconds": wall, "cpu seconds": cpu}
    row |= {"share": row["added"] / reached, "agreement": agreement(scene, filled, result)}
    row |= {"reasons": {s.name: s.reason for s in result.stages if s.name.startswith(OWN_STAGES)}}
    return row | scores([render_bytes(filled, t[0]) for t in scene.tests], scene)


def _targets(shared: SharedStages) -> list[np.ndarray]:
    """T of the first reference, [H, W] bool: the pixels that `share` counts Gaussians by."""
    masks, choice = shared.kept["masks"][0], shared.kept["reference"][0]
    return [v.target for v in masks.views if v.camera.id == choice.camera_id]


def baselines(scene: Scene, removed: np.ndarray) -> list[dict[str, Any]]:
    """The open hole, and Telea's fill of the true mask on the photo."""
    kept = scene.gaussians.take(~removed)
    rows = []
    start = now()
    grown = [cv2.dilate(t[2].astype(np.uint8), np.ones((2 * DILATION + 1,) * 2, np.uint8)) for t in scene.tests]
    telea = [cv2.inpaint(photo, g, 3, cv2.INPAINT_TELEA) for photo, g in zip(scene.with_object, grown)]
    spent = now() - start
    opened = [render_bytes(kept, t[0]) for t in scene.tests]
    for name, pictures, (wall, cpu) in (("hole open", opened, np.zeros(2)), ("telea", telea, spent)):
        row = {"scene": scene.name, "method": name, "added": 0, "share": 0.0, "stages": {}}
        row |= {"seconds": wall, "cpu seconds": cpu, "group": "baselines"}
        rows.append(row | scores(pictures, scene))
    return rows


def run(
    data: Path, scenes: tuple[str, ...], groups: Mapping[str, Mapping[str, RemovalSettings]], out: Path
) -> list[dict[str, Any]]:
    """Every method on every scene; what is measured so far lies in refine.json."""
    rows: list[dict[str, Any]] = []
    compile_kernels(load_scene(data / scenes[0]), groups)
    for name in scenes:
        scene, shared = load_scene(data / name), SharedStages()
        for group, methods in groups.items():
            for method, settings in methods.items():
                store = SharedStages() if group in WHOLE else shared
                row = measure(scene, method, settings, store) | {"group": group}
                rows.append(row)
                if method == "balanced":
                    shared = store
                numbers = "".join(f"{row[k]:8.2f}" for k in ("psnr mask", "psnr unseen", "seconds", "cpu seconds"))
                print(f"{name:8}{method:28}{numbers}{row['added']:7}", flush=True)
        if "masks" in shared.kept:
            rows += baselines(scene, shared.kept["masks"][0].removed)
        (out / "refine.json").write_text(json.dumps(rows, indent=1))
    return rows


def compile_kernels(scene: Scene, groups: Mapping[str, Mapping[str, RemovalSettings]]) -> None:
    """Each method once, with a single step of refinement: nothing that is timed compiles or loads anything."""
    ready = SharedStages()
    for group, methods in groups.items():
        for settings in methods.values():
            short = replace(settings, refine=replace(settings.refine, steps=min(1, settings.refine.steps)))
            measure(scene, "", short, SharedStages() if group in WHOLE else ready)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("--scenes", default=",".join(SCENES))
    parser.add_argument("--groups", default=",".join(GROUPS), help="of methods")
    parser.add_argument("--quick", action="store_true", help="one scene, presets without the paper's")
    parser.add_argument("--out", type=Path, default=Path("build/bench_refine"))
    parser.add_argument(
        "--assets", type=Path, help="where charts go; default: assets of a full run, else beside the tables"
    )
    parser.add_argument("--paper-steps", type=int, default=PRESETS["paper"].refine.steps, help="fewer: a shorter run")
    parser.add_argument("--add", type=Path, help="a refine.json of other groups, to be reported along")
    given = parser.parse_args()
    scenes, groups = tuple(given.scenes.split(",")), {g: GROUPS[g] for g in given.groups.split(",")}
    if "paper" in groups:
        shorter = replace(PRESETS["paper"].refine, steps=given.paper_steps)
        groups["paper"] = {name: replace(settings, refine=shorter) for name, settings in PAPER.items()}
    if given.quick:
        scenes, groups = scenes[:1], {"presets": {n: OURS[n] for n in ("draft", "balanced")}}
    given.out.mkdir(parents=True, exist_ok=True)
    rows = run(given.data, scenes, groups, given.out)
    if given.add:
        rows = [*json.loads(given.add.read_text()), *rows]
    full = scenes == SCENES and {r["group"] for r in rows} > set(GROUPS)
    write_report(rows, given.out, given.assets or (Path("assets") if full else given.out))


if __name__ == "__main__":
    main()
