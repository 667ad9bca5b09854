"""`climategs bench training`: the gain of a small network from training on weather and night.

Procedural streets are rendered in clear air and in several kinds of weather. A small U-Net is
trained in several ways from several seeds, and tested on other streets, in weather that it has and
has not learnt. Everything is fixed here: streets, ranges of the weather, steps and seeds. Images
are rendered once into a folder; an interrupted run goes on where it was.
"""

from __future__ import annotations

import math
import statistics
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from tqdm import tqdm

from adapters.base import open_scene
from adapters.street.layout import StreetParameters
from augment.jobs.render_job import SceneLoader
from augment.scene.semantics import SemanticClass
from recipes.load import parse_recipe
from recipes.schema import Recipe
from tools.bench.harness import Figures, Table, figures, machine_facts
from tools.bench.scene_images import (
    SceneImages,
    processor_s,
    read_samples,
    render_images,
    street_uris,
)
from tools.bench.segmentation import (
    IGNORED_LABEL,
    TrainingSettings,
    Views,
    one_deterministic_thread,
    score_network,
    train_network,
)

# The classes that the network tells apart: few, so that it sees each of them often.
CLASSES: Mapping[str, tuple[SemanticClass, ...]] = {
    "road": (SemanticClass.ROAD, SemanticClass.LANE_MARKING),
    "sidewalk": (SemanticClass.SIDEWALK,),
    "nature": (SemanticClass.VEGETATION, SemanticClass.TERRAIN),
    "building": (SemanticClass.BUILDING, SemanticClass.BARRIER),
    "pole, sign": (SemanticClass.POLE, SemanticClass.SIGN),
    "vehicle": (SemanticClass.VEHICLE, SemanticClass.TWO_WHEELER),
    "person": (SemanticClass.PEDESTRIAN,),
    "sky": (SemanticClass.SKY,),
}
# Labels show the scene without its weather: road under snow or water is road.
OUTPUT = "output: {depth: none, semantic: true, surface: scene, lidar: false, labels: false}"
CLEAR = "clear"  # The name of the condition without weather.


@dataclass(frozen=True)
class Condition:
    """A kind of weather, or of light."""

    title: str
    """Its name in tables."""
    recipe: str
    """Its recipe without outputs, YAML."""


CONDITIONS: Mapping[str, Condition] = {
    CLEAR: Condition("clear", "weather:"),
    "smog": Condition(
        "smog, 60 to 400 m",
        """
weather:
  smog:
    visibility_m: {log_uniform: [60, 400]}
    color: {uniform: [[0.60, 0.57, 0.52], [0.84, 0.85, 0.86]]}
    scale_height_m: {choice: [null, 60]}
""",
    ),
    "snow": Condition(
        "snow, 3 to 12 cm",
        """
weather:
  snow:
    depth_m: {uniform: [0.03, 0.12]}
    coverage: {uniform: [0.5, 1.0]}
    cell_m: 0.15  # smaller splats are not told apart at this resolution
    wind: {direction_deg: {uniform: [0, 360]}, drift: {uniform: [0.1, 0.5]}}
""",
    ),
    "light": Condition(
        "light: four styles",
        """
style:
  preset: {choice: [overcast, golden-hour, dusk, hazy-summer]}
  strength: {uniform: [0.7, 1.0]}
""",
    ),
    "rain": Condition(
        "rain, 5 to 80 mm/h, wet road and puddles",
        """
weather:
  rain:
    rate_mm_h: {log_uniform: [5, 80]}
    wind_mps: {uniform: [0, 8]}
    wind_from_deg: {uniform: [0, 360]}
""",
    ),
    "snowfall": Condition(
        "snowfall, 0.3 to 6 mm/h, bare ground",
        """
weather:
  snowfall:
    rate_mm_h: {log_uniform: [0.3, 6]}
    wind_mps: {uniform: [0, 8]}
    wind_from_deg: {uniform: [0, 360]}
""",
    ),
    "dusk-lamps": Condition("dusk with lamps (`dusk-lamps`)", "extends: dusk-lamps"),
    "night": Condition("night with lamps (`night`)", "extends: night"),
    "night-rain": Condition("rain at night (`night-rain`)", "extends: night-rain"),
    "night-fog": Condition("fog at night (`night-fog`)", "extends: night-fog"),
    "dry-rain": Condition(
        "rain on a dry road",
        """
weather:
  rain:
    rate_mm_h: {log_uniform: [5, 80]}
    wind_mps: {uniform: [0, 8]}
    wind_from_deg: {uniform: [0, 360]}
    wetness: 0
    spray: false
""",
    ),
    "snowstorm": Condition(
        "snowfall of 10 mm/h in a storm over 8 cm",
        """
weather:
  snow: {depth_m: 0.08, cell_m: 0.15}
  snowfall: {rate_mm_h: 10, wind_mps: 18, wind_from_deg: {uniform: [0, 360]}}
""",
    ),
    "thick-smog": Condition("thicker smog, 30 m", "weather: {smog: {visibility_m: 30}}"),
    "flood": Condition(
        "flood",
        """
weather:
  flood:
    level_m: {uniform: [0.15, 0.35]}
    turbidity_ntu: {log_uniform: [20, 150]}
    waves: {preset: {choice: [calm, breeze]}, direction_deg: {uniform: [0, 360]}}
""",
    ),
    "night-style": Condition("night as a style, without lamps", "style: {preset: night}"),
}
DAY_WEATHER = ("smog", "snow", "light", "rain", "snowfall")  # The conditions learnt by day.
DARK_HOURS = ("dusk-lamps", "night", "night-rain", "night-fog")  # Those learnt at dusk and night.

# The number of the first draw that is tested; those that are learnt lie below.
FIRST_TEST_DRAW = 100


@dataclass(frozen=True)
class Arm:
    """A way to train."""

    title: str
    """Its heading in tables."""
    kinds: tuple[str, ...] = ()
    """The conditions that half of its images show; empty for clean images only."""
    is_jittered: bool = False
    """True if colours are jittered."""


ARMS: Mapping[str, Arm] = {
    "clean": Arm("trained on clean"),
    "jitter": Arm("clean, colours jittered", is_jittered=True),
    "weather": Arm("clean and weather", DAY_WEATHER),
    "night": Arm("clean, weather and night", (*DAY_WEATHER, *DARK_HOURS)),
}


@dataclass(frozen=True)
class TrainingCase:
    """The scenes and weather that are rendered, and the trainings."""

    train_scenes: tuple[str, ...]
    """URIs of the scenes to learn from."""
    test_scenes: tuple[str, ...]
    """URIs of the scenes to test on."""
    frames: int = 8
    """The number of frames of each scene."""
    cameras: tuple[str, ...] = ("front", "front_left", "front_right")
    """The cameras of every frame."""
    draws: int = 2
    """The number of draws of each learnt condition in each training scene."""
    settings: TrainingSettings = field(
        default_factory=lambda: TrainingSettings(
            steps=300,
            batch=8,
            learning_rate=4e-3,
            widths=(16, 24, 32, 48),
            num_classes=len(CLASSES),
        )
    )
    """The settings of every training."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """The seeds: of first weights, of the order of images, and of what is drawn."""

    def recipes_of(self, uri: str) -> list[Recipe]:
        """Return the resolved recipes of a scene, the clean one first.

        No two scenes share a draw. A training scene has `draws` of each learnt condition, a test
        scene one of every condition.
        """
        learnt_kinds = (*DAY_WEATHER, *DARK_HOURS)
        if uri in self.train_scenes:
            first = self.train_scenes.index(uri) * self.draws
            numbers = range(first, first + self.draws)
            weather = [draw_recipe(kind, number) for kind in learnt_kinds for number in numbers]
        else:
            number = FIRST_TEST_DRAW + self.test_scenes.index(uri)
            weather = [draw_recipe(kind, number) for kind in CONDITIONS if kind != CLEAR]
        return [draw_recipe(CLEAR, 0), *weather]

    def images_of(self, uri: str) -> SceneImages:
        """Return the images of a scene."""
        return SceneImages(uri, self.recipes_of(uri), range(self.frames), self.cameras)


def draw_recipe(kind: str, number: int) -> Recipe:
    """Return one draw of a condition, in numbers.

    Args:
        kind: The name of a condition.
        number: The number of the draw.
    """
    text = f"{CONDITIONS[kind].recipe}\n{OUTPUT}\n"
    return parse_recipe(text, source=kind, name=kind).resolve(number)


# A street of few Gaussians.
SMALL_STREET = StreetParameters(frames=8, width=160, height=96, gaussians=60_000)
# The street of `--quick`.
QUICK_STREET = SMALL_STREET.model_copy(update={"frames": 2, "width": 96, "height": 64})

# The case of published figures.
FULL_CASE = TrainingCase(
    train_scenes=street_uris(range(6), SMALL_STREET),
    test_scenes=street_uris(range(100, 103), SMALL_STREET),
)
# The case of `--quick`.
QUICK_CASE = TrainingCase(
    train_scenes=street_uris(range(2), QUICK_STREET),
    test_scenes=street_uris((100,), QUICK_STREET),
    frames=2,
    draws=1,
    settings=TrainingSettings(
        steps=20, batch=4, learning_rate=4e-3, widths=(16, 24, 32), num_classes=len(CLASSES)
    ),
    seeds=(0, 1),
)


def measure(
    quick: bool = False,
    folder: Path | None = None,
    case: TrainingCase | None = None,
    *,
    scene_loader: SceneLoader = open_scene,
) -> Figures:
    """Render the images that are missing, train every arm from every seed, and test.

    Args:
        quick: True for QUICK_CASE.
        folder: The folder of the images, which a later run reads again; None for a temporary one.
        case: The scenes and trainings; None for FULL_CASE or QUICK_CASE.
        scene_loader: Opens a scene from its URI.

    Raises:
        OutputError: an image failed, or the folder holds other images of the same names.
    """
    machine = machine_facts()
    case = case or (QUICK_CASE if quick else FULL_CASE)
    with tempfile.TemporaryDirectory(prefix="climategs-bench-") as name:
        images_dir = folder or Path(name)
        start_s = processor_s()
        num_rendered = render_missing(case, images_dir, scene_loader)
        rendered_s = processor_s()
        train_views = read_views(case, images_dir, case.train_scenes)
        test_views = read_views(case, images_dir, case.test_scenes)
    read_s = processor_s()
    scores = _train_and_test(case, train_views, test_views)
    seconds = {
        "rendering": rendered_s - start_s,
        "reading": read_s - rendered_s,
        "training": processor_s() - read_s,
    }
    _, _, _, height, width = train_views.images.shape
    num_images = train_views.labels.shape[:2].numel() + test_views.labels.shape[:2].numel()
    settings = case.settings
    title = (
        f"mIoU in %, mean (least to greatest) of {len(case.seeds)} seeds: "
        f"{len(case.train_scenes)} streets, tested on {len(case.test_scenes)} others, "
        f"{width}x{height}, {settings.steps} steps of {settings.batch} images"
    )
    tables = [
        Table(title, ("tested on", *(arm.title for arm in ARMS.values())), _score_rows(scores)),
        *(_class_table(scores, kind) for kind in (CLEAR, "night")),
        Table(
            "Images and processor time",
            ("images", "rendered now", *(f"{part} s" for part in seconds)),
            [(num_images, num_rendered, *seconds.values())],
        ),
    ]
    per_seed = {
        arm: {
            kind: [[None if math.isnan(iou) else float(iou) for iou in run[kind]] for run in runs]
            for kind in CONDITIONS
        }
        for arm, runs in scores.items()
    }
    return figures("training", tables, machine=machine, classes=[*CLASSES], iou=per_seed)


# ---- images -------------------------------------------------------------------------------------


def render_missing(case: TrainingCase, folder: Path, scene_loader: SceneLoader = open_scene) -> int:
    """Render the images of all scenes that are missing; return their number.

    A scene that lacks no image is not opened.

    Args:
        case: The case.
        folder: The output folder.
        scene_loader: Opens a scene from its URI.

    Raises:
        OutputError: an image failed.
    """
    scenes = (case.images_of(uri) for uri in (*case.test_scenes, *case.train_scenes))
    return render_images(scenes, folder, scene_loader)


def read_views(case: TrainingCase, folder: Path, uris: Sequence[str]) -> Views:
    """Read all views of some scenes.

    Args:
        case: The case.
        folder: The output folder.
        uris: The scenes, all to learn from or all to test on.

    Raises:
        OutputError: an image is missing.
    """
    images = list[torch.Tensor]()
    labels = list[torch.Tensor]()
    kinds = tuple[str, ...]()
    for uri in uris:
        scene_images = case.images_of(uri)
        kinds = tuple(recipe.name for recipe in scene_images.recipes)
        for samples in read_samples(scene_images, folder, "semantic"):
            images.append(torch.stack([sample["image"] for sample in samples]))
            labels.append(torch.stack([sample["semantic"] for sample in samples]))
    return Views(torch.stack(images), class_indices(torch.stack(labels)), kinds)


def class_indices(semantic: torch.Tensor) -> torch.Tensor:
    """Return indices into CLASSES, uint8, or IGNORED_LABEL, of numbers of SemanticClass."""
    lookup = np.full(256, IGNORED_LABEL, np.uint8)
    for index, members in enumerate(CLASSES.values()):
        lookup[[int(member) for member in members]] = index
    return torch.from_numpy(lookup)[semantic.long()]


# ---- trainings and tables -----------------------------------------------------------------------

# The IoU of every class by condition, of every seed, by arm.
Scores = dict[str, list[dict[str, np.ndarray]]]


def _train_and_test(case: TrainingCase, train_views: Views, test_views: Views) -> Scores:
    """Train every arm from every seed and return its scores."""
    scores: Scores = {name: [] for name in ARMS}
    with (
        one_deterministic_thread(),
        tqdm(total=len(case.seeds) * len(ARMS), unit="training") as bar,
    ):
        for seed in case.seeds:
            for name, arm in ARMS.items():
                network, _ = train_network(
                    train_views,
                    case.settings,
                    kinds=arm.kinds,
                    is_jittered=arm.is_jittered,
                    seed=seed,
                )
                scores[name].append(score_network(network, test_views, len(CLASSES)))
                bar.update()
    return scores


def _score_rows(scores: Scores) -> list[tuple[str, ...]]:
    """Return the rows of the table of mean IoU: a condition, and the spread of every arm."""
    return [
        (
            condition.title + _learnt_by(kind),
            *(spread_text([float(np.nanmean(run[kind])) for run in scores[arm]]) for arm in ARMS),
        )
        for kind, condition in CONDITIONS.items()
    ]


def _learnt_by(kind: str) -> str:
    """Return the remark of a condition that not all arms with weather have learnt."""
    if kind in DARK_HOURS:
        return "; learnt by the last only"
    return "" if kind in (CLEAR, *DAY_WEATHER) else "; learnt by none"


def _class_table(scores: Scores, kind: str) -> Table:
    """Return the table of the IoU of every class in one condition."""
    rows = [
        (name, *(spread_text([float(run[kind][index]) for run in scores[arm]]) for arm in ARMS))
        for index, name in enumerate(CLASSES)
    ]
    title = f"IoU in % by class: {CONDITIONS[kind].title}"
    return Table(title, ("class", *(arm.title for arm in ARMS.values())), rows)


def spread_text(shares: Sequence[float]) -> str:
    """Return the mean of shares in percent, and the least and the greatest in brackets.

    The text is empty if a share is NaN: the class is in no test image.
    """
    if any(math.isnan(share) for share in shares):
        return ""
    percents = [100 * share for share in shares]
    return f"{statistics.fmean(percents):.1f} ({min(percents):.1f} to {max(percents):.1f})"
