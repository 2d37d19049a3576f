"""Charts: the surfaces that the object hid, each seen straight on by a camera that nobody stood at.

A chart's picture is made of all photos with the object left out; what no photo shows is its hole.
"""

from __future__ import annotations

import re

from .draw import Chart as Chart
from .draw import draw_charts as draw_charts
from .draw import lay_planes as lay_planes
from .find import CHART as CHART
from .find import ChartSettings as ChartSettings
from .find import Laid as Laid
from .find import find_planes as find_planes
from .plane import Hits as Hits
from .plane import Plane as Plane
from .plane import extent as extent
from .plane import first_hits as first_hits
from .plane import pictured as pictured


def chart_number(reference: str | None) -> int | None:
    """N of the reference chart:N, counted from 1; None for a view's ID."""
    found = re.fullmatch(rf"{CHART}:(\d+)", reference or "")
    return int(found[1]) if found else None
