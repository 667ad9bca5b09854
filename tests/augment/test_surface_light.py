"""Light of lamps on surfaces: lux on a road, normals, shadows of own beams, signs."""

from __future__ import annotations

import math
from dataclasses import replace

import numba
import numpy as np
import pytest
import torch

from augment.lamps import surface_light_kernels, surface_normal_kernels
from augment.lamps.beam_shadows import draw_beam_shadows, looks_into
from augment.lamps.lamp import EGO_OWNER, LampKind, Lamps
from augment.lamps.patterns import DIPPED_PEAK_CD, Pattern
from augment.lamps.surface_light import illuminance, return_share, surface_light
from augment.lamps.surface_light_kernels import TILE
from augment.lamps.surface_normals import Nodes, find_nodes, node_view
from augment.render.constants import RasterSettings
from augment.scene.cameras import Camera
from augment.scene.scene import PosedGaussians
from tests.lamp_scenes import camera_at, lamps_at, road_depth
from tests.streets import open_street

LAMP_HEIGHT_M = 0.65


def white(camera: Camera) -> np.ndarray:
    return np.ones((camera.height, camera.width, 3), np.float32)


def pixel_of(camera: Camera, point: tuple[float, float, float]) -> tuple[int, int]:
    """Return row and column of a point of the world."""
    x, y, z = (camera.camera_from_world.numpy() @ np.array([*point, 1.0]))[:3]
    return int(camera.fy * y / z + camera.cy), int(camera.fx * x / z + camera.cx)


@pytest.mark.parametrize(
    ("distance_m", "candela", "lux"), [(10.0, 5000.0, 3.25), (25.0, 10000.0, 0.42)]
)
def test_road_lux_is_candela_times_height_over_distance_cubed(
    distance_m: float, candela: float, lux: float
) -> None:
    camera = camera_at(1.5, width=400, height=300, focal_px=600)
    depth = road_depth(camera)
    lamp = lamps_at([(0, 0, LAMP_HEIGHT_M)], candela=candela)
    luminance = surface_light(lamp, camera, depth, white(camera))
    row, column = pixel_of(camera, (distance_m, 0, 0))
    # A pixel's row is 0.3 m of the road at 10 m, and 1.7 m at 25 m, over which lux fall by 3 / d.
    z = depth[row, column]
    expected = candela * LAMP_HEIGHT_M / (z**2 + LAMP_HEIGHT_M**2) ** 1.5
    assert luminance[row, column, 1] * math.pi == pytest.approx(expected, rel=0.01)
    # The text's numbers: 3.25 and 0.42 lx.
    nearest = illuminance(lamp, np.array([[distance_m, 0, 0]]), np.array([[0, 0, 1.0]]))
    assert float(nearest[0, 0]) == pytest.approx(lux, rel=0.015)


def test_dipped_beams_light_the_road_before_the_car() -> None:
    pair = lamps_at(
        [(0, 0.6, LAMP_HEIGHT_M), (0, -0.6, LAMP_HEIGHT_M)],
        (1, 0, 0),
        candela=DIPPED_PEAK_CD,
        pattern=Pattern.DIPPED_RIGHT,
    )
    points = np.array([[d, 0.0, 0.0] for d in (10, 25, 60)])
    lux = illuminance(pair, points, np.tile([0, 0, 1.0], (3, 1))).sum(1)
    # Two lamps of 5 to 7 kcd at 10 m, of 10 to 14 kcd at 25 m; the aim of -1 % ends at 65 m.
    assert 5 < lux[0] < 11
    assert 0.7 < lux[1] < 1.3
    assert lux[2] < 0.1


def test_kernel_equals_definition() -> None:
    camera = camera_at(1.5, width=101, height=67, focal_px=90)
    depth = road_depth(camera, 80.0)
    rng = np.random.default_rng(0)
    places = rng.uniform((5, -10, 0.5), (60, 10, 9), (12, 3)).tolist()
    lamps = Lamps.concatenate(
        [
            lamps_at(places[:6], candela=20000, pattern=Pattern.STREET, color=(1.2, 0.9, 0.4)),
            lamps_at(places[6:], (-1, 0.2, 0), candela=8000, pattern=Pattern.DIPPED_RIGHT),
        ]
    )
    nodes = find_nodes(camera, depth, step_px=1)
    extinction = 0.03
    luminance = surface_light(
        lamps,
        camera,
        depth,
        white(camera),
        nodes=nodes,
        extinctions_per_m=extinction,
        lamps_per_pixel=12,
    )
    points = camera.centre.numpy() + camera.ray_directions().double().numpy() * depth[..., None]
    lux = illuminance(
        lamps, points.reshape(-1, 3), nodes.normals.astype(np.float64).reshape(-1, 3), extinction
    )
    expected = (lux @ lamps.colors).reshape(luminance.shape) / math.pi
    expected[depth == 0] = 0
    # float32 sums of twelve lamps.
    np.testing.assert_allclose(luminance, expected, rtol=2e-5, atol=1e-5)


def test_lamps_at_a_grazing_angle_do_not_replace_those_above() -> None:
    camera = camera_at(1.5, width=101, height=67, focal_px=90)
    depth = road_depth(camera, 80.0)
    above = lamps_at([(15, 0, 8)], candela=2000)
    low = lamps_at([(15, y, 0.02) for y in range(-9, 9, 2)], candela=2000)
    alone = surface_light(above, camera, depth, white(camera))
    lamps = Lamps.concatenate([low, above])
    both = surface_light(lamps, camera, depth, white(camera), lamps_per_pixel=2)
    is_lit = alone[..., 1] > 0
    is_kept = (both >= 0.999 * alone).all(-1)
    # Two of the low lamps are brighter only in the row of tiles in which they stand.
    row, _ = pixel_of(camera, (15, 0, 0))
    first = row // TILE * TILE
    assert is_kept[:first].all()
    assert is_kept[first + TILE :].all()
    # That row is a quarter of the lit road.
    assert is_kept[is_lit].mean() > 0.75


def test_lamps_left_out_add_less_than_the_threshold() -> None:
    camera = camera_at(1.5, width=96, height=64, focal_px=80)
    depth = road_depth(camera, 200.0)
    lamps = lamps_at([(d, 3, 1.0) for d in (10, 30, 80, 160)], candela=10)
    everything = surface_light(lamps, camera, depth, white(camera))
    some = surface_light(lamps, camera, depth, white(camera), min_luminance_cd_m2=1e-3)
    assert (everything - some).max() <= len(lamps) * 1e-3
    assert not np.array_equal(everything, some)


def test_own_lamps_left_out_add_less_than_the_threshold_to_signs() -> None:
    camera = camera_at(1.2, width=200, height=120, focal_px=150)
    depth = np.full((120, 200), 60.0, np.float32)
    is_sign = np.ones((120, 200), bool)
    own = lamps_at([(0, 0, 1.0)], candela=1.0, owner=EGO_OWNER)
    everything = surface_light(own, camera, depth, white(camera), is_sign=is_sign)
    # The sign gets 20 times the threshold. A wall in its place would get a fiftieth of it.
    threshold = float(everything[60, 100, 1]) / 20
    some = surface_light(
        own, camera, depth, white(camera), is_sign=is_sign, min_luminance_cd_m2=threshold
    )
    wall = surface_light(own, camera, depth, white(camera), min_luminance_cd_m2=threshold)
    np.testing.assert_array_equal(some, everything)
    assert not wall.any()
    some = surface_light(
        own, camera, depth, white(camera), is_sign=is_sign, min_luminance_cd_m2=1e4 * threshold
    )
    assert not some.any()


def test_lamp_below_the_horizon_of_a_surface_does_not_light_it() -> None:
    camera = camera_at(1.5)
    depth = road_depth(camera)
    lamp = lamps_at([(20, 0, -0.5)], candela=1e5)
    assert not surface_light(lamp, camera, depth, white(camera)).any()


def test_normals_of_road_and_wall_are_exact_and_the_sky_has_none() -> None:
    camera = camera_at(1.5, pitch_deg=2)
    rays = camera.ray_directions().numpy()
    wall = np.where(rays[..., 0] > 0, 20 / rays[..., 0], 0)  # x = 20 m
    depth = road_depth(camera)
    is_wall = (depth == 0) | (depth * rays[..., 0] > 20)
    depth = np.where(is_wall, wall, depth).astype(np.float32)
    depth[:20] = 0
    nodes = find_nodes(camera, depth, step_px=2)
    is_wall = is_wall[1::2, 1::2]
    inner = np.zeros_like(is_wall)
    inner[15:60, 10:-10] = True
    edge = is_wall
    far_from_edge = inner & (edge == np.roll(edge, 6, 0)) & (edge == np.roll(edge, -6, 0))
    walls = nodes.normals[far_from_edge & is_wall]
    roads = nodes.normals[far_from_edge & ~is_wall]
    assert len(walls) > 100
    # 0.3 degrees: the wall's mean has a little of the road at its foot.
    np.testing.assert_allclose(walls, np.tile([-1.0, 0, 0], (len(walls), 1)), atol=5e-3)
    np.testing.assert_allclose(roads, np.tile([0, 0, 1.0], (len(roads), 1)), atol=1e-3)
    assert not nodes.normals[:9].any()


def test_noise_of_the_depth_leaves_the_road_evenly_lit() -> None:
    camera = camera_at(1.5, width=480, height=270, focal_px=450)
    depth = road_depth(camera, 60.0)
    rng = np.random.default_rng(1)
    noisy = (depth * (1 + 0.004 * rng.standard_normal(depth.shape))).astype(np.float32)
    lamp = lamps_at([(0, 0, LAMP_HEIGHT_M)], candela=10000)
    clean, found = (
        surface_light(lamp, camera, z, white(camera), nodes=find_nodes(camera, z, step_px=2))
        for z in (depth, noisy)
    )
    ratio = found[230:, 60:-60, 1] / clean[230:, 60:-60, 1]
    # 0.4 % of the depth is 2 cm at 5 m: its slopes alone would change the light by more than half.
    assert ratio.std() < 0.15
    assert ratio.mean() == pytest.approx(1, abs=0.1)


def test_bulges_of_a_front_leave_it_evenly_lit_and_edges_stay() -> None:
    camera = camera_at(1.5, width=480, height=270, focal_px=450)
    rays = camera.ray_directions().numpy()
    far = 12 / rays[..., 0]  # x = 12 m
    rows, columns = np.mgrid[:270, :480]
    waves = np.sin(rows / 4.0) * np.sin(columns / 4.0)
    bulging = far * (1 + 0.004 * waves)  # 5 cm
    depth = np.where(columns < 120, 0.6 * far, bulging).astype(np.float32)
    smooth = np.where(columns < 120, 0.6 * far, far).astype(np.float32)
    lamp = lamps_at([(9, -3, 6)], candela=5000)
    lit, expected = (
        surface_light(lamp, camera, z, white(camera), nodes=find_nodes(camera, z))[..., 1]
        for z in (depth, smooth)
    )
    front = np.s_[60:210, 190:420]
    raw = np.empty((135, 240, 3), np.float32)
    slopes = np.empty_like(raw)
    inverse = np.ascontiguousarray(1 / depth[1::2, 1::2])
    surface_normal_kernels.find_slopes(inverse, node_view(camera, 2), slopes)
    surface_normal_kernels.average_normals(inverse, slopes, raw)
    unsmoothed = surface_light(
        lamp, camera, depth, white(camera), nodes=Nodes(depth[1::2, 1::2].copy(), raw, 2)
    )[..., 1]
    deviation = (lit[front] / expected[front]).std()
    assert deviation < 0.5 * (unsmoothed[front] / expected[front]).std()
    nearer = np.s_[60:210, 20:100]
    np.testing.assert_allclose(lit[nearer], expected[nearer], rtol=1e-3)


def test_signs_send_own_light_back_as_their_sheeting_does() -> None:
    camera = camera_at(1.2, width=200, height=120, focal_px=150)
    depth = np.full((120, 200), 60.0, np.float32)
    is_sign = np.zeros((120, 200), bool)
    is_sign[50:70, 90:110] = True
    own = lamps_at([(0, 0, 0.65)], (1, 0, 0), candela=5000, owner=EGO_OWNER)
    foreign = lamps_at([(0, 0, 0.65)], (1, 0, 0), candela=5000)
    grey = 0.7 * white(camera)
    lit = surface_light(own, camera, depth, grey, is_sign=is_sign)
    wall = surface_light(own, camera, depth, grey)
    lux = 5000 / 60.0**2
    angle = math.atan(0.55 / 60)
    coefficient = 250 * float(return_share(np.array([angle]))[0])
    added = float(lit[60, 100, 1] - wall[60, 100, 1])
    assert added == pytest.approx(coefficient * lux, rel=0.02)
    assert added > 30 * float(wall[60, 100, 1])
    np.testing.assert_array_equal(lit[~is_sign], wall[~is_sign])
    foreign_light = surface_light(foreign, camera, depth, grey, is_sign=is_sign)
    np.testing.assert_array_equal(foreign_light, wall)


def test_return_of_signs_falls_with_the_observation_angle() -> None:
    degrees = np.array([0.0, 0.2, 0.33, 2.0, 4.0])
    share = return_share(np.radians(degrees))
    np.testing.assert_allclose(share[:4], [1, 1, 180 / 250, 5 / 250], rtol=1e-6)
    assert 0 < share[4] < share[3]


def test_own_beams_throw_shadows_and_the_road_none_on_itself() -> None:
    street = open_street()
    frame = street.frames[0]
    camera = frame.cameras["front"].scaled(0.25)
    parts = street.parts_for(camera)
    ego = frame.world_from_ego.numpy()
    place = ego[:3, 3] + 1.9 * ego[:3, 0]
    place[2] = LAMP_HEIGHT_M
    own = lamps_at(
        [place.tolist()], ego[:3, 0].tolist(), candela=10000, kind=LampKind.DIPPED, owner=EGO_OWNER
    )
    shadows = draw_beam_shadows(own, parts, settings=RasterSettings(), backend="cpu")
    assert shadows is not None
    assert shadows.maps_of(own).tolist() == [0]
    # Of the road ahead, nothing is dark up to the first thing that stands on it.
    road = np.array([place + d * ego[:3, 0] - [0, 0, LAMP_HEIGHT_M] for d in (4, 6, 8)])
    shares = [_lit_share(shadows, point) for point in road]
    assert shares == [1.0, 1.0, 1.0]
    # Behind the first surface in the middle of the map, all is dark.
    image = shadows.arrays.inverse_depths[0]
    row, column = np.unravel_index(np.argmax(image[: len(image) // 2]), image.shape)
    pose = shadows.arrays.poses[0]
    fx, fy, cx, cy = shadows.arrays.lenses[0]
    z = 2.0 / image[row, column]
    in_camera = np.array([(column + 0.5 - cx) / fx * z, (row + 0.5 - cy) / fy * z, z])
    behind = pose[:, :3].T @ (in_camera - pose[:, 3])
    assert _lit_share(shadows, behind) == 0.0


def _lit_share(shadows, point: np.ndarray) -> float:
    """Return the share of the first lamp's light at a point, as the kernel finds it."""
    return float(surface_light_kernels.lit_share.py_func(shadows.arrays, 0, *point))


def test_views_beside_and_behind_the_beams_need_no_map() -> None:
    own = lamps_at([(2, 0, 0.6)], (1, 0, 0), kind=LampKind.DIPPED, owner=EGO_OWNER)
    assert looks_into(turned_camera(0), own)
    assert looks_into(turned_camera(60), own)  # its image reaches 32 degrees to the side
    assert not looks_into(turned_camera(120), own)
    assert not looks_into(turned_camera(180), own)


def turned_camera(yaw_deg: float) -> Camera:
    """Return a camera that looks so far to the left of x."""
    camera = camera_at(1.5)
    yaw = math.radians(yaw_deg)
    turn = torch.eye(4, dtype=torch.float64)
    turn[:2, :2] = torch.tensor(
        [[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]], dtype=torch.float64
    )
    pose = camera.camera_from_world @ turn.T
    return replace(camera, camera_from_world=pose)


def test_no_own_lamps_need_no_map() -> None:
    parts: list[PosedGaussians] = []
    tail = lamps_at([(0, 0, 1)], kind=LampKind.TAIL, owner=EGO_OWNER)
    assert draw_beam_shadows(tail, parts, settings=RasterSettings(), backend="cpu") is None
    assert draw_beam_shadows(Lamps.none(), parts, settings=RasterSettings(), backend="cpu") is None


@pytest.mark.parametrize("size", [(1, 1), (2, 3), (17, 33)])
def test_tiny_pictures_and_no_lamps(size: tuple[int, int]) -> None:
    camera = camera_at(1.5, width=size[0], height=size[1], focal_px=20, pitch_deg=60)
    depth = road_depth(camera)
    lamps = lamps_at([(1, 0, 2)])
    lit = surface_light(lamps, camera, depth, white(camera))
    assert np.isfinite(lit).all()
    assert not surface_light(Lamps.none(), camera, depth, white(camera)).any()


def test_bits_do_not_depend_on_threads() -> None:
    camera = camera_at(1.5)
    depth = road_depth(camera)
    lamps = lamps_at([(d, (-1) ** d, 2) for d in range(5, 25)])
    before = numba.get_num_threads()
    pictures = []
    try:
        for count in (1, before):
            numba.set_num_threads(count)
            pictures.append(surface_light(lamps, camera, depth, white(camera)))
    finally:
        numba.set_num_threads(before)
    assert pictures[0].any()
    assert pictures[0].tobytes() == pictures[1].tobytes()


def test_lamp_inside_a_surface_is_finite() -> None:
    camera = camera_at(1.5)
    depth = road_depth(camera)
    lamps = lamps_at([(10, 0, 0), (10, 0, 1e-9)], candela=1e6)
    assert np.isfinite(surface_light(lamps, camera, depth, white(camera))).all()


def test_wrong_arguments_are_refused() -> None:
    camera = camera_at(1.5)
    depth = road_depth(camera)
    lamps = lamps_at([(10, 0, 1)])
    with pytest.raises(ValueError, match="depth_m must be"):
        surface_light(lamps, camera, depth[1:], white(camera)[1:])
    with pytest.raises(ValueError, match="lamps_per_pixel must be >= 1"):
        surface_light(lamps, camera, depth, white(camera), lamps_per_pixel=0)


def test_nodes_have_the_depth_of_their_pixels() -> None:
    camera = camera_at(1.5, width=9, height=7, focal_px=5, pitch_deg=45)
    depth = road_depth(camera)
    nodes = find_nodes(camera, depth, step_px=4)
    assert isinstance(nodes, Nodes)
    np.testing.assert_array_equal(nodes.depth, depth[2::4, 2::4])
