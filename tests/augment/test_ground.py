"""The road's height from labelled returns, splats, planes through low points, and the path alone.

The made-up road is a plane over x, so its heights are known; points on it are noisy and random.
"""

from __future__ import annotations

import dataclasses
import logging
import math
import sys

import numpy as np
import pytest
import torch

from augment.errors import BackendUnavailable, SceneError
from augment.scene.cameras import Frame
from augment.scene.ground import Stretches, ground_of, ground_points, load_open3d, measure_ground
from augment.scene.labels import Boxes, LidarSweep
from augment.scene.scene import Gaussians, Ground, Scene
from augment.scene.semantics import SemanticClass as Class
from augment.scene.sky import ConstantSky
from tests.scenes import camera_ahead, one_gaussian
from tests.snow_scenes import splats, stack_all

LENGTH_M, CAMERA_M, NOISE_M = 45.0, 1.6, 0.02
FRAMES = 10
# The median height of some hundred points with 2 cm of noise is off by about a millimetre, and the
# points of a stretch do not lie quite evenly: on a slope of 5 % that is another centimetre.
HEIGHT_M = 0.015


@pytest.fixture
def with_open3d():
    try:
        load_open3d()
    except BackendUnavailable as error:
        pytest.skip(str(error))


def road(slope: float = 0.0, *, count: int = 40_000, seed: int = 0) -> np.ndarray:
    """Points [N, 3] of a road 8 m wide, z = slope x, from 10 m before the path to 10 m beyond."""
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(-10, LENGTH_M + 10, count), rng.uniform(-4, 4, count)
    return np.stack([x, y, slope * x + rng.normal(0, NOISE_M, count)], axis=1)


def clutter(*, seed: int = 1) -> np.ndarray:
    """Walls on both sides, a car's body beside the path, and strays far below the ground."""
    rng = np.random.default_rng(seed)
    x = rng.uniform(-10, 55, 8000)
    y = rng.choice([-4.2, 4.2], 8000) + rng.normal(0, 0.02, 8000)
    wall = np.stack([x, y, rng.uniform(0, 6, 8000)], axis=1)
    car = rng.uniform([8, -3, 0.3], [12, -1.5, 1.5], (3000, 3))
    strays = rng.uniform([-5, -4, -5], [50, 4, -1], (60, 3))
    return np.concatenate([wall, car, strays])


def path(slope: float = 0.0, *, ego_m: float = 0.0) -> np.ndarray:
    x = np.linspace(0, LENGTH_M, FRAMES)
    return np.stack([x, np.zeros(FRAMES), slope * x + ego_m], axis=1)


@dataclasses.dataclass(frozen=True)
class PlainLabels:
    """A source of labels as anyone may write it: it does not say what its classes mean."""

    points: np.ndarray
    classes: np.ndarray | None = None

    def boxes(self, frame_index: int) -> Boxes:
        return Boxes.empty()

    def lidar(self, frame_index: int) -> LidarSweep | None:
        part = slice(frame_index, None, FRAMES)
        columns = dict(zip("xyz", self.points[part].T, strict=True))
        if self.classes is not None:
            columns["semantic"] = self.classes[part]
        return LidarSweep(columns)


@dataclasses.dataclass(frozen=True)
class KnownLabels(PlainLabels):
    """Class 7 is road, 9 a return of no surface, and all else unknown."""

    def lidar_classes(self, sweep: LidarSweep) -> np.ndarray | None:
        numbers = sweep.columns["semantic"]
        return np.where(numbers == 7, Class.ROAD, np.where(numbers == 9, -1, 0)).astype(np.int16)


def balls(points: np.ndarray, semantic: int | None = None, opacity: float = 0.9) -> Gaussians:
    return splats(points, (0.05, 0.05, 0.05), semantic=semantic, opacity=opacity)


def scene(slope: float = 0.0, *, ego_m: float = 0.0, **changes) -> Scene:
    """A drive along the path; cameras CAMERA_M above the road, the ego origin ego_m above it."""
    frames = []
    for number, place in enumerate(path(slope)):
        camera = camera_ahead(position=tuple(place + np.array([0, 0, CAMERA_M])))
        pose = torch.eye(4, dtype=torch.float64)
        pose[:3, 3] = torch.from_numpy(place + np.array([0, 0, ego_m]))
        frames.append(Frame(number, number * 10**8, pose, {camera.name: camera}))
    sky = ConstantSky(torch.zeros(3))
    base = Scene("made up", "test:", one_gaussian((0.0, 0.0, 30.0)), (), sky, tuple(frames))
    return dataclasses.replace(base, **changes)


@pytest.mark.parametrize("slope", [0.0, -0.08])
def test_a_road_on_a_slope_has_its_low_end_its_middle_and_its_tilt(slope: float) -> None:
    ground = measure_ground(road(slope), path(slope), "lidar labels")
    assert ground is not None
    assert ground.lowest_z_m == pytest.approx(min(0, slope * LENGTH_M), abs=HEIGHT_M)
    assert ground.median_z_m == pytest.approx(slope * LENGTH_M / 2, abs=HEIGHT_M)
    # Of a normal distribution the median deviation is 0.6745 standard deviations.
    assert ground.residual_m == pytest.approx(0.6745 * NOISE_M, rel=0.05)
    assert ground.tilt_deg == pytest.approx(abs(math.degrees(math.atan(slope))), abs=0.05)
    assert 5000 < ground.points < 40_000


def test_a_dip_counts_where_a_neighbour_confirms_it_and_a_hole_does_not() -> None:
    points = road()
    dip = np.clip(1 - np.abs(points[:, 0] - 24) / 8, 0, 1)
    dipped = points - dip[:, None] * [0, 0, 0.5]
    ground = measure_ground(dipped, path(), "lidar labels")
    # The deepest stretch reaches 1.5 m to both sides, where the dip is 9 cm less deep.
    assert ground is not None and ground.lowest_z_m == pytest.approx(-0.45, abs=0.05)
    hole = points - (np.abs(points[:, :1] - 24) < 1.6) * [0, 0, 0.8]
    ground = measure_ground(hole, path(), "lidar labels")
    # A median of points some of which fall into the hole may be a noise's width lower.
    assert ground is not None and ground.lowest_z_m == pytest.approx(0, abs=NOISE_M)


def test_a_car_that_stands_finds_the_road_it_does_not_see_below_itself() -> None:
    points = road()
    ring = points[np.hypot(points[:, 0] - 20, points[:, 1]) > 5]
    rng = np.random.default_rng(0)
    standing = np.array([20.0, 0, 0]) + rng.normal(0, 0.01, (300, 3))
    assert len(Stretches.along_path(standing)) == 1
    ground = measure_ground(ring, standing, "lidar labels")
    assert ground is not None and ground.lowest_z_m == ground.median_z_m
    assert ground.lowest_z_m == pytest.approx(0, abs=HEIGHT_M)


def test_labelled_returns_come_first_and_are_the_datasets_minus_its_origin() -> None:
    """Kilometres from zero, in float64; the splats would say something else."""
    origin = np.array([448_262.0, 4_421_337.0, 312.0])
    points = np.concatenate([road(0.05), clutter()])
    classes = np.repeat([7, 3], [40_000, len(points) - 40_000])
    labels = KnownLabels(points + origin, classes)
    wrong = balls(road() + np.array([0, 0, 0.7]), Class.ROAD)
    labelled_scene = scene(0.05, labels=labels, world_origin_m=origin, background=wrong)
    ground = ground_of(labelled_scene)
    assert ground.source == "lidar labels"
    assert ground.lowest_z_m == pytest.approx(0, abs=HEIGHT_M)
    assert ground.median_z_m == pytest.approx(0.05 * LENGTH_M / 2, abs=HEIGHT_M)
    assert ground_of(labelled_scene) is ground  # remembered
    assert ground_of(dataclasses.replace(labelled_scene)) == ground


def test_classes_nobody_explains_are_not_taken_for_roads(with_open3d) -> None:
    """Number 1 means road among our own classes only."""
    points = np.concatenate([road(), clutter()])
    labels = PlainLabels(points, np.where(points[:, 2] > 1, 1, 0))
    ground = ground_of(scene(labels=labels))
    assert ground.source == "ransac"
    assert ground.lowest_z_m == pytest.approx(0, abs=HEIGHT_M)


def test_road_splats_come_second() -> None:
    faint = balls(road(0.05) - np.array([0, 0, 0.5]), Class.ROAD, opacity=0.1)
    both = stack_all([balls(road(0.05), Class.LANE_MARKING), faint])
    ground = ground_of(scene(0.05, background=both))
    assert ground.source == "road splats"
    assert ground.lowest_z_m == pytest.approx(0, abs=HEIGHT_M)


@pytest.mark.parametrize("slope", [0.0, 0.1])
def test_planes_find_the_road_among_walls_cars_and_strays(with_open3d, slope: float) -> None:
    points = np.concatenate([road(slope), clutter() + np.array([0, 0, slope * LENGTH_M / 2])])
    ground = ground_of(scene(slope, background=balls(points)))
    assert ground.source == "ransac"
    assert ground.lowest_z_m == pytest.approx(0, abs=HEIGHT_M)
    assert ground.median_z_m == pytest.approx(slope * LENGTH_M / 2, abs=HEIGHT_M)


@pytest.mark.long
def test_a_road_that_climbs_and_falls_has_a_plane_for_each_part(with_open3d) -> None:
    """A hill of 4 m over 200 m, which no single plane is near."""
    rng = np.random.default_rng(0)
    x = rng.uniform(0, 200, 80_000)
    height = 2 * (1 - np.cos(2 * np.pi * x / 200))
    points = np.stack([x, rng.uniform(-4, 4, len(x)), height + rng.normal(0, 0.02, len(x))], 1)
    along = np.linspace(5, 195, 60)
    drive = np.stack([along, 0 * along, 2 * (1 - np.cos(2 * np.pi * along / 200))], 1)
    ground = measure_ground(ground_points(points, drive), drive, "ransac")
    assert ground is not None
    # Within a window the road bends away from its plane by up to 0.1 m, and what lies further off
    # than 0.15 m is left out.
    assert ground.lowest_z_m == pytest.approx(drive[:, 2].min(), abs=0.1)
    assert ground.median_z_m == pytest.approx(np.median(drive[:, 2]), abs=0.1)


@pytest.mark.parametrize(("ego_m", "lowest"), [(0.0, 0.0), (CAMERA_M, 0.1), (2.0, 0.1)])
def test_without_points_the_path_says_where_the_car_stood(ego_m: float, lowest: float) -> None:
    """An ego origin well below the cameras is on the road; otherwise the road is 1.5 m below the
    cameras, which stand at 1.6 m.
    """
    ground = ground_of(scene(0.02, ego_m=ego_m))
    assert ground.source == "ego path"
    assert ground.residual_m is None and ground.tilt_deg is None and ground.points == 0
    assert ground.lowest_z_m == pytest.approx(lowest)
    assert ground.median_z_m == pytest.approx(lowest + 0.02 * LENGTH_M / 2)
    estimated = ground_of(scene(ego_m=ego_m, ground_z_m=-0.3))
    assert (estimated.lowest_z_m, estimated.source) == (-0.3, "ego path")


def test_without_open3d_the_path_stands_in_and_the_log_says_what_to_install(
    monkeypatch, caplog
) -> None:
    monkeypatch.setitem(sys.modules, "open3d", None)  # importing it then fails
    with caplog.at_level(logging.WARNING, logger="augment.scene.ground"):
        ground = ground_of(scene(background=balls(np.concatenate([road(), clutter()]))))
    assert ground.source == "ego path"
    (record,) = caplog.records
    for package in ("pip install open3d", "libusb-1.0-0", "libgl1", "libx11-6", "libgomp1"):
        assert package in record.getMessage()


@pytest.mark.parametrize(
    ("changes", "unknown", "example"),
    [
        (
            {"has_metric_scale": False, "has_known_gravity": False},
            "not known: which way is up and how long a unit is.",
            "gaussians:a.ply?path=drive&up=-y&scale=0.35,",
        ),
        ({"has_metric_scale": False}, "not known: how long a unit is.", "path=drive&scale=0.35,"),
        ({"has_known_gravity": False}, "not known: which way is up.", "path=drive&up=-y,"),
    ],
)
def test_metres_and_gravity_are_asked_for_together(changes, unknown: str, example: str) -> None:
    stated = Ground(0.0, 0.0, "stated")  # a height does not say which way is up
    doubtful = scene(source="gaussians:a.ply?path=drive", ground=stated, **changes)
    with pytest.raises(SceneError) as caught:
        ground_of(doubtful)
    message = str(caught.value)
    assert unknown in message and example in message
    assert "up is the file's axis" in message and "scale is metres per unit" in message
    elsewhere = dataclasses.replace(doubtful, source="scene:fit")
    with pytest.raises(SceneError, match=r"gaussians:PATH\?up=-y&scale=0.35"):
        ground_of(elsewhere)
