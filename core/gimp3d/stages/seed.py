"""New Gaussians from the completed reference, and their colours from every view (paper, supplementary material)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np

from ..camera import Camera
from ..compute.threads import parallel_map
from ..errors import BadInput
from ..gaussians import SH_C0, Gaussians, matrices_to_quats, pad_sh, sh_basis
from ..geometry import SAME_DEPTH, bounds, cropped, directions, sees, surface_normals, window_mask
from ..raster import PictureGradients, PixelRegion, RasterSettings, contributions, pixel_region, touched_window
from ..schema import Between, Positive
from ..solvers.harmonics import HarmonicsSettings, Seen, fit_harmonics
from .propagate import PaintedView, Rule

OWN_RULES = (Rule.EVIDENCE, Rule.OWN_PIXELS, Rule.RETARGETED)  # pixels that a view's own tell the colour of
SHOWN = 0.5  # px of blend weight by which a view shows a Gaussian at all
CUT = 9.0  # of the usual miss of a view at a Gaussian (6 σ): what is missed by more is a wrong picture
LEAST_SIGMA = 0.2  # px, of a splat that stands for one pixel
BEND = 0.002  # RMS deviation from a plane, relative to the depth, above which a patch is halved: a tenth of SAME_DEPTH
MAXIMUM_SLANT = 4.0  # cap on the 1/cos θ stretch of grazing surfaces, which noise of their normals would make endless
THICKNESS = 0.1  # standard deviation along the normal, as a share of the smaller tangential one
NEEDED = 0.25  # blend weight that a Gaussian must reach in some pixel, or it is left out: 2 to 8 % of them
HOLD = 3.0  # px of blend weight by which colours, and their view dependence, are held at the closed form's
LOOKS = 12  # painted views that colours are corrected by; more gain nothing that is measured


@dataclass(frozen=True)
class SeedSettings:
    """How the completed reference becomes Gaussians."""

    spread: Positive = 0.75  # sides of a patch, σ of its splat on screen; smooth against sharp
    largest: Annotated[int, Between(1, 64)] = 4  # px, a power of two, side of a patch; fewer splats (paper: 1 px each)
    detail: float = 20.0  # squared grey levels × px that a patch may vary by; fewer splats against sharp ones
    opacity: Annotated[float, Between(0.01, 0.999)] = 0.98  # of new splats; what they hide against gradients to refine
    corrections: int = 1  # steps of least squares, 0: the fit at the centres (paper); time against seams and dark views
    sh_degree: Annotated[int, Between(0, 3)] = 2  # highest of new splats; size against gloss
    harmonics: HarmonicsSettings = HarmonicsSettings()
    grey: float = 0.5  # of white, what 3DGS adds to Σ h_k Y_k; the paper's h_0 = c_0 / Y_0 takes nothing off for it


def seed_gaussians(
    camera: Camera,
    image: np.ndarray,  # [H, W, 3] uint8, the inpainted reference
    depth: np.ndarray,  # [H, W] completed z-depth
    target: np.ndarray,  # [H, W] bool, T_0
    surfels: bool,
    settings: SeedSettings = SeedSettings(),
    nearer: bool = False,  # views may look from nearer, as at a chart
) -> Gaussians:
    """Gaussians of SH degree 0 that tile the target: large ones where colour and surface are smooth.

    The target is cut into rectangles (see `_patches`). Each becomes one Gaussian in the surface's tangent plane whose
    picture in the reference has the rectangle's shape, so that neighbours meet without cracks at any slant.

    Raises
    ------
    BadInput
        If `settings.largest` is no power of two.
    """
    size = settings.largest
    if size < 1 or size & (size - 1):
        raise BadInput(f"seed.largest: expected a power of two, got {size}")
    rows, cols = (  # squares of the picture's grid that hold the target, and one more all round
        slice(max(0, s.start // size - 1) * size, min(side, ((s.stop - 1) // size + 2) * size))
        for s, side in zip(bounds(target), target.shape)
    )
    camera, image, depth, target = cropped(camera, (rows, cols)), *(a[rows, cols] for a in (image, depth, target))
    normals = surface_normals(camera, depth)
    there = target & (depth > 0) & (np.abs(normals).sum(-1) > 0)
    z = np.where(there, depth, 1.0).astype(np.float64)
    rectangles, sums = _patches(image, np.where(there, 1 / z, 0.0), there, normals, settings)
    top, left, height, width = rectangles.T
    colours, disparity, normal = np.split(sums / (height * width)[:, None], [3, 4], axis=1)
    z = 1 / disparity
    uv = np.stack([left + width / 2, top + height / 2], -1)
    rays = np.concatenate([(uv - [camera.cx, camera.cy]) / [camera.fx, camera.fy], np.ones((len(z), 1))], -1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    # How far the plane moves for one pixel in the picture; along n·X = const, X = z·ray and z ~ 1 / (n·ray).
    towards = np.minimum((normal * rays).sum(-1), -np.linalg.norm(rays, axis=-1) / MAXIMUM_SLANT)
    steps = np.diag([1 / camera.fx, 1 / camera.fy, 0])[:2]
    slopes = normal @ steps.T / towards[:, None]
    tangents = z[..., None] * (steps[None] - slopes[..., None] * rays[:, None])  # [N, 2, 3]
    tangents -= (tangents @ normal[..., None]) * normal[:, None]
    # The rasteriser widens 3D Gaussians by its low-pass, in pixels; surfels are drawn as they are. Seen from nearer,
    # that is less than here, and cracks would open.
    low_pass = 0.0 if surfels or nearer else RasterSettings().low_pass
    sides = np.stack([width, height], -1)[..., None]
    sigma = np.sqrt(np.maximum((settings.spread * sides) ** 2 - low_pass, LEAST_SIGMA**2))
    axes, scales, _ = np.linalg.svd(np.swapaxes(sigma * tangents, 1, 2), full_matrices=False)
    frame = np.concatenate([axes, np.cross(axes[..., 0], axes[..., 1])[..., None]], -1)  # columns: axes in the camera
    scales = np.concatenate([scales, THICKNESS * scales[:, 1:]], -1)
    return Gaussians(
        means=camera.unproject(uv, z[:, 0]).astype(np.float32),
        log_scales=np.log(scales[:, : 2 if surfels else 3]).astype(np.float32),
        quats=matrices_to_quats(camera.R.T @ frame).astype(np.float32),
        opacity_logits=np.full(len(z), np.log(settings.opacity / (1 - settings.opacity)), np.float32),
        sh=((colours / 255.0 - 0.5) / SH_C0)[:, None].astype(np.float32),
    )


def _patches(
    image: np.ndarray, disparity: np.ndarray, target: np.ndarray, normals: np.ndarray, settings: SeedSettings
) -> tuple[np.ndarray, np.ndarray]:
    """Rectangles (top, left, height, width) [N, 4] that tile the target [H, W] bool; sums [N, 7] of their colours
    (`image`, uint8), disparities and normals.

    From squares of a grid, every rectangle is halved, across the side where that saves more, until its colours are one
    and its surface is plane, nearly. Colours that change evenly would be blended well by few large splats, too, but
    not in every view: the nearer splat covers the farther, which shifts the texture away from the camera. A rectangle
    that comes nearer to the target's edge than half of its own side is halved as well, so that no splat reaches out of
    the hole by more than it has to.
    """
    size = settings.largest
    tables = _SumTables(np.concatenate([image, disparity[..., None], normals], -1), target, size)
    corners = np.moveaxis(np.mgrid[: target.shape[0] : size, : target.shape[1] : size], 0, -1).reshape(-1, 2)
    pending = np.concatenate([corners, np.full_like(corners, size)], -1)
    done = []
    while len(pending):
        pending = pending[_sum(tables.target, pending) > 0]
        misfit, area = tables.misfit(pending), pending[:, 2:].prod(1)
        bend = np.sqrt(misfit[:, 3] / area) * area / _sum(tables.values, pending)[:, 3]
        fine = (misfit[:, :3].sum(1) <= settings.detail) & (bend <= BEND) & tables.inside(pending)
        fine |= area == 1
        done.append(pending[fine])
        pending = _halved(pending[~fine], tables)
    found = np.concatenate(done)
    found = found[np.lexsort((found[:, 1], found[:, 0]))]
    return found, _sum(tables.values, found)


def _halved(rectangles: np.ndarray, tables: _SumTables) -> np.ndarray:
    """Both halves of each [N, 4], cut so that colours are fitted best and no side exceeds four times the other."""
    halves, misfits = [], []
    for axis in (0, 1):
        first = rectangles.copy()
        first[:, 2 + axis] //= 2
        second = first.copy()
        second[:, axis] += first[:, 2 + axis]
        misfit, sides = (tables.misfit(first) + tables.misfit(second))[:, :3].sum(1), first[:, 2:]
        halves.append((first, second))
        misfits.append(np.where((sides == 0).any(1) | (sides.max(1) > 4 * sides.min(1)), np.inf, misfit))
    down = (misfits[0] < misfits[1])[:, None]  # equal, as where all is flat: squares come of it, as sides alternate
    down |= (misfits[0] == misfits[1])[:, None] & (rectangles[:, 2] > rectangles[:, 3])[:, None]
    return np.concatenate([np.where(down, a, b) for a, b in zip(*halves)])


class _SumTables:
    """Sums over rectangles (top, left, height, width) [N, 4] of a picture, each in constant time (Crow 1984)."""

    def __init__(self, values: np.ndarray, target: np.ndarray, size: int) -> None:
        self.shape, beyond = target.shape, [(0, -side % size) for side in target.shape]  # the grid's last squares
        padded = np.pad(values, (*beyond, (0, 0)))
        rows, cols = (i[..., None] + 0.5 for i in np.indices(padded.shape[:2]))
        fitted, disparity = padded[..., :4], padded[..., 3:4]
        self.values, self.target = _table(padded), _table(np.pad(target, beyond))
        self.moments = _table(np.concatenate([fitted**2, rows * disparity, cols * disparity], -1))

    def inside(self, rectangles: np.ndarray) -> np.ndarray:
        """[N] bool: of target alone, and so is half a side all round; what lies outside of the picture is no edge."""
        corner, sides = rectangles[:, :2], rectangles[:, 2:]
        low, high = np.maximum(corner - sides // 2, 0), np.minimum(corner + sides + sides // 2, self.shape)
        around = np.concatenate([low, high - low], -1)
        return np.all([_sum(self.target, r) == r[:, 2:].prod(1) for r in (rectangles, around)], axis=0)

    def misfit(self, rectangles: np.ndarray) -> np.ndarray:
        """Squared residuals, summed, [N, 4]: of colours from their mean, of disparity from its best plane."""
        total, moments = _sum(self.values, rectangles)[:, :4], _sum(self.moments, rectangles)
        pixels = np.maximum(rectangles[:, 2:].prod(1), 1)
        rest = moments[:, :4] - total**2 / pixels[:, None]
        for moment, start, side in zip(moments[:, 4:].T, rectangles[:, :2].T, rectangles[:, 2:].T):
            lever = pixels * (side**2 - 1) / 12
            slope = moment - (start + side / 2) * total[:, 3]
            rest[:, 3] -= slope**2 / np.where(lever > 0, lever, np.inf)
        return np.maximum(rest, 0.0)


def _table(values: np.ndarray) -> np.ndarray:
    """[H+1, W+1, …] sums of all above and to the left."""
    return np.pad(values.cumsum(0).cumsum(1), [(1, 0), (1, 0)] + [(0, 0)] * (values.ndim - 2))


def _sum(table: np.ndarray, rectangles: np.ndarray) -> np.ndarray:
    top, left, h, w = rectangles.T
    return table[top + h, left + w] - table[top, left + w] - table[top + h, left] + table[top, left]


def settle_gaussians(
    scene: Gaussians,
    seeds: Gaussians,
    reference: Camera,
    painted: Sequence[PaintedView],
    settings: SeedSettings = SeedSettings(),
    between: Sequence[PaintedView] = (),  # drawn views, that are painted as well: see steps.references.views_between
) -> Gaussians:
    """The seeds that show somewhere, of the scene's SH degree, in colours by which it, drawn, shows the painted views.

    Splats overlap one another and the rim, so a splat in its pixel's colour does not draw that pixel. A picture is
    linear in the colours c, pixels = W c + known; one gradient step of least squares, scaled by W's column sums
    (SIRT), takes most of what is missing. It is taken over views all round, and fits each Gaussian's coefficients to
    what each view misses: a step for the reference alone would undo, there, how near splats cover far ones, and double
    that on the other side. Without corrections, as in the paper, all seeds stay, and their colours are fitted to the
    painted views at their centres.
    """
    degree, sh = min(settings.sh_degree, scene.sh_degree), seeds.sh
    if degree > 0 and not settings.corrections:
        sh = _fitted_at_centres(seeds, reference, painted, degree, settings.harmonics)
    sh = pad_sh(sh, (scene.sh_degree + 1) ** 2).copy()
    sh[:, 0] += (0.5 - settings.grey) / SH_C0
    new = replace(seeds, sh=sh)
    if not settings.corrections:
        return new
    others = [p for p in painted if p.rules.any() and p.camera.id != reference.id]
    looks = [*others[:: math.ceil(len(others) / LOOKS) or 1], *(p for p in between if p.rules.any())]
    joined = scene.extended(new)

    def peak(camera: Camera) -> np.ndarray:
        there = window_mask(touched_window(new, camera), camera)
        return contributions(joined, camera, pixels=there).peak[len(scene) :]

    def step(paint: PaintedView) -> tuple[np.ndarray, np.ndarray]:
        """See missing_colours: of what the view's own pixels painted."""
        wanted = np.isin(paint.rule_map(), OWN_RULES)
        region = pixel_region(scene, paint.camera, wanted, passes=frozenset({"rgb"}))
        return missing_colours(region, new, wanted, paint.pasted(np.zeros((*wanted.shape, 3), np.uint8)))

    peaks = parallel_map(peak, [reference, *(p.camera for p in looks)])
    new = new.take(np.max(peaks, axis=0) >= NEEDED)
    for _ in range(settings.corrections if looks else 0):
        steps = parallel_map(step, looks)
        towards = [directions(new.means.astype(np.float64), p.camera) for p in looks]
        change = _colour_change(steps, towards, degree, HOLD)
        sh = new.sh.copy()
        sh[:, : change.shape[1]] += change
        new = replace(new, sh=sh)
    return new


def _fitted_at_centres(
    seeds: Gaussians, reference: Camera, painted: Sequence[PaintedView], degree: int, settings: HarmonicsSettings
) -> np.ndarray:
    """The paper's SH [N, K, 3] of the seeds."""
    means = seeds.means.astype(np.float64)

    def seen_in(paint: PaintedView) -> Seen:
        """By pixels of the view's own."""
        part = cropped(paint.camera, paint.part)
        visible = np.flatnonzero(sees(part, paint.depth, means, SAME_DEPTH))
        cols, rows = part.project(means[visible])[0].astype(int).T
        own = np.isin(paint.rules[rows, cols], OWN_RULES)
        index = visible[own]
        return index, directions(means[index], paint.camera), paint.image[rows[own], cols[own]] / 255.0

    colours = 0.5 + SH_C0 * seeds.sh[:, 0].astype(np.float64)
    return fit_harmonics(colours, directions(means, reference), parallel_map(seen_in, painted), degree, settings)


def _colour_change(
    steps: Sequence[tuple[np.ndarray, np.ndarray]], towards: Sequence[np.ndarray], degree: int, hold: float
) -> np.ndarray:
    """What must be added to the coefficients, [N, K, 3]: robust least squares with a ridge, over the views' unit
    directions `towards` the Gaussians [N, 3]. `steps` are each view's weights and what is missing there, [N, 3] each.

    The basis is taken less its mean over the views, so that what all of them miss is no view dependence, and few
    directions, or near ones, tell c_0 alone. What a view misses by far more than is usual counts little (Geman and
    McClure 1987): its photo is wrong there.
    """
    weights = [w[:, :1] for w, _ in steps]
    misses = [np.linalg.norm(m, axis=1, keepdims=True) / np.maximum(w, SHOWN) for w, (_, m) in zip(weights, steps)]
    shown = np.concatenate(weights) > SHOWN
    usual = max(1e-6, float(np.median(np.concatenate(misses)[shown]))) if shown.any() else 1.0
    trust = [1 / (1 + (m / (CUT * usual)) ** 2) ** 2 for m in misses]
    weights = [w * t for w, t in zip(weights, trust)]
    bases = [sh_basis(t, degree) / SH_C0 for t in towards]
    middle = sum(w * y for w, y in zip(weights, bases)) / np.maximum(sum(weights), 1e-9)
    middle[:, 0] = 0.0
    normal, right = hold * np.eye(middle.shape[1]), np.zeros(())
    for w, y, t, (_, missing) in zip(weights, bases, trust, steps):
        apart = y - middle
        normal = normal + (w * apart)[:, :, None] * apart[:, None]
        right = right + apart[:, :, None] * (t * missing)[:, None]
    change = np.linalg.solve(normal, right)
    change[:, 0] -= (middle[..., None] * change).sum(1)
    return change


def missing_colours(
    region: PixelRegion, new: Gaussians, wanted: np.ndarray, picture: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """W's column sums, and Wᵀ (picture − drawn) in units of c_0, [N, 3] each: W blends the new Gaussians' colours.

    The region is of the rest of the scene; the picture [H, W, 3] uint8 is what should show where `wanted` [H, W] bool.
    """
    drawn, way_back = region.trace(new)
    missing = np.where(wanted[..., None], picture / np.float32(255) - drawn.rgb, np.float32(0))
    one = np.broadcast_to(wanted[..., None], missing.shape)
    weights, error = (way_back.backward(PictureGradients(rgb=g.astype(np.float32))).sh[:, 0] for g in (one, missing))
    return weights / SH_C0, error / SH_C0**2
