"""Records of finished scenes: scene files of our own, and splats of any program."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from adapters.dataset import Dataset, Signature, names_in, read_start

# Endings of files that lie beside splats and belong to them.
_COMPANION_SUFFIXES = {".json", ".txt", ".bin", ".webp"}


def _is_scene_folder(folder: Path) -> bool:
    from augment.files.scene_file import is_scene_folder

    return is_scene_folder(folder)


def _is_scene_file(path: Path) -> bool:
    from augment.files.scene_file import is_scene_file

    return is_scene_file(path)


def _scene_content(path: str) -> Iterable[Path]:
    from augment.files.scene_file import FILES, LEVELS

    root = Path(path)
    if not root.is_dir():
        return [root]
    return [root / name for name in (*FILES, LEVELS) if (root / name).is_file()]


SCENE = Dataset(
    scheme="scene",
    description="what `climategs fit` made, or a `.climategs` file",
    page="scene-files.md",
    example="scene:out/fitted",
    opener="adapters.scene_folder:open_scene_folder",
    folder=Signature(_is_scene_folder, "a scene folder (scene.json)"),
    file=Signature(_is_scene_file, "a scene file (.climategs)"),
    content_files=_scene_content,
    is_hashed_whole=True,
)


def _holds_splats(folder: Path) -> bool:
    from augment.files.formats import splat_suffixes
    from augment.files.sog import is_sog_folder
    from augment.files.streamed_sog import LOD_META

    if any(folder.glob("point_cloud/iteration_*/point_cloud.ply")):
        return True
    if (folder / LOD_META).is_file() or is_sog_folder(folder):
        return True
    return any(name.lower().endswith(splat_suffixes()) for name in names_in(folder))


def _is_splat_file(path: Path) -> bool:
    from augment.files.formats import splat_suffixes
    from augment.files.ply import PLY
    from augment.files.sog import META, is_sog_folder
    from augment.files.streamed_sog import LOD_META

    if path.name == LOD_META or (path.name == META and is_sog_folder(path.parent)):
        return True
    suffix = path.suffix.lower()
    is_named = suffix in splat_suffixes() and suffix not in PLY.suffixes
    return is_named or read_start(path).startswith(PLY.first_bytes)


def _splat_folder_words() -> str:
    from augment.files.formats import splat_names

    return (
        f"a trained 3DGS model (point_cloud/iteration_N/point_cloud.ply), {splat_names()} files, a "
        "lod-meta.json, or meta.json and images of SOG, in it"
    )


def _splat_file_words() -> str:
    from augment.files.formats import splat_names

    return f"a {splat_names()} file or a lod-meta.json"


def _splat_content(path: str) -> Iterable[Path]:
    from adapters.scene_cache import visible_files
    from augment.files.formats import splat_suffixes

    root = Path(path)
    if not root.is_dir():
        return [root]
    suffixes = {*splat_suffixes(), *_COMPANION_SUFFIXES}
    return [file for file in visible_files(root) if file.suffix.lower() in suffixes]


GAUSSIANS = Dataset(
    scheme="gaussians",
    description=(
        "a `.ply`, `.splat`, `.ksplat`, `.spz`, `.sog`, `.glb` or `.usd`, or a trained 3DGS "
        "model's folder"
    ),
    page="splat-files.md",
    example="gaussians:model/point_cloud.ply?up=-y",
    opener="adapters.gaussian_files:open_gaussians",
    folder=Signature(_holds_splats, _splat_folder_words),
    file=Signature(_is_splat_file, _splat_file_words),
    content_files=_splat_content,
    is_hashed_whole=True,
)
