"""`suite.json`: what a finished suite holds, with the SHA-256 of every file.

In: the manifest and the files of an output in which a suite was rendered. Out: a `SuiteFile`.
`run_suite` writes it, `verify_suite` and scores read it. Paths are relative to the output folder.
"""

from __future__ import annotations

import hashlib
import json
from collections import defaultdict
from collections.abc import Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import Annotated, Any, Literal, NamedTuple

from pydantic import BaseModel, ConfigDict, Field

import augment
from augment.errors import OutputError
from augment.output.layout import (
    SWEEP_FOLDER,
    parse_errors_as_output_errors,
    variant_folder,
    variant_name,
)
from augment.output.manifest import OK, read_manifest_rows
from augment.output.names import MANIFEST_FILE, STATE_FOLDER, folder_name
from augment.output.store import Store, StoredFileMissing
from recipes.job import scaled_recipe
from recipes.schema import Recipe
from recipes.suite import CLEAN, Suite, SuiteVariant
from recipes.tags import columns_of_tags

# Name of the file.
SUITE_FILE = "suite.json"
# Files that are read at a time.
_NUM_READS = 8
# Number of files by which a loader of images is probed.
NUM_PROBES = 3

Sha256 = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]


class _Closed(BaseModel):
    """Base of the parts of the file."""

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True)


class VariantFacts(_Closed):
    """A variant of the suite."""

    effect: str
    """Name of the effect."""
    level: int
    """Level, 0 for the clean render."""
    number: str
    """Name of the effect's physical number; empty for the clean render."""
    unit: str
    """Unit of that number."""
    value: float | None
    """The number at this level; None for the clean render."""
    folder: str
    """Name of the variant's folder in each scene's folder."""
    numbers: dict[str, float | str]
    """Numbers of the weather and its classes by standards, by the manifest's columns."""
    recipe: dict[str, Any]
    """Recipe in numbers, without its seed."""
    seeds: dict[str, int]
    """Seed by scene."""
    probes: tuple[str, ...]
    """Paths of the first, the middle and the last image, by path: a user's loader hashes them."""


class SceneFacts(_Closed):
    """A scene of the suite."""

    source: str
    """The scene's own statement of its origin."""
    recorded_conditions: tuple[str, ...]
    """Conditions of the recording, where the dataset states them."""
    omitted_effects: tuple[str, ...]
    """Effects that the recording has already; the scene counts in no main score of theirs."""
    frames: tuple[int, ...]
    """Numbers of the frames of which there are images."""
    cameras: tuple[str, ...]
    """Names of the cameras of which there are images."""


class FailedImage(_Closed):
    """An image that could not be rendered."""

    scene: str
    """Name of the scene."""
    variant: str
    """Name of the variant, such as `fog-3`."""
    frame: int
    """Frame number."""
    camera: str
    """Name of the camera."""
    message: str
    """Reason."""


class SuiteFile(_Closed):
    """The file's content."""

    format: Literal[1] = 1
    """Version of the file's format."""
    suite: str
    """Name of the suite, with its version; of a quarter, with `-q`."""
    code_version: str
    """Version of this package that rendered the images."""
    backends: tuple[str, ...]
    """Names of the rasteriser's backends that rendered them."""
    changes: dict[str, Any]
    """Fields that differ from the suite's definition, by dotted path."""
    scale: float
    """Resolution over that of the suite's definition."""
    variants: dict[str, VariantFacts]
    """Variants by name, such as `fog-3`."""
    scenes: dict[str, SceneFacts]
    """Scenes by name."""
    failed: tuple[FailedImage, ...]
    """Images that could not be rendered."""
    files: dict[str, Sha256]
    """SHA-256 of every file, by path."""

    @property
    def content_hash(self) -> str:
        """Return the SHA-256 of everything else that the file says."""
        text = json.dumps(self.model_dump(mode="json"), sort_keys=True, separators=(",", ":"))
        return hashlib.sha256(text.encode()).hexdigest()

    def to_json(self) -> bytes:
        """Return the file's bytes."""
        data = {**self.model_dump(mode="json"), "sha256": self.content_hash}
        return (json.dumps(data, indent=1, ensure_ascii=False) + "\n").encode()

    @staticmethod
    def from_json(data: bytes, source_name: str) -> SuiteFile:
        """Return the content of a file's bytes.

        Raises:
            OutputError: The bytes are no such file, or were changed after it was written.
        """
        advice = "Start the suite again, which writes it anew"
        with parse_errors_as_output_errors(source_name, advice):
            fields = json.loads(data)
            stated_hash = fields.pop("sha256")
            suite_file = SuiteFile.model_validate(fields)
        content_hash = suite_file.content_hash
        if stated_hash != content_hash:
            raise OutputError(
                f"{source_name} was changed after it was written: its content has the SHA-256 "
                f"{content_hash}, and it states {stated_hash}. {advice}"
            )
        return suite_file


class SuiteRequest(NamedTuple):
    """Facts of a suite that its images do not state."""

    suite: Suite
    """The definition."""
    name: str
    """Name of the suite, or of its quarter."""
    changes: Mapping[str, object]
    """Fields that differ from the definition, by dotted path."""
    scale: float
    """Resolution over that of the definition."""
    conditions: Mapping[str, tuple[str, ...]]
    """Conditions of recordings, by the scene's statement of its origin."""


def read_suite_file(store: Store) -> SuiteFile:
    """Return the output's `suite.json`.

    Raises:
        OutputError: There is none, or it is damaged.
    """
    try:
        data = store.read(SUITE_FILE)
    except StoredFileMissing:
        raise OutputError(
            f"{store.uri} holds no {SUITE_FILE}: no suite was rendered there, or it is not "
            f"finished. `climategs suite weather-c ... --out {store.uri}` writes it at its end"
        ) from None
    return SuiteFile.from_json(data, f"{store.uri}/{SUITE_FILE}")


def check_same_suite(store: Store, request: SuiteRequest) -> None:
    """Refuse to mix two suites, or two forms of one, in an output.

    Raises:
        OutputError: The output's `suite.json` is of another suite, scale or changes.
    """
    if not store.exists(SUITE_FILE):
        return
    earlier = read_suite_file(store)
    facts = {
        "suite": (earlier.suite, request.name),
        "version of ClimateGS": (earlier.code_version, augment.__version__),
        "scale": (earlier.scale, request.scale),
        "changes": (earlier.changes, dict(request.changes)),
    }
    for name, (stored_value, requested_value) in facts.items():
        if stored_value != requested_value:
            raise OutputError(
                f"{store.uri} holds a suite with another {name}: {stored_value!r} there, "
                f"{requested_value!r} here; choose another --out"
            )


def describe_suite(
    store: Store, request: SuiteRequest, other_paths: Iterable[str] = ()
) -> SuiteFile:
    """Return the facts of all images of a suite in an output, and hash its files.

    Args:
        store: The output.
        request: Facts that the images do not state.
        other_paths: Paths of files that belong to the suite besides those of its variants.

    Raises:
        OutputError: A file of the manifest is missing, or nothing is finished.
    """
    all_names = [variant.name for variant in request.suite.variants]
    rows = [row for row in read_manifest_rows(store).to_pylist() if row["recipe"] in all_names]
    ok_rows = [row for row in rows if row["status"] == OK]
    rows_by_variant: defaultdict[str, list[dict[str, Any]]] = defaultdict(list)
    rows_by_scene: defaultdict[str, list[dict[str, Any]]] = defaultdict(list)
    for row in ok_rows:
        rows_by_variant[row["recipe"]].append(row)
        rows_by_scene[row["scene"]].append(row)
    names = [name for name in all_names if name in rows_by_variant]
    return SuiteFile(
        suite=request.name,
        code_version=augment.__version__,
        backends=tuple(sorted({row["backend"] for row in ok_rows})),
        changes=dict(request.changes),
        scale=request.scale,
        variants={name: _variant_facts(request, name, rows_by_variant[name]) for name in names},
        scenes={
            scene: _scene_facts(request, scene_rows)
            for scene, scene_rows in sorted(rows_by_scene.items())
        },
        failed=tuple(
            FailedImage(
                scene=row["scene"],
                variant=row["recipe"],
                frame=row["frame"],
                camera=row["camera"],
                message=row["message"],
            )
            for row in rows
            if row["status"] != OK
        ),
        files=hash_files(store, [*_suite_paths(store, ok_rows), *other_paths]),
    )


def hash_files(store: Store, paths: Iterable[str]) -> dict[str, str]:
    """Return the SHA-256 of files, by path; missing files have none."""
    ordered_paths = sorted(paths)

    def digest_of(path: str) -> str | None:
        try:
            return hashlib.sha256(store.read(path)).hexdigest()
        except StoredFileMissing:
            return None

    with ThreadPoolExecutor(_NUM_READS, thread_name_prefix="hashes") as pool:
        digests = zip(ordered_paths, pool.map(digest_of, ordered_paths), strict=True)
        return {path: digest for path, digest in digests if digest is not None}


def choose_probes(paths: Iterable[str]) -> tuple[str, ...]:
    """Return the first, the middle and the last of some paths, in their order as texts."""
    ordered_paths = sorted(set(paths))
    last = len(ordered_paths) - 1
    numbers = sorted({round(last * k / (NUM_PROBES - 1)) for k in range(NUM_PROBES)})
    return tuple(ordered_paths[number] for number in numbers) if ordered_paths else ()


def _variant_facts(request: SuiteRequest, name: str, rows: list[dict[str, Any]]) -> VariantFacts:
    """Return the facts of a variant from the manifest's rows of its images."""
    variant = SuiteVariant.parse(name)
    level = request.suite.level_of(variant)
    effect = None if variant.effect == CLEAN else request.suite.effects[variant.effect]
    scenes = sorted({row["scene"] for row in rows})
    seeds = {row["scene"]: row["seed"] for row in rows}
    recipe = scaled_recipe(request.suite.recipe(variant, scenes[0], request.changes), request.scale)
    return VariantFacts(
        effect=variant.effect,
        level=variant.level,
        number="" if effect is None else effect.number,
        unit="" if effect is None else effect.unit,
        value=None if level is None else level.value,
        folder=folder_name(variant_name(recipe)),
        numbers=_numbers_of(recipe),
        recipe=recipe.model_dump(mode="json", exclude={"seed"}),
        seeds={scene: seeds[scene] for scene in scenes},
        probes=choose_probes(row["image_path"] for row in rows),
    )


def _numbers_of(recipe: Recipe) -> dict[str, float | str]:
    """Return numbers and tags of a recipe's weather by column, without those that are not there."""
    columns = {**recipe.columns(), **columns_of_tags(recipe)}.items()
    # NaN, which no JSON has, stands for an absent effect.
    return {name: value for name, value in columns if value is not None and value == value}


def _scene_facts(request: SuiteRequest, rows: list[dict[str, Any]]) -> SceneFacts:
    """Return the facts of a scene from the manifest's rows of its images."""
    source = rows[0]["source"]
    conditions = request.conditions.get(source, ())
    return SceneFacts(
        source=source,
        recorded_conditions=conditions,
        omitted_effects=request.suite.effects_in(conditions),
        frames=tuple(sorted({row["frame"] for row in rows})),
        cameras=tuple(sorted({row["camera"] for row in rows})),
    )


def _suite_paths(store: Store, rows: list[dict[str, Any]]) -> list[str]:
    """Return the paths of all files of a suite: those of its variants, sweeps, the manifest.

    Raises:
        OutputError: A file that the manifest names is missing.
    """
    folders = {f"{variant_folder(row['scene'], row['variant'])}/" for row in rows}
    folders |= {f"{folder_name(row['scene'])}/{SWEEP_FOLDER}/" for row in rows}
    stored_paths = [path for path in store.list("") if not path.startswith(f"{STATE_FOLDER}/")]
    paths = [path for path in stored_paths if _folder_of(path, folders)]
    named_paths = {
        value
        for row in rows
        for column, value in row.items()
        if column.endswith("_path") and value is not None
    }
    if missing_paths := sorted(named_paths - set(paths)):
        raise OutputError(
            f"{store.uri}: {len(missing_paths)} files of the manifest are missing, the first of "
            f"them {missing_paths[0]}; start the suite again, which renders them"
        )
    return [*paths, MANIFEST_FILE]


def _folder_of(path: str, folders: set[str]) -> str | None:
    """Return the folder, of those `scene/variant/`, in which a path lies; None for none."""
    parts = path.split("/", 2)
    folder = f"{'/'.join(parts[:2])}/"
    return folder if len(parts) == 3 and folder in folders else None
