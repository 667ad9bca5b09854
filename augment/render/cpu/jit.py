"""How the CPU backend's functions are compiled. Importing compiles nothing; the first call does.

Division follows IEEE 754 (error_model), and no rounding is left to the compiler (no fast-math), so
an image has the same bits from every variant of a kernel.
"""

from __future__ import annotations

import functools
import hashlib
from pathlib import Path
from types import CellType, FunctionType
from typing import Any

import numba

_COMMON = {"nogil": True, "error_model": "numpy"}

# Called by kernels only, which keep its code in their own cache files.
inner = functools.partial(numba.njit, no_cpython_wrapper=True, no_cfunc_wrapper=True, **_COMMON)


def _hash_sources() -> str:
    folder = Path(__file__).parent
    sources = [*sorted(folder.glob("*.py")), folder.parent / "layout.py"]
    return hashlib.sha256(b"".join(path.read_bytes() for path in sources)).hexdigest()


SOURCES = _hash_sources()


def kernel(function: FunctionType) -> Any:
    """A parallel kernel, launched from Python and compiled once for these sources and this machine.

    numba's cache looks at the kernel's own file alone and would go on using code of other files
    that has changed since. It does look at what a function closes over, so a hash of all files is
    put there.
    """
    code = function.__code__.replace(co_freevars=("sources",))
    closed = FunctionType(code, function.__globals__, function.__name__, None, (CellType(SOURCES),))
    functools.update_wrapper(closed, function)
    del closed.__wrapped__
    return numba.njit(parallel=True, cache=True, **_COMMON)(closed)
