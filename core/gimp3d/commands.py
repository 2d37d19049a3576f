"""What each command does with files: read, call the library, write. The same verbs are the Python interface."""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from . import __version__
from .behind import BEFORE_FILL
from .box import read_region
from .camera import Camera, output_name
from .compute.jit import announce_compilation
from .compute.threads import parallel_map, set_thread_count
from .errors import BadInput
from .files import is_stream, sweep, try_target, write_atomically, write_json
from .frame import frame_of
from .gaussians import Gaussians
from .io.cameras import read_cameras, write_transforms
from .io.formats import read_scene
from .io.images import load_view, read_image, write_png
from .io.ply import SplatFile, positions, write_gaussians, write_ply
from .job import MOST_VARIANTS, RemovalJob, SharedStages, StageStore
from .memory import GAUSSIAN, VIEW_PIXEL, require_memory
from .orbit import measured_up, orbit_cameras
from .pictures import of_light
from .pipeline import RemovalResult, RemovalSettings, View, look, preview, remove_object, render_bytes
from .presets import job_settings, shadow_of
from .progress import Progress, silent
from .raster import RasterSettings, render
from .report import summary_of, write_charts, write_removal_report
from .run import Run
from .stages.charts import chart_number
from .stages.masks import MaskSettings, spread_views
from .stages.propagate import to_bytes
from .steps.references import charts_to_paint

PASSES = ("rgb", "alpha", "depth", "normal")


def scene_info(path: Path) -> dict[str, Any]:
    """Facts about a scene file: kind, count, SH degree, extent (scene units, 1st to 99th percentile), unusable rows.

    Raises
    ------
    BadInput
        If it is no scene.

    Examples
    --------
    >>> info = scene_info(Path("scene.ply"))
    >>> info["kind"], info["sh_degree"], info["unusable_rows"]
    ('3DGS', 0, 0)
    """
    file = read_scene(path)
    g = file.gaussians
    usable = g.usable
    means = g.means[usable] if usable.any() else np.zeros((1, 3), np.float32)
    return {
        "file": str(path),
        "kind": "2DGS" if g.is_surfels else "3DGS",
        "gaussians": len(g),
        "sh_degree": g.sh_degree,
        "antialiased": g.antialiased,
        "unusable_rows": int((~usable).sum()),
        "bounds_min": np.percentile(means, 1, axis=0).round(4).tolist(),
        "bounds_max": np.percentile(means, 99, axis=0).round(4).tolist(),
        "format": file.table.format,
        "properties": list(file.table.properties),
        "comments": list(file.table.comments),
    }


def convert(source: Path, target: Path) -> None:
    """Write a scene of any kind that `read_scene` knows as a plain binary PLY in Inria's layout."""
    if target.suffix.lower() != ".ply":
        raise BadInput(f"convert: {target} must end in .ply")
    try_target(target)
    write_gaussians(target, read_scene(source).gaussians)


def _precise(file: SplatFile) -> Gaussians:
    """The Gaussians with their centres in the file's own precision."""
    return replace(file.gaussians, means=positions(file))


def select_cameras(
    cameras: Sequence[Camera], split: str = "all", frames: Sequence[str] | None = None
) -> tuple[Camera, ...]:
    """The cameras of a split, or those named (`frames` wins); BadInput if one does not exist or nothing is left."""
    if frames:
        by_name = {c.id: c for c in cameras}
        missing = [f for f in frames if f not in by_name]
        if missing:
            raise BadInput(f"no camera {', '.join(missing)}; the file has {', '.join(list(by_name)[:5])} …")
        return tuple(by_name[f] for f in frames)
    chosen = tuple(c for c in cameras if split in ("all", c.split))
    if not chosen:
        raise BadInput(f"the camera file has no frame of split {split!r}")
    return chosen


def render_views(
    scene: Path,
    cameras: Path,
    out: Path,
    split: str = "all",  # train | test | all
    frames: Sequence[str] | None = None,
    passes: Sequence[str] = ("rgb",),
    scale: float = 1.0,  # of the pictures' width and height
    background: Sequence[float] = (0.0, 0.0, 0.0),  # red, green, blue from 0 to 1
    threads: int | None = None,
    progress: Progress = silent,
) -> None:
    """Draw the scene from its cameras into a folder, as `gimp3d render` does: one file for each frame and pass.

    Raises
    ------
    BadInput
        If a file cannot be used, or a pass, scale, split or frame makes no sense.

    Examples
    --------
    >>> render_views(Path("scene.ply"), Path("transforms.json"), Path("pictures"), passes=["rgb", "depth"])
    >>> sorted(path.name for path in Path("pictures").iterdir())[:2]
    ['0.depth.npy', '0.png']
    """
    _use_threads(threads)
    unknown = [p for p in passes if p not in PASSES]
    if unknown or not passes:
        raise BadInput(f"render: unknown pass {', '.join(unknown) or '(none)'}; use {','.join(PASSES)}")
    if not 0 < scale <= 16:
        raise BadInput(f"render: --scale must be in (0, 16], got {scale}")
    if not all(0 <= b <= 1 for b in background):
        raise BadInput("render: --background takes three numbers from 0 to 1")
    try_target(out, is_folder=True)
    given = _precise(read_scene(scene))
    chosen = select_cameras(read_cameras(cameras), split, frames)
    frame = frame_of(given, chosen)
    gaussians = frame.scene(given)
    announce_compilation(lambda text: progress("compile", 0, 1, text))
    raster = RasterSettings(background=tuple(background))  # type: ignore[arg-type]
    for done, camera in enumerate(chosen, 1):
        pinhole = replace(camera, distortion=None).scaled(scale)
        drawn = render(gaussians, frame.camera(pinhole), raster, frozenset(passes))
        name = output_name(camera.id)
        if "rgb" in passes:
            write_png(out / f"{name}.png", to_bytes(255 * drawn.rgb))
        if "alpha" in passes:
            write_png(out / f"{name}.alpha.png", to_bytes(255 * drawn.alpha))
        if "depth" in passes:
            _write_npy(out / f"{name}.depth.npy", drawn.median_depth / np.float32(frame.scale))
        if "normal" in passes:
            _write_npy(out / f"{name}.normal.npy", drawn.normals)
        progress("render", done, len(chosen), camera.id)


def write_masks(
    scene: Path,
    cameras: Path,
    roi: Path,
    out: Path,
    images: str | None = None,  # folder; "none": views are rendered from the scene itself
    mode: str = "need",  # need | paper
    grow: bool = False,
    split: str = "train",
    frames: Sequence[str] | None = None,
    extra_masks: Path | str | None = None,
    shadow: str = "auto",
    shadow_masks: Path | str | None = None,
    pictures: Path | None = None,
    depth_prior: str = "auto",
    threads: int | None = None,
    progress: Progress = silent,
) -> None:
    """Write every view's target region as a 0/255 picture, `out`/<ID without extension>.png.

    With `pictures`, also what a removal would do there: <ID>.mask.png, the region laid over the view; <ID>.depth.png,
    the surface that it would complete as a relief; <ID>.fit.png, how the depth prior was scaled, if there is one;
    proposed.json, what of the object the boxes cut off, as in a removal's summary; and, if the views are those that a
    removal would use, charts/, see `write_charts`.
    """
    _use_threads(threads)
    for folder in (out, *([pictures] if pictures else [])):
        try_target(folder, is_folder=True)
    given, region = _precise(read_scene(scene)), read_region(roi)
    available = read_cameras(cameras, _images_folder(images))
    written = select_cameras(available, split, frames)
    names = {c.id for c in written}
    looked_at = [c for c in available if c.split == "train" or c.id in names]  # in the file's order, as a removal does
    announce_compilation(lambda text: progress("compile", 0, 1, text))
    loaded = _load_views(looked_at, images, given)
    masks = MaskSettings(mode=mode, grow=grow)  # type: ignore[arg-type]
    run = Run(RemovalSettings(masks=masks, depth_prior=depth_prior, shadow=shadow_of(shadow, shadow_masks)), progress)
    marks = _read_marks("--extra-masks", extra_masks, looked_at), _read_marks("--shadow-masks", shadow_masks, looked_at)
    frame = frame_of(given, available)
    behind = look(run, frame, given, loaded, region, *marks)
    seen = {v.id: v for v in behind.views}
    if pictures:
        write_json(pictures / "proposed.json", frame.proposed_back(behind.masks.proposed))
        write_json(pictures / "light.json", behind.lit.facts())
        if all(c.split == "train" for c in written):
            used = {c.id for c in spread_views(looked_at, region, run.settings.views, _marked(marks))}
            removal = behind  # which uses no more views
            if len(used) < len(loaded):
                removal = look(run, frame, given, [v for v in loaded if v.camera.id in used], region, *marks)
            charts = charts_to_paint(removal.charts, removal.views)
            write_charts(pictures / "charts", frame.charts_back(charts))
    for camera in written:
        name, view = output_name(camera.id), seen.get(camera.id)
        target = view.masks.target if view else np.zeros((camera.height, camera.width), bool)
        write_png(out / f"{name}.png", target)
        if pictures and view:
            for looked in (*preview(view, run.settings), *of_light(behind.lit, list(seen), [camera.id])):
                write_png(pictures / f"{name}.{looked.kind}.png", looked.draw())


def write_orbit(
    scene: Path,
    roi: Path,
    out: Path,
    views: int = 24,
    up: Sequence[float] | None = None,
    width: int = 960,
    height: int = 540,
    fov_degrees: float = 50.0,
) -> tuple[np.ndarray, str]:
    """Write cameras round a region, for a scene that has none; returns what is up, and why."""
    gaussians, region = _precise(read_scene(scene)), read_region(roi)
    axis, why = None if up is None else np.asarray(up), "as given"
    if axis is None:
        axis, why = measured_up(gaussians, region), "away from the floor under the region"
    if axis is None:
        axis, why = np.array([0.0, 0.0, 1.0]), "no floor found; give --up if it is another direction"
    write_transforms(out, orbit_cameras(region, views, tuple(axis), width, height, fov_degrees))
    return axis, why


def run_removal(
    job: RemovalJob,
    folder: Path | None = None,
    resume: bool = False,
    progress: Progress = silent,
    allow_network: bool = False,  # never the job's to say: it may come from somebody else
) -> dict[str, Any]:
    """Run a removal from files to files.

    Returns
    -------
    dict
        The summary that `gimp3d remove --summary` writes: stages with seconds, counts, settings, warnings, the verdict.

    Raises
    ------
    Gimp3dError
        BadInput where a file or a setting cannot be used, IllPosed where the task has no answer; OUT is as it was then.

    Examples
    --------
    >>> job = RemovalJob("scene.ply", "transforms.json", "roi.json", "out.ply", preset="draft")
    >>> summary = run_removal(job)
    >>> summary["counts"]["removed"] > 0
    True
    """
    start = time.perf_counter()
    _use_threads(job.threads)
    if job.device == "cuda":
        raise BadInput("--device cuda: there is no CUDA backend yet; use cpu or auto")
    settings = job_settings(job)
    _try_targets(job, folder)
    progress("read", 0, 1, job.scene)
    file = read_scene(Path(job.scene))
    region = read_region(Path(job.roi))
    reference = job.reference and job.reference.removeprefix("./")
    available = _removal_cameras(job, reference)
    extra = _read_marks("--extra-masks", job.extra_masks, available)
    shadow = _read_marks("--shadow-masks", job.shadow_masks, available)
    cameras = spread_views(available, region, settings.views, _marked((extra, shadow)) | {reference or ""})
    pixels = sum(c.width * c.height for c in cameras)
    require_memory(VIEW_PIXEL * pixels + GAUSSIAN * len(file.gaussians), f"a removal with {len(cameras)} views")
    announce_compilation(lambda text: progress("compile", 0, 1, text))
    scene = _precise(file)
    views = _load_views(cameras, job.images, scene)
    picture = read_image(Path(job.reference_image)) if job.reference_image else None
    progress("read", 1, 1, f"{len(file.gaussians)} Gaussians, {len(views)} of {len(available)} views")
    key = _job_key(job, views, (extra, shadow)) if folder else ""
    shared = SharedStages(BEFORE_FILL if job.variants > 1 else ())
    given = (reference, picture, progress, shared, extra, shadow, allow_network)
    results: list[RemovalResult] = []
    for variant in range(settings.variant, settings.variant + job.variants):
        of_variant = replace(settings, variant=variant)
        if folder:
            stages = folder / "stages" / (str(variant + 1) if variant else "")
            shared.own = StageStore(stages, key, resume, asdict(of_variant))
        results.append(remove_object(scene, views, region, of_variant, *given))
    seconds = time.perf_counter() - start
    summary = summary_of(job, settings, file, results, _input_warnings(job, file, views), seconds)
    if job.report:
        write_removal_report(Path(job.report), scene, views, results, summary)
    _write_results(job, folder, file, results, summary)
    return summary


def _input_warnings(job: RemovalJob, file: SplatFile, views: Sequence[View]) -> list[str]:
    """What is amiss with what was read."""
    warnings = []
    if unusable := int((~file.gaussians.usable).sum()):
        what = "Gaussians hold NaN, infinity or a zero quaternion: ignored in use, kept in the file"
        warnings.append(f"{unusable} {what}")
    rendered = sum(v.camera.split == "train" and not v.is_photo for v in views)
    if rendered and job.images != "none":
        warnings.append(f"{rendered} of {len(views)} photos are missing: these views are rendered from the scene")
    return warnings


def _write_results(
    job: RemovalJob, folder: Path | None, file: SplatFile, results: Sequence[RemovalResult], summary: dict[str, Any]
) -> None:
    """Views, charts, summary, and the scenes, OUT last: as it was until all has gone well."""
    if job.views_out:
        for name, image in results[0].painted.items():
            write_png(Path(job.views_out) / f"{output_name(name)}.png", image)
        write_charts(Path(job.views_out) / "charts", results[0].charts)
    for path in [p for p in (job.summary, folder and folder / "summary.json") if p]:
        write_json(Path(path), summary)
    for path, result in reversed(list(zip(job.outs(), results))):
        write_ply(path, file, result.keep, result.added)


def _try_targets(job: RemovalJob, folder: Path | None) -> None:
    """Sweep what killed runs left half-written, and see that everything can be written before the work starts."""
    out = Path(job.out)
    if out.suffix.lower() != ".ply" and not is_stream(out):
        raise BadInput(f"--out: {out} must end in .ply")
    if not 1 <= job.variants <= MOST_VARIANTS:
        raise BadInput(f"--variants must be from 1 to {MOST_VARIANTS}, got {job.variants}")
    if job.variants > 1 and is_stream(out):
        raise BadInput(f"--variants: {out} takes one scene only")
    files = [*job.outs(), *(Path(p) for p in (job.summary, folder and folder / "summary.json") if p)]
    folders = [Path(p) for p in (job.report, job.views_out, folder and folder / "stages") if p]
    of_variants = folder.glob("stages/*/") if folder else ()
    sweep([*(f.parent for f in files), *folders, *of_variants])
    for path in files:
        try_target(path)
    for path in folders:
        try_target(path, is_folder=True)


def _removal_cameras(job: RemovalJob, reference: str | None) -> tuple[Camera, ...]:
    """The train frames and the reference, whatever its split."""
    available = read_cameras(Path(job.cameras), _images_folder(job.images))
    if reference and chart_number(reference) is None and reference not in {c.id for c in available}:
        raise BadInput(f"--reference: no camera {reference}; the file has {available[0].id}, {available[-1].id} …")
    if job.reference_image and not reference:
        raise BadInput("--reference-image needs --reference, the camera or chart:N that the picture is of")
    chosen = tuple(c for c in available if c.split == "train" or c.id == reference)
    if not any(c.split == "train" for c in chosen):
        raise BadInput("the camera file has no train frame; remove needs at least one")
    return chosen


def _images_folder(images: str | None) -> Path | None:
    return Path(images) if images and images != "none" else None


def _load_views(cameras: Sequence[Camera], images: str | None, scene: Gaussians) -> list[View]:
    """Photos where there are any; otherwise, and for a reference outside the train split, the rendered scene."""
    frame = frame_of(scene, cameras)
    drawn = frame.scene(scene)

    def load(camera: Camera) -> View:
        if images != "none" and camera.split == "train" and camera.image is not None and camera.image.exists():
            image, pinhole = load_view(camera)
            return View(pinhole, image)
        pinhole = replace(camera, distortion=None)
        return View(pinhole, render_bytes(drawn, frame.camera(pinhole)), is_photo=False)

    return parallel_map(load, cameras)


def _read_marks(option: str, folder: Path | str | None, cameras: Sequence[Camera]) -> dict[str, np.ndarray]:
    """The masks of a folder by camera ID, undistorted and resampled like photos; views may lack one."""
    if folder is None:
        return {}
    paths = {c.id: Path(folder) / f"{output_name(c.id)}.png" for c in cameras}
    masks = {c.id: load_view(replace(c, image=paths[c.id]))[0].max(-1) > 127 for c in cameras if paths[c.id].is_file()}
    if not masks:
        raise BadInput(f"{option}: {folder} holds no mask of a view, such as {paths[cameras[0].id]}")
    return masks


def _marked(marks: Sequence[Mapping[str, np.ndarray]]) -> set[str]:
    """The IDs of views in which something is marked."""
    return {name for masks in marks for name, mask in masks.items() if mask.any()}


def _job_key(job: RemovalJob, views: Sequence[View], marks: Sequence[Mapping[str, np.ndarray]]) -> str:
    """A hash of everything that a stage's result depends on."""
    digest = hashlib.sha256(__version__.encode())
    settings = {k: v for k, v in asdict(job).items() if k not in (*job.PATHS, "threads", "device", "variants")}
    digest.update(json.dumps(settings, sort_keys=True).encode())
    for path in (job.scene, job.cameras, job.roi, job.reference_image):
        if path and Path(path).is_file():
            digest.update(Path(path).read_bytes())
    for provider in (job.inpaint, job.depth_prior, job.refine_views or ""):
        for file in _files_of(provider):
            digest.update(file.read_bytes())
    for view in views:
        digest.update(view.camera.id.encode() + view.camera.viewmat.tobytes() + view.camera.K.tobytes())
        digest.update(view.image.tobytes())
        for mark in marks:
            digest.update(mark[view.camera.id].tobytes() if view.camera.id in mark else b"none")
    return digest.hexdigest()


def _files_of(provider: str) -> list[Path]:
    """The files that a provider names: a model or picture, options after commas, or a server's workflow after one."""
    name, _, rest = provider.partition(":")
    if name == "command":
        return []
    if name in ("http", "https"):
        rest = rest.partition(",")[2]
    parts = rest.split(",")
    named = (Path(",".join(parts[:k])) for k in range(len(parts), 0, -1))
    return [path for path in named if path.is_file()][:1]


def _write_npy(path: Path, array: np.ndarray) -> None:
    write_atomically(path, lambda f: np.save(f, array.astype(np.float32)))


def _use_threads(threads: int | None) -> None:
    if threads is not None and threads < 1:
        raise BadInput(f"--threads must be 1 or more, got {threads}")
    set_thread_count(threads)
