"""What files and users may bring: broken rows, giants, empty scenes, odd images, any number of threads."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import astuple, replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from property_tests import examples
from test_raster_render import CAMERA, one, random_scene

from gimp3d.camera import Camera
from gimp3d.compute import threads
from gimp3d.gaussians import Gaussians, quats_to_matrices
from gimp3d.raster import (
    PASSES,
    PictureGradients,
    Rendering,
    blend,
    contributions,
    footprint,
    project,
    render,
    trace,
    unblend,
    unproject,
)

WIDE = Camera("wide", 160, 100, 130.0, 130.0, 80.0, 50.0, np.eye(4))
ODD_VALUES = [0.0, -0.0, 1e-30, 1e10, -1e10, 3e38, -3e38, np.inf, -np.inf, np.nan, 79.0, 81.0, 1e-12]


@pytest.fixture
def any_thread_count():
    yield
    threads.set_thread_count(None)


def arrays(drawn: Rendering) -> list[np.ndarray]:
    return [np.asarray(value) for value in astuple(drawn)]


def assert_identical(a: list[np.ndarray], b: list[np.ndarray]) -> None:
    for x, y in zip(a, b, strict=True):
        np.testing.assert_array_equal(x, y)


def test_the_picture_is_bit_equal_for_any_thread_count(any_thread_count: None) -> None:
    gaussians = random_scene(40, 20_000, 1)  # enough for the tile lists to be made in several chunks
    chosen = np.arange(len(gaussians)) % 3 == 0
    results = []
    for count in (1, 2, 3, 7):
        threads.set_thread_count(count)
        share = contributions(gaussians, WIDE)
        results.append([*arrays(render(gaussians, WIDE)), footprint(gaussians, WIDE, chosen), share.total, share.peak])
    for result in results[1:]:
        assert_identical(results[0], result)


def test_concurrent_and_nested_renders_are_bit_equal_to_single_ones() -> None:
    scenes = [random_scene(seed, 3000, 1) for seed in range(4)]
    alone = [arrays(render(scene, WIDE)) for scene in scenes]
    nested = threads.parallel_map(lambda scene: arrays(render(scene, WIDE)), scenes)
    with ThreadPoolExecutor(4) as callers:
        concurrent = list(callers.map(lambda scene: arrays(render(scene, WIDE)), scenes * 3))
    for k, expected in enumerate(alone):
        assert_identical(expected, nested[k])
        for repetition in range(3):
            assert_identical(expected, concurrent[4 * repetition + k])


@examples(60)
@given(st.data())
def test_odd_rows_are_ignored_as_usable_says_and_harm_nothing(data: st.DataObject) -> None:
    """Any value in any column: rows that are not `usable` are not drawn, and every picture stays finite."""
    surfels = data.draw(st.booleans())
    scene = random_scene(data.draw(st.integers(0, 99)), 20, 1, surfels)
    for _ in range(data.draw(st.integers(1, 6))):
        field = data.draw(st.sampled_from(["means", "log_scales", "quats", "opacity_logits", "sh"]))
        column = getattr(scene, field).reshape(len(scene), -1)
        row, entry = data.draw(st.integers(0, 19)), data.draw(st.integers(0, column.shape[1] - 1))
        column[row, entry] = data.draw(st.sampled_from(ODD_VALUES))
    with np.errstate(all="ignore"):
        usable, intact = scene.usable, replace(scene, sh=np.zeros_like(scene.sh)).usable
    drawn = render(scene, CAMERA, passes=PASSES)
    # broken geometry counts always, a broken colour only where it would be seen
    assert np.count_nonzero(~intact) <= drawn.ignored <= np.count_nonzero(~usable)
    colourless = render(replace(scene, sh=np.zeros_like(scene.sh)), CAMERA)
    assert colourless.ignored == np.count_nonzero(~intact)
    without = render(scene.take(usable), CAMERA, passes=PASSES)
    assert without.ignored == 0
    assert_identical(arrays(drawn)[:-1], arrays(without)[:-1])
    for picture in (drawn.alpha, drawn.expected_depth, drawn.median_depth, drawn.normals):
        assert np.isfinite(picture).all()
    assert not np.isnan(drawn.rgb).any()  # a colour of 3e38 may overflow to infinity
    assert (drawn.alpha >= 0).all() and (drawn.alpha <= 1).all()


def test_every_kind_of_unusable_row_is_counted() -> None:
    scene = random_scene(41, 8)
    scene.means[0, 1] = np.nan
    scene.means[1, 2] = np.inf
    scene.quats[2] = 0
    scene.log_scales[4, 0] = np.nan
    scene.opacity_logits[5] = np.nan
    for z, ignored in ((2.0, 6), (-2.0, 5)):  # a broken colour counts in the picture, not behind the camera
        scene.means[3] = (0, 0, z)
        scene.sh[3, 15, 2] = np.nan
        assert render(scene, CAMERA).ignored == ignored
        assert render(scene, CAMERA, passes=frozenset({"alpha"})).ignored == ignored


@pytest.mark.parametrize(("logit", "alpha"), [(np.inf, 0.99), (-np.inf, 0.0)])
def test_infinite_opacity_logits_are_legal(logit: float, alpha: float) -> None:
    drawn = render(one(logit=logit, scale=0.5), CAMERA)
    assert drawn.ignored == 0
    assert drawn.alpha[14, 20] == pytest.approx(alpha, abs=1e-4)


@pytest.mark.parametrize("log_scale", [5.0, 20.0, 40.0, 79.0])
def test_a_giant_covers_the_whole_view(log_scale: float) -> None:
    giant = replace(one((0.3, -0.2, 5.0)), log_scales=np.full((1, 3), log_scale, np.float32))
    np.testing.assert_allclose(render(giant, WIDE).alpha, 0.9, rtol=1e-3)


@pytest.mark.parametrize("flat", [-20.0, -80.0, -np.inf])
def test_points_lines_and_discs_are_drawn(flat: float) -> None:
    for axes in ([flat] * 3, [-1, flat, flat], [-1, -1, flat]):
        drawn = render(replace(one(), log_scales=np.array([axes], np.float32)), CAMERA)
        assert drawn.alpha.max() > 0.3
        assert np.isfinite(drawn.normals).all()


def test_a_long_needle_does_not_glow() -> None:
    """In float32 xx·yy − xy² of this needle is mostly rounding; its profile must still be a Gaussian's."""
    turned = (np.cos(np.pi / 8), 0, 0, np.sin(np.pi / 8))
    needle = one((0, 0, 5.0), (30.0, 1e-4, 1e-4), quat=turned)
    right_angle = (WIDE.pixel_centres() - (WIDE.cx, WIDE.cy)) @ (-np.sqrt(0.5), np.sqrt(0.5))
    along = (WIDE.pixel_centres() - (WIDE.cx, WIDE.cy)) @ (np.sqrt(0.5), np.sqrt(0.5))
    alpha = 0.9 * np.exp(-0.5 * (right_angle**2 / (0.3 + (26e-4) ** 2) + along**2 / (0.3 + 780.0**2)))
    alpha[alpha < 1 / 255] = 0
    np.testing.assert_allclose(render(needle, WIDE).alpha, alpha, atol=1e-4)


@pytest.mark.parametrize("log_scale", [10.0, 30.0, 45.0, 60.0])
def test_a_needle_longer_than_the_view_looks_the_same_however_long(log_scale: float) -> None:
    """Its slant in its own whitened axes, ∝ its length, must not overflow where the blocks are found it reaches."""
    needles = [one(scale=(np.exp(s), 0.02, 0.02), quat=(0.9, 0.1, 0.2, 0.4)) for s in (8.0, log_scale)]
    short, long = (render(needle, CAMERA).alpha for needle in needles)
    np.testing.assert_allclose(long, short, atol=1e-4)


def test_a_splat_beside_the_camera_does_not_flood_the_view() -> None:
    """Its unclamped Jacobian would smear a splat 2 m to the side, barely in front, over every pixel."""
    assert render(one((2.0, 0.0, 0.02), 0.3), WIDE).alpha.max() == 0
    assert render(one((0.0, -2.0, 0.02), 0.3), WIDE).alpha.max() == 0


def test_what_lies_behind_the_near_plane_is_not_drawn() -> None:
    for z in (-2.0, 0.0, 0.009):
        assert render(one((0, 0, z)), CAMERA).alpha.max() == 0
    assert render(one((0, 0, 0.011), 1e-4), CAMERA).alpha.max() > 0


def test_a_scene_far_from_the_origin_is_drawn_where_it_is() -> None:
    """Map coordinates: the camera's float64 pose must not be rounded to float32."""
    turn = quats_to_matrices(np.array([[0.9, 0.1, -0.3, 0.2]]))[0]
    centre = np.array([400_000.0, 5_000_000.0, 300.0])
    viewmat = np.eye(4)
    viewmat[:3, :3], viewmat[:3, 3] = turn, -turn @ centre
    camera = replace(WIDE, viewmat=viewmat)
    gaussian = one(centre + turn.T @ (0.5, 0.25, 40.0), 2.0)
    drawn = render(gaussian, camera).alpha
    centroid = (drawn[..., None] * camera.pixel_centres()).sum((0, 1)) / drawn.sum()
    np.testing.assert_allclose(centroid, camera.project(gaussian.means.astype(float))[0][0], atol=0.02)


def test_no_gaussians_give_the_background() -> None:
    empty = random_scene(42).take(np.zeros(60, bool))
    drawn = render(empty, CAMERA)
    assert drawn.rgb.shape == (29, 41, 3)
    for picture in (drawn.rgb, drawn.alpha, drawn.expected_depth, drawn.median_depth, drawn.normals):
        assert not picture.any()
    assert footprint(empty, CAMERA, np.zeros(0, bool)).shape == (29, 41)
    assert contributions(empty, CAMERA).total.shape == (0,)


def test_a_picture_of_one_pixel() -> None:
    camera = Camera("dot", 1, 1, 1.0, 1.0, 0.5, 0.5, np.eye(4))
    drawn = render(one(scale=0.5), camera)
    assert drawn.alpha.shape == (1, 1)
    assert drawn.alpha[0, 0] == pytest.approx(0.9, rel=1e-5)
    assert contributions(one(scale=0.5), camera).total[0] == pytest.approx(0.9, rel=1e-5)


def draw_and_go_back(gaussians: Gaussians, camera: Camera) -> None:
    render(gaussians, camera)
    rendering, traced = trace(gaussians, camera)
    traced.backward(PictureGradients(rgb=rendering.rgb[::-1], alpha=rendering.alpha.astype(np.float64)))


def test_kernels_are_compiled_once_for_every_kind_of_input() -> None:
    """Read-only, strided or float64 arrays, surfels, every SH degree: a recompilation would take seconds."""
    kernels = (
        project.project_range,
        blend.blend_range,
        blend.weigh_range,
        unblend.unblend_range,
        unproject.unproject_range,
    )
    scene = random_scene(43, degree=1)
    draw_and_go_back(scene, CAMERA), contributions(scene, CAMERA)
    before = [len(k.signatures) for k in kernels]
    frozen = random_scene(43, degree=1)
    for array in (frozen.means, frozen.log_scales, frozen.quats, frozen.opacity_logits, frozen.sh):
        array.flags.writeable = False
    doubled = np.repeat(scene.means, 2, axis=1).astype(np.float64)
    odd: list[Gaussians] = [frozen, replace(scene, means=doubled[:, ::2])]
    odd += [random_scene(44, 10, degree) for degree in range(4)] + [random_scene(45, 10, surfels=True)]
    sized = replace(CAMERA, width=np.int32(41), height=np.int64(29))  # type: ignore[arg-type]
    for gaussians in odd:
        draw_and_go_back(gaussians, sized), contributions(gaussians, sized, pixels=np.ones((29, 41), np.uint8))
    assert [len(k.signatures) for k in kernels] == before
    assert_identical(arrays(render(frozen, CAMERA)), arrays(render(odd[1], CAMERA)))
