"""Pictures of what stages did, for the report and the preview."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

import numpy as np

from .compute.threads import parallel_map
from .gaussians import Gaussians
from .geometry import window_mask
from .raster import footprint, touched_window
from .run import Picture
from .stages.charts import Chart
from .stages.depth import DepthCompletion
from .stages.mapping import MappingField
from .stages.masks import Masks
from .stages.propagate import Propagation
from .stages.view_refinement import ViewRefinement
from .steps.completion import Completed
from .steps.light import Relit
from .view_state import ViewState

T = TypeVar("T")
SPREAD = 3  # views that are shown of many
SHOWN = 0.25  # blend weight of what the boxes cut off from which a pixel is marked


def spread(items: Sequence[T]) -> list[T]:
    """A few of many, evenly."""
    return [items[k * len(items) // SPREAD] for k in range(min(SPREAD, len(items)))]


def of_targets(views: Sequence[ViewState]) -> list[Picture]:
    return [Picture("mask", f"Region to fill in {v.id}", v.photo, (v.left.target,)) for v in spread(views)]


def of_charts(charts: Sequence[Chart]) -> list[Picture]:
    return [Picture("chart", f"What photos show of {c.camera.id}", c.image, (c.hole,)) for c in charts]


def of_growth(scene: Gaussians, masks: Masks, views: Sequence[ViewState]) -> list[Picture]:
    """What of the object the boxes cut off, in the two views that show most of it."""
    if masks.growth is None or not masks.growth.rows.any():
        return []
    rows, title = masks.growth.rows, "Taken along" if masks.growth.taken else "Cut off by the box"
    cut = scene.take(rows)

    def shown(v: ViewState) -> np.ndarray:
        window = window_mask(touched_window(cut, v.camera), v.camera)
        return footprint(scene, v.camera, rows, pixels=window) > SHOWN

    most = sorted(zip(views, parallel_map(shown, views)), key=lambda pair: -int(pair[1].sum()))[:2]
    return [Picture("mask", f"{title}, in {v.id}", v.photo, (mask,)) for v, mask in most]


def of_light(lit: Relit, camera_ids: Sequence[str], shown: Sequence[str] | None = None) -> list[Picture]:
    """Photos, the light that arrives, and the photos as they would be, of views by ID or the two that change most."""
    if lit.lifted is None:
        return []
    lifted = lit.lifted
    order = sorted(range(len(camera_ids)), key=lambda k: -int(lifted.shaded[k].sum()))[:2]
    if shown is not None:
        order = [k for k, name in enumerate(camera_ids) if name in shown]
    what = [name for name, facts in (("shadow", lit.shadow), ("reflection", lit.reflection)) if facts["found"]]
    title = f"The object's {' and '.join(what)} in {{}}: photo, what is left alone, undone"
    return [
        Picture("shadow", title.format(camera_ids[k]), lifted.before[k], (lifted.light[k], lifted.photos[k]))
        for k in order
        if lifted.shaded[k].any()
    ]


def of_depth(
    completion: DepthCompletion, depth: np.ndarray, target: np.ndarray, image: np.ndarray, name: str
) -> list[Picture]:
    """The completed surface, and how the depth prior was scaled, if there was one."""
    shown = [Picture("depth", f"Completed surface in {name}", image, (depth, target))]
    if len(completion.fit.ring):
        data = (completion.fit.ring, np.array(completion.fit.line), np.array([completion.fit.scale]))
        shown.append(Picture("fit", f"Scale of the depth prior, measured round the hole of {name}", image, data))
    return shown


def of_reference(completed: Completed, field: MappingField | None) -> list[Picture]:
    image, name = completed.appearance.image, completed.camera.id
    shown = [Picture("appearance", f"The reference without the object, {name}", image, (completed.target,))]
    if field is not None:
        shown.append(Picture("mapping", f"Mapping field of {name}", image, (field.rows, field.cols)))
    return shown


def of_painting(painting: Propagation, views: Sequence[ViewState]) -> list[Picture]:
    """Filled views: raw, blended, and by which rule."""
    before, shown = {v.id: v.painted for v in views}, []
    for p in spread(painting.views):
        was, title = before[p.camera_id], f"Filled view {p.camera_id}"
        shown.append(Picture("rules", title, p.pasted(was), (p.rule_map(*was.shape[:2]), p.pasted(was, p.raw))))
    return shown


def of_refinement(asked: ViewRefinement, views: Sequence[ViewState]) -> list[Picture]:
    before = {v.id: v.painted for v in views}
    shown = [
        Picture("refined", f"{a.camera_id} refined: before, after", a.image, (before[a.camera_id],))
        for a in asked.views
        if a.image is not None
    ]
    return spread(shown)
