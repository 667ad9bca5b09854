"""What opening a trained scene takes: time and memory, each in a process of its own.

A Street Gaussians model is made of random splats; its scene is opened as it is, as a scene folder
and as one file. Files are read once before, so that the disk does not count.
"""

from __future__ import annotations

import dataclasses
import json
import statistics
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from tools.bench_memory import extra_mib, measured_apart
from tools.bench_open_model import write_model
from tools.machine import load_average, machine_facts, machine_line

GAUSSIANS, ACTORS = 1_000_000, 20
QUICK_GAUSSIANS = 50_000


def bench_open(*, quick: bool = False, repeats: int = 5) -> dict[str, Any]:
    """Seconds and memory of every way to open the same Gaussians."""
    machine = dataclasses.asdict(machine_facts())
    gaussians = QUICK_GAUSSIANS if quick else GAUSSIANS
    with tempfile.TemporaryDirectory(prefix="climategs-bench-") as name:
        folder = Path(name)
        model, data, tensor_bytes = write_model(folder, gaussians, ACTORS)
        uri = f"street_gaussians:{model}?data={data}"
        kept = _keep(uri, folder)
        ways = {"Street Gaussians model (.pth)": (uri, tensor_bytes)}
        ways |= {what: (f"scene:{path}", size) for what, (path, size) in kept.items()}
        rows = [_measure(what, uri, size, repeats) for what, (uri, size) in ways.items()]
    return {
        "machine": machine,
        "load_after": load_average(),
        "gaussians": gaussians,
        "actors": ACTORS,
        "rows": rows,
    }


def open_text(result: dict[str, Any]) -> str:
    lines = [
        machine_line(result),
        f"{result['gaussians']:,} Gaussians, {result['actors']} actors among them; files in memory",
        f"{'':34} {'open':>8} {'tensors':>9} {'peak memory / tensors':>22}",
    ]
    lines += [
        f"{row['what']:34} {row['open_s']:6.2f} s {row['tensor_mib']:5.0f} MiB "
        f"{row['memory']:21.2f}"
        for row in result["rows"]
    ]
    return "\n".join(lines)


def _keep(uri: str, folder: Path) -> dict[str, tuple[Path, int]]:
    """The scene written in our own formats: where, and the bytes of its tensors."""
    from adapters.base import open_scene
    from augment.files.scene_file import save_scene, save_scene_file

    scene = open_scene(uri)
    held = scene.gaussian_bytes + scene.sky.faces.numel() * 4  # pyright: ignore
    save_scene(scene, folder / "scene")
    save_scene_file(scene, folder / "scene.climategs")
    save_scene_file(scene, folder / "half.climategs", half=True)
    return {
        "scene folder": (folder / "scene", held),
        "scene file": (folder / "scene.climategs", held),
        "scene file, half precision": (folder / "half.climategs", held),
    }


def _measure(what: str, uri: str, tensor_bytes: int, repeats: int) -> dict[str, Any]:
    seconds = [_apart(uri, "time") for _ in range(1 + repeats)][1:]  # the first reads the disk
    mib = tensor_bytes / 2**20
    return {
        "what": what,
        "open_s": statistics.median(seconds),
        "tensor_mib": mib,
        "memory": _apart(uri, "memory") / mib,
    }


def _apart(uri: str, what: str) -> float:
    return measured_apart("tools.bench_open", {"uri": uri, "what": what}, uri)


def _open_once(uri: str, what: str) -> float:
    from adapters.base import open_scene

    _import_all()
    if what == "memory":
        return extra_mib(lambda: open_scene(uri))
    begun = time.perf_counter()
    open_scene(uri)
    return time.perf_counter() - begun


def _import_all() -> None:
    """What opening imports is not measured: a long-lived process imports it once."""
    import importlib

    from adapters.uri import SCHEMES

    for scheme in ("scene", "street_gaussians"):  # a saved scene has the labels of its source
        importlib.import_module(SCHEMES[scheme].module)


def main(arguments: Sequence[str]) -> None:
    print(_open_once(**json.loads(arguments[0])))


if __name__ == "__main__":
    main(sys.argv[1:])
