"""What each rule about the object's light is worth: one at a time is taken out, on scenes with and without a shadow.

    python scripts/light_ablation.py [DATA] [--out build/light_ablation] [--only WORDS …]

Measured where it acts: which shadows are found, and how lifted photos differ from photos without the object. Masks and
planes are found once per scene. Writes OUT/table.md. Run by `make bench-light-rules`.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from unittest import mock

import cv2
import numpy as np
from bench_light import CLEAR, DIFFERS, SHADOWED, light
from bench_raster import ROOT, machine, say, write
from light_scenes import LitScene, shadowed_scenes, unshadowed_scenes
from real_scenes import read_scene

from gimp3d.box import Region, read_region
from gimp3d.camera import output_name
from gimp3d.gaussians import Gaussians
from gimp3d.io.formats import read_scene as read_splat
from gimp3d.io.images import load_view, read_image
from gimp3d.pipeline import PRESETS, View, render_bytes
from gimp3d.progress import silent
from gimp3d.solvers import lights
from gimp3d.stages import ground, lifting, light_search, shadow
from gimp3d.stages.charts import Plane, find_planes
from gimp3d.stages.clearing import object_pixels
from gimp3d.stages.exposure import exposure_ring, level_exposure
from gimp3d.stages.ground import look_at
from gimp3d.stages.lifting import lift_shadow
from gimp3d.stages.masks import Masks, find_masks
from gimp3d.stages.shadow import find_shadow
from gimp3d.stages.witness import Witness

MADE = ("sun 32 soft", "two lights", "wall", "neighbour", "rug, no shadow", "stain, no shadow", "wall, no shadow")


def by_depth_alone(witness: Witness, grounds: Sequence[Any], hits: Any) -> np.ndarray:
    return (hits.depth > 0) & (np.abs(witness.depth - hits.depth) < lifting.SAME * hits.depth)


def by_place_alone(surface: lights.Surface, bent: bool) -> np.ndarray:
    return BESIDES(surface, bent)[:, : 5 if bent else 2]


BESIDES = lights._besides
RULES: dict[str, Sequence[tuple[Any, str, Any]]] = {
    "as it is": (),
    "a light need not beat chance": ((light_search, "EARNS", 1e-9),),
    "… nor explain what is uneven": ((light_search, "EARNS", 1e-9), (light_search, "FITS", 1e-9)),
    "need not explain what is uneven": ((light_search, "FITS", 1e-9),),
    "may be missing round the object": ((shadow, "FAINT", -1.0),),
    "one light at most": ((light_search, "MOST", 1),),
    "hue is no paint": ((lights, "_besides", by_place_alone),),
    "strength by blocks of all sizes": ((shadow, "BROAD", (4, 8, 16, 32)),),
    "sky only as far as photos ask": ((shadow, "DULL", 0.0),),
    "depth alone tells what is ground": ((lifting, "_shows", by_depth_alone),),
    "pixels beside the object are lifted": ((lifting, "MIXED", lifting.DARKEST),),
    "the darkest are lifted": ((lifting, "DARKEST", 0.05),),
    "no walls beside it": ((ground, "_walls", lambda *_: []),),
}


@dataclass(frozen=True)
class Prepared:
    """A scene as the search for a shadow gets it."""

    name: str
    splat: Gaussians
    region: Region
    masks: Masks
    witnesses: list[Witness]
    planes: tuple[Plane, ...]
    truth: dict[str, np.ndarray]  # ID → photo without the object; empty where no shadow is to be found
    shadow: dict[str, np.ndarray]  # ID → [H, W] bool

    @classmethod
    def make(
        cls,
        name: str,
        splat: Gaussians,
        views: Sequence[View],
        region: Region,
        truth: dict[str, np.ndarray],
        told: dict[str, np.ndarray] | None = None,
    ) -> Prepared:
        settings = PRESETS["balanced"]
        photos = {v.camera.id: v.image for v in views}
        masks = find_masks(splat, region, [v.camera for v in views], settings.masks, silent, photos, None)
        objects = object_pixels(splat, masks.removed, masks.views, settings.clearing)
        kept, witnesses = splat.take(~masks.removed), []
        for view, (hidden, beside) in zip(masks.views, objects):
            ring, photo = exposure_ring(view), photos[view.camera.id]
            photo = level_exposure(ring, photo, render_bytes(kept, view.camera, pixels=ring)).image
            witnesses.append(Witness(view.camera, photo, hidden, beside, view.depth_before))
        assert settings.charts is not None
        planes = find_planes(masks.views, witnesses, region, settings.charts)
        shadows = {}
        for w in witnesses:
            i = w.camera.id
            if i in truth:
                dark = told[i] if told is not None else np.abs(photos[i] / 255 - truth[i] / 255).mean(-1) > DIFFERS
                shadows[i] = dark & ~(w.hidden | w.beside)
        return cls(name, splat, region, masks, witnesses, planes, truth, shadows)


def real(folder: Path) -> Prepared:
    scene = read_scene(folder)
    loaded = [load_view(replace(c, image=folder / c.id))[:2] for c in scene.train]
    truth, told = {}, None
    if folder.name in SHADOWED:
        clean = folder.parent / folder.name.removesuffix("_shadow")
        files = {c.id: folder / "truth" / f"{output_name(c.id)}.true.jpg" for c in scene.train}
        truth = {i: read_image(p if p.exists() else clean / i) for i, p in files.items()}
        told = {c.id: scene.shadow(c) for c in scene.train} if scene.has_shadow else None
    views = [View(camera, image) for image, camera in loaded]
    splat = read_splat(folder / "scene.ply").gaussians
    return Prepared.make(folder.name, splat, views, read_region(folder / "roi.json"), truth, told)


def made(scene: LitScene) -> Prepared:
    views = [View(c, render_bytes(scene.gaussians, c)) for c in scene.cameras()]
    truth = {v.camera.id: render_bytes(scene.truth, v.camera) for v in views} if scene.lamps else {}
    return Prepared.make(scene.name, scene.gaussians, views, scene.region, truth)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", nargs="?", type=Path, default=ROOT.parent / "shared" / "data" / "withwithout")
    parser.add_argument("--out", type=Path, default=ROOT / "build" / "light_ablation")
    parser.add_argument("--only", nargs="*", default=[], help="words of rules")
    given = parser.parse_args()
    scenes = [real(given.data / name) for name in (*SHADOWED, *CLEAR)]
    scenes += [made(s) for s in (*shadowed_scenes(), *unshadowed_scenes()) if s.name in MADE]
    lit, clear = ([s for s in scenes if bool(s.truth) == want] for want in (True, False))
    lines = [
        machine(),
        "",
        f"With a shadow: {', '.join(s.name for s in lit)}. Without: {', '.join(s.name for s in clear)}.",
    ]
    lines += [
        "",
        "| rule taken out | found | found falsely | darkening left | off | filled |",
        "|---|---|---|---|---|---|",
    ]
    for name, patches in RULES.items():
        if not given.only or any(word in name for word in given.only):
            lines.append(row := without(name, patches, lit, clear))
            say(row)
    write(given.out / "table.md", "\n".join(lines) + "\n")
    return 0


def without(
    name: str, patches: Sequence[tuple[Any, str, Any]], lit: Sequence[Prepared], clear: Sequence[Prepared]
) -> str:
    """A row of the table."""
    with ExitStack() as stack:
        for module, attribute, value in patches:
            stack.enter_context(mock.patch.object(module, attribute, value))
        scores = [undone(scene) for scene in lit]
        falsely = [scene.name for scene in clear if not isinstance(found_in(scene), str)]
    found = sum(s is not None for s in scores)
    left, off, filled = np.mean([s if s is not None else (1.0, 1.0, 0.0) for s in scores], axis=0)
    false = f"{len(falsely)} of {len(clear)}" + (f" ({', '.join(falsely)})" if falsely else "")
    return f"| {name} | {found} of {len(lit)} | {false} | {left:.0%} | {off:.0%} | {filled:.0%} |"


def found_in(scene: Prepared) -> shadow.Shadow | str:
    if not scene.planes:
        return "no surface"
    grounds = look_at(scene.planes, scene.masks.views, scene.witnesses, scene.region)
    return find_shadow(scene.splat.take(scene.masks.removed), scene.planes, grounds, scene.region)


def undone(scene: Prepared) -> tuple[float, float, float] | None:
    """Of the shadow's pixels: mean darkening left, its mean absolute value, and the share that is filled instead."""
    found = found_in(scene)
    if isinstance(found, str):
        return None
    lifted = lift_shadow(scene.splat, scene.masks.removed, found, scene.witnesses)
    parts: list[tuple[np.ndarray, ...]] = []
    for witness, photo, dark in zip(scene.witnesses, lifted.photos, lifted.dark):
        there = scene.shadow.get(witness.camera.id)
        if there is None or not there.any():
            continue
        truth = light(cv2.resize(scene.truth[witness.camera.id], photo.shape[1::-1], interpolation=cv2.INTER_AREA))
        before, after = light(witness.photo) - truth, light(photo) - truth
        level = np.median(before[~there & ~witness.hidden])
        parts.append(((before - level)[there], (after - level)[there], dark[there]))
    before, after, dark = (np.concatenate([p[k] for p in parts]) for k in range(3))
    was = -before[~dark].mean()
    return -after[~dark].mean() / was, np.abs(after[~dark]).mean() / was, float(dark.mean())


if __name__ == "__main__":
    sys.exit(main())
