"""The scene drawn in layers, with the fog that is in front of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from jaxtyping import Bool, Float
from torch import Tensor

from augment.base_photo import Photo, blackened, mix
from augment.cameras import Camera
from augment.render.buffers import ALPHA, EXPECTED_DEPTH, RGB, RenderOutput
from augment.render.composite import add_elevation, composite_sky
from augment.render.constants import RasterSettings
from augment.render.fog import Fog, blend_airlight, fog_raster, sky_optical_depth
from augment.render.layout import HeightClip
from augment.render.rasterize import rasterize
from augment.scene import PosedGaussians
from augment.sky import Sky
from augment.timing import timed


@dataclass(frozen=True, eq=False)
class LayerRenderer:
    """Draws the parts of a scene, all of them or those on one side of a level plane.

    fog: in front of parts and sky. fog_on_buffers: whether it is applied to finished layers, and
    not blended per Gaussian. photo: what cameras that took it see in place of the splats' colours.
    unpruned: the parts where `parts` lack what no recorded view would miss.
    """

    parts: Sequence[PosedGaussians]
    sky: Sky
    fog: Fog | None
    fog_on_buffers: bool
    settings: RasterSettings
    backend: str
    photo: Photo | None = None
    unpruned: Sequence[PosedGaussians] | None = None

    def without_fog(self) -> LayerRenderer:
        return replace(self, fog=None)

    def for_scale(self, scale: float) -> LayerRenderer:
        """Of layers with this many times as many pixels a side as the picture: splats as wide."""
        settings = replace(self.settings, blur_px2=self.settings.blur_px2 * scale * scale)
        return replace(self, settings=settings)

    def draw(
        self,
        camera: Camera,
        clip: HeightClip | None,
        buffers: frozenset[str],
        pixel_mask: Bool[Tensor, "H W"] | None = None,
        shown: Float[Tensor, "H W"] | None = None,
    ) -> RenderOutput:
        """The layer's buffers, without sky; its colours are seen through the fog.

        shown: how much of each pixel of a photo shows this layer; None for all of it.
        """
        raster = self._draw_level(camera, clip, buffers, pixel_mask, shown)
        if self.fog is None or self.fog.overcast == 0:
            return raster
        with timed("airlight by elevation"):
            rgb = add_elevation(raster, camera, self.fog, backend=self.backend)
        return replace(raster, rgb=rgb)

    def _draw_level(
        self,
        camera: Camera,
        clip: HeightClip | None,
        buffers: frozenset[str],
        pixel_mask: Bool[Tensor, "H W"] | None = None,
        shown: Float[Tensor, "H W"] | None = None,
    ) -> RenderOutput:
        """As `draw`, in the airlight of the horizon."""
        later = self.fog if self.fog_on_buffers else None
        photo = self.photo if self.photo is not None and self.photo.is_seen_by(camera) else None
        parts = self.parts
        if photo is not None:
            buffers = buffers | photo.buffers_for(parts)
            parts = blackened(parts) if shown is None else parts
        tilted = self.fog is not None and self.fog.overcast > 0
        raster = rasterize(
            parts,
            camera,
            buffers=buffers | {EXPECTED_DEPTH} if later or tilted else buffers,
            settings=self.settings,
            fog=None if self.fog_on_buffers else self.fog,
            clip=clip,
            pixel_mask=pixel_mask,
            backend=self.backend,
        )
        if photo is not None:
            with timed("photo"):
                raster = photo.paint(raster, parts, camera, shown)
        if later is not None:
            with timed("smog on buffers"):
                raster = replace(raster, rgb=fog_raster(raster, camera, later))
        return raster

    def draw_whole(
        self, camera: Camera, buffers: frozenset[str]
    ) -> tuple[Float[Tensor, "H W 3"], RenderOutput]:
        """The picture with its sky, not clamped, and the scene's buffers."""
        if self.photo is not None:
            return self._draw_on_photo(self.photo, camera, buffers)
        fog = self.fog if self.fog is not None and self.fog.scale_height_m is None else None
        if fog is not None and fog.overcast > 0:
            with timed("rasterise"):
                raster = self._draw_level(camera, None, buffers)
            with timed("airlight by elevation"):  # of the surfaces and behind them at once
                return add_elevation(raster, camera, fog, behind=True, backend=self.backend), raster
        with timed("rasterise"):
            raster = self.draw(camera, None, buffers)
        assert raster.rgb is not None and raster.alpha is not None
        with timed("sky" if fog is None else "airlight behind the splats"):  # which hides the sky
            return self.add_sky(raster.rgb, raster.alpha, camera), raster

    def add_sky(
        self, rgb: Float[Tensor, "H W 3"], alpha: Float[Tensor, "H W"], camera: Camera
    ) -> Float[Tensor, "H W 3"]:
        """A layer's colours before the sky, seen through the fog. camera: the view's, or a window
        of it.
        """
        if self.photo is None:
            return composite_sky(rgb, alpha, camera, self.sky, fog=self.fog, backend=self.backend)
        sky = self.photo.sky_colors(camera)
        if self.fog is not None:
            slope = camera.ray_directions(rgb.dtype, rgb.device)[..., 2]
            slope = slope / camera.ray_lengths(rgb.dtype, rgb.device)
            tau = sky_optical_depth(self.fog, slope, float(camera.centre[2]))
            sky = blend_airlight(sky, tau, self.fog, slope)
        return rgb + (1 - alpha)[..., None] * sky

    def _draw_on_photo(
        self, photo: Photo, camera: Camera, buffers: frozenset[str]
    ) -> tuple[Float[Tensor, "H W 3"], RenderOutput]:
        """The photo with what lies on the scene, through the smog up to each pixel's depth."""
        parts, own = photo.prepare(self.parts)
        requested = (buffers - {RGB}) | own | {ALPHA}
        if self.fog is not None:
            requested = requested | {EXPECTED_DEPTH}
        with timed("rasterise"):
            settings = replace(self.settings, sh_degree=0)  # one colour in all bands
            raster = rasterize(
                parts, camera, buffers=requested, settings=settings, backend=self.backend
            )
        with timed("photo"):
            rgb = photo.clear_picture(raster, parts)
        if self.fog is None:
            return rgb, raster
        with timed("smog on buffers"):
            transmittance = photo.transmittance(raster, self.fog)
            return mix(rgb, photo.airlight(self.fog), 1 - transmittance), raster
