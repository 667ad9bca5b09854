"""`climategs tags`, and tags as columns and filters of an output."""

from __future__ import annotations

import csv
import io
import json
import math
from pathlib import Path
from xml.etree import ElementTree as ET

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest

from augment.dataset import WeatherDataset
from augment.errors import OutputError
from augment.output.manifest import read_manifest
from recipes.load import parse_recipe
from recipes.schema import Recipe
from recipes.tags import CLASS_COLUMNS, columns_of_tags
from tests.augment.batch_scenes import write_scene
from tools.cli import main
from tools.tags import FORMATS, osi_conditions, read_tags

# 5 and 2 % of contrast on either side of a border, rain with wind, and weather that changes.
WEATHERS = {
    "fog": "{smog: {mor_m: 150}}",
    "wet": "{rain: {rate_mm_h: 16, wind_mps: 3, wind_from_deg: -90}, flood: {level_m: 0.05}}",
    "clear": "{}",
    "drying": "{rain: {rate_mm_h: {timeline: [[0, 3], [0.2, 3], [0.25, 0], [1, 0]], "
    "times: share}}, "
    "air: {temperature_c: 38, humidity: 0.1, wind_m_s: 15, road_warmer_k: 15}, "
    "clock: {speed: 10000}}",
    "thickening": "{smog: {visibility_m: {timeline: [[0, 4000], [1, 40]], times: share}}}",
}


def recipe_of(name: str) -> Recipe:
    text = f"weather: {WEATHERS[name]}\noutput: {{labels: false, lidar: false}}"
    return parse_recipe(text, source=f"{name}.yaml", name=name).resolve(0)


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("tags")
    write_scene(folder, [recipe_of(name) for name in WEATHERS])
    return folder


def printed(out: Path, format_name: str, capsys: pytest.CaptureFixture) -> str:
    assert main(["tags", str(out), "--format", format_name]) == 0
    return capsys.readouterr().out


def test_the_table_has_a_row_for_each_variant_and_each_frame_that_differs(out, capsys) -> None:
    rows = list(csv.DictReader(io.StringIO(printed(out, "csv", capsys))))
    assert [row["variant"] for row in rows] == [
        *("clear-000", *["drying-000"] * 4, "fog-000"),
        *["thickening-000"] * 4,
        "wet-000",
    ]
    clear, *drying, fog = rows[:6]
    *frames, wet = rows[6:]
    assert [row["openscenario_precipitation"] for row in drying] == ["rain", "dry", "dry", "dry"]
    assert [row["wmo_weather"] for row in drying] == ["RA", "NSW", "NSW", "NSW"]
    assert [row["openscenario_wetness"] for row in drying[1:]] == [
        *("wetWithPuddles", "wetWithPuddles", "dry")
    ]
    assert (fog["mor_m"], fog["visibility_m"], fog["osi_fog"]) == ("150", "195.878652", "thick")
    assert (clear["mor_m"], clear["osi_fog"], clear["frame"]) == ("", "excellent", "")
    assert (wet["wmo_weather"], wet["openscenario_wetness"]) == ("+RA", "lowFlooded")
    assert [row["frame"] for row in frames] == ["0", "1", "2", "3"]
    assert frames[0]["visibility_m"] == "4000" and frames[0]["osi_fog"] == "poor"
    classes = [row["osi_fog"] for row in frames]
    assert classes == sorted(classes, key=["poor", "mist", "light", "thick", "dense"].index)
    assert classes[-1] == "dense"


def test_images_have_the_tags_of_their_own_time_as_columns(out) -> None:
    table = read_manifest(out)
    tags = {(t.variant, t.frame): t.tags for t in read_tags(out)}
    for row in table.select(["variant", "frame", "camera", "mor_m", *CLASS_COLUMNS]).to_pylist():
        frame_tags = tags.get((row["variant"], None)) or tags[row["variant"], row["frame"]]
        # Cameras of a frame look at slightly different times.
        expected = None if frame_tags.mor_m is None else pytest.approx(frame_tags.mor_m, rel=0.1)
        assert row["mor_m"] == expected
        if row["variant"] in ("clear-000", "fog-000", "wet-000"):
            assert {name: row[name] for name in CLASS_COLUMNS} == {
                name: getattr(frame_tags, name) for name in CLASS_COLUMNS
            }
    changing = table.filter(pc.equal(table["variant"], "thickening-000"))
    assert len(set(changing["osi_fog"].to_pylist())) >= 3
    extinction = changing["smog_extinction_per_m"].to_numpy()
    assert changing["mor_m"].to_numpy() == pytest.approx(math.log(20) / extinction)


def test_a_dataset_is_filtered_by_tags(out, tmp_path) -> None:
    thick = WeatherDataset(out, where=pc.field("osi_fog").isin(["thick", "dense"]))
    variants = {thick[index]["variant"] for index in range(len(thick))}
    assert variants == {"fog-000", "thickening-000"}
    near = WeatherDataset(out, where=pc.field("mor_m") < 200)
    assert len(near) == len(thick)
    clear = pc.field("wmo_weather") == "NSW"
    dry = WeatherDataset(out, where=clear & (pc.field("variant") != "drying-000"))
    assert {row["variant"] for row in dry.table.to_pylist()} == {"clear-000"}
    # Values may be called like a column.
    assert len(WeatherDataset(out, where=pc.field("scene") == "osi_fog")) == 0


def test_filters_by_tags_that_an_older_output_lacks_are_refused(out, tmp_path) -> None:
    table = pq.read_table(out / "manifest.parquet")
    older = table.drop_columns([*CLASS_COLUMNS, "mor_m"])
    pq.write_table(older, tmp_path / "manifest.parquet")
    with pytest.raises(ValueError, match=r"asks for osi_fog, and \d+ of \d+ finished .* have none"):
        WeatherDataset(tmp_path, where=pc.field("osi_fog") == "thick")
    by_number = WeatherDataset(tmp_path, where=pc.field("smog_extinction_per_m") > 0.01)
    assert len(by_number) and by_number.table["osi_fog"].null_count == len(by_number)


def test_an_older_output_has_tags_all_the_same(out, tmp_path) -> None:
    for name in ("clear", "fog"):
        folder = tmp_path / "street" / f"{name}-000"
        folder.mkdir(parents=True)
        recipe = (out / "street" / f"{name}-000" / "recipe.yaml").read_bytes()
        (folder / "recipe.yaml").write_bytes(recipe)
    table = read_manifest(out).drop_columns([*CLASS_COLUMNS, "mor_m"])
    rows = table.filter(pc.is_in(table["variant"], pa.array(["clear-000", "fog-000"])))
    pq.write_table(rows, tmp_path / "manifest.parquet")
    expected = [t.tags for t in read_tags(out) if t.variant in ("clear-000", "fog-000")]
    assert [t.tags for t in read_tags(tmp_path)] == expected
    text = (folder / "recipe.yaml").read_text()
    (folder / "recipe.yaml").write_text(text.replace("mor_m: 150.0", "mor_m: 151.0"))
    with pytest.raises(OutputError, match=r"fog-000/recipe.yaml must be the recipe of the images"):
        read_tags(tmp_path)


def test_osi_has_the_names_of_its_enumerations(out, capsys) -> None:
    document = json.loads(printed(out, "osi", capsys))
    assert document["street/wet-000"] == {
        "ambient_illumination": "AMBIENT_ILLUMINATION_UNKNOWN",
        "precipitation": "PRECIPITATION_HEAVY",
        "fog": "FOG_EXCELLENT_VISIBILITY",
    }
    assert document["street/fog-000"]["fog"] == "FOG_THICK"
    assert document["street/thickening-000/000000"]["fog"] == "FOG_POOR_VISIBILITY"
    night = parse_recipe("light: {time: night}", source="n.yaml", name="n").resolve(0)
    tags = read_tags(out)[0].tags
    assert columns_of_tags(night)["osi_illumination"] == "level4"
    assert osi_conditions(tags)["precipitation"] == "PRECIPITATION_NONE"


def test_openscenario_is_a_catalog_of_environments(out, capsys) -> None:
    root = ET.fromstring(printed(out, "openscenario", capsys))
    header = root.find("FileHeader")
    assert header is not None and (header.get("revMajor"), header.get("revMinor")) == ("1", "2")
    environments = {e.get("name"): e for e in root.iterfind("Catalog/Environment")}
    wet = environments["street/wet-000"]
    weather = {element.tag: element.attrib for element in wet.find("Weather") or ()}
    assert weather == {
        "Precipitation": {"precipitationIntensity": "16", "precipitationType": "rain"},
        "Wind": {"direction": "4.71238898", "speed": "3"},  # from -90 degrees: 3 pi / 2
    }
    road = wet.find("RoadCondition")
    assert road is not None
    assert road.attrib == {"frictionScaleFactor": "0.83", "wetness": "lowFlooded"}
    fog = environments["street/fog-000"].find("Weather/Fog")
    assert fog is not None and fog.attrib == {"visualRange": "150"}
    assert environments["street/clear-000"].find("Weather/Fog") is None


def test_openlabel_has_numbers_in_the_units_of_its_ontology(out, capsys, tmp_path) -> None:
    document = json.loads(printed(out, "openlabel", capsys))["street/wet-000"]["openlabel"]
    assert document["metadata"]["schema_version"] == "1.0.0"
    tags = {tag["type"]: tag for tag in document["tags"].values()}
    assert tags["weatherRainValue"]["tag_data"]["num"][0]["val"] == 16
    assert {"WeatherRain", "SurfaceConditionFlooded"} <= tags.keys()
    assert all(tag["ontology_uid"] in document["ontologies"] for tag in tags.values())
    file = tmp_path / "tags.json"
    assert main(["tags", str(out), "--format", "openlabel", "--file", str(file)]) == 0
    assert json.loads(file.read_text())["street/wet-000"]["openlabel"] == document
    assert "wrote" in capsys.readouterr().out


def test_folders_without_an_output_are_refused(tmp_path, capsys) -> None:
    for format_name in FORMATS:
        assert main(["tags", str(tmp_path), "--format", format_name]) == 2
    assert "is no finished output folder" in capsys.readouterr().err
    assert main(["tags", "s3://bucket/out"]) == 2
