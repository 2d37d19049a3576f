"""From the reference into every view, by each view's own pixels (paper Algorithm 1, METHOD section 5).

The warp runs backward, from the new surface as view t sees it to the reference: no cracks, one sample per pixel. What
differs between the two pictures of one surface point is learned from the points that both views show.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import Literal

import cv2
import numpy as np

from ..camera import Camera
from ..compute.jit import inline_kernel, kernel
from ..compute.threads import at_once, parallel_map, run_ranges
from ..errors import BadInput
from ..progress import Progress, silent
from ..schema import AtLeastOne, Share
from ..solvers.colours import NO_CHANGE, ColourChange, biweight, exposure_gain, learn_change
from ..solvers.poisson import solve_poisson

TRANSFERS = ("learned", "sample", "none")
BLENDS = ("band", "rim")
SECTORS = 8  # places round the hole that predict one another
LEAST_REACH = 16  # px
MOST_PAIRS = 4000  # of the surroundings that colours are learned from
MOST_PATCHES = 2000  # of the mapped sources
SMOOTHING = 1 / 20  # of the reach: half the side of the square that pairs are means of, against misregistration
LEAST_BAND = 20  # px that tell a part's level
HOLD = 1 / 16  # how strongly a correction is held at its level where the band is far, over the band's own weight's root
BAND = 1 / 8  # of the reach: the strip round the hole that the blend is fitted to most
FAR = 4  # times as far away, photo still tells
SQUARE = np.ones((3, 3), np.uint8)


class Rule(IntEnum):
    """How a pixel of T_t got its colour."""

    UNTOUCHED = 0
    EVIDENCE = 1  # the photo shows the new surface itself here: T reaches beyond the object
    OWN_PIXELS = 2  # by the view's own pixels at the mapped source
    REFERENCE = 3  # the warped reference colour: no source to be seen
    UNREACHED = 4  # the reference does not see this surface
    RETARGETED = 5  # by the view's own pixels near the mapped source, which is itself hidden or off-screen
    OTHER_VIEW = 6  # the mapped source as another view shows it
    REFINED = 7  # by whoever --refine-views asked; the last one, as it comes after the propagation


OWN, REFERENCE, UNREACHED, RETARGETED, OTHER = 2, 3, 4, 5, 6  # the same, for the kernels


@dataclass(frozen=True)
class PropagateSettings:
    """Lengths in pixels, depths relative."""

    # "learned": the reference's colours, changed as this view's pixels tell; "sample": the colours of this view's
    # mapped sources (paper); "none": the warped reference
    transfer: Literal["learned", "sample", "none"] = "learned"
    # "band": fitted to the photo round the hole; "rim": to the rim's pixels alone (paper)
    blend: Literal["band", "rim"] = "band"
    patch: AtLeastOne = 5  # overlapping patches that are compared and blended (paper 4.1: 5 × 5)
    depth_tolerance: Share = 0.02  # z-test
    evidence_tolerance: Share = 0.006  # how near the photo's own surface must be to the new one to be taken as it
    smooth_tolerance: Share = 0.005  # how far depths may differ within one surface when their noise is averaged
    seam: Share = 0.05  # depth step between neighbours that parts two surfaces
    surroundings: float = 0.75  # width of what the blend looks at round the hole, over the root of the hole's area
    mapped: float = 0.5  # weight of all mapped sources against the surroundings in learning the change of colours
    retarget: int = 32  # px round a source that is hidden or off-screen, searched for another; 0: none
    misfit: float = 25.0  # grey levels, RMS, up to which a patch found there is alike
    donors: int = 8  # views that may lend samples of sources that a view does not show ("sample" only); 0: none


@dataclass(frozen=True)
class Reference:
    """The completed reference view."""

    camera: Camera
    image: np.ndarray  # [H, W, 3] uint8, inpainted
    depth: np.ndarray  # [H, W] float32, completed
    target: np.ndarray  # [H, W] bool, T_0
    source: np.ndarray  # [H, W] bool, pixels that show a photo's unhidden surface
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
    depth_new: np.ndarray  # [H, W] z of the scene with the new surface; used within `near_hole`


Loader = Callable[[], ViewToPaint]  # brings a view into memory; it is let go again once it is painted


@dataclass(frozen=True)
class PaintedView:
    """The part of a view round its painted hole."""

    camera_id: str
    top: int  # row and column of the view where the part begins
    left: int
    image: np.ndarray  # [h, w, 3] uint8, I_t*
    raw: np.ndarray  # [h, w, 3] uint8, before Poisson blending
    rules: np.ndarray  # [h, w] uint8, see Rule
    depth: np.ndarray  # [h, w] z of the scene with the new surface

    def pasted(
        self,
        picture: np.ndarray,  # [H, W, 3] uint8
        part: np.ndarray | None = None,  # [h, w, 3] uint8, e.g. `raw`; default: `image`
    ) -> np.ndarray:
        """The whole view: this part's hole in the picture, [H, W, 3]."""
        whole = picture.copy()
        h, w = self.rules.shape
        place = whole[self.top : self.top + h, self.left : self.left + w]
        there = self.rules != Rule.UNTOUCHED
        place[there] = (self.image if part is None else part)[there]
        return whole

    def rule_map(self, height: int, width: int) -> np.ndarray:
        """The rules in the whole view, [height, width] uint8."""
        whole = np.zeros((height, width), np.uint8)
        h, w = self.rules.shape
        whole[self.top : self.top + h, self.left : self.left + w] = self.rules
        return whole


@dataclass(frozen=True)
class Propagation:
    """Every view painted, in the order given."""

    views: tuple[PaintedView, ...]
    confidence: float
    reason: str


def near_hole(target: np.ndarray, settings: PropagateSettings) -> tuple[slice, slice]:
    """Rows and columns of what is looked at when the target [H, W] bool is painted; empty if that is."""
    if not target.any():
        return slice(0, 0), slice(0, 0)
    return _bounds(target, _reach(target, settings))


def _reach(target: np.ndarray, settings: PropagateSettings) -> int:
    return max(LEAST_REACH, math.ceil(settings.surroundings * math.sqrt(target.sum())))


def propagate(
    reference: Reference,
    views: Sequence[Loader],
    settings: PropagateSettings = PropagateSettings(),
    progress: Progress = silent,
) -> Propagation:
    """Paint the hole of every view by Algorithm 1. Painted views are never sources for others: order is irrelevant.

    As many views are in memory as threads work on them; what is kept of each is the part round its hole.

    Raises
    ------
    BadInput
        If the transfer or the blend is unknown.
    """
    for name, value, known in (("transfer", settings.transfer, TRANSFERS), ("blend", settings.blend, BLENDS)):
        if value not in known:
            raise BadInput(f"propagate: unknown {name} {value!r}; use {', '.join(known)}")
    mapped = _map_of(reference, settings)
    lent = _lent_colours(mapped, views, settings) if settings.transfer == "sample" else ()
    done = 0

    def paint(load: Loader) -> PaintedView:
        nonlocal done
        view = load()
        painted = _paint(mapped, view, lent, settings)
        done += 1
        progress("propagate", done, len(views), view.camera.id)
        return painted

    painted = tuple(parallel_map(paint, views, at_once(reference.target.size)))
    counts = sum((np.bincount(p.rules.ravel(), minlength=len(Rule)) for p in painted), np.zeros(len(Rule), int))
    total = max(1, counts[1:].sum())
    shares = ", ".join(f"{counts[r] / total:.0%} {r.name.lower().replace('_', ' ')}" for r in list(Rule)[1:-1])
    return Propagation(painted, float(1 - counts[Rule.UNREACHED] / total), shares)


@dataclass(frozen=True)
class _Map:
    """The reference and the list of its mapped pixels."""

    reference: Reference
    camera: np.ndarray  # [16], see _pack
    depth: np.ndarray  # [H, W] float32
    rows: np.ndarray  # [M] int32, mapped pixels of T_0
    cols: np.ndarray
    source_rows: np.ndarray  # [M] int32, f
    source_cols: np.ndarray
    index: np.ndarray  # [H, W] int32, each pixel's place in the list; -1 = none
    true: np.ndarray  # [H, W] bool, pixels that show what is there: photo or completed


def _map_of(reference: Reference, settings: PropagateSettings) -> _Map:
    there = reference.target & (reference.rows >= 0) & (settings.transfer != "none")
    rows, cols = (x.astype(np.int32) for x in np.nonzero(there))
    index = np.full(there.shape, -1, np.int32)
    index[rows, cols] = np.arange(len(rows))
    return _Map(
        reference=reference,
        camera=_pack(reference.camera),
        depth=np.ascontiguousarray(reference.depth, np.float32),
        rows=rows,
        cols=cols,
        source_rows=np.ascontiguousarray(reference.rows[rows, cols], np.int32),
        source_cols=np.ascontiguousarray(reference.cols[rows, cols], np.int32),
        index=index,
        true=reference.source | reference.target,
    )


@dataclass(frozen=True)
class _Sources:
    """Where a view shows the patches that explain the mapped pixels."""

    rows: np.ndarray  # [M] int32 in the reference: the field's, or found near it
    cols: np.ndarray
    rules: np.ndarray  # [M] uint8: OWN, RETARGETED, or 0 where the view shows none


@dataclass(frozen=True)
class _Lent:
    """What another view shows of the mapped sources."""

    camera: Camera
    colours: np.ndarray  # [M, 3] float32
    seen: np.ndarray  # [M] bool
    gain: np.ndarray  # [3] its exposure over the reference's


@dataclass(frozen=True)
class _Warp:
    """The reference as a part of a view sees it."""

    colours: np.ndarray  # [h, w, 3] float32
    u: np.ndarray  # [h, w] where it lies in the reference; NaN: the reference does not show it, or nobody asked
    v: np.ndarray

    @property
    def reached(self) -> np.ndarray:
        return ~np.isnan(self.u)

    def lookup(
        self,
        picture: np.ndarray,  # [H, W, ...] of the reference
        where: np.ndarray,  # [h, w] bool, reached
    ) -> np.ndarray:
        """The picture's values at those pixels, [N, ...]."""
        return picture[self.v[where].astype(int), self.u[where].astype(int)]


def _paint(mapped: _Map, view: ViewToPaint, lent: Sequence[_Lent], settings: PropagateSettings) -> PaintedView:
    if not view.target.any():
        nothing = np.zeros((0, 0, 3), np.uint8)
        return PaintedView(view.camera.id, 0, 0, nothing, nothing, nothing[..., 0], np.zeros((0, 0), np.float32))
    reach = _reach(view.target, settings)
    near, top, left = _cropped(view, reach)
    same = _same_surface(near, settings)
    evidence = near.target & same & ~near.silhouette  # what the removed Gaussians show, such as a shadow, is none
    hole = near.target & ~evidence
    base = np.where(evidence[..., None], near.image, near.base)
    distance = cv2.distanceTransform((~hole).astype(np.uint8), cv2.DIST_L2, 5)
    photo = ~near.silhouette & same & ~hole & (distance <= reach)
    depth = smooth_depth(near.depth_new, settings.smooth_tolerance)
    warp = _warp(mapped, near.camera, depth, hole | photo, settings)
    painted, photo = hole & warp.reached, photo & warp.reached
    photo[photo] = warp.lookup(mapped.true, photo)
    sources = _find_sources(mapped, view, settings)
    rules = _rules_of(mapped, sources, warp, hole)
    raw, change = warp.colours, NO_CHANGE
    if settings.transfer == "sample":
        raw, rules = _sample(mapped, view, sources, lent, warp, rules, settings)
    elif settings.transfer == "learned":
        alike = photo & _flat(depth, settings.seam)
        alike[alike] = warp.lookup(mapped.reference.source, alike)
        change = _learn(mapped, view, sources, warp.colours, base - warp.colours, alike, hole, reach, settings)
        raw = warp.colours + change.of(warp.colours).astype(np.float32)
    if settings.blend == "rim":
        blended = blend_rim(base, raw, painted, (hole & ~painted) | near.silhouette, depth, settings)
    else:
        width = BAND * reach
        blended = blend_band(base, raw, painted, photo, width, depth, change.offset, settings)
    rules[near.target & evidence] = Rule.EVIDENCE
    rows, cols = _bounds(near.target, 0)
    return PaintedView(
        view.camera.id,
        top + rows.start,
        left + cols.start,
        blended[rows, cols].copy(),
        _to_bytes(np.where(painted[..., None], raw, base)[rows, cols]),
        rules[rows, cols].copy(),
        near.depth_new[rows, cols].astype(np.float32),
    )


def _cropped(view: ViewToPaint, margin: int) -> tuple[ViewToPaint, int, int]:
    """The part of the view round its target, which is not empty, and where it begins."""
    rows, cols = _bounds(view.target, margin)
    arrays = {
        name: getattr(view, name)[rows, cols]
        for name in ("image", "base", "silhouette", "target", "depth_before", "depth_new")
    }
    c = view.camera
    height, width = arrays["target"].shape
    camera = replace(c, width=width, height=height, cx=c.cx - cols.start, cy=c.cy - rows.start)
    return ViewToPaint(camera, **arrays), rows.start, cols.start


def _bounds(mask: np.ndarray, margin: int) -> tuple[slice, slice]:
    """Rows and columns that hold the mask, which is not empty, and a margin."""
    there = (np.flatnonzero(mask.any(1 - axis)) for axis in (0, 1))
    rows, cols = (slice(max(0, int(x[0]) - margin), int(x[-1]) + margin + 1) for x in there)
    return rows, cols


def _same_surface(view: ViewToPaint, settings: PropagateSettings) -> np.ndarray:
    """[H, W] bool: the photo's surface is the new one."""
    near = np.abs(view.depth_before - view.depth_new) < settings.evidence_tolerance * view.depth_new
    return (view.depth_before > 0) & (view.depth_new > 0) & near


def smooth_depth(
    depth: np.ndarray,  # [H, W] z, 0 = nothing
    tolerance: float,  # relative
) -> np.ndarray:
    """[H, W] float32: the depth of splats without their noise, which makes a warp's samples jump.

    Disparities are averaged over 5 × 5 pixels by symmetric pairs of one surface: exact on planes, nothing at edges.
    """
    depth = np.ascontiguousarray(depth, np.float32)
    out = depth.copy()
    run_ranges(_smooth_range, depth.shape[0], depth, tolerance, out)
    return out


def _warp(mapped: _Map, camera: Camera, depth: np.ndarray, wanted: np.ndarray, settings: PropagateSettings) -> _Warp:
    rows, cols = np.nonzero(wanted)
    colours = np.zeros((*wanted.shape, 3), np.float32)
    u, v = np.full((2, *wanted.shape), np.nan)
    run_ranges(
        _warp_range,
        len(rows),
        rows,
        cols,
        _pack(camera),
        depth,
        mapped.camera,
        mapped.depth,
        mapped.reference.image,
        settings.depth_tolerance,
        colours,
        u,
        v,
    )
    return _Warp(colours, u, v)


def _find_sources(mapped: _Map, view: ViewToPaint, settings: PropagateSettings) -> _Sources:
    """The mapped sources as far as the view shows them, retargeted by local search where it does not.

    Patches are compared in the reference, where one camera sees both; the view only says which of them it shows.
    """
    rows, cols = mapped.source_rows.copy(), mapped.source_cols.copy()
    rules = np.zeros(len(rows), np.uint8)
    run_ranges(
        _find_range,
        len(rows),
        mapped.rows,
        mapped.cols,
        mapped.camera,
        mapped.depth,
        mapped.reference.image,
        mapped.reference.source,
        _pack(view.camera),
        np.ascontiguousarray(view.depth_before, np.float32),
        view.silhouette,
        settings.depth_tolerance,
        settings.patch // 2,
        settings.retarget,
        3 * settings.misfit**2,
        rows,
        cols,
        rules,
    )
    return _Sources(rows, cols, rules)


def _rules_of(mapped: _Map, sources: _Sources, warp: _Warp, hole: np.ndarray) -> np.ndarray:
    """[h, w] uint8: the rule of each pixel of the hole by the source of the reference pixel that it shows."""
    rules = np.where(hole, Rule.UNREACHED, Rule.UNTOUCHED).astype(np.uint8)
    reached = hole & warp.reached
    listed = warp.lookup(mapped.index, reached)
    found = np.append(sources.rules, 0)[listed]  # -1, which is not in the list, is the last
    rules[reached] = np.where(found > 0, found, Rule.REFERENCE)
    return rules


def _learn(
    mapped: _Map,
    view: ViewToPaint,
    sources: _Sources,
    warped: np.ndarray,  # [h, w, 3]
    difference: np.ndarray,  # [h, w, 3], the view less the warped reference
    alike: np.ndarray,  # [h, w] bool, pixels round the hole that both show
    hole: np.ndarray,  # [h, w] bool
    reach: int,
    settings: PropagateSettings,
) -> ColourChange:
    """How colours change from the reference to this view, by what both show round the hole and of mapped sources.

    What depends on the place (a highlight) comes into the hole from its rim, by the blend; what depends on the colour,
    hence on the material and on the exposure, is learned.
    """
    count = int(alike.sum())
    if not count:
        return NO_CHANGE
    rows, cols = (x[:: -(-count // MOST_PAIRS)] for x in np.nonzero(alike))
    radius = max(1, round(SMOOTHING * reach))
    colours, change = (_blurred(x, alike, radius)[rows, cols] for x in (warped, difference))
    places, weights = _sector(rows, cols, hole), np.ones(len(rows))
    patches, patch_colours, patch_change = _mean_patches(mapped, view, sources, settings)
    if len(patches) and settings.mapped > 0:
        colours, change = np.concatenate([colours, patch_colours]), np.concatenate([change, patch_change])
        beyond = _sector(sources.rows[patches], sources.cols[patches], mapped.index >= 0)
        places = np.concatenate([places, SECTORS + beyond])
        weights = np.concatenate([weights, np.full(len(patches), settings.mapped * len(rows) / len(patches))])
    return learn_change(colours, change, places, weights)


def _sector(rows: np.ndarray, cols: np.ndarray, region: np.ndarray) -> np.ndarray:
    """[N] int: in which direction pixels lie as seen from the region's centre."""
    centre = [x.mean() for x in np.nonzero(region)]
    angle = np.arctan2(rows - centre[0], cols - centre[1]) / (2 * np.pi) + 0.5
    return (SECTORS * angle).astype(int) % SECTORS


def _flat(depth: np.ndarray, seam: float) -> np.ndarray:
    """[h, w] bool: pixels beside no depth edge, where photos do not mix surfaces."""
    nearest = cv2.erode(np.where(depth > 0, depth, 0).astype(np.float32), SQUARE)
    return (cv2.dilate(depth, SQUARE) - nearest) < seam * depth


def _blurred(values: np.ndarray, where: np.ndarray, radius: int) -> np.ndarray:
    """The values' means over the pixels `where` of a square, [h, w, 3]."""
    side = (2 * radius + 1, 2 * radius + 1)
    weight = cv2.blur(where.astype(np.float32), side)
    total = cv2.blur((values * where[..., None]).astype(np.float32), side)
    return total / np.maximum(weight, 1e-6)[..., None]


def _mean_patches(
    mapped: _Map, view: ViewToPaint, sources: _Sources, settings: PropagateSettings
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Some of the sources that the view shows [K], their patches' mean colours in the reference and change [K, 3]."""
    shown = np.flatnonzero(sources.rules)
    shown = shown[:: max(1, -(-len(shown) // MOST_PATCHES))]
    colours, change = np.zeros((2, len(shown), 3))
    run_ranges(
        _mean_range,
        len(shown),
        sources.rows[shown],
        sources.cols[shown],
        mapped.camera,
        mapped.depth,
        mapped.reference.image,
        mapped.reference.source,
        _pack(view.camera),
        np.ascontiguousarray(view.depth_before, np.float32),
        view.silhouette,
        view.image,
        settings.depth_tolerance,
        settings.patch // 2,
        colours,
        change,
    )
    return shown, colours, change


def _sample(
    mapped: _Map,
    view: ViewToPaint,
    sources: _Sources,
    lent: Sequence[_Lent],
    warp: _Warp,
    rules: np.ndarray,
    settings: PropagateSettings,
) -> tuple[np.ndarray, np.ndarray]:
    """Algorithm 1's sampling: colours [h, w, 3] float32 and rules [h, w] of the hole."""
    borrowed, has = _borrowed(mapped, view, sources, lent, settings)
    raw, rules = warp.colours.copy(), rules.copy()
    rows, cols = np.nonzero(warp.reached & (rules > 0))
    run_ranges(
        _sample_range,
        len(rows),
        rows,
        cols,
        warp.u,
        warp.v,
        mapped.index,
        mapped.camera,
        mapped.depth,
        mapped.reference.source,
        sources.rows,
        sources.cols,
        sources.rules,
        _pack(view.camera),
        np.ascontiguousarray(view.depth_before, np.float32),
        view.silhouette,
        view.image,
        borrowed,
        has,
        settings.depth_tolerance,
        settings.patch // 2,
        raw,
        rules,
    )
    return raw, rules


def _borrowed(
    mapped: _Map, view: ViewToPaint, sources: _Sources, lent: Sequence[_Lent], settings: PropagateSettings
) -> tuple[np.ndarray, np.ndarray]:
    """[M, 3] colours of the sources by the nearest view that shows them, at this view's exposure; [M] bool: there."""
    colours, has = np.zeros((len(sources.rows), 3), np.float32), np.zeros(len(sources.rows), bool)
    others = sorted(
        (x for x in lent if x.camera.id != view.camera.id),
        key=lambda x: (float(np.linalg.norm(x.camera.centre - view.camera.centre)), x.camera.id),
    )
    gain = _lend(mapped, view, settings).gain if others else np.ones(3)
    for other in others:
        new = other.seen & (sources.rules == 0) & ~has
        colours[new] = other.colours[new] * (gain / other.gain)
        has |= new
    return colours, has


def _lent_colours(mapped: _Map, views: Sequence[Loader], settings: PropagateSettings) -> tuple[_Lent, ...]:
    """A few views' pixels at the mapped sources, for views that do not show them."""
    count = min(settings.donors, len(views))
    chosen = [views[k * len(views) // count] for k in range(count)]
    return tuple(parallel_map(lambda load: _lend(mapped, load(), settings), chosen))


def _lend(mapped: _Map, view: ViewToPaint, settings: PropagateSettings) -> _Lent:
    own = _find_sources(mapped, view, replace(settings, retarget=0))
    seen = own.rules > 0
    reference, camera = mapped.reference.camera, view.camera
    uv = np.stack([mapped.source_cols + 0.5, mapped.source_rows + 0.5], -1)[seen]
    z = mapped.depth[mapped.source_rows, mapped.source_cols][seen].astype(np.float64)
    x, y = (camera.project(reference.unproject(uv, z))[0].astype(np.float32) - 0.5).T.reshape(2, -1, 1)
    colours = np.zeros((len(seen), 3), np.float32)
    if seen.any():
        colours[seen] = _remap(view.image, x, y)
    before = mapped.reference.image[mapped.source_rows, mapped.source_cols][seen]
    return _Lent(camera, colours, seen, exposure_gain(before, colours[seen]))


def _remap(image: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """[N, 3] bilinear samples; OpenCV takes at most 32,767 rows at once."""
    parts = [
        cv2.remap(image, x[k : k + 32000], y[k : k + 32000], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)[:, 0]
        for k in range(0, len(x), 32000)
    ]
    return np.concatenate(parts)


def blend_rim(
    base: np.ndarray,  # [H, W, 3] uint8, the view round the hole
    raw: np.ndarray,  # [H, W, 3] float32, the fill
    painted: np.ndarray,  # [H, W] bool, where the fill is
    no_photo: np.ndarray,  # [H, W] bool, what bounds no fill: the rest of the hole, renderings of the emptied scene
    depth: np.ndarray,  # [H, W] z of the new scene
    settings: PropagateSettings,
) -> np.ndarray:
    """The paper's blend: gradients of the fill, its rim as in the view, [H, W, 3] uint8.

    The rim counts only where no depth seam parts it from the fill. Parts without a rim keep their own colours.
    """
    if not painted.any():
        return base.copy()
    rim = (cv2.dilate(painted.astype(np.uint8), SQUARE) > 0) & ~painted & ~no_photo & (depth > 0)
    nearest_fill = cv2.dilate(np.where(painted & (depth > 0), depth, 0).astype(np.float32), SQUARE)
    rim &= np.abs(nearest_fill - depth) < settings.seam * depth
    solution = solve_poisson(painted, rim, base, np.where(painted[..., None], raw, np.nan).astype(np.float32))
    result = base.copy()
    anchored = painted & ~solution.unanchored
    result[anchored] = _to_bytes(solution.values[anchored])
    free = painted & solution.unanchored
    result[free] = _to_bytes(raw[free])
    return result


def blend_band(
    base: np.ndarray,  # [H, W, 3] uint8, the view round the hole
    raw: np.ndarray,  # [H, W, 3] float32, the fill, in the hole and in the band
    painted: np.ndarray,  # [H, W] bool, where the fill is to be seen
    band: np.ndarray,  # [H, W] bool, photo round the hole that the fill must fit
    width: float,  # px over which the correction follows the photo; farther away it counts less
    depth: np.ndarray,  # [H, W] z of the new scene
    offset: np.ndarray,  # [3] level of parts that no band touches
    settings: PropagateSettings,
) -> np.ndarray:
    """The fill with a smooth correction c that fits it to the band, [H, W, 3] uint8.

    Minimises Σ |∇c|² + Σ_band w (c − mismatch)² + h Σ (c − level)²: Poisson blending (guidance: the fill's gradients)
    with a soft boundary. A rim of single pixels would carry each one's texture and misregistration into the hole: all
    photo round it is asked, and w is less where it is farther away, and where the mismatch is not like most. The weak
    hold h lets what few pixels say fade with the distance. Depth seams stop the correction.
    """
    result = base.copy()
    if not painted.any():
        return result
    distance = cv2.distanceTransform((~painted).astype(np.uint8), cv2.DIST_L2, 5)
    near = distance <= FAR * width
    whole = near & (painted | band | (depth > 0))  # the correction passes what lies between
    domain = whole & ~_behind_seams(whole, depth, settings.seam)
    data = band & domain
    mismatch = np.where(data[..., None], base - raw, 0)
    level = _levels(domain, data, mismatch, offset)
    weight, hold = 2 / width**2 * np.zeros(data.shape), (HOLD / width) ** 2
    if data.any():  # where the two show different things, the difference is none of light
        nearness = 1 / (1 + (distance[data] / width) ** 2)
        weight[data] = 2 / width**2 * nearness * biweight((mismatch - level)[data])
    anchor = (weight[..., None] * mismatch + hold * level) / (weight + hold)[..., None]
    correction = solve_poisson(
        domain, np.zeros_like(domain), np.zeros_like(mismatch), weight=weight + hold, anchor=anchor
    ).values
    correction[~domain] = offset
    _continue_over(painted & ~domain, domain, depth, settings.seam, correction)
    result[painted] = _to_bytes(raw[painted] + correction[painted])
    return result


def _levels(domain: np.ndarray, data: np.ndarray, values: np.ndarray, otherwise: np.ndarray) -> np.ndarray:
    """[H, W, 3]: the median of each connected part's data, where there are enough of them."""
    level = np.broadcast_to(otherwise, values.shape).astype(np.float64)
    _, parts = cv2.connectedComponents(domain.astype(np.uint8), connectivity=4)
    found, counts = np.unique(parts[data], return_counts=True)
    for part in found[counts >= LEAST_BAND]:
        inside = parts == part
        level[inside] = np.median(values[inside & data], axis=0)
    return level


def _behind_seams(region: np.ndarray, depth: np.ndarray, seam: float) -> np.ndarray:
    """[H, W] bool: pixels that lie behind a neighbour of the region by a step. Without them nothing crosses a seam."""
    behind = np.zeros_like(region)
    for a, b in ((np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1], np.s_[1:])):
        both = region[a] & region[b]
        step = depth[b] - depth[a]
        parted = both & (np.abs(step) > seam * np.minimum(depth[a], depth[b]))
        behind[b] |= parted & (step > 0)
        behind[a] |= parted & (step < 0)
    return behind


def _continue_over(left_out: np.ndarray, known: np.ndarray, depth: np.ndarray, seam: float, values: np.ndarray) -> None:
    """Give pixels that were left out at a seam the mean value [H, W, 3] of their own surface beside them."""
    rows, cols = np.nonzero(left_out)
    total, count = np.zeros((len(rows), 3)), np.zeros(len(rows))
    for dy, dx in ((-1, -1), (-1, 0), (-1, 1), (0, -1), (0, 1), (1, -1), (1, 0), (1, 1)):
        i, j = np.clip(rows + dy, 0, depth.shape[0] - 1), np.clip(cols + dx, 0, depth.shape[1] - 1)
        here, there = depth[rows, cols], depth[i, j]
        same = known[i, j] & (np.abs(here - there) < seam * np.minimum(here, there))
        total[same] += values[i[same], j[same]]
        count += same
    found = count > 0
    values[rows[found], cols[found]] = total[found] / count[found, None]


def _to_bytes(colours: np.ndarray) -> np.ndarray:
    return np.clip(np.rint(np.nan_to_num(colours)), 0, 255).astype(np.uint8)


def _pack(camera: Camera) -> np.ndarray:
    """Rotation (9), translation (3), fx fy cx cy as one float64 vector for the kernels."""
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
def _framed(u, v, h, w):
    return u >= 0 and v >= 0 and u < w and v < h


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


@kernel
def _smooth_range(lo, hi, depth, tolerance, out):
    """Rows lo … hi−1."""
    h, w = depth.shape
    for i in range(lo, hi):
        for j in range(w):
            if depth[i, j] <= 0:
                continue
            here = 1.0 / depth[i, j]
            total, count = here, 1.0
            for k in range(13, 25):  # half of the 5 × 5 neighbours, each with its mirror image
                dy, dx = k // 5 - 2, k % 5 - 2
                a, b, c, d = i + dy, j + dx, i - dy, j - dx
                if a < 0 or b < 0 or c < 0 or d < 0 or a >= h or b >= w or c >= h or d >= w:
                    continue
                if depth[a, b] <= 0 or depth[c, d] <= 0:
                    continue
                one, other = 1.0 / depth[a, b], 1.0 / depth[c, d]
                allowed = tolerance * here * (abs(dy) + abs(dx))
                if abs(one - here) < allowed and abs(other - here) < allowed:
                    total += one + other
                    count += 2.0
            out[i, j] = count / total


@kernel
def _warp_range(
    lo,
    hi,
    rows,  # [N] pixels of the view's part
    cols,
    camera,  # [16] of the part
    depth,  # [h, w]
    ref,  # [16]
    ref_depth,  # [H, W]
    ref_image,  # [H, W, 3]
    tolerance,
    colours,  # [h, w, 3] out
    u,  # [h, w] out, place in the reference
    v,
):
    """Pixels lo … hi−1: bilinear samples of those reference pixels that show the same surface."""
    h0, w0 = ref_depth.shape
    for k in range(lo, hi):
        i, j = rows[k], cols[k]
        z = float(depth[i, j])
        if z <= 0:
            continue
        x, y, zw = _unproject(camera, j + 0.5, i + 0.5, z)
        u0, v0, z0 = _project(ref, x, y, zw)
        if not _framed(u0, v0, h0, w0):
            continue
        i0, j0 = int(v0), int(u0)
        if abs(ref_depth[i0, j0] - z0) > tolerance * z0:
            continue
        a, b = math.floor(v0 - 0.5), math.floor(u0 - 0.5)
        t, s = v0 - 0.5 - a, u0 - 0.5 - b
        total, sum0, sum1, sum2 = 0.0, 0.0, 0.0, 0.0
        for tap in range(4):
            p, q = a + tap // 2, b + tap % 2
            if p < 0 or q < 0 or p >= h0 or q >= w0:
                continue
            if abs(ref_depth[p, q] - z0) > 2 * tolerance * z0:
                continue
            weight = (t if tap // 2 else 1 - t) * (s if tap % 2 else 1 - s) + 1e-6
            total += weight
            sum0 += weight * ref_image[p, q, 0]
            sum1 += weight * ref_image[p, q, 1]
            sum2 += weight * ref_image[p, q, 2]
        colours[i, j, 0], colours[i, j, 1], colours[i, j, 2] = sum0 / total, sum1 / total, sum2 / total
        u[i, j], v[i, j] = u0, v0


@inline_kernel
def _shown(u, v, ref, ref_depth, ref_source, camera, depth_before, silhouette, tolerance):
    """Where the view shows the reference's point at (u, v), and whether it does."""
    h0, w0 = ref_depth.shape
    h, w = depth_before.shape
    ut, vt, good = 0.0, 0.0, False
    if _framed(u, v, h0, w0):
        a, b = int(v), int(u)
        z = float(ref_depth[a, b])
        if z > 0 and ref_source[a, b]:
            x, y, zw = _unproject(ref, u, v, z)
            ut, vt, zt = _project(camera, x, y, zw)
            if _framed(ut, vt, h, w):
                i, j = int(vt), int(ut)
                good = not silhouette[i, j] and abs(depth_before[i, j] - zt) <= tolerance * zt
    return ut, vt, good


@inline_kernel
def _patch_misfit(image, source, i, j, a, b, radius, worst):
    """Mean squared difference (over pixels, summed over channels) of the patches at (i, j) and (a, b)."""
    h, w = source.shape
    total, count = 0.0, 0
    for dy in range(-radius, radius + 1):
        for dx in range(-radius, radius + 1):
            p, q, r, s = i + dy, j + dx, a + dy, b + dx
            if p < 0 or q < 0 or r < 0 or s < 0 or p >= h or q >= w or r >= h or s >= w or not source[r, s]:
                continue
            for channel in range(3):
                difference = float(image[p, q, channel]) - float(image[r, s, channel])
                total += difference * difference
            count += 1
    return total / count if 2 * count > (2 * radius + 1) ** 2 else worst


@kernel
def _find_range(
    lo,
    hi,
    rows,  # [M] mapped pixels
    cols,
    ref,
    ref_depth,
    ref_image,
    ref_source,
    camera,
    depth_before,
    silhouette,
    tolerance,
    radius,  # of patches
    reach,  # px of the search
    worst,  # misfit from which a patch is not alike
    source_rows,  # [M] in: the field; out: what is used
    source_cols,
    rules,  # [M] out
):
    for k in range(lo, hi):
        i, j, a, b = rows[k], cols[k], source_rows[k], source_cols[k]
        _, _, good = _shown(b + 0.5, a + 0.5, ref, ref_depth, ref_source, camera, depth_before, silhouette, tolerance)
        if good:
            rules[k] = OWN
            continue
        best, found_a, found_b = worst, -1, -1
        step = 2
        while step <= reach:  # eight directions, ever farther out
            for direction in range(9):
                p, q = a + step * (direction // 3 - 1), b + step * (direction % 3 - 1)
                _, _, good = _shown(
                    q + 0.5, p + 0.5, ref, ref_depth, ref_source, camera, depth_before, silhouette, tolerance
                )
                if good:
                    misfit = _patch_misfit(ref_image, ref_source, i, j, p, q, radius, worst)
                    if misfit < best:
                        best, found_a, found_b = misfit, p, q
            step *= 2
        if found_a < 0:
            continue
        step = reach // 4
        while step >= 1:  # then finer round the best
            centre_a, centre_b = found_a, found_b
            for direction in range(9):
                p, q = centre_a + step * (direction // 3 - 1), centre_b + step * (direction % 3 - 1)
                _, _, good = _shown(
                    q + 0.5, p + 0.5, ref, ref_depth, ref_source, camera, depth_before, silhouette, tolerance
                )
                if good:
                    misfit = _patch_misfit(ref_image, ref_source, i, j, p, q, radius, worst)
                    if misfit < best:
                        best, found_a, found_b = misfit, p, q
            step //= 2
        source_rows[k], source_cols[k], rules[k] = found_a, found_b, RETARGETED


@kernel
def _mean_range(
    lo,
    hi,
    rows,  # [K] sources
    cols,
    ref,
    ref_depth,
    ref_image,
    ref_source,
    camera,
    depth_before,
    silhouette,
    image,
    tolerance,
    radius,
    colours,  # [K, 3] out
    change,  # [K, 3] out
):
    for k in range(lo, hi):
        count = 0.0
        for dy in range(-radius, radius + 1):
            for dx in range(-radius, radius + 1):
                a, b = rows[k] + dy, cols[k] + dx
                ut, vt, good = _shown(
                    b + 0.5, a + 0.5, ref, ref_depth, ref_source, camera, depth_before, silhouette, tolerance
                )
                if good:
                    count += 1.0
                    for channel in range(3):
                        colours[k, channel] += ref_image[a, b, channel]
                        change[k, channel] += _bilinear(image, ut, vt, channel) - ref_image[a, b, channel]
        for channel in range(3):
            colours[k, channel] /= count  # not 0: the patch's centre is shown
            change[k, channel] /= count


@kernel
def _sample_range(
    lo,
    hi,
    rows,  # [N] pixels of the view's part that the reference reaches
    cols,
    u,  # [h, w] their places in the reference
    v,
    index,  # [H, W] of mapped pixels in the lists
    ref,
    ref_depth,
    ref_source,
    source_rows,  # [M]
    source_cols,
    source_rules,
    camera,
    depth_before,
    silhouette,
    image,
    borrowed,  # [M, 3]
    has,  # [M]
    tolerance,
    radius,
    raw,  # [h, w, 3] in: the warped reference; out: the samples
    rules,  # [h, w] in and out
):
    h0, w0 = ref_depth.shape
    for k in range(lo, hi):
        i, j = rows[k], cols[k]
        u0, v0 = float(u[i, j]), float(v[i, j])
        i0, j0 = int(v0), int(u0)
        z0 = float(ref_depth[i0, j0])
        total, sum0, sum1, sum2 = 0.0, 0.0, 0.0, 0.0
        for dy in range(-radius, radius + 1):
            for dx in range(-radius, radius + 1):
                a, b = i0 + dy, j0 + dx
                if a < 0 or b < 0 or a >= h0 or b >= w0 or index[a, b] < 0:
                    continue
                m = index[a, b]
                if source_rules[m] == 0 or abs(ref_depth[a, b] - z0) > 2 * tolerance * z0:
                    continue
                # the patch at (a, b) explains this pixel by its source at the same place within the patch
                uq, vq = source_cols[m] - dx + (u0 - j0), source_rows[m] - dy + (v0 - i0)
                ut, vt, good = _shown(uq, vq, ref, ref_depth, ref_source, camera, depth_before, silhouette, tolerance)
                if not good:
                    continue
                weight = math.exp(-0.5 * (dx * dx + dy * dy))
                total += weight
                sum0 += weight * _bilinear(image, ut, vt, 0)
                sum1 += weight * _bilinear(image, ut, vt, 1)
                sum2 += weight * _bilinear(image, ut, vt, 2)
        here = index[i0, j0]
        if total > 0:
            raw[i, j, 0], raw[i, j, 1], raw[i, j, 2] = sum0 / total, sum1 / total, sum2 / total
            if rules[i, j] == REFERENCE:
                rules[i, j] = OWN  # explained by its neighbours' patches
        elif here >= 0 and has[here]:
            raw[i, j, 0], raw[i, j, 1], raw[i, j, 2] = borrowed[here, 0], borrowed[here, 1], borrowed[here, 2]
            rules[i, j] = OTHER
        else:
            rules[i, j] = REFERENCE
