"""Gaussians that are both the object's and its surroundings', split at its outline.

Where the object stands on the floor, trainers fit splats that reach from one to the other. Kept they are stains, taken
they leave holes in what photos show. docs/method.md, "Where views are filled".
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.special import ndtri

from ..camera import Camera
from ..gaussians import Gaussians, matrices_to_quats, quats_to_matrices
from ..geometry import framed
from .witness import total_over


def split_at_outline(
    gaussians: Gaussians,  # finite
    share: np.ndarray,  # [M] of each, that is the object's, within 0 … 1
    photos: Sequence[tuple[Camera, np.ndarray]],  # and where each shows what is beside the object, [H, W] bool
) -> tuple[Gaussians, Gaussians]:
    """What of Gaussians is beside the object, and what is the object's; [M] each.

    The plane between is met where more photos show one end of an axis beside the object than show the other end there.
    """
    ends = gaussians.means + np.stack([1, -1])[:, None, None] * _axes(gaussians).transpose(2, 0, 1)[:, None]

    def beside(photo: tuple[Camera, np.ndarray]) -> np.ndarray:
        camera, shown = photo
        index, rows, cols, _ = framed(camera, ends.reshape(-1, 3))
        found = np.zeros(len(ends.reshape(-1, 3)))
        found[index] = shown[rows, cols]
        return found.reshape(ends.shape[:-1])

    plus, minus = total_over(photos, beside, ends.shape[:-1]).transpose(1, 2, 0)
    off = (plus - minus) / np.maximum(np.linalg.norm(plus - minus, axis=1, keepdims=True), 1)
    return truncated(gaussians, off, share), truncated(gaussians, -off, 1 - share)


def truncated(gaussians: Gaussians, towards: np.ndarray, share: np.ndarray) -> Gaussians:
    """What is left of Gaussians, as Gaussians, if a plane cuts a share [M] off each, on the side that is away from
    `towards` [M, 3]: unit vectors along the local axes, in standard deviations.

    Mean and variance across the plane are those of the truncated normal distribution (Johnson, Kotz and Balakrishnan
    1994, 10.1); the opacity keeps the mass.
    """
    at = ndtri(share)
    ahead = np.exp(-(at**2) / 2) / np.sqrt(2 * np.pi) / (1 - share)
    spread = 1 + at * ahead - ahead**2
    axes = _axes(gaussians)
    along = (axes @ towards[..., None])[..., 0]
    covariance = axes @ axes.transpose(0, 2, 1) - (1 - spread)[:, None, None] * along[:, :, None] * along[:, None]
    values, vectors = np.linalg.eigh(covariance)
    values, vectors = values[:, ::-1], vectors[..., ::-1]  # a surfel's normal is the last axis
    vectors = vectors * np.where(np.linalg.det(vectors) < 0, -1.0, 1.0)[:, None, None]
    mass = np.minimum(1, (1 - share) / np.sqrt(spread))
    least = spread[:, None] * np.exp(2 * gaussians.log_scales.min(1, keepdims=True).astype(np.float64))
    scales = np.log(np.maximum(values[:, : gaussians.log_scales.shape[1]], least)) / 2
    with np.errstate(divide="ignore"):  # the logit of mass times the opacity
        logits = np.log(mass) - np.logaddexp(np.log1p(-mass), -gaussians.opacity_logits.astype(np.float64))
    return replace(
        gaussians,
        means=(gaussians.means + ahead[:, None] * along).astype(gaussians.means.dtype),
        log_scales=scales.astype(np.float32),
        quats=matrices_to_quats(vectors).astype(np.float32),
        opacity_logits=logits.astype(np.float32),
    )


def _axes(gaussians: Gaussians) -> np.ndarray:
    """[M, 3, 3] float64: columns are the local axes, a standard deviation long; a surfel's third is 0."""
    scales = np.exp(gaussians.log_scales.astype(np.float64))
    scales = np.pad(scales, ((0, 0), (0, 3 - scales.shape[1])))
    return quats_to_matrices(gaussians.quats.astype(np.float64)) * scales[:, None]
