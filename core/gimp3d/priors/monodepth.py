"""Relative depth of the reference from elsewhere: the paper's monocular model, or a file (docs/method.md).

A prior says what its numbers are, since models differ: `disparity` (near is large, any scale and shift: MiDaS, Depth
Anything), `depth` (far is large, any scale and shift: Marigold and other affine-invariant depth) or `metric` (z-depth
up to scale). `relative_disparity` brings all of them to disparity of any scale and shift, which is what s_f takes on.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from tokenize import TokenError

import cv2
import numpy as np

from ..errors import BadInput, refusing
from ..files import require_file
from ..io.images import decoded
from ..solvers.robust import robust_fit
from . import networks
from .calls import Call, ask_command, split_command

KINDS = ("disparity", "depth", "metric")
FREE_SIZE = (518, 518)  # (width, height) for models that take any size: 37 patches of 14 px, as Depth Anything
# what NumPy raises for a file whose header is read as Python is
NO_ARRAY = (EOFError, OSError, OverflowError, SyntaxError, TokenError, TypeError, ValueError)
NETWORKS: dict[str, Callable[[str, Path], networks.OnnxModel | networks.TorchModel]] = {
    "onnx": networks.read_onnx,
    "torchscript": networks.read_torch,
}
USAGE = (
    "use auto, harmonic, planar, file:PATH, onnx:PATH, torchscript:PATH or command:CMD, followed by ,disparity ,depth "
    "or ,metric"
)


@dataclass(frozen=True)
class DepthPrior:
    """Depth of a view up to what `kind` leaves open."""

    values: np.ndarray  # [H, W] float32, NaN = no value
    kind: str = "disparity"  # disparity | depth | metric


def depth_prior(
    spec: str,  # auto | harmonic | planar | (file|onnx|torchscript|command):ARGUMENT[,KIND][,WIDTHxHEIGHT]
    height: int,
    width: int,
    picture: Callable[[], np.ndarray],  # [H, W, 3] uint8, the view without the object; who looks at it asks for it
    call: Call = Call("--depth-prior", "depth"),
) -> DepthPrior | None:
    """The prior that `spec` names, of the view's size, or None where the scene alone decides.

    A file holds disparity unless it is said to hold depth (0 = no value): .npy, or any picture that OpenCV reads with
    one channel of 8, 16 or 32 bits. It may have another resolution than the view, not another shape. A network sees
    the view, squeezed to the size that the model declares (else the one given after its path, else 518×518) and
    normalised by ImageNet's mean and deviation; its first output of two long axes is resized back. A command gets
    {image} and writes such a file: {out}, a PNG, or {npy}.
    Raises BadInput if the provider is unknown or its file, model or program cannot be used.
    """
    provider = depth_provider(spec, call)
    if provider is None:
        return None
    look, kind = provider
    values = look(picture, height, width)
    if not np.isfinite(values).any():
        raise BadInput(f"{call.option}: {spec.partition(':')[2]} gives no finite value")
    return DepthPrior(cv2.resize(values, (width, height), interpolation=cv2.INTER_LINEAR).astype(np.float32), kind)


Look = Callable[[Callable[[], np.ndarray], int, int], np.ndarray]  # (picture, height, width) → [h, w] float32


def depth_provider(spec: str, call: Call) -> tuple[Look, str] | None:
    """Who looks, and what its numbers are; raises what `depth_prior` would for reasons that are not the view's."""
    name, _, rest = spec.partition(":")
    if spec in ("auto", "harmonic", "planar"):
        return None
    if name != "file" and not (rest and name in (*NETWORKS, "command")):
        raise BadInput(f"{call.option}: unknown provider {spec!r}; {USAGE}")
    who, size = f"{call.option} {name}", None
    if name in NETWORKS:
        rest, size = networks.path_and_size(rest, who)
    before, _, kind = rest.rpartition(",")
    if kind not in KINDS:
        before, kind = rest, "disparity"
    if name == "file":
        return lambda _, height, width: _from_file(Path(before), kind, height, width), kind
    if name in NETWORKS:
        model = NETWORKS[name](who, Path(before))
        size = model.size or size or FREE_SIZE
        return lambda picture, *_: networks.look(model, size, picture(), call), kind
    words = split_command(before, call.option, ("{image}", "{out}"), ("{out}", "{npy}"))

    def look(picture: Callable[[], np.ndarray], height: int, width: int) -> np.ndarray:
        wrong, read = "wrote neither {out} nor {npy}", partial(_from_file, kind=kind, height=height, width=width)
        return ask_command(words, {"image": picture()}, ("npy.npy", "out.png"), wrong, call, read)

    return look, kind


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


def _from_file(path: Path, kind: str, height: int, width: int) -> np.ndarray:
    """A file's numbers of that kind, for a view of that shape; NaN where depth is 0."""
    with refusing(f"--depth-prior: cannot read {path}", *NO_ARRAY):
        if path.suffix == ".npy":
            values = np.load(require_file(path), allow_pickle=False)
        else:
            data = require_file(path).read_bytes()
            values = decoded(data, f"--depth-prior: {path}", cv2.IMREAD_ANYDEPTH | cv2.IMREAD_GRAYSCALE)
        values = np.asarray(values, np.float32)
    if values.ndim != 2 or values.size == 0:
        raise BadInput(f"--depth-prior: {path} is not a depth picture of one channel")
    if abs(values.shape[1] * height - values.shape[0] * width) > 1.5 * max(values.shape[0], height):
        size = f"{values.shape[1]}×{values.shape[0]}"
        raise BadInput(f"--depth-prior: {path} has {size} pixels, not the shape of the view ({width}×{height})")
    return values if kind == "disparity" else np.where(values == 0, np.nan, values)
