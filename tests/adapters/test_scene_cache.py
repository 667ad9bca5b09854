"""Raw scenes opened from the cache: the same bits, and never those of other files or options."""

from __future__ import annotations

import dataclasses
import os
import resource
import shutil
import signal
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from adapters.base import open_scene
from adapters.scene_cache import LIMIT_KEY, cached_scene, scene_digest
from adapters.uri import format_uri
from augment.errors import AdapterError
from augment.files.export import export_splats
from augment.files.scene_file import save_scene
from augment.render.rasterize import rasterize
from tests.adapters.all_drives import WRITERS, write_drive
from tests.adapters.recording_files import write_as_recording
from tests.fitted_scenes import assert_same, fitted_scene
from tools.cli import main

COARSE = {"voxel_m": "0.4", "image_scale": "0.5", "sky_size": "8", "frames": "0:2"}


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """An empty cache in use. Its folder."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setenv(LIMIT_KEY, "1")
    yield tmp_path / "cache" / "climategs" / "scenes"


def entries(cache: Path) -> set[str]:
    return {path.name for path in cache.iterdir()}


@pytest.mark.parametrize("scheme", WRITERS)
def test_a_cached_scene_is_the_built_one_to_the_bit(
    scheme: str, cache: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    uri = write_drive(scheme, tmp_path / "data").uri(**COARSE)
    monkeypatch.chdir(tmp_path)
    near = uri.replace(f"{tmp_path}/", "")  # a relative path: those of the images are so, too
    monkeypatch.setenv(LIMIT_KEY, "0")
    built = open_scene(near)
    assert not cache.exists()
    monkeypatch.setenv(LIMIT_KEY, "1")
    stored = open_scene(uri)
    kept = entries(cache)
    cached = open_scene(near)
    assert len(kept) == 1 and entries(cache) == kept
    assert_same(built, cached, but=("labels",))
    assert_same(built, stored, but=("labels", "source", "frames"))
    assert type(cached.labels) is type(built.labels)
    number = built.frames[-1].index
    assert_same(built.lidar(number), cached.lidar(number))
    assert built.boxes(number).track_ids == cached.boxes(number).track_ids
    camera, same = (next(iter(scene.frames[0].cameras.values())) for scene in (built, cached))
    for field in dataclasses.fields(camera):  # NumPy's numbers count otherwise than Python's
        assert type(getattr(camera, field.name)) is type(getattr(same, field.name)), field.name
    images = [rasterize(scene.parts_for(camera), camera).rgb for scene in (built, cached)]
    assert_same(*images)


def test_other_options_and_files_are_other_scenes(cache: Path, tmp_path: Path) -> None:
    root = write_as_recording(tmp_path / "data")
    uri = format_uri("recording", root, COARSE)
    first = open_scene(uri)
    assert open_scene(f"{uri}&ground_z=-3").ground_z_m == -3  # laid over what is kept
    assert len(entries(cache)) == 1
    assert len(open_scene(uri.replace("0.4", "0.6")).background) < len(first.background)
    image = sorted((root / "images").glob("*/*"))[0]
    content = image.read_bytes()
    image.unlink()
    assert len(open_scene(uri).frames[0].image_paths) < len(first.frames[0].image_paths)
    image.write_bytes(content)
    os.utime(image, ns=(0, 0))
    assert_same(open_scene(uri), first, but=("labels",))
    assert len(entries(cache)) == 4


@pytest.mark.parametrize("damage", ["cut short", "a bit"])
def test_a_damaged_entry_is_built_again(
    damage: str, cache: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    first = _kept(tmp_path / "a")
    (entry,) = cache.iterdir()
    content = bytearray(entry.read_bytes())
    content[-100] ^= 1
    entry.write_bytes(content[:-50] if damage == "cut short" else content)
    assert_same(_kept(tmp_path / "a"), first)
    assert "damaged" in caplog.text
    caplog.clear()
    _kept(tmp_path / "a")
    assert "damaged" not in caplog.text


def test_what_was_not_used_for_longest_makes_room(
    cache: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _kept(tmp_path / "a")
    (first,) = cache.iterdir()
    monkeypatch.setenv(LIMIT_KEY, str(2.5 * first.stat().st_size / 1e9))
    _kept(tmp_path / "b")
    (second,) = set(cache.iterdir()) - {first}
    os.utime(second, ns=(0, 0))
    os.utime(first, ns=(1, 1))
    _kept(tmp_path / "b")  # which now was used last
    _kept(tmp_path / "c")
    assert second.exists() and not first.exists() and len(entries(cache)) == 2


def test_who_wants_a_scene_that_is_being_built_waits_for_it(cache: Path, tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    builders, started = [], threading.Event()

    def build():
        builders.append(threading.get_ident())
        started.set()
        time.sleep(0.5)
        return fitted_scene()

    found = []

    def open_() -> None:
        found.append(cached_scene("recording", str(tmp_path / "a"), {}, build))

    first, second = (threading.Thread(target=open_) for _ in range(2))
    first.start()
    started.wait()
    second.start()
    first.join()
    second.join()
    assert len(builders) == 1 and len(entries(cache)) == 1
    assert_same(found[0].background, found[1].background)


@pytest.mark.parametrize("why", ["no folder", "no room"])
def test_without_a_cache_to_write_to_scenes_open_with_one_warning(
    why: str, cache: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    if why == "no folder":
        cache.parents[1].write_text("a file")
    else:
        resource.setrlimit(resource.RLIMIT_FSIZE, (1000, limits[1]))
    try:
        for name in "ab":
            assert_same(_kept(tmp_path / name), fitted_scene())
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        signal.signal(signal.SIGXFSZ, handler)
    assert caplog.text.count("are not kept") == 1
    assert not cache.exists() or not entries(cache)


def test_no_cache_leaves_it_out(
    cache: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    uri = write_drive("recording", tmp_path / "data").uri(**COARSE)
    assert main(["inspect", uri, "--no-cache"]) == 0
    assert not cache.exists()
    monkeypatch.setenv(LIMIT_KEY, "much")
    with pytest.raises(AdapterError, match=f"{LIMIT_KEY}.*'much'"):
        open_scene(uri)


def _kept(folder: Path):
    """A scene of everything that scenes hold, of a folder of its own."""
    folder.mkdir(exist_ok=True)
    return cached_scene("recording", str(folder), {}, fitted_scene)


@pytest.mark.parametrize("kind", ["link", "dangling link", "pipe"])
def test_what_others_put_in_the_caches_folder_is_neither_emptied_nor_waited_for(
    kind: str, cache: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    first = _kept(tmp_path / "a")
    (entry,) = cache.iterdir()
    lock = cache / f"{entry.name.partition('-')[0]}.lock"
    victim = tmp_path / "victim"
    victim.write_text("precious")
    entry.unlink()
    if kind == "pipe":
        os.mkfifo(lock)
        os.mkfifo(entry)
    else:
        lock.symlink_to(victim if kind == "link" else tmp_path / "nothing")
        entry.symlink_to("/dev/zero")
    assert_same(_kept(tmp_path / "a"), first)
    assert victim.read_text() == "precious" and not (tmp_path / "nothing").exists()
    assert "where a lock of climategs was expected" in caplog.text


# ---- The digest of what a scene is made from -----------------------------------------------------


def _scene(root: Path) -> str:
    save_scene(fitted_scene(), root)
    return f"scene:{root}"


def _splats(root: Path) -> str:
    root.mkdir(parents=True)
    export_splats(fitted_scene(), root / "point_cloud.ply", 0)
    return f"gaussians:{root}"


OURS: dict[str, Callable[[Path], str]] = {"scene": _scene, "gaussians": _splats}


@pytest.mark.parametrize("scheme", [*WRITERS, *OURS])
def test_a_digest_is_of_the_content_wherever_it_lies(
    scheme: str, cache: Path, tmp_path: Path
) -> None:
    data = tmp_path / "data"
    uri = OURS[scheme](data) if scheme in OURS else write_drive(scheme, data).uri()
    first = scene_digest(uri)
    assert first is not None and len(first) == 32
    shutil.copytree(tmp_path / "data", tmp_path / "copy")  # with other times
    (tmp_path / "copy" / ".hidden").write_text("of a file manager")
    (tmp_path / "copy" / "out" / ".climategs").mkdir(parents=True)
    (tmp_path / "copy" / "out" / "manifest.parquet").write_bytes(b"an output that was put here")
    copy = uri.replace(str(tmp_path / "data"), str(tmp_path / "copy"))
    assert scene_digest(copy) == scene_digest(copy) == first
    files = [p for p in (tmp_path / "copy").rglob("*") if p.suffix in (".json", ".bin", ".txt")]
    files += [p for p in (tmp_path / "copy").rglob("*.safetensors")]
    files += [p for p in (tmp_path / "copy").rglob("*.parquet") if "out" not in p.parts]
    files += [p for p in (tmp_path / "copy").rglob("*.ply")]
    files += [p for p in (tmp_path / "copy").rglob("sample.json")]  # of nuScenes its tables count
    content = bytearray(files[-1].read_bytes())
    content[len(content) // 2] ^= 1
    files[-1].write_bytes(content)
    assert scene_digest(copy) not in (first, None)


def test_what_was_read_once_is_remembered_until_the_files_change(
    cache: Path, tmp_path: Path
) -> None:
    uri = _scene(tmp_path / "a")
    for path in (tmp_path / "a").iterdir():
        os.utime(path, (1, 1))
    first = scene_digest(uri)
    (memo,) = (cache.with_name("digests")).iterdir()
    memo.write_text(memo.read_text().replace(str(first), "f" * 32))
    assert scene_digest(uri) == "f" * 32  # not read again
    os.utime(tmp_path / "a" / "scene.json", (2, 2))
    assert scene_digest(uri) == first
    memo.write_text("[" * 100_000)
    assert scene_digest(uri) == first


def test_scenes_without_files_of_their_own_have_a_digest_too(tmp_path: Path) -> None:
    first = scene_digest("procedural:street?seed=3&frames=2")
    assert first == scene_digest("procedural:street?frames=2&seed=3")
    assert first not in (None, scene_digest("procedural:street?seed=4&frames=2"))
    assert scene_digest(f"scene:{tmp_path / 'missing'}") is None
    assert scene_digest(str(tmp_path)) is None


def test_a_digest_is_of_every_kind_of_splat_file_in_a_folder(cache, tmp_path):
    digests = set()
    for name in ("a.ply", "b.SPZ", "c.glb", "d.gltf", "e.usdz", "f.sog"):
        (tmp_path / name).write_bytes(name.encode())
        digests.add(scene_digest(f"gaussians:{tmp_path}"))
    (tmp_path / "notes.md").write_text("nothing to render")
    assert len(digests) == 6 and scene_digest(f"gaussians:{tmp_path}") in digests
