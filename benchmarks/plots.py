"""Charts by matplotlib: panels of lines and marks in one style, as SVG whose bytes depend on the numbers alone."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from io import StringIO
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from .command import write

COLOURS = ("#1b7f5f", "#c65102", "#5e55a3", "#b0246b", "#59636e")  # dark on white, apart for colour-blind eyes
INK, FAINT, GRID = "#1f2328", "#59636e", "#dfe3e8"
NAMES = 8.5  # points of the names at lines' ends
STYLE = {
    "svg.hashsalt": "gimp3d", "svg.fonttype": "none",  # words stay words
    "font.family": "sans-serif", "font.size": 9.5, "text.color": INK, "legend.frameon": False, "lines.markersize": 4.5,
    "axes.titlelocation": "left", "axes.titleweight": "bold", "axes.titlesize": 10, "axes.edgecolor": FAINT,
    "axes.spines.top": False, "axes.spines.right": False, "axes.grid": True, "axes.axisbelow": True,
    "grid.color": GRID, "xtick.color": FAINT, "ytick.color": FAINT,
}  # fmt: skip


@dataclass(frozen=True)
class Line:
    """Points of one thing; lines of a group have one colour."""

    name: str
    points: Sequence[tuple[float, float]]
    group: str = ""  # its name if empty
    style: str = "-"  # matplotlib's: "--" dashed, "none" marks alone
    marker: str = "o"
    hollow: bool = False


@dataclass(frozen=True)
class Panel:
    """Lines over one pair of axes."""

    heading: str
    lines: Sequence[Line]
    x_label: str
    y_label: str
    x_log: bool = True
    y_log: bool = True
    x_ticks: Mapping[float, str] = field(default_factory=dict)  # empty: each x
    level: float | None = None  # what is wanted, as a dotted line
    named: bool = True  # names stand at the lines' ends


@contextmanager
def figure(path: Path, title: str, subtitle: str, width: float, height: float) -> Iterator[Figure]:
    """A figure of so many inches, written when the block ends."""
    with mpl.rc_context(STYLE):
        fig = Figure(figsize=(width, height), layout="constrained")
        fig.suptitle(f"{title}\n{subtitle}", x=0.01, ha="left", fontsize=11)
        yield fig
        found = StringIO()
        fig.savefig(found, format="svg", metadata={"Date": None})
    write(path, found.getvalue())


def draw_panels(
    path: Path, title: str, subtitle: str, grid: Sequence[Sequence[Panel]], size: tuple[float, float]
) -> None:
    """Rows of as many panels, each so many inches large; one legend where lines are not named at their ends."""
    across = len(grid[0])
    groups = dict.fromkeys(line.group or line.name for row in grid for panel in row for line in panel.lines)
    colours = {group: COLOURS[k % len(COLOURS)] for k, group in enumerate(groups)}
    with figure(path, title, subtitle, across * size[0], len(grid) * size[1] + 0.6) as fig:
        one_scale = all(len({panel.y_label for panel in row}) == 1 for row in grid)
        axes = fig.subplots(len(grid), across, squeeze=False, sharey="row" if one_scale else False)
        handles: dict[str, Any] = {}
        for row, places in zip(grid, axes):
            ends = [draw_panel(ax, panel, colours) for panel, ax in zip(row, places)]
            for panel, ax, of_panel in zip(row, places, ends):  # by now the limits are those of all panels
                if panel.named:
                    name_ends(ax, of_panel)
                else:
                    handles |= {line.get_label(): line for line in ax.lines if not line.get_label().startswith("_")}
                if panel.y_log:
                    plain_log_ticks(ax.yaxis, ax.get_ylim())
                if one_scale and ax is not places[0]:
                    ax.set_ylabel("")
        if handles:
            fig.legend(handles.values(), handles, loc="outside lower left", ncols=8, fontsize=8.5)


End = tuple[float, float, str, str]  # of a line: x, y, its name and colour


def draw_panel(ax: Axes, panel: Panel, colours: Mapping[str, str]) -> list[End]:
    if panel.x_log:
        ax.set_xscale("log")
    if panel.y_log:
        ax.set_yscale("log")
    ends: list[End] = []
    for line in panel.lines:
        if line.points:
            x, y = zip(*line.points)
            colour = colours[line.group or line.name]
            face = "white" if line.hollow else colour
            ax.plot(x, y, line.marker, linestyle=line.style, color=colour, markerfacecolor=face, label=line.name)
            ends.append((x[-1], y[-1], line.name, colour))
    ticks = panel.x_ticks or {x: f"{x:g}" for line in panel.lines for x, _ in line.points}
    ax.set_xticks(list(ticks), list(ticks.values()))
    ax.minorticks_off()
    if panel.level is not None:
        ax.axhline(panel.level, color=INK, linestyle=":", linewidth=1)
    ax.set(title=panel.heading, xlabel=panel.x_label, ylabel=panel.y_label)
    return ends


def name_ends(ax: Axes, ends: Sequence[End]) -> None:
    """Names to the right of the axes at their heights, moved apart where they would overlap."""
    ax.get_xlim(), ax.get_ylim()  # the limits are found when they are asked for
    height = ax.get_window_extent().height
    step, lowest = 1.3 * NAMES / max(height * 72 / ax.figure.dpi, 1), -np.inf
    for x, y, words, colour in sorted(ends, key=lambda end: end[1]):
        share = float(ax.transAxes.inverted().transform(ax.transData.transform((x, y)))[1])
        lowest = max(share, lowest + step)
        ax.annotate(
            words, (x, y), (1.02, lowest), textcoords="axes fraction", color=colour, fontsize=NAMES, va="center",
            arrowprops={"arrowstyle": "-", "color": colour, "alpha": 0.25},
        )  # fmt: skip


def plain_log_ticks(axis: Any, found: Sequence[float]) -> None:
    """Powers of ten and, of few decades, steps between as plain numbers on a logarithmic axis."""
    low, high = min(found), max(found)
    steps = (1, 1.2, 1.5, 2, 2.5, 3, 4, 5, 6, 8) if high / low < 5 else (1, 2, 5) if high / low < 200 else (1,)
    ticks = [s * 10.0**d for d in range(-9, 10) for s in steps if low <= s * 10.0**d <= high]
    axis.set_ticks(ticks, labels=[f"{t:,.10g}" for t in ticks])
