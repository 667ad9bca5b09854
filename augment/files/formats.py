"""The list of splat formats, and the choice of a reader.

A format is a record `SplatFormat` in its own file. The command line imports this module to name the
kinds of export, so it loads the formats, and with them torch, only when they are asked for.
"""

from __future__ import annotations

import functools
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from augment.errors import SceneError

if TYPE_CHECKING:
    from augment.files.splat_format import SplatFile, SplatFormat, SplatWriter

# The kinds of the formats that are written, in the order of `splat_formats`.
SplatKind = Literal["ply", "splat", "spz", "sog", "glb", "usd"]
# All kinds of export. Files of the first three kinds hold more than one moment.
ExportKind = Literal["file", "scene", "ply-parts", SplatKind]
_ZIP = b"PK\x03\x04"  # first bytes of a zip, which several formats are


@functools.cache
def splat_formats() -> tuple[SplatFormat, ...]:
    """Return all splat formats, in the order in which messages name them."""
    from augment.files.compressed_ply import COMPRESSED_PLY
    from augment.files.gltf import GLB, GLTF
    from augment.files.ksplat import KSPLAT
    from augment.files.ply import PLY
    from augment.files.sog import SOG
    from augment.files.splat import SPLAT
    from augment.files.splat_checkpoint import CHECKPOINT
    from augment.files.spz import SPZ
    from augment.files.streamed_sog import STREAMED_SOG
    from augment.files.usd import USD

    return (
        *(COMPRESSED_PLY, PLY, SPLAT, KSPLAT, SPZ, CHECKPOINT, SOG, GLB, GLTF, USD),
        STREAMED_SOG,
    )


def splat_suffixes() -> tuple[str, ...]:
    """Return the suffixes of all splat files, in lower case."""
    return tuple(suffix for splat_format in splat_formats() for suffix in splat_format.suffixes)


def splat_writer(kind: SplatKind) -> SplatWriter:
    """Return the writer of one kind of export."""
    writers = (splat_format.writer for splat_format in splat_formats())
    return next(writer for writer in writers if writer is not None and writer.kind == kind)


def join_names(names: Iterable[str], conjunction: str = "or") -> str:
    """Return names as part of a sentence: "a, b or c"."""
    *first_names, last_name = names
    return f"{', '.join(first_names)} {conjunction} {last_name}" if first_names else last_name


def splat_names() -> str:
    """Return the names of all formats of single files for messages: ".ply, ... or .usd"."""
    return join_names(f.name for f in splat_formats() if f.suffixes)


def read_splats(
    path: str | Path, *, activated: bool | None = None, level: int | None = None
) -> SplatFile:
    """Read a splat file of any format that is supported.

    Formats are recognised by the first bytes (.ply, .spz, .sog, .glb, checkpoints), the name
    (.splat, .ksplat, .gltf, .usd), the meta.json of a SOG folder, or the lod-meta.json of a
    streamed one.

    Args:
        path: the file.
        activated: for a .ply only, as in `augment.files.ply.read_ply`.
        level: for a lod-meta.json only, the level of detail; 0, the finest, by default.

    Raises:
        SceneError: the file does not exist, has an unknown format or damaged content, or its
            Gaussians need more memory than there is; the message says what was expected.
    """
    path = Path(path)
    try:
        splat_format = find_format(path)
        options = {"level": level, "activated": activated}
        stated_options = {name: value for name, value in options.items() if value is not None}
        for name in stated_options:
            if splat_format is None or name != splat_format.option:
                raise SceneError(f"{path}{_OPTION_ERRORS[name]}")
        if splat_format is None:
            raise SceneError(_unknown_format(path))
        return splat_format.reader(path, **stated_options)
    except MemoryError as error:
        raise SceneError(f"{path}: its Gaussians need more memory than there is: {error}") from None
    except OSError as error:
        raise SceneError(f"{path} cannot be read: {error.strerror or error}") from error


# The end of a sentence on an option that the file's format does not have.
_OPTION_ERRORS = {
    "level": " has no levels of detail, as a lod-meta.json has; leave lod out",
    "activated": (
        ": only a .ply may store values before or after their activation; leave activated out"
    ),
}


def find_format(path: Path) -> SplatFormat | None:
    """Return the format of a file; None if neither its first bytes nor its name tell."""
    if not path.is_file():
        raise SceneError(f"{path}: no such file; expected a {splat_names()}")
    with path.open("rb") as file:
        start = file.read(8)
    by_name = next((f for f in splat_formats() if f.fits_name(path)), None)
    if by_name is not None and start.startswith(_ZIP):
        return by_name  # a .usdz is a zip, and so is a .sog
    by_bytes = (f for f in splat_formats() if start.startswith(f.first_bytes))
    return next((f for f in by_bytes if f.fits_content(path)), by_name)


def _unknown_format(path: Path) -> str:
    """Return the message on a file of an unknown format."""
    formats = [f for f in splat_formats() if f.suffixes]
    by_bytes = join_names(f.name for f in formats if f.first_bytes)
    by_suffix = join_names(f.name for f in formats if not f.first_bytes)
    return (
        f"{path}: neither a {by_bytes}, which its first bytes would tell, nor named {by_suffix}; "
        "convert other splat formats (.lcc) to .ply first, for example with splat-transform"
    )
