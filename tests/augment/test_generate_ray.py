"""Dataset jobs on a Ray cluster of this machine, with stand-in scenes and renderers."""

from __future__ import annotations

import os
import signal
import sys
import types
from functools import partial
from pathlib import Path

import pytest

from augment.errors import ClimateGSError
from augment.jobs.generate import run_generate
from augment.scene.cameras import Camera
from augment.scene.scene import Scene
from recipes.schema import Recipe
from tests.augment.batch_scenes import FakeView, fake_render, slow_render
from tests.augment.generate_jobs import leftovers, make_job, outputs

HERE = Path(__file__).parent
PATHS = os.pathsep.join([str(HERE), str(HERE.parents[1])])
CPUS = 2


@pytest.fixture(scope="module")
def cluster():
    """A cluster whose workers can import what the tests do."""
    ray = pytest.importorskip("ray")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("RAY_USAGE_STATS_ENABLED", "0")
        ray.init(
            address="local",
            num_cpus=CPUS,
            num_gpus=1,  # says Ray: nobody asks it for one
            include_dashboard=False,
            log_to_driver=False,
            logging_level="ERROR",
            object_store_memory=100 << 20,
            runtime_env={"env_vars": {"PYTHONPATH": PATHS}},
        )
        yield ray
        ray.shutdown()


def serial(out: Path, *scenes: list[str]) -> dict[str, str]:
    """Digests of what one process renders."""
    run_generate(make_job(out, *scenes), progress=False)
    return outputs(out)


def dying_once(
    scene: Scene, camera: Camera, recipe: Recipe, *, backend: str, marker: Path
) -> FakeView:
    """Kills its process at the second frame, the first time that any process comes to it."""
    if camera.timestamp_ns == scene.frames[1].timestamp_ns:
        try:
            marker.touch(exist_ok=False)
        except FileExistsError:
            pass
        else:
            os.kill(os.getpid(), signal.SIGKILL)
    return fake_render(scene, camera, recipe, backend=backend)


@pytest.mark.long
@pytest.mark.usefixtures("cluster")
def test_job_gives_the_serial_bytes_with_too_few_cpus_and_an_actor_killed(tmp_path):
    """Two promises in one test, for every start of an actor imports torch anew."""
    marker = tmp_path / "killed"
    image_counts = []
    job = make_job(
        tmp_path / "out",
        executor="ray",
        workers=CPUS + 1,  # one finds no place
        renderer=partial(dying_once, marker=marker),
    )
    result = run_generate(
        job, progress=False, on_image=lambda done, failed: image_counts.append(done)
    )
    assert marker.exists()
    assert result.failed == 0, result.failures
    assert outputs(tmp_path / "out") == serial(tmp_path / "serial")
    assert not leftovers(tmp_path / "out")
    assert len(set(image_counts)) > 8, (
        f"images are told of one by one, not in blocks: {image_counts}"
    )


@pytest.mark.long
@pytest.mark.usefixtures("cluster")
def test_interrupt_lets_actors_finish_their_images(tmp_path):
    def interrupt(done: int, failed: int) -> None:
        if done:
            raise KeyboardInterrupt

    job = make_job(tmp_path / "out", executor="ray", workers=1, renderer=slow_render)
    with pytest.raises(KeyboardInterrupt, match="stopped"):
        run_generate(job, progress=False, on_image=interrupt)
    claim_files = [path for path in leftovers(tmp_path / "out") if "claims" in path]
    assert not claim_files, "a killed actor would have left its claim"
    result = run_generate(make_job(tmp_path / "out"), progress=False)
    assert result.written < 28, "what was finished is not rendered again"
    assert outputs(tmp_path / "out") == serial(tmp_path / "serial")


@pytest.mark.long
@pytest.mark.usefixtures("cluster")
def test_scenes_that_actors_cannot_import_end_the_job(tmp_path, monkeypatch):
    module = types.ModuleType("only_on_this_machine")
    exec("def opener(uri): ...", module.__dict__)
    monkeypatch.setitem(sys.modules, module.__name__, module)
    job = make_job(tmp_path / "out", executor="ray", workers=1, opener=module.opener)
    with pytest.raises(ClimateGSError, match=r"while starting.*only_on_this_machine"):
        run_generate(job, progress=False)


def test_without_ray_it_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(ClimateGSError, match=r"pip install \"climategs\[ray\]\""):
        run_generate(make_job(tmp_path / "out", executor="ray"), progress=False)


def test_ray_client_is_refused(tmp_path, monkeypatch):
    ray = pytest.importorskip("ray")
    monkeypatch.setattr(ray, "is_initialized", lambda: False)
    monkeypatch.setenv("RAY_ADDRESS", "ray://head:10001")
    with pytest.raises(ClimateGSError, match="client protocol"):
        run_generate(make_job(tmp_path / "out", executor="ray"), progress=False)
