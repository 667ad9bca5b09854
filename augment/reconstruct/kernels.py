"""Numba kernels of a fit, called by `loss`, `splats` and `trainer`.

They compute the image and depth loss with its derivatives, the sky's gradient, Adam's step on the
splats of a view, the forces on whole parts, and the pixels per metre at each splat.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import prange

from augment.render import layout as L
from augment.render.cpu import simd as v8
from augment.render.cpu.backward_kernels import (
    G_ABS_MEAN,
    G_COLOR,
    G_MAX_SIGMA,
    G_MEAN,
    G_OPACITY,
    G_QUAT,
    G_SCALE,
    NUM_GRADIENTS,
)
from augment.render.cpu.geometry import offsets_from_eye
from augment.render.cpu.jit import kernel, kernel_function, serial_kernel
from augment.render.cpu.project import write_basis
from augment.render.cpu.simd import LOG2_E, exp2_fine, floats_at
from augment.render.layout import BLOCK_SIZE, NUM_LANES, Index

# ---- The learnt sky: a cube map's colours behind a view, and their gradient ----------------------
# The lookup is `augment.scene.sky.sample_within_faces`, bilinear and clamped at the edge of a face.
# Its texel and fractions are stored for the backward pass.

PARTS = 4  # copies of the cube map in which gradients are summed, for any number of threads
# Image rows of a band. Part p sums bands p, p + PARTS, ..., so that all have as much sky.
BAND = 8
UNSEEN = -1  # texel of a pixel whose sky was not looked up


@kernel
def sample_sky(alpha, faces, rotation, intrinsics, min_transmittance, colors, texels, fractions):
    """Look up the sky's colour at every pixel with a transmittance of at least a limit; else black.

    All inputs are float32.

    Args:
        alpha: [H, W].
        faces: [6, R, R, 3].
        rotation: world_from_camera [3, 3].
        intrinsics: 1 / fx, 1 / fy, cx, cy.
        min_transmittance: the smallest 1 - alpha of a lookup.
        colors: written, [3, H, >= W].
        texels: written, int32 [H, W], flat index of the upper left of four texels, or UNSEEN.
        fractions: written, [2, H, W], position between the texels (column, row).
    """
    height, width = alpha.shape
    size = faces.shape[1]
    half = np.float32(0.5)
    one_f32 = np.float32(1)
    zero = np.float32(0)
    last = np.float32(size - 1)
    scale = np.float32(size) * half
    inverse_fx = intrinsics[0]
    inverse_fy = intrinsics[1]
    cx = intrinsics[2]
    cy = intrinsics[3]
    for band in prange((height + BAND - 1) // BAND):
        for i in range(band * BAND, min((band + 1) * BAND, height)):
            v = (np.float32(i) + half - cy) * inverse_fy
            bx = rotation[0, 1] * v + rotation[0, 2]
            by = rotation[1, 1] * v + rotation[1, 2]
            bz = rotation[2, 1] * v + rotation[2, 2]
            for j in range(width):
                if one_f32 - alpha[i, j] < min_transmittance:
                    texels[i, j] = UNSEEN
                    for c in range(3):
                        colors[c, i, j] = zero
                    continue
                u = (np.float32(j) + half - cx) * inverse_fx
                x = rotation[0, 0] * u + bx
                y = rotation[1, 0] * u + by
                z = rotation[2, 0] * u + bz
                ax = abs(x)
                ay = abs(y)
                az = abs(z)
                if ax >= ay and ax >= az:
                    major = ax
                    t = -y
                    face = 0 if x >= 0 else 1
                    s = -z if x >= 0 else z
                elif ay >= az:
                    major = ay
                    s = x
                    face = 2 if y >= 0 else 3
                    t = z if y >= 0 else -z
                else:
                    major = az
                    t = -y
                    face = 4 if z >= 0 else 5
                    s = x if z >= 0 else -x
                inverse = scale / major
                column = min(max(s * inverse + scale - half, zero), last)
                row = min(max(t * inverse + scale - half, zero), last)
                c0 = int(column)
                r0 = int(row)
                c1 = min(c0 + 1, size - 1)
                r1 = min(r0 + 1, size - 1)
                fc = column - np.float32(c0)
                fr = row - np.float32(r0)
                texels[i, j] = (face * size + r0) * size + c0
                fractions[0, i, j] = fc
                fractions[1, i, j] = fr
                for c in range(3):
                    top = faces[face, r0, c0, c] * (one_f32 - fc) + faces[face, r0, c1, c] * fc
                    bottom = faces[face, r1, c0, c] * (one_f32 - fc) + faces[face, r1, c1, c] * fc
                    colors[c, i, j] = top * (one_f32 - fr) + bottom * fr


@kernel
def scatter_sky(d_rgb, alpha, texels, fractions, size, parts, touched):
    """Add the gradient of every visible texel to the parts' sums.

    Args:
        d_rgb: [H, W, 3], gradient of the composited picture before the colour map.
        alpha: [H, W].
        texels, fractions: from `sample_sky`.
        size: R.
        parts: float32 [PARTS, texels, 3], zero before the first call.
        touched: uint8 [PARTS, >= texels], zero before the first call.
    """
    height, width = alpha.shape
    one_f32 = np.float32(1)
    zero = np.float32(0)
    bands = (height + BAND - 1) // BAND
    for part in prange(PARTS):
        for band in range(part, bands, PARTS):
            for i in range(band * BAND, min((band + 1) * BAND, height)):
                for j in range(width):
                    texel = texels[i, j]
                    if texel == UNSEEN:
                        continue
                    transmittance = one_f32 - alpha[i, j]
                    red = transmittance * d_rgb[i, j, 0]
                    green = transmittance * d_rgb[i, j, 1]
                    blue = transmittance * d_rgb[i, j, 2]
                    if red == zero and green == zero and blue == zero:
                        continue
                    fc = fractions[0, i, j]
                    fr = fractions[1, i, j]
                    for corner in range(4):
                        right = corner & 1
                        below = corner >> 1
                        weight = (fc if right else one_f32 - fc) * (fr if below else one_f32 - fr)
                        if weight == zero:  # also where the neighbour lies beyond the face
                            continue
                        corner_texel = texel + right + below * size
                        touched[part, corner_texel] = 1
                        parts[part, corner_texel, 0] += weight * red
                        parts[part, corner_texel, 1] += weight * green
                        parts[part, corner_texel, 2] += weight * blue


@serial_kernel
def gather_sky(parts, touched, words, texels, grads):
    """Sum the parts, in order, into a list of the touched texels; clear what was touched.

    Args:
        parts, touched: from `scatter_sky`.
        words: `touched` viewed as uint64 [PARTS, ...], to skip untouched texels quickly.
        texels: written, int32, increasing.
        grads: written, float32 [..., 3].

    Returns:
        The number of entries written.
    """
    count = 0
    for word in range(words.shape[1]):
        touched_bits = np.uint64(0)
        for part in range(PARTS):
            touched_bits |= words[part, word]
        if touched_bits == np.uint64(0):
            continue
        for texel in range(word * 8, word * 8 + 8):
            is_touched = False
            red = green = blue = np.float32(0)
            for part in range(PARTS):
                if touched[part, texel]:
                    is_touched = True
                    red += parts[part, texel, 0]
                    green += parts[part, texel, 1]
                    blue += parts[part, texel, 2]
                    for c in range(3):
                        parts[part, texel, c] = np.float32(0)
            if is_touched:
                texels[count] = texel
                grads[count, 0] = red
                grads[count, 1] = green
                grads[count, 2] = blue
                count += 1
        for part in range(PARTS):
            words[part, word] = np.uint64(0)
    return count


# ---- Numba kernel of the loss against depth priors -----------------------------------------------

CHUNK = 4096  # priors of one sum


@kernel
def compare_depth(expected, alpha, pixels, depth, weight, factor, min_alpha, d_expected, sums):
    """Sum weight |1/expected - 1/depth| over the priors, and compute its derivative.

    Pixels with alpha <= min_alpha do not count.

    Args:
        expected, alpha: flat [H, W].
        pixels, depth, weight: the priors, [M].
        factor: factor of the derivative.
        min_alpha: see above.
        d_expected: written, flat [H, W]; must be 0.
        sums: written, float64, one sum for each CHUNK of priors; -1 where a pixel lies outside of
            the
            image or the order does not increase.
    """
    one_f32 = np.float32(1)
    zero = np.float32(0)
    for chunk in prange(sums.size):
        total = 0.0
        previous_pixel = pixels[chunk * CHUNK - 1] if chunk else np.int32(-1)
        for k in range(chunk * CHUNK, min((chunk + 1) * CHUNK, pixels.size)):
            pixel = pixels[k]
            if pixel <= previous_pixel or pixel >= expected.size:
                total = -1.0
                break
            previous_pixel = pixel
            expected_depth = expected[pixel]
            if not (alpha[pixel] > min_alpha and expected_depth > zero and depth[k] > zero):
                continue
            inverse = one_f32 / expected_depth
            error = inverse - one_f32 / depth[k]
            total += weight[k] * abs(error)
            slope = factor * weight[k] * inverse * inverse
            d_expected[pixel] = -slope if error > zero else slope if error < zero else zero
        sums[chunk] = total


# ---- The image loss: L1 and SSIM against a recorded picture, and their gradients -----------------
# With x the picture, y the recorded one, G the window's blur, P = G(x + y) and N = G(x - y):
#
#     A1 = (P^2 - N^2)/2 + C1 = 2 mu_x mu_y + C1        A2 = 2 sigma_xy + C2, from G((x + y)^2)
#     B1 = (P^2 + N^2)/2 + C1 = mu_x^2 + mu_y^2 + C1    B2 = sigma_x^2 + sigma_y^2 + C2,
#     SSIM = A1 A2 / (B1 B2)                                 from G((x - y)^2)
#
# so four blurs are enough instead of five. The gradient takes three: with a, b, c the derivatives
# by P plus N, by G((x + y)^2) and by G((x - y)^2), each times the pixel's weight,
#
#     d/dx = G(a) + (x + y) G(2 b) + (x - y) G(2 c)
#
# Planes are rows of `stride` float32, a multiple of NUM_LANES. Planes that are blurred have PAD
# rows of zeros above and below, and zeros from the image's width to the stride. Kernels return
# NUM_LANES sums of every row, which the caller adds up in float64.

PAD = 5  # the window's radius
MARGIN = 8  # zeros on either side of a row that is blurred, >= PAD
SIGMA = 1.5  # pixels, of the window's Gaussian
C1 = np.float32(0.01**2)  # SSIM's constant of the means
C2 = np.float32(0.03**2)  # SSIM's constant of the variances

# The window's weights from its centre outwards, and their sum over the whole window.
_WINDOW = [math.exp(-(k**2) / (2 * SIGMA**2)) for k in range(PAD + 1)]
_WINDOW_SUM = _WINDOW[0] + 2 * sum(_WINDOW[1:])
W0, W1, W2, W3, W4, W5 = (np.float32(value / _WINDOW_SUM) for value in _WINDOW)


@kernel_function()
def _blur_row(row, at):
    """Return eight values blurred along a row with margins; at: index of the first in the row."""
    value = v8.load(row, at) * v8.broadcast(W0)
    pair = v8.load(row, at - Index(1)) + v8.load(row, at + Index(1))
    value = v8.fmuladd(pair, v8.broadcast(W1), value)
    pair = v8.load(row, at - Index(2)) + v8.load(row, at + Index(2))
    value = v8.fmuladd(pair, v8.broadcast(W2), value)
    pair = v8.load(row, at - Index(3)) + v8.load(row, at + Index(3))
    value = v8.fmuladd(pair, v8.broadcast(W3), value)
    pair = v8.load(row, at - Index(4)) + v8.load(row, at + Index(4))
    value = v8.fmuladd(pair, v8.broadcast(W4), value)
    pair = v8.load(row, at - Index(5)) + v8.load(row, at + Index(5))
    return v8.fmuladd(pair, v8.broadcast(W5), value)


@kernel_function()
def _blur_column(plane, at, stride):
    """Return eight values blurred over the rows; at: index of the first, PAD rows above them."""
    value = v8.load(plane, at + Index(5) * stride) * v8.broadcast(W0)
    pair = v8.load(plane, at + Index(4) * stride) + v8.load(plane, at + Index(6) * stride)
    value = v8.fmuladd(pair, v8.broadcast(W1), value)
    pair = v8.load(plane, at + Index(3) * stride) + v8.load(plane, at + Index(7) * stride)
    value = v8.fmuladd(pair, v8.broadcast(W2), value)
    pair = v8.load(plane, at + Index(2) * stride) + v8.load(plane, at + Index(8) * stride)
    value = v8.fmuladd(pair, v8.broadcast(W3), value)
    pair = v8.load(plane, at + stride) + v8.load(plane, at + Index(9) * stride)
    value = v8.fmuladd(pair, v8.broadcast(W4), value)
    pair = v8.load(plane, at) + v8.load(plane, at + Index(10) * stride)
    return v8.fmuladd(pair, v8.broadcast(W5), value)


@kernel_function()
def _pair_of_moments(plane, upper, lower, weight, first, second):
    """Return first + weight (a + b) and second + weight (a^2 + b^2), a and b from two rows."""
    a = v8.load(plane, upper)
    b = v8.load(plane, lower)
    first = v8.fmuladd(a + b, weight, first)
    return first, v8.fmuladd(v8.fmuladd(a, a, b * b), weight, second)


@kernel_function()
def _column_moments(plane, at, stride, rows, first_at, second_at):
    """Blur the values and their squares over the rows, as `_blur_column`, into two rows."""
    a = v8.load(plane, at + Index(5) * stride)
    first = a * v8.broadcast(W0)
    second = a * first
    first, second = _pair_of_moments(
        plane, at + Index(4) * stride, at + Index(6) * stride, v8.broadcast(W1), first, second
    )
    first, second = _pair_of_moments(
        plane, at + Index(3) * stride, at + Index(7) * stride, v8.broadcast(W2), first, second
    )
    first, second = _pair_of_moments(
        plane, at + Index(2) * stride, at + Index(8) * stride, v8.broadcast(W3), first, second
    )
    first, second = _pair_of_moments(
        plane, at + stride, at + Index(9) * stride, v8.broadcast(W4), first, second
    )
    first, second = _pair_of_moments(
        plane, at, at + Index(10) * stride, v8.broadcast(W5), first, second
    )
    v8.store(rows, first_at, first)
    v8.store(rows, second_at, second)


@kernel_function()
def _composite_row(rgb, alpha, sky, row, size, rows, out, first, plane):
    """Write rgb + (1 - alpha) sky of one image row into three planes of `out` from `first` on.

    rows: work space of four rows, zero beyond the image's width.
    """
    height = Index(size[0])
    width = Index(size[1])
    stride = Index(size[2])
    for j in range(Index(0), width):
        at = row * width + j
        rows[j] = rgb[at * Index(3)]
        rows[stride + j] = rgb[at * Index(3) + Index(1)]
        rows[Index(2) * stride + j] = rgb[at * Index(3) + Index(2)]
        rows[Index(3) * stride + j] = alpha[at]
    ones = v8.broadcast(np.float32(1))
    for j in range(Index(0), stride, Index(NUM_LANES)):
        transmittance = ones - v8.load(rows, Index(3) * stride + j)
        for c in range(Index(0), Index(3)):
            sky_color = v8.load(sky, (c * height + row) * stride + j)
            value = v8.fmuladd(transmittance, sky_color, v8.load(rows, c * stride + j))
            v8.store(out, first + c * plane + j, value)


@kernel_function()
def _mapped(planes, at, plane, color_map, channel):
    """Return one channel of the colour map, applied to three planes of composited colour."""
    entry = Index(4) * channel
    value = v8.fmuladd(
        v8.load(planes, at),
        v8.broadcast(color_map[entry]),
        v8.broadcast(color_map[entry + Index(3)]),
    )
    value = v8.fmuladd(
        v8.load(planes, at + plane), v8.broadcast(color_map[entry + Index(1)]), value
    )
    return v8.fmuladd(
        v8.load(planes, at + plane + plane), v8.broadcast(color_map[entry + Index(2)]), value
    )


@kernel
def compare(rgb, alpha, sky, color_map, recorded, weight, is_sky, size, written):
    """Compute x + y and x - y of rendered and recorded picture, and the sums of the L1 loss.

    Where the weight is 0, y is x.

    Args:
        rgb: flat [H, W, 3].
        alpha: flat [H, W].
        sky: flat planes [3, H, stride], the sky's colours.
        color_map: flat [3, 4].
        recorded: flat uint8 [H, W, 3].
        weight, is_sky: flat [H, W].
        size: height, width, stride.
        written: five arrays that are written: `composite`, the composited colour, flat planes
            [3, H, stride]; `pairs`, six flat planes [H + 2 PAD, stride], red, green, blue of x + y,
            then of x - y; `weights`, a flat plane [H, stride]; `sums`, flat [H, 2, NUM_LANES], of
            weight |x - y| and of weight; `covered`, float64 [H], of alpha in the sky.
    """
    # Items are read one by one: unpacking gives wrong arrays in a parallel kernel (numba 0.68).
    composite = written[0]
    pairs = written[1]
    weights = written[2]
    sums = written[3]
    covered = written[4]
    height = Index(size[0])
    width = Index(size[1])
    stride = Index(size[2])
    plane = Index(size[0] + 2 * PAD) * stride
    to_unit = v8.broadcast(np.float32(1 / 255))
    for band in prange((size[0] + BAND - 1) // BAND):
        rows = np.zeros(Index(4) * stride, np.float32)
        for i in range(band * BAND, min((band + 1) * BAND, size[0])):
            row = Index(i)
            row_start = row * stride
            _composite_row(rgb, alpha, sky, row, size, rows, composite, row_start, height * stride)
            opacity = 0.0
            for j in range(Index(0), width):
                at = row * width + j
                weights[row_start + j] = weight[at]
                if is_sky[at]:
                    opacity += alpha[at]
                rows[j] = np.float32(recorded[at * Index(3)])
                rows[stride + j] = np.float32(recorded[at * Index(3) + Index(1)])
                rows[Index(2) * stride + j] = np.float32(recorded[at * Index(3) + Index(2)])
            for j in range(width, stride):
                weights[row_start + j] = np.float32(0)
            zero = v8.broadcast(np.float32(0))
            error = zero
            weight_sum = zero
            first = (row + Index(PAD)) * stride
            for j in range(Index(0), stride, Index(NUM_LANES)):
                w = v8.load(weights, row_start + j)
                is_used = v8.greater(w, zero)
                weight_sum = weight_sum + w
                for c in range(Index(0), Index(3)):
                    x = _mapped(composite, row_start + j, height * stride, color_map, c)
                    y = v8.select(is_used, v8.load(rows, c * stride + j) * to_unit, x)
                    v8.store(pairs, c * plane + first + j, x + y)
                    v8.store(pairs, (Index(3) + c) * plane + first + j, x - y)
                    error = v8.fmuladd(v8.absolute(x - y), w, error)
            # Beyond the image both are zero, like the window's padding.
            for c in range(Index(0), Index(6)):
                for j in range(width, stride):
                    pairs[c * plane + first + j] = np.float32(0)
            v8.store(sums, row * Index(2 * NUM_LANES), error)
            v8.store(sums, row * Index(2 * NUM_LANES) + Index(NUM_LANES), weight_sum)
            covered[i] = opacity


@kernel
def compare_windows(pairs, weights, size, slopes, sums):
    """Compute SSIM's weighted sum, and the three planes whose blur is its gradient.

    Args:
        pairs, weights: from `compare`.
        size: height, width, stride.
        slopes: written, nine flat planes [H + 2 PAD, stride]: a, 2 b, 2 c (see above) for red, then
            green, then blue.
        sums: written, flat [H, NUM_LANES].
    """
    stride = Index(size[2])
    plane = Index(size[0] + 2 * PAD) * stride
    length = stride + Index(2 * MARGIN)
    for band in prange((size[0] + BAND - 1) // BAND):
        rows = np.zeros(Index(4) * length, np.float32)
        for i in range(band * BAND, min((band + 1) * BAND, size[0])):
            row = Index(i)
            half = v8.broadcast(np.float32(0.5))
            ones = v8.broadcast(np.float32(1))
            ssim_sum = v8.broadcast(np.float32(0))
            for c in range(Index(0), Index(3)):
                for j in range(Index(0), stride, Index(NUM_LANES)):
                    top = c * plane + row * stride + j
                    at = j + Index(MARGIN)
                    _column_moments(pairs, top, stride, rows, at, at + Index(2) * length)
                    _column_moments(
                        pairs,
                        top + Index(3) * plane,
                        stride,
                        rows,
                        at + length,
                        at + Index(3) * length,
                    )
                centre = Index(3) * c * plane + (row + Index(PAD)) * stride
                for j in range(Index(0), stride, Index(NUM_LANES)):
                    at = j + Index(MARGIN)
                    p = _blur_row(rows, at)
                    n = _blur_row(rows, at + length)
                    pp = p * p
                    nn = n * n
                    over_p = _blur_row(rows, at + Index(2) * length) - pp
                    over_n = _blur_row(rows, at + Index(3) * length) - nn
                    a1 = v8.fmuladd(pp - nn, half, v8.broadcast(C1))
                    b1 = v8.fmuladd(pp + nn, half, v8.broadcast(C1))
                    a2 = v8.fmuladd(over_p - over_n, half, v8.broadcast(C2))
                    b2 = v8.fmuladd(over_p + over_n, half, v8.broadcast(C2))
                    b2 = v8.maximum(
                        b2, v8.broadcast(C2)
                    )  # a variance; rounding may make it negative
                    w = v8.load(weights, row * stride + j)
                    inverse = ones / (b1 * b2)
                    ssim = a1 * a2 * inverse
                    ssim_sum = v8.fmuladd(ssim, w, ssim_sum)
                    w = w * inverse  # the derivatives by A1, A2, B1 and B2, times the weight
                    by_a1 = a2 * w
                    by_a2 = a1 * w
                    by_b1 = v8.negate(ssim * b2 * w)
                    by_b2 = v8.negate(ssim * b1 * w)
                    along = by_a1 - by_a2
                    across = by_b1 - by_b2
                    a = v8.fmuladd(p, along + across, n * (across - along))
                    v8.store(slopes, centre + j, a)
                    v8.store(slopes, centre + plane + j, by_b2 + by_a2)
                    v8.store(slopes, centre + plane + plane + j, by_b2 - by_a2)
            v8.store(sums, row * Index(NUM_LANES), ssim_sum)


@kernel_function()
def _picture_slopes(pairs, slopes, weights, row, size, factors, work, rows):
    """Write the loss's derivatives by the finished picture, one image row, into three rows."""
    stride = Index(size[2])
    plane = Index(size[0] + 2 * PAD) * stride
    length = stride + Index(2 * MARGIN)
    zero = v8.broadcast(np.float32(0))
    ones = v8.broadcast(np.float32(1))
    for c in range(Index(0), Index(3)):
        top = Index(3) * c * plane + row * stride
        for k in range(Index(0), Index(3)):
            for j in range(Index(0), stride, Index(NUM_LANES)):
                value = _blur_column(slopes, top + k * plane + j, stride)
                v8.store(work, k * length + Index(MARGIN) + j, value)
        centre = c * plane + (row + Index(PAD)) * stride
        for j in range(Index(0), stride, Index(NUM_LANES)):
            at = j + Index(MARGIN)
            w = v8.load(weights, row * stride + j)
            plus = v8.load(pairs, centre + j)
            minus = v8.load(pairs, centre + Index(3) * plane + j)
            slope = v8.fmuladd(_blur_row(work, at + length), plus, _blur_row(work, at))
            slope = v8.fmuladd(_blur_row(work, at + length + length), minus, slope)
            sign = v8.select(v8.greater(minus, zero), ones, zero)
            sign = v8.select(v8.greater(zero, minus), v8.negate(ones), sign)
            slope = v8.fmuladd(slope, v8.broadcast(factors[1]), sign * w * v8.broadcast(factors[0]))
            v8.store(rows, c * stride + j, v8.select(v8.greater(w, zero), slope, zero))


@kernel_function()
def _map_slopes(rows, channel, composite, row_start, plane, stride, sums, first):
    """Write the row's derivative by one channel of the colour map, NUM_LANES sums an entry."""
    zero = v8.broadcast(np.float32(0))
    red = zero
    green = zero
    blue = zero
    offset = zero
    for j in range(Index(0), stride, Index(NUM_LANES)):
        slope = v8.load(rows, channel * stride + j)
        at = row_start + j
        red = v8.fmuladd(slope, v8.load(composite, at), red)
        green = v8.fmuladd(slope, v8.load(composite, at + plane), green)
        blue = v8.fmuladd(slope, v8.load(composite, at + plane + plane), blue)
        offset = offset + slope
    v8.store(sums, first, red)
    v8.store(sums, first + Index(NUM_LANES), green)
    v8.store(sums, first + Index(2 * NUM_LANES), blue)
    v8.store(sums, first + Index(3 * NUM_LANES), offset)


@kernel_function()
def _times_transposed(rows, at, stride, color_map, k):
    """Return the derivative by channel k of the composited colour, from those by the picture."""
    value = v8.load(rows, at) * v8.broadcast(color_map[k])
    value = v8.fmuladd(v8.load(rows, at + stride), v8.broadcast(color_map[Index(4) + k]), value)
    return v8.fmuladd(
        v8.load(rows, at + stride + stride), v8.broadcast(color_map[Index(8) + k]), value
    )


@kernel
def differentiate(
    sky, color_map, is_sky, composite, pairs, slopes, weights, size, factors, d_rgb, d_alpha, sums
):
    """Compute the loss's derivatives by rgb, alpha and the colour map.

    Args:
        sky, color_map, is_sky, size: as in `compare`.
        composite, pairs, weights: from `compare`.
        slopes: from `compare_windows`.
        factors: float32, of the L1 loss and of SSIM per unit of weight, and of alpha in the sky.
        d_rgb: written, flat [H, W, 3].
        d_alpha: written, flat [H, W].
        sums: written, flat [H, 3, 4, NUM_LANES], the row's part of the colour map's derivative.
    """
    height = Index(size[0])
    width = Index(size[1])
    stride = Index(size[2])
    length = stride + Index(2 * MARGIN)
    plane = height * stride
    for band in prange((size[0] + BAND - 1) // BAND):
        rows = np.zeros(Index(7) * stride, np.float32)
        work = np.zeros(Index(3) * length, np.float32)
        for i in range(band * BAND, min((band + 1) * BAND, size[0])):
            row = Index(i)
            row_start = row * stride
            _picture_slopes(pairs, slopes, weights, row, size, factors, work, rows)
            for c in range(Index(0), Index(3)):
                first = (row * Index(3) + c) * Index(4 * NUM_LANES)
                _map_slopes(rows, c, composite, row_start, plane, stride, sums, first)
            for j in range(Index(0), stride, Index(NUM_LANES)):
                negative_d_alpha = v8.broadcast(np.float32(0))
                for k in range(Index(0), Index(3)):
                    slope = _times_transposed(rows, j, stride, color_map, k)
                    v8.store(rows, (Index(3) + k) * stride + j, slope)
                    negative_d_alpha = v8.fmuladd(
                        slope, v8.load(sky, k * plane + row_start + j), negative_d_alpha
                    )
                v8.store(rows, Index(6) * stride + j, v8.negate(negative_d_alpha))
            for j in range(Index(0), width):
                at = row * width + j
                d_rgb[at * Index(3)] = rows[Index(3) * stride + j]
                d_rgb[at * Index(3) + Index(1)] = rows[Index(4) * stride + j]
                d_rgb[at * Index(3) + Index(2)] = rows[Index(5) * stride + j]
                slope = rows[Index(6) * stride + j]
                d_alpha[at] = slope + factors[2] if is_sky[at] else slope


# ---- Numba kernel: forces of the loss on whole parts, from the gradients of their splats ---------

# Sums of a block, with g = dL/d mean and p the mean: g (3) and p x g (3). The second includes the
# effect of rotating the splats themselves.
MOMENTS = 6


@kernel
def sum_forces(addresses, sizes, blocks, rows, ids, counts, moments):
    """Sum the forces on each block, in each part's axes.

    Splats whose gradient is not finite are left out, as in the update.

    Args:
        addresses, sizes, blocks: as in project.
        rows, ids, counts: from project_backward; rows are flat.
        moments: written, float64 [B, MOMENTS].
    """
    for block in prange(blocks.shape[0]):
        part = blocks[block, 0]
        means = floats_at(addresses[part, 0], sizes[part, 0] * 3)
        quats = floats_at(addresses[part, 1], sizes[part, 0] * 4)
        for i in range(MOMENTS):
            moments[block, i] = 0.0
        for at in range(Index(block * BLOCK_SIZE), Index(block * BLOCK_SIZE + counts[block])):
            row = at * Index(NUM_GRADIENTS)
            splat = Index(ids[at])
            p = Index(3) * splat
            q = Index(4) * splat
            gx, gy, gz = _three(rows, row + Index(G_MEAN))
            px, py, pz = _three(means, p)
            # A rotation by w changes q to q + (0, w) q / 2.
            hw = np.float64(rows[row + Index(G_QUAT)])
            hx, hy, hz = _three(rows, row + Index(G_QUAT + 1))
            w = np.float64(quats[q])
            x, y, z = _three(quats, q + Index(1))
            if not math.isfinite(gx + gy + gz + hw + hx + hy + hz):
                continue
            moments[block, 0] += gx
            moments[block, 1] += gy
            moments[block, 2] += gz
            moments[block, 3] += py * gz - pz * gy + 0.5 * (w * hx - hw * x + y * hz - z * hy)
            moments[block, 4] += pz * gx - px * gz + 0.5 * (w * hy - hw * y + z * hx - x * hz)
            moments[block, 5] += px * gy - py * gx + 0.5 * (w * hz - hw * z + x * hy - y * hx)


@kernel_function()
def _three(array, at):
    """Return three numbers in float64."""
    return np.float64(array[at]), np.float64(array[at + Index(1)]), np.float64(array[at + Index(2)])


# ---- Numba kernel: pixels per metre, visibility and sky of each splat in one view ----------------

_MIN_DEPTH_M = np.float32(0.2)  # metres; nearer splats are ignored
# Margin as a fraction of the image's size: splats with centres this far outside reach into it.
_MARGIN_FRACTION = np.float32(0.15)
_SKY_MARGIN_PX = 2  # pixels of sky around a splat's centre; masks are accurate to one pixel


@kernel
def update_sightings(means, pose, intrinsics, sky, px_per_m, num_views, num_in_sky):
    """Add one view to the sightings of a part's splats.

    Args:
        means: float32 [N, 3].
        pose: camera_from_part, float32 [4, 4].
        intrinsics: fx, fy, cx, cy.
        sky: bool [H, W].
        px_per_m: float32 [N], raised to the view's pixels per metre at the splat.
        num_views: int32 [N], counts views that the splat's centre is inside of.
        num_in_sky: int32 [N], counts views in whose sky it lies.
    """
    height, width = sky.shape
    fx = intrinsics[0]
    fy = intrinsics[1]
    cx = intrinsics[2]
    cy = intrinsics[3]
    left = -_MARGIN_FRACTION * width
    right = (1 + _MARGIN_FRACTION) * width
    top = -_MARGIN_FRACTION * height
    bottom = (1 + _MARGIN_FRACTION) * height
    for i in prange(means.shape[0]):
        x = means[i, 0]
        y = means[i, 1]
        z = means[i, 2]
        depth = pose[2, 0] * x + pose[2, 1] * y + pose[2, 2] * z + pose[2, 3]
        if not depth > _MIN_DEPTH_M:
            continue
        u = fx * (pose[0, 0] * x + pose[0, 1] * y + pose[0, 2] * z + pose[0, 3]) / depth + cx
        v = fy * (pose[1, 0] * x + pose[1, 1] * y + pose[1, 2] * z + pose[1, 3]) / depth + cy
        if not (left < u < right and top < v < bottom):
            continue
        px_per_m[i] = max(px_per_m[i], fx / depth)
        column = math.floor(u)
        row = math.floor(v)
        if not (0 <= column < width and 0 <= row < height):
            continue
        num_views[i] += 1
        upper_row = max(row - _SKY_MARGIN_PX, 0)
        lower_row = min(row + _SKY_MARGIN_PX, height - 1)
        left_column = max(column - _SKY_MARGIN_PX, 0)
        right_column = min(column + _SKY_MARGIN_PX, width - 1)
        if sky[row, column] and sky[upper_row, column] and sky[lower_row, column]:
            num_in_sky[i] += sky[row, left_column] and sky[row, right_column]


# ---- Adam on the splats of a view, in the arrays that the rasteriser reads -----------------------
# Values stay activated: a step on the logarithm of a scale multiplies it, a step on the logit of an
# opacity divides its odds, and quaternions move along the sphere and are normalised. The method is
# that of Kingma & Ba 2015, with the bias correction counted per splat, since a view shows only a
# few of them.

# Columns of the geometry's moments, two registers: means 3, quats 4, one unused, logarithms of
# scales 3, logit of opacity 1, four unused.
GEOMETRY = 16
# Numbers of an update, float32: step sizes of a row's first 16 columns as NUM_GRADIENTS lists them
# (negative for opacity, whose odds are divided), of the SH, and the rest.
R_ROW = 0  # step sizes of a row's first 16 columns
R_SH_DC = 16  # step size of the SH of degree 0
R_SH_REST = 17  # step size of the other SH
R_BETA1 = 18  # Adam's decay of first moments
R_BETA2 = 19  # Adam's decay of second moments
R_SMALLEST = 20  # the least scale, metres
R_LARGEST = 21  # the largest scale, metres
R_ABS_UNIT = 22  # factor from 1/px to the unit of Splats.grads
R_RADIUS_UNIT = 23  # factor from px to the unit of Splats.grads
NUM_RATES = 24  # numbers of an update

MAX_CORRECTED_UPDATES = 10_000  # updates after which Adam's bias is neglected

_EPS = np.float32(1e-15)  # added to the root of the second moment
_MIN_OPACITY = np.float32(1e-4)
_MAX_OPACITY = np.float32(0.9995)
_MAX_SH = 16  # SH functions of degree 3
_ROWS_AT_ONCE = 1024  # rows that a thread updates together
_SH_NUMBERS = 48  # numbers of a splat's SH; the work space holds gradients, moments and steps


def bias_corrections(beta1: float, beta2: float) -> np.ndarray:
    """Return the moments' factors after 0 to MAX_CORRECTED_UPDATES updates, float32 [., 2]."""
    n = np.arange(MAX_CORRECTED_UPDATES + 1, dtype=np.float64)[:, None]
    n[0] = 1  # never read: a splat is updated before it is corrected
    return (1 / (1 - np.array([beta1, beta2]) ** n)).astype(np.float32)


class GradientRows(NamedTuple):
    """The output of project_backward, flat."""

    rows: np.ndarray  # float32, NUM_GRADIENTS numbers for each splat
    ids: np.ndarray  # int32, the splat of each row in its part
    counts: np.ndarray  # int64, rows of each block


class AdamState(NamedTuple):
    """Arrays of `Splats`, flat; see there."""

    geometry_m: np.ndarray
    geometry_v: np.ndarray
    sh_m: np.ndarray
    sh_v: np.ndarray
    age: np.ndarray
    grads: np.ndarray
    min_scale_m: np.ndarray


@kernel
def update_splats(
    addresses, sizes, views, blocks, firsts, gradients, num_functions, rates, corrections, state
):
    """Apply one step of Adam to every row of gradients; splats with rows that are not finite stay.

    The splats are changed in place.

    Args:
        addresses, sizes, views, blocks: as in project.
        firsts: int64 [P], index of each part's first splat in the arrays of moments.
        gradients: GradientRows.
        num_functions: number of SH functions that are learnt now.
        rates: float32 [NUM_RATES].
        corrections: from `bias_corrections`, flat.
        state: AdamState.
    """
    rows = gradients.rows
    ids = gradients.ids
    counts = gradients.counts
    age = state.age
    grads = state.grads
    min_scales_m = state.min_scale_m
    for block in prange(blocks.shape[0]):
        part = blocks[block, 0]
        num_splats, num_sh = sizes[part]
        means = floats_at(addresses[part, 0], num_splats * 3)
        quats = floats_at(addresses[part, 1], num_splats * 4)
        scales = floats_at(addresses[part, 2], num_splats * 3)
        opacities = floats_at(addresses[part, 3], num_splats)
        sh = floats_at(addresses[part, 4], num_splats * num_sh * 3)
        view = views[part]
        basis = np.empty((_MAX_SH + 2) * NUM_LANES, np.float32)
        work = np.zeros(4 * _SH_NUMBERS, np.float32)
        base = Index(block * BLOCK_SIZE)
        for at in range(Index(0), Index(counts[block]), Index(NUM_LANES)):
            _write_bases(
                means, ids, base + at, Index(counts[block]) - at, view, num_functions, basis
            )
            for lane in range(min(Index(NUM_LANES), Index(counts[block]) - at)):
                row = (base + at + lane) * Index(NUM_GRADIENTS)
                splat = Index(ids[base + at + lane])
                moment_row = Index(firsts[part]) + splat
                if not math.isfinite(_row_power(rows, row)):
                    continue
                age[moment_row] += 1
                grads[Index(3) * moment_row] += rows[row + Index(G_ABS_MEAN)] * rates[R_ABS_UNIT]
                grads[Index(3) * moment_row + Index(1)] += np.float32(1)
                radius = rows[row + Index(G_MAX_SIGMA)] * rates[R_RADIUS_UNIT]
                grads[Index(3) * moment_row + Index(2)] = max(
                    grads[Index(3) * moment_row + Index(2)], radius
                )
                n = Index(min(age[moment_row], MAX_CORRECTED_UPDATES))
                first = corrections[Index(2) * n]
                second = corrections[Index(2) * n + Index(1)]
                _update_geometry(
                    (means, quats, scales, opacities),
                    splat,
                    rows,
                    row,
                    basis[Index(_MAX_SH * NUM_LANES) + lane],
                    rates,
                    min_scales_m[moment_row],
                    (first, second),
                    (state.geometry_m, state.geometry_v),
                    moment_row * Index(GEOMETRY),
                    work,
                )
                _update_sh(
                    sh,
                    splat * Index(num_sh) * Index(3),
                    rows,
                    row,
                    basis,
                    lane,
                    Index(num_functions),
                    rates,
                    (first, second),
                    (state.sh_m, state.sh_v),
                    moment_row * Index(num_sh) * Index(3),
                    work,
                )


@kernel_function()
def _row_power(rows, row):
    """Return the sum of squares: not finite if a number or its second moment is not finite."""
    total = np.float32(0)
    for i in range(Index(NUM_GRADIENTS)):
        total += rows[row + i] * rows[row + i]
    return total


@kernel_function()
def _write_bases(means, ids, at, num_remaining, view, num_functions, basis):
    """Write SH functions of eight splats, and a pixel's width at each of them, metres."""
    lane_ids = np.empty(NUM_LANES, np.int32)
    for lane in range(Index(NUM_LANES)):
        lane_ids[lane] = ids[at + min(lane, num_remaining - Index(1))]
    dx, dy, dz = offsets_from_eye(means, lane_ids, Index(0), view)
    inverse = v8.broadcast(np.float32(1)) / v8.sqrt(v8.fmuladd(dx, dx, v8.fmuladd(dy, dy, dz * dz)))
    write_basis(dx * inverse, dy * inverse, dz * inverse, num_functions, basis)
    row = Index(L.V_ROTATION + 6)
    z = v8.fmuladd(v8.broadcast(view[row]), dx, v8.broadcast(view[row + Index(1)]) * dy)
    z = v8.fmuladd(v8.broadcast(view[row + Index(2)]), dz, z)
    v8.store(basis, Index(_MAX_SH * NUM_LANES), z * v8.broadcast(np.float32(1) / view[L.V_FOCAL]))


@kernel_function()
def _adam8(g, rates, first, second, m, m_at, v, v_at):
    """Update eight moments; return the factor of the step size."""
    one_f32 = np.float32(1)
    beta1 = rates[R_BETA1]
    beta2 = rates[R_BETA2]
    new_m = v8.fmuladd(v8.broadcast(beta1), v8.load(m, m_at), v8.broadcast(one_f32 - beta1) * g)
    new_v = v8.fmuladd(v8.broadcast(beta2), v8.load(v, v_at), v8.broadcast(one_f32 - beta2) * g * g)
    v8.store(m, m_at, new_m)
    v8.store(v, v_at, new_v)
    root = v8.sqrt(new_v * v8.broadcast(second)) + v8.broadcast(_EPS)
    return new_m * v8.broadcast(first) / root


@kernel_function()
def _update_geometry(
    splats, splat, rows, row, pixel_m, rates, min_scale_m, bias, moments, at, work
):
    """Update a splat's mean, rotation, scales and opacity."""
    means, quats, scales, opacities = splats
    (first, second) = bias
    (m, v) = moments
    one_f32 = np.float32(1)
    o = min(max(opacities[splat], _MIN_OPACITY), _MAX_OPACITY)
    rows[row + Index(G_OPACITY)] *= one_f32 - o
    low = _adam8(v8.load(rows, row), rates, first, second, m, at, v, at)
    v8.store(work, Index(0), low * v8.load(rates, Index(R_ROW)))
    high = _adam8(
        v8.load(rows, row + Index(8)), rates, first, second, m, at + Index(8), v, at + Index(8)
    )
    factors = exp2_fine(v8.broadcast(-LOG2_E) * high * v8.load(rates, Index(R_ROW + 8)))
    v8.store(work, Index(8), factors)
    for i in range(Index(3)):
        means[Index(3) * splat + i] -= pixel_m * work[i]
    min_scale = max(min_scale_m, rates[R_SMALLEST])
    norm = np.float32(0)
    for i in range(Index(4)):
        q = quats[Index(4) * splat + i] - work[Index(G_QUAT) + i]
        quats[Index(4) * splat + i] = q
        norm += q * q
    norm = one_f32 / np.float32(math.sqrt(norm))
    for i in range(Index(4)):
        quats[Index(4) * splat + i] *= norm
    for i in range(Index(3)):
        s = scales[Index(3) * splat + i] * work[Index(G_SCALE) + i]
        scales[Index(3) * splat + i] = min(max(s, min_scale), rates[R_LARGEST])
    odds = (one_f32 - o) / o * work[Index(G_OPACITY)]
    opacities[splat] = min(max(one_f32 / (one_f32 + odds), _MIN_OPACITY), _MAX_OPACITY)


@kernel_function()
def _update_sh(sh, start, rows, row, basis, lane, num_functions, rates, bias, moments, at, work):
    """Update a splat's colours."""
    (first, second) = bias
    (m, v) = moments
    red = rows[row + Index(G_COLOR)]
    green = rows[row + Index(G_COLOR + 1)]
    blue = rows[row + Index(G_COLOR + 2)]
    count = Index(3) * num_functions
    # The moments are copied: eight at a time would reach into the next splat's moments.
    for k in range(num_functions):
        value = basis[k * Index(NUM_LANES) + lane]
        work[Index(3) * k] = value * red
        work[Index(3) * k + Index(1)] = value * green
        work[Index(3) * k + Index(2)] = value * blue
    for i in range(count):
        work[Index(_SH_NUMBERS) + i] = m[at + i]
        work[Index(2 * _SH_NUMBERS) + i] = v[at + i]
    for i in range(Index(0), count, Index(NUM_LANES)):
        steps = _adam8(
            v8.load(work, i),
            rates,
            first,
            second,
            work,
            Index(_SH_NUMBERS) + i,
            work,
            Index(2 * _SH_NUMBERS) + i,
        )
        v8.store(work, Index(3 * _SH_NUMBERS) + i, steps)
    for i in range(count):
        m[at + i] = work[Index(_SH_NUMBERS) + i]
        v[at + i] = work[Index(2 * _SH_NUMBERS) + i]
    for i in range(Index(3)):
        sh[start + i] -= rates[R_SH_DC] * work[Index(3 * _SH_NUMBERS) + i]
    for i in range(Index(3), count):
        sh[start + i] -= rates[R_SH_REST] * work[Index(3 * _SH_NUMBERS) + i]


@kernel
def update_rows(values, m, v, age, rows, grads, rate, betas, corrections):
    """Apply one step of Adam to rows of three numbers; values stay within [0, 1].

    Args:
        values, m, v: float32 [N * 3].
        age: int32 [N].
        rows: int32 [T], without repetitions.
        grads: float32 [T, 3].
        rate: the step size.
        betas: float32 [2].
        corrections: as for `update_splats`.
    """
    for run in prange((rows.size + _ROWS_AT_ONCE - 1) // _ROWS_AT_ONCE):
        one_f32 = np.float32(1)
        for i in range(
            Index(run * _ROWS_AT_ONCE), Index(min((run + 1) * _ROWS_AT_ONCE, rows.size))
        ):
            row = Index(rows[i])
            age[row] += 1
            n = Index(min(age[row], MAX_CORRECTED_UPDATES))
            first = corrections[Index(2) * n]
            second = corrections[Index(2) * n + Index(1)]
            for channel in range(Index(3)):
                at = Index(3) * row + channel
                g = grads[i, channel]
                m[at] = betas[0] * m[at] + (one_f32 - betas[0]) * g
                v[at] = betas[1] * v[at] + (one_f32 - betas[1]) * g * g
                root = np.float32(math.sqrt(v[at] * second)) + _EPS
                values[at] = min(
                    max(values[at] - rate * first * m[at] / root, np.float32(0)), one_f32
                )
