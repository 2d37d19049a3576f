"""Providers of appearance that need nothing but this program and OpenCV."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import cv2
import numpy as np

from ..errors import BadInput
from ..solvers.exemplar import complete_picture
from ..solvers.patchmatch import nearest_allowed
from .appearance import Appearance, Provider, Unfinished, window_round_hole

SPECK = 4  # px; smaller parts of a hole are interpolated
PATCHES = (13, 21, 9)  # px, of variants in turn: larger ones continue larger figures, smaller ones fit closer
CONFIDENCE_SCALE = 20.0  # grey levels of misfit at which the confidence has fallen to 1/e


def without_specks(provider: Provider, view: Unfinished) -> Appearance:
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
    near = window_round_hole(view.hole)
    unknown = None if view.unknown is None else view.unknown[near]
    patch = PATCHES[view.variant % len(PATCHES)]
    filled, misfit = complete_picture(view.image[near], view.hole[near], patch, view.seed + view.variant, unknown)
    if np.isnan(misfit):
        return Appearance(telea(view).image, 0.1, "no patch of the reference lies off the hole: interpolated")
    confidence = 0.7 * float(np.exp(-misfit / CONFIDENCE_SCALE))
    whole = view.image.copy()
    whole[near] = filled
    words = f"filled with the view's own texture, which fits to {misfit:.1f} grey levels"
    return Appearance(whole, confidence, words)


def _interpolated(name: str, method: int, view: Unfinished) -> Appearance:
    """By cv2.inpaint, which looks at a few pixels of the hole at the image's border: they hold the nearest colour."""
    rows, cols = nearest_allowed(~view.hole)
    filled = cv2.inpaint(view.image[rows, cols], view.hole.astype(np.uint8), 3, method)
    return Appearance(filled, 0.3, f"interpolated by {name}")


def _xphoto(name: str, method: str, there: int, back: int, view: Unfinished) -> Appearance:
    """One of the methods of OpenCV's xphoto, whose mask marks what is known."""
    if not hasattr(cv2, "xphoto"):
        raise BadInput(f"--inpaint {name} needs OpenCV's contrib modules (opencv-contrib-python-headless)")
    colours = cv2.cvtColor(view.image, there)
    filled = np.zeros_like(colours)
    cv2.setRNGSeed(view.seed)
    cv2.xphoto.inpaint(colours, (~view.hole).astype(np.uint8) * 255, filled, getattr(cv2.xphoto, method))
    return Appearance(cv2.cvtColor(filled, back), 0.5, f"filled by {name}")


telea: Provider = partial(_interpolated, "telea", cv2.INPAINT_TELEA)  # fast marching (Telea 2004)
PROVIDERS: dict[str, Provider] = {
    "exemplar": exemplar,
    "telea": telea,
    "ns": partial(_interpolated, "ns", cv2.INPAINT_NS),  # isophotes continued (Bertalmio 2001)
    # shift maps (Pritch 2009), which compare Lab colours; and frequency-selective reconstruction (Genser 2018)
    "shiftmap": partial(_xphoto, "shiftmap", "INPAINT_SHIFTMAP", cv2.COLOR_RGB2Lab, cv2.COLOR_Lab2RGB),
    "fsr": partial(_xphoto, "fsr", "INPAINT_FSR_FAST", cv2.COLOR_RGB2BGR, cv2.COLOR_BGR2RGB),
}
