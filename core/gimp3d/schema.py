"""What comes from outside against what is expected: one reader for JSON, one for values by their type and bounds.

Our own hundred lines, as camera files are read inside Blender, where only NumPy is at hand: a compiled validator would
be one more wheel for every platform and Python, and the small zip carries none.
"""

from __future__ import annotations

import json
import math
import types
import typing
from collections.abc import Mapping
from dataclasses import MISSING, dataclass, fields, is_dataclass
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

from .errors import BadInput, refusing
from .files import require_file

T = TypeVar("T")
LARGEST_JSON = 256 << 20  # bytes; a camera takes about 1 kB


@dataclass(frozen=True)
class Between:
    """The least and the greatest value that a number may have."""

    low: float = -math.inf
    high: float = math.inf

    def __str__(self) -> str:
        return f"{self.low:g} or more" if math.isinf(self.high) else f"from {self.low:g} to {self.high:g}"


# Types of settings. A plain number is from 0 to 1,000.
Share = Annotated[float, Between(0, 1)]
Positive = Annotated[float, Between(1e-9)]
Signed = Annotated[float, Between()]
Degrees = Annotated[float, Between(0, 180)]
AtLeastOne = Annotated[int, Between(1, 1_000)]
Seed = Annotated[int, Between(0, 2**32 - 1)]
Variant = Annotated[int, Between(0, 15)]
SETTING = {float: Between(0, 1_000), int: Between(0, 1_000)}
ANY = {float: Between(), int: Between()}
PLAIN: dict[type, str] = {list: "a list", dict: "a mapping", bool: "true or false", str: "a text"}


def read_json(path: Path, what: str, largest: int = LARGEST_JSON) -> Any:
    """A JSON file's document; BadInput if it cannot be read, is too large, or is no JSON that anybody could mean."""
    with refusing(f"{what}: cannot read {path}", OSError), require_file(path).open("rb") as file:
        return parse_json(file.read(largest + 1), f"{what}: {path}", largest)


def parse_json(text: bytes, where: str, largest: int = LARGEST_JSON) -> Any:
    """The document of a JSON text; raises as read_json does."""
    if len(text) > largest:
        raise BadInput(f"{where} is larger than {largest >> 20} MiB")
    with refusing(f"{where} is not JSON", ValueError, RecursionError):
        return json.loads(text.decode("utf-8-sig"))


def checked(
    kind: Any,
    value: Any,
    where: str,
    bounds: Mapping[type, Between] = ANY,  # of numbers that do not bring their own
    extra: bool = False,  # mappings may hold keys that a dataclass does not know
) -> Any:
    """A JSON value as the type that is expected: numbers, str, bool, Literal, unions with None, mappings, dataclasses.

    BadInput if it is of another type or out of bounds.
    """
    origin, arguments = _parts(kind)
    if kind is Any:
        return value
    if origin is Annotated:
        return checked(arguments[0], value, where, {**bounds, arguments[0]: arguments[1]}, extra)
    if origin is Literal:
        if not any(value == a and type(value) is type(a) for a in arguments):
            raise BadInput(f"{where}: {' or '.join(map(str, arguments))} expected, got {shown(value)}")
        return value
    if origin in (typing.Union, types.UnionType):
        if value is None and type(None) in arguments:
            return None
        (one,) = (a for a in arguments if a is not type(None))
        return checked(one, value, where, bounds, extra)
    if origin is list:
        return [checked(arguments[0], item, where, bounds, extra) for item in _as(list, value, where)]
    if origin is dict:
        of_key, of_value = arguments
        pairs = _as(dict, value, where).items()
        return {checked(of_key, k, where): checked(of_value, v, f"{where}.{k}") for k, v in pairs}
    if kind in (float, int):
        return _number(kind, value, where, bounds[kind])
    if is_dataclass(kind):
        return _dataclass(kind, value, where, bounds, extra)
    return _as(kind, value, where)


def within(settings: Any, where: str) -> None:
    """Raise BadInput if a setting, or one of those inside it, is out of its bounds."""
    for name, kind in kinds(type(settings)).items():  # type: ignore[arg-type]
        value = getattr(settings, name)
        if is_dataclass(value):
            within(value, f"{where}{name}.")
        elif not isinstance(value, tuple):
            checked(kind, value, f"{where}{name}", SETTING)


@cache
def kinds(kind: Any) -> dict[str, Any]:
    """The types of a dataclass's fields, by name."""
    hints = typing.get_type_hints(kind, include_extras=True)
    return {f.name: hints[f.name] for f in fields(kind)}


def shown(value: Any) -> str:
    """A value for an error's line: one that is short and printable."""
    try:
        text = repr(value)
    except ValueError:  # an integer of thousands of digits
        text = "a very long number"
    text = text.encode("utf-8", "backslashreplace").decode()
    return text if len(text) <= 60 else f"{text[:57]}…"


@cache
def _parts(kind: Any) -> tuple[Any, tuple[Any, ...]]:
    """What a type is made of; asked for every number of a file."""
    return typing.get_origin(kind), typing.get_args(kind)


def _number(kind: type, value: Any, where: str, bounds: Between) -> float | int:
    what = "a whole number" if kind is int else "a number"
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise BadInput(f"{where}: {what} expected, got {shown(value)}")
    try:
        number = float(value)
    except OverflowError:
        number = math.inf
    if not math.isfinite(number) or (kind is int and number != int(number)):
        raise BadInput(f"{where}: {'a finite number' if kind is float else what} expected, got {shown(value)}")
    if not bounds.low <= number <= bounds.high:
        raise BadInput(f"{where}: must be {bounds}, got {shown(value)}")
    return kind(value)


def _as(kind: type[T], value: Any, where: str) -> T:
    if not isinstance(value, kind):
        raise BadInput(f"{where}: {PLAIN[kind]} expected, got {shown(value)}")
    if isinstance(value, str) and value.encode("utf-8", "ignore").decode() != value:  # surrogates
        raise BadInput(f"{where}: {shown(value)} is no text that a file can hold")
    return value


def _dataclass(kind: Any, value: Any, where: str, bounds: Mapping[type, Between], extra: bool) -> Any:
    given = _as(dict, value, where)
    unknown = sorted(set(given) - set(kinds(kind)))
    if unknown and not extra:
        raise BadInput(f"{where}: {shown(unknown[0])} is not known")
    members = {}
    for field in fields(kind):
        name, value = field.name, given.get(field.name)
        if value is not None:
            members[name] = checked(kinds(kind)[name], value, f"{where}: {name}", bounds, extra)
        elif field.default is MISSING and field.default_factory is MISSING:
            raise BadInput(f"{where}: no {name}")
    return kind(**members)
