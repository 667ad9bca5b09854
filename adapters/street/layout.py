"""Plan of the procedural street, drawn from the seed: positions of everything, the ego car's
path, its cameras, and the motion of moving actors.

x runs along the street, y to the left, z up; metres. Each kind of thing draws from its own stream
of random numbers, so that one more car moves no tree. The callers are `adapters.street.world` and
`adapters.procedural`.
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
from augment.scene.cameras import Camera, Frame
from augment.scene.scene import Track


class StreetParameters(BaseModel):
    """Parameters of a street's URI. Equal parameters give equal bits."""

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
        """Return the name of the scene."""
        return f"street-seed{self.seed}"

    @property
    def path_length_m(self) -> float:
        """Return the length of the ego car's drive."""
        return self.speed_mps * (self.frames - 1) * FRAME_NS * 1e-9

    @property
    def uri(self) -> str:
        """Return the canonical URI: the seed, then all parameters that differ from their
        defaults, in order.
        """
        changed_values = self.model_dump(exclude_defaults=True) | {"seed": self.seed}
        terms = [
            f"{key}={changed_values[key]}"
            for key in StreetParameters.model_fields
            if key in changed_values
        ]
        return "procedural:street?" + "&".join(terms)


def parse_parameters(query: Mapping[str, str]) -> StreetParameters:
    """Return the parameters of a URI's query."""
    descriptions = {
        key: str(field.description) for key, field in StreetParameters.model_fields.items()
    }
    check_query("procedural:street", query, descriptions)
    return validate(StreetParameters, dict(query), "procedural:street", "query")


# Time between two frames.
FRAME_NS = 100_000_000
# Time of the first frame.
START_NS = 1_700_000_000_000_000_000
# Width of a driving lane.
LANE_M = 3.4
# Half of the carriageway's width: a driving lane and a parking lane.
ROAD_HALF_M = 5.6
# Width of the kerb stone.
KERB_TOP_M = 0.15
# Distance of the house fronts from the street's middle.
FACADE_M = 9.4
# Slope of the carriageway from its crown to the kerbs.
CAMBER = 0.02
# Height of the kerb above the carriageway.
KERB_RISE_M = 0.13
# Slope of the pavements from kerb to wall.
PAVEMENT_SLOPE = 0.012
# y of the ego car.
EGO_Y_M = -1.7
# Distance of parked cars from the street's middle.
PARKED_Y_M = 4.52
# Distance of trees from the street's middle.
TREE_Y_M = 6.75
# Width of the cross streets at both ends.
CROSS_STREET_M = 10.0
# The land reaches this far beyond the street.
TERRAIN_REACH_M = 230.0
# Height of the land.
TERRAIN_Z_M = 0.03


class Mover(NamedTuple):
    """An actor that goes straight along x at a steady speed (negative: towards -x)."""

    name: str
    """Name, for example car-0 or pedestrian-1."""

    x_m: float
    """x at the first frame."""

    y_m: float
    """y at all times."""

    speed_mps: float
    """Speed along x."""

    seed: int
    """Seed of the mover's model and colours."""


@dataclass(frozen=True)
class Layout:
    """Plan of a street. Lengths are in metres, in the scene's world."""

    parameters: StreetParameters
    """Parameters of the street."""

    x0: float
    """x of the carriageway's beginning."""

    x1: float
    """x of the carriageway's end."""

    zebra_x: float
    """x of the zebra crossing's middle."""

    plots: list[tuple[float, float, int, int, bool]]
    """Beginning and end of each building or garden along x, its side of the street (+1 left, -1
    right), its seed, and True for a garden.
    """

    trees: np.ndarray
    """Positions (x, y) of the street trees, [T, 2]."""

    lamps: np.ndarray
    """Positions (x, y) of the lamps, [L, 2]."""

    signs: np.ndarray
    """Positions (x, y) of the signs, [S, 2]."""

    parked: np.ndarray
    """Positions (x, y) of the parked cars, [C, 2]."""

    movers: list[Mover]
    """Moving actors."""


def road_z(y: np.ndarray | float) -> np.ndarray | float:
    """Return the height of the carriageway: 0 at its crown, falling to both kerbs."""
    return -CAMBER * np.abs(y)


def pavement_z(y: np.ndarray | float) -> np.ndarray | float:
    """Return the height of the pavements, from kerb to wall."""
    kerb = -CAMBER * ROAD_HALF_M + KERB_RISE_M
    return kerb + PAVEMENT_SLOPE * (np.abs(y) - ROAD_HALF_M)


def rng_of(parameters: StreetParameters, *key: int) -> np.random.Generator:
    """Return the random numbers of one kind of thing."""
    return np.random.default_rng([parameters.seed, *key])


def draw_layout(parameters: StreetParameters) -> Layout:
    """Draw the plan of a street."""
    length = parameters.path_length_m
    x0 = -62.0
    x1 = length + 86.0
    zebra_x = length + 15.0
    y = ROAD_HALF_M + 0.55
    lamp_rows = (
        (np.arange(x0 + 10.0, x1 - 4.0, 26.0), y),
        (np.arange(x0 + 23.0, x1 - 4.0, 26.0), -y),
    )
    lamps = np.concatenate([np.stack([x, np.full_like(x, side)], 1) for x, side in lamp_rows])
    return Layout(
        parameters,
        x0,
        x1,
        zebra_x,
        plots=_draw_plots(rng_of(parameters, 1), x0, x1),
        trees=_draw_trees(rng_of(parameters, 2), x0, x1, lamps, zebra_x),
        lamps=lamps,
        signs=_place_signs(rng_of(parameters, 3), zebra_x, length),
        parked=_draw_parked_cars(rng_of(parameters, 4), parameters.parked, length, zebra_x),
        movers=_draw_movers(rng_of(parameters, 5), parameters),
    )


def _draw_plots(rng: np.random.Generator, x0: float, x1: float) -> list[tuple]:
    plots = []
    for side in (1, -1):
        x = x0 - 2.0
        is_garden = True
        while x < x1 - 3.0:
            is_garden = not is_garden and x < x1 - 20 and rng.random() < 0.13  # never two in a row
            end = x + (rng.uniform(4.5, 7.5) if is_garden else rng.uniform(7.5, 13.0))
            if x1 + 1.0 - end < 7.0:
                end = x1 + 1.0
                is_garden = False
            plots.append((x, end, side, int(rng.integers(2**31)), is_garden))
            x = end
    return plots


def _draw_trees(
    rng: np.random.Generator, x0: float, x1: float, lamps: np.ndarray, zebra_x: float
) -> np.ndarray:
    trees = []
    for side in (1, -1):
        x = x0 + rng.uniform(2, 9)
        while x < x1 - 3:
            position = np.array([x, side * TREE_Y_M])
            is_clear = np.abs(lamps - position).sum(1).min() > 3.0 and abs(x - zebra_x) > 4.5
            if is_clear and rng.random() > 0.25:
                trees.append(position)
            x += rng.uniform(8.0, 12.5)
    return np.array(trees).reshape(-1, 2)


def _place_signs(rng: np.random.Generator, zebra_x: float, length: float) -> np.ndarray:
    y = ROAD_HALF_M + 0.45
    positions = [(zebra_x - 2.6, -y), (zebra_x + 2.6, y), (rng.uniform(6, 9), -y)]
    positions += [(length + rng.uniform(36, 40), -y), (-rng.uniform(16, 20), y)]
    return np.array(positions)


def _draw_parked_cars(
    rng: np.random.Generator, count: int, length: float, zebra_x: float
) -> np.ndarray:
    slots = [
        (x + rng.uniform(-0.4, 0.4), side * PARKED_Y_M)
        for side in (1, -1)
        for x in np.arange(-26.0, length + 58.0, 6.1)
        if abs(x - zebra_x) > 5.5
    ]
    slot_numbers = rng.permutation(len(slots))[:count]
    return np.array([slots[i] for i in sorted(slot_numbers)]).reshape(-1, 2)


# x at the first frame, side of the road and speed of the moving cars. The speed of cars that drive
# in the ego car's direction is relative to it.
CAR_STARTS = (
    (17.0, -1, 0.6), (34.0, 1, -9.0), (-13.0, -1, -0.4),
    (62.0, 1, -8.2), (-24.0, 1, -9.5), (33.0, -1, 0.9),
)  # fmt: skip


def _draw_movers(rng: np.random.Generator, parameters: StreetParameters) -> list[Mover]:
    movers = []
    for i, (x, side, speed) in enumerate(CAR_STARTS[: parameters.moving]):
        speed += parameters.speed_mps if side < 0 else 0.0
        movers.append(Mover(f"car-{i}", x, side * LANE_M / 2, speed, int(rng.integers(2**31))))
    for i in range(parameters.pedestrians):
        side = (-1, 1)[i % 2]
        direction = (1, -1)[(i // 2 + i) % 2]
        x = rng.uniform(7, 10) + 4.5 * i + parameters.path_length_m * 0.25
        y = side * rng.uniform(7.7, 8.5)
        speed = direction * rng.uniform(1.2, 1.6)
        movers.append(Mover(f"pedestrian-{i}", x, y, speed, int(rng.integers(2**31))))
    return movers


# ---- The ego car's path, its six cameras, and where moving actors are at any time ----------------

# Horizontal field of view of every camera.
FIELD_OF_VIEW_DEG = 72.0
# Amplitude of the ego car's sway in its lane.
SWAY_M = 0.10
# Length of one sway along the street.
SWAY_LENGTH_M = 55.0
# Height of the cameras above the road.
CAMERA_Z_M = 1.6
# name: (forward, left) of the ego origin in metres, yaw in degrees to the left. Each fires when the
# LiDAR's beam, which turns clockwise once a frame and looks ahead at the frame's time, passes it.
CAMERA_MOUNTS = {
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
    """Return the ego car's ground points, float [N, 3], and yaws, float [N], at times [N].

    The car sways about its lane's middle.
    """
    seconds = (np.asarray(timestamps_ns, np.int64) - START_NS) * 1e-9
    x = parameters.speed_mps * seconds
    phase = 2 * np.pi * x / SWAY_LENGTH_M
    y = EGO_Y_M + SWAY_M * np.sin(phase)
    yaw = np.arctan(SWAY_M * 2 * np.pi / SWAY_LENGTH_M * np.cos(phase))
    return np.stack([x, y, road_z(y)], -1), yaw


def camera_path(parameters: StreetParameters, timestamps_ns: np.ndarray) -> np.ndarray:
    """Return the cameras' common place at times [N], above the ego car's middle, [N, 3]."""
    return ego_pose(parameters, timestamps_ns)[0] + np.array([0.0, 0.0, CAMERA_Z_M])


def frame_time_ns(index: int) -> int:
    """Return the time of a frame."""
    return START_NS + index * FRAME_NS


def build_frames(parameters: StreetParameters) -> tuple[Frame, ...]:
    """Return all frames with their six cameras."""
    frames = []
    for index in range(parameters.frames):
        time = frame_time_ns(index)
        cameras = {name: _camera(parameters, name, time) for name in CAMERA_MOUNTS}
        pose = torch.from_numpy(_world_from_ego(parameters, time))
        frames.append(Frame(index, time, pose, cameras))
    return tuple(frames)


def _world_from_ego(parameters: StreetParameters, timestamp_ns: int) -> np.ndarray:
    """Return world_from_ego, float64 [4, 4]: ego x forward, y left, z up, origin on the road."""
    positions, yaws = ego_pose(parameters, np.array([timestamp_ns]))
    return _rigid_transform(positions[0], float(yaws[0]))


def camera_offset_ns(name: str) -> int:
    """Return the time from the frame's time to the moment when a camera fires."""
    yaw_deg = CAMERA_MOUNTS[name][2]
    shift_ns = FRAME_NS if yaw_deg > 0 and name != "back" else 0
    return round(-yaw_deg / 360 * FRAME_NS) % FRAME_NS - shift_ns


def _camera(parameters: StreetParameters, name: str, frame_ns: int) -> Camera:
    forward_m, left_m, yaw_deg = CAMERA_MOUNTS[name]
    time = frame_ns + camera_offset_ns(name)
    width = parameters.width
    height = parameters.height
    ego_from_camera = _rigid_transform(
        np.array([forward_m, left_m, CAMERA_Z_M]), math.radians(yaw_deg)
    )
    ego_from_camera[:3, :3] = ego_from_camera[:3, :3] @ np.array(
        [[0, 0, 1], [-1, 0, 0], [0, -1, 0]], np.float64
    )
    pose = torch.from_numpy(invert_pose(_world_from_ego(parameters, time) @ ego_from_camera))
    focal_px = width / 2 / math.tan(math.radians(FIELD_OF_VIEW_DEG) / 2)
    return Camera(name, width, height, focal_px, focal_px, width / 2, height / 2, pose, time)


@dataclass(frozen=True, eq=False)
class Motion:
    """Motion of a mover's box centre over time. Its heading never changes.

    Attributes:
        times_ns: int64 [T], one frame beyond the drive on both sides, as far as the street goes.
        centres: float64 [T, 3].
        yaw: heading, radians.
    """

    times_ns: np.ndarray
    centres: np.ndarray
    yaw: float

    @property
    def track(self) -> Track:
        """Return the motion as a track."""
        poses = np.stack([_rigid_transform(centre, self.yaw) for centre in self.centres])
        return Track(torch.from_numpy(self.times_ns.copy()), torch.from_numpy(poses))

    def at(self, timestamps_ns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the centres [N, 3] at times [N], and a mask of the times at which the mover
        exists.

        The mask agrees with Track.pose_at.
        """
        start = int(self.times_ns[0])
        hold_ns = Track.hold_ns
        seconds = (timestamps_ns - start) * 1e-9
        samples = (self.times_ns - start) * 1e-9
        centres = np.stack([np.interp(seconds, samples, c) for c in self.centres.T], -1)
        last = int(self.times_ns[-1])
        return centres, (timestamps_ns >= start - hold_ns) & (timestamps_ns <= last + hold_ns)


def motion_of(mover: Mover, layout: Layout, height_m: float, ground_z: float) -> Motion:
    """Return the motion of a mover of this height while it is on the street."""
    frames = np.arange(-1, layout.parameters.frames + 1)
    x = mover.x_m + mover.speed_mps * frames * FRAME_NS * 1e-9
    is_on_street = (x > layout.x0 + 3) & (x < layout.x1 - 3)
    if not is_on_street.any():
        is_on_street[0] = True
    y, z = np.full((2, len(x)), [[mover.y_m], [ground_z + height_m / 2]])
    yaw = 0.0 if mover.speed_mps >= 0 else math.pi
    times = START_NS + frames[is_on_street].astype(np.int64) * FRAME_NS
    return Motion(times, np.stack([x, y, z], -1)[is_on_street], yaw)


def _rigid_transform(translation: np.ndarray, yaw_rad: float) -> np.ndarray:
    """Return the transform [4, 4] that turns about z, then shifts."""
    c = math.cos(yaw_rad)
    s = math.sin(yaw_rad)
    if abs(s) < 1e-15:
        s = 0.0
    transform = np.eye(4)
    transform[:2, :2] = [[c, -s], [s, c]]
    transform[:3, 3] = translation
    return transform
