"""Undoing a shadow: photos and Gaussians as they would look with the light that the object kept from them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from ..compute.threads import parallel_map
from ..gaussians import Gaussians
from ..geometry import Window, dilated, window_round
from ..srgb import encoded, linear
from .charts.find import TOLERANCE
from .charts.hits import Hits, first_hits, pictured
from .ground import Ground
from .recolour import recoloured
from .reflection import VISIBLE, Reflection
from .shadow import MIXED, UNTOUCHED, Shadow
from .witness import Witness

STRIDE = 4  # px between those that are asked first
EVEN = 0.02  # share of light up to which their neighbours are as they are
DARKEST = 0.3  # share of light below which a photo holds too little texture to be lifted: it is filled
BRIGHTER = (
    8.0  # grey levels by which lifted ground may be brighter than lit ground is: else less light is missing there
)
PATCH = 9  # px in which a photo and the ground are compared
ALIKE = 20.0  # grey levels by which they may differ
UNRELIABLE = 0.1  # share of the ground that is drawn clearly nearer than it is, from which depths tell nothing


@dataclass(frozen=True)
class Lifted:
    """A scene and its photos without the object's shadow."""

    before: tuple[np.ndarray, ...]  # [H, W, 3] uint8, the witnesses' photos …
    photos: tuple[np.ndarray, ...]  # [H, W, 3] uint8, … and how they are lifted
    light: tuple[np.ndarray, ...]  # [H, W] uint8, of 255: the share of light that arrives in them
    shaded: tuple[np.ndarray, ...]  # [H, W] bool, what changed in them
    dark: tuple[np.ndarray, ...]  # [H, W] bool, what is too dark to be lifted, or would be too bright: it is filled
    rows: np.ndarray  # [M] of the scene whose colours changed
    sh: np.ndarray  # [M, K, 3] their new ones
    confidence: float
    reason: str

    def after(self, first: Lifted) -> Lifted:
        """Both, one after the other; this one's scene is the first one's."""
        rows = np.union1d(first.rows, self.rows)
        sh = np.zeros((len(rows), *self.sh.shape[1:]), np.float32)
        sh[np.searchsorted(rows, first.rows)] = first.sh
        sh[np.searchsorted(rows, self.rows)] = self.sh
        light = tuple(np.minimum(a, b) for a, b in zip(first.light, self.light))
        shaded = tuple(a | b for a, b in zip(first.shaded, self.shaded))
        confidence, words = min(first.confidence, self.confidence), f"{first.reason}; {self.reason}"
        return replace(
            self, before=first.before, light=light, shaded=shaded, rows=rows, sh=sh, confidence=confidence, reason=words
        )

    def scene(self, scene: Gaussians) -> Gaussians:
        """The scene with the new colours."""
        sh = scene.sh.copy()
        sh[self.rows] = self.sh
        return replace(scene, sh=sh)


def lift_shadow(
    scene: Gaussians,
    removed: np.ndarray,  # [N] bool, the object
    shadow: Shadow,
    witnesses: Sequence[Witness],
) -> Lifted:
    """Divide linear light by the share of it that arrives, in photos and in the Gaussians that they show in shadow."""
    arriving = parallel_map(lambda w: light_in(shadow, w), witnesses)
    photos, shaded, dark, light = zip(*parallel_map(lambda p: _lifted(*p), list(zip(witnesses, arriving))))
    clear = [s & ~d for s, d in zip(shaded, dark)]
    rows, sh = recoloured(scene, removed, witnesses, photos, shaded, clear, 0)
    share = np.mean([s.mean() for s in shaded])
    words = f"{share:.1%} of the views' pixels and {len(rows)} Gaussians lie in its shadow"
    before = tuple(w.photo for w in witnesses)
    return Lifted(before, photos, light, shaded, dark, rows, sh, shadow.confidence, words)


@dataclass(frozen=True)
class Arriving:
    """The light in a part of a view; all of it arrives in the rest."""

    window: Window
    light: np.ndarray  # [h, w, 3] float32, the share of light that arrives at what is shown
    ground: np.ndarray  # [h, w] bool, where that is ground
    brightest: float  # grey level of ground that is not in the shadow


def _grey(light: np.ndarray) -> np.ndarray:
    """[H, W] the mean over channels."""
    return cv2.transform(light, np.full((1, 3), 1 / 3))


def _lifted(witness: Witness, arriving: Arriving) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """A photo without the shadow, what changed in it, what cannot be lifted, and the light of 255."""
    photo, light = witness.photo.copy(), np.full(witness.hidden.shape, 255, np.uint8)
    shaded, dark = np.zeros((2, *light.shape), bool)
    part, window = witness.cropped(arriving.window), arriving.window
    grey = _grey(arriving.light)
    light[window] = np.rint(grey * 255)
    shaded[window] = (grey < UNTOUCHED) & ~part.hidden
    dark[window] = shaded[window] & (grey < np.where(_mixed(part), MIXED, DARKEST))
    inside = shaded[window]
    bright = encoded(linear(part.photo[inside]) / np.maximum(arriving.light[inside], DARKEST))
    photo[shaded] = np.clip(np.rint(bright * 255), 0, 255)
    too_bright = np.zeros(inside.shape, np.uint8)
    too_bright[inside] = 255 * bright.max(-1) > arriving.brightest + BRIGHTER
    too_bright &= arriving.ground
    dark[window] |= cv2.morphologyEx(too_bright, cv2.MORPH_OPEN, np.ones((3, 3))) > 0  # single pixels are grain
    return photo, shaded, dark, light


def light_in(shadow: Shadow, witness: Witness) -> Arriving:
    """The share of light that arrives at what a view shows; all where it shows nothing.

    Where the photo looks as the others show the ground there, it is the ground, whatever the drawn depth: splats'
    depths are rough. What is drawn before it, and looks otherwise, stands on it.
    """
    uv, z = witness.camera.project(shadow.reach)
    whole = slice(0, witness.camera.height), slice(0, witness.camera.width)
    window = window_round(uv, witness.camera, 2 * STRIDE) if (z > 0).all() else whole
    witness = witness.cropped(window)
    camera, depth = witness.camera, witness.depth
    hits = first_hits(shadow.grounds, camera, depth > 0)
    on = np.where(_shows(witness, shadow.grounds, hits), hits.chart, -1).astype(int)
    below = (on < 0) & (hits.depth > 0) & (depth > (1 + TOLERANCE) * hits.depth)  # drawn where nothing can be seen
    depth = np.where(below | (witness.hidden & (on < 0)), 0, np.where(on >= 0, hits.depth, depth))
    points = camera.unproject(camera.pixel_centres(), depth.astype(np.float64))
    out = np.ones((*depth.shape, 3), np.float32)

    def ask(rows: np.ndarray, cols: np.ndarray) -> None:
        for number in np.unique(on[rows, cols]):
            of = (on[rows, cols] == number) & (depth[rows, cols] > 0)
            r, c = rows[of], cols[of]
            out[r, c] = shadow.arriving(points[r, c], number)

    h, w = depth.shape
    some_rows, some_cols = np.unique([*range(0, h, STRIDE), h - 1]), np.unique([*range(0, w, STRIDE), w - 1])
    grid = np.ix_(some_rows, some_cols)
    ask(*(i.ravel() for i in np.broadcast_arrays(*grid)))
    few = out[grid]
    if few.min() > UNTOUCHED:
        return Arriving(window, np.ones_like(out), on >= 0, 255.0)
    kernel = np.ones((3, 3), np.uint8)
    dim = _grey(few)
    uneven = cv2.dilate(dim, kernel) - cv2.erode(dim, kernel) > EVEN
    numbers = on[grid].astype(np.float32)
    uneven |= (cv2.dilate(numbers, kernel) != cv2.erode(numbers, kernel)) & (cv2.erode(dim, kernel) < UNTOUCHED)
    y, x = (
        np.interp(np.arange(n), some, np.arange(len(some))).astype(np.float32)
        for n, some in ((h, some_rows), (w, some_cols))
    )
    x, y = np.meshgrid(x, y)
    out = np.ascontiguousarray(cv2.remap(few, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))
    ask(*np.nonzero(cv2.remap(uneven.astype(np.uint8), x, y, cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE)))
    lit = (on >= 0) & ~witness.hidden & (_grey(out) >= UNTOUCHED)
    brightest = float(np.percentile(witness.photo[lit].max(-1), 99.9)) if lit.any() else 255.0
    return Arriving(window, out, on >= 0, brightest)


def _shows(witness: Witness, grounds: Sequence[Ground], hits: Hits) -> np.ndarray:
    """[H, W] bool: the photo shows the ground that its rays meet."""
    expected, known, hole = pictured(grounds, hits)
    weight = known.astype(np.float32)
    off = cv2.absdiff(expected, witness.photo).max(-1) * weight
    off = cv2.boxFilter(off, -1, (PATCH, PATCH)) / np.maximum(cv2.boxFilter(weight, -1, (PATCH, PATCH)), 1e-3)
    before = hits.behind(witness.depth, TOLERANCE)
    proven = known & (off < ALIKE) & (hits.depth > 0)
    rough = proven.any() and before[proven].mean() > UNRELIABLE  # what is drawn before it says nothing here
    is_it = np.where(known, proven, ~before | (hole & (rough | _mixed(witness)))) & (hits.depth > 0)
    return cv2.medianBlur(is_it.astype(np.uint8), PATCH) > 0  # highlights are specks


def _mixed(witness: Witness) -> np.ndarray:
    """[H, W] bool: right beside the object, where colours and depths may be the object's own."""
    return dilated(witness.hidden | witness.beside, 2)


def bare_photos(
    reflection: Reflection, witnesses: Sequence[Witness]
) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Of each view: the photo without the mirror image's light, what changed in it, and of 255 how little."""

    def of(witness: Witness) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        added = reflection.added(witness.camera)
        changed = (np.abs(added).max(-1) > VISIBLE) & ~witness.hidden
        hits = first_hits(reflection.grounds, witness.camera, changed)
        before = hits.behind(witness.depth, TOLERANCE)
        changed &= (hits.chart == 0) & ~before
        photo, light = witness.photo.copy(), np.full(changed.shape, 255, np.uint8)
        bare = linear(photo[changed]) - added[changed]
        photo[changed] = np.clip(np.rint(encoded(np.maximum(bare, 0)) * 255), 0, 255)
        light[changed] = np.clip(255 - 255 * np.abs(added[changed]).max(-1), 0, 255)
        return photo, changed, light

    return parallel_map(of, witnesses)


def subtract_reflection(
    scene: Gaussians,
    removed: np.ndarray,  # [N] bool, the object
    reflection: Reflection,
    witnesses: Sequence[Witness],
) -> Lifted:
    """Take the mirror image's light out of photos and out of the Gaussians that they show there.

    Trained splats hold reflections in what lies below the surface, in how its colours change with the view, or both:
    all of their SH are corrected.
    """
    photos, changed, light = zip(*bare_photos(reflection, witnesses))
    rows, sh = recoloured(scene, removed, witnesses, photos, changed, changed, scene.sh_degree)
    dark = tuple(np.zeros_like(c) for c in changed)
    before = tuple(w.photo for w in witnesses)
    share = np.mean([c.mean() for c in changed])
    words = f"{share:.1%} of the views' pixels and {len(rows)} Gaussians show its reflection"
    return Lifted(before, photos, light, changed, dark, rows, sh, reflection.confidence, words)
