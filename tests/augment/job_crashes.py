"""Kills jobs at chosen and random moments and goes on with them; prints what it found as JSON.

Run as a script, in a process of its own: each job runs in a fork of it, which is quick to start
and can be killed without harm to the tests. Exits non-zero, saying why, when a promise of
`climategs render` or `climategs generate` does not hold.
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

from tqdm import tqdm

import augment.jobs.block_queue as block_queue
import augment.jobs.pools as pools
from augment.errors import OutputError
from augment.jobs.generate import GenerateJob, GenerateResult, run_generate
from augment.jobs.render_job import RenderJob, run_job
from augment.output.atomic import TEMPORARY_SUFFIX
from augment.output.manifest import read_manifest_rows
from augment.output.names import STATE_FOLDER
from augment.output.store import open_store
from augment.output.tables import lidar_bytes
from augment.suite.run import run_suite
from augment.suite.verify import verify_suite
from recipes.flood import Flood
from recipes.snow import Snow
from tests.augment import generate_jobs as jobs
from tests.augment.batch_scenes import make_recipe, open_fake, tree_digest
from tests.augment.fork_server import keep_in_forks, server_process, start_fork_server
from tests.augment.generate_jobs import (
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
)
from tests.augment.suite_runs import make_run

Work = Callable[[], object]
CHANGES = ("fsync", "replace", "unlink", "rename", "rmdir", "link", "mkdir")
DISK_FULL = 28
INTERRUPTED = 130
KILLED = -signal.SIGKILL


def main(folder: Path, names: list[str]) -> None:
    # tqdm's own is shared with forks, and one that is killed may hold it.
    tqdm.set_lock(threading.RLock())
    tqdm.monitor_interval = 0  # its thread may hold the lock while a process forks
    faulthandler.register(signal.SIGUSR1)
    take_notes(folder / "notes")
    start_fork_server("tests.augment.generate_jobs", "augment.jobs.pools", "augment.jobs.worker")
    keep_in_forks()
    block_queue.ELSEWHERE_S = pools.WAIT_S = 0.05
    lidar_bytes(open_fake("fake:warm").labels.lidar(0))
    for number, work in enumerate((generating, rendering)):
        work(folder / f"warm-{number}")()  # imports what is imported late
    gc.collect()
    gc.freeze()  # or every fork looks through all that was imported
    results = {}
    for scenario in SCENARIOS:
        if scenario.__name__ in (names or [each.__name__ for each in SCENARIOS]):
            place = folder / scenario.__name__
            place.mkdir()
            results[scenario.__name__] = scenario(place)
    print(json.dumps(results))


# ---- Jobs in forks ------------------------------------------------------------------------------


def rendering(out: Path, renderer: Callable = noting_render, **options) -> Work:
    """`climategs render`: two frames of two cameras, unless there are workers."""
    # Snow of no depth is not laid; the stand-in draws some all the same.
    weather = {"flood": Flood(level_m=0.3), "snow": Snow(depth_m=0)}
    recipe = make_recipe(instance=False, semantic=False, **weather)
    frames = 16 if "workers" in options else 2
    job = RenderJob(f"fake:street?frames={frames}", [recipe], out, **options)
    return lambda: run_job(job, scene_loader=open_fake, renderer=renderer, progress=False)


def generating(out: Path, renderer: Callable = noting_render, **options) -> Work:
    """`climategs generate`: 28 images, unless told otherwise."""
    if "workers" in options:
        options["executor"] = "processes"
    job = make_job(out, renderer=renderer, **options)
    return lambda: generate(job)


def rendering_suite(out: Path) -> Work:
    """`climategs suite`: five variants of one scene, 20 images, and their hashes."""
    run = make_run(out, scenes=("fake:a?frames=2",), renderer=noting_render)
    return lambda: run_suite(run, progress=False)


def generate(job: GenerateJob) -> GenerateResult:
    return run_generate(job, progress=False)


def fork(work: Work, prepare: Work | None = None) -> int:
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


def finish(work: Work, what: str) -> None:
    code = end_of(fork(work))
    require(code == 0, f"{what}: exit code {code}")


def at_change(number: int) -> Work:
    """Makes a fork kill itself around its n-th change of the disk: odd before it, even after it."""

    def prepare() -> None:
        num_changes = [0]

        def watched(call: Callable) -> Callable:
            def wrapper(*arguments, **options):
                num_changes[0] += 1
                if num_changes[0] >= (number + 1) // 2 and number % 2:
                    os.kill(os.getpid(), signal.SIGKILL)
                result = call(*arguments, **options)
                if num_changes[0] >= number // 2 and not number % 2:
                    os.kill(os.getpid(), signal.SIGKILL)
                return result

            return wrapper

        for name in CHANGES:
            setattr(os, name, watched(getattr(os, name)))

    return prepare


def full_disk(calls: int) -> Work:
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


# ---- What must hold -----------------------------------------------------------------------------


def require(holds: bool, message: str) -> None:
    if not holds:
        sys.exit(message)


def digests_of(out: Path) -> dict[str, str]:
    """Of all that a finished job leaves. What `generate` knows of itself has names of its own."""
    is_generate = (out / STATE_FOLDER / "parts").exists()
    return outputs(out) if is_generate else tree_digest(out)


def whole_of(folder: Path, job: Callable[[Path], Work]) -> dict[str, str]:
    """Digests of the files of an uninterrupted run."""
    finish(job(folder / "whole"), "the whole job")
    forget_notes()
    return digests_of(folder / "whole")


def forget_notes() -> None:
    Path(os.environ[jobs.NOTES]).unlink(missing_ok=True)


def rendered_images() -> tuple[list[str], dict[str, int]]:
    return read_notes(Path(os.environ[jobs.NOTES]))


def check_whole_files(out: Path, reference_digests: dict[str, str], when: str) -> None:
    """Every file under a final name is the one of the uninterrupted run; readers see only such."""
    for name, digest in tree_digest(out).items():
        # A reader takes the manifest and the tables as they are: parts of the whole ones.
        is_hidden = name.startswith(STATE_FOLDER) or name.endswith(TEMPORARY_SUFFIX)
        is_growing = name == "manifest.parquet"
        require(
            is_hidden or is_growing or reference_digests.get(name) == digest,
            f"{when}: {name} is not whole",
        )
    check_reader(out, reference_digests, may_fail=True)


def check_ended(out: Path, reference_digests: dict[str, str], when: str, most: int = 10**9) -> None:
    """All promises about a job that has got through. most: times that an image was rendered."""
    after = digests_of(out)
    different = sorted(
        k
        for k in reference_digests.keys() | after.keys()
        if reference_digests.get(k) != after.get(k)
    )
    require(not different, f"{when}: these differ: {different}")
    require(not leftovers(out), f"{when}: left behind are {leftovers(out)}")
    again, rendered = rendered_images()
    require(not again, f"{when}: finished and rendered again: {again}")
    require(max(rendered.values(), default=0) <= most, f"{when}: {rendered}")


def notes_of(kind: str) -> set[str]:
    path = Path(os.environ[jobs.NOTES])
    lines = path.read_text().splitlines() if path.exists() else []
    return {line[2:] for line in lines if line[0] == kind}


def wait_for_notes(more: int) -> None:
    """Until so many more images are finished."""
    num_notes = len(notes_of("A")) + more
    deadline = time.monotonic() + 150
    while len(notes_of("A")) < num_notes:
        require(time.monotonic() < deadline, "nothing is rendered")
        time.sleep(0.005)


def workers_of_server() -> list[int]:
    """Worker processes: those that the fork server has started and that live."""
    server = server_process()
    processes = []
    for entry in os.listdir("/proc"):
        if entry.isdigit():
            try:
                facts = Path(f"/proc/{entry}/stat").read_text().rpartition(")")[2].split()
            except OSError:
                continue
            if int(facts[1]) == server and facts[0] != "Z":
                processes.append(int(entry))
    return processes


def wait_for_workers(limit_s: float = 20) -> None:
    """Workers end by themselves when their driver has gone."""
    deadline = time.monotonic() + limit_s
    while workers_of_server():
        require(time.monotonic() < deadline, f"workers live on: {workers_of_server()}")
        time.sleep(0.01)


# ---- Scenarios ----------------------------------------------------------------------------------


def kill_until_through(folder: Path, job: Callable[..., Work], rounds: int, changes: int) -> dict:
    """Kill a job around four changes of the disk, one after the other, and let it get through."""
    rng = random.Random(3)
    kills = 0
    reference_digests = whole_of(folder, job)
    for number in range(rounds):
        out = folder / f"killed-{number}"
        forget_notes()
        for _ in range(4):
            at = rng.randrange(1, changes)
            code = end_of(fork(job(out), at_change(at)))
            require(code in (0, KILLED), f"killed at {at}: exit code {code}")
            check_whole_files(out, reference_digests, f"killed at {at}")
            kills += code == KILLED
        finish(job(out), f"round {number}")
        check_ended(out, reference_digests, f"round {number}")
    return {"kills": kills}


def kill_a_few_times(folder: Path) -> dict:
    """The quick case, which the others hold too: of few images."""
    for name in ("render", "generate"):
        (folder / name).mkdir()
    small = {"scenes": ("fake:a?frames=2",)}
    results = (
        kill_until_through(folder / "render", rendering, 1, 150),
        kill_until_through(folder / "generate", lambda out: generating(out, **small), 1, 120),
    )
    return {"kills": sum(result["kills"] for result in results)}


def kill_render_jobs(folder: Path) -> dict:
    return kill_until_through(folder, rendering, 6, 250)


def kill_generate_jobs(folder: Path) -> dict:
    return kill_until_through(folder, generating, 6, 500)


def kill_suites(folder: Path) -> dict:
    """Suites that were killed end with the same files, `suite.json` with their hashes included."""
    result = kill_until_through(folder, rendering_suite, 1, 300)
    for out in folder.iterdir():
        require(verify_suite(open_store(out)).is_intact, f"{out} is not intact")
    return result


def kill_while_overwriting(folder: Path) -> dict:
    """Kill a run that overwrites an older variant: the old job or the new one must go on."""

    def old_job(out: Path) -> Work:
        """The same variant folder as `rendering`, with other pixels."""
        job = RenderJob("fake:street?frames=2", [make_recipe(depth="none")], out)
        return lambda: run_job(job, scene_loader=open_fake, renderer=noting_render, progress=False)

    finish(old_job(folder / "old"), "the old job")
    old = digests_of(folder / "old")
    reference_digests = whole_of(folder, rendering)
    kills = 0
    # All that an overwriting run does before it renders is within its first 30 changes.
    for number in [*range(1, 60, 13), 100]:
        out = Path(shutil.copytree(folder / "old", folder / f"killed-{number}"))
        kills += end_of(fork(rendering(out, overwrite=True), at_change(number))) == KILLED
        if end_of(fork(rendering(out))) == 0:
            require(
                digests_of(out) == reference_digests, f"killed at {number}: the new tree differs"
            )
        else:  # killed before the old content was given up
            finish(old_job(out), f"killed at {number}, neither job can go on")
            require(digests_of(out) == old, f"killed at {number}: the old tree differs")
    return {"kills": kills}


def stop_jobs_with_workers(folder: Path) -> dict:
    """Ctrl-C and SIGTERM let workers finish their images; after them, and after the parent alone
    was killed, a later run goes on."""
    from tools.generate import ended_by_sigterm

    stops = []
    for job in (rendering, generating):
        place = folder / job.__name__
        place.mkdir()
        reference_digests = whole_of(place, lambda out, job=job: job(out, workers=1))
        out = place / "stopped"

        def work(job=job, out=out) -> None:
            with ended_by_sigterm():
                job(out, slow_noting_render, workers=2)()

        for how in (signal.SIGINT, signal.SIGTERM, signal.SIGKILL):
            child = fork(work)
            wait_for_notes(3)
            # As a terminal and a scheduler do, to all of the group; the last to the parent alone.
            os.kill(child, how) if how == signal.SIGKILL else os.killpg(child, how)
            code = end_of(child)
            require(code in (INTERRUPTED, KILLED), f"{how!r}: exit code {code}")
            wait_for_workers()
            started = notes_of("R")
            ended = notes_of("A")
            require(how == signal.SIGKILL or started == ended, f"{how!r}: {started - ended}")
            stops.append(len(ended))
            check_reader(out, reference_digests) if job is generating else None
        finish(job(out, workers=1), f"{job.__name__} does not go on")
        check_ended(out, reference_digests, "stopped", most=2)
    return {"finished": stops}


def fill_the_disk(folder: Path) -> dict:
    """Let the disk be full after ever more writes; free it, and go on."""
    reference_digests = whole_of(folder, generating)
    failures = 0
    out = folder / "full"
    for calls in range(0, 1000, 60):
        code = end_of(fork(generating(out), full_disk(calls)))
        require(code in (0, DISK_FULL), f"full after {calls} calls: exit code {code}")
        check_reader(out, reference_digests)
        failures += code == DISK_FULL
        forget_notes()
        if code == 0:
            break
    finish(generating(out), "after a full disk")
    check_ended(out, reference_digests, "after a full disk")
    return {"failures": failures}


def run_several_drivers(folder: Path) -> dict:
    """Shards and whole jobs at once on one output; they share the work, and one is killed."""
    reference_digests = whole_of(folder, generating)
    out = folder / "at-once"
    job = make_job(out, renderer=slow_noting_render)
    shards = [lambda s=s: generate(replace(job, shard=(s, 3))) for s in (1, 2, 3)]
    children = [fork(work) for work in (*shards, lambda: generate(job), lambda: generate(job))]
    time.sleep(0.3)
    os.kill(children[3], signal.SIGKILL)
    codes = [end_of(child) for child in children]
    require(codes[:3] + codes[4:] == [0] * 4, f"drivers at once: {codes}")
    check_ended(out, reference_digests, "drivers at once", most=2)
    again = sum(count > 1 for count in rendered_images()[1].values())
    require(again <= 4, f"drivers at once: {again} images were rendered twice")
    return {"rendered_twice": again}


def die_at_one_image(folder: Path) -> dict:
    """A worker dies at one image each time; a later run renders that image alone."""
    reference_digests = whole_of(folder, generating)
    out = folder / "dying"
    results = folder / "results"
    job = make_job(out, renderer=dying_render, executor="processes", workers=2)
    finish(lambda: results.write_text(json.dumps(vars(generate(job)), default=str)), "dying")
    counts = json.loads(results.read_text())
    require(
        counts["written"] + counts["skipped"] == 27 and counts["failed"] == 1, f"dying: {counts}"
    )
    require(
        "was killed by SIGKILL while rendering this image" in str(counts["failures"]), f"{counts}"
    )
    rows = read_manifest_rows(open_store(out)).to_pylist()
    failed = [(r["variant"], r["frame"], r["camera"]) for r in rows if r["status"] == "failed"]
    require(failed == [("fog-000", 1, "front")] and len(rows) == 28, f"dying: {failed}")
    before = sum(rendered_images()[1].values())
    finish(generating(out), "again")
    check_ended(out, reference_digests, "died at one image")
    again = sum(rendered_images()[1].values()) - before
    require(again == 1, f"dying: {again} rendered again")
    return {}


def die_while_opening(folder: Path) -> dict:
    """A worker dies whenever it opens one of the scenes; the other one is rendered."""
    reference_digests = whole_of(folder, generating)
    out = folder / "dying"
    results = folder / "results"
    dying = make_job(out, opener=open_dying, executor="processes", workers=2)

    def render_dying() -> dict:
        finish(
            lambda: results.write_text(json.dumps(vars(generate(dying)), default=str)), "opening"
        )
        return json.loads(results.read_text())

    counts = render_dying()
    require((counts["written"], counts["failed"]) == (16, 0), f"opening: {counts}")
    why = "the worker was killed by SIGKILL while opening the scene, alone too"
    require(counts["unusable"] == {"fake:b?frames=3": why}, f"opening: {counts}")
    # Known from before, it is found out only when its blocks are rendered.
    shutil.rmtree(out)
    forget_notes()
    finish(generating(out, shard=(1, 2)), "half")
    counts = render_dying()
    require(counts["skipped"] + counts["written"] == 16 and counts["failed"] == 12, f"{counts}")
    rows = read_manifest_rows(open_store(out)).to_pylist()
    failed = {row["scene"] for row in rows if row["status"] == "failed"}
    require(failed == {"b"} and len(rows) == 28, f"opening later: {failed}")
    finish(generating(out), "opening later: it goes on")
    check_ended(out, reference_digests, "opening later")
    return {}


SCENARIOS = (
    kill_a_few_times,
    kill_render_jobs,
    kill_generate_jobs,
    kill_suites,
    kill_while_overwriting,
    stop_jobs_with_workers,
    fill_the_disk,
    run_several_drivers,
    die_at_one_image,
    die_while_opening,
)

if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2:])
