"""Whatever the text, the loader returns a template or raises RecipeError, and templates draw."""

from __future__ import annotations

from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from recipes.errors import RecipeError
from recipes.load import dump_recipe, parse_recipe
from recipes.template import RecipeTemplate, root

KEYS = sorted(
    {key for section in root().walk() for key in section.known}
    | {"uniform", "log_uniform", "normal", "choice", "weights", "mean", "std", "min", "max"}
    | {"<<", "visibility_km", "on"}
)
SCALARS = st.sampled_from(
    [
        *("0", "1", "-5", "0.5", "1e-3", "1e400", ".nan", "-.inf", "300", "2", "010"),
        *("null", "", "true", "yes", "png", "dusk", "deferred", "x", "'1'", '"\\ud800"'),
        *("0x" + "f" * 300, "9" * 399, "*a", "&a 1", "!!int 3"),
        *("[0.1, 0.2, 0.3]", "{uniform: [1, 2]}"),
    ]
)


def flow(entries: dict[str, str]) -> str:
    return "{" + ", ".join(f"{key}: {value}" for key, value in entries.items()) + "}"


def block(entries: dict[str, str], head: str = "", indent: str = "") -> str:
    return head + "".join(f"{indent}{key}: {value}\n" for key, value in entries.items())


FLOW = st.recursive(
    SCALARS,
    lambda inner: (
        st.lists(inner, max_size=4).map(lambda items: f"[{', '.join(items)}]")
        | st.dictionaries(st.sampled_from(KEYS), inner, max_size=4).map(flow)
    ),
    max_leaves=12,
)
TOP = st.dictionaries(st.sampled_from(KEYS), FLOW, max_size=5).map(block)
EFFECTS = root().sections["weather"].sections
WAVE_KEYS = EFFECTS["flood"].sections["waves"].sections["components"].known
WAVES = st.lists(st.dictionaries(st.sampled_from(WAVE_KEYS), SCALARS).map(flow), max_size=3).map(
    lambda items: "{components: [" + ", ".join(items) + "]}"
)


def effect(name: str, given: dict[str, str], extra: st.SearchStrategy) -> st.SearchStrategy[str]:
    """A recipe of one effect, with what it needs given."""
    keys = [key for key in EFFECTS[name].known if key not in given and key != "waves"]
    head = f"weather:\n  {name}:\n"
    fields = st.dictionaries(st.sampled_from(keys), FLOW)
    return st.builds(lambda d, e: block({**given, **d, **e}, head, "    "), fields, extra)


NONE = st.just({})
SMOG, SNOW = effect("smog", {}, NONE), effect("snow", {"depth_m": "0.1"}, NONE)
FLOOD = effect("flood", {"level_m": "1"}, NONE | WAVES.map(lambda waves: {"waves": waves}))
GOOD = """version: 1
seed: 7
variants: 2
weather:
  smog: &s
    visibility_m: {log_uniform: [100, 2000]}
    color: {choice: [[0.7, 0.7, 0.7], [0.7, {uniform: [0.6, 0.8]}, 0.7]], weights: [1, 2]}
    scale_height_m: {normal: {mean: 60, std: 10, min: 50, max: 90}}
  flood:
    level_m: {uniform: [0.1, 0.5]}
    absorption_per_m: {uniform: [[1, 2, 3], [2, 3, 4]]}
    waves:
      components:
        - {amplitude_m: 0.01, wavelength_m: {uniform: [1, 2]}, steepness: 0.06}
        - {amplitude_m: 0.002, wavelength_m: 0.3}
  snow:
    depth_m: {uniform: [0.02, 0.2]}
    light: {sun: {choice: [null, 0.5]}}
style: {preset: dusk, strength: {uniform: [0.5, 1]}, method: {choice: [mkl, reinhard]}}
output: {image: png, jpeg_quality: {uniform: [60, 95]}}
"""
# Without derandomize, one run in a thousand would test something that no other run repeats.
FUZZ = settings(
    max_examples=150, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.too_slow]
)


def loads_or_explains(text: str) -> RecipeTemplate | None:
    try:
        template = parse_recipe(text, source="fuzz.yaml")
    except RecipeError as error:
        assert error.problems
        for problem in error.problems:
            assert problem.startswith("fuzz.yaml:") and "\n" not in problem
            problem.encode()  # can be printed, even where the text held half a surrogate pair
            assert len(problem) < 1000
        return None
    recipe = template.resolve(0)
    assert parse_recipe(dump_recipe(recipe), source="dump").resolve(0) == recipe
    template.describe_ranges()
    return template


@FUZZ
@given(st.text())
@example("a: \ud800")
@example("? ")
@example("%")
@example("- - - -")
@example("!")
@example("&a *a")
def test_any_text(text: str) -> None:
    loads_or_explains(text)


@FUZZ
@given(st.text(alphabet="ab:-?,[]{}&*!|>'\"%@`#~ \n\t0.1e<=", max_size=60))
def test_text_of_yaml_signs(text: str) -> None:
    loads_or_explains(text)


@settings(FUZZ, max_examples=400)
@given(st.one_of(TOP, SMOG, FLOOD, SNOW))
def test_known_keys_with_any_values(text: str) -> None:
    loads_or_explains(text)


@FUZZ
@given(st.data())
def test_a_good_file_with_a_few_characters_changed(data: st.DataObject) -> None:
    text = GOOD
    for _ in range(data.draw(st.integers(0, 3))):
        at = data.draw(st.integers(0, len(text)))
        length = data.draw(st.integers(0, 12))
        text = text[:at] + data.draw(st.text(max_size=4)) + text[at + length :]
    loads_or_explains(text)
