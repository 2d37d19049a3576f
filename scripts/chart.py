"""Charts as SVG in one style: axes, lines, marks and their names. What a chart shows is its own script's business."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape

COLOURS = ("#1b7f5f", "#c65102", "#5e55a3", "#b0246b")  # dark enough on white, apart for colour-blind eyes
INK, FAINT, GRID = "#1f2328", "#59636e", "#dfe3e8"


@dataclass(frozen=True)
class Series:
    """A line, or marks without a line."""

    name: str
    group: str  # series of a group have one colour
    points: list[tuple[float, float]]
    shape: str = "line"  # line or dashed, with dots or rings; dot, ring, diamond or square: marks alone


@dataclass(frozen=True)
class Axis:
    """An axis from value `low` at place `start` to `high` at `end`, logarithmic or linear."""

    low: float
    high: float
    start: float
    end: float
    logarithmic: bool = True

    def place(self, value: float) -> float:
        if self.logarithmic:
            share = math.log(value / self.low) / math.log(self.high / self.low)
        else:
            share = (value - self.low) / (self.high - self.low)
        return self.start + share * (self.end - self.start)


def page(width: int, height: int, title: str, subtitle: str, parts: Sequence[str]) -> str:
    """The whole picture: a white card with a heading."""
    return "\n".join(
        [
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" width="{width}" height="{height}"'
            ' font-family="system-ui, -apple-system, Segoe UI, Roboto, Helvetica, Arial, sans-serif" font-size="13">',
            f"<title>{escape(title)}</title>",
            f'<rect x="0.5" y="0.5" width="{width - 1}" height="{height - 1}" rx="8" fill="#ffffff" stroke="#d0d7de"/>',
            text(24, 34, title, size=18, weight=600),
            text(24, 55, subtitle, colour=FAINT),
            *parts,
            "</svg>\n",
        ]
    )


def frame(
    heading: str,
    x_axis: Axis,
    y_axis: Axis,
    x_ticks: Mapping[float, str],
    y_ticks: Mapping[float, str],
    x_label: str = "",
    y_label: str = "",
    size: int = 13,  # of the ticks' words
) -> list[str]:
    """A panel's heading, grid, ticks and axis labels."""
    left, right, bottom, top = x_axis.start, x_axis.end, y_axis.start, y_axis.end
    parts = [text(left, top - 12, heading, size=14, weight=600)] if heading else []
    for value, words in y_ticks.items():
        y = y_axis.place(value)
        parts.append(f'<line x1="{left}" y1="{y:.1f}" x2="{right}" y2="{y:.1f}" stroke="{GRID}"/>')
        parts.append(text(left - 8, y + 4, words, anchor="end", colour=FAINT, size=size))
    for value, words in x_ticks.items():
        x = x_axis.place(value)
        parts.append(f'<line x1="{x:.1f}" y1="{bottom}" x2="{x:.1f}" y2="{bottom + 5}" stroke="{FAINT}"/>')
        parts.append(text(x, bottom + 20, words, anchor="middle", colour=FAINT, size=size))
    parts.append(f'<line x1="{left}" y1="{bottom}" x2="{right}" y2="{bottom}" stroke="{FAINT}"/>')
    if x_label:
        parts.append(text((left + right) / 2, bottom + 42, x_label, anchor="middle"))
    if y_label:
        label = text(0, 0, y_label, anchor="middle")
        parts.append(f'<g transform="translate({left - 54},{(bottom + top) / 2}) rotate(-90)">{label}</g>')
    return parts


def drawn(series: Series, x_axis: Axis, y_axis: Axis, colour: str) -> list[str]:
    """A series' marks, and the line through them if it is one."""
    places = [(x_axis.place(x), y_axis.place(y)) for x, y in series.points]
    parts = []
    if series.shape in ("line", "dashed"):
        path = " ".join(f"{x:.1f},{y:.1f}" for x, y in places)
        dashes = ' stroke-dasharray="5 4"' if series.shape == "dashed" else ""
        parts.append(f'<polyline points="{path}" fill="none" stroke="{colour}" stroke-width="2"{dashes}/>')
    return parts + [mark(series.shape, x, y, colour) for x, y in places]


def end_labels(series: Sequence[Series], x_axis: Axis, y_axis: Axis, colours: Mapping[str, str]) -> list[str]:
    """The lines' names to the right of their ends, moved apart where they would overlap."""
    parts, lowest = [], math.inf
    for s in sorted(series, key=lambda s: s.points[-1][1]):
        x, y = s.points[-1]
        lowest = min(y_axis.place(y) + 4, lowest - 15)
        parts.append(text(x_axis.place(x) + 10, lowest, s.group, colour=colours[s.group], weight=600, size=12))
    return parts


def group_colours(series: Sequence[Series]) -> dict[str, str]:
    """A colour for each group, in the order of their first series."""
    return {group: COLOURS[k % len(COLOURS)] for k, group in enumerate(dict.fromkeys(s.group for s in series))}


def mark(shape: str, x: float, y: float, colour: str) -> str:
    if shape in ("line", "dot"):
        return f'<circle cx="{x:.1f}" cy="{y:.1f}" r="3.5" fill="{colour}"/>'
    if shape in ("dashed", "ring"):
        return f'<circle cx="{x:.1f}" cy="{y:.1f}" r="3" fill="#ffffff" stroke="{colour}" stroke-width="1.5"/>'
    turn = f' transform="rotate(45 {x:.1f} {y:.1f})"' if shape == "diamond" else ""
    return (
        f'<rect x="{x - 4.5:.1f}" y="{y - 4.5:.1f}" width="9" height="9" fill="#ffffff" stroke="{colour}"'
        f' stroke-width="2"{turn}/>'
    )


def text(
    x: float, y: float, words: str, anchor: str = "start", colour: str = INK, size: int = 13, weight: int = 400
) -> str:
    style = f'text-anchor="{anchor}" fill="{colour}" font-size="{size}" font-weight="{weight}"'
    return f'<text x="{x:.1f}" y="{y:.1f}" {style}>{escape(words)}</text>'


def in_words(count: float) -> str:
    """2,000,000 as 2M, 100,000 as 100k."""
    return f"{count / 1e6:g}M" if count >= 1e6 else f"{count / 1e3:g}k"
