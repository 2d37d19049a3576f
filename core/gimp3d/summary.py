"""A removal in figures and words, as JSON."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from . import __version__
from .gaussians import Gaussians
from .io.ply import SplatFile
from .job import RemovalJob
from .memory import peak_memory_mb
from .presets import RemovalSettings
from .run import RemovalResult


def summary_of(
    job: RemovalJob,
    settings: RemovalSettings,
    file: SplatFile,
    result: RemovalResult,
    warnings: Sequence[str],
    seconds: float,
) -> dict[str, Any]:
    """What `--summary` writes.

    Its keys are an interface: the report, the Blender panel and other people's scripts read them.
    """
    removed, added = int((~result.keep).sum()), len(result.added) if result.added else 0
    return {
        "version": __version__,
        "command": "remove",
        "seconds_total": round(seconds, 3),
        "stages": [asdict(s) for s in result.stages],
        "counts": {
            "gaussians_in": len(file.gaussians),
            "removed": removed,
            "added": added,
            "gaussians_out": len(file.gaussians) - removed + added,
            "lifted": result.lifted,
            "changed": result.changed,
            **_cost(file, result.added),
            "views": result.views,
            "hole_pixels": result.hole_pixels,
            "open_pixels": result.open_pixels,
        },
        "verdict": asdict(result.verdict) if result.verdict else None,
        "selection": result.selection,
        "proposed": result.proposed,
        "shadow": result.shadow,
        "reflection": result.reflection,
        "charts": [
            {
                "kind": chart.kind,
                "texels": int(chart.there.sum()),
                "hole_texels": int(chart.hole.sum()),
                "photos_median": float(np.median(chart.photos[chart.known])) if chart.known.any() else 0.0,
            }
            for chart in result.charts
        ],
        "refined_views": result.refined_views,
        "references": [asdict(choice) for choice in result.references],
        "settings": {"preset": job.preset, "reference": job.reference, **asdict(settings)},
        "warnings": [*warnings, *result.warnings],
        "peak_memory_mb": round(peak_memory_mb(), 1),
    }


def variant_facts(out: Path, result: RemovalResult) -> dict[str, Any]:
    """What the summary says of one of several fills."""
    return {
        "out": str(out),
        "added": len(result.added) if result.added else 0,
        "changed": result.changed,
        "open_pixels": result.open_pixels,
        "score": result.verdict.score if result.verdict else None,
    }


def _cost(file: SplatFile, added: Gaussians | None) -> dict[str, int]:
    """What the new Gaussians need: bytes in the file (binary ones), and how many use which SH degree."""
    if added is None or not len(added):
        return {}
    used = (added.sh != 0).any(2)
    highest = np.ceil(np.sqrt(used.shape[1] - used[:, ::-1].argmax(1))).astype(int) - 1
    degrees = np.where(used.any(1), highest, 0)
    cost = {f"added_of_degree_{d}": int((degrees == d).sum()) for d in range(added.sh_degree + 1)}
    if file.table.format == "ascii":
        return cost
    return {"added_bytes": len(added) * file.table.rows.dtype.itemsize, **cost}
