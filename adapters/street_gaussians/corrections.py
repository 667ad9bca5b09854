"""What a model learnt for single images or cameras: colour maps and moved cameras."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from adapters.street_gaussians.records import CAMERA_NAMES, ModelConfig, StreetData, StreetImage
from augment.errors import AdapterError


@dataclass(frozen=True, eq=False)
class CameraChanges:
    """What the background is moved by before an image is taken.

    changes: float64 [n, 4, 4], rigid. rows: of every image's, by frame and camera.
    """

    changes: np.ndarray = field(default_factory=lambda: np.eye(4)[None])
    rows: Mapping[tuple[int, int], int] = field(default_factory=dict)

    def row(self, image: StreetImage) -> int:
        return self.rows.get((image.frame, image.cam), 0)

    def of(self, image: StreetImage) -> np.ndarray:
        return self.changes[self.row(image)]

    @cached_property
    def inverses(self) -> np.ndarray:
        return np.linalg.inv(self.changes)


def camera_changes(
    changes: np.ndarray | None, data: StreetData, config: ModelConfig, where: str
) -> CameraChanges:
    """The pose correction of every image; without any, cameras stay where they are.

    Raises:
        AdapterError: another number than of images or frames.
    """
    if changes is None:
        return CameraChanges()
    frames = {frame: row for row, frame in enumerate(data.frames)}
    by_image = config.pose_correction_mode == "image"
    rows = {
        (image.frame, image.cam): image.number if by_image else frames[image.frame]
        for image in data.images
    }
    expected = _image_count(data, config) if by_image else len(data.frames)
    _check_count(
        len(changes), expected, f"{where}, pose_correction", config.pose_correction_mode, data
    )
    return CameraChanges(changes, rows)


@dataclass(frozen=True, eq=False)
class ColorMaps:
    """As Scene.color_maps and Scene.image_color_maps."""

    by_camera: Mapping[str, Tensor] = field(default_factory=dict)
    by_image: Mapping[tuple[str, int], Tensor] = field(default_factory=dict)


def color_maps(maps: Tensor | None, data: StreetData, config: ModelConfig, where: str) -> ColorMaps:
    """The colour correction, applied after the sky: of cameras, or of images, whose cameras then
    have the mean of those that were trained on for other views.

    Raises:
        AdapterError: another number than of images or cameras.
    """
    if maps is None:
        return ColorMaps()
    mode, where = config.color_correction_mode, f"{where}, color_correction"
    if mode == "sensor":
        cams = sorted({image.cam for image in data.images})
        _check_count(len(maps), len(config.cameras), where, mode, data)
        if cams[-1] >= len(maps):
            raise AdapterError(
                f"{where}: affine_trans has maps of cameras 0 to {len(maps) - 1}, but the "
                f"configuration's data.cameras has {list(config.cameras)}"
            )
        return ColorMaps({CAMERA_NAMES[cam]: maps[cam].clone() for cam in cams})
    _check_count(len(maps), _image_count(data, config), where, mode, data)
    by_camera = {}
    for name in dict.fromkeys(image.name for image in data.images):
        own = [image for image in data.images if image.name == name]
        trained = [image.number for image in own if not image.is_held_out]
        chosen = trained or [image.number for image in own]
        by_camera[name] = maps[chosen].mean(0)
    by_image = {(i.name, i.timestamp_ns): maps[i.number].clone() for i in data.images}
    return ColorMaps(by_camera, by_image)


def _image_count(data: StreetData, config: ModelConfig) -> int:
    return len(data.frames) * len(config.cameras)


def _check_count(found: int, expected: int, where: str, mode: str, data: StreetData) -> None:
    if found != expected:
        raise AdapterError(
            f"{where} has {found} entries; with mode {mode!r} and the dataset {data.root} it must "
            f"have {expected}. The number follows from data.cameras and data.selected_frames of "
            f"the configuration: give the data and the configs/ that the model was trained with"
        )


def moved_camera(camera_from_world: Tensor, change: np.ndarray) -> Tensor:
    """camera_from_world of a camera that sees the background where the change moves it."""
    return camera_from_world @ torch.from_numpy(np.ascontiguousarray(change))
