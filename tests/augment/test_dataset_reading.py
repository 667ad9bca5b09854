"""What the dataset over files reads, and from where."""

from __future__ import annotations

import pickle
from pathlib import Path

import cv2
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch
from batch_scenes import FakeLabels, fake_render, open_fake
from dataset_folders import CLEAR, FLOODED, FOGGY, MemoryStore, assert_same_sample, write_scene
from torch.utils.data import DataLoader

from augment.dataset import SceneDataset, WeatherDataset, collate_frames
from augment.dataset.weather_dataset import Rows
from augment.errors import OutputError
from augment.geometry import invert_rigid, rotmat_from_quat, transform_points
from augment.jobs.layout import MANIFEST
from augment.jobs.manifest import parse_manifest, publish_part

ALL = ("image", "depth", "semantic", "instance", "water", "snow", "boxes", "lidar")


def same_tables(a: pa.Table, b: pa.Table) -> bool:
    """Equal, where NaN equals NaN."""
    return a.schema.equals(b.schema) and repr(a.to_pydict()) == repr(b.to_pydict())


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("reading") / "out"
    write_scene(out, [CLEAR, FOGGY, FLOODED])
    return out


@pytest.fixture
def remote(written: Path) -> MemoryStore:
    return MemoryStore.of(written)


def test_a_remote_folder_reads_like_a_local_one(written: Path, remote: MemoryStore) -> None:
    here, there = WeatherDataset(written, load=ALL), WeatherDataset(remote, load=ALL)
    assert len(here) == len(there) == 24 and same_tables(here.table, there.table)
    for index in range(24):
        assert_same_sample(here[index], there[index], but=("paths",))
    path = "street/clear-000/images/front/000000.png"
    assert there[0]["paths"]["image"] == f"memory://bucket/out/{path}?region=here"
    assert here[0]["paths"]["image"] == str(written / path)


def test_remote_samples_in_workers(written: Path, remote: MemoryStore) -> None:
    # Starts OpenCV's threads, which forked workers do not have.
    cv2.GaussianBlur(np.zeros((1000, 1000, 3), np.uint8), (0, 0), 3)
    dataset = WeatherDataset(remote, frames=[1])
    expected = [dataset[index] for index in range(6)]
    assert_same_sample(pickle.loads(pickle.dumps(dataset))[5], expected[5])  # as under spawn
    loader = DataLoader(
        dataset, batch_size=3, num_workers=2, collate_fn=collate_frames,
        multiprocessing_context="fork", timeout=100,
    )  # fmt: skip
    batches = list(loader)
    images = torch.cat([batch["image"] for batch in batches])
    assert torch.equal(images, torch.stack([sample["image"] for sample in expected]))
    assert batches[0]["camera"]["world_from_ego"].shape == (3, 4, 4)


@pytest.mark.parametrize(
    ("name", "data", "message"),
    [
        ("images/front/000001.png", None, r"000001.png\?region=here cannot be read"),
        ("images/front/000001.png", b"no", "its SHA-256 is not the manifest's"),
        ("calibration.json", None, r"calibration.json\?region=here cannot be read"),
        ("labels/boxes.parquet", b"no", r"^memory://.*boxes.parquet\?region=here is missing or"),
        ("lidar/000001.parquet", b"no", r"^memory://.*000001.parquet\?region=here is missing or"),
    ],
)
def test_damaged_remote_files_are_named(remote: MemoryStore, name, data, message) -> None:
    path = f"street/{name}" if "lidar" in name else f"street/clear-000/{name}"
    remote.delete([path])
    if data is not None:
        remote.write(path, data)
    dataset = WeatherDataset(remote, variants=["clear-000"], frames=[1], load=ALL)
    with pytest.raises(OutputError, match=message):
        dataset[0]


def test_blocks_of_running_jobs_are_seen(written: Path, remote: MemoryStore) -> None:
    table = parse_manifest(remote.read(MANIFEST), "here")
    remote.delete([MANIFEST])
    publish_part(remote, "block", table.slice(0, 8))
    expected = WeatherDataset(written).table.slice(0, 8)
    assert same_tables(WeatherDataset(remote).table, expected)


@pytest.mark.parametrize("kind", ALL)
def test_only_what_is_asked_for_is_read(remote: MemoryStore, kind: str) -> None:
    folders = {"boxes": "labels", "image": "images"}
    kept = ("manifest", "calibration", f"/{folders.get(kind, kind)}/")
    remote.delete([path for path in remote.files if not any(part in path for part in kept)])
    variant = "clear-009" if kind in ("water", "snow") else "clear-000"
    dataset = WeatherDataset(remote, variants=[variant], frames=[1], load=[kind])
    there = {name for name in ALL if dataset[0][name] is not None}
    assert there == ({kind} if kind != "snow" else set())
    if kind not in ("boxes", "lidar"):
        batch = collate_frames([dataset[0], dataset[1]])
        assert (batch[kind] is None) == (kind == "snow")


def test_options_that_there_are_not(written: Path, unchecked) -> None:
    for options, message in (
        ({"load": "depth"}, r"load must be some of image, .*; got 'depth'"),
        ({"load": ["flow"]}, r"load must be some of image, .*; got \['flow'\]"),
        ({"box_frame": "car"}, "box_frame must be one of world, ego, camera; got 'car'"),
        ({"image_type": "int8"}, "image_type must be one of float32, uint8; got 'int8'"),
    ):
        with pytest.raises(ValueError, match=message):
            WeatherDataset(written, **options)
    with pytest.raises(ValueError, match="load must not have 'lidar' for a live scene"):
        SceneDataset(open_fake("fake:street"), CLEAR, load=ALL, renderer=fake_render)


def test_sweeps(written: Path) -> None:
    dataset = WeatherDataset(written, variants=["clear-000"], cameras=["front"], load=["lidar"])
    sweep = FakeLabels().lidar(1)
    lidar = dataset[1]["lidar"]
    assert lidar["points_m"].numpy().tobytes() == sweep.points_m.tobytes()
    assert lidar["intensity"].dtype == torch.uint8 and lidar["timestamp_ns"][1] == 2**60 + 1
    assert lidar["sensor"].tolist() == ["top", "front"] * 25 and "x" not in lidar
    assert dataset[3]["lidar"] is None  # the source has no sweep of this frame


@pytest.mark.parametrize("frame", ["ego", "camera"])
def test_boxes_and_points_in_other_frames(written: Path, frame) -> None:
    asked = {"variants": ["clear-000"], "cameras": ["rear/left"], "load": ("boxes", "lidar")}
    world = WeatherDataset(written, **asked)[2]
    moved = WeatherDataset(written, box_frame=frame, **asked)[2]
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


def test_live_samples_have_the_same_options(written: Path) -> None:
    options = {"load": ("image", "boxes"), "box_frame": "camera", "transform": lambda s: [s]}
    options |= {"image_type": "uint8"}
    scene = open_fake("fake:street")
    live = SceneDataset(scene, FLOODED, renderer=fake_render, **options)
    files = WeatherDataset(written, variants=["clear-009"], **options)
    assert_same_sample(live[3][0], files[3][0], but=("paths",))
    assert live[3][0]["depth"] is None and live[3][0]["boxes"]["frame"] == "camera"
    assert live[3][0]["image"].dtype == torch.uint8


def test_visibility_of_boxes(written: Path) -> None:
    clear = WeatherDataset(written, variants=["clear-000"], frames=[3])[0]["boxes"]
    assert clear["transmittance"] is None and clear["visibility"].tolist() == [1, 1, 1]
    foggy = WeatherDataset(written, variants=["fog-000"], frames=[3])[0]["boxes"]
    assert torch.equal(foggy["visibility"], foggy["transmittance"])
    assert 0 < foggy["visibility"].max() < 1
    wet = WeatherDataset(written, variants=["clear-009"], frames=[2])[0]["boxes"]
    left = 1 - wet["hidden_fraction"].nan_to_num(0.0)
    np.testing.assert_allclose(wet["visibility"], left)


def test_links_may_lead_inside_only(tmp_path: Path) -> None:
    out = tmp_path / "out"
    write_scene(out, [CLEAR], frames=2)
    image = out / "street/clear-000/images/front/000000.png"
    image.rename(out / "elsewhere.png")
    image.symlink_to(out / "elsewhere.png")
    assert WeatherDataset(out)[0]["image"] is not None
    (out / "elsewhere.png").rename(tmp_path / "outside.png")
    image.unlink()
    image.symlink_to(tmp_path / "outside.png")
    dataset = WeatherDataset(out)
    with pytest.raises(OutputError, match=r"leads through a link to .*outside"):
        dataset[0]
    assert dataset[2]["image"] is not None


@pytest.mark.parametrize("path", ["street/..", "street/a\\b.png", "/", "street/clear-000/", ""])
def test_odd_paths_are_refused(remote: MemoryStore, tmp_path: Path, path: str) -> None:
    table = parse_manifest(remote.read(MANIFEST), "here")
    place = table.column_names.index("image_path")
    table = table.set_column(place, "image_path", pa.array([path] * table.num_rows))
    pq.write_table(table, tmp_path / MANIFEST)
    (tmp_path / "street").mkdir()
    calibration = remote.read("street/clear-000/calibration.json")
    (tmp_path / "street/clear-000").mkdir()
    (tmp_path / "street/clear-000/calibration.json").write_bytes(calibration)
    with pytest.raises(OutputError, match=r"relative to|cannot be read"):
        WeatherDataset(tmp_path)[0]


@pytest.mark.parametrize("checksum", ["ab" * 32, "A" * 64, None, "x"])
def test_columns_are_the_manifests(written: Path, checksum: str | None) -> None:
    """Also those with more values than 16 bits tell apart, or with other checksums."""
    table = pq.read_table(written / MANIFEST)
    whole = WeatherDataset(written).rows
    chosen = whole.take(np.array([5, 3, -1]))
    assert same_tables(whole.to_arrow(), table)
    assert same_tables(chosen.to_arrow(), table.take([5, 3, 23]))
    assert same_row(chosen.row(1), table, 3)

    count = 70_000
    columns = {
        "checksum": pa.array(["ab" * 32, checksum] * (count // 2), pa.string()),
        "image_path": pa.array(["a/b.png", None, "c\nd/e", "f"] * (count // 4), pa.string()),
        "timestamp_ns": pa.array(range(count)),
        "scene": pa.array([f"{k}" for k in range(count)]),
        "snow_depth_m": pa.array([float("nan")] * count),
    }
    table = pa.concat_tables([pa.table(columns).slice(0, 9), pa.table(columns).slice(9)])
    rows = pickle.loads(pickle.dumps(Rows.of(table)))
    assert same_tables(rows.to_arrow(), table)
    assert all(same_row(rows.row(k), table, k) for k in (0, 1, 2, count - 1))
    assert same_tables(Rows.of(table.slice(0, 0)).to_arrow(), table.slice(0, 0))


def same_row(row: dict, table: pa.Table, number: int) -> bool:
    return same_tables(pa.Table.from_pylist([row], table.schema), table.slice(number, 1))
