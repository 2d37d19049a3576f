"""The rasteriser as a torch function. Tensors and arrays share their memory; nothing is copied."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import torch

from ..camera import Camera
from ..gaussians import ARRAYS, Gaussians
from . import ALL_PASSES, PictureGradients, PixelRegion, RasterSettings, trace


@dataclass(frozen=True)
class Pictures:
    """As `Rendering`, in torch; pictures that were not asked for are None."""

    rgb: torch.Tensor | None  # [H, W, 3] float32
    alpha: torch.Tensor  # [H, W]
    expected_depth: torch.Tensor | None  # [H, W]
    median_depth: torch.Tensor | None  # [H, W]
    normals: torch.Tensor | None  # [H, W, 3]


PICTURES = tuple(f.name for f in fields(Pictures))


def rasterize(
    means: torch.Tensor,
    log_scales: torch.Tensor,
    quats: torch.Tensor,
    opacity_logits: torch.Tensor,
    sh: torch.Tensor,
    view: Camera | PixelRegion,
    settings: RasterSettings = RasterSettings(),
    passes: frozenset[str] = ALL_PASSES,
    antialiased: bool = False,
) -> Pictures:
    """Draw Gaussians so that a loss on the pictures flows back to them.

    The tensors are raw values as in `Gaussians`, and must not be changed in place between forward and backward: torch
    checks that. Where `view` is a pixel region, its own settings and passes count, and its frozen Gaussians are drawn
    along. A ValueError if a tensor is not float32, on the CPU and contiguous: it would have to be copied.
    """
    tensors = (means, log_scales, quats, opacity_logits, sh)
    for name, t in zip(ARRAYS, tensors):
        if t.dtype != torch.float32 or t.device.type != "cpu" or not t.is_contiguous():
            raise ValueError(f"{name}: expected a contiguous float32 tensor on the CPU, got {t.dtype} on {t.device}")
    drawn = _Rasterize.apply(*tensors, view, settings, passes, antialiased)
    return Pictures(*(picture if picture.numel() else None for picture in drawn))  # type: ignore[arg-type]


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *args: Any) -> tuple[torch.Tensor, ...]:
        *tensors, view, settings, passes, antialiased = args
        gaussians = Gaussians(**{n: t.detach().numpy() for n, t in zip(ARRAYS, tensors)}, antialiased=antialiased)
        if isinstance(view, Camera):
            rendering, ctx.traced = trace(gaussians, view, settings, passes)
        else:
            rendering, ctx.traced = view.trace(gaussians)
        ctx.save_for_backward(*tensors)  # so that torch notices if they are changed in place
        ctx.set_materialize_grads(False)
        return tuple(torch.from_numpy(getattr(rendering, name)) for name in PICTURES)

    @staticmethod
    def backward(ctx: Any, *given: torch.Tensor | None) -> tuple[Any, ...]:
        _ = ctx.saved_tensors
        gradients = {n: np.ascontiguousarray(g.numpy()) for n, g in zip(PICTURES, given) if g is not None and g.numel()}
        g = ctx.traced.backward(PictureGradients(**gradients))
        return (*(torch.from_numpy(getattr(g, name)) for name in ARRAYS), None, None, None, None)
