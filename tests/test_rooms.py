"""The order of the library's modules: each imports only what stands before it.

`ROOMS` is the order, and the picture in docs/design.md shows it. A module belongs to the room with
the longest matching prefix, so that a folder may give single modules to an earlier or later room.
Imports inside functions and for type checking count as well.
"""

from __future__ import annotations

import ast
import functools
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
    "disk": (
        "augment.files.stated_sizes",
        "augment.output.atomic",
        "augment.output.box_tables",
        "augment.output.names",
        "augment.output.tables",
    ),
    "files": ("augment.files",),
    "light": ("augment.light",),
    "photo": ("augment.photo",),
    "exposure": ("augment.exposure",),
    "lamps": ("augment.lamps",),
    "layers": ("augment.view.layers",),
    "effects": ("augment.effects",),
    "output": ("augment.output", "augment.suite.suite_file"),
    "metrics": ("augment.metrics",),
    "view": ("augment.view",),
    "reconstruct": ("augment.reconstruct",),
    "dataset": ("augment.dataset",),
    "scores": ("augment.scores",),
    "jobs": ("augment.jobs",),
    "suite": ("augment.suite",),
    "adapters": ("adapters",),
    "tools": ("tools",),
}
MAX_ROOT_FILES = 6  # at the root of augment/, `__init__` among them


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


@functools.cache
def import_graph() -> dict[str, set[str]]:
    """Return the modules that each module imports."""
    modules = module_paths()
    return {module: {*imports_of(path, modules)} - {module} for module, path in modules.items()}


def room_graph() -> dict[str, set[str]]:
    """Return the rooms that each room imports, without itself."""
    graph: dict[str, set[str]] = {room: set() for room in ROOMS}
    for module, imported_modules in import_graph().items():
        graph[room_of(module)] |= {room_of(imported) for imported in imported_modules}
    return {room: imported_rooms - {room} for room, imported_rooms in graph.items()}


def picture_edges() -> set[tuple[str, str]]:
    """Return the arrows of a picture of the rooms, each from a room to one that imports it.

    An arrow that others imply is left out: a -> c where there are a -> b and b -> c.
    """
    graph = room_graph()
    below: dict[str, set[str]] = {}  # all rooms that a room stands on, directly or not
    for room in ROOMS:
        below[room] = graph[room].union(*(below[lower] for lower in graph[room]))
    return {
        (lower, room)
        for room in ROOMS
        for lower in graph[room]
        if not any(lower in below[between] for between in graph[room])
    }


def test_every_module_imports_only_its_own_room_and_earlier_ones():
    order = list(ROOMS)
    upward_imports = [
        f"{module} ({room_of(module)}) imports {imported} ({room_of(imported)})"
        for module, imported_modules in import_graph().items()
        for imported in imported_modules
        if order.index(room_of(imported)) > order.index(room_of(module))
    ]
    assert upward_imports == []


def test_no_imports_of_the_library_close_a_circle_even_inside_functions():
    """A dataset's record names its reader, so that adapters import in circles when they open."""
    modules = import_graph().items()
    library = {name: imported for name, imported in modules if name.startswith(("aug", "rec"))}
    graph = {name: imported & library.keys() for name, imported in library.items()}
    while True:  # take away modules that import nothing that is left
        free = {module for module, imported in graph.items() if not imported & graph.keys()}
        if not free:
            break
        graph = {module: imported for module, imported in graph.items() if module not in free}
    assert graph == {}, "these modules import each other, or stand on modules that do"


def test_every_room_is_a_folder_or_a_file_that_exists():
    modules = module_paths()
    prefixes = [prefix for room in ROOMS.values() for prefix in room]
    assert [prefix for prefix in prefixes if prefix not in modules] == []
    assert {room_of(module) for module in modules} == set(ROOMS)


def test_few_files_lie_at_the_root_of_the_library():
    files = sorted(path.name for path in (ROOT / "augment").glob("*.py"))
    assert len(files) <= MAX_ROOT_FILES, files


def test_the_picture_of_the_rooms_shows_the_imports():
    (picture,) = re.findall(
        r"```mermaid\n(.*?)```", (ROOT / "docs/design.md").read_text(), flags=re.DOTALL
    )
    arrows = set(re.findall(r"^ *(\w+) --> (\w+)$", picture, flags=re.MULTILINE))
    assert arrows == picture_edges()
    assert set(re.findall(r"^ *(\w+)\[", picture, flags=re.MULTILINE)) == set(ROOMS)
