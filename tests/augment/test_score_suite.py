"""Scores of predictions on a small suite: formats, guards, refusals, baselines, omitted scenes."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from augment.errors import OutputError, ScoreError
from augment.output.store import open_store
from augment.scores.nuscenes_metric import NuScenesSplit
from augment.scores.probe import probe
from augment.scores.score_suite import ScoreOptions, add_baseline, score_suite
from augment.scores.suite_facts import read_suite
from augment.scores.suite_scores import read_scores
from augment.scores.truth import coco_truth, read_truth
from recipes.schema import Category
from tests.augment.suite_folders import (
    CLEAN_CLASSES,
    LABELS,
    LEVELS_M,
    OBJECT_BOXES,
    SCENES,
    SuiteFolder,
    coco_results,
    found_by_level,
    write_coco,
    write_meta,
    write_suite,
)

pytest.importorskip("pycocotools")


@pytest.fixture(scope="module")
def suite(tmp_path_factory) -> SuiteFolder:
    return write_suite(tmp_path_factory.mktemp("suite") / "out")


@pytest.fixture(scope="module")
def good_predictions(suite, tmp_path_factory) -> Path:
    return write_coco(tmp_path_factory.mktemp("good"), suite)


@pytest.fixture
def predictions(good_predictions, tmp_path) -> Path:
    """Return a copy of good predictions that a test may damage."""
    return Path(shutil.copytree(good_predictions, tmp_path / "p"))


def edit_json(path: Path, change: Callable) -> None:
    """Apply a function to the content of a JSON file."""
    content = json.loads(path.read_text())
    changed = change(content)
    path.write_text(json.dumps(content if changed is None else changed))


def test_recall_of_every_level_is_that_of_the_objects_that_were_written(suite, good_predictions):
    scores = score_suite(open_store(suite.path), good_predictions)
    fog = scores.effects["fog"]
    assert scores.clean == pytest.approx(1.0)
    assert scores.objects == 18
    assert scores.clean_recall == 1.0
    counts = [
        sum(len(found_by_level(number, level)) for number in range(6)) for level in range(1, 6)
    ]
    assert [level.recall for level in fog.levels] == [count / 18 for count in counts]
    assert [level.value for level in fog.levels] == list(LEVELS_M)
    assert scores.robustness.mpc == pytest.approx(np.mean([level.metric for level in fog.levels]))
    assert scores.robustness.mrr == pytest.approx(scores.robustness.mpc / scores.clean)
    assert not scores.warnings


def test_half_recall_of_levels_with_one_number_names_the_levels(tmp_path):
    suite = write_suite(tmp_path / "out", levels_m=(600.0, 300.0, 150.0, 75.0, 75.0))
    top = write_coco(
        tmp_path / "p", suite, lambda number, level: [0, 1, 2][: 3 if level < 4 else 6 - level]
    )
    half = score_suite(open_store(suite.path), top).effects["fog"].half_recall
    assert half is not None
    assert (half.text, half.value) == ("fog-5 but not fog-4, both 75 m", None)


def test_objects_are_binned_by_the_transmittance_of_their_own_variant(suite, good_predictions):
    bins = score_suite(open_store(suite.path), good_predictions).recall_bins["fog"]
    counts = [(counted.objects, counted.num_found) for counted in bins.transmittance]
    # 0.9, 0.6, 0.3, 0.1 and 0.01: a level a bin, and none is quite clear.
    found = [sum(len(found_by_level(n, level)) for n in range(6)) for level in (5, 4, 3, 2, 1)]
    assert counts == [*((18, count) for count in found), (0, 0)]
    ranges = [counted.objects for counted in bins.range_m]
    assert ranges == [30, 30, 0, 30]  # at 10, 30 and 70 m, in six images and five levels


def test_truth_for_trainers_has_the_numbers_that_results_must_name(suite):
    rendered = read_suite(open_store(suite.path))
    truth = coco_truth(rendered, read_truth(rendered), "fog-2")
    assert [entry["name"] for entry in truth["categories"]] == ["Car", "Pedestrian"]
    assert [image["file_name"] for image in truth["images"]] == list(suite.image_paths["fog-2"])
    assert [image["id"] for image in truth["images"]] == list(range(6))
    assert truth["annotations"][1]["bbox"] == [50, 24, 40, 40]


def test_categories_join_labels_and_leave_others_out(suite, good_predictions, tmp_path):
    only_cars = ScoreOptions(categories=(Category(label="C*", name="Vehicle"),))
    top = write_coco(tmp_path / "cars", suite)
    for variant in suite.variants:
        edit_json(
            top / variant / "results.json",
            lambda entries: [entry for entry in entries if entry["category_id"] == 1],
        )
    scores = score_suite(open_store(suite.path), top, options=only_cars)
    assert scores.objects == 12
    assert scores.categories == ("Vehicle",)
    assert "Pedestrian (6)" in scores.notes[0]
    with pytest.raises(ScoreError, match=r"category_id .*\(1 Vehicle\): 1 \(2\)"):
        score_suite(open_store(suite.path), good_predictions, options=only_cars)
    wrong = ScoreOptions(categories=(Category(label="vehicle.*", name="Vehicle"),))
    with pytest.raises(ScoreError, match=r"no box has a category; the labels are Car, Pedestrian"):
        score_suite(open_store(suite.path), good_predictions, options=wrong)


# ---- Other formats -------------------------------------------------------------------------------


def write_kitti(top: Path, suite: SuiteFolder) -> Path:
    """Write the tests' detector as KITTI's result files, with boxes in space."""
    rendered = read_suite(open_store(suite.path))
    truth = read_truth(rendered)
    for level, variant in enumerate(suite.variants):
        write_meta(top / variant, suite, variant)
        for number in range(6):
            lines = []
            for k in found_by_level(number, level):
                x, y, z, height, width, length, turn = truth.images[number].boxes_3d[k].tolist()
                sides = " ".join(f"{side:.1f}" for side in OBJECT_BOXES[k])
                size = f"{height:.4f} {width:.4f} {length:.4f}"
                place = f"{x:.4f} {y:.4f} {z:.4f} {turn:.4f}"
                lines.append(f"{LABELS[k]} -1 -1 0 {sides} {size} {place} {0.9 - 0.01 * k:.2f}\n")
            path = top / variant / "kitti" / f"{number:06d}.txt"
            path.parent.mkdir(exist_ok=True)
            path.write_text("".join(lines))
    return top


@pytest.mark.parametrize("view", ["bbox", "bev", "3d"])
def test_kitti_results_of_true_boxes_score_one_in_every_view(suite, tmp_path, view):
    top = write_kitti(tmp_path, suite)
    scores = score_suite(open_store(suite.path), top, options=ScoreOptions(kitti_view=view))
    assert scores.metric == f"AP|R40 {view} moderate (KITTI)"
    assert scores.clean == pytest.approx(1.0)
    values = [level.metric for level in scores.effects["fog"].levels]
    assert values == sorted(values, reverse=True)
    assert scores.effects["fog"].levels[0].recall == 15 / 18


def test_damaged_kitti_results_are_refused_with_the_line(suite, tmp_path):
    top = write_kitti(tmp_path, suite)
    path = top / "fog-1" / "kitti" / "000001.txt"
    good = path.read_text()
    no_size = re.sub(r"1\.\d000 \d\.\d000 \d\.\d000", "-1 -1 -1", good)
    cases = (
        ("Car 0 0\n", r"1 \(000001.txt, line 1: Car 0 0\)"),
        (good.replace("0.90", "nan").replace("0.89", "nan"), r"not 16 columns of finite numbers"),
        (good.replace("Car", "Tram"), r"types .*\(Car, Pedestrian\): 1 \(Tram\)"),
        (no_size, r"detections have no height, width and length"),
    )
    options = ScoreOptions(kitti_view="3d")
    for text, message in cases:
        path.write_text(text)
        with pytest.raises(ScoreError, match=message):
            score_suite(open_store(suite.path), top, options=options)
    path.unlink()
    (path.parent / "000009.txt").write_text("")
    with pytest.raises(ScoreError, match=r"files for images that .* 1 \(000009.txt\)"):
        score_suite(open_store(suite.path), top)
    (path.parent / "000009.txt").unlink()
    with pytest.raises(ScoreError, match=r"missing files: 1 \(000001.txt\)"):
        score_suite(open_store(suite.path), top)


def write_semantic(top: Path, suite: SuiteFolder) -> Path:
    """Write classes of which a row more is wrong at each level."""
    for level, variant in enumerate(suite.variants):
        write_meta(top / variant, suite, variant)
        (top / variant / "semantic").mkdir()
        for number in range(6):
            classes = CLEAN_CLASSES.copy()
            classes[: 8 * level] = 7 - classes[: 8 * level]  # road and building change places
            cv2.imwrite(str(top / variant / "semantic" / f"{number:06d}.png"), classes)
    return top


def test_semantic_scores_worked_by_hand(suite, tmp_path):
    top = write_semantic(tmp_path, suite)
    scores = score_suite(open_store(suite.path), top)
    assert scores.metric == "mIoU"
    assert scores.clean == 1.0
    # A share w of both classes is wrong: (1 - w) / (1 + w) of each.
    shares = np.arange(1, 6) / 8
    values = [level.metric for level in scores.effects["fog"].levels]
    np.testing.assert_allclose(values, (1 - shares) / (1 + shares))
    assert scores.effects["fog"].half_recall is None
    assert scores.worst_images[0].hits == pytest.approx(3 / 8)
    path = top / "fog-3" / "semantic" / "000002.png"
    cv2.imwrite(str(path), np.full((10, 10), 1, np.uint8))
    with pytest.raises(ScoreError, match=r"fog-3: image 000002: expected 96 x 64 pixels; got 10"):
        score_suite(open_store(suite.path), top)
    # A header alone states 25 gigabytes: it must not be decoded.
    path.write_bytes(cv2.imencode(".png", np.zeros((1, 1), np.uint8))[1].tobytes())
    huge = bytearray(path.read_bytes())
    huge[16:24] = (160_000).to_bytes(4, "big") * 2
    path.write_bytes(huge)
    with pytest.raises(ScoreError, match=r"expected 96 x 64 pixels; got 160000 x 160000"):
        score_suite(open_store(suite.path), top)
    path.write_bytes(b"no png")
    with pytest.raises(ScoreError, match=r"000002.png is no 8-bit PNG"):
        score_suite(open_store(suite.path), top)


def write_nuscenes(top: Path, suite: SuiteFolder) -> Path:
    """Write nuScenes results of one sample."""
    for level, variant in enumerate(suite.variants):
        write_meta(top / variant, suite, variant)
        box = {
            "sample_token": "t0", "translation": [1.0, 2.0, 0.5 + level], "size": [2.0, 4.0, 1.5],
            "rotation": [1, 0, 0, 0], "velocity": [0, 0], "detection_name": "car",
            "detection_score": 0.5, "attribute_name": "",
        }  # fmt: skip
        content = {"meta": {"use_camera": True}, "results": {"t0": [box]}}
        (top / variant / "results.json").write_text(json.dumps(content))
    return top


def test_nuscenes_results_are_read_and_checked_and_need_the_devkit(suite, tmp_path):
    top = write_nuscenes(tmp_path, suite)
    with pytest.raises(ScoreError, match=r"nuScenes results need the dataset's annotations"):
        score_suite(open_store(suite.path), top)
    python = tmp_path / "python"
    options = ScoreOptions(nuscenes=NuScenesSplit(tmp_path, "v1.0-mini", "mini_val", python))
    with pytest.raises(ScoreError, match=r"python cannot be run to compute NDS"):
        score_suite(open_store(suite.path), top, options=options)
    path = top / "fog-4" / "results.json"
    edit_json(path, lambda content: content["results"]["t0"][0].update(size=[1.0, float("nan"), 2]))
    with pytest.raises(ScoreError, match=r"not finite: 1 \(sample t0, box 0\)"):
        score_suite(open_store(suite.path), top, options=options)


# ---- Guards --------------------------------------------------------------------------------------


def test_pixels_of_a_loader_serve_as_a_probe_in_any_order_of_channels(suite, predictions):
    def load(path: str) -> np.ndarray:
        return cv2.imread(str(suite.path / path))  # blue, green, red

    for variant in suite.variants:
        answers = probe(load, suite.probes[variant])
        edit_json(predictions / variant / "meta.json", lambda meta, a=answers: {**meta, "probe": a})
    assert score_suite(open_store(suite.path), predictions).clean == pytest.approx(1.0)
    answers = probe(load, suite.probes["clean-0"])
    forged = dict(zip(suite.probes["fog-3"], answers.values(), strict=True))
    edit_json(predictions / "fog-3" / "meta.json", lambda meta: {**meta, "probe": forged})
    with pytest.raises(ScoreError, match=r"the loader gave the pixels of clean-0.*not shown fog-3"):
        score_suite(open_store(suite.path), predictions)


def test_results_without_a_probe_or_of_other_pictures_are_refused(suite, predictions):
    path = predictions / "fog-2" / "meta.json"
    good = json.loads(path.read_text())
    clean_answers = json.loads((predictions / "clean-0" / "meta.json").read_text())["probe"]
    swapped = dict(zip(suite.probes["fog-2"], clean_answers.values(), strict=True))
    first, *others = suite.probes["fog-2"]
    cases = (
        ({"variant": "fog-2"}, r"1 variants have no probe in meta.json.*: fog-2\. Call"),
        ({**good, "variant": "fog-3"}, r"predictions of 'fog-3', not of fog-2"),
        ({**good, "probe": clean_answers}, r"the probe lacks 3 of 3 images"),
        ({**good, "probe": {p: good["probe"][p] for p in others}}, r"lacks 1 of 3 images: .*fog-2"),
        ({**good, "probe": swapped}, r"gave the bytes of .*clean-0.*not shown fog-2: run it again"),
        ({**good, "probe": {**good["probe"], first: "0" * 64}}, r"bytes that no file of the suite"),
        ({**good, "probe": {**good["probe"], first: "zz"}}, r"neither a SHA-256 nor colours"),
        ({**good, "probe": {**good["probe"], first: "ff" * 768}}, r"pixels of no variant"),
        ([], r"meta.json is not usable"),
    )
    for meta, message in cases:
        path.write_text(json.dumps(meta))
        with pytest.raises(ScoreError, match=message):
            score_suite(open_store(suite.path), predictions)
    path.unlink()
    with pytest.raises(ScoreError, match=r"no probe"):
        score_suite(open_store(suite.path), predictions)


def test_equal_predictions_of_two_variants_are_refused(suite, predictions):
    same = (predictions / "fog-2" / "results.json").read_text()
    (predictions / "fog-4" / "results.json").write_text(json.dumps(json.loads(same), indent=3))
    message = r"same predictions, though their pictures differ: fog-2 = fog-4"
    with pytest.raises(ScoreError, match=message):
        score_suite(open_store(suite.path), predictions)


def test_variants_without_any_detection_may_be_equal(suite, predictions):
    for variant in ("fog-4", "fog-5"):
        (predictions / variant / "results.json").write_text("[]")
    levels = score_suite(open_store(suite.path), predictions).effects["fog"].levels
    assert [level.metric for level in levels[3:]] == [0.0, 0.0]


def test_a_score_equal_to_the_clean_one_gives_a_warning(suite, predictions):
    shifted = [{**entry, "score": entry["score"] - 0.01} for entry in coco_results(0)]
    (predictions / "fog-1" / "results.json").write_text(json.dumps(shifted))
    (warning,) = score_suite(open_store(suite.path), predictions).warnings
    assert warning.startswith("fog-1 scores 1.0000 as clean-0 does")


def test_variants_with_the_pictures_of_the_clean_render_give_a_warning(tmp_path):
    suite = write_suite(tmp_path / "out", unchanged=("fog-1", "fog-2"))
    top = write_coco(tmp_path / "p", suite)
    shutil.copy(top / "clean-0" / "results.json", top / "fog-1" / "results.json")  # equal: right
    (warning,) = score_suite(open_store(suite.path), top).warnings
    assert warning.startswith("2 variants have the same pictures as clean-0, byte by byte")
    assert warning.endswith("fog-1, fog-2")


# ---- Bad input -----------------------------------------------------------------------------------


def test_coco_results_that_do_not_fit_are_refused_with_names_and_counts(suite, predictions):
    path = predictions / "fog-1" / "results.json"
    good = path.read_text()

    def changed(**fields) -> str:
        first, second, *rest = json.loads(good)
        return json.dumps([{**first, **fields}, {**second, **fields}, *rest])

    cases = (
        (changed(image_id=99), r"images that the suite does not have: 1 \(99\)"),
        (changed(image_id="x/clean.png"), r"does not have: 1 \(x/clean.png\)"),
        (changed(image_id=True), r"does not have: 1 \(True\)"),
        (changed(image_id=suite.image_paths["fog-2"][0]), r"does not have: 1 \(scene-a/fog-2-000"),
        (changed(category_id=3), r"category_id .*1 Car, 2 Pedestrian\): 1 \(3\)"),
        (changed(category_id="Car"), r"category_id .*\('Car'\)"),
        (changed(bbox=[0, float("nan"), 1, 1]), r"not finite, or without area: 2 \(entry 0: .*nan"),
        (changed(bbox=[0, 0, 0, 5]), r"without area: 2"),
        (changed(score=float("inf")), r"not finite, or without area: 2"),
        (changed(bbox=[0, 0, 5]), r"entry 0 is no detection of COCO"),
        (changed(score=10**400), r"entry 0 is no detection of COCO"),
        ("[1, 2]", r"entry 0 is no detection of COCO"),
        ('{"a": 1}', r"neither COCO's results .* nor nuScenes'"),
        ("{", r"cannot be read as JSON"),
        ("\n[", r"cannot be read as JSON"),
    )
    for text, message in cases:
        path.write_text(text)
        with pytest.raises(ScoreError, match=message):
            score_suite(open_store(suite.path), predictions)


def test_images_are_named_by_number_or_path_and_none_is_left_out(suite, predictions):
    for variant in suite.variants:
        paths = suite.image_paths[variant]
        edit_json(
            predictions / variant / "results.json",
            lambda entries, p=paths: [{**e, "image_id": p[e["image_id"]]} for e in entries],
        )
    assert score_suite(open_store(suite.path), predictions).clean == pytest.approx(1.0)
    edit_json(predictions / "fog-5" / "meta.json", lambda meta: {**meta, "image_ids": None})
    with pytest.raises(ScoreError, match=r"3 \(scene-a/fog-5-000/images/front/000000.png, scene-b"):
        score_suite(open_store(suite.path), predictions)
    edit_json(predictions / "fog-5" / "meta.json", lambda meta: {**meta, "image_ids": [0, 77]})
    with pytest.raises(ScoreError, match=r"image_ids that the suite does not have: 1 \(77\)"):
        score_suite(open_store(suite.path), predictions)


def test_folders_that_do_not_fit_are_refused(suite, predictions, tmp_path):
    store = open_store(suite.path)
    with pytest.raises(ScoreError, match=r"is no folder"):
        score_suite(store, tmp_path / "nowhere")
    with pytest.raises(ScoreError, match=r"not rendered with hail; its effects are fog"):
        score_suite(store, predictions, options=ScoreOptions(effects=("hail",)))
    (predictions / "fog-9").mkdir()
    with pytest.raises(ScoreError, match=r"no variant of weather-c-v1: 1 \(fog-9\)"):
        score_suite(store, predictions)
    (predictions / "fog-9").rmdir()
    (predictions / "fog-2" / "kitti").mkdir()
    with pytest.raises(ScoreError, match=r"has coco and kitti; expected one"):
        score_suite(store, predictions)
    (predictions / "fog-2" / "results.json").unlink()
    with pytest.raises(ScoreError, match=r"mixes formats .*: coco in .*, kitti in fog-2"):
        score_suite(store, predictions)
    shutil.rmtree(predictions / "fog-2")
    shutil.rmtree(predictions / "fog-4")
    with pytest.raises(ScoreError, match=r"lacks the predictions of 2 of 6 variants: fog-2, fog-4"):
        score_suite(store, predictions)


def test_a_detector_without_a_clean_hit_is_refused(suite, tmp_path):
    top = write_coco(tmp_path, suite, lambda number, level: found_by_level(number, 2))
    for level, variant in enumerate(suite.variants):
        edit_json(
            top / variant / "results.json",
            lambda entries, n=level: [{**e, "bbox": [0, 0, 2 + n, 2]} for e in entries],
        )
    with pytest.raises(ScoreError, match=r"the clean value is 0.0 for fog"):
        score_suite(open_store(suite.path), top)


def test_a_suite_that_was_changed_or_is_missing_is_refused(suite, good_predictions, tmp_path):
    with pytest.raises(OutputError, match=r"holds no suite.json"):
        score_suite(open_store(tmp_path), good_predictions)
    copy = Path(shutil.copytree(suite.path, tmp_path / "copy"))
    edit_json(copy / "suite.json", lambda entries: {**entries, "suite": "weather-c-v9"})
    with pytest.raises(OutputError, match=r"changed after it was written"):
        score_suite(open_store(copy), good_predictions)
    (copy / "suite.json").write_text("[]")
    with pytest.raises(OutputError, match=r"suite.json is damaged"):
        score_suite(open_store(copy), good_predictions)


# ---- Baselines and omitted scenes ----------------------------------------------------------------


def test_a_baseline_is_read_from_predictions_and_from_json(suite, good_predictions, tmp_path):
    def weaker(number: int, level: int) -> list[int]:
        return [k for k in found_by_level(number, level) if level < 2 or k != 1]

    store = open_store(suite.path)
    base_folder = write_coco(tmp_path / "base", suite, weaker)
    scores = score_suite(store, good_predictions, base_folder)
    fog = scores.effects["fog"]
    base = score_suite(store, base_folder)
    ours = sum(level.metric for level in fog.levels)
    theirs = sum(level.metric for level in base.effects["fog"].levels)
    assert fog.corruption_error == pytest.approx((5 - ours) / (5 - theirs))
    assert fog.relative_gain == pytest.approx(ours / theirs - 1)
    assert scores.robustness.mce == fog.corruption_error
    assert fog.corruption_error is not None and fog.corruption_error < 1
    path = tmp_path / "base.json"
    path.write_text(json.dumps(base.model_dump(mode="json")))
    from_json = score_suite(store, good_predictions, path)
    assert (from_json.robustness.mce, from_json.robustness.mrra) == (
        scores.robustness.mce, scores.robustness.mrra,
    )  # fmt: skip
    for field, value, message in (
        ("suite", "weather-c-v2", r"of another suite: weather-c-v2 there, weather-c-v1 here"),
        ("metric", "mIoU", r"of another metric"),
        ("categories", ["Car"], r"of another categories"),
        ("images_sha256", "0" * 64, r"of another images"),
        ("clean", "much", r"holds no scores"),
    ):
        edit_json(path, lambda content, f=field, v=value: {**content, f: v})
        with pytest.raises(ScoreError, match=message):
            add_baseline(scores, read_scores(path), str(path))
        path.write_text(json.dumps(base.model_dump(mode="json")))
    edit_json(path, lambda content: content["effects"]["fog"]["levels"][4].update(level=7))
    with pytest.raises(ScoreError, match=r"of another levels"):
        add_baseline(scores, read_scores(path), str(path))
    path.write_text(json.dumps(base.model_dump(mode="json")))
    edit_json(path, lambda content: {**content, "suite_sha256": "0" * 64})
    compared = add_baseline(scores, read_scores(path), str(path))
    assert "other files of weather-c-v1" in compared.warnings[-1]


def test_scenes_recorded_in_an_effect_do_not_count_for_it(tmp_path, good_predictions):
    # The same files as those of `suite`, so that the predictions' probes fit.
    omitting = write_suite(tmp_path / "out", omitted={"scene-b": ("fog",)})

    def only_b_fails(number: int, level: int) -> list[int]:
        return [] if level and number in (2, 3) else [0, 1, 2][: 3 if level < 5 else 2]

    top = write_coco(tmp_path / "p", omitting, only_b_fails)
    scores = score_suite(open_store(omitting.path), top)
    assert scores.effects["fog"].omitted_scenes == ("scene-b",)
    assert [level.metric for level in scores.effects["fog"].levels[:4]] == pytest.approx([1.0] * 4)
    everywhere = write_suite(tmp_path / "all", omitted=dict.fromkeys(SCENES, ("fog",)))
    with pytest.raises(ScoreError, match=r"no effect can be scored"):
        score_suite(open_store(everywhere.path), good_predictions)


def test_recorded_images_are_scored_beside_the_clean_renders(suite, predictions):
    (predictions / "recorded").mkdir()
    (predictions / "recorded" / "results.json").write_text(json.dumps(coco_results(1)))
    scores = score_suite(open_store(suite.path), predictions)
    assert scores.recorded == pytest.approx(scores.effects["fog"].levels[0].metric)
