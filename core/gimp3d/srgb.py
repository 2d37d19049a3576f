"""Colours as files hold them, sRGB, and the linear light that shadows and exposures multiply (IEC 61966-2-1)."""

from __future__ import annotations

import numpy as np


def linear(picture: np.ndarray) -> np.ndarray:
    """Linear light in [0, 1] of a picture [..., 3] uint8."""
    return decoded(np.arange(256) / 255.0)[picture]


def decoded(colour: np.ndarray) -> np.ndarray:
    """Linear light of sRGB values in [0, 1]."""
    return np.where(colour <= 0.04045, colour / 12.92, ((colour + 0.055) / 1.055) ** 2.4)


def encoded(light: np.ndarray) -> np.ndarray:
    """sRGB values of linear light."""
    return np.where(light <= 0.0031308, light * 12.92, 1.055 * np.maximum(light, 1e-9) ** (1 / 2.4) - 0.055)
