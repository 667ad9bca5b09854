"""A job resolved: every scene's recipes in numbers, cut into blocks; as data and as a file.

The plan lies in the output as `.climategs/jobs/<name>.json`, so that progress can be read from the
output alone.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import augment
from augment.batch.layout import STATE_FOLDER, folder_name, variant_name
from augment.batch.store import Store
from augment.errors import ClimateGSError, OutputError, SceneError
from augment.generate.records import Block, SceneRecord, claim_name, cut_into_blocks
from recipes.job import JobRecipes, JobScene
from recipes.schema import Recipe

JOBS = f"{STATE_FOLDER}/jobs"
_FORMAT = 1


@dataclass(frozen=True)
class Plan:
    """blocks: in order, scene by scene. records: by scene. names: what a scene is called where the
    job says so. unusable: URI -> why the scene cannot be opened, or not as the job wants it.
    """

    job: str
    backend: str
    blocks: tuple[Block, ...]
    records: Mapping[str, SceneRecord]
    names: Mapping[str, str | None]
    unusable: Mapping[str, str]

    @property
    def images(self) -> int:
        return sum(block.images for block in self.blocks)


def make_plan(
    recipes: JobRecipes,
    scenes: Sequence[JobScene],
    found: Mapping[tuple[str, str | None], SceneRecord | str],
    backend: str,
    settled: Mapping[tuple[str, str], Recipe | str] = MappingProxyType({}),
) -> Plan:
    """The plan of a job. scenes: without patterns. found: the scene of every URI and name, or why
    it cannot be opened. settled: by scene and variant, those recipes whose quality had to choose
    its settings in the scene, or why it could not: no recipe of that scene is rendered then.

    Raises:
        ClimateGSError: two scenes would share a folder, or none of them can be used.
        RecipeError: a draw breaks a rule.
    """
    blocks: list[Block] = []
    records: dict[str, SceneRecord] = {}
    unusable: dict[str, str] = {}
    for entry in scenes:
        record = found[entry.uri, entry.name]
        if isinstance(record, str):
            unusable[entry.uri] = record
            continue
        _check_folder(records, record)
        drawn = recipes.of_scene(entry, record.name)
        chosen = [settled.get((record.name, variant_name(recipe)), recipe) for recipe in drawn]
        if failed := [why for why in chosen if isinstance(why, str)]:
            unusable[entry.uri] = failed[0]
            continue
        try:
            cut = cut_into_blocks(
                record,
                [recipe for recipe in chosen if isinstance(recipe, Recipe)],
                frames=entry.frames,
                cameras=entry.cameras,
                block_images=recipes.job.block_images,
                backend=backend,
            )
        except SceneError as error:
            unusable[entry.uri] = str(error)
            continue
        records[record.name] = record
        blocks += cut
    if not records:
        reasons = "".join(f"\n  {uri}: {why}" for uri, why in list(unusable.items())[:5])
        raise ClimateGSError(f"job {recipes.job.name}: none of its scenes can be used:{reasons}")
    names = {record.name: entry.name for entry, record in _pairs(scenes, found)}
    return Plan(recipes.job.name, backend, tuple(blocks), records, names, unusable)


def shard_of(blocks: Sequence[Block], number: int, count: int) -> list[Block]:
    """The blocks of shard `number` (counted from 1) of `count`: a run of about as many images as
    every other's, so that most scenes are opened by one shard only.
    """
    total, before = sum(block.images for block in blocks), 0
    mine = []
    for block in blocks:
        if (before + block.images / 2) * count // max(total, 1) == number - 1:
            mine.append(block)
        before += block.images
    return mine


@dataclass(frozen=True)
class PlannedBlock:
    """A block as the plan's file has it. key: of the block. images: how many."""

    key: str
    scene: str
    variant: str
    recipe: str
    images: int

    @property
    def claim(self) -> str:
        """As `Block.claim`."""
        return claim_name(self.key)


@dataclass(frozen=True)
class StoredPlan:
    """What the output says of a job."""

    job: str
    version: str
    blocks: tuple[PlannedBlock, ...]
    unusable: Mapping[str, str]


def store_plan(store: Store, plan: Plan) -> None:
    """Write the plan's file; the same for every shard and every time.

    Raises:
        OutputError: it cannot be written.
    """
    data = _to_json(plan)
    path = f"{JOBS}/{plan.job}.json"
    if not (store.exists(path) and store.read(path) == data):
        store.write(path, data)


def stored_plans(store: Store) -> list[StoredPlan]:
    """The plans of all jobs in the output, by name.

    Raises:
        OutputError: one is damaged.
    """
    paths = [path for path in store.list(JOBS) if path.endswith(".json")]
    return [_from_json(store.read(path), f"{store.uri}/{path}") for path in sorted(paths)]


def _pairs(
    scenes: Sequence[JobScene], found: Mapping[tuple[str, str | None], SceneRecord | str]
) -> list[tuple[JobScene, SceneRecord]]:
    pairs = [(entry, found[entry.uri, entry.name]) for entry in scenes]
    return [(entry, record) for entry, record in pairs if isinstance(record, SceneRecord)]


def _check_folder(records: Mapping[str, SceneRecord], record: SceneRecord) -> None:
    for other in records.values():
        if folder_name(other.name).casefold() == folder_name(record.name).casefold():
            raise ClimateGSError(
                f"the scenes {other.uri} and {record.uri} are both called {record.name!r}, so they "
                f"would share a folder; give one of them a name in the job: "
                f"{{uri: {record.uri!r}, name: ...}}"
            )


def _to_json(plan: Plan) -> bytes:
    blocks = [[b.key, b.scene, b.variant, b.recipe.name, b.images] for b in plan.blocks]
    facts = {
        "format": _FORMAT,
        "job": plan.job,
        "version": augment.__version__,
        "images": plan.images,
        "scenes": len(plan.records),
        "unusable": dict(plan.unusable),
        "blocks": blocks,
    }
    return json.dumps(facts, separators=(",", ":")).encode()


def _from_json(data: bytes, where: str) -> StoredPlan:
    try:
        facts = json.loads(data)
        if facts["format"] != _FORMAT:
            raise ValueError("it is of another version")
        blocks = tuple(PlannedBlock(*block) for block in facts["blocks"])
        plan = StoredPlan(facts["job"], facts["version"], blocks, facts["unusable"])
        _check_types(plan)
        return plan
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
        raise OutputError(f"{where} is damaged: {error}. Delete it and start the job again") from (
            error
        )


def _check_types(plan: StoredPlan) -> None:
    texts = [plan.job, plan.version, *plan.unusable.keys(), *plan.unusable.values()]
    for block in plan.blocks:
        texts += [block.key, block.scene, block.variant, block.recipe]
        if type(block.images) is not int or block.images < 1:
            raise ValueError(f"a block of {block.images!r} images")
    for text in texts:
        if not isinstance(text, str):
            raise ValueError(f"{text!r} in place of a text")
