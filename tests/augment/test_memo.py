"""What is worked out once for an owner: within its bytes, made once by threads, handed over."""

from __future__ import annotations

import gc
import pickle
import threading
import time
import weakref
from dataclasses import dataclass

import numpy as np
import pytest
import torch

from augment.memo import SceneMemo, memo_of


class Owner:
    """Hashed by identity."""


@dataclass(frozen=True)
class InFile:
    number: int

    def load(self) -> list[int]:
        return [self.number]


def test_a_value_is_made_once_and_forgotten_when_too_many_bytes_came_after_it():
    memo, made = SceneMemo(max_bytes=400), []  # for one more beside the largest

    def get(key: str) -> np.ndarray:
        return memo.get((key,), lambda: made.append(key) or np.zeros(100, np.float32))

    assert get("a") is get("a")
    get("b")
    get("a")  # used again: "b" is the one unused for longest
    get("c")
    get("a"), get("c")
    assert made == ["a", "b", "c"]
    get("b")
    assert made == ["a", "b", "c", "b"]


def test_a_value_beyond_the_limit_drives_out_no_other_and_none_drives_it_out():
    memo, made = SceneMemo(max_bytes=100), []
    for _ in range(3):
        for key, count in (("large", 10_000), ("small", 10), ("empty", 0)):
            memo.get((key,), lambda k=key, n=count: made.append(k) or np.zeros(n, np.float32))
    assert made == ["large", "small", "empty"]


def test_a_value_that_could_not_be_made_is_asked_for_again():
    memo = SceneMemo()
    with pytest.raises(ZeroDivisionError):
        memo.get(("key",), lambda: 1 // 0)
    assert memo.get(("key",), lambda: 1) == 1


def test_threads_wait_for_the_one_that_makes_a_value():
    memo, made = SceneMemo(), []

    def make() -> object:
        time.sleep(0.05)
        made.append(1)
        return object()

    found = []
    threads = [
        threading.Thread(target=lambda: found.append(memo.get(("slow",), make))) for _ in range(4)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(made) == 1 and len({id(value) for value in found}) == 1


def test_what_is_shared_is_found_by_another_process_memo():
    here, there = SceneMemo(), SceneMemo(max_bytes=1)
    here.put(("own",), 1)
    here.put(("plain",), 2, shared=True)
    here.put(("stored",), InFile(3), shared=True)
    there.update(pickle.loads(pickle.dumps(here.shared())))
    assert there.known(("plain",)) and not there.known(("own",))

    def refuse() -> None:
        raise AssertionError("it was handed over")

    assert there.get(("plain",), refuse) == 2
    first = there.get(("stored",), refuse)
    assert first == [3] and here.get(("stored",), refuse) == [3]
    there.get(("other",), lambda: torch.zeros(1000))  # what is shared is found again
    assert there.get(("stored",), refuse) == [3]


def test_a_memo_goes_with_its_owner():
    owner = Owner()
    memo_of(owner).put(("value",), 1)
    assert memo_of(owner) is memo_of(owner)
    gone = weakref.ref(memo_of(owner))
    del owner
    gc.collect()
    assert gone() is None
