"""Pictures of what stages did, for the report and the preview: what they show, and how they are drawn."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import cv2
import numpy as np

from .compute.threads import parallel_map
from .gaussians import Gaussians
from .geometry import disparity_of, window_mask
from .raster import footprint, touched_window
from .run import Picture, ViewState
from .stages.charts import Chart
from .stages.depth import DepthCompletion
from .stages.masks import Masks
from .stages.propagate import PaintedView, Rule
from .stages.propagate.paper import MappingField
from .stages.witness import spread
from .steps.behind import Relit
from .steps.references import Completed
from .steps.view_refinement import ViewRefinement

FEW = 3  # views that are shown of many
SHOWN = 0.25  # blend weight of what the boxes cut off from which a pixel is marked
RULE_COLOURS = {
    Rule.EVIDENCE: ("seen in this photo", (70, 160, 90)),
    Rule.OWN_PIXELS: ("fitted to this view's own pixels, or (paper) mapped from them", (70, 120, 220)),
    Rule.RETARGETED: ("this view's own pixels, found near the mapped ones", (60, 190, 220)),
    Rule.OTHER_VIEW: ("the mapped source as another view shows it", (160, 90, 200)),
    Rule.REFERENCE: ("warped from the reference", (240, 170, 50)),
    Rule.UNREACHED: ("not reached by this reference", (220, 60, 60)),
}
RED = (230, 60, 60)
PLOT_LOW, PLOT_HIGH = 56, 424  # px between which a plot of 480 px has its axes


def of_targets(views: Sequence[ViewState]) -> list[Picture]:
    few = spread(views, FEW)
    return [Picture("mask", f"Region to fill in {v.id}", partial(tinted, v.photo, v.left.target)) for v in few]


def of_charts(charts: Sequence[Chart]) -> list[Picture]:
    return [Picture("chart", f"What photos show of {c.camera.id}", partial(tinted, c.image, c.hole)) for c in charts]


def of_growth(scene: Gaussians, masks: Masks, views: Sequence[ViewState]) -> list[Picture]:
    """What of the object the boxes cut off, in the two views that show most of it."""
    if masks.growth is None or not masks.growth.rows.any():
        return []
    rows, title = masks.growth.rows, "Taken along" if masks.growth.taken else "Cut off by the box"
    scene = scene.take(np.arange(len(rows)))  # without what was split off
    cut = scene.take(rows)

    def shown(v: ViewState) -> np.ndarray:
        window = window_mask(touched_window(cut, v.camera), v.camera)
        return footprint(scene, v.camera, rows, pixels=window) > SHOWN

    most = sorted(zip(views, parallel_map(shown, views)), key=lambda pair: -int(pair[1].sum()))[:2]
    return [Picture("mask", f"{title}, in {v.id}", partial(tinted, v.photo, mask)) for v, mask in most]


def of_light(lit: Relit, camera_ids: Sequence[str], shown: Sequence[str] | None = None) -> list[Picture]:
    """Photos, the light that arrives, and the photos as they would be, of views by ID or the two that change most."""
    if lit.lifted is None:
        return []
    lifted = lit.lifted
    order = sorted(range(len(camera_ids)), key=lambda k: -int(lifted.shaded[k].sum()))[:2]
    if shown is not None:
        order = [k for k, name in enumerate(camera_ids) if name in shown]
    what = [name for name, facts in lit.facts().items() if facts["found"]]
    title = f"The object's {' and '.join(what)} in {{}}: photo, what is left alone, undone"
    parts = {k: [lifted.before[k], np.dstack([lifted.light[k]] * 3), lifted.photos[k]] for k in order}
    changed = [k for k in order if lifted.shaded[k].any()]
    return [Picture("shadow", title.format(camera_ids[k]), partial(np.hstack, parts[k])) for k in changed]


def of_depth(completion: DepthCompletion, depth: np.ndarray, target: np.ndarray, name: str) -> list[Picture]:
    """The completed surface, and how the depth prior was scaled, if there was one."""
    shown, fit = [Picture("depth", f"Completed surface in {name}", partial(relief, depth, target))], completion.fit
    if len(fit.ring):
        plot = partial(fit_plot, fit.ring, fit.line, fit.scale)
        shown.append(Picture("fit", f"Scale of the depth prior, measured round the hole of {name}", plot))
    return shown


def of_reference(completed: Completed, field: MappingField | None) -> list[Picture]:
    image, name = completed.image, completed.camera.id
    outline = partial(outlined, image, completed.target)
    shown = [Picture("appearance", f"The reference without the object, {name}", outline)]
    if field is not None:
        offsets = partial(offset_colours, image, field.rows, field.cols)
        shown.append(Picture("mapping", f"Mapping field of {name}", offsets))
    return shown


def of_painting(painted: Sequence[PaintedView], views: Sequence[ViewState]) -> list[Picture]:
    """Filled views: raw, blended, and by which rule."""
    before, shown = {v.id: v.painted for v in views}, []
    for p in spread(painted, FEW):
        was = before[p.camera.id]
        maps = p.pasted(was), p.rule_map(), p.pasted(was, p.raw)
        shown.append(Picture("rules", f"Filled view {p.camera.id}", partial(by_rule, *maps)))
    return shown


def of_refinement(asked: ViewRefinement, views: Sequence[ViewState]) -> list[Picture]:
    before = {v.id: v.painted for v in views}
    shown = [
        Picture("refined", f"{a.camera_id} refined: before, after", partial(np.hstack, [before[a.camera_id], a.image]))
        for a in asked.views
        if a.image is not None
    ]
    return spread(shown, FEW)


def by_rule(image: np.ndarray, rules: np.ndarray, raw: np.ndarray) -> np.ndarray:
    """A filled view raw, blended, and with the colours of its rules [H, W] over it."""
    marked = image
    for rule, (_, colour) in RULE_COLOURS.items():
        marked = tinted(marked, rules == rule, colour, 0.35)
    return np.hstack([raw, image, marked])


def tinted(
    image: np.ndarray, mask: np.ndarray, colour: tuple[int, int, int] = RED, strength: float = 0.5
) -> np.ndarray:
    """The image [H, W, 3] uint8 with a colour laid over the mask [H, W] bool."""
    mixed = (1 - strength) * image + strength * np.array(colour)
    return np.where(mask[..., None], mixed, image).astype(np.uint8)


def outlined(image: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """The image with the mask's outline drawn on it."""
    contours, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    return cv2.drawContours(image.copy(), contours, -1, RED, 1)


def relief(depth: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Depth [H, W] (z, 0 = nothing) as colour, shaded like a relief, the mask outlined."""
    disparity, there = disparity_of(depth).astype(np.float64), depth > 0
    low, high = np.percentile(disparity[there], [2, 98]) if there.any() else (0.0, 1.0)
    span = max(high - low, 1e-12)
    levels = (np.clip((disparity - low) / span, 0, 1) * 255).astype(np.uint8)
    shade = np.clip(1 + 12 * np.gradient(disparity, axis=0) / span, 0.6, 1.3)[..., None]
    shaded = np.clip(cv2.applyColorMap(levels, cv2.COLORMAP_VIRIDIS)[..., ::-1] * shade, 0, 255)
    return outlined(np.where(there[..., None], shaded, 40).astype(np.uint8), mask)


class FitAxes(NamedTuple):
    """Where a plot shows (prior, disparity): nearly all pairs fill it, outliers stay outside."""

    first: np.ndarray  # [2] at its lower left corner
    last: np.ndarray  # [2] at its upper right one

    @classmethod
    def around(cls, ring: np.ndarray) -> FitAxes:
        low, high = np.percentile(ring, [1, 99], axis=0)
        half = np.maximum(high - low, 1e-9) / 2 * 1.1
        return cls((low + high) / 2 - half, (low + high) / 2 + half)

    def place(self, points: np.ndarray) -> np.ndarray:
        """Pixels [..., 2] of (prior, disparity)."""
        share = (points - self.first) / (self.last - self.first)
        return PLOT_LOW + (PLOT_HIGH - PLOT_LOW) * np.stack([share[..., 0], 1 - share[..., 1]], -1)

    def line(self, line: tuple[float, float]) -> np.ndarray:
        """Pixels [2, 2] of the ends of the line disparity = slope · prior + offset."""
        return self.place(np.array([(m, line[0] * m + line[1]) for m in (self.first[0], self.last[0])]))


def fit_plot(
    ring: np.ndarray,  # [N, 2] (prior, scene's disparity) of pixels round the hole
    line: tuple[float, float],  # (slope, offset) fitted to them
    scale: float,  # s_f: the slope as far as the prior is believed; 0 = it is not used
) -> np.ndarray:
    """How s_f was measured: the scene's disparity over the prior, and the line fitted; [size, size, 3] uint8."""
    ink, faint, dots, drawn_line = (31, 35, 40), (223, 227, 232), (94, 85, 163), (198, 81, 2)
    low, high, axes = PLOT_LOW, PLOT_HIGH, FitAxes.around(ring)
    drawn = np.full((low + high, low + high, 3), 255, np.uint8)

    def write(words: str, x: int, y: int, size: float = 0.38, colour: tuple[int, ...] = ink, width: int = 1) -> None:
        cv2.putText(drawn, words, (x, y), cv2.FONT_HERSHEY_SIMPLEX, size, colour, width, cv2.LINE_AA)

    for share in (0, 0.25, 0.5, 0.75, 1):
        at = round(low + share * (high - low))
        value = axes.first + share * (axes.last - axes.first)
        cv2.line(drawn, (at, low), (at, high), faint, 1)
        cv2.line(drawn, (low, low + high - at), (high, low + high - at), faint, 1)
        write(f"{value[0]:.3g}", at - 20, high + 20)
        write(f"{value[1]:.3g}", 6, low + high - at + 4)
    inside = ((ring >= axes.first) & (ring <= axes.last)).all(1)
    for x, y in np.rint(axes.place(ring[inside])).astype(int):
        cv2.circle(drawn, (int(x), int(y)), 1, dots, -1, cv2.LINE_AA)
    fitted = axes.line(line)
    if np.abs(fitted).max() < 1e6:  # OpenCV's coordinates are short
        start, end = ((round(float(x)), round(float(y))) for x, y in fitted)
        seen, start, end = cv2.clipLine((low, low, high - low + 1, high - low + 1), start, end)
        if seen:
            cv2.line(drawn, start, end, drawn_line, 2, cv2.LINE_AA)
    words = f"s_f = {scale:.3g}" if scale else "s_f = 0: not used"
    write(f"{words} (fitted {line[0]:.3g})", low, 24, 0.55, drawn_line, 2)
    write("prior", (low + high) // 2 - 16, high + 44, 0.45)
    write("disparity of the scene", 6, 46, 0.45)
    return drawn


def offset_colours(image: np.ndarray, rows: np.ndarray, cols: np.ndarray) -> np.ndarray:
    """Offsets of a mapping field: hue is the direction, brightness the length."""
    y, x = np.mgrid[: rows.shape[0], : rows.shape[1]]
    dy, dx = (rows - y).astype(np.float32), (cols - x).astype(np.float32)
    length, angle = np.hypot(dx, dy), np.degrees(np.arctan2(dy, dx)) % 360
    there = rows >= 0
    longest = max(1.0, float(length[there].max())) if there.any() else 1.0
    hsv = np.stack([angle / 2, np.full_like(angle, 200), 80 + 175 * np.clip(length / longest, 0, 1)], -1)
    colour = cv2.cvtColor(hsv.astype(np.uint8), cv2.COLOR_HSV2RGB)
    return np.where(there[..., None], colour, image // 2)
