"""How good the built-in fill is: holes in photographs and in pictures with structure, beside other programs' fills.

Writes OUT/fill.md, OUT/fill.json, a chart and sheets of pictures. Scores are in the hole; edge: mean distance of edges
there to the truth's, both ways; sharpness: mean slope over the truth's; CPU seconds of one thread, the best of three
repetitions of what takes less than 2 s. Methods that the interpreter --others lacks are left out, and it is said so.
With --without, a rule of benchmarks.ablation is switched off. Run by `make bench-inpaint` (photographs) and `make
bench-fill` (structure; and whole removals, by benchmarks.real).
"""

from __future__ import annotations

import os

for _name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_name] = "1"

import tempfile
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from structured import edge_error, structured

from gimp3d.compute.threads import set_thread_count
from gimp3d.evaluate import score
from gimp3d.geometry import bounds
from gimp3d.io.images import write_png
from gimp3d.priors.inpaint import inpaint_reference
from gimp3d.solvers.exemplar import complete_picture

from .ablation import RULES, switched_off
from .command import ASSETS, parser_of, say, told_in_one_line, write_results
from .photographs import OTHERS_PYTHON, REPETITIONS, SHARE, SLOW_S, blob, filled_by, photographs
from .plots import COLOURS, FAINT, figure, name_ends
from .tables import Row, Section, columns, markdown, mean, sheet, values, where
from .timing import about, machine

OURS, RIVALS = "gimp3d exemplar", ("PyPatchMatch, radius 2", "PyPatchMatch, radius 3")
OPENCV = {"cv2 Telea": "telea", "cv2 NS": "ns", "xphoto SHIFTMAP": "shiftmap", "xphoto FSR fast": "fsr"}
OTHERS = {RIVALS[0]: "2", RIVALS[1]: "3", "biharmonic": "biharmonic"}
LARGE = ("astronaut", "coffee", "motorcycle", "retina")  # some methods take a minute for each
SCORED_MARGIN, SHEET_MARGIN = 64, 24  # px round the hole
CELL = (300, 220)  # px of a sheet's pictures
PARTS = ("photographs", "pictures")
Pictures = dict[str, tuple[np.ndarray, np.ndarray]]  # name → picture, hole


def main() -> None:
    parser = parser_of(__doc__, "fill", quick="two photographs of 512 px")
    parser.add_argument("--only", nargs="*", choices=PARTS, default=PARTS)
    parser.add_argument("--others", type=Path, default=OTHERS_PYTHON)
    parser.add_argument("--without", choices=RULES, metavar="RULE", help="as named in benchmarks.ablation")
    given = parser.parse_args()
    parts = ["photographs"] if given.quick else given.only
    results: Row = {"machine": machine(), "pictures": [], "missing": {}}
    with switched_off(RULES[given.without] if given.without else ()):
        set_thread_count(1)
        cv2.setNumThreads(1)
        if "photographs" in parts:
            for large in (False,) if given.quick else (False, True):
                fill_all("1080p" if large else "512", photographs_with_holes(given, large), given, results)
        if "pictures" in parts:
            fill_all("structure", structured(), given, results)
    write_results(given.out, "fill", results, markdown("The fill", about(results["machine"]), sections(results)))
    if "photographs" in parts:
        draw(results, (given.out if given.quick or given.without else ASSETS) / "inpaint.svg")


def photographs_with_holes(given: Any, large: bool) -> Pictures:
    found = photographs(given.others, given.out / "photographs", large)
    names = LARGE if large else list(found)[: 2 if given.quick else None]
    return {n: (found[n], blob(*found[n].shape[:2], seed=len(n))) for n in names}


def fill_all(size: str, pictures: Pictures, given: Any, results: Row) -> None:
    """Every method on every picture: rows of scores, and a sheet of what they made."""
    strips = []
    for name, (picture, hole) in pictures.items():
        fills = completed(given.others, picture, hole, results["missing"])
        for method, (filled, seconds) in fills.items():
            row = {"size": size, "picture": name, "method": method, "s": seconds, **scores(filled, picture, hole)}
            results["pictures"].append(row)
        strips.append(strip(picture, hole, {m: f for m, (f, _) in fills.items()}))
        say(f"{size} {name} done")
    write_png(given.out / f"sheet_{size}.png", sheet(strips))


def completed(
    others: Path, picture: np.ndarray, hole: np.ndarray, missing: dict[str, str]
) -> dict[str, tuple[np.ndarray, float]]:
    """Method → filled picture and CPU seconds."""
    holed = np.where(hole[..., None], np.uint8(0), picture)
    fills = {}
    runs: dict[str, Any] = {OURS: lambda: complete_picture(holed, hole)[0]}
    runs |= {m: lambda s=spec: inpaint_reference(s, holed, hole).image for m, spec in OPENCV.items()}
    complete_picture(holed[:96, :96], np.pad(np.ones((20, 20), bool), 38))  # compile
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


def scores(filled: np.ndarray, truth: np.ndarray, hole: np.ndarray) -> Row:
    near = bounds(hole, SCORED_MARGIN)
    filled, truth, hole = filled[near], truth[near], hole[near]
    inner = cv2.erode(hole.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    sharpness = slope(filled)[inner].mean() / slope(truth)[inner].mean()
    return score(filled, truth, hole) | {"sharpness": sharpness, "edge": edge_error(filled, truth, hole)}


def slope(picture: np.ndarray) -> np.ndarray:
    """Size of the luminance's gradient."""
    grey = picture.astype(np.float32).mean(-1)
    return np.hypot(cv2.Sobel(grey, -1, 1, 0), cv2.Sobel(grey, -1, 0, 1)).astype(np.float64)


def strip(truth: np.ndarray, hole: np.ndarray, fills: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """A row of a sheet: the hole, what was made of it, and the truth."""
    near = bounds(hole, SHEET_MARGIN)
    shown = {"hole": np.where(hole[..., None], np.uint8((255, 0, 255)), truth), **fills, "truth": truth}
    return {n: cv2.resize(p[near], CELL, interpolation=cv2.INTER_AREA) for n, p in shown.items()}


# -------------------------------------------------------------------------------------------------- what is written


def means(results: Row, size: str) -> dict[str, Row]:
    """Method → means over the pictures; time as the ratio to ours, picture by picture."""
    rows = where(results["pictures"], size=size)
    ours = {r["picture"]: r["s"] for r in where(rows, method=OURS)}
    found = {}
    for method in values(rows, "method"):
        own = where(rows, method=method)
        found[method] = {k: mean(own, k) for k in ("s", "psnr", "ssim", "flip", "sharpness")}
        found[method]["edge"] = float(np.nanmean([r["edge"] for r in own]))
        found[method]["slower"] = float(np.exp(np.mean([np.log(r["s"] / ours[r["picture"]]) for r in own])))
    return found


OF_METHODS = {"method": "{method}", "CPU, s": "{s:.2f}", "of ours": "{slower:.1f}×", "PSNR": "{psnr:.2f}"}
OF_METHODS |= {"SSIM": "{ssim:.3f}", "FLIP": "{flip:.3f}", "sharpness": "{sharpness:.2f}"}
OF_METHODS |= {"edges off, px": "{edge:.2f}"}
OF_PICTURES = {"picture": "{picture}", "PSNR": "{psnr:.2f}", "edges off, px": "{edge:.2f}"}
OF_PICTURES |= {"sharpness": "{sharpness:.2f}", "CPU, s": "{s:.2f}"}


def sections(results: Row) -> Iterator[Section]:
    left_out = " ".join(f"Left out: {method} ({why})." for method, why in results["missing"].items())
    for size in values(results["pictures"], "size"):
        rows = where(results["pictures"], size=size)
        names = values(rows, "picture")
        words = f"{', '.join(names)}. Means; photographs' holes are {SHARE:.0%}. "
        words += f"Sharpness: mean slope over the truth's. {left_out}"
        of_methods = ({"method": method, **m} for method, m in means(results, size).items())
        yield Section(f"{size}, {len(names)} pictures", words, *columns(of_methods, OF_METHODS))
        yield Section(f"{size}, {OURS}", "", *columns(where(rows, method=OURS), OF_PICTURES))


def draw(results: Row, path: Path) -> None:
    """PSNR over time, a panel for each size; in brackets sharpness."""
    sizes = [s for s in values(results["pictures"], "size") if s != "structure"]
    words = f"{results['machine']['cpu']}. In brackets: sharpness, mean slope over the truth's; 1 is right"
    with figure(path, f"Filling holes of {SHARE:.0%} in photographs", words, 6.2 * len(sizes), 4.2) as fig:
        for ax, size in zip(fig.subplots(1, len(sizes), squeeze=False).flat, sizes):
            found, names = means(results, size), []
            ax.set_xscale("log")
            for method, m in found.items():
                colour = COLOURS[0] if method == OURS else COLOURS[1] if method in RIVALS else FAINT
                ax.plot(m["s"], m["psnr"], "o", color=colour)
                names.append((m["s"], m["psnr"], f"{method} ({m['sharpness']:.2f})", colour))
            name_ends(ax, names)
            ax.set(title=size, xlabel="CPU time, s (log)", ylabel="PSNR in the hole, dB")


if __name__ == "__main__":
    told_in_one_line(main)
