"""What a trained model holds, read from trained_model/iteration_N.pth."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from adapters.street_gaussians.parameters import (
    Parameters,
    actor_id,
    read_camera_changes,
    read_color_maps,
    read_pose_changes,
    read_sky,
)
from adapters.street_gaussians.parts import Part, allocate, check_counts, finish_part
from adapters.street_gaussians.poses import PoseChanges
from adapters.street_gaussians.records import ModelConfig
from augment.errors import AdapterError
from augment.files.checkpoints import load_checkpoint, release, section, taken, tensor

_TENSORS = ("xyz", "feature_dc", "feature_rest", "scaling", "rotation", "opacity", "semantic")
_TRAINING = (
    "spatial_lr_scale", "denom", "max_radii2D", "xyz_gradient_accum", "active_sh_degree",
    "optimizer",
)  # fmt: skip
_PIECE = 1 << 18  # numbers copied at a time


@dataclass(frozen=True, eq=False)
class TrainedModel:
    """A model as its file has it. None and empty stand for what it lacks or what is not used.

    actors: by track id. sky: faces of a cube map, float32 [6, R, R, 3]. color_maps: float32
    [n, 3, 4]. camera_changes: float64 [n, 4, 4], rigid: what the background is moved by. problems:
    a sentence each.
    """

    file: Path
    background: Part
    actors: Mapping[int, Part]
    pose_changes: PoseChanges | None = None
    sky: Tensor | None = None
    color_maps: Tensor | None = None
    camera_changes: np.ndarray | None = None
    problems: Sequence[str] = ()


def read_checkpoint(path: Path, config: ModelConfig) -> TrainedModel:
    """Read a .pth. Nothing in it is run; the optimiser's state is not looked at.

    Raises:
        AdapterError: not such a file, damaged, or lacking what the configuration says was trained.
    """
    content = load_checkpoint(path)
    if "background" not in content:
        keys = ", ".join(map(str, list(content)[:12])) or "nothing"
        raise AdapterError(
            f"{path} lacks 'background', so it is no Street Gaussians model of a known version; it "
            f"holds {keys}. Expected background, obj_000 ..., actor_pose, sky_cubemap"
        )
    problems: list[str] = []
    background, found = _read_part(section(content, "background", str(path)), path, "background")
    problems += found
    actors = {}
    for name in content:
        number = actor_id(name) if isinstance(name, str) else None
        if number is None:
            continue
        part, found = _read_part(section(content, name, str(path)), path, name)
        problems += found
        if part is not None:
            actors[number] = part
    assert background is not None
    parameters = Parameters(content, path, problems)
    model = TrainedModel(
        file=path,
        background=background,
        actors=actors,
        pose_changes=read_pose_changes(parameters, config, has_actors=bool(actors)),
        sky=read_sky(parameters, config),
        color_maps=read_color_maps(parameters, config),
        camera_changes=read_camera_changes(parameters, config),
        problems=problems,
    )
    parameters.report_unknown()
    return model


def _read_part(content: Mapping[str, Any], path: Path, name: str) -> tuple[Part | None, list[str]]:
    """A part, None for an actor without usable Gaussians, and sentences."""
    where = f"{path}, {name}"
    means = tensor(content, "xyz", (None, 3), where)
    count = len(means)
    colours = tensor(content, "feature_dc", (count, None, 3), where)
    rest = tensor(content, "feature_rest", (count, None, 3), where)
    sources = {"means": means}
    for key, own, columns in (("scaling", "scales", 3), ("rotation", "quats", 4)):
        sources[own] = tensor(content, key, (count, columns), where)
    logits = tensor(content, "opacity", (count, 1), where)
    is_background = name == "background"
    check_counts(where, rest.shape[1], colours.shape[1], is_background=is_background)
    problems = _doubts(content, where)
    if count == 0 and not is_background:
        return None, [*problems, f"{where}: it has no Gaussians and is left out"]
    arrays, terms = allocate(count, 1 + rest.shape[1], colours.shape[1])
    for own, source in sources.items():
        taken(source, arrays[own])
    taken(logits, arrays["opacities"][:, None])
    _split(colours, arrays["sh"][:, :1], terms)
    _split(rest, arrays["sh"][:, 1:], None)
    try:
        part, found = finish_part(arrays, terms, where)
    except AdapterError as error:
        if is_background:
            raise
        return None, [*problems, f"{error} It is left out"]
    return part, [*problems, *found]


def _doubts(content: Mapping[str, Any], where: str) -> list[str]:
    semantic = content.get("semantic")
    problems = []
    if isinstance(semantic, Tensor) and semantic.dim() == 2 and semantic.shape[1] > 0:
        problems.append(f"{where}: its semantic features are not used")
    unknown = [str(key) for key in content if key not in (*_TENSORS, *_TRAINING)]
    if unknown:
        problems.append(f"{where}: it also holds {', '.join(unknown[:8])}, which is not used")
    return problems


def _split(source: Tensor, first: Tensor, further: Tensor | None) -> None:
    """Copy [N, T, 3] into two, memory given back as it goes. first takes as many as fit."""
    count = first.shape[1]
    rows = max(1, _PIECE // max(1, source[:1].numel()))
    for start in range(0, len(source), rows):
        piece = source[start : start + rows]
        first[start : start + rows] = piece[:, :count]
        if further is not None:
            further[start : start + rows] = piece[:, count:]
        if piece.is_contiguous():
            release(piece)
