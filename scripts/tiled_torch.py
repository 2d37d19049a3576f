"""Gaussians drawn by plain vectorised torch, 16×16 tiles in a Python loop: what the rasteriser's speed is held against.

The conventions are those of tests/core/raster/brute_force.py, but a Gaussian is looked at only in the tiles that its
ellipse can reach. autograd makes the gradients; tiles are checkpointed, so that only one at a time is held.
"""

from __future__ import annotations

from math import pi, sqrt

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from gimp3d.camera import Camera
from gimp3d.raster import RasterSettings

TILE = 16  # px
NOTHING = 1e-6  # accumulated weight that counts as none
# Columns of the features: image position, inverse covariance, opacity, then what is blended
X, Y, XX, XY, YY, OPACITY, BLENDED = range(7)


def draw(
    means: Tensor,  # [N, 3]
    log_scales: Tensor,  # [N, 3]
    quats: Tensor,  # [N, 4] wxyz
    opacity_logits: Tensor,  # [N]
    sh: Tensor,  # [N, 16, 3]
    camera: Camera,
    settings: RasterSettings = RasterSettings(),
) -> tuple[Tensor, Tensor, Tensor]:
    """rgb [H, W, 3] on black, alpha [H, W] and expected depth [H, W]."""
    features, reach = project(means, log_scales, quats, opacity_logits, sh, camera, settings)
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


def project(
    means: Tensor,
    log_scales: Tensor,
    quats: Tensor,
    opacity_logits: Tensor,
    sh: Tensor,
    camera: Camera,
    settings: RasterSettings,
) -> tuple[Tensor, Tensor]:
    """Features [N, 10], and how far from its centre each Gaussian is above alpha_min, [N, 2] px (EWA splatting)."""
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
    colours = (0.5 + (sh_basis(means - eye)[:, :, None] * sh).sum(1)).clamp(min=0)
    features = torch.cat([torch.stack(columns, 1), colours, z], 1)
    with torch.no_grad():
        squared_radius = 2 * (opacity / settings.alpha_min).log().clamp(min=0)
        reach = (squared_radius[:, None] * (torch.stack([uu, vv], 1) + low_pass)).sqrt()
    return features, reach


def rotation_matrices(quats: Tensor) -> Tensor:
    """Rotation matrices [N, 3, 3]: R = 1 + 2 w [v]× + 2 [v]×² for unit (w, v)."""
    w, x, y, z = (quats / quats.norm(dim=1, keepdim=True)).unbind(1)
    zero = torch.zeros_like(w)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], 1).reshape(-1, 3, 3)
    return torch.eye(3) + 2 * w[:, None, None] * cross + 2 * cross @ cross


def sh_basis(towards: Tensor) -> Tensor:
    """Real spherical harmonics up to degree 3 with the Condon–Shortley phase, [N, 16]."""
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
    return torch.stack(columns, 1)


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
