"""A dataset directory as a trained model sees it, and its frames."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from adapters.street_gaussians.calibration import (
    EgoPath,
    calibrated_cameras,
    inverse,
    read_camera_moments,
    read_ego_path,
    read_lens,
)
from adapters.street_gaussians.images import find_images
from adapters.street_gaussians.records import (
    CAMERA_NAMES,
    ModelConfig,
    StreetData,
    StreetImage,
)
from adapters.street_gaussians.tracks import (
    place_rows,
    read_track_table,
    read_visibility,
    seen_rows,
    track_files,
    tracked_objects,
    tracklets_of,
)
from augment.cameras import Camera, Frame
from augment.errors import AdapterError


def read_data(root: Path, config: ModelConfig) -> StreetData:
    """The frames, cameras and moving objects that the configuration selects.

    Images may be missing: what a camera sees is then told by its calibration and Waymo's sizes.

    Raises:
        AdapterError: no such folder; a missing or damaged file of calibration, poses, times or
            tracks; a selection of cameras or frames that the dataset has not.
    """
    if not root.is_dir():
        raise AdapterError(f"{root} is not a folder; expected a drive in Street Gaussians' layout")
    cams = _cameras(root, config)
    path = read_ego_path(root)
    frames, problems = _selected(root, path, config)
    origin = path.centre_m
    rows = slice(frames[0] - path.numbers[0], frames[-1] + 1 - path.numbers[0])
    world_from_ego = _centred(path.world_from_ego[rows], origin)
    images, image_problems = _images(root, path, frames, cams, config, origin)

    track_path, visible_path = track_files(root, use_tracker=config.use_tracker)
    table = read_track_table(track_path)
    seen = seen_rows(table, read_visibility(visible_path), visible_path, cams)
    tracklets = tracklets_of(table, place_rows(table, seen, frames, world_from_ego))
    times = path.times_s[rows]
    moments = [*times, *(image.timestamp_s for image in images)]
    return StreetData(
        root=root,
        world_origin_m=origin,
        frames=tuple(frames),
        frame_times_s=times,
        world_from_ego=world_from_ego,
        images=images,
        objects=tracked_objects(
            table, seen, tracklets.ids, frames, times, (min(moments), max(moments))
        ),
        tracklets=tracklets,
        problems=(*path.problems, *problems, *image_problems, *table.problems),
    )


def frames_of(data: StreetData) -> tuple[Frame, ...]:
    """The frames that have images or could have, with cameras as they recorded."""
    by_frame: dict[int, list[StreetImage]] = {}
    for image in data.images:
        by_frame.setdefault(image.frame, []).append(image)
    return tuple(
        Frame(
            index=number,
            timestamp_ns=round(float(seconds) * 1e9),
            world_from_ego=torch.from_numpy(pose.copy()),
            cameras={image.name: camera_of(image) for image in by_frame[number]},
            image_paths={i.name: str(i.path) for i in by_frame[number] if i.path is not None},
        )
        for number, seconds, pose in zip(
            data.frames, data.frame_times_s, data.world_from_ego, strict=True
        )
        if number in by_frame
    )


def camera_of(image: StreetImage) -> Camera:
    """The camera at the moment of the image, of the recorded size."""
    camera_from_world = image.camera_from_ego @ inverse(image.world_from_ego)
    return Camera(
        name=image.name,
        width=image.width,
        height=image.height,
        fx=image.fx,
        fy=image.fy,
        cx=image.cx,
        cy=image.cy,
        camera_from_world=torch.from_numpy(camera_from_world),
        timestamp_ns=image.timestamp_ns,
    )


def held_out_steps(count: int, config: ModelConfig) -> frozenset[int]:
    """Which of so many selected frames are not trained on, by their position among them."""
    steps = range(count)
    if config.split_test > 0:
        return frozenset(steps[config.split_test :: config.split_test])
    if config.split_train > 0:
        return frozenset(steps) - frozenset(steps[:: config.split_train])
    return frozenset()


def _cameras(root: Path, config: ModelConfig) -> list[int]:
    cams = sorted(set(config.cameras))
    if not cams or not set(cams) <= set(range(len(CAMERA_NAMES))):
        raise AdapterError(
            f"{root}: the configuration's data.cameras must be some of 0 to "
            f"{len(CAMERA_NAMES) - 1} ({', '.join(CAMERA_NAMES)}); got {list(config.cameras)}"
        )
    absent = sorted(set(cams) - set(calibrated_cameras(root)))
    if absent:
        raise AdapterError(
            f"{root / 'extrinsics' / f'{absent[0]}.txt'} does not exist, but camera {absent[0]} "
            f"({CAMERA_NAMES[absent[0]]}) is used; copy it from the dataset"
        )
    return cams


def _selected(root: Path, path: EgoPath, config: ModelConfig) -> tuple[range, tuple[str, ...]]:
    """The selected frames' numbers, and a sentence where the dataset has fewer."""
    there = path.numbers
    if config.selected_frames is None:
        return there, ()
    first, last = config.selected_frames
    frames = range(max(first, there[0]), min(last, there[-1]) + 1)
    if not frames:
        raise AdapterError(
            f"{root}: the configuration's data.selected_frames are {first} to {last}; the dataset "
            f"has {there[0]} to {there[-1]}, so it is another drive's, or not whole"
        )
    if (frames[0], frames[-1]) == (first, last):
        return frames, ()
    said = (
        f"{root} has frames {there[0]} to {there[-1]} of the {first} to {last} that the "
        f"configuration selects"
    )
    return frames, (said,)


def _centred(poses: np.ndarray, origin: np.ndarray) -> np.ndarray:
    out = poses.copy()
    out[..., :3, 3] -= origin
    return out


def _images(
    root: Path,
    path: EgoPath,
    frames: range,
    cams: Sequence[int],
    config: ModelConfig,
    origin: np.ndarray,
) -> tuple[tuple[StreetImage, ...], tuple[str, ...]]:
    lenses = {cam: read_lens(root, cam) for cam in cams}
    found = find_images(root, frames, lenses)
    moments, problems = read_camera_moments(root, path, frames, cams)
    held_out = held_out_steps(len(frames), config)
    images = []
    for number, (frame, cam) in enumerate((frame, cam) for frame in frames for cam in cams):
        moment, lens = moments.get((frame, cam)), lenses[cam]
        if moment is None:
            continue
        width, height = found.sizes[cam]
        images.append(
            StreetImage(
                frame=frame,
                cam=cam,
                path=found.paths.get((frame, cam)),
                timestamp_s=moment.timestamp_s,
                world_from_ego=_centred(moment.world_from_ego, origin),
                camera_from_ego=lens.camera_from_ego,
                width=width,
                height=height,
                fx=lens.fx,
                fy=lens.fy,
                cx=lens.cx,
                cy=lens.cy,
                is_held_out=frames.index(frame) in held_out,
                number=number,
            )
        )
    return tuple(images), (*found.problems, *problems)
