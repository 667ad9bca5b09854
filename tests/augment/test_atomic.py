"""Temporary files: no two have one name, dead processes' go, living ones' stay."""

from __future__ import annotations

import errno
import fcntl
import os
import signal
from collections.abc import Callable
from pathlib import Path

import pytest

from augment.jobs import atomic
from augment.jobs.atomic import (
    TEMPORARY_SUFFIX,
    copy_file,
    remove_temporaries,
    replaced_file,
    replaced_folder,
    write_atomic,
)
from augment.jobs.store import LocalStore

DATA = b"whole" * 1000


def write_folder(path: Path) -> None:
    with replaced_folder(path, ("data", "more")) as new:
        (new / "more").mkdir()
        (new / "more" / "data").write_bytes(DATA)


def copy(path: Path) -> None:
    original = path.parent.parent / "original"
    original.write_bytes(DATA)
    copy_file(str(original), str(path))


WRITERS: dict[str, Callable[[Path], None]] = {
    "file": lambda path: write_atomic(path, DATA),
    "folder": write_folder,
    "copy": copy,
    "store": lambda path: LocalStore(path.parent).write(path.name, DATA),
}
CLEARED_BY_JOBS = ("copy", "store")  # at their start


def in_child(action: Callable[[], None]) -> int:
    """The exit code of a forked process that did it."""
    child = os.fork()
    if child == 0:
        code = 1
        try:
            action()
            code = 0
        finally:
            os._exit(code)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


def temporaries(folder: Path) -> list[Path]:
    return [path for path in folder.rglob("*") if TEMPORARY_SUFFIX in path.name]


@pytest.mark.parametrize("kind", WRITERS)
def test_a_run_with_the_number_of_a_killed_one_writes_the_same_and_leaves_nothing(
    tmp_path, monkeypatch, kind
):
    """As in containers, where every run has the process number of the last."""
    monkeypatch.setattr(os, "getpid", lambda: 7)
    path = tmp_path / "out" / "scene.v1"
    path.parent.mkdir()

    def killed() -> None:
        os.fsync = lambda _: os.kill(child_process(), signal.SIGKILL)
        WRITERS[kind](path)

    def child_process() -> int:
        return int(os.readlink("/proc/self"))

    for count in (1, 1) if kind == "file" else (1, 2):  # folders are cleared once one is in place
        assert in_child(killed) == -signal.SIGKILL
        assert len(temporaries(path.parent)) == count and not path.exists()
    if kind in CLEARED_BY_JOBS:
        remove_temporaries(path.parent)
    assert in_child(lambda: WRITERS[kind](path)) == 0
    assert [p.name for p in path.parent.iterdir()] == ["scene.v1"]
    assert (path / "more" / "data" if kind == "folder" else path).read_bytes() == DATA


@pytest.mark.parametrize("kind", ["file", "folder"])
def test_what_a_living_process_writes_stays(tmp_path, kind):
    path = tmp_path / "scene"
    go_on, begun = os.pipe(), os.pipe()

    def slowly() -> None:
        write = replaced_file(path) if kind == "file" else replaced_folder(path, ("mine",))
        with write as target:
            os.write(begun[1], b".")
            os.read(go_on[0], 1)
            if isinstance(target, Path):
                (target / "mine").write_bytes(b"last")
            else:
                target.write(b"last")

    child = os.fork()
    if child == 0:
        try:
            slowly()
        finally:
            os._exit(0)
    os.read(begun[0], 1)
    WRITERS[kind](path)  # clears beside it
    remove_temporaries(tmp_path)
    assert len(temporaries(tmp_path)) == 1
    os.write(go_on[1], b".")
    os.waitpid(child, 0)
    for end in (*go_on, *begun):
        os.close(end)
    assert (path / "mine" if kind == "folder" else path).read_bytes() == b"last"
    assert not temporaries(tmp_path)


def test_what_is_cleared_and_what_is_not(tmp_path):
    (tmp_path / "original").write_bytes(b"keep")
    dead = [f".x.99-0{TEMPORARY_SUFFIX}", f".x.0123456789abcdef{TEMPORARY_SUFFIX}"]
    others = [f".x.y.12-3{TEMPORARY_SUFFIX}", ".x.tmp", f"x{TEMPORARY_SUFFIX}", ".x.12.partial"]
    for name in (*dead, *others):
        (tmp_path / name).write_bytes(b"half")
    (tmp_path / f".x.1{TEMPORARY_SUFFIX}").symlink_to("original")
    os.link(tmp_path / "original", tmp_path / f".x.2{TEMPORARY_SUFFIX}")
    os.mkfifo(tmp_path / f".x.3{TEMPORARY_SUFFIX}")
    write_atomic(tmp_path / "x", DATA)
    assert sorted(os.listdir(tmp_path)) == sorted([*others, "original", "x"])
    remove_temporaries(tmp_path)
    assert sorted(os.listdir(tmp_path)) == sorted([*others[1:], "original", "x"])
    assert (tmp_path / "original").read_bytes() == b"keep"


def test_a_folders_leftovers_give_back_what_was_not_ours(tmp_path):
    for number, suffix in enumerate(("12-3", "0123456789abcdef", "0123456789abcdef.old")):
        left = tmp_path / f".scene.{suffix}{TEMPORARY_SUFFIX}"
        left.mkdir()
        (left / "data").write_bytes(b"old")
        (left / f"notes{number}.txt").write_text("keep")
    other = tmp_path / f".scene.v2.12-3{TEMPORARY_SUFFIX}"
    other.mkdir()
    write_folder(tmp_path / "scene")
    assert sorted(os.listdir(tmp_path)) == [other.name, "scene"]
    names = ["more", "notes0.txt", "notes1.txt", "notes2.txt"]
    assert sorted(os.listdir(tmp_path / "scene")) == names


def test_a_file_taken_for_left_behind_before_it_is_locked_is_made_anew(tmp_path, monkeypatch):
    lock, taken = fcntl.flock, []

    def late(descriptor, operation):
        if len(taken) < 3 and operation & fcntl.LOCK_EX:
            taken.append(descriptor)
            for path in temporaries(tmp_path):
                path.unlink()
        lock(descriptor, operation)

    monkeypatch.setattr(fcntl, "flock", late)
    write_atomic(tmp_path / "x", DATA)
    assert len(taken) == 3 and os.listdir(tmp_path) == ["x"]
    assert (tmp_path / "x").read_bytes() == DATA


def test_without_locks_age_tells_what_was_left(tmp_path, monkeypatch):
    def no_locks(*_):
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    monkeypatch.setattr(fcntl, "flock", no_locks)
    young, old = (tmp_path / f".x.{n}{TEMPORARY_SUFFIX}" for n in (1, 2))
    for path in (young, old):
        path.write_bytes(b"half")
    os.utime(old, (1e9, 1e9))
    write_atomic(tmp_path / "x", DATA)
    assert sorted(os.listdir(tmp_path)) == [young.name, "x"]


def test_a_name_may_be_as_long_as_the_system_allows(tmp_path):
    for name in ("a" * 255, "é" * 127, "雪" * 85):
        write_atomic(tmp_path / name, DATA)
        write_folder(tmp_path / "folders" / name)
        assert (tmp_path / name).read_bytes() == DATA
    assert not temporaries(tmp_path)
    assert atomic.temporary_beside(tmp_path / "x") != atomic.temporary_beside(tmp_path / "x")
