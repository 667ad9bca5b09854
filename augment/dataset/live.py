"""A PyTorch dataset that renders a scene under one recipe when a sample is asked for."""

from __future__ import annotations

import os
from collections.abc import Callable, Collection, Sequence
from typing import Any

import torch
from torch.utils.data import Dataset

from augment.cameras import Camera, Frame
from augment.dataset.samples import (
    BUFFERS,
    DEFAULT_LOAD,
    BoxFrame,
    ImageType,
    Labels,
    Pixels,
    SampleOptions,
    make_sample,
)
from augment.errors import BackendUnavailable
from augment.jobs.backends import choose_backend
from augment.jobs.box_tables import View
from augment.jobs.files import (
    SceneIndex,
    camera_record,
    check_view,
    decode_image,
    encode_image,
    label_view,
    quantise_depth,
    select_frames,
    uses_boxes,
)
from augment.jobs.layout import PATH_KINDS, variant_name
from augment.jobs.prepare import find_bed, remember, snow_to_lay, store_maps
from augment.jobs.quality import resolve_quality
from augment.jobs.worker import Renderer, default_renderer
from augment.render.buffers import CUDA
from augment.scene import Scene
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

    Where the recipe's snow can lie and which maps its style takes are found here, once for all
    samples and worker processes. So are the settings of a recipe whose quality has still to choose
    them: `recipe` has them in numbers.

    scene: an open scene. frames, cameras: what to keep, None for all. backend: as in `rasterize`;
    "auto" never takes a GPU, which processes that a DataLoader forks could not use. "cuda" is for
    samples of this process, or of workers that are started afresh (`spawn`).
    renderer: `augment.views.render_view` if None. load, box_frame, transform: as for
    `WeatherDataset`; a live scene passes no sweeps on.

    Raises:
        SceneError: an unknown frame or camera, or the scene cannot have the recipe's snow.
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
        load: Collection[str] = DEFAULT_LOAD,
        box_frame: BoxFrame = "world",
        transform: Callable[[dict[str, Any]], Any] | None = None,
    ) -> None:
        self.options = SampleOptions.checked(image_type, load, box_frame)
        if "lidar" in load:
            raise ValueError(
                "load must not have 'lidar' for a live scene: run a job with output: {lidar: true} "
                "and read it with WeatherDataset"
            )
        self.scene, self.transform = scene, transform
        self._backend = backend
        if renderer is None:
            self._backend = choose_backend(backend, scene, gpu=False)
        self._process = os.getpid()
        recipe = with_digest(recipe)
        self.recipe = resolve_quality(
            recipe, scene, backend=self._backend, renderer=renderer
        ).recipe
        self._renderer = renderer or default_renderer()
        self._index = SceneIndex.of(scene)
        selection = select_frames(self._index, frames, cameras)
        self._items = [(frame, name) for frame, names in selection for name in names]

        snow = snow_to_lay(self.recipe)
        self._bed = None if snow is None else find_bed(scene, snow, backend=self._backend)
        self._maps = store_maps(scene, [self.recipe])

    def __setstate__(self, state: dict[str, Any]) -> None:
        """In another process the scene is another object, which knows of no bed and no maps yet."""
        self.__dict__.update(state)
        self._process = os.getpid()
        snow = snow_to_lay(self.recipe)
        if snow is not None and self._bed is not None:
            remember(self.scene, snow, self._bed)
        for maps in self._maps:
            maps.take_over(self.scene)

    def __len__(self) -> int:
        return len(self._items)

    def __getitem__(self, index: int) -> Any:
        if not -len(self) <= index < len(self):
            raise IndexError(f"sample {index} of a dataset of {len(self)}")
        sample = self._render(*self._items[index])
        return sample if self.transform is None else self.transform(sample)

    def _render(self, frame: Frame, name: str) -> dict[str, Any]:
        camera, recipe, load = frame.cameras[name], self.recipe, self.options.load
        if self._backend == CUDA and self._process != os.getpid():  # not unpickled: forked
            raise BackendUnavailable(_FORKED)
        view = self._renderer(self.scene, camera, recipe, backend=self._backend)
        written = camera.scaled(recipe.render.scale)
        check_view(view, written, recipe)
        origin_m = self._index.world_origin_m
        view, labels = self._labelled(frame, written, view)
        world_from_ego = frame.world_from_ego.clone()
        world_from_ego[:3, 3] += torch.from_numpy(origin_m)
        return make_sample(
            options=self.options,
            pixels=self._pixels(view),
            camera=camera_record(written, origin_m),
            world_from_ego=world_from_ego,
            labels=labels if "boxes" in load else Labels(),
            weather=recipe.weather_numbers(),
            paths=dict.fromkeys(PATH_KINDS),
            names={
                "scene": self.scene.name,
                "variant": variant_name(recipe),
                "frame": frame.index,
                "recipe_hash": recipe.hash,
                "surface": recipe.output.surface,
            },
        )

    def _pixels(self, view: View) -> Pixels:
        """What of a view the samples hold, as files would."""
        load, output, rgb = self.options.load, self.recipe.output, None
        if "image" in load:
            rgb = view.rgb
            if output.image != "png":
                rgb = decode_image(encode_image(rgb, output))
        depth = None if view.depth_m is None else quantise_depth(view.depth_m)
        buffers = (depth, view.semantic, view.instance, view.water, view.snow)
        return Pixels(
            rgb, *(b if kind in load else None for kind, b in zip(BUFFERS, buffers, strict=True))
        )

    def _labelled(self, frame: Frame, camera: Camera, view: View) -> tuple[View, Labels]:
        """A view with the boxes of its frame, and these as the files of a job would have them.
        camera: as written.
        """
        load, recipe, index = self.options.load, self.recipe, self._index
        requested = "boxes" in load or "instance" in load
        if not (requested and uses_boxes(recipe) and frame.index in index.labelled):
            return view, Labels()
        boxes = self.scene.boxes(frame.index)
        view, measured = label_view(
            boxes, index.instances, index.world_origin_m, camera, view, recipe
        )
        if not recipe.output.labels:
            return view, Labels()
        return view, Labels(boxes, measured, instances=index.instances.of(boxes.track_ids))
