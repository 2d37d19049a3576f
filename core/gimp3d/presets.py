"""Every stage's settings for a removal, and the presets: how much work is spent, and the paper as it is."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

from .schema import Seed, Share, Variant
from .stages.charts import ChartSettings
from .stages.clearing import ClearingSettings
from .stages.depth import DepthSettings
from .stages.mapping import MappingSettings
from .stages.masks import MaskSettings
from .stages.propagate import PropagateSettings
from .stages.refine import RefineSettings
from .stages.seed import SeedSettings
from .stages.selection import SelectionSettings


@dataclass(frozen=True)
class RemovalSettings:
    """Every stage's settings, and the providers of what no view shows."""

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
