"""Boxes in images of cameras with a lens or a rolling shutter: outlines, windows, occlusion.

Edges of boxes are curves there. They are divided into straight pieces, which are projected one by
one. `augment.scene.boxes` calls this module for such cameras; it does the same for pinholes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64, UInt16

from augment.scene.cameras import Camera
from augment.scene.pixel_rays import PixelRays, project_points

# Pieces into which an edge is divided.
NUM_PIECES = 24


class EdgePieces(NamedTuple):
    """Projected pieces of the edges of B boxes, E pieces a box."""

    first: Float64[np.ndarray, "B E 2"]
    """Pixels at which the pieces begin."""
    second: Float64[np.ndarray, "B E 2"]
    """Pixels at which they end."""
    is_shown: Bool[np.ndarray, "B E"]
    """Pieces that the camera can show, within the image or beyond."""


def project_edges(
    corners_m: Float64[np.ndarray, "B 8 3"], edges: Int64[np.ndarray, "12 2"], camera: Camera
) -> EdgePieces:
    """Return the pieces of boxes' edges in the image's plane.

    Args:
        corners_m: corners of the boxes, scene world.
        edges: pairs of corners that an edge joins.
        camera: the camera.
    """
    share = np.linspace(0.0, 1.0, NUM_PIECES + 1)[:, None]
    a = corners_m[:, edges[:, 0], None, :]
    b = corners_m[:, edges[:, 1], None, :]
    points = a + share * (b - a)  # [B, 12, P + 1, 3]
    num_segments = points.shape[1] * (points.shape[2] - 1)
    pixels, is_shown = project_points(camera, points.reshape(-1, 3))
    pixels = np.where(is_shown[:, None], pixels, 0.0).reshape((*points.shape[:-1], 2))
    is_shown = is_shown.reshape(points.shape[:-1])
    num_boxes = len(corners_m)
    return EdgePieces(
        pixels[:, :, :-1].reshape(num_boxes, num_segments, 2),
        pixels[:, :, 1:].reshape(num_boxes, num_segments, 2),
        (is_shown[:, :, :-1] & is_shown[:, :, 1:]).reshape(num_boxes, num_segments),
    )


def windows_of(
    pieces: EdgePieces, is_usable: Bool[np.ndarray, " B"], camera: Camera
) -> Int64[np.ndarray, "B 4"]:
    """Return left, top, right and bottom of the pixels that can show each box.

    Right and bottom are excluded; the window of a box out of view is empty. A box of which some
    edges cannot be projected may be anywhere.

    Args:
        pieces: edges of the boxes.
        is_usable: boxes that have numbers.
        camera: the camera.
    """
    windows = np.zeros((len(is_usable), 4), np.int64)
    is_shown = pieces.is_shown & is_usable[:, None]
    is_cut = is_shown.any(1) & ~pieces.is_shown.all(1)
    for axis, size in enumerate((camera.width, camera.height)):
        places = np.concatenate([pieces.first[..., axis], pieces.second[..., axis]], axis=1) - 0.5
        counts = np.concatenate([is_shown, is_shown], axis=1)
        first = np.where(counts, places, np.inf).min(axis=1, initial=np.inf)
        last = np.where(counts, places, -np.inf).max(axis=1, initial=-np.inf)
        # A pixel more on each side: between the ends of pieces an edge bends a little.
        windows[:, axis] = np.where(is_cut, 0, np.clip(np.ceil(first) - 1, 0, size))
        windows[:, axis + 2] = np.where(is_cut, size, np.clip(np.floor(last) + 2, 0, size))
    return windows


@dataclass(frozen=True, eq=False)
class BoxFrames:
    """Frames and sides of B boxes, as rays are tested with."""

    centres_m: Float64[np.ndarray, "B 3"]
    """Centres, scene world."""
    rotations: Float64[np.ndarray, "B 3 3"]
    """world_from_box."""
    owned_m: Float64[np.ndarray, "B 2 3"]
    """Lowest and highest corner of the part that owns surfaces, along the box's axes."""
    labelled_m: Float64[np.ndarray, "B 2 3"]
    """Lowest and highest corner of the labelled box."""


def crossings(
    rays: PixelRays, window: tuple[slice, slice], frames: BoxFrames, number: int, *, is_owned: bool
) -> tuple[Float64[np.ndarray, "h w"], Float64[np.ndarray, "h w"]]:
    """Return the depths at which the rays of a window enter and leave a box.

    Args:
        rays: rays of the image.
        window: rows and columns of the window.
        frames: the boxes.
        number: index of the box.
        is_owned: True for the part that owns surfaces, False for the labelled box.
    """
    rotation = frames.rotations[number]
    low, high = (frames.owned_m if is_owned else frames.labelled_m)[number]
    slopes = rays.directions[window] @ rotation
    height, width = rays.directions.shape[:2]
    origins = np.broadcast_to(rays.origins_m, (height, width, 3))[window]
    eyes = (origins - frames.centres_m[number]) @ rotation
    slopes = np.where(slopes == 0, 1e-300, slopes)
    with np.errstate(over="ignore"):  # of a ray along a side
        depths = np.sort(np.stack([(low - eyes) / slopes, (high - eyes) / slopes]), axis=0)
    return depths[0].max(axis=-1), depths[1].min(axis=-1)


class PixelCounts(NamedTuple):
    """Pixels that show B boxes, or hide them."""

    counts: Int64[np.ndarray, "B 6"]
    """Shown pixels, hidden ones, and left, top, right, bottom of the shown ones."""
    owners: UInt16[np.ndarray, "H W"]
    """1 + the smallest of the boxes that a pixel shows by its depth, 0 = none."""


def count_pixels_through_lens(
    rays: PixelRays,
    frames: BoxFrames,
    windows: Int64[np.ndarray, "B 4"],
    depth_m: Float32[np.ndarray, "H W"],
    instance: UInt16[np.ndarray, "_ _"],
    scenery: Bool[np.ndarray, "_ _"],
    actors: Int64[np.ndarray, " B"],
    near_m: float,
) -> PixelCounts:
    """Count the pixels that show each box, and those that show what hides it.

    This is the definition of `augment.scene.box_kernels.count_box_pixels`, for any rays.

    Args:
        rays: rays of the image.
        frames: the boxes.
        windows: pixels that can show each box: left, top, right, bottom.
        depth_m: depth of the surfaces, 0 = none.
        instance: the actors' numbers by pixel; [0, 0] where they are not known.
        scenery: surfaces of a class that no object has; [0, 0] where classes are not known.
        actors: the boxes' actors, 0 = none.
        near_m: depth below which a box is not seen.
    """
    num_boxes = len(windows)
    shown_pixels = [np.zeros((2, 0), np.int64) for _ in range(num_boxes)]
    num_hidden = np.zeros(num_boxes, np.int64)
    owners = np.zeros(depth_m.shape, np.uint16)
    owner_volumes = np.full(depth_m.shape, np.inf)
    volumes = np.prod(frames.labelled_m[:, 1] - frames.labelled_m[:, 0], axis=1)
    for box in range(num_boxes):
        left, top, right, bottom = windows[box]
        actor_rows = np.zeros((2, 0), np.int64)
        if actors[box] > 0 and instance.size:
            actor_rows = np.stack(np.nonzero(instance == actors[box]))
            shown_pixels[box] = actor_rows
        if left >= right or top >= bottom:
            continue
        window = (slice(top, bottom), slice(left, right))
        z = depth_m[window].astype(np.float64)
        nearest, farthest = crossings(rays, window, frames, box, is_owned=True)
        enter, leave = crossings(rays, window, frames, box, is_owned=False)
        nearest = np.maximum(nearest, near_m)
        enter = np.maximum(enter, near_m)
        pixel_actors = instance[window].astype(np.int64) if instance.size else np.zeros_like(z)
        is_other = (z > 0) & ~((actors[box] > 0) & (pixel_actors == actors[box]))
        is_in = is_other & (nearest <= z) & (z <= farthest)
        meets = enter <= leave
        num_hidden[box] = np.count_nonzero(is_in & (pixel_actors > 0) & meets)
        num_hidden[box] += np.count_nonzero(is_other & (z < nearest) & meets)
        if actors[box] == 0:
            is_shown = is_in & (pixel_actors == 0)
            if scenery.size:
                is_shown &= ~scenery[window]
            rows, columns = np.nonzero(is_shown)
            shown_pixels[box] = np.stack([rows + top, columns + left])
            is_smaller = volumes[box] < owner_volumes[rows + top, columns + left]
            place = (rows[is_smaller] + top, columns[is_smaller] + left)
            owners[place] = box + 1
            owner_volumes[place] = volumes[box]
    counts = np.zeros((num_boxes, 6), np.int64)
    counts[:, 1] = num_hidden
    for box, (rows, columns) in enumerate(shown_pixels):
        counts[box, 0] = len(rows)
        if len(rows):
            counts[box, 2:] = columns.min(), rows.min(), columns.max() + 1, rows.max() + 1
    return PixelCounts(counts, owners)
