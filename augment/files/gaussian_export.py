"""Scenes as plain splat files: baked at a moment, or part by part; with cameras for viewers.

`augment.files.export_losses` says what such files cannot keep. Scales and opacities are stored as
logs and logits, so that they read back to rounding, not to the bit.
"""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

from augment.bake import baked
from augment.batch.atomic import output_error, write_atomic
from augment.batch.layout import folder_name
from augment.cameras import Camera
from augment.errors import OutputError, SceneError
from augment.files.atomic_folder import replaced_folder
from augment.files.scene_document import document_text, track_entry
from augment.scene import Gaussians, Scene
from augment.splat_io import write_ply, write_splat

BACKGROUND, CAMERAS, PARTS, ACTORS = "background.ply", "cameras.json", "parts.json", "actors"
_FORMAT = "climategs-parts"
_MARK = re.compile(rb'\s*\{\s*"format"\s*:\s*"' + _FORMAT.encode() + rb'"')


def export_ply(scene: Scene, path: str | Path, timestamp_ns: int) -> None:
    """Write the scene as it is at a moment into an INRIA .ply.

    Its comments say `up: +z` where gravity is known, `unit: metre` where the scale is.

    Raises:
        SceneError: nothing is there at that moment. OutputError: as write_ply.
    """
    write_ply(path, _something(scene, timestamp_ns), notes=_notes(scene))


def export_splat(scene: Scene, path: str | Path, timestamp_ns: int) -> None:
    """Write the scene as it is at a moment into a .splat.

    Raises:
        SceneError: nothing is there at that moment. OutputError: as write_splat.
    """
    gaussians = _something(scene, timestamp_ns)
    write_splat(path, replace(gaussians, sh=gaussians.sh[:, :1]))  # export_losses says so


def export_cameras(scene: Scene, folder: str | Path) -> bool:
    """Write `cameras.json` beside splat files; a file that is there already stays as it is.

    Returns whether the folder's cameras.json is now this scene's; without frames there is none.

    Raises:
        OutputError: the file cannot be written.
    """
    path, text = Path(folder) / CAMERAS, inria_cameras(scene)
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
    """All images' cameras in the form of INRIA's cameras.json, named CAMERA/FRAME; None without.

    Principal points, which the form does not know, stand beside it as cx and cy.
    """
    views = [
        _view(camera, frame.index)
        for frame in scene.frames
        for camera in frame.cameras.values()
        if not camera.is_orthographic
    ]
    if not views:
        return None
    rows = ",\n".join(json.dumps({"id": number} | view) for number, view in enumerate(views))
    return f"[\n{rows}\n]\n".encode()


def export_ply_parts(scene: Scene, folder: str | Path) -> None:
    """Write background.ply, actors/NAME.ply in each actor's own frame, cameras.json, and parts.json
    with tracks, labels and sizes; as a whole or not at all. Colours that change over time are
    written as their constant part. Parts without Gaussians have no file.

    An earlier export in the folder is replaced.

    Raises:
        OutputError: the folder holds something else, or the system refused; what was there is then
            as it was.
    """
    folder = Path(folder).resolve()
    try:
        is_free = not folder.exists() or is_parts_folder(folder)
    except OSError as error:
        raise output_error(folder, error) from error
    if not is_free:
        raise OutputError(
            f"{folder} holds something else than exported parts, so it is not replaced; choose "
            f"another folder"
        )
    with replaced_folder(folder, (BACKGROUND, CAMERAS, PARTS, ACTORS)) as new:
        _write_parts(scene, new)


def is_parts_folder(folder: Path) -> bool:
    """Whether a folder is empty or holds what `export_ply_parts` writes and nothing else."""
    if not folder.is_dir():
        return False
    names = {entry.name for entry in folder.iterdir()}
    if not names:
        return True
    if PARTS not in names or not names <= {BACKGROUND, CAMERAS, PARTS, ACTORS}:
        return False
    with (folder / PARTS).open("rb") as file:
        is_ours = _MARK.match(file.read(200)) is not None
    actors = folder / ACTORS
    return is_ours and (
        not actors.is_dir() or all(file.suffix == ".ply" for file in actors.iterdir())
    )


def _write_parts(scene: Scene, folder: Path) -> None:
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
        "background": {
            "file": write(scene.background, BACKGROUND),
            "count": len(scene.background),
        },
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


def _something(scene: Scene, timestamp_ns: int) -> Gaussians:
    gaussians = baked(scene, timestamp_ns)
    if len(gaussians) == 0:
        raise SceneError(f"scene {scene.name!r} shows no Gaussians at {timestamp_ns} ns")
    return gaussians


def _notes(scene: Scene) -> dict[str, str]:
    notes = {}
    if scene.has_known_gravity:
        notes["up"] = "+z"
    if scene.has_metric_scale:
        notes["unit"] = "metre"
    if scene.world_origin_m.any():
        notes["world_origin_m"] = " ".join(str(float(v)) for v in scene.world_origin_m)
    return notes


def _view(camera: Camera, frame: int) -> dict[str, Any]:
    pose = camera.world_from_camera
    return {
        "img_name": f"{folder_name(camera.name)}/{frame:06d}",
        "width": camera.width,
        "height": camera.height,
        "position": pose[:3, 3].tolist(),
        "rotation": pose[:3, :3].tolist(),
        "fx": camera.fx,
        "fy": camera.fy,
        "cx": camera.cx,
        "cy": camera.cy,
    }
