"""A tiny rendered suite, and predictions for it, written file by file for the tests of scores."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from augment.output.box_tables import BOXES_2D, BoxNumbers
from augment.output.box_weather import box_tables
from augment.output.codecs import encode_ids, encode_image
from augment.output.layout import item_paths, path_columns, variant_folder, variant_name
from augment.output.manifest import (
    OK,
    Identity,
    ImageFacts,
    image_row,
    rows_to_table,
    write_manifest,
)
from augment.output.tables import FrameBoxes, boxes_bytes
from augment.scene.labels import Boxes
from augment.scores.probe import probe
from augment.suite.suite_file import SceneFacts, SuiteFile, VariantFacts
from recipes.moment import SceneTimes
from recipes.schema import Output, Recipe, Smog, Weather

WIDTH = 96
HEIGHT = 64
FRAMES = (0, 3)
CAMERA = "front"
SCENES = ("scene-a", "scene-b", "scene-c")
LEVELS_M = (600.0, 300.0, 150.0, 75.0, 37.0)
LABELS = ("Car", "Car", "Pedestrian")
# Left, top, right, bottom of the objects of every image, whole pixels.
OBJECT_BOXES = np.array([[4, 20, 44, 60], [50, 24, 90, 64], [40, 10, 52, 40]], np.float64)
TRANSMITTANCES = (0.9, 0.6, 0.3, 0.1, 0.01)
# True classes of every image: road on the left, building on the right.
CLEAN_CLASSES = np.tile(np.where(np.arange(WIDTH) < WIDTH // 2, 1, 6).astype(np.uint8), (HEIGHT, 1))


def recipe_of(variant: str) -> Recipe:
    """Return the recipe of a variant."""
    effect, level = variant.split("-")
    smog = Smog(extinction_per_m=2.996 / LEVELS_M[int(level) - 1]) if effect == "fog" else None
    output = Output(image="png", depth="none", semantic=True, lidar=False, labels=True)
    return Recipe(name=variant, weather=Weather(smog=smog), output=output)


@dataclass(frozen=True)
class SuiteFolder:
    """A rendered suite of one effect, three scenes, two frames and one camera."""

    path: Path
    """The output."""
    variants: tuple[str, ...]
    """Names of the variants."""
    image_paths: dict[str, tuple[str, ...]]
    """Paths of the images of each variant, by number."""
    probes: dict[str, tuple[str, ...]]
    """Probe paths of each variant."""


def write_suite(
    path: Path,
    omitted: Mapping[str, Sequence[str]] | None = None,
    name: str = "weather-c-v1",
    unchanged: Sequence[str] = (),
    levels_m: Sequence[float] = LEVELS_M,
) -> SuiteFolder:
    """Write a suite: manifest, images, label tables and `suite.json`.

    Args:
        omitted: Effects that do not count, by scene.
        name: Name of the suite.
        unchanged: Variants with the pictures of the clean render.
        levels_m: The numbers that `suite.json` states of the levels.
    """
    variants = ("clean-0", *(f"fog-{k}" for k in range(1, 6)))
    rows: list[dict[str, Any]] = []
    hashes: dict[str, str] = {}
    image_paths: dict[str, list[str]] = {variant: [] for variant in variants}
    for number, variant in enumerate(variants):
        recipe = recipe_of(variant)
        for scene in SCENES:
            top = path / variant_folder(scene, variant_name(recipe))
            for frame in FRAMES:
                paths = item_paths(scene, recipe, CAMERA, frame)
                gray = 40 + 30 * (0 if variant in unchanged else number) + frame
                pixels = np.full((HEIGHT, WIDTH, 3), gray, np.uint8)
                data = encode_image(pixels, recipe.output)
                _write(path / str(paths["image"]), data)
                hashes[str(paths["image"])] = hashlib.sha256(data).hexdigest()
                image_paths[variant].append(str(paths["image"]))
                _write(path / str(paths["semantic"]), encode_ids(CLEAN_CLASSES, np.uint8))
                rows.append(
                    image_row(
                        scene,
                        recipe,
                        Identity(f"made:{scene}", recipe.hash, "recorded", "0.6.0", "cpu"),
                        ImageFacts(frame, CAMERA, frame, WIDTH, HEIGHT),
                        SceneTimes(FRAMES[0], FRAMES[-1]),
                        paths=path_columns(paths),
                        status=OK,
                        checksum=hashes[str(paths["image"])],
                    )
                )
            _write_tables(top, None if number == 0 else TRANSMITTANCES[number - 1])
    write_manifest(path, rows_to_table(rows))
    probes = {v: tuple(paths[k] for k in (0, 2, 5)) for v, paths in image_paths.items()}
    suite_file = SuiteFile(
        suite=name,
        code_version="0.6.0",
        backends=("cpu",),
        changes={},
        scale=1.0,
        variants={
            variant: VariantFacts(
                effect=variant.split("-")[0],
                level=number,
                number="" if number == 0 else "meteorological optical range",
                unit="" if number == 0 else "m",
                value=None if number == 0 else levels_m[number - 1],
                folder=f"{variant}-000",
                numbers={},
                recipe=recipe_of(variant).model_dump(mode="json", exclude={"seed"}),
                seeds=dict.fromkeys(SCENES, 0),
                probes=probes[variant],
            )
            for number, variant in enumerate(variants)
        },
        scenes={
            scene: SceneFacts(
                source=f"made:{scene}",
                recorded_conditions=(),
                omitted_effects=tuple((omitted or {}).get(scene, ())),
                frames=FRAMES,
                cameras=(CAMERA,),
            )
            for scene in SCENES
        },
        failed=(),
        files=hashes,
    )
    (path / "suite.json").write_bytes(suite_file.to_json())
    return SuiteFolder(path, variants, {v: tuple(p) for v, p in image_paths.items()}, probes)


def _write(path: Path, data: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data)


def _write_tables(top: Path, transmittance: float | None) -> None:
    """Write the label tables and the calibration of a variant of a scene."""
    count = len(LABELS)
    boxes = Boxes(
        track_ids=tuple(f"track-{k}" for k in range(count)),
        labels=LABELS,
        centers_m=np.array([[-3.0, 0.0, 10.0], [4.0, 0.5, 30.0], [0.0, 0.2, 70.0]]),
        sizes_m=np.array([[4.0, 1.8, 1.5], [4.2, 1.8, 1.6], [0.6, 0.6, 1.7]]),
        quats=np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)),
        attributes={},
    )
    frame_boxes = {
        f: FrameBoxes(f, boxes, np.arange(1, count + 1, dtype=np.uint16)) for f in FRAMES
    }
    _write(top / "labels/boxes.parquet", boxes_bytes(frame_boxes))
    sides = {name: OBJECT_BOXES[:, k] for k, name in enumerate(("x0", "y0", "x1", "y1"))}
    area = np.prod(OBJECT_BOXES[:, 2:] - OBJECT_BOXES[:, :2], axis=1).astype(np.int64)
    numbers = BOXES_2D.make_numbers(
        boxes.track_ids,
        instance=np.arange(1, count + 1),
        **sides,
        **{f"modal_{name}": values for name, values in sides.items()},
        pixels=area,
        hidden_pixels=np.zeros(count, np.int64),
        truncated_fraction=np.zeros(count),
        is_estimated=np.zeros(count, bool),
    )
    _write(top / BOXES_2D.file, BOXES_2D.to_bytes({(f, CAMERA): numbers for f in FRAMES}))
    if transmittance is not None:
        table = box_tables()["box_smog"]
        smog = BoxNumbers(
            boxes.track_ids, {"transmittance": np.full(count, transmittance), "pixels": area}
        )
        _write(top / table.file, table.to_bytes({(f, CAMERA): smog for f in FRAMES}))
    camera = {
        **{"timestamp_ns": 0, "width": WIDTH, "height": HEIGHT},
        **{"fx": 90.0, "fy": 90.0, "cx": WIDTH / 2, "cy": HEIGHT / 2},
        "world_from_camera": np.eye(4).tolist(),
    }
    pose = {"timestamp_ns": 0, "world_from_ego": np.eye(4).tolist(), "cameras": {CAMERA: camera}}
    frames = [{"frame": f, **pose} for f in FRAMES]
    _write(top / "calibration.json", json.dumps({"frames": frames}).encode())


# ---- Predictions ---------------------------------------------------------------------------------


def found_by_level(number: int, level: int) -> list[int]:
    """Return the objects of an image that the tests' detector finds: fewer at every level.

    Of 18 objects in six images it finds 18, 15, 12, 9, 6 and 3.
    """
    return [k for k in range(3) if (number * 3 + k) % 6 >= level or level == 0]


def coco_results(
    level: int, found: Callable[[int, int], list[int]] = found_by_level
) -> list[dict[str, Any]]:
    """Return the COCO results of the tests' detector at a level."""
    results = []
    for number in range(len(SCENES) * len(FRAMES)):
        for k in found(number, level):
            left, top, right, bottom = OBJECT_BOXES[k].tolist()
            results.append(
                {
                    "image_id": number,
                    "category_id": 1 if LABELS[k] == "Car" else 2,
                    "bbox": [left, top, right - left, bottom - top],
                    "score": 0.9 - 0.01 * k + 0.001 * level,
                }
            )
    return results


def write_meta(folder: Path, suite: SuiteFolder, variant: str, **changes: Any) -> None:
    """Write the meta.json of a variant, with the probe of a loader that reads bytes."""
    folder.mkdir(parents=True, exist_ok=True)
    answers = probe(lambda path: (suite.path / path).read_bytes(), suite.probes[variant])
    meta = {"variant": variant, "probe": answers, "image_ids": list(range(6)), **changes}
    (folder / "meta.json").write_text(json.dumps(meta))


def write_coco(
    top: Path, suite: SuiteFolder, found: Callable[[int, int], list[int]] = found_by_level
) -> Path:
    """Write the COCO results of the tests' detector for all variants."""
    for level, variant in enumerate(suite.variants):
        write_meta(top / variant, suite, variant)
        (top / variant / "results.json").write_text(json.dumps(coco_results(level, found)))
    return top
