"""Pictures of an output folder: what they are called, and in which order they come."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from augment.jobs.layout import MANIFEST
from augment.jobs.manifest import later_columns, rows_to_table, write_manifest
from tests.tools.report_outputs import make_row
from tools import drawing as sheet

DRY, THIN, DEEP = ("clear-000", 0.0, math.nan), ("wet-000", 0.0, -0.05), ("wet-001", 0.0, 0.5)
MURKY, WHITE = ("fog-000", 0.0978, 0.3), ("white-000", 0.0, math.nan, 0.125)


def row_of(
    variant: str, extinction_per_m: float, level_m: float, snow_m: float = math.nan
) -> dict[str, Any]:
    weather = {"smog_extinction_per_m": extinction_per_m, "flood_level_m": level_m}
    paths = {"image_path": f"{variant}.png", "water_path": f"{variant}-water.png"}
    return make_row(frame=4, **weather, snow_depth_m=snow_m, **paths) | {"variant": variant}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    rows = [row_of(*variant) for variant in (MURKY, DEEP, WHITE, DRY, THIN)]
    for row in rows:
        cv2.imwrite(str(tmp_path / row["image_path"]), np.full((20, 40, 3), 200, np.uint8))
    write_manifest(tmp_path, rows_to_table(rows))
    return tmp_path


def titles(folder: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    drawn: list[str] = []

    def contact_sheet(rows):
        drawn.extend(title for title, _ in rows)
        return original(rows)

    original = sheet.contact_sheet
    monkeypatch.setattr(sheet, "contact_sheet", contact_sheet)
    assert sheet.draw_sheet(folder).is_file()
    return drawn


def test_a_row_says_its_weather_and_the_driest_comes_first(folder, monkeypatch) -> None:
    assert titles(folder, monkeypatch) == [
        "street, frame 4: clear-000 (no weather)",
        "street, frame 4: white-000 (snow 12.5 cm)",
        "street, frame 4: wet-000 (water at -0.05 m)",
        "street, frame 4: wet-001 (water at 0.50 m)",
        "street, frame 4: fog-000 (visibility 40 m, water at 0.30 m)",
    ]


def test_a_folder_older_than_floods_is_drawn(folder, monkeypatch) -> None:
    table = pq.read_table(folder / MANIFEST)
    pq.write_table(
        table.drop_columns([*later_columns(), "flood_level_m", "snow_depth_m"]), folder / MANIFEST
    )
    weather = [title.rpartition(" (")[2] for title in titles(folder, monkeypatch)]
    assert weather == [*["no weather)"] * 4, "visibility 40 m)"]


def test_a_row_says_its_style(folder, monkeypatch) -> None:
    table = pq.read_table(folder / MANIFEST)
    table = table.drop_columns(["style", "style_strength"])
    table = table.append_column("style", pa.array(["dusk"] * len(table)))
    table = table.append_column("style_strength", pa.array([0.75] * len(table)))
    pq.write_table(table, folder / MANIFEST)
    assert titles(folder, monkeypatch)[0] == "street, frame 4: clear-000 (dusk x 0.75)"


def test_a_picture_of_many_variants_shows_some_from_end_to_end() -> None:
    few, many = (
        [row_of(f"{i:03d}", 0.0, math.nan) for i in range(n)] for n in (sheet.MAX_SHOWN, 100)
    )
    assert [name for _, name in sheet.shown_groups(few)] == [row["variant"] for row in few]
    names = [name for _, name in sheet.shown_groups(many)]
    assert len(names) <= sheet.MAX_SHOWN and names[0] == "000" and int(names[-1]) >= 90
