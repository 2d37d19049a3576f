"""What the object does to the light round it: its shadow and its reflection, found and undone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..box import Region
from ..gaussians import Gaussians
from ..presets import RemovalSettings
from ..stages.charts import Chart
from ..stages.contact import find_contact
from ..stages.ground import look_at
from ..stages.lifting import Lifted, bare_photos, lift_shadow, subtract_reflection
from ..stages.occluder import support_first
from ..stages.reflection import Reflection, find_reflection
from ..stages.shadow import Shadow, find_shadow, marked_shadow
from ..stages.witness import Witness
from ..view_state import ViewState
from .surfaces import Surfaces

NO_SHADOW = {"found": False, "lights": [], "explained": 0.0}
NO_REFLECTION = {"found": False, "explained": 0.0}


@dataclass(frozen=True)
class Found:
    """What the object does to the light round it; in words, why it seems to do nothing."""

    reflection: Reflection | str
    shadow: Shadow | str

    @property
    def effects(self) -> list[Reflection | Shadow]:
        return [f for f in (self.shadow, self.reflection) if not isinstance(f, str)]

    @property
    def confidence(self) -> float:
        return min((f.confidence for f in self.effects), default=0.0)

    @property
    def reason(self) -> str:
        return "; ".join(f if isinstance(f, str) else f.reason for f in (self.shadow, self.reflection))


def find_light(
    scene: Gaussians,
    region: Region,
    surfaces: Surfaces,
    views: Sequence[ViewState],
    shadow_masks: Mapping[str, np.ndarray],  # ID → [H, W] bool, the shadow as the user marked it
    settings: RemovalSettings,
) -> Found:
    """Look for the object's reflection, and in photos without that for its shadow."""
    gone, masks = scene.take(surfaces.selection.removed), [v.masks for v in views]
    planes = support_first(surfaces.planes, gone)
    if not planes:
        none = "no surface is known round the object"
        return Found(f"no reflection found: {none}", f"no shadow found: {none}")
    witnesses: Sequence[Witness] = surfaces.witnesses(views)
    grounds = look_at(planes, masks, witnesses, region)
    reflection = find_reflection(gone, planes[0], grounds, witnesses, region)
    if isinstance(reflection, Reflection):
        bare = bare_photos(reflection, witnesses)
        witnesses = [replace(w, photo=photo) for w, (photo, _, _) in zip(witnesses, bare)]
        grounds = look_at(planes, masks, witnesses, region)
    if settings.shadow == "mask":
        shadow = marked_shadow([shadow_masks.get(v.id) for v in views], grounds, witnesses)
    else:
        shadow = find_shadow(gone, planes, grounds, region)
    return Found(reflection, shadow)


def undo_light(scene: Gaussians, surfaces: Surfaces, views: Sequence[ViewState], found: Found) -> Lifted:
    """Subtract the reflection, then lift the shadow, in photos and in splats; one of them at least is found."""
    witnesses: Sequence[Witness] = surfaces.witnesses(views)
    removed, first = surfaces.selection.removed, None
    if not isinstance(found.reflection, str):
        first = subtract_reflection(scene, removed, found.reflection, witnesses)
        scene, witnesses = first.scene(scene), [replace(w, photo=p) for w, p in zip(witnesses, first.photos)]
    if isinstance(found.shadow, str):
        assert first is not None
        return first
    lifted = lift_shadow(scene, removed, found.shadow, witnesses)
    return lifted if first is None else lifted.after(first)


def with_contact(found: Found, charts: Sequence[Chart]) -> Found:
    """The same with the shadow where the object touches a surface: where none of a lamp was found."""
    shadow = find_contact(charts)
    return replace(found, shadow=f"{found.shadow}; {shadow}" if isinstance(shadow, str) else shadow)


@dataclass(frozen=True)
class Relit:
    """What the object does to the light round it, undone as far as it is found."""

    found: Found
    lifted: Lifted | None

    @property
    def shadow(self) -> dict[str, Any]:
        """See Shadow.facts."""
        return _facts(self.found.shadow, NO_SHADOW)

    @property
    def reflection(self) -> dict[str, Any]:
        """See Reflection.facts."""
        return _facts(self.found.reflection, NO_REFLECTION)

    def scene(self, scene: Gaussians) -> Gaussians:
        """The scene in its new light."""
        return scene if self.lifted is None else self.lifted.scene(scene)

    @property
    def rows(self) -> np.ndarray:
        """[M] of the scene, whose light changed."""
        return np.zeros(0, int) if self.lifted is None else self.lifted.rows

    def views(self, views: Sequence[ViewState]) -> tuple[ViewState, ...]:
        """The views in it."""
        if self.lifted is None:
            return tuple(views)
        return tuple(replace(v, bare=photo, painted=photo) for v, photo in zip(views, self.lifted.photos))

    def shaded(self, number: int) -> np.ndarray | bool:
        """[H, W] bool: where a view, by its index, changed."""
        return False if self.lifted is None else self.lifted.shaded[number]


def _facts(found: Reflection | Shadow | str, none: dict[str, Any]) -> dict[str, Any]:
    """For the summary."""
    return {**none, "reason": found} if isinstance(found, str) else {**found.facts(), "reason": found.reason}


NOT_LIT = Relit(Found("not looked for", "not looked for"), None)
