"""Work in a process of its own, whose end, whatever it is, becomes a record."""

from __future__ import annotations

import multiprocessing
import sys
import time
import traceback
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import Any

Work = Callable[..., dict[str, Any]]


def guarded(work: Work, arguments: tuple[Any, ...]) -> dict[str, Any]:
    """What the work gives, and the `seconds` it took; or what it `failed` with, whose traceback
    goes to stderr.
    """
    start = time.perf_counter()
    try:
        found = work(*arguments)
    except Exception as error:  # others wait their turn
        traceback.print_exc(file=sys.stderr)
        return {"failed": f"{type(error).__name__}: {error}"}
    return {**found, "seconds": round(time.perf_counter() - start, 2)}


def apart(work: Work, arguments: tuple[Any, ...], within_s: float) -> dict[str, Any]:
    """As `guarded`, in a fresh process; `left_out` where no time is left or it takes longer.

    work: of a module, so that the other process finds it.
    """
    if within_s <= 0:
        return {"left_out": "no time was left"}
    context = multiprocessing.get_context("spawn")
    receiving, sending = context.Pipe(duplex=False)
    process = context.Process(target=_send, args=(sending, work, arguments))
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


def _send(sending: Connection, work: Work, arguments: tuple[Any, ...]) -> None:
    sending.send(guarded(work, arguments))
