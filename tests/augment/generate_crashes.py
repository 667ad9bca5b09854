"""Kills dataset jobs at chosen and random moments and goes on with them; prints what it found.

Run as a script, in a process of its own: each job runs in a fork of it, which is quick to start
and can be killed without harm to the tests. Exits non-zero, saying why, when a promise of
`climategs generate` does not hold.
"""

from __future__ import annotations

import errno
import faulthandler
import gc
import json
import os
import random
import shutil
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import generate_jobs as jobs
from batch_scenes import open_fake
from fork_server import keep_in_forks, server_process, start_fork_server
from generate_jobs import (
    SCENES,
    check_reader,
    dying_render,
    leftovers,
    make_job,
    noting_render,
    open_dying,
    outputs,
    read_notes,
    slow_noting_render,
    take_notes,
    very_slow_noting_render,
)
from tqdm import tqdm

import augment.jobs.generate as drive
import augment.jobs.pools as pools
from augment.errors import OutputError
from augment.jobs.block_worker import IndexTask
from augment.jobs.generate import GenerateJob, GenerateResult, run_generate
from augment.jobs.manifest import read_finished
from augment.jobs.pools import Finished, ProcessPool
from augment.jobs.store import open_store
from augment.jobs.tables import lidar_bytes

CHANGES = ("fsync", "replace", "unlink", "rename", "rmdir", "link", "mkdir")
DISK_FULL, INTERRUPTED = 28, 130
SCENARIOS: list[Callable[[Path], dict]] = []


def scenario(function: Callable[[Path], dict]) -> Callable[[Path], dict]:
    SCENARIOS.append(function)
    return function


def main(folder: Path, names: list[str]) -> None:
    # tqdm's own is shared with forks, and one that is killed may hold it.
    tqdm.set_lock(threading.RLock())
    faulthandler.register(signal.SIGUSR1)
    take_notes(folder / "notes")
    start_fork_server("generate_jobs", "augment.jobs.pools")
    keep_in_forks()
    drive.ELSEWHERE_S = pools.WAIT_S = 0.05
    lidar_bytes(open_fake("fake:warm").labels.lidar(0))
    run_generate(make_job(folder / "warm"), progress=False)  # imports what is imported late
    gc.collect()
    gc.freeze()  # or every fork looks through all that was imported
    found = {}
    for kill in SCENARIOS:
        if kill.__name__ in (names or [k.__name__ for k in SCENARIOS[1:]]):
            place = folder / kill.__name__
            place.mkdir()
            started = time.perf_counter()
            found[kill.__name__] = kill(place)
            found[kill.__name__]["seconds"] = round(time.perf_counter() - started, 2)
    print(json.dumps(found))


# Driving


def fork(work: Callable[[], object], prepare: Callable[[], object] | None = None) -> int:
    """Start `work` in a fork of this process, in a process group of its own; returns its id."""
    sys.stdout.flush()
    child = os.fork()
    if child == 0:
        code = 1
        try:
            os.setpgid(0, 0)
            if prepare is not None:
                prepare()
            work()
            code = 0
        except KeyboardInterrupt:
            code = INTERRUPTED
        except OutputError as error:
            code = DISK_FULL if "disk is full" in str(error) else 1
            if code == 1:
                traceback.print_exc()
        except BaseException:
            traceback.print_exc()
        finally:
            sys.stderr.flush()
            os._exit(code)
    return child


def end_of(child: int, limit_s: float = 150) -> int:
    """The exit code of a fork, -9 where it was killed; fails where it does not end."""
    deadline = time.monotonic() + limit_s
    while time.monotonic() < deadline:
        pid, status = os.waitpid(child, os.WNOHANG)
        if pid:
            return os.waitstatus_to_exitcode(status)
        time.sleep(0.002)
    os.kill(child, signal.SIGUSR1)  # it prints where it is
    time.sleep(1)
    os.killpg(child, signal.SIGKILL)
    sys.exit(f"a job does not end within {limit_s} s")


def generate(job: GenerateJob) -> GenerateResult:
    return run_generate(job, progress=False)


def generating(job: GenerateJob) -> Callable[[], GenerateResult]:
    return lambda: generate(job)


def at_change(number: int, act: Callable[[], None]) -> Callable[[], None]:
    """Makes a fork do `act` around its n-th change of the disk: just before it, or just after."""

    def prepare() -> None:
        met = [0]

        def watched(call: Callable) -> Callable:
            def wrapper(*arguments, **options):
                met[0] += 1
                if met[0] == (number + 1) // 2 and number % 2:
                    act()
                result = call(*arguments, **options)
                if met[0] >= number // 2 and not number % 2:
                    act()
                return result

            return wrapper

        for name in CHANGES:
            setattr(os, name, watched(getattr(os, name)))

    return prepare


def die() -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def full_disk(calls: int) -> Callable[[], None]:
    """Makes a fork's disk be full after so many calls that need room."""

    def prepare() -> None:
        left = [calls]

        def limited(call: Callable) -> Callable:
            def wrapper(*arguments, **options):
                if arguments[0] is not None and left[0] <= 0:
                    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
                left[0] -= 1
                return call(*arguments, **options)

            return wrapper

        jobs.note = lambda kind, name: None  # the notes lie on a disk of their own, say
        for name in ("write", "link", "mkdir"):
            setattr(os, name, limited(getattr(os, name)))

    return prepare


def whole_of(folder: Path, job: Callable[[Path], GenerateJob]) -> dict[str, str]:
    """Digests of the files of an uninterrupted run."""
    require(end_of(fork(lambda: generate(job(folder / "whole")))) == 0, "the whole job failed")
    forget_notes()
    return outputs(folder / "whole")


def forget_notes() -> None:
    Path(os.environ[jobs.NOTES]).unlink(missing_ok=True)


def check_ended(out: Path, whole: dict[str, str], when: str, most: int = 10**9) -> None:
    """All promises about a job that has got through. most: times that an image was rendered."""
    after = outputs(out)
    different = sorted(k for k in whole.keys() | after.keys() if whole.get(k) != after.get(k))
    require(not different, f"{when}: these differ: {different}")
    require(not leftovers(out), f"{when}: left behind are {leftovers(out)}")
    again, rendered = read_notes(Path(os.environ[jobs.NOTES]))
    require(not again, f"{when}: finished and rendered again: {again}")
    require(max(rendered.values(), default=0) <= most, f"{when}: {rendered.most_common(3)}")


def require(holds: bool, message: str) -> None:
    if not holds:
        sys.exit(message)


# Scenarios


@scenario
def kill_the_driver_twice(folder: Path) -> dict:
    """The quick case, which the others hold too: of few images."""
    return kill_the_driver(folder, kills=2, scenes=("fake:a?frames=2",), changes=120)


@scenario
def kill_the_driver(
    folder: Path, kills: int = 12, scenes: tuple[str, ...] = SCENES, changes: int = 500
) -> dict:
    """Kill one serial driver after the other, around changes of the disk and at random times."""
    rng, met, rounds = random.Random(3), 0, 0
    whole, seen = whole_of(folder, lambda out: make_job(out, scenes)), set()
    while met < kills:
        out = folder / f"killed-{rounds}"
        job = make_job(out, scenes, renderer=noting_render)
        forget_notes()
        while True:
            by_time = rng.random() < 0.2
            number = rng.randrange(1, changes)
            child = fork(generating(job), None if by_time else at_change(number, die))
            if by_time:
                time.sleep(rng.uniform(0, 0.4))
                os.kill(child, signal.SIGKILL)
            code = end_of(child)
            require(code in (0, -signal.SIGKILL), f"killed at {number}: exit code {code}")
            seen.add(check_reader(out, whole))
            if code == 0:
                break
            met += 1
        check_ended(out, whole, f"round {rounds}")
        require(len(os.listdir(out)) == 2 + len(scenes), f"{os.listdir(out)}")
        shutil.rmtree(out)
        rounds += 1
    return {"kills": met, "rounds": rounds, "seen": len(seen)}


@scenario
def fill_the_disk(folder: Path) -> dict:
    """Let the disk be full after ever more writes; free it, and go on."""
    whole = whole_of(folder, lambda out: make_job(out))
    failures = 0
    for calls in range(0, 1000, 60):
        out = folder / "full"
        code = end_of(fork(generating(make_job(out)), full_disk(calls)))
        require(code in (0, DISK_FULL), f"full after {calls} calls: exit code {code}")
        check_reader(out, whole)
        failures += code == DISK_FULL
        forget_notes()
        if code == 0:
            break
    require(end_of(fork(generating(make_job(out)))) == 0, "it does not go on")
    check_ended(out, whole, "after a full disk")
    return {"failures": failures}


@scenario
def run_several_drivers(folder: Path) -> dict:
    """Shards and whole jobs at once on one output; they share the work, and one is killed."""
    whole = whole_of(folder, lambda out: make_job(out))
    shards = [(1, 3), (2, 3), (3, 3)]
    for shard in shards:
        out = folder / "in-turn"
        job = make_job(out, renderer=noting_render, shard=shard)
        require(end_of(fork(generating(job))) == 0, f"{shard} failed")
    check_ended(out, whole, "shards in turn", most=1)
    forget_notes()
    out = folder / "at-once"
    job = make_job(out, renderer=slow_noting_render)
    children = [fork(generating(replace(job, shard=s))) for s in shards]
    children += [fork(generating(job)) for _ in range(2)]
    time.sleep(0.3)
    os.kill(children[3], signal.SIGKILL)
    codes = [end_of(child) for child in children]
    require(codes[:3] + codes[4:] == [0] * 4, f"drivers at once: {codes}")
    check_ended(out, whole, "drivers at once", most=2)
    _, rendered = read_notes(Path(os.environ[jobs.NOTES]))
    again = sum(count > 1 for count in rendered.values())
    require(again <= 4, f"drivers at once: {rendered}")
    return {"rendered_twice": again}


@scenario
def kill_workers(folder: Path, kills: int = 2) -> dict:
    """Kill workers and drivers of a job with processes, at random times, until it gets through."""
    rng, workers_killed, drivers_killed, runs = random.Random(1), 0, 0, 0
    scenes = ("fake:a?frames=5", "fake:b?frames=4")
    whole = whole_of(folder, lambda out: make_job(out, scenes))
    round_ = 0
    while workers_killed + drivers_killed < kills:
        out, round_ = folder / f"killed-{round_}", round_ + 1
        job = make_job(out, scenes, renderer=slow_noting_render, executor="processes", workers=2)
        forget_notes()
        while True:
            runs += 1
            child = fork(generating(job))
            code = None
            while code is None:
                code = wait_for_notes(rng.randrange(1, 8), child)
                if code is None and rng.random() < 0.5:
                    os.kill(child, signal.SIGKILL)
                    code = end_of(child)
                    drivers_killed += 1
                    wait_for_workers()
                elif code is None and (found := workers_of_server()):
                    os.kill(rng.choice(found), signal.SIGKILL)
                    workers_killed += 1
            require(code in (0, -signal.SIGKILL), f"processes: exit code {code}")
            check_reader(out, whole, may_fail=True)  # killed, and killed again alone
            if code == 0 and _is_done(job):
                break
        check_ended(out, whole, f"processes, round {round_}")
        wait_for_workers()
        shutil.rmtree(out)
    return {"workers_killed": workers_killed, "drivers_killed": drivers_killed, "runs": runs}


def _is_done(job: GenerateJob) -> bool:
    table = read_finished(open_store(job.setup.store_uri))
    return "failed" not in table["status"].to_pylist()


def workers_of_server() -> list[int]:
    """Worker processes: those that the fork server has started and that live."""
    server = server_process()
    found = []
    for entry in os.listdir("/proc"):
        if entry.isdigit():
            try:
                facts = Path(f"/proc/{entry}/stat").read_text().rpartition(")")[2].split()
            except OSError:
                continue
            if int(facts[1]) == server and facts[0] != "Z":
                found.append(int(entry))
    return found


def wait_for_workers(limit_s: float = 20) -> None:
    """Workers end by themselves when their driver has gone."""
    deadline = time.monotonic() + limit_s
    while workers_of_server():
        require(time.monotonic() < deadline, f"workers live on: {workers_of_server()}")
        time.sleep(0.01)


@scenario
def kill_an_idle_worker(folder: Path) -> dict:
    """A worker that dies without a task is no loss: the next task gets a new one."""
    setup = make_job(folder / "idle").setup

    def work() -> None:
        pool, task = ProcessPool(setup, 1), IndexTask("fake:a", None)
        for _ in range(2):
            pool.give(0, task)
            (event,) = pool.wait(60)
            require(isinstance(event, Finished), f"idle: {event}")
            (worker,) = workers_of_server()
            os.kill(worker, signal.SIGKILL)
            wait_for_workers()
            require(pool.wait(0.2) == [], "idle: it counts as lost")
        pool.close()

    require(end_of(fork(work)) == 0, "idle: the pool failed")
    return {}


@scenario
def stop_a_job_with_workers(folder: Path) -> dict:
    """Ctrl-C and SIGTERM let workers finish their images, and a second run goes on."""
    from tools.render import ended_by_sigterm

    whole = whole_of(folder, lambda out: make_job(out))
    out, stops = folder / "stopped", []
    job = make_job(out, renderer=very_slow_noting_render, executor="processes", workers=2)

    def work() -> None:
        with ended_by_sigterm():
            generate(job)

    for how in (signal.SIGINT, signal.SIGTERM):
        child = fork(work)
        wait_for_notes(4)
        os.killpg(child, how)  # as a terminal and a scheduler do: to all of the group
        code = end_of(child)
        require(code == INTERRUPTED, f"{how!r}: exit code {code}")
        wait_for_workers()
        started, ended = notes_of("R"), notes_of("A")
        require(started == ended, f"{how!r}: started and not finished: {started - ended}")
        stops.append(len(ended))
        check_reader(out, whole)
    require(end_of(fork(work)) == 0, "it does not go on")
    check_ended(out, whole, "stopped", most=1)
    return {"finished": stops}


def notes_of(kind: str) -> set[str]:
    path = Path(os.environ[jobs.NOTES])
    lines = path.read_text().splitlines() if path.exists() else []
    return {line[2:] for line in lines if line[0] == kind}


def wait_for_notes(more: int, child: int | None = None) -> int | None:
    """Until so many more images are finished, or the child has ended: then its exit code."""
    wanted, deadline = len(notes_of("A")) + more, time.monotonic() + 150
    while len(notes_of("A")) < wanted:
        pid, status = (0, 0) if child is None else os.waitpid(child, os.WNOHANG)
        if pid:
            return os.waitstatus_to_exitcode(status)
        require(time.monotonic() < deadline, "nothing is rendered")
        time.sleep(0.005)
    return None


@scenario
def die_at_one_image(folder: Path) -> dict:
    """A worker dies at one image each time; a later run renders that image alone."""
    whole = whole_of(folder, lambda out: make_job(out))
    out = folder / "dying"
    results = folder / "results"

    def work(renderer: Callable) -> Callable[[], None]:
        job = make_job(out, renderer=renderer, executor="processes", workers=2)
        return lambda: results.write_text(json.dumps(vars(generate(job)), default=str))

    require(end_of(fork(work(dying_render))) == 0, "dying: the job ended")
    found = json.loads(results.read_text())
    require(found["written"] + found["skipped"] == 27 and found["failed"] == 1, f"dying: {found}")
    require(
        "was killed by SIGKILL while rendering this image" in str(found["failures"]), f"{found}"
    )
    rows = read_finished(open_store(out)).to_pylist()
    failed = [(r["variant"], r["frame"], r["camera"]) for r in rows if r["status"] == "failed"]
    require(failed == [("fog-000", 1, "front")] and len(rows) == 28, f"dying: {failed}")
    again, rendered = read_notes(Path(os.environ[jobs.NOTES]))
    require(not again, f"dying: {again}")
    before = rendered.total()
    require(end_of(fork(generating(make_job(out, renderer=noting_render)))) == 0, "again")
    check_ended(out, whole, "died at one image")
    _, rendered = read_notes(Path(os.environ[jobs.NOTES]))
    require(rendered.total() == before + 1, f"dying: {rendered.total() - before} rendered again")
    return {"rendered_again": rendered.total() - before}


@scenario
def die_while_opening(folder: Path) -> dict:
    """A worker dies whenever it opens one of the scenes; the other one is rendered."""
    out, results = folder / "dying", folder / "results"

    def work(**options) -> Callable[[], None]:
        job = make_job(out, renderer=noting_render, executor="processes", workers=2, **options)
        return lambda: results.write_text(json.dumps(vars(generate(job)), default=str))

    require(end_of(fork(work(opener=open_dying))) == 0, "opening: the job ended")
    found = json.loads(results.read_text())
    require((found["written"], found["failed"]) == (16, 0), f"opening: {found}")
    why = "the worker was killed by SIGKILL while opening the scene, alone too"
    require(found["unusable"] == {"fake:b?frames=3": why}, f"opening: {found}")

    # Known from before, it is found out only when its blocks are rendered.
    shutil.rmtree(out)
    forget_notes()
    require(end_of(fork(generating(make_job(out, shard=(1, 2))))) == 0, "half")
    require(end_of(fork(work(opener=open_dying))) == 0, "opening later: the job ended")
    found = json.loads(results.read_text())
    require(found["skipped"] + found["written"] == 16 and found["failed"] == 12, f"{found}")
    rows = read_finished(open_store(out)).to_pylist()
    failed = {row["scene"] for row in rows if row["status"] == "failed"}
    require(failed == {"b"} and len(rows) == 28, f"opening later: {failed}")
    require(end_of(fork(work())) == 0, "opening later: it goes on")
    whole = whole_of(folder, lambda out: make_job(out))
    check_ended(out, whole, "opening later")
    return {}


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2:])
