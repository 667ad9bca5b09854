"""The sensor service: pictures as render's, refusals in words, clients that misbehave."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import grpc
import numpy as np
import pytest
import torch
from google.protobuf import descriptor_pb2
from google.protobuf.descriptor_pool import DescriptorPool
from grpc_health.v1 import health_pb2, health_pb2_grpc
from grpc_reflection.v1alpha.proto_reflection_descriptor_database import (
    ProtoReflectionDescriptorDatabase,
)
from grpc_tools import protoc

from augment.effects.lidar.codes import drop_lost_returns
from augment.errors import ClimateGSError
from augment.jobs.render_job import RenderJob, run_job
from augment.output.codecs import decode_image
from augment.scene.cameras import Camera
from augment.scene.scene import Scene, Track
from augment.view.weathered_sweep import weathered_sweep
from recipes.schema import Recipe
from tests.streets import LABELLED_STREET
from tests.tools.serve_requests import EMPTY, changed, image_request, refusal
from tools.cli import ServeOptions
from tools.serve.actors import requested_scene
from tools.serve.messages import (
    DESCRIPTOR_FILE,
    MAX_MESSAGE_BYTES,
    PACKAGES,
    PROTO_FOLDER,
    SERVICE,
    Stub,
    message_class,
    methods,
    service_names,
)
from tools.serve.metrics import NUM_LATENCIES, Metrics
from tools.serve.poses import pose_matrix, pose_message
from tools.serve.scene_store import parse_source
from tools.serve.server import RunningService, served_recipes, start_service

MAX_REQUESTS = 4
MAX_PIXELS = 200_000
NAN = float("nan")
# Rows of the images below which the test's mask shows the recording car.
CAR_ROW = 80


@dataclass(frozen=True)
class Server:
    """A server of a street in fog and in clear air."""

    running: RunningService
    options: ServeOptions
    channel: Any
    stub: Stub

    @property
    def scene(self) -> Scene:
        with self.running.store.borrow("street") as (opened, _):
            return opened.scene

    def recipe(self, weather: str) -> Recipe:
        with self.running.store.borrow(f"street@{weather}") as (_, recipe):
            return recipe

    def camera(self, name: str = "front", frame: int = 1) -> Camera:
        return self.scene.frames[frame].cameras[name]


@pytest.fixture(scope="module")
def server(tmp_path_factory) -> Iterator[Server]:
    masks = tmp_path_factory.mktemp("masks")
    mask = np.zeros((96, 160), np.uint8)
    mask[CAR_ROW:] = 255
    cv2.imwrite(str(masks / "front.png"), mask)
    options = ServeOptions(
        scenes=(f"street={LABELLED_STREET}&ego_masks={masks}",),
        recipe=("dense-fog", "clear"),
        overrides=("output.image=png",),
        port=0,
        max_requests=MAX_REQUESTS,
        max_pixels=MAX_PIXELS,
    )
    recipes = served_recipes(options.recipe, options.variants, options.overrides)
    with (
        start_service(options, recipes) as running,
        grpc.insecure_channel(f"127.0.0.1:{running.port}") as channel,
    ):
        yield Server(running, options, channel, Stub(channel))


# ---- The interface -------------------------------------------------------------------------------


def test_descriptors_are_compiled_from_the_proto_files(tmp_path):
    compiled = tmp_path / "set.binpb"
    arguments = [f"-I{PROTO_FOLDER}", "--include_imports", f"--descriptor_set_out={compiled}"]
    assert protoc.main(["protoc", *arguments, "sensorsim.proto"]) == 0
    stored, fresh = (
        descriptor_pb2.FileDescriptorSet.FromString(path.read_bytes())
        for path in (DESCRIPTOR_FILE, compiled)
    )
    assert stored == fresh


def test_reflection_lists_all_methods_under_both_names(server):
    database = ProtoReflectionDescriptorDatabase(server.channel)
    assert {*service_names(), "grpc.health.v1.Health"} < set(database.get_services())
    pool = DescriptorPool(database)
    names = {method.name for method in methods()}
    assert len(names) == 9
    for package in PACKAGES:
        service = pool.FindServiceByName(f"{package}.{SERVICE}")
        assert {method.name for method in service.methods} == names
        request = service.methods_by_name["render_rgb"].input_type
        assert request.full_name == f"{package}.RGBRenderRequest"
        assert request.fields_by_name["ego_mask_id"].number == 12


def test_both_names_of_the_service_give_the_same_image(server):
    request = image_request("street", server.camera())
    images = {Stub(server.channel, package).render_rgb(request).image_bytes for package in PACKAGES}
    assert len(images) == 1


def test_health_is_serving(server):
    health = health_pb2_grpc.HealthStub(server.channel)
    for name in ("", *service_names()):
        answer = health.Check(health_pb2.HealthCheckRequest(service=name))
        assert answer.status == health_pb2.HealthCheckResponse.SERVING


def test_version_has_that_of_the_interface(server):
    assert server.stub.get_version(EMPTY).grpc_api_version.minor == 54


# ---- Facts of a scene ----------------------------------------------------------------------------


def test_scenes_are_listed_with_and_without_their_weather(server):
    names = ["street", "street@dense-fog", "street@dense-fog#0", "street@clear", "street@clear#0"]
    assert list(server.stub.get_available_scenes(EMPTY).scene_ids) == names


def test_path_times_camera_place_is_the_recorded_pose_of_each_camera(server):
    """Cameras of a frame fire one after the other, while the car drives on."""
    request_class = message_class("AvailableTrajectoriesRequest")
    answer = server.stub.get_available_trajectories(request_class(scene_id="street"))
    poses = answer.available_trajectories[0].trajectory.poses
    assert len(poses) == len(server.scene.frames)
    request = message_class("AvailableCamerasRequest")(scene_id="street@clear")
    cameras = server.stub.get_available_cameras(request).available_cameras
    assert [camera.logical_id for camera in cameras] == list(server.scene.camera_names)
    times_ns = torch.tensor([1000 * pose.timestamp_us for pose in poses])
    rig = Track(times_ns, torch.stack([pose_matrix(pose.pose, "pose") for pose in poses]))
    for camera in cameras:
        images = [frame.cameras[camera.logical_id] for frame in server.scene.frames]
        recorded = next(c for c in images if times_ns[0] <= c.timestamp_ns <= times_ns[-1])
        world_from_rig = rig.pose_at(recorded.timestamp_ns)
        world_from_camera = world_from_rig @ pose_matrix(camera.rig_to_camera, "pose")
        # Float32 numbers of some metres, and half a microsecond at 10 m/s.
        torch.testing.assert_close(world_from_camera, recorded.world_from_camera, rtol=0, atol=2e-5)


# ---- Images --------------------------------------------------------------------------------------


def test_images_have_the_bytes_of_render(server, tmp_path):
    recipes = [server.recipe("dense-fog"), server.recipe("clear")]
    names = ("front", "left")
    job = RenderJob("street", recipes, tmp_path, cameras=names)
    run_job(job, scene_loader=lambda _uri: server.scene, progress=False)
    for recipe in recipes:
        for frame in server.scene.frames:
            for name in names:
                request = image_request(f"street@{recipe.name}", frame.cameras[name])
                data = server.stub.render_rgb(request).image_bytes
                (file,) = tmp_path.glob(f"*/{recipe.name}*/images/{name}/{frame.index:06d}.png")
                assert data == file.read_bytes(), (recipe.name, name)


def test_a_smaller_image_is_that_of_render_at_the_same_scale(server):
    camera = server.camera()
    request = changed(image_request("street", camera), resolution_w=80, resolution_h=48)
    half_request = image_request("street", camera.scaled(0.5))
    data = server.stub.render_rgb(request).image_bytes
    assert decode_image(data).shape == (48, 80, 3)
    assert data == server.stub.render_rgb(half_request).image_bytes


def test_formats_show_the_same_picture(server):
    camera = server.camera()
    png, planar, jpeg = (
        server.stub.render_rgb(image_request("street", camera, name)).image_bytes
        for name in ("PNG", "RGB_UINT8_PLANAR", "JPEG")
    )
    rgb = decode_image(png)
    planes = np.frombuffer(planar, np.uint8).reshape(3, camera.height, camera.width)
    assert np.array_equal(planes.transpose(1, 2, 0), rgb)
    error = np.abs(decode_image(jpeg).astype(int) - rgb)
    assert error.mean() < 3  # of a JPEG of quality 95 with noise of the splats
    coarse = changed(image_request("street", camera, "JPEG"), image_quality=20.0)
    assert len(server.stub.render_rgb(coarse).image_bytes) < len(jpeg) / 2


def test_weather_is_that_of_the_name(server):
    foggy, clear = (
        decode_image(server.stub.render_rgb(image_request(name, server.camera())).image_bytes)
        for name in ("street", "street@clear")
    )
    upper = slice(0, 48)  # houses and sky
    assert foggy[upper].std() < 0.5 * clear[upper].std()


FTHETA_RADIAL = [0.0, 90.0, -2.0, 1.0]


def test_an_f_theta_lens_shows_what_a_pinhole_shows_at_the_same_angles(server):
    """Rays of a pinhole's pixels are looked up in the f-theta image."""
    camera = server.camera()
    request = image_request("street@clear", camera)
    pinhole = decode_image(server.stub.render_rgb(request).image_bytes).astype(np.float32)
    param = request.camera_intrinsics.ftheta_param
    param.principal_point_x = camera.width / 2 - 0.5
    param.principal_point_y = camera.height / 2 - 0.5
    param.reference_poly = 2
    param.angle_to_pixeldist_poly.extend(FTHETA_RADIAL)
    param.max_angle = 1.4
    lens = decode_image(server.stub.render_rgb(request).image_bytes).astype(np.float32)
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    dx = (x - camera.cx) / camera.fx
    dy = (y - camera.cy) / camera.fy
    slope = np.hypot(dx, dy)
    angle = np.arctan(slope)
    distance = sum(k * angle**power for power, k in enumerate(FTHETA_RADIAL))
    scale = distance / np.maximum(slope, 1e-9)
    places = [camera.width / 2 + dx * scale - 0.5, camera.height / 2 + dy * scale - 0.5]
    seen = cv2.remap(lens, *[p.astype(np.float32) for p in places], cv2.INTER_LINEAR)
    inner = (slice(12, -12), slice(20, -20))
    # The lens's image is coarser by a fifth, which blurs edges: 5.3 of 255 in the mean.
    assert np.abs(seen - pinhole)[inner].mean() < 8
    assert np.abs(lens - pinhole)[inner].mean() > 12


def test_a_rolling_shutter_is_drawn_from_the_poses_of_the_request(server):
    request = image_request("street@clear", server.camera())
    still = server.stub.render_rgb(request).image_bytes
    end = pose_matrix(request.sensor_pose.start_pose, "pose")
    end[:3, 3] += torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
    request.sensor_pose.end_pose.CopyFrom(pose_message(end))
    request.frame_end_us = request.frame_start_us + 30_000
    whole = decode_image(server.stub.render_rgb(request).image_bytes).astype(int)
    request.camera_intrinsics.shutter_type = 1  # from the top to the bottom
    rolling = decode_image(server.stub.render_rgb(request).image_bytes).astype(int)
    upper = slice(0, 12)
    error = {
        name: np.abs(rolling[upper] - image[upper]).mean()
        for name, image in (("start", decode_image(still)), ("middle", whole))
    }
    assert error["start"] < 0.5 * error["middle"]  # the first rows are read at the start


def test_a_moving_camera_is_drawn_from_the_middle_of_its_exposure(server):
    camera = server.camera()
    request = image_request("street@clear", camera)
    start = pose_matrix(request.sensor_pose.start_pose, "pose")
    end = start.clone()
    end[:3, 3] += torch.tensor([2.0, 0.0, 0.0], dtype=torch.float64)
    middle = start.clone()
    middle[0, 3] += 1.0
    request.sensor_pose.end_pose.CopyFrom(pose_message(end))
    moved = server.stub.render_rgb(request).image_bytes
    for pose in (request.sensor_pose.start_pose, request.sensor_pose.end_pose):
        pose.CopyFrom(pose_message(middle))
    assert moved == server.stub.render_rgb(request).image_bytes


def test_a_batch_gives_each_camera_its_image_or_its_error(server):
    batch_class = message_class("BatchRGBRenderRequest")
    cameras = list(server.scene.frames[0].cameras.values())
    requests = [image_request("street", camera) for camera in cameras]
    items = [{"camera_name": r.camera_intrinsics.logical_id, "request": r} for r in requests]
    items[1]["request"] = changed(requests[1], image_format=5)
    answers = server.stub.batch_render_rgb(batch_class(items=items)).items
    assert [answer.camera_name for answer in answers] == [camera.name for camera in cameras]
    for number, (answer, request) in enumerate(zip(answers, requests, strict=True)):
        if number == 1:
            assert not answer.success and "AVC" in answer.error_message
            continue
        assert answer.success and not answer.error_message
        assert answer.result.image_bytes == server.stub.render_rgb(request).image_bytes


def test_the_recording_car_is_put_in_front_where_a_mask_is_asked_for(server):
    masks = server.stub.get_available_ego_masks(EMPTY).ego_mask_metadata
    ids = [(m.ego_mask_id.camera_logical_id, m.ego_mask_id.rig_config_id) for m in masks]
    assert ids == [("front", "street")]
    request = image_request("street@clear", server.camera())
    bare = decode_image(server.stub.render_rgb(request).image_bytes)
    request.insert_ego_mask = True
    request.ego_mask_id.CopyFrom(masks[0].ego_mask_id)
    masked = decode_image(server.stub.render_rgb(request).image_bytes)
    assert not masked[CAR_ROW:].any()  # a street has no photos, so that the car is black
    assert np.array_equal(masked[:CAR_ROW], bare[:CAR_ROW])
    longer = changed(request, camera_intrinsics__opencv_pinhole_param__focal_length_x=200.0)
    code, text = refusal(server.stub.render_rgb, longer)
    assert code == "INVALID_ARGUMENT" and "recorded lens" in text
    request.ego_mask_id.rig_config_id = "hyperion8"
    code, text = refusal(server.stub.render_rgb, request)
    assert code == "NOT_FOUND" and "'street' has masks of front" in text


# ---- Moving objects ------------------------------------------------------------------------------


def with_objects(server: Server, request: Any, shifts: dict[str, float]) -> Any:
    """The request with actors at their recorded poses, each moved along z by some metres."""
    request = changed(request)
    actors = {actor.track_id: actor for actor in server.scene.actors}
    for name, shift_m in shifts.items():
        pose = torch.eye(4, dtype=torch.float64)
        if name in actors:
            pose = actors[name].track.pose_at(1000 * request.frame_start_us).clone()
        pose[2, 3] += shift_m
        message = pose_message(pose)
        pair = {"start_pose": message, "end_pose": message}
        request.dynamic_objects.add(track_id=name, pose_pair=pair)
    return request


def test_moving_objects_are_where_the_request_says(server):
    request = image_request("street@clear", server.camera())
    names = [actor.track_id for actor in server.scene.actors]
    assert len(names) == 2  # a car ahead and a pedestrian
    images = {
        kind: decode_image(server.stub.render_rgb(r).image_bytes).astype(int)
        for kind, r in {
            "recorded": request,
            "stated": with_objects(server, request, dict.fromkeys(names, 0.0)),
            "raised": with_objects(server, request, dict.fromkeys(names, 30.0)),
            "absent": with_objects(server, request, {"somebody else": 0.0}),
        }.items()
    }
    # Float32 poses move splats by less than a thousandth of a pixel.
    assert np.abs(images["stated"] - images["recorded"]).max() <= 2
    difference = np.abs(images["absent"] - images["recorded"]).max(-1)
    assert 20 < (difference > 20).sum() < 2000  # the actors' own pixels
    # Thirty metres above the road they are out of view.
    assert np.array_equal(images["raised"], images["absent"])


def test_objects_that_the_scene_does_not_have_are_left_out(server):
    """A simulator states all its traffic, and one error would end its run."""
    name = server.scene.actors[0].track_id
    request = image_request("street@clear", server.camera())
    request = with_objects(server, request, {name: 0.0, "traffic-7": 0.0})
    requested = requested_scene(request, server.scene)
    assert requested.unknown_tracks == ("traffic-7",)
    assert len(requested.scene.actors) == len(server.scene.actors)
    assert refusal(server.stub.render_rgb, request) == ("OK", "")


def test_wrong_objects_are_refused_in_words(server):
    name = server.scene.actors[0].track_id
    request = image_request("street", server.camera())
    twice = with_objects(server, request, {name: 0.0})
    twice.dynamic_objects.append(twice.dynamic_objects[0])
    nan = with_objects(server, request, {name: NAN})
    no_pose = changed(request)
    no_pose.dynamic_objects.add(track_id=name)
    for bad_request, words in (
        (twice, "is there twice"),
        (nan, "dynamic_objects[0].pose_pair.start_pose: all numbers must be finite"),
        (no_pose, "dynamic_objects[0].pose_pair is missing"),
    ):
        code, text = refusal(server.stub.render_rgb, bad_request)
        assert code == "INVALID_ARGUMENT" and words in text


# ---- LiDAR ---------------------------------------------------------------------------------------


def sweep_request(server: Server, frame_index: int) -> Any:
    """A request for the sweep of a frame, from a sensor above the car."""
    frame = server.scene.frames[frame_index]
    world_from_sensor = frame.world_from_ego.clone()
    world_from_sensor[2, 3] += 1.8
    time_us = frame.timestamp_ns // 1000
    pose = pose_message(world_from_sensor)
    return message_class("LidarRenderRequest")(
        scene_id="street",
        frame_start_us=time_us - 100_000,
        frame_end_us=time_us,
        sensor_pose={"start_pose": pose, "end_pose": pose},
    )


def test_lidar_is_the_weathered_sweep_in_the_frame_of_the_request(server):
    for index, frame in enumerate(server.scene.frames):
        request = sweep_request(server, index)
        answer = server.stub.render_lidar(request)
        recorded = server.scene.lidar(frame.index)
        assert recorded is not None
        sweep = drop_lost_returns(
            weathered_sweep(server.scene, server.recipe("dense-fog"), frame.index, recorded)
        )
        assert answer.num_points == len(sweep) < len(recorded)
        xyz = np.frombuffer(answer.point_xyzs_buffer, "<f4").reshape(-1, 3)
        assert np.array_equal(xyz.ravel(), np.array(answer.point_xyzs, np.float32))
        pose = pose_matrix(request.sensor_pose.end_pose, "pose").numpy()
        points = xyz @ pose[:3, :3].T + pose[:3, 3] + server.scene.world_origin_m
        # Float32 numbers of up to 100 m.
        np.testing.assert_allclose(points, sweep.points_m, atol=2e-5)
        intensities = np.frombuffer(answer.point_intensities_buffer, "<f4")
        assert len(intensities) == len(sweep)
        assert intensities.min() >= 0 and 0 < intensities.max() <= 1


def test_lidar_far_from_every_sweep_is_not_implemented(server):
    request = sweep_request(server, 0)
    request.sensor_pose.end_pose.vec.y += 30
    code, text = refusal(server.stub.render_lidar, request)
    assert code == "UNIMPLEMENTED" and "no recorded sweep near this pose" in text


def test_a_sweep_within_reach_is_returned_though_another_is_nearer_in_time(server):
    request = sweep_request(server, 0)
    expected = server.stub.render_lidar(request).num_points
    # Aside of the first frame and behind it: 7.9 m from it, 8.2 m from the second.
    request.sensor_pose.end_pose.vec.x -= 3.0
    request.sensor_pose.end_pose.vec.y += 7.08
    request.frame_start_us += 60_000_000
    request.frame_end_us += 60_000_000
    assert server.stub.render_lidar(request).num_points == expected


def test_one_request_may_have_images_and_sweeps(server):
    request = message_class("AggregatedRenderRequest")(
        rgb_requests=[image_request("street", server.camera())],
        lidar_requests=[sweep_request(server, 0)],
    )
    answer = server.stub.render_aggregated(request)
    assert answer.rgb_returns[0] == server.stub.render_rgb(request.rgb_requests[0])
    assert answer.lidar_returns[0] == server.stub.render_lidar(request.lidar_requests[0])


# ---- Refusals, and clients that misbehave --------------------------------------------------------

# What is changed in a good request, and the status and words that it is refused with.
REFUSED = [
    ({"scene_id": "nowhere"}, "NOT_FOUND", "this server has street"),
    ({"scene_id": "street@hail"}, "NOT_FOUND", "@dense-fog"),
    ({"scene_id": "street@clear#7"}, "NOT_FOUND", "@clear#0"),
    ({"resolution_w": 60_000, "resolution_h": 60_000}, "INVALID_ARGUMENT", "3600000000"),
    ({"resolution_w": 2**32 - 1, "resolution_h": 1}, "INVALID_ARGUMENT", "at most 200000"),
    ({"sensor_pose__start_pose__vec__x": NAN}, "INVALID_ARGUMENT", "must be finite"),
    ({"sensor_pose__end_pose__quat__w": NAN}, "INVALID_ARGUMENT", "must be finite"),
    ({"sensor_pose__end_pose__quat__w": 3.0}, "INVALID_ARGUMENT", "unit quaternion"),
    ({"sensor_pose__start_pose__vec__z": 1e30}, "INVALID_ARGUMENT", "of the origin"),
    ({"frame_end_us": 0}, "INVALID_ARGUMENT", "frame_end_us must be"),
    ({"frame_start_us": 2**64 - 2, "frame_end_us": 2**64 - 1}, "OUT_OF_RANGE", "an hour"),
    ({"frame_start_us": 0, "frame_end_us": 1}, "OUT_OF_RANGE", "'street'"),
    ({"image_format": 0}, "INVALID_ARGUMENT", "PNG (1)"),
    ({"image_format": 3}, "UNIMPLEMENTED", "JPEG2000"),
    ({"image_format": 77}, "INVALID_ARGUMENT", "77"),
    ({"image_quality": NAN}, "INVALID_ARGUMENT", "image_quality"),
    ({"image_quality": 0.4}, "INVALID_ARGUMENT", "image_quality"),
    ({"insert_ego_mask": True}, "NOT_FOUND", "has masks of front"),
    ({"camera_intrinsics__logical_id": "x" * 999}, "INVALID_ARGUMENT", "200 characters"),
    (
        {"camera_intrinsics__opencv_pinhole_param__focal_length_x": 0.0},
        "INVALID_ARGUMENT",
        "fx must be finite and > 0",
    ),
    (
        {"camera_intrinsics__opencv_pinhole_param__focal_length_x": 1e-3},
        "INVALID_ARGUMENT",
        "field of view",
    ),
    (
        {"camera_intrinsics__opencv_pinhole_param__principal_point_x": NAN},
        "INVALID_ARGUMENT",
        "cx must be finite",
    ),
    (
        {"camera_intrinsics__bivariate_windshield_model_param__reference_poly": 1},
        "INVALID_ARGUMENT",
        "windshield",
    ),
]


@pytest.mark.parametrize(("changes", "status", "words"), REFUSED, ids=lambda value: str(value)[:40])
def test_a_request_that_cannot_be_served_is_refused_in_words(server, changes, status, words):
    request = changed(image_request("street", server.camera()), **changes)
    code, text = refusal(server.stub.render_rgb, request)
    assert code == status and words in text


def test_a_request_without_lens_or_pose_is_refused_in_words(server):
    request = image_request("street", server.camera())
    request.camera_intrinsics.ClearField("opencv_pinhole_param")
    assert "has no lens" in refusal(server.stub.render_rgb, request)[1]
    request = image_request("street", server.camera())
    request.ClearField("sensor_pose")
    assert "sensor_pose is missing" in refusal(server.stub.render_rgb, request)[1]


def test_a_lens_of_senseless_numbers_is_refused_in_words(server):
    """Pixels at this lens's end see so little that pinhole views would need 30 times its pixels."""
    request = image_request("street", server.camera().scaled(3.0))
    param = request.camera_intrinsics.ftheta_param
    param.principal_point_x = 240.0
    param.principal_point_y = 144.0
    param.reference_poly = 2
    param.angle_to_pixeldist_poly.extend([0.0, 110.0, 0.0, 0.0, 0.0, 0.0, 0.0, 5000.0])
    code, text = refusal(server.stub.render_rgb, request)
    assert code == "INVALID_ARGUMENT" and "Check the numbers of the lens" in text
    param.principal_point_x = -4000.0
    param.max_angle = 0.5
    code, text = refusal(server.stub.render_rgb, request)
    assert code == "INVALID_ARGUMENT" and "no pixel of its image" in text


def test_a_batch_beyond_its_limits_is_refused(server):
    batch_class = message_class("BatchRGBRenderRequest")
    request = image_request("street", server.camera())
    code, text = refusal(
        server.stub.batch_render_rgb, batch_class(items=[{"request": request}] * 65)
    )
    assert code == "INVALID_ARGUMENT" and "64 images" in text
    large = changed(request, resolution_w=10_000, resolution_h=10_000)
    code, text = refusal(server.stub.batch_render_rgb, batch_class(items=[{"request": large}]))
    assert code == "INVALID_ARGUMENT" and "pixels together" in text


def test_garbage_and_huge_messages_are_refused_in_words(server):
    call = server.channel.unary_unary(f"/{service_names()[0]}/render_rgb")
    code, text = refusal(call, b"\xff\xfe garbage \x00")
    assert code == "INVALID_ARGUMENT" and "not a message RGBRenderRequest" in text
    code, text = refusal(call, bytes(MAX_MESSAGE_BYTES + 1))
    assert code == "RESOURCE_EXHAUSTED" and "larger than max" in text
    unknown = server.channel.unary_unary(f"/{service_names()[0]}/shut_down")
    assert refusal(unknown, b"")[0] == "UNIMPLEMENTED"


def test_clients_that_die_or_send_nonsense_do_not_disturb_others(server):
    request = image_request("street", server.camera())
    expected = server.stub.render_rgb(request).image_bytes
    large = image_request("street", server.camera().scaled(3.0))
    stop = threading.Event()

    def misbehave() -> None:
        while not stop.is_set():
            with grpc.insecure_channel(f"127.0.0.1:{server.running.port}") as channel:
                # The channel closes while the image is drawn.
                begun = Stub(channel).render_rgb.future(large)
                stop.wait(0.02)
                del begun
                call = channel.unary_unary(f"/{service_names()[1]}/batch_render_rgb")
                refusal(call, b"\xff" * 100)

    with ThreadPoolExecutor(1) as pool:
        work = pool.submit(misbehave)
        try:
            images = {server.stub.render_rgb(request, timeout=60).image_bytes for _ in range(20)}
        finally:
            stop.set()
        work.result()
    assert images == {expected}


def test_requests_beyond_the_limit_are_refused_at_once(server):
    request = image_request("street", server.camera().scaled(3.0))
    count = 4 * MAX_REQUESTS
    with ThreadPoolExecutor(count) as pool:
        calls = [pool.submit(refusal, server.stub.render_rgb, request) for _ in range(count)]
        answers = [call.result() for call in calls]
    codes = [code for code, _ in answers]
    assert set(codes) == {"OK", "RESOURCE_EXHAUSTED"}
    assert codes.count("OK") >= MAX_REQUESTS
    # Beside ours, gRPC has a limit of all requests together.
    assert any("--max-requests" in text for _, text in answers)


def test_a_deadline_ends_the_work(server):
    """The client gives up at the deadline by itself; the server's own figures tell what it did."""
    request = image_request("street", server.camera().scaled(3.0))
    items = [{"camera_name": "front", "request": request}] * 32  # some seconds
    batch = message_class("BatchRGBRenderRequest")(items=items)
    metrics = server.running.metrics
    with pytest.raises(grpc.RpcError) as refused:
        server.stub.batch_render_rgb(batch, timeout=0.5)
    assert refused.value.code() is grpc.StatusCode.DEADLINE_EXCEEDED
    end_s = time.monotonic() + 60
    while metrics.num_in_flight > 0 and time.monotonic() < end_s:
        time.sleep(0.01)
    statuses = metrics.facts()["methods"]["batch_render_rgb"]["by_status"]
    # gRPC may call the request cancelled a moment before its time is up.
    assert {"DEADLINE_EXCEEDED", "CANCELLED"} & set(statuses)
    assert server.stub.render_rgb(image_request("street", server.camera())).image_bytes


def test_metrics_count_requests_by_status():
    metrics = Metrics()
    for milliseconds in range(1, 101):
        metrics.begin()
        metrics.end("render_rgb", "OK", milliseconds / 1000)
    metrics.begin()
    metrics.end("render_rgb", "NOT_FOUND", 60.0)
    metrics.begin()
    facts = metrics.facts()["methods"]["render_rgb"]
    assert metrics.num_in_flight == 1
    assert facts["count"] == 101
    assert facts["by_status"] == {"NOT_FOUND": 1, "OK": 100}
    # Percentiles of 1 to 100 ms, between two values: refusals are not counted.
    assert [facts[f"p{n}_ms"] for n in (50, 90, 99)] == [50.5, 90.1, 99.01]


def test_percentiles_are_those_of_the_latest_latencies():
    metrics = Metrics()
    for seconds in (9.0, 0.002):
        for _ in range(NUM_LATENCIES):
            metrics.begin()
            metrics.end("render_rgb", "OK", seconds)
            metrics.begin()
            metrics.end("render_rgb", "NOT_FOUND", 1.0)
    assert metrics.facts()["methods"]["render_rgb"]["p99_ms"] == 2.0


# ---- The command ---------------------------------------------------------------------------------


def test_options_that_do_not_fit_are_refused(tmp_path: Path):
    refused = {
        "no scene is named": {"scenes": ()},
        "belong together": {"scenes": ("a",), "tls_cert": tmp_path},
        "needs --tls-cert": {"scenes": ("a",), "tls_client_ca": tmp_path},
        "--port must be": {"scenes": ("a",), "port": 99_999},
    }
    for words, values in refused.items():
        with pytest.raises(ClimateGSError, match=words):
            ServeOptions(**values)
    with pytest.raises(ClimateGSError, match=r"render\.base is 'recorded'"):
        served_recipes(("dense-fog",), None, ("render.base=recorded",))


def test_a_scene_can_be_given_a_name(tmp_path: Path):
    for text, name, uri in (
        ("clip=procedural:street?seed=3", "clip", "procedural:street?seed=3"),
        ("procedural:street?seed=3", None, "procedural:street?seed=3"),
        ("a.b-1=/data/x=y", "a.b-1", "/data/x=y"),
        (f"{tmp_path}", None, f"{tmp_path}"),
    ):
        source = parse_source(text)
        assert (source.name, source.uri) == (name, uri)
