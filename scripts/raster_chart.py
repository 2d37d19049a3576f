"""The chart of bench_raster.py: milliseconds over the number of Gaussians. Both axes are logarithmic."""

from __future__ import annotations

import math

from chart import FAINT, INK, Axis, Series, drawn, end_labels, frame, group_colours, in_words, mark, page, text

WIDTH, HEIGHT = 960, 510
PLOT_WIDTH, PLOT_HEIGHT, TOP = 310, 310, 96
LEFTS = (80, 550)  # room for the lines' names to the right of each plot


def speed_chart(title: str, subtitle: str, panels: dict[str, list[Series]]) -> str:
    """One panel beside the other with the same axes."""
    series = [s for panel in panels.values() for s in panel]
    counts = sorted({n for s in series for n, _ in s.points})
    times = [ms for s in series for _, ms in s.points]
    decades = math.floor(math.log10(min(times))), math.ceil(math.log10(max(times) * 1.05))
    y_axis = Axis(10.0 ** decades[0], 10.0 ** decades[1], TOP + PLOT_HEIGHT, TOP)
    y_ticks = {10.0**d: f"{10.0**d:,.16g}" for d in range(decades[0], decades[1] + 1)}
    x_ticks = {n: in_words(n) for n in counts}
    colours = group_colours(series)
    parts = []
    for left, (name, panel) in zip(LEFTS, panels.items()):
        x_axis = Axis(counts[0] / 1.3, counts[-1] * 1.3, left, left + PLOT_WIDTH)
        parts += frame(name, x_axis, y_axis, x_ticks, y_ticks, "Gaussians in the scene (log)", "wall time, ms (log)")
        for s in panel:
            parts += drawn(s, x_axis, y_axis, colours[s.group])
        parts += end_labels([s for s in panel if s.shape == "line"], x_axis, y_axis, colours)
    shapes = {s.shape: s.name for s in series}
    legend = HEIGHT - 22
    for k, (shape, name) in enumerate(shapes.items()):
        x = LEFTS[0] + 10 + 130 * k
        parts += [mark(shape, x, legend - 4, INK), text(x + 14, legend, name)]
    parts.append(text(LEFTS[1], legend, "colour: size of the picture, px", colour=FAINT))
    return page(WIDTH, HEIGHT, title, subtitle, parts)
