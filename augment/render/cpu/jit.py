"""How the CPU backend's functions are compiled. Importing compiles nothing; the first call does.

Division follows IEEE 754 (error_model), and no rounding is left to the compiler (no fast-math), so
an image has the same bits from every variant of a kernel.
"""

from __future__ import annotations

import contextlib
import fcntl
import functools
import hashlib
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from types import CellType, FunctionType
from typing import Any

import numba
from numba.core.compiler_lock import global_compiler_lock

_COMMON = {"nogil": True, "error_model": "numpy"}

KERNELS: dict[str, Any] = {}  # all that were imported, by "module:function"

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
    put there. Of processes that want a kernel at the same time, one compiles it and the others
    wait for it.
    """
    return _compiled(function, parallel=True)


def serial_kernel(function: FunctionType) -> Any:
    """As `kernel`, on the thread that calls it."""
    return _compiled(function, parallel=False)


def _compiled(function: FunctionType, *, parallel: bool) -> Any:
    code = function.__code__.replace(co_freevars=("sources",))
    closed = FunctionType(code, function.__globals__, function.__name__, None, (CellType(SOURCES),))
    functools.update_wrapper(closed, function)
    del closed.__wrapped__
    compiled = numba.njit(parallel=parallel, cache=True, **_COMMON)(closed)
    name = f"{function.__module__}:{function.__name__}"
    compiled.compile = functools.partial(_compile_alone, compiled.compile, name)
    KERNELS[name] = compiled
    return compiled


def _compile_alone(compile_kernel: Callable[[Any], Any], name: str, sig: Any) -> Any:
    # In this order: a kernel's compilation compiles those that it calls, under numba's lock.
    with global_compiler_lock, compiling(name, sig):
        return compile_kernel(sig)


@contextlib.contextmanager
def compiling(name: str, sig: Any, *, wait: bool = True) -> Iterator[bool]:
    """The right to compile a kernel, among this user's processes, or to read it from the cache.

    Yields False where another process has it and there is no waiting.
    """
    digest = hashlib.sha256(f"{SOURCES} {name} {sig}".encode()).digest()
    place, way = int.from_bytes(digest[:7], "big"), fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB)
    try:
        file = _lock_file(os.getpid())
        fcntl.lockf(file, way, 1, place)
    except BlockingIOError:
        yield False
    except OSError:  # there is no such folder: processes may do the same work twice
        yield True
    else:
        try:
            yield True
        finally:
            fcntl.lockf(file, fcntl.LOCK_UN, 1, place)


@functools.cache
def _lock_file(_process: int) -> int:
    """A file of which each kernel's lock is a byte. It stays open: closing it ends all locks."""
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "climategs"
    cache.mkdir(parents=True, exist_ok=True)
    return os.open(cache / "kernels.lock", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
