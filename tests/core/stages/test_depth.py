"""Depth completion: planes, relief with a prior, and every ill-posed case of METHOD section 8 that concerns depth."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gimp3d.errors import BadInput, IllPosed
from gimp3d.io.images import write_png
from gimp3d.priors.monodepth import depth_prior
from gimp3d.stages.depth import DepthSettings, complete_disparity

H, W = 90, 120
V, U = np.mgrid[:H, :W].astype(np.float64)
PLANE = 0.3 + 0.0012 * V + 0.0003 * U


def round_hole(radius: float = 18, centre: tuple[float, float] = (45, 60)) -> np.ndarray:
    return np.hypot(V - centre[0], U - centre[1]) < radius


def complete(true: np.ndarray, hole: np.ndarray, prior: np.ndarray | None = None, **change: object):
    given_ = np.where(hole, 0, true).astype(np.float32)
    return complete_disparity(given_, ~hole, hole, prior, DepthSettings(**change))  # type: ignore[arg-type]


@settings(max_examples=25, deadline=None)
@given(a=st.floats(-0.002, 0.002), b=st.floats(-0.002, 0.002), noise=st.floats(0, 0.001), seed=st.integers(0, 99))
def test_planes_are_continued(a: float, b: float, noise: float, seed: int) -> None:
    true = 0.5 + a * (V - 45) + b * (U - 60)
    noisy = true + np.random.default_rng(seed).normal(0, noise, true.shape)
    hole = round_hole()
    found = complete(noisy, hole)
    assert np.abs(found.disparity - true)[hole].max() < 1e-5 + 6 * noise
    np.testing.assert_allclose(found.depth[hole], 1 / found.disparity[hole], rtol=1e-5)


def test_an_occluder_on_the_rim_does_not_smear_into_the_hole() -> None:
    scene = PLANE.copy()
    scene[50:, 72:] = 0.9  # something near, in front of the hole's corner
    hole = round_hole() & (scene < 0.8)
    for surface in ("auto", "harmonic"):
        found = complete(scene, hole, surface=surface)
        assert np.abs(found.disparity - PLANE)[hole].max() < 0.03, surface


@pytest.mark.parametrize(("gain", "shift"), [(3.0, 0.2), (0.05, -1.0), (12.0, 5.0)])
def test_a_prior_of_any_gain_and_shift_helps_where_the_surface_is_curved(gain: float, shift: float) -> None:
    rng = np.random.default_rng(0)
    bump = 0.08 * np.exp(-((V - 47) ** 2 + (U - 63) ** 2) / 500)
    true, hole = PLANE + bump, round_hole()
    prior = (gain * true + shift + rng.normal(0, 0.004 * gain * 0.1, true.shape)).astype(np.float32)
    guided, plain = complete(true, hole, prior), complete(true, hole, surface="harmonic")
    errors = [np.sqrt(((f.disparity - true)[hole] ** 2).mean()) for f in (guided, plain)]
    assert errors[0] < 0.3 * errors[1]
    assert guided.scale_factor == pytest.approx(1 / gain, rel=0.1) and guided.confidence > 0.9


def test_measured_scale_is_near_the_best_on_random_cases() -> None:
    rng = np.random.default_rng(1)
    ratios = []
    for _ in range(30):
        height, width, cy, cx = rng.uniform(0.03, 0.1), rng.uniform(10, 30), rng.uniform(30, 60), rng.uniform(45, 75)
        true = PLANE + height * np.exp(-((V - cy) ** 2 + (U - cx) ** 2) / (2 * width**2))
        gain, hole = 10 ** rng.uniform(-1, 1), round_hole(14)
        prior = (gain * true + rng.normal(0, 0.02 * gain * height, true.shape)).astype(np.float32)
        noisy = true + rng.normal(0, 0.0005, true.shape)

        def rmse(s: float | None, n=noisy, h=hole, p=prior, t=true) -> float:
            return float(np.sqrt(((complete(n, h, p, scale_factor=s).disparity - t)[h] ** 2).mean()))

        best = min(rmse(s / gain) for s in np.linspace(0, 1.4, 15))
        ratios.append(rmse(None) / max(best, 1e-5))
    assert np.median(ratios) < 1.25


@pytest.mark.parametrize("kind", ["constant", "NaN", "inverted", "noise"])
def test_useless_priors_fall_back_to_harmonic_and_say_so(kind: str) -> None:
    true, hole = PLANE, round_hole()
    prior = {
        "constant": np.full((H, W), 2.0),
        "NaN": np.full((H, W), np.nan),
        "inverted": -true,
        "noise": np.random.default_rng(0).normal(size=(H, W)),
    }[kind].astype(np.float32)
    found = complete(true, hole, prior)
    assert found.scale_factor == 0 and found.confidence <= 0.5 and found.reason
    assert np.abs(found.disparity - true)[hole].max() < 1e-3


def test_the_sign_of_the_guidance_follows_the_prior() -> None:
    bump = (0.1 * np.exp(-((V - 45) ** 2 + (U - 60) ** 2) / 100)).astype(np.float32)
    found = complete(PLANE, round_hole(), bump, scale_factor=1.0)
    assert found.disparity[45, 60] > PLANE[45, 60] + 0.05


@pytest.mark.parametrize("hole", [round_hole(25, (0, 60)), round_hole(30, (89, 119)), V < 40, U > 30])
def test_holes_that_touch_the_border(hole: np.ndarray) -> None:
    found = complete(PLANE, hole)
    assert np.isfinite(found.disparity).all() and (found.disparity[hole] > 0).all()
    assert np.abs(found.disparity - PLANE)[hole].max() < 1e-4


def test_a_hole_that_covers_the_image_is_refused() -> None:
    with pytest.raises(IllPosed, match="depth"):
        complete(PLANE, np.ones((H, W), bool))


def test_a_part_without_a_rim_takes_the_nearest_depth_with_low_confidence() -> None:
    hole = round_hole(10, (30, 30)) | round_hole(8, (60, 90))
    known = ~hole & ~(np.hypot(V - 60, U - 90) < 12)  # a moat of unknown pixels round the second part
    found = complete_disparity(
        np.where(known, PLANE, 0).astype(np.float32), known, hole, None, DepthSettings(surface="harmonic")
    )
    assert np.abs(found.disparity - PLANE)[hole].max() < 0.03 and found.confidence <= 0.3


def test_islands_are_boundary() -> None:
    hole = round_hole(25) & ~round_hole(4)
    found = complete(PLANE, hole, surface="harmonic")
    assert np.abs(found.disparity - PLANE)[hole].max() < 1e-4


@pytest.mark.parametrize("pixels", [1, 2, 3, 4])
def test_holes_of_a_few_pixels(pixels: int) -> None:
    hole = np.zeros((H, W), bool)
    hole[40, 50 : 50 + pixels] = True
    assert np.abs(complete(PLANE, hole).disparity - PLANE)[hole].max() < 1e-4


def test_negative_and_missing_disparity_are_clamped_and_counted() -> None:
    steep = 0.4 - 0.02 * np.abs(U - 60)  # falls below zero behind the hole's rim
    hole = round_hole(12)
    prior = (-3 * np.exp(-((V - 45) ** 2 + (U - 60) ** 2) / 50)).astype(np.float32)
    found = complete(np.maximum(steep, 0.05), hole, prior, scale_factor=1.0)
    assert found.clamped > 0 and (found.disparity[hole] > 0).all() and "clamped" in found.reason


def test_nothing_known_changes() -> None:
    found = complete(PLANE, round_hole())
    np.testing.assert_allclose(found.disparity[~round_hole()], PLANE[~round_hole()], rtol=1e-6)


def test_insisting_on_a_plane_where_there_is_none_is_refused() -> None:
    rough = PLANE + np.random.default_rng(0).normal(0, 0.05, PLANE.shape)
    with pytest.raises(IllPosed, match="plane"):
        complete(rough, round_hole(), surface="planar")


def test_priors_from_files_are_resized_and_converted(tmp_path: Path) -> None:
    np.save(tmp_path / "d.npy", (1 / PLANE).astype(np.float32))
    loaded = depth_prior(f"file:{tmp_path / 'd.npy'},depth", H, W)
    assert loaded is not None
    np.testing.assert_allclose(loaded, PLANE, rtol=1e-5)
    write_png(tmp_path / "d.png", np.full((H // 2, W // 2), 77, np.uint8))
    half = depth_prior(f"file:{tmp_path / 'd.png'}", H, W)
    assert half is not None and half.shape == (H, W) and half[3, 3] == 77
    assert depth_prior("auto", H, W) is None and depth_prior("harmonic", H, W) is None


@pytest.mark.parametrize("spec", ["file:nowhere.npy", "onnx:model.onnx", "magic", "file:"])
def test_bad_priors_are_refused(spec: str) -> None:
    with pytest.raises(BadInput, match="--depth-prior"):
        depth_prior(spec, H, W)
