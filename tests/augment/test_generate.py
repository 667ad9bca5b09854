"""`climategs generate`: what is rendered, what left alone, what becomes of failures and kills."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from augment.errors import ClimateGSError, OutputError
from augment.jobs.blocks import read_status, stored_plans
from augment.jobs.generate import GenerateJob, GenerateResult, Workers, plan_job, run_generate
from augment.jobs.processes import available_cores
from augment.jobs.render_job import RenderJob
from augment.jobs.time_shares import compute_time_shares
from augment.output.atomic import write_atomic
from augment.output.manifest import list_parts, read_manifest, read_manifest_rows
from augment.output.names import STATE_FOLDER, folder_name
from augment.output.store import open_store
from recipes.job import JobRecipes, JobScene
from tests.augment.batch_scenes import make_recipe, must_not_render, open_fake, run_fake
from tests.augment.generate_jobs import (
    DRY,
    check_reader,
    image_name,
    leftovers,
    make_job,
    make_recipes,
    open_without_memory,
    outputs,
    raising_render,
)


@pytest.fixture(autouse=True)
def few_collections(monkeypatch: pytest.MonkeyPatch) -> None:
    """A worker collects garbage between scenes: here, that of all tests so far."""
    lazy = SimpleNamespace(collect=lambda: None)
    monkeypatch.setattr("augment.jobs.block_worker.gc", lazy)


def run(job: GenerateJob) -> GenerateResult:
    return run_generate(job, progress=False)


def small_job(out: Path, recipes: JobRecipes | None = None, **options) -> GenerateJob:
    """3 frames of 2 cameras in 2 scenes under 2 recipes: 12 images in 6 blocks."""
    scenes = ["fake:a?frames=2", "fake:b?frames=1"]
    return make_job(out, scenes, recipes or make_recipes(block_images=2), **options)


def rendered(job: GenerateJob) -> list[str]:
    """Runs the job; the images that it rendered, in order."""
    names: list[str] = []

    def renderer(scene, camera, recipe, *, backend):
        names.append(image_name(scene, camera, recipe))
        return job.setup.renderer(scene, camera, recipe, backend=backend)

    run(replace(job, setup=replace(job.setup, renderer=renderer)))
    return names


def rows_of(out: Path, **values) -> list[dict]:
    rows = read_manifest_rows(open_store(out)).to_pylist()
    return [r for r in rows if all(r[key] == value for key, value in values.items())]


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("finished") / "out"
    result = run(small_job(out))
    assert (result.written, result.skipped, result.failed) == (12, 0, 0)
    return out


@pytest.fixture
def reference_digests(finished: Path) -> dict[str, str]:
    return outputs(finished)


def test_every_image_once_and_nothing_but_them_left(
    finished: Path, reference_digests: dict
) -> None:
    rows = read_manifest(finished).to_pylist()
    assert len(rows) == 12 and check_reader(finished, reference_digests) == 12
    listed_paths = {
        row[k] for row in rows for k in row if k.endswith("_path") and row[k] is not None
    }
    recipes = {f"{s}/{v}-000/recipe.yaml" for s in "ab" for v in ("fog", "wet")}
    assert reference_digests.keys() == listed_paths | recipes | {"manifest.parquet"}
    assert leftovers(finished) == []
    boxes = sorted(path.name[:7] for path in (finished / "a/fog-000/labels/boxes").iterdir())
    assert boxes == ["000000-", "000001-"]


def test_a_finished_job_renders_nothing_and_touches_nothing(finished: Path) -> None:
    before = {p: p.stat().st_mtime_ns for p in finished.rglob("*") if p.is_file()}
    result = run(small_job(finished, renderer=must_not_render))
    assert (result.written, result.skipped, result.failed) == (0, 12, 0)
    assert {p: p.stat().st_mtime_ns for p in finished.rglob("*") if p.is_file()} == before


def test_files_of_others_among_the_claims_stay(finished: Path, tmp_path: Path) -> None:
    out = Path(shutil.copytree(finished, tmp_path / "out"))
    foreign = out / STATE_FOLDER / "claims/notes.lock/x"
    foreign.parent.mkdir(parents=True)
    foreign.write_text("not a claim")
    result = run(small_job(out))
    assert (result.written, result.skipped) == (0, 12)
    assert foreign.read_text() == "not a claim"


@pytest.mark.parametrize("scene", ["b/", pytest.param("", marks=pytest.mark.long)])
def test_any_file_that_was_deleted_is_made_again(
    finished, reference_digests, tmp_path: Path, scene: str
) -> None:
    """One of every folder of a scene, or of all; nothing but what is missing is rendered."""
    out = Path(shutil.copytree(finished, tmp_path / "out"))
    firsts = {path.rpartition("/")[0]: path for path in reference_digests}
    names = {
        *firsts.values(),
        *(path for path in reference_digests if path.endswith("recipe.yaml")),
    }
    paths = sorted(path for path in names if "/" in path and path.startswith(scene))
    assert len(paths) > 5
    for path in paths:
        (out / path).unlink()
        images = rendered(small_job(out))
        assert outputs(out) == reference_digests, path
        assert leftovers(out) == []
        if "/images/" in path or "/depth/" in path:
            assert len(images) == 1
        if path.endswith("recipe.yaml"):
            assert images == []
    shutil.rmtree(out / "a")
    assert len(rendered(small_job(out))) == 8
    assert outputs(out) == reference_digests and leftovers(out) == []


def test_shards_in_any_order_give_the_files_of_one_run(
    tmp_path: Path, reference_digests: dict
) -> None:
    results = [run(small_job(tmp_path, shard=(k, 5))) for k in (4, 1, 5, 2, 3)]
    assert sum(result.written for result in results) == 12
    assert outputs(tmp_path) == reference_digests
    assert run(small_job(tmp_path, shard=(2, 2), renderer=must_not_render)).written == 0


@pytest.mark.long
def test_only_what_is_new_is_rendered(tmp_path: Path) -> None:
    """More frames, scenes, recipes and variants, one after the other."""
    dry = make_recipes(["dry"])
    both = make_recipes(["dry", "wet"])
    doubled = make_recipes(["dry", "wet"], variants=2)
    small = [JobScene(uri="fake:a?frames=3", frames="0:2")]
    assert len(rendered(make_job(tmp_path, small, dry))) == 4
    names = rendered(make_job(tmp_path, ["fake:a?frames=3"], dry))
    assert {n.split("/")[2] for n in names} == {"2"} and len(names) == 2
    scenes = ["fake:a?frames=3", "fake:b?frames=1"]
    names = rendered(make_job(tmp_path, scenes, dry))
    assert {n.split("/")[0] for n in names} == {"b"} and len(names) == 2
    names = rendered(make_job(tmp_path, scenes, both))
    assert {n.split("/")[1] for n in names} == {"wet-000"} and len(names) == 8
    names = rendered(make_job(tmp_path, scenes, doubled))
    assert {n.split("/")[1] for n in names} == {"dry-001", "wet-001"} and len(names) == 16
    run(make_job(tmp_path / "once", scenes, doubled))
    once = outputs(tmp_path / "once")
    assert {k: v for k, v in outputs(tmp_path).items() if not k.startswith("once")} == once


def test_draws_differ_from_scene_to_scene_unless_they_are_shared(tmp_path: Path) -> None:
    scenes = ["fake:a?frames=1", "fake:b?frames=1"]
    run(make_job(tmp_path / "own", scenes, make_recipes(["fog"])))
    run(make_job(tmp_path / "shared", scenes, make_recipes(["fog"], draws="shared")))
    scene_hashes = {row["recipe_hash"] for row in rows_of(tmp_path / "own")}
    shared = {row["recipe_hash"] for row in rows_of(tmp_path / "shared")}
    assert (len(scene_hashes), len(shared)) == (2, 1)


def test_another_recipe_of_the_same_name_is_refused(finished: Path) -> None:
    before = outputs(finished)
    parts = list_parts(open_store(finished))
    plans = stored_plans(open_store(finished))
    changed = make_recipes(texts={"fog": DRY})
    with pytest.raises(OutputError, match=r"a/fog-000 already holds.*recipe hash.*Give the recipe"):
        run(small_job(finished, recipes=changed, renderer=must_not_render))
    assert outputs(finished) == before and leftovers(finished) == []
    assert list_parts(open_store(finished)) == parts
    assert stored_plans(open_store(finished)) == plans


def test_an_image_that_fails_costs_itself_and_is_tried_again(
    tmp_path: Path, reference_digests: dict
) -> None:
    result = run(small_job(tmp_path, renderer=raising_render))
    assert (result.written, result.failed) == (11, 1)
    assert "rendering: ValueError: the picture is cut short" in result.failures[0]
    (row,) = rows_of(tmp_path, status="failed")
    image = row["scene"], row["variant"], row["frame"], row["camera"]
    assert image == ("a", "fog-000", 1, "front")
    assert "cut short" in row["message"] and row["image_path"] is None
    assert read_manifest(tmp_path).num_rows == 12
    assert rendered(small_job(tmp_path, renderer=raising_render)) == ["a/fog-000/1/front"]
    assert rendered(small_job(tmp_path)) == ["a/fog-000/1/front"]
    assert outputs(tmp_path) == reference_digests and leftovers(tmp_path) == []


def test_a_scene_that_memory_does_not_suffice_for(tmp_path: Path, reference_digests: dict) -> None:
    """Unusable where it was never opened; else all its images are failed rows, and tried again."""
    result = run(small_job(tmp_path, opener=open_without_memory))
    assert (result.written, result.failed) == (8, 0)
    assert "memory ran out (bad allocation)" in result.unusable["fake:b?frames=1"]
    assert read_status(open_store(tmp_path))[0].unusable == result.unusable
    out = tmp_path / "once"
    run(small_job(out, shard=(1, 12)))
    result = run(small_job(out, opener=open_without_memory))
    assert (result.written + result.skipped, result.failed) == (8, 4)
    assert {row["scene"] for row in rows_of(out, status="failed")} == {"b"}
    assert len(rows_of(out)) == 12
    assert run(small_job(out)).failed == 0
    assert outputs(out) == reference_digests and leftovers(out) == []


def test_scenes_of_one_name_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ClimateGSError, match=r"both called 'a', so they would share a folder"):
        run(make_job(tmp_path, ["fake:a?frames=1", "fake:a?frames=2"]))
    named_scenes = [JobScene(uri="fake:a?frames=1"), JobScene(uri="fake:a?frames=2", name="second")]
    assert run(make_job(tmp_path, named_scenes, make_recipes(["dry"]))).written == 6
    assert (tmp_path / "second" / "dry-000").is_dir()


def test_status_in_every_state(tmp_path: Path) -> None:
    store = open_store(tmp_path)
    assert read_status(store) == []
    calls = []

    def stops(scene, camera, recipe, *, backend):
        calls.append(camera.name)
        if len(calls) == 4:
            raise KeyboardInterrupt
        return small_job(tmp_path).setup.renderer(scene, camera, recipe, backend=backend)

    with pytest.raises(KeyboardInterrupt, match="start the same job again"):
        run(small_job(tmp_path, renderer=stops))
    (status,) = read_status(store)
    assert (status.total.planned, status.total.published, status.staged) == (12, 2, 1)
    assert (status.blocks, status.blocks_published, status.claims) == (6, 1, 0)
    assert read_manifest(tmp_path).num_rows == 2
    run(small_job(tmp_path, renderer=raising_render))
    (status,) = read_status(store)
    assert (status.total.published, status.total.in_failed_blocks, status.staged) == (12, 2, 0)
    assert status.by_scene["a"].planned == 8 and status.by_recipe["wet"].published == 6


def test_a_damaged_record_of_a_scene_is_made_again(tmp_path: Path) -> None:
    job = make_job(tmp_path, ["fake:a?frames=1"], make_recipes(["dry"]))
    run(job)
    (record,) = (tmp_path / ".climategs" / "scenes").iterdir()
    record_bytes = record.read_bytes()
    facts = json.loads(record_bytes)
    for damaged in (b"", b"{}", b"[1]", json.dumps({**facts, "frames": [[1]]}).encode(),
                    json.dumps({**facts, "extra": 1}).encode()):  # fmt: skip
        record.write_bytes(damaged)
        assert run(job).skipped == 2
        assert json.loads(record.read_bytes())["frames"] == facts["frames"]


def test_a_folder_that_may_not_be_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The tests may run as root, whom nothing stops."""

    def refuse(*_: object, **__: object) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr("os.replace", refuse)
    with pytest.raises(OutputError, match="not writable for this user"):
        run(make_job(tmp_path))


def test_a_render_job_into_the_same_folder(tmp_path: Path) -> None:
    """Before, between and after: neither loses the other's rows."""

    def render(name: str) -> None:
        job = RenderJob("fake:a?frames=2", [make_recipe(name, depth="none")], tmp_path)
        run_fake(job)

    def variants() -> dict[str, int]:
        names = [row["variant"] for row in rows_of(tmp_path, status="ok")]
        return {name: names.count(name) for name in sorted(set(names))}

    render("clear")
    run(make_job(tmp_path, ["fake:a?frames=2"], make_recipes(["wet"])))
    assert variants() == {"clear-000": 4, "wet-000": 4}
    render("haze")
    assert variants() == {"clear-000": 4, "haze-000": 4, "wet-000": 4}
    run(make_job(tmp_path, ["fake:a?frames=3"], make_recipes(["wet"])))
    assert variants() == {"clear-000": 4, "haze-000": 4, "wet-000": 6}
    assert read_manifest(tmp_path).num_rows == 14
    with pytest.raises(OutputError, match="a/haze-000 already holds"):
        run(make_job(tmp_path, ["fake:a?frames=2"], make_recipes(["haze"], texts={"haze": DRY})))


@pytest.fixture(autouse=True)
def no_threads_left() -> Iterator[None]:
    yield
    assert not [t for t in threading.enumerate() if t.name.startswith(("publish", "writer"))]


@pytest.mark.long
def test_sweeps_that_show_another_world_are_told_of_once(tmp_path: Path, caplog) -> None:
    snowy = "weather: {snow: {depth_m: 0.1}}\noutput: {depth: none, lidar: true}\n"
    recipes = make_recipes(("snowy",), variants=2, texts={"snowy": snowy}, block_images=2)
    scenes = ("fake:a?frames=2", "fake:b?frames=2&unlabelled=1")
    run(make_job(tmp_path / "out", scenes, recipes))
    messages = [record.message for record in caplog.records if "LiDAR passes" in record.message]
    assert messages == [
        "note: snowy-000: LiDAR passes through clean: snow 0.1 m deep in images, not in sweeps "
        "(output: {lidar: true, surface: solid}), and 1 more likewise"
    ]
    caplog.clear()
    run(make_job(tmp_path / "without", scenes[1:], recipes))
    assert "LiDAR passes" not in caplog.text


# ---- Where a GPU renders, or seems to -----------------------------------------------------------

SCENES = ["fake:a?frames=2"]


def job_of(out: Path, backend: str, **options) -> GenerateJob:
    job = make_job(out, SCENES, make_recipes(["fog"]), **options)
    return replace(job, setup=replace(job.setup, backend=backend))


def test_a_gpu_has_one_process_and_a_name_and_mixes_with_no_cpu(tmp_path, monkeypatch) -> None:
    def slots_of(backend: str, workers: int = 0) -> int:
        options = {"workers": workers} if workers else {}
        job_workers = Workers(job_of(tmp_path, backend, executor="processes", **options))
        job_workers.close()
        return job_workers.slots

    def planned(backend: str) -> str:
        return plan_job(job_of(tmp_path, backend, renderer=None), progress=False).backend

    assert (slots_of("cuda"), slots_of("cuda", 3), slots_of("cpu")) == (1, 3, available_cores())
    assert planned("auto") == "auto"
    monkeypatch.setattr("augment.render.cuda.runtime.has_gpu", lambda: True)
    assert slots_of("auto") == 1
    assert (planned("auto"), planned("cuda"), planned("cpu")) == ("cuda", "cuda", "cpu")
    for first, second in (("cuda", "auto"), ("auto", "cuda")):
        out = tmp_path / first
        run(job_of(out, first))
        before = outputs(out)
        with pytest.raises(OutputError, match=rf"backend there '{first}', here '{second}'"):
            run(job_of(out, second))
        assert outputs(out) == before


def test_a_dataset_job_measures_what_bound_it(tmp_path: Path) -> None:
    result = run(job_of(tmp_path, "auto"))
    timings = result.timings
    assert 0 < timings["renderers"] < timings["workers"] <= timings["render_wall"]
    assert timings["publish"] > 0
    shares = compute_time_shares(timings)
    assert shares is not None
    assert shares.rendering + shares.waiting_for_files + shares.other_work == pytest.approx(1)
    assert compute_time_shares(run(job_of(tmp_path, "auto")).timings) is None


# ---- Names, damage, kills -----------------------------------------------------------------------


def test_hostile_names_stay_inside(tmp_path: Path) -> None:
    for number, name in enumerate(("../../etc", "x" * 300, "новый", "a\nb", "CON ")):
        scene = replace(open_fake("fake:x?frames=1"), name=name)
        out = tmp_path / str(number) / "out"
        job = make_job(out, ["fake:x"], make_recipes(["dry"]), opener=lambda _uri, s=scene: s)
        assert run(job).written == 2
        assert [p.name for p in out.parent.iterdir()] == ["out"]
        assert (out / folder_name(name) / "dry-000" / "recipe.yaml").is_file()
        assert {row["scene"] for row in rows_of(out)} == {name}
        assert run(replace(job, setup=replace(job.setup, renderer=must_not_render))).skipped == 2
        assert read_status(open_store(out))[0].total.published == 2


@pytest.mark.usefixtures("unchecked")
def test_a_damaged_plan_is_told_and_written_again(tmp_path: Path) -> None:
    plan = {"format": 2, "job": "j", "version": "1", "blocks": [], "unusable": {}}
    block = {"key": "k", "scene": "s", "variant": "v", "recipe": "r", "images": "9"}
    changes = [{"blocks": [block]}, {"blocks": [["k"]]}, {"unusable": []}, {"job": ["j"]}]
    wrong = [json.dumps(plan | change).encode() for change in [*changes, {"format": 1}]]
    for data in (b"", b"[]", b'{"format":2}', b"\xff", b"[" * 100_000, *wrong):
        write_atomic(tmp_path / ".climategs" / "jobs" / "job.json", data)
        with pytest.raises(OutputError, match=r"job\.json is damaged: .*Start the job again"):
            read_status(open_store(tmp_path))
    assert run(make_job(tmp_path, ["fake:a?frames=1"], make_recipes(["dry"]))).written == 2
    assert read_status(open_store(tmp_path))[0].total.published == 2


def found_by(folder: Path, *scenarios: str) -> dict[str, dict]:
    """What has to hold is in the script, which ends with a message where it does not."""
    command = [sys.executable, "-m", "tests.augment.job_crashes", str(folder), *scenarios]
    root = Path(__file__).parents[2]
    done = subprocess.run(command, cwd=root, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@pytest.mark.long
def test_killed_jobs_go_on_to_identical_files(quick_folder: Path) -> None:
    assert found_by(quick_folder, "kill_a_few_times")["kill_a_few_times"]["kills"] == 8


@pytest.mark.long
def test_a_killed_suite_goes_on_to_identical_files_and_hashes(quick_folder: Path) -> None:
    assert found_by(quick_folder, "kill_suites")["kill_suites"]["kills"] >= 2


@pytest.mark.long
def test_jobs_that_are_killed_stopped_or_starved_of_disk_go_on(quick_folder: Path) -> None:
    counts = found_by(quick_folder)
    assert counts["kill_render_jobs"]["kills"] + counts["kill_generate_jobs"]["kills"] >= 30
    assert counts["kill_while_overwriting"]["kills"] >= 4
    assert counts["fill_the_disk"]["failures"] >= 2
    assert len(counts["stop_jobs_with_workers"]["finished"]) == 6
    assert {"run_several_drivers", "die_at_one_image", "die_while_opening"} <= counts.keys()


# ---- Scenes whose files change between two runs --------------------------------------------------


def digested_job(out: Path, digest: str | None, **options) -> GenerateJob:
    """A small job in which scene a has this content, and scene b always the same."""
    job = small_job(out, **options)
    digests = {"fake:a?frames=2": digest, "fake:b?frames=1": "content of b"}
    digest_of = None if digest is None else digests.get
    return replace(job, setup=replace(job.setup, scene_digest=digest_of))


@pytest.mark.parametrize("executor", ["serial", "rescan", "without records"])
def test_a_scene_whose_content_has_changed_is_refused(tmp_path: Path, executor: str) -> None:
    run(digested_job(tmp_path, "content1"))
    rows = rows_of(tmp_path, scene="a")
    assert {row["source_digest"] for row in rows} == {"content1"}
    before = outputs(tmp_path)
    options = {"reopens_scenes": True} if executor == "rescan" else {}
    if executor == "without records":
        shutil.rmtree(tmp_path / ".climategs" / "scenes")
    changed = digested_job(tmp_path, "content2", renderer=must_not_render, **options)
    pattern = "scene a as it was before.*fake:a.*content1.*content2.*another output.*or delete"
    with pytest.raises(OutputError, match=pattern):
        run(changed)
    assert outputs(tmp_path) == before
    assert run(digested_job(tmp_path, "content1", renderer=must_not_render)).skipped == 12
    shutil.rmtree(tmp_path / "a")
    assert len(rendered(digested_job(tmp_path, "content2"))) == 8
    assert {row["source_digest"] for row in rows_of(tmp_path, scene="a")} == {"content2"}
    assert run(digested_job(tmp_path, "content2", renderer=must_not_render)).skipped == 12
    assert leftovers(tmp_path) == []


def test_an_output_without_a_digest_is_taken_for_the_scene_as_it_is_once(
    tmp_path: Path, caplog
) -> None:
    recipes = make_recipes(["fog"], block_images=2)
    run(digested_job(tmp_path, None, recipes=recipes))
    more = digested_job(tmp_path, "content1")
    assert len(rendered(more)) == 6  # of the other recipe
    assert caplog.text.count("of an older version") == 2  # of each scene
    run(more)
    assert caplog.text.count("of an older version") == 2
    with pytest.raises(OutputError, match="scene a as it was before"):
        run(digested_job(tmp_path, "content2"))
