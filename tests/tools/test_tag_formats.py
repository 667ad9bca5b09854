"""Tags of all variants of a suite against the published schemas of their formats.

The schemas are not part of this package. They come with `pip install asam-qc-openscenarioxml
openlabel-checker osi-python`; without these the tests are skipped.
"""

from __future__ import annotations

import importlib.util
import json
from pathlib import Path

import pytest

from recipes.load import parse_recipe
from recipes.suite import load_suite
from recipes.tags import tags_of
from tools.tags import FORMATS, TaggedWeather

pytestmark = pytest.mark.long

# Weather that no level has: wind with water, mist, dusk, rain and snow at once.
OTHERS = (
    "weather: {rain: {rate_mm_h: 16, wind_mps: 3, wind_from_deg: -90}, flood: {level_m: 0.05}}",
    "weather: {rain: {rate_mm_h: 3}, snowfall: {rate_mm_h: 1}, smog: {visibility_m: 3000}}",
    "light: {time: dusk}",
)


@pytest.fixture(scope="module")
def weathers() -> list[TaggedWeather]:
    suite = load_suite("weather-c-v1")
    recipes = [suite.recipe(variant, "street") for variant in suite.variants]
    recipes += [parse_recipe(t, source="w.yaml", name="w").resolve(0) for t in OTHERS]
    return [TaggedWeather("street", f"w-{k}", k, tags_of(r)) for k, r in enumerate(recipes)]


def folder_of(module: str) -> Path:
    """Return the folder of a package that has a schema; skip the test without it."""
    spec = importlib.util.find_spec(module)
    if spec is None or not spec.submodule_search_locations:
        pytest.skip(f"no {module} is installed")
    return Path(spec.submodule_search_locations[0])


def test_openscenario_is_valid_by_the_schema_of_version_1_2(weathers):
    etree = pytest.importorskip("lxml.etree")
    path = folder_of("qc_openscenario") / "schema/1.2.0/OpenSCENARIO.xsd"
    schema = etree.XMLSchema(etree.parse(str(path)))
    document = etree.fromstring(FORMATS["openscenario"](weathers).encode())
    assert schema.validate(document), schema.error_log
    document.find("Catalog/Environment/RoadCondition").set("wetness", "damp")
    assert not schema.validate(document)


def test_openlabel_is_valid_by_the_schema_of_version_1_0(weathers):
    jsonschema = pytest.importorskip("jsonschema")
    path = folder_of("openlabel_checker") / "schema_data/openlabel_json_schema-v1.0.0.json"
    schema = json.loads(path.read_text())
    validator = jsonschema.validators.validator_for(schema)(schema)
    documents = json.loads(FORMATS["openlabel"](weathers))
    assert len(documents) == len(weathers)
    for name, document in documents.items():
        assert not [error.message for error in validator.iter_errors(document)], name


def test_osi_is_read_by_its_own_message(weathers):
    json_format = pytest.importorskip("google.protobuf.json_format")
    environment = pytest.importorskip("osi3.osi_environment_pb2")
    for name, conditions in json.loads(FORMATS["osi"](weathers)).items():
        message = environment.EnvironmentalConditions()
        json_format.ParseDict(conditions, message)  # it refuses unknown fields and values
        assert message.fog and message.precipitation, name
