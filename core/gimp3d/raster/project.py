"""From Gaussians to ellipses in the image: EWA projection (Zwicker 2001, Kerbl 2023) and SH colour.

Geometry is computed in float64 and without fast-math: the rows come from files, so infinities and NaN must be
seen as such, scenes may lie far from the origin, and a giant's covariance would overflow float32. What
blending reads is float32.
"""

from __future__ import annotations

import math

import numpy as np
from numba import float64, int32

from ..jit import exact_kernel, inline_kernel

TILE = 16  # px, side of a tile

# One feature row of 16 float32 (a cache line) per Gaussian. The whitening matrix [[XX, XY], [0, YY]] maps an
# offset in pixels so that alpha = opacity · 2^−(squared length): unlike a conic's, its terms are never
# negative, so that rounding cannot make a needle glow.
MEAN_X, MEAN_Y = 0, 1  # px
WHITEN_XX, WHITEN_XY, WHITEN_YY = 2, 3, 4  # 1/px
LOG2_OPACITY = 5
RED, GREEN, BLUE = 6, 7, 8
DEPTH = 9  # z
HALF_HEIGHT = 10  # px, vertical reach of the ellipse alpha = alpha_min
NORMAL_X, NORMAL_Y, NORMAL_Z = 11, 12, 13  # camera axes, facing the camera
FEATURES = 16

UNUSABLE, HIDDEN, DRAWN = -1, 0, 1  # what became of a row

FAR = 1e30  # beyond it, depths in scene units or positions in pixels are no longer safe in float32
LARGEST_LOG_SCALE = 80.0  # as Gaussians.usable
SMALLEST_SQUARED_QUAT = 1e-20
HALF_LOG2E = 0.5 * math.log2(math.e)  # exp(−x²/2) = 2^(−HALF_LOG2E · x²)
EXPONENT_BITS = np.int32(0x7F800000)  # a float32 is finite if its magnitude bits lie below
MAGNITUDE_BITS = np.int32(0x7FFFFFFF)
ZERO, HALF = np.float32(0), np.float32(0.5)

# Real spherical harmonics in 3DGS's order and signs.
C0, C1 = np.float32(0.28209479177387814), np.float32(0.4886025119029199)
C2 = tuple(np.float32(c) for c in (1.0925484305920792, 0.31539156525252005, 0.5462742152960396))
C3 = tuple(
    np.float32(c)
    for c in (
        0.5900435899266435,
        2.890611442640554,
        0.4570457994644658,
        0.3731763325901154,
        1.445305721320277,
    )
)
TWO, THREE, FOUR = np.float32(2), np.float32(3), np.float32(4)


@inline_kernel
def _finite_bits(bits, i):
    """Whether row i of float32 values, seen as int32 so that this vectorises, has no NaN or infinity."""
    largest = int32(0)
    for k in range(bits.shape[1]):
        largest = max(largest, bits[i, k] & MAGNITUDE_BITS)
    return largest < EXPONENT_BITS


@inline_kernel
def _usable(i, means, log_scales, quats, opacity_logits, sh_bits):
    """`Gaussians.usable` of one row, so that drawing needs no pass over all SH coefficients in NumPy."""
    ok = not math.isnan(opacity_logits[i])
    for k in range(3):
        ok = ok and math.isfinite(means[i, k])
    for k in range(log_scales.shape[1]):
        ok = ok and log_scales[i, k] < LARGEST_LOG_SCALE  # false for NaN
    squared = ZERO
    for k in range(4):
        ok = ok and math.isfinite(quats[i, k])
        squared += quats[i, k] * quats[i, k]
    return ok and squared > SMALLEST_SQUARED_QUAT and _finite_bits(sh_bits, i)


@inline_kernel
def _colour(sh, i, c, x, y, z):
    """max(0, 0.5 + Σ Y_k h_k) of channel c in direction (x, y, z)."""
    bands = sh.shape[1]
    value = HALF + C0 * sh[i, 0, c]
    if bands > 1:
        value += C1 * (z * sh[i, 2, c] - y * sh[i, 1, c] - x * sh[i, 3, c])
    if bands > 4:
        xx, yy, zz = x * x, y * y, z * z
        value += C2[0] * (x * y * sh[i, 4, c] - y * z * sh[i, 5, c] - x * z * sh[i, 7, c])
        value += C2[1] * (TWO * zz - xx - yy) * sh[i, 6, c] + C2[2] * (xx - yy) * sh[i, 8, c]
        if bands > 9:
            value -= C3[0] * (y * (THREE * xx - yy) * sh[i, 9, c] + x * (xx - THREE * yy) * sh[i, 15, c])
            value -= C3[2] * (FOUR * zz - xx - yy) * (y * sh[i, 11, c] + x * sh[i, 13, c])
            value += C3[3] * z * (TWO * zz - THREE * (xx + yy)) * sh[i, 12, c]
            value += C3[1] * x * y * z * sh[i, 10, c] + C3[4] * z * (xx - yy) * sh[i, 14, c]
    return max(value, ZERO)


@exact_kernel
def project_range(
    lo,
    hi,
    means,  # [N, 3]
    log_scales,  # [N, 3], or [N, 2] for surfels: their third scale is 0
    quats,  # [N, 4] wxyz
    opacity_logits,  # [N]
    sh,  # [N, K, 3]
    sh_bits,  # [N, 3 K] int32, the same memory
    camera,  # [23] float64: R (9), t (3), fx, fy, cx, cy, centre (3), bounds of x/z and y/z (−x, +x, −y, +y)
    width,
    height,
    near,
    low_pass,
    alpha_min,
    antialiased,
    with_colour,
    features,  # [N, 16] out, filled where DRAWN
    states,  # [N] int8 out: UNUSABLE, HIDDEN or DRAWN
):
    """Feature rows of Gaussians lo … hi−1."""
    r00, r01, r02, r10, r11, r12, r20, r21, r22 = (
        camera[0], camera[1], camera[2], camera[3], camera[4], camera[5], camera[6], camera[7], camera[8],
    )  # fmt: skip
    fx, fy, cx, cy = camera[12], camera[13], camera[14], camera[15]
    for i in range(lo, hi):
        if not _usable(i, means, log_scales, quats, opacity_logits, sh_bits):
            states[i] = UNUSABLE
            continue
        states[i] = HIDDEN
        px, py, pz = float64(means[i, 0]), float64(means[i, 1]), float64(means[i, 2])
        z = r20 * px + r21 * py + r22 * pz + camera[11]
        opacity = 1.0 / (1.0 + math.exp(-float64(opacity_logits[i])))
        if not (near <= z < FAR and opacity > alpha_min):
            continue
        x = r00 * px + r01 * py + r02 * pz + camera[9]
        y = r10 * px + r11 * py + r12 * pz + camera[10]
        mean_x, mean_y = fx * x / z + cx, fy * y / z + cy

        # Rows of J R: the Jacobian of the perspective times the rotation. Far outside the frustum it is
        # evaluated at the bounds, or else a splat beside the camera would flood the view.
        j00, j02 = fx / z, -fx / z * min(max(x / z, camera[19]), camera[20])
        j11, j12 = fy / z, -fy / z * min(max(y / z, camera[21]), camera[22])
        a0, a1, a2 = j00 * r00 + j02 * r20, j00 * r01 + j02 * r21, j00 * r02 + j02 * r22
        b0, b1, b2 = j11 * r10 + j12 * r20, j11 * r11 + j12 * r21, j11 * r12 + j12 * r22

        qw, qx = float64(quats[i, 0]), float64(quats[i, 1])
        qy, qz = float64(quats[i, 2]), float64(quats[i, 3])
        norm = 1.0 / math.sqrt(qw * qw + qx * qx + qy * qy + qz * qz)
        qw, qx, qy, qz = qw * norm, qx * norm, qy * norm, qz * norm
        q00, q01, q02 = 1 - 2 * (qy * qy + qz * qz), 2 * (qx * qy - qw * qz), 2 * (qx * qz + qw * qy)
        q10, q11, q12 = 2 * (qx * qy + qw * qz), 1 - 2 * (qx * qx + qz * qz), 2 * (qy * qz - qw * qx)
        q20, q21, q22 = 2 * (qx * qz - qw * qy), 2 * (qy * qz + qw * qx), 1 - 2 * (qx * qx + qy * qy)
        s0, s1, s2 = math.exp(float64(log_scales[i, 0])), math.exp(float64(log_scales[i, 1])), 0.0
        if log_scales.shape[1] == 3:
            s2 = math.exp(float64(log_scales[i, 2]))

        # The image covariance [[uu, uv], [uv, vv]] from u, v = rows of J R Q S. Its determinant is |u × v|²,
        # so that with the low-pass nothing is subtracted: uu·vv − uv² would cancel for needles.
        u0, v0 = (a0 * q00 + a1 * q10 + a2 * q20) * s0, (b0 * q00 + b1 * q10 + b2 * q20) * s0
        u1, v1 = (a0 * q01 + a1 * q11 + a2 * q21) * s1, (b0 * q01 + b1 * q11 + b2 * q21) * s1
        u2, v2 = (a0 * q02 + a1 * q12 + a2 * q22) * s2, (b0 * q02 + b1 * q12 + b2 * q22) * s2
        uu, uv, vv = u0 * u0 + u1 * u1 + u2 * u2, u0 * v0 + u1 * v1 + u2 * v2, v0 * v0 + v1 * v1 + v2 * v2
        sharp = (u1 * v2 - u2 * v1) ** 2 + (u2 * v0 - u0 * v2) ** 2 + (u0 * v1 - u1 * v0) ** 2
        det = sharp + low_pass * (uu + vv) + low_pass * low_pass
        xx, yy = uu + low_pass, vv + low_pass
        if not 0.0 < det < math.inf:
            continue
        if antialiased:  # mip-splatting: what the low-pass adds to the area is taken from the opacity
            opacity *= math.sqrt(sharp / det)
            if not opacity > alpha_min:
                continue

        radius = math.sqrt(math.log2(opacity / alpha_min))  # whitened length at which alpha = alpha_min
        half_width, half_height = radius * math.sqrt(xx / HALF_LOG2E), radius * math.sqrt(yy / HALF_LOG2E)
        outside_x = mean_x + half_width <= 0.0 or mean_x - half_width >= width
        outside_y = mean_y + half_height <= 0.0 or mean_y - half_height >= height
        if outside_x or outside_y or not (abs(mean_x) < FAR and abs(mean_y) < FAR):
            continue
        states[i] = DRAWN
        f = features[i]
        whiten_xx = math.sqrt(HALF_LOG2E * yy / det)
        f[MEAN_X], f[MEAN_Y], f[DEPTH] = mean_x, mean_y, z
        f[WHITEN_XX], f[WHITEN_XY] = max(whiten_xx, 1.0 / FAR), -whiten_xx * uv / yy
        f[WHITEN_YY], f[HALF_HEIGHT] = max(math.sqrt(HALF_LOG2E / yy), 1.0 / FAR), min(half_height, FAR)
        f[LOG2_OPACITY] = math.log2(opacity)

        if with_colour:
            dx, dy, dz = px - camera[16], py - camera[17], pz - camera[18]
            inverse = 1.0 / math.sqrt(dx * dx + dy * dy + dz * dz)
            dir_x, dir_y, dir_z = np.float32(dx * inverse), np.float32(dy * inverse), np.float32(dz * inverse)
            for c in range(3):
                f[RED + c] = _colour(sh, i, c, dir_x, dir_y, dir_z)

        # the flattest axis is the surface normal
        if s2 <= s0 and s2 <= s1:
            wx, wy, wz = q02, q12, q22
        elif s0 <= s1:
            wx, wy, wz = q00, q10, q20
        else:
            wx, wy, wz = q01, q11, q21
        nx = r00 * wx + r01 * wy + r02 * wz
        ny = r10 * wx + r11 * wy + r12 * wz
        nz = r20 * wx + r21 * wy + r22 * wz
        facing = -1.0 if nx * x + ny * y + nz * z > 0.0 else 1.0
        f[NORMAL_X], f[NORMAL_Y], f[NORMAL_Z] = facing * nx, facing * ny, facing * nz
