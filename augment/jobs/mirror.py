"""Copy of a dataset's folder in which images and sweeps of a variant replace the recorded ones.

In: the dataset's folder (`DatasetFolder`), and the files to put in place (`Replacement`). Out: the
copy, and a record of it. Called by `climategs mirror` (`tools/mirror.py`).

    <out>/source/<variant>/<dataset's folder>/...                    files for the dataset's tools
    <out>/source/<variant>/climategs-mirror-<dataset's folder>.json  record of the complete copy
    <out>/source/<variant>/climategs-mirror-<dataset's folder>.files list of the files put there

Every file that is not replaced is the source's own file under a second name (a hard link), or a
copy of it where links are not possible. A second build goes on after a kill, and brings an older
copy up to date; it stops where other programs have edited the copy. A dataset of many scenes has
one copy, to which each scene adds its images.
"""

from __future__ import annotations

import json
import os
import re
import stat
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache, cached_property, partial
from pathlib import Path
from typing import Any, Literal, NamedTuple

import cv2
import numpy as np
from pydantic import BaseModel
from tqdm import tqdm

from augment.effects.lidar.codes import drop_lost_returns
from augment.errors import AdapterError, OutputError
from augment.files.image_size import read_image_header
from augment.jobs.placed_files import ANY_SIZE, PlacedFile, PlacedFiles, digest_of
from augment.jobs.write_pump import WritePump
from augment.output.atomic import (
    copy_file,
    flush_folder,
    link_file,
    make_output_error,
    move_temporary,
    raise_output_error,
    temporary_names,
    temporary_path,
    write_atomic,
    write_file_atomically,
)
from augment.output.codecs import decode_image, encode_image
from augment.output.layout import parse_errors_as_output_errors
from augment.output.manifest import OK
from augment.output.names import folder_name, resolve_inside
from augment.output.tables import read_lidar
from augment.scene.cameras import Frame
from augment.scene.labels import LabelSource, StoresLidar
from recipes.load import load_recipe
from recipes.schema import Output

# ---- The files of a dataset, with their places in a copy of it -----------------------------------
# A dataset's own entries (`samples`, `camera` ...) may be links to other disks. Links below them
# must stay within the dataset, and stay links in the copy; other links would lead the copy to
# foreign files.


@dataclass(frozen=True)
class DatasetFolder:
    """A dataset in a folder."""

    uri: str
    """URI that the dataset was opened by."""
    root: Path
    """Absolute path of the folder; its name is the copy's name too."""
    images: str
    """Regular expression that matches the complete paths of camera images, relative to root."""
    entries: tuple[str, ...] | None = None
    """Names in root that belong to the dataset; None for all."""
    sweep_pattern: str = r"(?!)"  # matches no path
    """Regular expression that matches the complete paths of LiDAR sweeps, relative to root."""

    @cached_property
    def bases(self) -> tuple[tuple[str, str], ...]:
        """Real paths of the dataset's folders and files, each with its place relative to root.

        The first is root itself; the others are the targets of its entries that lead elsewhere.
        """
        real_root = os.path.realpath(self.root)
        try:
            names = sorted(os.listdir(real_root))
        except OSError as error:
            raise AdapterError(f"{self.root} cannot be listed: {error.strerror}") from error
        if not self.root.name:
            raise AdapterError(f"{self.root} has no name; a dataset must lie in a folder")
        bases = [(real_root, "")]
        for name in names:
            path = os.path.join(real_root, name)
            if not self.has(name) or not os.path.islink(path):
                continue
            real_path = os.path.realpath(path)
            if is_within(real_path, real_root):
                continue
            if not os.path.exists(real_path):
                raise AdapterError(
                    f"{path} is a link to {real_path}, which does not exist; put it there, or "
                    f"delete the link"
                )
            if is_within(real_root, real_path):
                raise AdapterError(
                    f"{path} is a link to {real_path}, which holds the dataset itself; delete the "
                    f"link"
                )
            bases.append((real_path, name))
        return tuple(bases)

    def place_of(self, path: str | Path) -> str | None:
        """Return the place of a file or folder relative to root, links followed; None outside."""
        real_path = os.path.realpath(path)
        for base, name in self.bases:
            if is_within(real_path, base):
                inner_path = os.path.relpath(real_path, base)
                parts = [part for part in (name, inner_path) if part not in ("", ".")]
                place = "/".join(parts)
                return place if not place or self.has(place.split("/")[0]) else None
        return None

    def is_image(self, relative: str) -> bool:
        """Return True for the path of a camera image."""
        return re.fullmatch(self.images, relative) is not None

    def is_sweep(self, relative: str) -> bool:
        """Return True for the path of a LiDAR sweep."""
        return re.fullmatch(self.sweep_pattern, relative) is not None

    def has(self, name: str) -> bool:
        """Return True if this entry of root belongs to the dataset."""
        return self.entries is None or name in self.entries


class SourceFile(NamedTuple):
    """A file of the dataset."""

    relative: str
    """Path relative to the dataset's root."""
    path: str
    """Real path of the file."""
    facts: os.stat_result
    """Result of os.lstat for that path."""


class SourceFolder(NamedTuple):
    """Direct contents of one folder."""

    relative: str
    """Path relative to the root; "" for the root itself."""
    files: list[SourceFile]
    """Files of the folder."""
    folders: list[tuple[str, str]]
    """Relative and real path of each folder in it."""
    links: list[tuple[str, str]]
    """Relative path and text of each link in it; links lead to other parts of the dataset."""


class FileCounts(NamedTuple):
    """Counts of a dataset's files."""

    files: int
    """Number of all files."""
    images: int
    """Number of camera images."""
    sweeps: int = 0
    """Number of LiDAR sweeps."""


def survey(tree: DatasetFolder) -> FileCounts:
    """Count the files of a dataset without reading them."""
    names = [file.relative for folder in walk(tree) for file in folder.files]
    return FileCounts(len(names), sum(map(tree.is_image, names)), sum(map(tree.is_sweep, names)))


def walk(tree: DatasetFolder, relative: str = "", path: str = "") -> Iterator[SourceFolder]:
    """Yield the folders of a dataset, each before those in it, in order of name.

    Args:
        relative: Folder to begin with, relative to the root.
        path: Real path of that folder.
    """
    path = path or os.path.realpath(tree.root)
    linked_paths = {} if relative else {name: real_path for real_path, name in tree.bases}
    contents = SourceFolder(relative, [], [], [])
    try:
        for name in sorted(os.listdir(path)):
            if not relative and not tree.has(name):
                continue
            place = f"{relative}/{name}".lstrip("/")
            real_path = linked_paths.get(name, os.path.join(path, name))
            facts = os.lstat(real_path)
            if stat.S_ISREG(facts.st_mode):
                contents.files.append(SourceFile(place, real_path, facts))
            elif stat.S_ISDIR(facts.st_mode):
                contents.folders.append((place, real_path))
            elif stat.S_ISLNK(facts.st_mode):
                contents.links.append((place, _link_text(tree, place, real_path)))
            else:
                raise AdapterError(
                    f"{real_path} is neither a file nor a folder nor a link; a dataset's copy "
                    f"cannot have it, move it elsewhere"
                )
    except OSError as error:
        raise AdapterError(f"{error.filename or path} cannot be read: {error.strerror}") from error
    yield contents
    for inner_place, real_path in contents.folders:
        yield from walk(tree, inner_place, real_path)


def is_within(path: str, folder: str) -> bool:
    """Return True if a real path is the folder, or in it."""
    return path == folder or path.startswith(folder.rstrip("/") + "/")


def _link_text(tree: DatasetFolder, place: str, path: str) -> str:
    """Return the text of the copy's link that leads to the same part of the copy."""
    target = tree.place_of(path)
    if target is None:
        raise AdapterError(
            f"{path} is a link to {os.path.realpath(path)}, outside {tree.root}. A copy of the "
            f"dataset can have links within it, and {tree.root}'s own entries may be links to "
            f"other places: put the file itself there, or the link higher up"
        )
    return os.path.relpath(target or ".", os.path.dirname(place) or ".")


# ---- Putting files and links in place ------------------------------------------------------------

# A file of the copy is a hard link of the original.
LINKED = "linked"
# A file of the copy has the same size and time as the original.
COPIED = "copied"


def find_placement(target: str, original: os.stat_result) -> str | None:
    """Return how the original is in place: LINKED, COPIED, or None if it is not.

    COPIED means the same size and time.
    """
    facts = _facts(target)
    if facts is None or not stat.S_ISREG(facts.st_mode):
        return None
    if (facts.st_dev, facts.st_ino) == (original.st_dev, original.st_ino):
        return LINKED
    is_same = (facts.st_size, facts.st_mtime_ns) == (original.st_size, original.st_mtime_ns)
    return COPIED if is_same else None


def write_file(data: bytes, target: str, mtime_ns: int) -> None:
    """Write a file with that time of change."""
    with write_file_atomically(Path(target), clear=False, flush=False) as file:
        file.write(data)
        file.flush()
        os.utime(file.fileno(), ns=(mtime_ns, mtime_ns))


def put_link(text: str, target: str) -> bool:
    """Make a symbolic link with this text; return False where it exists already."""
    with raise_output_error(Path(target)):
        if os.path.islink(target) and os.readlink(target) == text:
            return False
        temporary = temporary_path(Path(target))
        os.symlink(text, temporary)
        move_temporary(temporary, target)
    return True


def make_real_folder(folder: str) -> bool:
    """Make sure that a folder of the copy is a real one; return True where it had to be made."""
    facts = _facts(folder)
    if facts is None:
        with raise_output_error(Path(folder)):
            os.mkdir(folder)
        return True
    if not stat.S_ISDIR(facts.st_mode):
        kind = "a link" if stat.S_ISLNK(facts.st_mode) else "a file"
        raise OutputError(
            f"{folder} is {kind}; the copy of the dataset needs a folder of its own there, and "
            f"writes through no link. Delete it, or choose another output folder"
        )
    return False


def find_foreign_names(folder: str, expected_names: set[str]) -> list[str]:
    """Return foreign names in a folder of the copy; leftovers of a killed run are deleted."""
    with raise_output_error(Path(folder)):
        unexpected_names = set(os.listdir(folder)) - expected_names
        temporary_leftovers = set(temporary_names(unexpected_names))
        for name in temporary_leftovers:
            os.unlink(os.path.join(folder, name))
    return sorted(unexpected_names - temporary_leftovers)


def _facts(path: str) -> os.stat_result | None:
    """Return the facts of a file, folder or link; None where there is none."""
    try:
        return os.lstat(path)
    except FileNotFoundError:
        return None


# ---- The place of a dataset's copy, and the record beside it -------------------------------------

# Folder of the copies in the output folder.
MIRROR_FOLDER = "source"
# First letters of a record's name.
RECORD_START = "climategs-mirror-"
# Kind of the links to files that are not replaced.
Links = Literal["hard", "copy"]


class ReplacementRecord(BaseModel):
    """Image or weathered sweep of a scene that stands in a recorded file's place."""

    scene: str
    """Name of the scene."""
    image: str | None = None
    """Path of the image relative to the output folder."""
    sha256: str | None = None
    """SHA-256 of the image."""
    sweep: str | None = None
    """Path of the sweep relative to the output folder."""


class MirrorRecord(BaseModel):
    """Record of a dataset's copy."""

    folder: str
    """Folder of the dataset."""
    links: Links = "hard"
    """Kind of the links to files that are not replaced."""
    scenes: dict[str, dict[str, Any]] = {}
    """Facts by scene name."""
    files: dict[str, int] = {}
    """Number of files by kind."""
    bytes: dict[str, int] = {}
    """Number of bytes by kind."""
    replaced: dict[str, ReplacementRecord] = {}
    """Images in the place of recorded ones, by place in the dataset."""
    replaced_sweeps: dict[str, ReplacementRecord] = {}
    """Sweeps in the place of recorded ones, by place in the dataset."""


def mirror_folder(out_dir: Path, variant: str) -> Path:
    """Return the folder of the copies of datasets in a variant's weather."""
    return out_dir / MIRROR_FOLDER / folder_name(variant)


def record_names(tree: DatasetFolder, folder: Path) -> tuple[Path, Path]:
    """Return the paths of a complete copy's record, and of the record while the copy is changed."""
    record = folder / f"{RECORD_START}{tree.root.name}.json"
    return record, record.with_name(record.name + ".begun")


def read_record(tree: DatasetFolder, folder: Path) -> MirrorRecord:
    """Return the record of the dataset's copy in a folder; it is empty where there is none.

    The record of a copy that was stopped while it was being changed counts too.
    """
    path = next((path for path in record_names(tree, folder) if path.is_file()), None)
    if path is None:
        return MirrorRecord(folder=str(tree.root))
    advice = "Delete it and build the copy again, once for each scene whose images are in it"
    with parse_errors_as_output_errors(str(path), advice):
        record = MirrorRecord.model_validate_json(path.read_bytes())
    if os.path.realpath(record.folder) != os.path.realpath(tree.root):
        raise OutputError(
            f"{folder / tree.root.name} is the copy of {record.folder}, not of {tree.root}: choose "
            f"another output folder, or delete that copy"
        )
    return record


# ---- Replacements of recorded files: images and sweeps in the form of the recorded ones ----------

# Formats of recipes by those of ImageHeader.
FORMATS = {"PNG": "png", "JPEG": "jpg"}


class ImageForm(NamedTuple):
    """Form of an image file."""

    format: str
    """`png` or `jpg`."""
    size: tuple[int, int]
    """Width and height, pixels."""
    is_grey: bool = False
    """True for one channel; known only of PNG."""


class Replacement(NamedTuple):
    """File that shall stand in a recorded file's place."""

    path: Path
    """Our file."""
    record: ReplacementRecord
    """Its entry in the record."""
    form: ImageForm | None = None
    """Form of an image; an image is encoded again where the recorded one has another form."""
    content: Callable[[], bytes] | None = None
    """For a sweep, makes the bytes of the file in this place; None where only its scene's labels
    could.
    """

    @staticmethod
    def image(out_dir: Path, row: Mapping[str, Any]) -> Replacement:
        """Return the replacement from a manifest's row of a finished image."""
        name = row["image_path"]
        form = ImageForm("jpg" if name.endswith(".jpg") else "png", (row["width"], row["height"]))
        record = ReplacementRecord(scene=row["scene"], image=name, sha256=row["checksum"])
        return Replacement(resolve_inside(out_dir, name), record, form)

    @staticmethod
    def sweep(
        out_dir: Path, row: Mapping[str, Any], content: Callable[[Path], bytes] | None = None
    ) -> Replacement:
        """Return the replacement from a manifest's row with a weathered sweep.

        Args:
            content: Makes the bytes of the file in this place from the sweep.
        """
        path = resolve_inside(out_dir, row["lidar_path"])
        record = ReplacementRecord(scene=row["scene"], sweep=row["lidar_path"])
        return Replacement(path, record, content=content and partial(content, path))


def is_weathered(row: Mapping[str, Any]) -> bool:
    """Return True if an image's row names a sweep that has met the weather."""
    return row["lidar"] == "weather" and row["lidar_path"] is not None


def weathered_images(
    out_dir: Path, rows: Sequence[Mapping[str, Any]], frames: Sequence[Frame], tree: DatasetFolder
) -> tuple[dict[str, Replacement], list[str]]:
    """Return the finished images of a variant's rows by their place in the dataset.

    Returns:
        The images, and notes on those without a place of their own.
    """
    recorded_paths = {frame.index: frame.image_paths for frame in frames}
    images: dict[str, Replacement] = {}
    unplaced_images = []
    shared_places = []
    notes = []
    for row in rows:
        if row["status"] != OK:
            continue
        path = recorded_paths.get(row["frame"], {}).get(row["camera"])
        place = None if path is None else tree.place_of(path)
        if place is None:
            unplaced_images.append(f"frame {row['frame']}, camera {row['camera']}")
            continue
        if place in images:
            shared_places.append(place)
        images[place] = Replacement.image(out_dir, row)
    if unplaced_images:
        notes.append(
            f"{len(unplaced_images)} rendered images, such as {unplaced_images[0]}, have no "
            f"recorded image in the dataset: they are not in its copy"
        )
    if shared_places:
        notes.append(
            f"{len(shared_places)} recorded images, such as {shared_places[0]}, belong to several "
            f"frames: the copy shows the last of them"
        )
    return images, notes


def weathered_sweeps(
    out_dir: Path,
    rows: Sequence[Mapping[str, Any]],
    labels: LabelSource | None,
    tree: DatasetFolder,
) -> tuple[dict[str, Replacement], list[str]]:
    """Return the weathered sweeps of a variant's rows by their place in the dataset.

    A dataset may have several files for one sweep. Lost returns are left out.

    Returns:
        The sweeps, and notes on those without a place.
    """
    row_of_frame = {row["frame"]: row for row in rows if row["status"] == OK and is_weathered(row)}
    sweeps: dict[str, Replacement] = {}
    unplaced_frames = []
    notes = []
    for frame, row in sorted(row_of_frame.items()):
        lidar_labels = labels if isinstance(labels, StoresLidar) else None
        source_files = [] if lidar_labels is None else lidar_labels.lidar_files(frame)
        file_of_place = {tree.place_of(file): file for file in source_files}
        if lidar_labels is None or not file_of_place or None in file_of_place:
            unplaced_frames.append(frame)
            continue
        for place, file in file_of_place.items():
            content = partial(_encode_sweep, lidar_labels, frame, file)
            sweeps[str(place)] = Replacement.sweep(out_dir, row, content)
    if unplaced_frames:
        notes.append(
            f"{len(unplaced_frames)} weathered LiDAR sweeps, the first of frame "
            f"{unplaced_frames[0]}, have no "
            f"file of their own in the dataset: its copy keeps the recorded ones, and {out_dir} "
            f"has these"
        )
    return sweeps, notes


def _encode_sweep(labels: StoresLidar, frame: int, file: Path, sweep: Path) -> bytes:
    """Return the bytes of a recorded file's replacement, without lost returns."""
    return labels.lidar_content(frame, file, drop_lost_returns(read_lidar(sweep)))


def _encode_fitted_image(
    image: Path, recorded: ImageForm, jpeg_quality: Callable[[Path], int]
) -> bytes:
    """Return our image as a file of the recorded one's form.

    It is made smaller by area, and larger by cubic splines.

    Args:
        jpeg_quality: Returns the JPEG quality of a variant's folder.
    """
    try:
        rgb = decode_image(image.read_bytes())
    except OSError as error:
        raise make_output_error(image, error) from error
    except ValueError as error:
        raise OutputError(f"{image} is damaged ({error}); delete it and render again") from error
    size = recorded.size
    (height, width) = rgb.shape[:2]
    if (width, height) != size:
        is_smaller = size[0] < width and size[1] < height
        interpolation = cv2.INTER_AREA if is_smaller else cv2.INTER_CUBIC
        rgb = np.asarray(cv2.resize(rgb, size, interpolation=interpolation), np.uint8)
    if recorded.is_grey:
        is_encoded, data = cv2.imencode(".png", cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY))
        assert is_encoded
        return data.tobytes()
    settings = {"image": recorded.format, "jpeg_quality": jpeg_quality(image.parents[2])}
    return encode_image(rgb, Output.model_validate(settings))


def _jpeg_quality(variant: Path) -> int:
    """Return the JPEG quality of the recipe in a variant's folder."""
    return load_recipe(variant / "recipe.yaml").resolve(0).output.jpeg_quality


def image_form(path: str | Path) -> ImageForm | None:
    """Return the form of an image file by its first bytes.

    None where it is neither PNG nor JPEG.
    """
    header = read_image_header(path)
    if header is None or header.format not in FORMATS:
        return None
    return ImageForm(FORMATS[header.format], (header.width, header.height), header.is_grey)


def dataset_format(frames: Sequence[Frame]) -> str:
    """Return the image format to render in, so that the copy's images keep their format.

    It is that of the recorded images; png where they have several formats.
    """
    suffixes = {Path(path).suffix.lower() for f in frames for path in f.image_paths.values()}
    formats = {{".png": "png", ".jpg": "jpg", ".jpeg": "jpg"}.get(suffix) for suffix in suffixes}
    formats.discard(None)
    if not formats:
        raise AdapterError(
            f"the scene knows no recorded image in PNG or JPEG (found: {sorted(suffixes) or 'none'}"
            f"); a dataset's copy replaces those"
        )
    return "jpg" if formats == {"jpg"} else "png"


# ---- The copy ------------------------------------------------------------------------------------

# Kinds of files that a record counts.
_FILE_KINDS: tuple[str, ...] = (
    LINKED,
    COPIED,
    "symbolic_links",
    "camera_images",
    "replaced_images",
    "lidar_sweeps",
    "replaced_lidar_files",
)
# Kinds of files whose bytes a record counts.
_BYTE_KINDS: tuple[str, ...] = (LINKED, COPIED, "new_images")


@dataclass
class MirrorResult:
    """Result of building a copy."""

    folder: Path
    """Folder of the copy."""
    record: MirrorRecord
    """Record of the copy."""
    changed: int = 0
    """Number of files and links that this call has put in place."""
    new: int = 0
    """Number of weathered images that are files of their own and not links to the rendered ones."""
    resized: list[tuple[tuple[int, int], tuple[int, int]]] = field(default_factory=list)
    """Rendered and recorded sizes of the images whose sizes differ."""
    unusable: list[str] = field(default_factory=list)
    """Recorded images that are neither PNG nor JPEG, and stay."""
    outdated: list[str] = field(default_factory=list)
    """Files of sweeps that another scene has rendered again; the source's own files stand in their
    place.
    """
    missing: list[str] = field(default_factory=list)
    """Recorded images that the source no longer has."""
    extra_files: list[str] = field(default_factory=list)
    """Files of the copy that the source does not have."""


def check_disjoint(tree: DatasetFolder, out_dir: Path) -> None:
    """Raise OutputError where the output folder lies in the dataset: copies would hold copies."""
    if tree.place_of(out_dir) is not None:
        raise OutputError(
            f"{out_dir} lies in the dataset's own folder {tree.root}; a copy of the dataset cannot "
            f"be made there, choose an output folder elsewhere"
        )


def mirror_dataset(
    tree: DatasetFolder,
    folder: Path,
    weathered: Mapping[str, Replacement],
    scenes: Mapping[str, Any],
    *,
    extent: FileCounts,
    links: Links = "hard",
    progress: bool = True,
) -> MirrorResult:
    """Build the copy of a dataset in a folder, or bring it up to date.

    The caller holds the lock of the output folder.

    Args:
        tree: The dataset.
        folder: Folder of the copy.
        weathered: All files that shall stand in the copy, by place in the dataset.
        scenes: Facts of the copy's scenes, in JSON's types, for the record.
        extent: Result of `survey(tree)`.
        links: `hard`, or `copy` for a copy that shares nothing with source and images.
        progress: If True, show a bar on stderr.

    Raises:
        AdapterError: A file of the source cannot be read, or a link leads out of it.
        OutputError: The system refuses, a link is in the way, or files were edited or existed
            before; no file is left half-written.
    """
    check_disjoint(tree, folder)
    files_by_kind = dict.fromkeys(_FILE_KINDS, 0)
    bytes_by_kind = dict.fromkeys(_BYTE_KINDS, 0)
    record = MirrorRecord(
        folder=str(tree.root),
        links=links,
        scenes=dict(scenes),
        files=files_by_kind,
        bytes=bytes_by_kind,
    )
    mirroring = _Mirroring(tree, folder, weathered, MirrorResult(folder / tree.root.name, record))
    with tqdm(total=extent.files, unit="file", desc="copy", disable=not progress) as bar:
        mirroring.fill_copy(bar)
    mirroring.finish()
    return mirroring.result


@dataclass(eq=False)
class _Mirroring:
    """State of one call of mirror_dataset."""

    tree: DatasetFolder
    """The dataset."""
    folder: Path
    """Folder of the copies."""
    weathered: Mapping[str, Replacement]
    """Files that shall stand in the copy, by place in the dataset."""
    result: MirrorResult
    """Result so far."""
    changed_folders: set[str] = field(default_factory=set)
    """Folders with new names, to be made durable."""
    encoded: list[str] = field(default_factory=list)
    """Paths of images that are encoded again."""

    def __post_init__(self) -> None:
        self.files = self.result.record.files
        self.bytes = self.result.record.bytes
        self.record, self.unfinished_record = record_names(self.tree, self.folder)
        self.placed = PlacedFiles(self.record.with_suffix(".files"))
        self.root = str(self.result.folder)
        self.jpeg_quality = cache(_jpeg_quality)

    def fill_copy(self, bar: tqdm) -> None:
        """Mark the copy as incomplete, and put all files in place."""
        self._check_untouched()
        for folder in (self.folder.parent, self.folder):
            self._make_folder(str(folder))
        with raise_output_error(self.record):
            if self.record.exists():
                os.replace(self.record, self.unfinished_record)
                flush_folder(self.folder)
        self._make_folder(self.root)
        self.placed.begin()
        self.pump = WritePump()
        try:
            for folder in walk(self.tree):
                self._fill(folder)
                bar.update(len(folder.files))
        finally:
            self.placed.close()
            self.pump.close()
        self.result.new += len(self.encoded)
        self.bytes["new_images"] += sum(os.lstat(path).st_size for path in self.encoded)

    def finish(self) -> None:
        """Make the names durable, then mark the copy as complete."""
        record = self.result.record
        known_places = {*self.result.record.replaced, *self.result.unusable}
        images = {
            place for place, replacement in self.weathered.items() if replacement.form is not None
        }
        self.result.missing = sorted(images - known_places)
        self.files["replaced_images"] = len(record.replaced)
        self.files["replaced_lidar_files"] = len(record.replaced_sweeps)
        text = (json.dumps(record.model_dump(exclude_none=True), indent=1) + "\n").encode()
        with raise_output_error(self.folder):
            for folder in sorted(self.changed_folders):
                flush_folder(Path(folder))
            if self.unfinished_record.is_file() and self.unfinished_record.read_bytes() == text:
                os.replace(self.unfinished_record, self.record)
        self.placed.finish()
        if not self.record.exists():
            write_atomic(self.record, text)
        with raise_output_error(self.unfinished_record):
            self.unfinished_record.unlink(missing_ok=True)

    def _check_untouched(self) -> None:
        """Refuse to replace files that other programs have edited in the copy, or put there.

        Copies of earlier versions have no list of files; their files are taken as they are.
        """
        if not os.path.isdir(self.root):
            return
        is_new = not (self.record.exists() or self.unfinished_record.exists())
        adopts_files = not (is_new or self.placed.exists)
        placed_files: dict[str, PlacedFile] = {}
        foreign_files: list[str] = []
        for folder in walk(self.tree):
            for file in folder.files:
                target = self._target(file.relative)
                facts = _facts(target)
                if facts is None or not stat.S_ISREG(facts.st_mode):
                    continue
                if adopts_files:
                    placed_files[file.relative] = PlacedFile(facts.st_size, facts.st_mtime_ns)
                elif not self._is_known(file, target, facts):
                    foreign_files.append(file.relative)
            for name, _ in folder.links:
                facts = _facts(self._target(name))
                if facts is not None and stat.S_ISREG(facts.st_mode):
                    foreign_files.append(name)
        if foreign_files:
            raise self._edited_files_error(foreign_files)
        if adopts_files:
            self.placed.adopt(placed_files)

    def _is_known(self, file: SourceFile, target: str, facts: os.stat_result) -> bool:
        """Return True if a file of the copy was put there by this package, or is about to be."""
        if self.placed.find(file.relative, facts) or find_placement(target, file.facts):
            return True
        replacement = self.weathered.get(file.relative)
        rendered_facts = None if replacement is None else _facts(str(replacement.path))
        return rendered_facts is not None and rendered_facts.st_mtime_ns == facts.st_mtime_ns

    def _edited_files_error(self, names: list[str]) -> OutputError:
        """Return the error of files that other programs have edited."""
        is_are = "file is" if len(names) == 1 else "files are"
        return OutputError(
            f"{len(names)} {is_are} not what was put in the copy {self.root}, such as {names[0]}: "
            f"edited since, or there before. Nothing has been replaced. Move such files out of "
            f"the copy to keep them, or delete them there to have them made again; or choose "
            f"another output folder"
        )

    def _fill(self, folder: SourceFolder) -> None:
        """Put the contents of one folder in place."""
        path = self._target(folder.relative)
        entries = [*folder.files, *folder.folders, *folder.links]
        foreign_names = find_foreign_names(path, {os.path.basename(entry[0]) for entry in entries})
        if not folder.relative:  # other drives, which other scenes have put into the copy
            foreign_names = [
                name for name in foreign_names if not os.path.lexists(self.tree.root / name)
            ]
        self.result.extra_files += [
            f"{folder.relative}/{name}".lstrip("/") for name in foreign_names
        ]
        for inner_place, _ in folder.folders:
            self._make_folder(self._target(inner_place))
        for file in folder.files:
            self.files["camera_images"] += self.tree.is_image(file.relative)
            self.files["lidar_sweeps"] += self.tree.is_sweep(file.relative)
            replacement = self.weathered.get(file.relative)
            if replacement is None or not self._replace(file, replacement):
                placement = self._put_file(file.path, file.facts, file.relative)
                self.files[placement] += 1
                self.bytes[placement] += file.facts.st_size
        for name, text in folder.links:
            self.files["symbolic_links"] += 1
            if put_link(text, self._target(name)):
                self._note_change(path)

    def _replace(self, file: SourceFile, replacement: Replacement) -> bool:
        """Put a weathered file in place; return False where the recorded file has to stay.

        It stays where an image has a format that this package does not write, or where only another
        scene could write a sweep.
        """
        result = self.result
        target = self._target(file.relative)
        recorded_form = None
        if replacement.form is not None:
            try:
                recorded_form = image_form(file.path)
            except OSError as error:
                raise AdapterError(f"{file.path} cannot be read: {error.strerror}") from error
            if recorded_form is None:
                result.unusable.append(file.relative)
                return False
        rendered_facts = _facts_of(replacement.path)
        if replacement.form is None or recorded_form is None:
            if not self._write_sweep(file, rendered_facts.st_mtime_ns, replacement.content):
                result.outdated.append(file.relative)
                return False
            result.record.replaced_sweeps[file.relative] = replacement.record
            return True
        if replacement.form != recorded_form:
            if _is_written(target, rendered_facts.st_mtime_ns, recorded_form):
                self.placed.keep(file.relative, PlacedFile(ANY_SIZE, rendered_facts.st_mtime_ns))
            else:
                content = partial(
                    _encode_fitted_image, replacement.path, recorded_form, self.jpeg_quality
                )
                self._write(
                    file.relative, PlacedFile(ANY_SIZE, rendered_facts.st_mtime_ns), content
                )
            self.encoded.append(target)
        elif self._put_file(str(replacement.path), rendered_facts, file.relative) == COPIED:
            result.new += 1
            self.bytes["new_images"] += rendered_facts.st_size
        if replacement.form.size != recorded_form.size:
            result.resized.append((replacement.form.size, recorded_form.size))
        result.record.replaced[file.relative] = replacement.record
        return True

    def _put_file(self, original: str, facts: os.stat_result, name: str) -> str:
        """Link or copy a file, where that has not been done; return LINKED or COPIED."""
        target = self._target(name)
        may_link = self.result.record.links == "hard"
        placed_file = PlacedFile(facts.st_size, facts.st_mtime_ns, facts.st_ctime_ns)
        placement = find_placement(target, facts)
        if placement == LINKED and may_link:
            # A link changes the original's ctime, so the line stays as it was.
            self.placed.keep(name, self.placed.find(name, facts) or placed_file)
            return LINKED
        if placement == COPIED and self._is_copy(original, target, name, placed_file):
            self.placed.keep(name, placed_file)
            return COPIED
        self.placed.add(name, placed_file)
        is_linked = may_link and link_file(original, target)
        if not is_linked:
            self.pump.submit(lambda: copy_file(original, target))
        self._note_change(os.path.dirname(target))
        return LINKED if is_linked else COPIED

    def _is_copy(self, original: str, target: str, name: str, placed_file: PlacedFile) -> bool:
        """Return True if a file of the original's size and time has the same content.

        An edit may have kept size and time.

        Raises:
            OutputError: The content differs, and the file was not put there by this package.
        """
        known_file = self.placed.find(name, os.lstat(target))
        if known_file is not None and known_file.source_ctime_ns == placed_file.source_ctime_ns:
            return True
        with raise_output_error(Path(target)):
            is_same = digest_of(original) == digest_of(target)
        if not is_same and known_file is None:
            raise self._edited_files_error([name])
        return is_same

    def _write_sweep(
        self, file: SourceFile, mtime_ns: int, content: Callable[[], bytes] | None
    ) -> bool:
        """Write a file of a weathered sweep with that time, unless it is up to date.

        Returns:
            False where only another scene could write the file.
        """
        target = self._target(file.relative)
        name = file.relative
        ctime_ns = file.facts.st_ctime_ns
        is_written = _is_written(target, mtime_ns, None)
        known_file = self.placed.find(name, os.lstat(target)) if is_written else None
        if known_file is not None and known_file.source_ctime_ns == ctime_ns:
            self.placed.keep(name, known_file)
            return True
        try:
            digest = digest_of(file.path)
        except OSError as error:
            raise AdapterError(f"{file.path} cannot be read: {error.strerror}") from error
        placed_file = PlacedFile(ANY_SIZE, mtime_ns, ctime_ns, digest)
        # Links elsewhere change the source's ctime too, but not its content.
        if known_file is not None and known_file.source_digest == digest:
            self.placed.keep(name, placed_file)
            return True
        if content is None:  # the content that an earlier version wrote is not known
            keeps_file = is_written and not (known_file and known_file.source_digest)
            if keeps_file and known_file is not None:
                self.placed.keep(name, known_file)
            return keeps_file
        if is_written:
            data = content()
            if Path(target).read_bytes() == data:
                self.placed.keep(name, placed_file)
                return True
            content = partial(bytes, data)
        self._write(name, placed_file, content)
        return True

    def _write(self, name: str, placed_file: PlacedFile, content: Callable[[], bytes]) -> None:
        """Write a file on a thread of the pump."""
        target = self._target(name)
        self.placed.add(name, placed_file)
        self.pump.submit(lambda: write_file(content(), target, placed_file.mtime_ns))
        self._note_change(os.path.dirname(target))

    def _make_folder(self, folder: str) -> None:
        """Make sure that a folder of the copy is a real one."""
        if make_real_folder(folder):
            self.changed_folders.add(os.path.dirname(folder))

    def _note_change(self, folder: str) -> None:
        """Count a change, and note its folder."""
        self.result.changed += 1
        self.changed_folders.add(folder)

    def _target(self, relative: str) -> str:
        """Return the path in the copy."""
        return os.path.join(self.root, relative) if relative else self.root


def _facts_of(path: Path) -> os.stat_result:
    """Return the facts of a file that the manifest names."""
    try:
        return os.stat(path)
    except OSError as error:
        raise OutputError(
            f"{path}, which the manifest names, cannot be read ({error.strerror}); render again"
        ) from error


def _is_written(target: str, mtime_ns: int, form: ImageForm | None) -> bool:
    """Return True if a file of ours with that time, and form of an image, is in place."""
    try:
        is_ours = os.lstat(target).st_mtime_ns == mtime_ns
        return is_ours and (form is None or image_form(target) == form)
    except OSError:
        return False
