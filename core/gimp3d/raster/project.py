"""From Gaussians in the world to ellipses in the image: EWA projection (Zwicker 2001, Kerbl 2023) and SH colour."""

from __future__ import annotations

import math

import numpy as np
from numba import float32, int32

from ..jit import inline_kernel, kernel

# One feature row of 16 float32 (a cache line) per Gaussian: what blending reads.
MEAN_X, MEAN_Y = 0, 1  # px
CONIC_XX, CONIC_XY, CONIC_YY = 2, 3, 4  # of the exponent in base 2: alpha = 2^(… + LOG2_OPACITY)
LOG2_OPACITY = 5
RED, GREEN, BLUE = 6, 7, 8
DEPTH = 9  # z
HALF_HEIGHT = 10  # px, vertical reach of the ellipse at alpha = 1/255
NORMAL_X, NORMAL_Y, NORMAL_Z = 11, 12, 13  # camera axes, facing the camera
FEATURES = 16

TILE = 16  # px
LOG2E = np.float32(1.4426950408889634)
FRUSTUM = np.float32(1.3)  # the Jacobian is evaluated no further out than 1.3 × the frustum (Kerbl 2023)
ALPHA_MIN = np.float32(1 / 255)
ZERO, HALF, ONE, TWO = np.float32(0), np.float32(0.5), np.float32(1), np.float32(2)
C0, C1 = np.float32(0.28209479177387814), np.float32(0.4886025119029199)
C20, C21, C22 = np.float32(1.0925484305920792), np.float32(-1.0925484305920792), np.float32(0.31539156525252005)
C24 = np.float32(0.5462742152960396)
C30, C31, C32 = np.float32(-0.5900435899266435), np.float32(2.890611442640554), np.float32(-0.4570457994644658)
C33, C35 = np.float32(0.3731763325901154), np.float32(1.445305721320277)
THREE, FOUR = np.float32(3), np.float32(4)


@inline_kernel
def _colour(sh, i, c, bands, x, y, z):
    """max(0, 0.5 + Σ Y_k h_k) of channel c."""
    value = HALF + C0 * sh[i, 0, c]
    if bands > 1:
        value += C1 * (z * sh[i, 2, c] - y * sh[i, 1, c] - x * sh[i, 3, c])
    if bands > 4:
        xx, yy, zz = x * x, y * y, z * z
        value += C20 * x * y * sh[i, 4, c] + C21 * y * z * sh[i, 5, c] + C22 * (TWO * zz - xx - yy) * sh[i, 6, c]
        value += C21 * x * z * sh[i, 7, c] + C24 * (xx - yy) * sh[i, 8, c]
        if bands > 9:
            value += C30 * y * (THREE * xx - yy) * sh[i, 9, c] + C31 * x * y * z * sh[i, 10, c]
            value += C32 * y * (FOUR * zz - xx - yy) * sh[i, 11, c]
            value += C33 * z * (TWO * zz - THREE * xx - THREE * yy) * sh[i, 12, c]
            value += C32 * x * (FOUR * zz - xx - yy) * sh[i, 13, c] + C35 * z * (xx - yy) * sh[i, 14, c]
            value += C30 * x * (xx - THREE * yy) * sh[i, 15, c]
    return max(value, ZERO)


@kernel
def project_range(
    lo,
    hi,
    rows,  # [M] Gaussians to draw
    means,  # [N, 3]
    scales,  # [N, 3] activated
    quats,  # [N, 4] wxyz
    opacity,  # [N] activated
    sh,  # [N, K, 3]
    camera,  # [23] R (9), t (3), fx, fy, cx, cy, centre (3), tan limits x−, x+, y−, y+
    width,
    height,
    near,
    low_pass,
    antialiased,
    features,  # [M, 16] out
    rects,  # [M, 4] out: tile ranges x0, y0, x1, y1
    tiles,  # [M] out: number of tiles, 0 = not drawn
):
    """Feature rows of Gaussians rows[lo:hi]."""
    across, down = (width + TILE - 1) // TILE, (height + TILE - 1) // TILE
    r00, r01, r02, r10, r11, r12, r20, r21, r22 = (
        camera[0], camera[1], camera[2], camera[3], camera[4], camera[5], camera[6], camera[7], camera[8],
    )  # fmt: skip
    fx, fy, cx, cy = camera[12], camera[13], camera[14], camera[15]
    bands = sh.shape[1]
    for m in range(lo, hi):
        i = rows[m]
        tiles[m] = 0
        px, py, pz = means[i, 0], means[i, 1], means[i, 2]
        z = r20 * px + r21 * py + r22 * pz + camera[11]
        o = opacity[i]
        if not (z >= near and o > ALPHA_MIN):
            continue
        x = r00 * px + r01 * py + r02 * pz + camera[9]
        y = r10 * px + r11 * py + r12 * pz + camera[10]
        iz = ONE / z
        # the Jacobian of the perspective, clamped so that a splat beside the camera does not flood the view
        jx = min(max(x * iz, camera[19]), camera[20]) * z
        jy = min(max(y * iz, camera[21]), camera[22]) * z
        j00, j02, j11, j12 = fx * iz, -fx * jx * iz * iz, fy * iz, -fy * jy * iz * iz
        a0, a1, a2 = j00 * r00 + j02 * r20, j00 * r01 + j02 * r21, j00 * r02 + j02 * r22
        b0, b1, b2 = j11 * r10 + j12 * r20, j11 * r11 + j12 * r21, j11 * r12 + j12 * r22
        qw, qx, qy, qz = quats[i, 0], quats[i, 1], quats[i, 2], quats[i, 3]
        norm = ONE / math.sqrt(qw * qw + qx * qx + qy * qy + qz * qz)
        qw, qx, qy, qz = qw * norm, qx * norm, qy * norm, qz * norm
        q00, q01, q02 = ONE - TWO * (qy * qy + qz * qz), TWO * (qx * qy - qw * qz), TWO * (qx * qz + qw * qy)
        q10, q11, q12 = TWO * (qx * qy + qw * qz), ONE - TWO * (qx * qx + qz * qz), TWO * (qy * qz - qw * qx)
        q20, q21, q22 = TWO * (qx * qz - qw * qy), TWO * (qy * qz + qw * qx), ONE - TWO * (qx * qx + qy * qy)
        s0, s1, s2 = scales[i, 0], scales[i, 1], scales[i, 2]
        u0, v0 = (a0 * q00 + a1 * q10 + a2 * q20) * s0, (b0 * q00 + b1 * q10 + b2 * q20) * s0
        u1, v1 = (a0 * q01 + a1 * q11 + a2 * q21) * s1, (b0 * q01 + b1 * q11 + b2 * q21) * s1
        u2, v2 = (a0 * q02 + a1 * q12 + a2 * q22) * s2, (b0 * q02 + b1 * q12 + b2 * q22) * s2
        xx, xy, yy = u0 * u0 + u1 * u1 + u2 * u2, u0 * v0 + u1 * v1 + u2 * v2, v0 * v0 + v1 * v1 + v2 * v2
        sharp = xx * yy - xy * xy
        xx, yy = xx + low_pass, yy + low_pass
        det = xx * yy - xy * xy
        if not (det > float32(1e-12)) or not (xx + yy < float32(1e12)):
            continue
        if antialiased:  # mip-splatting: what the low-pass adds to the area is taken from the opacity
            o = o * math.sqrt(max(sharp / det, ZERO))
            if not (o > ALPHA_MIN):
                continue
        mx, my = fx * x * iz + cx, fy * y * iz + cy
        reach = TWO * math.log(o / ALPHA_MIN)
        half_width, half_height = math.sqrt(reach * xx), math.sqrt(reach * yy)
        if mx + half_width <= ZERO or my + half_height <= ZERO or mx - half_width >= width or my - half_height >= height:
            continue
        x0 = int32(max(mx - half_width, ZERO)) // TILE
        y0 = int32(max(my - half_height, ZERO)) // TILE
        x1 = min(int32(min(mx + half_width, float32(width))) // TILE + 1, across)
        y1 = min(int32(min(my + half_height, float32(height))) // TILE + 1, down)
        f = features[m]
        inverse = ONE / det
        f[MEAN_X], f[MEAN_Y] = mx, my
        f[CONIC_XX], f[CONIC_XY], f[CONIC_YY] = -HALF * LOG2E * yy * inverse, LOG2E * xy * inverse, -HALF * LOG2E * xx * inverse
        f[LOG2_OPACITY], f[DEPTH], f[HALF_HEIGHT] = math.log(o) * LOG2E, z, half_height
        dx, dy, dz = px - camera[16], py - camera[17], pz - camera[18]
        length = ONE / math.sqrt(dx * dx + dy * dy + dz * dz)
        for c in range(3):
            f[RED + c] = _colour(sh, i, c, bands, dx * length, dy * length, dz * length)
        # the flattest axis is the surface normal
        if s0 <= s1 and s0 <= s2:
            wx, wy, wz = q00, q10, q20
        elif s1 <= s2:
            wx, wy, wz = q01, q11, q21
        else:
            wx, wy, wz = q02, q12, q22
        nx = r00 * wx + r01 * wy + r02 * wz
        ny = r10 * wx + r11 * wy + r12 * wz
        nz = r20 * wx + r21 * wy + r22 * wz
        if nx * x + ny * y + nz * z > ZERO:
            nx, ny, nz = -nx, -ny, -nz
        f[NORMAL_X], f[NORMAL_Y], f[NORMAL_Z] = nx, ny, nz
        rects[m, 0], rects[m, 1], rects[m, 2], rects[m, 3] = x0, y0, x1, y1
        tiles[m] = (x1 - x0) * (y1 - y0)
