"""Compilation of the CPU backend's functions. Importing compiles nothing; the first call does.

Division follows IEEE 754 (error_model), and no rounding is left to the compiler (no fast-math). So
an image has the same bits from every variant of a kernel.
"""

from __future__ import annotations

import contextlib
import fcntl
import functools
import hashlib
import logging
import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import CellType, FunctionType
from typing import Any

import numba
from numba.core import event
from numba.core.compiler_lock import global_compiler_lock

from augment.render.cpu.kernel_cache import cache_of_kernel, kernel_cache_folder, user_cache_folder

logger = logging.getLogger(__name__)

# Seconds without compiling after which the next compiling is logged again.
MIN_PAUSE_S = 10.0
_COMMON = {"nogil": True, "error_model": "numpy"}

# All imported kernels, by "module:function".
KERNELS: dict[str, Any] = {}

# Decorator of a function that kernels call; they keep its code in their own cache files.
kernel_function = functools.partial(
    numba.njit, no_cpython_wrapper=True, no_cfunc_wrapper=True, **_COMMON
)


def _hash_sources() -> str:
    """Return a digest of the files that hold functions which kernels of other files call."""
    folder = Path(__file__).parent
    render = folder.parent
    sources = [
        *sorted(folder.glob("*.py")),
        *sorted(render.glob("*_kernels.py")),
        render / "layout.py",
        render / "fog_banks.py",
        *sorted((render.parent / "lamps").glob("*_kernels.py")),
        *sorted((render.parent / "effects" / "lamps").glob("*_kernels.py")),
        *sorted((render.parent / "effects" / "falling").glob("*_kernels.py")),
    ]
    return hashlib.sha256(b"".join(path.read_bytes() for path in sources)).hexdigest()


SOURCES = _hash_sources()


def kernel(function: FunctionType) -> Any:
    """Return a parallel kernel, launched from Python and compiled once per version and machine.

    numba's cache looks at the kernel's own file alone, and would go on using code of other files
    that has changed since. It does look at the variables that a function closes over, so a hash of
    all files is put there. If several processes want a kernel at the same time, one compiles it and
    the others wait for it.
    """
    return _compiled(function, parallel=True)


def serial_kernel(function: FunctionType) -> Any:
    """Return a kernel as `kernel` does, for the calling thread alone."""
    return _compiled(function, parallel=False)


def _compiled(function: FunctionType, *, parallel: bool) -> Any:
    """Return a numba function that is compiled once for these sources, by one process at a time."""
    code = function.__code__.replace(co_freevars=("sources",))
    closure = FunctionType(
        code, function.__globals__, function.__name__, None, (CellType(SOURCES),)
    )
    functools.update_wrapper(closure, function)
    del closure.__wrapped__
    compiled = numba.njit(parallel=parallel, **_COMMON)(closure)
    if (cache := cache_of_kernel(closure, SOURCES)) is not None:
        compiled._cache = cache
    name = f"{function.__module__}:{function.__name__}"
    compiled.compile = functools.partial(_compile_alone, compiled.compile, name)
    KERNELS[name] = compiled
    return compiled


def cached_njit(**options: Any) -> Callable[[FunctionType], Any]:
    """Return a decorator as `numba.njit(cache=True, **options)`, for functions beside the kernels.

    Compiled code lies in the user's cache folder. A function is compiled again when any file in its
    folder changes.
    """

    def decorate(function: FunctionType) -> Any:
        compiled = numba.njit(**options)(function)
        folder = str(Path(function.__code__.co_filename).parent)
        if (cache := cache_of_kernel(function, _hash_folder(folder))) is not None:
            compiled._cache = cache
        return compiled

    return decorate


@functools.cache
def _hash_folder(folder: str) -> str:
    sources = sorted(Path(folder).glob("*.py"))
    return hashlib.sha256(b"".join(path.read_bytes() for path in sources)).hexdigest()


def _compile_alone(compile_kernel: Callable[[Any], Any], name: str, sig: Any) -> Any:
    # The locks are taken in this order, since a kernel's compilation compiles the kernels that it
    # calls, under numba's lock.
    with global_compiler_lock, compiling(name, sig), _CLOCK.running():
        return compile_kernel(sig)


class _Clock:
    """Seconds that this process has spent on compiling kernels, and on reading them from the cache.

    It runs under numba's lock, so for one thread at a time.
    """

    def __init__(self) -> None:
        self.seconds = 0.0
        self._depth = 0

    @contextlib.contextmanager
    def running(self) -> Iterator[None]:
        """Count the time inside; nested uses count once."""
        started = time.perf_counter()
        self._depth += 1
        try:
            yield
        finally:
            self._depth -= 1
            if self._depth == 0:  # else a kernel's compilation has compiled another one
                self.seconds += time.perf_counter() - started


_CLOCK = _Clock()


class _CompileLog(event.Listener):
    """Listener that logs before the first of several kernels is compiled.

    Reading kernels from the cache is no such event.
    """

    def __init__(self) -> None:
        self._end_s = -MIN_PAUSE_S

    def on_start(self, event: event.Event) -> None:
        if time.monotonic() - self._end_s >= MIN_PAUSE_S:
            folder = os.environ.get("NUMBA_CACHE_DIR") or kernel_cache_folder()
            logger.info(COMPILE_NOTE, folder or "numba's own place")
        self._end_s = time.monotonic()  # of inner functions' events, which lie within it

    def on_end(self, event: event.Event) -> None:
        self._end_s = time.monotonic()


COMPILE_NOTE = "compiling kernels (once; kept in %s) ..."
event.register("numba:compile", _CompileLog())


def compile_seconds() -> float:
    """Return how many seconds this process has spent on having its kernels compiled so far."""
    return _CLOCK.seconds


@contextlib.contextmanager
def compiling(name: str, sig: Any, *, wait: bool = True) -> Iterator[bool]:
    """Take the right to compile a kernel, or to read it from the cache, among this user's
    processes.

    Yields False if another process has it and `wait` is False.
    """
    digest = hashlib.sha256(f"{SOURCES} {name} {sig}".encode()).digest()
    lock_byte = int.from_bytes(digest[:7], "big")
    lock_mode = fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB)
    try:
        file = _lock_file(os.getpid())
        fcntl.lockf(file, lock_mode, 1, lock_byte)
    except BlockingIOError:
        yield False
    except OSError:  # there is no such folder, so processes may do the same work twice
        yield True
    else:
        try:
            yield True
        finally:
            fcntl.lockf(file, fcntl.LOCK_UN, 1, lock_byte)


@functools.cache
def _lock_file(_process: int) -> int:
    """Return a file of which each kernel's lock is a byte. It stays open: closing it ends all
    locks.
    """
    cache = user_cache_folder()
    if cache is None:
        raise FileNotFoundError("this user has no home folder, so no cache folder")
    cache.mkdir(parents=True, exist_ok=True)
    flags = os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW
    return os.open(cache / "kernels.lock", flags, 0o600)
