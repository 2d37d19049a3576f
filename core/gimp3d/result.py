"""What goes into a removal beside the scene, and what comes out of it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from .camera import Camera
from .gaussians import Gaussians
from .stages.charts import Chart
from .stages.reference import ReferenceChoice
from .stages.verdict import Verdict


@dataclass(frozen=True)
class View:
    """A camera and what it sees, the object included."""

    camera: Camera
    image: np.ndarray  # [H, W, 3] uint8
    is_photo: bool = True  # False: drawn from the scene


@dataclass(frozen=True)
class StageReport:
    """What a stage says of itself."""

    name: str
    seconds: float
    confidence: float
    reason: str


@dataclass(frozen=True)
class Picture:
    """A stage's result to look at; `report` draws it by its kind."""

    kind: str  # mask | chart | shadow | depth | fit | appearance | mapping | rules | refined
    title: str
    image: np.ndarray  # [H, W, 3] uint8, the view
    # per kind: (target) | (hole) | (light that arrives, lifted) | (depth, target) | (ring, line, s_f) | (target)
    # | (rows, cols) | (rules, raw) | (the view before)
    data: tuple[np.ndarray, ...]


@dataclass(frozen=True)
class RemovalResult:
    """The removal: which rows stay, what is added, and how it came about."""

    keep: np.ndarray  # [N] bool over the input's rows
    added: Gaussians | None
    stages: tuple[StageReport, ...] = ()
    hole_pixels: int = 0
    open_pixels: int = 0  # of these, what no reference reached
    views: int = 0
    painted: dict[str, np.ndarray] = field(default_factory=dict)  # ID → I_t* [H, W, 3] uint8
    pictures: tuple[Picture, ...] = ()
    charts: tuple[Chart, ...] = ()  # as completed; see steps.references.charts_to_paint
    references: tuple[ReferenceChoice, ...] = ()  # in the order in which they were completed
    warnings: tuple[str, ...] = ()
    selection: dict[str, int] = field(default_factory=dict)  # how many rows have which masks' Fate
    verdict: Verdict | None = None  # None where nothing was removed
    proposed: dict[str, Any] = field(default_factory=dict)  # what of the object the boxes cut off, see Growth.facts
    shadow: dict[str, Any] = field(default_factory=dict)  # see Shadow.facts
    reflection: dict[str, Any] = field(default_factory=dict)  # see Reflection.facts
    lifted: int = 0  # Gaussians that stay in another light
    changed: int = 0  # … or otherwise not as they were: removed, and the first of those added
    refined_views: dict[str, Any] = field(default_factory=dict)  # see ViewRefinement.facts; empty: nobody was asked

    @property
    def new(self) -> Gaussians | None:
        """What is added and was not there before."""
        return self.added and self.added.take(np.arange(self.changed, len(self.added)))
