"""Undoing a shadow or a reflection: photos and Gaussians as they would look in the light without the object."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import cv2
import numpy as np

from ..compute.threads import parallel_map
from ..gaussians import SH_C0, Gaussians, sh_basis
from ..geometry import Window, dilated, directions, window_round
from ..raster import PixelRegion, label_weights, pixel_region
from ..srgb import encoded, linear
from .charts.find import TOLERANCE
from .charts.plane import Hits, first_hits, pictured
from .ground import Ground
from .reflection import VISIBLE, Reflection
from .seed import missing_colours
from .shadow import MIXED, UNTOUCHED, Shadow
from .witness import Witness

STRIDE = 4  # px between those that are asked first
EVEN = 0.02  # share of light up to which their neighbours are as they are
DARKEST = 0.3  # share of light below which a photo holds too little texture to be lifted: it is filled
BRIGHTEST = 0.999  # share of lit ground that is no brighter: the rest is glints
BRIGHTER = 8.0  # grey levels by which lifted ground may be brighter than lit: else less light is missing there
PATCH = 9  # px in which a photo and the ground are compared
ALIKE = 20.0  # grey levels by which they may differ
UNRELIABLE = 0.1  # share of the ground that is drawn clearly nearer than it is, from which depths tell nothing
LOOKS = 12  # views by which colours are corrected
CORRECTIONS, HOLD = 10, 0.03  # steps of least squares, and px of blend weight by which the old colours are held
SHOWN = 0.5  # px of blend weight by which photos show a Gaussian

Undone = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]  # of a view: see Lifted.photos, shaded, dark, light


@dataclass(frozen=True)
class Lifted:
    """A scene and its photos without the object's shadow."""

    before: tuple[np.ndarray, ...]  # [H, W, 3] uint8, the witnesses' photos …
    photos: tuple[np.ndarray, ...]  # [H, W, 3] uint8, … and how they are lifted
    light: tuple[np.ndarray, ...]  # [H, W] uint8, of 255: the share of light that arrives in them
    shaded: tuple[np.ndarray, ...]  # [H, W] bool, what changed in them
    dark: tuple[np.ndarray, ...]  # [H, W] bool, what is too dark to be lifted, or would be too bright: it is filled
    rows: np.ndarray  # [M] of the scene whose colours changed
    gaussians: Gaussians  # [M], with their new ones
    confidence: float
    reason: str


def lift(
    scene: Gaussians,
    removed: np.ndarray,  # [N] bool, the object
    witnesses: Sequence[Witness],
    reflection: Reflection | str | None,  # words, or None: there is none
    shadows: Sequence[Shadow] = (),  # one after the other; one of all at least
) -> Lifted:
    """Subtract the reflection's light, then divide by the shares of light that arrive: in photos, and in the Gaussians
    that they show there.

    Trained splats hold reflections in what lies below the surface, in how its colours change with the view, or both:
    all of their SH are corrected.
    """
    steps: list[tuple[float, Callable[[Sequence[Witness]], list[Undone]], int, str]] = []
    if isinstance(reflection, Reflection):
        bare = partial(bare_photos, reflection)
        steps.append((reflection.confidence, bare, scene.sh_degree, "show its reflection"))
    for shadow in shadows:
        steps.append((shadow.confidence, partial(lifted_photos, shadow), 0, "lie in its shadow"))
    before, sh, rows, words = tuple(w.photo for w in witnesses), scene.sh.copy(), np.zeros(0, int), []
    shaded = tuple(np.zeros_like(w.hidden) for w in witnesses)
    light = tuple(np.full(s.shape, 255, np.uint8) for s in shaded)
    for _, undone, degree, how in steps:
        photos, changed, dark, left = zip(*undone(witnesses))
        clear = [c & ~d for c, d in zip(changed, dark)]
        new, colours = recoloured(replace(scene, sh=sh), removed, witnesses, photos, changed, clear, degree)
        sh[new] = colours
        rows, witnesses = np.union1d(rows, new), [replace(w, photo=p) for w, p in zip(witnesses, photos)]
        light, shaded = tuple(map(np.minimum, light, left)), tuple(map(np.logical_or, shaded, changed))
        words.append(f"{np.mean([c.mean() for c in changed]):.1%} of the views' pixels and {len(new)} Gaussians {how}")
    confidence = min(step[0] for step in steps)
    lit = replace(scene.take(rows), sh=sh[rows])
    return Lifted(before, photos, light, shaded, dark, rows, lit, confidence, "; ".join(words))


def lifted_photos(shadow: Shadow, witnesses: Sequence[Witness]) -> list[Undone]:
    """Of each view: the photo without the shadow.

    How bright lit ground is, all views tell: one may show of a white line nothing but what lies in the shade.
    """
    arriving = parallel_map(lambda w: light_in(shadow, w), witnesses)
    levels = np.cumsum(sum(a.lit for a in arriving))
    brightest = int(np.searchsorted(levels, BRIGHTEST * levels[-1])) if levels[-1] else 255
    return parallel_map(lambda of: _lifted(*of, brightest), zip(witnesses, arriving))


@dataclass(frozen=True)
class Arriving:
    """The light in a part of a view; all of it arrives in the rest."""

    window: Window
    light: np.ndarray  # [h, w, 3] float32, the share of light that arrives at what is shown
    ground: np.ndarray  # [h, w] bool, where that is ground
    lit: np.ndarray  # [256] int64, pixels of ground that is not in the shadow by their brightest channel's level


def _grey(light: np.ndarray) -> np.ndarray:
    """[H, W] the mean over channels."""
    return cv2.transform(light, np.full((1, 3), 1 / 3))


def _lifted(witness: Witness, arriving: Arriving, brightest: int) -> Undone:
    """A photo without the shadow, where ground is no brighter than so many grey levels."""
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
    too_bright[inside] = 255 * bright.max(-1) > brightest + BRIGHTER
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

    some = [np.unique([*range(0, n, STRIDE), n - 1]) for n in depth.shape]
    grid = np.ix_(*some)
    ask(*(i.ravel() for i in np.broadcast_arrays(*grid)))
    few = out[grid]
    if few.min() > UNTOUCHED:
        return Arriving(window, np.ones_like(out), on >= 0, np.zeros(256, int))
    kernel, dim = np.ones((3, 3), np.uint8), _grey(few)
    steps, borders = (cv2.morphologyEx(a, cv2.MORPH_GRADIENT, kernel) for a in (dim, on[grid].astype(np.float32)))
    uneven = (steps > EVEN) | ((borders > 0) & (cv2.erode(dim, kernel) < UNTOUCHED))
    between = [np.interp(np.arange(n), s, np.arange(len(s))).astype(np.float32) for n, s in zip(depth.shape, some)]
    y, x = np.meshgrid(*between, indexing="ij")
    out = np.ascontiguousarray(cv2.remap(few, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))
    ask(*np.nonzero(cv2.remap(uneven.astype(np.uint8), x, y, cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE)))
    lit = (on >= 0) & ~witness.hidden & (_grey(out) >= UNTOUCHED)
    return Arriving(window, out, on >= 0, np.bincount(witness.photo[lit].max(-1), minlength=256))


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


def bare_photos(reflection: Reflection, witnesses: Sequence[Witness]) -> list[Undone]:
    """Of each view: the photo without the mirror image's light."""

    def of(witness: Witness) -> Undone:
        added = reflection.added(witness.camera)
        changed = (np.abs(added).max(-1) > VISIBLE) & ~witness.hidden
        hits = first_hits(reflection.grounds, witness.camera, changed)
        changed &= (hits.chart == 0) & ~hits.behind(witness.depth, TOLERANCE)
        photo, light = witness.photo.copy(), np.full(changed.shape, 255, np.uint8)
        bare = linear(photo[changed]) - added[changed]
        photo[changed] = np.clip(np.rint(encoded(np.maximum(bare, 0)) * 255), 0, 255)
        light[changed] = np.clip(255 - 255 * np.abs(added[changed]).max(-1), 0, 255)
        return photo, changed, np.zeros_like(changed), light

    return parallel_map(of, witnesses)


def recoloured(
    scene: Gaussians,
    removed: np.ndarray,  # [N] bool
    witnesses: Sequence[Witness],
    photos: Sequence[np.ndarray],  # as they would be
    changed: Sequence[np.ndarray],  # [H, W] bool, where they are not as they were
    clear: Sequence[np.ndarray],  # [H, W] bool, … and can be believed, but beside the object
    degree: int,  # of the SH that are corrected
    may: np.ndarray | None = None,  # [N] bool, rows that may change; None: all
) -> tuple[np.ndarray, np.ndarray]:
    """Rows [M] of what shows in changed pixels, and colours [M, K, 3] by which the scene, drawn, shows the new photos.

    Least squares (SIRT) over the views that show most of the change; held where photos stay as they are.
    """
    stays = np.flatnonzero(~removed)
    kept = scene.take(stays)
    looks = sorted(range(len(changed)), key=lambda k: -int(changed[k].sum()))[:LOOKS]
    looks = [k for k in looks if changed[k].any()]

    def shown(k: int) -> np.ndarray:
        labels = np.where(witnesses[k].hidden, 0, 1 + changed[k]).astype(np.uint8)
        return label_weights(kept, witnesses[k].camera, labels, 2)

    weights = np.array(parallel_map(shown, looks)).reshape(-1, 2, len(kept))
    rows = np.flatnonzero((weights[:, 1].sum(0) > SHOWN) & (may is None or may[stays]))
    if not len(rows):
        return stays[rows], scene.sh[stays[rows]]
    others = np.ones(len(kept), bool)
    others[rows] = False
    rest, lit, bands = kept.take(others), kept.take(rows), (degree + 1) ** 2

    def prepared(k: int) -> tuple[PixelRegion, np.ndarray, np.ndarray]:
        mask = clear[k] & ~witnesses[k].beside
        return pixel_region(rest, witnesses[k].camera, mask, passes=frozenset({"rgb"})), mask, photos[k]

    ready, means = parallel_map(prepared, looks), lit.means.astype(np.float64)
    bases = [sh_basis(directions(means, witnesses[k].camera), degree) / SH_C0 for k in looks]
    change, now = np.zeros((len(rows), bands, 3)), lit
    for _ in range(CORRECTIONS):
        bends = np.tile(HOLD * np.eye(bands), (len(rows), 3, 1, 1))  # a channel that is clamped at 0 has no weight
        slopes = np.zeros((len(rows), 3, bands))
        asked = [(region, now, mask, photo) for region, mask, photo in ready]
        steps = parallel_map(lambda a: missing_colours(*a), asked)
        for (weight, missing), basis, steady in zip(steps, bases, weights[:, 0, rows]):
            bends += (weight + steady[:, None])[..., None, None] * (basis[:, :, None] * basis[:, None])[:, None]
            here = missing + weight * np.einsum("mk,mkc->mc", basis, change)
            slopes += here[..., None] * basis[:, None]
        change = np.linalg.solve(bends, slopes[..., None])[..., 0].transpose(0, 2, 1)
        sh = lit.sh.copy()
        sh[:, :bands] += change
        now = replace(lit, sh=sh)
    return stays[rows], now.sh
