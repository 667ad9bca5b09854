"""`--layout source`: what is checked before rendering, what is said, and copies of many scenes."""

from __future__ import annotations

import dataclasses
import json
import os
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from adapters.dataset import fixed_tree
from adapters.datasets import DATASETS
from augment.effects.lidar import drop_lost_returns
from augment.errors import AdapterError, ClimateGSError, OutputError
from augment.jobs.mirror_sweeps import find_span_frames
from augment.jobs.render_job import RenderJob, run_job
from augment.output.tables import read_lidar
from augment.scene.labels import LidarSweep
from augment.scene.scene import Scene
from augment.view.weathered_sweep import weathered_sweep
from recipes.flood import Flood
from tests.augment.batch_scenes import SIZE, FakeLabels, fake_render, make_recipe, open_fake
from tests.augment.mirror_trees import contents
from tools import render as render_tools
from tools.cli import RenderOptions
from tools.mirror import clear_notes, mirror_again, mirror_outputs, recipes_for_source

CAMERAS = {"front": "front", "rear/left": "left"}
FRAMES = 4


def write_sequence(root: Path, suffix: str = "jpg", size: tuple[int, int] = SIZE) -> Path:
    """The images of a PandaSet sequence: enough to be copied, too little to be opened."""
    for folder in CAMERAS.values():
        (root / "camera" / folder).mkdir(parents=True)
        for frame in range(FRAMES):
            image = np.full((*size[::-1], 3), 40 * frame, np.uint8)
            cv2.imwrite(str(root / "camera" / folder / f"{frame:02d}.{suffix}"), image)
    (root / "lidar").mkdir()
    (root / "lidar" / "poses.json").write_text("[]")
    return root


def scene_of(root: Path, name: str = "street", frames: tuple[int, ...] = (0, 1, 2, 3)) -> Scene:
    """A scene of some frames of the sequence."""
    scene = open_fake(f"fake:{name}")
    chosen = [
        dataclasses.replace(
            scene.frame(number),
            image_paths={
                camera: str(root / "camera" / folder / f"{number:02d}.jpg")
                for camera, folder in CAMERAS.items()
            },
        )
        for number in frames
    ]
    source = f"pandaset:{root}?scene={name}"
    return dataclasses.replace(scene, source=source, frames=tuple(chosen))


def recipe_of(name: str = "fog", **options):
    return make_recipe(
        name, semantic=False, instance=False, depth="none", lidar=False, labels=False, **options
    )


def render(scene: Scene, out: Path, recipe=None, **selection) -> None:
    recipe = recipe or recipes_for_source(scene, out, [recipe_of()])[0]
    job = RenderJob(scene.source, [recipe], out, **selection)
    run_job(job, scene_loader=lambda _: scene, renderer=fake_render, progress=False)


def changed(root: Path, copy: Path) -> set[str]:
    a, b = contents(root), contents(copy)
    assert a.keys() == b.keys()
    return {name for name in a if a[name] != b[name]}


@pytest.fixture
def root(tmp_path) -> Path:
    return write_sequence(tmp_path / "002")


def test_images_of_another_size_are_compressed_once(root, tmp_path):
    scene, out = scene_of(root), tmp_path / "out"
    half = recipe_of(image="jpg")
    half = half.model_copy(update={"render": half.render.model_copy(update={"scale": 0.5})})
    (recipe,) = recipes_for_source(scene, out, [half])
    assert recipe.output.image == "png"
    render(scene, out, recipe, frames=[0], cameras=["front"])
    said = mirror_outputs(scene, out, progress=False)
    assert any("1 were rendered at another size" in sentence for sentence in said)
    assert changed(root, out / "source/fog-000/002") == {"camera/front/00.jpg"}
    (image,) = (out / scene.name / "fog-000/images/front").iterdir()
    assert image.suffix == ".png"
    assert recipes_for_source(scene, out, [half]) == [recipe]  # and they go on from there


def test_what_is_shared_and_what_stays_clear_is_said(root, tmp_path):
    scene, out = scene_of(root), tmp_path / "out"
    render(scene, out, frames=[1, 2], cameras=["front"])
    said = mirror_outputs(scene, out, progress=False)
    copy = out / "source/fog-000/002"
    assert str(copy) in said[0] and "9 files put in place" in said[0]
    assert "2 of 8 camera images are weathered; 6 stay clear" in said[1]
    assert f"7 files are shared with {root}" in said[2]
    assert changed(root, copy) == {"camera/front/01.jpg", "camera/front/02.jpg"}
    again = mirror_outputs(scene, out, links="copy", progress=False)
    assert "9 files put in place" in again[0] and "7 files are copies" in again[2]
    assert "(up to date)" in mirror_outputs(scene, out, progress=False)[0]


def test_images_in_another_format_are_not_rendered_twice(root, tmp_path):
    scene, out = scene_of(root), tmp_path / "out"
    render(scene, out, recipe_of(), frames=[0])
    with pytest.raises(OutputError, match=r"images as png, and they would be rendered as jpg"):
        recipes_for_source(scene, out, [recipe_of()])
    recipes_for_source(scene, out, [recipe_of()], overwrite=True)
    # What it advises: the copy is made from what is there.
    mirror_outputs(scene, out, progress=False)
    copy = out / "source/fog-000/002"
    assert changed(root, copy) == {"camera/front/00.jpg", "camera/left/00.jpg"}
    assert (copy / "camera/front/00.jpg").read_bytes()[:2] == b"\xff\xd8"
    # A record names no files outside: images of other scenes count as the manifest knows them.
    path = out / "source/fog-000/climategs-mirror-002.json"
    record = json.loads(path.read_text())
    for place in ("camera/front/03.jpg", "../../secret"):
        record["replaced"][place] = {"scene": "x", "image": "../../../etc/passwd", "sha256": ""}
    path.write_text(json.dumps(record))
    mirror_outputs(scene, out, progress=False)
    assert len(changed(root, copy)) == 2
    for text in ("{", "[]", '{"scenes": {}, "replaced": {"a": {}}, "folder": ""}'):
        path.write_text(text)
        with pytest.raises(OutputError, match=r"climategs-mirror-002\.json is damaged"):
            mirror_outputs(scene, out, progress=False)


@dataclasses.dataclass(frozen=True)
class Sweeps(FakeLabels):
    """The sweeps of FakeLabels in files of their own: float64 x y z, and intensities in others."""

    root: Path = Path()

    def lidar_files(self, frame_index: int) -> tuple[Path, ...]:
        files = (self.root / f"{kind}/{frame_index:02d}.bin" for kind in ("lidar", "intensity"))
        return tuple(file for file in files if file.exists())

    def lidar_content(self, frame_index: int, file: Path, sweep: LidarSweep) -> bytes:
        if file.parent.name == "intensity":
            return np.asarray(sweep.columns["intensity"]).tobytes()
        return sweep.points_m.tobytes()


def with_sweeps(root: Path, name: str = "street", frames: tuple[int, ...] = (0, 1, 2)) -> Scene:
    labels = Sweeps(root=root)
    for frame in frames:
        for kind in ("lidar", "intensity"):
            (root / kind).mkdir(exist_ok=True)
            (root / kind / f"{frame:02d}.bin").write_bytes(b"recorded")
    return dataclasses.replace(scene_of(root, name, frames), labels=labels)


@pytest.fixture
def bin_sweeps(monkeypatch):
    """The little sequence's sweeps are no pickles."""
    tree = fixed_tree(r"camera/[^/]+/\d+\.jpg", r"lidar/\d+\.bin")
    dataset = dataclasses.replace(DATASETS["pandaset"], source_tree=tree)
    monkeypatch.setitem(DATASETS, "pandaset", dataset)


FLOOD = Flood(level_m=0.0, reference="absolute", turbidity_ntu=0)  # loses what is deep in it
WET = {"flood": FLOOD, "semantic": False, "instance": False, "depth": "none", "image": "jpg"}
LIDAR_FILES = {f"{kind}/{frame:02d}.bin" for kind in ("lidar", "intensity") for frame in range(3)}


def lidar_line(said: list[str]) -> str:
    (line,) = (sentence for sentence in said if "LiDAR sweeps" in sentence)
    return line.strip()


def test_weathered_sweeps_stand_in_the_copy(root, tmp_path, bin_sweeps):
    scene, out = with_sweeps(root), tmp_path / "out"
    copy = out / "source/wet-000/002"
    before = contents(root)
    render(scene, out, make_recipe("wet", **WET), frames=[0, 2], cameras=["front"])
    said = mirror_outputs(scene, out, progress=False)
    assert lidar_line(said) == (
        "2 of 3 LiDAR sweeps are weathered, lost returns left out; 1 stay clear, as recorded"
    )
    lidar = {place for place in changed(root, copy) if place.endswith(".bin")}
    assert lidar == {place for place in LIDAR_FILES if "01" not in place}
    for frame in (0, 2):
        sweep = drop_lost_returns(read_lidar(out / f"street/wet-000/lidar/{frame:06d}.parquet"))
        assert 0 < len(sweep) < 50
        assert (copy / f"lidar/{frame:02d}.bin").read_bytes() == sweep.points_m.tobytes()
        intensity = sweep.columns["intensity"].tobytes()
        assert (copy / f"intensity/{frame:02d}.bin").read_bytes() == intensity
    assert (copy / "lidar/01.bin").samefile(root / "lidar/01.bin")
    assert "(up to date)" in mirror_outputs(scene, out, progress=False)[0]
    # Sweeps that are rendered clean give way to the recorded ones.
    clean = make_recipe("wet", lidar=True, **WET)
    render(scene, out, clean, frames=[0, 2], cameras=["front"], overwrite=True)
    assert lidar_line(mirror_outputs(scene, out, progress=False)) == (
        "0 of 3 LiDAR sweeps are weathered; 3 stay clear, as recorded"
    )
    assert not changed(root, copy) & LIDAR_FILES and contents(root) == before
    # A dataset without files for them.
    bare = dataclasses.replace(scene_of(root), labels=FakeLabels())
    render(bare, tmp_path / "bare", make_recipe("wet", **WET), frames=[1, 2])
    said = mirror_outputs(bare, tmp_path / "bare", progress=False)
    assert "2 weathered LiDAR sweeps, the first of frame 1, have no file of their own" in said[-1]


class Relabelled(Sweeps):
    """Sweeps in files whose further contents are the source's."""

    def lidar_content(self, frame_index: int, file: Path, sweep: LidarSweep) -> bytes:
        return file.read_bytes() + super().lidar_content(frame_index, file, sweep)


def test_new_labels_of_the_source_come_into_weathered_sweeps(root, tmp_path, bin_sweeps):
    """Of the same size and time too; other changes of the file's facts are none of its labels."""
    one, two = with_sweeps(root, "one", (0, 1)), with_sweeps(root, "two", (2,))
    one, two = (dataclasses.replace(each, labels=Relabelled(root=root)) for each in (one, two))
    out, copy = tmp_path / "out", tmp_path / "out/source/wet-000/002"
    for scene in (one, two):
        render(scene, out, make_recipe("wet", **WET))
        mirror_outputs(scene, out, progress=False)
    label = root / "lidar/00.bin"
    time_ns = label.stat().st_mtime_ns
    label.chmod(0o600)
    assert "(up to date)" in mirror_outputs(two, out, progress=False)[0]
    label.write_bytes(b"reviewed")
    os.utime(label, ns=(time_ns, time_ns))
    said = mirror_outputs(two, out, progress=False)  # knows nothing of the other's labels
    assert "1 files of LiDAR of other scenes are out of date" in "\n".join(said)
    assert "(1 files put in place)" in mirror_outputs(one, out, progress=False)[0]
    assert (copy / "lidar/00.bin").read_bytes().startswith(b"reviewed")
    assert (copy / "lidar/01.bin").read_bytes().startswith(b"recorded")
    with pytest.raises(OutputError, match=r"1 file is not what was put .*lidar/01\.bin"):
        (copy / "lidar/01.bin").write_bytes(b"edited")
        mirror_outputs(one, out, progress=False)


def test_scenes_of_one_dataset_keep_each_others_sweeps(root, tmp_path, bin_sweeps):
    one, two = with_sweeps(root, "one", (0, 1)), with_sweeps(root, "two", (2,))
    out, copy = tmp_path / "out", tmp_path / "out/source/wet-000/002"
    wet = make_recipe("wet", **WET)
    for scene in (one, two):
        render(scene, out, wet)
        said = mirror_outputs(scene, out, progress=False)
    assert lidar_line(said) == "3 of 3 LiDAR sweeps are weathered, lost returns left out"
    assert changed(root, copy) & LIDAR_FILES == LIDAR_FILES
    render(one, out, wet, overwrite=True)
    said = mirror_outputs(two, out, progress=False)
    assert lidar_line(said).startswith("1 of 3 LiDAR sweeps are weathered")
    assert "4 files of LiDAR of other scenes are out of date" in "\n".join(said)
    said = mirror_outputs(one, out, progress=False)
    assert lidar_line(said).startswith("3 of 3") and "out of date" not in "\n".join(said)


def with_gap(scene: Scene, number: int) -> Scene:
    """The scene without images of one frame."""
    frames = [
        dataclasses.replace(frame, cameras={}, image_paths={}) if frame.index == number else frame
        for frame in scene.frames
    ]
    return dataclasses.replace(scene, frames=tuple(frames))


def test_sweeps_between_images_have_the_weather_too(root, tmp_path, bin_sweeps):
    """A LiDAR turns more often than cameras look; clouds of several sweeps show one weather."""
    one = with_gap(with_sweeps(root, "one", (0, 1)), 1)
    two = with_sweeps(root, "two", (2,))
    out, copy = tmp_path / "out", tmp_path / "out/source/wet-000/002"
    wet = make_recipe("wet", **WET)
    render(one, out, wet)
    assert lidar_line(mirror_outputs(one, out, progress=False)).startswith("2 of 3 LiDAR sweeps")
    expected = drop_lost_returns(weathered_sweep(one, wet, 1, one.lidar(1)))
    assert (copy / "lidar/01.bin").read_bytes() == expected.points_m.tobytes()
    before = contents(copy)
    assert "(up to date)" in mirror_outputs(one, out, progress=False)[0]
    # Another scene's run keeps it, though the manifest has no image with that sweep.
    render(two, out, wet)
    said = mirror_outputs(two, out, progress=False)
    assert lidar_line(said) == "3 of 3 LiDAR sweeps are weathered, lost returns left out"
    assert (copy / "lidar/01.bin").read_bytes() == before["lidar/01.bin"]
    damaged = out / "one/wet-000/lidar/000001.parquet"
    damaged.write_bytes(b"half")
    mirror_outputs(one, out, progress=False)
    assert (copy / "lidar/01.bin").read_bytes() == before["lidar/01.bin"]


def test_the_span_has_the_frames_between_rendered_ones():
    scene = open_fake("fake:street")
    pictured, empty = scene.frames[0], dataclasses.replace(scene.frames[0], cameras={})
    frames = [dataclasses.replace(pictured if n % 2 else empty, index=n) for n in range(7)]
    for rendered, span in (
        ((1, 3, 5), (0, 1, 2, 3, 4, 5, 6)),
        ((1, 3), (0, 1, 2, 3)),
        ((3,), (3,)),
        ((1, 5), (0, 1, 5, 6)),
        ((), ()),
    ):
        assert tuple(find_span_frames(frames, rendered, pictured.cameras)) == span


def test_what_will_stay_clear_is_said_before(root, bin_sweeps):
    scene = with_gap(with_sweeps(root, "one", (0, 1, 2)), 1)
    (note,) = clear_notes(scene, of_sweeps=True)
    assert note.startswith("4 of 8 camera images") and "4 that no frame of scene 'one'" in note
    images, sweeps = clear_notes(scene, {0, 1}, ["front"], of_sweeps=True)
    assert images.startswith("7 of 8 camera images") and "4 that no frame of scene 'one'" in images
    assert "3 of frames or cameras that are not rendered" in images
    assert sweeps.startswith("2 of 3 LiDAR") and "2 of frames or cameras that are not" in sweeps
    unlike = dataclasses.replace(scene, labels=FakeLabels())
    assert clear_notes(unlike, of_sweeps=True)[1].startswith("no LiDAR sweep has a file of its own")
    whole = with_sweeps(root, frames=(0, 1, 2, 3))
    assert clear_notes(whole, of_sweeps=True) == []


def test_a_deleted_variant_does_not_stop_the_others(root, tmp_path):
    scene, out = scene_of(root), tmp_path / "out"
    for name in ("fog", "haze"):
        render(scene, out, recipe_of(name, image="jpg"), frames=[0])
    mirror_outputs(scene, out, progress=False)
    shutil.rmtree(out / "street/fog-000")
    said = mirror_outputs(scene, out, progress=False)
    assert f"{out / 'street/fog-000'} was deleted" in said[0] and "render it again" in said[0]
    assert "haze-000/002 (up to date)" in said[1]
    for variants in (None, ["fog-000", "haze-000"]):
        if variants is None:
            shutil.rmtree(out / "street/haze-000")
        with pytest.raises(OutputError, match=r"fog-000.* was deleted, .*; render it again"):
            mirror_outputs(scene, out, variants=variants or ["fog-000"], progress=False)
    with pytest.raises(OutputError, match=r"recipe\.yaml was deleted"):
        mirror_outputs(scene, out, progress=False)


def test_scenes_of_one_dataset_share_a_copy(root, tmp_path):
    """As the scenes of nuScenes, whose loader takes the dataset as a whole."""
    one, two = scene_of(root, "one", (0, 1)), scene_of(root, "two", (2,))
    out, copy = tmp_path / "out", tmp_path / "out/source/fog-000/002"
    render(one, out)
    mirror_outputs(one, out, progress=False)
    render(two, out)
    said = mirror_outputs(two, out, progress=False)
    whole = {f"camera/{c}/{f:02d}.jpg" for c in CAMERAS.values() for f in (0, 1, 2)}
    assert changed(root, copy) == whole
    assert "(2 files put in place)" in said[0] and said[1].startswith("  6 of 8 camera")
    record = json.loads((out / "source/fog-000/climategs-mirror-002.json").read_text())
    assert sorted(record["scenes"]) == ["one", "two"]
    assert record["scenes"]["one"]["source"] == one.source
    # Neither scene's next run gives up the other's.
    assert "(up to date)" in mirror_outputs(one, out, progress=False)[0]
    assert changed(root, copy) == whole
    # Images of a deleted scene give way to recorded ones.
    shutil.rmtree(out / "one")
    said = mirror_outputs(two, out, progress=False)
    assert "4 images of other scenes, such as camera/front/00.jpg, are no longer in" in said[-1]
    assert (copy / "camera/front/00.jpg").samefile(root / "camera/front/00.jpg")


def test_making_the_copy_again_by_itself(root, tmp_path, monkeypatch, capsys):
    scene, out = scene_of(root), tmp_path / "out"
    render(scene, out, frames=[0])
    other = scene_of(root, "other", frames=(3,))
    opened = []

    def opened_scene(uri: str) -> Scene:
        opened.append(uri)
        return scene if uri == scene.source else other

    monkeypatch.setattr("tools.mirror.open_scene", opened_scene)
    assert mirror_again(out) == 0
    assert opened == [scene.source]
    assert str(out / "source/fog-000/002") in capsys.readouterr().out
    render(other, out)
    assert mirror_again(out) == 0
    assert opened[1:] == sorted([scene.source, other.source])
    said = capsys.readouterr().out
    assert said.count("dataset: ") == 2 and "4 of 8 camera images are weathered" in said
    assert mirror_again(out, scene.source, links="copy") == 0
    assert opened[3:] == [scene.source]
    # A scene that a job has renamed.
    renamed = tmp_path / "renamed"
    render(dataclasses.replace(scene, name="drive-7"), renamed, frames=[0])
    assert mirror_again(renamed) == mirror_again(renamed, scene.source) == 0
    assert changed(root, renamed / "source/fog-000/002")


def test_wrong_scenes_and_folders_are_refused(root, tmp_path):
    scene, out = scene_of(root), tmp_path / "out"
    render(scene, out, frames=[0])
    other = scene_of(root, "other")
    elsewhere = dataclasses.replace(scene, source=f"{scene.source}&frames=0:2")
    named = scene_of(root, "source")
    render(named, tmp_path / "named", frames=[0])
    render(scene, tmp_path / "path", camera_path=scene.frames[:1])
    for wrong_scene, folder, variants, message in (
        (other, out, None, "has no images of scene 'other'"),
        (scene, out, ["fog-000", "snow-000"], "has no images of scene 'street' and snow-000"),
        (elsewhere, out, None, r"was rendered from .*, not from .*frames=0:2"),
        (scene, tmp_path / "nothing", None, "is no finished output folder"),
        (named, tmp_path / "named", None, "has images of a scene called 'source'"),
        (scene, tmp_path / "path", None, "shows a camera path"),
    ):
        with pytest.raises(OutputError, match=message):
            mirror_outputs(wrong_scene, folder, variants=variants, progress=False)
    mirror_outputs(scene, out, progress=False)
    namesake = scene_of(write_sequence(tmp_path / "more" / "002"), "other")
    for wrong_scene, folder, message in (
        (scene, root / "out", "lies in the dataset's own folder"),
        (namesake, out, r"is the copy of .*/002, not of .*/more/002: choose"),
    ):
        with pytest.raises(OutputError, match=message):
            recipes_for_source(wrong_scene, folder, [recipe_of()])


def test_a_dataset_that_has_moved_is_taken(root, tmp_path):
    scene, out = scene_of(root), tmp_path / "out"
    render(scene, out, frames=[0])
    moved = scene_of(root.rename(tmp_path / "moved"))
    (first, *others) = moved.frames
    cameras = {
        name: dataclasses.replace(camera, timestamp_ns=camera.timestamp_ns + 1)
        for name, camera in first.cameras.items()
    }
    late = dataclasses.replace(moved, frames=(dataclasses.replace(first, cameras=cameras), *others))
    with pytest.raises(OutputError, match=r"was rendered from .*/002.*, or the same one where"):
        mirror_outputs(late, out, progress=False)
    mirror_outputs(moved, out, progress=False)
    assert changed(tmp_path / "moved", out / "source/fog-000/moved") == {
        "camera/front/00.jpg",
        "camera/left/00.jpg",
    }


def test_render_takes_the_layout(root, tmp_path, monkeypatch, capsys):
    """`climategs render --layout source`, with a stand-in for opening and rendering."""
    scene, out = scene_of(root), tmp_path / "out"
    fog = tmp_path / "fog.yaml"
    fog.write_text(
        "weather: {smog: {visibility_m: 50}}\noutput: {depth: none, lidar: false, labels: false}\n"
    )

    def job(what, *, scene_loader):
        return run_job(what, scene_loader=scene_loader, renderer=fake_render, progress=False)

    monkeypatch.setattr(render_tools, "open_scene", lambda _: scene)
    monkeypatch.setattr(render_tools, "run_job", job)
    monkeypatch.setattr(render_tools, "warm_up", lambda *_: None)
    asked = {"recipes": (str(fog),), "scene": "", "out": out, "sheet": False, "layout": "source"}
    assert RenderOptions(**asked, scale=0.5, frames="1:3").run() == 0
    said = capsys.readouterr().out
    assert f"dataset: {out / 'source/fog-000/002'}" in said
    assert "  4 were rendered at another size and resized, such as 12x8 to 24x16 pixels" in said
    assert len(changed(root, out / "source/fog-000/002")) == 4
    assert sorted(path.suffix for path in (out / "street").rglob("00000?.*")) == [".png"] * 4
    path = tmp_path / "path.json"
    with pytest.raises(ClimateGSError, match=r"--camera-path .*path\.json shows frames that"):
        RenderOptions(**asked, camera_path=path).run()
    monkeypatch.setattr(render_tools, "open_scene", lambda _: open_fake("fake:street"))
    with pytest.raises(AdapterError, match="has no dataset's folder"):
        RenderOptions(**asked).run()
