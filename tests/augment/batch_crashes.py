"""Kills batch jobs at chosen or random moments and resumes them; prints what it found as JSON.

Run as a script, in a process of its own: each job runs in a fork of it, which is quick to start
and can be killed without harm to the tests. It exits non-zero, saying why, when a promise of the
batch package does not hold.
"""

from __future__ import annotations

import gc
import json
import os
import random
import shutil
import signal
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from batch_scenes import fake_render, make_bed, make_recipe, open_fake, slow_render, tree_digest
from fork_server import keep_in_forks, start_fork_server

from augment.effects.snow import support as beds
from augment.jobs.atomic import TEMPORARY_SUFFIX
from augment.jobs.job_state import ProgressLog
from augment.jobs.layout import STATE_FOLDER
from augment.jobs.render_job import RenderJob, run_job
from recipes.flood import Flood
from recipes.snow import Snow

STRIDE = 71  # odd, so that kills come before and after calls; 1 tries every point
SYNC_POINTS = ("fsync", "replace", "unlink", "rename", "rmdir")


def main(folder: Path) -> None:
    start_fork_server("batch_scenes", "augment.jobs.worker")
    keep_in_forks()
    beds.place_snow_support = lambda *_, **__: make_bed(1.0)
    for warm in (job(folder / "warm"), snowy_job(folder / "warm-snow")):
        render(warm)()  # imports before the forks what is imported late
    gc.collect()
    gc.freeze()  # or every fork looks through all that was imported
    found = {}
    for kill in (sweep_fresh, sweep_snow, sweep_overwrite, kill_at_random, stop_a_job_with_workers):
        (folder / kill.__name__).mkdir()
        found[kill.__name__] = kill(folder / kill.__name__)
    print(json.dumps(found))


def job(folder: Path, frames: int = 2, **options) -> RenderJob:
    # Snow of no depth is not laid; the stand-in draws some all the same.
    weather = {"flood": Flood(level_m=0.3), "snow": Snow(depth_m=0)}
    recipe = make_recipe(instance=False, semantic=False, **weather)
    return RenderJob(f"fake:street?frames={frames}", [recipe], folder, **options)


def snowy_job(out: Path) -> RenderJob:
    recipe = make_recipe(instance=False, semantic=False, snow=Snow(depth_m=0.1))
    return RenderJob("fake:street?frames=1", [recipe], out)


def clear_job(folder: Path, **options) -> RenderJob:
    """The same variant folder as `job`, with other pixels."""
    recipe = make_recipe(depth="none", semantic=False, instance=False)
    return RenderJob("fake:street?frames=1", [recipe], folder, **options)


def render(what: RenderJob, renderer=fake_render) -> Callable[[], None]:
    return lambda: run_job(what, scene_loader=open_fake, renderer=renderer, progress=False)


@dataclass(frozen=True)
class Ended:
    """How a fork ended. code: -9 if killed. points: the changes of the disk it met, if it lived.

    finished: images whose entry into the journal had returned.
    """

    code: int
    points: int
    finished: int


def run_forked(work: Callable[[], None], kill_at: int | None = None) -> Ended:
    """Run `work` in a fork of this process.

    kill_at: the fork kills itself around that call that changes the disk: odd numbers just before
    it, even ones just after.
    """
    reader, writer = os.pipe()
    child = os.fork()
    if child == 0:
        count = _count_sync_points(kill_at)
        _tell_of_finished(writer)
        code = 1
        try:
            work()
            code = 0
        finally:
            os.write(writer, b"%d" % count())
            os._exit(code)
    os.close(writer)
    _, status = os.waitpid(child, 0)
    told = os.read(reader, 1 << 16)
    os.close(reader)
    points = told.lstrip(b".")
    return Ended(os.waitstatus_to_exitcode(status), int(points or 0), told.count(b"."))


def _tell_of_finished(pipe: int) -> None:
    append = ProgressLog.append

    def told(progress_log: ProgressLog, row: dict) -> None:
        append(progress_log, row)
        os.write(pipe, b"." if row["status"] == "ok" else b"")

    ProgressLog.append = told


def _count_sync_points(kill_at: int | None) -> Callable[[], int]:
    met = [0]

    def watched(call):
        def wrapper(*arguments, **options):
            met[0] += 1
            here = kill_at is not None and met[0] >= (kill_at + 1) // 2
            if here and kill_at % 2 == 1:
                os.kill(os.getpid(), signal.SIGKILL)
            result = call(*arguments, **options)
            if here:
                os.kill(os.getpid(), signal.SIGKILL)
            return result

        return wrapper

    for name in SYNC_POINTS:
        setattr(os, name, watched(getattr(os, name)))
    return lambda: met[0]


def sweep_fresh(folder: Path) -> dict[str, int]:
    """Kill a first run around every few changes of the disk; check, resume, compare."""
    uninterrupted = run_forked(render(job(folder / "whole")))
    require(uninterrupted.code == 0, "the uninterrupted run failed")
    whole = tree_digest(folder / "whole")
    kills, last = 0, 2 * uninterrupted.points
    # The end, where journals become the manifest, is tried more closely.
    for kill_at in [*range(1, last - 30, STRIDE), *range(last - 30, last, 11)]:
        out = folder / "killed"
        ended = run_forked(render(job(out)), kill_at)
        # Threads meet the points in another order each time, so the last may not be reached.
        require(ended.code == -signal.SIGKILL or kill_at > last - 8, f"{kill_at}: {ended}")
        kills += ended.code == -signal.SIGKILL
        check_only_whole_files(out, whole, f"killed at {kill_at}")
        resume_and_compare(job(out), out, whole, ended.finished, f"killed at {kill_at}")
        shutil.rmtree(out)
    return {"kills": kills}


def sweep_snow(folder: Path) -> dict[str, int]:
    """Kill a run while it stores where snow can lie, and while it writes the first files."""
    require(run_forked(render(snowy_job(folder / "whole"))).code == 0, "the snowy run failed")
    # The state's own files go by what they hold, and a job's do not tell of it.
    whole = tree_digest(folder / "whole" / "street")
    kills = 0
    # Just before each of the first calls: after one, nothing differs until the next is at hand.
    for kill_at in range(1, 25, 6):
        out = folder / "killed"
        kills += run_forked(render(snowy_job(out)), kill_at).code == -signal.SIGKILL
        check_only_whole_files(out / "street", whole, f"killed at {kill_at}")
        again = run_forked(render(snowy_job(out)))
        require(again.code == 0, f"killed at {kill_at}: the snowy job cannot go on")
        require(tree_digest(out / "street") == whole, f"killed at {kill_at}: the tree differs")
        left = sorted(path.name[:5] for path in (out / STATE_FOLDER).iterdir())
        require(left == ["lock", "snow-"], f"killed at {kill_at}: left behind are {left}")
        shutil.rmtree(out)
    return {"kills": kills}


def sweep_overwrite(folder: Path) -> dict[str, int]:
    """Kill a run that overwrites an older variant: the old job or the new one must go on."""
    run_forked(render(clear_job(folder / "old")))
    run_forked(render(job(folder / "whole", frames=1)))
    old, whole = tree_digest(folder / "old"), tree_digest(folder / "whole")
    kills = 0
    # All that an overwriting run does before it renders is within its first 30 changes.
    for kill_at in [*range(1, 60, 13), 100]:
        out = folder / "killed"
        shutil.copytree(folder / "old", out)
        ended = run_forked(render(job(out, frames=1, overwrite=True)), kill_at)
        kills += ended.code == -signal.SIGKILL
        if run_forked(render(job(out, frames=1))).code == 0:
            require(tree_digest(out) == whole, f"killed at {kill_at}: the new tree differs")
        else:  # killed before the old content was given up
            again = run_forked(render(clear_job(out)))
            require(again.code == 0, f"killed at {kill_at}: neither job can go on")
            require(tree_digest(out) == old, f"killed at {kill_at}: the old tree differs")
        shutil.rmtree(out)
    return {"kills": kills}


def kill_at_random(folder: Path) -> dict[str, int]:
    """Kill one job again and again at random times of its own until it gets through.

    Times of the processor, not of a clock: on a machine that is busy it would be killed for ever.
    """
    run_forked(render(job(folder / "whole", frames=6)))
    whole = tree_digest(folder / "whole")
    out, rng, kills = folder / "killed", random.Random(5), 0
    while True:
        limit_s = rng.uniform(0.01, 0.03 + 0.005 * kills)  # it gets through on any machine
        child = os.fork()
        if child == 0:
            signal.setitimer(signal.ITIMER_PROF, limit_s)
            render(job(out, frames=6))()
            os._exit(0)
        _, status = os.waitpid(child, 0)
        if status == 0:
            break
        require(os.waitstatus_to_exitcode(status) == -signal.SIGPROF, f"at random: {status}")
        kills += 1
        check_only_whole_files(out, whole, f"kill {kills}")
    require(tree_digest(out) == whole, "the resumed tree differs")
    return {"kills": kills}


def stop_a_job_with_workers(folder: Path) -> dict[str, int]:
    """Press Ctrl-C on a job with two workers, run it again, kill its process alone, resume."""
    run_forked(render(job(folder / "whole", frames=16)))
    out, printed = folder / "stopped", folder / "stderr"
    child = start_with_workers(out, printed)
    wait_for_finished(out, 3)
    os.killpg(child, signal.SIGINT)  # as a terminal does: to the workers too
    _, status = os.waitpid(child, 0)
    said = printed.read_text()
    require(os.waitstatus_to_exitcode(status) == 130, f"interrupted: {status}, {said}")
    require(said.startswith("stopped with") and said.count("\n") == 1, f"interrupted: {said}")
    require((out / "manifest.parquet").exists(), "interrupted: no manifest")

    child = start_with_workers(out, printed)
    wait_for_finished(out, 3)
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    finished = count_finished(out)
    whole = tree_digest(folder / "whole")
    resume_and_compare(job(out, frames=16), out, whole, finished, "parent killed")
    return {"finished": finished}


def start_with_workers(out: Path, printed: Path) -> int:
    """A job with two workers in a process group of its own; what it prints goes to a file."""
    child = os.fork()
    if child == 0:
        os.setpgid(0, 0)
        with printed.open("w") as file:
            os.dup2(file.fileno(), 2)
        try:
            render(job(out, frames=16, workers=2), slow_render)()
        except KeyboardInterrupt as stopped:
            os.write(2, f"{stopped}\n".encode())
            os._exit(130)
        os._exit(0)
    return child


def wait_for_finished(out: Path, count: int) -> None:
    while count_finished(out) < count:
        time.sleep(0.01)


def check_only_whole_files(out: Path, whole: dict[str, str], when: str) -> None:
    """Every file under a final name is the one of the uninterrupted run."""
    for name, digest in tree_digest(out).items():
        hidden = name.startswith(STATE_FOLDER) or name.endswith(TEMPORARY_SUFFIX)
        require(hidden or whole.get(name) == digest, f"{when}: {name} is not the whole file")


def resume_and_compare(
    what: RenderJob, out: Path, whole: dict[str, str], finished: int, when: str
) -> None:
    """Finish the job; nothing finished is rendered again, and the files are the same."""

    def work() -> None:
        result = run_job(what, scene_loader=open_fake, renderer=fake_render, progress=False)
        # More than was told: killed between the journal's line and the telling.
        require(result.skipped >= finished, f"{when}: {finished} were finished, got {result}")

    ended = run_forked(work)
    require(ended.code == 0, f"{when}: resuming failed with exit code {ended.code}")
    after = tree_digest(out)
    different = {k for k in whole.keys() | after.keys() if whole.get(k) != after.get(k)}
    require(not different, f"{when}: after resuming these differ: {sorted(different)}")


def count_finished(out: Path) -> int:
    """Images that a journal lists, read without the code under test."""
    progress_logs = list((out / STATE_FOLDER).rglob("*.jsonl"))
    return sum(progress_log.read_bytes().count(b"\n") - 1 for progress_log in progress_logs)


def require(holds: bool, message: str) -> None:
    if not holds:
        sys.exit(message)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
