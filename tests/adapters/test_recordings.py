"""Scenes of folders of many scenes, and the conditions that datasets state of their recordings."""

from __future__ import annotations

from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from adapters.base import expand_datasets, recorded_conditions
from adapters.waymo.dataset import POSES
from recipes.job import JobScene
from tests.adapters.nuscenes_files import Dataset

DESCRIPTIONS = {
    "scene-0001": "Rain, parked trucks, night",
    "scene-0002": "Training on a terrain with a drain, after sunset",
    "scene-0003": "Night drive, rainy, light fog",
}


@pytest.fixture
def nuscenes(tmp_path: Path) -> Path:
    dataset = Dataset(tmp_path)
    for name in DESCRIPTIONS:
        dataset.add_scene(name, [10**15])
    for row in dataset.rows["scene"]:
        row["description"] = DESCRIPTIONS[row["name"]]
    return dataset.write()


def test_a_nuscenes_folder_stands_for_its_scenes(nuscenes: Path) -> None:
    entry = JobScene(uri=f"nuscenes:{nuscenes}?sweeps=0", frames="::2")
    scenes = expand_datasets([entry])
    assert [s.uri for s in scenes] == [
        f"nuscenes:{nuscenes}?sweeps=0&scene={name}" for name in DESCRIPTIONS
    ]
    assert {s.frames for s in scenes} == {"::2"}
    one = JobScene(uri=f"nuscenes:{nuscenes}?scene=scene-0002")
    assert expand_datasets([one]) == [one]
    street = JobScene(uri="procedural:street?seed=3")
    assert expand_datasets([street]) == [street]
    nowhere = JobScene(uri="waymo:/nowhere")  # stays, so that opening it says what is missing
    assert expand_datasets([nowhere]) == [nowhere]


def test_nuscenes_descriptions_state_conditions_by_whole_words(nuscenes: Path) -> None:
    found = {n: recorded_conditions(f"nuscenes:{nuscenes}?scene={n}") for n in DESCRIPTIONS}
    assert found == {
        "scene-0001": ("night", "rain"),
        "scene-0002": (),
        "scene-0003": ("fog", "night", "rain"),
    }
    assert recorded_conditions("procedural:street?seed=3") == ()


def test_waymo_statistics_state_conditions(tmp_path: Path) -> None:
    for name, weather, time in (("1_a", "rain", "Night"), ("2_b", "sunny", "Day"), ("3_c", "", "")):
        for tag in (POSES, "stats"):
            if tag == "stats" and name == "3_c":
                continue  # as of a folder into which the component was not copied
            (tmp_path / "validation" / tag).mkdir(parents=True, exist_ok=True)
            columns = {"key.segment_context_name": [name] * 2}
            if tag == "stats":
                columns["[StatsComponent].weather"] = [weather] * 2
                columns["[StatsComponent].time_of_day"] = [time] * 2
            pq.write_table(pa.table(columns), tmp_path / "validation" / tag / f"{name}.parquet")
    scenes = expand_datasets([JobScene(uri=f"waymo:{tmp_path}")])
    assert [s.uri.rpartition("segment=")[2] for s in scenes] == ["1_a", "2_b", "3_c"]
    assert [recorded_conditions(s.uri) for s in scenes] == [("night", "rain"), (), ()]
