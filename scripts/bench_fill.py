"""How good the built-in fill is: whole removals beside the true picture given, and pictures with structure beside
other programs' fills.

    python scripts/bench_fill.py [DATA] [--scenes a,b] [--only pictures|removals] [--reuse] [--out build/bench_fill]

Writes OUT/table.md, OUT/results.json, OUT/sheet.png (the pictures) and a sheet per removal. Scenes with a shadow are
run with the true shadow marked. Scores of pictures are in the hole; edge: mean distance of edges there to the truth's,
both ways; sharpness: mean slope over the truth's; CPU seconds of all threads. Run by `make bench-fill`.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from bench_inpaint import OURS, completed, scores, strip
from bench_raster import ROOT, machine, say, write
from bench_real import Run, compile_kernels, folder_of, measured, sheets
from raster_report import table
from real_scenes import read_scene
from structured import edge_error, structured

from gimp3d.errors import BadInput
from gimp3d.io.images import write_png

SCENES = ("desk", "corner", "gloss", "rocks", "real_table", "real_bed", "kitchen_monkey", "tiles_mug")
GOALS = {"psnr mask": 2.5, "psnr unseen": 4.0}  # dB that the built-in fill may lose to the true picture, in the mean
Row = dict[str, Any]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("data", nargs="?", type=Path, default=ROOT.parent / "shared" / "data" / "withwithout")
    parser.add_argument("--scenes", default=",".join(SCENES), help="folders of DATA, or of real/ beside it")
    parser.add_argument("--only", choices=("pictures", "removals"))
    parser.add_argument("--others", type=Path, default=ROOT / "build" / "others" / "bin" / "python")
    parser.add_argument("--reuse", action="store_true", help="score removals that lie in OUT instead of running them")
    parser.add_argument("--out", type=Path, default=ROOT / "build" / "bench_fill")
    given = parser.parse_args()
    results: dict[str, Any] = {"machine": machine(), "pictures": [], "missing": {}, "removals": []}
    try:
        if given.only != "removals":
            pictures(given.others, given.out, results)
        if given.only != "pictures":
            removals(given.data, given.scenes.split(","), given.out, given.reuse, results)
    except BadInput as error:
        print(f"bench_fill: error: {error}", file=sys.stderr)
        return error.exit_code
    write(given.out / "results.json", json.dumps(results, indent=1))
    write(given.out / "table.md", markdown(results))
    say("\n" + markdown(results))
    return 0


def pictures(others: Path, out: Path, results: dict[str, Any]) -> None:
    strips = []
    for name, (truth, hole) in structured().items():
        fills = completed(others, truth, name, results["missing"], hole)
        for method, (filled, seconds) in fills.items():
            edge = edge_error(filled, truth, hole)
            results["pictures"].append(
                {"picture": name, "method": method, "s": seconds, "edge": edge, **scores(filled, truth, hole)}
            )
        strips.append(strip(truth, hole, {m: f for m, (f, _) in fills.items()}))
        say(f"{name} done")
    write_png(out / "sheet.png", np.vstack(strips))


def removals(data: Path, names: Sequence[str], out: Path, reuse: bool, results: dict[str, Any]) -> None:
    scenes = [read_scene(folder_of(data, name)) for name in names]
    if not reuse:
        compile_kernels(scenes[0], out)
    for scene in scenes:
        row: Row = {"scene": scene.name}
        for true_picture in (True, False):
            run = Run("balanced", true_picture, scene.has_shadow)
            row[run.kind] = measured(scene, run, out / scene.name / run.name, reuse)
            if "refused" not in row[run.kind]:
                for name, picture in sheets(scene, out / scene.name / run.name / "render").items():
                    write_png(out / f"{scene.name}_{run.name}{name}.png", picture)
        results["removals"].append(row)
        say(f"{scene.name} done")


def markdown(results: dict[str, Any]) -> str:
    host = results["machine"]
    parts = ["# The fill\n", f"{host['cpu']}; load at the start {host['load_at_start'][0]}.\n"]
    if results["removals"]:
        parts += ["## Whole removals, balanced: the true picture given, and the built-in fill\n", *of_removals(results)]
    if results["pictures"]:
        parts += ["## Pictures with structure\n", *of_pictures(results)]
    return "\n".join(parts)


def of_removals(results: dict[str, Any]) -> list[str]:
    rows, lost = [], {key: [] for key in GOALS}
    for row in results["removals"]:
        runs = row["given"], row["built-in"]
        if refused := [run["refused"] for run in runs if "refused" in run]:
            rows.append([row["scene"], refused[0], "", "", ""])
            continue
        cells = [row["scene"]]
        for key, by_scene in lost.items():
            if all(key in run for run in runs):
                by_scene.append(runs[0][key] - runs[1][key])
                cells += [f"{runs[0][key]:.1f} → {runs[1][key]:.1f}"]
            else:
                cells += ["–"]
        rows.append([*cells, *(f"{run['seconds']:.1f}" for run in runs)])
    head = ["scene", "mask dB: given → built-in", "never seen dB", "given, s", "built-in, s"]
    found = [
        f"{key}: {np.mean(values):.1f} dB less in the mean (goal: at most {GOALS[key]})"
        for key, values in lost.items()
        if values
    ]
    return [table(head, rows), *(f"{words}\n" for words in found)]


def of_pictures(results: dict[str, Any]) -> list[str]:
    rows = results["pictures"]
    methods = list(dict.fromkeys(r["method"] for r in rows))
    means = []
    for method in methods:
        own = [r for r in rows if r["method"] == method]
        cells = [float(np.nanmean([r[key] for r in own])) for key in ("psnr", "edge", "sharpness", "s")]
        means.append([method, *(f"{value:.2f}" for value in cells)])
    ours = [
        [r["picture"], f"{r['psnr']:.1f}", f"{r['edge']:.2f}", f"{r['sharpness']:.2f}", f"{r['s']:.2f}"]
        for r in rows
        if r["method"] == OURS
    ]
    left_out = [f"Left out: {method} ({why}).\n" for method, why in results["missing"].items()]
    head = ["PSNR", "edge, px", "sharpness", "CPU, s"]
    return [*left_out, table(["method, mean", *head], means), table([f"{OURS}", *head], ours)]


if __name__ == "__main__":
    sys.exit(main())
