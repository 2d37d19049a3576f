"""A removal's settings: a preset, what the job's fields say, and single ones of `--set stage.name=value` on top."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any

from .errors import BadInput
from .job import SHADOWS, RemovalJob
from .presets import PRESETS, RemovalSettings
from .schema import within


def job_settings(job: RemovalJob) -> RemovalSettings:
    """The preset's settings with the job's own on top.

    Raises
    ------
    BadInput
        If a key of --set does not exist or its value is of the wrong type.
    """
    if job.preset not in PRESETS:
        raise BadInput(f"--preset: {job.preset!r} is not in this version; use {', '.join(PRESETS)}")
    if not 0 <= job.seed < 1 << 32:
        raise BadInput(f"--seed must be from 0 to {2**32 - 1}, got {job.seed}")
    settings = replace(PRESETS[job.preset], inpaint=job.inpaint, depth_prior=job.depth_prior, random_seed=job.seed)
    masks = replace(settings.masks, grow=job.grow)
    settings = replace(settings, refine_views=job.refine_views or "", masks=masks)
    shadow = shadow_of(job.shadow, job.shadow_masks)
    if settings.shadow == "off" and shadow == "mask":
        raise BadInput(f"--shadow mask: the preset {job.preset} leaves shadows alone; use another preset")
    if settings.shadow != "off":
        settings = replace(settings, shadow=shadow)
    for key, text in job.set.items():
        settings = _with(settings, key.split("."), text, key)
    within(settings, "--set: ")
    return settings


def shadow_of(shadow: str, masks: Path | str | None) -> Any:
    """The setting `shadow`; raises BadInput if masks of a shadow are given without `mask`, or the other way round."""
    if shadow not in SHADOWS:
        raise BadInput(f"--shadow: {shadow!r} is not one of {', '.join(SHADOWS)}")
    if (shadow == "mask") != (masks is not None):
        raise BadInput("--shadow mask and --shadow-masks DIR go together")
    return shadow


def _with(settings: Any, path: Sequence[str], text: str, key: str) -> Any:
    names = [f.name for f in fields(settings)]
    if path[0] not in names:
        raise BadInput(f"--set: no setting {key!r}; {type(settings).__name__} has {', '.join(names)}")
    value = getattr(settings, path[0])
    if is_dataclass(value) and len(path) > 1:
        return replace(settings, **{path[0]: _with(value, path[1:], text, key)})
    if is_dataclass(value) or len(path) > 1:
        raise BadInput(f"--set: {key!r} is not a single setting")
    try:
        new = _parse_like(value, text)
    except ValueError:
        raise BadInput(f"--set: {key} takes a {type(value).__name__}, got {text!r}") from None
    return replace(settings, **{path[0]: new})


def _parse_like(value: Any, text: str) -> Any:
    if isinstance(value, bool):
        if text.lower() not in ("true", "false", "0", "1"):
            raise ValueError(text)
        return text.lower() in ("true", "1")
    if value is None:
        return None if text == "none" else float(text)
    return type(value)(text)
