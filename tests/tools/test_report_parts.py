"""What a report counts, draws and chooses, piece by piece."""

from __future__ import annotations

import math

import numpy as np
import pyarrow as pa
import pytest

from augment.jobs.files import box_tables, visibility
from augment.jobs.manifest import rows_to_table
from augment.jobs.store import LocalStore, StoredFile
from tests.tools.report_outputs import make_row, street_rows, write_output
from tools import report, report_numbers, report_pictures
from tools.drawing import evenly, linear_ticks, log_ticks
from tools.report_numbers import (
    Spread,
    byte_size,
    chart,
    count,
    find_draws,
    percent,
    quantity_of,
    short,
    spreads,
    weather_text,
)
from tools.report_pictures import BUDGET, MAX_IMAGES, ReportFiles, Shares


def as_table(rows) -> pa.Table:
    return report.add_variant_key(rows_to_table(rows))


def files_of(folder) -> ReportFiles:
    store = LocalStore(folder)
    return ReportFiles(store, store.list(""))


def test_numbers_are_written_for_people() -> None:
    numbers = {
        0: "0", 0.0123456: "0.0123", -0.018174: "−0.0182", 1.0: "1", 99.96: "100",
        1234.5: "1,234", 2.5e9: "2.50e+09", math.nan: "nan", 0.00001: "1.00e−05",
    }  # fmt: skip
    assert [short(number) for number in numbers] == list(numbers.values())
    assert [count(1, "box"), count(1200, "box"), count(2, "class")] == [
        "1 box", "1,200 boxes", "2 classes",
    ]  # fmt: skip
    assert [byte_size(n) for n in (999, 1000, 999_600, 3_210_000_000)] == [
        "999 B", "1 kB", "1 MB", "3.21 GB",
    ]  # fmt: skip
    assert [percent(*p) for p in ((0, 0), (1, 1000), (999, 1000), (1, 3))] == [
        "–", "< 1 %", "> 99 %", "33 %",
    ]  # fmt: skip


def test_a_histogram_counts_every_image_once() -> None:
    rng = np.random.default_rng(0)
    values, images = rng.lognormal(0, 2, 200), rng.integers(1, 9, 200)
    edges, counts, log = report_numbers.histogram(values, images)
    assert log and counts.sum() == images.sum()
    assert (np.diff(edges) > 0).all() and len(counts) <= report_numbers.MAX_BINS
    assert not report_numbers.histogram(values, images, linear=True)[2]


@pytest.mark.parametrize(
    "values", [[-1e99, 1e99], [1e-99, 1e99], [0.0, 1e-250], [1.0, 1.0000001], [-3.0, 0.0, 7.0]]
)
def test_any_range_can_be_drawn(values) -> None:
    spread = Spread(quantity_of("x_m"), np.array(values), np.ones(len(values), int), 0)
    drawn = chart(spread)
    assert sum(images for *_, images in drawn["bars"]) == len(values)
    places = [*drawn["bars"], *drawn["labels"], drawn["marks"]]
    assert "nan" not in str(places) and "inf" not in str(places)


def test_axes_have_a_few_round_numbers() -> None:
    for low, high in ((0.81, 1), (-0.02, 0.31), (12.3, 26.1)):
        found = linear_ticks(low, high)
        steps = np.diff(found)
        assert 2 <= len(found) <= 8 and low <= min(found) and max(found) <= high
        assert steps == pytest.approx(steps[0]) and f"{steps[0]:.0e}"[0] in "125"
    assert log_ticks(30, 2000, most=5) == [100, 1000]
    assert log_ticks(30, 300, most=5) == [50, 100, 200]


def test_spreads_leave_out_what_is_absent() -> None:
    rows = [make_row(frame=i) for i in range(2)]
    rows += [make_row(recipe="fog", frame=i, smog_extinction_per_m=0.03912) for i in range(3)]
    rows += [make_row(recipe="odd", smog_extinction_per_m=math.inf, flood_level_m=0.0)]
    table = as_table(rows)
    found = {s.quantity.name: s for s in spreads(find_draws(table))}
    assert list(found) == ["smog_extinction_per_m", "flood_level_m"]
    smog = found["smog_extinction_per_m"]
    assert smog.values == pytest.approx([100]) and smog.images.tolist() == [3]
    assert smog.absent_images == 3
    assert found["flood_level_m"].values.tolist() == [0.0]  # a level, not an absence


def test_what_counts_as_without_weather() -> None:
    for changes, clear in (
        ({}, True),
        ({"snow_depth_m": 0.0, "snow_coverage": 1.0}, True),
        ({"snow_depth_m": 0.2, "snow_coverage": 0.0}, True),
        ({"snow_depth_m": 0.2, "snow_coverage": 0.5}, False),
        ({"flood_level_m": 0.0}, False),
        ({"smog_extinction_per_m": 1e-4}, False),
        ({"style": "dusk", "style_strength": 0.0}, True),
        ({"rain_mm_per_h": 0.0}, True),
        ({"rain_mm_per_h": 2.0}, False),
    ):
        assert find_draws(as_table([make_row(**changes)]))["is_clear"].to_pylist() == [clear], (
            changes
        )


def test_a_row_says_its_weather() -> None:
    row = make_row(smog_extinction_per_m=0.03912, snow_depth_m=0.125, style="dusk")
    assert weather_text(row) == "style dusk, visibility 100 m, snow 12.5 cm"
    assert weather_text(make_row()) == "no weather"
    rain = quantity_of("rain_mm_per_h")
    assert (rain.title, rain.unit) == ("Rain", "mm/h")


def test_groups_count_images_variants_frames_and_cameras() -> None:
    table = as_table([*street_rows(), make_row("street-1", "fog", 5, 9, "left", status="failed")])
    fog = next(g for g in report.group_by(table, "recipe") if g["name"] == "fog")
    counts = {"finished": 24, "failed": 1, "scenes": 2, "variants": 7, "frames": 5, "cameras": 2}
    assert fog == {"name": "fog", "source": "procedural:street-0", **counts}
    (whole,) = report.group_by(table)
    assert (whole["finished"] + whole["failed"], whole["scenes"], whole["variants"]) == (41, 2, 11)
    assert report.group_by(table.slice(0, 0))[0]["finished"] == 0
    nameless = report.group_by(as_table([make_row(), make_row(recipe="")]), "recipe")
    assert [group["name"] for group in nameless] == ["", "clear"]


def test_files_are_counted_by_kind() -> None:
    listing = {
        "s/v/images/front/1.png": 30, "s/v/depth/front/1.png": 20, "s/v/calibration.json": 1,
        "s/v/calibration/000000.json": 2, "s/v/recipe.yaml": 3, "manifest.parquet": 7,
        ".climategs/parts/a.parquet": 9, "report.html": 100, "images.txt": 4,
    }  # fmt: skip
    stored = {path: StoredFile(size, 0.0) for path, size in listing.items()}
    kinds = report.files_by_kind(stored, ["report.html"])
    found = {kind["kind"]: (kind["files"], kind["bytes"]) for kind in kinds}
    assert found == {
        "images": (1, 30), "depth": (1, 20), "calibration": (2, 3), "other": (2, 7),
        "manifest": (1, 7), report.STATE: (1, 9),
    }  # fmt: skip


def test_pictures_stay_within_their_bytes() -> None:
    noise = np.random.default_rng(0).integers(0, 255, (300, 500, 3), np.uint8)
    for most in (60_000, 9_000, 1_500):
        picture = report_pictures.embed(noise, 400, most)
        assert len(picture.uri) * 3 / 4 - 40 <= most and picture.width <= 400
    flat = report_pictures.embed(noise[:, :50], 400, 60_000)
    assert (flat.width, flat.height) == (50, 300)
    tall = report_pictures.embed(np.zeros((4000, 20, 3), np.uint8), 16, 9_000)
    assert tall.height <= 24


def test_any_number_of_pictures_fits_the_budget() -> None:
    for images in range(MAX_IMAGES + 1):
        shares = Shares.of(images)
        large, buffers = shares.places * shares.variants, 4 * shares.samples
        assert large + buffers + shares.thumbnails == images
        assert large != 1 and shares.thumbnails >= 0
        total = large * shares.large_bytes + buffers * shares.buffer_bytes
        assert total + shares.thumbnails * shares.small_bytes <= BUDGET
    assert Shares.of(MAX_IMAGES).small_bytes > 2000


def test_depth_goes_from_near_to_far_and_none_is_grey() -> None:
    rgb, note = report_pictures.color_depth(np.array([[0, 1, 10, 100]], np.float32))
    assert rgb[0, 0].tolist() == [128, 128, 128] and note == "1.2 m to 98 m"
    assert rgb[0, 1, 0] > rgb[0, 1, 2] and rgb[0, 3, 2] > rgb[0, 3, 1]  # red near, blue far
    assert report_pictures.color_depth(np.zeros((2, 2), np.float32))[1] == "nowhere"
    assert report_pictures.color_depth(np.full((2, 2), 7, np.float32))[0].shape == (2, 2, 3)


def test_picked_images_differ_and_are_spread() -> None:
    table = as_table(street_rows(scenes=3, frames=4))
    rows = np.arange(table.num_rows)
    picked = report_pictures.pick_images(table, rows, 10)
    keys = {(r["scene"], r["variant"], r["frame"], r["camera"]) for r in picked}
    assert len(keys) == 10 and str(picked) == str(report_pictures.pick_images(table, rows, 10))
    assert len({k[0] for k in keys}) == 3 and len({k[3] for k in keys}) == 2
    assert len(report_pictures.pick_images(table, rows, 10_000)) == table.num_rows
    few = report_pictures.pick_images(table, rows[table.num_rows - 3 :], 9)
    assert {(r["scene"], r["variant"]) for r in few} == {("street-2", "wet-000")} and len(few) == 3
    assert evenly(list(range(10)), 3) == [1, 5, 8]


def test_places_pair_clear_with_each_recipe() -> None:
    rows = street_rows(scenes=3)
    rows = [r for r in rows if (r["scene"], r["recipe"]) != ("street-1", "clear")]
    table = as_table(rows)
    clear = {row["draw"] for row in table.to_pylist() if row["recipe"] == "clear"}
    places = report_pictures.pick_places(table, clear, 4, 6)
    assert [rows[0]["scene"] for rows in places] == ["street-0", "street-2"]
    assert [row["recipe"] for row in places[0]] == ["clear", "fog", "wet"]
    assert {row["camera"] for rows in places for row in rows} == {"front"}


def test_visibility_is_that_of_the_labels(tmp_path) -> None:
    rows = [row for row in street_rows(scenes=1, frames=1) if row["recipe"] == "wet"][:1]
    rows[0]["smog_extinction_per_m"] = 0.01
    write_output(tmp_path, rows)
    shares = report.share_visible(as_table(rows), ["wet"], files_of(tmp_path))
    paths = {kind: rows[0][f"{kind}_path"] for kind in box_tables() if kind != "box_2d"}
    weather = {k: box_tables()[k].read(tmp_path / path)[0, "front"] for k, path in paths.items()}
    expected = visibility(weather, 3)[:2]  # no pixel shows the third box
    assert expected.tolist() == pytest.approx([0.9 * 0.5 * 0.5, 0.0])
    assert shares is not None
    assert shares["rows"] == [("wet", [("s0", "0–5 %", 1), ("s2", "20–50 %", 1)])]
    assert shares["sample"] == ""  # all of them


def test_an_image_too_large_to_decode_is_left_alone(tmp_path) -> None:
    header = b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR" + (60_000).to_bytes(4, "big") * 2 + b"\x08\2\0\0\0"
    (tmp_path / "a.png").write_bytes(header + b"\0" * 40)
    files = files_of(tmp_path)
    assert files.read_picture(make_row(image_path="a.png")) is None
    assert files.problems == {"a.png": "60000x60000 pixels: not looked at"}
