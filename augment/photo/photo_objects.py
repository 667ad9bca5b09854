"""Pixels of a photo beside moving objects, and the surfaces that they show.

In: the posed parts of a view, its depth and its photo. Out: `ObjectEdges`. They say which pixels
show the background, although the splats of an object hide it, and which pixels show an object that
its splats do not reach. The former take the buffers of a view without the objects, the latter those
of the nearest pixel of the object. So snow, water, wet ground and fog end where the car of the
photo ends.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int32, Int64, UInt8
from torch import Tensor

from augment.photo import edge_kernels as kernels
from augment.photo.object_underside import Underside, height_numbers, heights_at, underside_of
from augment.photo.outlines import MIN_AREA_PX, Silhouette, fill_polygons, find_outlines
from augment.photo.parked_objects import ObjectParts
from augment.render.buffers import ALPHA, BUFFERS, EXPECTED_DEPTH, OVERLAY, SPLAT_IDS, RenderOutput
from augment.render.constants import RasterSettings
from augment.render.layout import HeightClip
from augment.render.rasterize import rasterize
from augment.scene.cameras import Camera
from augment.scene.scene import PosedGaussians

# Width of the copy in which silhouettes are drawn, pixels.
SILHOUETTE_PX = 480
# Distance by which splats lie beside what the photo shows, at most, metres.
REACH_M = 0.25
# Smallest reach of an object whose outline is moved, pixels of the photo.
MIN_REACH_PX = 6.0
# Largest reach, as a part of the image's width.
MAX_REACH_FRACTION = 0.03
# Largest reach, as a part of the object's smaller side.
MAX_REACH_SIDE = 0.3
# Alpha of moving parts above which a pixel may show them.
CLEAR_ALPHA = 0.02
# Alpha of moving parts from which a pixel shows nothing else.
SOLID_ALPHA = 0.95
# Relative depth by which a moving part may lie behind the scene's surface and still be it.
DEPTH_TOLERANCE = 0.1
# Depth by which it may lie behind, metres.
DEPTH_TOLERANCE_M = 0.5
# Height above an object within which its own snow may lie, metres.
CAP_HEIGHT_M = 0.8
# Share of a pixel that shows snow on an object, up to which the pixel may take other buffers.
CLEAR_OVERLAY = 0.05
# Share of a pixel that snow on the ground may hide where an object's buffers are taken.
MAX_GROUND_SNOW = 0.1
# Share of a pixel from which snow on an object shows there.
MIN_CAP_SHARE = 0.5
# Largest number of objects whose outlines are moved; the nearest ones are taken.
MAX_OBJECTS = 60


@dataclass(frozen=True, eq=False)
class ObjectEdges:
    """Pixels around objects that show something else than their splats do."""

    instance_ids: frozenset[int]
    """Instance ids of the objects."""
    shows_background: Bool[np.ndarray, "H W"]
    """True where the photo shows the background, and splats of objects hide it."""
    targets: Int64[np.ndarray, " M"]
    """Flat indices of pixels where the photo shows an object, and its splats do not hide the
    background."""
    sources: Int64[np.ndarray, " M"]
    """Flat indices of the nearest pixels of the same objects."""

    @cached_property
    def window(self) -> tuple[slice, slice]:
        """Return the rows and columns around the pixels that show the background."""
        left, top, width, height = cv2.boundingRect(self.shows_background.view(np.uint8))
        return slice(top, top + max(height, 1)), slice(left, left + max(width, 1))

    def window_of(self, camera: Camera) -> Camera:
        """Return the view through the window.

        Args:
            camera: the camera of the photo.
        """
        rows, columns = self.window
        return camera.cropped(
            columns.start, rows.start, columns.stop - columns.start, rows.stop - rows.start
        )

    def background_of(self, parts: Sequence[PosedGaussians]) -> tuple[PosedGaussians, ...]:
        """Return the parts without the objects and what lies on them."""
        return tuple(part for part in parts if part.instance_id not in self.instance_ids)

    def apply(
        self, raster: RenderOutput, background: RenderOutput, parts: Sequence[PosedGaussians]
    ) -> RenderOutput:
        """Return the buffers with the edges of the photo. On the CPU they are written in place.

        Args:
            raster: buffers of the parts.
            background: the same buffers of `background_of(parts)` in the window; only the pixels
                of `shows_background` are read.
            parts: the parts.
        """
        rows, columns = self.window
        is_copied = np.ascontiguousarray(self.shows_background[rows, columns])
        moved_buffers = dict[str, Tensor]()
        for name in BUFFERS:
            buffer = getattr(raster, name)
            if buffer is None:
                continue
            window_values = getattr(background, name)
            if name == SPLAT_IDS:
                window_values = self._count_through(window_values, parts)
            if buffer.device.type == "cpu" and not buffer.requires_grad:
                values = buffer.numpy().reshape(*buffer.shape[:2], -1)
                window = window_values.numpy().reshape(*is_copied.shape, -1)
                kernels.copy_window(is_copied, window, rows.start, columns.start, values)
                flat_values = values.reshape(-1, values.shape[2])
                kernels.move_pixels(self.targets, self.sources, flat_values)
                continue
            window_rows, window_columns = np.nonzero(is_copied)
            background_pixels = (window_rows + rows.start) * buffer.shape[1]
            background_pixels += window_columns + columns.start
            window_pixels = window_rows * is_copied.shape[1] + window_columns
            from_window, to_pixels, targets, sources = (
                torch.from_numpy(numbers).to(buffer.device)
                for numbers in (window_pixels, background_pixels, self.targets, self.sources)
            )
            hidden_values = window_values.flatten(0, 1)[from_window]
            flat_buffer = buffer.flatten(0, 1).index_copy(0, to_pixels, hidden_values)
            moved = flat_buffer.index_copy(0, targets, flat_buffer[sources])
            moved_buffers[name] = moved.view_as(buffer)
        return replace(raster, **moved_buffers) if moved_buffers else raster

    def _count_through(self, splat_ids: Tensor, parts: Sequence[PosedGaussians]) -> Tensor:
        """Return indices of splats of the background as indices through all parts.

        Args:
            splat_ids: indices among the splats of `background_of(parts)`; -1 for none.
            parts: the parts.
        """
        num_removed = 0
        num_kept = 0
        kept_starts = list[int]()
        shifts = [0]
        for part in parts:
            if part.instance_id in self.instance_ids:
                num_removed += len(part.gaussians)
                continue
            # Indices from -1 on are of no splat, from 0 on of the first part that is kept.
            kept_starts.append(num_kept)
            shifts.append(num_removed)
            num_kept += len(part.gaussians)
        device = splat_ids.device
        first_ids = torch.tensor(kept_starts, device=device, dtype=splat_ids.dtype)
        part_numbers = torch.bucketize(splat_ids, first_ids, right=True)
        return splat_ids + torch.tensor(shifts, device=device)[part_numbers].to(splat_ids.dtype)


class _Drawing(NamedTuple):
    """Moving parts alone, in the small copy."""

    owners: Int32[np.ndarray, "h w"]
    """Instance id of the part with the largest weight, 0 where there is none."""
    alpha: Float[np.ndarray, "h w"]
    """Alpha of the parts, 0 where the scene lies before them."""
    depth: Float[np.ndarray, "h w"]
    """z of the parts, metres."""
    overlay: Float[np.ndarray, "h w"]
    """Share of the pixel that shows what lies on the parts."""


@dataclass(frozen=True, eq=False)
class _Object:
    """An object whose outline is moved."""

    instance_id: int
    """Instance id of its parts."""
    depth_m: float
    """Median z of its pixels, metres."""
    polygons: list[Float[np.ndarray, "_ 2"]]
    """Its outlines in the photo."""
    underside: Underside | None = None
    """Its lower side: it does not reach below."""


def find_edges(
    parts: Sequence[PosedGaussians],
    raster: RenderOutput,
    camera: Camera,
    pixels: UInt8[np.ndarray, "H W 3"],
    *,
    settings: RasterSettings,
    clip: HeightClip | None = None,
    parked: ObjectParts | None = None,
    backend: str,
) -> ObjectEdges | None:
    """Return the edges of the objects on the photo; None where there are none.

    Args:
        parts: the posed parts of the view.
        raster: their buffers, with alpha and expected depth.
        camera: the camera of the photo.
        pixels: the photo.
        settings: the rasteriser's settings.
        clip: height above which the buffers show the parts; None if they show all.
        parked: objects that stand still, taken from the background; None for none.
        backend: the rasteriser's backend.
    """
    moving_parts = [part for part in parts if part.instance_id > 0]
    bare_parts = [part for part in moving_parts if not part.is_overlay]
    is_snowy = len(bare_parts) < len(moving_parts)
    poses: Mapping[int, np.ndarray] = {}
    if parked is not None:
        moving_parts += parked.parts
        bare_parts += parked.bare_parts
        is_snowy |= any(part.is_overlay for part in parked.parts)
        poses = parked.poses
    if not bare_parts or camera.is_orthographic:
        return None
    assert raster.alpha is not None and raster.expected_depth is not None
    small = camera.resized(*copy_size(camera, SILHOUETTE_PX))
    alpha, depth = (_shrink(buffer, small) for buffer in (raster.alpha, raster.expected_depth))
    scene_depth = np.where(alpha > 0.5, depth, np.float32(np.inf))
    settings = replace(settings, sh_degree=0)
    bare = _draw(bare_parts, small, scene_depth, settings, backend)
    objects = _find_objects(bare, camera, pixels)
    if not objects:
        return None
    undersides = {
        o.instance_id: underside_of(
            [part for part in bare_parts if part.instance_id == o.instance_id],
            poses.get(o.instance_id),
        )
        for o in objects
    }
    objects = [replace(o, underside=undersides[o.instance_id]) for o in objects]
    covered = bare
    if is_snowy:
        covered = _draw(moving_parts, small, scene_depth, settings, backend)
    is_drawn = None if clip is None else alpha > 0.5
    is_bare = None
    if raster.overlay is not None:  # snow on the ground hides the feet of objects
        is_bare = _shrink(raster.overlay, small) <= covered.overlay + MAX_GROUND_SNOW
    return _edges_of(objects, covered, is_drawn, is_bare, clip, camera, covered is not bare)


def copy_size(camera: Camera, width_px: int) -> tuple[int, int]:
    """Return width and height of a copy of the camera's image, at most `width_px` wide."""
    factor = max(1.0, camera.width / width_px)
    return max(1, round(camera.width / factor)), max(1, round(camera.height / factor))


def _shrink(buffer: Tensor, small: Camera) -> np.ndarray:
    """Return a small copy of a buffer, pixel by pixel."""
    image = buffer.detach().cpu().float().contiguous().numpy()
    return cv2.resize(image, (small.width, small.height), interpolation=cv2.INTER_NEAREST)


def _draw(
    parts: Sequence[PosedGaussians],
    small: Camera,
    scene_depth: Float[np.ndarray, "h w"],
    settings: RasterSettings,
    backend: str,
) -> _Drawing:
    """Return the moving parts, as far as the scene does not lie before them."""
    raster = rasterize(
        parts,
        small,
        buffers={ALPHA, EXPECTED_DEPTH, OVERLAY, SPLAT_IDS},
        settings=settings,
        backend=backend,
    )
    assert raster.alpha is not None and raster.expected_depth is not None
    assert raster.splat_ids is not None and raster.overlay is not None
    alpha, depth, overlay, splat_ids = (
        buffer.detach().cpu().numpy()
        for buffer in (raster.alpha, raster.expected_depth, raster.overlay, raster.splat_ids)
    )
    ends = np.cumsum([len(part.gaussians) for part in parts])
    instance_ids = np.array([part.instance_id for part in parts], np.int32)
    # Most pixels show no moving part.
    pixels = np.flatnonzero(splat_ids >= 0)
    limits = scene_depth.reshape(-1)[pixels] * (1 + DEPTH_TOLERANCE) + DEPTH_TOLERANCE_M
    pixels = pixels[depth.reshape(-1)[pixels] <= limits]
    numbers = np.searchsorted(ends, splat_ids.reshape(-1)[pixels], side="right")
    owners = np.zeros(depth.shape, np.int32)
    owners.reshape(-1)[pixels] = instance_ids[numbers]
    return _Drawing(owners, _only_at(pixels, alpha), depth, _only_at(pixels, overlay))


def _only_at(pixels: Int64[np.ndarray, " M"], image: np.ndarray) -> np.ndarray:
    """Return an image with its values at some pixels, and 0 elsewhere."""
    out = np.zeros_like(image)
    out.reshape(-1)[pixels] = image.reshape(-1)[pixels]
    return out


def _find_objects(
    drawing: _Drawing, camera: Camera, pixels: UInt8[np.ndarray, "H W 3"]
) -> list[_Object]:
    """Return the objects whose outlines are moved, from the farthest to the nearest."""
    height, width = drawing.owners.shape
    scale = camera.width / width, camera.height / height
    owners = np.where(drawing.alpha > 0.5, drawing.owners, 0)
    masks = [(owners == instance_id, instance_id) for instance_id in np.unique(owners[owners > 0])]
    masks = [pair for pair in masks if np.count_nonzero(pair[0]) >= MIN_AREA_PX]
    depths_m = [float(np.median(drawing.depth[mask])) for mask, _ in masks]
    objects = list[_Object]()
    is_nearer = np.zeros(owners.shape, bool)
    nearer_reach_px = 0.0
    for number in np.argsort(depths_m, kind="stable")[:MAX_OBJECTS]:
        mask, instance_id = masks[number]
        depth_m = depths_m[number]
        left, top, mask_width, mask_height = cv2.boundingRect(mask.astype(np.uint8))
        reach_px = min(
            camera.fx * REACH_M / max(depth_m, 1e-3),
            MAX_REACH_FRACTION * camera.width,
            MAX_REACH_SIDE * min(mask_width * scale[0], mask_height * scale[1]),
        )
        if reach_px < MIN_REACH_PX:
            continue
        if nearer_reach_px > 0:
            # Splats of nearer objects hide more of it than the photo's objects do.
            side = 2 * math.ceil(nearer_reach_px / scale[0]) + 1
            grown_mask = cv2.dilate(mask.astype(np.uint8), np.ones((side, side), np.uint8)) > 0
            mask = mask | (grown_mask & is_nearer)
            left, top, mask_width, mask_height = cv2.boundingRect(mask.astype(np.uint8))
        is_nearer |= mask
        nearer_reach_px = max(nearer_reach_px, reach_px)
        window = mask[top : top + mask_height, left : left + mask_width]
        # An edge of the window is one of the object, unless it is the image's.
        margins = (
            (int(top > 0), int(top + mask_height < height)),
            (int(left > 0), int(left + mask_width < width)),
        )
        window = np.pad(window, margins)
        corner = left - margins[1][0], top - margins[0][0]
        silhouette = Silhouette(window, *corner, scale, reach_px)
        polygons = find_outlines(silhouette, pixels)
        if polygons:
            objects.append(_Object(int(instance_id), depth_m, polygons))
    return objects[::-1]


def _edges_of(
    objects: Sequence[_Object],
    drawing: _Drawing,
    is_drawn: Bool[np.ndarray, "h w"] | None,
    is_bare: Bool[np.ndarray, "h w"] | None,
    clip: HeightClip | None,
    camera: Camera,
    has_caps: bool,
) -> ObjectEdges:
    """Return the pixels where the photo's outlines of objects differ from the drawn ones.

    Args:
        objects: the objects, the nearest last.
        drawing: the moving parts with all that lies on them.
        is_drawn: True where the buffers show a surface; None without a clip.
        is_bare: False where snow on the ground hides the objects; None without snow.
        clip: height above which the buffers show the parts; None if they show all.
        camera: the camera of the photo.
        has_caps: if True, snow may lie on the objects.
    """
    photo_labels = np.zeros((camera.height, camera.width), np.uint8)
    labels_by_id = np.zeros(
        max(int(drawing.owners.max()), *(o.instance_id for o in objects)) + 1, np.uint8
    )
    for label, drawn_object in enumerate(objects, 1):
        fill_polygons(drawn_object.polygons, photo_labels, label)
        labels_by_id[drawn_object.instance_id] = label
    labels = labels_by_id[drawing.owners]
    _cut_below(objects, photo_labels, labels, drawing, camera)
    alpha = np.where(labels > 0, drawing.alpha, np.float32(0))
    # The background may show through pixels beside those that are drawn: one more is taken.
    hides = cv2.dilate((alpha > CLEAR_ALPHA).astype(np.uint8), np.ones((3, 3), np.uint8))
    window = _Window(objects, hides, camera)
    window_labels = np.ascontiguousarray(photo_labels[window.rows, window.columns])
    shows_background = np.zeros(photo_labels.shape, np.bool_)
    lacks_object = np.empty(window_labels.shape, np.bool_)
    overlay = np.empty((0, 0), np.float32)
    is_above = np.empty((0, 0), np.bool_)
    if has_caps:
        overlay = window.linear(drawing.overlay)
        is_above = _are_above(objects, photo_labels, camera)[window.rows, window.columns]
    kernels.mark_edges(
        window_labels,
        np.array([window.rows.start, window.columns.start, camera.height, camera.width], np.int64),
        hides,
        labels,
        window.linear(alpha),
        overlay,
        np.ascontiguousarray(is_above),
        np.array([SOLID_ALPHA, MIN_CAP_SHARE], np.float32),
        shows_background,
        lacks_object,
    )
    if has_caps:  # the soft edge of its snow stays as it is drawn
        lacks_object &= overlay <= CLEAR_OVERLAY
    target_rows, target_columns = np.nonzero(lacks_object)
    target_labels = window_labels[target_rows, target_columns]
    targets = (target_rows + window.rows.start) * camera.width
    targets += target_columns + window.columns.start
    square = np.ones((3, 3), np.uint8)
    is_pure = (alpha >= SOLID_ALPHA) & (cv2.erode(labels, square) == cv2.dilate(labels, square))
    if is_bare is not None:
        is_pure &= is_bare
    moves = list[tuple[np.ndarray, np.ndarray]]()
    for label in np.unique(target_labels).tolist():
        chosen = targets[target_labels == label]
        is_seed = is_pure & (labels == label)
        if clip is None or is_drawn is None:
            moves.append(_find_sources(chosen, is_seed, camera))
            continue
        # Water hides the lower part of an object, which then comes from pixels without a surface.
        rows, columns = np.divmod(chosen, camera.width)
        small_rows = rows * labels.shape[0] // camera.height
        small_columns = columns * labels.shape[1] // camera.width
        is_object = is_pure & (labels == label)
        depths_m: float | np.ndarray = objects[label - 1].depth_m
        if is_object.any():
            nearest = _nearest_to(small_rows, small_columns, is_object)
            depths_m = drawing.depth.reshape(-1)[nearest]
        is_above = heights_at(chosen, depths_m, camera) > clip.z_m
        moves.append(_find_sources(chosen[is_above], is_seed & is_drawn, camera))
        moves.append(_find_sources(chosen[~is_above], is_seed & ~is_drawn, camera))
    empty = np.empty(0, np.int64)
    targets, sources = (
        (np.concatenate([empty, *flat]) for flat in zip(*moves, strict=True))
        if moves
        else (empty, empty)
    )
    return ObjectEdges(
        frozenset(drawn_object.instance_id for drawn_object in objects),
        shows_background,
        targets,
        sources,
    )


def _cut_below(
    objects: Sequence[_Object],
    photo_labels: UInt8[np.ndarray, "H W"],
    labels: UInt8[np.ndarray, "h w"],
    drawing: _Drawing,
    camera: Camera,
) -> None:
    """Take pixels below the ground on which an object stands from it, in place.

    They show the shadow on the road beside its wheels, which is as dark as the object.
    """
    height, width = labels.shape
    for label, drawn_object in enumerate(objects, 1):
        is_object = (labels == label) & (drawing.alpha > 0.5)
        left, top, box_width, box_height = cv2.boundingRect(
            np.concatenate(drawn_object.polygons).astype(np.float32)
        )
        if not is_object.any():
            continue
        first_row = max(top + box_height // 2, 0)
        first_column = max(left, 0)
        end = max(top + box_height, 0), max(left + box_width, 0)
        window = photo_labels[first_row : end[0], first_column : end[1]]
        if not window.size:
            continue
        x, y, num_columns, num_rows = cv2.boundingRect((window == label).view(np.uint8))
        if num_columns == 0:
            continue
        corner = first_row + y, first_column + x
        nearest, first = _nearest_around(
            (
                corner[0] * height // camera.height,
                (corner[0] + num_rows - 1) * height // camera.height,
            ),
            (
                corner[1] * width // camera.width,
                (corner[1] + num_columns - 1) * width // camera.width,
            ),
            is_object,
        )
        assert drawn_object.underside is not None
        nearest_depths_m = drawing.depth.reshape(-1)[nearest]
        small_rows, small_columns = np.indices(nearest.shape)
        lowest_m = drawn_object.underside.lowest_at(
            (small_rows + first[0] + 0.5) * (camera.height / height),
            (small_columns + first[1] + 0.5) * (camera.width / width),
            nearest_depths_m,
            camera,
        )
        kernels.cut_below(
            np.uint8(label),
            np.array([*corner, num_rows, num_columns], np.int64),
            nearest_depths_m,
            np.array([*first, height, width], np.int64),
            np.array(height_numbers(camera)),
            lowest_m,
            photo_labels,
        )


def _are_above(
    objects: Sequence[_Object], photo_labels: UInt8[np.ndarray, "H W"], camera: Camera
) -> Bool[np.ndarray, "H W"]:
    """Return the mask of pixels above the objects of the photo that snow on them may hide."""
    is_above = np.zeros(photo_labels.shape, bool)
    for label, drawn_object in enumerate(objects, 1):
        reach_px = min(
            round(camera.fy * CAP_HEIGHT_M / max(drawn_object.depth_m, 1e-3)), camera.height // 4
        )
        left, top, width, height = cv2.boundingRect(
            np.concatenate(drawn_object.polygons).astype(np.float32)
        )
        left = max(left, 0)
        first = max(top - reach_px, 0)
        rows = slice(first, max(top + height, 0))
        columns = slice(left, max(left + width, 0))
        window = (photo_labels[rows, columns] == label).astype(np.uint8)
        if not window.size or reach_px < 1:
            continue
        column = np.ones((reach_px + 1, 1), np.uint8)
        # The anchor is the kernel's first row, so that a pixel sees the rows below it.
        is_above[rows, columns] |= cv2.dilate(window, column, anchor=(0, 0)) > 0
    return is_above


class _Window:
    """Rows and columns of the photo around objects, as splats and as polygons show them."""

    def __init__(
        self, objects: Sequence[_Object], hides: UInt8[np.ndarray, "h w"], camera: Camera
    ) -> None:
        self._small_size = hides.shape[::-1]
        self._size = camera.width, camera.height
        left, top, width, height = cv2.boundingRect(hides)
        corners = [np.array([[left, top], [left + width, top + height]]) * self._scale]
        corners += [polygon for o in objects for polygon in o.polygons]
        points = np.concatenate(corners)
        first = np.clip(np.floor(points.min(0)).astype(int) - 1, 0, None)
        last = np.minimum(np.ceil(points.max(0)).astype(int) + 2, self._size)
        self.columns = slice(int(first[0]), int(last[0]))
        self.rows = slice(int(first[1]), int(last[1]))

    @property
    def _scale(self) -> np.ndarray:
        """Return the size of the photo over that of the small copy, x and y."""
        return np.array(self._size) / self._small_size

    def linear(self, image: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "m n"]:
        """Return the values of a small image at the window's pixels, between its own."""
        small_from_window = np.zeros((2, 3))
        small_from_window[[0, 1], [0, 1]] = 1 / self._scale
        start = np.array([self.columns.start, self.rows.start])
        small_from_window[:, 2] = (start + 0.5) / self._scale - 0.5
        size = self.columns.stop - self.columns.start, self.rows.stop - self.rows.start
        return cv2.warpAffine(
            image,
            small_from_window,
            size,
            flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
            borderMode=cv2.BORDER_REPLICATE,
        )


def _find_sources(
    targets: Int64[np.ndarray, " M"], is_seed: Bool[np.ndarray, "h w"], camera: Camera
) -> tuple[Int64[np.ndarray, " L"], Int64[np.ndarray, " L"]]:
    """Return the targets and the pixels nearest to them that are seeds; none without seeds.

    Args:
        targets: flat indices of pixels.
        is_seed: small pixels that show the same thing as the targets.
        camera: the camera of the photo.
    """
    if not len(targets) or not is_seed.any():
        return np.empty(0, np.int64), np.empty(0, np.int64)
    height, width = is_seed.shape
    rows, columns = np.divmod(targets, camera.width)
    small_rows = rows * height // camera.height
    small_columns = columns * width // camera.width
    nearest = _nearest_to(small_rows, small_columns, is_seed)
    seed_rows, seed_columns = np.divmod(nearest, width)
    # The pixel from which the small copy has its value: others of the seed were not looked at, and
    # would repeat a pattern over all targets beside it.
    rows = seed_rows * camera.height // height
    columns = seed_columns * camera.width // width
    return targets, rows * camera.width + columns


def _nearest_to(
    rows: Int64[np.ndarray, " M"], columns: Int64[np.ndarray, " M"], is_seed: np.ndarray
) -> Int64[np.ndarray, " M"]:
    """Return the flat index of the seed nearest to each of some pixels, of which there are some."""
    if not len(rows):
        return np.empty(0, np.int64)
    nearest, (top, left) = _nearest_around(
        (int(rows.min()), int(rows.max())), (int(columns.min()), int(columns.max())), is_seed
    )
    return nearest[rows - top, columns - left]


def _nearest_around(
    row_range: tuple[int, int], column_range: tuple[int, int], is_seed: Bool[np.ndarray, "h w"]
) -> tuple[Int64[np.ndarray, "m n"], tuple[int, int]]:
    """Return the flat index of the seed nearest to each pixel of a window, and its first row and
    column.

    Args:
        row_range: first and last row that the window holds, beside those of the seeds.
        column_range: first and last column.
        is_seed: the seeds, of which there are some.
    """
    left, top, width, height = cv2.boundingRect(is_seed.view(np.uint8))
    bottom = max(top + height, row_range[1] + 1)
    right = max(left + width, column_range[1] + 1)
    top = min(top, row_range[0])
    left = min(left, column_range[0])
    nearest = nearest_pixels(np.ascontiguousarray(is_seed[top:bottom, left:right]))
    seed_rows, seed_columns = np.divmod(nearest, right - left)
    return (seed_rows + top) * is_seed.shape[1] + seed_columns + left, (top, left)


def nearest_pixels(is_seed: Bool[np.ndarray, "h w"]) -> Int64[np.ndarray, "h w"]:
    """Return the flat index of the seed nearest to each pixel."""
    _, label_image = cv2.distanceTransformWithLabels(
        (~is_seed).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    numbers = np.asarray(label_image, np.int64)
    seeds = np.flatnonzero(is_seed)
    indices = np.zeros(numbers.max() + 1, np.int64)
    indices[numbers.reshape(-1)[seeds]] = seeds
    return indices[numbers]
