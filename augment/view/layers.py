"""Rendering of a scene's parts and sky, through the fog that lies before them.

In: posed Gaussians, a sky, fog and a camera. Out: the rasteriser's buffers, and colours with the
sky behind them. `augment.view.render_view` renders a whole picture with one `LayerRenderer`;
effects that need several layers (what stands above the water, below it, mirrored in it) call it
once a layer.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from augment.light.common_exposure import AddedColors
from augment.photo.parked_objects import ParkedObjects, take_objects
from augment.photo.photo_objects import find_edges
from augment.photo.recorded_base import Photo, blacken_parts
from augment.render.buffers import ALPHA, EXPECTED_DEPTH, RGB, RenderOutput
from augment.render.composite import add_airlight_elevation, composite_sky
from augment.render.constants import RasterSettings
from augment.render.fog import Fog, blend_airlight
from augment.render.fog_image import apply_fog_to_render, sky_image_depth
from augment.render.layout import ABOVE, HeightClip
from augment.render.rasterize import rasterize
from augment.scene.cameras import Camera
from augment.scene.scene import PosedGaussians
from augment.scene.sky import Sky
from augment.timing import timed


@dataclass(frozen=True, eq=False)
class LayerRenderer:
    """Renders the parts of a scene: all of them, or those on one side of a level plane."""

    parts: Sequence[PosedGaussians]
    """The posed Gaussians of the layer."""
    sky: Sky
    """The sky behind all parts."""
    fog: Fog | None
    """The fog before parts and sky; None for clear air."""
    applies_fog_to_buffers: bool
    """If True, fog is applied to finished buffers, by their depth; else it is blended Gaussian by
    Gaussian while rasterising."""
    settings: RasterSettings
    """The rasteriser's settings."""
    backend: str
    """The rasteriser's backend, as `rasterize` takes it."""
    photo: Photo | None = None
    """The recorded image that replaces the splats' colours in views of the camera that took it;
    None to show the splats."""
    unpruned_parts: Sequence[PosedGaussians] | None = None
    """The parts before pruning, if `parts` have been pruned (`augment.detail.prune`); else None."""
    added_colors: AddedColors | None = None
    """Map of the colours that effects add, before the camera's colour map; None to leave them."""
    parked: Callable[[], ParkedObjects] | None = None
    """Returns parked vehicles, whose edges snow and water take from the photo; None for none."""
    needs_lamp_inputs: bool = False
    """If True, effects also fill those fields of `RenderedView` that only lamps read."""

    def without_fog(self) -> LayerRenderer:
        """Return the same renderer in clear air."""
        return replace(self, fog=None)

    def for_scale(self, scale: float) -> LayerRenderer:
        """Return the renderer for layers of another resolution than the picture.

        The rasteriser's blur grows with the resolution, so that splats stay as wide as in the
        picture.

        Args:
            scale: pixels along a side of the layer over pixels along that side of the picture.
        """
        settings = replace(self.settings, blur_px2=self.settings.blur_px2 * scale * scale)
        return replace(self, settings=settings)

    def render_layer(
        self,
        camera: Camera,
        clip: HeightClip | None,
        buffers: frozenset[str],
        pixel_mask: Bool[Tensor, "H W"] | None = None,
        photo_share: Float[Tensor, "H W"] | None = None,
    ) -> RenderOutput:
        """Return the buffers of the layer, without sky, with colours as seen through the fog.

        Args:
            camera: the view, or a window of it.
            clip: the level plane and the side of it to render; None renders both sides.
            buffers: names of the buffers to compute.
            pixel_mask: pixels to render; None renders all.
            photo_share: share of each pixel of a photo that shows this layer, 0 to 1; None means 1
                everywhere.
        """
        raster = self._draw_level(camera, clip, buffers, pixel_mask, photo_share)
        if self.fog is None or self.fog.elevation_gain == 0:
            return raster
        with timed("airlight by elevation"):
            rgb = add_airlight_elevation(raster, camera, self.fog, backend=self.backend)
        return replace(raster, rgb=rgb)

    def _draw_level(
        self,
        camera: Camera,
        clip: HeightClip | None,
        buffers: frozenset[str],
        pixel_mask: Bool[Tensor, "H W"] | None = None,
        photo_share: Float[Tensor, "H W"] | None = None,
    ) -> RenderOutput:
        """Return the buffers of the layer, with the airlight of the horizon at every elevation."""
        buffer_fog = self.fog if self.applies_fog_to_buffers else None
        photo = self.photo if self.photo is not None and self.photo.is_seen_by(camera) else None
        parts = self.parts
        is_photo = photo is not None and photo.camera is camera and photo_share is None
        moves_edges = is_photo and (clip is None or clip.kept_side == ABOVE)
        if photo is not None:
            buffers = buffers | photo.buffers_for(parts)
            parts = blacken_parts(parts) if photo_share is None else parts
            if moves_edges:
                buffers = buffers | {ALPHA, EXPECTED_DEPTH}
        has_elevation_airlight = self.fog is not None and self.fog.elevation_gain > 0
        raster = rasterize(
            parts,
            camera,
            buffers=buffers | {EXPECTED_DEPTH} if buffer_fog or has_elevation_airlight else buffers,
            settings=self.settings,
            fog=None if self.applies_fog_to_buffers else self.fog,
            clip=clip,
            pixel_mask=pixel_mask,
            backend=self.backend,
        )
        if moves_edges:
            raster = self._move_edges(raster, parts, camera, clip, buffers, self.settings)
        if photo is not None:
            with timed("photo"):
                if moves_edges:
                    raster = photo.complete(raster, clip)
                raster = photo.paint(
                    raster, parts, camera, photo_share, parts_sky=self._parts_sky(photo)
                )
        if buffer_fog is not None:
            with timed("smog on buffers"):
                rgb = apply_fog_to_render(raster, camera, buffer_fog, backend=self.backend)
                raster = replace(raster, rgb=rgb)
        return raster

    def render_with_sky(
        self, camera: Camera, buffers: frozenset[str]
    ) -> tuple[Float[Tensor, "H W 3"], RenderOutput]:
        """Return the picture with its sky, not clamped, and the buffers of the scene.

        Args:
            camera: the view.
            buffers: names of the buffers to compute.
        """
        if self.photo is not None:
            return self._draw_on_photo(self.photo, camera, buffers)
        fog = self.fog if self.fog is not None and self.fog.scale_height_m is None else None
        if fog is not None and fog.elevation_gain > 0:
            with timed("rasterise"):
                raster = self._draw_level(camera, None, buffers)
            with timed("airlight by elevation"):  # of the surfaces and behind them at once
                return add_airlight_elevation(
                    raster, camera, fog, has_fog_behind=True, backend=self.backend
                ), raster
        with timed("rasterise"):
            raster = self.render_layer(camera, None, buffers)
        assert raster.rgb is not None and raster.alpha is not None
        with timed("sky" if fog is None else "airlight behind the splats"):  # which hides the sky
            return self.add_sky(raster.rgb, raster.alpha, camera), raster

    def add_sky(
        self, rgb: Float[Tensor, "H W 3"], alpha: Float[Tensor, "H W"], camera: Camera
    ) -> Float[Tensor, "H W 3"]:
        """Return a layer's colours with the sky behind them, seen through the fog.

        Args:
            rgb: colours of the layer without sky, display-encoded.
            alpha: opacity of the layer.
            camera: the view that was rendered, or a window of it.
        """
        if self.photo is None:
            return composite_sky(rgb, alpha, camera, self.sky, fog=self.fog, backend=self.backend)
        sky = self.photo.sky_colors(camera, parts_sky=self._parts_sky(self.photo))
        if self.fog is not None:
            ray_slope = camera.ray_directions(rgb.dtype, rgb.device)[..., 2]
            ray_slope = ray_slope / camera.ray_lengths(rgb.dtype, rgb.device)
            tau = sky_image_depth(self.fog, camera, ray_slope, backend=self.backend)
            sky = blend_airlight(sky, tau, self.fog, ray_slope)
        return rgb + (1 - alpha)[..., None] * sky

    def _move_edges(
        self,
        raster: RenderOutput,
        parts: Sequence[PosedGaussians],
        camera: Camera,
        clip: HeightClip | None,
        buffers: frozenset[str],
        settings: RasterSettings,
    ) -> RenderOutput:
        """Return the buffers of the photo's view with objects that end where the photo shows it.

        Args:
            raster: the buffers.
            parts: the parts that they show.
            camera: the camera of the photo.
            clip: the level plane above which they are drawn; None without a plane.
            buffers: names of the buffers.
            settings: settings of the rasteriser.
        """
        assert self.photo is not None and raster.alpha is not None
        with timed("photo: outlines"):
            covers_scene = clip is not None or any(part.is_overlay for part in self.parts)
            objects = self.parked() if covers_scene and self.parked is not None else None
            parked = take_objects(self.parts, objects, camera)
            edges = find_edges(
                self.parts,
                raster,
                camera,
                self.photo.pixels,
                settings=settings,
                clip=clip,
                parked=parked,
                backend=self.backend,
            )
        if edges is None:
            return raster
        with timed("photo: background of objects"):
            is_needed = np.ascontiguousarray(edges.shows_background[edges.window])
            background = rasterize(
                edges.background_of(parked.hide(parts, edges.instance_ids)),
                edges.window_of(camera),
                buffers=buffers,
                settings=settings,
                clip=clip,
                pixel_mask=torch.from_numpy(is_needed).to(raster.alpha.device),
                backend=self.backend,
            )
            return edges.apply(raster, background, parts)

    def _draw_on_photo(
        self, photo: Photo, camera: Camera, buffers: frozenset[str]
    ) -> tuple[Float[Tensor, "H W 3"], RenderOutput]:
        """Return the photo with what lies on the scene, seen through the smog up to each pixel's
        depth,
        and the buffers of the scene.
        """
        parts, photo_buffers = photo.prepare_parts(self.parts)
        requested_buffers = (buffers - {RGB}) | photo_buffers | {ALPHA, EXPECTED_DEPTH}
        with timed("rasterise"):
            settings = replace(self.settings, sh_degree=0)  # one colour in all bands
            raster = rasterize(
                parts, camera, buffers=requested_buffers, settings=settings, backend=self.backend
            )
        raster = self._move_edges(raster, parts, camera, None, requested_buffers, settings)
        with timed("photo"):
            raster = photo.complete(raster)
            if self.fog is None:
                return photo.clear_picture(raster, parts), raster
        with timed("smog on buffers"):
            rgb, fog_share = photo.fade(raster, parts, self.fog)
            return rgb, replace(raster, fog_share=fog_share)

    def _parts_sky(self, photo: Photo) -> bool:
        """Return True if sky and surfaces of a photo's mixed pixels get different weather."""
        return photo.matte is not None and (self.fog is not None or photo.style is not None)
