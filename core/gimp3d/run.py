"""How stages are run: timed, their words and results kept, and open to whoever watches or replaces them."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, Protocol, TypeVar

from .gaussians import Gaussians
from .presets import RemovalSettings
from .priors.calls import Call
from .progress import Progress, silent
from .result import Picture, StageReport
from .stages.reference import ReferenceChoice

R = TypeVar("R")


class Store(Protocol):
    """Where finished stages are kept, so that a stopped run can go on (store.StageStore)."""

    def load(self, name: str) -> Any | None: ...

    def save(self, name: str, result: Any) -> None: ...


class Observer(Protocol):
    """Runs a stage: may look at what goes in and comes out, or do something else in its place.

    `name` is the stage's ("masks", "propagate 2" in the second round), `work` its function, `inputs` what that takes.
    """

    def __call__(self, name: str, work: Callable[..., Any], inputs: tuple[Any, ...]) -> Any: ...


def unobserved(name: str, work: Callable[..., Any], inputs: tuple[Any, ...]) -> Any:
    """The observer that only runs the stage."""
    return work(*inputs)


def counted(new: Gaussians) -> tuple[float, str]:
    """The words of a stage that makes Gaussians."""
    return 1.0, f"{len(new)} new Gaussians"


class Run:
    """One removal's stages in order; finished ones are taken from the store."""

    def __init__(
        self,
        settings: RemovalSettings,
        progress: Progress = silent,
        store: Store | None = None,
        allow_network: bool = False,
        observer: Observer = unobserved,
    ) -> None:
        self.settings, self.progress, self.store = settings, progress, store
        self.allow_network, self.observer = allow_network, observer
        self.stages: list[StageReport] = []
        self.warnings: list[str] = []
        self.pictures: list[Picture] = []
        self.references: list[ReferenceChoice] = []

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
        result = self.store.load(name) if self.store else None
        if result is None:
            result = self.observer(name, work, inputs)
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
