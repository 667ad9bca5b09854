"""Triton functions: lines of splats that are lit pixel by pixel (see augment.render.shading)."""

from __future__ import annotations

import triton
import triton.language as tl

from augment.render import layout, shading
from augment.render.cuda_geometry_kernels import dot, rotation_rows, three

LEAST_FACING = tl.constexpr(shading.LEAST_FACING)
V_FOCAL = tl.constexpr(layout.V_FOCAL)
V_SUN, V_WRAP = tl.constexpr(layout.V_SUN), tl.constexpr(layout.V_WRAP)


@triton.jit
def light_lines(normal, towards, view):
    """All lines but the slopes. normal: unit, in the part's axes; towards: from the eye to the
    splats, in the camera's.
    """
    r, s, t = rotation_rows(view)
    n = (dot(r, normal), dot(s, normal), dot(t, normal))
    is_back = dot(n, towards) > 0.0
    nx, ny, nz = tl.where(is_back, -n[0], n[0]), tl.where(is_back, -n[1], n[1]), n[2]
    nz = tl.where(is_back, -nz, nz)
    sun, wrap = three(view + V_SUN), tl.load(view + V_WRAP)
    inverse = 1.0 / tl.maximum(-nz, LEAST_FACING)
    ax, ay = nx * inverse, ny * inverse
    fx, fy = tl.load(view + V_FOCAL), tl.load(view + V_FOCAL + 1)
    scale = 1.0 / (1.0 + wrap)
    return (
        dot((nx, ny, nz), sun) * scale,
        tl.fma(sun[2], ax, sun[0]) / fx * scale,
        tl.fma(sun[2], ay, sun[1]) / fy * scale,
        wrap * scale,
        ax / fx,
        ay / fy,
    )
