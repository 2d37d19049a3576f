"""What users are told of a removal: what it will cost, how far it is, by a callable that stages call, and what it did.

The constants are written by tools/calibrate_forecast.py, which measures them (2 cores, kernels compiled; the demo
scene with up to four times the Gaussians and pixels). Who runs removals multiplies by their own last run's pace.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Protocol

CHARTED = ("draft", "balanced", "best")  # presets that complete charts; others complete one view
ON_CHARTS = ("surfaces", "light", "lift", "charts", "clear", "verdict")  # stages of the former alone …
ON_VIEWS = ("reference", "depth", "mapping")  # … and of the latter
ORDER = (
    "read", "masks", "exposure", "surfaces", "light", "lift", "charts", "clear", "relearn", "reference", "depth",
    "appearance", "seed", "mapping", "propagate", "settle", "refine", "recolour", "verdict",
)  # fmt: skip
STEPS = {"balanced": 100, "best": 400, "paper": 3000, "paper-literal": 3000}  # of refinement; others 0
VIEWS = 64  # that the former use at most; others use all
# s of a stage: constant, for each million pixels of all views, for each million Gaussians in each view
STAGES = {
    "read": (0.213, 0.074, 0.114),
    "masks": (0.222, 0.135, 0.222),
    "exposure": (0.017, 0.014, 0.02),
    "surfaces": (0.739, 0.154, 0.045),
    "light": (1.866, 0.021, 0.0),
    "lift": (0.0, 0.0, 0.0),
    "charts": (0.079, 0.068, 0.004),
    "clear": (0.053, 0.037, 0.096),
    "reference": (0.196, 0.007, 0.0),
    "depth": (0.007, 0.005, 0.0),
    "appearance": (0.621, 0.09, 0.16),
    "seed": (0.0, 0.004, 0.002),
    "mapping": (0.029, 0.016, 0.0),
    "propagate": (0.078, 0.102, 0.025),
    "settle": (0.013, 0.014, 0.034),
    "verdict": (0.137, 0.043, 0.039),
}
STEP = (0.00114, 0.02575)  # s of a step of refinement: constant, for each million pixels of a view
RECOLOUR = (0.0, 0.058, 0.218)  # s, as in STAGES
PAPER_STEP = (0.0033, 0.09402)  # the same for the paper's, which move everything
MEMORY_MB = (318.0, 57.0, 316.0)  # constant, for each million pixels of all views, for each million Gaussians


class Progress(Protocol):
    """Called as work goes on; may raise Cancelled to stop it."""

    def __call__(self, stage: str, done: int, total: int, message: str = "") -> None: ...


def silent(stage: str, done: int, total: int, message: str = "") -> None:
    """Report nothing."""


def count_words(counts: Mapping[str, int], things: str = "Gaussians") -> str:
    """What a removal did: those that were changed are counted once."""
    gone, new, changed = counts["removed"] - counts["changed"], counts["added"] - counts["changed"], counts["changed"]
    return f"{gone:,} {things} removed, {new:,} added" + (f", {changed:,} round them changed" if changed else "")


@dataclass(frozen=True)
class Forecast:
    """Seconds of each stage in order, and the memory that is needed at once."""

    stages: dict[str, float]
    memory_mb: float

    @property
    def seconds(self) -> float:
        return sum(self.stages.values())


def forecast_removal(gaussians: int, views: int, pixels: int, preset: str = "balanced") -> Forecast:
    """What a removal will roughly take, of `pixels` in all views: one chart, or one view, and a shadow that stays."""
    charted = preset in CHARTED
    if charted and views > VIEWS:
        pixels, views = pixels * VIEWS // views, VIEWS
    work = (1.0, pixels / 1e6, gaussians / 1e6 * views)
    other = ON_VIEWS if charted else ON_CHARTS
    stages = {name: _sum(cost, work) for name, cost in STAGES.items() if name not in other}
    if steps := STEPS.get(preset, 0):
        stages["refine"] = steps * _sum(STEP if charted else PAPER_STEP, (1.0, pixels / 1e6 / max(1, views)))
        if charted:
            stages["relearn"] = stages["refine"]  # as many steps, over about as many pixels
            stages["recolour"] = _sum(RECOLOUR, work)
    memory_mb = _sum(MEMORY_MB, (1.0, pixels / 1e6, gaussians / 1e6))
    return Forecast({name: stages[name] for name in ORDER if name in stages}, memory_mb)


def _sum(costs: tuple[float, ...], work: tuple[float, ...]) -> float:
    return sum(c * w for c, w in zip(costs, work, strict=True))


@dataclass
class Clock:
    """How far a removal is, from its progress lines; never goes back."""

    forecast: Forecast
    fraction: float = 0.0
    _done: dict[str, float] = field(default_factory=dict)

    def take(self, stage: str, done: int, total: int) -> None:
        """A progress line; stages that the forecast does not know count nothing."""
        names = list(self.forecast.stages)
        if stage in names:
            for earlier in names[: names.index(stage)]:
                self._done[earlier] = 1.0
            self._done[stage] = min(1.0, done / max(1, total))
        spent = sum(seconds * self._done.get(name, 0.0) for name, seconds in self.forecast.stages.items())
        self.fraction = max(self.fraction, min(1.0, spent / max(1e-9, self.forecast.seconds)))

    def seconds_left(self, elapsed: float, pace: float = 1.0) -> float:
        """From the forecast times `pace` at first, more and more from this run's own speed."""
        told = self.forecast.seconds * pace * (1 - self.fraction)
        seen = elapsed * (1 - self.fraction) / self.fraction if self.fraction > 0 else told
        return (1 - self.fraction) * told + self.fraction * seen
