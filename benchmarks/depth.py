"""Measures depth completion: errors behind the object in scenes with truth, by surface and by priors whose faults are
known, with the scale of the prior (s_f) measured and as the paper has it.

Writes OUT/depth.json, OUT/depth.md and a chart. Run by `make bench-depth`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from gimp3d.camera import output_name
from gimp3d.errors import IllPosed
from gimp3d.geometry import disparity_of
from gimp3d.priors.monodepth import DepthPrior
from gimp3d.stages.depth import DepthSettings, complete_depth
from gimp3d.stages.masks import ViewMasks, find_masks
from gimp3d.stages.reference import rim

from .command import ASSETS, parser_of, told_in_one_line, write_results
from .plots import COLOURS, figure, plain_log_ticks
from .scenes import MADE, Scene, read_scenes
from .tables import Row, Section, distance_to, markdown, mean, values, where
from .timing import about, machine

OURS = DepthSettings()
PAPER = replace(OURS, surface="harmonic")  # a membrane, guided or not
RING = 24  # px round the hole in which the splats' own error is measured
GAIN = 0.27  # of the made priors in scenes
CHARTED = {  # from the best to the worst kind
    "auto, other views": "default: planes or plate, and other views",
    "auto": "planes or plate, this view alone",
    "planar": "planes",
    "smooth": "thin plate",
    "harmonic": "membrane (paper without a prior)",
    "guided, true": "prior: true depth",
    "guided, gain, shift": "prior: true, unknown units",
    "guided, noise 5 %": "prior: white noise 5 %",
    "guided, bias 5 %": "prior: smooth errors 5 %",
    "membrane, bias 5 %": "the same, membrane (paper, s_f measured)",
    "s_f = 0.1, bias 5 %": "the same, s_f = 0.1 (paper)",
    "sign as printed, bias 5 %": "the same, sign as printed",
}


def main() -> None:
    given = parser_of(__doc__, "depth", data=True, quick="one view of each scene", scenes=",".join(MADE)).parse_args()
    scenes, results = read_scenes(given.data, given.scenes, needs_truth=True), {"machine": machine()}
    results["scenes"] = [row for scene in scenes for row in scene_cases(scene, 1 if given.quick else None)]
    words = markdown("Depth completion", about(results["machine"]), sections(results["scenes"]))
    write_results(given.out, "depth", results, words)
    whole = not given.quick and given.scenes == ",".join(MADE)
    draw(results, (ASSETS if whole else given.out) / "depth_error.svg")


def prior_of(
    truth: np.ndarray, rng: np.random.Generator, gain: float, shift: float = 0.0, bias: float = 0.0, noise: float = 0.0
) -> np.ndarray:
    """A relative disparity [H, W], (truth + errors) / gain + shift: `gain` is the s_f of a prior without errors.

    `bias` is of smooth errors (σ 14 px), `noise` of white ones, both as shares of the disparity's range.
    """
    smooth = cv2.GaussianBlur(rng.standard_normal(truth.shape), (0, 0), 14)
    errors = bias * (smooth / smooth.std()) + noise * rng.standard_normal(truth.shape)
    return (truth + np.ptp(truth) * errors) / gain + shift


def scene_cases(scene: Scene, most: int | None) -> Iterator[Row]:
    """Depth errors in the hole of each test view of a scene, by surface and prior."""
    for camera in scene.test[:most]:
        masks = find_masks(scene.gaussians, scene.region, [*scene.train, camera])
        view = next(v for v in masks.views if v.camera.id == camera.id)
        others = [v for v in masks.views if v.camera.id != camera.id]
        truth, known = scene.depth(camera), rim(view)
        there = np.isfinite(truth) & (truth > 0)
        ring = errors(view.depth_after, truth, known & (distance_to(view.target) <= RING) & there)
        for way, complete in ways(view, others, known, truth).items():
            try:
                found = complete()
            except IllPosed:
                continue
            hole = view.target & there
            row = {"scene": scene.name, "view": output_name(camera.id), "way": way, "ring": ring}
            row |= {"hole": errors(found.depth, truth, hole)}
            yield row | {"unseen": errors(found.depth, truth, hole & scene.unseen(camera)), "reason": found.reason}


def errors(depth: np.ndarray, truth: np.ndarray, counted: np.ndarray) -> dict[str, float]:
    """Median, 95th percentile and bias of the relative depth error, in %; a pixel without depth is 100 % off."""
    if not counted.any():
        return dict.fromkeys(("median", "p95", "bias"), float("nan"))
    with np.errstate(divide="ignore", invalid="ignore"):
        off = 100 * np.where(depth[counted] > 0, depth[counted] / truth[counted] - 1, 1.0)
    median, p95, bias = np.median(abs(off)), np.percentile(abs(off), 95), np.median(off)
    return {"median": float(median), "p95": float(p95), "bias": float(bias)}


def ways(
    view: ViewMasks, others: list[ViewMasks], known: np.ndarray, truth: np.ndarray
) -> dict[str, Callable[[], Any]]:
    """Every way to complete a view: name → what does it."""
    disparity, rng, true = disparity_of(view.depth_after), np.random.default_rng(7), 1 / truth
    priors = {
        "true": (true, "disparity"),
        "gain, shift": (prior_of(true, rng, GAIN, -0.4), "disparity"),
        "noise 5 %": (prior_of(true, rng, GAIN, -0.4, noise=0.05), "disparity"),
        "bias 5 %": (prior_of(true, rng, GAIN, -0.4, bias=0.05), "disparity"),
        "affine depth, bias 5 %": (0.3 / prior_of(true, rng, 1, bias=0.05) + 2, "depth"),
    }

    def alone(settings: DepthSettings, prior: DepthPrior | None = None) -> Callable[[], Any]:
        return lambda: complete_depth(view, [view], disparity, known, prior, settings)

    found = {
        "harmonic": alone(PAPER),
        "planar": alone(replace(OURS, surface="planar")),
        "smooth": alone(replace(OURS, surface="smooth")),
        "auto": alone(OURS),
        "auto, other views": lambda: complete_depth(view, others, disparity, known, None, OURS),
    }
    for name, (numbers, kind) in priors.items():
        prior = DepthPrior(numbers.astype(np.float32), kind)
        found |= {f"guided, {name}": alone(OURS, prior), f"membrane, {name}": alone(PAPER, prior)}
        if name in ("gain, shift", "bias 5 %"):
            for words, scale in (("s_f = 0.1", 0.1), ("sign as printed", -GAIN)):
                found[f"{words}, {name}"] = alone(replace(PAPER, scale_factor=scale), prior)
    return found


# ---------------------------------------------------------------------------------------------------- what is written


def sections(rows: list[Row]) -> Iterator[Section]:
    scenes = values(rows, "scene")
    lines = [["ring", *(pair(where(rows, scene=s), "ring") for s in scenes), ""]]
    for way in values(rows, "way"):
        own = where(rows, way=way)
        lines.append([way, *(pair(where(own, scene=s), "hole") for s in scenes), pair(own, "unseen")])
    yield Section(
        "How the hole is completed",
        "Relative depth error, %: median / 95 %, means over the test views. Ring: the splats' own error within "
        f"{RING} px of the hole. Unseen: the part of the hole that no training view shows.",
        ["way", *scenes, "unseen, all"],
        lines,
    )


def pair(rows: list[Row], key: str) -> str:
    """Means of medians and of 95th percentiles."""
    found = [r[key] for r in rows if not np.isnan(r[key]["median"])]
    return f"{mean(found, 'median'):.2f} / {mean(found, 'p95'):.2f}" if found else "–"


def draw(results: Row, path: Path) -> None:
    """Median errors of each way in each scene; a bar in the scene's colour at the splats' own error on the ring."""
    rows = results["scenes"]
    ways = [way for way in CHARTED if where(rows, way=way)]
    words = "Scenes with known truth, means over their test views; dotted: the splats' own error round the hole"
    with figure(path, "How right the completed depth is", words, 8.5, 0.8 + 0.33 * len(ways)) as fig:
        ax = fig.subplots()
        ax.set_xscale("log")
        for scene, colour in zip(values(rows, "scene"), COLOURS):
            own = where(rows, scene=scene)
            ax.axvline(mean([r["ring"] for r in own], "median"), color=colour, linestyle=":")
            found = [mean([r["hole"] for r in where(own, way=way)], "median") for way in ways]
            ax.plot(found, range(len(ways)), "o", color=colour, label=scene)
        plain_log_ticks(ax.xaxis, [0.1, 20.0])
        ax.set(xlim=(0.1, 20), xlabel="median relative depth error in the hole, % (log)")
        ax.set_yticks(range(len(ways)), [CHARTED[way] for way in ways])
        ax.invert_yaxis()
        fig.legend(loc="outside lower left", ncols=4)


if __name__ == "__main__":
    told_in_one_line(main)
