"""What goes into a removal, travels through it and comes out; how its stages are run: timed, kept, open to watchers."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol, TypeVar

import numpy as np

from .camera import Camera
from .gaussians import Gaussians
from .presets import RemovalSettings
from .priors.calls import Call
from .progress import Progress, silent
from .stages.charts import Chart, Hits
from .stages.exposure import Exposure
from .stages.masks import ViewMasks
from .stages.propagate import Reference
from .stages.reference import ReferenceChoice
from .stages.verdict import Verdict

R = TypeVar("R")


@dataclass(frozen=True)
class View:
    """A camera and what it sees, the object included."""

    camera: Camera
    image: np.ndarray  # [H, W, 3] uint8
    is_photo: bool = True  # False: drawn from the scene


@dataclass(frozen=True)
class ViewState:
    """What is known of a view on its way through a removal; pictures are [H, W] of its camera."""

    masks: ViewMasks  # what the object touched, and where the view has to be filled
    photo: np.ndarray  # [H, W, 3] uint8, with the object, as it came
    exposure: Exposure  # of the photo over the splats'
    bare: np.ndarray  # [H, W, 3] uint8, the photo at the splats' exposure, the object's shadow and reflection undone
    painted: np.ndarray  # [H, W, 3] uint8, the same without the object, as far as that is known
    left: ViewMasks  # the masks as they are now: T shrinks with every reference
    hits: Hits | None = None  # where its rays meet charts; None without them
    rules: np.ndarray | None = None  # [H, W] Rule that gave each pixel its last colour; None: nothing was painted yet
    best: tuple[int, Reference] | None = None  # the reference that painted most of it, and how many pixels it did

    @classmethod
    def first(cls, masks: ViewMasks, photo: np.ndarray, exposure: Exposure) -> ViewState:
        """A view of which nothing is known but its photo and what has to be filled of it."""
        level = exposure.level(photo)
        return cls(masks, photo, exposure, level, level, masks)

    @property
    def camera(self) -> Camera:
        return self.masks.camera

    @property
    def id(self) -> str:
        return self.masks.camera.id


def open_pixels(views: Sequence[ViewState]) -> int:
    """What is still to be filled, in all views."""
    return sum(int(v.left.target.sum()) for v in views)


@dataclass(frozen=True)
class StageReport:
    """What a stage says of itself."""

    name: str
    seconds: float
    confidence: float
    reason: str


@dataclass(frozen=True)
class Picture:
    """A stage's result to look at."""

    kind: str  # mask | chart | shadow | depth | fit | appearance | mapping | rules | refined
    title: str
    draw: Callable[[], np.ndarray]  # [H, W, 3] uint8, where somebody looks


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


class Store(Protocol):
    """Where finished stages are kept, so that a stopped run can go on (job.StageStore)."""

    def load(self, name: str) -> Any | None: ...

    def save(self, name: str, result: Any) -> None: ...


# Runs a stage by its name ("masks", "propagate 2" in the second round), its function and what that takes: may look at
# what goes in and comes out, or do something else in its place.
Observer = Callable[[str, Callable[..., Any], tuple[Any, ...]], Any]


def counted(new: Gaussians) -> tuple[float, str]:
    """The words of a stage that makes Gaussians."""
    return 1.0, f"{len(new)} new Gaussians"


@dataclass
class Run:
    """One removal's stages in order; finished ones are taken from the store."""

    settings: RemovalSettings
    progress: Progress = silent
    store: Store | None = None
    allow_network: bool = False
    observer: Observer | None = None
    stages: list[StageReport] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    pictures: list[Picture] = field(default_factory=list)
    references: list[ReferenceChoice] = field(default_factory=list)

    def __call__(
        self,
        name: str,
        work: Callable[..., R],
        *inputs: Any,
        words: Callable[[R], tuple[float, str]] | None = None,  # confidence and reason, of results that have none
    ) -> R:
        """The stage's result."""
        self.progress(name, 0, 1)
        start = time.perf_counter()
        result: Any = self.store.load(name) if self.store else None
        if result is None:
            result = self.observer(name, work, inputs) if self.observer else work(*inputs)
            if self.store:
                self.store.save(name, result)
        confidence, reason = words(result) if words else (result.confidence, result.reason)
        self.stages.append(StageReport(name, time.perf_counter() - start, float(confidence), reason))
        self.progress(name, 1, 1, reason)
        return result

    def call(self, option: str, stage: str, strength: float = 1.0) -> Call:
        """What whoever a stage asks outside this program may do."""
        asked, network = self.settings, self.allow_network
        return Call(option, stage, self.progress, asked.painter_seconds, network, asked.prompt, strength)
