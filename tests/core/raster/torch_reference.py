"""A differentiable rasteriser: float64 torch, every pixel × every Gaussian, autograd does the gradients.

The forward formulas are those of brute_force.py (EWA splatting: Zwicker 2001, Kerbl 2023) and, for surfels, the
exact ray–plane intersection of 2DGS (Huang 2024). Nothing is tuned for speed: this is what tests compare with.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import pi, sqrt
from typing import Any

import torch
from torch import Tensor

from gimp3d.camera import Camera

NOTHING = 1e-6  # accumulated weight, or length of a summed normal, that counts as none
EDGE_ON = 1e-6  # |cosine| between a surfel's normal and the line to its centre below which rays miss the plane
DOUBT = 1e-5  # relative distance from a threshold within which float32 may decide otherwise
DOUBT_ALPHA_MIN = 1e-4  # the same for alpha_min: small alphas come from large exponents
DOUBT_RHO = 1e-8  # squared σ; at a surfel's very centre both of its distances are zero but for rounding


@dataclass(frozen=True)
class Pictures:
    """What the formulas say, float64; everything but `doubtful` carries gradients."""

    rgb: Tensor  # [H, W, 3]
    alpha: Tensor  # [H, W]
    expected_depth: Tensor  # [H, W]
    median_depth: Tensor  # [H, W]
    normals: Tensor  # [H, W, 3]
    doubtful: Tensor  # [H, W] bool: some decision is within rounding of its threshold
    weights: Tensor  # [H, W, N] blend weights


def draw(
    means: Tensor,  # [N, 3]
    log_scales: Tensor,  # [N, 3], or [N, 2] for surfels
    quats: Tensor,  # [N, 4] wxyz
    opacity_logits: Tensor,  # [N]
    sh: Tensor,  # [N, K, 3]
    camera: Camera,
    settings: Any,  # like RasterSettings; `stop` is not read
    antialiased: bool = False,  # only for 3D Gaussians
    used: Tensor | None = None,  # [H, W, N] bool: the (pixel, Gaussian) pairs that may count
) -> Pictures:
    """Draw usable Gaussians; rows whose centre is nearer than `near` get zero weight and zero gradient."""
    rotation, shift, eye = (torch.as_tensor(v, dtype=torch.float64) for v in (camera.R, camera.t, camera.centre))
    every_z = (means @ rotation.T + shift)[:, 2].detach()
    order = torch.argsort(every_z.float(), stable=True)  # float32, so that ties are those of the fast rasteriser
    order = order[every_z[order] >= settings.near]

    centres = means[order] @ rotation.T + shift
    axes = rotation @ rotation_matrices(quats[order])
    scales, opacity = log_scales[order].exp(), opacity_logits[order].sigmoid()
    pixels = torch.as_tensor(camera.pixel_centres())[:, :, None]  # [H, W, 1, 2]
    if log_scales.shape[1] == 2:
        rho, depth, doubt = _surfels(centres, axes, scales, pixels, camera, settings)
        normals = axes[:, :, 2]
    else:
        rho, compensation = _ellipses(centres, axes, scales, pixels, camera, settings.low_pass)
        depth, doubt = centres[:, 2].expand_as(rho), torch.zeros_like(rho, dtype=torch.bool)
        if antialiased:
            opacity = opacity * compensation
        flattest = scales.detach().argmin(1)
        normals = axes[torch.arange(len(order)), :, flattest]
    normals = torch.where((normals * centres).sum(1, keepdim=True) > 0, -normals, normals)

    raw = opacity * torch.exp(-0.5 * rho)
    counted = torch.ones_like(raw, dtype=torch.bool) if used is None else used[:, :, order]
    alpha = torch.where(counted & (raw > settings.alpha_min), raw.clamp(max=settings.alpha_max), 0.0)
    signed = 0.5 + torch.einsum("nk,nkc->nc", sh_basis(means[order] - eye, sh.shape[1]), sh[order])
    colours = signed.clamp(min=0)
    doubt = counted & doubt
    doubt |= (alpha > 0) & (signed.abs() < DOUBT).any(1)  # where the colour's gradient stops
    doubt |= counted & ((raw - settings.alpha_min).abs() < DOUBT_ALPHA_MIN * settings.alpha_min)
    doubt |= counted & ((raw - settings.alpha_max).abs() < DOUBT * settings.alpha_max)

    # transmittance before each Gaussian, and at last behind all
    unhindered = torch.ones(camera.height, camera.width, 1, dtype=torch.float64)
    light = torch.cumprod(torch.cat([unhindered, 1 - alpha], -1), -1)
    before, after = light[..., :-1], light[..., 1:]
    doubt |= (alpha > 0) & ((after - 0.5).abs() < DOUBT)
    weights = alpha * before
    total = weights.sum(-1)
    background = torch.tensor(settings.background, dtype=torch.float64)
    something = total > NOTHING
    mean_depth = (weights * depth).sum(-1) / torch.where(something, total, 1.0)
    normal_sum = weights @ normals
    clear = ((normal_sum**2).sum(-1, keepdim=True) > NOTHING**2).expand_as(normal_sum)
    unit = torch.nn.functional.normalize(torch.where(clear, normal_sum, 1.0), dim=-1)
    return Pictures(
        rgb=weights @ colours + light[..., -1:] * background,
        alpha=total,
        expected_depth=torch.where(something, mean_depth, 0.0),
        median_depth=torch.where((before > 0.5) & (after <= 0.5), depth, 0.0).sum(-1),
        normals=torch.where(clear, unit, 0.0),
        doubtful=doubt.any(-1),
        weights=torch.zeros(*weights.shape[:2], len(means), dtype=torch.float64).index_copy(2, order, weights),
    )


def rotation_matrices(
    quats: Tensor,  # [N, 4] wxyz, any norm > 0
) -> Tensor:
    """Rotation matrices [N, 3, 3] whose columns are the local axes: R = 1 + 2 w [v]× + 2 [v]×² for unit (w, v)."""
    w, x, y, z = (quats / quats.norm(dim=1, keepdim=True)).unbind(1)
    zero = torch.zeros_like(w)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], 1).reshape(-1, 3, 3)
    return torch.eye(3, dtype=quats.dtype) + 2 * w[:, None, None] * cross + 2 * cross @ cross


def sh_basis(
    towards: Tensor,  # [N, 3] from the camera to the Gaussians, any length > 0
    bands: int,  # 1, 4, 9 or 16
) -> Tensor:
    """Real spherical harmonics with the Condon–Shortley phase, degree by degree, order −l … l, [N, bands]."""
    x, y, z = (towards / towards.norm(dim=1, keepdim=True)).unbind(1)
    columns = [torch.full_like(x, sqrt(1 / (4 * pi)))]
    columns += [sqrt(3 / (4 * pi)) * v for v in (-y, z, -x)]
    columns += [sqrt(15 / (4 * pi)) * x * y, -sqrt(15 / (4 * pi)) * y * z]
    columns += [sqrt(5 / (16 * pi)) * (3 * z * z - 1)]
    columns += [-sqrt(15 / (4 * pi)) * x * z, sqrt(15 / (16 * pi)) * (x * x - y * y)]
    columns += [-sqrt(35 / (32 * pi)) * y * (3 * x * x - y * y), sqrt(105 / (4 * pi)) * x * y * z]
    columns += [-sqrt(21 / (32 * pi)) * y * (5 * z * z - 1), sqrt(7 / (16 * pi)) * z * (5 * z * z - 3)]
    columns += [-sqrt(21 / (32 * pi)) * x * (5 * z * z - 1), sqrt(105 / (16 * pi)) * z * (x * x - y * y)]
    columns += [-sqrt(35 / (32 * pi)) * x * (x * x - 3 * y * y)]
    return torch.stack(columns[:bands], 1)


def _project(
    centres: Tensor,  # [M, 3] camera axes
    camera: Camera,
) -> Tensor:
    """Pixel coordinates, [M, 2]."""
    focal = torch.tensor([camera.fx, camera.fy], dtype=torch.float64)
    return centres[:, :2] / centres[:, 2:] * focal + torch.tensor([camera.cx, camera.cy], dtype=torch.float64)


def _ellipses(
    centres: Tensor,  # [M, 3] camera axes
    axes: Tensor,  # [M, 3, 3] columns, camera axes
    scales: Tensor,  # [M, 3]
    pixels: Tensor,  # [H, W, 1, 2]
    camera: Camera,
    low_pass: float,
) -> tuple[Tensor, Tensor]:
    """Squared Mahalanobis distances [H, W, M], and what antialiasing multiplies the opacity by, [M]."""
    size = torch.tensor([camera.width, camera.height], dtype=torch.float64)
    focal = torch.tensor([camera.fx, camera.fy], dtype=torch.float64)
    principal = torch.tensor([camera.cx, camera.cy], dtype=torch.float64)
    low, high = (-principal - 0.15 * size) / focal, (size - principal + 0.15 * size) / focal
    tangent = (centres[:, :2] / centres[:, 2:]).clamp(low, high)
    jacobian = torch.cat([torch.eye(2, dtype=torch.float64).expand(len(centres), 2, 2), -tangent[:, :, None]], 2)
    jacobian = jacobian * focal[:, None] / centres[:, 2, None, None]
    halves = jacobian @ axes * scales[:, None]  # [M, 2, 3], J W Q S
    covariance = halves @ halves.mT + low_pass * torch.eye(2, dtype=torch.float64)
    offset = pixels - _project(centres, camera)
    power = torch.einsum("hwmi,mij,hwmj->hwm", offset, torch.linalg.inv(covariance), offset)
    # det(A Aᵀ) = |a × b|² for the two rows of A: unlike the determinant's, this square root is smooth for needles
    sharp = torch.linalg.cross(halves[:, 0], halves[:, 1]).norm(dim=1)
    return power, sharp / torch.linalg.det(covariance).sqrt()


def _surfels(
    centres: Tensor,  # [M, 3] camera axes
    axes: Tensor,  # [M, 3, 3] columns t_u, t_v, n, camera axes
    scales: Tensor,  # [M, 2]
    pixels: Tensor,  # [H, W, 1, 2]
    camera: Camera,
    settings: Any,
) -> tuple[Tensor, Tensor, Tensor]:
    """Squared distances in σ, depths, and where these hang on rounding, each [H, W, M] (Huang 2024, eq. 8–11).

    A surfel counts as at least a blob of √surfel_low_pass px around its projected centre, at the centre's depth.
    """
    focal = torch.tensor([camera.fx, camera.fy], dtype=torch.float64)
    principal = torch.tensor([camera.cx, camera.cy], dtype=torch.float64)
    ray = torch.nn.functional.pad((pixels - principal) / focal, (0, 1), value=1.0)  # [H, W, 1, 3]
    normals = axes[:, :, 2]
    height = (normals * centres).sum(1)  # of the plane over the camera's centre, signed
    slope = (ray * normals).sum(-1)
    meets = (slope * height.sign() > 0) & (height.abs() >= EDGE_ON * centres.norm(dim=1))
    z_ray = height / torch.where(meets, slope, 1.0)  # no division by zero, whose gradient would be NaN
    doubt = meets & ((z_ray - settings.near).abs() < DOUBT * settings.near)
    meets = meets & (z_ray >= settings.near)
    within = z_ray[..., None] * ray - centres
    rho_plane = (((within[..., None] * axes[:, :, :2]).sum(-2) / scales) ** 2).sum(-1)
    rho_image = ((pixels - _project(centres, camera)) ** 2).sum(-1) / settings.surfel_low_pass
    on_plane = meets & (rho_plane <= rho_image)
    doubt |= meets & ((rho_plane - rho_image).abs() < DOUBT * rho_image + DOUBT_RHO)
    rho = torch.where(on_plane, rho_plane, rho_image)
    return rho, torch.where(on_plane, z_ray, centres[:, 2]), doubt
