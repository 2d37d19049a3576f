"""Measures how much a removal depends on its reference: every test view with its true picture, and training views drawn
at random with the built-in fill. On scenes rendered with and without the object; whole removals, scored in test views.

Writes OUT/references.json, OUT/references.md and a chart. Run by `make bench-references`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from gimp3d.camera import Camera
from gimp3d.errors import IllPosed
from gimp3d.pipeline import PRESETS

from .command import ASSETS, parser_of, say, told_in_one_line, write_results
from .plots import COLOURS, FAINT, figure
from .scenes import MADE, MASKS, Scene, cached_scene, filled, read_scenes, removal, side_by_side, view_psnrs
from .tables import Row, Section, markdown, values, where
from .timing import about, machine

GIVEN, FILLED = "true picture", "built-in fill"
KINDS = {
    GIVEN: "each test view, given its true picture, scored on the others",
    FILLED: "training views drawn at random, filled by the built-in appearance, scored on all test views",
}
PRESETS_MEASURED = ("balanced", "paper")
DRAWN, SEED = 10, 0  # training views drawn as references
GOOD = 0.5  # of the best reference's score: what shows the surface less well counts as a poor reference


@dataclass
class MasksOnly:
    """A store that keeps the masks: they do not depend on the reference as long as the views are the same."""

    kept: dict[str, Any] = field(default_factory=dict)

    def load(self, name: str) -> Any | None:
        return self.kept.get(name)

    def save(self, name: str, result: Any) -> None:
        if name == "masks":
            self.kept[name] = result


def main() -> None:
    parser = parser_of(__doc__, "references", data=True, quick="one scene and two references of each kind only")
    parser.add_argument("--scenes", default=",".join(MADE), help="names, separated by commas")
    parser.add_argument("--steps", type=int, default=100, help="of refinement at most; the paper's preset has 3,000")
    given = parser.parse_args()
    names = given.scenes.split(",")[0] if given.quick else given.scenes
    folders = [s.folder for s in read_scenes(given.data, names, needs_truth=True)]
    groups = list(product(folders, KINDS, PRESETS_MEASURED, [2 if given.quick else DRAWN], [given.steps]))
    results: Row = {"machine": machine(), "steps": given.steps, "references": []}
    with side_by_side() as workers:
        for rows in workers.map(measured, *zip(*groups)):
            results["references"] += rows
    whole = not given.quick and given.scenes == ",".join(MADE)
    write_results(given.out, "references", results, report(results))
    draw(results, (ASSETS if whole else given.out) / "references.svg")


def measured(folder: Path, kind: str, preset: str, most: int, steps: int) -> list[Row]:
    """A row for each reference: PSNR of every test view but the reference, or why the removal was refused.

    And the reference's own score: how much of the surface that has to be made up it shows, and how well.
    """
    scene, store = cached_scene(folder), None if kind == GIVEN else MasksOnly()
    refine = PRESETS[preset].refine
    settings = replace(PRESETS[preset], refine=replace(refine, steps=min(refine.steps, steps)))
    rows = []
    for camera, picture in references(scene, kind, most):
        row: Row = {"scene": scene.name, "kind": kind, "preset": preset, "reference": camera.id}
        try:
            result = removal(scene, settings, camera, picture, store=store)
            others = [c for c in scene.test if c.id != camera.id]
            row["views"] = view_psnrs(scene, filled(scene.gaussians, result), others)
            row["score"] = next(s.score for s in result.references[0].scores if s.camera_id == camera.id)
            said = ", ".join(f"{means([row], mask)[0]:.2f} dB in {mask}" for mask in MASKS)
        except IllPosed as error:
            row["refused"] = said = str(error)
        say(f"{scene.name}, {kind}, {preset}, {camera.id}: {said}")
        rows.append(row)
    return rows


def references(scene: Scene, kind: str, most: int) -> Iterator[tuple[Camera, np.ndarray | None]]:
    """Cameras, and their pictures without the object where the removal is given them."""
    if kind == GIVEN:
        yield from ((c, scene.truth(c)) for c in scene.test[:most])
    else:
        drawn = np.random.default_rng(SEED).choice(len(scene.train), most, replace=False)
        yield from ((scene.train[k], None) for k in drawn)


# --------------------------------------------------------------------------------------------------- what is written


def means(rows: Sequence[Row], mask: str) -> list[float]:
    """Each reference's mean over the views that it is scored on."""
    return [float(np.mean([v[mask] for v in r["views"].values()])) for r in rows]


def sigma(found: Sequence[float]) -> float:
    return float(np.std(found, ddof=1)) if len(found) > 1 else float("nan")


def sigma_by_view(rows: Sequence[Row], mask: str) -> float:
    """σ of the references' mean deviations from what the same views get from all references."""
    names = {name for r in rows for name in r["views"]}
    usual = {n: np.mean([r["views"][n][mask] for r in rows if n in r["views"]]) for n in names}
    return sigma([float(np.mean([v[mask] - usual[n] for n, v in r["views"].items()])) for r in rows])


def is_good(row: Row, others: Sequence[Row]) -> bool:
    return bool(row["score"] >= GOOD * max(r["score"] for r in others))


def report(results: Row) -> str:
    rows, sections = results["references"], []
    for kind, words in KINDS.items():
        if of_kind := where(rows, kind=kind):
            head = ["scene", "preset", "references", "refused"]
            head += [f"{mask}, {what}" for mask in MASKS for what in ("mean ± σ", "worst", "σ by view", "good")]
            title = f"{kind.capitalize()}: {words}"
            sections.append(Section(title, overall(of_kind), head, list(spread_rows(of_kind))))
    lines = []
    for r in rows:
        cells = [f"{means([r], mask)[0]:.2f}" for mask in MASKS] if "views" in r else [r["refused"], ""]
        score = f"{r['score']:.2f}" if "score" in r else ""
        lines.append([r["scene"], r["kind"], r["preset"], r["reference"], score, *cells])
    sections.append(Section("Every reference", "", ["scene", "picture", "preset", "reference", "score", *MASKS], lines))
    words = (
        f"{about(results['machine'])} Whole removals, {results['steps']} steps of refinement at most. PSNR in dB of "
        "the test views, drawn from the filled splat, without the reference. Mean ± σ over references (n - 1). *By "
        "view*: σ once each view's own mean is taken out, as leaving out a view changes a mean as well. *Good*: σ of "
        "the references that score at least half as high as the best one; what others show poorly or not at all is "
        "made up by later references, whatever picture is given."
    )
    return markdown("Each view as the reference", words, sections)


def overall(rows: list[Row]) -> str:
    """σ of each preset, mean over the scenes."""
    parts = []
    for mask, preset in product(MASKS, values(rows, "preset")):
        done = [r for r in where(rows, preset=preset) if "views" in r]
        found = [sigma(means(where(done, scene=s), mask)) for s in values(rows, "scene")]
        parts.append(f"in {mask}, {preset}: {np.mean(found):.2f} dB")
    return f"Mean σ over the scenes {'; '.join(parts)}."


def spread_rows(rows: list[Row]) -> Iterator[list[Any]]:
    for scene, preset in product(values(rows, "scene"), values(rows, "preset")):
        asked = where(rows, scene=scene, preset=preset)
        found = [r for r in asked if "views" in r]
        cells: list[Any] = [scene, preset, len(found), len(asked) - len(found)]
        for mask in MASKS:
            of = means(found, mask)
            if not of:
                cells += ["", "", "", ""]
                continue
            good = means([r for r in found if is_good(r, found)], mask)
            cells += [f"{np.mean(of):.2f} ± {sigma(of):.2f}", f"{min(of):.2f}"]
            cells += [f"{sigma_by_view(found, mask):.2f}", f"{sigma(good):.2f} ({len(good)})"]
        yield cells


def draw(results: Row, path: Path) -> None:
    """A dot for each reference, by scene and preset; the bar is the mean, the words σ."""
    rows = results["references"]
    scenes, presets = values(rows, "scene"), values(rows, "preset")
    words = "Mean PSNR of the test views by reference (rings: it shows the surface poorly); bar: mean; figure: σ"
    with figure(path, "The same removal from other references", words, 10.5, 7.2) as fig:
        axes = fig.subplots(len(MASKS), len(KINDS), squeeze=False, sharey="row")
        for (mask, kind), ax in zip(product(MASKS, KINDS), axes.flat):
            for (n, scene), (k, preset) in product(enumerate(scenes), enumerate(presets)):
                found = [r for r in where(rows, kind=kind, scene=scene, preset=preset) if "views" in r]
                x = n + 0.3 * (k - (len(presets) - 1) / 2)
                of = means(found, mask)
                for row, value in zip(found, of):
                    face = COLOURS[k] if is_good(row, found) else "white"
                    ax.plot(x, value, "o", color=COLOURS[k], markerfacecolor=face)
                if of:
                    ax.plot([x - 0.1, x + 0.1], [np.mean(of)] * 2, color=COLOURS[k])
                    ax.annotate(f"{sigma(of):.2f}", (x, max(of)), (0, 5), textcoords="offset points", ha="center",
                                color=FAINT, fontsize=8)  # fmt: skip
            ax.set_xticks(range(len(scenes)), scenes)
            ax.set(title=f"{kind.capitalize()}: {mask}", ylabel="PSNR, dB")
        for k, preset in enumerate(presets):
            axes[0, 0].plot([], [], "o", color=COLOURS[k], label=preset)
        fig.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower left", ncols=len(presets))


if __name__ == "__main__":
    told_in_one_line(main)
