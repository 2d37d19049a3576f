"""Measures the SH fit: accuracy inside and outside the cone of views on simulated materials beside other rules,
and what bad observations do.

As in the project's first measurements of SH fits: three materials, noise, and wrong observations; grey, so that the
three channels carry no more than one. Writes OUT/harmonics.json and OUT/harmonics.md. Run by `make bench-harmonics`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from gimp3d.solvers.harmonics import HarmonicsSettings, Observations, fit_harmonics, sh_basis

from .command import parser_of, say, told_in_one_line, write_results
from .tables import Row, Section, markdown, mean, values, where
from .timing import about, machine

MATERIALS = ("Lambertian", "smooth", "specular")
BASE = 0.4  # colour without the material's own
NOISE, ANCHOR_NOISE, WRONG = 0.02, 0.01, 0.3  # standard deviations, and by how much a wrong observation is off
SCORED = 40  # directions that a fit is scored in, inside and outside the cone
FLOOR = 0.2  # of our ridge, where colours have noise alone
PAPER_SIGMA = 0.1  # σ_0 of the rules that fit_harmonics is compared with, as they were first measured
LAPLACE = np.repeat([1.0, 9.0, 36.0], [3, 5, 7])  # (l (l + 1) / 2)² per coefficient
SEEDS = (100, 101)  # not those on which the constants of the fit were chosen


# Numbers of views, half angles of the cone (degrees), and simulated Gaussians per material
FULL, QUICK = ((5, 10, 30, 100), (10, 30, 90), 300), ((5, 30), (10, 90), 40)


def main() -> None:
    given = parser_of(__doc__, "harmonics", quick="less of everything, in seconds").parse_args()
    plan = QUICK if given.quick else FULL
    results: Row = {"quick": given.quick, "machine": machine()}
    results["accuracy"] = list(accuracy(*plan))
    results["stability"] = list(stability(plan[-1]))
    words = markdown("Fitting spherical harmonics", about(results["machine"]), sections(results))
    write_results(given.out, "harmonics", results, words)


# ------------------------------------------------------------------------------------------------------- what is fitted


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
    colours = exposure * material(kinds, towards, highlights)
    colours[:, ::3] *= jump
    colours += NOISE * rng.normal(size=colours.shape)
    off = rng.random(colours.shape) < wrong
    colours[off] += rng.choice([-WRONG, WRONG], int(off.sum()))
    wide = {"inside": half_angle, "outside": min(2 * half_angle, math.pi), "all round": math.pi}
    places = {name: cone(rng, n, SCORED, angle, axis) for name, angle in wide.items()}
    anchors = material(kinds, reference[:, None], highlights)[:, 0] + ANCHOR_NOISE * rng.normal(size=n)
    scored = {name: (d, material(kinds, d, highlights)) for name, d in places.items()}
    return Simulation(kinds, anchors, reference, towards, colours, scored)


def cone(rng: np.random.Generator, n: int, views: int, half_angle: float, axis: np.ndarray) -> np.ndarray:
    """[n, views, 3] directions, uniform within `half_angle` of the axis."""
    cosine = 1 - rng.random((n, views)) * (1 - math.cos(half_angle))
    turn, sine = rng.random((n, views)) * 2 * math.pi, np.sqrt(np.maximum(1 - cosine**2, 0))
    u = np.cross(axis, [0.3, 1.0, 0.2])
    u /= np.linalg.norm(u)
    frame = np.stack([u, np.cross(axis, u), axis])
    return np.stack([sine * np.cos(turn), sine * np.sin(turn), cosine], -1) @ frame


def material(kinds: np.ndarray, directions: np.ndarray, highlights: np.ndarray) -> np.ndarray:
    """Each Gaussian's colour, [N, V]: constant, with a slow change, or with a highlight."""
    cosine = (directions * highlights[:, None]).sum(-1)
    slow = 0.15 * cosine + 0.08 * directions[..., 0] * directions[..., 2]
    return BASE + np.choose(kinds[:, None], [np.zeros_like(cosine), slow, 0.5 * np.exp((cosine - 1) / 0.03)])


# --------------------------------------------- rules: Simulation → coefficients [N, 15] of Y_k − Y_k(ω_0), or of
# Y_k where it is not anchored


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


def gimp3d(s: Simulation, offset: bool = False) -> np.ndarray:
    n, views = s.colours.shape
    grey = np.repeat(s.colours.reshape(-1, 1), 3, axis=1)
    observed = Observations(np.arange(n + 1) * views, s.directions.reshape(-1, 3), grey, np.ones(n * views))
    anchors = np.repeat(s.anchors[:, None], 3, axis=1)
    settings = HarmonicsSettings(offset=offset)
    return fit_harmonics(anchors, s.anchor_directions, observed, 3, settings, FLOOR).sh[:, 1:, 0]


RULES: dict[str, Callable[[Simulation], np.ndarray]] = {
    "constant": constant,
    "paper": paper,
    "ridge 1, degree 3": ridge,
    "leave-one-out": leave_one_out,
    "gimp3d": gimp3d,
    "gimp3d, offset": lambda s: gimp3d(s, offset=True),
}


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
        name: np.einsum("nvk,nk->nv", sh_basis(directions, 3)[..., 1:] - origin, found) + s.anchors[:, None] - true
        for name, (directions, true) in s.scored.items()
    }


# ------------------------------------------------------------------------------------------------------------- measured


def accuracy(counts: Sequence[int], cones: Sequence[int], each: int) -> Iterator[Row]:
    """RMSE per number of views, cone, material and rule, inside and outside the cone; 8 % of observations wrong."""
    for views in counts:
        for half_angle in cones:
            made = [simulate(views, math.radians(half_angle), seed, each) for seed in SEEDS]
            for rule in RULES:
                found = [errors_of(s, rule) for s in made]
                for kind, name in enumerate(MATERIALS):
                    row: Row = {"views": views, "cone": half_angle, "rule": rule, "material": name}
                    for place in ("inside", "outside"):
                        rms = [np.sqrt(np.mean(e[place][s.kinds == kind] ** 2)) for s, e in zip(made, found)]
                        row[place] = float(np.mean(rms))
                    yield row
    say("accuracy: done")


def stability(each: int) -> Iterator[Row]:
    """Error curves: RMSE inside the cone, and the 99th percentile of errors all round."""
    lit = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5)
    gathered = {"views": 10, "away": math.radians(45)}
    cases: dict[str, dict[float, Row]] = {
        "wrong observations": {x: {"wrong": x} for x in lit[:5]},
        "exposure jumps": {x: {"jump": 1 + x} for x in lit},
        "reference lit otherwise": {x: {"exposure": 1 - x} for x in lit},
        "views": {x: {"views": x} for x in (1, 2, 3, 5, 10, 20, 40)},
        "clustered views": {x: {**gathered, "half_angle": math.radians(x)} for x in (0.1, 0.3, 1, 3, 10, 30)},
        "two near-equal views": {x: {"views": 2, "half_angle": math.radians(x)} for x in (0.01, 0.1, 1, 3, 10, 30)},
    }
    usual = {"views": 30, "half_angle": math.radians(40), "seed": SEEDS[0], "each": each}
    for case, settings in cases.items():
        for x, changed in settings.items():
            s = simulate(**{**usual, **changed})
            for rule in RULES:
                errors = errors_of(s, rule)
                inside = float(np.sqrt(np.mean(errors["inside"] ** 2)))
                all_round = float(np.quantile(np.abs(errors["all round"]), 0.99))
                yield {"case": case, "x": x, "rule": rule, "inside": inside, "all_round": all_round}
    say("stability: done")


def sections(results: Row) -> Iterator[Section]:
    words = "RMSE inside / outside the cone of views (outside: twice as wide), colours in [0, 1], 8 % of observations "
    words += "wrong; means of the cells."
    for by in ("views", "cone", "material"):
        rows, head = results["accuracy"], values(results["accuracy"], by)
        lines = []
        for rule in RULES:
            own = where(rows, rule=rule)
            cells = [*(where(own, **{by: value}) for value in head), own]
            lines.append([rule, *(f"{mean(c, 'inside'):.4f} / {mean(c, 'outside'):.4f}" for c in cells)])
        yield Section(f"Accuracy on simulated materials by {by}", words, [by, *map(str, head), "all"], lines)
    for case in values(results["stability"], "case"):
        rows = where(results["stability"], case=case)
        lines = [
            [x, *(f"{r['inside']:.3f} / {r['all_round']:.3f}" for r in where(rows, x=x))] for x in values(rows, "x")
        ]
        words = "RMSE inside the cone / 99th percentile of errors all round."
        yield Section(f"Stability: {case}", words, [case, *values(rows, "rule")], lines)


if __name__ == "__main__":
    told_in_one_line(main)
