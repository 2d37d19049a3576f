"""What bench_propagate.py found, as tables and as a chart."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from chart import Axis, Series, drawn, end_labels, frame, group_colours, page, text
from propagate_ablation import EXTRA, MAPPED, METHODS, STEPS, UNBLENDED, UNFILLED, WARP
from raster_report import shown, table

MASKS = ("mask", "unseen", "painted")
LOW = 30.0  # dB below which the warped reference has failed
WIDTH, HEIGHT, TOP, PLOT = 1240, 500, 104, 300


def markdown(results: dict[str, Any]) -> str:
    host = results["machine"]
    parts = [
        "# Propagation\n",
        f"{host['cpu']}, {host['cores']} cores; load at the start {host['load_at_start'][0]}.\n",
        "## Time\n",
        "A made room with a hole of the share given; loads, learning and blending included. CPU is that of all "
        "threads together.\n",
        table(
            ["views", "size", "hole", "wall, s", "CPU, s", "CPU per view, ms", "Poisson's share"],
            [
                [
                    r["views"],
                    shown(r["size"]),
                    f"{r['hole']:.1%}",
                    f"{r['wall_s']:.1f}",
                    f"{r['cpu_s']:.1f}",
                    f"{r['cpu_ms_per_view']:.0f}",
                    f"{r['poisson_share']:.0%}",
                ]
                for r in results["speed"]
            ],
        ),
        "## Memory\n",
        table(
            ["views", "size", "peak above the room, MiB", "of it results", "all views at once would be"],
            [
                [r["views"], shown(r["size"]), *(f"{r[k]:.0f}" for k in ("peak_mib", "kept_mib", "all_views_mib"))]
                for r in results["memory"]
            ],
        ),
        "## The blend\n",
        table(
            ["size", "views", "unknowns", "largest error, grey levels", "mean error", "pixels changed outside"],
            [
                [
                    shown(r["size"]),
                    r["views"],
                    r["unknowns"],
                    f"{r['largest_grey_levels']:.4f}",
                    f"{r['mean_grey_levels']:.5f}",
                    r["changed_outside"],
                ]
                for r in results["blend"]
            ],
        ),
        "## Steps, on the made room\n",
        "PSNR of the painted pixels in dB; its dark veins are glossy, its light stone is not.\n",
        room_table(results["room"]),
    ]
    if results["scores"]:
        parts += [*steps(results), *mapping(results["scores"]), *agreement(results["consistency"])]
        parts += ["## Rules\n", rules_table(results["rules"])]
    return "\n".join(parts)


def room_table(rows: Sequence[dict[str, Any]]) -> str:
    views = sorted({r["view"] for r in rows})
    methods = [m for m in METHODS if any(r["method"] == m for r in rows)]
    cells = {(r["method"], r["view"]): r["psnr"] for r in rows}
    return table(
        ["step", *(f"view {v}" for v in views)], [[m, *(f"{cells[m, v]:.2f}" for v in views)] for m in methods]
    )


def mean_of(rows: Sequence[dict[str, Any]], method: str, mask: str, metric: str, scene: str | None = None) -> float:
    chosen = [r for r in rows if r["method"] == method and scene in (None, r["scene"])]
    return float(np.mean([r[mask][metric] for r in chosen]))


def steps(results: dict[str, Any]) -> list[str]:
    rows = results["scores"]
    scenes = list(dict.fromkeys(r["scene"] for r in rows))
    parts = [
        "## Steps, on scenes rendered with and without the object\n",
        "Painted test views, means. `mask`: what the object hides; `unseen`: what no training view sees of it; "
        "`painted`: pixels that one reference's propagation reaches. Sharpness: size of the Laplacian over the "
        "truth's.\n",
    ]
    for mask in MASKS:
        parts += [
            f"### {mask}\n",
            table(
                ["step", "PSNR", "SSIM", "FLIP", "sharpness", *(f"{s}, PSNR" for s in scenes)],
                [
                    [
                        m,
                        f"{mean_of(rows, m, mask, 'psnr'):.2f}",
                        *(f"{mean_of(rows, m, mask, k):.3f}" for k in ("ssim", "flip")),
                        f"{mean_of(rows, m, mask, 'sharpness'):.2f}",
                        *(f"{mean_of(rows, m, mask, 'psnr', s):.2f}" for s in scenes),
                    ]
                    for m in METHODS
                ],
            ),
        ]
    return parts


def mapping_gains(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Of every view: the warp's PSNR in the painted pixels, unblended and blended, and the mapping's."""
    by = {(r["scene"], r["view"], r["method"]): r["painted"] for r in rows}
    views = dict.fromkeys((r["scene"], r["view"]) for r in rows)
    return [
        {
            "scene": scene,
            "view": view,
            "unblended": by[scene, view, UNBLENDED]["psnr"],
            "warp": by[scene, view, WARP]["psnr"],
            "mapping": by[scene, view, MAPPED]["psnr"],
        }
        for scene, view in views
    ]


def mapping(rows: Sequence[dict[str, Any]]) -> list[str]:
    gains = mapping_gains(rows)
    low = [g["mapping"] - g["warp"] for g in gains if g["warp"] < LOW]
    high = [g["mapping"] - g["warp"] for g in gains if g["warp"] >= LOW]
    words = []
    for name, found in (("below", low), ("from", high)):
        if found:
            words.append(
                f"In the {len(found)} views where the blended warp is {name} {LOW:.0f} dB the mapping adds "
                f"{np.mean(found):+.2f} dB on average, {min(found):+.2f} at worst, {max(found):+.2f} at best."
            )
    return [
        "## Mapping against warping, view by view\n",
        " ".join(words) + "\n",
        table(
            ["scene", "view", "warp, not blended", "warp, blended", "with mapping", "gain"],
            [
                [
                    g["scene"],
                    g["view"],
                    *(f"{g[k]:.2f}" for k in ("unblended", "warp", "mapping")),
                    f"{g['mapping'] - g['warp']:+.2f}",
                ]
                for g in gains
            ],
        ),
    ]


def agreement(rows: Sequence[dict[str, Any]]) -> list[str]:
    methods = list(dict.fromkeys(r["method"] for r in rows))

    def mean(method: str, baseline: str, key: str) -> float:
        return float(np.mean([r[key] for r in rows if r["method"] == method and r["baseline"] == baseline]))

    angles = {b: mean(methods[0], b, "median_degrees") for b in ("short", "long")}
    return [
        "## Agreement between views\n",
        "Painted views warped to one another by the true depth, PSNR in the painted pixels; coverage: their share of "
        "`mask` that the other view shows. True views differ as well, by view dependence and resampling: `beyond` "
        "counts only what differs otherwise than in the truth. Sharpness: size of the Laplacian in the compared pixels "
        "over the truth's; blurred views agree easily.\n",
        table(
            [
                "step",
                *(f"{b} baselines ({angles[b]:.0f}°), dB" for b in angles),
                *(f"beyond, {b}" for b in angles),
                *(f"coverage, {b}" for b in angles),
                *(f"sharpness, {b}" for b in angles),
            ],
            [
                [
                    m,
                    *(f"{mean(m, b, 'psnr'):.2f}" for b in angles),
                    *("–" if m == "truth" else f"{mean(m, b, 'psnr_beyond'):.2f}" for b in angles),
                    *(f"{mean(m, b, 'coverage'):.0%}" for b in angles),
                    *(f"{mean(m, b, 'sharpness'):.2f}" for b in angles),
                ]
                for m in methods
            ],
        ),
    ]


def rules_table(rows: Sequence[dict[str, Any]]) -> str:
    names = [k for k in rows[0] if k != "scene"]
    return table(
        ["scene", *(n.lower().replace("_", " ") for n in names)],
        [[r["scene"], *(f"{r[n]:.0%}" for n in names)] for r in rows],
    )


def draw_chart(results: dict[str, Any]) -> str:
    """Time per view by the number of views and by size; what each step is worth."""
    parts = [*views_panel(results["speed"]), *sizes_panel(results["speed"])]
    if results["scores"]:
        parts += steps_panel(results["scores"])
    host = results["machine"]
    subtitle = f"hole of 8 % of the picture, blending included; {host['cpu']}, {host['cores']} cores"
    return page(WIDTH, HEIGHT, "Propagation: what it costs, and what each step is worth", subtitle, parts)


def views_panel(rows: Sequence[dict[str, Any]]) -> list[str]:
    size = rows[0]["size"]
    chosen = [r for r in rows if r["size"] == size]
    x_axis = Axis(0, max(r["views"] for r in chosen) * 1.05, 80, 370, logarithmic=False)
    most = 1.4 * max(max(r["cpu_ms_per_view"], 1e3 * r["wall_s"] / r["views"]) for r in chosen)
    step = next(s for s in (10, 20, 50, 100, 200, 500, 1000, 2000) if most <= 6 * s)
    y_axis = Axis(0, 6 * step, TOP + PLOT, TOP, logarithmic=False)
    series = [Series("CPU", "CPU per view", [(r["views"], r["cpu_ms_per_view"]) for r in chosen])]
    series.append(Series("wall", "wall per view", [(r["views"], 1e3 * r["wall_s"] / r["views"]) for r in chosen]))
    return panel(
        f"Views at {shown(size)}",
        series,
        x_axis,
        y_axis,
        {r["views"]: str(r["views"]) for r in chosen},
        {step * k: str(step * k) for k in range(7)},
        "views",
        "ms per view",
        labels_above=True,
    )


def sizes_panel(rows: Sequence[dict[str, Any]]) -> list[str]:
    best: dict[tuple[int, ...], dict[str, Any]] = {tuple(r["size"]): r for r in rows}
    chosen = sorted(best.values(), key=lambda r: r["size"][0])
    x_axis = Axis(0.1, 12, 470, 740)
    values = [r["cpu_ms_per_view"] for r in chosen]
    y_axis = Axis(min(values) * min(0.5, chosen[0]["poisson_share"]) / 2, max(values) * 2, TOP + PLOT, TOP)
    pixels = [r["size"][0] * r["size"][1] / 1e6 for r in chosen]
    series = [
        Series("all", "CPU per view", list(zip(pixels, values))),
        Series("poisson", "of it Poisson", [(p, v * r["poisson_share"]) for p, v, r in zip(pixels, values, chosen)]),
    ]
    ticks = {10.0**k: f"{10.0**k:g}" for k in range(-1, 6) if y_axis.low <= 10.0**k <= y_axis.high}
    return panel(
        "Size of the picture (log axes)",
        series,
        x_axis,
        y_axis,
        {p: f"{p:.1f}" for p in pixels},
        ticks,
        "million pixels",
        "ms per view",
        labels_above=True,
    )


def panel(
    heading: str,
    series: Sequence[Series],
    x_axis: Axis,
    y_axis: Axis,
    x_ticks: dict[float, str],
    y_ticks: dict[float, str],
    x_label: str,
    y_label: str,
    labels_above: bool = False,
) -> list[str]:
    colours = group_colours(series)
    parts = frame(heading, x_axis, y_axis, x_ticks, y_ticks, x_label, y_label)
    for s in series:
        parts += drawn(s, x_axis, y_axis, colours[s.group])
        if labels_above:
            x, y = s.points[-1]
            parts.append(
                text(
                    x_axis.place(x),
                    y_axis.place(y) - 12,
                    s.group,
                    anchor="end",
                    colour=colours[s.group],
                    weight=600,
                    size=12,
                )
            )
    return parts if labels_above else [*parts, *end_labels(series, x_axis, y_axis, colours)]


def steps_panel(rows: Sequence[dict[str, Any]]) -> list[str]:
    """One bar per step: ours green, the paper's orange."""
    methods = [m for m in METHODS if m not in (UNFILLED, EXTRA)]
    values = [mean_of(rows, m, "painted", "psnr") for m in methods]
    low = np.floor(min(values) / 5) * 5 - 5
    x_axis = Axis(low, np.ceil(max(values) / 5) * 5, 1020, 1190, logarithmic=False)
    parts = [text(x_axis.start - 205, TOP - 12, "Steps: PSNR of painted pixels, dB", size=14, weight=600)]
    height = PLOT / len(methods)
    for k, (method, value) in enumerate(zip(methods, values)):
        y = TOP + height * k
        ours = method in STEPS and STEPS[method].blend == "band"
        colour = "#1b7f5f" if ours else "#c65102" if method.startswith("paper") else "#8a929b"
        wide = x_axis.place(value) - x_axis.start
        parts.append(
            f'<rect x="{x_axis.start}" y="{y + 4:.1f}" width="{wide:.1f}" height="{height - 8:.1f}" fill="{colour}"/>'
        )
        parts.append(text(x_axis.start - 8, y + height / 2 + 4, method, anchor="end", size=12))
        parts.append(text(x_axis.place(value) + 5, y + height / 2 + 4, f"{value:.1f}", size=12))
    parts.append(text(x_axis.start, TOP + PLOT + 20, f"{low:.0f}", anchor="middle", size=12))
    parts.append(text(x_axis.end, TOP + PLOT + 20, f"{x_axis.high:.0f}", anchor="middle", size=12))
    return parts
