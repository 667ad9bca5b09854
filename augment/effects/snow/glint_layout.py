"""What the GPU's kernel reads that finds glints."""

from __future__ import annotations

# A layer: where its crystals lie, by address, and float32 numbers of the view from its part.
A_PLACES, A_MIRRORS = 0, 1
ADDRESSES = 2
N_EYE = 0  # 3, and the 3 remainders that float32 could not hold
N_SUN, N_STRENGTH = 6, 9  # unit, towards it; see Crystals
NUMBERS = 10
# A block's row, int32: its layer, its first crystal and how many, the place of its first glint.
R_LAYER, R_FIRST, R_COUNT, R_SLOT = range(4)
ROW = 4

BLOCK = 1024  # crystals, and lanes of a program
# Glints of a block at most: mirrors face every direction alike, so that one in 80 throws the sun at
# an eye; five times as many in one block come up once in 10^20.
MOST = 64
