"""Temporary files: no two have one name, dead processes' go, living ones' stay."""

from __future__ import annotations

import errno
import fcntl
import os
import signal
from collections.abc import Callable
from pathlib import Path

import pytest

from augment.errors import OutputError
from augment.jobs.processes import OutputLock, file_lock
from augment.output import atomic
from augment.output.atomic import (
    TEMPORARY_SUFFIX,
    copy_file,
    open_lock,
    path_below,
    read_file,
    remove_temporaries,
    wait_for_lock,
    write_atomic,
    write_file_atomically,
    write_folder_atomically,
)
from augment.output.claims import try_lock
from augment.output.store import LocalStore

DATA = b"whole" * 1000


def write_folder(path: Path) -> None:
    with write_folder_atomically(path, ("data", "more")) as new:
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
    go_on = os.pipe()
    begun = os.pipe()

    def slowly() -> None:
        write = (
            write_file_atomically(path)
            if kind == "file"
            else write_folder_atomically(path, ("mine",))
        )
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
    foreign_names = [
        f".x.y.12-3{TEMPORARY_SUFFIX}",
        ".x.tmp",
        f"x{TEMPORARY_SUFFIX}",
        ".x.12.partial",
    ]
    for name in (*dead, *foreign_names):
        (tmp_path / name).write_bytes(b"half")
    (tmp_path / f".x.1{TEMPORARY_SUFFIX}").symlink_to("original")
    os.link(tmp_path / "original", tmp_path / f".x.2{TEMPORARY_SUFFIX}")
    os.mkfifo(tmp_path / f".x.3{TEMPORARY_SUFFIX}")
    write_atomic(tmp_path / "x", DATA)
    assert sorted(os.listdir(tmp_path)) == sorted([*foreign_names, "original", "x"])
    remove_temporaries(tmp_path)
    assert sorted(os.listdir(tmp_path)) == sorted([*foreign_names[1:], "original", "x"])
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
    lock = fcntl.flock
    removed_files = []

    def late(descriptor, operation):
        if len(removed_files) < 3 and operation & fcntl.LOCK_EX:
            removed_files.append(descriptor)
            for path in temporaries(tmp_path):
                path.unlink()
        lock(descriptor, operation)

    monkeypatch.setattr(fcntl, "flock", late)
    write_atomic(tmp_path / "x", DATA)
    assert len(removed_files) == 3 and os.listdir(tmp_path) == ["x"]
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
    assert atomic.temporary_path(tmp_path / "x") != atomic.temporary_path(tmp_path / "x")


def _link(path: Path) -> None:
    path.symlink_to(path.parent.parent / "victim")


def _dangling_link(path: Path) -> None:
    path.symlink_to(path.parent.parent / "nothing")


def _hard_link(path: Path) -> None:
    os.link(path.parent.parent / "victim", path)


NO_LOCKS: dict[str, Callable[[Path], object]] = {
    "link": _link,
    "dangling link": _dangling_link,
    "hard link": _hard_link,
    "zeros": lambda path: path.symlink_to("/dev/zero"),
    "pipe": os.mkfifo,
    "folder": Path.mkdir,
    "file of somebody's": lambda path: path.write_text("precious"),
}
LOCKERS: dict[str, Callable[[Path], object]] = {
    "output": lambda path: OutputLock(path.parent.parent).__enter__(),
    "claim": try_lock,
    "shared file": lambda path: file_lock(path, "tests").__enter__(),
}


@pytest.mark.parametrize("locker", LOCKERS)
@pytest.mark.parametrize("kind", NO_LOCKS)
def test_what_is_no_lock_is_refused_and_stays_as_it_is(tmp_path, kind, locker):
    (tmp_path / "victim").write_text("precious")
    lock = tmp_path / ".climategs" / "lock"
    lock.parent.mkdir()
    NO_LOCKS[kind](lock)
    before = lock.lstat()
    with pytest.raises(OutputError, match=f"{lock} is a .*lock of climategs.*delete it"):
        LOCKERS[locker](lock)
    assert (tmp_path / "victim").read_text() == "precious"
    assert sorted(os.listdir(tmp_path)) == [".climategs", "victim"]
    assert (lock.lstat().st_ino, lock.lstat().st_size) == (before.st_ino, before.st_size)


def test_a_state_folder_that_leads_out_of_the_output_is_refused(tmp_path):
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / ".climategs").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(OutputError, match="leads through a link"):
        OutputLock(tmp_path / "out").__enter__()
    assert os.listdir(tmp_path / "elsewhere") == []


def test_a_lock_held_for_ever_is_waited_for_no_longer_than_said(tmp_path):
    path = tmp_path / "lock"
    holder = open_lock(path)
    waiter = open_lock(path)
    fcntl.flock(holder, fcntl.LOCK_EX)
    with pytest.raises(OutputError, match=r"has held this lock for 0 s \(builds\); end it"):
        wait_for_lock(path, waiter, patience_s=0.1, activity="builds")
    fcntl.flock(holder, fcntl.LOCK_UN)
    wait_for_lock(path, waiter, patience_s=0.1, activity="builds")
    os.close(holder)
    os.close(waiter)


def test_a_link_that_leads_to_itself_is_no_file(tmp_path):
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    with pytest.raises(OSError, match="symbolic links"):
        read_file(path_below(tmp_path, ("loop", "file")))


@pytest.mark.parametrize("make", [os.mkfifo, lambda path: path.symlink_to("/dev/zero")])
def test_pipes_and_devices_are_not_read(tmp_path, make):
    make(tmp_path / "file")
    with pytest.raises(OSError, match="not a regular file"):
        read_file(tmp_path / "file")
