"""Outputs that somebody else has changed: readers say what is wrong, and never fail otherwise."""

from __future__ import annotations

import json
import math
import random
import shutil
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from augment.dataset import WeatherDataset
from augment.errors import ClimateGSError
from augment.jobs.render_job import RenderJob, run_job
from augment.output.store import open_store
from augment.output.tables import METADATA_KEY
from recipes.flood import Flood
from tests.augment.batch_scenes import fake_render, make_recipe, open_fake
from tools.cli import EvaluateOptions
from tools.evaluate import evaluate_output
from tools.report import write_report
from tools.sheet import draw_sheet
from tools.view.outputs import OutputViewer

TYPES = [pa.int32(), pa.float64(), pa.string(), pa.binary(), pa.bool_(), pa.null(),
         pa.list_(pa.int64()), pa.struct([("a", pa.int64())]), pa.timestamp("ns"),
         pa.decimal128(38, 2), pa.large_string()]  # fmt: skip
VALUES: dict[str, list[Any]] = {
    "string": [None, "", "a\0b", "a\nb", "/etc/passwd", "../a", "a//b/", "x" * 5000, "{", "\u202e"],
    "int64": [None, 0, -1, 2**31, 2**62, -(2**63), 2**63 - 1],
    "double": [None, math.nan, math.inf, -math.inf, 1e308, -1.0, 0.0, 5e-324],
}


@pytest.fixture(scope="module")
def output(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Of one camera in two kinds of weather, with labels of all kinds and sweeps."""
    out = tmp_path_factory.mktemp("damaged")
    recipes = [make_recipe(), make_recipe("wet", flood=Flood(level_m=0.3))]
    job = RenderJob("fake:street", recipes, out, frames=[1, 2], cameras=["front"])
    run_job(job, scene_loader=open_fake, renderer=fake_render, progress=False)
    return out


def samples(out: Path) -> None:
    files = WeatherDataset(out, load=("image", "depth", "boxes", "lidar"))
    for index in range(len(files)):
        files[index]


def evaluated(out: Path) -> None:
    evaluate_output(EvaluateOptions(out=str(out), long=2, pairs=1), progress=False)


def looked_through(out: Path) -> None:
    viewer = OutputViewer(open_store(str(out)))
    for row in viewer.rows:
        viewer.picture(row, "image")


READERS: dict[str, Callable[[Path], object]] = {
    "sheet": draw_sheet,
    "report": lambda out: write_report(out, images=2),
    "evaluate": evaluated,
    "dataset": samples,
    "viewer": looked_through,
}


def outcomes(out: Path) -> Counter[str]:
    """How many readers were content, and how many refused; any other error is raised."""
    found: Counter[str] = Counter()
    for read in READERS.values():
        try:
            read(out)
            found["read"] += 1
        except ClimateGSError as error:
            assert str(error)
            found["refused"] += 1
    return found


def changed_tables(table: pa.Table, rng: random.Random) -> Iterator[pa.Table]:
    """The table with a column lost, of another type, coded, or with another value, over and over;
    doubled, turned round and empty."""
    for at, name in enumerate(table.column_names):
        column, kind = table[name], table[name].type
        yield table.drop_columns([name])
        yield table.set_column(at, name, pa.nulls(len(table), rng.choice(TYPES)))
        yield table.set_column(at, name, column.dictionary_encode())
        for value in rng.sample(VALUES.get(str(kind), [None]), k=min(2, len(VALUES[str(kind)]))):
            values = column.to_pylist()
            values[rng.randrange(len(values))] = value
            yield table.set_column(at, name, pa.array(values, kind))
    yield from (pa.concat_tables([table, table]), table.slice(0, 0), pa.table({}))
    yield table.take(pa.array(range(len(table))[::-1]))
    yield table.append_column("further", pa.array(["?"] * len(table)))
    yield table.replace_schema_metadata({b"climategs.parts": b"[" * 10**5})


def test_readers_refuse_changed_manifests_and_never_fail_otherwise(
    output: Path, tmp_path: Path
) -> None:
    out = Path(shutil.copytree(output, tmp_path / "out"))
    assert outcomes(out) == {"read": len(READERS)}
    whole = pq.read_table(out / "manifest.parquet")
    rng, found = random.Random(0), Counter[str]()
    for changed in rng.sample(list(changed_tables(whole, rng)), k=8):
        pq.write_table(changed, out / "manifest.parquet")
        found += outcomes(out)
    assert found["refused"] > 8 and found["read"] > 3


def changed_notes(note: Any, rng: random.Random) -> Iterator[bytes]:
    """The metadata of a file with another value somewhere, over and over."""
    for _ in range(12):
        copy = json.loads(json.dumps(note))
        at, key = copy, rng.choice(list(copy))
        while isinstance(at[key], dict | list) and at[key] and rng.random() < 0.8:
            at = at[key]
            key = rng.choice(list(at) if isinstance(at, dict) else range(len(at)))
        at[key] = rng.choice([None, -1, "x", [], {}, 10**30, 1.5, True])
        yield json.dumps(copy).encode()
    yield from (b"{", b"[]", b"null", b"[" * 10**5)


@pytest.mark.long
def test_readers_refuse_changed_label_files_and_never_fail_otherwise(
    output: Path, tmp_path: Path
) -> None:
    out = Path(shutil.copytree(output, tmp_path / "out"))
    rng, found = random.Random(1), Counter[str]()
    for path in sorted((out / "street" / "wet-000").rglob("*.parquet")):
        data, table = path.read_bytes(), pq.read_table(path)
        note = json.loads(table.schema.metadata[METADATA_KEY])
        tables = [
            table.replace_schema_metadata({METADATA_KEY: n}) for n in changed_notes(note, rng)
        ]
        for at, name in enumerate(table.column_names):
            tables += [table.drop_columns([name]), table.set_column(at, name, pa.nulls(len(table)))]
        for changed in rng.sample(tables, k=5):
            pq.write_table(changed, path)
            found += outcomes(out)
        path.write_bytes(data)
    assert found["refused"] > 12 and outcomes(out) == {"read": len(READERS)}
