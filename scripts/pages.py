"""Pages of benchmarks: tables as HTML, and sheets of pictures."""

from __future__ import annotations

from dataclasses import dataclass
from html import escape

import cv2
import numpy as np


@dataclass(frozen=True)
class Section:
    """A table with a heading and what must be known to read it."""

    title: str
    words: str
    head: list[str]
    rows: list[list[str]]


def html_table(section: Section) -> str:
    rows = _html_row(section.head, "th") + "".join(_html_row(row, "td") for row in section.rows)
    return f"<h2>{escape(section.title)}</h2><p>{escape(section.words)}</p><table>{rows}</table>"


def figure(name: str) -> str:
    """A picture that lies beside the page, as wide as the page; a click shows it alone."""
    return f"<figure><a href='{name}'><img src='{name}' alt=''></a><figcaption>{escape(name)}</figcaption></figure>"


def _html_row(cells: list[str], tag: str) -> str:
    return "<tr>" + "".join(f"<{tag}>{escape(cell)}</{tag}>" for cell in cells) + "</tr>"


def fitted(picture: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """The picture as large as it gets on a black ground of `size` (width, height)."""
    scale = min(size[0] / picture.shape[1], size[1] / picture.shape[0])
    small = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_NEAREST)[: size[1], : size[0]]
    ground = np.zeros((size[1], size[0], 3), np.uint8)
    ground[: small.shape[0], : small.shape[1]] = small
    return ground


def titled(picture: np.ndarray, words: str) -> np.ndarray:
    bar = np.full((18, picture.shape[1], 3), 30, np.uint8)
    cv2.putText(bar, words, (4, 13), cv2.FONT_HERSHEY_SIMPLEX, 0.4, (230, 230, 230), 1, cv2.LINE_AA)
    return np.vstack([bar, picture])


def sheet(pictures: list[np.ndarray], columns: int) -> np.ndarray:
    """Pictures in rows; all are as large as the first."""
    shape = pictures[0].shape
    alike = [p if p.shape == shape else fitted(p, (shape[1], shape[0])) for p in pictures]
    alike += [np.zeros(shape, np.uint8)] * (-len(alike) % columns)
    return np.vstack([np.hstack(alike[k : k + columns]) for k in range(0, len(alike), columns)])
