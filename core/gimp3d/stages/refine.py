"""Optimising the new Gaussians so that every view shows what was painted into it (paper 3.4; docs/method.md)."""

from __future__ import annotations

import itertools
import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, TypeVar

import cv2
import numpy as np

from ..camera import Camera
from ..compute.threads import parallel_map
from ..gaussians import Gaussians
from ..geometry import bounds, dilated
from ..progress import Progress, silent
from ..raster import Gradients, PictureGradients, Rendering, pixel_region
from ..schema import AtLeastOne, Between
from .propagate import Rule

V = TypeVar("V")
WINDOW, SIGMA = 11, 1.5  # of SSIM, as 3DGS and the evaluation take it
STEADY, STEADIER = 0.01**2, 0.03**2  # SSIM's C1 and C2, by which dark and flat parts count little
SSIM = 0.2  # share of D-SSIM in the loss, the rest is L1 (Kerbl 2023)
MARGIN = 4  # px of known picture round the target that counts as well: no visible seam
PAINTED = 0.5  # how far a painted pixel is believed, beside one of a photo
HELD_OUT = 8  # every so many views is not learned from; it says when to stop
TOGETHER = 2  # views whose gradients are taken from the same state, side by side; each moves it one step
BETAS, EPSILON = (0.9, 0.999), 1e-15  # of Adam
# Its learning rates: 3DGS's, those of shapes lower as there are few steps; of means in the Gaussians' median size.
RATES = {"means": 0.02, "log_scales": 0.005, "quats": 0.001, "opacity_logits": 0.02}
COLOUR, VIEW_DEPENDENCE = 0.0025, 0.000125


@dataclass(frozen=True)
class RefineSettings:
    """How long the new Gaussians are optimised."""

    steps: Annotated[int, Between(0, 1_000_000)] = 0  # of one view each, 0: the closed form is final; time against dB
    views: AtLeastOne = 48  # of the painted ones, at most; memory against what the others show
    check: AtLeastOne = 25  # steps between two looks at the held-out views; time against the best moment to stop
    patience: AtLeastOne = 2  # looks without an improvement before it stops; time against a late improvement


@dataclass(frozen=True)
class Observation:
    """What a view should show."""

    camera: Camera
    image: np.ndarray  # [H, W, 3] uint8
    target: np.ndarray  # [H, W] bool, what was painted
    weight: np.ndarray  # [H, W] float32 ≥ 0, how far each pixel is trusted

    def counting(self, margin: int) -> np.ndarray:
        """[H, W] float32, how far pixels count: the target as it is trusted; round it the photo itself counts fully."""
        return np.where(self.target, self.weight, dilated(self.target, margin)).astype(np.float32)


def observed(camera: Camera, image: np.ndarray, rules: np.ndarray) -> Observation:
    """What a painted view, `image` [H, W, 3] uint8 by its `rules` [H, W] uint8, tells of its hole."""
    weight = np.where(rules == Rule.EVIDENCE, 1.0, PAINTED) * ~np.isin(rules, (Rule.UNTOUCHED, Rule.UNREACHED))
    return Observation(camera, image, rules != Rule.UNTOUCHED, weight.astype(np.float32))


@dataclass(frozen=True)
class Refinement:
    """Optimised Gaussians."""

    gaussians: Gaussians
    steps: int  # of the kept state
    confidence: float  # by how much the loss of the held-out views fell, of what is left
    reason: str


def looked_at(views: Sequence[V], settings: RefineSettings) -> Sequence[V]:
    """Of many views as many as refinement looks at, evenly."""
    return views[:: math.ceil(len(views) / settings.views) or 1]


def refine_gaussians(
    frozen: Gaussians,  # the rest of the scene: its arrays are only read
    new: Gaussians,
    observations: Sequence[Observation],
    settings: RefineSettings = RefineSettings(),
    seed: int = 0,
    progress: Progress = silent,
    learned: Collection[str] = (*RATES, "sh"),  # what of the new Gaussians moves
    margin: int = MARGIN,  # px of known picture round the targets that counts as well
) -> Refinement:
    """Adam on the new Gaussians alone, over the tiles that the targets cover; the rest of the scene does not move.

    Every HELD_OUT-th view is left out of the gradient. The state that it likes best is kept, so the result is never
    worse there than the start. Without steps, views or new Gaussians the input is returned.
    """
    seen = looked_at([o for o in observations if o.counting(margin).any()], settings)
    if settings.steps == 0 or not len(new) or not seen:
        return Refinement(new, 0, 1.0, "no refinement: the closed form is final")
    views = parallel_map(lambda o: _View(frozen, o, margin), seen)
    judges = views[HELD_OUT // 2 :: HELD_OUT] or views[:1]
    learners = [v for v in views if v not in judges] or views
    state = _State(new, learned)
    rng = np.random.default_rng(seed)

    def judged() -> float:
        return float(np.mean(parallel_map(lambda v: v.loss(state.gaussians), judges)))

    before = best = judged()
    kept, kept_step, waited, step, order = new, 0, 0, 0, list[int]()
    while step < settings.steps:
        order = order or list(rng.permutation(len(learners)))
        count = min(TOGETHER, settings.check - step % settings.check, settings.steps - step)
        looks, order = order[:count], order[count:]
        for slopes in parallel_map(lambda k: learners[k].slopes(state.gaussians), looks):
            state.step(slopes)
        step += len(looks)
        if step % settings.check == 0 or step == settings.steps:
            now = judged()
            progress("refine", step, settings.steps, f"held-out loss {now:.4f}")
            waited = 0 if now < best else waited + 1
            if now < best:
                best, kept, kept_step = now, state.copied(), step
            if waited > settings.patience:
                break
    reason = (
        f"{kept_step} of {settings.steps} steps on {len(learners)} views kept: the loss of {len(judges)} held-out "
        f"views fell from {before:.4f} to {best:.4f}"
    )
    return Refinement(kept, kept_step, min(1.0, before / max(best, 1e-9) - 1), reason)


class _State:
    """The new Gaussians on their way: Adam (Kingma 2015)."""

    def __init__(self, new: Gaussians, learned: Collection[str] = (*RATES, "sh")) -> None:
        size = float(np.exp(np.median(new.log_scales)))
        colour = np.full((new.sh.shape[1], 1), VIEW_DEPENDENCE, np.float32)
        colour[0] = COLOUR
        rates: dict[str, float | np.ndarray] = {**RATES, "means": RATES["means"] * size, "sh": colour}
        self.rates = {name: rate for name, rate in rates.items() if name in learned}
        self.steps, self.gaussians = 0, new
        self.gaussians = self.copied()
        self.moments = {name: np.zeros((2, *getattr(new, name).shape), np.float32) for name in self.rates}

    def step(self, slopes: Gradients) -> None:
        """Move along the gradients; one that is no number does not count."""
        self.steps += 1
        unbiased, unbiased_square = (1 - beta**self.steps for beta in BETAS)
        for name, rate in self.rates.items():
            slope = np.nan_to_num(getattr(slopes, name), nan=0.0, posinf=0.0, neginf=0.0)
            mean, square = self.moments[name]
            mean += (1 - BETAS[0]) * (slope - mean)
            square += (1 - BETAS[1]) * (slope * slope - square)
            values = getattr(self.gaussians, name)
            values -= rate / unbiased * mean / (np.sqrt(square / unbiased_square) + EPSILON)

    def copied(self) -> Gaussians:
        return replace(self.gaussians, **{name: getattr(self.gaussians, name).copy() for name in self.rates})


class _View:
    """A view's part of the loss: what does not change between steps is prepared once."""

    def __init__(self, frozen: Gaussians, observation: Observation, margin: int = MARGIN) -> None:
        weight = observation.counting(margin)
        self.region = pixel_region(frozen, observation.camera, weight > 0, passes=frozenset({"rgb", "alpha"}))
        self.window = bounds(weight > 0, WINDOW // 2)
        weight = weight[self.window]
        self.counted, self.share = weight > 0, weight / weight.sum()  # by how much each pixel counts in the loss
        self.image = observation.image[self.window].astype(np.float32) / 255
        self.mean = _blurred(self.image)
        self.variance = _blurred(self.image**2) - self.mean**2

    def loss(self, active: Gaussians) -> float:
        return self.judged(self.region.render(active))[0]

    def slopes(self, active: Gaussians) -> Gradients:
        """The loss's gradient with respect to the new Gaussians."""
        drawn, way_back = self.region.trace(active)
        return way_back.backward(self.judged(drawn)[1])

    def judged(self, drawn: Rendering) -> tuple[float, PictureGradients]:
        """The loss of a rendering, and its gradient with respect to that."""
        part = drawn.rgb[self.window]
        rgb = np.where(self.counted[..., None], np.clip(part, 0, 1), self.image)
        off, share = rgb - self.image, self.share[..., None] / 3
        likeness, uphill = self._ssim(rgb, share)
        loss = (1 - SSIM) * float((np.abs(off) * share).sum()) + SSIM * float(((1 - likeness) * share).sum())
        slope = (1 - SSIM) * np.sign(off) * share - SSIM * uphill
        picture = np.zeros(drawn.rgb.shape, np.float32)
        picture[self.window] = slope * (self.counted[..., None] & (part >= 0) & (part <= 1))
        return loss, PictureGradients(rgb=picture)

    def _ssim(self, rgb: np.ndarray, share: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The SSIM map [h, w, 3] (Wang 2004), and the gradient of Σ share · SSIM with respect to rgb."""
        ends = 0, len(rgb) // 2, len(rgb)
        parts = parallel_map(lambda rows: self._ssim_of(rgb, share, *rows), itertools.pairwise(ends))
        ssim, slope = (np.concatenate(part) for part in zip(*parts))
        return ssim, slope

    def _ssim_of(self, rgb: np.ndarray, share: np.ndarray, low: int, high: int) -> tuple[np.ndarray, np.ndarray]:
        """The same of some rows."""
        near = slice(max(0, low - WINDOW), high + WINDOW)  # what two blurs reach
        inner = slice(low - near.start, high - near.start)
        rgb, share, image, image_mean, variance = (a[near] for a in (rgb, share, self.image, self.mean, self.variance))
        mean, square, product = _blurred(rgb), _blurred(rgb * rgb), _blurred(rgb * image)
        brightness = mean**2 + image_mean**2 + STEADY
        contrast = square - mean**2 + variance + STEADIER
        alike, together = 2 * mean * image_mean + STEADY, 2 * (product - mean * image_mean) + STEADIER
        ssim = alike * together / (brightness * contrast)
        by_product = 2 * share * alike / (brightness * contrast)
        by_square = -share * ssim / contrast
        by_mean = 2 * share * (image_mean * (together - alike) / (brightness * contrast) - ssim * mean / brightness)
        by_mean -= 2 * mean * by_square
        slope = _blurred(by_mean) + 2 * rgb * _blurred(by_square) + image * _blurred(by_product)
        return ssim[inner], slope[inner]


def _blurred(picture: np.ndarray) -> np.ndarray:
    """Under SSIM's window, black all round; it is its own adjoint."""
    kernel = cv2.getGaussianKernel(WINDOW, SIGMA, cv2.CV_64F)
    return cv2.sepFilter2D(picture, -1, kernel, kernel, borderType=cv2.BORDER_CONSTANT)
