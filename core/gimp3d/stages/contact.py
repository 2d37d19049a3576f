"""The shadow where the object touches a surface: a dark rim round what it hides, of light that came from all sides.

Lamps cast shadows that have a shape (`shadow`); what the object keeps from its nearest surroundings of the light of a
whole room has none but that of its own foot. It is narrow, so it is looked for on charts, and only beside the hole.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import scipy.ndimage
from scipy.spatial import cKDTree

from ..geometry import dilated
from ..srgb import linear
from .charts import Chart
from .ground import Ground
from .lifting import MIXED
from .light_search import DARK
from .shadow import Shadow

WIDTH = 0.1  # of the hole's size: as far as such a shadow is sought; as far again lies what it is compared with
LEAST_WIDTH = 3.0  # texels of that
STRIPS = 4  # of equal distance from the hole, each of which may be dark
LIKE = 0.3  # log of a ratio of channels by which a surface's colours differ as much as one width away
COMPARED = 15  # texels of like colour with which one is compared
VISIBLE = 0.1  # of log luminance, below which nobody sees a rim
CHANCE = 3.0  # times as much of the outline must be dark as farther out, where nothing touches anything
TOO_DARK = 1.01 - MIXED  # share of light; what only pixels show that may be the object's, in its shadow, is filled
SOME = 0.05  # share of the outline that chance makes dark at least


def find_contact(charts: Sequence[Chart]) -> Shadow | str:
    """The dark rims round the charts' holes; or why they count for none.

    A texel beside the hole is compared with the nearest ones of its colour a little farther out. It is in the shadow
    if most of what lies as near to the hole as it does, and not far from it, is darker than there. Textures are dark by
    chance as well: as often where nothing stands, one width away.
    """
    found = [(c, *_rim(c)) for c in charts]
    rims = [(chart, taken, share) for chart, taken, share, by_chance in found if share > CHANCE * max(by_chance, SOME)]
    if not rims:
        return "no dark rim found where it touches a surface"
    share = max(share for _, _, share in rims)
    most = max(float(np.percentile(taken[taken > 0], 90)) for _, taken, _ in rims)
    words = f"a dark rim round {share:.0%} of its outline, where up to {most:.0%} of the light is missing"
    grounds = tuple(Ground(c.plane, c.camera, c.depth, c.there, c.image, c.known, c.hole) for c, _, _ in rims)
    taken = tuple(np.repeat(t[..., None], 3, axis=-1).astype(np.float32) for _, t, _ in rims)
    return Shadow(grounds, None, (), taken, share, 1 - 1 / CHANCE, words)


def _rim(chart: Chart) -> tuple[np.ndarray, float, float]:
    """[H, W] the share of light that is taken, and of what share of the outline; and what chance makes of that."""
    width = max(LEAST_WIDTH, WIDTH * float(np.sqrt(chart.hole.sum())))
    hole = chart.hole | _shown_by_none(chart, width)
    far = cv2.distanceTransform((~hole).astype(np.uint8), cv2.DIST_L2, 5)
    logs = np.log(linear(chart.image) + DARK)
    luminance, hue = np.log(np.exp(logs).mean(-1)), logs[..., [0, 2]] - logs[..., 1:2]
    shown = chart.there & (chart.photos > 0) & ~hole

    def darker(start: float) -> tuple[np.ndarray, np.ndarray]:
        """Texels within a width of a distance, and by how much they are brighter than those beyond."""
        here = shown & (far > start) & (far <= start + width)
        beyond = shown & (far > start + width) & (far <= start + 2.5 * width)
        change = np.zeros(far.shape, np.float32)
        if here.any() and beyond.sum() >= COMPARED:
            places = [np.column_stack([np.argwhere(on) / width, hue[on] / LIKE]) for on in (beyond, here)]
            nearest = cKDTree(places[0]).query(places[1], k=COMPARED)[1]
            change[here] = luminance[here] - np.median(luminance[beyond][nearest], axis=1)
        return here, change

    elsewhere, by_chance = darker(width)
    if not elsewhere.any():
        return np.zeros(far.shape), 0.0, 1.0
    limit = max(VISIBLE, 1.4826 * float(np.median(np.abs(by_chance[elsewhere]))))
    here, change = darker(0.0)
    strips = [here & (far > k * width / STRIPS) & (far <= (k + 1) * width / STRIPS) for k in range(STRIPS)]
    outside = elsewhere & (far <= width + width / STRIPS)
    level, inside = np.zeros(far.shape, np.float32), hole
    for k, strip in enumerate(strips):
        dark, mean = _mostly_dark(strip, change, limit, width)
        inside = dark & dilated(inside, max(1, round(width / STRIPS)))
        level[inside] = mean[inside]
        if k == 0:
            share = float(inside.sum() / max(1, strip.sum()))
    chance = float(_mostly_dark(outside, by_chance, limit, width)[0].sum() / max(1, outside.sum()))
    return _taken(level, hole, width), share, chance


def _shown_by_none(chart: Chart, width: float) -> np.ndarray:
    """[H, W] bool: texels beside the hole that photos show only where they may show the object as well."""
    unseen = chart.hole | (chart.there & (chart.photos == 0))
    labels, _ = scipy.ndimage.label(unseen)
    near = cv2.distanceTransform((~chart.hole).astype(np.uint8), cv2.DIST_L2, 5) <= width
    return near & unseen & np.isin(labels, np.unique(labels[chart.hole]))


def _mostly_dark(
    strip: np.ndarray,  # [H, W] bool
    change: np.ndarray,  # [H, W] of log luminance
    limit: float,
    width: float,
) -> tuple[np.ndarray, np.ndarray]:
    """[H, W] bool: parts of a strip most of whose surroundings along it are darker; and by how much."""
    side = (2 * round(width) + 1,) * 2

    def along(values: np.ndarray) -> np.ndarray:
        return cv2.boxFilter(values.astype(np.float32), -1, side, normalize=False, borderType=cv2.BORDER_CONSTANT)

    count = along(strip)
    dark = strip & (along(strip & (change < -limit)) > 0.5 * count)
    shaded = strip & (change < -limit)
    return dark, along(np.where(shaded, change, 0)) / np.maximum(along(shaded), 1)


def _taken(level: np.ndarray, hole: np.ndarray, width: float) -> np.ndarray:
    """[H, W] the share of light taken: without steps, and beside the object so much that it is filled."""
    dark = level < 0
    taken = 1 - np.exp(cv2.GaussianBlur(level, (0, 0), width / (2 * STRIPS)))
    inside = hole & dilated(dark, round(width))
    taken[inside] = np.maximum(taken[inside], TOO_DARK)
    return taken
