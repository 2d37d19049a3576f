"""Relative depth of the reference from elsewhere: the paper's monocular model, or a file (METHOD section 3)."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from ..errors import BadInput


def depth_prior(
    spec: str,  # auto | harmonic | planar | file:PATH[,disparity|,depth]
    height: int,
    width: int,
) -> np.ndarray | None:
    """Relative disparity [H, W] float32 (any scale and shift, NaN = no value), or None where the scene alone decides.

    A file holds disparity (near is large) unless it is said to hold depth: .npy, or any picture that OpenCV reads with
    one channel of 8, 16 or 32 bits. It may have another resolution than the view, not another shape.

    Raises
    ------
    BadInput
        If the provider is unknown or its file cannot be used.
    """
    name, _, rest = spec.partition(":")
    if spec in ("auto", "harmonic", "planar"):
        return None
    if name == "file":
        path, _, kind = rest.rpartition(",")
        if kind not in ("disparity", "depth"):
            path, kind = rest, "disparity"
        return _from_file(Path(path), kind, height, width)
    if name == "onnx":
        raise BadInput("--depth-prior onnx: not available in this version; use auto, harmonic, planar or file:PATH")
    raise BadInput(
        f"--depth-prior: unknown provider {spec!r}; use auto, harmonic, planar or file:PATH[,disparity|,depth]"
    )


def _from_file(path: Path, kind: str, height: int, width: int) -> np.ndarray:
    try:
        if path.suffix == ".npy":
            values = np.load(path, allow_pickle=False)
        else:
            values = cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_ANYDEPTH | cv2.IMREAD_GRAYSCALE)
        values = np.asarray(values, np.float32)
    except (OSError, ValueError, TypeError, cv2.error) as error:
        raise BadInput(f"--depth-prior: cannot read {path} ({error})") from None
    if values.ndim != 2 or values.size == 0:
        raise BadInput(f"--depth-prior: {path} is not a depth picture of one channel")
    if not np.isfinite(values).any():
        raise BadInput(f"--depth-prior: {path} holds no finite value")
    if abs(values.shape[1] * height - values.shape[0] * width) > 1.5 * max(values.shape[0], height):
        raise BadInput(
            f"--depth-prior: {path} has {values.shape[1]}×{values.shape[0]} pixels, not the shape of the view "
            f"({width}×{height})"
        )
    if kind == "depth":
        with np.errstate(divide="ignore", invalid="ignore"):
            values = np.where(values > 0, 1.0 / values, np.nan).astype(np.float32)
    if values.shape != (height, width):
        values = cv2.resize(values, (width, height), interpolation=cv2.INTER_LINEAR)
    return values
