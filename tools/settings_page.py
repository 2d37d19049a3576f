"""Writes docs/settings.md: every setting of `--set`, from the settings classes and the comments beside their fields.

A field's comment is `# unit; what it trades`. A test fails if the page is not what this writes.
"""

from __future__ import annotations

import ast
import inspect
import io
import math
import textwrap
import tokenize
import typing
from collections.abc import Iterator
from dataclasses import dataclass, fields, is_dataclass
from functools import cache
from pathlib import Path
from typing import Any, Literal

from gimp3d.pipeline import PRESETS, RemovalSettings
from gimp3d.schema import SETTING, Between, kinds

PAGE = Path(__file__).resolve().parents[1] / "docs" / "settings.md"
HEAD = """# Settings

Written by `tools/settings_page.py` from the settings classes; do not edit it by hand.

Each line is one key of `--set key=value`; in Python it is a field of `RemovalSettings`. *Default* is the field's own
value; *presets* names the presets that have another one. A value out of its range is refused (exit code 2). What is no
choice – thresholds that a measurement or a source settled – is a named constant beside its use in the code, with that
reason.
"""
COLUMNS = "| key | default | presets | range | unit | what it trades |\n|---|---|---|---|---|---|"
OFF = "none"  # how an optional group of settings that is left out is written


@dataclass(frozen=True)
class Entry:
    """One setting, as the page says it."""

    key: str  # dotted, as --set takes it
    default: Any
    presets: dict[str, Any]  # of those that differ from the default
    range: str
    unit: str
    trades: str

    def row(self) -> str:
        names: dict[str, list[str]] = {}  # by value
        for name, value in self.presets.items():
            names.setdefault(shown(value), []).append(name)
        presets = "; ".join(f"{', '.join(who)}: {value}" for value, who in names.items())
        cells = (f"`{self.key}`", shown(self.default), presets, self.range, self.unit, self.trades)
        return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


def entries(settings: Any = RemovalSettings(), prefix: str = "") -> Iterator[Entry]:
    """Every single setting: a class's own fields in their order, then those of the classes inside it."""
    groups = []
    for field in fields(settings):
        value, key = getattr(settings, field.name), f"{prefix}{field.name}"
        if is_dataclass(value):
            groups.append((value, f"{key}."))
            continue
        unit, trades = comment_of(type(settings), field.name)
        presets = {name: value_at(preset, key) for name, preset in PRESETS.items()}
        differing = {name: found for name, found in presets.items() if found not in (value, OFF)}
        yield Entry(key, value, differing, range_of(kinds(type(settings))[field.name]), unit, trades)
    for value, inside in groups:
        yield from entries(value, inside)


def value_at(settings: Any, key: str) -> Any:
    """The value of a dotted key, or OFF where the settings leave out its whole group."""
    for name in key.split("."):
        settings = getattr(settings, name)
        if settings is None and name != key.rpartition(".")[2]:
            return OFF
    return settings


def comment_of(kind: type, name: str) -> tuple[str, str]:
    """Unit and trade-off of a field, from the comment on its own line; empty where there is none."""
    said = _comments(kind).get(name, "")
    unit, semicolon, trades = said.partition("; ")
    return (unit, trades) if semicolon else ("", said)


@cache
def _comments(kind: type) -> dict[str, str]:
    """Field → its comment, of one settings class."""
    source = textwrap.dedent(inspect.getsource(kind))
    tokens = tokenize.generate_tokens(io.StringIO(source).readline)
    at_line = {t.start[0]: t.string.lstrip("# ").strip() for t in tokens if t.type == tokenize.COMMENT}
    (body,) = ast.parse(source).body
    assert isinstance(body, ast.ClassDef)
    return {
        node.target.id: " ".join(at_line[k] for k in range(node.lineno, (node.end_lineno or 0) + 1) if k in at_line)
        for node in body.body
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name)
    }


def range_of(kind: Any) -> str:
    """What a field of this type may be."""
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if isinstance(kind, type) and kind in SETTING:
        return _between(SETTING[kind], kind)
    if origin is Literal:
        return ", ".join(f"`{a}`" for a in arguments)
    for bounds in arguments:
        if isinstance(bounds, Between):
            return _between(bounds, arguments[0])
    if type(None) in arguments:
        return f"{', '.join(range_of(a) for a in arguments if a is not type(None))}, or none"
    return {bool: "true, false", str: "text"}.get(kind, "")


def _between(bounds: Between, kind: type) -> str:
    whole = "whole, " if kind is int else ""
    if math.isinf(bounds.low):
        return f"{whole}any"
    if math.isinf(bounds.high):
        return f"{whole}> 0" if 0 < bounds.low < 1e-6 else f"{whole}≥ {bounds.low:,g}"
    high = f"{bounds.high:,.0f}" if bounds.high >= 1000 else f"{bounds.high:g}"
    return f"{whole}{bounds.low:g} … {high}"


def shown(value: Any) -> str:
    """A value as it is typed after `--set key=`."""
    if value is None:
        return OFF
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, tuple):
        return ", ".join(map(shown, value))
    return f"{value:g}" if isinstance(value, float) else str(value) or "(empty)"


def page() -> str:
    """The whole of docs/settings.md."""
    parts, found = [HEAD], list(entries())
    for group in dict.fromkeys(e.key.rpartition(".")[0] for e in found):
        rows = [e.row() for e in found if e.key.rpartition(".")[0] == group]
        parts.append("\n".join([f"## {group or 'The removal'}\n", COLUMNS, *rows, ""]))
    return "\n".join(parts)


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
    print(f"{PAGE}: {len(list(entries()))} settings")
