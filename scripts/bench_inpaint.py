"""Measures how the exemplar fill completes holes in photographs, beside PyPatchMatch, OpenCV's methods and a biharmonic
fill: PSNR, SSIM, FLIP and sharpness in the hole, and time.

Writes OUT/inpaint.json, OUT/inpaint.md, a chart and sheets of pictures. Times are CPU seconds of all threads, the best
of three repetitions of what takes less than 2 s. Methods that the interpreter `--others` lacks are left out, and it is
said so. Run by `make bench-inpaint`.

    python scripts/bench_inpaint.py [--others PYTHON] [--quick] [--out build/bench_inpaint] [--chart FILE.svg]
"""

from __future__ import annotations

import os

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_name] = "1"

import argparse
import json
import sys
import tempfile
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from bench_raster import HERE, ROOT, machine, say, write
from chart import FAINT, Axis, Series, drawn, frame, page, text
from photographs import REPETITIONS, SHARE, SLOW_S, blob, filled_by, photographs
from raster_report import table

from gimp3d.compute.threads import set_thread_count
from gimp3d.evaluate.metrics import score
from gimp3d.io.images import write_png
from gimp3d.priors.inpaint import inpaint_reference
from gimp3d.solvers.exemplar import complete_picture

OURS, RIVALS = "gimp3d exemplar", ("PyPatchMatch, radius 2", "PyPatchMatch, radius 3")
OPENCV = {"cv2 Telea": "telea", "cv2 NS": "ns", "xphoto SHIFTMAP": "shiftmap", "xphoto FSR fast": "fsr"}
OTHERS = {RIVALS[0]: "2", RIVALS[1]: "3", "biharmonic": "biharmonic"}
SCORED_MARGIN, SHEET_MARGIN = 64, 24  # px round the hole
LARGE = ("astronaut", "coffee", "motorcycle", "retina")  # some methods take a minute for each
CELL = (300, 220)  # px of a sheet's pictures
Row = dict[str, Any]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--others", type=Path, default=ROOT / "build" / "others" / "bin" / "python")
    parser.add_argument("--quick", action="store_true", help="two pictures of 512 px")
    parser.add_argument("--out", type=Path, default=ROOT / "build" / "bench_inpaint")
    parser.add_argument("--chart", type=Path)
    options = parser.parse_args()
    chart = options.chart or (options.out if options.quick else HERE.parent / "assets") / "inpaint.svg"
    set_thread_count(1)
    cv2.setNumThreads(1)
    rows: list[Row] = []
    missing: dict[str, str] = {}
    for large in (False,) if options.quick else (False, True):
        pictures = photographs(options.others, options.out / "photographs", large)
        if large:
            pictures = {name: pictures[name] for name in LARGE}
        if options.quick:
            pictures = dict(list(pictures.items())[:2])
        strips = []
        for name, picture in pictures.items():
            hole = blob(*picture.shape[:2], seed=len(name))
            fills = completed(options.others, picture, name, missing, hole)
            for method, (filled, seconds) in fills.items():
                found = {"size": "1080p" if large else "512", "picture": name, "method": method, "s": seconds}
                rows.append(found | scores(filled, picture, hole))
            strips.append(strip(picture, hole, {m: f for m, (f, _) in fills.items()}))
            say(f"{rows[-1]['size']} {name} done")
        write_png(options.out / f"sheet_{rows[-1]['size']}.png", np.vstack(strips))
    results = {"machine": machine(), "missing": missing, "rows": rows}
    write(options.out / "inpaint.json", json.dumps(results, indent=1))
    write(options.out / "inpaint.md", markdown(results))
    write(chart, draw(results))
    return 0


def completed(
    others: Path, picture: np.ndarray, name: str, missing: dict[str, str], hole: np.ndarray
) -> dict[str, tuple[np.ndarray, float]]:
    """Method → filled picture and CPU seconds."""
    holed = np.where(hole[..., None], np.uint8(0), picture)
    fills = {}
    runs = {OURS: lambda: complete_picture(holed, hole).image}
    runs |= {method: partial(opencv, spec, holed, hole) for method, spec in OPENCV.items()}
    small, spot = holed[:96, :96], np.pad(np.ones((20, 20), bool), 38)
    complete_picture(small, spot)  # compile
    for method, run in runs.items():
        times: list[float] = []
        while not times or (len(times) < REPETITIONS and times[0] < SLOW_S):
            start = time.process_time()
            filled = run()
            times.append(time.process_time() - start)
        fills[method] = filled, min(times)
    for method, argument in OTHERS.items():
        with tempfile.TemporaryDirectory() as folder:
            filled, found = filled_by(others, argument, holed, hole, Path(folder))
        if filled is None:
            missing[method] = found
        else:
            fills[method] = filled, found
    return {m: fills[m] for m in (OURS, *OTHERS, *OPENCV) if m in fills}


def opencv(spec: str, holed: np.ndarray, hole: np.ndarray) -> np.ndarray:
    return inpaint_reference(spec, holed, hole).image


def scores(filled: np.ndarray, truth: np.ndarray, hole: np.ndarray) -> Row:
    near = around(hole, SCORED_MARGIN)
    filled, truth, hole = filled[near], truth[near], hole[near]
    inner = cv2.erode(hole.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    return score(filled, truth, hole) | {"sharpness": slope(filled)[inner].mean() / slope(truth)[inner].mean()}


def slope(picture: np.ndarray) -> np.ndarray:
    """Size of the luminance's gradient."""
    grey = picture.astype(np.float32).mean(-1)
    return np.hypot(cv2.Sobel(grey, -1, 1, 0), cv2.Sobel(grey, -1, 0, 1)).astype(np.float64)


def around(hole: np.ndarray, margin: int) -> tuple[slice, slice]:
    rows, cols = np.nonzero(hole)
    return (
        slice(max(0, rows.min() - margin), rows.max() + 1 + margin),
        slice(max(0, cols.min() - margin), cols.max() + 1 + margin),
    )


def strip(truth: np.ndarray, hole: np.ndarray, fills: dict[str, np.ndarray]) -> np.ndarray:
    """The hole and what was made of it, side by side; the truth last."""
    near = around(hole, SHEET_MARGIN)
    shown = {"hole": np.where(hole[..., None], np.uint8((255, 0, 255)), truth), **fills, "truth": truth}
    cells = []
    for name, picture in shown.items():
        cell = cv2.resize(np.ascontiguousarray(picture[near]), CELL, interpolation=cv2.INTER_AREA)
        cv2.putText(cell, name, (5, 15), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (0, 0, 0), 3, cv2.LINE_AA)
        cv2.putText(cell, name, (5, 15), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (255, 255, 255), 1, cv2.LINE_AA)
        cells.append(cell)
    return np.hstack(cells)


def means(rows: Sequence[Row], size: str) -> dict[str, Row]:
    """Method → means over the pictures; time as the ratio to ours, picture by picture."""
    ours = {r["picture"]: r["s"] for r in rows if r["size"] == size and r["method"] == OURS}
    found = {}
    for method in dict.fromkeys(r["method"] for r in rows if r["size"] == size):
        chosen = [r for r in rows if (r["size"], r["method"]) == (size, method)]
        found[method] = {k: float(np.mean([r[k] for r in chosen])) for k in ("s", "psnr", "ssim", "flip", "sharpness")}
        found[method]["slower"] = float(np.exp(np.mean([np.log(r["s"] / ours[r["picture"]]) for r in chosen])))
    return found


def markdown(results: Row) -> str:
    host, rows = results["machine"], results["rows"]
    parts = [
        "# Filling holes in photographs\n",
        f"Holes of {SHARE:.0%}; CPU time of all threads, {host['cpu']}; load at the start {host['load_at_start'][0]}. "
        "Scores in the hole; sharpness: mean slope over the truth's.\n",
        *(f"Left out: {method} ({why}).\n" for method, why in results["missing"].items()),
    ]
    for size in dict.fromkeys(r["size"] for r in rows):
        pictures = dict.fromkeys(r["picture"] for r in rows if r["size"] == size)
        cells = [
            [
                method,
                f"{m['s']:.2f}",
                f"{m['slower']:.1f}×",
                f"{m['psnr']:.2f}",
                *(f"{m[k]:.3f}" for k in ("ssim", "flip")),
                f"{m['sharpness']:.2f}",
            ]
            for method, m in means(rows, size).items()
        ]
        parts += [f"## {size}, {len(pictures)} photographs\n", f"{', '.join(pictures)}.\n"]
        parts.append(table(["method", "CPU, s", "of ours", "PSNR", "SSIM", "FLIP", "sharpness"], cells))
    return "\n".join(parts)


def draw(results: Row) -> str:
    """PSNR over time, a panel for each size."""
    parts, top, height = [], 104, 300
    sizes = list(dict.fromkeys(r["size"] for r in results["rows"]))
    for k, size in enumerate(sizes):
        found, left = means(results["rows"], size), 80 + 600 * k
        times, values = [m["s"] for m in found.values()], [m["psnr"] for m in found.values()]
        x_axis = Axis(min(times) / 1.5, max(times) * 20, left, left + 480)
        y_axis = Axis(min(values) - 0.3, max(values) + 0.3, top + height, top, logarithmic=False)
        x_ticks = {10.0**d: f"{10.0**d:g}" for d in range(-3, 4) if x_axis.low < 10.0**d < x_axis.high}
        y_ticks = {float(v): f"{v}" for v in range(int(y_axis.low) + 1, int(y_axis.high) + 1)}
        parts += frame(size, x_axis, y_axis, x_ticks, y_ticks, "CPU time, s (log)", "PSNR in the hole, dB")
        lowest = y_axis.start + 100
        for method, m in sorted(found.items(), key=lambda item: item[1]["psnr"]):
            colour = "#1b7f5f" if method == OURS else "#c65102" if method in RIVALS else FAINT
            parts += drawn(Series(method, method, [(m["s"], m["psnr"])], "dot"), x_axis, y_axis, colour)
            lowest = min(y_axis.place(m["psnr"]) + 4, lowest - 15)  # names do not cover each other
            words = f"{method} ({m['sharpness']:.2f})"
            parts.append(text(x_axis.place(m["s"]) + 8, lowest, words, colour=colour, size=12))
    parts.append(text(80, 482, "In brackets: sharpness, mean slope over the truth's; 1 is right.", colour=FAINT))
    host = results["machine"]
    return page(80 + 600 * len(sizes), 500, "Filling holes of 8 % in photographs", host["cpu"], parts)


if __name__ == "__main__":
    sys.exit(main())
