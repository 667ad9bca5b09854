"""Trained Street Gaussians models as scenes, against pictures composed from their raw numbers."""

from __future__ import annotations

import dataclasses
import math
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from scipy.spatial.transform import Rotation

from adapters.base import open_scene
from adapters.detect_format import detect_scheme
from adapters.street_gaussians.adapter import (
    camera_changes,
    check_changes,
    color_maps,
    image_poses,
    make_actor,
    open_street_gaussians,
    street_gaussians_labels,
    vehicle_poses,
)
from adapters.street_gaussians.data import (
    ModelConfig,
    StreetData,
    StreetImage,
    TrackedObject,
    Tracklets,
)
from adapters.street_gaussians.model import Part, PoseChanges
from augment.errors import AdapterError
from augment.render.rasterize import rasterize
from augment.scene.cameras import Camera
from augment.scene.scene import Gaussians, PosedGaussians, Scene
from augment.scene.sky import ConstantSky
from augment.view.plan import make_plan
from augment.view.render_view import render_buffers
from recipes.schema import Recipe
from tests.adapters.street_gaussians_files import Facts, write_as_street_gaussians
from tests.adapters.street_gaussians_models import (
    RawModel,
    RawPart,
    config_tree,
    random_part,
    write_model,
)
from tests.assertions import assert_images_close

C0, C1 = 0.28209479177387814, 0.4886025119029199
CAMS = (0, 1, 2)
# Columns that the moving objects 1 and 4 have among these cameras' tracks in the four frames; the
# object 6 is seen by another camera only.
COLUMNS = {1: (0, 0, 0, 0), 4: (None, 1, 1, 1)}
SPAN = {1: (0, 3), 4: (1, 3)}
FACES = ((0, 1), (0, -1), (1, 1), (1, -1), (2, 1), (2, -1))  # axis and sign
# s and t of a direction (x, y, z) on each face, OpenGL 4.6 table 8.19: which axis and sign.
SC = ((2, -1), (2, 1), (0, 1), (0, 1), (0, 1), (0, -1))
TC = ((1, -1), (1, -1), (2, 1), (2, -1), (1, -1), (1, -1))


@pytest.fixture(scope="module")
def drive(tmp_path_factory) -> Facts:
    """Without images and LiDAR, which a trained model does not need."""
    return without_images(tmp_path_factory.mktemp("drive") / "seq")


def without_images(root: Path, **how) -> Facts:
    """Cameras are then those of Waymo; 96 pixels wide they are those of the facts."""
    facts = write_as_street_gaussians(root, images=False, lidar=False, **how)
    for cam in facts.cameras:
        path = root / "intrinsics" / f"{cam}.txt"
        values = np.loadtxt(path)
        np.savetxt(path, [*(20 * values[:4]), *values[4:]])
    return facts


def raw_model(facts: Facts, **changes) -> RawModel:
    """A street of splats along the drive, and those of the actors 1 and 4."""
    background = random_part(0, 400, low=(-20, -8, -1), high=(30, 8, 6), size_m=0.5)
    heading = Rotation.from_euler("z", 0.7)  # of the street in the dataset's world
    background = dataclasses.replace(
        background, xyz=heading.apply(background.xyz).astype(np.float32)
    )
    rng = np.random.default_rng(7)
    opt_rots = np.zeros((len(facts.numbers), 2, 1))
    opt_rots[:, 0], opt_rots[:, 1] = 0.03, -0.05  # the same in all frames: headings stay
    raw = RawModel(
        background=background,
        actors={
            1: random_part(1, 60, terms=5, low=(-2, -0.9, -0.7), high=(2, 0.9, 0.7)),
            4: random_part(2, 60, terms=5, low=(-1.5, -0.6, -0.8), high=(1.5, 0.6, 0.8)),
        },
        opt_trans=0.2 * rng.normal(size=(len(facts.numbers), 2, 3)),
        opt_rots=opt_rots,
        sky=smooth_sky(32),
    )
    return dataclasses.replace(raw, **changes)


def smooth_sky(size: int) -> np.ndarray:
    """Faces that differ from each other, each with slopes of its own."""
    ticks = (np.arange(size) + 0.5) / size
    t, s = np.meshgrid(ticks, ticks, indexing="ij")
    return np.stack([
        np.stack([0.1 + 0.12 * f + 0.1 * s, 0.9 - 0.1 * f - 0.2 * t, 0.3 + 0.5 * s * t], -1)
        for f in range(6)
    ])  # fmt: skip


def tree(facts: Facts, **changes) -> dict:
    return config_tree(**{"source_path": str(facts.root), "data.cameras": list(CAMS), **changes})


def saved(folder: Path, facts: Facts, raw: RawModel, how: dict | None = None, **config) -> Path:
    return write_model(folder / "run", raw, tree(facts, **config), **(how or {}))


def opened(path: Path, **query: str) -> Scene:
    return open_street_gaussians(str(path), {"width": "96", **query})


def render(scene: Scene, camera: Camera) -> torch.Tensor:
    return render_buffers(scene, camera, make_plan(Recipe(), scene), backend="reference").rgb


# --- the picture, from the raw numbers alone ---


def world_from_camera(facts: Facts, frame: int, cam: int) -> np.ndarray:
    pose = facts.world_from_ego(frame, cam) @ facts.ego_from_camera(cam)
    pose[:3, 3] -= facts.origin_m
    return pose


def vehicle_pose(facts: Facts, raw: RawModel, number: int, frame: int) -> np.ndarray:
    """In the vehicle's axes at the frame's time, as trained."""
    pose = facts.ego_from_object(number, frame)
    column = COLUMNS[number][frame]
    if raw.opt_trans is not None:
        pose[:3, 3] += raw.opt_trans[frame, column]
        pose[:3, :3] = (
            pose[:3, :3] @ Rotation.from_euler("z", 2 * raw.opt_rots[frame, column, 0]).as_matrix()
        )
    return pose


def actor_pose(facts: Facts, raw: RawModel, number: int, frame: int, cam: int) -> np.ndarray:
    """World pose at the camera's time, between the frames nearest to it."""
    time = facts.time_s(frame, cam)
    frames = [f for f in facts.numbers if COLUMNS[number][f] is not None]
    a, b = sorted(frames, key=lambda f: abs(facts.time_s(f) - time))[:2]
    share = (time - facts.time_s(a)) / (facts.time_s(b) - facts.time_s(a))
    first, second = (vehicle_pose(facts, raw, number, f) for f in (a, b))
    turn = Rotation.from_matrix(first[:3, :3].T @ second[:3, :3]).as_rotvec()
    pose = np.eye(4)
    pose[:3, :3] = first[:3, :3] @ Rotation.from_rotvec(share * turn).as_matrix()
    pose[:3, 3] = (1 - share) * first[:3, 3] + share * second[:3, 3]
    world = facts.world_from_ego(frame, cam) @ pose
    world[:3, 3] -= facts.origin_m
    return world


def constant_colour(part: RawPart, phase: float) -> np.ndarray:
    """The Fourier sum of a frame, [N, 3]."""
    total = np.zeros((len(part.xyz), 3))
    for k in range(part.dc.shape[1]):
        b = math.cos(math.pi * phase * k) if k % 2 == 0 else math.sin(math.pi * phase * (k + 1))
        total += b * part.dc[:, k]
    return total


def placed(part: RawPart, pose: np.ndarray, eye: np.ndarray, phase: float = 0.0) -> Gaussians:
    """Splats in the world in the one colour that the eye sees, directions in the world's axes."""
    means = part.xyz @ pose[:3, :3].T + pose[:3, 3]
    own = Rotation.from_quat(np.roll(part.rotation, -1, axis=1))
    quats = np.roll((Rotation.from_matrix(pose[:3, :3]) * own).as_quat(), 1, axis=1)
    to = means - eye
    x, y, z = (to / np.linalg.norm(to, axis=1, keepdims=True)).T[:, :, None]
    rgb = 0.5 + C0 * constant_colour(part, phase)
    rgb += C1 * (-y * part.rest[:, 0] + z * part.rest[:, 1] - x * part.rest[:, 2])
    return Gaussians(
        means=torch.tensor(means, dtype=torch.float32),
        quats=torch.tensor(quats, dtype=torch.float32),
        scales=torch.tensor(np.exp(part.scaling)),
        opacities=torch.tensor(1 / (1 + np.exp(-part.opacity[:, 0]))),
        sh=torch.tensor((np.maximum(rgb, 0) - 0.5) / C0, dtype=torch.float32)[:, None],
    )


def sky_at(faces: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Colours [P, 3] of directions [P, 3], and whether all four texels are of one face."""
    size = faces.shape[1]
    colours, inside = np.zeros((len(directions), 3)), np.zeros(len(directions), bool)
    for index, direction in enumerate(directions):
        axis = int(np.abs(direction).argmax())
        face = FACES.index((axis, 1 if direction[axis] > 0 else -1))
        s = SC[face][1] * direction[SC[face][0]] / abs(direction[axis])
        t = TC[face][1] * direction[TC[face][0]] / abs(direction[axis])
        column, row = (s + 1) / 2 * size - 0.5, (t + 1) / 2 * size - 0.5
        inside[index] = 0 <= column < size - 1 and 0 <= row < size - 1
        if inside[index]:
            c, r = int(column), int(row)
            fc, fr = column - c, row - r
            top = faces[face, r, c] * (1 - fc) + faces[face, r, c + 1] * fc
            low = faces[face, r + 1, c] * (1 - fc) + faces[face, r + 1, c + 1] * fc
            colours[index] = top * (1 - fr) + low * fr
    return colours, inside


def composed(
    facts: Facts, raw: RawModel, frame: int, cam: int, *, move: np.ndarray | None = None,
    affine: np.ndarray | None = None, white: bool = False,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """The picture float64 [H, W, 3], and where the sky is known without other faces' texels."""
    pose = world_from_camera(facts, frame, cam)
    width, height = facts.image_size(cam)
    fx, fy, cx, cy = facts.intrinsics(cam)
    view = Camera("test", width, height, fx, fy, cx, cy, torch.from_numpy(np.linalg.inv(pose)))
    parts = [placed(raw.background, np.eye(4) if move is None else move, pose[:3, 3])]
    for number, part in raw.actors.items():
        start, end = SPAN[number]
        if facts.time_s(start) - 0.1 <= facts.time_s(frame, cam) <= facts.time_s(end) + 0.1:
            phase = (frame - start) / (end - start)
            world = actor_pose(facts, raw, number, frame, cam)
            parts.append(placed(part, world, pose[:3, 3], phase))
    drawn = rasterize([PosedGaussians(part) for part in parts], view, backend="reference")
    u, v = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    rays = np.stack([(u - cx) / fx, (v - cy) / fy, np.ones_like(u)], -1) @ pose[:3, :3].T
    if raw.sky is None:
        sky, known = np.full((height, width, 3), float(white)), np.ones((height, width), bool)
    else:
        found = sky_at(raw.sky.clip(0, 1), rays.reshape(-1, 3))
        sky, known = found[0].reshape(height, width, 3), found[1].reshape(height, width)
    rgb = drawn.rgb.double().numpy() + (1 - drawn.alpha.double().numpy())[..., None] * sky
    if affine is not None:
        rgb = rgb @ affine[:, :3].T + affine[:, 3]
    return rgb, known


def assert_shows(scene: Scene, facts: Facts, raw: RawModel, frame: int, cam: int, **how) -> None:
    tolerance = how.pop("tolerance", 2e-4)
    name = ("FRONT", "FRONT_LEFT", "FRONT_RIGHT")[cam]
    rgb = render(scene, scene.frame(frame).cameras[name]).double().numpy()
    expected, known = composed(facts, raw, frame, cam, **how)
    assert known.mean() > 0.8 and expected.std() > 0.05
    rgb[~known] = expected[~known] = 0
    assert_images_close(rgb, expected, p999=tolerance, flip=10 * tolerance, max_flips=3)


# --- scenes ---


@pytest.mark.parametrize(("frame", "cam"), [(0, 0), (1, 2)])
def test_a_model_shows_what_its_numbers_say(tmp_path: Path, drive: Facts, frame, cam) -> None:
    raw = raw_model(drive)
    scene = opened(saved(tmp_path, drive, raw))
    assert not (drive.root / "images").exists()
    assert [actor.track_id for actor in scene.actors] == ["1", "4"]
    assert scene.problems and all("image" in problem for problem in scene.problems)
    assert_shows(scene, drive, raw, frame, cam)


def test_colours_and_poses_are_corrected(tmp_path: Path, drive: Facts) -> None:
    rng = np.random.default_rng(3)
    affine = np.eye(3, 4) + 0.1 * rng.normal(size=(12, 3, 4))
    # Turns of a milliradian: what directions of view lose by them stays below the tolerance.
    turns = np.concatenate([np.ones((12, 1)), 0.0005 * rng.normal(size=(12, 3))], 1) * 1.7
    moves = 0.1 * rng.normal(size=(12, 3))
    raw = raw_model(drive, affine=affine, moves=moves, turns=turns)
    config = {"model.use_color_correction": True, "model.use_pose_correction": True}
    scene = opened(saved(tmp_path, drive, raw, **config))
    for frame, cam in ((0, 1), (2, 0)):
        number = 3 * frame + cam
        move = np.eye(4)
        move[:3, :3] = Rotation.from_quat(np.roll(turns[number], -1)).as_matrix()
        move[:3, 3] = moves[number]
        how = {"move": move, "affine": affine[number]}
        assert_shows(scene, drive, raw, frame, cam, tolerance=2e-3, **how)
    front = torch.tensor(affine[[0, 3, 6, 9]].mean(0), dtype=torch.float32)
    torch.testing.assert_close(scene.color_maps["FRONT"], front)


def test_a_camera_has_one_map_in_all_its_images(tmp_path: Path, drive: Facts) -> None:
    affine = np.eye(3, 4) + 0.1 * np.random.default_rng(3).normal(size=(3, 3, 4))
    raw = raw_model(drive, affine=affine, sky=None)
    config = {
        "model.use_color_correction": True, "model.color_correction.mode": "sensor",
        "model.nsg.include_sky": False, "data.white_background": True,
    }  # fmt: skip
    scene = opened(saved(tmp_path, drive, raw, **config))
    assert scene.image_color_maps == {}
    assert isinstance(scene.sky, ConstantSky) and scene.sky.rgb.tolist() == [1, 1, 1]
    assert_shows(scene, drive, raw, 1, 2, affine=affine[2], white=True)


def test_weights_in_a_point_cloud_show_the_same_without_what_they_lack(
    tmp_path: Path, drive: Facts
) -> None:
    raw = raw_model(drive)
    model = saved(tmp_path, drive, raw)
    scene = opened(model, weights="ply")
    assert any("left out" in p and "learnt poses, the sky" in p for p in scene.problems)
    bare = dataclasses.replace(raw, opt_trans=None, opt_rots=None, sky=None)
    assert_shows(scene, drive, bare, 2, 0)
    file = model / "point_cloud" / "iteration_50000" / "point_cloud.ply"
    by_file = opened(file)
    assert torch.equal(by_file.background.means, scene.background.means)
    assert by_file.name == "run" and by_file.made_by["iteration"] == 50000


def test_what_a_scene_knows(tmp_path: Path, drive: Facts) -> None:
    model = saved(tmp_path, drive, raw_model(drive))
    scene = open_scene(str(model))
    assert detect_scheme(model) == "street_gaussians"
    assert (scene.name, scene.source) == ("run", f"street_gaussians:{model}")
    assert scene.recorded_source == f"street_gaussians:{drive.root}"
    assert scene.has_metric_scale and scene.ground is None and scene.ground_z_m is None
    np.testing.assert_allclose(scene.world_origin_m, drive.origin_m)
    assert scene.made_by["config"].endswith("config_000000.yaml")
    assert scene.camera_names == ("FRONT", "FRONT_LEFT", "FRONT_RIGHT")
    assert len(scene.boxes(1)) == 6
    labels = [street_gaussians_labels(str(path), {}) for path in (model, drive.root)]
    for found in labels:
        np.testing.assert_array_equal(found.boxes(1).centers_m, scene.boxes(1).centers_m)
    part = opened(model, frames="1:3")
    assert [frame.index for frame in part.frames] == [1, 2]
    assert torch.equal(part.actors[0].track.timestamps_ns, scene.actors[0].track.timestamps_ns)


def test_images_are_capped_as_the_project_renders_them(tmp_path: Path) -> None:
    facts = without_images(tmp_path / "seq", frames=3)
    raw = raw_model(facts)
    raw = dataclasses.replace(raw, actors={}, opt_trans=None, opt_rots=None)
    model = saved(tmp_path, facts, raw, **{"data.cameras": [0, 4]})
    views = {}
    for query in ({}, {"width": "0"}, {"width": "96"}):
        views[query.get("width")] = open_street_gaussians(str(model), query).frames[0].cameras
    sizes = {key: [(c.width, c.height) for c in found.values()] for key, found in views.items()}
    assert sizes == {
        None: [(1600, 1066), (1600, 738)],
        "0": [(1920, 1280), (1920, 886)],
        "96": [(96, 64), (96, 44)],
    }
    for name in ("fx", "fy", "cx", "cy"):
        whole, capped = (getattr(views[key]["FRONT"], name) for key in ("0", None))
        assert capped == pytest.approx(whole / 1.2)


def test_parts_and_tracks_that_do_not_belong_together_are_said(
    tmp_path: Path, drive: Facts
) -> None:
    raw = raw_model(drive)
    raw = dataclasses.replace(raw, actors={1: raw.actors[1], 99: raw.actors[4]})
    scene = opened(saved(tmp_path, drive, raw))
    assert [actor.track_id for actor in scene.actors] == ["1"]
    assert any("obj_004 of the tracks has no Gaussians" in p for p in scene.problems)
    assert any("obj_099 has no track" in p for p in scene.problems)


def test_of_several_iterations_the_newest_or_the_named(tmp_path: Path, drive: Facts) -> None:
    model = saved(tmp_path, drive, raw_model(drive))
    early = raw_model(drive, background=random_part(9, 11, high=(20, 5, 5)))
    saved(tmp_path, drive, early, how={"iteration": 7000, "is_final": False})
    assert len(opened(model).background) == 400
    assert len(opened(model, iteration="7000").background) == 11
    assert len(opened(model / "trained_model" / "iteration_7000.pth").background) == 11
    assert opened(model, iteration="7000", weights="ply").made_by["iteration"] == 7000
    with pytest.raises(AdapterError, match=r"no \.pth of iteration 8000; it has 7000, 50000"):
        opened(model, iteration="8000")
    shutil.rmtree(model / "trained_model")
    assert len(opened(model).actors) == 2
    with pytest.raises(AdapterError, match=r"holds no \.pth"):
        opened(model, weights="pth")


def test_where_the_data_are(tmp_path: Path, drive: Facts) -> None:
    model = saved(tmp_path, drive, raw_model(drive))
    config = model / "configs" / "config_000000.yaml"
    config.write_text(yaml.safe_dump(tree(drive, source_path="/elsewhere/002")))
    with pytest.raises(AdapterError, match=r"'/elsewhere/002' is not here.*data=DIR"):
        opened(model)
    scene = opened(model, data=str(drive.root))
    assert scene.recorded_source == f"street_gaussians:{drive.root}"
    assert street_gaussians_labels(str(model), {"data": str(drive.root)}) is not None
    with pytest.raises(AdapterError, match="no such folder"):
        opened(model, data=str(tmp_path / "none"))
    with pytest.raises(AdapterError, match=re.escape(str(model / "configs" / "nothing"))):
        opened(model, data=str(model / "configs" / "nothing"))
    shutil.rmtree(model / "configs")
    with pytest.raises(AdapterError, match=r"config_\*.yaml; which column"):
        opened(model, data=str(drive.root))


def test_wrong_options(tmp_path: Path, drive: Facts) -> None:
    model = saved(tmp_path, drive, raw_model(drive))
    for query, message in (
        ({"scale": "2"}, "unknown option 'scale'.*data: .*rotation_bug"),
        ({"iteration": "last"}, "iteration must be a whole number"),
        ({"width": "-5"}, "width must be a whole number of pixels"),
        ({"weights": "npz"}, "weights must be pth or ply.*got 'npz'"),
        ({"rotation_bug": "yes"}, "rotation_bug must be 0 or 1"),
        ({"frames": "5"}, "frames must be first:stop"),
        ({"frames": "50:60"}, "selects none of the 4 frames"),
    ):
        with pytest.raises(AdapterError, match=message):
            opened(model, **query)


def test_paths_that_are_no_model(tmp_path: Path, drive: Facts) -> None:
    with pytest.raises(AdapterError, match=r"expected trained_model/iteration_N\.pth"):
        opened(tmp_path)
    (tmp_path / "notes.txt").write_text("x")
    with pytest.raises(AdapterError, match=r"a model's folder, \.pth or \.ply"):
        opened(tmp_path / "notes.txt")
    model = saved(tmp_path, drive, raw_model(drive))
    with pytest.raises(AdapterError, match="is one file, so iteration= and weights="):
        opened(model / "trained_model" / "iteration_50000.pth", iteration="3")


FRAMES = 6
CAMERA = Camera("any", 64, 48, 50.0, 50.0, 32.0, 24.0, torch.eye(4, dtype=torch.float64))
TRAINED_CAMS = (0, 2)
DELAYS_S = {0: 0.013, 2: 0.031}
START_S = 1550083467.25


def heading_quat(angle: float) -> np.ndarray:
    return np.array([math.cos(angle / 2), 0, 0, math.sin(angle / 2)])


def ego(seconds: float) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("zyx", [0.3 * seconds, 0.02, -0.01]).as_matrix()
    pose[:3, 3] = [8 * seconds, -2 + seconds, 0.1]
    return pose


def image(step: int, number: int, cam: int, *, is_held_out: bool) -> StreetImage:
    time_s = START_S + 0.1 * step + DELAYS_S[cam]
    return StreetImage(
        frame=10 + step, cam=cam, path=None, timestamp_s=time_s,
        world_from_ego=ego(0.1 * step + DELAYS_S[cam]), camera=CAMERA, is_held_out=is_held_out,
        number=number,
    )  # fmt: skip


def street(held_out: tuple[int, ...] = ()) -> StreetData:
    """Objects 5, in frames 1 to 4 and in another column in each, and 8, in frame 2 only."""
    rng = np.random.default_rng(0)
    ids = np.full((FRAMES, 3), -1)
    for step, column in zip(range(1, 5), (2, 0, 1, 0), strict=True):
        ids[step, column] = 5
    ids[2, 1] = 8
    quats = np.zeros((FRAMES, 3, 4))
    quats[...] = [[heading_quat(a) for a in row] for row in rng.uniform(2.9, 3.3, (FRAMES, 3))]
    times = START_S + 0.1 * np.arange(FRAMES)
    steps = [(step, cam) for step in range(FRAMES) for cam in TRAINED_CAMS]
    return StreetData(
        root=Path("drive"),
        world_origin_m=np.zeros(3),
        frames=tuple(range(10, 10 + FRAMES)),
        frame_times_s=times,
        world_from_ego=np.stack([ego(0.1 * step) for step in range(FRAMES)]),
        images=tuple(
            image(step, number, cam, is_held_out=step in held_out)
            for number, (step, cam) in enumerate(steps)
        ),
        objects=(
            TrackedObject(
                5, "vehicle", (4.0, 2.0, 1.5), 11, 14, times[1] - 0.1, min(times[4] + 0.1, times[5])
            ),
            TrackedObject(8, "vehicle", (4.0, 2.0, 1.5), 12, 12, times[2] - 0.1, times[2] + 0.1),
        ),
        tracklets=Tracklets(ids, rng.normal(size=(FRAMES, 3, 3)) * 5, quats),
    )


def some_changes(seed: int = 1) -> PoseChanges:
    rng = np.random.default_rng(seed)
    return PoseChanges(0.3 * rng.normal(size=(FRAMES, 3, 3)), 0.2 * rng.normal(size=(FRAMES, 3)))


def scipy_rotation(wxyz: np.ndarray) -> Rotation:
    return Rotation.from_quat(np.roll(wxyz, -1))


def between(first: Rotation, second: Rotation, share: float) -> Rotation:
    """Along the arc from the first to the second, and beyond."""
    return first * Rotation.from_rotvec((first.inv() * second).as_rotvec() * share)


def expected_pose(
    data: StreetData, track_id: int, time: float, changes: PoseChanges | None, bug: bool = False
) -> tuple[np.ndarray, Rotation]:
    """One pose, step by step: frames by distance in time, earlier ones first where equal."""
    rows = [(f, m) for f in range(FRAMES) for m in range(3) if data.tracklets.ids[f, m] == track_id]
    rows.sort(key=lambda row: abs(data.frame_times_s[row[0]] - time))
    poses = []
    for f, m in rows[:2]:
        position = data.tracklets.positions[f, m].copy()
        rotation = scipy_rotation(data.tracklets.quats[f, m])
        if changes is not None:
            position += changes.positions[f, m]
            rotation = rotation * Rotation.from_euler("z", 2 * changes.half_turns[f, m])
        poses.append((position, rotation))
    if len(poses) == 1:
        return poses[0]
    (p1, r1), (p2, r2) = poses
    if bug:
        r2 = r1 * Rotation.from_euler("z", 2 * changes.half_turns[rows[0][0], rows[1][1]])
    t1, t2 = (data.frame_times_s[f] for f, _ in rows[:2])
    share = (time - t1) / (t2 - t1)
    return p1 * (t2 - time) / (t2 - t1) + p2 * (time - t1) / (t2 - t1), between(r1, r2, share)


def check(poses, index: int, expected: tuple[np.ndarray, Rotation]) -> None:
    # 1e-6 m and rad: seconds since 1970 have steps of 2.4e-7 s, and things move at 50 m/s here.
    np.testing.assert_allclose(poses.positions[index], expected[0], atol=1e-4)
    turn = scipy_rotation(poses.quats[index]).inv() * expected[1]
    assert turn.magnitude() < 1e-5


@pytest.mark.parametrize("bug", [False, True])
@pytest.mark.parametrize("changes", [None, some_changes()])
def test_between_and_beyond_frames(changes, bug) -> None:
    data = street()
    times = START_S + np.array([0.04, 0.11, 0.149, 0.2, 0.231, 0.38, 0.42, 0.47])
    for tracked in data.objects:
        poses = vehicle_poses(data, tracked, times, changes, rotation_bug=bug)
        for index, time in enumerate(times):
            used = bug and changes is not None
            check(poses, index, expected_pose(data, tracked.track_id, time, changes, used))


def test_images_that_were_not_trained_on() -> None:
    """Between the poses at the two nearest images of the camera that were, and not their own."""
    data, changes = street(held_out=(2, 4, 5)), some_changes()
    tracked = data.objects[0]
    index = np.arange(len(data.images))
    shown = index[[tracked.start_s <= i.timestamp_s <= tracked.end_s for i in data.images]]
    poses = image_poses(data, tracked, shown, changes, interpolate_held_out=True)
    # Steps that the camera was trained with within the object's time: 0, 1, 3.
    nearest = {2: {0: (1, 3), 2: (1, 3)}, 4: {0: (3, 1), 2: (3, 1)}}
    seen = 0
    for position, number in enumerate(shown):
        found = data.images[number]
        step = found.frame - 10
        if step not in nearest:
            check(poses, position, expected_pose(data, 5, found.timestamp_s, changes))
            continue
        seen += 1
        times = [START_S + 0.1 * s + DELAYS_S[found.cam] for s in nearest[step][found.cam]]
        (p1, r1), (p2, r2) = (expected_pose(data, 5, time, changes) for time in times)
        share = (found.timestamp_s - times[0]) / (times[1] - times[0])
        check(poses, position, (p1 + share * (p2 - p1), between(r1, r2, share)))
    assert seen == 4
    own = image_poses(data, tracked, shown, changes, interpolate_held_out=False)
    assert np.abs(own.positions - poses.positions).max() > 0.01


def test_without_two_trained_images_a_pose_is_the_images_own() -> None:
    data = street(held_out=(0, 1, 2, 3, 5))
    poses = image_poses(data, data.objects[0], np.array([2]), None, interpolate_held_out=True)
    check(poses, 0, expected_pose(data, 5, data.images[2].timestamp_s, None))


def part_of(terms: int, degree: int = 0) -> Part:
    raw = random_part(3, 7, terms=terms, degree=degree)
    gaussians = Gaussians(
        means=torch.from_numpy(raw.xyz),
        quats=torch.nn.functional.normalize(torch.from_numpy(raw.rotation)),
        scales=torch.from_numpy(raw.scaling).exp(),
        opacities=torch.from_numpy(raw.opacity[:, 0]).sigmoid(),
        sh=torch.from_numpy(np.concatenate([raw.dc[:, :1], raw.rest], 1)),
    )
    return Part(gaussians, torch.from_numpy(raw.dc[:, 1:].copy()) if terms > 1 else None)


PLAIN = ModelConfig(fourier_scale=2.0)
STILL = camera_changes(None, street(), PLAIN, "model")


def test_an_actor_is_where_and_when_its_images_are() -> None:
    data, changes = street(), some_changes()
    actor, problems = make_actor(data, data.objects[0], part_of(5), changes, STILL, PLAIN)
    assert actor is not None and problems == ()
    assert (actor.track_id, actor.label, actor.size_m) == ("5", "vehicle", (4.0, 2.0, 1.5))
    for found in data.images:
        pose = actor.track.pose_at(found.timestamp_ns)
        shown = data.objects[0].start_s <= found.timestamp_s <= data.objects[0].end_s
        assert (pose is not None) == shown, found
        if pose is None:
            continue
        position, rotation = expected_pose(data, 5, found.timestamp_s, changes)
        expected = np.eye(4)
        expected[:3, :3], expected[:3, 3] = rotation.as_matrix(), position
        np.testing.assert_allclose(pose, found.world_from_ego @ expected, atol=1e-4)
        phase = 2.0 * (found.frame - 11) / (14 - 11)
        assert actor.color_waves.phase_at(found.timestamp_ns) == pytest.approx(phase)
    assert {i.frame for i in data.images if i.timestamp_s > data.objects[0].end_s} == {15}


def test_the_background_is_moved_and_actors_stay() -> None:
    """The camera sees the moved background where it was, and the actor where it is."""
    data = street()
    rng = np.random.default_rng(5)
    moves = np.tile(np.eye(4), (len(data.images), 1, 1))
    moves[:, :3, :3] = Rotation.from_rotvec(0.05 * rng.normal(size=(len(moves), 3))).as_matrix()
    moves[:, :3, 3] = 0.2 * rng.normal(size=(len(moves), 3))
    config = ModelConfig(cameras=TRAINED_CAMS, use_pose_correction=True)
    changes = camera_changes(moves, data, config, "model")
    plain, _ = make_actor(data, data.objects[0], part_of(1), None, STILL, PLAIN)
    moved, _ = make_actor(data, data.objects[0], part_of(1), None, changes, PLAIN)
    assert plain.color_waves is None
    np.testing.assert_array_equal(changes, moves)
    for found in data.images[2:10]:
        change = moves[found.number]
        there = moved.track.pose_at(found.timestamp_ns).numpy()
        here = plain.track.pose_at(found.timestamp_ns).numpy()
        np.testing.assert_allclose(change @ there, here, atol=1e-12)
    by_frame = camera_changes(
        moves[:FRAMES], data, config.model_copy(update={"pose_correction_mode": "frame"}), "model"
    )
    np.testing.assert_array_equal(by_frame, moves[[i.frame - 10 for i in data.images]])


def test_an_object_of_one_frame_has_one_pose_and_colour() -> None:
    data = street()
    actor, problems = make_actor(data, data.objects[1], part_of(3), some_changes(), STILL, PLAIN)
    assert len(problems) == 1 and "tracked in one frame only" in problems[0]
    assert actor.color_waves.phases.tolist() == [0.0] * len(actor.track.timestamps_ns)
    shown = [i for i in data.images if actor.track.pose_at(i.timestamp_ns) is not None]
    assert {i.frame for i in shown} == {11, 12}


def test_an_object_between_images_is_left_out() -> None:
    data = street()
    tracked = dataclasses.replace(data.objects[0], start_s=START_S + 0.02, end_s=START_S + 0.03)
    actor, problems = make_actor(data, tracked, part_of(1), None, STILL, PLAIN)
    assert actor is None and "in none of the images' moments" in problems[0]


def test_images_of_one_moment_are_said() -> None:
    data = street()
    first, second = data.images[2], data.images[3]
    twin = dataclasses.replace(second, timestamp_s=first.timestamp_s)
    data = dataclasses.replace(data, images=(*data.images[:3], twin, *data.images[4:]))
    actor, problems = make_actor(data, data.objects[0], part_of(1, degree=1), None, STILL, PLAIN)
    assert any("apart in images of one moment" in problem for problem in problems)
    assert actor.colors_in_world
    assert bool((actor.track.timestamps_ns.diff() > 0).all())


def test_poses_of_another_selection_are_refused() -> None:
    data = street()
    check_changes(some_changes(), data, "model.pth")
    for shape in ((FRAMES + 2, 3), (FRAMES, 4)):
        other = PoseChanges(np.zeros((*shape, 3)), np.zeros(shape))
        words = (
            rf"model.pth: actor_pose has {shape[0]} frames and {shape[1]} columns.*give {FRAMES} "
            r"frames and 3 columns.*selected_frames.*data.cameras and data.use_tracker"
        )
        with pytest.raises(AdapterError, match=words):
            check_changes(other, data, "model.pth")


def test_colour_maps_of_images_and_cameras() -> None:
    data = street(held_out=(2, 4))
    maps = torch.randn(12, 3, 4, generator=torch.Generator().manual_seed(0))
    config = ModelConfig(cameras=TRAINED_CAMS, use_color_correction=True)
    by_camera, by_image = color_maps(maps, data, config, "model")
    for number, step_cam in enumerate((s, c) for s in range(FRAMES) for c in TRAINED_CAMS):
        seen = next(i for i in data.images if (i.frame - 10, i.cam) == step_cam)
        assert torch.equal(by_image[seen.name, seen.timestamp_ns], maps[number])
    right = maps[[1, 3, 7, 11]].mean(0)  # trained on: frames 0, 1, 3, 5
    torch.testing.assert_close(by_camera["FRONT_RIGHT"], right)
    sensor = config.model_copy(update={"color_correction_mode": "sensor", "cameras": (0, 1, 2)})
    by_camera, by_image = color_maps(maps[:3], data, sensor, "model")
    assert torch.equal(by_camera["FRONT_RIGHT"], maps[2]) and not by_image
    with pytest.raises(AdapterError, match=r"maps of cameras 0 to 1.*cameras has"):
        color_maps(maps[:2], data, sensor.model_copy(update={"cameras": TRAINED_CAMS}), "model")


@pytest.mark.parametrize("mode", ["image", "frame"])
def test_corrections_of_another_selection_are_refused(mode: str) -> None:
    data = street()
    config = ModelConfig(cameras=TRAINED_CAMS, pose_correction_mode=mode)
    with pytest.raises(AdapterError, match=rf"pose_correction has 5 entries.*mode '{mode}'"):
        camera_changes(np.tile(np.eye(4), (5, 1, 1)), data, config, "model.pth")
    with pytest.raises(AdapterError, match=r"color_correction has 11 entries.*must have 12"):
        color_maps(torch.zeros(11, 3, 4), data, config, "model.pth")
