"""scene.json: everything of a scene folder but its arrays, in numbers that read back to the bit."""

from __future__ import annotations

import dataclasses
import json
import os
from typing import Any

import numpy as np
import torch
from torch import Tensor

from augment.cameras import Camera, Frame
from augment.errors import SceneError
from augment.ground_heights import Ground
from augment.scene import Actor, Gaussians, Scene, Track
from augment.scene_schema import (
    FORMAT,
    VERSION,
    ActorEntry,
    FrameEntry,
    SceneDocument,
    checked_document,
)
from augment.sky import ConstantSky, CubemapSky, LatLongSky, Sky

SKY_KINDS: dict[type, str] = {ConstantSky: "constant", LatLongSky: "latlong", CubemapSky: "cubemap"}
_ROTATION_TOLERANCE = 1e-3  # cameras are held to 1e-4 by their own class


def scene_document(scene: Scene) -> dict[str, Any]:
    """The contents of scene.json.

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
        "made_by": _json_facts(scene),
        "problems": list(scene.problems),
        "actors": [_actor_entry(actor) for actor in scene.actors],
        "frames": [_frame_entry(frame) for frame in scene.frames],
    }
    checked_document(document, f"scene {scene.name!r}")
    return document


def document_text(document: dict[str, Any]) -> str:
    """JSON with a line a key, and a line an actor, frame or problem."""

    def text(value: Any) -> str:
        return json.dumps(value, ensure_ascii=False, allow_nan=False)

    lines = []
    for key, value in document.items():
        if key in ("actors", "frames", "problems") and value:
            rows = ",\n".join(f"  {text(item)}" for item in value)
            lines.append(f"{text(key)}: [\n{rows}\n]")
        else:
            lines.append(f"{text(key)}: {text(value)}")
    return "{\n" + ",\n".join(lines) + "\n}\n"


def scene_of(
    document: SceneDocument, parts: list[Gaussians], sky: Sky, *, source: str, where: str
) -> Scene:
    """The scene of a document; parts: background first, then its actors. It has no labels.

    Raises:
        SceneError: poses that are not rigid, times that do not increase, repeated names.
    """
    try:
        actors = tuple(
            _actor(entry, gaussians)
            for entry, gaussians in zip(document.actors, parts[1:], strict=True)
        )
        frames = tuple(_frame(entry) for entry in document.frames)
        repeated = len(frames) - len({frame.index for frame in frames})
        if repeated:
            raise ValueError(f"{repeated} frame numbers are given twice")
        return Scene(
            name=document.name,
            source=source,
            background=parts[0],
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
            recorded_source=document.recorded_source,
            made_by=document.made_by,
        )
    except ValueError as error:
        raise SceneError(f"{where}: {error}") from error


def _actor_entry(actor: Actor) -> dict[str, Any]:
    return {
        "track_id": actor.track_id,
        "label": actor.label,
        "size_m": [float(v) for v in actor.size_m],
        "gaussians": len(actor.gaussians),
        "track": {
            "hold_ns": int(actor.track.hold_ns),
            "timestamps_ns": actor.track.timestamps_ns.tolist(),
            "world_from_actor": _rigid_rows(
                actor.track.world_from_actor, f"actor {actor.track_id!r}"
            ),
        },
    }


def _actor(entry: ActorEntry, gaussians: Gaussians) -> Actor:
    where = f"actor {entry.track_id!r}"
    poses = torch.tensor(entry.track.world_from_actor, dtype=torch.float64).reshape(-1, 4, 4)
    _check_rigid(poses, where)
    length, width, height = entry.size_m
    try:
        times = torch.tensor(entry.track.timestamps_ns, dtype=torch.int64)
        track = Track(times, poses, entry.track.hold_ns)
    except ValueError as error:
        raise ValueError(f"{where}: {error}") from error
    return Actor(entry.track_id, entry.label, gaussians, track, (length, width, height))


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
        return json.loads(json.dumps(dict(scene.made_by), allow_nan=False))
    except (TypeError, ValueError) as error:
        raise SceneError(
            f"scene {scene.name!r}: made_by must hold JSON's own types and finite numbers: {error}"
        ) from error
