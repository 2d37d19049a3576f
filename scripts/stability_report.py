"""What bench_stability.py found, as a table and as a chart."""

from __future__ import annotations

import math
from typing import Any

from chart import COLOURS, FAINT, Axis, Series, drawn, frame, mark, page, text
from raster_report import table

Row = dict[str, Any]
HEADINGS = {  # kind → heading, unit of its levels
    "views": ("Views", ""),
    "cone": ("All views within", "°"),
    "exposure": ("Exposures off, ±", "%"),
    "misplaced": ("Photos mixed up", "%"),
    "garbled": ("Pixels garbled", "%"),
    "surface": ("Surface off", "%"),
    "depths": ("All depths off", "%"),
}
MEASURES = {"mask": "PSNR hidden, dB", "unseen": "PSNR unseen, dB", "largest": "largest splat, %"}
WIDE, HIGH, TOP, LEFT, GAP = 130, 150, 110, 90, 24  # px


def label(kind: str, level: float) -> str:
    unit = HEADINGS[kind][1]
    return f"{100 * level:g}" if unit == "%" else f"{level:g}"


def markdown(results: dict[str, Any]) -> str:
    host = results["machine"]
    lines = []
    for r in results["rows"]:
        words = ["unperturbed", ""] if r["kind"] == "none" else [HEADINGS[r["kind"]][0]]
        if r["kind"] != "none":
            words.append(label(r["kind"], r["level"]) + HEADINGS[r["kind"]][1])
        if "refused" in r:
            lines.append([r["scene"], *words, r["refused"], *[""] * 8])
            continue
        numbers = [f"{r[k]:.2f}" for k in ("mask", "unseen", "open mask", "open unseen")]
        ends = [r["added"], "yes" if r["finite"] else "NO", f"{100 * r['largest']:.2f}", f"{r['farthest']:.2f}"]
        lines.append([r["scene"], *words, *numbers, *ends, "; ".join(r["warnings"])])
    head = ["scene", "what is wrong", "by", "mask", "unseen", "hole open: mask", "unseen", "added", "finite"]
    head += ["largest, %", "farthest", "warnings"]
    return (
        f"# Whole removals whose input is wrong\n\n{host['cpu']}, {host['cores']} cores; preset {results['preset']}. "
        "PSNR in dB of the test views but the reference. *Largest*: the largest new standard deviation; *farthest*: "
        "the farthest new Gaussian from the box's centre; both in diagonals of the box.\n\n" + table(head, lines)
    )


def draw_chart(results: dict[str, Any]) -> str:
    """A column per perturbation, a row per measure, a line per scene; dashed: the hole left open."""
    rows = [r for r in results["rows"] if "refused" not in r]
    kinds = [k for k in HEADINGS if any(r["kind"] == k for r in results["rows"])]
    scenes = list(dict.fromkeys(r["scene"] for r in results["rows"]))
    hues = dict(zip(scenes, COLOURS))
    parts = []
    for k, scene in enumerate(scenes):
        parts += [mark("dot", LEFT + 90 * k, 76, hues[scene]), text(LEFT + 10 + 90 * k, 80, scene, colour=hues[scene])]
    parts.append(
        text(LEFT + 90 * len(scenes), 80, "dashed: the hole left open; the first mark is unperturbed", colour=FAINT)
    )
    for i, (measure, words) in enumerate(MEASURES.items()):
        scale = 100 if measure == "largest" else 1
        top = TOP + 20 + i * (HIGH + 60)
        values = [scale * r[measure] for r in rows]
        if measure == "largest":
            y_axis = Axis(min(values) / 1.5, max(values) * 1.5, top + HIGH, top)
            ticks = {v: f"{v:g}" for v in (0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50, 100) if y_axis.low <= v <= y_axis.high}
        else:
            values += [r[f"open {measure}"] for r in rows]
            low, high = 5 * math.floor(min(values) / 5), 5 * math.ceil(max(values) / 5)
            y_axis = Axis(low, high, top + HIGH, top, logarithmic=False)
            ticks = {float(v): str(v) for v in range(low, high + 1, 5)}
        for j, kind in enumerate(kinds):
            levels = list(dict.fromkeys(r["level"] for r in results["rows"] if r["kind"] == kind))
            left = LEFT + j * (WIDE + GAP)
            x_axis = Axis(-0.3, len(levels) + 0.3, left, left + WIDE, logarithmic=False)
            x_ticks = {0.0: "–"} | {n + 1.0: label(kind, level) for n, level in enumerate(levels)}
            heading = "{}{}".format(HEADINGS[kind][0], f", {u}" if (u := HEADINGS[kind][1]) else "") if i == 0 else ""
            shown = ticks if j == 0 else dict.fromkeys(ticks, "")
            parts += frame("", x_axis, y_axis, x_ticks, shown, y_label=words if j == 0 else "", size=11)
            parts.append(text(left, top - 12, heading, size=12, weight=600))
            for scene in scenes:
                of = {(r["kind"], r["level"]): r for r in rows if r["scene"] == scene}
                line = [(0.0, of.get(("none", 0.0)))]
                line += [(n + 1.0, of.get((kind, level))) for n, level in enumerate(levels)]
                points = [(x, scale * r[measure]) for x, r in line if r]
                parts += drawn(Series(scene, scene, points), x_axis, y_axis, hues[scene])
                if measure != "largest":
                    there = [(x, r[f"open {measure}"]) for x, r in line if r]
                    parts += drawn(Series(scene, scene, there, "dashed"), x_axis, y_axis, hues[scene])
    width, height = LEFT + len(kinds) * (WIDE + GAP) + 10, TOP + 20 + len(MEASURES) * (HIGH + 60)
    subtitle = "Test views but the reference; largest splat: its standard deviation by the box's diagonal"
    return page(width, height, "What wrong input does to a removal", subtitle, parts)
