"""What several stages ask of cameras, depths and pictures: frames, windows, the same surface or not, normals.

Depths are z along the viewing axis, [H, W], 0 where there is nothing; pixel coordinates are continuous, pixel (row i,
column j) having its centre at (j + 0.5, i + 0.5); points are in scene coordinates.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from .camera import Camera
from .compute.jit import inline_kernel

Window = tuple[slice, slice]  # rows and columns of a picture
WHOLE: Window = (slice(0, None), slice(0, None))

SAME_DEPTH = 0.02  # relative z within which two drawn depths are the same surface: the scatter of settled splats
SOLID = 0.9  # opacity from which a pixel shows a surface and not a veil before it
EVIDENCE_DEPTH = 0.006  # relative z within which a photo shows a completed surface: closer than SAME_DEPTH, as a copied
# pixel of another surface is seen at once, while one that is not copied is only filled
FAINT = 1e-3  # of a blur's weight, below which it shows next to nothing
SPECK = 4  # px, of a part of a mask that is too small to be a thing of its own
MOST_ROWS = 32_000  # of a picture that cv2.remap makes; it refuses 32,768


def framed(camera: Camera, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Which points [N, 3] lie in a view's frame: their indices [M], and row, column and z where they do."""
    uv, z = camera.project(points)
    with np.errstate(invalid="ignore"):
        inside = (z > 0) & (uv >= 0).all(-1) & (uv[:, 0] < camera.width) & (uv[:, 1] < camera.height)
    cols, rows = uv[inside].astype(int).T
    return np.flatnonzero(inside), rows, cols, z[inside]


def same_surface(drawn: np.ndarray, z: np.ndarray, tolerance: float) -> np.ndarray:
    """Bool of the arrays' shape: a drawn depth and that of a surface asked about (0 = nothing) are within a relative
    tolerance of the latter."""
    return (drawn > 0) & (z > 0) & (np.abs(drawn - z) < tolerance * z)


def sees(camera: Camera, depth: np.ndarray, points: np.ndarray, tolerance: float) -> np.ndarray:
    """[N] bool: the point is framed and is the surface seen there (z-test with a relative tolerance)."""
    index, rows, cols, z = framed(camera, points)
    result = np.zeros(len(points), bool)
    result[index] = same_surface(depth[rows, cols], z, tolerance)
    return result


def surface_points(
    camera: Camera, depth: np.ndarray, window: Window = WHOLE, step: int = 1
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rows [N], columns [N] and points [N, 3] of a window's pixels, every step-th each way, that show a surface."""
    rows, cols = np.nonzero(depth[window][::step, ::step] > 0)
    rows, cols = step * rows + window[0].start, step * cols + window[1].start
    return rows, cols, camera.unproject(np.stack([cols + 0.5, rows + 0.5], -1), depth[rows, cols].astype(np.float64))


def directions(points: np.ndarray, camera: Camera) -> np.ndarray:
    """Unit vectors from a camera to points, [N, 3]."""
    towards = points - camera.centre
    return towards / np.maximum(np.linalg.norm(towards, axis=-1, keepdims=True), 1e-12)


def disparity_of(depth: np.ndarray) -> np.ndarray:
    """1/z [H, W] float32, 0 where there is nothing."""
    return np.where(depth > 0, 1.0 / np.where(depth > 0, depth, 1.0), 0.0).astype(np.float32)


def surface_normals(camera: Camera, depth: np.ndarray) -> np.ndarray:
    """Unit normals [H, W, 3] of a depth map in camera axes, facing the camera; 0 where depth is missing."""
    points = camera.unproject(camera.pixel_centres(), depth.astype(np.float64)) @ camera.R.T
    normals = np.cross(_difference(points, 0), _difference(points, 1))
    length = np.linalg.norm(normals, axis=-1, keepdims=True)
    valid = (depth > 0)[..., None] & (length > 0)
    return np.where(valid, normals / np.where(length > 0, length, 1), 0.0)


def _difference(points: np.ndarray, axis: int) -> np.ndarray:
    """One-sided differences of [H, W, 3] points, to the side where depth changes less: edges do not tilt normals."""
    if points.shape[axis] < 2:
        return np.zeros_like(points)
    step = np.diff(points, axis=axis)
    first, last = np.take(step, [0], axis), np.take(step, [-1], axis)
    forward, backward = np.concatenate([step, last], axis), np.concatenate([first, step], axis)
    return np.where(np.abs(forward[..., 2:]) <= np.abs(backward[..., 2:]), forward, backward)


def bounds(mask: np.ndarray, margin: int = 0) -> Window:
    """The rectangle that holds a mask and a margin in pixels, within the picture; an empty one for an empty mask."""
    found = [np.flatnonzero(mask.any(1 - axis)) for axis in (0, 1)]
    ends = [(max(0, int(x[0]) - margin), int(x[-1]) + margin + 1) if len(x) else (0, 0) for x in found]
    rows, cols = (slice(low, min(high, side)) for (low, high), side in zip(ends, mask.shape))
    return rows, cols


def window_round(points: np.ndarray, camera: Camera, margin: int = 0) -> Window:
    """The rectangle round points [N, 2] in pixels and a margin, within the picture; never empty."""
    size = np.array([camera.width, camera.height])
    ends = [points.min(0), points.max(0)] if len(points) else [size / 2, size / 2]
    low = np.clip(np.floor(ends[0]) - margin, 0, size - 1).astype(int)
    high = np.clip(np.ceil(ends[1]) + margin, low + 1, size).astype(int)
    return slice(low[1], high[1]), slice(low[0], high[0])


def window_mask(window: Window, camera: Camera) -> np.ndarray:
    """[H, W] bool: the pixels of a view that lie in a window."""
    mask = np.zeros((camera.height, camera.width), bool)
    mask[window] = True
    return mask


def cropped(camera: Camera, window: Window) -> Camera:
    """The part of a view in a window, with exact intrinsics."""
    rows, cols = window
    width, height = cols.stop - cols.start, rows.stop - rows.start
    return replace(camera, width=width, height=height, cx=camera.cx - cols.start, cy=camera.cy - rows.start)


def dilated(mask: np.ndarray, margin: int) -> np.ndarray:
    """[H, W] bool: a mask and all pixels within a square of `margin` pixels round its own."""
    return cv2.dilate(mask.astype(np.uint8), np.ones((2 * margin + 1,) * 2, np.uint8)) > 0


def specks(mask: np.ndarray) -> np.ndarray:
    """[H, W] bool: the parts of a mask of a few pixels each."""
    _, labels, parts, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)
    return mask & (parts[labels, cv2.CC_STAT_AREA] <= SPECK)


def blurred(picture: np.ndarray, shown: np.ndarray, sigma: float) -> np.ndarray:
    """A picture [H, W] or [H, W, C] under a Gaussian blur in which only the pixels shown, [H, W] bool, count, float32.

    Normalised convolution (Knutsson and Westin 1993); 0 where none is near.
    """
    each = (..., *[None] * (picture.ndim - 2))  # channel
    weight = shown.astype(np.float32)
    total = cv2.GaussianBlur(np.where(shown[each], picture, 0).astype(np.float32), (0, 0), sigma)
    share = np.maximum(cv2.GaussianBlur(weight, (0, 0), sigma), FAINT)
    return np.asarray(total.reshape(picture.shape) / share[each])


def colours_at(
    picture: np.ndarray, uv: np.ndarray, how: int = cv2.INTER_LINEAR, beyond: int = cv2.BORDER_REPLICATE
) -> np.ndarray:
    """[N, ...] of the picture's type: samples at uv [N, 2], as cv2 names the way; by default its border goes on."""
    at = (uv.astype(np.float32) - np.float32(0.5))[:, None]
    parts = [at[k : k + MOST_ROWS] for k in range(0, len(at), MOST_ROWS)]
    found = [cv2.remap(picture, p, None, how, borderMode=beyond)[:, 0] for p in parts]
    return np.concatenate(found) if found else np.zeros((0, *picture.shape[2:]), picture.dtype)


def pack_camera(camera: Camera) -> np.ndarray:
    """[18] float64, a camera for kernels: rotation by rows, translation, fx, fy, cx, cy, width, height."""
    c = camera
    return np.concatenate([c.R.ravel(), c.t, [c.fx, c.fy, c.cx, c.cy, c.width, c.height]])


@inline_kernel
def project(c, x, y, z):
    """(u, v, depth) of a point in packed camera c; u = v = −1e9, out of every frame, where depth is not positive."""
    depth = c[6] * x + c[7] * y + c[8] * z + c[11]
    if not depth > 1e-9:
        return -1e9, -1e9, depth
    u = c[12] * (c[0] * x + c[1] * y + c[2] * z + c[9]) / depth + c[14]
    v = c[13] * (c[3] * x + c[4] * y + c[5] * z + c[10]) / depth + c[15]
    return u, v, depth


@inline_kernel
def unproject(c, u, v, depth):
    """(x, y, z) of the point that packed camera c shows at (u, v) at a depth."""
    x, y = (u - c[14]) / c[12] * depth, (v - c[15]) / c[13] * depth
    a, b, d = x - c[9], y - c[10], depth - c[11]
    return c[0] * a + c[3] * b + c[6] * d, c[1] * a + c[4] * b + c[7] * d, c[2] * a + c[5] * b + c[8] * d
