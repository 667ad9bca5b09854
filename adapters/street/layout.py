"""Where things stand: the street's plan, drawn from the seed. x runs along it, y to the left.

Each kind of thing draws from its own stream, so that one more car moves no tree.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from pydantic import BaseModel, ConfigDict, Field

from adapters.camera_files.camera_files import validate
from adapters.uri import check_query
from adapters.world import invert_pose
from augment.cameras import Camera, Frame
from augment.scene import Track


class StreetParameters(BaseModel):
    """What a URI may ask for, all that decides a street: equal parameters give equal bits."""

    model_config = ConfigDict(frozen=True)

    seed: int = Field(0, ge=0, le=2**31 - 1, description="layout, colours, sky")
    frames: int = Field(20, ge=1, le=300, description="how many, at 10 Hz")
    width: int = Field(960, ge=16, le=4096, description="of every camera's image, pixels")
    height: int = Field(540, ge=16, le=4096, description="of every camera's image, pixels")
    speed_mps: float = Field(8.0, ge=0, le=20, description="of the ego car")
    gaussians: int = Field(
        290_000,
        ge=60_000,
        le=4_000_000,
        description="how many to aim for, actors included (met within a few per cent)",
    )
    parked: int = Field(12, ge=0, le=40, description="cars beside the road")
    moving: int = Field(3, ge=0, le=6, description="cars on the road")
    pedestrians: int = Field(2, ge=0, le=6, description="how many")
    lidar_columns: int = Field(1024, ge=16, le=4096, description="rays per turn")
    lidar_rings: int = Field(64, ge=2, le=256, description="rays per column")

    @property
    def name(self) -> str:
        return f"street-seed{self.seed}"

    @property
    def path_length_m(self) -> float:
        """How far the ego car drives."""
        return self.speed_mps * (self.frames - 1) * FRAME_NS * 1e-9

    @property
    def uri(self) -> str:
        """Canonical: the seed, then whatever differs from its default, in the order above."""
        changed = self.model_dump(exclude_defaults=True) | {"seed": self.seed}
        shown = [f"{key}={changed[key]}" for key in StreetParameters.model_fields if key in changed]
        return "procedural:street?" + "&".join(shown)


def parse_parameters(query: Mapping[str, str]) -> StreetParameters:
    """Parameters of a URI's query."""
    known = {key: str(field.description) for key, field in StreetParameters.model_fields.items()}
    check_query("procedural:street", query, known)
    return validate(StreetParameters, dict(query), "procedural:street", "query")


FRAME_NS = 100_000_000
START_NS = 1_700_000_000_000_000_000
LANE_M = 3.4
ROAD_HALF_M = 5.6  # a driving lane and a parking lane
KERB_TOP_M = 0.15  # the kerb stone's width
FACADE_M = 9.4
CAMBER = 0.02
KERB_RISE_M = 0.13
PAVEMENT_SLOPE = 0.012
EGO_Y_M = -1.7
PARKED_Y_M = 4.52
TREE_Y_M = 6.75
CROSS_STREET_M = 10.0  # width of the streets that end ours
TERRAIN_REACH_M = 230.0
TERRAIN_Z_M = 0.03


class Mover(NamedTuple):
    """Something that goes straight along x at a steady speed (negative: towards -x)."""

    name: str  # car-0, pedestrian-1
    x_m: float  # at the first frame
    y_m: float
    speed_mps: float
    seed: int


@dataclass(frozen=True)
class Layout:
    """The plan. x0, x1: where the street's carriageway begins and ends, metres. plots: where each
    building or garden begins and ends, its side (+1 left, -1 right), seed, and whether it is a
    garden."""

    parameters: StreetParameters
    x0: float
    x1: float
    zebra_x: float
    plots: list[tuple[float, float, int, int, bool]]
    trees: np.ndarray  # [T, 2]
    lamps: np.ndarray  # [L, 2]
    signs: np.ndarray  # [S, 2]
    parked: np.ndarray  # [C, 2]
    movers: list[Mover]


def road_z(y: np.ndarray | float) -> np.ndarray | float:
    """Height of the carriageway: 0 at its crown, falling to both kerbs."""
    return -CAMBER * np.abs(y)


def pavement_z(y: np.ndarray | float) -> np.ndarray | float:
    """Height of the pavements, from kerb to wall."""
    kerb = -CAMBER * ROAD_HALF_M + KERB_RISE_M
    return kerb + PAVEMENT_SLOPE * (np.abs(y) - ROAD_HALF_M)


def stream(parameters: StreetParameters, *key: int) -> np.random.Generator:
    """Random numbers of one kind of thing."""
    return np.random.default_rng([parameters.seed, *key])


def draw_layout(parameters: StreetParameters) -> Layout:
    """The plan of a street."""
    length = parameters.path_length_m
    x0, x1, zebra_x = -62.0, length + 86.0, length + 15.0
    y = ROAD_HALF_M + 0.55
    rows = (np.arange(x0 + 10.0, x1 - 4.0, 26.0), y), (np.arange(x0 + 23.0, x1 - 4.0, 26.0), -y)
    lamps = np.concatenate([np.stack([x, np.full_like(x, side)], 1) for x, side in rows])
    return Layout(
        parameters,
        x0,
        x1,
        zebra_x,
        plots=_plots(stream(parameters, 1), x0, x1),
        trees=_trees(stream(parameters, 2), x0, x1, lamps, zebra_x),
        lamps=lamps,
        signs=_signs(stream(parameters, 3), zebra_x, length),
        parked=_parked(stream(parameters, 4), parameters.parked, length, zebra_x),
        movers=_movers(stream(parameters, 5), parameters),
    )


def _plots(rng: np.random.Generator, x0: float, x1: float) -> list[tuple]:
    plots = []
    for side in (1, -1):
        x, garden = x0 - 2.0, True
        while x < x1 - 3.0:
            garden = not garden and x < x1 - 20 and rng.random() < 0.13  # never two in a row
            end = x + (rng.uniform(4.5, 7.5) if garden else rng.uniform(7.5, 13.0))
            if x1 + 1.0 - end < 7.0:
                end, garden = x1 + 1.0, False
            plots.append((x, end, side, int(rng.integers(2**31)), garden))
            x = end
    return plots


def _trees(
    rng: np.random.Generator, x0: float, x1: float, lamps: np.ndarray, zebra_x: float
) -> np.ndarray:
    trees = []
    for side in (1, -1):
        x = x0 + rng.uniform(2, 9)
        while x < x1 - 3:
            place = np.array([x, side * TREE_Y_M])
            clear = np.abs(lamps - place).sum(1).min() > 3.0 and abs(x - zebra_x) > 4.5
            if clear and rng.random() > 0.25:
                trees.append(place)
            x += rng.uniform(8.0, 12.5)
    return np.array(trees).reshape(-1, 2)


def _signs(rng: np.random.Generator, zebra_x: float, length: float) -> np.ndarray:
    y = ROAD_HALF_M + 0.45
    places = [(zebra_x - 2.6, -y), (zebra_x + 2.6, y), (rng.uniform(6, 9), -y)]
    places += [(length + rng.uniform(36, 40), -y), (-rng.uniform(16, 20), y)]
    return np.array(places)


def _parked(rng: np.random.Generator, count: int, length: float, zebra_x: float) -> np.ndarray:
    slots = [
        (x + rng.uniform(-0.4, 0.4), side * PARKED_Y_M)
        for side in (1, -1)
        for x in np.arange(-26.0, length + 58.0, 6.1)
        if abs(x - zebra_x) > 5.5
    ]
    chosen = rng.permutation(len(slots))[:count]
    return np.array([slots[i] for i in sorted(chosen)]).reshape(-1, 2)


# x at the first frame, side of the road, speed; of the ego car's where it drives the same way.
CARS = (
    (17.0, -1, 0.6), (34.0, 1, -9.0), (-13.0, -1, -0.4),
    (62.0, 1, -8.2), (-24.0, 1, -9.5), (33.0, -1, 0.9),
)  # fmt: skip


def _movers(rng: np.random.Generator, parameters: StreetParameters) -> list[Mover]:
    movers = []
    for i, (x, side, speed) in enumerate(CARS[: parameters.moving]):
        speed += parameters.speed_mps if side < 0 else 0.0
        movers.append(Mover(f"car-{i}", x, side * LANE_M / 2, speed, int(rng.integers(2**31))))
    for i in range(parameters.pedestrians):
        side, direction = (-1, 1)[i % 2], (1, -1)[(i // 2 + i) % 2]
        x = rng.uniform(7, 10) + 4.5 * i + parameters.path_length_m * 0.25
        y, speed = side * rng.uniform(7.7, 8.5), direction * rng.uniform(1.2, 1.6)
        movers.append(Mover(f"pedestrian-{i}", x, y, speed, int(rng.integers(2**31))))
    return movers


# ---- The ego car's path, its six cameras, and where moving actors are at any time ----------------

FIELD_OF_VIEW_DEG = 72.0
SWAY_M, SWAY_LENGTH_M = 0.10, 55.0
CAMERA_Z_M = 1.6
# name: (forward, left) of the ego origin in metres, yaw in degrees to the left. Each fires when the
# LiDAR's beam, which turns clockwise once a frame and looks ahead at the frame's time, passes it.
MOUNTS = {
    "front": (1.6, 0.0, 0.0),
    "front_left": (1.5, 0.45, 55.0),
    "front_right": (1.5, -0.45, -55.0),
    "left": (1.2, 0.55, 110.0),
    "right": (1.2, -0.55, -110.0),
    "back": (-1.2, 0.0, 180.0),
}


def ego_pose(
    parameters: StreetParameters, timestamps_ns: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The ego car, swaying about its lane's middle, at times [N]: positions [N, 3] of its ground
    point and yaws [N]."""
    seconds = (np.asarray(timestamps_ns, np.int64) - START_NS) * 1e-9
    x = parameters.speed_mps * seconds
    phase = 2 * np.pi * x / SWAY_LENGTH_M
    y = EGO_Y_M + SWAY_M * np.sin(phase)
    yaw = np.arctan(SWAY_M * 2 * np.pi / SWAY_LENGTH_M * np.cos(phase))
    return np.stack([x, y, road_z(y)], -1), yaw


def camera_path(parameters: StreetParameters, timestamps_ns: np.ndarray) -> np.ndarray:
    """Where the cameras are at times [N], taken together: above the ego car's middle, [N, 3]."""
    return ego_pose(parameters, timestamps_ns)[0] + np.array([0.0, 0.0, CAMERA_Z_M])


def frame_time_ns(index: int) -> int:
    return START_NS + index * FRAME_NS


def build_frames(parameters: StreetParameters) -> tuple[Frame, ...]:
    """All frames with their six cameras."""
    frames = []
    for index in range(parameters.frames):
        time = frame_time_ns(index)
        cameras = {name: _camera(parameters, name, time) for name in MOUNTS}
        pose = torch.from_numpy(_world_from_ego(parameters, time))
        frames.append(Frame(index, time, pose, cameras))
    return tuple(frames)


def _world_from_ego(parameters: StreetParameters, timestamp_ns: int) -> np.ndarray:
    """float64 [4, 4]: ego x forward, y left, z up, origin on the road."""
    positions, yaws = ego_pose(parameters, np.array([timestamp_ns]))
    return _rigid(positions[0], float(yaws[0]))


def camera_offset_ns(name: str) -> int:
    """How long after the frame's time a camera fires."""
    yaw_deg = MOUNTS[name][2]
    before = FRAME_NS if yaw_deg > 0 and name != "back" else 0
    return round(-yaw_deg / 360 * FRAME_NS) % FRAME_NS - before


def _camera(parameters: StreetParameters, name: str, frame_ns: int) -> Camera:
    forward, left, yaw_deg = MOUNTS[name]
    time, width, height = frame_ns + camera_offset_ns(name), parameters.width, parameters.height
    mount = _rigid(np.array([forward, left, CAMERA_Z_M]), math.radians(yaw_deg))
    mount[:3, :3] = mount[:3, :3] @ np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0]], np.float64)
    pose = torch.from_numpy(invert_pose(_world_from_ego(parameters, time) @ mount))
    focal_px = width / 2 / math.tan(math.radians(FIELD_OF_VIEW_DEG) / 2)
    return Camera(name, width, height, focal_px, focal_px, width / 2, height / 2, pose, time)


@dataclass(frozen=True, eq=False)
class Motion:
    """A mover's box centre over time; its heading never changes.

    times_ns: int64 [T], one frame beyond the drive on both sides, as far as the street goes.
    centres: float64 [T, 3].
    """

    times_ns: np.ndarray
    centres: np.ndarray
    yaw: float

    @property
    def track(self) -> Track:
        poses = np.stack([_rigid(centre, self.yaw) for centre in self.centres])
        return Track(torch.from_numpy(self.times_ns.copy()), torch.from_numpy(poses))

    def at(self, timestamps_ns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Centres [N, 3] at times [N], and whether the mover is there at all: as Track.pose_at."""
        start, hold = int(self.times_ns[0]), Track.hold_ns
        seconds = (timestamps_ns - start) * 1e-9
        samples = (self.times_ns - start) * 1e-9
        centres = np.stack([np.interp(seconds, samples, c) for c in self.centres.T], -1)
        last = int(self.times_ns[-1])
        return centres, (timestamps_ns >= start - hold) & (timestamps_ns <= last + hold)


def motion_of(mover: Mover, layout: Layout, height_m: float, ground_z: float) -> Motion:
    """Where a mover of this height goes while it is on the street."""
    frames = np.arange(-1, layout.parameters.frames + 1)
    x = mover.x_m + mover.speed_mps * frames * FRAME_NS * 1e-9
    on_street = (x > layout.x0 + 3) & (x < layout.x1 - 3)
    if not on_street.any():
        on_street[0] = True
    y, z = np.full((2, len(x)), [[mover.y_m], [ground_z + height_m / 2]])
    yaw = 0.0 if mover.speed_mps >= 0 else math.pi
    times = START_NS + frames[on_street].astype(np.int64) * FRAME_NS
    return Motion(times, np.stack([x, y, z], -1)[on_street], yaw)


def _rigid(translation: np.ndarray, yaw_rad: float) -> np.ndarray:
    c, s = math.cos(yaw_rad), math.sin(yaw_rad)
    if abs(s) < 1e-15:
        s = 0.0
    out = np.eye(4)
    out[:2, :2] = [[c, -s], [s, c]]
    out[:3, 3] = translation
    return out
