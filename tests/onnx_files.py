"""ONNX files written field by field (protocol buffers), since the package `onnx` is no dependency."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

Shape = Sequence[int | str]


def varint(value: int) -> bytes:
    return bytes([value & 127 | 128 * (value > 127)]) + (varint(value >> 7) if value > 127 else b"")


def field(number: int, value: int | str | bytes) -> bytes:
    if isinstance(value, int):
        return varint(number << 3) + varint(value)
    data = value.encode() if isinstance(value, str) else value
    return varint(number << 3 | 2) + varint(len(data)) + data


def value_info(name: str, shape: Shape) -> bytes:
    dims = b"".join(field(1, field(1, n) if isinstance(n, int) else field(2, n)) for n in shape)
    return field(1, name) + field(2, field(1, field(1, 1) + field(2, dims)))


class Node(NamedTuple):
    """An operator, and its constant if it has one."""

    message: bytes
    constant: tuple[str, np.ndarray] | None = None


def pixelwise(source: str, result: str, weights: np.ndarray, operator: str = "Conv") -> Node:
    """A 1×1 convolution by weights [output channels, input channels]."""
    kernel = field(1, "kernel_shape") + field(20, 7) + field(8, 1) + field(8, 1)
    name = f"{result} weights"
    message = field(1, source) + field(1, name) + field(2, result) + field(4, operator) + field(5, kernel)
    return Node(message, (name, weights[:, :, None, None]))


def combined(operator: str, sources: Sequence[str], result: str) -> Node:
    """An operator of several inputs, pixel by pixel."""
    return Node(b"".join(field(1, s) for s in sources) + field(2, result) + field(4, operator))


def model(nodes: Sequence[Node], inputs: Mapping[str, Shape], output: Shape, result: str = "y") -> bytes:
    """A whole file."""
    graph = b"".join(field(1, node.message) for node in nodes) + field(2, "g")
    for node in nodes:
        if node.constant:
            name, values = node.constant
            tensor = b"".join(field(1, n) for n in values.shape) + field(2, 1) + field(8, name)
            graph += field(5, tensor + field(9, values.astype("<f4").tobytes()))
            graph += field(11, value_info(name, values.shape))
    for name, shape in inputs.items():
        graph += field(11, value_info(name, shape))
    graph += field(12, value_info(result, output))
    return field(1, 8) + field(7, graph) + field(8, field(1, "") + field(2, 13))
