"""drivestudio runs (OmniRe and its kin: `config.yaml` and `checkpoint_*.pth`) as scenes.

    drivestudio:RUN?data=DIR&checkpoint=NAME&frames=first:stop

Background, rigid objects, the sky, and what was learnt for each image (colours, camera pose) are
read; people and what else deforms is left out, with its count in Scene.problems. World: the
model's, turned until z is up (see adapters.drivestudio.drive). Cameras are those of training:
pinholes of the size that images were scaled to, with their corrected poses.

Differences from the project's own renderer: it clamps each splat's colour, and what the splats
blend to, to at most 1, where here what is brighter stays so until the image is written; and it
draws nothing nearer than its near plane of 0.1 m.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from adapters.drivestudio.actors import identify, make_actors, read_poses
from adapters.drivestudio.corrections import read_corrections
from adapters.drivestudio.drive import model_from_dataset, read_drive, scene_from_model
from adapters.drivestudio.instances import read_instances
from adapters.drivestudio.labels import DriveStudioLabels
from adapters.drivestudio.nodes import BACKGROUND, RIGID, left_out, read_gaussians
from adapters.drivestudio.options import RunOptions
from adapters.drivestudio.run import Run, find_run
from adapters.drivestudio.sky import read_sky
from adapters.uri import format_uri
from adapters.world import WorldChange
from augment.errors import AdapterError
from augment.files.checkpoints import load_checkpoint, section, taken, tensor
from augment.scene import Actor, Scene, check_gaussians


def open_drivestudio(path: str, query: dict[str, str]) -> Scene:
    """The scene of a run's folder, or of a checkpoint in it.

    query: data, checkpoint, frames; see RunOptions. The checkpoint is the final one, else the
    newest.

    Raises:
        AdapterError: a wrong option, a config, checkpoint or calibration that is missing or not the
            project's, or data of another scene. What is left out is in Scene.problems.
        SceneError: no usable Gaussians.
    """
    options = RunOptions.from_query(query)
    run = find_run(Path(path), options)
    numbers = options.select(run.frames, f"drivestudio:{path}")
    content = load_checkpoint(run.checkpoint)
    where = str(run.checkpoint)
    step = content.get("step")
    if type(step) is not int or step < 0:
        raise AdapterError(f"{where}: step must be a number of training steps; got {step!r}")
    models = section(content, "models", where)
    corrections = read_corrections(models, run, where)
    drive = read_drive(run, numbers, corrections)
    sky, about_sky = read_sky(models, scene_from_model(run), where)
    background, about_background = read_gaussians(
        section(models, BACKGROUND, where),
        step=step,
        sh_interval=run.sh_interval(BACKGROUND),
        where=f"{where} {BACKGROUND}",
    )
    background, unusable = check_gaussians(background, where=f"{where} {BACKGROUND}")
    change = WorldChange(rotation=scene_from_model(run))
    actors, about_actors = _actors(models, run, step, where)
    return Scene(
        name=run.folder.absolute().name,
        source=format_uri("drivestudio", path, query),
        background=change.gaussians(background, np.zeros(3)),
        actors=actors,
        sky=sky,
        frames=drive.frames,
        labels=DriveStudioLabels(run),
        color_maps=corrections.camera_maps(run),
        image_color_maps=corrections.image_maps(run, drive.frames),
        problems=(
            *left_out(models, where),
            *about_background,
            *unusable,
            *about_actors,
            *about_sky,
            *corrections.problems,
            *drive.problems,
            *_about_renderer(run),
        ),
        made_by={
            "method": "drivestudio",
            "checkpoint": where,
            "step": step,
            "config": str(run.config_file),
        },
    )


def _actors(
    models: Mapping[str, Any], run: Run, step: int, where: str
) -> tuple[tuple[Actor, ...], tuple[str, ...]]:
    if RIGID not in models:
        return (), ()
    content, where = section(models, RIGID, where), f"{where} {RIGID}"
    gaussians, problems = read_gaussians(
        content, step=step, sh_interval=run.sh_interval(RIGID), where=where
    )
    poses = read_poses(content, run, where)
    ids = tensor(content, "points_ids", (len(gaussians), 1), where, dtype=torch.int64)
    owners = taken(ids)[:, 0].numpy()
    count = poses.visible.shape[1]
    if len(owners) and not 0 <= owners.min() <= owners.max() < count:
        raise AdapterError(
            f"{where}: points_ids must be 0 to {count - 1}, one of the {count} objects; got "
            f"{owners.min()} to {owners.max()}"
        )
    instances = read_instances(run.data)
    identities = identify(poses, instances or (), model_from_dataset(run), run.frames)
    unknown = [f"rigid-{i}" for i, identity in enumerate(identities) if identity is None]
    if unknown:
        reason = "" if instances else f" ({run.data} holds no instances/instances_info.json)"
        problems += (
            f"{where}: which of the data's objects these are could not be told{reason}, so that no "
            f"box is known to be theirs: {', '.join(unknown)}",
        )
    actors, about = make_actors(gaussians, owners, poses, identities, run, where)
    return actors, problems + about


def _about_renderer(run: Run) -> tuple[str, ...]:
    if not run.antialiased:
        return ()
    return (
        f"{run.config_file}: the run was trained with trainer.render.antialiased, which draws "
        f"small splats fainter than they are drawn here; a recipe's render: {{antialiased: true}} "
        f"does the same",
    )
