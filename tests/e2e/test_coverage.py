"""No part of a hole is left open silently, whatever the preset."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from scenes import REGION, cameras, charted, scene

from gimp3d import filling
from gimp3d.errors import IllPosed
from gimp3d.evaluate import run_benchmark
from gimp3d.pipeline import PRESETS, RemovalSettings, View, remove_object, render_bytes


def views() -> list[View]:
    return [View(c, render_bytes(scene(), c)) for c in cameras()]


def test_what_stays_open_is_counted_and_said() -> None:
    first, *others = cameras()
    cut = replace(first, cx=first.cx - 60)  # shows half of the hole
    seen = [View(c, render_bytes(scene(), c)) for c in (cut, *others)]
    done = remove_object(scene(), seen, REGION, RemovalSettings(charts=None, extra_references=0), reference=cut.id)
    assert done.open_pixels > 0.1 * done.hole_pixels
    assert any(f"({done.open_pixels})" in w and "stay open" in w for w in done.warnings)


def test_a_negligible_hole_that_no_view_can_fill_does_not_stop_a_removal(monkeypatch: pytest.MonkeyPatch) -> None:
    def none(*_: object) -> None:
        raise IllPosed("no view shows it")

    monkeypatch.setattr(filling, "choose_reference", none)
    with pytest.raises(IllPosed, match="no view shows it"):
        remove_object(scene(), views(), REGION, RemovalSettings(charts=None))
    monkeypatch.setattr(filling, "NEGLIGIBLE", 1.0)
    done = remove_object(scene(), views(), REGION, RemovalSettings(charts=None))
    assert done.added is None and not done.keep.all() and done.open_pixels == done.hole_pixels > 0
    assert any("no view shows it" in w for w in done.warnings) and any("stay open" in w for w in done.warnings)


def test_a_view_that_is_named_without_a_picture_is_filled_on_charts() -> None:
    named = cameras()[1].id
    done = remove_object(scene(), views(), REGION, PRESETS["draft"], reference=named)
    plain = remove_object(scene(), views(), REGION, PRESETS["draft"])
    assert any(named in w and "filled on charts" in w for w in done.warnings)
    assert [r.camera_id for r in done.references] == [named] and len(done.charts) == len(plain.charts) == 1
    assert done.added is not None and plain.added is not None
    assert done.added.means.tobytes() == plain.added.means.tobytes()


@pytest.mark.parametrize("count", [1, 5])
def test_views_from_one_place_have_charts_too(count: int) -> None:
    same = [replace(cameras()[1], id=f"same{k}") for k in range(count)]
    assert charted(scene(), REGION, same).charts


@pytest.mark.slow
def test_the_draft_preset_leaves_no_black_hole(shared_data: Path, tmp_path: Path) -> None:
    rows = run_benchmark(shared_data / "withwithout", tmp_path, ["gloss"], ["draft"])
    psnr = {r["method"]: r["psnr mask"] for r in rows}
    assert psnr["draft"] > 30 > psnr["hole open"] + 5  # what one reference does not reach costs 11 dB
