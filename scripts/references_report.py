"""What bench_references.py found, as tables and as a chart."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from chart import COLOURS, FAINT, Axis, frame, mark, page, text
from raster_report import table

GIVEN, FILLED = "true picture", "built-in fill"
MASKS = {"mask": "what the object hides", "unseen": "what no training view sees of it"}
GOOD = 0.5  # of the best reference's score: what shows the surface less well counts as a poor reference
WIDTH, TOP, PLOT, BETWEEN = 1120, 110, 230, 90
Row = dict[str, Any]


def markdown(results: dict[str, Any]) -> str:
    host, rows = results["machine"], results["references"]
    parts = [
        "# Each view as the reference\n",
        f"{host['cpu']}, {host['cores']} cores. Whole removals, {results['steps']} steps of refinement at most. PSNR "
        "in dB of the test views, drawn from the filled splat, without the reference itself. Mean ± σ over references "
        "(n - 1). *By view*: σ once each view's own mean is taken out, as leaving out another view changes a mean as "
        "well. *Good*: σ of the references that score at least half as high as the best one; what others show "
        "poorly or not at all is made up by later references, whatever picture is given.\n",
    ]
    for kind, words in (
        (GIVEN, "each test view, given its true picture, scored on the others"),
        (FILLED, "training views drawn at random, filled by the built-in appearance, scored on all test views"),
    ):
        of_kind = [r for r in rows if r["kind"] == kind]
        if of_kind:
            parts += [f"## {kind.capitalize()}: {words}\n", spread_table(of_kind), *verdict(of_kind)]
    parts += ["## Every reference\n", references_table(rows)]
    return "\n".join(parts)


def done(rows: Sequence[Row], scene: str, preset: str) -> list[Row]:
    return [r for r in rows if (r["scene"], r["preset"]) == (scene, preset) and "views" in r]


def means(rows: Sequence[Row], mask: str) -> list[float]:
    """Each reference's mean over the views that it is scored on."""
    return [float(np.mean([v[mask] for v in r["views"].values()])) for r in rows]


def sigma(values: Sequence[float]) -> float:
    return float(np.std(values, ddof=1)) if len(values) > 1 else float("nan")


def sigma_by_view(rows: Sequence[Row], mask: str) -> float:
    """σ of the references' mean deviations from what the same views get from all references."""
    names = {name for r in rows for name in r["views"]}
    usual = {n: np.mean([r["views"][n][mask] for r in rows if n in r["views"]]) for n in names}
    return sigma([float(np.mean([v[mask] - usual[n] for n, v in r["views"].items()])) for r in rows])


def is_good(row: Row, others: Sequence[Row]) -> bool:
    return bool(row["score"] >= GOOD * max(r["score"] for r in others))


def mean_sigma(rows: Sequence[Row], preset: str, mask: str) -> float:
    """Mean over scenes."""
    return float(np.mean([sigma(means(done(rows, s, preset), mask)) for s in names_of(rows, "scene")]))


def names_of(rows: Sequence[Row], key: str) -> list[str]:
    return list(dict.fromkeys(r[key] for r in rows))


def spread_table(rows: Sequence[Row]) -> str:
    head = ["scene", "preset", "references", "refused"]
    head += [f"{mask}, {what}" for mask in MASKS for what in ("mean ± σ", "worst", "σ by view", "good")]
    lines: list[list[Any]] = []
    for scene in names_of(rows, "scene"):
        for preset in names_of(rows, "preset"):
            asked = [r for r in rows if (r["scene"], r["preset"]) == (scene, preset)]
            found = done(rows, scene, preset)
            cells: list[Any] = [scene, preset, len(found), len(asked) - len(found)]
            for mask in MASKS:
                values = means(found, mask)
                if not values:
                    cells += ["", "", "", ""]
                    continue
                cells += [f"{np.mean(values):.2f} ± {sigma(values):.2f}", f"{min(values):.2f}"]
                good = means([r for r in found if is_good(r, found)], mask)
                cells += [f"{sigma_by_view(found, mask):.2f}", f"{sigma(good):.2f} ({len(good)})"]
            lines.append(cells)
    return table(head, lines)


def verdict(rows: Sequence[Row]) -> list[str]:
    """σ of both presets, mean over the scenes."""
    presets = names_of(rows, "preset")
    return [
        "Mean σ over the scenes, "
        + "; ".join(
            f"in {mask}: " + ", ".join(f"{mean_sigma(rows, p, mask):.2f} dB {p}" for p in presets) for mask in MASKS
        )
        + ".\n"
    ]


def references_table(rows: Sequence[Row]) -> str:
    lines = []
    for r in rows:
        cells = [f"{means([r], mask)[0]:.2f}" for mask in MASKS] if "views" in r else [r["refused"], ""]
        score = f"{r['score']:.2f}" if "score" in r else ""
        lines.append([r["scene"], r["kind"], r["preset"], r["reference"], score, *cells])
    return table(["scene", "picture", "preset", "reference", "score", *MASKS], lines)


def draw_chart(results: dict[str, Any]) -> str:
    """A dot for each reference, by scene and preset; the bar is the mean, the words σ."""
    rows = results["references"]
    kinds, scenes, presets = (names_of(rows, k) for k in ("kind", "scene", "preset"))
    colours = {p: COLOURS[k] for k, p in enumerate(presets)}
    parts = []
    for k, preset in enumerate(presets):
        parts += [mark("dot", WIDTH - 250 + 120 * k, 51, colours[preset])]
        parts += [text(WIDTH - 240 + 120 * k, 55, preset, colour=colours[preset], weight=600)]
    for i, mask in enumerate(MASKS):
        values = [m for r in rows if "views" in r for m in means([r], mask)]
        low, high = 2 * np.floor(min(values) / 2), 2 * np.ceil(max(values) / 2)
        top = TOP + i * (PLOT + BETWEEN)
        y_axis = Axis(low, high + 1, top + PLOT, top, logarithmic=False)
        step = 2 if high - low <= 16 else 4
        y_ticks = {float(v): f"{v:.0f}" for v in np.arange(low, high + 1, step)}
        for j, kind in enumerate(kinds):
            left = 84 + j * (WIDTH - 60) // len(kinds)
            x_axis = Axis(0, len(scenes), left, left + (WIDTH - 60) // len(kinds) - 80, logarithmic=False)
            heading = f"{kind.capitalize()}: {MASKS[mask]}"
            parts += frame(heading, x_axis, y_axis, {n + 0.5: s for n, s in enumerate(scenes)}, y_ticks, "", "PSNR, dB")
            for n, scene in enumerate(scenes):
                for k, preset in enumerate(presets):
                    found = done([r for r in rows if r["kind"] == kind], scene, preset)
                    place = n + (k + 1) / (len(presets) + 1)
                    parts += column(found, mask, x_axis.place(place), y_axis, colours[preset])
    subtitle = "Mean PSNR of the test views by reference (rings: it shows the surface poorly); bar: mean; figure: σ"
    return page(WIDTH, TOP + 2 * PLOT + BETWEEN + 50, "The same removal from other references", subtitle, parts)


def column(rows: Sequence[Row], mask: str, x: float, y_axis: Axis, colour: str) -> list[str]:
    """The references' dots, their mean and its σ."""
    if not rows:
        return []
    values = means(rows, mask)
    y, highest = y_axis.place(float(np.mean(values))), y_axis.place(max(values))
    bar = f'<line x1="{x - 13:.1f}" y1="{y:.1f}" x2="{x + 13:.1f}" y2="{y:.1f}" stroke="{colour}" stroke-width="2"/>'
    shapes = ["dot" if is_good(r, rows) else "ring" for r in rows]
    dots = [mark(shape, x, y_axis.place(v), colour) for shape, v in zip(shapes, values)]
    return [*dots, bar, text(x, highest - 9, f"{sigma(values):.2f}", anchor="middle", colour=FAINT, size=11)]
