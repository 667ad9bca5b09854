"""The datasets over files, here and in stores elsewhere, and over live scenes."""

from __future__ import annotations

import json
import pickle
from collections.abc import Iterable
from dataclasses import dataclass, field
from multiprocessing.reduction import ForkingPickler
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest
import torch
from torch.utils.data import DataLoader

from augment.dataset import (
    ClipDataset,
    MixedDataset,
    SceneDataset,
    WeatherDataset,
    clean_frames,
    collate_frames,
)
from augment.dataset.weather_dataset import Rows
from augment.errors import BackendUnavailable, OutputError, SceneError
from augment.jobs.render_job import RenderJob, run_job
from augment.output.box_weather import box_tables
from augment.output.manifest import parse_manifest, publish_part
from augment.output.names import MANIFEST_FILE
from augment.output.store import StoredFile, StoredFileMissing
from augment.scene.geometry import invert_rigid, rotmat_from_quat, transform_points
from recipes.schema import Recipe, columns_of_effects
from tests.augment.batch_scenes import (
    CLEAR,
    FLOODED,
    FOGGY,
    ORIGIN_M,
    FakeLabels,
    assert_same_sample,
    fake_render,
    make_frame,
    make_recipe,
    must_not_render,
    open_fake,
    write_scene,
)

FOLDER = Path("street") / "fog-000"
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
    words = {name for name, column in columns_of_effects().items() if not column.is_number}
    assert sample["weather"].keys() == recipe.columns().keys() - words
    assert sample["weather"]["smog_extinction_per_m"] == pytest.approx(3.912 / 50)
    assert sample["paths"]["image"].endswith("000003.png") and sample["paths"]["lidar"] is None
    assert sample["recipe_hash"] == recipe.hash
    assert (sample["scene"], sample["variant"], sample["frame"]) == ("street", "fog-000", 3)


def test_filters(written: Path) -> None:
    assert len(WeatherDataset(written, load=["image"])) == 32
    flooded = WeatherDataset(written, where=pc.field("water_path").is_valid())
    assert set(flooded.table["variant"].to_pylist()) == {"clear-009"}
    foggy = WeatherDataset(written, where=pc.field("smog_extinction_per_m") > 0)
    assert set(foggy.table["variant"].to_pylist()) == {"fog-000", "fog-001"}
    assert len(WeatherDataset(written, cameras=["front"], frames=[0, 2], load=())) == 8
    assert len(WeatherDataset(written, scenes=[])) == 0
    assert foggy[-1]["frame"] == 3 and len(list(foggy)) == 16
    for index in (16, -17):
        with pytest.raises(IndexError, match="of a dataset of 16"):
            foggy[index]
    with pytest.raises(ValueError, match=r"no camera \['back'\]; finished are: front, rear/left"):
        WeatherDataset(written, cameras=["back"])
    with pytest.raises(ValueError, match="collection of names; got the string 'street'"):
        WeatherDataset(written, scenes="street")
    with pytest.raises(SceneError, match="no frame 7"):
        SceneDataset(open_fake("fake:s"), make_recipe(), frames=[7], renderer=fake_render)


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
    complete, poor = WeatherDataset(full), WeatherDataset(bare)  # masks need not be everywhere
    assert len(WeatherDataset([full])) == len(complete) == 24
    assert poor[0]["semantic"] is None and poor.available_kinds() == {"image", "depth", "instance"}
    fog = "street/fog-000, street/fog-001, street/fog-002 and 1 more"
    message = rf"boxes: none in {bare} \({fog}\); semantic: none in {bare} .* Leave it out "
    with pytest.raises(ValueError, match=message + r"\(load=\('image', 'depth', 'instance', "):
        WeatherDataset([full, bare])
    with pytest.raises(ValueError, match=rf"lidar: none in {bare} .*load=\('depth',\)"):
        WeatherDataset([full, bare], load=["lidar", "depth"])
    assert len(WeatherDataset([full, bare], load=["image", "depth", "water"])) == 56
    assert len(WeatherDataset([full, bare], variants=["clear-000", "clear-009"])) == 16
    # Of datasets opened apart, by what takes them together.
    with pytest.raises(ValueError, match=rf"`weathered` \({bare}\) have no boxes, semantic, those"):
        MixedDataset(clean_frames(complete), poor, 0.5)
    with pytest.raises(ValueError, match=r"`clean` \(.*full\) have no depth, those of `weathered`"):
        MixedDataset(WeatherDataset(full, load=()), WeatherDataset(bare, load=["depth"]), 0.5)
    with pytest.raises(
        ValueError, match=r"1 of a batch's 2 samples have no semantic: .* street/fo"
    ):
        collate_frames([complete[0], poor[0]])
    for root, fault in (([], "got an empty list"), ([full, tmp_path], "no output folder")):
        with pytest.raises((ValueError, OutputError), match=fault):
            WeatherDataset(root)


def test_outputs_together_have_the_samples_of_each(tmp_path: Path) -> None:
    first_folder, second_folder = tmp_path / "one", tmp_path / "other"
    write_scene(first_folder, [CLEAR, FLOODED])
    write_scene(second_folder, [CLEAR, FOGGY], frames=3)
    datasets = [WeatherDataset(first_folder), WeatherDataset(second_folder)]
    both = pickle.loads(pickle.dumps(WeatherDataset([first_folder, second_folder])))
    assert len(both) == len(datasets[0]) + len(datasets[1]) == 28
    for index, of in (
        (0, datasets[0][0]),
        (15, datasets[0][15]),
        (16, datasets[1][0]),
        (27, datasets[1][11]),
    ):
        assert_same_sample(both[index], of)
    assert both.table["output"].to_pylist() == [str(first_folder)] * 16 + [str(second_folder)] * 12
    foggy = WeatherDataset(
        [first_folder, second_folder], where=pc.field("smog_extinction_per_m") > 0
    )
    assert_same_sample(foggy[0], datasets[1][6])
    # A clip is of one output, though both have the scene and the variant.
    lengths = [len(ClipDataset(dataset, 3)) for dataset in (*datasets, both)]
    assert lengths[2] == lengths[0] + lengths[1] > 0


def test_failed_images_are_left_out(tmp_path: Path) -> None:
    job = RenderJob("fake:street?unreadable=1", [make_recipe()], tmp_path)
    run_job(job, scene_loader=open_fake, renderer=fake_render, progress=False)
    assert sorted(set(WeatherDataset(tmp_path).table["frame"].to_pylist())) == [0, 2, 3]
    job = RenderJob("fake:none", [make_recipe()], tmp_path / "failed")
    run_job(job, scene_loader=open_fake, renderer=must_not_render, progress=False)
    assert len(WeatherDataset(tmp_path / "failed")) == 0


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


def test_damaged_files_are_named(one_image: Path) -> None:
    folder = one_image / FOLDER
    calibration = json.loads((folder / "calibration.json").read_text())
    calibration["frames"][0]["cameras"] = {}
    for name, damage, message in (
        ("images/front/000001.png", None, "000001.png cannot be read.*run the job again"),
        ("images/front/000001.png", 100, "000001.png is damaged: its SHA-256"),
        ("depth/front/000001.png", 300, "depth/front/000001.png is damaged: not a complete PNG"),
        ("depth/front/000001.png", (folder / "semantic/front/000001.png").read_bytes(),
         r"depth/front/000001.png is damaged: expected.*uint16"),
        ("semantic/front/000001.png", 0, "semantic/front/000001.png is damaged"),
        ("calibration.json", 50, "calibration.json is missing or not"),
        ("calibration.json", json.dumps(calibration).encode(), r"damaged: it lacks 'front'"),
        ("labels/boxes.parquet", 50, "boxes.parquet is missing or not a readable"),
    ):  # fmt: skip
        path, data = folder / name, (folder / name).read_bytes()
        path.unlink()
        if damage is not None:
            path.write_bytes(data[:damage] if isinstance(damage, int) else damage)
        with pytest.raises(OutputError, match=message):
            WeatherDataset(one_image)[0]
        path.write_bytes(data)
    assert WeatherDataset(one_image)[0]["image"] is not None


def test_a_manifest_cannot_name_files_outside(one_image: Path, tmp_path_factory) -> None:
    outside = tmp_path_factory.mktemp("outside")
    (outside / "out.png").write_bytes(b"secret")
    (one_image / "way").symlink_to(outside)
    manifest = one_image / "manifest.parquet"
    table = pq.read_table(manifest)
    place = table.column_names.index("image_path")
    for path in ("../secret.png", "/etc/hostname", "way/out.png", "street/..", "street/a\\b.png",
                 "/", "street/fog-000/", ""):  # fmt: skip
        pq.write_table(table.set_column(place, "image_path", pa.array([path])), manifest)
        with pytest.raises(OutputError, match=r"relative to|outside|cannot be read"):
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


# ---- What is read, and from where ---------------------------------------------------------------

ALL = ("image", "depth", "semantic", "instance", "water", "snow", "boxes", "lidar")


def same_tables(a: pa.Table, b: pa.Table) -> bool:
    """Equal, where NaN equals NaN."""
    return a.schema.equals(b.schema) and repr(a.to_pydict()) == repr(b.to_pydict())


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("reading") / "out"
    write_scene(out, [CLEAR, FOGGY, FLOODED])
    return out


@dataclass
class MemoryStore:
    """A store that is not on this machine, as far as readers can tell."""

    files: dict[str, bytes] = field(default_factory=dict)
    uri: str = "memory://bucket/out?region=here"
    local_dir: Path | None = None

    @staticmethod
    def of(folder: Path) -> MemoryStore:
        files = (path for path in folder.rglob("*") if path.is_file())
        return MemoryStore({p.relative_to(folder).as_posix(): p.read_bytes() for p in files})

    def read(self, path: str) -> bytes:
        if path not in self.files:
            raise StoredFileMissing(f"{path} is not in {self.uri}")
        return self.files[path]

    def write(self, path: str, data: bytes) -> None:
        self.files[path] = data

    def put_file(self, path: str, source: Path) -> None:
        self.files[path] = source.read_bytes()

    def list(self, folder: str) -> dict[str, StoredFile]:
        inside = f"{folder}/" if folder else ""
        names = sorted(name for name in self.files if name.startswith(inside))
        return {name: StoredFile(len(self.files[name]), 0.0) for name in names}

    def exists(self, path: str) -> bool:
        return path in self.files

    def delete(self, paths: Iterable[str]) -> None:
        for path in paths:
            self.files.pop(path, None)


@pytest.fixture
def remote(folder: Path) -> MemoryStore:
    return MemoryStore.of(folder)


def test_a_remote_folder_reads_like_a_local_one(folder: Path, remote: MemoryStore) -> None:
    local, remote_dataset = WeatherDataset(folder, load=ALL), WeatherDataset(remote, load=ALL)
    assert len(local) == len(remote_dataset) == 24 and same_tables(
        local.table, remote_dataset.table
    )
    for index in range(24):
        assert_same_sample(local[index], remote_dataset[index], but=("paths",))
    path = "street/clear-000/images/front/000000.png"
    assert remote_dataset[0]["paths"]["image"] == f"memory://bucket/out/{path}?region=here"
    assert local[0]["paths"]["image"] == str(folder / path)


def test_blocks_of_running_jobs_are_seen(folder: Path, remote: MemoryStore) -> None:
    table = parse_manifest(remote.read(MANIFEST_FILE), "here")
    remote.delete([MANIFEST_FILE])
    publish_part(remote, "block", table.slice(0, 8))
    expected = WeatherDataset(folder).table.slice(0, 8)
    assert same_tables(WeatherDataset(remote).table, expected)


def test_options_that_there_are_not(folder: Path, unchecked) -> None:
    for options, message in (
        ({"load": "depth"}, r"load must be some of image, .*; got 'depth'"),
        ({"load": ["flow"]}, r"load must be some of image, .*; got \['flow'\]"),
        ({"box_frame": "car"}, "box_frame must be one of world, ego, camera; got 'car'"),
        ({"image_type": "int8"}, "image_type must be one of float32, uint8; got 'int8'"),
    ):
        with pytest.raises(ValueError, match=message):
            WeatherDataset(folder, **options)
    with pytest.raises(ValueError, match="load must not have 'lidar' for a live scene"):
        SceneDataset(open_fake("fake:street"), CLEAR, load=ALL, renderer=fake_render)


def test_sweeps(folder: Path) -> None:
    dataset = WeatherDataset(folder, variants=["clear-000"], cameras=["front"], load=["lidar"])
    sweep = FakeLabels().lidar(1)
    lidar = dataset[1]["lidar"]
    assert lidar["points_m"].numpy().tobytes() == sweep.points_m.tobytes()
    assert lidar["intensity"].dtype == torch.uint8 and lidar["timestamp_ns"][1] == 2**60 + 1
    assert lidar["sensor"].tolist() == ["top", "front"] * 25 and "x" not in lidar
    assert dataset[3]["lidar"] is None  # the source has no sweep of this frame


@pytest.mark.parametrize("frame", ["ego", "camera"])
def test_boxes_and_points_in_other_frames(folder: Path, frame) -> None:
    selection = {"variants": ["clear-000"], "cameras": ["rear/left"], "load": ("boxes", "lidar")}
    world = WeatherDataset(folder, **selection)[2]
    moved = WeatherDataset(folder, box_frame=frame, **selection)[2]
    assert (world["boxes"]["frame"], moved["boxes"]["frame"]) == ("world", frame)
    frame_from_world = invert_rigid(moved["camera"][f"world_from_{frame}"])
    for key, kind in (("centers_m", "boxes"), ("points_m", "lidar")):
        expected = transform_points(frame_from_world, world[kind][key])
        # The world's coordinates are 4e6 m: a unit in their last place is 1e-9 m.
        np.testing.assert_allclose(moved[kind][key], expected, atol=1e-8)
    rotations = frame_from_world[:3, :3] @ rotmat_from_quat(world["boxes"]["quats"])
    np.testing.assert_allclose(rotmat_from_quat(moved["boxes"]["quats"]), rotations, atol=1e-12)
    assert torch.equal(moved["boxes"]["sizes_m"], world["boxes"]["sizes_m"])
    ego = moved["camera"]["world_from_ego"]
    assert ego.dtype == torch.float64 and ego[0, 3] == world["camera"]["world_from_ego"][0, 3]


def test_only_what_is_asked_for_is_read(remote: MemoryStore) -> None:
    all_files = dict(remote.files)
    folders = {"boxes": "labels", "image": "images"}
    for kind in ALL:
        name_parts = ("manifest", "calibration", f"/{folders.get(kind, kind)}/")
        remote.files = {p: d for p, d in all_files.items() if any(part in p for part in name_parts)}
        variant = "clear-009" if kind in ("water", "snow") else "clear-000"
        dataset = WeatherDataset(remote, variants=[variant], frames=[1], load=[kind])
        kinds = {name for name in ALL if dataset[0][name] is not None}
        assert kinds == ({kind} if kind != "snow" else set())
        if kind not in ("boxes", "lidar"):
            batch = collate_frames([dataset[0], dataset[1]])
            assert (batch[kind] is None) == (kind == "snow")


@pytest.mark.parametrize("checksum", ["ab" * 32, None, "x"])
def test_columns_are_the_manifests(folder: Path, checksum: str | None) -> None:
    """Also those with more values than 16 bits tell apart, or with other checksums."""
    table = pq.read_table(folder / MANIFEST_FILE)
    all_rows = WeatherDataset(folder).rows
    chosen = all_rows.take(np.array([5, 3, -1]))
    assert same_tables(all_rows.to_arrow(), table)
    assert same_tables(chosen.to_arrow(), table.take([5, 3, 23]))
    assert same_row(chosen.row(1), table, 3)

    count = 66_000
    columns = {
        "checksum": pa.array(["ab" * 32, checksum] * (count // 2), pa.string()),
        "image_path": pa.array(["a/b.png", None, "c\nd/e", "f"] * (count // 4), pa.string()),
        "timestamp_ns": pa.array(range(count)),
        "scene": pa.array([f"{k}" for k in range(count)]),
        "snow_depth_m": pa.array([float("nan")] * count),
    }
    table = pa.concat_tables([pa.table(columns).slice(0, 9), pa.table(columns).slice(9)])
    rows = pickle.loads(pickle.dumps(Rows.from_table(table)))
    assert same_tables(rows.to_arrow(), table)
    assert all(same_row(rows.row(k), table, k) for k in (0, 1, 2, count - 1))
    assert same_tables(Rows.from_table(table.slice(0, 0)).to_arrow(), table.slice(0, 0))


def same_row(row: dict, table: pa.Table, number: int) -> bool:
    return same_tables(pa.Table.from_pylist([row], table.schema), table.slice(number, 1))
