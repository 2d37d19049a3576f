"""Measures depth completion: the scale of a prior (s_f) against the best one and against none on random cases, the
surfaces on random places, and depth errors in the holes of the scenes rendered with and without the object.

Writes OUT/depth.json, OUT/depth.md and a chart. Run by `make bench-depth`.

    python scripts/bench_depth.py [--quick] [--data FOLDER] [--first-seed N] [--out FOLDER] [--chart FILE.svg]
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from depth_report import draw_chart, markdown
from depth_scenes import PLACES, RELIEFS, place, prior_of, relief

from gimp3d.box import read_region
from gimp3d.camera import Camera
from gimp3d.compute.threads import parallel_map
from gimp3d.errors import IllPosed
from gimp3d.gaussians import Gaussians
from gimp3d.geometry import disparity_of
from gimp3d.io.cameras import read_cameras
from gimp3d.io.ply import read_ply
from gimp3d.job import write_atomically
from gimp3d.priors.monodepth import DepthPrior
from gimp3d.raster import RasterSettings, render, surface_depth
from gimp3d.solvers.poisson import solve_poisson
from gimp3d.stages.depth import DepthSettings, complete_depth, complete_disparity, fit_prior
from gimp3d.stages.layers import distance_to
from gimp3d.stages.masks import ViewMasks, find_masks
from gimp3d.stages.reference import rim

ROOT = Path(__file__).resolve().parents[1]
OURS = DepthSettings()
PAPER = replace(OURS, surface="harmonic")  # a membrane, guided or not
ERRORS = (0.0, 0.05, 0.15)  # of the prior, smooth, as a share of the disparity's range
SCENES = ("desk", "corner", "gloss", "rocks")
SOLID = 0.9  # alpha from which a depth is trusted
RING = 24  # px round the hole in which the splats' own error is measured
Row = dict[str, Any]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="a few cases, in seconds")
    parser.add_argument("--data", type=Path, default=ROOT.parent / "shared" / "data" / "withwithout")
    parser.add_argument("--first-seed", type=int, default=5000, help="of the random cases; others give fresh ones")
    parser.add_argument("--out", type=Path, default=ROOT / "build" / "bench_depth")
    parser.add_argument("--chart", type=Path, help="default: assets/depth_error.svg, or OUT/depth_error.svg if --quick")
    given = parser.parse_args()
    chart = given.chart or (given.out if given.quick else ROOT / "assets") / "depth_error.svg"
    count = 1 if given.quick else 20
    names = [n for n in SCENES if (given.data / n / "truth").is_dir()]
    results: Row = {
        "quick": given.quick,
        "first_seed": given.first_seed,
        "scale": list(scale_cases(range(given.first_seed, given.first_seed + count))),
        "places": list(place_cases(range(given.first_seed, given.first_seed + count))),
        "scenes": [row for n in names for row in scene_cases(given.data / n, 1 if given.quick else None)],
    }
    given.out.mkdir(parents=True, exist_ok=True)
    write_atomically(given.out / "depth.json", lambda f: f.write(json.dumps(results, indent=1).encode()))
    write_atomically(given.out / "depth.md", lambda f: f.write(markdown(results).encode()))
    if names:
        chart.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(chart, lambda f: f.write(draw_chart(results["scenes"]).encode()))
    print(markdown(results))


def scale_cases(seeds: range) -> Iterator[Row]:
    """RMSE in the hole, % of the disparity's range, of every way to choose s_f on random reliefs."""
    cases = [(kind, error, seed) for kind in RELIEFS for error in ERRORS for seed in seeds]
    yield from parallel_map(lambda case: _scale_case(*case), cases)


def _scale_case(kind: str, error: float, seed: int) -> Row:
    rng = np.random.default_rng([seed, RELIEFS.index(kind), ERRORS.index(error)])
    scene = relief(kind, rng)
    gain, shift = float(np.exp(rng.uniform(-3, 3))), rng.uniform(-5, 5)
    prior = prior_of(scene.truth, rng, gain, shift, error)
    hole, truth = scene.hole, scene.truth[scene.hole]
    # Two Laplace solves give the membrane for every s_f.
    base = solve_poisson(hole, ~hole, scene.measured).values[hole]
    detail = prior[hole] - solve_poisson(hole, ~hole, prior).values[hole]
    flat = detail.std() < 1e-9 * np.abs(prior).max()
    best = 0.0 if flat else float((truth - base) @ detail / (detail @ detail))
    fit = fit_prior(scene.measured, ~hole, hole, prior)

    def rmse(disparity: np.ndarray) -> float:
        return float(100 * np.sqrt(np.mean((disparity - truth) ** 2)) / np.ptp(scene.truth))

    def ours(with_prior: np.ndarray | None, scale: float | None = None) -> float:
        settings = replace(OURS, surface="smooth", scale_factor=scale)
        return rmse(complete_disparity(scene.measured, ~hole, hole, with_prior, settings).disparity[hole])

    tried = np.linspace(0.2, 1.4, 7) * (0 if flat else gain)
    return {
        "kind": kind,
        "error": error,
        "seed": seed,
        "gain": gain,
        "s_f": fit.scale,
        "best_s_f": best,
        "membrane": {
            "measured": rmse(base + fit.scale * detail),
            "best": rmse(base + best * detail),
            "none": rmse(base),
            "0.1": rmse(base + 0.1 * detail),
            "as printed": rmse(base - gain * detail),
        },
        "plate": {
            "measured": ours(prior) if fit.scale else ours(None),
            "best": min([ours(None), *(ours(prior, float(s)) for s in tried if s)]),
            "none": ours(None),
        },
    }


def place_cases(seeds: range) -> Iterator[Row]:
    """Relative depth errors in the hole on random places, without a prior."""
    cases = [(kind, seed) for kind in PLACES for seed in seeds]
    yield from parallel_map(lambda case: _place_case(*case), cases)


def _place_case(kind: str, seed: int) -> Row:
    scene = place(kind, np.random.default_rng([seed, PLACES.index(kind)]))
    row: Row = {"kind": kind, "seed": seed}
    for surface in ("harmonic", "smooth", "planar", "auto"):
        settings = replace(OURS, surface=surface, plane_share=0.3 if surface == "planar" else OURS.plane_share)
        try:
            found = complete_disparity(scene.measured, ~scene.hole, scene.hole, None, settings)
        except IllPosed:
            row[surface] = None
            continue
        row[surface] = errors(found.depth, 1 / scene.truth, scene.hole)
        if surface == "auto":
            row |= {"planes": found.reason.startswith("planar"), "confidence": found.confidence}
    return row


def errors(depth: np.ndarray, truth: np.ndarray, where: np.ndarray) -> dict[str, float]:
    """Median, 95th percentile and bias of the relative depth error, in %; a pixel without depth is 100 % off."""
    with np.errstate(divide="ignore", invalid="ignore"):
        off = 100 * np.where(depth[where] > 0, depth[where] / truth[where] - 1, 1.0)
    if len(off) == 0:
        return {"median": float("nan"), "p95": float("nan"), "bias": float("nan")}
    size = np.abs(off)
    return {"median": float(np.median(size)), "p95": float(np.percentile(size, 95)), "bias": float(np.median(off))}


def scene_cases(folder: Path, most: int | None) -> Iterator[Row]:
    """Depth errors in the hole of each test view of a scene, by source of the depth round it, surface and prior."""
    cameras = read_cameras(folder / "transforms.json")
    gaussians, region = read_ply(folder / "scene.ply").gaussians, read_region(folder / "roi.json")
    train = [c for c in cameras if c.split == "train"]
    for camera in [c for c in cameras if c.split == "test"][:most]:
        masks = find_masks(gaussians, region, [*train, camera])
        view = next(v for v in masks.views if v.camera.id == camera.id)
        others = [v for v in masks.views if v.camera.id != camera.id]
        name = Path(camera.id).stem
        truth = np.load(folder / "truth" / "test" / f"{name}.depth.npy").astype(np.float64)
        unseen = cv2.imread(str(folder / "truth" / "test" / f"{name}.unseen.png"), cv2.IMREAD_GRAYSCALE) > 0
        there = np.isfinite(truth) & (truth > 0)
        for source, depth in depth_sources(gaussians.take(~masks.removed), camera).items():
            seen = replace(view, depth_after=depth)
            known = rim(seen, SOLID)
            ring = known & (distance_to(view.target) <= RING) & there
            about = {"scene": folder.name, "view": name, "source": source, "ring": errors(depth, truth, ring)}
            for way, complete in ways(seen, others, known, truth, source == "surface").items():
                try:
                    found = complete()
                except IllPosed:
                    continue
                yield about | {
                    "way": way,
                    "hole": errors(found.depth, truth, view.target & there),
                    "unseen": errors(found.depth, truth, view.target & unseen & there),
                    "confidence": found.confidence,
                    "reason": found.reason,
                }


def depth_sources(kept: Gaussians, camera: Camera) -> dict[str, np.ndarray]:
    """The depth of the splats that stay, by what counts as a pixel's depth."""
    drawn = render(kept, camera, RasterSettings(), frozenset({"depth"}))
    return {"expected": drawn.expected_depth, "median": drawn.median_depth, "surface": surface_depth(kept, camera)[0]}


def ways(
    view: ViewMasks, others: list[ViewMasks], known: np.ndarray, truth: np.ndarray, every: bool
) -> dict[str, Callable[[], Any]]:
    """Every way to complete a view: name → what does it."""
    disparity = disparity_of(view.depth_after)
    rng = np.random.default_rng(7)
    true = 1 / truth
    gain = 0.27
    priors = {
        "true": DepthPrior(true.astype(np.float32)),
        "gain, shift": DepthPrior(prior_of(true, rng, gain, -0.4).astype(np.float32)),
        "noise 5 %": DepthPrior(prior_of(true, rng, gain, -0.4, noise=0.05).astype(np.float32)),
        "bias 5 %": DepthPrior(prior_of(true, rng, gain, -0.4, bias=0.05).astype(np.float32)),
        "affine depth, bias 5 %": DepthPrior((0.3 / prior_of(true, rng, 1, bias=0.05) + 2).astype(np.float32), "depth"),
    }

    def alone(settings: DepthSettings, prior: DepthPrior | None = None) -> Callable[[], Any]:
        return lambda: complete_depth(view, [view], disparity, known, prior, settings)

    found = {
        "harmonic": alone(PAPER),
        "planar": alone(replace(OURS, surface="planar", plane_share=0.4)),
        "smooth": alone(replace(OURS, surface="smooth")),
        "auto": alone(OURS),
        "auto, other views": lambda: complete_depth(view, others, disparity, known, None, OURS),
    }
    if not every:
        return {name: found[name] for name in ("harmonic", "auto")}
    for name, prior in priors.items():
        scale = 1.0 if name == "true" else gain
        found |= {f"guided, {name}": alone(OURS, prior), f"membrane, {name}": alone(PAPER, prior)}
        if name in ("gain, shift", "bias 5 %"):
            found |= {
                f"s_f = 0.1, {name}": alone(replace(PAPER, scale_factor=0.1), prior),
                f"sign as printed, {name}": alone(replace(PAPER, scale_factor=-scale), prior),
            }
    return found


if __name__ == "__main__":
    main()
