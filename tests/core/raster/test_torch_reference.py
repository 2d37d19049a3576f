"""The differentiable reference by itself: against brute_force.py, finite differences and closed forms."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import brute_force
import numpy as np
import pytest
from test_raster_render import CAMERA, one, posed, random_scene

from gimp3d.camera import Camera
from gimp3d.gaussians import Gaussians, quats_to_matrices
from gimp3d.raster import RasterSettings

torch = pytest.importorskip("torch")
from torch_reference import Pictures, draw  # noqa: E402 (needs torch)

DIFFERENTIABLE = ["rgb", "alpha", "expected_depth", "median_depth", "normals"]
PARAMETERS = ["means", "log_scales", "quats", "opacity_logits", "sh"]


def settings(**changes: object) -> SimpleNamespace:
    """RasterSettings and what surfels need besides."""
    common = vars(RasterSettings(background=(0.1, 0.2, 0.3)))
    return SimpleNamespace(**{**common, "surfel_low_pass": 0.5, **changes})


def tensors(gaussians: Gaussians) -> list:
    """The five parameters in float64, with gradients."""
    return [torch.tensor(getattr(gaussians, p), dtype=torch.float64, requires_grad=True) for p in PARAMETERS]


def pictures(gaussians: Gaussians, camera: Camera = CAMERA, **changes: object) -> Pictures:
    return draw(*tensors(gaussians), camera, settings(**changes), gaussians.antialiased)


def surfel(**changes: object) -> Gaussians:
    """The Gaussian of `one`, with its third scale left out."""
    gaussian = one(**changes)
    return replace(gaussian, log_scales=gaussian.log_scales[:, :2])


def tiny_scene(surfels: bool) -> tuple[Gaussians, Camera]:
    """Three solid, tilted Gaussians across a 6 × 5 px view that has no symmetry."""
    rng = np.random.default_rng(4)
    means = np.array([[0.1, -0.2, 1.6], [-0.4, 0.3, 2.1], [0.3, 0.2, 2.9]])
    scales = rng.uniform(-1.6, -0.4, (3, 2 if surfels else 3))
    scales[1] -= 1.0 * surfels  # small enough that the low-pass reaches beyond it
    logits = np.array([0.2, 1.0, 0.6])
    camera = posed(Camera("tiny", 6, 5, 5.0, 5.5, 2.8, 2.3, np.eye(4)), 1)
    return Gaussians(means, scales, rng.normal(0, 1, (3, 4)), logits, rng.normal(0, 0.15, (3, 4, 3))), camera


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("seed", range(3))
def test_3d_gaussians_match_brute_force(seed: int, antialiased: bool) -> None:
    gaussians = replace(random_scene(seed), antialiased=antialiased)
    camera, raster = posed(CAMERA, seed), RasterSettings(background=(0.1, 0.2, 0.3))
    drawn, reference = pictures(gaussians, camera), brute_force.draw(gaussians, camera, raster)
    doubtful = drawn.doubtful.numpy()
    assert (doubtful >= reference.doubtful).all()
    assert doubtful.mean() < 0.02
    for name in ["rgb", "alpha", "expected_depth", "median_depth", "normals"]:
        np.testing.assert_allclose(
            getattr(drawn, name).detach().numpy()[~doubtful],
            getattr(reference, name)[~doubtful],
            rtol=1e-9,
            atol=1e-10,
            err_msg=name,
        )
    weights = np.moveaxis(drawn.weights.detach().numpy(), 2, 0)
    np.testing.assert_allclose(weights[:, ~doubtful], reference.weights[:, ~doubtful], rtol=1e-9, atol=1e-10)


@pytest.mark.parametrize("name", DIFFERENTIABLE)
@pytest.mark.parametrize("kind", ["3d", "antialiased", "surfels"])
def test_gradients_match_finite_differences(kind: str, name: str) -> None:
    gaussians, camera = tiny_scene(kind == "surfels")
    exact = settings(alpha_min=1e-12)
    drawn = draw(*tensors(gaussians), camera, exact, kind == "antialiased")
    assert not drawn.doubtful.any()
    assert len(drawn.median_depth.unique()) > 2  # the median comes from several Gaussians

    def picture(*parameters):
        return getattr(draw(*parameters, camera, exact, kind == "antialiased"), name)

    assert torch.autograd.gradcheck(picture, tensors(gaussians), eps=1e-6, atol=1e-6, rtol=1e-4)


def test_the_tiny_surfels_are_met_on_their_planes_and_beside_them() -> None:
    """So that the finite differences try both; beside its plane a surfel's depth is its centre's."""
    gaussians, camera = tiny_scene(surfels=True)
    beside = []
    for row, z in enumerate(camera.to_camera(gaussians.means)[:, 2]):
        drawn = pictures(gaussians.take(np.array([row])), camera, alpha_min=1e-12)
        beside.append(np.isclose(drawn.expected_depth.detach(), z, rtol=1e-12) & (drawn.alpha > 1e-3).numpy())
    assert 5 < np.sum(beside) < 60


@pytest.mark.parametrize("surfels", [False, True])
def test_gradients_are_finite_and_rows_behind_the_camera_have_none(surfels: bool) -> None:
    gaussians = random_scene(5, surfels=surfels)
    parameters = tensors(gaussians)
    drawn = draw(*parameters, CAMERA, settings())
    sum((getattr(drawn, name) ** 2).sum() for name in DIFFERENTIABLE).backward()
    behind = gaussians.means[:, 2] < 0.01
    assert behind.any()
    for parameter in parameters:
        assert parameter.grad.isfinite().all()
        assert (parameter.grad[behind] == 0).all()
        assert (parameter.grad != 0).any()
    assert (drawn.weights[:, :, behind] == 0).all()


def depth_where_drawn(gaussians: Gaussians, row: int) -> np.ndarray:
    """One Gaussian's depth at every pixel that it reaches, 1 elsewhere, [H, W]."""
    depth = pictures(gaussians.take(np.array([row]))).expected_depth.detach().numpy()
    return np.where(depth > 0, depth, 1.0)


@pytest.mark.parametrize("surfels", [False, True])
def test_nothing_before_the_camera_is_the_background(surfels: bool) -> None:
    gaussians = random_scene(5, surfels=surfels)
    drawn = pictures(gaussians.take(gaussians.means[:, 2] < 0))
    assert (drawn.rgb == torch.tensor([0.1, 0.2, 0.3], dtype=torch.float64)).all()
    assert not any(getattr(drawn, name).any() for name in [*DIFFERENTIABLE[1:], "doubtful", "weights"])


@pytest.mark.parametrize("surfels", [False, True])
def test_pairs_that_are_not_used_do_not_count(surfels: bool) -> None:
    gaussians = random_scene(7, surfels=surfels)
    chosen = np.random.default_rng(7).random(len(gaussians)) < 0.5
    used = torch.tensor(chosen).expand(CAMERA.height, CAMERA.width, -1)
    masked = draw(*tensors(gaussians), CAMERA, settings(), used=used)
    fewer = pictures(gaussians.take(chosen))
    for name in [*DIFFERENTIABLE, "doubtful"]:
        torch.testing.assert_close(getattr(masked, name), getattr(fewer, name), rtol=1e-9, atol=1e-12)
    torch.testing.assert_close(masked.weights[:, :, chosen], fewer.weights)


def test_gradients_stop_at_the_largest_alpha_and_below_the_smallest() -> None:
    parameters = tensors(one(logit=20.0, scale=0.1))
    drawn = draw(*parameters, CAMERA, settings())
    (drawn.alpha[14, 20] + drawn.alpha[0, 0]).backward()
    assert drawn.alpha[14, 20] == 0.99
    assert drawn.alpha[0, 0] == 0
    assert all((p.grad == 0).all() for p in parameters if p.grad is not None)


def test_thresholds_are_marked_as_doubtful() -> None:
    logit = float(np.log(0.99 / 0.01))  # opacity alpha_max at the centre
    drawn = pictures(replace(one(), opacity_logits=np.array([logit])))
    assert drawn.doubtful[14, 20]
    assert not pictures(one()).doubtful.any()
    alpha = float(pictures(one()).alpha[14, 25].detach())
    assert pictures(one(), alpha_min=alpha * (1 + 5e-5)).doubtful[14, 25]
    half = pictures(replace(one(), opacity_logits=np.zeros(1)))
    assert half.doubtful[14, 20]


def test_a_surfel_facing_the_camera_has_its_closed_form() -> None:
    """alpha = o·exp(−r²/2σ²): σ = f s / z when that is large, σ² = 0.5 px² when it is small."""
    camera = replace(CAMERA, fx=40.0, fy=40.0)
    radius2 = ((camera.pixel_centres() - (camera.cx, camera.cy)) ** 2).sum(-1)
    for scale, variance in ((0.1, (40 * 0.1 / 2) ** 2), (0.01, 0.5)):
        drawn = pictures(surfel(scale=scale), camera)
        alpha = 0.9 * np.exp(-0.5 * radius2 / variance)
        alpha[alpha < 1 / 255] = 0
        np.testing.assert_allclose(drawn.alpha.detach(), alpha, rtol=1e-6)
        np.testing.assert_allclose(drawn.expected_depth.detach(), np.where(alpha > 0, 2.0, 0.0), rtol=1e-12)
        np.testing.assert_allclose(drawn.median_depth.detach(), np.where(alpha > 0.5, 2.0, 0.0), rtol=1e-12)
        rgb = alpha[..., None] * (0.8, 0.5, 0.2) + (1 - alpha[..., None]) * (0.1, 0.2, 0.3)
        np.testing.assert_allclose(drawn.rgb.detach(), rgb, rtol=1e-6)
        np.testing.assert_allclose(drawn.normals.detach()[alpha > 0], [(0, 0, -1)] * np.sum(alpha > 0), atol=1e-12)


def test_a_tilted_surfel_is_met_on_its_plane() -> None:
    """Points at its depth lie in the plane, and alpha is the Gaussian of their coordinates in it."""
    camera = posed(CAMERA, 1)
    gaussians = surfel(mean=(0.1, -0.05, 2.0), scale=0.3, quat=(0.9, 0.5, -0.4, 0.7))
    gaussians = replace(gaussians, log_scales=np.log([[0.5, 0.25]]).astype(np.float32))
    drawn = pictures(gaussians, camera)
    there = (drawn.alpha > 0).numpy()
    assert there.sum() > 100
    points = camera.unproject(camera.pixel_centres(), drawn.expected_depth.detach().numpy())[there]
    u, v, height = np.moveaxis((points - gaussians.means) @ quats_to_matrices(gaussians.quats)[0].astype(float), -1, 0)
    assert np.ptp(drawn.expected_depth.detach().numpy()[there]) > 0.5
    np.testing.assert_allclose(height, 0, atol=1e-6)
    alpha = 0.9 * np.exp(-0.5 * ((u / 0.5) ** 2 + (v / 0.25) ** 2))
    np.testing.assert_allclose(drawn.alpha.detach().numpy()[there], alpha, rtol=1e-4)


def test_a_surfel_seen_edge_on_is_a_dot() -> None:
    """Rays miss its plane; the low-pass remains, at its centre's depth."""
    turn = np.deg2rad(90) / 2
    drawn = pictures(surfel(scale=0.5, quat=(np.cos(turn), 0, np.sin(turn), 0)))
    radius2 = ((CAMERA.pixel_centres() - (CAMERA.cx, CAMERA.cy)) ** 2).sum(-1)
    alpha = 0.9 * np.exp(-radius2)
    alpha[alpha < 1 / 255] = 0
    np.testing.assert_allclose(drawn.alpha.detach(), alpha, rtol=1e-6)
    np.testing.assert_array_equal(drawn.expected_depth.detach(), np.where(alpha > 0, 2.0, 0.0))


def test_a_surfel_is_not_met_before_the_near_plane() -> None:
    """A floor that passes below the camera, in a column of pixels that its centre's dot does not reach."""
    turn = np.deg2rad(80) / 2
    floor = surfel(mean=(0.4, 0.4, 2.0), scale=3.0, quat=(np.cos(turn), np.sin(turn), 0, 0))
    for near, row in ((0.01, 28), (1.0, 21)):  # the last row of pixels, and the last whose ray is long enough
        drawn = pictures(floor, near=near)
        depth = drawn.expected_depth[:, 15].detach()
        assert (depth[row] > near) & (depth[row] < 1.5)
        assert (depth[row + 1 :] == 0).all()
        assert (drawn.alpha[row + 1 :, 15] == 0).all()
