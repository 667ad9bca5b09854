"""The order of the library's modules: each imports only what stands before it.

`ROOMS` is the order, and the picture in docs/design.md shows it. A module belongs to the room with
the longest matching prefix, so that a folder may give single modules to an earlier or later room.
Imports inside functions and for type checking count as well.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]

# Rooms in their order, each with the modules and packages in it.
ROOMS: dict[str, tuple[str, ...]] = {
    "recipes": ("recipes",),
    "base": ("augment", "augment.errors", "augment.memo", "augment.rng", "augment.timing"),
    "kernels": (
        "augment.progress",
        "augment.render.compile_ahead",
        "augment.render.constants",
        "augment.render.cpu.hash_kernels",
        "augment.render.cpu.jit",
        "augment.render.cpu.kernel_cache",
        "augment.render.cpu.simd",
        "augment.render.cuda.runtime",
        "augment.render.layout",
        "augment.render.mode_depth",
        "augment.render.sh",
        "augment.render.threads",
    ),
    "scene": ("augment.scene",),
    "render": ("augment.render",),
    "detail": ("augment.detail", "augment.render.rasterize"),
    "atomic": (
        "augment.output.atomic",
        "augment.output.box_tables",
        "augment.output.codecs",
        "augment.output.tables",
    ),
    "files": ("augment.files",),
    "light": ("augment.light",),
    "photo": ("augment.photo",),
    "exposure": ("augment.exposure",),
    "layers": ("augment.view.layers",),
    "effects": ("augment.effects",),
    "output": ("augment.output",),
    "metrics": ("augment.metrics",),
    "view": ("augment.view",),
    "reconstruct": ("augment.reconstruct",),
    "dataset": ("augment.dataset",),
    "jobs": ("augment.jobs",),
    "adapters": ("adapters",),
    "tools": ("tools",),
}
# Lazy imports that close a circle: the choice between CPU and GPU, made once a process.
CIRCLES = {
    ("augment.render.buffers", "augment.render.cpu.driver"),
    ("augment.render.buffers", "augment.render.cuda.driver"),
}


def module_paths() -> dict[str, Path]:
    """Return the file of every module, by the module's name."""
    paths = (
        path
        for name in ("recipes", "augment", "adapters", "tools")
        for path in (ROOT / name).rglob("*.py")
    )
    return {
        ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): path
        for path in paths
    }


def imports_of(path: Path, modules: dict[str, Path]) -> Iterator[str]:
    """Yield the modules of this project that a file imports, wherever the statement stands."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name in modules)
        elif isinstance(node, ast.ImportFrom) and node.module in modules:
            for alias in node.names:
                name = f"{node.module}.{alias.name}"
                yield name if name in modules else node.module


def room_of(module: str) -> str:
    """Return the room with the longest prefix of a module's name."""
    fits = (
        (len(prefix), room)
        for room, prefixes in ROOMS.items()
        for prefix in prefixes
        if f"{module}.".startswith(f"{prefix}.")
    )
    return max(fits)[1]
