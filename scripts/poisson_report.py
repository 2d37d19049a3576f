"""What bench_poisson.py found, as tables and as a chart."""

from __future__ import annotations

import math
from typing import Any

from chart import COLOURS, FAINT, Axis, Series, drawn, end_labels, frame, page, text
from raster_report import table

WIDTH, HEIGHT = 960, 470
PLOT_WIDTH, PLOT_HEIGHT, TOP = 300, 280, 96
LEFTS = (80, 545)  # room for the lines' names to the right of each plot
CHART_TOLERANCE = 1e-6
NAMES = ("gimp3d", "pyamg RS + CG", "SciPy CG", "spsolve", "splu")  # in the chart
Row = dict[str, Any]


def markdown(results: Row) -> str:
    """The results as tables."""
    host = results["machine"]
    by_tolerance, by_shape = results["by_tolerance"], results["by_shape"]
    assembly = {r["size"]: f"{r['assembly_ms']:.0f} ms at {r['size']}" for r in by_tolerance}
    parts = [
        "# Speed of the Poisson solver\n",
        f"{host['cpu']} ({host['architecture']}), one thread, load at the start {host['load_at_start'][0]}; "
        f"numba {host['numba']}, SciPy {host['scipy']}, pyamg {host['pyamg']}.\n",
        "CPU milliseconds, best of several in turns; ours from masks and values to filled pixels, the others from the "
        f"assembled matrix on (assembling it with NumPy: {', '.join(assembly.values())}). Residual: ‖b − A·x‖ / ‖b‖, "
        "b relative to the constant that fits best. Error: largest, over the range of the values, against "
        f"{', '.join(dict.fromkeys(r['exact_by'] for r in by_tolerance if 'exact_by' in r))}. "
        "Ratio: time over that of gimp3d at the same tolerance (at 1e-6 for direct solvers).\n",
        "## Holes of 8 %, by tolerance\n",
        comparison(by_tolerance),
        "## Other shares and shapes\n",
        "parts: many, with islands, some at the image's border; screened: a fifth of the pixels drawn to values of "
        "their own.\n",
        comparison(by_shape),
        "## Channels\n",
        "Blending (guided), default tolerance: one channel, and three at once.\n",
        table(
            ["size", "unknowns", "precision", "one, ms", "three, ms", "ratio"],
            [
                [r["size"], r["unknowns"], r["precision"], r["one_ms"], r["three_ms"], r["ratio"]]
                for r in results["channels"]
            ],
        ),
        "## Memory\n",
        "Peak of the process above that with the problem (for the others: the matrix) alone.\n",
        table(
            ["size", "solver", "MiB"],
            [[r["size"], r["solver"], "not known" if r["mib"] is None else r["mib"]] for r in results["memory"]],
        ),
    ]
    return "\n".join(parts)


def comparison(rows: list[Row]) -> str:
    ours = {(key(r), r["tolerance"]): r["ms"] for r in rows if r["solver"] == "gimp3d"}
    cells = []
    for r in rows:
        base = ours[key(r), r["tolerance"] or CHART_TOLERANCE]
        cells.append(
            [
                r["size"]
                + ("" if r["shape"] == "blob" else f", {r['shape']}")
                + (", screened" if r["screened"] else ""),
                f"{r['share']:.0%}",
                f"{r['unknowns']:,}",
                r["solver"],
                "direct" if r["tolerance"] is None else f"{r['tolerance']:.0e}",
                "not run to its end" if r["ms"] is None else f"{r['ms']:.1f}",
                "" if r["ms"] is None else f"{r['ms'] / base:.1f}",
                r.get("iterations") or "",
                *(["", ""] if r["ms"] is None else [f"{r['residual']:.1e}", f"{r['error']:.1e}"]),
            ]
        )
    head = ["hole", "share", "unknowns", "solver", "tolerance", "ms", "ratio", "iterations", "residual", "error"]
    return table(head, cells)


def key(row: Row) -> tuple[Any, ...]:
    return row["size"], row["share"], row["shape"], row["screened"]


def draw_chart(results: Row) -> str:
    """Time and iterations over the number of unknowns."""
    rows = [r for r in results["by_tolerance"] if r["ms"] is not None]
    shown = [r for r in rows if r["tolerance"] in (CHART_TOLERANCE, None) and r["solver"] in NAMES]
    times, steps = (
        [
            Series(name, name, points)
            for name in NAMES
            if (points := [(r["unknowns"], r[what]) for r in shown if r["solver"] == name and r[what]])
        ]
        for what in ("ms", "iterations")
    )
    colours = dict(zip(NAMES, (*COLOURS, FAINT)))
    parts = []
    for left, (heading, panel, label) in zip(
        LEFTS, (("Time", times, "CPU time, ms (log)"), ("Iterations", steps, "iterations (log)"))
    ):
        counts = sorted({x for s in panel for x, _ in s.points})
        values = [y for s in panel for _, y in s.points]
        decades = math.floor(math.log10(min(values))), math.ceil(math.log10(max(values) * 1.05))
        x_axis = Axis(counts[0] / 1.3, counts[-1] * 1.3, left, left + PLOT_WIDTH)
        y_axis = Axis(10.0 ** decades[0], 10.0 ** decades[1], TOP + PLOT_HEIGHT, TOP)
        y_ticks = {10.0**d: f"{10.0**d:,.16g}" for d in range(decades[0], decades[1] + 1)}
        x_ticks = {n: f"{n / 1e3:.0f}k" for n in counts}
        parts += frame(heading, x_axis, y_axis, x_ticks, y_ticks, "pixels of the hole (log)", label)
        for series in panel:
            parts += drawn(series, x_axis, y_axis, colours[series.group])
        parts += end_labels(panel, x_axis, y_axis, colours)
    words = ", ".join(dict.fromkeys(r["size"] for r in shown))
    parts.append(text(LEFTS[0], HEIGHT - 18, f"Holes of 8 % of a picture: {words}.", colour=FAINT))
    host = results["machine"]
    subtitle = f"residual 1e-6 (splu, spsolve: direct); one thread, {host['cpu']} ({host['vectors']})"
    return page(WIDTH, HEIGHT, "Poisson's equation on an irregular hole", subtitle, parts)
