"""How many steps fit into a time: learning rates that decay need to know before the first one."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass

from tools.fit_parts import Fitter

NOMINAL_STEPS = 5000  # the run that the throw-away trainer believes to be the beginning of
UNTIMED = 3  # steps that compile kernels and touch new memory
LEAST, MOST, MAX_S = 8, 40, 10.0
RESERVE = 0.05  # of the time, for evaluations and checkpoints
MIN_PART = 0.2  # of the time, for steps, however long reading takes
# A step's time over a whole run, as a multiple of its first steps' where splats are added.
GROWTH = 1.25


@dataclass(frozen=True)
class StepEstimate:
    """steps: that fill the time. step_s: median seconds of a first step, without its image's."""

    steps: int
    step_s: float


def estimate_steps(
    trainer: Callable[[int], Fitter],
    budget_s: float,
    *,
    views: int,
    grows: bool,
    clock: Callable[[], float] = time.perf_counter,
) -> StepEstimate:
    """Times a trainer that is thrown away. trainer: makes one for a number of steps. views: that
    are learnt from; each costs more the first time, when its image is read.

    What is measured here is not taken off the time to optimise.
    """
    fitter = trainer(NOMINAL_STEPS)
    for _ in range(UNTIMED):
        fitter.run_step()
    loads: list[float] = []
    others: list[float] = []
    begun = clock()
    while len(others) < LEAST or (len(others) < MOST and clock() - begun < MAX_S):
        before = clock()
        load_s = fitter.run_step().stage_s.get("load", 0.0)
        loads.append(load_s)
        others.append(clock() - before - load_s)
    step_s = max(statistics.median(others), 1e-6)
    left_s = max(budget_s * (1 - RESERVE) - views * statistics.median(loads), MIN_PART * budget_s)
    steps = int(left_s / (step_s * (GROWTH if grows else 1.0)))
    return StepEstimate(max(1, steps if steps < 100 else steps // 50 * 50), step_s)
