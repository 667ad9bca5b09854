"""Suites as they are rendered: hashes, verification, other shards, and samples on the fly."""

from __future__ import annotations

import hashlib
import json
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from augment.dataset import WeatherDataset
from augment.effects.lens_drops.drops import LensDropsPlan, drops_at
from augment.effects.lidar.codes import ATTENUATED
from augment.effects.smog import wavelength_factor
from augment.errors import OutputError
from augment.output.manifest import read_manifest_rows
from augment.output.names import STATE_FOLDER
from augment.output.store import open_store
from augment.render.scatter import scattered_share
from augment.suite.run import quarter_of, run_suite
from augment.suite.suite_dataset import SuiteDataset
from augment.suite.suite_file import SUITE_FILE, SuiteFile, choose_probes, read_suite_file
from augment.suite.verify import verify_suite
from augment.view.plan import make_plan, plan_view
from augment.view.weathered_sweep import weathered_sweep
from recipes.lens_drops import LensDrops
from recipes.suite import SuiteVariant
from tests.augment.batch_scenes import (
    assert_same_sample,
    fake_render,
    make_camera,
    open_fake,
    tree_digest,
)
from tests.augment.suite_runs import SUITE, make_run
from tests.lidar_sweeps import ranges_of, some_points, street, sweep_of
from tests.streets import LABELLED_STREET, open_street

NAMES = ["clean-0", "fog-1", "fog-3", "flood-1", "flood-3"]


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A whole suite; tests that change files copy it."""
    out = tmp_path_factory.mktemp("suite") / "out"
    result = run_suite(make_run(out), progress=False)
    assert (result.images.written, result.images.failed) == (60, 0)
    return out


def copy_of(finished: Path, target: Path) -> Path:
    for path in finished.rglob("*"):
        if path.is_file():
            (target / path.relative_to(finished)).parent.mkdir(parents=True, exist_ok=True)
            (target / path.relative_to(finished)).write_bytes(path.read_bytes())
    return target


# ---- suite.json ----------------------------------------------------------------------------------


def test_suite_json_has_the_hash_of_every_file_and_the_numbers_of_every_variant(finished: Path):
    suite_file = read_suite_file(open_store(finished))
    files = {p: h for p, h in tree_digest(finished).items() if not p.startswith(STATE_FOLDER)}
    files.pop(SUITE_FILE)
    assert suite_file.files == files
    assert list(suite_file.variants) == NAMES
    fog = suite_file.variants["fog-3"]
    assert (fog.effect, fog.level, fog.value, fog.unit) == ("fog", 3, 150, "m")
    assert fog.numbers["smog_extinction_per_m"] == 0.02
    assert fog.recipe["weather"]["smog"]["extinction_per_m"] == 0.02
    expected = {s: SUITE.recipe(SuiteVariant("fog", 3), s).seed for s in ("a", "b")}
    assert fog.seeds == expected
    assert suite_file.scenes["a"].frames == (0, 1, 2, 3)
    assert suite_file.scenes["b"].cameras == ("front", "rear/left")
    json.loads((finished / SUITE_FILE).read_text(), parse_constant=pytest.fail)  # no NaN


def test_scenes_whose_recording_has_the_effect_are_marked(finished: Path):
    scenes = read_suite_file(open_store(finished)).scenes
    assert scenes["a"].omitted_effects == scenes["a"].recorded_conditions == ()
    assert scenes["b"].recorded_conditions == ("fog", "night")
    assert scenes["b"].omitted_effects == ("fog", "night", "combined")


def test_probes_are_the_first_the_middle_and_the_last_image(finished: Path):
    suite_file = read_suite_file(open_store(finished))
    for name, facts in suite_file.variants.items():
        images = sorted(p for p in suite_file.files if f"/{facts.folder}/images/" in p)
        assert facts.probes == (images[0], images[6], images[-1]) and len(images) == 12, name
    assert choose_probes(["b"]) == ("b",) and choose_probes(["b", "a"]) == ("a", "b")
    assert choose_probes([]) == ()


def test_a_failed_image_is_named(tmp_path: Path):
    def failing(scene, camera, recipe, *, backend):
        if recipe.name == "fog-1" and camera.name == "front":
            raise ValueError("the picture is cut short")
        return fake_render(scene, camera, recipe, backend=backend)

    run = make_run(tmp_path, scenes=["fake:a?frames=1"], effects=["fog"], renderer=failing)
    result = run_suite(run, progress=False)
    assert result.images.failed == 1 and result.suite_file is not None
    (failed,) = result.suite_file.failed
    assert (failed.scene, failed.variant, failed.frame, failed.camera) == ("a", "fog-1", 0, "front")
    assert "cut short" in failed.message
    again = run_suite(make_run(tmp_path, scenes=["fake:a?frames=1"], effects=["fog"]),
                      progress=False)  # fmt: skip
    assert again.images.written == 1 and again.suite_file.failed == ()


# ---- Runs, shards, subsets -----------------------------------------------------------------------


def test_a_second_run_renders_nothing_and_writes_the_same(finished: Path, tmp_path: Path):
    out = copy_of(finished, tmp_path / "out")
    result = run_suite(make_run(out), progress=False)
    assert result.images.written == 0 and result.images.skipped == 60
    assert (out / SUITE_FILE).read_bytes() == (finished / SUITE_FILE).read_bytes()


@pytest.mark.long
def test_the_last_shard_writes_suite_json(finished: Path, tmp_path: Path):
    first, second = (make_run(tmp_path, shard=(number, 2)) for number in (1, 2))
    assert run_suite(first, progress=False).suite_file is None
    assert not (tmp_path / SUITE_FILE).exists()
    assert run_suite(second, progress=False).suite_file is not None
    assert (tmp_path / SUITE_FILE).read_bytes() == (finished / SUITE_FILE).read_bytes()


@pytest.mark.long
def test_effects_that_are_added_later_give_the_same_files(finished: Path, tmp_path: Path):
    for options in ({"effects": ["flood"], "levels": [3]}, {"levels": [1]}, {}):
        run_suite(make_run(tmp_path, **options), progress=False)
    files = read_suite_file(open_store(tmp_path)).files
    expected = read_suite_file(open_store(finished)).files
    assert files == expected


def test_a_scene_alone_has_the_files_that_it_has_among_others(finished: Path, tmp_path: Path):
    run_suite(make_run(tmp_path, scenes=["fake:b?frames=2"], effects=["fog"]), progress=False)
    alone = read_suite_file(open_store(tmp_path)).files
    among = read_suite_file(open_store(finished)).files
    pictures = [path for path in alone if path.startswith("b/fog-")]
    assert len(pictures) > 8 and all(alone[path] == among[path] for path in pictures)


@pytest.mark.long
def test_a_quarter_has_every_fourth_frame_with_the_bytes_of_the_whole(
    finished: Path, tmp_path: Path
):
    run = make_run(tmp_path, is_quarter=True)
    run_suite(replace(run, scenes=quarter_of(run.scenes)), progress=False)
    quarter = read_suite_file(open_store(tmp_path))
    assert quarter.suite == "weather-c-v1-q"
    assert [scene.frames for scene in quarter.scenes.values()] == [(0,), (0,)]
    images = {p: h for p, h in quarter.files.items() if "/images/" in p}
    whole = read_suite_file(open_store(finished)).files
    assert len(images) == 20 and images == {path: whole[path] for path in images}


def test_another_suite_in_the_folder_is_refused(finished: Path, tmp_path: Path):
    out = copy_of(finished, tmp_path / "out")
    before = tree_digest(out)
    for options, name in (
        ({"scale": 0.5}, "scale: 1.0 there, 0.5 here"),
        ({"changes": {"output.image": "png"}}, "changes: {} there, {'output.image': 'png'} here"),
        ({"is_quarter": True}, "suite: 'weather-c-v1' there, 'weather-c-v1-q' here"),
    ):
        with pytest.raises(OutputError, match=f"holds a suite with another {name}"):
            run_suite(make_run(out, **options), progress=False)
    assert tree_digest(out) == before


# ---- Verification --------------------------------------------------------------------------------


def test_verification_finds_changed_missing_and_added_files(finished: Path, tmp_path: Path):
    out = copy_of(finished, tmp_path / "out")
    store = open_store(out)
    assert verify_suite(store).is_intact
    (out / "predictions.json").write_text("{}")
    outcome = verify_suite(store)
    assert outcome.is_intact and outcome.unlisted == ("predictions.json",)
    paths = sorted(path for path in outcome.suite_file.files if path.endswith(".jpg"))
    data = bytearray((out / paths[5]).read_bytes())
    data[len(data) // 2] ^= 1
    (out / paths[5]).write_bytes(data)
    (out / paths[7]).unlink()
    outcome = verify_suite(store)
    assert not outcome.is_intact
    assert (outcome.changed, outcome.missing) == ((paths[5],), (paths[7],))


def test_a_changed_suite_json_is_refused(finished: Path, tmp_path: Path):
    out = copy_of(finished, tmp_path / "out")
    store = open_store(out)
    text = (out / SUITE_FILE).read_text()
    (out / SUITE_FILE).write_text(text.replace('"level": 3', '"level": 2', 1))
    with pytest.raises(OutputError, match="was changed after it was written"):
        read_suite_file(store)
    for damaged in (text[:100], "[]", "{}", text.replace('"format": 1', '"format": 2')):
        (out / SUITE_FILE).write_text(damaged)
        with pytest.raises(OutputError, match=r"suite\.json is damaged"):
            read_suite_file(store)
    (out / SUITE_FILE).unlink()
    with pytest.raises(OutputError, match="no suite was rendered there"):
        verify_suite(store)


@pytest.mark.long
def test_one_changed_byte_among_ten_thousand_files_is_found_soon(finished: Path, tmp_path: Path):
    suite_file = read_suite_file(open_store(finished))
    files = {}
    for number in range(10_000):
        path = tmp_path / f"a/fog-1-000/images/front/{number:06d}.jpg"
        if number == 0:
            path.parent.mkdir(parents=True)
        data = number.to_bytes(4, "big") * 1000
        path.write_bytes(data)
        files[str(path.relative_to(tmp_path))] = hashlib.sha256(data).hexdigest()
    many = suite_file.model_copy(update={"files": files})
    (tmp_path / SUITE_FILE).write_bytes(many.to_json())
    path = tmp_path / "a/fog-1-000/images/front/007777.jpg"
    data = bytearray(path.read_bytes())
    data[1234] ^= 0x10
    path.write_bytes(data)
    start_s = time.perf_counter()
    outcome = verify_suite(open_store(tmp_path))
    assert time.perf_counter() - start_s < 60  # the promise; some seconds on two loaded cores
    assert outcome.changed == ("a/fog-1-000/images/front/007777.jpg",) and not outcome.missing


def test_suite_json_reads_back_as_it_was(finished: Path):
    data = (finished / SUITE_FILE).read_bytes()
    assert SuiteFile.from_json(data, "x").to_json() == data


# ---- On the fly ----------------------------------------------------------------------------------


def test_samples_on_the_fly_are_those_of_the_files_to_the_byte(finished: Path):
    suite_file = read_suite_file(open_store(finished))
    scenes = [open_fake("fake:a?frames=4"), open_fake("fake:b?frames=2")]
    live = SuiteDataset(scenes, "fog-3", renderer=fake_render)
    files = WeatherDataset(finished, variants=["fog-3-000"], load=["image", "boxes"])
    assert len(live) == len(files) == 12
    by_path = {
        str(Path(sample["paths"]["image"]).relative_to(finished)): sample for sample in files
    }
    for index in range(len(live)):
        path = live.image_path(index)
        assert live.image_bytes(index) == (finished / path).read_bytes()
        live.check(index, suite_file)
        assert_same_sample(live[index], by_path[path], but=("paths",))
    batch = live.__getitems__([11, 0, 7, 8])
    assert [s["scene"] for s in batch] == ["b", "a", "a", "b"]
    other = SuiteDataset(scenes, "fog-3", renderer=fake_render, changes={"output.jpeg_quality": 80})
    with pytest.raises(OutputError, match="is rendered with other bytes here"):
        other.check(0, suite_file)
    quarter = SuiteDataset(scenes, "fog-3", suite="weather-c-v1-q", renderer=fake_render)
    assert len(quarter) == 4
    with pytest.raises(OutputError, match="give it the same suite"):
        quarter.check(0, suite_file)


def test_wrong_datasets_are_refused():
    scene = open_fake("fake:a")
    for scenes, options, message in (
        ([], {}, "scenes must be one or more"),
        ([scene, scene], {}, "each of another name"),
        ([scene], {"suite": "weather-c-v1-q", "frames": "0:2"}, "weather-c-v1-q has the frames"),
    ):
        with pytest.raises(ValueError, match=message):
            SuiteDataset(scenes, "fog-3", renderer=fake_render, **options)


def test_a_real_street_on_the_fly_has_the_bytes_of_its_files(tmp_path: Path):
    def opener(uri: str):
        return open_street(LABELLED_STREET)

    run = make_run(
        tmp_path, scenes=["street"], effects=["fog", "lens"], levels=[5], frames="0",
        renderer=None, opener=opener,
    )  # fmt: skip
    assert run_suite(run, progress=False).images.failed == 0
    suite_file = read_suite_file(open_store(tmp_path))
    for variant in ("fog-5", "lens-5"):
        scenes = [open_street(LABELLED_STREET)]
        SuiteDataset(scenes, variant, frames="0", cameras=["front"]).check(0, suite_file)
    rows = read_manifest_rows(open_store(tmp_path)).to_pylist()
    shares = [row["lens_drops_fraction"] for row in rows if row["recipe"] == "lens-5"]
    # The mask has what a tenth of the light of is from drops: some more than their share.
    assert 0.25 < np.mean(shares) < 0.6


# ---- One number for camera and LiDAR, and for every lens -----------------------------------------


@pytest.mark.parametrize("level", range(1, 6))
def test_camera_and_lidar_have_the_extinction_of_the_level(level: int):
    scene = street()
    recipe = SUITE.recipe(SuiteVariant("fog", level), scene.name)
    stated_per_m = 0.005 * 2 ** (level - 1)
    camera = make_camera("front", 10**18, 0.0)
    (effect,) = plan_view(make_plan(recipe, scene), scene, camera).effects
    depth = torch.full((camera.height, camera.width), 12.5)
    share = scattered_share(torch.ones_like(depth), depth, camera, effect.settings.fog)
    distances_m = depth.double() * camera.ray_lengths(torch.float64)
    camera_per_m = -torch.log1p(-share.double()) / distances_m
    assert float((camera_per_m - stated_per_m).abs().max()) < 1e-6
    sweep = sweep_of(some_points(), intensity=0.5)
    columns = weathered_sweep(scene, recipe, 0, sweep).columns
    is_attenuated = columns["weather_code"] == ATTENUATED
    assert is_attenuated.sum() > 20
    intensity = columns["intensity"][is_attenuated].astype(np.float64)
    lidar_per_m = np.log(0.5 / intensity) / (2 * ranges_of(sweep)[is_attenuated])
    # At 905 nm, light haze takes a little less than of visible light: at level 1 alone.
    factor = wavelength_factor(stated_per_m)
    assert np.abs(lidar_per_m / factor - stated_per_m).max() < 1e-6
    assert factor == 1 if level > 1 else factor == pytest.approx(0.869, abs=1e-3)


@pytest.mark.parametrize("share", [0.02, 0.1, 0.35])
def test_drops_cover_their_share_of_narrow_and_wide_pictures(share: float):
    scene = open_fake("fake:a")
    section = LensDrops(share=share, radius_mm=0.9, radius_spread=0.2, glass_m=0.03)
    plan = LensDropsPlan(section, seed=3)
    for focal_px in (200.0, 120.0):
        covers = []
        for second in range(0, 1200, 60):  # longer than a drop stays
            camera = replace(
                make_camera("front", 10**18 + second * 10**9, 0.0),
                width=192, height=108, fx=focal_px, fy=focal_px, cx=96.0, cy=54.0,
            )  # fmt: skip
            drops = drops_at(plan, scene, camera)
            scale = focal_px / plan.drops.glass_m
            x, y = np.meshgrid(np.arange(192) + 0.5 - 96, np.arange(108) + 0.5 - 54)
            offsets = np.stack([x, y])[..., None] - scale * drops.centres_m.T[:, None, None]
            inside = (offsets**2).sum(0) < (scale * drops.radii_m) ** 2
            covers.append(inside.any(-1).mean())
        # Drops at the border lie half outside, and few drops come in whole numbers.
        assert np.mean(covers) == pytest.approx(share, rel=0.25), focal_px
