"""Models as trained on a street whose picture is known: the street's own Gaussians in the files of
Street Gaussians and drivestudio, and its pictures by other code than the project's.

The street is the procedural one. Here it gets colours by direction and over time, a sky given by a
formula, a car that drives a bend on a slope, and objects that move in that car's frame in straight
lines and turn evenly, so that what lies between two frames, and beyond them, is exact.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import torch
import yaml
from scipy.spatial.transform import Rotation
from street_gaussians_models import RawModel, RawPart, config_tree, write_model

from augment.cameras import Camera
from augment.render.rasterize import rasterize
from augment.scene import Gaussians, PosedGaussians, Scene

C0, C1 = 0.28209479177387814, 0.4886025119029199
NAMES = ("FRONT", "FRONT_LEFT", "FRONT_RIGHT", "SIDE_LEFT", "SIDE_RIGHT")
WAYMO_NAMES = ("front_camera", "front_left_camera", "front_right_camera", "left_camera")
YAWS = (0.0, 0.8, -0.8, 1.5)
DELAYS_S = (0.021, -0.015, 0.029, 0.007)
FRAMES, SELECTED = range(8), range(1, 7)
START_S, STEP_S = 1_550_083_467.346, 0.1
ORIGIN_M = np.array([-2312.25, 5120.5, 41.75])  # of the street in the dataset's world
# Columns: camera x right, y down, z forward, in axes x forward, y left, z up.
FORWARD = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
TERMS = 5

Sky = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True)
class Splats:
    """xyz, sizes [N, 3] metres; turns: N rotations; opacity [N]; dc [N, F, 3] the colours' Fourier
    terms; rest [N, 3, 3] spherical harmonics of degree 1, for directions of the model's world.
    """

    xyz: np.ndarray
    turns: Rotation
    sizes: np.ndarray
    opacity: np.ndarray
    dc: np.ndarray
    rest: np.ndarray

    def moved(self, pose: np.ndarray) -> Splats:
        """Carried along, but for what they show from where."""
        xyz = self.xyz @ pose[:3, :3].T + pose[:3, 3]
        return replace(self, xyz=xyz, turns=Rotation.from_matrix(pose[:3, :3]) * self.turns)


@dataclass(frozen=True)
class Mover:
    """An object in the car's frame, seconds from frame 0: place start_m + t * speed_mps, heading
    angle + t * rate. frames: in which it is tracked."""

    label: str
    size_m: tuple[float, float, float]
    splats: Splats
    start_m: np.ndarray
    speed_mps: np.ndarray
    angle: float
    rate: float
    frames: range = SELECTED

    def pose(self, seconds: float) -> np.ndarray:
        angle = self.angle + self.rate * seconds
        return about_z(angle, self.start_m + seconds * self.speed_mps)

    def phase(self, frame: int) -> float:
        return (frame - self.frames[0]) / (self.frames[-1] - self.frames[0])


@dataclass(frozen=True)
class Street:
    """standing: pose and size of objects that stand, street. width: of images, pixels. vivid: how
    far colours depend on direction, time and image."""

    background: Splats
    movers: Mapping[int, Mover]
    standing: tuple[tuple[np.ndarray, tuple[float, float, float]], ...]
    sky: Sky
    width: int
    vivid: float

    def size(self, cam: int) -> tuple[int, int]:
        rows = 866 if cam >= 3 else 1280
        return self.width, int(rows / (1920 / self.width))


def about_z(angle: float, place) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("z", angle).as_matrix()
    pose[:3, 3] = place
    return pose


def ego(seconds: float) -> np.ndarray:
    """The car in the street, from frame 0 on."""
    x = 9 * seconds
    pose = about_z(0.2 - 0.6 * seconds, (x, -1.7 + 0.02 * x * x, 0.01 * x))
    pose[:3, :3] = pose[:3, :3] @ Rotation.from_euler("yx", [0.01 + 0.003 * x, 0.02]).as_matrix()
    return pose


def ego_from_camera(cam: int) -> np.ndarray:
    return about_z(YAWS[cam], (1.2, (0.0, 0.2, -0.2, 0.4)[cam], 1.9)) @ rigid(FORWARD)


def rigid(rotation: np.ndarray) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3] = rotation
    return pose


def evening(directions: np.ndarray) -> np.ndarray:
    """A smooth sky that differs in all directions: blue above, redder towards +x, greener to +y."""
    x, y, z = (directions / np.linalg.norm(directions, axis=-1, keepdims=True)).T
    return np.stack([0.5 + 0.25 * x - 0.1 * z, 0.5 + 0.2 * y, 0.55 + 0.4 * z], -1)


def street_of(scene: Scene, *, width: int = 160, sky: Sky = evening, vivid: float = 1.0) -> Street:
    rng = np.random.default_rng(11)
    ground = [0.0, 0.0, -ego(0)[2, 3]]

    def mover(index: int, label: str, start, speed, angle, rate, frames=SELECTED) -> Mover:
        actor = scene.actors[index % len(scene.actors)]
        up = float(actor.track.world_from_actor[0, 2, 3])
        return Mover(
            label, actor.size_m, _coloured(actor.gaussians, rng, TERMS, vivid),
            np.array([*start, up]) + ground, np.array([*speed, 0.0]), angle, rate, frames,
        )  # fmt: skip

    movers = {
        3: mover(0, "vehicle", (12, -3), (4, 2), -0.1, 0.1),
        7: mover(1, "vehicle", (18, 1), (-15, 2), 3.5, -2.9),
        12: mover(-1, "cyclist", (8, -4.5), (6, 1), 0.4, 0.3, range(1, 4)),
    }
    boxes = scene.boxes(scene.frames[0].index)
    standing = tuple(
        (about_z(Rotation.from_quat(np.roll(quat, -1)).as_euler("zyx")[0], place), tuple(size))
        for name, quat, place, size in zip(
            boxes.track_ids, boxes.quats, boxes.centers_m, boxes.sizes_m, strict=True
        )
        if name.startswith("parked")
    )
    return Street(_coloured(scene.background, rng, 1, vivid), movers, standing, sky, width, vivid)


def _coloured(gaussians: Gaussians, rng, terms: int, vivid: float) -> Splats:
    count = len(gaussians)
    dc = vivid * 0.3 * rng.normal(size=(1, terms, 3)) * rng.uniform(0.5, 1, (count, terms, 1))
    dc[:, 0] = gaussians.sh[:, 0].numpy()
    return Splats(
        xyz=gaussians.means.double().numpy(),
        turns=Rotation.from_quat(np.roll(gaussians.quats.numpy(), -1, axis=1)),
        sizes=gaussians.scales.double().numpy(),
        opacity=gaussians.opacities.double().numpy().clip(1e-4, 1 - 1e-4),
        dc=dc,
        rest=vivid * 0.12 * rng.normal(size=(1, 3, 3)) * rng.uniform(0.5, 1, (count, 1, 1)),
    )


# --- pictures ---


@dataclass(frozen=True)
class Shot:
    """What an image is taken with. world_from_camera, poses: of the movers, in one world; world:
    that of the street. phases: of the movers' colours. affine [3, 4]: of the image's colours."""

    world_from_street: np.ndarray
    world_from_camera: np.ndarray
    poses: Mapping[int, np.ndarray]
    phases: Mapping[int, float]
    affine: np.ndarray | None = None


def picture(street: Street, shot: Shot, cam: int) -> np.ndarray:
    """uint8 [H, W, 3]."""
    width, height = street.size(cam)
    fx, fy, cx, cy = intrinsics(street, cam)
    pose = shot.world_from_camera
    camera = Camera("test", width, height, fx, fy, cx, cy, torch.from_numpy(np.linalg.inv(pose)))
    parts = [_seen(street.background.moved(shot.world_from_street), pose[:3, 3], 0.0)]
    for number, placed in shot.poses.items():
        splats = street.movers[number].splats.moved(placed)
        parts.append(_seen(splats, pose[:3, 3], shot.phases[number]))
    drawn = rasterize([PosedGaussians(part) for part in parts], camera)
    u, v = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    rays = np.stack([(u - cx) / fx, (v - cy) / fy, np.ones_like(u)], -1) @ pose[:3, :3].T
    sky = street.sky(rays.reshape(-1, 3)).reshape(height, width, 3).clip(0, 1)
    rgb = drawn.rgb.double().numpy() + (1 - drawn.alpha.double().numpy())[..., None] * sky
    if shot.affine is not None:
        rgb = rgb @ shot.affine[:, :3].T + shot.affine[:, 3]
    return np.round(rgb.clip(0, 1) * 255).astype(np.uint8)


def _seen(splats: Splats, eye: np.ndarray, phase: float) -> Gaussians:
    """In the one colour that the eye sees."""
    to = splats.xyz - eye
    x, y, z = (to / np.linalg.norm(to, axis=1, keepdims=True)).T[:, :, None]
    rgb = 0.5 + C0 * constant(splats.dc, phase)
    rgb = rgb + C1 * (-y * splats.rest[:, 0] + z * splats.rest[:, 1] - x * splats.rest[:, 2])
    return Gaussians(
        means=tensor(splats.xyz),
        quats=tensor(np.roll(splats.turns.as_quat(), 1, axis=1)),
        scales=tensor(splats.sizes),
        opacities=tensor(splats.opacity),
        sh=tensor((np.maximum(rgb, 0) - 0.5) / C0)[:, None],
    )


def constant(dc: np.ndarray, phase: float) -> np.ndarray:
    """1, sin 2 pi t, cos 2 pi t, sin 4 pi t, cos 4 pi t of [N, F, 3]."""
    turn = 2 * math.pi * phase
    waves = [1.0, math.sin(turn), math.cos(turn), math.sin(2 * turn), math.cos(2 * turn)]
    return np.einsum("nfc,f->nc", dc, waves[: dc.shape[1]])


def tensor(values: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(np.asarray(values, np.float32).copy())


def intrinsics(street: Street, cam: int) -> tuple[float, float, float, float]:
    width, height = street.size(cam)
    return 0.75 * width, 0.75 * width, width / 2 + 0.75, height / 2 - 0.5


def cube(sky: Sky, size: int) -> np.ndarray:
    """Faces [6, R, R, 3], by the table of cube map faces in OpenGL 4.6, section 8.13."""
    ticks = 2 * (np.arange(size) + 0.5) / size - 1
    t, s = np.meshgrid(ticks, ticks, indexing="ij")
    one = np.ones_like(s)
    faces = [
        (one, -t, -s), (-one, -t, s), (s, one, t), (s, -one, -t), (s, -t, one), (-s, -t, -one),
    ]  # fmt: skip
    flat = np.stack([np.stack(face, -1) for face in faces]).reshape(-1, 3)
    return sky(flat).reshape(6, size, size, 3)


# --- Street Gaussians ---


@dataclass(frozen=True)
class StreetGaussiansRun:
    """affine [n, 3, 4]: of the images, by frame, then camera. opened_from_street [4, 4]."""

    model: Path
    data: Path
    street: Street
    cams: tuple[int, ...]
    affine: np.ndarray
    opened_from_street: np.ndarray
    changes: Mapping[tuple[int, int], tuple[np.ndarray, float]]

    def shot(self, frame: int, cam: int, *, corrected: bool = True) -> Shot:
        """corrected: with what only the .pth holds, else with what the track file says."""
        seconds = frame * STEP_S + DELAYS_S[cam]
        car = self.opened_from_street @ ego(seconds)
        shown = {
            number: mover
            for number, mover in self.street.movers.items()
            if mover.frames[0] - 1 <= seconds / STEP_S <= mover.frames[-1] + 1
        }
        position = (frame - SELECTED[0]) * len(self.cams) + self.cams.index(cam)
        return Shot(
            self.opened_from_street,
            car @ ego_from_camera(cam),
            {n: car @ self.pose(n, seconds, corrected) for n in shown},
            {n: mover.phase(frame) for n, mover in shown.items()},
            self.affine[position] if corrected else None,
        )

    def pose(self, number: int, seconds: float, corrected: bool) -> np.ndarray:
        mover = self.street.movers[number]
        if corrected:
            return mover.pose(seconds)
        frames = sorted(mover.frames, key=lambda f: abs(f * STEP_S - seconds))[:2]
        share = (seconds / STEP_S - frames[0]) / (frames[1] - frames[0])
        (place, angle), (place2, angle2) = (self.labelled(number, f) for f in frames)
        return about_z(angle + share * (angle2 - angle), place + share * (place2 - place))

    def labelled(self, number: int, frame: int) -> tuple[np.ndarray, float]:
        """Place and heading in the track file, the car's frame."""
        mover, (shift, half_turn) = self.street.movers[number], self.changes[number, frame]
        place = mover.start_m + frame * STEP_S * mover.speed_mps - shift
        return place, mover.angle + mover.rate * frame * STEP_S - 2 * half_turn


def write_street_gaussians(
    root: Path, street: Street, *, cams: tuple[int, ...] = (0, 1, 2, 3), sky_size: int = 64
) -> StreetGaussiansRun:
    rng = np.random.default_rng(5)
    data, centre = root / "data", np.mean([ego(f * STEP_S)[:3, 3] for f in FRAMES], axis=0)
    opened_from_street = np.eye(4)
    opened_from_street[:3, 3] = -centre
    changes = {
        (number, frame): (0.3 * rng.normal(size=3), 0.1 * rng.normal())
        for number, mover in street.movers.items()
        for frame in mover.frames
    }
    affine = np.eye(3, 4) + 0.06 * street.vivid * rng.normal(size=(len(SELECTED) * len(cams), 3, 4))
    run = StreetGaussiansRun(
        root / "model", data, street, cams, affine, opened_from_street, changes
    )
    _write_drive(run)
    columns = _write_tracks(run, rng)
    shifts, half_turns = np.zeros((len(SELECTED), 3, 3)), np.zeros((len(SELECTED), 3, 1))
    for (number, frame), column in columns.items():
        row = frame - SELECTED[0]
        shifts[row, column], half_turns[row, column, 0] = changes[number, frame]
    raw = RawModel(
        background=_raw(street.background.moved(opened_from_street), rng),
        actors={number: _raw(mover.splats, rng) for number, mover in street.movers.items()},
        opt_trans=shifts,
        opt_rots=half_turns,
        sky=cube(street.sky, sky_size),
        affine=affine,
    )
    config = {
        "source_path": str(data), "data.cameras": list(cams),
        "data.selected_frames": [SELECTED[0], SELECTED[-1]], "model.use_color_correction": True,
    }  # fmt: skip
    write_model(run.model, raw, config_tree(**config))
    return run


def _raw(splats: Splats, rng) -> RawPart:
    quats = np.roll(splats.turns.as_quat(), 1, axis=1) * rng.uniform(0.5, 3, (len(splats.xyz), 1))
    parts = (splats.xyz, splats.dc, splats.rest, np.log(splats.sizes), quats, _logit(splats))
    return RawPart(*(np.asarray(part, np.float32) for part in parts))


def _logit(splats: Splats) -> np.ndarray:
    return np.log(splats.opacity / (1 - splats.opacity))[:, None]


def _write_drive(run: StreetGaussiansRun) -> None:
    for folder in ("images", "ego_pose", "extrinsics", "intrinsics", "track"):
        (run.data / folder).mkdir(parents=True)
    times: dict[str, dict[str, float]] = {"FRAME": {}, **{NAMES[cam]: {} for cam in run.cams}}
    dataset_from_street = np.eye(4)
    dataset_from_street[:3, 3] = ORIGIN_M
    for cam in run.cams:
        np.savetxt(run.data / "extrinsics" / f"{cam}.txt", ego_from_camera(cam))
        values = [*intrinsics(run.street, cam), *[0.0] * 5]
        np.savetxt(run.data / "intrinsics" / f"{cam}.txt", values)
    for frame in FRAMES:
        name, seconds = f"{frame:06d}", frame * STEP_S
        np.savetxt(run.data / "ego_pose" / f"{name}.txt", dataset_from_street @ ego(seconds))
        times["FRAME"][name] = START_S + seconds
        for cam in run.cams:
            moment = seconds + DELAYS_S[cam]
            file = run.data / "ego_pose" / f"{name}_{cam}.txt"
            np.savetxt(file, dataset_from_street @ ego(moment))
            times[NAMES[cam]][name] = START_S + moment
            if frame in SELECTED:
                _write_grey(run.data / "images" / f"{name}_{cam}.png", run.street.size(cam))
    (run.data / "timestamps.json").write_text(json.dumps(times))


def _write_grey(path: Path, size: tuple[int, int]) -> None:
    rgb = np.full((size[1], size[0], 3), 128, np.uint8)
    path.write_bytes(cv2.imencode(path.suffix, rgb)[1].tobytes())


def _write_tracks(run: StreetGaussiansRun, rng) -> dict[tuple[int, int], int]:
    """The track file, each frame's objects in an order of its own, and which column each moving one
    gets in each selected frame: what stands, is a sign or in no camera's view has none."""
    header = (
        "frame_id track_id object_class alpha box_height box_width box_length box_center_x "
        "box_center_y box_center_z box_heading speed\n"
    )
    rows, visible = [header], {}
    columns: dict[tuple[int, int], int] = {}
    for frame in FRAMES:
        found = {
            number: (mover.label, mover.size_m, *run.labelled(number, frame))
            for number, mover in run.street.movers.items()
            if (number, frame) in run.changes
        }
        for number, (pose, size) in enumerate(run.street.standing, start=30):
            local = np.linalg.inv(ego(frame * STEP_S)) @ pose
            angle = math.atan2(local[1, 0], local[0, 0])
            found[number] = ("vehicle", size, local[:3, 3], angle)
        found[20] = ("vehicle", (4.0, 1.8, 1.5), np.array([-9.0 + 2 * frame, -6, 0.8]), 0.0)
        found[21] = ("sign", (0.3, 0.5, 0.9), np.array([9.0 + 2 * frame, 6, 2.2]), 0.0)
        used = 0
        for number in rng.permutation(list(found)).tolist():
            label, (length, width, height), (x, y, z), angle = found[number]
            words = [
                frame, number, label, -10, height, width, length, x, y, z, angle, 1.0,
            ]  # fmt: skip
            rows.append(" ".join(map(str, words)) + " \n")
            visible.setdefault(str(number), {})[str(frame)] = [4] if number == 20 else [0, 1]
            if number in run.street.movers:
                columns[number, frame] = used
                used += 1
    (run.data / "track" / "track_info.txt").write_text("".join(rows))
    (run.data / "track" / "track_camera_vis.json").write_text(json.dumps(visible))
    return columns


# --- drivestudio ---


@dataclass(frozen=True)
class DrivestudioRun:
    """affine [n, 3, 4] and shifts [n, 3], of cameras in their own axes: by frame, then camera."""

    folder: Path
    data: Path
    street: Street
    cams: tuple[int, ...]
    affine: np.ndarray
    shifts: np.ndarray

    def shot(self, frame: int, cam: int) -> Shot:
        seconds = frame * STEP_S
        model_from_street = np.linalg.inv(ego(SELECTED[0] * STEP_S))
        car = model_from_street @ ego(seconds)
        image = (frame - SELECTED[0]) * len(self.cams) + self.cams.index(cam)
        shift = np.eye(4)
        shift[:3, 3] = self.shifts[image]
        shown = [n for n, mover in self.street.movers.items() if frame in mover.frames]
        return Shot(
            model_from_street,
            car @ ego_from_camera(cam) @ shift,
            {n: car @ self.street.movers[n].pose(seconds) for n in shown},
            dict.fromkeys(shown, 0.0),
            self.affine[image],
        )


def write_drivestudio(
    root: Path, street: Street, *, cams: tuple[int, ...] = (0, 1, 2, 3), sky_size: int = 64
) -> DrivestudioRun:
    """Splats have the first of their colours' terms only."""
    rng = np.random.default_rng(6)
    steady = {
        number: replace(mover, splats=replace(mover.splats, dc=mover.splats.dc[:, :1]))
        for number, mover in street.movers.items()
    }
    street, images = replace(street, movers=steady), len(SELECTED) * len(cams)
    affine, network = _affine(rng, images, street.vivid)
    shifts = 0.1 * rng.normal(size=(images, 3))
    run = DrivestudioRun(root / "run", root / "data" / "005", street, cams, affine, shifts)
    _write_processed(run)
    model_from_street = np.linalg.inv(ego(SELECTED[0] * STEP_S))
    models = {
        "Background": _nodes(street.background.moved(model_from_street), rng),
        "RigidNodes": _rigid_nodes(run, rng),
        # The sky's base is looked up at (x, z, -y) of a direction.
        "Sky": {"base": tensor(cube(lambda d: street.sky(d @ LOOKED_UP), sky_size))},
        "Affine": network,
        "CamPose": {"embeds.weight": tensor(np.hstack([shifts, np.zeros((images, 6))]))},
    }
    run.folder.mkdir()
    torch.save({"models": models, "step": 30000}, run.folder / "checkpoint_final.pth")
    config = {
        "trainer": {"gaussian_ctrl_general_cfg": {"sh_degree_interval": 1000}},
        "data": {
            "data_root": str(root / "data"), "dataset": "waymo", "scene_idx": 5,
            "start_timestep": SELECTED[0], "end_timestep": SELECTED[-1],
            "pixel_source": {
                "cameras": list(cams), "test_image_stride": 0,
                "downscale_when_loading": [1920 / street.width] * len(cams),
            },
        },
    }  # fmt: skip
    (run.folder / "config.yaml").write_text(yaml.safe_dump(config))
    return run


# (x, z, -y) = direction @ LOOKED_UP.T, so that direction = (x, z, -y) @ LOOKED_UP.
LOOKED_UP = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])


def _affine(rng, images: int, vivid: float) -> tuple[np.ndarray, dict]:
    """Colour maps and the network that gives them: its hidden numbers are the embedding's."""
    embedding = np.abs(rng.normal(size=(images, 4)))
    output = 0.03 * vivid * rng.normal(size=(12, 4))
    maps = np.eye(3, 4) + (embedding @ output.T).reshape(-1, 3, 4)
    network = {
        "embedding.weight": tensor(embedding),
        "decoder.0.weight": tensor(np.eye(4)), "decoder.0.bias": tensor(np.zeros(4)),
        "decoder.2.weight": tensor(output), "decoder.2.bias": tensor(np.zeros(12)),
    }  # fmt: skip
    return maps, network


def _nodes(splats: Splats, rng) -> dict:
    raw = _raw(splats, rng)
    return {
        "_means": tensor(raw.xyz), "_scales": tensor(raw.scaling), "_quats": tensor(raw.rotation),
        "_opacities": tensor(raw.opacity), "_features_dc": tensor(raw.dc[:, 0]),
        "_features_rest": tensor(raw.rest),
    }  # fmt: skip


def _rigid_nodes(run: DrivestudioRun, rng) -> dict:
    movers = run.street.movers
    parts = [_nodes(mover.splats, rng) for mover in movers.values()]
    nodes = {key: torch.cat([part[key] for part in parts]) for key in parts[0]}
    owners = np.repeat(np.arange(len(parts)), [len(part["_means"]) for part in parts])
    nodes["points_ids"] = torch.from_numpy(owners)[:, None]
    places, quats = np.zeros((len(SELECTED), 3, 3)), np.ones((len(SELECTED), 3, 4))
    visible = np.zeros((len(SELECTED), 3), bool)
    for row, frame in enumerate(SELECTED):
        poses = run.shot(frame, 0).poses
        for index, number in enumerate(movers):
            if number in poses:
                visible[row, index] = True
                places[row, index] = poses[number][:3, 3]
                turn = Rotation.from_matrix(poses[number][:3, :3])
                quats[row, index] = 1.7 * np.roll(turn.as_quat(), 1)
    nodes["instances_trans"], nodes["instances_quats"] = tensor(places), tensor(quats)
    nodes["instances_fv"] = torch.from_numpy(visible)
    nodes["instances_size"] = tensor(np.array([mover.size_m for mover in movers.values()]))
    return nodes


def _write_processed(run: DrivestudioRun) -> None:
    for folder in ("images", "ego_pose", "extrinsics", "intrinsics", "instances"):
        (run.data / folder).mkdir(parents=True)
    dataset_from_street = np.eye(4)
    dataset_from_street[:3, 3] = ORIGIN_M
    for cam in run.cams:
        # Waymo's own camera axes: x forward, y left, z up.
        pose = ego_from_camera(cam) @ rigid(FORWARD.T)
        np.savetxt(run.data / "extrinsics" / f"{cam}.txt", pose)
        scale = 1920 / run.street.width
        height = 866 if cam >= 3 else 1280
        fx, fy, cx, cy = intrinsics(run.street, cam)
        rows = height / run.street.size(cam)[1]
        values = [fx * scale, fy * rows, cx * scale, cy * rows, *[0.0] * 5]
        np.savetxt(run.data / "intrinsics" / f"{cam}.txt", values)
    info: dict[str, dict] = {}
    for key, (number, mover) in enumerate(run.street.movers.items()):
        poses = [dataset_from_street @ ego(f * STEP_S) @ mover.pose(f * STEP_S)
                 for f in mover.frames]  # fmt: skip
        info[str(key)] = {
            "id": f"waymo-{number}", "class_name": mover.label.capitalize(),
            "frame_annotations": {
                "frame_idx": list(mover.frames), "obj_to_world": [p.tolist() for p in poses],
                "box_size": [list(mover.size_m)] * len(poses),
            },
        }  # fmt: skip
    (run.data / "instances" / "instances_info.json").write_text(json.dumps(info))
    for frame in FRAMES:
        pose = dataset_from_street @ ego(frame * STEP_S)
        np.savetxt(run.data / "ego_pose" / f"{frame:03d}.txt", pose)
