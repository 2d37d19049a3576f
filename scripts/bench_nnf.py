"""Measures nearest-neighbour fields of holes in photographs: how far they are from the exact ones, over time, beside
PatchMatch as published and from coarse to fine. (PyPatchMatch does not give its field away; bench_inpaint has it.)

Writes OUT/nnf.json, OUT/nnf.md and a chart. Times are CPU ms of one thread, the best of several repetitions. The cost
is the mean over sampled pixels of the patches' RMS difference, over that of the exact nearest neighbours (brute force);
the excess is what is above 1. Run by `make bench-nnf`.

    python scripts/bench_nnf.py [--others PYTHON] [--quick] [--out build/bench_nnf] [--chart FILE.svg]
"""

from __future__ import annotations

import os

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_name] = "1"

import argparse
import json
import sys
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
from bench_raster import HERE, ROOT, machine, say, write
from chart import FAINT, Axis, Series, drawn, end_labels, frame, group_colours, page, text
from classic_patchmatch import RADIUS, classic, pyramid
from photographs import SHARE, blob, photographs
from raster_report import table

from gimp3d.compute.threads import set_thread_count
from gimp3d.solvers import patchmatch
from gimp3d.solvers.patches import lay_out
from gimp3d.solvers.patchmatch import PatchMatchSettings, nearest_neighbour_field, patch_centres

QUERIES = 500
CHUNK = 65536  # source patches compared at once
OURS, CLASSIC, PYRAMID = "gimp3d", "classic PatchMatch", "pyramid PatchMatch"
TARGET = 2.5
Row = dict[str, Any]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--others", type=Path, default=ROOT / "build" / "others" / "bin" / "python")
    parser.add_argument("--quick", action="store_true", help="two pictures of 512 px")
    parser.add_argument("--out", type=Path, default=ROOT / "build" / "bench_nnf")
    parser.add_argument("--chart", type=Path)
    options = parser.parse_args()
    chart = options.chart or (options.out if options.quick else HERE.parent / "assets") / "nnf.svg"
    set_thread_count(1)
    rows: list[Row] = []
    for large in (False,) if options.quick else (False, True):
        pictures = photographs(options.others, options.out / "photographs", large)
        if options.quick:
            pictures = dict(list(pictures.items())[:2])
        for name, picture in pictures.items():
            rows += list(
                measured("1080p" if large else "512", name, picture, 1 if options.quick else 2 if large else 3)
            )
            say(f"{rows[-1]['size']} {name} done")
    results = {"machine": machine(), "rows": rows}
    results["summary"] = [summary(rows, size) for size in dict.fromkeys(r["size"] for r in rows)]
    write(options.out / "nnf.json", json.dumps(results, indent=1))
    write(options.out / "nnf.md", markdown(results))
    write(chart, draw(results))
    return 0


def methods() -> dict[tuple[str, str], Callable[[np.ndarray, np.ndarray], np.ndarray]]:
    """(method, effort) → function from picture and hole to cost [H, W]."""

    def ours(picture: np.ndarray, hole: np.ndarray, grid: int, tree_sweeps: int, sweeps: int) -> np.ndarray:
        settings = PatchMatchSettings(coherence=0.0, sweeps=sweeps)
        with mock.patch.multiple(patchmatch, GRID=grid, TREE_SWEEPS=tree_sweeps):
            return nearest_neighbour_field(picture, hole, ~hole, None, settings).cost

    found: dict[tuple[str, str], Callable[[np.ndarray, np.ndarray], np.ndarray]] = {}
    for grid, tree_sweeps, sweeps in ((4, 1, 1), (3, 1, 2), (2, 1, 2), (2, 2, 4), (1, 2, 4)):
        effort = f"grid {grid}, {sweeps} sweeps, {tree_sweeps} with the tree"
        found[OURS, effort] = partial(ours, grid=grid, tree_sweeps=tree_sweeps, sweeps=sweeps)
    for sweeps in (1, 2, 3, 5, 8, 12, 20):
        found[CLASSIC, f"{sweeps} sweeps"] = lambda p, h, n=sweeps: classic(p, h, n)[2]
    for sweeps, reach in ((1, 8), (2, 8), (3, 16), (4, 32), (8, 64)):
        found[PYRAMID, f"{sweeps} sweeps, reach {reach}"] = lambda p, h, n=sweeps, r=reach: pyramid(p, h, n, r)[2]
    return found


def measured(size: str, name: str, picture: np.ndarray, repetitions: int) -> Sequence[Row]:
    hole = blob(*picture.shape[:2], seed=len(name))
    y, x, exact = exact_costs(picture, hole)
    rows = []
    for (method, effort), run in methods().items():
        if not rows or rows[-1]["method"] != method:
            run(picture[:128, :128], blob(128, 128, 0))  # compile
        times = []
        for _ in range(repetitions):
            start = time.process_time()
            cost = run(picture, hole)
            times.append(1e3 * (time.process_time() - start))
        ratio = float(np.sqrt(cost[y, x]).mean() / np.sqrt(exact).mean())
        rows.append(
            {"size": size, "picture": name, "method": method, "effort": effort, "ms": min(times), "excess": ratio - 1}
        )
    return rows


def exact_costs(picture: np.ndarray, hole: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(rows, cols) of sampled hole pixels, and the least mean squared difference of any source patch."""
    layout = lay_out(picture.astype(np.float32) / 255, RADIUS)
    side = 2 * RADIUS + 1
    within = (np.arange(side)[:, None] * layout.stride + np.arange(3 * side)).ravel()

    def patches(rows: np.ndarray, cols: np.ndarray) -> np.ndarray:
        return layout.values[layout.starts(rows, cols)[:, None] + within]

    rows, cols = np.nonzero(hole)
    chosen = np.random.default_rng(0).choice(len(rows), min(QUERIES, len(rows)), replace=False)
    rows, cols = rows[chosen], cols[chosen]
    wanted = patches(rows, cols)
    middle = wanted.mean(0)
    wanted = wanted - middle  # the expanded square loses fewer digits round 0
    least, nearest = np.full(len(rows), np.inf), np.zeros(len(rows), np.int64)
    offered = np.argwhere(patch_centres(~hole, RADIUS))
    for start in range(0, len(offered), CHUNK):
        values = patches(*offered[start : start + CHUNK].T) - middle
        distances = (values**2).sum(1) - 2 * wanted @ values.T
        best = distances.argmin(1)
        found = distances[np.arange(len(best)), best]
        nearest = np.where(found < least, start + best, nearest)
        least = np.minimum(least, found)
    differences = wanted - (patches(*offered[nearest].T) - middle)
    return rows, cols, (differences.astype(np.float64) ** 2).mean(1)


def curve(rows: Sequence[Row], size: str, method: str) -> list[tuple[float, float, str]]:
    """(ms, excess, effort), means over the pictures."""
    efforts = dict.fromkeys(r["effort"] for r in rows if r["method"] == method)
    chosen = [[r for r in rows if (r["size"], r["method"], r["effort"]) == (size, method, e)] for e in efforts]
    return [
        (float(np.mean([r["ms"] for r in c])), float(np.mean([r["excess"] for r in c])), e)
        for c, e in zip(chosen, efforts)
    ]


def summary(rows: Sequence[Row], size: str) -> Row:
    """How many times lower the excess is at equal time, for every effort of ours within the others' range of times."""
    found: Row = {"size": size, "ratios": []}
    for ms, excess, effort in curve(rows, size, OURS):
        row: Row = {"effort": effort, "ms": ms, "excess": excess}
        for other in (CLASSIC, PYRAMID):
            theirs = sorted(curve(rows, size, other))
            if ms <= theirs[-1][0]:  # in between, along the chart's straight lines; before their first point: that
                value = np.exp(np.interp(np.log(ms), np.log([t[0] for t in theirs]), np.log([t[1] for t in theirs])))
                row[other] = float(value) / excess
        found["ratios"].append(row)
    return found


def markdown(results: Row) -> str:
    host = results["machine"]
    parts = [
        "# Nearest-neighbour fields\n",
        f"Patches of 5×5 pixels, holes of {SHARE:.0%}; one thread, {host['cpu']}; load at the start "
        f"{host['load_at_start'][0]}. Means over the pictures.\n",
    ]
    for found in results["summary"]:
        size = found["size"]
        pictures = dict.fromkeys(r["picture"] for r in results["rows"] if r["size"] == size)
        parts += [f"## {size}, {len(pictures)} photographs\n", f"{', '.join(pictures)}.\n"]
        cells = []
        for method in (OURS, CLASSIC, PYRAMID):
            for ms, excess, effort in curve(results["rows"], size, method):
                ratios = next((r for r in found["ratios"] if r["effort"] == effort and method == OURS), {})
                lower = [f"{ratios[o]:.1f}×" if o in ratios else "" for o in (CLASSIC, PYRAMID)]
                cells.append([method, effort, f"{ms:.0f}", f"{excess:.3f}", *lower])
        head = ["method", "effort", "ms", "excess", "lower than classic at equal time", "than pyramid"]
        parts.append(table(head, cells))
    return "\n".join(parts)


def draw(results: Row) -> str:
    parts, top, height = [], 104, 300
    for k, found in enumerate(results["summary"]):
        size, left = found["size"], 90 + 590 * k
        series = [
            Series(m, m, [(ms, excess) for ms, excess, _ in sorted(curve(results["rows"], size, m))])
            for m in (OURS, CLASSIC, PYRAMID)
        ]
        times = [x for s in series for x, _ in s.points]
        values = [y for s in series for _, y in s.points]
        x_axis = Axis(min(times) / 1.2, max(times) * 1.2, left, left + 340)
        y_axis = Axis(min(values) / 1.2, max(values) * 1.2, top + height, top)
        ticks = [n * 10.0**d for d in range(-3, 5) for n in (1, 2, 5)]
        x_ticks = {t: f"{t:g}" for t in ticks if x_axis.low < t < x_axis.high}
        y_ticks = {t: f"{t:g}" for t in ticks if y_axis.low < t < y_axis.high}
        parts += frame(size, x_axis, y_axis, x_ticks, y_ticks, "CPU time, ms (log)", "excess cost (log)")
        for s in series:
            parts += drawn(s, x_axis, y_axis, group_colours(series)[s.group])
        parts += end_labels(series, x_axis, y_axis, group_colours(series))
    host = results["machine"]
    parts.append(
        text(90, 482, "Excess: mean patch RMS difference over the exact nearest neighbours', less 1.", colour=FAINT)
    )
    width = 40 + 590 * len(results["summary"])
    return page(max(width, 640), 500, "Nearest-neighbour fields", f"photographs; one thread, {host['cpu']}", parts)


if __name__ == "__main__":
    sys.exit(main())
