"""An independent rasteriser: float64 NumPy, every pixel × every Gaussian, straight from the formulas."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gimp3d.camera import Camera
from gimp3d.gaussians import Gaussians, quats_to_matrices
from gimp3d.raster import RasterSettings

DEFAULT = RasterSettings()


@dataclass(frozen=True)
class Reference:
    """What the formulas say; weights are per Gaussian."""

    rgb: np.ndarray  # [H, W, 3]
    alpha: np.ndarray  # [H, W]
    expected_depth: np.ndarray  # [H, W]
    median_depth: np.ndarray  # [H, W]
    normals: np.ndarray  # [H, W, 3]
    weights: np.ndarray  # [N, H, W] blend weights
    doubtful: np.ndarray  # [H, W] bool: some alpha or transmittance is within rounding of a threshold


def sh_basis(
    d: np.ndarray,  # [N, 3] unit
) -> np.ndarray:
    """Real spherical harmonics up to degree 3 from their definition by Legendre polynomials, [N, 16].

    Built from scipy's associated Legendre functions rather than copied from 3DGS, so that a slip in one of
    the sixteen hand-written terms shows. 3DGS keeps the Condon–Shortley phase: Y_1 = (−y, z, −x).
    """
    from math import factorial, pi

    from scipy.special import lpmv

    azimuth = np.arctan2(d[:, 1], d[:, 0])
    columns = []
    for degree in range(4):
        for order in range(-degree, degree + 1):
            m = abs(order)
            norm = np.sqrt((2 * degree + 1) / (4 * pi) * factorial(degree - m) / factorial(degree + m))
            legendre = norm * lpmv(m, degree, d[:, 2])  # includes (−1)^m
            if order == 0:
                columns.append(legendre)
            else:
                wave = np.cos(m * azimuth) if order > 0 else np.sin(m * azimuth)
                columns.append(np.sqrt(2) * legendre * wave)
    return np.stack(columns, 1)


def draw(gaussians: Gaussians, camera: Camera, settings: RasterSettings = DEFAULT) -> Reference:
    """Draw the usable Gaussians; unusable ones get zero weight."""
    n, h, w = len(gaussians), camera.height, camera.width
    means = gaussians.means.astype(np.float64)
    scales = np.exp(gaussians.log_scales.astype(np.float64))
    if gaussians.is_surfels:
        scales = np.concatenate([scales, np.zeros((n, 1))], 1)
    axes = quats_to_matrices(gaussians.quats.astype(np.float64))
    with np.errstate(over="ignore"):
        opacity = 1 / (1 + np.exp(-gaussians.opacity_logits.astype(np.float64)))
    points = camera.to_camera(means)
    x, y, z = points.T

    margin = 0.15 * np.array([w, h])  # gsplat: 0.3 × tan(half fov) beyond either edge
    low = (-np.array([camera.cx, camera.cy]) - margin) / (camera.fx, camera.fy)
    high = (np.array([w - camera.cx, h - camera.cy]) + margin) / (camera.fx, camera.fy)
    tx, ty = np.clip(points[:, :2] / z[:, None], low, high).T * z
    zero = np.zeros(n)
    jacobian = np.stack(
        [
            np.stack([camera.fx / z, zero, -camera.fx * tx / z**2], -1),
            np.stack([zero, camera.fy / z, -camera.fy * ty / z**2], -1),
        ],
        1,
    )
    world = np.einsum("nij,nj,nkj->nik", axes, scales**2, axes)
    view = jacobian @ camera.R
    sharp = view @ world @ view.transpose(0, 2, 1)
    covariance = sharp + settings.low_pass * np.eye(2)
    if gaussians.antialiased:
        ratio = np.linalg.det(sharp) / np.linalg.det(covariance)
        opacity = opacity * np.sqrt(np.maximum(ratio, 0))

    centres = np.stack([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy], -1)
    direction = means - camera.centre
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    bands = gaussians.sh.shape[1]
    colours = np.einsum("nk,nkc->nc", sh_basis(direction)[:, :bands], gaussians.sh.astype(np.float64))
    colours = np.maximum(colours + 0.5, 0)
    normals = np.take_along_axis(axes, scales.argmin(1)[:, None, None], 2)[..., 0] @ camera.R.T
    normals *= np.where((normals * points).sum(1) > 0, -1.0, 1.0)[:, None]

    rgb, normal_sum = np.zeros((h, w, 3)), np.zeros((h, w, 3))
    depth_sum, median, weight_sum = np.zeros((3, h, w))
    transmittance = np.ones((h, w))
    weights, doubtful = np.zeros((n, h, w)), np.zeros((h, w), bool)
    for i in np.argsort(z.astype(np.float32), kind="stable"):
        if not z[i] >= settings.near:
            continue
        offset = camera.pixel_centres() - centres[i]
        power = np.einsum("hwi,ij,hwj->hw", offset, np.linalg.inv(covariance[i]), offset)
        alpha = opacity[i] * np.exp(-0.5 * power)
        doubtful |= abs(alpha - settings.alpha_min) < 1e-4 * settings.alpha_min
        alpha = np.where(alpha > settings.alpha_min, np.minimum(alpha, settings.alpha_max), 0)
        weights[i] = alpha * transmittance
        after = transmittance * (1 - alpha)
        median = np.where((transmittance > 0.5) & (after <= 0.5), z[i], median)
        doubtful |= abs(after - 0.5) < 1e-5
        transmittance = after
        rgb += weights[i][..., None] * colours[i]
        normal_sum += weights[i][..., None] * normals[i]
        depth_sum += weights[i] * z[i]
        weight_sum += weights[i]
    rgb += transmittance[..., None] * np.asarray(settings.background)
    expected = np.divide(depth_sum, weight_sum, out=np.zeros((h, w)), where=weight_sum > 0)
    length = np.linalg.norm(normal_sum, axis=-1, keepdims=True)
    unit = np.divide(normal_sum, length, out=np.zeros((h, w, 3)), where=length > 0)
    return Reference(rgb, weight_sum, expected, median, unit, weights, doubtful)
