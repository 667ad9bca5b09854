"""Manifests: what is refused of anybody's, and what readers see while parts become one."""

from __future__ import annotations

import io
import itertools
import math
import tempfile
from collections.abc import Callable
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from augment.errors import OutputError
from augment.output.layout import path_kinds
from augment.output.manifest import (
    FAILED,
    MAX_SIDE_PX,
    OK,
    Identity,
    ImageFacts,
    compact,
    image_row,
    later_columns,
    latest_rows,
    list_parts,
    manifest_bytes,
    parse_manifest,
    parts_to_merge,
    publish_part,
    read_manifest,
    read_manifest_rows,
    rows_to_table,
)
from augment.output.store import Store, open_store
from augment.output.tables import read_table
from recipes.moment import SceneTimes
from tests.augment.batch_scenes import fog_job, make_recipe, run_fake


@pytest.fixture(scope="module")
def manifest(tmp_path_factory: pytest.TempPathFactory) -> pa.Table:
    """Of eight images, as a job wrote it."""
    out = tmp_path_factory.mktemp("manifest")
    run_fake(fog_job(out))
    return pq.read_table(out / "manifest.parquet")


def parsed(table: pa.Table) -> pa.Table:
    sink = io.BytesIO()
    pq.write_table(table, sink)
    return parse_manifest(sink.getvalue(), "out/manifest.parquet")


def put(name: str, row: int, value: object) -> Callable[[pa.Table], pa.Table]:
    """The table with another value in one place."""

    def change(table: pa.Table) -> pa.Table:
        values = table[name].to_pylist()
        values[row] = value
        column = pa.array(values, table[name].type)
        return table.set_column(table.column_names.index(name), name, column)

    return change


def put_column(name: str, make: Callable[[pa.ChunkedArray], object]):
    def change(table: pa.Table) -> pa.Table:
        return table.set_column(table.column_names.index(name), name, make(table[name]))

    return change


def no_utf8(column: pa.ChunkedArray) -> pa.Array:
    _, ends, letters = pa.array(column.to_pylist()).buffers()
    damaged = pa.py_buffer(b"\xff" + letters.to_pybytes()[1:])
    return pa.Array.from_buffers(pa.string(), len(column), [None, ends, damaged])


REFUSED = {
    "a path upwards": (put("image_path", 3, "../a.png"), "'image_path', row 3 .* got '../a.png'"),
    "upwards inside": (put("depth_path", 0, "a/../../b.png"), "'depth_path', row 0"),
    "an absolute path": (put("labels_path", 1, "/etc/passwd"), "'labels_path', row 1"),
    "a path of Windows": (put("lidar_path", 1, "..\\a"), "'lidar_path', row 1"),
    "a zero in a path": (put("image_path", 1, "a\0.png"), "'image_path', row 1"),
    "no path": (put("calibration_path", 1, ""), "'calibration_path', row 1"),
    "a finished image without a file": (put("image_path", 2, None), "'image_path', row 2"),
    "no scene": (put("scene", 4, None), "'scene', row 4 .* must be a value; got None"),
    "no frame": (put("frame", 4, None), "'frame', row 4"),
    "no checksum": (put("checksum", 7, None), "'checksum', row 7"),
    "another status": (put("status", 0, "done"), "'status', row 0 .* 'ok' or 'failed'; got 'done'"),
    "no width": (put("width", 0, 0), f"'width', row 0 .* must be 1 to {MAX_SIDE_PX} .*; got 0"),
    "a huge height": (put("height", 5, 1 << 40), "'height', row 5"),
    "endless smog": (put("smog_extinction_per_m", 6, math.inf), "extinction_per_m', row 6"),
    "a scale of zero": (put("render_scale", 6, 0.0), "'render_scale', row 6"),
    "two rows of an image": (
        lambda table: pa.concat_tables([table, table.slice(2, 1)]),
        "2 are of scene 'street', variant 'fog-000', frame 1, camera 'front', .* row 2",
    ),
    "a lost column": (lambda t: t.drop_columns(["variant"]), r"lacks the columns \['variant'\]"),
    "numbers as texts": (
        put_column("frame", lambda c: c.cast(pa.string())),
        "'frame' must be of type int64; got string",
    ),
    "weather in texts": (
        put_column("snow_depth_m", lambda c: c.cast(pa.string())),
        "'snow_depth_m' must be of type double; got string",
    ),
    "codes for texts": (
        put_column("camera", lambda c: c.dictionary_encode()),
        "'camera' must be of type string; got dictionary",
    ),
    "lists": (
        put_column("seed", lambda c: pa.array([[1]] * len(c))),
        "'seed' must be of type int64; got list",
    ),
    "a column that no version has": (
        lambda table: table.append_column("mood", pa.array(["good"] * len(table))),
        "'mood' must be of type double; got string",
    ),
    "a column twice": (
        lambda table: table.append_column("scene", table["scene"]),
        "has several columns 'scene'",
    ),
    "bytes that are no text": (put_column("recipe", no_utf8), "not a readable Parquet file.*UTF8"),
}


def test_what_no_job_writes_is_refused_by_file_column_and_row(manifest: pa.Table) -> None:
    for name, (change, message) in REFUSED.items():
        with pytest.raises(OutputError, match=message) as caught:
            parsed(change(manifest))
        assert str(caught.value).startswith("out/manifest.parquet"), name


def test_what_jobs_and_careful_programs_write_is_read(manifest: pa.Table) -> None:
    assert manifest_bytes(parsed(manifest)) == manifest_bytes(manifest)
    failed = put("image_path", 2, None)(put("status", 2, "failed")(manifest))
    assert parsed(failed)["status"].to_pylist().count("failed") == 1
    # pandas writes NaN as null.
    empty = put_column("snow_depth_m", lambda c: pa.nulls(len(c), pa.float64()))(manifest)
    assert all(math.isnan(depth) for depth in parsed(empty)["snow_depth_m"].to_pylist())
    old = parsed(manifest.drop_columns(list(later_columns())))
    assert old.column_names == manifest.column_names
    assert set(old["surface"].to_pylist()) == {"solid"} and old["quality"].null_count == 8
    # An output whose only variant is being overwritten has no rows.
    assert parsed(manifest.slice(0, 0)).num_rows == 0
    assert parse_manifest(manifest_bytes(rows_to_table([])), "manifest").num_rows == 0


class Unpickling(pa.ExtensionType):
    """A type that runs what a file says, as pyarrow's own did up to 14.0.0, and others' do."""

    ran: list[bytes] = []  # noqa: RUF012 - what every instance adds to

    def __init__(self) -> None:
        super().__init__(pa.string(), "tests.unpickling")

    def __arrow_ext_serialize__(self) -> bytes:
        return b"cos\nsystem\n(S'true'\ntR."

    @classmethod
    def __arrow_ext_deserialize__(cls, storage_type: pa.DataType, serialized: bytes) -> Unpickling:
        cls.ran.append(serialized)
        return cls()


def test_extension_types_of_a_file_are_never_made(tmp_path: Path) -> None:
    path = tmp_path / "a.parquet"
    pa.register_extension_type(Unpickling())
    try:
        for name in ("a", "ab", "abc", "abcd"):  # base64 may start anywhere
            plain = pa.array(["text"])
            columns = {name: pa.ExtensionArray.from_storage(Unpickling(), plain), "plain": plain}
            pq.write_table(pa.table(columns), path)
            Unpickling.ran.clear()
            for source in (path, path.read_bytes()):
                with pytest.raises(OutputError, match=r"labels has a column of an Arrow extension"):
                    read_table(source, "labels")
            assert Unpickling.ran == []
        pq.read_table(path)
        assert Unpickling.ran != []  # so it would have run
    finally:
        pa.unregister_extension_type("tests.unpickling")


def test_a_manifest_that_is_none(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="does not exist"):
        read_manifest(tmp_path)
    for data in (b"", b"PAR1", b"PAR1" + b"\xff" * 40 + b"PAR1", b"\xff" * 8):
        (tmp_path / "manifest.parquet").write_bytes(data)
        with pytest.raises(OutputError, match=r"manifest\.parquet is missing or not a readable"):
            read_manifest(tmp_path)


# ---- Parts and the manifest against a model of what a reader must see ---------------------------

RECIPE = make_recipe()
IDENTITY = Identity("fake:a", RECIPE.hash, "recorded", "1", "cpu")
PATHS = {f"{kind}_path": "a.png" if kind == "image" else None for kind in path_kinds()}


def table(frames: dict[int, bool], message: str = "", scene: str = "a") -> pa.Table:
    """Rows of frames; the values say whether they are finished."""
    rows = [
        image_row(scene, RECIPE, IDENTITY, ImageFacts(frame, "front", frame, 4, 3),
                  SceneTimes(0, 1), paths=PATHS,
                  status=OK if done else FAILED, message=message)
        for frame, done in frames.items()
    ]  # fmt: skip
    return rows_to_table(rows)


def seen(rows: pa.Table) -> dict[tuple[str, int], tuple[bool, str]]:
    return {(r["scene"], r["frame"]): (r["status"] == OK, r["message"]) for r in rows.to_pylist()}


def frames_of(store: Store) -> dict[int, tuple[bool, str]]:
    return {frame: state for (_, frame), state in seen(read_manifest_rows(store)).items()}


@st.composite
def some_tables(draw: st.DrawFn) -> list[dict[int, bool]]:
    frames = st.dictionaries(st.integers(0, 6), st.booleans(), max_size=6)
    return draw(st.lists(frames, min_size=1, max_size=4))


@given(some_tables())
@settings(max_examples=40, deadline=None)
def test_latest_rows_are_those_of_the_first_table(frames: list[dict[int, bool]]) -> None:
    tables = [table(statuses, str(number)) for number, statuses in enumerate(frames)]
    expected_rows: dict[tuple[str, int], tuple[bool, str]] = {}
    for number, given_frames in reversed(list(enumerate(frames))):
        expected_rows |= {("a", f): (done, str(number)) for f, done in given_frames.items()}
    latest_table = latest_rows(tables)
    assert seen(latest_table) == expected_rows
    assert latest_table["frame"].to_pylist() == sorted({frame for _, frame in expected_rows})


def test_of_two_rows_in_one_table_the_finished_one_counts() -> None:
    both = pa.concat_tables([table({1: False}, "old"), table({1: True}, "new")])
    assert seen(latest_rows([both])) == {("a", 1): (True, "new")}


# Blocks by number: block n has frames 2n and 2n + 1.
STEPS = st.one_of(
    st.tuples(st.just("publish"), st.integers(0, 2), st.booleans(), st.booleans()),
    st.tuples(st.just("compact")),
)


@given(st.lists(STEPS, max_size=6))
@settings(max_examples=6, deadline=None)
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


def test_a_finished_block_is_not_replaced_by_a_failed_one(tmp_path: Path) -> None:
    store = open_store(tmp_path)
    complete_part = publish_part(store, "a/b", table({0: True}))
    assert publish_part(store, "a/b", table({0: False}, "died")).name == complete_part.name
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
    read_file = type(store).read
    done = []

    def replaced(self: Store, path: str) -> bytes:
        if path.endswith(".failed.parquet") and not done:
            done.append(path)
            publish_part(store, "a/b", table({0: True}))
        return read_file(self, path)

    monkeypatch.setattr(type(store), "read", replaced)
    assert frames_of(store) == {0: (True, "")} and done


def test_a_damaged_note_in_the_manifest(tmp_path: Path) -> None:
    """The parts are what is true."""
    store = open_store(tmp_path)
    publish_part(store, "a/b", table({0: True}))
    rows = compact(store)
    assert rows is not None
    for note in (b"{", b"5", b"null", b'{"a": 1}', b"[1, null]", b"[" * 10**5):
        rows = rows.replace_schema_metadata({b"climategs.parts": note})
        store.write("manifest.parquet", manifest_bytes(rows))
        assert frames_of(store) == {0: (True, "")} and parts_to_merge(store) == 1
