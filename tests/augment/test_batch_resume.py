"""A job that is killed, or stopped, goes on later and leaves the same files to the bit."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest
from batch_scenes import fake_render, make_recipe, must_not_render, open_fake, tree_digest

from augment.errors import OutputError
from augment.jobs.manifest import read_manifest
from augment.jobs.render_job import JobResult, RenderJob, run_job

IDENTITY = ("source", "recipe_hash", "trajectory", "version", "backend")


def run(job: RenderJob, renderer=fake_render) -> JobResult:
    return run_job(job, scene_loader=open_fake, renderer=renderer, progress=False)


@pytest.mark.long
def test_killed_jobs_resume_to_identical_files(quick_folder: Path) -> None:
    script = Path(__file__).with_name("batch_crashes.py")
    done = subprocess.run(
        [sys.executable, script, quick_folder], capture_output=True, text=True, timeout=240
    )
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert found["sweep_fresh"]["kills"] >= 4
    assert found["sweep_snow"]["kills"] >= 3
    assert found["sweep_overwrite"]["kills"] >= 4
    assert found["kill_at_random"]["kills"] >= 1
    assert found["stop_a_job_with_workers"]["finished"] >= 3


def test_a_complete_job_renders_nothing_and_touches_nothing(tmp_path: Path) -> None:
    job = RenderJob("fake:street", [make_recipe()], tmp_path)
    assert run(job).written == 8
    before = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*") if path.is_file()}
    result = run(job, must_not_render)
    assert (result.written, result.skipped, result.failed) == (0, 8, 0)
    lock = tmp_path / ".climategs" / "lock"
    after = {path: path.stat().st_mtime_ns for path in before}
    assert {p for p in before if before[p] != after[p]} <= {lock}


def test_selections_in_any_order_give_the_tree_of_one_run(tmp_path: Path) -> None:
    recipes = [make_recipe(), make_recipe("clear", image="jpg")]
    run(RenderJob("fake:street", recipes, tmp_path / "once"))
    parts = tmp_path / "parts"
    run(RenderJob("fake:street", recipes[1:], parts, frames=[3, 1]))
    run(RenderJob("fake:street", recipes, parts, cameras=["rear/left"]))
    run(RenderJob("fake:street", recipes, parts))
    assert tree_digest(parts) == tree_digest(tmp_path / "once")


def test_a_missing_file_is_rendered_again(tmp_path: Path) -> None:
    job = RenderJob("fake:street", [make_recipe()], tmp_path)
    run(job)
    whole = tree_digest(tmp_path)
    lost = ["images/front/000001.png", "depth/front/000002.png", "labels/boxes.parquet"]
    for name in lost:
        (tmp_path / "street" / "fog-000" / name).unlink()
    assert run(job).written == 2
    assert tree_digest(tmp_path) == whole


def test_an_interrupt_finishes_what_is_at_hand_and_can_be_resumed(tmp_path: Path) -> None:
    recipes = [make_recipe(), make_recipe(variant=1)]
    run(RenderJob("fake:street", recipes, tmp_path / "whole"))
    calls = []

    def interrupted(scene, camera, recipe, *, backend):
        calls.append(camera.name)
        if len(calls) == 4:
            raise KeyboardInterrupt
        return fake_render(scene, camera, recipe, backend=backend)

    job = RenderJob("fake:street", recipes, tmp_path / "stopped")
    with pytest.raises(KeyboardInterrupt, match="stopped with 3 of 16 images finished; run the"):
        run(job, interrupted)
    assert read_manifest(tmp_path / "stopped").num_rows == 3
    assert run(job).skipped == 3
    assert tree_digest(tmp_path / "stopped") == tree_digest(tmp_path / "whole")


def test_half_a_line_in_a_journal_is_not_believed(tmp_path: Path) -> None:
    """As a kill in the midst of a write leaves it; whole lines before it still count."""
    recipes = [make_recipe("clear", labels=False)]  # whose rows are all that a line holds
    run(RenderJob("fake:street", recipes, tmp_path / "whole"))
    out = tmp_path / "torn"
    run(RenderJob("fake:street", recipes, out, frames=[0, 1]))
    rows = read_manifest(out).to_pylist()
    (out / "manifest.parquet").unlink()
    lines = [{name: rows[0][name] for name in IDENTITY}, *rows]
    text = "".join(json.dumps(line) + "\n" for line in lines)
    progress_log = out / ".climategs" / "journal" / "street" / "clear-000.jsonl"
    progress_log.parent.mkdir(parents=True)
    progress_log.write_text(text[:-20])
    assert run(RenderJob("fake:street", recipes, out)).skipped == 3
    assert tree_digest(out) == tree_digest(tmp_path / "whole")


def test_temporary_files_of_a_killed_run_are_cleared(tmp_path: Path) -> None:
    job = RenderJob("fake:street", [make_recipe()], tmp_path)
    run(job)
    whole = tree_digest(tmp_path)
    folder = tmp_path / "street" / "fog-000" / "images" / "front"
    for place in (folder, tmp_path, tmp_path / ".climategs"):
        (place / ".000001.png.99-0.climategs-tmp").write_bytes(b"half")
    run(job, must_not_render)
    assert tree_digest(tmp_path) == whole


def test_recipes_and_scenes_share_a_folder(tmp_path: Path) -> None:
    run(RenderJob("fake:a", [make_recipe()], tmp_path, frames=[0]))
    run(RenderJob("fake:b", [make_recipe("clear")], tmp_path, frames=[1]))
    rows = read_manifest(tmp_path).select(["scene", "variant", "frame", "camera"]).to_pylist()
    assert [tuple(row.values()) for row in rows] == [
        ("a", "fog-000", 0, "front"),
        ("a", "fog-000", 0, "rear/left"),
        ("b", "clear-000", 1, "front"),
        ("b", "clear-000", 1, "rear/left"),
    ]


@pytest.mark.parametrize("ended", [True, False], ids=["finished", "only begun"])
def test_another_recipe_under_the_same_name_is_refused(tmp_path: Path, ended: bool) -> None:
    run(RenderJob("fake:street", [make_recipe()], tmp_path, frames=[0]))
    if not ended:  # as a kill leaves it: a journal and no manifest
        identity = read_manifest(tmp_path).to_pylist()[0]
        (tmp_path / "manifest.parquet").unlink()
        progress_log = tmp_path / ".climategs" / "journal" / "street" / "fog-000.jsonl"
        progress_log.parent.mkdir(parents=True)
        progress_log.write_text(json.dumps({name: identity[name] for name in IDENTITY}) + "\n")
    before = tree_digest(tmp_path)
    changed = make_recipe(depth="none")
    pattern = f"fog-000 already holds.*recipe hash there '{make_recipe().hash}'.*overwrite"
    with pytest.raises(OutputError, match=pattern):
        run(RenderJob("fake:street", [changed], tmp_path), must_not_render)
    assert tree_digest(tmp_path) == before

    calls = []

    def stops_at_the_third(scene, camera, recipe, *, backend):
        calls.append(camera.name)
        if len(calls) == 3:
            raise SystemExit("stopped without a chance to tidy up")
        return fake_render(scene, camera, recipe, backend=backend)

    with pytest.raises(SystemExit, match="stopped without"):
        run(RenderJob("fake:street", [changed], tmp_path, overwrite=True), stops_at_the_third)
    assert run(RenderJob("fake:street", [changed], tmp_path)).skipped == 2
    assert {row["recipe_hash"] for row in read_manifest(tmp_path).to_pylist()} == {changed.hash}
    digest = tree_digest(tmp_path)
    run(RenderJob("fake:street", [changed], tmp_path / "new"))
    assert digest == tree_digest(tmp_path / "new")


def test_overwriting_replaces_the_variant_and_no_other(tmp_path: Path) -> None:
    run(RenderJob("fake:street", [make_recipe(), make_recipe(variant=1)], tmp_path))
    changed = make_recipe(depth="none")
    result = run(RenderJob("fake:street", [changed], tmp_path, frames=[0], overwrite=True))
    assert (result.written, result.skipped) == (2, 0)
    run(RenderJob("fake:street", [changed], tmp_path / "new", frames=[0]))
    fog = "street/fog-000/"
    here = {k: v for k, v in tree_digest(tmp_path).items() if k.startswith(fog)}
    new = {k: v for k, v in tree_digest(tmp_path / "new").items() if k.startswith(fog)}
    assert here == new
    assert (
        read_manifest(tmp_path).column("variant").to_pylist() == ["fog-000"] * 2 + ["fog-001"] * 8
    )
