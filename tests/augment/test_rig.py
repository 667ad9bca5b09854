"""Several views drawn at once: the bits, files and errors of one after the other."""

from __future__ import annotations

import dataclasses
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch
from torch.utils.data import DataLoader

import augment.view.render_view
from augment.dataset import SceneDataset
from augment.jobs.render_job import JobResult, RenderJob, run_job
from augment.render.cpu.order import spatial_order
from augment.render.threads import (
    has_concurrent_kernels,
    limit_threads,
    num_kernel_threads,
    split_threads,
)
from augment.scene.cameras import Camera
from augment.scene.scene import Gaussians, Scene
from augment.view.render_view import ViewPool, begin_view, render_view, render_views
from augment.view.results import WeatheredView
from recipes.flood import Flood
from recipes.rain import Rain
from recipes.schema import Output, Recipe, Render, Weather
from recipes.smog import Smog
from recipes.snow import Snow
from tests.augment.batch_scenes import tree_digest
from tests.scenes import random_gaussians
from tests.streets import LABELLED_STREET, open_street

IMAGES = Output(depth="expected", semantic=True, instance=True, labels=True)
RECIPES = {
    "clean": Recipe(name="clean", output=IMAGES),
    "winter": Recipe(
        name="winter",
        output=IMAGES,
        weather=Weather(smog=Smog(visibility_m=80), snow=Snow(depth_m=0.1, cell_m=0.2)),
    ),
    "wet": Recipe(
        name="wet", weather=Weather(rain=Rain(rate_mm_h=20), flood=Flood(level_m=0.1)),
        render=Render(scale=0.5),
    ),
}  # fmt: skip


@pytest.fixture(autouse=True)
def threads() -> Iterator[None]:
    limit_threads(None)
    if num_kernel_threads() < 2 or not has_concurrent_kernels():
        pytest.skip("views are drawn at once where this process may use two cores and has TBB")
    yield
    limit_threads(1)


@pytest.fixture(scope="module")
def scene() -> Scene:
    return open_street(LABELLED_STREET)


def cameras_of(scene: Scene) -> list[Camera]:
    """Of two frames and of different sizes, so that later views are done before earlier ones."""
    cameras = [c for frame in scene.frames for c in [*frame.cameras.values()][:3]]
    return [camera.scaled(1.0 if n % 2 else 0.3) for n, camera in enumerate(cameras)]


def assert_same(a: WeatheredView, b: WeatheredView) -> None:
    for name in ("rgb", "depth_m", "semantic", "instance"):
        assert np.array_equal(getattr(a, name), getattr(b, name)), name
    assert a.masks.keys() == b.masks.keys()
    assert all(np.array_equal(a.masks[name], b.masks[name]) for name in a.masks)


@pytest.mark.parametrize("name", RECIPES)
def test_views_drawn_at_once_have_the_bits_of_those_drawn_one_by_one(scene, name) -> None:
    recipe, cameras = RECIPES[name], cameras_of(scene)
    fresh = dataclasses.replace(scene)  # nothing is prepared: threads want the same at once
    together = list(render_views(fresh, cameras, recipe))
    assert len(together) == 6
    for camera, view in zip(cameras, together, strict=True):
        assert_same(view, render_view(fresh, camera, recipe))
    assert list(render_views(fresh, [], recipe)) == []


def orthographic(camera: Camera) -> Camera:
    """Smog cannot be drawn for it."""
    return dataclasses.replace(camera, is_orthographic=True)


def test_an_error_names_its_camera_and_comes_after_the_views_before_it(scene) -> None:
    cameras = cameras_of(scene)
    cameras[2] = dataclasses.replace(orthographic(cameras[2]), name="from above")
    views = render_views(scene, cameras, RECIPES["winter"])
    assert [next(views).camera.name for _ in range(2)] == [c.name for c in cameras[:2]]
    with pytest.raises(ValueError, match="is orthographic") as caught:
        next(views)
    assert any("camera 'from above' at" in note for note in caught.value.__notes__)


def test_scenes_of_too_many_splats_are_drawn_one_by_one(scene) -> None:
    """A second work space would take more than half a GiB. No memory is taken for the splats."""
    one, count = random_gaussians(1, sh_degree=0), 5_000_000
    columns = (one.means, one.quats, one.scales, one.opacities, one.sh)
    many = Gaussians(*(column.expand(count, *column.shape[1:]) for column in columns))
    with ViewPool(dataclasses.replace(scene, background=many), "cpu") as pool:
        assert pool.num_in_flight == 0
    with ViewPool(scene, "cpu") as pool:
        assert pool.num_in_flight == num_kernel_threads()
    with ViewPool(scene, "reference") as pool:
        assert pool.num_in_flight == 0


# ---- Threads -------------------------------------------------------------------------------------


def test_threads_divide_what_the_process_may_use() -> None:
    whole, of_torch, together = num_kernel_threads(), torch.get_num_threads(), threading.Barrier(2)

    def shares() -> tuple[int, int]:
        together.wait(10)  # so that each thread takes one
        return num_kernel_threads(), torch.get_num_threads()

    with split_threads(2) as pool:
        found = [task.result() for task in [pool.submit(shares) for _ in range(2)]]
    assert sum(own for own, _ in found) == whole
    assert all(own_of_torch <= max(own, 1) for own, own_of_torch in found)
    assert (num_kernel_threads(), torch.get_num_threads()) == (whole, of_torch)
    with ThreadPoolExecutor(1) as pool:  # threads begun later have what the process had
        assert pool.submit(torch.get_num_threads).result() == of_torch


def test_threads_that_draw_the_same_gaussians_find_one_order() -> None:
    """Another order would drop what is known of the first, frame after frame."""
    gaussians, together = random_gaussians(40_000, sh_degree=0), threading.Barrier(4)

    def find() -> list:
        together.wait(10)
        return [spatial_order(gaussians) for _ in range(3)]

    with ThreadPoolExecutor(4) as pool:
        found = [task.result() for task in [pool.submit(find) for _ in range(4)]]
    orders = [order for own in found for order in own]
    assert len({id(order) for order in orders if order is not None}) == 1
    assert sum(order is None for order in orders) == 1
    assert orders[-1] is not None
    assert orders[-1].sorted(gaussians.scales) is orders[-1].sorted(gaussians.scales)


# ---- Jobs and datasets ---------------------------------------------------------------------------


def job(scene: Scene, out, **options) -> JobResult:
    own = RenderJob(scene.source, [RECIPES["winter"]], out, cameras=["front", "left"])
    return run_job(own, scene_loader=lambda _: scene, progress=False, **options)


@pytest.fixture(scope="module")
def single(scene, tmp_path_factory) -> dict[str, str]:
    """The files of a job that draws one view after the other."""
    out = tmp_path_factory.mktemp("single")
    limit_threads(1)
    assert job(scene, out).written == 4
    limit_threads(None)
    return tree_digest(out)


def test_a_job_delivers_in_order_what_it_draws_at_once(scene, single, tmp_path) -> None:
    told = []
    assert job(scene, tmp_path, on_outcome=told.append).written == 4
    assert tree_digest(tmp_path) == single
    assert sorted((o.frame, o.camera) for o in told) == [
        (frame, name) for frame in (0, 1) for name in ("front", "left")
    ]


def test_a_view_that_fails_takes_no_other_with_it(scene, single, tmp_path, monkeypatch) -> None:
    dark = scene.frames[0].cameras["left"]

    def begin(scene, camera, recipe, *, backend):
        if (camera.name, camera.timestamp_ns) == (dark.name, dark.timestamp_ns):
            raise RuntimeError("no light")
        return begin_view(scene, camera, recipe, backend=backend)

    with monkeypatch.context() as patched:
        patched.setattr(augment.view.render_view, "begin_view", begin)
        result = job(scene, tmp_path)
    assert (result.written, result.failed) == (3, 1)
    assert result.failures[0].endswith("frame 0, camera left: rendering: RuntimeError: no light")
    result = job(scene, tmp_path)
    assert (result.written, result.skipped) == (1, 3)
    assert tree_digest(tmp_path) == single


def test_an_interrupted_job_goes_on_where_it_was(scene, single, tmp_path) -> None:
    def interrupt(outcome) -> None:
        if outcome.frame == 0 and outcome.camera == "front":
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt, match="of 4 images finished"):
        job(scene, tmp_path, on_outcome=interrupt)
    result = job(scene, tmp_path)
    assert result.skipped >= 1 and result.skipped + result.written == 4
    assert tree_digest(tmp_path) == single


def test_a_batch_of_a_live_scene_has_the_samples_drawn_alone(scene) -> None:
    live = SceneDataset(scene, RECIPES["winter"], cameras=["front", "left"], image_type="uint8")
    (batch,) = DataLoader(live, batch_size=4, collate_fn=list)
    assert len(batch) == len(live) == 4
    for index, sample in enumerate(batch):
        alone = live[index]
        assert (sample["frame"], sample["camera"]["name"]) == (
            alone["frame"],
            alone["camera"]["name"],
        )
        for name in ("image", "depth", "semantic", "instance", "snow"):
            assert torch.equal(sample[name], alone[name]), name
