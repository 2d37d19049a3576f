"""The Blender side of 3D-GIMP: splat objects, the region, the views, and the Remove button. No algorithm lives here."""

from __future__ import annotations

import bpy

from . import command, panels, properties
from .operators import base, display, environment, io, presets, reference, remove, roi, views

MODULES = (
    *(properties, base, environment, io, display, roi, views, reference, remove, presets),
    *(panels, command),
)


def register() -> None:
    for module in MODULES:
        for cls in getattr(module, "CLASSES", ()):
            bpy.utils.register_class(cls)
        if hasattr(module, "register"):
            module.register()


def unregister() -> None:
    for module in reversed(MODULES):
        if hasattr(module, "unregister"):
            module.unregister()
        for cls in reversed(getattr(module, "CLASSES", ())):
            bpy.utils.unregister_class(cls)
