"""Recorded lenses: scenes whose cameras distort as those of the dataset did (`lens=recorded`).

A scene is always made from pinhole images. Where a dataset's images are distorted, these are
undistorted copies. By default the scene has the copies and their pinhole cameras. With
`lens=recorded` its `frames` have the cameras with their lenses and the images as recorded, and its
`seen_frames` are the frames with the copies, from which it was made.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Literal, NamedTuple, get_args

from augment.errors import AdapterError
from augment.files.lens_records import optics_record
from augment.files.undistorted_images import inner_pinhole, write_undistorted
from augment.output.names import folder_name
from augment.scene.cameras import Camera, Frame
from augment.scene.scene import Scene

LensChoice = Literal["undistorted", "recorded"]
UNDISTORTED_LENS: LensChoice = "undistorted"
RECORDED_LENS: LensChoice = "recorded"
LENS_MEANING = f"one of {', '.join(get_args(LensChoice))}"


def with_recorded_frames(scene: Scene, recorded_frames: tuple[Frame, ...] | None) -> Scene:
    """Return a scene with the cameras and images as recorded in place of those it was made from.

    Args:
        scene: the scene, with pinhole cameras.
        recorded_frames: frames with lenses; None to leave the scene as it is.
    """
    if recorded_frames is None:
        return scene
    return dataclasses.replace(scene, frames=recorded_frames, seen_frames=scene.frames)


def undistorted_scene(scene: Scene) -> Scene:
    """Return the scene with the undistorted images that it was made from, and their pinholes.

    A scene whose cameras have neither lens nor shutter is returned as it is.
    """
    has_lenses = any(
        not (camera.is_pinhole or camera.is_orthographic)
        for frame in scene.frames
        for camera in frame.cameras.values()
    )
    if not has_lenses or not scene.seen_frames:
        return scene
    return dataclasses.replace(scene, frames=scene.seen_frames, seen_frames=None)


def with_lenses_of(scene: Scene, recorded_frames: Sequence[Frame]) -> Scene:
    """Return a scene of pinhole cameras with lenses and images as recorded, at its own poses.

    Args:
        scene: a scene of the same frames, whose poses may have been corrected.
        recorded_frames: frames with the lenses.
    """
    recorded = {frame.index: frame for frame in recorded_frames}
    frames = []
    for frame in scene.frames:
        cameras = {
            name: dataclasses.replace(
                recorded[frame.index].cameras[name],
                camera_from_world=camera.camera_from_world,
                timestamp_ns=camera.timestamp_ns,
            )
            for name, camera in frame.cameras.items()
        }
        image_paths = recorded[frame.index].image_paths
        frames.append(dataclasses.replace(frame, cameras=cameras, image_paths=image_paths))
    return with_recorded_frames(scene, tuple(frames))


class LensFrames(NamedTuple):
    """Frames of a drive whose images were recorded through lenses.

    Attributes:
        frames: pinhole cameras and undistorted images, from which the scene is made.
        recorded_frames: lenses and images as recorded, for the scene; None if it keeps `frames`.
        notes: sentences about the lenses.
    """

    frames: tuple[Frame, ...]
    recorded_frames: tuple[Frame, ...] | None
    notes: tuple[str, ...]


def split_lenses(
    name: str, frames: Sequence[Frame], lens: LensChoice, *, published: str
) -> LensFrames:
    """Return what a scene is made from, and what it shows.

    Args:
        name: name of the scene.
        frames: frames with lenses and the images as recorded.
        lens: the option.
        published: the images in words, for the sentence that they have no lens.
    """
    if all(camera.is_pinhole for frame in frames for camera in frame.cameras.values()):
        return LensFrames(tuple(frames), None, no_lens_note(published, lens))
    pinholes, notes = pinhole_frames(name, frames)
    if lens == RECORDED_LENS:
        return LensFrames(pinholes, tuple(frames), ())
    return LensFrames(pinholes, None, notes)


def no_lens_note(images: str, lens: LensChoice) -> tuple[str, ...]:
    """Return a sentence if recorded lenses are asked for and the images are published without.

    Args:
        images: the images in words, the start of the sentence.
        lens: the option.
    """
    if lens == UNDISTORTED_LENS:
        return ()
    return (
        f"{images} show no lens distortion as they are: lens=recorded changes nothing, the cameras "
        f"are pinholes",
    )


def pinhole_frames(name: str, frames: Sequence[Frame]) -> tuple[tuple[Frame, ...], tuple[str, ...]]:
    """Return frames with pinhole cameras and undistorted copies, and sentences on the copies.

    Copies lie in the user's cache (`adapters.scene_cache.image_folder`) and are written once they
    are read. Cameras without a lens keep their images.

    Args:
        name: name of the scene.
        frames: frames with lenses and the images as recorded.

    Raises:
        AdapterError: a lens leaves no undistorted picture, or the folder cannot be written.
    """
    optics: dict[tuple[str, str], str] = {}
    cameras: dict[str, tuple[Camera, Camera]] = {}
    sources: dict[str, str] = {}
    place_of_image: dict[tuple[int, str], str] = {}
    pinhole_of_image: dict[tuple[int, str], Camera] = {}
    for frame in frames:
        for camera_name, camera in frame.cameras.items():
            if camera.lens is None and camera.shutter is None:
                continue
            if camera.lens is None:
                pinhole_of_image[frame.index, camera_name] = camera.without_lens()
                continue
            key = camera_name, _optics_text(camera)
            if key not in optics:
                number = sum(other == camera_name for other, _ in optics)
                folder = folder_name(camera_name if not number else f"{camera_name}-{number + 1}")
                optics[key] = folder
                cameras[folder] = camera, _inner_pinhole(camera)
            folder = optics[key]
            pinhole = cameras[folder][1]
            pinhole_of_image[frame.index, camera_name] = dataclasses.replace(
                pinhole,
                camera_from_world=camera.camera_from_world,
                timestamp_ns=camera.timestamp_ns,
            )
            path = frame.image_paths.get(camera_name)
            if path is None:
                continue
            place = f"{folder}/{Path(path).stem}.jpg"
            if place in sources:
                place = f"{folder}/{Path(path).stem}-{frame.index}.jpg"
            sources[place] = str(Path(path).absolute())
            place_of_image[frame.index, camera_name] = place
    image_dir = _write_folder(name, cameras, sources) if sources else None
    undistorted = tuple(
        dataclasses.replace(
            frame,
            cameras={
                camera_name: pinhole_of_image.get((frame.index, camera_name), camera)
                for camera_name, camera in frame.cameras.items()
            },
            image_paths={
                camera_name: str(image_dir / place_of_image[frame.index, camera_name])
                if image_dir is not None and (frame.index, camera_name) in place_of_image
                else path
                for camera_name, path in frame.image_paths.items()
            },
        )
        for frame in frames
    )
    return undistorted, copies_note(camera_name for camera_name, _ in optics)


def copies_note(names: Iterable[str]) -> tuple[str, ...]:
    """Return a sentence on the cameras whose images were undistorted; none without such cameras."""
    listed = ", ".join(dict.fromkeys(names))
    if not listed:
        return ()
    return (
        f"images of {listed} are without their lens distortion, in copies that cameras and weather "
        f"go with; lens=recorded keeps the lenses",
    )


def _inner_pinhole(camera: Camera) -> Camera:
    """Return the pinhole of a camera's undistorted copies."""
    try:
        return inner_pinhole(camera)
    except ValueError as error:
        raise AdapterError(
            f"camera {camera.name!r}: {error}. Check the coefficients of its lens and their order"
        ) from None


def _optics_text(camera: Camera) -> str:
    """Return the numbers of a camera that decide its undistorted copies, as text."""
    numbers = (camera.width, camera.height, *camera.intrinsics)
    return json.dumps([numbers, optics_record(camera).get("lens")])


def _write_folder(
    name: str, cameras: Mapping[str, tuple[Camera, Camera]], sources: Mapping[str, str]
) -> Path:
    """Write the description of the copies, and return their folder."""
    from adapters.scene_cache import image_folder  # which imports the list of datasets

    # Copies of another size, as an earlier version may have left them, are not taken for these.
    texts = sorted(
        f"{folder} {_optics_text(camera)} {_optics_text(pinhole)}"
        for folder, (camera, pinhole) in cameras.items()
    )
    digest = hashlib.sha256(json.dumps(texts).encode()).hexdigest()[:8]
    paths = [Path(source) for source in sources.values()]
    folder = image_folder(f"{folder_name(name)}-{digest}", paths)
    write_undistorted(folder, cameras, sources)
    return folder
