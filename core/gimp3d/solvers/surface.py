"""The surface a picture shows, as patches need it: a tangent plane at every pixel.

A patch on the tangent plane of p, moved along the surface to q, covers the pixels q + A δ where the patch at p
covers p + δ: A = J(q) J(p)⁻¹, J being the projection of tangent coordinates to pixels (slanted supports of
PatchMatch Stereo, Bleyer 2011; plane guidance, Huang 2014). So a floor's texture shrinks with distance.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numba import float32

from ..compute.jit import exact_kernel
from ..compute.threads import parallel_map, run_ranges

WINDOW = 14  # px: half the window that planes are fitted to
STRIP = 256  # rows that are fitted at once; results do not depend on it
LEAST_PIXELS = 0.25  # of the window that must be on a surface
LEAST_COSINE = 0.08  # between a plane's normal and the ray; steeper planes are not believed
ON_PLANE = 0.04  # relative difference of disparity up to which a pixel lies on another's plane
WHOLE = 0.75  # share of a source patch that must lie on its centre's surface
SAME_NORMAL = 0.2  # squared difference of unit normals up to which two pixels are on one surface, 22°
NORMAL = 0.01  # cost of a source whose unit normal differs by 1 (60°): (25 grey levels)²
OFF_PLANE = 10.0  # cost of a source as far from the target's plane as the target is from the camera, and
FURTHEST_OFF = 0.05  # the most it costs
SCALES = 0.25, 4.0  # least and greatest ratio of areas of a source patch to its target's
MIXED, NEARER = 3, 0.05  # px beside something nearer by this share whose colours are not trusted
SKY = 1e4  # depth of what is infinitely far, in the greatest depths of the picture


class TangentPlanes(NamedTuple):
    """Tangent planes; a named tuple, as kernels take it. Camera axes, scene units."""

    point: np.ndarray  # [H, W, 3] float32
    normal: np.ndarray  # [H, W, 3] float32, unit, away from the camera
    frame: np.ndarray  # [H, W, 4] float32: J, pixels per unit along two directions of the plane, row by row
    inverse: np.ndarray  # [H, W, 4] float32: J⁻¹
    disparity: np.ndarray  # [H, W, 3] float32: of the plane, and its slopes along x and y per pixel
    clear: np.ndarray  # [H, W] bool: nothing nearer is close by, whose colour would be mixed in


_none = [np.empty((0, 0, n), np.float32) for n in (3, 3, 4, 4, 3)]
NO_SURFACE = TangentPlanes(_none[0], _none[1], _none[2], _none[3], _none[4], np.empty((0, 0), bool))


def tangent_planes(disparity: np.ndarray, K: np.ndarray) -> TangentPlanes:
    """The plane round each pixel that fits best, from windows round it and beside it: edges do not tilt planes.

    `disparity` [H, W] is 1/z, 0 = infinitely far or nothing.
    """
    valid = np.isfinite(disparity) & (disparity > 0)
    known = np.where(valid, disparity, 0.0).astype(np.float64)
    far = SKY / max(float(known[valid].min(initial=1.0)), 1e-9)

    def strip(top: int) -> list[np.ndarray]:
        """Its rows see all that the whole picture's would: 2 windows to either side."""
        first, last = max(0, top - 2 * WINDOW), min(len(known), top + STRIP + 2 * WINDOW)
        moved = K - np.array([[0, 0, 0], [0, 0, first], [0, 0, 0]])
        return [a[top - first : top - first + STRIP] for a in _planes(known[first:last], valid[first:last], moved, far)]

    parts = parallel_map(strip, range(0, len(known), STRIP))
    return TangentPlanes(*(np.concatenate(arrays) for arrays in zip(*parts)))


def _planes(known: np.ndarray, valid: np.ndarray, K: np.ndarray, far: float) -> TangentPlanes:
    h, w = known.shape
    plane = _fitted(known, valid)
    x, y = np.meshgrid(np.arange(w) + 0.5, np.arange(h) + 0.5)
    rays = np.stack([(x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1], np.ones((h, w))], -1)
    offset = plane[..., 0] - plane[..., 1] * x - plane[..., 2] * y
    normal = np.stack([plane[..., 1], plane[..., 2], offset], -1) @ K  # n · X = 1 on the plane
    length = np.linalg.norm(normal, axis=-1, keepdims=True)
    normal /= np.maximum(length, 1e-12)
    cosine = (normal * rays).sum(-1) / np.linalg.norm(rays, axis=-1)
    flat = ~valid | (cosine < LEAST_COSINE) | (plane[..., 0] <= 0)
    normal[flat] = (0, 0, 1)
    depth = np.where(valid, 1 / np.maximum(np.where(flat, known, plane[..., 0]), 1e-12), far)
    plane[flat] = np.stack([known, np.zeros((h, w)), np.zeros((h, w))], -1)[flat]
    frame = _projected(normal, rays, depth, K)
    determinant = frame[..., 0] * frame[..., 3] - frame[..., 1] * frame[..., 2]
    inverse = frame[..., [3, 1, 2, 0]] * [1, -1, -1, 1] / determinant[..., None]
    point, normal, frame, inverse, plane = (
        np.ascontiguousarray(a, np.float32) for a in (rays * depth[..., None], normal, frame, inverse, plane)
    )
    nearest = cv2.dilate(known, np.ones((2 * MIXED + 1, 2 * MIXED + 1), np.uint8))
    beside_nearer = nearest > (1 + NEARER) * (known + MIXED * np.abs(plane[..., 1:]).sum(-1))
    return TangentPlanes(point, normal, frame, inverse, plane, ~beside_nearer)


def _projected(normal: np.ndarray, rays: np.ndarray, depth: np.ndarray, K: np.ndarray) -> np.ndarray:
    """[H, W, 4]: how two unit vectors of each plane project. They are x and y, turned by the least rotation that
    takes the viewing axis to the normal: the same on all of a plane."""
    a, b, c = np.moveaxis(normal, -1, 0)
    first = np.stack([1 - a * a / (1 + c), -a * b / (1 + c), -a], -1)
    second = np.stack([-a * b / (1 + c), 1 - b * b / (1 + c), -b], -1)
    rows = [
        K[k, k] / depth * (along[..., k] - rays[..., k] * along[..., 2]) for k in (0, 1) for along in (first, second)
    ]
    return np.stack(rows, -1)


def _fitted(disparity: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """[H, W, 3]: disparity and slopes at each pixel of the best of nine windows' planes (least squares).

    Planes are affine in disparity. The best has the least residual, counting how far it misses the pixel itself.
    """
    h, w = disparity.shape
    y, x = np.mgrid[:h, :w].astype(np.float64)
    weight = valid.astype(np.float64)

    def total(a: np.ndarray) -> np.ndarray:
        return cv2.boxFilter(a, -1, (2 * WINDOW + 1,) * 2, normalize=False, borderType=cv2.BORDER_CONSTANT)

    count, sx, sy = total(weight), total(weight * x), total(weight * y)
    d, dx, dy = total(disparity), total(disparity * x), total(disparity * y)
    safe = np.maximum(count, 1)
    mx, my, md = sx / safe, sy / safe, d / safe
    vxx, vxy = total(weight * x * x) - sx * mx, total(weight * x * y) - sx * my
    vyy, vdd = total(weight * y * y) - sy * my, total(disparity * disparity) - d * md
    vdx, vdy = dx - d * mx, dy - d * my
    determinant = vxx * vyy - vxy * vxy
    fit = (count >= LEAST_PIXELS * (2 * WINDOW + 1) ** 2) & (determinant > 1e-6 * safe * safe)
    safe_determinant = np.where(fit, determinant, 1)
    bx = np.where(fit, (vdx * vyy - vdy * vxy) / safe_determinant, 0)
    by = np.where(fit, (vdy * vxx - vdx * vxy) / safe_determinant, 0)
    residual = np.where(fit, np.maximum(vdd - bx * vdx - by * vdy, 0) / safe, np.inf)
    plane = np.empty((h, w, 3))
    _choose(disparity, mx, my, md, bx, by, residual, plane)
    return plane


@exact_kernel
def _choose(disparity, mx, my, md, bx, by, residual, plane):
    """`plane` becomes that of the best window round or beside each pixel; where none fits, it is level."""
    h, w = disparity.shape
    for y in range(h):
        for x in range(w):
            least = np.inf
            plane[y, x, 0], plane[y, x, 1], plane[y, x, 2] = disparity[y, x], 0.0, 0.0
            for k in range(9):
                a = min(max(y + (k // 3 - 1) * WINDOW, 0), h - 1)
                b = min(max(x + (k % 3 - 1) * WINDOW, 0), w - 1)
                here = md[a, b] + bx[a, b] * (x - mx[a, b]) + by[a, b] * (y - my[a, b])
                score = residual[a, b] + (disparity[y, x] - here) ** 2
                if score < least:
                    least = score
                    plane[y, x, 0], plane[y, x, 1], plane[y, x, 2] = here, bx[a, b], by[a, b]


def coarser(surface: TangentPlanes, level: int, shape: tuple[int, ...]) -> TangentPlanes:
    """The planes at 1 / 2^level of the resolution; A does not change with the resolution."""
    if level == 0:
        return surface
    rows, cols = (
        np.minimum(np.arange(n) * 2**level + 2 ** (level - 1), full - 1)
        for n, full in zip(shape, surface.point.shape[:2])
    )
    arrays = [np.ascontiguousarray(a[rows[:, None], cols]) for a in surface]
    arrays[4][..., 1:] *= 2**level
    return TangentPlanes(*arrays)


def supports(surface: TangentPlanes | None, places: np.ndarray, radius: int) -> np.ndarray:
    """[N, (2 radius + 1)²] uint8: which pixels of the patches at `places` ([N, 2]) lie on the centre's surface."""
    if surface is None:
        return np.empty((0, 0), np.uint8)
    found = np.empty((len(places), (2 * radius + 1) ** 2), np.uint8)
    run_ranges(_support, len(places), places, surface.normal, surface.disparity, surface.clear, radius, found)
    return found


@exact_kernel
def _support(lo, hi, places, normal, disparity, clear, radius, found):
    h, w, _ = normal.shape
    for k in range(lo, hi):
        y, x = places[k]
        value, along_x, along_y = disparity[y, x, 0], disparity[y, x, 1], disparity[y, x, 2]
        slot = 0
        for a in range(y - radius, y + radius + 1):
            for b in range(x - radius, x + radius + 1):
                on = 0 <= a < h and 0 <= b < w
                if on:
                    off = abs(disparity[a, b, 0] - (value + along_x * (b - x) + along_y * (a - y)))
                    turned = float32(0)
                    for c in range(3):
                        turned += (normal[a, b, c] - normal[y, x, c]) ** 2
                    on = (off <= ON_PLANE * value and turned <= SAME_NORMAL and clear[a, b]) or (a == y and b == x)
                found[k, slot] = on
                slot += 1


def whole_patches(surface: TangentPlanes, centres: np.ndarray, radius: int) -> np.ndarray:
    """[H, W] bool: the centres whose patch lies on one surface."""
    kept = centres.copy()
    kept[centres] = supports(surface, np.argwhere(centres), radius).mean(1) >= WHOLE
    return kept


def warps(surface: TangentPlanes, target: np.ndarray, rows: np.ndarray, cols: np.ndarray) -> np.ndarray:
    """[N, 4] float32, A row by row: from each target pixel's patch to the patch at its source."""
    inverse, frame = surface.inverse[target], surface.frame[rows[target], cols[target]]
    products = [frame[:, a] * inverse[:, b] + frame[:, a + 1] * inverse[:, b + 2] for a in (0, 2) for b in (0, 1)]
    return np.stack(products, -1)
