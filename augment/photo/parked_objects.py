"""Splats of vehicles that stand still, as parts of their own.

In: the posed parts of a view, whose background holds parked vehicles, and their labelled boxes.
Out: `ObjectParts`, the splats of each vehicle near the camera and of the snow on it, and the
background without them. With these, `photo_objects` ends parked vehicles where the photo shows
their edges, as it does with moving ones, and closes the gaps between their splats.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float64, Int64

from augment.render.cpu.order import cached_of_tensor
from augment.scene.cameras import Camera
from augment.scene.scene import Gaussians, PosedGaussians
from augment.scene.semantics import SemanticClass

# Distance of a vehicle's centre from the camera up to which its outline is moved, metres.
MAX_DISTANCE_M = 12.0
# Distance beyond the sides of a box in which splats are the vehicle's, metres: mirrors, and discs
# of some centimetres.
SIDE_MARGIN_M = 0.15
# Height of a box's lowest part, in which splats are the ground's, metres.
BOTTOM_MARGIN_M = 0.1
# Height above a box up to which splats are the vehicle's, metres.
TOP_MARGIN_M = 0.15
# The same of snow that lies on the vehicle.
TOP_MARGIN_OF_SNOW_M = 0.7
# Height of a box's part in which snow lies on the ground, metres.
BOTTOM_MARGIN_OF_SNOW_M = 0.5
# Fewest splats of a vehicle whose outline is moved.
MIN_SPLATS = 60
# Classes of splats in a vehicle's box that are not the vehicle.
OTHER_CLASSES = (
    SemanticClass.ROAD,
    SemanticClass.LANE_MARKING,
    SemanticClass.SIDEWALK,
    SemanticClass.TERRAIN,
    SemanticClass.VEGETATION,
    SemanticClass.BUILDING,
    SemanticClass.POLE,
    SemanticClass.SIGN,
    SemanticClass.PEDESTRIAN,
)


@dataclass(frozen=True, eq=False)
class ObjectBox:
    """Box of an object that stands still."""

    centre_m: Float64[np.ndarray, "3"]
    """Its centre in the world."""
    rotation: Float64[np.ndarray, "3 3"]
    """world_from_box; x forward, y left, z up."""
    size_m: tuple[float, float, float]
    """Length, width and height."""

    def is_near(self, camera: Camera) -> bool:
        """Return True if the object may be in view, and is near the camera."""
        x, _, z = camera.camera_from_world.numpy()[:3] @ np.append(self.centre_m, 1.0)
        reach_m = float(np.hypot(*self.size_m[:2])) / 2
        half_width = max(camera.cx, camera.width - camera.cx) / camera.fx
        distance_m = float(np.linalg.norm(self.centre_m - camera.centre.numpy()))
        is_in_view = abs(x) - half_width * z < reach_m * np.hypot(1, half_width)
        return bool(distance_m <= MAX_DISTANCE_M and z > -reach_m and is_in_view)

    def rows_in(self, gaussians: Gaussians, *, is_overlay: bool) -> Int64[np.ndarray, " R"]:
        """Return the rows of the Gaussians that are the object's, or lie on it.

        Args:
            gaussians: Gaussians in the world.
            is_overlay: True for those of snow.
        """
        means = gaussians.means.detach().cpu().numpy()
        half_m = np.array(self.size_m) / 2 + [SIDE_MARGIN_M, SIDE_MARGIN_M, 0]
        reach_m = np.abs(self.rotation[:2, :2]) @ half_m[:2]
        is_close = np.abs(means[:, 0] - self.centre_m[0]) <= reach_m[0]
        rows = np.flatnonzero(is_close)
        rows = rows[np.abs(means[rows, 1] - self.centre_m[1]) <= reach_m[1]]
        local = (means[rows].astype(np.float64) - self.centre_m) @ self.rotation
        lowest_m = BOTTOM_MARGIN_OF_SNOW_M if is_overlay else BOTTOM_MARGIN_M
        above_m = TOP_MARGIN_OF_SNOW_M if is_overlay else TOP_MARGIN_M
        is_inside = (np.abs(local[:, :2]) <= half_m[:2]).all(1)
        is_inside &= (local[:, 2] >= lowest_m - half_m[2]) & (local[:, 2] <= half_m[2] + above_m)
        rows = rows[is_inside]
        if is_overlay or gaussians.semantic is None:
            return rows
        classes = gaussians.semantic[torch.from_numpy(rows)].cpu().numpy()
        return rows[~np.isin(classes, OTHER_CLASSES)]


@dataclass(frozen=True, eq=False)
class ParkedObjects:
    """Objects of a scene that stand still."""

    boxes: Sequence[ObjectBox]
    """Their boxes."""
    background: Gaussians
    """The Gaussians of the background, which hold theirs, as they are without snow: a roof that
    snow buries is a part of the outline."""


@dataclass(frozen=True, eq=False)
class ObjectParts:
    """Splats of objects that stand still, taken from the background of a view."""

    parts: tuple[PosedGaussians, ...]
    """The splats of each object that snow leaves, and of the snow on it, with instance ids that no
    actor in view has."""
    bare_parts: tuple[PosedGaussians, ...]
    """The splats of each object without snow."""
    poses: dict[int, Float64[np.ndarray, "4 4"]]
    """world_from_box of the objects, by instance id."""
    rows: dict[int, dict[int, Int64[np.ndarray, " R"]]]
    """Rows of the splats, by number of the view's part and by instance id."""

    def hide(
        self, parts: Sequence[PosedGaussians], instance_ids: frozenset[int]
    ) -> tuple[PosedGaussians, ...]:
        """Return the parts of the view with objects that have opacity 0.

        Args:
            parts: the parts of the view, in the order of those from which the objects come.
            instance_ids: instance ids of the objects to hide.
        """
        hidden_parts = list(parts)
        for number, rows_by_id in self.rows.items():
            rows = [rows for i, rows in rows_by_id.items() if i in instance_ids]
            if not rows:
                continue
            gaussians = parts[number].gaussians
            opacities = gaussians.opacities.clone()
            opacities[torch.from_numpy(np.concatenate(rows)).to(opacities.device)] = 0
            hidden_parts[number] = replace(
                parts[number], gaussians=replace(gaussians, opacities=opacities)
            )
        return tuple(hidden_parts)


def take_objects(
    parts: Sequence[PosedGaussians], objects: ParkedObjects | None, camera: Camera
) -> ObjectParts:
    """Return the splats of the objects that are near the camera.

    Args:
        parts: the posed parts of a view.
        objects: the objects; None for none.
        camera: the camera of the view.
    """
    object_parts = list[PosedGaussians]()
    bare_parts = list[PosedGaussians]()
    poses = dict[int, np.ndarray]()
    rows_by_part = dict[int, dict[int, np.ndarray]]()
    instance_id = max((part.instance_id for part in parts), default=0)
    if objects is None:
        return ObjectParts((), (), poses, rows_by_part)
    for box in objects.boxes:
        if not box.is_near(camera):
            continue
        bare_rows = _rows_of(box, objects.background, is_overlay=False)
        if len(bare_rows) < MIN_SPLATS:
            continue
        instance_id += 1
        pose = np.eye(4)
        pose[:3, :3] = box.rotation
        pose[:3, 3] = box.centre_m
        poses[instance_id] = pose
        bare_gaussians = _select(objects.background, bare_rows)
        bare_parts.append(PosedGaussians(bare_gaussians, instance_id=instance_id))
        for number, part in enumerate(parts):
            if part.instance_id > 0 or part.world_from_part is not None:
                continue
            rows = _rows_of(box, part.gaussians, is_overlay=part.is_overlay)
            if not len(rows):
                continue
            rows_by_part.setdefault(number, {})[instance_id] = rows
            object_parts.append(
                PosedGaussians(
                    _select(part.gaussians, rows),
                    instance_id=instance_id,
                    is_overlay=part.is_overlay,
                )
            )
    return ObjectParts(tuple(object_parts), tuple(bare_parts), poses, rows_by_part)


def _select(gaussians: Gaussians, rows: Int64[np.ndarray, " R"]) -> Gaussians:
    """Return the Gaussians of some rows."""
    return gaussians.select(torch.from_numpy(rows).to(gaussians.means.device))


def _rows_of(box: ObjectBox, gaussians: Gaussians, *, is_overlay: bool) -> Int64[np.ndarray, " R"]:
    """Return the rows that are an object's; remembered as long as the Gaussians' means live.

    Opacities may change from image to image, as snow buries more.
    """
    pose = (box.centre_m.tobytes(), box.rotation.tobytes(), box.size_m)
    return cached_of_tensor(
        gaussians.means,
        f"rows of a box {is_overlay} {pose}",
        lambda: box.rows_in(gaussians, is_overlay=is_overlay),
    )
