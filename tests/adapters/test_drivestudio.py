"""A drivestudio run as a scene: its images are those composed from the checkpoint's own numbers."""

from __future__ import annotations

import json
import os
import pickle
from collections import OrderedDict
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from adapters.base import open_scene
from adapters.detect_format import detect_scheme
from adapters.drivestudio.adapter import (
    drivestudio_labels,
    open_drivestudio,
    read_sky,
    rotate_cubemap,
)
from augment.errors import AdapterError
from augment.render.rasterize import rasterize
from augment.scene.cameras import Camera
from augment.scene.scene import Gaussians, PosedGaussians
from augment.scene.sky import ConstantSky, CubemapSky, directions_of_cubemap
from augment.view.plan import make_plan
from augment.view.render_view import render_buffers
from recipes.schema import Recipe
from tests.adapters import drivestudio_files as files
from tests.adapters.drivestudio_files import (
    COUNT,
    START,
    STRIDE,
    quat_of,
    rotation_of,
    write_as_drivestudio,
)

FRAME_NS = 100_000_000
C0 = 0.28209479177387814


@pytest.fixture(scope="module", params=["waymo", "nuscenes", "pandaset", "argoverse"])
def run(request, tmp_path_factory):
    numbers = write_as_drivestudio(tmp_path_factory.mktemp(request.param), dataset=request.param)
    return numbers, open_scene(f"drivestudio:{numbers.folder}")


def opengl_lookup(directions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Face, s and t in [0, 1] of directions [N, 3], by the table of OpenGL's specification."""
    faces, s, t = [], [], []
    for x, y, z in directions:
        major = int(np.abs([x, y, z]).argmax())
        face, sc, tc = {
            (0, True): (0, -z, -y), (0, False): (1, z, -y),
            (1, True): (2, x, z), (1, False): (3, x, -z),
            (2, True): (4, x, -y), (2, False): (5, -x, -y),
        }[major, bool((x, y, z)[major] > 0)]  # fmt: skip
        length = abs((x, y, z)[major])
        faces.append(face)
        s.append((sc / length + 1) / 2)
        t.append((tc / length + 1) / 2)
    return np.array(faces), np.array(s), np.array(t)


def own_sky(base: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Colours of EnvLight in directions [N, 3] of the model's world, and which of them lie between
    texels of one face.
    """
    turned = np.stack([directions[:, 0], directions[:, 2], -directions[:, 1]], 1)
    face, s, t = opengl_lookup(turned)
    size = base.shape[1]
    column, row = s * size - 0.5, t * size - 0.5
    inside = (np.minimum(column, row) >= 0) & (np.maximum(column, row) <= size - 1)
    c, r = (np.clip(v, 0, size - 1 - 1e-9) for v in (column, row))
    c0, r0 = c.astype(int), r.astype(int)
    fc, fr = (c - c0)[:, None], (r - r0)[:, None]
    top = base[face, r0, c0] * (1 - fc) + base[face, r0, c0 + 1] * fc
    bottom = base[face, r0 + 1, c0] * (1 - fc) + base[face, r0 + 1, c0 + 1] * fc
    return top * (1 - fr) + bottom * fr, inside


def own_affine(content: dict, embedding: np.ndarray) -> np.ndarray:
    w = {name: value.double().numpy() for name, value in content.items()}
    hidden = np.maximum(w["decoder.0.weight"] @ embedding + w["decoder.0.bias"], 0)
    values = (w["decoder.2.weight"] @ hidden + w["decoder.2.bias"]).reshape(3, 4)
    return values + np.hstack([np.eye(3), np.zeros((3, 1))])


def own_pose_change(row: np.ndarray) -> np.ndarray:
    a, b = row[3:9].reshape(2, 3) + np.eye(2, 3)
    x = a / np.linalg.norm(a)
    y = b - x.dot(b) * x
    y /= np.linalg.norm(y)
    return files.rigid(np.array([x, y, np.cross(x, y)]), row[:3])


def own_object_pose(rigid: dict, at: int, index: int) -> np.ndarray | None:
    """[4, 4] in the model's world; of a held-out frame the middle of its neighbours, if any."""
    quats = rigid["instances_quats"].double().numpy()
    places = rigid["instances_trans"].double().numpy()
    visible = rigid["instances_fv"].numpy()
    if not visible[at, index]:
        return None
    if at == STRIDE and visible[at - 1, index] and visible[at + 1, index]:
        middle = (places[at - 1, index] + places[at + 1, index]) / 2
        return files.rigid(rotation_of(quats[at + 1, index]), middle)  # it does not turn
    return files.rigid(rotation_of(quats[at, index]), places[at, index])


def world_gaussians(content: dict, chosen: np.ndarray, world: np.ndarray) -> Gaussians:
    """Raw rows activated and placed; spherical harmonics stay as they are, as in the project."""
    raw = {name: content[name].double().numpy()[chosen] for name in content if name[0] == "_"}
    if raw["_features_rest"].shape[1] == 0:
        first = (1 / (1 + np.exp(-raw["_features_dc"])) - 0.5) / C0
    else:
        first = raw["_features_dc"]
    own = Rotation.from_quat(np.roll(raw["_quats"], -1, axis=1))
    quats = np.roll((Rotation.from_matrix(world[:3, :3]) * own).as_quat(), 1, axis=1)
    return Gaussians(
        means=files.floats(raw["_means"] @ world[:3, :3].T + world[:3, 3]),
        quats=files.floats(quats),
        scales=files.floats(np.exp(raw["_scales"])),
        opacities=files.floats(1 / (1 + np.exp(-raw["_opacities"][:, 0]))),
        sh=files.floats(np.concatenate([first[:, None], raw["_features_rest"]], 1)),
    )


def own_image(numbers: files.Numbers, at: int, position: int) -> tuple[np.ndarray, np.ndarray]:
    """The image of a frame and camera in the model's world, and where its sky is between texels."""
    models = numbers.models
    image = at * len(files.CAMERAS) + position
    change = own_pose_change(models["CamPose"]["embeds.weight"][image].double().numpy())
    world_from_camera = numbers.model_from_camera[at, position] @ change
    width, height = files.SIZES[numbers.dataset][position]
    columns, rows = int(width / files.DOWNSCALE), int(height / files.DOWNSCALE)
    sx, sy = columns / width, rows / height
    lens = (files.FOCAL_PX * sx, files.FOCAL_PX * 1.02 * sy, 0.49 * width * sx, 0.52 * height * sy)
    camera_from_world = torch.from_numpy(np.linalg.inv(world_from_camera))
    seen = Camera("own", columns, rows, *lens, camera_from_world)
    background = models["Background"]
    every = np.arange(len(background["_means"]))
    parts = [PosedGaussians(world_gaussians(background, every, np.eye(4)))]
    rigid = models["RigidNodes"]
    for index in range(2):
        world = own_object_pose(rigid, at, index)
        if world is not None:
            chosen = np.flatnonzero(rigid["points_ids"][:, 0].numpy() == index)
            parts.append(PosedGaussians(world_gaussians(rigid, chosen, world)))
    raster = rasterize(parts, seen, backend="reference")
    rays = seen.ray_directions(torch.float64).reshape(-1, 3).numpy()
    sky, inside = own_sky(models["Sky"]["base"].double().numpy(), rays)
    shape = (seen.height, seen.width)
    alpha = raster.alpha.double().numpy()[..., None]
    rgb = raster.rgb.double().numpy() + (1 - alpha) * sky.reshape(*shape, 3)
    looks = models["Affine"]["embedding.weight"].double().numpy()
    color_map = own_affine(models["Affine"], looks.mean(0) if at == STRIDE else looks[image])
    return rgb @ color_map[:, :3].T + color_map[:, 3], inside.reshape(shape)


# Frame 2 is trained on, frame 3 lacks an object, frame 4 is held out.
@pytest.mark.parametrize(("at", "position"), [(2, 1), (STRIDE, 0), (4, 2)])
def test_images_are_those_composed_from_the_checkpoint(run, at, position):
    numbers, scene = run
    camera = list(scene.frame(START + at).cameras.values())[position]
    shown = render_buffers(scene, camera, make_plan(Recipe(), scene), backend="reference").rgb
    own, inside = own_image(numbers, at, position)
    assert tuple(shown.shape) == own.shape
    assert inside.mean() > 0.5
    error = np.abs(shown.double().numpy() - own)[inside]
    # Float rounding; and splats whose opacity at a pixel is about 1/255 may be there or not.
    assert np.quantile(error, 0.99) < 2e-5
    assert error.max() < 0.01
    assert own.std() > 0.1


def test_colours_without_spherical_harmonics_are_sigmoids(tmp_path):
    numbers = write_as_drivestudio(tmp_path, degree=0)
    scene = open_scene(str(numbers.folder))
    raw = numbers.models["Background"]["_features_dc"]
    assert scene.background.sh.shape[1] == 1
    assert torch.allclose(scene.background.sh[:, 0] * C0 + 0.5, torch.sigmoid(raw), atol=1e-6)
    camera = next(iter(scene.frames[1].cameras.values()))
    shown = render_buffers(scene, camera, make_plan(Recipe(), scene), backend="reference").rgb
    own, inside = own_image(numbers, 1, 0)
    assert np.quantile(np.abs(shown.double().numpy() - own)[inside], 0.99) < 2e-5


def test_degrees_that_training_had_not_switched_on_are_left_out(tmp_path):
    numbers = write_as_drivestudio(tmp_path, degree=3)
    path = numbers.folder / "checkpoint_final.pth"
    content = torch.load(path, weights_only=True)
    torch.save({**content, "step": 1999}, path)
    scene = open_scene(str(numbers.folder))
    assert scene.background.sh.shape[1] == 4
    expected = numbers.models["Background"]["_features_rest"][:, :3]
    assert torch.equal(scene.background.sh[:, 1:], expected)
    assert any("Background: training stopped at step 1999" in p for p in scene.problems)
    faster = {"model.Background.ctrl": {"sh_degree_interval": 500}}
    files.write_config(numbers.folder, numbers.data.parent, "waymo", faster)
    scene = open_scene(str(numbers.folder))
    assert scene.background.sh.shape[1] == 16
    assert [a.gaussians.sh.shape[1] for a in scene.actors] == [4, 4]


def test_objects_are_those_of_the_data_and_absent_where_not_visible(run):
    numbers, scene = run
    assert [a.track_id for a in scene.actors] == ["car-a", "car-b"]
    assert [a.label for a in scene.actors] == ["Vehicle", "Vehicle"]
    assert scene.actors[0].size_m == pytest.approx((4, 1.8, 1.5))
    track = scene.actors[1].track
    times = [(START + at) * FRAME_NS for at in range(COUNT)]
    assert [track.pose_at(time) is not None for time in times] == [True, True, False, True, True]
    assert track.pose_at(times[-1] + FRAME_NS) is None
    # z is up in PandaSet's world already, which is left as it is.
    flat = files.OPENCV_AXES if numbers.dataset == "nuscenes" else np.eye(3)
    level = files.RIGHT_AXES.T if numbers.dataset == "pandaset" else np.eye(3)
    for at in (0, 1, 2, 4):
        pose = scene.actors[0].track.pose_at(times[at]).numpy()
        trained = numbers.models["RigidNodes"]["instances_trans"][at, 0].double().numpy()
        assert np.allclose(pose[:3, 3], flat @ trained, atol=1e-9)
        assert np.allclose(pose[:3, :3], level @ files.turn(2, 0.4), atol=1e-6)
    between = scene.actors[0].track.pose_at(times[0] + FRAME_NS // 2)[:3, 3].numpy()
    ends = [scene.actors[0].track.pose_at(t)[:3, 3].numpy() for t in times[:2]]
    assert np.allclose(between, np.mean(ends, 0))


@pytest.mark.parametrize(("stride", "is_between"), [(3, True), (5, False)])
def test_held_out_frames_have_the_middle_of_their_neighbours(tmp_path, stride, is_between):
    """Of position 3; position 1 never has, as the first frame must not be among its neighbours."""
    numbers = write_as_drivestudio(tmp_path, config={"data.pixel_source.test_image_stride": stride})
    path = numbers.folder / "checkpoint_final.pth"
    content = torch.load(path, weights_only=True)
    quats = content["models"]["RigidNodes"]["instances_quats"]
    for at, heading in enumerate((0.1, 0.3, 0.4, 2.0, 0.8)):
        quats[at, 0] = files.floats(quat_of(files.turn(2, heading)) * (-1) ** at)
    torch.save(content, path)
    track = open_scene(str(numbers.folder)).actors[0].track
    places = numbers.models["RigidNodes"]["instances_trans"][:, 0].double().numpy()
    between = files.rigid(files.turn(2, 0.6), (places[2] + places[4]) / 2)
    trained = files.rigid(files.turn(2, 2.0), places[3])
    shown = [track.pose_at((START + at) * FRAME_NS).numpy() for at in range(COUNT)]
    assert np.allclose(shown[3], between if is_between else trained, atol=1e-6)
    assert np.allclose(shown[1], files.rigid(files.turn(2, 0.3), places[1]), atol=1e-6)


def test_boxes_and_actors_agree(run):
    _, scene = run
    boxes = scene.boxes(START + 1)
    assert boxes.track_ids == ("walker", "car-b", "car-a")
    assert boxes.labels == ("Pedestrian", "Vehicle", "Vehicle")
    assert boxes.attributes["instance"].tolist() == [0, 1, 2]
    for actor in scene.actors:
        row = boxes.track_ids.index(actor.track_id)
        pose = actor.track.pose_at((START + 1) * FRAME_NS).numpy()
        assert np.linalg.norm(boxes.centers_m[row] - pose[:3, 3]) == pytest.approx(0.0632, abs=1e-3)
        assert np.allclose(rotation_of(boxes.quats[row]), pose[:3, :3], atol=1e-6)
        assert np.allclose(boxes.sizes_m[row], actor.size_m)
    assert "car-b" not in scene.boxes(START + 2).track_ids


def test_sweeps_are_moved_to_the_scene(run):
    numbers, scene = run
    is_waymo = numbers.dataset == "waymo"
    rows = files.lidar_rows(numbers.dataset, 3).astype(np.float64)
    axes = {"nuscenes": files.OPENCV_AXES}.get(numbers.dataset, np.eye(3))
    car = {"pandaset": files.RIGHT_AXES}.get(numbers.dataset, np.eye(3))
    moved = np.linalg.inv(numbers.dataset_from_model) @ files.dataset_from_ego(3)
    moved = files.rigid(axes, [0, 0, 0]) @ moved @ files.rigid(car, [0, 0, 0])
    sweep = scene.lidar(3)
    first = 3 if is_waymo else 0
    expected = rows[:, first : first + 3] @ moved[:3, :3].T + moved[:3, 3]
    assert np.allclose(sweep.points_m, expected, atol=1e-6)
    names = "elongation laser_id flow_class" if is_waymo else "intensity"
    at = {"elongation": 12, "laser_id": 13, "flow_class": 9, "intensity": 3}
    for name in names.split():
        assert np.array_equal(sweep.columns[name], rows[:, at[name]].astype(np.float32))
    if is_waymo:
        flow = np.stack([sweep.columns[f"flow_{axis}"] for axis in "xyz"], 1)
        assert np.allclose(flow, rows[:, 6:9] @ moved[:3, :3].T, atol=1e-6)
    (numbers.data / "lidar" / "005.bin").unlink(missing_ok=True)
    assert scene.lidar(5) is None
    again = pickle.loads(pickle.dumps(drivestudio_labels(str(numbers.folder), {})))
    assert again.boxes(2).track_ids == scene.boxes(2).track_ids


def test_world_is_level_and_ego_looks_ahead(run):
    numbers, scene = run
    level = files.RIGHT_AXES.T if numbers.dataset == "pandaset" else np.eye(3)
    for frame in scene.frames:
        ego = level.T @ frame.world_from_ego[:3, :3].numpy()
        assert ego[2, 2] > 0.99 and ego[0, 0] > 0.99
    front = next(iter(scene.frames[0].cameras.values())).world_from_camera[:3, :3].numpy()
    front = level.T @ front
    assert front[0, 2] > 0.99 and front[2, 1] < -0.99
    assert [f.index for f in scene.frames] == [1, 2, 3, 4, 5]
    assert {c.timestamp_ns for c in scene.frame(3).cameras.values()} == {3 * FRAME_NS}
    assert len(scene.frame(3).image_paths) == 3


def test_colour_maps_of_held_out_images_are_of_the_mean_appearance(run):
    numbers, scene = run
    content = numbers.models["Affine"]
    mean = own_affine(content, content["embedding.weight"].double().numpy().mean(0))
    assert set(scene.color_maps) == set(scene.camera_names)
    for color_map in scene.color_maps.values():
        assert np.allclose(color_map.numpy(), mean, atol=1e-6)
    times = {time for _, time in scene.image_color_maps}
    assert times == {(START + at) * FRAME_NS for at in range(COUNT) if at != STRIDE}


def test_skipped_models_are_named_with_their_counts(run):
    numbers, scene = run
    assert any("7 Gaussians of SMPLNodes are left out" in p for p in scene.problems)
    assert any("5 Gaussians of DeformableNodes are left out" in p for p in scene.problems)
    distorted = [p for p in scene.problems if "lens distortion" in p]
    assert len(distorted) == (3 if numbers.dataset == "waymo" else 0)


def test_frames_are_selected_without_shifting_what_is_learnt_for_images(run):
    numbers, scene = run
    part = open_scene(f"drivestudio:{numbers.folder}?frames=3:5")
    assert [f.index for f in part.frames] == [3, 4]
    name = scene.camera_names[1]
    key = (name, 3 * FRAME_NS)
    assert torch.equal(part.image_color_maps[key], scene.image_color_maps[key])
    here, there = (s.frame(3).cameras[name].camera_from_world for s in (part, scene))
    assert torch.equal(here, there)
    assert open_scene(part.source).frames[0].index == 3


@pytest.mark.parametrize("flat", [np.eye(3), files.OPENCV_AXES])
def test_sky_texels_are_the_checkpoint_s_own(flat):
    """Of every texel of the scene's sky, by a table of its own."""
    size = 5
    base = np.random.default_rng(0).uniform(0, 2, (6, size, size, 3)).astype(np.float32)
    sky, problems = read_sky({"Sky": {"base": torch.from_numpy(base.copy())}}, flat, "here")
    assert problems == () and isinstance(sky, CubemapSky)
    ticks = (np.arange(size) + 0.5) / size * 2 - 1
    t, s = (v.ravel() for v in np.meshgrid(ticks, ticks, indexing="ij"))
    one = np.ones_like(s)
    for face, axes in enumerate(
        [(one, -t, -s), (-one, -t, s), (s, one, t), (s, -one, -t), (s, -t, one), (-s, -t, -one)]
    ):
        scene_directions = np.stack(axes, 1)
        x, y, z = (scene_directions @ flat).T  # of the model's world
        source, u, v = opengl_lookup(np.stack([x, z, -y], 1))
        texels = base[source, (v * size).astype(int), (u * size).astype(int)]
        assert np.array_equal(sky.faces[face].reshape(-1, 3).numpy(), texels)


def test_a_sky_on_a_slope_is_looked_up_between_texels():
    faces = torch.rand(6, 9, 9, 3, generator=torch.Generator().manual_seed(3))
    turn = rotation_of(np.array([0.9, 0.3, -0.2, 0.25]))
    shown = rotate_cubemap(faces, turn)
    there = directions_of_cubemap(9) @ torch.from_numpy(turn.T).float()
    assert torch.allclose(shown, CubemapSky(faces).sample(there), atol=1e-5)


@pytest.mark.parametrize("appearances", [0, 4])
def test_sky_network_is_baked(appearances):
    rng = np.random.default_rng(4)
    inputs, width = 45 + appearances, 64
    w = {
        "sky_head.layers.0.weight": rng.normal(size=(width, inputs)) * 0.2,
        "sky_head.layers.0.bias": rng.normal(size=width) * 0.1,
        "sky_head.layers.1.weight": rng.normal(size=(width, width + inputs)) * 0.1,
        "sky_head.layers.1.bias": rng.normal(size=width) * 0.1,
        "sky_head.layers.2.weight": rng.normal(size=(3, width)) * 0.2,
        "sky_head.layers.2.bias": rng.normal(size=3) * 0.1,
    }
    if appearances:
        w["appearance_embedding.weight"] = rng.normal(size=(6, appearances))
    content = {name: files.floats(value) for name, value in w.items()}
    sky, problems = read_sky({"Sky": content}, files.OPENCV_AXES, "here")
    assert isinstance(sky, CubemapSky) and sky.faces.shape == (6, 256, 256, 3)
    assert [("mean appearance" in p) for p in problems] == [True] * bool(appearances)
    # The texel in the middle of +x, a little left of and above the axis.
    direction = np.array([1, 1 / 256, 1 / 256]) / np.linalg.norm([1, 1 / 256, 1 / 256])
    x = direction @ files.OPENCV_AXES
    given = list(x)
    given += [np.sin(2.0**k * v) for k in range(7) for v in x]
    given += [np.sin(2.0**k * v + np.pi / 2) for k in range(7) for v in x]
    if appearances:
        given += list(w["appearance_embedding.weight"].mean(0))
    hidden = np.maximum(w["sky_head.layers.0.weight"] @ given + w["sky_head.layers.0.bias"], 0)
    hidden = np.maximum(
        w["sky_head.layers.1.weight"] @ [*hidden, *given] + w["sky_head.layers.1.bias"], 0
    )
    out = w["sky_head.layers.2.weight"] @ hidden + w["sky_head.layers.2.bias"]
    shown = sky.sample(torch.from_numpy(direction)[None])[0].numpy()
    assert np.allclose(shown, 1 / (1 + np.exp(-out)), atol=1e-4)


@pytest.fixture
def numbers(tmp_path):
    return files.write_as_drivestudio(tmp_path)


def opened(numbers, **query):
    return open_drivestudio(str(numbers.folder), query)


def change_checkpoint(numbers, change) -> None:
    path = numbers.folder / "checkpoint_final.pth"
    content = torch.load(path, weights_only=True)
    change(content)
    torch.save(content, path)


def refused(numbers, message: str, **query) -> str:
    with pytest.raises(AdapterError, match=message) as caught:
        opened(numbers, **query)
    return str(caught.value)


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("data.dataset", "mars", "axes of 'mars' are not known.*waymo, nuscenes, pandaset, argov"),
        ("data.dataset", None, "data.dataset: Field required"),
        ("data.dataset", 3, "data.dataset: Input should be a valid string .got 3"),
        ("data.data_root", "${root}/x", r"data.data_root is '\$\{root\}/x', which refers"),
        ("data.pixel_source.cameras", ["${cam}"], r"data.pixel_source.cameras is '\$\{cam\}'"),
        ("data.start_timestep", 1.5, "data.start_timestep: Input should be a valid integer"),
        ("data.start_timestep", 6, "frames data.start_timestep 6 to data.end_timestep 5 .* none"),
        ("data.pixel_source.cameras", [0, 5], r"camera numbers, 0 to 4, each once; got \[0, 5\]"),
        ("data.pixel_source.cameras", [0, 0, 1], "each once"),
        ("data.pixel_source.cameras", [], "data.pixel_source.cameras: List should have at least 1"),
        ("data.pixel_source.cameras", [True, 2], "cameras.0: Input should be a valid integer"),
        ("data.pixel_source.downscale_when_loading", [2, 2], "factor > 0 for each of the 3"),
        ("data.pixel_source.downscale_when_loading", [2, 0, 2], "loading.1: .*greater than 0"),
        ("data.pixel_source.downscale_when_loading", [2000, 2, 2], "leaves no pixel of 1920x1280"),
        ("data.pixel_source.test_image_stride", -1, "greater than or equal to 0 .got -1"),
        ("data.data_root", "/nowhere", r"/nowhere/007 of its config.yaml is not here.*data=DIR"),
        ("data.scene_idx", None, "does not say where the data is.*data=DIR"),
    ],
)
def test_a_config_that_cannot_be_used_is_refused(numbers, key, value, message):
    files.write_config(numbers.folder, numbers.data.parent, "waymo", {key: value})
    assert "config.yaml" in refused(numbers, message)


def test_options_that_cannot_be_used_are_refused(numbers):
    refused(numbers, "unknown option 'nodes'; .* data: .*; checkpoint: .*; frames:", nodes="1")
    refused(numbers, "frames must be first:stop", frames="3")
    refused(numbers, "frames must be first:stop", frames="4:2")
    refused(numbers, "frames=7: selects none of the 5 frames .1 to 5", frames="7:")
    refused(numbers, "no such folder; give the processed scene's", data="/nowhere")
    refused(numbers, "data must be the processed scene's folder", data="")
    refused(numbers, "does not exist; the run has checkpoint_final.pth", checkpoint="b.pth")
    refused(numbers, "without '..'", checkpoint="../b.pth")
    (numbers.folder / "config.yaml").unlink()
    refused(numbers, "config.yaml does not exist; a drivestudio run is")


def test_runs_are_recognised_and_data_found(numbers, tmp_path, monkeypatch):
    assert detect_scheme(numbers.folder) == "drivestudio"
    assert open_scene(str(numbers.folder)).name == "run"
    # A relative root is one from above the run, or from where one is.
    files.write_config(numbers.folder, Path("data"), "waymo", {})
    assert opened(numbers).frames[0].image_paths["front_camera"].startswith(str(tmp_path))
    elsewhere = tmp_path / "elsewhere"
    (tmp_path / "data").rename(elsewhere)
    refused(numbers, "data/007 of its config.yaml is not here")
    found = opened(numbers, data=str(elsewhere / "007"))
    assert found.frames[0].image_paths["front_camera"].startswith(str(elsewhere))
    monkeypatch.chdir(elsewhere.rename(tmp_path / "cwd").parent)
    (tmp_path / "cwd").rename(tmp_path / "data")
    assert len(opened(numbers).frames) == files.COUNT


def test_the_newest_checkpoint_is_taken_where_none_is_final(numbers):
    final = numbers.folder / "checkpoint_final.pth"
    content = torch.load(final, weights_only=True)
    final.unlink()
    refused(numbers, "holds no checkpoint_final.pth and no checkpoint_NNNNN.pth")
    for name, count in (("09000", 3), ("15000", 11), ("100000", 2)):
        content["models"]["SMPLNodes"]["_means"] = torch.zeros(count, 3)
        torch.save(content, numbers.folder / f"checkpoint_{name}.pth")
    assert any("2 Gaussians of SMPL" in p for p in opened(numbers).problems)
    chosen = opened(numbers, checkpoint="checkpoint_15000.pth")
    assert any("11 Gaussians of SMPL" in p for p in chosen.problems)
    file = str(numbers.folder / "checkpoint_09000.pth")
    assert any("3 Gaussians of SMPL" in p for p in open_drivestudio(file, {}).problems)
    with pytest.raises(AdapterError, match="is a checkpoint already"):
        open_drivestudio(file, {"checkpoint": "checkpoint_15000.pth"})


def put(model: str, name: str, value):
    def change(content):
        content["models"][model][name] = value

    return change


def drop(*keys: str):
    def change(content):
        for key in keys[:-1]:
            content = content[key]
        del content[keys[-1]]

    return change


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (drop("models"), "holds no dictionary 'models'; it holds step"),
        (drop("step"), "step must be a number of training steps; got None"),
        (drop("models", "Background"), "holds no dictionary 'Background'; it holds RigidNodes"),
        (drop("models", "Background", "_quats"), "Background lacks the tensor '_quats'"),
        (put("Background", "_scales", torch.zeros(80, 2)), r"_scales must be .*\[80, 3\]; got"),
        (put("Background", "_means", torch.zeros(80, 3).double()), "_means must be float32"),
        (put("Background", "_features_rest", torch.zeros(80, 24, 3)), "0, 3, 8 or 15 rows.*got 24"),
        (put("Background", "_features_rest", torch.zeros(80, 4, 3)), "0, 3, 8 or 15 rows.*got 4"),
        (put("Background", "_taus", torch.zeros(80, 1)), "holds _taus besides plain Gaussians"),
        (put("RigidNodes", "points_ids", torch.full((40, 1), 2)), "points_ids must be 0 to 1"),
        (put("RigidNodes", "points_ids", torch.zeros(40, dtype=torch.long)), "points_ids must be"),
        (put("RigidNodes", "instances_fv", torch.ones(9, 2).bool()), "instances_fv has 9 frames;"),
        (put("RigidNodes", "instances_fv", torch.ones(5, 2)), "instances_fv must be bool"),
        (put("RigidNodes", "instances_quats", torch.zeros(5, 2, 4)), "NaN, infinite or zero"),
        (put("RigidNodes", "instances_trans", torch.zeros(5, 3, 3)), r"instances_trans must be"),
        (drop("models", "RigidNodes", "instances_size"), "lacks the tensor 'instances_size'"),
        (put("Sky", "base", torch.zeros(6, 8, 4, 3)), r"base must be \[6, R, R, 3\]"),
        (put("Sky", "base", torch.full((6, 2, 2, 3), torch.nan)), "base holds NaN"),
        (put("Affine", "embedding.weight", torch.zeros(14, 4)), r"embedding.weight must be .*15"),
        (put("Affine", "decoder.0.weight", torch.zeros(16, 5)), "must take the 4 numbers"),
        (put("Affine", "decoder.2.bias", torch.zeros(9)), r"decoder.2.bias must be .*\[12\]"),
        (put("CamPose", "embeds.weight", torch.zeros(15, 6)), r"embeds.weight must be .*\[15, 9\]"),
        (put("CamPose", "embeds.weight", -torch.eye(15, 9).roll(3, 1)), "that are no rotation"),
        (put("CamPose", "embeds.weight", torch.full((15, 9), torch.inf)), "NaN or infinite"),
    ],
)
def test_a_checkpoint_of_another_layout_is_refused(numbers, change, message):
    change_checkpoint(numbers, change)
    assert "checkpoint_final.pth" in refused(numbers, message)


def test_data_that_is_missing_or_wrong_is_refused(numbers):
    bin_file = numbers.data / "lidar" / "002.bin"
    bin_file.write_bytes(bin_file.read_bytes()[:-4])
    with pytest.raises(AdapterError, match=r"002\.bin must hold rows of 14 float32"):
        opened(numbers).lidar(2)
    pose = numbers.data / "ego_pose" / "002.txt"
    text = pose.read_text()
    pose.write_text("1 2 3")
    refused(numbers, r"002\.txt must hold 4 x 4 numbers")
    pose.write_text(text)
    intrinsics = numbers.data / "intrinsics" / "2.txt"
    intrinsics.write_text("0 1 2 3")
    refused(numbers, r"2\.txt must hold fx fy cx cy")
    intrinsics.unlink()
    refused(numbers, r"2\.txt does not exist")


def test_data_of_another_scene_is_refused(numbers):
    (numbers.data / "ego_pose" / "005.txt").unlink()
    refused(numbers, "embedding.weight must be")
    change_checkpoint(numbers, drop("models", "Affine"))
    change_checkpoint(numbers, drop("models", "CamPose"))
    refused(numbers, "instances_fv has 5 frames; .* have 4 .1 to 4.. Is it the scene")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda v: {"a": v["0"]}, "a.*: Input should be a valid integer"),
        (lambda v: {"0": {"id": 1}}, "0.frame_annotations.frame_idx: Field required"),
        (lambda v: {"0": v["0"], "1": v["0"]}, "ids of objects repeat"),
        (lambda v: {"0": notes(v["0"], frame_idx=[0])}, r"of equal length; got \(1, 6, 6\)"),
        (lambda v: {"0": notes(v["0"], frame_idx=[0] * 6)}, "frame numbers, each once"),
        (lambda v: {"0": notes(v["0"], frame_idx=[10**400] * 6)}, "frame_idx: .*must hold T numb"),
        (lambda v: {"0": notes(v["0"], box_size=[["1"] * 3] * 6)}, "must hold T x 3 numbers"),
        (lambda v: {"9" * 5000: v["0"]}, "Unable to parse|unable to parse"),
        (lambda v: {"0": notes(v["0"], box_size=[[1, 2]] * 6)}, "box_size: .*must hold T x 3 numb"),
        (lambda v: {"0": notes(v["0"], box_size=[[1, 2, 0]] * 6)}, "box_size > 0"),
        (lambda v: {"0": notes(v["0"], obj_to_world=[[2.0] * 16] * 6)}, "must be rotations"),
    ],
)
def test_objects_that_are_none_are_refused(numbers, change, message):
    path = numbers.data / "instances" / "instances_info.json"
    path.write_text(json.dumps(change(json.loads(path.read_text()))))
    assert "instances_info.json" in refused(numbers, message)


def notes(entry: dict, **values) -> dict:
    return {**entry, "frame_annotations": {**entry["frame_annotations"], **values}}


def test_objects_that_cannot_be_told_keep_their_numbers(numbers):
    path = numbers.data / "instances" / "instances_info.json"
    info = json.loads(path.read_text())
    twin = {**info["2"], "id": "car-c"}
    path.write_text(json.dumps({**info, "3": twin}))
    scene = opened(numbers)
    assert [a.track_id for a in scene.actors] == ["rigid-0", "car-b"]
    assert scene.actors[0].label == "vehicle"
    assert any("could not be told" in p and p.endswith("rigid-0") for p in scene.problems)
    path.unlink()
    scene = opened(numbers)
    assert [a.track_id for a in scene.actors] == ["rigid-0", "rigid-1"]
    assert any("holds no instances/instances_info.json" in p for p in scene.problems)
    assert len(scene.boxes(1)) == 0


def test_poses_of_objects_may_be_flat(numbers):
    before = opened(numbers).boxes(1)
    path = numbers.data / "instances" / "instances_info.json"
    info = json.loads(path.read_text())
    for key, entry in info.items():
        poses = np.array(entry["frame_annotations"]["obj_to_world"]).reshape(-1, 16)
        info[key] = notes(entry, obj_to_world=poses.tolist())
    nothing = {name: [] for name in ("frame_idx", "obj_to_world", "box_size")}
    info["3"] = {"id": 9, "frame_annotations": nothing}
    path.write_text(json.dumps(info, indent=4))
    os.utime(path, ns=(0, 0))
    assert np.array_equal(opened(numbers).boxes(1).centers_m, before.centers_m)


def test_objects_elsewhere_or_of_another_size_are_not_taken_for_the_model_s(numbers):
    path = numbers.data / "instances" / "instances_info.json"
    info = json.loads(path.read_text())
    moved = np.array(info["2"]["frame_annotations"]["obj_to_world"])
    moved[:, 0, 3] += 5
    info["2"] = notes(info["2"], obj_to_world=moved.tolist())
    info["1"] = notes(info["1"], box_size=[[4.5, 1.9, 1.7]] * 4)
    path.write_text(json.dumps(info))
    assert [a.track_id for a in opened(numbers).actors] == ["rigid-0", "rigid-1"]


def test_what_is_gone_on_without_is_said(numbers):
    (numbers.data / "images" / "002_0.jpg").unlink()
    first = numbers.data / "images" / "000_3.jpg"
    first.write_bytes((numbers.data / "images" / "000_0.jpg").read_bytes())

    def change(content):
        models = content["models"]
        del models["Sky"]
        width = torch.zeros(16, 6)
        models["Affine"]["decoder.0.weight"] = width
        models["Extra"] = OrderedDict(weight=torch.zeros(2))
        models["RigidNodes"]["instances_fv"][:, 1] = False
        models["Background"]["_means"][:3] = torch.nan
        rotated = torch.tensor([1.0, 0, 0, 1])
        models["RigidNodes"]["instances_quats"][0, 0] = rotated

    change_checkpoint(numbers, change)
    changes = {"data.pixel_source.undistort": False, "trainer.render.antialiased": True}
    files.write_config(numbers.folder, numbers.data.parent, "waymo", changes)
    scene = opened(numbers)
    assert isinstance(scene.sky, ConstantSky) and scene.color_maps == scene.image_color_maps == {}
    said = "\n".join(scene.problems)
    for part in (
        "1 of 15 images are missing, the first 002_0.jpg",
        "000_3.jpg is of 1920x1280 pixels; drivestudio takes the intrinsics of left_camera to be",
        "holds no Sky; the sky is black",
        "differ over the image (pixel_affine); they are left out",
        "the model Extra is left out",
        "no actors: rigid-1",
        "left out 3 of 80 Gaussians with NaN",
        "as if it had none (undistort is off)",
        "trainer.render.antialiased",
    ):
        assert part in said
    assert "front_camera" not in scene.frame(2).image_paths
    assert len(scene.background) == 77


def test_a_run_without_objects_or_corrections_is_a_scene(numbers):
    for name in ("RigidNodes", "Affine", "CamPose", "SMPLNodes", "DeformableNodes"):
        change_checkpoint(numbers, drop("models", name))
    scene = opened(numbers)
    assert scene.actors == () and scene.color_maps == {}
    camera = scene.frame(1).cameras["front_camera"]
    expected = files.ego_from_opencv(0)
    assert np.allclose(camera.world_from_camera.numpy(), expected, atol=1e-9)
    assert len(scene.boxes(1)) == 3


def test_perturbed_poses_are_applied_before_the_learnt_ones(numbers):
    def change(content):
        shift = torch.zeros(15, 9)
        shift[:, 0] = 0.5
        quarter = torch.zeros(15, 9)
        quarter[:, 3:] = torch.tensor([-1.0, -1, 0, 1, -1, 0])  # rows (0 -1 0) and (1 0 0)
        content["models"]["CamPosePerturb"] = {"embeds.weight": quarter}
        content["models"]["CamPose"] = {"embeds.weight": shift}

    change_checkpoint(numbers, change)
    camera = opened(numbers).frame(1).cameras["front_camera"]
    turned = files.rigid(np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), [0, 0, 0])
    expected = files.ego_from_opencv(0) @ turned @ files.rigid(np.eye(3), [0.5, 0, 0])
    assert np.allclose(camera.world_from_camera.numpy(), expected, atol=1e-7)


@pytest.mark.parametrize(
    ("dataset", "slope", "lies"),
    [
        ("nuscenes", 0.3, False),
        ("pandaset", 0.3, False),
        ("waymo", 0.6, True),
        ("nuscenes", np.pi / 2, True),
    ],
)
def test_a_car_on_no_road_is_taken_to_stand_level(tmp_path, monkeypatch, dataset, slope, lies):
    level = files.dataset_from_ego
    c, s = np.cos(slope), np.sin(slope)
    nose_up = files.rigid(np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]), [0, 0, 0])
    monkeypatch.setattr(files, "dataset_from_ego", lambda frame: level(frame) @ nose_up)
    scene = opened(files.write_as_drivestudio(tmp_path, dataset=dataset))
    assert any("taken to stand level" in problem for problem in scene.problems) == lies
    expected = np.eye(3)[2] if lies else [-s, 0, c]
    assert np.allclose(scene.frames[0].world_from_ego[2, :3].numpy(), expected, atol=1e-12)


def test_labels_need_no_readable_checkpoint(numbers):
    (numbers.folder / "checkpoint_final.pth").write_bytes(b"")
    labels = drivestudio_labels(str(numbers.folder), {"frames": "2:3"})
    assert labels.boxes(1).track_ids == ("walker", "car-b", "car-a")
