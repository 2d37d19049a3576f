"""Scores against closed forms and plain computations."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest

from gimp3d.errors import BadInput
from gimp3d.evaluate import evaluate_folders, flip_map, psnr, score, ssim_map
from gimp3d.io.images import write_png

RNG = np.random.default_rng(0)
PICTURE = RNG.integers(0, 256, (40, 50, 3), dtype=np.uint8)
EVERYWHERE = np.ones((40, 50), bool)


def test_psnr_of_a_constant_difference() -> None:
    dark = np.full((40, 50, 3), 100, np.uint8)
    assert psnr(dark, dark + 10, EVERYWHERE) == pytest.approx(20 * np.log10(255 / 10))
    assert psnr(dark, dark, EVERYWHERE) == 100


def test_ssim_against_the_definition() -> None:
    other = np.clip(PICTURE.astype(int) + RNG.normal(0, 30, PICTURE.shape), 0, 255).astype(np.uint8)
    offsets = np.arange(-5, 6)
    window = np.exp(-(offsets[:, None] ** 2 + offsets**2) / (2 * 1.5**2))
    window /= window.sum()
    found = ssim_map(PICTURE, other)
    padded = [np.pad(p.astype(float) / 255, ((5, 5), (5, 5), (0, 0)), "reflect") for p in (PICTURE, other)]
    for y, x in ((0, 0), (2, 49), (39, 20), (5, 5), (20, 30), (34, 44)):
        expected = []
        for c in range(3):
            a, b = (p[y : y + 11, x : x + 11, c] for p in padded)
            ma, mb = (window * a).sum(), (window * b).sum()
            va, vb, co = (
                (window * a * a).sum() - ma**2,
                (window * b * b).sum() - mb**2,
                (window * a * b).sum() - ma * mb,
            )
            expected.append((2 * ma * mb + 1e-4) * (2 * co + 9e-4) / ((ma**2 + mb**2 + 1e-4) * (va + vb + 9e-4)))
        assert found[y, x] == pytest.approx(np.mean(expected), abs=1e-9)


def test_flip_is_zero_for_equal_pictures_and_grows() -> None:
    assert flip_map(PICTURE, PICTURE).max() < 1e-6
    flat = np.full((40, 50, 3), 128, np.uint8)
    small, large = flip_map(flat, flat + 10).mean(), flip_map(flat, flat + 100).mean()
    assert 0 < small < large <= 1
    assert flip_map(np.zeros_like(flat), np.full_like(flat, 255)).mean() > 0.9


def test_what_lies_far_outside_the_mask_does_not_count() -> None:
    mask = np.zeros((40, 50), bool)
    mask[:10, :10] = True
    spoiled = PICTURE.copy()
    spoiled[30:, 40:] = 0
    assert score(spoiled, PICTURE, mask)["psnr"] == 100
    assert score(spoiled, PICTURE, mask)["ssim"] == pytest.approx(1)


@pytest.fixture
def folders(tmp_path: Path) -> tuple[Path, Path, Path]:
    names = ("pred", "truth", "masks")
    for k in range(3):
        for name, picture in zip(names, (PICTURE, PICTURE, EVERYWHERE)):
            suffix = ".mask.png" if name == "masks" else ".png"
            write_png(tmp_path / name / "test" / f"{k:03d}{suffix}", picture)
    return tuple(tmp_path / n for n in names)  # type: ignore[return-value]


@pytest.mark.parametrize("excluded", ["test/000.png", "test/000", "000", "000.png", "./test/000.JPG", "000.jpg"])
def test_views_pair_up_and_exclusions_take_any_form(folders: tuple[Path, Path, Path], excluded: str) -> None:
    assert set(evaluate_folders(*folders, exclude=(excluded,))["views"]) == {"test/001", "test/002"}
    inner = [f / "test" for f in folders]
    result = evaluate_folders(*inner, exclude=(excluded,))
    assert set(result["views"]) == {"001", "002"} and not result["warnings"]


def test_views_left_out_without_being_excluded_are_named(folders: tuple[Path, Path, Path]) -> None:
    (folders[0] / "test" / "002.png").unlink()
    result = evaluate_folders(*folders, exclude=("test/007.png", "000"))
    assert set(result["views"]) == {"test/001"}
    typo, missing = result["warnings"]
    assert "test/007.png names no picture" in typo and missing.startswith("test/002: no picture")


def test_a_plain_mask_name_serves_where_the_suffixed_one_is_missing(folders: tuple[Path, Path, Path]) -> None:
    mask = folders[2] / "test" / "001.mask.png"
    mask.rename(mask.with_name("001.png"))
    assert set(evaluate_folders(*folders)["views"]) == {"test/000", "test/001", "test/002"}


def test_scores_are_means_over_the_mask_then_over_views(folders: tuple[Path, Path, Path]) -> None:
    mask = np.zeros((40, 50), bool)
    mask[3:20, 5:30] = True
    dark = PICTURE // 2
    write_png(folders[0] / "test" / "001.png", dark)
    write_png(folders[2] / "test" / "001.mask.png", mask)
    result = evaluate_folders(*folders, exclude=("000",))
    found = result["views"]["test/001"]
    error = ((dark.astype(float) - PICTURE)[mask] ** 2).mean()
    assert found["psnr"] == pytest.approx(10 * np.log10(255**2 / error))
    assert found["ssim"] == pytest.approx(ssim_map(dark, PICTURE)[mask].mean())
    assert found["flip"] == pytest.approx(flip_map(dark, PICTURE)[mask].mean())
    for metric, equal in (("psnr", 100), ("ssim", 1), ("flip", 0)):
        assert result["mean"][metric] == pytest.approx((found[metric] + equal) / 2, abs=1e-6)
    assert json.loads(json.dumps(result, allow_nan=False)) == result


def test_flip_without_its_package_names_the_extra_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "flip_evaluator", None)
    with pytest.raises(BadInput, match=r"gimp3d\[evaluate\]"):
        flip_map(PICTURE, PICTURE)


def test_empty_masks_are_skipped_with_a_warning(folders: tuple[Path, Path, Path]) -> None:
    write_png(folders[2] / "test" / "001.mask.png", ~EVERYWHERE)
    result = evaluate_folders(*folders)
    assert set(result["views"]) == {"test/000", "test/002"} and "empty" in result["warnings"][0]


def test_wrong_sizes_and_nothing_to_pair_are_refused(folders: tuple[Path, Path, Path]) -> None:
    write_png(folders[0] / "test" / "001.png", PICTURE[:20])
    with pytest.raises(BadInput, match="differ in size"):
        evaluate_folders(*folders)
    with pytest.raises(BadInput, match="no picture"):
        evaluate_folders(folders[0], folders[2], folders[1])
    with pytest.raises(BadInput, match="not a folder"):
        evaluate_folders(folders[0] / "x", folders[1], folders[2])
