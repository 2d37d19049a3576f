"""What stays round the object, learned again: its splats were fitted with the object's before and among them.

And after the hole is filled, what is drawn before the new Gaussians takes their colours: where drawn depths scatter,
splats of the floor lie before the floor that photos tell.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from ..box import Region
from ..gaussians import SH_C0, Gaussians
from ..presets import RemovalSettings
from ..progress import Progress
from ..raster import label_weights
from ..stages.charts import Chart, extent, pictured
from ..stages.recolour import recoloured
from ..stages.refine import Observation, looked_at, refine_gaussians
from ..stages.seed import OWN_RULES
from ..stages.selection import near_region
from ..stages.witness import Witness, total_over
from ..view_state import ViewState
from .references import emptied

LEARNED = ("opacity_logits", "sh")  # shapes stay: photos of one side tear them (kitchen_monkey −0.2 dB, real_bed −0.1)
ROUND = 24  # px round the object in which photos teach
PLACE, ELSEWHERE = 1, 2  # labels of a view's pixels: the object's place, and all others
SHOWN = 2.0  # px of blend weight in the object's place, over all views, from which a Gaussian learns
SHARE = 0.1  # of all its weight; what draws other places more than this one is left alone
LARGEST = 0.5  # diagonals of the region, σ: giants of the background show in many places
SMOOTHING = 1.0  # px, σ by which splats and charts are blurred before they are compared
VISIBLE = 0.5 / 255  # change of a Gaussian's colour from which it shows
WRONG = 2.0  # times the charts' usual error beyond which what is drawn in the object's place is none of the surface


@dataclass(frozen=True)
class Relearned:
    """Gaussians round the object, as photos teach them."""

    rows: np.ndarray  # [M] of the scene
    gaussians: Gaussians  # [M], their new values
    confidence: float
    reason: str

    def scene(self, scene: Gaussians) -> Gaussians:
        """The scene with them."""
        arrays = {name: getattr(scene, name).copy() for name in LEARNED}
        for name in LEARNED:
            arrays[name][self.rows] = getattr(self.gaussians, name)
        return replace(scene, **arrays)


def relearn(
    scene: Gaussians,
    region: Region,
    removed: np.ndarray,  # [N] bool
    views: Sequence[ViewState],
    charts: Sequence[Chart],
    settings: RemovalSettings,
    progress: Progress,
) -> Relearned:
    """Fit colours and opacity of what draws the object's place to the photos round it, and to the charts inside.

    Inside, charts teach only what cannot be true: a Gaussian that nobody saw there may draw anything, but where it
    draws about what charts show, a photo of its own place knows better than a chart's mosaic.
    """
    kept = scene.take(~removed)
    showing = looked_at([v for v in views if v.masks.silhouette.any()], settings.refine)
    near = kept.usable & near_region(kept, region, 1.0) & (kept.scales.max(1) < LARGEST * extent(region))
    near &= np.isfinite(kept.opacity_logits)  # infinite ones are legal, and have no slope

    def weights(view: ViewState) -> np.ndarray:
        labels = np.where(view.masks.silhouette, PLACE, ELSEWHERE).astype(np.uint8)
        return label_weights(kept, view.camera, labels, ELSEWHERE, near)

    place, elsewhere = total_over(showing, weights, (2, len(kept)))
    learns = near & (place > SHOWN) & (place > SHARE * (place + elsewhere))
    observations = [observed_round(v, charts) for v in emptied(kept, showing)]
    how = settings.refine, settings.random_seed, lambda _, *step: progress("relearn", *step), LEARNED, ROUND
    refined = refine_gaussians(kept.take(~learns), kept.take(learns), observations, *how)
    rows = np.flatnonzero(~removed)[learns] if refined.steps else np.zeros(0, int)
    reason = f"{len(rows)} Gaussians round the object: {refined.reason}"
    return Relearned(rows, refined.gaussians.take(np.arange(len(rows))), refined.confidence, reason)


def take_painted_colours(kept: Gaussians, added: Gaussians, views: Sequence[ViewState]) -> Relearned:
    """The kept Gaussians that show where views are painted, in colours by which the filled scene shows what is painted.

    What they show elsewhere holds them.
    """
    wanted = [np.isin(v.rules, OWN_RULES) for v in views if v.rules is not None]
    views = [v for v in views if v.rules is not None]
    hidden = [(v.masks.silhouette | v.masks.target) & ~own for v, own in zip(views, wanted)]
    witnesses = [Witness(v.camera, v.painted, h, np.zeros_like(h), v.masks.depth_before) for v, h in zip(views, hidden)]
    whole, painted = kept.extended(added), [v.painted for v in views]
    may = (np.arange(len(whole)) < len(kept)) & whole.usable & np.isfinite(whole.opacity_logits)
    rows, sh = recoloured(whole, np.zeros(len(whole), bool), witnesses, painted, wanted, wanted, 0, may)
    seen = np.abs(sh[:, 0] - kept.sh[rows, 0]).max(1) > VISIBLE / SH_C0
    rows, sh = rows[seen], sh[seen]
    reason = f"{len(rows)} Gaussians before the new ones take the colours that are painted there"
    return Relearned(rows, replace(kept.take(rows), sh=sh), 1.0, reason)


def observed_round(view: ViewState, charts: Sequence[Chart]) -> Observation:
    """What a view teaches of the object's surroundings; it is painted with the emptied scene in the object's place."""
    place = view.masks.silhouette | view.masks.target
    image, weight = view.painted, np.zeros(place.shape, np.float32)
    if view.hits is not None:
        shown, known, hole = pictured(charts, view.hits)
        tolerance = max(c.tolerance for c in charts)
        known &= ~hole & ~view.hits.behind(view.masks.depth_after, tolerance)
        off = np.sqrt(((_smooth(image) - _smooth(shown)) ** 2).mean(-1))
        beside = known & ~place
        if beside.any():
            wrong = known & place & ~view.masks.target & (off > WRONG * np.sqrt((off[beside] ** 2).mean()))
            image = np.where(wrong[..., None], shown, image)
            weight[wrong] = 1
    return Observation(view.camera, image, place, weight)


def _smooth(picture: np.ndarray) -> np.ndarray:
    return cv2.GaussianBlur(picture.astype(np.float32), (0, 0), SMOOTHING)
