"""Surfels, met by each pixel's ray: against the float64 reference and closed forms; turned SH for both kinds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from property_tests import examples
from test_raster_render import CAMERA, one, posed, random_scene

from gimp3d.camera import Camera
from gimp3d.gaussians import Gaussians, matrices_to_quats, quats_to_matrices, sh_basis
from gimp3d.raster import PASSES, RasterSettings, Rendering, contributions, footprint, render

torch = pytest.importorskip("torch")
from torch_reference import Pictures, draw  # noqa: E402 (needs torch)

WIDE = Camera("wide", 150, 90, 120.0, 118.0, 74.0, 46.0, np.eye(4))
EVERY_ALPHA = RasterSettings(alpha_min=1e-5, stop=1e-9)  # no threshold large enough to flip visibly
BACKGROUND = RasterSettings(background=(0.1, 0.2, 0.3))


def surfel(scale: float | tuple[float, float] = 0.1, **changes: object) -> Gaussians:
    """The Gaussian of `one` with two scales."""
    gaussian = one(**changes)  # type: ignore[arg-type]
    return replace(gaussian, log_scales=np.log(np.broadcast_to(np.float32(scale), (1, 2))))


def turned_about_x(degrees: float) -> tuple[float, float, float, float]:
    half = np.deg2rad(degrees) / 2
    return float(np.cos(half)), float(np.sin(half)), 0.0, 0.0


def turned_sh(sh: np.ndarray, turn: np.ndarray) -> np.ndarray:
    """Coefficients [N, K, 3] of the colours that are seen along turned directions as `sh`'s are along the old ones."""
    d = np.random.default_rng(0).normal(size=(64, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    before, after = (sh_basis(towards, round(sh.shape[1] ** 0.5) - 1) for towards in (d, d @ turn.T))
    return np.asarray(np.linalg.pinv(after) @ before @ sh, np.float32)


def reference(gaussians: Gaussians, camera: Camera, raster: RasterSettings = BACKGROUND) -> Pictures:
    values = (gaussians.means, gaussians.log_scales, gaussians.quats, gaussians.opacity_logits, gaussians.sh)
    return draw(*(torch.tensor(v, dtype=torch.float64) for v in values), camera, raster, gaussians.antialiased)


def everything(gaussians: Gaussians, camera: Camera, raster: RasterSettings = BACKGROUND) -> Rendering:
    return render(gaussians, camera, raster, PASSES)


def assert_matches_reference(gaussians: Gaussians, camera: Camera, raster: RasterSettings = BACKGROUND) -> None:
    """All six pictures, at every pixel whose thresholds are not a matter of rounding (nearly all are not)."""
    drawn, expected = everything(gaussians, camera, raster), reference(gaussians, camera, raster)
    sure = ~expected.doubtful.numpy()
    assert sure.mean() > 0.95
    stopped = 2 * raster.stop  # what may lie behind the end of a tile
    alpha = expected.alpha.numpy()
    np.testing.assert_allclose(drawn.alpha[sure], alpha[sure], atol=stopped)
    np.testing.assert_array_equal(drawn.alpha[sure] == 0, alpha[sure] == 0)
    np.testing.assert_allclose(drawn.rgb[sure], expected.rgb.numpy()[sure], atol=2 * stopped)
    np.testing.assert_allclose(drawn.expected_depth[sure], expected.expected_depth.numpy()[sure], rtol=2e-3)
    np.testing.assert_allclose(drawn.median_depth[sure], expected.median_depth.numpy()[sure], rtol=2e-4)
    clear = sure & (expected.normals.norm(dim=-1).numpy() > 0)
    if clear.any():
        cosine = (drawn.normals * expected.normals.numpy()).sum(-1)[clear]
        assert np.quantile(cosine, 0.01) > 0.99999  # nearly cancelling normals have no direction


@pytest.mark.parametrize("seed", range(8))
def test_all_pictures_match_the_reference(seed: int) -> None:
    camera = (CAMERA, WIDE)[seed % 2]
    assert_matches_reference(random_scene(seed, degree=seed % 4, surfels=True), posed(camera, seed))


def test_other_thresholds_match_the_reference() -> None:
    raster = RasterSettings((0.2, 0.4, 0.6), 2.0, 0.3, 2.0, 1e-3, 0.8)
    for seed in range(3):
        assert_matches_reference(random_scene(seed, surfels=True), posed(CAMERA, seed), raster)


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
    gaussians = random_scene(seed, 30, 1, surfels=True)
    drawn, expected = everything(gaussians, camera), reference(gaussians, camera)
    sure = ~expected.doubtful.numpy()
    np.testing.assert_allclose(drawn.rgb[sure], expected.rgb.numpy()[sure], atol=1e-3)
    np.testing.assert_allclose(drawn.alpha[sure], expected.alpha.numpy()[sure], atol=2e-4)
    np.testing.assert_allclose(drawn.expected_depth[sure], expected.expected_depth.numpy()[sure], rtol=1e-2)


@pytest.mark.parametrize("scale", [0.1, 0.01])
def test_a_surfel_facing_the_camera_has_its_closed_form(scale: float) -> None:
    """alpha = o·exp(−r²/2σ²): σ = f s / z where that is large, σ² = 0.5 px² where it is small."""
    camera = replace(CAMERA, fx=40.0, fy=40.0)
    drawn = everything(surfel(scale), camera)
    radius2 = ((camera.pixel_centres() - (camera.cx, camera.cy)) ** 2).sum(-1)
    alpha = 0.9 * np.exp(-0.5 * radius2 / max((40 * scale / 2) ** 2, 0.5))
    alpha[alpha < 1 / 255] = 0
    np.testing.assert_allclose(drawn.alpha, alpha, atol=1e-6)
    rgb = alpha[..., None] * (0.8, 0.5, 0.2) + (1 - alpha[..., None]) * (0.1, 0.2, 0.3)
    np.testing.assert_allclose(drawn.rgb, rgb, atol=1e-6)
    there = alpha > 0
    np.testing.assert_allclose(drawn.expected_depth, np.where(there, 2.0, 0.0), rtol=1e-4)
    np.testing.assert_array_equal(drawn.median_depth, np.where(alpha > 0.5, np.float32(2), np.float32(0)))
    np.testing.assert_allclose(drawn.normals[there], [(0, 0, -1)] * there.sum(), atol=1e-6)


def test_a_tilted_surfel_has_its_planes_depth() -> None:
    """Both depths are those of points on the plane, and alpha is the Gaussian of their coordinates in it."""
    camera = posed(CAMERA, 1)
    gaussians = surfel((0.5, 0.25), mean=(0.1, -0.05, 2.0), quat=(0.9, 0.5, -0.4, 0.7))
    drawn = everything(gaussians, camera)
    for depth, least in ((drawn.expected_depth, 0.0), (drawn.median_depth, 0.5)):
        there = drawn.alpha > least
        assert there.sum() > 50
        assert np.ptp(depth[there]) > 0.3
        points = camera.unproject(camera.pixel_centres(), depth.astype(float))[there]
        axes = quats_to_matrices(gaussians.quats)[0].astype(float)
        u, v, height = np.moveaxis((points - gaussians.means) @ axes, -1, 0)
        np.testing.assert_allclose(height, 0, atol=5e-4 if least == 0 else 1e-5)  # faint pixels: Σ w z / Σ w
        alpha = 0.9 * np.exp(-0.5 * ((u / 0.5) ** 2 + (v / 0.25) ** 2))
        np.testing.assert_allclose(drawn.alpha[there], alpha, rtol=5e-3)
    np.testing.assert_array_equal(drawn.median_depth[drawn.alpha < 0.499], 0)


def test_the_median_depth_is_that_of_the_surfel_that_blocks_half_of_the_light() -> None:
    tilted, behind = turned_about_x(50), (0, 0, 4.0)
    faint = surfel(2.0, mean=(0, 0, 1.5), logit=-1.0, quat=tilted)
    both = faint.extended(surfel(3.0, mean=behind, logit=3.0, quat=tilted))
    drawn = everything(both, CAMERA)
    alone = everything(both.take(np.array([1])), CAMERA)
    there = (drawn.median_depth > 0) & (alone.median_depth > 0)
    assert there.mean() > 0.5
    np.testing.assert_allclose(drawn.median_depth[there], alone.median_depth[there], rtol=1e-6)


@pytest.mark.parametrize("distance", [0.05, 0.5, 2.0, 8.0])
@pytest.mark.parametrize("tilt", [-80, -60, 60, 80, 88])
def test_a_surfel_partly_behind_the_camera_does_not_flood_the_view(tilt: float, distance: float) -> None:
    """A floor or ceiling that goes on below and behind the camera is seen up to its horizon, not beyond."""
    quat = turned_about_x(tilt)
    normal = quats_to_matrices(np.array([quat]))[0, :, 2]
    floor = surfel(100.0, mean=(0.1, 0.3, distance), quat=quat, logit=2.0)
    assert_matches_reference(floor, CAMERA)
    drawn = everything(floor, CAMERA)
    rays = CAMERA.unproject(CAMERA.pixel_centres(), np.ones((29, 41)))
    met = (normal @ floor.means[0].astype(float)) / (rays @ normal)
    missed = (met < 0) & (((CAMERA.pixel_centres() - CAMERA.project(floor.means.astype(float))[0][0]) ** 2).sum(-1) > 8)
    assert (drawn.alpha[missed] == 0).all()


def test_surfels_through_the_cameras_plane_match_the_reference() -> None:
    """Large discs around the camera, at any angle."""
    for seed in range(10):
        gaussians = random_scene(seed, 12, 0, surfels=True)
        means = np.random.default_rng(seed).normal(0, 0.8, (12, 3)).astype(np.float32)
        large = np.full((12, 2), 0.5, np.float32)
        assert_matches_reference(replace(gaussians, means=means, log_scales=large), CAMERA)


@pytest.mark.parametrize("scale", [0.5, 1e-5, 1e5])
def test_a_surfel_seen_edge_on_is_a_dot(scale: float) -> None:
    drawn = everything(surfel(scale, quat=turned_about_x(90)), CAMERA)
    radius2 = ((CAMERA.pixel_centres() - (CAMERA.cx, CAMERA.cy)) ** 2).sum(-1)
    alpha = 0.9 * np.exp(-radius2)
    alpha[alpha < 1 / 255] = 0
    np.testing.assert_allclose(drawn.alpha, alpha, atol=1e-6)
    np.testing.assert_allclose(drawn.expected_depth, np.where(alpha > 0, 2.0, 0.0), rtol=1e-4)


@pytest.mark.parametrize("degrees", [89.0, 89.9, 89.99, 89.9999])
def test_surfels_nearly_edge_on_match_the_reference(degrees: float) -> None:
    """They are a thin line, which the low-pass widens around their centre only."""
    assert_matches_reference(surfel(0.3, mean=(0.1, -0.13, 2.0), quat=turned_about_x(degrees)), CAMERA)


@pytest.mark.parametrize("log_scale", [5.0, 20.0, 40.0, 79.0])
@pytest.mark.parametrize("quat", [(1, 0, 0, 0), (0.9, 0.3, 0.1, 0.2)])
def test_a_giant_covers_everything(log_scale: float, quat: tuple[float, ...]) -> None:
    giant = replace(surfel(mean=(0.3, -0.2, 5.0), quat=quat), log_scales=np.full((1, 2), log_scale, np.float32))
    drawn = everything(giant, WIDE)
    np.testing.assert_allclose(drawn.alpha, 0.9, rtol=3e-3)
    assert_matches_reference(giant, WIDE)


def test_contributions_and_footprints_match_the_reference() -> None:
    for seed in range(4):
        gaussians, camera = random_scene(seed, surfels=True), posed(CAMERA, seed)
        expected = reference(gaussians, camera, EVERY_ALPHA)
        sure = ~expected.doubtful.numpy()
        weights = expected.weights.numpy()[sure]
        share = contributions(gaussians, camera, EVERY_ALPHA, sure)
        np.testing.assert_allclose(share.total, weights.sum(0), rtol=1e-3, atol=2e-3)
        np.testing.assert_allclose(share.peak, weights.max(0), atol=2e-5)
        chosen = np.random.default_rng(seed).random(len(gaussians)) < 0.3
        seen = footprint(gaussians, camera, chosen, EVERY_ALPHA)[sure]
        np.testing.assert_allclose(seen, weights[:, chosen].sum(1), atol=1e-4)


@pytest.mark.parametrize("degree", range(4))
@pytest.mark.parametrize("surfels", [False, True])
def test_a_rigid_motion_of_scene_and_camera_changes_nothing(surfels: bool, degree: int) -> None:
    gaussians, camera = random_scene(60 + degree, degree=degree, surfels=surfels), posed(CAMERA, degree)
    turn = quats_to_matrices(np.array([[0.4, -0.7, 0.3, 0.5]]))[0]
    shift = np.array([0.5, -0.25, 1.0])
    moved = replace(
        gaussians,
        means=(gaussians.means @ turn.T + shift).astype(np.float32),
        quats=matrices_to_quats(turn @ quats_to_matrices(gaussians.quats.astype(float))).astype(np.float32),
        sh=turned_sh(gaussians.sh, turn),
    )
    viewmat = np.eye(4)
    viewmat[:3, :3], viewmat[:3, 3] = camera.R @ turn.T, camera.t - camera.R @ turn.T @ shift
    before, after = everything(gaussians, camera), everything(moved, replace(camera, viewmat=viewmat))
    for name, most in (("rgb", 1e-4), ("alpha", 1e-4), ("normals", 1e-3)):
        difference = np.abs(getattr(before, name) - getattr(after, name))
        assert np.quantile(difference, 0.99) < most, name
        assert difference.mean() < most, name
    assert before.rgb.std() > 0.05
