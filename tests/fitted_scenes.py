"""A small scene with everything a saved scene holds, and what it means that two are equal."""

from __future__ import annotations

import dataclasses

import numpy as np
import torch

from augment.scene.cameras import Frame
from augment.scene.scene import Actor, ColorSeries, Gaussians, Ground, Scene, Track
from augment.scene.sky import CubemapSky
from tests.scenes import camera_ahead, random_gaussians, random_pose

START_NS = 1_557_540_079_200_123_457  # too many digits for a float64


def fitted_scene(**changes) -> Scene:
    """Two actors of unlike degrees, one of them without classes, one with colours that change; two
    frames of two cameras.
    """
    rng = np.random.default_rng(7)
    background = with_classes(random_gaussians(50, seed=1, sh_degree=1))
    poses = torch.stack([random_pose(i, rng.normal(size=3)) for i in range(3)])
    times = torch.tensor([START_NS, START_NS + 99_999_999, START_NS + 200_000_001])
    car = Track(times, poses, hold_ns=5)
    person = Track(times[:1], poses[:1], max_gap_ns=300_000_001)
    phases = torch.tensor([0.1, 1 / 3, 2.0], dtype=torch.float64)
    waves = ColorSeries(torch.from_numpy(rng.normal(0, 0.1, (7, 4, 3)).astype("f4")), times, phases)
    actors = (
        Actor(
            "car/1",
            "Car",
            random_gaussians(7, sh_degree=0),
            car,
            (4.0, 2.0, 1.5),
            waves,
            colors_in_world=True,
        ),
        Actor("é", "Person", with_classes(random_gaussians(3)), person, (0.7, 0.6, 1.8)),
    )
    color_map, image_map = torch.from_numpy(rng.normal(size=(2, 3, 4)).astype(np.float32))
    frames = tuple(frame(number, START_NS + number * 100_000_000) for number in (4, 5))
    scene = Scene(
        name="drive 2",
        source="test:drive?a=b",
        background=background,
        actors=actors,
        sky=CubemapSky(torch.rand(6, 5, 5, 3, generator=torch.Generator().manual_seed(0))),
        frames=frames,
        world_origin_m=np.array([448_262.0, 4_421_337.0, -0.1]),
        ground_z_m=-1.2345678901234567,
        has_metric_scale=False,
        problems=("left/000003.jpg is missing", "one more"),
        color_maps={"ahead": color_map},
        image_color_maps={("left", START_NS + 500_000_000 - 1): image_map, ("gone", 0): color_map},
        recorded_source="test:recording",
        made_by={"steps": 30, "loss": [0.1, None], "config": {"seed": 0, "name": "ß"}},
        ground=Ground(-1.2345678901234567, -1.1, "lidar labels", 1 / 70, 41_233, None),
        has_known_gravity=False,
    )
    return dataclasses.replace(scene, **changes)


def frame(number: int, time_ns: int) -> Frame:
    ahead = camera_ahead(position=(0.1 * number, 0.3, 1 / 3), yaw=0.1, timestamp_ns=time_ns + 1)
    left = dataclasses.replace(camera_ahead(yaw=1.3, timestamp_ns=time_ns - 1), name="left")
    cameras = {"ahead": ahead, "left": left}
    return Frame(number, time_ns, random_pose(number), cameras, {"ahead": f"/data/{number}.jpg"})


def with_classes(gaussians: Gaussians) -> Gaussians:
    classes = (torch.arange(len(gaussians)) % 15).short()
    return dataclasses.replace(gaussians, semantic=classes)


def assert_same(a, b, *, but: tuple[str, ...] = (), where: str = "") -> None:
    """Equal to the bit, types and dtypes included."""
    if dataclasses.is_dataclass(a):
        assert type(a) is type(b), where
        for field in dataclasses.fields(a):
            if field.name not in but:
                ours, theirs = getattr(a, field.name), getattr(b, field.name)
                assert_same(ours, theirs, where=f"{where}.{field.name}")
    elif isinstance(a, torch.Tensor):
        assert isinstance(b, torch.Tensor) and a.dtype == b.dtype and a.shape == b.shape, where
        assert a.numpy().tobytes() == b.numpy().tobytes(), where
    elif isinstance(a, np.ndarray):
        assert a.dtype == b.dtype and a.tobytes() == b.tobytes(), where
    elif isinstance(a, dict):
        assert list(a) == list(b), where
        for key in a:
            assert_same(a[key], b[key], where=f"{where}[{key!r}]")
    elif isinstance(a, tuple):
        assert len(a) == len(b), where
        for i, (ours, theirs) in enumerate(zip(a, b, strict=True)):
            assert_same(ours, theirs, where=f"{where}[{i}]")
    else:
        assert a == b, where
