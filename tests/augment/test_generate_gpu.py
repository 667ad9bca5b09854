"""Dataset jobs where a GPU renders, or seems to: who does the work, and what never mixes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from generate_jobs import make_job, make_recipes, outputs, raising_render

from augment.errors import GpuLost, OutputError
from augment.jobs.generate import GenerateJob, Workers, plan_job, run_generate
from augment.jobs.processes import available_cores, renders_on_gpu
from augment.jobs.worker import shares_of

SCENES = ["fake:a?frames=2"]


def job_of(out: Path, backend: str, **options) -> GenerateJob:
    job = make_job(out, SCENES, make_recipes(["fog"]), **options)
    return replace(job, setup=replace(job.setup, backend=backend))


def slots_of(job: GenerateJob) -> int:
    workers = Workers(job)
    workers.close()
    return workers.slots


def test_one_process_where_a_gpu_renders(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    on_gpu = job_of(tmp_path, "cuda", executor="processes")
    assert slots_of(on_gpu) == 1 and slots_of(replace(on_gpu, workers=3)) == 3
    assert slots_of(job_of(tmp_path, "cpu", executor="processes")) == available_cores()
    monkeypatch.setattr("augment.render.cuda.runtime.has_gpu", lambda: True)
    assert renders_on_gpu("auto") and not renders_on_gpu("cpu")
    assert slots_of(job_of(tmp_path, "auto", executor="processes")) == 1


def test_auto_gets_its_name_where_there_is_a_gpu(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    job = job_of(tmp_path, "auto", renderer=None)
    assert plan_job(job, progress=False).backend == "auto"
    monkeypatch.setattr("augment.render.cuda.runtime.has_gpu", lambda: True)
    on_gpu = plan_job(job, progress=False)
    assert on_gpu.backend == "cuda"
    assert on_gpu.blocks[0].key == plan_job(job_of(tmp_path, "cuda"), progress=False).blocks[0].key
    assert plan_job(job_of(tmp_path, "cpu"), progress=False).backend == "cpu"
    assert plan_job(job_of(tmp_path, "auto"), progress=False).backend == "auto"  # a stand-in's own


@pytest.mark.parametrize(("first", "second"), [("cuda", "auto"), ("auto", "cuda")])
def test_pictures_of_a_gpu_and_a_cpu_never_mix(tmp_path: Path, first: str, second: str) -> None:
    run_generate(job_of(tmp_path, first), progress=False)
    before = outputs(tmp_path)
    with pytest.raises(OutputError, match=rf"backend there '{first}', here '{second}'"):
        run_generate(job_of(tmp_path, second), progress=False)
    assert outputs(tmp_path) == before


def test_a_lost_gpu_fails_no_block(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    job = job_of(tmp_path, "cuda", renderer=raising_render)
    with monkeypatch.context() as patch:
        patch.setattr("augment.jobs.worker.gpu_is_lost", lambda backend: True)
        with pytest.raises(GpuLost, match="since frame 1, camera front"):
            run_generate(job, progress=False)
    result = run_generate(job_of(tmp_path, "cuda"), progress=False)
    assert result.failed == 0 and result.written + result.skipped == 4


def test_a_dataset_job_measures_what_bound_it(tmp_path: Path) -> None:
    result = run_generate(job_of(tmp_path, "auto"), progress=False)
    timings = result.timings
    assert 0 < timings["renderers"] < timings["workers"] <= timings["render_wall"]
    assert timings["publish"] > 0
    shares = shares_of(timings)
    assert shares is not None
    assert shares.rendering + shares.held + shares.beside == pytest.approx(1)
    assert shares_of(run_generate(job_of(tmp_path, "auto"), progress=False).timings) is None
