"""What bench_harmonics.py found, as tables and as charts."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
from chart import FAINT, Axis, Series, drawn, end_labels, frame, group_colours, in_words, page, text
from materials import MATERIALS
from raster_report import table

from gimp3d.evaluate import benchmark

WIDTH, HEIGHT, PLOT_WIDTH, PLOT_HEIGHT = 1200, 660, 200, 190
LEFTS, TOPS = (80, 475, 870), (105, 395)
CHARTED = ("gimp3d", "leave-one-out", "ridge 1, degree 3", "constant")  # in the accuracy chart
STABLE = ("gimp3d", "paper", "gimp3d, offset", "constant")
Row = dict[str, Any]


def markdown(results: dict[str, Any]) -> str:
    """The results as tables."""
    host = results["machine"]
    times = list(results["speed"][0]["times"])
    parts = [
        "# Fitting spherical harmonics\n",
        f"{host['cpu']} ({host['architecture']}), {host['cores']} cores, {host['vectors']}; load at the start "
        f"{host['load_at_start'][0]}.\n",
        f"## Speed\n\n{in_words(results['count'])} Gaussians, milliseconds, wall (CPU), best of several. “gimp3d” "
        f"chooses degree and ridge per Gaussian; all others fit that degree with a ridge of {results['ridge']}. lstsq "
        "is timed on 1,000 Gaussians and scaled up.\n",
        table(
            ["threads", "views", "degree", *times, "Cholesky ÷ fixed, CPU", "÷ gimp3d", "largest difference"],
            [
                [r["threads"], r["views"], r["degree"], *(pair(r["times"][name]) for name in times), *versus(r)]
                for r in results["speed"]
            ],
        ),
        "## Accuracy on simulated materials\n\nRMSE inside | outside the cone of views (outside: twice as wide), "
        "colours in [0, 1], 8 % of observations wrong; means of the cells.\n",
        accuracy_table(results["accuracy"], "views"),
        accuracy_table(results["accuracy"], "cone"),
        accuracy_table(results["accuracy"], "material"),
        "## Stability\n\nRMSE inside the cone | 99th percentile of errors all round.\n",
        *(stability_table(results["stability"], case) for case in cases(results)),
    ]
    if results["scenes"]:
        parts += ["## Removals, preset balanced\n", benchmark.table(results["scenes"]), ""]
    return "\n".join(parts)


def pair(costs: dict[str, float]) -> str:
    return f"{costs['wall_ms']:.0f} ({costs['cpu_ms']:.0f})"


def versus(row: Row) -> list[str]:
    times = row["times"]
    if "torch Cholesky" not in times:
        return ["—"] * 3
    cholesky = times["torch Cholesky"]["cpu_ms"]
    ratios = [f"{cholesky / times[name]['cpu_ms']:.1f}" for name in ("gimp3d, fixed", "gimp3d")]
    return [*ratios, f"{row['difference']:.0e}"]


def accuracy_table(rows: list[Row], by: str) -> str:
    values = list(dict.fromkeys(r[by] for r in rows))
    rules = dict.fromkeys(r["rule"] for r in rows)
    lines = []
    for rule in rules:
        cells = [[r for r in rows if r["rule"] == rule and r[by] == v] for v in values]
        lines.append([rule, *(both(c) for c in (*cells, [r for r in rows if r["rule"] == rule]))])
    return table([by, *map(str, values), "all"], lines)


def both(rows: list[Row]) -> str:
    return f"{mean(rows, 'inside'):.4f} | {mean(rows, 'outside'):.4f}".replace(" | ", " \\| ")


def mean(rows: Iterable[Row], key: str) -> float:
    return float(np.mean([r[key] for r in rows]))


def cases(results: dict[str, Any]) -> list[str]:
    return list(dict.fromkeys(r["case"] for r in results["stability"]))


def stability_table(rows: list[Row], case: str) -> str:
    rows = [r for r in rows if r["case"] == case]
    values, rules = list(dict.fromkeys(r["x"] for r in rows)), list(dict.fromkeys(r["rule"] for r in rows))
    found = {(r["rule"], r["x"]): f"{r['inside']:.3f} \\| {r['all_round']:.3f}" for r in rows}
    return table([case, *(f"{v:g}" for v in values)], [[rule, *(found[rule, v] for v in values)] for rule in rules])


# ------------------------------------------------------------------------------------------------------------- charts


def accuracy_chart(results: dict[str, Any]) -> str:
    """Above: milliseconds over the number of views, by degree. Below: errors inside and outside the cone."""
    threads = min(r["threads"] for r in results["speed"])
    rows = [r for r in results["speed"] if r["threads"] == threads]
    shown = ("gimp3d", "gimp3d, fixed", "torch Cholesky", "torch lstsq")
    parts = []
    for left, degree in zip(LEFTS, (1, 2, 3)):
        lines = [
            Series(name, name, [(r["views"], r["times"][name]["cpu_ms"]) for r in rows if r["degree"] == degree])
            for name in shown
            if name in rows[0]["times"]
        ]
        parts += panel(f"Degree {degree}", lines, left, TOPS[0], "views (log)", "ms CPU, one thread (log)")
    errors = results["accuracy"]
    for left, where in zip(LEFTS, ("inside", "outside")):
        lines = [
            Series(rule, rule, by_views([r for r in errors if r["rule"] == rule], where), line_of(rule))
            for rule in CHARTED
        ]
        parts += panel(f"{where.capitalize()} the cone of views", lines, left, TOPS[1], "views (log)", "RMSE (log)")
    parts += notes(
        LEFTS[2],
        TOPS[1],
        [
            f"Above: {in_words(results['count'])} Gaussians. “gimp3d”",
            "chooses degree and ridge for each; the",
            "others fit that degree with one ridge.",
            "",
            f"Below: mean over {', '.join(MATERIALS[:2])} and",
            f"{MATERIALS[2]} materials and cones of 10°, 30°",
            "and 90°; 8 % of observations are wrong.",
            "“Outside” is a cone twice as wide.",
            "Colours in [0, 1].",
        ],
    )
    host = results["machine"]
    subtitle = f"{host['architecture']}, {host['vectors']}. Lower is better."
    return page(WIDTH, HEIGHT, "Fitting view-dependent colour: speed and accuracy", subtitle, parts)


def stability_chart(results: dict[str, Any]) -> str:
    """Error curves of bad observations."""
    axes: dict[str, tuple[str, str, Callable[[float], str]]] = {
        "wrong observations": ("inside", "share of wrong observations", lambda x: f"{x:.0%}"),
        "exposure jumps": ("inside", "gain of every third view", lambda x: f"+{x:.0%}"),
        "reference lit otherwise": ("inside", "exposure of all views but the reference", lambda x: f"−{x:.0%}"),
        "views": ("all_round", "views in a cone of 40° (log)", lambda x: f"{x:g}"),
        "clustered views": ("all_round", "half angle of 10 views, 45° off (log)", lambda x: f"{x:g}°"),
        "two near-equal views": ("all_round", "half angle of both (log)", lambda x: f"{x:g}°"),
    }
    words = {"inside": "RMSE in the cone (log)", "all_round": "99 % of errors (log)"}
    places = [(left, top) for top in TOPS for left in LEFTS]
    parts = []
    for (left, top), (case, (key, label, tick)) in zip(places, axes.items()):
        rows = [r for r in results["stability"] if r["case"] == case]
        lines = [
            Series(rule, rule, [(r["x"], r[key]) for r in rows if r["rule"] == rule], line_of(rule)) for rule in STABLE
        ]
        parts += panel(case.capitalize(), lines, left, top, label, words[key], tick, key == "all_round")
    subtitle = (
        "Above: RMSE in the cone of views. Below: 99th percentile of errors in all directions, most of them far from "
        "every view. 8 % of observations are wrong where nothing else is said."
    )
    return page(WIDTH, HEIGHT, "Fitting view-dependent colour: bad observations", subtitle, parts)


def line_of(rule: str) -> str:
    return "dashed" if rule == "constant" else "line"


def by_views(rows: list[Row], where: str) -> list[tuple[float, float]]:
    return [(v, mean([r for r in rows if r["views"] == v], where)) for v in dict.fromkeys(r["views"] for r in rows)]


def panel(
    heading: str,
    lines: list[Series],
    left: float,
    top: float,
    x_label: str,
    y_label: str,
    tick: Callable[[float], str] = lambda x: f"{x:g}",
    logarithmic: bool = True,
) -> list[str]:
    """Lines over a logarithmic y axis."""
    xs = sorted({x for s in lines for x, _ in s.points})
    ys = [y for s in lines for _, y in s.points]
    x_axis = (
        Axis(xs[0] / 1.2, xs[-1] * 1.2, left, left + PLOT_WIDTH)
        if logarithmic
        else Axis(xs[0] - 0.03 * xs[-1], 1.03 * xs[-1], left, left + PLOT_WIDTH, logarithmic=False)
    )
    low, high = 0.9 * min(ys), 1.1 * max(ys)
    decades = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    steps = (1, 2, 3, 4, 6, 8) if high / low < 5 else (1, 2, 5) if high / low < 60 else (1,)
    ticks = [s * 10.0**d for d in decades if len(decades) < 6 or d % 3 == 0 for s in steps]
    y_axis = Axis(low, high, top + PLOT_HEIGHT, top)
    y_ticks = {t: f"{t:g}" for t in ticks if low <= t <= high}
    colours = group_colours(lines)
    parts = frame(heading, x_axis, y_axis, {x: tick(x) for x in xs}, y_ticks, x_label, y_label, size=12)
    for s in lines:
        parts += drawn(s, x_axis, y_axis, colours[s.group])
    return parts + end_labels(lines, x_axis, y_axis, colours)


def notes(left: float, top: float, lines: list[str]) -> list[str]:
    return [text(left, top + 18 * k, line, colour=FAINT) for k, line in enumerate(lines)]
