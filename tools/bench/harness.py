"""The tools of all subjects of `climategs bench`: paired rounds, memory, processes, figures.

Cases take turns within a round, and every other round has the opposite order, so that a disturbance
of the machine affects all cases alike. Ratios are taken round by round. The figures of a subject
have one JSON form (`figures`), from which tables are printed or written as Markdown.
"""

from __future__ import annotations

import contextlib
import ctypes
import dataclasses
import gc
import importlib.metadata
import math
import multiprocessing
import os
import platform
import re
import sys
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tqdm import tqdm

Cell = str | float | int | None  # A cell of a table; None is empty.
Action = Callable[[], object]  # Work that is timed, or whose memory is measured.
Figures = dict[str, Any]  # Measured values by name, which can be written as JSON.
# The error of a pixel above which it lies on the other side of a cut-off in the two pictures.
FLIP = 1e-3
# The packages whose versions are reported.
PACKAGES = ("climategs", "numpy", "torch", "triton", "numba", "llvmlite", "tbb", "gsplat")


# ---- figures and their one JSON form ------------------------------------------------------------


@dataclass(frozen=True)
class Table:
    """Figures as people read them."""

    title: str
    """The line above the table."""
    columns: Sequence[str]
    """The headings of the columns."""
    rows: Sequence[Sequence[Cell]]
    """The cells of every row, as many as there are columns."""
    note: str = ""
    """The line below the table."""


def figures(name: str, tables: Sequence[Table], *, machine: Figures, **facts: Any) -> Figures:
    """Return the JSON form of a subject's figures.

    Args:
        name: The name of the subject.
        tables: The tables.
        machine: The `machine_facts()` from before the subject began.
        facts: Further figures by name.
    """
    return {
        "bench": name,
        "machine": machine,
        "load_after": load_average(),
        "tables": [
            {**dataclasses.asdict(t), "columns": [*t.columns], "rows": [[*row] for row in t.rows]}
            for t in tables
        ],
        "facts": facts,
    }


def print_figures(result: Figures) -> None:
    """Print the machine and all tables. Text is left-aligned, numbers are right-aligned."""
    print(f"{result['bench']}: {machine_line(result)}")
    for table in result["tables"]:
        print(f"\n{table['title']}")
        lines = [table["columns"], *([format_cell(c) for c in row] for row in table["rows"])]
        widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
        numeric = _numeric_columns(table)
        for line in lines:
            cells = zip(line, widths, numeric, strict=True)
            print("  ".join(c.rjust(w) if n else c.ljust(w) for c, w, n in cells).rstrip())
        if table["note"]:
            print(f"  {table['note']}")


def markdown(result: Figures) -> str:
    """Return the machine and all tables as Markdown, each table under its title."""
    lines = [f"{machine_line(result)}."]
    for table in result["tables"]:
        marks = ["---:" if numeric else "---" for numeric in _numeric_columns(table)]
        rows = [[format_cell(cell) for cell in row] for row in table["rows"]]
        lines += ["", f"**{table['title']}**", "", *markdown_lines(table["columns"], marks, rows)]
        lines += ["", table["note"]] if table["note"] else []
    return "\n".join(lines) + "\n"


def markdown_lines(
    header: Sequence[str], marks: Sequence[str], rows: Sequence[Sequence[str]]
) -> list[str]:
    """Return the lines of a Markdown table. marks: alignment of every column, such as `---:`."""
    return [f"| {' | '.join(line)} |" for line in (header, marks, *rows)]


def replace_marked(text: str, start: str, end: str, content: str) -> str:
    """Return a document with other lines between two markers.

    Args:
        text: The document.
        start: The line of the first marker.
        end: The line of the second marker.
        content: The new lines between them.

    Raises:
        ValueError: the document lacks a marker.
    """
    text_before, start_mark, marked_text = text.partition(start)
    _, end_mark, text_after = marked_text.partition(end)
    if not (start_mark and end_mark):
        raise ValueError(f"the document has no '{start}' with '{end}' after it")
    return f"{text_before}{start}\n\n{content.strip()}\n\n{end}{text_after}"


def format_cell(cell: Cell) -> str:
    """Return a cell's text: numbers to 3 significant digits, without exponent from 0.001 on."""
    if cell is None:
        return ""
    if isinstance(cell, bool):
        return "yes" if cell else "NO"
    if not isinstance(cell, float):
        return cell if isinstance(cell, str) else f"{cell:,}"
    if cell == 0 or not math.isfinite(cell):
        return f"{cell:g}"
    if abs(cell) < 1e-3:
        return f"{cell:.1e}"
    return f"{cell:,.{max(0, 2 - math.floor(math.log10(abs(cell))))}f}"


def _numeric_columns(table: Mapping[str, Any]) -> list[bool]:
    """Return for every column of a table True if it has no text."""
    columns = zip(*table["rows"], strict=True) if table["rows"] else [()] * len(table["columns"])
    return [not any(isinstance(cell, str) for cell in column) for column in columns]


# ---- time ---------------------------------------------------------------------------------------


class WallClock:
    """The host's clock, for work that is done when its call returns."""

    def mark(self) -> Any:
        """Return a mark of the time now."""
        return time.perf_counter()

    def wait(self) -> None:
        """Wait until all work is done."""

    def seconds(self, first: Any, then: Any) -> float:
        """Return the seconds between two marks."""
        return then - first


class EventClock(WallClock):
    """The GPU's clock. Its marks are events in the GPU's queue, so that marking never waits."""

    def mark(self) -> torch.cuda.Event:
        event = torch.cuda.Event(enable_timing=True)
        event.record()
        return event

    def wait(self) -> None:
        torch.cuda.synchronize()

    def seconds(self, first: torch.cuda.Event, then: torch.cuda.Event) -> float:
        return first.elapsed_time(then) / 1e3


def rounds(
    cases: Mapping[str, Action], repeats: int, *, warm_up: int = 1, clock: WallClock | None = None
) -> dict[str, list[float]]:
    """Run cases in turns and return the seconds of each, one number a round.

    Args:
        cases: The actions by name.
        repeats: The number of rounds that count.
        warm_up: The number of rounds before the first that counts.
        clock: The clock; None for the host's.

    Raises:
        ValueError: there is no case, or no round.
    """
    if repeats < 1 or not cases:
        raise ValueError(f"need repeats >= 1 and a case; got {repeats} and {list(cases)}")
    clock = clock or WallClock()
    marks: dict[str, list[tuple[Any, Any]]] = {name: [] for name in cases}
    for repeat in tqdm(range(warm_up + repeats), unit="round", leave=False):
        if repeat == warm_up:
            clock.wait()
        for name in alternate_order(cases, repeat):
            start = clock.mark()
            cases[name]()
            marks[name].append((start, clock.mark()))
    clock.wait()
    return {
        name: [clock.seconds(*p) for p in case_marks[warm_up:]]
        for name, case_marks in marks.items()
    }


def alternate_order(names: Mapping[str, Any], repeat: int) -> list[str]:
    """Return the names in order, and every other time in the opposite order."""
    return [*names] if repeat % 2 else [*names][::-1]


def spread(values: Sequence[float]) -> dict[str, float]:
    """Return median, minimum and 90 % quantile, in the order in which tables list them."""
    low, middle, high = np.quantile(values, [0, 0.5, 0.9])
    return {"median": float(middle), "min": float(low), "p90": float(high)}


def spread_ms(seconds: Sequence[float]) -> dict[str, float]:
    """Return the spread of times in milliseconds."""
    return spread([1e3 * s for s in seconds])


def spread_ratio(over: Sequence[float], under: Sequence[float]) -> dict[str, float]:
    """Return the spread of ratios, pair by pair."""
    return spread([o / u for o, u in zip(over, under, strict=True)])


def median_ms(seconds: Sequence[float]) -> float:
    """Return the median of times in milliseconds."""
    return 1e3 * float(np.median(seconds))


def image_difference(rgb: torch.Tensor, expected: torch.Tensor) -> dict[str, float]:
    """Compare two pictures, rgb [H, W, 3], by each pixel's worst channel.

    Returns:
        The 99.9 % quantile of the error, its maximum, the number of pixels whose error is above
        FLIP, and the number of pixels.
    """
    error = (rgb.detach().cpu() - expected.detach().cpu()).abs().amax(-1).numpy()
    return {
        "p999": float(np.quantile(error, 0.999)),
        "max": float(error.max()),
        "flipped": int((error > FLIP).sum()),
        "pixels": int(error.size),
    }


# ---- memory and processes -----------------------------------------------------------------------

_STATUS = Path("/proc/self/status")  # The file with the sizes of this process.
RESET_PEAK = Path("/proc/self/clear_refs")  # The file that resets the peak of resident memory.


def status_mib(field: str) -> float:
    """Return a size of this process from /proc in MiB, such as VmRSS."""
    match = re.search(rf"^{field}:\s*(\d+)", _STATUS.read_text(), re.MULTILINE)
    if match is None:
        raise RuntimeError(f"{_STATUS} has no {field}")
    return int(match[1]) / 1024


def begin_peak() -> float | None:
    """Start to count `VmHWM` anew; return the resident MiB now, or None without /proc.

    Freed heap is returned to the system first, of which glibc would keep up to 64 MiB.
    """
    if not RESET_PEAK.is_file():
        return None
    gc.collect()
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)
    before = status_mib("VmRSS")
    RESET_PEAK.write_text("5")
    return before


def extra_mib(action: Action) -> float | None:
    """Return the peak memory of an action above the memory before it, MiB; None without /proc.

    The action's result counts, too.
    """
    before = begin_peak()
    if before is None:
        return None
    action_result = action()
    peak_mib = status_mib("VmHWM")
    del action_result  # alive until the peak was read
    return peak_mib - before


def peak_mib_in_subprocess(
    work: Callable[..., Action], arguments: tuple[Any, ...], within_s: float = 600
) -> float | None:
    """Return `extra_mib` of the action that `work` returns, measured in a fresh process.

    A process that has rendered before would still hold scratch memory.

    Raises:
        RuntimeError: the process failed or took too long.
    """
    subprocess_figures = run_in_subprocess(_extra_mib_of, (work, arguments), within_s)
    if "mib" not in subprocess_figures:
        raise RuntimeError(
            f"measuring the memory of {work.__name__}{arguments} failed: {subprocess_figures}"
        )
    return subprocess_figures["mib"]


def _extra_mib_of(work: Callable[..., Action], arguments: tuple[Any, ...]) -> Figures:
    return {"mib": extra_mib(work(*arguments))}


def run_and_time(work: Callable[..., Figures], arguments: tuple[Any, ...]) -> Figures:
    """Return the figures of the work with the `seconds` that it took, or its error as `failed`."""
    start = time.perf_counter()
    try:
        work_figures = work(*arguments)
    except Exception as error:  # the other sections must still run
        traceback.print_exc(file=sys.stderr)
        return {"failed": f"{type(error).__name__}: {error}"}
    return {**work_figures, "seconds": round(time.perf_counter() - start, 2)}


def run_in_subprocess(
    work: Callable[..., Figures], arguments: tuple[Any, ...], within_s: float
) -> Figures:
    """Run `run_and_time` in a fresh process.

    Args:
        work: A function of a module, so that the other process can import it.
        arguments: Its arguments.
        within_s: The time after which the process is stopped, seconds.

    Returns:
        The work's figures; `left_out` with the reason if there was no time, or too little.
    """
    if within_s <= 0:
        return {"left_out": "no time was left"}
    context = multiprocessing.get_context("spawn")
    receiving, sending = context.Pipe(duplex=False)
    process = context.Process(target=_send_result, args=(sending, work, arguments))
    process.start()
    sending.close()
    try:
        if not receiving.poll(within_s):
            return {"left_out": f"it was stopped after {within_s:.0f} s"}
        return receiving.recv()
    except EOFError:
        process.join()
        return {"failed": f"its process ended with code {process.exitcode}"}
    finally:
        process.kill()
        process.join()


def _send_result(
    sending: Connection, work: Callable[..., Figures], arguments: tuple[Any, ...]
) -> None:
    sending.send(run_and_time(work, arguments))


# ---- the machine --------------------------------------------------------------------------------


def machine_facts() -> Figures:
    """Return facts of this machine and process; start numba's thread pool if it is not running.

    The fact `load` is the mean number of processes that ran or waited over the last minute. More
    than a few tenths disturb measurements.
    """
    from augment.render.threads import num_kernel_threads, select_thread_pool

    flags = (_proc_field("/proc/cpuinfo", "flags") or "").split()
    total = _proc_field("/proc/meminfo", "MemTotal")
    return {
        "processor": _proc_field("/proc/cpuinfo", "model name") or platform.processor(),
        "cores": len(os.sched_getaffinity(0)) if sys.platform == "linux" else os.cpu_count(),
        "simd": [name for name in ("sse4_2", "avx", "avx2", "fma", "avx512f") if name in flags],
        "memory_gib": None if total is None else round(int(total.split()[0]) / 2**20, 1),
        "thread_pool": select_thread_pool(),  # before anything starts a pool of numba's choice
        "threads": num_kernel_threads(),
        "torch_threads": torch.get_num_threads(),
        "load": load_average(),
        "platform": platform.platform(),
        "python": platform.python_version(),
        "versions": {name: version for name in PACKAGES if (version := version_of(name))},
    }


def load_average() -> float | None:
    """Return the processes that ran or waited over the last minute; None if unknown."""
    return round(os.getloadavg()[0], 2) if hasattr(os, "getloadavg") else None


def version_of(package: str) -> str | None:
    """Return the version of an installed package; None if it is not installed."""
    with contextlib.suppress(importlib.metadata.PackageNotFoundError):
        return importlib.metadata.version(package)


def machine_line(result: Mapping[str, Any]) -> str:
    """Return a line about the machine, its load and, where the facts have one, its GPU."""
    machine = result["machine"]
    gpu = result.get("facts", result).get("gpu")
    return (f"{gpu['name']}; " if gpu else "") + (
        f"{machine['processor']}, {machine['cores']} cores, {machine['threads']} threads; "
        f"load {machine['load']} before, {result['load_after']} after"
    )


def _proc_field(path: str, name: str) -> str | None:
    with contextlib.suppress(OSError):
        match = re.search(rf"^{name}\s*:\s*(.*)$", Path(path).read_text(), re.MULTILINE)
        return match[1] if match else None


# ---- the GPU ------------------------------------------------------------------------------------


def check_gpu() -> None:
    """Check that there is a GPU to measure.

    Raises:
        BackendUnavailable: there is none.
    """
    from augment.errors import BackendUnavailable
    from augment.render.backends import available_backends
    from augment.render.cuda.runtime import has_gpu

    if not has_gpu():
        why = available_backends()["cuda"] or (
            f"torch {torch.__version__} sees no GPU, or TRITON_INTERPRET is set"
        )
        raise BackendUnavailable(f"there is no GPU to measure here: {why}")


def gpu_facts() -> Figures | None:
    """Return facts of the current GPU; None where torch sees none."""
    if not torch.cuda.is_available():
        return None
    properties = torch.cuda.get_device_properties(torch.cuda.current_device())
    return {
        "name": properties.name,
        "memory_gib": round(properties.total_memory / 2**30, 1),
        "processors": properties.multi_processor_count,
        "capability": f"{properties.major}.{properties.minor}",
        "cuda": torch.version.cuda,
        "triton": version_of("triton"),
    }


def peak_gpu_mib(action: Action) -> tuple[float, float] | tuple[None, None]:
    """Return the peak MiB of tensors on the GPU during an action: in all, and above those before.

    Free memory that torch keeps is not counted. Both are None without a GPU.
    """
    if not torch.cuda.is_available():
        return None, None
    gc.collect()
    torch.cuda.synchronize()
    before = torch.cuda.memory_allocated()
    torch.cuda.empty_cache()
    torch.cuda.reset_peak_memory_stats()
    action_result = action()
    torch.cuda.synchronize()
    peak_bytes = torch.cuda.max_memory_allocated()
    del action_result
    return peak_bytes / 2**20, (peak_bytes - before) / 2**20
