"""Forecasts grow with the work, and a clock runs from nothing to all."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gimp3d.pipeline import PRESETS
from gimp3d.progress import CHARTED, STEPS, VIEWS, Clock, forecast_removal

SIZES = st.tuples(st.integers(0, 10**7), st.integers(1, VIEWS // 2), st.integers(1, 10**9))


@given(SIZES, st.sampled_from(["draft", "balanced", "best", "paper"]))
def test_more_work_takes_longer(size: tuple[int, int, int], preset: str) -> None:
    gaussians, views, pixels = size
    small, large = (forecast_removal(f * gaussians, f * views, f * pixels, preset) for f in (1, 2))
    assert 0 < small.seconds < large.seconds and 0 < small.memory_mb < large.memory_mb


def test_presets_with_more_steps_take_longer() -> None:
    draft, balanced, best = (forecast_removal(50_000, 24, 3_000_000, p).seconds for p in ("draft", "balanced", "best"))
    assert draft < balanced < best


def test_steps_and_charts_are_the_presets_own() -> None:
    """The forecast must not import the pipeline: Blender's process has no compiled libraries."""
    assert {name: STEPS.get(name, 0) for name in PRESETS} == {n: s.refine.steps for n, s in PRESETS.items()}
    assert {name: VIEWS * (name in CHARTED) for name in PRESETS} == {n: s.views for n, s in PRESETS.items()}


def test_views_that_are_not_used_take_no_time() -> None:
    used, more = (forecast_removal(1000, views, views * 10_000, "draft") for views in (VIEWS, 200))
    assert more == used != forecast_removal(1000, VIEWS // 2, VIEWS * 5_000, "draft")
    assert set(CHARTED) == {name for name, s in PRESETS.items() if s.charts is not None}


@pytest.mark.parametrize(
    ("preset", "seconds", "memory_mb"), [("balanced", 9.3, 558), ("best", 12.6, 563), ("paper", 52.4, 557)]
)
def test_the_demo_takes_the_time_that_was_measured(preset: str, seconds: float, memory_mb: float) -> None:
    """On the machine that the constants come from: what tools/calibrate_forecast.py printed."""
    told = forecast_removal(44_914, 24, 24 * 480 * 270, preset)
    assert 0.8 < told.seconds / seconds < 1.25 and 0.7 < told.memory_mb / memory_mb < 1.4


@given(st.lists(st.tuples(st.sampled_from(["read", "masks", "depth", "seed 3", "strange"]), st.integers(0, 9))))
def test_a_clock_never_goes_back(lines: list[tuple[str, int]]) -> None:
    clock, seen = Clock(forecast_removal(1000, 9, 10**6)), [0.0]
    for stage, done in lines:
        clock.take(stage, done, 9)
        seen.append(clock.fraction)
    assert seen == sorted(seen) and seen[-1] <= 1


def test_a_clock_trusts_what_it_sees_more_and_more() -> None:
    forecast = forecast_removal(1000, 9, 10**6)
    clock = Clock(forecast)
    assert clock.seconds_left(0.0, pace=2.0) == pytest.approx(2 * forecast.seconds)
    clock.take(list(forecast.stages)[-2], 1, 1)
    slow = 50 * forecast.seconds
    told, seen = forecast.seconds * (1 - clock.fraction), slow * (1 - clock.fraction) / clock.fraction
    assert clock.fraction > 0.5 and told < clock.seconds_left(slow) < seen
    assert seen - clock.seconds_left(slow) < clock.seconds_left(slow) - told
    clock.take(list(forecast.stages)[-1], 1, 1)
    assert clock.fraction == pytest.approx(1) and clock.seconds_left(slow) == pytest.approx(0, abs=1e-6)
