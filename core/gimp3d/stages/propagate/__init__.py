"""From the reference into every view, by each view's own pixels (paper Algorithm 1; docs/method.md).

`warp` finds where the surface that a view shows lies in the reference; its colours are fitted to the photo round the
hole by Poisson blending with a soft boundary. The paper (eq. 9) blends to the rim, and takes colours as in `paper`.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import fields

import cv2
import numpy as np

from ...compute.threads import at_once, parallel_map
from ...errors import BadInput
from ...geometry import EVIDENCE_DEPTH, bounds, cropped, dilated, same_surface
from ...progress import Progress, silent
from ...solvers.poisson import solve_poisson
from ...solvers.robust import biweight
from .detail import ROUND, as_drawn
from .paper import MappingField, Sampler
from .warp import Loader, PaintedView, PropagateSettings, Propagation, Reference, Rule, ViewToPaint, warp_reference

SURROUNDINGS = 0.75  # width of what is looked at round the hole, over the root of the hole's area
LEAST_REACH = 16  # px of that
BAND = 1 / 8  # of that: the strip round the hole that the blend is fitted to most
SEAM = 0.05  # relative depth step between neighbours that parts two surfaces: 2.5 times what depths scatter by
LEAST_BAND = 20  # px of photo that tell the level of a part
HOLD = 1 / 16  # weight that holds a correction at its level where no photo is near; over the root of the band's weight
TOLERANCES = 4.0, 2.0, 1.0  # of a mismatch, round by round
LOCAL = 2.0  # widths of the band, σ of the neighbourhood that tells what is usual
CELLS = 4.0  # to a σ, in which it is blurred
LEAST_COUNT = 1e-3  # share of a neighbourhood from which on it tells
FAR = 4  # widths of the band within which photo still tells
SQUARE = np.ones((3, 3), np.uint8)


def near_hole(target: np.ndarray) -> tuple[slice, slice]:
    """Rows and columns of what is looked at when the target [H, W] bool is painted; empty if that is."""
    return bounds(target, _reach(target))


def round_hole(target: np.ndarray, silhouette: np.ndarray) -> np.ndarray:
    """[H, W] bool: where a view tells how sharply the scene is drawn, of its target and object, [H, W] bool each."""
    return dilated(target, ROUND) & ~silhouette


def _reach(target: np.ndarray) -> int:
    return max(LEAST_REACH, math.ceil(SURROUNDINGS * math.sqrt(target.sum())))


def propagate(
    reference: Reference,
    views: Sequence[Loader],
    settings: PropagateSettings = PropagateSettings(),
    progress: Progress = silent,
    sources: MappingField | None = None,
) -> Propagation:
    """Paint the hole of every view. Painted views are never sources for others: order is irrelevant.

    `sources` are of the reference's target pixels: only the paper's sampling asks for them. As many views are in memory
    as threads work on them, and of each the part round its hole is kept.

    Raises
    ------
    BadInput
        If the transfer or the blend is unknown.
    """
    for name, known in (("transfer", ("warp", "sample")), ("blend", ("band", "rim"))):
        if (value := getattr(settings, name)) not in known:
            raise BadInput(f"propagate: unknown {name} {value!r}; use {', '.join(known)}")
    sample = Sampler(reference, sources, views, settings) if sources and settings.transfer == "sample" else None
    done = itertools.count(1)

    def paint(load: Loader) -> PaintedView:
        view = load()
        painted = _painted(reference, view, sample, settings)
        progress("propagate", next(done), len(views), view.camera.id)
        return painted

    painted = tuple(parallel_map(paint, views, at_once(reference.target.size)))
    counts = sum((np.bincount(p.rules.ravel(), minlength=len(Rule)) for p in painted), np.zeros(len(Rule), int))
    total = max(1, counts[1:].sum())
    shares = ", ".join(f"{counts[r] / total:.0%} {r.name.lower().replace('_', ' ')}" for r in list(Rule)[1:-1])
    return Propagation(painted, float(1 - counts[Rule.UNREACHED] / total), shares)


def _painted(
    reference: Reference, view: ViewToPaint, sample: Sampler | None, settings: PropagateSettings
) -> PaintedView:
    """One view: what of it is photo of the new surface, the rest warped and blended."""
    reach, part = _reach(view.target), near_hole(view.target)
    if not view.target.any():
        nothing = np.zeros((0, 0, 3), np.uint8)
        return PaintedView(view.camera, 0, 0, nothing, nothing, nothing[..., 0], np.zeros((0, 0), np.float32))
    near = ViewToPaint(cropped(view.camera, part), *(getattr(view, f.name)[part] for f in fields(view)[1:]))
    same = same_surface(near.depth_before, near.depth_new, EVIDENCE_DEPTH)  # the photo's surface is the new one
    evidence = near.target & same & ~near.silhouette  # what the removed Gaussians show, such as a shadow, is none
    hole = near.target & ~evidence
    base = np.where(evidence[..., None], near.image, near.base)
    distance = cv2.distanceTransform((~hole).astype(np.uint8), cv2.DIST_L2, 5)
    photo = ~near.silhouette & same & ~hole & (distance <= reach)
    depth = np.ascontiguousarray(near.depth_new, np.float32)
    warp = warp_reference(reference, near.camera, depth, hole | photo)
    reached = ~np.isnan(warp.u)
    painted, photo = hole & reached, photo & reached
    photo[photo] = warp.lookup(reference.source | reference.target, photo)
    rules = np.where(hole, Rule.UNREACHED, Rule.UNTOUCHED).astype(np.uint8)
    rules[painted] = Rule.REFERENCE if sample else Rule.OWN_PIXELS
    if sample:
        sample(view, warp, rules)
    raw, blended = warp.colours, base
    if settings.blend == "band":
        beside = photo & round_hole(near.target, near.silhouette)
        raw = as_drawn(raw, painted | photo, near.image, near.drawn, beside)
    if painted.any() and settings.blend == "rim":
        blended = blend_rim(base, raw, painted, (hole & ~painted) | near.silhouette, depth)
    elif painted.any():
        blended = blend_band(base, raw, painted, photo, BAND * reach, depth)
    rules[evidence] = Rule.EVIDENCE
    hole_alone = bounds(near.target)
    unblended = to_bytes(np.where(painted[..., None], raw, base)[hole_alone])
    shown, told, new_depth = (a[hole_alone].copy() for a in (blended, rules, depth))
    top, left = (s.start for s in bounds(view.target))
    return PaintedView(view.camera, top, left, shown, unblended, told, new_depth)


def blend_band(
    base: np.ndarray,  # [H, W, 3] uint8, the view round the hole
    raw: np.ndarray,  # [H, W, 3] float32, the fill, in the hole and in the band
    painted: np.ndarray,  # [H, W] bool, where the fill is to be seen; somewhere it is
    band: np.ndarray,  # [H, W] bool, photo round the hole that the fill must fit
    width: float,  # px over which the correction follows the photo; farther away it counts less
    depth: np.ndarray,  # [H, W] z of the new scene
) -> np.ndarray:
    """The fill with a smooth correction c that fits it to the band, [H, W, 3] uint8.

    Minimises Σ |∇c|² + Σ_band w (c − mismatch)² + h Σ (c − level)²: Poisson blending (guidance: the fill's gradients)
    with a soft boundary. A rim of single pixels would carry each one's texture and misregistration into the hole: all
    photo round it is asked, and w is less where it is farther away, and where the mismatch is not like the others near
    by (reweighted least squares: Holland and Welsch 1977). The weak hold h lets what few pixels say fade with the
    distance. Depth seams stop the correction.
    """
    result = base.copy()
    distance = cv2.distanceTransform((~painted).astype(np.uint8), cv2.DIST_L2, 5)
    near = distance <= FAR * width
    whole = near & (painted | band | (depth > 0))  # the correction passes what lies between
    joined = whole & ~_behind_seams(painted | band, depth)
    _, parts = cv2.connectedComponents(joined.astype(np.uint8), connectivity=4)
    parts[~np.isin(parts, parts[dilated(painted, 1)])] = 0  # what the fill does not touch has no say
    domain = parts > 0
    data = band & domain
    mismatch = np.where(data[..., None], base - raw, 0)
    level = _levels(parts, data, mismatch)
    weight, hold = np.zeros(data.shape), (HOLD / width) ** 2
    if data.any():  # where the two show different things, the difference is none of light
        nearness = 1 / (1 + (distance[data] / width) ** 2)
        weight[data] = 2 / width**2 * nearness * _alike(mismatch, level, data, LOCAL * width)
    anchor = (weight[..., None] * mismatch + hold * level) / (weight + hold)[..., None]
    no, flat = np.zeros_like(domain), np.zeros_like(mismatch)
    correction = solve_poisson(domain, no, flat, weight=weight + hold, anchor=anchor).values
    correction[~domain] = 0
    _continue_over(painted & ~domain, domain, depth, correction)
    result[painted] = to_bytes(raw[painted] + correction[painted])
    return result


def blend_rim(
    base: np.ndarray, raw: np.ndarray, painted: np.ndarray, no_photo: np.ndarray, depth: np.ndarray
) -> np.ndarray:
    """The paper's blend, [H, W, 3] uint8: gradients of the fill `raw` [H, W, 3] float32 where it is `painted` [H, W]
    bool, its rim as in the view `base` [H, W, 3] uint8, but for `no_photo` [H, W] bool: the rest of the hole, drawings
    of the emptied scene. The rim counts only where no seam of `depth`, [H, W] z of the new scene, parts it from the
    fill. Parts without a rim keep their own colours.
    """
    rim = (cv2.dilate(painted.astype(np.uint8), SQUARE) > 0) & ~painted & ~no_photo & (depth > 0)
    nearest_fill = cv2.dilate(np.where(painted & (depth > 0), depth, 0).astype(np.float32), SQUARE)
    rim &= np.abs(nearest_fill - depth) < SEAM * depth
    solution = solve_poisson(painted, rim, base, np.where(painted[..., None], raw, np.nan).astype(np.float32))
    result, free = base.copy(), solution.unanchored[..., None]
    result[painted] = to_bytes(np.where(free, raw, solution.values)[painted])
    return result


def _alike(mismatch: np.ndarray, level: np.ndarray, data: np.ndarray, width: float) -> np.ndarray:
    """[N] in [0, 1]: how much each of the data counts, as its mismatch is like the others' near by.

    A local mean, reweighted (Holland and Welsch 1977): what differs from most may be the light of another place.
    """
    mean, shape = level, data.shape
    # as coarse as the neighbourhood allows
    small = [max(1, round(n / max(1.0, width / CELLS))) for n in shape]
    sigma = width * small[0] / shape[0], width * small[1] / shape[1]
    for tolerance in TOLERANCES:
        counts = np.zeros(shape)
        counts[data] = biweight((mismatch - mean)[data], tolerance)
        told = np.concatenate([counts[..., None], counts[..., None] * mismatch], axis=-1).astype(np.float32)
        told = cv2.resize(told, small[::-1], interpolation=cv2.INTER_AREA)
        told = cv2.GaussianBlur(told, (0, 0), sigma[1], sigmaY=sigma[0])
        told = cv2.resize(told, shape[::-1], interpolation=cv2.INTER_LINEAR)
        mean = (told[..., 1:] + LEAST_COUNT * level) / (told[..., :1] + LEAST_COUNT)
    return counts[data]


def _levels(parts: np.ndarray, data: np.ndarray, values: np.ndarray) -> np.ndarray:
    """[H, W, 3]: the median of each part's data, where there are enough of them; else 0. `parts` [H, W] are numbers."""
    level = np.zeros(values.shape)
    found, counts = np.unique(parts[data], return_counts=True)
    for part in found[counts >= LEAST_BAND]:
        inside = parts == part
        level[inside] = np.median(values[inside & data], axis=0)
    return level


def _behind_seams(region: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """[H, W] bool: pixels that lie behind a neighbour of the region by a step. Without them nothing crosses a seam."""
    behind = np.zeros_like(region)
    for a, b in ((np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1], np.s_[1:])):
        both = region[a] & region[b]
        step = depth[b] - depth[a]
        parted = both & (np.abs(step) > SEAM * np.minimum(depth[a], depth[b]))
        behind[b] |= parted & (step > 0)
        behind[a] |= parted & (step < 0)
    return behind


def _continue_over(left_out: np.ndarray, known: np.ndarray, depth: np.ndarray, values: np.ndarray) -> None:
    """Give pixels that were left out at a seam the mean value [H, W, 3] of their own surface beside them."""
    rows, cols = np.nonzero(left_out)
    total, count = np.zeros((len(rows), 3)), np.zeros(len(rows))
    for dy, dx in ((-1, -1), (-1, 0), (-1, 1), (0, -1), (0, 1), (1, -1), (1, 0), (1, 1)):
        i, j = np.clip(rows + dy, 0, depth.shape[0] - 1), np.clip(cols + dx, 0, depth.shape[1] - 1)
        here, there = depth[rows, cols], depth[i, j]
        same = known[i, j] & (np.abs(here - there) < SEAM * np.minimum(here, there))
        total[same] += values[i[same], j[same]]
        count += same
    found = count > 0
    values[rows[found], cols[found]] = total[found] / count[found, None]


def to_bytes(colours: np.ndarray) -> np.ndarray:
    """Grey levels as uint8, NaN as 0."""
    return np.clip(np.rint(np.nan_to_num(colours)), 0, 255).astype(np.uint8)
