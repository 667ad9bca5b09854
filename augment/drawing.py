"""The scene drawn in layers, with the fog that is in front of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from jaxtyping import Bool
from torch import Tensor

from augment.cameras import Camera
from augment.render.buffers import EXPECTED_DEPTH, RenderOutput
from augment.render.composite import add_elevation
from augment.render.constants import RasterSettings
from augment.render.fog import Fog, fog_raster
from augment.render.layout import HeightClip
from augment.render.rasterize import rasterize
from augment.scene import PosedGaussians
from augment.sky import Sky
from augment.timing import timed


@dataclass(frozen=True, eq=False)
class LayerRenderer:
    """Draws the parts of a scene, all of them or those on one side of a level plane.

    fog: in front of parts and sky. fog_on_buffers: whether it is applied to finished layers, and
    not blended per Gaussian.
    """

    parts: Sequence[PosedGaussians]
    sky: Sky
    fog: Fog | None
    fog_on_buffers: bool
    settings: RasterSettings
    backend: str

    def without_fog(self) -> LayerRenderer:
        return replace(self, fog=None)

    def draw(
        self,
        camera: Camera,
        clip: HeightClip | None,
        buffers: frozenset[str],
        pixel_mask: Bool[Tensor, "H W"] | None = None,
    ) -> RenderOutput:
        """The layer's buffers, without sky; its colours are seen through the fog."""
        later = self.fog if self.fog_on_buffers else None
        tilted = self.fog if self.fog is not None and self.fog.overcast > 0 else None
        raster = rasterize(
            self.parts,
            camera,
            buffers=buffers | {EXPECTED_DEPTH} if later or tilted else buffers,
            settings=self.settings,
            fog=None if self.fog_on_buffers else self.fog,
            clip=clip,
            pixel_mask=pixel_mask,
            backend=self.backend,
        )
        if later is not None:
            with timed("smog on buffers"):
                raster = replace(raster, rgb=fog_raster(raster, camera, later))
        if tilted is not None:
            with timed("airlight by elevation"):
                rgb = add_elevation(raster, camera, tilted, backend=self.backend)
                raster = replace(raster, rgb=rgb)
        return raster
