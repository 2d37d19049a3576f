"""What the removal leaves in the air goes, and targets are the charts' holes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import pytest
from scenes import BLOCK, REGION, cameras, charts_of, discs, floor, scene

from gimp3d.gaussians import Gaussians
from gimp3d.geometry import SOLID, dilated
from gimp3d.presets import PRESETS
from gimp3d.raster import footprint, render_bytes, surface_depth
from gimp3d.run import ViewState
from gimp3d.stages import clearing
from gimp3d.stages.charts import Chart, Hits, Plane, lay_planes
from gimp3d.stages.clearing import (
    ClearingSettings,
    chart_targets,
    clear_air,
    object_pixels,
    over_surfaces,
)
from gimp3d.stages.exposure import Exposure
from gimp3d.stages.look import box_polygon, fill_polygon
from gimp3d.stages.masks import Masks, ViewMasks
from gimp3d.stages.selection import Fate, Selection
from gimp3d.stages.witness import Says, Witness, ask
from gimp3d.steps.behind import Surfaces, chart_surfaces, find_surfaces

UP = np.array([0.0, 0, 1])
EYES = cameras(9, 160, 120)
TOLERANCE = 0.02
NONE = np.zeros((120, 160), bool)  # no marks
Targets = list[tuple[ViewMasks, Hits]]
RED = np.array([200, 20, 20], np.uint8)  # of the block; the floor is grey


@dataclass(frozen=True)
class Removal:
    """A scene whose block is to go, as its views show it."""

    scene: Gaussians
    selection: Selection
    views: list[ViewMasks]
    witnesses: list[Witness]


def removal(extra: Gaussians | None = None) -> Removal:
    """The block scene and further Gaussians, which stay."""
    whole = scene()
    object_ = np.arange(len(whole)) >= len(floor(with_hole=True))
    fates = np.where(object_, Fate.REMOVED_INSIDE, Fate.OUTSIDE).astype(np.uint8)
    if extra is not None:
        whole = whole.extended(extra)
        fates = np.concatenate([fates, np.full(len(extra), Fate.OUTSIDE, np.uint8)])
    views = []
    for camera in EYES:
        depth, alpha = surface_depth(whole, camera)
        no = np.zeros(depth.shape, bool)
        views.append(ViewMasks(camera, no, no, no, no, depth, alpha, depth, alpha, no))
    selection = Selection(fates)
    (masks,) = object_pixels(whole, views, ClearingSettings(), selection.removed)
    grey, witnesses = np.full(3, 99, np.uint8), []
    for v, (shown, some) in zip(views, masks):
        photo = np.where(shown[..., None], RED, grey)
        witnesses.append(Witness(v.camera, photo, shown, some, v.alpha_before < SOLID, v.depth_before))
    return Removal(whole, selection, views, witnesses)


def specks(places: list[list[float]]) -> Gaussians:
    return discs(np.array(places), (0, 0, 1), np.full((len(places), 3), 0.5), 0.05)


@pytest.fixture(scope="module")
def plain() -> Removal:
    return removal()


@pytest.fixture(scope="module")
def charts(plain: Removal) -> tuple[Chart, ...]:
    return charts_of([Plane.make(np.zeros(3), UP, REGION)], plain.witnesses)


@pytest.fixture(scope="module")
def targets(plain: Removal, charts: tuple[Chart, ...]) -> Targets:
    p = plain
    return chart_targets(p.scene, p.selection, p.views, p.witnesses, charts, [NONE] * len(EYES))


def cleared(
    removal: Removal,
    witnesses: list[Witness] | None = None,
    observed: float = 0.2,
    beside: Sequence[int] = (),
) -> np.ndarray:
    """Rows that clear_air removes on top of the selection's."""
    settings = ClearingSettings(observed=observed)
    told = removal.witnesses if witnesses is None else witnesses
    shown = np.isin(np.arange(len(removal.scene)), beside)
    after = clear_air(removal.scene, REGION, removal.selection, told, shown, settings)
    new = after.removed & ~removal.selection.removed
    assert (after.fates[new] == Fate.REMOVED_REVEALED).all()
    np.testing.assert_array_equal(after.fates[~new], removal.selection.fates[~new])
    return np.flatnonzero(new)


def test_photos_show_the_object_where_its_gaussians_draw(plain: Removal) -> None:
    for view, witness in zip(plain.views, plain.witnesses):
        weight = footprint(plain.scene, view.camera, plain.selection.removed)
        assert witness.hidden[weight > 0.5].mean() > 0.99
        assert (witness.beside | ~witness.hidden).all()  # some of it is where it is
        near = np.zeros_like(weight, bool)
        rows, cols = np.nonzero(weight > 0.1)
        for dy in (-1, 0, 1):
            for dx in (-1, 0, 1):
                near[np.clip(rows + dy, 0, 119), np.clip(cols + dx, 0, 159)] = True
        assert not (witness.hidden | witness.beside)[~near].any()


OFF = 0.45  # x of places on the floor beside the block


def test_what_photos_show_beside_the_object_is_no_haze() -> None:
    given = removal(specks([[0, 0, 0.25]]))
    haze = len(given.scene) - 1
    assert haze in cleared(given) and haze not in cleared(given, beside=[haze])


def test_low_over_a_surface_and_below_it(plain: Removal) -> None:
    places = [[OFF, 0, -0.02], [OFF, 0.1, 0.01], [OFF, 0, -0.3], [OFF, 0, 0.3], [0, 0, -0.02]]
    laid = lay_planes([Plane.make(np.zeros(3), UP, REGION)], plain.witnesses, REGION)
    low, sunk = over_surfaces(specks(places), REGION, laid)
    assert list(np.flatnonzero(low)) == [0, 1, 4] and list(np.flatnonzero(sunk)) == [0, 2, 4]
    assert not np.any(over_surfaces(specks(places), REGION, ()))


def test_floor_that_selection_took_is_no_object_in_photos() -> None:
    """Photos show it beside the block, whatever a box that cuts into the floor made of it."""
    plain = removal()
    ring = (np.abs(plain.scene.means[:, :2]).max(1) < OFF) & (plain.scene.means[:, 2] < 0.01)
    whole = replace(plain.scene, means=plain.scene.means - np.float32([0, 0, 0.01]) * ring[:, None])
    taken = np.where(ring, np.uint8(Fate.REMOVED_INSIDE), plain.selection.fates)
    gone = taken >= Fate.REMOVED_INSIDE
    boxes = [
        fill_polygon(outline, v.camera) for v in plain.views if (outline := box_polygon(*REGION, v.camera)) is not None
    ]
    seen = tuple(
        replace(v, polygon=box, weight=footprint(whole, v.camera, gone))
        for v, box in zip(plain.views, boxes, strict=True)
    )
    masks = Masks(Selection(taken), seen, "need", 1.0, "")
    photos = [render_bytes(whole, v.camera) for v in plain.views]
    levelled = Exposure(np.ones(3))
    views = [ViewState.first(v, photo, levelled) for v, photo in zip(plain.views, photos)]
    found = find_surfaces(whole, REGION, masks, views, PRESETS["balanced"])
    fates = found.selection.fates[: len(whole)]
    back = ring & (fates == Fate.KEPT_SURFACE)
    outside = np.abs(plain.scene.means[:, :2]).max(1) > BLOCK / 2 + 0.06
    assert back[ring & outside].mean() > 0.9
    assert (fates >= Fate.REMOVED_INSIDE)[plain.selection.removed & ~ring].all()
    # what reaches under the block is split: it stays in its place, and its other part goes
    parts, split = np.arange(len(whole), len(found.scene)), found.split
    assert len(parts) == len(split) > 0 and found.selection.removed[parts].all() and ring[split].all()
    off = [np.abs(found.scene.means[rows, :2]).max(1).mean() for rows in (parts, split)]
    assert off[0] < np.abs(whole.means[split, :2]).max(1).mean() < off[1]
    same = np.setdiff1d(np.arange(len(whole)), split)
    np.testing.assert_array_equal(found.scene.means[same], whole.means[same])
    for view, (hidden, _), witness in zip(plain.views, found.objects, plain.witnesses):
        taken_for_it = footprint(whole, view.camera, Selection(taken).removed) > 0.5
        assert (taken_for_it & ~witness.hidden).sum() > 5 * (hidden & ~dilated(witness.hidden, 3)).sum()


def test_haze_within_the_object_goes_and_what_photos_see_stays() -> None:
    given = removal(specks([[0, 0, 0.25], [0.1, -0.1, 0.3], [0.5, 0.45, 0.3], [0, 0, 0.75]]))
    new = cleared(given)
    first = len(given.scene) - 4
    assert {first, first + 1} <= set(new) and not {first + 2, first + 3} & set(new)
    inside = np.abs(given.scene.means[new]).max(1) < BLOCK
    assert inside.all()  # nothing but what the block hid


def test_the_floor_round_the_object_stays(plain: Removal) -> None:
    """But for splats (0.03 apart) that only pixels at the object's edge show."""
    gone = plain.scene.means[cleared(plain)]
    assert (np.abs(gone[:, :2]) < BLOCK / 2 + 0.08).all()


def test_what_one_photo_sees_stays() -> None:
    """Although the object hides it in all the others."""
    given = removal(specks([[0.36, 0.1, 0.3]]))
    row = len(given.scene) - 1
    blind = [replace(w, hidden=np.ones_like(w.hidden)) for w in given.witnesses]
    assert row in cleared(given, blind)
    told = ask(given.witnesses, given.scene.means[row:].astype(np.float64), TOLERANCE)[:, 0]
    assert {Says.SEEN, Says.HIDDEN} <= set(told)
    for k, witness in enumerate(given.witnesses):
        if told[k] in (Says.SEEN, Says.HIDDEN):
            new = cleared(given, [*blind[:k], witness, *blind[k + 1 :]])
            assert (row in new) == (told[k] == Says.HIDDEN)


def test_what_is_only_seen_right_beside_the_object_is_not_vouched_for() -> None:
    """There a pixel may show the object's own edge."""
    given = removal(specks([[0.36, 0.1, 0.3]]))
    row = len(given.scene) - 1
    assert row not in cleared(given)
    everywhere = np.ones((120, 160), bool)
    assert row in cleared(given, [replace(w, beside=everywhere) for w in given.witnesses])


def test_far_haze_and_haze_that_draws_nothing_stay() -> None:
    faint = replace(specks([[0, 0, 0.25]]), opacity_logits=np.full(1, -12, np.float32))
    given = removal(specks([[1.4, 0, 0.2]]).extended(faint))
    blind = [replace(w, hidden=np.ones_like(w.hidden)) for w in given.witnesses]
    new = set(cleared(given, blind))
    assert not {len(given.scene) - 2, len(given.scene) - 1} & new and new


def test_haze_is_what_no_photo_shows_by_a_share_of_its_blend_weight(monkeypatch: pytest.MonkeyPatch) -> None:
    given = removal(specks([[0, 0, 0.25], [0.5, 0.45, 0.3], [0.3, 0, 0.1]]))
    kept, gone = given.scene.take(~given.selection.removed), []
    for row in (-3, -2, -1):
        chosen = np.zeros(len(kept), bool)
        chosen[row] = True
        for least in (0.0, 0.2, 0.8, 0.999):
            count, behind = 0, 0.0
            for view, told in zip(given.views, given.witnesses):
                weight = footprint(kept, view.camera, chosen)
                covered = float(weight[told.hidden].sum())
                seen = float(weight[~told.hidden & ~told.beside].sum())
                count, behind = count + (seen > 0.5 and seen >= least * (seen + covered)), behind + covered
            for weight_, enough in ((0.999 * behind, behind > 0), (1.001 * behind, False)):
                monkeypatch.setattr(clearing, "HAZE_WEIGHT", weight_)
                found = len(given.scene) + row in cleared(given, observed=least)
                assert found == (count == 0 and enough)
                gone.append(found)
    assert any(gone) and not all(gone[::2])


def test_targets_lie_where_the_object_was_and_meet_a_chart(plain: Removal, targets: Targets) -> None:
    assert len(targets) == len(EYES)
    for (view, hits), witness in zip(targets, plain.witnesses):
        touched = footprint(plain.scene, view.camera, plain.selection.removed) > 0.05
        assert view.target.any()
        assert not (view.target & ~(witness.hidden | touched)).any()
        assert not (view.target & (hits.depth == 0)).any()
        np.testing.assert_array_equal(view.silhouette, witness.hidden | witness.beside)


def test_targets_are_the_floor_s_hole_below_the_block(plain: Removal, targets: Targets) -> None:
    for (view, _), witness in zip(targets, plain.witnesses):
        camera = view.camera
        rays = camera.unproject(camera.pixel_centres(), np.ones(view.target.shape)) - camera.centre
        with np.errstate(divide="ignore"):
            z = -camera.centre[2] / rays[..., 2]
        place = np.abs(camera.centre + np.where(z > 0, z, 1e6)[..., None] * rays)[..., :2].max(-1)
        assert (place < BLOCK / 2 - 0.06).sum() > 50
        assert view.target[(place < BLOCK / 2 - 0.06) & witness.hidden].all()
        far = cv2.distanceTransform((place > BLOCK / 2 + 0.06).astype(np.uint8), cv2.DIST_L2, 5)
        assert far[view.target].max() < 2.5  # closed and grown by a pixel each


def test_targets_hold_the_charts_holes(plain: Removal, charts: tuple[Chart, ...], targets: Targets) -> None:
    for (view, hits), witness in zip(targets, plain.witnesses):
        met = hits.chart == 0
        hole = np.zeros(met.shape, bool)
        hole[met] = charts[0].hole[hits.rows[met], hits.cols[met]]
        before = (view.alpha_after >= 0.5) & (view.depth_after > 0)
        before &= view.depth_after < (1 - charts[0].tolerance) * hits.depth
        assert view.target[hole & witness.hidden & ~before].all()
        assert not (view.target & before).any()


def test_what_stays_before_the_floor_is_not_filled(charts: tuple[Chart, ...], targets: Targets) -> None:
    """A board within the block that other photos saw, and pixels of a surface in front of the block."""
    given = removal(discs(np.array([[0, 0, 0.3]]), (0, 0, 1), np.full((1, 3), 0.5), 0.09))
    views = list(given.views)
    bar = np.zeros((120, 160), bool)
    bar[:, 70:75] = True
    views[3] = replace(views[3], occluder=bar)
    found = chart_targets(given.scene, given.selection, views, given.witnesses, charts, [NONE] * len(EYES))
    board = np.arange(len(given.scene)) == len(given.scene) - 1
    kept = given.scene.take(~given.selection.removed)
    lost = 0
    for (view, _), (plain_view, _) in zip(found, targets):
        solid = footprint(kept, view.camera, board[~given.selection.removed]) > 0.8
        assert solid.any() and not (view.target & solid).any()
        lost += int((plain_view.target & solid).sum())
    assert lost > 50
    assert (targets[3][0].target & bar).any() and not (found[3][0].target & bar).any()


def test_marked_pixels_are_filled_too(plain: Removal, charts: tuple[Chart, ...], targets: Targets) -> None:
    mark = np.zeros((120, 160), bool)
    mark[5:15, 8:30] = True
    marks = [mark if k == 2 else NONE for k in range(len(EYES))]
    p = plain
    found = chart_targets(p.scene, p.selection, p.views, p.witnesses, charts, marks)
    for k, ((view, _), (without, _)) in enumerate(zip(found, targets)):
        np.testing.assert_array_equal(view.target, without.target | mark if k == 2 else without.target)


def test_views_after_are_those_of_the_emptied_scene(plain: Removal, targets: Targets) -> None:
    kept = plain.scene.take(~plain.selection.removed)
    for view, _ in targets:
        depth, alpha = surface_depth(kept, view.camera)
        np.testing.assert_allclose(view.alpha_after, alpha, atol=1e-5)
        both = (depth > 0) & (view.depth_after > 0)
        np.testing.assert_allclose(view.depth_after[both], depth[both], rtol=1e-5)


def test_without_charts_there_is_no_confidence(plain: Removal) -> None:
    views = [ViewState.first(v, w.photo, Exposure(np.ones(3))) for v, w in zip(plain.views, plain.witnesses)]
    objects = [(w.hidden, w.beside) for w in plain.witnesses]
    none = np.zeros(len(plain.scene), bool)
    surfaces = Surfaces(
        (), (), plain.selection, none, objects, objects, (NONE,) * len(EYES), 1.0, "", plain.scene, np.zeros(0, int)
    )
    found = chart_surfaces(REGION, surfaces, views)
    assert not found.charts and found.confidence == 0 and found.reason.startswith("no surface")
