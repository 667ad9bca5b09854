"""The dataset that renders a scene under one recipe when a sample is asked for."""

from __future__ import annotations

import os
from collections.abc import Callable, Collection, Iterator, Sequence
from typing import Any

import numpy as np
import torch
from torch.utils.data import Dataset

from augment.dataset.samples import (
    BoxFrame,
    ImageType,
    Labels,
    Sample,
    SampleOptions,
    check_index,
    make_sample,
)
from augment.effects import JobContext, precompute_effects
from augment.errors import BackendUnavailable
from augment.memo import memo_of
from augment.output.calibration import camera_record
from augment.output.codecs import decode_image, encode_image, quantise_depth
from augment.output.layout import path_kinds, variant_name
from augment.photo.recorded_base import check_photos
from augment.render.backends import choose_backend
from augment.render.buffers import CUDA
from augment.scene.box_estimates import evidence_of
from augment.scene.cameras import Camera, Frame
from augment.scene.scene import Scene
from augment.scene.scene_index import SceneIndex, select_frames
from augment.scene.scene_times import scene_times
from augment.view.box_labels import label_view, uses_boxes
from augment.view.quality import resolve_quality
from augment.view.render_view import render_views
from augment.view.results import Renderer, ViewResult, check_view
from recipes.files import with_digest
from recipes.schema import Recipe

_FORKED = (
    "backend 'cuda' cannot render in a forked process, which the GPU does not answer: give the "
    "DataLoader num_workers=0 or multiprocessing_context='spawn', or take backend 'cpu'"
)


class SceneDataset(Dataset):
    """The samples that `WeatherDataset` would read after a job, without writing anything.

    The pixels are those of the files: depth is in steps of 1/256 m, and where the recipe writes
    JPEG the image passes through JPEG in memory. `paths` holds only None.

    Data that all images share (where snow can lie, the maps of a style) is computed here, once for
    all samples and worker processes. So are the settings of a recipe whose quality has still to
    choose them: `recipe` has them in numbers.

    Args:
        scene: an open scene.
        recipe: the weather and the outputs.
        frames: numbers of the frames to keep; None for all.
        cameras: names of the cameras to keep; None for all.
        backend: as in `rasterize`; "auto" never takes a GPU, which processes that a DataLoader
            forks could not use. "cuda" is for samples of this process, or of workers that are
            started afresh (`spawn`).
        image_type: as for `WeatherDataset`.
        renderer: renders a view; None takes `augment.view.render_view.render_view`.
        load: as for `WeatherDataset`; a live scene passes no sweeps on.
        box_frame: as for `WeatherDataset`.
        transform: as for `WeatherDataset`.

    Raises:
        SceneError: an unknown frame or camera, or the scene cannot have the recipe's snow or base.
        RecipeError, StyleError: a file of the recipe's style cannot be used.
        BackendUnavailable: the backend.
        ValueError: the backend, or an unknown option.
    """

    def __init__(
        self,
        scene: Scene,
        recipe: Recipe,
        *,
        frames: Sequence[int] | None = None,
        cameras: Sequence[str] | None = None,
        backend: str = "auto",
        image_type: ImageType = "float32",
        renderer: Renderer | None = None,
        load: Collection[str] | None = None,
        box_frame: BoxFrame = "world",
        transform: Callable[[Sample], Any] | None = None,
    ) -> None:
        self.options = SampleOptions.create(image_type, load, box_frame)
        if load is not None and "lidar" in load:
            raise ValueError(
                "load must not have 'lidar' for a live scene: run a job with output: {lidar: true} "
                "and read it with WeatherDataset"
            )
        self.scene = scene
        self.transform = transform
        self._backend = choose_backend(backend, scene, gpu=False) if renderer is None else backend
        self._process = os.getpid()
        quality = resolve_quality(
            with_digest(recipe), scene, backend=self._backend, renderer=renderer
        )
        self.recipe = quality.recipe
        self._renderer = renderer
        self._index = SceneIndex.of(scene)
        selection = select_frames(self._index, frames, cameras)
        check_photos([self.recipe], scene.name, selection)
        self._items = [(frame, name) for frame, names in selection for name in names]
        precompute_effects(JobContext(scene, [self.recipe], backend=self._backend))
        self._memo = memo_of(scene.as_recorded).shared()

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Restore the state; fill the memo of the scene, which is a new object in this process."""
        self.__dict__.update(state)
        self._process = os.getpid()
        memo_of(self.scene.as_recorded).take_shared(self._memo)

    def __len__(self) -> int:
        return len(self._items)

    def __getitem__(self, index: int) -> Any:
        return self.__getitems__([index])[0]

    def __getitems__(self, indices: Sequence[int]) -> list[Any]:
        """Return the samples of a batch, rendered together; a DataLoader calls this method."""
        items = [self._items[check_index(index, len(self))] for index in indices]
        views = self._views([frame.cameras[name] for frame, name in items])
        transform = self.transform or (lambda sample: sample)
        return [
            transform(self._sample(frame, name, view))
            for (frame, name), view in zip(items, views, strict=True)
        ]

    @property
    def images(self) -> list[tuple[int, str]]:
        """Return the frame and the camera of every sample."""
        return [(frame.index, name) for frame, name in self._items]

    def image_bytes(self, index: int) -> bytes:
        """Return the bytes of the image file that a job would write for a sample."""
        frame, name = self._items[check_index(index, len(self))]
        view = next(iter(self._views([frame.cameras[name]])))
        return encode_image(view.rgb, self.recipe.output)

    def _views(self, cameras: Sequence[Camera]) -> Iterator[Any]:
        """Return the views of some cameras, rendered as they are asked for."""
        if self._backend == CUDA and self._process != os.getpid():  # not unpickled: forked
            raise BackendUnavailable(_FORKED)
        if self._renderer is None:
            return render_views(self.scene, cameras, self.recipe, backend=self._backend)
        options = {"backend": self._backend}
        return (self._renderer(self.scene, camera, self.recipe, **options) for camera in cameras)

    def _sample(self, frame: Frame, name: str, view: ViewResult) -> Sample:
        """Return the sample of one view."""
        recipe = self.recipe
        origin_m = self._index.world_origin_m
        camera = frame.cameras[name].scaled(recipe.render.scale)
        check_view(view, camera, recipe)
        view, labels = self._label(frame, camera, view)
        weather = recipe.at(scene_times(self.scene), camera.timestamp_ns)
        world_from_ego = frame.world_from_ego.clone()
        world_from_ego[:3, 3] += torch.from_numpy(origin_m)
        return make_sample(
            options=self.options,
            images=self._images(view),
            camera=camera_record(camera, origin_m),
            world_from_ego=world_from_ego,
            labels=labels,
            metadata={
                "weather": {n: v for n, v in weather.columns().items() if isinstance(v, float)},
                "paths": dict.fromkeys(path_kinds()),
                "scene": self.scene.name,
                "variant": variant_name(recipe),
                "frame": frame.index,
                "recipe_hash": recipe.hash,
                "surface": recipe.output.surface,
            },
        )

    def _images(self, view: ViewResult) -> dict[str, np.ndarray]:
        """Return the images of a view that samples hold, with the pixels that files would have."""
        output = self.recipe.output
        images = {"semantic": view.semantic, "instance": view.instance, **view.masks}
        if "image" in self.options.load:
            is_exact = output.image == "png"
            images["image"] = view.rgb if is_exact else decode_image(encode_image(view.rgb, output))
        if view.depth_m is not None:
            images["depth"] = quantise_depth(view.depth_m)
        return {k: v for k, v in images.items() if k in self.options.load and v is not None}

    def _label(self, frame: Frame, camera: Camera, view: ViewResult) -> tuple[ViewResult, Labels]:
        """Return the view with the frame's boxes in its instance image, and the frame's labels.

        The labels are those that the files of a job would hold.

        Args:
            frame: the frame.
            camera: the camera that a job would write.
            view: the rendered view.
        """
        load = self.options.load
        recipe = self.recipe
        index = self._index
        requested = uses_boxes(recipe) and ("boxes" in load or "instance" in load)
        if not requested or frame.index not in index.labelled_frames:
            return view, Labels()
        boxes = self.scene.boxes(frame.index)
        view, measured = label_view(
            boxes,
            index.instances,
            index.world_origin_m,
            camera,
            view,
            recipe,
            evidence=lambda: evidence_of(self.scene, frame.index),
        )
        if not (recipe.output.labels and "boxes" in load):
            return view, Labels()
        return view, Labels(boxes, measured, instances=index.instances.numbers_of(boxes.track_ids))
