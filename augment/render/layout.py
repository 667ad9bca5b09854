"""Layout of the arrays that kernels hand to each other, on the CPU and, where noted, on the GPU.

All arrays are flat. The CPU kernels index them with unsigned integers, which lets the compiler keep
loops simple. `view_numbers` fills the arrays of a view; `cpu.driver` and `cuda.splats` allocate the
rest. The module also holds `HeightClip`, the plane at which splats are cut, and its derivation.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

# ---- Splats cut at a height: only what lies above, or below, a level plane is drawn --------------
# A splat stands for the surface on which its density is highest along each ray. Let S2 be the
# covariance of its image position, c the covariance of image position and depth, and z the depth of
# its centre. The depth of that surface is
#
#     z(p) = z + g . (p - mean2d),    g = S2^-1 c
#
# to first order (the conditional mean of a Gaussian). For a plane it is 1/z that is linear in the
# image, so i(p) = 1/z - g . (p - mean2d) / z^2 is used, which has the same slope. Seen from an eye
# at height h_eye over the plane, a point at inverse depth i on the ray through p is at height
# z (h_eye i + s(p)), where s is the vertical part of the ray's direction. So
#
#     L(p) = h_eye i(p) + s(p)
#
# is linear in p and has the sign of the height: the cut is a straight line in the image. Divided by
# its slope, L is a distance from that line in pixels, and clamp(L + 0.5, 0, 1) is a smooth edge.
# Parallel rays need no inverse depth: z(p) is exact for a plane, and the height is linear in p.
# With a clip, expected and mode depth are taken over these surfaces, too: over 1/i(p), at most as
# far from the centre as the splat reaches. The centres of large splats lie nearer or farther than
# what a pixel shows of them, by more than shallow water is deep. `SURFACE_DEPTHS_ONLY` asks for
# these depths and
# cuts nothing.

ABOVE = "above"
BELOW = "below"
# Sign of the heights that a clip keeps, by the side that it keeps.
SIGNS = {ABOVE: 1.0, BELOW: -1.0}
# Pixels that are added to the distance from the cut before it is clamped to [0, 1].
EDGE_PX = 0.5
# Pixels that are added besides for a layer that overlaps the edge of another one.
OVERLAP_PX = 1.0
# Pixels that limit the distance from the cut: it has no limit where the slope of L vanishes.
FAR_PX = 1e6
# px^2 that are added to the diagonal of S2, so that splats seen edge-on have a slope.
SHARP_PX2 = 0.003
# Largest depth that a splat may reach from its centre, over the centre's depth: z(p) <= 3 z.
# Cameras with parallel rays have no such limit.
MAX_DEPTH_GROWTH = 2 / 3


@dataclass(frozen=True)
class HeightClip:
    """Side of the plane up . x = z_m (world) that is drawn.

    z_m: height of the plane along `up`, metres.
    kept_side: the side that is drawn, "above" or "below".
    max_distance_m: distance from the plane, metres, beyond which splats may be left out because the
        caller cannot see them. Splats count with their whole extent.
    has_overlap: if True, one more pixel of the edge is kept. This is for a layer that is seen
        behind the edge of another layer, so that nothing shows between them.
    up: unit vector, world.
    """

    z_m: float
    kept_side: Literal["above", "below"]
    max_distance_m: float = math.inf
    has_overlap: bool = False
    up: tuple[float, float, float] = (0.0, 0.0, 1.0)

    def __post_init__(self) -> None:
        if self.kept_side not in SIGNS or not math.isfinite(self.z_m):
            raise ValueError(
                f"kept_side of a clip must be 'above' or 'below' and z_m finite; "
                f"got {self.kept_side!r}, z_m = {self.z_m}"
            )
        if not self.max_distance_m >= 0:
            raise ValueError(
                f"a clip's max_distance_m must be >= 0 metres; got {self.max_distance_m}"
            )

    @property
    def sign(self) -> float:
        """1 where heights above the plane are kept, -1 where heights below it are kept."""
        return SIGNS[self.kept_side]

    def height_above(self, point: Sequence[float]) -> float:
        """Return the height of a point (world) above the plane, metres."""
        return sum(a * b for a, b in zip(self.up, point, strict=True)) - self.z_m

    @property
    def edge_px(self) -> float:
        """Pixels that are added to the distance from the cut."""
        return EDGE_PX + OVERLAP_PX * self.has_overlap


# A clip that cuts nothing: images have the same bits as without a clip, except for the depths,
# which are those of the splats' surfaces.
SURFACE_DEPTHS_ONLY = HeightClip(z_m=-1e9, kept_side="above")


# Type of every index in the CPU kernels.
Index = np.uint64
# Pixels or splats in one register.
NUM_LANES = 8

# Gaussians in a block. A block is one piece of work for a thread; its results (128 KB) stay in the
# thread's cache.
BLOCK_SIZE = 2048
# Low bits of z's float32 pattern that a bin of z leaves out: a bin is 3 % wide.
BIN_SHIFT = 18
# Number of bins of z: all positive finite float32 numbers.
BINS = 0x7F800000 >> BIN_SHIFT

# Width of a tile, pixels.
TILE_W = 16
# Height of a tile, pixels.
TILE_H = 16
# Pixels of a tile.
PIXELS = TILE_W * TILE_H
# Strips of a tile, each one register wide.
STRIPS = TILE_W // NUM_LANES
# Pixels of a strip.
STRIP = TILE_H * NUM_LANES

# ---- A splat's record: RECORD float32, one cache line --------------------------------------------
# With u = x - MEAN_X - LEAN_X (y - MEAN_Y), pixels, the log2 of its alpha is
#     e = LOG_OPACITY - (SHARP_X u)^2 - FALL_Y (y - MEAN_Y)^2,
# the conic with its square completed along a row, so that no term can cancel another. FALL_X,
# LEAN_Y and BLUNT_Y say the same along a column.

# float32 numbers of a record.
RECORD = 16
# Mean, pixels from the image's left edge.
MEAN_X = 0
# Mean, pixels from the image's top edge.
MEAN_Y = 1
# Columns that the ridge of the ellipse shifts per row.
LEAN_X = 2
# Sharpness along a row, 1/px.
SHARP_X = 3
# Fall of log2 alpha with the squared distance from the mean's row, 1/px^2.
FALL_Y = 4
# log2 of the opacity.
LOG_OPACITY = 5
# Rows from the mean to the top or bottom of the ellipse in which alpha can reach ALPHA_MIN.
RADIUS_Y = 6
# Fall of log2 alpha with the squared distance from the mean's column, 1/px^2.
FALL_X = 7
# Rows that the ridge of the ellipse shifts per column.
LEAN_Y = 8
# 1 / sharpness along a column, px.
BLUNT_Y = 9
# z of the centre, metres.
DEPTH = 10
# Index of the Gaussian, counted through all parts: an int32 as float32 bits.
SPLAT_ID = 11
# Red of the colour, display-encoded, as the next two.
RED = 12
GREEN = 13
BLUE = 14
# 1 if the splat's part is an overlay, else 0.
IS_OVERLAY = 15

# ---- The cut of a splat that is clipped at a height: CUT float32 ---------------------------------
# With x and y from its mean, pixels, the kept share of its alpha is
# clamp(C_VALUE + C_X x + C_Y y, 0, 1). The depth of its surface is the depth of its centre over
# 1 - clamp(C_RIGHT x + C_DOWN y, -C_REACH, C_REACH), or, for an orthographic camera, the depth of
# its centre plus that clamped line.

# float32 numbers of a cut.
CUT = 8
# Kept share at the mean, before the clamp.
C_VALUE = 0
# Slope of the kept share along x, 1/px.
C_X = 1
# Slope of the kept share along y, 1/px.
C_Y = 2
# Relative growth of the surface's depth along x, 1/px (orthographic: metres per px).
C_RIGHT = 3
# Relative growth of the surface's depth along y, 1/px (orthographic: metres per px).
C_DOWN = 4
# Largest relative growth or shrinking of the depth (orthographic: metres).
C_REACH = 5

# ---- A view: VIEW float32 for every part of the scene --------------------------------------------

# Rotation camera_from_part: 9 numbers, row by row.
V_ROTATION = 0
# Camera centre in the part, 3 numbers, then the 3 remainders that float32 could not hold.
V_EYE = 9
# Focal lengths in x and y, pixels.
V_FOCAL = 15
# Principal point in x and y, pixels.
V_CENTRE = 17
# Image width and height, pixels.
V_SIZE = 19
# Lower limits of x/z and y/z in the Jacobian.
V_LOW = 21
# Upper limits of x/z and y/z in the Jacobian.
V_HIGH = 23
# Pixels that a semi-axis of one metre can reach at z = 1 at most, in x and y.
V_GAIN = 25
# Smallest z that is drawn, metres.
V_NEAR = 27
# px^2 that are added to the diagonal of the 2D covariance.
V_BLUR = 28
# Alpha below which a splat is skipped.
V_ALPHA_MIN = 29
# log2 of that alpha.
V_LOG_CUT = 30
# Extinction of the fog at its base, 1/m.
V_EXTINCTION = 31
# Airlight of the fog, 3 display-encoded numbers.
V_AIRLIGHT = 32
# Height of the camera over the fog's base, scale heights.
V_EYE_HEIGHT = 35
# Upward parts of the part's three axes, scale heights per metre.
V_UP = 36
# Height of the camera on the kept side of the clip's plane, metres.
V_CLIP_EYE = 39
# Direction towards the kept side, in the part's axes: 3 numbers.
V_CLIP_PART = 40
# Direction towards the kept side, in the camera's axes: 3 numbers.
V_CLIP_CAMERA = 43
# Pixels that are added to the distance from the cut.
V_CLIP_EDGE = 46
# Sigmas that a splat reaches at most.
V_EXTENT = 47
# Distance from the clip's plane beyond which nothing need be drawn, metres.
V_CLIP_REACH = 48
# Factor that, times inverse^2, says how the cut's slope follows the slope of the surface.
V_CLIP_FALL = 49
# Largest growth or shrinking of a surface's depth.
V_CLIP_LONGEST = 50
# 1 if rays are parallel, else 0.
V_PARALLEL = 51
# 1 if the part is an overlay, else 0.
V_OVERLAY = 52
# Unit vector towards the light, in the camera's axes: 3 numbers.
V_SUN = 53
# Wrap of the light around a splat (augment.render.shading).
V_WRAP = 56
# 1 if the part is lit pixel by pixel, else 0.
V_LIT = 57
# Number of the part's colour maps.
V_MAPS = 58
# Radius, pixels, up to which splats are left out; negative for none.
V_RADIUS_CLIP = 59
# Distance from the eye beyond which the fog leaves nothing of a splat to be drawn, metres.
V_FOG_FAR = 60
# float32 numbers of a view.
VIEW = 64

# ---- The arrays that a part is read from, by address ---------------------------------------------

A_MEANS = 0
A_QUATS = 1
A_SCALES = 2
A_OPACITIES = 3
A_SH = 4
# Slopes of the light; they are read for lit parts only.
A_SLOPES = 5
# Colour maps; they are read where V_MAPS > 0.
A_MAPS = 6
# int16 row of the colour maps for every Gaussian; they are read where V_MAPS > 1.
A_ROWS = 7
# Number of these addresses.
NUM_ADDRESSES = 8
# Numbers of a colour map.
MAP = 12

# ---- Modes of the projection: int64 each ---------------------------------------------------------

# 1 if colours are computed.
M_COLOR = 0
# Largest number of SH functions that is evaluated.
M_NUM_SH_FUNCTIONS = 1
# 1 if opacities are scaled by sqrt(det / det_blurred).
M_ANTIALIASED = 2
# NO_FOG, UNIFORM_FOG or LAYERED_FOG.
M_FOG = 3
# 1 if splats are cut at a height.
M_CLIP = 4
# 1 if any part is lit pixel by pixel.
M_LIGHT = 5
# Address of the table of fog banks (augment.render.fog_table), float32; 0 without banks.
M_BANKS = 6
# Number of the table's numbers.
M_BANKS_COUNT = 7
# Number of the modes.
MODES = 8
# Values of M_FOG.
NO_FOG = 0
UNIFORM_FOG = 1
LAYERED_FOG = 2
