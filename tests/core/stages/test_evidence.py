"""What photos show of the hidden surface."""

from __future__ import annotations

import numpy as np
from scenes import REGION, cameras, scene, truth

from gimp3d.pipeline import render_bytes
from gimp3d.raster import render
from gimp3d.stages.evidence import gather_evidence
from gimp3d.stages.masks import find_masks


def test_evidence_is_the_true_colour_and_never_the_objects() -> None:
    views = cameras(12)
    masks = find_masks(scene(), REGION, views)
    view = masks.views[0]
    true = render(truth(), view.camera)
    sources = [(v.camera, render_bytes(scene(), v.camera), v.depth_before) for v in masks.views]
    evidence = gather_evidence(view.camera, true.median_depth, view.silhouette, sources, tolerance=0.02)
    assert evidence.seen.any() and not (evidence.seen & ~view.silhouette).any()
    difference = np.abs(evidence.image[evidence.seen].astype(float) - 255 * np.clip(true.rgb[evidence.seen], 0, 1))
    assert np.median(difference) < 4 and np.percentile(difference, 95) < 25
    points = view.camera.unproject(view.camera.pixel_centres(), true.median_depth.astype(float))
    under = (np.abs(points[..., :2]) < 0.2).all(-1) & (true.median_depth > 0)
    assert not evidence.seen[under].any()  # nobody sees under the block
