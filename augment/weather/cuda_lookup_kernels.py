"""Where vectors lie in a layer's image, and what it shows there, for Triton kernels.

A view is a layer's camera as 22 numbers (see `water_launch.view_numbers`): focal length times its
right, down (fx, fy) and forward axes; coefficients of column, row and 1 in the x, y, z of a pixel's
ray; cx, cy; the image's width and height. Vectors start at the layer's eye. Lanes outside a mask
load nothing and get zeros.
"""

from __future__ import annotations

import triton
import triton.language as tl

from augment.weather import layer_lookup

LEVELS = tl.constexpr(layer_lookup.MIP_LEVELS)
_LEAST_DEPTH = tl.constexpr(layer_lookup.LEAST_DEPTH)
_CX, _CY, _WIDTH, _HEIGHT = (tl.constexpr(k) for k in (18, 19, 20, 21))


@triton.jit
def clamp(x, low, high):
    return tl.minimum(tl.maximum(x, low), high)


@triton.jit
def dot(numbers, x, y, z):
    """Of three numbers in memory and vectors."""
    return tl.load(numbers) * x + tl.load(numbers + 1) * y + tl.load(numbers + 2) * z


@triton.jit
def project(view, x, y, z):
    """Column and row; huge for what is behind the camera."""
    inverse = 1.0 / tl.maximum(dot(view + 6, x, y, z), _LEAST_DEPTH)
    column = dot(view, x, y, z) * inverse + tl.load(view + _CX)
    return column, dot(view + 3, x, y, z) * inverse + tl.load(view + _CY)


@triton.jit
def clamp_to(view, column, row):
    column = clamp(column, 0.5, tl.load(view + _WIDTH) - 0.5)
    return column, clamp(row, 0.5, tl.load(view + _HEIGHT) - 0.5)


@triton.jit
def is_inside(view, column, row):
    across = (column >= 0.0) & (column < tl.load(view + _WIDTH))
    return across & (row >= 0.0) & (row < tl.load(view + _HEIGHT))


@triton.jit
def look(alpha, depth, view, column, row, mask):
    """Alpha and depth of the nearest pixels inside, and their centres."""
    width, height = tl.load(view + _WIDTH), tl.load(view + _HEIGHT)
    column = tl.floor(clamp(column, 0.0, width - 1.0))
    row = tl.floor(clamp(row, 0.0, height - 1.0))
    pixel = row.to(tl.int32) * width.to(tl.int32) + column.to(tl.int32)
    a = tl.load(alpha + pixel, mask=mask, other=0.0)
    return a, tl.load(depth + pixel, mask=mask, other=0.0), column + 0.5, row + 0.5


@triton.jit
def way(view, depth, column, row, x0, y0, z0):
    """How far the points that pixels show at a depth are from others."""
    x = depth * dot(view + 9, column, row, 1.0) - x0
    y = depth * dot(view + 12, column, row, 1.0) - y0
    z = depth * dot(view + 15, column, row, 1.0) - z0
    return tl.sqrt(x * x + y * y + z * z)


@triton.jit
def place(column, row, width, height):
    """The first of the four pixels round coordinates, and the way from it in columns and rows.

    width, height: floats. On the last pixels the way is 1, from those before.
    """
    x, y = clamp(column - 0.5, 0.0, width - 1.0), clamp(row - 0.5, 0.0, height - 1.0)
    c0 = tl.maximum(tl.minimum(tl.floor(x), width - 2.0), 0.0)
    r0 = tl.maximum(tl.minimum(tl.floor(y), height - 2.0), 0.0)
    return c0.to(tl.int32), r0.to(tl.int32), x - c0, y - r0


@triton.jit
def _mixed(image, a, b, c, d, fc, fr, mask):
    """Of four places in memory, by the way between them."""
    top = (1.0 - fc) * tl.load(image + a, mask=mask, other=0.0)
    top += fc * tl.load(image + b, mask=mask, other=0.0)
    bottom = (1.0 - fc) * tl.load(image + c, mask=mask, other=0.0)
    bottom += fc * tl.load(image + d, mask=mask, other=0.0)
    return (1.0 - fr) * top + fr * bottom


@triton.jit
def fetch(rgb, alpha, view, column, row, mask):
    """Colours and alphas between the pixels' centres."""
    width, height = tl.load(view + _WIDTH), tl.load(view + _HEIGHT)
    c0, r0, fc, fr = place(column, row, width, height)
    wide = width.to(tl.int32)
    a = r0 * wide + c0
    right = tl.minimum(wide - 1, 1)
    below = tl.minimum(height.to(tl.int32) - 1, 1) * wide
    b, c, d = a + right, a + below, a + (right + below)
    opaque = _mixed(alpha, a, b, c, d, fc, fr, mask)
    a, b, c, d = 3 * a, 3 * b, 3 * c, 3 * d
    red = _mixed(rgb, a, b, c, d, fc, fr, mask)
    green = _mixed(rgb + 1, a, b, c, d, fc, fr, mask)
    return red, green, _mixed(rgb + 2, a, b, c, d, fc, fr, mask), opaque


@triton.jit
def fetch_square(image, a, width, right, fc, fr, mask):
    """From images of four channels: pixels a, the one `right` of it, and a width below both."""
    b, c, d = 4 * (a + right), 4 * (a + width), 4 * (a + width + right)
    a = 4 * a
    red = _mixed(image, a, b, c, d, fc, fr, mask)
    green = _mixed(image + 1, a, b, c, d, fc, fr, mask)
    blue = _mixed(image + 2, a, b, c, d, fc, fr, mask)
    return red, green, blue, _mixed(image + 3, a, b, c, d, fc, fr, mask)


@triton.jit
def fetch_level(mips, view, level, column, row, mask):
    """From a level of averages (`cuda_mip_kernels.average`) of the view's image, whole numbers."""
    width, height = tl.load(view + _WIDTH).to(tl.int32), tl.load(view + _HEIGHT).to(tl.int32)
    first = tl.zeros_like(level)
    wide, high = width, height
    for below in tl.static_range(LEVELS - 1):
        first += tl.where(level > below, wide * high, 0)
        wide, high = (wide + 1) >> 1, (high + 1) >> 1
    step = 1 << level
    wide, high = (width + step - 1) >> level, (height + step - 1) >> level
    scale = 1.0 / step.to(tl.float32)
    c0, r0, fc, fr = place(column * scale, row * scale, wide.to(tl.float32), high.to(tl.float32))
    right, below_it = tl.minimum(wide - 1, 1), tl.where(high > 1, wide, 0)
    return fetch_square(mips, first + r0 * wide + c0, below_it, right, fc, fr, mask)
