"""Tables of a trained model beside its Gaussians: poses, sky, colour and pose correction."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from adapters.street_gaussians.poses import PoseChanges, rotations_of
from adapters.street_gaussians.records import ModelConfig
from augment.errors import AdapterError
from augment.files.checkpoints import section, taken, tensor

_ACTOR = re.compile(r"obj_(\d{3,9})")


def actor_id(name: str) -> int | None:
    """The track id in a part's name, such as obj_003; None for other names."""
    match = _ACTOR.fullmatch(name)
    number = int(match[1]) if match else None
    return number if number is not None and name == f"obj_{number:03d}" else None


class Parameters:
    """Networks and tables of a checkpoint beside its Gaussians, with sentences about them."""

    def __init__(self, content: Mapping[str, Any], path: Path, problems: list[str]) -> None:
        self.path, self.problems = path, problems
        self._content = content
        self._seen = {"background", "iter"}

    def skip(self, name: str) -> None:
        """Say that an entry is known."""
        self._seen.add(name)

    def of(self, name: str, key: str, is_used: bool) -> Mapping[str, Any] | None:
        """The table `params` of an entry. key: what in the configuration says that it is used.

        Raises:
            AdapterError: it is used but not there.
        """
        self._seen.add(name)
        if not is_used:
            if self._content.get(name):
                self.problems.append(
                    f"{self.path}: {name} is left out, as the configuration has not {key}"
                )
            return None
        if name not in self._content:
            raise AdapterError(
                f"{self.path} lacks {name!r}, although the configuration has {key}; it holds "
                f"{', '.join(map(str, list(self._content)[:12]))}. Copy the model and its "
                f"configs/ from the same training"
            )
        entry = section(self._content, name, str(self.path))
        return section(entry, "params", f"{self.path}, {name}")

    def numbers(
        self, params: Mapping[str, Any], name: str, key: str, shape: Sequence[int | None]
    ) -> np.ndarray:
        """A small table, float64.

        Raises:
            AdapterError: missing, of another shape, or not finite.
        """
        where = f"{self.path}, {name}.params"
        found = tensor(params, key, shape, where).double().numpy()
        if not np.isfinite(found).all():
            raise AdapterError(f"{where}: {key} holds NaN or infinite numbers")
        return found

    def report_unknown(self) -> None:
        names = [name for name in self._content if name not in self._seen]
        names = [str(name) for name in names if actor_id(str(name)) is None]
        if names:
            self.problems.append(
                f"{self.path} also holds {', '.join(names[:8])}, which is not used: expected "
                f"background, obj_000 ..., actor_pose, sky_cubemap, color_correction, "
                f"pose_correction and iter"
            )


def read_pose_changes(
    parameters: Parameters, config: ModelConfig, *, has_actors: bool
) -> PoseChanges | None:
    """What training added to the actors' poses; None where it left them.

    Raises:
        AdapterError: as Parameters.
    """
    if not has_actors:
        parameters.skip("actor_pose")
        return None
    params = parameters.of("actor_pose", "model.nsg.opt_track", config.opt_track)
    if params is None:
        return None
    positions = parameters.numbers(params, "actor_pose", "opt_trans", (None, None, 3))
    shape = (*positions.shape[:2], 1)
    half_turns = parameters.numbers(params, "actor_pose", "opt_rots", shape)
    return PoseChanges(positions, half_turns[..., 0])


def read_sky(parameters: Parameters, config: ModelConfig) -> Tensor | None:
    """Faces of the sky, float32 [6, R, R, 3] in [0, 1]; None where there is none that can be used.

    The project clamps what it looks up; clamped texels are the same but between texels of which
    only some are out of range.

    Raises:
        AdapterError: as Parameters.
    """
    params = parameters.of("sky_cubemap", "model.nsg.include_sky", config.include_sky)
    if params is None:
        return None
    where = f"{parameters.path}, sky_cubemap.params"
    if any(str(key) == "sky_codebook" or str(key).startswith("mlp_shader") for key in params):
        parameters.problems.append(
            f"{where}: a sky made of a codebook and a network is not supported; the sky has the "
            f"background's colour instead"
        )
        return None
    faces = tensor(params, "sky_cube_map", (6, None, None, 3), where)
    if faces.shape[1] != faces.shape[2] or faces.shape[1] == 0:
        raise AdapterError(
            f"{where}: sky_cube_map must be float32 [6, R, R, 3]; got {list(faces.shape)}"
        )
    own = torch.empty(faces.shape)
    for face in range(6):
        taken(faces[face], own[face])
    lowest, highest = own.numpy().min(), own.numpy().max()
    if not np.isfinite([lowest, highest]).all():
        raise AdapterError(f"{where}: sky_cube_map holds NaN or infinite numbers")
    return own.clamp_(0, 1)


def read_color_maps(parameters: Parameters, config: ModelConfig) -> Tensor | None:
    """Colour maps float32 [n, 3, 4]; None where there are none that can be used.

    Raises:
        AdapterError: as Parameters.
    """
    name = "color_correction"
    params = parameters.of(name, "model.use_color_correction", config.use_color_correction)
    if params is None:
        return None
    if config.color_correction_mlp or any(str(k).startswith("affine_trans.") for k in params):
        parameters.problems.append(
            f"{parameters.path}, {name}: colour correction by a network is not supported and left "
            f"out; images have the scene's own colours"
        )
        return None
    return torch.from_numpy(
        parameters.numbers(params, name, "affine_trans", (None, 3, 4)).astype(np.float32)
    )


def read_camera_changes(parameters: Parameters, config: ModelConfig) -> np.ndarray | None:
    """What the background is moved by before an image is taken, float64 [n, 4, 4].

    Raises:
        AdapterError: as Parameters.
    """
    name = "pose_correction"
    params = parameters.of(name, "model.use_pose_correction", config.use_pose_correction)
    if params is None:
        return None
    centres = parameters.numbers(params, name, "pose_correction_trans", (None, 3))
    quats = parameters.numbers(params, name, "pose_correction_rots", (len(centres), 4))
    if (np.linalg.norm(quats, axis=1) == 0).any():
        raise AdapterError(
            f"{parameters.path}, {name}.params: pose_correction_rots holds a quaternion of zeros"
        )
    changes = np.tile(np.eye(4), (len(centres), 1, 1))
    changes[:, :3, :3] = rotations_of(quats)
    changes[:, :3, 3] = centres
    return changes
