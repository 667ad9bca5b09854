"""Tiny scenes, labels and a stand-in renderer for the tests of batch jobs and datasets.

Worker processes and scripts import this module by name, so it needs nothing of pytest.
"""

from __future__ import annotations

import hashlib
import os
import signal
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from augment.effects.effect import EffectPlan, LabelInputs
from augment.effects.smog import SmogPlan
from augment.effects.snow.plan import SnowPlan
from augment.effects.style.color_maps import StyleMaps
from augment.errors import AdapterError
from augment.exposure.cells import OPEN_EDGE, ExposedCells, ExposedSurface
from augment.exposure.exposed_surface import exposed_surface_of
from augment.exposure.search import ExposureSettings
from augment.jobs.render_job import JobResult, RenderJob, run_job
from augment.render.fog import Fog
from augment.scene.cameras import Camera, Frame
from augment.scene.labels import Boxes, LidarSweep
from augment.scene.scene import Gaussians, Scene
from augment.scene.semantics import SemanticClass
from augment.scene.sky import ConstantSky
from augment.view.results import LabelSurfaces
from recipes.flood import Flood
from recipes.schema import Output, Recipe, Smog, Weather
from recipes.snow import Snow
from recipes.style import Style

ORIGIN_M = np.array([448_262.123456789, 4_421_337.987654321, 41.5])
LEVEL_Z_M = 0.2
THICKNESS_M = 0.15
DRY_NS = 10**18 + 300_000_001  # frame 3, rear/left: neither water nor snow is in view
SIZE = (24, 16)  # width and height of the cameras, pixels


@dataclass(frozen=True)
class FakeLabels:
    """Boxes and sweeps made from the frame's number. unreadable: frames whose files are broken."""

    unreadable: tuple[int, ...] = ()

    def boxes(self, frame_index: int) -> Boxes:
        if frame_index in self.unreadable:
            raise AdapterError(f"cuboids/{frame_index:02d}.pkl.gz is cut short")
        count = frame_index % 4
        rng = np.random.default_rng(frame_index)
        return Boxes(
            track_ids=tuple(f"track-{i}" for i in range(count)),
            labels=("Car",) * count,
            centers_m=rng.normal(size=(count, 3)) + ORIGIN_M,
            sizes_m=rng.uniform(1, 4, (count, 3)),
            quats=rng.normal(size=(count, 4)),
            attributes={
                "speed": rng.normal(size=(count, 3)).astype(np.float32),
                "parked": np.arange(count) % 2 == 0,
                "rider": np.array(["with", None, float("nan")][:count], object),
            },
        )

    def lidar(self, frame_index: int) -> LidarSweep | None:
        if frame_index == 3:
            return None  # as a dataset with a missing sweep
        rng = np.random.default_rng(100 + frame_index)
        xyz = rng.normal(size=(3, 50)) + ORIGIN_M[:, None]
        return LidarSweep({
            "x": xyz[0], "y": xyz[1], "z": xyz[2],
            "intensity": rng.integers(0, 255, 50).astype(np.uint8),
            "timestamp_ns": np.arange(50, dtype=np.int64) + 2**60,
            "sensor": np.array(["top", "front"] * 25),
            "note": np.array(["a", "bc"] * 25, object),
        })  # fmt: skip


@dataclass(frozen=True)
class FakeView:
    rgb: np.ndarray
    depth_m: np.ndarray | None = None
    semantic: np.ndarray | None = None
    instance: np.ndarray | None = None
    masks: dict[str, np.ndarray] = field(default_factory=dict)
    effects: dict[str, LabelInputs] = field(default_factory=dict)
    surface: LabelSurfaces | None = None


def open_fake(uri: str) -> Scene:
    """`fake:NAME?frames=N&unreadable=K`: a scene of N frames and two cameras."""
    name, _, query = uri.removeprefix("fake:").partition("?")
    options = dict(part.split("=") for part in query.split("&") if part)
    unreadable = tuple(int(options[k]) for k in ("unreadable",) if k in options)
    frames = tuple(make_frame(index) for index in range(int(options.get("frames", 4))))
    return Scene(
        name=name,
        source=f"fake:{name}",
        background=make_gaussians(),
        actors=(),
        sky=ConstantSky(torch.tensor([0.5, 0.6, 0.7])),
        frames=frames,
        labels=None if "unlabelled" in options else FakeLabels(unreadable),
        world_origin_m=ORIGIN_M,
    )


def make_gaussians(count: int = 40) -> Gaussians:
    rng = torch.Generator().manual_seed(0)
    means = torch.rand(count, 3, generator=rng) * torch.tensor([8.0, 4.0, 2.0])
    return Gaussians(
        means=means + torch.tensor([4.0, -2.0, 0.0]),
        quats=torch.nn.functional.normalize(torch.randn(count, 4, generator=rng), dim=-1),
        scales=torch.rand(count, 3, generator=rng) * 0.5 + 0.05,
        opacities=torch.rand(count, generator=rng),
        sh=torch.rand(count, 1, 3, generator=rng) - 0.5,
        semantic=(torch.arange(count) % 14).short(),
    )


def make_frame(index: int) -> Frame:
    time_ns = 10**18 + index * 100_000_000
    world_from_ego = torch.eye(4, dtype=torch.float64)
    world_from_ego[0, 3] = 0.1 * index
    cameras = {
        name: make_camera(name, time_ns + offset, 0.1 * index)
        for offset, name in enumerate(("front", "rear/left"))
    }
    return Frame(index, time_ns, world_from_ego, cameras)


def make_camera(name: str, time_ns: int, forward_m: float) -> Camera:
    """Looks along +x from (forward_m, 0, 1)."""
    camera_from_world = torch.tensor(
        [[0.0, -1, 0, 0], [0, 0, -1, 1], [1, 0, 0, -forward_m], [0, 0, 0, 1]], dtype=torch.float64
    )
    width, height = SIZE
    return Camera(name, width, height, 20.3, 20.1, 12.25, 8.5, camera_from_world, time_ns)


def make_recipe(
    name: str = "fog",
    variant: int = 0,
    flood: Flood | None = None,
    snow: Snow | None = None,
    style: Style | None = None,
    **output,
) -> Recipe:
    smog = Smog(visibility_m=50.0 + variant)
    weather = Weather(smog=smog if name == "fog" else None, flood=flood, snow=snow)
    settings = {"semantic": True, "instance": True, **output}
    numbers = {"name": name, "variant": variant, "seed": 7}
    return Recipe(**numbers, weather=weather, style=style, output=Output(**settings))


CLEAR = make_recipe("clear", lidar=True)
FOGGY = make_recipe(image="jpg", lidar=True)
FLOODED = make_recipe("clear", variant=9, flood=Flood(level_m=0.3), surface="first")


def fake_render(scene: Scene, camera: Camera, recipe: Recipe, *, backend: str) -> FakeView:
    """Noise that depends on scene, camera, time and recipe: nothing else, and on nothing less."""
    camera = camera.scaled(recipe.render.scale)
    key = f"{scene.name} {camera.name} {camera.timestamp_ns} {recipe.hash}"
    seed = int.from_bytes(hashlib.sha256(key.encode()).digest()[:8], "little")
    rng = np.random.default_rng(seed)
    shape = (camera.height, camera.width)
    output = recipe.output
    depth = rng.uniform(-10, 300, shape).astype(np.float32)
    view = FakeView(
        rgb=rng.integers(0, 256, (*shape, 3), dtype=np.uint8),
        depth_m=None if output.depth == "none" else depth,
        semantic=rng.integers(0, 15, shape, dtype=np.uint8) if output.semantic else None,
        instance=rng.integers(0, 600, shape).astype(np.uint16) if output.instance else None,
    )
    effects = fake_effects(camera, recipe, rng)
    masks = {"water": effects.get("flood"), "snow": effects.get("snow")}
    nowhere = np.zeros(shape, np.uint8)
    return replace(
        view,
        masks={n: nowhere if e.mask is None else e.mask for n, e in masks.items() if e},
        effects=effects,
        surface=None if scene.labels is None else fake_surface(rng, shape),
    )


def fake_surface(rng: np.random.Generator, shape: tuple[int, int]) -> LabelSurfaces:
    """Surfaces where the boxes are, of classes that none is of."""
    depth = rng.uniform(0, 4, shape).astype(np.float32)
    classes = np.full(shape, SemanticClass.ROAD, np.uint8)
    return LabelSurfaces(depth, None, depth, classes, False)


def fake_effects(
    camera: Camera, recipe: Recipe, rng: np.random.Generator
) -> dict[str, LabelInputs]:
    """Water on a third of the pixels and snow on half of them, but none in view of one image;
    surfaces where the boxes are.
    """
    weather, shape = recipe.weather, (camera.height, camera.width)

    def seen(placed: EffectPlan, share: float | None = None) -> LabelInputs:
        mask = None
        if share is not None:
            if camera.timestamp_ns == DRY_NS:
                return LabelInputs(placed, None, None, None)
            mask = np.where(rng.random(shape) < share, 255, 0).astype(np.uint8)
        return LabelInputs(placed, rng.uniform(0, 4, shape).astype(np.float32), mask, None)

    effects = {}
    if weather.flood is not None:
        effects["flood"] = seen(EffectPlan(None, (), water_level_z_m=LEVEL_Z_M), 1 / 3)
    if weather.snow is not None:
        snow = SnowPlan(weather.snow.model_copy(update={"depth_m": THICKNESS_M}), 0)
        effects["snow"] = seen(EffectPlan(snow, ()), 1 / 2)
    if weather.smog is not None:
        smog = weather.smog
        fog = (
            SmogPlan(Fog(smog.resolved_extinction_per_m, smog.color), False)
            if smog.resolved_extinction_per_m
            else None
        )
        effects["smog"] = seen(EffectPlan(fog, ()))
    if recipe.style is not None:
        effects["style"] = LabelInputs(EffectPlan(None, ()), None, None, None)
    return effects


def make_bed(x_m: float) -> ExposedSurface:
    """One cell at x_m, without anything under it."""
    cells = ExposedCells(
        centers_m=torch.tensor([[x_m, 0.0, 0.0]]),
        normals=torch.tensor([[0.0, 0.0, 1.0]]),
        sizes_m=torch.ones(1),
        edge_distance_m=torch.ones(1),
        neighbours=torch.full((1, 4), OPEN_EDGE, dtype=torch.int32),
        relative_light=torch.ones(1),
        track_share=torch.zeros(1),
        obstacle_vectors=torch.zeros(1, 2),
        semantic=torch.zeros(1, dtype=torch.int16),
        depth_share=torch.ones(1),
        hideable_ids=torch.zeros(0, dtype=torch.int32),
        covering_cells=torch.zeros(0, 5, dtype=torch.int32),
    )
    return ExposedSurface(cells, {})


def bed_render(scene: Scene, camera: Camera, recipe: Recipe, *, backend: str) -> FakeView:
    """As `style_render`, with the number that `make_bed` was given in the first pixel's red."""
    snow = recipe.weather.snow
    assert snow is not None
    bed = exposed_surface_of(
        scene, ExposureSettings(cell_m=snow.cell_m, max_slope_deg=snow.max_slope_deg)
    )
    view = style_render(scene, camera, recipe, backend=backend)
    view.rgb[0, 0, 0] = round(bed.ground.centers_m[0, 0].item() * 20)
    return view


def make_maps(red: float) -> StyleMaps:
    """Maps that give everything this much red."""
    one = torch.tensor([[0.0, 0, 0, red], [0, 1, 0, 0], [0, 0, 1, 0]])
    return StyleMaps(one[None], one, one)


def style_render(scene: Scene, camera: Camera, recipe: Recipe, *, backend: str) -> FakeView:
    """As `fake_render`, with the number that `make_maps` was given, times 100, in the second
    pixel's red.
    """
    from augment.effects.style.style import style_maps

    view = fake_render(scene, camera, recipe, backend=backend)
    if recipe.style is not None:
        maps = style_maps(scene, recipe.style)
        view.rgb[0, 1, 0] = round(100 * maps.picture[0, 3].item())
    return view


@dataclass
class FakePending:
    """A view that has been begun, as on a GPU."""

    finish: Callable[[], FakeView]

    def result(self) -> FakeView:
        return self.finish()


def begin_fake(scene: Scene, camera: Camera, recipe: Recipe, *, backend: str) -> FakePending:
    return FakePending(lambda: fake_render(scene, camera, recipe, backend=backend))


def slow_render(scene: Scene, camera: Camera, recipe: Recipe, *, backend: str) -> FakeView:
    time.sleep(0.02)
    return fake_render(scene, camera, recipe, backend=backend)


def must_not_render(scene: Scene, camera: Camera, recipe: Recipe, *, backend: str) -> FakeView:
    raise AssertionError(f"rendered camera {camera.name} again")


def render_dying_at_frame_2(
    scene: Scene, camera: Camera, recipe: Recipe, *, backend: str
) -> FakeView:
    """Kills its process, as the kernel does when memory runs out, at one image."""
    if camera.name == "front" and camera.timestamp_ns == make_frame(2).timestamp_ns:
        os.kill(os.getpid(), signal.SIGKILL)
    return bed_render(scene, camera, recipe, backend=backend)


def tree_digest(folder: Path) -> dict[str, str]:
    """SHA-256 of every file below a folder, by relative path."""
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def run_fake(job: RenderJob, renderer: Any = fake_render, **options) -> JobResult:
    """Run a job on the stand-in scenes, with a stand-in renderer unless it is None."""
    return run_job(
        job, renderer=renderer, **{"scene_loader": open_fake, "progress": False, **options}
    )


def fog_job(out: Path, uri: str = "fake:street", **options) -> RenderJob:
    """4 frames of 2 cameras in smog."""
    return RenderJob(uri, [make_recipe()], out, **options)


def write_scene(out: Path, recipes: list, name: str = "street", frames: int = 4) -> None:
    """A scene of two cameras under some recipes."""
    run_fake(RenderJob(f"fake:{name}?frames={frames}", recipes, out))


def assert_same_sample(a: Any, b: Any, *, but: tuple[str, ...] = ()) -> None:
    """Equal in types, dtypes and values; NaN equals NaN. but: keys that are not compared."""
    assert type(a) is type(b)
    if isinstance(a, dict):
        assert a.keys() == b.keys()
        for key in a.keys() - set(but):
            assert_same_sample(a[key], b[key])
    elif isinstance(a, list):
        for one, other in zip(a, b, strict=True):
            assert_same_sample(one, other)
    elif isinstance(a, torch.Tensor):
        same = np.array_equal(a.numpy(), b.numpy(), equal_nan=a.is_floating_point())
        assert a.dtype == b.dtype and same
    elif isinstance(a, np.ndarray):
        assert a.dtype == b.dtype and [repr(v) for v in a.ravel()] == [repr(v) for v in b.ravel()]
    elif isinstance(a, float):
        assert a == b or (a != a and b != b)
    else:
        assert a == b
