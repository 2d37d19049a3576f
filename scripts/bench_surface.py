"""Measures where a removal fills and on what surface: target regions, references, depths, and how much they change when
poses, depths, the region, the reference or the photos do. On scenes rendered with and without the object.

Writes OUT/surface.json, OUT/surface.md, OUT/index.html with its pictures, and charts. Run by `make bench-surface`.

    python scripts/bench_surface.py [DATA] [--quick] [--scenes a,b] [--out build/bench_surface] [--charts assets]
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Iterator
from contextlib import nullcontext
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from bench_raster import ROOT, machine, say, write
from perturbations import moved, noisy_depths, resized, turned
from surface_chart import masks_chart, references_chart, stability_chart
from surface_pictures import depth_sheet, mask_sheet
from surface_report import markdown, page
from surface_scenes import (
    SHADOW,
    Scene,
    mask_scores,
    overlap,
    read_scene,
    reference_scores,
    scene_masks,
    surface_scores,
    targets,
)

from gimp3d.errors import BadInput, IllPosed
from gimp3d.io.images import write_png
from gimp3d.stages.depth import DepthSettings
from gimp3d.stages.masks import Masks, MaskSettings

MODES = ("need", "paper")
SURFACES = ("harmonic", "planar", "auto")
CHARTS = {
    "surface_masks.svg": masks_chart,
    "surface_references.svg": references_chart,
    "surface_stability.svg": stability_chart,
}


@dataclass(frozen=True)
class Plan:
    """How far what is perturbed; `seeds` only where there is chance in it."""

    poses: tuple[float, ...]  # px RMS
    depths: tuple[float, ...]  # relative, one standard deviation
    sizes: tuple[float, ...]  # of the region
    places: tuple[tuple[int, float], ...]  # the region's axis, share of its size
    seeds: tuple[int, ...]


FULL = Plan(
    poses=(0.1, 0.3, 1.0, 2.0),
    depths=(0.001, 0.003, 0.01, 0.03),
    sizes=(0.8, 0.9, 1.1, 1.2),
    places=tuple((axis, share) for axis in range(3) for share in (-0.1, 0.1)),
    seeds=(0, 1),
)
QUICK = Plan(poses=(0.3, 2.0), depths=(0.003, 0.03), sizes=(0.8, 1.2), places=((0, 0.1), (2, -0.1)), seeds=(0,))
QUICK_SCENES = ("desk", "desk" + SHADOW)


@dataclass(frozen=True)
class Perturbation:
    """One way to be wrong."""

    kind: str  # poses, depths, size, place, or none
    level: float = 0.0
    label: str = "0"  # of the level
    axis: int = 0  # of the region, for its place
    seed: int = 0


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", nargs="?", type=Path, default=ROOT.parent / "shared" / "data" / "withwithout")
    parser.add_argument("--quick", action="store_true", help="one place and the largest perturbations only")
    parser.add_argument("--scenes", help="names, separated by commas; default: all in DATA")
    parser.add_argument("--out", type=Path, default=ROOT / "build" / "bench_surface")
    parser.add_argument("--charts", type=Path, help="folder; default: assets, or OUT where not everything is measured")
    given = parser.parse_args()
    try:
        results = measured(given.data, given.quick, given.scenes, given.out)
    except BadInput as error:
        print(f"bench_surface: error: {error}", file=sys.stderr)
        return error.exit_code
    charts = given.charts or (given.out if given.quick or given.scenes else ROOT / "assets")
    write(given.out / "surface.json", json.dumps(results, indent=1))
    write(given.out / "surface.md", markdown(results))
    pictures = {name: draw(results) for name, draw in CHARTS.items()}
    for name, picture in pictures.items():
        write(charts / name, picture)
    write(given.out / "index.html", page(results, pictures))
    return 0


def measured(data: Path, quick: bool, only: str | None, out: Path) -> dict[str, Any]:
    names = only.split(",") if only else sorted(p.parent.name for p in data.glob("*/truth"))
    names = [n for n in names if only or not quick or n in QUICK_SCENES]
    if not names:
        raise BadInput(f"{data} holds no scenes with truth/")
    results: dict[str, Any] = {"quick": quick, "machine": machine(), "scenes": names}
    results |= {key: [] for key in ("masks", "references", "depths", "stability", "shadows", "pictures")}
    unperturbed: dict[str, dict[str, np.ndarray]] = {}
    for name in names:
        unperturbed[name] = measure_scene(read_scene(data / name), QUICK if quick else FULL, results, out)
    results["shadows"] = [shadow(name, results, unperturbed) for name in names if name + SHADOW in names]
    return results


def measure_scene(scene: Scene, plan: Plan, results: dict[str, Any], out: Path) -> dict[str, np.ndarray]:
    """Everything about one scene, into the results, and pictures of it into `out`. Returns T of its training views."""
    scene_masks(scene, scene.train[:2])  # compiles what is not in the cache, which is not to be timed
    for mode in MODES:
        start = time.process_time()
        masks = scene_masks(scene, scene.train, MaskSettings(mode=mode))
        cpu = round(time.process_time() - start, 2)
        row = {"scene": scene.name, "mode": mode, **mask_scores(scene, masks), "cpu_s": cpu}
        results["masks"].append(row)
        say(f"{scene.name} {mode}: {row['covered']:.2%} covered, area {row['area']:.2f}, {cpu} s")
        save_picture(out, f"masks_{scene.name}_{mode}.png", mask_sheet(scene, masks), results)
        if mode == MODES[0]:
            results["references"].append({"scene": scene.name, **reference_scores(masks)})
    # A test view is a camera only; to be completed as the reference it must be among those that masks are found for.
    masks = scene_masks(scene, scene.train + scene.test)
    for kind in SURFACES:
        rows = surface_scores(scene, masks, DepthSettings(surface=kind))
        results["depths"] += [{"scene": scene.name, "surface": kind, **row} for row in rows]
    save_picture(out, f"surfaces_{scene.name}.png", depth_sheet(scene, masks), results)
    before = targets(masks, scene.train)
    results["stability"].append(stability(scene, Perturbation("none"), masks, before))
    for perturbation in perturbations(plan):
        try:
            row = stability(scene, perturbation, perturbed_masks(scene, perturbation), before)
            said = f"IoU {row['iou']:.3f}, {row['covered']:.2%} covered, depth error {row['median']:.2%}"
        except IllPosed as error:
            row, said = {"scene": scene.name, **asdict(perturbation), "refused": str(error)}, f"refused: {error}"
        results["stability"].append(row)
        say(f"{scene.name} {perturbation.kind} {perturbation.label}: {said}")
    return before


def perturbations(plan: Plan) -> Iterator[Perturbation]:
    for seed in plan.seeds:
        yield from (Perturbation("poses", pixels, f"{pixels:g}", seed=seed) for pixels in plan.poses)
        yield from (Perturbation("depths", share, f"{100 * share:g}", seed=seed) for share in plan.depths)
    yield from (Perturbation("size", factor, f"{factor:g}") for factor in plan.sizes)
    yield from (Perturbation("place", share, f"{'-+'[share > 0]}{'xyz'[axis]}", axis) for axis, share in plan.places)


def perturbed_masks(scene: Scene, perturbation: Perturbation) -> Masks:
    """The scene's masks where something is wrong. Test views are never turned: the truth is known in them only."""
    train, region, level = scene.train, scene.region, perturbation.level
    if perturbation.kind == "poses":
        rng = np.random.default_rng(perturbation.seed)
        train = tuple(turned(c, level, rng) for c in train)
    elif perturbation.kind == "size":
        region = resized(region, level)
    elif perturbation.kind == "place":
        region = moved(region, perturbation.axis, level)
    with noisy_depths(level, perturbation.seed) if perturbation.kind == "depths" else nullcontext():
        return scene_masks(scene, train + scene.test, region=region)


def stability(scene: Scene, perturbation: Perturbation, masks: Masks, before: dict[str, np.ndarray]) -> dict[str, Any]:
    """T of the training views against that before and against the truth; depths of the test views against the truth."""
    iou, worst = overlap(targets(masks, scene.train), before)
    scores = mask_scores(scene, masks)
    surfaces = surface_scores(scene, masks)
    done = [r for r in surfaces if "refused" not in r]
    if not done:
        raise IllPosed(surfaces[0]["refused"])
    return {
        "scene": scene.name,
        **asdict(perturbation),
        "iou": iou,
        "worst_iou": worst,
        **{key: scores[key] for key in ("covered", "area")},
        **{key: float(np.mean([r[key] for r in done])) for key in ("median", "p95")},
        "references_refused": len(surfaces) - len(done),
    }


def shadow(name: str, results: dict[str, Any], unperturbed: dict[str, dict[str, np.ndarray]]) -> dict[str, Any]:
    """A place whose photos show the object's shadow and reflections, against the same without."""
    plain, dark = (
        next(r for r in results["stability"] if r["scene"] == n and r["kind"] == "none") for n in (name, name + SHADOW)
    )
    iou, worst = overlap(unperturbed[name], unperturbed[name + SHADOW])
    return {
        "scene": name,
        "iou": [1.0, iou],
        "worst_iou": [1.0, worst],
        **{key: [plain[key], dark[key]] for key in ("covered", "area", "median", "p95")},
    }


def save_picture(out: Path, name: str, picture: np.ndarray, results: dict[str, Any]) -> None:
    write_png(out / name, picture)
    results["pictures"].append(name)


if __name__ == "__main__":
    sys.exit(main())
