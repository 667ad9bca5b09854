"""A dataset's folder once more, with a variant's images and weathered sweeps in place of its own.

    <out>/source/<variant>/<dataset's folder>/...                   what the dataset's tools read
    <out>/source/<variant>/climategs-mirror-<dataset's folder>.json what it is; once it is complete

All that is not replaced is the source's own file under a second name (a hard link), or a copy of it
where links cannot be had. Building again goes on after a kill, and brings an older copy up to date.
A dataset of many scenes has one copy, to which each scene adds its images.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from tqdm import tqdm

from augment.batch.atomic import flush_folder, output_error, write_atomic
from augment.batch.mirror_files import (
    COPIED,
    LINKED,
    copy_file,
    found_as,
    link_file,
    others_in,
    own_folder,
    put_link,
    write_file,
)
from augment.batch.mirror_images import ImageForm, Weathered, fits, fitted, image_form
from augment.batch.mirror_record import record_names
from augment.batch.mirror_sweeps import WeatheredSweep
from augment.batch.mirror_tree import SourceFile, SourceFolder, SourceTree, Survey, walk
from augment.batch.writer import WritePump
from augment.errors import AdapterError, OutputError

Links = Literal["hard", "copy"]


@dataclass
class Mirrored:
    """What a copy of a dataset is made of. Sizes in bytes.

    linked, copied: files of the source. replaced: weathered images that stand for recorded ones;
    of these, new are files of their own, the others are one with the rendered ones. resized: the
    sizes rendered and recorded of those that differ. unusable: recorded images that are neither
    PNG nor JPEG, which stay. sweeps: LiDAR sweeps of the source; weathered: files of returns, and
    of labels of returns, that stand for its own. outdated: files of such that another scene has
    rendered anew, where the source's own stand. missing: recorded images that the source has no
    longer. others: files in the copy that the source does not have. changed: how many files and
    links this call has put in place.
    """

    folder: Path
    linked: int = 0
    linked_size: int = 0
    copied: int = 0
    copied_size: int = 0
    links: int = 0
    images: int = 0
    replaced: dict[str, dict[str, Any]] = field(default_factory=dict)
    new: int = 0
    new_size: int = 0
    resized: list[tuple[tuple[int, int], tuple[int, int]]] = field(default_factory=list)
    unusable: list[str] = field(default_factory=list)
    sweeps: int = 0
    weathered: dict[str, dict[str, str]] = field(default_factory=dict)
    outdated: list[str] = field(default_factory=list)
    missing: list[str] = field(default_factory=list)
    others: list[str] = field(default_factory=list)
    changed: int = 0


def check_apart(tree: SourceTree, out_dir: Path) -> None:
    """Raise OutputError where the output folder lies in the dataset: copies would hold copies."""
    if tree.relative(out_dir) is not None:
        raise OutputError(
            f"{out_dir} lies in the dataset's own folder {tree.root}; a copy of the dataset cannot "
            f"be made there, choose an output folder elsewhere"
        )


def mirror_dataset(
    tree: SourceTree,
    folder: Path,
    images: Mapping[str, Weathered],
    scenes: Mapping[str, Any],
    *,
    extent: Survey,
    sweeps: Mapping[str, WeatheredSweep] | None = None,
    links: Links = "hard",
    progress: bool = True,
) -> Mirrored:
    """Build the copy of a dataset in a folder, or bring it up to date.

    images: by place in the dataset, all that shall stand in the copy. scenes: facts of those that
    the images are of, in JSON's types, for the record. extent: `survey(tree)`. sweeps: as images.
    links: hard, or copy for a copy that shares nothing with source and images. Needs the lock of
    the output folder.

    Raises:
        AdapterError: a file of the source cannot be read, or a link leads out of it.
        OutputError: the system refused, or a link is in the way. No file is left half-written.
    """
    check_apart(tree, folder)
    run = _Mirroring(tree, folder, images, sweeps or {}, links)
    with tqdm(total=extent.files, unit="file", desc="copy", disable=not progress) as bar:
        run.go(bar)
    run.finish(scenes)
    return run.done


class _Mirroring:
    """One call of mirror_dataset."""

    def __init__(
        self,
        tree: SourceTree,
        folder: Path,
        images: Mapping[str, Weathered],
        sweeps: Mapping[str, WeatheredSweep],
        links: Links,
    ) -> None:
        self.tree, self.folder, self.images, self.sweeps = tree, folder, images, sweeps
        self.may_link, self.links = links == "hard", links
        self.root = str(folder / tree.root.name)
        self.record, self.begun_record = record_names(tree, folder)
        self.done = Mirrored(folder / tree.root.name)
        self.changed_folders: set[str] = set()
        self.fitted: list[str] = []
        self.is_begun = False

    def go(self, bar: tqdm) -> None:
        for folder in (self.folder.parent, self.folder, self.root):
            self._own(str(folder))
        self.pump = WritePump()
        try:
            for folder in walk(self.tree):
                self._fill(folder)
                bar.update(len(folder.files))
        finally:
            self.pump.close()
        done = self.done
        done.new += len(self.fitted)
        done.new_size += sum(os.lstat(path).st_size for path in self.fitted)
        done.missing = sorted(self.images.keys() - done.replaced.keys() - set(done.unusable))

    def finish(self, scenes: Mapping[str, Any]) -> None:
        """Make the names durable, then say that the copy is complete."""
        try:
            for folder in sorted(self.changed_folders):
                flush_folder(Path(folder))
        except OSError as error:
            raise output_error(self.folder, error) from error
        text = json.dumps(self._described(scenes), indent=1) + "\n"
        if not (self.record.is_file() and self.record.read_bytes() == text.encode()):
            write_atomic(self.record, text.encode())
        try:
            self.begun_record.unlink(missing_ok=True)
        except OSError as error:
            raise output_error(self.begun_record, error) from error

    def _fill(self, folder: SourceFolder) -> None:
        path = self._target(folder.relative)
        names = [file.relative for file in folder.files] + [name for name, _ in folder.links]
        expected = {os.path.basename(name) for name in [*names, *folder.folders]}
        others = others_in(path, expected)
        if not folder.relative:  # other drives, which the copy has from other scenes
            others = [name for name in others if not os.path.lexists(self.tree.root / name)]
        self.done.others += [f"{folder.relative}/{name}".lstrip("/") for name in others]
        for inner in folder.folders:
            self._own(self._target(inner))
        for file in folder.files:
            self.done.images += self.tree.is_image(file.relative)
            self.done.sweeps += self.tree.is_sweep(file.relative)
            image, sweep = self.images.get(file.relative), self.sweeps.get(file.relative)
            is_put = image is not None and self._replace(file, image)
            if not is_put and (sweep is None or not self._put_sweep(file, sweep)):
                self._keep(file)
        for name, text in folder.links:
            self.done.links += 1
            if put_link(text, self._target(name)):
                self._begin()
                self._changed(path)

    def _keep(self, file: SourceFile) -> None:
        """Put the source's own file in place."""
        how = self._place(file.path, file.facts, self._target(file.relative))
        if how == LINKED:
            self.done.linked += 1
            self.done.linked_size += file.facts.st_size
        else:
            self.done.copied += 1
            self.done.copied_size += file.facts.st_size

    def _replace(self, file: SourceFile, image: Weathered) -> bool:
        """Put a weathered image in place; False where the recorded one is none that we write."""
        try:
            recorded = image_form(file.path)
        except OSError as error:
            raise AdapterError(f"{file.path} cannot be read: {error.strerror}") from error
        if recorded is None:
            self.done.unusable.append(file.relative)
            return False
        rendered = _facts_of(image.path)
        target = self._target(file.relative)
        if not fits(image, recorded):
            self._fit(image, recorded, target, rendered.st_mtime_ns)
        elif self._place(str(image.path), rendered, target) == COPIED:
            self.done.new += 1
            self.done.new_size += rendered.st_size
        self.done.replaced[file.relative] = {
            "scene": image.scene,
            "image": image.name,
            "sha256": image.checksum,
        }
        sizes = (image.form.width, image.form.height), (recorded.width, recorded.height)
        if sizes[0] != sizes[1]:
            self.done.resized.append(sizes)
        return True

    def _put_sweep(self, file: SourceFile, sweep: WeatheredSweep) -> bool:
        """Write the file of a weathered sweep, where the one there is not: its time would be ours.
        False where only another scene could write it.
        """
        mtime_ns, target = _facts_of(sweep.path).st_mtime_ns, self._target(file.relative)
        content = sweep.content
        if not _is_written(target, mtime_ns):
            if content is None:
                self.done.outdated.append(file.relative)
                return False
            self._begin()
            self.pump.submit(lambda: write_file(content(), target, mtime_ns))
            self._changed(os.path.dirname(target))
        self.done.weathered[file.relative] = {"scene": sweep.scene, "sweep": sweep.name}
        return True

    def _place(self, original: str, facts: os.stat_result, target: str) -> str:
        """Link or copy, where that has not been done; says which."""
        found = found_as(target, facts)
        if found == COPIED or (found == LINKED and self.may_link):
            return found
        self._begin()
        if self.may_link and link_file(original, target):
            self._changed(os.path.dirname(target))
            return LINKED
        self.pump.submit(lambda: copy_file(original, target))
        self._changed(os.path.dirname(target))
        return COPIED

    def _fit(self, image: Weathered, recorded: ImageForm, target: str, mtime_ns: int) -> None:
        """Encode anew, where the file there is not this image's: its time and form would be."""
        self.fitted.append(target)
        if _is_fitted(target, recorded, mtime_ns):
            return
        self._begin()
        self.pump.submit(lambda: write_file(fitted(image, recorded), target, mtime_ns))
        self._changed(os.path.dirname(target))

    def _begin(self) -> None:
        """Take back that the copy is complete, before its first change."""
        if self.is_begun:
            return
        self.is_begun = True
        try:
            if self.record.exists():
                os.replace(self.record, self.begun_record)
                flush_folder(self.folder)
        except OSError as error:
            raise output_error(self.record, error) from error

    def _own(self, folder: str) -> None:
        if own_folder(folder):
            self._begin()
            self.changed_folders.add(os.path.dirname(folder))

    def _changed(self, folder: str) -> None:
        self.done.changed += 1
        self.changed_folders.add(folder)

    def _target(self, relative: str) -> str:
        return os.path.join(self.root, relative) if relative else self.root

    def _described(self, scenes: Mapping[str, Any]) -> dict[str, Any]:
        done = self.done
        return {
            "folder": str(self.tree.root),
            "links": self.links,
            "scenes": scenes,
            "files": {
                "linked": done.linked,
                "copied": done.copied,
                "symbolic_links": done.links,
                "camera_images": done.images,
                "replaced_images": len(done.replaced),
                "lidar_sweeps": done.sweeps,
                "replaced_lidar_files": len(done.weathered),
            },
            "bytes": {
                "linked": done.linked_size,
                "copied": done.copied_size,
                "new_images": done.new_size,
            },
            "replaced": done.replaced,
            "replaced_sweeps": done.weathered,
        }


def _facts_of(path: Path) -> os.stat_result:
    try:
        return os.stat(path)
    except OSError as error:
        raise OutputError(
            f"{path}, which the manifest names, cannot be read ({error.strerror}); render again"
        ) from error


def _is_written(target: str, mtime_ns: int) -> bool:
    try:
        return os.lstat(target).st_mtime_ns == mtime_ns
    except OSError:
        return False


def _is_fitted(target: str, recorded: ImageForm, mtime_ns: int) -> bool:
    try:
        facts = os.lstat(target)
        return facts.st_mtime_ns == mtime_ns and image_form(target) == recorded
    except OSError:
        return False
