"""A view's snow on the GPU: what its layers become, with one upload a frame and nothing back."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from torch import Tensor

from augment.cameras import Camera
from augment.effects.snow.cuda_close import plan_split
from augment.effects.snow.cuda_glints import plan_glints
from augment.effects.snow.cuda_light import plan_light
from augment.effects.snow.near_camera import Layer, SnowCover
from augment.render.cuda.runtime import upload_together
from augment.render.part_views import part_poses
from augment.scene import Gaussians, PosedGaussians, SplatShading


def pose_layers(
    cover: SnowCover, covered: Sequence[tuple[Layer, PosedGaussians]], camera: Camera
) -> list[PosedGaussians]:
    """Layers that have splats where their parts stand, the ground's finer where it is near, and
    their glints, as `SnowCover.parts_for` lists them. What differs from frame to frame lies on the
    GPU; the rest is copied there the first time.
    """
    if not covered:
        return []
    layers = [layer for layer, _ in covered]
    poses = part_poses([part.world_from_part for _, part in covered])
    sun = np.array(cover.sun)
    suns = sun @ poses[:, :3, :3]
    eyes_m = ((camera.centre.numpy() - poses[:, :3, 3])[:, None] @ poses[:, :3, :3])[:, 0]

    by_normals = [number for number, layer in enumerate(layers) if layer.normals is not None]
    light = plan_light([layers[number] for number in by_normals], suns[by_normals], cover.wrap)
    ground, split = cover.ground, None
    if ground in layers and ground.normals is None:
        split = plan_split(ground.gaussians, ground.slopes, camera, sun, cover.grain)
    glints = plan_glints([layer.crystals for layer in layers], suns, eyes_m)

    sent = _sent(*(
        () if light is None else (light.rows, light.numbers),
        () if split is None else (split.rows, split.numbers),
        () if glints is None else (glints.rows, glints.layers, glints.numbers),
    ))  # fmt: skip
    lit = [] if light is None else light.run(*next(sent))
    near = None if split is None else split.run(*next(sent))
    bright = [None] * len(layers) if glints is None else glints.run(*next(sent))

    lit_of, out = dict(zip(by_normals, lit, strict=True)), []
    for number, (layer, part) in enumerate(covered):
        drawn: list[tuple[Gaussians, Tensor | None]]
        if number in lit_of:
            drawn = [(lit_of[number], None)]
        elif layer is ground and near is not None:
            drawn = [(near.whole, layer.slopes), (near.fine, near.fine_slopes)]
        else:
            drawn = [(layer.gaussians, layer.slopes)]
        shown = bright[number]
        if shown is not None:
            drawn.append((shown, None))
        direction = tuple(suns[number].tolist())
        out += [
            PosedGaussians(
                splats,
                part.world_from_part,
                part.instance_id,
                is_snow=True,
                shading=None if added is None else SplatShading(added, direction, cover.wrap),
            )
            for splats, added in drawn
        ]
    return out


def _sent(*groups: tuple[np.ndarray, ...]) -> Iterator[list[Tensor]]:
    """What lies on the GPU of each group that has arrays, all by one upload."""
    groups = tuple(group for group in groups if group)
    if groups:
        tensors = upload_together([array for group in groups for array in group])
        for group in groups:
            yield tensors[: len(group)]
            tensors = tensors[len(group) :]
