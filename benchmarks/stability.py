"""Measures how whole removals bear what is wrong with their input: too few views, views from one side, exposures, wrong
photos, wrong depths. On scenes rendered with and without the object.

Writes OUT/stability.json, OUT/stability.md and a chart. Run by `make bench-stability`.
"""

from __future__ import annotations

from contextlib import nullcontext
from itertools import product
from pathlib import Path

import numpy as np

from gimp3d.box import Region
from gimp3d.camera import Camera
from gimp3d.errors import IllPosed
from gimp3d.gaussians import ARRAYS
from gimp3d.pipeline import PRESETS, RemovalResult, View

from .command import ASSETS, parser_of, say, told_in_one_line, write_results
from .perturbations import exposed, garbled, gathered, misplaced, noisy_depths, noisy_surfaces
from .plots import Line, Panel, draw_panels
from .scenes import Scene, cached_scene, filled, mean_psnrs, new_gaussians, read_scenes, removal, side_by_side
from .tables import Row, Section, columns, markdown, values, where
from .timing import about, machine

SCENES = "desk,gloss"
CLUSTER = 12  # views that look from one side
SEED = 0
KINDS = {  # heading, unit of its levels, and these
    "views": ("Views", "", (9, 3, 2, 1)),  # the reference among them; two are 1° apart
    "cone": ("All views within", "°", (90, 30, 10)),  # from the reference; of CLUSTER views
    "exposure": ("Exposures off, ±", "%", (0.1, 0.2, 0.4)),  # each photo's gain
    "misplaced": ("Photos mixed up", "%", (0.1, 0.2, 0.4)),  # photos that are other views'
    "garbled": ("Pixels garbled", "%", (0.1, 0.2, 0.4)),  # of all photos: they show something else
    "surface": ("Surface off", "%", (0.01, 0.03, 0.1)),  # noise of the references' completed depths, relative
    "depths": ("All depths off", "%", (0.01, 0.03, 0.1)),  # of all depths that are drawn
}
QUICK = {"views": (1,), "misplaced": (0.1,), "surface": (0.1,)}
WRONG_PHOTOS = {"exposure": exposed, "misplaced": misplaced, "garbled": garbled}


def main() -> None:
    parser = parser_of(__doc__, "stability", data=True, quick="one scene and three perturbations", scenes=SCENES)
    parser.add_argument("--preset", default="balanced", choices=PRESETS)
    given = parser.parse_args()
    scenes = read_scenes(given.data, given.scenes.split(",")[0] if given.quick else given.scenes, needs_truth=True)
    levels = QUICK if given.quick else {kind: of_kind for kind, (_, _, of_kind) in KINDS.items()}
    asked = [("none", 0.0), *((kind, level) for kind, of_kind in levels.items() for level in of_kind)]
    results: Row = {"machine": machine(), "preset": given.preset, "rows": []}
    with side_by_side() as workers:
        folders, cases = zip(*product([s.folder for s in scenes], asked))
        for row in workers.map(measured, folders, *zip(*cases), [given.preset] * len(folders)):
            results["rows"].append(row)
            say(" ".join(f"{v:.4g}" if isinstance(v, float) else str(v) for v in row.values()))
    whole = not given.quick and given.scenes == SCENES
    write_results(given.out, "stability", results, report(results))
    draw(results, (ASSETS if whole else given.out) / "stability.svg")


def measured(folder: Path, kind: str, level: float, preset: str) -> Row:
    """A removal, the reference's true picture given: PSNR of the other test views, and what was added; or why not."""
    scene = cached_scene(folder)
    reference, *others = scene.test
    row: Row = {"scene": scene.name, "kind": kind, "level": level}
    views = perturbed_views(scene, reference, kind, level)
    try:
        observer = noisy_surfaces(level, SEED) if kind == "surface" else None
        with noisy_depths(level, SEED) if kind == "depths" else nullcontext():
            result = removal(scene, PRESETS[preset], reference, scene.truth(reference), views, observer=observer)
    except IllPosed as error:
        return row | {"refused": str(error)}
    row |= mean_psnrs(scene, filled(scene.gaussians, result), others)
    opened = mean_psnrs(scene, scene.gaussians.take(result.keep), others)
    row |= {f"open {name}": value for name, value in opened.items()}
    return row | grown(result, scene.region) | {"warnings": list(result.warnings)}


def perturbed_views(scene: Scene, reference: Camera, kind: str, level: float) -> list[View]:
    """The views that a removal is given beside its reference, which has no photo."""
    if kind in WRONG_PHOTOS:
        photos = WRONG_PHOTOS[kind](scene.photos, level, SEED)
        return [View(c, photos[c.id]) for c in scene.train]
    if kind not in ("views", "cone"):
        return scene.views
    others = int(level) - 1 if kind == "views" else CLUSTER
    chosen = scene.views[:: max(1, -(-len(scene.views) // max(1, others)))][:others]
    if kind == "views" and others != 1:
        return chosen
    degrees = level if kind == "cone" else 1.0
    cameras = gathered([v.camera for v in chosen], reference, scene.region[0].center, degrees)
    return [scene.drawn(c) for c in cameras]


def grown(result: RemovalResult, region: Region) -> Row:
    """What is new: how many, whether all is finite, the largest splat and the farthest, in diagonals of the box."""
    new, added = new_gaussians(result), result.added
    if not new or not added:
        return {"added": 0, "finite": True, "largest": 0.0, "farthest": 0.0}
    corners = np.concatenate([box.corners() for box in region])
    centre, diagonal = corners.mean(0), float(np.linalg.norm(np.ptp(corners, axis=0)))
    row = {"added": len(new), "finite": all(bool(np.isfinite(getattr(added, name)).all()) for name in ARRAYS)}
    farthest = float(np.linalg.norm(new.means - centre, axis=1).max())
    return row | {"largest": float(new.scales.max()) / diagonal, "farthest": farthest / diagonal}


def label(kind: str, level: float) -> str:
    return f"{100 * level:g}" if KINDS[kind][1] == "%" else f"{level:g}"


def report(results: Row) -> str:
    rows = []
    for r in results["rows"]:
        heading, unit, _ = KINDS.get(r["kind"], ("unperturbed", "", ()))
        level = label(r["kind"], r["level"]) + unit if r["kind"] in KINDS else ""
        said = r.get("refused") or "; ".join(r["warnings"])
        finite = {True: "yes", False: "NO"}.get(r.get("finite"), "")
        rows.append({**r, "what": heading, "by": level, "finite": finite, "said": said})
    forms = {"scene": "{scene}", "what is wrong": "{what}", "by": "{by}", "mask": "{mask:.2f}"}
    forms |= {"unseen": "{unseen:.2f}", "hole open: mask": "{open mask:.2f}", "hole open: unseen": "{open unseen:.2f}"}
    forms |= {"added": "{added}", "finite": "{finite}", "largest": "{largest:.2%}"}
    forms |= {"farthest": "{farthest:.2f}", "warnings": "{said}"}
    section = Section(
        "Removals",
        "PSNR in dB of the test views but the reference. *Largest*: the largest new standard deviation; *farthest*: "
        "the farthest new Gaussian from the box's centre; both in diagonals of the box.",
        *columns(rows, forms),
    )
    words = f"{about(results['machine'])} Preset {results['preset']}."
    return markdown("Whole removals whose input is wrong", words, [section])


def draw(results: Row, path: Path) -> None:
    """A column per perturbation, a row per measure, a line per scene; dashed: the hole left open."""
    rows = [r for r in results["rows"] if "refused" not in r]
    grid = []
    measures = {"mask": "PSNR hidden, dB", "unseen": "PSNR unseen, dB", "largest": "largest splat, %"}
    for measure, words in measures.items():
        grid.append([])
        for kind in (k for k in KINDS if where(results["rows"], kind=k)):
            levels = values(where(results["rows"], kind=kind), "level")
            lines = []
            for scene in values(results["rows"], "scene"):
                line = [where(rows, scene=scene, kind="none")]
                line += [where(rows, scene=scene, kind=kind, level=level) for level in levels]
                found = [(x, of[0]) for x, of in enumerate(line) if of]
                if measure == "largest":
                    lines.append(Line(scene, [(x, 100 * r[measure]) for x, r in found]))
                    continue
                lines.append(Line(scene, [(x, r[measure]) for x, r in found]))
                opened = [(x, r[f"open {measure}"]) for x, r in found]
                lines.append(Line(f"{scene}, hole left open", opened, scene, "--", hollow=True))
            ticks = {0.0: "–"} | {n + 1.0: label(kind, level) for n, level in enumerate(levels)}
            heading = ", ".join(filter(None, KINDS[kind][:2])) if measure == "mask" else ""
            grid[-1].append(Panel(heading, lines, "", words, False, measure == "largest", ticks, named=False))
    words = "Test views but the reference; –: unperturbed; largest splat: its standard deviation by the box's diagonal"
    draw_panels(path, "What wrong input does to a removal", words, grid, (2.4, 2.3))


if __name__ == "__main__":
    told_in_one_line(main)
