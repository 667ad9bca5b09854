"""Counts the numba kernels that Python launches, by name, while a test runs."""

from __future__ import annotations

import functools
import importlib
import re
import sys
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from numba.core.dispatcher import Dispatcher

import augment


class CountingKernel:
    """Stands where a kernel is launched. What else Python asks of it, it asks of the kernel."""

    def __init__(self, kernel: Dispatcher, counts: Counter[str]) -> None:
        self._kernel, self._counts = kernel, counts

    def __call__(self, *arguments):
        self._counts[self._kernel.__name__] += 1
        return self._kernel(*arguments)

    def __getattr__(self, name: str):
        return getattr(self._kernel, name)


def is_kernel(value: object) -> bool:
    """Whether it is a compiled function with threads of its own: those are launched from Python;
    what they call is compiled into them.
    """
    return isinstance(value, Dispatcher) and bool(value.targetoptions.get("parallel"))


@functools.cache
def _import_kernels() -> None:
    """Every module that compiles some, so that none can be launched under a name not known here."""
    root = Path(augment.__path__[0])
    for path in sorted(root.rglob("*.py")):
        if re.search(r"^@(kernel|numba\.njit)", path.read_text(), re.MULTILINE):
            importlib.import_module(
                ".".join(("augment", *path.relative_to(root).with_suffix("").parts))
            )


def launch_sites() -> dict[tuple[str, str], Dispatcher]:
    """Kernels by the module and the name that they can be launched under."""
    _import_kernels()
    modules = [m for name, m in sorted(sys.modules.items()) if name.startswith("augment.")]
    return {
        (module.__name__, name): value
        for module in modules
        for name, value in vars(module).items()
        if is_kernel(value)
    }


@contextmanager
def counted_kernels() -> Iterator[Counter[str]]:
    """Launches of every kernel of the library inside the block."""
    counts, sites = Counter[str](), launch_sites()
    try:
        for (module, name), kernel in sites.items():
            setattr(sys.modules[module], name, CountingKernel(kernel, counts))
        yield counts
    finally:
        for (module, name), kernel in sites.items():
            setattr(sys.modules[module], name, kernel)
