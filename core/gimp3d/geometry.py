"""What several stages ask of cameras, depths and pictures: the same surface or not, windows, normals, disparity."""

from __future__ import annotations

SAME_DEPTH = 0.02  # relative z within which two drawn depths are the same surface: the scatter of settled splats
SOLID = 0.9  # opacity from which a pixel shows a surface and not a veil before it
