"""The way back through projection: from the records of a Gaussian's list entries to the gradients of its values.

Everything is computed anew in float64, row by row; p, U, V, A … are as in unblend.py and project.py.
"""

from __future__ import annotations

import math

import numpy as np
from numba import float32, float64

from ..jit import exact_kernel, inline_kernel
from .project import (
    C0,
    C1,
    C2,
    C3,
    BLUE,
    DRAWN,
    EDGE_ON,
    FOUR,
    GREEN,
    HALF_LOG2E,
    RED,
    THREE,
    TWO,
    ZERO,
    exp64,
    rotation,
)
from .unblend import (
    D_A_X,
    D_A_Y,
    D_BLUE,
    D_CENTRE_X,
    D_CENTRE_Y,
    D_DEPTH,
    D_GREEN,
    D_NORMAL_X,
    D_NORMAL_Y,
    D_NORMAL_Z,
    D_RED,
    D_U_X,
    D_U_Y,
    D_V_X,
    D_V_Y,
    LOG_ALPHA,
    P_X,
    P_XX,
    P_XY,
    P_Y,
    P_YY,
    RECORD,
)
from .vec16 import load1, load16, splat16, store1, store16

SIX, EIGHT = np.float32(6), np.float32(8)
MEAN, SCALE, QUAT, OUT_SIZE = 0, 3, 6, 10  # where a row's gradients are gathered


@exact_kernel
def unproject_range(
    lo,
    hi,
    means,  # [N, 3]
    log_scales,  # [N, 3 or 2]
    quats,  # [N, 4]
    opacity_logits,  # [N]
    sh,  # [N, K, 3]
    camera,  # [23] float64, as project_range
    low_pass,
    antialiased,
    features,  # [N, 16 or 32]
    states,  # [N] int8
    counts,  # [N] int32, records of each row
    first_records,  # [N] int64
    records,  # [Q · 16]
    d_means,  # [N, 3] out
    d_log_scales,  # [N, 3 or 2] out
    d_quats,  # [N, 4] out
    d_opacity_logits,  # [N] out
    d_sh,  # [N, K, 3] out
):
    """Gradients of Gaussians lo … hi−1."""
    surfels = log_scales.shape[1] == 2
    sums, out = np.empty(RECORD, np.float32), np.empty(OUT_SIZE, np.float64)
    flat_sh, flat_d_sh, bands = sh.reshape(-1), d_sh.reshape(-1), sh.shape[1]
    for i in range(lo, hi):
        if states[i] != DRAWN or counts[i] == 0:
            for k in range(3):
                d_means[i, k] = ZERO
            for k in range(log_scales.shape[1]):
                d_log_scales[i, k] = ZERO
            for k in range(4):
                d_quats[i, k] = ZERO
            d_opacity_logits[i] = ZERO
            for k in range(3 * bands):
                store1(flat_d_sh, i * 3 * bands + k, ZERO)
            continue
        total = splat16(ZERO)
        first = first_records[i]
        for r in range(first, first + counts[i]):
            total = total + load16(records, r * RECORD)
        store16(sums, 0, total)
        if surfels:
            _surfel(i, means, log_scales, quats, camera, sums, out)
        else:
            _ellipse(i, means, log_scales, quats, opacity_logits, camera, low_pass, antialiased, sums, out)
        _colour(i, bands, means, camera, flat_sh, features[i], sums, flat_d_sh, out)
        for k in range(3):
            d_means[i, k] = out[MEAN + k]
        for k in range(log_scales.shape[1]):
            d_log_scales[i, k] = out[SCALE + k]
        for k in range(4):
            d_quats[i, k] = out[QUAT + k]
        opacity = 1.0 / (1.0 + exp64(-float64(opacity_logits[i])))
        d_opacity_logits[i] = sums[LOG_ALPHA] * (1.0 - opacity)  # d ln o / d logit = 1 − o


@inline_kernel
def _to_world(camera, x, y, z):
    """A gradient with respect to camera coordinates as one with respect to the mean."""
    return (
        camera[0] * x + camera[3] * y + camera[6] * z,
        camera[1] * x + camera[4] * y + camera[7] * z,
        camera[2] * x + camera[5] * y + camera[8] * z,
    )


@inline_kernel
def _to_camera(camera, px, py, pz):
    return (
        camera[0] * px + camera[1] * py + camera[2] * pz + camera[9],
        camera[3] * px + camera[4] * py + camera[5] * pz + camera[10],
        camera[6] * px + camera[7] * py + camera[8] * pz + camera[11],
    )


@inline_kernel
def _pull_rotation(
    w, x, y, z, e00, e01, e02, e10, e11, e12, e20, e21, e22, out
):
    """From the gradient with respect to the rotation matrix to that of the raw quaternion (normal to it)."""
    inverse = 1.0 / math.sqrt(w * w + x * x + y * y + z * z)
    w, x, y, z = w * inverse, x * inverse, y * inverse, z * inverse
    gw = 2.0 * (x * (e21 - e12) + y * (e02 - e20) + z * (e10 - e01))
    gx = 2.0 * (y * (e01 + e10) + z * (e02 + e20) + w * (e21 - e12) - 2.0 * x * (e11 + e22))
    gy = 2.0 * (x * (e01 + e10) + z * (e12 + e21) + w * (e02 - e20) - 2.0 * y * (e00 + e22))
    gz = 2.0 * (x * (e02 + e20) + y * (e12 + e21) + w * (e10 - e01) - 2.0 * z * (e00 + e11))
    along = gw * w + gx * x + gy * y + gz * z
    out[QUAT] = (gw - along * w) * inverse
    out[QUAT + 1] = (gx - along * x) * inverse
    out[QUAT + 2] = (gy - along * y) * inverse
    out[QUAT + 3] = (gz - along * z) * inverse


@exact_kernel
def _ellipse(i, means, log_scales, quats, opacity_logits, camera, low_pass, antialiased, sums, out):
    """Through EWA projection: cov = V Vᵀ + low_pass with V = J R Q S, mean2d, z and the flattest axis."""
    r00, r01, r02, r10, r11, r12, r20, r21, r22 = (
        camera[0], camera[1], camera[2], camera[3], camera[4], camera[5], camera[6], camera[7], camera[8],
    )  # fmt: skip
    fx, fy = camera[12], camera[13]
    x, y, z = _to_camera(camera, float64(means[i, 0]), float64(means[i, 1]), float64(means[i, 2]))
    iz = 1.0 / z
    tan_x, tan_y = x * iz, y * iz
    bent_x, bent_y = min(max(tan_x, camera[19]), camera[20]), min(max(tan_y, camera[21]), camera[22])
    j00, j11 = fx * iz, fy * iz
    j02, j12 = -j00 * bent_x, -j11 * bent_y
    a0, a1, a2 = j00 * r00 + j02 * r20, j00 * r01 + j02 * r21, j00 * r02 + j02 * r22
    b0, b1, b2 = j11 * r10 + j12 * r20, j11 * r11 + j12 * r21, j11 * r12 + j12 * r22
    qw, qx, qy, qz = float64(quats[i, 0]), float64(quats[i, 1]), float64(quats[i, 2]), float64(quats[i, 3])
    q00, q01, q02, q10, q11, q12, q20, q21, q22 = rotation(qw, qx, qy, qz)
    s0, s1, s2 = (
        exp64(float64(log_scales[i, 0])),
        exp64(float64(log_scales[i, 1])),
        exp64(float64(log_scales[i, 2])),
    )
    u0, v0 = (a0 * q00 + a1 * q10 + a2 * q20) * s0, (b0 * q00 + b1 * q10 + b2 * q20) * s0
    u1, v1 = (a0 * q01 + a1 * q11 + a2 * q21) * s1, (b0 * q01 + b1 * q11 + b2 * q21) * s1
    u2, v2 = (a0 * q02 + a1 * q12 + a2 * q22) * s2, (b0 * q02 + b1 * q12 + b2 * q22) * s2
    uu, uv, vv = u0 * u0 + u1 * u1 + u2 * u2, u0 * v0 + u1 * v1 + u2 * v2, v0 * v0 + v1 * v1 + v2 * v2
    n0, n1, n2 = u1 * v2 - u2 * v1, u2 * v0 - u0 * v2, u0 * v1 - u1 * v0
    sharp = n0 * n0 + n1 * n1 + n2 * n2
    det = sharp + low_pass * (uu + vv) + low_pass * low_pass
    kxx, kxy, kyy = (vv + low_pass) / det, -uv / det, (uu + low_pass) / det  # the conic, inverse of cov

    # ln alpha = ln o − ½ δᵀKδ: dL/dmean2d = K Σpδ, dL/dcov = ½ K (Σpδδᵀ) K
    px, py = float64(sums[P_X]), float64(sums[P_Y])
    d_mean_x, d_mean_y = kxx * px + kxy * py, kxy * px + kyy * py
    pxx, pxy, pyy = float64(sums[P_XX]), float64(sums[P_XY]), float64(sums[P_YY])
    # K V = (low_pass V + [v × n; n × u]) / det: as a product, its terms would cancel for needles
    ku0, kv0 = (low_pass * u0 + v1 * n2 - v2 * n1) / det, (low_pass * v0 + n1 * u2 - n2 * u1) / det
    ku1, kv1 = (low_pass * u1 + v2 * n0 - v0 * n2) / det, (low_pass * v1 + n2 * u0 - n0 * u2) / det
    ku2, kv2 = (low_pass * u2 + v0 * n1 - v1 * n0) / det, (low_pass * v2 + n0 * u1 - n1 * u0) / det
    # dL/dV = 2 dL/dcov V = K (Σpδδᵀ) K V
    tu0, tv0 = pxx * ku0 + pxy * kv0, pxy * ku0 + pyy * kv0
    tu1, tv1 = pxx * ku1 + pxy * kv1, pxy * ku1 + pyy * kv1
    tu2, tv2 = pxx * ku2 + pxy * kv2, pxy * ku2 + pyy * kv2
    du0, dv0 = kxx * tu0 + kxy * tv0, kxy * tu0 + kyy * tv0
    du1, dv1 = kxx * tu1 + kxy * tv1, kxy * tu1 + kyy * tv1
    du2, dv2 = kxx * tu2 + kxy * tv2, kxy * tu2 + kyy * tv2
    # dL/d ln s_k = u_k du_k + v_k dv_k, as column k of V is proportional to s_k; K is symmetric
    d_s0, d_s1, d_s2 = ku0 * tu0 + kv0 * tv0, ku1 * tu1 + kv1 * tv1, ku2 * tu2 + kv2 * tv2
    if antialiased:  # ln opacity has ½ (ln sharp − ln det) added; d sharp / du = 2 v × n, d sharp / dv = 2 n × u
        p = float64(sums[LOG_ALPHA])
        c = p / sharp if sharp > 1e-300 else 0.0
        du0 += c * (v1 * n2 - v2 * n1) - p * ku0
        du1 += c * (v2 * n0 - v0 * n2) - p * ku1
        du2 += c * (v0 * n1 - v1 * n0) - p * ku2
        dv0 += c * (n1 * u2 - n2 * u1) - p * kv0
        dv1 += c * (n2 * u0 - n0 * u2) - p * kv1
        dv2 += c * (n0 * u1 - n1 * u0) - p * kv2
        h0, h1, h2 = n1 * n1 + n2 * n2, n0 * n0 + n2 * n2, n0 * n0 + n1 * n1  # half of d sharp / d ln s_k
        d_s0 += c * h0 - p * (low_pass * (u0 * u0 + v0 * v0) + h0) / det
        d_s1 += c * h1 - p * (low_pass * (u1 * u1 + v1 * v1) + h1) / det
        d_s2 += c * h2 - p * (low_pass * (u2 * u2 + v2 * v2) + h2) / det
    out[SCALE], out[SCALE + 1], out[SCALE + 2] = d_s0, d_s1, d_s2
    du0, du1, du2, dv0, dv1, dv2 = du0 * s0, du1 * s1, du2 * s2, dv0 * s0, dv1 * s1, dv2 * s2
    e00, e01, e02 = a0 * du0 + b0 * dv0, a0 * du1 + b0 * dv1, a0 * du2 + b0 * dv2
    e10, e11, e12 = a1 * du0 + b1 * dv0, a1 * du1 + b1 * dv1, a1 * du2 + b1 * dv2
    e20, e21, e22 = a2 * du0 + b2 * dv0, a2 * du1 + b2 * dv1, a2 * du2 + b2 * dv2
    # the normal: the flattest column of Q in camera axes, facing the camera
    gx, gy, gz = _to_world(
        camera, float64(sums[D_NORMAL_X]), float64(sums[D_NORMAL_Y]), float64(sums[D_NORMAL_Z])
    )
    third, first = s2 <= s0 and s2 <= s1, s0 <= s1
    wx, wy, wz = (q02, q12, q22) if third else ((q00, q10, q20) if first else (q01, q11, q21))
    towards = (
        (r00 * wx + r01 * wy + r02 * wz) * x
        + (r10 * wx + r11 * wy + r12 * wz) * y
        + (r20 * wx + r21 * wy + r22 * wz) * z
    )
    facing = -1.0 if towards > 0.0 else 1.0
    if third:
        e02, e12, e22 = e02 + facing * gx, e12 + facing * gy, e22 + facing * gz
    elif first:
        e00, e10, e20 = e00 + facing * gx, e10 + facing * gy, e20 + facing * gz
    else:
        e01, e11, e21 = e01 + facing * gx, e11 + facing * gy, e21 + facing * gz
    _pull_rotation(qw, qx, qy, qz, e00, e01, e02, e10, e11, e12, e20, e21, e22, out)

    da0, db0 = du0 * q00 + du1 * q01 + du2 * q02, dv0 * q00 + dv1 * q01 + dv2 * q02
    da1, db1 = du0 * q10 + du1 * q11 + du2 * q12, dv0 * q10 + dv1 * q11 + dv2 * q12
    da2, db2 = du0 * q20 + du1 * q21 + du2 * q22, dv0 * q20 + dv1 * q21 + dv2 * q22
    d_j00, d_j02 = da0 * r00 + da1 * r01 + da2 * r02, da0 * r20 + da1 * r21 + da2 * r22
    d_j11, d_j12 = db0 * r10 + db1 * r11 + db2 * r12, db0 * r20 + db1 * r21 + db2 * r22
    # j00 = fx/z, j02 = −fx/z · bent, bent = x/z within its bounds
    d_tan_x = fx * d_mean_x - (j00 * d_j02 if bent_x == tan_x else 0.0)
    d_tan_y = fy * d_mean_y - (j11 * d_j12 if bent_y == tan_y else 0.0)
    d_iz = fx * (d_j00 - bent_x * d_j02) + fy * (d_j11 - bent_y * d_j12) + d_tan_x * x + d_tan_y * y
    d_z = float64(sums[D_DEPTH]) - d_iz * iz * iz
    out[MEAN], out[MEAN + 1], out[MEAN + 2] = _to_world(camera, d_tan_x * iz, d_tan_y * iz, d_z)


@exact_kernel
def _surfel(i, means, log_scales, quats, camera, sums, out):
    """Through ray–splat intersection: U, V, A and the projected centre as functions of the surfel's pose."""
    fx, fy = camera[12], camera[13]
    x, y, z = _to_camera(camera, float64(means[i, 0]), float64(means[i, 1]), float64(means[i, 2]))
    qw, qx, qy, qz = float64(quats[i, 0]), float64(quats[i, 1]), float64(quats[i, 2]), float64(quats[i, 3])
    q00, q01, q02, q10, q11, q12, q20, q21, q22 = rotation(qw, qx, qy, qz)
    tx, ty, tz = _turn(camera, q00, q10, q20)
    bx, by, bz = _turn(camera, q01, q11, q21)
    nx, ny, nz = _turn(camera, q02, q12, q22)
    plane = nx * x + ny * y + nz * z
    seen = plane * plane > EDGE_ON * EDGE_ON * (x * x + y * y + z * z)
    d_tx, d_ty, d_tz, d_bx, d_by, d_bz, d_nx, d_ny, d_nz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    d_x, d_y, d_z = float64(sums[D_CENTRE_X]) * fx / z, float64(sums[D_CENTRE_Y]) * fy / z, float64(sums[D_DEPTH])
    d_z -= (d_x * x + d_y * y) / z
    out[SCALE], out[SCALE + 1] = 0.0, 0.0
    if seen:
        slope = z / plane
        a_x, a_y = slope * nx / fx, slope * ny / fy
        along_u, along_v = tx * x + ty * y + tz * z, bx * x + by * y + bz * z
        scale_u = math.sqrt(HALF_LOG2E) * exp64(-float64(log_scales[i, 0]))
        scale_v = math.sqrt(HALF_LOG2E) * exp64(-float64(log_scales[i, 1]))
        gux, guy = scale_u * float64(sums[D_U_X]), scale_u * float64(sums[D_U_Y])
        gvx, gvy = scale_v * float64(sums[D_V_X]), scale_v * float64(sums[D_V_Y])
        # U = scale (z (tx/fx, ty/fy) − A along), V likewise
        out[SCALE] = -(gux * (z * tx / fx - a_x * along_u) + guy * (z * ty / fy - a_y * along_u))
        out[SCALE + 1] = -(gvx * (z * bx / fx - a_x * along_v) + gvy * (z * by / fy - a_y * along_v))
        d_along_u, d_along_v = -(gux * a_x + guy * a_y), -(gvx * a_x + gvy * a_y)
        d_ax = float64(sums[D_A_X]) - gux * along_u - gvx * along_v
        d_ay = float64(sums[D_A_Y]) - guy * along_u - gvy * along_v
        d_tx, d_ty, d_tz = gux * z / fx + d_along_u * x, guy * z / fy + d_along_u * y, d_along_u * z
        d_bx, d_by, d_bz = gvx * z / fx + d_along_v * x, gvy * z / fy + d_along_v * y, d_along_v * z
        d_z += gux * tx / fx + guy * ty / fy + gvx * bx / fx + gvy * by / fy
        d_x, d_y, d_z = (
            d_x + d_along_u * tx + d_along_v * bx,
            d_y + d_along_u * ty + d_along_v * by,
            d_z + d_along_u * tz + d_along_v * bz,
        )
        # A = slope (nx/fx, ny/fy), slope = z / plane, plane = n·c
        d_slope = d_ax * nx / fx + d_ay * ny / fy
        d_plane = -d_slope * slope / plane
        d_nx, d_ny, d_nz = d_ax * slope / fx + d_plane * x, d_ay * slope / fy + d_plane * y, d_plane * z
        d_x, d_y, d_z = d_x + d_plane * nx, d_y + d_plane * ny, d_z + d_plane * nz + d_slope / plane
    facing = -1.0 if plane > 0.0 else 1.0
    d_nx, d_ny, d_nz = (
        d_nx + facing * float64(sums[D_NORMAL_X]),
        d_ny + facing * float64(sums[D_NORMAL_Y]),
        d_nz + facing * float64(sums[D_NORMAL_Z]),
    )
    e00, e10, e20 = _to_world(camera, d_tx, d_ty, d_tz)
    e01, e11, e21 = _to_world(camera, d_bx, d_by, d_bz)
    e02, e12, e22 = _to_world(camera, d_nx, d_ny, d_nz)
    _pull_rotation(qw, qx, qy, qz, e00, e01, e02, e10, e11, e12, e20, e21, e22, out)
    out[MEAN], out[MEAN + 1], out[MEAN + 2] = _to_world(camera, d_x, d_y, d_z)


@inline_kernel
def _turn(camera, x, y, z):
    """A direction in camera axes."""
    return (
        camera[0] * x + camera[1] * y + camera[2] * z,
        camera[3] * x + camera[4] * y + camera[5] * z,
        camera[6] * x + camera[7] * y + camera[8] * z,
    )


@exact_kernel
def _colour(i, bands, means, camera, flat_sh, f, sums, flat_d_sh, out):
    """Through the SH colour: gradients of the coefficients, and of the mean by way of the direction."""
    # nothing flows through a channel that is clamped to 0
    red = sums[D_RED] if f[RED] > ZERO else ZERO
    green = sums[D_GREEN] if f[GREEN] > ZERO else ZERO
    blue = sums[D_BLUE] if f[BLUE] > ZERO else ZERO
    o = i * 3 * bands
    _store_band(flat_d_sh, o, C0, red, green, blue)
    if bands == 1:
        return
    dx, dy, dz = (
        float64(means[i, 0]) - camera[16],
        float64(means[i, 1]) - camera[17],
        float64(means[i, 2]) - camera[18],
    )
    inverse = 1.0 / math.sqrt(dx * dx + dy * dy + dz * dz)
    x, y, z = float32(dx * inverse), float32(dy * inverse), float32(dz * inverse)
    _store_band(flat_d_sh, o + 3, -C1 * y, red, green, blue)
    _store_band(flat_d_sh, o + 6, C1 * z, red, green, blue)
    _store_band(flat_d_sh, o + 9, -C1 * x, red, green, blue)
    # h: each band's coefficients under the colour's gradient
    gx = -C1 * _dot(flat_sh, o + 9, red, green, blue)
    gy = -C1 * _dot(flat_sh, o + 3, red, green, blue)
    gz = C1 * _dot(flat_sh, o + 6, red, green, blue)
    if bands > 4:
        xx, yy, zz = x * x, y * y, z * z
        _store_band(flat_d_sh, o + 12, C2[0] * x * y, red, green, blue)
        _store_band(flat_d_sh, o + 15, -C2[0] * y * z, red, green, blue)
        _store_band(flat_d_sh, o + 18, C2[1] * (TWO * zz - xx - yy), red, green, blue)
        _store_band(flat_d_sh, o + 21, -C2[0] * x * z, red, green, blue)
        _store_band(flat_d_sh, o + 24, C2[2] * (xx - yy), red, green, blue)
        h4, h5 = C2[0] * _dot(flat_sh, o + 12, red, green, blue), -C2[0] * _dot(flat_sh, o + 15, red, green, blue)
        h6, h7 = TWO * C2[1] * _dot(flat_sh, o + 18, red, green, blue), -C2[0] * _dot(flat_sh, o + 21, red, green, blue)
        h8 = TWO * C2[2] * _dot(flat_sh, o + 24, red, green, blue)
        gx += y * h4 - x * h6 + z * h7 + x * h8
        gy += x * h4 + z * h5 - y * h6 - y * h8
        gz += y * h5 + TWO * z * h6 + x * h7
        if bands > 9:
            _store_band(flat_d_sh, o + 27, -C3[0] * y * (THREE * xx - yy), red, green, blue)
            _store_band(flat_d_sh, o + 30, C3[1] * x * y * z, red, green, blue)
            _store_band(flat_d_sh, o + 33, -C3[2] * y * (FOUR * zz - xx - yy), red, green, blue)
            _store_band(flat_d_sh, o + 36, C3[3] * z * (TWO * zz - THREE * (xx + yy)), red, green, blue)
            _store_band(flat_d_sh, o + 39, -C3[2] * x * (FOUR * zz - xx - yy), red, green, blue)
            _store_band(flat_d_sh, o + 42, C3[4] * z * (xx - yy), red, green, blue)
            _store_band(flat_d_sh, o + 45, -C3[0] * x * (xx - THREE * yy), red, green, blue)
            h9, h10 = -C3[0] * _dot(flat_sh, o + 27, red, green, blue), C3[1] * _dot(flat_sh, o + 30, red, green, blue)
            h11, h12 = -C3[2] * _dot(flat_sh, o + 33, red, green, blue), C3[3] * _dot(flat_sh, o + 36, red, green, blue)
            h13, h14 = -C3[2] * _dot(flat_sh, o + 39, red, green, blue), C3[4] * _dot(flat_sh, o + 42, red, green, blue)
            h15 = -C3[0] * _dot(flat_sh, o + 45, red, green, blue)
            gx += SIX * x * y * h9 + y * z * h10 - TWO * x * y * h11 - SIX * x * z * h12
            gx += (FOUR * zz - THREE * xx - yy) * h13 + TWO * x * z * h14 + THREE * (xx - yy) * h15
            gy += THREE * (xx - yy) * h9 + x * z * h10 + (FOUR * zz - xx - THREE * yy) * h11 - SIX * y * z * h12
            gy -= TWO * x * y * h13 + TWO * y * z * h14 + SIX * x * y * h15
            gz += x * y * h10 + EIGHT * y * z * h11 + (SIX * zz - THREE * (xx + yy)) * h12
            gz += EIGHT * x * z * h13 + (xx - yy) * h14
    along = gx * x + gy * y + gz * z
    out[MEAN] += (gx - along * x) * inverse
    out[MEAN + 1] += (gy - along * y) * inverse
    out[MEAN + 2] += (gz - along * z) * inverse


@inline_kernel
def _store_band(flat, o, y, red, green, blue):
    store1(flat, o, y * red)
    store1(flat, o + 1, y * green)
    store1(flat, o + 2, y * blue)


@inline_kernel
def _dot(flat, o, red, green, blue):
    return load1(flat, o) * red + load1(flat, o + 1) * green + load1(flat, o + 2) * blue
