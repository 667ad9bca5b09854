"""`climategs bench detector`: the robustness of a small detector, trained with and without weather.

Procedural streets are rendered in clear air and in draws of some kinds of weather. A small detector
of cars and pedestrians is trained in two ways from several seeds. Other streets are rendered as the
suite `weather-c-v1`, and the detectors are scored on it as `climategs score` does. Everything is
fixed here: streets, ranges of the weather, steps and seeds. Images are rendered once into a folder;
an interrupted run goes on where it was.
"""

from __future__ import annotations

import importlib.util
import itertools
import json
import multiprocessing
import tempfile
from collections.abc import Mapping
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tqdm import tqdm

from adapters.base import open_scene, recorded_conditions
from adapters.street.layout import StreetParameters
from augment.errors import ClimateGSError, OutputError
from augment.jobs.block_worker import JobWorkerSetup
from augment.jobs.render_job import SceneLoader
from augment.output.codecs import decode_image
from augment.output.store import open_store
from augment.scores.probe import probe
from augment.scores.score_suite import add_baseline, score_suite
from augment.scores.suite_facts import RenderedSuite, read_suite
from augment.scores.suite_scores import SuiteScores
from augment.suite.run import SuiteRun, run_suite, suite_recipes
from recipes.job import JobScene
from recipes.load import parse_recipe
from recipes.schema import Recipe
from recipes.suite import load_suite
from tools.bench.detection import (
    NUM_SIDES,
    DetectionViews,
    Objects,
    detect,
    make_targets,
    stack_targets,
    train_detector,
)
from tools.bench.detector_tables import Hits, count_hits, make_tables
from tools.bench.harness import Figures, figures, machine_facts
from tools.bench.scene_images import (
    SceneImages,
    processor_s,
    read_samples,
    render_images,
    street_uris,
)
from tools.bench.segmentation import TrainingSettings, one_deterministic_thread

SUITE = "weather-c-v1"
# Labels of the street, in the order of the suite's categories.
CATEGORIES = ("Car", "Pedestrian")
# Objects with a smaller box, or a smaller share that others leave visible, do not teach.
MIN_BOX_AREA_PX2 = 40.0
MIN_VISIBLE_FRACTION = 0.1
# The name of the condition without weather.
CLEAR = "clear"
OUTPUT = "output: {image: jpg, jpeg_quality: 92, depth: none, lidar: false, labels: true}"

# The weather that is learnt, by name, YAML. Its ranges are those of the suite's levels.
LEARNT_WEATHER: Mapping[str, str] = {
    "fog": "weather: {smog: {extinction_per_m: {log_uniform: [0.005, 0.08]}, scatter: 0.0}}",
    "rain": """
weather:
  rain:
    rate_mm_h: {log_uniform: [1, 100]}
    wind_mps: {uniform: [0, 8]}
    wind_from_deg: {uniform: [0, 360]}
""",
    "snowfall": """
weather:
  snowfall:
    rate_mm_h: {log_uniform: [0.3, 5]}
    wind_mps: {uniform: [0, 8]}
    wind_from_deg: {uniform: [0, 360]}
""",
    "snow": "weather: {snow: {depth_m: {log_uniform: [0.01, 0.3]}, coverage: {uniform: [0.7, 1]}}}",
    "night": """
light:
  time: night
  vehicles: "on"
  own_beams: dipped
  street: "on"
  street_lumen: {log_uniform: [2000, 20000]}
""",
}
# Effects of the suite that no training shows.
UNKNOWN_EFFECTS = ("flood", "lens")


@dataclass(frozen=True)
class Arm:
    """A way to train."""

    title: str
    """Its heading in tables."""
    kinds: tuple[str, ...] = ()
    """The kinds of weather that half of its images show; empty for clean images only."""


ARMS: Mapping[str, Arm] = {
    "clean": Arm("trained on clean"),
    "weather": Arm("trained on weather", tuple(LEARNT_WEATHER)),
}


@dataclass(frozen=True)
class DetectorCase:
    """The scenes and weather that are rendered, and the trainings."""

    train_scenes: tuple[str, ...]
    """URIs of the scenes to learn from."""
    test_scenes: tuple[str, ...]
    """URIs of the scenes of the suite."""
    train_frames: tuple[int, ...]
    """Frame numbers of each scene to learn from."""
    test_frames: str
    """Frame numbers of each scene of the suite, as in a recipe job."""
    train_cameras: tuple[str, ...] = ("front",)
    """Cameras of the scenes to learn from."""
    test_cameras: tuple[str, ...] = ("front",)
    """Cameras of the suite."""
    draws: int = 1
    """The number of draws of each kind of weather in each scene to learn from."""
    effects: tuple[str, ...] | None = None
    """Effects of the suite; None for all."""
    levels: tuple[int, ...] | None = None
    """Levels of the suite; None for all."""
    settings: TrainingSettings = field(
        default_factory=lambda: TrainingSettings(
            steps=160,
            batch=8,
            learning_rate=4e-3,
            widths=(16, 24, 32, 48, 64),
            num_classes=len(CATEGORIES) + NUM_SIDES,
        )
    )
    """The settings of every training."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """The seeds: of first weights, of the order of images, and of what is drawn."""
    executor: str = "processes"
    """Kind of the workers that render the suite."""
    workers: int = 2
    """The number of processes that train."""

    def recipes_of(self, uri: str) -> list[Recipe]:
        """Return the resolved recipes of a scene to learn from, the clean one first."""
        first = self.train_scenes.index(uri) * self.draws
        numbers = range(first, first + self.draws)
        weather = [draw_recipe(kind, number) for kind in LEARNT_WEATHER for number in numbers]
        return [draw_recipe(CLEAR, 0), *weather]

    @property
    def train_images(self) -> list[SceneImages]:
        """Return the images to learn from, of each scene."""
        return [
            SceneImages(uri, self.recipes_of(uri), self.train_frames, self.train_cameras)
            for uri in self.train_scenes
        ]


def draw_recipe(kind: str, number: int) -> Recipe:
    """Return one draw of a kind of weather, in numbers.

    Args:
        kind: The name of the kind, or CLEAR.
        number: The number of the draw.
    """
    text = f"{LEARNT_WEATHER.get(kind, 'weather:')}\n{OUTPUT}\n"
    return parse_recipe(text, source=kind, name=kind).resolve(number)


# A busy street.
BUSY_STREET = StreetParameters(
    frames=29, width=256, height=144, gaussians=100_000, parked=20, moving=6, pedestrians=6
)
# The street of `--quick`.
QUICK_STREET = BUSY_STREET.model_copy(
    update={"frames": 5, "width": 128, "height": 72, "gaussians": 60_000}
)

# The case of published figures. Frames of a street are 10 m apart, those of the suite 16 m.
FULL_CASE = DetectorCase(
    train_scenes=street_uris(range(6), BUSY_STREET),
    test_scenes=street_uris((100, 101, 102, 103, 106, 107), BUSY_STREET),
    train_frames=tuple(range(0, 29, 5)),
    test_frames="::8",
)
# The case of `--quick`.
QUICK_CASE = DetectorCase(
    train_scenes=street_uris(range(2), QUICK_STREET),
    test_scenes=street_uris((100, 101), QUICK_STREET),
    train_frames=(0, 4),
    test_frames="::4",
    effects=("fog", "lens"),
    levels=(1, 5),
    settings=TrainingSettings(
        steps=60,
        batch=4,
        learning_rate=4e-3,
        widths=(16, 24, 32),
        num_classes=len(CATEGORIES) + NUM_SIDES,
    ),
    seeds=(0, 1),
    executor="serial",
)


def measure(
    quick: bool = False,
    folder: Path | None = None,
    case: DetectorCase | None = None,
    *,
    scene_loader: SceneLoader = open_scene,
) -> Figures:
    """Render the images that are missing, train every arm from every seed, and score.

    Args:
        quick: True for QUICK_CASE.
        folder: The folder of images and predictions, which a later run reads again; None for a
            temporary one.
        case: The scenes and trainings; None for FULL_CASE or QUICK_CASE.
        scene_loader: Opens a scene from its URI; an importable function.

    Raises:
        ClimateGSError: pycocotools is not installed.
        OutputError: an image failed, or the folder holds another suite.
    """
    if importlib.util.find_spec("pycocotools") is None:
        raise ClimateGSError("the detectors' mAP needs pycocotools: pip install 'climategs[score]'")
    machine = machine_facts()
    case = case or (QUICK_CASE if quick else FULL_CASE)
    with tempfile.TemporaryDirectory(prefix="climategs-bench-") as name:
        work_dir = folder or Path(name)
        seconds = {"start": processor_s()}
        render_suite(case, work_dir / "suite", scene_loader)
        seconds["suite"] = processor_s()
        render_images(case.train_images, work_dir / "training", scene_loader)
        seconds["training images"] = processor_s()
        suite = read_suite(open_store(str(work_dir / "suite")))
        scores, hits, train_s = _train_and_score(case, suite, work_dir)
        seconds["training and scoring"] = processor_s()
    names = list(seconds)
    parts = {b: seconds[b] - seconds[a] for a, b in itertools.pairwise(names)}
    parts["one training"] = train_s
    titles = {arm: ARMS[arm].title for arm in ARMS}
    tables = make_tables(suite, scores, hits, titles, UNKNOWN_EFFECTS, parts)
    facts: dict[str, Any] = {
        arm: [run.model_dump(mode="json") for run in runs] for arm, runs in scores.items()
    }
    return figures("detector", tables.tables, machine=machine, curves=tables.curves, scores=facts)


# ---- images -------------------------------------------------------------------------------------


def render_suite(case: DetectorCase, out: Path, scene_loader: SceneLoader = open_scene) -> None:
    """Render the images of the suite that are missing.

    Raises:
        OutputError: An image failed, or the output holds another suite.
    """
    definition = load_suite(SUITE)
    variants = definition.select(case.effects, case.levels)
    setup = JobWorkerSetup(str(out), None, "auto", scene_loader)
    run = SuiteRun(
        suite_recipes(definition, variants, {"output.lidar": False}),
        [
            JobScene(uri=uri, frames=case.test_frames, cameras=case.test_cameras)
            for uri in case.test_scenes
        ],
        setup,
        recorded_conditions,
        executor=case.executor,
    )
    result = run_suite(run)
    if result.images.failed or result.images.unusable:
        raise OutputError(
            f"{out}: {result.images.failed} images failed, and {len(result.images.unusable)} "
            f"scenes cannot be used"
        )


def read_views(case: DetectorCase, folder: Path) -> DetectionViews:
    """Return the views to learn from.

    Raises:
        OutputError: An image is missing.
    """
    images = list[torch.Tensor]()
    targets = []
    kinds = tuple[str, ...]()
    for scene_images in case.train_images:
        kinds = tuple(recipe.name for recipe in scene_images.recipes)
        for samples in read_samples(scene_images, folder, "boxes"):
            images.append(torch.stack([sample["image"] for sample in samples]))
            objects = objects_of(samples[0]["boxes"])
            height, width = images[-1].shape[-2:]
            targets.append(make_targets(objects, len(CATEGORIES), (height, width)))
    return DetectionViews(torch.stack(images), kinds, stack_targets(targets))


def objects_of(boxes: Mapping[str, Any]) -> Objects:
    """Return the objects that an image shows, of the `boxes` of a sample of the clean render."""
    xyxy = boxes["modal_xyxy"]
    categories = torch.tensor(
        [CATEGORIES.index(label) if label in CATEGORIES else -1 for label in boxes["labels"]],
        dtype=torch.int64,
    )
    is_visible = xyxy.isfinite().all(dim=1) & (categories >= 0)
    xyxy = xyxy[is_visible]
    areas_px2 = (xyxy[:, 2:] - xyxy[:, :2]).prod(dim=1)
    fractions = boxes["visible_fraction"][is_visible]
    is_ignored = (areas_px2 < MIN_BOX_AREA_PX2) | (fractions < MIN_VISIBLE_FRACTION)
    return Objects(xyxy, categories[is_visible], is_ignored)


# ---- trainings and predictions ------------------------------------------------------------------


def _train_and_score(
    case: DetectorCase, suite: RenderedSuite, work_dir: Path
) -> tuple[dict[str, list[SuiteScores]], dict[str, list[Hits]], float]:
    """Train every arm from every seed, in processes.

    Returns:
        Scores and hits of each seed by arm, and the mean processor time of a training, seconds.
    """
    pairs = [(name, seed) for seed in case.seeds for name in ARMS]
    folders = {pair: work_dir / "predictions" / f"{pair[0]}-{pair[1]}" for pair in pairs}
    context = multiprocessing.get_context("spawn")
    with (
        ProcessPoolExecutor(case.workers, mp_context=context) as pool,
        tqdm(total=len(pairs), unit="training") as bar,
    ):
        futures = [
            pool.submit(train_and_predict, case, work_dir, name, seed, folders[name, seed])
            for name, seed in pairs
        ]
        for future in as_completed(futures):
            future.result()
            bar.update()
    scores: dict[str, list[SuiteScores]] = {name: [] for name in ARMS}
    hits: dict[str, list[Hits]] = {name: [] for name in ARMS}
    for name, seed in pairs:
        run = score_suite(suite.store, folders[name, seed])
        baseline = run if name == "clean" else scores["clean"][-1]
        scores[name].append(add_baseline(run, baseline, f"clean-{seed}"))
        hits[name].append(count_hits(suite, folders[name, seed]))
    return scores, hits, float(np.mean([future.result() for future in futures]))


def train_and_predict(
    case: DetectorCase, work_dir: Path, arm: str, seed: int, folder: Path
) -> float:
    """Train a detector, and write its predictions for the suite.

    Args:
        case: The case.
        work_dir: The folder of the rendered images.
        arm: The name of the way to train.
        seed: The seed.
        folder: The folder of the predictions.

    Returns:
        Processor time of the training, seconds.
    """
    views = read_views(case, work_dir / "training")
    suite = read_suite(open_store(str(work_dir / "suite")))
    with one_deterministic_thread():
        start_s = processor_s()
        network = train_detector(views, case.settings, kinds=ARMS[arm].kinds, seed=seed)
        train_s = processor_s() - start_s
        predict_suite(network, suite, folder)
    return train_s


def predict_suite(network: torch.nn.Module, suite: RenderedSuite, folder: Path) -> None:
    """Write the detections of all variants as `climategs score` reads them."""
    for variant, rows in suite.rows.items():
        entries = list[dict[str, Any]]()
        for number, row in enumerate(rows):
            rgb = load_image(suite, row["image_path"])
            detections = detect(network, torch.from_numpy(rgb).permute(2, 0, 1))
            pairs = zip(*(part.tolist() for part in detections), strict=True)
            for (left, top, right, bottom), category, score in pairs:
                entries.append(
                    {
                        "image_id": number,
                        "category_id": category + 1,
                        "bbox": [left, top, right - left, bottom - top],
                        "score": score,
                    }
                )
        paths = suite.entries.variants[variant].probes
        meta = {
            "variant": variant,
            "probe": probe(lambda path: load_image(suite, path), paths),
            "image_ids": list(range(len(rows))),
        }
        out = folder / variant
        out.mkdir(parents=True, exist_ok=True)
        (out / "results.json").write_text(json.dumps(entries))
        (out / "meta.json").write_text(json.dumps(meta))


def load_image(suite: RenderedSuite, path: str) -> np.ndarray:
    """Return an image of the suite, uint8 [H, W, 3]."""
    return decode_image(suite.store.read(path))
