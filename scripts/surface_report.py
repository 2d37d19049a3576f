"""What bench_surface.py found, as Markdown and as a page."""

from __future__ import annotations

from collections.abc import Iterator
from html import escape
from typing import Any

import numpy as np
from pages import Section, figure, html_table
from raster_report import table
from surface_chart import KINDS
from surface_pictures import COVERED, MISSED, MORE
from surface_scenes import SHADOW

from gimp3d.camera import output_name
from gimp3d.report import STYLE

LEGEND = {"never seen and in T": COVERED, "never seen and missed": MISSED, "in T though some view sees it": MORE}


def sections(results: dict[str, Any]) -> Iterator[Section]:
    yield Section(
        "Target regions",
        "Training views. Covered: share of the pixels that no view sees, without their 1-px rim, that T holds (wanted: "
        "99 %). Area: of T over that of never-seen pixels (wanted: 1.6 at most). Silhouette: overlap (IoU) with "
        "what the object truly hides. Seconds: CPU, of all threads together.",
        ["scene", "mode", "covered", "worst view", "area", "silhouette", "hole pixels", "CPU s"],
        [mask_row(r) for r in [*results["masks"], *mean_masks(results["masks"])]],
    )
    yield Section(
        "References",
        "Chosen among the training views by what they show of the surface that has to be made up: the share of it, how "
        "squarely (mean cosine) and how finely (of the finest view). Then what share the first reference covers, and "
        "what each further one, chosen greedily, adds.",
        ["scene", "chosen", "score", "shows", "squarely", "finely", "next best", "first, second … add"],
        [reference_row(r) for r in results["references"]],
    )
    yield Section(
        "Depth behind the object",
        "Test views, each as the reference. Relative error of z in never-seen pixels without their 1-px rim, mean over "
        "the views: median and 95th percentile; the worst view's median. Pixels with no depth are wrong by 100 %.",
        ["scene", "surface", "median", "95 %", "worst view", "refused"],
        list(depth_rows(results["depths"])),
    )
    yield Section(
        "Each test view as the reference",
        "T there, and the surface that the default settings complete.",
        ["scene", "view", "covered", "area", "median", "95 %", "what happened"],
        [reference_view_row(r) for r in results["depths"] if r["surface"] == "auto"],
    )
    yield Section(
        "Stability",
        "Mean over scenes and seeds, the worst scene in brackets. Overlap: IoU of T with T unperturbed, over the "
        "training views. Depth: relative error, mean over the test views of their medians. Poses: the training cameras "
        "are turned at random; depths: every view's rendered depths get errors of their own, smooth over a few pixels; "
        "the region is scaled or moved along its axes by a tenth of its size.",
        ["perturbed", "by", "overlap", "covered", "area", "depth error", "refused"],
        list(stability_rows(results["stability"])),
    )
    if results["shadows"]:
        yield Section(
            "Shadows and reflections of the object in the photos",
            "The same places with splats trained on photos that show them, against without.",
            ["place", "overlap", "covered", "area", "depth error"],
            [shadow_row(r) for r in results["shadows"]],
        )


def mask_row(row: dict[str, Any]) -> list[str]:
    shares = [f"{row[key]:.2%}" for key in ("covered", "worst_view_covered")]
    rest = [f"{row['silhouette_iou']:.3f}", f"{row['hole_pixels']:.0f}", f"{row['cpu_s']:.1f}"]
    return [row["scene"], row["mode"], *shares, f"{row['area']:.2f}", *rest]


def mean_masks(rows: list[dict[str, Any]]) -> Iterator[dict[str, Any]]:
    for mode in dict.fromkeys(r["mode"] for r in rows):
        of_mode = [r for r in rows if r["mode"] == mode and not r["scene"].endswith(SHADOW)]
        if not of_mode:
            continue
        numbers = [key for key, value in of_mode[0].items() if not isinstance(value, str)]
        yield {
            "scene": "mean without shadows",
            "mode": mode,
            **{key: float(np.mean([r[key] for r in of_mode])) for key in numbers},
        }


def reference_row(row: dict[str, Any]) -> list[str]:
    if "refused" in row:
        return [row["scene"], row["refused"], *[""] * 6]
    first = row["chosen"]
    others = ", ".join(f"{output_name(r['view'])} {r['score']:.2f}" for r in row["runners_up"])
    steps = ", ".join(f"{s['adds']:.1%}" for s in row["plan"])
    shares = [f"{first['covered']:.1%}", f"{first['facing']:.2f}", f"{first['detail']:.0%}"]
    return [row["scene"], output_name(first["camera_id"]), f"{first['score']:.2f}", *shares, others, steps]


def depth_rows(rows: list[dict[str, Any]]) -> Iterator[list[str]]:
    for scene, surface in dict.fromkeys((r["scene"], r["surface"]) for r in rows):
        of_both = [r for r in rows if (r["scene"], r["surface"]) == (scene, surface)]
        done = [r for r in of_both if "refused" not in r]
        refused = str(len(of_both) - len(done) or "")
        cells = ["", "", ""]
        if done:
            medians = [r["median"] for r in done]
            cells = [f"{x:.2%}" for x in (np.mean(medians), np.mean([r["p95"] for r in done]), max(medians))]
        yield [scene, surface, *cells, refused]


def reference_view_row(row: dict[str, Any]) -> list[str]:
    numbers = [f"{row['covered']:.2%}", f"{row['area']:.2f}"] if "covered" in row else ["", ""]
    errors = [f"{row[key]:.2%}" for key in ("median", "p95")] if "median" in row else ["", ""]
    return [row["scene"], output_name(row["view"]), *numbers, *errors, row.get("refused") or row["reason"]]


def stability_rows(rows: list[dict[str, Any]]) -> Iterator[list[str]]:
    headings = {"none": "nothing", **{kind: heading for kind, heading, *_ in KINDS}}
    for kind, label in dict.fromkeys((r["kind"], r["label"]) for r in rows):
        same = [r for r in rows if (r["kind"], r["label"]) == (kind, label)]
        done = [r for r in same if "refused" not in r]
        cells = ["", "", "", ""]
        if done:
            columns = {key: [r[key] for r in done] for key in ("iou", "covered", "area", "median")}
            cells = [
                f"{np.mean(columns['iou']):.3f} ({min(columns['iou']):.3f})",
                f"{np.mean(columns['covered']):.2%} ({min(columns['covered']):.2%})",
                f"{np.mean(columns['area']):.2f} ({max(columns['area']):.2f})",
                f"{np.mean(columns['median']):.2%} ({max(columns['median']):.2%})",
            ]
        refused = sum(r.get("references_refused", 0) for r in done)
        words = [f"{len(same) - len(done)} runs"] * (len(done) < len(same)) + [f"{refused} views"] * (refused > 0)
        yield [headings[kind], "" if kind == "none" else label, *cells, ", ".join(words)]


def shadow_row(row: dict[str, Any]) -> list[str]:
    pairs = [(key, "{:.2%}") for key in ("covered",)] + [("area", "{:.2f}"), ("median", "{:.2%}")]
    return [
        row["scene"],
        f"{row['iou'][1]:.3f} (worst view {row['worst_iou'][1]:.3f})",
        *(f"{form.format(row[key][0])} → {form.format(row[key][1])}" for key, form in pairs),
    ]


def markdown(results: dict[str, Any]) -> str:
    """The results as tables."""
    parts = ["# Where a removal fills, and on what surface\n", f"{about(results)}\n"]
    for section in sections(results):
        parts += [f"## {section.title}\n", f"{section.words}\n", table(section.head, section.rows)]
    return "\n".join(parts)


def about(results: dict[str, Any]) -> str:
    host = results["machine"]
    quick = " Quick: few scenes and perturbations." if results["quick"] else ""
    return f"Scenes: {', '.join(results['scenes'])}. {host['cpu']}, {host['cores']} cores.{quick}"


def page(results: dict[str, Any], charts: dict[str, str]) -> str:
    """Tables, charts (name → SVG) and the sheets of pictures that lie beside the page."""
    tables = "".join(html_table(s) for s in sections(results))
    drawn = "".join(f"<figure class=chart>{svg}</figure>" for svg in charts.values())
    dots = "".join(f"<span class=dot style='background:rgb{c}'></span>{escape(w)}" for w, c in LEGEND.items())
    sheets = "".join(figure(name) for name in results["pictures"])
    return (
        "<!doctype html><html lang=en><meta charset=utf-8><meta name=viewport content='width=device-width'>"
        f"<title>Where a removal fills</title><style>{STYLE}\nfigure.chart svg{{width:100%;height:auto}}"
        "figure{margin:1rem 0}</style>"
        f"<h1>Where a removal fills, and on what surface</h1><p>{escape(about(results))}</p>{drawn}{tables}"
        f"<h2>Pictures</h2><p>{dots}; outline: what the object hides.</p>{sheets}</html>\n"
    )
