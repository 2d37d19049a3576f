"""What is told of a removal: a summary as JSON, and a page with pictures of before and after and of every stage."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import asdict, replace
from html import escape
from pathlib import Path
from string import Template
from typing import Annotated, Any, get_origin, get_type_hints

import numpy as np

from . import __version__
from .files import write_atomically
from .frame import frame_of
from .gaussians import Gaussians
from .io.cameras import write_transforms
from .io.images import write_png
from .io.ply import SplatFile
from .job import RemovalJob
from .memory import peak_memory_mb
from .pictures import RULE_COLOURS
from .presets import RemovalSettings
from .progress import count_words
from .raster import render_bytes
from .run import RemovalResult, View
from .stages.charts import Chart
from .stages.reference import ReferenceChoice
from .stages.verdict import Verdict
from .stages.witness import spread

MOST_FLIPS = 24  # painted views in the flip-book
MOST_SCORES = 6  # views listed for each reference
STYLE = """
:root{color-scheme:light dark;--edge:#8884;--accent:#3b82f6}
body{font:15px/1.5 system-ui,sans-serif;max-width:1100px;margin:2rem auto;padding:0 1rem}
h1{font-size:1.6rem;margin:0}h2{font-size:1.15rem;margin:2rem 0 .6rem}
table{border-collapse:collapse;width:100%}td,th{text-align:left;padding:.3rem .6rem;border-bottom:1px solid var(--edge)}
td.n{text-align:right;font-variant-numeric:tabular-nums;white-space:nowrap}
.grid{display:grid;grid-template-columns:repeat(auto-fill,minmax(330px,1fr));gap:1rem}
figure{margin:0}.wide{grid-column:1/-1}figure img{width:100%;border-radius:6px;display:block}
figcaption{font-size:.85rem;opacity:.8;margin-top:.3rem}
.flip{position:relative}.flip img+img{position:absolute;inset:0;opacity:0;transition:opacity .15s}
.flip:hover img+img{opacity:1}
.book{max-width:720px}.book input{width:100%}
td:has(.bar){width:22%}.bar{background:var(--accent);height:.7rem;border-radius:3px;min-width:2px}
.score{font-size:1.1rem;display:flex;gap:.8rem;align-items:center}
.score div{width:12rem;background:var(--edge);border-radius:4px}.score div div{height:.9rem}
.warn{border-left:4px solid #f59e0b;padding:.2rem .8rem;margin:.4rem 0}
.dot{display:inline-block;width:.8em;height:.8em;border-radius:2px;margin:0 .3em 0 .8em}
""".strip()
PAGE = Template(
    """
<!doctype html><html lang=en><meta charset=utf-8><meta name=viewport content='width=device-width'>
<title>3D-GIMP report</title><style>$style</style><h1>3D-GIMP: object removed</h1>
<p>$facts</p>
$verdict$warnings
<h2>Before and after</h2><div class=grid>$pairs</div>
$variants$flips
<h2>Stages</h2>$stages
$charts$references
<h2>What each stage saw</h2><p>Filled views: raw, blended, and by which rule. $legend</p>
<div class=grid>$pictures</div>
<h2>Counts</h2>$counts
<details><summary>Settings</summary><pre>$settings</pre></details></html>
""".lstrip()
)
TURN = "[...nextElementSibling.children].forEach((page, k) => page.hidden = k != value)"  # of the flip-book's slider


def summary_of(
    job: RemovalJob,
    settings: RemovalSettings,
    file: SplatFile,
    results: Sequence[RemovalResult],  # of every variant
    warnings: Sequence[str],
    seconds: float,
) -> dict[str, Any]:
    """What `--summary` writes; its keys are an interface: the page, Blender's panel and others' scripts read them."""
    result = results[0]
    removed, added = int((~result.keep).sum()), len(result.added) if result.added else 0
    return {
        "version": __version__,
        "command": "remove",
        "seconds_total": round(seconds, 3),
        "stages": [asdict(s) for s in result.stages],
        "counts": {
            "gaussians_in": len(file.gaussians),
            "removed": removed,
            "added": added,
            "gaussians_out": len(file.gaussians) - removed + added,
            "lifted": result.lifted,
            "changed": result.changed,
            **_cost(file, result.added),
            "views": result.views,
            "hole_pixels": result.hole_pixels,
            "open_pixels": result.open_pixels,
        },
        "verdict": asdict(result.verdict) if result.verdict else None,
        "selection": result.selection,
        "proposed": result.proposed,
        "shadow": result.shadow,
        "reflection": result.reflection,
        "charts": [
            {
                "kind": chart.kind,
                "texels": int(chart.there.sum()),
                "hole_texels": int(chart.hole.sum()),
                "photos_median": float(np.median(chart.photos[chart.known])) if chart.known.any() else 0.0,
            }
            for chart in result.charts
        ],
        "refined_views": result.refined_views,
        "references": [asdict(choice) for choice in result.references],
        "settings": {"preset": job.preset, "reference": job.reference, **asdict(settings)},
        "warnings": [*warnings, *result.warnings],
        "peak_memory_mb": round(peak_memory_mb(), 1),
        "variants": [
            {
                "out": str(out),
                "added": len(variant.added) if variant.added else 0,
                "changed": variant.changed,
                "open_pixels": variant.open_pixels,
                "score": variant.verdict.score if variant.verdict else None,
            }
            for out, variant in zip(job.outs(), results)
        ],
    }


def _cost(file: SplatFile, added: Gaussians | None) -> dict[str, int]:
    """What the new Gaussians need: bytes in the file (binary ones), and how many use which SH degree."""
    if added is None or not len(added):
        return {}
    used = (added.sh != 0).any(2)
    highest = np.ceil(np.sqrt(used.shape[1] - used[:, ::-1].argmax(1))).astype(int) - 1
    degrees = np.where(used.any(1), highest, 0)
    cost = {f"added_of_degree_{d}": int((degrees == d).sum()) for d in range(added.sh_degree + 1)}
    if file.table.format == "ascii":
        return cost
    return {"added_bytes": len(added) * file.table.rows.dtype.itemsize, **cost}


def write_removal_report(
    folder: Path, scene: Gaussians, views: Sequence[View], variants: Sequence[RemovalResult], summary: dict[str, Any]
) -> Path:
    """Write index.html and its pictures into `folder`; returns the page's path."""
    result, frame = variants[0], frame_of(scene, [v.camera for v in views])
    after = scene.take(result.keep).extended(result.added)

    def drawn(gaussians: Gaussians, view: View) -> np.ndarray:
        return render_bytes(frame.scene(gaussians), frame.camera(view.camera))

    def image(name: str, picture: np.ndarray, words: str = "") -> str:
        write_png(folder / name, picture)
        return f"<img src='{name}' alt='{words}'>"

    parts: dict[str, list[str]] = {"pairs": [], "flips": [], "pictures": [], "variants": []}
    for k, view in enumerate(spread(views, 6)):
        before = image(f"before_{k}.png", drawn(scene, view), "before")
        pair = f"<div class=flip>{before}{image(f'after_{k}.png', drawn(after, view), 'after')}</div>"
        parts["pairs"].append(_figure(pair, f"{view.camera.id} – hover to see it without the object"))
    painted = list(result.painted.items())
    for k, (camera_id, picture) in enumerate(painted[:: max(1, -(-len(painted) // MOST_FLIPS))]):
        parts["flips"].append(_figure(image(f"view_{k:02d}.png", picture), camera_id, " hidden" if k else ""))
    if len(variants) > 1:
        touched = [int((result.painted.get(v.camera.id, v.image) != v.image).sum()) for v in views]
        view = views[int(np.argmax(touched))]
        for k, variant in enumerate(variants, 1):
            picture = drawn(scene.take(variant.keep).extended(variant.added), view)
            parts["variants"].append(_figure(image(f"variant_{k}.png", picture), summary["variants"][k - 1]["out"]))
    write_charts(folder / "charts", result.charts)
    for number, shown in enumerate((p for p in result.pictures if p.kind == "chart"), 1):
        write_png(folder / f"chart_{number}.png", shown.draw())
    for k, shown in enumerate(p for p in result.pictures if p.kind != "chart"):
        wide = " class=wide" if shown.kind in ("rules", "shadow", "refined") else ""
        parts["pictures"].append(_figure(image(f"stage_{k:02d}.png", shown.draw()), shown.title, wide))
    page = _page(summary, parts, result)
    write_atomically(folder / "index.html", lambda f: f.write(page.encode()))
    return folder / "index.html"


def write_charts(folder: Path, charts: Sequence[Chart]) -> None:
    """What --reference chart:N takes: N.png, the picture; N.hole.png, 255 where it has to be painted; and the cameras.

    The cameras can be read like any, but nobody took a photo there: none is a train frame.
    """
    if not charts:
        return
    for number, chart in enumerate(charts, 1):
        write_png(folder / f"{number}.png", chart.image)
        write_png(folder / f"{number}.hole.png", chart.hole)
    cameras = [replace(chart.camera, id=f"{number}.png", split="test") for number, chart in enumerate(charts, 1)]
    write_transforms(folder / "transforms.json", cameras)


def _page(summary: dict[str, Any], parts: dict[str, list[str]], result: RemovalResult) -> str:
    counts, stages = summary["counts"], summary["stages"]
    longest = max((s["seconds"] for s in stages), default=1) or 1
    timed = (
        (s["name"], f"{s['seconds']:.2f} s", _bar(s["seconds"] / longest), f"{s['confidence']:.0%}", s["reason"])
        for s in stages
    )
    legend = (f"<span class=dot style='background:rgb{rgb}'></span>{words}" for words, rgb in RULE_COLOURS.values())
    numbers = (counts | summary.get("selection", {})).items()
    return PAGE.substitute(
        style=STYLE,
        facts=f"{count_words(counts)}, {summary['seconds_total']:.1f} s, "
        f"peak memory {summary['peak_memory_mb']:.0f} MB, version {escape(summary['version'])}.",
        verdict=_verdict(summary.get("verdict")),
        warnings="".join(f"<p class=warn>{escape(w)}</p>" for w in summary["warnings"]),
        pairs="".join(parts["pairs"]),
        variants=f"<h2>Variants</h2><div class=grid>{''.join(fills)}</div>" if (fills := parts["variants"]) else "",
        flips=_flip_book(parts["flips"]),
        stages=_table(".n.n.", timed, ("stage", "time", "", "confidence", "what happened")),
        charts=_charts(result.charts, summary),
        references=_references(result.references),
        legend="".join(legend),
        pictures="".join(parts["pictures"]),
        counts=_table(".n", ((k.replace("_", " "), f"{v:,}") for k, v in numbers)),
        settings=escape(json.dumps(summary["settings"], indent=1)),
    )


class _Html(str):
    """Text that is HTML already."""


def _table(kinds: str, rows: Iterable[Sequence[str]], head: Sequence[str] = ()) -> str:
    """A table; the kind of a column is n for numbers, else a dot."""
    lines = ["".join(f"<th>{words}" for words in head)] if head else []
    for row in rows:
        cells = (cell if isinstance(cell, _Html) else escape(cell) for cell in row)
        lines.append("".join(f"<td{' class=n' * (kind == 'n')}>{cell}</td>" for kind, cell in zip(kinds, cells)))
    return f"<table>{''.join(f'<tr>{line}</tr>' for line in lines)}</table>"


def _bar(share: float) -> _Html:
    return _Html(f"<div class=bar style='width:{share:.0%}'></div>")


def _figure(content: str, caption: str, attributes: str = "") -> str:
    return f"<figure{attributes}>{content}<figcaption>{escape(caption)}</figcaption></figure>"


def _verdict(verdict: dict[str, Any] | None) -> str:
    """The score as a bar from red to green, what it comes to, and its figures."""
    if verdict is None:
        return ""
    score, words = verdict["score"], [escape(w) for w in verdict["words"]]
    bar = f"<div><div style='width:{score:.0%};background:hsl({120 * score:.0f} 60% 45%)'></div></div>"
    figures = (
        (name.replace("_", " "), f"{verdict[name]:.3f}", kind.__metadata__[0])
        for name, kind in get_type_hints(Verdict, include_extras=True).items()
        if get_origin(kind) is Annotated and verdict[name] is not None
    )
    return (
        f"<p class=score>{bar}<b>{score:.2f}</b>{words[0]}</p><ul>{''.join(f'<li>{w}</li>' for w in words[1:])}</ul>"
        f"<details><summary>What the score is made of</summary>{_table('.n.', figures)}</details>"
    )


def _flip_book(figures: Sequence[str]) -> str:
    """The painted views one after the other, under a slider."""
    if not figures:
        return ""
    slider = f"<input type=range min=0 max={len(figures) - 1} value=0 aria-label=view oninput='{TURN}'>"
    return f"<h2>Painted views</h2><div class=book>{slider}<div>{''.join(figures)}</div></div>"


def _charts(charts: Sequence[Chart], summary: dict[str, Any]) -> str:
    """The hidden surfaces straight on: what photos show of each, and its completed picture."""
    rows, figures = [], ""
    for k, (chart, facts) in enumerate(zip(charts, summary.get("charts", ())), 1):
        numbers = (f"{facts['texels']:,}", f"{facts['hole_texels']:,}", f"{facts['photos_median']:.0f}")
        rows.append((f"chart:{k}", facts["kind"], *numbers, chart.reason))
        figures += _figure(f"<img src='chart_{k}.png' alt='hole'>", f"chart:{k}, what photos show; red: the hole")
        figures += _figure(f"<img src='charts/{k}.png' alt='completed'>", f"chart:{k}, completed")
    table = _table("..nnn.", rows, ("chart", "kind", "texels", "hole", "photos of a texel", "why"))
    words = "The surfaces behind the object, straight on. To paint one:"
    code = "<code>--reference chart:N --reference-image FILE</code>"
    return f"<h2>Charts</h2><p>{words} {code}.</p>{table}<div class=grid>{figures}</div>" if rows else ""


def _references(choices: Sequence[ReferenceChoice]) -> str:
    """Why each reference was chosen: the best views' scores as a table."""
    head, tables = ("view", "score", "", "shows of the hidden surface", "mean cos θ", "detail"), ""
    for choice in choices:
        rows = []
        for k, s in enumerate(choice.scores):
            chosen = s.camera_id == choice.camera_id
            name = _Html(f"<b>{escape(s.camera_id)}</b>") if chosen else s.camera_id
            numbers = (f"{s.score:.2f}", _bar(s.score), f"{s.covered:.0%}", f"{s.facing:.2f}", f"{s.detail:.0%}")
            if chosen or k < MOST_SCORES:
                rows.append((name, *numbers))
        tables += f"{_table('.n.nnn', rows, head)}<p>{len(choice.scores)} candidates</p>"
    return f"<h2>Reference views</h2>{tables}" if tables else ""
