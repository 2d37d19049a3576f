"""Blender's own splat objects (5.3 and later), known by their attributes: read into Gaussians, and written.

`radiance:base` holds f_dc and the opacity, `radiance:sh_k` the further SH coefficients; scale and opacity are activated
values, so a round trip is to rounding, not to the byte. Written from the attributes' description, not tried on 5.3.
"""

from __future__ import annotations

import re

import bpy
import numpy as np

from gimp3d.errors import BadInput
from gimp3d.gaussians import Gaussians, pad_sh

BASE, SH = "radiance:base", re.compile(r"radiance:sh_(\d+)")
KEYS = {"FLOAT": ("value", 1), "FLOAT_VECTOR": ("vector", 3), "FLOAT_COLOR": ("color", 4), "QUATERNION": ("value", 4)}


def is_native(candidate: bpy.types.Object | None) -> bool:
    """Whether an object's points carry what a splat has."""
    if candidate is None or candidate.type not in ("POINTCLOUD", "MESH"):
        return False
    return all(name in candidate.data.attributes for name in (BASE, "scale", "rotation"))


def read_native(data: bpy.types.ID) -> Gaussians:
    """The Gaussians of a point cloud's (or mesh's) attributes."""
    base = attribute_values(data, BASE)
    with np.errstate(divide="ignore"):
        opacity = np.clip(base[:, 3], 0, 1)
        logits, log_scales = np.log(opacity) - np.log1p(-opacity), np.log(attribute_values(data, "scale"))
    higher = [attribute_values(data, name) for name in _sh_names(data)]
    if len(higher) not in (0, 3, 8, 15, 24):
        raise BadInput(f"{data.name} has {len(higher)} SH attributes; 0, 3, 8 or 15 expected")
    sh = np.stack([base[:, :3], *higher[:15]], axis=1)  # of degree 4 the first three
    return Gaussians(attribute_values(data, "position"), log_scales, attribute_values(data, "rotation"), logits, sh)


def write_native(data: bpy.types.ID, gaussians: Gaussians) -> None:
    """Set the attributes of a point cloud (or mesh) of as many points; it has those that `read_native` reads."""
    names = _sh_names(data)
    sh = pad_sh(gaussians.sh, 1 + len(names))
    norms = np.linalg.norm(gaussians.quats, axis=1, keepdims=True)
    values = {
        "position": gaussians.means,
        "scale": gaussians.scales,
        "rotation": gaussians.quats / np.where(norms > 0, norms, 1),
        BASE: np.concatenate([sh[:, 0], gaussians.opacity[:, None]], axis=1),
        **{name: sh[:, k] for k, name in enumerate(names, 1)},
    }
    for name, value in values.items():
        attribute = data.attributes[name]
        key, _ = _layout(attribute)
        attribute.data.foreach_set(key, np.ascontiguousarray(value, np.float32).ravel())
    data.update_tag()


def attribute_values(data: bpy.types.ID, name: str) -> np.ndarray:
    """A float attribute, [N] or [N, width]."""
    attribute = data.attributes[name]
    key, width = _layout(attribute)
    values = np.empty(len(attribute.data) * width, np.float32)
    attribute.data.foreach_get(key, values)
    return values.reshape(-1, width) if width > 1 else values


def _layout(attribute: bpy.types.Attribute) -> tuple[str, int]:
    if attribute.data_type in KEYS:
        return KEYS[attribute.data_type]
    return "value", 4  # FLOAT4, which older Blenders do not have


def _sh_names(data: bpy.types.ID) -> list[str]:
    found = [m for m in map(SH.fullmatch, data.attributes.keys()) if m]
    return [m[0] for m in sorted(found, key=lambda m: int(m[1]))]
