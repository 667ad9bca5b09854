"""Triton functions: lines of splats that are lit pixel by pixel (see augment.render.shading)."""

from __future__ import annotations

import triton
import triton.language as tl

from augment.render import layout, shading
from augment.render.cuda_geometry_kernels import dot, rotation_rows, three

LEAST_FACING = tl.constexpr(shading.LEAST_FACING)
V_FOCAL, V_PARALLEL = tl.constexpr(layout.V_FOCAL), tl.constexpr(layout.V_PARALLEL)
V_SUN, V_WRAP = tl.constexpr(layout.V_SUN), tl.constexpr(layout.V_WRAP)


@triton.jit
def store_lights(lines, normals, points, slopes, through, lit, mask, view):
    """Write the lines of splats, all 0 where they are not lit.

    lines: pointers to every splat's. normals: unit, in the part's axes; points: in the camera.
    slopes: 0 where not lit; through: the smog's transmittance before them.
    """
    r, s, t = rotation_rows(view)
    nx, ny, nz = dot(r, normals), dot(s, normals), dot(t, normals)
    parallel = tl.load(view + V_PARALLEL) > 0.0
    facing = tl.where(parallel, nz, dot((nx, ny, nz), points))
    nx, ny = tl.where(facing > 0.0, -nx, nx), tl.where(facing > 0.0, -ny, ny)
    nz = tl.where(facing > 0.0, -nz, nz)
    sun, wrap = three(view + V_SUN), tl.load(view + V_WRAP)
    inverse = 1.0 / tl.maximum(-nz, LEAST_FACING)
    ax, ay = nx * inverse, ny * inverse
    fx, fy = tl.load(view + V_FOCAL), tl.load(view + V_FOCAL + 1)
    scale = 1.0 / (1.0 + wrap)
    tl.store(lines, tl.where(lit, dot((nx, ny, nz), sun) * scale, 0.0), mask)
    tl.store(lines + 1, tl.where(lit, tl.fma(ax, sun[2], sun[0]) / fx * scale, 0.0), mask)
    tl.store(lines + 2, tl.where(lit, tl.fma(ay, sun[2], sun[1]) / fy * scale, 0.0), mask)
    tl.store(lines + 3, tl.where(lit, wrap * scale, 0.0), mask)
    tl.store(lines + 4, tl.where(lit, ax / fx, 0.0), mask)
    tl.store(lines + 5, tl.where(lit, ay / fy, 0.0), mask)
    tl.store(lines + 6, through * slopes[0], mask)
    tl.store(lines + 7, through * slopes[1], mask)
    tl.store(lines + 8, through * slopes[2], mask)
