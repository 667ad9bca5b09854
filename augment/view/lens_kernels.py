"""Numba kernels that look up pinhole views at the pixels of a lens image.

`augment.view.lens_view` prepares the arrays. A place (u, v) in a view counts pixel centres at +0.5.
"""

from __future__ import annotations

import math

import numpy as np
from numba import prange

from augment.render.cpu.jit import kernel, kernel_function

# Samples along one side of a pixel, at most.
MAX_SAMPLES = 8


@kernel_function()
def _cubic_weights(t, out):
    """Compute the four weights of a Catmull-Rom spline at a share between the middle two."""
    half = np.float32(0.5)
    unit = np.float32(1.0)
    two = np.float32(2.0)
    out[0] = half * t * (t * (two - t) - unit)
    out[1] = half * (t * t * (np.float32(3.0) * t - np.float32(5.0)) + two)
    out[2] = half * t * (t * (np.float32(4.0) - np.float32(3.0) * t) + unit)
    out[3] = half * t * t * (t - unit)


@kernel_function()
def _step(pixels, weights, row, column, down, right, out):
    """Compute the change of the place in the view from a pixel to the next one.

    The neighbour before it is taken where the next one is not in the view, and the pixel's own
    size where neither is.
    """
    height, width = weights.shape
    for sign in (1, -1):
        r = row + sign * down
        c = column + sign * right
        if 0 <= r < height and 0 <= c < width and weights[r, c] > 0:
            for k in range(2):
                out[k] = np.float32(sign) * (pixels[r, c, k] - pixels[row, column, k])
            return
    out[0] = np.float32(right)
    out[1] = np.float32(down)


@kernel
def add_view(image, pixels, weights, slack, out):
    """Add a view's colours to the lens image, weighted: out += weight mean(image).

    A pixel takes the mean of a raster of samples over the parallelogram that it covers in the view,
    one sample a view's pixel. Each sample is a cubic interpolation within the range of the 16
    pixels around it.

    Args:
        image: colours of the view, float32 [h, w, 3].
        pixels: places in the view, float32 [H, W, 2].
        weights: float32 [H, W].
        slack: part of a view's pixel by which a pixel may be larger before another sample is taken.
        out: float32 [H, W, 3].
    """
    height, width = weights.shape
    view_height, view_width, _ = image.shape
    half = np.float32(0.5)
    for row in prange(height):
        steps = np.empty((2, 2), np.float32)
        across = np.empty(4, np.float32)
        down = np.empty(4, np.float32)
        total = np.empty(3, np.float32)
        for column in range(width):
            weight = weights[row, column]
            if not weight > 0:
                continue
            _step(pixels, weights, row, column, 0, 1, steps[0])
            _step(pixels, weights, row, column, 1, 0, steps[1])
            size_x = math.sqrt(steps[0, 0] ** 2 + steps[0, 1] ** 2)
            size_y = math.sqrt(steps[1, 0] ** 2 + steps[1, 1] ** 2)
            num_x = min(max(math.ceil(size_x - slack), 1), MAX_SAMPLES)
            num_y = min(max(math.ceil(size_y - slack), 1), MAX_SAMPLES)
            total[:] = np.float32(0.0)
            for j in range(num_y):
                shift_y = (np.float32(j) + half) / np.float32(num_y) - half
                for i in range(num_x):
                    shift_x = (np.float32(i) + half) / np.float32(num_x) - half
                    u = pixels[row, column, 0] + shift_x * steps[0, 0] + shift_y * steps[1, 0]
                    v = pixels[row, column, 1] + shift_x * steps[0, 1] + shift_y * steps[1, 1]
                    u -= half
                    v -= half
                    first_u = math.floor(u)
                    first_v = math.floor(v)
                    _cubic_weights(np.float32(u - first_u), across)
                    _cubic_weights(np.float32(v - first_v), down)
                    left = int(first_u) - 1
                    top = int(first_v) - 1
                    for channel in range(3):
                        value = np.float32(0.0)
                        low = np.float32(np.inf)
                        high = np.float32(-np.inf)
                        for y in range(4):
                            r = min(max(top + y, 0), view_height - 1)
                            line = np.float32(0.0)
                            for x in range(4):
                                c = min(max(left + x, 0), view_width - 1)
                                pixel = image[r, c, channel]
                                line += across[x] * pixel
                                low = min(low, pixel)
                                high = max(high, pixel)
                            value += down[y] * line
                        total[channel] += min(max(value, low), high)
            share = weight / np.float32(num_x * num_y)
            for channel in range(3):
                out[row, column, channel] += share * total[channel]


@kernel
def look_up_depth(depth, pixels, is_taken, max_spread, out):
    """Compute depth at places in a view: linear in 1 / depth on a surface, else that of the nearest
    pixel.

    Args:
        depth: z in the view, float32 [h, w]; 0 = none.
        pixels: places in the view, float32 [H, W, 2].
        is_taken: bool [H, W], pixels to compute.
        max_spread: largest ratio of depths that belong to one surface.
        out: float32 [H, W], z in the view.
    """
    height, width = is_taken.shape
    view_height, view_width = depth.shape
    half = np.float32(0.5)
    unit = np.float32(1.0)
    for row in prange(height):
        for column in range(width):
            if not is_taken[row, column]:
                continue
            u = pixels[row, column, 0]
            v = pixels[row, column, 1]
            nearest_row = min(max(math.floor(v), 0), view_height - 1)
            nearest_column = min(max(math.floor(u), 0), view_width - 1)
            nearest = depth[nearest_row, nearest_column]
            out[row, column] = nearest
            left = math.floor(u - half)
            top = math.floor(v - half)
            if left < 0 or top < 0 or left + 1 >= view_width or top + 1 >= view_height:
                continue
            low = np.float32(np.inf)
            high = np.float32(0.0)
            for y in range(2):
                for x in range(2):
                    low = min(low, depth[top + y, left + x])
                    high = max(high, depth[top + y, left + x])
            if not low > 0 or high > max_spread * low:
                continue
            a = u - half - np.float32(left)
            b = v - half - np.float32(top)
            inverse = (unit - b) * (
                (unit - a) / depth[top, left] + a / depth[top, left + 1]
            ) + b * ((unit - a) / depth[top + 1, left] + a / depth[top + 1, left + 1])
            out[row, column] = unit / inverse
