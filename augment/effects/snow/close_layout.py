"""Numbers of a view that the GPU's kernel reads which splits discs of snow: float32."""

from __future__ import annotations

N_ROTATION = 0  # camera_from_part, 9 numbers, row by row
N_EYE = 9  # the camera's centre, 3, and the 3 remainders that float32 could not hold
N_LIMITS = 15  # lowest and highest x / z, then y / z
N_FINEST, N_RELIEF, N_MOTTLE = 19, 20, 21  # see close_kernels
N_SUN = 22  # the sun's level direction times half a step, metres: x, y
N_CRUMB, N_CLOD = 24, 26  # where the eye lies in the table of noise, texels: of crumbs, of clods
NUMBERS = 28
# A block's row, int32: its first place in the order of discs, how many it has, into how many along
# a side one of them is split at most, and the place of its first finer disc.
R_FIRST, R_COUNT, R_SPLITS, R_SLOT = range(4)
ROW = 4
BLOCK = 128  # discs, and lanes of a program
