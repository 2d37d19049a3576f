"""Gaussians that are partly the object's are split where photos show its outline."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scenes import cameras, discs

from gimp3d.camera import Camera
from gimp3d.gaussians import Gaussians, quats_to_matrices
from gimp3d.raster import footprint
from gimp3d.stages.splitting import split_at_outline, truncated

EYES = cameras(9, 200, 150)
HALF = np.array([0.5])
seeds = st.integers(0, 10**6)


def one(seed: int, surfel: bool = False) -> tuple[Gaussians, np.ndarray]:
    """A Gaussian of any shape, and the direction of a cut, in its own frame."""
    rng = np.random.default_rng(seed)
    scales = rng.normal(-2, 1, (1, 2 if surfel else 3)).astype(np.float32)
    quats, sh = rng.normal(size=(1, 4)).astype(np.float32), np.zeros((1, 1, 3), np.float32)
    towards = rng.normal(size=(1, 3)) * [1, 1, 0 if surfel else 1]
    means = rng.normal(size=(1, 3)).astype(np.float32)
    return Gaussians(means, scales, quats, np.zeros(1, np.float32), sh), towards / np.linalg.norm(towards)


def covariance(gaussians: Gaussians) -> np.ndarray:
    """[3, 3] of the first."""
    scales = np.exp(gaussians.log_scales[0].astype(np.float64))
    axes = quats_to_matrices(gaussians.quats.astype(np.float64))[0][:, : len(scales)] * scales
    return axes @ axes.T


@given(seeds, st.floats(0.02, 0.98), st.booleans())
def test_a_part_has_the_moments_of_what_lies_on_its_side(seed: int, share: float, surfel: bool) -> None:
    whole, towards = one(seed, surfel)
    samples = np.random.default_rng(0).normal(size=(40_000, 3)) * [1, 1, 0 if surfel else 1]
    across = samples @ towards[0]
    left = samples[across > np.quantile(across, share)]
    scales = np.pad(np.exp(whole.log_scales[0].astype(np.float64)), (0, 1 if surfel else 0))
    axes = quats_to_matrices(whole.quats.astype(np.float64))[0] * scales
    expected = left @ axes.T + whole.means[0]
    found, largest = truncated(whole, towards, np.array([share])), scales.max()
    error = 5 / np.sqrt(len(left))  # of a mean of so many samples, in standard deviations
    np.testing.assert_allclose(found.means[0], expected.mean(0), atol=error * largest)
    np.testing.assert_allclose(covariance(found), np.cov(expected.T), atol=3 * error * largest**2)
    assert found.is_surfels == surfel and found.usable.all()


@given(seeds, st.floats(0.05, 0.95))
def test_parts_draw_no_more_than_the_whole(seed: int, share: float) -> None:
    whole, towards = one(seed)
    parts = truncated(whole, towards, np.array([share])), truncated(whole, -towards, np.array([1 - share]))

    def mass(gaussians: Gaussians) -> float:
        return float(gaussians.opacity[0] * np.exp(gaussians.log_scales[0].astype(np.float64).sum()))

    assert max(p.opacity[0] for p in parts) <= whole.opacity[0] + 1e-6
    assert 0.9 < sum(mass(p) for p in parts) / mass(whole) < 1 + 1e-4
    middle = sum(p.means * s for p, s in zip(parts, (1 - share, share)))
    np.testing.assert_allclose(middle, whole.means, atol=1e-4 * np.exp(whole.log_scales.max()))


def test_values_stay_finite() -> None:
    whole, towards = one(3)
    flat = replace(whole, log_scales=np.array([[-2, -2, -30]], np.float32))
    part = truncated(flat, np.array([[1.0, 0, 0]]), HALF)
    assert -31 < part.log_scales[0].min() < -15
    for logit in (-1e4, -40.0, 40.0, 1e4):
        solid = replace(whole, opacity_logits=np.full(1, logit, np.float32))
        found = [truncated(solid, towards, np.array([share])).opacity_logits[0] for share in (0.1, 0.5)]
        assert np.isfinite(found).all() and max(found) <= logit + 1e-3
        assert found[0] == pytest.approx(logit)  # the larger part is as dense as the whole


def astride(surfels: bool = False) -> Gaussians:
    """A floor of discs, and a large one over x = 0, the last."""
    xy = np.stack(np.meshgrid(*[np.linspace(-1, 1, 21)] * 2), -1).reshape(-1, 2)
    places = np.concatenate([np.pad(xy, ((0, 0), (0, 1))), [[0.0, 0, 0.02]]])
    found = discs(places, (0, 0, 1), np.full((len(places), 3), 0.5), 0.05)
    log_scales = found.log_scales.copy()
    log_scales[-1, :2] = np.log(0.25)
    return replace(found, log_scales=log_scales[:, : 2 if surfels else 3])


def right_of(border: float) -> list[tuple[Camera, np.ndarray]]:
    """Photos that show what is beside the object at x > border, on the floor."""
    shown = []
    for camera in EYES:
        ys, xs = np.mgrid[0.5 : camera.height, 0.5 : camera.width]
        rays = np.stack([(xs - camera.cx) / camera.fx, (ys - camera.cy) / camera.fy, np.ones_like(xs)], -1)
        rays = rays @ camera.viewmat[:3, :3]
        with np.errstate(divide="ignore"):
            x = camera.centre[0] - rays[..., 0] * camera.centre[2] / rays[..., 2]
        shown.append((camera, (rays[..., 2] < 0) & (x > border)))
    return shown


def share_of(gaussians: Gaussians, row: int, photos: list[tuple[Camera, np.ndarray]]) -> float:
    """Of what is drawn of a row, what shows beside the object."""
    chosen = np.arange(len(gaussians)) == row
    drawn = [(footprint(gaussians, c, chosen), beside) for c, beside in photos]
    return sum(float(w[b].sum()) for w, b in drawn) / sum(float(w.sum()) for w, _ in drawn)


@pytest.mark.parametrize("surfels", [False, True])
@pytest.mark.parametrize("border", [-0.12, 0.0])
def test_parts_lie_on_their_own_side_of_the_outline(surfels: bool, border: float) -> None:
    scene, photos = astride(surfels), right_of(border)
    row = len(scene) - 1
    before = share_of(scene, row, photos)
    rest, part = split_at_outline(scene.take(np.array([row])), np.array([1 - before]), photos)
    assert rest.means[0, 0] > 0.05 and part.means[0, 0] < -0.1
    assert np.abs(rest.means[0, 1:] - [0, 0.02]).max() < 0.03 > np.abs(part.means[0, 1:] - [0, 0.02]).max()
    halves = scene.with_rows(np.array([row]), rest).extended(part)
    assert share_of(halves, row, photos) > max(0.85, before) and share_of(halves, row + 1, photos) < 0.3
    normal = quats_to_matrices(rest.quats)[0][:, 2]
    assert abs(normal[2]) > 0.99  # as flat as it was


@pytest.mark.parametrize("logit", [4.0, -2.0])
def test_a_pair_draws_about_what_the_whole_drew(logit: float) -> None:
    lone = astride().take(np.array([-1]))
    lone = replace(lone, opacity_logits=np.full(1, logit, np.float32))
    rest, part = split_at_outline(lone, HALF, right_of(0.0))
    for camera in EYES:
        was = footprint(lone, camera, np.ones(1, bool))
        now = footprint(rest.extended(part), camera, np.ones(2, bool))
        assert np.abs(was - now).sum() < 0.3 * was.sum() and 0.95 < now.sum() / was.sum() < 1.05


def test_rows_that_no_photo_shows_stay_where_they_are() -> None:
    lone = astride().take(np.array([-1]))
    nowhere = [(c, np.zeros_like(b)) for c, b in right_of(0.0)]
    for photos in (nowhere, []):
        for part in split_at_outline(lone, HALF, photos):
            np.testing.assert_allclose(part.means, lone.means, atol=1e-6)
            assert part.usable.all()
