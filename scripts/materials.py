"""Simulated Gaussians whose colour depends on the direction, seen by views in a cone, and rules that fit them.

As in the project's first measurements of SH fits: three materials, noise, and wrong observations; grey, so that the
three channels carry no more than one.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from gimp3d.solvers.harmonics import HarmonicsSettings, Observations, fit_harmonics, sh_basis

MATERIALS = ("Lambertian", "smooth", "specular")
BASE = 0.4  # colour without the material's own
NOISE, ANCHOR_NOISE, WRONG = 0.02, 0.01, 0.3  # standard deviations, and by how much a wrong observation is off
SCORED = 40  # directions that a fit is scored in, inside and outside the cone
FLOOR = 0.2  # of our ridge, where colours have noise alone
PAPER_SIGMA = 0.1  # σ_0 of the rules that fit_harmonics is compared with, as they were first measured
LAPLACE = np.repeat([1.0, 9.0, 36.0], [3, 5, 7])  # (l (l + 1) / 2)² per coefficient


@dataclass(frozen=True)
class Simulation:
    """N Gaussians, a third of each material."""

    kinds: np.ndarray  # [N] index into MATERIALS
    anchors: np.ndarray  # [N] grey in the reference direction
    anchor_directions: np.ndarray  # [N, 3] unit
    directions: np.ndarray  # [N, V, 3]
    colours: np.ndarray  # [N, V]
    scored: dict[str, tuple[np.ndarray, np.ndarray]]  # where → directions [N, SCORED, 3], true colours [N, SCORED]


def simulate(
    views: int,
    half_angle: float,  # of the cone of directions, radians
    seed: int,
    each: int = 200,  # Gaussians per material
    wrong: float = 0.08,  # share of observations that are off by WRONG
    jump: float = 1.0,  # exposure of every third view
    exposure: float = 1.0,  # of all views, but not of the reference
    away: float | None = None,  # angle from the cone's axis to the reference; None: it lies somewhere in the cone
) -> Simulation:
    """Directions are uniform in a cone; "outside" is uniform in one twice as wide, "all round" on the sphere."""
    rng, n = np.random.default_rng(seed), each * len(MATERIALS)
    axis = rng.normal(size=3)
    axis /= np.linalg.norm(axis)
    kinds = np.repeat(np.arange(len(MATERIALS)), each)
    highlights = cone(rng, n, 1, max(half_angle, 0.2), axis)[:, 0]
    towards, reference = cone(rng, n, views, half_angle, axis), cone(rng, n, 1, half_angle, axis)[:, 0]
    if away is not None:
        aside = np.cross(axis, [0.3, 1.0, 0.2])
        aside /= np.linalg.norm(aside)
        reference = np.tile(math.cos(away) * axis + math.sin(away) * aside, (n, 1))
    true = BASE + material(kinds, towards, highlights)
    true *= exposure
    true[:, ::3] *= jump
    colours = true + NOISE * rng.normal(size=true.shape)
    off = rng.random(true.shape) < wrong
    colours[off] += rng.choice([-WRONG, WRONG], int(off.sum()))
    wide = {"inside": half_angle, "outside": min(2 * half_angle, math.pi), "all round": math.pi}
    places = {where: cone(rng, n, SCORED, angle, axis) for where, angle in wide.items()}
    return Simulation(
        kinds,
        BASE + material(kinds, reference[:, None], highlights)[:, 0] + ANCHOR_NOISE * rng.normal(size=n),
        reference,
        towards,
        colours,
        {where: (d, BASE + material(kinds, d, highlights)) for where, d in places.items()},
    )


def cone(rng: np.random.Generator, n: int, views: int, half_angle: float, axis: np.ndarray) -> np.ndarray:
    """[n, views, 3] directions, uniform within `half_angle` of the axis."""
    cosine = 1 - rng.random((n, views)) * (1 - math.cos(half_angle))
    turn, sine = rng.random((n, views)) * 2 * math.pi, np.sqrt(np.maximum(1 - cosine**2, 0))
    u = np.cross(axis, [0.3, 1.0, 0.2])
    u /= np.linalg.norm(u)
    frame = np.stack([u, np.cross(axis, u), axis])
    return np.stack([sine * np.cos(turn), sine * np.sin(turn), cosine], -1) @ frame


def material(kinds: np.ndarray, directions: np.ndarray, highlights: np.ndarray) -> np.ndarray:
    """Each Gaussian's own colour, [N, V]: none, a slow change, or a highlight."""
    cosine = (directions * highlights[:, None]).sum(-1)
    slow = 0.15 * cosine + 0.08 * directions[..., 0] * directions[..., 2]
    return np.choose(kinds[:, None], [np.zeros_like(cosine), slow, 0.5 * np.exp((cosine - 1) / 0.03)])


# Rules: Simulation → coefficients [N, 15] of Y_k − Y_k(ω_0), or of Y_k where the rule is not anchored.
Rule = Callable[[Simulation], np.ndarray]


def constant(s: Simulation) -> np.ndarray:
    return np.zeros((len(s.anchors), 15))


def paper(s: Simulation) -> np.ndarray:
    """Degree 3 without anchor or ridge (paper supplementary), by minimum-norm least squares."""
    weight = np.sqrt(paper_weights(s))[..., None]
    basis = sh_basis(s.directions, 3)[..., 1:]
    return (np.linalg.pinv(basis * weight) @ ((s.colours - s.anchors[:, None])[..., None] * weight))[..., 0]


def ridge(s: Simulation) -> np.ndarray:
    """Degree 3 with a ridge of 1 on every coefficient."""
    return weighted_fit(s, 15, np.ones(15), paper_weights(s))[0]


def leave_one_out(s: Simulation) -> np.ndarray:
    """Degree and ridge (Laplace) of least leave-one-out error, with no floor."""
    weights = paper_weights(s)
    best = (weights * (s.colours - s.anchors[:, None]) ** 2).sum(1)
    chosen = constant(s)
    for k in (3, 8, 15):
        for size in (1e-3, 1e-2, 1e-1, 1.0, 10.0):
            coefficients, errors = weighted_fit(s, k, size * LAPLACE[:k], weights)
            error = 1.02 * (weights * errors**2).sum(1)
            better = error < best
            best[better], chosen[better] = error[better], coefficients[better]
    return chosen


def gimp3d(s: Simulation, settings: HarmonicsSettings = HarmonicsSettings()) -> np.ndarray:
    return fit_harmonics(grey(s.anchors), s.anchor_directions, observations(s), 3, settings, FLOOR).sh[:, 1:, 0]


def with_offset(s: Simulation) -> np.ndarray:
    return gimp3d(s, HarmonicsSettings(offset=True))


RULES: dict[str, Rule] = {
    "constant": constant,
    "paper": paper,
    "ridge 1, degree 3": ridge,
    "leave-one-out": leave_one_out,
    "gimp3d": gimp3d,
    "gimp3d, offset": with_offset,
}


def observations(s: Simulation) -> Observations:
    n, views = s.colours.shape
    offsets = np.arange(n + 1) * views
    return Observations(offsets, s.directions.reshape(-1, 3), grey(s.colours.ravel()), np.ones(n * views))


def grey(values: np.ndarray) -> np.ndarray:
    return np.repeat(values[:, None], 3, axis=1)


def paper_weights(s: Simulation) -> np.ndarray:
    """e_ω, [N, V]."""
    scale = PAPER_SIGMA * np.exp(1 - (s.directions * s.anchor_directions[:, None]).sum(-1))
    return np.exp(-((s.colours - s.anchors[:, None]) ** 2) / (2 * scale**2))


def weighted_fit(s: Simulation, k: int, penalty: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The anchored fit of k coefficients, padded to 15, and its leave-one-out errors, in float64."""
    basis = (sh_basis(s.directions, 3) - sh_basis(s.anchor_directions, 3)[:, None])[..., 1 : k + 1]
    residuals, weighted = s.colours - s.anchors[:, None], basis * weights[..., None]
    inverse = np.linalg.inv(np.einsum("nvk,nvl->nkl", weighted, basis) + np.diag(penalty))
    found = np.einsum("nkl,nvl,nv->nk", inverse, weighted, residuals, optimize=True)
    leverage = np.einsum("nvk,nkl,nvl->nv", weighted, inverse, basis, optimize=True)
    errors = (residuals - np.einsum("nvk,nk->nv", basis, found)) / np.maximum(1 - leverage, 1e-3)
    return np.pad(found, ((0, 0), (0, 15 - k))), errors


def errors_of(s: Simulation, rule: str) -> dict[str, np.ndarray]:
    """A rule's colour errors [N, SCORED] by place."""
    found = RULES[rule](s)
    origin = 0.0 if rule == "paper" else sh_basis(s.anchor_directions, 3)[:, None, 1:]
    return {
        where: np.einsum("nvk,nk->nv", sh_basis(directions, 3)[..., 1:] - origin, found) + s.anchors[:, None] - true
        for where, (directions, true) in s.scored.items()
    }
