"""The thread pool of the CPU kernels: TBB, which survives a fork.

Numba's OpenMP layer kills forked DataLoader workers once the parent has rendered. TBB does not, but
numba looks for its library where the system keeps libraries, and pip installs it elsewhere.
"""

from __future__ import annotations

import ctypes
import functools
import logging
import os
import sys
from pathlib import Path

import numba

LIBRARY = "libtbb.so.12"
logger = logging.getLogger(__name__)


@functools.cache
def prepare() -> str:
    """Selects the layer before numba starts its pool; to be called before any parallel kernel.

    Returns the layer's name. A choice made through NUMBA_THREADING_LAYER is left alone.
    """
    if "NUMBA_THREADING_LAYER" in os.environ:
        return os.environ["NUMBA_THREADING_LAYER"]
    path = Path(sys.prefix) / "lib" / LIBRARY
    try:
        ctypes.CDLL(str(path) if path.is_file() else LIBRARY, mode=ctypes.RTLD_GLOBAL)
    except OSError:
        logger.warning(
            "the TBB library (%s) was not found; DataLoader workers that render must be started "
            "with multiprocessing_context='spawn'. Install the package `tbb` to remove this limit",
            LIBRARY,
        )
        return "default"
    numba.config.THREADING_LAYER = "tbb"
    return "tbb"
