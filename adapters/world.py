"""Conversion from a file's world to the scene's: axes, unit of length, origin."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import torch

from augment.errors import AdapterError
from augment.scene.scene import Gaussians
from augment.scene.semantics import class_of_label
from augment.scene.transform import transform_gaussians_rigidly

# ---- Sets of Gaussians into one, and the class of an object's ------------------------------------


def join_gaussians(parts: Sequence[Gaussians]) -> Gaussians:
    """Join parts. They have one degree of spherical harmonics, and classes unless empty."""
    names = ("means", "quats", "scales", "opacities", "sh")
    joined = {name: torch.cat([getattr(p, name) for p in parts]) for name in names}
    semantic = torch.cat([p.semantic for p in parts if p.semantic is not None])
    return Gaussians(**joined, semantic=semantic)


def with_class_of(label: str, gaussians: Gaussians) -> Gaussians:
    """Return the Gaussians of an object with the class of its label, if nothing more is known."""
    classes = torch.full((len(gaussians),), int(class_of_label(label)), dtype=torch.int16)
    return dataclasses.replace(gaussians, semantic=classes)


# ---- World to world -----------------------------------------------------------------------------

_AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}


@dataclass(frozen=True, eq=False)
class WorldChange:
    """Change of world: scene = scale * rotation @ source - origin_m, in float64.

    Attributes:
        rotation: float64 [3, 3], proper.
        scale: metres per unit of the source.
        origin_m: float64 [3], metres along the scene's axes.
    """

    rotation: np.ndarray = field(default_factory=lambda: np.eye(3))
    scale: float = 1.0
    origin_m: np.ndarray = field(default_factory=lambda: np.zeros(3))

    def points(self, points: np.ndarray) -> np.ndarray:
        """Return points in the scene's world, float64 [N, 3]."""
        return self.scale * (np.asarray(points, np.float64) @ self.rotation.T) - self.origin_m

    def pose(self, world_from_camera: np.ndarray) -> np.ndarray:
        """Return world_from_camera of the scene.

        It stays rigid: the scale changes its position only.
        """
        pose = np.eye(4)
        pose[:3, :3] = self.rotation @ world_from_camera[:3, :3]
        pose[:3, 3] = self.points(world_from_camera[None, :3, 3])[0]
        return pose

    def gaussians(self, gaussians: Gaussians, source_origin: np.ndarray) -> Gaussians:
        """Return Gaussians in the scene's world.

        Means, quats, scales, and SH of degree 1 and above change.

        source_origin: [3], offset that was already subtracted from their means, in the source's
        world.
        """
        shift = self.points(source_origin[None])[0]
        turned = not np.array_equal(self.rotation, np.eye(3))
        if not turned and self.scale == 1.0 and not shift.any():
            return gaussians
        rotation = torch.from_numpy(np.ascontiguousarray(self.rotation))
        return transform_gaussians_rigidly(gaussians, rotation, torch.from_numpy(shift), self.scale)


def parse_up(text: str) -> np.ndarray:
    """Return the unit vector of `up`: an axis such as +z, -y or x, or three numbers such as
    0.1,-0.9,0.2.
    """
    name = text.strip().lower()
    if name.lstrip("+-") in _AXES and len(name) <= 2:
        axis = np.array(_AXES[name[-1]])
        return -axis if name[0] == "-" else axis
    try:
        vector = np.array([float(number) for number in name.split(",")])
    except ValueError:
        vector = np.zeros(0)
    length = np.linalg.norm(vector)
    if vector.shape != (3,) or not (np.isfinite(length) and length > 0):
        raise AdapterError(
            "up must be the source's axis that points up (+x -x +y -y +z -z), three numbers "
            f"such as 0,-1,0.1, or 'cameras'; got {text!r}"
        )
    return vector / length


def rotation_to_z_up(up: np.ndarray) -> np.ndarray:
    """Return the smallest rotation that takes the unit vector `up` to +z; about x if up is -z."""
    middle = up + np.array([0.0, 0.0, 1.0])
    if np.linalg.norm(middle) < 1e-9:
        return np.diag([1.0, -1.0, -1.0])
    middle /= np.linalg.norm(middle)
    # Two mirrors make a turn that is orthonormal to rounding, however close `up` comes to -z.
    mirrors = [np.eye(3) - 2 * np.outer(normal, normal) for normal in (middle, up)]
    rotation = mirrors[0] @ mirrors[1]
    # Axis names must turn exactly, so that integers stay integers.
    return np.round(rotation) if np.abs(rotation - np.round(rotation)).max() < 1e-15 else rotation


def invert_pose(pose: np.ndarray) -> np.ndarray:
    """Return the inverse of a rigid transform, float64 [4, 4]."""
    out = np.eye(4)
    out[:3, :3] = pose[:3, :3].T
    out[:3, 3] = -pose[:3, :3].T @ pose[:3, 3]
    return out


def nearest_axis(vector: np.ndarray) -> str:
    """Return the name of the axis closest to a vector: +x, -x, … -z."""
    index = int(np.abs(vector).argmax())
    return f"{'-' if vector[index] < 0 else '+'}{'xyz'[index]}"
