"""What the URI of a raw drive may ask for, as in `pandaset:<path>?voxel_m=0.05&frames=0:10`."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from adapters.lidar.scene import LidarSceneOptions
from augment.errors import AdapterError
from recipes.nearest import nearest_word

IMAGE_SCALES = (1.0, 0.5, 0.25, 0.125)  # the fractions a JPEG decodes to without a second resize


@dataclass(frozen=True)
class HeldOut:
    """Frame numbers `first`, `first + step`, ... below `stop` (None: to the end), as `range`."""

    first: int
    stop: int | None = None
    step: int = 1

    def holds(self, frame: int) -> bool:
        inside = frame >= self.first and (self.stop is None or frame < self.stop)
        return inside and (frame - self.first) % self.step == 0

    def __str__(self) -> str:
        return f"{self.first}:{'' if self.stop is None else self.stop}:{self.step}"


@dataclass(frozen=True)
class DriveFrames:
    """Frame numbers of a scene, ascending, and those of them that are held out."""

    numbers: tuple[int, ...]
    held_out: frozenset[int]
    problems: tuple[str, ...] = ()

    @property
    def used(self) -> tuple[int, ...]:
        """The numbers of the frames that the scene is built from."""
        return tuple(number for number in self.numbers if number not in self.held_out)


@dataclass(frozen=True)
class DriveOptions:
    """Options of one opening; a scene is a function of the files and of these.

    first_frame, stop_frame: frame numbers used, stop excluded; None for the sequence's end.
    voxel_m: edge of a voxel near the ego path, metres; it grows with the distance from it.
    max_gaussians: voxels are enlarged until the scene holds no more than about this many.
    image_scale: resolution that images are decoded at for colours and sky. sky_size: texels along
    an edge of the sky's cube map. held_out: frames whose images and sweeps the Gaussians, their
    colours and the sky are made without; they stay in the scene, with cameras, images and labels,
    and their boxes still make tracks.
    """

    first_frame: int = 0
    stop_frame: int | None = None
    voxel_m: float = 0.04
    max_gaussians: int = 500_000
    image_scale: float = 0.5
    sky_size: int = 768
    held_out: HeldOut | None = None

    @staticmethod
    def from_query(
        scheme: str, query: Mapping[str, str], own: Mapping[str, str] | None = None
    ) -> DriveOptions:
        """The options of a URI's query. scheme: for messages. own: keys that the scheme has besides
        and reads itself, with what their values may be.

        Raises:
            AdapterError: an unknown key, or a value of the wrong kind or out of range.
        """
        own = own or {}
        unknown = sorted(set(query) - set(_KEYS) - set(own))
        if unknown:
            kinds = {key: kind for key, (_, kind) in _KEYS.items()} | dict(own)
            allowed = "; ".join(f"{key}: {kind}" for key, kind in kinds.items())
            near = nearest_word(unknown[0], tuple(kinds))
            guess = "" if near is None else f"did you mean {near!r}? "
            raise AdapterError(
                f"{scheme}: unknown option {unknown[0]!r}; {guess}allowed are {allowed}"
            )
        fields: dict[str, Any] = {}
        for key, text in query.items():
            if key in own:
                continue
            parse, kind = _KEYS[key]
            try:
                fields |= parse(key, text)
            except ValueError:
                raise AdapterError(f"{scheme}: {key} must be {kind}; got {text!r}") from None
        return DriveOptions(**fields)

    def keeps(self, frame: int) -> bool:
        return frame >= self.first_frame and (self.stop_frame is None or frame < self.stop_frame)

    def select(self, numbers: Sequence[int], *, where: str) -> DriveFrames:
        """Which of the dataset's frames the scene has.

        numbers: the dataset's, ascending. where: the dataset, for messages.

        Raises:
            AdapterError: no frame is left, or all are held out.
        """
        kept = tuple(number for number in numbers if self.keeps(number))
        if not kept:
            stop = "" if self.stop_frame is None else self.stop_frame
            raise AdapterError(
                f"{where}: frames={self.first_frame}:{stop} selects none of the {len(numbers)} "
                f"frames ({numbers[0]} to {numbers[-1]})"
            )
        if self.held_out is None:
            return DriveFrames(kept, frozenset())
        held = frozenset(filter(self.held_out.holds, kept))
        if len(held) == len(kept):
            raise AdapterError(
                f"{where}: held_out={self.held_out} holds out all {len(kept)} frames ({kept[0]} to "
                f"{kept[-1]}); leave some to build the scene from, as 1::2 does"
            )
        problem = f"held_out={self.held_out} holds out none of frames {kept[0]} to {kept[-1]}"
        return DriveFrames(kept, held, () if held else (problem,))

    def scene_options(self, lidar_top_deg: float) -> LidarSceneOptions:
        """What building takes of these. lidar_top_deg: highest elevation the LiDAR looks at."""
        return LidarSceneOptions(
            voxel_m=self.voxel_m,
            max_gaussians=self.max_gaussians,
            image_scale=self.image_scale,
            sky_size=self.sky_size,
            lidar_top_deg=lidar_top_deg,
        )


def _frames(_: str, text: str) -> dict[str, Any]:
    first, colon, stop = text.partition(":")
    if not colon:
        raise ValueError(text)
    fields = {"first_frame": int(first or 0), "stop_frame": int(stop) if stop else None}
    if fields["first_frame"] < 0 or (stop and fields["stop_frame"] <= fields["first_frame"]):
        raise ValueError(text)
    return fields


def _held_out(key: str, text: str) -> dict[str, Any]:
    parts = text.split(":")
    if len(parts) not in (2, 3):
        raise ValueError(text)
    first, stop, step = (int(part) if part else None for part in (*parts, "")[:3])
    first, step = first or 0, 1 if step is None else step
    if first < 0 or step < 1 or (stop is not None and stop <= first):
        raise ValueError(text)
    return {key: HeldOut(first, stop, step)}


def _integer(low: int, high: int) -> Callable[[str, str], dict[str, Any]]:
    def parse(key: str, text: str) -> dict[str, Any]:
        if not low <= int(text) <= high:
            raise ValueError(text)
        return {key: int(text)}

    return parse


def _voxel(key: str, text: str) -> dict[str, Any]:
    value = float(text)
    if not (math.isfinite(value) and 0.01 <= value <= 2):
        raise ValueError(text)
    return {key: value}


def _scale(key: str, text: str) -> dict[str, Any]:
    if float(text) not in IMAGE_SCALES:
        raise ValueError(text)
    return {key: float(text)}


_KEYS: dict[str, tuple[Callable[[str, str], dict[str, Any]], str]] = {
    "frames": (_frames, "first:stop, frame numbers with stop excluded, either side may be empty"),
    "voxel_m": (_voxel, "a number of metres from 0.01 to 2"),
    "max_gaussians": (_integer(1_000, 20_000_000), "an integer from 1000 to 20000000"),
    "image_scale": (_scale, "one of 1, 0.5, 0.25, 0.125"),
    "sky_size": (_integer(8, 4096), "an integer from 8 to 4096"),
    "held_out": (
        _held_out,
        "first:stop:step, frame numbers with stop excluded, such as 1::2 for every other one",
    ),
}
