"""A one-page HTML report of a removal: before and after, what each stage saw, how long it took."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import replace
from html import escape
from pathlib import Path
from string import Template
from typing import Any, NamedTuple

import cv2
import numpy as np

from .files import write_atomically
from .gaussians import Gaussians
from .geometry import disparity_of
from .io.cameras import write_transforms
from .io.images import write_png
from .pipeline import Picture, RemovalResult, View, render_bytes
from .progress import count_words
from .stages.charts import Chart
from .stages.propagate import Rule
from .stages.reference import ReferenceChoice

RULE_COLOURS = {
    Rule.EVIDENCE: ("seen in this photo", (70, 160, 90)),
    Rule.OWN_PIXELS: ("fitted to this view's own pixels, or (paper) mapped from them", (70, 120, 220)),
    Rule.RETARGETED: ("this view's own pixels, found near the mapped ones", (60, 190, 220)),
    Rule.OTHER_VIEW: ("the mapped source as another view shows it", (160, 90, 200)),
    Rule.REFERENCE: ("warped from the reference", (240, 170, 50)),
    Rule.UNREACHED: ("not reached by this reference", (220, 60, 60)),
}
MEANINGS = {  # of the verdict's figures
    "open_share": "share of the hole that stays open",
    "remains": "share of the object's pixels that still look like it",
    "haze": "blend weight before the surface behind the object",
    "ring_fidelity": "dB that the surroundings gained or lost against photos",
    "sharpness": "detail of what was filled over that of its surroundings",
    "agreement": "share of the object's pixels that look as photos, or other views, show the place",
    "invented": "share of the object's pixels that no photo and no picture shows",
    "expected_error": "dB by which the object's pixels are probably worse than its surroundings were",
}
MOST_FLIPS = 24  # painted views in the flip-book
MOST_SCORES = 6  # views listed for each reference
PLOT_LOW, PLOT_HIGH = 56, 424  # px between which a plot of 480 px has its axes
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


def write_removal_report(
    folder: Path, scene: Gaussians, views: Sequence[View], variants: Sequence[RemovalResult], summary: dict[str, Any]
) -> Path:
    """Write index.html and its pictures into `folder`; returns the page's path."""
    result, after = variants[0], _filled(scene, variants[0])
    parts: dict[str, list[str]] = {"pairs": [], "flips": [], "pictures": [], "variants": []}
    for k, view in enumerate(views[n * len(views) // 6] for n in range(min(6, len(views)))):
        names = (f"before_{k}.png", f"after_{k}.png")
        for name, gaussians in zip(names, (scene, after)):
            write_png(folder / name, render_bytes(gaussians, view.camera))
        pair = f"<div class=flip><img src='{names[0]}' alt='before'><img src='{names[1]}' alt='after'></div>"
        parts["pairs"].append(_figure(pair, f"{view.camera.id} – hover to see it without the object"))
    painted = list(result.painted.items())
    for k, (camera_id, image) in enumerate(painted[:: max(1, -(-len(painted) // MOST_FLIPS))]):
        write_png(folder / f"view_{k:02d}.png", image)
        parts["flips"].append(_figure(_image(f"view_{k:02d}.png"), camera_id, " hidden" if k else ""))
    if len(variants) > 1:
        view = max(views, key=lambda v: _touched(v, result))
        for k, variant in enumerate(variants, 1):
            write_png(folder / f"variant_{k}.png", render_bytes(_filled(scene, variant), view.camera))
            parts["variants"].append(_figure(_image(f"variant_{k}.png"), summary["variants"][k - 1]["out"]))
    write_charts(folder / "charts", result.charts)
    for number, picture in enumerate((p for p in result.pictures if p.kind == "chart"), 1):
        write_png(folder / f"chart_{number}.png", draw(picture))
    for k, picture in enumerate(p for p in result.pictures if p.kind != "chart"):
        write_png(folder / f"stage_{k:02d}.png", draw(picture))
        wide = " class=wide" if picture.kind in ("rules", "shadow", "refined") else ""
        parts["pictures"].append(_figure(_image(f"stage_{k:02d}.png"), picture.title, wide))
    page = _page(summary, parts, result)
    write_atomically(folder / "index.html", lambda f: f.write(page.encode()))
    return folder / "index.html"


def _filled(scene: Gaussians, result: RemovalResult) -> Gaussians:
    kept = scene.take(result.keep)
    return kept if result.added is None else kept.extended(result.added)


def _touched(view: View, result: RemovalResult) -> int:
    """How many values of the view the removal changed."""
    painted = result.painted.get(view.camera.id)
    return 0 if painted is None else int((painted != view.image).sum())


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


def draw(picture: Picture) -> np.ndarray:
    """A stage's result as a picture, [H, W, 3] uint8."""
    image, data = picture.image, picture.data
    if picture.kind in ("mask", "chart"):
        return tinted(image, data[0], (230, 60, 60))
    if picture.kind == "shadow":
        light, lifted = data
        return np.hstack([image, np.repeat(light[..., None], 3, axis=2), lifted])
    if picture.kind == "refined":
        return np.hstack([data[0], image])
    if picture.kind == "rules":
        marked = image
        for rule, (_, colour) in RULE_COLOURS.items():
            marked = tinted(marked, data[0] == rule, colour, 0.35)
        return np.hstack([data[1], image, marked])
    if picture.kind == "mapping":
        return offset_colours(image, *data)
    if picture.kind == "depth":
        return relief(*data)
    return fit_plot(*data) if picture.kind == "fit" else outlined(image, data[0])


def tinted(
    image: np.ndarray,  # [H, W, 3] uint8
    mask: np.ndarray,  # [H, W] bool
    colour: tuple[int, int, int],
    strength: float = 0.5,
) -> np.ndarray:
    """The image with a colour laid over the mask."""
    mixed = (1 - strength) * image + strength * np.array(colour)
    return np.where(mask[..., None], mixed, image).astype(np.uint8)


def outlined(image: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """The image with the mask's outline drawn on it."""
    contours, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    return cv2.drawContours(image.copy(), contours, -1, (230, 60, 60), 1)


def relief(
    depth: np.ndarray,  # [H, W] z, 0 = nothing
    mask: np.ndarray,  # [H, W] bool, outlined
) -> np.ndarray:
    """Depth as colour, shaded like a relief."""
    disparity, there = disparity_of(depth).astype(np.float64), depth > 0
    low, high = np.percentile(disparity[there], [2, 98]) if there.any() else (0.0, 1.0)
    span = max(high - low, 1e-12)
    levels = (np.clip((disparity - low) / span, 0, 1) * 255).astype(np.uint8)
    shade = np.clip(1 + 12 * np.gradient(disparity, axis=0) / span, 0.6, 1.3)[..., None]
    shaded = np.clip(cv2.applyColorMap(levels, cv2.COLORMAP_VIRIDIS)[..., ::-1] * shade, 0, 255)
    return outlined(np.where(there[..., None], shaded, 40).astype(np.uint8), mask)


class FitAxes(NamedTuple):
    """Where a plot shows (prior, disparity): nearly all pairs fill it, outliers stay outside."""

    first: np.ndarray  # [2] at its lower left corner
    last: np.ndarray  # [2] at its upper right one

    @classmethod
    def around(cls, ring: np.ndarray) -> FitAxes:
        low, high = np.percentile(ring, [1, 99], axis=0)
        half = np.maximum(high - low, 1e-9) / 2 * 1.1
        return cls((low + high) / 2 - half, (low + high) / 2 + half)

    def place(self, points: np.ndarray) -> np.ndarray:
        """Pixels [..., 2] of (prior, disparity)."""
        share = (points - self.first) / (self.last - self.first)
        return PLOT_LOW + (PLOT_HIGH - PLOT_LOW) * np.stack([share[..., 0], 1 - share[..., 1]], -1)

    def line(self, line: np.ndarray) -> np.ndarray:
        """Pixels [2, 2] of the ends of the line disparity = slope · prior + offset."""
        return self.place(np.array([(m, line[0] * m + line[1]) for m in (self.first[0], self.last[0])]))


def fit_plot(
    ring: np.ndarray,  # [N, 2] (prior, scene's disparity) of pixels round the hole
    line: np.ndarray,  # [2] (slope, offset) fitted to them
    scale: np.ndarray,  # s_f, one number: the slope as far as the prior is believed; 0 = it is not used
) -> np.ndarray:
    """How s_f was measured: the scene's disparity over the prior, and the line fitted; [size, size, 3] uint8."""
    ink, faint, dots, drawn_line = (31, 35, 40), (223, 227, 232), (94, 85, 163), (198, 81, 2)
    low, high, axes = PLOT_LOW, PLOT_HIGH, FitAxes.around(ring)
    drawn = np.full((low + high, low + high, 3), 255, np.uint8)

    def write(words: str, x: int, y: int, size: float = 0.38, colour: tuple[int, ...] = ink, width: int = 1) -> None:
        cv2.putText(drawn, words, (x, y), cv2.FONT_HERSHEY_SIMPLEX, size, colour, width, cv2.LINE_AA)

    for share in (0, 0.25, 0.5, 0.75, 1):
        at = round(low + share * (high - low))
        value = axes.first + share * (axes.last - axes.first)
        cv2.line(drawn, (at, low), (at, high), faint, 1)
        cv2.line(drawn, (low, low + high - at), (high, low + high - at), faint, 1)
        write(f"{value[0]:.3g}", at - 20, high + 20)
        write(f"{value[1]:.3g}", 6, low + high - at + 4)
    inside = ((ring >= axes.first) & (ring <= axes.last)).all(1)
    for x, y in np.rint(axes.place(ring[inside])).astype(int):
        cv2.circle(drawn, (int(x), int(y)), 1, dots, -1, cv2.LINE_AA)
    fitted = axes.line(line)
    if np.abs(fitted).max() < 1e6:  # OpenCV's coordinates are short
        start, end = ((round(float(x)), round(float(y))) for x, y in fitted)
        seen, start, end = cv2.clipLine((low, low, high - low + 1, high - low + 1), start, end)
        if seen:
            cv2.line(drawn, start, end, drawn_line, 2, cv2.LINE_AA)
    words = f"s_f = {float(scale.ravel()[0]):.3g}" if scale.any() else "s_f = 0: not used"
    write(f"{words} (fitted {float(line[0]):.3g})", low, 24, 0.55, drawn_line, 2)
    write("prior", (low + high) // 2 - 16, high + 44, 0.45)
    write("disparity of the scene", 6, 46, 0.45)
    return drawn


def offset_colours(image: np.ndarray, rows: np.ndarray, cols: np.ndarray) -> np.ndarray:
    """Offsets of a mapping field: hue is the direction, brightness the length."""
    y, x = np.mgrid[: rows.shape[0], : rows.shape[1]]
    dy, dx = (rows - y).astype(np.float32), (cols - x).astype(np.float32)
    length, angle = np.hypot(dx, dy), np.degrees(np.arctan2(dy, dx)) % 360
    there = rows >= 0
    longest = max(1.0, float(length[there].max())) if there.any() else 1.0
    hsv = np.stack([angle / 2, np.full_like(angle, 200), 80 + 175 * np.clip(length / longest, 0, 1)], -1)
    colour = cv2.cvtColor(hsv.astype(np.uint8), cv2.COLOR_HSV2RGB)
    return np.where(there[..., None], colour, image // 2)


def _page(summary: dict[str, Any], parts: dict[str, list[str]], result: RemovalResult) -> str:
    counts, stages = summary["counts"], summary["stages"]
    longest = max((s["seconds"] for s in stages), default=1) or 1
    timed = (
        (s["name"], f"{s['seconds']:.2f} s", _bar(s["seconds"] / longest), f"{s['confidence']:.0%}", s["reason"])
        for s in stages
    )
    legend = (
        f"<span class=dot style='background:rgb{colour}'></span>{words}" for words, colour in RULE_COLOURS.values()
    )
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


def _image(name: str, words: str = "") -> str:
    return f"<img src='{name}' alt='{words}'>"


def _verdict(verdict: dict[str, Any] | None) -> str:
    """The score as a bar from red to green, what it comes to, and its figures."""
    if verdict is None:
        return ""
    score, words = verdict["score"], [escape(w) for w in verdict["words"]]
    bar = f"<div><div style='width:{score:.0%};background:hsl({120 * score:.0f} 60% 45%)'></div></div>"
    figures = ((n.replace("_", " "), f"{verdict[n]:.3f}", m) for n, m in MEANINGS.items() if verdict[n] is not None)
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
        figures += _figure(_image(f"chart_{k}.png", "hole"), f"chart:{k}, what photos show; red: the hole")
        figures += _figure(_image(f"charts/{k}.png", "completed"), f"chart:{k}, completed")
    table = _table("..nnn.", rows, ("chart", "kind", "texels", "hole", "photos of a texel", "why"))
    words = (
        "The surfaces behind the object, straight on. To paint one: <code>--reference chart:N --reference-image FILE"
    )
    return f"<h2>Charts</h2><p>{words}</code>.</p>{table}<div class=grid>{figures}</div>" if rows else ""


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
