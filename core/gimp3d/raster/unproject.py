"""The way back through projection: from the records of a Gaussian's list entries to the gradients of its values.

Everything is computed anew in float64, on scratch planes as in project.py; p, U, V, A … are as there and in unblend.py.
"""

from __future__ import annotations

import math

import numpy as np
from numba import float32, float64

from ..compute.jit import exact_kernel, inline_kernel
from ..compute.simd import exp64, load1, load16, prefetch, splat16, store1, store16
from .harmonics import BASIS_PLANES, C1, C2, C3, FOUR, SH_X, THREE, TWO, sh_basis
from .project import BLUE, DRAWN, EDGE_ON, GREEN, HALF_LOG2E, RED, ZERO
from .staging import CHUNK, LOGIT, QW, S0, S1, STAGED, X, facing_normal, load3, rotation_of, stage, store3, to_camera
from .unblend import RECORD

# Records' sums in the order in which unblend_range leaves them. A 3D Gaussian's are over pixels: p is the gradient with
# respect to ln alpha, (dx, dy) the offset from its centre. A surfel's have the same first four, p in LOG_ALPHA, and
# after it the gradients of U, V, A and CENTRE.
D_RED, D_GREEN, D_BLUE, D_DEPTH, LOG_ALPHA = range(5)
P_X, P_Y, P_XX, P_XY, P_YY = range(5, 10)
D_U_X, D_U_Y, D_V_X, D_V_Y, D_A_X, D_A_Y, D_CENTRE_X, D_CENTRE_Y = range(5, 13)
D_NORMAL_X = 13  # the first of three
SIX, EIGHT = np.float32(6), np.float32(8)
AHEAD = 16  # Gaussians whose records to prefetch: tiles left them all over the memory
# Scratch planes after those of what is staged: a record's sums, then the gradients
D_MEAN, D_SCALE, D_QUAT, D_LOGIT = 27 * CHUNK, 30 * CHUNK, 33 * CHUNK, 37 * CHUNK
PLANES = 38


@exact_kernel
def unproject_range(lo, hi, values, camera, low_pass, antialiased, features, states, spans, records, gradients):
    """Gradients of Gaussians lo … hi−1, one array for each of `values`, zero on entry.

    The records [Q · 16] of Gaussian g are those from spans[g, 0] to spans[g, 1] − 1; the rest is as for project_range.
    """
    means, log_scales, quats, opacity_logits, sh = values
    d_means, d_log_scales, d_quats, d_opacity_logits, d_sh = gradients
    scale_count, bands = log_scales.shape[1], sh.shape[1]
    flat_sh, flat_d_sh = sh.reshape(-1), d_sh.reshape(-1)
    s, rows, sums = np.empty(PLANES * CHUNK, np.float64), np.empty(CHUNK, np.int64), np.empty(RECORD, np.float32)
    basis = np.empty(BASIS_PLANES * CHUNK, np.float32)
    i = lo
    while i < hi:
        n = 0
        while i < hi and n < CHUNK:
            prefetch(records, spans[min(i + AHEAD, hi - 1), 0] * RECORD)
            if states[i] == DRAWN and spans[i, 0] < spans[i, 1]:
                total = splat16(ZERO)
                for r in range(spans[i, 0], spans[i, 1]):
                    total = total + load16(records, r * RECORD)
                store16(sums, 0, total)
                for j in range(RECORD):
                    store1(s, STAGED + j * CHUNK + n, float64(sums[j]))
                stage(s, n, i, means, log_scales, quats, opacity_logits, camera)
                rows[n] = i
                n += 1
            i += 1
        if scale_count == 2:
            _surfels_back(s, n, camera)
        else:
            _ellipses_back(s, n, camera, low_pass, antialiased)
        _logits_back(s, n)
        sh_basis(s, n, camera, bands, basis)
        _colours_back(s, n, rows, basis, bands, camera, flat_sh, features, flat_d_sh)
        for k in range(n):
            row = rows[k]
            for j in range(3):
                d_means[row, j] = load1(s, D_MEAN + j * CHUNK + k)
            for j in range(scale_count):
                d_log_scales[row, j] = load1(s, D_SCALE + j * CHUNK + k)
            for j in range(4):
                d_quats[row, j] = load1(s, D_QUAT + j * CHUNK + k)
            d_opacity_logits[row] = load1(s, D_LOGIT + k)


@inline_kernel
def _to_world(r, x, y, z):
    """The inverse of to_camera."""
    return r[0] * x + r[3] * y + r[6] * z, r[1] * x + r[4] * y + r[7] * z, r[2] * x + r[5] * y + r[8] * z


@inline_kernel
def _pull_rotation(s, k, e00, e01, e02, e10, e11, e12, e20, e21, e22):
    """From the gradient with respect to the rotation matrix to that of the raw quaternion (normal to it)."""
    w, (x, y, z) = load1(s, QW + k), load3(s, QW + CHUNK, k)
    inverse = 1.0 / math.sqrt(w * w + x * x + y * y + z * z)
    w, x, y, z = w * inverse, x * inverse, y * inverse, z * inverse
    gw = 2.0 * (x * (e21 - e12) + y * (e02 - e20) + z * (e10 - e01))
    gx = 2.0 * (y * (e01 + e10) + z * (e02 + e20) + w * (e21 - e12) - 2.0 * x * (e11 + e22))
    gy = 2.0 * (x * (e01 + e10) + z * (e12 + e21) + w * (e02 - e20) - 2.0 * y * (e00 + e22))
    gz = 2.0 * (x * (e02 + e20) + y * (e12 + e21) + w * (e10 - e01) - 2.0 * z * (e00 + e11))
    along = gw * w + gx * x + gy * y + gz * z
    store1(s, D_QUAT + k, (gw - along * w) * inverse)
    store3(s, D_QUAT + CHUNK, k, (gx - along * x) * inverse, (gy - along * y) * inverse, (gz - along * z) * inverse)


@exact_kernel
def _ellipses_back(s, n, camera, low_pass, antialiased):
    """Through EWA projection: cov = V Vᵀ + low_pass with V = J R Q S, mean2d, z and the flattest axis."""
    # in locals, or else every store might have changed them, and nothing would vectorise
    r = (camera[0], camera[1], camera[2], camera[3], camera[4], camera[5], camera[6], camera[7], camera[8])
    r00, r01, r02, r10, r11, r12, r20, r21, r22 = r
    left, right, top, bottom = camera[18], camera[19], camera[20], camera[21]
    fx, fy = camera[12], camera[13]
    for k in range(n):
        x, y, z = load3(s, X, k)
        iz = 1.0 / z
        tan_x, tan_y = x * iz, y * iz
        bent_x, bent_y = min(max(tan_x, left), right), min(max(tan_y, top), bottom)
        j00, j11 = fx * iz, fy * iz
        j02, j12 = -j00 * bent_x, -j11 * bent_y
        a0, a1, a2 = j00 * r00 + j02 * r20, j00 * r01 + j02 * r21, j00 * r02 + j02 * r22
        b0, b1, b2 = j11 * r10 + j12 * r20, j11 * r11 + j12 * r21, j11 * r12 + j12 * r22
        q = rotation_of(s, k)
        q00, q01, q02, q10, q11, q12, q20, q21, q22 = q
        s0, s1, s2 = load3(s, S0, k)
        s0, s1, s2 = exp64(s0), exp64(s1), exp64(s2)
        u0, v0 = (a0 * q00 + a1 * q10 + a2 * q20) * s0, (b0 * q00 + b1 * q10 + b2 * q20) * s0
        u1, v1 = (a0 * q01 + a1 * q11 + a2 * q21) * s1, (b0 * q01 + b1 * q11 + b2 * q21) * s1
        u2, v2 = (a0 * q02 + a1 * q12 + a2 * q22) * s2, (b0 * q02 + b1 * q12 + b2 * q22) * s2
        uu, uv, vv = u0 * u0 + u1 * u1 + u2 * u2, u0 * v0 + u1 * v1 + u2 * v2, v0 * v0 + v1 * v1 + v2 * v2
        n0, n1, n2 = u1 * v2 - u2 * v1, u2 * v0 - u0 * v2, u0 * v1 - u1 * v0
        sharp = n0 * n0 + n1 * n1 + n2 * n2
        det = sharp + low_pass * (uu + vv) + low_pass * low_pass
        kxx, kxy, kyy = (vv + low_pass) / det, -uv / det, (uu + low_pass) / det  # the conic, inverse of cov

        # ln alpha = ln o − ½ δᵀKδ: dL/dmean2d = K Σpδ, dL/dcov = ½ K (Σpδδᵀ) K
        px, py = _sum(s, P_X, k), _sum(s, P_Y, k)
        d_mean_x, d_mean_y = kxx * px + kxy * py, kxy * px + kyy * py
        pxx, pxy, pyy = _sum(s, P_XX, k), _sum(s, P_XY, k), _sum(s, P_YY, k)
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
            p = _sum(s, LOG_ALPHA, k)
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
        store3(s, D_SCALE, k, d_s0, d_s1, d_s2)
        du0, du1, du2, dv0, dv1, dv2 = du0 * s0, du1 * s1, du2 * s2, dv0 * s0, dv1 * s1, dv2 * s2
        e00, e01, e02 = a0 * du0 + b0 * dv0, a0 * du1 + b0 * dv1, a0 * du2 + b0 * dv2
        e10, e11, e12 = a1 * du0 + b1 * dv0, a1 * du1 + b1 * dv1, a1 * du2 + b1 * dv2
        e20, e21, e22 = a2 * du0 + b2 * dv0, a2 * du1 + b2 * dv1, a2 * du2 + b2 * dv2
        # the normal: the flattest column of Q in camera axes, facing the camera
        gx, gy, gz = load3(s, STAGED + D_NORMAL_X * CHUNK, k)
        gx, gy, gz = _to_world(r, gx, gy, gz)
        _, _, _, third, first, facing = facing_normal(r, q, s0, s1, s2, x, y, z)
        to_third = facing if third else 0.0
        to_first = (0.0 if third else facing) if first else 0.0
        to_second = facing - to_third - to_first
        e00, e10, e20 = e00 + to_first * gx, e10 + to_first * gy, e20 + to_first * gz
        e01, e11, e21 = e01 + to_second * gx, e11 + to_second * gy, e21 + to_second * gz
        e02, e12, e22 = e02 + to_third * gx, e12 + to_third * gy, e22 + to_third * gz
        _pull_rotation(s, k, e00, e01, e02, e10, e11, e12, e20, e21, e22)

        da0, db0 = du0 * q00 + du1 * q01 + du2 * q02, dv0 * q00 + dv1 * q01 + dv2 * q02
        da1, db1 = du0 * q10 + du1 * q11 + du2 * q12, dv0 * q10 + dv1 * q11 + dv2 * q12
        da2, db2 = du0 * q20 + du1 * q21 + du2 * q22, dv0 * q20 + dv1 * q21 + dv2 * q22
        d_j00, d_j02 = da0 * r00 + da1 * r01 + da2 * r02, da0 * r20 + da1 * r21 + da2 * r22
        d_j11, d_j12 = db0 * r10 + db1 * r11 + db2 * r12, db0 * r20 + db1 * r21 + db2 * r22
        # j00 = fx/z, j02 = −fx/z · bent, bent = x/z within its bounds
        d_tan_x = fx * d_mean_x - (j00 * d_j02 if bent_x == tan_x else 0.0)
        d_tan_y = fy * d_mean_y - (j11 * d_j12 if bent_y == tan_y else 0.0)
        d_iz = fx * (d_j00 - bent_x * d_j02) + fy * (d_j11 - bent_y * d_j12) + d_tan_x * x + d_tan_y * y
        d_z = _sum(s, D_DEPTH, k) - d_iz * iz * iz
        _store_mean(s, k, r, d_tan_x * iz, d_tan_y * iz, d_z)


@exact_kernel
def _surfels_back(s, n, camera):
    """Through ray–splat intersection: U, V, A and the projected centre as functions of the surfel's pose."""
    # in locals, or else every store might have changed them, and nothing would vectorise
    r = (camera[0], camera[1], camera[2], camera[3], camera[4], camera[5], camera[6], camera[7], camera[8])
    fx, fy = camera[12], camera[13]
    for k in range(n):
        x, y, z = load3(s, X, k)
        q00, q01, q02, q10, q11, q12, q20, q21, q22 = rotation_of(s, k)
        tx, ty, tz = to_camera(r, q00, q10, q20)
        bx, by, bz = to_camera(r, q01, q11, q21)
        nx, ny, nz = to_camera(r, q02, q12, q22)
        plane = nx * x + ny * y + nz * z
        seen = plane * plane > EDGE_ON * EDGE_ON * (x * x + y * y + z * z)
        inverse = 1.0 / plane if seen else 0.0
        slope = z * inverse
        a_x, a_y = slope * nx / fx, slope * ny / fy
        along_u, along_v = tx * x + ty * y + tz * z, bx * x + by * y + bz * z
        # U = scale (z (tx/fx, ty/fy) − A along), V likewise; edge-on, where only the low-pass is left, they are fixed
        scale_u = math.sqrt(HALF_LOG2E) * exp64(-load1(s, S0 + k)) if seen else 0.0
        scale_v = math.sqrt(HALF_LOG2E) * exp64(-load1(s, S1 + k)) if seen else 0.0
        gux, guy = scale_u * _sum(s, D_U_X, k), scale_u * _sum(s, D_U_Y, k)
        gvx, gvy = scale_v * _sum(s, D_V_X, k), scale_v * _sum(s, D_V_Y, k)
        store1(s, D_SCALE + k, -(gux * (z * tx / fx - a_x * along_u) + guy * (z * ty / fy - a_y * along_u)))
        store1(s, D_SCALE + CHUNK + k, -(gvx * (z * bx / fx - a_x * along_v) + gvy * (z * by / fy - a_y * along_v)))
        d_along_u, d_along_v = -(gux * a_x + guy * a_y), -(gvx * a_x + gvy * a_y)
        d_ax = _sum(s, D_A_X, k) - gux * along_u - gvx * along_v
        d_ay = _sum(s, D_A_Y, k) - guy * along_u - gvy * along_v
        # A = slope (nx/fx, ny/fy), slope = z / plane, plane = n·c
        d_slope = d_ax * nx / fx + d_ay * ny / fy
        d_plane = -d_slope * slope * inverse
        d_ax, d_ay = d_ax * slope, d_ay * slope

        d_cx, d_cy = _sum(s, D_CENTRE_X, k) * fx / z, _sum(s, D_CENTRE_Y, k) * fy / z
        d_x = d_cx + d_along_u * tx + d_along_v * bx + d_plane * nx
        d_y = d_cy + d_along_u * ty + d_along_v * by + d_plane * ny
        d_z = _sum(s, D_DEPTH, k) - (d_cx * x + d_cy * y) / z + d_along_u * tz + d_along_v * bz + d_plane * nz
        d_z += (gux * tx + gvx * bx) / fx + (guy * ty + gvy * by) / fy + d_slope * inverse
        _store_mean(s, k, r, d_x, d_y, d_z)
        facing = -1.0 if plane > 0.0 else 1.0
        e00, e10, e20 = _to_world(r, gux * z / fx + d_along_u * x, guy * z / fy + d_along_u * y, d_along_u * z)
        e01, e11, e21 = _to_world(r, gvx * z / fx + d_along_v * x, gvy * z / fy + d_along_v * y, d_along_v * z)
        sx, sy, sz = load3(s, STAGED + D_NORMAL_X * CHUNK, k)
        sx, sy = d_ax / fx + d_plane * x + facing * sx, d_ay / fy + d_plane * y + facing * sy
        e02, e12, e22 = _to_world(r, sx, sy, d_plane * z + facing * sz)
        _pull_rotation(s, k, e00, e01, e02, e10, e11, e12, e20, e21, e22)


@inline_kernel
def _sum(s, j, k):
    """Sum j of the record of staged Gaussian k."""
    return load1(s, STAGED + j * CHUNK + k)


@inline_kernel
def _store_mean(s, k, r, x, y, z):
    x, y, z = _to_world(r, x, y, z)
    store3(s, D_MEAN, k, x, y, z)


@exact_kernel
def _logits_back(s, n):
    """d ln o / d logit = 1 − o; a loop of its own, because within the others it stops them from vectorising."""
    for k in range(n):
        store1(s, D_LOGIT + k, _sum(s, LOG_ALPHA, k) / (1.0 + exp64(load1(s, LOGIT + k))))


@exact_kernel
def _colours_back(s, n, rows, basis, bands, camera, flat_sh, features, flat_d_sh):
    """Through the SH colour: gradients of the coefficients, and of the mean by way of the direction."""
    for k in range(n):
        i = rows[k]
        o = i * 3 * bands
        # nothing flows through a channel that is clamped to 0
        red = float32(_sum(s, D_RED, k)) if features[i, RED] > ZERO else ZERO
        green = float32(_sum(s, D_GREEN, k)) if features[i, GREEN] > ZERO else ZERO
        blue = float32(_sum(s, D_BLUE, k)) if features[i, BLUE] > ZERO else ZERO
        for band in range(bands):
            y = load1(basis, band * CHUNK + k)
            store1(flat_d_sh, o + 3 * band, y * red)
            store1(flat_d_sh, o + 3 * band + 1, y * green)
            store1(flat_d_sh, o + 3 * band + 2, y * blue)
        if bands == 1:
            continue
        x, y, z = load3(basis, SH_X, k)
        # h: each band's coefficients under the colour's gradient, with the band's factor
        gx = -C1 * _dot(flat_sh, o + 9, red, green, blue)
        gy = -C1 * _dot(flat_sh, o + 3, red, green, blue)
        gz = C1 * _dot(flat_sh, o + 6, red, green, blue)
        if bands > 4:
            xx, yy, zz = x * x, y * y, z * z
            h4 = C2[0] * _dot(flat_sh, o + 12, red, green, blue)
            h5 = -C2[0] * _dot(flat_sh, o + 15, red, green, blue)
            h6 = TWO * C2[1] * _dot(flat_sh, o + 18, red, green, blue)
            h7 = -C2[0] * _dot(flat_sh, o + 21, red, green, blue)
            h8 = TWO * C2[2] * _dot(flat_sh, o + 24, red, green, blue)
            gx += y * h4 - x * h6 + z * h7 + x * h8
            gy += x * h4 + z * h5 - y * h6 - y * h8
            gz += y * h5 + TWO * z * h6 + x * h7
            if bands > 9:
                h9 = -C3[0] * _dot(flat_sh, o + 27, red, green, blue)
                h10 = C3[1] * _dot(flat_sh, o + 30, red, green, blue)
                h11 = -C3[2] * _dot(flat_sh, o + 33, red, green, blue)
                h12 = C3[3] * _dot(flat_sh, o + 36, red, green, blue)
                h13 = -C3[2] * _dot(flat_sh, o + 39, red, green, blue)
                h14 = C3[4] * _dot(flat_sh, o + 42, red, green, blue)
                h15 = -C3[0] * _dot(flat_sh, o + 45, red, green, blue)
                gx += SIX * x * y * h9 + y * z * h10 - TWO * x * y * h11 - SIX * x * z * h12
                gx += (FOUR * zz - THREE * xx - yy) * h13 + TWO * x * z * h14 + THREE * (xx - yy) * h15
                gy += THREE * (xx - yy) * h9 + x * z * h10 + (FOUR * zz - xx - THREE * yy) * h11 - SIX * y * z * h12
                gy -= TWO * x * y * h13 + TWO * y * z * h14 + SIX * x * y * h15
                gz += x * y * h10 + EIGHT * y * z * h11 + (SIX * zz - THREE * (xx + yy)) * h12
                gz += EIGHT * x * z * h13 + (xx - yy) * h14
        px, py, pz = load3(s, X, k)
        inverse = 1.0 / math.sqrt(px * px + py * py + pz * pz)
        along = gx * x + gy * y + gz * z
        mx, my, mz = load3(s, D_MEAN, k)
        mx, my, mz = mx + (gx - along * x) * inverse, my + (gy - along * y) * inverse, mz + (gz - along * z) * inverse
        store3(s, D_MEAN, k, mx, my, mz)


@inline_kernel
def _dot(flat, o, red, green, blue):
    return load1(flat, o) * red + load1(flat, o + 1) * green + load1(flat, o + 2) * blue
