"""Training views from the recorded images of a scene's frames."""

from __future__ import annotations

import math
import re
import threading
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from tqdm import tqdm

from adapters.ego_masks import read_ego_masks
from adapters.training_views.depth_priors import DepthPriors, DepthSource, ReferenceDepth
from augment.errors import AdapterError, SceneError
from augment.files.recorded_images import ImageFault, read_scaled
from augment.memo import SceneMemo
from augment.photo.lidar_view import lidar_top_rad
from augment.photo.own_car import find_own_car_mask, moving_frames
from augment.photo.sky_matte import sky_matte
from augment.reconstruct.view import RecordedView, ViewKey
from augment.scene.cameras import Camera
from augment.scene.scene import Scene

NONE = "none"
_EVERY = re.compile(r"every-(\d{1,6})(?:st|nd|rd|th)")
CACHE_BYTES = 1 << 30
_MAX_POSITION_M = 1e6  # float32 has a resolution of 6 cm there
_SIZE_SHARE = 0.05  # by which the sides of one camera's images may differ
_SKY_SHARE = 0.9  # share of sky from which a pixel is trained to be empty
_TOP_FRAMES = 5  # frames that the LiDAR's highest view is measured in


def holdout_step(holdout: str) -> int | None:
    """Return N for "every-Nth" and None for "none"."""
    if holdout == NONE:
        return None
    match = _EVERY.fullmatch(holdout)
    step = int(match[1]) if match else 0
    if step < 2:
        raise AdapterError(
            f"holdout must be 'none' or 'every-Nth' with N >= 2, such as every-2nd or every-8th; "
            f"got {holdout!r}"
        )
    return step


class RecordedViews:
    """A `ViewSource` of a scene that was opened from recordings.

    `load` may be called from several threads.

    Every image is decoded once at the start. Unusable ones are left out and named in `problems`.

    ego_masks: bool [H, W] at the training resolution, for each camera that sees the recording car.
    There are no depth priors in it: the LiDAR looks past the car at the road behind. lidar_top_rad:
    highest elevation that the LiDAR measures; None if it is unknown.
    """

    def __init__(
        self,
        scene: Scene,
        *,
        scale: float,
        cameras: Sequence[str] | None = None,
        holdout: str = "none",
        cache_bytes: int = CACHE_BYTES,
        depth: DepthPriors = DepthPriors(),  # noqa: B008 - frozen, so sharing it is safe
        reference_depth: ReferenceDepth | None = None,
        masks_dir: Path | None = None,
    ) -> None:
        """Read the headers and pixels of all images.

        Args:
            scene: as initialised, before any optimisation. Its Gaussians decide where sky must be.
            scale: training resolution over recorded resolution, in (0, 1].
            cameras: names, all by default.
            holdout: "none" or "every-Nth": of the scene's frames the last of every N is held out.
            cache_bytes: memory for decoded images, and half as much for depth priors. Other images
                are read again.
            depth: sources of depth priors.
            reference_depth: depth by which relative maps are brought to metres without LiDAR.
            masks_dir: folder of masks of the recording car (adapters.ego_masks). By default the
                scene's own masks, or else what the images tell.
        """
        if not 0 < scale <= 1:
            raise ValueError(f"scale must be > 0 and <= 1; got {scale}")
        if scene.moved_instances:
            raise SceneError(
                f"scene {scene.name!r} has moved actors, and its images show them where they were "
                f"recorded, so nothing can be learnt from them; leave tracks out of the URI"
            )
        names = _camera_names(scene, cameras)
        step = holdout_step(holdout)
        self._scene = scene
        self._images = SceneMemo(cache_bytes)
        self._problems: list[str] = []
        self._lock = threading.Lock()
        self._cameras = self._read_all(names, scale)
        held_out = {f.index for f in scene.frames[step - 1 :: step]} if step else set()
        self.train = tuple(key for key in self._cameras if key.frame not in held_out)
        self.test = tuple(key for key in self._cameras if key.frame in held_out)
        self._check_split(holdout)
        self._depth = DepthSource(
            scene, self._cameras, depth, cache_bytes=cache_bytes // 2, reference=reference_depth
        )
        self.lidar_top_rad = self._measure_lidar_top()
        self._skies: dict[ViewKey, np.ndarray] = {}  # one bit a pixel
        self.ego_masks = self._find_ego(names, masks_dir)

    @property
    def problems(self) -> tuple[str, ...]:
        """Return a sentence for each fault that the views do without; loading may add some."""
        return (*self._problems, *self._depth.problems)

    def camera(self, key: ViewKey) -> Camera:
        try:
            return self._cameras[key]
        except KeyError:
            raise AdapterError(
                f"scene {self._scene.name!r} has no usable image of camera {key.camera!r} in "
                f"frame {key.frame}"
            ) from None

    def image(self, key: ViewKey) -> np.ndarray:
        """Return the view's image alone, uint8 [H, W, 3]. Callers must not write into it."""
        scaled = self.camera(key)
        frame = self._scene.frame(key.frame)
        path = Path(frame.image_paths[key.camera])
        try:
            read_image = partial(read_scaled, path, frame.cameras[key.camera], scaled)
            return self._images.get(key, read_image)
        except ImageFault as fault:
            raise AdapterError(
                f"camera {key.camera}, frame {key.frame}: image {path} {fault}; it could be read "
                f"when the scene was opened, leave the files as they are while they are in use"
            ) from None

    def load(self, key: ViewKey) -> RecordedView:
        camera = self.camera(key)
        rgb = self.image(key)
        with self._lock:
            sky = self._sky(key, camera, rgb)
            prior = self._depth.load(key, sky)
        ego = self._ego(camera)
        if ego is not None:
            prior = prior.select(~ego.reshape(-1)[prior.pixels])
        weight = np.ones(sky.shape, np.float32)
        return RecordedView(camera, rgb, weight, sky, prior.pixels, prior.depth_m, prior.weight)

    def own_car(self, key: ViewKey) -> np.ndarray:
        """Return the pixels of the recording car in a view, bool [H, W]."""
        camera = self.camera(key)
        mask = self._ego(camera)
        return np.zeros((camera.height, camera.width), np.bool_) if mask is None else mask

    def _ego(self, camera: Camera) -> np.ndarray | None:
        """Return the pixels of the recording car in the camera's images, bool [H, W].

        The result is None without one.
        """
        mask = self.ego_masks.get(camera.name)
        if mask is None or not _is_about(mask.shape[::-1], camera):
            return None
        if mask.shape == (camera.height, camera.width):
            return mask
        size = camera.width, camera.height
        return cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0

    def _sky(self, key: ViewKey, camera: Camera, rgb: np.ndarray) -> np.ndarray:
        size = (camera.height, camera.width)
        if key not in self._skies:
            matte = None if self.lidar_top_rad is None else sky_matte(self._scene, camera, rgb)
            mask = np.zeros(size, np.bool_) if matte is None else matte.sky_share > _SKY_SHARE
            ego = self._ego(camera)
            self._skies[key] = np.packbits(mask if ego is None else mask & ~ego)
        bits = np.unpackbits(self._skies[key], count=camera.height * camera.width)
        return bits.view(np.bool_).reshape(size)

    def _read_all(self, names: Sequence[str], scale: float) -> dict[ViewKey, Camera]:
        """Return the training camera of every view with a usable image, in order of frame and
        camera.
        """
        scene = self._scene
        expected = [
            (ViewKey(frame.index, name), frame.cameras[name], frame.image_paths.get(name))
            for frame in scene.frames
            for name in names
            if name in frame.cameras
        ]
        cameras: dict[ViewKey, Camera] = {}
        for key, full, path in tqdm(expected, desc="images", unit="image", disable=None):
            if path is None:
                continue  # the adapter that left it out has said so
            _check_camera(key, full)
            scaled = full.scaled(scale)
            try:
                self._images.put(key, read_scaled(Path(path), full, scaled))
                cameras[key] = scaled
            except ImageFault as fault:
                where = f"camera {key.camera}, frame {key.frame}"
                self._problems.append(f"{where}: image {path} {fault}; left out")
        if not cameras:
            first = f" First: {self._problems[0]}." if self._problems else ""
            raise AdapterError(
                f"scene {scene.name!r} ({scene.source}) has no usable recorded image for "
                f"{len(scene.frames)} frames of {', '.join(names) or 'no camera'} "
                f"({len(expected)} expected). A reconstruction needs recordings: open the raw "
                f"drive, such as pandaset:PATH or recording:PATH, and see that its images are in "
                f"place.{first}"
            )
        return cameras

    def _check_split(self, holdout: str) -> None:
        if not self.train:
            raise AdapterError(
                f"scene {self._scene.name!r}: holdout {holdout!r} leaves no image to learn from; "
                f"choose a larger step or 'none'"
            )
        if holdout != "none" and not self.test:
            frames = len({key.frame for key in self._cameras})
            self._problems.append(
                f"nothing is held out: {holdout} selects none of the {frames} "
                f"frame{'s' if frames > 1 else ''} with images, so quality is known on training "
                f"views only"
            )

    def _find_ego(self, names: Sequence[str], masks_dir: Path | None) -> dict[str, np.ndarray]:
        """Return each camera's mask of the recording car, without empty ones.

        Masks come from the files in masks_dir, else from the scene, else from the images."""
        masks: dict[str, np.ndarray] = {}
        sizes: dict[str, Camera] = {}
        world_from_egos = {f.index: f.world_from_ego for f in self._scene.frames}
        for name in names:
            views = [(k, c) for k, c in self._cameras.items() if k.camera == name]
            if not views:
                continue
            # Should a camera's size change, masks are for about the size it has at first.
            size = (views[0][1].width, views[0][1].height)
            views = [(k, c) for k, c in views if _is_about(size, c)]
            sizes[name] = views[0][1]
            if masks_dir is not None:
                continue
            if self._scene.ego_masks is not None:
                mask = self._scene.ego_masks.get(name)
                if mask is not None:
                    masks[name] = _resized_mask(mask, views[0][1])
                continue
            moving = [views[i] for i in moving_frames([camera for _, camera in views])]
            images = [self.image(key) for key, _ in moving]
            egos = [world_from_egos[key.frame] for key, _ in moving]
            masks[name] = find_own_car_mask([camera for _, camera in moving], images, egos)
        if masks_dir is not None:
            masks = read_ego_masks(masks_dir, sizes, known_names=self._scene.camera_names)
        return {name: mask for name, mask in masks.items() if mask.any()}

    def _measure_lidar_top(self) -> float | None:
        frames = list(dict.fromkeys(key.frame for key in self._cameras))
        sample = frames[:: max(1, -(-len(frames) // _TOP_FRAMES))]
        top = lidar_top_rad(self._scene, sample)
        if top is None:
            self._problems.append(
                "no sky masks: without LiDAR sweeps nothing tells sky from tall buildings"
            )
        return top


def _is_about(size: tuple[int, ...], camera: Camera) -> bool:
    """Return True if the camera's width and height are those of `size` within 5 %.

    Images that were undistorted one by one differ by a few pixels."""
    ratios = camera.width / size[0], camera.height / size[1]
    return all(abs(ratio - 1) <= _SIZE_SHARE for ratio in ratios)


def _resized_mask(mask: np.ndarray, camera: Camera) -> np.ndarray:
    """Return a mask at the camera's size, bool [H, W]; any part of a pixel on the car counts."""
    size = (camera.width, camera.height)
    return cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0.25


def _check_camera(key: ViewKey, camera: Camera) -> None:
    """Refuse a position that a Camera may have but no recording has."""
    where = f"camera {key.camera}, frame {key.frame}"
    position = camera.centre.tolist()
    if not all(math.isfinite(x) and abs(x) < _MAX_POSITION_M for x in position):
        raise AdapterError(
            f"{where}: its position in the scene must be finite and within {_MAX_POSITION_M:.0f} m "
            f"of the origin; got {position}. Check the pose in the dataset"
        )


def _camera_names(scene: Scene, cameras: Sequence[str] | None) -> tuple[str, ...]:
    scene_cameras = scene.camera_names
    if cameras is None:
        return scene_cameras
    unknown_cameras = sorted(set(cameras) - set(scene_cameras))
    if unknown_cameras or not cameras:
        raise AdapterError(
            f"scene {scene.name!r} has no camera {', '.join(map(repr, unknown_cameras)) or 'named'}"
            f"; it has {', '.join(scene_cameras) or 'none'}"
        )
    return tuple(name for name in scene_cameras if name in cameras)
