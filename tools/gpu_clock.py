"""Times on a GPU, by events on its own clock, and what it is: for benchmarks."""

from __future__ import annotations

import dataclasses
import gc
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Protocol

import torch

from tools.machine import version_of

Action = Callable[[], object]


class Clock(Protocol):
    """Moments of the GPU's work. mark: the moment when what was asked for until now is done."""

    def mark(self) -> object: ...

    def wait(self) -> None: ...

    def between_ms(self, first: object, then: object) -> float: ...


class EventClock:
    """Of the GPU: marks are events among its work, so that nothing waits while they are set."""

    def mark(self) -> torch.cuda.Event:
        event = torch.cuda.Event(enable_timing=True)
        event.record()
        return event

    def wait(self) -> None:
        torch.cuda.synchronize()

    def between_ms(self, first: object, then: object) -> float:
        assert isinstance(first, torch.cuda.Event) and isinstance(then, torch.cuda.Event)
        return first.elapsed_time(then)


class WallClock:
    """Of the host, for work that is done when its call returns."""

    def mark(self) -> float:
        return time.perf_counter()

    def wait(self) -> None:
        pass

    def between_ms(self, first: object, then: object) -> float:
        assert isinstance(first, float) and isinstance(then, float)
        return 1e3 * (then - first)


@dataclass(frozen=True)
class Timing:
    """How often and by which clock. warm_up: runs before the first that counts."""

    repeats: int = 30
    warm_up: int = 5
    clock: Clock = dataclasses.field(default_factory=EventClock)

    def __post_init__(self) -> None:
        if self.repeats < 1 or self.warm_up < 0:
            raise ValueError(f"need repeats >= 1 and warm_up >= 0; got {self}")


def times_in_turns(actions: Mapping[str, Action], timing: Timing) -> dict[str, list[float]]:
    """Milliseconds of each action, every other turn in the opposite order, so that what the GPU's
    clocks and the host do meanwhile falls on all.

    From one action's mark to its next is the time on the GPU, the GPU's waiting for the host's
    launches included; no action waits for the one before unless it does so by itself.
    """
    clock, marks = timing.clock, {name: [] for name in actions}
    for turn in range(timing.warm_up + timing.repeats):
        if turn == timing.warm_up:
            clock.wait()
        names = list(actions)
        for name in names if turn % 2 else reversed(names):
            start = clock.mark()
            actions[name]()
            end = clock.mark()
            if turn >= timing.warm_up:
                marks[name].append((start, end))
    clock.wait()
    return {name: [clock.between_ms(*pair) for pair in each] for name, each in marks.items()}


def host_times_ms(action: Action, timing: Timing) -> list[float]:
    """Milliseconds from the call to the end of its work, each begun when the GPU is idle."""
    found = []
    for turn in range(timing.warm_up + timing.repeats):
        timing.clock.wait()
        start = time.perf_counter()
        action()
        timing.clock.wait()
        if turn >= timing.warm_up:
            found.append(1e3 * (time.perf_counter() - start))
    return found


@dataclass(frozen=True)
class GpuFacts:
    """name: the GPU's. processors: its streaming multiprocessors. l2_mib: its last cache."""

    name: str
    memory_gib: float
    processors: int
    l2_mib: float | None
    capability: str
    cuda: str | None
    driver: str | None
    triton: str | None


def gpu_facts() -> GpuFacts | None:
    """Of the current GPU; None where torch sees none."""
    if not torch.cuda.is_available():
        return None
    found = torch.cuda.get_device_properties(torch.cuda.current_device())
    l2 = getattr(found, "L2_cache_size", None)
    return GpuFacts(
        name=found.name,
        memory_gib=round(found.total_memory / 2**30, 1),
        processors=found.multi_processor_count,
        l2_mib=None if l2 is None else round(l2 / 2**20, 1),
        capability=f"{found.major}.{found.minor}",
        cuda=torch.version.cuda,
        driver=_driver(),
        triton=version_of("triton"),
    )


def _driver() -> str | None:
    try:
        with open("/proc/driver/nvidia/version") as file:
            words = file.readline().split()
    except OSError:
        return None
    return next((word for word in words if word[:1].isdigit() and "." in word), None)


def peak_gpu_mib(action: Action) -> tuple[float, float] | None:
    """MiB of tensors on the GPU at the action's highest moment: all of them, and above what lay
    there before. None without a GPU.

    What torch holds free is not counted: it gives it to the next that asks.
    """
    if not torch.cuda.is_available():
        return None
    gc.collect()
    torch.cuda.synchronize()
    torch.cuda.empty_cache()
    before = torch.cuda.memory_allocated()
    torch.cuda.reset_peak_memory_stats()
    kept = action()
    torch.cuda.synchronize()
    highest = torch.cuda.max_memory_allocated()
    del kept
    return highest / 2**20, (highest - before) / 2**20


def gpu_mib() -> float | None:
    """MiB of tensors that lie on the GPU now; None without one."""
    if not torch.cuda.is_available():
        return None
    gc.collect()
    torch.cuda.synchronize()
    return torch.cuda.memory_allocated() / 2**20


def check_gpu() -> None:
    """Raises BackendUnavailable where there is no GPU to measure."""
    from augment.errors import BackendUnavailable
    from augment.render.buffers import available_backends
    from augment.render.cuda.runtime import has_gpu

    if has_gpu():
        return
    why = available_backends()["cuda"] or (
        f"torch {torch.__version__} sees no GPU, or TRITON_INTERPRET is set"
    )
    raise BackendUnavailable(f"there is no GPU to measure here: {why}")
