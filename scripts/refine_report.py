"""Tables and charts of bench_refine: quality against time, number of new Gaussians and SH degree."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from chart import COLOURS, FAINT, Axis, Series, drawn, frame, page, text

Row = dict[str, Any]
METRICS = ("psnr mask", "ssim mask", "flip mask", "psnr unseen", "ssim unseen", "flip unseen", "agreement")
# What the paper prints and cannot be run.
UNDEFINED = {
    "printed order of levels": "level 0 comes first and starts from the field of level 1, which nothing has made yet; "
    "with one level, which is what the paper's presets run, the order says nothing"
}
BETWEEN = 120  # px between panels, for the bubbles' names
INSTANT = 0.1  # s that the axis of seconds begins at
HUES = {"presets": COLOURS[0], "paper": COLOURS[1], "ablations": COLOURS[2], "baselines": COLOURS[3]}


def write_report(rows: Sequence[Row], out: Path, assets: Path) -> None:
    """`refine.md` in `out`; pareto.svg and parsimony.svg in `assets`."""
    (out / "refine.md").write_text(tables(rows))
    everything = [*rows, *means(rows)]
    (assets / "pareto.svg").write_text(pareto(everything))
    if {"counts", "degrees"} <= {r["group"] for r in rows}:
        (assets / "parsimony.svg").write_text(parsimony(means(rows)))


def means(rows: Sequence[Row]) -> list[Row]:
    """One row per method: means over the scenes."""
    found = []
    for group, method in dict.fromkeys((r["group"], r["method"]) for r in rows):
        of = [r for r in rows if (r["group"], r["method"]) == (group, method)]
        numbers = {
            k: float(np.mean([r[k] for r in of]))
            for k in (*METRICS, "added", "seconds", "cpu seconds", "share")
            if k in of[0]
        }
        stages = {s: float(np.mean([_stage(r, s) for r in of])) for s in STAGES}
        found.append({"scene": "mean", "method": method, "group": group, "stages": stages} | numbers)
    return found


STAGES = ("masks", "reference", "depth", "appearance", "mapping", "propagate", "seed", "refine")


def _stage(row: Row, stage: str) -> float:
    """Seconds of a stage, all references together."""
    return sum(seconds for name, seconds in row["stages"].items() if name.split(" ")[0] == stage)


def tables(rows: Sequence[Row]) -> str:
    average = means(rows)
    parts = ["# New Gaussians: quality, time, number", ""]
    for group in dict.fromkeys(r["group"] for r in rows):
        parts += [
            f"## {group}",
            "",
            "| scene | method | " + " | ".join(METRICS) + " | added | per px of T | s | CPU s |",
        ]
        parts.append("|---|---|" + "---:|" * (len(METRICS) + 4))
        for row in [*rows, *average]:
            if row["group"] == group:
                numbers = [
                    f"{row[k]:.3f}" if k[:4] in ("ssim", "flip") else f"{row.get(k, math.nan):.2f}" for k in METRICS
                ]
                ends = [
                    f"{row['added']:.0f}",
                    f"{row['share']:.2f}",
                    f"{row['seconds']:.1f}",
                    f"{row['cpu seconds']:.1f}",
                ]
                parts.append(f"| {row['scene']} | {row['method']} | " + " | ".join([*numbers, *ends]) + " |")
        if group == "paper":
            parts += [f"| all | {method} | no result: {why} |" for method, why in UNDEFINED.items()]
        parts.append("")
    parts += ["## Seconds per stage, means", "", "| method | " + " | ".join(STAGES) + " |"]
    parts.append("|---|" + "---:|" * len(STAGES))
    for row in average:
        if row["group"] in ("paper", "presets"):
            parts.append(f"| {row['method']} | " + " | ".join(f"{row['stages'][s]:.2f}" for s in STAGES) + " |")
    return "\n".join(parts) + "\n"


def pareto(rows: Sequence[Row]) -> str:
    """Quality against seconds: one bubble per preset, ablation and baseline; its area is the Gaussians added.

    The open hole takes no time and lies far below all others: it is told in words.
    """
    chosen = [r for r in rows if r["group"] in HUES and r["method"] != "hole open"]
    opened = {r["scene"]: r["psnr unseen"] for r in rows if r["method"] == "hole open"}
    scenes = list(dict.fromkeys(r["scene"] for r in chosen))
    wide, high = 470, 330
    columns = 2
    parts = []
    for k, scene in enumerate([*scenes[-1:], *scenes[:-1]]):
        left, top = 80 + k % columns * (wide + BETWEEN), 120 + k // columns * (high + 90)
        parts += _bubbles(scene, [r for r in chosen if r["scene"] == scene], left, top, wide - 110, high - 60)
        if scene in opened:
            words = f"hole open: {opened[scene]:.1f} dB"
            parts.append(text(left + wide - 110, top - 12, words, anchor="end", colour=FAINT, size=11))
    lines = math.ceil(len(scenes) / columns)
    height = 110 + lines * (high + 90)
    subtitle = "PSNR where no view looks, against seconds of a whole removal; area: Gaussians added"
    return page(columns * (wide + BETWEEN) + 20, height, "Speed and accuracy of whole removals", subtitle, parts)


def _bubbles(scene: str, rows: Sequence[Row], left: float, top: float, wide: float, high: float) -> list[str]:
    timed = [max(r["seconds"], INSTANT) for r in rows]
    quality = [r["psnr unseen"] for r in rows]
    x = Axis(min(timed) * 0.8, max(timed) * 1.5, left, left + wide)
    low, top_value = math.floor(min(quality)) - 1, math.ceil(max(quality)) + 1
    y = Axis(low, top_value, top + high, top, logarithmic=False)
    ticks = {t: f"{t:g}" for t in (0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50, 100, 200, 500) if x.low <= t <= x.high}
    step = max(1, math.ceil((top_value - low) / 6))
    parts = frame(scene, x, y, ticks, {v: str(v) for v in range(low, top_value + 1, step)}, "seconds", "dB")
    lowest = -math.inf
    for row in sorted(rows, key=lambda r: -r["psnr unseen"]):
        hue = HUES[row["group"]]
        px, py = x.place(max(row["seconds"], INSTANT)), y.place(row["psnr unseen"])
        radius = max(2.5, 0.14 * math.sqrt(row["added"]))
        parts.append(
            f'<circle cx="{px:.1f}" cy="{py:.1f}" r="{radius:.1f}" fill="{hue}" fill-opacity="0.45" stroke="{hue}"/>'
        )
        lowest = max(py + 4, lowest + 13)
        parts.append(
            f'<path d="M{px:.1f} {py:.1f}L{left + wide + 8:.1f} {lowest - 4:.1f}" stroke="{hue}" stroke-opacity="0.3"/>'
        )
        parts.append(text(left + wide + 10, lowest, row["method"].lstrip("… "), colour=hue, size=11))
    return parts


def parsimony(average: Sequence[Row]) -> str:
    """Quality against the number of new Gaussians, and against the highest SH degree."""
    counts = sorted((r for r in average if r["group"] == "counts"), key=lambda r: r["share"])
    degrees = [r for r in average if r["group"] == "degrees"]
    parts = []
    panels = (
        ("New Gaussians per pixel of the hole", [r["share"] for r in counts], counts, True),
        ("Highest SH degree", list(range(len(degrees))), degrees, False),
    )
    for k, (label, across, rows, logarithmic) in enumerate(panels):
        left = 90 + 520 * k
        values = [r[m] for r in (*counts, *degrees) for m in ("psnr mask", "psnr unseen")]
        low, high = math.floor(min(values)), math.ceil(max(values))
        y = Axis(low, high, 380, 110, logarithmic=False)
        x = Axis(
            min(across) * 0.9 - (0 if logarithmic else 0.2), max(across) * 1.1 + 0.01, left, left + 330, logarithmic
        )
        ticks = {t: f"{t:g}" for t in ((0.1, 0.2, 0.5, 1) if logarithmic else across) if x.low <= t <= x.high}
        parts += frame("", x, y, ticks, {v: str(v) for v in range(low, high + 1)}, label, "PSNR, dB")
        for hue, metric, words in ((COLOURS[0], "psnr mask", "hidden"), (COLOURS[1], "psnr unseen", "seen by no view")):
            series = Series(words, words, [(a, r[metric]) for a, r in zip(across, rows)])
            parts += drawn(series, x, y, hue)
            parts.append(
                text(x.place(across[-1]) + 8, y.place(rows[-1][metric]) + 4, words, colour=hue, size=12, weight=600)
            )
    parts.append(text(90, 450, "Closed form alone, not refined; means over the scenes.", colour=FAINT))
    return page(1080, 470, "How many Gaussians, and of which degree, a hole needs", "", parts)
