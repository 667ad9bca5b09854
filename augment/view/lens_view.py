"""Pictures of cameras with a lens or a rolling shutter, put together from pinhole views.

In: a camera and a function that draws pinhole views. Out: one picture, its depth, classes and
masks, at the camera's own pixels. `augment.scene.pinhole_views` chooses the views of a lens. A
rolling shutter is drawn in strips of rows or columns, each at the pose of its middle; then every
row is moved to its own pose by the depth of what it shows.

Everything that belongs to the image and not to the scene (drops on the glass, glare, blur, noise)
comes after this: `augment.view.render_view` applies it to the whole picture.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, UInt8

from augment.render.threads import kernel_threads
from augment.scene.cameras import Camera
from augment.scene.pinhole_views import LensLayout, layout_of
from augment.scene.pixel_rays import PixelRays, depth_of, pixel_rays_of, project_local
from augment.timing import timed
from augment.view.images import ViewImages
from augment.view.lens_kernels import add_view, look_up_depth

# Part of a view's pixel by which a pixel of the lens may be larger before it takes two samples.
SAMPLE_SLACK = 0.2
# Largest ratio of the depths of neighbours on one surface, which are interpolated.
MAX_DEPTH_RATIO = 1.1
# Margin of a strip of a rolling shutter on both sides, part of the image's side. Splats beside a
# view are clamped by its size, so that a strip must not be too narrow.
STRIP_MARGIN = 0.125
# The same, at least, and the margin along a strip, pixels.
MIN_STRIP_MARGIN_PX = 16
# Distance of the sky for rows that move, metres.
FAR_M = 1e5
# Turns of finding the depth at which a ray meets a surface.
_NUM_MOTION_STEPS = 3
# Pixels that pay for a thread of their own.
_PIXELS_PER_THREAD = 1 << 15


@dataclass(frozen=True, eq=False)
class ViewPicture:
    """A picture before the camera's sensor, with the images of what it shows."""

    rgb: Float32[np.ndarray, "H W 3"]
    """Display-encoded colour, not clamped."""
    images: ViewImages
    """Depth, classes, instances and masks; its `rgb` is not used."""
    trust: UInt8[np.ndarray, "H W"] | None = None
    """Trust mask; None unless asked for."""
    own_car: Bool[np.ndarray, "H W"] | None = None
    """Pixels of a recorded picture that show the recording car; None where it shows none."""
    is_inside: Bool[np.ndarray, "H W"] | None = None
    """Pixels that see something through the lens; None if all do."""
    motion_depth_m: Float32[np.ndarray, "H W"] | None = None
    """Depth by which rows of a rolling shutter are moved, 0 = none; None without a shutter."""
    photo_rgb: Float32[np.ndarray, "H W 3"] | None = None
    """The recorded image before any weather, in the colours of `rgb`; None without one."""


# Function that draws the picture of a pinhole camera, with a factor of the rasteriser's blur, and
# the camera without shutter through whose lens the picture is looked at.
DrawPinhole = Callable[[Camera, float, Camera], ViewPicture]


@dataclass(frozen=True, eq=False)
class Strip:
    """Rows or columns of an image that are drawn at one pose."""

    camera: Camera
    """The camera at the pose of the strip's middle, with the strip and a margin as its image; no
    shutter."""
    window: tuple[slice, slice]
    """Rows and columns of the strip in the image."""
    top: int
    """Row of the image at which the strip's margin begins; may be negative."""
    left: int
    """Column of the image at which the strip's margin begins; may be negative."""

    @property
    def inner_window(self) -> tuple[slice, slice]:
        """Return the rows and columns of the strip in its camera's image."""
        rows, columns = self.window
        return (
            slice(rows.start - self.top, rows.stop - self.top),
            slice(columns.start - self.left, columns.stop - self.left),
        )


def draw_through_lens(
    camera: Camera, num_strips: int, draw: DrawPinhole, *, moves_rows: bool
) -> ViewPicture:
    """Return the picture of a camera with a lens, a rolling shutter, or both.

    Args:
        camera: the camera.
        num_strips: strips in which a rolling shutter is drawn.
        draw: draws a pinhole view.
        moves_rows: if True, rows of a strip are moved to their own poses. A recorded image has
            its rows at their poses already.
    """
    if camera.shutter is None:
        return _draw_lens(camera, draw)
    strips = strips_of(camera, num_strips, reaches_beyond=moves_rows)
    whole_camera = None if camera.lens is None else dataclasses.replace(camera, shutter=None)
    pictures = [_draw_lens(strip.camera, draw, whole_camera) for strip in strips]
    if moves_rows:
        with timed("rolling shutter"):
            rays = pixel_rays_of(camera)
            lookups = [
                _StripLookup.moved(strip, picture, rays)
                for strip, picture in zip(strips, pictures, strict=True)
            ]
    else:
        lookups = [_StripLookup(strip) for strip in strips]
    with timed("rolling shutter"):
        return _join(lookups, pictures, (camera.height, camera.width))


def strips_of(camera: Camera, num_strips: int, *, reaches_beyond: bool = True) -> tuple[Strip, ...]:
    """Return the strips in which a rolling shutter is drawn.

    Args:
        camera: a camera with a shutter.
        num_strips: number of strips, at most one a row (or column).
        reaches_beyond: if True, margins of strips reach beyond the image.
    """
    shutter = camera.shutter
    assert shutter is not None
    size = camera.height if shutter.is_along_rows else camera.width
    count = min(max(num_strips, 1), size)
    borders = [round(size * i / count) for i in range(count + 1)]
    margin_px = max(round(size * STRIP_MARGIN), MIN_STRIP_MARGIN_PX)
    side_px = MIN_STRIP_MARGIN_PX if reaches_beyond else 0
    strips = []
    for first, end in itertools.pairwise(borders):
        moment = camera.at_read_out(shutter.share_at((first + end) / 2, size))
        begin = first - margin_px
        stop = end + margin_px
        if not reaches_beyond:
            begin = max(begin, 0)
            stop = min(stop, size)
        if shutter.is_along_rows:
            window = (slice(first, end), slice(0, camera.width))
            place = (begin, -side_px)
            shape = (stop - begin, camera.width + 2 * side_px)
        else:
            window = (slice(0, camera.height), slice(first, end))
            place = (-side_px, begin)
            shape = (camera.height + 2 * side_px, stop - begin)
        strip_camera = moment.cropped(place[1], place[0], shape[1], shape[0])
        strips.append(Strip(strip_camera, window, *place))
    return tuple(strips)


def _draw_lens(
    camera: Camera, draw: DrawPinhole, whole_camera: Camera | None = None
) -> ViewPicture:
    """Return the picture of a camera without shutter, through its lens if it has one.

    Args:
        camera: the camera.
        draw: draws a pinhole view.
        whole_camera: the camera of whose image this is a window; None for a whole image.
    """
    if camera.lens is None:
        return draw(camera, 1.0, camera)
    with timed("lens: layout"):
        layout = layout_of(camera, whole_camera)
    pictures = [draw(view.camera_for(camera), view.blur_gain, camera) for view in layout.views]
    with timed("lens"):
        return _merge(layout, pictures, is_along_ray=camera.lens.is_depth_along_ray)


def _merge(
    layout: LensLayout, pictures: Sequence[ViewPicture], *, is_along_ray: bool
) -> ViewPicture:
    """Return the picture at the pixels of the lens.

    Colours are mixed between views. Everything else is that of the view with the largest weight.

    Args:
        layout: the views.
        pictures: their pictures.
        is_along_ray: if True, depth is the distance along the ray, else z.
    """
    rgb = _mix_views(layout, [picture.rgb for picture in pictures])
    photos = [picture.photo_rgb for picture in pictures if picture.photo_rgb is not None]
    look_up = _Lookup.of(layout)
    images = [picture.images for picture in pictures]
    mask_names = dict.fromkeys(name for view_images in images for name in view_images.masks)
    masks = {
        name: look_up.nearest([view_images.masks.get(name) for view_images in images])
        for name in mask_names
    }
    return ViewPicture(
        rgb,
        ViewImages(
            rgb=np.zeros((0, 0, 3), np.uint8),
            depth_m=look_up.depth([i.depth_m for i in images], is_along_ray),
            semantic=look_up.nearest([i.semantic for i in images]),
            instance=look_up.nearest([i.instance for i in images]),
            scene_depth_m=look_up.depth([i.scene_depth_m for i in images], is_along_ray),
            masks={name: mask for name, mask in masks.items() if mask is not None},
        ),
        motion_depth_m=look_up.depth([p.motion_depth_m for p in pictures], is_along_ray),
        photo_rgb=_mix_views(layout, photos) if photos else None,
        trust=look_up.nearest([picture.trust for picture in pictures]),
        own_car=look_up.nearest([picture.own_car for picture in pictures]),
        is_inside=None if layout.is_inside.all() else layout.is_inside,
    )


def _mix_views(
    layout: LensLayout, images: Sequence[Float32[np.ndarray, "_ _ 3"]]
) -> Float32[np.ndarray, "H W 3"]:
    """Return the colours at the pixels of the lens.

    Args:
        layout: the views.
        images: their colours.
    """
    rgb = np.zeros((*layout.is_inside.shape, 3), np.float32)
    for view, image in zip(layout.views, images, strict=True):
        pixels = np.ascontiguousarray(image)
        with kernel_threads(_PIXELS_PER_THREAD):
            add_view(pixels, view.pixels, view.weights, np.float32(SAMPLE_SLACK), rgb)
    return rgb


@dataclass(frozen=True, eq=False)
class _Lookup:
    """Nearest pixels of the views, by pixel of the lens."""

    layout: LensLayout
    """The views."""
    taken_masks: tuple[Bool[np.ndarray, "H W"], ...]
    """Pixels that take each view."""
    places: tuple[tuple[np.ndarray, np.ndarray], ...]
    """Rows and columns in each view of the pixels that take it."""

    @staticmethod
    def of(layout: LensLayout) -> _Lookup:
        """Return the nearest pixels of a layout."""
        main_view = layout.main_view
        taken_masks = []
        places = []
        for number, view in enumerate(layout.views):
            is_taken = layout.is_inside & (main_view == number)
            pixels = view.pixels[is_taken].astype(np.int64)
            taken_masks.append(is_taken)
            places.append(
                (
                    np.clip(pixels[:, 1], 0, view.height - 1),
                    np.clip(pixels[:, 0], 0, view.width - 1),
                )
            )
        return _Lookup(layout, tuple(taken_masks), tuple(places))

    def nearest(self, images: Sequence[np.ndarray | None]) -> np.ndarray | None:
        """Return an image of the views at the lens's pixels, 0 where nothing is seen.

        Args:
            images: the image of each view; None counts as 0. If all are None, so is the result.
        """
        first = next((image for image in images if image is not None), None)
        if first is None:
            return None
        out = np.zeros(self.layout.is_inside.shape, first.dtype)
        for image, is_taken, place in zip(images, self.taken_masks, self.places, strict=True):
            if image is not None:
                out[is_taken] = image[place]
        return out

    def depth(
        self, images: Sequence[Float32[np.ndarray, "_ _"] | None], is_along_ray: bool
    ) -> Float32[np.ndarray, "H W"] | None:
        """Return the depth at the lens's pixels, 0 where there is none.

        Args:
            images: z in each view; all or none are None.
            is_along_ray: if True, depth is the distance along the ray, else z.
        """
        if any(image is None for image in images):
            return None
        out = np.zeros(self.layout.is_inside.shape, np.float32)
        for view, image, is_taken in zip(self.layout.views, images, self.taken_masks, strict=True):
            assert image is not None
            z = np.ascontiguousarray(image)
            with kernel_threads(_PIXELS_PER_THREAD):
                look_up_depth(z, view.pixels, is_taken, np.float32(MAX_DEPTH_RATIO), out)
            factor = view.distance_per_z[is_taken]
            if not is_along_ray:
                factor = factor * self.layout.rays[..., 2][is_taken]
            out[is_taken] *= factor
        return out


@dataclass(frozen=True, eq=False)
class _StripLookup:
    """Places in a strip's picture of its pixels."""

    strip: Strip
    """The strip."""
    pixels: Float32[np.ndarray, "h w 2"] | None = None
    """Places in the strip's picture, pixel centres at +0.5; None where nothing moves."""
    depth_gain: Float32[np.ndarray, "h w"] | None = None
    """Depth in the image over the depth at that place; None where nothing moves."""

    @staticmethod
    def moved(strip: Strip, picture: ViewPicture, rays: PixelRays) -> _StripLookup:
        """Return the places that show what the rows see from their own poses.

        A ray meets the surface at a depth that is not known. It is found by turns: the depth at a
        place gives the point on the ray, and the point gives the place.

        Args:
            strip: the strip.
            picture: its picture.
            rays: rays of the whole image, at the poses of the rows.
        """
        depth_image = picture.motion_depth_m
        assert depth_image is not None
        depth_image = np.where(depth_image > 0, depth_image, FAR_M)
        camera = strip.camera
        height, width = depth_image.shape
        directions = rays.directions[strip.window]
        shape = rays.directions.shape
        origins = np.broadcast_to(rays.origins_m, shape)[strip.window]
        pose = camera.world_from_camera.numpy()
        depth = depth_image[strip.inner_window].astype(np.float64)
        pixels = np.zeros((*depth.shape, 2))
        gain = np.ones_like(depth)
        for _ in range(_NUM_MOTION_STEPS):
            local = (origins + directions * depth[..., None] - pose[:3, 3]) @ pose[:3, :3]
            pixels = project_local(camera, local.reshape(-1, 3)).reshape(*depth.shape, 2)
            place = np.nan_to_num(pixels, nan=-1.0)
            column = np.clip(place[..., 0].astype(np.int64), 0, width - 1)
            row = np.clip(place[..., 1].astype(np.int64), 0, height - 1)
            strip_depth = depth_of(camera, local.reshape(-1, 3)).reshape(depth.shape)
            gain = depth / np.maximum(strip_depth, 1e-3)
            depth = np.clip(gain, 0.5, 2.0) * depth_image[row, column]
        rows, columns = np.indices(depth.shape)
        inner = strip.inner_window
        still = np.stack([columns + inner[1].start, rows + inner[0].start], -1) + 0.5
        pixels = np.where(np.isnan(pixels), still, pixels)
        return _StripLookup(
            strip,
            np.ascontiguousarray(pixels, np.float32),
            np.clip(gain, 0.5, 2.0).astype(np.float32),
        )

    def colors(self, image: Float32[np.ndarray, "_ _ 3"]) -> Float32[np.ndarray, "h w 3"]:
        """Return the colours of the strip's pixels.

        Args:
            image: colours of the strip's picture.
        """
        if self.pixels is None:
            return image[self.strip.inner_window]
        out = np.zeros((*self.pixels.shape[:2], 3), np.float32)
        weights = np.ones(self.pixels.shape[:2], np.float32)
        source = np.ascontiguousarray(image)
        with kernel_threads(_PIXELS_PER_THREAD):
            add_view(source, self.pixels, weights, np.float32(SAMPLE_SLACK), out)
        return out

    def nearest(self, image: np.ndarray) -> np.ndarray:
        """Return an image of the strip's picture at the strip's pixels."""
        if self.pixels is None:
            return image[self.strip.inner_window]
        height, width = image.shape[:2]
        column = np.clip(self.pixels[..., 0].astype(np.int64), 0, width - 1)
        row = np.clip(self.pixels[..., 1].astype(np.int64), 0, height - 1)
        return image[row, column]

    def depth(self, image: np.ndarray) -> np.ndarray:
        """Return depths of the strip's picture at the strip's pixels, from their own poses."""
        depth_m = self.nearest(image)
        return depth_m if self.depth_gain is None else depth_m * self.depth_gain


def _join(
    lookups: Sequence[_StripLookup], pictures: Sequence[ViewPicture], size: tuple[int, int]
) -> ViewPicture:
    """Return the picture of all strips.

    Args:
        lookups: places of the strips' pixels in their pictures.
        pictures: the pictures.
        size: height and width of the whole image.
    """

    def join(
        images: Sequence[np.ndarray | None],
        look_up: Callable[[_StripLookup, np.ndarray], np.ndarray] = _StripLookup.nearest,
        value: int = 0,
    ) -> np.ndarray | None:
        first = next((image for image in images if image is not None), None)
        if first is None:
            return None
        out = np.full((*size, *first.shape[2:]), value, first.dtype)
        for lookup, image in zip(lookups, images, strict=True):
            if image is not None:
                out[lookup.strip.window] = look_up(lookup, image)
        return out

    images = [picture.images for picture in pictures]
    names = dict.fromkeys(name for strip_images in images for name in strip_images.masks)
    masks = {name: join([i.masks.get(name) for i in images]) for name in names}
    rgb = join([picture.rgb for picture in pictures], _StripLookup.colors)
    assert rgb is not None
    return ViewPicture(
        rgb,
        ViewImages(
            rgb=np.zeros((0, 0, 3), np.uint8),
            depth_m=join([i.depth_m for i in images], _StripLookup.depth),
            semantic=join([i.semantic for i in images]),
            instance=join([i.instance for i in images]),
            scene_depth_m=join([i.scene_depth_m for i in images], _StripLookup.depth),
            masks={name: mask for name, mask in masks.items() if mask is not None},
        ),
        photo_rgb=join([picture.photo_rgb for picture in pictures], _StripLookup.colors),
        trust=join([picture.trust for picture in pictures]),
        own_car=join([picture.own_car for picture in pictures]),
        is_inside=join([picture.is_inside for picture in pictures], value=1),
    )
