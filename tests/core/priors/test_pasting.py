"""Pictures from outside are registered, checked, and pasted into the hole alone.

Those of the view agree however poorly it is drawn, others do not, and levels come from the ring.
"""

from pathlib import Path

import cv2
import numpy as np
import pytest
from pictures import badly_drawn, disc, error, holed, refuse, scenery

from gimp3d.errors import BadInput
from gimp3d.io.images import write_png
from gimp3d.priors.inpaint import inpaint_reference
from gimp3d.priors.pasting import likeness, paste_picture, ring_gain, shift_between


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


# How alike pictures are

H, W = 180, 240
Y, X = np.mgrid[:H, :W]
HOLE = np.hypot(Y - 95, X - 125) < 30
KNOWN = cv2.dilate(HOLE.astype(np.uint8), np.ones((9, 9), np.uint8)) == 0


def landscape(seed: int = 0) -> np.ndarray:
    """Things of several sizes before a sky that is brighter than the ground, [H, W, 3] uint8."""
    random = np.random.default_rng(seed)
    layers = [cv2.GaussianBlur(random.normal(size=(H, W, 3)), (0, 0), s) * s for s in (1.5, 4, 12)]
    return np.clip(120 + 60 * np.tanh((60 - Y[..., None]) / 20) + 60 * sum(layers), 10, 245).astype(np.uint8)


def drawn_badly(picture: np.ndarray) -> np.ndarray:
    """As splats of few views show it: blurred, with haze in patches."""
    haze = cv2.GaussianBlur(np.random.default_rng(7).normal(size=picture.shape), (0, 0), 12) * 500
    return np.clip(0.5 * cv2.GaussianBlur(picture, (0, 0), 3) + 80 + haze, 0, 255).astype(np.uint8)


def altered(picture: np.ndarray, what: str) -> np.ndarray:
    h, w = picture.shape[:2]
    if what == "re-lit":
        return np.clip(picture * [1.5, 1.3, 1.1], 0, 255).astype(np.uint8)
    if what == "noisy":
        noise = np.random.default_rng(3).normal(0, 15, picture.shape)
        return np.clip(picture + noise, 0, 255).astype(np.uint8)
    if what == "shifted":
        return cv2.warpAffine(picture, np.float32([[1, 0, 3], [0, 1, -2]]), (w, h), borderMode=cv2.BORDER_REFLECT)
    if what == "smaller":
        half = cv2.resize(picture, (w // 2, h // 2), interpolation=cv2.INTER_AREA)
        return cv2.resize(half, (w, h), interpolation=cv2.INTER_CUBIC)
    return picture


@pytest.mark.parametrize("what", ["as it is", "re-lit", "noisy", "shifted", "smaller"])
def test_the_view_itself_agrees_however_poorly_it_is_drawn(what: str) -> None:
    for view, least in ((landscape(), 0.8), (drawn_badly(landscape()), 0.45)):
        view = np.where(HOLE[..., None], 0, view).astype(np.uint8)
        agreement, chance = likeness(view, altered(landscape(), what), KNOWN)
        assert agreement > least and agreement > 10 * chance


@pytest.mark.parametrize("view", [landscape(), drawn_badly(landscape())])
def test_other_pictures_agree_no_better_than_chance(view: np.ndarray) -> None:
    """Though their sky and ground lie where the view's do, by which blurred luminances correlate."""
    others = [landscape(5), landscape()[:, ::-1], np.roll(landscape(), 40, axis=1)]
    for other in others:
        agreement, chance = likeness(view, np.ascontiguousarray(other), KNOWN)
        assert agreement < 0.25 and agreement < 6 * chance
    a, b = (cv2.GaussianBlur(cv2.cvtColor(p, cv2.COLOR_RGB2GRAY), (0, 0), 2)[KNOWN] for p in (view, others[0]))
    assert np.corrcoef(a, b)[0, 1] > 0.3


def test_chance_is_what_other_places_reach() -> None:
    """A pattern that repeats itself fits elsewhere nearly as well."""
    checks = np.repeat(np.where((X // 9 + Y // 9) % 2, 200, 60)[..., None], 3, 2).astype(np.uint8)
    assert likeness(checks, checks, KNOWN)[1] > 4 * likeness(landscape(), landscape(), KNOWN)[1]


@pytest.mark.parametrize("size", [(1, 1), (1, 9), (9, 1), (6, 8), (40, 30)])
def test_pictures_of_any_size_and_without_texture_are_compared(size: tuple[int, int]) -> None:
    grey = np.full((*size, 3), 90, np.uint8)
    agreement, chance = likeness(grey, grey, np.ones(size, bool))
    assert abs(agreement) < 1e-6 and chance < 1e-6
    assert (ring_gain(grey, grey, np.zeros(size, bool), np.ones(size, bool)) == 1).all()


# Levels


@pytest.mark.parametrize("gain", [(1.3, 1.3, 1.3), (0.7, 0.7, 0.7), (1.1, 1.0, 0.9)])
def test_exposure_and_white_balance_are_measured_on_the_ring(gain: tuple[float, ...]) -> None:
    picture, rng = landscape(), np.random.default_rng(1)
    lit = 0.6 * picture * np.array(gain) + rng.normal(0, 8, picture.shape)
    far = np.hypot(Y - 95, X - 125) > 65
    view = np.clip(np.where(far[..., None], picture, lit), 0, 255).astype(np.uint8)  # elsewhere in another light
    found = ring_gain(view, (0.6 * picture).astype(np.uint8), HOLE, KNOWN)
    np.testing.assert_allclose(found, gain, rtol=0.02)


def test_a_shadow_on_a_part_of_the_ring_is_no_exposure() -> None:
    view = landscape()
    shadow = (X > 125) & (Y > 80)
    view = np.where(shadow[..., None], 0.6 * view, view).astype(np.uint8)
    assert (ring_gain(view, landscape(), HOLE, KNOWN) == 1).all()


def test_a_picture_at_the_views_levels_keeps_them_bit_for_bit() -> None:
    for seed in range(5):
        noise = np.random.default_rng(seed).normal(0, 12, landscape().shape)
        noisy = np.rint(np.clip(cv2.GaussianBlur(landscape(seed), (0, 0), 1) + noise, 0, 255)).astype(np.uint8)
        assert (ring_gain(noisy, landscape(seed), HOLE, KNOWN) == 1).all()


def test_a_shift_is_found_in_a_poor_drawing() -> None:
    found = shift_between(drawn_badly(landscape()), altered(landscape(), "shifted"), KNOWN)
    np.testing.assert_allclose(found, (3, -2), atol=0.5)
