"""Worker processes: the same files as one process makes, and no harm from their death."""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path

import pytest
from batch_scenes import (
    fake_render,
    make_recipe,
    open_fake,
    render_dying_at_frame_2,
    tree_digest,
)

from augment.batch.executors import _thread_limits, available_cores
from augment.batch.job import RenderJob, run_job
from augment.batch.manifest import read_manifest
from augment.errors import SceneError
from augment.scene import Scene


def test_a_dying_worker_costs_one_image_and_workers_change_no_file(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Two promises in one test, for every start of a worker imports torch anew."""
    recipes = [make_recipe()]
    one = tmp_path / "one"
    run_job(RenderJob("fake:street", recipes, one), scene_loader=open_fake, renderer=fake_render,
            progress=False)  # fmt: skip
    job = RenderJob("fake:street", recipes, tmp_path / "two", workers=2)
    result = run_job(job, scene_loader=open_fake, renderer=render_dying_at_frame_2, progress=False)
    assert (result.written, result.failed) == (7, 1)
    assert "was killed by SIGKILL while rendering this image, and again" in result.failures[0]
    assert "a worker process was killed by SIGKILL; its images are tried once more" in caplog.text
    failed = [r for r in read_manifest(job.out_dir).to_pylist() if r["status"] == "failed"]
    assert [(row["frame"], row["camera"]) for row in failed] == [(2, "front")]

    alone = dataclasses.replace(job, workers=1)
    result = run_job(alone, scene_loader=open_fake, renderer=fake_render, progress=False)
    assert (result.written, result.skipped, result.failed) == (1, 7, 0)
    assert tree_digest(tmp_path / "two") == tree_digest(one)


def test_what_workers_call_must_be_importable(tmp_path: Path) -> None:
    def local_loader(uri: str) -> Scene:
        return open_fake(uri)

    job = RenderJob("fake:street", [make_recipe()], tmp_path, workers=2)
    with pytest.raises(ValueError, match=r"scene_loader .*local_loader.* cannot be sent to"):
        run_job(job, scene_loader=local_loader, renderer=fake_render, progress=False)
    assert not list(tmp_path.rglob("*.png"))


def test_a_worker_that_cannot_open_the_scene_says_why(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setenv("BATCH_SCENES_PARENT", str(os.getpid()))
    job = RenderJob("fake:street?only_parent=1", [make_recipe()], tmp_path, frames=[0], workers=2)
    with pytest.raises(SceneError, match=r"opening fake:street.* in a worker process: .*no memory"):
        run_job(job, scene_loader=open_fake, renderer=fake_render, progress=False)


def test_workers_share_the_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    monkeypatch.delenv("NUMBA_NUM_THREADS", raising=False)
    with _thread_limits(4):
        assert os.environ["NUMBA_NUM_THREADS"] == "4"
        assert os.environ["OMP_NUM_THREADS"] == "1"  # the user's own limit stands
    assert "NUMBA_NUM_THREADS" not in os.environ
    assert available_cores() >= 1
