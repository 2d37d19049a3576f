"""What stays round the object learns from photos, and from charts where what it draws cannot be true."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scenes import BLOCK, REGION, cameras, floor, scene

from gimp3d.behind import Behind, look_behind
from gimp3d.evaluate import psnr
from gimp3d.gaussians import ARRAYS, Gaussians
from gimp3d.geometry import dilated
from gimp3d.pipeline import PRESETS, View, remove_object, render_bytes
from gimp3d.run import Run
from gimp3d.stages import refine
from gimp3d.stages.beside import Shown, Sight
from gimp3d.stages.charts import pictured
from gimp3d.stages.masks import Masks, find_masks
from gimp3d.stages.propagate import Rule
from gimp3d.steps.behind import observed_round, take_painted_colours
from gimp3d.steps.references import emptied

SETTINGS = replace(PRESETS["balanced"], refine=replace(PRESETS["balanced"].refine, steps=50), shadow="off")
SPOILT = 0.3  # scene units round the block


def spoilt() -> Gaussians:
    """The block on its floor, which was fitted too dark right round it."""
    whole = scene()
    away = np.abs(whole.means[:, :2]).max(1) - BLOCK / 2
    near = (whole.means[:, 2] == 0) & (away > 0.01) & (away < SPOILT)
    sh = whole.sh.copy()
    sh[near] -= 0.1
    return replace(whole, sh=sh)


@cache
def views() -> tuple[View, ...]:
    return tuple(View(c, render_bytes(scene(), c)) for c in cameras(9))


@cache
def found() -> tuple[Masks, dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Masks, photos and marked shadows, of which there are none."""
    photos = {v.camera.id: v.image for v in views()}
    return find_masks(spoilt(), REGION, [v.camera for v in views()], SETTINGS.masks, photos=photos), photos, {}


@cache
def behind() -> Behind:
    return look_behind(Run(SETTINGS), spoilt(), REGION, *found())


def fidelity(gaussians: Gaussians) -> float:
    """PSNR of photos round the object's place."""
    found = []
    for view in behind().views:
        place = view.masks.silhouette | view.masks.target
        drawn = render_bytes(gaussians, view.camera)
        found.append(psnr(drawn, view.photo, dilated(place, 8) & ~place))
    return float(np.mean(found))


def test_of_many_photos_some_are_cut_by_their_colours_as_far_apart_as_can_be(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = list[list[Sight]]()

    def shown(scene: Gaussians, goes: np.ndarray, stays: np.ndarray, may: np.ndarray, sights: list[Sight]) -> Shown:
        asked.append(sights)
        return Shown(*np.zeros((4, len(scene)), bool), np.zeros(len(scene)), [])

    monkeypatch.setattr("gimp3d.steps.behind.shown_beside", shown)
    monkeypatch.setattr("gimp3d.steps.behind.CUT", 3)
    look_behind(Run(SETTINGS), spoilt(), REGION, *found())
    centres = np.array([s.camera.centre for s in asked[0]])
    assert len(asked[0]) == 3 and len(views()) == 9
    apart = np.linalg.norm(centres[:, None] - centres, axis=-1)[np.triu_indices(3, 1)]
    everyone = np.array([v.camera.centre for v in views()])
    neighbours = np.sort(np.linalg.norm(everyone[:, None] - everyone, axis=-1), axis=1)[:, 1]
    assert apart.min() > 1.5 * neighbours.max()


def test_colours_round_the_object_become_those_of_photos() -> None:
    stays = ~behind().masks.removed
    before, after = behind().before.take(stays), behind().scene.take(stays)
    assert fidelity(after) > fidelity(before) + 2
    changed = np.zeros(len(stays), bool)
    changed[behind().changed] = True
    assert 0 < changed.sum() < 0.5 * stays.sum() and not (changed & ~stays).any()
    for name in ARRAYS:
        old, new = getattr(behind().before, name), getattr(behind().scene, name)
        np.testing.assert_array_equal(old[~changed], new[~changed])
        if name not in ("sh", "opacity_logits"):
            np.testing.assert_array_equal(old, new)


def test_what_learned_counts_as_removed_and_added_and_comes_first() -> None:
    result = remove_object(spoilt(), views(), REGION, SETTINGS)
    assert result.changed > 0 and result.lifted == 0 and result.added is not None
    back = {tuple(m) for m in spoilt().means[~result.keep]}
    assert all(tuple(m) in back for m in result.added.means[: result.changed])
    assert not any(tuple(m) in back for m in result.added.means[result.changed :])


def test_what_is_opaque_to_infinity_stays_so() -> None:
    odd = spoilt()
    odd.opacity_logits[::2] = np.inf
    result = remove_object(odd, views(), REGION, SETTINGS)
    assert result.added is not None and result.changed > 0
    assert all(np.isfinite(getattr(result.added, name)).all() for name in ARRAYS)


def test_draft_leaves_what_stays_as_it_is() -> None:
    assert remove_object(spoilt(), views(), REGION, PRESETS["draft"]).changed == 0


def test_what_held_out_views_do_not_like_is_not_learned(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(refine, "COLOUR", 5.0)
    behind.cache_clear()
    try:
        assert len(behind().changed) == 0
        assert behind().scene.sh.tobytes() == behind().before.sh.tobytes()
    finally:
        behind.cache_clear()


def test_charts_teach_what_cannot_be_true() -> None:
    kept = behind().scene.take(~behind().masks.removed)
    view = emptied(kept, behind().views)[3]
    assert view.hits is not None
    shown, known, hole = pictured(behind().charts, view.hits)
    place = view.masks.silhouette & ~view.masks.target & known & ~hole
    rows, cols = np.nonzero(place)
    patch = np.zeros_like(place)
    patch[rows[0] : rows[0] + 6, cols[0] - 6 : cols[0] + 6] = True
    assert (patch & place).sum() > 5
    hazy = replace(view, painted=np.where(patch[..., None], [0, 0, 255], view.painted).astype(np.uint8))
    for seen, few in ((observed_round(view, behind().charts), True), (observed_round(hazy, behind().charts), False)):
        taught = seen.weight > 0
        assert not (taught & ~place).any()
        np.testing.assert_array_equal(seen.image[taught], shown[taught])
        assert taught[patch & place].mean() < 0.5 if few else taught[patch & place].all()


def test_what_is_drawn_before_the_new_gaussians_takes_their_colours() -> None:
    """A shadow on splats that stay: new Gaussians behind them cannot lighten it."""
    clean = floor(with_hole=False)
    reach = np.abs(clean.means[:, :2]).max(1)
    shadow, sh = reach < BLOCK / 2, clean.sh.copy()
    sh[shadow, 0] -= 0.6
    kept, added = replace(clean, sh=sh), clean.take(np.arange(len(clean)) == int(np.argmax(reach)))
    seen = []
    for v in behind().views:
        place = v.masks.silhouette | v.masks.target
        rules = np.where(place, Rule.OWN_PIXELS, Rule.UNTOUCHED).astype(np.uint8)
        seen.append(replace(v, painted=render_bytes(clean, v.camera), rules=rules))

    def error(gaussians: Gaussians) -> float:
        drawn = [(v, render_bytes(gaussians, v.camera)) for v in seen]
        return float(np.mean([psnr(d, v.painted, v.rules == Rule.OWN_PIXELS) for v, d in drawn]))

    found = take_painted_colours(kept, added, seen)
    after = kept.with_rows(found.rows, found.gaussians)
    assert error(kept) < 30 and error(after) > error(kept) + 10
    assert (reach[found.rows] < 3 * BLOCK).all() and np.isin(np.flatnonzero(shadow), found.rows).mean() > 0.9
    assert (
        after.sh[np.setdiff1d(np.arange(len(kept)), found.rows)]
        == kept.sh[np.setdiff1d(np.arange(len(kept)), found.rows)]
    ).all()
