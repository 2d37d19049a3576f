"""What each rule is worth: one at a time is switched off, in whole removals of scenes with truth, made and real.

    python -m benchmarks.ablation [DATA] [--scenes a,b] [--rules WORD …] [--picture given built-in]

A rule is a dotted setting of `RemovalSettings` or `module:NAME`, a constant or function of the module that uses it; it
is looked up only when its row runs, and a name that is gone fills the row with a clear line. (What a kernel reads is
frozen when it is compiled: such a constant cannot be switched here.) Finished cells lie in OUT/cells.json, so a stopped
run goes on; delete it after a change to the core. Writes OUT/ablation.md. Run by `make bench-ablation`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, fields, is_dataclass, replace
from importlib import import_module
from typing import Any

import numpy as np

from gimp3d.errors import BadInput, IllPosed
from gimp3d.gaussians import ARRAYS
from gimp3d.pipeline import PRESETS, RemovalSettings
from gimp3d.solvers.edges import ABOVE, BELOW, LEAST, REACH
from gimp3d.solvers.exemplar import EDGE
from gimp3d.stages.beside import Shown
from gimp3d.stages.charts import Chart, Plane, Surface, find
from gimp3d.stages.charts.find import MOST_SCATTER
from gimp3d.stages.charts.lay import flat_surface
from gimp3d.stages.witness import Says

from .command import kept, parser_of, say, told_in_one_line, write
from .scenes import BUILT_IN, GIVEN, MADE, MASKS, REAL, Scene, filled, mean_psnrs, new_gaussians, read_scenes, removal
from .tables import Row, Section, markdown
from .timing import Watch, about, machine, replaced

SCENES = (*MADE, "desk_shadow", "corner_shadow", *REAL)
PRESET = "balanced"
Switch = tuple[str, Any]  # what, and its value when the rule is off


@dataclass(frozen=True)
class Around:
    """A function that is made of the one that it stands for."""

    make: Callable[[Any], Any]


def _by_depth_alone(witness: Any, _: Any, hits: Any) -> np.ndarray:
    return (hits.depth > 0) & (np.abs(witness.depth - hits.depth) < 0.05 * hits.depth)


def _all_alike(shown_beside: Any) -> Any:
    def shown(*of: Any) -> Any:
        found = shown_beside(*of)
        return found._replace(alike=found.beside)

    return shown


def _scatter_of_all(points: np.ndarray, witnesses: Any) -> float:
    off = np.abs(find._depths_off(points, witnesses))
    return min(MOST_SCATTER, find.SCATTER * float(np.median(off))) if len(off) else 0.0


def _hides_from_more(said: np.ndarray) -> np.ndarray:
    return np.asarray((said == Says.HIDDEN).sum(0) > (said == Says.SEEN).sum(0))


def _hidden_by_none_else(unseen: Callable[..., np.ndarray]) -> Callable[..., np.ndarray]:
    return lambda said: unseen(said) & ((said == Says.HIDDEN).sum(0) > (said == Says.BEHIND).sum(0))


def _led_nowhere(parted: Callable[..., list[Chart]]) -> Callable[..., list[Chart]]:
    def of(drawn: Sequence[tuple[Chart, np.ndarray]], witnesses: Any) -> list[Chart]:
        blind = [(replace(c, plane=replace(c.plane, told=None)), spread) for c, spread in drawn]
        return [replace(c, plane=own.plane) for c, (own, _) in zip(parted(blind, witnesses), drawn)]

    return of


def _little_known(beyond: np.ndarray) -> bool:
    return min(beyond[rows, ..., 0].sum() for rows in (ABOVE, BELOW)) < 2 * LEAST


def _no_chart(to_paint: Any) -> Any:
    def paint(view: Any, completed: Any, scene: Any) -> Any:
        return to_paint(view, replace(completed, camera=replace(completed.camera, id="")), scene)

    return paint


def _none_both(shown: Shown) -> Shown:
    return shown._replace(both=np.zeros_like(shown.both))


def _placed_anywhere(placed: Callable[..., Surface | None]) -> Callable[..., Surface | None]:
    def by(plane: Plane, *given: Any, **named: Any) -> Surface | None:
        found = placed(replace(plane, told=None), *given, **named)
        return found and replace(found, plane=plane)

    return by


ALL_ZERO = Around(lambda rates: dict.fromkeys(rates, 0.0))
BY_PLACE_ALONE = Around(lambda besides: lambda surface, bent: besides(surface, bent)[:, : 5 if bent else 2])
RULES: dict[str, tuple[Switch, ...]] = {
    # what is object, where is filled, from which surface
    "no further references": (("extra_references", 0),),
    "no charts: targets and references as the paper's": (("masks.mode", "paper"), ("charts", None)),
    "what has its centre in the box is the object": (("masks.selection.by_centre", True),),
    "an edge beside the box ends what is round it": (
        ("gimp3d.stages.surroundings:_tops", lambda over, *_: np.zeros_like(over)),
    ),
    "smears that only the removal reveals stay": (("masks.selection.support", 0.0),),
    "planes are settled all round the object": (
        ("gimp3d.stages.charts.find:OWN", 10**9),
        ("gimp3d.stages.charts.find:ONE_SIDED", 2.0),
    ),
    "planes are settled by pixels of other planes, too": (("gimp3d.stages.charts.find:SHARED", 0),),
    "planes stay on which photos agree far less than where splats draw them": (
        ("gimp3d.stages.charts.find:MADE_UP", 0.0),
    ),
    "planes are settled where views see through them, too": (
        ("gimp3d.stages.charts.find:depth_scatter", lambda *_: np.inf),
    ),
    "a plane must hold a tenth of what is round the object": (("charts.least", 0.1),),
    "views' agreement asks no more of photos": (("gimp3d.stages.masks:USUAL_AGREEMENT", 0.0),),
    "no haze is cleared": (("gimp3d.stages.clearing:HAZE_WEIGHT", math.inf),),
    "half of a Gaussian is to be seen in a photo": (("clearing.observed", 0.5),),
    "a tenth of it is": (("clearing.observed", 0.1),),
    "colours do not tell the object from what is beside it": (
        (
            "gimp3d.steps.behind:shown_beside",
            lambda scene, *_: Shown(*np.zeros((4, len(scene)), bool), np.zeros(len(scene)), []),
        ),
    ),
    "Gaussians that are both are taken or left whole": (
        ("gimp3d.steps.behind:shown_beside", Around(lambda shown: lambda *p: _none_both(shown(*p)))),
    ),
    "what was left is not asked": (("gimp3d.steps.behind:LEFT", ()),),
    "photos do not tell each other": (("gimp3d.stages.beside:ROUNDS", (2,)),),
    "what a cut takes off may lie apart from what it began from": (
        ("gimp3d.stages.beside:_begun", lambda cut, _: cut),
    ),
    "photos are cut at their own size": (("gimp3d.stages.beside:ROUNDS", (1, 1)),),
    "what photos show beside the object may be a foot, whatever its colours": (
        ("gimp3d.steps.behind:shown_beside", Around(_all_alike)),
    ),
    "a twentieth of a Gaussian may be shown as the object": (("gimp3d.stages.beside:LEAST", 0.05),),
    "a quarter of a Gaussian may be shown as the object": (("gimp3d.stages.beside:LEAST", 0.25),),
    "charts take colours where a foot may be": (
        ("gimp3d.steps.behind:over_surfaces", Around(lambda over: lambda *p: (over(*p)[0], np.ones(len(p[0]), bool)))),
    ),
    "a texel that no photo shows is a hole": (("gimp3d.stages.charts:specks", np.zeros_like),),
    "a chart paints what z-tests take for it, though another one is met there": (
        ("gimp3d.steps.references:_to_paint", Around(_no_chart)),
    ),
    "colours of the object are pure": (("gimp3d.stages.charts:LEAST_SHARE", 1.0),),
    "textures may not be misplaced": (("gimp3d.stages.charts:MISPLACED", 0.0),),
    "what the object hides lies on planes": (
        (
            "gimp3d.stages.charts:places_drawn",
            lambda plane, half, n, *_: flat_surface(plane, plane.origin, np.full(2, 2 * half), 2 * half / n).points(),
        ),
    ),
    "photos count that show what stands before a surface": (
        (
            "gimp3d.stages.charts.find:_free",
            lambda points, textures: np.ones((len(points), len(textures.cameras)), bool),
        ),
    ),
    "planes are sought at any distance": (("gimp3d.stages.charts.find:_sought", lambda _: True),),
    "what stands before a surface tells how it scatters": tuple(
        (f"gimp3d.stages.{module}:depth_scatter", _scatter_of_all) for module in ("charts", "charts.find")
    ),
    "the object hides what other things stand before": (("gimp3d.stages.charts:_hides_from_most", _hides_from_more),),
    "what mostly other things hide is no hole": (("gimp3d.stages.charts:_unseen", Around(_hidden_by_none_else)),),
    "what is hidden of a plane lies anywhere on it": (("gimp3d.stages.charts:_placed", Around(_placed_anywhere)),),
    "a chart goes as far as the object hides anything": (("gimp3d.stages.charts:TRIMMED", (0.0,)),),
    "what lies on other planes tells of a relief, too": (
        ("gimp3d.stages.charts.lay:_drawn_surface", Around(lambda drawn: lambda *p: drawn(*p[:4]))),
    ),
    "depths of another surface tell how they scatter": (("gimp3d.stages.charts:MOST_SCATTER", -1.0),),
    "a surface begins anew where it goes through another": (
        ("gimp3d.stages.charts:_shown", Around(lambda shown: lambda *p: shown(*p[:4], np.ones_like(p[4])))),
    ),
    "surfaces too close for rough depths are all there": (
        ("gimp3d.stages.charts:_parted", lambda drawn, _: [chart for chart, _ in drawn]),
    ),
    "of two close surfaces either has islands": (("gimp3d.stages.charts:_parted", Around(_led_nowhere)),),
    "one photo tells that the surface ends": (
        ("gimp3d.stages.charts:_through", lambda said: (said == Says.THROUGH).sum(0)),
    ),
    # what stays round it
    "what stays learns nothing": (("gimp3d.steps.behind:SHOWN", math.inf),),
    "charts teach what stays nothing": (("gimp3d.steps.behind:WRONG", math.inf),),
    "shapes of what stays learn too": (("gimp3d.steps.behind:LEARNED", ARRAYS),),
    "what draws other places more learns too": (("gimp3d.steps.behind:SHARE", 0.0),),
    "what is drawn before new Gaussians keeps its colours": (("gimp3d.steps.behind:VISIBLE", math.inf),),
    # into the other views
    "the paper's sampling": (("propagate.transfer", "sample"),),
    "the paper's blend": (("propagate.blend", "rim"),),
    "the paper's sampling and its blend": (("propagate.transfer", "sample"), ("propagate.blend", "rim")),
    "photo of places that no photo shows tells of light": (
        (
            "gimp3d.stages.propagate:_painted",
            Around(lambda painted: lambda r, *p: painted(replace(r, source=r.source | r.target), *p)),
        ),
    ),
    "light differs by as much all round the hole": (("gimp3d.stages.propagate.blend:TOLERANCES", (1.0,)),),
    "the fill is as sharp as photos": (("gimp3d.stages.propagate.detail:BLURS", ()),),
    "the fill keeps the colours of its reference": (("gimp3d.stages.propagate.blend:TELLING", 1e9),),
    "what goes with colour on one side goes so on all": (("gimp3d.stages.propagate.blend:_trust", lambda *_: 1.0),),
    "depth seams do not stop the blend": (("gimp3d.stages.propagate.blend:SEAM", 1e9),),
    # new Gaussians
    "one Gaussian per pixel": (("seed.largest", 1),),
    "colours as seeded": (("seed.corrections", 0),),
    "no view dependence": (("seed.sh_degree", 0),),
    "only photos tell view dependence": (("gimp3d.steps.references:views_between", lambda *_: ()),),
    "degree 1": (("seed.sh_degree", 1),),
    "degree 3": (("seed.sh_degree", 3),),
    "Gaussians that show nowhere stay": (("gimp3d.stages.seed:NEEDED", -1.0),),
    "not refined": (("refine.steps", 0),),
    "refined by L1 alone": (("gimp3d.stages.refine:SSIM", 0.0),),
    "colours alone are refined": (("gimp3d.stages.refine:RATES", ALL_ZERO),),
    # the fill
    "nothing is taken for regular": (("gimp3d.solvers.exemplar:find_motions", lambda *_: ()),),
    "halves of edges do not meet on a line": (("gimp3d.solvers.edges:_straight", lambda *_: None),),
    "no edge turns a corner, nor ends unseen": (("gimp3d.solvers.edges:_joined", lambda *_: []),),
    "no edge is bent": (("gimp3d.solvers.edges:_curve", lambda *_: []), ("gimp3d.solvers.edges:_bent", lambda *_: [])),
    "edges bend only where they turn little": (("gimp3d.solvers.edges:ROUND", float("inf")),),
    "an edge counts beside one that is told better": (("gimp3d.solvers.edges:FIRM", 0.0),),
    "what varies little need not be explained": (("gimp3d.solvers.regularity:LOCALLY", -float("inf")),),
    "an edge is told as far as others, or not": (("gimp3d.solvers.edges:SOON", REACH),),
    "what lies far beyond a hole ends edges, too": (("gimp3d.solvers.edges:_unknown", _little_known),),
    "what photos disagree on ends edges": (
        ("gimp3d.solvers.exemplar:find_edges", Around(lambda find: lambda *p: find(*p[:3], p[2]))),
    ),
    "one mean on both sides of an edge": (
        ("gimp3d.solvers.kriging:_means", Around(lambda means: lambda *p: means(*p[:4], (), p[5]))),
    ),
    "no edge is continued": (("gimp3d.solvers.exemplar:find_edges", lambda *_: ()),),
    "edges of all kinds are alike": (("gimp3d.solvers.exemplar:GUIDE", np.float32([EDGE, EDGE, *[0] * 6])),),
    "edges of one step are": (("gimp3d.solvers.exemplar:GUIDE", np.float32([EDGE, EDGE, *[1] * 3, *[0] * 3])),),
    "patches expect no colours": (("gimp3d.solvers.exemplar:EXPECTED", 0.0),),
    "patches that fit badly have more say": (("gimp3d.solvers.exemplar:SELECTIVE", 4.0),),
    "averages of patches stay": (("gimp3d.solvers.exemplar:COPIED", 0.0), ("gimp3d.solvers.exemplar:MOSAICS", 0)),
    "what is copied is not matched again": (("gimp3d.solvers.exemplar:MOSAICS", 0),),
    "votes have no say in the mosaic": (("gimp3d.solvers.exemplar:COPIED", 1.0),),
    "fills have no grain beside what is copied": (
        ("gimp3d.solvers.exemplar:with_grain", lambda picture, hole, *_: picture[hole]),
    ),
    "loud detail is grain, too": (("gimp3d.solvers.grain:LOUD", 1e9),),
    "detail of other materials is grain, too": (("gimp3d.solvers.grain:LIKE", math.inf),),
    "Telea's fill": (("inpaint", "telea"),),
    # the object's light
    "shadows and reflections stay": (("shadow", "off"),),
    "sheen may be an image": (("gimp3d.stages.reflection:_without_slopes", lambda values, *_: values),),
    "dark rims where it stands stay": (("gimp3d.stages.shadow:CHANCE", math.inf),),
    "a light need not beat chance": (("gimp3d.stages.light_search:EARNS", 1e-9),),
    "a light need not explain what is uneven": (("gimp3d.stages.light_search:FITS", 1e-9),),
    "only lights that explain most are tried": (("gimp3d.stages.light_search:STARTS", (False,)),),
    "a shadow may be missing round the object": (("gimp3d.stages.shadow:FAINT", -1.0),),
    "one light at most": (("gimp3d.stages.light_search:MOST", 1),),
    "hue is no paint": (("gimp3d.solvers.lights:_besides", BY_PLACE_ALONE),),
    "strength by blocks of all sizes": (("gimp3d.stages.shadow:BROAD", (4, 8, 16, 32)),),
    "sky only as far as photos ask": (("gimp3d.stages.shadow:DULL", 0.0),),
    "depth alone tells what is ground": (("gimp3d.stages.lifting:_shows", _by_depth_alone),),
    "pixels beside the object are lifted": (("gimp3d.stages.lifting:MIXED", 0.3),),
    "lifted ground may be brighter than lit ground": (("gimp3d.stages.lifting:BRIGHTER", math.inf),),
    "the darkest are lifted": (("gimp3d.stages.lifting:DARKEST", 0.05),),
    "the support is what photos agree on best": (("gimp3d.steps.behind:support_first", lambda planes, _: planes),),
    "walls hide no sky": (
        ("gimp3d.stages.light_search:_open_sky", Around(lambda sky: lambda _: sky(np.zeros((0, 3))))),
    ),
    "no walls beside it": (("gimp3d.stages.ground:_walls", lambda *_: []),),
    "grounds climb other planes": (
        ("gimp3d.stages.ground:lay_surface", Around(lambda lay: lambda *p, others, **k: lay(*p, **k))),
    ),
    "drawn depths lie as far off grounds as can be": (("gimp3d.stages.ground:scatter_about", lambda *_: MOST_SCATTER),),
}


def main() -> None:
    parser = parser_of(__doc__, "ablation", data=True, quick="one made scene, two rules", scenes=",".join(SCENES))
    parser.add_argument("--rules", nargs="*", default=[], metavar="WORD", help="rules that hold one of these words")
    parser.add_argument("--picture", nargs="*", default=[GIVEN, BUILT_IN], choices=[GIVEN, BUILT_IN])
    given = parser.parse_args()
    names = [rule for rule in RULES if not given.rules or any(word in rule for word in given.rules)]
    scenes = read_scenes(given.data, "desk" if given.quick else given.scenes, needs_truth=True)
    if given.quick:
        names, given.picture = ["the paper's blend", "not refined"], [GIVEN]
    cells: dict[tuple[str, str, str], Row] = {}
    for scene in scenes:
        for picture in given.picture:
            for rule in ("", *names):
                switches = RULES[rule] if rule else ()
                key = f"{scene.name} | {picture} | {rule} | {[what for what, _ in switches]}"
                cell = kept(given.out / "cells.json", key, lambda s=scene, p=picture, w=switches: measured(s, p, w))
                cells[scene.name, picture, rule] = cell
                say(f"{scene.name:16}{picture:10}{rule or 'as it is':48}" + _cell(cell, cells[scene.name, picture, ""]))
            words = markdown("What each rule is worth", about(machine()), sections(cells, given.picture))
            write(given.out / "ablation.md", words)


def measured(scene: Scene, picture: str, switches: Sequence[Switch]) -> Row:
    """PSNR in the mask and where no view looks, and seconds of a removal; or why there are none."""
    reference = scene.test[0] if picture == GIVEN else None
    true_picture = scene.truth(reference) if reference else None
    try:
        settings = changed(PRESETS[PRESET], switches)
        with switched_off(switches):
            watch = Watch()
            result = removal(scene, settings, reference, true_picture)
            wall, cpu = watch.lap()
    except (BadInput, IllPosed) as error:
        return {"refused": str(error)}
    found = mean_psnrs(scene, filled(scene.gaussians, result), scene.test[1:])
    return found | {"seconds": wall / 1e3, "cpu_s": cpu / 1e3, "added": len(new_gaussians(result) or ())}


def changed(settings: RemovalSettings, switches: Sequence[Switch]) -> RemovalSettings:
    """The settings with those switches that are settings."""
    for path, value in switches:
        if ":" not in path:
            settings = _with(settings, path.split("."), value, path)
    return settings


def _with(settings: Any, path: Sequence[str], value: Any, whole: str) -> Any:
    if not is_dataclass(settings) or path[0] not in {f.name for f in fields(settings)}:
        raise BadInput(f"ablation: there is no setting {whole} any more: mend RULES")
    inner = value if len(path) == 1 else _with(getattr(settings, path[0]), path[1:], value, whole)
    return replace(settings, **{path[0]: inner})


@contextmanager
def switched_off(switches: Sequence[Switch]) -> Iterator[None]:
    """Those switches that are a module's constants or functions have their other value inside."""
    with ExitStack() as stack:
        for what, value in switches:
            if ":" in what:
                module_name, name = what.split(":")
                try:
                    module = import_module(module_name)
                    before = getattr(module, name)
                except (ImportError, AttributeError):
                    raise BadInput(f"ablation: there is no {what} any more: mend RULES") from None
                stack.enter_context(replaced(module, name, value.make(before) if isinstance(value, Around) else value))
        yield


def _cell(cell: Row, before: Row) -> str:
    if "refused" in cell or "refused" in before:
        return cell.get("refused") or "–"
    changes = " / ".join(f"{cell[mask] - before[mask]:+.2f}" for mask in MASKS)
    return f"{changes} ({cell['seconds']:.0f} s)"


def sections(cells: dict[tuple[str, str, str], Row], pictures: Sequence[str]) -> Iterator[Section]:
    for picture in pictures:
        scenes = list(dict.fromkeys(s for s, p, _ in cells if p == picture))
        lines = []
        for rule in dict.fromkeys(r for _, p, r in cells if p == picture):
            of = [(cells[s, picture, ""], cells[s, picture, rule]) for s in scenes if (s, picture, rule) in cells]
            done = [(b, c) for b, c in of if "refused" not in b and "refused" not in c]
            line, form = [rule or "as it is"], "{:+.2f}" if rule else "{:.2f}"
            for mask in MASKS:
                found = [c[mask] - b[mask] if rule else c[mask] for b, c in done]
                line += [form.format(f(found)) if found else "–" for f in (np.mean, min, max)]
            seconds = [c["cpu_s"] - (b["cpu_s"] if rule else 0) for b, c in done]
            line.append(f"{np.mean(seconds):+.1f}" if seconds else "–")
            if rule:
                line += [_cell(c, b) for b, c in of]
            else:
                whole = "{mask:.2f} / {unseen:.2f} ({seconds:.0f} s)"
                line += [b.get("refused") or whole.format(**b) for b, _ in of]
            lines.append(line + [""] * (len(scenes) - len(of)))
        head = ["rule switched off", *(f"{m}: {w}" for m in MASKS for w in ("mean", "worst", "best")), "CPU s", *scenes]
        yield Section(
            f"Picture {picture}",
            f"Preset {PRESET}; PSNR of the test views but the first, dB: change against the first row, in what the "
            "object hides (mask) and in what no training view sees of it (unseen). By scene: mask / unseen (seconds).",
            head,
            lines,
        )


if __name__ == "__main__":
    told_in_one_line(main)
