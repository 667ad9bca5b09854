"""The worked example of training on weather: which streets, which weather, how long.

All of it is fixed here and was not chosen by its outcome: the streets, what is drawn from the
ranges, steps and seeds. Steps and learning rate were tried on other streets than these.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from adapters.street.layout import StreetParameters
from recipes.parse import parse_recipe
from recipes.schema import Recipe

# Labels show the scene without its weather, whatever hides it: road under snow or water is road.
_HEAD = "output: {depth: none, semantic: true, surface: scene, lidar: false, labels: false}\n"

RECIPES: dict[str, str] = {
    "clear": "weather:",
    # What is trained on.
    "smog": """
weather:
  smog:
    visibility_m: {log_uniform: [60, 400]}
    color: {uniform: [[0.60, 0.57, 0.52], [0.84, 0.85, 0.86]]}
    scale_height_m: {choice: [null, 60]}
""",
    "snow": """
weather:
  snow:
    depth_m: {uniform: [0.03, 0.12]}
    coverage: {uniform: [0.5, 1.0]}
    cell_m: 0.15  # smaller splats are not told apart at this resolution
    wind: {direction_deg: {uniform: [0, 360]}, drift: {uniform: [0.1, 0.5]}}
""",
    "light": """
style:
  preset: {choice: [overcast, golden-hour, dusk, hazy-summer]}
  strength: {uniform: [0.7, 1.0]}
""",
    # What is not: beyond the range, and kinds that no training image shows.
    "thick-smog": "weather: {smog: {visibility_m: 30}}",
    "flood": """
weather:
  flood:
    level_m: {uniform: [0.15, 0.35]}
    turbidity_ntu: {log_uniform: [20, 150]}
    waves: {preset: {choice: [calm, breeze]}, direction_deg: {uniform: [0, 360]}}
""",
    "night": "style: {preset: night}",
}
CLEAN = "clear"


@dataclass(frozen=True)
class TrainingCase:
    """What is rendered, trained and tested.

    train_scenes, test_scenes: URIs. frames: how many of each, from 0 on. cameras: of every frame.
    train_weather: how many draws of each recipe every training scene has, beside the clean one.
    test_weather: conditions by group, each a recipe that every test scene has one new draw of.
    steps: of every training. batch: images a step. learning_rate: its highest. seeds: of a
    network's first weights and of the order of its images.
    """

    train_scenes: tuple[str, ...]
    test_scenes: tuple[str, ...]
    frames: int
    cameras: tuple[str, ...]
    train_weather: Mapping[str, int] = field(
        default_factory=lambda: {"smog": 2, "snow": 2, "light": 2}
    )
    test_weather: Mapping[str, tuple[str, ...]] = field(
        default_factory=lambda: {
            "clean": (CLEAN,),
            "seen weather": ("smog", "snow", "light"),
            "beyond the range": ("thick-smog",),
            "unseen weather": ("flood", "night"),
        }
    )
    steps: int = 300
    batch: int = 8
    learning_rate: float = 4e-3
    widths: tuple[int, ...] = (16, 24, 32, 48)
    seeds: tuple[int, ...] = (0, 1, 2)

    @property
    def conditions(self) -> tuple[str, ...]:
        """What is tested on, in order."""
        return tuple(name for names in self.test_weather.values() for name in names)

    def recipes_of(self, uri: str) -> list[Recipe]:
        """What is rendered of a scene. No two scenes, and no training and test, share a draw."""
        if uri in self.train_scenes:
            place, counts = self.train_scenes.index(uri), {CLEAN: 1, **self.train_weather}
            firsts = {name: place * count for name, count in counts.items()}
        else:
            place, counts = self.test_scenes.index(uri), dict.fromkeys(self.conditions, 1)
            after = len(self.train_scenes)
            firsts = {
                name: after * self.train_weather.get(name, 1) + place for name in self.conditions
            }
        return [
            draw(name, 0 if name == CLEAN else firsts[name] + number)
            for name, count in counts.items()
            for number in range(count)
        ]


def draw(name: str, variant: int) -> Recipe:
    """One recipe in numbers."""
    return parse_recipe(_HEAD + RECIPES[name], source=name, name=name).resolve(variant)


def streets(seeds: Sequence[int], *, frames: int, width: int, height: int) -> tuple[str, ...]:
    """URIs of light streets through which the car drives fast: frames that differ."""
    return tuple(
        StreetParameters(
            seed=seed,
            frames=frames,
            width=width,
            height=height,
            speed_mps=20.0,
            gaussians=60_000,
            lidar_columns=16,  # no sweep is used
            lidar_rings=2,
        ).uri
        for seed in seeds
    )


CAMERAS = ("front", "front_left", "front_right")
WHOLE = TrainingCase(
    train_scenes=streets(range(6), frames=8, width=160, height=96),
    test_scenes=streets(range(100, 103), frames=8, width=160, height=96),
    frames=8,
    cameras=CAMERAS,
)
QUICK = TrainingCase(
    train_scenes=streets(range(2), frames=4, width=96, height=64),
    test_scenes=streets(range(100, 101), frames=4, width=96, height=64),
    frames=4,
    cameras=CAMERAS,
    train_weather={"smog": 1, "light": 1},
    steps=40,
    seeds=(0, 1),
)
