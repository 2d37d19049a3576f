"""The surfaces behind the object: the planes that run in behind it, their charts, the air before them, and T."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..box import Region
from ..errors import IllPosed
from ..gaussians import Gaussians
from ..presets import RemovalSettings
from ..stages.charts import Chart, Laid, Plane, draw_charts, find_planes, lay_planes
from ..stages.clearing import Targets, chart_targets, clear_air, hiding_rests, object_pixels, sunk_rows, with_surface
from ..stages.masks import Masks
from ..stages.selection import Selection
from ..stages.witness import Witness
from ..view_state import ViewState


@dataclass(frozen=True)
class Surfaces:
    """What is round the object, and where photos show it; tuples are of the masks' views."""

    planes: tuple[Plane, ...]
    laid: tuple[Laid, ...]  # those of which the object hides something
    selection: Selection  # without what photos show to be surface
    objects: tuple[tuple[np.ndarray, np.ndarray], ...]  # see object_pixels
    marked: tuple[np.ndarray, ...]  # [H, W] bool, what the user named beside the object, and what is too dark to lift
    confidence: float
    reason: str

    def witnesses(self, views: Sequence[ViewState]) -> list[Witness]:
        return [
            Witness(v.camera, v.bare, hidden | marked, beside, v.masks.depth_before)
            for v, (hidden, beside), marked in zip(views, self.objects, self.marked)
        ]

    def with_marked(self, more: Sequence[np.ndarray]) -> Surfaces:
        return replace(self, marked=tuple(a | b for a, b in zip(self.marked, more)))


def find_surfaces(
    scene: Gaussians,
    region: Region,
    masks: Masks,
    views: Sequence[ViewState],
    settings: RemovalSettings,
    settled: bool = True,
) -> Surfaces:
    """The planes that run into what the object hid, settled by photos or as they are drawn."""
    assert settings.charts is not None
    if all(view.silhouette.all() for view in masks.views):
        raise IllPosed("the object hides everything in every view: nothing is left to fill from, add views")
    # What the user named beside the object, by a mask or a box of its own: masks let no depth stand there.
    marked = tuple(v.silhouette & v.target & (v.depth_before == 0) & (v.alpha_before > 0) for v in masks.views)
    objects = tuple(object_pixels(scene, masks.removed, masks.views, settings.clearing))
    rough = Surfaces((), (), masks.selection, objects, marked, 1.0, "")
    witnesses = rough.witnesses(views)
    planes = find_planes(masks.views, witnesses, region, settings.charts, settled)
    laid = lay_planes(planes, masks.views, witnesses, region, settings.charts)
    reason = f"{len(planes)} planes run into what the object hid"
    found = replace(rough, planes=planes, laid=laid, reason=reason)
    sunk = sunk_rows(scene, masks.selection, laid)
    if not len(sunk):
        return found

    def hidden_by(removed: np.ndarray) -> Surfaces:
        return replace(found, objects=tuple(object_pixels(scene, removed, masks.views, settings.clearing)))

    standing = masks.removed
    standing[sunk] = False
    charts = draw_charts(laid, hidden_by(standing).witnesses(views), region, marked)
    selection = with_surface(masks.selection, scene, sunk, charts)
    given = int((masks.removed & ~selection.removed).sum())
    return replace(
        hidden_by(selection.removed), selection=selection, reason=f"{reason}, {given} Gaussians of theirs stay"
    )


@dataclass(frozen=True)
class Charted:
    """The surfaces that the object hid, seen straight on, and what follows from them."""

    charts: tuple[Chart, ...]
    selection: Selection  # with what had to be cleared away
    targets: Targets
    confidence: float
    reason: str


def chart_surfaces(
    scene: Gaussians, region: Region, surfaces: Surfaces, views: Sequence[ViewState], settings: RemovalSettings
) -> Charted:
    """Show the hidden surfaces, clear the air before them, and say where they have to be filled."""
    witnesses, marked, masks = surfaces.witnesses(views), surfaces.marked, [v.masks for v in views]
    charts = draw_charts(surfaces.laid, witnesses, region, marked)
    if not charts:
        return Charted((), surfaces.selection, Targets((), ()), 0.0, "no surface runs into what the object hid")
    tolerance, witnesses = max(c.tolerance for c in charts), hiding_rests(witnesses, charts)
    selection = clear_air(scene, region, surfaces.selection, masks, witnesses, charts, settings.clearing)
    targets = chart_targets(scene, selection, masks, witnesses, charts, tolerance, marked, settings.clearing)
    words = [f"{c.kind}: {c.reason}, {int(c.hole.sum())} texels that no photo shows" for c in charts]
    cleared = int((selection.removed & ~surfaces.selection.removed).sum())
    return Charted(charts, selection, targets, charts[0].agreement, "; ".join([*words, f"{cleared} of haze go"]))
