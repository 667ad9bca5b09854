"""Worker processes: the same files as one process makes, and no harm from their death."""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path

import pytest
import torch
from batch_scenes import (
    FakeLabels,
    bed_render,
    fake_render,
    make_bed,
    make_gaussians,
    make_maps,
    make_recipe,
    open_fake,
    render_dying_at_frame_2,
    tree_digest,
)
from fork_server import quick_context, start_fork_server
from pending_views import begin_fake

from augment.errors import ClimateGSError
from augment.jobs.manifest import read_manifest
from augment.jobs.processes import available_cores, share_scene, thread_limits
from augment.jobs.render_job import RenderJob, run_job
from augment.scene import Actor, Track
from augment.sky import LatLongSky
from recipes.flood import Flood
from recipes.snow import Snow
from recipes.style import Style


def test_a_dying_worker_costs_one_image_and_workers_change_no_file(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The third promise: workers take over the job's bed and maps. What they found themselves would
    show.
    """
    start_fork_server("batch_scenes", "augment.jobs.pools")
    monkeypatch.setattr("multiprocessing.get_context", quick_context)
    monkeypatch.setattr(
        "augment.effects.snow.support.place_snow_support", lambda *_, **__: make_bed(3.0)
    )
    monkeypatch.setattr("augment.effects.style.style._find_maps", lambda *_: make_maps(0.4))
    style = Style(preset="dusk")
    recipes = [make_recipe(flood=Flood(level_m=0.3), snow=Snow(depth_m=0.1), style=style)]
    one = tmp_path / "one"
    run_job(RenderJob("fake:street", recipes, one), scene_loader=open_fake, renderer=bed_render,
            progress=False)  # fmt: skip
    job = RenderJob("fake:street", recipes, tmp_path / "two", workers=2)
    result = run_job(job, scene_loader=open_fake, renderer=render_dying_at_frame_2, progress=False)
    assert (result.written, result.failed) == (7, 1)
    assert "was killed by SIGKILL while rendering this image, and again" in result.failures[0]
    assert "images are tried once more, alone: its worker was killed by SIGKILL" in caplog.text
    failed = [r for r in read_manifest(job.out_dir).to_pylist() if r["status"] == "failed"]
    assert [(row["frame"], row["camera"]) for row in failed] == [(2, "front")]

    alone = dataclasses.replace(job, workers=1)
    result = run_job(alone, scene_loader=open_fake, renderer=bed_render, progress=False)
    assert (result.written, result.skipped, result.failed) == (1, 7, 0)
    assert tree_digest(tmp_path / "two" / "street") == tree_digest(one / "street")
    manifest = (tmp_path / "two" / "manifest.parquet").read_bytes()
    assert manifest == (one / "manifest.parquet").read_bytes()


def test_workers_finish_a_view_that_nothing_follows(tmp_path: Path, monkeypatch) -> None:
    """They have it in flight when they have no more to do, and the job waits for it."""
    start_fork_server("batch_scenes", "augment.jobs.pools")
    monkeypatch.setattr("multiprocessing.get_context", quick_context)
    job = RenderJob("fake:street", [make_recipe()], tmp_path / "begun", workers=2)
    result = run_job(job, scene_loader=open_fake, renderer=begin_fake, progress=False)
    assert result.written == 8 and result.timings["await"] > 0
    assert 0 < result.timings["renderers"] < result.timings["workers"]
    alone = RenderJob("fake:street", [make_recipe()], tmp_path / "drawn")
    run_job(alone, scene_loader=open_fake, renderer=fake_render, progress=False)
    assert tree_digest(tmp_path / "begun") == tree_digest(tmp_path / "drawn")


def test_a_renderer_that_workers_cannot_import_is_refused(tmp_path: Path) -> None:
    job = RenderJob("fake:street", [make_recipe()], tmp_path, workers=2)
    with pytest.raises(ValueError, match=r"renderer <function .*lambda.* cannot be sent to worker"):
        run_job(job, scene_loader=open_fake, renderer=lambda *_, **__: None, progress=False)
    assert not list(tmp_path.rglob("*.png"))


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


def test_labels_that_cannot_be_sent_are_refused(tmp_path: Path) -> None:
    class Local(FakeLabels):
        pass

    scene = dataclasses.replace(open_fake("fake:street"), labels=Local())
    job = RenderJob("fake:street", [make_recipe()], tmp_path, workers=2)
    with pytest.raises(ValueError, match=r"cannot be sent to worker processes.*workers=1 works"):
        run_job(job, scene_loader=lambda _uri: scene, renderer=fake_render, progress=False)
    assert not list(tmp_path.rglob("*.climategs-tmp"))


def test_a_worker_that_cannot_start_ends_the_job(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr("augment.jobs.pools._main", os.abort)
    job = RenderJob("fake:street", [make_recipe()], tmp_path, frames=[0], workers=2)
    with pytest.raises(ClimateGSError, match=r"worker process ended with exit code 1 while start"):
        run_job(job, scene_loader=open_fake, renderer=fake_render, progress=False)


def test_workers_share_the_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    monkeypatch.delenv("NUMBA_NUM_THREADS", raising=False)
    with thread_limits(4):
        assert os.environ["NUMBA_NUM_THREADS"] == "4"
        assert os.environ["OMP_NUM_THREADS"] == "1"  # the user's own limit stands
    assert "NUMBA_NUM_THREADS" not in os.environ
    assert available_cores() >= 1
