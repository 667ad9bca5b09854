"""Records of the snow that lies on the parts of a scene, ready to be rendered for a camera.

`layer.lay_snow` makes the records once a scene. `SnowLayers.parts_for` turns them into
posed Gaussians for each view.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from weakref import WeakKeyDictionary

import torch
from jaxtyping import Float
from torch import Tensor

from augment.effects.snow.glints import Crystals
from augment.effects.snow.relief import Grain
from augment.effects.snow.wet_tracks import WetRoad
from augment.memo import memo_of
from augment.render.buffers import AUTO, CUDA
from augment.render.cuda import runtime as gpu
from augment.render.sh import SH_C0
from augment.scene.cameras import Camera
from augment.scene.scene import Gaussians, PosedGaussians, Scene, SplatShading


@dataclass(frozen=True, eq=False)
class PartSnow:
    """Snow on one part of a scene."""

    # Gaussians of the snow, in the part's frame, with semantic SNOW.
    gaussians: Gaussians
    # Opacities of the part's own Gaussians, 0 for those that the snow buries.
    visible_opacities: Float[Tensor, "N"]
    # Colour that full sun adds to each Gaussian, see SplatShading; None where the colours are lit.
    sunlight_rgb: Float[Tensor, "S 3"] | None = None
    # Unit normals. Given for a part that moves and is lit splat by splat, since its light changes
    # as it turns; None otherwise.
    normals: Float[Tensor, "S 3"] | None = None
    crystals: Crystals | None = None


@dataclass(frozen=True, eq=False)
class SnowLayers:
    """Snow in a scene."""

    ground: PartSnow  # snow on the background
    actors: Mapping[str, PartSnow]  # snow on actors, by track_id
    sun: tuple[float, float, float]  # unit vector towards the sun, world, for layers with slopes
    wrap: float  # how far light reaches around, see SplatShading, for layers with slopes
    thickness_m: float  # depth of the snow on level ground
    grain: Grain  # how the snow looks from close by
    wet_road: WetRoad | None = None  # bare wet road in the tracks of traffic; None without any

    def layer_on(self, scene: Scene, instance_id: int) -> PartSnow | None:
        """Return the snow on the background (0) or an actor (1 + its index), or None."""
        if instance_id == 0:
            return self.ground
        return self.actors.get(scene.actors[instance_id - 1].track_id)

    def parts_for(
        self,
        scene: Scene,
        camera: Camera,
        without_snow: Sequence[PosedGaussians] | None = None,
        snowy_ids: Collection[int] | None = None,
        *,
        backend: str = AUTO,
    ) -> tuple[PosedGaussians, ...]:
        """Return the scene's parts and their snow at the moment the camera took its image.

        The scene's own parts come first, in their order.

        Args:
            scene: the scene.
            camera: the camera.
            without_snow: parts to render, the background first; None for all parts of the scene.
            snowy_ids: instance ids of the parts whose snow is rendered; None for all.
            backend: with "cuda", arrays that change with the view lie on the GPU, equal within
                float rounding.
        """
        without_snow = scene.parts_for(camera) if without_snow is None else without_snow
        parts = []
        snowy_parts = []
        for part in without_snow:
            layer = self.layer_on(scene, part.instance_id)
            if layer is None or (snowy_ids is not None and part.instance_id not in snowy_ids):
                parts.append(part)
                continue
            visible_gaussians = _hide_buried(layer, part.gaussians)
            parts.append(dataclasses.replace(part, gaussians=visible_gaussians))
            if len(layer.gaussians):
                snowy_parts.append((layer, part))
        for layer, part in snowy_parts:
            parts.extend(self._pose_layer(layer, part, camera, backend))
        return tuple(parts)

    def _pose_layer(
        self, layer: PartSnow, part: PosedGaussians, camera: Camera, backend: str
    ) -> list[PosedGaussians]:
        """Return the layer at the pose of its part, and its glints."""
        world_from_part = part.world_from_part
        eye_m = camera.centre
        sun = torch.tensor(self.sun, dtype=torch.float64)
        if world_from_part is not None:
            sun = world_from_part[:3, :3].T @ sun
            eye_m = world_from_part[:3, :3].T @ (eye_m - world_from_part[:3, 3])
        gaussians = layer.gaussians
        slopes = layer.sunlight_rgb
        if layer.normals is not None:
            assert slopes is not None
            sun_direction = sun.tolist()
            gaussians = _light_per_splat(
                gaussians, slopes, layer.normals, sun_direction, self.wrap, backend
            )
            slopes = None
        gaussians_and_slopes = [(gaussians, slopes)]
        if layer.crystals is not None:
            glints = layer.crystals.glints(sun, eye_m, backend=backend)
            gaussians_and_slopes += [] if glints is None else [(glints, None)]
        towards_sun = tuple(sun.tolist())
        instance = part.instance_id
        shadings = (
            None if s is None else SplatShading(s, towards_sun, self.wrap)
            for _, s in gaussians_and_slopes
        )
        return [
            PosedGaussians(splats, world_from_part, instance, is_overlay=True, shading=shading)
            for (splats, _), shading in zip(gaussians_and_slopes, shadings, strict=True)
        ]


def _hide_buried(layer: PartSnow, gaussians: Gaussians) -> Gaussians:
    """Return a part's Gaussians with opacity 0 where the snow buries them.

    The result is one object for as long as the part's Gaussians are one, so that a GPU keeps what
    it holds of it from frame to frame.
    """
    gaussians_by_layer = memo_of(gaussians).get(
        ("left visible by snow",), WeakKeyDictionary[PartSnow, Gaussians]
    )
    if layer not in gaussians_by_layer:
        gaussians_by_layer[layer] = dataclasses.replace(
            gaussians, opacities=layer.visible_opacities
        )
    return gaussians_by_layer[layer]


def _light_per_splat(
    gaussians: Gaussians,
    slopes: Tensor,
    normals: Tensor,
    sun: list[float],
    wrap: float,
    backend: str,
) -> Gaussians:
    """Return the Gaussians in the light that their own normals catch.

    Args:
        gaussians: snow in shade.
        slopes: [S, 3], colour that full sun adds.
        normals: [S, 3], unit normals, in the part's frame.
        sun: unit vector towards the sun, in the part's frame.
        wrap: how far light reaches around, see SplatShading.
        backend: the backend.
    """
    # numpy, since starting threads would take longer than the arithmetic on one part's snow
    sh, slope_values, normal_values = (
        gpu.gpu_copy(t) if backend == CUDA else t.numpy() for t in (gaussians.sh, slopes, normals)
    )
    facing = (
        normal_values[:, 0] * sun[0] + normal_values[:, 1] * sun[1] + normal_values[:, 2] * sun[2]
    )
    sun_share = ((facing + wrap) / (1 + wrap)).clip(0, 1) / SH_C0
    lit_sh = sh + (slope_values * sun_share[:, None])[:, None, :]
    return dataclasses.replace(gaussians, sh=torch.as_tensor(lit_sh))
