"""How far a job has come, read from its output alone."""

from __future__ import annotations

import contextlib
import time
from collections import defaultdict
from dataclasses import dataclass

from augment.errors import OutputError
from augment.jobs.blocks import StoredPlan, stored_plans
from augment.jobs.claims import CLAIMS_FOLDER, try_claim
from augment.jobs.layout import MANIFEST, STATE_FOLDER
from augment.jobs.manifest import OK, Part, list_parts, read_manifest
from augment.jobs.store import Store

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
            finished = sum(j.read_bytes().count(b'"status":"ok"') for j in progress_logs)
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
