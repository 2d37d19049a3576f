"""The object's shadow: is it found, is the light right, and what is left of it once the object is gone.

Four parts. Removals of scenes with a shadow, as `gimp3d` in a process of its own: shadow undone, left alone, and put
into the hole where the truth has it. Made scenes whose light is known, and such whose floor is glossy
(tests/lit_scenes.py). And scenes without a shadow, the demo's among them, of which none must be found: each with
several random draws of four views in five. With --without, a rule of benchmarks.ablation is switched off in the last
three. Writes OUT/light.md and a sheet of pictures per scene. Run by `make bench-light`.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from lit_scenes import LitScene, glossy_scene, reflected, shadowed_scenes, unshadowed_scenes

from gimp3d.behind import LIGHT
from gimp3d.camera import output_name
from gimp3d.commands import render_views
from gimp3d.evaluate import psnr, score
from gimp3d.io.images import read_image, write_png
from gimp3d.pipeline import PRESETS, View, remove_object, render_bytes
from gimp3d.srgb import linear

from .ablation import RULES, switched_off
from .command import ASSETS, parser_of, say, told_in_one_line, write
from .scenes import MADE, SHADOW, Scene, filled, gimp3d, marked_words, read_scene, removal, remove_words
from .tables import Section, markdown, sheet
from .timing import Watch, about, machine

SHADOWED = ("tiles_mug", "kitchen_monkey", "desk_shadow", "corner_shadow")
CLEAR = (*MADE, "real_table")
DEMO = ASSETS / "demo"
DIFFERS = 0.04  # share of white by which photos with and without the shadow differ in it
GLOSSY = (0.1, 0.2, 0.4)  # share of light that comes back from a floor
DRAWS, KEPT = 10, 0.8  # of each scene; of the views in a draw
DARK = 4e-3  # of linear light, below which darkness is noise
WAYS = {"undone": ["--shadow", "auto"], "marked": [], "left": ["--shadow", "off"], "filled": ["--shadow", "off"]}


def main() -> None:
    parser = parser_of(__doc__, "light", data=True)
    parser.add_argument("--skip-removals", action="store_true")
    parser.add_argument("--without", choices=RULES, metavar="RULE", help="as named in benchmarks.ablation")
    given = parser.parse_args()
    sections = []

    def section(title: str, head: Sequence[str], rows: Iterator[list[str]]) -> None:
        sections.append(Section(title, "", head, []))
        for row in rows:
            sections[-1].rows.append(row)
            say(" | ".join(row))

    if not given.skip_removals:
        head = ("scene", "shadow", "mask dB", "FLIP", "in the shadow dB", "FLIP", "darkening left")
        head += ("light", "seconds", "for the light")
        scenes = (read_scene(given.data / name, needs_truth=True) for name in SHADOWED)
        section("Removals", head, (row for s in scenes for row in removals(s, given.out / s.name)))
    with switched_off(RULES[given.without] if given.without else ()):
        made, folder = (*shadowed_scenes(), *unshadowed_scenes()), given.out / "made"
        head = ("made scene", "covers", "found", "off by", "darkening left", "seconds")
        section("Known light", head, (known_light(m, folder) for m in made))
        head = ("glossy floor", "found", "in the reflection dB: left, undone", "seconds")
        section("Known reflections", head, (known_reflection(strength, folder) for strength in GLOSSY))
        clear = [DEMO, *(given.data / name for name in CLEAR)]
        rows = ([f.name, f"{sum(draw(f, k) for k in range(DRAWS))} of {DRAWS}"] for f in clear)
        section("Without a shadow", ("scene", "found in draws"), rows)
    words = f"{about(machine())} Without: {given.without or 'nothing'}."
    write(given.out / "light.md", markdown("The object's light", words, sections))


def removals(scene: Scene, folder: Path) -> Iterator[list[str]]:
    """Rows of the table; their pictures lie in the folder."""
    shadows = shadows_of(scene)
    for way, words in WAYS.items():
        out, summary = folder / way / "out.ply", folder / way / "summary.json"
        if way in ("marked", "filled"):
            words = [*words, *marked_words({c.id: shadows[c.id] for c in scene.train}, folder, way == "marked")]
        if message := gimp3d([*remove_words(scene, out), *words, "--summary", str(summary)]):
            yield [scene.name, way, f"refused: {message}", *[""] * 7]
            continue
        render_views(out, scene.folder / "transforms.json", folder / way / "render", split="test")
        scores, before, after, rows = [], [], [], []
        for camera in scene.test[1:]:
            truth, photo = scene.truth(camera), scene.with_object(camera)
            drawn = read_image(folder / way / "render" / f"{output_name(camera.id)}.png")
            shadow = shadows[camera.id]
            found = [score(drawn, truth, where) for where in (scene.hides(camera) & ~shadow, shadow)]
            scores.append([s[metric] for s in found for metric in ("psnr", "flip")])
            before.append(light(photo)[shadow] - light(truth)[shadow])
            after.append(light(drawn)[shadow] - light(truth)[shadow])
            rows.append({output_name(camera.id): photo, "truth": truth, way: drawn})
        write_png(folder / f"{way}.png", sheet(rows))
        facts, left = json.loads(summary.read_text()), np.concatenate(after).mean() / np.concatenate(before).mean()
        lamps = ", ".join(f"{x['elevation']:.0f}°/{x['azimuth']:.0f}°" for x in facts["shadow"]["lights"]) or "–"
        numbers = [f"{x:.{2 + k % 2}f}" for k, x in enumerate(np.mean(scores, axis=0))]
        seconds = facts["seconds_total"]
        share = sum(s["seconds"] for s in facts["stages"] if s["name"] in LIGHT) / seconds
        yield [scene.name, way, *numbers, f"{left:.0%}", lamps, f"{seconds:.1f}", f"{share:.0%}"]


def shadows_of(scene: Scene) -> dict[str, np.ndarray]:
    """ID → [H, W] bool: the truth's; of scenes lit twice, where photos with and without the shadow differ."""
    cameras = (*scene.train, *scene.test)
    if scene.has_shadow:
        return {c.id: scene.shadow(c) for c in cameras}

    def photos(of: Scene) -> dict[str, np.ndarray]:
        return {**of.photos, **{c.id: of.with_object(c) for c in of.test}}

    dark, clean = photos(scene), photos(read_scene(scene.folder.parent / scene.name.removesuffix(SHADOW)))
    differ = {c.id: np.abs(dark[c.id].astype(float) - clean[c.id]).mean(-1) > DIFFERS * 255 for c in cameras}
    return {c.id: differ[c.id] & ~scene.hides(c) for c in cameras}


def light(picture: np.ndarray) -> np.ndarray:
    """[H, W] log luminance."""
    return np.log(linear(picture).mean(-1) + DARK)


def known_light(made: LitScene, folder: Path) -> list[str]:
    views, watch = [View(c, render_bytes(made.gaussians, c)) for c in made.cameras()], Watch()
    result = remove_object(made.gaussians, views, made.region, PRESETS["draft"])
    (wall, _), final = watch.lap(), filled(made.gaussians, result)
    towards = [np.array(x["direction"]) for x in result.shadow["lights"]]
    lamps = [lamp.direction for lamp in made.lamps if np.isfinite(lamp.softness)]
    off = [min([angle(lamp, t) for t in towards], default=180.0) for lamp in lamps]
    before, after, rows, covers = [], [], [], 0.0
    for view in views[::3]:
        truth, drawn = render_bytes(made.truth, view.camera), render_bytes(final, view.camera)
        block = (view.image[..., 0].astype(int) - view.image[..., 1] > 70).astype(np.uint8)
        dark = light(view.image) - light(truth)
        shadow = (dark < -0.1) & (cv2.dilate(block, np.ones((9, 9), np.uint8)) == 0)
        covers = max(covers, shadow.mean())
        before.append(dark[shadow])
        after.append((light(drawn) - light(truth))[shadow])
        rows.append({made.name: view.image, "truth": truth, "result": drawn})
    write_png(folder / f"{made.name.replace(' ', '_')}.png", sheet(rows))
    gone = np.concatenate(before)
    left = f"{np.concatenate(after).sum() / gone.sum():.0%}" if len(gone) and made.lamps else "–"
    degrees = ", ".join(f"{x:.1f}°" for x in off) or "–"
    return [made.name, f"{covers:.1%}", "yes" if result.shadow["found"] else "no", degrees, left, f"{wall / 1e3:.1f}"]


def known_reflection(strength: float, folder: Path) -> list[str]:
    made = glossy_scene(strength)
    views = [View(c, render_bytes(made.gaussians, c)) for c in made.cameras()]
    scores, pictures = [], [{"truth": render_bytes(made.truth, v.camera)} for v in views[::3]]
    for way in ("off", "auto"):
        watch = Watch()
        result = remove_object(made.gaussians, views, made.region, replace(PRESETS["balanced"], shadow=way))
        (wall, _), final = watch.lap(), filled(made.gaussians, result)
        for view, row in zip(views[::3], pictures):
            row[way] = render_bytes(final, view.camera)
        where = [reflected(made, v.camera) for v in views[::3]]
        scores.append(np.mean([psnr(row[way], row["truth"], there) for row, there in zip(pictures, where)]))
    write_png(folder / f"glossy_{strength:.2f}.png", sheet(pictures))
    found = "yes" if result.reflection["found"] else "no"
    return [f"{strength:.0%} comes back", found, f"{scores[0]:.1f}, {scores[1]:.1f}", f"{wall / 1e3:.1f}"]


def angle(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.degrees(np.arccos(np.clip(a @ b / np.linalg.norm(b), -1, 1))))


def draw(folder: Path, seed: int) -> bool:
    """Whether a shadow is found with some of the scene's views; where it has no photos they are drawn."""
    scene, rng = read_scene(folder), np.random.default_rng(seed)
    chosen = sorted(rng.choice(len(scene.train), round(KEPT * len(scene.train)), replace=False))
    views = [scene.drawn(scene.train[k]) if folder == DEMO else scene.views[k] for k in chosen]
    result = removal(scene, replace(PRESETS["draft"], inpaint="telea"), views=views)
    return bool(result.shadow["found"])


if __name__ == "__main__":
    told_in_one_line(main)
