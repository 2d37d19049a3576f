"""Every stage's settings: presets (how much work, and the paper as it is), and on top what a job and its --set say."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from pathlib import Path
from typing import Any, Literal

from .errors import BadInput
from .job import SHADOWS, RemovalJob
from .schema import Seed, Share, Variant, within
from .stages.charts import ChartSettings
from .stages.clearing import ClearingSettings
from .stages.depth import DepthSettings
from .stages.masks import MaskSettings
from .stages.propagate import PropagateSettings
from .stages.propagate.paper import MappingSettings
from .stages.refine import RefineSettings
from .stages.seed import SeedSettings
from .stages.selection import SelectionSettings


@dataclass(frozen=True)
class RemovalSettings:
    """Every stage's settings, and the providers of what no view shows."""

    views: int = 64  # number; of views that the program uses at most, far from each other; 0: all
    masks: MaskSettings = MaskSettings()
    charts: ChartSettings | None = ChartSettings()  # None: photos are the only references (paper)
    clearing: ClearingSettings = ClearingSettings()
    depth: DepthSettings = DepthSettings()
    mapping: MappingSettings = MappingSettings()
    propagate: PropagateSettings = PropagateSettings()
    seed: SeedSettings = SeedSettings()
    refine: RefineSettings = RefineSettings()
    inpaint: str = "exemplar"  # provider; who paints what no photo shows
    depth_prior: str = "auto"  # provider; where the depth behind the object comes from
    shadow: Literal["auto", "off", "mask"] = "auto"  # look for the object's shadow, leave it, or undo the marked one
    extra_references: int = 3  # views; completed after the first one and the charts, where these do not reach
    extra_gain: Share = 0.01  # share of the hole; that must still be open for an extra reference
    random_seed: Seed = 0  # number; another one gives another texture
    variant: Variant = 0  # number; another one fills with another brush
    refine_views: str = ""  # provider; who is asked to refine painted views beside their reference, empty: nobody
    painter_seconds: float = 600.0  # s; that a painter or model outside this program may take for one picture
    prompt: str = ""  # words; what stands behind the object, for painters that read


PRESETS: dict[str, RemovalSettings] = {
    "draft": RemovalSettings(extra_references=1, extra_gain=0.02),
    "balanced": RemovalSettings(refine=RefineSettings(steps=100)),
    "best": RemovalSettings(refine=RefineSettings(steps=400), extra_references=4, extra_gain=0.005),
    "paper": RemovalSettings(
        views=0,
        masks=MaskSettings(mode="paper", selection=SelectionSettings(by_centre=True)),
        charts=None,
        depth=DepthSettings(surface="harmonic", scale_factor=0.1),
        propagate=PropagateSettings(transfer="sample", blend="rim"),
        seed=SeedSettings(largest=1, corrections=0, sh_degree=3),
        refine=RefineSettings(steps=3000, patience=120),
        shadow="off",
        extra_references=0,
    ),
}
# The paper as it is printed: the signs of the guidance (told only with a depth prior) and of the visibility, the patch
# cost without p, SH that are not anchored and lack 3DGS's 0.5. Of several levels, the finest first gives no field.
_PAPER = PRESETS["paper"]
PRESETS["paper-literal"] = replace(
    _PAPER,
    depth=replace(_PAPER.depth, scale_factor=-0.1),
    mapping=replace(_PAPER.mapping, visibility=-_PAPER.mapping.visibility, as_printed=True),
    seed=replace(_PAPER.seed, grey=0.0, harmonics=replace(_PAPER.seed.harmonics, anchored=False)),
)


def job_settings(job: RemovalJob) -> RemovalSettings:
    """The preset's settings with the job's own on top; BadInput if one does not exist, or its value is none for it."""
    if job.preset not in PRESETS:
        raise BadInput(f"--preset: {job.preset!r} is not in this version; use {', '.join(PRESETS)}")
    if not 0 <= job.seed < 1 << 32:
        raise BadInput(f"--seed must be from 0 to {2**32 - 1}, got {job.seed}")
    preset, shadow = PRESETS[job.preset], shadow_of(job.shadow, job.shadow_masks)
    if preset.shadow == "off" and shadow == "mask":
        raise BadInput(f"--shadow mask: the preset {job.preset} leaves shadows alone; use another preset")
    settings = replace(
        preset,
        masks=replace(preset.masks, grow=job.grow),
        inpaint=job.inpaint,
        depth_prior=job.depth_prior,
        shadow="off" if preset.shadow == "off" else shadow,
        random_seed=job.seed,
        refine_views=job.refine_views or "",
    )
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
    (name, *rest), names = path, [f.name for f in fields(settings)]
    if name not in names:
        raise BadInput(f"--set: no setting {key!r}; {type(settings).__name__} has {', '.join(names)}")
    value = getattr(settings, name)
    if is_dataclass(value) != bool(rest):
        raise BadInput(f"--set: {key!r} is not a single setting")
    try:
        new = _with(value, rest, text, key) if rest else _parse_like(value, text)
    except (KeyError, ValueError):
        raise BadInput(f"--set: {key} takes a {type(value).__name__}, got {text!r}") from None
    return replace(settings, **{name: new})


def _parse_like(value: Any, text: str) -> Any:
    if isinstance(value, bool):
        return {"true": True, "1": True, "false": False, "0": False}[text.lower()]
    if value is None:
        return None if text == "none" else float(text)
    return type(value)(text)
