"""Measures how whole removals bear what is wrong with their input: too few views, views from one side, exposures, wrong
photos, wrong depths. On scenes rendered with and without the object.

Writes OUT/stability.json, OUT/stability.md and a chart. Run by `make bench-stability`.

    python scripts/bench_stability.py [DATA] [--quick] [--scenes a,b] [--preset balanced] [--out build/bench_stability]
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import nullcontext
from dataclasses import asdict, dataclass
from functools import cache
from itertools import product
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from bench_raster import ROOT, machine, say, write
from bench_references import AT_ONCE, share_threads
from perturbations import exposed, garbled, gathered, misplaced, noisy_depths, noisy_surfaces
from stability_report import draw_chart, markdown
from surface_scenes import Scene, read_scene

from gimp3d.box import Region
from gimp3d.camera import Camera
from gimp3d.errors import BadInput, IllPosed
from gimp3d.evaluate.metrics import psnr
from gimp3d.gaussians import Gaussians
from gimp3d.io.images import read_image
from gimp3d.pipeline import PRESETS, RemovalResult, View, remove_object, render_bytes

SCENES = ("desk", "gloss")
CLUSTER = 12  # views that look from one side
SEED = 0


@dataclass(frozen=True)
class Perturbation:
    """One way in which the input is wrong."""

    kind: str  # as in LEVELS, or none
    level: float = 0.0


LEVELS = {
    "views": (9, 3, 2, 1),  # the reference among them; two are 1° apart
    "cone": (90, 30, 10),  # degrees from the reference within which all views look; of CLUSTER views
    "exposure": (0.1, 0.2, 0.4),  # each photo's gain, ±
    "misplaced": (0.1, 0.2, 0.4),  # share of photos that are other views'
    "garbled": (0.1, 0.2, 0.4),  # share of all photos' pixels that show something else
    "surface": (0.01, 0.03, 0.1),  # noise of the references' completed depths, relative
    "depths": (0.01, 0.03, 0.1),  # of all depths that are drawn
}
QUICK = {"views": (1,), "misplaced": (0.1,), "surface": (0.1,)}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", nargs="?", type=Path, default=ROOT.parent / "shared" / "data" / "withwithout")
    parser.add_argument("--quick", action="store_true", help="one scene and three perturbations")
    parser.add_argument("--scenes", default=",".join(SCENES), help="names, separated by commas")
    parser.add_argument("--preset", default="balanced", choices=PRESETS)
    parser.add_argument("--out", type=Path, default=ROOT / "build" / "bench_stability")
    parser.add_argument("--chart", type=Path, help="default: assets/stability.svg, or in OUT if not all is measured")
    given = parser.parse_args()
    names = given.scenes.split(",")[: 1 if given.quick else None]
    asked = [Perturbation("none")]
    asked += [Perturbation(k, level) for k, levels in (QUICK if given.quick else LEVELS).items() for level in levels]
    results: dict[str, Any] = {"machine": machine(), "preset": given.preset, "rows": []}
    try:
        with ProcessPoolExecutor(AT_ONCE, get_context("spawn"), share_threads) as workers:
            folders, perturbations = zip(*product((given.data / n for n in names), asked))
            for row in workers.map(measured, folders, perturbations, [given.preset] * len(folders)):
                results["rows"].append(row)
                say(" ".join(f"{v:.4g}" if isinstance(v, float) else str(v) for v in row.values()))
    except BadInput as error:
        print(f"bench_stability: error: {error}", file=sys.stderr)
        return error.exit_code
    whole = not given.quick and names == list(SCENES)
    write(given.out / "stability.json", json.dumps(results, indent=1))
    write(given.out / "stability.md", markdown(results))
    write(given.chart or (ROOT / "assets" if whole else given.out) / "stability.svg", draw_chart(results))
    return 0


_scene = cache(read_scene)


def measured(folder: Path, perturbation: Perturbation, preset: str) -> dict[str, Any]:
    """A removal, the reference's true picture given: PSNR of the other test views, and what was added; or why not."""
    scene = _scene(folder)
    reference, *others = scene.test
    row: dict[str, Any] = {"scene": scene.name, **asdict(perturbation)}
    views = perturbed_views(scene, reference, perturbation)
    noise = {"surface": noisy_surfaces, "depths": noisy_depths}.get(perturbation.kind)
    try:
        with noise(perturbation.level, SEED) if noise else nullcontext():
            picture = read_image(folder / reference.id)
            result = remove_object(scene.gaussians, views, scene.region, PRESETS[preset], reference.id, picture)
    except IllPosed as error:
        return row | {"refused": str(error)}
    emptied = scene.gaussians.take(result.keep)
    filled = emptied.extended(result.added) if result.added else emptied
    for name, splats in (("", filled), ("open ", emptied)):
        row |= {f"{name}{k}": v for k, v in scored(scene, splats, others).items()}
    return row | grown(result, scene.region) | {"warnings": list(result.warnings)}


def perturbed_views(scene: Scene, reference: Camera, perturbation: Perturbation) -> list[View]:
    """The views that a removal is given, the reference last. It has no photo: it shows the scene as drawn."""
    kind, level = perturbation.kind, perturbation.level
    photos, cameras = scene.photos, scene.train
    if kind in WRONG_PHOTOS:
        photos = WRONG_PHOTOS[kind](photos, level, SEED)
    elif kind in ("views", "cone"):
        others = int(level) - 1 if kind == "views" else CLUSTER
        cameras = cameras[:: max(1, -(-len(cameras) // max(1, others)))][:others]
        if kind == "cone" or others == 1:
            cameras = gathered(cameras, reference, scene.region[0].center, level if kind == "cone" else 1.0)
            photos = {c.id: render_bytes(scene.gaussians, c) for c in cameras}
    return [View(c, photos[c.id]) for c in cameras] + [View(reference, render_bytes(scene.gaussians, reference))]


WRONG_PHOTOS = {"exposure": exposed, "misplaced": misplaced, "garbled": garbled}


def scored(scene: Scene, splats: Gaussians, cameras: Sequence[Camera]) -> dict[str, float]:
    """Mean PSNR in what the object hides, and in what no training view sees of it."""
    found: dict[str, list[float]] = {"mask": [], "unseen": []}
    for camera in cameras:
        drawn, truth = render_bytes(splats, camera), read_image(scene.folder / camera.id)
        for name, mask in (("mask", scene.hides(camera)), ("unseen", scene.unseen(camera))):
            found[name].append(psnr(drawn, truth, mask))
    return {name: float(np.mean(values)) for name, values in found.items()}


def grown(result: RemovalResult, region: Region) -> dict[str, Any]:
    """What was added: how many, whether all is finite, the largest splat and the farthest, in diagonals of the box."""
    new = result.added
    if not new:
        return {"added": 0, "finite": True, "largest": 0.0, "farthest": 0.0}
    corners = np.concatenate([box.corners() for box in region])
    centre, diagonal = corners.mean(0), float(np.linalg.norm(np.ptp(corners, axis=0)))
    arrays = (new.means, new.log_scales, new.quats, new.opacity_logits, new.sh)
    return {
        "added": len(new),
        "finite": all(bool(np.isfinite(a).all()) for a in arrays),
        "largest": float(new.scales.max()) / diagonal,
        "farthest": float(np.linalg.norm(new.means - centre, axis=1).max()) / diagonal,
    }


if __name__ == "__main__":
    sys.exit(main())
