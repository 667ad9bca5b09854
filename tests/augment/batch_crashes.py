"""Kills batch jobs at chosen or random moments and resumes them; prints what it found as JSON.

Run as a script, in a process of its own: each job runs in a fork of it, which is quick to start
and can be killed without harm to the tests. It exits non-zero, saying why, when a promise of the
batch package does not hold.
"""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path

from batch_scenes import fake_render, make_recipe, open_fake, slow_render, tree_digest

from augment.batch.atomic import TEMPORARY_SUFFIX
from augment.batch.job import RenderJob, run_job
from augment.batch.label_files import lidar_bytes
from augment.batch.layout import STATE_FOLDER

STRIDE = 11  # odd, so that kills come before and after calls; 1 tries every point
SYNC_POINTS = ("fsync", "replace", "unlink", "rename", "rmdir")


def main(folder: Path) -> None:
    lidar_bytes(open_fake("fake:warm").labels.lidar(0))  # loads the Parquet code before the forks
    found = {}
    for kill in (sweep_fresh, sweep_overwrite, kill_at_random, kill_parent_of_workers):
        (folder / kill.__name__).mkdir()
        found[kill.__name__] = kill(folder / kill.__name__)
    print(json.dumps(found))


def job(folder: Path, frames: int = 2, **options) -> RenderJob:
    recipe = make_recipe(instance=False, semantic=False)
    return RenderJob(f"fake:street?frames={frames}", [recipe], folder, **options)


def clear_job(folder: Path, **options) -> RenderJob:
    """The same variant folder as `job`, with other pixels."""
    recipe = make_recipe(depth="none", semantic=False, instance=False)
    return RenderJob("fake:street?frames=1", [recipe], folder, **options)


def render(what: RenderJob, renderer=fake_render) -> Callable[[], None]:
    return lambda: run_job(what, scene_loader=open_fake, renderer=renderer, progress=False)


def run_forked(work: Callable[[], None], kill_at: int | None = None) -> tuple[int, int]:
    """Run `work` in a fork; returns its exit code (-9 if killed) and how many sync points it met.

    kill_at: the fork kills itself around that call that changes the disk: odd numbers just before
    it, even ones just after.
    """
    reader, writer = os.pipe()
    child = os.fork()
    if child == 0:
        counter = _count_sync_points(kill_at)
        code = 1
        try:
            work()
            code = 0
        finally:
            os.write(writer, str(counter()).encode())
            os._exit(code)
    os.close(writer)
    _, status = os.waitpid(child, 0)
    met = os.read(reader, 100)
    os.close(reader)
    return os.waitstatus_to_exitcode(status), int(met or 0)


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
    code, points = run_forked(render(job(folder / "whole")))
    require(code == 0, "the uninterrupted run failed")
    whole = tree_digest(folder / "whole")
    kills = 0
    for kill_at in range(1, 2 * points + 1, STRIDE):
        out = folder / "killed"
        code, _ = run_forked(render(job(out)), kill_at)
        # Threads meet the points in another order each time, so the last may not be reached.
        require(code == -signal.SIGKILL or kill_at > 2 * points - 8, f"{kill_at}: exit {code}")
        kills += code == -signal.SIGKILL
        check_only_whole_files(out, whole, f"killed at {kill_at}")
        resume_and_compare(job(out), out, whole, f"killed at {kill_at}")
        shutil.rmtree(out)
    return {"points": points, "kills": kills}


def sweep_overwrite(folder: Path) -> dict[str, int]:
    """Kill a run that overwrites an older variant; it must end as if begun in an empty folder."""
    run_forked(render(clear_job(folder / "old")))
    run_forked(render(job(folder / "whole", frames=1)))
    whole = tree_digest(folder / "whole")
    shutil.copytree(folder / "old", folder / "counted")
    _, points = run_forked(render(job(folder / "counted", frames=1, overwrite=True)))
    kills = 0
    for kill_at in range(1, 2 * points + 1, STRIDE):
        out = folder / "killed"
        shutil.copytree(folder / "old", out)
        code, _ = run_forked(render(job(out, frames=1, overwrite=True)), kill_at)
        kills += code == -signal.SIGKILL
        code, _ = run_forked(render(job(out, frames=1)))
        if code != 0:  # killed before the old content was given up: the old job still stands
            code, _ = run_forked(render(clear_job(out)))
            require(code == 0, f"killed at {kill_at}: neither job can go on")
            require(tree_digest(out) == tree_digest(folder / "old"), f"{kill_at}: old tree differs")
        else:
            require(tree_digest(out) == whole, f"killed at {kill_at}: the new tree differs")
        shutil.rmtree(out)
    return {"points": points, "kills": kills}


def kill_at_random(folder: Path) -> dict[str, int]:
    """Kill one job again and again after random times until it gets through."""
    run_forked(render(job(folder / "whole", frames=6)))
    whole = tree_digest(folder / "whole")
    out, rng, kills = folder / "killed", random.Random(5), 0
    while True:
        child = os.fork()
        if child == 0:
            render(job(out, frames=6), slow_render)()
            os._exit(0)
        time.sleep(rng.uniform(0.05, 0.25))
        os.kill(child, signal.SIGKILL)
        _, status = os.waitpid(child, 0)
        if status == 0:
            break
        kills += 1
        check_only_whole_files(out, whole, f"kill {kills}")
    require(tree_digest(out) == whole, "the resumed tree differs")
    return {"kills": kills}


def kill_parent_of_workers(folder: Path) -> dict[str, int]:
    """Kill a job with two workers; they must go too, and the folder be free to resume."""
    run_forked(render(job(folder / "whole", frames=40)))
    out = folder / "killed"
    child = os.fork()
    if child == 0:
        render(job(out, frames=40, workers=2), slow_render)()
        os._exit(0)
    while count_finished(out) < 3:
        time.sleep(0.01)
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    finished = count_finished(out)
    resume_and_compare(job(out, frames=40), out, tree_digest(folder / "whole"), "parent killed")
    return {"finished": finished}


def check_only_whole_files(out: Path, whole: dict[str, str], when: str) -> None:
    """Every file under a final name is the one of the uninterrupted run."""
    for name, digest in tree_digest(out).items():
        hidden = name.startswith(STATE_FOLDER) or name.endswith(TEMPORARY_SUFFIX)
        require(hidden or whole.get(name) == digest, f"{when}: {name} is not the whole file")


def resume_and_compare(what: RenderJob, out: Path, whole: dict[str, str], when: str) -> None:
    """Finish the job; nothing finished is rendered again, and the files are the same."""
    finished = count_finished(out)

    def work() -> None:
        result = run_job(what, scene_loader=open_fake, renderer=fake_render, progress=False)
        require(result.skipped == finished, f"{when}: {finished} were finished, got {result}")

    code, _ = run_forked(work)
    require(code == 0, f"{when}: resuming failed with exit code {code}")
    after = tree_digest(out)
    different = {k for k in whole.keys() | after.keys() if whole.get(k) != after.get(k)}
    require(not different, f"{when}: after resuming these differ: {sorted(different)}")


def count_finished(out: Path) -> int:
    """Images that a journal or the manifest lists, read without the code under test."""
    import pyarrow.parquet as pq

    if (out / "manifest.parquet").exists():
        return pq.ParquetFile(out / "manifest.parquet").metadata.num_rows
    journals = list((out / STATE_FOLDER).rglob("*.jsonl"))
    return sum(journal.read_bytes().count(b"\n") - 1 for journal in journals)


def require(holds: bool, message: str) -> None:
    if not holds:
        sys.exit(message)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
