"""One picture of a surface from photos that hide parts of it, of which one is wrong."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from property_tests import examples
from scenes import cameras

from gimp3d.camera import Camera
from gimp3d.orbit import look_at
from gimp3d.stages.witness import Says, Witness, ask, mosaic

UP = np.array([0.0, 0, 1])
ABOVE = Camera("above", 100, 80, 400.0, 400.0, 50.0, 40.0, look_at(4 * UP, np.zeros(3), np.array([0.0, 1, 0])))
POINTS = ABOVE.unproject(ABOVE.pixel_centres(), np.full((80, 100), 4.0))  # 1 cm per texel, on z = 0


def texture(points: np.ndarray) -> np.ndarray:
    x, y = points[..., 0], points[..., 1]
    waves = [np.sin(9 * x + 4 * y), np.sin(11 * y - 5 * x), np.sin(7 * x - 8 * y)]
    return np.stack([120 + 50 * w + 20 * waves[0] * waves[1] for w in waves], -1)


def photo(camera: Camera) -> Witness:
    """A view of the floor z = 0, which nothing hides."""
    shape = (camera.height, camera.width)
    rays = camera.unproject(camera.pixel_centres(), np.ones(shape)) - camera.centre
    z = -camera.centre[2] / rays[..., 2]
    shown = z > 0
    colours = np.where(shown[..., None], np.clip(np.rint(texture(camera.centre + z[..., None] * rays)), 0, 255), 0)
    no = np.zeros(shape, bool)
    return Witness(camera, colours.astype(np.uint8), no, no, no, np.where(shown, z, 0).astype(np.float32))


def said_of(witnesses: list[Witness]) -> np.ndarray:
    return ask(witnesses, POINTS.reshape(-1, 3), 0.02).reshape(-1, *POINTS.shape[:2])


def hiding(witness: Witness, places: np.ndarray) -> Witness:
    """With a red object in the way of floor texels [H, W] bool, and 3 px round them."""
    uv = witness.camera.project(POINTS[places])[0].astype(int)
    mask = np.zeros(witness.hidden.shape, np.uint8)
    mask[uv[:, 1], uv[:, 0]] = 1
    hidden = cv2.dilate(mask, np.ones((7, 7), np.uint8)) > 0
    wide = cv2.dilate(mask, np.ones((11, 11), np.uint8)) > 0
    red = np.where(hidden[..., None], np.array([200, 20, 20], np.uint8), witness.photo)
    return replace(witness, photo=red, hidden=hidden, beside=wide & ~hidden)


@pytest.fixture(scope="module")
def photos() -> list[Witness]:
    return [photo(c) for c in cameras(9, 240, 180)]


def test_the_floor_shows_as_it_is(photos: list[Witness]) -> None:
    picture, spread, _ = mosaic(POINTS, UP, photos, said_of(photos))
    assert picture.dtype == np.uint8 and spread.dtype == np.float32
    assert np.abs(picture - texture(POINTS)).max() < 2.5
    assert spread.max() < 2.5


def test_one_photo_of_other_colours_does_not_show(photos: list[Witness]) -> None:
    """Though it is the one that shows the floor best."""
    best = int(np.argmax([w.camera.centre[2] for w in photos]))
    wrong = [replace(w, photo=255 - w.photo) if k == best else w for k, w in enumerate(photos)]
    picture, spread, _ = mosaic(POINTS, UP, wrong, said_of(wrong))
    assert np.abs(picture - texture(POINTS)).max() < 4
    assert spread.max() < 4


def test_what_no_photo_shows_is_black_and_what_one_shows_is_not(photos: list[Witness]) -> None:
    never, most = np.zeros((2, 80, 100), bool)
    never[30:50, 20:50], most[30:50, 50:80] = True, True
    hidden = [hiding(w, never | most if k else never) for k, w in enumerate(photos)]
    said = said_of(hidden)
    shown = np.isin(said, (Says.SEEN, Says.BESIDE)).any(0)
    picture, _, _ = mosaic(POINTS, UP, hidden, said)
    assert not shown[never].any() and shown[most][30:].any()
    assert not picture[~shown].any()
    clear = (said == Says.SEEN).any(0)
    assert clear.mean() > 0.7
    assert np.abs(picture - texture(POINTS))[clear].max() < 4  # and none of the object's red


def test_what_is_beside_the_object_counts_only_where_nothing_else_is_seen(photos: list[Witness]) -> None:
    said = np.full((3, 80, 100), Says.SEEN, np.uint8)
    said[1:, :, 50:] = Says.BESIDE
    said[0, :, 75:] = Says.HIDDEN
    flat = [replace(w, photo=np.full_like(w.photo, c)) for w, c in zip(photos, (100, 140, 148))]
    picture, spread, _ = mosaic(POINTS, UP, flat, said)
    far = np.s_[:, 0:30], np.s_[:, 60:65], np.s_[:, 95:]  # from where another median is mixed in
    assert [int(np.median(picture[f])) for f in far] == [140, 100, 144]
    assert not spread.any()  # of another light, but of the same texture: none


@examples(20)
@given(values=st.lists(st.integers(0, 255), min_size=1, max_size=6), channel=st.integers(0, 2))
def test_plain_photos_make_their_median_and_differ_in_light_only(values: list[int], channel: int) -> None:
    camera = cameras(9, 240, 180)[2]
    plain = []
    for value in values:
        colours = np.full((180, 240, 3), 77, np.uint8)
        colours[..., channel] = value
        plain.append(replace(photo(camera), photo=colours))
    picture, spread, _ = mosaic(POINTS, UP, plain, np.full((len(plain), 80, 100), Says.SEEN, np.uint8))
    expected = np.full(3, 77.0)
    expected[channel] = np.median(values)
    assert np.abs(picture - expected).max() <= 0.5 + 1e-3
    assert not spread.any()


def test_photos_differ_where_they_show_textures_of_their_own(photos: list[Witness]) -> None:
    """Half of them are brighter there, which is light; or all show another noise, as of something before the floor."""
    patch = np.zeros((80, 100), bool)
    patch[20:60, 30:70] = True
    edge = cv2.dilate(patch.astype(np.uint8), np.ones((49, 49), np.uint8)) > 0
    inner = cv2.erode(patch.astype(np.uint8), np.ones((25, 25), np.uint8)) > 0
    rng = np.random.default_rng(3)
    brighter, other = [], []
    for k, w in enumerate(photos[:6]):
        mask = hiding(w, patch).hidden[..., None]
        brighter.append(replace(w, photo=(w.photo * 0.8 + 50 * (k % 2) * mask).astype(np.uint8)))
        noise = cv2.GaussianBlur(rng.normal(0, 1, w.photo.shape[:2]), (0, 0), 2) * 300
        own = np.clip(120 + noise, 0, 255)[..., None].repeat(3, 2)
        other.append(replace(w, photo=np.where(mask, own, w.photo).astype(np.uint8)))
    told = said_of(brighter)
    (_, light, loud), (_, texture_, common) = (mosaic(POINTS, UP, p, told) for p in (brighter, other))
    assert light[inner].max() < 4 and light[~edge].max() < 2.5
    assert texture_[inner].min() > 10 and texture_[~edge].max() < 2.5
    # they have more in common than apart where they show one texture, and less where they show several
    assert loud[inner].mean() > 4 * light[inner].mean() and common[inner].mean() < texture_[inner].mean()


def test_detail_is_that_of_the_photo_with_most_pixels() -> None:
    """Three blurred photos have no detail; a nearer one has, and says so by less than photos may differ."""
    near = replace(ABOVE, id="near", width=200, height=160, fx=800.0, fy=800.0, cx=100.0, cy=80.0)
    sharp, x = np.full((160, 200, 3), 100, np.uint8), np.arange(200)
    sharp += np.where(x // 8 % 2, 8, 0).astype(np.uint8)[None, :, None]
    no, z = np.zeros((160, 200), bool), np.full((160, 200), 4, np.float32)
    far = [Witness(ABOVE, np.full((80, 100, 3), 104, np.uint8), *[no[:80, :100]] * 3, z[:80, :100])] * 3
    witnesses = [*far[:2], Witness(near, sharp, no, no, no, z), far[2]]
    picture, _, _ = mosaic(POINTS, UP, witnesses, said_of(witnesses))
    truth = sharp.reshape(80, 2, 100, 2, 3)[:, 0, :, 0]
    assert np.abs(picture.astype(int) - truth)[:, 10:-10].max() <= 1
    loud = replace(witnesses[2], photo=(sharp.astype(int) + 30).astype(np.uint8))
    picture, _, _ = mosaic(POINTS, UP, [*far[:2], loud, far[2]], said_of(witnesses))
    assert (picture == 104).all()
