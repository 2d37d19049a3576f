"""`blender --command gimp3d …`: the command line of the library, inside Blender (CONTRACT: gimp3d)."""

from __future__ import annotations

from typing import Any

import bpy

_handles: list[Any] = []


def _run(arguments: list[str]) -> int:
    from gimp3d.cli import main

    return main(arguments)


def register() -> None:
    if hasattr(bpy.utils, "register_cli_command"):  # Blender ≥ 4.2; the bpy module has it too
        _handles.append(bpy.utils.register_cli_command("gimp3d", _run))


def unregister() -> None:
    while _handles:
        bpy.utils.unregister_cli_command(_handles.pop())
