"""Pictures on recorded images: the photo stays the picture, and the scene supplies the weather.

In: a scene with recorded images, and one of its cameras (`open_photo`). Out: a `Photo`, whose
methods give `augment.view.layers.LayerRenderer` the colours of surfaces and sky and the
transmittance of smog. `check_photos` and `check_base` refuse recipes that need images which were
not recorded.

P is the photo in the scene's colours, mapped where a style asks for it. The scene is rendered for
alpha, depth, and the share o and colours S of what lies on the scene (snow). T is the transmittance
of the smog. Then

    clear = (1 - o) P + S
    picture = T clear + (1 - T) airlight         T = alpha T(depth) + (1 - alpha) T(sky)

A layer of a flooded scene shows (alpha - o) P + S in place of its splats' colours. So what stands
in the water, what lies under it and what the water reflects has the photo's colours. Only views
that the photo does not hold, as the mirrored one, show splats.

T and the sky's share are those of splats, whose edges lie pixels beside the photo's. A guided
filter (He, Sun and Tang 2013, "Guided Image Filtering") moves them to the photo's. Things close to
the camera lie further off. Beside edges that the photo does not show, T is therefore taken from its
surroundings, as far as the photo shows no edge between (Min et al. 2014, "Fast Global Image
Smoothing Based on Weighted Least Squares").
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from jaxtyping import Float, Int16, Int64, UInt8
from torch import Tensor

from augment.errors import SceneError
from augment.files.recorded_images import ImageFault, has_image, read_scaled
from augment.light.cast_shadows import FadedShadows
from augment.memo import memo_of
from augment.photo.photo_objects import copy_size
from augment.photo.photo_surface import CLEAR_ALPHA, MIN_ROAD_FALL, OPAQUE_ALPHA, complete_surfaces
from augment.photo.sky_matte import SkyMatte, sky_matte, sky_matte_of_view
from augment.render import photo_kernels as kernels
from augment.render.buffers import (
    AUTO,
    CPU,
    CUDA,
    OVERLAY,
    RGB,
    SPLAT_IDS,
    RenderOutput,
    choose_kernels,
)
from augment.render.composite import add_airlight_elevation, apply_color_map, unit_depth_coordinates
from augment.render.cuda import runtime as gpu
from augment.render.fog import Fog
from augment.render.fog_image import image_optical_depth, sky_image_depth
from augment.render.layout import HeightClip
from augment.render.threads import kernel_threads
from augment.scene.cameras import Camera, Frame
from augment.scene.scene import PosedGaussians, Scene
from augment.scene.semantics import SemanticClass
from recipes.schema import Recipe

# Radius of the guided filter, as a part of the image's width.
FILTER_RADIUS_FRACTION = 1 / 320
# Resolution of the guided filter's windows where the photo's sky is known.
MATTE_FILTER_SCALE = 0.5
# Radius from which they are coarser, pixels.
MIN_COARSE_RADIUS_PX = 4
# Variance of display-encoded colour that the guided filter counts as an edge.
EDGE_VARIANCE = 0.05**2
# Radius for the sky's share, in radii: splats of sky and of pale walls are told apart badly.
SKY_RADIUS_FACTOR = 4
# Distance by which splats lie beside what the photo shows, metres: many pixels for close things.
EDGE_OFFSET_M = 0.12
# Least contrast of an edge of T between surfaces that may have to be moved.
MIN_TRANSMITTANCE_STEP = 0.1
# Offset of an edge below which it stays, pixels.
MIN_EDGE_OFFSET_PX = 2
# Largest offset of an edge, as a part of the image's width.
MAX_OFFSET_FRACTION = 1 / 30
# Width of the copy in which edges are moved, pixels.
ALIGNED_PX = 480
# Least contrast of an edge of the photo, of 255.
MIN_PHOTO_CONTRAST = 26
# Size of the neighbourhood in which most of T's edges must lie on edges of the photo to be where
# they belong, as a part of the image's width.
NEIGHBOURHOOD_FRACTION = 1 / 20
# Least weight of T in the smoothing, for what is nothing but edge; T counts more far from edges.
MIN_WEIGHT = 0.02
# Strength of the smoothing (lambda of Min et al. 2014), squared pixels.
SMOOTHING_RADIUS_PX2 = 1000.0
# Colour difference that stops the smoothing (sigma of Min et al. 2014), of 255.
COLOR_SIGMA = 5.0
# Largest condition number of a colour map that is undone: 8 bits come back exactly.
MAX_CONDITION = 1e3
# Largest height of a camera above the road, metres; more is a hill's.
MAX_CAMERA_HEIGHT_M = 4.0
# Image rows that a thread takes at a time.
ROWS_PER_THREAD = 32
# Colour map that leaves black.
_NO_COLOR = torch.zeros(1, 3, 4)

# ---- The recorded image of a camera --------------------------------------------------------------


def check_photos(
    recipes: Iterable[Recipe],
    scene_name: str,
    selection: Iterable[tuple[Frame, Sequence[str]]],
    *,
    is_path: bool = False,
) -> None:
    """Refuse recipes on recorded images where one of the selected images was not recorded.

    Args:
        recipes: the recipes of the job.
        scene_name: names the scene in the message.
        selection: frames and the names of their cameras.
        is_path: if True, the frames are of a camera path.

    Raises:
        SceneError: names the missing image, and says what to do.
    """
    names = sorted({recipe.name for recipe in recipes if recipe.render.is_on_recorded})
    if not names:
        return
    request = f"recipe {', '.join(names)}: render.base is 'recorded'"
    if is_path:
        raise SceneError(
            f"{request}, and a camera path shows what no camera of scene {scene_name!r} recorded; "
            f"render it with base: splats"
        )
    views = [(frame, name) for frame, cameras in selection for name in cameras]
    missing_views = [v for v in views if not has_image(Path(v[0].image_paths.get(v[1], "")))]
    if missing_views:
        frame, name = missing_views[0]
        path = frame.image_paths.get(name)
        reason = "none is known" if path is None else f"{path} is not there"
        raise SceneError(
            f"{request}, but {len(missing_views)} of {len(views)} selected images of scene "
            f"{scene_name!r} have no recorded one; the first is camera {name!r} of frame "
            f"{frame.index}: {reason}. Select other cameras or frames, say where the recording has "
            f"moved (data=URI of a fitted scene), or render with base: splats"
        )


def check_base(recipe: Recipe, scene: Scene) -> None:
    """Refuse a recipe on recorded images that no camera of the scene can serve.

    Raises:
        SceneError: the scale is above 1, or the scene has no recorded images.
    """
    if not recipe.render.is_on_recorded:
        return
    request = f"recipe {recipe.name}: render.base is 'recorded'"
    if recipe.render.scale > 1:
        raise SceneError(
            f"{request}, which holds no more pixels than were recorded; render.scale must be <= 1, "
            f"got {recipe.render.scale:g}"
        )
    if scene.moved_instances:
        number = min(scene.moved_instances)
        raise SceneError(
            f"{request}, and the recorded images show the actors of scene {scene.name!r} where "
            f"they were recorded, but {len(scene.moved_instances)} of them were moved, removed or "
            f"added (the first is {scene.actors[number - 1].track_id!r}); render it with base: "
            f"splats"
        )
    if not any(frame.image_paths for frame in scene.frames):
        raise SceneError(
            f"{request}, but scene {scene.name!r} ({scene.source}) has no recorded images; open "
            f"the recording or a scene fitted to it, or render with base: splats"
        )


def find_recorded(scene: Scene, camera: Camera) -> tuple[Path, Camera]:
    """Return the path of the image that a camera recorded, and that camera at the image's own size.

    Args:
        scene: the scene.
        camera: a camera of the scene, at any scale; found by name, time and pose.

    Raises:
        SceneError: the camera has no recorded image.
    """

    def index() -> dict[tuple[str, int], list[tuple[Path, Camera]]]:
        images_by_key = defaultdict(list)
        for frame in scene.frames:
            for name, path in frame.image_paths.items():
                if (recorded_camera := frame.cameras.get(name)) is not None:
                    images_by_key[name, recorded_camera.timestamp_ns].append(
                        (Path(path), recorded_camera)
                    )
        return dict(images_by_key)

    scene = scene.as_recorded
    images = memo_of(scene).get(("recorded images",), index)
    for path, recorded_camera in images.get((camera.name, camera.timestamp_ns), ()):
        if _is_window(recorded_camera.resized(camera.width, camera.height), camera):
            return path, recorded_camera
    raise SceneError(
        f"scene {scene.name!r} has no recorded image of camera {camera.name!r} at "
        f"{camera.timestamp_ns} ns, this pose and this focal length; with render.base 'recorded' "
        f"only what was recorded can be rendered, all else takes base: splats"
    )


def _is_window(outer: Camera, inner: Camera) -> bool:
    """Return True if both look through one lens at one moment, with pixels of one size."""
    focal_difference = max(abs(outer.fx / inner.fx - 1), abs(outer.fy / inner.fy - 1))
    return focal_difference < 1e-9 and torch.equal(outer.camera_from_world, inner.camera_from_world)


# ---- The photo in place of the scene's colours ---------------------------------------------------


@dataclass(frozen=True, eq=False)
class PhotoStyle:
    """A style's colour maps for a photo."""

    surface_maps: Float[Tensor, "C 3 4"]
    """Maps of surfaces, [C, 3, 4]: one, or one a class."""
    sky_map: Float[Tensor, "3 4"]
    """Map of the sky."""
    sky_levels: Float[Tensor, " M"] | None = None
    """Share of sky in each of the background's M - 2 splats, 0 to 1, between a zero for no splat
    and a zero for actors' splats; None where no splat shows sky."""
    other_splat_maps: Float[Tensor, "K 3 4"] | None = None
    """Those of the splats' maps that differ from the first; None where there are none."""
    mark_maps: Float[Tensor, "R 3 4"] | None = None
    """Maps that turn any colour into marks: the share of sky in a splat, and how far it takes each
    of `other_splat_maps`; [R, 3, 4], by rows of the background's splats, or by classes where
    `mark_rows` is None. None where there is nothing to mark, or where `other_splat_maps` are more
    than two.
    """
    mark_rows: Int16[Tensor, " N"] | None = None
    """Row of `marks` of each splat of the background; None where `marks` go by classes."""

    def with_marks(self, parts: Sequence[PosedGaussians]) -> tuple[PosedGaussians, ...]:
        """Return the parts in the colours of their marks."""
        assert self.mark_maps is not None
        class_marks = self.mark_maps[: len(self.surface_maps)].contiguous()
        return tuple(
            replace(part, color_maps=class_marks, color_rows=None)
            if part.instance_id > 0 or self.mark_rows is None
            else replace(part, color_maps=self.mark_maps, color_rows=self.mark_rows)
            for part in parts
        )


@dataclass(frozen=True, eq=False)
class Photo:
    """A recorded image in place of the scene's colours."""

    camera: Camera
    """Camera that took the image, at the photo's size."""
    pixels: UInt8[np.ndarray, "H W 3"]
    """The image as recorded."""
    backend: str
    """Backend that draws."""
    scene_from_recorded: Float[Tensor, "3 4"] | None = None
    """Map from recorded colours to the scene's, which the camera's colour map turns back in the
    finished picture; None where they are the same."""
    height_m: float | None = None
    """Height of the camera above the road, metres; None where unknown."""
    style: PhotoStyle | None = None
    """Colour maps of a style; None without a style."""
    faded_shadows: FadedShadows | None = None
    """Shadows on the ground that fade in smog; None where none fade."""
    matte: SkyMatte | None = None
    """Sky of the photo; None where it is not known, or nobody asks: then splats tell the sky."""

    def is_seen_by(self, camera: Camera) -> bool:
        """Return True if the camera is a window of the photo's."""
        return _is_window(self.camera, camera)

    def buffers_for(self, parts: Sequence[PosedGaussians]) -> frozenset[str]:
        """Return the buffers that painting layers of these parts needs."""
        buffers = {RGB, OVERLAY} if any(part.is_overlay for part in parts) else set[str]()
        if self.style is not None and (
            len(self.style.surface_maps) > 1 or self.style.sky_levels is not None
        ):
            buffers.add(SPLAT_IDS)
        return frozenset(buffers)

    def prepare_parts(
        self, parts: Sequence[PosedGaussians]
    ) -> tuple[tuple[PosedGaussians, ...], frozenset[str]]:
        """Return the parts and the buffers that `clear_picture` needs."""
        if self._takes_marks(parts):
            assert self.style is not None
            return self.style.with_marks(parts), frozenset({RGB})
        return blacken_parts(parts), self.buffers_for(parts)

    def _takes_marks(self, parts: Sequence[PosedGaussians]) -> bool:
        """Return True if splats show marks of the style in place of their colours.

        This takes half as long as finding the heaviest splat of each pixel.
        """
        marks = None if self.style is None else self.style.mark_maps
        return marks is not None and not any(part.is_overlay for part in parts)

    def paint(
        self,
        raster: RenderOutput,
        parts: Sequence[PosedGaussians],
        camera: Camera,
        photo_share: Float[Tensor, "H W"] | None = None,
        *,
        parts_sky: bool = False,
    ) -> RenderOutput:
        """Return a layer that shows the photo in place of its splats.

        Args:
            raster: buffers of `blacken_parts` parts; with `photo_share`, of the parts in their own
                colours.
            parts: the parts of the layer.
            camera: the view, a window of the photo's camera.
            photo_share: share of each pixel of the photo that shows the layer; the rest keeps the
                parts' colours. None means 1 everywhere.
            parts_sky: if True, mixed pixels show the colour of their surface without the sky.
        """
        assert raster.rgb is not None and raster.alpha is not None
        surface_rgb, sky_rgb, sky_share = self.layer_colors(
            raster, parts, camera, parts_sky=parts_sky
        )
        surface = surface_rgb if sky_share is None else mix(surface_rgb, sky_rgb, sky_share)
        surface = self._without_sun(surface, raster, camera)
        if photo_share is not None:
            weight = photo_share if camera is self.camera else photo_share * self._inside(camera)
            rest_rgb = (1 - weight)[..., None] * raster.rgb
            return replace(raster, rgb=add_weighted(rest_rgb, surface, weight * raster.alpha))
        is_complete = self.matte is not None and camera is self.camera
        alpha = photo_alpha = raster.alpha if is_complete else opaque_alpha(raster.alpha)
        if raster.overlay is not None:
            alpha = torch.maximum(alpha, raster.overlay)
            photo_alpha = alpha - raster.overlay
        return replace(raster, rgb=add_weighted(raster.rgb, surface, photo_alpha), alpha=alpha)

    def clear_picture(
        self,
        raster: RenderOutput,
        parts: Sequence[PosedGaussians],
        sky_weight: Float[Tensor, " M"] | None = None,
    ) -> Float[Tensor, "H W 3"]:
        """Return the photo with what lies on the scene, before any smog.

        Args:
            raster: buffers of the parts that `prepare_parts` gives.
            parts: those parts.
            sky_weight: weight of the sky's colour in each mixed pixel, against the surface's; None
                for the share that the photo shows.
        """
        if self._is_only_covered(raster, sky_weight):
            assert raster.rgb is not None and raster.overlay is not None
            return self._mix_on_cpu(raster.overlay, raster.rgb, is_premultiplied=True)
        rgb = self._land if self.style is None else self._styled(self.style, raster, parts)
        if self.matte is not None and (sky_weight is not None or self.style is not None):
            rgb = self._mix_parted(rgb, sky_weight)
        rgb = self._without_sun(rgb, raster, self.camera)
        if raster.overlay is None:
            return rgb
        assert raster.rgb is not None
        return add_weighted(raster.rgb, rgb, 1 - raster.overlay)

    def _is_only_covered(self, raster: RenderOutput, sky_weight: Tensor | None) -> bool:
        """Return True if the picture is the photo with snow on it, and the CPU draws it."""
        has_weights = self.matte is not None and sky_weight is not None
        if raster.overlay is None or raster.rgb is None or has_weights:
            return False
        is_plain = self.style is None and self.faded_shadows is None
        return is_plain and choose_kernels(self.backend, raster.rgb, raster.overlay) == CPU

    def _mix_on_cpu(
        self,
        weight: Float[Tensor, "H W"],
        other: Float[Tensor, "#H #W 3"],
        *,
        is_premultiplied: bool,
    ) -> Float[Tensor, "H W 3"]:
        """Return the photo mixed with another image, in one pass over the pixels.

        Args:
            weight: share of each pixel that shows the other image.
            other: the other image.
            is_premultiplied: True if the other image is given times its weight.
        """
        color_map = self.scene_from_recorded
        matrix = np.eye(3, 4, dtype=np.float32) if color_map is None else color_map.numpy()
        out = np.empty(self.pixels.shape, np.float32)
        arrays = (image.detach().contiguous().numpy() for image in (weight, other))
        with kernel_threads(ROWS_PER_THREAD):
            kernels.mix_photo(self.pixels, matrix, *arrays, is_premultiplied, out)
        return torch.from_numpy(out)

    def _styled(
        self, style: PhotoStyle, raster: RenderOutput, parts: Sequence[PosedGaussians]
    ) -> Float[Tensor, "H W 3"]:
        """Return the photo in the colours of a style."""
        assert raster.alpha is not None
        alpha = raster.alpha
        if not self._takes_marks(parts):
            surface_rgb, sky_rgb, sky_level = self.layer_colors(raster, parts, self.camera)
            return mix(surface_rgb, sky_rgb, self._sharp_sky_share(alpha, sky_level))
        marks = raster.rgb
        assert marks is not None
        solid_alpha = alpha.clamp_min(1e-6)
        if self.matte is None and choose_kernels(self.backend, alpha, marks) == CPU:
            share = self.sharpen(self._marked_share_on_cpu(alpha, marks), SKY_RADIUS_FACTOR)
        else:
            share = self._sharp_sky_share(alpha, (marks[..., 0] / solid_alpha).clamp_max(1))
        if style.other_splat_maps is None and self.backend == CPU:
            return self._in_both_on_cpu(style, share)
        surface_rgb = self._land
        for number, splat_map in enumerate(
            () if style.other_splat_maps is None else style.other_splat_maps
        ):
            weight = (marks[..., 1 + number] / solid_alpha).clamp_max(1)
            surface_rgb = mix(surface_rgb, self._in_colors(splat_map), weight)
        return mix(surface_rgb, self._sky, share)

    def _sharp_sky_share(
        self, alpha: Float[Tensor, "H W"], sky_level: Float[Tensor, "H W"] | None
    ) -> Float[Tensor, "H W"]:
        """Return the share of sky in each pixel, with the photo's edges: the matte's if known."""
        if self.matte is not None:
            return torch.from_numpy(self.matte.sky_share).to(self._device)
        return self.sharpen(self._sky_share(alpha, sky_level), SKY_RADIUS_FACTOR)

    def _sky_share(
        self, alpha: Float[Tensor, "H W"], sky_level: Float[Tensor, "H W"] | None
    ) -> Float[Tensor, "H W"]:
        """Return the share of sky in each pixel: beside the surfaces, and painted on them."""
        alpha = opaque_alpha(alpha)
        share = 1 - alpha if sky_level is None else 1 - alpha * (1 - sky_level)
        if self.height_m is not None:
            share = share.masked_fill(self.ray_fall > MIN_ROAD_FALL, 0.0)
        return share

    def _marked_share_on_cpu(self, alpha: Tensor, marks: Tensor) -> Tensor:
        """Return the share of sky in each pixel, from marks, by the CPU kernel."""
        out = np.empty(tuple(alpha.shape), np.float32)
        fall = (-self.camera.world_from_camera[2, :3]).tolist()
        numbers = (CLEAR_ALPHA, OPAQUE_ALPHA), *unit_depth_coordinates(self.camera)
        numbers = *numbers, (*fall, math.inf if self.height_m is None else MIN_ROAD_FALL)
        with kernel_threads(ROWS_PER_THREAD):
            kernels.compute_sky_share(
                alpha.detach().numpy(),
                marks.detach().numpy(),
                *(np.asarray(n, np.float32) for n in numbers),
                out,
            )
        return torch.from_numpy(out)

    def _in_both_on_cpu(self, style: PhotoStyle, share: Tensor) -> Tensor:
        """Return the photo in the style's maps of surfaces and sky, mixed by the share of sky."""
        maps = (
            _composed(style_map, self.scene_from_recorded).numpy()
            for style_map in (style.surface_maps[0], style.sky_map)
        )
        out = np.empty(self.pixels.shape, np.float32)
        with kernel_threads(ROWS_PER_THREAD):
            kernels.map_photo_colors_with_sky(self.pixels, *maps, share.numpy(), out)
        return torch.from_numpy(out)

    def layer_colors(
        self,
        raster: RenderOutput,
        parts: Sequence[PosedGaussians],
        camera: Camera,
        *,
        parts_sky: bool = False,
    ) -> tuple[Tensor, Tensor, Tensor | None]:
        """Return colours of surfaces [H, W, 3] and of the sky, and the share of sky in surfaces [H,
        W].

        Colours are the scene's, not clamped, at the pixels of a window. The share is None where no
        surface shows sky.
        """
        surface_rgb = self._cut(self._parted[0] if parts_sky else self._land, camera)
        style = self.style
        sky_share = None
        if style is None:
            return surface_rgb, self.sky_colors(camera, parts_sky=parts_sky), None
        if len(style.surface_maps) > 1:
            assert raster.splat_ids is not None
            has_splat = raster.splat_ids >= 0
            table = splat_classes(parts, surface_rgb.device)
            classes = torch.where(has_splat, table[raster.splat_ids.clamp_min(0)], 0)
            for class_number in torch.unique(classes).tolist():
                if class_number and not torch.equal(
                    style.surface_maps[class_number], style.surface_maps[0]
                ):
                    class_rgb = self._cut(self._in_colors(style.surface_maps[class_number]), camera)
                    surface_rgb = torch.where(
                        (classes == class_number)[..., None], class_rgb, surface_rgb
                    )
        if style.sky_levels is not None and self.matte is None:
            assert raster.splat_ids is not None
            levels = style.sky_levels.to(surface_rgb.device)
            sky_share = levels[(raster.splat_ids + 1).clamp_max(len(levels) - 1)]
        return surface_rgb, self.sky_colors(camera, parts_sky=parts_sky), sky_share

    def _without_sun(
        self, rgb: Float[Tensor, "H W 3"], raster: RenderOutput, camera: Camera
    ) -> Float[Tensor, "H W 3"]:
        """Return the colours of surfaces with the shadows on the ground faded."""
        depth = raster.expected_depth
        alpha = raster.alpha
        if self.faded_shadows is None or depth is None or alpha is None:
            return rgb
        small_camera = camera.resized(*copy_size(camera, ALIGNED_PX))
        z, small_alpha = (
            cv2.resize(
                buffer.detach().cpu().float().contiguous().numpy(),
                (small_camera.width, small_camera.height),
                interpolation=cv2.INTER_NEAREST,
            )
            for buffer in (depth, alpha)
        )
        points = z[..., None] * small_camera.ray_directions().numpy() + camera.centre.numpy()
        points[small_alpha < 0.5] = math.inf
        lit_share, factors = self.faded_shadows.gains_at(points.astype(np.float32))
        lit_share = cv2.resize(
            lit_share, (camera.width, camera.height), interpolation=cv2.INTER_LINEAR
        )
        if camera is self.camera:
            lit_share = self.sharpen(torch.from_numpy(lit_share), SKY_RADIUS_FACTOR).numpy()
        lit_steps = cv2.merge([np.rint(lit_share * 255).astype(np.uint8)] * 3)
        return rgb * torch.from_numpy(cv2.LUT(lit_steps, factors[None])).to(rgb.device)

    def own_car_colors(self, rows: slice) -> Float[Tensor, "h W 3"]:
        """Return rows of the photo in the colours of the recording car: those of vehicles.

        The caller may write into them.

        Args:
            rows: the rows.
        """
        style = self.style
        if style is None:
            return self._in_colors(None, rows)
        number = 0 if len(style.surface_maps) == 1 else int(SemanticClass.VEHICLE)
        return self._in_colors(style.surface_maps[number], rows)

    def is_land(self, rgb: Float[Tensor, "H W 3"]) -> bool:
        """Return True if an image is the photo that later passes read, so that nobody writes it.

        Args:
            rgb: the image.
        """
        land = self.__dict__.get("_land")
        return land is not None and rgb.data_ptr() == land.data_ptr()

    def sky_colors(self, camera: Camera, *, parts_sky: bool = False) -> Float[Tensor, "H W 3"]:
        """Return the sky's colours at the pixels of a window.

        Args:
            camera: the window.
            parts_sky: if True, mixed pixels show the colour of the sky without their surface.
        """
        if parts_sky:
            return self._cut(self._parted[1], camera)
        return self._cut(self._land if self.style is None else self._sky, camera)

    @cached_property
    def _land(self) -> Float[Tensor, "H W 3"]:
        """Return the photo in the colours of surfaces."""
        return self._in_colors(None if self.style is None else self.style.surface_maps[0])

    @cached_property
    def _sky(self) -> Float[Tensor, "H W 3"]:
        """Return the photo in the colours of the sky."""
        assert self.style is not None
        return self._in_colors(self.style.sky_map)

    # ---- Mixed pixels at the sky line

    @cached_property
    def _mixed_pixels(self) -> Int64[np.ndarray, " M"]:
        """Return the flat indices of pixels that show both sky and a surface."""
        assert self.matte is not None
        share = self.matte.sky_share
        return np.flatnonzero((share > 0) & (share < 1))

    @cached_property
    def _mixed_colors(self) -> tuple[Float[Tensor, "M 3"], Float[Tensor, "M 3"]]:
        """Return the colours of surfaces and of the sky in mixed pixels, in the scene's colours."""
        assert self.matte is not None
        share = self.matte.sky_share.reshape(-1)[self._mixed_pixels, None]
        surface = self.matte.surface_rgb.reshape(-1, 3)[self._mixed_pixels].astype(np.float32)
        mixed_levels = self.pixels.reshape(-1, 3)[self._mixed_pixels]
        sky = np.clip((mixed_levels - (1 - share) * surface) / share, 0, 255)
        style = self.style
        style_maps = (None, None) if style is None else (style.surface_maps[0], style.sky_map)
        surface_rgb, sky_rgb = (
            self._map_levels(torch.from_numpy(levels), style_map)
            for levels, style_map in zip((surface, sky), style_maps, strict=True)
        )
        return surface_rgb, sky_rgb

    def _map_levels(
        self, levels: Float[Tensor, "M 3"], style_map: Float[Tensor, "3 4"] | None
    ) -> Float[Tensor, "M 3"]:
        """Return colours of the photo, 0 to 255, as `_in_colors` does."""
        rgb = levels.to(self._device) / 255
        color_map = self.scene_from_recorded
        if style_map is not None:
            color_map = _composed(style_map, self.scene_from_recorded)
        if color_map is None:
            return rgb
        color_map = color_map.to(rgb.device)
        mapped = rgb @ color_map[:, :3].T + color_map[:, 3]
        return mapped if style_map is None else mapped.clamp_min(0)

    @cached_property
    def _parted(self) -> tuple[Float[Tensor, "H W 3"], Float[Tensor, "H W 3"]]:
        """Return the colours of surfaces and of the sky, each without the other in mixed pixels."""
        land = self._land
        sky = self._land if self.style is None else self._sky
        if self.matte is None:
            return land, sky
        surface_rgb, sky_rgb = self._mixed_colors
        return self._with_mixed(land, surface_rgb), self._with_mixed(sky, sky_rgb)

    def _with_mixed(
        self, image: Float[Tensor, "H W 3"], colors: Float[Tensor, "M 3"]
    ) -> Float[Tensor, "H W 3"]:
        """Return a copy of an image with other colours in mixed pixels."""
        pixels = torch.from_numpy(self._mixed_pixels).to(image.device)
        return image.flatten(0, 1).index_copy(0, pixels, colors.to(image)).view_as(image)

    def _mix_parted(
        self, rgb: Float[Tensor, "H W 3"], sky_weight: Float[Tensor, " M"] | None
    ) -> Float[Tensor, "H W 3"]:
        """Return a picture whose mixed pixels weigh the colours of sky and surface anew."""
        assert self.matte is not None
        if not len(self._mixed_pixels):
            return rgb
        if sky_weight is None:
            share = self.matte.sky_share.reshape(-1)[self._mixed_pixels]
            sky_weight = torch.from_numpy(share)
        return self._with_mixed(rgb, self._weigh_mixed(sky_weight))

    def _weigh_mixed(self, sky_weight: Float[Tensor, " M"]) -> Float[Tensor, "M 3"]:
        """Return the colours of mixed pixels by the weight of their sky."""
        surface_rgb, sky_rgb = self._mixed_colors
        weight = sky_weight.to(surface_rgb)[:, None]
        return (1 - weight) * surface_rgb + weight * sky_rgb

    def surface_part(
        self, rgb: Float[Tensor, "H W 3"], alpha: Float[Tensor, "H W"], fog: Fog | None
    ) -> Float[Tensor, "H W 3"] | None:
        """Return the part of a finished picture that its surfaces have, without that of the sky.

        None where the photo's sky is not known.

        Args:
            rgb: the picture.
            alpha: share of surfaces in each pixel.
            fog: the fog in the picture; None for clear air.
        """
        if self.matte is None:
            return None
        black = torch.zeros(1, 1, 3, device=rgb.device)
        surface_part = mix(rgb, black, 1 - alpha)
        pixels = torch.from_numpy(self._mixed_pixels).to(rgb.device)
        if not len(pixels):
            return surface_part
        share = 1 - alpha.flatten()[pixels, None]
        sky = self._mixed_colors[1]
        if fog is not None:
            airlight = self.airlight(fog)
            airlight = airlight.expand_as(rgb).flatten(0, 1)[pixels]
            transmittance = self._sky_transmittance(fog)
            if isinstance(transmittance, Tensor):
                transmittance = transmittance.flatten()[pixels, None]
            sky = airlight + transmittance * (sky - airlight)
        mixed_rgb = rgb.flatten(0, 1)[pixels]
        sky_part = torch.minimum((share * sky).clamp_min(0), mixed_rgb)
        surface_part.flatten(0, 1).index_copy_(0, pixels, mixed_rgb - sky_part)
        return surface_part

    def _in_colors(
        self, style_map: Float[Tensor, "3 4"] | None, rows: slice = slice(None)
    ) -> Float[Tensor, "h W 3"]:
        """Return rows of the photo in the scene's colours, or in a style's map of them, which ends
        at 0.
        """
        color_map = self.scene_from_recorded
        min_value = -math.inf
        if style_map is not None:
            color_map = _composed(style_map, self.scene_from_recorded)
            min_value = 0.0
        if self.backend == CPU:
            levels = self.pixels[rows]
            out = np.empty(levels.shape, np.float32)
            matrix = np.eye(3, 4, dtype=np.float32) if color_map is None else color_map.numpy()
            with kernel_threads(ROWS_PER_THREAD):
                kernels.map_photo_colors(levels, matrix, np.float32(min_value), out)
            return torch.from_numpy(out)
        pixels = torch.from_numpy(self.pixels[rows])
        rgb = (gpu.upload(pixels) if self.backend == CUDA else pixels).float() / 255
        if color_map is None:
            return rgb
        return apply_color_map(rgb, color_map, backend=self.backend).clamp_min(min_value)

    def sharpen(self, values: Float[Tensor, "H W"], times: int = 1) -> Float[Tensor, "H W"]:
        """Return values of 0 to 1 with their edges moved to the photo's.

        Args:
            values: the values.
            times: radius of the guided filter, in FILTER_RADIUS_FRACTION.
        """
        radius = max(2, round(FILTER_RADIUS_FRACTION * times * self.camera.width))
        source = np.ascontiguousarray(values.detach().cpu().float().numpy())
        rows_with_values = np.flatnonzero(source.max(1) > 0)
        if not len(rows_with_values):
            return values
        # No window of the other rows holds a value.
        rows = slice(
            max(0, rows_with_values[0] - 2 * radius), rows_with_values[-1] + 1 + 2 * radius
        )
        # A surface has no edge at the sky line of a matte, so that coarser windows are enough
        # (He and Sun 2015, "Fast Guided Filter"). A guide in colour would take twice as long.
        is_coarse = self.matte is not None and radius >= MIN_COARSE_RADIUS_PX
        scale = MATTE_FILTER_SCALE if is_coarse else 1.0
        guide = cv2.cvtColor(self.pixels[rows], cv2.COLOR_RGB2GRAY)
        sharpened = np.zeros_like(source)
        sharpened[rows] = cv2.ximgproc.guidedFilter(
            guide, source[rows], radius, EDGE_VARIANCE * 255**2, scale=scale
        )
        return torch.from_numpy(np.clip(sharpened, 0, 1, out=sharpened)).to(values.device)

    def complete(self, raster: RenderOutput, clip: HeightClip | None = None) -> RenderOutput:
        """Return the buffers with the surfaces that the photo shows; unchanged without a matte.

        Args:
            raster: the buffers, with alpha and expected depth.
            clip: level plane above which they show the scene: pixels whose rays fall to it stay as
                they are. None without a plane.
        """
        if self.matte is None:
            return raster
        is_complete = None if clip is None else self.ray_fall.cpu().numpy() > 0
        return complete_surfaces(
            raster, self.matte.sky_share, self.pixels, self.camera, self.height_m, is_complete
        )

    def fade(
        self, raster: RenderOutput, parts: Sequence[PosedGaussians], fog: Fog
    ) -> tuple[Float[Tensor, "H W 3"], Float[Tensor, "H W"]]:
        """Return the photo with what lies on the scene, seen through the smog, and the smog's
        share in each pixel.

        Args:
            raster: buffers of the parts that `prepare_parts` gives, with surfaces as `complete`
                makes them.
            parts: those parts.
            fog: the smog.
        """
        if self.matte is None:
            rgb = self.clear_picture(raster, parts)
            fog_share = 1 - self.transmittance(raster, fog)
            return mix(rgb, self.airlight(fog), fog_share), fog_share
        alpha = raster.alpha
        depth = raster.expected_depth
        assert alpha is not None and depth is not None
        surface_transmittance = self._transmittance_of(torch.ones_like(alpha), depth, fog)
        sky_transmittance = self._sky_transmittance(fog)
        # The weight of the sky counts in mixed pixels alone.
        pixels = torch.from_numpy(self._mixed_pixels).to(alpha.device)
        mixed_alpha = alpha.flatten()[pixels]
        sky_weight = (mixed_alpha == 0).to(alpha)
        full_share = torch.ones((), device=alpha.device)
        fog_share = torch.addcmul(full_share, alpha, surface_transmittance, value=-1)
        if isinstance(sky_transmittance, Tensor):
            sky_part = (1 - alpha) * sky_transmittance
            fog_share = fog_share - sky_part
            transmittance = 1 - fog_share.flatten()[pixels]
            mixed_sky_part = sky_part.flatten()[pixels]
            sky_weight = torch.maximum(sky_weight, mixed_sky_part / transmittance.clamp_min(1e-6))
        airlight = self.airlight(fog)
        is_plain = self.style is None and self.faded_shadows is None and raster.overlay is None
        if not is_plain:
            rgb = self.clear_picture(raster, parts, sky_weight)
            return mix(rgb, airlight, fog_share), fog_share
        if choose_kernels(self.backend, airlight, fog_share) == CPU:
            rgb = self._mix_on_cpu(fog_share, airlight, is_premultiplied=False)
        else:
            rgb = mix(self._land, airlight, fog_share)
        mixed_share = fog_share.flatten()[pixels, None]
        mixed_airlight = airlight.expand_as(rgb).flatten(0, 1)[pixels]
        mixed_rgb = (1 - mixed_share) * self._weigh_mixed(sky_weight) + mixed_share * mixed_airlight
        rgb.flatten(0, 1).index_copy_(0, pixels, mixed_rgb)
        return rgb, fog_share

    def _sky_transmittance(self, fog: Fog) -> Float[Tensor, "H W"] | float:
        """Return the transmittance of the smog up to the sky; 0.0 in uniform smog."""
        if fog.scale_height_m is None:
            return 0.0
        lengths = self.camera.ray_lengths(device=self._device)
        slope = -self.ray_fall / lengths
        return torch.exp(-sky_image_depth(fog, self.camera, slope, backend=self.backend))

    def transmittance(self, raster: RenderOutput, fog: Fog) -> Float[Tensor, "H W"]:
        """Return T of what the photo shows, up to the rendered depth, with the photo's edges.

        Where nothing is rendered, T is that of the way to the road or to the sky.
        """
        assert raster.alpha is not None and raster.expected_depth is not None
        return self._transmittance_of(opaque_alpha(raster.alpha), raster.expected_depth, fog)

    def _transmittance_of(
        self, alpha: Float[Tensor, "H W"], depth: Float[Tensor, "H W"], fog: Fog
    ) -> Float[Tensor, "H W"]:
        """Return T of surfaces of an alpha and a depth, with the photo's edges."""
        if fog.banks is None and choose_kernels(self.backend, alpha, depth) == CPU:
            transmittance = self._transmittance_on_cpu(alpha, depth, fog)
            return self.sharpen(self.align_edges(transmittance, alpha, depth))
        camera = self.camera
        device = alpha.device
        fall = self.ray_fall
        lengths = camera.ray_lengths(device=device)
        surface_depth = image_optical_depth(fog, camera, depth, backend=self.backend)
        surface_transmittance = torch.exp(-surface_depth)
        if fog.banks is not None and bool((alpha >= 1).all()):  # no background has to be looked up
            return self.sharpen(self.align_edges(surface_transmittance, alpha, depth))
        background_depth = sky_image_depth(fog, camera, -fall / lengths, backend=self.backend)
        if self.height_m is not None:
            road_m = self.height_m / fall.clamp_min(MIN_ROAD_FALL)
            road_depth = image_optical_depth(fog, camera, road_m, backend=self.backend)
            background_depth = torch.where(fall > MIN_ROAD_FALL, road_depth, background_depth)
        transmittance = alpha * surface_transmittance + (1 - alpha) * torch.exp(-background_depth)
        return self.sharpen(self.align_edges(transmittance, alpha, depth))

    def align_edges(
        self, values: Float[Tensor, "H W"], alpha: Float[Tensor, "H W"], depth: Float[Tensor, "H W"]
    ) -> Float[Tensor, "H W"]:
        """Return values of about 0 to 1, replaced beside edges of close things by those around.

        Args:
            values: the values, such as T.
            alpha: alpha of the surfaces.
            depth: z of the surfaces, metres.
        """
        size = copy_size(self.camera, ALIGNED_PX)
        factor = self.camera.width / size[0]
        full_values, small_alpha, z = (
            image.detach().cpu().float().numpy() for image in (values, alpha, depth)
        )
        small_values = cv2.resize(full_values, size, interpolation=cv2.INTER_AREA)
        small_alpha, z = (
            cv2.resize(image, size, interpolation=cv2.INTER_NEAREST) for image in (small_alpha, z)
        )
        z = np.where(small_alpha > 0.5, z, np.float32(math.inf))
        square = np.ones((5, 5), np.uint8)
        clean_values = cv2.medianBlur(small_values, 5)  # without the dots of a reconstruction
        edges = (_contrast(clean_values) > MIN_TRANSMITTANCE_STEP) & np.isfinite(
            cv2.dilate(z, square)
        )
        nearest_m = np.maximum(cv2.erode(z, square), 1e-3)
        offset_px = np.where(edges, self.camera.fx / factor * EDGE_OFFSET_M / nearest_m, 0)
        if offset_px.max() < MIN_EDGE_OFFSET_PX:
            return values
        guide = cv2.resize(self.pixels, size, interpolation=cv2.INTER_AREA)
        window_px = (max(3, round(NEIGHBOURHOOD_FRACTION * size[0])),) * 2
        is_movable = (offset_px >= MIN_EDGE_OFFSET_PX).astype(np.float32)
        is_unseen = is_movable * (_contrast(guide).max(-1) < MIN_PHOTO_CONTRAST)
        offset_px[cv2.blur(is_unseen, window_px) < 0.5 * cv2.blur(is_movable, window_px)] = 0
        trust = np.ones(small_values.shape, np.float32)
        radius = MIN_EDGE_OFFSET_PX
        while radius <= MAX_OFFSET_FRACTION * size[0]:
            is_beside = offset_px >= radius
            if is_beside.any():
                distance_px = cv2.distanceTransform((~is_beside).astype(np.uint8), cv2.DIST_L2, 3)
                np.minimum(trust, (2 * distance_px / radius - 1).clip(0, 1), out=trust)
            radius *= 2
        if trust.min() == 1:
            return values
        smoother = cv2.ximgproc.createFastGlobalSmootherFilter(
            guide, SMOOTHING_RADIUS_PX2, COLOR_SIGMA
        )
        weight = np.maximum(trust, np.float32(MIN_WEIGHT))
        smoothed = smoother.filter(weight * small_values) / np.maximum(
            smoother.filter(weight), 1e-6
        )
        full_size = (self.camera.width, self.camera.height)
        change = cv2.resize(
            (1 - trust) * (smoothed - small_values), full_size, interpolation=cv2.INTER_LINEAR
        )
        return torch.from_numpy(cv2.add(full_values, change)).to(values)

    def airlight(self, fog: Fog) -> Float[Tensor, "#H #W 3"]:
        """Return the fog's colour at each pixel; [1, 1, 3] where all pixels have the same."""
        if fog.elevation_gain == 0:
            return torch.tensor(fog.airlight_rgb, device=self._device)[None, None]
        size = (self.camera.height, self.camera.width)
        zeros = torch.zeros(size, device=self._device)
        raster = RenderOutput(
            rgb=torch.zeros(*size, 3, device=self._device), alpha=zeros, expected_depth=zeros
        )
        return add_airlight_elevation(
            raster, self.camera, fog, has_fog_behind=True, backend=self.backend
        )

    def _transmittance_on_cpu(self, alpha: Tensor, depth: Tensor, fog: Fog) -> Tensor:
        """Return T up to the rendered depth, by the CPU kernel."""
        camera = self.camera
        out = np.empty(tuple(alpha.shape), np.float32)
        inverse_m = 0.0 if fog.scale_height_m is None else 1 / fog.scale_height_m
        lens = (1 / camera.fx, 1 / camera.fy, camera.cx, camera.cy)
        over_base_m = float(camera.centre[2]) - fog.base_z_m
        numbers = (
            *(lens, (-camera.world_from_camera[2, :3]).tolist()),
            (fog.extinction_per_m, inverse_m, over_base_m),
            (self.height_m or 0.0, MIN_ROAD_FALL),
        )
        arrays = [np.array(values, np.float32) for values in numbers]
        with kernel_threads(ROWS_PER_THREAD):
            kernels.compute_transmittance(alpha.numpy(), depth.detach().numpy(), *arrays, out)
        return torch.from_numpy(out)

    @cached_property
    def ray_fall(self) -> Float[Tensor, "H W"]:
        """Return the metres by which each pixel's ray falls per metre of depth."""
        camera = self.camera
        device = self._device
        x, y, z = (-camera.world_from_camera[2, :3]).tolist()
        u = (torch.arange(camera.width, device=device) + 0.5 - camera.cx) / camera.fx
        v = (torch.arange(camera.height, device=device) + 0.5 - camera.cy) / camera.fy
        return (x * u + z) + (y * v)[:, None]

    def _cut(self, rgb: Float[Tensor, "H W 3"], camera: Camera) -> Float[Tensor, "h w 3"]:
        """Return the photo's image at a window's pixels; beyond its border the border's colours."""
        if camera is self.camera:
            return rgb
        rows, columns = self._places(camera)
        rows = rows.clamp(0, self.camera.height - 1)
        return rgb[rows][:, columns.clamp(0, self.camera.width - 1)]

    def _inside(self, camera: Camera) -> Tensor:
        """Return the mask of a window's pixels that lie inside the photo."""
        rows, columns = self._places(camera)
        down = (rows >= 0) & (rows < self.camera.height)
        across = (columns >= 0) & (columns < self.camera.width)
        return down[:, None] & across

    @property
    def _device(self) -> torch.device:
        """Return the device of the backend."""
        return gpu.gpu_device() if self.backend == CUDA else torch.device("cpu")

    def _places(self, camera: Camera) -> tuple[Tensor, Tensor]:
        """Return the photo's rows and columns of a window's pixels."""
        device = self._device
        top = round(self.camera.cy - camera.cy)
        left = round(self.camera.cx - camera.cx)
        rows = torch.arange(top, top + camera.height, device=device)
        return rows, torch.arange(left, left + camera.width, device=device)


class PhotoView(NamedTuple):
    """A view of an image that was recorded through a lens."""

    pixels: UInt8[np.ndarray, "H W 3"]
    """The image in the view."""
    frame: Frame
    """The frame of the image, with the lenses."""
    lens_camera: Camera
    """The camera with its lens and without its shutter, at the view's place."""


def _read_photo(scene: Scene, camera: Camera) -> UInt8[np.ndarray, "H W 3"]:
    """Return the recorded image of a pinhole camera of the scene, at the camera's size.

    Raises:
        SceneError: there is no photo, or it cannot be read.
    """
    path, recorded_camera = find_recorded(scene, camera)
    try:
        return read_scaled(path, recorded_camera, camera)
    except ImageFault as fault:
        raise SceneError(f"camera {camera.name}: recorded image {path} {fault}") from None


def open_photo(
    scene: Scene,
    camera: Camera,
    color_map: Float[Tensor, "3 4"] | None,
    *,
    backend: str,
    finds_sky: bool = False,
    view: PhotoView | None = None,
) -> Photo:
    """Return the photo of a camera of the scene, at the camera's size, before any style.

    Args:
        scene: the scene.
        camera: one of its cameras, at any scale.
        color_map: colour map that the finished picture gets; None without one.
        backend: backend that draws.
        finds_sky: if True, the photo has its sky matte.
        view: the photo in this view, of a camera with a lens or a shutter; None if the photo is
            that of `camera`.

    Raises:
        SceneError: there is no photo, it cannot be read, or the colour map has no inverse.
    """
    pixels = _read_photo(scene, camera) if view is None else view.pixels
    scene_from_recorded = None
    if color_map is not None:
        matrix = color_map[:, :3].double()
        offset = color_map[:, 3].double()
        if float(torch.linalg.cond(matrix)) > MAX_CONDITION:
            raise SceneError(
                f"scene {scene.name!r}: the colour map of camera {camera.name!r} has no inverse "
                f"({color_map.tolist()}), so its photo has no colours in the scene; render with "
                f"exposure: neutral"
            )
        inverse = torch.linalg.inv(matrix)
        scene_from_recorded = torch.cat([inverse, -(inverse @ offset)[:, None]], 1).float()
    height_m = None
    if scene.has_known_gravity and scene.ground_z_m is not None:
        camera_height_m = float(camera.centre[2]) - scene.ground_z_m
        height_m = min(camera_height_m, MAX_CAMERA_HEIGHT_M) if camera_height_m > 0 else None
    matte = None
    if finds_sky and view is None:
        matte = sky_matte(scene, camera, pixels)
    elif finds_sky and view is not None:
        matte = sky_matte_of_view(scene, view.frame, view.lens_camera, camera, pixels)
    return Photo(camera, pixels, backend, scene_from_recorded, height_m, matte=matte)


def _contrast(image: np.ndarray) -> np.ndarray:
    """Return the difference of the highest and lowest value of each pixel and its neighbours."""
    square = np.ones((3, 3), np.uint8)
    return cv2.dilate(image, square) - cv2.erode(image, square)


def blacken_parts(parts: Sequence[PosedGaussians]) -> tuple[PosedGaussians, ...]:
    """Return the parts in black, except those that lie on the scene.

    The colours of black parts come from the photo.
    """
    return tuple(
        part if part.is_overlay else replace(part, color_maps=_NO_COLOR, color_rows=None)
        for part in parts
    )


def opaque_alpha(alpha: Float[Tensor, "H W"]) -> Float[Tensor, "H W"]:
    """Return the alpha of what the photo shows, 0 to 1, from the alpha of splats."""
    return ((alpha - CLEAR_ALPHA) / (OPAQUE_ALPHA - CLEAR_ALPHA)).clamp(0, 1)


def mix(
    rgb: Float[Tensor, "H W 3"], other: Float[Tensor, "#H #W 3"], weight: Float[Tensor, "H W"]
) -> Float[Tensor, "H W 3"]:
    """Return (1 - weight) rgb + weight other.

    The result equals `rgb` to the bit where the weight is 0, and `other` where it is 1.
    """
    if choose_kernels(AUTO, rgb, other, weight) != CPU:
        return (1 - weight)[..., None] * rgb + weight[..., None] * other
    return _run(kernels.blend_images, rgb, other, weight)


def add_weighted(
    base: Float[Tensor, "H W 3"], rgb: Float[Tensor, "H W 3"], weight: Float[Tensor, "H W"]
) -> Float[Tensor, "H W 3"]:
    """Return base + weight rgb."""
    if choose_kernels(AUTO, base, rgb, weight) != CPU:
        return base + weight[..., None] * rgb
    return _run(kernels.add_weighted, base, rgb, weight)


def _run(kernel: Any, *images: Tensor) -> Tensor:
    """Return the image that a CPU kernel makes of some images."""
    out = np.empty(tuple(images[0].shape), np.float32)
    with kernel_threads(ROWS_PER_THREAD):
        kernel(*(image.detach().contiguous().numpy() for image in images), out)
    return torch.from_numpy(out)


def _composed(
    outer: Float[Tensor, "3 4"], inner: Float[Tensor, "3 4"] | None
) -> Float[Tensor, "3 4"]:
    """Return the map `outer` after `inner`, float32."""
    if inner is None:
        return outer.contiguous()
    matrix = outer[:, :3].double()
    inner_map = inner.double()
    composed = matrix @ inner_map
    composed[:, 3] += outer[:, 3]
    return composed.float()


def splat_classes(parts: Sequence[PosedGaussians], device: torch.device) -> Int16[Tensor, "N"]:
    """Return the class of every splat, in the order in which buffers count them; 0 where
    unknown.
    """
    classes = [
        torch.zeros(len(p.gaussians), dtype=torch.int16)
        if p.gaussians.semantic is None
        else p.gaussians.semantic
        for p in parts
    ]
    return torch.cat(
        [
            part_classes if part_classes.device == device else gpu.gpu_copy(part_classes)
            for part_classes in classes
        ]
    )
