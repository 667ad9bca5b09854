"""What every store promises, and what a local one does on the disk."""

import errno
import os
import pickle
import threading
from pathlib import Path

import pytest
from s3_server import s3_server

from augment.errors import OutputError
from augment.jobs import store as local_store
from augment.jobs.atomic import TEMPORARY_SUFFIX
from augment.jobs.store import LocalStore, StoredFileMissing, open_store


@pytest.fixture(scope="module")
def server():
    with s3_server() as server:
        yield server


@pytest.fixture(params=["local", "s3"])
def store(request, tmp_path):
    if request.param == "local":
        return open_store(tmp_path / "out")
    return open_store(request.getfixturevalue("server").uri(f"{tmp_path.name}/o%20t"))


def test_what_was_written_is_read(store):
    assert store.list("") == {}
    assert not store.exists("a/b.txt")
    store.write("a/b.txt", b"first and longer")
    store.write("a/b.txt", b"second")
    store.write("a.gz", b"not compressed")
    store.write("a/empty", b"")
    assert store.read("a/b.txt") == b"second"
    assert store.read("a.gz") == b"not compressed"
    assert store.read("a/empty") == b""
    assert store.exists("a/b.txt") and not store.exists("a") and not store.exists("b.txt")
    assert {path: file.size for path, file in store.list("").items()} == {
        "a.gz": 14,
        "a/b.txt": 6,
        "a/empty": 0,
    }
    assert list(store.list("a")) == ["a/b.txt", "a/empty"]
    assert store.list("a/b") == store.list("nothing") == {}
    store.delete(["a/b.txt", "a/empty", "never/there"])
    assert list(store.list("")) == ["a.gz"]


def test_missing_files_are_told_from_others(store):
    store.write("a/b", b"")
    for path in ("nothing", "a/c", "c/b", "a/b/c"):
        with pytest.raises(StoredFileMissing, match=path):
            store.read(path)


def test_files_are_put(store, tmp_path):
    source = tmp_path / "source.bin"
    source.write_bytes(b"12345")
    for _ in range(2):
        store.put_file("a/b", source)
        assert store.read("a/b") == b"12345"
    with pytest.raises(OutputError, match=r"cannot read .*nothing"):
        store.put_file("a/b", tmp_path / "nothing")
    store.write("a/b", b"6")
    assert source.read_bytes() == b"12345"
    assert list(store.list("")) == ["a/b"]


@pytest.mark.parametrize(
    "path",
    ["", "/", "/etc/passwd", "..", "../x", "a/../../x", "a\\b", "a\0b", "a\nb", "//x", "\udcff"],
)
def test_hostile_paths_are_refused(store, path, tmp_path):
    calls = [store.read, store.exists, lambda path: store.write(path, b"")]
    calls += [lambda path: store.delete(["fine", path])]
    calls += [lambda path: store.put_file(path, tmp_path)]
    calls += [store.list] if path else []
    for call in calls:
        with pytest.raises(OutputError, match="no path of a file there"):
            call(path)


def test_pickled_stores_name_the_same_place(store):
    store.write("a", b"1")
    for other in (pickle.loads(pickle.dumps(store)), open_store(store.uri)):
        assert other.read("a") == b"1"
        assert other.uri == store.uri and other.local_dir == store.local_dir


def test_local_places(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    expected = tmp_path / "a b"
    for uri in (expected, "a b", Path("a b"), f"file://{tmp_path}/a%20b"):
        store = open_store(uri)
        assert (store.local_dir, store.uri) == (expected, str(expected))
    assert open_store(f"file://localhost{tmp_path}").local_dir == tmp_path
    for uri in ("file://elsewhere/a", "file://"):
        with pytest.raises(OutputError, match="absolute"):
            open_store(uri)
    assert not expected.exists()


def test_local_files_are_linked_or_else_copied(tmp_path, monkeypatch):
    store, source = LocalStore(tmp_path / "out"), tmp_path / "source"
    source.write_bytes(b"1")
    link = tmp_path / "link"
    link.symlink_to(source)
    store.put_file("a/linked", link)
    assert os.path.samefile(source, tmp_path / "out/a/linked")
    assert not (tmp_path / "out/a/linked").is_symlink()

    def refuse(*_, **__):
        raise OSError(errno.EXDEV, "another disk")

    monkeypatch.setattr(os, "link", refuse)
    store.put_file("a/copied", source)
    store.put_file("a/linked", source)
    assert store.read("a/copied") == store.read("a/linked") == b"1"
    assert not os.path.samefile(source, tmp_path / "out/a/linked")
    assert sorted(os.listdir(tmp_path / "out/a")) == ["copied", "linked"]


def test_a_full_disk_leaves_the_old_file(tmp_path, monkeypatch):
    store = LocalStore(tmp_path)
    store.write("a/b", b"old")
    (tmp_path / "source").write_bytes(b"new")

    def refuse(*_, **__):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "replace", refuse)
    for call in (
        lambda: store.write("a/b", b"n"),
        lambda: store.put_file("a/b", tmp_path / "source"),
    ):
        with pytest.raises(OutputError, match="disk is full"):
            call()
    assert store.read("a/b") == b"old"
    assert os.listdir(tmp_path / "a") == ["b"]


def test_links_do_not_lead_out(tmp_path):
    (tmp_path / "secret").write_text("x")
    store = LocalStore(tmp_path / "out")
    store.write("a", b"")
    (tmp_path / "out/up").symlink_to(tmp_path)
    for call in (lambda: store.read("up/secret"), lambda: store.write("up/new", b"")):
        with pytest.raises(OutputError, match="through a link"):
            call()
    with pytest.raises(OutputError, match="through a link"):
        store.delete(["up/secret"])
    assert list(store.list("")) == ["a"]
    assert (tmp_path / "secret").exists()


def test_emptied_folders_go_and_the_root_stays(tmp_path):
    store = LocalStore(tmp_path / "out")
    store.write("a/b/c/d", b"")
    store.write("a/e", b"")
    store.delete(["a/b/c/d"])
    assert os.listdir(tmp_path / "out/a") == ["e"]
    store.delete(["a/e", "a/e/f"])
    assert os.listdir(tmp_path / "out") == []


def test_temporaries_are_not_files(tmp_path):
    store = LocalStore(tmp_path)
    (tmp_path / f".x{TEMPORARY_SUFFIX}").write_bytes(b"half")
    (tmp_path / "dangling").symlink_to("nothing")
    assert store.list("") == {}


def test_unreadable_folders_are_told(tmp_path, monkeypatch):
    store = LocalStore(tmp_path)

    def refuse(*_, **__):
        raise PermissionError(errno.EACCES, "Permission denied")

    monkeypatch.setattr(local_store.os, "scandir", refuse)
    with pytest.raises(OutputError, match=r"cannot read .*Permission denied"):
        store.list("")
    (tmp_path / "folder").mkdir()
    with pytest.raises(OutputError, match=r"cannot read .*folder: Is a directory"):
        store.read("folder")
    with pytest.raises(OutputError, match=r"cannot delete .*folder"):
        store.delete(["folder"])


def test_writing_where_others_delete_the_folder(tmp_path):
    """Each deletes the other's folder all the time; no write fails."""
    store = LocalStore(tmp_path)
    errors = []

    def work(name):
        try:
            for _ in range(30):
                store.write(f"a/b/{name}", b"x")
                store.delete([f"a/b/{name}"])
        except OutputError as error:
            errors.append(error)

    threads = [threading.Thread(target=work, args=(str(n),)) for n in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not errors
    assert os.listdir(tmp_path) == []
