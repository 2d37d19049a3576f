"""ONNX models: run by ONNX Runtime where it is installed, else by OpenCV, with the same answers."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from onnx_files import Shape, combined, field, model, pixelwise, varint
from pictures import disc, holed, inner, refuse, scenery

from gimp3d.errors import BadInput
from gimp3d.priors.inpaint import inpaint_reference
from gimp3d.priors.networks import onnx_runtime, read_onnx


@pytest.fixture(params=["OpenCV", "ONNX Runtime"])
def runner(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """Who runs models in this test."""
    if request.param == "OpenCV":
        monkeypatch.setitem(sys.modules, "onnxruntime", None)
    else:
        pytest.importorskip("onnxruntime", reason="the optional extra onnx is not installed")
    return str(request.param)


# A network that paints what the mask marks in one colour
PAINT = np.array([[0.8], [0.2], [0.1]])


def painter(order: tuple[str, str] = ("image", "mask"), size: Shape = ("h", "w"), scale: float = 1) -> bytes:
    shapes: dict[str, Shape] = {"image": (1, 3, *size), "mask": (1, 1, *size)}
    nodes = [
        pixelwise("image", "kept", scale * np.eye(3)),
        pixelwise("mask", "paint", scale * PAINT),
        combined("Add", ["kept", "paint"], "y"),
    ]
    return model(nodes, {name: shapes[name] for name in order}, (1, 3, *size))


def painter_of_four_channels(size: Shape = ("h", "w")) -> bytes:
    return model([pixelwise("x", "y", np.hstack([np.eye(3), PAINT]))], {"x": (1, 4, *size)}, (1, 3, *size))


@pytest.mark.parametrize(
    "network",
    [
        painter(),
        painter(("mask", "image")),
        painter(size=(96, 128)),
        painter(scale=255),
        painter_of_four_channels(),
        painter_of_four_channels((64, 64)),
    ],
    ids=["any size", "mask first", "fixed size", "0 to 255", "4 channels", "4 channels, fixed"],
)
@pytest.mark.parametrize("asked", ["", ",160x120"])
def test_a_model_paints_the_hole(tmp_path: Path, network: bytes, asked: str, runner: str) -> None:
    (tmp_path / "a, b.onnx").write_bytes(network)
    picture, hole = scenery(), disc()
    done = inpaint_reference(f"onnx:{tmp_path}/a, b.onnx{asked}", holed(picture, hole), hole)
    assert np.abs(done.image[inner(hole)].astype(int) - np.rint(255 * PAINT[:, 0])).max() <= 2
    assert (done.image[~hole] == picture[~hole]).all()


def test_models_that_cannot_paint_are_refused(tmp_path: Path, capfd: pytest.CaptureFixture[str], runner: str) -> None:
    path = tmp_path / "m.onnx"
    no_mask = model([pixelwise("x", "y", np.eye(3))], {"x": (1, 3, 64, 64)}, (1, 3, 64, 64))
    one_channel = model([pixelwise("x", "y", np.ones((1, 4)))], {"x": (1, 4, 64, 64)}, (1, 1, 64, 64))
    inverted = model([pixelwise("x", "y", -np.eye(3, 4))], {"x": (1, 4, 64, 64)}, (1, 3, 64, 64))
    unknown = model([pixelwise("x", "y", np.eye(3, 4), "NoSuchThing")], {"x": (1, 4, 64, 64)}, (1, 3, 64, 64))
    cases = {
        "cannot read": None,
        "not an ONNX model": b"nothing at all, only words",
        "picture of 3 channels and a mask of 1": no_mask,
        "no finite picture": one_channel,
        "does not match the view": inverted,
        f"{runner} cannot run": unknown,
    }
    for words, data in cases.items():
        path.unlink(missing_ok=True)
        if data is not None:
            path.write_bytes(data)
        refuse(words, f"onnx:{path}", scenery(), disc())
    assert capfd.readouterr().err == ""


def test_who_runs_models_is_onnx_runtime_if_it_is_there(monkeypatch: pytest.MonkeyPatch) -> None:
    there = type(sys)("onnxruntime")
    monkeypatch.setitem(sys.modules, "onnxruntime", there)
    assert onnx_runtime() is there
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    assert onnx_runtime() is None


# Files with sizes that make no sense


@pytest.mark.parametrize("asked", ["0x0", "0x64", "64x0", "8193x64", "99999999999999999999x1"])
def test_sizes_that_no_picture_has_are_refused(tmp_path: Path, asked: str) -> None:
    (tmp_path / "m.onnx").write_bytes(painter())
    refuse(f"{asked} is no size for a picture", f"onnx:{tmp_path}/m.onnx,{asked}", scenery(), disc())


@pytest.mark.parametrize("size", [(1 << 20, 64), (64, 1 << 62), (8193, 8193)])
def test_models_that_declare_sizes_that_no_picture_has_are_refused(tmp_path: Path, size: tuple[int, int]) -> None:
    (tmp_path / "m.onnx").write_bytes(painter_of_four_channels(size))
    words = f"m.onnx takes {size[1]}×{size[0]} pixels, which is no size for a picture"
    refuse(words, f"onnx:{tmp_path}/m.onnx", scenery(), disc())


@pytest.mark.parametrize("channels", [0, 1 << 40, (1 << 64) - 1])
def test_models_with_absurd_channels_are_refused(tmp_path: Path, channels: int) -> None:
    data = model([pixelwise("x", "y", np.eye(3, 4))], {"x": (1, channels, 64, 64)}, (1, 3, 64, 64))
    (tmp_path / "m.onnx").write_bytes(data)
    refuse("it must take a picture of 3 channels", f"onnx:{tmp_path}/m.onnx", scenery(), disc())


def test_a_negative_length_means_any(tmp_path: Path) -> None:
    minus_one = (1 << 64) - 1  # as protocol buffers write it
    (tmp_path / "m.onnx").write_bytes(painter_of_four_channels((minus_one, minus_one)))
    found = read_onnx("--inpaint onnx", tmp_path / "m.onnx")
    assert found.inputs == {"x": (1, 4, 0, 0)} and found.size is None


@pytest.mark.parametrize("data", [b"\xff" * 4000, field(7, b"\x80" * 4000), varint(7 << 3 | 2) + b"\xff" * 9 + b"\x01"])
def test_numbers_without_an_end_are_refused(tmp_path: Path, data: bytes) -> None:
    (tmp_path / "m.onnx").write_bytes(data)
    with pytest.raises(BadInput, match="not an ONNX model"):
        read_onnx("--inpaint onnx", tmp_path / "m.onnx")
