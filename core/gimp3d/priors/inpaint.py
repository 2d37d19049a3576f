"""Who invents the reference without the object: providers of this program, and the table of others (docs/painters.md).

A provider of this program is a `Provider`, named in `PROVIDERS`. Whoever paints outside it, or has painted a file, is a
`Painter`, made by what `PAINTERS` names for its argument after the colon; its pictures are registered and checked
(docs/developing.md).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import cv2
import numpy as np

from ..errors import BadInput, IllPosed
from ..geometry import specks
from ..io.images import read_image
from ..solvers.exemplar import complete_picture
from . import gemini, networks, servers
from .calls import Call, Painter, command_painter
from .pasting import Appearance, interpolated, paste_picture, window_round_hole

__all__ = ["PAINTERS", "PROVIDERS", "Appearance", "check_provider", "inpaint_reference", "painter", "paste_picture"]

PATCHES = (13, 21, 9)  # px, of variants in turn: larger ones continue larger figures, smaller ones fit closer
CONFIDENCE_SCALE = 20.0  # grey levels of misfit at which the confidence has fallen to 1/e


def inpaint_reference(
    spec: str,
    image: np.ndarray,  # [H, W, 3] uint8; what stands in the hole means nothing
    hole: np.ndarray,  # [H, W] bool
    seed: int = 0,  # the same seed gives the same fill
    unknown: np.ndarray | None = None,  # [H, W] bool, pixels that mean nothing either, but are not to be filled
    call: Call = Call(),
    variant: int = 0,  # another fill of the same hole, for people to choose from
) -> Appearance:
    """Fill the hole by the provider that `spec` names.

    Raises BadInput if the provider is unknown, or its file, program or server fails; IllPosed if the hole is the whole
    image and no picture of it is given.
    """
    who = None if spec in PROVIDERS else painter(spec, call)
    if not hole.any():
        return Appearance(image.copy(), 1.0, "nothing to fill in the reference")
    if hole.all() and not spec.startswith("file:"):
        raise IllPosed("appearance: the hole covers the whole reference; give a picture of it or choose another view")
    if who:
        filled = _painted(who, call, image, hole, seed + variant, unknown)
    else:
        filled = without_specks(PROVIDERS[spec], image, hole, seed, unknown, variant)
    return replace(filled, image=np.where(hole[..., None], filled.image, image))


def check_provider(spec: str, call: Call = Call()) -> str:
    """What a user has to know before the provider is asked; raises BadInput now if `inpaint_reference` would later."""
    return "" if spec in PROVIDERS else painter(spec, call).notice


def painter(spec: str, call: Call = Call()) -> Painter:
    """Who paints outside this program; raises BadInput if there is none, or it is known already that it cannot work."""
    name, _, argument = spec.partition(":")
    if name in PAINTERS and (argument or spec == "gemini"):
        return PAINTERS[name](argument, call)
    raise BadInput(f"{call.option}: unknown provider {spec!r}; use {CHOICES}")


def _painted(
    who: Painter, call: Call, image: np.ndarray, hole: np.ndarray, seed: int, unknown: np.ndarray | None
) -> Appearance:
    """The hole's surroundings, or the whole view, as a painter shows them without the object."""
    part = (slice(None), slice(None)) if who.whole else window_round_hole(hole)
    near, mask = image[part], hole[part]
    unknown = np.zeros_like(mask) if unknown is None else unknown[part] & ~mask
    if who.notice:
        call.tell(who.notice)
    picture = who.paint(near, mask | unknown, seed, call)  # what is not known means nothing to the painter either
    done = paste_picture(near, mask, picture, who.answer, ~unknown)
    whole = image.copy()
    whole[part] = done.image
    return replace(done, image=whole)


# image, hole (not empty), seed, unknown, variant of `inpaint_reference` → what it returns outside the hole is dropped
Provider = Callable[[np.ndarray, np.ndarray, int, np.ndarray | None, int], Appearance]


def without_specks(
    provider: Provider, image: np.ndarray, hole: np.ndarray, seed: int, unknown: np.ndarray | None, variant: int
) -> Appearance:
    """Parts of the hole of a few pixels are interpolated; the provider fills the rest."""
    few = specks(hole)
    if few.any():
        image, hole = np.where(few[..., None], interpolated(image, hole), image), hole & ~few
    if not hole.any():
        return Appearance(image, 1.0, "a hole of a few pixels: interpolated")
    return provider(image, hole, seed, unknown, variant)


def exemplar(image: np.ndarray, hole: np.ndarray, seed: int, unknown: np.ndarray | None, variant: int) -> Appearance:
    """Texture of the hole's surroundings, from coarse to fine; what lies far off is seldom the same surface."""
    near = window_round_hole(hole)
    if unknown is not None:
        unknown = unknown[near]
    filled, misfit = complete_picture(image[near], hole[near], PATCHES[variant % len(PATCHES)], seed + variant, unknown)
    if np.isnan(misfit):
        return Appearance(interpolated(image, hole), 0.1, "no patch of the reference lies off the hole: interpolated")
    whole = image.copy()
    whole[near] = filled
    words = f"filled with the view's own texture, which fits to {misfit:.1f} grey levels"
    return Appearance(whole, 0.7 * float(np.exp(-misfit / CONFIDENCE_SCALE)), words)


def _interpolated(name: str, method: int, image: np.ndarray, hole: np.ndarray, *_: Any) -> Appearance:
    return Appearance(interpolated(image, hole, method), 0.3, f"interpolated by {name}")


def _xphoto(
    name: str, method: str, there: int, back: int, image: np.ndarray, hole: np.ndarray, seed: int, *_: Any
) -> Appearance:
    """One of the methods of OpenCV's xphoto, whose mask marks what is known."""
    if not hasattr(cv2, "xphoto"):
        raise BadInput(f"--inpaint {name} needs OpenCV's contrib modules (opencv-contrib-python-headless)")
    colours = cv2.cvtColor(image, there)
    filled = np.zeros_like(colours)
    cv2.setRNGSeed(seed)
    cv2.xphoto.inpaint(colours, (~hole).astype(np.uint8) * 255, filled, getattr(cv2.xphoto, method))
    return Appearance(cv2.cvtColor(filled, back), 0.5, f"filled by {name}")


PROVIDERS: dict[str, Provider] = {
    "exemplar": exemplar,
    "telea": partial(_interpolated, "telea", cv2.INPAINT_TELEA),  # fast marching (Telea 2004)
    "ns": partial(_interpolated, "ns", cv2.INPAINT_NS),  # isophotes continued (Bertalmio 2001)
    # shift maps (Pritch 2009), which compare Lab colours; and frequency-selective reconstruction (Genser 2018)
    "shiftmap": partial(_xphoto, "shiftmap", "INPAINT_SHIFTMAP", cv2.COLOR_RGB2Lab, cv2.COLOR_Lab2RGB),
    "fsr": partial(_xphoto, "fsr", "INPAINT_FSR_FAST", cv2.COLOR_RGB2BGR, cv2.COLOR_BGR2RGB),
}
PAINTERS: dict[str, Callable[[str, Call], Painter]] = {
    "file": lambda path, _: Painter(path, lambda *_: read_image(path), path, whole=True),
    "onnx": networks.onnx_painter,
    "torchscript": networks.torch_painter,
    "gemini": gemini.painter,
    "http": lambda rest, call: servers.painter(f"http:{rest}", call),
    "https": lambda rest, call: servers.painter(f"https:{rest}", call),
    "command": command_painter,
}
CHOICES = ", ".join(
    [*PROVIDERS, "file:PATH", "onnx:PATH", "torchscript:PATH", "gemini[:MODEL]", "http://HOST:PORT or command:CMD"]
)
