"""ONNX models: what they expect, and what they answer. ONNX Runtime runs them where it is installed, else OpenCV.

What a model takes is read from its file, by the protocol buffers at the end: OpenCV does not say it, and ONNX Runtime,
28 MB for every platform and Python, only after it has loaded the weights. Sizes that make no sense are refused at once.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from ..compute.threads import thread_count
from ..errors import BadInput
from .appearance import Painter
from .calls import Call, one_line, waited
from .networks import as_picture, check_size, path_and_size, times, with_black_hole
from .pasting import scaled

FREE_SIZE = (512, 512)  # (width, height) for models that take any size
LONGEST_VARINT = 70  # bits; protocol buffers have numbers of ten bytes at most
QUIET = 4  # ONNX Runtime's log level that tells fatal errors only: the others come as exceptions too


def painter(argument: str, call: Call) -> Painter:
    """A network that paints: PATH[,WIDTHxHEIGHT] of an ONNX file.

    It takes a picture of 3 channels and a mask of 1 (LaMa), or both as 4 channels: RGB in [0, 1] with the hole black,
    1 = fill; it answers with RGB in [0, 1] or [0, 255]. Of the size that it declares, else the one given, else 512².

    Raises
    ------
    BadInput
        If the file is no such model.
    """
    who = f"{call.option} onnx"
    path, size = path_and_size(argument, who)
    model = read_model(who, path)
    channels = {dims[1]: name for name, dims in model.inputs.items() if len(dims) == 4}
    if sorted(channels) not in ([1, 3], [4]):
        takes = ", ".join(f"{name} {times(dims)}" for name, dims in model.inputs.items())
        raise BadInput(
            f"{who}: {path} takes {takes}; it must take a picture of 3 channels and a mask of 1, or 4 channels"
        )
    width, height = model.size(channels[max(channels)]) or size or FREE_SIZE

    def paint(image: np.ndarray, mask: np.ndarray, seed: int, call: Call) -> np.ndarray:
        picture, hole = with_black_hole(image, mask, width, height)
        parts = {3: picture, 1: hole[..., None], 4: np.dstack([picture, hole])}
        blobs = {name: parts[n].transpose(2, 0, 1)[None] for n, name in channels.items()}
        outputs = waited(path.name, lambda: model.run(blobs), call)
        h, w = mask.shape
        return scaled(as_picture(outputs[0], model.who), w, h)  # it was squeezed, whatever the size

    return Painter(path.name, paint, f"the picture that {path} painted")


@dataclass(frozen=True)
class OnnxModel:
    """A model that was read, not yet run."""

    who: str  # for messages: option and path
    path: Path
    data: bytes
    inputs: dict[str, tuple[int, ...]]  # name → axes as declared, 0 = any length

    def size(self, name: str) -> tuple[int, int] | None:
        """(width, height) of an input of four axes [N, C, H, W], or None if the model takes any.

        Raises
        ------
        BadInput
            If no picture has that size.
        """
        dims = self.inputs.get(name, ())
        if len(dims) != 4 or not dims[2] or not dims[3]:
            return None
        check_size((dims[3], dims[2]), f"{self.who} takes {dims[3]}×{dims[2]} pixels, which")
        return dims[3], dims[2]

    @property
    def picture(self) -> str:
        """The input of four axes, that takes the picture; else any, so that who runs it says what is wrong."""
        return next((name for name, dims in self.inputs.items() if len(dims) == 4), next(iter(self.inputs), ""))

    def look(self, blob: np.ndarray) -> tuple[np.ndarray, ...]:
        """The outputs to a picture [1, 3, H, W]; raises as `run` does."""
        return self.run({self.picture: blob})

    def run(self, blobs: Mapping[str, np.ndarray]) -> tuple[np.ndarray, ...]:
        """The model's outputs to these inputs ([N, C, H, W] float32).

        Raises
        ------
        BadInput
            If it cannot be run.
        """
        feeds = {name: np.ascontiguousarray(blob, np.float32) for name, blob in blobs.items()}
        runtime = onnx_runtime()
        who = "OpenCV" if runtime is None else "ONNX Runtime"
        failures = cv2.error if runtime is None else Exception  # ONNX Runtime's have no common base
        try:
            return self._by_opencv(feeds) if runtime is None else self._by_runtime(runtime, feeds)
        except failures as error:
            reason = getattr(error, "err", None) or str(error)
        advice = "export it to a plain ONNX" if runtime else "install onnxruntime, or export it to a plain ONNX"
        raise BadInput(f"{self.who}: {who} cannot run it ({one_line(reason, 200)}); {advice}")

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


def read_model(option: str, path: Path) -> OnnxModel:
    """Read a model and what it declares of its inputs: OpenCV does not tell.

    Raises
    ------
    BadInput
        If there is no such file or it is not an ONNX model.
    """
    try:
        data = path.read_bytes()
        return OnnxModel(f"{option}: {path}", path, data, _inputs(data))
    except OSError as error:
        raise BadInput(f"{option}: cannot read {path} ({error.strerror})") from None
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
        if kind == 0:
            value, at = _varint(message, at)
            yield key >> 3, value
            continue
        if kind not in (1, 2, 5):
            raise ValueError(f"wire type {kind}")
        length, at = _varint(message, at) if kind == 2 else (8 if kind == 1 else 4, at)
        if at + length > len(message):
            raise ValueError("cut off")
        yield key >> 3, message[at : at + length]
        at += length


def _varint(message: memoryview, at: int) -> tuple[int, int]:
    """(value, where it ends): seven bits a byte, the lowest first."""
    value = shift = 0
    while shift < LONGEST_VARINT:
        value |= (message[at] & 127) << shift
        shift, at = shift + 7, at + 1
        if message[at - 1] < 128:
            return value, at
    raise ValueError("endless number")
