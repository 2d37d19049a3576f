"""Scratch planes for CHUNK Gaussians at a time, one array of float64: loops over such planes vectorise."""

from __future__ import annotations

from numba import float64

from ..compute.jit import inline_kernel
from ..compute.simd import load1, store1

CHUNK = 64
X, Y, Z, QW, QX, QY, QZ, S0, S1, S2, LOGIT = range(0, 11 * CHUNK, CHUNK)  # camera coordinates of the centre
STAGED = 11 * CHUNK  # the first plane after those of what is staged


@inline_kernel
def stage(s, n, i, means, log_scales, quats, opacity_logits, camera):
    """Put Gaussian i into place n of the scratch planes, its mean in camera coordinates."""
    x, y, z = float64(means[i, 0]), float64(means[i, 1]), float64(means[i, 2])
    store1(s, X + n, camera[0] * x + camera[1] * y + camera[2] * z + camera[9])
    store1(s, Y + n, camera[3] * x + camera[4] * y + camera[5] * z + camera[10])
    store1(s, Z + n, camera[6] * x + camera[7] * y + camera[8] * z + camera[11])
    for k in range(4):
        store1(s, QW + k * CHUNK + n, float64(quats[i, k]))
    for k in range(log_scales.shape[1]):
        store1(s, S0 + k * CHUNK + n, float64(log_scales[i, k]))
    store1(s, LOGIT + n, float64(opacity_logits[i]))


@inline_kernel
def load3(s, plane, k):
    """Place k of three planes."""
    return load1(s, plane + k), load1(s, plane + CHUNK + k), load1(s, plane + 2 * CHUNK + k)


@inline_kernel
def store3(s, plane, k, x, y, z):
    store1(s, plane + k, x)
    store1(s, plane + CHUNK + k, y)
    store1(s, plane + 2 * CHUNK + k, z)


@inline_kernel
def rotation_of(s, k):
    """The rotation matrix of staged Gaussian k, row by row."""
    return rotation(load1(s, QW + k), load1(s, QX + k), load1(s, QY + k), load1(s, QZ + k))


@inline_kernel
def rotation(w, x, y, z):
    """The rotation matrix of a quaternion of any length, row by row."""
    k = 2.0 / (w * w + x * x + y * y + z * z)
    return (
        1.0 - k * (y * y + z * z), k * (x * y - w * z), k * (x * z + w * y),
        k * (x * y + w * z), 1.0 - k * (x * x + z * z), k * (y * z - w * x),
        k * (x * z - w * y), k * (y * z + w * x), 1.0 - k * (x * x + y * y),
    )  # fmt: skip


@inline_kernel
def to_camera(r, x, y, z):
    """A direction in the world's axes in the camera's; r: the rows of the camera's rotation."""
    return r[0] * x + r[1] * y + r[2] * z, r[3] * x + r[4] * y + r[5] * z, r[6] * x + r[7] * y + r[8] * z


@inline_kernel
def facing_normal(r, q, s0, s1, s2, x, y, z):
    """The flattest axis of a 3D Gaussian, turned towards the camera, in its axes; whether it is the third axis, or of
    the others the first, and ±1 for the turn."""
    third, first = (s2 <= s0) & (s2 <= s1), s0 <= s1
    wx = q[2] if third else (q[0] if first else q[1])
    wy = q[5] if third else (q[3] if first else q[4])
    wz = q[8] if third else (q[6] if first else q[7])
    nx, ny, nz = to_camera(r, wx, wy, wz)
    facing = -1.0 if nx * x + ny * y + nz * z > 0.0 else 1.0
    return facing * nx, facing * ny, facing * nz, third, first, facing
