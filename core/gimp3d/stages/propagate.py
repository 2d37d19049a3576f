"""From the reference into every view, with each view's own pixels (paper Algorithm 1, METHOD section 5).

The warp runs backward, from the new surface as view t sees it to the reference: no cracks, one sample per pixel.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum

import cv2
import numpy as np

from ..camera import Camera
from ..jit import inline_kernel, kernel
from ..progress import Progress, silent
from ..solvers.poisson import solve_poisson
from ..threads import parallel_map


class Rule(IntEnum):
    """How a pixel of T_t got its colour."""

    UNTOUCHED = 0
    EVIDENCE = 1  # the photo shows the new surface itself here (the box held more than the object)
    OWN_PIXELS = 2  # mapped: the view's own pixels at the warped source
    REFERENCE = 3  # the warped reference colour
    UNREACHED = 4  # the reference does not see this surface


RULE_EVIDENCE, RULE_OWN, RULE_REFERENCE, RULE_UNREACHED = 1, 2, 3, 4  # the same, for the kernel


@dataclass(frozen=True)
class PropagateSettings:
    """Lengths in pixels, depths relative."""

    patch: int = 5  # overlapping patches that are blended per pixel (paper 4.1: 5 × 5)
    depth_tolerance: float = 0.02  # z-test
    evidence_tolerance: float = 0.006  # how near the photo's own surface must be to the new one to be taken as it
    evidence_margin: int = 3  # px that evidence keeps away from the object
    seam: float = 0.05  # relative depth step across which blending takes no boundary value
    transfer: str = "difference"  # "difference": reference colour + the source's change between views; "sample": paper


@dataclass(frozen=True)
class Reference:
    """The completed reference view."""

    camera: Camera
    image: np.ndarray  # [H, W, 3] uint8, inpainted
    depth: np.ndarray  # [H, W] float32, completed
    target: np.ndarray  # [H, W] bool, T_0
    rows: np.ndarray  # [H, W] int32, source of each target pixel, -1 = none
    cols: np.ndarray


@dataclass(frozen=True)
class ViewToPaint:
    """A view before its hole is painted."""

    camera: Camera
    image: np.ndarray  # [H, W, 3] uint8, the photo (or rendering) with the object
    base: np.ndarray  # [H, W, 3] uint8, without the object: the photo round it, the emptied scene where it was
    silhouette: np.ndarray  # [H, W] bool, touched by the object
    target: np.ndarray  # [H, W] bool, T_t
    depth_before: np.ndarray  # [H, W] z with the object
    depth_new: np.ndarray  # [H, W] z of the scene with the new surface


@dataclass(frozen=True)
class PaintedView:
    """A view with its hole painted."""

    camera_id: str
    image: np.ndarray  # [H, W, 3] uint8, I_t*
    raw: np.ndarray  # [H, W, 3] uint8, before Poisson blending
    rules: np.ndarray  # [H, W] uint8, see Rule


@dataclass(frozen=True)
class Propagation:
    """Every view painted, in the order given."""

    views: tuple[PaintedView, ...]
    confidence: float
    reason: str


def propagate(
    reference: Reference,
    views: Sequence[ViewToPaint],
    settings: PropagateSettings = PropagateSettings(),
    progress: Progress = silent,
) -> Propagation:
    """Paint the hole of every view by Algorithm 1. Painted views are never sources for others: order is irrelevant."""
    done = 0

    def paint(view: ViewToPaint) -> PaintedView:
        nonlocal done
        painted = _paint(reference, view, settings)
        done += 1
        progress("propagate", done, len(views), view.camera.id)
        return painted

    painted = tuple(parallel_map(paint, views))
    counts = np.sum([np.bincount(p.rules.ravel(), minlength=len(Rule)) for p in painted], axis=0)
    total = max(1, counts[1:].sum())
    shares = ", ".join(f"{counts[r] / total:.0%} {r.name.lower().replace('_', ' ')}" for r in list(Rule)[1:])
    return Propagation(painted, float(1 - counts[Rule.UNREACHED] / total), shares)


def _paint(reference: Reference, view: ViewToPaint, settings: PropagateSettings) -> PaintedView:
    evidence = evidence_pixels(view, settings)
    base = np.where(evidence[..., None], view.image, view.base)
    raw = base.astype(np.float32)
    rules = np.zeros(view.target.shape, np.uint8)
    hole = view.target & ~evidence
    rows, cols = np.nonzero(hole)
    _warp_pixels(
        rows,
        cols,
        _pack(view.camera),
        view.depth_new.astype(np.float32),
        view.depth_before.astype(np.float32),
        view.silhouette,
        view.image,
        _pack(reference.camera),
        reference.depth.astype(np.float32),
        reference.image,
        reference.target,
        reference.rows,
        reference.cols,
        settings.patch // 2,
        settings.depth_tolerance,
        settings.transfer == "difference",
        raw,
        rules,
    )
    painted = hole & ((rules == Rule.OWN_PIXELS) | (rules == Rule.REFERENCE))
    blended = blend(base, raw, painted, hole & ~painted, view.depth_new, settings)
    rules[view.target & evidence] = Rule.EVIDENCE
    return PaintedView(view.camera.id, blended, _to_bytes(raw), rules)


def evidence_pixels(view: ViewToPaint, settings: PropagateSettings) -> np.ndarray:
    """[H, W] bool: pixels of T_t where the photo already shows the new surface, unhidden."""
    near = np.abs(view.depth_before - view.depth_new) < settings.evidence_tolerance * view.depth_new
    same = (view.depth_before > 0) & (view.depth_new > 0) & near
    hidden = (view.silhouette & ~same).astype(np.uint8)
    hidden = cv2.morphologyEx(hidden, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    size = 2 * settings.evidence_margin + 1
    return view.target & same & (cv2.dilate(hidden, np.ones((size, size), np.uint8)) == 0)


def blend(
    base: np.ndarray,  # [H, W, 3] uint8, the view round the hole
    raw: np.ndarray,  # [H, W, 3] float32, the fill
    painted: np.ndarray,  # [H, W] bool, where the fill is
    unpainted: np.ndarray,  # [H, W] bool, the rest of the hole: no boundary
    depth: np.ndarray,  # [H, W] z of the new scene
    settings: PropagateSettings,
) -> np.ndarray:
    """The fill Poisson-blended into the view, [H, W, 3] uint8; the rim counts only where no depth seam parts it."""
    if not painted.any():
        return base.copy()
    rim = (cv2.dilate(painted.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0) & ~painted & ~unpainted & (depth > 0)
    fill_depth = np.where(painted & (depth > 0), depth, 0).astype(np.float32)
    nearest_fill = cv2.dilate(fill_depth, np.ones((3, 3), np.uint8))
    rim &= np.abs(nearest_fill - depth) < settings.seam * depth
    guidance = np.where(painted[..., None], raw, np.nan).astype(np.float32)
    solution = solve_poisson(painted, rim, base, guidance)
    result = base.copy()
    anchored = painted & ~solution.unanchored
    result[anchored] = _to_bytes(solution.values[anchored])
    free = painted & solution.unanchored
    result[free] = _to_bytes(raw[free])
    return result


def _to_bytes(colours: np.ndarray) -> np.ndarray:
    return np.clip(np.rint(np.nan_to_num(colours)), 0, 255).astype(np.uint8)


def _pack(camera: Camera) -> np.ndarray:
    """Rotation (9), translation (3), fx fy cx cy as one float64 vector for the kernel."""
    return np.concatenate([camera.R.ravel(), camera.t, [camera.fx, camera.fy, camera.cx, camera.cy]])


@inline_kernel
def _unproject(c, u, v, z):
    x = (u - c[14]) / c[12] * z
    y = (v - c[15]) / c[13] * z
    a, b, d = x - c[9], y - c[10], z - c[11]
    return c[0] * a + c[3] * b + c[6] * d, c[1] * a + c[4] * b + c[7] * d, c[2] * a + c[5] * b + c[8] * d


@inline_kernel
def _project(c, x, y, z):
    w = c[6] * x + c[7] * y + c[8] * z + c[11]
    if w <= 1e-9:
        return -1e9, -1e9, w
    a = c[0] * x + c[1] * y + c[2] * z + c[9]
    b = c[3] * x + c[4] * y + c[5] * z + c[10]
    return c[12] * a / w + c[14], c[13] * b / w + c[15], w


@inline_kernel
def _bilinear(image, u, v, channel):
    h, w = image.shape[0], image.shape[1]
    x, y = min(max(u - 0.5, 0.0), w - 1.0), min(max(v - 0.5, 0.0), h - 1.0)
    x0, y0 = int(x), int(y)
    x1, y1 = min(x0 + 1, w - 1), min(y0 + 1, h - 1)
    s, t = x - x0, y - y0
    top = image[y0, x0, channel] * (1 - s) + image[y0, x1, channel] * s
    bottom = image[y1, x0, channel] * (1 - s) + image[y1, x1, channel] * s
    return top * (1 - t) + bottom * t


@inline_kernel
def _framed(u, v, h, w):
    return u >= 0 and v >= 0 and u < w and v < h


@kernel
def _warp_pixels(
    rows,  # [M] pixels of T_t
    cols,
    camera,  # [16] view t
    depth_new,  # [H, W] view t, with the new surface
    depth_before,  # [H, W] view t, with the object
    silhouette,  # [H, W] view t
    image,  # [H, W, 3] view t
    ref,  # [16] the reference
    ref_depth,
    ref_image,
    ref_target,
    field_rows,
    field_cols,
    radius,
    tolerance,
    difference,  # transfer the source's change between views instead of its colour
    raw,  # [H, W, 3] out
    rules,  # [H, W] out
):
    h, w = depth_new.shape
    h0, w0 = ref_depth.shape
    for k in range(len(rows)):
        i, j = rows[k], cols[k]
        rules[i, j] = RULE_UNREACHED
        z = float(depth_new[i, j])
        if z <= 0:
            continue
        x, y, zw = _unproject(camera, j + 0.5, i + 0.5, z)
        u0, v0, z0 = _project(ref, x, y, zw)
        if not _framed(u0, v0, h0, w0):
            continue
        i0, j0 = int(v0), int(u0)
        if abs(ref_depth[i0, j0] - z0) > tolerance * z0:
            continue
        rules[i, j] = RULE_REFERENCE
        total = 0.0
        sum0, sum1, sum2 = 0.0, 0.0, 0.0
        for dy in range(-radius, radius + 1):
            for dx in range(-radius, radius + 1):
                a, b = i0 + dy, j0 + dx
                if a < 0 or b < 0 or a >= h0 or b >= w0 or not ref_target[a, b] or field_rows[a, b] < 0:
                    continue
                if abs(ref_depth[a, b] - z0) > 2 * tolerance * z0:
                    continue
                # the patch at (a, b) explains this pixel by its source at the same place within the patch
                uq = field_cols[a, b] - dx + (u0 - j0)
                vq = field_rows[a, b] - dy + (v0 - i0)
                if not _framed(uq, vq, h0, w0):
                    continue
                zq = float(ref_depth[int(vq), int(uq)])
                if zq <= 0 or ref_target[int(vq), int(uq)]:
                    continue
                xq, yq, zqw = _unproject(ref, uq, vq, zq)
                ut, vt, zt = _project(camera, xq, yq, zqw)
                if not _framed(ut, vt, h, w):
                    continue
                it, jt = int(vt), int(ut)
                if silhouette[it, jt] or abs(depth_before[it, jt] - zt) > tolerance * zt:
                    continue
                weight = math.exp(-0.5 * (dx * dx + dy * dy))
                total += weight
                if difference:
                    sum0 += weight * (_bilinear(image, ut, vt, 0) - _bilinear(ref_image, uq, vq, 0))
                    sum1 += weight * (_bilinear(image, ut, vt, 1) - _bilinear(ref_image, uq, vq, 1))
                    sum2 += weight * (_bilinear(image, ut, vt, 2) - _bilinear(ref_image, uq, vq, 2))
                else:
                    sum0 += weight * _bilinear(image, ut, vt, 0)
                    sum1 += weight * _bilinear(image, ut, vt, 1)
                    sum2 += weight * _bilinear(image, ut, vt, 2)
        base0, base1, base2 = 0.0, 0.0, 0.0
        if difference or total == 0.0:
            base0 = _bilinear(ref_image, u0, v0, 0)
            base1 = _bilinear(ref_image, u0, v0, 1)
            base2 = _bilinear(ref_image, u0, v0, 2)
        if total > 0.0:
            rules[i, j] = RULE_OWN
            sum0, sum1, sum2 = sum0 / total, sum1 / total, sum2 / total
        raw[i, j, 0], raw[i, j, 1], raw[i, j, 2] = base0 + sum0, base1 + sum1, base2 + sum2
