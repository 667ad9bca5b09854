"""Snow that lies in a scene, ready to be drawn: Gaussians added, and Gaussians hidden."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from weakref import WeakKeyDictionary

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from augment.cameras import Camera
from augment.render.backends import AUTO, CUDA
from augment.render.sh import SH_C0
from augment.scene import Gaussians, PosedGaussians, Scene, SplatShading
from augment.snow.close import Grain, split_near
from augment.snow.sparkle import Crystals


@dataclass(frozen=True, eq=False)
class Layer:
    """The snow on one part of a scene.

    gaussians [S]: the snow, in the part's frame, semantic SNOW. opacities [N]: of the part's own
    Gaussians, 0 for those that the snow buries. slopes [S, 3]: what the light's share is
    multiplied by, see SplatShading; None where the light is in the Gaussians' colours already.
    normals [S, 3]: unit, where that share is one for a splat but changes as the part turns, as that
    of a vehicle's snow; None where it is one for a pixel. crystals: what may glint, or None.
    """

    gaussians: Gaussians
    opacities: Float[Tensor, "N"]
    slopes: Float[Tensor, "S 3"] | None = None
    normals: Float[Tensor, "S 3"] | None = None
    crystals: Crystals | None = None


@dataclass(frozen=True, eq=False)
class SnowCover:
    """The snow in a scene. actors: layers by track_id. sun, wrap: of the light, for layers with
    slopes (world; see SplatShading). thickness_m: the layer's depth on level ground. grain: how the
    ground's snow looks from close by.
    """

    ground: Layer
    actors: Mapping[str, Layer]
    sun: tuple[float, float, float]
    wrap: float
    thickness_m: float
    grain: Grain

    def layer_on(self, scene: Scene, instance_id: int) -> Layer | None:
        """The snow on the background (0) or an actor (1 + its index); None where it has none."""
        if instance_id == 0:
            return self.ground
        return self.actors.get(scene.actors[instance_id - 1].track_id)

    def parts_for(
        self,
        scene: Scene,
        camera: Camera,
        bare: Sequence[PosedGaussians] | None = None,
        snowy: Collection[int] | None = None,
        *,
        backend: str = AUTO,
    ) -> tuple[PosedGaussians, ...]:
        """The scene's parts and the snow on them at the moment the camera took its image.

        The scene's own come first and in their order, so that what is neither buried nor covered
        keeps its number. bare: those parts that are drawn, the background first. snowy: instance
        ids of the parts whose snow is; None for all. backend: that draws them; what changes with
        the view lies on the GPU where that is "cuda", and equals the CPU's within float rounding.
        """
        bare = scene.parts_for(camera) if bare is None else bare
        parts, covered = [], []
        for part in bare:
            layer = self.layer_on(scene, part.instance_id)
            if layer is None or (snowy is not None and part.instance_id not in snowy):
                parts.append(part)
                continue
            left = _left_visible(layer, part.gaussians)
            parts.append(dataclasses.replace(part, gaussians=left))
            if len(layer.gaussians):
                covered.append((layer, part))
        if backend == CUDA:
            from augment.snow.cuda_cover import pose_layers

            return (*parts, *pose_layers(self, covered, camera))
        eye_m = camera.centre
        for layer, part in covered:
            parts.extend(self._posed(layer, part, camera, eye_m))
        return tuple(parts)

    def _posed(
        self,
        layer: Layer,
        part: PosedGaussians,
        camera: Camera,
        eye_m: Float[Tensor, "3"],
    ) -> tuple[PosedGaussians, ...]:
        """The layer where its part stands, the ground's finer where it is near, and its glints."""
        pose, number = part.world_from_part, part.instance_id
        sun = torch.tensor(self.sun, dtype=torch.float64)
        if pose is not None:
            sun, eye_m = pose[:3, :3].T @ sun, pose[:3, :3].T @ (eye_m - pose[:3, 3])
        gaussians, slopes = layer.gaussians, layer.slopes
        if layer.normals is not None:
            assert slopes is not None
            gaussians = _lit(gaussians, slopes, layer.normals, sun, self.wrap)
            slopes = None
        drawn = [(gaussians, slopes)]
        near = (
            split_near(gaussians, slopes, camera, sun, self.grain) if layer is self.ground else None
        )
        if near is not None:
            drawn = [(near.whole, slopes), (near.fine, near.fine_slopes)]
        glints = None if layer.crystals is None else layer.crystals.glints(sun, eye_m)
        if glints is not None:
            drawn.append((glints, None))
        light = tuple(sun.tolist())
        return tuple(
            PosedGaussians(
                splats,
                pose,
                number,
                is_snow=True,
                shading=None if added is None else SplatShading(added, light, self.wrap),
            )
            for splats, added in drawn
        )


_left: WeakKeyDictionary[Layer, tuple[Gaussians, Gaussians]] = WeakKeyDictionary()


def _left_visible(layer: Layer, own: Gaussians) -> Gaussians:
    """A part's Gaussians less those that the snow buries: one object for as long as the part's own
    is one, so that what a GPU knows of it is not asked for anew every frame.
    """
    known = _left.get(layer)
    if known is None or known[0] is not own:
        known = _left[layer] = (own, dataclasses.replace(own, opacities=layer.opacities))
    return known[1]


def _lit(
    gaussians: Gaussians,
    slopes: Float[Tensor, "S 3"],
    normals: Float[Tensor, "S 3"],
    sun: Float[Tensor, "3"],
    wrap: float,
) -> Gaussians:
    """The Gaussians in the light that their own normals catch. sun: unit, in the part's frame."""
    # numpy, since starting threads would take longer than the arithmetic on one part's snow
    n, light = normals.numpy(), sun.numpy().astype(np.float32)
    facing = n[:, 0] * light[0] + n[:, 1] * light[1] + n[:, 2] * light[2]
    share = np.clip((facing + wrap) / (1 + wrap), 0, 1) / SH_C0
    lit = gaussians.sh.numpy() + (slopes.numpy() * share[:, None])[:, None, :]
    return dataclasses.replace(gaussians, sh=torch.from_numpy(lit.astype(np.float32)))
