"""Samples a second out of an output folder and of a scene that is rendered on the fly, and memory.

The folder holds JPEGs of 960x540 of the procedural street with depth, boxes and calibration, or is
one that is there already. Files are read once before, so that the disk does not count.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from torch.utils.data import DataLoader, Dataset

from adapters.base import open_scene
from augment.dataset import SceneDataset, WeatherDataset, collate_frames
from augment.jobs.atomic import write_atomic
from augment.jobs.layout import MANIFEST_FILE
from augment.jobs.manifest import manifest_bytes, read_manifest
from augment.views import render_view
from recipes.load import load_recipe
from recipes.schema import Output, Recipe
from tools.bench.harness import (
    Action,
    Figures,
    Table,
    figures,
    machine_facts,
    peak_mib_in_subprocess,
    rounds,
    spread,
    spread_ratio,
)
from tools.bench.scenes import record_street, street_uri

BATCH = 8
CAMERAS = ("front", "front_left", "front_right", "back")
DECODING = "decoding alone (cv2.imdecode)"
# What is read of every sample: WeatherDataset's options. Images are compared with their checksums
# where `verify` is not False.
READINGS: Mapping[str, dict[str, Any]] = {
    "image, uint8": {"load": ("image",), "image_type": "uint8", "verify": False},
    "image, uint8, verified": {"load": ("image",), "image_type": "uint8"},
    "image, float32": {"load": ("image",), "verify": False},
    "image, float32, verified": {"load": ("image",)},
    "image, boxes, float32, verified": {"load": ("image", "boxes")},
    "image, depth, boxes, float32, verified": {"load": ("image", "depth", "boxes")},
}


@dataclass(frozen=True)
class DatasetCase:
    """images: in the folder. scale: of 960x540. rows: of the manifest whose memory is taken. live:
    images rendered on the fly. gaussians: of the street. workers: of DataLoaders. memory: whether
    it is measured.
    """

    images: int = 256
    scale: float = 1.0
    rows: int = 1_000_000
    live: int = 16
    gaussians: int = 60_000
    workers: tuple[int, ...] = (2, 1)
    readings: tuple[str, ...] = tuple(READINGS)
    memory: bool = True


FULL_CASE = DatasetCase()
QUICK_CASE = DatasetCase(images=32, rows=20_000, live=4)


def measure(
    quick: bool = False,
    folder: Path | None = None,
    repeats: int = 3,
    case: DatasetCase | None = None,
) -> Figures:
    """folder: an output folder with JPEG images to read; None makes one."""
    machine = machine_facts()
    case = case or (QUICK_CASE if quick else FULL_CASE)
    with tempfile.TemporaryDirectory(prefix="climategs-bench-") as name:
        scratch = Path(name)
        if folder is None:
            folder = scratch / "out"
            recipe = Recipe(name="clear", output=Output(image="jpg", depth="median"))
            size = {"frames": -(-case.images // len(CAMERAS)), "gaussians": case.gaussians}
            record_street(folder, recipe, scale=case.scale, cameras=CAMERAS, **size)
        facts, rows = _read(folder, case, repeats)
        live = _render_live(case, repeats)
        large = _write_manifest_of(scratch / "large", folder, case.rows)
        table_mib = WeatherDataset(large).rows.batch.nbytes / 2**20
        peak = peak_mib_in_subprocess(_opening_of, (large,)) if case.memory else None
    title = "{images} JPEGs of {width}x{height}, {kib:.0f} KiB each, batches of ".format(**facts)
    rates = ("what", "workers", "images/s")
    memory = ("rows", "MiB held", "MiB at most")
    tables = [
        Table(f"{title}{BATCH}", (*rates, "of decoding"), rows),
        Table("Rendered on the fly", (*rates, "of rendering"), live),
        Table("Opening a large manifest", memory, [(case.rows, table_mib, peak)]),
    ]
    return figures("dataset", tables, machine=machine, **facts)


def _write_manifest_of(target: Path, folder: Path, count: int) -> Path:
    """The folder's manifest, a variant after the other, of images that are not there."""
    table = read_manifest(folder)
    pieces = []
    variant = table["variant"][0].as_py()
    num_rows = table.num_rows
    for first in range(0, count, num_rows):
        piece = table.slice(0, min(num_rows, count - first))
        columns = dict(zip(piece.column_names, piece.columns, strict=True))
        name = f"fog-{first // num_rows:05d}"
        for key in columns:
            if key.endswith("_path"):
                columns[key] = pc.replace_substring(columns[key], variant, name)
        columns["variant"] = pa.array([name] * piece.num_rows, columns["variant"].type)
        columns["checksum"] = pa.array([f"{first + n:064x}" for n in range(piece.num_rows)])
        pieces.append(pa.table(columns))
    write_atomic(target / MANIFEST_FILE, manifest_bytes(pa.concat_tables(pieces)))
    return target


def _opening_of(folder: Path) -> Action:
    return lambda: WeatherDataset(folder)


def _read(folder: Path, case: DatasetCase, repeats: int) -> tuple[Figures, list[tuple]]:
    dataset = WeatherDataset(folder)
    files = [(folder / path).read_bytes() for path in dataset.table["image_path"].to_pylist()]
    size = {name: dataset.rows.row(0)[name] for name in ("width", "height")}
    facts = {"images": len(files), **size, "kib": sum(map(len, files)) / len(files) / 1024}
    rows: list[tuple] = []
    for workers in case.workers:
        readers = {DECODING: _pass_through(_Decoding(files), workers)} | {
            name: _pass_through(WeatherDataset(folder, **READINGS[name]), workers)
            for name in case.readings
        }
        rows += _rates(rounds(readers, repeats), workers, len(files))
    return facts, rows


def _render_live(case: DatasetCase, repeats: int) -> list[tuple]:
    """Samples of a scene in fog beside the same views without a DataLoader."""
    scene = open_scene(street_uri(-(-case.live // len(CAMERAS)), case.gaussians))
    recipe = load_recipe("dense-fog").resolve(0)
    recipe = recipe.model_copy(update={"output": Output(depth="none", labels=False)})
    live = SceneDataset(scene, recipe, cameras=CAMERAS, load=("image",))

    def render_all() -> None:
        for frame in scene.frames:
            for name in CAMERAS:
                render_view(scene, frame.cameras[name], recipe)

    renderers = {"rendering alone": render_all, "SceneDataset": _pass_through(live, 0)}
    return _rates(rounds(renderers, repeats), 0, len(live))


def _rates(seconds: Mapping[str, list[float]], workers: int, images: int) -> list[tuple]:
    """Medians; the fraction is of the first case, round by round."""
    limit = next(iter(seconds.values()))
    return [
        (name, workers, images / spread(times)["median"], spread_ratio(limit, times)["median"])
        for name, times in seconds.items()
    ]


def _pass_through(dataset: Dataset, workers: int) -> Callable[[], int]:
    """One pass through a dataset, whose workers live on."""
    loader = DataLoader(
        dataset,
        batch_size=BATCH,
        num_workers=workers,
        collate_fn=len if isinstance(dataset, _Decoding) else collate_frames,
        persistent_workers=workers > 0,
        multiprocessing_context="fork" if workers else None,
    )
    return lambda: sum(1 for _ in loader)


class _Decoding(Dataset):
    """Decodes images that are in memory, and hands nothing on."""

    def __init__(self, files: Sequence[bytes]) -> None:
        self.files = files

    def __len__(self) -> int:
        return len(self.files)

    def __getitem__(self, index: int) -> int:
        cv2.setNumThreads(0)
        cv2.imdecode(np.frombuffer(self.files[index], np.uint8), cv2.IMREAD_COLOR)
        return 0
