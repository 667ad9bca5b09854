"""`climategs bench dataset`: samples a second of the two datasets, and memory of a long manifest.

`measure` reads samples from an output folder, and renders samples of a scene on the fly. The folder
is the caller's, or one that is made here: JPEGs of 960x540 of the procedural street with depth,
boxes and calibration. All files are read once before, so that the disk does not count.
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
from augment.output.atomic import write_atomic
from augment.output.manifest import manifest_bytes, read_manifest
from augment.output.names import MANIFEST_FILE
from augment.view.render_view import render_view
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

BATCH = 8  # The number of samples of a batch.
CAMERAS = ("front", "front_left", "front_right", "back")  # The cameras of the street's samples.
DECODING = "decoding alone (cv2.imdecode)"  # The row with which readings are compared.
# The options of WeatherDataset by the row's name. Images are compared with their checksums unless
# `verify` is False.
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
    """The sizes that are measured."""

    images: int = 256
    """The number of images in the folder that is made."""
    scale: float = 1.0
    """The scale of its images, relative to 960x540."""
    rows: int = 1_000_000
    """The number of rows of the manifest whose memory is measured."""
    live: int = 16
    """The number of images that are rendered on the fly."""
    gaussians: int = 60_000
    """The number of Gaussians of the street."""
    workers: tuple[int, ...] = (2, 1)
    """The numbers of worker processes of DataLoaders, one measurement for each."""
    readings: tuple[str, ...] = tuple(READINGS)
    """The names of the READINGS that are measured."""
    memory: bool = True
    """True if memory is measured."""


FULL_CASE = DatasetCase()  # The case of published figures.
# The case of `--quick`.
QUICK_CASE = DatasetCase(images=32, rows=20_000, live=4)


def measure(
    quick: bool = False,
    folder: Path | None = None,
    repeats: int = 3,
    case: DatasetCase | None = None,
) -> Figures:
    """Measure both datasets and the memory of a long manifest.

    Args:
        quick: True for QUICK_CASE.
        folder: An output folder with JPEG images; None makes one.
        repeats: The number of rounds that count.
        case: Sizes; None for FULL_CASE or QUICK_CASE.
    """
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
        large = _write_long_manifest(scratch / "large", folder, case.rows)
        table_mib = WeatherDataset(large).rows.batch.nbytes / 2**20
        peak = peak_mib_in_subprocess(_open_dataset, (large,)) if case.memory else None
    title = "{images} JPEGs of {width}x{height}, {kib:.0f} KiB each, batches of ".format(**facts)
    rates = ("what", "workers", "images/s")
    memory = ("rows", "MiB held", "MiB at most")
    tables = [
        Table(f"{title}{BATCH}", (*rates, "of decoding"), rows),
        Table("Rendered on the fly", (*rates, "of rendering"), live),
        Table("Opening a large manifest", memory, [(case.rows, table_mib, peak)]),
    ]
    return figures("dataset", tables, machine=machine, **facts)


def _write_long_manifest(target: Path, folder: Path, count: int) -> Path:
    """Write a manifest of `count` rows, without images, and return its folder.

    The rows are those of the folder's manifest, again and again with other names of the variant.
    """
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


def _open_dataset(folder: Path) -> Action:
    """Return an action that opens a folder."""
    return lambda: WeatherDataset(folder)


def _read(folder: Path, case: DatasetCase, repeats: int) -> tuple[Figures, list[tuple]]:
    """Return facts of the folder's images, and rows of all readings and of decoding alone."""
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
    """Rows of a scene in fog as a dataset, and of the same views rendered in a loop."""
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
    """Rows of rates: medians, and the share of the first case's rate, round by round."""
    limit = next(iter(seconds.values()))
    return [
        (name, workers, images / spread(times)["median"], spread_ratio(limit, times)["median"])
        for name, times in seconds.items()
    ]


def _pass_through(dataset: Dataset, workers: int) -> Callable[[], int]:
    """Return an action that reads a dataset once. Its worker processes live on between passes."""
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
    """A dataset that decodes images from memory and returns nothing."""

    def __init__(self, files: Sequence[bytes]) -> None:
        self.files = files

    def __len__(self) -> int:
        return len(self.files)

    def __getitem__(self, index: int) -> int:
        cv2.setNumThreads(0)
        cv2.imdecode(np.frombuffer(self.files[index], np.uint8), cv2.IMREAD_COLOR)
        return 0
