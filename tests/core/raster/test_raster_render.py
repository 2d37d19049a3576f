"""Pictures against the brute-force reference and closed forms."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from brute_force import DEFAULT, draw
from hypothesis import given
from hypothesis import strategies as st
from property_tests import examples

from gimp3d.camera import Camera
from gimp3d.gaussians import SH_C0, Gaussians, matrices_to_quats, quats_to_matrices
from gimp3d.raster import ALL_PASSES, PASSES, RasterSettings, render

CAMERA = Camera("front", 41, 29, 35.0, 33.0, 20.5, 14.5, np.eye(4))
LOGIT_09 = float(np.log(9.0))  # opacity 0.9


def random_scene(seed: int, count: int = 60, degree: int = 3, surfels: bool = False) -> Gaussians:
    """Blobs, discs and needles in front of, beside and behind a camera at the origin, faint to solid."""
    rng = np.random.default_rng(seed)
    depth = rng.uniform(-1, 6, count)
    means = np.stack([rng.normal(0, 0.6, count) * depth, rng.normal(0, 0.5, count) * depth, depth], 1)
    return Gaussians(
        means=means.astype(np.float32),
        log_scales=rng.uniform(-4.5, -0.3, (count, 2 if surfels else 3)).astype(np.float32),
        quats=rng.normal(0, 2, (count, 4)).astype(np.float32),
        opacity_logits=rng.uniform(-3, 5, count).astype(np.float32),
        sh=rng.normal(0, 0.4, (count, (degree + 1) ** 2, 3)).astype(np.float32),
    )


def one(mean=(0.0, 0.0, 2.0), scale=0.1, logit=LOGIT_09, colour=(0.8, 0.5, 0.2), quat=(1, 0, 0, 0)) -> Gaussians:
    """A single Gaussian of SH degree 0."""
    return Gaussians(
        np.array([mean], np.float32),
        np.log(np.broadcast_to(np.float32(scale), (1, 3))),
        np.array([quat], np.float32),
        np.array([logit], np.float32),
        ((np.array(colour, np.float32) - 0.5) / np.float32(SH_C0))[None, None],
    )


def posed(camera: Camera, seed: int) -> Camera:
    """The camera turned a little and moved a little."""
    rng = np.random.default_rng(seed)
    viewmat = np.eye(4)
    viewmat[:3, :3] = quats_to_matrices(np.array([[1, *rng.normal(0, 0.15, 3)]]))[0]
    viewmat[:3, 3] = rng.normal(0, 0.3, 3)
    return replace(camera, viewmat=viewmat)


def assert_matches_reference(gaussians: Gaussians, camera: Camera, raster: RasterSettings = DEFAULT) -> None:
    """Every pass, at every pixel whose thresholds are not a matter of rounding (nearly all are not)."""
    drawn, reference = render(gaussians, camera, raster), draw(gaussians, camera, raster)
    sure = ~reference.doubtful
    assert sure.mean() > 0.95
    stopped = 2 * raster.stop  # what may lie behind the end of a tile
    np.testing.assert_allclose(drawn.alpha[sure], reference.alpha[sure], atol=stopped)
    np.testing.assert_allclose(drawn.rgb[sure], reference.rgb[sure], atol=2 * stopped)
    np.testing.assert_array_equal(drawn.alpha[sure] == 0, reference.alpha[sure] == 0)
    np.testing.assert_allclose(drawn.median_depth[sure], reference.median_depth[sure], rtol=1e-5)
    np.testing.assert_allclose(drawn.expected_depth[sure], reference.expected_depth[sure], rtol=2e-3)
    clear = sure & (np.linalg.norm(reference.normals, axis=-1) > 0)
    cosine = (drawn.normals * reference.normals).sum(-1)[clear]
    assert np.quantile(cosine, 0.01) > 0.99999  # nearly cancelling normals have no direction
    # and the doubtful ones are off by no more than a flipped threshold
    assert np.abs(drawn.alpha - reference.alpha).max() < 2 * raster.alpha_min
    assert np.abs(drawn.rgb - reference.rgb).mean() < 1e-4


@pytest.mark.parametrize("degree", range(4))
def test_every_sh_degree_matches_the_reference(degree: int) -> None:
    assert_matches_reference(random_scene(degree, degree=degree), posed(CAMERA, degree))


@examples(25)
@given(
    seed=st.integers(0, 10**6),
    width=st.integers(1, 50),
    height=st.integers(1, 50),
    offset=st.floats(-0.6, 0.6),
)
def test_any_scene_size_and_principal_point_match_the_reference(
    seed: int, width: int, height: int, offset: float
) -> None:
    camera = replace(CAMERA, width=width, height=height, cx=width * (0.5 + offset), cy=height * (0.5 - offset / 2))
    gaussians, reference = random_scene(seed, 30, 1), draw(random_scene(seed, 30, 1), camera)
    drawn = render(gaussians, camera)
    sure = ~reference.doubtful
    assert drawn.rgb.shape == (height, width, 3)
    np.testing.assert_allclose(drawn.alpha[sure], reference.alpha[sure], atol=2e-4)
    np.testing.assert_allclose(drawn.rgb[sure], reference.rgb[sure], atol=4e-4)
    np.testing.assert_allclose(drawn.median_depth[sure], reference.median_depth[sure], rtol=1e-5)


def test_antialiased_opacity_matches_the_reference() -> None:
    gaussians = random_scene(8)
    thin = replace(gaussians, antialiased=True)
    assert_matches_reference(thin, CAMERA)
    assert render(thin, CAMERA).alpha.sum() < render(gaussians, CAMERA).alpha.sum()


def test_other_thresholds_match_the_reference() -> None:
    raster = RasterSettings((0.2, 0.4, 0.6), near=2.0, low_pass=1.5, alpha_min=1e-3, alpha_max=0.8)
    assert_matches_reference(random_scene(10), CAMERA, raster)


def test_many_tiles_match_the_reference() -> None:
    """Needles across several tiles: none that the ellipse reaches may be left out of the lists."""
    camera = Camera("wide", 150, 90, 120.0, 120.0, 75.0, 45.0, np.eye(4))
    gaussians = random_scene(11, 60, 0)
    needles = replace(gaussians, log_scales=gaussians.log_scales + np.float32([1.5, -2, -2]))
    assert_matches_reference(needles, camera)


def test_a_single_splat_has_its_closed_form() -> None:
    """Isotropic at the optical axis: alpha = o·exp(−r²/2σ²) with σ² = (f s / z)² + 0.3 px²."""
    camera = replace(CAMERA, fx=40.0, fy=40.0)
    drawn = render(one(), camera, RasterSettings(background=(0.1, 0.2, 0.3)))
    radius2 = ((camera.pixel_centres() - (camera.cx, camera.cy)) ** 2).sum(-1)
    alpha = 0.9 * np.exp(-0.5 * radius2 / ((40 * 0.1 / 2) ** 2 + 0.3))
    alpha[alpha < 1 / 255] = 0
    np.testing.assert_allclose(drawn.alpha, alpha, atol=1e-6)
    rgb = alpha[..., None] * (0.8, 0.5, 0.2) + (1 - alpha[..., None]) * (0.1, 0.2, 0.3)
    np.testing.assert_allclose(drawn.rgb, rgb, atol=1e-6)
    there = alpha > 0
    np.testing.assert_allclose(drawn.expected_depth[there], 2.0, rtol=1e-4)
    np.testing.assert_array_equal(drawn.median_depth, np.where(alpha > 0.5, np.float32(2), np.float32(0)))


@pytest.mark.parametrize(("u", "v"), [(10.5, 7.5), (10.0, 7.0), (16.0, 16.0), (31.75, 15.25)])
def test_pixel_centres_lie_at_one_half(u: float, v: float) -> None:
    """A splat projected to (u, v) has its centre of mass there, also astride tiles."""
    mean = CAMERA.unproject(np.array([u, v]), np.array(2.0))
    drawn = render(one(mean, 0.08), CAMERA, RasterSettings(alpha_min=1e-6))
    centroid = (drawn.alpha[..., None] * CAMERA.pixel_centres()).sum((0, 1)) / drawn.alpha.sum()
    np.testing.assert_allclose(centroid, (u, v), atol=2e-3)


def test_a_rigid_motion_of_scene_and_camera_changes_nothing() -> None:
    gaussians = random_scene(12, degree=0)
    turn = quats_to_matrices(np.array([[0.4, -0.7, 0.3, 0.5]]))[0]
    shift = np.array([3.0, -2.0, 7.0])
    moved = replace(
        gaussians,
        means=(gaussians.means @ turn.T + shift).astype(np.float32),
        quats=matrices_to_quats(turn @ quats_to_matrices(gaussians.quats.astype(float))).astype(np.float32),
    )
    viewmat = np.eye(4)
    viewmat[:3, :3], viewmat[:3, 3] = turn.T, -turn.T @ shift
    before, after = render(gaussians, CAMERA), render(moved, replace(CAMERA, viewmat=viewmat))
    difference = np.abs(before.rgb - after.rgb)
    assert np.quantile(difference, 0.999) < 1e-4
    assert difference.mean() < 1e-5
    assert np.quantile(np.abs(before.normals - after.normals), 0.99) < 1e-3


def test_normals_are_the_flattest_axis_facing_the_camera() -> None:
    half = np.deg2rad(60) / 2  # a disc turned by 60° about y
    for side in (1, -1):
        disc = one(scale=(0.3, 0.3, 1e-4), quat=(np.cos(half), 0, side * np.sin(half), 0))
        normal = render(disc, CAMERA).normals[14, 20]
        np.testing.assert_allclose(normal, (-side * np.sin(2 * half), 0, -np.cos(2 * half)), atol=1e-5)


def test_colours_may_exceed_one_but_not_fall_below_zero() -> None:
    drawn = render(one(colour=(3.0, -2.0, 0.5), scale=1.0, logit=20.0), CAMERA).rgb[14, 20]
    np.testing.assert_allclose(drawn, (3.0 * 0.99, 0.0, 0.5 * 0.99), rtol=1e-4)


@pytest.mark.parametrize(
    "wanted",
    [set(), {"rgb"}, {"alpha"}, {"depth"}, {"expected_depth"}, {"normal"}, {"alpha", "depth"}],
)
@pytest.mark.parametrize("surfels", [False, True])
def test_a_pass_is_the_same_alone_as_with_the_others(surfels: bool, wanted: set[str]) -> None:
    gaussians = random_scene(13, surfels=surfels)
    everything, some = render(gaussians, CAMERA, passes=PASSES), render(gaussians, CAMERA, passes=frozenset(wanted))
    passes = {  # each picture's
        "rgb": {"rgb"},
        "expected_depth": {"depth", "expected_depth"},
        "median_depth": {"depth"},
        "normals": {"normal"},
    }
    np.testing.assert_array_equal(some.alpha, everything.alpha)
    for field, names in passes.items():
        if names & wanted:
            np.testing.assert_array_equal(getattr(some, field), getattr(everything, field))
        else:
            assert getattr(some, field).size == 0
        assert getattr(everything, field).any()


def test_an_unknown_pass_is_named() -> None:
    with pytest.raises(ValueError, match=r"colour.*alpha.*depth.*expected_depth.*normal.*rgb"):
        render(one(), CAMERA, passes=ALL_PASSES | {"colour"})
