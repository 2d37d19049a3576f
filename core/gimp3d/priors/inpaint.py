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
from .likeness import HALO, likeness, ring_gain, shift_between
from .onnx import read_model

SURROUNDINGS = 1.0  # margin round the hole's bounding box that textures are taken from, in its side lengths
LEAST_SURROUNDINGS = 32  # px, at least
SPECK = 4  # px; smaller parts of a hole are interpolated
LEAST_COMPARED = 0.02  # share of the view that must be known outside the hole to judge a picture by
GROSS = 64.0  # grey levels; larger differences count as this much, so that a few changed objects do not decide
CLEARLY = 0.9  # a shift is kept if it lowers the residual to this share, and by MARGIN
MARGIN = 0.25  # grey levels
SURE_SHIFT = 1.0  # px, from which it need not lower it so much: photos are found 0.75 px off at most in poor drawings
# A picture is of another view if its details agree by less than FOREIGN with the view's and by no more than so many
# times what chance gives, and its colours differ. On ten scenes, true photos against drawings of poor splats (exposure
# ±30 %, colour cast, noise, JPEG, 5 px off, half the size) agree by 0.53 and more, by 0.41 if the drawing is blurred or
# hazed beyond use; photos less than 14° aside by at most 0.46, others of the scene by 0.31, of other scenes by 0.15.
FOREIGN, FOREIGN_CHANCE = 0.3, 8.0
DOUBTFUL = 0.6  # agreement below which the user is told
SAME_COLOURS = 4.0  # grey levels of mean difference up to which a picture is the view, whatever its details
FREE_SIZE = (512, 512)  # (height, width) for models that take any size
BRIGHTEST = 2.0  # answers up to here are in [0, 1], give or take what networks overshoot
CONFIDENCE_SCALE = 20.0  # grey levels of residual at which the confidence has fallen to 1/e


@dataclass(frozen=True)
class Appearance:
    """The reference without the object."""

    image: np.ndarray  # [H, W, 3] uint8; outside the hole it is the input, bit for bit
    confidence: float
    reason: str
    warnings: tuple[str, ...] = ()


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
    return replace(filled, image=np.where(hole[..., None], filled.image, image))


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
    known: np.ndarray | None = None,  # [H, W] bool, where the view shows what it will without the object; None: outside
) -> Appearance:
    """A given picture, registered to the view (size, shift, levels) and pasted inside the hole only.

    It takes the exposure and white balance of the view round the hole. Shift and levels are applied only if they
    clearly differ: a picture that matches is pasted bit for bit. One that agrees poorly is pasted with a warning.

    Raises
    ------
    BadInput
        If it has another shape or shows something else.
    """
    picture = _resized(picture, hole.shape, name)
    size = 2 * HALO + 1
    outside = cv2.dilate(hole.astype(np.uint8), np.ones((size, size), np.uint8)) == 0
    if known is not None and (outside & known).mean() >= LEAST_COMPARED:
        outside &= known
    if outside.mean() < LEAST_COMPARED:
        pasted = np.where(hole[..., None], picture, image)
        return Appearance(pasted, 0.5, "picture pasted; too little of the view is left to check it by")
    like = likeness(image, picture, outside)
    picture, words = _registered(image, picture, hole, outside)
    residual = _difference(image, picture, outside)
    compared = (
        f"outside the hole it agrees by {like.agreement:.2f} with what is known of the view (1 = the same details, "
        f"{2 * like.chance:.2f} = chance) and differs by {residual:.0f} grey levels on average"
    )
    differs = residual > SAME_COLOURS
    if differs and like.agreement < FOREIGN and like.agreement <= FOREIGN_CHANCE * like.chance:
        raise BadInput(f"{name} does not match the view: {compared}; give a picture of the reference view itself")
    warnings = (f"{name} matches the view poorly: {compared}",) if differs and like.agreement < DOUBTFUL else ()
    words = f"picture pasted {words}, agreement {like.agreement:.2f}, residual {residual:.1f} grey levels"
    confidence = max(0.0, like.agreement) * float(np.exp(-residual / CONFIDENCE_SCALE)) if differs else 1.0
    return Appearance(np.where(hole[..., None], picture, image), confidence, words, warnings)


def _resized(picture: np.ndarray, shape: tuple[int, ...], name: str) -> np.ndarray:
    h, w = shape
    height, width = picture.shape[:2]
    if abs(width * h - height * w) > 1.5 * max(width, height, w, h):  # sizes are rounded to whole pixels
        raise BadInput(f"{name} has {width}×{height} pixels, which is not the shape of the view ({w}×{h})")
    if (height, width) == (h, w):
        return picture
    return _scaled(picture, w, h)


def _registered(image: np.ndarray, picture: np.ndarray, hole: np.ndarray, known: np.ndarray) -> tuple[np.ndarray, str]:
    """The picture at the view's levels, shifted if that clearly fits better, and what was done."""
    dx, dy = shift_between(image, picture, known)
    h, w = known.shape
    moved = cv2.warpAffine(
        picture,
        np.array([[1, 0, dx], [0, 1, dy]]),
        (w, h),
        flags=cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_REPLICATE,
    )
    gains = [ring_gain(image, p, hole, known) for p in (picture, moved)]
    levelled = [_times(p, g) for p, g in zip((picture, moved), gains)]
    residuals = [_difference(image, p, known) for p in levelled]
    clearly = residuals[1] < CLEARLY * residuals[0] - MARGIN
    shifted = int(clearly or (np.hypot(dx, dy) > SURE_SHIFT and residuals[1] < residuals[0]))
    words = [f"shifted by ({-dx:.1f}, {-dy:.1f}) px"] if shifted else []
    if (gains[shifted] != 1).any():
        words.append("with gain " + ", ".join(f"{g:.2f}" for g in gains[shifted]))
    return levelled[shifted], " ".join(words) or "as it is"


def _times(picture: np.ndarray, gain: np.ndarray) -> np.ndarray:
    return picture if (gain == 1).all() else np.clip(np.rint(picture * gain), 0, 255).astype(np.uint8)


def _difference(image: np.ndarray, picture: np.ndarray, where: np.ndarray) -> float:
    """Mean absolute difference in grey levels; gross ones are cut off."""
    difference = np.abs(image[where].astype(np.float32) - picture[where]).mean(-1)
    return float(np.minimum(difference, GROSS).mean())


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
