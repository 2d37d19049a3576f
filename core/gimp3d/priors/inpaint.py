"""Who invents the reference without the object: the table of providers (docs/painters.md).

A provider of this program is a function Unfinished → Appearance, named in `builtin.PROVIDERS`. Whoever paints outside
it is a `Painter`, made by what `PAINTERS` names for its argument after the colon; its pictures are registered and
checked like a file's (docs/developing.md).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from ..errors import BadInput, IllPosed
from ..io.images import read_image
from . import command, gemini, onnx, servers, torchscript
from .appearance import Appearance, Painter, Provider, Unfinished, window_round_hole
from .builtin import PROVIDERS, without_specks
from .calls import Call
from .pasting import paste_picture

__all__ = ["PAINTERS", "PROVIDERS", "Appearance", "check_provider", "inpaint_reference", "painter", "paste_picture"]

PAINTERS: dict[str, Callable[[str, Call], Painter]] = {
    "onnx": onnx.painter,
    "torchscript": torchscript.painter,
    "gemini": gemini.painter,
    "http": lambda rest, call: servers.painter(f"http:{rest}", call),
    "https": lambda rest, call: servers.painter(f"https:{rest}", call),
    "command": command.painter,
}
WITHOUT_ARGUMENT = ("gemini",)  # they may have one
CHOICES = ", ".join(
    [*PROVIDERS, "file:PATH", "onnx:PATH", "torchscript:PATH", "gemini[:MODEL]", "http://HOST:PORT or command:CMD"]
)


def inpaint_reference(
    spec: str,
    image: np.ndarray,  # [H, W, 3] uint8
    hole: np.ndarray,  # [H, W] bool
    seed: int = 0,
    unknown: np.ndarray | None = None,  # [H, W] bool, see Unfinished
    call: Call = Call(),
    variant: int = 0,
) -> Appearance:
    """Fill the hole by the provider that `spec` names.

    Raises
    ------
    BadInput
        If the provider is unknown, or its file, program or server fails.
    IllPosed
        If the hole is the whole image and no picture of it is given.
    """
    provider = _provider(spec, call)
    if not hole.any():
        return Appearance(image.copy(), 1.0, "nothing to fill in the reference")
    if hole.all() and not spec.startswith("file:"):
        raise IllPosed("appearance: the hole covers the whole reference; give a picture of it or choose another view")
    filled = provider(Unfinished(image, hole, seed, unknown, variant))
    return replace(filled, image=np.where(hole[..., None], filled.image, image))


def check_provider(spec: str, call: Call = Call()) -> str:
    """What a user has to know before the provider is asked; raises BadInput now if `inpaint_reference` would later."""
    if spec in PROVIDERS or spec.startswith("file:"):
        return ""
    return painter(spec, call).notice


def painter(spec: str, call: Call = Call()) -> Painter:
    """Who paints outside this program.

    Raises
    ------
    BadInput
        If there is no such painter, or it is known already that it cannot work.
    """
    name, _, argument = spec.partition(":")
    if name in PAINTERS and (argument or spec in WITHOUT_ARGUMENT):
        return PAINTERS[name](argument, call)
    raise BadInput(f"{call.option}: unknown provider {spec!r}; use {CHOICES}")


def _provider(spec: str, call: Call) -> Provider:
    if spec in PROVIDERS:
        return lambda view: without_specks(PROVIDERS[spec], view)
    name, _, argument = spec.partition(":")
    if name == "file" and argument:
        return lambda view: paste_picture(view.image, view.hole, read_image(argument), argument)
    who = painter(spec, call)
    return lambda view: _painted(who, view, call)


def _painted(who: Painter, view: Unfinished, call: Call) -> Appearance:
    """The hole's surroundings, or the whole view, as a painter shows them without the object."""
    part = (slice(None), slice(None)) if who.whole else window_round_hole(view.hole)
    image, hole = view.image[part], view.hole[part]
    unknown = np.zeros_like(hole) if view.unknown is None else view.unknown[part] & ~hole
    if who.notice:
        call.tell(who.notice)
    # what is not known means nothing to the painter either
    picture = who.paint(image, hole | unknown, view.seed + view.variant, call)
    done = paste_picture(image, hole, picture, who.answer, ~unknown)
    whole = view.image.copy()
    whole[part] = done.image
    return replace(done, image=whole)
