"""The region of interest: oriented boxes in scene coordinates; several boxes are a union."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from .errors import BadInput, refusing
from .gaussians import matrices_to_quats, quats_to_matrices
from .schema import checked, read_json

PARTS = ("center", "size", "rotation_wxyz")  # of a box in a file
LARGEST_ROI = 1 << 20  # bytes of a ROI's file
MOST_BOXES = 50
LARGEST = 1e30  # scene units


@dataclass(frozen=True)
class Box:
    """An oriented box: points `center + R(rotation) · x` with `|x| ≤ size / 2`."""

    center: np.ndarray  # [3] float64, scene coordinates
    size: np.ndarray  # [3] full edge lengths, > 0
    rotation_wxyz: np.ndarray  # [4] unit quaternion

    @classmethod
    def make(cls, center: object, size: object, rotation_wxyz: object = (1, 0, 0, 0)) -> Box:
        """A checked box from anything array-like; a quaternion of any length but zero says how it is turned.

        Raises
        ------
        BadInput
            If a number is missing, not finite, a size is not positive or the quaternion is zero.

        Examples
        --------
        >>> Box.make([0, 0, 0.5], [1, 1, 1]).contains(np.array([[0, 0, 0.9], [0, 0, 1.1]]))
        array([ True, False])
        """
        wrong = (TypeError, ValueError, OverflowError, RecursionError)
        with refusing("ROI: numbers expected for center, size and rotation_wxyz", *wrong):
            c, s, q = (np.array(v, dtype=np.float64) for v in (center, size, rotation_wxyz))
        for name, value, length in (("center", c, 3), ("size", s, 3), ("rotation_wxyz", q, 4)):
            if value.shape != (length,) or not (np.abs(value) < LARGEST).all():  # NaN is not less either
                raise BadInput(f"ROI: {name} must be {length} finite numbers")
        if (s <= 0).any():
            raise BadInput(f"ROI: size must be positive, got {s.tolist()}")
        norm = np.linalg.norm(q)
        if norm < 1e-9:
            raise BadInput("ROI: rotation_wxyz is zero; use [1, 0, 0, 0] for no rotation")
        return cls(c, s, q / norm)

    @property
    def axes(self) -> np.ndarray:
        """[3, 3], columns are the box's axes in the scene."""
        return quats_to_matrices(self.rotation_wxyz[None])[0]

    def contains(self, points: np.ndarray) -> np.ndarray:
        """[N] bool of points [N, 3]; those on a face are inside, NaN is outside."""
        local = (points - self.center) @ self.axes
        return (np.abs(local) <= self.size / 2).all(-1)

    def corners(self) -> np.ndarray:
        """[8, 3]; corner k has the sign of bit b of k along axis b."""
        signs = np.array([[1 if k >> b & 1 else -1 for b in range(3)] for k in range(8)])
        return self.center + (signs * self.size / 2) @ self.axes.T

    def to_json(self) -> dict[str, list[float]]:
        return {name: getattr(self, name).tolist() for name in PARTS}


Region = tuple[Box, ...]


def in_region(region: Sequence[Box], points: np.ndarray) -> np.ndarray:
    """[N] bool: points [N, 3] inside any of the boxes."""
    return np.any([np.zeros(len(points), bool), *(box.contains(points) for box in region)], axis=0)


def box_from_matrix(matrix: np.ndarray, bounds_min: np.ndarray, bounds_max: np.ndarray) -> Box:
    """The box that a transform makes of axis-aligned bounds: any rotation, scale (also negative) and translation.

    BadInput if it shears (rotated child of a non-uniformly scaled parent) or flattens the box.
    """
    linear = matrix[:3, :3]
    lengths = np.linalg.norm(linear, axis=0)
    if not (lengths > 1e-12 * lengths.max()).all():
        raise BadInput("ROI: the box is flat; give it a volume")
    axes = linear / lengths
    if np.abs(axes.T @ axes - np.eye(3)).max() > 1e-4:
        raise BadInput("ROI: the box is sheared; apply its parent's scale first")
    if np.linalg.det(axes) < 0:
        axes[:, 0] *= -1  # a mirrored box is the same set of points
    center = (matrix @ np.append((bounds_min + bounds_max) / 2, 1.0))[:3]
    return Box.make(center, lengths * (bounds_max - bounds_min), matrices_to_quats(axes[None])[0])


def read_region(path: Path | str) -> Region:
    """Read a ROI JSON: one box, or a list of boxes; BadInput if it is missing, no JSON, or a box is malformed."""
    path = Path(path)
    data = read_json(path, "ROI", LARGEST_ROI)
    boxes = data if isinstance(data, list) else [data]
    if not boxes:
        raise BadInput(f"ROI: {path} holds no box")
    if len(boxes) > MOST_BOXES:
        raise BadInput(f"ROI: {path} holds {len(boxes)} boxes; {MOST_BOXES} are the most, each costs time")
    region = []
    for box in boxes:
        if not isinstance(box, dict) or box.get("center") is None or box.get("size") is None:
            raise BadInput(f'ROI: {path} must hold {{"center", "size", "rotation_wxyz"}} or a list of such boxes')
        told = [checked(list[float], box[n], f"ROI: {path}: {n}") for n in PARTS if box.get(n) is not None]
        region.append(Box.make(*told))
    return tuple(region)
