"""A dataset's folder once more, with a variant's images and weathered sweeps in place of its own.

    <out>/source/<variant>/<dataset's folder>/...                   what the dataset's tools read
    <out>/source/<variant>/climategs-mirror-<dataset's folder>.json what it is; once it is complete
    <out>/source/<variant>/climategs-mirror-<dataset's folder>.files what was put there

All that is not replaced is the source's own file under a second name (a hard link), or a copy of it
where links cannot be had. Building again goes on after a kill, and brings an older copy up to date;
what others have edited there stops it. A dataset of many scenes has one copy, to which each scene
adds its images.
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

from augment.cameras import Frame
from augment.effects.lidar.codes import drop_lost
from augment.errors import AdapterError, OutputError
from augment.files.image_size import read_image_header
from augment.jobs.atomic import (
    copy_file,
    flush_folder,
    link_file,
    move_temporary,
    output_error,
    refusals_of,
    replaced_file,
    temporary_beside,
    temporary_names,
    write_atomic,
)
from augment.jobs.files import WritePump, decode_image, encode_image
from augment.jobs.layout import folder_name, reading_back, resolve_inside
from augment.jobs.manifest import OK
from augment.jobs.placed_files import ANY_SIZE, PlacedFile, PlacedFiles, digest_of
from augment.jobs.tables import read_lidar
from augment.labels import LabelSource, StoresLidar
from recipes.load import load_recipe
from recipes.schema import Output

# ---- The files of a dataset, as a copy of it in another place has to have them -------------------
# A dataset's own entries (`samples`, `camera` ...) may be links to other disks. Links below them
# must stay within the dataset, and stay links in the copy; others would lead it to files that
# nobody meant.


@dataclass(frozen=True)
class SourceTree:
    """A dataset in a folder. root: absolute; its name is the copy's name too. uri: what it was
    opened by. images, sweeps: regular expressions that the paths of its camera images and LiDAR
    sweeps, relative to root, match in full. entries: what in root belongs to it; None for all.
    """

    uri: str
    root: Path
    images: str
    entries: tuple[str, ...] | None = None
    sweeps: str = r"(?!)"  # none

    @cached_property
    def bases(self) -> tuple[tuple[str, str], ...]:
        """Real paths of the folders and files that make up the dataset, and where each belongs
        relative to root: root itself, then what its own entries lead to elsewhere.
        """
        real_root = os.path.realpath(self.root)
        try:
            names = sorted(os.listdir(real_root))
        except OSError as error:
            raise AdapterError(f"{self.root} cannot be listed: {error.strerror}") from error
        if not self.root.name:
            raise AdapterError(f"{self.root} has no name; a dataset must lie in a folder")
        found = [(real_root, "")]
        for name in names:
            path = os.path.join(real_root, name)
            if not self.has(name) or not os.path.islink(path):
                continue
            real = os.path.realpath(path)
            if is_within(real, real_root):
                continue
            if not os.path.exists(real):
                raise AdapterError(
                    f"{path} is a link to {real}, which does not exist; put it there, or delete "
                    f"the link"
                )
            if is_within(real_root, real):
                raise AdapterError(
                    f"{path} is a link to {real}, which holds the dataset itself; delete the link"
                )
            found.append((real, name))
        return tuple(found)

    def relative(self, path: str | Path) -> str | None:
        """Where a file or folder belongs relative to root, links followed; None outside."""
        real = os.path.realpath(path)
        for base, name in self.bases:
            if is_within(real, base):
                inner = os.path.relpath(real, base)
                parts = [part for part in (name, inner) if part not in ("", ".")]
                within = "/".join(parts)
                return within if not within or self.has(within.split("/")[0]) else None
        return None

    def is_image(self, relative: str) -> bool:
        """Whether this is the path of a camera image."""
        return re.fullmatch(self.images, relative) is not None

    def is_sweep(self, relative: str) -> bool:
        """Whether this is the path of a LiDAR sweep."""
        return re.fullmatch(self.sweeps, relative) is not None

    def has(self, name: str) -> bool:
        """Whether this entry of root belongs to the dataset."""
        return self.entries is None or name in self.entries


class SourceFile(NamedTuple):
    """relative: to the dataset's root. path: where its bytes are. facts: as os.lstat of that."""

    relative: str
    path: str
    facts: os.stat_result


class SourceFolder(NamedTuple):
    """What is directly in one folder, by paths relative to the root, "" for itself. folders: with
    their real paths. links: with what the link says, which leads to another part of the dataset.
    """

    relative: str
    files: list[SourceFile]
    folders: list[tuple[str, str]]
    links: list[tuple[str, str]]


class Survey(NamedTuple):
    """How many files a dataset has, and how many of them are camera images and LiDAR sweeps."""

    files: int
    images: int
    sweeps: int = 0


def survey(tree: SourceTree) -> Survey:
    """Look at all that belongs to a dataset, reading no file."""
    names = [file.relative for folder in walk(tree) for file in folder.files]
    return Survey(len(names), sum(map(tree.is_image, names)), sum(map(tree.is_sweep, names)))


def walk(tree: SourceTree, relative: str = "", path: str = "") -> Iterator[SourceFolder]:
    """The folders of a dataset, each before those in it, in order of name."""
    path = path or os.path.realpath(tree.root)
    elsewhere = {} if relative else {name: real for real, name in tree.bases}
    found = SourceFolder(relative, [], [], [])
    try:
        for name in sorted(os.listdir(path)):
            if not relative and not tree.has(name):
                continue
            within = f"{relative}/{name}".lstrip("/")
            real = elsewhere.get(name, os.path.join(path, name))
            facts = os.lstat(real)
            if stat.S_ISREG(facts.st_mode):
                found.files.append(SourceFile(within, real, facts))
            elif stat.S_ISDIR(facts.st_mode):
                found.folders.append((within, real))
            elif stat.S_ISLNK(facts.st_mode):
                found.links.append((within, _link_text(tree, within, real)))
            else:
                raise AdapterError(
                    f"{real} is neither a file nor a folder nor a link; a dataset's copy cannot "
                    f"have it, move it elsewhere"
                )
    except OSError as error:
        raise AdapterError(f"{error.filename or path} cannot be read: {error.strerror}") from error
    yield found
    for inner, real in found.folders:
        yield from walk(tree, inner, real)


def is_within(path: str, folder: str) -> bool:
    """Whether a real path is a folder's or of something in it."""
    return path == folder or path.startswith(folder.rstrip("/") + "/")


def _link_text(tree: SourceTree, within: str, path: str) -> str:
    """What the copy's link has to say to lead to the same part of the dataset's copy."""
    target = tree.relative(path)
    if target is None:
        raise AdapterError(
            f"{path} is a link to {os.path.realpath(path)}, outside {tree.root}. A copy of the "
            f"dataset can have links within it, and {tree.root}'s own entries may be links to "
            f"other places: put the file itself there, or the link higher up"
        )
    return os.path.relpath(target or ".", os.path.dirname(within) or ".")


# ---- Files and links put in place ----------------------------------------------------------------

LINKED, COPIED = "linked", "copied"


def found_as(target: str, original: os.stat_result) -> str | None:
    """How the original is in place: LINKED, COPIED (same size and time), or None: it is not."""
    facts = _facts(target)
    if facts is None or not stat.S_ISREG(facts.st_mode):
        return None
    if (facts.st_dev, facts.st_ino) == (original.st_dev, original.st_ino):
        return LINKED
    same = (facts.st_size, facts.st_mtime_ns) == (original.st_size, original.st_mtime_ns)
    return COPIED if same else None


def write_file(data: bytes, target: str, mtime_ns: int) -> None:
    """Write a file with that time of change."""
    with replaced_file(Path(target), clear=False, flush=False) as file:
        file.write(data)
        file.flush()
        os.utime(file.fileno(), ns=(mtime_ns, mtime_ns))


def put_link(text: str, target: str) -> bool:
    """A symbolic link that says `text`; False where it is there already."""
    with refusals_of(Path(target)):
        if os.path.islink(target) and os.readlink(target) == text:
            return False
        temporary = temporary_beside(Path(target))
        os.symlink(text, temporary)
        move_temporary(temporary, target)
    return True


def own_folder(folder: str) -> bool:
    """Make sure that a folder of the copy is a real one; True where it had to be made."""
    facts = _facts(folder)
    if facts is None:
        with refusals_of(Path(folder)):
            os.mkdir(folder)
        return True
    if not stat.S_ISDIR(facts.st_mode):
        kind = "a link" if stat.S_ISLNK(facts.st_mode) else "a file"
        raise OutputError(
            f"{folder} is {kind}; the copy of the dataset needs a folder of its own there, and "
            f"writes through no link. Delete it, or choose another output folder"
        )
    return False


def others_in(folder: str, expected: set[str]) -> list[str]:
    """Names in a folder of the copy that are not expected; what a killed run left is deleted."""
    with refusals_of(Path(folder)):
        found = set(os.listdir(folder)) - expected
        left = set(temporary_names(found))
        for name in left:
            os.unlink(os.path.join(folder, name))
    return sorted(found - left)


def _facts(path: str) -> os.stat_result | None:
    try:
        return os.lstat(path)
    except FileNotFoundError:
        return None


# ---- Where the copy of a dataset lies, and the file beside it that says what stands in it --------

MIRROR_FOLDER = "source"
Links = Literal["hard", "copy"]


class Shown(BaseModel):
    """What of a scene stands in a recorded file's place: an image or a weathered sweep, by its path
    relative to the output folder. sha256: of the image.
    """

    scene: str
    image: str | None = None
    sha256: str | None = None
    sweep: str | None = None


class MirrorRecord(BaseModel):
    """folder: the dataset's. scenes: facts by name. files, bytes: how many there are of a kind.
    replaced, replaced_sweeps: what stands in the place of recorded files, by place in the dataset.
    """

    folder: str
    links: Links = "hard"
    scenes: dict[str, dict[str, Any]] = {}
    files: dict[str, int] = {}
    bytes: dict[str, int] = {}
    replaced: dict[str, Shown] = {}
    replaced_sweeps: dict[str, Shown] = {}


def mirror_folder(out_dir: Path, variant: str) -> Path:
    """Where the copies of datasets in a variant's weather lie."""
    return out_dir / MIRROR_FOLDER / folder_name(variant)


def record_names(tree: SourceTree, folder: Path) -> tuple[Path, Path]:
    """The record of a complete copy, and its name while the copy is being changed."""
    record = folder / f"climategs-mirror-{tree.root.name}.json"
    return record, record.with_name(record.name + ".begun")


def read_record(tree: SourceTree, folder: Path) -> MirrorRecord:
    """What is known of the dataset's copy in a folder, also of one that was stopped while it was
    being changed; empty where there is none.
    """
    path = next((path for path in record_names(tree, folder) if path.is_file()), None)
    if path is None:
        return MirrorRecord(folder=str(tree.root))
    advice = "Delete it and build the copy again, once for each scene whose images are in it"
    with reading_back(str(path), advice):
        record = MirrorRecord.model_validate_json(path.read_bytes())
    if os.path.realpath(record.folder) != os.path.realpath(tree.root):
        raise OutputError(
            f"{folder / tree.root.name} is the copy of {record.folder}, not of {tree.root}: choose "
            f"another output folder, or delete that copy"
        )
    return record


# ---- What stands in the place of recorded files: images and sweeps in their form -----------------

FORMATS = {"PNG": "png", "JPEG": "jpg"}  # of ImageHeader, and of recipes


class ImageForm(NamedTuple):
    """format: png or jpg. size: width and height. is_grey: one channel (told of PNG only)."""

    format: str
    size: tuple[int, int]
    is_grey: bool = False


class Weathered(NamedTuple):
    """What shall stand in a recorded file's place. path: our file. form: of an image; of another
    than the recorded one it is encoded anew. content: of a sweep, makes the bytes of the file in
    this place; None where only its scene's labels could.
    """

    path: Path
    shown: Shown
    form: ImageForm | None = None
    content: Callable[[], bytes] | None = None

    @staticmethod
    def image(out_dir: Path, row: Mapping[str, Any]) -> Weathered:
        """The finished image of a manifest's row."""
        name = row["image_path"]
        form = ImageForm("jpg" if name.endswith(".jpg") else "png", (row["width"], row["height"]))
        shown = Shown(scene=row["scene"], image=name, sha256=row["checksum"])
        return Weathered(resolve_inside(out_dir, name), shown, form)

    @staticmethod
    def sweep(
        out_dir: Path, row: Mapping[str, Any], content: Callable[[Path], bytes] | None = None
    ) -> Weathered:
        """The weathered sweep of a manifest's row. content: of the place's file, from the sweep."""
        path = resolve_inside(out_dir, row["lidar_path"])
        shown = Shown(scene=row["scene"], sweep=row["lidar_path"])
        return Weathered(path, shown, content=content and partial(content, path))


def is_weathered(row: Mapping[str, Any]) -> bool:
    """Whether the row of an image names a sweep that has met the weather."""
    return row["lidar"] == "weather" and row["lidar_path"] is not None


def weathered_images(
    out_dir: Path, rows: Sequence[Mapping[str, Any]], frames: Sequence[Frame], tree: SourceTree
) -> tuple[dict[str, Weathered], list[str]]:
    """The finished images of a variant's rows by their place in the dataset, and a sentence for
    those that have none.
    """
    recorded = {frame.index: frame.image_paths for frame in frames}
    found: dict[str, Weathered] = {}
    unplaced, doubled, notes = [], [], []
    for row in rows:
        if row["status"] != OK:
            continue
        path = recorded.get(row["frame"], {}).get(row["camera"])
        place = None if path is None else tree.relative(path)
        if place is None:
            unplaced.append(f"frame {row['frame']}, camera {row['camera']}")
            continue
        if place in found:
            doubled.append(place)
        found[place] = Weathered.image(out_dir, row)
    if unplaced:
        notes.append(
            f"{len(unplaced)} rendered images, such as {unplaced[0]}, have no recorded image in "
            f"the dataset: they are not in its copy"
        )
    if doubled:
        notes.append(
            f"{len(doubled)} recorded images, such as {doubled[0]}, belong to several frames: the "
            f"copy shows the last of them"
        )
    return found, notes


def weathered_sweeps(
    out_dir: Path, rows: Sequence[Mapping[str, Any]], labels: LabelSource | None, tree: SourceTree
) -> tuple[dict[str, Weathered], list[str]]:
    """As `weathered_images`, of the sweeps, of which a dataset may have several files each. Lost
    returns are left out.
    """
    frames = {row["frame"]: row for row in rows if row["status"] == OK and is_weathered(row)}
    found: dict[str, Weathered] = {}
    unplaced, notes = [], []
    for frame, row in sorted(frames.items()):
        stored = labels if isinstance(labels, StoresLidar) else None
        files = [] if stored is None else stored.lidar_files(frame)
        places = {tree.relative(file): file for file in files}
        if stored is None or not places or None in places:
            unplaced.append(frame)
            continue
        for place, file in places.items():
            content = partial(_returns, stored, frame, file)
            found[str(place)] = Weathered.sweep(out_dir, row, content)
    if unplaced:
        notes.append(
            f"{len(unplaced)} weathered LiDAR sweeps, the first of frame {unplaced[0]}, have no "
            f"file of their own in the dataset: its copy keeps the recorded ones, and {out_dir} "
            f"has these"
        )
    return found, notes


def _returns(labels: StoresLidar, frame: int, file: Path, sweep: Path) -> bytes:
    return labels.lidar_content(frame, file, drop_lost(read_lidar(sweep)))


def _fitted(image: Path, recorded: ImageForm, jpeg_quality: Callable[[Path], int]) -> bytes:
    """Our image as a file of the recorded one's form: smaller by area, larger by cubic splines.
    jpeg_quality: of a variant's folder.
    """
    try:
        rgb = decode_image(image.read_bytes())
    except OSError as error:
        raise output_error(image, error) from error
    except ValueError as error:
        raise OutputError(f"{image} is damaged ({error}); delete it and render again") from error
    size, (height, width) = recorded.size, rgb.shape[:2]
    if (width, height) != size:
        is_smaller = size[0] < width and size[1] < height
        method = cv2.INTER_AREA if is_smaller else cv2.INTER_CUBIC
        rgb = np.asarray(cv2.resize(rgb, size, interpolation=method), np.uint8)
    if recorded.is_grey:
        done, data = cv2.imencode(".png", cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY))
        assert done
        return data.tobytes()
    settings = {"image": recorded.format, "jpeg_quality": jpeg_quality(image.parents[2])}
    return encode_image(rgb, Output.model_validate(settings))


def _jpeg_quality(variant: Path) -> int:
    return load_recipe(variant / "recipe.yaml").resolve(0).output.jpeg_quality


def image_form(path: str | Path) -> ImageForm | None:
    """Of an image file by its first bytes; None where it is neither PNG nor JPEG."""
    header = read_image_header(path)
    if header is None or header.format not in FORMATS:
        return None
    return ImageForm(FORMATS[header.format], (header.width, header.height), header.is_grey)


def dataset_format(frames: Sequence[Frame]) -> str:
    """The format in which to render so that the dataset's images are of it: that of the recorded
    ones, png where they are of several.
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

# What a record counts.
_FILES: tuple[str, ...] = (LINKED, COPIED, "symbolic_links", "camera_images", "replaced_images",
                           "lidar_sweeps", "replaced_lidar_files")  # fmt: skip
_BYTES: tuple[str, ...] = (LINKED, COPIED, "new_images")


@dataclass
class Mirrored:
    """What was made of a copy. record: what it is made of. changed: how many files and links this
    call has put in place. new: weathered images that are files of their own and no links to the
    rendered ones. resized: rendered and recorded sizes of those that differ. unusable: recorded
    images that are neither PNG nor JPEG, which stay. outdated: files of sweeps that another scene
    has rendered anew, where the source's own stand. missing: recorded images that the source has
    no longer. others: files that the source does not have.
    """

    folder: Path
    record: MirrorRecord
    changed: int = 0
    new: int = 0
    resized: list[tuple[tuple[int, int], tuple[int, int]]] = field(default_factory=list)
    unusable: list[str] = field(default_factory=list)
    outdated: list[str] = field(default_factory=list)
    missing: list[str] = field(default_factory=list)
    others: list[str] = field(default_factory=list)


def check_disjoint(tree: SourceTree, out_dir: Path) -> None:
    """Raise OutputError where the output folder lies in the dataset: copies would hold copies."""
    if tree.relative(out_dir) is not None:
        raise OutputError(
            f"{out_dir} lies in the dataset's own folder {tree.root}; a copy of the dataset cannot "
            f"be made there, choose an output folder elsewhere"
        )


def mirror_dataset(
    tree: SourceTree,
    folder: Path,
    weathered: Mapping[str, Weathered],
    scenes: Mapping[str, Any],
    *,
    extent: Survey,
    links: Links = "hard",
    progress: bool = True,
) -> Mirrored:
    """Build the copy of a dataset in a folder, or bring it up to date; needs the lock of the output
    folder. weathered: by place in the dataset, all that shall stand in the copy. scenes: facts of
    those that it is of, in JSON's types, for the record. extent: `survey(tree)`. links: hard, or
    copy for a copy that shares nothing with source and images. Raises AdapterError: a file of the
    source cannot be read, or a link leads out of it. OutputError: the system refused, a link is in
    the way, or files were edited or were there before; no file is left half-written.
    """
    check_disjoint(tree, folder)
    files, sizes = dict.fromkeys(_FILES, 0), dict.fromkeys(_BYTES, 0)
    record = MirrorRecord(
        folder=str(tree.root), links=links, scenes=dict(scenes), files=files, bytes=sizes
    )
    run = _Mirroring(tree, folder, weathered, Mirrored(folder / tree.root.name, record))
    with tqdm(total=extent.files, unit="file", desc="copy", disable=not progress) as bar:
        run.go(bar)
    run.finish()
    return run.done


@dataclass(eq=False)
class _Mirroring:
    """One call of mirror_dataset."""

    tree: SourceTree
    folder: Path
    weathered: Mapping[str, Weathered]
    done: Mirrored
    changed_folders: set[str] = field(default_factory=set)
    encoded: list[str] = field(default_factory=list)  # images of another form than ours

    def __post_init__(self) -> None:
        self.files, self.bytes = self.done.record.files, self.done.record.bytes
        self.record, self.begun = record_names(self.tree, self.folder)
        self.placed = PlacedFiles(self.record.with_suffix(".files"))
        self.root = str(self.done.folder)
        self.jpeg_quality = cache(_jpeg_quality)

    def go(self, bar: tqdm) -> None:
        """Take back that the copy is complete, and make it so."""
        self._check_untouched()
        for folder in (self.folder.parent, self.folder):
            self._own(str(folder))
        with refusals_of(self.record):
            if self.record.exists():
                os.replace(self.record, self.begun)
                flush_folder(self.folder)
        self._own(self.root)
        self.placed.begin()
        self.pump = WritePump()
        try:
            for folder in walk(self.tree):
                self._fill(folder)
                bar.update(len(folder.files))
        finally:
            self.placed.close()
            self.pump.close()
        self.done.new += len(self.encoded)
        self.bytes["new_images"] += sum(os.lstat(path).st_size for path in self.encoded)

    def finish(self) -> None:
        """Make the names durable, then say that the copy is complete."""
        record, known = self.done.record, {*self.done.record.replaced, *self.done.unusable}
        images = {place for place, ours in self.weathered.items() if ours.form is not None}
        self.done.missing = sorted(images - known)
        self.files["replaced_images"] = len(record.replaced)
        self.files["replaced_lidar_files"] = len(record.replaced_sweeps)
        text = (json.dumps(record.model_dump(exclude_none=True), indent=1) + "\n").encode()
        with refusals_of(self.folder):
            for folder in sorted(self.changed_folders):
                flush_folder(Path(folder))
            if self.begun.is_file() and self.begun.read_bytes() == text:
                os.replace(self.begun, self.record)
        self.placed.finish()
        if not self.record.exists():
            write_atomic(self.record, text)
        with refusals_of(self.begun):
            self.begun.unlink(missing_ok=True)

    def _check_untouched(self) -> None:
        """Refuse to replace what others have put in the copy: edited labels, files of their own.
        Copies of earlier versions say nothing of their files; those are taken as they are.
        """
        if not os.path.isdir(self.root):
            return
        is_new = not (self.record.exists() or self.begun.exists())
        adopts = not (is_new or self.placed.is_there)
        adopted: dict[str, PlacedFile] = {}
        others: list[str] = []
        for folder in walk(self.tree):
            for file in folder.files:
                target = self._target(file.relative)
                facts = _facts(target)
                if facts is None or not stat.S_ISREG(facts.st_mode):
                    continue
                if adopts:
                    adopted[file.relative] = PlacedFile(facts.st_size, facts.st_mtime_ns)
                elif not self._is_known(file, target, facts):
                    others.append(file.relative)
            for name, _ in folder.links:
                facts = _facts(self._target(name))
                if facts is not None and stat.S_ISREG(facts.st_mode):
                    others.append(name)
        if others:
            raise self._edited(others)
        if adopts:
            self.placed.adopt(adopted)

    def _is_known(self, file: SourceFile, target: str, facts: os.stat_result) -> bool:
        """Whether a file of the copy is what was put there, or is about to be."""
        if self.placed.known(file.relative, facts) or found_as(target, file.facts):
            return True
        ours = self.weathered.get(file.relative)
        rendered = None if ours is None else _facts(str(ours.path))
        return rendered is not None and rendered.st_mtime_ns == facts.st_mtime_ns

    def _edited(self, names: list[str]) -> OutputError:
        is_are = "file is" if len(names) == 1 else "files are"
        return OutputError(
            f"{len(names)} {is_are} not what was put in the copy {self.root}, such as {names[0]}: "
            f"edited since, or there before. Nothing has been replaced. Move such files out of "
            f"the copy to keep them, or delete them there to have them made again; or choose "
            f"another output folder"
        )

    def _fill(self, folder: SourceFolder) -> None:
        path = self._target(folder.relative)
        entries = [*folder.files, *folder.folders, *folder.links]
        others = others_in(path, {os.path.basename(entry[0]) for entry in entries})
        if not folder.relative:  # other drives, which the copy has from other scenes
            others = [name for name in others if not os.path.lexists(self.tree.root / name)]
        self.done.others += [f"{folder.relative}/{name}".lstrip("/") for name in others]
        for inner, _ in folder.folders:
            self._own(self._target(inner))
        for file in folder.files:
            self.files["camera_images"] += self.tree.is_image(file.relative)
            self.files["lidar_sweeps"] += self.tree.is_sweep(file.relative)
            ours = self.weathered.get(file.relative)
            if ours is None or not self._replace(file, ours):
                how = self._place(file.path, file.facts, file.relative)
                self.files[how] += 1
                self.bytes[how] += file.facts.st_size
        for name, text in folder.links:
            self.files["symbolic_links"] += 1
            if put_link(text, self._target(name)):
                self._changed(path)

    def _replace(self, file: SourceFile, ours: Weathered) -> bool:
        """Put what is weathered in place; False where the recorded file has to stay: an image that
        is none that we write, or a sweep that only another scene could write.
        """
        done, target, recorded = self.done, self._target(file.relative), None
        if ours.form is not None:
            try:
                recorded = image_form(file.path)
            except OSError as error:
                raise AdapterError(f"{file.path} cannot be read: {error.strerror}") from error
            if recorded is None:
                done.unusable.append(file.relative)
                return False
        rendered = _facts_of(ours.path)
        if ours.form is None or recorded is None:
            if not self._write_sweep(file, rendered.st_mtime_ns, ours.content):
                done.outdated.append(file.relative)
                return False
            done.record.replaced_sweeps[file.relative] = ours.shown
            return True
        if ours.form != recorded:
            if _is_written(target, rendered.st_mtime_ns, recorded):
                self.placed.keep(file.relative, PlacedFile(ANY_SIZE, rendered.st_mtime_ns))
            else:
                content = partial(_fitted, ours.path, recorded, self.jpeg_quality)
                self._write(file.relative, PlacedFile(ANY_SIZE, rendered.st_mtime_ns), content)
            self.encoded.append(target)
        elif self._place(str(ours.path), rendered, file.relative) == COPIED:
            done.new += 1
            self.bytes["new_images"] += rendered.st_size
        if ours.form.size != recorded.size:
            done.resized.append((ours.form.size, recorded.size))
        done.record.replaced[file.relative] = ours.shown
        return True

    def _place(self, original: str, facts: os.stat_result, name: str) -> str:
        """Link or copy, where that has not been done; says which."""
        target = self._target(name)
        may_link = self.done.record.links == "hard"
        placed = PlacedFile(facts.st_size, facts.st_mtime_ns, facts.st_ctime_ns)
        found = found_as(target, facts)
        if found == LINKED and may_link:
            # A link changes the original's time of change: the line stays as it was.
            self.placed.keep(name, self.placed.known(name, facts) or placed)
            return LINKED
        if found == COPIED and self._is_copy(original, target, name, placed):
            self.placed.keep(name, placed)
            return COPIED
        self.placed.add(name, placed)
        is_linked = may_link and link_file(original, target)
        if not is_linked:
            self.pump.submit(lambda: copy_file(original, target))
        self._changed(os.path.dirname(target))
        return LINKED if is_linked else COPIED

    def _is_copy(self, original: str, target: str, name: str, placed: PlacedFile) -> bool:
        """Whether a file of the original's size and time holds the same too: an edit may have kept
        both. Raises OutputError: it does not, and was not put there.
        """
        known = self.placed.known(name, os.lstat(target))
        if known is not None and known.source_ctime_ns == placed.source_ctime_ns:
            return True
        with refusals_of(Path(target)):
            is_same = digest_of(original) == digest_of(target)
        if not is_same and known is None:
            raise self._edited([name])
        return is_same

    def _write_sweep(
        self, file: SourceFile, mtime_ns: int, content: Callable[[], bytes] | None
    ) -> bool:
        """Write a file of a weathered sweep, of that time, where there is none yet or the source's
        has changed; False where that would take what we do not have.
        """
        target, name, ctime_ns = self._target(file.relative), file.relative, file.facts.st_ctime_ns
        is_written = _is_written(target, mtime_ns, None)
        known = self.placed.known(name, os.lstat(target)) if is_written else None
        if known is not None and known.source_ctime_ns == ctime_ns:
            self.placed.keep(name, known)
            return True
        try:
            digest = digest_of(file.path)
        except OSError as error:
            raise AdapterError(f"{file.path} cannot be read: {error.strerror}") from error
        placed = PlacedFile(ANY_SIZE, mtime_ns, ctime_ns, digest)
        # Links elsewhere change the source's time too, and not what it holds.
        if known is not None and known.source_digest == digest:
            self.placed.keep(name, placed)
            return True
        if content is None:  # with what an earlier version wrote is not known
            is_taken = is_written and not (known and known.source_digest)
            if is_taken and known is not None:
                self.placed.keep(name, known)
            return is_taken
        if is_written:
            data = content()
            if Path(target).read_bytes() == data:
                self.placed.keep(name, placed)
                return True
            content = partial(bytes, data)
        self._write(name, placed, content)
        return True

    def _write(self, name: str, placed: PlacedFile, content: Callable[[], bytes]) -> None:
        target = self._target(name)
        self.placed.add(name, placed)
        self.pump.submit(lambda: write_file(content(), target, placed.mtime_ns))
        self._changed(os.path.dirname(target))

    def _own(self, folder: str) -> None:
        if own_folder(folder):
            self.changed_folders.add(os.path.dirname(folder))

    def _changed(self, folder: str) -> None:
        self.done.changed += 1
        self.changed_folders.add(folder)

    def _target(self, relative: str) -> str:
        return os.path.join(self.root, relative) if relative else self.root


def _facts_of(path: Path) -> os.stat_result:
    try:
        return os.stat(path)
    except OSError as error:
        raise OutputError(
            f"{path}, which the manifest names, cannot be read ({error.strerror}); render again"
        ) from error


def _is_written(target: str, mtime_ns: int, form: ImageForm | None) -> bool:
    """Whether a file of ours stands there: of that time, and of that form, if it is an image."""
    try:
        is_ours = os.lstat(target).st_mtime_ns == mtime_ns
        return is_ours and (form is None or image_form(target) == form)
    except OSError:
        return False
