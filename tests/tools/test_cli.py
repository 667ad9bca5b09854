"""The `climategs` command as a user runs it, on a scene small enough to be quick."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import cv2
import pytest
import torch

from augment.dataset import WeatherDataset
from augment.files.ply import write_ply
from augment.scene import Gaussians
from recipes.style import style_preset_names
from tools.cli import main
from tools.render import resolve_recipes

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


def test_a_job_says_at_its_start_that_sweeps_and_depth_differ(tmp_path, capsys):
    scene = "procedural:street?seed=3&frames=1&gaussians=60000&lidar_columns=16"
    (tmp_path / "seen-through.yaml").write_text(
        "weather: {flood: {level_m: 0.3, reflection: sky}}\n"
    )
    asked = [str(tmp_path / "seen-through.yaml"), "--scene", scene, "--out", str(tmp_path / "out")]
    for frames in ([], ["--frames", "0"]):
        assert main(["render", *asked, *frames, "--scale", "0.1"]) == 0
        assert "LiDAR meets the weather: " in capsys.readouterr().err


def test_a_flood_asks_for_metres_and_gravity(scene_uri, tmp_path, capsys):
    bare = scene_uri.split("?")[0] + "?cameras=none"
    out = tmp_path / "out"
    assert main(["render", "street-flood", "--scene", bare, "--out", str(out)]) == 2
    message = capsys.readouterr().err
    assert "up=" in message and "scale=" in message and not out.exists()


def test_render_takes_several_recipes(scene_uri, recipe, tmp_path, capsys):
    out = ["--scene", scene_uri, "--out", str(tmp_path / "out"), "--no-sheet", "--frames", "1"]
    assert main(["render", "clear", recipe, *out, "--variants", "2"]) == 0
    written = {path.parts[-4] for path in (tmp_path / "out").glob("*/*/images/*/*.png")}
    assert written == {"clear-000", "clear-001", "fog-000", "fog-001"}
    (tmp_path / "others").mkdir()
    other = shutil.copy(recipe, tmp_path / "others")
    for again in (recipe, str(other)):
        assert main(["render", recipe, again, *out]) == 2
        assert f"{recipe} and {again} are both called 'fog'" in capsys.readouterr().err


def test_render_takes_selections_and_scale(scene_uri, recipe, tmp_path):
    out = tmp_path / "out"
    arguments = ["render", recipe, "--scene", scene_uri, "--out", str(out), "--variants", "1"]
    assert main([*arguments, "--frames", "1", "--scale", "0.5", "--no-sheet"]) == 0
    (image,) = out.glob("*/*/images/*/*.png")
    assert image.stem.endswith("1") and cv2.imread(str(image)).shape == (12, 16, 3)


def test_a_failing_image_gives_exit_code_1(scene_uri, recipe, tmp_path, monkeypatch, capsys):
    import augment.views

    real = augment.views.render_view

    def breaks_on_the_second_frame(scene, camera, recipe, *, backend):
        if camera.timestamp_ns > 0:
            raise RuntimeError("no light")
        return real(scene, camera, recipe, backend=backend)

    monkeypatch.setattr(augment.views, "render_view", breaks_on_the_second_frame)
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


def test_explain_names_every_pass(scene_uri, recipe, tmp_path, capsys):
    target = tmp_path / "plan.json"
    assert main(["explain", recipe, "--scene", scene_uri, "--json", str(target)]) == 0
    text = capsys.readouterr().out
    assert "runs   smog per Gaussian" in text and "skips  sky" in text
    facts = json.loads(target.read_text())
    assert facts["variants"] == 2
    assert 5 <= facts["recipe"]["weather"]["smog"]["visibility_m"] <= 50


def test_recipes_lists_prints_and_exports(tmp_path, capsys):
    assert main(["recipes"]) == 0
    assert "dense-fog" in capsys.readouterr().out.split()
    assert main(["recipes", "dense-fog"]) == 0
    assert "visibility_m" in capsys.readouterr().out
    schema = tmp_path / "schema.json"
    assert main(["recipes", "--schema", str(schema)]) == 0
    assert "weather" in json.loads(schema.read_text())["properties"]


def test_mistakes_exit_with_2_and_one_message(scene_uri, tmp_path, capsys):
    out = ["--out", str(tmp_path / "out")]
    here = ["render", "clear", "--scene", scene_uri, *out]
    for arguments, message in (
        (["render", "--scene", scene_uri, *out], "no recipe is named"),
        (["render", "no-such", "--scene", scene_uri, *out], "no such file"),
        (["render", "clear", "--scene", "nowhere:x", *out], "nowhere"),
        ([*here, "--frames", "x"], "--frames 'x'"),
        ([*here, "--frames", "9"], "no frame 9"),
        ([*here, "--cameras", "q"], "no camera q"),
        ([*here, "--scale", "99"], "a scale of 99"),
        ([*here, "--scale", "nan"], "--scale must be a finite number; got nan"),
        ([*here, "--variants", "0"], "--variants must be greater than or equal to 1; got 0"),
        ([*here, "--workers", "0"], "--workers must be"),
        (["explain", "clear", "--scene", scene_uri, "--variant", "9"], "clear has one variant, 0"),
        (["evaluate", out[1], "--short", "7"], "--long must be above --short 7; got 7"),
        (["export", scene_uri, *out, "--frame", "4"], "--frame is for ply and splat"),
        (["export", scene_uri, *out, "--kind", "ply", "--half"], "--half is for a single scene"),
        (["sheet", out[1]], "manifest.parquet does not exist"),
        (["inspect", scene_uri, "--json", "/nowhere/facts.json"], "cannot write /nowhere/facts"),
        (["style", "presets", "dawn-mits"], "dawn-mist"),
        (["style", "train", *out], "there is nothing to learn from"),
        (["style", "apply", "procedural:street", "dsuk", *out], "dusk"),
        (["generate", "job.yaml"], "--out is missing"),
        (["generate", *out], "no job file is named"),
        (["generate", "job.yaml", *out], "no such file; a job is a YAML file"),
        (["generate", *out, "--status"], "no job has been started there"),
        (["generate", "--out", "ftp://x/y", "--status"], "ftp"),
    ):
        assert main(arguments) == 2
        error = capsys.readouterr().err
        assert message in error and "Traceback" not in error
    for arguments in (
        ["render", "clear", "--scene", "procedural:street", "--out", "s3://bucket/path"],
        ["sheet", "s3://bucket/path"],
        ["mirror", "gs://bucket/path"],
    ):
        assert main(arguments) == 2
        assert "is not on this machine" in capsys.readouterr().err


def test_style_presets_are_listed_and_printed(capsys):
    assert main(["style", "presets"]) == 0
    assert tuple(capsys.readouterr().out.split()) == style_preset_names()
    assert main(["style", "presets", "dusk"]) == 0
    assert "covariance:" in capsys.readouterr().out
    with pytest.raises(SystemExit, match="2"):
        main(["style"])
    assert "{apply, train, presets}" in capsys.readouterr().err


def test_a_defect_keeps_its_traceback(monkeypatch):
    from tools import cli

    def broken() -> int:
        raise ZeroDivisionError("a defect")

    monkeypatch.setitem(cli.COMMANDS, "recipes", broken)
    with pytest.raises(ZeroDivisionError):
        main(["recipes"])


def test_scale_is_recorded_in_the_recipe(recipe):
    (half, _) = resolve_recipes([recipe], scale=0.5)
    (whole, _) = resolve_recipes([recipe])
    assert half.render.scale == 0.5 and half.hash != whole.hash
    assert half.weather == whole.weather


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
