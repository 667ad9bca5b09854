"""What a stopwatch and a watcher are told of passes."""

from __future__ import annotations

import pytest

from augment.timing import PassProgress, counted_steps, stopwatch, timed, watched


def work() -> None:
    with timed("view plan"):
        with counted_steps("finding exposed surfaces", 2) as advance:
            advance()
            advance()
        with timed("sky"):
            pass


def test_a_watcher_hears_which_pass_runs_and_how_far_it_has_got():
    reports = list[PassProgress]()
    with watched(reports.append), stopwatch() as seconds:
        work()
    assert reports == [
        PassProgress("view plan"),
        PassProgress("finding exposed surfaces", 0, 2),
        PassProgress("finding exposed surfaces", 1, 2),
        PassProgress("finding exposed surfaces", 2, 2),
        PassProgress("view plan"),
        PassProgress("sky"),
        PassProgress("view plan"),
    ]
    assert set(seconds) == {"view plan", "sky"}
    work()
    assert len(reports) == 7  # nobody listens any more


@pytest.mark.parametrize(
    "last", [("sky", 0), ("finding exposed surfaces", 0), ("finding exposed surfaces", 1)]
)
def test_what_a_watcher_raises_gives_up_what_runs(last):
    reports = list[PassProgress]()

    def tell(progress: PassProgress) -> None:
        reports.append(progress)
        if (progress.name, progress.num_done) == last:
            raise KeyError("nobody waits")

    with pytest.raises(KeyError, match="nobody waits"), watched(tell):
        work()
    assert (reports[-1].name, reports[-1].num_done) == last
