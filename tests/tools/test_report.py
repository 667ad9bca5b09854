"""Pages, sheets and videos of an output: what they show, and what does not stop them."""

from __future__ import annotations

import base64
import hashlib
import json
import math
import subprocess
import sys
import tomllib
from collections import Counter
from html.parser import HTMLParser
from pathlib import Path

import cv2
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from augment.errors import OutputError
from augment.output.box_weather import box_tables, combine_visibility
from augment.output.manifest import publish_part, rows_to_table, write_manifest
from augment.output.names import MANIFEST_FILE
from augment.output.store import LocalStore
from tests.tools.report_outputs import make_row, street_rows, write_output
from tools import report
from tools.chosen_images import MAX_SHOWN, cameras_on_car, shown_variants
from tools.cli import main
from tools.pictures import write_video
from tools.report import write_report
from tools.report_numbers import find_draws, spreads
from tools.report_pictures import BUDGET, MAX_IMAGES, ReportFiles, Shares
from tools.sheet import VIDEO_WIDTH, draw_sheet, draw_video, sheet_lines, side_by_side

EVIL = "\"><script>alert(1)</script><img src=x onerror='alert(2)'>\u202e"


class Page(HTMLParser):
    """What a browser would make of the page: tags, attributes, and the text a reader sees."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: Counter[str] = Counter()
        self.attributes: list[tuple[str, str, str | None]] = []
        self.words: list[str] = []
        self.scripts: list[str] = []
        self._inside = ""
        self.feed(text)
        self.text = " ".join(" ".join(self.words).split())

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags[tag] += 1
        self.attributes += [(tag, name, value) for name, value in attrs]
        self._inside = tag

    def handle_endtag(self, tag: str) -> None:
        self._inside = ""

    def handle_data(self, data: str) -> None:
        if self._inside == "script":
            self.scripts.append(data)
        elif self._inside != "style":
            self.words.append(data)

    def values(self, tag: str, attribute: str) -> list[str]:
        return [v or "" for t, a, v in self.attributes if (t, a) == (tag, attribute)]


def page_of(out: Path, images: int = 48) -> Page:
    return Page(write_report(out, images=images).path.read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def street(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("street")
    failed = make_row("street-0", "fog", 0, 7, "left", status="failed", message="no memory: 12 MB")
    again = failed | {"frame": 8, "message": "no memory: 9 MB"}
    return write_output(out, [*street_rows(), failed, again], lidar=True)


@pytest.fixture(scope="module")
def page(street: Path) -> Page:
    return page_of(street)


def test_the_page_says_what_there_is(page) -> None:
    for words in ("40 images", "2 failed", "2 scenes", "3 recipes", "10 variants", "2 cameras"):
        assert words in page.text
    assert "1.2.3" in page.text and "40×24" in page.text
    assert "Visibility in smog 21.7 to 196 m" in page.text
    assert "3.912 / smog_extinction_per_m" in page.text
    assert "24 images, 6 variants; absent in 16" in page.text
    assert "Snow depth 25 cm in 8 images, 2 variants; absent in 32" in page.text


def test_pictures_of_all_kinds_are_in_it(page) -> None:
    assert page.tags["input"] == 2  # a slider for each scene
    options = page.values("option", "data-name")
    assert options[:3] == ["clear-000", "fog-000", "wet-000"] and len(options) == 2 * 2 * 3
    captions = page.values("img", "alt")
    assert captions.count("Depth") == captions.count("Semantic classes") == 3
    assert any(said.startswith("wet-000, street-") for said in captions)
    assert len(captions) <= 48


def test_labels_and_lidar_are_counted(page) -> None:
    # Every variant's file holds one frame only: the last to be written.
    assert "Car 4 4" in page.text and "Bus 2 2" in page.text
    bars = {said for tag, name, said in page.attributes if (tag, name) == ("span", "aria-label")}
    assert bars == {
        "5–20 % 50 %, 80–95 % 50 %",  # fog: 0.9 and 0.1; the third box is in no pixel
        "0–5 % 50 %, 20–50 % 50 %",  # wet: half under water and half of it under snow; all snow
        "unchanged 40 %, weaker 20 %, scattered in the air or at the water 20 %, code 9 20 %",
    }
    failures = "2 no memory: 12 MB such as street-0 · fog-000 · frame 7 · left"
    assert failures in page.text  # grouped by what went wrong


def test_labels_for_trainers_are_on_the_page(tmp_path) -> None:
    out = write_output(tmp_path, street_rows(scenes=1, frames=1))
    record = {
        "asked": {"split": {"train": 1.0}, "seed": 0, "changes": []},
        "categories": ["Car", EVIL], "images": {"coco": 6, "yolo": 6},
        "objects": {"coco": 12, "yolo": 9}, "hidden": {"coco": 3, "yolo": 3},
        "unmapped": {"Tree": 4},
    }  # fmt: skip
    (out / "labels").mkdir()
    (out / "labels/labels.json").write_text(json.dumps(record))
    page = page_of(out)
    assert "labels/coco 6 12 3 labels/yolo 6 9 3 Categories: Car, " in page.text
    assert "Of no category, and left out: Tree (4 boxes)." in page.text
    assert len(page.scripts) == 1 and not page.values("img", "onerror")
    (out / "labels/labels.json").write_text(json.dumps(record | {"images": "six"}))
    page = page_of(out)
    assert "For trainers" not in page.text and "labels/labels.json 1 validation error" in page.text


def test_nothing_is_fetched_and_links_stay_in_the_folder(page, street, tmp_path) -> None:
    sources = [v for _, name, v in page.attributes if name in ("src", "srcset", "data")]
    assert sources and all(v and v.startswith("data:image/jpeg;base64,") for v in sources)
    links = page.values("a", "href")
    assert all(link.startswith(("#", "./street-")) for link in links)
    assert all((street / link).is_file() for link in links if link.startswith("./"))
    elsewhere = write_report(street, tmp_path / "page.html").path.read_text(encoding="utf-8")
    assert all(link.startswith("#") for link in Page(elsewhere).values("a", "href"))
    assert str(street.parent) not in elsewhere
    (script,) = page.scripts  # only the page's own may run
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    (policy,) = [v for v in page.values("meta", "content") if "default-src" in v]
    assert f"script-src 'sha256-{digest}'" in policy and "default-src 'none'" in policy


def test_untrusted_names_are_text(tmp_path) -> None:
    rows = street_rows(scenes=1, frames=1)
    write_output(tmp_path, rows)
    wrong = {name: EVIL for name in ("scene", "source", "camera", "surface", "version", "backend")}
    rows = [row | wrong for row in rows]
    for i, row in enumerate(rows):
        row |= {"variant": f"{EVIL}{i}", "recipe": f"{EVIL}{i}", "style": EVIL}
        row |= {f"{EVIL}_m": 0.5 + i}
    rows[0] |= {"image_path": "javascript:alert(3)"}
    rows[1] |= {"status": "failed", "message": EVIL}
    write_output(tmp_path, rows)
    page = page_of(tmp_path)
    assert page.tags["script"] == 1
    assert not [name for _, name, _ in page.attributes if name.startswith("on")]
    assert not [v for v in page.values("a", "href") if not v.startswith(("#", "./"))]
    assert all(v.startswith("data:") for v in page.values("img", "src"))
    assert "<script>alert(1)</script>" in page.text and "\u202e" not in page.text


def test_damaged_files_are_listed_and_do_not_stop_it(tmp_path) -> None:
    rows = street_rows(scenes=1, frames=1)
    write_output(tmp_path, rows)
    missing, cut, changed, _, other = (row["image_path"] for row in rows[:5])
    (tmp_path / missing).unlink()
    (tmp_path / cut).write_bytes((tmp_path / cut).read_bytes()[:60])
    rows[1]["checksum"] = ""
    (tmp_path / changed).write_bytes((tmp_path / other).read_bytes())
    rows[2]["checksum"] = "0" * 64
    (tmp_path / rows[4]["labels_path"]).write_bytes(b"no Parquet")
    (tmp_path / rows[4]["depth_path"]).write_bytes(b"no PNG")
    write_output(tmp_path, rows)
    written = write_report(tmp_path)
    page = Page(written.path.read_text(encoding="utf-8"))
    assert f"{missing} missing" in page.text
    assert f"{cut} " in page.text
    assert f"{changed} its SHA-256 is not the manifest's" in page.text
    assert written.problems >= 3
    assert str(tmp_path.parent) not in page.text
    assert page.tags["img"] > 4


def test_without_a_clear_variant_pairs_are_shown(tmp_path) -> None:
    rows = [row for row in street_rows(scenes=1, frames=1) if row["recipe"] == "fog"]
    write_output(tmp_path, rows)
    page = page_of(tmp_path)
    assert "no variant without weather" in page.text
    assert page.values("option", "data-name")[:3] == ["fog-000", "fog-001", "fog-002"]


def test_outputs_of_every_state_have_a_page(street, tmp_path) -> None:
    (street / "report.html").unlink(missing_ok=True)
    first = write_report(street, images=2).path.read_bytes()
    assert write_report(street, images=2).path.read_bytes() == first  # itself it does not count
    assert Page(first.decode()).tags["img"] <= 2
    failed = [make_row(frame=i, status="failed", message="x") for i in range(3)]
    page = page_of(write_output(tmp_path / "failed", failed))
    assert "3 failed" in page.text and "0 images" in page.text and page.tags["img"] == 0
    old, rows = tmp_path / "old", street_rows(scenes=1, frames=1)
    write_output(old, rows, buffers=False)
    table = pq.read_table(old / MANIFEST_FILE)
    young = ["box_smog_path", "snow_path", "style", "snow_depth_m", "style_strength", "surface"]
    pq.write_table(table.drop_columns(young), old / MANIFEST_FILE)
    page = page_of(old)
    assert "10 images" in page.text and "Labels" not in page.text
    (old / MANIFEST_FILE).unlink()  # a running job's
    publish_part(LocalStore(old), "block", rows_to_table(rows[:6]))
    assert "6 images" in page_of(old).text


def test_of_a_store_elsewhere_the_page_is_written_here(street, tmp_path, monkeypatch) -> None:
    class Elsewhere(LocalStore):
        uri = "s3://bucket/night%20drive?region=x"
        local_dir = None

    monkeypatch.setattr(report, "open_store", lambda _: Elsewhere(street))
    monkeypatch.chdir(tmp_path)
    written = write_report("s3://bucket/night%20drive?region=x")
    assert written.path.name.startswith("night_drive-") and written.path.is_file()
    page = Page(written.path.read_text(encoding="utf-8"))
    assert "night drive" in page.text and page.tags["img"] > 20
    assert all(link.startswith("#") for link in page.values("a", "href"))


def test_an_output_of_any_size_has_a_small_page(tmp_path) -> None:
    def name(i: int) -> str:
        return f"{i:04d}" + '"' * 400

    rows = [
        make_row(name(i), name(i), camera=name(i), status="failed", message=chr(65 + i % 50) * 999)
        for i in range(200)
    ]
    rows += [
        make_row(name(i), name(i), frame=1, camera=name(i), snow_depth_m=0.1 * i)
        for i in range(100)
    ]
    for i, row in enumerate(rows):
        row |= {f"n{k}": float(k * i) for k in range(30)}
    written = write_report(
        write_output(tmp_path, [r | {"image_path": "missing.png"} for r in rows])
    )
    assert written.size + BUDGET * 4 / 3 < report.MAX_PAGE
    page = Page(written.path.read_text(encoding="utf-8"))
    assert "and 160 more scenes with 60 images, 160 failed" in page.text
    assert page.tags["tr"] < 150 and page.tags["svg"] == 24


def test_the_command_says_what_it_wrote(street, tmp_path, capsys) -> None:
    assert main(["report", str(street), "--html", str(tmp_path / "a.html"), "--images", "3"]) == 0
    assert f"{tmp_path / 'a.html'} (0." in capsys.readouterr().out
    assert main(["report", str(street), "--images", "401"]) == 2
    assert main(["report", str(tmp_path / "nowhere")]) == 2
    with pytest.raises(OutputError, match="0 to 400 images; got -1"):
        write_report(street, images=-1)


def test_templates_are_installed() -> None:
    root = Path(report.__file__).parent
    patterns = tomllib.loads((root.parent / "pyproject.toml").read_text())["tool"]["setuptools"]
    found = {path for glob in patterns["package-data"]["tools"] for path in root.glob(glob)}
    assert found == {*(root / "templates").iterdir()}


# ---- What a page counts and chooses --------------------------------------------------------------


def as_table(rows) -> pa.Table:
    return report.add_variant_key(rows_to_table(rows))


def files_of(folder) -> ReportFiles:
    store = LocalStore(folder)
    return ReportFiles(store, store.list(""))


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
        ({"hail_mm_per_h": 0.0}, True),
        ({"hail_mm_per_h": 2.0}, False),
    ):
        assert find_draws(as_table([make_row(**changes)]))["is_clear"].to_pylist() == [clear], (
            changes
        )


def test_any_number_of_pictures_fits_the_budget() -> None:
    for images in range(MAX_IMAGES + 1):
        shares = Shares.of(images)
        large, buffers = shares.places * shares.variants, 4 * shares.samples
        assert large + buffers + shares.thumbnails == images
        assert large != 1 and shares.thumbnails >= 0
        total = large * shares.large_bytes + buffers * shares.buffer_bytes
        assert total + shares.thumbnails * shares.small_bytes <= BUDGET
    assert Shares.of(MAX_IMAGES).small_bytes > 2000


def test_visibility_is_that_of_the_labels(tmp_path) -> None:
    rows = [row for row in street_rows(scenes=1, frames=1) if row["recipe"] == "wet"][:1]
    rows[0]["smog_extinction_per_m"] = 0.01
    write_output(tmp_path, rows)
    shares = report.share_visible(as_table(rows), ["wet"], files_of(tmp_path))
    paths = {kind: rows[0][f"{kind}_path"] for kind in box_tables() if kind != "box_2d"}
    there = {kind: tmp_path / path for kind, path in paths.items() if path}
    weather = {kind: box_tables()[kind].read(path)[0, "front"] for kind, path in there.items()}
    expected = combine_visibility(weather, 3)[:2]  # no pixel shows the third box
    assert expected.tolist() == pytest.approx([0.9 * 0.5 * 0.5, 0.0])
    assert shares is not None
    assert shares["rows"] == [("wet", [("s0", "0–5 %", 1), ("s2", "20–50 %", 1)])]
    assert shares["sample"] == ""  # all of them


def test_contrast_of_boxes_is_counted_by_recipe(tmp_path) -> None:
    light = box_tables()["box_light"]
    rows = [row for row in street_rows(scenes=1, frames=1) if row["recipe"] == "wet"][:1]
    path = "street/wet-000/labels/light.parquet"
    rows[0]["box_light_path"] = path
    contrasts = [-0.5, 0.0, 0.19, 30.0, np.nan]
    stored = {
        name: np.zeros(5, kind) if kind is not object else np.full(5, "", object)
        for name, kind in light.columns.items()
        if name in light.stored_columns
    }
    stored["luminance_contrast"] = np.array(contrasts)
    numbers = light.make_numbers(("a", "b", "c", "d", "e"), **stored)
    (tmp_path / path).parent.mkdir(parents=True)
    (tmp_path / path).write_bytes(light.to_bytes({(0, "front"): numbers}))
    shares = report.share_contrast(as_table(rows), ["wet"], files_of(tmp_path))
    assert shares is not None
    bars = [("s0", "−1 to −0.2", 1), ("s1", "−0.2 to 0.2", 2), ("s5", "over 20", 1)]
    assert shares["rows"] == [("wet", bars)]
    rows[0]["box_light_path"] = None
    assert report.share_contrast(as_table(rows), ["wet"], files_of(tmp_path)) is None


def test_an_image_too_large_to_decode_is_left_alone(tmp_path) -> None:
    header = b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR" + (60_000).to_bytes(4, "big") * 2 + b"\x08\2\0\0\0"
    (tmp_path / "a.png").write_bytes(header + b"\0" * 40)
    files = files_of(tmp_path)
    assert files.read_picture(make_row(image_path="a.png")) is None
    assert files.problems == {"a.png": "60000x60000 pixels: not looked at"}


# ---- Sheets and videos ---------------------------------------------------------------------------

WEATHER = {
    "fog": {"smog_extinction_per_m": 0.0978, "flood_level_m": 0.3},
    "deep": {"flood_level_m": 0.5},
    "white": {"snow_depth_m": 0.125},
    "clear": {},
    "wet": {"flood_level_m": -0.05},
}
# Their axes, degrees to the left of straight ahead.
RIG = {"front": 0, "front_left": 55, "side": 90, "rear_left": 130, "front_right": -55, "back": -178}


def row_of(recipe: str, frame: int = 4, camera: str = "front", **changes: object) -> dict:
    name = f"{recipe}-{camera}-{frame}.png"
    return make_row("street", recipe, 0, frame, camera, image_path=name, **changes)


def write_rows(out: Path, rows: list[dict]) -> Path:
    for row in rows:
        cv2.imwrite(str(out / row["image_path"]), np.full((20, 40, 3), 200, np.uint8))
    write_manifest(out, rows_to_table(rows))
    return out


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write_rows(tmp_path, [row_of(name, **numbers) for name, numbers in WEATHER.items()])


def titles(folder: Path, **chosen: str) -> list[str]:
    return [title for title, _ in sheet_lines(folder, **chosen)]


def test_a_line_says_its_weather_and_the_driest_comes_first(folder) -> None:
    assert titles(folder) == [
        "street, frame 4: clear-000 (no weather)",
        "street, frame 4: white-000 (snow 12.5 cm)",
        "street, frame 4: wet-000 (water at -0.05 m)",
        "street, frame 4: deep-000 (water at 0.50 m)",
        "street, frame 4: fog-000 (visibility 40 m, water at 0.30 m)",
    ]


def test_a_picture_of_many_variants_shows_some_from_end_to_end() -> None:
    def names(count: int) -> list[str]:
        table = rows_to_table([row_of(f"{i:03d}") for i in range(count)])
        return [row["recipe"] for row in shown_variants(table)]

    assert names(MAX_SHOWN) == [f"{i:03d}" for i in range(MAX_SHOWN)]
    many = names(100)
    assert len(many) <= MAX_SHOWN and many[0] == "000" and int(many[-1]) >= 90


def test_a_sheet_shows_the_chosen_recipes_cameras_and_frames(tmp_path) -> None:
    rows = [row_of(r, n, c) for r in ("clear", "fog") for n in range(4) for c in ("a", "b", "c")]
    write_rows(tmp_path, rows)
    lines = sheet_lines(tmp_path, "fog", "c,a", "0,2:4")
    assert [title[:24] for title, _ in lines] == [f"street, frame {n}: fog-000" for n in (0, 2, 3)]
    assert all([name for name, _ in images] == ["a", "c"] for _, images in lines)
    assert [t.partition(":")[0] for t in titles(tmp_path)] == ["street, frame 2"] * 2
    for chosen, there in (
        ({"recipe": "fog,rain"}, "recipe rain; it has clear, fog"),
        ({"camera": "d"}, "camera d; it has a, b, c"),
        ({"frame": "7"}, "frame 7; it has 0, 1, 2, 3"),
        ({"frame": "8:"}, "frame 8:; it has 0, 1, 2, 3"),
    ):
        with pytest.raises(OutputError, match=there):
            draw_sheet(tmp_path, **chosen)
    with pytest.raises(OutputError, match="camera d; it has a, b, c"):
        draw_video(tmp_path, "d")


def calibration(cameras: dict[str, tuple[float, float]]) -> str:
    """Of a car that drives towards north-east. cameras: bearing in degrees, metres to the left."""
    turned = np.deg2rad(45)
    ego = np.eye(4)
    ego[:2, :2] = [[np.cos(turned), -np.sin(turned)], [np.sin(turned), np.cos(turned)]]
    ego[:3, 3] = 1e6, -2e6, 30
    entries = {}
    for name, (bearing_deg, left_m) in cameras.items():
        a, pose = np.deg2rad(bearing_deg), np.eye(4)
        ahead = np.array([np.cos(a), np.sin(a), 0])
        pose[:3, :3] = np.stack([np.cross(ahead, [0, 0, 1]), [0, 0, -1], ahead], 1)
        pose[1, 3] = left_m
        entries[name] = {"world_from_camera": (ego @ pose).tolist()}
    return json.dumps(
        {"frames": [{"frame": 4, "world_from_ego": ego.tolist(), "cameras": entries}]}
    )


def test_cameras_stand_in_their_order_on_the_car(tmp_path) -> None:
    def order(cameras: dict[str, tuple[float, float]], text: str | None = None) -> list[str]:
        (tmp_path / "calibration.json").write_text(text or calibration(cameras))
        path = {"calibration_path": "calibration.json"}
        table = rows_to_table([row_of("clear", camera=name, **path) for name in cameras])
        return cameras_on_car(LocalStore(tmp_path), table)

    rig = {name: (float(bearing), 0.0) for name, bearing in RIG.items()}
    assert order(rig) == ["rear_left", "side", "front_left", "front", "front_right", "back"]
    for back in (180, 179, -170, 170):  # seen from either side, it is the back
        assert order(rig | {"back": (back, 0.0)})[-1] == "back"
    assert order({"a": (0.2, -0.3), "b": (-0.1, 0.3)}) == ["b", "a"]  # a stereo pair
    for text in ("{", "[]", '{"frames": [{"frame": 4}]}', calibration(rig).replace("1.0", "NaN")):
        assert order(rig, text) == sorted(RIG)
    assert order(rig, calibration({k: rig[k] for k in ("front", "side")}))[:3] == [
        "side", "front", "back",
    ]  # fmt: skip


def pictures(count: int = 5) -> list[np.ndarray]:
    ramp = np.linspace(0, 255, 96 * 64 * 3).reshape(64, 96, 3).astype(np.uint8)
    return [np.roll(ramp, 8 * i, 1) for i in range(count)]


def test_a_video_is_h264_that_browsers_play_and_the_same_bytes_again(tmp_path) -> None:
    ffmpeg = pytest.importorskip("imageio_ffmpeg")
    write_video(tmp_path / "a.mp4", pictures(), 12.5)
    write_video(tmp_path / "b.mp4", iter(pictures()), 12.5)
    data = (tmp_path / "a.mp4").read_bytes()
    assert data == (tmp_path / "b.mp4").read_bytes()
    assert data.index(b"moov") < data.index(b"mdat")  # plays before it is loaded
    command = [
        ffmpeg.get_ffmpeg_exe(),
        "-i",
        tmp_path / "a.mp4",
        *["-f", "rawvideo", "-pix_fmt", "rgb24", "-"],
    ]
    decoded = subprocess.run(command, capture_output=True, check=True)
    (said,) = (line for line in decoded.stderr.decode().splitlines() if "Video: h264" in line)
    assert "yuv420p" in said and "96x64" in said and "12.50 fps" in said
    shown = np.frombuffer(decoded.stdout, np.uint8).reshape(-1, 64, 96, 3).astype(float)
    # At 8 bits the colours survive to a few levels; with another matrix green is off by 20.
    errors = [np.abs(a - b).mean() for a, b in zip(shown, pictures(), strict=True)]
    assert max(errors) < 4
    with pytest.raises(OutputError, match=r"cannot write the video .*not divisible by 2"):
        write_video(tmp_path / "c.mp4", [pictures()[0][:63]], 10)
    assert not list(tmp_path.glob("*c.mp4*"))


def test_without_ffmpeg_a_video_is_mpeg4_part_2_and_says_so(tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    write_video(tmp_path / "a.mp4", pictures(), 10)
    said = capsys.readouterr().err
    assert "MPEG-4 part 2" in said and "browsers" in said and "climategs[video]" in said
    assert b"mp4v" in (tmp_path / "a.mp4").read_bytes()


def test_a_video_is_of_frames_that_all_variants_have(tmp_path) -> None:
    write_rows(tmp_path, [row_of("clear", 1), row_of("clear", 2), row_of("fog", 2)])
    frames = cv2.VideoCapture(str(draw_video(tmp_path, "front")))
    assert frames.get(cv2.CAP_PROP_FRAME_COUNT) == 1
    frames = cv2.VideoCapture(str(draw_video(tmp_path, "front", recipe="clear")))
    assert frames.get(cv2.CAP_PROP_FRAME_COUNT) == 2
    write_rows(tmp_path, [row_of("clear", 1), row_of("fog", 2)])
    with pytest.raises(OutputError, match="no frame of front in common"):
        draw_video(tmp_path, "front")
    for count in (1, 4, 9):
        image = side_by_side([("", np.zeros((101, 333, 3), np.uint8))] * count)
        height, width = image.shape[:2]
        assert height % 2 == width % 2 == 0 and 1400 < width <= VIDEO_WIDTH
