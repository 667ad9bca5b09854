"""The datasets over written files and over live scenes."""

from __future__ import annotations

import json
import pickle
from multiprocessing.reduction import ForkingPickler
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest
import torch
from batch_scenes import (
    LEVEL_Z_M,
    ORIGIN_M,
    FakeLabels,
    fake_render,
    make_frame,
    make_recipe,
    must_not_render,
    open_fake,
)
from dataset_folders import CLEAR, FOGGY, assert_same_sample, write_scene
from torch.utils.data import DataLoader

from augment.boxes import PlacedBoxes
from augment.dataset import (
    ClipDataset,
    MixedDataset,
    SceneDataset,
    WeatherDataset,
    clean_frames,
    collate_frames,
)
from augment.effects.flood.effect import hidden_pixels, submerged_fraction
from augment.errors import BackendUnavailable, OutputError, SceneError
from augment.jobs.files import box_tables
from augment.jobs.render_job import RenderJob, run_job
from recipes.flood import Flood
from recipes.schema import Recipe

FLOODED = make_recipe("clear", variant=9, flood=Flood(level_m=0.3), surface="first")
RECIPES = [
    make_recipe(),
    make_recipe(variant=1, image="jpg"),
    make_recipe("clear", depth="none"),
    FLOODED,
]


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four variants of one scene; shared, so tests that damage files copy it."""
    out = tmp_path_factory.mktemp("dataset") / "out"
    job = RenderJob("fake:street", RECIPES, out)
    run_job(job, scene_loader=open_fake, renderer=fake_render, progress=False)
    return out


@pytest.fixture
def one_image(tmp_path: Path) -> Path:
    """A folder with a single image, to be damaged."""
    job = RenderJob("fake:street", [make_recipe()], tmp_path, frames=[1], cameras=["front"])
    run_job(job, scene_loader=open_fake, renderer=fake_render, progress=False)
    return tmp_path


@pytest.mark.parametrize("recipe", RECIPES, ids=["png", "jpg", "no depth", "flood"])
def test_live_samples_equal_written_ones(written: Path, recipe: Recipe) -> None:
    scene = open_fake("fake:street")
    live = SceneDataset(scene, recipe, renderer=fake_render)
    files = WeatherDataset(written, variants=[f"{recipe.name}-{recipe.variant:03d}"])
    assert len(live) == len(files) == 8
    for index in range(8):
        assert_same_sample(live[index], files[index], but=("paths",))
        assert set(live[index]["paths"].values()) == {None}


def test_a_sample_holds_what_it_says(written: Path) -> None:
    files = WeatherDataset(written, variants=["fog-000"], cameras=["rear/left"], frames=[3])
    assert len(files) == 1
    sample = files[0]
    recipe, camera = make_recipe(), make_frame(3).cameras["rear/left"]
    view = fake_render(open_fake("fake:street"), camera, recipe, backend="")
    assert sample["image"].shape == (3, 16, 24) and sample["image"].dtype == torch.float32
    np.testing.assert_array_equal(
        (sample["image"] * 255).round().byte().permute(1, 2, 0).numpy(), view.rgb
    )
    usable = (view.depth_m > 1 / 512) & (view.depth_m < 255.99)
    # Half a step of 1/256 m.
    assert np.abs(sample["depth"].numpy() - view.depth_m)[usable].max() <= 1 / 512
    assert sample["depth"][torch.from_numpy(view.depth_m < 0)].abs().max() == 0
    np.testing.assert_array_equal(sample["semantic"].numpy(), view.semantic)
    np.testing.assert_array_equal(sample["instance"].numpy(), view.instance)
    boxes, expected = sample["boxes"], FakeLabels().boxes(3)
    assert boxes["centers_m"].numpy().tobytes() == expected.centers_m.tobytes()
    assert boxes["sizes_m"].shape == (3, 3) and boxes["quats"].shape == (3, 4)
    assert boxes["labels"] == ["Car"] * 3 and boxes["track_ids"] == list(expected.track_ids)
    assert sample["camera"]["name"] == "rear/left"
    assert sample["camera"]["timestamp_ns"] == camera.timestamp_ns
    assert torch.equal(sample["camera"]["K"], camera.K)
    pose = sample["camera"]["world_from_camera"]
    assert pose.dtype == torch.float64
    np.testing.assert_array_equal(
        pose[:3, 3].numpy(), camera.world_from_camera[:3, 3].numpy() + ORIGIN_M
    )
    assert sample["weather"].keys() == recipe.columns().keys() - {"style", "style_method"}
    assert sample["weather"]["smog_extinction_per_m"] == pytest.approx(3.912 / 50)
    assert sample["paths"]["image"].endswith("000003.png") and sample["paths"]["lidar"] is None
    assert sample["recipe_hash"] == recipe.hash
    assert (sample["scene"], sample["variant"], sample["frame"]) == ("street", "fog-000", 3)


def test_a_flooded_sample_holds_what_it_says(written: Path) -> None:
    files = WeatherDataset(written, variants=["clear-009"], cameras=["front"], frames=[1])
    sample = files[0]
    camera, boxes = make_frame(1).cameras["front"], FakeLabels().boxes(1)
    view = fake_render(open_fake("fake:street"), camera, FLOODED, backend="")
    assert sample["water"].dtype == torch.bool
    np.testing.assert_array_equal(sample["water"].numpy(), view.masks["water"] > 0)
    assert sample["surface"] == "first"
    placed = PlacedBoxes.of(boxes, ORIGIN_M)
    submerged = submerged_fraction(placed, LEVEL_Z_M)
    np.testing.assert_array_equal(sample["boxes"]["submerged_fraction"].numpy(), submerged)
    counted = hidden_pixels(placed, camera, view.effects["flood"].depth_m, view.masks["water"])
    assert counted.marked.sum() > 0
    hidden = [h / p if p else np.nan for p, h in zip(counted.pixels, counted.marked, strict=True)]
    np.testing.assert_array_equal(sample["boxes"]["hidden_fraction"].numpy(), hidden)
    assert sample["paths"]["water"].endswith("water/front/000001.png")
    assert sample["paths"]["box_water"].endswith("labels/water.parquet")


def test_filters(written: Path) -> None:
    assert len(WeatherDataset(written, load=["image"])) == 32
    flooded = WeatherDataset(written, where=pc.field("water_path").is_valid())
    assert set(flooded.table["variant"].to_pylist()) == {"clear-009"}
    foggy = WeatherDataset(written, where=pc.field("smog_extinction_per_m") > 0)
    assert set(foggy.table["variant"].to_pylist()) == {"fog-000", "fog-001"}
    assert len(WeatherDataset(written, cameras=["front"], frames=[0, 2], load=())) == 8
    assert len(WeatherDataset(written, scenes=[])) == 0
    with pytest.raises(ValueError, match=r"no camera \['back'\]; finished are: front, rear/left"):
        WeatherDataset(written, cameras=["back"])
    with pytest.raises(ValueError, match="collection of names; got the string 'street'"):
        WeatherDataset(written, scenes="street")
    with pytest.raises(SceneError, match="no frame 7"):
        SceneDataset(open_fake("fake:s"), make_recipe(), frames=[7], renderer=fake_render)


def test_indices_behave_as_a_lists(written: Path) -> None:
    files = WeatherDataset(written, variants=["fog-000"])
    assert files[-1]["frame"] == 3
    assert len(list(files)) == 8
    for index in (8, -9):
        with pytest.raises(IndexError, match="of a dataset of 8"):
            files[index]


def test_in_a_data_loader_with_workers(written: Path) -> None:
    files = WeatherDataset(written, variants=["fog-000", "clear-009"], frames=[2, 3])
    assert ForkingPickler.dumps(files)  # a worker started by spawn would receive this
    loader = DataLoader(
        files, batch_size=3, num_workers=2, collate_fn=collate_frames,
        multiprocessing_context="fork",
    )  # fmt: skip
    batches = list(loader)
    assert [len(batch["scene"]) for batch in batches] == [3, 3, 2]
    first, last = batches[0], batches[-1]
    assert first["image"].shape == (3, 3, 16, 24)
    assert first["depth"].shape == first["water"].shape == (3, 16, 24)  # clear-009 comes first
    assert last["water"] is None  # without a flood there is none
    assert batches[1]["water"][1] is None and batches[1]["water"][0].shape == (16, 24)
    assert [len(boxes["labels"]) for boxes in first["boxes"]] == [2, 2, 3]
    assert first["camera"]["K"].shape == (3, 3, 3)
    assert first["camera"]["world_from_camera"].dtype == torch.float64
    assert first["camera"]["timestamp_ns"].dtype == torch.int64
    assert last["weather"]["smog_extinction_per_m"].shape == (2,)
    assert torch.equal(last["image"][1], files[7]["image"])


def test_outputs_that_lack_what_others_have_are_refused_by_name(tmp_path: Path) -> None:
    full, bare = tmp_path / "full", tmp_path / "bare"
    write_scene(full, [CLEAR, FOGGY, FLOODED])
    none = {"semantic": False, "labels": False, "lidar": False}
    write_scene(bare, [make_recipe(variant=number, **none) for number in range(4)])
    alike, poor = WeatherDataset(full), WeatherDataset(bare)  # masks need not be everywhere
    assert len(WeatherDataset([full])) == len(alike) == 24
    assert poor[0]["semantic"] is None and poor.given() == {"image", "depth", "instance"}
    fog = "street/fog-000, street/fog-001, street/fog-002 and 1 more"
    named = rf"boxes: none in {bare} \({fog}\); semantic: none in {bare} .* Leave it out "
    with pytest.raises(ValueError, match=named + r"\(load=\('image', 'depth', 'instance', 'water'"):
        WeatherDataset([full, bare])
    with pytest.raises(ValueError, match=rf"lidar: none in {bare} .*load=\('depth',\)"):
        WeatherDataset([full, bare], load=["lidar", "depth"])
    assert len(WeatherDataset([full, bare], load=["image", "depth", "water"])) == 56
    assert len(WeatherDataset([full, bare], variants=["clear-000", "clear-009"])) == 16
    # Of datasets opened apart, by what takes them together.
    with pytest.raises(ValueError, match=rf"`weathered` \({bare}\) have no boxes, semantic, those"):
        MixedDataset(clean_frames(alike), poor, 0.5)
    with pytest.raises(ValueError, match=r"`clean` \(.*full\) have no depth, those of `weathered`"):
        MixedDataset(WeatherDataset(full, load=()), WeatherDataset(bare, load=["depth"]), 0.5)
    with pytest.raises(
        ValueError, match=r"1 of a batch's 2 samples have no semantic: .* street/fo"
    ):
        collate_frames([alike[0], poor[0]])
    for root, fault in (([], "got an empty list"), ([full, tmp_path], "no output folder")):
        with pytest.raises((ValueError, OutputError), match=fault):
            WeatherDataset(root)


def test_outputs_together_have_the_samples_of_each(tmp_path: Path) -> None:
    one, other = tmp_path / "one", tmp_path / "other"
    write_scene(one, [CLEAR, FLOODED])
    write_scene(other, [CLEAR, FOGGY], frames=3)
    apart = [WeatherDataset(one), WeatherDataset(other)]
    both = pickle.loads(pickle.dumps(WeatherDataset([one, other])))
    assert len(both) == len(apart[0]) + len(apart[1]) == 28
    for index, of in ((0, apart[0][0]), (15, apart[0][15]), (16, apart[1][0]), (27, apart[1][11])):
        assert_same_sample(both[index], of)
    assert both.table["output"].to_pylist() == [str(one)] * 16 + [str(other)] * 12
    foggy = WeatherDataset([one, other], where=pc.field("smog_extinction_per_m") > 0)
    assert_same_sample(foggy[0], apart[1][6])
    # A clip is of one output, though both have the scene and the variant.
    lengths = [len(ClipDataset(dataset, 3)) for dataset in (*apart, both)]
    assert lengths[2] == lengths[0] + lengths[1] > 0


def test_failed_images_are_left_out(tmp_path: Path) -> None:
    job = RenderJob("fake:street?unreadable=1", [make_recipe()], tmp_path)
    run_job(job, scene_loader=open_fake, renderer=fake_render, progress=False)
    assert sorted(set(WeatherDataset(tmp_path).table["frame"].to_pylist())) == [0, 2, 3]
    job = RenderJob("fake:none", [make_recipe()], tmp_path / "failed")
    run_job(job, scene_loader=open_fake, renderer=must_not_render, progress=False)
    assert len(WeatherDataset(tmp_path / "failed")) == 0


@pytest.mark.parametrize(
    ("name", "damage", "message"),
    [
        ("images/front/000001.png", None, "000001.png cannot be read.*run the job again"),
        ("images/front/000001.png", 100, "000001.png is damaged: its SHA-256"),
        ("depth/front/000001.png", None, "depth/front/000001.png cannot be read"),
        ("depth/front/000001.png", 300, "depth/front/000001.png is damaged: not a complete PNG"),
        ("semantic/front/000001.png", 0, "semantic/front/000001.png is damaged"),
        ("calibration.json", 50, "calibration.json is missing or not"),
        ("labels/boxes.parquet", 50, "boxes.parquet is missing or not a readable"),
    ],
)
def test_damaged_files_are_named(one_image, name, damage, message) -> None:
    path = one_image / "street" / "fog-000" / name
    data = path.read_bytes()
    path.unlink()
    if damage is not None:
        path.write_bytes(data[:damage])
    files = WeatherDataset(one_image)
    with pytest.raises(OutputError, match=message):
        files[0]


def test_images_of_another_kind_are_named(one_image: Path) -> None:
    folder = one_image / "street" / "fog-000"
    (folder / "depth" / "front" / "000001.png").write_bytes(
        (folder / "semantic" / "front" / "000001.png").read_bytes()
    )
    with pytest.raises(OutputError, match=r"depth/front/000001.png is damaged: expected.*uint16"):
        WeatherDataset(one_image)[0]


@pytest.fixture
def one_flooded_image(tmp_path: Path) -> Path:
    job = RenderJob("fake:street", [FLOODED], tmp_path, frames=[1], cameras=["front"])
    run_job(job, scene_loader=open_fake, renderer=fake_render, progress=False)
    return tmp_path


@pytest.mark.parametrize(
    ("item", "message"),
    [
        ((2, "front"), "water.parquet is damaged: it lacks frame 1, camera 'front'"),
        ((1, "front"), "water.parquet is damaged: frame 1, camera 'front': it has 0 boxes"),
    ],
)
def test_numbers_of_other_boxes_are_refused(one_flooded_image: Path, item, message) -> None:
    none = box_tables()["box_water"].from_json([(), (), (), ()])
    path = one_flooded_image / "street" / "clear-009" / "labels" / "water.parquet"
    path.write_bytes(box_tables()["box_water"].to_bytes({item: none}))
    with pytest.raises(OutputError, match=message):
        WeatherDataset(one_flooded_image)[0]
    path.write_bytes((path.parent / "boxes.parquet").read_bytes())
    with pytest.raises(OutputError, match="holds 'boxes' data; expected 'box water'"):
        WeatherDataset(one_flooded_image)[0]


def test_entries_missing_from_companions_are_named(one_image: Path) -> None:
    path = one_image / "street" / "fog-000" / "calibration.json"
    calibration = json.loads(path.read_text())
    calibration["frames"][0]["cameras"] = {}
    path.write_text(json.dumps(calibration))
    with pytest.raises(OutputError, match=r"calibration.json is damaged: it lacks 'front'"):
        WeatherDataset(one_image)[0]


@pytest.mark.parametrize("path", ["../secret.png", "/etc/hostname", "way/out.png"])
def test_a_manifest_cannot_name_files_outside(one_image: Path, path: str, tmp_path_factory) -> None:
    outside = tmp_path_factory.mktemp("outside")
    (outside / "out.png").write_bytes(b"secret")
    (one_image / "way").symlink_to(outside)
    manifest = one_image / "manifest.parquet"
    table = pq.read_table(manifest)
    place = table.column_names.index("image_path")
    pq.write_table(table.set_column(place, "image_path", pa.array([path])), manifest)
    with pytest.raises(OutputError, match=r"relative to|outside"):
        WeatherDataset(one_image)[0]


def test_folders_that_hold_no_dataset(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match=r"holds neither manifest.parquet nor finished blocks"):
        WeatherDataset(tmp_path)
    (tmp_path / "manifest.parquet").write_bytes(b"PAR1 no")
    with pytest.raises(OutputError, match="not a readable Parquet file"):
        WeatherDataset(tmp_path)
    pq.write_table(pa.table({"scene": ["a"]}), tmp_path / "manifest.parquet")
    with pytest.raises(OutputError, match="lacks the columns"):
        WeatherDataset(tmp_path)


def test_live_rendering_by_the_library(tmp_path: Path) -> None:
    """The same pixels from the files and from the live scene, rendered by the library itself."""
    recipe = make_recipe(image="jpg")
    job = RenderJob("fake:street", [recipe], tmp_path, frames=[1], backend="reference")
    assert run_job(job, scene_loader=open_fake, progress=False).failures == ()
    files = WeatherDataset(tmp_path)
    live = SceneDataset(open_fake("fake:street"), recipe, frames=[1], backend="reference")
    for index in range(2):
        assert_same_sample(live[index], files[index], but=("paths",))
    assert files[0]["image"].std() > 0


def test_live_samples_take_no_gpu_unasked(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("augment.render.cuda.runtime.has_gpu", lambda: True)
    live = SceneDataset(open_fake("fake:street"), make_recipe(), frames=[0])
    assert live._backend == "cpu"


def test_a_forked_worker_cannot_draw_on_the_gpu() -> None:
    live = SceneDataset(
        open_fake("fake:street"), make_recipe(), frames=[0], renderer=fake_render, backend="cuda"
    )
    assert len(list(DataLoader(live, batch_size=None))) == 2
    forked = DataLoader(live, batch_size=None, num_workers=1, multiprocessing_context="fork")
    with pytest.raises(BackendUnavailable, match=r"multiprocessing_context='spawn'"):
        next(iter(forked))
    pickled = bytes(ForkingPickler.dumps(live))  # what a worker started by spawn receives
    live._process = 0  # as if it had been made in another process
    with pytest.raises(BackendUnavailable, match="in a forked process"):
        live[0]
    assert pickle.loads(pickled)[0]["image"].shape == (3, 16, 24)
