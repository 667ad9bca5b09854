"""Passes over images, whole frames and snow where all lies on a GPU, and what kernels compile into.

Kernels are interpreted where there is no GPU, and a pretended one tells where a tensor lies on the
wrong side.
"""

from __future__ import annotations

import dataclasses
import gc
import os
import subprocess
import sys
from collections.abc import Iterator

import numpy as np
import pytest
import torch

pytest.importorskip("triton")

from augment.exposure import search
from augment.exposure.search import ExposureSettings, find_exposed_surface
from augment.render.backends import available_backends
from augment.render.buffers import CUDA, RenderOutput
from augment.render.composite import apply_color_map, composite_sky, to_byte_array
from augment.render.cuda import runtime as gpu
from augment.render.cuda.runtime import upload
from augment.render.fog import Fog
from augment.render.fog_banks import FogBanks
from augment.render.fog_image import apply_fog_to_render
from augment.render.rasterize import renormalise_alpha
from augment.scene.cameras import Camera
from augment.scene.geometry import rigid, rotmat_from_quat
from augment.scene.labels import Boxes
from augment.scene.scene import Ground, Scene
from augment.scene.semantics import SemanticClass
from augment.scene.sky import ConstantSky, CubemapSky, LatLongSky, Sky
from augment.view.render_view import begin_view, render_view
from augment.view.results import WeatheredView
from recipes.schema import Output, Recipe, Render, Smog, Weather
from recipes.snow import Snow
from recipes.speed import Speed
from recipes.style import Style
from tests import snow_scenes
from tests.augment.kernel_compiling import Launch, compile_launches, complaints, recorded_launches
from tests.augment.kernel_frames import views
from tests.augment.pretend_gpu import AwayTensor, pretended_gpu
from tests.snow_scenes import box_car, cameras_of, drive, sheet

WIDTH, HEIGHT = 33, 21
UNIFORM = Fog(0.03, (0.5, 0.6, 0.7))
LAYERED = Fog(0.03, (0.5, 0.6, 0.7), 30.0, -2.0)
BANKED = dataclasses.replace(LAYERED, banks=FogBanks(1.0, 100.0, 0.3, 5.0, 7))


@pytest.fixture
def away(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    with pretended_gpu(monkeypatch):
        yield


def camera(seed: int = 0) -> Camera:
    """Looks somewhere: over all seeds every face and edge of a cube map is crossed."""
    quat = torch.randn(4, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    pose = rigid(rotmat_from_quat(quat), torch.tensor([1.0, 2.0, -3.0], dtype=torch.float64))
    return Camera("c", WIDTH, HEIGHT, 15.0, 15.5, 15.2, 10.1, pose)


def images(seed: int = 0) -> RenderOutput:
    """Premultiplied colour, alpha with both its ends, depth up to 200 m and 0 at some pixels."""
    generator = torch.Generator().manual_seed(seed)
    alpha = torch.rand(HEIGHT, WIDTH, generator=generator)
    alpha[:3], alpha[3:5] = 0, 1
    rgb = torch.rand(HEIGHT, WIDTH, 3, generator=generator) * alpha[..., None]
    depth = 200 * torch.rand(HEIGHT, WIDTH, generator=generator) ** 3
    depth[:3] = 0
    return RenderOutput(rgb=rgb, alpha=alpha, expected_depth=depth, overlay=0.7 * alpha)


def on_gpu(seen: RenderOutput) -> RenderOutput:
    moved = {f.name: getattr(seen, f.name) for f in dataclasses.fields(seen)}
    return RenderOutput(**{k: None if v is None else upload(v) for k, v in moved.items()})


class Gradient:
    """A sky that only it can sample."""

    def sample(self, directions: torch.Tensor) -> torch.Tensor:
        return 0.5 + 0.5 * torch.nn.functional.normalize(directions, dim=-1)


def skies() -> dict[str, Sky]:
    generator = torch.Generator().manual_seed(1)
    return {
        "cube": CubemapSky(torch.rand(6, 8, 8, 3, generator=generator)),
        "constant": ConstantSky(torch.tensor([0.2, 0.5, 0.9])),
        "panorama": LatLongSky(torch.rand(16, 32, 3, generator=generator)),
        "another": Gradient(),
    }


@pytest.mark.parametrize(
    ("name", "smog"),
    [
        ("cube", LAYERED),
        ("constant", None),
        ("panorama", UNIFORM),
        ("another", LAYERED),
        ("cube", BANKED),
    ],
)
def test_the_sky_behind_the_splats(away, name, smog):
    sky = skies()[name]
    for seed in range(2 if name == "cube" else 1):
        seen, view = images(seed), camera(seed)
        expected = composite_sky(seen.rgb, seen.alpha, view, sky, fog=smog, backend="reference")
        moved = on_gpu(seen)
        got = composite_sky(moved.rgb, moved.alpha, view, sky, fog=smog, backend="cuda")
        # Textures of noise, whose coordinates float32 rounds, and edges between faces: see
        # test_rasterize.
        difference = (got.cpu() - expected).abs().amax(-1)
        assert float(difference.quantile(0.99)) < 1e-4
        assert int((difference > 1e-3).sum()) <= 2
        assert torch.equal(got.cpu()[3:5], seen.rgb[3:5])  # opaque pixels show no sky


@pytest.mark.parametrize("medium", [UNIFORM, LAYERED, Fog(5.0, (0.1, 0.2, 0.3), 3.0), BANKED])
def test_smog_on_buffers(away, medium):
    seen, view = images(), camera()
    expected = apply_fog_to_render(seen, view, medium)
    got = apply_fog_to_render(on_gpu(seen), view, medium)
    # The CPU's kernel of banks has an exp2 good to 3e-6.
    atol = 2e-6 if medium.banks is None else 2e-5
    torch.testing.assert_close(got.cpu(), expected, atol=atol, rtol=0)


def test_colour_maps(away):
    matrix = torch.tensor([[1.1, 0.05, 0, 0.02], [-0.1, 0.9, 0.1, 0], [0, 0.2, 1.2, -0.05]])
    rgb = images().rgb
    expected = apply_color_map(rgb, matrix, backend="reference")
    got = apply_color_map(upload(rgb), matrix, backend="cuda")
    torch.testing.assert_close(got.cpu(), expected, atol=1e-6, rtol=0)
    double = apply_color_map(upload(rgb.double()), matrix, backend="cuda")  # left to torch
    torch.testing.assert_close(double.cpu(), expected.double(), atol=1e-6, rtol=0)


@pytest.mark.parametrize(
    "without", [(), ("rgb",), ("overlay",)], ids=["all", "no colour", "no overlay"]
)
def test_finished_pixels_become_opaque(away, without):
    seen = dataclasses.replace(images(), **dict.fromkeys(without))
    expected = renormalise_alpha(seen, 0.3, backend="reference")
    got = renormalise_alpha(on_gpu(seen), 0.3, backend="cuda")
    for name in {"rgb", "alpha", "overlay"} - set(without):
        value = getattr(got, name).cpu()
        torch.testing.assert_close(value, getattr(expected, name), atol=1e-6, rtol=0)


def test_eight_bits_of_an_image_on_the_gpu(away):
    rgb = 1.4 * images().rgb - 0.2
    assert (to_byte_array(upload(rgb)) == to_byte_array(rgb)).all()


# --- whole views --------------------------------------------------------------------------------


class Labels:
    """One box around the car, so that labels are measured."""

    def boxes(self, frame_index: int) -> Boxes:
        return Boxes(("car",), ("Car",), np.array([[4.0, -0.5, 0.3]]), np.array([[1.2, 0.8, 0.6]]),
                     np.array([[1.0, 0, 0, 0]]))  # fmt: skip

    def lidar(self, frame_index: int) -> None:
        return None


@pytest.fixture(scope="module")
def scene() -> Scene:
    """A road, a wall and a car of so few splats that interpreted kernels draw them in a second."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(snow_scenes, "STEP_M", 0.6)
        road = snow_scenes.sheet((1.0, 7.0), (-1.6, 1.6), semantic=int(SemanticClass.ROAD))
        wall = snow_scenes.side_wall(1.6, (2.0, 7.0), (0.0, 1.0))
        wall = dataclasses.replace(
            wall, semantic=torch.full((len(wall),), int(SemanticClass.BUILDING), dtype=torch.int16)
        )
        car = snow_scenes.box_car(start=(4.0, -0.5), moved_m=1.0, size=(1.2, 0.8, 0.6))
        built = snow_scenes.drive(road, wall, actors=[car], places=((0.0, 0, 1.0), (0.2, 0, 1.0)))
    return dataclasses.replace(
        built,
        sky=skies()["cube"],
        ground_z_m=0.0,
        ground=Ground(0.0, 0.0, "stated", None, 0, None),
        labels=Labels(),
        color_maps={"ahead": torch.eye(3, 4) * 0.8 + 0.05},
    )


SNOW = Snow(depth_m=0.1, cell_m=1.0, tracks="never", shading="per_splat")
LOW = Smog(visibility_m=20, scale_height_m=9.0, model="deferred", blend="linear", scatter=0.3)
RECIPES = {
    "smog, style on the picture": Recipe(
        weather=Weather(smog=Smog(visibility_m=20)),
        style=Style(preset="dusk", applied_to="picture"),
        output=Output(depth="none"),
    ),
    "layered smog on buffers, early stop": Recipe(
        weather=Weather(smog=LOW),
        render=Render(speed=Speed(transmittance_stop=0.2)),
        output=Output(depth="expected", instance=True),
    ),
    "snow, bare images": Recipe(
        weather=Weather(snow=SNOW), output=Output(semantic=True, surface="scene")
    ),
}


def scaled(recipe: Recipe) -> Recipe:
    return recipe.model_copy(update={"render": recipe.render.model_copy(update={"scale": 0.1})})


def view_of(scene: Scene, recipe: Recipe, backend: str) -> WeatheredView:
    return render_view(scene, scene.frames[0].cameras["ahead"], scaled(recipe), backend=backend)


def check_same(got: WeatheredView, expected: WeatheredView) -> None:
    """Of two float32 backends: what is rounded may fall to either side, and single pixels may flip
    at a cut-off.
    """
    images, others = images_of(got), images_of(expected)
    assert images.keys() == others.keys()
    for name, b in others.items():
        a = images[name]
        assert a.dtype == b.dtype and a.shape == b.shape, name
        if name == "rgb":
            assert np.abs(a.astype(int) - b).max() <= 1
        else:
            close = np.isclose(a, b, rtol=1e-4, atol=0)
            assert (~close).sum() <= 2, f"{name}: {(~close).sum()} pixels differ"


def images_of(view: WeatheredView) -> dict[str, np.ndarray]:
    """All arrays of a view by name."""
    fields = {field.name: getattr(view, field.name) for field in dataclasses.fields(view)}
    depths = {f"depth of {name}": seen.depth_m for name, seen in view.effects.items()}
    found = {**fields, **view.masks, **depths}
    return {name: image for name, image in found.items() if isinstance(image, np.ndarray)}


@pytest.mark.parametrize(
    "name",
    [
        pytest.param("layered smog on buffers, early stop", marks=pytest.mark.long),
        pytest.param("smog, style on the picture", marks=pytest.mark.long),
        pytest.param("snow, bare images", marks=pytest.mark.long),
    ],
)
def test_a_view_is_that_of_the_cpu(scene, away, name):
    expected = view_of(scene, RECIPES[name], "cpu")  # first, so that it places the snow
    check_same(view_of(scene, RECIPES[name], "cuda"), expected)
    assert expected.rgb.std() > 5  # there is something to see


@pytest.mark.long
def test_two_views_under_way_do_not_mix(scene, away):
    recipe = scaled(Recipe(output=Output(depth="none", labels=False)))
    cameras = [frame.cameras["ahead"] for frame in scene.frames]
    begun = [begin_view(scene, camera, recipe, backend="cuda") for camera in cameras]
    alone = [render_view(scene, camera, recipe, backend="cpu") for camera in cameras]
    for view, expected in zip(reversed(begun), reversed(alone), strict=True):
        check_same(view.result(), expected)
    assert not np.array_equal(alone[0].rgb, alone[1].rgb)


# ---- snow ----------------------------------------------------------------------------------------


@pytest.mark.long
def test_a_bed_placed_on_the_gpu_is_the_cpus(monkeypatch):
    small = sheet((0.0, 1.4), (-0.7, 0.7))  # few splats, for an interpreted blend
    ground = dataclasses.replace(small, means=16 * small.means, scales=16 * small.scales)
    scene = drive(ground, places=[(-3.0, 0.0, 1.5)])
    cameras = [camera.scaled(0.12) for camera in cameras_of(scene)]
    settings = ExposureSettings(cell_m=8.0)
    monkeypatch.setattr(search, "_MAX_SQUARE_CELLS", 16)  # several, which threads work on
    expected = find_exposed_surface(scene, cameras, settings)
    assert len(expected.ground) > 5
    with pretended_gpu(monkeypatch):
        found = find_exposed_surface(scene, cameras, settings, backend="cuda")
    assert_alike(found.ground, expected.ground)


@pytest.mark.gpu
def test_a_larger_bed_with_a_vehicle_is_the_cpus():
    car = box_car(start=(6.0, 0.0))
    scene = drive(sheet((-6.0, 20.0), (-8.0, 8.0)), actors=[car])
    expected = find_exposed_surface(scene, cameras_of(scene), ExposureSettings(cell_m=0.1))
    found = find_exposed_surface(
        scene, cameras_of(scene), ExposureSettings(cell_m=0.1), backend="cuda"
    )
    assert found.actors.keys() == expected.actors.keys() == {"car"}
    for a, b in ((found.ground, expected.ground), (found.actors["car"], expected.actors["car"])):
        assert len(a) == pytest.approx(len(b), rel=1e-3)  # cells at a threshold
        assert float((a.sizes_m**2).sum()) == pytest.approx(float((b.sizes_m**2).sum()), rel=1e-3)


def assert_alike(found, expected) -> None:
    """The same cells; heights and colours within what float32 sums differ by."""
    for field in dataclasses.fields(expected):
        a, b = getattr(found, field.name), getattr(expected, field.name)
        assert not isinstance(a, AwayTensor)
        if a.dtype.is_floating_point:
            torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-4)
        else:
            assert torch.equal(a, b), field.name


# ---- copies, and the pretended GPU ---------------------------------------------------------------


def test_a_copy_lives_as_long_as_its_tensor_and_follows_its_changes(monkeypatch):
    gc.collect()  # what other tests have left
    with pretended_gpu(monkeypatch):
        before = len(gpu._copies)
        tensor = torch.arange(6.0)
        copy = gpu.gpu_copy(tensor)
        assert isinstance(copy, AwayTensor) and gpu.gpu_copy(tensor) is copy
        tensor[0] = 9
        assert float(gpu.gpu_copy(tensor)[0]) == 9
        del tensor, copy
        gc.collect()
        assert len(gpu._copies) == before


def test_the_pretended_gpu_refuses_what_a_real_one_would(monkeypatch):
    with pretended_gpu(monkeypatch):
        away, here = torch.ones(3).to(gpu.gpu_device()), torch.ones(3)
        assert (away + 1).device == gpu.gpu_device() and float((away + away).sum()) == 6
        with pytest.raises(RuntimeError, match="one lies on the CPU"):
            away + here
        with pytest.raises(RuntimeError):
            away.numpy()
        assert torch.equal(away.cpu(), here) and torch.equal(away.to("cpu"), here)
        made = torch.tensor([1.0, 2.0], device=away.device)
        assert isinstance(made, AwayTensor) and isinstance(torch.zeros_like(made), AwayTensor)
        away[1] = 5
        assert away.inner.tolist() == [1, 5, 1]
        with pytest.raises(AssertionError, match="a kernel was given a tensor of cpu"):
            gpu._kernel_argument(here)
        with pytest.raises(AssertionError, match="not contiguous"):
            gpu._kernel_argument(torch.ones(3, 2).to(gpu.gpu_device()).T)
        with pytest.raises(AssertionError, match="a kernel was given"):
            gpu._kernel_argument(np.int64(3))


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_without_a_gpu_kernels_are_interpreted_and_auto_does_not_take_them():
    assert gpu.is_interpreted() and gpu.gpu_device() == torch.device("cpu")
    assert available_backends()[CUDA] is None and not gpu.has_gpu()


# ---- compiling for a Hopper GPU ------------------------------------------------------------------

interpreted = pytest.mark.skipif(
    not gpu.is_interpreted(), reason="launches are recorded while kernels are interpreted"
)


def record_views(*names: str) -> list[Launch]:
    every = views()
    with recorded_launches() as counts:
        for name in names or every:
            every[name]()
    return [*counts]


@interpreted
@pytest.mark.long
def test_kernels_of_views_compile_into_what_they_should():
    """One of each kernel of a few views, since compiling takes seconds; all of them below."""
    launches = {each.name: each for each in record_views("clean")}
    assert launches.keys() >= {"project_gaussians", "count_tiles", "list_pairs", "blend_blocks"}
    assert not complaints(compile_launches([*launches.values()]))


@pytest.mark.gpu
def test_kernels_of_all_views_compile_into_what_they_should():
    """In a process in which they are interpreted, since here they run on the GPU."""
    code = (
        "from tests.augment.test_cuda_frame import *\n"
        "assert not (wrong := complaints(compile_launches(record_views()))), wrong"
    )
    environment = {**os.environ, "TRITON_INTERPRET": "1"}
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False, env=environment
    )
    if "only 0-dimensional arrays" in done.stderr:
        pytest.skip("this Triton interprets loops with older numpy only (3.6 with less than 2.4)")
    assert done.returncode == 0, done.stderr
