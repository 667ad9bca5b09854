"""What the GPU's kernel reads that lights snow splat by splat, layer by layer."""

from __future__ import annotations

# int64: where normals, slopes and SH lie, by address; how many splats, and the place of the first
# among all that are lit.
R_NORMALS, R_SLOPES, R_SH, R_COUNT, R_SLOT = range(5)
ROW = 5
N_SUN, N_WRAP = 0, 3  # float32: unit, towards it, in the part's frame; how far light is wrapped
NUMBERS = 4
BLOCK = 256  # splats that a program takes
