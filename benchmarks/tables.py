"""Rows of results, Markdown tables of them, and sheets of pictures."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

Row = dict[str, Any]


# --------------------------------------------------------------------------------------------------------------- tables


def table(head: Sequence[Any], rows: Iterable[Sequence[Any]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "".join("| " + " | ".join(str(cell) for cell in line) + " |\n" for line in lines)


def columns(rows: Iterable[Row], forms: Mapping[str, str]) -> tuple[list[str], list[list[str]]]:
    """Head and lines of a table: what stands over each column, and the format of what a row says there, if it does."""

    def cell(form: str, row: Row) -> str:
        try:
            return form.format(**row)
        except KeyError:
            return ""

    return list(forms), [[cell(form, row) for form in forms.values()] for row in rows]


def where(rows: Iterable[Row], **wanted: Any) -> list[Row]:
    """The rows that have these values."""
    return [r for r in rows if all(r.get(key) == value for key, value in wanted.items())]


def values(rows: Iterable[Row], key: str) -> list[Any]:
    """The different values of a key, in the order in which they come."""
    return list(dict.fromkeys(r[key] for r in rows))


def mean(rows: Iterable[Row], key: str) -> float:
    """Mean over the rows that have the key; NaN if none has."""
    found = [r[key] for r in rows if key in r]
    return float(np.mean(found)) if found else float("nan")


def in_words(count: float) -> str:
    """2,000,000 as 2M, 100,000 as 100k."""
    return f"{count / 1e6:g}M" if count >= 1e6 else f"{count / 1e3:g}k"


def shown(size: Sequence[int]) -> str:
    return f"{size[0]}×{size[1]}"


@dataclass(frozen=True)
class Section:
    """A table with a heading and what must be known to read it."""

    title: str
    words: str
    head: Sequence[str]
    rows: Sequence[Sequence[Any]]


def markdown(title: str, about: str, sections: Iterable[Section], pictures: Sequence[str] = ()) -> str:
    """Tables, and the pictures that lie beside them."""
    parts = [f"# {title}\n", f"{about}\n"]
    for section in sections:
        parts += [f"## {section.title}\n", f"{section.words}\n", table(section.head, section.rows)]
    return "\n".join([*parts, *(f"{name}\n\n![{name}]({name})\n" for name in pictures)])


# --------------------------------------------------------------------------------------------------- sheets of pictures


def sheet(rows: Sequence[dict[str, np.ndarray]]) -> np.ndarray:
    """Rows of pictures [H, W, 3] uint8 under their words, each as large as it gets where the largest one fits."""
    height, width = np.max([picture.shape[:2] for row in rows for picture in row.values()], axis=0)
    return np.vstack([np.hstack([_tile(p, words, height, width) for words, p in row.items()]) for row in rows])


def _tile(picture: np.ndarray, words: str, height: int, width: int) -> np.ndarray:
    scale = min(width / picture.shape[1], height / picture.shape[0])
    small = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_NEAREST)[:height, :width]
    tile = np.zeros((height + 18, width, 3), np.uint8)
    tile[:18] = 30
    tile[18 : 18 + small.shape[0], : small.shape[1]] = small
    cv2.putText(tile, words, (4, 13), cv2.FONT_HERSHEY_SIMPLEX, 0.4, (230, 230, 230), 1, cv2.LINE_AA)
    return tile


def distance_to(mask: np.ndarray) -> np.ndarray:
    """Pixels to the nearest one of the mask, [H, W]; infinite where the mask is empty."""
    if not mask.any():
        return np.full(mask.shape, np.inf)
    return cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
