"""What of a scene an exported file cannot keep, a sentence each, for people."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal

from augment.scene import Scene

_SEEN_PX = 0.1
ExportKind = Literal["scene", "file", "ply", "ply-parts", "splat"]


def export_losses(
    scene: Scene, kind: ExportKind, timestamp_ns: int | None = None, *, half: bool = False
) -> tuple[str, ...]:
    """What is lost, or has to be known, of a scene in a file of that kind.

    timestamp_ns: the moment at which ply and splat are baked.
    """
    if kind in ("scene", "file"):
        return tuple(_of_saved(scene, kind, half=half))
    found = [*_of_places(scene, kind, timestamp_ns), *_of_colours(scene, kind)]
    return (*found, *_of_facts(scene))


def _of_saved(scene: Scene, kind: ExportKind, *, half: bool) -> Iterator[str]:
    has_images = any(frame.image_paths for frame in scene.frames)
    if scene.labels is not None or scene.recorded_source is not None or has_images:
        yield (
            f"boxes, LiDAR and recorded images are not in it: they are read from "
            f"{scene.recorded_source or scene.source}; where that has moved, open it with ?data=URI"
        )
    if kind == "file":
        yield "it names folders of this machine: the working folder, the recording's, the images'"
    if half:
        yield (
            "rotations, opacities and colours are rounded to float16: colours by up to 0.1/255, "
            "rotations by up to 0.05 degrees, opacities by up to 0.00025"
        )


def _of_places(scene: Scene, kind: ExportKind, timestamp_ns: int | None) -> Iterator[str]:
    if kind == "ply-parts":
        if any(len(part) == 0 for part in scene.all_gaussians):
            yield "parts without Gaussians have no file"
    elif scene.actors:
        assert timestamp_ns is not None
        there = sum(actor.track.pose_at(timestamp_ns) is not None for actor in scene.actors)
        yield f"actors ({there}) stand still where they are {_moment(scene, timestamp_ns)}"
        if there < len(scene.actors):
            yield f"actors ({len(scene.actors) - there}) that are not there then are left out"
        if off_ns := _greatest_delay_ns(scene, timestamp_ns):
            yield (
                f"the frame's cameras took their images up to {off_ns / 1e6:.0f} ms from that "
                f"moment, so that moving actors are a little off in them"
            )
    if kind == "splat" and scene.world_origin_m.any():
        place = ", ".join(f"{v:.3f}" for v in scene.world_origin_m)
        yield f"where the scene lies in the dataset's world ({place}) is left out"
    if kind == "splat":
        yield "which way is up and how long a unit is are left out: open it with ?up=+z&scale=1"


def _of_colours(scene: Scene, kind: ExportKind) -> Iterator[str]:
    yield "the sky is left out"
    if scene.mapped_cameras:
        yield (
            f"how the recorded colours of {', '.join(scene.mapped_cameras)} differ from the "
            f"scene's (colour maps) is left out"
        )
    waves = sum(actor.color_waves is not None for actor in scene.actors)
    if waves:
        which = "their constant part" if kind == "ply-parts" else "those of that moment"
        yield f"colours of actors ({waves}) that change over time are {which}"
    if kind == "ply-parts" and any(actor.colors_in_world for actor in scene.actors):
        yield (
            "colours of actors by direction are for directions of the world, and viewers turn them "
            "with the actor"
        )
    if kind == "splat":
        yield "colours, opacities and rotations have 8 bits; colours below 0 or above 1 are cut off"
        if any(part.sh_degree > 0 for part in scene.all_gaussians):
            yield "colours do not depend on the direction of view: SH bands above 0 are left out"
        if any(part.semantic is not None for part in scene.all_gaussians):
            yield "semantic classes are left out"


def _of_facts(scene: Scene) -> Iterator[str]:
    if scene.labels is not None:
        yield f"boxes and LiDAR stay with {scene.recorded_source or scene.source}"
    if scene.ground_z_m is not None:
        yield f"the road's height is left out: open it with ?ground_z={scene.ground_z_m:.3f}"
    cameras = [camera for frame in scene.frames for camera in frame.cameras.values()]
    if cameras:
        off = max(
            max(abs(camera.cx - camera.width / 2), abs(camera.cy - camera.height / 2))
            for camera in cameras
        )
        yield "times of images are left out of cameras.json"
        if off >= _SEEN_PX:
            yield (
                f"viewers take the principal points of cameras.json to be in the middle of the "
                f"image; they lie up to {off:.1f} px off"
            )
    if any(camera.is_orthographic for camera in cameras):
        yield "orthographic cameras are left out"
    if scene.made_by:
        yield "how the scene was made (made_by) is left out"


def _moment(scene: Scene, timestamp_ns: int) -> str:
    number = next((f.index for f in scene.frames if f.timestamp_ns == timestamp_ns), None)
    return f"at {timestamp_ns} ns" if number is None else f"in frame {number}"


def _greatest_delay_ns(scene: Scene, timestamp_ns: int) -> int:
    """How far from a frame's own time its cameras took their images; 0 of another time."""
    delays = [
        abs(camera.timestamp_ns - timestamp_ns)
        for frame in scene.frames
        if frame.timestamp_ns == timestamp_ns
        for camera in frame.cameras.values()
    ]
    return max(delays, default=0)
