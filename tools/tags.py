"""`climategs tags`: the weather of an output in the classes and words of standards.

In: an output folder. Out: a text of one of FORMATS. The tags themselves are `recipes.tags`.
"""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

from augment.errors import OutputError
from augment.output.atomic import write_atomic
from augment.output.layout import variant_folder
from augment.output.manifest import read_manifest
from augment.output.recipe_files import RECIPE_FILE
from recipes.errors import RecipeError
from recipes.fields import with_unchecked_field
from recipes.load import load_recipe
from recipes.moment import ANY_DRIVE, SceneTimes
from recipes.schema import Recipe
from recipes.tags import CLASS_COLUMNS, NUMBER_COLUMNS, Tags, tags_of

# Ontology of OpenLABEL's tags.
OPENLABEL_ONTOLOGY = (
    "https://openlabel.asam.net/V1-0-0/ontologies/openlabel_ontology_scenario_tags.ttl"
)
OPENLABEL_VERSION = "1.0.0"
# Columns of the manifest from which the tags of an image follow.
_IMAGE_COLUMNS = (
    "scene",
    "variant",
    "frame",
    "timestamp_ns",
    "recipe_hash",
    "weather_time_s",
    "timeline_values",
)
# Values of OSI's fields are these words and the class in capitals.
_OSI_PREFIXES = {
    "ambient_illumination": "AMBIENT_ILLUMINATION_",
    "precipitation": "PRECIPITATION_",
    "fog": "FOG_",
}
# Classes of visibility have one more word in OSI.
_OSI_VISIBILITIES = ("poor", "moderate", "good", "excellent")


@dataclass(frozen=True)
class TaggedWeather:
    """The weather of a variant of a scene, or of one of its frames."""

    scene: str
    """Name of the scene."""
    variant: str
    """Name of the variant."""
    frame: int | None
    """Frame number where the weather changes over time; None for all frames."""
    tags: Tags
    """The tags."""

    @property
    def name(self) -> str:
        """Return the name of the weather in files: scene, variant, and the frame if it has one."""
        frame_part = "" if self.frame is None else f"/{self.frame:06d}"
        return f"{self.scene}/{self.variant}{frame_part}"


# ---- From an output to tags ----------------------------------------------------------------------


def read_tags(out: Path) -> list[TaggedWeather]:
    """Return the tags of every variant in an output folder, sorted by scene, variant and frame.

    They follow from the variants' recipe.yaml, so outputs of any version have them.

    Args:
        out: the output folder.

    Raises:
        OutputError: no output folder, or a recipe.yaml is not that of the variant's images.
    """
    table = read_manifest(out)
    columns = (*_IMAGE_COLUMNS, *NUMBER_COLUMNS, *CLASS_COLUMNS)
    variant_rows: dict[tuple[str, str], list[dict[str, Any]]] = {}
    scene_rows: dict[str, list[dict[str, Any]]] = {}
    for row in table.select(columns).to_pylist():
        variant_rows.setdefault((row["scene"], row["variant"]), []).append(row)
        scene_rows.setdefault(row["scene"], []).append(row)
    weathers = []
    for (scene, variant), rows in sorted(variant_rows.items()):
        path = Path(out) / variant_folder(scene, variant) / RECIPE_FILE
        recipe = load_recipe(path).resolve(0)
        if recipe.hash != rows[0]["recipe_hash"]:
            raise OutputError(
                f"{path} must be the recipe of the images beside it, of hash "
                f"{rows[0]['recipe_hash']} in the manifest; got {recipe.hash}. It was edited: "
                f"render the variant again, or put its recipe back"
            )
        if not recipe.changes_over_time:
            weathers.append(TaggedWeather(scene, variant, None, tags_of(recipe)))
            continue
        times = _times_of_rows(scene_rows[scene])
        row_of_frame = {row["frame"]: row for row in reversed(rows)}
        weathers += [
            TaggedWeather(scene, variant, frame, _tags_of_row(recipe, row, times))
            for frame, row in sorted(row_of_frame.items())
        ]
    return weathers


def _times_of_rows(rows: Sequence[Mapping[str, Any]]) -> SceneTimes:
    """Return the times of a drive by its images in an output."""
    stamps = [row["timestamp_ns"] for row in rows]
    return SceneTimes(min(stamps), max(stamps), len({row["frame"] for row in rows}))


def _tags_of_row(recipe: Recipe, row: Mapping[str, Any], times: SceneTimes) -> Tags:
    """Return the tags of a recipe that changes over time, at the time of an image.

    Timelines and tags of the row hold where the output has only a part of the drive.

    Args:
        recipe: the recipe.
        row: the image's row of the manifest, which has the values of all timelines.
        times: times of the drive.
    """
    time_s = row["weather_time_s"] or 0.0
    try:
        state = recipe.at_weather_time(times, time_s)
    except RecipeError:  # a timeline goes beyond the images that are here
        state = recipe.at_weather_time(ANY_DRIVE, time_s)
    for path, value in json.loads(row["timeline_values"] or "{}").items():
        state = with_unchecked_field(state, path, value)
    names = [name for name in (*NUMBER_COLUMNS, *CLASS_COLUMNS) if row[name] is not None]
    return replace(tags_of(state), **{name: row[name] for name in names})


# ---- Formats -------------------------------------------------------------------------------------


def csv_text(weathers: Sequence[TaggedWeather]) -> str:
    """Return a table with a row for each weather and a column for each tag, in SI units."""
    names = [field.name for field in fields(Tags) if field.name != "openlabel"]
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["scene", "variant", "frame", *names])
    for weather in weathers:
        values = [getattr(weather.tags, name) for name in names]
        cells = [f"{value:.9g}" if isinstance(value, float) else value for value in values]
        writer.writerow([weather.scene, weather.variant, weather.frame, *cells])
    return text.getvalue()


def osi_conditions(tags: Tags) -> dict[str, str]:
    """Return the fields of OSI's message EnvironmentalConditions, as of protobuf's JSON."""
    fog = f"{tags.osi_fog}_visibility" if tags.osi_fog in _OSI_VISIBILITIES else tags.osi_fog
    classes = {
        "ambient_illumination": tags.osi_illumination,
        "precipitation": tags.osi_precipitation,
        "fog": fog,
    }
    return {name: _OSI_PREFIXES[name] + value.upper() for name, value in classes.items()}


def osi_text(weathers: Sequence[TaggedWeather]) -> str:
    """Return a JSON object with OSI's message EnvironmentalConditions for each weather by name."""
    return _json_text({weather.name: osi_conditions(weather.tags) for weather in weathers})


def openlabel_document(weather: TaggedWeather) -> dict[str, Any]:
    """Return an OpenLABEL document that tags one weather."""
    tags = {}
    for number, tag in enumerate(weather.tags.openlabel):
        entry: dict[str, Any] = {"ontology_uid": "0", "type": tag.name}
        if tag.value is not None:
            value = float(f"{tag.value:.9g}")
            entry["tag_data"] = {"num": [{"name": tag.name, "type": "value", "val": value}]}
        tags[str(number)] = entry
    return {
        "openlabel": {
            "metadata": {"schema_version": OPENLABEL_VERSION, "tagged_file": weather.name},
            "ontologies": {"0": OPENLABEL_ONTOLOGY},
            "tags": tags,
        }
    }


def openlabel_text(weathers: Sequence[TaggedWeather]) -> str:
    """Return a JSON object with an OpenLABEL document for each weather by name."""
    return _json_text({weather.name: openlabel_document(weather) for weather in weathers})


def openscenario_text(weathers: Sequence[TaggedWeather], date: datetime | None = None) -> str:
    """Return a catalog of OpenSCENARIO XML 1.2 with an Environment for each weather.

    Args:
        weathers: the weathers.
        date: date of the file; now by default.
    """
    root = ET.Element("OpenSCENARIO")
    date_text = (date or datetime.now(UTC)).strftime("%Y-%m-%dT%H:%M:%S")
    header = {"revMajor": "1", "revMinor": "2", "date": date_text, "author": "ClimateGS"}
    ET.SubElement(root, "FileHeader", header | {"description": "Weather of rendered images"})
    catalog = ET.SubElement(root, "Catalog", {"name": "weather"})
    for weather in weathers:
        _add_environment(catalog, weather)
    ET.indent(root)
    return f'<?xml version="1.0" encoding="UTF-8"?>\n{ET.tostring(root, encoding="unicode")}\n'


def _add_environment(catalog: ET.Element, weather: TaggedWeather) -> None:
    """Add an Environment to a catalog. What no recipe says, such as the sun's place, is left out.

    Properties of the road condition hold the numbers and classes that OpenSCENARIO has no field
    for.
    """
    tags = weather.tags
    environment = ET.SubElement(catalog, "Environment", {"name": weather.name})
    conditions = ET.SubElement(environment, "Weather")
    if tags.mor_m is not None:
        ET.SubElement(conditions, "Fog", {"visualRange": f"{tags.mor_m:.9g}"})
    precipitation = {
        "precipitationIntensity": f"{tags.rain_mm_h + tags.snowfall_mm_h:.9g}",
        "precipitationType": tags.openscenario_precipitation,
    }
    ET.SubElement(conditions, "Precipitation", precipitation)
    if tags.wind_mps is not None and tags.wind_from_deg is not None:
        direction_rad = math.radians(tags.wind_from_deg % 360)
        wind = {"direction": f"{direction_rad:.9g}", "speed": f"{tags.wind_mps:.9g}"}
        ET.SubElement(conditions, "Wind", wind)
    road = {"frictionScaleFactor": f"{tags.friction_scale:g}", "wetness": tags.openscenario_wetness}
    condition = ET.SubElement(environment, "RoadCondition", road)
    properties = ET.SubElement(condition, "Properties")
    for name in (
        "visibility_m",
        "extinction_per_m",
        "illuminance_lx",
        "snow_depth_m",
        "flood_level_m",
        "osi_fog",
        "osi_precipitation",
        "osi_illumination",
        "wmo_weather",
    ):
        value = getattr(tags, name)
        if value is not None:
            text = f"{value:.9g}" if isinstance(value, float) else str(value)
            ET.SubElement(properties, "Property", {"name": name, "value": text})


def _json_text(value: Any) -> str:
    return json.dumps(value, indent=2, ensure_ascii=False) + "\n"


# Texts of tags by the name of their format.
FORMATS: dict[str, Callable[[Sequence[TaggedWeather]], str]] = {
    "csv": csv_text,
    "osi": osi_text,
    "openscenario": openscenario_text,
    "openlabel": openlabel_text,
}


# ---- The command ---------------------------------------------------------------------------------


def write_tags(out: Path, format_name: str, file: Path | None = None) -> str:
    """Return the tags of an output as text, and write them to a file if one is named.

    Args:
        out: the output folder.
        format_name: key of FORMATS.
        file: the file to write.
    """
    text = FORMATS[format_name](read_tags(out))
    if file is not None:
        write_atomic(file, text.encode())
    return text
