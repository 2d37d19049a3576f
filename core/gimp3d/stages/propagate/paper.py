"""The mapping field: which source patch of the reference explains each filled one (paper 3.3; docs/method.md).

And the paper's Algorithm 1: a pixel takes the view's own colour at the source that the mapping field gives it.

Where the view does not show that source, another one near it that looks alike is taken (retargeting), else another
view's pixel (`transfer="sample"`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from ...camera import Camera
from ...compute.jit import inline_kernel, kernel
from ...compute.threads import parallel_map, run_ranges
from ...geometry import SAME_DEPTH, colours_at, surface_points
from ...schema import Signed
from ...solvers.patchmatch import PatchMatchSettings, nearest_neighbour_field
from ...solvers.robust import exposure_gain
from ..witness import Says, Witness, ask, total_over
from .warp import Loader, Picture, PropagateSettings, Reference, Rule, ViewToPaint, Warp, picture_of, shown_at

MISFIT = 25.0  # grey levels of RMS misfit at which the field's confidence has fallen to 1/e
RADIUS = 2  # px of the overlapping patches that are compared and blended (paper 4.1: 5 × 5)
ALIKE = 25.0  # grey levels, RMS, up to which a patch found near a hidden source is alike
OWN, REFERENCE, RETARGETED, OTHER = 2, 3, 5, 6  # members of Rule, for the kernels


@dataclass(frozen=True)
class MappingSettings:
    """How sources are judged."""

    visibility: Signed = 0.002  # squared colour difference, λ_v of eq. 8, (11 grey levels)²; likeness, what views see
    as_printed: bool = False  # compared at f(p), copied from p + f(p); nothing: the paper's cost misses p
    patchmatch: PatchMatchSettings = field(default_factory=PatchMatchSettings)


@dataclass(frozen=True)
class MappingField:
    """f as absolute source coordinates."""

    rows: np.ndarray  # [H, W] int32, -1 where there is none
    cols: np.ndarray  # [H, W] int32
    confidence: float
    reason: str


def source_visibility(
    camera: Camera,
    depth: np.ndarray,  # [H, W] z-depth of the reference, 0 = nothing
    views: Sequence[tuple[Camera, np.ndarray, np.ndarray]],  # (camera, z-depth with the object, hidden pixels)
) -> np.ndarray:
    """v(q) [H, W] float32: the share of views that show the source point at q: framed, in front, not hidden."""
    rows, cols, points = surface_points(camera, np.where(np.isfinite(depth), depth, 0))

    def shown(view: tuple[Camera, np.ndarray, np.ndarray]) -> np.ndarray:
        other, z, hidden = view
        no = np.zeros_like(hidden)
        witness = Witness(other, np.empty((0, 0, 3), np.uint8), hidden, no, no, z)
        return ask([witness], points, SAME_DEPTH)[0] == Says.SEEN

    share = np.zeros(depth.shape, np.float32)
    share[rows, cols] = total_over(views, shown, rows.shape) / max(1, len(views))
    return share


def mapping_field(
    image: np.ndarray,  # [H, W, 3] uint8, the inpainted reference
    target: np.ndarray,  # [H, W] bool, T_0
    source: np.ndarray,  # [H, W] bool, centres of patches that may be copied
    visibility: np.ndarray,  # [H, W] float32, see source_visibility
    settings: MappingSettings = MappingSettings(),
    seed: int = 0,
) -> MappingField:
    """The field f* that minimises misfit, incoherence and λ_v (1 − v) over T_0 (paper eq. 8, sign mended).

    The target's colours are known (the reference is inpainted already), so no EM is needed.
    """
    penalty = (settings.visibility * (1 - visibility)).astype(np.float32)
    patchmatch = replace(settings.patchmatch, seed=settings.patchmatch.seed + seed)
    nearest = nearest_neighbour_field(image, target, source, penalty, patchmatch)
    if settings.as_printed:  # the place that was compared is taken as the offset f(p); none where p + f(p) is no source
        moved = np.stack([nearest.rows, nearest.cols]) + np.indices(source.shape)
        kept = nearest.found & (moved[0] < source.shape[0]) & (moved[1] < source.shape[1])
        kept[kept] = source[tuple(moved[:, kept])]
        rows, cols = np.where(kept, moved, -1).astype(np.int32)
        nearest = nearest._replace(rows=rows, cols=cols)
    found = nearest.found
    if not target.any():
        confidence, reason = 1.0, "nothing to map: the target region is empty in the reference"
    elif not found.any():
        confidence = 0.0
        reason = "no source patch: the reference shows nothing but the hole; its own colours are warped"
    else:
        rows, cols = nearest.rows[found], nearest.cols[found]
        appearance = (nearest.cost[found] - penalty[rows, cols]) / (1 - patchmatch.coherence)
        misfit = 255 * float(np.sqrt(max(0.0, appearance.mean())))
        confidence = float(np.exp(-misfit / MISFIT))
        reason = f"fill explained to {misfit:.1f} grey levels; "
        reason += f"sources seen by {visibility[rows, cols].mean():.0%} of the views"
    return MappingField(nearest.rows, nearest.cols, confidence, reason)


@dataclass(frozen=True)
class Lent:
    """What another view shows of the mapped sources."""

    camera: Camera
    colours: np.ndarray  # [M, 3] float32
    seen: np.ndarray  # [M] bool
    gain: np.ndarray  # [3] its exposure over the reference's


class Sampler:
    """Algorithm 1's sampling of any view; a few of the views lend it pixels at mapped sources that it does not show."""

    def __init__(
        self, reference: Reference, field: MappingField, views: Sequence[Loader], settings: PropagateSettings
    ) -> None:
        there = reference.target & (field.rows >= 0)
        self.reference, self.picture, self.reach = reference, picture_of(reference), settings.retarget
        self.pixels = [x.astype(np.int32) for x in np.nonzero(there)]  # rows and columns [M] of mapped pixels of T_0
        self.sources = [np.ascontiguousarray(f[there], np.int32) for f in (field.rows, field.cols)]  # theirs, f
        self.index = np.full(there.shape, -1, np.int32)  # each pixel's place in these lists; -1 = none
        self.index[there] = np.arange(there.sum())
        count = min(settings.donors, len(views))
        chosen = [views[k * len(views) // count] for k in range(count)]
        self.lent = parallel_map(lambda load: self._lend(load()), chosen)

    def __call__(self, view: ViewToPaint, warp: Warp, rules: np.ndarray) -> None:
        """Change the warp's colours to sampled ones, and `rules` [h, w] uint8 from REFERENCE, as which they come in
        where the warp reaches the hole.
        """
        *sources, source_rules = self._shown_in(picture_of(view), self.reach)
        reached = rules == Rule.REFERENCE
        found = np.append(source_rules, 0)[warp.lookup(self.index, reached)]  # -1, which is not in it, is the last
        rules[reached] = np.where(found > 0, found, Rule.REFERENCE)
        rows, cols = np.nonzero(reached)
        taken = self.index, *sources, source_rules, *self._borrowed(view, source_rules == 0)
        given = rows, cols, warp.u, warp.v, *taken, self.picture, picture_of(view), RADIUS
        run_ranges(_sample_range, len(rows), *given, warp.colours, rules)

    def _shown_in(self, view: Picture, reach: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The mapped sources as far as the view shows them, retargeted by search within `reach` px where it does not:
        rows and columns [M] int32 in the reference; rules [M] uint8 OWN, RETARGETED, or 0 where the view shows none.

        Patches are compared in the reference, where one camera sees both; the view only says which of them it shows.
        """
        rows, cols = self.sources
        found = rows.copy(), cols.copy(), np.zeros(len(rows), np.uint8)
        given = *self.pixels, self.picture, view, RADIUS, reach, 3 * ALIKE**2
        run_ranges(_find_range, len(rows), *given, *found)
        return found

    def _borrowed(self, view: ViewToPaint, wanted: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """[M, 3] colours of wanted sources in the nearest view that shows them, at this exposure; [M] bool: there."""
        colours, has = np.zeros((len(wanted), 3), np.float32), np.zeros(len(wanted), bool)
        others = [x for x in self.lent if x.camera.id != view.camera.id]
        others.sort(key=lambda x: (float(np.linalg.norm(x.camera.centre - view.camera.centre)), x.camera.id))
        gain = self._lend(view).gain if others else np.ones(3)
        for other in others:
            new = other.seen & wanted & ~has
            colours[new] = other.colours[new] * (gain / other.gain)
            has |= new
        return colours, has

    def _lend(self, view: ViewToPaint) -> Lent:
        seen = self._shown_in(picture_of(view), reach=0)[2] > 0
        rows, cols = (x[seen] for x in self.sources)
        z = self.picture.depth[rows, cols].astype(np.float64)
        points = self.reference.camera.unproject(np.stack([cols + 0.5, rows + 0.5], -1), z)
        colours = np.zeros((len(seen), 3), np.float32)
        colours[seen] = colours_at(view.image, view.camera.project(points)[0])
        return Lent(view.camera, colours, seen, exposure_gain(self.reference.image[rows, cols], colours[seen]))


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
def _patch_misfit(reference, i, j, a, b, radius, worst):
    """Mean squared difference (over pixels, summed over channels) of the patches at (i, j) and (a, b)."""
    h, w = reference.usable.shape
    total, count = 0.0, 0
    for dy in range(-radius, radius + 1):
        for dx in range(-radius, radius + 1):
            p, q, r, s = i + dy, j + dx, a + dy, b + dx
            if p < 0 or q < 0 or r < 0 or s < 0 or p >= h or q >= w or r >= h or s >= w:
                continue
            if not reference.usable[r, s]:
                continue
            for channel in range(3):
                difference = float(reference.image[p, q, channel]) - float(reference.image[r, s, channel])
                total += difference * difference
            count += 1
    return total / count if 2 * count > (2 * radius + 1) ** 2 else worst


@kernel
def _find_range(lo, hi, rows, cols, reference, view, radius, reach, worst, source_rows, source_cols, rules):
    """Mapped pixels lo … hi−1 of the lists rows and cols: which source the view shows, and by which rule.

    The sources [M] come in as the field has them and leave as they are used; `worst` is the misfit of patches of a
    radius from which they are not alike, `reach` how far is searched in px.
    """
    for k in range(lo, hi):
        i, j = rows[k], cols[k]
        a, b = source_rows[k], source_cols[k]
        _, _, good = shown_at(b + 0.5, a + 0.5, reference, view)
        if good:
            rules[k] = OWN
            continue
        best, found_a, found_b = worst, -1, -1
        step, outwards = 2, True
        while 1 <= step <= reach:  # eight directions, ever farther out, then ever finer round the best
            for direction in range(9):
                p, q = a + step * (direction // 3 - 1), b + step * (direction % 3 - 1)
                _, _, good = shown_at(q + 0.5, p + 0.5, reference, view)
                if good:
                    misfit = _patch_misfit(reference, i, j, p, q, radius, worst)
                    if misfit < best:
                        best, found_a, found_b = misfit, p, q
            if outwards and 2 * step > reach:
                outwards, step = False, reach // 2
            step = step * 2 if outwards else step // 2
            if not outwards:
                if found_a < 0:
                    break
                a, b = found_a, found_b
        if found_a >= 0:
            source_rows[k], source_cols[k], rules[k] = found_a, found_b, RETARGETED


@kernel
def _sample_range(
    lo, hi, rows, cols, u, v, index, source_rows, source_cols, source_rules, borrowed, has, reference, view, radius,
    raw, rules
):  # fmt: skip
    """Pixels lo … hi−1 of the lists rows and cols, which lie at (u, v) of the reference: the mean over patches.

    `index` [H, W] is the place of the reference's mapped pixels in the lists of sources and of what is borrowed [M].
    `raw` [h, w, 3] and `rules` [h, w] come in as the warp gives them.
    """
    h0, w0 = reference.depth.shape
    for k in range(lo, hi):
        i, j = rows[k], cols[k]
        u0, v0 = float(u[i, j]), float(v[i, j])
        i0, j0 = int(v0), int(u0)
        z0 = float(reference.depth[i0, j0])
        total, sum0, sum1, sum2 = 0.0, 0.0, 0.0, 0.0
        for dy in range(-radius, radius + 1):
            for dx in range(-radius, radius + 1):
                a, b = i0 + dy, j0 + dx
                if a < 0 or b < 0 or a >= h0 or b >= w0 or index[a, b] < 0:
                    continue
                m = index[a, b]
                if source_rules[m] == 0 or abs(reference.depth[a, b] - z0) > 2 * SAME_DEPTH * z0:
                    continue
                # the patch at (a, b) explains this pixel by its source at the same place within the patch
                uq, vq = source_cols[m] - dx + (u0 - j0), source_rows[m] - dy + (v0 - i0)
                ut, vt, good = shown_at(uq, vq, reference, view)
                if not good:
                    continue
                weight = math.exp(-0.5 * (dx * dx + dy * dy))
                total += weight
                sum0 += weight * _bilinear(view.image, ut, vt, 0)
                sum1 += weight * _bilinear(view.image, ut, vt, 1)
                sum2 += weight * _bilinear(view.image, ut, vt, 2)
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
