"""Kernels of pictures on a photo against their plain forms, bit for bit."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from augment.photo import edge_kernels as kernels
from augment.photo.outlines import (
    BACKGROUND_POINTS,
    BACKGROUND_PX,
    MAX_EDGE_LEVELS,
    MAX_UNLIKE,
    PLAIN_LEVELS,
    REGION_LEVELS,
    UNLIKE_LEVELS,
    UNLIKE_THRESHOLD,
)
from augment.photo.packed_matte import pack_matte, unpack_matte
from augment.photo.photo_objects import ObjectEdges
from augment.photo.recorded_base import add_weighted, mix
from augment.render import photo_kernels
from augment.render.buffers import SPLAT_IDS, RenderOutput
from augment.scene.scene import PosedGaussians
from tests.snow_scenes import wall


def smooth(values: np.ndarray, count: int) -> np.ndarray:
    """Return the mean of `count` neighbours around a closed outline."""
    half = min(count // 2, len(values) - 1)
    ring = np.concatenate([values[-half:], values, values[:half]])
    sums = np.concatenate([np.zeros_like(ring[:1]), ring.cumsum(0, dtype=np.float64)])
    return (sums[2 * half + 1 :] - sums[: -2 * half - 1]) / (2 * half + 1)


def plain_gains(
    samples: np.ndarray, side_px: int, count: int, outer_px: int, reach_px: float, prior: np.ndarray
) -> np.ndarray:
    """Return the gains of `score_gains`, array by array."""
    planes = np.ascontiguousarray(np.moveaxis(samples, 2, 0), np.float32)
    sums = np.zeros((3, len(samples) + 1, samples.shape[1]), np.float32)
    np.cumsum(planes, 1, out=sums[:, 1:])
    difference = 2 * sums[:, side_px : side_px + count] - sums[:, :count]
    difference -= sums[:, 2 * side_px : 2 * side_px + count]
    edges = np.minimum(np.abs(difference).max(0) / side_px, MAX_EDGE_LEVELS)
    background = smooth(planes[:, -BACKGROUND_PX:].mean(1).T, BACKGROUND_POINTS)
    unlike = np.abs(planes - background.T.astype(np.float32)[:, None]).max(0)
    unlike = np.minimum(unlike / np.float32(UNLIKE_LEVELS), np.float32(MAX_UNLIKE))
    unlike_sums = (unlike - np.float32(UNLIKE_THRESHOLD)).cumsum(0)
    last = side_px + count - 1
    scores = 2 * unlike_sums[side_px - 1 : last] - unlike_sums[last]
    scores -= scores.mean(0)
    brightness = planes[:, last - outer_px :].mean(0)
    zone = 2 * BACKGROUND_POINTS - 3
    variance = smooth((brightness**2).mean(0), zone) - smooth(brightness.mean(0), zone) ** 2
    regions = scores / (1 + np.maximum(variance, 0) / PLAIN_LEVELS**2).astype(np.float32)
    gains = edges + np.float32(REGION_LEVELS / reach_px) * regions
    return (gains - prior[:, None]).T


@pytest.mark.parametrize(
    ("num_points", "side_px", "count", "outer_px"),
    [(16, 2, 9, 2), (333, 5, 51, 10), (64, 3, 27, 5)],
)
def test_gains_of_offsets_are_those_of_the_plain_form(num_points, side_px, count, outer_px):
    rng = np.random.default_rng(num_points)
    num_samples = count + 2 * side_px + BACKGROUND_PX
    samples = rng.integers(0, 256, (num_samples, num_points, 3)).astype(np.uint8)
    samples[:, : num_points // 2] //= 16  # half of the outline is on plain ground
    prior = rng.uniform(0, 25, count).astype(np.float32)
    reach_px = float(count - outer_px)
    numbers = (
        *(side_px, count, outer_px, BACKGROUND_PX, BACKGROUND_POINTS, MAX_EDGE_LEVELS),
        *(REGION_LEVELS / reach_px, UNLIKE_LEVELS, MAX_UNLIKE, UNLIKE_THRESHOLD, PLAIN_LEVELS**2),
    )
    gains = np.empty((num_points, count), np.float32)
    kernels.score_gains(samples, np.array(numbers, np.float32), prior, gains)
    expected = plain_gains(samples, side_px, count, outer_px, reach_px, prior)
    np.testing.assert_array_equal(gains, expected)


def test_a_photo_under_snow_or_smog_is_mapped_and_mixed_in_one_pass():
    rng = np.random.default_rng(2)
    pixels = rng.integers(0, 256, (37, 51, 3)).astype(np.uint8)
    color_map = rng.normal(size=(3, 4)).astype(np.float32)
    overlay = rng.uniform(0, 1, (37, 51)).astype(np.float32)
    overlay_rgb = rng.uniform(0, 1, (37, 51, 3)).astype(np.float32)
    land = np.empty((37, 51, 3), np.float32)
    photo_kernels.map_photo_colors(pixels, color_map, np.float32(-np.inf), land)
    expected = add_weighted(
        torch.from_numpy(overlay_rgb), torch.from_numpy(land), 1 - torch.from_numpy(overlay)
    )
    covered = np.empty_like(land)
    photo_kernels.mix_photo(pixels, color_map, overlay, overlay_rgb, True, covered)
    np.testing.assert_array_equal(covered, expected.numpy())
    for airlight in (overlay_rgb, overlay_rgb[:1, :1].copy()):
        expected = mix(*map(torch.from_numpy, (land, airlight, overlay)))
        photo_kernels.mix_photo(pixels, color_map, overlay, airlight, False, covered)
        np.testing.assert_array_equal(covered, expected.numpy())


def test_edges_are_marked_where_the_photo_and_the_drawing_differ():
    rng = np.random.default_rng(3)
    size = 60, 90
    small_size = 20, 30
    top = 7
    left = 11
    window_labels = rng.integers(0, 3, (40, 70)).astype(np.uint8)
    small_labels = rng.integers(0, 3, small_size).astype(np.uint8)
    small_hides = rng.integers(0, 2, small_size).astype(np.uint8)
    alpha, overlay = rng.uniform(0, 1, (2, 40, 70)).astype(np.float32)
    is_above = rng.uniform(size=(40, 70)) > 0.5
    limits = np.array([0.6, 0.5], np.float32)
    rows = (np.arange(40) + top) // 3
    columns = (np.arange(70) + left) // 3
    hides, labels = (image[rows][:, columns] for image in (small_hides, small_labels))
    lacks_expected = (window_labels > 0) & ~((alpha >= limits[0]) & (labels == window_labels))
    for has_caps in (False, True):
        shows_expected = (hides > 0) & (window_labels == 0)
        if has_caps:
            shows_expected &= ~(is_above & (overlay > limits[1]))
        shows = np.zeros(size, np.bool_)
        lacks = np.empty((40, 70), np.bool_)
        kernels.mark_edges(
            window_labels,
            np.array([top, left, *size], np.int64),
            small_hides,
            small_labels,
            alpha,
            overlay if has_caps else overlay[:0, :0].copy(),
            is_above if has_caps else is_above[:0, :0].copy(),
            limits,
            shows,
            lacks,
        )
        np.testing.assert_array_equal(shows[top : top + 40, left : left + 70], shows_expected)
        assert shows.sum() == shows_expected.sum()
        np.testing.assert_array_equal(lacks, lacks_expected)


def test_pixels_below_a_height_are_taken_from_their_object_alone():
    rng = np.random.default_rng(4)
    labels = rng.integers(0, 3, (60, 90)).astype(np.uint8)
    nearest_depth = rng.uniform(4, 40, (20, 30)).astype(np.float32)
    eye_z_m = 1.7
    rise_x = 0.01
    rise_y = -0.99
    rise_z = 0.02
    cx = 44.0
    cy = 31.0
    fx = 80.0
    fy = 81.0
    rows, columns = np.mgrid[:60, :90]
    rise = rise_x * (columns + 0.5 - cx) / fx + rise_y * (rows + 0.5 - cy) / fy
    heights = eye_z_m + nearest_depth[rows // 3, columns // 3] * (rise + rise_z)
    expected = labels.copy()
    inside = (rows >= 5) & (rows < 55) & (columns >= 9) & (columns < 80)
    expected[(labels == 2) & (heights < 0.3) & inside] = 0
    assert (expected != labels).any()
    kernels.cut_below(
        np.uint8(2),
        np.array([5, 9, 50, 71], np.int64),
        nearest_depth[1:, 2:].copy(),
        np.array([1, 2, 20, 30], np.int64),
        np.array([eye_z_m, rise_x, rise_y, rise_z, cx, cy, fx, fy]),
        np.full((19, 28), 0.3),
        labels,
    )
    np.testing.assert_array_equal(labels, expected)


def test_pixels_move_as_if_all_were_read_before_any_is_written():
    values = np.arange(24, dtype=np.float32).reshape(12, 2)
    targets = np.array([0, 1, 2, 3])
    sources = np.array([1, 2, 3, 11])
    expected = values.copy()
    expected[targets] = values[sources]
    kernels.move_pixels(targets, sources, values)
    np.testing.assert_array_equal(values, expected)


def test_splats_behind_objects_are_counted_through_all_parts():
    parts = [
        PosedGaussians(wall(8.0, (-width, width), (0.0, 1.0)), instance_id=number)
        for number, width in ((0, 1.0), (3, 0.5), (0, 0.3), (4, 0.6), (5, 0.4), (0, 0.2))
    ]
    counts = [len(part.gaussians) for part in parts]
    firsts = np.cumsum([0, *counts])
    kept = [number for number, part in enumerate(parts) if part.instance_id not in (3, 5)]
    expected = np.concatenate([np.arange(firsts[k], firsts[k + 1]) for k in kept])
    expected = np.concatenate([[-1], expected])
    num_pixels = len(expected)
    ids = torch.arange(-1, num_pixels - 1, dtype=torch.int32).reshape(1, -1)
    no_pixels = np.empty(0, np.int64)
    is_hidden = np.ones((1, num_pixels), np.bool_)
    edges = ObjectEdges(frozenset({3, 5}), is_hidden, no_pixels, no_pixels)
    raster = RenderOutput(splat_ids=torch.zeros((1, num_pixels), dtype=torch.int32))
    moved = edges.apply(raster, RenderOutput(splat_ids=ids), parts)
    np.testing.assert_array_equal(getattr(moved, SPLAT_IDS).numpy()[0], expected)


def test_a_packed_matte_keeps_every_bit():
    rng = np.random.default_rng(5)
    rgb = rng.integers(0, 256, (50, 83, 3)).astype(np.uint8)
    share = np.zeros((50, 83), np.float32)
    share[:30] = rng.choice(np.float32([0, 1, 0.25, 0.7]), (30, 83))
    surface_rgb = np.where((share % 1 > 0)[..., None], 255 - rgb, rgb)
    small_sky_rgb = rng.integers(0, 256, (6, 10, 3)).astype(np.uint8)
    packed = pack_matte(share[:30], surface_rgb[:30], small_sky_rgb)
    unpacked_share, unpacked_rgb, sky_rgb = unpack_matte(packed, rgb)
    np.testing.assert_array_equal(unpacked_share, share)
    np.testing.assert_array_equal(unpacked_rgb, surface_rgb)
    assert sky_rgb[:30].any() and not sky_rgb[30:].any()
