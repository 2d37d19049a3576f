"""Gaussians drawn by plain vectorised torch, 16×16 tiles in a Python loop: what the rasteriser's speed is held against.

The conventions are those of tests/core/raster/torch_reference.py, but a Gaussian is looked at only in the tiles that
its ellipse can reach. autograd makes the gradients; tiles are checkpointed, so that only one at a time is held.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint
from torch_reference import rotation_matrices, sh_basis

from gimp3d.camera import Camera
from gimp3d.raster import RasterSettings

TILE = 16  # px
NOTHING = 1e-6  # accumulated weight that counts as none
# Columns of the features: image position, inverse covariance, opacity, then what is blended
X, Y, XX, XY, YY, OPACITY, BLENDED = range(7)


def draw(parameters: Sequence[Tensor], camera: Camera) -> tuple[Tensor, Tensor, Tensor]:
    """rgb [H, W, 3] on black, alpha [H, W] and expected depth [H, W] of means [N, 3], log scales [N, 3], quaternions
    [N, 4] wxyz, opacity logits [N] and SH coefficients [N, 16, 3]."""
    settings = RasterSettings()
    features, reach = project(parameters, camera, settings)
    across, down = -(-camera.width // TILE), -(-camera.height // TILE)
    entries, counts = tile_entries(features.detach(), reach, across, down, settings)
    v, u = torch.meshgrid(torch.arange(TILE) + 0.5, torch.arange(TILE) + 0.5, indexing="ij")
    corner = torch.stack([u, v], -1).reshape(-1, 2)
    tiles = []
    for t, rows in enumerate(features[entries].split(counts)):
        pixels = corner + TILE * torch.tensor([t % across, t // across])
        tiles.append(checkpoint(blend, rows, pixels, settings, use_reentrant=False))
    sums = torch.stack(tiles).reshape(down, across, TILE, TILE, 5).transpose(1, 2)
    sums = sums.reshape(down * TILE, across * TILE, 5)[: camera.height, : camera.width]
    alpha = sums[..., 4]
    depth = torch.where(alpha > NOTHING, sums[..., 3] / alpha.clamp(min=NOTHING), 0.0)
    return sums[..., :3], alpha, depth


def project(parameters: Sequence[Tensor], camera: Camera, settings: RasterSettings) -> tuple[Tensor, Tensor]:
    """Features [N, 10], and how far from its centre each Gaussian is above alpha_min, [N, 2] px (EWA splatting)."""
    means, log_scales, quats, opacity_logits, sh = parameters
    rotation, shift, eye = (torch.as_tensor(v, dtype=means.dtype) for v in (camera.R, camera.t, camera.centre))
    size, focal = means.new_tensor([camera.width, camera.height]), means.new_tensor([camera.fx, camera.fy])
    principal = means.new_tensor([camera.cx, camera.cy])
    centres = means @ rotation.T + shift
    z = centres[:, 2:]
    tangent = centres[:, :2] / z
    edge = tangent.clamp((-principal - 0.15 * size) / focal, (size - principal + 0.15 * size) / focal)
    jacobian = torch.cat([torch.eye(2).expand(len(z), 2, 2), -edge[:, :, None]], 2) * (focal / z)[:, :, None]
    u, v = (jacobian @ rotation @ rotation_matrices(quats) * log_scales.exp()[:, None]).unbind(1)
    # the determinant from the rows' cross product: that of the covariance would cancel for needles
    low_pass, sharp = settings.low_pass, (torch.linalg.cross(u, v) ** 2).sum(1)
    uu, uv, vv = (u * u).sum(1), (u * v).sum(1), (v * v).sum(1)
    determinant = sharp + low_pass * (uu + vv) + low_pass**2
    opacity = opacity_logits.sigmoid()
    columns = [*(tangent * focal + principal).T, (vv + low_pass) / determinant, -uv / determinant]
    columns += [(uu + low_pass) / determinant, opacity]
    colours = (0.5 + (sh_basis(means - eye, sh.shape[1])[:, :, None] * sh).sum(1)).clamp(min=0)
    features = torch.cat([torch.stack(columns, 1), colours, z], 1)
    with torch.no_grad():
        squared_radius = 2 * (opacity / settings.alpha_min).log().clamp(min=0)
        reach = (squared_radius[:, None] * (torch.stack([uu, vv], 1) + low_pass)).sqrt()
    return features, reach


def tile_entries(
    features: Tensor, reach: Tensor, across: int, down: int, settings: RasterSettings
) -> tuple[Tensor, list[int]]:
    """Rows of features tile by tile, near to far, and how many each tile has."""
    limit, z = torch.tensor([across, down]), features[:, -1]
    first = ((features[:, :2] - reach) / TILE).floor().long().clamp(min=0)
    spans = (torch.minimum(((features[:, :2] + reach) / TILE).floor().long() + 1, limit) - first).clamp(min=0)
    drawn = (z >= settings.near) & (features[:, OPACITY] > settings.alpha_min)
    areas = spans.prod(1) * drawn
    order = torch.argsort(z, stable=True)
    rows = order.repeat_interleave(areas[order])
    place = torch.arange(len(rows)) - (areas[order].cumsum(0) - areas[order]).repeat_interleave(areas[order])
    wide = spans[rows, 0]
    tiles = (first[rows, 1] + place // wide) * across + first[rows, 0] + place % wide
    by_tile = torch.argsort(tiles, stable=True)
    return rows[by_tile], torch.bincount(tiles, minlength=across * down).tolist()


def blend(rows: Tensor, pixels: Tensor, settings: RasterSettings) -> Tensor:
    """Sums over a tile's Gaussians: rgb, z and 1, each times the blend weights, [256, 5]."""
    dx, dy = pixels[:, :1] - rows[:, X], pixels[:, 1:] - rows[:, Y]
    power = dx * (rows[:, XX] * dx + 2 * rows[:, XY] * dy) + rows[:, YY] * dy * dy
    raw = rows[:, OPACITY] * torch.exp(-0.5 * power)
    alpha = torch.where(raw > settings.alpha_min, raw.clamp(max=settings.alpha_max), 0.0)
    light = torch.cumprod(1 - alpha, 1)
    weights = alpha * torch.cat([torch.ones_like(light[:, :1]), light[:, :-1]], 1)
    return torch.cat([weights @ rows[:, BLENDED:], weights.sum(1, keepdim=True)], 1)
