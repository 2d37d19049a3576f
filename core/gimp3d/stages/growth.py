"""What of the object the boxes cut off: its parts that go on outside them, and what looks like it on the surface.

Gaussians that touch and have about the same colour are one part. A part that lies in the boxes to some share is the
object's, so its rest is proposed. A part that the boxes hardly touch, or that goes on without end, is something else.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.ndimage
import scipy.sparse
import scipy.sparse.csgraph
from scipy.spatial import cKDTree

from ..box import Box, Region, in_region
from ..camera import Camera
from ..gaussians import SH_C0, Gaussians
from .surroundings import follow_surface

REACH = 0.5  # how far from a box its rest may lie, as a share of the box's longest edge
TOUCH = 4.0  # centres so near touch, times the median distance of an object's Gaussian from its fifth nearest
COLOUR = 0.25  # largest difference of a channel between Gaussians that look alike, colours in [0, 1]
BINS = 12  # of each channel in the histograms of both their colours
LIKELY = 0.9  # probability by colour from which a Gaussian on the surface is the object's all the same
UNLIKELY = 0.1  # probability up to which one off the surface is something else
SHARE = 0.1  # of a part's Gaussians that the boxes must hold
LEAST = 10  # Gaussians of a piece that is worth proposing
LEAST_WEIGHT = 0.5  # blend weight, summed over pixels and views, up to which a Gaussian shows nothing: half a pixel
LARGE = 0.25  # longest standard deviation of a large Gaussian, as a share of the shortest edge of the boxes


@dataclass(frozen=True)
class Growth:
    """What the boxes cut off."""

    rows: np.ndarray  # [N] bool: the object's, but kept
    region: Region  # the boxes, one of them enlarged to hold these
    box: Box | None  # that one; None if nothing was cut
    taken: bool = False  # they go, and `region` counts
    endless: bool = False  # a part of what the boxes cut goes on too far to be the object's rest

    @property
    def words(self) -> str:
        """The proposal for people; empty if there is none."""
        if self.endless and self.box is None:
            return "the box cuts something larger than what it holds: nothing is proposed; is the box too small?"
        if self.box is None or self.taken:
            return ""
        size, centre = (", ".join(f"{v:.4g}" for v in values) for values in (self.box.size, self.box.center))
        return (
            f"the box cuts the object: {int(self.rows.sum())} Gaussians of it stay; "
            f"use --grow or a box of size {size} at {centre}"
        )


def find_growth(
    gaussians: Gaussians,
    region: Region,  # boxes round the object
    of_object: np.ndarray,  # [N] bool, those that go as the object's
    stays: np.ndarray,  # [N] bool, those that are kept
    shown: np.ndarray,  # [N] blend weight summed over pixels and views, whole as far round the boxes as REACH
    views: Sequence[tuple[Camera, np.ndarray]],  # (camera, z-depth [H, W] with the object, 0 = nothing)
) -> Growth:
    """Which kept Gaussians are the object's, though the boxes or the surface under it kept them."""
    none = Growth(np.zeros(len(gaussians), bool), region, None)
    outer = tuple(replace(box, size=box.size + 2 * REACH * box.size.max()) for box in region)
    longest = gaussians.scales.max(1)
    small = longest < LARGE * min(box.size.min() for box in region)
    there = gaussians.usable & (shown > LEAST_WEIGHT) & in_region(outer, gaussians.means.astype(np.float64))
    rows = np.flatnonzero(there & (of_object | (small & stays)))
    points, object_ = gaussians.means[rows].astype(np.float64), of_object[rows]
    if object_.sum() < LEAST or object_.all():
        return none
    on_surface = np.zeros(len(rows), bool)
    for box in outer:
        # coarser than for the selection: a proposal needs no more
        part = follow_surface(box, outer, views, beyond=0.1, seeds=0.05, most_cells=200_000, most_views=20)
        on_surface |= part.distance(points) <= part.cell + longest[rows]
    colours = np.clip(0.5 + SH_C0 * gaussians.sh[rows, 0], 0, 1)
    like = _likelihood(colours, shown[rows], object_ & ~on_surface, ~object_ & on_surface)
    nodes = object_ | (like > np.where(on_surface, LIKELY, UNLIKELY))
    rows, points, object_ = rows[nodes], points[nodes], object_[nodes]
    colours, like = colours[nodes], like[nodes]
    tree = cKDTree(points[object_])
    spacing = float(np.median(tree.query(points[object_], k=min(6, tree.n))[0][:, -1]))
    radius = TOUCH * spacing
    pairs = cKDTree(points).query_pairs(radius, output_type="ndarray")
    pairs = pairs[(np.abs(colours[pairs[:, 0]] - colours[pairs[:, 1]]) < COLOUR).all(1)]
    parts = components(pairs, len(rows))
    held, cut = np.bincount(parts[object_], minlength=len(rows)), np.bincount(parts[~object_], minlength=len(rows))
    known = in_region([replace(box, size=np.maximum(box.size - 2 * spacing, 0)) for box in outer], points)
    endless = np.bincount(parts[~object_ & ~known], minlength=len(rows)) > 0
    ours = held >= np.maximum(1, SHARE * (held + cut))
    rest = (ours & ~endless)[parts] & ~object_
    pieces = components(pairs[rest[pairs].all(1)], len(rows))[rest]
    sizes, likes = np.bincount(pieces, minlength=1), np.bincount(pieces, like[rest], minlength=1)
    grown = np.flatnonzero(rest)[((sizes >= LEAST) & (likes > sizes / 2))[pieces]]
    outside = int((~in_region(region, points[grown])).sum())
    too_much = outside > object_.sum() + len(grown) - outside
    if not len(grown) or too_much:
        return replace(none, endless=bool(too_much or (ours & endless & (cut >= LEAST)).any()))
    found = none.rows.copy()
    found[rows[grown]] = True
    holding = [_holding(box, points[grown], radius) for box in region]
    least = int(np.argmin([new.size.prod() - old.size.prod() for new, old in zip(holding, region)]))
    return Growth(found, (*region[:least], holding[least], *region[least + 1 :]), holding[least])


def _likelihood(colours: np.ndarray, weights: np.ndarray, object_: np.ndarray, surface: np.ndarray) -> np.ndarray:
    """[M]: the probability by colour [M, 3] in [0, 1] that a Gaussian is the object's, from smoothed histograms,
    weighted [M], of what is the object's for sure and what is mostly surface, [M] bool each.
    """
    index = np.minimum(colours * BINS, BINS - 1).astype(int) @ np.array([BINS * BINS, BINS, 1])

    def density(rows: np.ndarray) -> np.ndarray:
        counts = np.bincount(index[rows], weights[rows], BINS**3).reshape(BINS, BINS, BINS)
        return scipy.ndimage.gaussian_filter(counts / max(float(counts.sum()), 1e-9), 0.7).ravel()[index]

    of_object, of_surface = density(object_), density(surface)
    return of_object / np.maximum(of_object + of_surface, 1e-12)


def components(pairs: np.ndarray, count: int) -> np.ndarray:
    """[count]: the number of each node's connected component, of the graph with edges [E, 2]."""
    graph = scipy.sparse.coo_matrix((np.ones(len(pairs), bool), pairs.T), (count, count))
    return scipy.sparse.csgraph.connected_components(graph, directed=False)[1]


def _holding(box: Box, points: np.ndarray, margin: float) -> Box:
    """The box, its faces moved outwards to hold points and a margin round those that it did not hold."""
    local, half = (points - box.center) @ box.axes, box.size / 2
    low = np.where(local.min(0) < -half, local.min(0) - margin, -half)
    high = np.where(local.max(0) > half, local.max(0) + margin, half)
    return replace(box, center=box.center + box.axes @ ((low + high) / 2), size=high - low)
