"""Facts of a rendered suite that scores need, read from its `suite.json` and its manifest.

In: an output in which a suite was rendered. Out: `RenderedSuite`. An image has one number in all
variants: its place among the suite's images, ordered by scene, frame and camera. Predictions name
images by this number.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

from augment.errors import ScoreError
from augment.output.manifest import OK, read_manifest_rows
from augment.output.store import Store
from augment.suite.suite_file import SuiteFile, read_suite_file
from recipes.suite import CLEAN, SuiteVariant

# Name of the variant without weather.
CLEAN_VARIANT = SuiteVariant(CLEAN, 0).name
# Number of names that a message lists.
MAX_NAMES = 5

# Columns of the manifest that scores read, besides paths: a row of all columns takes much memory.
_COLUMNS = (
    *("scene", "variant", "frame", "camera", "recipe", "status", "checksum", "width", "height"),
    "timestamp_ns",
)

Row = Mapping[str, Any]


class ImageKey(NamedTuple):
    """Identity of an image in all variants."""

    scene: str
    """Name of the scene."""
    frame: int
    """Frame number."""
    camera: str
    """Name of the camera."""


@dataclass(frozen=True, eq=False)
class RenderedSuite:
    """A suite in an output."""

    store: Store
    """The output."""
    entries: SuiteFile
    """Content of its `suite.json`."""
    content_hash: str
    """SHA-256 of that content."""
    images: tuple[ImageKey, ...]
    """The images that every variant has; an image's number is its place here."""
    rows: Mapping[str, tuple[Row, ...]]
    """Rows of the manifest by variant, in the order of `images`."""
    omitted_images: tuple[ImageKey, ...]
    """Images that some variant lacks, because they could not be rendered."""

    @property
    def name(self) -> str:
        """Return the name of the suite."""
        return self.entries.suite

    @cached_property
    def images_hash(self) -> str:
        """Return the SHA-256 of the identities of all images."""
        return hashlib.sha256(json.dumps(self.images).encode()).hexdigest()

    @property
    def effects(self) -> dict[str, tuple[str, ...]]:
        """Return the variants of each effect, mildest first, by effect."""
        names: dict[str, list[str]] = {}
        ordered = sorted(self.entries.variants, key=lambda name: self.entries.variants[name].level)
        for name in ordered:
            if name != CLEAN_VARIANT:
                names.setdefault(self.entries.variants[name].effect, []).append(name)
        order = dict.fromkeys(entry.effect for entry in self.entries.variants.values())
        return {effect: tuple(names[effect]) for effect in order if effect in names}

    def numbers_of(self, effect: str | None) -> tuple[int, ...]:
        """Return the numbers of the images that count for an effect; None for all images."""
        scenes = self.entries.scenes
        return tuple(
            number
            for number, image in enumerate(self.images)
            if effect is None or effect not in scenes[image.scene].omitted_effects
        )

    def has_same_images(self, variant: str, other_variant: str) -> bool:
        """Return True if two variants have the same pictures, byte by byte."""
        checksums = [
            tuple(row["checksum"] for row in self.rows[name]) for name in (variant, other_variant)
        ]
        return checksums[0] == checksums[1]


def read_suite(store: Store) -> RenderedSuite:
    """Return the suite that was rendered in an output.

    Raises:
        OutputError: There is no finished suite, or a file is damaged.
        ScoreError: The suite has no clean variant, or no image in all variants.
    """
    entries = read_suite_file(store)
    if CLEAN_VARIANT not in entries.variants:
        raise ScoreError(
            f"{store.uri}: the suite has no {CLEAN_VARIANT}, and every score is relative to it; "
            f"render it into this output"
        )
    rows: dict[str, dict[ImageKey, Row]] = {name: {} for name in entries.variants}
    table = read_manifest_rows(store)
    columns = [name for name in table.column_names if name in _COLUMNS or name.endswith("_path")]
    for row in table.select(columns).to_pylist():
        if row["status"] == OK and row["recipe"] in rows and row["scene"] in entries.scenes:
            key = ImageKey(row["scene"], row["frame"], row["camera"])
            if key in rows[row["recipe"]]:
                raise ScoreError(
                    f"{store.uri}: variant {row['recipe']} has two images of scene {key.scene!r}, "
                    f"frame {key.frame}, camera {key.camera!r}; a suite has one"
                )
            rows[row["recipe"]][key] = row
    images = sorted(set.intersection(*(set(variant_rows) for variant_rows in rows.values())))
    if not images:
        raise ScoreError(f"{store.uri}: no image is there in all {len(rows)} variants")
    all_images = set().union(*rows.values())
    return RenderedSuite(
        store,
        entries,
        entries.content_hash,
        tuple(images),
        {name: tuple(variant_rows[k] for k in images) for name, variant_rows in rows.items()},
        tuple(sorted(all_images - set(images))),
    )


def list_names(names: Iterable[object]) -> str:
    """Return the count of some names and the first of them, for messages."""
    texts = [str(name) for name in names]
    more = ", ..." if len(texts) > MAX_NAMES else ""
    return f"{len(texts)} ({', '.join(texts[:MAX_NAMES])}{more})"
