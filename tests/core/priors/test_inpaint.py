"""Providers of appearance: each fills the hole, only the hole, and says clearly when it cannot."""

import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from onnx_files import Shape, combined, model, pixelwise
from property_tests import examples

from gimp3d.errors import BadInput, IllPosed
from gimp3d.io.images import write_png
from gimp3d.priors.inpaint import PROVIDERS, inpaint_reference, paste_picture
from gimp3d.threads import set_thread_count


@pytest.fixture(autouse=True)
def _default_threads() -> Iterator[None]:
    yield
    set_thread_count(None)


def scenery(height: int = 120, width: int = 160, seed: int = 0) -> np.ndarray:
    """Noise of several scales, [H, W, 3] uint8."""
    random = np.random.default_rng(seed)
    layers = [cv2.GaussianBlur(random.normal(size=(height, width, 3)), (0, 0), s) * s for s in (1.5, 4, 12)]
    return np.clip(128 + 70 * sum(layers), 10, 245).astype(np.uint8)


def stripes(height: int = 120, width: int = 160) -> np.ndarray:
    y, x = np.mgrid[:height, :width]
    wave = 128 + 90 * np.sin((x + 0.5 * y) * 0.55)
    return np.dstack([wave, 0.8 * wave, 255 - wave]).astype(np.uint8)


def checks(height: int = 120, width: int = 160) -> np.ndarray:
    y, x = np.mgrid[:height, :width]
    return np.repeat(np.where((x // 8 + y // 8) % 2, 210, 60)[..., None], 3, 2).astype(np.uint8)


def grain(height: int = 120, width: int = 160) -> np.ndarray:
    """Speckle without any larger structure: flat fills show by their lack of contrast."""
    noise = cv2.GaussianBlur(np.random.default_rng(2).normal(size=(height, width)), (0, 0), 1.2)
    return np.repeat(np.clip(128 + 100 * noise, 0, 255)[..., None], 3, 2).astype(np.uint8)


def disc(height: int = 120, width: int = 160, radius: float = 22) -> np.ndarray:
    y, x = np.mgrid[:height, :width]
    return (y - height / 2) ** 2 + (x - width / 2) ** 2 < radius**2


def holed(picture: np.ndarray, hole: np.ndarray) -> np.ndarray:
    return np.where(hole[..., None], np.uint8(255), picture)


def error(filled: np.ndarray, truth: np.ndarray, where: np.ndarray) -> float:
    """Mean absolute difference, grey levels."""
    return float(np.abs(filled[where].astype(float) - truth[where]).mean())


def save(path: Path, picture: np.ndarray) -> str:
    write_png(path, picture)
    return f"file:{path}"


def refuse(message: str, spec: str, image: np.ndarray, hole: np.ndarray) -> None:
    with pytest.raises(BadInput, match=message):
        inpaint_reference(spec, image, hole)


# every provider


@pytest.mark.parametrize("spec", PROVIDERS)
def test_providers_change_the_hole_only_and_repeat_themselves(spec: str) -> None:
    picture, hole = scenery(), disc()
    done = inpaint_reference(spec, holed(picture, hole), hole, seed=3)
    again = inpaint_reference(spec, holed(picture, hole), hole, seed=3)
    assert (done.image[~hole] == picture[~hole]).all()
    assert (done.image == again.image).all()
    assert error(done.image, picture, hole) < 60
    assert 0 < done.confidence < 1 and done.reason


@pytest.mark.parametrize("spec", PROVIDERS)
def test_what_stood_in_the_hole_does_not_matter(spec: str) -> None:
    picture, hole = scenery(), disc()
    black = np.where(hole[..., None], np.uint8(0), picture)
    fills = [inpaint_reference(spec, base, hole).image for base in (black, holed(picture, hole))]
    assert (fills[0] == fills[1]).all()


@pytest.mark.parametrize("spec", PROVIDERS)
@pytest.mark.parametrize("pixels", [1, 3])
def test_specks_are_interpolated(spec: str, pixels: int) -> None:
    picture = cv2.GaussianBlur(scenery(), (0, 0), 3)
    hole = np.zeros(picture.shape[:2], bool)
    hole[50, 60 : 60 + pixels] = True
    assert error(inpaint_reference(spec, holed(picture, hole), hole).image, picture, hole) < 6


@pytest.mark.parametrize("spec", PROVIDERS)
@pytest.mark.parametrize("shape", [(1, 1), (1, 9), (3, 3), (6, 8), (17, 12)])
def test_pictures_smaller_than_a_patch_are_filled(spec: str, shape: tuple[int, int]) -> None:
    picture = scenery(*shape)
    hole = np.zeros(shape, bool)
    hole[: max(1, shape[0] // 2), : max(1, shape[1] // 2)] = True
    if hole.all():
        with pytest.raises(IllPosed):
            inpaint_reference(spec, picture, hole)
    else:
        assert (inpaint_reference(spec, picture, hole).image[~hole] == picture[~hole]).all()


@pytest.mark.parametrize("spec", PROVIDERS)
def test_an_empty_hole_is_a_no_op_and_a_full_one_is_refused(spec: str) -> None:
    picture = scenery()
    none = np.zeros(picture.shape[:2], bool)
    assert (inpaint_reference(spec, picture, none).image == picture).all()
    with pytest.raises(IllPosed, match="whole reference"):
        inpaint_reference(spec, picture, ~none)


@pytest.mark.parametrize("spec", ["", "lama", "exemplar:3", "file", "file:", "command:", "onnx:"])
def test_unknown_providers_are_refused_with_the_choices(spec: str) -> None:
    choices = "exemplar, telea, ns, shiftmap, fsr, file:PATH, onnx:PATH, torchscript:PATH"
    refuse(choices, spec, scenery(), disc())


# exemplar


@pytest.mark.parametrize("make", [stripes, checks])
def test_exemplar_continues_a_pattern_where_interpolation_cannot(make: Callable[[], np.ndarray]) -> None:
    picture, hole = make(), disc()
    own, smooth = (inpaint_reference(s, holed(picture, hole), hole).image for s in ("exemplar", "telea"))
    assert error(own, picture, hole) < 0.35 * error(smooth, picture, hole)


def test_exemplar_keeps_the_contrast_of_the_texture() -> None:
    picture, hole = grain(), disc()
    filled = inpaint_reference("exemplar", holed(picture, hole), hole).image
    inner = cv2.erode(hole.astype(np.uint8), np.ones((9, 9), np.uint8)) > 0
    assert filled[inner].std() > 0.7 * picture[~hole].std()


@pytest.mark.parametrize("guided", [False, True])
def test_exemplar_depends_on_the_seed_and_not_on_the_thread_count(guided: bool) -> None:
    picture, hole = scenery(), disc()
    disparity = np.linspace(0.2, 0.5, 120, dtype=np.float32)[:, None].repeat(160, 1) if guided else None

    def fill(seed: int) -> np.ndarray:
        return inpaint_reference("exemplar", holed(picture, hole), hole, seed, disparity, K).image

    fills = []
    for threads in (1, 2, 4):
        set_thread_count(threads)
        fills.append(fill(1))
    assert (fills[0] == fills[1]).all() and (fills[0] == fills[2]).all()
    assert (fill(2) != fills[0]).any()


def test_exemplar_fills_holes_at_the_border_with_islands_and_in_many_parts() -> None:
    picture = stripes()
    hole = np.zeros(picture.shape[:2], bool)
    hole[:30, :50] = True
    hole[10:14, 20:26] = False  # an island
    hole[60:75, 140:] = hole[100:, 60:63] = True
    filled = inpaint_reference("exemplar", holed(picture, hole), hole).image
    assert error(filled, picture, hole) < 15


def test_exemplar_interpolates_where_only_thin_lines_are_known() -> None:
    picture = np.full((40, 60, 3), 90, np.uint8)
    hole = np.ones((40, 60), bool)
    hole[::8] = False
    filled = inpaint_reference("exemplar", holed(picture, hole), hole)
    assert error(filled.image, picture, hole) < 2


# exemplar, along surfaces

K = np.array([[200.0, 0, 100], [0, 200, 40], [0, 0, 1]])


def floor(height: int = 150, width: int = 200) -> tuple[np.ndarray, np.ndarray]:
    """Tiles on a plane below the camera, and its disparity: they shrink with distance."""
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    disparity = np.maximum((y - K[1, 2]) / K[1, 1], 0)  # 1 under the camera
    with np.errstate(divide="ignore", invalid="ignore"):
        a, b = (x - K[0, 2]) / K[0, 0] / disparity, 1 / disparity
        tiles = np.tanh(4 * np.sin(12 * a + 6 * b) * np.sin(6 * a - 12 * b))
    grey = np.where(disparity > 0.15, 128 + 80 * tiles, 220)
    return np.repeat(grey[..., None], 3, 2).astype(np.uint8), disparity.astype(np.float32)


def test_a_surface_makes_textures_shrink_with_distance() -> None:
    picture, disparity = floor()
    y, x = np.mgrid[:150, :200]
    hole = (x - 100) ** 2 / 1.5 + (y - 115) ** 2 < 22**2
    base = holed(picture, hole)
    flat = inpaint_reference("exemplar", base, hole).image
    guided = inpaint_reference("exemplar", base, hole, disparity=disparity, K=K)
    assert error(guided.image, picture, hole) < 0.4 * error(flat, picture, hole)
    assert "surfaces" in guided.reason


@pytest.mark.parametrize("value", [0.0, np.nan, np.inf, -1.0, 1e-9, 1e9])
def test_surfaces_without_sense_still_give_a_fill(value: float) -> None:
    picture, hole = scenery(), disc()
    disparity = np.full(hole.shape, value, np.float32)
    done = inpaint_reference("exemplar", holed(picture, hole), hole, disparity=disparity, K=K)
    assert (done.image[~hole] == picture[~hole]).all()
    assert error(done.image, picture, hole) < 60


@examples(25)
@given(st.integers(0, 2**31), st.integers(6, 40), st.integers(6, 40), st.booleans(), st.floats(0.02, 0.98))
def test_any_hole_is_filled_with_colours_that_the_picture_may_hold(
    seed: int, height: int, width: int, guided: bool, share: float
) -> None:
    random = np.random.default_rng(seed)
    picture = random.integers(60, 200, (height, width, 3)).astype(np.uint8)
    hole = cv2.GaussianBlur(random.random((height, width)), (0, 0), 1.5)
    hole = hole > np.quantile(hole, share)
    if hole.all():
        hole[0, 0] = False
    disparity = random.uniform(0.1, 1, hole.shape).astype(np.float32) if guided else None
    done = inpaint_reference("exemplar", picture, hole, seed % 7, disparity, K)
    assert (done.image[~hole] == picture[~hole]).all()
    again = inpaint_reference("exemplar", np.where(hole[..., None], np.uint8(3), picture), hole, seed % 7, disparity, K)
    assert (done.image == again.image).all()


@pytest.mark.parametrize("guided", [False, True])
def test_a_constant_picture_stays_constant(guided: bool) -> None:
    picture, hole = np.full((90, 120, 3), (40, 90, 200), np.uint8), disc(90, 120)
    disparity = np.full(hole.shape, 0.5, np.float32) if guided else None
    assert (inpaint_reference("exemplar", holed(picture, hole), hole, disparity=disparity, K=K).image == picture).all()


# onnx: a network that paints what the mask marks in one colour

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
def test_a_model_paints_the_hole(tmp_path: Path, network: bytes, asked: str) -> None:
    (tmp_path / "a, b.onnx").write_bytes(network)
    picture, hole = scenery(), disc()
    done = inpaint_reference(f"onnx:{tmp_path}/a, b.onnx{asked}", holed(picture, hole), hole)
    inner = cv2.erode(hole.astype(np.uint8), np.ones((9, 9), np.uint8)) > 0
    assert np.abs(done.image[inner].astype(int) - np.rint(255 * PAINT[:, 0])).max() <= 2
    assert (done.image[~hole] == picture[~hole]).all()


def test_models_that_cannot_paint_are_refused(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
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
        "OpenCV cannot run": unknown,
    }
    for words, data in cases.items():
        path.unlink(missing_ok=True)
        if data is not None:
            path.write_bytes(data)
        refuse(words, f"onnx:{path}", scenery(), disc())
    assert capfd.readouterr().err == ""


# file


def test_a_matching_picture_is_pasted_bit_for_bit(tmp_path: Path) -> None:
    picture, hole = scenery(), disc()
    done = inpaint_reference(save(tmp_path / "without.png", picture), holed(picture, hole), hole)
    assert (done.image == picture).all()
    assert done.confidence > 0.95


@pytest.mark.parametrize("noise", [2, 10])
def test_a_photo_matches_a_noisy_rendering_of_its_view(noise: float) -> None:
    picture, hole = scenery(), disc()
    shaken = picture + np.random.default_rng(0).normal(0, noise, picture.shape)
    rendering = np.clip(cv2.GaussianBlur(shaken, (0, 0), 0.6), 0, 255).astype(np.uint8)
    done = paste_picture(holed(rendering, hole), hole, picture)
    assert (done.image[hole] == picture[hole]).all()
    assert (done.image[~hole] == rendering[~hole]).all()


def test_objects_that_differ_outside_the_hole_do_not_decide() -> None:
    picture, hole = scenery(), disc()
    view = picture.copy()
    view[90:115, 10:60] = 255
    assert (paste_picture(holed(view, hole), hole, picture).image[hole] == picture[hole]).all()


@pytest.mark.parametrize("shift", [(3, -2), (1.5, 0.75)])
def test_a_shifted_and_relit_picture_is_registered(shift: tuple[float, float]) -> None:
    picture, hole = scenery(240, 320), disc(240, 320, 40)
    matrix = np.array([[1, 0, shift[0]], [0, 1, shift[1]]], np.float64)
    moved = cv2.warpAffine(picture, matrix, (320, 240), flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
    relit = np.clip(moved * [0.85, 0.9, 1.03], 0, 255).astype(np.uint8)
    done = paste_picture(holed(picture, hole), hole, relit)
    assert "shifted" in done.reason
    assert error(done.image, picture, hole) < 2 < error(relit, picture, hole)


@pytest.mark.parametrize("balance", [(0.75, 0.75, 0.75), (1.12, 1.0, 0.88)])
def test_a_picture_takes_the_exposure_and_white_balance_of_the_view_round_the_hole(balance: tuple[float, ...]) -> None:
    """Though the rest of the view is in another light, and is drawn without its details."""
    picture, hole = scenery(240, 320), disc(240, 320, 40)
    lit = np.clip(picture * np.array(balance), 0, 255)
    y, x = np.mgrid[:240, :320]
    near = np.hypot(y - 120, x - 160) < 85
    view = cv2.GaussianBlur(np.where(near[..., None], lit, picture).astype(np.uint8), (0, 0), 2.5)
    done = paste_picture(holed(view, hole), hole, picture)
    assert error(done.image, lit, hole) < 1.5 < error(picture, lit, hole)
    assert "gain" in done.reason and done.warnings == ()


def badly_drawn(picture: np.ndarray) -> np.ndarray:
    """As splats of few views show it: blurred, with haze in patches."""
    haze = cv2.GaussianBlur(np.random.default_rng(7).normal(size=picture.shape), (0, 0), 12) * 600
    return np.clip(0.3 * cv2.GaussianBlur(picture, (0, 0), 4) + 90 + haze, 0, 255).astype(np.uint8)


def test_a_picture_of_a_badly_drawn_view_is_pasted_with_a_warning() -> None:
    picture, hole = scenery(240, 320), disc(240, 320, 40)
    view = holed(badly_drawn(picture), hole)
    done = paste_picture(view, hole, picture, "photo.png")
    (warning,) = done.warnings
    assert warning.startswith("photo.png matches the view poorly: outside the hole it agrees by 0.")
    assert "grey levels" in warning and done.confidence < 0.6
    with pytest.raises(BadInput, match="does not match the view"):
        paste_picture(view, hole, scenery(240, 320, seed=9))


def test_where_the_view_is_not_known_a_picture_is_not_compared() -> None:
    """What stands in the object's place is drawn from splats that it hid."""
    picture, hole = scenery(240, 320), disc(240, 320, 30)
    silhouette = disc(240, 320, 90)
    view = np.where(silhouette[..., None], np.uint8(70), picture)
    with_it = paste_picture(view, hole, picture, known=~silhouette)
    assert (with_it.image[hole] == picture[hole]).all() and with_it.confidence > 0.95
    assert (paste_picture(view, hole, picture).image[hole] != picture[hole]).any()


def test_a_command_may_be_warned_about(tmp_path: Path) -> None:
    """A warning comes through a provider to whoever asked it."""
    picture, hole = scenery(240, 320), disc(240, 320, 40)
    path = tmp_path / "photo.png"
    write_png(path, picture)
    body = f"shutil.copy({str(path)!r}, out)"
    done = inpaint_reference(script(tmp_path, body), holed(badly_drawn(picture), hole), hole)
    assert len(done.warnings) == 1 and "matches the view poorly" in done.warnings[0]


@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_a_picture_of_another_resolution_is_resampled(factor: float) -> None:
    picture, hole = scenery(), disc()
    way = cv2.INTER_AREA if factor < 1 else cv2.INTER_CUBIC
    other = cv2.resize(picture, None, fx=factor, fy=factor, interpolation=way)
    assert error(paste_picture(holed(picture, hole), hole, other).image, picture, hole) < 3


@pytest.mark.parametrize("what", ["another scene", "mirrored", "inverted", "constant"])
def test_a_picture_of_something_else_is_refused(what: str, tmp_path: Path) -> None:
    picture, hole = scenery(), disc()
    other = {
        "another scene": scenery(seed=9),
        "mirrored": picture[:, ::-1],
        "inverted": 255 - picture,
        "constant": np.full_like(picture, 128),
    }[what]
    refuse("does not match the view", save(tmp_path / "other.png", np.ascontiguousarray(other)), picture, hole)


def test_a_picture_of_another_shape_is_refused(tmp_path: Path) -> None:
    refuse("not the shape of the view", save(tmp_path / "wide.png", scenery(120, 200)), scenery(), disc())


def test_a_file_that_is_no_picture_is_refused(tmp_path: Path) -> None:
    (tmp_path / "note.png").write_text("not a picture")
    refuse("not a picture", f"file:{tmp_path / 'note.png'}", scenery(), disc())
    refuse("cannot read", f"file:{tmp_path / 'missing.png'}", scenery(), disc())


def test_a_whole_view_may_be_given_as_a_picture(tmp_path: Path) -> None:
    picture = scenery()
    everywhere = np.ones(picture.shape[:2], bool)
    done = inpaint_reference(save(tmp_path / "all.png", picture), np.zeros_like(picture), everywhere)
    assert (done.image == picture).all()
    assert done.confidence <= 0.5


# command


def script(folder: Path, body: str) -> str:
    """A command that runs a Python script with {image} {mask} {out}."""
    path = folder / "fill.py"
    path.write_text(f"import sys, shutil\nimage, mask, out = sys.argv[1:]\n{body}\n", encoding="utf-8")
    return f"command:'{sys.executable}' '{path}' {{image}} {{mask}} {{out}}"


def test_a_command_fills_the_hole(tmp_path: Path) -> None:
    picture, hole = scenery(), disc()
    body = (
        "import cv2\n"
        "picture, where = cv2.imread(image), cv2.imread(mask, 0)\n"
        "assert set(where.ravel()) == {0, 255}\n"
        "picture[where > 0] = (30, 20, 10)\n"
        "cv2.imwrite(out, picture)"
    )
    done = inpaint_reference(script(tmp_path, body), picture, hole)
    assert (done.image[hole] == (10, 20, 30)).all()
    assert (done.image[~hole] == picture[~hole]).all()


@pytest.mark.parametrize(
    ("body", "message"),
    [
        ("print('no model', file=sys.stderr); sys.exit(3)", "ended with 3: no model"),
        ("pass", "wrote no"),
        ("open(out, 'w').write('text')", "not a picture"),
        ("import cv2; cv2.imwrite(out, cv2.imread(image)[:50])", "not the shape of the view"),
    ],
)
def test_a_command_that_fails_is_reported(tmp_path: Path, body: str, message: str) -> None:
    refuse(message, script(tmp_path, body), scenery(), disc())


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        ("command:no-such-program-here {image} {mask} {out}", "cannot start no-such-program-here"),
        ("command:true {image}", "does not say where"),
        ("command:fill 'unbalanced {out}", "cannot read"),
    ],
)
def test_a_command_that_cannot_run_is_refused(spec: str, message: str) -> None:
    refuse(message, spec, scenery(), disc())


def test_a_command_sees_no_shell(tmp_path: Path) -> None:
    body = "import cv2; cv2.imwrite(out, cv2.imread(image))"
    spec = script(tmp_path, body).replace("{out}", f"{{out}} ; touch {tmp_path / 'escaped'}")
    refuse("ended with 1", spec, scenery(), disc())
    assert not (tmp_path / "escaped").exists()
