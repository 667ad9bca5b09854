"""Numba kernels for a sky that is learnt: a cube map's colours behind a view, and their gradient.

The lookup is `augment.sky.sample_within_faces`, bilinear and clamped at the edge of a face. What
it found is kept (texel, fractions), so that the way back computes no direction again.
"""

from __future__ import annotations

import numba
import numpy as np

PARTS = 4  # gradients are summed in as many copies of the cube map, whatever the threads
BAND = 8  # image rows at a time; part p sums bands p, p + PARTS, ... so that all see as much sky
UNSEEN = -1  # texel of a pixel whose sky was not looked up


@numba.njit(parallel=True, cache=True, nogil=True, error_model="numpy")
def sample_sky(alpha, faces, rotation, intrinsics, least, colors, texels, fractions):
    """The sky's colour at every pixel through which at least `least` of it is seen, else black.

    alpha [H, W]. faces [6, R, R, 3]. rotation: world_from_camera [3, 3]. intrinsics: 1 / fx,
    1 / fy, cx, cy. All float32. Written: colors [3, H, >= W], texels int32 [H, W] (flat index of
    the upper left of four texels, or UNSEEN), fractions [2, H, W] (column, row).
    """
    height, width = alpha.shape
    size = faces.shape[1]
    half, one, zero = np.float32(0.5), np.float32(1), np.float32(0)
    last = np.float32(size - 1)
    scale = np.float32(size) * half
    ifx, ify, cx, cy = intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3]
    for band in numba.prange((height + BAND - 1) // BAND):
        for i in range(band * BAND, min((band + 1) * BAND, height)):
            v = (np.float32(i) + half - cy) * ify
            bx = rotation[0, 1] * v + rotation[0, 2]
            by = rotation[1, 1] * v + rotation[1, 2]
            bz = rotation[2, 1] * v + rotation[2, 2]
            for j in range(width):
                if one - alpha[i, j] < least:
                    texels[i, j] = UNSEEN
                    for c in range(3):
                        colors[c, i, j] = zero
                    continue
                u = (np.float32(j) + half - cx) * ifx
                x = rotation[0, 0] * u + bx
                y = rotation[1, 0] * u + by
                z = rotation[2, 0] * u + bz
                ax, ay, az = abs(x), abs(y), abs(z)
                if ax >= ay and ax >= az:
                    major, t = ax, -y
                    face = 0 if x >= 0 else 1
                    s = -z if x >= 0 else z
                elif ay >= az:
                    major, s = ay, x
                    face = 2 if y >= 0 else 3
                    t = z if y >= 0 else -z
                else:
                    major, t = az, -y
                    face = 4 if z >= 0 else 5
                    s = x if z >= 0 else -x
                inverse = scale / major
                column = min(max(s * inverse + scale - half, zero), last)
                row = min(max(t * inverse + scale - half, zero), last)
                c0, r0 = int(column), int(row)
                c1, r1 = min(c0 + 1, size - 1), min(r0 + 1, size - 1)
                fc, fr = column - np.float32(c0), row - np.float32(r0)
                texels[i, j] = (face * size + r0) * size + c0
                fractions[0, i, j] = fc
                fractions[1, i, j] = fr
                for c in range(3):
                    top = faces[face, r0, c0, c] * (one - fc) + faces[face, r0, c1, c] * fc
                    bottom = faces[face, r1, c0, c] * (one - fc) + faces[face, r1, c1, c] * fc
                    colors[c, i, j] = top * (one - fr) + bottom * fr


@numba.njit(parallel=True, cache=True, nogil=True, error_model="numpy")
def scatter_sky(d_rgb, alpha, texels, fractions, size, parts, touched):
    """Add the gradient of every texel seen to the parts' sums.

    d_rgb [H, W, 3]: gradient of the composited picture before the colour map. size: R. parts
    float32 [PARTS, texels, 3] and touched uint8 [PARTS, >= texels]: zero before the first call.
    """
    height, width = alpha.shape
    one, zero = np.float32(1), np.float32(0)
    bands = (height + BAND - 1) // BAND
    for part in numba.prange(PARTS):
        for band in range(part, bands, PARTS):
            for i in range(band * BAND, min((band + 1) * BAND, height)):
                for j in range(width):
                    texel = texels[i, j]
                    if texel == UNSEEN:
                        continue
                    through = one - alpha[i, j]
                    red = through * d_rgb[i, j, 0]
                    green = through * d_rgb[i, j, 1]
                    blue = through * d_rgb[i, j, 2]
                    if red == zero and green == zero and blue == zero:
                        continue
                    fc, fr = fractions[0, i, j], fractions[1, i, j]
                    for corner in range(4):
                        right, below = corner & 1, corner >> 1
                        weight = (fc if right else one - fc) * (fr if below else one - fr)
                        if weight == zero:  # also where the neighbour lies beyond the face
                            continue
                        at = texel + right + below * size
                        touched[part, at] = 1
                        parts[part, at, 0] += weight * red
                        parts[part, at, 1] += weight * green
                        parts[part, at, 2] += weight * blue


@numba.njit(cache=True, nogil=True, error_model="numpy")
def gather_sky(parts, touched, words, texels, grads):
    """Sum the parts, in order, into a list of the touched texels; clear what was touched.

    words: `touched` seen as uint64 [PARTS, ...], to pass over what was not. Returns the count of
    entries written to texels (increasing) and grads [..., 3].
    """
    count = 0
    for word in range(words.shape[1]):
        anything = np.uint64(0)
        for part in range(PARTS):
            anything |= words[part, word]
        if anything == np.uint64(0):
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
                grads[count, 0], grads[count, 1], grads[count, 2] = red, green, blue
                count += 1
        for part in range(PARTS):
            words[part, word] = np.uint64(0)
    return count
