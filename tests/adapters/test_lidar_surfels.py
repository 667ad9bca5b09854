"""Points to surfels to Gaussians: thinning, normals, gaps."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch

from adapters.drivestudio.adapter import drivestudio_labels
from adapters.kitti.adapter import KittiLabels
from adapters.lidar_scene.depth import DepthPixels, read_returns
from adapters.lidar_scene.split import PointSet
from adapters.lidar_scene.surfels import (
    CLOSE_M,
    GROWTH,
    MAX_WALL_GAP_M,
    NEAR_M,
    SplatShape,
    borrow_colours,
    bridge_gaps,
    edges_at,
    fill_ground,
    fill_walls,
    gaussians_from_surfels,
    ground_points,
    surfels_from_points,
    thin_points,
)
from adapters.nuscenes.adapter import nuscenes_labels
from adapters.pandaset.adapter import SENSORS_M, PandaSetLabels, read_lidar
from adapters.procedural import LOWEST_DEG, StreetLabels, lidar_rays
from adapters.recording.adapter import RecordingLabels
from adapters.street.layout import StreetParameters
from adapters.street_gaussians.adapter import ROOF_SENSOR_M, StreetGaussiansLabels
from augment.errors import AdapterError
from augment.scene.cameras import Camera, Frame
from augment.scene.geometry import rotmat_from_quat
from augment.scene.labels import Boxes, KnowsLidarOrigins, LidarSweep
from augment.scene.scene import Actor, Scene, Track
from augment.scene.semantics import SemanticClass as Class
from augment.scene.sky import ConstantSky
from tests.adapters import nuscenes_files, pandaset_files, street
from tests.adapters.drives import camera as drives_camera
from tests.adapters.drives import one_splat
from tests.adapters.drivestudio_files import write_as_drivestudio

ORIGIN = np.zeros((1, 3), np.float32)


def point_set(points, semantic=Class.OTHER) -> PointSet:
    points = np.asarray(points, np.float32)
    return PointSet(points, np.broadcast_to(np.int16(semantic), len(points)).copy())


def plane(normal, spacing=(0.1, 0.1), half=1.0, centre=(0, 0, 0)) -> np.ndarray:
    """A grid of points on a plane; the spacing along its two axes may differ."""
    normal = np.asarray(normal, np.float64) / np.linalg.norm(normal)
    a = np.cross(normal, [0.3, 0.1, 1.0] if abs(normal[2]) < 0.9 else [1.0, 0, 0])
    a /= np.linalg.norm(a)
    b = np.cross(normal, a)
    u, v = (np.arange(-half, half + 1e-9, s) for s in spacing)
    grid = u[:, None, None] * a + v[None, :, None] * b
    return (grid.reshape(-1, 3) + centre).astype(np.float32)


def edges_of(points, metres: float) -> np.ndarray:
    return np.full(len(points), metres, np.float32)


def test_a_voxel_keeps_its_mean_and_commonest_class():
    points = np.float32(
        [[0.01, 0.01, 0.01], [0.03, 0.01, 0.01], [0.02, 0.04, 0.04], [0.3, 0, 0.01]] + 5 * [[9] * 3]
    )
    # Any number of unknown is outvoted by a known class.
    classes = [Class.ROAD, Class.POLE, Class.ROAD, Class.UNKNOWN, Class.SIGN] + 4 * [Class.UNKNOWN]
    some = PointSet(points, np.array(classes, np.int16))
    thin, edges = thin_points(some, np.float32([[0, 0, 0], [9, 9, 9]]), voxel_m=0.05)
    order = np.argsort(thin.points[:, 0])
    expected = [[0.02, 0.02, 0.02], [0.3, 0, 0.01], [9, 9, 9]]
    np.testing.assert_allclose(thin.points[order], expected, atol=1e-6)
    assert thin.semantic[order].tolist() == [Class.ROAD, Class.UNKNOWN, Class.SIGN]
    np.testing.assert_allclose(edges, 0.05)


def test_voxels_grow_with_distance_from_the_path():
    far = np.array([[NEAR_M / 2, 0, 0], [2 * NEAR_M, 0, 0], [8 * NEAR_M, 0, 0]])
    edges = edges_at(far, ORIGIN, voxel_m=0.1)
    np.testing.assert_allclose(edges, 0.1 * np.array([1, 2, 8]) ** GROWTH, rtol=1e-6)
    path = np.array([[0.0, 0, 0], [8 * NEAR_M, 0, 0]])
    assert edges_at(far[2:], path, voxel_m=0.1) == pytest.approx(0.1)


@pytest.mark.parametrize("normal", [(0, 0, 1), (1, 0, 0), (1, 2, 3)])
def test_normals_and_spacing_of_a_plane(normal):
    points = plane(normal, spacing=(0.1, 0.1))
    surfels = surfels_from_points(points, edges_of(points, 0.1))
    expected = np.asarray(normal) / np.linalg.norm(normal)
    np.testing.assert_allclose(np.abs(surfels.normals @ expected), 1, atol=1e-5)
    np.testing.assert_allclose((surfels.normals * surfels.major).sum(1), 0, atol=1e-5)
    inner = np.abs(points).max(axis=1) < 0.7
    # Axes at an angle to the grid see the diagonal neighbour, sqrt(2) away.
    assert (surfels.spacing[inner] > 0.099).all() and (surfels.spacing[inner] < 0.142).all()
    assert not surfels.isolated.any()


def test_rings_on_the_ground_are_stretched_across():
    points = plane((0, 0, 1), spacing=(0.05, 0.18))  # dense along a ring, sparse across
    classes = np.full(len(points), Class.ROAD, np.int16)
    surfels = surfels_from_points(points, edges_of(points, 0.05), semantic=classes)
    inner = np.abs(points).max(axis=1) < 0.6
    along = np.abs(surfels.major[inner] @ (points[1] - points[0])) / 0.18 < 0.5
    across = np.where(along, surfels.spacing[inner, 1], surfels.spacing[inner, 0])
    assert np.median(across) == pytest.approx(0.18, abs=0.02)
    assert np.abs(surfels.normals[inner, 2]).min() > 0.999


def test_two_wires_are_not_a_sheet():
    x = np.arange(-2, 2, 0.08)
    wires = [np.stack([x, np.full_like(x, y), np.full_like(x, 9.0)], 1) for y in (0.0, 0.3)]
    points = np.concatenate(wires).astype(np.float32)
    surfels = surfels_from_points(points, edges_of(points, 0.08))
    assert surfels.spacing.max() < 0.2
    assert len(bridge_gaps(point_set(points), edges_of(points, 0.08), surfels)) == 0


def test_a_lone_ring_faces_as_its_class_does():
    x = np.arange(-1, 1, 0.05)
    ring = np.stack([x, 0 * x, 0 * x], 1).astype(np.float32)
    for semantic, axis in ((Class.ROAD, 2), (Class.BUILDING, 1)):
        classes = np.full(len(ring), semantic, np.int16)
        surfels = surfels_from_points(ring, edges_of(ring, 0.05), semantic=classes)
        np.testing.assert_allclose(np.abs(surfels.normals[:, axis]), 1, atol=1e-4)


def test_points_far_from_all_others_and_too_few_are_isolated():
    points = np.concatenate([plane((0, 0, 1)), np.float32([[0, 0, 5]])])
    surfels = surfels_from_points(points, edges_of(points, 0.1))
    assert surfels.isolated.tolist() == [False] * (len(points) - 1) + [True]
    for count in (0, 3):
        few = surfels_from_points(points[:count], edges_of(points[:count], 1.0))
        assert len(few) == count and few.isolated.all()


def test_gaussians_are_flat_along_the_normal():
    points = plane((0, 0.6, 0.8))
    edge = edges_of(points, 0.1)
    surfels = surfels_from_points(points, edge)
    colours = np.tile(np.float32([0.2, 0.5, 0.9]), (len(points), 1))
    g = gaussians_from_surfels(surfels, colours, np.full(len(points), Class.BUILDING, np.int16))
    thin_axis = rotmat_from_quat(g.quats)[:, :, 2]
    np.testing.assert_allclose(np.abs(thin_axis.numpy() @ np.float32([0, 0.6, 0.8])), 1, atol=1e-4)
    assert (g.scales[:, 2] < 0.3 * g.scales[:, :2].amin(1)).all() and (g.scales > 0).all()
    np.testing.assert_allclose(g.sh[:, 0] * 0.28209479 + 0.5, colours, atol=1e-6)
    assert g.means.dtype == torch.float32 and g.semantic.dtype == torch.int16
    shape = SplatShape(opacity=0.5, sigma_per_spacing=1.0)
    wide = gaussians_from_surfels(surfels, colours, g.semantic.numpy(), shape)
    torch.testing.assert_close(wide.scales[:, :2], 2 * g.scales[:, :2])
    assert (wide.opacities == 0.5).all()


def test_unseen_points_borrow_the_nearest_colour_within_reach():
    points = np.float32([[0, 0, 0], [0.1, 0, 0], [3, 0, 0]])
    colours = np.float32([[1, 0, 0], [0, 0, 0], [0, 0, 0]])
    seen = np.array([True, False, False])
    got, known = borrow_colours(points, colours, seen, np.full(3, 0.5, np.float32))
    assert known.tolist() == [True, True, False]
    np.testing.assert_array_equal(got[:2], [[1, 0, 0], [1, 0, 0]])
    assert seen.tolist() == [True, False, False]  # the caller's arrays are left alone
    _, known = borrow_colours(points, colours, np.zeros(3, bool), np.ones(3, np.float32))
    assert not known.any()


def bridges(points: np.ndarray, edge: float) -> np.ndarray:
    some, edges = point_set(points, Class.VEHICLE), edges_of(points, edge)
    surfels = surfels_from_points(points, edges, semantic=some.semantic)
    return bridge_gaps(some, edges, surfels).points


def test_rings_on_one_surface_are_bridged_as_far_as_their_class_allows():
    points = plane((0, 1, 0), spacing=(0.05, 0.3))
    new = bridges(points, 0.05)
    assert len(new) > 4 * len(points) / 2
    assert np.abs(new[:, 1]).max() < 1e-5  # on the plane
    distance = np.abs(new[:, None] - points[None]).max(2).min(1)
    assert distance.max() < 0.16  # within the gaps, none further
    assert len(bridges(plane((0, 1, 0), spacing=(0.05, 0.6)), 0.05)) == 0
    step = np.concatenate([plane((0, 0, 1)), plane((0, 0, 1), centre=(0, 0, 0.3))])
    new = bridges(step, 0.1)
    assert not ((new[:, 2] > 0.05) & (new[:, 2] < 0.25)).any()


def test_walls_are_filled_between_rings_and_no_further():
    x = np.arange(0, 3, 0.1)
    heights = (0.0, 1.0, 2.5, 2.5 + MAX_WALL_GAP_M + 0.5)
    rows = [np.stack([x, np.full_like(x, 10), np.full_like(x, z)], 1) for z in heights]
    points = np.concatenate(rows).astype(np.float32)
    some = point_set(points, Class.BUILDING)
    edges = edges_of(points, 0.1)
    surfels = surfels_from_points(points, edges, semantic=some.semantic)
    new = fill_walls(some, edges, surfels)
    np.testing.assert_allclose(new.points[:, 1], 10, atol=1e-5)
    assert (new.semantic == Class.BUILDING).all()
    for low, high, filled in ((0.1, 0.9, True), (1.1, 2.4, True), (2.6, 5.9, False)):
        inside = (new.points[:, 2] > low) & (new.points[:, 2] < high)
        assert inside.any() == filled
    # One column in 0.2 m of wall, one point in 0.16 m of height.
    assert len(new) > 15 * 2.5 / 0.17 * 0.8
    cars = point_set(points, Class.VEHICLE)
    assert len(fill_walls(cars, edges, surfels)) == 0


def sloping_ground(hole_m: float) -> PointSet:
    x, y = np.meshgrid(np.arange(-12, 12, 0.2), np.arange(-12, 12, 0.2))
    x, y = x.ravel(), y.ravel()
    keep = np.hypot(x, y) > hole_m
    points = np.stack([x, y, 0.05 * x], 1)[keep]
    return point_set(points, Class.ROAD)


def test_a_hole_in_the_ground_is_filled_on_its_slope():
    ground = sloping_ground(2.0)
    new = fill_ground(ground, np.zeros((1, 3)), voxel_m=0.2)
    assert len(new) > np.pi * 2.0**2 / 0.4**2 * 0.8 and (new.semantic == Class.ROAD).all()
    assert np.hypot(new.points[:, 0], new.points[:, 1]).max() < 2.3
    # A plane is its own smoothest continuation; the rim's cells are known to their mean height.
    np.testing.assert_allclose(new.points[:, 2], 0.05 * new.points[:, 0], atol=0.02)


def test_ground_does_not_grow_outwards_nor_over_wide_holes_aside():
    wide = sloping_ground(CLOSE_M + 1.5)
    new = fill_ground(wide, np.array([[0.0, 30, 0]]), voxel_m=0.2)
    assert len(new) == 0 or np.hypot(new.points[:, 0], new.points[:, 1]).min() > 1.0
    assert len(new) == 0 or np.abs(new.points[:, :2]).max() < 12.3
    some = point_set(plane((0, 1, 0)), Class.BUILDING)  # no ground at all
    assert len(fill_ground(some, np.zeros((1, 3)), voxel_m=0.1)) == 0


def test_ground_goes_on_under_and_beside_the_car_however_wide_the_hole():
    new = fill_ground(sloping_ground(6.0), np.zeros((1, 3)), voxel_m=0.2)
    assert len(new) > np.pi * 6.0**2 / 0.4**2 * 0.8
    # Relaxed for smaller holes: in the widest, the slope is a little flatter than around.
    np.testing.assert_allclose(new.points[:, 2], 0.05 * new.points[:, 0], atol=0.1)


def test_without_classes_low_points_are_ground():
    ground = sloping_ground(0.0).points
    car = plane((0, 0, 1), half=1.0, centre=(3.0, 3.0, 1.5))
    wall = plane((0, 1, 0), half=2.0, centre=(0, 11.0, 3.6))
    found = ground_points(point_set(np.concatenate([ground, car, wall]), Class.UNKNOWN))
    assert found[: len(ground)].mean() > 0.9 and not found[len(ground) :].any()


WORLD_ORIGIN = np.array([5000.0, -3000.0, 0.0])
SECOND = 1_000_000_000


@dataclass(frozen=True)
class OneSweep:
    columns: dict | None

    def boxes(self, frame_index: int) -> Boxes:
        return Boxes.empty()

    def lidar(self, frame_index: int) -> LidarSweep | None:
        return None if self.columns is None else LidarSweep(self.columns)

    def lidar_classes(self, sweep: LidarSweep) -> np.ndarray | None:
        return sweep.columns.get("semantic")


def camera(time_s: float = 10.0) -> Camera:
    looking = drives_camera(size=(40, 30), focal_px=20.0, position=(0, 0, 0))
    return dataclasses.replace(looking, timestamp_ns=round(time_s * SECOND))


def scene(points, times_s, *, actors=(), **extra) -> Scene:
    world = np.asarray(points, np.float64) + WORLD_ORIGIN  # labels are in the dataset's world
    columns = {c: world[:, i] for i, c in enumerate("xyz")}
    columns |= {"t": np.asarray(times_s, np.float64)} | extra
    return made(columns, actors)


def made(columns, actors=()) -> Scene:
    frame = Frame(0, 10 * SECOND, torch.eye(4, dtype=torch.float64), {}, {})
    return Scene(
        "s", "test:", one_splat(), actors, ConstantSky(torch.ones(3)), (frame,), OneSweep(columns),
        world_origin_m=WORLD_ORIGIN,
    )  # fmt: skip


def driving_actor(speed_mps: float) -> Actor:
    """A box of 4 x 2 x 1.5 m, 10 m ahead at 10 s, driving away."""
    times = torch.tensor([9 * SECOND, 10 * SECOND, 11 * SECOND])
    poses = torch.eye(4, dtype=torch.float64).repeat(3, 1, 1)
    poses[:, 0, 3] = torch.tensor([10 - speed_mps, 10.0, 10 + speed_mps])
    return Actor("a", "Car", one_splat(), Track(times, poses), (4.0, 2.0, 1.5))


def seen(one: Scene, time_s: float = 10.0) -> DepthPixels:
    return read_returns(one, 0).seen_by(camera(time_s))


def test_the_nearest_return_of_a_pixel_gives_its_depth():
    depth = seen(scene([[10, 0, 0], [4, 1, 0.5], [7, 0, 0], [9, 0, 0]], [9.95, 10.02, 10, 10]))
    # u = 20 - 20 y / x, v = 15 - 20 z / x
    assert depth.pixels.tolist() == [12 * 40 + 15, 15 * 40 + 20] and depth.pixels.dtype == np.int32
    assert depth.depth_m.tolist() == [4, 7] and depth.depth_m.dtype == np.float32


def test_a_moving_objects_returns_are_carried_to_the_cameras_time():
    # Its rear face, 2 m behind its centre, seen a tenth of a second early and late; and the floor
    # of its box, which is ground.
    points = [[10 - 2 - 2, 0.0, 0.2], [10 - 2 + 2, 0.5, 0.2], [6.0, 3.0, 0.2], [5.0, 0.0, -0.7]]
    one = scene(points, [9.9, 10.1, 9.9, 9.85], actors=(driving_actor(20.0),))
    for time_s, depths in ((10.0, [5, 6, 8, 8]), (10.05, [5, 6, 9, 9]), (20.0, [5, 6])):
        np.testing.assert_allclose(np.sort(seen(one, time_s).depth_m), depths, atol=1e-6)


def test_returns_of_no_surface_are_told_by_the_labels():
    one = scene([[10, 0, 0], [5, 0, 1]], [10, 10], semantic=np.array([7, -1]))
    assert len(read_returns(one, 0).points) == 2
    np.testing.assert_allclose(read_returns(one, 0, of_surfaces=True).points, [[10, 0, 0]])


def test_times_of_returns_may_be_whole_numbers_or_missing():
    x, y, z = WORLD_ORIGIN[:, None] + np.array([[8], [0], [0]])
    columns = {"x": x, "y": y, "z": z}
    for more, time_ns in (
        ({}, 10 * SECOND),
        ({"timestamp_ns": np.array([7])}, 7),
        ({"t": np.array([9.5])}, 9_500_000_000),
        ({"t": np.array([1e6])}, 10 * SECOND),  # of some other start
    ):
        assert read_returns(made(columns | more), 0).timestamps_ns.tolist() == [time_ns]
    with pytest.raises(AdapterError, match=r"frame 0: its sweep's column timestamp_ns must hold"):
        read_returns(made(columns | {"timestamp_ns": np.array([7.5])}), 0)
    assert read_returns(made(None), 0) is None


PANDASET = Path(__file__).resolve().parents[3] / "shared" / "data" / "pandaset_mini" / "002"


def test_street_origins_give_back_the_beams() -> None:
    parameters = StreetParameters(frames=2, lidar_columns=16, lidar_rings=8)
    labels = StreetLabels(parameters)
    origins, directions, times = lidar_rays(parameters, 1)
    count = directions.shape[1]
    points = (origins[:, None] + 7.0 * directions).reshape(-1, 3)
    columns = {name: points[:, axis] for axis, name in enumerate("xyz")}
    sweep = LidarSweep({**columns, "timestamp_ns": np.repeat(times, count)})
    found = labels.lidar_origins(1, sweep)
    np.testing.assert_allclose(np.linalg.norm(points - found, axis=1), 7.0, atol=1e-9)
    lowest = np.degrees(np.arcsin((points - found)[::count, 2] / 7.0))
    np.testing.assert_allclose(lowest, LOWEST_DEG, atol=1e-6)
    assert isinstance(labels, KnowsLidarOrigins)


def test_pandasets_sensors_ride_on_the_car(tmp_path: Path) -> None:
    offset = np.array([1000.0, -50.0, 3.0])
    labels = PandaSetLabels(pandaset_files.write_as_pandaset(tmp_path, offset_m=offset))
    first = street.time_s(0)
    seconds = first + np.array([0.1, 0.05, 0.0, -0.1, 0.1])
    sweep = LidarSweep({name: np.zeros(5) for name in "xyz"} | {
        "t": seconds, "d": np.array([0, 0, 0, 0, 1]),
    })  # fmt: skip
    found = labels.lidar_origins(1, sweep) - offset
    along = street.EGO_SPEED_MPS * (seconds - first)
    expected = SENSORS_M[[0, 0, 0, 0, 1]] + along[:, None] * [1.0, 0.0, 0.0]
    np.testing.assert_allclose(found, expected, atol=1e-5)  # float64 seconds since 1970
    assert labels.lidar_origins(99, sweep) is None


@pytest.mark.skipif(not PANDASET.is_dir(), reason=f"{PANDASET} is not there")
def test_published_beams_of_each_sensor_do_not_cross() -> None:
    """From where a sensor is, its returns hide each other least: from half a metre beside, more of
    a direction's returns lie at different ranges.
    """
    table = read_lidar(PANDASET, 5)
    labels = PandaSetLabels(PANDASET)
    sweep = labels.lidar(5)
    assert table is not None and sweep is not None
    origins = labels.lidar_origins(5, sweep)
    forward = np.asarray(sweep.columns["d"]) == 1
    points, at = sweep.points_m[forward], origins[forward]

    def crossed(offset: tuple[float, float, float]) -> float:
        ray = points - at - np.array(offset)
        ranges = np.linalg.norm(ray, axis=1)
        azimuth = np.floor(np.degrees(np.arctan2(ray[:, 1], ray[:, 0])) / 0.15).astype(int)
        elevation = np.floor(np.degrees(np.arcsin(ray[:, 2] / ranges)) / 0.15).astype(int)
        order = np.lexsort([ranges, elevation, azimuth])
        same = (np.diff(azimuth[order]) == 0) & (np.diff(elevation[order]) == 0)
        return float((np.diff(np.log(ranges[order]))[same] > 0.1).mean())

    here = crossed((0.0, 0.0, 0.0))
    for axis in range(1, 3):
        for side in (-0.4, 0.4):
            offset = [0.0, 0.0, 0.0]
            offset[axis] = side
            assert crossed((offset[0], offset[1], offset[2])) > 1.1 * here


def test_nuscenes_sensor_at_the_files_time(tmp_path: Path) -> None:
    root = nuscenes_files.write_as_nuscenes(tmp_path)
    labels = nuscenes_labels(str(root), {"scene": "scene-0001"})
    sweep = labels.lidar(0)
    found = labels.lidar_origins(0, sweep)
    assert found.shape == (len(sweep), 3) and labels.lidar_origins(99, sweep) is None
    np.testing.assert_array_equal(found[0], labels.frames[0].sweep.world_from_sensor[:3, 3])
    ranges = np.linalg.norm(sweep.points_m - found, axis=1)
    assert np.median(ranges[np.isfinite(ranges)]) < 100


def test_kittis_velodyne(tmp_path: Path) -> None:
    pose = np.eye(4)
    pose[:3, 3] = 5.0, 6.0, 7.0
    labels = KittiLabels(tmp_path, {}, {}, {2: pose})
    sweep = LidarSweep({name: np.zeros(3) for name in "xyz"})
    np.testing.assert_array_equal(labels.lidar_origins(2, sweep), np.tile([5.0, 6.0, 7.0], (3, 1)))
    assert labels.lidar_origins(3, sweep) is None


def test_recordings_may_bring_their_own(tmp_path: Path) -> None:
    (tmp_path / "lidar").mkdir()
    columns = {name: np.arange(4.0) for name in ("x", "y", "z", "origin_x", "origin_y", "origin_z")}
    pq.write_table(pa.table(columns), tmp_path / "lidar" / "000000.parquet")
    labels = RecordingLabels(tmp_path)
    sweep = labels.lidar(0)
    np.testing.assert_array_equal(labels.lidar_origins(0, sweep), sweep.points_m)
    bare = LidarSweep({name: np.arange(4.0) for name in "xyz"})
    assert labels.lidar_origins(0, bare) is None


@pytest.mark.parametrize("dataset", ["waymo", "nuscenes", "pandaset"])
def test_drivestudio_data(tmp_path: Path, dataset: str) -> None:
    labels = drivestudio_labels(str(write_as_drivestudio(tmp_path, dataset=dataset).folder), {})
    sweep = labels.lidar(3)
    found = labels.lidar_origins(3, sweep)
    if dataset == "pandaset":
        assert found is None
    elif dataset == "waymo":
        np.testing.assert_array_equal(found[:, 0], sweep.columns["origin_x"])
    else:
        assert found.shape == (len(sweep), 3) and np.isfinite(found).all()


def test_waymos_roof_sensor(tmp_path: Path) -> None:
    (tmp_path / "ego_pose").mkdir()
    pose = np.array([[0.0, -1, 0, 10], [1, 0, 0, 20], [0, 0, 1, 30], [0, 0, 0, 1]])
    np.savetxt(tmp_path / "ego_pose" / "000004.txt", pose)
    labels = StreetGaussiansLabels(tmp_path)
    sweep = LidarSweep({name: np.zeros(2) for name in "xyz"})
    forward, left, up = ROOF_SENSOR_M
    expected = [10 - left, 20 + forward, 30 + up]
    np.testing.assert_allclose(labels.lidar_origins(4, sweep), np.tile(expected, (2, 1)))
    assert labels.lidar_origins(5, sweep) is None
