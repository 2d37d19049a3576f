"""Thin plates: the smoothest continuation of scattered values, slopes and bends included.

A membrane (Laplace's equation) is fixed at the rim and forgets how the surface came to it. A thin plate keeps the
slope: on curved ground its error is a half to a quarter of a membrane's, measured on random scenes.
"""

from __future__ import annotations

import cv2
import numpy as np
import scipy.ndimage
import scipy.sparse
import scipy.sparse.linalg

from ..geometry import bounds

SMOOTHING = 1.5  # px, σ below which the values' own noise is smoothed away
TENSION = 1.0  # length, in radii of the hole, beyond which the plate is a membrane
UNKNOWNS = 4000  # at most; larger domains are solved on a coarser grid
STIFF = 15.0  # px, smoothing of a first plate that tells outliers: a soft one bends to clusters of them
OUTLIER = 4.7  # standard deviations off the stiff plate at which a value does not count (Tukey: 95 % efficient)


def thin_plate(values: np.ndarray, weight: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """The surface u [H, W] float64 that is smoothest and nearest to the values; NaN off its domain.

    `weight` [H, W] ≥ 0 is how much each value counts, 0 = unknown; `wanted` [H, W] bool where it is asked for.
    Minimises Σ w (u − v)² + λ ∫ (u_xx² + 2 u_xy² + u_yy² + |∇u − s|²/ℓ²) over wanted pixels and those of weight > 0, s
    the values' common slope (Wahba 1990: thin-plate smoothing; Franke 1985: tension), with natural boundaries, by a
    sparse factorisation. Parts of the domain without a value are NaN.
    """
    wanted, weight = np.asarray(wanted, bool), np.asarray(weight, np.float64)
    domain = wanted | (weight > 0)
    result = np.full(domain.shape, np.nan)
    if not (weight > 0).any():
        return result
    window = bounds(domain)
    domain, weight = domain[window], weight[window]
    # Less their common slope: tension pulls at bends only, and cells that are half empty stand for their middle.
    rows, cols = np.nonzero(weight > 0)
    root, points = np.sqrt(weight[rows, cols]), np.stack([rows, cols, np.ones(len(rows))], -1)
    slope = np.linalg.lstsq(points * root[:, None], values[window][rows, cols] * root, rcond=None)[0]
    y, x = np.indices(domain.shape)
    trend = slope[0] * y + slope[1] * x + slope[2]
    stride = int(np.ceil(np.sqrt(domain.sum() / UNKNOWNS)))
    count = _cells(weight, stride)
    mean = _cells(np.where(weight > 0, values[window] - trend, 0.0) * weight, stride) / np.where(count > 0, count, 1)
    cells = _cells(domain.astype(np.float64), stride) > 0
    parts, _ = scipy.ndimage.label(cells)
    cells &= np.isin(parts, parts[count > 0])
    radius = max(np.sqrt(wanted.sum() / np.pi), 1.0)
    pull = (TENSION * radius / stride) ** -2
    coarse, weights, (h, w) = np.full(cells.shape, np.nan), count, domain.shape
    for smoothing in (STIFF, SMOOTHING):
        energy = _energy(cells, smoothing**4 / stride**2, pull)
        system = (energy + scipy.sparse.diags(weights[cells])).tocsc()
        options = {"SymmetricMode": True, "DiagPivotThresh": 0.0}
        factors = scipy.sparse.linalg.splu(system, permc_spec="MMD_AT_PLUS_A", options=options)
        coarse[cells] = factors.solve(weights[cells] * mean[cells])
        # Tukey's weights of the residuals; never 0, lest a part of the domain lose all.
        off = np.where(count > 0, np.abs(coarse - mean), 0.0)
        share = off / (OUTLIER * (1.4826 * float(np.median(off[count > 0]))) + 1e-300)
        weights = count * np.maximum(1 - np.minimum(share, 1.0) ** 2, 1e-3) ** 2
    inside = domain & cells.repeat(stride, 0).repeat(stride, 1)[:h, :w]
    result[window] = np.where(inside, _refined(coarse, cells, stride)[:h, :w] + trend, np.nan)
    return result


def _cells(values: np.ndarray, stride: int) -> np.ndarray:
    """Sums over cells of stride × stride pixels."""
    h, w = (-(-n // stride) for n in values.shape)
    padded = np.pad(values, ((0, h * stride - values.shape[0]), (0, w * stride - values.shape[1])))
    return padded.reshape(h, stride, w, stride).sum((1, 3))


def _energy(cells: np.ndarray, stiffness: float, tension: float) -> scipy.sparse.csr_matrix:
    """The matrix [n, n] of the bending energy; differences that leave the domain are dropped (natural boundary)."""
    index = np.where(cells, np.cumsum(cells).reshape(cells.shape) - 1, -1)
    h, w = cells.shape
    n = int(cells.sum())
    energy = scipy.sparse.csr_matrix((n, n))
    for share, stencil in (
        (1.0, {(0, 0): 1, (0, 1): -2, (0, 2): 1}),
        (1.0, {(0, 0): 1, (1, 0): -2, (2, 0): 1}),
        (2.0, {(0, 0): 1, (0, 1): -1, (1, 0): -1, (1, 1): 1}),
        (tension, {(0, 0): -1, (0, 1): 1}),
        (tension, {(0, 0): -1, (1, 0): 1}),
    ):
        down, right = max(y for y, _ in stencil), max(x for _, x in stencil)
        if h <= down or w <= right:
            continue
        taken = np.stack([index[y : h - down + y, x : w - right + x].ravel() for y, x in stencil])
        taken = taken[:, (taken >= 0).all(0)]
        rows = np.broadcast_to(np.arange(taken.shape[1]), taken.shape)
        factors = np.repeat(np.sqrt(stiffness * share) * np.array(list(stencil.values()), float), taken.shape[1])
        difference = scipy.sparse.csr_matrix((factors, (rows.ravel(), taken.ravel())), (taken.shape[1], n))
        energy = energy + difference.T @ difference
    return energy


def _refined(coarse: np.ndarray, cells: np.ndarray, stride: int) -> np.ndarray:
    """Bicubic, from cells to pixels."""
    if stride == 1:
        return coarse
    nearest = scipy.ndimage.distance_transform_edt(~cells, return_distances=False, return_indices=True)
    size = coarse.shape[1] * stride, coarse.shape[0] * stride
    to_cells = np.array([[1, 0, 0.5], [0, 1, 0.5]]) / stride - [[0, 0, 0.5], [0, 0, 0.5]]
    flags, border = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP, cv2.BORDER_REPLICATE
    return cv2.warpAffine(coarse[tuple(nearest)], to_cells, size, flags=flags, borderMode=border)
