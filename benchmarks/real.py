"""Whole removals on real scenes with truth, and on a real scan without: scores, rings, T, verdicts and pictures.

Each scene is run with the true picture of its first test view and without any, as `gimp3d` in a process of its own.
Scenes with a shadow are run as they are, and with the true shadow marked, which the paper's preset fills. Writes
OUT/real.json and OUT/real.md with a sheet of pictures per run. Run by `make bench-real`.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.stats import spearmanr

from gimp3d.camera import Camera, output_name
from gimp3d.commands import render_views
from gimp3d.errors import BadInput
from gimp3d.evaluate import empty_region, psnr, score_renders, telea
from gimp3d.geometry import SAME_DEPTH, bounds
from gimp3d.io.images import read_image, read_mask, write_png
from gimp3d.io.ply import read_ply, write_ply
from gimp3d.raster import surface_depth

from .command import parser_of, say, told_in_one_line, write, write_results
from .scenes import BUILT_IN, GIVEN, MADE, REAL, Scene, gimp3d, read_scenes, remove_words, scene_words, shadow_words
from .tables import Row, Section, columns, distance_to, markdown, sheet, values, where
from .timing import about, machine

SCENES = (*REAL, "kitchen_480")
EMPTIED, TELEA, PAPER = "emptied box", "telea", "paper"
BASELINES = (EMPTIED, TELEA, PAPER)
PRESETS = ("draft", "balanced", "best", PAPER)
CLEARANCE = 3.0  # px between the object and what counts as round it: pixels nearer to it are mixed
NEAR = 24.0  # px from the object within which a removal must do no harm
TOLERANCE = 5  # px by which the object's masks are dilated for its hidden volume
SHOWN = 8  # views of a scene without truth
AMPLIFIED = 4  # times the difference
# what is wanted
BELOW_RING = {GIVEN: 1.0, BUILT_IN: 4.0}  # dB by which the mask may fall short of the ring, mean over the real scenes
HARM = 0.05  # dB that the surroundings may lose
COVERED, AREA = {"real": 0.97, "made": 0.985}, {"real": 2.0, "made": 1.6}  # of T, at least and at most
INVENTED = {"real_table": 0.03}  # share of the mask at most
SECONDS = {("kitchen_480", "balanced"): 20.0}  # at most
ORDER = 0.8  # Spearman's coefficient, at least
LOST = {"psnr mask": 2.5, "psnr unseen": 4.0}  # dB that the built-in fill may lose to the true picture, in the mean


@dataclass(frozen=True)
class Run:
    """One removal of a scene."""

    preset: str
    given: bool  # the true picture of the first test view
    marked: bool  # the true shadow

    @property
    def kind(self) -> str:
        return GIVEN if self.given else BUILT_IN

    @property
    def name(self) -> str:
        return f"{self.preset}_{self.kind}" + "_shadow_marked" * self.marked


def planned(scene: Scene, presets: Sequence[str]) -> Iterator[Run]:
    """The scene's removals. The paper's preset is a baseline: run once, with the picture that its protocol gives.

    Without truth there is no picture to give, and nothing marked.
    """
    for marked in (False, True)[: 1 + scene.has_shadow]:
        for preset in presets:
            for given in (True, False)[not scene.has_truth :]:
                if preset != PAPER or (given, marked) == (scene.has_truth, scene.has_shadow):
                    yield Run(preset, given, marked)


def main() -> None:
    parser = parser_of(__doc__, "real", data=True, scenes=",".join(SCENES))
    parser.add_argument("--presets", default=",".join(PRESETS))
    parser.add_argument("--reuse", action="store_true", help="score removals that lie in OUT instead of running them")
    given = parser.parse_args()
    results: Row = {"machine": machine(), "rows": [], "coverage": [], "pictures": []}
    scenes = read_scenes(given.data, given.scenes)
    if not given.reuse:  # compile what is timed, by a removal with a single step of refinement, refused or not
        words = remove_words(scenes[0], given.out / "compiled.ply")
        gimp3d([*words, "--preset", "balanced", "--set", "refine.steps=1"])
    for scene in scenes:
        bench_scene(scene, given.presets.split(","), given.out, given.reuse, results)
        write_results(given.out, "real", results, report(results))


def bench_scene(scene: Scene, presets: Sequence[str], out: Path, reuse: bool, results: Row) -> None:
    """Add a scene's rows, its coverage and its sheets of pictures to the results."""
    folder, before = out / scene.name, {}
    if scene.has_truth:
        render_views(scene.folder / "scene.ply", scene.folder / "transforms.json", folder / "before", split="test")
        before = {f"{name} before": value for name, value in round_the_object(scene, folder / "before").items()}
        for marked in (False, True)[: 1 + scene.has_shadow]:
            counts = {"marked": marked, "counts": marked == scene.has_shadow}
            results["coverage"].append({"scene": scene.name, **counts, **masks(scene, marked, folder, reuse)})
            for method, renders in baselines(scene, marked, folder).items():
                row = {"scene": scene.name, "method": method, "kind": "", **counts, **before}
                results["rows"].append(row | scored(scene, renders))
    for run in planned(scene, presets):
        row = {"scene": scene.name, "method": run.preset, "kind": run.kind, "marked": run.marked, **before}
        row |= {"counts": run.marked == scene.has_shadow, **measured(scene, run, folder / run.name, reuse)}
        if "psnr mask" in row:
            row["error"] = row["ring before"] - row["psnr mask"]
        if "refused" not in row:
            names = write_sheets(scene, folder / run.name / "render", folder / run.name)
            results["pictures"] += [f"{scene.name}/{name}" for name in names]
        results["rows"].append(row)
        numbers = "".join(f"{row[key]:8.2f}" for key in ("psnr mask", "psnr unseen", "seconds") if key in row)
        say(f"{scene.name:16}{run.name:32}{numbers}{row.get('refused', '')}")


def masks(scene: Scene, marked: bool, folder: Path, reuse: bool) -> dict[str, float]:
    """Coverage of T as `gimp3d masks` writes it."""
    targets = folder / ("masks_shadow_marked" if marked else "masks")
    if not (reuse and targets.is_dir()):
        words = ["masks", *scene_words(scene), "--out", str(targets)]
        if message := gimp3d([*words, *(shadow_words(scene, folder) if marked else [])]):
            raise BadInput(message)
    return coverage(scene, targets)


def baselines(scene: Scene, marked: bool, folder: Path) -> dict[str, Path]:
    """Pictures of the emptied box, and of Telea's fill of the photos with the object (and the shadow, if marked)."""
    emptied, filled = folder / "emptied", folder / ("telea_shadow_marked" if marked else "telea")
    empty_region(scene.folder, emptied / "out.ply")
    render_views(emptied / "out.ply", scene.folder / "transforms.json", emptied / "render", split="test")
    for camera in scene.test:
        picture = telea(scene.with_object(camera), covered(scene, camera, marked))
        write_png(filled / f"{output_name(camera.id)}.png", picture)
    return {EMPTIED: emptied / "render", TELEA: filled}


def measured(scene: Scene, run: Run, folder: Path, reuse: bool) -> Row:
    """A removal's scores, or why it was refused."""
    out, refused, summary_path = folder / "out.ply", folder / "refused.txt", folder / "summary.json"
    if not (reuse and (summary_path.exists() or refused.exists())):
        for path in (out, refused, summary_path):
            path.unlink(missing_ok=True)
        words = [*remove_words(scene, out), "--summary", str(summary_path), "--preset", run.preset]
        if run.given:
            reference = scene.test[0].id
            words += ["--reference", reference, "--reference-image", str(scene.folder / reference)]
        marked = shadow_words(scene, folder.parent, run.preset != PAPER) if run.marked else []
        if message := gimp3d([*words, *marked]):
            write(refused, message)
    if refused.exists():
        return {"refused": refused.read_text()}
    summary = json.loads(summary_path.read_text())
    counts, cameras = summary["counts"], scene.folder / "transforms.json"
    row: Row = {"seconds": summary["seconds_total"], "score": (summary.get("verdict") or {}).get("score")}
    row |= {key: counts[key] for key in ("hole_pixels", "open_pixels")}
    row |= {key: counts[key] - counts["changed"] for key in ("removed", "added")}
    drawn: Any = {"split": "test"} if scene.has_truth else {"frames": [c.id for c in shown(scene)]}
    render_views(out, cameras, folder / "render", **drawn)
    if scene.has_truth:
        file = read_ply(out)
        new = np.arange(len(file.gaussians)) >= counts["gaussians_out"] - counts["added"] + counts["changed"]
        views = [(c, covered(scene, c, run.marked), surface_depth(scene.gaussians, c)[0]) for c in scene.train]
        astray = outside_hidden_volume(file.gaussians.means[new], views)
        row |= {"outside": float(astray.mean()) if new.any() else 0.0, **scored(scene, folder / "render")}
        write_ply(folder / "unfilled.ply", file, ~new)
        render_views(folder / "unfilled.ply", cameras, folder / "unfilled", split="test")
        unfilled = score_renders(scene.folder, folder / "unfilled", scene.test[0].id)
        row |= {f"{key} unfilled": value for key, value in unfilled.items()}
    return row


def scored(scene: Scene, renders: Path) -> dict[str, float]:
    after = {f"{name} after": value for name, value in round_the_object(scene, renders).items()}
    return score_renders(scene.folder, renders, scene.test[0].id) | after


def covered(scene: Scene, camera: Camera, marked: bool) -> np.ndarray:
    """[H, W] bool: what the object hides, and its shadow where that is marked."""
    return scene.hides(camera) | scene.shadow(camera) if marked else scene.hides(camera)


def shown(scene: Scene) -> list[Camera]:
    """Views that are looked at where there is no truth, spread over all."""
    chosen = np.unique(np.linspace(0, len(scene.train) - 1, SHOWN).round().astype(int))
    return [scene.train[k] for k in chosen]


# ----------------------------------------------------------------------------------------- round the object, its volume


def ring(mask: np.ndarray, left_out: np.ndarray) -> np.ndarray:
    """[H, W] bool, as what is given: the pixels nearest to the mask but not close to it, as many as it has, or all."""
    away = distance_to(mask)
    allowed = np.flatnonzero((away > CLEARANCE) & ~left_out)
    found = np.zeros(mask.shape, bool)
    found.flat[allowed[np.argsort(away.ravel()[allowed], kind="stable")[: mask.sum()]]] = True
    return found


def near(mask: np.ndarray, left_out: np.ndarray) -> np.ndarray:
    """[H, W] bool: pixels within NEAR of the mask but not close to it."""
    away = distance_to(mask)
    return (away > CLEARANCE) & (away <= NEAR) & ~left_out


def round_the_object(scene: Scene, renders: Path) -> dict[str, float]:
    """PSNR of drawn test views outside the object, means over them: "ring", "near", and in the true "shadow".

    Ring and near never hold the shadow: the truth has none, so a scene that was drawn perfectly would fail there.
    """
    found: dict[str, list[float]] = {}
    for camera in scene.test[1:]:
        drawn, truth = read_image(renders / f"{output_name(camera.id)}.png"), scene.truth(camera)
        mask, shadow = scene.hides(camera), scene.shadow(camera)
        regions = {"ring": ring(mask, shadow), "near": near(mask, shadow), "shadow": shadow}
        for name, region in regions.items():
            if region.any():
                found.setdefault(name, []).append(psnr(drawn, truth, region))
    return {name: float(np.mean(of)) for name, of in found.items()}


def outside_hidden_volume(
    points: np.ndarray,
    views: Sequence[tuple[Camera, np.ndarray, np.ndarray]],
    tolerance: int = TOLERANCE,
) -> np.ndarray:
    """[N] bool: points [N, 3] that some view shows beside what the object hides there, or that no view does.

    Views come with what the object hides [H, W] and z of what they show [H, W]: what lies behind another thing in one
    is not seen there.
    """
    framed, beside = np.zeros(len(points), bool), np.zeros(len(points), bool)
    kernel = np.ones((2 * tolerance + 1,) * 2, np.uint8)
    for camera, mask, depth in views:
        hidden = cv2.dilate(mask.astype(np.uint8), kernel) > 0
        uv, z = camera.project(points.astype(np.float64))
        within = np.flatnonzero((z > 0) & (uv >= 0).all(-1) & (uv < [camera.width, camera.height]).all(-1))
        cols, rows = uv[within].astype(int).T
        front = depth[rows, cols]
        shown = hidden[rows, cols] | (front == 0) | (z[within] < (1 + SAME_DEPTH) * front)
        framed[within] |= shown
        beside[within] |= shown & ~hidden[rows, cols]
    return beside | ~framed


def coverage(scene: Scene, targets: Path) -> dict[str, float]:
    """T in the training views, as `gimp3d masks` wrote it, against what no view sees.

    "covered": share of never-seen pixels that T holds; "area": T's over theirs; "invented": share of what the object
    hides that is in T although some view sees it.
    """
    sums = np.zeros(5)
    for camera in scene.train:
        target = read_mask(targets / f"{output_name(camera.id)}.png")
        mask, unseen = scene.hides(camera), scene.unseen(camera)
        sums += [m.sum() for m in (target & unseen, target, target & mask & ~unseen, unseen, mask)]
    found, own_pixels, invented, never_seen, hidden = sums.tolist()
    least = max(1, never_seen)
    return {"covered": found / least, "area": own_pixels / least, "invented": invented / max(1, hidden)}


# ------------------------------------------------------------------------------------------------------------- pictures


def write_sheets(scene: Scene, renders: Path, target: Path) -> list[str]:
    """A run's sheets, a row per view, whole and close up, beside the folder `target`; their names."""
    if scene.has_truth:
        rows = [with_truth(scene, c, renders) for c in scene.test]
        windows = [bounds(m, int(np.sqrt(m.sum()) / 2)) for m in map(scene.hides, scene.test)]
        close = [{words: picture[window] for words, picture in row.items()} for row, window in zip(rows, windows)]
        sheets = {f"{target.name}.png": rows, f"{target.name}.close.png": close}
    else:
        drawn = {c.id: read_image(renders / f"{output_name(c.id)}.png") for c in shown(scene)}
        sheets = {f"{target.name}.png": [{output_name(i): scene.photos[i], "result": p} for i, p in drawn.items()]}
    for name, of in sheets.items():
        write_png(target.with_name(name), sheet(of))
    return list(sheets)


def with_truth(scene: Scene, camera: Camera, renders: Path) -> dict[str, np.ndarray]:
    """Photo with the object, truth, result, and how they differ, with the outline of what the object hides."""
    name, truth = output_name(camera.id), scene.truth(camera)
    drawn, mask = read_image(renders / f"{name}.png"), scene.hides(camera)
    wrong = np.clip(AMPLIFIED * np.abs(drawn.astype(int) - truth), 0, 255).astype(np.uint8)
    contours, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(wrong, contours, -1, (255, 255, 255), 1)
    title = name + " (not scored)" * (camera is scene.test[0])
    words = f"result: {psnr(drawn, truth, mask):.2f} dB"
    return {title: scene.with_object(camera), "truth": truth, words: drawn, f"{AMPLIFIED} x difference": wrong}


# ---------------------------------------------------------------------------------------------------------------- goals


@dataclass(frozen=True)
class Goal:
    """What is wanted of the results, and what was found."""

    name: str
    wanted: str
    found: str
    met: bool


def goals(results: Row) -> Iterator[Goal]:
    """Every goal about which something was measured."""
    rows = where(results["rows"], counts=True)
    runs = [r for r in rows if r["method"] not in BASELINES]
    for preset in values(runs, "method"):
        own = where(runs, method=preset)
        for kind in BELOW_RING:
            yield from _mean_below_ring(preset, kind, own)
        if done := [r for r in own if "psnr mask" in r]:
            yield from _worst_goals(preset, done, rows, sum("refused" in r for r in own))
            yield from _lost_goals(preset, done)
    yield from _coverage_goals(where(results["coverage"], counts=True))
    for (scene, preset), most in SECONDS.items():
        for row in (r for r in where(runs, scene=scene, method=preset) if "seconds" in r):
            words = f"{row['seconds']:.1f} s on {results['machine']['cores']} cores"
            yield Goal(f"{scene}, {preset}", f"≤ {most:g} s", words, row["seconds"] <= most)
    order = agreement(results["rows"])
    if order is not None:
        yield Goal("order of the verdict's score, Spearman", f"≥ {ORDER:g}", f"{order:.2f}", order >= ORDER)


def _mean_below_ring(preset: str, kind: str, runs: Sequence[Row]) -> Iterator[Goal]:
    own = [r for r in where(runs, kind=kind) if r["scene"] in REAL]
    done = [r["error"] for r in own if "error" in r]
    if done:
        wanted, mean = BELOW_RING[kind], float(np.mean(done))
        words = f"ring − {mean:.2f} dB" if mean >= 0 else f"ring + {-mean:.2f} dB"
        words += "" if len(done) == len(REAL) else f" ({len(done)} of {len(REAL)} scenes)"
        met = mean <= wanted and len(done) == len(own)
        yield Goal(f"{preset}, {kind}: mask, mean over real scenes", f"≥ ring − {wanted:g} dB", words, met)


def _worst_goals(preset: str, done: Sequence[Row], rows: Sequence[Row], refused: int) -> Iterator[Goal]:
    def margin(row: Row) -> float:
        simple = [r for r in where(rows, scene=row["scene"]) if r["method"] in (EMPTIED, TELEA)]
        return row["psnr mask"] - max(r["psnr mask"] for r in simple)

    kinds = (
        ("mask against the better of emptied box and Telea", "≥ 0 dB", margin, 0.0, refused),
        ("mask against its own removal, not filled", "≥ 0 dB", gain, 0.0, 0),
        ("round the object against before", f"≥ −{HARM:g} dB", harm, -HARM, 0),
    )
    for name, wanted, of, least, lost in kinds:
        worst = min(done, key=of)
        words = f"{of(worst):+.2f} dB in {worst['scene']}, {worst['kind']}" + (f"; {lost} refused" if lost else "")
        yield Goal(f"{preset}: {name}, worst", wanted, words, of(worst) >= least and not lost)
    worst = max(done, key=lambda r: r["outside"])
    words = f"{worst['outside']:.1%} in {worst['scene']}, {worst['kind']}"
    yield Goal(f"{preset}: new Gaussians outside the hidden volume, most", "none", words, worst["outside"] == 0)


def _lost_goals(preset: str, done: Sequence[Row]) -> Iterator[Goal]:
    """What the built-in fill loses to the true picture."""
    pairs = [where(done, scene=scene, kind=kind) for scene in values(done, "scene") for kind in (GIVEN, BUILT_IN)]
    both = [(a[0], b[0]) for a, b in zip(pairs[::2], pairs[1::2]) if a and b]
    for key, most in LOST.items():
        lost = [a[key] - b[key] for a, b in both if key in a and key in b]
        if lost:
            words, met = f"{np.mean(lost):.2f} dB", bool(np.mean(lost) <= most)
            yield Goal(f"{preset}: {key}, lost by the built-in fill, mean", f"≤ {most:g} dB", words, met)


def _coverage_goals(rows: Sequence[Row]) -> Iterator[Goal]:
    for kind, names in (("real", REAL), ("made", MADE)):
        if own := [c for c in rows if c["scene"] in names]:
            least, most = min(own, key=lambda c: c["covered"]), max(own, key=lambda c: c["area"])
            words, met = f"{least['covered']:.3f} in {least['scene']}", least["covered"] >= COVERED[kind]
            yield Goal(f"T covers what no view sees, {kind} scenes, least", f"≥ {COVERED[kind]:g}", words, met)
            words, met = f"{most['area']:.2f}× in {most['scene']}", most["area"] <= AREA[kind]
            yield Goal(f"T's size over that, {kind} scenes, most", f"≤ {AREA[kind]:g}×", words, met)
    for c in (c for c in rows if c["scene"] in INVENTED):
        words, most = f"{c['invented']:.1%}", INVENTED[c["scene"]]
        yield Goal(f"{c['scene']}: mask invented though seen", f"≤ {most:.0%}", words, c["invented"] <= most)


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


# --------------------------------------------------------------------------------------------------------------- tables


def report(results: Row) -> str:
    return markdown("Real scenes", about(results["machine"]), sections(results), results["pictures"])


def sections(results: Row) -> Iterator[Section]:
    rows = results["rows"]
    yield Section(
        "Goals",
        "Scenes with a shadow count with the true shadow marked.",
        ["goal", "wanted", "found", ""],
        [[g.name, g.wanted, g.found, "met" if g.met else "UNMET"] for g in goals(results)],
    )
    head = ["scene", "shadow", "method", "picture", "PSNR mask", "SSIM", "FLIP", "PSNR unseen", "SSIM", "FLIP"]
    head += ["not filled", "ring", "near", "in the shadow", "outside", "removed", "added", "open px", "seconds"]
    yield Section(
        "Scores",
        "Means over the test views but the first. Not filled: PSNR in mask and unseen of the same removal without its "
        "new Gaussians. Ring: PSNR of as many pixels round the mask as it has, before (the ceiling) and after. Near: "
        f"{NEAR:g} px round it, after and what the removal changed there. The object's shadow is left out of both; its "
        "own column has its PSNR before and after. Outside: share of the new Gaussians outside the object's hidden "
        "volume.",
        head,
        [_score_cells(r, len(head)) for r in rows],
    )
    if results["coverage"]:
        yield Section(
            "Coverage of T",
            "Training views. Covered: share of the pixels that no view sees that T holds. Area: of T over theirs. "
            "Invented: share of the mask that is in T though some view sees it.",
            *columns(({**c, "shadow": _shadow(c)} for c in results["coverage"]), OF_COVERAGE),
        )
    judged = [r for r in rows if r.get("score") is not None and "error" in r]
    if judged:
        order = agreement(rows)
        yield Section(
            "Verdict against truth",
            "Error: PSNR of the ring before the removal less that of the mask, dB. Spearman's coefficient: "
            + (f"{order:.2f}." if order is not None else "nothing to be ordered."),
            *columns(({**r, "shadow": _shadow(r)} for r in sorted(judged, key=lambda r: -r["score"])), OF_VERDICTS),
        )


OF_COVERAGE = {"scene": "{scene}", "shadow": "{shadow}", "covered": "{covered:.3f}", "area": "{area:.2f}"}
OF_COVERAGE |= {"invented": "{invented:.1%}"}
OF_VERDICTS = {"scene": "{scene}", "shadow": "{shadow}", "method": "{method}", "picture": "{kind}"}
OF_VERDICTS |= {"score": "{score:.3f}", "error": "{error:+.2f}"}


def _score_cells(row: Row, width: int) -> list[str]:
    start = [row["scene"], _shadow(row), row["method"], row["kind"]]
    if "refused" in row:
        return [*start, row["refused"], *[""] * (width - len(start) - 1)]

    def cell(key: str, form: str) -> str:
        return form.format(row[key]) if key in row else ""

    masks = [(metric, mask) for mask in ("mask", "unseen") for metric in ("psnr", "ssim", "flip")]
    found = [cell(f"{metric} {mask}", "{:.2f}" if metric == "psnr" else "{:.3f}") for metric, mask in masks]
    bare = [cell(f"psnr {mask} unfilled", "{:.2f}") for mask in ("mask", "unseen")]
    rings = ["", "", ""]
    if row["method"] != TELEA:  # photos: their surroundings say nothing of a removal
        pairs = [(cell(f"{n} before", "{:.2f}"), cell(f"{n} after", "{:.2f}")) for n in ("ring", "near", "shadow")]
        rings = [f"{before} → {after}" if before and after else "" for before, after in pairs]
        rings[1] = f"{row['near after']:.2f} ({harm(row):+.2f})" if rings[1] else ""
    ends = [cell("outside", "{:.1%}"), *(cell(key, "{}") for key in ("removed", "added", "open_pixels"))]
    return [*start, *found, " / ".join(filter(None, bare)), *rings, *ends, cell("seconds", "{:.1f}")]


def _shadow(row: Row) -> str:
    return "marked" if row["marked"] else ""


if __name__ == "__main__":
    told_in_one_line(main)
