import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

from adapters.base import open_scene
from adapters.scene_cache import scene_digest
from adapters.tracks_file import other_scenes, with_tracks
from augment.errors import AdapterError, ClimateGSError
from augment.output.manifest import read_manifest
from augment.scene.moved_actors import RECORDED_SWEEPS
from augment.scene.scene import Scene
from tests.streets import LABELLED_STREET, open_street
from tools.cli import GenerateOptions, RenderOptions
from tools.options import with_tracks_key

CAR = "car-0"
PERSON = "pedestrian-0"
POSES = [{"time_s": 0.0, "position_m": [9.0, -1.5, 0.8], "yaw_deg": 30.0}]
FILE = {
    "move": [{"track_id": CAR, "poses": POSES}],
    "remove": [{"track_id": PERSON}],
    "add": [
        {"track_id": "behind", "copy_of": CAR, "shift_m": [-9.0, 0.0, 0.0]},
        {
            "track_id": "stranger",
            "copy_of": "car-1",
            "scene": LABELLED_STREET.replace("seed=3", "seed=4").replace("moving=1", "moving=2"),
            "poses": POSES,
            "hold_s": 5.0,
        },
    ],
}


def write(path: Path, content: object) -> Path:
    path.write_text(json.dumps(content))
    return path


def moved(scene: Scene, path: Path, scene_path: str = "street") -> Scene:
    return with_tracks(scene, path, scene_path, open_street)


def test_a_file_moves_removes_and_adds_actors(tmp_path: Path) -> None:
    scene = open_street(LABELLED_STREET)
    changed = moved(scene, write(tmp_path / "t.json", FILE))
    assert [actor.track_id for actor in changed.actors] == [CAR, PERSON, "behind", "stranger"]
    time_ns = scene.frames[0].timestamp_ns
    poses = changed.poses_at(time_ns)
    assert sorted(poses) == [1, 3, 4]
    assert np.allclose(poses[1][:3, 3] + scene.world_origin_m, POSES[0]["position_m"])
    assert np.allclose(poses[1][:2, 0], [np.cos(np.pi / 6), np.sin(np.pi / 6)])
    recorded = scene.poses_at(time_ns)[1]
    assert np.allclose(
        poses[3], recorded @ np.array([[1, 0, 0, -9.0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]])
    )
    assert set(changed.boxes(0).track_ids) == {CAR, "behind", "stranger", "parked-0"}
    assert changed.poses_at(time_ns + 1_000_000_000).keys() == {4}
    assert any("1 moved, 1 removed, 2 added" in problem for problem in changed.problems)
    assert "tracks=" in changed.source


def test_the_digest_of_a_scene_is_of_the_file_too(tmp_path: Path) -> None:
    path = write(tmp_path / "t.json", FILE)
    uri = with_tracks_key(LABELLED_STREET, path)
    first = scene_digest(uri)
    assert first is not None and first != scene_digest(LABELLED_STREET)
    write(path, {"remove": [{"track_id": CAR}]})
    assert scene_digest(uri) not in (first, None)
    write(path, FILE)
    assert scene_digest(uri) == first


def test_another_scene_without_a_scheme_keeps_its_options(tmp_path: Path) -> None:
    splats = tmp_path / "other.ply"
    splats.write_bytes(b"ply\nformat binary_little_endian 1.0\n")
    added = {"track_id": "a", "copy_of": CAR, "poses": POSES, "scene": "other.ply?up=-y"}
    uris = list(other_scenes(write(tmp_path / "t.json", {"add": [added]}), "street"))
    assert uris == [f"gaussians:{splats}?up=-y"]


def test_files_that_cannot_be_used_are_refused_in_words(tmp_path: Path) -> None:
    scene = open_street(LABELLED_STREET)
    path = tmp_path / "t.json"
    outside = tmp_path.parent / "elsewhere"
    outside.mkdir(exist_ok=True)
    (tmp_path / "nothing").mkdir()
    still = {"time_s": 0, "position_m": [0, 0, 0]}
    added = {"track_id": "a", "copy_of": CAR, "poses": POSES}

    def move(**fields: object) -> dict[str, object]:
        return {"move": [{"track_id": CAR, **fields}]}

    refusals: list[tuple[object, str]] = [
        ({"remove": [{"track_id": "nobody"}]}, "no actor 'nobody'"),
        ({"remove": [{"track_id": "parked-0"}]}, "part of the background"),
        ({}, "lists are empty"),
        ({"moved": []}, "moved"),
        (move(), "poses or shift_m"),
        (move(poses=POSES, shift_m=[0, 0, 0]), "poses or shift_m"),
        (move(poses=[]), "at least 1"),
        (move(poses=[{**POSES[0], "time_s": float("nan")}]), "finite"),
        (move(poses=[{**POSES[0], "position_m": [0, float("inf"), 0]}]), "finite"),
        (move(poses=[{**POSES[0], "position_m": [1e9, 0, 0]}]), "within|less than"),
        (move(poses=[still]), "yaw_deg or quat_wxyz"),
        (move(poses=[{**still, "quat_wxyz": [1, 1, 0, 0]}]), "length 1"),
        (move(poses=[POSES[0], POSES[0]]), "must increase"),
        ({"add": [added, added]}, "stands twice"),
        ({"add": [{**added, "track_id": CAR}]}, "two actors would be called"),
        ({"add": [added], "remove": [{"track_id": "a"}]}, "stands twice"),
        ({"add": [{**added, "copy_of": "nobody"}]}, "no actor 'nobody'"),
        ({"add": [{**added, "scene": "../elsewhere"}]}, "lies outside of"),
        ({"add": [{**added, "scene": "scene:/etc/passwd"}]}, "lies outside of"),
        ({"add": [{**added, "scene": "not-there"}]}, "there is no"),
        ({"add": [{**added, "scene": f"{LABELLED_STREET}&tracks=t.json"}]}, "moved actors itself"),
        ({"add": [{**added, "scene": "scene:.?data=/etc/passwd"}]}, "option data may name a file"),
        ({"add": [{**added, "scene": "nothing"}]}, "Looked for"),
        (
            {"add": [{**added, "scene": LABELLED_STREET.replace("moving=1", "moving=0")}]},
            f"no actor '{CAR}'",
        ),
        (
            {"add": [{**added, "poses": None, "shift_m": [1, 0, 0], "scene": LABELLED_STREET}]},
            "must have poses",
        ),
        ([], "an object"),
    ]
    for content, words in refusals:
        with pytest.raises(AdapterError, match=words):
            moved(scene, write(path, content))
    with pytest.raises(AdapterError, match="no such file"):
        moved(scene, tmp_path / "missing.json")
    path.write_text('{"remove": [], "remove": []}')
    with pytest.raises(AdapterError, match="2 entries 'remove'"):
        moved(scene, path)


def test_an_actor_of_a_scene_without_actors_or_of_another_unit_is_refused(tmp_path: Path) -> None:
    scene = open_street(LABELLED_STREET)
    content = {
        "add": [{"track_id": "a", "copy_of": "car-9", "poses": POSES, "scene": LABELLED_STREET}]
    }
    path = write(tmp_path / "t.json", content)
    empty = dataclasses.replace(scene, actors=())
    with pytest.raises(AdapterError, match="it has none"):
        with_tracks(scene, path, "street", lambda uri: empty)
    unknown = dataclasses.replace(scene, has_metric_scale=False)
    with pytest.raises(AdapterError, match="not known to be a metre"):
        with_tracks(scene, path, "street", lambda uri: unknown)


@pytest.mark.long
def test_render_and_generate_write_moved_labels_and_say_so(tmp_path: Path) -> None:
    path = write(tmp_path / "t.json", FILE)
    recipe = tmp_path / "labelled.yaml"
    recipe.write_text("name: labelled\noutput: {lidar: true, labels: true, instance: true}\n")
    rendered = tmp_path / "rendered"
    options = {
        "recipes": (str(recipe),),
        "scene": LABELLED_STREET,
        "frames": "0",
        "cameras": "front",
    }
    assert RenderOptions(**options, out=rendered, tracks=path, sheet=False).run() == 0
    rows = read_manifest(rendered).to_pylist()
    assert [row["lidar_note"] for row in rows] == [RECORDED_SWEEPS]
    assert "tracks=" in rows[0]["source"]
    # Images of the scene as it was recorded do not go into the same output.
    with pytest.raises(ClimateGSError):
        RenderOptions(**options, out=rendered, sheet=False).run()
    job = tmp_path / "job.yaml"
    job.write_text(
        f"scenes:\n  - uri: '{LABELLED_STREET}'\n    frames: '0'\n    cameras: [front]\n"
        f"recipes: [labelled.yaml]\n"
    )
    generated = tmp_path / "generated"
    assert GenerateOptions(job=job, out=str(generated), executor="serial", tracks=path).run() == 0
    again = read_manifest(generated).to_pylist()
    assert again[0]["checksum"] == rows[0]["checksum"]
    assert open_scene(with_tracks_key(LABELLED_STREET, path)).boxes(0).track_ids
