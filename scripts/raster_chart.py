"""The chart of bench_raster.py: milliseconds over the number of Gaussians, as SVG. Both axes are logarithmic."""

from __future__ import annotations

import math
from dataclasses import dataclass
from html import escape

WIDTH, HEIGHT = 960, 510
PLOT_WIDTH, PLOT_HEIGHT, TOP = 310, 310, 96
LEFTS = (80, 550)  # room for the lines' names to the right of each plot
COLOURS = ("#1b7f5f", "#c65102", "#5e55a3", "#b0246b")  # dark enough on white, apart for colour-blind eyes
INK, FAINT, GRID = "#1f2328", "#59636e", "#dfe3e8"


@dataclass(frozen=True)
class Series:
    """A line, or marks without a line."""

    name: str
    group: str  # series of a group have one colour
    points: list[tuple[int, float]]  # (Gaussians, ms)
    shape: str = "line"  # line, diamond or square


@dataclass(frozen=True)
class Axis:
    """A logarithmic axis from value `low` at place `start` to `high` at `end`."""

    low: float
    high: float
    start: float
    end: float

    def place(self, value: float) -> float:
        share = math.log(value / self.low) / math.log(self.high / self.low)
        return self.start + share * (self.end - self.start)


def speed_chart(title: str, subtitle: str, panels: dict[str, list[Series]]) -> str:
    """One panel beside the other with the same axes."""
    series = [s for panel in panels.values() for s in panel]
    counts = sorted({n for s in series for n, _ in s.points})
    times = [ms for s in series for _, ms in s.points]
    decades = math.floor(math.log10(min(times))), math.ceil(math.log10(max(times) * 1.05))
    y_axis = Axis(10.0 ** decades[0], 10.0 ** decades[1], TOP + PLOT_HEIGHT, TOP)
    groups = list(dict.fromkeys(s.group for s in series))
    colours = {group: COLOURS[k % len(COLOURS)] for k, group in enumerate(groups)}
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {HEIGHT}" width="{WIDTH}" height="{HEIGHT}"'
        ' font-family="system-ui, -apple-system, Segoe UI, Roboto, Helvetica, Arial, sans-serif" font-size="13">',
        f"<title>{escape(title)}</title>",
        f'<rect x="0.5" y="0.5" width="{WIDTH - 1}" height="{HEIGHT - 1}" rx="8" fill="#ffffff" stroke="#d0d7de"/>',
        text(24, 34, title, size=18, weight=600),
        text(24, 55, subtitle, colour=FAINT),
    ]
    for left, (name, panel) in zip(LEFTS, panels.items()):
        x_axis = Axis(counts[0] / 1.3, counts[-1] * 1.3, left, left + PLOT_WIDTH)
        parts += frame(name, x_axis, y_axis, counts, range(decades[0], decades[1] + 1))
        for s in panel:
            parts += drawn(s, x_axis, y_axis, colours[s.group])
        parts += end_labels([s for s in panel if s.shape == "line"], x_axis, y_axis, colours)
    shapes = {s.shape: s.name for s in series}
    legend = HEIGHT - 22
    for k, (shape, name) in enumerate(shapes.items()):
        x = LEFTS[0] + 10 + 130 * k
        parts += [mark(shape, x, legend - 4, INK), text(x + 14, legend, name)]
    parts.append(text(LEFTS[1], legend, "colour: size of the picture, px", colour=FAINT))
    return "\n".join([*parts, "</svg>"]) + "\n"


def frame(name: str, x_axis: Axis, y_axis: Axis, counts: list[int], decades: range) -> list[str]:
    """A panel's heading, grid, ticks and axis labels."""
    left, right, bottom = x_axis.start, x_axis.end, y_axis.start
    parts = [text(left, TOP - 12, name, size=14, weight=600)]
    for decade in decades:
        y = y_axis.place(10.0**decade)
        parts.append(f'<line x1="{left}" y1="{y:.1f}" x2="{right}" y2="{y:.1f}" stroke="{GRID}"/>')
        parts.append(text(left - 8, y + 4, f"{10.0**decade:,.16g}", anchor="end", colour=FAINT))
    for n in counts:
        x = x_axis.place(n)
        parts.append(f'<line x1="{x:.1f}" y1="{bottom}" x2="{x:.1f}" y2="{bottom + 5}" stroke="{FAINT}"/>')
        parts.append(text(x, bottom + 20, in_words(n), anchor="middle", colour=FAINT))
    parts.append(f'<line x1="{left}" y1="{bottom}" x2="{right}" y2="{bottom}" stroke="{FAINT}"/>')
    parts.append(text((left + right) / 2, bottom + 42, "Gaussians in the scene (log)", anchor="middle"))
    middle = (y_axis.start + y_axis.end) / 2
    label = text(0, 0, "wall time, ms (log)", anchor="middle")
    return [*parts, f'<g transform="translate({left - 54},{middle}) rotate(-90)">{label}</g>']


def drawn(series: Series, x_axis: Axis, y_axis: Axis, colour: str) -> list[str]:
    """A series' marks, and the line through them if it is one."""
    places = [(x_axis.place(n), y_axis.place(ms)) for n, ms in series.points]
    parts = []
    if series.shape == "line":
        path = " ".join(f"{x:.1f},{y:.1f}" for x, y in places)
        parts.append(f'<polyline points="{path}" fill="none" stroke="{colour}" stroke-width="2"/>')
    return parts + [mark(series.shape, x, y, colour) for x, y in places]


def end_labels(series: list[Series], x_axis: Axis, y_axis: Axis, colours: dict[str, str]) -> list[str]:
    """The lines' names to the right of their ends, moved apart where they would overlap."""
    parts, lowest = [], math.inf
    for s in sorted(series, key=lambda s: s.points[-1][1]):
        n, ms = s.points[-1]
        lowest = min(y_axis.place(ms) + 4, lowest - 15)
        parts.append(text(x_axis.place(n) + 10, lowest, s.group, colour=colours[s.group], weight=600, size=12))
    return parts


def mark(shape: str, x: float, y: float, colour: str) -> str:
    if shape == "line":
        return f'<circle cx="{x:.1f}" cy="{y:.1f}" r="3.5" fill="{colour}"/>'
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


def in_words(count: int) -> str:
    """2,000,000 as 2M, 100,000 as 100k."""
    return f"{count / 1e6:g}M" if count >= 1e6 else f"{count / 1e3:g}k"
