"""Networks in files that paint or tell depth: what they expect, what they are fed, and what their answers mean.

ONNX models are run by ONNX Runtime where it is installed, else by OpenCV. What one takes is read from its file, by the
protocol buffers at the end: OpenCV does not say it, and ONNX Runtime, 28 MB for every platform and Python, only after
it has loaded the weights. Sizes that make no sense are refused at once. TorchScript models are run by torch on the CPU:
such a file is code, and torch runs what it says.
"""

from __future__ import annotations

import importlib.util
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from ..compute.threads import thread_count
from ..errors import BadInput, one_line, refusing
from .calls import Call, Painter, waited
from .pasting import scaled

BRIGHTEST = 2.0  # answers up to here are in [0, 1], give or take what networks overshoot
LONGEST = 8192  # px of a side that a model may declare or be asked for: more is a damaged file or a slip
IMAGENET_MEAN = np.array([0.485, 0.456, 0.406], np.float32)  # of RGB in [0, 1], as published models were trained
IMAGENET_STD = np.array([0.229, 0.224, 0.225], np.float32)
FREE_SIZE = (512, 512)  # (width, height) for models that take any size
LONGEST_VARINT = 10  # bytes; protocol buffers have no longer numbers
QUIET = 4  # ONNX Runtime's log level that tells fatal errors only: the others come as exceptions too
MULTIPLE = 8  # px; LaMa's encoder halves a picture three times
LONGEST_SIDE = 1280  # px; larger pictures are reduced: LaMa loses its grip, and a laptop its memory
Size = tuple[int, int]  # width, height


def onnx_painter(argument: str, call: Call) -> Painter:
    """A network that paints: PATH[,WIDTHxHEIGHT] of an ONNX file; raises BadInput if it is no such model.

    It takes a picture of 3 channels and a mask of 1 (LaMa), or both as 4 channels: RGB in [0, 1] with the hole black,
    1 = fill; it answers with RGB in [0, 1] or [0, 255]. Of the size that it declares, else the one given, else 512².
    """
    who = f"{call.option} onnx"
    name, size = path_and_size(argument, who)
    model = read_onnx(who, Path(name))
    channels = [dims[1] for dims in model.inputs.values() if len(dims) == 4]
    if sorted(channels) not in ([1, 3], [4]):
        takes = ", ".join(f"{name} {times(dims)}" for name, dims in model.inputs.items())
        raise BadInput(
            f"{model.who} takes {takes}; it must take a picture of 3 channels and a mask of 1, or 4 channels"
        )
    width, height = model.size or size or FREE_SIZE

    def paint(image: np.ndarray, mask: np.ndarray, seed: int, call: Call) -> np.ndarray:
        picture, hole = with_black_hole(image, mask, width, height)
        parts = {3: picture, 1: hole[..., None], 4: np.dstack([picture, hole])}
        blobs = [parts[n].transpose(2, 0, 1)[None] for n in channels]
        answers = waited(model.path.name, lambda: model.run(*blobs), call)
        return scaled(as_picture(answers, model.who), *mask.shape[::-1])  # it was squeezed, whatever the size

    return Painter(model.path.name, paint, f"the picture that {model.path} painted")


def torch_painter(argument: str, call: Call) -> Painter:
    """A network that paints as LaMa's file big-lama.pt does; raises BadInput if there is no such file, or no torch.

    It takes a picture [1, 3, H, W] of RGB in [0, 1] and a mask [1, 1, H, W] of 0 and 1 = fill, H and W multiples of 8
    (mirrored beyond the border, as IOPaint and simple-lama do), and answers with [1, 3, H, W] in [0, 1].
    """
    model = read_torch(f"{call.option} torchscript", Path(argument))

    def paint(image: np.ndarray, mask: np.ndarray, seed: int, call: Call) -> np.ndarray:
        h, w = mask.shape
        factor = min(1.0, LONGEST_SIDE / max(h, w))
        width, height = max(1, round(factor * w)), max(1, round(factor * h))
        more = ((0, -height % MULTIPLE), (0, -width % MULTIPLE), (0, 0))
        picture, hole = with_black_hole(image, mask, width, height)
        blobs = [np.pad(p, more, mode="symmetric").transpose(2, 0, 1)[None] for p in (picture, hole[..., None])]
        answer = as_picture(waited(model.path.name, lambda: model.run(*blobs), call), model.who)
        if answer.shape[:2] != blobs[0].shape[2:]:
            sizes = (times(a[::-1]) for a in (answer.shape[:2], blobs[0].shape[2:]))
            raise BadInput("{} answers with {} pixels to a picture of {}".format(model.who, *sizes))
        return scaled(answer[:height, :width], w, h)

    return Painter(model.path.name, paint, f"the picture that {model.path} painted")


def look(model: OnnxModel | TorchModel, size: Size, image: np.ndarray, call: Call) -> np.ndarray:
    """The depth picture [h, w] float32 that a network makes of a view [H, W, 3] uint8, squeezed to `size`.

    It is the first of its answers that has two long axes.
    """
    squeezed = scaled(image, *size).astype(np.float32) / 255
    blob = ((squeezed - IMAGENET_MEAN) / IMAGENET_STD).transpose(2, 0, 1)[None]
    answers = waited(model.path.name, lambda: model.run(blob), call, lambda: "looks at the view")
    for values in map(np.squeeze, answers):
        if values.ndim == 2 and min(values.shape) > 1:
            return values.astype(np.float32)
    raise BadInput(f"{model.who} answers with {', '.join(times(a.shape) for a in answers)}, which is no depth picture")


def path_and_size(argument: str, who: str) -> tuple[str, Size | None]:
    """PATH[,WIDTHxHEIGHT] taken apart; raises BadInput if the size is none that a picture can have."""
    found = re.search(r",(\d+)x(\d+)$", argument)
    if not found:
        return argument, None
    size = int(found[1]), int(found[2])
    check_size(size, f"{who}: {found[0][1:]}")
    return argument[: found.start()], size


def check_size(size: Size, what: str) -> None:
    """Raise BadInput if it is no size for a picture; `what` says whose it is."""
    if not all(0 < side <= LONGEST for side in size):
        raise BadInput(f"{what} is no size for a picture: sides are from 1 to {LONGEST} pixels")


def with_black_hole(
    image: np.ndarray,  # [H, W, 3] uint8
    mask: np.ndarray,  # [H, W] bool
    width: int,
    height: int,
) -> tuple[np.ndarray, np.ndarray]:
    """What networks that paint are fed: the picture [height, width, 3] in [0, 1], 0 in the hole, and the hole, bool."""
    hole = cv2.resize(mask.astype(np.float32), (width, height), interpolation=cv2.INTER_LINEAR) > 0
    return scaled(image, width, height).astype(np.float32) / 255 * ~hole[..., None], hole


def as_picture(answers: Sequence[np.ndarray], who: str) -> np.ndarray:
    """A network's first answer, of [1, 3, H, W] in [0, 1] or [0, 255], as [H, W, 3] uint8."""
    if not answers:
        raise BadInput(f"{who} answers with no picture")
    values = np.squeeze(answers[0])
    if values.ndim != 3 or values.shape[0] != 3 or not np.isfinite(values).all():
        raise BadInput(f"{who} answers with {times(answers[0].shape)}, which is no finite picture")
    if values.max() <= BRIGHTEST:
        values = values * 255
    return np.clip(np.rint(values), 0, 255).astype(np.uint8).transpose(1, 2, 0)


def times(shape: Sequence[int]) -> str:
    return "×".join(map(str, shape))


@dataclass(frozen=True)
class TorchModel:
    """A model file that is there, with a torch that may run it."""

    who: str  # for messages: option and path
    path: Path
    size: Size | None = None  # it takes any

    def run(self, *blobs: np.ndarray) -> tuple[np.ndarray, ...]:
        """The model's outputs to these inputs; raises BadInput if it is no TorchScript model or cannot be run."""
        import torch

        before = torch.get_num_threads()
        torch.set_num_threads(thread_count())
        try:
            model = torch.jit.load(str(self.path), map_location="cpu").eval()
            with torch.no_grad():
                answer: Any = model(*(torch.from_numpy(np.ascontiguousarray(b, np.float32)) for b in blobs))
            answers = list(answer.values()) if isinstance(answer, dict) else answer
            answers = answers if isinstance(answers, (list, tuple)) else (answers,)
            return tuple(a.float().numpy() for a in answers if isinstance(a, torch.Tensor))
        except (RuntimeError, TypeError, ValueError) as error:  # torch's own are RuntimeErrors
            # the last line says what; before it stands where
            *_, reason = str(error).strip().splitlines() or [type(error).__name__]
            words = f"torch cannot run it ({reason[:200]}); it must be a TorchScript model"
            raise BadInput(f"{self.who}: {words}") from None
        finally:
            torch.set_num_threads(before)


def read_torch(option: str, path: Path) -> TorchModel:
    """The model at a path, nothing of it run yet; raises BadInput if there is no such file, or no torch."""
    if not path.is_file():
        raise BadInput(f"{option}: cannot read {path} (no such file)")
    if importlib.util.find_spec("torch") is None:
        raise BadInput(f"{option}: needs PyTorch, which is not installed; pip install 'gimp3d[torch]'")
    return TorchModel(f"{option}: {path}", path)


@dataclass(frozen=True)
class OnnxModel:
    """A model that was read, not yet run."""

    who: str  # for messages: option and path
    path: Path
    data: bytes
    inputs: dict[str, tuple[int, ...]]  # name → axes as declared, 0 = any length

    @property
    def size(self) -> Size | None:
        """Of the picture that it takes, the input of most channels; None: any; BadInput if no picture has that size."""
        pictures = [dims for dims in self.inputs.values() if len(dims) == 4]
        _, _, height, width = max(pictures, key=lambda dims: dims[1], default=(0, 0, 0, 0))
        if not width or not height:
            return None
        check_size((width, height), f"{self.who} takes {width}×{height} pixels, which")
        return width, height

    def run(self, *blobs: np.ndarray) -> tuple[np.ndarray, ...]:
        """The model's outputs to what its inputs of four axes are fed, in order; raises BadInput if it cannot be run.

        If it has no such inputs, whoever runs it says what is wrong with the first one.
        """
        names = [name for name, dims in self.inputs.items() if len(dims) == 4] or [next(iter(self.inputs), "")]
        feeds = {name: np.ascontiguousarray(blob, np.float32) for name, blob in zip(names, blobs)}
        runtime = onnx_runtime()
        failures = Exception if runtime else cv2.error  # ONNX Runtime's have no common base
        try:
            return self._by_runtime(runtime, feeds) if runtime else self._by_opencv(feeds)
        except failures as error:
            reason = one_line(getattr(error, "err", None) or error, 200)
        who, before = ("ONNX Runtime", "") if runtime else ("OpenCV", "install onnxruntime, or ")
        raise BadInput(f"{self.who}: {who} cannot run it ({reason}); {before}export it to a plain ONNX")

    def _by_opencv(self, feeds: Mapping[str, np.ndarray]) -> tuple[np.ndarray, ...]:
        level = cv2.setLogLevel(0)  # silent: its complaints come as exceptions too
        try:
            net = cv2.dnn.readNetFromONNX(np.frombuffer(self.data, np.uint8))
            for name, blob in feeds.items():
                net.setInput(blob, name)
            return tuple(net.forward(net.getUnconnectedOutLayersNames()))
        finally:
            cv2.setLogLevel(level)

    def _by_runtime(self, runtime: Any, feeds: Mapping[str, np.ndarray]) -> tuple[np.ndarray, ...]:
        options = runtime.SessionOptions()
        options.intra_op_num_threads, options.log_severity_level = thread_count(), QUIET
        # from the path, as weights of large models lie in a file beside it
        session = runtime.InferenceSession(str(self.path), options, providers=["CPUExecutionProvider"])
        return tuple(np.asarray(output) for output in session.run(None, dict(feeds)))


def onnx_runtime() -> Any | None:
    """The module onnxruntime, or None where it is not installed."""
    try:
        import onnxruntime
    except ImportError:
        return None
    return onnxruntime


def read_onnx(option: str, path: Path) -> OnnxModel:
    """A model and what it declares of its inputs; raises BadInput if there is no such file or it is no ONNX model."""
    with refusing(f"{option}: cannot read {path}", OSError):
        data = path.read_bytes()
    try:
        return OnnxModel(f"{option}: {path}", path, data, _inputs(data))
    except (IndexError, ValueError):
        raise BadInput(f"{option}: {path} is not an ONNX model") from None


def _inputs(model: bytes) -> dict[str, tuple[int, ...]]:
    """ModelProto.graph (7) .input (11), leaving out initializers (5)."""
    graphs = _messages(memoryview(model), 7)
    if not graphs:
        raise ValueError("no graph")
    constants = {bytes(name) for tensor in _messages(graphs[0], 5) for name in _messages(tensor, 8)}
    found = {}
    for value in _messages(graphs[0], 11):
        name = bytes(_messages(value, 1)[0])
        if name not in constants:
            shapes = [s for t in _messages(value, 2) for tensor in _messages(t, 1) for s in _messages(tensor, 2)]
            dims = [dict(_fields(dim)).get(1, 0) for shape in shapes for dim in _messages(shape, 1)]
            # a negative length, in two's complement, means any as well
            found[name.decode()] = tuple(n if isinstance(n, int) and n < 1 << 63 else 0 for n in dims)
    return found


def _messages(message: memoryview, number: int) -> list[memoryview]:
    """The length-delimited fields of one number."""
    return [value for n, value in _fields(message) if n == number and isinstance(value, memoryview)]


def _fields(message: memoryview) -> Iterator[tuple[int, int | memoryview]]:
    """(field number, value) of a protocol buffer message, in order."""
    at = 0
    while at < len(message):
        key, at = _varint(message, at)
        kind = key & 7
        if kind not in (0, 1, 2, 5):
            raise ValueError(f"wire type {kind}")
        number, at = _varint(message, at) if kind in (0, 2) else (8 if kind == 1 else 4, at)
        if kind == 0:
            yield key >> 3, number
        else:  # so many bytes follow
            yield key >> 3, message[at : at + number]
            at += number
    if at > len(message):
        raise ValueError("cut off")


def _varint(message: memoryview, at: int) -> tuple[int, int]:
    """(value, where it ends): seven bits a byte, the lowest first."""
    value = 0
    for k, byte in enumerate(message[at : at + LONGEST_VARINT]):
        value |= (byte & 127) << 7 * k
        if byte < 128:
            return value, at + k + 1
    raise ValueError("endless number")
