"""Painters in whole removals, and every command that the cookbook (docs/painters.md) prints, against stand-ins."""

from __future__ import annotations

import json
import re
import shlex
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from onnx_files import combined, model, pixelwise
from pictures import disc, holed, painted_view, scenery
from scenes import REGION, cameras, scene
from stand_ins import Automatic, Comfy, Gemini, StandIn, big_lama, depth_model, serving

from gimp3d import commands, filling, pipeline
from gimp3d.cli import main
from gimp3d.io.cameras import write_transforms
from gimp3d.io.ply import write_gaussians
from gimp3d.job import RemovalJob, save_job
from gimp3d.pipeline import RemovalResult, RemovalSettings
from gimp3d.priors.calls import Call
from gimp3d.priors.inpaint import inpaint_reference, painter
from gimp3d.priors.monodepth import depth_prior
from gimp3d.stages.propagate import Rule
from gimp3d.stages.refine import PAINTED
from gimp3d.steps.view_refinement import refine_views

PAGE = (Path(__file__).parents[2] / "docs" / "painters.md").read_text(encoding="utf-8")
PRINTED = [
    line
    for block in re.findall(r"```sh\n(.*?)```", PAGE, re.DOTALL)
    for line in block.splitlines()
    if line.startswith("gimp3d ")
]
SCRIPTS = dict(re.findall(r"`(\w+\.py)` – .*?```python\n(.*?)```", PAGE, re.DOTALL))


def write_scene(folder: Path, count: int) -> Path:
    write_gaussians(folder / "scene.ply", scene())
    write_transforms(folder / "transforms.json", cameras(count, 100, 75))
    (folder / "roi.json").write_text(json.dumps(REGION[0].to_json()))
    return folder


# The page


@pytest.fixture(scope="module")
def kitchen(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with everything that the page's commands name."""
    folder = write_scene(tmp_path_factory.mktemp("kitchen"), 2)
    pytest.importorskip("torch")
    big_lama(folder / "big-lama.pt")
    depth_model(folder / "depth.pt")
    nodes = [
        pixelwise("image", "kept", np.eye(3)),
        pixelwise("mask", "paint", np.array([[0.8], [0.2], [0.1]])),
        combined("Add", ["kept", "paint"], "y"),
    ]
    shapes = {"image": (1, 3, "h", "w"), "mask": (1, 1, "h", "w")}
    (folder / "lama.onnx").write_bytes(model(nodes, shapes, (1, 3, "h", "w")))
    looks = model([pixelwise("x", "y", np.array([[0.2, 0.3, 0.5]]))], {"x": (1, 3, "h", "w")}, (1, 1, "h", "w"))
    (folder / "depth_anything.onnx").write_bytes(looks)
    shutil.copy(Path(pipeline.__file__).parent / "priors/workflows/inpaint.json", folder / "my_workflow.json")
    for name, text in SCRIPTS.items():
        (folder / name).write_text(text, encoding="utf-8")
    return folder


@pytest.fixture
def servers(monkeypatch: pytest.MonkeyPatch) -> Iterator[dict[str, StandIn]]:
    """Stand-ins by the addresses that the page prints; another machine's server is this one's."""
    monkeypatch.setattr("gimp3d.priors.servers.POLL", 0.01)
    monkeypatch.setenv("GEMINI_API_KEY", "the-key")
    monkeypatch.delenv("GOOGLE_API_KEY", raising=False)
    with serving(Comfy()) as comfy, serving(Automatic()) as automatic, serving(Gemini()) as gemini:
        monkeypatch.setenv("GOOGLE_GEMINI_BASE_URL", gemini.url)
        yield {
            "http://127.0.0.1:8188": comfy,
            "http://192.168.1.20:8188": comfy,
            "http://127.0.0.1:7860": automatic,
            "gemini": gemini,
        }


def asks_only(scene_: Any, views: Any, region: Any, settings: RemovalSettings, *rest: Any) -> RemovalResult:
    """In a removal's place: its providers are asked about a picture, as it would."""
    network = rest[-1]
    picture, hole = scenery(), disc()
    facts: dict[str, Any] = {}
    call = Call("--inpaint", "appearance", rest[2], 60, network, settings.prompt)
    facts["inpaint"] = inpaint_reference(settings.inpaint, holed(picture, hole), hole, call=call).reason
    if settings.depth_prior != "auto":
        assert depth_prior(settings.depth_prior, *hole.shape, lambda: picture, call) is not None
    if settings.refine_views:
        view = painted_view("a", picture, np.where(hole, Rule.REFERENCE, Rule.UNTOUCHED), picture, hole)
        done = refine_views(painter(settings.refine_views, call), [view], 0, call)
        facts["refined"] = done.facts()
    return RemovalResult(np.ones(len(scene_), bool), None, refined_views=facts)


def test_the_page_has_a_command_for_every_painter() -> None:
    painters = {"torchscript:", "onnx:", "http://127.0.0.1:8188", "http://127.0.0.1:7860", "gemini", "command:"}
    for option, kinds in (("--inpaint ", painters), ("--depth-prior ", {"onnx:", "torchscript:", "command:"}),
                          ("--refine-views ", {"command:", "http:"})):  # fmt: skip
        for kind in kinds:
            assert any(re.search(f'{option}"?{kind}', line) for line in PRINTED), (option, kind)
    assert len(PRINTED) >= 16 and set(SCRIPTS) == {"paint.py", "depth.py", "refine.py"}


@pytest.mark.parametrize("line", PRINTED, ids=range(len(PRINTED)))
def test_the_pages_commands_work(
    line: str, kitchen: Path, servers: dict[str, StandIn], monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    if "gemini" in line:
        pytest.importorskip("google.genai", reason="the optional extra gemini is not installed")
    asked = [server for address, server in servers.items() if address in line]
    for address, server in servers.items():
        if address.startswith("http"):
            line = line.replace(address, server.url)
    line = line.replace("command:python ", f"command:{shlex.quote(sys.executable)} ")
    monkeypatch.chdir(kitchen)
    monkeypatch.setattr(commands, "remove_object", asks_only)
    code = main([*shlex.split(line)[1:], "--images", "none", "--summary", "s.json", "--progress", "none"])
    assert code == 0, capsys.readouterr().err
    facts = json.loads((kitchen / "s.json").read_text())["refined_views"]
    if "--inpaint" in line:
        assert "picture pasted" in facts["inpaint"]
    if "refine.py" in line:
        assert facts["refined"]["accepted"] == 1
    assert all(server.asked for server in asked)


def test_the_pages_messages_are_the_programs() -> None:
    """The words that a user may look for are in the source, up to what is filled in."""
    core = Path(pipeline.__file__).parent
    source = " ".join(p.read_text(encoding="utf-8") for p in core.rglob("*.py"))
    source = re.sub(r"\"\s*\n\s*f?\"", "", source).replace("{{", "{").replace("}}", "}")
    for cell in re.findall(r"^\| `([^|]*)` \|", PAGE, re.MULTILINE):
        if cell.startswith(
            ("torchscript:", "onnx:", "http", "gemini", "command:", "refused", "failed in", "Google refused")
        ):
            continue  # a painter, or a server's own words
        for words in (w.strip(" ;:,") for w in re.split(r'…|http\S+|600|"{mask}"|\(IMAGE_SAFETY\)|1:', cell)):
            assert words in source, words


# Whole removals


def remove(folder: Path, *more: str) -> int:
    paths = [str(folder / name) for name in ("scene.ply", "transforms.json", "roi.json", "out.ply")]
    arguments = ["remove", paths[0], "--cameras", paths[1], "--roi", paths[2], "--out", paths[3], "--images", "none"]
    more = ("--shadow", "off", "--summary", str(folder / "s.json"), *more)
    return main([*arguments, "--progress", "none", *more])


def written(folder: Path, name: str, body: str) -> str:
    """A command that runs a Python script with three files' names."""
    text = (
        "import sys, cv2, numpy as np\nimage, mask = (cv2.imread(name) for name in sys.argv[1:3])\nout = sys.argv[3]\n"
    )
    (folder / name).write_text(f"{text}{body}\n", encoding="utf-8")
    return f"command:'{sys.executable}' '{folder / name}' {{image}} {{mask}} {{out}}"


def test_painted_and_refined_views_reach_the_splats(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The refining program darkens the views, but one it paints white."""
    folder = write_scene(tmp_path, 4)
    paint = written(folder, "paint.py", "cv2.imwrite(out, np.where(mask > 0, np.uint8((200, 60, 30)), image))")
    body = (
        "from pathlib import Path\n"
        "count = Path(__file__).with_name('count')\n"
        "count.write_text(count.read_text() + 'x' if count.exists() else 'x')\n"
        "to = np.uint8(255) if count.read_text() == 'xx' else np.maximum(image, 14) - np.uint8(14)\n"
        "cv2.imwrite(out, np.where(mask > 0, to, image))"
    )
    refine = written(folder, "refine.py", body)
    before: dict[str, np.ndarray] = {}
    seen: dict[str, Any] = {}  # by ID, what the splats are fitted to
    ask, fit = filling.refine_views, filling.refine_gaussians

    def asked(who: Any, views: Any, *rest: Any) -> Any:
        before.update({v.id: v.painted.astype(int) for v in views})
        return ask(who, views, *rest)

    def fitted(kept: Any, added: Any, views: Any, *rest: Any) -> Any:
        seen.update({v.camera.id: v for v in views})
        return fit(kept, added, views, *rest)

    monkeypatch.setattr(filling, "refine_views", asked)
    monkeypatch.setattr(filling, "refine_gaussians", fitted)
    few = ("--set", "refine.steps=2", "--inpaint", paint, "--report", str(folder / "report"))
    assert remove(folder, *few, "--refine-views", refine) == 0
    summary = json.loads((folder / "s.json").read_text())
    refined = summary["refined_views"]
    assert refined["provider"] == refine == summary["settings"]["refine_views"]
    assert refined["asked"] == 4 and refined["accepted"] == 3
    (refused,) = (name for name, view in refined["views"].items() if not view["accepted"])
    (warning,) = (w for w in summary["warnings"] if "--refine-views" in w)
    assert warning.startswith(f"--refine-views: {refused} is left as it was: ") and "something else" in warning
    assert "picture pasted" in next(s["reason"] for s in summary["stages"] if s["name"] == "appearance")
    assert "3 of 4 views refined" in next(s["reason"] for s in summary["stages"] if s["name"] == "refine views")
    page = (folder / "report" / "index.html").read_text()
    assert "refined: before, after" in page and "is left as it was" in page
    assert (seen[refused].image == before[refused]).all()
    for name in set(refined["views"]) - {refused}:
        changed = (seen[name].image != before[name]).any(-1)
        assert changed.sum() > 50 and (before[name] - seen[name].image).max() == 14
        assert (seen[name].weight[changed] == PAINTED).all() and seen[name].target[changed].all()


def test_depth_by_a_program_is_scaled_on_the_ring_of_a_named_view(tmp_path: Path) -> None:
    folder = write_scene(tmp_path, 3)
    (folder / "depth.py").write_text(SCRIPTS["depth.py"], encoding="utf-8")
    spec = f"command:'{sys.executable}' '{folder / 'depth.py'}' {{image}} {{npy}},metric"
    more = ("--preset", "draft", "--reference", "orbit/000", "--inpaint", "telea", "--depth-prior", spec)
    assert remove(folder, *more) == 0
    depth = next(s for s in json.loads((folder / "s.json").read_text())["stages"] if s["name"] == "depth")
    assert "prior" in depth["reason"]


@pytest.mark.parametrize(
    ("more", "words"),
    [
        (("--inpaint", "gemini"), "--inpaint gemini: sends pictures of the scene to Google"),
        (("--inpaint", "http://192.0.2.7:8188"), "192.0.2.7 is not this machine"),
        (("--inpaint", "torchscript:gone.pt"), "cannot read gone.pt"),
        (("--inpaint", "command:fill {image}"), "does not say where {out} goes"),
        (("--depth-prior", "onnx:gone.onnx"), "cannot read gone.onnx"),
        (("--depth-prior", "command:depth {image}"), "does not say where {out} or {npy} goes"),
        (("--refine-views", "gemini"), "--refine-views: unknown provider 'gemini'"),
        (("--refine-views", "http://192.0.2.7:8188"), "--refine-views http: 192.0.2.7 is not this machine"),
        (("--preset", "draft", "--refine-views", "command:x {out}"), "this preset does no refinement"),
    ],
)
def test_what_cannot_work_is_refused_before_the_work_begins(
    tmp_path: Path,
    more: tuple[str, ...],
    words: str,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(pipeline, "find_masks", lambda *_: pytest.fail("the work began"))
    folder = write_scene(tmp_path, 2)
    assert remove(folder, *more) == 2
    said = capsys.readouterr().err
    assert words in said and said.count("\n") == 1 and not (folder / "out.ply").exists()


def test_a_job_cannot_allow_itself_the_network(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """It may come from somebody else; who runs it decides."""
    folder = write_scene(tmp_path, 2)
    paths = {"scene": "scene.ply", "cameras": "transforms.json", "roi": "roi.json", "out": "out.ply"}
    paths = {name: str(folder / path) for name, path in paths.items()}
    save_job(folder, RemovalJob(**paths, images="none", inpaint="http://192.0.2.7:8188"))
    job = json.loads((folder / "job.json").read_text())
    assert main(["remove", "--job", str(folder), "--progress", "none"]) == 2
    assert "192.0.2.7 is not this machine" in capsys.readouterr().err
    (folder / "job.json").write_text(json.dumps({**job, "allow_network": True}))
    assert main(["remove", "--job", str(folder), "--progress", "none"]) == 2
    assert "made by another version" in capsys.readouterr().err


def test_what_leaves_the_machine_is_said_before(tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
                                                capsys: pytest.CaptureFixture[str]) -> None:  # fmt: skip
    monkeypatch.setattr(pipeline, "find_masks", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
    folder = write_scene(tmp_path, 2)
    arguments = ("--inpaint", "http://192.0.2.7:8188", "--allow-network", "--progress", "json")
    assert remove(folder, *arguments) == 130
    found = capsys.readouterr()
    notice = "pictures of the scene are sent to 192.0.2.7:8188"
    assert found.err.startswith(f"gimp3d: note: {notice}\n")
    assert notice in [json.loads(line)["message"] for line in found.out.splitlines() if '"message"' in line]


@pytest.mark.parametrize("spec", ["onnx:{}", "torchscript:{},512x512", "http://127.0.0.1:8188,{}", "file:{}"])
def test_a_job_is_another_one_when_a_painters_file_changes(tmp_path: Path, spec: str) -> None:
    file = tmp_path / "a, b.json"
    job = RemovalJob(
        "s.ply", "c.json", "r.json", "o.ply", inpaint=spec.format(file), refine_views="command:" + 300 * "x"
    )
    keys = []
    for text in ("one", "two"):
        file.write_text(text)
        keys.append(commands._job_key(job, [], ()))
    assert keys[0] != keys[1] == commands._job_key(job, [], ())
