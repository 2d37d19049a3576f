"""Relative depth of the reference from elsewhere: the paper's monocular model, or a file (METHOD section 3).

A prior says what its numbers are, since models differ: `disparity` (near is large, any scale and shift: MiDaS, Depth
Anything), `depth` (far is large, any scale and shift: Marigold and other affine-invariant depth) or `metric` (z-depth
up to scale). `relative_disparity` brings all of them to disparity of any scale and shift, which is what s_f takes on.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from ..errors import BadInput
from ..solvers.robust import robust_fit
from .onnx import OnnxModel, read_model

KINDS = ("disparity", "depth", "metric")
IMAGENET_MEAN = np.array([0.485, 0.456, 0.406], np.float32)  # of RGB in [0, 1], as published models were trained
IMAGENET_STD = np.array([0.229, 0.224, 0.225], np.float32)
FREE_SIZE = (518, 518)  # (width, height) for models that take any size: 37 patches of 14 px, as Depth Anything
USAGE = "use auto, harmonic, planar, file:PATH or onnx:PATH, the path followed by ,disparity ,depth or ,metric"


@dataclass(frozen=True)
class DepthPrior:
    """Depth of a view up to what `kind` leaves open."""

    values: np.ndarray  # [H, W] float32, NaN = no value
    kind: str = "disparity"  # disparity | depth | metric


def depth_prior(
    spec: str,  # auto | harmonic | planar | file:PATH[,KIND] | onnx:PATH[,KIND][,WIDTHxHEIGHT]
    height: int,
    width: int,
    image: np.ndarray | None = None,  # [H, W, 3] uint8, the view without the object; what a model looks at
) -> DepthPrior | None:
    """The prior that `spec` names, of the view's size, or None where the scene alone decides.

    A file holds disparity unless it is said to hold depth (0 = no value): .npy, or any picture that OpenCV reads with
    one channel of 8, 16 or 32 bits. It may have another resolution than the view, not another shape. A model is run by
    OpenCV on the view, squeezed to the size that the model declares (else the one given after its path, else 518×518)
    and normalised by ImageNet's mean and deviation; its first output of two long axes is resized back.

    Raises
    ------
    BadInput
        If the provider is unknown or its file cannot be used.
    """
    name, _, rest = spec.partition(":")
    if spec in ("auto", "harmonic", "planar"):
        return None
    if name not in ("file", "onnx"):
        raise BadInput(f"--depth-prior: unknown provider {spec!r}; {USAGE}")
    size = re.search(r",(\d+)x(\d+)$", rest) if name == "onnx" else None
    if size:
        rest = rest[: size.start()]
    path, _, kind = rest.rpartition(",")
    if kind not in KINDS:
        path, kind = rest, "disparity"
    if name == "file":
        values = _from_file(Path(path), height, width)
        if kind != "disparity":
            values = np.where(values == 0, np.nan, values)
    else:
        if image is None:
            raise BadInput("--depth-prior onnx: there is no picture to look at")
        values = _from_model(Path(path), image, (int(size[1]), int(size[2])) if size else None)
    if not np.isfinite(values).any():
        raise BadInput(f"--depth-prior: {path} gives no finite value")
    if values.shape != (height, width):
        values = cv2.resize(values, (width, height), interpolation=cv2.INTER_LINEAR)
    return DepthPrior(values.astype(np.float32), kind)


def relative_disparity(
    prior: DepthPrior,
    disparity: np.ndarray,  # [H, W] 1/z of the scene
    known: np.ndarray,  # [H, W] bool, where that is trusted
) -> np.ndarray:
    """[H, W] float32 disparity of any scale and shift, NaN = no value.

    Metric depth is inverted. Affine depth m has an unknown scale and shift *in depth*, so 1/m would be bent:
    z = a·m + b is fitted to the scene's depth first (relative errors, reweighted by Tukey's biweight), then inverted.
    A fit with a ≤ 0 is none; −m then stands for the disparity, so that the ring shows the prior not to agree.
    """
    m = prior.values
    if prior.kind == "disparity":
        return m
    if prior.kind == "metric":
        return np.divide(1, m, out=np.full_like(m, np.nan), where=m > 0)
    with np.errstate(invalid="ignore"):
        common = known & (disparity > 0) & np.isfinite(disparity) & np.isfinite(m)
    a, b = _affine(m[common].astype(np.float64), disparity[common].astype(np.float64))
    if a <= 0:
        return -m
    z = a * m + b
    nearest = 0.1 / disparity[common].max()  # what the fit sends to or behind the camera has no value
    with np.errstate(invalid="ignore"):
        return np.divide(1, z, out=np.full_like(m, np.nan), where=z > nearest).astype(np.float32)


def _affine(m: np.ndarray, disparity: np.ndarray) -> tuple[float, float]:
    """(a, b) that minimise |(a·m + b)·d − 1| robustly; (0, 0) where that is not determined."""
    if len(m) < 3 or np.ptp(m) <= 1e-6 * np.abs(m).max():
        return 0.0, 0.0
    middle, spread = m.mean(), m.std()
    rows = np.stack([(m - middle) / spread, np.ones_like(m)], -1) * disparity[:, None]
    (a, b), _ = robust_fit(rows, np.ones(len(m)))
    return float(a / spread), float(b - a * middle / spread)


def _from_file(path: Path, height: int, width: int) -> np.ndarray:
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
    if abs(values.shape[1] * height - values.shape[0] * width) > 1.5 * max(values.shape[0], height):
        raise BadInput(
            f"--depth-prior: {path} has {values.shape[1]}×{values.shape[0]} pixels, not the shape of the view "
            f"({width}×{height})"
        )
    return values


def _from_model(path: Path, image: np.ndarray, size: tuple[int, int] | None) -> np.ndarray:
    """[h, w] float32, a network's answer to a picture."""
    model = read_model("--depth-prior onnx", path)
    width, height = declared_size(model) or size or FREE_SIZE
    method = cv2.INTER_AREA if width * height < image.shape[0] * image.shape[1] else cv2.INTER_CUBIC
    squeezed = cv2.resize(image, (width, height), interpolation=method).astype(np.float32) / 255
    outputs = model.run({_looking(model): ((squeezed - IMAGENET_MEAN) / IMAGENET_STD).transpose(2, 0, 1)[None]})
    for output in outputs:
        values = np.squeeze(output)
        if values.ndim == 2 and min(values.shape) > 1:
            return values.astype(np.float32)
    shapes = ", ".join("×".join(map(str, o.shape)) for o in outputs)
    raise BadInput(f"--depth-prior onnx: {path} answers with {shapes}, which is no depth picture")


def declared_size(model: OnnxModel) -> tuple[int, int] | None:
    """(width, height) of the first input of four axes [N, C, H, W], or None if the model takes any."""
    dims = model.inputs.get(_looking(model), ())
    return (dims[3], dims[2]) if len(dims) == 4 and dims[2] * dims[3] else None


def _looking(model: OnnxModel) -> str:
    """The input that takes the picture; a name that no input has lets OpenCV say what is wrong."""
    return next((name for name, dims in model.inputs.items() if len(dims) == 4), next(iter(model.inputs), ""))
