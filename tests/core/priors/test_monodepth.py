"""Depth priors: files, small networks made here, and what their numbers mean."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from onnx_files import model, pixelwise
from stand_ins import depth_model

from gimp3d.errors import BadInput
from gimp3d.priors.calls import Call
from gimp3d.priors.monodepth import DepthPrior, depth_prior, depth_provider, relative_disparity
from gimp3d.priors.networks import IMAGENET_MEAN, IMAGENET_STD, read_onnx


def prior_of(spec, height, width, image=None, call=Call("--depth-prior", "depth")):
    """The prior; who is given no picture must not ask for one, as it may have to be painted first."""

    def picture():
        assert image is not None
        return image

    return depth_prior(spec, height, width, picture, call)


def array_file(header: str) -> bytes:
    """A .npy file whose header says so."""
    return b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header.encode()


def test_the_scene_alone_decides_without_a_file():
    assert all(prior_of(spec, 4, 5) is None for spec in ("auto", "harmonic", "planar"))


# Files


@pytest.mark.parametrize("kind", ["", "disparity", "depth", "metric"])
def test_a_file_is_read_as_what_it_is_said_to_hold(tmp_path, kind):
    values = np.linspace(1, 2, 48, dtype=np.float32).reshape(6, 8)
    path = tmp_path / "a, b.npy"
    np.save(path, values)
    found = prior_of(f"file:{path}{',' if kind else ''}{kind}", 6, 8)
    assert found.kind == (kind or "disparity")
    np.testing.assert_array_equal(found.values, values)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_png_priors_keep_their_depth(tmp_path, dtype):
    values = (np.arange(48).reshape(6, 8) * (np.iinfo(dtype).max // 48)).astype(dtype)
    cv2.imwrite(str(tmp_path / "p.png"), values)
    np.testing.assert_array_equal(prior_of(f"file:{tmp_path}/p.png", 6, 8).values, values)


def test_a_prior_of_another_size_is_resized(tmp_path):
    np.save(tmp_path / "p.npy", np.tile(np.arange(32.0), (24, 1)))
    found = prior_of(f"file:{tmp_path}/p.npy", 48, 64).values
    assert found.shape == (48, 64)
    np.testing.assert_allclose(np.diff(found[10, 2:-2]), 0.5, atol=1e-6)


def test_unusable_priors_are_refused(tmp_path):
    np.save(tmp_path / "colour.npy", np.ones((6, 8, 3)))
    np.save(tmp_path / "text.npy", np.array([["a", "b"]]))
    np.save(tmp_path / "portrait.npy", np.ones((8, 6)))
    np.save(tmp_path / "empty.npy", np.full((6, 8), np.nan))
    np.save(tmp_path / "object.npy", np.array([[None]]), allow_pickle=True)
    (tmp_path / "broken.npy").write_bytes(b"nothing")
    (tmp_path / "broken.png").write_bytes(b"nothing")
    (tmp_path / "zero.png").write_bytes(b"")
    for name in ("colour.npy", "text.npy", "portrait.npy", "empty.npy", "object.npy", "broken.npy", "broken.png",
                 "zero.png", "missing.npy", "missing.exr", ""):  # fmt: skip
        with pytest.raises(BadInput, match="--depth-prior"):
            prior_of(f"file:{tmp_path}/{name}", 6, 8)
    with pytest.raises(BadInput, match="unknown provider 'depht'"):
        prior_of("depht", 6, 8)


# What the numbers mean

Z = 2 + np.add.outer(np.linspace(0, 3, 40), np.sin(np.linspace(0, 6, 60)))
KNOWN = np.ones(Z.shape, bool)
KNOWN[10:25, 20:40] = False


def agreement(found, disparity):
    """Correlation with the true disparity, 1 for any positive scale and shift."""
    return np.corrcoef(found.ravel(), disparity.ravel())[0, 1]


def test_disparity_and_metric_depth_need_no_fit():
    np.testing.assert_array_equal(relative_disparity(DepthPrior(Z.astype(np.float32)), 1 / Z, KNOWN), np.float32(Z))
    values = np.array([[0, 2, np.nan], [-1, 4, np.inf]], np.float32)
    found = relative_disparity(DepthPrior(values, "metric"), np.ones((2, 3)), np.ones((2, 3), bool))
    np.testing.assert_array_equal(found, [[np.nan, 0.5, np.nan], [np.nan, 0.25, 0]])


@pytest.mark.parametrize("scale, shift", [(1.0, 0.0), (0.2, -3.0), (40.0, 500.0)])
def test_affine_depth_is_fitted_in_depth(scale, shift):
    """Inverting it as it is would bend planes; fitted first, it is the scene's own disparity."""
    prior = DepthPrior((scale * Z + shift).astype(np.float32), "depth")
    rng = np.random.default_rng(0)
    scene = 1 / Z * (1 + 0.01 * rng.standard_normal(Z.shape))
    scene[rng.random(Z.shape) < 0.1] *= 3  # outliers
    np.testing.assert_allclose(relative_disparity(prior, scene, KNOWN), 1 / Z, rtol=0.01)


def test_depth_that_runs_the_other_way_disagrees_with_the_scene():
    prior = DepthPrior((10 - Z).astype(np.float32), "depth")
    assert agreement(relative_disparity(prior, 1 / Z, KNOWN), 1 / Z) < -0.8


def test_constant_depth_and_nothing_known_give_no_fit():
    flat = DepthPrior(np.ones(Z.shape, np.float32), "depth")
    assert np.ptp(relative_disparity(flat, 1 / Z, KNOWN)) == 0
    nothing = relative_disparity(DepthPrior(Z.astype(np.float32), "depth"), 1 / Z, np.zeros(Z.shape, bool))
    assert agreement(nothing, 1 / Z) > 0


def test_what_the_fit_sends_behind_the_camera_has_no_value():
    values = Z.astype(np.float32)
    values[15, 30] = -50.0
    found = relative_disparity(DepthPrior(values, "depth"), 1 / Z, KNOWN)
    assert np.isnan(found[15, 30]) and np.isfinite(found[KNOWN]).all()


# Networks


def network(height="h", width="w", weights=(0.2, 0.3, 0.5), operator="Conv", output=("h", "w")):
    """A 1×1 convolution: one channel, a weighted sum of the normalised picture's."""
    return model([pixelwise("x", "y", np.array([weights]), operator)], {"x": (1, 3, height, width)}, (1, 1, *output))


def picture(height, width):
    x, y = np.meshgrid(np.arange(width), np.arange(height))
    waves = [127 + 100 * np.sin(x / 17 + k) * np.cos(y / 13 - k) for k in range(3)]
    return np.stack(waves, -1).astype(np.uint8)


def answer(image, weights=(0.2, 0.3, 0.5)):
    return ((image / 255 - IMAGENET_MEAN) / IMAGENET_STD) @ np.array(weights)


@pytest.mark.parametrize("height, width, given, size", [(48, 64, "", (64, 48)), ("h", "w", ",80x60", (80, 60)),
                                                        ("h", "w", "", (518, 518))])  # fmt: skip
@pytest.mark.parametrize("kind", ["", ",depth"])
def test_a_model_sees_the_normalised_picture_in_its_own_size(tmp_path, height, width, given, size, kind):
    path = tmp_path / "model.onnx"
    path.write_bytes(network(height, width))
    image = picture(90, 120)
    found = prior_of(f"onnx:{path}{kind}{given}", 90, 120, image)
    assert found.kind == (kind[1:] or "disparity") and found.values.shape == (90, 120)
    wanted = answer(image)
    assert np.abs(found.values - wanted)[3:-3, 3:-3].mean() < 0.02 * np.ptp(wanted)
    assert read_onnx("--depth-prior", path).size == (None if height == "h" else size)


def scripted(folder, body):
    """A command that runs a Python script with {image} and where its answer goes."""
    path = folder / "depth.py"
    path.write_text(f"import sys, cv2, numpy as np\nimage, out = sys.argv[1:]\n{body}\n", encoding="utf-8")
    return f"command:'{sys.executable}' '{path}' {{image}}"


@pytest.mark.parametrize("provider", ["onnx", "torchscript", "command"])
def test_who_predicts_disparity_guides_the_completion(tmp_path, provider):
    """From the file to the depth: somebody has learned this scene, up to scale and shift, which the ring tells."""
    from gimp3d.stages.depth import complete_depth

    v, u = np.mgrid[:120, :160]
    truth = 0.3 + 0.1 * np.exp(-((u - 86) ** 2 + (v - 66) ** 2) / 300) + 0.05 * np.sin(u / 15)
    image = np.repeat(((truth - 0.2) / 0.3 * 255).round().astype(np.uint8)[..., None], 3, -1)
    if provider == "onnx":
        (tmp_path / "model.onnx").write_bytes(network(120, 160, (0.0, 1.0, 0.0)))
        spec = f"onnx:{tmp_path}/model.onnx"
    elif provider == "torchscript":
        pytest.importorskip("torch")
        spec = f"torchscript:{depth_model(tmp_path / 'model.pt')},160x120"
    else:
        spec = scripted(tmp_path, "np.save(out, cv2.imread(image)[..., 1] / 7 - 3)") + " {npy}"
    hole = np.hypot(v - 60, u - 80) < 28
    prior = prior_of(spec, 120, 160, image)
    found = complete_depth(np.where(hole, 9, truth), ~hole, hole, prior)
    assert found.reason.startswith("guided")
    assert np.percentile(np.abs(found.depth * truth - 1)[hole], 95) < 0.01


# TorchScript


@pytest.mark.parametrize("kind, given, size", [("", "", (518, 518)), (",depth", ",80x60", (80, 60))])
def test_a_torchscript_model_sees_the_normalised_picture(tmp_path, kind, given, size):
    pytest.importorskip("torch")
    path, image = depth_model(tmp_path / "a, b.pt"), picture(90, 120)
    found = prior_of(f"torchscript:{path}{kind}{given}", 90, 120, image)
    assert found.kind == (kind[1:] or "disparity") and found.values.shape == (90, 120)
    wanted = answer(image, (0, 1, 0))
    assert np.abs(found.values - wanted)[3:-3, 3:-3].mean() < 0.02 * np.ptp(wanted)


def test_torchscript_models_that_cannot_look_are_refused(tmp_path):
    torch = pytest.importorskip("torch")

    class Means(torch.nn.Module):
        def forward(self, image: torch.Tensor) -> torch.Tensor:
            return image.mean((2, 3))

    torch.jit.script(Means()).save(str(tmp_path / "m.pt"))
    with pytest.raises(BadInput, match=r"--depth-prior torchscript: .* answers with 1×3, which is no depth picture"):
        prior_of(f"torchscript:{tmp_path}/m.pt", 30, 40, picture(30, 40))
    with pytest.raises(BadInput, match=r"cannot read .*gone\.pt"):
        depth_provider(f"torchscript:{tmp_path}/gone.pt", Call("--depth-prior"))
    with pytest.raises(BadInput, match="0x5 is no size for a picture"):
        depth_provider(f"torchscript:{tmp_path}/m.pt,0x5", Call("--depth-prior"))


# Commands


@pytest.mark.parametrize(
    "out, write", [("{npy}", "np.save(out, d)"), ("{out}", "cv2.imwrite(out, d.astype(np.uint16))")]
)
def test_a_command_writes_what_a_file_would_hold(tmp_path, out, write):
    image = picture(30, 40)
    body = f"d = cv2.imread(image).astype(np.float32)[..., 0] * 100\nd[0, 0] = 0\n{write}"
    found = prior_of(f"{scripted(tmp_path, body)} {out},metric", 30, 40, image)
    assert found.kind == "metric" and np.isnan(found.values[0, 0])  # 0 = no value, as in a file
    np.testing.assert_array_equal(found.values[1:], image[1:, :, 2] * 100.0)


@pytest.mark.parametrize(
    "name, data",
    [
        ("d.npy", b""),
        ("d.npy", array_file("{'descr': '<f4', 'fortran_order': False, 'shape': (6, 8,)")),  # no end
        ("d.npy", array_file("{'descr': '>08', 'fortran_order': False, 'shape': (6, 8)}")),
        ("d.npy", array_file("{'descr': '<f4', 'fortran_order': False, 'shape': (6, %s)}" % ("9" * 30))),
        ("d.npy", array_file("{\n    'descr': '<f4'\n  }")),
        ("d.png", b""),
        ("d.png", b"\x89PNG\r\n\x1a\n" + b"\x0f" * 60),
    ],
)
def test_files_that_hold_no_depths_are_told_in_one_line(name: str, data: bytes, tmp_path: Path) -> None:
    """Found by make fuzz: NumPy reads headers as Python, and each of these fails there in another way."""
    (tmp_path / name).write_bytes(data)
    with pytest.raises(BadInput) as error:
        prior_of(f"file:{tmp_path / name},depth", 6, 8)
    assert str(error.value).startswith("--depth-prior: ") and "\n" not in str(error.value)


def test_a_pipe_of_depths_is_refused_instead_of_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "d.npy")
    with pytest.raises(BadInput, match="is a pipe"):
        prior_of(f"file:{tmp_path / 'd.npy'},depth", 6, 8)


@pytest.mark.parametrize(
    "body, out, words",
    [
        ("sys.exit('no weights')", "{npy}", "ended with 1: no weights"),
        ("pass", "{npy}", "wrote neither {out} nor {npy}"),
        ("open(out, 'w').write('text')", "{out}", "not a picture"),
        ("np.save(out, np.ones((9, 9, 3)))", "{npy}", "not a depth picture of one channel"),
        ("np.save(out, np.full((30, 40), np.nan))", "{npy}", "gives no finite value"),
        ("np.save(out, np.ones((30, 80)))", "{npy}", "not the shape of the view"),
        ("", "", "does not say where {out} or {npy} goes"),
        ("import time; time.sleep(9)", "{npy}", "was not done after 0.3 s"),
    ],
)
def test_commands_that_fail_are_told(tmp_path, body, out, words):
    with pytest.raises(BadInput) as error:
        call = Call("--depth-prior", "depth", seconds=0.3 if "sleep" in body else 60)
        prior_of(f"{scripted(tmp_path, body)} {out}".strip(), 30, 40, picture(30, 40), call)
    assert words in str(error.value) and "--depth-prior" in str(error.value) and "\n" not in str(error.value)


# Files of networks that make no sense


@pytest.mark.parametrize("given", ["0x0", "0x64", "9000x64"])
def test_sizes_that_no_picture_has_are_refused(tmp_path, given):
    (tmp_path / "m.onnx").write_bytes(network())
    with pytest.raises(BadInput, match=f"--depth-prior onnx: {given} is no size for a picture"):
        prior_of(f"onnx:{tmp_path}/m.onnx,{given}", 30, 40, picture(30, 40))


def test_models_that_declare_sizes_that_no_picture_has_are_refused(tmp_path):
    (tmp_path / "m.onnx").write_bytes(network(1 << 40, 64))
    with pytest.raises(BadInput, match="takes 64×1099511627776 pixels, which is no size for a picture"):
        prior_of(f"onnx:{tmp_path}/m.onnx", 30, 40, picture(30, 40))


def test_unusable_models_are_refused_in_one_line(tmp_path, capfd):
    image, path = picture(30, 40), tmp_path / "m.onnx"
    cases = {
        "cannot read": None,
        "not an ONNX model": b"nothing at all, only words",
        " cannot run ": network(48, 64, operator="NoSuchThing"),
        "which is no depth picture": network(1, 64),
    }
    for words, data in cases.items():
        path.unlink(missing_ok=True)
        if data is not None:
            path.write_bytes(data)
        with pytest.raises(BadInput, match="--depth-prior onnx") as error:
            prior_of(f"onnx:{path}", 30, 40, image)
        assert words in str(error.value) and "\n" not in str(error.value)
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("cut", range(1, 60, 7))
def test_models_cut_short_are_refused(tmp_path, cut):
    (tmp_path / "m.onnx").write_bytes(network(48, 64)[:-cut])
    with pytest.raises(BadInput):
        prior_of(f"onnx:{tmp_path}/m.onnx", 30, 40, picture(30, 40))
