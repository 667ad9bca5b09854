"""How many steps fit into a time: learning rates that decay need to know before the first one."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass

from tools.fit_parts import Fitter

NOMINAL_STEPS = 5000  # the run that the throw-away trainer believes to be the beginning of
UNTIMED = 3  # steps that compile kernels and touch new memory
LEAST, MOST, MOST_S = 8, 40, 10.0
RESERVE = 0.05  # of the time, for evaluations and checkpoints
# A step's time over a whole run, as a multiple of its first steps' where splats are added.
GROWTH = 1.25


@dataclass(frozen=True)
class StepEstimate:
    """steps: that fill the time. step_s: median seconds of a step at the start."""

    steps: int
    step_s: float


def estimate_steps(
    trainer: Callable[[int], Fitter],
    budget_s: float,
    *,
    grows: bool,
    clock: Callable[[], float] = time.perf_counter,
) -> StepEstimate:
    """Times a trainer that is thrown away. trainer: makes one for a number of steps.

    What is measured here is not taken off the time to optimise.
    """
    fitter = trainer(NOMINAL_STEPS)
    for _ in range(UNTIMED):
        fitter.run_step()
    seconds: list[float] = []
    while len(seconds) < LEAST or (len(seconds) < MOST and sum(seconds) < MOST_S):
        begun = clock()
        fitter.run_step()
        seconds.append(clock() - begun)
    step_s = max(statistics.median(seconds), 1e-6)
    steps = int(budget_s * (1 - RESERVE) / (step_s * (GROWTH if grows else 1.0)))
    return StepEstimate(max(1, steps if steps < 100 else steps // 50 * 50), step_s)
