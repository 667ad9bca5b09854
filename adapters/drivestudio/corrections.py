"""What a run learnt for each image: its colours' affine map and its camera's pose.

Image i of a run is frame * cameras + camera, both counted from 0 as the run has them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from adapters.drivestudio.run import Run
from augment.cameras import Frame
from augment.errors import AdapterError
from augment.files.checkpoints import section, taken, tensor

_POSES = ("CamPosePerturb", "CamPose")  # in the order in which they apply


@dataclass(frozen=True, eq=False)
class ImageCorrections:
    """color_maps: float32 [n, 3, 4] of each image, mean_color_map: [3, 4] of images that were not
    trained on; both None without any. pose_changes: float64 [n, 4, 4], what world_from_camera is
    multiplied by on its right; None for no change.
    """

    color_maps: np.ndarray | None
    mean_color_map: np.ndarray | None
    pose_changes: np.ndarray | None
    problems: tuple[str, ...] = ()

    def camera_from_corrected(self, image: int) -> np.ndarray:
        return np.eye(4) if self.pose_changes is None else self.pose_changes[image]

    def camera_maps(self, run: Run) -> dict[str, torch.Tensor]:
        """Of cameras whose images were not trained on, by name."""
        if self.mean_color_map is None:
            return {}
        names = [run.convention.cameras[number].name for number in run.cameras]
        return {name: torch.from_numpy(self.mean_color_map.copy()) for name in names}

    def image_maps(
        self, run: Run, frames: tuple[Frame, ...]
    ) -> dict[tuple[str, int], torch.Tensor]:
        """Of the images that were trained on, by camera name and time."""
        if self.color_maps is None:
            return {}
        maps = {}
        for frame in frames:
            if run.is_held_out(frame.index):
                continue
            first = (frame.index - run.frames.start) * len(run.cameras)
            for position, number in enumerate(run.cameras):
                name = run.convention.cameras[number].name
                color_map = torch.from_numpy(self.color_maps[first + position].copy())
                maps[name, frame.cameras[name].timestamp_ns] = color_map
        return maps


def read_corrections(models: Mapping[str, Any], run: Run, where: str) -> ImageCorrections:
    """The corrections of a checkpoint's models.

    Raises:
        AdapterError: a tensor is missing, of another shape, or not finite.
    """
    count = len(run.frames) * len(run.cameras)
    maps, mean, problems = None, None, ()
    if "Affine" in models:
        maps, mean, problems = _affine(section(models, "Affine", where), count, f"{where} Affine")
    changes = None
    for name in _POSES:
        if name in models:
            found = _pose_changes(section(models, name, where), count, f"{where} {name}")
            changes = found if changes is None else changes @ found
    return ImageCorrections(maps, mean, changes, problems)


def _affine(
    content: Mapping[str, Any], count: int, where: str
) -> tuple[np.ndarray | None, np.ndarray | None, tuple[str, ...]]:
    embedding = _numbers(content, "embedding.weight", (count, None), where)
    hidden = _numbers(content, "decoder.0.weight", (None, None), where)
    width, inputs = hidden.shape
    if inputs == embedding.shape[1] + 2:
        return (
            *(None, None),
            (
                f"{where}: the colour corrections differ over the image (pixel_affine); they are "
                f"left out, so images have the model's own colours",
            ),
        )
    if inputs != embedding.shape[1]:
        raise AdapterError(
            f"{where}: decoder.0.weight must take the {embedding.shape[1]} numbers of "
            f"embedding.weight; it takes {inputs}"
        )
    hidden_bias = _numbers(content, "decoder.0.bias", (width,), where)
    output = _numbers(content, "decoder.2.weight", (12, width), where)
    output_bias = _numbers(content, "decoder.2.bias", (12,), where)

    def decoded(embedding: np.ndarray) -> np.ndarray:
        values = np.maximum(embedding @ hidden.T + hidden_bias, 0) @ output.T + output_bias
        return (values.reshape(-1, 3, 4) + np.eye(3, 4)).astype(np.float32)

    return decoded(embedding), decoded(embedding.mean(0, keepdims=True))[0], ()


def _pose_changes(content: Mapping[str, Any], count: int, where: str) -> np.ndarray:
    """float64 [n, 4, 4] of 3 numbers of a shift and 6 of a rotation each.

    The 6, of which the identity's were taken off, are its first two rows before Gram and Schmidt
    (Zhou et al. 2019, "On the Continuity of Rotation Representations in Neural Networks", sec. B).
    """
    values = _numbers(content, "embeds.weight", (count, 9), where)
    first = values[:, 3:6] + [1.0, 0, 0]
    second = values[:, 6:9] + [0, 1.0, 0]
    with np.errstate(all="ignore"):
        x = first / np.linalg.norm(first, axis=1, keepdims=True)
        y = second - (x * second).sum(1, keepdims=True) * x
        y = y / np.linalg.norm(y, axis=1, keepdims=True)
    changes = np.tile(np.eye(4), (count, 1, 1))
    changes[:, :3, :3] = np.stack([x, y, np.cross(x, y)], axis=1)
    changes[:, :3, 3] = values[:, :3]
    if not np.isfinite(changes).all():
        raise AdapterError(f"{where}: embeds.weight holds rows that are no rotation")
    return changes


def _numbers(
    content: Mapping[str, Any], name: str, shape: tuple[int | None, ...], where: str
) -> np.ndarray:
    values = taken(tensor(content, name, shape, where)).double().numpy()
    if not np.isfinite(values).all():
        raise AdapterError(f"{where}: {name} holds NaN or infinite numbers")
    return values
