"""The fill in a view's light: fitted to the photo round the hole, softly, or to its rim as the paper does (eq. 9)."""

from __future__ import annotations

import cv2
import numpy as np

from ...geometry import dilated
from ...solvers.poisson import solve_poisson
from ...solvers.robust import biweight

SEAM = 0.05  # relative depth step between neighbours that parts two surfaces: 2.5 times what depths scatter by
LEAST_BAND = 20  # px of photo that tell the level of a part
HOLD = 1 / 16  # weight that holds a correction at its level where no photo is near; over the root of the band's weight
TOLERANCES = 4.0, 2.0, 1.0  # of a mismatch, round by round
LOCAL = 2.0  # widths of the band, σ of the neighbourhood that tells what is usual
CELLS = 4.0  # to a σ, in which it is blurred
LEAST_COUNT = 1e-3  # share of a neighbourhood from which on it tells
FAR = 4  # widths of the band within which photo still tells
COARSE = 2.0  # px, σ by which colours are blurred that tell of materials: finer detail lies elsewhere in a rough scan
TELLING = 4.0  # grey levels by which these must differ to tell anything
USUAL = (2, 98)  # percentiles of them in the band; what goes with a colour beyond is not known
SQUARE = np.ones((3, 3), np.uint8)


def blend_band(
    base: np.ndarray,  # [H, W, 3] uint8, the view round the hole
    raw: np.ndarray,  # [H, W, 3] float32, the fill, in the hole and in the band
    painted: np.ndarray,  # [H, W] bool, where the fill is to be seen; somewhere it is
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
    distance = cv2.distanceTransform((~painted).astype(np.uint8), cv2.DIST_L2, 5)
    near = distance <= FAR * width
    whole = near & (painted | band | (depth > 0))  # the correction passes what lies between
    joined = whole & ~_behind_seams(painted | band, depth)
    _, parts = cv2.connectedComponents(joined.astype(np.uint8), connectivity=4)
    parts[~np.isin(parts, parts[dilated(painted, 1)])] = 0  # what the fill does not touch has no say
    domain = parts > 0
    data = band & domain
    mismatch = np.where(data[..., None], base - raw, 0)
    level = _levels(parts, data, mismatch)
    weight, hold = np.zeros(data.shape), (HOLD / width) ** 2
    if data.any():  # where the two show different things, the difference is none of light
        nearness = 1 / (1 + (distance[data] / width) ** 2)
        weight[data] = 2 / width**2 * nearness * _alike(mismatch, level, data, LOCAL * width)
    anchor = (weight[..., None] * mismatch + hold * level) / (weight + hold)[..., None]
    no, flat = np.zeros_like(domain), np.zeros_like(mismatch)
    correction = solve_poisson(domain, no, flat, weight=weight + hold, anchor=anchor).values
    correction[~domain] = 0
    _continue_over(painted & ~domain, domain, depth, correction)
    result[painted] = to_bytes(raw[painted] + correction[painted])
    return result


def colours_here(
    raw: np.ndarray,  # [H, W, 3] float32, the fill, in the hole and in the band
    photo: np.ndarray,  # [H, W, 3] uint8
    painted: np.ndarray,  # [H, W] bool, the hole
    band: np.ndarray,  # [H, W] bool, where the photo shows what the fill shows
    width: float,  # px over which photo counts; farther away it counts less
) -> np.ndarray:
    """The fill in the view's colours, [H, W, 3] float32, so far as photo and fill differ by what goes with colour.

    From one view to another wood shines and cloth does not, and exposures change contrast: a linear function of coarse
    colours, by reweighted least squares (Holland and Welsch 1977) with a ridge of what tells nothing. It counts as far
    as three quarters of the surroundings predict the fourth: errors of place and light go with colour by chance.
    """
    distance = cv2.distanceTransform((~painted).astype(np.uint8), cv2.DIST_L2, 5)
    band = band & (distance <= FAR * width)
    if band.sum() < LEAST_BAND:
        return raw
    where = painted | band
    colours, differs = _blurred(raw, where), _blurred(photo - raw, band)[band]
    told = colours[band]
    near = weight = 1 / (1 + (distance[band] / width) ** 2)
    for tolerance in TOLERANCES:
        middle, usual, slopes = _line(told, differs, weight)
        weight = near * (biweight(differs - usual - (told - middle) @ slopes, tolerance) + LEAST_COUNT)
    below, right = ((n[band] > n[painted].mean()) for n in np.indices(band.shape))
    slopes = slopes * _trust(told, differs, weight, 2 * below + right)
    result = raw.copy()
    result[where] += (np.clip(colours[where], *np.percentile(told, USUAL, axis=0)) - middle) @ slopes
    return result


def _line(told: np.ndarray, differs: np.ndarray, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Means [3] of colours and of differences [N, 3], and slopes [3, 3] of these over those."""
    middle, usual = (np.average(v, axis=0, weights=weight) for v in (told, differs))
    centred = told - middle
    scaled = (weight / weight.sum())[:, None] * centred
    bends = scaled.T @ centred + TELLING**2 * np.eye(3)
    return middle, usual, np.linalg.solve(bends, scaled.T @ (differs - usual))


def _trust(told: np.ndarray, differs: np.ndarray, weight: np.ndarray, quarter: np.ndarray) -> float:
    """In [0, 1]: how much of what colours [N, 3] say of differences [N, 3] in the other quarters holds in each, [N]."""
    both = square = 0.0
    for number in np.unique(quarter):
        on = quarter == number
        if not on.all():
            elsewhere, inside = _line(told, differs, np.where(on, 0, weight))[2], weight[on]
            x, y = (v[on] - np.average(v[on], axis=0, weights=inside) for v in (told, differs))
            both += (inside @ (x @ elsewhere * y)).sum()
            square += (inside @ (x @ elsewhere) ** 2).sum()
    return float(np.clip(both / square, 0, 1)) if square else 0.0


def _blurred(values: np.ndarray, where: np.ndarray) -> np.ndarray:
    """[H, W, 3] float64 of those values."""
    inside = cv2.GaussianBlur(where.astype(np.float64), (0, 0), COARSE)
    mixed = cv2.GaussianBlur(np.where(where[..., None], values, 0).astype(np.float64), (0, 0), COARSE)
    return mixed / np.maximum(inside, LEAST_COUNT)[..., None]


def blend_rim(
    base: np.ndarray, raw: np.ndarray, painted: np.ndarray, no_photo: np.ndarray, depth: np.ndarray
) -> np.ndarray:
    """The paper's blend, [H, W, 3] uint8: gradients of the fill `raw` [H, W, 3] float32 where it is `painted` [H, W]
    bool, its rim as in the view `base` [H, W, 3] uint8, but for `no_photo` [H, W] bool: the rest of the hole, drawings
    of the emptied scene. The rim counts only where no seam of `depth`, [H, W] z of the new scene, parts it from the
    fill. Parts without a rim keep their own colours.
    """
    rim = (cv2.dilate(painted.astype(np.uint8), SQUARE) > 0) & ~painted & ~no_photo & (depth > 0)
    nearest_fill = cv2.dilate(np.where(painted & (depth > 0), depth, 0).astype(np.float32), SQUARE)
    rim &= np.abs(nearest_fill - depth) < SEAM * depth
    solution = solve_poisson(painted, rim, base, np.where(painted[..., None], raw, np.nan).astype(np.float32))
    result, free = base.copy(), solution.unanchored[..., None]
    result[painted] = to_bytes(np.where(free, raw, solution.values)[painted])
    return result


def _alike(mismatch: np.ndarray, level: np.ndarray, data: np.ndarray, width: float) -> np.ndarray:
    """[N] in [0, 1]: how much each of the data counts, as its mismatch is like the others' near by.

    A local mean, reweighted (Holland and Welsch 1977): what differs from most may be the light of another place.
    """
    mean, shape = level, data.shape
    # as coarse as the neighbourhood allows
    small = [max(1, round(n / max(1.0, width / CELLS))) for n in shape]
    sigma = width * small[0] / shape[0], width * small[1] / shape[1]
    for tolerance in TOLERANCES:
        counts = np.zeros(shape)
        counts[data] = biweight((mismatch - mean)[data], tolerance)
        told = np.concatenate([counts[..., None], counts[..., None] * mismatch], axis=-1).astype(np.float32)
        told = cv2.resize(told, small[::-1], interpolation=cv2.INTER_AREA)
        told = cv2.GaussianBlur(told, (0, 0), sigma[1], sigmaY=sigma[0])
        told = cv2.resize(told, shape[::-1], interpolation=cv2.INTER_LINEAR)
        mean = (told[..., 1:] + LEAST_COUNT * level) / (told[..., :1] + LEAST_COUNT)
    return counts[data]


def _levels(parts: np.ndarray, data: np.ndarray, values: np.ndarray) -> np.ndarray:
    """[H, W, 3]: the median of each part's data, where there are enough of them; else 0. `parts` [H, W] are numbers."""
    level = np.zeros(values.shape)
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
