"""The procedural street as a scene: parameters, labels, and its splats against the truth."""

from __future__ import annotations

import pickle

import cv2
import numpy as np
import pytest
import torch

from adapters.base import open_scene
from adapters.procedural import StreetTruth, TrueView, open_procedural, open_truth
from adapters.street.layout import (
    ROAD_HALF_M,
    StreetParameters,
    draw_layout,
    parse_parameters,
    pavement_z,
    road_z,
)
from adapters.street.world import build_street
from augment.errors import AdapterError, SceneError
from augment.render.rasterize import rasterize
from augment.scene import Scene
from augment.semantics import SemanticClass

QUERY = {"seed": "3", "width": "480", "height": "270"}
SMALL = {"gaussians": "60000", "frames": "2", "width": "64", "height": "36"}
SMALL |= {"parked": "1", "moving": "1", "pedestrians": "1"}  # one of each kind


@pytest.fixture(scope="module")
def scene() -> Scene:
    return open_procedural(QUERY)


@pytest.fixture(scope="module")
def truth() -> StreetTruth:
    return open_truth(QUERY)


@pytest.mark.parametrize(
    ("query", "message"),
    [
        ({"sede": "3"}, "unknown option 'sede'; .* seed: .*; frames: "),
        ({"seed": "three"}, "seed: Input should be a valid integer.*got three"),
        ({"seed": "-1"}, "seed: Input should be greater than or equal to 0"),
        ({"frames": "301"}, "frames: Input should be less than or equal to 300 .got 301"),
        ({"frames": "2.5"}, "frames: Input should be a valid integer"),
        ({"speed_mps": "nan"}, "speed_mps: Input should be"),
    ],
)
def test_invalid_queries_say_what_is_wrong(query, message):
    with pytest.raises(AdapterError, match=message):
        open_procedural(query)


def test_canonical_uri_opens_the_same_parameters():
    query = {"frames": "7", "seed": "4", "speed_mps": "8"}
    parameters = parse_parameters(query)
    assert parameters.uri == "procedural:street?seed=4&frames=7"
    text = parameters.uri.split("?")[1]
    assert parse_parameters(dict(pair.split("=") for pair in text.split("&"))) == parameters


def test_same_query_gives_the_same_bits_and_another_seed_does_not():
    state = torch.random.get_rng_state(), np.random.get_state()[1].copy()  # noqa: NPY002
    first = open_procedural({**SMALL, "seed": "8"})
    build_street.cache_clear()
    again = open_scene(first.source)
    for a, b in zip(_all_gaussians(first), _all_gaussians(again), strict=True):
        for name in ("means", "quats", "scales", "opacities", "sh", "semantic"):
            assert torch.equal(getattr(a, name), getattr(b, name)), name
    assert torch.equal(first.sky.faces, again.sky.faces)
    other = StreetParameters(seed=9)
    assert not np.array_equal(draw_layout(other).trees, draw_layout(StreetParameters(seed=8)).trees)
    assert torch.equal(state[0], torch.random.get_rng_state())
    assert np.array_equal(state[1], np.random.get_state()[1])  # noqa: NPY002


def test_scene_is_complete_and_finite(scene):
    assert scene.name == "street-seed3"
    assert scene.source == "procedural:street?seed=3&width=480&height=270"
    total = sum(len(g) for g in _all_gaussians(scene))
    assert 150_000 <= total <= 300_000
    for gaussians in _all_gaussians(scene):
        for name in ("means", "quats", "scales", "opacities", "sh"):
            assert torch.isfinite(getattr(gaussians, name)).all(), name
        assert gaussians.scales.min() > 0
        assert (gaussians.quats.norm(dim=1) - 1).abs().max() < 1e-5
        assert gaussians.semantic is not None
        colour = 0.5 + 0.28209479 * gaussians.sh[:, 0]
        assert colour.min() >= -1e-6 and colour.max() <= 1 + 1e-6
    classes = set(scene.background.semantic.unique().tolist())
    names = "ROAD LANE_MARKING SIDEWALK TERRAIN VEGETATION BUILDING POLE SIGN VEHICLE"
    assert {SemanticClass[name] for name in names.split()} <= classes
    assert len(scene.frames) == 20 and len(scene.camera_names) == 6
    assert -0.05 < scene.ground_z_m < 0


def test_cameras_ride_on_the_ego_car(scene):
    for index in (0, 19):
        frame = scene.frames[index]
        for camera in frame.cameras.values():
            assert abs(camera.timestamp_ns - frame.timestamp_ns) <= 50_000_000
            assert camera.centre[2] == pytest.approx(1.6 - 0.034, abs=0.01)
        ahead = frame.cameras["front"].world_from_camera[:3, 2]
        behind = frame.cameras["back"].world_from_camera[:3, 2]
        left = frame.cameras["left"].world_from_camera[:3, 2]
        assert ahead[0] > 0.99 and behind[0] < -0.99 and left[1] > 0.9
    moved = scene.frames[19].world_from_ego[:3, 3] - scene.frames[0].world_from_ego[:3, 3]
    assert moved[0].item() == pytest.approx(8.0 * 1.9)


def test_moving_actors_move_and_stay_in_their_boxes(scene):
    for number in (0, 11):
        boxes = scene.boxes(number)
        for actor in scene.actors:
            row = boxes.track_ids.index(actor.track_id)
            pose = actor.track.pose_at(scene.frames[number].timestamp_ns)
            assert np.allclose(boxes.centers_m[row], pose[:3, 3].numpy(), atol=1e-12)
            assert tuple(boxes.sizes_m[row]) == actor.size_m
            own = actor.gaussians.semantic != SemanticClass.ROAD  # the rest is its shadow
            reach = actor.gaussians.means[own].abs().amax(0)
            assert (reach <= torch.tensor(actor.size_m) / 2).all(), actor.track_id
            assert own.sum() > 200
    for actor in scene.actors:
        first, last = (actor.track.pose_at(scene.frames[i].timestamp_ns) for i in (0, 19))
        assert (first[:3, 3] - last[:3, 3]).norm() > 1.0
    parked = [i for i, name in enumerate(boxes.track_ids) if name.startswith("parked")]
    assert len(parked) == 12 and boxes.attributes["is_parked"][parked].all()


def test_lidar_returns_lie_on_the_surfaces_they_name(scene):
    sweep = scene.lidar(4)
    points, semantic = sweep.points_m, sweep.columns["semantic"]
    assert points.dtype == np.float64 and 40_000 < len(points) <= 65_536
    flat = np.isin(semantic, [SemanticClass.ROAD, SemanticClass.LANE_MARKING])
    flat &= (points[:, 0] > -60) & (points[:, 0] < 90)
    assert flat.sum() > 5000
    # Exact planes; what remains is rounding of coordinates of some ten metres.
    assert np.abs(points[flat, 2] - road_z(points[flat, 1])).max() < 1e-9
    paved = (semantic == SemanticClass.SIDEWALK) & (np.abs(points[:, 1]) > ROAD_HALF_M + 1e-6)
    paved &= (points[:, 0] > -60) & (points[:, 0] < 90)
    assert np.abs(points[paved, 2] - pavement_z(points[paved, 1])).max() < 1e-9
    assert np.isfinite(sweep.columns["intensity"]).all()


def test_boxes_hold_the_lidar_returns_of_their_actors_at_each_point_s_time(scene):
    sweep = scene.lidar(4)
    found = 0
    for number, actor in enumerate(scene.actors, start=1):
        index = np.flatnonzero(sweep.columns["instance"] == number)
        for i in index[:: max(1, len(index) // 50)]:
            pose = actor.track.pose_at(int(sweep.columns["timestamp_ns"][i])).numpy()
            local = pose[:3, :3].T @ (sweep.points_m[i] - pose[:3, 3])
            assert (np.abs(local) <= np.array(actor.size_m) / 2 + 1e-9).all(), actor.track_id
            found += 1
    assert found > 50
    boxes = scene.boxes(4)
    inside = np.zeros(len(sweep), bool)
    for centre, size in zip(boxes.centers_m, boxes.sizes_m, strict=True):
        inside |= (np.abs(sweep.points_m - centre) <= size / 2 + 1e-9).all(1)
    still = (sweep.columns["semantic"] == SemanticClass.VEHICLE) & (sweep.columns["instance"] == 0)
    assert inside[still].all()  # parked cars: every return is in a box, all are axis-aligned


def test_labels_survive_pickling_and_name_a_missing_frame(scene):
    labels = pickle.loads(pickle.dumps(scene.labels))
    a, b = labels.boxes(3), scene.boxes(3)
    assert a.track_ids == b.track_ids and np.array_equal(a.centers_m, b.centers_m)
    with pytest.raises(SceneError, match="frames 0 to 19; got 20"):
        scene.lidar(20)


@pytest.mark.long
@pytest.mark.parametrize(("frame", "name"), [(0, "front"), (10, "left")])
def test_splats_agree_with_the_truth(scene, truth, frame, name):
    camera = scene.frames[frame].cameras[name]
    view = truth.render(camera)
    out = rasterize(
        scene.parts_for(camera), camera, buffers=("rgb", "alpha", "expected_depth", "splat_ids")
    )
    sky = scene.sky.sample(camera.ray_directions())
    rgb = (out.rgb + (1 - out.alpha)[..., None] * sky).numpy()
    smooth = _smooth_pixels(view) & (view.depth < 30)
    classes = [SemanticClass.ROAD, SemanticClass.BUILDING]
    chosen = smooth & np.isin(view.semantic, classes)
    assert chosen.sum() > 20_000
    # Blending takes nearer splats first; splats lie deeper to make up for it, which fits some
    # viewing angles better than others and leaves about a centimetre or two at this resolution.
    error_m = np.abs(out.expected_depth.numpy() - view.depth)[chosen]
    assert np.median(error_m) < 0.025
    assert np.median(np.abs(rgb - view.rgb).max(-1)[chosen]) < 2 / 255
    assert np.mean(out.alpha.numpy()[chosen] > 0.99) > 0.97
    solid = cv2.erode(np.isfinite(view.depth).astype(np.uint8), np.ones((9, 9), np.uint8)) > 0
    solid &= view.semantic != SemanticClass.VEGETATION  # crowns have gaps
    assert out.alpha.numpy()[solid].min() > 0.9  # silhouettes fade; nothing within them is open
    own = torch.cat([p.gaussians.semantic for p in scene.parts_for(camera)]).numpy()
    seen = own[out.splat_ids.numpy()[chosen]]
    assert np.mean(seen == view.semantic[chosen]) > 0.99


def test_parts_of_the_sky_that_truth_sees_are_left_open(scene, truth):
    camera = scene.frames[0].cameras["front"]
    view = truth.render(camera)
    is_sky = np.isinf(view.depth)
    deep = cv2.erode(is_sky.astype(np.uint8), np.ones((31, 31), np.uint8)) > 0
    out = rasterize(scene.parts_for(camera), camera, buffers=("alpha",))
    assert deep.sum() > 1000
    assert out.alpha.numpy()[deep].max() < 0.02


def test_truth_sees_moving_things_where_they_are(truth):
    mover = truth.street.movers[0]
    for time in mover.motion.times_ns[[1, 5]]:
        centre = mover.motion.at(np.array([time]))[0][0]
        origin = centre + np.array([0.0, 0.0, 10.0])
        hits = truth.cast(origin, np.array([[0.0, 0.0, -1.0]]), int(time))
        assert hits.instance[0] == 1 and hits.semantic[0] == SemanticClass.VEHICLE
        assert 10 - mover.size_m[2] / 2 - 1e-9 < hits.distance[0] < 10
        assert hits.normal[0, 2] > 0.5


def _all_gaussians(scene: Scene) -> list:
    return [scene.background, *(actor.gaussians for actor in scene.actors)]


def _smooth_pixels(view: TrueView) -> np.ndarray:
    """Pixels whose 5x5 neighbourhood is one surface: one class and instance, colour within 8/255,
    and inverse depth (linear on a plane) without a bend or a step.
    """
    kernel = np.ones((5, 5), np.uint8)
    code = (view.semantic.astype(np.int32) * 64 + view.instance).astype(np.uint16)
    smooth = cv2.erode(code, kernel) == cv2.dilate(code, kernel)
    span = cv2.dilate(view.rgb, kernel) - cv2.erode(view.rgb, kernel)
    smooth &= span.max(-1) < 8 / 255
    inverse = 1 / np.where(np.isinf(view.depth), 1e4, view.depth)
    bend = np.zeros_like(inverse)
    bend[1:-1] = np.abs(np.diff(inverse, 2, axis=0))
    bend[:, 1:-1] = np.maximum(bend[:, 1:-1], np.abs(np.diff(inverse, 2, axis=1)))
    return smooth & (cv2.dilate(bend / inverse, kernel) < 2e-3)
