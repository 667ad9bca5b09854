"""A job resolved: every scene's recipes in numbers, cut into blocks; as data and as a file.

The plan lies in the output as `.climategs/jobs/<name>.json`, so that progress can be read from the
output alone.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import time
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Annotated, Literal

from pydantic import Field, TypeAdapter

import augment
from augment.cameras import scaled_size
from augment.errors import ClimateGSError, OutputError, SceneError
from augment.jobs.atomic import read_file
from augment.jobs.claims import CLAIMS_FOLDER, try_claim
from augment.jobs.files import RECORDED, SceneIndex, has_lidar, select_frames
from augment.jobs.layout import MANIFEST, STATE_FOLDER, folder_name, reading_back, variant_name
from augment.jobs.manifest import OK, Identity, Part, Pictured, list_parts, read_manifest
from augment.jobs.store import Store
from augment.scene import Scene
from augment.trust import judge_scene, seen_views, unfitted_cameras
from recipes.job import ALL, JobRecipes, JobScene
from recipes.schema import Recipe, parse_frames

# ---- What a job knows of a scene without keeping it open, and the blocks of images it is cut into


@dataclass(frozen=True)
class FrameRecord:
    """cameras: by name, width and height in pixels and the time of the image."""

    number: int
    timestamp_ns: int
    cameras: dict[str, tuple[int, int, int]]


@dataclass(frozen=True)
class SceneRecord:
    """A scene's frames and cameras. uri: as the job names it. source: as the scene does itself.
    has_lidar: whether there is any. open_s: how long opening it took. unfitted: cameras that it was
    never fitted to. learnt_scale: of the images that it was made from over the cameras. problems:
    what is not fit for weather, as of augment.trust.SceneTrust. digest: of its content, None where
    nobody knows it.
    """

    uri: str
    name: str
    source: str
    has_lidar: bool
    open_s: float
    frames: tuple[FrameRecord, ...]
    unfitted: tuple[str, ...] = ()
    learnt_scale: float | None = None
    problems: tuple[str, ...] = ()
    digest: str | None = None

    @staticmethod
    def of(scene: Scene, uri: str, open_s: float, digest: str | None = None) -> SceneRecord:
        select_frames(SceneIndex.of(scene), None, None)  # or it holds no image at all
        frames = [
            FrameRecord(
                frame.index,
                frame.timestamp_ns,
                {n: (c.width, c.height, c.timestamp_ns) for n, c in sorted(frame.cameras.items())},
            )
            for frame in sorted(scene.frames, key=lambda frame: frame.index)
        ]
        lidar = has_lidar(scene, [frame.number for frame in frames])
        unfitted = unfitted_cameras(scene)
        cameras = [name for name in scene.camera_names if name not in unfitted]
        return SceneRecord(
            *(uri, scene.name, scene.source, lidar, open_s, tuple(frames)),
            unfitted=unfitted,
            learnt_scale=seen_views(scene).scale,
            problems=judge_scene(scene, cameras=cameras, scale=None, count=1).problems,
            digest=digest,
        )

    def to_json(self) -> bytes:
        return _RECORD.dump_json(self)

    @staticmethod
    def from_json(data: bytes, where: str) -> SceneRecord:
        """What `to_json` made bytes of."""
        with reading_back(where, "Delete it; the scene is opened again"):
            return _RECORD.validate_json(data, strict=True)


_RECORD = TypeAdapter(SceneRecord)


@dataclass(frozen=True)
class Block:
    """Images that one worker renders in a row and that appear in the output at once. key:
    `<scene>/<variant>-<first frame>-<digest>`, the digest of all that decides the block's images,
    whatever else is in the job. uri: what opens the scene. source: the scene's own word for that.
    scene: its name in the output. images: how many it has. digest: of the scene's content; no part
    of the key, so that outputs of before it was noted are gone on with.
    """

    key: str
    uri: str
    source: str
    scene: str
    recipe: Recipe
    frames: tuple[int, ...]
    cameras: tuple[str, ...]
    images: int
    digest: str | None = None

    @property
    def variant(self) -> str:
        return variant_name(self.recipe)

    @property
    def claim(self) -> str:
        """Its name among the claims, and that of the folder it is rendered in."""
        return claim_name(self.key)

    @property
    def file_stem(self) -> str:
        """What its files are called that belong to several images: `000016-3fc0a1b2`."""
        return self.key.rsplit("/", 1)[-1].removeprefix(folder_name(self.variant) + "-")

    def identity(self, backend: str) -> Identity:
        """What its images are made from. backend: as named, or as chosen where that is known."""
        version = augment.__version__
        return Identity(self.source, self.recipe.hash, RECORDED, version, backend, self.digest)

    def pictured(self, record: SceneRecord) -> list[Pictured]:
        """All images of the block, by frame and camera."""
        requested, cameras, scale = set(self.frames), set(self.cameras), self.recipe.render.scale
        return [
            Pictured(frame.number, name, time, *scaled_size(width, height, scale))
            for frame in record.frames
            if frame.number in requested
            for name, (width, height, time) in frame.cameras.items()
            if name in cameras
        ]


def claim_name(key: str) -> str:
    """A block's key as a name that is a single part of a path."""
    return folder_name(key.replace("/", "."))


def cut_into_blocks(
    record: SceneRecord,
    recipes: Sequence[Recipe],
    *,
    frames: str = "all",
    cameras: Sequence[str] | None = None,
    block_images: int = 64,
    backend: str = "auto",
) -> list[Block]:
    """The scene's blocks, variant by variant, in the order of the frames. frames: as
    `recipes.schema` reads them; ranges end with the scene. cameras: names; None for all but those
    that were never fitted, and `all` for these too. block_images: about how many images one
    has. Blocks begin at fixed frames, so that most stay the same when the selection grows.
    """
    known = {name for frame in record.frames for name in frame.cameras}
    if cameras is None:
        cameras = tuple(sorted(known - set(record.unfitted))) if record.unfitted else None
    elif tuple(cameras) == ALL:
        cameras = None
    if cameras is not None and (unknown := sorted(set(cameras) - known)):
        raise SceneError(
            f"scene {record.name!r} has no camera {', '.join(unknown)}; it has "
            f"{', '.join(sorted(known))}"
        )
    selected_cameras = known if cameras is None else set(cameras)
    numbers = [frame.number for frame in record.frames]
    chosen = parse_frames(frames).select(numbers, clip=True)
    requested = set(numbers if chosen is None else chosen)
    if unknown_frames := sorted(requested - set(numbers)):
        raise SceneError(
            f"scene {record.name!r} has no frame {', '.join(map(str, unknown_frames))}; its frames "
            f"are {numbers[0]} to {numbers[-1]}"
        )
    span = max(1, block_images // max(len(selected_cameras), 1))
    origin = record.uri, record.source, record.name
    blocks: list[Block] = []
    for recipe in recipes:
        stem = f"{folder_name(record.name)}/{folder_name(variant_name(recipe))}"
        for start in range(0, len(record.frames), span):
            run = [f for f in record.frames[start : start + span] if f.number in requested]
            counts = [len(selected_cameras & f.cameras.keys()) for f in run]
            held = tuple(f.number for f, count in zip(run, counts, strict=True) if count)
            if held:
                names = tuple(sorted(selected_cameras & {n for f in run for n in f.cameras}))
                decides = [record.source, recipe.hash, held, names, augment.__version__, backend]
                digest = hashlib.sha256(json.dumps(decides).encode()).hexdigest()[:12]
                key = f"{stem}-{run[0].number:06d}-{digest}"
                blocks.append(Block(key, *origin, recipe, held, names, sum(counts), record.digest))
    if not blocks:
        raise SceneError(
            f"scene {record.name!r} ({record.uri}): frames {frames!r} and cameras "
            f"{'all' if cameras is None else ', '.join(cameras)} hold no image"
        )
    return blocks


# ---- The plan ------------------------------------------------------------------------------------

JOBS = f"{STATE_FOLDER}/jobs"


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
    resolved: Mapping[tuple[str, str], Recipe | str] = MappingProxyType({}),
) -> Plan:
    """The plan of a job. scenes: without patterns. found: the scene of every URI and name, or why
    it cannot be opened. resolved: by scene and variant, recipes whose quality had to choose, or why
    it could not: then no recipe of that scene is rendered. Raises ClimateGSError: two scenes would
    share a folder, or none can be used. RecipeError: a draw breaks a rule.
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
        chosen = [resolved.get((record.name, variant_name(recipe)), recipe) for recipe in drawn]
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
    pairs = [(entry, found[entry.uri, entry.name]) for entry in scenes]
    names = {record.name: e.name for e, record in pairs if isinstance(record, SceneRecord)}
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
    images: Annotated[int, Field(ge=1)]

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
    unusable: dict[str, str]
    format: Literal[2] = 2


_STORED_PLAN = TypeAdapter(StoredPlan)


def store_plan(store: Store, plan: Plan) -> None:
    """Write the plan's file; the same for every shard and every time."""
    blocks = [PlannedBlock(b.key, b.scene, b.variant, b.recipe.name, b.images) for b in plan.blocks]
    stored = StoredPlan(plan.job, augment.__version__, tuple(blocks), dict(plan.unusable))
    data = _STORED_PLAN.dump_json(stored)
    path = f"{JOBS}/{plan.job}.json"
    if not (store.exists(path) and store.read(path) == data):
        store.write(path, data)


def stored_plans(store: Store) -> list[StoredPlan]:
    """The plans of all jobs in the output, by name."""
    paths = [path for path in store.list(JOBS) if path.endswith(".json")]
    return [_from_json(store.read(path), f"{store.uri}/{path}") for path in sorted(paths)]


def _check_folder(records: Mapping[str, SceneRecord], record: SceneRecord) -> None:
    for other in records.values():
        if folder_name(other.name).casefold() == folder_name(record.name).casefold():
            raise ClimateGSError(
                f"the scenes {other.uri} and {record.uri} are both called {record.name!r}, so they "
                f"would share a folder; give one of them a name in the job: "
                f"{{uri: {record.uri!r}, name: ...}}"
            )


def _from_json(data: bytes, where: str) -> StoredPlan:
    with reading_back(where, "Start the job again, which writes it anew"):
        return _STORED_PLAN.validate_json(data, strict=True)


# ---- How far a job has come, read from its output alone ------------------------------------------

_RECENT = 20  # blocks whose times tell how fast it goes


@dataclass
class Progress:
    """Images of a group. in_failed_blocks: all those of blocks of which some image failed."""

    planned: int = 0
    published: int = 0
    in_failed_blocks: int = 0


@dataclass(frozen=True)
class JobStatus:
    """staged: images that are finished in blocks that are not published, on this machine.
    images_per_s: of the last blocks together, None where too few tell. claims: blocks that somebody
    works on.
    """

    job: str
    version: str
    total: Progress
    by_scene: dict[str, Progress]
    by_recipe: dict[str, Progress]
    unusable: dict[str, str]
    blocks: int
    blocks_published: int
    staged: int
    images_per_s: float | None
    claims: int

    @property
    def left_s(self) -> float | None:
        """How long the rest takes at that pace, seconds."""
        if not self.images_per_s:
            return None
        return (self.total.planned - self.total.published) / self.images_per_s


def read_status(store: Store) -> list[JobStatus]:
    """The status of every job in the output, by name; empty where none was ever started."""
    plans = stored_plans(store)
    if not plans:
        return []
    parts = list_parts(store)
    staged = _staged(store)
    claims = _claims(store)
    return [_status(plan, parts, staged, claims) for plan in plans]


def _status(
    plan: StoredPlan, parts: dict[str, Part], staged: dict[str, int], claims: set[str]
) -> JobStatus:
    total = Progress()
    scenes: defaultdict[str, Progress] = defaultdict(Progress)
    recipes: defaultdict[str, Progress] = defaultdict(Progress)
    published, in_stage, claimed = 0, 0, 0
    times: list[tuple[float, int]] = []
    for block in plan.blocks:
        part = parts.get(block.key)
        for group in (total, scenes[block.scene], recipes[block.recipe]):
            group.planned += block.images
            if part is not None:
                group.published += block.images
                group.in_failed_blocks += block.images if part.has_failures else 0
        claimed += block.claim in claims
        if part is None:
            in_stage += min(staged.get(block.claim, 0), block.images)
        else:
            published += 1
            times.append((part.modified_s, block.images))
    return JobStatus(
        plan.job,
        plan.version,
        total,
        dict(scenes),
        dict(recipes),
        dict(plan.unusable),
        len(plan.blocks),
        published,
        in_stage,
        _pace(times),
        claimed,
    )


def _pace(times: list[tuple[float, int]]) -> float | None:
    recent = sorted(times)[-_RECENT:]
    if len(recent) < 2 or time.time() - recent[-1][0] > 3600:
        return None
    seconds = recent[-1][0] - recent[0][0]
    return sum(images for _, images in recent[1:]) / seconds if seconds > 0 else None


def _staged(store: Store) -> dict[str, int]:
    """Finished images by block that is being rendered on this machine's disk into this output."""
    if store.local_dir is None:
        return {}
    counts: dict[str, int] = {}
    for folder in (store.local_dir / STATE_FOLDER / "blocks").glob("*"):
        with contextlib.suppress(OSError, OutputError):  # published meanwhile
            progress_logs = list(folder.glob(f"{STATE_FOLDER}/journal/*/*.jsonl"))
            finished = sum(read_file(j).count(b'"status":"ok"') for j in progress_logs)
            if (folder / MANIFEST).is_file():  # a run that was stopped, or had failures
                finished += read_manifest(folder)["status"].to_pylist().count(OK)
            counts[folder.name] = finished
    return counts


def _claims(store: Store) -> set[str]:
    """Names of what is claimed; elsewhere also by a process that was killed some seconds ago."""
    paths = store.list(CLAIMS_FOLDER)
    names = {p.removeprefix(f"{CLAIMS_FOLDER}/").split("/")[0].removesuffix(".lock") for p in paths}
    return names if store.local_dir is None else {name for name in names if _is_held(store, name)}


def _is_held(store: Store, name: str) -> bool:
    """Whether the claim's holder lives; a dead one's is cleared away."""
    try:
        claim = try_claim(store, name)
    except OutputError:  # somebody else's output, which can be read and no more
        return True
    if claim is not None:
        claim.release()
    return claim is None
