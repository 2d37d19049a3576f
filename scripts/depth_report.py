"""What bench_depth.py found, as tables and as a chart."""

from __future__ import annotations

from typing import Any

import numpy as np
from chart import COLOURS, FAINT, GRID, Axis, mark, page, text
from raster_report import table

Row = dict[str, Any]
WAYS = {  # in the chart, from the best to the worst kind
    "auto, other views": "default: planes or plate, and other views",
    "auto": "planes or plate, this view alone",
    "planar": "planes",
    "smooth": "thin plate",
    "harmonic": "membrane (paper without a prior)",
    "guided, true": "prior: true depth",
    "guided, gain, shift": "prior: true, unknown units",
    "guided, noise 5 %": "prior: white noise 5 %",
    "guided, bias 5 %": "prior: smooth errors 5 %",
    "membrane, bias 5 %": "  the same, membrane (paper, s_f measured)",
    "s_f = 0.1, bias 5 %": "  the same, s_f = 0.1 (paper)",
    "sign as printed, bias 5 %": "  the same, sign as printed",
}
WIDTH, LEFT, RIGHT, TOP, LINE = 960, 360, 930, 112, 30


def markdown(results: Row) -> str:
    """The results as tables."""
    parts = [
        "# Depth completion\n",
        f"Random cases from seed {results['first_seed']} on.\n",
        "## The scale of a prior\n",
        "RMSE of disparity in the hole, % of its range, mean over random reliefs; the prior has unknown gain and "
        "shift, and smooth errors as given. Membrane: the paper's form; plate: this program's, which continues the "
        "prior's error by a thin plate or its average. Best: the s_f (of 7 for the plate) that gives the least error, "
        "known from the true surface. Worse: share of cases in which the measured s_f does worse than none by more "
        "than 10 % (and by more than 0.1 % of the range).\n",
        scale_table(results["scale"]),
        "## Surfaces on random places\n",
        "Relative depth error in the hole, %: median / 95 %, means over places. Planes: share in which auto took "
        "them.\n",
        place_table(results["places"]),
    ]
    if results["scenes"]:
        parts += [
            "## Scenes rendered with and without the object\n",
            "Relative depth error, %: median / 95 %, means over the test views. Ring: the splats' own error within "
            "24 px of the hole. Unseen: the part of the hole that no training view shows.\n",
            "### What counts as a pixel's depth\n",
            source_table(results["scenes"]),
            "### How the hole is completed (surface depth)\n",
            way_table(results["scenes"]),
        ]
    return "\n".join(parts)


def scale_table(rows: list[Row]) -> str:
    groups = list(dict.fromkeys((r["kind"], r["error"]) for r in rows))
    lines = []
    for kind, error in [*groups, ("all", None)]:
        own = [r for r in rows if kind == "all" or (r["kind"], r["error"]) == (kind, error)]
        membrane, plate = mean_of(own, "membrane"), mean_of(own, "plate")
        lines.append(
            [
                kind,
                "" if error is None else f"{error:.0%}",
                *(f"{membrane[k]:.2f}" for k in ("none", "as printed", "0.1", "measured", "best")),
                f"{membrane['measured'] / membrane['best']:.2f}",
                f"{worse(own, 'membrane'):.1%}",
                *(f"{plate[k]:.2f}" for k in ("none", "measured", "best")),
                f"{plate['measured'] / plate['best']:.2f}",
                f"{worse(own, 'plate'):.1%}",
            ]
        )
    head = ["none", "as printed", "s_f = 0.1", "measured", "best", "ratio", "worse"]
    return table(["relief", "error", *head, "plate: none", "measured", "best", "ratio", "worse"], lines)


def mean_of(rows: list[Row], key: str) -> dict[str, float]:
    return {k: float(np.mean([r[key][k] for r in rows])) for k in rows[0][key]}


def worse(rows: list[Row], key: str) -> float:
    return float(np.mean([r[key]["measured"] > max(1.1 * r[key]["none"], r[key]["none"] + 0.1) for r in rows]))


def place_table(rows: list[Row]) -> str:
    surfaces = ("harmonic", "smooth", "planar", "auto")
    lines = []
    for kind in [*dict.fromkeys(r["kind"] for r in rows), "all"]:
        own = [r for r in rows if kind in ("all", r["kind"])]
        cells = [pair([r[s] for r in own if r[s] is not None]) for s in surfaces]
        lines.append([kind, *cells, f"{np.mean([r['planes'] for r in own]):.0%}"])
    return table(["place", *surfaces, "planes"], lines)


def pair(found: list[dict[str, float]]) -> str:
    """Means of medians and of 95th percentiles."""
    found = [f for f in found if not np.isnan(f["median"])]
    if not found:
        return "–"
    return f"{np.mean([f['median'] for f in found]):.2f} / {np.mean([f['p95'] for f in found]):.2f}"


def source_table(rows: list[Row]) -> str:
    lines = []
    for scene in dict.fromkeys(r["scene"] for r in rows):
        for source in dict.fromkeys(r["source"] for r in rows):
            own = [r for r in rows if (r["scene"], r["source"]) == (scene, source)]
            bias = float(np.mean([r["ring"]["bias"] for r in own]))
            cells = [pair([r["hole"] for r in own if r["way"] == way]) for way in ("harmonic", "auto")]
            lines.append([scene, source, pair([r["ring"] for r in own]), f"{bias:+.2f}", *cells])
    return table(["scene", "depth", "ring", "ring's bias", "harmonic", "auto"], lines)


def way_table(rows: list[Row]) -> str:
    rows = [r for r in rows if r["source"] == "surface"]
    scenes = list(dict.fromkeys(r["scene"] for r in rows))
    lines = [["ring", *(pair([r["ring"] for r in rows if r["scene"] == s]) for s in scenes), ""]]
    for way in dict.fromkeys(r["way"] for r in rows):
        own = [r for r in rows if r["way"] == way]
        cells = [pair([r["hole"] for r in own if r["scene"] == s]) for s in scenes]
        lines.append([way, *cells, pair([r["unseen"] for r in own])])
    return table(["way", *scenes, "unseen, all"], lines)


def draw_chart(rows: list[Row]) -> str:
    """Median errors of each way in each scene; a bar in the scene's colour at the splats' own error on the ring."""
    rows = [r for r in rows if r["source"] == "surface"]
    scenes = list(dict.fromkeys(r["scene"] for r in rows))
    ways = [w for w in WAYS if any(r["way"] == w for r in rows)]
    bottom = TOP + LINE * len(ways)
    axis = Axis(0.1, 20.0, LEFT, RIGHT)
    parts = []
    for value in (0.1, 0.2, 0.5, 1, 2, 5, 10, 20):
        x = axis.place(value)
        parts.append(f'<line x1="{x:.1f}" y1="{TOP - 14}" x2="{x:.1f}" y2="{bottom}" stroke="{GRID}"/>')
        parts.append(text(x, bottom + 18, f"{value:g}", anchor="middle", colour=FAINT))
    parts.append(text((LEFT + RIGHT) / 2, bottom + 40, "median relative depth error in the hole, % (log)", "middle"))
    for k, scene in enumerate(scenes):
        colour = COLOURS[k % len(COLOURS)]
        parts += [mark("dot", LEFT + 130 * k, 84, colour), text(LEFT + 10 + 130 * k, 88, scene, colour=colour)]
        own = [r for r in rows if r["scene"] == scene]
        x = axis.place(float(np.mean([r["ring"]["median"] for r in own])))
        line = f'<line x1="{x:.1f}" y1="{TOP - 14}" x2="{x:.1f}" y2="{bottom}" stroke="{colour}"'
        parts.append(f'{line} stroke-dasharray="2 4" opacity="0.8"/>')
        for n, way in enumerate(ways):
            found = [r["hole"]["median"] for r in own if r["way"] == way]
            if found:
                place = min(max(axis.place(float(np.mean(found))), LEFT), RIGHT)
                parts.append(mark("dot", place, TOP + LINE * n + 6, colour))
    for n, way in enumerate(ways):
        words = WAYS[way]
        weight = 600 if "default" in words else 400
        parts.append(text(LEFT - 14, TOP + LINE * n + 10, words.strip(), "end", weight=weight))
    title = "How right the completed depth is"
    about = "Scenes with known truth, means over six views each; dotted: the splats' own error round the hole."
    return page(WIDTH, bottom + 60, title, about, parts)
