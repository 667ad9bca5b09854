"""The record of nuScenes."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path

from adapters.dataset import Dataset, FolderLayout, OpenLabels, Signature, fixed_tree, names_in

_TABLES = "v1.0-*/scene.json"


def _is_nuscenes(folder: Path) -> bool:
    versions = (name for name in names_in(folder) if name.startswith("v1.0-"))
    if any((folder / name / "scene.json").is_file() for name in versions):
        return True
    from adapters.nuscenes.tables import table_folders  # under any other name

    return (folder / "samples").is_dir() and bool(table_folders(folder))


def _files_of_scene(path: str, _query: dict[str, str], open_labels: OpenLabels) -> Iterator[Path]:
    """Return the files of one scene: the folder holds hundreds."""
    from adapters.nuscenes.adapter import NuScenesLabels

    root = Path(path)
    labels = open_labels()
    assert isinstance(labels, NuScenesLabels)
    tables = labels.tables
    yield root / tables.version
    for frame in labels.frames:
        yield from (root / f.filename for f in (frame.sweep, *frame.images.values()))
    yield from (root / name for name in tables.semantic_files.values())


def _tables(path: str) -> Iterable[Path]:
    """Return the folders of tables, which alone are read for the digest."""
    return [file.parent for file in sorted(Path(path).glob("*/sample.json"))]


NUSCENES = Dataset(
    scheme="nuscenes",
    description="a nuScenes dataset",
    page="nuscenes.md",
    example="nuscenes:data/nuscenes?scene=scene-0061",
    opener="adapters.nuscenes.adapter:open_nuscenes",
    labels="adapters.nuscenes.adapter:nuscenes_labels",
    is_raw=True,
    folder=Signature(_is_nuscenes, f"a nuScenes dataset ({_TABLES})"),
    layouts=(FolderLayout("a nuScenes dataset", {_TABLES: (_TABLES,), "samples/": ("samples",)}),),
    source_tree=fixed_tree(
        r"(samples|sweeps)/CAM_[^/]+/[^/]+\.jpg", r"(samples|sweeps)/LIDAR_TOP/[^/]+\.pcd\.bin"
    ),
    scene_files=_files_of_scene,
    list_scenes="adapters.nuscenes.recordings:list_scenes",
    conditions="adapters.nuscenes.recordings:recorded_conditions",
    content_files=_tables,
)
