"""Target regions: exactly what the object hid, from every view."""

from __future__ import annotations

from dataclasses import FrozenInstanceError, replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from property_tests import examples
from scenes import BLOCK, REGION, block, cameras, charted, discs, floor, scene, truth

from gimp3d.box import Box, read_region
from gimp3d.camera import Camera
from gimp3d.compute.threads import set_thread_count
from gimp3d.errors import BadInput, IllPosed
from gimp3d.io.cameras import read_cameras
from gimp3d.io.images import load_view, read_mask
from gimp3d.io.ply import read_ply
from gimp3d.orbit import look_at
from gimp3d.pipeline import render_bytes
from gimp3d.raster import Backend, Drawing, render, surface_depth
from gimp3d.stages import look, selection
from gimp3d.stages import masks as stage
from gimp3d.stages.masks import MaskSettings, ViewMasks, find_masks
from gimp3d.stages.selection import SelectionSettings

RIM = np.ones((3, 3), np.uint8)  # a 1-px rim on every side


def test_the_target_covers_the_hole_and_little_more() -> None:
    masks = charted(scene(), REGION, cameras()).masks
    assert masks.removed.sum() >= len(block())
    for view in masks.views:
        true = render(truth(), view.camera).median_depth
        points = view.camera.unproject(view.camera.pixel_centres(), true.astype(float))
        under = (true > 0) & (np.abs(points[..., :2]) < BLOCK / 2 - 0.02).all(-1)
        assert (view.target & under).sum() >= 0.97 * under.sum(), view.camera.id
        assert view.target.sum() <= view.silhouette.sum()
        assert not view.target[true == 0].any() or view.target[true == 0].sum() < 0.1 * view.target.sum()


@pytest.mark.parametrize("zoom", [0.3, 0.5])
def test_holes_of_a_few_pixels_are_in_the_target(zoom: float) -> None:
    """Rows of the floor under the block, one to four pixels high in the views from low down."""
    views = [replace(c, fx=zoom * c.fx, fy=zoom * c.fy) for c in cameras()]
    found = charted(scene(), REGION, views).masks.views
    hidden = [hidden_floor(v.camera) for v in found]
    assert min(h.sum() for h in hidden) < 25 and all(h.any() for h in hidden)
    assert sum((v.target & h).sum() for v, h in zip(found, hidden)) > 0.97 * sum(h.sum() for h in hidden)


def test_need_is_smaller_than_paper_and_both_lie_where_the_object_was() -> None:
    need = charted(scene(), REGION, cameras()).masks
    paper = find_masks(scene(), REGION, cameras(), MaskSettings(mode="paper"))
    assert 0 < need.hole_pixels < paper.hole_pixels
    for view in paper.views:
        assert not (view.target & ~view.polygon).any()


def test_cameras_inside_the_region_are_left_out() -> None:
    inside = Camera(
        "inside", 60, 40, 50, 50, 30, 20, look_at(np.array([0.1, 0, 0.2]), np.ones(3), np.array([0, 0, 1.0]))
    )
    masks = find_masks(scene(), REGION, [*cameras(), inside])
    assert len(masks.views) == 9 and "inside" not in {v.camera.id for v in masks.views}


def test_nothing_selected_everything_selected_no_view_and_unknown_mode() -> None:
    far = (Box.make([0, 0, 50], [1, 1, 1]),)
    empty = find_masks(scene(), far, cameras())
    assert not empty.removed.any() and empty.hole_pixels == 0
    with pytest.raises(IllPosed, match="whole scene"):
        find_masks(scene(), (Box.make([0, 0, 0], [99, 99, 99]),), cameras())
    behind = [replace(c, viewmat=np.diag([-1.0, 1, -1, 1]) @ c.viewmat) for c in cameras()]
    with pytest.raises(IllPosed, match="no usable view"):
        find_masks(scene(), REGION, behind)
    with pytest.raises(BadInput, match="unknown mode"):
        find_masks(scene(), REGION, cameras(), MaskSettings(mode="other"))


def test_views_of_mixed_sizes_and_intrinsics() -> None:
    mixed = [c.scaled(f) for c, f in zip(cameras(), (1, 0.5, 1.3, 0.77, 1, 1, 1, 1, 1))]
    masks = charted(scene(), REGION, mixed).masks
    for view in masks.views:
        assert view.target.shape == (view.camera.height, view.camera.width) and view.target.any()


def hidden_floor(camera: Camera) -> np.ndarray:
    """[H, W] bool: pixels that show the floor under the block once it is gone."""
    depth, _ = surface_depth(truth(), camera)
    points = camera.unproject(camera.pixel_centres(), depth.astype(float))
    return (depth > 0) & (np.abs(points[..., :2]) < BLOCK / 2).all(-1)


@examples(10)
@given(seed=st.integers(0, 10_000), count=st.integers(5, 12), guessed=st.booleans())
def test_targets_of_all_views_agree(seed: int, count: int, guessed: bool) -> None:
    """A point that no view saw is in T of every view that frames it unoccluded, up to a 1-px rim; one way or the other.

    The floor under the block is a hole, or splats that a trainer guessed and no photo shows.
    """
    rng = np.random.default_rng(seed)
    chosen = rng.permutation(24)[:count]
    views = [c for k, c in enumerate(cameras(24, 140, 105)) if k in chosen]
    whole = (truth() if guessed else floor(with_hole=True)).extended(block())
    masks = charted(whole, REGION, views).masks
    inner = np.linspace(-0.22, 0.22, 23)
    points = np.stack([*(g.ravel() for g in np.meshgrid(inner, inner)), np.zeros(23 * 23)], -1)
    for view in masks.views:
        uv, z = view.camera.project(points)
        framed = (z > 0) & (uv >= 1).all(1) & (uv < np.array([view.camera.width, view.camera.height]) - 1).all(1)
        cols, rows = uv[framed].astype(int).T
        grown = cv2.dilate(view.target.astype(np.uint8), RIM) > 0
        assert grown[rows, cols].mean() > 0.99, view.camera.id


def test_what_a_view_saw_is_not_in_any_target() -> None:
    """Floor and wall behind the block, seen past it by others, stay out of T however many views the block hides them
    from."""
    wall = discs(
        np.stack(
            [*(g.ravel() for g in np.meshgrid(np.arange(-1.5, 1.5, 0.035), [-1.0], np.arange(0, 1.2, 0.035)))], -1
        ),
        (0, 1, 0),
        np.full((86 * 35, 3), 0.6),
        0.025,
    )
    front = [c for c in cameras(24, 140, 105) if c.centre[1] > -0.5]
    masks = charted(scene().extended(wall), REGION, front).masks
    assert len(front) > 12
    for view in masks.views:
        away = cv2.dilate(hidden_floor(view.camera).astype(np.uint8), RIM, iterations=6) == 0
        assert (view.target & away).sum() <= 0.02 * view.target.sum(), view.camera.id


def test_extra_masks_are_filled_and_never_evidence() -> None:
    """A painted shadow: in T of its views, out of what photos vouch for, and its splats go."""
    dark = scene()
    shadow = (np.abs(dark.means[:, :2] - [0.0, -0.5]) < 0.15).all(1) & (dark.means[:, 2] < 0.01)
    dark.sh[shadow] -= 0.8
    flat = dark.take(shadow)
    views = cameras(9, 140, 105)
    painted = {c.id: render(flat, c).alpha > 0.5 for c in views}
    masks = find_masks(dark, REGION, views, extra=painted)
    plain = find_masks(dark, REGION, views)
    assert masks.selection.counts["removed_masked"] > 0.5 * shadow.sum()
    assert masks.removed[shadow].mean() > 0.7 and not plain.removed[shadow].any()
    assert not masks.removed[~shadow & ~plain.removed].mean() > 0.02
    for view in masks.views:
        mask = painted[view.camera.id]
        assert view.target[mask].all() and view.silhouette[mask].all()
        assert not view.depth_before[mask].any()
    seen = [c for c in views if (painted[c.id] & (surface_depth(flat, c)[0] == surface_depth(dark, c)[0])).sum() > 40]
    some = find_masks(dark, REGION, views, extra={seen[0].id: painted[seen[0].id]})
    assert some.removed[shadow].mean() > 0.5  # one mask is enough, and fills the other views too
    both = charted(dark, REGION, views, extra={seen[0].id: painted[seen[0].id]}).masks
    other = next(v for v in both.views if v.camera.id == seen[-1].id)
    assert len(seen) > 1 and other.target[render(flat, other.camera).alpha > 0.9].mean() > 0.8
    with pytest.raises(BadInput, match="extra mask"):
        find_masks(dark, REGION, views, extra={views[0].id: np.ones((3, 4), bool)})
    with pytest.raises(BadInput, match="photo"):
        find_masks(dark, REGION, views, photos={views[0].id: np.zeros((3, 4, 3), np.uint8)})


def test_views_that_do_not_fit_fall_back_to_the_papers_targets(monkeypatch: pytest.MonkeyPatch) -> None:
    views = cameras()
    photos = {c.id: render_bytes(scene(), c) for c in views}
    assert find_masks(scene(), REGION, views, photos=photos).mode == "need"
    rng = np.random.default_rng(0)
    noise = {c.id: rng.integers(0, 255, (c.height, c.width, 3), np.uint8) for c in views}
    wrong = find_masks(scene(), REGION, views, photos=noise)
    paper = find_masks(scene(), REGION, views, MaskSettings(mode="paper"))
    assert wrong.mode == "paper" and "do not match" in wrong.reason and "paper" in wrong.warnings[0]
    assert wrong.hole_pixels > 0.9 * paper.hole_pixels and paper.warnings == ()

    class Noisy(Drawing):
        def surface_depth(self, gone: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
            depth, alpha = super().surface_depth(gone)
            return (depth * rng.uniform(0.7, 1.3, depth.shape)).astype(np.float32), alpha

    monkeypatch.setattr(Backend, "drawing", Noisy)
    vague = find_masks(scene(), REGION, views)
    assert vague.mode == "paper" and "alike" in vague.warnings[0] and vague.hole_pixels > 0.9 * paper.hole_pixels


@pytest.mark.parametrize(("agreement", "support"), [(1.0, 0.05), (0.97, 0.05), (0.77, 0.25)])
def test_the_worse_views_agree_the_more_photos_must_vouch_for_what_is_revealed(
    monkeypatch: pytest.MonkeyPatch, agreement: float, support: float
) -> None:
    asked = []

    def choose(*given: object) -> object:
        asked.append(given[3])  # the support
        return chosen(*given)

    chosen = stage.choose
    monkeypatch.setattr(stage, "choose", choose)
    monkeypatch.setattr(stage, "depth_agreement", lambda *_: agreement)
    find_masks(scene(), REGION, cameras())
    find_masks(scene(), REGION, cameras(), MaskSettings(selection=SelectionSettings(support=0)))
    assert asked == pytest.approx([support, 0])


def test_constant_photos_say_nothing() -> None:
    views = cameras()
    grey = {c.id: np.full((c.height, c.width, 3), 128, np.uint8) for c in views}
    assert find_masks(scene(), REGION, views, photos=grey).mode == "need"


def test_a_box_partly_behind_a_camera() -> None:
    beam = (Box.make([0, 0, 0.26], [0.62, 9.0, 0.56]),)  # reaches behind cameras that stand in its line
    masks = charted(scene(), beam, cameras()).masks
    assert masks.views and masks.hole_pixels > 0
    assert masks.removed[len(floor(True)) :].all()


def test_running_again_on_the_result_is_calm() -> None:
    first = charted(scene(), REGION, cameras()).masks
    rest = scene().take(~first.removed[: len(scene())])
    filled = rest.extended(truth().take((np.abs(truth().means[:, :2]) <= BLOCK / 2).all(1)))
    again = charted(filled, REGION, cameras()).masks
    assert again.hole_pixels < 2 * first.hole_pixels


@pytest.mark.parametrize("pixels", [0.1, 0.5, 1.0, 2.0])
def test_poses_may_be_off_by_a_pixel_or_two(pixels: float) -> None:
    """Photos stay where they were; the selection and the targets must bend, not break."""
    rng = np.random.default_rng(3)
    views = cameras(9, 240, 180)
    photos = {c.id: render_bytes(scene(), c) for c in views}

    def off(camera: Camera) -> Camera:
        angle = rng.normal(size=3) * pixels / camera.fx
        turn = cv2.Rodrigues(angle)[0]
        matrix = camera.viewmat.copy()
        matrix[:3] = turn @ matrix[:3]
        return replace(camera, viewmat=matrix)

    exact = charted(scene(), REGION, views, photos).masks
    bent = charted(scene(), REGION, [off(c) for c in views], photos).masks
    assert bent.mode == "need"
    count = len(scene())
    assert (exact.removed[:count] != bent.removed[:count]).mean() < 0.01
    assert bent.removed[len(floor(True)) :].all()
    assert 0.7 < bent.hole_pixels / exact.hole_pixels < 1.4


@pytest.mark.parametrize("scale", [0.9, 1.1, 1.2])
def test_the_region_may_be_drawn_too_large_or_small(scale: float) -> None:
    views = cameras(9, 240, 180)
    exact = charted(scene(), REGION, views).masks
    other = charted(scene(), (replace(REGION[0], size=scale * REGION[0].size),), views).masks
    rows = slice(len(floor(True)), None)
    assert other.removed[rows].mean() > 0.99
    assert other.removed[: len(floor(True))].mean() < 0.05
    for a, b in zip(exact.views, other.views):
        assert (a.target & b.target).sum() > 0.6 * (a.target | b.target).sum()


def test_broken_rows_change_nothing() -> None:
    g = scene()
    broken = g.take(np.arange(50))
    broken.means[:20] = np.nan
    broken.quats[20:40] = 0
    broken.log_scales[40:] = np.nan
    whole, plain = find_masks(g.extended(broken), REGION, cameras()), find_masks(g, REGION, cameras())
    assert not whole.removed[-50:].any() and (whole.removed[:-50] == plain.removed).all()
    assert all((a.target == b.target).all() for a, b in zip(whole.views, plain.views))


def test_the_result_does_not_depend_on_threads() -> None:
    many = find_masks(scene(), REGION, cameras())
    set_thread_count(1)
    try:
        one = find_masks(scene(), REGION, cameras())
    finally:
        set_thread_count(None)
    assert (many.selection.fates == one.selection.fates).all()
    assert all((a.target == b.target).all() for a, b in zip(many.views, one.views))


def test_every_view_is_drawn_a_fixed_number_of_times(monkeypatch: pytest.MonkeyPatch) -> None:
    """O(views) renders: as many per view for 12 views as for 6."""
    calls = 0

    def counted(function):
        def run(*args, **kwargs):
            nonlocal calls
            calls += 1
            return function(*args, **kwargs)

        return run

    for module, name in ((look, "drawing"), (stage, "drawing"), (look, "render"), (selection, "label_weights")):
        monkeypatch.setattr(module, name, counted(getattr(module, name)))
    per_view = []
    for count in (6, 12):
        calls = 0
        find_masks(scene(), REGION, cameras(count))
        per_view.append(calls / count)
    assert per_view[0] == per_view[1] <= 4


def test_only_a_part_is_drawn_without_the_object_but_all_of_the_view_is_right() -> None:
    views = cameras(5)
    found = find_masks(scene(), REGION, views)
    kept = scene().take(~found.removed)
    for view in found.views:
        depth, alpha = surface_depth(kept, view.camera)
        np.testing.assert_array_equal(view.depth_after, depth)
        np.testing.assert_array_equal(view.alpha_after, alpha)
        before, _ = surface_depth(scene(), view.camera)
        np.testing.assert_array_equal(view.depth_before, before)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["desk", "corner", "gloss", "rocks"])
@pytest.mark.parametrize(("scale", "least", "most"), [(1.0, 0.99, 1.5), (0.8, 0.75, 1.6), (1.2, 0.99, 1.5)])
def test_targets_of_the_measured_scenes(shared_data: Path, name: str, scale: float, least: float, most: float) -> None:
    """Share of the never-seen pixels up to a 1-px rim that T covers, and its area over theirs; the box a fifth off.

    In a box that cuts the object, photos show its foot outside the box, and splats are split there: least in corner.
    """
    folder = shared_data / "withwithout" / name
    loaded = [load_view(c) for c in read_cameras(folder / "transforms.json") if c.split == "train"]
    gaussians = read_ply(folder / "scene.ply").gaussians
    region = tuple(replace(b, size=scale * b.size) for b in read_region(folder / "roi.json"))
    masks = charted(gaussians, region, [c for _, c in loaded], {c.id: p for p, c in loaded}).masks
    covered = area = unseen = inner = touched = either = 0
    for view in masks.views:
        stem = folder / "truth" / "images" / Path(view.camera.id).stem
        hidden, object_ = read_mask(f"{stem}.unseen.png"), read_mask(f"{stem}.mask.png")
        core = cv2.erode(hidden.astype(np.uint8), RIM) > 0
        covered, inner = covered + (view.target & core).sum(), inner + core.sum()
        area, unseen = area + view.target.sum(), unseen + hidden.sum()
        touched, either = touched + (view.silhouette & object_).sum(), either + (view.silhouette | object_).sum()
    assert len(masks.views) == len(loaded) and masks.mode == "need"
    assert covered >= least * inner
    assert area <= most * unseen
    assert touched >= 0.84 * either
    assert scale < 1 or masks.selection.counts["kept_surface"] > 100


@examples(25)
@given(st.integers(0, 10**6), st.integers(1, 20), st.integers(1, 20))
def test_what_a_view_keeps_small_reads_as_it_was(seed: int, height: int, width: int) -> None:
    rng = np.random.default_rng(seed)
    bits = rng.random((4, height, width)) < 0.3
    before = rng.random((2, height, width), np.float32)
    after = np.where(rng.random((2, height, width)) < 0.1, rng.random((2, height, width)), before).astype(np.float32)
    weight = np.where(bits[1], rng.random((height, width)), 0).astype(np.float32)
    view = ViewMasks(cameras()[0], *bits, *before, *after, weight)
    assert view.weight.dtype == np.float32 and (view.weight == weight).all()
    for name, expected in zip(("polygon", "silhouette", "occluder", "target"), bits):
        found = getattr(view, name)
        assert found.dtype == bool and (found == expected).all()
    assert view.depth_after.dtype == view.alpha_after.dtype == np.float32
    assert (view.depth_after == after[0]).all() and (view.alpha_after == after[1]).all()
    other = replace(view, target=~bits[3], depth_after=before[0])
    assert (other.target == ~bits[3]).all() and (other.depth_after == before[0]).all()
    assert other.depth_before is view.depth_before and other.alpha_before is view.alpha_before
    assert (view.depth_after == after[0]).all()
    with pytest.raises(FrozenInstanceError):
        view.target = bits[0]  # type: ignore[misc]


@examples(20)
@given(seed=st.integers(0, 1000), most=st.integers(1, 30), needed=st.integers(0, 4))
def test_views_that_are_used_are_far_from_each_other_and_see_the_region(seed: int, most: int, needed: int) -> None:
    rng = np.random.default_rng(seed)
    around = cameras(12, 60, 45)
    up = np.array([0.0, 0.0, 1.0])
    beside = [  # right beside another one, and one that looks away
        *(replace(c, id=f"b{k}", viewmat=look_at(c.centre + 1e-3, np.zeros(3), up)) for k, c in enumerate(around)),
        replace(around[0], id="away", viewmat=look_at(around[0].centre, 2 * around[0].centre, up)),
    ]
    available = [[*around, *beside][k] for k in rng.permutation(25)]
    names = {available[k].id for k in rng.permutation(25)[:needed]} | {"unknown"}
    used = [c.id for c in stage.spread_views(available, REGION, most, names)]
    if most >= 25:
        assert used == [c.id for c in available]
        return
    assert used == [c.id for c in available if c.id in used]
    names -= {"unknown"}
    assert names <= set(used) and len(used) == max(len(names), min(most, 24 + ("away" in names)))
    assert "away" in names or "away" not in used
    if not names and most <= 12:
        places = {c.id: c.centre for c in available}
        assert min([np.linalg.norm(places[a] - places[b]) for a in used for b in used if a != b], default=1.0) > 0.1


def test_all_views_are_used_if_no_number_is_asked() -> None:
    around = cameras(5, 60, 45)
    assert [c.id for c in stage.spread_views(around, REGION, 0)] == [c.id for c in around]
    assert stage.spread_views([], REGION, 3) == ()
