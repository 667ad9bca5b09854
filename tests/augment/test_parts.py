"""Parts and the manifest against a model of what a reader must see, also while they change."""

from __future__ import annotations

import itertools
import tempfile
import threading
from pathlib import Path

import pyarrow as pa
import pytest
from batch_scenes import make_recipe
from hypothesis import given, settings
from hypothesis import strategies as st

from augment.errors import OutputError
from augment.jobs.layout import path_kinds
from augment.jobs.manifest import (
    FAILED,
    OK,
    Identity,
    Pictured,
    compact,
    image_row,
    latest_rows,
    list_parts,
    parts_to_merge,
    publish_part,
    read_finished,
    rows_to_table,
)
from augment.jobs.store import Store, open_store

RECIPE = make_recipe()
IDENTITY = Identity("fake:a", RECIPE.hash, "recorded", "1", "cpu")
PATHS = {f"{kind}_path": "a.png" if kind == "image" else None for kind in path_kinds()}


def table(frames: dict[int, bool], message: str = "", scene: str = "a") -> pa.Table:
    """Rows of frames; the values say whether they are finished."""
    rows = [
        image_row(scene, RECIPE, IDENTITY, Pictured(frame, "front", frame, 4, 3), paths=PATHS,
                  status=OK if done else FAILED, message=message)
        for frame, done in frames.items()
    ]  # fmt: skip
    return rows_to_table(rows)


def seen(rows: pa.Table) -> dict[tuple[str, int], tuple[bool, str]]:
    return {(r["scene"], r["frame"]): (r["status"] == OK, r["message"]) for r in rows.to_pylist()}


def frames_of(store: Store) -> dict[int, tuple[bool, str]]:
    return {frame: state for (_, frame), state in seen(read_finished(store)).items()}


@st.composite
def some_tables(draw: st.DrawFn) -> list[dict[int, bool]]:
    frames = st.dictionaries(st.integers(0, 6), st.booleans(), max_size=6)
    return draw(st.lists(frames, min_size=1, max_size=4))


@given(some_tables())
@settings(max_examples=40, deadline=None)
def test_latest_rows_are_those_of_the_first_table(frames: list[dict[int, bool]]) -> None:
    tables = [table(given, str(number)) for number, given in enumerate(frames)]
    wanted: dict[tuple[str, int], tuple[bool, str]] = {}
    for number, given_frames in reversed(list(enumerate(frames))):
        wanted |= {("a", f): (done, str(number)) for f, done in given_frames.items()}
    found = latest_rows(tables)
    assert seen(found) == wanted
    assert found["frame"].to_pylist() == sorted({frame for _, frame in wanted})


def test_of_two_rows_in_one_table_the_finished_one_counts() -> None:
    both = pa.concat_tables([table({1: False}, "old"), table({1: True}, "new")])
    assert seen(latest_rows([both])) == {("a", 1): (True, "new")}


# Blocks by number: block n has frames 2n and 2n + 1.
STEPS = st.one_of(
    st.tuples(st.just("publish"), st.integers(0, 2), st.booleans(), st.booleans()),
    st.tuples(st.just("compact")),
)


@given(st.lists(STEPS, max_size=6))
@settings(max_examples=15, deadline=None)
def test_what_is_published_is_seen_whatever_is_merged_when(steps: list[tuple]) -> None:
    with tempfile.TemporaryDirectory() as where:
        store = open_store(where)
        model: dict[int, tuple[bool, bool]] = {}
        numbers = itertools.count()
        for step in steps:
            if step[0] == "compact":
                compact(store)
                assert parts_to_merge(store) == 0
            else:
                _, block, first, second = step
                rows = table({2 * block: first, 2 * block + 1: second}, str(next(numbers)))
                publish_part(store, f"a/fog-{block}", rows)
                if model.get(block) != (True, True):
                    model[block] = (first, second)
            if model:
                expected = {2 * b + k: ok for b, oks in model.items() for k, ok in enumerate(oks)}
                assert {f: ok for f, (ok, _) in frames_of(store).items()} == expected
        parts = list_parts(store)
        assert {int(k[-1]): not p.has_failures for k, p in parts.items()} == {
            block: all(oks) for block, oks in model.items()
        }
        if model:  # the manifest is what is made of the parts alone
            compact(store)
            data = store.read("manifest.parquet")
            store.delete(["manifest.parquet"])
            compact(store)
            assert store.read("manifest.parquet") == data


def test_nothing_is_finished_yet(tmp_path: Path) -> None:
    store = open_store(tmp_path)
    assert compact(store) is None and parts_to_merge(store) == 0
    with pytest.raises(OutputError, match=r"neither manifest\.parquet nor finished blocks"):
        read_finished(store)


def test_a_finished_block_is_not_replaced_by_a_failed_one(tmp_path: Path) -> None:
    store = open_store(tmp_path)
    whole = publish_part(store, "a/b", table({0: True}))
    assert publish_part(store, "a/b", table({0: False}, "died")).name == whole.name
    assert frames_of(store) == {0: (True, "")}


def test_what_a_killed_process_left_beside_its_successor_goes(tmp_path: Path) -> None:
    store = open_store(tmp_path)
    old = publish_part(store, "a/b", table({0: False}, "died"))
    data = store.read(old.path)
    new = publish_part(store, "a/b", table({0: True}))
    store.write(old.path, data)  # as if killed before it was deleted
    assert list_parts(store)["a/b"].name == new.name
    assert frames_of(store) == {0: (True, "")}
    compact(store)
    assert list(store.list(".climategs/parts")) == [new.path]


def test_a_part_that_is_replaced_while_it_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = open_store(tmp_path)
    publish_part(store, "a/b", table({0: False}, "died"))
    read, done = type(store).read, []

    def replaced(self: Store, path: str) -> bytes:
        if path.endswith(".failed.parquet") and not done:
            done.append(path)
            publish_part(store, "a/b", table({0: True}))
        return read(self, path)

    monkeypatch.setattr(type(store), "read", replaced)
    assert frames_of(store) == {0: (True, "")} and done


def test_readers_while_blocks_are_published_and_merged(tmp_path: Path) -> None:
    """A reader sees ever more blocks, each whole, and never an error."""
    store, errors, counts = open_store(tmp_path), [], []
    publish_part(store, "a/block-0", table({0: True, 1: True}))
    stop = threading.Event()

    def look() -> None:
        try:
            while not stop.is_set():
                counts.append(len(frames_of(open_store(tmp_path))))
        except Exception as error:
            errors.append(error)

    reader = threading.Thread(target=look)
    reader.start()
    for number in range(1, 15):
        rows = {2 * number: True, 2 * number + 1: True}
        failing = {frame: False for frame in rows}
        publish_part(store, f"a/block-{number}", table(failing, "first"))
        if number % 3 == 0:
            compact(store)
        publish_part(store, f"a/block-{number}", table(rows))
    stop.set()
    reader.join()
    assert errors == [] and counts == sorted(counts) and all(n % 2 == 0 for n in counts)
    assert frames_of(store) == {frame: (True, "") for frame in range(30)}


@pytest.mark.parametrize("note", [b"{", b"5", b"null", b'{"a": 1}', b"[1, null]", b"[" * 10**5])
def test_a_damaged_note_in_the_manifest(tmp_path: Path, note: bytes) -> None:
    """The parts are what is true."""
    from augment.jobs.manifest import manifest_bytes

    store = open_store(tmp_path)
    publish_part(store, "a/b", table({0: True}))
    rows = compact(store)
    assert rows is not None
    store.write("manifest.parquet", manifest_bytes(rows.replace_schema_metadata(
        {b"climategs.parts": note})))  # fmt: skip
    assert frames_of(store) == {0: (True, "")} and parts_to_merge(store) == 1
