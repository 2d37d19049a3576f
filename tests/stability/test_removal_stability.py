"""Whole removals bend under wrong input and do not break: nothing explodes, and a hole is never worse for its fill.

The fast tests use the made scene, whose truth is known; `make bench-stability` measures rendered ones.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from functools import cache, partial
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from scenes import REGION, cameras, scene, truth
from scipy.ndimage import binary_dilation

from benchmarks.perturbations import exposed, garbled, gathered, misplaced, noisy_depths, noisy_surfaces
from benchmarks.scenes import filled, mean_psnrs, read_scene, removal
from benchmarks.stability import draw, perturbed_views, report
from gimp3d.camera import Camera
from gimp3d.evaluate import psnr
from gimp3d.pipeline import PRESETS, RemovalResult, View, remove_object, render_bytes
from gimp3d.run import Observer

ROOT = Path(__file__).resolve().parents[2]
REFERENCE, *OTHERS = cameras(9)
ALL = (REFERENCE, *OTHERS)
PHOTOS = {c.id: render_bytes(scene(), c) for c in ALL}
TRUTH = {c.id: render_bytes(truth(), c) for c in ALL}
DIAGONAL = float(np.linalg.norm(REGION[0].size))


def removed(
    views: tuple[Camera, ...] = ALL,
    photos: dict[str, np.ndarray] | None = None,
    observer: Observer | None = None,
) -> RemovalResult:
    """The block removed, the reference's true picture given."""
    photos = photos or {c.id: render_bytes(scene(), c) for c in views}
    given = [View(c, photos[c.id]) for c in views]
    settings, picture = PRESETS["draft"], TRUTH[REFERENCE.id]
    return remove_object(scene(), given, REGION, settings, REFERENCE.id, picture, observer=observer)


HIDDEN = {c.id: (np.abs(PHOTOS[c.id].astype(int) - TRUTH[c.id]) > 20).any(-1) for c in OTHERS}


def score(result: RemovalResult, filled: bool = True, whole: bool = False) -> float:
    """Mean PSNR of the other views in what the block hides, or of whole pictures."""
    splats = scene().take(result.keep)
    if filled and result.added:
        splats = splats.extended(result.added)
    where = {c.id: HIDDEN[c.id] | whole for c in OTHERS}
    return float(np.mean([psnr(render_bytes(splats, c), TRUTH[c.id], where[c.id]) for c in OTHERS]))


@cache
def unperturbed() -> float:
    return score(removed())


@cache
def flat() -> float:
    """The same where what the block hides has one colour, that of what is round it."""
    painted = {}
    for name, hidden in HIDDEN.items():
        ring = binary_dilation(hidden, iterations=8) & ~hidden
        painted[name] = np.where(hidden[..., None], np.median(PHOTOS[name][ring], 0), TRUTH[name])
    return float(np.mean([psnr(p.astype(np.uint8), TRUTH[name], HIDDEN[name]) for name, p in painted.items()]))


def near(degrees: float, cameras: list[Camera] = OTHERS) -> RemovalResult:
    """All views within so many degrees of the reference."""
    return removed((REFERENCE, *gathered(cameras, REFERENCE, REGION[0].center, degrees)))


def photographed(wrong: dict[str, np.ndarray]) -> RemovalResult:
    return removed(ALL, {**PHOTOS, **wrong})


PICTURES = {c.id: PHOTOS[c.id] for c in OTHERS}
# What is wrong, and by how many dB the result may be worse than without; None where surfaces are as rough as gravel.
# Fewer views are not worse here: they leave more of the hole to the reference, whose picture is the true one.
CASES: dict[str, tuple[Callable[[], RemovalResult], Callable[[], AbstractContextManager[None]], float | None]] = {
    "one view": (lambda: removed((REFERENCE,)), nullcontext, 1),
    "two views 1° apart": (lambda: near(1.0, OTHERS[:1]), nullcontext, 1),
    "all views within 10°": (lambda: near(10.0), nullcontext, 3),
    "exposures off by 20 %": (lambda: photographed(exposed(PICTURES, 0.2, 0)), nullcontext, 0.5),
    "two of nine photos exchanged": (lambda: photographed(misplaced(PICTURES, 0.1, 0)), nullcontext, 3),
    "a tenth of all pixels wrong": (lambda: photographed(garbled(PICTURES, 0.1, 0)), nullcontext, 2.5),
    "surface off by 1 %": (lambda: removed(observer=noisy_surfaces(0.01, 0)), nullcontext, 3),
    "surface off by 10 %": (lambda: removed(observer=noisy_surfaces(0.1, 0)), nullcontext, None),
    "all depths off by 1 %": (removed, partial(noisy_depths, 0.01, 0), 1),
    "all depths off by 10 %": (removed, partial(noisy_depths, 0.1, 0), None),
}


@pytest.mark.parametrize("case", [pytest.param(c, marks=[pytest.mark.slow] * (k % 2)) for k, c in enumerate(CASES)])
def test_nothing_explodes(case: str) -> None:
    work, wrong, loss = CASES[case]
    with wrong():
        result = work()
    new = result.added
    assert new is not None
    assert all(np.isfinite(a).all() for a in (new.means, new.log_scales, new.quats, new.opacity_logits, new.sh))
    # The floor ends five boxes away; a splat is never larger than the hole.
    assert new.scales.max() < DIAGONAL / 2
    assert np.linalg.norm(new.means - REGION[0].center, axis=1).max() < 5 * DIAGONAL
    assert score(result) > score(result, filled=False) + 3
    gained = score(result, whole=True) - score(result, filled=False, whole=True)
    if loss is not None:
        assert score(result) > unperturbed() - loss and gained > 5
        return
    # Better than one colour; what it spills over its surroundings costs about what it gains, and the verdict says so.
    assert result.verdict is not None and score(result) > flat() and gained > -1
    assert any("surroundings lost" in words for words in result.verdict.words)


def test_a_fill_that_is_not_rough_does_not_warn_of_its_surroundings() -> None:
    """Or the warning above would say nothing."""
    for result in (removed(), removed(observer=noisy_surfaces(0.01, 0))):
        assert result.verdict is not None and not any("surroundings lost" in w for w in result.verdict.words)


def test_more_noise_is_worse_but_never_worse_than_the_hole() -> None:
    found = [score(removed(observer=noisy_surfaces(relative, 0))) for relative in (0.01, 0.03, 0.1)]
    assert unperturbed() + 1 > found[0] > found[1] > found[2] > score(removed(), filled=False) + 3  # 1 dB: chance


def test_wrong_photos_are_as_wrong_as_they_say_and_the_same_every_time() -> None:
    name = OTHERS[0].id
    for perturb, share in ((exposed, 0.2), (misplaced, 0.25), (garbled, 0.25)):
        once, again, other = (perturb(PICTURES, share, seed) for seed in (3, 3, 4))
        assert all((once[n] == again[n]).all() for n in PICTURES) and list(once) == list(PICTURES)
        assert any((once[n] != other[n]).any() for n in PICTURES)
    changed = [n for n, p in misplaced(PICTURES, 0.25, 0).items() if (p != PICTURES[n]).any()]
    assert len(changed) == 2
    flat = {n: np.full_like(p, 100) for n, p in PICTURES.items()}
    gains = np.array([p.mean() / 100 for p in exposed(flat, 0.2, 0).values()])
    assert 0.8 <= gains.min() < 1 < gains.max() <= 1.2 and len(np.unique(gains)) == len(gains)
    noise = {n: np.random.default_rng(0).integers(0, 256, p.shape, np.uint8) for n, p in PICTURES.items()}
    wrong = np.mean([(p != noise[n]).any(-1).mean() for n, p in garbled(noise, 0.25, 0).items()])
    assert 0.15 < wrong < 0.35 and (garbled(noise, 0, 0)[name] == noise[name]).all()


@pytest.mark.parametrize("degrees", [1.0, 10.0, 90.0])
def test_gathered_views_look_at_the_region_from_one_side(degrees: float) -> None:
    centre = REGION[0].center
    found = gathered(OTHERS, REFERENCE, centre, degrees)
    towards = [(c.centre - centre) / np.linalg.norm(c.centre - centre) for c in (REFERENCE, *found)]
    angles = np.degrees(np.arccos(np.clip([t @ towards[0] for t in towards[1:]], -1, 1)))
    assert angles.max() == pytest.approx(degrees, rel=1e-6) and angles.std() > 0
    for camera in found:
        assert np.linalg.norm(camera.centre - centre) == pytest.approx(np.linalg.norm(REFERENCE.centre - centre))
        np.testing.assert_allclose(camera.project(centre)[0], REFERENCE.project(centre)[0], atol=1e-6)
        np.testing.assert_allclose(camera.R @ camera.R.T, np.eye(3), atol=1e-12)


def test_only_completed_surfaces_are_off() -> None:
    exact: dict[str, Any] = {}
    off: list[str] = []

    def watched(name: str, work: Callable[..., Any], inputs: tuple[Any, ...]) -> Any:
        exact[name] = work(*inputs)
        found = noisy_surfaces(0.1, 0)(name, lambda *_: exact[name], inputs)
        off.extend([name] * (found is not exact[name]))
        return found

    removed(observer=watched)
    assert off and all(name.startswith("depth") for name in off)


def test_table_and_chart_show_what_was_refused(tmp_path: Path) -> None:
    row = {"scene": "desk", "kind": "none", "level": 0.0, "mask": 30.0, "unseen": 28.0, "open mask": 12.0}
    row |= {"open unseen": 9.0, "added": 10, "finite": True, "largest": 0.02, "farthest": 0.5, "warnings": ["careful"]}
    worse = row | {"kind": "surface", "level": 0.1, "mask": 20.0, "finite": False, "largest": 0.3}
    refused = {"scene": "desk", "kind": "surface", "level": 0.03, "refused": "sees no hole"}
    results = {
        "machine": {"cpu": "any", "cores": 4, "load_at_start": [0.0]},
        "preset": "draft",
        "rows": [row, worse, refused],
    }
    words = report(results)
    assert "| 20.00 |" in words and "| NO |" in words and "| sees no hole |" in words and "| careful |" in words
    draw(results, tmp_path / "chart.svg")
    drawn = ElementTree.parse(tmp_path / "chart.svg").getroot()
    assert {"Surface off, %", "10", "3"} <= {t.text for t in drawn.iter("{http://www.w3.org/2000/svg}text")}


@pytest.mark.slow
def test_on_a_rendered_scene_it_bends_too(shared_data: Path, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "benchmarks.stability", str(shared_data / "withwithout"), "--quick"]
    done = subprocess.run(
        [*command, "--preset", "draft", "--out", str(tmp_path)], cwd=ROOT, capture_output=True, text=True, timeout=500
    )
    assert done.returncode == 0, done.stderr
    rows = {r["kind"]: r for r in json.loads((tmp_path / "stability.json").read_text())["rows"]}
    assert set(rows) == {"none", "views", "misplaced", "surface"} and all(r["finite"] for r in rows.values())
    assert all(r["mask"] > r["open mask"] + 5 and r["largest"] < 0.5 for r in rows.values())
    assert rows["misplaced"]["mask"] > rows["none"]["mask"] - 1
    ElementTree.parse(tmp_path / "stability.svg")


@pytest.mark.slow
def test_two_true_pictures_give_nearly_the_same_removal(shared_data: Path) -> None:
    desk = read_scene(shared_data / "withwithout" / "desk", needs_truth=True)
    given = [removal(desk, PRESETS["draft"], camera, desk.truth(camera)) for camera in desk.test[:2]]
    one, other = (mean_psnrs(desk, filled(desk.gaussians, result), desk.test[2:])["mask"] for result in given)
    assert abs(one - other) < 1.1  # dB; σ of the two 0.8


def test_without_scenes_the_benchmark_says_so_in_one_line(tmp_path: Path) -> None:
    out = str(tmp_path / "out")
    command = [sys.executable, "-m", "benchmarks.stability", str(tmp_path), "--quick", "--out", out]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120)
    assert done.returncode == 2 and len(done.stderr.splitlines()) == 1 and "has no truth/" in done.stderr
    assert not (tmp_path / "out").exists()


@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_two_views_from_one_side_find_the_table(shared_data: Path) -> None:
    """Half of two views hide whatever one of them does: that tells nothing of what is hidden always."""
    desk = read_scene(shared_data / "withwithout" / "desk", needs_truth=True)
    reference = desk.test[0]
    views = perturbed_views(desk, reference, "views", 2)
    given = removal(desk, PRESETS["draft"], reference, desk.truth(reference), views)
    found = mean_psnrs(desk, filled(desk.gaussians, given), desk.test[1:])
    assert found["mask"] > 26 and found["unseen"] > 24  # measured: 28.7, 26.7; on a plane that is not there 15, 11
