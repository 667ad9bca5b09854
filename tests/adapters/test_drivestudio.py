"""A drivestudio run as a scene: its images are those composed from the checkpoint's own numbers."""

from __future__ import annotations

import pickle

import drivestudio_files as files
import numpy as np
import pytest
import torch
from drivestudio_files import COUNT, START, STRIDE, quat_of, rotation_of, write_run
from scipy.spatial.transform import Rotation

from adapters.base import open_scene
from adapters.drivestudio.adapter import drivestudio_labels, read_sky, turned_faces
from augment.cameras import Camera
from augment.plan import make_plan
from augment.render.rasterize import rasterize
from augment.scene import Gaussians, PosedGaussians
from augment.sky import CubemapSky, directions_of_cubemap
from augment.views import render_buffers
from recipes.schema import Recipe

FRAME_NS = 100_000_000
C0 = 0.28209479177387814


@pytest.fixture(scope="module", params=["waymo", "nuscenes", "pandaset", "argoverse"])
def run(request, tmp_path_factory):
    numbers = write_run(tmp_path_factory.mktemp(request.param), dataset=request.param)
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
    return files.pose(np.array([x, y, np.cross(x, y)]), row[:3])


def own_object_pose(rigid: dict, at: int, index: int) -> np.ndarray | None:
    """[4, 4] in the model's world; of a held-out frame the middle of its neighbours, if any."""
    quats = rigid["instances_quats"].double().numpy()
    places = rigid["instances_trans"].double().numpy()
    visible = rigid["instances_fv"].numpy()
    if not visible[at, index]:
        return None
    if at == STRIDE and visible[at - 1, index] and visible[at + 1, index]:
        middle = (places[at - 1, index] + places[at + 1, index]) / 2
        return files.pose(rotation_of(quats[at + 1, index]), middle)  # it does not turn
    return files.pose(rotation_of(quats[at, index]), places[at, index])


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
    seen = Camera(
        "own",
        columns,
        rows,
        files.FOCAL_PX * sx,
        files.FOCAL_PX * 1.02 * sy,
        0.49 * width * sx,
        0.52 * height * sy,
        torch.from_numpy(np.linalg.inv(world_from_camera)),
    )
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
@pytest.mark.parametrize(("at", "position"), [(1, 0), (2, 1), (STRIDE, 0), (4, 2)])
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


def test_objects_matter_to_the_images_that_are_compared(run):
    _, scene = run
    camera = next(iter(scene.frame(START + 1).cameras.values()))
    whole, *less = (
        rasterize(parts, camera, backend="reference").rgb
        for parts in (
            scene.parts_for(camera),
            *(tuple(p for p in scene.parts_for(camera) if p.instance_id != i) for i in (1, 2)),
        )
    )
    assert all(float((whole - without).abs().max()) > 0.1 for without in less)


def test_colours_without_spherical_harmonics_are_sigmoids(tmp_path):
    numbers = write_run(tmp_path, degree=0)
    scene = open_scene(str(numbers.folder))
    raw = numbers.models["Background"]["_features_dc"]
    assert scene.background.sh.shape[1] == 1
    assert torch.allclose(scene.background.sh[:, 0] * C0 + 0.5, torch.sigmoid(raw), atol=1e-6)
    camera = next(iter(scene.frames[1].cameras.values()))
    shown = render_buffers(scene, camera, make_plan(Recipe(), scene), backend="reference").rgb
    own, inside = own_image(numbers, 1, 0)
    assert np.quantile(np.abs(shown.double().numpy() - own)[inside], 0.99) < 2e-5


def test_degrees_that_training_had_not_switched_on_are_left_out(tmp_path):
    numbers = write_run(tmp_path, degree=3)
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
        assert np.allclose(pose[:3, :3], level @ files.turn_z(0.4), atol=1e-6)
    between = scene.actors[0].track.pose_at(times[0] + FRAME_NS // 2)[:3, 3].numpy()
    ends = [scene.actors[0].track.pose_at(t)[:3, 3].numpy() for t in times[:2]]
    assert np.allclose(between, np.mean(ends, 0))


@pytest.mark.parametrize(("stride", "is_between"), [(3, True), (5, False)])
def test_held_out_frames_have_the_middle_of_their_neighbours(tmp_path, stride, is_between):
    """Of position 3; position 1 never has, as the first frame must not be among its neighbours."""
    numbers = write_run(tmp_path, config={"data.pixel_source.test_image_stride": stride})
    path = numbers.folder / "checkpoint_final.pth"
    content = torch.load(path, weights_only=True)
    quats = content["models"]["RigidNodes"]["instances_quats"]
    for at, heading in enumerate((0.1, 0.3, 0.4, 2.0, 0.8)):
        quats[at, 0] = files.floats(quat_of(files.turn_z(heading)) * (-1) ** at)
    torch.save(content, path)
    track = open_scene(str(numbers.folder)).actors[0].track
    places = numbers.models["RigidNodes"]["instances_trans"][:, 0].double().numpy()
    between = files.pose(files.turn_z(0.6), (places[2] + places[4]) / 2)
    trained = files.pose(files.turn_z(2.0), places[3])
    shown = [track.pose_at((START + at) * FRAME_NS).numpy() for at in range(COUNT)]
    assert np.allclose(shown[3], between if is_between else trained, atol=1e-6)
    assert np.allclose(shown[1], files.pose(files.turn_z(0.3), places[1]), atol=1e-6)


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
    moved = files.pose(axes, [0, 0, 0]) @ moved @ files.pose(car, [0, 0, 0])
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
    shown = turned_faces(faces, turn)
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
