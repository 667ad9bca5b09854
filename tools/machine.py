"""What a measurement was made on: processor, threads, versions, and how busy it was."""

from __future__ import annotations

import importlib.metadata
import os
import platform
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

PACKAGES = ("climategs", "numpy", "torch", "numba", "llvmlite", "tbb")


@dataclass(frozen=True)
class MachineFacts:
    """processor: its name. cores: those this process may use. simd: vector extensions of note.

    threads, thread_pool: numba's. load: processes that ran or waited, averaged over the minute
    before the measurement; more than a few tenths means that others disturbed it.
    """

    processor: str
    cores: int
    simd: tuple[str, ...]
    memory_gib: float | None
    threads: int
    thread_pool: str
    torch_threads: int
    load: float | None
    platform: str
    python: str
    versions: dict[str, str]


def machine_facts() -> MachineFacts:
    """The facts of this machine and process; starts numba's thread pool if nobody has yet."""
    import torch

    from augment.render.threads import select_thread_pool, thread_count

    thread_pool = select_thread_pool()  # before anything else starts a pool of numba's own choice
    return MachineFacts(
        processor=_field("/proc/cpuinfo", "model name") or platform.processor() or "unknown",
        cores=_usable_cores(),
        simd=_simd(),
        memory_gib=_memory_gib(),
        threads=thread_count(),
        thread_pool=thread_pool,
        torch_threads=torch.get_num_threads(),
        load=load_average(),
        platform=platform.platform(),
        python=platform.python_version(),
        versions={name: version for name in PACKAGES if (version := version_of(name))},
    )


def load_average() -> float | None:
    """Processes that ran or waited over the last minute; None where the system does not say."""
    return round(os.getloadavg()[0], 2) if hasattr(os, "getloadavg") else None


def _usable_cores() -> int:
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _simd() -> tuple[str, ...]:
    flags = (_field("/proc/cpuinfo", "flags") or "").split()
    return tuple(name for name in ("sse4_2", "avx", "avx2", "fma", "avx512f") if name in flags)


def _memory_gib() -> float | None:
    total = _field("/proc/meminfo", "MemTotal")
    return None if total is None else round(int(total.split()[0]) / 2**20, 1)


def _field(path: str, name: str) -> str | None:
    """The first value of `name: value` in a file of /proc; None where there is none."""
    try:
        lines = Path(path).read_text().splitlines()
    except OSError:
        return None
    for line in lines:
        key, _, value = line.partition(":")
        if key.strip() == name:
            return value.strip()
    return None


def version_of(package: str) -> str | None:
    """Of an installed package; None where it is not."""
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


def machine_line(figures: Mapping[str, Any]) -> str:
    """What a benchmark's figures were measured on. figures: with `machine` and `load_after`, and
    `gpu` where one did the work."""
    machine, gpu = figures["machine"], figures.get("gpu")
    return (f"{gpu['name']}; " if gpu else "") + (
        f"{machine['processor']}, {machine['cores']} cores, {machine['threads']} threads; "
        f"load {machine['load']} before, {figures['load_after']} after"
    )
