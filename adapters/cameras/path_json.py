"""The camera path: a small JSON format for poses made by hand or by a script.

    {"width": 960, "height": 540, "fx": 600, "fy": 600, "cx": 480, "cy": 270,
     "frames": [{"timestamp_s": 0.0, "camera": "front",
                 "position": [0, 0, 1.6], "look_at": [9, 0, 1.6]},
                {"timestamp_s": 0.1, "camera": "front",
                 "world_from_camera": [[…], […], […], […]]}]}

Lengths and axes are those of the world the path is used in; cameras are OpenCV (x right, y down,
z forward). `fy` defaults to `fx`, `cx, cy` to the middle, `camera` to "camera". `timestamp_s`
counts from the scene's first frame, and entries of one time are one frame. Without times, the n-th
entry of every camera is frame n, 0.1 s apart.
"""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

from adapters.cameras.json_formats import Focal, Number, Pixels, Pose, Vector, validate
from adapters.cameras.posed_views import PosedView, ViewSet, check_pose, look_at_pose

# int64 nanoseconds reach 9.2e9 s.
Seconds = Annotated[float, Field(strict=True, ge=-9e9, le=9e9, allow_inf_nan=False)]


class _PathFrame(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")
    timestamp_s: Seconds | None = None
    camera: Annotated[str, Field(pattern=r"^\w[\w.-]*$", max_length=64)] = "camera"
    position: Vector | None = None
    look_at: Vector | None = None
    world_from_camera: Pose | None = None

    @model_validator(mode="after")
    def _has_one_pose(self) -> _PathFrame:
        pair = (self.position is not None, self.look_at is not None)
        if pair != ((self.world_from_camera is None),) * 2:
            raise ValueError("give either position and look_at, or world_from_camera")
        return self


class _PathFile(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")
    width: Pixels
    height: Pixels
    fx: Focal
    fy: Focal | None = None
    cx: Number | None = None
    cy: Number | None = None
    frames: Annotated[list[_PathFrame], Field(min_length=1)]

    @model_validator(mode="after")
    def _times_are_whole(self) -> _PathFile:
        timed = [f.timestamp_s is not None for f in self.frames]
        if any(timed) and not all(timed):
            raise ValueError(
                f"timestamp_s must be in all frames or in none; it is in {sum(timed)} of "
                f"{len(timed)} (missing first in frames.{timed.index(False)})"
            )
        keys = Counter((f.timestamp_s, f.camera) for f in self.frames)
        key, most = keys.most_common(1)[0]
        if all(timed) and most > 1:
            raise ValueError(f"camera {key[1]!r} stands {most} times at timestamp_s {key[0]}")
        return self


def path_views(content: object, path: Path) -> ViewSet:
    """Views of a camera path.

    Raises:
        AdapterError: a field is unknown, missing or out of range; names its place and value.
    """
    file = validate(_PathFile, content, path, "camera path")
    times = sorted({f.timestamp_s for f in file.frames if f.timestamp_s is not None})
    rank = {time: number for number, time in enumerate(times)}
    seen: Counter[str] = Counter()
    views = []
    for number, frame in enumerate(file.frames):
        where = f"{path}: frames.{number}"
        if frame.position is not None and frame.look_at is not None:
            pose = look_at_pose(frame.position, frame.look_at, where=where)
        else:
            pose = check_pose(np.asarray(frame.world_from_camera), where=where)
        time = frame.timestamp_s
        views.append(
            PosedView(
                name=f"frames.{number}",
                width=file.width,
                height=file.height,
                fx=file.fx,
                fy=file.fx if file.fy is None else file.fy,
                cx=file.width / 2 if file.cx is None else file.cx,
                cy=file.height / 2 if file.cy is None else file.cy,
                world_from_camera=pose,
                camera=frame.camera,
                frame=seen[frame.camera] if time is None else rank[time],
                timestamp_ns=None if time is None else round(time * 1e9),
            )
        )
        seen[frame.camera] += 1
    return ViewSet(tuple(views))
