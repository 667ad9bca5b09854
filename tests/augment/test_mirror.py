"""A copy of a dataset with weathered images: what it is made of, and what stays untouched."""

from __future__ import annotations

import dataclasses
import errno
import itertools
import json
import os
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from augment.errors import AdapterError, OutputError
from augment.jobs import mirror as mirror_module
from augment.jobs.mirror import dataset_format, mirror_folder, read_record, weathered_images
from augment.output.atomic import TEMPORARY_SUFFIX
from augment.output.codecs import decode_image
from tests.augment import batch_scenes
from tests.augment import mirror_trees as trees


@pytest.fixture
def source(tmp_path) -> Path:
    return trees.write_dataset(tmp_path / "drive")


@pytest.fixture(scope="module")
def rendered(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("rendered")
    trees.render(trees.write_dataset(folder / "drive"), folder / "out")
    return folder / "out"


@pytest.fixture
def out(rendered, tmp_path) -> Path:
    return Path(shutil.copytree(rendered, tmp_path / "out"))


def image_of(out: Path, camera: str, frame: int, variant: str = "fog-000") -> Path:
    folder = {"front": "front", "rear": "rear_left-" + "*"}[camera]
    (path,) = (out / "street" / variant / "images").glob(f"{folder}/{frame:06d}.*")
    return path


def places(suffix: str = "png") -> set[str]:
    return {f"camera/{name}/{f:02d}.{suffix}" for name in ("front", "rear") for f in range(4)}


def test_the_copy_is_the_source_in_all_but_the_images(source, out):
    before = trees.snapshot(source)
    done = trees.mirror(source, out)
    copy = out / "source/fog-000/drive"
    assert done.folder == copy
    assert trees.listing(copy) == trees.listing(source)
    recorded = trees.contents(source)
    copied_files = trees.contents(copy)
    assert {name for name in recorded if recorded[name] != copied_files[name]} == places()
    for camera in ("front", "rear"):
        for frame in range(4):
            rendered = image_of(out, camera, frame)
            assert (copy / f"camera/{camera}/{frame:02d}.png").samefile(rendered)
    for name in recorded.keys() - places():
        assert (copy / name).samefile(source / name)
    assert trees.snapshot(source) == before
    files = done.record.files
    sizes = done.record.bytes
    assert files["linked"] == len(recorded) - 8 and files["copied"] == done.new == 0
    assert sizes["linked"] == sum(len(recorded[name]) for name in recorded.keys() - places())
    assert (files["camera_images"], set(done.record.replaced)) == (8, places())
    assert done.changed == len(recorded)


def test_the_record_says_what_the_copy_is(source, out):
    trees.mirror(source, out)
    record = json.loads((out / "source/fog-000/climategs-mirror-drive.json").read_text())
    assert record["scenes"] == {"street": {"seed": 7}}
    assert record["folder"] == str(source) and record["links"] == "hard"
    assert record["files"] == {
        "linked": 5, "copied": 0, "symbolic_links": 0, "camera_images": 8, "replaced_images": 8,
        "lidar_sweeps": 0, "replaced_lidar_files": 0,
    }  # fmt: skip
    row = batch_scenes.tree_digest(out)["street/fog-000/images/front/000002.png"]
    assert record["replaced"]["camera/front/02.png"] == {
        "scene": "street",
        "image": "street/fog-000/images/front/000002.png",
        "sha256": row,
    }


def test_building_again_changes_nothing(source, out):
    trees.mirror(source, out)
    folder = out / "source/fog-000"
    before = trees.snapshot(folder)
    done = trees.mirror(source, out)
    assert done.changed == 0 and len(done.record.replaced) == 8
    after = trees.snapshot(folder)
    del before[str(folder)], after[str(folder)]  # the record's name was another for a while
    assert after == before


def test_more_images_come_in(source, tmp_path):
    out = tmp_path / "out"
    trees.render(source, out, frames=[1], cameras=["front"])
    done = trees.mirror(source, out)
    copy = done.folder
    assert (
        set(done.record.replaced) == {"camera/front/01.png"}
        and done.record.files["camera_images"] == 8
    )
    assert (copy / "camera/rear/01.png").samefile(source / "camera/rear/01.png")
    before = trees.snapshot(source)
    trees.render(source, out, frames=[1, 3])
    done = trees.mirror(source, out)
    assert len(done.record.replaced) == 4 and done.changed == 3
    assert (copy / "camera/rear/03.png").samefile(image_of(out, "rear", 3))
    assert (copy / "camera/rear/02.png").samefile(source / "camera/rear/02.png")
    assert trees.snapshot(source) == before  # links were replaced, not what they led to


@pytest.mark.long
def test_going_on_after_a_kill_at_any_point(tmp_path, monkeypatch):
    """Stopped before or after each change of the disk: no half file, and the rest is done later."""
    source = trees.write_dataset(tmp_path / "drive", frames=1)
    out = tmp_path / "out"
    trees.render(source, out, frames=[0])
    (source / "camera" / "also").symlink_to("front")
    copy = out / "source/fog-000"
    uninterrupted = trees.mirror(source, out, links="copy")
    complete_files = trees.contents(copy)
    before = trees.snapshot(source)
    assert uninterrupted.record.files["copied"] > 0
    for calls in itertools.count(1, 5):  # odd, so that stops come before and after changes
        shutil.rmtree(copy)
        stopped = False
        with monkeypatch.context() as patch:
            stop_at(patch, calls)
            try:
                trees.mirror(source, out, links="copy")
            except KeyboardInterrupt:
                stopped = True
        if not stopped:
            break
        half = trees.contents(copy) if copy.is_dir() else {}
        final = {n: half[n] for n in half if not n.endswith((TEMPORARY_SUFFIX, ".files"))}
        assert all(complete_files.get(name) == final[name] for name in final), f"stopped at {calls}"
        trees.mirror(source, out, links="copy")
        assert trees.contents(copy) == complete_files, f"stopped at {calls}"
        assert trees.snapshot(source) == before
    assert calls > 20


def stop_at(patch, call_number: int) -> None:
    """Raise around the given change of the disk: odd before it, even after it."""
    call_counter = itertools.count(1)

    def watched(call):
        def wrapper(*arguments, **options):
            mine = next(call_counter)
            if 2 * mine - 1 == call_number:
                raise KeyboardInterrupt
            result = call(*arguments, **options)
            if 2 * mine == call_number:
                raise KeyboardInterrupt
            return result

        return wrapper

    for name in ("link", "replace", "mkdir", "symlink", "sendfile", "utime"):
        patch.setattr(os, name, watched(getattr(os, name)))


def test_a_stopped_update_does_not_say_that_it_is_complete(source, tmp_path, monkeypatch):
    out = tmp_path / "out"
    trees.render(source, out, frames=[0])
    trees.mirror(source, out)
    trees.render(source, out)
    with monkeypatch.context() as patch:
        stop_at(patch, 3)
        with pytest.raises(KeyboardInterrupt):
            trees.mirror(source, out)
    record = out / "source/fog-000/climategs-mirror-drive.json"
    assert not record.exists()
    # What stood in the copy is still known, for images of other scenes.
    stopped_record = read_record(trees.tree_of(source), record.parent)
    assert set(stopped_record.replaced) == {"camera/front/00.png", "camera/rear/00.png"}
    trees.mirror(source, out)
    names = {p.name for p in record.parent.iterdir() if p.is_file()}
    assert names == {record.name, "climategs-mirror-drive.files"}
    assert len(json.loads(record.read_text())["replaced"]) == 8


def test_a_full_disk_leaves_no_half_file(source, out, monkeypatch):
    source_files = trees.contents(source)
    before = trees.snapshot(source)

    def full(*_, **__):
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(os, "sendfile", full)
        with pytest.raises(OutputError, match=r"cannot write .*free some space"):
            trees.mirror(source, out, links="copy")
    copy = out / "source/fog-000"
    assert not any(p.name.endswith(TEMPORARY_SUFFIX) for p in copy.rglob("*"))
    for name, data in trees.contents(copy / "drive").items():
        assert data == source_files[name]
    assert not (copy / "climategs-mirror-drive.json").exists()
    assert trees.snapshot(source) == before


def test_files_are_copied_where_they_cannot_be_linked(source, out, monkeypatch):
    numbers = itertools.cycle([errno.EXDEV, errno.EPERM, errno.EMLINK, errno.EOPNOTSUPP])

    def refuse(*_, **__):
        number = next(numbers)
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(os, "link", refuse)
    done = trees.mirror(source, out)
    assert done.record.files["linked"] == 0 and done.record.files["copied"] == 5 and done.new == 8
    assert trees.listing(done.folder) == trees.listing(source)
    for name in trees.contents(source):
        assert not (done.folder / name).samefile(source / name)
    source_file = source / "lidar/raw/00.bin"
    again = done.folder / "lidar/raw/00.bin"
    assert again.read_bytes() == source_file.read_bytes()
    assert again.stat().st_mtime_ns == source_file.stat().st_mtime_ns
    assert trees.mirror(source, out).changed == 0
    source_file.write_bytes(b"of another length")
    assert trees.mirror(source, out).changed == 1
    assert again.read_bytes() == b"of another length"
    time_ns = source_file.stat().st_mtime_ns
    source_file.write_bytes(b"of another length, at that time")
    os.utime(source_file, ns=(time_ns, time_ns))
    assert trees.mirror(source, out).changed == 1


def test_a_copy_that_shares_nothing(source, out):
    trees.mirror(source, out)
    done = trees.mirror(source, out, links="copy")  # gives up the links that were there
    assert done.record.files["linked"] == 0 and done.record.files["copied"] == 5
    before = trees.snapshot(source)
    for path in done.folder.rglob("*"):
        if path.is_file():
            path.write_bytes(b"mine")
    assert trees.snapshot(source) == before
    assert image_of(out, "front", 0).read_bytes() != b"mine"


def edit(path: Path, links: str) -> None:
    """As editors save: of a hard link into a new file, lest the source change too."""
    if links == "hard":
        path.unlink()
    path.write_bytes(b"edited by hand")


@pytest.mark.parametrize("links", ["hard", "copy"])
def test_edits_in_the_copy_stop_it_before_anything_changes(source, out, links):
    done = trees.mirror(source, out, links=links)
    label = done.folder / "lidar/raw/00.bin"
    image = done.folder / "camera/front/01.png"
    edit(label, links)
    edit(image, links)
    (source / "README.md").unlink()
    (source / "README.md").write_text("Another text.\n")
    before = trees.snapshot(out / "source")
    with pytest.raises(OutputError, match=r"2 files are not what was put .*front/01\.png.* them"):
        trees.mirror(source, out, links=links)
    assert trees.snapshot(out / "source") == before
    image.unlink()
    with pytest.raises(OutputError, match=r"1 file is not what was put .*lidar/raw/00\.bin"):
        trees.mirror(source, out, links=links)
    label.unlink()
    assert trees.mirror(source, out, links=links).changed == 3
    assert label.read_bytes() == (source / "lidar/raw/00.bin").read_bytes()
    assert (done.folder / "README.md").read_text() == "Another text.\n"


def test_files_that_were_there_before_stop_it(source, out):
    """Also where the dataset has a link, and of the same size and time as the dataset's."""
    (source / "camera/also").symlink_to("front")
    copy = out / "source/fog-000/drive"
    content = b"other" * 1000
    time_ns = (source / "lidar/raw/00.bin").stat().st_mtime_ns
    for place in ("README.md", "camera/also", "camera/front/00.png", "lidar/raw/00.bin"):
        (copy / place).parent.mkdir(parents=True, exist_ok=True)
        (copy / place).write_bytes(content)
        if place == "lidar/raw/00.bin":
            os.utime(copy / place, ns=(time_ns, time_ns))
        with pytest.raises(OutputError, match=f"1 file is not what was put .*{place}"):
            trees.mirror(source, out)
        assert (copy / place).read_bytes() == content
        (copy / place).unlink()
    trees.mirror(source, out)
    assert trees.listing(copy) == trees.listing(source)


@pytest.mark.parametrize("links", ["hard", "copy"])
def test_a_source_of_the_same_size_and_time_is_looked_into(source, out, links):
    trees.mirror(source, out, links=links)
    label = source / "lidar/raw/00.bin"
    time_ns = label.stat().st_mtime_ns
    content = bytes(5000)
    if links == "hard":
        label.unlink()
    label.write_bytes(content)
    os.utime(label, ns=(time_ns, time_ns))
    assert trees.mirror(source, out, links=links).changed == 1
    assert (out / "source/fog-000/drive/lidar/raw/00.bin").read_bytes() == content
    label.chmod(0o600)  # a change of its facts alone
    assert trees.mirror(source, out, links=links).changed == 0


def test_copies_of_earlier_versions_are_taken_as_they_are(source, out, monkeypatch):
    """They have no list of what was put there; from then on they have one."""
    done = trees.mirror(source, out, links="copy")
    list_path = out / "source/fog-000/climategs-mirror-drive.files"
    list_path.unlink()
    (done.folder / "README.md").write_text("edited")
    (done.folder / "lidar/raw/00.bin").write_text("edited")
    with monkeypatch.context() as patch:
        stop_at(patch, 8)
        with pytest.raises(KeyboardInterrupt):
            trees.mirror(source, out, links="copy")
    assert trees.mirror(source, out, links="copy").changed > 0
    recorded = trees.contents(source)
    copied_files = trees.contents(done.folder)
    assert all(copied_files[name] == recorded[name] for name in recorded.keys() - places())
    (done.folder / "README.md").write_text("edited")
    with pytest.raises(OutputError, match="not what was put in the copy"):
        trees.mirror(source, out, links="copy")
    list_path.write_text(list_path.read_text() + '["half a li')  # when the power went
    with pytest.raises(OutputError, match="not what was put in the copy"):
        trees.mirror(source, out, links="copy")
    list_path.write_text("[1]\n")
    with pytest.raises(OutputError, match=r"drive\.files is damaged: .* Delete it and run again"):
        trees.mirror(source, out, links="copy")


def test_a_changed_source_is_noticed(source, out):
    done = trees.mirror(source, out)
    table = source / "README.md"
    new = source / "camera/front/poses2.json"
    table.unlink()
    table.write_text("Another dataset.\n")
    new.write_text("[]")
    (source / "lidar/nothing.txt").unlink()
    again = trees.mirror(source, out)
    assert again.changed == 2
    assert (done.folder / "README.md").samefile(table)
    assert (done.folder / "camera/front/poses2.json").samefile(new)
    assert again.extra_files == ["lidar/nothing.txt"]  # nobody here may decide to delete it


def test_others_files_stay_and_leftovers_go(source, out):
    done = trees.mirror(source, out)
    (done.folder / "infos.pkl").write_bytes(b"a loader's cache")
    (done.folder / "camera" / f".1-2{TEMPORARY_SUFFIX}").write_bytes(b"half")
    assert trees.mirror(source, out).extra_files == ["infos.pkl"]
    assert set(trees.listing(done.folder)) - set(trees.listing(source)) == {"infos.pkl"}


def test_links_within_the_dataset_stay_links(source, out):
    (source / "camera/also").symlink_to("front")
    (source / "lidar/same.bin").symlink_to(source / "lidar/raw/00.bin")  # absolute
    (source / "lidar/gone").symlink_to("not/there")
    done = trees.mirror(source, out)
    copy = done.folder
    assert done.record.files["symbolic_links"] == 3 and trees.listing(copy) == trees.listing(source)
    assert os.readlink(copy / "camera/also") == "front"
    assert os.readlink(copy / "lidar/same.bin") == "raw/00.bin"
    assert os.readlink(copy / "lidar/gone") == "not/there"
    # Through the link the weathered images are seen as well.
    assert (copy / "camera/also/00.png").samefile(image_of(out, "front", 0))
    assert trees.mirror(source, out).changed == 0


def test_own_entries_may_lie_elsewhere(source, tmp_path):
    """What people do whose disks are full; a link below them may lead to another of them."""
    (source / "camera").rename(tmp_path / "disk")
    (source / "camera").symlink_to(tmp_path / "disk")
    (source / "README.md").rename(tmp_path / "text")
    (source / "README.md").symlink_to(tmp_path / "text")
    (tmp_path / "disk/rear/sweep").symlink_to(source / "lidar/raw")
    out = tmp_path / "out"
    trees.render(source, out)
    before = trees.snapshot(source), trees.snapshot(tmp_path / "disk")
    copy = trees.mirror(source, out).folder
    assert not (copy / "camera").is_symlink() and not (copy / "README.md").is_symlink()
    assert (copy / "README.md").samefile(tmp_path / "text")
    assert (copy / "camera/front/00.png").samefile(image_of(out, "front", 0))
    assert (copy / "camera/rear/poses.json").samefile(tmp_path / "disk/rear/poses.json")
    assert os.readlink(copy / "camera/rear/sweep") == "../../lidar/raw"
    assert (trees.snapshot(source), trees.snapshot(tmp_path / "disk")) == before


def test_a_source_that_is_a_link_itself(source, tmp_path):
    (tmp_path / "named").symlink_to(source)
    out = tmp_path / "out"
    trees.render(tmp_path / "named", out)
    done = trees.mirror(tmp_path / "named", out)
    assert done.folder.name == "named" and len(done.record.replaced) == 8
    assert not done.folder.is_symlink()


def test_what_a_copy_cannot_have_is_refused(source, out, tmp_path):
    """Links that lead out of the dataset, and what is neither file nor folder nor link."""
    (tmp_path / "secret").write_text("secret")
    for name, text, message in (
        ("camera/secret", "../../secret", r"camera/secret is a link to .*secret, outside"),
        ("camera/front/09.png", "/etc/hostname", r"09\.png is a link to /etc/hostname, outside"),
        ("sweeps", "../gone", r"sweeps is a link to .*gone, which does not exist"),
        ("loop", "..", r"loop is a link to .*, which holds the dataset itself"),
        ("lidar/pipe", None, r"pipe is neither a file nor a folder nor a link"),
    ):
        path = source / name
        os.mkfifo(path) if text is None else path.symlink_to(text)
        with pytest.raises(AdapterError, match=message):
            trees.mirror(source, out)
        path.unlink()
    assert not (out / "source/fog-000").exists()


def test_nothing_is_written_through_a_link_in_the_output(source, out):
    """A copy that somebody began with `ln -s` would lead into the source."""
    before = trees.snapshot(source)
    copy = out / "source/fog-000"
    for place in ("", "drive", "drive/camera"):
        folder = copy / place
        folder.parent.mkdir(parents=True, exist_ok=True)
        folder.symlink_to(source / place.removeprefix("drive").lstrip("/"))
        with pytest.raises(OutputError, match=r"is a link; the copy of the data|lies in the datas"):
            trees.mirror(source, out)
        folder.unlink()
    folder = copy / "drive/camera/front"  # links in the places of files are replaced themselves
    folder.mkdir(parents=True, exist_ok=True)
    for links in ("hard", "copy"):
        for name in ("00.png", "poses.json"):
            (folder / name).unlink(missing_ok=True)
            (folder / name).symlink_to(source / "camera/front" / name)
        trees.mirror(source, out, links=links)
        assert not any((folder / name).is_symlink() for name in ("00.png", "poses.json"))
    (copy / "drive/README.md").unlink()
    (copy / "drive/README.md/mine").mkdir(parents=True)
    with pytest.raises(OutputError, match=r"cannot write .*README\.md"):
        trees.mirror(source, out)
    assert (copy / "drive/README.md/mine").is_dir() and trees.snapshot(source) == before


def test_only_what_belongs_to_the_dataset(source, out):
    tree = trees.tree_of(source, entries=("camera", "README.md"))
    done = trees.mirror(source, out, tree=tree)
    assert sorted(path.name for path in done.folder.iterdir()) == ["README.md", "camera"]
    for place in (".", "out", "lidar/out"):
        with pytest.raises(OutputError, match="lies in the dataset's own folder"):
            mirror_module.check_disjoint(trees.tree_of(source), source / place)
    # Beside what belongs to it.
    mirror_module.check_disjoint(trees.tree_of(source, entries=("camera",)), source / "out")


def test_a_source_that_cannot_be_written(source, out):
    folders = [source, *(path for path in source.rglob("*") if path.is_dir())]
    for path in [*folders, *(p for p in source.rglob("*") if p.is_file())]:
        path.chmod(0o555 if path.is_dir() else 0o444)
    before = trees.snapshot(source)
    try:
        done = trees.mirror(source, out)
        assert trees.snapshot(source) == before
        # The copy is the user's: it can be deleted and built again.
        assert all(path.stat().st_mode & 0o200 for path in done.folder.rglob("*") if path.is_dir())
    finally:
        for path in folders:
            path.chmod(0o755)


@pytest.mark.parametrize(
    ("scale", "method", "suffix"), [(0.5, cv2.INTER_CUBIC, "png"), (2.0, cv2.INTER_AREA, "jpg")]
)
def test_images_of_another_size_are_resized(tmp_path, scale, method, suffix):
    source = trees.write_dataset(tmp_path / "drive", suffix=suffix)
    out = tmp_path / "out"
    trees.render(source, out, scale=scale, image=suffix)
    done = trees.mirror(source, out)
    width, height = batch_scenes.SIZE
    rendered = (round(width * scale), round(height * scale))
    assert done.resized == [(rendered, (width, height))] * 8
    file = done.folder / f"camera/front/01.{suffix}"
    resized_image = decode_image(file.read_bytes()).astype(int)
    assert resized_image.shape == (height, width, 3)
    image = decode_image(image_of(out, "front", 1).read_bytes())
    expected = cv2.resize(image, (width, height), interpolation=method).astype(int)
    # Noise of half the image's frequency, at quality 92: JPEG alone is off by some levels.
    assert np.abs(resized_image - expected).mean() <= (0 if suffix == "png" else 8)
    assert done.new == 8 and done.record.bytes["new_images"] == sum(
        p.stat().st_size for p in (done.folder / "camera").glob(f"*/*.{suffix}")
    )
    before = trees.snapshot(done.folder)
    assert trees.mirror(source, out).changed == 0
    assert trees.snapshot(done.folder) == before


def test_grey_images_stay_grey(source, tmp_path):
    path = source / "camera/front/00.png"
    out = tmp_path / "out"
    cv2.imwrite(str(path), cv2.imread(str(path), cv2.IMREAD_GRAYSCALE))
    trees.render(source, out, frames=[0])
    done = trees.mirror(source, out)
    image = cv2.imread(str(done.folder / "camera/front/00.png"), cv2.IMREAD_UNCHANGED)
    assert image.ndim == 2
    rgb = decode_image(image_of(out, "front", 0).read_bytes())
    assert np.abs(image - rgb @ [0.299, 0.587, 0.114]).max() < 1
    assert trees.mirror(source, out).changed == 0


def test_recorded_images_that_are_none_stay(source, out):
    (source / "camera/front/00.png").write_bytes(b"GIF89a")
    (source / "camera/front/01.png").unlink()
    rows = trees.read_manifest(out).to_pylist()
    frames = trees.scene_of(source).frames
    images, notes = weathered_images(out, rows, frames, trees.tree_of(source))
    assert notes == [
        "1 rendered images, such as frame 1, camera front, have no recorded image in the dataset: "
        "they are not in its copy"
    ]
    extent = trees.survey(trees.tree_of(source))
    assert extent.images == 7
    folder = mirror_folder(out, "fog-000")
    done = mirror_module.mirror_dataset(
        trees.tree_of(source), folder, images, {}, extent=extent, progress=False
    )
    assert done.unusable == ["camera/front/00.png"] and len(done.record.replaced) == 6
    assert (done.folder / "camera/front/00.png").read_bytes() == b"GIF89a"


def test_images_of_another_format_are_encoded_anew(tmp_path):
    source = trees.write_dataset(tmp_path / "drive", suffix="jpg")
    out = tmp_path / "out"
    frame = batch_scenes.make_frame(0)
    for names, image_format in (
        (("a.jpg", "b.JPEG"), "jpg"),
        (("a.png",), "png"),
        (("a.png", "b.jpg"), "png"),
    ):
        paths = {str(number): name for number, name in enumerate(names)}
        assert dataset_format([dataclasses.replace(frame, image_paths=paths)]) == image_format
    with pytest.raises(AdapterError, match="knows no recorded image"):
        dataset_format([frame])
    trees.render(source, out, image="png")
    done = trees.mirror(source, out)
    assert done.resized == [] and done.new == 8
    file = done.folder / "camera/front/01.jpg"
    assert file.read_bytes()[:2] == b"\xff\xd8"
    image = decode_image(image_of(out, "front", 1).read_bytes()).astype(int)
    assert np.abs(decode_image(file.read_bytes()) - image).mean() < 8
    image = image_of(out, "front", 0)
    image.write_bytes(image.read_bytes()[:30])
    with pytest.raises(OutputError, match=r"000000\.png is damaged .*render again"):
        trees.mirror(source, out)
    image.unlink()
    with pytest.raises(OutputError, match=r"000000\.png, which the manifest names, cannot be read"):
        trees.mirror(source, out)
