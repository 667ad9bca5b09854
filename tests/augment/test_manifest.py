"""A manifest from anybody: what is refused, and what older versions' mean."""

from __future__ import annotations

import io
import math
from collections.abc import Callable
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from batch_scenes import fake_render, make_recipe, open_fake

from augment.errors import OutputError
from augment.jobs.manifest import (
    MAX_SIDE_PX,
    later_columns,
    manifest_bytes,
    parse_manifest,
    read_manifest,
)
from augment.jobs.render_job import RenderJob, run_job
from augment.jobs.tables import read_table


@pytest.fixture(scope="module")
def manifest(tmp_path_factory: pytest.TempPathFactory) -> pa.Table:
    """Of eight images, as a job wrote it."""
    out = tmp_path_factory.mktemp("manifest")
    job = RenderJob("fake:street", [make_recipe()], out)
    run_job(job, scene_loader=open_fake, renderer=fake_render, progress=False)
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
    assert parsed(manifest.slice(0, 0)).num_rows == 0


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
    pa.register_extension_type(Unpickling())
    try:
        for name in ("a", "ab", "abc", "abcd"):  # base64 may start anywhere
            plain = pa.array(["text"])
            columns = {name: pa.ExtensionArray.from_storage(Unpickling(), plain), "plain": plain}
            path = tmp_path / f"{name}.parquet"
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
