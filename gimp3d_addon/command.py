"""`blender --command gimp3d …`: the command line of the library, from Blender."""

from __future__ import annotations

import subprocess
from typing import Any

import bpy

from .operators.base import python_of
from .worker import child_command

_handles: list[Any] = []


def _run(arguments: list[str]) -> int:
    """In a child, as Remove does: Blender's own Python may lack what the chosen one has."""
    return subprocess.run(child_command(arguments, python_of(bpy.context)), check=False).returncode


def register() -> None:
    if hasattr(bpy.utils, "register_cli_command"):  # Blender ≥ 4.2; the bpy module has it too
        _handles.append(bpy.utils.register_cli_command("gimp3d", _run))


def unregister() -> None:
    while _handles:
        bpy.utils.unregister_cli_command(_handles.pop())
