"""`climategs evaluate` on an output of a painted wall, whose pictures are known exactly."""

import functools
import json
import math

import cv2
import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from augment.errors import OutputError
from augment.metrics.lpips import ALEX, expected_shapes
from augment.output.calibration import frame_entry
from augment.output.codecs import encode_depth, encode_ids, encode_image, encode_mask
from augment.output.manifest import rows_to_table, write_manifest
from augment.output.tables import boxes_bytes
from augment.render.sensor import add_noise
from augment.scene.cameras import Frame
from recipes.load import dump_recipe
from recipes.schema import Output, Recipe, Sensor
from tests.tools.report_outputs import make_row
from tests.walls import FRAME_NS, board_boxes, driving_camera, wall_view
from tools.cli import EvaluateOptions
from tools.evaluate import evaluate_output, evaluation_text
from tools.output import write_json

FRAMES = 8
CAMERAS = {"ahead": 0.0, "left": 0.5, "behind": math.pi}  # name: yaw, radians
FLICKER = 8 / 255
NOISE = 0.03


def camera_of(name, frame):
    return driving_camera(frame, name=name, yaw=CAMERAS[name])


def measure(out, **options):
    return evaluate_output(EvaluateOptions(out=str(out), **options), progress=False)


@functools.cache
def boxes_file():
    return boxes_bytes(board_boxes(FRAMES))


@functools.cache
def calibration_file():
    ego, origin_m = torch.eye(4, dtype=torch.float64), np.zeros(3)
    frames = [
        Frame(n, n * FRAME_NS, ego, {name: camera_of(name, n) for name in CAMERAS})
        for n in range(FRAMES)
    ]
    return json.dumps({"frames": [frame_entry(f, CAMERAS, 1.0, origin_m) for f in frames]}).encode()


def write_image(out, row, *, depth=True, instance=False):
    """The files of a row. Flooded ones flicker in the lower half, where their water is; rain draws
    white streaks on every image in places of its own.
    """
    base, stem = f"{row['scene']}/{row['variant']}", f"{row['camera']}/{row['frame']:06d}.png"
    view = wall_view(camera_of(row["camera"], row["frame"]))
    picture, depth_m = view.picture.copy(), view.depth_m.astype(np.float32)
    wet = np.zeros(depth_m.shape, bool)
    if row["recipe"] == "flood":
        wet[len(wet) // 2 :] = True
        picture[wet] += FLICKER * (row["frame"] % 2)
    if row["recipe"] == "noisy":
        camera, noisy = camera_of(row["camera"], row["frame"]), torch.from_numpy(picture).float()
        picture = add_noise(noisy, NOISE, camera, seed=1, scene="wall").numpy()
    streaks = (
        np.random.default_rng([row["frame"], *row["camera"].encode()]).random(wet.shape) < 0.02
    )
    if row["recipe"] == "rain":
        picture[streaks] = 1.0
    rgb = (picture.clip(0, 1) * 255).round().astype(np.uint8)
    files = {"image": (f"{base}/images/{stem}", encode_image(rgb, Output()))}
    files["labels"] = (f"{base}/labels/boxes.parquet", boxes_file())
    files["calibration"] = (f"{base}/calibration.json", calibration_file())
    if depth:
        files["depth"] = (f"{base}/depth/{stem}", encode_depth(depth_m))
    if row["recipe"] == "flood":
        files["water"] = (f"{base}/water/{stem}", encode_mask(wet.astype(np.uint8) * 255))
    if row["recipe"] == "rain":
        files["rain"] = (f"{base}/rain/{stem}", encode_mask(streaks.astype(np.uint8) * 255))
    if instance:
        ids = (depth_m < 7).astype(np.uint16)
        files["instance"] = (f"{base}/instance/{stem}", encode_ids(ids, np.uint16))
    for kind, (path, data) in files.items():
        row[f"{kind}_path"] = path
        if not (out / path).exists():
            (out / path).parent.mkdir(parents=True, exist_ok=True)
            (out / path).write_bytes(data)


def write_walls(out, recipes=("clear",), frames=range(FRAMES), **kwargs):
    size = {"width": 64, "height": 48}
    weather = {
        "clear": {},
        "flood": {"flood_level_m": 0.3},
        "fog": {"smog_extinction_per_m": 0.1},
        "rain": {"rain_rate_mm_h": 20.0},
        "noisy": {},
    }
    rows = [
        make_row("wall", recipe, 0, frame, camera, **weather[recipe], **size)
        for recipe in recipes
        for frame in frames
        for camera in CAMERAS
    ]
    for row in rows:
        write_image(out, row, **kwargs)
    write_manifest(out, rows_to_table(rows))
    return out


@pytest.fixture(scope="module")
def walls(tmp_path_factory):
    return write_walls(tmp_path_factory.mktemp("walls"), ("clear", "flood"), instance=True)


@pytest.fixture(scope="module")
def facts(walls):
    return measure(walls)


def test_a_clean_wall_has_the_errors_of_its_files(facts):
    clear = facts["recipes"][0]
    assert clear["recipe"] == "clear" and clear["effects"] == "clean"
    # Cameras that look back see the wall behind the world: depth below 0 is none.
    assert [clear[k]["pairs"] for k in ("short", "long", "cameras")] == [14, 2, 8]
    assert [clear[k]["left_out"] for k in ("short", "long", "cameras")] == [7, 1, 0]
    for kind in ("short", "long", "cameras"):
        # 8 bits: two roundings of +-1/2 of 255, less where four are blended.
        assert 0 < clear[kind]["all"]["rmse"]["mean"] < 0.41 / 255
        assert clear[kind]["water"] is None
    assert clear["short"]["seconds_apart"] == pytest.approx(0.1)
    assert clear["long"]["meters_apart"] == pytest.approx(0.7)
    assert clear["long"]["moved_share"] > 0.005


def test_water_is_reported_apart(facts):
    flood = facts["recipes"][1]
    assert flood["effects"] == "flood"
    short = flood["short"]
    assert short["water"]["rmse"]["mean"] == pytest.approx(FLICKER, rel=0.05)
    assert short["dry"]["rmse"]["mean"] < 0.41 / 255
    assert short["dry"]["rmse"]["mean"] < short["all"]["rmse"]["mean"] < FLICKER
    shares = [short[part]["share"]["mean"] for part in ("all", "dry", "water")]
    assert shares[0] == pytest.approx(shares[1] + shares[2])
    assert flood["cameras"]["water"]["rmse"]["mean"] < 0.41 / 255  # of one frame: no flicker
    worst = next(w for w in facts["worst"] if (w["recipe"], w["kind"]) == ("flood", "short"))
    assert worst["all"]["rmse"] == max(
        p["all"]["rmse"] or 0 for p in facts["pairs"] if p["recipe"] == "flood"
    )


def test_noise_of_the_camera_is_taken_out(facts, tmp_path):
    out = write_walls(tmp_path, ("noisy",))
    with_it = measure(out)["recipes"][0]["short"]["all"]
    assert "noise" not in with_it and with_it["rmse"]["mean"] > NOISE  # no recipe says so
    recipe = Recipe(name="noisy", camera=Sensor(noise=NOISE))
    file = out / "wall" / "noisy-000" / "recipe.yaml"
    file.write_text(dump_recipe(recipe))
    found = measure(out)
    clear, short = facts["recipes"][0]["short"]["all"], found["recipes"][0]["short"]["all"]
    assert short["noise"]["mean"] == pytest.approx(with_it["rmse"]["mean"], rel=0.05)
    # What is left of a variance after an estimate of a few hundred independent pixels.
    assert short["rmse"]["mean"] < 0.3 * NOISE
    assert short["relative"]["mean"] < with_it["relative"]["mean"] / 3
    assert clear["rmse"]["mean"] < 0.3 * NOISE
    said = evaluation_text(found)
    assert f"taken out of RMSE and relative: noisy {short['noise']['mean']:.2f}"[:-1] in said
    jpg = recipe.model_copy(update={"output": Output(image="jpg")})
    file.write_text(dump_recipe(jpg))
    assert measure(out)["recipes"][0]["short"]["all"] == with_it
    file.write_text("camera: {noise: -1}")
    with pytest.raises(OutputError, match=r"recipe\.yaml is damaged.*run the job again"):
        measure(out)


def test_streaks_are_no_inconsistency(facts, tmp_path):
    rain = measure(write_walls(tmp_path, ("rain",), frames=range(2)))["recipes"][0]
    clear = facts["recipes"][0]
    assert rain["effects"] == "rain"
    for kind in ("short", "cameras"):
        found = rain[kind]["all"]
        assert found["rmse"]["mean"] < 0.41 / 255
        # Streaks of the one and, four times, of the other are left out.
        assert found["share"]["mean"] < 0.95 * clear[kind]["all"]["share"]["mean"]


def test_command(walls, tmp_path, capsys):
    shapes = expected_shapes(ALEX)
    generator = torch.Generator().manual_seed(1)
    tensors = {n: torch.randn(s, generator=generator).abs() / 50 for n, s in shapes.items()}
    save_file(tensors, tmp_path / "alex.safetensors")
    options = EvaluateOptions(
        out=str(walls),
        pairs=2,
        recipes="flood",
        lpips=tmp_path / "alex.safetensors",
        pictures=tmp_path / "worst",
        json_file=tmp_path / "facts.json",
    )
    code = options.run()
    out = capsys.readouterr().out
    assert code == 0
    assert "1 frame apart" in out and "7 frames apart" in out and "Neighbouring cameras" in out
    assert "| flood | flood | 2 | 0 | 0.10 m, 0.10 s |" in out and "| water only |" in out
    # Every row is this output's: a method's published figures are no result of it.
    rows = {line.split("|")[1].strip() for line in out.splitlines() if line.startswith("| ")}
    assert rows == {"recipe", "flood", "without water", "water only"}
    facts = json.loads((tmp_path / "facts.json").read_text())
    assert facts["lpips"] == "alex" and len(facts["pairs"]) == 6
    short = next(p for p in facts["pairs"] if p["kind"] == "short")["all"]
    assert short["lpips"] == pytest.approx(short["lpips_counted"] * short["share"])
    assert short["lpips"] > 0
    for kind in ("short", "long", "cameras"):
        picture = cv2.imread(str(tmp_path / "worst" / f"flood-{kind}.png"))
        assert picture.shape[2] == 3 and picture.std() > 10


def test_frames_that_are_not_consecutive_have_no_pairs(tmp_path):
    write_walls(tmp_path / "out", frames=(0, 2, 4))
    facts = measure(tmp_path / "out")
    clear = facts["recipes"][0]
    (note,) = facts["notes"]
    assert "1 or 7 apart, so the tables of short and long range are empty" in note
    assert "--short 2 --long 4" in note and note in evaluation_text(facts)
    assert clear["short"] is None and clear["long"] is None and clear["cameras"]["pairs"] == 3
    thinned = measure(tmp_path / "out", short=2, long=4)
    assert thinned["notes"] == []
    two = thinned["recipes"][0]
    assert two["short"]["pairs"] + two["short"]["left_out"] == 6
    write_json(tmp_path / "f.json", facts)  # None and numbers only


def test_errors_say_what_to_do(walls, tmp_path):
    write_walls(tmp_path / "flat", frames=(0, 1), depth=False)
    row = make_row("wall", "clear", 0, 0, "ahead", width=64, height=48)
    write_image(tmp_path / "one", row)
    write_manifest(tmp_path / "one", rows_to_table([row]))
    for out, options, message in (
        (tmp_path, {}, "nothing in it is finished yet"),
        (walls, {"recipes": "snow"}, r"no recipe \['snow'\]; finished are: clear, flood"),
        (tmp_path / "flat", {}, r"has no depth images.*depth: median"),
        (tmp_path / "one", {}, "no two images to compare"),
    ):
        with pytest.raises(OutputError, match=message):
            measure(out, **options)
