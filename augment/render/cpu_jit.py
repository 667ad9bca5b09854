"""How the CPU backend's functions are compiled. Importing compiles nothing; the first call does.

Division follows IEEE 754 (error_model), and no rounding is left to the compiler (no fast-math), so
an image has the same bits from every variant of a kernel.
"""

from __future__ import annotations

import functools

import numba

_COMMON = {"nogil": True, "error_model": "numpy"}

kernel = functools.partial(numba.njit, parallel=True, cache=True, **_COMMON)  # launched from Python
# Called by kernels only, which keep its code in their own cache files.
inner = functools.partial(numba.njit, no_cpython_wrapper=True, no_cfunc_wrapper=True, **_COMMON)
