"""The charts of bench_surface.py."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from chart import FAINT, INK, Axis, Series, drawn, frame, group_colours, mark, page, text
from surface_scenes import SHADOW

from gimp3d.camera import output_name

TOP, PLOT_HEIGHT, BETWEEN = 100, 150, 62  # px
BESIDE, WITH_TICKS = 26, 84  # px left of a panel whose axis is its neighbour's, and of one with its own
APART = 0.07  # of a step between ticks, by which marks of different scenes stand apart
Row = dict[str, Any]


@dataclass(frozen=True)
class Measure:
    """What a panel shows: a share on a linear axis that ends at 1, or a ratio on a logarithmic one."""

    key: str
    words: str
    share: bool
    unit: float = 1.0
    wanted: float | None = None  # the target, drawn as a line

    def axis(self, values: Sequence[float], start: float, end: float) -> Axis:
        values = [*values, *([self.wanted] if self.wanted else [])]
        if self.share:
            return Axis(min(0.9, math.floor(10 * min(values)) / 10), 1.0, start, end, logarithmic=False)
        return Axis(nice(0.95 * min(values), math.floor), nice(1.05 * max(values), math.ceil), start, end)

    def ticks(self, axis: Axis) -> dict[float, str]:
        if self.share:
            step = 0.02 if axis.low >= 0.9 else 0.1 if axis.low >= 0.5 else 0.2
            values = np.arange(1, axis.low - 1e-9, -step)
            return {float(v): f"{v:.0%}" for v in values}
        decades = range(math.floor(math.log10(axis.low)), math.ceil(math.log10(axis.high)) + 1)
        steps = (1, 2, 5) if axis.high / axis.low < 500 else (1,)
        values = [s * 10.0**d for d in decades for s in steps]
        return {v: f"{v:g}" for v in values if 0.999 * axis.low <= v <= 1.001 * axis.high}


COVERED = Measure("covered", "never-seen pixels in T", True, wanted=0.99)
OVERLAP = Measure("iou", "IoU with T unperturbed", True)
AREA = Measure("area", "area of T ÷ never-seen", False, wanted=1.6)
ERROR = Measure("median", "depth error, %", False, unit=100.0)


@dataclass(frozen=True)
class Column:
    """Categories along the x axis, and rows of results at them by series."""

    heading: str
    labels: Sequence[str]
    rows: dict[str, list[tuple[int, Row]]]  # series → (place among the labels, row)
    joined: bool = True
    width: int = 190


Cell = tuple[Column, Measure]


def masks_chart(results: dict[str, Any]) -> str:
    """T against what no view sees, per scene and mode."""
    scenes = results["scenes"]
    modes = dict.fromkeys(r["mode"] for r in results["masks"])
    rows = {m: [(scenes.index(r["scene"]), r) for r in results["masks"] if r["mode"] == m] for m in modes}
    column = Column("", [s.replace(SHADOW, "*") for s in scenes], rows, joined=False, width=330)
    subtitle = "Training views. Never-seen: hidden by the object in every view; lines: what is wanted. *: with shadows"
    return panels("Where is filled: target regions T by mode", subtitle, [[(column, COVERED), (column, AREA)]])


def references_chart(results: dict[str, Any]) -> str:
    """Each test view as the reference."""
    rows = [r for r in results["depths"] if r["surface"] == "auto"]
    views = list(dict.fromkeys(r["view"] for r in rows))
    lines = {
        s: [(views.index(r["view"]), r) for r in rows if r["scene"] == s and "refused" not in r]
        for s in results["scenes"]
    }
    column = Column("", [output_name(v).rpartition("/")[2] for v in views], lines, joined=False, width=250)
    cells = [(column, COVERED), (column, AREA), (column, ERROR)]
    subtitle = "Test views, never a photo. Depth error: relative, median over never-seen pixels"
    return panels("Each test view as the reference", subtitle, [cells])


def stability_chart(results: dict[str, Any]) -> str:
    """T and depths over the perturbations."""
    columns = [perturbed(results, *kind) for kind in KINDS]
    if results["shadows"]:
        lines = {
            r["scene"]: [(k, {key: r[key][k] for key in ("covered", "iou", "median")}) for k in (0, 1)]
            for r in results["shadows"]
        }
        columns.append(Column("Shadows in photos", ["without", "with"], lines, width=130))
    subtitle = "Mean over seeds; depth error: relative, in never-seen pixels, mean of the test views' medians"
    cells = [[(column, measure) for column in columns] for measure in (OVERLAP, COVERED, ERROR)]
    return panels("Stability: what wrong poses, depths and regions change", subtitle, cells)


# kind, heading, label of the unperturbed, whether a line joins the levels
KINDS = (
    ("poses", "Poses off, px", "0", True),
    ("depths", "Depths off, %", "0", True),
    ("size", "Region's size ×", "1", True),
    ("place", "Region moved by 10 %", "0", False),
)


def perturbed(results: dict[str, Any], kind: str, heading: str, zero: str, joined: bool) -> Column:
    """A kind of perturbation, its levels in order with the unperturbed among them."""
    found = [r for r in results["stability"] if r["kind"] == kind]
    levels = {r["label"]: r["level"] if kind == "size" else k for k, r in enumerate(found, 1)}
    labels = sorted({**levels, zero: 1.0 if kind == "size" else 0}.items(), key=lambda item: item[1])
    order = list(dict.fromkeys(name for name, _ in labels))
    lines: dict[str, list[tuple[int, Row]]] = {}
    for scene in results["scenes"]:
        rows = [r for r in found if r["scene"] == scene and "refused" not in r]
        rows += [{**r, "label": zero} for r in results["stability"] if r["scene"] == scene and r["kind"] == "none"]
        lines[scene] = [(k, mean([r for r in rows if r["label"] == label])) for k, label in enumerate(order)
                        if any(r["label"] == label for r in rows)]  # fmt: skip
    return Column(heading, order, lines, joined)


def mean(rows: Sequence[Row]) -> Row:
    """Numbers averaged over the rows, which differ in their seed."""
    return {key: float(np.mean([r[key] for r in rows])) for key in ("iou", "covered", "area", "median")}


def panels(title: str, subtitle: str, grid: Sequence[Sequence[Cell]]) -> str:
    """Rows of panels; all of a measure have one scale, so that they can be compared."""
    measures = dict.fromkeys(measure for row in grid for _, measure in row)
    values = {
        m: [r[m.key] * m.unit for row in grid for c, m2 in row if m2 is m for line in c.rows.values() for _, r in line]
        for m in measures
    }
    series = {name: as_series(name, column) for row in grid for column, _ in row for name in column.rows}
    colours = group_colours(list(series.values()))
    parts: list[str] = []
    width = 0.0
    for k, row in enumerate(grid):
        top, left = TOP + k * (PLOT_HEIGHT + BETWEEN), 0.0
        for column, measure, before in zip(*zip(*row), [None, *(m for _, m in row)]):
            own = measure is not before
            left += WITH_TICKS if own else BESIDE
            x_axis = Axis(-0.5, len(column.labels) - 0.5, left, left + column.width, logarithmic=False)
            y_axis = measure.axis(values[measure], top + PLOT_HEIGHT, top)
            ticks = {float(x): words for x, words in enumerate(column.labels)}
            y_ticks = measure.ticks(y_axis)
            shown = y_ticks if own else dict.fromkeys(y_ticks, "")
            heading = column.heading if k == 0 else ""
            parts += frame(heading, x_axis, y_axis, ticks, shown, y_label=measure.words if own else "", size=11)
            parts += target(measure, x_axis, y_axis)
            for n, (name, line) in enumerate(column.rows.items()):
                shift = 0.0 if column.joined else APART * (n - (len(column.rows) - 1) / 2)
                points = [(x + shift, r[measure.key] * measure.unit) for x, r in line]
                one = as_series(name, column, points)
                parts += drawn(one, x_axis, y_axis, colours[one.group])
            left += column.width
        width = max(width, left)
    bottom = TOP + len(grid) * (PLOT_HEIGHT + BETWEEN)
    parts += legend(series.values(), colours, bottom + 8)
    return page(round(width) + 30, bottom + 30, title, subtitle, parts)


def as_series(name: str, column: Column, points: list[tuple[float, float]] | None = None) -> Series:
    """Scenes whose photos show shadows have their sister's colour, and open marks."""
    dark = name.endswith(SHADOW)
    shape = ("dashed" if dark else "line") if column.joined else ("ring" if dark else "dot")
    return Series(name, name.removesuffix(SHADOW), points or [], shape)


def target(measure: Measure, x_axis: Axis, y_axis: Axis) -> list[str]:
    if measure.wanted is None:
        return []
    y = y_axis.place(measure.wanted)
    return [
        f'<line x1="{x_axis.start}" y1="{y:.1f}" x2="{x_axis.end}" y2="{y:.1f}" stroke="{INK}" stroke-dasharray="2 3"/>'
    ]


def legend(series: Iterable[Series], colours: dict[str, str], y: float) -> list[str]:
    parts, x = [], float(WITH_TICKS)
    for s in series:
        parts += [mark(s.shape, x, y - 4, colours[s.group]), text(x + 10, y, s.name, colour=FAINT)]
        x += 34 + 7.5 * len(s.name)
    return parts


def nice(value: float, towards: Any) -> float:
    """1, 2 or 5 times a power of ten, below (math.floor) or above (math.ceil)."""
    decade = 10.0 ** math.floor(math.log10(value))
    steps = [s * decade for s in (1, 2, 5, 10)]
    return max(s for s in steps if s <= value) if towards is math.floor else min(s for s in steps if s >= value)
