"""What bench_raster.py found, as tables and as a chart."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from chart import Series, in_words
from raster_chart import speed_chart


def markdown(results: dict[str, Any]) -> str:
    """The results as tables."""
    host, first, flops = results["machine"], results["first_call"], results["flops"]
    parts = [
        "# Speed of the rasteriser\n",
        f"{host['cpu']} ({host['architecture']}), {host['cores']} cores, {host['vectors']}; load at the start "
        f"{host['load_at_start'][0]}. FMA peak {results['peak_gflops_per_core']:.0f} GFLOP/s per core.\n",
        "rgb, alpha and expected depth, SH degree 3. Milliseconds, wall (CPU), best of several.\n",
        table(
            ["kind", "Gaussians", "picture", "threads", "forward", "backward"],
            [[*named(r), r["threads"], *(pair(r[name]) for name in ("forward", "backward"))] for r in results["speed"]],
        ),
        "## Blends per second\n",
        f"A lane is one Gaussian at one pixel: {flops['forward']} operations forward, {flops['backward']} backward.\n",
        table(
            ["kind", "Gaussians", "picture", "M lanes", "forward, G/s", "of peak", "backward, G/s", "of peak"],
            [
                [*named(r), f"{r['lanes'] / 1e6:.1f}", *rate(r["forward"]), *rate(r["backward"])]
                for r in results["blends"]
            ],
        ),
        "## A region\n",
        "Forward and backward of active Gaussians in a rectangle, against those of the whole scene and picture.\n",
        table(
            ["depths", "active", "threads", "first", "iteration", "whole", "CPU ratio", "wall ratio"],
            [
                [
                    r["depths"],
                    r["active"],
                    r["threads"],
                    *(pair(r[k]) for k in ("prepare", "iteration", "whole")),
                    r["cpu_ratio"],
                    r["wall_ratio"],
                ]
                for r in results["region"]
            ],
        ),
    ]
    versus = ["ours forward", "theirs", "wall ratio", "ours backward", "theirs", "wall ratio"]
    if results["prototype"]:
        parts += [
            "## The prototype\n",
            table(
                ["Gaussians", "picture", "threads", *versus],
                [[*named(r)[1:], r["threads"], *versus_cells(r)] for r in results["prototype"]],
            ),
        ]
    if torch := results["torch"]:
        parts += [
            "## Plain torch, tile by tile\n",
            f"{in_words(torch['n'])} Gaussians, {shown(torch['size'])}. Its picture differs from ours by "
            f"{torch['largest_difference']:.1e} at most, {torch['mean_difference']:.1e} in the mean.\n",
            table(["threads", *versus], [[r["threads"], *versus_cells(r)] for r in torch["rows"]]),
        ]
    parts += [
        "## First call and memory\n",
        f"First forward and backward of a process ({in_words(first['n'])}, {shown(first['size'])}): "
        f"{first['cold_s']:.1f} s compiling, {first['warm_s']:.2f} s with kernels in the cache.\n",
        table(
            ["Gaussians", "picture", "scene, MiB", "after forward", "after backward"],
            [[*named(r)[1:], r["scene_mib"], r["forward_mib"], r["backward_mib"]] for r in results["memory"]],
        ),
    ]
    return "\n".join(parts)


def named(row: dict[str, Any]) -> list[str]:
    return [row.get("kind", ""), in_words(row["n"]), shown(row["size"])]


def pair(costs: dict[str, float]) -> str:
    return f"{costs['wall_ms']:.1f} ({costs['cpu_ms']:.1f})"


def rate(row: dict[str, float]) -> list[str]:
    return [f"{row['giga_lanes_per_s']:.2f}", f"{row['share_of_peak']:.0%}" if "share_of_peak" in row else "—"]


def versus_cells(row: dict[str, Any]) -> list[str]:
    return [
        cell
        for name in ("forward", "backward")
        for cell in (pair(row[name]["ours"]), pair(row[name]["theirs"]), f"{row[name]['wall_ratio']:.2f}")
    ]


def table(head: list[str], rows: list[list[Any]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "".join("| " + " | ".join(str(cell) for cell in line) + " |\n" for line in lines)


def draw_chart(results: dict[str, Any]) -> str:
    """Wall times with the most threads measured."""
    rows = [r for r in results["speed"] if r["kind"] == "3d"]
    threads = max(r["threads"] for r in rows)
    rows = [r for r in rows if r["threads"] == threads]
    others = [(r, "prototype", "diamond") for r in results["prototype"]]
    if torch := results["torch"]:
        others += [({**torch, **r}, "tiled torch", "square") for r in torch["rows"]]
    panels: dict[str, list[Series]] = {}
    for name, heading in (("forward", "Forward: the picture"), ("backward", "Backward: gradients of all parameters")):
        panel = panels.setdefault(heading, [])
        for size in dict.fromkeys(r["size"] for r in rows):
            points = [(r["n"], r[name]["wall_ms"]) for r in rows if r["size"] == size]
            panel.append(Series("gimp3d", shown(size), points))
        for row, who, shape in others:
            if row["threads"] == threads:
                panel.append(Series(who, shown(row["size"]), [(row["n"], row[name]["theirs"]["wall_ms"])], shape))
    host = results["machine"]
    subtitle = f"rgb, alpha and expected depth, SH degree 3; {threads} threads, {host['cpu']} ({host['vectors']})"
    return speed_chart("Wall time to draw Gaussians, and for the gradients", subtitle, panels)


def shown(size: Sequence[int]) -> str:
    return f"{size[0]}×{size[1]}"
