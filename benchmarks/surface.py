"""Measures where a removal fills and on what surface: target regions, depths behind the object with each test view as
the reference, and how much they change when poses, depths, the region or the photos do. On scenes with truth.

Writes OUT/surface.json, OUT/surface.md with pictures, and charts. Run by `make bench-surface`.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import asdict, dataclass
from pathlib import Path

import cv2
import numpy as np

from gimp3d.box import Region
from gimp3d.camera import Camera, output_name
from gimp3d.errors import BadInput, IllPosed
from gimp3d.geometry import disparity_of
from gimp3d.io.images import write_png
from gimp3d.report import tinted
from gimp3d.stages.depth import DepthCompletion, complete_depth
from gimp3d.stages.masks import Masks, MaskSettings, ViewMasks, find_masks
from gimp3d.stages.reference import rim

from .command import ASSETS, parser_of, say, told_in_one_line, write_results
from .perturbations import moved, noisy_depths, resized, turned
from .plots import Line, Panel, draw_panels
from .scenes import SHADOW, Scene, read_scenes
from .tables import Row, Section, columns, markdown, mean, sheet, values, where
from .timing import about, machine

MODES = ("need", "paper")
COVERED, MISSED, MORE = (46, 160, 67), (255, 0, 200), (250, 140, 20)  # colours of the overlays
QUICK_SCENES = ("desk", "desk" + SHADOW)


@dataclass(frozen=True)
class Perturbation:
    """One way to be wrong."""

    kind: str  # as in KINDS, or none
    level: float = 0.0  # px RMS; relative, one standard deviation; of the region's size; share of its size
    label: str = "0"  # of the level
    axis: int = 0  # of the region, for its place
    seed: int = 0


KINDS = {  # heading, label of the unperturbed
    "poses": ("Poses off, px", "0"),
    "depths": ("Depths off, %", "0"),
    "size": ("Region's size ×", "1"),
    "place": ("Region moved by 10 %", "0"),
}


def perturbations(quick: bool) -> Iterator[Perturbation]:
    for seed in (0,) if quick else (0, 1):  # where there is chance in it
        for pixels in (0.3, 2.0) if quick else (0.1, 0.3, 1.0, 2.0):
            yield Perturbation("poses", pixels, f"{pixels:g}", seed=seed)
        for share in (0.003, 0.03) if quick else (0.001, 0.003, 0.01, 0.03):
            yield Perturbation("depths", share, f"{100 * share:g}", seed=seed)
    for factor in (0.8, 1.2) if quick else (0.8, 0.9, 1.1, 1.2):
        yield Perturbation("size", factor, f"{factor:g}")
    for axis, share in ((0, 0.1), (2, -0.1)) if quick else [(a, s) for a in range(3) for s in (-0.1, 0.1)]:
        yield Perturbation("place", share, f"{'-+'[share > 0]}{'xyz'[axis]}", axis)


def main() -> None:
    parser = parser_of(__doc__, "surface", data=True, quick="one place and the largest perturbations only")
    parser.add_argument("--scenes", help="folders of DATA, separated by commas; default: all")
    given = parser.parse_args()
    names = given.scenes.split(",") if given.scenes else sorted(p.parent.name for p in given.data.glob("*/truth"))
    names = [n for n in names if given.scenes or not given.quick or n in QUICK_SCENES]
    if not names:
        raise BadInput(f"{given.data} holds no scenes with truth/")
    results: Row = {"quick": given.quick, "machine": machine(), "scenes": names}
    results |= {key: [] for key in ("masks", "depths", "stability", "shadows", "pictures")}
    unperturbed = {}
    for scene in read_scenes(given.data, ",".join(names), needs_truth=True):
        unperturbed[scene.name] = measure_scene(scene, given.quick, results, given.out)
    results["shadows"] = [shadow(n, results, unperturbed) for n in names if n + SHADOW in names]
    words = f"{about(results['machine'])} Pictures: green is never seen and in T, magenta never seen and missed, "
    words += "orange in T though some view sees it; outline: what the object hides."
    text = markdown("Where a removal fills, and on what surface", words, sections(results), results["pictures"])
    write_results(given.out, "surface", results, text)
    draw(results, given.out if given.quick or given.scenes else ASSETS)


def measure_scene(scene: Scene, quick: bool, results: Row, out: Path) -> dict[str, np.ndarray]:
    """Everything about one scene, into the results, and pictures of it into `out`. Returns T of its training views."""
    scene_masks(scene, scene.train[:2])  # compiles what is not in the cache, which is not to be timed
    for mode in MODES:
        start = time.process_time()
        masks = scene_masks(scene, scene.train, MaskSettings(mode=mode))
        cpu = round(time.process_time() - start, 2)
        row = {"scene": scene.name, "mode": mode, **mask_scores(scene, masks), "cpu_s": cpu}
        results["masks"].append(row)
        say(f"{scene.name} {mode}: {row['covered']:.2%} covered, area {row['area']:.2f}, {cpu} s")
        results["pictures"].append(f"masks_{scene.name}_{mode}.png")
        write_png(out / results["pictures"][-1], mask_sheet(scene, masks))
    # A test view is a camera only; to be completed as the reference it must be among those that masks are found for.
    masks = scene_masks(scene, scene.train + scene.test)
    results["depths"] += [{"scene": scene.name, **row} for row in surface_scores(scene, masks)]
    before = targets(masks, scene.train)
    results["stability"].append(stability(scene, Perturbation("none"), masks, before))
    for perturbation in perturbations(quick):
        try:
            row = stability(scene, perturbation, perturbed_masks(scene, perturbation), before)
            said = f"IoU {row['iou']:.3f}, {row['covered']:.2%} covered, depth error {row['median']:.2%}"
        except IllPosed as error:
            row, said = {"scene": scene.name, **asdict(perturbation), "refused": str(error)}, f"refused: {error}"
        results["stability"].append(row)
        say(f"{scene.name} {perturbation.kind} {perturbation.label}: {said}")
    return before


def perturbed_masks(scene: Scene, perturbation: Perturbation) -> Masks:
    """The scene's masks where something is wrong. Test views are never turned: the truth is known in them only."""
    train, region, level = scene.train, scene.region, perturbation.level
    if perturbation.kind == "poses":
        rng = np.random.default_rng(perturbation.seed)
        train = tuple(turned(c, level, rng) for c in train)
    elif perturbation.kind == "size":
        region = resized(region, level)
    elif perturbation.kind == "place":
        region = moved(region, perturbation.axis, level)
    with noisy_depths(level, perturbation.seed) if perturbation.kind == "depths" else nullcontext():
        return scene_masks(scene, train + scene.test, region=region)


def stability(scene: Scene, perturbation: Perturbation, masks: Masks, before: dict[str, np.ndarray]) -> Row:
    """T of the training views against that before and against the truth; depths of the test views against the truth."""
    iou, worst = overlap(targets(masks, scene.train), before)
    found, surfaces = mask_scores(scene, masks), surface_scores(scene, masks)
    done = [r for r in surfaces if "refused" not in r]
    if not done:
        raise IllPosed(surfaces[0]["refused"])
    row = {"scene": scene.name, **asdict(perturbation), "iou": iou, "worst_iou": worst}
    row |= {key: found[key] for key in ("covered", "area")}
    return row | {key: mean(done, key) for key in ("median", "p95")} | {"views_refused": len(surfaces) - len(done)}


def shadow(name: str, results: Row, unperturbed: dict[str, dict[str, np.ndarray]]) -> Row:
    """A place whose photos show the object's shadow and reflections, against the same without."""
    pair = [where(results["stability"], scene=n, kind="none")[0] for n in (name, name + SHADOW)]
    iou, worst = overlap(unperturbed[name], unperturbed[name + SHADOW])
    both = {key: [r[key] for r in pair] for key in ("covered", "area", "median")}
    return {"scene": name, "iou": [1.0, iou], "worst_iou": [1.0, worst], **both}


# -------------------------------------------------------------------------------------- what the stages say, and truth


def scene_masks(
    scene: Scene, cameras: Sequence[Camera], settings: MaskSettings = MaskSettings(), region: Region | None = None
) -> Masks:
    """The stage as a removal calls it."""
    return find_masks(scene.gaussians, region or scene.region, cameras, settings, photos=scene.photos)


def targets(masks: Masks, cameras: Sequence[Camera]) -> dict[str, np.ndarray]:
    """T [H, W] of every camera; a view that was left out has none."""
    found = {v.camera.id: v.target for v in masks.views}
    return {c.id: found.get(c.id, np.zeros((c.height, c.width), bool)) for c in cameras}


def shares(pairs: Sequence[tuple[np.ndarray, np.ndarray]], least: int = 50) -> tuple[float, float]:
    """Share of the second masks' pixels that the first ones hold: over all pairs, and in the worst pair.

    Pairs whose second mask has fewer than `least` pixels say little and cannot be the worst.
    """
    counts = np.array([[(a & b).sum(), b.sum()] for a, b in pairs], float).reshape(-1, 2)
    large = counts[counts[:, 1] >= least]
    return counts[:, 0].sum() / max(1, counts[:, 1].sum()), float((large[:, 0] / large[:, 1]).min(initial=1.0))


def overlap(a: Mapping[str, np.ndarray], b: Mapping[str, np.ndarray]) -> tuple[float, float]:
    """Intersection over union of two sets of masks: over all views, and in the worst view."""
    return shares([(a[name] & b[name], a[name] | b[name]) for name in a])


def without_rim(mask: np.ndarray) -> np.ndarray:
    """The mask [H, W] without its outermost pixels, which show both sides; the frame is no rim."""
    return cv2.erode(mask.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0


def mask_scores(scene: Scene, masks: Masks) -> Row:
    """T of the training views against what no view sees, and the silhouettes against what the object hides."""
    found = targets(masks, scene.train)
    unseen = {c.id: scene.unseen(c) for c in scene.train}
    covered, worst = shares([(found[name], without_rim(unseen[name])) for name in found])
    there = [v for v in masks.views if v.camera.id in found]
    silhouettes = ({v.camera.id: v.silhouette for v in there}, {v.camera.id: scene.hides(v.camera) for v in there})
    pixels = int(sum(t.sum() for t in found.values()))
    area = pixels / max(1, sum(u.sum() for u in unseen.values()))
    row = {"covered": covered, "worst_view_covered": worst, "area": area, "silhouette_iou": overlap(*silhouettes)[0]}
    return row | {"hole_pixels": pixels}


def completed(view: ViewMasks, views: Sequence[ViewMasks]) -> DepthCompletion:
    """The surface behind the object in a view, as a removal with these training views completes it."""
    used = [v for v in views if v is view or v.camera.split == "train"]
    return complete_depth(view, used, disparity_of(view.depth_after), rim(view))


def surface(view: ViewMasks, completion: DepthCompletion) -> np.ndarray:
    """[H, W] z of the view without the object: completed in T, the scene's own elsewhere."""
    return np.where(view.target, completion.depth, view.depth_after).astype(np.float32)


def surface_scores(scene: Scene, masks: Masks) -> list[Row]:
    """Every test view as the reference: its T against the truth, and its completed surface. Refusals say why.

    Errors of z count where no view sees the surface, also where T missed it; infinitely far is an error of 1.
    """
    views = {v.camera.id: v for v in masks.views}
    rows = []
    for camera in scene.test:
        row: Row = {"view": camera.id}
        rows.append(row)
        if camera.id not in views:
            row["refused"] = "the view does not frame the region"
            continue
        view, unseen, truth = views[camera.id], scene.unseen(camera), scene.depth(camera)
        row["covered"] = shares([(view.target, without_rim(unseen))])[0]
        row["area"] = float(view.target.sum() / max(1, unseen.sum()))
        try:
            completion = completed(view, masks.views)
        except IllPosed as error:
            row["refused"] = str(error)
            continue
        error = np.minimum(np.abs(surface(view, completion) - truth) / truth, 1.0)[without_rim(unseen)]
        row |= {"median": float(np.median(error)), "p95": float(np.percentile(error, 95))}
        row |= {"confidence": completion.confidence, "reason": completion.reason}
    return rows


# ------------------------------------------------------------------------------------------------------------- pictures


def mask_sheet(scene: Scene, masks: Masks) -> np.ndarray:
    """All training views, [H, W, 3] uint8: T and what no view sees as colours, what the object hides as an outline."""
    found, tiles = targets(masks, scene.train), []
    for camera in scene.train:
        target, unseen, photo = found[camera.id], scene.unseen(camera), scene.photos[camera.id] // 2 + 60
        for mask, colour in ((target & unseen, COVERED), (unseen & ~target, MISSED), (target & ~unseen, MORE)):
            photo = tinted(photo, mask, colour, 0.65)
        outline, _ = cv2.findContours(scene.hides(camera).astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        cv2.drawContours(photo, outline, -1, (255, 255, 255), 1)
        tiles.append((output_name(camera.id), cv2.resize(photo, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)))
    tiles += [(" " * k, np.zeros_like(tiles[0][1])) for k in range(1, 1 + -len(tiles) % 6)]
    return sheet([dict(tiles[k : k + 6]) for k in range(0, len(tiles), 6)])


# --------------------------------------------------------------------------------------------------------------- tables


def sections(results: Row) -> Iterator[Section]:
    plain = [r for r in results["masks"] if not r["scene"].endswith(SHADOW)]
    means = [{"scene": "mean without shadows", "mode": m} for m in values(plain, "mode")]
    for row in means:
        row |= {key: mean(where(plain, mode=row["mode"]), key) for key in plain[0] if key not in row}
    yield Section(
        "Target regions",
        "Training views. Covered: share of the pixels that no view sees, without their 1-px rim, that T holds (wanted: "
        "99 %). Area: of T over that of never-seen pixels (wanted: 1.6 at most). Silhouette: overlap (IoU) with "
        "what the object truly hides. Seconds: CPU, of all threads together.",
        *columns([*results["masks"], *means], OF_MASKS),
    )
    said = ({**r, "of": output_name(r["view"]), "said": r.get("refused") or r["reason"]} for r in results["depths"])
    yield Section(
        "Each test view as the reference",
        "T there, and the surface that the default settings complete: relative error of z in never-seen pixels without "
        "their 1-px rim, median and 95th percentile. Pixels with no depth are wrong by 100 %.",
        *columns(said, OF_DEPTHS),
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
            *columns(results["shadows"], OF_SHADOWS),
        )


FORMS = {"iou": "{:.3f}", "covered": "{:.2%}", "area": "{:.2f}", "median": "{:.2%}"}
OF_MASKS = {"scene": "{scene}", "mode": "{mode}", "covered": "{covered:.2%}", "worst view": "{worst_view_covered:.2%}"}
OF_MASKS |= {"area": "{area:.2f}", "silhouette": "{silhouette_iou:.3f}", "hole pixels": "{hole_pixels:.0f}"}
OF_MASKS |= {"CPU s": "{cpu_s:.1f}"}
OF_DEPTHS = {"scene": "{scene}", "view": "{of}", "covered": "{covered:.2%}", "area": "{area:.2f}"}
OF_DEPTHS |= {"median": "{median:.2%}", "95 %": "{p95:.2%}", "what happened": "{said}"}
OF_SHADOWS = {"place": "{scene}", "overlap": "{iou[1]:.3f} (worst view {worst_iou[1]:.3f})"}
OF_SHADOWS |= {"covered": "{covered[0]:.2%} → {covered[1]:.2%}", "area": "{area[0]:.2f} → {area[1]:.2f}"}
OF_SHADOWS |= {"depth error": "{median[0]:.2%} → {median[1]:.2%}"}


def stability_rows(rows: list[Row]) -> Iterator[list[str]]:
    best: dict[str, Callable[[list[float]], float]] = {"iou": min, "covered": min, "area": max, "median": max}
    for kind, label in dict.fromkeys((r["kind"], r["label"]) for r in rows):
        same = where(rows, kind=kind, label=label)
        done = [r for r in same if "refused" not in r]
        cells = [
            f"{FORMS[k].format(mean(done, k))} ({FORMS[k].format(worst([r[k] for r in done]))})" if done else ""
            for k, worst in best.items()
        ]
        refused = sum(r["views_refused"] for r in done)
        words = [f"{len(same) - len(done)} runs"] * (len(done) < len(same)) + [f"{refused} views"] * (refused > 0)
        what = (KINDS[kind][0], label) if kind in KINDS else ("nothing", "")
        yield [*what, *cells, ", ".join(words)]


# --------------------------------------------------------------------------------------------------------------- charts

MEASURES = {  # words, whether logarithmic, unit, what is wanted
    "iou": ("IoU with T unperturbed", False, 1.0, None),
    "covered": ("never-seen pixels in T", False, 1.0, 0.99),
    "area": ("area of T ÷ never-seen", True, 1.0, 1.6),
    "median": ("depth error, %", True, 100.0, None),
}
CHANGED = ("iou", "covered", "median")  # what perturbations change
Lines = dict[str, list[tuple[float, Row]]]  # name → places on the x axis with their rows


def panel(heading: str, measure: str, labels: Sequence[str], lines: Lines, joined: bool) -> Panel:
    """Scenes whose photos show shadows have their sister's colour, and open marks."""
    words, logarithmic, unit, wanted = MEASURES[measure]
    drawn = []
    for n, (name, line) in enumerate(lines.items()):
        dark, shift = name.endswith(SHADOW), 0.0 if joined else 0.07 * (n - (len(lines) - 1) / 2)
        points = [(x + shift, unit * r[measure]) for x, r in line]
        style = "none" if not joined else "--" if dark else "-"
        drawn.append(Line(name, points, name.removesuffix(SHADOW), style, hollow=dark))
    ticks = {float(k): label for k, label in enumerate(labels)}
    return Panel(heading, drawn, "", words, False, logarithmic, ticks, wanted, named=False)


def draw(results: Row, folder: Path) -> None:
    scenes, depths = results["scenes"], results["depths"]
    by_mode: Lines = {m: [(scenes.index(r["scene"]), r) for r in where(results["masks"], mode=m)] for m in MODES}
    labels = [s.replace(SHADOW, "*") for s in scenes]
    words = "Training views. Never-seen: hidden by the object in every view; lines: what is wanted. *: with shadows"
    row = [panel("", k, labels, by_mode, False) for k in ("covered", "area")]
    draw_panels(folder / "surface_masks.svg", "Where is filled: target regions T by mode", words, [row], (6.0, 3.0))

    views = values(depths, "view")
    done = [r for r in depths if "median" in r]
    by_scene: Lines = {s: [(views.index(r["view"]), r) for r in where(done, scene=s)] for s in scenes}
    labels = [output_name(v).rpartition("/")[2] for v in views]
    words = "Test views, never a photo. Depth error: relative, median over never-seen pixels"
    row = [panel("", k, labels, by_scene, False) for k in ("covered", "area", "median")]
    draw_panels(folder / "surface_references.svg", "Each test view as the reference", words, [row], (4.0, 3.0))

    columns = [(KINDS[kind][0], *perturbed(results, kind), kind != "place") for kind in KINDS]
    if results["shadows"]:
        found = {r["scene"]: [(k, {m: r[m][k] for m in CHANGED}) for k in (0, 1)] for r in results["shadows"]}
        columns.append(("Shadows in photos", ["without", "with"], found, True))
    words = "Mean over seeds; depth error: relative, in never-seen pixels, mean of the test views' medians"
    grid = [[panel(c[0] if k == "iou" else "", k, *c[1:]) for c in columns] for k in CHANGED]
    title = "Stability: what wrong poses, depths and regions change"
    draw_panels(folder / "surface_stability.svg", title, words, grid, (2.8, 2.3))


def perturbed(results: Row, kind: str) -> tuple[list[str], Lines]:
    """A kind of perturbation: its labels in order with the unperturbed among them, and means over seeds by scene."""
    zero = KINDS[kind][1]
    levels = {r["label"]: r["level"] for r in where(results["stability"], kind=kind)}
    labels = list(levels)
    labels.insert(sum(level < 1 for level in levels.values()) if kind == "size" else 0, zero)
    lines: Lines = {}
    for scene in results["scenes"]:
        rows = [r for r in where(results["stability"], scene=scene) if "refused" not in r]
        same = [where(rows, kind="none") if label == zero else where(rows, kind=kind, label=label) for label in labels]
        lines[scene] = [(k, {key: mean(of, key) for key in CHANGED}) for k, of in enumerate(same) if of]
    return labels, lines


if __name__ == "__main__":
    told_in_one_line(main)
