"""Snow that lies in a scene, ready to be drawn: Gaussians added, and Gaussians hidden."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from augment.cameras import Camera
from augment.scene import Gaussians, PosedGaussians, Scene, SplatShading


@dataclass(frozen=True, eq=False)
class Layer:
    """The snow on one part of a scene.

    gaussians [S]: the snow, in the part's frame, semantic SNOW. opacities [N]: of the part's own
    Gaussians, 0 for those that the snow buries. slopes [S, 3]: see SplatShading; None where the
    light is in the Gaussians' colours already.
    """

    gaussians: Gaussians
    opacities: Float[Tensor, "N"]
    slopes: Float[Tensor, "S 3"] | None = None


@dataclass(frozen=True, eq=False)
class SnowCover:
    """The snow in a scene. actors: layers by track_id. sun, wrap: of the light, for layers with
    slopes (world; see SplatShading). thickness_m: the layer's depth on level ground.
    """

    ground: Layer
    actors: Mapping[str, Layer]
    sun: tuple[float, float, float]
    wrap: float
    thickness_m: float

    def parts_for(self, scene: Scene, camera: Camera) -> tuple[PosedGaussians, ...]:
        """The scene's parts and the snow on them at the moment the camera took its image.

        The scene's own come first and in their order, so that what is neither buried nor covered
        keeps its number.
        """
        bare = scene.parts_for(camera)
        parts, snow = [], []
        for part in bare:
            layer = self.ground
            if part.instance_id > 0:
                track_id = scene.actors[part.instance_id - 1].track_id
                if track_id not in self.actors:
                    parts.append(part)
                    continue
                layer = self.actors[track_id]
            kept = dataclasses.replace(part.gaussians, opacities=layer.opacities)
            parts.append(dataclasses.replace(part, gaussians=kept))
            if len(layer.gaussians):
                snow.append(self._posed(layer, part))
        return (*parts, *snow)

    def _posed(self, layer: Layer, part: PosedGaussians) -> PosedGaussians:
        shading = None
        if layer.slopes is not None:
            sun = torch.tensor(self.sun, dtype=torch.float64)
            if part.world_from_part is not None:
                sun = part.world_from_part[:3, :3].T @ sun
            shading = SplatShading(layer.slopes, tuple(sun.tolist()), self.wrap)
        return PosedGaussians(
            layer.gaussians, part.world_from_part, part.instance_id, is_snow=True, shading=shading
        )
