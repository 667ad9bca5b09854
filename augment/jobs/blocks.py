"""Plan of a dataset job: every scene's images under every resolved recipe, cut into blocks.

In: recipes of a job and records of its scenes. Out: a `JobPlan` for `generate`, and the status of a
job for `climategs status`. The plan is stored in the output as `.climategs/jobs/<name>.json`, so
that progress can be read from the output alone.
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
from augment.errors import ClimateGSError, OutputError, SceneError
from augment.output.atomic import read_file
from augment.output.calibration import RECORDED
from augment.output.claims import CLAIMS_FOLDER, try_claim
from augment.output.layout import (
    OLD_PROGRESS_LOGS,
    PROGRESS_LOGS,
    parse_errors_as_output_errors,
    variant_name,
)
from augment.output.manifest import OK, Identity, ImageFacts, Part, list_parts, read_manifest
from augment.output.names import MANIFEST_FILE, STATE_FOLDER, folder_name
from augment.output.store import Store
from augment.photo.trust import judge_scene, source_views, unfitted_cameras
from augment.scene.cameras import scaled_size
from augment.scene.scene import Scene
from augment.scene.scene_index import SceneIndex, has_lidar, select_frames
from augment.scene.scene_times import times_of_drive
from recipes.errors import RecipeError
from recipes.job import ALL_CAMERAS, JobScene, SceneRecipes
from recipes.moment import SceneTimes
from recipes.schema import Recipe, parse_frames

# ---- Record of a scene that is not open, and the blocks of images it is cut into -----------------


@dataclass(frozen=True)
class FrameRecord:
    """Cameras of one frame."""

    number: int
    """Frame number."""
    timestamp_ns: int
    """Time of the frame."""
    cameras: dict[str, tuple[int, int, int]]
    """Width and height in pixels and the time of the image, by camera name."""


@dataclass(frozen=True)
class SceneRecord:
    """Frames and cameras of a scene."""

    uri: str
    """URI of the scene, as the job names it."""
    name: str
    """Name of the scene in the output."""
    source: str
    """The scene's own statement of its origin."""
    has_lidar: bool
    """True if a frame has a LiDAR sweep."""
    open_s: float
    """Seconds that opening the scene took."""
    frames: tuple[FrameRecord, ...]
    """Frames in order of number."""
    unfitted: tuple[str, ...] = ()
    """Names of the cameras that the scene was never fitted to."""
    learnt_scale: float | None = None
    """Size of the images that the scene was made from, divided by the size of the cameras'
    images.
    """
    problems: tuple[str, ...] = ()
    """Reasons why the scene is not fit for weather, as of augment.photo.trust.SceneTrust."""
    digest: str | None = None
    """Digest of the scene's content; None where it is not known."""

    @staticmethod
    def of(scene: Scene, uri: str, open_s: float, digest: str | None = None) -> SceneRecord:
        """Return the record of an open scene."""
        select_frames(SceneIndex.of(scene), None, None)  # raises where the scene has no image
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
            uri,
            scene.name,
            scene.source,
            lidar,
            open_s,
            tuple(frames),
            unfitted=unfitted,
            learnt_scale=source_views(scene).scale,
            problems=judge_scene(scene, cameras=cameras, scale=None, count=1).problems,
            digest=digest,
        )

    @property
    def times(self) -> SceneTimes:
        """Times of the scene's images, by which its weather changes."""
        images = (time for frame in self.frames for _, _, time in frame.cameras.values())
        return times_of_drive(images, [frame.timestamp_ns for frame in self.frames])

    def to_json(self) -> bytes:
        """Return the record as JSON."""
        return _RECORD.dump_json(self)

    @staticmethod
    def from_json(data: bytes, source_name: str) -> SceneRecord:
        """Return the record that `to_json` has written.

        Args:
            source_name: Name of the file, for errors.
        """
        with parse_errors_as_output_errors(source_name, "Delete it; the scene is opened again"):
            return _RECORD.validate_json(data, strict=True)


_RECORD = TypeAdapter(SceneRecord)


@dataclass(frozen=True)
class Block:
    """Images that one worker renders in a row and that appear in the output in one step."""

    key: str
    """`<scene>/<variant>-<first frame>-<digest>`. The digest is of all that decides the block's
    images; the rest of the job does not change it.
    """
    uri: str
    """URI that opens the scene."""
    source: str
    """The scene's own statement of its origin."""
    scene: str
    """Name of the scene in the output."""
    recipe: Recipe
    """Resolved recipe."""
    frames: tuple[int, ...]
    """Frame numbers."""
    cameras: tuple[str, ...]
    """Camera names."""
    images: int
    """Number of images."""
    digest: str | None = None
    """Digest of the scene's content. It is no part of the key, so that jobs go on with outputs that
    were begun before the digest was noted.
    """

    @property
    def variant(self) -> str:
        """Name of the block's variant."""
        return variant_name(self.recipe)

    @property
    def claim(self) -> str:
        """Name of the block's claim, and of the folder in which it is rendered."""
        return claim_name(self.key)

    @property
    def file_stem(self) -> str:
        """Stem of the block's files that belong to several images: `000016-3fc0a1b2`."""
        return self.key.rsplit("/", 1)[-1].removeprefix(folder_name(self.variant) + "-")

    def identity(self, backend: str) -> Identity:
        """Return the identity of the block's images.

        Args:
            backend: Name of the backend, or the chosen one where it is known.
        """
        version = augment.__version__
        return Identity(self.source, self.recipe.hash, RECORDED, version, backend, self.digest)

    def list_images(self, record: SceneRecord) -> list[ImageFacts]:
        """Return all images of the block, by frame and camera."""
        frame_numbers = set(self.frames)
        camera_names = set(self.cameras)
        scale = self.recipe.render.scale
        return [
            ImageFacts(frame.number, name, time_ns, *scaled_size(width, height, scale))
            for frame in record.frames
            if frame.number in frame_numbers
            for name, (width, height, time_ns) in frame.cameras.items()
            if name in camera_names
        ]


def claim_name(key: str) -> str:
    """Return a block's key as a single component of a path."""
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
    """Return the scene's blocks, variant by variant, in the order of the frames.

    Blocks begin at fixed frames, so that most blocks stay the same when the selection grows.

    Args:
        record: Record of the scene.
        recipes: Resolved recipes.
        frames: Selection of frames, as `recipes.schema` reads it; ranges end with the scene.
        cameras: Camera names. None: all cameras that the scene was fitted to; `all`: every camera.
        block_images: Approximate number of images in a block.
        backend: Name of the rasteriser's backend.
    """
    camera_names = {name for frame in record.frames for name in frame.cameras}
    if cameras is None:
        cameras = tuple(sorted(camera_names - set(record.unfitted))) if record.unfitted else None
    elif tuple(cameras) == ALL_CAMERAS:
        cameras = None
    if cameras is not None and (unknown_cameras := sorted(set(cameras) - camera_names)):
        raise SceneError(
            f"scene {record.name!r} has no camera {', '.join(unknown_cameras)}; it has "
            f"{', '.join(sorted(camera_names))}"
        )
    selected_cameras = camera_names if cameras is None else set(cameras)
    scene_frames = [frame.number for frame in record.frames]
    selected_frames = parse_frames(frames).select(scene_frames, clip=True)
    requested_frames = set(scene_frames if selected_frames is None else selected_frames)
    if unknown_frames := sorted(requested_frames - set(scene_frames)):
        raise SceneError(
            f"scene {record.name!r} has no frame {', '.join(map(str, unknown_frames))}; its frames "
            f"are {scene_frames[0]} to {scene_frames[-1]}"
        )
    block_frames = max(1, block_images // max(len(selected_cameras), 1))
    origin = record.uri, record.source, record.name
    blocks: list[Block] = []
    for recipe in recipes:
        stem = f"{folder_name(record.name)}/{folder_name(variant_name(recipe))}"
        for start in range(0, len(record.frames), block_frames):
            block_records = [
                f
                for f in record.frames[start : start + block_frames]
                if f.number in requested_frames
            ]
            num_images = [len(selected_cameras & f.cameras.keys()) for f in block_records]
            frame_numbers = tuple(
                f.number for f, count in zip(block_records, num_images, strict=True) if count
            )
            if frame_numbers:
                names = tuple(
                    sorted(selected_cameras & {n for f in block_records for n in f.cameras})
                )
                key_facts = [
                    record.source,
                    recipe.hash,
                    frame_numbers,
                    names,
                    augment.__version__,
                    backend,
                ]
                digest = hashlib.sha256(json.dumps(key_facts).encode()).hexdigest()[:12]
                key = f"{stem}-{block_records[0].number:06d}-{digest}"
                blocks.append(
                    Block(
                        key, *origin, recipe, frame_numbers, names, sum(num_images), record.digest
                    )
                )
    if not blocks:
        raise SceneError(
            f"scene {record.name!r} ({record.uri}): frames {frames!r} and cameras "
            f"{'all' if cameras is None else ', '.join(cameras)} hold no image"
        )
    return blocks


# ---- The plan ------------------------------------------------------------------------------------

# Folder of the plans.
JOBS = f"{STATE_FOLDER}/jobs"


@dataclass(frozen=True)
class JobPlan:
    """Blocks of a whole job."""

    job: str
    """Name of the job."""
    backend: str
    """Name of the rasteriser's backend."""
    blocks: tuple[Block, ...]
    """Blocks in order, scene by scene."""
    records: Mapping[str, SceneRecord]
    """Records by scene name."""
    names: Mapping[str, str | None]
    """Name that the job gives a scene, or None, by scene name."""
    unusable: Mapping[str, str]
    """Reasons why a scene cannot be opened, or not as the job asks for it, by URI."""

    @property
    def images(self) -> int:
        """Number of images."""
        return sum(block.images for block in self.blocks)


def make_job_plan(
    recipes: SceneRecipes,
    scenes: Sequence[JobScene],
    scene_records: Mapping[tuple[str, str | None], SceneRecord | str],
    backend: str,
    resolved: Mapping[tuple[str, str], Recipe | str] = MappingProxyType({}),
) -> JobPlan:
    """Return the plan of a job.

    Args:
        scenes: Scenes of the job, with patterns already expanded.
        scene_records: Record of every scene, or why it cannot be opened, by URI and name.
        resolved: Recipes whose quality had to choose settings, or why it could not, by scene and
            variant. In the second case no recipe of that scene is rendered.

    Raises:
        ClimateGSError: Two scenes would share a folder, or no scene can be used.
        RecipeError: A draw breaks a rule.
    """
    blocks: list[Block] = []
    records: dict[str, SceneRecord] = {}
    unusable: dict[str, str] = {}
    for entry in scenes:
        record = scene_records[entry.uri, entry.name]
        if isinstance(record, str):
            unusable[entry.uri] = record
            continue
        _check_folder(records, record)
        recipe_draws = recipes.resolve_for_scene(entry, record.name)
        resolved_recipes = [
            resolved.get((record.name, variant_name(recipe)), recipe) for recipe in recipe_draws
        ]
        try:
            for recipe in recipe_draws:
                recipe.check_times(record.times)
        except RecipeError as error:
            unusable[entry.uri] = str(error)
            continue
        if failures := [why for why in resolved_recipes if isinstance(why, str)]:
            unusable[entry.uri] = failures[0]
            continue
        try:
            scene_blocks = cut_into_blocks(
                record,
                [recipe for recipe in resolved_recipes if isinstance(recipe, Recipe)],
                frames=entry.frames,
                cameras=entry.cameras,
                block_images=recipes.job.block_images,
                backend=backend,
            )
        except SceneError as error:
            unusable[entry.uri] = str(error)
            continue
        records[record.name] = record
        blocks += scene_blocks
    if not records:
        reasons = "".join(f"\n  {uri}: {why}" for uri, why in list(unusable.items())[:5])
        raise ClimateGSError(f"job {recipes.job.name}: none of its scenes can be used:{reasons}")
    pairs = [(entry, scene_records[entry.uri, entry.name]) for entry in scenes]
    names = {record.name: e.name for e, record in pairs if isinstance(record, SceneRecord)}
    return JobPlan(recipes.job.name, backend, tuple(blocks), records, names, unusable)


def select_shard(blocks: Sequence[Block], number: int, count: int) -> list[Block]:
    """Return the blocks of shard `number` of `count`, counted from 1.

    Each shard is a run of about as many images as every other one, so that most scenes are opened
    by only one shard.
    """
    total_images = sum(block.images for block in blocks)
    images_before = 0
    shard_blocks = []
    for block in blocks:
        if (images_before + block.images / 2) * count // max(total_images, 1) == number - 1:
            shard_blocks.append(block)
        images_before += block.images
    return shard_blocks


@dataclass(frozen=True)
class PlannedBlock:
    """Block in the plan's file."""

    key: str
    """Key of the block."""
    scene: str
    """Name of the scene in the output."""
    variant: str
    """Name of the variant."""
    recipe: str
    """Name of the recipe."""
    images: Annotated[int, Field(ge=1)]
    """Number of images."""

    @property
    def claim(self) -> str:
        """Name of the block's claim, as of `Block.claim`."""
        return claim_name(self.key)


@dataclass(frozen=True)
class StoredPlan:
    """File of a job's plan."""

    job: str
    """Name of the job."""
    version: str
    """Version of this package that planned the job."""
    blocks: tuple[PlannedBlock, ...]
    """Blocks in order."""
    unusable: dict[str, str]
    """Reasons why scenes cannot be used, by URI."""
    format: Literal[2] = 2
    """Version of the file's format."""


_STORED_PLAN = TypeAdapter(StoredPlan)


def store_plan(store: Store, plan: JobPlan) -> None:
    """Write the plan's file; it is the same for every shard and every run."""
    blocks = [PlannedBlock(b.key, b.scene, b.variant, b.recipe.name, b.images) for b in plan.blocks]
    stored_plan = StoredPlan(plan.job, augment.__version__, tuple(blocks), dict(plan.unusable))
    data = _STORED_PLAN.dump_json(stored_plan)
    path = f"{JOBS}/{plan.job}.json"
    if not (store.exists(path) and store.read(path) == data):
        store.write(path, data)


def stored_plans(store: Store) -> list[StoredPlan]:
    """Return the plans of all jobs in the output, by name."""
    paths = [path for path in store.list(JOBS) if path.endswith(".json")]
    return [_from_json(store.read(path), f"{store.uri}/{path}") for path in sorted(paths)]


def _check_folder(records: Mapping[str, SceneRecord], record: SceneRecord) -> None:
    """Raise ClimateGSError where two scenes would share a folder."""
    for other_record in records.values():
        if folder_name(other_record.name).casefold() == folder_name(record.name).casefold():
            raise ClimateGSError(
                f"the scenes {other_record.uri} and {record.uri} are both called {record.name!r}, "
                f"so they would share a folder; give one of them a name in the job: "
                f"{{uri: {record.uri!r}, name: ...}}"
            )


def _from_json(data: bytes, source_name: str) -> StoredPlan:
    """Return the plan in a file's bytes."""
    with parse_errors_as_output_errors(source_name, "Start the job again, which writes it anew"):
        return _STORED_PLAN.validate_json(data, strict=True)


# ---- Status of a job, read from its output alone -------------------------------------------------

# Number of the last blocks whose times give the job's speed.
_NUM_RECENT = 20


@dataclass
class ImageCounts:
    """Counts of the images of a group."""

    planned: int = 0
    """Images of the plan."""
    published: int = 0
    """Images of published blocks."""
    in_failed_blocks: int = 0
    """All images of blocks in which some image failed."""


@dataclass(frozen=True)
class JobStatus:
    """Status of a job."""

    job: str
    """Name of the job."""
    version: str
    """Version of this package that planned the job."""
    total: ImageCounts
    """Counts of all images."""
    by_scene: dict[str, ImageCounts]
    """Counts by scene name."""
    by_recipe: dict[str, ImageCounts]
    """Counts by recipe name."""
    unusable: dict[str, str]
    """Reasons why scenes cannot be used, by URI."""
    blocks: int
    """Number of blocks."""
    blocks_published: int
    """Number of published blocks."""
    staged: int
    """Finished images of blocks that are not published yet, on this machine."""
    images_per_s: float | None
    """Speed of the last blocks; None where there are too few of them."""
    claims: int
    """Number of blocks that a process has claimed."""

    @property
    def remaining_s(self) -> float | None:
        """Seconds that the remaining images take at that speed; None where it is not known."""
        if not self.images_per_s:
            return None
        return (self.total.planned - self.total.published) / self.images_per_s


def read_status(store: Store) -> list[JobStatus]:
    """Return the status of every job in the output, by name.

    The list is empty where no job was ever started.
    """
    plans = stored_plans(store)
    if not plans:
        return []
    parts = list_parts(store)
    staged_images = _count_staged_images(store)
    claim_names = _claims(store)
    return [_status(plan, parts, staged_images, claim_names) for plan in plans]


def _status(
    plan: StoredPlan, parts: dict[str, Part], staged_images: dict[str, int], claim_names: set[str]
) -> JobStatus:
    """Return the status of one job."""
    total = ImageCounts()
    scenes: defaultdict[str, ImageCounts] = defaultdict(ImageCounts)
    recipes: defaultdict[str, ImageCounts] = defaultdict(ImageCounts)
    num_published = 0
    num_staged = 0
    num_claimed = 0
    times: list[tuple[float, int]] = []
    for block in plan.blocks:
        part = parts.get(block.key)
        for group in (total, scenes[block.scene], recipes[block.recipe]):
            group.planned += block.images
            if part is not None:
                group.published += block.images
                group.in_failed_blocks += block.images if part.has_failures else 0
        num_claimed += block.claim in claim_names
        if part is None:
            num_staged += min(staged_images.get(block.claim, 0), block.images)
        else:
            num_published += 1
            times.append((part.modified_s, block.images))
    return JobStatus(
        plan.job,
        plan.version,
        total,
        dict(scenes),
        dict(recipes),
        dict(plan.unusable),
        len(plan.blocks),
        num_published,
        num_staged,
        _pace(times),
        num_claimed,
    )


def _pace(times: list[tuple[float, int]]) -> float | None:
    """Return images per second of the last blocks; None where it is not known."""
    recent_times = sorted(times)[-_NUM_RECENT:]
    if len(recent_times) < 2 or time.time() - recent_times[-1][0] > 3600:
        return None
    seconds = recent_times[-1][0] - recent_times[0][0]
    return sum(images for _, images in recent_times[1:]) / seconds if seconds > 0 else None


def _count_staged_images(store: Store) -> dict[str, int]:
    """Return the number of finished images by block that is rendered on this machine."""
    if store.local_dir is None:
        return {}
    counts: dict[str, int] = {}
    for folder in (store.local_dir / STATE_FOLDER / "blocks").glob("*"):
        with contextlib.suppress(OSError, OutputError):  # another process has published it
            finished = 0
            for name in (PROGRESS_LOGS, OLD_PROGRESS_LOGS):
                for path in folder.glob(f"{STATE_FOLDER}/{name}/*/*.jsonl"):
                    finished += read_file(path).count(b'"status":"ok"')
            if (folder / MANIFEST_FILE).is_file():  # a run that was stopped, or had failures
                finished += read_manifest(folder)["status"].to_pylist().count(OK)
            counts[folder.name] = finished
    return counts


def _claims(store: Store) -> set[str]:
    """Return the names of claims; on a remote store also of processes that died moments ago."""
    paths = store.list(CLAIMS_FOLDER)
    names = {p.removeprefix(f"{CLAIMS_FOLDER}/").split("/")[0].removesuffix(".lock") for p in paths}
    return names if store.local_dir is None else {name for name in names if _is_held(store, name)}


def _is_held(store: Store, name: str) -> bool:
    """Return True if the claim's holder lives; the claim of a dead holder is deleted."""
    try:
        claim = try_claim(store, name)
    except OutputError:  # an output of another user, which can only be read
        return True
    if claim is not None:
        claim.release()
    return claim is None
