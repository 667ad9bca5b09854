"""Views in flight and files beside them: the same files, whatever waits for what."""

from __future__ import annotations

import dataclasses
import signal
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
import pytest
from batch_scenes import FakeLabels, fake_render, make_recipe, open_fake, tree_digest
from pending_views import Gpu
from pretend_gpu import pretended_gpu

from augment.errors import GpuLost, OutputError
from augment.jobs import worker as runner
from augment.jobs.files import WritePump
from augment.jobs.manifest import read_manifest
from augment.jobs.render_job import JobResult, RenderJob, run_job

SOON_S = 10.0  # for what takes no time, on a machine that is busy


def run(job: RenderJob, renderer=fake_render, **options) -> JobResult:
    options = {"scene_loader": open_fake, "progress": False, **options}
    return run_job(job, renderer=renderer, **options)


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> dict[str, str]:
    """Digests of what a renderer that waits gives: 4 frames of 2 cameras."""
    out = tmp_path_factory.mktemp("whole")
    run(RenderJob("fake:street", [make_recipe()], out))
    return tree_digest(out)


def test_the_next_view_is_begun_before_the_last_is_waited_for(tmp_path: Path, whole) -> None:
    gpu = Gpu()
    result = run(RenderJob("fake:street", [make_recipe()], tmp_path), gpu)
    assert result.written == 8
    expected = [("begin", 0)]
    for number in range(1, 8):
        expected += [("begin", number), ("await", number - 1)]
    assert gpu.notes == [*expected, ("await", 7)]
    assert tree_digest(tmp_path) == whole


def test_failures_are_those_of_the_view_they_happen_to(tmp_path: Path, whole) -> None:
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
    result = run(RenderJob("fake:street", [make_recipe()], tmp_path), gpu)
    assert (result.written, result.failed) == (5, 3)
    rows = read_manifest(tmp_path).to_pylist()
    messages = {(r["frame"], r["camera"]): r["message"] for r in rows if r["status"] == "failed"}
    assert messages == {
        (1, "front"): "rendering: RuntimeError: the copies of view 2 did not come",
        (1, "rear/left"): "rendering: MemoryError: no room for the lists of view 3",
        (3, "rear/left"): "rendering: RuntimeError: the copies of view 7 did not come",
    }
    assert [n for kind, n in gpu.notes if kind == "await"] == [0, 1, 2, 4, 5, 6, 7]
    run(RenderJob("fake:street", [make_recipe()], tmp_path))
    assert tree_digest(tmp_path) == whole


def test_a_lost_gpu_ends_the_run_and_fails_no_image(tmp_path: Path, monkeypatch, whole) -> None:
    class Lost(Gpu):
        def awaited(self, number: int) -> None:
            if number >= 3:
                raise RuntimeError("CUDA error: an illegal memory access was encountered")

    job = RenderJob("fake:street", [make_recipe()], tmp_path)
    with monkeypatch.context() as patch:
        patch.setattr(runner, "gpu_is_lost", lambda backend: True)
        with pytest.raises(GpuLost, match=r"since frame 1, camera rear/left \(rendering: "):
            run(job, Lost())
    result = run(job)
    assert (result.written, result.skipped, result.failed) == (5, 3, 0)
    assert tree_digest(tmp_path) == whole


def test_an_interrupt_lands_what_is_in_flight(tmp_path: Path, whole) -> None:
    class Interrupted(Gpu):
        waits = 0

        def awaited(self, number: int) -> None:
            self.waits += 1
            if self.waits == 3:  # once, while it waits for view 2
                raise KeyboardInterrupt
            super().awaited(number)

    gpu = Interrupted()
    with pytest.raises(KeyboardInterrupt, match="stopped with 3 of 8 images finished"):
        run(RenderJob("fake:street", [make_recipe()], tmp_path), gpu)
    assert gpu.notes[-1] == ("await", 2)
    result = run(RenderJob("fake:street", [make_recipe()], tmp_path))
    assert (result.written, result.skipped) == (5, 3)
    assert tree_digest(tmp_path) == whole


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


def test_pictures_do_not_wait_for_their_sweep(tmp_path: Path, whole) -> None:
    """With one thread for the sweep and one for pictures: both of the frame are written, and none
    is told of before the sweep is there.
    """
    labels, told = SlowSweeps(), []
    scene = dataclasses.replace(open_fake("fake:street"), labels=labels)

    def let_come() -> None:
        deadline = time.monotonic() + SOON_S
        while len(list(tmp_path.rglob("images/*/*.png"))) < 2 and time.monotonic() < deadline:
            time.sleep(0.01)
        written.append(len(list(tmp_path.rglob("images/*/*.png"))))
        assert not told
        labels.come.set()

    written: list[int] = []
    watcher = threading.Thread(target=let_come)
    watcher.start()
    job = RenderJob("fake:street", [make_recipe()], tmp_path, frames=[0])
    result = run(job, scene_loader=lambda _uri: scene, on_outcome=told.append)
    watcher.join()
    assert written == [2] and result.written == len(told) == 2
    found = tree_digest(tmp_path / "street/fog-000/images")
    stem = "street/fog-000/images/"
    assert found == {k: whole[stem + k] for k in found} and len(found) == 2


def test_pictures_of_a_sweep_that_fails_are_taken_back(tmp_path: Path) -> None:
    labels = SlowSweeps(message="the file is cut short")
    scene = dataclasses.replace(open_fake("fake:street"), labels=labels)
    started = []

    def render(*arguments, **options):
        started.append(1)
        if len(started) == 2:
            labels.come.set()
        return fake_render(*arguments, **options)

    job = RenderJob("fake:street", [make_recipe()], tmp_path, frames=[0])
    result = run(job, render, scene_loader=lambda _uri: scene)
    assert result.failed == 2 and "EOFError: the file is cut short" in result.failures[0]
    assert not list(tmp_path.rglob("*.png"))


def test_no_more_views_wait_than_memory_is_meant_for(tmp_path: Path, monkeypatch) -> None:
    held, most = [0], [0]
    lock = threading.Lock()

    def counting(*arguments, **options):
        with lock:
            held[0] += 1
            most[0] = max(most[0], held[0])
        return fake_render(*arguments, **options)

    write_view = runner.write_view

    def slow_write(*arguments):
        time.sleep(0.005)
        written = write_view(*arguments)
        with lock:
            held[0] -= 1
        return written

    monkeypatch.setattr(runner, "write_view", slow_write)
    recipe = make_recipe(lidar=False)
    run(RenderJob("fake:street?frames=20", [recipe], tmp_path), counting)
    assert held[0] == 0 and most[0] <= 5  # four in the pump, and the one that is handed over


def test_what_fails_after_a_task_stops_the_pump() -> None:
    pump = WritePump(threads=1, waiting=2)
    future = pump.submit(lambda: 3)
    future.result()

    def fail() -> None:
        raise OutputError("the disk is full")

    pump.after(future, fail)
    with pytest.raises(OutputError, match="the disk is full"):
        pump.submit(lambda: 4)
    with pytest.raises(OutputError, match="the disk is full"):
        pump.close()


def test_an_interrupt_waits_for_what_is_being_written() -> None:
    pump, written = WritePump(), []

    def write() -> None:
        time.sleep(0.2)
        signal.raise_signal(signal.SIGINT)
        time.sleep(0.2)
        written.append(True)

    pump.submit(write)
    with pytest.raises(KeyboardInterrupt):
        pump.close()
    assert written


@pytest.mark.long
def test_a_job_on_a_gpu_gives_the_pictures_of_the_cpu(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Drawn as jobs draw there, one view in flight, and one by one: the same bytes."""
    pytest.importorskip("triton")
    from augment.views import render_view

    def of_job(folder: str, backend: str, renderer=None) -> RenderJob:
        job = RenderJob(
            "fake:street", [make_recipe()], tmp_path / folder, frames=[1], backend=backend
        )
        assert run(job, renderer).failures == ()
        return job

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
