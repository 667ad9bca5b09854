"""Writes scenes as plain splat files: baked at one moment, or part by part; with viewers' cameras.

The command `export` calls it. `export_losses` lists what such files cannot keep. Scales and
opacities are stored as logarithms and logits, so they read back to rounding, not to the bit.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from augment.errors import OutputError, SceneError
from augment.files.formats import ExportKind, SplatKind, splat_writer
from augment.files.ply import write_ply
from augment.files.scene_file import document_text, track_entry
from augment.files.splat_format import SplatWriter
from augment.output.atomic import raise_output_error, write_atomic, write_folder_atomically
from augment.output.names import folder_name
from augment.scene.cameras import Camera
from augment.scene.scene import Gaussians, Scene
from augment.scene.transform import bake_scene

# ---- What an exported file cannot keep of a scene: one sentence each, for people -----------------

_VISIBLE_OFFSET_PX = 0.1  # a smaller offset of the principal point goes unmentioned


def export_losses(
    scene: Scene, kind: ExportKind, timestamp_ns: int | None = None, *, half: bool = False
) -> tuple[str, ...]:
    """List what a file of one kind loses of a scene, and what its users have to know.

    Args:
        scene: the scene.
        kind: the kind of file.
        timestamp_ns: the moment that a splat file shows.
        half: whether a scene file stores float16.

    Returns:
        One sentence a loss.
    """
    if kind in ("scene", "file"):
        return tuple(_saved_losses(scene, kind, half=half))
    is_parts = kind == "ply-parts"
    writer = splat_writer("ply" if kind == "ply-parts" else kind)
    return (
        *(_parts_losses(scene) if is_parts else _moment_losses(scene, timestamp_ns)),
        *_world_losses(scene, writer),
        *_colour_losses(scene, writer, is_parts=is_parts),
        *_fact_losses(scene, writer),
    )


def _saved_losses(scene: Scene, kind: ExportKind, *, half: bool) -> Iterator[str]:
    """Losses of a saved scene: a scene folder or a scene file."""
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


def _parts_losses(scene: Scene) -> Iterator[str]:
    """Losses of files that hold one part each."""
    if any(len(part) == 0 for part in scene.all_gaussians):
        yield "parts without Gaussians have no file"


def _moment_losses(scene: Scene, timestamp_ns: int | None) -> Iterator[str]:
    """Losses of a file that shows one moment."""
    if not scene.actors:
        return
    assert timestamp_ns is not None
    num_actors = sum(actor.track.pose_at(timestamp_ns) is not None for actor in scene.actors)
    number = next((f.index for f in scene.frames if f.timestamp_ns == timestamp_ns), None)
    moment = f"at {timestamp_ns} ns" if number is None else f"in frame {number}"
    yield f"actors ({num_actors}) stand still where they are {moment}"
    if num_actors < len(scene.actors):
        yield f"actors ({len(scene.actors) - num_actors}) that are not there then are left out"
    if delay_ns := _greatest_delay_ns(scene, timestamp_ns):
        yield (
            f"the frame's cameras took their images up to {delay_ns / 1e6:.0f} ms from that "
            f"moment, so that moving actors are a little off in them"
        )


def _world_losses(scene: Scene, writer: SplatWriter) -> Iterator[str]:
    """Losses of the place in the world, of axes, unit and cameras."""
    if not writer.keeps_world_origin and scene.world_origin_m.any():
        place = ", ".join(f"{v:.3f}" for v in scene.world_origin_m)
        yield f"where the scene lies in the dataset's world ({place}) is left out"
    yield from (loss.sentence for loss in writer.world_losses if loss.applies_to(scene))


def _colour_losses(scene: Scene, writer: SplatWriter, *, is_parts: bool) -> Iterator[str]:
    """Losses in colours, sky and classes."""
    yield "the sky is left out"
    if scene.color_mapped_cameras:
        yield (
            f"how the recorded colours of {', '.join(scene.color_mapped_cameras)} differ from the "
            f"scene's (colour maps) is left out"
        )
    waves = sum(actor.color_waves is not None for actor in scene.actors)
    if waves:
        which = "their constant part" if is_parts else "those of that moment"
        yield f"colours of actors ({waves}) that change over time are {which}"
    if is_parts and any(actor.colors_in_world for actor in scene.actors):
        yield (
            "colours of actors by direction are for directions of the world, and viewers turn them "
            "with the actor"
        )
    yield from (loss.sentence for loss in writer.value_losses if loss.applies_to(scene))
    has_classes = any(part.semantic is not None for part in scene.all_gaussians)
    if has_classes and not writer.keeps_classes:
        yield "semantic classes are left out"


def _fact_losses(scene: Scene, writer: SplatWriter) -> Iterator[str]:
    """Losses in labels, cameras and other facts."""
    if scene.labels is not None:
        yield f"boxes and LiDAR stay with {scene.recorded_source or scene.source}"
    if scene.ground_z_m is not None:
        yield f"the road's height is left out: open it with ?ground_z={scene.ground_z_m:.3f}"
    cameras = [camera for frame in scene.frames for camera in frame.cameras.values()]
    if cameras and writer.has_camera_file:
        offset_px = max(
            max(abs(camera.cx - camera.width / 2), abs(camera.cy - camera.height / 2))
            for camera in cameras
        )
        yield "times of images are left out of cameras.json"
        if offset_px >= _VISIBLE_OFFSET_PX:
            yield (
                f"viewers take the principal points of cameras.json to be in the middle of the "
                f"image; they lie up to {offset_px:.1f} px off"
            )
    if cameras and writer.has_camera_file and any(c.lens or c.shutter for c in cameras):
        yield (
            "lenses and rolling shutters are left out of cameras.json, which has pinholes: there "
            "the cameras look the same way with the same focal length"
        )
    if any(camera.is_orthographic for camera in cameras):
        yield "orthographic cameras are left out"
    if scene.made_by:
        yield "how the scene was made (made_by) is left out"


def _greatest_delay_ns(scene: Scene, timestamp_ns: int) -> int:
    """Return the largest time between a frame and its images; 0 at a time without a frame."""
    delays = [
        abs(camera.timestamp_ns - timestamp_ns)
        for frame in scene.frames
        if frame.timestamp_ns == timestamp_ns
        for camera in frame.cameras.values()
    ]
    return max(delays, default=0)


# ---- Files ---------------------------------------------------------------------------------------

BACKGROUND = "background.ply"  # the Gaussians that do not move
CAMERAS = "cameras.json"  # all images' cameras, for viewers
PARTS = "parts.json"  # tracks, labels and sizes of actors
ACTORS = "actors"  # the folder of the actors' .ply files
_FORMAT = "climategs-parts"  # the format that parts.json names
_FORMAT_PATTERN = re.compile(rb'\s*\{\s*"format"\s*:\s*"' + _FORMAT.encode() + rb'"')


def export_splats(
    scene: Scene, path: str | Path, timestamp_ns: int, *, kind: SplatKind = "ply"
) -> None:
    """Write the scene at one moment into a splat file of any format.

    A .ply's comments say `up: +z` where gravity is known, and `unit: metre` where the scale is.

    Args:
        scene: the scene.
        path: the file.
        timestamp_ns: the moment.
        kind: the kind of file.

    Raises:
        SceneError: the scene shows no Gaussians then, or the format cannot hold them.
        OutputError: the file cannot be written.
    """
    gaussians = bake_scene(scene, timestamp_ns)
    if len(gaussians) == 0:
        raise SceneError(f"scene {scene.name!r} shows no Gaussians at {timestamp_ns} ns")
    splat_writer(kind).write(Path(path), gaussians, _notes(scene))


def export_cameras(scene: Scene, folder: str | Path) -> bool:
    """Write `cameras.json` beside splat files; a file that exists stays as it is.

    Returns:
        Whether the folder's cameras.json is now this scene's; a scene without frames has none.
    """
    path = Path(folder) / CAMERAS
    text = inria_cameras(scene)
    if text is None:
        return not path.exists()
    if path.exists():
        try:
            return path.read_bytes() == text
        except OSError:  # a folder, or what may not be read
            return False
    write_atomic(path, text)
    return True


def inria_cameras(scene: Scene) -> bytes | None:
    """Return all images' cameras in the form of INRIA's cameras.json, or None without cameras.

    They are named CAMERA/FRAME. The form has no principal points; they are added as cx and cy.
    """
    views = [
        _camera_entry(camera, frame.index)
        for frame in scene.frames
        for camera in frame.cameras.values()
        if not camera.is_orthographic
    ]
    if not views:
        return None
    rows = ",\n".join(json.dumps({"id": number} | view) for number, view in enumerate(views))
    return f"[\n{rows}\n]\n".encode()


def export_ply_parts(scene: Scene, folder: str | Path) -> None:
    """Write a folder with a .ply of the background and one of every actor, or change nothing.

    It holds background.ply, actors/NAME.ply in each actor's own frame, cameras.json, and parts.json
    with tracks, labels and sizes. Colours that change over time are written as their constant part.
    Parts without Gaussians have no file. An earlier export in the folder is replaced.
    """
    folder = Path(folder).resolve()
    with raise_output_error(folder):
        is_free = not folder.exists() or is_parts_folder(folder)
    if not is_free:
        raise OutputError(
            f"{folder} holds something else than exported parts, so it is not replaced; choose "
            f"another folder"
        )
    with write_folder_atomically(folder, (BACKGROUND, CAMERAS, PARTS, ACTORS)) as new:
        _write_parts(scene, new)


def is_parts_folder(folder: Path) -> bool:
    """Return True for a folder that is empty or holds only files of `export_ply_parts`."""
    if not folder.is_dir():
        return False
    names = {entry.name for entry in folder.iterdir()}
    if not names:
        return True
    if PARTS not in names or not names <= {BACKGROUND, CAMERAS, PARTS, ACTORS}:
        return False
    with (folder / PARTS).open("rb") as file:
        is_parts_file = _FORMAT_PATTERN.match(file.read(200)) is not None
    actors = folder / ACTORS
    return is_parts_file and (
        not actors.is_dir() or all(file.suffix == ".ply" for file in actors.iterdir())
    )


def _write_parts(scene: Scene, folder: Path) -> None:
    """Write the files of `export_ply_parts` into a new folder."""
    notes = _notes(scene)

    def write(gaussians: Gaussians, name: str) -> str | None:
        if len(gaussians) == 0:
            return None
        write_ply(folder / name, gaussians, notes=notes)
        return name

    facts: dict[str, Any] = {
        "format": _FORMAT,
        "version": 1,
        "name": scene.name,
        "world_origin_m": [float(v) for v in scene.world_origin_m],
        "has_metric_scale": bool(scene.has_metric_scale),
        "has_known_gravity": bool(scene.has_known_gravity),
        "background": {"file": write(scene.background, BACKGROUND), "count": len(scene.background)},
        "actors": [
            {
                "file": write(actor.gaussians, f"{ACTORS}/{folder_name(actor.track_id)}.ply"),
                "track_id": actor.track_id,
                "label": actor.label,
                "size_m": [float(v) for v in actor.size_m],
                "count": len(actor.gaussians),
                "track": track_entry(actor.track, f"actor {actor.track_id!r}"),
            }
            for actor in scene.actors
        ],
    }
    if (cameras := inria_cameras(scene)) is not None:
        write_atomic(folder / CAMERAS, cameras)
    write_atomic(folder / PARTS, document_text(facts).encode())


def _notes(scene: Scene) -> dict[str, str]:
    """Return the facts of a scene that splat files keep, by their names in SplatFile.notes."""
    notes = {}
    if scene.has_known_gravity:
        notes["up"] = "+z"
    if scene.has_metric_scale:
        notes["unit"] = "metre"
    if scene.world_origin_m.any():
        notes["world_origin_m"] = " ".join(str(float(v)) for v in scene.world_origin_m)
    return notes


def _camera_entry(camera: Camera, frame: int) -> dict[str, Any]:
    """Return one entry of cameras.json."""
    pose = camera.world_from_camera
    return {
        "img_name": f"{folder_name(camera.name)}/{frame:06d}",
        **{"width": camera.width, "height": camera.height},
        **{"position": pose[:3, 3].tolist(), "rotation": pose[:3, :3].tolist()},
        **{name: getattr(camera, name) for name in ("fx", "fy", "cx", "cy")},
    }
