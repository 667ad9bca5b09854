"""Triton functions: splats cut at a height (see augment.render.clip)."""

from __future__ import annotations

import triton
import triton.language as tl

from augment.render import clip, layout
from augment.render.cuda_geometry_kernels import along_axes, cross, dot, eight, three

FAR = tl.constexpr(clip.FAR_PX)
SHARP = tl.constexpr(clip.SHARP_PX2)
TINY = tl.constexpr(1e-20)
V_EXTENT, V_FOCAL = tl.constexpr(layout.V_EXTENT), tl.constexpr(layout.V_FOCAL)
V_ROTATION = tl.constexpr(layout.V_ROTATION)
V_CLIP_EYE = tl.constexpr(layout.V_CLIP_EYE)
V_CLIP_PART = tl.constexpr(layout.V_CLIP_PART)
V_CLIP_CAMERA = tl.constexpr(layout.V_CLIP_CAMERA)
V_CLIP_EDGE = tl.constexpr(layout.V_CLIP_EDGE)
V_CLIP_REACH = tl.constexpr(layout.V_CLIP_REACH)
V_CLIP_FALL = tl.constexpr(layout.V_CLIP_FALL)
V_CLIP_LONGEST = tl.constexpr(layout.V_CLIP_LONGEST)


@triton.jit
def cut_of(d, right, down, columns, sizes, inverse, view):
    """Which splats have a part on the kept side, and their cuts, [B, CUT] as in layout."""
    up = three(view + V_CLIP_PART)
    extent = tl.load(view + V_EXTENT)
    rise = along_axes(up, columns, sizes)
    away = along_axes(three(view + V_ROTATION + 6), columns, sizes)
    height = dot(up, d) + tl.load(view + V_CLIP_EYE)
    reach = extent * tl.sqrt(dot(rise, rise))
    gx, gy = _depth_slope(right, down, away)

    fall = tl.load(view + V_CLIP_FALL) * inverse * inverse
    lx = tl.fma(-fall, gx, tl.load(view + V_CLIP_CAMERA) / tl.load(view + V_FOCAL))
    ly = tl.fma(-fall, gy, tl.load(view + V_CLIP_CAMERA + 1) / tl.load(view + V_FOCAL + 1))
    scale = 1.0 / tl.maximum(tl.sqrt(tl.fma(lx, lx, ly * ly)), TINY)
    offset = tl.maximum(tl.minimum(height * inverse * scale, FAR), -FAR)
    whole = height >= reach
    offset = tl.where(whole, FAR, offset) + tl.load(view + V_CLIP_EDGE)
    lx, ly = tl.where(whole, 0.0, lx * scale), tl.where(whole, 0.0, ly * scale)
    deep = tl.sqrt(dot(away, away)) * inverse
    deep = tl.minimum(extent * deep, tl.load(view + V_CLIP_LONGEST))
    partly = (height + reach >= 0.0) & (height - reach <= tl.load(view + V_CLIP_REACH))
    zero = tl.zeros_like(deep)
    cut = eight(offset, lx, ly, gx * inverse, gy * inverse, deep, zero, zero)
    return partly, cut


@triton.jit
def _depth_slope(x, y, z):
    """g = S2^-1 c of semi-axes right, down and away (see augment.render.clip), per px.

    As cpu_clip's: determinants as products of cross products, all divided by y.y + b, so that no
    digits cancel and nothing overflows.
    """
    inverse = 1.0 / (dot(y, y) + SHARP)
    root = tl.sqrt(inverse)
    c, right, down = cross(x, y, root), cross(z, y, root), cross(x, z, root)
    by_blur = inverse * SHARP
    det = dot(c, c) + tl.fma(by_blur, dot(x, x), SHARP)
    gx = tl.fma(by_blur, dot(x, z), dot(c, right))
    gy = tl.fma(by_blur, dot(y, z), dot(c, down))
    return gx / det, gy / det
