"""Scores against closed forms and plain computations."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gimp3d.errors import BadInput
from gimp3d.evaluate.metrics import evaluate_folders, flip_map, psnr, score, ssim_map
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
    for y, x in ((5, 5), (20, 30), (34, 44)):
        expected = []
        for c in range(3):
            a, b = (p[y - 5 : y + 6, x - 5 : x + 6, c].astype(float) / 255 for p in (PICTURE, other))
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


@pytest.mark.parametrize("excluded", ["test/000.png", "test/000", "000", "000.png"])
def test_views_pair_up_and_exclusions_take_any_form(folders: tuple[Path, Path, Path], excluded: str) -> None:
    assert set(evaluate_folders(*folders, exclude=(excluded,))["views"]) == {"test/001", "test/002"}
    inner = [f / "test" for f in folders]
    assert set(evaluate_folders(*inner, exclude=(excluded,))["views"]) == {"001", "002"}


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
