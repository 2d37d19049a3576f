"""Measures nearest-neighbour fields of holes in photographs: how far they are from the exact ones, over time, beside
PatchMatch as published and from coarse to fine. (PyPatchMatch does not give its field away; benchmarks.fill has it.)

Writes OUT/nnf.json, OUT/nnf.md and a chart. Times are CPU ms of one thread, the best of several repetitions. The cost
is the mean over sampled pixels of the patches' RMS difference, over that of the exact nearest neighbours (brute force);
the excess is what is above 1. Run by `make bench-nnf`.
"""

from __future__ import annotations

import os

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_name] = "1"

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from gimp3d.compute.threads import set_thread_count
from gimp3d.solvers import patchmatch
from gimp3d.solvers.patches import lay_out
from gimp3d.solvers.patchmatch import PatchMatchSettings, nearest_neighbour_field, patch_centres

from .classic_patchmatch import RADIUS, classic, pyramid
from .command import ASSETS, parser_of, say, told_in_one_line, write_results
from .photographs import OTHERS_PYTHON, SHARE, blob, photographs
from .plots import Line, Panel, draw_panels
from .tables import Row, Section, markdown, mean, values, where
from .timing import about, machine, replaced, timed

QUERIES = 500
CHUNK = 65536  # source patches compared at once
OURS, CLASSIC, PYRAMID = "gimp3d", "classic PatchMatch", "pyramid PatchMatch"


def main() -> None:
    parser = parser_of(__doc__, "nnf", quick="two pictures of 512 px")
    parser.add_argument("--others", type=Path, default=OTHERS_PYTHON)
    given = parser.parse_args()
    set_thread_count(1)
    rows: list[Row] = []
    for large in (False,) if given.quick else (False, True):
        size, repetitions = "1080p" if large else "512", 1 if given.quick else 2 if large else 3
        pictures = photographs(given.others, given.out / "photographs", large)
        for name, picture in list(pictures.items())[: 2 if given.quick else None]:
            rows += [{"size": size, "picture": name, **row} for row in measured(picture, len(name), repetitions)]
            say(f"{size} {name} done")
    results = {"machine": machine(), "rows": rows, "summary": list(summary(rows))}
    words = markdown("Nearest-neighbour fields", f"One thread, {about(results['machine'])}", sections(results))
    write_results(given.out, "nnf", results, words)
    draw(results, (given.out if given.quick else ASSETS) / "nnf.svg")


def methods() -> dict[tuple[str, str], Callable[[np.ndarray, np.ndarray], np.ndarray]]:
    """(method, effort) → function from picture and hole to cost [H, W]."""

    def ours(picture: np.ndarray, hole: np.ndarray, grid: int, tree_sweeps: int, sweeps: int) -> np.ndarray:
        settings = PatchMatchSettings(coherence=0.0, sweeps=sweeps)
        with replaced(patchmatch, "GRID", grid), replaced(patchmatch, "TREE_SWEEPS", tree_sweeps):
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


def measured(picture: np.ndarray, seed: int, repetitions: int) -> Iterator[Row]:
    hole = blob(*picture.shape[:2], seed=seed)
    y, x, exact = exact_costs(picture, hole)
    last = ""
    for (method, effort), run in methods().items():
        if method != last:
            run(picture[:128, :128], blob(128, 128, 0))  # compile
        last, costs = method, []
        cpu = min(timed(lambda r=run, c=costs: c.append(r(picture, hole)))[1] for _ in range(repetitions))
        ratio = float(np.sqrt(costs[0][y, x]).mean() / np.sqrt(exact).mean())
        yield {"method": method, "effort": effort, "ms": cpu, "excess": ratio - 1}


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
        sources = patches(*offered[start : start + CHUNK].T) - middle
        distances = (sources**2).sum(1) - 2 * wanted @ sources.T
        best = distances.argmin(1)
        found = distances[np.arange(len(best)), best]
        nearest = np.where(found < least, start + best, nearest)
        least = np.minimum(least, found)
    differences = wanted - (patches(*offered[nearest].T) - middle)
    return rows, cols, (differences.astype(np.float64) ** 2).mean(1)


def curve(rows: Sequence[Row], size: str, method: str) -> list[tuple[float, float, str]]:
    """(ms, excess, effort), means over the pictures."""
    own = where(rows, size=size, method=method)
    efforts = [(where(own, effort=effort), effort) for effort in values(own, "effort")]
    return [(mean(of, "ms"), mean(of, "excess"), effort) for of, effort in efforts]


def summary(rows: Sequence[Row]) -> Iterator[Row]:
    """How many times lower the excess is at equal time, for every effort of ours within the others' range of times."""
    for size in values(rows, "size"):
        ratios = []
        for ms, excess, effort in curve(rows, size, OURS):
            row: Row = {"effort": effort, "ms": ms, "excess": excess}
            for other in (CLASSIC, PYRAMID):
                theirs = sorted(curve(rows, size, other))
                if ms <= theirs[-1][0]:  # in between, along the chart's straight lines; before their first point: that
                    times, excesses = np.log([t[:2] for t in theirs]).T
                    row[other] = float(np.exp(np.interp(np.log(ms), times, excesses))) / excess
            ratios.append(row)
        yield {"size": size, "ratios": ratios}


def sections(results: Row) -> Iterator[Section]:
    for found in results["summary"]:
        pictures, lines = values(where(results["rows"], size=found["size"]), "picture"), []
        for method in (OURS, CLASSIC, PYRAMID):
            for ms, excess, effort in curve(results["rows"], found["size"], method):
                ratios = next(iter(where(found["ratios"], effort=effort)), {}) if method == OURS else {}
                lower = [f"{ratios[o]:.1f}×" if o in ratios else "" for o in (CLASSIC, PYRAMID)]
                lines.append([method, effort, f"{ms:.0f}", f"{excess:.3f}", *lower])
        words = f"Patches of 5×5 pixels, holes of {SHARE:.0%}. Means over {', '.join(pictures)}."
        head = ["method", "effort", "ms", "excess", "lower than classic at equal time", "than pyramid"]
        yield Section(f"{found['size']}, {len(pictures)} photographs", words, head, lines)


def draw(results: Row, path: Path) -> None:
    panels = []
    for size in values(results["rows"], "size"):
        curves = {m: sorted(curve(results["rows"], size, m)) for m in (OURS, CLASSIC, PYRAMID)}
        lines = [Line(m, [point[:2] for point in points]) for m, points in curves.items()]
        low, high = (f(ms for points in curves.values() for ms, *_ in points) for f in (min, max))
        ticks = {t: f"{t:g}" for d in range(-1, 6) for t in (10.0**d, 3 * 10.0**d) if low <= t <= high}
        panels.append(Panel(size, lines, "CPU time, ms (log)", "excess cost (log)", x_ticks=ticks))
    words = f"photographs; one thread, {results['machine']['cpu']}. Excess: mean patch RMS difference over the exact "
    words += "nearest neighbours', less 1"
    draw_panels(path, "Nearest-neighbour fields", words, [panels], (5.2, 4.0))


if __name__ == "__main__":
    told_in_one_line(main)
