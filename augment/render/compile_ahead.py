"""Kernels compiled by several processes at a time, before they are wanted.

numba compiles one kernel after another, when each is first called. `signatures.json` lists what
the kernels are called with, those first that take longest to compile: other processes take from the
list what nobody compiles yet, and leave it in numba's cache. The list only saves time: what is not
in it is compiled when it is called.
"""

from __future__ import annotations

import contextlib
import functools
import importlib
import json
import multiprocessing
from collections.abc import Iterable, Iterator
from importlib import resources
from typing import Any, cast

import numba
from numba import types

from augment.render.cpu.jit import KERNELS, compiling
from augment.render.threads import thread_count

Form = str | list[Any]  # of a type, in JSON


def describe_type(kind: Any) -> Form:
    """A type that JSON can hold: 'int64', 'float32[2]C', or a list of a tuple's class and parts."""
    if isinstance(kind, types.Array):
        return f"{kind.dtype}[{kind.ndim}]{kind.layout}{'' if kind.mutable else ' read-only'}"
    if isinstance(kind, types.BaseTuple):
        named, parts = getattr(kind, "instance_class", tuple), list(cast("Iterable[Any]", kind))
        name = "tuple" if named is tuple else f"{named.__module__}:{named.__qualname__}"
        return [name, *map(describe_type, parts)]
    return str(kind)


def find_type(form: Form) -> Any:
    """The type that `describe_type` described."""
    if not isinstance(form, str):
        name, parts = form[0], [find_type(part) for part in form[1:]]
        if name == "tuple":
            return types.Tuple(parts)
        if len(set(parts)) == 1:  # which numba makes a type of its own
            return types.NamedUniTuple(parts[0], len(parts), _find(name))
        return types.NamedTuple(parts, _find(name))
    text, _, constant = form.partition(" ")
    if "[" not in text:
        return types.none if text == "none" else getattr(numba, text)
    dtype, _, shape = text.partition("[")
    return types.Array(getattr(numba, dtype), int(shape[:-2]), shape[-1], readonly=bool(constant))


def _find(name: str) -> Any:
    module, _, inside = name.partition(":")
    return functools.reduce(getattr, inside.split("."), importlib.import_module(module))


def read_signatures() -> list[tuple[str, list[Form]]]:
    """The list, each a kernel as "module:function" and its arguments' types."""
    text = resources.files("augment.render").joinpath("signatures.json").read_text()
    return [(name, forms) for name, forms in json.loads(text)]


def signatures_in_use() -> set[str]:
    """What this process has called kernels with, as lines of `signatures.json`."""
    return {
        json.dumps([name, [describe_type(kind) for kind in signature]])
        for name, compiled in KERNELS.items()
        for signature in compiled.signatures
    }


@contextlib.contextmanager
def compile_ahead(parts: Iterable[str]) -> Iterator[None]:
    """Meanwhile other processes compile: one for each thread that this process has, but for one.

    parts: of the list, kernels whose module's name begins so.
    """
    spawn, ways = multiprocessing.get_context("spawn"), (tuple(parts),)
    beside = [
        spawn.Process(target=compile_listed, args=ways, daemon=True)
        for _ in range(thread_count() - 1)
    ]
    for process in beside:
        process.start()
    try:
        yield
        for process in beside:
            process.join()
    finally:
        for process in beside:
            process.kill()


def compile_listed(parts: Iterable[str]) -> None:
    """Compile what the list has of these parts and no other process is at."""
    for name, forms in read_signatures():
        if name.startswith(tuple(parts)):
            _find(name)
            compiled, signature = KERNELS[name], tuple(map(find_type, forms))
            with compiling(name, signature, wait=False) as is_mine:
                if is_mine:
                    compiled.compile(signature)
