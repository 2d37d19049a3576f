"""The object's shadow: is it found, is the light right, and what is left of it once the object is gone.

    python scripts/bench_light.py [DATA] [--draws 10] [--skip-removals] [--out build/bench_light]

Four parts. Removals of scenes with a shadow, as `gimp3d` in a process of its own: shadow undone, left alone, and put
into the hole where the truth marks it. Made scenes whose light is known, and such whose floor is glossy
(light_scenes.py). And scenes without a shadow, of which none must be found: each with several random draws of four
views in five. Writes OUT/table.md and a sheet of pictures per scene. Run by `make bench-light`.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from bench_raster import ROOT, machine, say, write
from bench_real import gimp3d, remove_words, shadow_words
from light_scenes import LitScene, glossy_scene, reflected, shadowed_scenes, unshadowed_scenes
from pages import sheet, titled
from real_scenes import Scene, read_scene

from gimp3d.box import Region, read_region
from gimp3d.camera import Camera, output_name
from gimp3d.commands import render_views
from gimp3d.evaluate.benchmark import photo_with_object
from gimp3d.evaluate.metrics import psnr
from gimp3d.gaussians import Gaussians
from gimp3d.io.formats import read_scene as read_splat
from gimp3d.io.images import load_view, read_image, write_png
from gimp3d.pipeline import PRESETS, View, remove_object, render_bytes
from gimp3d.srgb import linear

SHADOWED = ("tiles_mug", "kitchen_monkey", "desk_shadow", "corner_shadow")
CLEAR = ("desk", "corner", "gloss", "rocks", "real_table")
DIFFERS = 0.04  # share of white by which photos with and without the shadow differ in it
GLOSSY = (0.1, 0.2, 0.4)  # share of light that comes back from a floor
KEPT = 0.8  # of the views in a draw
DARK = 4e-3  # of linear light, below which darkness is noise
WAYS = {"undone": ["--shadow", "auto"], "left": ["--shadow", "off"], "filled": ["--shadow", "off"]}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", nargs="?", type=Path, default=ROOT.parent / "shared" / "data" / "withwithout")
    parser.add_argument("--draws", type=int, default=10)
    parser.add_argument("--skip-removals", action="store_true")
    parser.add_argument("--out", type=Path, default=ROOT / "build" / "bench_light")
    given = parser.parse_args()
    lines = [f"{machine()}", ""]
    if not given.skip_removals:
        lines += [
            "| scene | shadow | mask dB | in the shadow dB | darkening left | light | seconds |",
            "|---|---|---|---|---|---|---|",
        ]
        for name in SHADOWED:
            scene = read_scene(given.data / name)
            for way, words in WAYS.items():
                if way != "filled" or scene.has_shadow:
                    lines.append(row := removal(scene, way, words, given.out / name))
                    say(row)
    lines += ["", "| made scene | found | off by | darkening left | seconds |", "|---|---|---|---|---|"]
    for made in (*shadowed_scenes(), *unshadowed_scenes()):
        lines.append(row := known_light(made, given.out / "made"))
        say(row)
    lines += ["", "| glossy floor | found | in the reflection dB: left, undone | seconds |", "|---|---|---|---|"]
    for strength in GLOSSY:
        lines.append(row := known_reflection(strength, given.out / "made"))
        say(row)
    lines += ["", "| scene without a shadow | found in draws |", "|---|---|"]
    for name in CLEAR:
        found = sum(draw(given.data / name, k) for k in range(given.draws))
        lines.append(row := f"| {name} | {found} of {given.draws} |")
        say(row)
    write(given.out / "table.md", "\n".join(lines) + "\n")
    return 0


def removal(scene: Scene, way: str, words: Sequence[str], folder: Path) -> str:
    """A row of the table; its pictures lie in the folder."""
    out, summary = folder / way / "out.ply", folder / way / "summary.json"
    marked = shadow_words(scene, folder) if way == "filled" else []
    if message := gimp3d([*remove_words(scene, out), *words, *marked, "--summary", str(summary)]):
        return f"| {scene.name} | {way} | refused: {message} | | | | |"
    render_views(out, scene.folder / "transforms.json", folder / way / "render", split="test")
    facts = json.loads(summary.read_text())
    scores: list[tuple[float, float]] = []
    before, after, rows = [], [], []
    for camera in scene.test[1:]:
        truth, photo = read_image(scene.folder / camera.id), photo_with_object(scene.folder, camera.id)
        drawn = read_image(folder / way / "render" / f"{output_name(camera.id)}.png")
        hidden, shadow = scene.hides(camera), shadow_of(scene, camera)
        scores.append((psnr(drawn, truth, hidden & ~shadow), psnr(drawn, truth, shadow)))
        before.append(light(photo)[shadow] - light(truth)[shadow])
        after.append(light(drawn)[shadow] - light(truth)[shadow])
        rows += [titled(p, w) for p, w in ((photo, output_name(camera.id)), (truth, "truth"), (drawn, way))]
    write_png(folder / f"{way}.png", sheet(rows, 3))
    left = np.concatenate(after).mean() / np.concatenate(before).mean()
    masked, shaded = np.mean(scores, axis=0)
    lamps = ", ".join(f"{x['elevation']:.0f}°/{x['azimuth']:.0f}°" for x in facts["shadow"]["lights"]) or "–"
    return (
        f"| {scene.name} | {way} | {masked:.2f} | {shaded:.2f} | {left:.0%} | {lamps} | {facts['seconds_total']:.1f} |"
    )


def shadow_of(scene: Scene, camera: Camera) -> np.ndarray:
    """[H, W] bool: the truth's; of scenes lit twice, where photos with and without the shadow differ."""
    if scene.has_shadow:
        return scene.shadow(camera)
    clean = scene.folder.parent / scene.name.removesuffix("_shadow")
    a, b = (photo_with_object(f, camera.id).astype(float) / 255 for f in (scene.folder, clean))
    return (np.abs(a - b).mean(-1) > DIFFERS) & ~scene.hides(camera)


def light(picture: np.ndarray) -> np.ndarray:
    """[H, W] log luminance."""
    return np.log(linear(picture).mean(-1) + DARK)


def known_light(made: LitScene, folder: Path) -> str:
    views = [View(c, render_bytes(made.gaussians, c)) for c in made.cameras()]
    start = time.perf_counter()
    result = remove_object(made.gaussians, views, made.region, PRESETS["draft"])
    seconds = time.perf_counter() - start
    final = made.gaussians.take(result.keep)
    final = final if result.added is None else final.extended(result.added)
    towards = [np.array(x["direction"]) for x in result.shadow["lights"]]
    off = [min([angle(lamp.direction, t) for t in towards], default=180.0) for lamp in made.lamps]
    before, after, rows = [], [], []
    for view in views[::3]:
        truth, drawn = render_bytes(made.truth, view.camera), render_bytes(final, view.camera)
        block = (view.image[..., 0].astype(int) - view.image[..., 1] > 70).astype(np.uint8)
        dark = light(view.image) - light(truth)
        shadow = (dark < -0.1) & (cv2.dilate(block, np.ones((9, 9), np.uint8)) == 0)
        before.append(dark[shadow])
        after.append((light(drawn) - light(truth))[shadow])
        rows += [titled(p, w) for p, w in ((view.image, made.name), (truth, "truth"), (drawn, "result"))]
    write_png(folder / f"{made.name.replace(' ', '_')}.png", sheet(rows, 3))
    gone = np.concatenate(before)
    left = f"{np.concatenate(after).sum() / gone.sum():.0%}" if len(gone) and made.lamps else "–"
    degrees = ", ".join(f"{x:.1f}°" for x in off) or "–"
    return f"| {made.name} | {'yes' if result.shadow['found'] else 'no'} | {degrees} | {left} | {seconds:.1f} |"


def known_reflection(strength: float, folder: Path) -> str:
    made = glossy_scene(strength)
    views = [View(c, render_bytes(made.gaussians, c)) for c in made.cameras()]
    scores, rows = [], []
    for way in ("off", "auto"):
        start = time.perf_counter()
        result = remove_object(made.gaussians, views, made.region, replace(PRESETS["balanced"], shadow=way))
        seconds = time.perf_counter() - start
        final = made.gaussians.take(result.keep)
        final = final if result.added is None else final.extended(result.added)
        drawn = {v.camera.id: render_bytes(final, v.camera) for v in views[::3]}
        truth = {v.camera.id: render_bytes(made.truth, v.camera) for v in views[::3]}
        where = {v.camera.id: reflected(made, v.camera) for v in views[::3]}
        scores.append(np.mean([psnr(drawn[i], truth[i], where[i]) for i in drawn]))
        rows += [titled(p, way) for i in drawn for p in (truth[i], drawn[i])]
    write_png(folder / f"glossy_{strength:.2f}.png", sheet(rows, 4))
    found = "yes" if result.reflection["found"] else "no"
    return f"| {strength:.0%} comes back | {found} | {scores[0]:.1f}, {scores[1]:.1f} | {seconds:.1f} |"


def angle(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.degrees(np.arccos(np.clip(a @ b / np.linalg.norm(b), -1, 1))))


def draw(folder: Path, seed: int) -> bool:
    """Whether a shadow is found with some of the scene's views."""
    scene = read_scene(folder)
    rng = np.random.default_rng(seed)
    chosen = sorted(rng.choice(len(scene.train), round(KEPT * len(scene.train)), replace=False))
    loaded = [load_view(replace(scene.train[k], image=folder / scene.train[k].id))[:2] for k in chosen]
    views = [View(camera, image) for image, camera in loaded]
    splat: Gaussians = read_splat(folder / "scene.ply").gaussians
    region: Region = read_region(folder / "roi.json")
    facts: dict[str, Any] = remove_object(splat, views, region, replace(PRESETS["draft"], inpaint="telea")).shadow
    return bool(facts["found"])


if __name__ == "__main__":
    sys.exit(main())
