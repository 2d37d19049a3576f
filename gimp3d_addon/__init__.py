"""The Blender side of 3D-GIMP: splat objects, the region, the views, and the Remove button. No algorithm lives here."""

from __future__ import annotations

from types import ModuleType

import bpy

from . import command, panels, preferences, properties
from .operators import base, display, environment, io, reference, remove, roi, views

MODULES = (properties, base, environment, preferences, io, display, roi, views, reference, remove, panels, command)


def classes_of(module: ModuleType) -> list[type]:
    """The operators, panels and property groups that a module defines, in its order."""
    found = [c for c in vars(module).values() if isinstance(c, type) and c.__module__ == module.__name__]
    return [c for c in found if issubclass(c, bpy.types.bpy_struct)]


def register() -> None:
    for module in MODULES:
        for cls in classes_of(module):
            bpy.utils.register_class(cls)
        if hasattr(module, "register"):
            module.register()


def unregister() -> None:
    for module in reversed(MODULES):
        if hasattr(module, "unregister"):
            module.unregister()
        for cls in reversed(classes_of(module)):
            bpy.utils.unregister_class(cls)
