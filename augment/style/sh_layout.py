"""What the kernels that fold colour maps into spherical harmonics are given, on CPU and GPU."""

from __future__ import annotations

import numpy as np

from augment.render.sh import SH_C0

FOLDED = 13  # numbers of a folded map: 9 of M row by row, 3 that the first function gets, changes
BLACK = np.float32(-0.5 / SH_C0)  # sh_00 of a colour of 0
