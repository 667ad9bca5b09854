"""How fast a DataLoader gets samples out of an output folder, beside decoding its images alone.

The folder is made here: JPEGs of 960x540 as a job writes them, with depth, boxes and calibration;
or it is one that is there already. Files are read once before, so that the disk does not count.
"""

from __future__ import annotations

import dataclasses
import json
import statistics
import sys
import tempfile
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tools.bench_dataset_folder import write_folder, write_manifest_of
from tools.bench_memory import extra_mib, measured_apart
from tools.machine import load_average, machine_facts, machine_line

BATCH = 8


@dataclass(frozen=True)
class Case:
    """images: in the folder. width, height: theirs. rows: of the manifest whose memory is taken."""

    images: int = 256
    width: int = 960
    height: int = 540
    rows: int = 1_000_000


WHOLE = Case()
QUICK = Case(images=32, rows=20_000)


@dataclass(frozen=True)
class Way:
    """One way to read. options: of WeatherDataset; None is decoding alone."""

    what: str
    workers: int
    options: dict[str, Any] | None


DECODING = "decoding alone (cv2.imdecode)"
_IMAGE = {"load": ("image",), "verify": False}
WAYS = (
    Way(DECODING, 2, None),
    Way("image, uint8", 2, {**_IMAGE, "image_type": "uint8"}),
    Way("image, uint8, verified", 2, {**_IMAGE, "image_type": "uint8", "verify": True}),
    Way("image, float32", 2, _IMAGE),
    Way("image, float32, verified", 2, {**_IMAGE, "verify": True}),
    Way("image, boxes, float32, verified", 2, {"load": ("image", "boxes")}),
    Way("image, depth, boxes, float32, verified", 2, {"load": ("image", "depth", "boxes")}),
    Way(DECODING, 1, None),
    Way("image, uint8", 1, {**_IMAGE, "image_type": "uint8"}),
    Way("image, depth, boxes, float32, verified", 1, {"load": ("image", "depth", "boxes")}),
)


def bench_dataset(
    case: Case = WHOLE, *, folder: Path | None = None, repeats: int = 7
) -> dict[str, Any]:
    """Images a second of every way, and the memory of a large manifest.

    folder: an output folder to read; None makes one.
    """
    machine = dataclasses.asdict(machine_facts())
    with tempfile.TemporaryDirectory(prefix="climategs-bench-") as name:
        scratch = Path(name)
        if folder is None:
            folder = scratch / "out"
            write_folder(folder, case.images, case.width, case.height)
        facts, rates = _rates(folder, repeats)
        write_manifest_of(scratch / "large", case.rows)
        peak, held = (_memory_apart(scratch / "large", what) for what in ("peak", "held"))
    limits = {w.workers: r for w, r in zip(WAYS, rates, strict=True) if w.options is None}
    rows = [_row(way, own, limits[way.workers]) for way, own in zip(WAYS, rates, strict=True)]
    return {
        "machine": machine,
        "load_after": load_average(),
        **facts,
        "rows": rows,
        "memory": {"rows": case.rows, "peak_mib": peak, "held_mib": held},
    }


def _row(way: Way, rates: Sequence[float], limits: Sequence[float]) -> dict[str, Any]:
    """Medians; the fraction is of the same round's limit, for others may use the machine too."""
    fractions = [rate / limit for rate, limit in zip(rates, limits, strict=True)]
    return {
        "what": way.what,
        "workers": way.workers,
        "images_per_s": statistics.median(rates),
        "of_limit": statistics.median(fractions),
    }


def dataset_text(result: dict[str, Any]) -> str:
    memory = result["memory"]
    lines = [
        machine_line(result),
        f"{result['images']} images of {result['width']}x{result['height']}, "
        f"{result['image_kib']:.0f} KiB each; batches of {BATCH}",
        f"{'':42} {'workers':>7} {'images/s':>9} {'of decoding':>12}",
    ]
    lines += [
        f"{row['what']:42} {row['workers']:7} {row['images_per_s']:9.0f} {row['of_limit']:12.2f}"
        for row in result["rows"]
    ]
    lines.append(
        f"a manifest of {memory['rows']:,} rows: {memory['held_mib']:.0f} MiB in the dataset, "
        f"{memory['peak_mib']:.0f} MiB at most while it is opened"
    )
    return "\n".join(lines)


def _rates(folder: Path, repeats: int) -> tuple[dict[str, Any], list[list[float]]]:
    """Images a second of each way and round; the rounds take all ways in turn."""
    from augment.dataset import WeatherDataset

    dataset = WeatherDataset(folder)
    paths = [str(folder / path) for path in dataset.table["image_path"].to_pylist()]
    size = sum(Path(path).stat().st_size for path in paths) / len(paths) / 1024
    facts = {
        "images": len(dataset),
        "width": dataset.rows["width"][0],
        "height": dataset.rows["height"][0],
        "image_kib": size,
    }
    loaders = [_loader(way, folder, paths) for way in WAYS]
    for loader in loaders:
        _passed(loader)  # starts the workers, and reads the files
    rates: list[list[float]] = [[] for _ in WAYS]
    for _ in range(repeats):
        for loader, own in zip(loaders, rates, strict=True):
            begun = time.perf_counter()
            count = _passed(loader)
            own.append(count / (time.perf_counter() - begun))
    return facts, rates


def _loader(way: Way, folder: Path, paths: Sequence[str]) -> Iterable[Any]:
    from torch.utils.data import DataLoader

    from augment.dataset import WeatherDataset, collate_frames

    dataset: Any = _Decoding([Path(path).read_bytes() for path in paths])
    if way.options is not None:
        dataset = WeatherDataset(folder, **way.options)
    return DataLoader(
        dataset,
        batch_size=BATCH,
        num_workers=way.workers,
        collate_fn=len if way.options is None else collate_frames,
        persistent_workers=True,
        multiprocessing_context="fork",
    )


def _passed(loader: Iterable[Any]) -> int:
    return sum(batch if isinstance(batch, int) else len(batch["scene"]) for batch in loader)


class _Decoding:
    """Decodes images that are in memory, and hands nothing on."""

    def __init__(self, files: Sequence[bytes]) -> None:
        self.files = files

    def __len__(self) -> int:
        return len(self.files)

    def __getitem__(self, index: int) -> int:
        import cv2
        import numpy as np

        cv2.setNumThreads(0)
        cv2.imdecode(np.frombuffer(self.files[index], np.uint8), cv2.IMREAD_COLOR)
        return 0

    def __iter__(self) -> Iterator[int]:
        return map(self.__getitem__, range(len(self)))


def _memory_apart(folder: Path, what: str) -> float:
    return measured_apart("tools.bench_dataset", {"folder": str(folder), "what": what}, what)


def _memory(folder: str, what: str) -> float:
    """MiB of opening a dataset: at the highest moment, or of the arrays that it keeps."""
    from augment.dataset import WeatherDataset

    if what == "peak":
        return extra_mib(lambda: WeatherDataset(folder))
    return WeatherDataset(folder).rows.nbytes / 2**20


def main(arguments: Sequence[str]) -> None:
    print(_memory(**json.loads(arguments[0])))


if __name__ == "__main__":
    main(sys.argv[1:])
