"""Which Gaussians go: the object, its halo and its smears; not the floor that the box cuts into."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scenes import BLOCK, block, cameras, discs, floor, scene, truth

from gimp3d.box import Box, Region
from gimp3d.gaussians import Gaussians
from gimp3d.pipeline import render_bytes
from gimp3d.raster import render, surface_depth
from gimp3d.stages.masks import Masks, MaskSettings, find_masks
from gimp3d.stages.selection import Fate, SelectionSettings, select_removed, standing

DEEP = (Box.make([0, 0, 0.2], [0.9, 0.9, 0.72]),)  # cuts 16 cm into the floor, a hand's width round the block
VIEWS = cameras(12, 200, 150)
FLOOR = len(floor(with_hole=True))
RED = np.array([0.85, 0.12, 0.1])


def balls(points: np.ndarray, colours: np.ndarray, size: float, opacity_logit: float) -> Gaussians:
    made = discs(np.asarray(points, float), (0, 0, 1), np.asarray(colours, float), size)
    made.log_scales[:] = np.log(size)
    made.opacity_logits[:] = opacity_logit
    return made


def found(gaussians: Gaussians, region: Region = DEEP, clean: Gaussians | None = None, **changed: float) -> Masks:
    """Masks with photos of the clean scene, by default of the scene itself."""
    photos = {c.id: render_bytes(gaussians if clean is None else clean, c) for c in VIEWS}
    return find_masks(gaussians, region, VIEWS, MaskSettings(selection=SelectionSettings(**changed)), photos=photos)


def test_floor_in_the_box_stays_and_the_object_goes() -> None:
    masks = found(scene())
    fates = masks.selection.fates
    distance = np.abs(scene().means[:FLOOR, :2]).max(1) - BLOCK / 2
    inside = select_removed(scene(), DEEP)[:FLOOR]
    assert (fates[FLOOR:] >= Fate.REMOVED_INSIDE).all()
    assert inside.sum() > 200 and (fates[:FLOOR][inside & (distance > 0.08)] < Fate.REMOVED_INSIDE).all()
    assert (fates[:FLOOR][inside] == Fate.KEPT_SURFACE).mean() > 0.5
    assert masks.removed[:FLOOR].mean() < 0.03 and not masks.removed[:FLOOR][distance > 0.1].any()
    assert sum(masks.selection.counts.values()) == (fates > 0).sum()
    assert "of floor or wall" in masks.reason and str(int(masks.removed.sum())) in masks.reason


@pytest.mark.parametrize("scale", [0.85, 1.0, 1.2])
@pytest.mark.parametrize("lower", [0.0, 0.1])
def test_the_box_may_be_drawn_carelessly(scale: float, lower: float) -> None:
    box = replace(DEEP[0], size=DEEP[0].size * scale, center=DEEP[0].center - [0, 0, lower])
    fates = found(scene(), (box,)).selection.fates
    assert (fates[FLOOR:][select_removed(scene(), (box,))[FLOOR:]] >= Fate.REMOVED_INSIDE).all()
    assert (fates[:FLOOR] >= Fate.REMOVED_INSIDE).mean() < 0.03


def test_parts_of_the_object_outside_a_small_box_keep_nothing_in_it() -> None:
    small = (Box.make([0, 0, 0.3], [0.4, 0.4, 0.5]),)
    masks = found(scene(), small)
    assert masks.selection.counts["kept_surface"] == 0
    assert masks.removed[select_removed(scene(), small)].all()


def test_straddlers_go_where_they_show_on_the_object_and_stay_elsewhere() -> None:
    low = (Box.make([0, 0, 0.224], [0.9, 0.9, 0.548]),)  # the block's top, at 0.5, sticks out by 2 mm
    fates = found(scene(), low).selection.fates
    top = scene().means[:, 2] > 0.49
    assert not select_removed(scene(), low)[top].any()
    assert (fates[top & (np.abs(scene().means[:, :2]) < 0.2).all(1)] == Fate.REMOVED_STRADDLING).all()
    edge = (np.abs(np.abs(scene().means[:FLOOR, :2]) - 0.45) < 0.02).any(1)  # floor astride the box's side
    assert Fate.KEPT_STRADDLING in fates[:FLOOR][edge] and (fates[:FLOOR][edge] < Fate.REMOVED_INSIDE).all()


def test_a_giant_of_the_background_stays_and_opens_no_hole() -> None:
    ground = balls([[0.1, 0.05, -0.03]], [[0.4, 0.5, 0.45]], 1.0, 4.0)
    ground.log_scales[:, 2] = np.log(0.002)
    rim = floor(with_hole=True)
    rim = rim.take((np.abs(rim.means[:, :2]) > 1.4).any(1))  # so that the giant is all there is near the block
    whole = rim.extended(block()).extended(ground)
    masks = found(whole)
    assert masks.selection.fates[-1] == Fate.KEPT_SURFACE and masks.selection.counts["kept_surface"] == 1
    for view in masks.views[::4]:
        before = render(whole, view.camera).alpha
        assert (view.alpha_after[~view.polygon] > before[~view.polygon] - 0.05).all()


def test_smears_under_and_behind_the_object_go_and_little_else() -> None:
    """Splats that no clean photo vouches for, planted into a clean scene: precision and recall."""
    rng = np.random.default_rng(0)
    under = rng.uniform([-0.2, -0.2, -0.04], [0.2, 0.2, 0.02], (90, 3))
    inside = rng.uniform([-0.2, -0.2, 0.05], [0.2, 0.2, 0.45], (90, 3))
    planted = balls(np.concatenate([under, inside]), np.tile(RED, (180, 1)), 0.02, 1.0)
    whole = scene().extended(planted)
    shallow = (Box.make([0, 0, 0.29], [0.9, 0.9, 0.5]),)  # from 4 cm above the floor on: most smears lie outside
    masks = found(whole, shallow, scene())
    wrong = np.zeros(len(whole), bool)
    wrong[FLOOR:] = True  # the block and all that was planted
    recall = masks.removed[-180:].mean()
    precision = wrong[masks.removed].mean()
    assert recall > 0.9, recall
    assert precision > 0.9, precision
    assert masks.selection.counts["removed_revealed"] > 0
    without = found(whole, shallow, scene(), support=0.0)
    assert without.removed[-180:].mean() < recall


def test_haze_behind_the_object_is_told_from_floor_by_the_photos() -> None:
    """Floaters behind the block, seen past it from the sides, where clean photos do not show them."""
    rng = np.random.default_rng(1)
    haze = balls(rng.uniform([-0.08, 0.28, 0.04], [0.08, 0.44, 0.2], (25, 3)), np.tile(RED, (25, 1)), 0.02, 3.0)
    whole = scene().extended(haze)
    tight = (Box.make([0, 0, 0.26], [0.56, 0.56, 0.56]),)
    front = tuple(c for c in VIEWS if c.centre[1] < 0.3)
    with_photos, without = (
        find_masks(whole, tight, front, photos={c.id: render_bytes(clean, c) for c in front})
        for clean in (scene(), whole)
    )
    assert with_photos.removed[-25:].sum() > without.removed[-25:].sum()
    assert with_photos.removed[-25:].mean() > 0.7
    assert with_photos.removed[:FLOOR].mean() < 0.03


def test_where_nothing_stands_on_the_surface_the_surface_itself_goes() -> None:
    patch = (Box.make([0, 0, 0], [0.5, 0.5, 0.2]),)
    masks = found(truth(), patch)
    assert (masks.removed == select_removed(truth(), patch)).all() and masks.removed.any()


def test_by_centre_is_the_papers_rule() -> None:
    masks = found(scene(), by_centre=True)
    assert (masks.removed == select_removed(scene(), DEEP)).all()
    assert set(np.unique(masks.selection.fates)) == {Fate.OUTSIDE, Fate.REMOVED_INSIDE}


def test_unusable_rows_are_never_removed_and_never_counted() -> None:
    g = scene()
    rows = np.flatnonzero(select_removed(g, DEEP))[[0, 300, 900]]
    g.sh[rows[0], 0, 0] = np.nan
    g.means[rows[1]] = np.nan
    g.quats[rows[2]] = 0
    masks = found(g)
    assert (masks.selection.fates[rows] == Fate.OUTSIDE).all() and masks.removed.sum() > 1000


def test_overlapping_boxes_are_their_union() -> None:
    halves = (Box.make([-0.1, 0, 0.2], [0.7, 0.9, 0.72]), Box.make([0.1, 0, 0.2], [0.7, 0.9, 0.72]))
    assert (select_removed(scene(), halves) == select_removed(scene(), DEEP)).all()
    one, two = found(scene()).removed, found(scene(), halves).removed
    assert two[FLOOR:].all() and (one != two).mean() < 0.01


def test_the_objects_foot_in_a_shadows_box_makes_it_no_object() -> None:
    foot, body, other = [True, True, False], [True, False, False], [False, False, True]
    views = [np.array([foot] * 30 + [body] * 50), np.array([foot] * 5 + [body] * 90 + [other] * 3)]
    assert standing(views, [1000, 1000]) == [True, False, True]
    assert standing(views, [1000, 2000]) == [True, False, False]  # three pixels of 2000 are too few
    assert standing([np.array([foot] * 9)], [1000]) == [True, False, False]  # of equal boxes one is enough
    assert standing([np.zeros((0, 3), bool)], [1000]) == [False] * 3


def test_a_box_round_a_shadow_takes_its_floor_and_masks_it() -> None:
    """It cuts into the block's foot and lies half outside the block's box."""
    box = Box.make([0.45, 0, 0], [0.5, 0.4, 0.1])
    masks = find_masks(scene(), (*DEEP, box), VIEWS)
    alone = box.contains(scene().means) & ~DEEP[0].contains(scene().means)
    assert alone[:FLOOR].sum() > 50 and masks.removed[alone].all()
    shown = 0  # in some views the block hides it all
    for view in masks.views:
        depth, _ = surface_depth(scene(), view.camera)
        points = view.camera.unproject(view.camera.pixel_centres(), depth.astype(float)).reshape(-1, 3)
        named = (box.contains(points) & ~DEEP[0].contains(points)).reshape(depth.shape) & (depth > 0)
        shown += named.sum()
        assert view.target[named].all()
        assert not view.depth_before[named].any()  # its photos are no evidence
    assert shown > 1000
