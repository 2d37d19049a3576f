"""ONNX models run by OpenCV: what they expect, and what they answer."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from ..errors import BadInput


@dataclass(frozen=True)
class OnnxModel:
    """A model that was read, not yet run."""

    option: str  # by which it was given, for messages
    path: Path
    data: bytes
    inputs: dict[str, tuple[int, ...]]  # name → axes as declared, 0 = any length

    def run(self, blobs: Mapping[str, np.ndarray]) -> tuple[np.ndarray, ...]:
        """The model's outputs to these inputs ([N, C, H, W] float32).

        Raises
        ------
        BadInput
            If OpenCV cannot run it.
        """
        level = cv2.setLogLevel(0)  # silent: its complaints come as exceptions too
        try:
            net = cv2.dnn.readNetFromONNX(np.frombuffer(self.data, np.uint8))
            for name, blob in blobs.items():
                net.setInput(np.ascontiguousarray(blob, np.float32), name)
            return tuple(net.forward(net.getUnconnectedOutLayersNames()))
        except cv2.error as error:
            reason = " ".join(str(error.err or error).split())[:200]
            raise BadInput(
                f"{self.option}: OpenCV cannot run {self.path} ({reason}); export it to a plain ONNX"
            ) from None
        finally:
            cv2.setLogLevel(level)


def read_model(option: str, path: Path) -> OnnxModel:
    """Read a model and what it declares of its inputs: OpenCV does not tell.

    Raises
    ------
    BadInput
        If there is no such file or it is not an ONNX model.
    """
    try:
        data = path.read_bytes()
        return OnnxModel(option, path, data, _inputs(data))
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
            found[name.decode()] = tuple(n if isinstance(n, int) else 0 for n in dims)
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
    while True:
        value |= (message[at] & 127) << shift
        shift, at = shift + 7, at + 1
        if message[at - 1] < 128:
            return value, at
