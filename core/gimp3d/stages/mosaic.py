"""One picture of a surface from all photos that show it."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from ..compute.jit import exact_kernel, inline_kernel
from ..compute.threads import parallel_map, run_ranges
from .witness import Says, Witness, texture

SEAM = 4.0  # px, σ below which detail is the best photo's, above which colour is what most photos say
FEW = 12.0  # grey levels by which a photo may always differ from what most say
LOUD = 3.0  # times the spread of textures, by which its detail may besides: more is the edge of something before it


def mosaic(
    points: np.ndarray,  # [H, W, 3] scene coordinates of its texels
    normal: np.ndarray,  # [3] unit
    witnesses: Sequence[Witness],
    said: np.ndarray,  # [V, H, W], see ask
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """[H, W, 3] uint8: colours that most photos agree on, as sharp as the photo that shows the place best; 0 of none.

    And by how much photos' textures differ round each texel, [H, W] float32 grey levels, the median over photos: things
    that do not lie on the surface show another texture in each, whatever the light. And how loud the texture is that
    most of them show, likewise: a loud one differs more where photos are a little misplaced.

    Where photos disagree, the median of each channel decides. As misplaced photos blur its detail, that comes from one
    photo at a time, brought to the median's colours by a smooth correction: the one with most pixels there of those
    that need little of it. So no seam shows between photos (two bands of Burt & Adelson 1983).
    """
    h, w = points.shape[:2]
    clear = (said == Says.SEEN).any(0)  # elsewhere what is beside the object has to do
    told = np.where(clear, said == Says.SEEN, said == Says.BESIDE)
    flat = points.reshape(-1, 3)

    def of(k: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        c = witnesses[k].camera
        uv, z = c.project(points)
        x, y = (np.nan_to_num(uv, nan=-1e4).astype(np.float32) - 0.5).transpose(2, 0, 1)
        sample = cv2.remap(witnesses[k].photo, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        towards = c.centre - flat
        cosine = towards @ normal / np.linalg.norm(towards, axis=1)
        density = np.where(told[k].ravel(), np.maximum(cosine, 0.02) * c.fx * c.fy, 0)
        density = (density / np.maximum(np.nan_to_num(z.ravel()), 1e-9) ** 2).astype(np.float32)
        return sample.reshape(-1, 3), texture(sample, told[k]).ravel(), density

    parts = parallel_map(of, range(len(witnesses)))
    samples, textures, density = (np.array([p[k] for p in parts]) for k in range(3))
    middle, (spread, loud) = np.zeros((h * w, 3), np.float32), np.zeros((2, h * w), np.float32)
    run_ranges(_agree_range, h * w, samples, textures, density, middle, spread, loud)
    several = (density > 0).sum(0).reshape(h, w) > 1  # one photo agrees with itself
    spread, loud = (_smooth(a.reshape(h, w, 1), several)[..., 0] for a in (spread, loud))

    def correction(k: int) -> np.ndarray:
        off = _smooth((middle - samples[k]).reshape(h, w, 3), told[k])
        return np.clip(np.rint(off), -128, 127).astype(np.int8).reshape(-1, 3)

    corrections = np.array(parallel_map(correction, range(len(witnesses))))
    picture = middle.copy()
    run_ranges(_choose_range, h * w, samples, corrections, density, middle, FEW, FEW + LOUD * spread.ravel(), picture)
    return np.clip(np.rint(picture), 0, 255).reshape(h, w, 3).astype(np.uint8), spread, loud


def _smooth(picture: np.ndarray, shown: np.ndarray) -> np.ndarray:
    weight = shown.astype(np.float32)
    total = cv2.GaussianBlur(picture * weight[..., None], (0, 0), SEAM).reshape(picture.shape)
    return total / np.maximum(cv2.GaussianBlur(weight, (0, 0), SEAM), 1e-3)[..., None]


@exact_kernel
def _agree_range(lo, hi, samples, textures, density, middle, spread, loud):
    values = np.empty(len(samples))
    for i in range(lo, hi):
        for channel in range(4):  # the fourth is texture
            count = 0
            for k in range(len(samples)):
                if density[k, i] > 0:
                    values[count] = samples[k, i, channel] if channel < 3 else textures[k, i]
                    count += 1
            if count == 0:
                break
            part = np.sort(values[:count])
            if channel < 3:
                middle[i, channel] = 0.5 * (part[(count - 1) // 2] + part[count // 2])
            else:
                loud[i] = 0.5 * abs(part[count // 2])
                spread[i] = 0.5 * np.sort(np.abs(part - part[count // 2]))[count // 2]


@exact_kernel
def _choose_range(lo, hi, samples, corrections, density, middle, few, loud, picture):
    for i in range(lo, hi):
        least, largest = 127.0, 0.0
        for k in range(len(samples)):  # the nearest to the median always agrees
            if density[k, i] > 0:
                least = min(least, _most(corrections, k, i))
        for k in range(len(samples)):
            if not density[k, i] > largest or _most(corrections, k, i) > max(few, least):
                continue
            off = 0.0
            for channel in range(3):
                off = max(off, abs(samples[k, i, channel] + corrections[k, i, channel] - middle[i, channel]))
            if off <= loud[i]:
                largest = density[k, i]
                for channel in range(3):
                    picture[i, channel] = samples[k, i, channel] + corrections[k, i, channel]


@inline_kernel
def _most(corrections, k, i):
    return max(abs(float(corrections[k, i, 0])), abs(float(corrections[k, i, 1])), abs(float(corrections[k, i, 2])))
