"""What commands write besides their result: notes on stderr, facts as JSON; and where they may."""

from __future__ import annotations

import contextlib
import json
import logging
import re
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from functools import cache
from pathlib import Path
from typing import Annotated, Any

from tqdm import tqdm
from tyro.conf import arg

MAX_FAILURES = 20  # that are printed
SILENT_S = 2.0
JsonFile = Annotated[Path | None, arg(name="json", metavar="FILE")]


def print_note(text: str) -> None:
    """Print to stderr, above the progress bars, beside the result on stdout."""
    tqdm.write(text, file=sys.stderr)


class NoteHandler(logging.Handler):
    """Prints log records as notes."""

    def emit(self, record: logging.LogRecord) -> None:
        print_note(self.format(record))


def duration_text(seconds: float) -> str:
    """A time in a unit that suits it."""
    if seconds < 90:
        return f"{seconds:.1f} s"
    if seconds < 5400:
        return f"{seconds / 60:.0f} min"
    return f"{seconds / 3600:.1f} h"


def print_images(result: Any, took: str) -> None:
    """Print what became of a job's images: counts on stdout, the first failures as notes."""
    rate = result.written / result.seconds if result.seconds else 0.0
    print(
        f"{result.written} images written, {result.skipped} already there, {result.failed} failed; "
        f"{took}, {rate:.1f} images/s"
    )
    for failure in result.failures[:MAX_FAILURES]:
        print_note(f"failed: {failure}")
    if (more := len(result.failures) - MAX_FAILURES) > 0:
        print_note(f"... and {more} more; the manifest has them all")


@contextlib.contextmanager
def compiling_noted(modules: Sequence[str] = (), *, on_gpu: bool = False) -> Iterator[None]:
    """Have other processes compile kernels from the first one on, and say how long it took.

    That kernels are compiled is logged by augment.render.cpu.jit; what lies in numba's cache is
    loaded in silence. Triton does not tell beforehand: on a GPU, whatever takes longer than
    SILENT_S counts as compiling, and is said here.

    Args:
        modules: beginnings of names of modules, whose kernels the other processes compile.
        on_gpu: if True, Triton's kernels are meant.
    """
    from numba.core.event import Event, TimingListener, install_listener

    from augment.render.compile_ahead import compile_ahead

    exit_stack = ExitStack()
    start_s = time.perf_counter()

    @cache
    def say_once() -> float:
        if on_gpu:
            print_note("compiling kernels (once; kept for the next run) ...")
        if modules:
            exit_stack.enter_context(compile_ahead(modules))
        return time.perf_counter()

    class Announcer(TimingListener):
        def on_start(self, event: Event) -> None:
            say_once()
            super().on_start(event)

    timer = threading.Timer(SILENT_S, say_once)
    timer.daemon = True
    if on_gpu:
        timer.start()
    try:
        with exit_stack, install_listener("numba:compile", Announcer()):
            yield
    finally:
        timer.cancel()
    if say_once.cache_info().misses:
        seconds = time.perf_counter() - (start_s if on_gpu else say_once())
        print_note(f"kernels compiled after {seconds:.1f} s")


def fill(template: str, **facts: Any) -> str:
    """Fill one of tools/templates and return the text."""
    from jinja2 import Environment, PackageLoader, StrictUndefined

    loader = PackageLoader("tools")
    environment = Environment(
        loader=loader, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    return environment.get_template(template).render(facts).rstrip("\n")


def write_json(path: Path | None, facts: dict[str, Any], *, say: bool = True) -> None:
    """Write facts to a file, if one is named, and by default say so.

    Raises:
        OutputError: the file cannot be written.
    """
    if path is None:
        return
    from augment.errors import OutputError

    try:
        path.write_text(json.dumps(facts, indent=2) + "\n")
    except OSError as error:
        raise OutputError(f"cannot write {path}: {error.strerror}") from error
    if say:
        print_note(f"wrote {path}")


LABELS_OF_STORES = (
    "copy the output here, images too (as by `aws s3 sync URI OUT`), then `climategs labels OUT`"
)


def check_local(out: Path, instead: str) -> Path:
    """Refuse `s3://bucket/path` where a folder is meant: as a path it would be a folder `s3:` here.

    instead: what to do, for the message.

    Raises:
        OutputError: the path begins with a scheme.
    """
    from augment.errors import OutputError

    # Path makes one slash of two.
    if re.match(r"[A-Za-z][A-Za-z0-9+.-]+:/", str(out)):
        raise OutputError(
            f"{out} is not on this machine, and this command needs a folder that is; {instead}"
        )
    return out


def check_scene_out(out: Path, *, may_replace: bool, why: str = "") -> None:
    """Refuse an OUT that holds anything but a scene that may be replaced, before hours are spent.

    Raises:
        OutputError: it is something else, or a scene that may not; why: for that message.
    """
    from augment.errors import OutputError
    from augment.files.scene_file import is_scene_folder

    if not out.exists() or (out.is_dir() and not any(out.iterdir())):
        return
    if not is_scene_folder(out):
        raise OutputError(f"{out} holds something else than a scene: choose another --out")
    if not may_replace:
        raise OutputError(
            f"{out} holds a scene{why}: choose another --out, or replace it with --overwrite"
        )


def path_beside(out: Path, ending: str) -> Path:
    """Return OUT with an ending after its name.

    Raises:
        OutputError: OUT has no name.
    """
    from augment.errors import OutputError

    out = out.resolve()
    if not out.name:
        raise OutputError(f"--out {out} is the file system's root: name a folder below it")
    return out.with_name(out.name + ending)
