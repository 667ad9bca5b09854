"""Splits, clips, pairs, mixtures and shards."""

from __future__ import annotations

import json
from collections import Counter
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
import torch
from torch.utils.data import DataLoader

from augment.dataset import (
    ClipDataset,
    MixedDataset,
    PairedDataset,
    ShardedSampler,
    WeatherDataset,
    clean_frames,
    collate_frames,
    split_by_scene,
)
from augment.dataset.weather_dataset import Rows
from tests.augment.batch_scenes import (
    CLEAR,
    FLOODED,
    FOGGY,
    assert_same_sample,
    make_recipe,
    write_scene,
)

FRAMES = 6


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Scene street under three recipes and scene alley under one: six frames of two cameras."""
    out = tmp_path_factory.mktemp("training") / "out"
    write_scene(out, [CLEAR, FOGGY, FLOODED], frames=FRAMES)
    write_scene(out, [CLEAR], name="alley", frames=FRAMES)
    return out


def scenes_of(parts: dict) -> dict[str, set[str]]:
    return {name: set(part["scene"].to_pylist()) for name, part in parts.items()}


def many_scenes(count: int) -> pa.Table:
    names = [f"scene-{k:03d}" for k in range(count) for _ in range(2)]
    return pa.table({"scene": names, "variant": ["clear-000", "fog-000"] * count})


def test_a_split_shares_no_scene_and_loses_none() -> None:
    table = many_scenes(300)
    fractions = {"train": 0.7, "val": 0.2, "test": 0.1}
    parts = scenes_of(split_by_scene(table, fractions, seed=3))
    assert sum(map(len, parts.values())) == 300
    assert set.union(*parts.values()) == set(table["scene"].to_pylist())
    for name, fraction in fractions.items():
        # Four standard deviations of a binomial distribution.
        assert abs(len(parts[name]) - 300 * fraction) < 4 * (300 * fraction * (1 - fraction)) ** 0.5
    assert parts != scenes_of(split_by_scene(table, fractions, seed=4))


def test_a_scene_stays_where_it_is_when_others_come() -> None:
    few, many = (scenes_of(split_by_scene(many_scenes(count))) for count in (40, 90))
    assert all(few[name] == {s for s in many[name] if s < "scene-040"} for name in few)
    # Of this name and seed for ever: other versions must not move it.
    assert {"scene-000", "scene-002", "scene-003", "scene-010"} <= few["val"]
    assert {"scene-001", "scene-004", "scene-005", "scene-011"} <= few["train"]


def test_exact_splits() -> None:
    fractions = {"train": 0.75, "val": 0.15, "test": 0.1}
    for count in (0, 1, 3, 45):
        parts = scenes_of(split_by_scene(many_scenes(count), fractions, exact=True))
        assert sum(map(len, parts.values())) == count
        assert all(abs(len(parts[name]) - f * count) < 1 for name, f in fractions.items())


def test_splits_of_datasets(written: Path) -> None:
    parts = split_by_scene(WeatherDataset(written), {"a": 0.5, "b": 0.5}, exact=True)
    scenes = {name: set(part.table["scene"].to_pylist()) for name, part in parts.items()}
    assert sorted(map(sorted, scenes.values())) == [["alley"], ["street"]]
    assert {len(part) for part in parts.values()} == {12, 36}
    assert all(part[0]["scene"] in scenes[name] for name, part in parts.items())
    for fractions in ({}, {"train": 0.8}, {"train": 1.2, "val": -0.2}):
        with pytest.raises(ValueError, match="fractions must be >= 0 and add up to 1"):
            split_by_scene(WeatherDataset(written), fractions)


def frames_of(clips: ClipDataset) -> list[list[int]]:
    frames = clips.frames.table["frame"].to_numpy()
    return [frames[clips.row_numbers(k)[:, 0]].tolist() for k in range(len(clips))]


def test_clips_are_the_samples_of_their_frames(written: Path) -> None:
    options = {"load": ("image", "depth", "water", "boxes", "lidar"), "box_frame": "ego"}
    frames = WeatherDataset(written, scenes=["street"], variants=["clear-009"], **options)
    clips = ClipDataset(frames, 3)
    assert len(clips) == 4 and frames_of(clips)[1] == [1, 2, 3]
    clip = clips[1]
    for t in range(3):
        for c, camera in enumerate(("front", "rear/left")):
            sample = frames[2 * (1 + t) + c]
            assert sample["camera"]["name"] == camera == clip["camera"]["name"][c]
            for key in ("image", "depth", "water"):
                assert torch.equal(clip[key][t, c], sample[key])
            for key in ("K", "world_from_camera"):
                assert torch.equal(clip["camera"][key][t, c], sample["camera"][key])
            assert torch.equal(
                clip["camera"]["world_from_ego"][t], sample["camera"]["world_from_ego"]
            )
            assert clip["camera"]["timestamp_ns"][t, c] == sample["camera"]["timestamp_ns"]
            boxes = clip["boxes"][t]
            assert torch.equal(boxes["centers_m"], sample["boxes"]["centers_m"])
            per_image = boxes["hidden_fraction"][c], sample["boxes"]["hidden_fraction"]
            np.testing.assert_array_equal(*per_image)
            assert clip["paths"][t][c] == sample["paths"]
    assert clip["frame"].tolist() == [1, 2, 3] and clip["semantic"] is None
    assert [sweep is None for sweep in clip["lidar"]] == [False, False, True]
    assert (clip["scene"], clip["variant"]) == ("street", "clear-009")


def test_boxes_of_clips_in_the_cameras_frames(written: Path) -> None:
    frames = WeatherDataset(written, scenes=["alley"], load=("boxes", "lidar"), box_frame="camera")
    clip = ClipDataset(frames, 2, cameras=["rear/left", "front"], transform=dict)[2]
    assert clip["image"] is None and clip["camera"]["name"] == ["rear/left", "front"]
    boxes = clip["boxes"][1]
    assert boxes["centers_m"].shape == (2, 3, 3) and boxes["sizes_m"].shape == (3, 3)
    assert torch.equal(boxes["centers_m"][1], frames[6]["boxes"]["centers_m"])
    assert [None if s is None else s["points_m"].shape for s in clip["lidar"]] == [(50, 3), None]


def test_clips_never_span_gaps(written: Path) -> None:
    dataset = WeatherDataset(written, load=())
    # Four sequences (three variants and another scene) of six frames.
    assert len(ClipDataset(dataset, 6)) == 4 and len(ClipDataset(dataset, 7)) == 0
    assert frames_of(ClipDataset(dataset, 2, step=3, stride=2))[:2] == [[0, 3], [2, 5]]
    single_scene = dataset.select(np.arange(12))
    rows = single_scene.table
    lacking = np.array([row != (2, "front") for row in zip(
        rows["frame"].to_pylist(), rows["camera"].to_pylist(), strict=True)])  # fmt: skip
    assert frames_of(ClipDataset(single_scene.select(lacking), 2)) == [[0, 1], [3, 4], [4, 5]]
    other = ClipDataset(single_scene.select(lacking), 2, cameras=["rear/left"])
    assert len(other) == 5 and other.row_numbers(1).shape == (2, 1)
    even = dataset.select(dataset.rows.numbers("frame") % 2 == 0)  # a job over every second frame
    assert frames_of(ClipDataset(even, 3)) == [[0, 2, 4]] * 4
    with pytest.raises(ValueError, match="length, step and stride must be >= 1; got"):
        ClipDataset(dataset, 0)
    with pytest.raises(ValueError, match=r"no camera \['back'\]; there are"):
        ClipDataset(dataset, 2, cameras=["back"])
    with pytest.raises(IndexError, match="clip 4 of a dataset of 4"):
        ClipDataset(dataset, 6)[4]
    assert len(ClipDataset(dataset.select(np.zeros(len(dataset), bool)), 1)) == 0


def test_clips_never_span_a_pause(written: Path) -> None:
    alley = WeatherDataset(written, scenes=["alley"])
    table = alley.table
    late_ns = 300_000_000 * (table["frame"].to_numpy() >= 4)
    times = pa.array(table["timestamp_ns"].to_numpy() + late_ns)
    place = table.column_names.index("timestamp_ns")
    alley.rows = Rows.from_table(table.set_column(place, "timestamp_ns", times))
    assert frames_of(ClipDataset(alley, 2)) == [[0, 1], [1, 2], [2, 3], [4, 5]]


def test_pairs_show_the_same_moment(written: Path) -> None:
    dataset = WeatherDataset(written)
    pairs = PairedDataset.of(dataset)
    assert len(pairs) == 24 and pairs.num_unpaired == 0
    moments = set()
    for index in range(len(pairs)):
        clean, weathered = pairs[index]["clean"], pairs[index]["weathered"]
        for key in ("scene", "frame"):
            assert clean[key] == weathered[key]
        assert clean["camera"]["name"] == weathered["camera"]["name"]
        assert clean["variant"] == "clear-000"
        moments.add(weathered["variant"])
    assert moments == {"fog-000", "clear-009"}
    fog_pairs = PairedDataset.of(dataset, clean_variant="fog-000")
    assert len(fog_pairs) == 24 and fog_pairs[0]["clean"]["variant"] == "fog-000"
    assert fog_pairs.num_unpaired == 12  # alley has no fog


def test_what_is_clean(written: Path, tmp_path: Path) -> None:
    from recipes.flood import Flood
    from recipes.snow import Snow

    level = make_recipe("clear", variant=1, flood=Flood(level_m=0.0))
    bare = make_recipe("clear", variant=2, snow=Snow(depth_m=0.0))
    write_scene(tmp_path, [CLEAR, level, bare], frames=2)
    clean = clean_frames(WeatherDataset(tmp_path))
    # Water at a level of 0 is water; snow of no depth is none.
    assert set(clean.table["variant"].to_pylist()) == {"clear-000", "clear-002"}
    dataset = WeatherDataset(tmp_path)
    with pytest.raises(ValueError, match=r"frame 0, camera 'front' has more than one clean image"):
        PairedDataset.of(dataset)
    assert len(PairedDataset.of(dataset, "clear-002")) == 8
    with pytest.raises(ValueError, match=r"no variant 'x'; there are clear-000, clear-001"):
        clean_frames(dataset, "x")
    foggy = WeatherDataset(written, scenes=["street"], variants=["fog-000"], frames=[5])
    with pytest.raises(ValueError, match="no clean image has the scene, frame and camera"):
        PairedDataset(clean_frames(dataset, "clear-000"), foggy)


def test_mixtures_depend_on_seed_epoch_and_index_only(written: Path) -> None:
    dataset = WeatherDataset(written, load=())
    clean = clean_frames(dataset)
    weathered = dataset.select(dataset.rows.numbers("frame") < 5)
    weathered = weathered.select(
        np.array([name != "clear-000" for name in weathered.table["variant"].to_pylist()])
    )
    mixed = MixedDataset(clean, weathered, 0.5, seed=1)
    assert len(mixed) == len(clean) == 24
    counts: Counter[str] = Counter()
    of_clean, of_weathered = clean.table.to_pylist(), weathered.table.to_pylist()
    for epoch in range(40):
        mixed.set_epoch(epoch)
        for index in range(24):
            row = mixed.weathered_row(index)
            if of_clean[index]["scene"] == "street" and of_clean[index]["frame"] < 5:
                counts["clear-000" if row is None else of_weathered[row]["variant"]] += 1
            else:
                assert row is None
            if row is not None:
                for name in ("scene", "frame", "camera"):
                    assert of_weathered[row][name] == of_clean[index][name]
    # 400 draws; four standard deviations.
    assert abs(counts["clear-000"] - 200) < 40 and abs(counts["fog-000"] - 100) < 35
    mixed.set_epoch(3)
    again = MixedDataset(clean, weathered, 0.5, seed=1)
    again.set_epoch(3)
    rows = [mixed.weathered_row(k) for k in range(24)]
    for index in (rows.index(None), next(k for k in range(24) if rows[k] is not None)):
        row = rows[index]
        expected = clean[index] if row is None else weathered[row]
        assert_same_sample(mixed[index], expected)
    assert rows == [again.weathered_row(k) for k in reversed(range(24))][::-1]
    assert rows != [MixedDataset(clean, weathered, 0.5, seed=2).weathered_row(k) for k in range(24)]
    never = MixedDataset(clean, weathered, 0.0)
    assert [never.weathered_row(k) for k in range(24)] == [None] * 24
    with pytest.raises(ValueError, match=r"fraction must be 0 to 1; got 1\.5"):
        MixedDataset(clean, weathered, 1.5)


@pytest.mark.parametrize("remainder", ["exact", "pad", "drop"])
def test_every_sample_once_over_all_ranks(remainder) -> None:
    for count, ranks in ((0, 1), (0, 3), (1, 5), (7, 2), (7, 3), (24, 1), (24, 3), (24, 5)):
        samplers = [
            ShardedSampler(count, rank=rank, ranks=ranks, seed=5, remainder=remainder)
            for rank in range(ranks)
        ]
        shares = [list(sampler) for sampler in samplers]
        assert [len(share) for share in shares] == [len(sampler) for sampler in samplers]
        counts = Counter(index for share in shares for index in share)
        if remainder == "exact":
            assert counts == Counter(range(count))
        else:
            assert len(set(map(len, shares))) == 1
            extra = counts.total() - count
            assert -ranks < extra < ranks and (extra >= 0) == (remainder == "pad" or extra == 0)
            assert set(counts) <= set(range(count)) and len(counts) == min(count, counts.total())


def test_orders_differ_by_epoch_and_seed() -> None:
    first_sampler, second_sampler = ShardedSampler(50, seed=1), ShardedSampler(50, seed=1)
    first = list(first_sampler)
    assert first == list(first_sampler) == list(second_sampler) and sorted(first) == list(range(50))
    first_sampler.set_epoch(1)
    assert list(first_sampler) != first and list(ShardedSampler(50, seed=2)) != first
    assert list(ShardedSampler(range(5), shuffle=False)) == [0, 1, 2, 3, 4]


@pytest.mark.parametrize("ranks_after", [1, 2, 3])
def test_an_epoch_goes_on_after_an_interruption(ranks_after: int) -> None:
    before = [ShardedSampler(23, rank=rank, ranks=2, seed=4) for rank in range(2)]
    for sampler in before:
        sampler.set_epoch(6)
    trained = [index for sampler in before for index in list(sampler)[:5]]
    state = json.loads(json.dumps(before[1].state_dict(num_trained=5)))
    after = [ShardedSampler(23, rank=r, ranks=ranks_after, seed=4) for r in range(ranks_after)]
    for sampler in after:
        sampler.load_state_dict(state)
        assert sampler.epoch == 6
    left = [index for sampler in after for index in sampler]
    assert Counter(trained + left) == Counter(range(23))
    assert sum(map(len, after)) == 13
    # Stopped again, three samples of each rank later.
    again = ShardedSampler(23, seed=4)
    again.load_state_dict(after[0].state_dict(num_trained=3))
    assert len(again) == 13 - 3 * ranks_after
    again.set_epoch(7)
    assert len(again) == 23


def test_a_sampler_knows_what_it_gave_out(unchecked) -> None:
    sampler = ShardedSampler(10, seed=4)
    iterator = iter(sampler)
    first = [next(iterator) for _ in range(4)]
    other = ShardedSampler(10, seed=4)
    other.load_state_dict(sampler.state_dict())
    assert sorted(first + list(other)) == list(range(10))
    assert other.state_dict()["done"] == 10 and ShardedSampler(10).state_dict()["done"] == 0
    with pytest.raises(ValueError, match="the state is of another sampler: seed 4 there and 9"):
        ShardedSampler(10, seed=9).load_state_dict(sampler.state_dict())
    with pytest.raises(ValueError, match="rank must be 0 to 1 of 2; got 2"):
        ShardedSampler(4, rank=2, ranks=2)
    with pytest.raises(ValueError, match="remainder must be one of exact, pad, drop; got 'cut'"):
        ShardedSampler(4, remainder="cut")


def test_ranks_and_workers_share_an_epoch(written: Path) -> None:
    dataset = WeatherDataset(written, load=())
    counts: Counter[tuple] = Counter()
    for rank in range(2):
        loader = DataLoader(
            dataset, batch_size=5, num_workers=2, collate_fn=collate_frames,
            sampler=ShardedSampler(dataset, rank=rank, ranks=2), multiprocessing_context="fork",
        )  # fmt: skip
        for batch in loader:
            keys = (
                batch["scene"],
                batch["variant"],
                batch["frame"].tolist(),
                batch["camera"]["name"],
            )
            counts.update(zip(*keys, strict=True))
    assert len(counts) == 48 and set(counts.values()) == {1}
