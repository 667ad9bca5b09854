"""Lamps of the vehicles of a scene, and of the recording car.

In: a scene, a moment, settings. Out: `Lamps`. Vehicles are the scene's actors and the labelled
boxes of its background. Their lamps lie on their boxes (`vehicle_places`), drawn to the surface of
the vehicle's own Gaussians where there are enough. Which of them are lit depends on the vehicle's
track and on a hash of its name, so it is the same in every view, order and process.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float64

from augment.exposure.vehicle_cells import parked_vehicles
from augment.lamps.braking import is_braking, travels
from augment.lamps.lamp import EGO_OWNER, MAP_OWNER, LampKind, Lamps, color_of_temperature
from augment.lamps.lamp_types import DIPPED, HIGH, STOP, TAIL, THIRD_STOP, LampType, make_lamps
from augment.lamps.patterns import Pattern
from augment.lamps.road_heights import RoadHeights
from augment.lamps.vehicle_places import LampPlace, body_of, places_of, points_of
from augment.memo import memo_of
from augment.rng import rng_for
from augment.scene.cameras import Camera
from augment.scene.geometry import invert_rigid
from augment.scene.scene import Actor, Gaussians, Scene, Track

# ---- Settings ------------------------------------------------------------------------------------


@dataclass(frozen=True)
class VehicleLampSettings:
    """Choice of the vehicles' lamps that are lit."""

    seed: int = 0
    """Seed of the hash that chooses vehicles."""
    lit_share: float = 1.0
    """Share of moving vehicles with lit lamps, 0 to 1."""
    parked_share: float = 0.05
    """Share of parked vehicles with lit lamps, 0 to 1."""
    unknown_share: float = 0.5
    """Share of vehicles with lit lamps, of those that a drive is too short to call parked."""
    beam: LampKind = LampKind.DIPPED
    """Front lamps that are lit: DIPPED, HIGH or DAYTIME. With DAYTIME rear lamps are dark but for
    stop lamps."""
    front_fog_share: float = 0.0
    """Share of lit vehicles with front fog lamps."""
    rear_fog_share: float = 0.0
    """Share of lit vehicles with a rear fog lamp."""
    left_hand_traffic: bool = False
    """If True, traffic keeps left, and beams are mirrored."""

    def __post_init__(self) -> None:
        shares = ("lit_share", "parked_share", "unknown_share", "front_fog_share", "rear_fog_share")
        for name in shares:
            value = getattr(self, name)
            if not 0.0 <= value <= 1.0:  # also catches NaN
                raise ValueError(f"{name} must be a share from 0 to 1; got {value}")
        if self.beam not in (LampKind.DIPPED, LampKind.HIGH, LampKind.DAYTIME):
            raise ValueError(f"beam must be DIPPED, HIGH or DAYTIME; got {self.beam!r}")


# Share of vehicles with halogen headlamps; the others have LEDs or xenon lamps.
HALOGEN_SHARE = 0.4
# Colour temperatures of halogen headlamps, kelvin.
_HALOGEN_K = (2900.0, 3400.0)
# Colour temperatures of LED and xenon headlamps, kelvin.
_LED_K = (4300.0, 6300.0)
# Standard deviation of the logarithm of a vehicle's intensities: dirt, age and make.
_INTENSITY_SIGMA = 0.25
# Limits of the factor of a vehicle's intensities.
_INTENSITY_FACTORS = (0.55, 1.6)


class _Traits(NamedTuple):
    """Numbers of one vehicle that a hash of its name gives."""

    lit_level: float
    """The vehicle is lit where the share is above this level."""
    front_fog_level: float
    """The same for front fog lamps."""
    rear_fog_level: float
    """The same for the rear fog lamp."""
    factor: float
    """Factor of all intensities."""
    white: np.ndarray
    """Colour of the front lamps."""


def _traits_of(scene: Scene, track_id: str, seed: int) -> _Traits:
    """Return the numbers that the hash of a vehicle's name gives, remembered for the scene."""
    name = scene.name
    key = ("lamps, traits of a vehicle", track_id, seed)
    return memo_of(scene.as_recorded).get(key, lambda: _draw_traits(name, track_id, seed))


def _draw_traits(scene_name: str, track_id: str, seed: int) -> _Traits:
    """Return the numbers that the hash of a vehicle's name gives."""
    rng = rng_for(seed=seed, scene=scene_name, effect=f"lamps.vehicle.{track_id}")
    lit_level, front_fog_level, rear_fog_level, halogen_level, warmth = rng.random(5).tolist()
    factor = float(np.exp(_INTENSITY_SIGMA * np.clip(rng.standard_normal(), -3, 3)))
    low, high = _HALOGEN_K if halogen_level < HALOGEN_SHARE else _LED_K
    white = color_of_temperature(low + (high - low) * warmth)
    factor = float(np.clip(factor, *_INTENSITY_FACTORS))
    return _Traits(lit_level, front_fog_level, rear_fog_level, factor, white)


# ---- Lamps of other vehicles ---------------------------------------------------------------------


class _Vehicle(NamedTuple):
    """A vehicle that stands or moves in the scene."""

    track_id: str
    """Track of the vehicle."""
    label: str
    """Dataset's name of its kind."""
    size_m: tuple[float, float, float]
    """Length, width and height of its box."""
    owner: int
    """Instance id of its actor; MAP_OWNER for one of the background."""
    is_moving: bool | None
    """True if it moves during the drive or has stopped in traffic, None if that is not known."""
    gaussians: Gaussians | None
    """Gaussians in the frame of the box; None for vehicles of the background."""


def vehicle_lamps(scene: Scene, timestamp_ns: int, settings: VehicleLampSettings) -> Lamps:
    """Return the lit lamps of all vehicles but the recording car at a moment.

    Args:
        scene: the scene.
        timestamp_ns: the moment.
        settings: choice of the lamps that are lit.
    """
    parts: list[Lamps] = []
    poses = scene.poses_at(timestamp_ns)
    for owner, actor in enumerate(scene.actors, start=1):
        if owner not in poses or body_of(actor.label, actor.size_m) is None:
            continue
        vehicle = _Vehicle(
            actor.track_id,
            actor.label,
            actor.size_m,
            owner,
            _travels(scene, actor),
            actor.gaussians,
        )
        if not _is_lit(scene, vehicle, settings):
            continue
        brakes = _brakes(scene, actor, timestamp_ns)
        lamps = _lamps_on_box(scene, vehicle, settings, brakes)
        parts.append(_place(lamps, poses[owner]))
    parts.append(_parked_lamps(scene, settings))
    return Lamps.concatenate(parts)


def _travels(scene: Scene, actor: Actor) -> bool | None:
    """Return `travels` of an actor's track, remembered; None where it is not known."""
    track = actor.track
    key = ("lamps, travels", actor.track_id)
    # A tuple, as the memo makes None anew.
    return memo_of(scene).get(key, lambda: (travels(track),))[0]


def _brakes(scene: Scene, actor: Actor, timestamp_ns: int) -> bool:
    """Return True if an actor brakes at the sample of its track that is nearest to a time.

    So the cameras of a frame, which fire one after another, show the same lamps.
    """
    track = actor.track
    times_ns = track.timestamps_ns.numpy()
    nearest = int(np.abs(times_ns - timestamp_ns).argmin())
    key = ("lamps, braking", actor.track_id, nearest)
    return memo_of(scene).get(key, lambda: (is_braking(track, int(times_ns[nearest])),))[0]


def _parked_lamps(scene: Scene, settings: VehicleLampSettings) -> Lamps:
    """Return the lit lamps of vehicles of the background. They are the same at all times."""

    def find() -> Lamps:
        parts: list[Lamps] = []
        is_short = _is_short(scene)
        for parked in parked_vehicles(scene):
            motion = True if parked.is_stopped else None if is_short else False
            vehicle = _Vehicle(
                parked.track_id, parked.label, parked.size_m, MAP_OWNER, motion, None
            )
            is_vehicle = body_of(parked.label, parked.size_m) is not None
            if not is_vehicle or not _is_lit(scene, vehicle, settings):
                continue
            pose = np.eye(4)
            pose[:3, :3] = parked.rotation
            pose[:3, 3] = parked.centre_m
            # A driver who waits in traffic holds the brakes.
            lamps = _lamps_on_box(scene, vehicle, settings, parked.is_stopped)
            parts.append(_place(lamps, pose))
        return Lamps.concatenate(parts)

    scene = scene.as_recorded
    return memo_of(scene).get(("lamps of parked vehicles", settings), find)


def _is_short(scene: Scene) -> bool:
    """Return True if the drive is too short to tell parked vehicles from others."""
    frames = scene.frames if scene.seen_frames is None else scene.seen_frames
    times_ns = [frame.timestamp_ns for frame in frames]
    return not times_ns or max(times_ns) - min(times_ns) < 1e9


def _is_lit(scene: Scene, vehicle: _Vehicle, settings: VehicleLampSettings) -> bool:
    """Return True if a vehicle has its lamps on."""
    shares = {
        True: settings.lit_share,
        False: settings.parked_share * settings.lit_share,
        None: settings.unknown_share * settings.lit_share,
    }
    return _traits_of(scene, vehicle.track_id, settings.seed).lit_level < shares[vehicle.is_moving]


def _lamps_on_box(
    scene: Scene, vehicle: _Vehicle, settings: VehicleLampSettings, brakes: bool
) -> Lamps:
    """Return a vehicle's lit lamps in the frame of its box, remembered for its actor."""

    def make() -> Lamps:
        traits = _traits_of(scene, vehicle.track_id, settings.seed)
        body = body_of(vehicle.label, vehicle.size_m)
        assert body is not None
        chosen = (
            place for place in places_of(body) if _is_on(place.lamp_type, traits, settings, brakes)
        )
        return Lamps.concatenate(
            [
                _make(place, point, vehicle, traits, settings)
                for place in chosen
                for point in points_of(
                    place, vehicle.size_m, left_hand_traffic=settings.left_hand_traffic
                )
            ]
        )

    key = ("lamps of a vehicle", vehicle.track_id, vehicle.owner, settings, brakes)
    return memo_of(scene.as_recorded).get(key, make)


def _is_on(
    lamp_type: LampType, traits: _Traits, settings: VehicleLampSettings, brakes: bool
) -> bool:
    """Return True if a lamp of a lit vehicle is on."""
    kind = lamp_type.kind
    if kind in (LampKind.DIPPED, LampKind.HIGH, LampKind.DAYTIME):
        # Bicycles have one kind of front lamp.
        is_bicycle = kind == LampKind.DIPPED and lamp_type is not DIPPED
        return is_bicycle or kind == settings.beam
    if kind == LampKind.STOP:
        return brakes
    if settings.beam == LampKind.DAYTIME:
        return False
    if kind == LampKind.TAIL:
        return not brakes or lamp_type is not TAIL  # the stop lamps hold the tail lamps' light
    if kind == LampKind.FRONT_FOG:
        return traits.front_fog_level < settings.front_fog_share
    return kind == LampKind.REAR_FOG and traits.rear_fog_level < settings.rear_fog_share


def _make(
    place: LampPlace,
    point: tuple[float, float, float],
    vehicle: _Vehicle,
    traits: _Traits,
    settings: VehicleLampSettings,
) -> Lamps:
    """Return one lamp in the frame of the box."""
    lamp_type = place.lamp_type
    if lamp_type.pattern == Pattern.DIPPED_RIGHT and settings.left_hand_traffic:
        lamp_type = replace(lamp_type, pattern=Pattern.DIPPED_LEFT)
    is_front = place.along > 0
    x = _surface_x(vehicle.gaussians, point, is_front)
    position = np.array([[point[0] if x is None else x, point[1], point[2]]])
    axis = np.array([[1.0 if is_front else -1.0, 0.0, 0.0]])
    color = traits.white if is_front else None
    return make_lamps(
        position, axis, lamp_type, factors=traits.factor, color=color, owner=vehicle.owner
    )


# Half width of the column of Gaussians around a lamp that show the vehicle's surface, metres.
_COLUMN_HALF_WIDTH_M = 0.15
# Fewest Gaussians in it that show a surface.
_MIN_IN_COLUMN = 10
# Share of them that may lie beyond the surface.
_STRAY_SHARE = 0.1
# Largest distance by which a lamp is drawn to the surface, metres. A third stop lamp of a saloon
# lies far from that of an estate car.
_MAX_SHIFT_M = 1.2
# Opacity from which on a Gaussian is part of a surface.
_MIN_OPACITY = 0.3
# Distance of a lamp before the surface, metres.
_CLEARANCE_M = 0.03


def _surface_x(
    gaussians: Gaussians | None, point: tuple[float, float, float], is_front: bool
) -> float | None:
    """Return the x of a lamp just before the vehicle's own surface; None where it has none."""
    if gaussians is None or len(gaussians) == 0:
        return None
    means = gaussians.means.detach().numpy()
    offsets = np.abs(means[:, 1:] - np.array(point[1:]))
    is_near = (offsets < _COLUMN_HALF_WIDTH_M).all(1)
    is_near &= gaussians.opacities.detach().numpy() > _MIN_OPACITY
    is_near &= (means[:, 0] > 0) == is_front
    x = means[is_near, 0]
    if len(x) < _MIN_IN_COLUMN:
        return None
    surface = float(np.quantile(x, 1 - _STRAY_SHARE if is_front else _STRAY_SHARE))
    surface += _CLEARANCE_M if is_front else -_CLEARANCE_M
    return surface if abs(surface - point[0]) <= _MAX_SHIFT_M else None


def _place(lamps: Lamps, world_from_box: Float64[np.ndarray, "4 4"]) -> Lamps:
    """Return lamps of a box's frame in the world."""
    rotation = world_from_box[:3, :3]
    return replace(
        lamps,
        positions_m=lamps.positions_m @ rotation.T + world_from_box[:3, 3],
        axes=_unit(lamps.axes @ rotation.T),
        ups=_unit(lamps.ups @ rotation.T),
    )


def _unit(vectors: Float64[np.ndarray, "M 3"]) -> Float64[np.ndarray, "M 3"]:
    """Return vectors at unit length: poses of float32 files are orthonormal to some 1e-7."""
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


# ---- Lamps of the recording car ------------------------------------------------------------------


@dataclass(frozen=True)
class OwnLampSettings:
    """Lamps of the recording car."""

    beam: LampKind | None = LampKind.DIPPED
    """Front lamps that are lit: DIPPED or HIGH; None for none, and no rear lamps."""
    left_hand_traffic: bool = False
    """If True, traffic keeps left, and beams are mirrored."""
    height_m: float = 0.65
    """Height of the headlamps above the road, metres."""
    half_distance_m: float = 0.62
    """Half of the distance between the two headlamps, metres."""
    ahead_m: float = 1.9
    """Distance of the headlamps ahead of the front camera, metres: from a windscreen or roof to the
    bumper."""
    length_m: float = 4.4
    """Distance between head and tail lamps, metres."""


# Distance of the headlamps ahead of the car's origin where no camera looks ahead, metres.
_AHEAD_OF_ORIGIN_M = 2.5
# Cosine of the angle to the car's axis below which a camera looks ahead.
_AHEAD_COSINE = 0.9
# Height of the tail lamps above the road, metres.
_TAIL_HEIGHT_M = 0.9
# Longest time for which the car's path is continued beyond its first and last frame, nanoseconds.
_MAX_BEYOND_NS = 500_000_000


def own_lamps(scene: Scene, camera: Camera, settings: OwnLampSettings) -> Lamps:
    """Return the lit lamps of the recording car at the moment of a camera's image.

    They are fixed to the car's pose at that moment, which is interpolated between frames.

    Args:
        scene: the scene.
        camera: the camera, for its moment.
        settings: the lamps.

    Raises:
        ValueError: the beam is none of DIPPED, HIGH and None.
    """
    if settings.beam not in (LampKind.DIPPED, LampKind.HIGH, None):
        raise ValueError(f"own beams must be DIPPED, HIGH or None; got {settings.beam!r}")
    if settings.beam is None or not scene.frames:
        return Lamps.none()
    path = _ego_track(scene)
    pose = _pose_beyond(path, camera.timestamp_ns)
    x = _front_camera_x(scene) + settings.ahead_m
    forward = pose[:3, 0]
    heading = _unit(np.array([[forward[0], forward[1], 0.0]]))[0]
    left = np.array([-heading[1], heading[0], 0.0])
    middle = pose[:3, 3] + x * heading
    tail = middle - settings.length_m * heading
    heights = RoadHeights.of_scene(scene)
    side_offsets = settings.half_distance_m * np.array([1.0, -1.0])[:, None] * left
    fronts = middle + side_offsets
    fronts[:, 2] = heights.height_at(middle, pose[2, 3]) + settings.height_m
    rears = tail + side_offsets
    rears[:, 2] = heights.height_at(tail, pose[2, 3]) + _TAIL_HEIGHT_M
    # Along the slope of the road, as the car lies on it.
    axis = middle - tail
    axis[2] = (fronts[0, 2] - settings.height_m) - (rears[0, 2] - _TAIL_HEIGHT_M)
    beam_type = DIPPED if settings.beam == LampKind.DIPPED else HIGH
    if settings.left_hand_traffic and beam_type is DIPPED:
        beam_type = replace(DIPPED, pattern=Pattern.DIPPED_LEFT)
    axes = np.tile(axis, (2, 1))
    parts = [make_lamps(fronts, axes, beam_type, owner=EGO_OWNER)]
    if settings.beam == LampKind.HIGH:  # dipped beams stay on
        dipped = Pattern.DIPPED_LEFT if settings.left_hand_traffic else Pattern.DIPPED_RIGHT
        parts.append(make_lamps(fronts, axes, replace(DIPPED, pattern=dipped), owner=EGO_OWNER))
    brakes = is_braking(path, camera.timestamp_ns)
    parts.append(make_lamps(rears, -axes, STOP if brakes else TAIL, owner=EGO_OWNER))
    if brakes:
        third = rears.mean(0, keepdims=True) + np.array([0.0, 0.0, 0.5])
        parts.append(make_lamps(third, -axes[:1], THIRD_STOP, owner=EGO_OWNER))
    return Lamps.concatenate(parts)


def _ego_track(scene: Scene) -> Track:
    """Return the path of the recording car through the scene's frames."""

    def find() -> Track:
        frames = {frame.timestamp_ns: frame for frame in scene.frames}
        times_ns = sorted(frames)
        poses = torch.stack([frames[time_ns].world_from_ego.double() for time_ns in times_ns])
        return Track(torch.tensor(times_ns, dtype=torch.int64), poses, hold_ns=1 << 62)

    scene = scene.as_recorded
    return memo_of(scene).get(("lamps, ego track",), find)


def _pose_beyond(track: Track, timestamp_ns: int) -> Float64[np.ndarray, "4 4"]:
    """Return the pose of a track at a time, continued for a moment beyond its ends."""
    times_ns = track.timestamps_ns
    first_ns = int(times_ns[0])
    last_ns = int(times_ns[-1])
    inside_ns = min(max(timestamp_ns, first_ns), last_ns)
    pose = track.pose_at(inside_ns)
    assert pose is not None
    pose_array = pose.double().numpy().copy()
    beyond_ns = timestamp_ns - inside_ns
    if beyond_ns and len(times_ns) > 1 and abs(beyond_ns) <= _MAX_BEYOND_NS:
        a, b = (0, 1) if beyond_ns < 0 else (-2, -1)
        centres = track.world_from_actor[:, :3, 3].double().numpy()
        velocity = (centres[b] - centres[a]) / float(times_ns[b] - times_ns[a])
        pose_array[:3, 3] += velocity * beyond_ns
    return pose_array


def _front_camera_x(scene: Scene) -> float:
    """Return how far ahead of the car's origin the camera is that looks ahead, metres."""

    def find() -> float:
        path = _ego_track(scene)
        cameras = [camera for frame in scene.frames[:1] for camera in frame.cameras.values()]
        for camera in cameras:
            world_from_ego = torch.from_numpy(_pose_beyond(path, camera.timestamp_ns))
            ego_from_camera = invert_rigid(world_from_ego) @ camera.world_from_camera
            if float(ego_from_camera[0, 2]) > _AHEAD_COSINE:
                return float(ego_from_camera[0, 3])
        return _AHEAD_OF_ORIGIN_M - OwnLampSettings().ahead_m

    scene = scene.as_recorded
    return memo_of(scene).get(("lamps, front camera",), find)
