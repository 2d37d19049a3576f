"""Measures how much a removal depends on its reference: every test view with its true picture, and training views drawn
at random with the built-in fill. On scenes rendered with and without the object; whole removals, scored in test views.

Writes OUT/references.json, OUT/references.md and a chart. Run by `make bench-references`.

    python scripts/bench_references.py [DATA] [--quick] [--scenes a,b] [--steps N] [--out build/bench_references]
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field, replace
from functools import cache
from itertools import product
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from bench_raster import ROOT, machine, say, write
from references_report import FILLED, GIVEN, draw_chart, markdown
from surface_scenes import Scene, read_scene

from gimp3d.camera import Camera
from gimp3d.compute.threads import available_cores, set_thread_count
from gimp3d.errors import BadInput, IllPosed
from gimp3d.evaluate.metrics import psnr
from gimp3d.io.images import read_image
from gimp3d.pipeline import PRESETS, RemovalSettings, View, remove_object, render_bytes

SCENES = ("desk", "corner", "gloss", "rocks")
MODES = ("balanced", "paper")
DRAWN, SEED = 10, 0  # training views drawn as references
AT_ONCE = 2  # removals; each has long parts that use a single core


@dataclass(frozen=True)
class Group:
    """References of one scene that are measured after one another, by one process."""

    folder: Path
    kind: str
    preset: str
    count: int  # of references
    steps: int  # of refinement at most


@dataclass
class MasksOnly:
    """A store that keeps the masks: they do not depend on the reference as long as the views are the same."""

    kept: dict[str, Any] = field(default_factory=dict)

    def load(self, name: str) -> Any | None:
        return self.kept.get(name)

    def save(self, name: str, result: Any) -> None:
        if name == "masks":
            self.kept[name] = result


_scene = cache(read_scene)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", nargs="?", type=Path, default=ROOT.parent / "shared" / "data" / "withwithout")
    parser.add_argument("--quick", action="store_true", help="one scene and two references of each kind only")
    parser.add_argument("--scenes", default=",".join(SCENES), help="names, separated by commas")
    parser.add_argument("--steps", type=int, default=100, help="of refinement at most; the paper's preset has 3,000")
    parser.add_argument("--out", type=Path, default=ROOT / "build" / "bench_references")
    parser.add_argument("--chart", type=Path, help="default: assets/references.svg, or in OUT if not all is measured")
    given = parser.parse_args()
    names = given.scenes.split(",")[: 1 if given.quick else None]
    groups = [
        Group(given.data / name, kind, preset, 2 if given.quick else count, given.steps)
        for name, (kind, count), preset in product(names, ((GIVEN, sys.maxsize), (FILLED, DRAWN)), MODES)
    ]
    results: dict[str, Any] = {"machine": machine(), "steps": given.steps, "references": []}
    try:
        with ProcessPoolExecutor(AT_ONCE, get_context("spawn"), share_threads) as workers:
            for rows in workers.map(measured, groups):
                results["references"] += rows
    except BadInput as error:
        print(f"bench_references: error: {error}", file=sys.stderr)
        return error.exit_code
    whole = not given.quick and names == list(SCENES)
    write(given.out / "references.json", json.dumps(results, indent=1))
    write(given.out / "references.md", markdown(results))
    write(given.chart or (ROOT / "assets" if whole else given.out) / "references.svg", draw_chart(results))
    return 0


def share_threads() -> None:
    set_thread_count(max(1, available_cores() // AT_ONCE))


def measured(group: Group) -> list[dict[str, Any]]:
    """A row for each reference: PSNR of every test view but the reference, or why the removal was refused."""
    scene, store = _scene(group.folder), MasksOnly()
    preset = PRESETS[group.preset]
    settings = replace(preset, refine=replace(preset.refine, steps=min(preset.refine.steps, group.steps)))
    rows = []
    for camera, picture in references(scene, group):
        row = {"scene": scene.name, "kind": group.kind, "preset": group.preset, "reference": camera.id}
        try:
            row |= removal(scene, settings, camera, picture, None if group.kind == GIVEN else store)
            means = [np.mean([v[mask] for v in row["views"].values()]) for mask in ("mask", "unseen")]
            said = f"{means[0]:.2f} dB in mask, {means[1]:.2f} dB in unseen"
        except IllPosed as error:
            row["refused"] = said = str(error)
        say(f"{scene.name}, {group.kind}, {group.preset}, {camera.id}: {said}")
        rows.append(row)
    return rows


def references(scene: Scene, group: Group) -> Iterator[tuple[Camera, np.ndarray | None]]:
    """Cameras, and their pictures without the object where the removal is given them."""
    if group.kind == GIVEN:
        yield from ((c, read_image(scene.folder / c.id)) for c in scene.test[: group.count])
    else:
        drawn = np.random.default_rng(SEED).choice(len(scene.train), group.count, replace=False)
        yield from ((scene.train[k], None) for k in drawn)


def removal(
    scene: Scene, settings: RemovalSettings, reference: Camera, picture: np.ndarray | None, store: MasksOnly | None
) -> dict[str, Any]:
    """ID of test view → PSNR in what the object hides, and in what no training view sees of it. Whole removal.

    And the reference's own score: how much of the surface that has to be made up it shows, and how well. As in
    `gimp3d remove`, a reference that is no training view has no photo, but shows the scene as drawn.
    """
    views = [View(c, scene.photos[c.id]) for c in scene.train]
    if picture is not None:
        views.append(View(reference, render_bytes(scene.gaussians, reference)))
    result = remove_object(scene.gaussians, views, scene.region, settings, reference.id, picture, store=store)
    left = scene.gaussians.take(result.keep)
    filled = left if result.added is None else left.extended(result.added)
    found = {}
    for camera in scene.test:
        if camera.id != reference.id:
            drawn, truth = render_bytes(filled, camera), read_image(scene.folder / camera.id)
            masks = {"mask": scene.hides(camera), "unseen": scene.unseen(camera)}
            found[camera.id] = {name: psnr(drawn, truth, mask) for name, mask in masks.items()}
    score = next(s.score for s in result.references[0].scores if s.camera_id == reference.id)
    return {"views": found, "score": score}


if __name__ == "__main__":
    sys.exit(main())
