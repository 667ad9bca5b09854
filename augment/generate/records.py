"""What a job knows of a scene without keeping it open, and the blocks of images it is cut into."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import augment
from augment.batch.journal import Identity
from augment.batch.layout import folder_name, variant_name
from augment.batch.rows import Pictured
from augment.batch.selection import SceneIndex, has_lidar, select_frames
from augment.batch.trajectory import RECORDED
from augment.cameras import scaled_size
from augment.errors import OutputError, SceneError
from augment.scene import Scene
from recipes.frames import parse_frames
from recipes.schema import Recipe

_FORMAT = 1


@dataclass(frozen=True)
class FrameRecord:
    """cameras: by name, width and height in pixels and the time of the image."""

    number: int
    timestamp_ns: int
    cameras: dict[str, tuple[int, int, int]]


@dataclass(frozen=True)
class SceneRecord:
    """A scene's frames and cameras. uri: as the job names it. source: as the scene does itself.

    has_labels: whether boxes can pass through. has_lidar: whether a frame has a sweep. open_s: how
    long opening it took. gaussians_bytes: of its splats.
    """

    uri: str
    name: str
    source: str
    has_labels: bool
    open_s: float
    gaussian_bytes: int
    frames: tuple[FrameRecord, ...]
    has_lidar: bool = True  # in records of before it was asked

    @staticmethod
    def of(scene: Scene, uri: str, open_s: float) -> SceneRecord:
        select_frames(SceneIndex.of(scene), None, None)  # or it holds no image at all
        return SceneRecord(
            uri=uri,
            name=scene.name,
            source=scene.source,
            has_labels=scene.labels is not None,
            has_lidar=has_lidar(scene, [frame.index for frame in scene.frames]),
            open_s=open_s,
            gaussian_bytes=scene.gaussian_bytes,
            frames=tuple(
                FrameRecord(
                    frame.index,
                    frame.timestamp_ns,
                    {
                        name: (camera.width, camera.height, camera.timestamp_ns)
                        for name, camera in sorted(frame.cameras.items())
                    },
                )
                for frame in sorted(scene.frames, key=lambda frame: frame.index)
            ),
        )

    def to_json(self) -> bytes:
        frames = [[f.number, f.timestamp_ns, f.cameras] for f in self.frames]
        facts = {**vars(self), "format": _FORMAT, "frames": frames}
        return json.dumps(facts, separators=(",", ":")).encode()

    @staticmethod
    def from_json(data: bytes, where: str) -> SceneRecord:
        """What `to_json` made bytes of.

        Raises:
            OutputError: the bytes are something else.
        """
        try:
            facts: dict[str, Any] = json.loads(data)
            if facts.pop("format") != _FORMAT:
                raise ValueError("it is of another version")
            frames = tuple(
                FrameRecord(number, time, {n: (w, h, t) for n, (w, h, t) in cameras.items()})
                for number, time, cameras in facts.pop("frames")
            )
            return SceneRecord(**facts, frames=frames)
        except (ValueError, TypeError, KeyError, AttributeError) as error:
            raise OutputError(
                f"{where} is damaged: {error}. Delete it; the scene is opened again"
            ) from error


@dataclass(frozen=True)
class Block:
    """Images that one worker renders in a row and that appear in the output at once.

    key: `<scene>/<variant>-<first frame>-<digest>`; the digest is of all that decides the block's
    images, so it stays the same whatever else is in the job. uri: what opens the scene. source:
    the scene's own word for that. scene: its name in the output. frames, cameras: in order.
    images: how many it has.
    """

    key: str
    uri: str
    source: str
    scene: str
    recipe: Recipe
    frames: tuple[int, ...]
    cameras: tuple[str, ...]
    images: int

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
        return Identity(self.source, self.recipe.hash, RECORDED, augment.__version__, backend)

    def pictured(self, record: SceneRecord) -> list[Pictured]:
        """All images of the block, by frame and camera."""
        wanted, cameras, scale = set(self.frames), set(self.cameras), self.recipe.render.scale
        return [
            Pictured(frame.number, name, time, *scaled_size(width, height, scale))
            for frame in record.frames
            if frame.number in wanted
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
    """The scene's blocks, variant by variant, in the order of the frames.

    frames: as `recipes.frames` reads them; ranges end with the scene. block_images: about how many
    images one has. Blocks begin at fixed frames of the scene, whatever the selection, so that most
    stay the same when it grows.

    Raises:
        SceneError: an unknown frame or camera, or no image is left.
    """
    known = {name for frame in record.frames for name in frame.cameras}
    if cameras is not None and (unknown := sorted(set(cameras) - known)):
        raise SceneError(
            f"scene {record.name!r} has no camera {', '.join(unknown)}; it has "
            f"{', '.join(sorted(known))}"
        )
    wanted_cameras = known if cameras is None else set(cameras)
    numbers = [frame.number for frame in record.frames]
    chosen = parse_frames(frames).select(numbers, clip=True)
    wanted = set(numbers if chosen is None else chosen)
    if unknown_frames := sorted(wanted - set(numbers)):
        raise SceneError(
            f"scene {record.name!r} has no frame {', '.join(map(str, unknown_frames))}; its frames "
            f"are {numbers[0]} to {numbers[-1]}"
        )
    span = max(1, block_images // max(len(wanted_cameras), 1))
    blocks: list[Block] = []
    for recipe in recipes:
        for start in range(0, len(record.frames), span):
            run = [f for f in record.frames[start : start + span] if f.number in wanted]
            counts = [len(wanted_cameras & f.cameras.keys()) for f in run]
            held = tuple(f.number for f, count in zip(run, counts, strict=True) if count)
            if held:
                names = tuple(sorted(wanted_cameras & {n for f in run for n in f.cameras}))
                key = _key(record, recipe, run[0].number, held, names, backend)
                blocks.append(
                    Block(
                        key,
                        record.uri,
                        record.source,
                        record.name,
                        recipe,
                        held,
                        names,
                        sum(counts),
                    )
                )
    if not blocks:
        raise SceneError(
            f"scene {record.name!r} ({record.uri}): frames {frames!r} and cameras "
            f"{'all' if cameras is None else ', '.join(cameras)} hold no image"
        )
    return blocks


def _key(
    record: SceneRecord,
    recipe: Recipe,
    first: int,
    frames: tuple[int, ...],
    cameras: tuple[str, ...],
    backend: str,
) -> str:
    decides = [record.source, recipe.hash, frames, cameras, augment.__version__, backend]
    digest = hashlib.sha256(json.dumps(decides).encode()).hexdigest()[:12]
    variant = folder_name(variant_name(recipe))
    return f"{folder_name(record.name)}/{variant}-{first:06d}-{digest}"
