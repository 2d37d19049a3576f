"""A removal's stages: watched, replaced, taken from the store; and views that cannot be used."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scenes import REGION, cameras, scene, truth

from gimp3d.camera import Camera
from gimp3d.errors import BadInput
from gimp3d.frame import Frame
from gimp3d.gaussians import Gaussians, pad_sh
from gimp3d.orbit import look_at
from gimp3d.pipeline import PRESETS, View, remove_object, render_bytes
from gimp3d.progress import forecast_removal
from gimp3d.raster import footprint
from gimp3d.steps import references

IN_ORDER = [
    "masks",
    "exposure",
    "surfaces",
    "light",
    "charts",
    "contact",
    "clear",
    "appearance",
    "seed",
    "propagate",
    "settle",
]


def views() -> list[View]:
    return [View(c, render_bytes(scene(), c)) for c in cameras(5, 120, 90)]


def test_an_observer_sees_every_stage_in_order_with_what_it_takes_and_makes() -> None:
    seen: dict[str, tuple[Any, ...]] = {}

    def watch(name: str, work: Any, inputs: tuple[Any, ...]) -> Any:
        made = work(*inputs)
        seen[name] = (*inputs, made)
        return made

    result = remove_object(scene(), views(), REGION, PRESETS["draft"], observer=watch)
    assert list(seen)[: len(IN_ORDER)] == IN_ORDER and list(seen)[-1] == "verdict"
    assert list(seen) == [stage.name for stage in result.stages]
    # or progress would stand still: a stage that the forecast does not know counts nothing
    assert set(forecast_removal(1000, 5, 5 * 120 * 90, "draft").stages) - set(seen) == {"read", "lift"}
    assert seen["masks"][0] is not None and isinstance(seen["settle"][-1], Gaussians)
    assert result.verdict is seen["verdict"][-1]
    assert all(stage.seconds >= 0 and stage.reason for stage in result.stages)


@pytest.mark.parametrize("named", [False, True])
def test_light_is_told_where_photos_show_the_reference_and_nowhere_in_a_hole(named: bool) -> None:
    seen: dict[str, tuple[Any, ...]] = {}

    def watch(name: str, work: Any, inputs: tuple[Any, ...]) -> Any:
        seen[name] = inputs
        return work(*inputs)

    given = (views()[0].camera.id, views()[0].image) if named else (None, None)
    remove_object(scene(), views(), REGION, PRESETS["draft"], *given, observer=watch)
    completed, chart = seen["propagate"][0], seen["clear"][3][0]
    if named:
        hits = next(v.hits for v in seen["propagate"][2] if v.id == completed.camera.id)
        shown = hits.of([chart.shown])
        assert (completed.source == shown)[completed.target].all()
    else:
        assert (completed.source == chart.shown).all() and (completed.target & ~chart.hole & completed.source).any()
    hole = hits.of([chart.hole]) if named else chart.hole
    assert (hole & completed.target).sum() > 100 and not (hole & completed.source & completed.target).any()


def test_what_is_filled_shines_as_its_surroundings_do_where_no_photo_looks_from(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A floor that is brighter from between two groups of photos than from these, which show all of it alike."""

    def shining(splats: Gaussians) -> Gaussians:
        sh = pad_sh(splats.sh, 9)
        sh[:, 4] += 0.45 * (np.abs(splats.means[:, 2:]) < 0.01)  # of x·y
        return replace(splats, sh=sh)

    def look(azimuth: float, elevation: float) -> Camera:
        a, e = np.radians([azimuth, elevation])
        eye = 2.2 * np.array([np.cos(a) * np.cos(e), np.sin(a) * np.cos(e), np.sin(e)])
        viewmat = look_at(eye, REGION[0].center, np.array([0.0, 0.0, 1.0]))
        return replace(cameras(1)[0], id=f"{azimuth}/{elevation}", viewmat=viewmat)

    with_block, without = shining(scene()), shining(truth())
    groups = [look(middle + side, e) for middle in (0, 90) for side in (-8, 8) for e in (25, 40, 55)]
    photos, from_between = [View(c, render_bytes(with_block, c)) for c in groups], look(45, 40)

    def off() -> float:
        result = remove_object(with_block, photos, REGION, PRESETS["draft"])
        filled = with_block.take(result.keep).extended(result.added)
        shows = footprint(filled, from_between, np.arange(len(filled)) >= result.keep.sum()) > 0.9
        drawn, true = (render_bytes(g, from_between)[shows].astype(float) for g in (filled, without))
        return abs(float((drawn - true).mean()))

    following = off()
    monkeypatch.setattr(references, "views_between", lambda *_: ())
    assert following < 0.7 * off()


def test_an_observer_can_stand_in_for_a_stage() -> None:
    def in_red(name: str, work: Any, inputs: tuple[Any, ...]) -> Any:
        made = work(*inputs)
        if name == "appearance":
            made = replace(made, image=np.where(inputs[1][..., None], np.uint8((250, 10, 10)), made.image))
        return made

    result = remove_object(scene(), views(), REGION, PRESETS["draft"], observer=in_red)
    chart = result.charts[0]
    assert (chart.image[chart.hole] == (250, 10, 10)).all(-1).mean() > 0.5
    assert result.added is not None
    red = result.added.sh[:, 0, 0] - result.added.sh[:, 0, 1]  # degree 0, red over green
    assert np.percentile(red, 90) > 2


class Memory:
    """A store that keeps results as they are."""

    def __init__(self) -> None:
        self.results: dict[str, Any] = {}

    def load(self, name: str) -> Any | None:
        return self.results.get(name)

    def save(self, name: str, result: Any) -> None:
        self.results[name] = result


def test_finished_stages_are_not_run_again() -> None:
    store = Memory()
    first = remove_object(scene(), views(), REGION, PRESETS["draft"], store=store)
    run_again: list[str] = []
    del store.results["settle"]

    def watch(name: str, work: Any, inputs: tuple[Any, ...]) -> Any:
        run_again.append(name)
        return work(*inputs)

    second = remove_object(scene(), views(), REGION, PRESETS["draft"], store=store, observer=watch)
    assert run_again == ["settle"]
    assert first.added is not None and second.added is not None
    np.testing.assert_array_equal(first.added.sh, second.added.sh)


@pytest.mark.parametrize(("scale", "shift"), [(2.0**-14, 0.0), (2.0**20, 0.0), (2.0**-14, 2.0**30)])
def test_a_library_call_takes_a_scene_in_any_units_and_anywhere(scale: float, shift: float) -> None:
    """Not the command alone: a tiny scene lay nearer to its cameras than anything is drawn."""
    elsewhere = Frame(shift * np.array([0.5, -0.3, 0.8]), scale)
    means = (scene().means.astype(np.float64) - elsewhere.origin) * scale
    moved = replace(scene(), means=means, log_scales=scene().log_scales + np.float32(np.log(scale)))
    seen = [replace(v, camera=elsewhere.camera(v.camera)) for v in views()]
    there = remove_object(moved, seen, elsewhere.region(REGION), PRESETS["draft"])
    home = remove_object(scene(), views(), REGION, PRESETS["draft"])
    np.testing.assert_array_equal(there.keep, home.keep)
    assert there.added is not None and home.added is not None
    back = elsewhere.back(there.added)
    assert back is not None and len(back) == pytest.approx(len(home.added), rel=0.02)
    for part in ("means", "log_scales"):
        spread, expected = (np.percentile(getattr(g, part), [5, 50, 95], 0) for g in (back, home.added))
        np.testing.assert_allclose(spread, expected, atol=0.02)
    chart = elsewhere.charts_back(there.charts)[0].camera
    np.testing.assert_allclose(chart.centre, home.charts[0].camera.centre, atol=1e-3)


def test_a_view_of_no_pixels_is_refused() -> None:
    views = [View(replace(cameras(1)[0], width=0), np.zeros((96, 0, 3), np.uint8))]
    with pytest.raises(BadInput, match="pixels"):
        remove_object(scene(), views, REGION)
