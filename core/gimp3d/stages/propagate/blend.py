"""The painted hole fitted to the photo round it, by Poisson blending with a soft boundary (paper eq. 9: `paper.py`)."""

from __future__ import annotations

import cv2
import numpy as np

from ...solvers.poisson import solve_poisson
from ...solvers.robust import biweight

SEAM = 0.05  # relative depth step between neighbours that parts two surfaces: 2.5 times what depths scatter by
LEAST_BAND = 20  # px of photo that tell the level of a part
HOLD = 1 / 16  # weight that holds a correction at its level where no photo is near; over the root of the band's weight
TOLERANCES = 4.0, 2.0, 1.0  # of a mismatch, round by round
LOCAL = 2.0  # widths of the band, σ of the neighbourhood that tells what is usual
LEAST_COUNT = 1e-3  # share of a neighbourhood from which on it tells
FAR = 4  # widths of the band within which photo still tells
SQUARE = np.ones((3, 3), np.uint8)


def blend_band(
    base: np.ndarray,  # [H, W, 3] uint8, the view round the hole
    raw: np.ndarray,  # [H, W, 3] float32, the fill, in the hole and in the band
    painted: np.ndarray,  # [H, W] bool, where the fill is to be seen
    band: np.ndarray,  # [H, W] bool, photo round the hole that the fill must fit
    width: float,  # px over which the correction follows the photo; farther away it counts less
    depth: np.ndarray,  # [H, W] z of the new scene
) -> np.ndarray:
    """The fill with a smooth correction c that fits it to the band, [H, W, 3] uint8.

    Minimises Σ |∇c|² + Σ_band w (c − mismatch)² + h Σ (c − level)²: Poisson blending (guidance: the fill's gradients)
    with a soft boundary. A rim of single pixels would carry each one's texture and misregistration into the hole: all
    photo round it is asked, and w is less where it is farther away, and where the mismatch is not like the others near
    by (reweighted least squares: Holland and Welsch 1977). The weak hold h lets what few pixels say fade with the
    distance. Depth seams stop the correction.
    """
    result = base.copy()
    if not painted.any():
        return result
    distance = cv2.distanceTransform((~painted).astype(np.uint8), cv2.DIST_L2, 5)
    near = distance <= FAR * width
    whole = near & (painted | band | (depth > 0))  # the correction passes what lies between
    domain = whole & ~_behind_seams(painted | band, depth)
    data = band & domain
    mismatch = np.where(data[..., None], base - raw, 0)
    level = _levels(domain, data, mismatch)
    weight, hold = np.zeros(data.shape), (HOLD / width) ** 2
    if data.any():  # where the two show different things, the difference is none of light
        nearness = 1 / (1 + (distance[data] / width) ** 2)
        weight[data] = 2 / width**2 * nearness * _alike(mismatch, level, data, LOCAL * width)
    anchor = (weight[..., None] * mismatch + hold * level) / (weight + hold)[..., None]
    correction = solve_poisson(
        domain, np.zeros_like(domain), np.zeros_like(mismatch), weight=weight + hold, anchor=anchor
    ).values
    correction[~domain] = 0
    _continue_over(painted & ~domain, domain, depth, correction)
    result[painted] = to_bytes(raw[painted] + correction[painted])
    return result


def _alike(mismatch: np.ndarray, level: np.ndarray, data: np.ndarray, width: float) -> np.ndarray:
    """[N] in [0, 1]: how much each of the data counts, as its mismatch is like the others' near by.

    A local mean, reweighted (Holland and Welsch 1977): what differs from most may be the light of another place.
    """
    mean = level
    for tolerance in TOLERANCES:
        counts = np.zeros(data.shape)
        counts[data] = biweight((mismatch - mean)[data], tolerance)
        total = cv2.GaussianBlur(counts, (0, 0), width)[..., None] + LEAST_COUNT
        mean = (cv2.GaussianBlur(counts[..., None] * mismatch, (0, 0), width) + LEAST_COUNT * level) / total
    return counts[data]


def _levels(domain: np.ndarray, data: np.ndarray, values: np.ndarray) -> np.ndarray:
    """[H, W, 3]: the median of each connected part's data, where there are enough of them; else 0."""
    level = np.zeros(values.shape)
    _, parts = cv2.connectedComponents(domain.astype(np.uint8), connectivity=4)
    found, counts = np.unique(parts[data], return_counts=True)
    for part in found[counts >= LEAST_BAND]:
        inside = parts == part
        level[inside] = np.median(values[inside & data], axis=0)
    return level


def _behind_seams(region: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """[H, W] bool: pixels that lie behind a neighbour of the region by a step. Without them nothing crosses a seam."""
    behind = np.zeros_like(region)
    for a, b in ((np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1], np.s_[1:])):
        both = region[a] & region[b]
        step = depth[b] - depth[a]
        parted = both & (np.abs(step) > SEAM * np.minimum(depth[a], depth[b]))
        behind[b] |= parted & (step > 0)
        behind[a] |= parted & (step < 0)
    return behind


def _continue_over(left_out: np.ndarray, known: np.ndarray, depth: np.ndarray, values: np.ndarray) -> None:
    """Give pixels that were left out at a seam the mean value [H, W, 3] of their own surface beside them."""
    rows, cols = np.nonzero(left_out)
    total, count = np.zeros((len(rows), 3)), np.zeros(len(rows))
    for dy, dx in ((-1, -1), (-1, 0), (-1, 1), (0, -1), (0, 1), (1, -1), (1, 0), (1, 1)):
        i, j = np.clip(rows + dy, 0, depth.shape[0] - 1), np.clip(cols + dx, 0, depth.shape[1] - 1)
        here, there = depth[rows, cols], depth[i, j]
        same = known[i, j] & (np.abs(here - there) < SEAM * np.minimum(here, there))
        total[same] += values[i[same], j[same]]
        count += same
    found = count > 0
    values[rows[found], cols[found]] = total[found] / count[found, None]


def to_bytes(colours: np.ndarray) -> np.ndarray:
    """Grey levels as uint8, NaN as 0."""
    return np.clip(np.rint(np.nan_to_num(colours)), 0, 255).astype(np.uint8)
