"""Where the surface that a view shows lies in the reference, and the reference's colours there.

The warp runs backward, from the new surface as view t sees it to the reference: no cracks, one sample per pixel.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ...camera import Camera
from ...compute.jit import inline_kernel, kernel
from ...compute.threads import run_ranges
from ...geometry import SAME_DEPTH, pack_camera, project, unproject
from .types import Reference, ViewToPaint


class Picture(NamedTuple):
    """A view as the kernels take it."""

    camera: np.ndarray  # [18], see pack_camera
    depth: np.ndarray  # [H, W] float32
    image: np.ndarray  # [H, W, 3] uint8
    usable: np.ndarray  # [H, W] bool, pixels that show a photo's unhidden surface


def picture_of(view: ViewToPaint | Reference) -> Picture:
    """The view with the object, or the completed reference."""
    if isinstance(view, Reference):
        depth, usable = view.depth, view.source
    else:
        depth, usable = view.depth_before, ~view.silhouette
    arrays = np.asarray(depth, np.float32), view.image, usable
    return Picture(pack_camera(view.camera), *(np.ascontiguousarray(a) for a in arrays))


@dataclass(frozen=True)
class Warp:
    """The reference as a part of a view sees it."""

    colours: np.ndarray  # [h, w, 3] float32
    u: np.ndarray  # [h, w] where it lies in the reference; NaN: the reference does not show it, or nobody asked
    v: np.ndarray

    @property
    def reached(self) -> np.ndarray:
        """[h, w] bool: pixels whose surface the reference shows."""
        return ~np.isnan(self.u)

    def lookup(
        self,
        picture: np.ndarray,  # [H, W, ...] of the reference
        where: np.ndarray,  # [h, w] bool, reached
    ) -> np.ndarray:
        """The picture's values at those pixels, [N, ...]."""
        return picture[self.v[where].astype(int), self.u[where].astype(int)]


def warp_reference(reference: Picture, camera: Camera, depth: np.ndarray, wanted: np.ndarray) -> Warp:
    """The reference's colours at the `wanted` [h, w] bool pixels of a part of a view, and the places they come from.
    `camera` is the part's, `depth` [h, w] float32 z of its new surface.
    """
    rows, cols = np.nonzero(wanted)
    colours = np.zeros((*wanted.shape, 3), np.float32)
    u, v = np.full((2, *wanted.shape), np.nan)
    run_ranges(_warp_range, len(rows), rows, cols, pack_camera(camera), depth, reference, SAME_DEPTH, colours, u, v)
    return Warp(colours, u, v)


@inline_kernel
def _inside(u, v, h, w):
    """Whether a point lies in a picture of h × w pixels."""
    return u >= 0 and v >= 0 and u < w and v < h


@inline_kernel
def shown_at(u, v, reference, view, tolerance):
    """Where the view shows the surface point at (u, v) of the reference, and whether it does, unhidden."""
    h0, w0 = reference.depth.shape
    h, w = view.depth.shape
    ut, vt, good = 0.0, 0.0, False
    if _inside(u, v, h0, w0):
        a, b = int(v), int(u)
        z = float(reference.depth[a, b])
        if z > 0 and reference.usable[a, b]:
            x, y, zw = unproject(reference.camera, u, v, z)
            ut, vt, zt = project(view.camera, x, y, zw)
            if _inside(ut, vt, h, w):
                i, j = int(vt), int(ut)
                good = view.usable[i, j] and abs(view.depth[i, j] - zt) <= tolerance * zt
    return ut, vt, good


@kernel
def _warp_range(lo, hi, rows, cols, camera, depth, ref, tolerance, colours, u, v):
    """Pixels lo … hi−1 of the lists rows and cols: bilinear samples of reference pixels that show the same surface.

    Written are the colours [h, w, 3] and where they lie in the reference, u and v [h, w].
    """
    h0, w0 = ref.depth.shape
    for k in range(lo, hi):
        i, j = rows[k], cols[k]
        z = float(depth[i, j])
        if z <= 0:
            continue
        x, y, zw = unproject(camera, j + 0.5, i + 0.5, z)
        u0, v0, z0 = project(ref.camera, x, y, zw)
        if not _inside(u0, v0, h0, w0):
            continue
        i0, j0 = int(v0), int(u0)
        if abs(ref.depth[i0, j0] - z0) > tolerance * z0:
            continue
        a, b = math.floor(v0 - 0.5), math.floor(u0 - 0.5)
        t, s = v0 - 0.5 - a, u0 - 0.5 - b
        total, sum0, sum1, sum2 = 0.0, 0.0, 0.0, 0.0
        for tap in range(4):
            p, q = a + tap // 2, b + tap % 2
            if p < 0 or q < 0 or p >= h0 or q >= w0:
                continue
            if abs(ref.depth[p, q] - z0) > 2 * tolerance * z0:
                continue
            weight = (t if tap // 2 else 1 - t) * (s if tap % 2 else 1 - s) + 1e-6
            total += weight
            sum0 += weight * ref.image[p, q, 0]
            sum1 += weight * ref.image[p, q, 1]
            sum2 += weight * ref.image[p, q, 2]
        colours[i, j, 0], colours[i, j, 1], colours[i, j, 2] = sum0 / total, sum1 / total, sum2 / total
        u[i, j], v[i, j] = u0, v0
