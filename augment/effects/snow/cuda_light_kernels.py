"""Triton kernel: snow in the light that its own normals catch (see
augment.effects.snow.near_camera).
"""

from __future__ import annotations

import triton
import triton.language as tl

from augment.effects.snow import light_layout
from augment.render.cuda.project_kernels import dot, floats_at, three, three_where
from augment.render.sh import SH_C0

C0 = tl.constexpr(SH_C0)
ROW, NUMBERS = tl.constexpr(light_layout.ROW), tl.constexpr(light_layout.NUMBERS)
R_NORMALS, R_SLOPES = tl.constexpr(light_layout.R_NORMALS), tl.constexpr(light_layout.R_SLOPES)
R_SH, R_COUNT = tl.constexpr(light_layout.R_SH), tl.constexpr(light_layout.R_COUNT)
R_SLOT = tl.constexpr(light_layout.R_SLOT)
N_SUN, N_WRAP = tl.constexpr(light_layout.N_SUN), tl.constexpr(light_layout.N_WRAP)


@triton.jit
def light_splats(rows, numbers, lit, BLOCK: tl.constexpr):
    """SH of the splats of layer program_id(1), BLOCK of them a program.

    rows int64 [L, ROW], numbers float32 [L, NUMBERS]: see light_layout. lit [S, 3]: written.
    """
    layer, first = tl.program_id(1), tl.program_id(0) * BLOCK
    row, view = rows + layer * ROW, numbers + layer * NUMBERS
    count = tl.load(row + R_COUNT).to(tl.int32)
    if first < count:
        lane = first + tl.arange(0, BLOCK)
        inside = lane < count
        normals = three_where(floats_at(tl.load(row + R_NORMALS)) + lane * 3, inside)
        slopes = three_where(floats_at(tl.load(row + R_SLOPES)) + lane * 3, inside)
        sh = three_where(floats_at(tl.load(row + R_SH)) + lane * 3, inside)
        wrap = tl.load(view + N_WRAP)
        facing = (dot(normals, three(view + N_SUN)) + wrap) / (1.0 + wrap)
        share = tl.minimum(tl.maximum(facing, 0.0), 1.0) / C0
        own = lit + (tl.load(row + R_SLOT).to(tl.int32) + lane) * 3
        tl.store(own, sh[0] + slopes[0] * share, inside)
        tl.store(own + 1, sh[1] + slopes[1] * share, inside)
        tl.store(own + 2, sh[2] + slopes[2] * share, inside)
