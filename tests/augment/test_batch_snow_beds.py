"""Where snow can lie is found once a job, for all of its images, and used again by later jobs."""

from __future__ import annotations

import dataclasses
import pickle
from collections.abc import Callable
from pathlib import Path

import cv2
import pytest
import torch
from batch_scenes import (
    bed_render,
    fake_render,
    make_bed,
    make_camera,
    make_frame,
    make_recipe,
    open_fake,
    tree_digest,
)

from augment.cameras import Frame
from augment.dataset import SceneDataset
from augment.effects import Sharing, share_effects
from augment.effects.snow import support as beds
from augment.effects.snow.placement import PlacementSettings
from augment.errors import OutputError, SceneError
from augment.jobs.render_job import JobResult, RenderJob, run_job
from augment.memo import memo_of
from recipes.schema import Recipe
from recipes.snow import Snow

FILES = ("*.png", "*.jsonl", "*.yaml", "*.json", "*.parquet")


class Placements(list):
    """Stands in for finding a bed: lists (settings, cameras) of every call.

    before: what to do at each call.
    """

    before: Callable[[], None] = staticmethod(lambda: None)

    def __call__(self, scene, cameras, settings, *, backend="auto", progress=False):
        self.before()
        self.append((settings, list(cameras)))
        return make_bed(len(self[-1][1]) + settings.cell_m)


@pytest.fixture
def placements(monkeypatch: pytest.MonkeyPatch) -> Placements:
    found = Placements()
    monkeypatch.setattr(beds, "place_snow_support", found)
    return found


def snowy(depth_m: float = 0.1, variant: int = 0, **snow) -> Recipe:
    return make_recipe(variant=variant, snow=Snow(depth_m=depth_m, **snow))


def run(job: RenderJob, renderer=fake_render, **options) -> JobResult:
    options = {"scene_loader": open_fake, "progress": False, **options}
    return run_job(job, renderer=renderer, **options)


def files_of(out: Path) -> list[Path]:
    return [path for pattern in FILES for path in out.rglob(pattern)]


def test_a_bed_is_found_for_all_cameras_before_any_file(placements, tmp_path: Path) -> None:
    placements.before = lambda: placements.append(files_of(tmp_path))
    job = RenderJob("fake:street", [snowy()], tmp_path, frames=[1], cameras=["front"])
    result = run(job)
    assert result.written == 1 and result.timings["prepare"] > 0
    before, (settings, cameras) = placements
    assert before == []
    assert settings == PlacementSettings(cell_m=0.05, max_slope_deg=50.0)
    expected = [camera for k in range(4) for camera in make_frame(k).cameras.values()]
    assert [(c.name, c.timestamp_ns) for c in cameras] == [
        (c.name, c.timestamp_ns) for c in expected
    ]
    # The other images need no second search.
    assert run(dataclasses.replace(job, frames=None, cameras=None)).written == 7
    assert len(placements) == 2


def test_another_depth_finds_the_bed_in_its_file(placements, tmp_path: Path) -> None:
    run(RenderJob("fake:street", [snowy(0.1)], tmp_path))
    placements.before = pytest.fail
    result = run(RenderJob("fake:street", [snowy(0.3, 1)], tmp_path), bed_render)
    assert (result.written, result.failures) == (8, ())


def test_where_there_can_be_no_snow_nothing_is_written_or_replaced(
    placements, tmp_path: Path
) -> None:
    def fails() -> None:
        raise SceneError("scene 'street' does not know its metres")

    run(RenderJob("fake:street", [make_recipe()], tmp_path, frames=[0]))
    before = tree_digest(tmp_path)
    placements.before = fails
    for overwrite, variant in ((False, 1), (True, 0)):
        job = RenderJob("fake:street", [snowy(0.1, variant)], tmp_path, overwrite=overwrite)
        with pytest.raises(SceneError, match="does not know its metres"):
            run(job)
        assert tree_digest(tmp_path) == before


def test_a_job_stopped_while_it_searches_goes_on(placements, tmp_path: Path) -> None:
    def stops() -> None:
        raise KeyboardInterrupt

    job = RenderJob("fake:street", [snowy()], tmp_path)
    placements.before = stops
    with pytest.raises(KeyboardInterrupt, match="0 of 8 images"):
        run(job)
    assert not files_of(tmp_path) and not list((tmp_path / ".climategs").glob("snow-*"))
    placements.before = lambda: None
    assert run(job).written == 8


def test_a_camera_path_has_a_bed_of_its_own(placements, tmp_path: Path) -> None:
    """And the caller's scene goes on with its own cameras' bed."""
    scene = open_fake("fake:street")
    recorded = make_frame(1)
    cameras = {"front": make_camera("front", recorded.timestamp_ns, 0.5)}
    path = [Frame(1, recorded.timestamp_ns, recorded.world_from_ego, cameras)]
    settings, found = PlacementSettings(), []

    def render(scene, camera, recipe, *, backend):
        found.append(beds.support_of(scene, settings))
        return fake_render(scene, camera, recipe, backend=backend)

    load = {"scene_loader": lambda _uri: scene}
    run(RenderJob("fake:street", [snowy()], tmp_path / "path", camera_path=path), render, **load)
    run(RenderJob("fake:street", [snowy()], tmp_path / "own", frames=[0]), render, **load)
    assert [len(cameras) for _, cameras in placements] == [1, 8]
    assert [bed.ground.centers_m[0, 0].item() for bed in found] == pytest.approx([1.05, 8.05, 8.05])
    # A path's job after it neither takes the scene's bed nor leaves its own.
    run(RenderJob("fake:street", [snowy()], tmp_path / "path2", camera_path=path), render, **load)
    assert found[-1].ground.centers_m[0, 0].item() == pytest.approx(1.05)
    assert beds.support_of(scene, settings).ground.centers_m[0, 0].item() == pytest.approx(8.05)


def test_beds_that_are_remembered_get_their_file_too(placements, tmp_path: Path) -> None:
    """One scene object, two output folders: workers of the second job need a file there."""
    scene, key = open_fake("fake:street"), ("snow support", PlacementSettings())
    for name in "ab":
        share_effects(Sharing(scene, [snowy()], folder=tmp_path / name))
        stored = memo_of(scene).shared()[key]
        assert Path(stored.path).parent == tmp_path / name and Path(stored.path).is_file()
    assert len(placements) == 1
    other = open_fake("fake:street")
    memo_of(other).update(pickle.loads(pickle.dumps(memo_of(scene).shared())))
    placements.before = pytest.fail
    same, again = (beds.support_of(s, PlacementSettings()) for s in (scene, other))
    assert torch.equal(same.ground.centers_m, again.ground.centers_m)


def test_a_folder_that_cannot_be_written_is_named(placements, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="file"):
        share_effects(
            Sharing(open_fake("fake:street"), [snowy()], folder=tmp_path / "file" / "state")
        )


def test_live_samples_share_one_search(placements) -> None:
    scene = open_fake("fake:street")
    live = SceneDataset(scene, snowy(), renderer=bed_render, frames=[0])
    assert len(placements) == 1 and len(placements[0][1]) == 8
    images = [live[k]["image"] for k in range(2)]
    assert len(placements) == 1
    state = {name: value for name, value in vars(live).items() if name != "scene"}
    again = SceneDataset.__new__(SceneDataset)
    again.__setstate__({**state, "scene": open_fake("fake:street")})  # as a worker receives it
    placements.before = pytest.fail
    assert all(torch.equal(again[k]["image"], images[k]) for k in range(2))


@pytest.mark.long
def test_the_librarys_own_snow_does_not_depend_on_how_a_job_went(tmp_path: Path) -> None:
    """Real beds and real pictures: whole, by two workers, and in parts that search anew."""
    recipe, uri = snowy(0.15, cell_m=0.2), "fake:street?frames=2"
    whole, shared, parts = (tmp_path / name for name in ("whole", "shared", "parts"))
    result = run(RenderJob(uri, [recipe], whole), None)
    assert (result.written, result.failures) == (4, ())
    assert run(RenderJob(uri, [recipe], shared, workers=2), None).failures == ()
    run(RenderJob(uri, [recipe], parts, frames=[1], cameras=["front"]), None)
    for bed in (parts / ".climategs").glob("snow-*"):
        bed.unlink()
    assert run(RenderJob(uri, [recipe], parts), None).skipped == 1
    for out in (shared, parts):
        assert tree_digest(out / "street") == tree_digest(whole / "street")
        assert (out / "manifest.parquet").read_bytes() == (whole / "manifest.parquet").read_bytes()
    masks = [cv2.imread(str(path), cv2.IMREAD_UNCHANGED) for path in whole.rglob("snow/*/*.png")]
    assert len(masks) == 4 and max(mask.mean() for mask in masks) > 0
