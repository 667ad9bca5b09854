"""How kernels lay out what they hand to each other, on the CPU and, where it says so, on the GPU.

Arrays are flat; the CPU's indices are unsigned, which is what lets the compiler keep loops simple.
"""

from __future__ import annotations

import numpy as np

U = np.uint64
LANES = 8  # pixels or splats in one register

# Gaussians are worked on in blocks: one piece of work for a thread, whose results (128 KB) stay in
# its cache.
BLOCK = 2048
BIN_SHIFT = 18  # z is counted in bins of its float32 pattern without these low bits: 3 % wide
BINS = 0x7F800000 >> BIN_SHIFT

TILE_W, TILE_H = 16, 16
PIXELS = TILE_W * TILE_H
STRIPS = TILE_W // LANES  # of a tile, each one register wide
STRIP = TILE_H * LANES  # pixels of a strip

# A splat's record: RECORD float32, one cache line. With u = x - MEAN_X - LEAN_X (y - MEAN_Y),
# pixels, the log2 of its alpha is
#     e = LOG_OPACITY - (SHARP_X u)^2 - FALL_Y (y - MEAN_Y)^2,
# the conic with its square completed along a row, so that no term can cancel another. FALL_X,
# LEAN_Y and BLUNT_Y (1 / sharpness) say the same along a column.
RECORD = 16
MEAN_X, MEAN_Y, LEAN_X, SHARP_X, FALL_Y, LOG_OPACITY = 0, 1, 2, 3, 4, 5
RADIUS_Y, FALL_X, LEAN_Y, BLUNT_Y, DEPTH = 6, 7, 8, 9, 10
SPLAT_ID, RED, GREEN, BLUE, IS_SNOW = 11, 12, 13, 14, 15

# The cut of a splat that is clipped at a height: CUT float32. With x and y from its mean, pixels,
# the kept share of its alpha is clamp(C_AT + C_X x + C_Y y, 0, 1), and its surface's depth is its
# centre's over 1 - clamp(C_RIGHT x + C_DOWN y, -C_REACH, C_REACH), or, seen by an orthographic
# camera, its centre's plus that clamped line.
CUT = 8
C_AT, C_X, C_Y, C_RIGHT, C_DOWN, C_REACH = 0, 1, 2, 3, 4, 5

# A view: VIEW float32 for every part of the scene.
V_ROTATION = 0  # camera_from_part, 9 numbers, row by row
V_EYE = 9  # camera centre in the part, 3, and the 3 remainders that float32 could not hold
V_FOCAL, V_CENTRE, V_SIZE = 15, 17, 19  # pixels, x and y each
V_LOW, V_HIGH = 21, 23  # limits of x/z and y/z in the Jacobian
V_GAIN = 25  # most that a semi-axis of one metre can reach at z = 1, pixels, in x and y
V_NEAR, V_BLUR, V_ALPHA_MIN, V_LOG_CUT = 27, 28, 29, 30
V_SIGMA, V_AIRLIGHT = 31, 32  # smog: extinction, and 3 of display-encoded colour
V_EYE_HEIGHT, V_UP = 35, 36  # camera and part axes upwards, in scale heights: 1 and 3
V_CLIP_EYE = 39  # height of the camera on the kept side of the clip's plane, metres
V_CLIP_PART, V_CLIP_CAMERA = 40, 43  # towards that side, in the part's axes and the camera's
V_CLIP_EDGE, V_EXTENT = 46, 47  # pixels; sigmas that a splat reaches at most
V_CLIP_REACH = 48  # metres from the clip's plane beyond which nothing need be drawn
V_CLIP_FALL = 49  # times inverse^2: how the cut's slope follows the surface's
V_CLIP_LONGEST = 50  # most that a surface's depth may grow or shrink
V_PARALLEL = 51  # 1 where rays are parallel, else 0
V_SNOW = 52  # 1 where the part is snow, else 0
V_SUN, V_WRAP = 53, 56  # towards the light, in the camera's axes; how far it is wrapped
V_LIT = 57  # 1 where the part is lit pixel by pixel, else 0
V_MAPS = 58  # how many colour maps the part has
V_RADIUS_CLIP = 59  # pixels; splats no larger are left out; negative for none
VIEW = 64

# What a part is read from: arrays of these by address.
A_MEANS, A_QUATS, A_SCALES, A_OPACITIES, A_SH = 0, 1, 2, 3, 4
A_SLOPES = 5  # of the light; read of lit parts only
A_MAPS, A_ROWS = 6, 7  # colour maps, read where V_MAPS > 0; int16 rows of them, where it is > 1
ADDRESSES = 8
MAP = 12  # numbers of a colour map

# How to project: int64 each.
M_COLOR, M_FUNCTIONS, M_ANTIALIASED, M_SMOG = 0, 1, 2, 3  # M_FUNCTIONS: most SH functions
M_CLIP, M_LIGHT = 4, 5
MODES = 6
NO_SMOG, UNIFORM_SMOG, LAYERED_SMOG = 0, 1, 2
