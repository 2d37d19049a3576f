"""The surface behind the object: completing the reference's disparity (paper 3.3, METHOD section 3)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.ndimage

from ..errors import IllPosed
from ..solvers.poisson import solve_poisson


@dataclass(frozen=True)
class DepthSettings:
    """Lengths in pixels; disparities relative to the ring's."""

    surface: str = "auto"  # "auto": a plane where the ring is one, else harmonic; "planar" or "harmonic" insist
    plane_ring: int = 24  # width of the ring on which a plane is sought
    plane_inlier: float = 0.008  # relative disparity within which a ring pixel lies on the plane
    plane_share: float = 0.5  # of the ring that must lie on it
    plane_tries: int = 256  # RANSAC samples
    scale_factor: float | None = None  # s_f; None: measured on the ring. The paper uses 0.1
    ring: int = 12  # width of the ring on which s_f is measured
    gradient_step: int = 6  # differences over this distance are least sensitive to a prior's noise (research, K2)
    minimum_ring: int = 10  # ring pixels below which s_f is undefined
    minimum_correlation: float = 0.3  # between the prior's and the scene's gradients
    layer_jump: float = 0.06  # relative disparity step between neighbours on the rim that parts two layers
    low: float = 0.25  # completed disparities are clamped to [low · ring's least, high · ring's greatest]
    high: float = 4.0


@dataclass(frozen=True)
class DepthCompletion:
    """A completed disparity map."""

    disparity: np.ndarray  # [H, W] float32; 0 = infinitely far or nothing
    depth: np.ndarray  # [H, W] float32 z-depth; 0 where disparity is 0
    scale_factor: float  # s_f used; 0 = harmonic
    clamped: int  # pixels whose disparity had to be clamped
    confidence: float
    reason: str


def complete_disparity(
    disparity: np.ndarray,  # [H, W] float32, 1/z of the scene, valid where `known`
    known: np.ndarray,  # [H, W] bool, Dirichlet pixels
    hole: np.ndarray,  # [H, W] bool, the target region T
    prior: np.ndarray | None = None,  # [H, W] float32 relative disparity, any scale and shift
    settings: DepthSettings = DepthSettings(),  # noqa: B008
) -> DepthCompletion:
    """Fill a hole in a disparity map in the gradient domain (paper 3.3).

    Solves Δd = s_f Δd_m on the hole with d fixed on its known rim and natural boundaries elsewhere. The equation is
    linear: d = L[d_g] + s_f (d_m − L[d_m]), where L is harmonic completion, so one s_f costs as much as any.
    The printed divergence has the opposite sign (METHOD section 3). Rim pixels of a layer in front of the hole are
    no boundary (`background_rim`).

    Without a prior, a ring that is one plane is continued as that plane (planes are exactly affine in disparity); what
    the rim deviates from it is completed harmonically.

    Raises
    ------
    IllPosed
        If the hole has no known rim at all, or a plane was insisted on and there is none.
    """
    fixed = background_rim(disparity, known & ~hole, hole, settings)
    if prior is None and settings.surface != "harmonic":
        plane, on_plane, share = ring_plane(disparity, known & ~hole, hole, settings)
        if share >= settings.plane_share:
            return _complete_on_plane(disparity, known, hole, plane, on_plane, share, settings)
        if settings.surface == "planar":
            raise IllPosed(f"depth: only {share:.0%} of the surroundings lie on one plane; use --depth-prior auto")
    if not (fixed & scipy.ndimage.binary_dilation(hole)).any():
        raise IllPosed("depth: the hole has no rim of known depth; choose a reference that shows more surroundings")
    harmonic = solve_poisson(hole, fixed, disparity)
    filled, s, confidence, reason = harmonic.values, 0.0, 0.7, "harmonic"
    if prior is not None:
        s, confidence, reason = measure_scale(disparity, fixed, hole, prior, settings)
        if s != 0.0:
            relative = np.where(np.isfinite(prior), prior, 0.0)
            smooth = solve_poisson(hole, fixed, relative)
            filled = np.where(hole, harmonic.values + s * (relative - smooth.values), harmonic.values)
    if harmonic.unanchored.any():
        nearest = scipy.ndimage.distance_transform_edt(~fixed, return_distances=False, return_indices=True)
        filled = np.where(harmonic.unanchored, disparity[tuple(nearest)], filled)
        confidence, reason = min(confidence, 0.3), reason + "; a part of the hole has no rim: nearest depth used"
    return _clamped(filled, disparity, known, hole, fixed, s, confidence, reason, settings)


def _complete_on_plane(
    disparity: np.ndarray,
    known: np.ndarray,
    hole: np.ndarray,
    plane: np.ndarray,
    on_plane: np.ndarray,
    share: float,
    settings: DepthSettings,
) -> DepthCompletion:
    """The plane plus the harmonic extension of what the rim's pixels on it deviate."""
    deviation = solve_poisson(hole, known & on_plane & ~hole, disparity - plane)
    filled = np.where(hole, plane + np.where(deviation.unanchored, 0.0, deviation.values), disparity)
    words = f"planar: {share:.0%} of the surroundings lie on one plane"
    return _clamped(filled, disparity, known, hole, known & on_plane, 0.0, share, words, settings)


def ring_plane(
    disparity: np.ndarray,
    known: np.ndarray,
    hole: np.ndarray,
    settings: DepthSettings,
) -> tuple[np.ndarray, np.ndarray, float]:
    """The plane d = a·u + b·v + c that most of the ring lies on: (plane [H, W], pixels on it [H, W] bool, share).

    RANSAC (Fischler & Bolles 1981) with a fixed seed, refined by least squares on the inliers.
    """
    h, w = hole.shape
    v, u = np.mgrid[:h, :w]
    rows, cols = np.nonzero(known & scipy.ndimage.binary_dilation(hole, iterations=settings.plane_ring))
    nothing = np.zeros(hole.shape), np.zeros(hole.shape, bool), 0.0
    if len(rows) < max(3, settings.minimum_ring):
        return nothing
    points = np.stack([cols, rows, np.ones(len(rows))], -1).astype(np.float64)
    d = disparity[rows, cols].astype(np.float64)
    tolerance = settings.plane_inlier * max(float(np.median(d)), 1e-12)
    rng = np.random.default_rng(0)
    samples = rng.integers(0, len(rows), (settings.plane_tries, 3))
    systems = points[samples]
    solvable = np.abs(np.linalg.det(systems)) > 1.0  # three pixels in a line say nothing
    if not solvable.any():
        return nothing
    candidates = np.linalg.solve(systems[solvable], d[samples][solvable][..., None])[..., 0]
    thin = points[:: max(1, len(points) // 2000)], d[:: max(1, len(points) // 2000)]
    votes = (np.abs(thin[0] @ candidates.T - thin[1][:, None]) < tolerance).sum(0)
    best = candidates[int(votes.argmax())]
    for _ in range(3):
        on = np.abs(points @ best - d) < tolerance
        if on.sum() < 3:
            return nothing
        best = np.linalg.lstsq(points[on], d[on], rcond=None)[0]
    plane = best[0] * u + best[1] * v + best[2]
    share = float((np.abs(points @ best - d) < tolerance).mean())
    return plane, np.abs(plane - disparity) < tolerance, share


def _clamped(
    filled: np.ndarray,
    disparity: np.ndarray,
    known: np.ndarray,
    hole: np.ndarray,
    fixed: np.ndarray,
    scale: float,
    confidence: float,
    reason: str,
    settings: DepthSettings,
) -> DepthCompletion:
    """The result with disparities kept to the ring's range (METHOD section 8: disparity ≤ 0 after the solve)."""
    ring = disparity[fixed & scipy.ndimage.binary_dilation(hole, iterations=3)]
    ring = ring[ring > 0]
    low, high = (settings.low * ring.min(), settings.high * ring.max()) if len(ring) else (0.0, np.inf)
    clipped = np.where(hole, np.clip(filled, low, high), np.where(known, disparity, 0.0))
    clamped = int((hole & (clipped != filled)).sum())
    if clamped > 0.05 * hole.sum():
        confidence, reason = confidence * 0.5, f"{reason}; {clamped} pixels clamped to the ring's range"
    clipped = clipped.astype(np.float32)
    depth = np.where(clipped > 0, 1.0 / np.where(clipped > 0, clipped, 1.0), 0.0).astype(np.float32)
    return DepthCompletion(clipped, depth, scale, clamped, confidence, reason)


def measure_scale(
    disparity: np.ndarray,
    known: np.ndarray,
    hole: np.ndarray,
    prior: np.ndarray,
    settings: DepthSettings,
) -> tuple[float, float, str]:
    """s_f with its confidence and reason: least squares between gradients on the ring (METHOD section 3).

    0 where the prior says nothing: too few pixels, no variance, no or negative agreement.
    """
    if settings.scale_factor is not None:
        return settings.scale_factor, 0.5, f"guided, s_f = {settings.scale_factor:g} as set"
    ring = known & scipy.ndimage.binary_dilation(hole, iterations=settings.ring) & np.isfinite(prior)
    pairs = []
    k = settings.gradient_step
    for near, far in ((np.s_[:, :-k], np.s_[:, k:]), (np.s_[:-k], np.s_[k:])):
        both = ring[near] & ring[far]
        pairs.append(np.stack([(prior[far] - prior[near])[both], (disparity[far] - disparity[near])[both]]))
    m, d = np.concatenate(pairs, axis=1).astype(np.float64)
    if len(m) < settings.minimum_ring:
        return 0.0, 0.3, "harmonic: too little of the surroundings is visible to scale the prior"
    if (m**2).sum() < 1e-12 * max(1.0, float(np.nanmax(np.abs(prior[ring])) ** 2)) * len(m):
        return 0.0, 0.3, "harmonic: the prior is constant round the hole"
    scale = float((m * d).sum() / (m**2).sum())
    correlation = float((m * d).sum() / np.sqrt((m**2).sum() * max((d**2).sum(), 1e-300)))
    if scale <= 0 or correlation < settings.minimum_correlation:
        return 0.0, 0.3, f"harmonic: the prior does not fit the scene (correlation {correlation:.2f})"
    return scale, correlation, f"guided, s_f = {scale:.3g} measured on the ring (correlation {correlation:.2f})"


def background_rim(
    disparity: np.ndarray,
    known: np.ndarray,
    hole: np.ndarray,
    settings: DepthSettings,
) -> np.ndarray:
    """[H, W] bool: the known pixels that may bound the hole; rim pixels of an occluder in front are not among them.

    Neighbouring rim pixels that differ by more than a jump belong to different layers. Of two layers that meet, the
    nearer one is in front of the hole and would smear into it (METHOD section 3), unless it makes up most of the rim.
    """
    rim = known & scipy.ndimage.binary_dilation(hole, np.ones((3, 3)))
    nearest = np.where(known, disparity, -np.inf)
    farthest = np.where(known, disparity, np.inf)
    around = np.ones((3, 3), bool)
    high = scipy.ndimage.maximum_filter(nearest, footprint=around)
    low = scipy.ndimage.minimum_filter(farthest, footprint=around)
    with np.errstate(invalid="ignore", divide="ignore"):
        edge = (high - low) > settings.layer_jump * high
    layers, count = scipy.ndimage.label(rim & ~edge, np.ones((3, 3)))
    if count < 2 or not (rim & edge).any():
        return known
    dropped = np.zeros_like(known)
    sizes = scipy.ndimage.sum_labels(rim, layers, np.arange(count + 1))
    medians = scipy.ndimage.median(disparity, layers, np.arange(count + 1))
    main = medians[1 + int(np.argmax(sizes[1:]))]
    for k in range(1, count + 1):
        if medians[k] > main * (1 + settings.layer_jump) and sizes[k] < 0.4 * sizes[1:].sum():
            dropped |= layers == k
    return known & ~dropped & ~(rim & edge & (disparity > main * (1 + settings.layer_jump)))
