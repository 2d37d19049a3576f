"""What is behind the object: its surfaces in the light that they would have without it, and where they are unknown."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from .box import Region
from .gaussians import Gaussians
from .run import Run, ViewState
from .stages.charts import Chart
from .stages.exposure import exposures_of, levelled
from .stages.masks import Masks
from .steps.behind import (
    NOT_LIT,
    Charted,
    Relit,
    Surfaces,
    chart_surfaces,
    clear_round,
    find_light,
    find_surfaces,
    relearn,
    undo_light,
    with_contact,
)

LIGHT = ("light", "lift", "contact", "lift 2", "charts 2", "lift 3")  # stages that a removal with --shadow off lacks
# stages that know nothing of fills
BEFORE_FILL = ("masks", "exposure", "surfaces", "charts", *LIGHT, "surfaces 2", "charts 3", "clear", "relearn")


@dataclass(frozen=True)
class Behind:
    """What is behind the object, and the scene in the light that it would have without it."""

    before: Gaussians  # the scene with the object, in that light
    scene: Gaussians  # the same, but what stays round the object is learned anew
    changed: np.ndarray  # [M] rows of it that are not as they came
    masks: Masks  # with what had to be cleared away; if there are charts, T is what no photo shows of them
    views: tuple[ViewState, ...]
    charts: tuple[Chart, ...]
    lit: Relit
    parts: int = 0  # the scenes' last rows, that came by splitting and go

    def recoloured(self, kept: Gaussians, rows: np.ndarray) -> Behind:
        """With what stays, of which the rows [M] have other colours now."""
        stays = np.flatnonzero(~self.masks.removed)
        scene = self.scene.with_rows(stays[rows], kept.take(rows))
        return replace(self, scene=scene, changed=np.union1d(self.changed, stays[rows]))


def look_behind(
    run: Run,
    scene: Gaussians,
    region: Region,
    masks: Masks,
    photos: Mapping[str, np.ndarray],  # ID → [H, W, 3] uint8, of every view
    shadow_masks: Mapping[str, np.ndarray],
) -> Behind:
    """Level the photos, find the surfaces that the object hid, undo its shadow and reflection, draw the charts."""
    settings, region, lit = run.settings, masks.grown(region), NOT_LIT
    if not masks.removed.any():
        return Behind(scene, scene, lit.rows, masks, (), (), lit)
    exposures = run("exposure", exposures_of, scene.take(~masks.removed), masks.views, photos, words=levelled)
    views = tuple(ViewState.first(v, photos[v.camera.id], e) for v, e in zip(masks.views, exposures))
    if settings.charts is None or masks.mode != "need":
        return Behind(scene, scene, lit.rows, masks, views, (), lit)
    inputs = scene, region, masks, views, settings
    surfaces = run("surfaces", find_surfaces, *inputs)
    masks = replace(masks, selection=surfaces.selection)

    def in_light(found: Relit, suffix: str = "") -> tuple[Relit, Surfaces, Charted]:
        """What the object does to the light undone, and the surfaces and their charts as they are then."""
        light = run(f"lift{suffix}", undo_light, surfaces, views, found) if found.effects else None
        lit = replace(found, lifted=light)
        bounded = surfaces if light is None else surfaces.with_marked(light.dark)
        return lit, bounded, run(f"charts{suffix}", chart_surfaces, region, bounded, lit.views(views))

    found = NOT_LIT
    if settings.shadow != "off":
        found = run("light", find_light, region, surfaces, views, shadow_masks, settings)
        if isinstance(found.shadow, str) and settings.shadow == "mask":
            run.warnings.append(found.shadow)
    lit, bounded, charted = in_light(found)
    if settings.shadow != "off":
        found = run("contact", with_contact, found, charted.charts)
        if isinstance(found.contact, str):
            lit = replace(found, lifted=lit.lifted)
        else:
            lit, bounded, charted = in_light(found, " 2")
    if surfaces.planes and not charted.charts:  # photos of plain textures agree anywhere
        surfaces = run("surfaces 2", find_surfaces, *inputs, False)
        masks = replace(masks, selection=surfaces.selection)
        lit, bounded, charted = in_light(found, " 3")
    scene, views = lit.scene(surfaces.scene), lit.views(views)
    if charted.charts:
        cleared = run("clear", clear_round, scene, region, bounded, charted.charts, views, settings)
        masks = replace(masks, selection=cleared.selection, views=tuple(m for m, _ in cleared.targets))
        views = tuple(replace(v, masks=m, left=m, hits=h) for v, (m, h) in zip(views, cleared.targets))
    changed = np.setdiff1d(np.union1d(lit.rows, surfaces.split), np.flatnonzero(masks.removed))
    behind = Behind(scene, scene, changed, masks, views, charted.charts, lit, len(surfaces.split))
    if not settings.refine.steps:
        return behind
    given = scene, region, masks.removed, views, charted.charts, settings, run.progress
    learned = run("relearn", relearn, *given)
    scene = scene.with_rows(learned.rows, learned.gaussians)
    return replace(behind, scene=scene, changed=np.union1d(changed, learned.rows))
