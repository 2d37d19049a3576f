"""Random scenes with a hole and a known surface behind it, and relative-depth priors with known faults."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np

RELIEFS = ("plane", "sphere", "step", "crease", "terrain")
PLACES = ("floor", "corner", "ledge", "crest", "terrain", "waves", "boulder", "mounds")
Height = Callable[[np.ndarray, np.ndarray], np.ndarray]


@dataclass(frozen=True)
class Scene:
    """A disparity map without the object, as splats give it, and as it is."""

    truth: np.ndarray  # [H, W] disparity
    measured: np.ndarray  # [H, W] with noise
    hole: np.ndarray  # [H, W] bool


def relief(kind: str, rng: np.random.Generator, height: int = 180, width: int = 240) -> Scene:
    """A disparity map of one of RELIEFS with noise of 0.5 % of its range (research, K2)."""
    v, u = np.mgrid[:height, :width].astype(float)
    x, y = u - width / 2, v - height / 2
    truth = 1 + rng.uniform(-0.004, 0.004) * x + rng.uniform(-0.001, 0.007) * y
    turn, offset = rng.uniform(0, np.pi), rng.uniform(-8, 8)
    across = x * np.cos(turn) + y * np.sin(turn) + offset
    if kind == "sphere":
        (a, b), radius = rng.uniform(-25, 25, 2), rng.uniform(28, 45)
        truth += 0.5 * np.sqrt(np.maximum(1 - np.hypot(x - a, y - b) ** 2 / radius**2, 0))
    elif kind == "step":
        truth += 0.6 * (across > 0)
    elif kind == "crease":
        truth += 0.012 * np.abs(across)
    elif kind == "terrain":
        truth += smooth_noise(rng, truth.shape, 12) * 0.3
    truth += max(0.0, 0.2 - truth.min())
    hole = blob(rng, x, y, np.sqrt(0.08 * height * width / np.pi))
    return Scene(truth, truth + 0.005 * np.ptp(truth) * rng.standard_normal(truth.shape), hole)


def place(kind: str, rng: np.random.Generator, height: int = 180, width: int = 320) -> Scene:
    """One of PLACES, seen in perspective from 1 above the ground, with relative noise of 0.1 to 0.4 %."""
    focal, far, pitch = 300.0, 12.0, np.deg2rad(rng.uniform(18, 50))
    v, u = np.mgrid[:height, :width] + 0.5
    a, b = (u - width / 2) / focal, (v - height / 2) / focal
    # z-depth × ray; x right, y ahead, z up, seen from (0, 0, 1)
    ray = np.stack([a, np.cos(pitch) - b * np.sin(pitch), -np.sin(pitch) - b * np.cos(pitch)], -1)
    middle = 1 / np.tan(pitch)  # y of the ground in the picture's middle
    depth = _planes(kind, rng, ray, middle) if kind in ("floor", "corner") else _ground(kind, rng, ray, middle)
    depth = np.minimum(depth, far)
    x, y = u - width / 2 - rng.uniform(-30, 30), (v - height / 2 - rng.uniform(-12, 12)) * rng.uniform(1, 1.6)
    hole = blob(rng, x, y, rng.uniform(22, 46))
    noise = 0.5 * (rng.standard_normal(depth.shape) + smooth_noise(rng, depth.shape, 1.5))
    return Scene(1 / depth, 1 / depth * (1 + rng.uniform(0.001, 0.004) * noise), hole)


def _planes(kind: str, rng: np.random.Generator, ray: np.ndarray, middle: float) -> np.ndarray:
    """z-depth of a floor, and of one or two walls that meet it near the picture's middle."""
    tilt = rng.uniform(-0.1, 0.1, 2)
    planes = [(np.array([-tilt[0], -tilt[1], 1.0]), -tilt[1] * middle - 1)]
    turn = np.pi / 2 + rng.uniform(-0.9, 0.9)
    for _ in range(0 if kind == "floor" else rng.integers(1, 3)):
        normal = np.array([-np.cos(turn), -np.sin(turn), 0])
        planes.append((normal, normal[1] * middle + rng.uniform(0.02, 0.15) * middle * -1))
        turn += rng.choice([-1, 1]) * np.pi / 2
    depth = np.full(ray.shape[:2], np.inf)
    for normal, level in planes:
        along = ray @ normal
        hit = np.divide(level, along, out=np.full(along.shape, np.inf), where=np.abs(along) > 1e-9)
        depth = np.minimum(depth, np.where(hit > 0, hit, np.inf))
    return depth


def _ground(kind: str, rng: np.random.Generator, ray: np.ndarray, middle: float) -> np.ndarray:
    """z-depth of a height field, found by stepping along the rays and halving."""
    height = _height(kind, rng, middle)

    def below(z: np.ndarray) -> np.ndarray:
        return 1 + z * ray[..., 2] < height(z * ray[..., 0], z * ray[..., 1])

    low, high = np.full(ray.shape[:2], 0.25), np.full(ray.shape[:2], 12.0)
    reached = np.zeros(ray.shape[:2], bool)
    for z in np.geomspace(0.25, 12, 260):
        under = below(np.full(ray.shape[:2], z)) & ~reached
        high[under], reached = z, reached | under
        low[~reached] = z
    for _ in range(24):
        half = (low + high) / 2
        under = below(half)
        low, high = np.where(under, low, half), np.where(under, half, high)
    return np.where(reached, high, 12.0)


def _height(kind: str, rng: np.random.Generator, middle: float) -> Height:
    turn, offset = rng.uniform(0, 2 * np.pi), rng.uniform(-0.1, 0.1) * middle

    def across(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return x * np.cos(turn) + (y - middle) * np.sin(turn) - offset

    size = rng.uniform(0.02, 0.08) * middle
    if kind == "ledge":
        rise = rng.uniform(0.05, 0.2) * middle
        return lambda x, y: rise * (across(x, y) > 0)
    if kind == "crest":
        slope = rng.uniform(0.2, 0.6) * rng.choice([-1, 1])
        return lambda x, y: -slope * np.abs(across(x, y))
    if kind == "terrain":  # a power-law spectrum
        frequency = np.hypot(*np.meshgrid(np.fft.fftfreq(256), np.fft.fftfreq(256)))
        frequency[0, 0] = np.inf
        spectrum = np.fft.fft2(rng.standard_normal((256, 256))) * frequency ** -rng.uniform(1.6, 2.4)
        field = np.fft.ifft2(spectrum).real
        field = (field / field.std() * size).astype(np.float32)
        step = rng.uniform(40, 80) / middle

        def look(x: np.ndarray, y: np.ndarray) -> np.ndarray:
            at = [(c * step % 256).astype(np.float32) for c in (x, y)]
            return cv2.remap(field, *at, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)

        return look
    if kind == "waves":
        turns, phases, rates = rng.uniform(0, 6, 3), rng.uniform(0, 6, 3), rng.uniform(2, 7, 3) / middle
        return lambda x, y: (
            size / 2 * sum(np.sin(r * (x * np.cos(t) + y * np.sin(t)) + p) for t, p, r in zip(turns, phases, rates))
        )
    if kind == "boulder":
        (a, b), radius = rng.uniform(-0.15, 0.15, 2) * middle, rng.uniform(0.15, 0.35) * middle
        return lambda x, y: 0.6 * np.sqrt(np.maximum(radius**2 - (x - a) ** 2 - (y - middle - b) ** 2, 0))
    centres, radii = rng.uniform(-0.8, 0.8, (8, 2)) * middle, rng.uniform(0.1, 0.4, 8) * middle
    heights = rng.uniform(-0.12, 0.15, 8) * middle
    return lambda x, y: sum(
        h * np.exp(-((x - a) ** 2 + (y - middle - b) ** 2) / (2 * r**2))
        for (a, b), r, h in zip(centres, radii, heights)
    )


def blob(rng: np.random.Generator, x: np.ndarray, y: np.ndarray, radius: float) -> np.ndarray:
    """[H, W] bool: a round hole with an irregular outline."""
    angle, phase = np.arctan2(y, x), rng.uniform(0, 2 * np.pi, 3)
    waves = sum(s * np.sin(n * angle + p) for s, n, p in zip((0.18, 0.1, 0.06), (2, 3, 5), phase))
    return np.hypot(x, y) < radius * (1 + waves)


def smooth_noise(rng: np.random.Generator, shape: tuple[int, ...], size: float) -> np.ndarray:
    """Gaussian noise of standard deviation 1, blurred to a size in pixels."""
    noise = cv2.GaussianBlur(rng.standard_normal(shape), (0, 0), size)
    return noise / noise.std()


def prior_of(
    truth: np.ndarray,  # [H, W] disparity
    rng: np.random.Generator,
    gain: float,
    shift: float = 0.0,
    bias: float = 0.0,  # smooth errors of σ 14 px, as a share of the disparity's range
    noise: float = 0.0,  # white noise, as a share of the range
) -> np.ndarray:
    """A relative disparity: (truth + errors) / gain + shift, so that `gain` is the s_f of a prior without errors."""
    spread = np.ptp(truth)
    errors = bias * smooth_noise(rng, truth.shape, 14) + noise * rng.standard_normal(truth.shape)
    return (truth + spread * errors) / gain + shift
