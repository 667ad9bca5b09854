"""Facts of a scene that clients ask for: cameras and their place on the car, the path, masks."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from augment.errors import SceneError
from augment.scene.cameras import Camera, Frame
from augment.scene.geometry import invert_rigid
from augment.scene.scene import Scene, Track
from augment.scene.scene_times import scene_times

# Nanoseconds of a microsecond, the unit of time of clients.
NS_PER_US = 1000


@dataclass(frozen=True, eq=False)
class RigCamera:
    """A camera of the car."""

    camera: Camera
    """The camera in the middle of the drive, at its full size."""
    rig_from_camera: Tensor
    """Place of the camera on the car, float64 [4, 4]."""


@dataclass(frozen=True, eq=False)
class SceneFacts:
    """Facts of a scene that are known also while it is closed."""

    name: str
    """Name for clients."""
    cameras: tuple[RigCamera, ...]
    """Cameras, in the scene's order."""
    path: tuple[tuple[int, Tensor], ...]
    """Time, microseconds, and pose world_from_rig, float64 [4, 4], of each frame."""
    image_cameras: dict[tuple[str, int], Camera]
    """Camera of each recorded image, by the camera's name and the image's time in whole
    microseconds."""
    masked_cameras: tuple[str, ...]
    """Names of cameras with a mask of the recording car."""
    start_ns: int
    """Time of the first image."""
    end_ns: int
    """Time of the last image."""


def facts_of(scene: Scene, name: str) -> SceneFacts:
    """Return the facts of an open scene.

    Args:
        scene: the scene, which has frames.
        name: name for clients.

    Raises:
        SceneError: the scene has times that messages cannot hold.
    """
    times = scene_times(scene)
    if min(times.start_ns, scene.frames[0].timestamp_ns) < 0:
        raise SceneError(
            f"scene {scene.name!r} ({scene.source}) has times before 0, which the interface of "
            f"simulators cannot say; it begins at {times.start_ns} ns"
        )
    rig = _rig_track(scene.frames)
    images = (camera for frame in scene.frames for camera in frame.cameras.values())
    masks = scene.ego_masks or {}
    return SceneFacts(
        name=name,
        cameras=tuple(_rig_camera(scene, rig, camera) for camera in scene.camera_names),
        path=tuple(
            (frame.timestamp_ns // NS_PER_US, frame.world_from_ego) for frame in scene.frames
        ),
        image_cameras={
            (camera.name, camera.timestamp_ns // NS_PER_US): camera for camera in images
        },
        masked_cameras=tuple(camera for camera in scene.camera_names if camera in masks),
        start_ns=times.start_ns,
        end_ns=times.end_ns,
    )


def _rig_track(frames: tuple[Frame, ...]) -> Track | None:
    """Return the poses of the car over time; None where frames share a time."""
    times_ns = torch.tensor([frame.timestamp_ns for frame in frames], dtype=torch.int64)
    if not bool((times_ns.diff() > 0).all()):
        return None
    return Track(times_ns, torch.stack([frame.world_from_ego for frame in frames]))


def _rig_camera(scene: Scene, rig: Track | None, name: str) -> RigCamera:
    """Return a camera with its place on the car.

    Cameras of a frame fire at different moments, so that the car's pose is taken at the camera's
    own time.
    """
    frames = [frame for frame in scene.frames if name in frame.cameras]
    # Before the first and after the last frame, the car's pose is not known.
    first_ns = scene.frames[0].timestamp_ns
    last_ns = scene.frames[-1].timestamp_ns
    frames = [f for f in frames if first_ns <= f.cameras[name].timestamp_ns <= last_ns] or frames
    frame = frames[len(frames) // 2]
    camera = frame.cameras[name]
    world_from_rig = None if rig is None else rig.pose_at(camera.timestamp_ns)
    if world_from_rig is None:
        world_from_rig = frame.world_from_ego
    return RigCamera(camera, invert_rigid(world_from_rig) @ camera.world_from_camera)
