"""What a job was bound by."""

from __future__ import annotations

import time
from pathlib import Path

import pytest
from batch_scenes import make_recipe, open_fake
from pending_views import Gpu

from augment.jobs.files import encode_image
from augment.jobs.render_job import RenderJob, run_job
from augment.jobs.worker import Shares, shares_of

# 10 s of one worker with two writing threads.
SECONDS = {"workers": 10.0, "renderers": 10.0, "writers": 20.0, "render": 9.0, "held": 0.5}


def bound(**seconds: float) -> Shares:
    shares = shares_of({**SECONDS, **seconds})
    assert shares is not None
    return shares


def test_who_is_busiest_bounds_the_job() -> None:
    assert bound(encode=8.0, write=1.0).bound_by == "rendering"
    assert bound(render=4.0, held=6.0, encode=15.0, write=4.0).bound_by == "encoding"
    assert bound(render=4.0, held=6.0, encode=5.0, write=14.0).bound_by == "writing to disk"
    assert bound(render=4.0, held=6.0, lidar=19.0).bound_by == "LiDAR"
    assert bound(render=2.0, held=0.0, open=1.0, prepare=6.0).bound_by == "preparing effects"
    # Nothing of the job's own explains where four fifths went.
    assert (
        bound(render=2.0, held=0.0, open=1.0).bound_by == "workers that start or have nothing to do"
    )


def test_shares_are_of_all_workers_from_begin_to_end() -> None:
    """Two workers of 10 s, of which their rendering threads were at it for 16 together."""
    shares = bound(workers=20.0, renderers=16.0, writers=32.0, render=12.0, held=2.0, encode=20.0)
    assert shares.rendering == 0.6 and shares.held == 0.1
    assert shares.beside == pytest.approx(0.3)
    assert shares.writing["encoding"] == 0.5  # of four threads' 10 s


@pytest.mark.parametrize("slow", ["rendering", "encoding"])
def test_a_job_measures_what_bounds_it(
    slow: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One of them sleeps: what else there is to do takes milliseconds."""

    class Slow(Gpu):
        def awaited(self, number: int) -> None:
            time.sleep(0.1 if slow == "rendering" else 0.0)

    def slow_encode(*arguments):
        time.sleep(0.2 if slow == "encoding" else 0.0)
        return encode_image(*arguments)

    monkeypatch.setattr("augment.jobs.files.encode_image", slow_encode)
    recipe = make_recipe("clear", depth="none", labels=False, lidar=False)
    job = RenderJob("fake:street", [recipe], tmp_path)
    result = run_job(job, scene_loader=open_fake, renderer=Slow(), progress=False)
    shares = shares_of(result.timings)
    assert shares is not None and shares.bound_by == slow, result.timings
    whole = shares.rendering + shares.held + shares.beside
    assert whole == pytest.approx(1)
    if slow == "rendering":
        assert shares.awaiting > 0.5 > shares.held
    else:
        assert shares.held > 0.5 > shares.rendering
