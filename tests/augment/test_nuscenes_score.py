"""NDS by another Python: against values worked by hand where nuscenes-devkit is, and its refusals.

NUSCENES_PYTHON names a Python that has the devkit; without it the tests with the devkit are
skipped. A stand-in for the devkit tests everything else.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from augment.errors import ScoreError
from augment.scores.nuscenes_metric import NuScenesSplit, detection_score
from tests.adapters.nuscenes_files import SCENES, read_table, write_as_nuscenes, write_table

VERSION = "v1.0-trainval"
CLASSES = {"car": "car", "truck": "truck", "pedestrian.adult": "pedestrian"}
# Of the ten classes of the benchmark three have objects.
SHARE = 3 / 10
# Cones have no direction, cones and barriers no speed and no attribute.
DIRECTION_SHARE = 3 / 9
ATTRIBUTE_SHARE = 3 / 8


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = write_as_nuscenes(tmp_path_factory.mktemp("nuscenes"), version=VERSION, semantic=False)
    rows = read_table(root, "sample_annotation", VERSION)
    # Objects without a return do not count in the benchmark.
    write_table(root, "sample_annotation", [{**row, "num_lidar_pts": 5} for row in rows], VERSION)
    return root


def write_results(
    path: Path, root: Path, shift_m: Callable[[str], float] = lambda scene: 0.0
) -> Path:
    """Write the truth as results; boxes of a scene are shifted along the world's x axis."""
    tables = {
        name: {row["token"]: row for row in read_table(root, name, VERSION)}
        for name in ("sample", "sample_annotation", "instance", "category", "attribute", "scene")
    }
    samples = tables["sample"]
    annotations = tables["sample_annotation"]
    results: dict[str, list[dict]] = {token: [] for token in samples}
    for row in annotations.values():
        first = annotations[row["prev"] or row["token"]]
        last = annotations[row["next"] or row["token"]]
        time_s = 1e-6 * (
            samples[last["sample_token"]]["timestamp"] - samples[first["sample_token"]]["timestamp"]
        )
        way_m = np.subtract(last["translation"], first["translation"])[:2]
        sample = samples[row["sample_token"]]
        x, y, z = row["translation"]
        category = tables["category"][tables["instance"][row["instance_token"]]["category_token"]]
        results[row["sample_token"]].append(
            {
                "sample_token": row["sample_token"],
                "translation": [x + shift_m(tables["scene"][sample["scene_token"]]["name"]), y, z],
                "size": row["size"],
                "rotation": row["rotation"],
                "velocity": (way_m / time_s).tolist(),
                "detection_name": CLASSES[category["name"].split(".", 1)[1]],
                "detection_score": 0.9,
                "attribute_name": tables["attribute"][row["attribute_tokens"][0]]["name"],
            }
        )
    path.write_text(json.dumps({"results": results}))
    return path


def score_by_hand(average_precision: float, position_error_m: float) -> float:
    """Return NDS where three classes have this AP and this error of position, and no other error.

    NDS = (5 mAP + sum over five errors of 1 - min(1, error)) / 10. Classes without objects have an
    AP of 0 and errors of 1.
    """
    place = 1 - (SHARE * position_error_m + 1 - SHARE)
    return (
        5 * SHARE * average_precision + place + SHARE + DIRECTION_SHARE + 2 * ATTRIBUTE_SHARE
    ) / 10


@pytest.fixture
def devkit_split(dataset: Path) -> NuScenesSplit:
    python = os.environ.get("NUSCENES_PYTHON")
    if not python:
        pytest.skip("NUSCENES_PYTHON names no Python with nuscenes-devkit")
    return NuScenesSplit(dataset, VERSION, "train", Path(python))


@pytest.mark.long
def test_the_truth_scores_one_in_all_classes_that_have_objects(dataset, devkit_split, tmp_path):
    path = write_results(tmp_path / "results.json", dataset)
    score = detection_score(path, devkit_split, SCENES)
    assert {name for name, value in score.by_class.items() if value == pytest.approx(1)} == {
        *CLASSES.values()
    }
    assert score.score == pytest.approx(score_by_hand(1.0, 0.0))


@pytest.mark.long
def test_boxes_beside_their_place_lose_one_of_four_thresholds(dataset, devkit_split, tmp_path):
    # 0.75 m are over the threshold of 0.5 m, and below those of 1, 2 and 4 m.
    path = write_results(tmp_path / "results.json", dataset, lambda scene: 0.75)
    score = detection_score(path, devkit_split, SCENES)
    assert score.by_class["car"] == pytest.approx(0.75)
    assert score.errors["trans_err"] == pytest.approx(SHARE * 0.75 + 1 - SHARE)
    assert score.score == pytest.approx(score_by_hand(0.75, 0.75))


@pytest.mark.long
def test_scenes_that_do_not_count_change_no_score(dataset, devkit_split, tmp_path):
    shifts_m = {SCENES[0]: 0.0, SCENES[1]: 3.0}
    path = write_results(tmp_path / "results.json", dataset, lambda scene: shifts_m[scene])
    score = detection_score(path, devkit_split, SCENES, [SCENES[1]])
    assert score.score == pytest.approx(score_by_hand(1.0, 0.0))
    assert detection_score(path, devkit_split, SCENES).score < score.score
    with pytest.raises(ScoreError, match=r"1 scenes of train are not in the suite, .* scene-0002"):
        detection_score(path, devkit_split, SCENES[:1])


@pytest.mark.long
def test_a_split_of_ones_own_needs_the_samples_of_its_scenes_alone(dataset, devkit_split, tmp_path):
    path = write_results(tmp_path / "results.json", dataset)
    content = json.loads(path.read_text())
    scene_of_token = {row["token"]: row["name"] for row in read_table(dataset, "scene", VERSION)}
    names = {
        row["token"]: scene_of_token[row["scene_token"]]
        for row in read_table(dataset, "sample", VERSION)
    }
    content["results"] = {t: b for t, b in content["results"].items() if names[t] == SCENES[1]}
    path.write_text(json.dumps(content))
    write_table(dataset, "splits", {"mine": [SCENES[1]]}, VERSION)
    score = detection_score(path, replace(devkit_split, split="mine"), [SCENES[1]])
    assert score.score == pytest.approx(score_by_hand(1.0, 0.0))


@pytest.mark.long
def test_the_devkit_refuses_results_that_lack_a_sample(dataset, devkit_split, tmp_path):
    path = write_results(tmp_path / "results.json", dataset)
    content = json.loads(path.read_text())
    content["results"].popitem()
    path.write_text(json.dumps(content))
    with pytest.raises(ScoreError, match=r"AssertionError: Samples in split doesn't match"):
        detection_score(path, devkit_split, SCENES)


# ---- Without the devkit --------------------------------------------------------------------------

# Three modules with the names that the program needs. NDS is the number of boxes of the truth.
STAND_IN = {
    "nuscenes/__init__.py": """
import json, os
class NuScenes:
    def __init__(self, version, dataroot, verbose):
        self.rows = {}
        for name in ("sample", "scene"):
            with open(os.path.join(dataroot, version, name + ".json")) as file:
                self.rows[name] = {row["token"]: row for row in json.load(file)}
    def get(self, table, token):
        return self.rows[table][token]
""",
    "nuscenes/eval/common/config.py": "def config_factory(name): return name",
    "nuscenes/eval/detection/evaluate.py": """
import json
class Boxes:
    def __init__(self, boxes): self.boxes = boxes
    def __getitem__(self, token): return self.boxes[token]
class Metrics:
    mean_dist_aps = {"car": 0.5}
    tp_errors = {"trans_err": 1.0}
class DetectionEval:
    def __init__(self, tables, config, path, split, output_dir, verbose):
        print("the devkit prints")
        with open(path) as file: content = json.load(file)
        assert content["meta"]["use_camera"] is False
        self.sample_tokens = list(tables.rows["sample"])
        assert set(self.sample_tokens) == set(content["results"]), "Samples do not match"
        self.gt_boxes = Boxes(content["results"])
        self.pred_boxes = Boxes(content["results"])
    def evaluate(self):
        metrics = Metrics()
        metrics.nd_score = sum(map(len, self.gt_boxes.boxes.values()))
        return metrics, None
""",
}


def write_program(path: Path, text: str) -> Path:
    """Write a program that stands for a Python."""
    path.write_text(text)
    path.chmod(0o755)
    return path


def test_another_python_scores_the_scenes_that_count(dataset, tmp_path, monkeypatch):
    for name, text in STAND_IN.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    text = f'#!/bin/sh\nPYTHONPATH={tmp_path} exec {sys.executable} "$@"\n'
    write_program(tmp_path / "python", text)
    monkeypatch.chdir(tmp_path.parent)
    split = NuScenesSplit(dataset, VERSION, "train", Path(tmp_path.name) / "python")
    path = write_results(tmp_path / "results.json", dataset)
    # Car and truck in three samples, a walker in two.
    assert detection_score(path, split, SCENES).score == 16
    score = detection_score(path, split, SCENES, [SCENES[0]])
    assert (score.score, score.by_class) == (8, {"car": 0.5})
    with pytest.raises(ScoreError, match=r"1 scenes of train are not in the suite, .* scene-0001"):
        detection_score(path, split, SCENES[1:])
    path.write_text(json.dumps({"results": {}}))
    with pytest.raises(ScoreError, match=r"gives no NDS: AssertionError: Samples do not match"):
        detection_score(path, split, SCENES)


def test_a_python_without_the_devkit_is_named(dataset, tmp_path):
    path = write_results(tmp_path / "results.json", dataset)
    text = '#!/bin/sh\necho "no such program" >&2\nexit 3\n'
    broken = write_program(tmp_path / "broken", text)
    for python, message in (
        (None, r"cannot import \(No module named 'nuscenes'\).*--nuscenes-python"),
        (tmp_path / "nowhere", r"nowhere cannot be run to compute NDS"),
        (broken, r"broken ended with 3 and computed no NDS: no such program"),
    ):
        with pytest.raises(ScoreError, match=message):
            detection_score(path, NuScenesSplit(dataset, VERSION, "train", python), SCENES)
