"""Real spherical harmonics as 3DGS uses them. NumPy alone, as Blender's own process has no compiled libraries."""

from __future__ import annotations

import numpy as np

from .gaussians import SH_C0

C1 = 0.4886025119029199
C2 = (1.0925484305920792, -1.0925484305920792, 0.31539156525252005, -1.0925484305920792, 0.5462742152960396)
C3 = (
    *(-0.5900435899266435, 2.890611442640554, -0.4570457994644658, 0.3731763325901154),
    *(-0.4570457994644658, 1.445305721320277, -0.5900435899266435),
)


def sh_basis(
    directions: np.ndarray,  # [..., 3] unit, from the camera to the point
    degree: int,  # 0–3
) -> np.ndarray:
    """Y_k(ω) with 3DGS's signs and order, [..., (degree+1)²]."""
    x, y, z = np.moveaxis(directions, -1, 0)
    bands = [np.full_like(x, SH_C0)]
    if degree > 0:
        bands += [-C1 * y, C1 * z, -C1 * x]
    if degree > 1:
        squares = (C2[2] * (2 * z * z - x * x - y * y), C2[3] * x * z, C2[4] * (x * x - y * y))
        bands += [C2[0] * x * y, C2[1] * y * z, *squares]
    if degree > 2:
        bands += [C3[0] * y * (3 * x * x - y * y), C3[1] * x * y * z, C3[2] * y * (4 * z * z - x * x - y * y)]
        bands += [C3[3] * z * (2 * z * z - 3 * x * x - 3 * y * y), C3[4] * x * (4 * z * z - x * x - y * y)]
        bands += [C3[5] * z * (x * x - y * y), C3[6] * x * (x * x - 3 * y * y)]
    return np.stack(bands, -1)
