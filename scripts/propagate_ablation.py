"""What each step of propagation is worth: painted views against the truth, and against one another."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from typing import Any
from unittest import mock

import cv2
import numpy as np
from bench_raster import say
from made_room import loaders
from propagate_cost import Size, room

from gimp3d import pipeline
from gimp3d.box import read_region
from gimp3d.camera import Camera, output_name
from gimp3d.commands import select_cameras
from gimp3d.errors import BadInput
from gimp3d.evaluate.metrics import flip_map, psnr, ssim_map
from gimp3d.gaussians import Gaussians
from gimp3d.io.cameras import read_cameras
from gimp3d.io.images import read_image, read_mask, write_png
from gimp3d.io.ply import read_ply
from gimp3d.report import RULE_COLOURS, tinted
from gimp3d.stages.propagate import Loader, PropagateSettings, Propagation, Reference, Rule, ViewToPaint, propagate
from gimp3d.stages.refine import RefineSettings
from gimp3d.stages.seed import seed_gaussians

OURS = PropagateSettings()
PAPER = PropagateSettings(transfer="sample", blend="rim", retarget=0, donors=0)
STEPS = {
    "warp, paper's blend": PropagateSettings(transfer="none", blend="rim"),
    "paper: warp + mapping": PAPER,
    "paper: + retargeting": replace(PAPER, retarget=OURS.retarget),
    "paper: + other views": replace(PAPER, retarget=OURS.retarget, donors=OURS.donors),
    "warp, blend fitted to photo": PropagateSettings(transfer="none"),
    "+ colours learned round the hole": replace(OURS, mapped=0.0, retarget=0),
    "+ mapping": replace(OURS, retarget=0),
    "+ retargeting": OURS,
}
UNFILLED, SPLATTED, UNBLENDED, EXTRA = "no fill", "reference only", "warp, not blended", "+ extra references"
METHODS = (UNFILLED, SPLATTED, UNBLENDED, *STEPS, EXTRA)
WARP, MAPPED = "warp, blend fitted to photo", "+ retargeting"  # what the mapping must beat, and the mapping
REACHED = (Rule.OWN_PIXELS, Rule.REFERENCE, Rule.RETARGETED)
SAME_POINT = 0.01  # relative difference of true depths within which two views show one point
COMPARED = (UNBLENDED, "paper: + other views", WARP, MAPPED, EXTRA)


@dataclass(frozen=True)
class TestView:
    """A view that the object hides part of, and the truth."""

    camera: Camera
    truth: np.ndarray  # [H, W, 3] uint8
    masks: dict[str, np.ndarray]  # mask, unseen: [H, W] bool
    depth: np.ndarray  # [H, W] z without the object


@dataclass(frozen=True)
class Case:
    """A scene's removal up to the propagation, and what came of the whole of it."""

    name: str
    tests: tuple[TestView, ...]
    reference: Reference
    views: dict[str, ViewToPaint]  # before the hole is painted
    splatted: dict[str, np.ndarray]  # the emptied views with the first reference's Gaussians drawn in the hole
    final: dict[str, np.ndarray]  # painted views after the extra references


def read_case(folder: Path) -> Case:
    """Run a removal with the true picture of the first test view as reference; the other test views are painted.

    Their pictures with the object are what is painted; their pictures without it are read for scores only.
    """
    if not (folder / "truth").is_dir():
        raise BadInput(
            f"bench_propagate: {folder} has no truth/; give the folder of scenes with and without the object"
        )
    cameras = read_cameras(folder / "transforms.json")
    train, test = select_cameras(cameras, "train"), select_cameras(cameras, "test")
    views = [pipeline.View(c, read_image(folder / c.id)) for c in train]
    views += [pipeline.View(c, read_image(folder / "images" / f"with_test_{Path(c.id).stem}.png")) for c in test]
    scene, region = read_ply(folder / "scene.ply").gaussians, read_region(folder / "roi.json")
    rounds: list[tuple[Reference, list[ViewToPaint]]] = []
    seeds: list[Gaussians] = []

    def propagate_seen(reference: Reference, loads: Sequence[Loader], *more: Any) -> Propagation:
        # loaded now: later rounds change what the loaders give
        rounds.append((reference, [] if rounds else [load() for load in loads]))
        return propagate(reference, loads, *more)

    def seeds_seen(*args: Any) -> Gaussians:
        seeds.append(seed_gaussians(*args))
        return seeds[-1]

    settings = replace(pipeline.PRESETS["balanced"], refine=RefineSettings(steps=0))  # it changes no painted view
    with mock.patch.multiple(pipeline, propagate=propagate_seen, seed_gaussians=seeds_seen):
        result = pipeline.remove_object(scene, views, region, settings, test[0].id, read_image(folder / test[0].id))
    reference, painted = rounds[0]
    filled = scene.take(result.keep).extended(seeds[0])
    splatted = {c.id: pipeline.render_bytes(filled, c) for c in test[1:]}
    tests = tuple(_test_view(folder, c) for c in test[1:])
    return Case(folder.name, tests, reference, {v.camera.id: v for v in painted}, splatted, result.painted)


def _test_view(folder: Path, camera: Camera) -> TestView:
    stem = folder / "truth" / output_name(camera.id)
    masks = {kind: read_mask(stem.with_name(f"{stem.name}.{kind}.png")) for kind in ("mask", "unseen")}
    depth = np.load(stem.with_name(f"{stem.name}.depth.npy"), allow_pickle=False).astype(np.float64)
    return TestView(camera, read_image(folder / camera.id), masks, depth)


def measure(case: Case, out: Path | None) -> dict[str, Any]:
    """Scores per method and view, and how well a method's views agree."""
    pictures, rules = painted_views(case)
    scores = []
    for k, test in enumerate(case.tests):
        masks = {**test.masks, "painted": test.masks["mask"] & np.isin(rules[test.camera.id], REACHED)}
        for method in METHODS:
            row = _scores(pictures[method][test.camera.id], test.truth, masks)
            scores.append({"scene": case.name, "view": test.camera.id, "method": method, **row})
        if out is not None:
            write_png(out / f"{case.name}_{k + 1}.png", _sheet(case, test, pictures, rules[test.camera.id]))
    shares = np.bincount(np.concatenate([r.ravel() for r in rules.values()]), minlength=len(Rule))[1:]
    mean = {m: np.mean([r["painted"]["psnr"] for r in scores if r["method"] == m]) for m in (WARP, MAPPED)}
    say(f"{case.name}: painted pixels, {WARP} {mean[WARP]:.2f} dB, {MAPPED} {mean[MAPPED]:.2f} dB")
    return {
        "scores": scores,
        "consistency": [{"scene": case.name, **row} for row in consistency(case.tests, pictures, rules)],
        "rules": {"scene": case.name, **{r.name: float(shares[r - 1] / shares.sum()) for r in list(Rule)[1:]}},
    }


def painted_views(case: Case) -> tuple[dict[str, dict[str, np.ndarray]], dict[str, np.ndarray]]:
    """Pictures by method and view, and the rules of the full method."""
    names = [t.camera.id for t in case.tests]
    views = {name: case.views[name] for name in names}
    others = [lambda v=v: v for name, v in case.views.items() if name not in names]
    pictures: dict[str, dict[str, np.ndarray]] = {UNFILLED: {n: views[n].base for n in names}}
    pictures[SPLATTED] = {n: np.where(views[n].target[..., None], case.splatted[n], views[n].base) for n in names}
    rules: dict[str, np.ndarray] = {}
    for method, settings in STEPS.items():
        lenders = others if settings.donors and settings.transfer == "sample" else []
        done = propagate(case.reference, [*(lambda v=v: v for v in views.values()), *lenders], settings)
        parts = dict(zip(names, done.views))
        pictures[method] = {n: p.pasted(views[n].base) for n, p in parts.items()}
        if method == WARP:
            pictures[UNBLENDED] = {n: p.pasted(views[n].base, p.raw) for n, p in parts.items()}
        if method == MAPPED:
            rules = {n: p.rule_map(*views[n].target.shape) for n, p in parts.items()}
    pictures[EXTRA] = {n: case.final[n] for n in names}
    return pictures, rules


def _scores(picture: np.ndarray, truth: np.ndarray, masks: dict[str, np.ndarray]) -> dict[str, dict[str, float]]:
    alike, error = ssim_map(picture, truth), flip_map(picture, truth)
    detail, wanted = _detail(picture), _detail(truth)
    return {
        name: {
            "psnr": psnr(picture, truth, mask),
            "ssim": float(alike[mask].mean()),
            "flip": float(error[mask].mean()),
            "sharpness": float(detail[mask].mean() / wanted[mask].mean()),
        }
        for name, mask in masks.items()
    }


def _detail(picture: np.ndarray) -> np.ndarray:
    """[H, W] size of the Laplacian of the luminance: blur lowers it, noise raises it."""
    grey = cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY).astype(np.float32)
    return np.abs(cv2.Laplacian(grey, cv2.CV_32F))


def consistency(
    tests: Sequence[TestView], pictures: dict[str, dict[str, np.ndarray]], rules: dict[str, np.ndarray]
) -> list[dict[str, Any]]:
    """Error of each painted view against the others, warped to it by the true depth; short and long baselines apart."""
    points = tests[0].camera.unproject(tests[0].camera.pixel_centres(), tests[0].depth)[tests[0].masks["mask"]]
    centre = np.median(points, axis=0)
    pairs = [(a, b, _angle(a.camera, b.camera, centre)) for a, b in combinations(tests, 2)]
    middle = float(np.median([angle for *_, angle in pairs]))
    rows = []
    for method in (*COMPARED, "truth"):
        for baseline in ("short", "long"):
            chosen = [(a, b) for a, b, angle in pairs if (angle <= middle) == (baseline == "short")]
            squares, beyond, compared, hidden = 0.0, 0.0, 0, 0
            found_detail, true_detail = 0.0, 0.0
            for one, other in [*chosen, *((b, a) for a, b in chosen)]:
                hole = one.masks["mask"] & np.isin(rules[one.camera.id], REACHED)
                rows_, cols_, x, y = _matches(one, other, hole)
                true = _difference(one.truth, other.truth, rows_, cols_, x, y)
                mine, theirs = (t.truth if method == "truth" else pictures[method][t.camera.id] for t in (one, other))
                found = _difference(mine, theirs, rows_, cols_, x, y)
                found_detail += float(_detail(mine)[rows_, cols_].sum())
                true_detail += float(_detail(one.truth)[rows_, cols_].sum())
                squares, beyond = squares + float((found**2).sum()), beyond + float(((found - true) ** 2).sum())
                compared, hidden = compared + len(rows_), hidden + int(one.masks["mask"].sum())
            rows.append(
                {
                    "method": method,
                    "baseline": baseline,
                    "psnr": _decibels(squares, compared),
                    "psnr_beyond": _decibels(beyond, compared),
                    "coverage": compared / max(1, hidden),
                    "sharpness": found_detail / max(true_detail, 1e-9),
                    "median_degrees": float(
                        np.degrees(np.median([g for *_, g in pairs if (g <= middle) == (baseline == "short")]))
                    ),
                }
            )
    return rows


def _difference(
    one: np.ndarray, other: np.ndarray, rows: np.ndarray, cols: np.ndarray, x: np.ndarray, y: np.ndarray
) -> np.ndarray:
    """[N, 3] grey levels between a picture's pixels and the other's at (x, y)."""
    warped = cv2.remap(other, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)[:, 0]
    return one[rows, cols].astype(float) - warped


def _decibels(squares: float, pixels: int) -> float:
    return 10 * float(np.log10(255.0**2 * 3 * max(1, pixels) / max(squares, 1e-9)))


def _angle(a: Camera, b: Camera, centre: np.ndarray) -> float:
    one, other = (centre - c.centre for c in (a, b))
    return float(np.arccos(np.clip(one @ other / np.linalg.norm(one) / np.linalg.norm(other), -1, 1)))


def _matches(one: TestView, other: TestView, hole: np.ndarray) -> tuple[np.ndarray, ...]:
    """Pixels of a view's hole that the other view shows, and where: rows, columns, x, y [N, 1] as OpenCV samples."""
    rows, cols = np.nonzero(hole & (one.depth > 0))
    points = one.camera.unproject(np.stack([cols + 0.5, rows + 0.5], -1), one.depth[rows, cols])
    uv, z = other.camera.project(points)
    height, width = other.depth.shape
    framed = (z > 0) & (uv > 0.5).all(-1) & (uv[:, 0] < width - 0.5) & (uv[:, 1] < height - 0.5)
    j, i = np.where(framed[:, None], uv, 0).astype(int).T
    shown = framed & (np.abs(other.depth[i, j] - z) < SAME_POINT * z)
    x, y = (uv[shown].astype(np.float32) - 0.5).T.reshape(2, -1, 1)
    return rows[shown], cols[shown], x, y


def made_room(size: Size) -> list[dict[str, Any]]:
    """The same steps where half of the floor is glossy and everything is known: pixels painted, by view."""
    reference, shots = room(size)
    steps = {**STEPS, UNBLENDED: STEPS[WARP]}
    rows = []
    for method, settings in steps.items():
        done = propagate(reference, loaders(shots, len(shots)), settings)
        for k, (part, shot) in enumerate(zip(done.views, shots)):
            if k == 0:
                continue  # the reference
            picture = part.pasted(shot.view.base, part.raw if method == UNBLENDED else None)
            painted = np.isin(part.rule_map(*shot.view.target.shape), (*REACHED, Rule.OTHER_VIEW))
            rows.append({"view": k, "method": method, "psnr": psnr(picture, shot.truth, painted)})
    return rows


def _sheet(case: Case, test: TestView, pictures: dict[str, dict[str, np.ndarray]], rules: np.ndarray) -> np.ndarray:
    """A view's hole: emptied, unblended, the paper's way, ours, with extra references, the truth, rules."""
    name = test.camera.id
    marked = pictures[MAPPED][name]
    for rule, (_, colour) in RULE_COLOURS.items():
        marked = tinted(marked, rules == rule, colour)
    methods = (UNFILLED, UNBLENDED, "paper: + other views", MAPPED, EXTRA)
    tiles = [case.views[name].image, *(pictures[m][name] for m in methods), test.truth, marked]
    rows, cols = np.nonzero(test.masks["mask"] | (rules > 0))
    part = np.s_[max(0, rows.min() - 10) : rows.max() + 11, max(0, cols.min() - 10) : cols.max() + 11]
    half = len(tiles) // 2
    return np.vstack([np.hstack([t[part] for t in tiles[:half]]), np.hstack([t[part] for t in tiles[half:]])])
