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
from ..stages.ground import look_at
from ..stages.lifting import Lifted, bare_photos, lift_shadow, subtract_reflection
from ..stages.masks import Masks
from ..stages.occluder import support_first
from ..stages.reflection import Reflection, find_reflection
from ..stages.shadow import Shadow, find_contact, find_shadow, marked_shadow
from ..stages.witness import Witness
from ..view_state import ViewState
from .surfaces import Surfaces

NOT_LOOKED_FOR = "not looked for"
NO_SHADOW = {"found": False, "lights": [], "explained": 0.0}
NO_REFLECTION = {"found": False, "explained": 0.0}


@dataclass(frozen=True)
class Found:
    """What the object does to the light round it, as far as it is found."""

    reflection: Reflection | None
    why_reflection: str
    shadow: Shadow | None
    why_shadow: str

    @classmethod
    def of(cls, reflection: Reflection | str, shadow: Shadow | str) -> Found:
        one = (None, reflection) if isinstance(reflection, str) else (reflection, reflection.reason)
        other = (None, shadow) if isinstance(shadow, str) else (shadow, shadow.reason)
        return cls(*one, *other)

    @property
    def anything(self) -> bool:
        return self.reflection is not None or self.shadow is not None

    @property
    def confidence(self) -> float:
        return min((f.confidence for f in (self.reflection, self.shadow) if f is not None), default=0.0)

    @property
    def reason(self) -> str:
        return f"{self.why_shadow}; {self.why_reflection}"


def find_light(
    scene: Gaussians,
    region: Region,
    masks: Masks,
    surfaces: Surfaces,
    views: Sequence[ViewState],
    shadow_masks: Mapping[str, np.ndarray],  # ID → [H, W] bool, the shadow as the user marked it
    settings: RemovalSettings,
) -> Found:
    """Look for the object's reflection, and in photos without that for its shadow."""
    gone = scene.take(masks.removed)
    planes = support_first(surfaces.planes, gone)
    if not planes:
        none = "no surface is known round the object"
        return Found(None, f"no reflection found: {none}", None, f"no shadow found: {none}")
    witnesses: Sequence[Witness] = surfaces.witnesses(views)
    grounds = look_at(planes, masks.views, witnesses, region)
    reflection = find_reflection(gone, planes[0], grounds, witnesses, region)
    if isinstance(reflection, Reflection):
        bare = bare_photos(reflection, witnesses)
        witnesses = [replace(w, photo=photo) for w, (photo, _, _) in zip(witnesses, bare)]
        grounds = look_at(planes, masks.views, witnesses, region)
    if settings.shadow == "mask":
        shadow = marked_shadow([shadow_masks.get(v.id) for v in views], grounds, witnesses)
    else:
        shadow = find_shadow(gone, planes[0], grounds, region)
    return Found.of(reflection, shadow)


def undo_light(scene: Gaussians, masks: Masks, surfaces: Surfaces, views: Sequence[ViewState], found: Found) -> Lifted:
    """Subtract the reflection, then lift the shadow, in photos and in splats; one of them at least is found."""
    witnesses: Sequence[Witness] = surfaces.witnesses(views)
    first = None
    if found.reflection is not None:
        first = subtract_reflection(scene, masks.removed, found.reflection, witnesses)
        scene, witnesses = first.scene(scene), [replace(w, photo=p) for w, p in zip(witnesses, first.photos)]
    if found.shadow is None:
        assert first is not None
        return first
    lifted = lift_shadow(scene, masks.removed, found.shadow, witnesses)
    return lifted if first is None else lifted.after(first)


def with_contact(found: Found, charts: Sequence[Chart]) -> Found:
    """The same with the shadow where the object touches a surface: where none of a lamp was found."""
    shadow = find_contact(charts)
    if isinstance(shadow, str):
        return replace(found, why_shadow=f"{found.why_shadow}; {shadow}")
    return replace(found, shadow=shadow, why_shadow=shadow.reason)


@dataclass(frozen=True)
class Relit:
    """What the object does to the light round it undone, or why it is not."""

    lifted: Lifted | None
    shadow: dict[str, Any]  # see Shadow.facts
    reflection: dict[str, Any]  # see Reflection.facts

    @classmethod
    def of(cls, found: Found, lifted: Lifted | None) -> Relit:
        shadow, reflection = (
            {**(what.facts() if what is not None else none), "reason": why}
            for what, why, none in (
                (found.shadow, found.why_shadow, NO_SHADOW),
                (found.reflection, found.why_reflection, NO_REFLECTION),
            )
        )
        return cls(lifted, shadow, reflection)

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


NOT_LIT = Relit(None, {**NO_SHADOW, "reason": NOT_LOOKED_FOR}, {**NO_REFLECTION, "reason": NOT_LOOKED_FOR})
