"""What the new Gaussians are worth: presets, ablations and baselines by quality, time and count, on scenes with truth.

Kernels are compiled before anything is timed. Seconds hold all that a removal does; CPU seconds, of all threads, mean
the same on a busy machine. Writes OUT/pareto.json, OUT/pareto.md and charts. Run by `make bench-pareto`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from gimp3d.evaluate import telea
from gimp3d.gaussians import Gaussians
from gimp3d.pipeline import PRESETS, RemovalResult, RemovalSettings, render_bytes

from .ablation import changed
from .command import ASSETS, parser_of, say, told_in_one_line, write_results
from .plots import COLOURS, FAINT, Line, Panel, draw_panels, figure, name_ends
from .scenes import MADE, Scene, filled, new_gaussians, read_scenes, removal, scores
from .tables import Row, Section, markdown, mean, values, where
from .timing import Watch, about, machine

BALANCED = PRESETS["balanced"]
METRICS = {"psnr mask": "{:.2f}", "ssim mask": "{:.3f}", "flip mask": "{:.3f}", "psnr unseen": "{:.2f}"}
METRICS |= {"ssim unseen": "{:.3f}", "flip unseen": "{:.3f}", "agreement": "{:.2f}"}
COSTS = {"added": "{:.0f}", "share": "{:.2f}", "seconds": "{:.1f}", "cpu seconds": "{:.1f}"}
HUES = dict(zip(("presets", "paper", "ablations", "baselines"), COLOURS))


def seeded(**seed: Any) -> RemovalSettings:
    """Balanced without refinement, and with other settings of the seeds."""
    return changed(BALANCED, [("refine.steps", 0), *((f"seed.{name}", value) for name, value in seed.items())])


GROUPS: dict[str, dict[str, RemovalSettings]] = {
    "paper": {name: PRESETS[name] for name in ("paper-literal", "paper")},
    "presets": {name: PRESETS[name] for name in ("draft", "balanced", "best")},
    "ablations": {
        "not refined": seeded(),
        "… one per pixel, as seeded": seeded(largest=1, corrections=0),
        "… colours as seeded": seeded(corrections=0),
    },
    "counts": {
        f"detail {detail:g}, patch {largest}": seeded(detail=detail, largest=largest)
        for detail, largest in ((0, 1), (5, 4), (20, 4), (100, 4), (500, 8), (5000, 8))
    },
    "degrees": {f"degree {degree}": seeded(sh_degree=degree) for degree in range(4)},
}


def main() -> None:
    parser = parser_of(
        __doc__, "pareto", data=True, quick="one scene, presets without the paper's", scenes=",".join(MADE)
    )
    parser.add_argument("--paper-steps", type=int, default=PRESETS["paper"].refine.steps, help="fewer: a shorter run")
    given = parser.parse_args()
    paper = {n: changed(s, [("refine.steps", given.paper_steps)]) for n, s in GROUPS["paper"].items()}
    groups = GROUPS | {"paper": paper}
    if given.quick:
        given.scenes, groups = MADE[0], {"presets": {n: GROUPS["presets"][n] for n in ("draft", "balanced")}}
    results: Row = {"machine": machine(), "rows": []}
    scenes = read_scenes(given.data, given.scenes, needs_truth=True)
    run(scenes[0], groups, only_compile=True)
    for scene in scenes:
        results["rows"] += run(scene, groups)
        words = markdown("New Gaussians: quality, time, number", about(results["machine"]), sections(results["rows"]))
        write_results(given.out, "pareto", results, words)
    folder = ASSETS if given.scenes == ",".join(MADE) else given.out
    draw_pareto(results["rows"], folder / "pareto.svg")
    if not given.quick:
        draw_parsimony(means(results["rows"]), folder / "parsimony.svg")


def run(scene: Scene, groups: Mapping[str, Mapping[str, RemovalSettings]], only_compile: bool = False) -> list[Row]:
    """Every method on a scene; only_compile: with a single step of refinement, so that nothing timed compiles."""
    rows: list[Row] = []
    removed = np.zeros(0, bool)
    for group, methods in groups.items():
        for method, settings in methods.items():
            if only_compile:
                settings = changed(settings, [("refine.steps", min(1, settings.refine.steps))])
            row, removed = measure(scene, method, settings)
            rows.append({"group": group, **row})
            numbers = "".join(f"{rows[-1][k]:8.2f}" for k in ("psnr mask", "psnr unseen", "seconds", "cpu seconds"))
            say(f"{scene.name:8}{method:28}{numbers}{rows[-1]['added']:7}")
    return rows if only_compile else [*rows, *baselines(scene, removed)]


def measure(scene: Scene, name: str, settings: RemovalSettings) -> tuple[Row, np.ndarray]:
    """A removal's row, and which Gaussians went, [N] bool."""
    made: dict[str, Any] = {}

    def watched(stage: str, work: Callable[..., Any], inputs: tuple[Any, ...]) -> Any:
        if stage == "seed":
            made["target"] = inputs[3]
        made[stage] = work(*inputs)
        return made[stage]

    reference, watch = scene.test[0], Watch()
    result = removal(scene, settings, reference, scene.truth(reference), observer=watched)
    spent = seconds_of(watch)
    splats = filled(scene.gaussians, result)
    added = len(new_gaussians(result) or ())
    row: Row = {"scene": scene.name, "method": name, "added": added, "share": added / max(1, made["target"].sum())}
    row |= {"stages": {s.name: s.seconds for s in result.stages}}
    row |= spent | {"agreement": agreement(scene, splats, result)}
    return row | scores(scene, {c.id: render_bytes(splats, c) for c in scene.test[1:]}), made["masks"].removed


def seconds_of(watch: Watch) -> Row:
    wall, cpu = watch.lap()
    return {"seconds": wall / 1e3, "cpu seconds": cpu / 1e3}


def agreement(scene: Scene, splats: Gaussians, result: RemovalResult) -> float:
    """PSNR of the drawn scene against the painted training views, where they differ from the photos: consistency."""
    errors = []
    for view in scene.views[::3]:
        painted = result.painted.get(view.camera.id)
        if painted is None or not (there := (painted != view.image).any(-1)).any():
            continue
        wrong = render_bytes(splats, view.camera)[there].astype(float) - painted[there]
        errors.append(10 * np.log10(255**2 / max(1e-9, (wrong**2).mean())))
    return float(np.mean(errors))


def baselines(scene: Scene, removed: np.ndarray) -> Iterator[Row]:
    """The open hole, and Telea's fill of the true mask on the photo."""
    kept, watch = scene.gaussians.take(~removed), Watch()
    fills = {c.id: telea(scene.with_object(c), scene.hides(c)) for c in scene.test[1:]}
    spent = seconds_of(watch)
    opened = {c.id: render_bytes(kept, c) for c in scene.test[1:]}
    for name, pictures, took in (("hole open", opened, dict.fromkeys(spent, 0.0)), ("telea", fills, spent)):
        row: Row = {"group": "baselines", "scene": scene.name, "method": name, "added": 0, "share": 0.0, "stages": {}}
        yield row | took | scores(scene, pictures)


def means(rows: Sequence[Row]) -> list[Row]:
    """One row per method: means over the scenes."""
    found = []
    for group, method in dict.fromkeys((r["group"], r["method"]) for r in rows):
        of = where(rows, group=group, method=method)
        row = {"scene": "mean", "method": method, "group": group} | {k: mean(of, k) for k in (*METRICS, *COSTS)}
        stages: dict[str, float] = {}
        for name, seconds in (item for r in of for item in r["stages"].items()):
            name = name.split(" ")[0]  # of all references together
            stages[name] = stages.get(name, 0.0) + seconds / len(of)
        found.append(row | {"stages": stages})
    return found


def sections(rows: Sequence[Row]) -> Iterator[Section]:
    average = means(rows)
    for group in values(rows, "group"):
        lines = []
        for row in where([*rows, *average], group=group):
            numbers = [form.format(row.get(k, math.nan)) for k, form in (METRICS | COSTS).items()]
            lines.append([row["scene"], row["method"], *numbers])
        yield Section(group, "", ["scene", "method", *METRICS, "added", "per px of T", "s", "CPU s"], lines)
    timed = [r for r in average if r["group"] in ("paper", "presets")]
    stages = list(dict.fromkeys(name for r in timed for name in r["stages"]))
    lines = [[r["method"], *(f"{r['stages'].get(s, 0.0):.2f}" for s in stages)] for r in timed]
    yield Section("Seconds per stage, means", "", ["method", *stages], lines)


def draw_pareto(rows: Sequence[Row], path: Path) -> None:
    """Quality against seconds: one bubble per preset, ablation and baseline; its area is the Gaussians added.

    The open hole takes no time and lies far below all others: it is told in words.
    """
    chosen = [r for r in (*rows, *means(rows)) if r["group"] in HUES]
    scenes = ["mean", *(s for s in values(chosen, "scene") if s != "mean")]
    lines = math.ceil(len(scenes) / 2)
    words = "PSNR where no view looks, against seconds of a whole removal; area: Gaussians added"
    with figure(path, "Speed and accuracy of whole removals", words, 11, 3.6 * lines) as fig:
        axes = list(fig.subplots(lines, 2, squeeze=False).flat)
        for ax, scene in zip(axes, scenes):
            bubbles(ax, scene, where(chosen, scene=scene))
        for ax in axes[len(scenes) :]:
            ax.set_axis_off()


def bubbles(ax: Axes, scene: str, rows: Sequence[Row]) -> None:
    ax.set_xscale("log")
    ax.margins(0.1)  # bubbles are large
    ends, opened = [], ""
    for row in rows:
        if row["method"] == "hole open":
            opened = f" (hole open: {row['psnr unseen']:.1f} dB)"
            continue
        at, hue = (max(row["seconds"], 0.1), row["psnr unseen"]), HUES[row["group"]]
        ax.scatter(*at, s=max(20, 0.04 * row["added"]), color=hue, alpha=0.5)
        ends.append((*at, row["method"].lstrip("… "), hue))
    ticks = (0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50, 100, 200, 500)
    low, high = ax.get_xlim()
    shown = [t for t in ticks if low <= t <= high]
    ax.set_xticks(shown, [f"{t:g}" for t in shown])
    ax.minorticks_off()
    name_ends(ax, ends)
    ax.set(xlabel="seconds", ylabel="dB")
    ax.set_title(scene + opened, color=FAINT)


def draw_parsimony(average: Sequence[Row], path: Path) -> None:
    """Quality against the number of new Gaussians, and against the highest SH degree."""
    counts = sorted(where(average, group="counts"), key=lambda r: r["share"])
    degrees = [r | {"degree": k} for k, r in enumerate(where(average, group="degrees"))]
    panels = []
    for key, words, rows in (
        ("share", "new Gaussians per pixel of the hole", counts),
        ("degree", "highest SH degree", degrees),
    ):
        names = {"psnr mask": "hidden", "psnr unseen": "seen by no view"}
        lines = [Line(name, [(r[key], r[metric]) for r in rows]) for metric, name in names.items()]
        ticks = {t: f"{t:g}" for t in (0.1, 0.2, 0.5, 1)} if key == "share" else {}
        panels.append(Panel("", lines, words, "PSNR, dB", key == "share", False, ticks))
    words = "Closed form alone, not refined; means over the scenes"
    draw_panels(path, "How many Gaussians, and of which degree, a hole needs", words, [panels], (5.2, 3.6))


if __name__ == "__main__":
    told_in_one_line(main)
