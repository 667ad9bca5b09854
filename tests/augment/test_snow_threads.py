"""Work on several threads: order and failures."""

from __future__ import annotations

import threading
import time

import pytest

from augment.effects.snow import height_map as in_threads
from augment.effects.snow.height_map import in_order


@pytest.fixture(autouse=True, params=[1, 4])
def threads(request, monkeypatch) -> int:
    monkeypatch.setattr(in_threads, "thread_count", lambda: request.param)
    return request.param


def test_results_are_in_the_items_order(threads: int) -> None:
    seen, told = set(), []

    def late_first(item: int) -> int:
        time.sleep(0.002 * (5 - item))
        seen.add(threading.current_thread())
        return item * item

    found = in_order(late_first, range(5), after_each=lambda: told.append(1))
    assert found == [0, 1, 4, 9, 16]
    assert len(told) == 5
    assert (threading.current_thread() in seen) == (threads == 1)
    assert in_order(late_first, []) == []
    here = [threading.current_thread()] * 3  # which alone uses a GPU
    assert in_order(lambda _: threading.current_thread(), range(3), backend="cuda") == here


def test_a_failure_is_the_callers_and_leaves_nobody_waiting() -> None:
    begun = []

    def fails(item: int) -> int:
        begun.append(item)
        return 1 // (item - 1)

    with pytest.raises(ZeroDivisionError):
        in_order(fails, range(1, 500))
    assert len(begun) < 499
