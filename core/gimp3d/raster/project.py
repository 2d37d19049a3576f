"""From Gaussians to ellipses in the image: EWA projection (Zwicker 2001, Kerbl 2023), ray–splat intersection
for surfels (Huang 2024), SH colour.

Geometry is computed in float64 and NaN-safe: the rows come from files, so infinities and NaN must be seen as such,
scenes may lie far from the origin, and a giant's covariance would overflow float32. What blending reads is float32.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import float32, float64, int32, int64

from ..compute.jit import exact_kernel, inline_kernel
from ..compute.simd import LOG2E, exp64, load1, log2_64, store1
from .harmonics import BASIS_PLANES, sh_basis
from .staging import CHUNK, LOGIT, S0, S1, STAGED, X, facing_normal, load3, rotation_of, stage, store3, to_camera

TILE = 32  # px, side of a tile

# One feature row of float32 per Gaussian: 16 (a cache line), or 32 for surfels. Slots 0–5 bound where it can be seen:
# the whitening matrix [[XX, XY], [0, YY]] maps an offset from (BOUND_X, BOUND_Y) in px so that the bound has the
# length HALF_HEIGHT · YY. Unlike a conic's, its terms are never subtracted, so that rounding cannot make a needle glow.
BOUND_X, BOUND_Y = 0, 1  # px
WHITEN_XX, WHITEN_XY, WHITEN_YY = 2, 3, 4  # 1/px
HALF_HEIGHT = 5  # px
LOG2_OPACITY = 6
DEPTH = 7  # z of the centre
RED, GREEN, BLUE = 8, 9, 10
NORMAL_X, NORMAL_Y, NORMAL_Z = 11, 12, 13  # camera axes, facing the camera
# A 3D Gaussian: alpha = opacity · 2^−(squared whitened length); its centre is (BOUND_X, BOUND_Y).
ELLIPSE_ROW = 16
# A surfel: with δ the offset from its projected centre, its own coordinates at a pixel are u = (U·δ) / (1 + A·δ)
# and v = (V·δ) / (1 + A·δ), the ray meets it at z = DEPTH / (1 + A·δ), and alpha = opacity · 2^−(u² + v²).
CENTRE_X, CENTRE_Y, U_X, U_Y, V_X, V_Y, A_X, A_Y = range(14, 22)
SURFEL_ROW = 32

UNUSABLE, HIDDEN, DRAWN = -1, 0, 1  # what became of a row

FAR = 1e30  # beyond it, depths in scene units or positions in pixels are no longer safe in float32
EDGE_ON = 1e-6  # sine of the angle to its plane below which a surfel is seen by its low-pass only
SHARP = 1e6  # 1/px: so steep that only the low-pass is left
LARGEST_LOG_SCALE = 80.0  # as Gaussians.usable
SMALLEST_SQUARED_QUAT = 1e-20
HALF_LOG2E = 0.5 * LOG2E  # exp(−x²/2) = 2^(−HALF_LOG2E · x²)
EXPONENT_BITS = np.int32(0x7F800000)  # a float32 is finite if its magnitude bits lie below
MAGNITUDE_BITS = np.int32(0x7FFFFFFF)
ZERO, HALF = np.float32(0), np.float32(0.5)

# Scratch planes after those of what is staged: a feature row's slots, then half the bound's width
OUT_X, OUT_Y, OUT_XX, OUT_XY, OUT_YY, OUT_HALF_HEIGHT, OUT_LOG2, OUT_DEPTH = range(STAGED, 19 * CHUNK, CHUNK)
OUT_NX, OUT_CENTRE_X, OUT_UY, OUT_AX = (STAGED + slot * CHUNK for slot in (NORMAL_X, CENTRE_X, U_Y, A_X))
OUT_HALF_WIDTH, PLANES = STAGED + (A_Y + 1) * CHUNK, 11 + A_Y + 2


@dataclass(frozen=True)
class Projected:
    """Gaussians projected into a camera."""

    features: np.ndarray  # [N, 16 or 32] float32
    rects: np.ndarray  # [N, 4] int16
    states: np.ndarray  # [N] int8

    @property
    def ignored(self) -> int:
        return int(np.count_nonzero(self.states == UNUSABLE))


@inline_kernel
def shown_of(flat, o):
    """Of the feature row that begins at o: log₂ of the opacity, depth, colour and normal."""
    return (
        load1(flat, o + LOG2_OPACITY), load1(flat, o + DEPTH),
        load1(flat, o + RED), load1(flat, o + GREEN), load1(flat, o + BLUE),
        load1(flat, o + NORMAL_X), load1(flat, o + NORMAL_Y), load1(flat, o + NORMAL_Z),
    )  # fmt: skip


@inline_kernel
def ellipse_of(flat, o):
    """Of a 3D Gaussian's feature row: its centre and whitening matrix."""
    return (
        load1(flat, o + BOUND_X), load1(flat, o + BOUND_Y),
        load1(flat, o + WHITEN_XX), load1(flat, o + WHITEN_XY), load1(flat, o + WHITEN_YY),
    )  # fmt: skip


@inline_kernel
def surfel_of(flat, o):
    """Of a surfel's feature row: its centre, U, V and A."""
    return (
        load1(flat, o + CENTRE_X), load1(flat, o + CENTRE_Y), load1(flat, o + U_X), load1(flat, o + U_Y),
        load1(flat, o + V_X), load1(flat, o + V_Y), load1(flat, o + A_X), load1(flat, o + A_Y),
    )  # fmt: skip


@inline_kernel
def _usable(i, means, log_scales, quats, opacity_logits):
    """`Gaussians.usable` of one row, but for its SH coefficients."""
    ok = not math.isnan(opacity_logits[i])
    for k in range(3):
        ok = ok and math.isfinite(means[i, k])
    for k in range(log_scales.shape[1]):
        ok = ok and log_scales[i, k] < LARGEST_LOG_SCALE  # false for NaN
    squared = ZERO
    for k in range(4):
        ok = ok and math.isfinite(quats[i, k])
        squared += quats[i, k] * quats[i, k]
    return ok and squared > SMALLEST_SQUARED_QUAT


@exact_kernel
def _ellipses(s, n, camera, low_pass, log2_alpha_min, antialiased):
    """The first n staged 3D Gaussians as ellipses in the image."""
    r = (camera[0], camera[1], camera[2], camera[3], camera[4], camera[5], camera[6], camera[7], camera[8])
    r00, r01, r02, r10, r11, r12, r20, r21, r22 = r
    fx, fy, cx, cy = camera[12], camera[13], camera[14], camera[15]
    left, right, top, bottom = camera[18], camera[19], camera[20], camera[21]
    for k in range(n):
        x, y, z = load3(s, X, k)
        inverse_z = 1.0 / z
        # Rows of J R: the Jacobian of the perspective times the rotation. Far outside the frustum it is
        # evaluated at the bounds, or else a splat beside the camera would flood the view.
        tan_x, tan_y = x * inverse_z, y * inverse_z
        j00, j11 = fx * inverse_z, fy * inverse_z
        j02, j12 = -j00 * min(max(tan_x, left), right), -j11 * min(max(tan_y, top), bottom)
        a0, a1, a2 = j00 * r00 + j02 * r20, j00 * r01 + j02 * r21, j00 * r02 + j02 * r22
        b0, b1, b2 = j11 * r10 + j12 * r20, j11 * r11 + j12 * r21, j11 * r12 + j12 * r22

        q = rotation_of(s, k)
        q00, q01, q02, q10, q11, q12, q20, q21, q22 = q
        s0, s1, s2 = load3(s, S0, k)
        s0, s1, s2 = exp64(s0), exp64(s1), exp64(s2)
        # The image covariance [[uu, uv], [uv, vv]] from u, v = rows of J R Q S. Its determinant is |u × v|²,
        # so that with the low-pass nothing is subtracted: uu·vv − uv² would cancel for needles.
        u0, v0 = (a0 * q00 + a1 * q10 + a2 * q20) * s0, (b0 * q00 + b1 * q10 + b2 * q20) * s0
        u1, v1 = (a0 * q01 + a1 * q11 + a2 * q21) * s1, (b0 * q01 + b1 * q11 + b2 * q21) * s1
        u2, v2 = (a0 * q02 + a1 * q12 + a2 * q22) * s2, (b0 * q02 + b1 * q12 + b2 * q22) * s2
        uu, uv, vv = u0 * u0 + u1 * u1 + u2 * u2, u0 * v0 + u1 * v1 + u2 * v2, v0 * v0 + v1 * v1 + v2 * v2
        n0, n1, n2 = u1 * v2 - u2 * v1, u2 * v0 - u0 * v2, u0 * v1 - u1 * v0
        sharp = n0 * n0 + n1 * n1 + n2 * n2
        det = sharp + low_pass * (uu + vv) + low_pass * low_pass
        xx, yy = uu + low_pass, vv + low_pass

        log2_opacity = -log2_64(1.0 + exp64(-load1(s, LOGIT + k)))
        if antialiased:  # mip-splatting: what the low-pass adds to the area is taken from the opacity
            log2_opacity += 0.5 * log2_64(max(sharp / det, 1e-300))
        squared_radius = log2_opacity - log2_alpha_min  # the squared whitened length at which alpha = alpha_min
        radius = math.sqrt(max(squared_radius, 0.0) / HALF_LOG2E)
        whiten_xx = math.sqrt(HALF_LOG2E * yy / det)
        store1(s, OUT_X + k, fx * tan_x + cx)
        store1(s, OUT_Y + k, fy * tan_y + cy)
        store3(s, OUT_XX, k, whiten_xx, -whiten_xx * uv / yy, math.sqrt(HALF_LOG2E / yy))
        store1(s, OUT_DEPTH + k, z)
        store1(s, OUT_HALF_WIDTH + k, radius * math.sqrt(xx))
        store1(s, OUT_HALF_HEIGHT + k, radius * math.sqrt(yy))
        store1(s, OUT_LOG2 + k, log2_opacity)

        nx, ny, nz, _, _, _ = facing_normal(r, q, s0, s1, s2, x, y, z)  # of the surface
        store3(s, OUT_NX, k, nx, ny, nz)


@exact_kernel
def _surfels(s, n, camera, low_pass, log2_alpha_min):
    """The first n staged surfels: their own coordinates as functions of the pixel, and an ellipse around them."""
    r = (camera[0], camera[1], camera[2], camera[3], camera[4], camera[5], camera[6], camera[7], camera[8])
    fx, fy, cx, cy = camera[12], camera[13], camera[14], camera[15]
    for k in range(n):
        x, y, z = load3(s, X, k)
        q00, q01, q02, q10, q11, q12, q20, q21, q22 = rotation_of(s, k)
        tx, ty, tz = to_camera(r, q00, q10, q20)
        bx, by, bz = to_camera(r, q01, q11, q21)
        nx, ny, nz = to_camera(r, q02, q12, q22)
        # The ray (x̂, ŷ, 1) z through a pixel meets the plane n·p = n·c at z = n·c / n·(x̂, ŷ, 1).
        plane = nx * x + ny * y + nz * z
        seen = plane * plane > EDGE_ON * EDGE_ON * (x * x + y * y + z * z)
        slope = z / plane if seen else 0.0
        a_x, a_y = slope * nx / fx, slope * ny / fy
        scale_u = math.sqrt(HALF_LOG2E) * exp64(-load1(s, S0 + k))
        scale_v = math.sqrt(HALF_LOG2E) * exp64(-load1(s, S1 + k))
        along_u, along_v = tx * x + ty * y + tz * z, bx * x + by * y + bz * z
        u_x, u_y = scale_u * (z * tx / fx - a_x * along_u), scale_u * (z * ty / fy - a_y * along_u)
        v_x, v_y = scale_v * (z * bx / fx - a_x * along_v), scale_v * (z * by / fy - a_y * along_v)
        u_x, u_y = (min(max(u_x, -SHARP), SHARP), min(max(u_y, -SHARP), SHARP)) if seen else (SHARP, 0.0)
        v_x, v_y = (min(max(v_x, -SHARP), SHARP), min(max(v_y, -SHARP), SHARP)) if seen else (0.0, SHARP)

        # |(U·δ, V·δ)|² = r² (1 + A·δ)² is a conic (δ−e)ᵀM(δ−e) = r² (1 + A·e) with e = r² M⁻¹A; where it is no
        # ellipse, the surfel reaches round the camera and may be seen anywhere.
        log2_opacity = -log2_64(1.0 + exp64(-load1(s, LOGIT + k)))
        rr = max(log2_opacity - log2_alpha_min, 0.0)
        det_uv = u_x * v_y - u_y * v_x
        cross_u, cross_v = u_x * a_y - u_y * a_x, v_x * a_y - v_y * a_x
        det = det_uv * det_uv - rr * (cross_u * cross_u + cross_v * cross_v)
        ellipse = det > 1e-6 * det_uv * det_uv
        inverse = 1.0 / det if ellipse else 0.0
        # M⁻¹ = [[myy, −mxy], [−mxy, mxx]] · inverse
        mxx = u_x * u_x + v_x * v_x - rr * a_x * a_x
        mxy = u_x * u_y + v_x * v_y - rr * a_x * a_y
        myy = u_y * u_y + v_y * v_y - rr * a_y * a_y
        e_x, e_y = rr * (myy * a_x - mxy * a_y) * inverse, rr * (mxx * a_y - mxy * a_x) * inverse
        level = rr * (1.0 + a_x * e_x + a_y * e_y) * inverse
        # The ellipse δᵀΣ⁻¹δ = 1; its semi-axes are raised until the low-pass disc around the centre lies inside.
        sxx, sxy, syy = level * myy, -level * mxy, level * mxx
        mean, half_gap = 0.5 * (sxx + syy), 0.5 * math.sqrt((sxx - syy) * (sxx - syy) + 4.0 * sxy * sxy)
        disc = math.sqrt(rr * low_pass / HALF_LOG2E) + math.sqrt(e_x * e_x + e_y * e_y)
        long, short = max(mean + half_gap, disc * disc), max(mean - half_gap, disc * disc)
        stretch = (long - short) / (2.0 * half_gap) if half_gap > 1e-9 * mean else 0.0
        lift = long - stretch * (mean + half_gap)
        sxx, sxy, syy = stretch * sxx + lift, stretch * sxy, stretch * syy + lift
        area = long * short
        bounded = ellipse & (area > 0.0)
        mean_x, mean_y = fx * x / z + cx, fy * y / z + cy
        store1(s, OUT_X + k, mean_x + e_x)
        store1(s, OUT_Y + k, mean_y + e_y)
        store1(s, OUT_XX + k, math.sqrt(syy / area) if bounded else 1.0 / FAR)
        store1(s, OUT_XY + k, -sxy / math.sqrt(area * syy) if bounded else 0.0)
        store1(s, OUT_YY + k, 1.0 / math.sqrt(syy) if bounded else 1.0 / FAR)
        store1(s, OUT_DEPTH + k, z)
        store1(s, OUT_HALF_WIDTH + k, math.sqrt(sxx) if bounded else FAR)
        store1(s, OUT_HALF_HEIGHT + k, math.sqrt(syy) if bounded else FAR)
        store1(s, OUT_LOG2 + k, log2_opacity)
        facing = -1.0 if plane > 0.0 else 1.0
        store3(s, OUT_NX, k, facing * nx, facing * ny, facing * nz)
        store3(s, OUT_CENTRE_X, k, mean_x, mean_y, u_x)
        store3(s, OUT_UY, k, u_y, v_x, v_y)
        store1(s, OUT_AX + k, a_x)
        store1(s, OUT_AX + CHUNK + k, a_y)


@inline_kernel
def _tile_range(low, high, tiles):
    """First tile, and one past the last, with a pixel centre between low and high (px)."""
    first = math.ceil(min(max((low - (TILE - 0.5)) / TILE, 0.0), float64(tiles)))
    end = math.floor(min(max((high - 0.5) / TILE + 1.0, 0.0), float64(tiles)))
    return int64(first), int64(end)


@inline_kernel
def _misses(x, y, z, log_scale, camera, low_pass, reach, tiles):
    """Whether a 3D Gaussian with this longest axis surely misses the tiles: a bound of what _ellipses gives."""
    inverse_z = 1.0 / z
    tan_x, tan_y = x * inverse_z, y * inverse_z
    u, v = camera[12] * tan_x + camera[14], camera[13] * tan_y + camera[15]
    beside = max(TILE * tiles[0] - u, u - TILE * tiles[2])  # px by which the centre lies beside them
    beyond = max(TILE * tiles[1] - v, v - TILE * tiles[3])
    if max(beside, beyond) <= 0.0:
        return False
    slope_x, slope_y = min(max(tan_x, camera[18]), camera[19]), min(max(tan_y, camera[20]), camera[21])
    size = exp64(log_scale) * inverse_z
    across, down = camera[12] * size, camera[13] * size
    squared_width = reach * reach * (across * across * (1.0 + slope_x * slope_x) + low_pass)
    squared_height = reach * reach * (down * down * (1.0 + slope_y * slope_y) + low_pass)
    return (beside > 0.0 and beside * beside > squared_width) or (beyond > 0.0 and beyond * beyond > squared_height)


@exact_kernel
def project_range(lo, hi, values, camera, tiles, limits, with_colour, features, rects, states):
    """Feature rows of Gaussians lo … hi−1.

    `values` of them all: means [N, 3], log_scales [N, 3], or [N, 2] for surfels, quats [N, 4] wxyz, opacity_logits [N]
    and sh [N, K, 3]. `camera` [22] float64: R (9), t (3), fx, fy, cx, cy, width, height, bounds of x/z and y/z (−x, +x,
    −y, +y). `tiles` [6] int64: first column and row of the tiles to draw, one past the last, how many there are across
    and down. `limits`: near, low_pass, alpha_min, antialiased. Out: `features` [N, 16 or 32] and `rects` [N, 4] int16
    (first column and row of tiles, and one past the last), filled where `states` [N] int8 become DRAWN.
    """
    means, log_scales, quats, opacity_logits, sh = values
    near, low_pass, alpha_min, antialiased = limits
    surfels = log_scales.shape[1] == 2
    flat, row_size = features.reshape(-1), int64(features.shape[1])
    s, rows = np.empty(PLANES * CHUNK, np.float64), np.empty(CHUNK, np.int64)
    flat_sh, bands, basis = sh.reshape(-1), sh.shape[1], np.empty(BASIS_PLANES * CHUNK, np.float32)
    sh_bits = sh.reshape(len(sh), 3 * bands).view(np.int32)
    logit_min = -math.log(max(1.0 / alpha_min - 1.0, 1e-300))
    log2_alpha_min = math.log2(alpha_min)
    reach = 1.001 * math.sqrt(max(-log2_alpha_min, 0.0) / HALF_LOG2E)  # of an opaque one, in standard deviations
    i = lo
    while i < hi:
        n = 0
        while i < hi and n < CHUNK:
            if not _usable(i, means, log_scales, quats, opacity_logits):
                states[i] = UNUSABLE
            else:
                states[i] = HIDDEN
                px, py, pz = float64(means[i, 0]), float64(means[i, 1]), float64(means[i, 2])
                z = camera[6] * px + camera[7] * py + camera[8] * pz + camera[11]
                meets = near <= z < FAR and opacity_logits[i] > logit_min
                if meets and not surfels:
                    x = camera[0] * px + camera[1] * py + camera[2] * pz + camera[9]
                    y = camera[3] * px + camera[4] * py + camera[5] * pz + camera[10]
                    longest = float64(max(log_scales[i, 0], log_scales[i, 1], log_scales[i, 2]))
                    meets = not _misses(x, y, z, longest, camera, low_pass, reach, tiles)
                if meets:
                    stage(s, n, i, means, log_scales, quats, opacity_logits, camera)
                    rows[n] = i
                    n += 1
            i += 1
        if surfels:
            _surfels(s, n, camera, low_pass, log2_alpha_min)
        else:
            _ellipses(s, n, camera, low_pass, log2_alpha_min, antialiased)
        _emit(s, n, rows, sh_bits, tiles, log2_alpha_min, surfels, flat, row_size, rects, states)
        if with_colour:
            sh_basis(s, n, camera, bands, basis)
            _paint(n, rows, basis, bands, flat_sh, flat, row_size, states)


@exact_kernel
def _emit(s, n, rows, sh_bits, tiles, log2_alpha_min, surfels, flat, row_size, rects, states):
    """Write the feature rows of the first n staged rows, unless they miss the tiles to draw."""
    for k in range(n):
        i = rows[k]
        x, y = load1(s, OUT_X + k), load1(s, OUT_Y + k)
        half_width, half_height = load1(s, OUT_HALF_WIDTH + k), load1(s, OUT_HALF_HEIGHT + k)
        x0, x1 = _tile_range(x - half_width, x + half_width, tiles[4])
        y0, y1 = _tile_range(y - half_height, y + half_height, tiles[5])
        log2_opacity, xx = load1(s, OUT_LOG2 + k), load1(s, OUT_XX + k)
        placed = abs(x) < FAR and abs(y) < FAR and math.isfinite(xx) and log2_opacity > log2_alpha_min
        if not (placed and x0 < x1 and y0 < y1):
            continue
        if x1 <= tiles[0] or x0 >= tiles[2] or y1 <= tiles[1] or y0 >= tiles[3]:
            continue
        largest = int32(0)
        for j in range(sh_bits.shape[1]):
            largest = max(largest, sh_bits[i, j] & MAGNITUDE_BITS)
        if largest >= EXPONENT_BITS:  # NaN or infinity, seen as int32 so that this vectorises
            states[i] = UNUSABLE
            continue
        states[i] = DRAWN
        rects[i, 0], rects[i, 1], rects[i, 2], rects[i, 3] = x0, y0, x1, y1
        o = i * row_size
        for slot in range(CENTRE_X):  # colours come later, if at all
            store1(flat, o + slot, float32(load1(s, STAGED + slot * CHUNK + k)))
        if surfels:
            for slot in range(CENTRE_X, A_Y + 1):
                store1(flat, o + slot, float32(load1(s, STAGED + slot * CHUNK + k)))
        store1(flat, o + WHITEN_XX, float32(max(xx, 1.0 / FAR)))
        store1(flat, o + WHITEN_YY, float32(max(load1(s, OUT_YY + k), 1.0 / FAR)))
        store1(flat, o + HALF_HEIGHT, float32(min(half_height, FAR)))


@exact_kernel
def _paint(n, rows, basis, bands, flat_sh, flat, row_size, states):
    """The colours max(0, 0.5 + Σ Y_k h_k) of the first n staged rows, where they are drawn."""
    for k in range(n):
        i = rows[k]
        if states[i] == DRAWN:
            red, green, blue = HALF, HALF, HALF
            h = i * 3 * bands
            for band in range(bands):
                y = load1(basis, band * CHUNK + k)
                red += y * load1(flat_sh, h + 3 * band)
                green += y * load1(flat_sh, h + 3 * band + 1)
                blue += y * load1(flat_sh, h + 3 * band + 2)
            store1(flat, i * row_size + RED, max(red, ZERO))
            store1(flat, i * row_size + GREEN, max(green, ZERO))
            store1(flat, i * row_size + BLUE, max(blue, ZERO))
