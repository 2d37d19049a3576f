"""Providers of appearance: what the reference looks like without the object (METHOD section 2).

A provider is a function Unfinished → Appearance. To add one: write it and name it in PROVIDERS or, if it takes an
argument after a colon, in PROVIDERS_OF (docs/developing.md).
"""

from __future__ import annotations

import re
import shlex
import subprocess
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from ..errors import BadInput, IllPosed
from ..io.images import read_image, write_png
from ..solvers.exemplar import ExemplarSettings, complete_picture
from ..solvers.patchmatch import nearest_allowed
from ..solvers.surface import tangent_planes
from .onnx import read_model

SURROUNDINGS = 1.0  # margin round the hole's bounding box that textures are taken from, in its side lengths
LEAST_SURROUNDINGS = 32  # px, at least
SPECK = 4  # px; smaller parts of a hole are interpolated
HALO = 4  # px round the hole in which a picture is not compared with the view
LEAST_COMPARED = 0.02  # share of the view that must lie outside the hole to judge a picture by
GROSS = 64.0  # grey levels; larger differences count as this much, so that a few changed objects do not decide
CLEARLY = 0.9  # registration is kept if it lowers the residual to this share, and by MARGIN
MARGIN = 0.25  # grey levels
MAX_SHIFT = 0.02  # of the picture's width; a picture that is off by more is not an edited copy of the view
MAX_GAIN = 2.0
# A picture is of another view if it differs by more than this many grey levels on average and its luminance
# correlates less than this with the view's. Pictures of the same view with noise of 10 grey levels have 8 and
# 0.99, photos from a few steps aside 12 to 30 and 0.1 to 0.85, other scenes over 30 and under 0.4.
FOREIGN_DIFFERENCE = 12.0
FOREIGN_CORRELATION = 0.8
FREE_SIZE = (512, 512)  # (height, width) for models that take any size
BRIGHTEST = 2.0  # answers up to here are in [0, 1], give or take what networks overshoot
CONFIDENCE_SCALE = 20.0  # grey levels of residual at which the confidence has fallen to 1/e


@dataclass(frozen=True)
class Appearance:
    """The reference without the object."""

    image: np.ndarray  # [H, W, 3] uint8; outside the hole it is the input, bit for bit
    confidence: float
    reason: str


@dataclass(frozen=True)
class Unfinished:
    """What a provider is given. It may return anything inside the hole; what it returns outside is ignored."""

    image: np.ndarray  # [H, W, 3] uint8; what stands in the hole means nothing
    hole: np.ndarray  # [H, W] bool, not empty
    seed: int = 0  # the same seed gives the same fill
    disparity: np.ndarray | None = None  # [H, W] float32, 1/z of the surface, in the hole too; 0 = infinity or nothing
    K: np.ndarray | None = None  # [3, 3], known with the disparity
    unknown: np.ndarray | None = None  # [H, W] bool, pixels that mean nothing either, but are not to be filled


Provider = Callable[[Unfinished], Appearance]


def inpaint_reference(
    spec: str,
    image: np.ndarray,  # [H, W, 3] uint8
    hole: np.ndarray,  # [H, W] bool
    seed: int = 0,
    disparity: np.ndarray | None = None,  # [H, W] float32, of the completed surface; None: not known
    K: np.ndarray | None = None,  # [3, 3]
    unknown: np.ndarray | None = None,  # [H, W] bool, see Unfinished
) -> Appearance:
    """Fill the hole by the provider that `spec` names (CONTRACT: Providers).

    The surface guides `exemplar`: textures are copied along it, so that they shrink with distance.

    Raises
    ------
    BadInput
        If the provider is unknown, or its file or command fails.
    IllPosed
        If the hole is the whole image and no picture of it is given.
    """
    provider = _provider(spec)
    if not hole.any():
        return Appearance(image.copy(), 1.0, "nothing to fill in the reference")
    if hole.all() and not spec.startswith("file:"):
        raise IllPosed("appearance: the hole covers the whole reference; give a picture of it or choose another view")
    filled = provider(Unfinished(image, hole, seed, disparity, K, unknown))
    return Appearance(np.where(hole[..., None], filled.image, image), filled.confidence, filled.reason)


def _provider(spec: str) -> Provider:
    name, _, argument = spec.partition(":")
    if spec in PROVIDERS:
        return lambda view: _without_specks(PROVIDERS[spec], view)
    if name in PROVIDERS_OF and argument:
        return lambda view: PROVIDERS_OF[name](argument, view)
    choices = ", ".join([*PROVIDERS, "file:PATH", "onnx:PATH"])
    raise BadInput(f"--inpaint: unknown provider {spec!r}; use {choices} or command:CMD")


def _without_specks(provider: Provider, view: Unfinished) -> Appearance:
    """Parts of the hole of a few pixels are interpolated; the provider fills the rest."""
    image, hole = view.image, view.hole
    _, labels, parts, _ = cv2.connectedComponentsWithStats(hole.astype(np.uint8), connectivity=8)
    specks = hole & (parts[labels, cv2.CC_STAT_AREA] <= SPECK)
    if specks.any():
        rest = hole & ~specks
        image = np.where(specks[..., None], telea(view).image, image)
        if not rest.any():
            return Appearance(image, 1.0, "a hole of a few pixels: interpolated")
        hole = rest
    return provider(replace(view, image=image, hole=hole))


def exemplar(view: Unfinished) -> Appearance:
    """Texture of the hole's surroundings, from coarse to fine; what lies far off is seldom the same surface."""
    near = _surroundings(view.hole)
    surface = None
    if view.disparity is not None and view.K is not None:
        corner = np.array([[0, 0, near[1].start], [0, 0, near[0].start], [0, 0, 0]])
        surface = tangent_planes(view.disparity[near], view.K - corner)
    unknown = None if view.unknown is None else view.unknown[near]
    done = complete_picture(view.image[near], view.hole[near], ExemplarSettings(seed=view.seed), surface, unknown)
    if np.isnan(done.misfit):
        return Appearance(telea(view).image, 0.1, "no patch of the reference lies off the hole: interpolated")
    confidence = 0.7 * float(np.exp(-done.misfit / CONFIDENCE_SCALE))
    whole = view.image.copy()
    whole[near] = done.image
    how = "" if surface is None else ", laid along its surfaces"
    words = f"filled with the view's own texture{how}, which fits to {done.misfit:.1f} grey levels"
    return Appearance(whole, confidence, words)


def _surroundings(hole: np.ndarray) -> tuple[slice, slice]:
    """The hole's bounding box, larger by its own size on every side."""
    spans = []
    for axis in (0, 1):
        there = np.flatnonzero(hole.any(1 - axis))
        low, high = int(there[0]), int(there[-1]) + 1
        margin = max(LEAST_SURROUNDINGS, round(SURROUNDINGS * (high - low)))
        spans.append(slice(max(0, low - margin), high + margin))
    return spans[0], spans[1]


def telea(view: Unfinished) -> Appearance:
    """Fast marching (Telea 2004), OpenCV."""
    return _interpolated(view, "telea", cv2.INPAINT_TELEA)


def navier_stokes(view: Unfinished) -> Appearance:
    """Isophotes continued (Bertalmio 2001), OpenCV."""
    return _interpolated(view, "ns", cv2.INPAINT_NS)


def _interpolated(view: Unfinished, name: str, method: int) -> Appearance:
    """By cv2.inpaint, which looks at a few pixels of the hole at the image's border: they hold the nearest colour."""
    rows, cols = nearest_allowed(~view.hole)
    filled = cv2.inpaint(view.image[rows, cols], view.hole.astype(np.uint8), 3, method)
    return Appearance(filled, 0.3, f"interpolated by {name}")


def shiftmap(view: Unfinished) -> Appearance:
    """Shift maps (Pritch 2009), OpenCV's xphoto, which compares Lab colours."""
    return _xphoto(view, "shiftmap", "INPAINT_SHIFTMAP", cv2.COLOR_RGB2Lab, cv2.COLOR_Lab2RGB)


def fsr(view: Unfinished) -> Appearance:
    """Frequency-selective reconstruction (Genser 2018), OpenCV's xphoto, the fast one."""
    return _xphoto(view, "fsr", "INPAINT_FSR_FAST", cv2.COLOR_RGB2BGR, cv2.COLOR_BGR2RGB)


def _xphoto(view: Unfinished, name: str, method: str, there: int, back: int) -> Appearance:
    """One of xphoto's methods; their mask marks what is known."""
    if not hasattr(cv2, "xphoto"):
        raise BadInput(f"--inpaint {name} needs OpenCV's contrib modules (opencv-contrib-python-headless)")
    colours = cv2.cvtColor(view.image, there)
    filled = np.zeros_like(colours)
    cv2.setRNGSeed(view.seed)
    cv2.xphoto.inpaint(colours, (~view.hole).astype(np.uint8) * 255, filled, getattr(cv2.xphoto, method))
    return Appearance(cv2.cvtColor(filled, back), 0.5, f"filled by {name}")


def run_command(command: str, view: Unfinished) -> Appearance:
    """What a program makes of {image} and {mask} (255 = fill) in {out}; no shell is involved."""
    if "{out}" not in command:
        raise BadInput(
            f"--inpaint command: {command!r} does not say where {{out}} goes; use {{image}} {{mask}} {{out}}"
        )
    try:
        words = shlex.split(command)
    except ValueError as error:
        raise BadInput(f"--inpaint command: cannot read {command!r} ({error})") from None
    with tempfile.TemporaryDirectory(prefix="gimp3d-") as folder:
        paths = {name: Path(folder) / f"{name}.png" for name in ("image", "mask", "out")}
        write_png(paths["image"], view.image)
        write_png(paths["mask"], view.hole)
        for name, path in paths.items():
            words = [word.replace(f"{{{name}}}", str(path)) for word in words]
        try:
            done = subprocess.run(words, capture_output=True, text=True, errors="replace", check=False)
        except OSError as error:
            raise BadInput(f"--inpaint command: cannot start {words[0]} ({error.strerror})") from None
        if done.returncode != 0:
            said = done.stderr.strip().splitlines()[-1:] or ["no message"]
            raise BadInput(f"--inpaint command: {words[0]} ended with {done.returncode}: {said[0][:200]}")
        if not paths["out"].exists():
            raise BadInput(f"--inpaint command: {words[0]} wrote no {{out}} picture")
        return paste_picture(view.image, view.hole, read_image(paths["out"]), f"the picture that {words[0]} wrote")


def run_model(argument: str, view: Unfinished) -> Appearance:
    """What a network makes of the hole's surroundings: PATH[,WIDTHxHEIGHT] of an ONNX file, run by OpenCV.

    It takes a picture of 3 channels and a mask of 1 (LaMa), or both as 4 channels: RGB in [0, 1] with the hole black,
    1 = fill; it answers with RGB in [0, 1] or [0, 255]. What it leaves outside the hole must be the view.
    """
    size = re.search(r",(\d+)x(\d+)$", argument)
    path = Path(argument[: size.start()] if size else argument)
    model = read_model("--inpaint onnx", path)
    channels = {dims[1]: name for name, dims in model.inputs.items() if len(dims) == 4}
    if sorted(channels) not in ([1, 3], [4]):
        takes = ", ".join(f"{name} {'×'.join(map(str, dims))}" for name, dims in model.inputs.items())
        raise BadInput(
            f"--inpaint onnx: {path} takes {takes}; it must take a picture of 3 channels and a mask of 1, or 4 channels"
        )
    declared = model.inputs[channels[max(channels)]][2:]
    height, width = declared if all(declared) else (int(size[2]), int(size[1])) if size else FREE_SIZE
    near = _surroundings(view.hole)
    hole = cv2.resize(view.hole[near].astype(np.float32), (width, height), interpolation=cv2.INTER_LINEAR) > 0
    picture = _scaled(view.image[near], width, height).astype(np.float32) / 255 * ~hole[..., None]
    parts = {3: picture, 1: hole[..., None], 4: np.dstack([picture, hole])}
    outputs = model.run({name: parts[n].transpose(2, 0, 1)[None] for n, name in channels.items()})
    answer = np.squeeze(outputs[0])
    if answer.ndim != 3 or answer.shape[0] != 3 or not np.isfinite(answer).all():
        raise BadInput(
            f"--inpaint onnx: {path} answers with {'×'.join(map(str, outputs[0].shape))}, which is no finite picture"
        )
    if answer.max() <= BRIGHTEST:
        answer = answer * 255
    painted = np.clip(np.rint(answer), 0, 255).astype(np.uint8).transpose(1, 2, 0)
    h, w = view.hole[near].shape
    name = f"the picture that {path} painted"
    done = paste_picture(view.image[near], view.hole[near], _scaled(painted, w, h), name)
    whole = view.image.copy()
    whole[near] = done.image
    return replace(done, image=whole)


def _scaled(picture: np.ndarray, width: int, height: int) -> np.ndarray:
    smaller = width * height < picture.shape[0] * picture.shape[1]
    return cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA if smaller else cv2.INTER_CUBIC)


def paste_picture(
    image: np.ndarray,  # [H, W, 3] uint8, the view
    hole: np.ndarray,  # [H, W] bool
    picture: np.ndarray,  # [H', W', 3] uint8, the view without the object
    name: str = "the picture",
) -> Appearance:
    """A given picture, registered to the view (size, gain, shift) and pasted inside the hole only.

    Gain and shift are applied only if they clearly lower the difference outside the hole: a picture that
    matches is pasted bit for bit.

    Raises
    ------
    BadInput
        If it has another shape or shows something else.
    """
    picture = _resized(picture, hole.shape, name)
    size = 2 * HALO + 1
    outside = cv2.dilate(hole.astype(np.uint8), np.ones((size, size), np.uint8)) == 0
    if outside.mean() < LEAST_COMPARED:
        pasted = np.where(hole[..., None], picture, image)
        return Appearance(pasted, 0.5, "picture pasted; too little of the view is left to check it by")
    picture, residual, words = _registered(image, picture, outside)
    alike = _correlation(image, picture, outside)
    if residual > FOREIGN_DIFFERENCE and alike < FOREIGN_CORRELATION:
        raise BadInput(
            f"{name} does not match the view: outside the hole it differs by {residual:.0f} grey levels on "
            f"average and correlates by {alike:.2f}; give a picture of the reference view itself"
        )
    words = f"picture pasted {words}, residual {residual:.1f} grey levels"
    return Appearance(np.where(hole[..., None], picture, image), float(np.exp(-residual / CONFIDENCE_SCALE)), words)


def _resized(picture: np.ndarray, shape: tuple[int, ...], name: str) -> np.ndarray:
    h, w = shape
    height, width = picture.shape[:2]
    if abs(width * h - height * w) > 1.5 * max(width, height, w, h):  # sizes are rounded to whole pixels
        raise BadInput(f"{name} has {width}×{height} pixels, which is not the shape of the view ({w}×{h})")
    if (height, width) == (h, w):
        return picture
    return _scaled(picture, w, h)


def _registered(image: np.ndarray, picture: np.ndarray, outside: np.ndarray) -> tuple[np.ndarray, float, str]:
    """The picture as it is, re-lit, or shifted and re-lit: the simplest that clearly fits better."""
    best, residual, words = picture, _difference(image, picture, outside), "as it is"
    dx, dy = _shift(image, picture, outside)
    h, w = outside.shape
    moved = cv2.warpAffine(
        picture,
        np.array([[1, 0, dx], [0, 1, dy]]),
        (w, h),
        flags=cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_REPLICATE,
    )
    for candidate, how in ((picture, "with"), (moved, f"shifted by ({-dx:.1f}, {-dy:.1f}) px, with")):
        gain = _gain(image, candidate, outside)
        lit = np.clip(np.rint(candidate * gain), 0, 255).astype(np.uint8)
        left = _difference(image, lit, outside)
        if left < CLEARLY * residual - MARGIN:
            best, residual, words = lit, left, f"{how} gain {gain.mean():.2f}"
    return best, residual, words


def _difference(image: np.ndarray, picture: np.ndarray, where: np.ndarray) -> float:
    """Mean absolute difference in grey levels; gross ones are cut off."""
    difference = np.abs(image[where].astype(np.float32) - picture[where]).mean(-1)
    return float(np.minimum(difference, GROSS).mean())


def _correlation(image: np.ndarray, picture: np.ndarray, where: np.ndarray) -> float:
    """Of the two luminances, blurred against noise; 0 where one of them is constant."""
    a, b = (cv2.GaussianBlur(_grey(p), (0, 0), 2)[where] for p in (image, picture))
    spread = a.std() * b.std()
    return float(((a - a.mean()) * (b - b.mean())).mean() / spread) if spread > 1e-6 else 0.0


def _shift(image: np.ndarray, picture: np.ndarray, outside: np.ndarray) -> tuple[float, float]:
    """(x, y) px where the view's origin lies in the picture, from coarse to fine; 0 if it cannot be told."""
    h, w = outside.shape
    warp = np.eye(2, 3, dtype=np.float32)
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 50, 1e-4)
    for factor in (4, 2, 1):
        if min(h, w) < 32 * factor:
            continue
        size = (w // factor, h // factor)
        view, other = (cv2.resize(_grey(p), size, interpolation=cv2.INTER_AREA) for p in (image, picture))
        mask = cv2.resize(outside.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST)
        warp[:, 2] /= factor
        try:
            warp = cv2.findTransformECC(view, other, warp, cv2.MOTION_TRANSLATION, criteria, mask, 5)[1]
        except cv2.error:  # no texture, or nothing alike
            return 0.0, 0.0
        warp[:, 2] *= factor
    if np.abs(warp[:, 2]).max() > MAX_SHIFT * w:
        return 0.0, 0.0
    return float(warp[0, 2]), float(warp[1, 2])


def _gain(image: np.ndarray, picture: np.ndarray, where: np.ndarray) -> np.ndarray:
    """[3] factor per channel that brings the picture to the view's exposure, from well exposed pixels."""
    gain = np.ones(3)
    for channel in range(3):
        a, b = (p[..., channel][where].astype(np.float32) for p in (image, picture))
        exposed = (a > 16) & (b > 16) & (a < 250) & (b < 250)
        if exposed.any():
            gain[channel] = np.median(a[exposed] / b[exposed])
    return np.clip(gain, 1 / MAX_GAIN, MAX_GAIN)


def _grey(picture: np.ndarray) -> np.ndarray:
    return cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY).astype(np.float32)


PROVIDERS: dict[str, Provider] = {
    "exemplar": exemplar,
    "telea": telea,
    "ns": navier_stokes,
    "shiftmap": shiftmap,
    "fsr": fsr,
}

PROVIDERS_OF: dict[str, Callable[[str, Unfinished], Appearance]] = {  # those that take what follows a colon
    "file": lambda path, view: paste_picture(view.image, view.hole, read_image(path), path),
    "onnx": run_model,
    "command": run_command,
}
