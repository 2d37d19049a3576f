"""The rasteriser in torch: the same gradients, nothing copied, and the seam that lets another backend draw."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, fields, replace

import numpy as np
import pytest
from test_raster_region import active_scene, frozen_scene, some_pixels
from test_raster_render import CAMERA, random_scene

from gimp3d.camera import Camera
from gimp3d.gaussians import Gaussians
from gimp3d.raster import (
    PASSES,
    Gradients,
    PictureGradients,
    RasterSettings,
    Rendering,
    backward,
    contributions,
    footprint,
    pixel_region,
    render,
    trace,
    use_backend,
)

torch = pytest.importorskip("torch")
from gimp3d.raster.autograd import PICTURES, Pictures, rasterize  # noqa: E402 (needs torch)

PARAMETERS = ["means", "log_scales", "quats", "opacity_logits", "sh"]
BACKGROUND = RasterSettings(background=(0.1, 0.2, 0.3))


@pytest.fixture(params=["3d", "antialiased", "surfels"])
def gaussians(request: pytest.FixtureRequest) -> Gaussians:
    drawn = random_scene(70, degree=2, surfels=request.param == "surfels")
    return replace(drawn, antialiased=request.param == "antialiased")


def tensors(gaussians: Gaussians, requires_grad: bool = True) -> list[torch.Tensor]:
    return [torch.tensor(getattr(gaussians, p), requires_grad=requires_grad) for p in PARAMETERS]


def loss_of(drawn: Pictures) -> torch.Tensor:
    """Random weights for every picture."""
    generator = torch.Generator().manual_seed(0)
    pictures = [getattr(drawn, name) for name in PICTURES]
    return sum((p * torch.randn(p.shape, generator=generator)).sum() for p in pictures if p is not None)


def upstream_of(rendering: Rendering) -> PictureGradients:
    """The gradient of `loss_of`."""
    generator = torch.Generator().manual_seed(0)
    pictures = {n: getattr(rendering, n) for n in PICTURES if getattr(rendering, n).size}
    return PictureGradients(**{n: torch.randn(p.shape, generator=generator).numpy() for n, p in pictures.items()})


def assert_same(parameters: list[torch.Tensor], gradients: Gradients) -> None:
    for parameter, name in zip(parameters, PARAMETERS):
        np.testing.assert_array_equal(parameter.grad.numpy(), getattr(gradients, name), err_msg=name)


@pytest.mark.parametrize("passes", [PASSES, frozenset({"rgb"}), frozenset({"expected_depth", "normal"})])
def test_pictures_and_gradients_are_those_of_the_arrays(gaussians: Gaussians, passes: frozenset[str]) -> None:
    parameters = tensors(gaussians)
    drawn = rasterize(*parameters, CAMERA, BACKGROUND, passes, gaussians.antialiased)
    rendering, traced = trace(gaussians, CAMERA, BACKGROUND, passes)
    for name in PICTURES:
        picture, array = getattr(drawn, name), getattr(rendering, name)
        assert (picture is None) == (array.size == 0)
        if picture is not None:
            np.testing.assert_array_equal(picture.detach().numpy(), array)
    loss_of(drawn).backward()
    assert_same(parameters, backward(traced, upstream_of(rendering)))
    assert parameters[0].grad.any()


@pytest.mark.parametrize("surfels", [False, True])
def test_a_region_may_be_the_view(surfels: bool) -> None:
    """Its own settings and passes count."""
    frozen, active = frozen_scene(71, surfels), active_scene(71, surfels)
    passes = frozenset({"rgb", "expected_depth"})
    region = pixel_region(frozen, CAMERA, some_pixels(CAMERA), BACKGROUND, passes)
    parameters = tensors(active)
    drawn = rasterize(*parameters, region, passes=frozenset({"normal"}))
    loss_of(drawn).backward()
    rendering, traced = region.trace(active)
    np.testing.assert_array_equal(drawn.rgb.detach().numpy(), rendering.rgb)
    assert drawn.normals is None and drawn.expected_depth is not None
    assert_same(parameters, traced.backward(upstream_of(rendering)))


def test_losses_on_one_drawing_and_on_several_add_up(gaussians: Gaussians) -> None:
    cameras = (CAMERA, replace(CAMERA, fx=50.0))
    expected = []
    for camera, name in ((cameras[0], "rgb"), (cameras[0], "alpha"), (cameras[1], "rgb")):
        rendering, traced = trace(gaussians, camera)
        expected.append(backward(traced, PictureGradients(**{name: np.ones_like(getattr(rendering, name))})))
    parameters = tensors(gaussians)
    first, second = (rasterize(*parameters, c, antialiased=gaussians.antialiased) for c in cameras)
    first.rgb.sum().backward(retain_graph=True)
    first.alpha.sum().backward()
    second.rgb.sum().backward()
    for k, name in enumerate(PARAMETERS):
        total = sum(getattr(g, name).astype(float) for g in expected)
        np.testing.assert_allclose(parameters[k].grad, total, rtol=1e-4, atol=1e-5 * np.abs(total).max())


def test_some_parameters_may_be_constant(gaussians: Gaussians) -> None:
    every = tensors(gaussians)
    loss_of(rasterize(*every, CAMERA, antialiased=gaussians.antialiased)).backward()
    some = [t.requires_grad_(k in (1, 4)) for k, t in enumerate(tensors(gaussians, False))]
    loss_of(rasterize(*some, CAMERA, antialiased=gaussians.antialiased)).backward()
    for k in range(5):
        assert torch.equal(some[k].grad, every[k].grad) if k in (1, 4) else some[k].grad is None
    constant = rasterize(*tensors(gaussians, False), CAMERA)
    assert not constant.rgb.requires_grad


def test_a_change_in_place_before_going_back_is_noticed(gaussians: Gaussians) -> None:
    parameters = tensors(gaussians)
    drawn = rasterize(*parameters, CAMERA, antialiased=gaussians.antialiased)
    with torch.no_grad():
        parameters[3] += 1
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        drawn.rgb.sum().backward()


@pytest.mark.parametrize("index", range(5))
def test_tensors_that_would_have_to_be_copied_are_refused(index: int) -> None:
    parameters = tensors(random_scene(72))
    for wrong in (parameters[index].double(), parameters[index].repeat_interleave(2, 0)[::2]):
        given = [wrong if k == index else p for k, p in enumerate(parameters)]
        with pytest.raises(ValueError, match=f"^{PARAMETERS[index]}: expected a contiguous float32 tensor on the CPU"):
            rasterize(*given, CAMERA)


@dataclass
class FakeTrace:
    """Goes back to ones, and notes what it was given."""

    gaussians: Gaussians
    given: list[PictureGradients] = field(default_factory=list)

    def backward(self, gradients: PictureGradients) -> Gradients:
        self.given.append(gradients)
        return Gradients(*(np.ones_like(getattr(self.gaussians, p)) for p in PARAMETERS))


@dataclass
class FakeDrawing:
    picture: Rendering

    def render(self, passes: frozenset[str]) -> Rendering:
        return self.picture

    def footprint(self, chosen: np.ndarray) -> np.ndarray:
        return np.full_like(self.picture.alpha, 8)


@dataclass
class FakeBackend:
    """Draws pictures that are 7 everywhere, and notes what it was asked."""

    seen: list[Gaussians] = field(default_factory=list)
    traces: list[FakeTrace] = field(default_factory=list)

    def picture(self, gaussians: Gaussians, camera: Camera) -> Rendering:
        self.seen.append(gaussians)
        size = (camera.height, camera.width)
        shapes = ((*size, 3), size, size, (0, 0), (*size, 3))
        return Rendering(*(np.full(s, 7, np.float32) for s in shapes), 5)

    def trace(
        self, gaussians: Gaussians, camera: Camera, settings: RasterSettings, passes: frozenset[str]
    ) -> tuple[Rendering, FakeTrace]:
        self.traces.append(FakeTrace(gaussians))
        return self.picture(gaussians, camera), self.traces[-1]

    def drawing(self, gaussians: Gaussians, camera: Camera, *_: object) -> FakeDrawing:
        return FakeDrawing(self.picture(gaussians, camera))

    def weigh(self, gaussians: Gaussians, *_: object) -> tuple[np.ndarray, np.ndarray]:
        return np.full((1, len(gaussians)), 9, np.float32), np.full(len(gaussians), 10, np.float32)


@pytest.fixture
def fake() -> Iterator[FakeBackend]:
    backend = FakeBackend()
    before = use_backend(backend)
    yield backend
    assert use_backend(before) is backend


def test_another_backend_may_draw(fake: FakeBackend) -> None:
    gaussians = random_scene(73)
    assert (render(gaussians, CAMERA).rgb == 7).all()
    rendering, traced = trace(gaussians, CAMERA)
    assert rendering.ignored == 5
    assert (backward(traced, PictureGradients()).means == 1).all()
    assert (footprint(gaussians, CAMERA, np.ones(60, bool)) == 8).all()
    assert (contributions(gaussians, CAMERA).peak == 10).all()
    assert all(seen is gaussians for seen in fake.seen)


def test_the_cpu_draws_again_afterwards() -> None:
    before = render(random_scene(74), CAMERA).rgb
    own = use_backend(FakeBackend())
    use_backend(own)
    np.testing.assert_array_equal(render(random_scene(74), CAMERA).rgb, before)


def test_nothing_is_copied_on_the_way(fake: FakeBackend) -> None:
    """The backend gets the tensors' memory, torch gets the pictures', the backend gets the gradients'."""
    parameters = tensors(random_scene(75))
    drawn = rasterize(*parameters, CAMERA, antialiased=True)
    assert drawn.median_depth is None and (drawn.rgb == 7).all()
    assert fake.seen[0].antialiased
    for parameter, name in zip(parameters, PARAMETERS):
        assert getattr(fake.seen[0], name).ctypes.data == parameter.data_ptr()
    given = torch.full_like(drawn.rgb, 3.0)
    gradients = torch.autograd.grad(drawn.rgb, parameters, given)
    assert all((g == 1).all() for g in gradients)
    received = fake.traces[0].given[0]
    assert received.rgb.ctypes.data == given.data_ptr()
    assert all(getattr(received, f.name).size == 0 for f in fields(received) if f.name != "rgb")


@pytest.mark.parametrize("surfels", [False, True])
def test_adam_fits_gaussians_to_a_picture(surfels: bool) -> None:
    target = active_scene(76, surfels, 8)
    picture = torch.tensor(render(target, CAMERA, BACKGROUND).rgb)
    rng = np.random.default_rng(76)
    start = replace(
        target,
        means=target.means + rng.normal(0, 0.04, target.means.shape).astype(np.float32),
        log_scales=target.log_scales + rng.normal(0, 0.2, target.log_scales.shape).astype(np.float32),
        opacity_logits=np.zeros(8, np.float32),
        sh=target.sh * np.float32(0.3),
    )
    parameters = tensors(start)
    optimiser = torch.optim.Adam(
        [{"params": [p], "lr": lr} for p, lr in zip(parameters, (0.01, 0.03, 0.03, 0.1, 0.05))]
    )
    losses = []
    for _ in range(60):
        optimiser.zero_grad()
        loss = ((rasterize(*parameters, CAMERA, BACKGROUND, frozenset({"rgb"})).rgb - picture) ** 2).mean()
        loss.backward()
        optimiser.step()
        losses.append(float(loss.detach()))
    assert losses[-1] < 0.1 * losses[0]
