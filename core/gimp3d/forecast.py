"""What a removal will cost, told before it starts, and how far a running one is.

The constants are written by scripts/calibrate_forecast.py, which measures them (2 cores, kernels compiled; the demo
scene with up to four times the Gaussians and pixels). Who runs removals multiplies by their own last run's pace.
"""

from __future__ import annotations

from dataclasses import dataclass, field

CHARTED = ("surfaces", "light", "lift", "charts", "verdict")  # stages of presets that know charts …
ROUNDS = {"draft": 2, "balanced": 4, "best": 5}  # … which these are: charts and views completed one after the other
ROUND = ("reference", "depth", "appearance", "mapping", "propagate", "seed")
STEPS = {"balanced": 100, "best": 400, "paper": 3000, "paper-literal": 3000}  # of refinement; others 0
# s of a stage: constant, for each million pixels of all views, for each million Gaussians in each view
FIRST = {
    "read": (0.234, 0.081, 0.135),
    "masks": (0.428, 0.099, 0.093),
    "reference": (0.126, 0.009, 0.078),
    "depth": (0.0, 0.032, 0.051),
    "appearance": (0.088, 0.023, 0.018),
    "mapping": (0.003, 0.03, 0.006),
    "propagate": (0.184, 0.036, 0.073),
    "seed": (0.053, 0.007, 0.018),
}
FURTHER = {
    "reference": (0.0, 0.009, 0.019),
    "depth": (0.0, 0.015, 0.005),
    "appearance": (0.0, 0.007, 0.0),
    "mapping": (0.0, 0.014, 0.009),
    "propagate": (0.0, 0.008, 0.024),
    "seed": (0.0, 0.008, 0.014),
}
PER_STEP = (0.0, 0.03323)  # s of refinement: constant, for each million pixels of a view
MEMORY_MB = (208.0, 59.0, 795.0)  # constant, for each million pixels of all views, for each million Gaussians


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
    work = (1.0, pixels / 1e6, gaussians / 1e6 * views)
    known = preset in ROUNDS  # charts are completed without looking for a reference and its depth
    other = ROUND[:2] if known else CHARTED
    stages = {name: _sum(cost, work) for name, cost in FIRST.items() if name not in other}
    for round_ in range(2, 1 + ROUNDS.get(preset, 1)):
        stages |= {f"{name} {round_}": _sum(cost, work) for name, cost in FURTHER.items()}
    steps = STEPS.get(preset, 0)
    if steps:
        stages["refine"] = steps * _sum(PER_STEP, (1.0, pixels / 1e6 / max(1, views)))
    memory_mb = _sum(MEMORY_MB, (1.0, pixels / 1e6, gaussians / 1e6))
    return Forecast(stages, memory_mb)


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
