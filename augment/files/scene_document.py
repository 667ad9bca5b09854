"""scene.json: everything of a saved scene but its arrays, in numbers that read back to the bit."""

from __future__ import annotations

import dataclasses
import json
import os
from typing import Any

import numpy as np
import torch
from torch import Tensor

from augment.cameras import Camera, Frame
from augment.color_waves import ColorWaves
from augment.errors import SceneError
from augment.files.scene_schema import (
    FORMAT,
    VERSION,
    ActorEntry,
    FrameEntry,
    Precision,
    SceneDocument,
    checked_document,
)
from augment.files.scene_tensors import SKY_KINDS, SavedPart
from augment.ground_heights import Ground
from augment.scene import Actor, Scene, Track
from augment.sky import Sky

_LISTS = ("actors", "frames", "problems", "image_color_maps")  # with a line an item
_ROTATION_TOLERANCE = 1e-3  # cameras are held to 1e-4 by their own class


def scene_document(scene: Scene, precision: Precision = "float32") -> dict[str, Any]:
    """The contents of scene.json. Where precision is not float32, made_by says so for good.

    Raises:
        SceneError: the scene has something that the file could not give back.
    """
    kind = SKY_KINDS.get(type(scene.sky))
    if kind is None:
        raise SceneError(
            f"scene {scene.name!r}: a sky of class {type(scene.sky).__name__} cannot be saved; "
            f"only {', '.join(t.__name__ for t in SKY_KINDS)} can"
        )
    document = {
        "format": FORMAT,
        "version": VERSION,
        "precision": precision,
        "name": scene.name,
        "recorded_source": scene.recorded_source or scene.source,
        "working_folder": os.getcwd(),
        "world_origin_m": np.asarray(scene.world_origin_m, np.float64).tolist(),
        "ground_z_m": None if scene.ground_z_m is None else float(scene.ground_z_m),
        "has_metric_scale": bool(scene.has_metric_scale),
        "ground": None if scene.ground is None else dataclasses.asdict(scene.ground),
        "has_known_gravity": bool(scene.has_known_gravity),
        "sky": kind,
        "background_gaussians": len(scene.background),
        "color_maps": {name: matrix.tolist() for name, matrix in scene.color_maps.items()},
        "image_color_maps": [
            {"camera": name, "timestamp_ns": int(timestamp_ns), "rows": matrix.tolist()}
            for (name, timestamp_ns), matrix in scene.image_color_maps.items()
        ],
        "made_by": _json_facts(scene)
        | ({} if precision == "float32" else {"precision": precision}),
        "problems": list(scene.problems),
        "actors": [_actor_entry(actor) for actor in scene.actors],
        "frames": [_frame_entry(frame) for frame in scene.frames],
    }
    checked_document(document, f"scene {scene.name!r}")
    return document


def document_text(document: dict[str, Any]) -> str:
    """JSON with a line a key, and a line an actor, frame, problem or image's colour map."""

    def text(value: Any) -> str:
        return json.dumps(value, ensure_ascii=False, allow_nan=False)

    lines = []
    for key, value in document.items():
        if key in _LISTS and value:
            rows = ",\n".join(f"  {text(item)}" for item in value)
            lines.append(f"{text(key)}: [\n{rows}\n]")
        else:
            lines.append(f"{text(key)}: {text(value)}")
    return "{\n" + ",\n".join(lines) + "\n}\n"


def scene_of(
    document: SceneDocument, parts: list[SavedPart], sky: Sky, *, source: str, where: str
) -> Scene:
    """The scene of a document; parts: background first, then its actors. It has no labels.

    Raises:
        SceneError: poses that are not rigid, times that do not increase, repeated names.
    """
    try:
        actors = tuple(
            _actor(entry, part) for entry, part in zip(document.actors, parts[1:], strict=True)
        )
        frames = tuple(_frame(entry) for entry in document.frames)
        repeated = len(frames) - len({frame.index for frame in frames})
        if repeated:
            raise ValueError(f"{repeated} frame numbers are given twice")
        image_color_maps = {
            (entry.camera, entry.timestamp_ns): torch.tensor(entry.rows, dtype=torch.float32)
            for entry in document.image_color_maps
        }
        repeated = len(document.image_color_maps) - len(image_color_maps)
        if repeated:
            raise ValueError(f"{repeated} images' colour maps are given twice")
        return Scene(
            name=document.name,
            source=source,
            background=parts[0].gaussians,
            actors=actors,
            sky=sky,
            frames=frames,
            world_origin_m=np.array(document.world_origin_m, np.float64),
            ground_z_m=document.ground_z_m,
            has_metric_scale=document.has_metric_scale,
            ground=None if document.ground is None else Ground(**document.ground.model_dump()),
            has_known_gravity=document.has_known_gravity,
            problems=tuple(document.problems),
            color_maps={
                name: torch.tensor(rows, dtype=torch.float32)
                for name, rows in document.color_maps.items()
            },
            image_color_maps=image_color_maps,
            recorded_source=document.recorded_source,
            made_by=document.made_by,
        )
    except ValueError as error:
        raise SceneError(f"{where}: {error}") from error


def track_entry(track: Track, where: str) -> dict[str, Any]:
    """A track as JSON holds it.

    Raises:
        SceneError: poses that are not float64, or not rigid.
    """
    return {
        "hold_ns": int(track.hold_ns),
        "max_gap_ns": None if track.max_gap_ns is None else int(track.max_gap_ns),
        "timestamps_ns": track.timestamps_ns.tolist(),
        "world_from_actor": _rigid_rows(track.world_from_actor, where),
    }


def _actor_entry(actor: Actor) -> dict[str, Any]:
    waves = actor.color_waves
    return {
        "track_id": actor.track_id,
        "label": actor.label,
        "size_m": [float(v) for v in actor.size_m],
        "gaussians": len(actor.gaussians),
        "track": track_entry(actor.track, f"actor {actor.track_id!r}"),
        "color_waves": None
        if waves is None
        else {"timestamps_ns": waves.timestamps_ns.tolist(), "phases": waves.phases.tolist()},
        "colors_in_world": bool(actor.colors_in_world),
    }


def _actor(entry: ActorEntry, part: SavedPart) -> Actor:
    where = f"actor {entry.track_id!r}"
    poses = torch.tensor(entry.track.world_from_actor, dtype=torch.float64).reshape(-1, 4, 4)
    _check_rigid(poses, where)
    length, width, height = entry.size_m
    try:
        times = torch.tensor(entry.track.timestamps_ns, dtype=torch.int64)
        track = Track(times, poses, entry.track.hold_ns, entry.track.max_gap_ns)
        waves = None
        if entry.color_waves is not None:
            assert part.waves is not None
            times = torch.tensor(entry.color_waves.timestamps_ns, dtype=torch.int64)
            phases = torch.tensor(entry.color_waves.phases, dtype=torch.float64)
            waves = ColorWaves(part.waves, times, phases)
    except ValueError as error:
        raise ValueError(f"{where}: {error}") from error
    size_m = (length, width, height)
    return Actor(
        entry.track_id, entry.label, part.gaussians, track, size_m, waves, entry.colors_in_world
    )


def _frame_entry(frame: Frame) -> dict[str, Any]:
    where = f"frame {frame.index}"
    wrong = [name for name, camera in frame.cameras.items() if camera.name != name]
    if wrong:
        raise SceneError(f"{where}: cameras must stand under their own names; {wrong} do not")
    return {
        "index": int(frame.index),
        "timestamp_ns": int(frame.timestamp_ns),
        "world_from_ego": _rigid_rows(frame.world_from_ego, where),
        "cameras": {name: _camera_entry(camera) for name, camera in frame.cameras.items()},
        "image_paths": {name: os.path.abspath(path) for name, path in frame.image_paths.items()},
    }


def _camera_entry(camera: Camera) -> dict[str, Any]:
    return {
        "width": int(camera.width),
        "height": int(camera.height),
        **{name: float(getattr(camera, name)) for name in ("fx", "fy", "cx", "cy")},
        "timestamp_ns": int(camera.timestamp_ns),
        "camera_from_world": _rigid_rows(camera.camera_from_world, f"camera {camera.name!r}"),
        **({"is_orthographic": True} if camera.is_orthographic else {}),
    }


def _frame(entry: FrameEntry) -> Frame:
    where = f"frame {entry.index}"
    world_from_ego = torch.tensor(entry.world_from_ego, dtype=torch.float64)
    _check_rigid(world_from_ego, where)
    cameras = {}
    for name, camera in entry.cameras.items():
        pose = torch.tensor(camera.camera_from_world, dtype=torch.float64)
        _check_rigid(pose, f"{where}, camera {name!r}")
        numbers = camera.model_dump(exclude={"camera_from_world"})
        cameras[name] = Camera(name=name, camera_from_world=pose, **numbers)
    return Frame(entry.index, entry.timestamp_ns, world_from_ego, cameras, entry.image_paths)


def _rigid_rows(transforms: Tensor, where: str) -> list:
    if transforms.dtype != torch.float64:
        raise SceneError(f"{where}: poses must be float64; got {transforms.dtype}")
    try:
        _check_rigid(transforms, where)
    except ValueError as error:
        raise SceneError(str(error)) from error
    return transforms.tolist()


def _check_rigid(transforms: Tensor, where: str) -> None:
    """ValueError unless [.., 4, 4] are rotations and translations."""
    poses = transforms.detach().numpy()  # torch would wake its threads for a few numbers
    rotation = poses[..., :3, :3]
    with np.errstate(all="ignore"):  # of numbers so large that their products overflow
        error = np.abs(rotation @ np.swapaxes(rotation, -1, -2) - np.eye(3))
        determinant = np.linalg.det(rotation)
    is_rotation = (error < _ROTATION_TOLERANCE).all() and (determinant > 0).all()
    has_last_row = (poses[..., 3, :] == np.eye(4)[3]).all()
    if not (np.isfinite(poses).all() and is_rotation and has_last_row):
        raise ValueError(
            f"{where}: a pose must be a rotation and a translation with 0 0 0 1 in its last row"
        )


def _json_facts(scene: Scene) -> dict[str, Any]:
    try:
        text = json.dumps(dict(scene.made_by), allow_nan=False, ensure_ascii=False)
        return json.loads(text.encode())  # unpaired surrogates cannot be written
    except (TypeError, ValueError) as error:
        raise SceneError(
            f"scene {scene.name!r}: made_by must hold JSON's own types and finite numbers: {error}"
        ) from error
