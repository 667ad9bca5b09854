"""Pictures of an output folder: which images they show, in which order, and what files they are."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pyarrow.parquet as pq
import pytest

from augment.errors import OutputError
from augment.jobs.layout import MANIFEST
from augment.jobs.manifest import later_columns, rows_to_table, write_manifest
from augment.jobs.store import LocalStore
from tests.tools.report_outputs import make_row
from tools import drawing

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
    return [title for title, _ in drawing.sheet_lines(folder, **chosen)]


def test_a_line_says_its_weather_and_the_driest_comes_first(folder) -> None:
    assert titles(folder) == [
        "street, frame 4: clear-000 (no weather)",
        "street, frame 4: white-000 (snow 12.5 cm)",
        "street, frame 4: wet-000 (water at -0.05 m)",
        "street, frame 4: deep-000 (water at 0.50 m)",
        "street, frame 4: fog-000 (visibility 40 m, water at 0.30 m)",
    ]


def test_a_folder_older_than_floods_is_drawn(folder) -> None:
    table = pq.read_table(folder / MANIFEST)
    young = [*later_columns(), "flood_level_m", "snow_depth_m"]
    pq.write_table(table.drop_columns(young), folder / MANIFEST)
    weather = [title.rpartition(" (")[2] for title in titles(folder)]
    assert weather == [*["no weather)"] * 4, "visibility 40 m)"]


def test_a_line_says_its_style(tmp_path) -> None:
    write_rows(tmp_path, [row_of("clear", style="dusk", style_strength=0.75)])
    assert titles(tmp_path) == ["street, frame 4: clear-000 (dusk x 0.75)"]


def test_a_picture_of_many_variants_shows_some_from_end_to_end() -> None:
    def names(count: int) -> list[str]:
        table = rows_to_table([row_of(f"{i:03d}") for i in range(count)])
        return [row["recipe"] for row in drawing.shown_variants(table)]

    assert names(drawing.MAX_SHOWN) == [f"{i:03d}" for i in range(drawing.MAX_SHOWN)]
    many = names(100)
    assert len(many) <= drawing.MAX_SHOWN and many[0] == "000" and int(many[-1]) >= 90


def test_a_sheet_shows_the_chosen_recipes_cameras_and_frames(tmp_path) -> None:
    rows = [row_of(r, n, c) for r in ("clear", "fog") for n in range(4) for c in ("a", "b", "c")]
    write_rows(tmp_path, rows)
    lines = drawing.sheet_lines(tmp_path, "fog", "c,a", "0,2:4")
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
            drawing.draw_sheet(tmp_path, **chosen)
    with pytest.raises(OutputError, match="camera d; it has a, b, c"):
        drawing.draw_video(tmp_path, "d")


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
        return drawing.cameras_on_car(LocalStore(tmp_path), table)

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
    drawing.write_video(tmp_path / "a.mp4", pictures(), 12.5)
    drawing.write_video(tmp_path / "b.mp4", iter(pictures()), 12.5)
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
        drawing.write_video(tmp_path / "c.mp4", [pictures()[0][:63]], 10)
    assert not list(tmp_path.glob("*c.mp4*"))


def test_without_ffmpeg_a_video_is_mpeg4_part_2_and_says_so(tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    drawing.write_video(tmp_path / "a.mp4", pictures(), 10)
    said = capsys.readouterr().err
    assert "MPEG-4 part 2" in said and "browsers" in said and "climategs[video]" in said
    assert b"mp4v" in (tmp_path / "a.mp4").read_bytes()


@pytest.mark.parametrize("count", [1, 2, 3, 4, 5, 9])
def test_pictures_of_a_video_have_even_sides(count) -> None:
    image = np.zeros((101, 333, 3), np.uint8)
    height, width = drawing.side_by_side([("", image)] * count).shape[:2]
    assert height % 2 == width % 2 == 0 and 1400 < width <= drawing.VIDEO_WIDTH


def test_a_video_is_of_frames_that_all_variants_have(tmp_path) -> None:
    write_rows(tmp_path, [row_of("clear", 1), row_of("clear", 2), row_of("fog", 2)])
    frames = cv2.VideoCapture(str(drawing.draw_video(tmp_path, "front")))
    assert frames.get(cv2.CAP_PROP_FRAME_COUNT) == 1
    frames = cv2.VideoCapture(str(drawing.draw_video(tmp_path, "front", recipe="clear")))
    assert frames.get(cv2.CAP_PROP_FRAME_COUNT) == 2
    write_rows(tmp_path, [row_of("clear", 1), row_of("fog", 2)])
    with pytest.raises(OutputError, match="no frame of front in common"):
        drawing.draw_video(tmp_path, "front")
