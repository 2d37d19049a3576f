"""Values from outside: of the type and in the bounds that are expected, or refused in one line."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import pytest

from gimp3d.errors import BadInput
from gimp3d.job import RemovalJob
from gimp3d.pipeline import PRESETS, RemovalSettings
from gimp3d.presets import job_settings
from gimp3d.schema import Between, Share, checked, kinds, parse_json, read_json, within


@dataclass(frozen=True)
class Thing:
    name: str
    share: Share = 0.5
    count: Annotated[int, Between(1, 9)] = 1
    mode: Literal["a", "b"] = "a"
    perhaps: float | None = None
    words: dict[str, str] | None = None


def test_values_become_the_types_that_are_expected() -> None:
    given = {"name": "ä", "share": 1, "count": 3.0, "mode": "b", "perhaps": None, "words": {"k": "v"}}
    thing = checked(Thing, given, "here")
    assert thing == Thing("ä", 1.0, 3, "b", None, {"k": "v"})
    assert type(thing.share) is float and type(thing.count) is int
    assert checked(Thing, {"name": "x", "more": 1}, "here", extra=True) == Thing("x")


REFUSED = {
    "no mapping": ([], "a mapping expected"),
    "nothing needed": ({"share": 1}, "no name"),
    "null needed": ({"name": None}, "no name"),
    "unknown": ({"name": "x", "nmae": 1}, "'nmae' is not known"),
    "text": ({"name": 5}, "a text expected, got 5"),
    "surrogate": ({"name": "\ud800"}, "no text that a file can hold"),
    "bool for a number": ({"name": "x", "share": True}, "a number expected"),
    "text for a number": ({"name": "x", "share": "1"}, "a number expected"),
    "NaN": ({"name": "x", "share": math.nan}, "finite"),
    "infinity": ({"name": "x", "perhaps": math.inf}, "finite"),
    "400 digits": ({"name": "x", "perhaps": 10**400}, "finite"),
    "5000 digits": ({"name": "x", "perhaps": 10**5000}, "finite"),
    "too much": ({"name": "x", "share": 1.5}, "from 0 to 1"),
    "too little": ({"name": "x", "count": 0}, "from 1 to 9"),
    "half a count": ({"name": "x", "count": 1.5}, "a whole number"),
    "another word": ({"name": "x", "mode": "c"}, "a or b expected"),
    "a list": ({"name": "x", "words": ["k"]}, "a mapping expected"),
    "a number as a word": ({"name": "x", "words": {"k": 1}}, "a text expected"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_other_values_are_refused_in_one_short_line(case: str) -> None:
    value, words = REFUSED[case]
    with pytest.raises(BadInput, match=words) as caught:
        checked(Thing, value, "here")
    text = str(caught.value)
    assert text.startswith("here") and "\n" not in text and len(text) < 150
    text.encode()


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (b"[" * 100_000, "nested too deep|not JSON"),
        (b'{"a":' * 100_000, "nested too deep|not JSON"),
        (b"\xff\xfe{}", "not JSON"),
        (b"", "not JSON"),
        (b"1" * 5000, "not JSON"),
        (b" " * 2000, "larger than"),
    ],
)
def test_what_is_no_sensible_json_is_refused(text: bytes, words: str) -> None:
    with pytest.raises(BadInput, match=words):
        parse_json(text, "here", 1000 if text.isspace() else 1 << 20)


def test_a_json_file_is_read_with_its_byte_order_mark(tmp_path: Path) -> None:
    (tmp_path / "x.json").write_bytes(b'\xef\xbb\xbf{"a": 1}')
    assert read_json(tmp_path / "x.json", "test") == {"a": 1}
    for name in ("none.json", "."):
        with pytest.raises(BadInput, match="test"):
            read_json(tmp_path / name, "test")


def settings_of(settings: Any, prefix: str = "") -> Iterator[tuple[str, Any, Any]]:
    """Every setting's key, value and type."""
    for field in fields(settings):
        value = getattr(settings, field.name)
        if is_dataclass(value):
            yield from settings_of(value, f"{prefix}{field.name}.")
        else:
            yield f"{prefix}{field.name}", value, kinds(type(settings))[field.name]


KEYS = {key: value for key, value, _ in settings_of(RemovalSettings())}
NUMBERS = [k for k, v in KEYS.items() if isinstance(v, int | float) and not isinstance(v, bool)]


def job(key: str, value: str) -> RemovalJob:
    return RemovalJob("s", "c", "r", "o.ply", set={key: value})


@pytest.mark.parametrize("value", ["nan", "inf", "-inf", "1e400", "much", ""])
@pytest.mark.parametrize("key", NUMBERS)
def test_no_setting_takes_what_is_no_finite_number(key: str, value: str) -> None:
    with pytest.raises(BadInput, match="--set"):
        job_settings(job(key, value))


@pytest.mark.parametrize("key", [k for k in NUMBERS if k not in ("depth.scale_factor", "mapping.visibility")])
def test_no_other_setting_takes_a_negative_number(key: str) -> None:
    with pytest.raises(BadInput, match=f"--set: {key}: must be"):
        job_settings(job(key, "-1"))


def test_presets_lie_within_the_bounds_and_words_are_checked() -> None:
    for name, preset in PRESETS.items():
        within(preset, f"{name}: ")
    for key in ("masks.mode", "depth.surface", "propagate.transfer", "propagate.blend", "shadow"):
        with pytest.raises(BadInput, match=key):
            job_settings(job(key, "nonsense"))
