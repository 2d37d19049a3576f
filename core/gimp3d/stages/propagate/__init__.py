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
from .blend import blend_band, blend_rim, colours_here, to_bytes
from .detail import ROUND, as_drawn
from .paper import MappingField, Sampler
from .warp import Loader, PaintedView, PropagateSettings, Propagation, Reference, Rule, ViewToPaint, warp_reference

SURROUNDINGS = 0.75  # width of what is looked at round the hole, over the root of the hole's area
LEAST_REACH = 16  # px of that
BAND = 1 / 8  # of that: the strip round the hole that the blend is fitted to most


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
    photo[photo] = warp.lookup(reference.source, photo)  # elsewhere something stands that rough depths do not tell
    rules = np.where(hole, Rule.UNREACHED, Rule.UNTOUCHED).astype(np.uint8)
    rules[painted] = Rule.REFERENCE if sample else Rule.OWN_PIXELS
    if sample:
        sample(view, warp, rules)
    raw, blended = warp.colours, base
    if settings.blend == "band":
        raw = colours_here(raw, base, painted, photo, BAND * reach)
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
