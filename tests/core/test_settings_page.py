"""docs/settings.md says of every setting what it is, and says it as the code does."""

from __future__ import annotations

import pytest
import settings_page

from gimp3d.commands import job_settings
from gimp3d.job import RemovalJob

ENTRIES = tuple(settings_page.entries())


def test_the_page_is_what_the_tool_writes() -> None:
    assert settings_page.PAGE.read_text(encoding="utf-8") == settings_page.page()


def test_every_setting_says_its_unit_and_what_it_trades() -> None:
    assert [e.key for e in ENTRIES if not e.trades] == []
    numbers = [e for e in ENTRIES if isinstance(e.default, int | float) and not isinstance(e.default, bool)]
    assert [e.key for e in numbers if not e.unit] == []


def test_every_key_takes_its_default_as_it_is_written() -> None:
    written = {e.key: settings_page.shown(e.default) for e in ENTRIES if e.default not in (None, "")}
    plain = {key: text for key, text in written.items() if ", " not in text}
    settings = job_settings(RemovalJob(scene="", cameras="", roi="", out="", set=plain))
    for entry in ENTRIES:
        if entry.key in plain:
            assert settings_page.value_at(settings, entry.key) == pytest.approx(entry.default)


def test_a_preset_that_differs_is_named() -> None:
    steps = next(e for e in ENTRIES if e.key == "refine.steps")
    assert steps.presets["balanced"] == 100 and "balanced: 100" in steps.row()
