"""Trained Street Gaussians models as scenes.

    street_gaussians:MODEL?data=DIR&iteration=N&weights=pth&width=1600&frames=0:50&rotation_bug=1

Neither training images nor COLMAP nor CUDA are needed; the dataset's folder is, for the cameras'
and actors' poses. World: the dataset's, minus the mean position of the car. Cameras are those of
the project's renders: at most `width` pixels wide, without distortion. The dataset's folder alone
opens as a raw drive.

Where pictures differ from the project's: colours above 1 are not cut before the sky and the colour
map; with a pose correction the sky turns with the background, by the fraction of a degree that
corrections have.

rotation_bug=1 turns actors as an older release of the project did, which models that were trained
with that release have learnt to live with.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import torch

from adapters.street_gaussians.actors import ActorSettings, make_actor
from adapters.street_gaussians.corrections import (
    CameraChanges,
    camera_changes,
    color_maps,
    moved_camera,
)
from adapters.street_gaussians.data import frames_of, read_data
from adapters.street_gaussians.labels import labels_of
from adapters.street_gaussians.model import TrainedModel, read_checkpoint
from adapters.street_gaussians.model_files import ModelFiles, find_data, find_model, is_dataset
from adapters.street_gaussians.model_ply import read_point_cloud
from adapters.street_gaussians.options import SCHEME, ModelOptions
from adapters.street_gaussians.poses import check_changes
from adapters.street_gaussians.raw import open_raw
from adapters.street_gaussians.records import StreetData
from adapters.uri import format_uri
from augment.cameras import Camera, Frame
from augment.labels import LabelSource
from augment.scene import Actor, Scene
from augment.sky import ConstantSky, CubemapSky, Sky


def open_street_gaussians(path: str, query: dict[str, str]) -> Scene:
    """The scene of a trained model, or of a dataset's folder.

    path: a model's folder, a .pth or .ply in it, or a dataset's folder. query: see ModelOptions; of
    a dataset: see open_raw.

    Raises:
        AdapterError: a wrong option, or a file that is missing, damaged, of another version, or
            does not belong to the others; names file and key.
    """
    if is_dataset(Path(path)):
        return open_raw(Path(path), query)
    options = ModelOptions.from_query(query)
    files = find_model(Path(path), options)
    data = read_data(files.data, files.config)
    recorded = frames_of(data)
    chosen = options.frames.select([f.index for f in recorded], where=f"{SCHEME}:{path}")
    model = _read_model(files)
    if model.pose_changes is not None:
        check_changes(model.pose_changes, data, str(model.file))
    changes = camera_changes(model.camera_changes, data, files.config, str(model.file))
    maps = color_maps(model.color_maps, data, files.config, str(model.file))
    recorded = [frame for frame in recorded if frame.index in chosen.numbers]
    frames = _with_model_cameras(recorded, data, changes, options.width)
    settings = ActorSettings.of(files.config, rotation_bug=options.rotation_bug)
    actors, problems = _actors(data, model, changes, settings)
    moments = {(c.name, c.timestamp_ns) for frame in frames for c in frame.cameras.values()}
    return Scene(
        name=files.folder.resolve().name,
        source=format_uri(SCHEME, path, query),
        background=model.background.gaussians,
        actors=actors,
        sky=_sky(model, white=files.config.white_background),
        frames=frames,
        labels=labels_of(files.data),
        world_origin_m=data.world_origin_m,
        problems=(*data.problems, *chosen.problems, *model.problems, *problems),
        color_maps=maps.by_camera,
        image_color_maps={k: v for k, v in maps.by_image.items() if k in moments},
        recorded_source=format_uri(SCHEME, files.data, {}),
        made_by=_facts(files),
    )


def street_gaussians_labels(path: str, query: dict[str, str]) -> LabelSource | None:
    """The labels alone, of a dataset's folder or of a model's dataset.

    Raises:
        AdapterError: as open_street_gaussians.
    """
    if is_dataset(Path(path)):
        return labels_of(Path(path))
    return labels_of(find_data(Path(path), ModelOptions.from_query(query)))


def _read_model(files: ModelFiles) -> TrainedModel:
    read = read_checkpoint if files.weights.suffix.lower() == ".pth" else read_point_cloud
    return read(files.weights, files.config)


def _actors(
    data: StreetData, model: TrainedModel, changes: CameraChanges, settings: ActorSettings
) -> tuple[tuple[Actor, ...], Sequence[str]]:
    """Actors in the order in which their objects appear, and sentences."""
    actors, problems = [], []
    for tracked in data.objects:
        part = model.actors.get(tracked.track_id)
        if part is None:
            problems.append(
                f"the {tracked.label} obj_{tracked.track_id:03d} of the tracks has no Gaussians in "
                f"{model.file} and is left out"
            )
            continue
        actor, found = make_actor(data, tracked, part, model.pose_changes, changes, settings)
        problems += found
        if actor is not None:
            actors.append(actor)
    known = {tracked.track_id for tracked in data.objects}
    problems += [
        f"{model.file}: obj_{number:03d} has no track among the moving objects of {data.root} and "
        f"is left out"
        for number in model.actors
        if number not in known
    ]
    return tuple(actors), problems


def _sky(model: TrainedModel, *, white: bool) -> Sky:
    if model.sky is not None:
        return CubemapSky(model.sky)
    return ConstantSky(torch.full((3,), float(white)))


def _with_model_cameras(
    frames: Sequence[Frame], data: StreetData, changes: CameraChanges, width: int
) -> tuple[Frame, ...]:
    """Frames with the cameras that the model renders in place of those that recorded."""
    images = {(image.frame, image.name): image for image in data.images}
    return tuple(
        dataclasses.replace(
            frame,
            cameras={
                name: dataclasses.replace(
                    _capped(camera, width),
                    camera_from_world=moved_camera(
                        camera.camera_from_world, changes.of(images[frame.index, name])
                    ),
                )
                for name, camera in frame.cameras.items()
            },
        )
        for frame in frames
    )


def _capped(camera: Camera, width: int) -> Camera:
    """The camera at most so wide, as the project renders it: the scale is one for both axes, and
    what is left of a row below the last whole one is cut off.
    """
    if width == 0 or camera.width <= width:
        return camera
    scale = camera.width / width
    return dataclasses.replace(
        camera,
        width=width,
        height=max(1, int(camera.height / scale)),
        fx=camera.fx / scale,
        fy=camera.fy / scale,
        cx=camera.cx / scale,
        cy=camera.cy / scale,
    )


def _facts(files: ModelFiles) -> dict[str, object]:
    return {
        "method": "Street Gaussians",
        "weights": str(files.weights),
        "iteration": files.iteration,
        "config": str(files.config_file),
    }
