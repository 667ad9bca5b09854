"""Outlines of objects on a photo: the edge of a splat silhouette, moved to the edge of the photo.

In: the mask of an object as its splats show it, and the photo. Out: the polygon of the object as
the photo shows it. `augment.photo.photo_objects` calls it for each object in view.

Splats are discs of some centimetres, and tracks and clocks are off by as much, so that a silhouette
ends many pixels beside the car. From each of N points of the silhouette a ray is sampled along its
normal, at K offsets. An offset gains

    edge      the difference of colour between both sides of the offset
    region    pixels outside it that look like the background, and pixels inside it that do not;
              it counts where the background is plain, such as a road
    prior     nearness to the usual offset, somewhat inside the silhouette

and the best closed path is found by dynamic programming, so that the outline keeps the silhouette's
form where the photo shows no edge.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from augment.photo import edge_kernels
from augment.photo import outline_kernels as kernels

# Distance of the points of an outline, as a part of the reach.
POINT_SPACING = 1 / 10
# Smallest distance of the points of an outline, pixels of the photo.
MIN_POINT_SPACING_PX = 2.0
# Sigma with which the silhouette is smoothed, as a part of the reach.
SMOOTHING = 0.45
# Reach outside the silhouette over the reach inside it.
OUTER_REACH = 0.25
# Width of the sides of an edge, as a part of the reach.
SIDE_WIDTH = 1 / 8
# Smallest and largest width of the sides of an edge, pixels.
SIDE_LIMITS_PX = (2, 5)
# Width of the zone beyond the outer reach whose mean is the background's colour, pixels.
BACKGROUND_PX = 6
# Points of the outline over which the background's colour is averaged.
BACKGROUND_POINTS = 9
# Largest gain of an edge, levels of 255.
MAX_EDGE_LEVELS = 40.0
# Cost of a bend of the path by one offset, levels.
BEND_COST_LEVELS = 3.0
# Gain of the region over the whole reach, levels.
REGION_LEVELS = 25.0
# Difference of colour that is one unit of being unlike the background, levels.
UNLIKE_LEVELS = 18.0
# Units of being unlike the background above which a pixel is the object's.
UNLIKE_THRESHOLD = 0.55
# Largest number of units.
MAX_UNLIKE = 1.5
# Standard deviation of a background's brightness at which the region counts half, levels.
PLAIN_LEVELS = 9.0
# Cost of the prior at a distance of one reach from the usual offset, levels.
PRIOR_LEVELS = 25.0
# Usual offset, in reaches inside the silhouette.
USUAL_OFFSET = 0.35
# Distance from the image's border within which an outline stays, pixels.
BORDER_PX = 3
# Number of points beside the border whose direction tells where the outline leaves the image.
NUM_LEADING_POINTS = 8
# Largest shift along the border of the place where it does, in reaches.
MAX_BORDER_SHIFT = 4.0
# Smallest area of a silhouette that has an outline, pixels of the small mask.
MIN_AREA_PX = 12
# Sobel's sum for a slope of one a pixel.
SOBEL_GAIN = 8.0
# Fractional bits of the coordinates of polygons.
SUBPIXEL_BITS = 4


class Silhouette(NamedTuple):
    """Silhouette of an object in a copy of the image."""

    mask: Bool[np.ndarray, "h w"]
    """True where the splats of the object show, in the small copy."""
    left: int
    """First column of the mask in the small copy."""
    top: int
    """First row of the mask in the small copy."""
    scale: tuple[float, float]
    """Width and height of the photo over those of the small copy."""
    reach_px: float
    """Distance inside the silhouette at which the photo's edge may lie, pixels of the photo."""


def find_outlines(
    silhouette: Silhouette, pixels: UInt8[np.ndarray, "H W 3"]
) -> list[Float[np.ndarray, "_ 2"]]:
    """Return the polygons of an object as the photo shows it, in coordinates of the photo.

    A pixel's centre lies at whole coordinates, as OpenCV draws polygons.

    Args:
        silhouette: the object as its splats show it.
        pixels: the photo.
    """
    scale_x = silhouette.scale[0]
    sigma = max(0.8, SMOOTHING * silhouette.reach_px / scale_x)
    margin = int(3 * sigma) + 2
    soft_mask = cv2.GaussianBlur(
        np.pad(silhouette.mask, margin, mode="edge").astype(np.float32), (0, 0), sigma
    )
    inner = (slice(margin, -margin), slice(margin, -margin))
    contours, _ = cv2.findContours(
        (soft_mask[inner] > 0.5).astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE
    )
    slopes = [cv2.Sobel(soft_mask, cv2.CV_32F, *order)[inner] for order in ((1, 0), (0, 1))]
    polygons = list[np.ndarray]()
    for contour in contours:
        if cv2.contourArea(contour) < MIN_AREA_PX:
            continue
        points = _resample(contour[:, 0], silhouette.reach_px / scale_x)
        heights, *slopes_at = (_read_at(image, points) for image in (soft_mask[inner], *slopes))
        slope = np.stack(slopes_at, 1)
        # A step of Newton's method leads from the pixels of the contour to the height 0.5.
        steepness = np.maximum(np.linalg.norm(slope, axis=1), 1e-3)
        step = np.clip((0.5 - heights) / (steepness / SOBEL_GAIN), -1, 1) / steepness
        points += slope * step[:, None]
        spacing_px = max(POINT_SPACING * silhouette.reach_px, MIN_POINT_SPACING_PX)
        normals = -_smooth(slope, max(3, round(silhouette.reach_px / spacing_px)))
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
        corner = np.array([silhouette.left, silhouette.top])
        # Pixel centres of both images lie at + 0.5.
        points = (points + corner + 0.5) * silhouette.scale - 0.5
        polygons.append(_move_outline(points, normals, silhouette.reach_px, pixels))
    return polygons


def _read_at(image: np.ndarray, points: Float[np.ndarray, "N 2"]) -> Float[np.ndarray, " N"]:
    """Return an image's values at points between its pixels."""
    columns, rows = points.T.astype(np.float32)
    values = cv2.remap(
        np.ascontiguousarray(image),
        columns[:, None],
        rows[:, None],
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE,
    )
    return values[:, 0].astype(np.float64)


def _resample(contour: np.ndarray, reach_px: float) -> np.ndarray:
    """Return points [N, 2] along a closed contour at equal distances."""
    corners = np.concatenate([contour, contour[:1]]).astype(np.float64)
    lengths = np.concatenate([[0.0], np.hypot(*np.diff(corners, axis=0).T).cumsum()])
    spacing = max(POINT_SPACING * reach_px, 0.5)
    count = max(16, round(lengths[-1] / spacing))
    places = np.arange(count) * (lengths[-1] / count)
    return np.stack([np.interp(places, lengths, corners[:, axis]) for axis in (0, 1)], 1)


def _smooth(values: np.ndarray, count: int) -> np.ndarray:
    """Return the mean of `count` neighbours around a closed outline; values are [N, ...]."""
    half = min(count // 2, len(values) - 1)
    if half < 1:
        return values
    ring = np.concatenate([values[-half:], values, values[:half]])
    sums = np.concatenate([np.zeros_like(ring[:1]), ring.cumsum(0, dtype=np.float64)])
    return (sums[2 * half + 1 :] - sums[: -2 * half - 1]) / (2 * half + 1)


def _move_outline(
    points: Float[np.ndarray, "N 2"],
    normals: Float[np.ndarray, "N 2"],
    reach_px: float,
    pixels: UInt8[np.ndarray, "H W 3"],
) -> Float[np.ndarray, "N 2"]:
    """Return the points moved along their normals to the edges of the photo."""
    offsets, gains = score_offsets(points, normals, reach_px, pixels)
    limit = np.array(pixels.shape[1::-1]) - 1 - BORDER_PX
    is_at_border = ((points < BORDER_PX) | (points > limit)).any(1)
    gains[is_at_border] = 0
    # The path is closed: it is found on two rounds, and its middle does not know where it began.
    path = np.empty(2 * len(points), np.int64)
    kernels.find_best_path(np.concatenate([gains, gains]), np.float32(BEND_COST_LEVELS), path)
    half = len(points) // 2
    moves = offsets[
        np.concatenate([path[len(points) : len(points) + half], path[half : len(points)]])
    ]
    outline = points + normals * np.where(is_at_border, 0, moves)[:, None]
    if is_at_border.any() and not is_at_border.all():
        _narrow_at_border(outline, points, np.asarray(is_at_border), limit, reach_px)
    # An object that the image cuts reaches beyond the image's border.
    outline = np.where(points < BORDER_PX, np.minimum(outline, -1), outline)
    return np.where(points > limit, np.maximum(outline, limit + 1 + BORDER_PX), outline)


def _narrow_at_border(
    outline: Float[np.ndarray, "N 2"],
    points: Float[np.ndarray, "N 2"],
    is_at_border: Bool[np.ndarray, " N"],
    limit: np.ndarray,
    reach_px: float,
) -> None:
    """Move the ends of what the image cuts to where the outline beside them leads, in place.

    Points at the image's border stay, and would keep the silhouette's width there.

    Args:
        outline: moved points; those at the border have not been moved.
        points: points of the silhouette.
        is_at_border: True for points at the border.
        limit: largest x and y of points that are not at the border.
        reach_px: distance inside the silhouette at which the photo's edge may lie, pixels.
    """
    num_points = len(points)
    for step in (1, -1):
        for last in np.flatnonzero(~is_at_border & np.roll(is_at_border, -step)):
            first = (last + step) % num_points
            is_beyond = (points[first] < BORDER_PX) | (points[first] > limit)
            axis = int(is_beyond[1])
            along = 1 - axis
            before = (last - step * NUM_LEADING_POINTS) % num_points
            lead = outline[last] - outline[before]
            to_border = points[first, axis] - outline[last, axis]
            if is_at_border[before] or is_beyond.all() or lead[axis] * to_border <= 0:
                continue
            end = outline[last, along] + to_border * lead[along] / lead[axis]
            shift = end - points[first, along]
            if abs(shift) > MAX_BORDER_SHIFT * reach_px:
                continue
            point = first
            # Only points that the silhouette has beyond the end move: the object gets narrower.
            while is_at_border[point] and (end - points[point, along]) * shift > 0:
                if not (points[point, axis] < BORDER_PX or points[point, axis] > limit[axis]):
                    break
                outline[point, along] = end
                point = (point + step) % num_points


def score_offsets(
    points: Float[np.ndarray, "N 2"],
    normals: Float[np.ndarray, "N 2"],
    reach_px: float,
    pixels: UInt8[np.ndarray, "H W 3"],
) -> tuple[Float[np.ndarray, " K"], Float[np.ndarray, "N K"]]:
    """Return the offsets along the normals, pixels, and the gain of each at each point.

    Args:
        points: points of a silhouette.
        normals: their unit normals, outwards.
        reach_px: distance inside the silhouette at which the edge may lie, pixels.
        pixels: the photo.
    """
    inner_px = round(reach_px)
    outer_px = max(2, round(OUTER_REACH * reach_px))
    side_px = int(np.clip(SIDE_WIDTH * reach_px, *SIDE_LIMITS_PX))
    sampled = np.arange(-inner_px - side_px, outer_px + side_px + BACKGROUND_PX + 1)
    places = (points + normals * sampled[:, None, None]).astype(np.float32)  # [M, N, 2]
    samples = cv2.remap(
        pixels,
        np.ascontiguousarray(places[..., 0]),
        np.ascontiguousarray(places[..., 1]),
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE,
    )
    count = inner_px + outer_px + 1
    # The edge lies half a pixel before the first sample outside, and OpenCV paints half a pixel
    # beyond the border of a polygon.
    offsets = sampled[side_px : side_px + count] - 1.0
    prior = PRIOR_LEVELS * (offsets / reach_px + USUAL_OFFSET) ** 2
    numbers = (
        *(side_px, count, outer_px, BACKGROUND_PX, BACKGROUND_POINTS, MAX_EDGE_LEVELS),
        *(REGION_LEVELS / reach_px, UNLIKE_LEVELS, MAX_UNLIKE, UNLIKE_THRESHOLD, PLAIN_LEVELS**2),
    )
    gains = np.empty((len(points), count), np.float32)
    edge_kernels.score_gains(
        samples, np.array(numbers, np.float32), prior.astype(np.float32), gains
    )
    return offsets, gains


def fill_polygons(
    polygons: list[Float[np.ndarray, "_ 2"]], image: UInt8[np.ndarray, "H W"], value: int
) -> None:
    """Paint polygons into an image."""
    for polygon in polygons:
        corners = np.round(polygon * (1 << SUBPIXEL_BITS)).astype(np.int32)
        cv2.fillPoly(image, [corners], value, shift=SUBPIXEL_BITS)
