"""Charts: the surfaces that the object hid, each seen straight on by a camera that nobody stood at.

A chart's picture is made of all photos with the object left out; what no photo shows is its hole.
"""

from __future__ import annotations

import re

from .draw import Chart, draw_charts, lay_planes
from .find import CHART, ChartSettings, Laid, find_planes
from .plane import Hits, Plane, extent, first_hits, pictured

__all__ = [
    "CHART", "Chart", "ChartSettings", "Hits", "Laid", "Plane", "chart_number", "draw_charts", "extent", "find_planes",
    "first_hits", "lay_planes", "pictured",
]  # fmt: skip


def chart_number(reference: str | None) -> int | None:
    """N of the reference chart:N, counted from 1; None for a view's ID."""
    found = re.fullmatch(rf"{CHART}:(\d+)", reference or "")
    return int(found[1]) if found else None
