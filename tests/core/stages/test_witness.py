"""What photos say of points, and how alike they look there."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from property_tests import examples
from scenes import cameras

from gimp3d.camera import Camera
from gimp3d.geometry import pack_camera
from gimp3d.orbit import look_at
from gimp3d.stages.witness import Says, Textures, Witness, ask

CAMERA = Camera("one", 8, 6, 10.0, 10.0, 4.0, 3.0, np.eye(4))


def witness(camera: Camera, **changed: np.ndarray) -> Witness:
    """A view of a grey surface at z = 1, with nothing before it."""
    shape = (camera.height, camera.width)
    no = np.zeros(shape, bool)
    return replace(
        Witness(camera, np.full((*shape, 3), 128, np.uint8), no, no, no, np.ones(shape, np.float32)), **changed
    )


def plainly(witness: Witness, points: np.ndarray, tolerance: float) -> np.ndarray:
    """The reference for ask: one point at a time."""
    said = np.full(len(points), Says.NOTHING, np.uint8)
    for i, point in enumerate(points):
        uv, z = witness.camera.project(point)
        if z <= 0 or not (0 <= uv[0] < witness.camera.width and 0 <= uv[1] < witness.camera.height):
            continue
        at = int(uv[1]), int(uv[0])
        front = float(witness.depth[at])
        if witness.hidden[at]:
            said[i] = Says.HIDDEN
        elif front == 0 or front > (1 + tolerance) * z:
            said[i] = Says.THROUGH
        elif front < (1 - tolerance) * z:
            said[i] = Says.BEHIND
        else:
            said[i] = Says.BESIDE if witness.beside[at] else Says.SEEN
    return said


@examples(40)
@given(seed=st.integers(0, 2**32 - 1), tolerance=st.sampled_from([0.01, 0.05, 0.3]))
def test_ask_says_what_a_plain_loop_says(seed: int, tolerance: float) -> None:
    rng = np.random.default_rng(seed)
    asked = []
    for _ in range(3):
        eye = rng.normal(size=3)
        pose = look_at(3 * eye / np.linalg.norm(eye), rng.normal(0, 0.1, 3), rng.normal(size=3))
        camera = Camera("any", 13, 9, rng.uniform(5, 20), rng.uniform(5, 20), rng.uniform(3, 10), 4.0, pose)
        hidden, beside, void = rng.random((3, 9, 13)) < np.array([0.2, 0.3, 0.2])[:, None, None]
        depth = np.where(void, 0, rng.uniform(2, 4, (9, 13))).astype(np.float32)
        asked.append(witness(camera, hidden=hidden, beside=beside, depth=depth))
    points = rng.normal(0, 1.5, (200, 3))
    said = ask(asked, points, tolerance)
    assert said.dtype == np.uint8
    np.testing.assert_array_equal(said, [plainly(w, points, tolerance) for w in asked])
    assert set(np.unique(ask(asked, rng.normal(0, 1.5, (20_000, 3)), tolerance))) == set(Says)


@pytest.mark.parametrize(
    ("point", "says"),
    [
        ([0, 0, 1.0], Says.SEEN),
        ([0, 0, 1.04], Says.SEEN),
        ([0, 0, 0.96], Says.SEEN),
        ([0, 0, 1.06], Says.BEHIND),
        ([0, 0, 0.95], Says.THROUGH),
        ([0, 0, -1.0], Says.NOTHING),
        ([0.41, 0, 1.0], Says.NOTHING),
        ([-0.35, 0, 1.0], Says.HIDDEN),
        ([-0.35, 0, 0.5], Says.NOTHING),
        ([-0.35, 0, 9.0], Says.BEHIND),
        ([-0.15, 0, 0.4], Says.HIDDEN),
        ([-0.25, 0, 1.0], Says.BESIDE),
        ([-0.17, 0, 0.7], Says.THROUGH),
        ([0.35, 0, 7.0], Says.BEHIND),
        ([0.35, 0, 1.0], Says.THROUGH),
    ],
)
def test_a_point_before_behind_on_or_beside_a_surface(point: list[float], says: Says) -> None:
    hidden, beside = np.zeros((2, 6, 8), bool)
    depth = np.ones((6, 8), np.float32)
    hidden[:, 0], beside[:, 1], depth[:, 7] = True, True, 0
    assert ask([witness(CAMERA, hidden=hidden, beside=beside, depth=depth)], np.array([point]), 0.05) == [[says]]


def test_no_points_and_no_photos_are_answered() -> None:
    assert ask([witness(CAMERA)], np.zeros((0, 3)), 0.1).shape == (1, 0)
    assert ask([], np.zeros((5, 3)), 0.1).shape == (0, 5)


def test_packed_cameras_hold_the_projection() -> None:
    camera = cameras()[4]
    c = pack_camera(camera)
    point = np.array([0.1, -0.2, 0.3])
    p = c[:9].reshape(3, 3) @ point + c[9:12]
    np.testing.assert_allclose(p[:2] / p[2] * c[12:14] + c[14:16], camera.project(point)[0], rtol=1e-12)
    assert tuple(c[16:]) == (camera.width, camera.height)


def texture(points: np.ndarray) -> np.ndarray:
    x, y = points[..., 0], points[..., 1]
    grey = 128 + 40 * np.sin(11 * x + 3 * y) + 40 * np.sin(13 * y - 5 * x + 1) + 20 * np.sin(24 * x - 19 * y)
    return np.repeat(np.clip(np.rint(grey), 0, 255).astype(np.uint8)[..., None], 3, -1)


SLOPE = np.array([0.15, -0.1])  # of the textured plane z = SLOPE · (x, y) + 0.05


def photo_of_the_plane(camera: Camera) -> Witness:
    rays = camera.unproject(camera.pixel_centres(), np.ones((camera.height, camera.width))) - camera.centre
    normal = np.array([*-SLOPE, 1.0])
    z = (0.05 - normal @ camera.centre) / (rays @ normal)
    shown = z > 0
    photo = texture(camera.centre + z[..., None] * rays) * shown[..., None].astype(np.uint8)
    return witness(camera, photo=photo, depth=np.where(shown, z, 0).astype(np.float32))


def on_the_plane(offset: float = 0.0, tilt: float = 0.0) -> np.ndarray:
    x, y = np.meshgrid(np.linspace(-0.4, 0.4, 60), np.linspace(-0.4, 0.4, 60))
    return np.stack([x, y, SLOPE[0] * x + SLOPE[1] * y + 0.05 + offset + tilt * x], -1).reshape(-1, 3)


@pytest.fixture(scope="module")
def plane_photos() -> list[Witness]:
    return [photo_of_the_plane(c) for c in cameras(9, 240, 180)]


def test_photos_agree_most_on_the_true_plane_and_less_the_further_off(plane_photos: list[Witness]) -> None:
    textures = Textures.make(plane_photos)
    offsets = np.linspace(-0.06, 0.06, 13)
    told = [textures.agreement(on_the_plane(o)) for o in offsets]
    assert np.argmax(told) == 6 and told[6] > 0.9
    assert (np.diff(told[:7]) > 0).all() and (np.diff(told[6:]) < 0).all()
    tilted = [textures.agreement(on_the_plane(tilt=t)) for t in (-0.2, -0.05, 0, 0.05, 0.2)]
    assert tilted[0] < tilted[1] < tilted[2] > tilted[3] > tilted[4]


def test_agreement_is_that_of_the_points_that_three_photos_show(plane_photos: list[Witness]) -> None:
    points = on_the_plane()
    assert Textures.make(plane_photos[:2]).agreement(points) == 0
    textures = Textures.make(plane_photos[:3])
    told = [textures.agreement(p[None]) for p in points]
    assert 0 <= min(told) < textures.agreement(points) < max(told) <= 1 + 1e-9  # Cauchy and Schwarz
    assert textures.agreement(points + np.array([0, 0, 50.0])) == 0


def test_what_a_photo_hides_does_not_count(plane_photos: list[Witness]) -> None:
    """An object of any colour over half of a photo changes nothing where photos do not show it."""
    spoilt, left = [], np.zeros((180, 240), bool)
    left[:, :120] = True
    for k, w in enumerate(plane_photos[:4]):
        colour = np.uint8(60 * k)
        spoilt.append(replace(w, photo=np.where(left[..., None], colour, w.photo), hidden=left))
    textures = Textures.make(spoilt)
    points = on_the_plane()
    uv = np.array([w.camera.project(points)[0] for w in spoilt])
    enough = (uv[..., 0] > 121.5).sum(0) >= 3
    few = (uv[..., 0] > 120.5).sum(0) < 3
    assert enough.any() and few.any()
    assert textures.agreement(points[enough]) > 0 and textures.agreement(points[few]) == 0
    assert textures.agreement(points) > 0.9
    half = Textures.make([replace(w, hidden=np.zeros_like(left), beside=left) for w in spoilt])
    np.testing.assert_array_equal(half.values, textures.values)  # what is beside the object is left out alike


def test_only_so_many_photos_are_compared(plane_photos: list[Witness]) -> None:
    textures = Textures.make(plane_photos, most=4)
    chosen = [plane_photos[k].camera for k in (0, 2, 4, 6)]
    np.testing.assert_array_equal(textures.cameras, [pack_camera(c) for c in chosen])
    assert len(textures.values) == 4 * 240 * 180
