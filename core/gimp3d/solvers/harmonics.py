"""The paper's fit of real spherical harmonics, as 3DGS uses them, to colours seen from several directions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..gaussians import SH_C0, sh_basis
from .robust import MAD

COLLINEAR = 1e-3  # least ratio of the variances of the directions across and along their main axis
SAME = 2e-5  # mean squared distance of directions from their own: below it (0.3°), they are one
LEAST_SIGMA = 1.0 / 255  # of 8-bit colours
LEAST_RIDGE = 1e-6  # observations: without any, few directions leave the equations singular

Seen = tuple[np.ndarray, np.ndarray, np.ndarray]  # a view's rows [m], none twice; directions and colours [m, 3]


@dataclass(frozen=True)
class HarmonicsSettings:
    """How the paper's fit is read."""

    anchored: bool = True  # the basis is Y(ω) − Y(ω_0); False: Y(ω), as printed, which misses c_0 in ω_0 itself
    ridge: float = 1e-3  # observations; colours of few directions are held to the reference's against their own


def fit_harmonics(
    anchors: np.ndarray,  # [N, 3] colours c_0 that must be reproduced in the reference direction
    anchor_directions: np.ndarray,  # [N, 3] unit ω_0, from the camera to the point
    views: Sequence[Seen],
    degree: int,
    settings: HarmonicsSettings = HarmonicsSettings(),
) -> np.ndarray:
    """The paper's fit of real spherical harmonics: coefficients [N, (degree + 1)², 3] float32, as 3DGS stores them.

    Weighted least squares on the residuals c_ω − c_0 in the basis Y_k(ω) − Y_k(ω_0), so that the reference's colour c_0
    comes out exactly in its own direction ω_0 (supplement, equations 10 to 12; docs/method.md). c_0 alone for Gaussians
    that nobody saw, and where the directions, seen along ω_0, do not span a patch of the sphere: one view, duplicates,
    a line.
    """
    bands = (degree + 1) ** 2 - 1
    at_anchor = sh_basis(anchor_directions, degree)[:, 1:]
    sizes = [np.linalg.norm(colours - anchors[rows], axis=1) for rows, _, colours in views]
    sigma = max(LEAST_SIGMA, MAD * float(np.median(np.concatenate(sizes)))) if sum(map(len, sizes)) else LEAST_SIGMA
    total, scatter = np.zeros(len(anchors)), np.zeros((len(anchors), 3, 3))
    matrix, right = np.zeros((len(anchors), bands, bands)), np.zeros((len(anchors), bands, 3))
    for (rows, towards, colours), size in zip(views, sizes):
        ahead = anchor_directions[rows]
        basis = sh_basis(towards, degree)[:, 1:] - (at_anchor[rows] if settings.anchored else 0.0)
        # The paper's e_ω; |ω − ω_0|² = 2 (1 − ω·ω_0).
        apart = ((towards - ahead) ** 2).sum(1)
        weight = np.exp(-0.5 * (size / sigma) ** 2 * np.exp(-apart))[:, None, None]
        across = towards - (towards * ahead).sum(1, keepdims=True) * ahead
        total[rows] += weight[:, 0, 0]
        scatter[rows] += weight * across[:, :, None] * across[:, None]
        matrix[rows] += weight * basis[:, :, None] * basis[:, None]
        right[rows] += weight * basis[:, :, None] * (colours - anchors[rows])[:, None]
    spread = np.linalg.eigvalsh(scatter)  # one is 0, along ω_0
    posed = (spread[:, 1] > COLLINEAR * spread[:, 2]) & (spread[:, 2] > SAME * total)
    found = np.linalg.solve(matrix + max(settings.ridge, LEAST_RIDGE) * np.eye(bands), right) * posed[:, None, None]
    level = anchors - 0.5
    if settings.anchored:
        level = level - np.einsum("nk,nkc->nc", at_anchor, found)
    return np.concatenate([level[:, None] / SH_C0, found], axis=1).astype(np.float32)
