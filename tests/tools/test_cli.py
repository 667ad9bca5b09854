"""The `climategs` command as a user runs it, on a scene small enough to be quick."""

from __future__ import annotations

import dataclasses
import json
import math
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from adapters.base import open_scene
from augment.dataset import WeatherDataset
from augment.errors import ClimateGSError, OutputError
from augment.files.ply import write_ply
from augment.files.scene_file import load_scene_parts, save_scene
from augment.light.scene_light import find_scene_light
from augment.output.manifest import read_manifest
from augment.scene.labels import Boxes
from augment.scene.scene import Gaussians, Scene
from augment.scene.scene_times import scene_times
from recipes.schema import Output, Recipe
from recipes.style import style_preset_names
from tests.fitted_scenes import assert_same, fitted_scene
from tests.snow_scenes import box_car, drive, sheet
from tests.streets import open_street
from tools import explain
from tools.cli import ExportOptions, GenerateOptions, main
from tools.explain import explain_recipe, explanation_text, measure_passes
from tools.generate import ended_by_sigterm, generate_dataset

FOG = """
version: 1
seed: 3
variants: 2
weather:
  smog:
    visibility_m: {uniform: [5, 50]}
"""


@pytest.fixture
def scene_uri(tmp_path) -> str:
    """A floor of 400 splats, with two recorded images of it."""
    x, y = torch.meshgrid(torch.arange(-5, 5, 0.5), torch.arange(-5, 5, 0.5), indexing="ij")
    count = x.numel()
    floor = Gaussians(
        means=torch.stack([x.reshape(-1), y.reshape(-1), torch.zeros(count)], -1),
        quats=torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1),
        scales=torch.tensor([[0.4, 0.4, 0.01]]).repeat(count, 1),
        opacities=torch.full((count,), 0.95),
        sh=torch.full((count, 1, 3), 0.3),
    )
    path = tmp_path / "floor.ply"
    write_ply(path, floor)
    cameras = {
        "width": 32, "height": 24, "fx": 30, "fy": 30, "cx": 16, "cy": 12,
        "frames": [
            {"timestamp_s": 0.1 * i, "position": [-4 + i, 0, 1.5], "look_at": [4, 0, 0]}
            for i in range(2)
        ],
    }  # fmt: skip
    (tmp_path / "path.json").write_text(json.dumps(cameras))
    return f"gaussians:{path}?scale=1&cameras={tmp_path / 'path.json'}"


@pytest.fixture
def recipe(tmp_path) -> str:
    path = tmp_path / "fog.yaml"
    path.write_text(FOG)
    return str(path)


def test_render_writes_images_manifest_and_pictures(scene_uri, recipe, tmp_path, capsys):
    out = tmp_path / "out"
    assert main(["render", recipe, "--scene", scene_uri, "--out", str(out)]) == 0
    said = capsys.readouterr().out
    assert "4 images written, 0 already there, 0 failed" in said
    assert (out / "manifest.parquet").is_file()
    images = sorted(out.glob("*/fog-00[01]/images/*/*.png"))
    assert len(images) == 4
    assert all(cv2.imread(str(path)).shape == (24, 32, 3) for path in images)
    assert cv2.imread(str(out / "contact_sheet.png")).shape[1] > 32
    # The second run finds everything done, and says so.
    assert main(["render", recipe, "--scene", scene_uri, "--out", str(out), "--no-sheet"]) == 0
    assert "0 images written, 4 already there" in capsys.readouterr().out
    camera = images[0].parent.name
    assert main(["sheet", str(out), "--video-camera", camera]) == 0
    assert cv2.VideoCapture(str(out / f"video_{camera}.mp4")).get(cv2.CAP_PROP_FRAME_COUNT) == 2


def test_render_a_flood_and_read_it_back(scene_uri, tmp_path, capsys):
    recipe, out = tmp_path / "flood.yaml", tmp_path / "out"
    recipe.write_text(
        "weather: {flood: {level_m: 0.3, reflection: sky}}\noutput: {surface: first}\n"
    )
    uri = scene_uri + "&up=%2Bz&ground_z=0"
    assert main(["render", str(recipe), "--scene", uri, "--out", str(out)]) == 0
    samples = WeatherDataset(out)
    assert len(samples) == 2
    for sample in samples:
        assert sample["surface"] == "first" and sample["weather"]["flood_level_m"] == 0.3
        water = sample["water"]
        assert 0.3 < float(water.float().mean()) < 0.9  # what lies below the horizon
        # The camera looks down at the floor's middle, so the water is nearer than the floor.
        depth = sample["depth"][water]  # 0 beyond what 16 bits hold
        assert float(depth[depth > 0].min()) > 0.5 and float((depth > 0).float().mean()) > 0.9
    assert "2 images written" in capsys.readouterr().out
    assert main(["explain", str(recipe), "--scene", uri]) == 0
    assert "flood: bed" in capsys.readouterr().out


@pytest.mark.long
def test_a_job_says_at_its_start_that_sweeps_and_depth_differ(tmp_path, capsys):
    scene = "procedural:street?seed=3&frames=1&gaussians=60000&lidar_columns=16"
    (tmp_path / "seen-through.yaml").write_text(
        "weather: {flood: {level_m: 0.3, reflection: sky}}\n"
    )
    asked = [str(tmp_path / "seen-through.yaml"), "--scene", scene, "--out", str(tmp_path / "out")]
    for frames in ([], ["--frames", "0"]):
        assert main(["render", *asked, *frames, "--scale", "0.1"]) == 0
        assert "LiDAR meets the weather: " in capsys.readouterr().err


def test_render_takes_several_recipes_selections_and_scale(scene_uri, recipe, tmp_path, capsys):
    out = ["--scene", scene_uri, "--out", str(tmp_path / "out"), "--no-sheet", "--frames", "1"]
    assert main(["render", "clear", recipe, *out, "--variants", "2", "--scale", "0.5"]) == 0
    images = sorted((tmp_path / "out").glob("*/*/images/*/*.png"))
    assert [path.parts[-4] for path in images] == ["clear-000", "clear-001", "fog-000", "fog-001"]
    assert all(path.stem.endswith("1") for path in images)
    assert {cv2.imread(str(path)).shape for path in images} == {(12, 16, 3)}
    (tmp_path / "others").mkdir()
    other = shutil.copy(recipe, tmp_path / "others")
    for again in (recipe, str(other)):
        assert main(["render", recipe, again, *out]) == 2
        assert f"{recipe} and {again} are both called 'fog'" in capsys.readouterr().err


def test_a_failing_image_gives_exit_code_1(scene_uri, recipe, tmp_path, monkeypatch, capsys):
    import augment.view.render_view

    real = augment.view.render_view.begin_view

    def breaks_on_the_second_frame(scene, camera, recipe, *, backend):
        if camera.timestamp_ns > 0:
            raise RuntimeError("no light")
        return real(scene, camera, recipe, backend=backend)

    monkeypatch.setattr(augment.view.render_view, "begin_view", breaks_on_the_second_frame)
    out = tmp_path / "out"
    assert main(["render", recipe, "--scene", scene_uri, "--out", str(out), "--no-sheet"]) == 1
    streams = capsys.readouterr()
    assert "2 images written, 0 already there, 2 failed" in streams.out
    assert "no light" in streams.err


def test_inspect_says_what_is_there_and_writes_json(scene_uri, tmp_path, capsys):
    target = tmp_path / "facts.json"
    assert main(["inspect", scene_uri, "--json", str(target)]) == 0
    facts = json.loads(target.read_text())
    assert facts["gaussians"] == 400
    assert facts["frames"]["count"] == 2
    assert "400" in capsys.readouterr().out


@pytest.mark.parametrize(("sun_share", "verdict"), [(0.2, ": fit for"), (0.8, ": not fit for")])
def test_inspect_judges_the_light_for_nights(sun_share, verdict, monkeypatch, scene_uri, capsys):
    light = dataclasses.replace(find_scene_light(open_scene(scene_uri)), sun_share=sun_share)
    monkeypatch.setattr("tools.inspect.find_scene_light", lambda scene: light)
    assert main(["inspect", scene_uri]) == 0
    assert f"the sun gives {100 * sun_share:.0f} % of it{verdict} dusk" in capsys.readouterr().out


def test_recipes_lists_prints_and_exports(tmp_path, capsys):
    assert main(["recipes"]) == 0
    assert "\ndense-fog      Fog in which a car 100 m ahead" in capsys.readouterr().out
    assert main(["recipes", "dense-fog"]) == 0
    text = capsys.readouterr().out
    assert "visibility_m" in text
    (tmp_path / "mine.yaml").write_text(text)
    assert main(["recipes", str(tmp_path / "mine.yaml")]) == 0
    assert capsys.readouterr().out == text
    assert main(["recipes", str(tmp_path / "mine.yaml"), "--draws", "--set", "variants=3"]) == 0
    draws = capsys.readouterr().out.splitlines()
    assert "weather.smog.visibility_m: uniform from 50 to 120 (metres)" in draws
    assert [line.split()[0] for line in draws[-3:]] == ["mine-000", "mine-001", "mine-002"]
    assert all("weather.smog.visibility_m = " in line for line in draws[-3:])
    schema = tmp_path / "schema.json"
    assert main(["recipes", "--schema", str(schema)]) == 0
    assert "weather" in json.loads(schema.read_text())["properties"]


def test_mistakes_exit_with_2_and_one_message(scene_uri, tmp_path, capsys):
    out = ["--out", str(tmp_path / "out")]
    here = ["render", "clear", "--scene", scene_uri, *out]
    bare = scene_uri.split("?")[0] + "?cameras=none"
    for arguments, message in (
        (["render", "--scene", scene_uri, *out], "no recipe is named"),
        (["render", "no-such", "--scene", scene_uri, *out], "no such file"),
        (["render", "clear", "--scene", "nowhere:x", *out], "nowhere"),
        ([*here, "--set", "render.scal=1"], "--set render.scal=1: render.scal: unknown field; did"),
        ([*here, "--frames", "x"], "--frames 'x'"),
        ([*here, "--frames", "9"], "no frame 9"),
        ([*here, "--cameras", "q"], "no camera q"),
        ([*here, "--scale", "99"], "a scale of 99"),
        ([*here, "--scale", "nan"], "--scale must be a finite number; got nan"),
        ([*here, "--variants", "0"], "--variants must be greater than or equal to 1; got 0"),
        ([*here, "--workers", "0"], "--workers must be"),
        (["explain", "clear", "--scene", scene_uri, "--variant", "9"], "clear has one variant, 0"),
        (["evaluate", out[1], "--short", "7"], "--long must be above --short 7; got 7"),
        (["export", scene_uri, *out, "--frame", "4"], "--frame is for ply, splat"),
        (["export", scene_uri, *out, "--kind", "ply", "--half"], "--half is for a single scene"),
        (["sheet", out[1]], "manifest.parquet does not exist"),
        ([*here, "--set", "\udcff=1"], "argument 8 is not UTF-8 text: '\\udcff=1'"),
        (["render", "\udcff.yaml", "--scene", scene_uri, *out], "argument 2 is not UTF-8"),
        (["render", "clear", "--scene", "scene:\udcff", *out], "argument 4 is not UTF-8"),
        ([*here[:-1], "\udcff"], "argument 6 is not UTF-8 text"),
        ([*here, "--set", "output.depth=false"], "one of median, expected, mode, none; write none"),
        ([*here, "--set", "weather.smog=false"], "write null to leave it out"),
        (["inspect", scene_uri, "--json", "/nowhere/facts.json"], "cannot write /nowhere/facts"),
        (["style", "presets", "dawn-mits"], "dawn-mist"),
        (["style", "train", *out], "there is nothing to learn from"),
        (["style", "apply", "procedural:street", "dsuk", *out], "dusk"),
        (["generate", "job.yaml"], "--out is missing"),
        (["generate", *out], "no job file is named"),
        (["generate", "job.yaml", *out], "no such file; a job is a YAML file"),
        (["generate", *out, "--status"], "no job has been started there"),
        (["generate", "--out", "ftp://x/y", "--status"], "ftp"),
        (["render", "street-flood", "--scene", bare, *out], "up="),
        (["render", "street-flood", "--scene", bare, *out], "scale="),
        ([*here[:-1], "s3://bucket/path"], "is not on this machine"),
        (["sheet", "s3://bucket/path"], "is not on this machine"),
        (["mirror", "gs://bucket/path"], "is not on this machine"),
        (["labels", "s3://bucket/path"], "copy the output here, images too (as by `aws s3 sync"),
    ):
        assert main(arguments) == 2
        error = " ".join(capsys.readouterr().err.split())
        assert message in error and "Traceback" not in error
        assert not (tmp_path / "out").exists()


def test_style_presets_are_listed_and_printed(capsys):
    assert main(["style", "presets"]) == 0
    assert tuple(capsys.readouterr().out.split()) == style_preset_names()
    assert main(["style", "presets", "dusk"]) == 0
    assert "covariance:" in capsys.readouterr().out
    with pytest.raises(SystemExit, match="2"):
        main(["style"])
    assert "{apply, train, presets}" in capsys.readouterr().err


def test_help_loads_neither_torch_nor_the_kernels():
    """What keeps `climategs --help` instant; its time itself is measured by hand, not here."""
    code = (
        "import sys; from tools.cli import main\n"
        "try: main(['--help'])\n"
        "except SystemExit: pass\n"
        "loaded = {'torch', 'numba', 'numpy', 'cv2', 'pyarrow'} & set(sys.modules)\n"
        "sys.exit(f'loaded {loaded}' if loaded else 0)"
    )
    root = Path(__file__).resolve().parents[2]
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, cwd=root, check=False
    )
    assert result.returncode == 0, result.stderr
    assert "render" in result.stdout


# ---- explain -------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def scene() -> Scene:
    road = sheet((-2.0, 24.0), (-4.0, 4.0), semantic=1)
    return drive(road, actors=[box_car(start=(8.0, -2.0), size=(3.0, 1.8, 1.0))])


def explained(monkeypatch, tmp_path, scene: Scene, recipe: str, **options):
    path = tmp_path / "recipe.yaml"
    path.write_text(recipe)
    monkeypatch.setattr(explain, "open_scene", lambda uri: scene)
    facts = explain_recipe(str(path), "test:sheets", **options)
    return facts, explanation_text(facts)


def test_shares_of_a_frame_add_up(scene):
    times = measure_passes(Recipe(output=Output(depth="none", labels=False)), scene)
    assert times["views"] == 2 and times["frame_ms"] > 0
    assert times["folded"] == times["once_s"] == {}
    assert sum(times["share"].values()) == pytest.approx(1)
    assert {"rasterise", "sky", "view plan", "8 bits", "everything else"} <= set(times["share"])
    assert not any(name.startswith(("flood", "snow", "style")) for name in times["share"])


def test_times_are_on_the_page_only_where_they_were_measured(scene, monkeypatch, tmp_path):
    recipe = "weather: {smog: {visibility_m: 40}}\noutput: {depth: none, labels: false}\n"
    facts, page = explained(monkeypatch, tmp_path, scene, recipe)
    assert "smog per Gaussian" in facts["times"]["folded"]
    lines = {line[9:].split("  ")[0].strip(): line for line in page.splitlines()}
    assert "%" in lines["rasterise"] and "(" in lines["smog per Gaussian"]
    assert "%" not in lines["flood: bed"] and "2 views spread over" in page
    assert "actors can be in view in 2 of 2, 1.0 of 1 on average" in page
    monkeypatch.setattr(explain, "measure_passes", None)  # not called
    facts, page = explained(monkeypatch, tmp_path, scene, recipe, times=False)
    assert facts["times"] is None and "%" not in page and "skips  flood: bed" in page


CHANGING = """
weather:
  clock: {speed: 10}
  smog: {visibility_m: {timeline: [[0, 50], [1, 250]], times: share}}
output: {depth: none, labels: false}
"""


def test_changing_weather_is_explained_at_a_time_and_drawn(scene, monkeypatch, tmp_path):
    facts, page = explained(monkeypatch, tmp_path, scene, CHANGING, times=False)
    drive_s = scene_times(scene).duration_s
    assert facts["moment"] == {"drive_s": drive_s / 2, "weather_s": 5 * drive_s}
    assert "smog.visibility_m = 150" in page and "numbers that change over the drive:" in page
    assert facts["course"]["values"]["weather.smog.visibility_m"] == pytest.approx(
        [50 + 25 * i for i in range(9)]
    )
    picture = tmp_path / "curves.png"
    options = {"times": False, "at_s": 0.0, "plot": picture}
    facts, page = explained(monkeypatch, tmp_path, scene, CHANGING, **options)
    assert "0 s after the drive's first image" in page and "smog.visibility_m = 50" in page
    assert cv2.imread(str(picture)).shape[2] == 3
    with pytest.raises(ClimateGSError, match="--at 99: the scene's drive goes from 0 to"):
        explained(monkeypatch, tmp_path, scene, CHANGING, times=False, at_s=99.0)
    plain = "weather: {smog: {visibility_m: 40}}\n"
    with pytest.raises(ClimateGSError, match="no number of recipe recipe changes"):
        explained(monkeypatch, tmp_path, scene, plain, times=False, plot=picture)
    _, page = explained(monkeypatch, tmp_path, scene, plain, times=False)
    assert "change over the drive" not in page and "first image" not in page


def test_lamps_are_explained_by_source_with_their_cost(scene, monkeypatch, tmp_path):
    recipe = "light: {time: night, street: off}\noutput: {depth: none, labels: false}\n"
    facts, page = explained(monkeypatch, tmp_path, scene, recipe)
    parts = {part["name"]: part for part in facts["parts"]}
    assert parts["own beams"]["counts"] == {"dipped": 2.0, "tail": 2.0}
    assert "street lamps" not in parts and math.isfinite(parts["own beams"]["ms"])
    assert "own beams: 2.0 dipped, 2.0 tail; " in page
    assert "light.time = night" in page
    facts, page = explained(monkeypatch, tmp_path, scene, recipe, times=False)
    assert facts["parts"] == [] and "parts of effects" not in page


def test_labels_for_trainers_are_explained(scene, monkeypatch, tmp_path):
    recipe = "output: {depth: none, labels: [coco], min_visibility: 0.2}\n"
    facts, page = explained(monkeypatch, tmp_path, scene, recipe, times=False)
    assert facts["labels"]["files"] == ["labels/coco/instances_train.json"]
    assert "labels/coco/instances_train.json" in page and "none: the scene has no boxes" in page
    box = Boxes(("a",), ("Car",), np.zeros((1, 3)), np.ones((1, 3)), np.eye(1, 4), {})
    monkeypatch.setattr(Scene, "boxes", lambda _scene, _frame: box)
    _, page = explained(monkeypatch, tmp_path, scene, recipe, times=False)
    assert "\n  Car: 2 boxes of 1 objects, of which images get those that a pixel shows" in page
    assert "where the weather leaves less than 0.2 of an object, it is left out" in page
    facts, page = explained(monkeypatch, tmp_path, scene, "{}\n", times=False)
    assert facts["labels"] is None and "for trainers" not in page


def test_compiling_is_said_before_it_is_done_wherever_it_is():
    """In a process of its own: what is said depends on what was compiled before."""
    code = """
import numba, sys
from tools.cli import main
import tools.cli
import augment.render.cpu.jit
from tools.output import compiling_noted

@numba.njit
def doubled(x):
    return 2 * x

def command():
    doubled(2)
    with compiling_noted():
        doubled(2.0)
    with compiling_noted():
        doubled(2.0)

tools.cli.COMMANDS["presets"] = command
sys.exit(main(["presets"]))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    lines = done.stderr.splitlines()
    assert done.returncode == 0, done.stderr
    assert lines[0].startswith("compiling kernels (once; kept in ")
    assert lines[0].endswith("climategs/kernels) ...")
    assert len(lines) == 2 and lines[1].startswith("kernels compiled after")


def test_settings_are_those_of_the_quality(monkeypatch, tmp_path, scene):
    facts, text = explained(monkeypatch, tmp_path, scene, "quality: reference\n", times=False)
    assert facts["settings"]["render.scale"] == 1 and "\nquality reference:\n" in text
    open_ = "quality: {max_flip: 0.1}\nrender: {scale: 0.5}\n"
    facts, text = explained(monkeypatch, tmp_path, scene, open_, times=False)
    assert facts["settings"]["render.scale"] == 0.5 and not facts["is_chosen"]
    assert "quality max_flip 0.1, chosen in view of the scene when a job starts" in text
    _, text = explained(monkeypatch, tmp_path, scene, "{}\n", times=False)
    assert "\nno quality is asked for:\n" in text


# ---- generate ------------------------------------------------------------------------------------


def test_what_is_no_shard() -> None:
    assert GenerateOptions(out="o", status=True, shard="07/8")
    for text in ("", "1", "/", "0/3", "4/3", "-1/3", "1/3/5", "a/b", "1 of 3", "1/", "1.0/2",
                 "1/" + "9" * 5000):  # fmt: skip
        with pytest.raises(ClimateGSError, match="write i/n with i from 1 to n, as in 2/8"):
            GenerateOptions(out="o", status=True, shard=text)


def test_sigterm_is_as_ctrl_c() -> None:
    before = signal.getsignal(signal.SIGTERM)
    with pytest.raises(KeyboardInterrupt), ended_by_sigterm():
        signal.raise_signal(signal.SIGTERM)
    assert signal.getsignal(signal.SIGTERM) is before


def test_a_job_whose_scenes_cannot_be_opened(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    (tmp_path / "job.yaml").write_text("scenes: [missing]\nrecipes: [clear]\n")
    job, out = tmp_path / "job.yaml", tmp_path / "out"
    assert main(["generate", str(job), "--out", str(out), "--executor", "serial"]) == 2
    said = capsys.readouterr().err
    assert "none of its scenes can be used" in said and str(tmp_path / "missing") in said
    with pytest.raises(ClimateGSError, match="none of its scenes"):
        generate_dataset(GenerateOptions(job=job, out=str(out), executor="serial", dry_run=True))


# ---- export --------------------------------------------------------------------------------------


@pytest.fixture
def uri(tmp_path: Path) -> str:
    save_scene(fitted_scene(), tmp_path / "scene")
    return f"scene:{tmp_path / 'scene'}"


def export_scene(scene: str, out: Path, **options) -> int:
    return ExportOptions(scene=scene, out=out, **options).run()


def names(folder: Path) -> list[str]:
    return sorted(str(p.relative_to(folder)) for p in folder.rglob("*") if p.is_file())


def test_a_file_is_the_scene(uri, tmp_path, capsys):
    assert export_scene(uri, tmp_path / "new" / "drive") == 0
    path = tmp_path / "new" / "drive.climategs"
    assert names(tmp_path / "new") == ["drive.climategs"]
    said = capsys.readouterr()
    assert f"wrote {path} (0.0 MB)" in said.out and "read from test:recording" in said.out
    assert "is not there" in said.err  # the note of the opened scene
    assert_same(load_scene_parts(path), fitted_scene(), but=("source",))
    for again in (open_scene(str(path)), open_scene(f"scene:{path}")):
        assert_same(again, fitted_scene(), but=("source", "problems"))
        assert again.source == f"scene:{path}"

    export_scene(f"scene:{path}", tmp_path / "half.climategs", half=True)
    assert "0.05 degrees" in capsys.readouterr().out
    half = open_scene(str(tmp_path / "half.climategs"))
    assert half.made_by["precision"] == "float16"
    assert torch.equal(half.background.means, fitted_scene().background.means)
    export_scene(str(path), tmp_path / "folder", kind="scene")
    assert_same(load_scene_parts(tmp_path / "folder"), fitted_scene(), but=("source",))


def test_a_recording_is_found_from_the_exported_file(tmp_path, monkeypatch):
    street = "procedural:street?seed=5&frames=2&gaussians=60000&lidar_columns=16&parked=0"
    save_scene(fitted_scene(recorded_source=street), tmp_path / "scene")
    export_scene(f"scene:{tmp_path / 'scene'}", tmp_path / "a")
    scene = open_scene(str(tmp_path / "a.climategs"))
    assert scene.problems == fitted_scene().problems and len(scene.boxes(1)) > 0
    # A recording named relative to where the scene was saved, and not there today.
    monkeypatch.chdir(tmp_path)
    save_scene(fitted_scene(recorded_source="pandaset:raw/002"), "scene")
    (tmp_path / "other").mkdir()
    monkeypatch.chdir(tmp_path / "other")
    export_scene(f"scene:{tmp_path / 'scene'}", Path("b"))
    again = load_scene_parts("b.climategs")
    assert again.recorded_source == f"pandaset:{tmp_path}/raw/002"
    assert again.problems == fitted_scene().problems


def test_baked_files_have_cameras_beside_them(uri, tmp_path, capsys, caplog):
    for kind in ("ply", "splat"):
        assert export_scene(uri, tmp_path / kind / "a", kind=kind, frame=5) == 0
        assert names(tmp_path / kind) == [f"a.{kind}", "cameras.json"]
        said = capsys.readouterr().out
        assert f"wrote {tmp_path / kind / 'cameras.json'}" in said
        assert "note: the sky is left out" in said
        assert "stand still where they are in frame 5" in said
        again = open_scene(str(tmp_path / kind / f"a.{kind}"))
        assert (
            again.camera_names == ("ahead", "left") and len(again.background) == 50
        )  # no actor then
    assert not caplog.messages  # what is lost is said once
    export_scene(uri, tmp_path / "ply" / "b.ply", kind="ply")
    said = capsys.readouterr()
    assert "stand still where they are in frame 4" in said.out and "not this" not in said.err
    (tmp_path / "ply" / "cameras.json").write_text("[]")
    export_scene(uri, tmp_path / "ply" / "b.ply", kind="ply", overwrite=True)
    assert "not this scene's; it is left as it is" in capsys.readouterr().err
    assert (tmp_path / "ply" / "cameras.json").read_text() == "[]"


def test_what_is_refused(uri, tmp_path):
    for out, options, message in (
        ("a.ply", {"kind": "file"}, "is named as --kind ply .* is --kind file: say"),
        ("a.climategs", {"kind": "ply"}, "is named as --kind file .* is --kind ply: say"),
        ("a.splat", {"kind": "scene"}, "is named as --kind splat .* is --kind scene: say"),
        ("a", {"kind": "ply", "frame": 7}, "has no frame 7; it has 4 to 5"),
        ("/", {}, "root"),
    ):
        with pytest.raises(ClimateGSError, match=message):
            export_scene(uri, tmp_path / out, **options)
    assert {Path(name).parent.name for name in names(tmp_path)} == {"scene"}


def test_what_is_there_is_replaced_only_if_wanted(uri, tmp_path):
    for kind, suffix in {"file": "climategs", "ply": "ply", "splat": "splat"}.items():
        path = tmp_path / f"a.{suffix}"
        path.write_text("keep")
        with pytest.raises(OutputError, match=r"is there already: .* --overwrite"):
            export_scene(uri, tmp_path / "a", kind=kind)
        assert path.read_text() == "keep"
        export_scene(uri, tmp_path / "a", kind=kind, overwrite=True)
        assert path.stat().st_size > 1000
        (tmp_path / f"b.{suffix}").mkdir()
        with pytest.raises(OutputError, match="is a folder"):
            export_scene(uri, tmp_path / "b", kind=kind, overwrite=True)
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "holiday.jpg").touch()
    for kind in ("scene", "ply-parts"):
        with pytest.raises(OutputError, match="holds something else"):
            export_scene(uri, tmp_path / "photos", kind=kind, overwrite=True)
    assert names(tmp_path / "photos") == ["holiday.jpg"]


@pytest.mark.long
def test_commands_say_what_is_not_fit_and_leave_out_cameras_that_were_never_fitted(
    tmp_path, capsys
):
    fit = {"scale": 0.1, "views": {"front": [0, 1]}}
    street = dataclasses.replace(open_street(), made_by={"fitted": fit})
    save_scene(street, tmp_path / "fitted")
    uri, out = f"scene:{tmp_path / 'fitted'}", str(tmp_path / "out")
    assert main(["inspect", uri]) == 0
    page = capsys.readouterr().out
    assert "seen        front: 2 images of 96 px along 0.8 m, surfaces within" in page
    assert "not fit     front: rendered 10.0 times as large as it was learnt" in page
    assert "not fit     back: never fitted" in page and "none found" not in page
    render = ["render", "clear", "--scene", uri, "--out", out, "--scale", "0.05", "--frames", "0"]
    assert main([*render, "--no-sheet"]) == 0
    left_out = "left out: front_left, front_right, left, right, back"
    assert f"note: {left_out}" in capsys.readouterr().err
    assert read_manifest(Path(out))["camera"].to_pylist() == ["front"]
    assert main([*render, "--no-sheet", "--cameras", "all"]) == 0
    assert read_manifest(Path(out)).num_rows == 6
    job = tmp_path / "job.yaml"
    job.write_text(f"scenes: ['{uri}']\nrecipes: [clear]\nscale: 0.05\n")
    assert main(["generate", str(job), "--out", f"{out}2", "--executor", "serial"]) == 0
    assert set(read_manifest(Path(f"{out}2"))["camera"].to_pylist()) == {"front"}
