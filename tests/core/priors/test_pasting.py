"""Pictures from outside are registered, checked, and pasted into the hole alone."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from pictures import badly_drawn, disc, error, holed, refuse, scenery

from gimp3d.errors import BadInput
from gimp3d.io.images import write_png
from gimp3d.priors.inpaint import inpaint_reference
from gimp3d.priors.pasting import paste_picture


def save(path: Path, picture: np.ndarray) -> str:
    write_png(path, picture)
    return f"file:{path}"


def test_a_matching_picture_is_pasted_bit_for_bit(tmp_path: Path) -> None:
    picture, hole = scenery(), disc()
    done = inpaint_reference(save(tmp_path / "without.png", picture), holed(picture, hole), hole)
    assert (done.image == picture).all()
    assert done.confidence > 0.95


@pytest.mark.parametrize("noise", [2, 10])
def test_a_photo_matches_a_noisy_rendering_of_its_view(noise: float) -> None:
    picture, hole = scenery(), disc()
    shaken = picture + np.random.default_rng(0).normal(0, noise, picture.shape)
    rendering = np.clip(cv2.GaussianBlur(shaken, (0, 0), 0.6), 0, 255).astype(np.uint8)
    done = paste_picture(holed(rendering, hole), hole, picture)
    assert (done.image[hole] == picture[hole]).all()
    assert (done.image[~hole] == rendering[~hole]).all()


def test_objects_that_differ_outside_the_hole_do_not_decide() -> None:
    picture, hole = scenery(), disc()
    view = picture.copy()
    view[90:115, 10:60] = 255
    assert (paste_picture(holed(view, hole), hole, picture).image[hole] == picture[hole]).all()


@pytest.mark.parametrize("shift", [(3, -2), (1.5, 0.75)])
def test_a_shifted_and_relit_picture_is_registered(shift: tuple[float, float]) -> None:
    picture, hole = scenery(240, 320), disc(240, 320, 40)
    matrix = np.array([[1, 0, shift[0]], [0, 1, shift[1]]], np.float64)
    moved = cv2.warpAffine(picture, matrix, (320, 240), flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
    relit = np.clip(moved * [0.85, 0.9, 1.03], 0, 255).astype(np.uint8)
    done = paste_picture(holed(picture, hole), hole, relit)
    assert "shifted" in done.reason
    assert error(done.image, picture, hole) < 2 < error(relit, picture, hole)


@pytest.mark.parametrize("balance", [(0.75, 0.75, 0.75), (1.12, 1.0, 0.88)])
def test_a_picture_takes_the_exposure_and_white_balance_of_the_view_round_the_hole(balance: tuple[float, ...]) -> None:
    """Though the rest of the view is in another light, and is drawn without its details."""
    picture, hole = scenery(240, 320), disc(240, 320, 40)
    lit = np.clip(picture * np.array(balance), 0, 255)
    y, x = np.mgrid[:240, :320]
    near = np.hypot(y - 120, x - 160) < 85
    view = cv2.GaussianBlur(np.where(near[..., None], lit, picture).astype(np.uint8), (0, 0), 2.5)
    done = paste_picture(holed(view, hole), hole, picture)
    assert error(done.image, lit, hole) < 1.5 < error(picture, lit, hole)
    assert "gain" in done.reason and done.warnings == ()


def test_a_picture_of_a_badly_drawn_view_is_pasted_with_a_warning() -> None:
    picture, hole = scenery(240, 320), disc(240, 320, 40)
    view = holed(badly_drawn(picture), hole)
    done = paste_picture(view, hole, picture, "photo.png")
    (warning,) = done.warnings
    assert warning.startswith("photo.png matches the view poorly: outside the hole it agrees by 0.")
    assert "grey levels" in warning and done.confidence < 0.6
    with pytest.raises(BadInput, match="does not match the view"):
        paste_picture(view, hole, scenery(240, 320, seed=9))


def test_where_the_view_is_not_known_a_picture_is_not_compared() -> None:
    """What stands in the object's place is drawn from splats that it hid."""
    picture, hole = scenery(240, 320), disc(240, 320, 30)
    silhouette = disc(240, 320, 90)
    view = np.where(silhouette[..., None], np.uint8(70), picture)
    with_it = paste_picture(view, hole, picture, known=~silhouette)
    assert (with_it.image[hole] == picture[hole]).all() and with_it.confidence > 0.95
    assert (paste_picture(view, hole, picture).image[hole] != picture[hole]).any()


@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_a_picture_of_another_resolution_is_resampled(factor: float) -> None:
    picture, hole = scenery(), disc()
    way = cv2.INTER_AREA if factor < 1 else cv2.INTER_CUBIC
    other = cv2.resize(picture, None, fx=factor, fy=factor, interpolation=way)
    assert error(paste_picture(holed(picture, hole), hole, other).image, picture, hole) < 3


@pytest.mark.parametrize("what", ["another scene", "mirrored", "inverted", "constant"])
def test_a_picture_of_something_else_is_refused(what: str, tmp_path: Path) -> None:
    picture, hole = scenery(), disc()
    other = {
        "another scene": scenery(seed=9),
        "mirrored": picture[:, ::-1],
        "inverted": 255 - picture,
        "constant": np.full_like(picture, 128),
    }[what]
    refuse("does not match the view", save(tmp_path / "other.png", np.ascontiguousarray(other)), picture, hole)


def test_a_picture_of_another_shape_is_refused(tmp_path: Path) -> None:
    refuse("not the shape of the view", save(tmp_path / "wide.png", scenery(120, 200)), scenery(), disc())


def test_a_file_that_is_no_picture_is_refused(tmp_path: Path) -> None:
    (tmp_path / "note.png").write_text("not a picture")
    refuse("not a picture", f"file:{tmp_path / 'note.png'}", scenery(), disc())
    refuse("cannot read", f"file:{tmp_path / 'missing.png'}", scenery(), disc())


def test_a_whole_view_may_be_given_as_a_picture(tmp_path: Path) -> None:
    picture = scenery()
    everywhere = np.ones(picture.shape[:2], bool)
    done = inpaint_reference(save(tmp_path / "all.png", picture), np.zeros_like(picture), everywhere)
    assert (done.image == picture).all()
    assert done.confidence <= 0.5
