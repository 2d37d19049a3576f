"""Real spherical harmonics of the directions in which Gaussians are seen, as scratch planes of float32."""

from __future__ import annotations

import math

import numpy as np
from numba import float32

from ..compute.jit import exact_kernel
from ..compute.simd import store1
from ..gaussians import SH_C0, SH_C1, SH_C2, SH_C3
from .staging import CHUNK, X, load3, store3

# The magnitudes of gaussians.py's factors
C0, C1 = np.float32(SH_C0), np.float32(SH_C1)
C2 = tuple(np.float32(abs(SH_C2[k])) for k in (0, 2, 4))
C3 = tuple(np.float32(abs(SH_C3[k])) for k in (0, 1, 2, 3, 5))
TWO, THREE, FOUR = np.float32(2), np.float32(3), np.float32(4)
SH_X = 16 * CHUNK  # the first of three planes with the direction, after 16 planes of the SH basis
BASIS_PLANES = 19


@exact_kernel
def sh_basis(s, n, camera, bands, basis):
    """Real spherical harmonics of the directions from the camera to the first n staged centres: planes of `basis`."""
    for k in range(n):
        x, y, z = load3(s, X, k)
        inverse = 1.0 / math.sqrt(x * x + y * y + z * z)
        x, y, z = x * inverse, y * inverse, z * inverse
        u = float32(camera[0] * x + camera[3] * y + camera[6] * z)
        v = float32(camera[1] * x + camera[4] * y + camera[7] * z)
        store3(basis, SH_X, k, u, v, float32(camera[2] * x + camera[5] * y + camera[8] * z))
        store1(basis, k, C0)
    if bands > 1:
        for k in range(n):
            x, y, z = load3(basis, SH_X, k)
            store3(basis, CHUNK, k, -C1 * y, C1 * z, -C1 * x)
    if bands > 4:
        for k in range(n):
            x, y, z = load3(basis, SH_X, k)
            xx, yy, zz = x * x, y * y, z * z
            store3(basis, 4 * CHUNK, k, C2[0] * x * y, -C2[0] * y * z, C2[1] * (TWO * zz - xx - yy))
            store1(basis, 7 * CHUNK + k, -C2[0] * x * z)
            store1(basis, 8 * CHUNK + k, C2[2] * (xx - yy))
    if bands > 9:
        for k in range(n):
            x, y, z = load3(basis, SH_X, k)
            xx, yy, zz = x * x, y * y, z * z
            store1(basis, 9 * CHUNK + k, -C3[0] * y * (THREE * xx - yy))
            store1(basis, 10 * CHUNK + k, C3[1] * x * y * z)
            store1(basis, 11 * CHUNK + k, -C3[2] * y * (FOUR * zz - xx - yy))
            store1(basis, 12 * CHUNK + k, C3[3] * z * (TWO * zz - THREE * (xx + yy)))
            store1(basis, 13 * CHUNK + k, -C3[2] * x * (FOUR * zz - xx - yy))
            store1(basis, 14 * CHUNK + k, C3[4] * z * (xx - yy))
            store1(basis, 15 * CHUNK + k, -C3[0] * x * (xx - THREE * yy))
