"""A tiny recorded drive made in code: images on disk, returns in memory, surfaces as splats.

The car stands or drives along +x; cameras look along +x unless turned. World z up, ground at 0.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch

from augment.scene.cameras import Camera, Frame
from augment.scene.labels import Boxes, LidarSweep
from augment.scene.scene import Actor, Gaussians, Scene
from augment.scene.sky import ConstantSky

FRAME_NS = 100_000_000
WHOLE = r"(?s)\A.*\Z"  # a pattern for all of a file
AHEAD = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])  # camera_from_world of one along +x
LEFT = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])


@dataclass(frozen=True)
class Sweeps:
    """Labels without boxes; `by_frame` holds each frame's returns, float64 [N, 3] in the world or
    [N, 4] with their intensity."""

    by_frame: Mapping[int, np.ndarray]

    def boxes(self, frame_index: int) -> Boxes:
        return Boxes.empty()

    def lidar(self, frame_index: int) -> LidarSweep | None:
        points = self.by_frame.get(frame_index)
        if points is None:
            return None
        names = ("x", "y", "z", "intensity")[: points.shape[1]]
        columns = {name: points[:, i] for i, name in enumerate(names)}
        times = np.full(len(points), frame_index * FRAME_NS, np.int64)
        return LidarSweep(columns | {"timestamp_ns": times})


def camera(
    name: str = "front",
    frame: int = 0,
    *,
    size=(64, 48),
    focal_px: float = 40.0,
    position=(0.0, 0.0, 1.5),
    rotation: np.ndarray = AHEAD,
) -> Camera:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, -rotation @ np.asarray(position, np.float64)
    width, height = size
    return Camera(
        name, width, height, focal_px, focal_px, width / 2, height / 2,
        torch.from_numpy(pose), frame * FRAME_NS,
    )  # fmt: skip


def paint(path: Path, rgb: np.ndarray) -> str:
    """Write an image; returns its path as scenes hold it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), np.ascontiguousarray(rgb[..., ::-1]))
    return str(path)


def drive(
    folder: Path,
    frames: int,
    *,
    cameras: Callable[[int], Mapping[str, Camera]] = lambda f: {"front": camera(frame=f)},
    picture: Callable[[Camera, int], np.ndarray] | None = None,
    sweeps: Mapping[int, np.ndarray] | None = None,
    background: Gaussians | None = None,
    actors: tuple[Actor, ...] = (),
    speed_mps: float = 8.0,
    suffix: str = ".png",
) -> Scene:
    """A scene of so many frames, numbered 0, 1, ..., with an image for every camera."""
    made = []
    for number in range(frames):
        rig = cameras(number)
        paths = {}
        for name, cam in rig.items():
            rgb = plain(cam, number) if picture is None else picture(cam, number)
            paths[name] = paint(folder / name / f"{number:03d}{suffix}", rgb)
        ego = torch.eye(4, dtype=torch.float64)
        ego[0, 3] = speed_mps * number * FRAME_NS * 1e-9
        made.append(Frame(number, number * FRAME_NS, ego, rig, paths))
    labels = None if sweeps is None else Sweeps(sweeps)
    return Scene(
        "drive", "test:drive", one_splat() if background is None else background, actors,
        ConstantSky(torch.ones(3)), tuple(made), labels,
    )  # fmt: skip


def plain(cam: Camera, number: int) -> np.ndarray:
    """A picture that differs from frame to frame and has a gradient, so that flips show."""
    rows, columns = np.mgrid[: cam.height, : cam.width]
    levels = np.stack([columns * 2, rows * 3, np.full_like(rows, 10 * number + 20)], -1)
    return np.clip(levels, 0, 255).astype(np.uint8)


def one_splat() -> Gaussians:
    return flat_splats(np.array([[10.0, 0, 1]]), 0.1)


def flat_splats(means: np.ndarray, scale_m: float) -> Gaussians:
    """Opaque grey balls."""
    count = len(means)
    return Gaussians(
        torch.from_numpy(np.asarray(means, np.float32)),
        torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1),
        torch.full((count, 3), scale_m),
        torch.full((count,), 0.95),
        torch.zeros(count, 1, 3),
    )


@contextmanager
def changed(path: Path, pattern: str | None, text: str = "") -> Iterator[None]:
    """A file with what matches the pattern replaced by a text, or without the file where there is
    no pattern; as it was afterwards. An empty pattern changes nothing."""
    before = path.read_bytes()
    if pattern is None:
        path.unlink()
    elif pattern:
        after, count = re.subn(pattern, text, before.decode(), flags=re.MULTILINE)
        assert count, (path, pattern)
        path.write_text(after)
    try:
        yield
    finally:
        path.write_bytes(before)
