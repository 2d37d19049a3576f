"""Providers of appearance: each fills the hole, only the hole, and says clearly when it cannot."""

from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pictures import disc, error, holed, refuse, scenery
from property_tests import examples

from gimp3d.compute.threads import set_thread_count
from gimp3d.errors import IllPosed
from gimp3d.io.images import write_png
from gimp3d.priors.inpaint import PROVIDERS, inpaint_reference


@pytest.fixture(autouse=True)
def _default_threads() -> Iterator[None]:
    yield
    set_thread_count(None)


def stripes(height: int = 120, width: int = 160) -> np.ndarray:
    y, x = np.mgrid[:height, :width]
    wave = 128 + 90 * np.sin((x + 0.5 * y) * 0.55)
    return np.dstack([wave, 0.8 * wave, 255 - wave]).astype(np.uint8)


def checks(height: int = 120, width: int = 160) -> np.ndarray:
    y, x = np.mgrid[:height, :width]
    return np.repeat(np.where((x // 8 + y // 8) % 2, 210, 60)[..., None], 3, 2).astype(np.uint8)


def grain(height: int = 120, width: int = 160) -> np.ndarray:
    """Speckle without any larger structure: flat fills show by their lack of contrast."""
    noise = cv2.GaussianBlur(np.random.default_rng(2).normal(size=(height, width)), (0, 0), 1.2)
    return np.repeat(np.clip(128 + 100 * noise, 0, 255)[..., None], 3, 2).astype(np.uint8)


# every provider


@pytest.mark.parametrize("spec", PROVIDERS)
def test_providers_change_the_hole_only_and_repeat_themselves(spec: str) -> None:
    picture, hole = scenery(), disc()
    done = inpaint_reference(spec, holed(picture, hole), hole, seed=3)
    again = inpaint_reference(spec, holed(picture, hole), hole, seed=3)
    assert (done.image[~hole] == picture[~hole]).all()
    assert (done.image == again.image).all()
    assert error(done.image, picture, hole) < 60
    assert 0 < done.confidence < 1 and done.reason


@pytest.mark.parametrize("spec", PROVIDERS)
def test_what_stood_in_the_hole_does_not_matter(spec: str) -> None:
    picture, hole = scenery(), disc()
    black = np.where(hole[..., None], np.uint8(0), picture)
    fills = [inpaint_reference(spec, base, hole).image for base in (black, holed(picture, hole))]
    assert (fills[0] == fills[1]).all()


@pytest.mark.parametrize("spec", PROVIDERS)
@pytest.mark.parametrize("pixels", [1, 3])
def test_specks_are_interpolated(spec: str, pixels: int) -> None:
    picture = cv2.GaussianBlur(scenery(), (0, 0), 3)
    hole = np.zeros(picture.shape[:2], bool)
    hole[50, 60 : 60 + pixels] = True
    assert error(inpaint_reference(spec, holed(picture, hole), hole).image, picture, hole) < 6


@pytest.mark.parametrize("spec", PROVIDERS)
@pytest.mark.parametrize("shape", [(1, 1), (1, 9), (3, 3), (6, 8), (17, 12)])
def test_pictures_smaller_than_a_patch_are_filled(spec: str, shape: tuple[int, int]) -> None:
    picture = scenery(*shape)
    hole = np.zeros(shape, bool)
    hole[: max(1, shape[0] // 2), : max(1, shape[1] // 2)] = True
    if hole.all():
        with pytest.raises(IllPosed):
            inpaint_reference(spec, picture, hole)
    else:
        assert (inpaint_reference(spec, picture, hole).image[~hole] == picture[~hole]).all()


@pytest.mark.parametrize("spec", PROVIDERS)
def test_an_empty_hole_is_a_no_op_and_a_full_one_is_refused(spec: str) -> None:
    picture = scenery()
    none = np.zeros(picture.shape[:2], bool)
    assert (inpaint_reference(spec, picture, none).image == picture).all()
    with pytest.raises(IllPosed, match="whole reference"):
        inpaint_reference(spec, picture, ~none)


@pytest.mark.parametrize("spec", ["", "lama", "exemplar:3", "file", "file:", "command:", "onnx:"])
def test_unknown_providers_are_refused_with_the_choices(spec: str) -> None:
    choices = "exemplar, telea, ns, shiftmap, fsr, file:PATH, onnx:PATH, torchscript:PATH"
    refuse(choices, spec, scenery(), disc())


def test_a_file_is_held_against_what_is_known_alone(tmp_path: Path) -> None:
    """A chart is black where no photo shows it; the picture of it is not."""
    picture, hole = scenery(), disc()
    unknown = np.zeros_like(hole)
    unknown[:, : hole.shape[1] // 3] = True
    write_png(tmp_path / "painted.png", picture)
    chart = np.where((hole | unknown)[..., None], np.uint8(0), picture)
    found = inpaint_reference(f"file:{tmp_path / 'painted.png'}", chart, hole, unknown=unknown & ~hole)
    assert not found.warnings and "residual 0.0" in found.reason
    assert (found.image[hole] == picture[hole]).all()


# exemplar


@pytest.mark.parametrize("make", [stripes, checks])
def test_exemplar_continues_a_pattern_where_interpolation_cannot(make: Callable[[], np.ndarray]) -> None:
    picture, hole = make(), disc()
    own, smooth = (inpaint_reference(s, holed(picture, hole), hole).image for s in ("exemplar", "telea"))
    assert error(own, picture, hole) < 0.35 * error(smooth, picture, hole)


def test_exemplar_keeps_the_contrast_of_the_texture() -> None:
    picture, hole = grain(), disc()
    filled = inpaint_reference("exemplar", holed(picture, hole), hole).image
    inner = cv2.erode(hole.astype(np.uint8), np.ones((9, 9), np.uint8)) > 0
    assert filled[inner].std() > 0.7 * picture[~hole].std()


def test_exemplar_depends_on_the_seed_and_not_on_the_thread_count() -> None:
    picture, hole = scenery(), disc()

    def fill(seed: int) -> np.ndarray:
        return inpaint_reference("exemplar", holed(picture, hole), hole, seed).image

    fills = []
    for threads in (1, 2, 4):
        set_thread_count(threads)
        fills.append(fill(1))
    assert (fills[0] == fills[1]).all() and (fills[0] == fills[2]).all()
    assert (fill(2) != fills[0]).any()


def test_exemplar_fills_holes_at_the_border_with_islands_and_in_many_parts() -> None:
    picture = stripes()
    hole = np.zeros(picture.shape[:2], bool)
    hole[:30, :50] = True
    hole[10:14, 20:26] = False  # an island
    hole[60:75, 140:] = hole[100:, 60:63] = True
    filled = inpaint_reference("exemplar", holed(picture, hole), hole).image
    assert error(filled, picture, hole) < 15


def test_exemplar_interpolates_where_only_thin_lines_are_known() -> None:
    picture = np.full((40, 60, 3), 90, np.uint8)
    hole = np.ones((40, 60), bool)
    hole[::8] = False
    filled = inpaint_reference("exemplar", holed(picture, hole), hole)
    assert error(filled.image, picture, hole) < 2


@examples(25)
@given(st.integers(0, 2**31), st.integers(6, 40), st.integers(6, 40), st.floats(0.02, 0.98))
def test_any_hole_is_filled_with_colours_that_the_picture_may_hold(
    seed: int, height: int, width: int, share: float
) -> None:
    random = np.random.default_rng(seed)
    picture = random.integers(60, 200, (height, width, 3)).astype(np.uint8)
    hole = cv2.GaussianBlur(random.random((height, width)), (0, 0), 1.5)
    hole = hole > np.quantile(hole, share)
    if hole.all():
        hole[0, 0] = False
    done = inpaint_reference("exemplar", picture, hole, seed % 7)
    assert (done.image[~hole] == picture[~hole]).all()
    again = inpaint_reference("exemplar", np.where(hole[..., None], np.uint8(3), picture), hole, seed % 7)
    assert (done.image == again.image).all()


def test_a_constant_picture_stays_constant() -> None:
    picture, hole = np.full((90, 120, 3), (40, 90, 200), np.uint8), disc(90, 120)
    assert (inpaint_reference("exemplar", holed(picture, hole), hole).image == picture).all()
