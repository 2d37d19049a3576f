"""Which texels of a chart show the object rather than the surface: by the colours of both."""

from __future__ import annotations

import cv2
import numpy as np

GRAIN = 4.0  # grey levels, σ by which colours of one kind differ at least
LEAST_SHARE = 0.3  # of the object in a colour that shows it: its edges are mixed with the surface
SAMPLES = 128  # colours of each kind, squared, that the two models are made of


def shows_object(
    picture: np.ndarray,  # [H, W, 3] uint8
    doubtful: np.ndarray,  # [H, W] bool, texels that may show either; all others show the surface
    presumed: np.ndarray,  # [H, W] bool, those that show the object as far as is known without colours
    object_colours: np.ndarray,  # [N, 3] uint8
    surface_colours: np.ndarray,  # [M, 3] uint8
) -> np.ndarray:
    """[H, W] bool: doubtful texels that look like the object; the presumed ones where there is nothing to compare.

    Two Gaussian mixtures and a minimum cut along edges of the picture (GrabCut: Rother 2004). The models stay as they
    are learned from what is certain: in the doubtful texels either kind may be missing. The object's is of its colours
    mixed with the surface's, as its edges are.
    """
    if not doubtful.any() or not len(object_colours) or not len(surface_colours):
        return doubtful & presumed
    rng = np.random.default_rng(0)
    shown, surface = (
        c[rng.integers(0, len(c), (SAMPLES, SAMPLES))].astype(float) for c in (object_colours, surface_colours)
    )
    share = rng.uniform(LEAST_SHARE, 1, (SAMPLES, SAMPLES, 1))
    drawn = share * shown + (1 - share) * surface, surface
    # a colour without any spread would be a model that nothing else fits, however near
    certain = [np.clip(c + rng.normal(0, GRAIN, c.shape), 0, 255).astype(np.uint8) for c in drawn]
    labels = np.repeat(np.array([cv2.GC_FGD, cv2.GC_BGD], np.uint8), SAMPLES)[:, None].repeat(SAMPLES, 1)
    labels[[0, -1], [0, -1]] = cv2.GC_PR_FGD, cv2.GC_PR_BGD  # it refuses to work where nothing is in doubt
    models = np.zeros((2, 1, 65))
    cv2.setRNGSeed(0)
    cv2.grabCut(np.concatenate(certain), labels, None, models[1], models[0], 1, cv2.GC_INIT_WITH_MASK)
    labels = np.where(doubtful, np.uint8(cv2.GC_PR_FGD), np.uint8(cv2.GC_BGD))
    cv2.grabCut(np.ascontiguousarray(picture), labels, None, models[1], models[0], 1, cv2.GC_EVAL_FREEZE_MODEL)
    return labels == cv2.GC_PR_FGD
