"""The add-on as it is installed: its package, its preferences, and its folders in Blender's user folder."""

from __future__ import annotations

from pathlib import Path

import bpy

PACKAGE = __package__.rpartition(".")[0] or __package__  # the extension; in a checkout the add-on itself


def preferences(context: bpy.types.Context) -> bpy.types.AddonPreferences | None:
    """The add-on's preferences; None where it was registered from a checkout without being enabled."""
    addon = context.preferences.addons.get(PACKAGE)
    return addon.preferences if addon else None


def user_folder(name: str) -> Path:
    """A folder of the add-on's own in Blender's user folder, which updates leave alone."""
    if PACKAGE.startswith("bl_ext."):
        return Path(bpy.utils.extension_path_user(PACKAGE, path=name, create=True))
    return Path(bpy.utils.user_resource("DATAFILES", path=f"gimp3d/{name}", create=True))
