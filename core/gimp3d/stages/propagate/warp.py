"""What goes into the propagation and what comes out; where the surface that a view shows lies in the reference.

The warp runs backward, from the new surface as view t sees it to the reference: no cracks, one sample per pixel.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from typing import Literal, NamedTuple

import numpy as np

from ...camera import Camera
from ...compute.jit import inline_kernel, kernel
from ...compute.threads import run_ranges
from ...geometry import SAME_DEPTH, Window, pack_camera, project, unproject


class Rule(IntEnum):
    """How a pixel of T_t got its colour."""

    UNTOUCHED = 0
    EVIDENCE = 1  # the photo shows the new surface itself here: T reaches beyond the object
    OWN_PIXELS = 2  # by the view's own: fitted to those round the hole, or (paper) those at the mapped source
    REFERENCE = 3  # the warped reference colour (paper: where nothing shows the mapped source)
    UNREACHED = 4  # the reference does not see this surface
    RETARGETED = 5  # by the view's own pixels near the mapped source, which is itself hidden or off-screen
    OTHER_VIEW = 6  # the mapped source as another view shows it
    REFINED = 7  # by whoever --refine-views asked; the last one, as it comes after the propagation


@dataclass(frozen=True)
class PropagateSettings:
    """How a view is painted: by default what was measured to be best, else as in the paper."""

    # warp: the reference's colours; sample: the colours of this view's mapped sources (paper)
    transfer: Literal["warp", "sample"] = "warp"  # way; the reference's texture against the view's light
    # band: fitted to the photo round the hole; rim: to the rim's pixels alone (paper)
    blend: Literal["band", "rim"] = "band"  # way; an even level against no seam at any pixel of the rim
    retarget: int = 32  # px searched round a source that is not to be seen (sample only); time against more own pixels
    donors: int = 8  # views that lend samples of sources a view does not show (sample only); time against holes


@dataclass(frozen=True)
class Reference:
    """The completed reference view."""

    camera: Camera
    image: np.ndarray  # [H, W, 3] uint8, inpainted
    depth: np.ndarray  # [H, W] float32, completed
    target: np.ndarray  # [H, W] bool, T_0
    source: np.ndarray  # [H, W] bool, what photos show, the object not in the way, agreeing or not


@dataclass(frozen=True)
class ViewToPaint:
    """A view before its hole is painted."""

    camera: Camera
    image: np.ndarray  # [H, W, 3] uint8, the photo (or rendering) with the object
    base: np.ndarray  # [H, W, 3] uint8, without the object: the photo round it, the emptied scene where it was
    silhouette: np.ndarray  # [H, W] bool, touched by the object
    target: np.ndarray  # [H, W] bool, T_t
    depth_before: np.ndarray  # [H, W] z with the object
    depth_new: np.ndarray  # [H, W] z of the scene with the new surface; used within `near_hole`
    drawn: np.ndarray  # [H, W, 3] uint8, what the scene without the object draws; used where `round_hole` says


Loader = Callable[[], ViewToPaint]  # brings a view into memory; it is let go again once it is painted


@dataclass(frozen=True)
class PaintedView:
    """The part of a view round its painted hole."""

    camera: Camera  # the view's
    top: int  # row and column of the view where the part begins
    left: int
    image: np.ndarray  # [h, w, 3] uint8, I_t*
    raw: np.ndarray  # [h, w, 3] uint8, before Poisson blending
    rules: np.ndarray  # [h, w] uint8, see Rule
    depth: np.ndarray  # [h, w] z of the scene with the new surface

    @property
    def part(self) -> Window:
        h, w = self.rules.shape
        return slice(self.top, self.top + h), slice(self.left, self.left + w)

    def pasted(self, picture: np.ndarray, part: np.ndarray | None = None) -> np.ndarray:
        """The picture [H, W, 3] uint8, this part's hole pasted in: from `part` [h, w, 3], by default `image`."""
        whole = picture.copy()
        there = self.rules != Rule.UNTOUCHED
        whole[self.part][there] = (self.image if part is None else part)[there]
        return whole

    def rule_map(self) -> np.ndarray:
        """The rules in the whole view, [H, W] uint8."""
        return self.pasted(np.zeros((self.camera.height, self.camera.width), np.uint8), self.rules)


@dataclass(frozen=True)
class Propagation:
    """Every view painted, in the order given."""

    views: tuple[PaintedView, ...]
    confidence: float
    reason: str


class Picture(NamedTuple):
    """A view as the kernels take it."""

    camera: np.ndarray  # [18], see pack_camera
    depth: np.ndarray  # [H, W] float32
    image: np.ndarray  # [H, W, 3] uint8
    usable: np.ndarray  # [H, W] bool, pixels that show a photo's unhidden surface


def picture_of(view: ViewToPaint | Reference) -> Picture:
    """The view with the object, or the completed reference."""
    if isinstance(view, Reference):  # of what is neither completed nor a photo's it has no colour
        depth, usable = np.where(view.target | view.source, view.depth, 0), view.source
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

    def lookup(self, picture: np.ndarray, where: np.ndarray) -> np.ndarray:
        """The values [N, ...] of a picture [H, W, ...] of the reference at pixels `where` [h, w] bool, all reached."""
        return picture[self.v[where].astype(int), self.u[where].astype(int)]


def warp_reference(reference: Reference, camera: Camera, depth: np.ndarray, wanted: np.ndarray) -> Warp:
    """The reference's colours at the `wanted` [h, w] bool pixels of a part of a view, and the places they come from.
    `camera` is the part's, `depth` [h, w] float32 z of its new surface.
    """
    rows, cols = np.nonzero(wanted)
    colours, (u, v) = np.zeros((*wanted.shape, 3), np.float32), np.full((2, *wanted.shape), np.nan)
    run_ranges(_warp_range, len(rows), rows, cols, pack_camera(camera), depth, picture_of(reference), colours, u, v)
    return Warp(colours, u, v)


@inline_kernel
def _inside(u, v, h, w):
    """Whether a point lies in a picture of h × w pixels."""
    return u >= 0 and v >= 0 and u < w and v < h


@inline_kernel
def shown_at(u, v, reference, view):
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
                good = view.usable[i, j] and abs(view.depth[i, j] - zt) <= SAME_DEPTH * zt
    return ut, vt, good


@kernel
def _warp_range(lo, hi, rows, cols, camera, depth, ref, colours, u, v):
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
        if abs(ref.depth[i0, j0] - z0) > SAME_DEPTH * z0:
            continue
        a, b = math.floor(v0 - 0.5), math.floor(u0 - 0.5)
        t, s = v0 - 0.5 - a, u0 - 0.5 - b
        total, sum0, sum1, sum2 = 0.0, 0.0, 0.0, 0.0
        for tap in range(4):
            p, q = a + tap // 2, b + tap % 2
            if p < 0 or q < 0 or p >= h0 or q >= w0:
                continue
            if abs(ref.depth[p, q] - z0) > 2 * SAME_DEPTH * z0:
                continue
            weight = (t if tap // 2 else 1 - t) * (s if tap % 2 else 1 - s) + 1e-6
            total += weight
            sum0 += weight * ref.image[p, q, 0]
            sum1 += weight * ref.image[p, q, 1]
            sum2 += weight * ref.image[p, q, 2]
        colours[i, j, 0], colours[i, j, 1], colours[i, j, 2] = sum0 / total, sum1 / total, sum2 / total
        u[i, j], v[i, j] = u0, v0
