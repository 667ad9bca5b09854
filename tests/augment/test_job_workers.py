"""Views in flight, files beside them, worker processes: the same files, whatever waits for what."""

from __future__ import annotations

import dataclasses
import os
import signal
import sys
import threading
import time
import types
from concurrent.futures import Future
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from augment.errors import ClimateGSError, GpuLost, OutputError
from augment.jobs import worker as runner
from augment.jobs.processes import share_scene, thread_limits
from augment.jobs.render_job import RenderJob
from augment.jobs.time_shares import compute_time_shares
from augment.jobs.write_pump import WritePump
from augment.output.manifest import read_manifest
from augment.render.threads import wait_for_result
from augment.scene.scene import Actor, Track
from augment.scene.sky import LatLongSky
from recipes.flood import Flood
from recipes.snow import Snow
from recipes.style import Style
from tests.augment.batch_scenes import (
    FakeLabels,
    FakePending,
    bed_render,
    begin_fake,
    fake_render,
    fog_job,
    make_bed,
    make_gaussians,
    make_maps,
    make_recipe,
    open_fake,
    render_dying_at_frame_2,
    run_fake,
    tree_digest,
)
from tests.augment.fork_server import quick_context, start_fork_server
from tests.augment.pretend_gpu import pretended_gpu

SOON_S = 10.0  # for what takes no time, on a machine that is busy


@pytest.fixture(scope="module")
def reference_digests(tmp_path_factory) -> dict[str, str]:
    """Digests of what a renderer that waits gives."""
    out = tmp_path_factory.mktemp("whole")
    run_fake(fog_job(out))
    return tree_digest(out)


# ---- Views in flight -----------------------------------------------------------------------------


@dataclass
class Gpu:
    """Begins views and finishes them when they are waited for; `notes` has the order."""

    notes: list[tuple[str, int]] = field(default_factory=list)
    count: int = 0

    def __call__(self, scene, camera, recipe, *, backend: str):
        number = self.count
        self.count = self.count + 1
        self.began(number)

        def finish():
            self.awaited(number)
            return fake_render(scene, camera, recipe, backend=backend)

        return FakePending(finish)

    def began(self, number: int) -> None:
        self.notes.append(("begin", number))

    def awaited(self, number: int) -> None:
        self.notes.append(("await", number))


def test_the_next_view_is_begun_before_the_last_is_waited_for(
    tmp_path: Path, reference_digests
) -> None:
    gpu = Gpu()
    assert run_fake(fog_job(tmp_path), gpu).written == 8
    expected = [("begin", 0)]
    for number in range(1, 8):
        expected += [("begin", number), ("await", number - 1)]
    assert gpu.notes == [*expected, ("await", 7)]
    assert tree_digest(tmp_path) == reference_digests


def test_failures_are_those_of_the_view_they_happen_to(tmp_path: Path, reference_digests) -> None:
    class Failing(Gpu):
        def began(self, number: int) -> None:
            super().began(number)
            if number == 3:
                raise MemoryError("no room for the lists of view 3")

        def awaited(self, number: int) -> None:
            super().awaited(number)
            if number in (2, 7):
                raise RuntimeError(f"the copies of view {number} did not come")

    gpu = Failing()
    result = run_fake(fog_job(tmp_path), gpu)
    assert (result.written, result.failed) == (5, 3)
    rows = read_manifest(tmp_path).to_pylist()
    messages = {(r["frame"], r["camera"]): r["message"] for r in rows if r["status"] == "failed"}
    assert messages == {
        (1, "front"): "rendering: RuntimeError: the copies of view 2 did not come",
        (1, "rear/left"): "rendering: MemoryError: no room for the lists of view 3",
        (3, "rear/left"): "rendering: RuntimeError: the copies of view 7 did not come",
    }
    assert [n for kind, n in gpu.notes if kind == "await"] == [0, 1, 2, 4, 5, 6, 7]
    run_fake(fog_job(tmp_path))
    assert tree_digest(tmp_path) == reference_digests


def test_a_lost_gpu_ends_the_run_and_fails_no_image(
    tmp_path: Path, monkeypatch, reference_digests
) -> None:
    class Lost(Gpu):
        def awaited(self, number: int) -> None:
            if number >= 3:
                raise RuntimeError("CUDA error: an illegal memory access was encountered")

    with monkeypatch.context() as patch:
        patch.setattr(runner, "gpu_is_lost", lambda backend: True)
        with pytest.raises(GpuLost, match=r"since frame 1, camera rear/left \(rendering: "):
            run_fake(fog_job(tmp_path), Lost())
    result = run_fake(fog_job(tmp_path))
    assert (result.written, result.skipped, result.failed) == (5, 3, 0)
    assert tree_digest(tmp_path) == reference_digests


def test_an_interrupt_lands_what_is_in_flight(tmp_path: Path, reference_digests) -> None:
    class Interrupted(Gpu):
        waits = 0

        def awaited(self, number: int) -> None:
            self.waits += 1
            if self.waits == 3:  # once, while it waits for view 2
                raise KeyboardInterrupt
            super().awaited(number)

    gpu = Interrupted()
    with pytest.raises(KeyboardInterrupt, match="stopped with 4 of 8 images finished"):
        run_fake(fog_job(tmp_path), gpu)
    assert gpu.notes[-2:] == [("await", 2), ("await", 3)]
    result = run_fake(fog_job(tmp_path))
    assert (result.written, result.skipped) == (4, 4)
    assert tree_digest(tmp_path) == reference_digests


@pytest.mark.long
def test_a_job_on_a_gpu_gives_the_pictures_of_the_cpu(tmp_path: Path, monkeypatch) -> None:
    """Drawn as jobs draw there, one view in flight, and one by one: the same bytes."""
    pytest.importorskip("triton")
    from augment.view.render_view import render_view

    def of_job(folder: str, backend: str, renderer=None) -> None:
        job = fog_job(tmp_path / folder, frames=[1], backend=backend)
        assert run_fake(job, renderer).failures == ()

    with pretended_gpu(monkeypatch):
        of_job("begun", "cuda")
        of_job("drawn", "cuda", render_view)
    of_job("cpu", "cpu")
    assert tree_digest(tmp_path / "begun") == tree_digest(tmp_path / "drawn")
    folder = tmp_path / "begun/street"
    images = sorted(folder.rglob("*.png"))
    assert len(images) == 8
    for path in images:
        theirs = tmp_path / "cpu/street" / path.relative_to(folder)
        ours = cv2.imread(str(path), cv2.IMREAD_UNCHANGED).astype(int)
        # Sums in another order: a step of 8 bits, or of 1/256 m.
        difference = np.abs(ours - cv2.imread(str(theirs), cv2.IMREAD_UNCHANGED)).max()
        assert difference <= (0 if "semantic" in str(path) or "instance" in str(path) else 1)


# ---- Files beside rendering ----------------------------------------------------------------------


@dataclass(frozen=True)
class SlowSweeps(FakeLabels):
    """Sweeps that come when they are let, or fail with a message."""

    come: threading.Event = field(default_factory=threading.Event)
    message: str = ""

    def lidar(self, frame_index: int):
        assert self.come.wait(SOON_S)
        if self.message:
            raise EOFError(self.message)
        return super().lidar(frame_index)


def test_pictures_do_not_wait_for_their_sweep(tmp_path: Path, reference_digests) -> None:
    """With one thread for the sweep and one for pictures: both of the frame are written, and none
    is told of before the sweep is there.
    """
    labels = SlowSweeps()
    outcomes = []
    scene = dataclasses.replace(open_fake("fake:street"), labels=labels)

    def let_come() -> None:
        deadline = time.monotonic() + SOON_S
        while len(list(tmp_path.rglob("images/*/*.png"))) < 2 and time.monotonic() < deadline:
            time.sleep(0.01)
        written.append(len(list(tmp_path.rglob("images/*/*.png"))))
        assert not outcomes
        labels.come.set()

    written: list[int] = []
    watcher = threading.Thread(target=let_come)
    watcher.start()
    job = fog_job(tmp_path, frames=[0])
    result = run_fake(job, scene_loader=lambda _uri: scene, on_outcome=outcomes.append)
    watcher.join()
    assert written == [2] and result.written == len(outcomes) == 2
    image_digests = tree_digest(tmp_path / "street/fog-000/images")
    stem = "street/fog-000/images/"
    assert (
        image_digests == {k: reference_digests[stem + k] for k in image_digests}
        and len(image_digests) == 2
    )


def test_pictures_of_a_sweep_that_fails_are_taken_back(tmp_path: Path) -> None:
    labels = SlowSweeps(message="the file is cut short")
    scene = dataclasses.replace(open_fake("fake:street"), labels=labels)
    started = []

    def render(*arguments, **options):
        started.append(1)
        if len(started) == 2:
            labels.come.set()
        return fake_render(*arguments, **options)

    result = run_fake(fog_job(tmp_path, frames=[0]), render, scene_loader=lambda _uri: scene)
    assert result.failed == 2 and "EOFError: the file is cut short" in result.failures[0]
    assert not list(tmp_path.rglob("*.png"))


def test_a_pump_takes_no_more_than_it_may_hold_and_stops_at_a_failure() -> None:
    pump = WritePump(threads=1, waiting=2)
    go_on = threading.Event()
    started_tasks = []

    def feed() -> None:
        for number in range(9):
            pump.submit(lambda: go_on.wait(SOON_S))
            started_tasks.append(number)

    feeder = threading.Thread(target=feed)
    feeder.start()
    feeder.join(0.2)
    assert len(started_tasks) <= 2  # one waits, and one is at work
    go_on.set()
    feeder.join(SOON_S)
    assert len(started_tasks) == 9

    def fail() -> None:
        raise OutputError("the disk is full")

    future = pump.submit(lambda: 3)
    future.result()
    pump.after(future, fail)
    for call in (lambda: pump.submit(lambda: 4), pump.close):
        with pytest.raises(OutputError, match="the disk is full"):
            call()


def test_an_interrupt_waits_for_what_is_being_written() -> None:
    pump = WritePump()
    written = []

    def write() -> None:
        time.sleep(0.2)
        signal.raise_signal(signal.SIGINT)
        time.sleep(0.2)
        written.append(True)

    pump.submit(write)
    with pytest.raises(KeyboardInterrupt):
        pump.close()
    assert written


def test_an_interrupt_of_a_wait_is_an_interrupt_and_the_result_still_comes() -> None:
    future = Future()
    waiter = threading.get_ident()

    def interrupt() -> None:
        time.sleep(0.1)
        signal.pthread_kill(waiter, signal.SIGINT)

    other = threading.Thread(target=interrupt)
    other.start()
    with pytest.raises(KeyboardInterrupt):
        wait_for_result(future)
    other.join()
    future.set_result(3)
    assert wait_for_result(future) == 3


def test_who_is_busiest_bounds_the_job() -> None:
    """10 s of one worker with two writing threads; then of two workers."""
    common_seconds = {
        "workers": 10.0,
        "renderers": 10.0,
        "writers": 20.0,
        "render": 9.0,
        "wait_for_files": 0.5,
    }

    def shares(**seconds: float):
        time_shares = compute_time_shares({**common_seconds, **seconds})
        assert time_shares is not None
        return time_shares

    for bound_by, seconds in (
        ("rendering", {"encode": 8.0, "write": 1.0}),
        ("encoding", {"render": 4.0, "wait_for_files": 6.0, "encode": 15.0, "write": 4.0}),
        ("writing to disk", {"render": 4.0, "wait_for_files": 6.0, "encode": 5.0, "write": 14.0}),
        ("LiDAR", {"render": 4.0, "wait_for_files": 6.0, "lidar": 19.0}),
        ("preparing effects", {"render": 2.0, "wait_for_files": 0.0, "open": 1.0, "prepare": 6.0}),
        # Nothing of the job's own explains where four fifths went.
        (
            "workers that start or have nothing to do",
            {"render": 2.0, "wait_for_files": 0.0, "open": 1.0},
        ),
    ):
        assert shares(**seconds).bound_by == bound_by
    both = {
        "workers": 20.0,
        "renderers": 16.0,
        "writers": 32.0,
        "render": 12.0,
        "wait_for_files": 2.0,
    }
    time_shares = shares(**both, encode=20.0)
    assert time_shares.rendering == 0.6 and time_shares.waiting_for_files == 0.1
    assert time_shares.other_work == pytest.approx(0.3)
    assert time_shares.writing["encoding"] == 0.5  # of four threads' 10 s


# ---- Worker processes ----------------------------------------------------------------------------


@pytest.fixture
def quick_workers(monkeypatch: pytest.MonkeyPatch) -> None:
    start_fork_server("tests.augment.batch_scenes", "augment.jobs.pools")
    monkeypatch.setattr("multiprocessing.get_context", quick_context)


@pytest.mark.usefixtures("quick_workers")
def test_a_dying_worker_costs_one_image_and_workers_change_no_file(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The third promise: workers take over the job's bed and maps. What they found themselves would
    show.
    """
    monkeypatch.setattr(
        "augment.exposure.exposed_surface.find_exposed_surface", lambda *_, **__: make_bed(3.0)
    )
    monkeypatch.setattr("augment.effects.style.style._find_maps", lambda *_: make_maps(0.4))
    style = Style(preset="dusk")
    recipes = [make_recipe(flood=Flood(level_m=0.3), snow=Snow(depth_m=0.1), style=style)]
    one_worker_dir = tmp_path / "one"
    run_fake(RenderJob("fake:street", recipes, one_worker_dir), bed_render)
    job = RenderJob("fake:street", recipes, tmp_path / "two", workers=2)
    result = run_fake(job, render_dying_at_frame_2)
    assert (result.written, result.failed) == (7, 1)
    assert "was killed by SIGKILL while rendering this image, and again" in result.failures[0]
    assert "images are tried once more, alone: its worker was killed by SIGKILL" in caplog.text
    failed = [r for r in read_manifest(job.out_dir).to_pylist() if r["status"] == "failed"]
    assert [(row["frame"], row["camera"]) for row in failed] == [(2, "front")]

    result = run_fake(dataclasses.replace(job, workers=1), bed_render)
    assert (result.written, result.skipped, result.failed) == (1, 7, 0)
    assert tree_digest(tmp_path / "two" / "street") == tree_digest(one_worker_dir / "street")
    manifest = (tmp_path / "two" / "manifest.parquet").read_bytes()
    assert manifest == (one_worker_dir / "manifest.parquet").read_bytes()


@pytest.mark.usefixtures("quick_workers")
def test_workers_finish_a_view_that_nothing_follows(tmp_path: Path, reference_digests) -> None:
    """They have it in flight when they have no more to do, and the job waits for it."""
    result = run_fake(fog_job(tmp_path, workers=2), begin_fake)
    assert result.written == 8 and result.timings["wait_for_views"] > 0
    assert 0 < result.timings["renderers"] < result.timings["workers"]
    assert tree_digest(tmp_path) == reference_digests


def test_what_cannot_be_sent_to_workers_is_refused(tmp_path: Path) -> None:
    class Local(FakeLabels):
        pass

    scene = dataclasses.replace(open_fake("fake:street"), labels=Local())
    for message, renderer, opened in (
        (r"renderer <function .*lambda.* cannot be sent", lambda *_, **__: None, open_fake),
        (r"cannot be sent to worker processes.*workers=1 works", fake_render, lambda _uri: scene),
    ):
        with pytest.raises(ValueError, match=message):
            run_fake(fog_job(tmp_path, workers=2), renderer, scene_loader=opened)
    assert not list(tmp_path.rglob("*.png")) + list(tmp_path.rglob("*.climategs-tmp"))


@pytest.mark.long
def test_a_worker_that_cannot_start_ends_the_job(tmp_path: Path, monkeypatch) -> None:
    module = types.ModuleType("only_in_this_process")
    exec("def render(*_, **__): ...", module.__dict__)
    monkeypatch.setitem(sys.modules, module.__name__, module)
    with pytest.raises(ClimateGSError, match=r"worker process ended with exit code 1 while start"):
        run_fake(fog_job(tmp_path, frames=[0], workers=2), module.render)


def test_a_shared_scene_is_the_scene(tmp_path: Path) -> None:
    """Every tensor to the bit, and no longer than needed on the disk."""
    scene = open_fake("fake:street")
    track = Track(torch.arange(2), torch.eye(4, dtype=torch.float64).expand(2, 4, 4))
    gaussians = dataclasses.replace(make_gaussians(2000), semantic=None)
    actor = Actor("7", "Car", gaussians, track, (4.0, 2.0, 1.5))
    sky = LatLongSky(torch.rand(4, 8, 3))
    maps = {"front": torch.rand(3, 4)}
    scene = dataclasses.replace(scene, actors=(actor,), sky=sky, color_maps=maps)
    shared = share_scene(scene, scene.frames, tmp_path)
    assert len(list(tmp_path.iterdir())) == 1
    assert len(shared.skeleton) < 20_000 < Path(shared.path).stat().st_size
    again, _ = shared.open()
    shared.remove()
    assert not list(tmp_path.iterdir())
    for ours, theirs in (
        (scene.background, again.background),
        (actor.gaussians, again.actors[0].gaussians),
        (track, again.actors[0].track),
        (scene.sky, again.sky),
        (scene.frames[1].cameras["front"], again.frames[1].cameras["front"]),
    ):
        for name, value in vars(ours).items():
            other = getattr(theirs, name)
            if isinstance(value, torch.Tensor):
                assert other.dtype == value.dtype and torch.equal(other, value)
            else:
                assert other == value
    assert torch.equal(again.color_maps["front"], maps["front"])
    assert again.labels == scene.labels
    again.background.means[0] = 0  # may be written to, as any tensor


def test_workers_share_the_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    monkeypatch.delenv("NUMBA_NUM_THREADS", raising=False)
    with thread_limits(4):
        assert os.environ["NUMBA_NUM_THREADS"] == "4"
        assert os.environ["OMP_NUM_THREADS"] == "1"  # the user's own limit stands
    assert "NUMBA_NUM_THREADS" not in os.environ
