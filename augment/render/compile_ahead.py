"""Compilation of kernels by several processes at a time, before they are needed.

numba compiles one kernel after another, when each is first called. `signatures.json` lists the
argument types that the kernels are called with; kernels that take longest to compile come first.
Other processes take kernels from the list that no process compiles yet, and leave them in numba's
cache. The list only saves time: a kernel that is not in it is compiled when it is called.
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
from augment.render.threads import num_kernel_threads

# A type as JSON holds it.
Form = str | list[Any]


def describe_type(kind: Any) -> Form:
    """Return a numba type in a form that JSON can hold.

    It is a name such as 'int64' or 'float32[2]C', or a list of a tuple's class and its parts.
    """
    if isinstance(kind, types.Array):
        return f"{kind.dtype}[{kind.ndim}]{kind.layout}{'' if kind.mutable else ' read-only'}"
    if isinstance(kind, types.BaseTuple):
        tuple_class = getattr(kind, "instance_class", tuple)
        parts = list(cast("Iterable[Any]", kind))
        name = (
            "tuple"
            if tuple_class is tuple
            else f"{tuple_class.__module__}:{tuple_class.__qualname__}"
        )
        return [name, *map(describe_type, parts)]
    return str(kind)


def find_type(form: Form) -> Any:
    """Return the type that `describe_type` described."""
    if not isinstance(form, str):
        name = form[0]
        parts = [find_type(part) for part in form[1:]]
        if name == "tuple":
            return types.Tuple(parts)
        if len(set(parts)) == 1:  # numba has a type of its own for these
            return types.NamedUniTuple(parts[0], len(parts), _import_object(name))
        return types.NamedTuple(parts, _import_object(name))
    text, _, read_only_mark = form.partition(" ")
    if "[" not in text:
        return types.none if text == "none" else getattr(numba, text)
    dtype, _, shape = text.partition("[")
    return types.Array(
        getattr(numba, dtype), int(shape[:-2]), shape[-1], readonly=bool(read_only_mark)
    )


def _import_object(name: str) -> Any:
    """Return the object named "module:name"."""
    module, _, qualified_name = name.partition(":")
    return functools.reduce(getattr, qualified_name.split("."), importlib.import_module(module))


def read_signatures() -> list[tuple[str, list[Form]]]:
    """Return the list: for each kernel "module:function" and the types of its arguments."""
    text = resources.files("augment.render").joinpath("signatures.json").read_text()
    return [(name, forms) for name, forms in json.loads(text)]


def signatures_in_use() -> set[str]:
    """Return the calls of kernels in this process, as lines of `signatures.json`."""
    return {
        json.dumps([name, [describe_type(kind) for kind in signature]])
        for name, compiled in KERNELS.items()
        for signature in compiled.signatures
    }


@contextlib.contextmanager
def compile_ahead(module_prefixes: Iterable[str]) -> Iterator[None]:
    """Let other processes compile kernels meanwhile: one for each thread of this process but one.

    module_prefixes: prefixes of the names of the modules whose kernels are compiled.
    """
    spawn = multiprocessing.get_context("spawn")
    arguments = (tuple(module_prefixes),)
    processes = [
        spawn.Process(target=compile_listed, args=arguments, daemon=True)
        for _ in range(num_kernel_threads() - 1)
    ]
    for process in processes:
        process.start()
    try:
        yield
        for process in processes:
            process.join()
    finally:
        for process in processes:
            process.kill()


def compile_listed(parts: Iterable[str]) -> None:
    """Compile the listed kernels of these parts that no other process is compiling."""
    for name, forms in read_signatures():
        if name.startswith(tuple(parts)):
            _import_object(name)
            compiled = KERNELS[name]
            signature = tuple(map(find_type, forms))
            with compiling(name, signature, wait=False) as is_mine:
                if is_mine:
                    compiled.compile(signature)
