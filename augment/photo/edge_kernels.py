"""Numba kernels of objects' edges on a photo: moved pixels, gains of outlines.

`augment.photo.photo_objects` and `augment.photo.outlines` call them.
Each writes the same bits as the plain form that its test holds.
"""

from __future__ import annotations

import numpy as np

from augment.render.cpu.jit import kernel_function, serial_kernel


@serial_kernel
def copy_window(is_copied, window_values, top, left, values):
    """Copy the marked pixels of a window into an image.

    Args:
        is_copied: bool [h, w], pixels of the window that are copied.
        window_values: [h, w, C], values of the window.
        top: row of the image in which the window begins.
        left: column of the image in which the window begins.
        values: [H, W, C], which is written.
    """
    height, width = is_copied.shape
    num_channels = values.shape[2]
    for i in range(height):
        for j in range(width):
            if is_copied[i, j]:
                for c in range(num_channels):
                    values[top + i, left + j, c] = window_values[i, j, c]


@serial_kernel
def move_pixels(targets, sources, values):
    """Give pixels the values that other pixels had before.

    Args:
        targets: int64 [M], flat indices of the pixels that are written.
        sources: int64 [M], flat indices of the pixels that they are taken from.
        values: [P, C], which is written.
    """
    num_channels = values.shape[1]
    taken_values = np.empty((len(sources), num_channels), values.dtype)
    for m in range(len(sources)):
        for c in range(num_channels):
            taken_values[m, c] = values[sources[m], c]
    for m in range(len(targets)):
        for c in range(num_channels):
            values[targets[m], c] = taken_values[m, c]


@serial_kernel
def mark_edges(
    labels,
    place,
    small_hides,
    small_labels,
    alpha,
    overlay,
    is_above,
    limits,
    shows_background,
    lacks_object,
):
    """Mark the pixels of a window where the photo's objects differ from the drawn ones.

    Args:
        labels: uint8 [h, w], object of the photo at each pixel of the window, 0 for none.
        place: int64 [4], first row and column of the window, height and width of the photo.
        small_hides: uint8 [m, n], 1 where drawn objects hide the background, in a small copy.
        small_labels: uint8 [m, n], the drawn objects.
        alpha: float32 [h, w], alpha of the drawn objects.
        overlay: float32 [h, w], share of snow on objects; [0, 0] without.
        is_above: bool [h, w], pixels that snow on objects may hide; [0, 0] without.
        limits: float32 [2], alpha from which an object is solid, and share from which snow shows.
        shows_background: output bool [H, W], pixels of the photo that show the background; the
            window alone is written.
        lacks_object: output bool [h, w], pixels that show an object which is not drawn there.
    """
    height, width = labels.shape
    small_height, small_width = small_labels.shape
    has_caps = len(overlay) > 0
    for i in range(height):
        row = place[0] + i
        small_row = row * small_height // place[2]
        for j in range(width):
            column = place[1] + j
            small_column = column * small_width // place[3]
            label = labels[i, j]
            shows = label == 0 and small_hides[small_row, small_column] > 0
            if shows and has_caps and is_above[i, j] and overlay[i, j] > limits[1]:
                shows = False
            shows_background[row, column] = shows
            is_drawn = alpha[i, j] >= limits[0] and small_labels[small_row, small_column] == label
            lacks_object[i, j] = label > 0 and not is_drawn


@serial_kernel
def cut_below(label, window, nearest_depth, small_window, numbers, lowest, photo_labels):
    """Take the pixels of an object that lie below its lower side from it.

    Args:
        label: uint8, the object.
        window: int64 [4], first row and column, and height and width of the pixels to look at.
        nearest_depth: float32 [m, n], depth (m) of the object nearest to each pixel of a small
            copy's window.
        small_window: int64 [4], first row and column of that window, and height and width of the
            small copy.
        numbers: float64 [8]; the camera's height (m), the rise of its axes (3), its lens (cx, cy,
            fx, fy).
        lowest: float64 [m, n], height (m) of the lower side at each pixel of the small window.
        photo_labels: uint8 [H, W], objects of the photo, in which 0 is written.
    """
    height, width = photo_labels.shape
    for row in range(window[0], window[0] + window[2]):
        small_row = row * small_window[2] // height - small_window[0]
        rise_of_row = numbers[2] * (row + 0.5 - numbers[5]) / numbers[7]
        for column in range(window[1], window[1] + window[3]):
            if photo_labels[row, column] != label:
                continue
            small_column = column * small_window[3] // width - small_window[1]
            rise = numbers[1] * (column + 0.5 - numbers[4]) / numbers[6] + rise_of_row
            depth_m = np.float64(nearest_depth[small_row, small_column])
            if numbers[0] + depth_m * (rise + numbers[3]) < lowest[small_row, small_column]:
                photo_labels[row, column] = 0


@kernel_function()
def smooth_ring(values, count):
    """Return the mean of `count` neighbours around a closed outline, float64 [N].

    Args:
        values: float32 [N], values at the points of the outline.
        count: number of neighbours.
    """
    num_points = len(values)
    half = min(count // 2, num_points - 1)
    sums = np.zeros(num_points + 2 * half + 1, np.float64)
    for m in range(num_points + 2 * half):
        sums[m + 1] = sums[m] + np.float64(values[(m + num_points - half) % num_points])
    means = np.empty(num_points, np.float64)
    for n in range(num_points):
        means[n] = (sums[n + 2 * half + 1] - sums[n]) / (2 * half + 1)
    return means


@serial_kernel
def score_gains(samples, numbers, prior, gains):
    """Write the gain of each offset of an outline at each of its points.

    `augment.photo.outlines` says how a gain is made up.

    Args:
        samples: uint8 [M, N, 3], colours along the normals, from the inside to the outside.
        numbers: float32 [11]; width of the sides of an edge, number of offsets, reach outside the
            silhouette, width of the background's zone (px), points over which the background is
            averaged, largest gain of an edge (levels), weight of the region, levels of a unit of
            being unlike the background, largest number of units, units above which a pixel is the
            object's, and the square of the deviation at which the region counts half (levels^2).
        prior: float32 [K], cost of each offset.
        gains: output float32 [N, K].
    """
    num_samples, num_points, _ = samples.shape
    side = np.int64(numbers[0])
    num_offsets = np.int64(numbers[1])
    outer = np.int64(numbers[2])
    zone = np.int64(numbers[3])
    zone_points = np.int64(numbers[4])
    width = np.float32(side)
    two = np.float32(2)
    zero = np.float32(0)
    # The background's colour: its zone's mean, averaged over neighbouring points.
    zone_means = np.empty((num_points, 3), np.float32)
    brightness_means = np.empty(num_points, np.float32)
    square_means = np.empty(num_points, np.float32)
    first_outside = side + num_offsets - 1 - outer
    for n in range(num_points):
        for c in range(3):
            total = zero
            for m in range(num_samples - zone, num_samples):
                total += np.float32(samples[m, n, c])
            zone_means[n, c] = total / np.float32(zone)
        total = zero
        squares = zero
        for m in range(first_outside, num_samples):
            brightness = np.float32(samples[m, n, 0]) + np.float32(samples[m, n, 1])
            brightness = (brightness + np.float32(samples[m, n, 2])) / np.float32(3)
            total += brightness
            squares += brightness * brightness
        brightness_means[n] = total / np.float32(num_samples - first_outside)
        square_means[n] = squares / np.float32(num_samples - first_outside)
    background = np.empty((num_points, 3), np.float32)
    for c in range(3):
        smooth = smooth_ring(zone_means[:, c].copy(), zone_points)
        for n in range(num_points):
            background[n, c] = np.float32(smooth[n])
    mean = smooth_ring(brightness_means, 2 * zone_points - 3)
    square_mean = smooth_ring(square_means, 2 * zone_points - 3)
    sums = np.empty((num_samples + 1, 3), np.float32)
    unlike_sums = np.empty(num_samples, np.float32)
    scores = np.empty(num_offsets, np.float32)
    for n in range(num_points):
        sums[0] = zero
        unlike_sum = zero
        for m in range(num_samples):
            unlike = zero
            for c in range(3):
                level = np.float32(samples[m, n, c])
                sums[m + 1, c] = sums[m, c] + level
                unlike = max(unlike, abs(level - background[n, c]))
            unlike = min(unlike / numbers[7], numbers[8]) - numbers[9]
            unlike_sum = unlike if m == 0 else unlike_sum + unlike
            unlike_sums[m] = unlike_sum
        # The region: pixels unlike the background inside, and like it outside.
        last_sum = unlike_sums[side + num_offsets - 1]
        total = zero
        for k in range(num_offsets):
            scores[k] = two * unlike_sums[side + k - 1] - last_sum
            total = scores[k] if k == 0 else total + scores[k]
        mean_score = total / np.float32(num_offsets)
        variance = max(square_mean[n] - mean[n] * mean[n], 0.0)
        plainness = np.float32(1 + variance / np.float64(numbers[10]))
        for k in range(num_offsets):
            edge = zero
            for c in range(3):
                difference = two * sums[side + k, c] - sums[k, c] - sums[2 * side + k, c]
                edge = max(edge, abs(difference))
            edge = min(edge / width, numbers[5])
            region = (scores[k] - mean_score) / plainness
            gains[n, k] = edge + numbers[6] * region - prior[k]
