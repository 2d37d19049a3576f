"""New Gaussians from the completed reference, and their colours from every view (paper supplementary, METHOD 6)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..camera import Camera
from ..gaussians import SH_C0, Gaussians, matrices_to_quats, pad_sh
from ..solvers.harmonics import HarmonicsSettings, fit_harmonics, gather_observations
from ..threads import parallel_map
from .masks import sees
from .propagate import Loader, PaintedView, Rule
from .reference import surface_normals


@dataclass(frozen=True)
class SeedSettings:
    """How a pixel of the completed reference becomes a Gaussian."""

    spread: float = 0.6  # tangential standard deviation in pixel footprints
    maximum_slant: float = 4.0  # cap on the 1/cos θ stretch of grazing surfaces
    thickness: float = 0.1  # standard deviation along the normal, as a share of the tangential one
    opacity: float = 0.98
    sh_degree: int = 2  # the highest of new Gaussians; each gets the one that its observations support
    # Painted views err together, which leaving one out cannot see: all of them are worth few observations. And what
    # they share against the reference is mostly a shadow or an exposure that it has not.
    harmonics: HarmonicsSettings = HarmonicsSettings(floor=20.0, offset=True)
    depth_tolerance: float = 0.02  # z-test of observations


def seed_gaussians(
    camera: Camera,
    image: np.ndarray,  # [H, W, 3] uint8, the inpainted reference
    depth: np.ndarray,  # [H, W] completed z-depth
    target: np.ndarray,  # [H, W] bool, T_0
    surfels: bool,
    settings: SeedSettings = SeedSettings(),
) -> Gaussians:
    """One Gaussian per target pixel with a depth, of SH degree 0: back-projected, aligned with the surface."""
    normals = surface_normals(camera, depth)
    rows, cols = np.nonzero(target & (depth > 0) & (np.abs(normals).sum(-1) > 0))
    z = depth[rows, cols].astype(np.float64)
    uv = np.stack([cols + 0.5, rows + 0.5], -1)
    means = camera.unproject(uv, z)
    n = normals[rows, cols]
    rays = np.stack([(uv[:, 0] - camera.cx) / camera.fx, (uv[:, 1] - camera.cy) / camera.fy, np.ones(len(z))], -1)
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    cosine = np.clip(-(n * rays).sum(-1), 1 / settings.maximum_slant, 1.0)
    # the steep axis lies in the surface along the slope seen from the camera; the level axis completes the frame
    steep = rays + n * -(n * rays).sum(-1, keepdims=True)
    length = np.linalg.norm(steep, axis=-1, keepdims=True)
    helper = np.where(np.abs(n[:, :1]) < 0.9, [[1.0, 0, 0]], [[0, 1.0, 0]])
    steep = np.where(length > 1e-6, steep, helper - n * (n * helper).sum(-1, keepdims=True))
    steep /= np.linalg.norm(steep, axis=-1, keepdims=True)
    level = np.cross(n, steep)
    frame = np.stack([steep, level, n], -1)  # columns: local axes in the camera
    footprint = settings.spread * z / np.sqrt(camera.fx * camera.fy)
    scales = np.stack([footprint / cosine, footprint, settings.thickness * footprint], -1)
    colours = image[rows, cols] / 255.0
    return Gaussians(
        means=means.astype(np.float32),
        log_scales=np.log(scales[:, : 2 if surfels else 3]).astype(np.float32),
        quats=matrices_to_quats(camera.R.T @ frame).astype(np.float32),
        opacity_logits=np.full(len(z), np.log(settings.opacity / (1 - settings.opacity)), np.float32),
        sh=((colours - 0.5) / SH_C0)[:, None].astype(np.float32),
    )


def colour_gaussians(
    seeds: Gaussians,
    reference: Camera,
    views: Sequence[Loader],
    painted: Sequence[PaintedView],
    scene_degree: int,
    settings: SeedSettings = SeedSettings(),
) -> Gaussians:
    """The seeds with view-dependent colour fitted to the painted views; c_0 stays what the reference shows."""
    degree, bands = min(settings.sh_degree, scene_degree), (scene_degree + 1) ** 2
    if degree == 0:
        return replace(seeds, sh=pad_sh(seeds.sh, bands))
    means = seeds.means.astype(np.float64)
    seen = parallel_map(lambda pair: _seen_in(means, *pair, settings.depth_tolerance), zip(views, painted))
    colours = 0.5 + SH_C0 * seeds.sh[:, 0].astype(np.float64)
    observations = gather_observations(len(seeds), seen)
    fit = fit_harmonics(colours, _towards(means, reference), observations, degree, settings.harmonics)
    return replace(seeds, sh=pad_sh(fit.sh, bands))


def _seen_in(
    means: np.ndarray, load: Loader, paint: PaintedView, tolerance: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rows of the seeds that a painted view shows by pixels of its own, the directions to them, and their colours."""
    view = load()
    visible = np.flatnonzero(sees(view.camera, view.depth_new, means, tolerance))
    uv, _ = view.camera.project(means[visible])
    cols, rows = uv.astype(int).T
    rules = paint.rule_map(view.camera.height, view.camera.width)
    own = np.isin(rules[rows, cols], (Rule.EVIDENCE, Rule.OWN_PIXELS, Rule.RETARGETED))
    index = visible[own]
    colours = paint.image[rows[own] - paint.top, cols[own] - paint.left] / 255.0
    return index, _towards(means[index], view.camera), colours


def _towards(means: np.ndarray, camera: Camera) -> np.ndarray:
    """Unit directions from the camera to the points."""
    towards = means - camera.centre
    return towards / np.linalg.norm(towards, axis=-1, keepdims=True)
