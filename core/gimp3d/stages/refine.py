"""Optimising the new Gaussians so that every view shows what was painted into it (paper 3.4, METHOD section 7)."""

from __future__ import annotations

import math
import threading
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np

from ..camera import Camera
from ..errors import BadInput
from ..gaussians import Gaussians
from ..progress import Progress, silent
from ..raster import PixelRegion, pixel_region
from ..threads import parallel_map
from .propagate import Rule

WINDOW, SIGMA = 11, 1.5  # of SSIM, as 3DGS and the evaluation take it
C1, C2 = 0.01**2, 0.03**2
BETAS, EPSILON = (0.9, 0.999), 1e-15  # of Adam


@dataclass(frozen=True)
class RefineSettings:
    """How the new Gaussians are optimised. Lengths in pixels."""

    steps: int = 0  # one view each; 0: the closed form is final
    views: int = 48  # as many of the painted ones at most: each holds its part of the scene in memory
    ssim: float = 0.2  # share of D-SSIM in the loss, the rest is L1 (Kerbl 2023)
    margin: int = 4  # of known picture round the target that counts as well: no visible seam
    held_out: int = 8  # every so many views is not learned from; it says when to stop
    check: int = 25  # steps between two looks at the held-out views
    patience: int = 2  # looks without an improvement before it stops
    # Learning rates of Adam; that of means is in units of the Gaussians' median size, per step
    rate_means: float = 0.02
    rate_scales: float = 0.005
    rate_quats: float = 0.001
    rate_opacity: float = 0.02
    rate_colour: float = 0.0025
    rate_view_dependence: float = 0.000125
    normal: float = 0.05  # weight of normal consistency, surfels only (Huang 2024)
    distortion: float = 10.0  # weight of depth distortion, surfels only


@dataclass(frozen=True)
class Observation:
    """What a view should show."""

    camera: Camera
    image: np.ndarray  # [H, W, 3] uint8
    target: np.ndarray  # [H, W] bool, what was painted
    weight: np.ndarray  # [H, W] float32 ≥ 0, how far each pixel is trusted


# How far a painted pixel is believed, by the rule that gave its colour.
TRUST = {
    Rule.EVIDENCE: 1.0,
    Rule.OWN_PIXELS: 0.5,
    Rule.RETARGETED: 0.5,
    Rule.OTHER_VIEW: 0.25,
    Rule.REFERENCE: 0.25,
}


def observed(
    camera: Camera,
    image: np.ndarray,  # [H, W, 3] uint8, the painted view
    rules: np.ndarray,  # [H, W] uint8, see Rule
) -> Observation:
    """What a painted view tells: its hole, each pixel as far as its rule is believed."""
    weights = np.zeros(max(Rule) + 1, np.float32)
    for rule, weight in TRUST.items():
        weights[rule] = weight
    return Observation(camera, image, rules != Rule.UNTOUCHED, weights[rules])


@dataclass(frozen=True)
class Refinement:
    """Optimised Gaussians."""

    gaussians: Gaussians
    steps: int  # of the kept state
    before: float  # loss of the held-out views
    after: float
    confidence: float
    reason: str


def torch_is_there() -> bool:
    try:
        import torch  # noqa: F401
    except ImportError:
        return False
    return True


def load_torch_ahead() -> None:
    """Import torch, if it is there, beside other work: it takes a second."""
    threading.Thread(target=torch_is_there, name="import torch").start()


def refine_gaussians(
    frozen: Gaussians,  # the rest of the scene: its arrays are only read
    new: Gaussians,
    observations: Sequence[Observation],
    settings: RefineSettings = RefineSettings(),
    seed: int = 0,
    progress: Progress = silent,
) -> Refinement:
    """Adam on the new Gaussians alone, over the tiles that the targets cover; the rest of the scene does not move.

    Every `held_out`-th view is left out of the gradient. The state that it likes best is kept, so the result is never
    worse there than the start. Without steps, views or new Gaussians the input is returned.

    Raises
    ------
    BadInput
        If torch is missing.
    """
    seen = [o for o in observations if (o.weight[o.target] > 0).any()]
    seen = seen[:: math.ceil(len(seen) / settings.views) or 1]
    if settings.steps == 0 or not len(new) or not seen:
        return Refinement(new, 0, 0.0, 0.0, 1.0, "no refinement: the closed form is final")
    if not torch_is_there():
        raise BadInput("refine: torch is not installed; pip install gimp3d[torch], or choose the preset draft")
    import torch

    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # sums are then the same on every machine; the rasteriser has threads of its own
    try:
        return _refine(frozen, new, seen, settings, seed, progress)
    finally:
        torch.set_num_threads(threads)


def _refine(
    frozen: Gaussians,
    new: Gaussians,
    seen: Sequence[Observation],
    settings: RefineSettings,
    seed: int,
    progress: Progress,
) -> Refinement:
    import torch

    views = parallel_map(lambda o: _View(frozen, o, settings), seen)
    judges = views[settings.held_out // 2 :: settings.held_out] or views[:1]
    learners = [v for v in views if v not in judges] or views
    state = _State(new, settings)
    rng = np.random.default_rng(seed)

    def judged() -> float:
        with torch.no_grad():
            return float(np.mean([v.loss(state).item() for v in judges]))

    before = best = judged()
    kept, kept_step, waited = state.gaussians(), 0, 0
    order: list[int] = []
    for step in range(1, settings.steps + 1):
        if not order:
            order = list(rng.permutation(len(learners)))
        learners[order.pop()].loss(state).backward()
        state.step()
        if step % settings.check == 0 or step == settings.steps:
            now = judged()
            progress("refine", step, settings.steps, f"held-out loss {now:.4f}")
            waited = 0 if now < best else waited + 1
            if now < best:
                best, kept, kept_step = now, state.gaussians(), step
            if waited > settings.patience:
                break
    reason = (
        f"{kept_step} of {settings.steps} steps on {len(learners)} views kept: the loss of {len(judges)} held-out "
        f"views fell from {before:.4f} to {best:.4f}"
    )
    return Refinement(kept, kept_step, before, best, min(1.0, before / max(best, 1e-9) - 1), reason)


class _State:
    """The new Gaussians as torch parameters."""

    def __init__(self, new: Gaussians, settings: RefineSettings) -> None:
        import torch

        self.new = new
        size = float(np.exp(np.median(new.log_scales)))
        arrays = (new.means, new.log_scales, new.quats, new.opacity_logits, new.sh[:, :1], new.sh[:, 1:])
        rates = (
            settings.rate_means * size,
            settings.rate_scales,
            settings.rate_quats,
            settings.rate_opacity,
            settings.rate_colour,
            settings.rate_view_dependence,
        )
        self.parameters = [torch.tensor(a, dtype=torch.float32, requires_grad=True) for a in arrays]
        self.rates, self.steps = rates, 0
        self.moments = [(torch.zeros_like(p), torch.zeros_like(p)) for p in self.parameters]

    def step(self) -> None:
        """A step of Adam (Kingma 2015) along the gradients, which are used up.

        As torch.optim.Adam to the last bit, but making one of those loads half of torch, which takes a second.
        """
        import torch

        self.steps += 1
        beta, beta2 = BETAS
        with torch.no_grad():
            for p, rate, (mean, square) in zip(self.parameters, self.rates, self.moments):
                if p.grad is None or not p.numel():
                    continue
                slope = torch.nan_to_num_(p.grad, 0.0, 0.0, 0.0)
                mean.lerp_(slope, 1 - beta)
                square.mul_(beta2).addcmul_(slope, slope, value=1 - beta2)
                size = (square.sqrt() / math.sqrt(1 - beta2**self.steps)).add_(EPSILON)
                p.addcdiv_(mean, size, value=-rate / (1 - beta**self.steps))
                p.grad = None

    def gaussians(self) -> Gaussians:
        means, log_scales, quats, opacity_logits, dc, rest = (p.detach().numpy() for p in self.parameters)
        return replace(
            self.new,
            means=means.copy(),
            log_scales=log_scales.copy(),
            quats=quats.copy(),
            opacity_logits=opacity_logits.copy(),
            sh=np.concatenate([dc, rest], axis=1),
        )


class _View:
    """A view's part of the loss: what does not change between steps is prepared once."""

    def __init__(self, frozen: Gaussians, observation: Observation, settings: RefineSettings) -> None:
        import torch

        self.settings, self.surfels, self.antialiased = settings, frozen.is_surfels, frozen.antialiased
        size = 2 * settings.margin + 1
        counted = cv2.dilate(observation.target.astype(np.uint8), np.ones((size, size), np.uint8)) > 0
        passes = {"rgb", "alpha"} | ({"normal", "distortion", "expected_depth"} if self.surfels else set())
        self.region: PixelRegion = pixel_region(frozen, observation.camera, counted, passes=frozenset(passes))
        rows, cols = np.flatnonzero(counted.any(1)), np.flatnonzero(counted.any(0))
        half = WINDOW // 2
        self.window = (
            slice(max(rows[0] - half, 0), rows[-1] + half + 1),
            slice(max(cols[0] - half, 0), cols[-1] + half + 1),
        )
        # Round the target the photo itself counts fully.
        weight = np.where(observation.target, observation.weight, 1.0) * counted
        self.image = torch.from_numpy(observation.image[self.window].astype(np.float32) / 255)
        self.weight = torch.from_numpy(weight[self.window].astype(np.float32))
        self.counted = torch.from_numpy(counted[self.window])

        self.rays = torch.from_numpy(_rays(observation.camera)[self.window].astype(np.float32))

    def loss(self, state: _State) -> Any:  # torch.Tensor, which is not imported here
        import torch

        from ..raster.autograd import rasterize

        means, log_scales, quats, opacity_logits, dc, rest = state.parameters
        sh = torch.cat([dc, rest], 1)
        drawn = rasterize(means, log_scales, quats, opacity_logits, sh, self.region, antialiased=self.antialiased)
        total = self.weight.sum()

        def mean(values: Any) -> Any:
            return (values * self.weight).sum() / total

        def part(picture: Any) -> Any:
            return picture[self.window]

        rgb = torch.where(self.counted[..., None], part(drawn.rgb).clamp(0, 1), self.image)
        absolute, structure = mean((rgb - self.image).abs().mean(-1)), mean((1 - _ssim(rgb, self.image)).mean(-1))
        loss = (1 - self.settings.ssim) * absolute + self.settings.ssim * structure
        if self.surfels:
            across = (part(drawn.normals) * _normals(part(drawn.expected_depth), self.rays)).sum(-1)
            loss = loss + self.settings.distortion * mean(part(drawn.distortion))
            loss = loss + self.settings.normal * mean(1 - across)
        return loss


def _rays(camera: Camera) -> np.ndarray:
    """Points at depth 1 that the pixels show, [H, W, 3] in camera axes."""
    flat = (camera.pixel_centres() - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    return np.concatenate([flat, np.ones((*flat.shape[:-1], 1))], -1)


def _normals(depth: Any, rays: Any) -> Any:  # torch.Tensor [H, W], [H, W, 3]
    """Unit normals [H, W, 3] of a depth map, facing the camera (Huang 2024, eq. 16)."""
    import torch

    points = rays * depth[..., None]
    right, down = (torch.gradient(points, dim=d)[0] for d in (1, 0))
    return torch.nn.functional.normalize(torch.cross(down, right, dim=-1), dim=-1)


def _ssim(a: Any, b: Any) -> Any:  # torch.Tensor [H, W, 3] each
    """The SSIM map [H, W, 3] with a Gaussian window (Wang 2004)."""
    import torch

    x = torch.arange(WINDOW, dtype=torch.float32) - WINDOW // 2
    kernel = torch.exp(-(x**2) / (2 * SIGMA**2))
    kernel = kernel / kernel.sum()
    maps = torch.stack([a, b, a * a, b * b, a * b]).permute(0, 3, 1, 2).reshape(15, 1, *a.shape[:2])
    rows = torch.nn.functional.conv2d(maps, kernel.view(1, 1, WINDOW, 1), padding=(WINDOW // 2, 0))
    blurred = torch.nn.functional.conv2d(rows, kernel.view(1, 1, 1, WINDOW), padding=(0, WINDOW // 2))
    mean_a, mean_b, aa, bb, ab = blurred.reshape(5, 3, *a.shape[:2]).permute(0, 2, 3, 1)
    product = mean_a * mean_b
    variances = aa - mean_a**2 + bb - mean_b**2
    return (2 * product + C1) * (2 * (ab - product) + C2) / ((mean_a**2 + mean_b**2 + C1) * (variances + C2))
