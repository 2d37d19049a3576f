"""The surface behind the object: completing the reference's disparity (paper 3.3, METHOD section 3)."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import cv2
import numpy as np
import scipy.ndimage

from ..errors import IllPosed
from ..solvers.poisson import solve_poisson

AROUND = np.ones((3, 3), bool)  # a pixel and its 8 neighbours


@dataclass(frozen=True)
class DepthSettings:
    """Lengths in pixels; differences of disparity are relative to the disparity itself."""

    surface: str = "auto"  # "auto": planes where the ring shows them, else harmonic; "planar", "harmonic" insist
    plane_ring: int = 24  # width of the ring on which planes are sought
    plane_inlier: float = 0.008  # difference up to which a ring pixel lies on a plane
    plane_share: float = 0.65  # of the ring that must lie on planes
    most_planes: int = 3  # a floor and two walls
    least_plane: float = 0.08  # share of the ring that a plane must hold
    plane_tries: int = 256  # RANSAC samples per plane
    junction: float = 0.95  # share of two planes' ring pixels that max or min must explain for them to meet
    least_layer: float = 0.1  # share of the rim that what is on no plane must hold to reach into the hole
    scale_factor: float | None = None  # s_f; None: measured on the ring. The paper uses 0.1
    ring: int = 12  # width of the ring on which s_f is measured
    gradient_step: int = 6  # differences over this distance suffer least from a prior's noise (research, K2)
    minimum_ring: int = 10  # ring pixels below which nothing can be measured
    minimum_correlation: float = 0.2  # between the prior's and the scene's gradients
    smoothing: float = 12.0  # σ of the average of what the ring deviates from a plane
    layer_jump: float = 0.06  # step on the rim that parts two layers
    layer_band: int = 4  # width of the ring on which layers are told apart
    occluder_share: float = 0.25  # of the rim, at most, is taken for occluders; more is what the object stood on
    low: float = 0.25  # completed disparities are clamped to [low · ring's least, high · ring's greatest]
    high: float = 4.0


@dataclass(frozen=True)
class DepthCompletion:
    """A completed disparity map."""

    disparity: np.ndarray  # [H, W] float32; 0 = infinitely far or nothing
    depth: np.ndarray  # [H, W] float32 z-depth; 0 where disparity is 0
    scale_factor: float  # s_f used; 0 = no guidance
    clamped: int  # pixels whose disparity had to be clamped
    confidence: float  # 0 to 1
    reason: str


def complete_disparity(
    disparity: np.ndarray,  # [H, W] float32, 1/z of the scene, valid where `known`; 0 = infinitely far (sky)
    known: np.ndarray,  # [H, W] bool, Dirichlet pixels
    hole: np.ndarray,  # [H, W] bool, the target region T
    prior: np.ndarray | None = None,  # [H, W] float32 relative disparity, any scale and shift
    settings: DepthSettings = DepthSettings(),
) -> DepthCompletion:
    """Fill a hole in a disparity map in the gradient domain (paper 3.3).

    Solves Δd = s_f Δd_m on the hole with d fixed on its known rim and natural boundaries elsewhere; the
    printed divergence has the opposite sign (METHOD section 3). Without a prior, planes on which the
    surroundings lie are continued (`planar_surfaces`) and the rest is harmonic. Nothing smears across layers:
    rims of occluders are no boundary (`background_rim`), and sky keeps a part of the hole to itself.
    Known pixels that are NaN, infinite or negative are not known. A part of the hole that has no rim takes the
    prior, aligned to the ring, or the nearest depth.

    Raises
    ------
    IllPosed
        If the hole has no known rim at all and no prior that fits what is known; or if planes were insisted
        on and there are none.
    """
    with np.errstate(invalid="ignore"):
        trusted = known & ~hole & np.isfinite(disparity) & (disparity >= 0)
    scene = np.where(trusted, disparity, 0.0).astype(np.float64)
    if not hole.any():
        return _completion(scene, 0.0, 0, 1.0, "nothing to fill")
    anchored = bool((trusted & scipy.ndimage.binary_dilation(hole)).any())
    window = _window(hole, settings.plane_ring + 1) if anchored else np.s_[:, :]
    background, inside = scene[window], hole[window]
    rim = background_rim(background, trusted[window], inside, settings)
    fit, guidance = PriorFit(0.0, 0.0, 0.7, "harmonic"), None
    surfaces: tuple[Surface, ...] = ()
    if prior is not None:
        fit = fit_prior(background, rim, inside, prior[window], settings, on_ring=anchored)
        guidance = fit.scale * prior[window] + fit.shift if fit.scale else None
    elif anchored and settings.surface != "harmonic":
        planar = planar_surfaces(background, rim, inside, settings)
        if planar.share >= settings.plane_share:
            fit, surfaces = PriorFit(0.0, 0.0, planar.share, planar.reason), planar.surfaces
        elif settings.surface == "planar":
            raise IllPosed(f"depth: only {planar.share:.0%} of the surroundings lie on planes; use --depth-prior auto")
    if not anchored and guidance is None:
        raise IllPosed("depth: the hole has no rim of known depth; choose a reference that shows more surroundings")
    filled = _fill(background, rim, inside, surfaces, guidance, settings)
    filled, clamped, confidence, reason = _settle(filled, background, rim, inside, fit, settings)
    scene[window] = np.where(inside, filled, background)
    return _completion(scene, fit.scale, clamped, confidence, reason)


@dataclass(frozen=True)
class PriorFit:
    """How a relative prior turns into the scene's disparity: scale · prior + shift. Scale 0: not at all."""

    scale: float  # s_f
    shift: float  # matters only where the hole has no rim
    confidence: float
    reason: str


def fit_prior(
    disparity: np.ndarray,  # [H, W]
    known: np.ndarray,  # [H, W] bool
    hole: np.ndarray,  # [H, W] bool
    prior: np.ndarray,  # [H, W] relative disparity
    settings: DepthSettings = DepthSettings(),
    on_ring: bool = True,  # else on everything known
) -> PriorFit:
    """Measure s_f by least squares between gradients on the ring (METHOD section 3).

    Mean gradients are left out: a slope is harmonic, so it needs no prior and says nothing about one. With a noisy
    prior the best s_f is below the true gain, which is what least squares gives. 0 where the prior says nothing: too
    few pixels, no variance, no or negative agreement.
    """
    ring = known & (disparity > 0) & np.isfinite(prior)
    if on_ring:
        ring &= _distance(hole) <= settings.ring
    k, pairs = settings.gradient_step, []
    for near, far in ((np.s_[:, :-k], np.s_[:, k:]), (np.s_[:-k], np.s_[k:])):
        both = ring[near] & ring[far]
        if both.any():
            steps = np.stack([(prior[far] - prior[near])[both], (disparity[far] - disparity[near])[both]])
            pairs.append(steps - steps.mean(axis=1, keepdims=True))
    m, d = np.concatenate([np.zeros((2, 0)), *pairs], axis=1)
    if len(m) < settings.minimum_ring:
        return PriorFit(0.0, 0.0, 0.3, "harmonic: too little is known round the hole to scale the prior")

    def fitted(scale: float, confidence: float, reason: str) -> PriorFit:
        return PriorFit(scale, float(np.median((disparity - scale * prior)[ring])), confidence, reason)

    if settings.scale_factor is not None:
        return fitted(settings.scale_factor, 0.5, f"guided, s_f = {settings.scale_factor:g} as set")
    if (m**2).mean() < 1e-12 * max(float(np.abs(prior[ring]).max()) ** 2, 1e-300):
        return PriorFit(0.0, 0.0, 0.3, "harmonic: the prior is constant round the hole")
    scale = float((m * d).sum() / (m**2).sum())
    correlation = float((m * d).sum() / np.sqrt((m**2).sum() * max((d**2).sum(), 1e-300)))
    if correlation < settings.minimum_correlation:
        reason = f"harmonic: the prior does not fit the scene (correlation {correlation:.2f})"
        return PriorFit(0.0, 0.0, 0.3, reason)
    words = f"guided, s_f = {scale:.3g} measured on the ring (correlation {correlation:.2f})"
    return fitted(scale, correlation, words)


def background_rim(
    disparity: np.ndarray,  # [H, W]
    known: np.ndarray,  # [H, W] bool
    hole: np.ndarray,  # [H, W] bool
    settings: DepthSettings = DepthSettings(),
) -> np.ndarray:
    """[H, W] bool: the known pixels that may bound the hole, that is, not those of occluders in front of it.

    Layers are the parts of the band round the hole between jumps. Taken from the farthest on, those that together make
    up most of the rim are what the hole lies in; nearer ones that end at a jump are occluders, behind which the others
    go on (METHOD section 3).
    Surfaces that meet, as a floor and a wall, have no jump between them, however steep.
    """
    distance = _distance(hole)
    band = known & (distance <= settings.layer_band)
    jumps = _jumps(disparity, known, band, settings.layer_jump)
    layers, count = scipy.ndimage.label(band & ~jumps, AROUND)
    if count < 2 or not jumps.any():
        return known
    numbers = np.arange(1, count + 1)
    sizes = scipy.ndimage.sum_labels(distance < 2, layers, numbers)
    heights = scipy.ndimage.median(disparity, layers, numbers)
    beside_jump = np.isin(numbers, layers[scipy.ndimage.binary_dilation(jumps, AROUND)])
    far_first = np.argsort(heights)
    reached = np.cumsum(sizes[far_first])
    background = heights[far_first][np.searchsorted(reached, (1 - settings.occluder_share) * reached[-1])]
    nearer = (1 + settings.layer_jump) * background
    occluder = beside_jump & (heights > nearer)
    front = np.isin(layers, numbers[occluder])
    # Of the step's own pixels, those on its upper half belong to the occluder.
    top = scipy.ndimage.maximum_filter(np.where(known, disparity, -np.inf), 5)
    bottom = scipy.ndimage.minimum_filter(np.where(known, disparity, np.inf), 5)
    with np.errstate(invalid="ignore"):
        upper = disparity > (top + bottom) / 2
    edge = jumps & scipy.ndimage.binary_dilation(front, AROUND, iterations=2) & upper
    return known & ~front & ~edge


def _jumps(disparity: np.ndarray, known: np.ndarray, band: np.ndarray, threshold: float) -> np.ndarray:
    """[H, W] bool: pixels of the band within 2 px of a step.

    The measure is the second difference over ±2 px, which is 0 on planes at any slant and the step's height at a
    step, also one blurred over a pixel or two.
    """
    padded = np.pad(np.where(known, disparity, np.nan), 2, constant_values=np.nan)
    h, w = disparity.shape
    found = np.zeros(disparity.shape, bool)
    with np.errstate(invalid="ignore"):
        for dy, dx in ((0, 2), (2, 0), (2, 2), (2, -2)):
            after = padded[2 + dy : 2 + dy + h, 2 + dx : 2 + dx + w]
            before = padded[2 - dy : 2 - dy + h, 2 - dx : 2 - dx + w]
            found |= np.abs(before + after - 2 * disparity) > threshold * np.maximum(before, after)
    return found & band


@dataclass(frozen=True)
class Surface:
    """A part of the background that planes describe: one, or some that meet in a line."""

    disparity: np.ndarray  # [H, W] float64, continued over the whole image
    on: np.ndarray  # [H, W] bool, the ring's pixels on it
    planes: int = 1


@dataclass(frozen=True)
class PlanarSurfaces:
    """What of the hole's surroundings is planar."""

    surfaces: tuple[Surface, ...]
    share: float  # of the ring that lies on them
    reason: str


def planar_surfaces(
    disparity: np.ndarray,  # [H, W]; 0 = sky
    known: np.ndarray,  # [H, W] bool
    hole: np.ndarray,  # [H, W] bool
    settings: DepthSettings = DepthSettings(),
) -> PlanarSurfaces:
    """The planes d = a·u + b·v + c on which the ring round the hole lies, largest first; sky is the plane d = 0.

    A plane in space is exactly affine in disparity, whatever the camera. Sequential RANSAC (Fischler & Bolles
    1981) with a fixed seed, each plane refined by least squares. Only planes that touch the hole count. Two that
    the ring shows to meet become one surface: the nearer one where they are concave (a room seen from inside:
    max of disparities), the farther where convex (min).
    """
    distance = _distance(hole)
    ring = known & (distance <= settings.plane_ring)
    rim = known & (distance < 2)
    sky = ring & (disparity == 0)
    left = ring & ~sky
    rng = np.random.default_rng(0)
    found = [Surface(np.zeros(hole.shape), sky)] if sky.any() else []
    for _ in range(settings.most_planes):
        plane = _largest_plane(disparity, left, settings, rng)
        if plane is None:
            break
        near = left & (np.abs(plane - disparity) < settings.plane_inlier * disparity)
        # Where a plane merely cuts through rough ground, its inliers are scattered.
        inliers, candidates = (cv2.boxFilter(a.astype(np.float32), -1, (7, 7)) for a in (near, left))
        on = near & (inliers > 0.6 * candidates)
        left &= ~near
        if on.sum() < settings.least_plane * ring.sum():
            break
        found.append(Surface(plane, on))
    share = float(sum(s.on.sum() for s in found) / max(1, ring.sum()))
    planes = sum(s.disparity.any() for s in found)
    reason = f"planar: {share:.0%} of the surroundings lie on {planes} plane{'s' if planes != 1 else ''}"
    touching = [s for s in found if (s.on & rim).sum() > 0.03 * rim.sum()]
    return PlanarSurfaces(tuple(_joined(touching, settings)), share, reason)


def _largest_plane(
    disparity: np.ndarray, ring: np.ndarray, settings: DepthSettings, rng: np.random.Generator
) -> np.ndarray | None:
    """The plane [H, W] that most ring pixels lie on."""
    rows, cols = np.nonzero(ring)
    if len(rows) < max(3, settings.minimum_ring):
        return None
    # Divided by d, residuals are relative.
    d = disparity[rows, cols]
    points = np.stack([cols, rows, np.ones(len(rows))], -1) / d[:, None]
    samples = rng.integers(0, len(rows), (settings.plane_tries, 3))
    solvable = np.abs(np.linalg.det(points[samples] * d[samples][..., None])) > 1.0  # not three pixels in a line
    if not solvable.any():
        return None
    candidates = np.linalg.solve(points[samples[solvable]], np.ones((solvable.sum(), 3, 1)))[..., 0]
    thinned = points[:: max(1, len(points) // 2000)]
    votes = (np.abs(thinned @ candidates.T - 1) < settings.plane_inlier).sum(0)
    best = candidates[int(votes.argmax())]
    for _ in range(3):
        on = np.abs(points @ best - 1) < settings.plane_inlier
        if on.sum() < 3:
            return None
        best = np.linalg.lstsq(points[on], np.ones(on.sum()), rcond=None)[0]
    v, u = np.mgrid[: ring.shape[0], : ring.shape[1]]
    return best[0] * u + best[1] * v + best[2]


def _joined(surfaces: list[Surface], settings: DepthSettings) -> list[Surface]:
    """The surfaces, with those that meet made one."""
    for a, b in combinations(surfaces, 2):
        for meet in (np.maximum, np.minimum):
            joint = meet(a.disparity, b.disparity)
            kept = [
                (np.abs(joint - s.disparity) <= settings.plane_inlier * np.abs(s.disparity))[s.on].mean()
                for s in (a, b)
            ]
            if min(kept) >= settings.junction:
                others = [s for s in surfaces if s is not a and s is not b]
                return _joined([Surface(joint, a.on | b.on, a.planes + b.planes), *others], settings)
    return surfaces


def _fill(
    disparity: np.ndarray,
    rim: np.ndarray,
    hole: np.ndarray,
    surfaces: tuple[Surface, ...],
    guidance: np.ndarray | None,
    settings: DepthSettings,
) -> np.ndarray:
    """Disparity [H, W] float64 of the hole, NaN where nothing says anything.

    Each surface, and what of the rim is on none, gets the part of the hole where the harmonic extension of its share
    of the rim is largest.
    """
    rim = rim & scipy.ndimage.binary_dilation(hole)
    sky = rim & (disparity == 0)
    if not surfaces and sky.any():
        surfaces = (Surface(np.zeros(hole.shape), sky),)
    loose = len(surfaces)
    layer = _layers(disparity, rim, surfaces, settings)
    present = np.unique(layer[layer >= 0])
    part = np.full(hole.shape, present[0] if len(present) else loose)
    if len(present) > 1:
        votes = solve_poisson(hole, layer >= 0, (layer[..., None] == present).astype(np.float64)).values
        part = present[np.nan_to_num(votes).argmax(-1)]
    rest = hole & (part == loose)
    filled = np.where(rest, solve_poisson(rest, layer == loose, disparity, guidance).values, np.nan)
    for k, surface in enumerate(surfaces):
        own = hole & (part == k)
        filled[own] = (surface.disparity + _deviation(disparity, surface, own, layer == k, settings))[own]
    return filled


def _layers(
    disparity: np.ndarray, rim: np.ndarray, surfaces: tuple[Surface, ...], settings: DepthSettings
) -> np.ndarray:
    """[H, W] int: the surface on which each rim pixel lies, len(surfaces) for none, −1 off the rim."""
    layer = np.where(rim, len(surfaces), -1)
    for k, surface in reversed(list(enumerate(surfaces))):
        step = settings.layer_jump * np.maximum(disparity, surface.disparity)
        layer[rim & (np.abs(disparity - surface.disparity) <= step)] = k
    if surfaces and (layer == len(surfaces)).sum() < settings.least_layer * rim.sum():
        layer[layer == len(surfaces)] = -1
    return layer


def _deviation(
    disparity: np.ndarray, surface: Surface, own: np.ndarray, rim: np.ndarray, settings: DepthSettings
) -> np.ndarray:
    """[H, W]: what the ring deviates from the surface, averaged along it and extended harmonically into the hole.

    The pixels that touch the hole are biased by the object's haze: averaging over the whole ring is 4 to 6 times as
    accurate as meeting them exactly, measured on scenes with known truth.
    """
    known = surface.on.astype(np.float64)
    weight = cv2.GaussianBlur(known, (0, 0), settings.smoothing)
    total = cv2.GaussianBlur(known * (disparity - surface.disparity), (0, 0), settings.smoothing)
    average = np.divide(total, weight, out=np.zeros_like(total), where=weight > 0.01)
    return np.nan_to_num(solve_poisson(own, rim & (weight > 0.01), average).values)


def _settle(
    filled: np.ndarray,
    disparity: np.ndarray,
    rim: np.ndarray,
    hole: np.ndarray,
    fit: PriorFit,
    settings: DepthSettings,
) -> tuple[np.ndarray, int, float, str]:
    """Every pixel decided and kept to the ring's range: (disparity, pixels clamped, confidence, reason)."""
    confidence, reason = fit.confidence, fit.reason
    undecided = hole & ~np.isfinite(filled)
    if undecided.any():
        nearest = scipy.ndimage.distance_transform_edt(~rim, return_distances=False, return_indices=True)
        filled = np.where(undecided, disparity[tuple(nearest)], filled)
        confidence, reason = min(confidence, 0.3), f"{reason}; a part of the hole has no rim: nearest depth used"
    ring = rim & (_distance(hole) <= settings.layer_band)
    around = disparity[ring if ring.any() else rim]
    finite = around[around > 0]
    low, high = (settings.low * finite.min(), settings.high * finite.max()) if len(finite) else (0.0, 0.0)
    if (around == 0).any():  # where the ring shows sky, so far means infinitely far
        filled = np.where(filled < low, 0.0, filled)
        low = 0.0
    clamped = int((hole & ((filled < low) | (filled > high))).sum())
    if clamped > 0.05 * hole.sum():
        confidence, reason = 0.5 * confidence, f"{reason}; {clamped} pixels clamped to the ring's range"
    return np.clip(filled, low, high), clamped, confidence, reason


def _completion(disparity: np.ndarray, scale: float, clamped: int, confidence: float, reason: str) -> DepthCompletion:
    disparity = disparity.astype(np.float32)
    depth = np.divide(1, disparity, out=np.zeros_like(disparity), where=disparity > 0)
    return DepthCompletion(disparity, depth, scale, clamped, confidence, reason)


def _window(hole: np.ndarray, margin: int) -> tuple[slice, slice]:
    """The hole's bounding box and what is round it."""
    rows, cols = np.flatnonzero(hole.any(1)), np.flatnonzero(hole.any(0))
    return (
        slice(max(rows[0] - margin, 0), rows[-1] + margin + 1),
        slice(max(cols[0] - margin, 0), cols[-1] + margin + 1),
    )


def _distance(hole: np.ndarray) -> np.ndarray:
    """[H, W] float32: distance to the hole in pixels, 0 inside."""
    return cv2.distanceTransform((~hole).astype(np.uint8), cv2.DIST_L2, 5)
