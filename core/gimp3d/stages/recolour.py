"""Gaussians in other colours, so that the scene, drawn, shows photos as they were changed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ..compute.threads import parallel_map
from ..gaussians import SH_C0, Gaussians, sh_basis
from ..geometry import directions
from ..raster import label_weights, pixel_region
from .seed import missing_colours
from .witness import Witness

LOOKS = 12  # views by which colours are corrected
CORRECTIONS, HOLD = 10, 0.03  # steps of least squares, and px of blend weight by which the old colours are held
SHOWN = 0.5  # px of blend weight by which photos show a Gaussian


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
    masks = [clear[k] & ~witnesses[k].beside for k in looks]
    cameras = [witnesses[k].camera for k in looks]
    passes = frozenset({"rgb"})
    regions = parallel_map(lambda p: pixel_region(rest, *p, passes=passes), list(zip(cameras, masks)))
    bases = [sh_basis(directions(lit.means.astype(np.float64), c), degree) / SH_C0 for c in cameras]
    change, now = np.zeros((len(rows), bands, 3)), lit
    for _ in range(CORRECTIONS):
        asked = [(region, now, mask, photos[k]) for region, mask, k in zip(regions, masks, looks)]
        bends = np.tile(HOLD * np.eye(bands), (len(rows), 3, 1, 1))  # a channel that is clamped at 0 has no weight
        slopes = np.zeros((len(rows), 3, bands))
        for (weight, missing), basis, steady in zip(
            parallel_map(lambda of: missing_colours(*of), asked), bases, weights[:, 0, rows]
        ):
            bends += (weight + steady[:, None])[..., None, None] * (basis[:, :, None] * basis[:, None])[:, None]
            here = missing + weight * np.einsum("mk,mkc->mc", basis, change)
            slopes += here[..., None] * basis[:, None]
        change = np.linalg.solve(bends, slopes[..., None])[..., 0].transpose(0, 2, 1)
        sh = lit.sh.copy()
        sh[:, :bands] += change
        now = replace(lit, sh=sh)
    return stays[rows], now.sh
