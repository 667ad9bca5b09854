"""Draws and messages that no version may change: the recipe's numbers, and where a fault is.

`wrong_recipes.json` is a table of faults, each a few changed lines of a preset or of RICH.
"""

from __future__ import annotations

import hashlib
import json
import random
import re
from pathlib import Path

import pytest

from recipes.errors import RecipeError
from recipes.fields import packaged_text
from recipes.load import load_recipe, parse_recipe, preset_names
from recipes.template import RecipeTemplate

NUM_VARIANTS = 50
NUM_TEMPLATES = 150


def digest(templates: list[RecipeTemplate], num_variants: int) -> str:
    """Hash the canonical JSON, which has every bit of every number, of the first variants."""
    texts = [t.resolve(k).canonical_json() for t in templates for k in range(num_variants)]
    return hashlib.sha256("\n".join(texts).encode()).hexdigest()[:16]


PRESETS = {
    "blizzard": "18e900c8ba7012e2",
    "brown-smog": "8decc4c09550077a",
    "clear": "1e1fd554a7f9ba30",
    "deep-flood": "960c1c744bff6617",
    "deep-snow": "22022722fefe7740",
    "dense-fog": "0940ca220faf4622",
    "downpour": "568fe3732cde5b26",
    "drizzle": "8c832df0db003d51",
    "drying-road": "44ab5192bae32c17",
    "dusk-lamps": "a86249c1f2c5ef92",
    "dusting": "27448a9db136a29e",
    "evening": "34733b3c9bf4144d",
    "first-snow": "8238e93962252eed",
    "flurries": "b5cf05104f05a211",
    "fog-bank": "0e95bd8906e6619c",
    "foggy-lamps": "9b3ddc7207c300ed",
    "fresh-snow": "4c72878cde6040fc",
    "light-haze": "5e425464cf301de1",
    "night": "2f83fa6217148b72",
    "night-fog": "9b30ab1e1b80b194",
    "night-rain": "09afbc31960c272e",
    "overcast": "5f097c152a748005",
    "passing-shower": "03e51a75c2bd1354",
    "puddled": "bc75e7b5574e727a",
    "rain": "62dc7be361876ebd",
    "slush": "3d860d8dae84e1db",
    "snowfall": "bdde9b144ab6c6bd",
    "storm": "b93e206ac51504d1",
    "street-flood": "57bcd16a1256403d",
    "winter-day": "dc738d7355359818",
    "winter-fog": "3ed30feff48ae816",
    "winter-street": "6c8f8fad8d6e2027",
}


@pytest.mark.parametrize("name", preset_names())
def test_fifty_variants_of_a_preset_are_pinned(name: str) -> None:
    assert digest([load_recipe(name)], NUM_VARIANTS) == PRESETS[name]


# ---- Generated templates -------------------------------------------------------------------------

# Numbers: low and high, within which ranges are made. A whole low end makes whole numbers.
NUMBERS = {
    "weather.smog.visibility_m": (20.0, 5000.0),
    "weather.smog.scale_height_m": (1.0, 300.0),
    "weather.smog.scatter": (0.1, 2.0),
    "weather.flood.level_m": (0.1, 2.0),
    "weather.flood.turbidity_ntu": (1.0, 200.0),
    "weather.flood.waves.count": (4, 24),
    "weather.flood.waves.seed": (1, 10**6),
    "weather.snow.depth_m": (0.01, 1.0),
    "weather.snow.light.sun": (0.1, 1.0),
    "weather.snow.wind.direction_deg": (1.0, 360.0),
    "weather.rain.rate_mm_h": (0.5, 100.0),
    "weather.rain.wetness": (0.1, 1.0),
    "weather.snowfall.rate_mm_h": (0.1, 10.0),
    "style.strength": (0.2, 2.0),
    "camera.noise": (0.001, 0.1),
    "camera.lens_drops.count": (1, 100),
    "camera.lens_drops.radius_mm": (0.2, 5.0),
    "render.scale": (0.25, 2.0),
    "render.sh_degree": (1, 3),
    "output.jpeg_quality": (50, 99),
}
NULLABLE = ("scale_height_m", "turbidity_ntu", "sun", "wetness", "drops.count", "sh_degree")
WORDS = {
    "weather.smog.model": ("per_gaussian", "deferred"),
    "weather.flood.reference": ("lowest", "median", "absolute"),
    "weather.snow.tracks": ("auto", "always", "never"),
    "weather.rain.spray": ("true", "false"),
    "style.preset": ("dusk", "rain", "night"),
    "style.method": ("mkl", "reinhard"),
    "quality.tier": ("draft", "balanced", "reference", "null"),
    "output.lidar": ("auto", "weather", "true", "false"),
    "output.surface": ("solid", "scene", "first"),
}
COLOURS = ("weather.smog.color", "weather.flood.color", "weather.rain.color")
# Fields without which a section is none.
REQUIRED = (
    *("weather.smog.visibility_m", "weather.flood.level_m", "weather.snow.depth_m"),
    *("weather.rain.rate_mm_h", "weather.snowfall.rate_mm_h", "style.preset"),
)


EFFECTS = ("smog", "flood", "snow", "rain", "snowfall")


class Generator:
    """Random recipes: every kind of range, choices of ranges, weights, lists, probabilities."""

    def __init__(self, seed: int) -> None:
        self._random = random.Random(seed)

    def text(self) -> str:
        choose = self._random
        fields = {path: self._number(path) for path in NUMBERS}
        fields |= {path: self._word(WORDS[path]) for path in WORDS}
        fields |= {path: self._colour() for path in COLOURS}
        if choose.random() < 0.5:
            fields["weather.flood.waves.components"] = self._waves()
        effects = [name for name in EFFECTS if choose.random() < 0.6]
        tree: dict = {}
        for path, value in fields.items():
            parents = path.split(".")[:-1]
            is_absent = parents[0] == "weather" and parents[1] not in effects
            if is_absent or (path not in REQUIRED and choose.random() < 0.5):
                continue
            section = tree
            for parent in parents:
                section = section.setdefault(parent, {})
            section[path.rpartition(".")[2]] = value
        for effect in effects:
            if choose.random() < 0.3 and effect in tree["weather"]:
                tree["weather"][effect]["probability"] = f"{choose.random():.3f}"
        tree["seed"] = choose.randrange(2**62)
        tree["variant"] = choose.randrange(1000)
        return flow(tree)

    def _number(self, path: str, depth: int = 0) -> str:
        low, high = NUMBERS[path]
        return self._range(low, high, depth, nullable=path.endswith(NULLABLE))

    def _range(self, low: float, high: float, depth: int = 0, *, nullable: bool = False) -> str:
        kind = self._random.randrange(6 if depth < 2 else 4)
        first, second = sorted(self._between(low, high) for _ in range(2))
        if kind == 0:
            return f"{first}"
        if kind == 1:
            return f"{{uniform: [{first}, {second}]}}"
        if kind == 2:
            return f"{{log_uniform: [{first}, {second}]}}"
        if kind == 3 and first < second:
            mean = self._random.uniform(first, second)
            std = self._random.uniform(0.1, 2) * (second - first)
            return f"{{normal: {{mean: {mean}, std: {std:.5f}, min: {first}, max: {second}}}}}"
        count = self._random.randint(1, 4)
        options = [self._range(low, high, depth + 1) for _ in range(count)]
        return self._choice(options + ["null"] * (nullable and kind == 4))

    def _between(self, low: float, high: float) -> float:
        if isinstance(low, int):
            return self._random.randint(low, int(high))
        return round(self._random.uniform(low, high), 4)

    def _choice(self, options: list[str]) -> str:
        weights = [self._random.choice((1, 0.25, 3, 2.5)) for _ in options]
        written = f", weights: {weights}" if self._random.random() < 0.5 else ""
        return f"{{choice: [{', '.join(options)}]{written}}}"

    def _word(self, words: tuple[str, ...]) -> str:
        if self._random.random() < 0.5:
            return self._random.choice(words)
        return self._choice(self._random.sample(words, self._random.randint(1, len(words))))

    def _colour(self, depth: int = 0) -> str:
        kind = self._random.randrange(4 if depth < 1 else 2)
        if kind == 0:
            return f"[{', '.join(self._range(0.05, 0.95) for _ in range(3))}]"
        ends = [[round(self._random.random(), 3) for _ in range(3)] for _ in range(2)]
        if kind < 3:
            return f"{{uniform: {ends}}}" if kind == 1 else f"{ends[0]}"
        return self._choice([self._colour(1) for _ in range(3)])

    def _waves(self) -> str:
        wave = "{{amplitude_m: {}, wavelength_m: {}, steepness: {}}}"
        parts = ((0.001, 0.01), (1.0, 9.0), (0.01, 0.2))
        waves = (wave.format(*(self._range(*ends) for ends in parts)) for _ in range(3))
        return f"[{', '.join(waves)}]"


def flow(tree: dict) -> str:
    items = (f"{k}: {flow(v) if isinstance(v, dict) else v}" for k, v in tree.items())
    return "{" + ", ".join(items) + "}"


def test_generated_templates_are_pinned() -> None:
    generator = Generator(seed=1)
    texts = [generator.text() for _ in range(NUM_TEMPLATES)]
    templates = [parse_recipe(text, source="generated") for text in texts]
    assert digest(templates, 3) == "6faae13387055469"


# ---- Wrong recipes -------------------------------------------------------------------------------

RICH = """\
version: 1
name: rich
seed: 7
variant: 2
variants: 4
quality:
  tier: {choice: [draft, balanced]}
weather:
  smog:
    visibility_m: {log_uniform: [100, 2000]}
    color: {choice: [[0.7, 0.7, 0.7], [0.7, {uniform: [0.6, 0.8]}, 0.7]], weights: [1, 2]}
    scale_height_m: {normal: {mean: 60, std: 10, min: 50, max: 90}}
    base_height_m: {choice: [0, {uniform: [-5, 5]}, 12.5], weights: [1, 2, 0]}
    model: {choice: [deferred, per_gaussian]}
    probability: 0.75
  flood:
    level_m: {uniform: [0.1, 0.5]}
    absorption_per_m: {uniform: [[1, 2, 3], [2, 3, 4]]}
    color: [0.42, {uniform: [0.3, 0.4]}, {choice: [0.25, 0.3]}]
    waves:
      seed: {uniform: [0, 1000]}
      components:
        - {amplitude_m: 0.01, wavelength_m: {uniform: [1, 2]}, steepness: 0.06}
        - {amplitude_m: {uniform: [0.002, 0.02]}, wavelength_m: 0.3, phase_deg: {uniform: [0, 360]}}
  snow:
    depth_m: {uniform: [0.02, 0.2]}
    coverage: 0.9
    light: {sun: {choice: [null, 0.5]}, brightness: 0.8}
    wind:
      drift: {normal: {mean: 0.3, std: 0.1, min: 0, max: 1}}
  rain:
    rate_mm_h: {normal: {mean: 5, std: 2, min: 0, max: 10}}
    wetness: {choice: [null, {uniform: [0.5, 1]}]}
    spray: {choice: [true, false]}
style: {preset: dusk, strength: {uniform: [0.5, 1]}, method: {choice: [mkl, reinhard]}}
camera:
  noise: {uniform: [0.001, 0.003]}
  lens_drops: {count: {uniform: [0, 40]}, radius_mm: {log_uniform: [0.5, 2]}}
render: {scale: {choice: [0.5, 1]}, sh_degree: {uniform: [0, 3]}, exposure: neutral}
output:
  image: {choice: [png, jpg]}
  jpeg_quality: {uniform: [60, 95]}
  lidar: {choice: [auto, true, weather]}
  labels: [coco, kitti]
  categories:
    - {label: "vehicle.*", name: car}
    - {label: pedestrian, name: person}
  min_visibility: {uniform: [0, 0.2]}
"""
WRONG = json.loads((Path(__file__).parent / "wrong_recipes.json").read_text(encoding="utf-8"))


@pytest.mark.parametrize("base", sorted({row[0] for row in WRONG}))
def test_wrong_recipes_are_refused_at_their_lines_and_paths(base: str) -> None:
    """A row has a base, a line, the number of lines that go, the new lines, and the problems."""
    lines = (RICH if base == "rich" else packaged_text("presets", base)).split("\n")
    for row in WRONG:
        _, line, num_lines, text, places = row
        if row[0] != base:
            continue
        new_lines = text.split("\n") if text else []
        changed = [*lines[: line - 1], *new_lines, *lines[line - 1 + num_lines :]]
        with pytest.raises(RecipeError) as caught:
            parse_recipe("\n".join(changed), source="r")
        found = [re.match(r"r:(\d+): (.*?)(?: = |: | is given)", p) for p in caught.value.problems]
        assert sorted({f"{m[1]} {m[2]}" for m in found if m}) == places, row
