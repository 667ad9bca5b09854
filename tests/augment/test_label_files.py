"""Labels for trainers: masks, COCO, KITTI and YOLO files, read back by others' readers or ours."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from augment.dataset import LabelOptions, write_labels
from augment.dataset.label_files import NothingLabelled, category_of, forecast_labels
from augment.errors import OutputError
from augment.jobs.generate import run_generate
from augment.jobs.render_job import RenderJob, run_job
from augment.output.manifest import read_manifest
from augment.output.tables import read_boxes
from augment.scene.boxes import WorldBoxes, encode_masks, find_occlusion
from augment.scene.labels import Boxes
from recipes.load import parse_recipe
from recipes.schema import Category, Recipe
from tests.augment.batch_scenes import FakeLabels, fake_render, open_fake, tree_digest
from tests.augment.generate_jobs import make_job, make_recipes
from tests.augment.test_boxes_2d import StreetLabels, open_street, street

ALL = "labels: [coco, kitti, yolo], lidar: false"


def recipe(output: str = ALL, weather: str = "{}", name: str = "clear") -> Recipe:
    text = f"name: {name}\nweather: {weather}\noutput: {{{output}}}"
    return parse_recipe(text, source="test").resolve(0)


def render(out: Path, *recipes: Recipe, **options) -> Path:
    job = RenderJob("test:sheets", recipes or (recipe(),), out, backend="cpu", **options)
    assert run_job(job, scene_loader=open_street, progress=False).failed == 0
    return out


@pytest.fixture(scope="module")
def output(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Clear: masks by depth, and by the instance image; in smog: hidden objects are marked."""
    smog = "{smog: {visibility_m: 30}}"
    out = render(
        tmp_path_factory.mktemp("labels") / "out",
        recipe(),
        recipe(f"{ALL}, instance: true", name="ids"),
        recipe(f"{ALL}, min_visibility: 0.4, on_hidden: mark", smog, "marked"),
        recipe(f"{ALL}, min_visibility: 0.4", smog, "removed"),
    )
    write_labels(out)
    return out


def coco_of(out: Path, part: str = "train") -> dict:
    return json.loads((out / f"labels/coco/instances_{part}.json").read_text())


def annotations_of(out: Path, variant: str, frame: int = 0) -> tuple[dict, list[dict]]:
    coco_file = coco_of(out)
    images = [i for i in coco_file["images"] if (i["variant"], i["frame"]) == (variant, frame)]
    return images[0], [a for a in coco_file["annotations"] if a["image_id"] == images[0]["id"]]


def pixels_of(annotation: dict) -> np.ndarray:
    """bool [H, W], by the run lengths' definition."""
    height, width = annotation["segmentation"]["size"]
    counts, number, shift = [], 0, 0
    for character in annotation["segmentation"]["counts"]:
        bits = ord(character) - 48
        number |= (bits & 31) << shift
        shift += 5
        if not bits & 32:
            if bits & 16:
                number -= 1 << shift
            counts.append(number + (counts[-2] if len(counts) > 2 else 0))
            number = shift = 0
    is_object = np.repeat(np.arange(len(counts)) % 2 == 1, counts)
    return np.pad(is_object, (0, height * width - len(is_object))).reshape(width, height).T


# ---- Masks ---------------------------------------------------------------------------------------


def test_masks_are_encoded_as_pycocotools_encodes_them() -> None:
    mask = pytest.importorskip("pycocotools.mask", reason="pycocotools is not installed")
    rng = np.random.default_rng(0)
    for trial in range(60):
        height, width = rng.integers(1, 40, 2)
        image = rng.integers(0, 4, (height, width)).astype(np.uint16)
        if trial % 3:  # long runs, with negative differences and several characters a count
            image = cv2.resize(image, (300, 170), interpolation=cv2.INTER_NEAREST)
        if trial % 7 == 0:
            image[:] = trial % 2
        numbers = np.array([1, 2, 9, 0, 3, 2], np.uint16)
        encoded = encode_masks(image, numbers)
        for box, number in enumerate(numbers):
            object_mask = (image == number) & (number > 0)
            rows, columns = np.nonzero(object_mask)
            sides = [encoded[side][box] for side in ("left", "top", "right", "bottom")]
            assert encoded["pixels"][box] == object_mask.sum()
            if not object_mask.any():
                assert sides == [0, 0, 0, 0] and encoded["rle"][box] == ""
                continue
            assert sides == [columns.min(), rows.min(), columns.max() + 1, rows.max() + 1]
            expected = mask.encode(np.asfortranarray(object_mask.astype(np.uint8)))[
                "counts"
            ].decode()
            assert encoded["rle"][box] == expected


def test_a_pixel_by_depth_shows_the_smallest_box_that_has_its_surface() -> None:
    """Against every pixel and box, one by one."""
    scene = street()
    boxes, camera = scene.boxes(0), scene.frames[0].cameras["ahead"].scaled(0.25)
    rng = np.random.default_rng(1)
    depth = rng.uniform(0, 20, (camera.height, camera.width)).astype(np.float32)
    world_boxes = WorldBoxes.from_labels(boxes, np.asarray(scene.world_origin_m))
    sizes = [world_boxes.sizes_m, world_boxes.sizes_m * [[3], [1], [2]]]
    tight = [replace(world_boxes, sizes_m=s, low_m=-s / 2, high_m=s / 2) for s in sizes]
    points = depth[..., None] * camera.ray_directions(torch.float64).numpy()
    points = points + camera.centre.numpy()
    for sized_boxes in tight:
        owners = np.zeros(depth.shape, np.int64)
        for box in np.argsort(-np.prod(sized_boxes.sizes_m, axis=1)):
            along = (points - sized_boxes.centres_m[box]) @ sized_boxes.rotations[box]
            inside = (abs(along) <= sized_boxes.sizes_m[box] / 2).all(axis=-1) & (depth > 0)
            owners[inside] = box + 1
        box_owners = find_occlusion(sized_boxes, camera, depth, with_owners=True).owner_boxes
        assert box_owners is not None and (owners > 0).sum() > 20
        # Rays that graze a side: rounding decides, in one pixel of a thousand at most.
        assert (box_owners != owners).mean() < 1e-3


def test_masks_follow_the_instance_image_where_there_is_one(output: Path) -> None:
    image, annotations = annotations_of(output, "ids-000")
    path = output / image["file_name"].replace("/images/", "/instance/")
    instance = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert {a["track_id"] for a in annotations} == {"car", "parked"}
    for annotation in annotations:
        np.testing.assert_array_equal(
            pixels_of(annotation), instance == annotation["instance"], annotation["track_id"]
        )
    # By depth the lowest 8 cm are left out, and the wall's edge blurs: nearly the same.
    by_depth = {a["track_id"]: a for a in annotations_of(output, "clear-000")[1]}
    for annotation in annotations:
        mask, depth_mask = pixels_of(annotation), pixels_of(by_depth[annotation["track_id"]])
        assert (mask & depth_mask).sum() > 0.85 * (mask | depth_mask).sum()


# ---- The formats, read back ----------------------------------------------------------------------


# pycocotools 2.0.11 under NumPy 2.
@pytest.mark.filterwarnings("ignore:__array__ implementation:DeprecationWarning")
def test_pycocotools_reads_the_annotations(output: Path) -> None:
    coco = pytest.importorskip("pycocotools.coco", reason="pycocotools is not installed")
    coco_api = coco.COCO(str(output / "labels/coco/instances_train.json"))
    assert [c["name"] for c in coco_api.loadCats(coco_api.getCatIds())] == ["Car"]
    assert len(coco_api.getImgIds()) == 8 and len(coco_api.getAnnIds()) > 10
    for annotation in coco_api.loadAnns(coco_api.getAnnIds()):
        mask = coco_api.annToMask(annotation).astype(bool)
        np.testing.assert_array_equal(mask, pixels_of(annotation))
        rows, columns = np.nonzero(mask)
        x, y, width, height = annotation["bbox"]
        assert (x, y, x + width, y + height) == (
            columns.min(), rows.min(), columns.max() + 1, rows.max() + 1
        )  # fmt: skip
        assert annotation["area"] == mask.sum()
    for image in coco_api.loadImgs(coco_api.getImgIds()):
        shape = cv2.imread(str(output / image["file_name"])).shape
        assert shape == (image["height"], image["width"], 3)
    # A wall stands before half of the parked car.
    hidden_annotations = [
        a for a in coco_api.anns.values() if a["track_id"] == "parked" and a["iscrowd"] == 0
    ]
    assert all(0.1 < a["occlusion"] < 0.9 for a in hidden_annotations if a["image_id"] == 0)


def kitti_objects(out: Path, number: int) -> tuple[np.ndarray, list[tuple[str, np.ndarray]]]:
    """P2 and (type, numbers) of a training image, as a reader of KITTI's object set has them."""
    top = out / "labels/kitti/training"
    calib = dict(
        line.split(":", 1) for line in (top / f"calib/{number:06d}.txt").read_text().splitlines()
    )
    lines = (top / f"label_2/{number:06d}.txt").read_text().splitlines()
    words = [line.split() for line in lines]
    assert all(len(line_words) == 15 for line_words in words)
    objects = [(line_words[0], np.array(line_words[1:], np.float64)) for line_words in words]
    return np.array(calib["P2"].split(), np.float64).reshape(3, 4), objects


def projected(P2: np.ndarray, numbers: np.ndarray) -> np.ndarray:
    """Left, top, right, bottom of the box's corners (the development kit's computeBox3D)."""
    h, w, length, x, y, z, ry = numbers[7:]
    a = length / 2
    corners = np.array([
        [a, a, -a, -a, a, a, -a, -a],
        [0, 0, 0, 0, -h, -h, -h, -h],
        [w / 2, -w / 2, -w / 2, w / 2, w / 2, -w / 2, -w / 2, w / 2],
    ])  # fmt: skip
    turn = np.array([[np.cos(ry), 0, np.sin(ry)], [0, 1, 0], [-np.sin(ry), 0, np.cos(ry)]])
    points = P2 @ np.vstack([turn @ corners + [[x], [y], [z]], np.ones(8)])
    pixels = points[:2] / points[2]
    return np.concatenate([pixels.min(axis=1), pixels.max(axis=1)])


def test_kitti_boxes_project_onto_their_2d_boxes(output: Path) -> None:
    image, annotations = annotations_of(output, "clear-000")
    P2, objects = kitti_objects(output, image["id"])
    assert [kind for kind, _ in objects] == ["Car"] * len(annotations)
    for (_, numbers), annotation in zip(objects, annotations, strict=True):
        x, y, width, height = annotation["bbox_amodal"]
        np.testing.assert_allclose(numbers[3:7], [x, y, x + width, y + height], atol=2e-3)
        if numbers[0] == 0:  # inside the image: a tenth of a millimetre, at 6 m and f = 285
            np.testing.assert_allclose(projected(P2, numbers), numbers[3:7], atol=0.02)
        alpha, ry = numbers[2], numbers[13]
        assert alpha == pytest.approx(ry - np.arctan2(numbers[10], numbers[12]), abs=2e-4)
        assert numbers[7:10].tolist() == [1.5, 1.8, 4.0]
        assert numbers[1] == (0 if annotation["occlusion"] <= 0.1 else 1)
    assert sum(numbers[0] == 0 for _, numbers in objects) >= 1


def test_kitti_places_boxes_where_the_dataset_has_them(output: Path) -> None:
    """Through the LiDAR's place, which is the ego frame's, back to the world."""
    number = annotations_of(output, "clear-000", frame=1)[0]["id"]
    top = output / "labels/kitti/training"
    line = next(
        s for s in (top / f"calib/{number:06d}.txt").read_text().splitlines() if "velo_to" in s
    )
    camera_from_ego = np.array(line.split()[1:], np.float64).reshape(3, 4)
    entry = json.loads((output / "sheets/clear-000/calibration.json").read_text())["frames"][1]
    world_from_ego = np.array(entry["world_from_ego"])
    boxes = read_boxes(output / "sheets/clear-000/labels/boxes.parquet")[1].boxes
    for _, numbers in kitti_objects(output, number)[1]:
        centre = numbers[10:13] - [0, numbers[7] / 2, 0]
        ego = camera_from_ego[:, :3].T @ (centre - camera_from_ego[:, 3])
        world = world_from_ego[:3, :3] @ ego + world_from_ego[:3, 3]
        assert np.linalg.norm(boxes.centers_m - world, axis=1).min() < 2e-4  # four decimals


def test_yolo_boxes_are_those_of_coco(output: Path) -> None:
    top = output / "labels/yolo"
    assert (top / "data.yaml").read_text() == (
        'train: images/train\nval: images/train\nnames:\n  0: "Car"\n'
    )
    coco_file = coco_of(output)
    for image in coco_file["images"]:
        name = f"train/{image['id']:06d}"
        assert (top / f"images/{name}.png").samefile(output / image["file_name"])
        lines = (top / f"labels/{name}.txt").read_text().splitlines()
        coco_annotations = [
            a for a in coco_file["annotations"] if a["image_id"] == image["id"] and not a["iscrowd"]
        ]
        size = np.array([image["width"], image["height"]] * 2)
        for line, annotation in zip(lines, coco_annotations, strict=True):
            category, *numbers = map(float, line.split())
            cx, cy, width, height = np.array(numbers) * size
            box = [cx - width / 2, cy - height / 2, width, height]
            np.testing.assert_allclose(box, annotation["bbox"], atol=1e-3)  # six decimals
            assert category == 0


def test_what_the_weather_hides_is_marked_or_left_out(output: Path) -> None:
    clear = annotations_of(output, "clear-000")[1]
    image, marked = annotations_of(output, "marked-000")
    removed = annotations_of(output, "removed-000")[1]
    assert [a["track_id"] for a in marked] == [a["track_id"] for a in clear]
    hidden_ids = {a["track_id"] for a in marked if a["visibility"] < 0.4}
    assert hidden_ids == {a["track_id"] for a in marked if a["iscrowd"]} == {"parked"}
    assert {a["track_id"] for a in removed} == {a["track_id"] for a in clear} - hidden_ids
    kinds = [kind for kind, _ in kitti_objects(output, image["id"])[1]]
    assert kinds == ["DontCare" if a["iscrowd"] else "Car" for a in marked]
    dont_care = next(n for kind, n in kitti_objects(output, image["id"])[1] if kind == "DontCare")
    assert dont_care[7:].tolist() == [-1, -1, -1, -1000, -1000, -1000, -10]


def test_every_image_is_in_the_index(output: Path) -> None:
    with (output / "labels/index.csv").open() as file:
        rows = list(csv.DictReader(file))
    paths = read_manifest(output)["image_path"].to_pylist()
    assert [row["image"] for row in rows] == paths
    assert [int(row["number"]) for row in rows] == list(range(8))
    listed = (output / "labels/kitti/ImageSets/train.txt").read_text().split()
    assert listed == [f"{number:06d}" for number in range(8)]


class OddLabels(StreetLabels):
    """The driving car has a negative length, the parked one no label."""

    def boxes(self, frame_index: int) -> Boxes:
        boxes = super().boxes(frame_index)
        is_car = np.array([track == "car" for track in boxes.track_ids])
        labels = tuple("" if track == "parked" else "Car" for track in boxes.track_ids)
        sizes = np.where(is_car[:, None], boxes.sizes_m * [-1, 1, 1], boxes.sizes_m)
        return replace(boxes, labels=labels, sizes_m=sizes)


def test_boxes_without_a_size_or_a_label_are_no_objects(tmp_path: Path) -> None:
    """Their tables keep them as they are; nothing for trainers has a number that is none."""
    mask_recipe = recipe(f"{ALL}, instance: true")
    job = RenderJob("test:odd", [mask_recipe], tmp_path, frames=[0], backend="cpu")
    run_job(job, scene_loader=lambda uri: street(OddLabels()), progress=False)
    done = write_labels(tmp_path)
    assert done.unmapped == {"": 1} and done.without_numbers == 1
    assert read_boxes(next(tmp_path.rglob("boxes.parquet")))[0].boxes.sizes_m.min() == -4
    (annotation,) = coco_of(tmp_path)["annotations"]  # its pixels are the actor's
    assert annotation["track_id"] == "car" and annotation["bbox_amodal"] == annotation["bbox"]
    assert [c["name"] for c in coco_of(tmp_path)["categories"]] == ["Car"]
    ((kind, numbers),) = kitti_objects(tmp_path, 0)[1]
    assert kind == "DontCare" and numbers[7:].tolist() == [-1, -1, -1, -1000, -1000, -1000, -10]


# ---- Categories, parts, going on -----------------------------------------------------------------


def test_the_first_row_that_takes_a_label_names_its_category() -> None:
    table = (
        Category(label="vehicle.bus.*", name="bus"),
        Category(label="vehicle.*", name="car"),
        Category(label="*.rider", name="person"),
    )
    cases = {"vehicle.bus.rigid": "bus", "vehicle.car": "car", "a.rider": "person", "vehicle": None}
    assert {label: category_of(label, table) for label in cases} == cases
    assert category_of("anything", None) == "anything"
    any_category = (Category(label="*", name="object"),)
    assert (
        category_of("", None) is category_of("", any_category) is None
    )  # the dataset has no label


def test_what_will_be_written_is_known_before(output: Path) -> None:
    table = "categories: [{label: Car, name: vehicle}], min_visibility: 0.4"
    planned = forecast_labels(street(), recipe(f"{ALL}, {table}").output)
    assert planned is not None and planned["min_visibility"] == 0.4
    patterns = [name.replace("*", "000000*") for name in planned["files"]]
    both = [name for text in patterns for name in _expanded(text)]
    assert len(both) == 8 and all(any(output.glob(name)) for name in both)
    boxes = [street().boxes(frame.index) for frame in street().frames]
    labels = [label for frame_boxes in boxes for label in frame_boxes.labels]
    tracks = {
        track
        for frame_boxes in boxes
        for track, lb in zip(frame_boxes.track_ids, frame_boxes.labels, strict=True)
        if lb == "Car"
    }
    expected_categories = {"vehicle": {"boxes": labels.count("Car"), "objects": len(tracks)}}
    assert planned["categories"] == expected_categories
    assert sum(planned["unmapped"].values()) == len(labels) - labels.count("Car")
    assert forecast_labels(street(), recipe("labels: true").output) is None


def _expanded(pattern: str) -> list[str]:
    before, brace, suffix = pattern.partition("{")
    if not brace:
        return [pattern]
    names, _, after = suffix.partition("}")
    return [before + name + after for name in names.split(",")]


def test_categories_can_be_changed_without_rendering(output: Path, tmp_path: Path) -> None:
    rows = '[{label: "Tr*", name: Truck}, {label: Car, name: "Big car"}]'
    changes = (f"output.categories={rows}", "output.labels=[kitti, coco]")
    try:
        done = write_labels(output, LabelOptions(changes=changes))
        assert done.unused_rows == ("Tr*",) and not done.unmapped
        names = [c["name"] for c in coco_of(output)["categories"]]
        assert names == ["Truck", "Big car"] and not (output / "labels/yolo").exists()
        assert all(a["category_id"] == 2 for a in coco_of(output)["annotations"])
        assert {kind for kind, _ in kitti_objects(output, 0)[1]} == {"Big_car"}
        before = tree_digest(output / "labels")
        write_labels(output)  # as the last time
        assert tree_digest(output / "labels") == before
        with pytest.raises(OutputError, match=r"names Lorry; .* The labels are Car$"):
            write_labels(output, LabelOptions(changes=(
                "output.categories=[{label: Lorry, name: Truck}]",)))  # fmt: skip
        assert tree_digest(output / "labels") == before
    finally:
        write_labels(output, LabelOptions())


LABELLED = {"fog": f"weather: {{smog: {{visibility_m: 50}}}}\noutput: {{{ALL}}}\n"}


def test_the_files_do_not_depend_on_how_the_job_went(tmp_path: Path) -> None:
    """One scene after the other or in blocks, at once or in parts: the same bytes."""
    recipes = make_recipes(("fog",), texts=LABELLED)
    run_generate(make_job(tmp_path / "blocks", recipes=recipes), progress=False)
    scene_recipes = {
        s.uri: recipes.resolve_for_scene(s, s.uri[5]) for s in make_job("x", recipes=recipes).scenes
    }
    for uri, resolved in scene_recipes.items():
        for frames in ((0, 2), None):
            job = RenderJob(uri, resolved, tmp_path / "parts", frames=frames)
            run_job(job, scene_loader=open_fake, renderer=fake_render, progress=False)
            write_labels(tmp_path / "parts")
    write_labels(tmp_path / "blocks")
    block_digest, part_digest = (
        tree_digest(tmp_path / "blocks/labels"),
        tree_digest(tmp_path / "parts/labels"),
    )
    assert block_digest == part_digest and len(block_digest) > 5 * 14
    count = sum(len(FakeLabels().boxes(frame)) for frame in range(4))
    shown_ids = {a["track_id"] for a in coco_of(tmp_path / "parts")["annotations"]}
    assert shown_ids and shown_ids <= {f"track-{k}" for k in range(count)}
    split = LabelOptions(split={"train": 0.5, "val": 0.5}, seed=0)
    parts = write_labels(tmp_path / "parts", split).parts
    scenes = {p: {i["scene"] for i in coco_of(tmp_path / "parts", p)["images"]} for p in parts}
    assert parts == {"train": 8, "val": 6} or parts == {"train": 6, "val": 8}
    assert scenes["train"].isdisjoint(scenes["val"])


def test_refusals(tmp_path: Path) -> None:
    job = RenderJob("fake:street?frames=2", [recipe("labels: true")], tmp_path / "out")
    run_job(job, scene_loader=open_fake, renderer=fake_render, progress=False)
    with pytest.raises(NothingLabelled, match=r"labels: \[coco, kitti, yolo\]"):
        write_labels(tmp_path / "out")
    assert not (tmp_path / "out/labels").exists()
    with pytest.raises(ValueError, match="add up to 1"):
        write_labels(tmp_path / "out", LabelOptions(split={"train": 0.5}))
    with pytest.raises(ValueError, match=r"got '\.\./up'"):
        write_labels(tmp_path / "out", LabelOptions(split={"../up": 1.0}))
    with pytest.raises(OutputError, match="neither"):
        write_labels(tmp_path / "nothing")
