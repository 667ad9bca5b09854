"""How kernels lay out what they hand to each other, on the CPU and, where it says so, on the GPU.

Arrays are flat; the CPU's indices are unsigned, which is what lets the compiler keep loops simple.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

# ---- Splats cut at a height: what lies above a level plane, or below it, is drawn ----------------
# A splat is taken for the surface on which its density is highest along each ray: with covariance
# S2 of its image position and c, that of image position and depth, the depth there is
#
#     z(p) = z + g . (p - mean2d),    g = S2^-1 c
#
# to first order (the conditional mean of a Gaussian). Of a plane it is 1/z that is linear in the
# image, so i(p) = 1/z - g . (p - mean2d) / z^2 is used, which has the same slope. Seen from an eye
# at height h_eye over the plane, a point at inverse depth i on the ray through p is at height
# z (h_eye i + s(p)), s being the vertical part of the ray's direction. So
#
#     L(p) = h_eye i(p) + s(p)
#
# is linear in p and has the sign of the height: the cut is a straight line in the image. Divided by
# its slope, L is a distance from that line in pixels, and clamp(L + 0.5, 0, 1) a smooth edge.
# Parallel rays need no such detour: there z(p) is exact for a plane, and the height linear in p.
# With a clip, expected and mode depth, too, are taken over these surfaces, 1/i(p), no farther from
# the centre than the splat reaches: the centres of large splats stand nearer or farther than what a
# pixel shows of them, by more than shallow water is deep. `UNCUT` asks for that and cuts nothing.

ABOVE, BELOW = "above", "below"
SIGNS = {ABOVE: 1.0, BELOW: -1.0}
EDGE_PX, OVERLAP_PX = 0.5, 1.0  # added to the distance before it is clamped to [0, 1]
FAR_PX = 1e6  # distances are clamped to this: where the slope vanishes they have no end
SHARP_PX2 = 0.003  # added to S2's diagonal, so that splats seen edge-on have a slope
LONGEST = 2 / 3  # of its depth, that a splat may reach: z(p) is at most 3 z (no matter if parallel)


@dataclass(frozen=True)
class HeightClip:
    """The side of the plane up . x = z_m (world, metres) that is kept. up: unit.

    reach_m: splats that lie farther from the plane than this with all they are may be left out,
    where whoever asks could not see them. overlaps: keep one pixel more than half of the edge, for
    a layer that is seen behind the edge of another: nothing shows between them then.
    """

    z_m: float
    keep: Literal["above", "below"]
    reach_m: float = math.inf
    overlaps: bool = False
    up: tuple[float, float, float] = (0.0, 0.0, 1.0)

    def __post_init__(self) -> None:
        if self.keep not in SIGNS or not math.isfinite(self.z_m):
            raise ValueError(
                f"a clip keeps 'above' or 'below' a finite height; "
                f"got {self.keep!r}, z_m = {self.z_m}"
            )
        if not self.reach_m >= 0:
            raise ValueError(f"a clip's reach_m must be >= 0 metres; got {self.reach_m}")

    @property
    def sign(self) -> float:
        """1 where heights above the plane are kept, -1 where those below are."""
        return SIGNS[self.keep]

    def height_of(self, point: Sequence[float]) -> float:
        """Of a point (world) above the plane, metres."""
        return sum(a * b for a, b in zip(self.up, point, strict=True)) - self.z_m

    @property
    def edge_px(self) -> float:
        """What is added to the distance from the cut, pixels."""
        return EDGE_PX + OVERLAP_PX * self.overlaps


# Nothing is cut: images have the bits of those without a clip, but for depths, which are surfaces'.
UNCUT = HeightClip(z_m=-1e9, keep="above")


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
SPLAT_ID, RED, GREEN, BLUE, IS_OVERLAY = 11, 12, 13, 14, 15

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
V_SIGMA, V_AIRLIGHT = 31, 32  # fog: extinction, and 3 of display-encoded colour
V_EYE_HEIGHT, V_UP = 35, 36  # camera and part axes upwards, in scale heights: 1 and 3
V_CLIP_EYE = 39  # height of the camera on the kept side of the clip's plane, metres
V_CLIP_PART, V_CLIP_CAMERA = 40, 43  # towards that side, in the part's axes and the camera's
V_CLIP_EDGE, V_EXTENT = 46, 47  # pixels; sigmas that a splat reaches at most
V_CLIP_REACH = 48  # metres from the clip's plane beyond which nothing need be drawn
V_CLIP_FALL = 49  # times inverse^2: how the cut's slope follows the surface's
V_CLIP_LONGEST = 50  # most that a surface's depth may grow or shrink
V_PARALLEL = 51  # 1 where rays are parallel, else 0
V_OVERLAY = 52  # 1 where the part is an overlay, else 0
V_SUN, V_WRAP = 53, 56  # towards the light, in the camera's axes; how far it is wrapped
V_LIT = 57  # 1 where the part is lit pixel by pixel, else 0
V_MAPS = 58  # how many colour maps the part has
V_RADIUS_CLIP = 59  # pixels; splats no larger are left out; negative for none
V_FOG_FAR = 60  # metres from the eye beyond which the fog leaves nothing of a splat to be drawn
VIEW = 64

# What a part is read from: arrays of these by address.
A_MEANS, A_QUATS, A_SCALES, A_OPACITIES, A_SH = 0, 1, 2, 3, 4
A_SLOPES = 5  # of the light; read of lit parts only
A_MAPS, A_ROWS = 6, 7  # colour maps, read where V_MAPS > 0; int16 rows of them, where it is > 1
ADDRESSES = 8
MAP = 12  # numbers of a colour map

# How to project: int64 each.
M_COLOR, M_FUNCTIONS, M_ANTIALIASED, M_FOG = 0, 1, 2, 3  # M_FUNCTIONS: most SH functions
M_CLIP, M_LIGHT = 4, 5
MODES = 6
NO_FOG, UNIFORM_FOG, LAYERED_FOG = 0, 1, 2
