"""Ends a job: what belongs to a whole variant is written, then the manifest, then journals go."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from augment.batch.atomic import write_atomic
from augment.batch.box_weather import TABLES
from augment.batch.calibration import calibration_bytes, frame_entry, read_entries
from augment.batch.label_files import FrameBoxes, boxes_bytes, read_boxes
from augment.batch.layout import MANIFEST, box_weather_files
from augment.batch.ledger import Ledger, VariantState
from augment.batch.runner import describe
from augment.batch.selection import SceneIndex
from augment.errors import OutputError


@dataclass
class BoxCache:
    """Boxes of the scene's frames, each read once. errors: frames whose boxes cannot be read."""

    index: SceneIndex
    read: dict[int, FrameBoxes] = field(default_factory=dict)
    errors: dict[int, str] = field(default_factory=dict)

    def get(self, frames: Iterable[int]) -> dict[int, FrameBoxes]:
        """The boxes of those frames that have labels and can be read."""
        wanted = [f for f in frames if f in self.index.labelled]
        for number in wanted:
            if number not in self.read and number not in self.errors:
                self._read(number)
        return {number: self.read[number] for number in wanted if number in self.read}

    def _read(self, number: int) -> None:
        assert self.index.labels is not None  # labelled frames exist only with a source
        try:
            boxes = FrameBoxes(
                self.index.frames_by_number[number].timestamp_ns, self.index.labels.boxes(number)
            )
            boxes_bytes({number: boxes})  # what cannot be stored exactly fails here, by frame
        except Exception as error:
            self.errors[number] = describe(error, f"reading the boxes of frame {number}")
        else:
            self.read[number] = boxes


def finish(ledger: Ledger, trajectory: str, boxes: BoxCache) -> None:
    """Write labels, calibration and manifest of the job's variants that have rows.

    Safe to repeat: a kill at any point leaves the journals, and the next run does it again.

    Raises:
        OutputError: the system refused.
    """
    variants = [variant for variant in ledger.variants if variant.rows]
    for variant in variants:
        if variant.recipe.output.labels and ledger.index.labels is not None:
            _write_boxes(ledger, variant, boxes)
            for kind in _tables(variant):
                _write_box_weather(ledger, variant, kind)
        _write_calibration(ledger, variant, trajectory)
    if variants:
        ledger.write_manifest(variants)
    for variant in variants:
        variant.journal.remove()


def needs_finish(ledger: Ledger) -> bool:
    """Whether anything that `finish` writes is not there, or a journal is still open."""
    return not (ledger.out_dir / MANIFEST).is_file() or any(
        variant.is_journalled or not _is_whole(ledger, variant) for variant in ledger.variants
    )


def _is_whole(ledger: Ledger, variant: VariantState) -> bool:
    paths = _companions(ledger, variant)
    return all(path.is_file() for path in paths.values())


def _companions(ledger: Ledger, variant: VariantState) -> dict[str, Path]:
    folder = ledger.out_dir / variant.folder
    paths = {"calibration": folder / "calibration.json"}
    if variant.recipe.output.labels and ledger.index.labels is not None:
        paths["labels"] = folder / "labels" / "boxes.parquet"
        paths |= {kind: folder / file for kind, file in _tables(variant).items()}
    return paths


def _tables(variant: VariantState) -> dict[str, str]:
    """The files of what is measured of boxes, less those that came with a later version than
    the one that rendered the images: only rendering again would tell what is in them.
    """
    labelled = [row for row in variant.rows.values() if row["labels_path"] is not None]
    return {
        kind: file
        for kind, file in box_weather_files(variant.recipe).items()
        if not labelled or any(row[f"{kind}_path"] is not None for row in labelled)
    }


def _write_boxes(ledger: Ledger, variant: VariantState, cache: BoxCache) -> None:
    path = _companions(ledger, variant)["labels"]
    frames = sorted({frame for frame, _ in variant.rows})
    known: Mapping[int, FrameBoxes] = {}
    if path.is_file():
        known = {n: b for n, b in _read_or_drop(path).items() if n in set(frames)}
    new = cache.get([number for number in frames if number not in known])
    found = {**known, **new}
    number_of = ledger.index.instances.of
    numbered = {n: replace(b, instances=number_of(b.boxes.track_ids)) for n, b in found.items()}
    write_atomic(path, boxes_bytes(numbered))


def _write_box_weather(ledger: Ledger, variant: VariantState, kind: str) -> None:
    path = _companions(ledger, variant)[kind]
    # Not of an image that was measured once and has failed since.
    listed = {item for item, row in variant.rows.items() if row[f"{kind}_path"] is not None}
    known = variant.box_weather[kind]
    write_atomic(path, TABLES[kind].to_bytes({i: known[i] for i in known if i in listed}))


def _read_or_drop(path: Path) -> dict[int, FrameBoxes]:
    """A damaged file counts as absent: the scene still has the boxes."""
    try:
        return read_boxes(path)
    except OutputError:
        return {}


def _write_calibration(ledger: Ledger, variant: VariantState, trajectory: str) -> None:
    path = _companions(ledger, variant)["calibration"]
    index = ledger.index
    names: dict[int, list[str]] = {}
    for frame, camera in variant.rows:
        names.setdefault(frame, []).append(camera)
    here = [number for number in names if number in index.frames_by_number]
    scale, origin = variant.recipe.render.scale, index.world_origin_m
    entries = {n: frame_entry(index.frames_by_number[n], names[n], scale, origin) for n in here}
    gone: Sequence[int] = [number for number in names if number not in index.frames_by_number]
    if gone:  # the scene has lost frames since they were rendered
        earlier = read_entries(path)
        entries |= {number: earlier[number] for number in gone if number in earlier}
    write_atomic(path, calibration_bytes(index, variant.name, trajectory, entries))
