"""The sky of a run as a cube map of the scene's world.

drivestudio looks a direction (x, y, z) of its world up at (x, z, -y), in nvdiffrast's faces. Where
the scene's world differs from it by a permutation of axes, both turns together take texels to
texels, and no colour is interpolated.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from augment.cameras import Camera
from augment.errors import AdapterError
from augment.files.checkpoints import section, taken, tensor
from augment.render.composite import composite_sky
from augment.sky import ConstantSky, CubemapSky, Sky, cubemap_coordinates, directions_of_cubemap

_LOOKUP_FROM_MODEL = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
_BAKED_SIZE = 256
_LARGEST = 8192  # texels along an edge
_OCTAVES = 7  # frequencies 1 to 64 of the sky network's directions


def read_sky(
    models: Mapping[str, Any], scene_from_model: np.ndarray, where: str
) -> tuple[Sky, tuple[str, ...]]:
    """The sky of a checkpoint's models, black where there is none that is known here, and what is
    not as it was trained.

    scene_from_model: [3, 3], a rotation.

    Raises:
        AdapterError: tensors of another shape than the project's.
    """
    black = ConstantSky(torch.zeros(3))
    if "Sky" not in models:
        return black, (f"{where} holds no Sky; the sky is black",)
    content, where = section(models, "Sky", where), f"{where} Sky"
    if "base" in content:
        base = tensor(content, "base", (6, None, None, 3), where)
        if base.shape[1] != base.shape[2] or not 1 <= base.shape[1] <= _LARGEST:
            raise AdapterError(
                f"{where}: base must be [6, R, R, 3] with R from 1 to {_LARGEST}; "
                f"got {list(base.shape)}"
            )
        faces = taken(base)
        if not bool(torch.isfinite(faces).all()):
            raise AdapterError(f"{where}: base holds NaN or infinite numbers")
        return CubemapSky(turned_faces(faces, _LOOKUP_FROM_MODEL @ scene_from_model.T)), ()
    if "sky_head.layers.0.weight" in content:
        return _baked(content, scene_from_model, where)
    keys = ", ".join(map(str, list(content)[:6])) or "nothing"
    return black, (f"{where} is of a kind that is not known here ({keys}); the sky is black",)


def turned_faces(faces: Tensor, source_from_target: np.ndarray) -> Tensor:
    """A cube map that shows in direction d what `faces` show in source_from_target @ d: exactly
    where that is a permutation of axes with signs, else at the middle of each texel.

    faces: [6, R, R, 3]. source_from_target: [3, 3], a rotation.
    """
    if not np.isin(source_from_target, (-1.0, 0.0, 1.0)).all():
        return _drawn_faces(CubemapSky(faces), source_from_target)
    turned = torch.empty_like(faces)
    for target, (source, quarters) in enumerate(_turns_of_faces(source_from_target)):
        turned[target] = torch.rot90(faces[source], quarters)
    return turned


def _drawn_faces(sky: CubemapSky, source_from_target: np.ndarray) -> Tensor:
    """Each face as a camera of 90 degrees sees it; a face is the mirror image of such a picture."""
    size = sky.faces.shape[1]
    faces = torch.empty_like(sky.faces)
    for face, corners in enumerate(directions_of_cubemap(2).double()):
        left, down = corners[0, 0] - corners[0, 1], corners[1, 0] - corners[0, 0]
        axes = torch.nn.functional.normalize(torch.stack([left, down, corners.sum((0, 1))]))
        pose = torch.eye(4, dtype=torch.float64)
        pose[:3, :3] = axes @ torch.from_numpy(source_from_target.T.copy())
        camera = Camera("face", size, size, *[size / 2] * 4, camera_from_world=pose)
        empty = torch.zeros(size, size, 3)
        faces[face] = composite_sky(empty, empty[..., 0], camera, sky).flip(1)
    return faces


def _turns_of_faces(source_from_target: np.ndarray) -> list[tuple[int, int]]:
    """For each face, the one that it shows and by how many quarter turns, found on a cube map of
    two texels an edge: where four texels go, all do.
    """
    turn = torch.from_numpy(source_from_target).float()
    face, s, t = cubemap_coordinates(directions_of_cubemap(2) @ turn.T)
    shown = face * 4 + (t > 0) * 2 + (s > 0)
    texels = torch.arange(24).reshape(6, 2, 2)
    return [
        next(
            (source, quarters)
            for source in range(6)
            for quarters in range(4)
            if torch.equal(torch.rot90(texels[source], quarters), wanted)
        )
        for wanted in shown
    ]


def _baked(
    content: Mapping[str, Any], scene_from_model: np.ndarray, where: str
) -> tuple[Sky, tuple[str, ...]]:
    """The sky network's colours of 256 texels a face, with the mean of its images' appearances."""
    appearance, note = torch.zeros(0), ()
    if "appearance_embedding.weight" in content:
        rows = taken(tensor(content, "appearance_embedding.weight", (None, None), where))
        appearance = rows.mean(0)
        if bool((rows != appearance).any()):
            note = (
                f"{where}: the sky differed from image to image; it has their mean appearance, as "
                f"the project gives it to images that were not trained on",
            )
    inputs = 3 + 6 * _OCTAVES + len(appearance)
    width = tensor(content, "sky_head.layers.0.weight", (None, inputs), where).shape[0]
    shapes = ((width, inputs), (width, width + inputs), (3, width))
    layers = [
        (
            taken(tensor(content, f"sky_head.layers.{i}.weight", shape, where)),
            taken(tensor(content, f"sky_head.layers.{i}.bias", shape[:1], where)),
        )
        for i, shape in enumerate(shapes)
    ]
    turn = torch.from_numpy(scene_from_model).float()
    faces = torch.stack(
        [
            _network(directions.reshape(-1, 3) @ turn, appearance, layers)
            for directions in directions_of_cubemap(_BAKED_SIZE)
        ]
    )
    if not bool(torch.isfinite(faces).all()):
        raise AdapterError(f"{where}: the sky's network gives NaN or infinite colours")
    return CubemapSky(faces.reshape(6, _BAKED_SIZE, _BAKED_SIZE, 3)), note


def _network(directions: Tensor, appearance: Tensor, layers: list[tuple[Tensor, Tensor]]) -> Tensor:
    """Colours [N, 3] of unit directions [N, 3] of the model's world."""
    scales = 2.0 ** torch.arange(_OCTAVES)
    waves = (directions[:, None, :] * scales[:, None]).reshape(len(directions), -1)
    encoded = torch.cat([directions, waves.sin(), (waves + 0.5 * torch.pi).sin()], 1)
    given = torch.cat([encoded, appearance.expand(len(directions), -1)], 1)
    (first, first_bias), (middle, middle_bias), (last, last_bias) = layers
    hidden = (given @ first.T + first_bias).relu()
    hidden = (torch.cat([hidden, given], 1) @ middle.T + middle_bias).relu()
    return (hidden @ last.T + last_bias).sigmoid()
