"""Scene URIs: parsing and its inverse, dispatch, recognition, and what is said if nothing fits."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from splat_scenes import street

from adapters.base import open_scene, recognise
from adapters.uri import format_uri, parse_uri
from augment.errors import AdapterError
from augment.files.ply import write_ply, write_splat


@pytest.mark.parametrize(
    ("uri", "expected"),
    [
        ("procedural:street?seed=3", ("procedural", "street", {"seed": "3"})),
        ("procedural:street", ("procedural", "street", {})),
        ("gaussians:/b.ply?up=+z&scale=1", ("gaussians", "/b.ply", {"up": "+z", "scale": "1"})),
        ("gaussians:a.ply?up=-y&", ("gaussians", "a.ply", {"up": "-y"})),
        ("PandaSet:x", ("pandaset", "x", {})),
        ("a folder/b c.ply", (None, "a folder/b c.ply", {})),
        ("a%20folder/b.ply?cameras=c%26d.json", (None, "a folder/b.ply", {"cameras": "c&d.json"})),
        ("./x:y.ply", (None, "x:y.ply", {})),
        ("gaussians:a.ply?cameras=b=c", ("gaussians", "a.ply", {"cameras": "b=c"})),
    ],
)  # fmt: skip
def test_parse_uri(uri: str, expected: tuple) -> None:
    assert parse_uri(uri) == expected


@pytest.mark.parametrize(
    ("uri", "message"),
    [
        ("", "no path"),
        ("gaussians:", r"no path.*procedural:street\?seed=3"),
        ("gaussians:?up=z", "no path"),
        ("gaussians:a.ply?up", "expected key=value after.*got 'up'"),
        ("gaussians:a.ply?=3", "expected key=value"),
        ("gaussians:a.ply?up=z&up=y", "'up' is given twice"),
    ],
)
def test_bad_uris(uri: str, message: str) -> None:
    with pytest.raises(AdapterError, match=message):
        parse_uri(uri)


def test_names_with_special_characters(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What exists as written is taken as written; the query starts after it."""
    monkeypatch.chdir(tmp_path)
    for name in ("what?.ply", "100%20.ply", "a b#c.ply", "gaussians:odd.ply"):
        Path(name).touch()
        assert parse_uri(name) == (None, name, {})
        if ":" not in name:
            assert parse_uri(f"gaussians:{name}?up=z") == ("gaussians", name, {"up": "z"})
            written = format_uri("gaussians", name, {"up": "+z", "cameras": "a&b=c?.json"})
            expected = {"up": "+z", "cameras": "a&b=c?.json"}
            assert parse_uri(written) == ("gaussians", name, expected)


@given(
    path=st.text(st.characters(codec="utf-8", exclude_characters="\0/"), min_size=1),
    query=st.dictionaries(st.sampled_from(["up", "scale", "cameras"]), st.text(max_size=8)),
)
def test_format_uri_is_the_inverse(path: str, query: dict[str, str]) -> None:
    path = "absent/" + path
    normal = str(Path(path))
    assert parse_uri(format_uri("gaussians", path, query)) == ("gaussians", normal, query)


def test_unknown_schemes_list_the_known() -> None:
    with pytest.raises(
        AdapterError, match=r"unknown scheme 'argoverse'.*pandaset.*gaussians.*up=-y"
    ):
        open_scene("argoverse:/data")
    with pytest.raises(AdapterError, match="procedural scenes are street; got 'forest'"):
        open_scene("procedural:forest")


def test_missing_paths_say_how_far_they_exist(tmp_path: Path) -> None:
    with pytest.raises(AdapterError, match=f"no such file or folder.*exists up to {tmp_path}"):
        open_scene(f"gaussians:{tmp_path}/a/b/c.ply")
    for uri in (f"pandaset:{tmp_path}/x", f"{tmp_path}/x?up=z"):
        with pytest.raises(AdapterError, match="no such file or folder"):
            open_scene(uri)


def test_recognition_by_contents(tmp_path: Path) -> None:
    write_ply(tmp_path / "a.bin", street(length=8))
    write_splat(tmp_path / "b.splat", street(length=8))
    for name in ("a.bin", "b.splat"):
        assert recognise(tmp_path / name) == "gaussians"
    (tmp_path / "set" / "seq" / "camera").mkdir(parents=True)
    (tmp_path / "set" / "seq" / "lidar").mkdir()
    assert recognise(tmp_path / "set" / "seq") == "pandaset"
    model = tmp_path / "model" / "point_cloud" / "iteration_7"
    model.mkdir(parents=True)
    with pytest.raises(AdapterError, match=r"not recognised as a scene; looked for .*a PandaSet"):
        recognise(tmp_path / "model")
    write_ply(model / "point_cloud.ply", street(length=8))
    assert recognise(tmp_path / "model") == "gaussians"
    assert recognise(model) == "gaussians"
    with pytest.raises(AdapterError, match=r"It holds scenes: give one, such as .*seq\. Or name"):
        recognise(tmp_path / "set")
    (tmp_path / "text.txt").write_text("hello")
    with pytest.raises(AdapterError, match=r"looked for .*a \.ply or \.splat file"):
        open_scene(str(tmp_path / "text.txt"))


def test_bare_paths_open_and_reopen(tmp_path: Path) -> None:
    path = tmp_path / "a street?.ply"
    write_ply(path, street())
    scene = open_scene(f"{path}?scale=2")
    again = open_scene(scene.source)
    assert scene.source.startswith("gaussians:") and again.source == scene.source
    assert again.background.means.equal(scene.background.means)
    assert scene.has_metric_scale


def test_unreadable_files_are_adapter_errors(tmp_path: Path, monkeypatch) -> None:
    path = tmp_path / "a.ply"
    write_ply(path, street(length=8))

    def refuse(*_args, **_keywords):
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr(Path, "open", refuse)
    with pytest.raises(AdapterError, match=r"cannot be read: .*Permission denied"):
        open_scene(f"gaussians:{path}")


def test_the_road_height_can_be_given_to_any_scene(tmp_path: Path) -> None:
    write_ply(tmp_path / "a.ply", street())
    uri = f"gaussians:{tmp_path}/a.ply?scale=1"
    scene = open_scene(f"{uri}&ground_z=-1.5")
    assert scene.ground_z_m == -1.5
    assert open_scene(scene.source).ground_z_m == -1.5  # a worker opens the same scene
    with pytest.raises(AdapterError, match=r"ground_z must be the road's height.*got 'low'"):
        open_scene(f"{uri}&ground_z=low")
