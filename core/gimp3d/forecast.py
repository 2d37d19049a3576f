"""What a removal will cost, told before it starts, and how far a running one is.

The constants are measured (4 cores, kernels compiled; the demo and the desk scene, 50,000 Gaussians and 24–36 views of
480×270, and a scan of 125,000): good to a factor of two. Who runs removals multiplies by their own last run's pace.
"""

from __future__ import annotations

from dataclasses import dataclass, field

ROUNDS = {"draft": 3, "balanced": 4, "best": 5}  # reference views completed, one after the other; others 1
ROUND = ("reference", "depth", "appearance", "mapping", "propagate", "seed")
STEPS = {"balanced": 100, "best": 400, "paper": 3000, "paper-literal": 3000}  # of refinement; others 0
PER_STEP = 0.005  # s
PER_MEGAPIXEL = {"read": 0.3, "masks": 0.6, "reference": 0.2, "propagate": 0.3}  # s for each million pixels of views
PER_STAGE = {"depth": 0.25, "appearance": 0.3, "mapping": 0.1, "seed": 0.05}  # s
PER_MILLION_VIEWED = 0.5  # s of masks for each million Gaussians in each view
BASE_MB, MB_PER_MEGAPIXEL, MB_PER_MILLION = 350.0, 40.0, 1000.0
REFINE_MB = 50.0  # the views, made ready


@dataclass(frozen=True)
class Forecast:
    """Seconds of each stage in order (further rounds are `depth 2`, …), and the memory that is needed at once."""

    stages: dict[str, float]
    memory_mb: float

    @property
    def seconds(self) -> float:
        return sum(self.stages.values())


def forecast_removal(
    gaussians: int,
    views: int,
    pixels: int,  # of all views together
    preset: str = "balanced",
) -> Forecast:
    """What a removal will roughly take; of what it finds to fill nothing is known yet, so all rounds count."""
    megapixels, millions = pixels / 1e6, gaussians / 1e6
    cost = {
        name: PER_STAGE.get(name, 0) + PER_MEGAPIXEL.get(name, 0) * megapixels for name in ("read", "masks", *ROUND)
    }
    cost["masks"] += PER_MILLION_VIEWED * millions * views
    stages = {name: cost[name] for name in ("read", "masks")}
    for round_ in range(1, 1 + ROUNDS.get(preset, 1)):
        stages |= {name if round_ == 1 else f"{name} {round_}": cost[name] for name in ROUND}
    steps = STEPS.get(preset, 0)
    if steps:
        stages["refine"] = PER_STEP * steps
    memory_mb = BASE_MB + MB_PER_MEGAPIXEL * megapixels + MB_PER_MILLION * millions + (REFINE_MB if steps else 0.0)
    return Forecast(stages, memory_mb)


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
