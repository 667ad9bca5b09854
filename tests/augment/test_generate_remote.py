"""Dataset jobs whose output is in an object store that fails, killed and gone on with."""

from __future__ import annotations

import hashlib
from pathlib import Path
from types import SimpleNamespace

import pytest
from generate_jobs import image_name, make_job, make_recipes, outputs
from s3_server import s3_server

from augment.jobs.blocks import read_status
from augment.jobs.claims import ClaimTimes
from augment.jobs.generate import run_generate
from augment.jobs.store import open_store


def test_a_remote_output_has_the_files_of_a_local_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Requests fail now and then; the job is stopped twice, and what was finished stays so."""
    lazy = SimpleNamespace(collect=lambda: None)
    monkeypatch.setattr("augment.jobs.block_worker.gc", lazy)
    monkeypatch.setattr("augment.jobs.claims.CLAIM_TIMES", ClaimTimes(0.2))
    scenes, recipes = ["fake:a?frames=3"], make_recipes(["fog"], block_images=2)
    run_generate(make_job(tmp_path / "local", scenes, recipes), progress=False)
    whole = outputs(tmp_path / "local")
    rendered: list[str] = []
    stop_at = [2, 5, -1]

    def renderer(scene, camera, recipe, *, backend):
        if len(rendered) == stop_at[0]:
            raise KeyboardInterrupt
        rendered.append(image_name(scene, camera, recipe))
        return make_job("x").setup.renderer(scene, camera, recipe, backend=backend)

    with s3_server() as server:
        uri = server.uri("out")
        job = make_job(uri, scenes, recipes, renderer=renderer, scratch=tmp_path / "scratch")
        while stop_at:
            server.fail(1, status=503, method="PUT")
            server.fail(1, cut="answer", method="PUT", path="images")
            if stop_at[0] >= 0:
                with pytest.raises(KeyboardInterrupt, match="start the same job again"):
                    run_generate(job, progress=False)
            else:
                result = run_generate(job, progress=False)
                assert result.failed == 0
            stop_at.pop(0)
        assert len(rendered) == len(set(rendered)) == 6
        store = open_store(uri)
        there = {path for path in store.list("") if not path.startswith(".climategs")}
        assert there == whole.keys()
        assert {p: hashlib.sha256(store.read(p)).hexdigest() for p in there} == whole
        assert not [key for key in server.keys() if "/claims/" in key and not key.endswith("/")]  # noqa: SIM118
        assert not any((tmp_path / "scratch" / "blocks").iterdir())
        (status,) = read_status(store)
        assert (status.total.published, status.claims) == (6, 0)
