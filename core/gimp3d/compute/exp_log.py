"""Exponential and logarithm in float64 for kernels: these vectorise, libm's calls do not. Numbers are taken as bits."""

from __future__ import annotations

import math

import numpy as np
from numba import int64

from .jit import inline_kernel
from .simd import bits_of, float_of

LOG2E, LN2 = math.log2(math.e), math.log(2.0)
ROUNDING = 1.5 * 2.0**52  # added to a float64 it leaves the nearest integer in the low mantissa bits
MANTISSA_BITS = np.int64(0xFFFFFFFFFFFFF)
INTEGER_BITS, INTEGER_OFFSET = np.int64(0x4330000000000000), 2.0**52  # float_of(INTEGER_BITS | k) = 2^52 + k


@inline_kernel
def exp64(x):
    """e^x with a relative error of 1e-11 for |x| ≤ 700; it is clamped beyond. For exact kernels only: fast-math
    would cancel ROUNDING."""
    x = min(max(x, -700.0), 700.0)
    shifted = x * LOG2E + ROUNDING
    r = x - (shifted - ROUNDING) * LN2
    p = 1.0 / 362880.0
    p = p * r + 1.0 / 40320.0
    p = p * r + 1.0 / 5040.0
    p = p * r + 1.0 / 720.0
    p = p * r + 1.0 / 120.0
    p = p * r + 1.0 / 24.0
    p = p * r + 1.0 / 6.0
    p = p * r + 0.5
    p = p * r + 1.0
    p = p * r + 1.0
    return float_of(bits_of(p) + (bits_of(shifted) << int64(52)))


@inline_kernel
def log2_64(y):
    """log₂ y of a normal number with an absolute error of 1e-11."""
    bits = bits_of(y)
    # the exponent is counted from √½, so that the mantissa lies in [√½, √2)
    lifted = bits - np.int64(0x3FE6A09E667F3BCD)
    exponent = float_of(INTEGER_BITS | ((lifted >> int64(52)) + int64(2048))) - (INTEGER_OFFSET + 2048.0)
    m = float_of((lifted & MANTISSA_BITS) + np.int64(0x3FE6A09E667F3BCD))
    s = (m - 1.0) / (m + 1.0)
    ss = s * s
    p = 1.0 / 13.0
    p = p * ss + 1.0 / 11.0
    p = p * ss + 1.0 / 9.0
    p = p * ss + 1.0 / 7.0
    p = p * ss + 1.0 / 5.0
    p = p * ss + 1.0 / 3.0
    p = p * ss + 1.0
    return exponent + 2.0 * LOG2E * s * p
