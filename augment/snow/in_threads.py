"""Work of placing snow on several threads, with the GPU left to the thread that waits for them."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from queue import SimpleQueue
from typing import TypeVar

from augment.render.backends import CUDA
from augment.render.threads import thread_count

Item = TypeVar("Item")
Result = TypeVar("Result")

_MOST_AT_ONCE = 8  # a square of cells takes up to some 300 MB while it is worked on
_ROWS = 8192  # of arrays, in one part: what is made from them stays in a core's caches


class _Worker(threading.local):
    """What a thread that works for `in_order` asks its caller to do."""

    calls: SimpleQueue[Callable[[], object]] | None = None


_worker = _Worker()


def in_order(
    function: Callable[[Item], Result],
    items: Iterable[Item],
    *,
    after_each: Callable[[], object] = lambda: None,
) -> list[Result]:
    """The function's results for each item, in the items' order, found by as many threads as
    kernels use: numpy, cv2 and kernels let other threads go on.

    after_each: called in this thread, for one item after another.
    """
    items = list(items)
    threads = min(thread_count(), len(items), _MOST_AT_ONCE)
    results = []
    if threads <= 1 or _worker.calls is not None:
        for item in items:
            results.append(function(item))
            after_each()
        return results
    calls: SimpleQueue[Callable[[], object]] = SimpleQueue()

    def work(item: Item) -> Result:
        _worker.calls = calls
        return function(item)

    with ThreadPoolExecutor(threads, thread_name_prefix="placing snow") as pool:
        found = [pool.submit(work, item) for item in items]
        for one in found:
            one.add_done_callback(lambda _: calls.put(lambda: None))  # wakes the caller
        try:
            for one in found:
                _answer_until(one, calls)
                results.append(one.result())
                after_each()
        finally:
            for one in found:
                one.cancel()  # where one failed, the others are not begun
            for one in found:
                _answer_until(one, calls)
    return results


def on_device(function: Callable[[], Result], backend: str) -> Result:
    """The function's result. Work on a GPU is done by the caller of `in_order`, one call after
    another: its thread has the device and the stream that are meant. That on the CPU is done here.
    """
    calls = _worker.calls
    if calls is None or backend != CUDA:
        return function()
    result: Future[Result] = Future()

    def call() -> None:
        try:
            result.set_result(function())
        except BaseException as error:  # for the thread that asked
            result.set_exception(error)

    calls.put(call)
    return result.result()


def slices_of(count: int) -> list[slice]:
    """Parts of `count` rows, for `in_order`."""
    return [slice(start, min(count, start + _ROWS)) for start in range(0, count, _ROWS)]


def _answer_until(one: Future[Result], calls: SimpleQueue[Callable[[], object]]) -> None:
    """Do what threads ask for until one result is there."""
    while not one.done():
        calls.get()()
