"""What bench_real.py found: goals, scores, coverage and verdicts, as Markdown and as a page."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from html import escape
from typing import Any

import numpy as np
from pages import Section, figure, html_table
from raster_report import table
from real_scenes import NEAR
from scipy.stats import spearmanr

from gimp3d.report import STYLE

REAL = ("real_table", "real_bed", "kitchen_monkey", "tiles_mug")
MADE = ("desk", "corner", "gloss", "rocks")
GIVEN, BUILT_IN = "given", "built-in"
EMPTIED, TELEA, PAPER = "emptied box", "telea", "paper"
BASELINES = (EMPTIED, TELEA, PAPER)
BELOW_RING = {GIVEN: 1.0, BUILT_IN: 4.0}  # dB by which the mask may fall short of the ring, mean over the real scenes
HARM = 0.05  # dB that the surroundings may lose
COVERED, AREA = {"real": 0.97, "made": 0.985}, {"real": 2.0, "made": 1.6}  # of T, at least and at most
INVENTED = {"real_table": 0.03}  # share of the mask at most
SECONDS = {("kitchen_480", "balanced"): 20.0}  # at most
ORDER = 0.8  # Spearman's coefficient, at least
SCORES = (
    *("scene", "shadow", "method", "picture", "PSNR mask", "SSIM", "FLIP", "PSNR unseen", "SSIM", "FLIP"),
    *("not filled", "ring", "near", "in the shadow", "outside", "removed", "added", "open px", "seconds"),
)
Row = dict[str, Any]


@dataclass(frozen=True)
class Goal:
    """What is wanted of the results, and what was found."""

    name: str
    wanted: str
    found: str
    met: bool


def goals(results: dict[str, Any]) -> Iterator[Goal]:
    """Every goal about which something was measured."""
    rows = [r for r in results["rows"] if r["counts"]]
    runs = [r for r in rows if r["method"] not in BASELINES]
    for preset in dict.fromkeys(r["method"] for r in runs):
        own = [r for r in runs if r["method"] == preset]
        for kind in BELOW_RING:
            yield from _mean_below_ring(preset, kind, own)
        with_truth = [r | {"margin": _margin(r, rows)} for r in own if "psnr mask" in r]
        if with_truth:
            refused = sum("refused" in r for r in own)
            worst = min(with_truth, key=lambda r: r["margin"])
            met = worst["margin"] >= 0 and not refused
            words = f"{worst['margin']:+.2f} dB in {_which(worst)}" + _refused(refused)
            yield Goal(f"{preset}: mask against the better of emptied box and Telea, worst", "≥ 0 dB", words, met)
            worst = min(with_truth, key=gain)
            words, met = f"{gain(worst):+.2f} dB in {_which(worst)}", gain(worst) >= 0
            yield Goal(f"{preset}: mask against its own removal, not filled, worst", "≥ 0 dB", words, met)
            worst = min(with_truth, key=harm)
            words, met = f"{harm(worst):+.2f} dB in {_which(worst)}", harm(worst) >= -HARM
            yield Goal(f"{preset}: round the object against before, worst", f"≥ −{HARM:g} dB", words, met)
            worst = max(with_truth, key=lambda r: r["outside"])
            words, met = f"{worst['outside']:.1%} in {_which(worst)}", worst["outside"] == 0
            yield Goal(f"{preset}: new Gaussians outside the hidden volume, most", "none", words, met)
    yield from _coverage_goals([c for c in results["coverage"] if c["counts"]])
    for (scene, preset), most in SECONDS.items():
        for row in (r for r in runs if (r["scene"], r["method"]) == (scene, preset) and "seconds" in r):
            cores = results["machine"]["cores"]
            words = f"{row['seconds']:.1f} s on {cores} cores"
            yield Goal(f"{scene}, {preset}", f"≤ {most:g} s", words, row["seconds"] <= most)
    order = agreement(results["rows"])
    if order is not None:
        yield Goal("order of the verdict's score, Spearman", f"≥ {ORDER:g}", f"{order:.2f}", order >= ORDER)


def _mean_below_ring(preset: str, kind: str, runs: Sequence[Row]) -> Iterator[Goal]:
    own = [r for r in runs if r["kind"] == kind and r["scene"] in REAL]
    done = [r["error"] for r in own if "error" in r]
    if done:
        wanted, mean = BELOW_RING[kind], float(np.mean(done))
        words = f"ring − {mean:.2f} dB" if mean >= 0 else f"ring + {-mean:.2f} dB"
        words += "" if len(done) == len(REAL) else f" ({len(done)} of {len(REAL)} scenes)"
        met = mean <= wanted and len(done) == len(own)
        yield Goal(f"{preset}, {kind}: mask, mean over real scenes", f"≥ ring − {wanted:g} dB", words, met)


def _coverage_goals(coverage: Sequence[Row]) -> Iterator[Goal]:
    for kind, names in (("real", REAL), ("made", MADE)):
        own = [c for c in coverage if c["scene"] in names]
        if own:
            least, most = min(own, key=lambda c: c["covered"]), max(own, key=lambda c: c["area"])
            words, met = f"{least['covered']:.3f} in {least['scene']}", least["covered"] >= COVERED[kind]
            yield Goal(f"T covers what no view sees, {kind} scenes, least", f"≥ {COVERED[kind]:g}", words, met)
            words, met = f"{most['area']:.2f}× in {most['scene']}", most["area"] <= AREA[kind]
            yield Goal(f"T's size over that, {kind} scenes, most", f"≤ {AREA[kind]:g}×", words, met)
    for c in (c for c in coverage if c["scene"] in INVENTED):
        most_invented = INVENTED[c["scene"]]
        words, met = f"{c['invented']:.1%}", c["invented"] <= most_invented
        yield Goal(f"{c['scene']}: mask invented though seen", f"≤ {most_invented:.0%}", words, met)


def agreement(rows: Sequence[Row]) -> float | None:
    """Spearman's coefficient of verdicts' scores with true errors: 1 where better scores have smaller errors."""
    pairs = [(r["score"], -r["error"]) for r in rows if r.get("score") is not None and "error" in r]
    if len({score for score, _ in pairs}) < 2 or len({error for _, error in pairs}) < 2:
        return None  # nothing to be ordered
    return float(spearmanr(*zip(*pairs)).statistic)


def harm(row: Row) -> float:
    """dB that the removal changed round the object: negative is worse."""
    return row["near after"] - row["near before"]


def gain(row: Row) -> float:
    """dB that the new Gaussians bring in the mask: negative where nothing would have been better."""
    return row["psnr mask"] - row["psnr mask unfilled"]


def _margin(row: Row, rows: Sequence[Row]) -> float:
    """dB by which the mask is better than the best simple baseline."""
    simple = [r for r in rows if r["scene"] == row["scene"] and r["method"] in (EMPTIED, TELEA)]
    return row["psnr mask"] - max(r["psnr mask"] for r in simple)


def _which(row: Row) -> str:
    return f"{row['scene']}, {row['kind']}"


def _refused(count: int) -> str:
    return f"; {count} refused" if count else ""


def sections(results: dict[str, Any]) -> Iterator[Section]:
    rows, cores = results["rows"], results["machine"]["cores"]
    yield Section(
        "Goals",
        "Scenes with a shadow count with the true shadow marked.",
        ["goal", "wanted", "found", ""],
        [[g.name, g.wanted, g.found, "met" if g.met else "UNMET"] for g in goals(results)],
    )
    yield Section(
        "Scores",
        "Means over the test views but the first. Not filled: PSNR in mask and unseen of the same removal without its "
        "new Gaussians. Ring: PSNR of as many pixels round the mask as it has, before (the ceiling) and after. Near: "
        f"{NEAR:g} px round it, after and what the removal changed there. The object's shadow is left out of both; its "
        "own column has its PSNR before and after. Outside: share of the new Gaussians outside the object's hidden "
        f"volume. Seconds on {cores} cores.",
        list(SCORES),
        [_score_cells(r) for r in rows],
    )
    if results["coverage"]:
        yield Section(
            "Coverage of T",
            "Training views. Covered: share of the pixels that no view sees that T holds. Area: of T over theirs. "
            "Invented: share of the mask that is in T though some view sees it.",
            ["scene", "shadow", "covered", "area", "invented"],
            [
                [c["scene"], _shadow(c), f"{c['covered']:.3f}", f"{c['area']:.2f}", f"{c['invented']:.1%}"]
                for c in results["coverage"]
            ],
        )
    judged = [r for r in rows if r.get("score") is not None and "error" in r]
    if judged:
        order = agreement(rows)
        yield Section(
            "Verdict against truth",
            "Error: PSNR of the ring before the removal less that of the mask, dB. Spearman's coefficient: "
            + (f"{order:.2f}." if order is not None else "nothing to be ordered."),
            ["scene", "shadow", "method", "picture", "score", "error"],
            [
                [r["scene"], _shadow(r), r["method"], r["kind"], f"{r['score']:.3f}", f"{r['error']:+.2f}"]
                for r in sorted(judged, key=lambda r: -r["score"])
            ],
        )


def _score_cells(row: Row) -> list[str]:
    start = [row["scene"], _shadow(row), row["method"], row["kind"]]
    if "refused" in row:
        return [*start, row["refused"], *[""] * (len(SCORES) - len(start) - 1)]
    numbers = [f"{metric} {mask}" for mask in ("mask", "unseen") for metric in ("psnr", "ssim", "flip")]
    scores = [(f"{row[k]:.2f}" if k.startswith("psnr") else f"{row[k]:.3f}") if k in row else "" for k in numbers]
    pairs = [_before_after(row, name) for name in ("ring", "near", "shadow")]
    if pairs[1]:
        pairs[1] = f"{row['near after']:.2f} ({harm(row):+.2f})"
    if row["method"] == TELEA:
        pairs = [""] * 3  # photos: their surroundings say nothing of a removal
    outside = f"{row['outside']:.1%}" if "outside" in row else ""
    counts = [f"{row[key]}" if key in row else "" for key in ("removed", "added", "open_pixels")]
    bare = [f"{row[key]:.2f}" for key in ("psnr mask unfilled", "psnr unseen unfilled") if key in row]
    seconds = f"{row['seconds']:.1f}" if "seconds" in row else ""
    return [*start, *scores, " / ".join(bare), *pairs, outside, *counts, seconds]


def _before_after(row: Row, name: str) -> str:
    pair = [row.get(f"{name} {when}") for when in ("before", "after")]
    return "" if None in pair else f"{pair[0]:.2f} → {pair[1]:.2f}"


def _shadow(row: Row) -> str:
    return "marked" if row["marked"] else ""


def markdown(results: dict[str, Any]) -> str:
    """The results as tables."""
    parts = ["# Real scenes\n", f"{about(results)}\n"]
    for section in sections(results):
        parts += [f"## {section.title}\n", f"{section.words}\n", table(section.head, section.rows)]
    return "\n".join(parts)


def about(results: dict[str, Any]) -> str:
    host = results["machine"]
    return f"{host['cpu']}, {host['cores']} cores; load at the start {host['load_at_start'][0]}."


def page(results: dict[str, Any]) -> str:
    """Tables, and the sheets of pictures that lie beside the page."""
    tables = "".join(html_table(s) for s in sections(results))
    sheets = "".join(figure(name) for name in results["pictures"])
    return (
        "<!doctype html><html lang=en><meta charset=utf-8><meta name=viewport content='width=device-width'>"
        f"<title>Real scenes</title><style>{STYLE}\nbody{{max-width:none}}table{{width:auto}}figure{{margin:1rem 0}}"
        f"</style><h1>Real scenes</h1><p>{escape(about(results))}</p>{tables}<h2>Pictures</h2>{sheets}</html>\n"
    )
