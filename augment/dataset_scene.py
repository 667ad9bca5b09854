"""A PyTorch dataset that renders a scene under one recipe when a sample is asked for."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from torch.utils.data import Dataset

from augment.batch.backends import choose_backend
from augment.batch.box_weather import measure_boxes
from augment.batch.calibration import camera_record
from augment.batch.encode import decode_image, encode_image, quantise_depth
from augment.batch.layout import PATH_KINDS, variant_name
from augment.batch.runner import Renderer, default_renderer
from augment.batch.selection import SceneIndex, select_frames
from augment.batch.snow_beds import find_bed, remember, snow_to_lay
from augment.batch.style_maps import store_maps
from augment.batch.writer import check_view
from augment.dataset_samples import ImageType, Pixels, make_sample
from augment.scene import Scene
from recipes.files import with_digest
from recipes.schema import Recipe


class SceneDataset(Dataset):
    """The samples that `WeatherDataset` would read after a job, without writing anything.

    The pixels are those of the files: depth is in steps of 1/256 m, and where the recipe writes
    JPEG the image passes through JPEG in memory. `paths` holds only None.

    Where the recipe's snow can lie and which maps its style takes are found here, once for all
    samples and worker processes.

    scene: an open scene. frames, cameras: what to keep, None for all. backend: as in `rasterize`.
    renderer: `augment.apply.render_view` if None.

    Raises:
        SceneError: an unknown frame or camera, or the scene cannot have the recipe's snow.
        RecipeError, StyleError: a file of the recipe's style cannot be used.
        BackendUnavailable, ValueError: the backend.
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
    ) -> None:
        if image_type not in ("float32", "uint8"):
            raise ValueError(f"image_type must be 'float32' or 'uint8'; got {image_type!r}")
        self.scene, self.recipe = scene, with_digest(recipe)
        self.image_type: ImageType = image_type
        self._backend = choose_backend(backend, scene) if renderer is None else backend
        self._renderer = renderer or default_renderer()
        self._index = SceneIndex.of(scene)
        selection = select_frames(self._index, frames, cameras)
        self._items = [(frame, name) for frame, names in selection for name in names]

        snow = snow_to_lay(recipe)
        self._bed = None if snow is None else find_bed(scene, snow)
        self._maps = store_maps(scene, [self.recipe])

    def __setstate__(self, state: dict[str, Any]) -> None:
        """In another process the scene is another object, which knows of no bed and no maps yet."""
        self.__dict__.update(state)
        snow = snow_to_lay(self.recipe)
        if snow is not None and self._bed is not None:
            remember(self.scene, snow, self._bed)
        for maps in self._maps:
            maps.take_over(self.scene)

    def __len__(self) -> int:
        return len(self._items)

    def __getitem__(self, index: int) -> dict[str, Any]:
        if not -len(self) <= index < len(self):
            raise IndexError(f"sample {index} of a dataset of {len(self)}")
        frame, name = self._items[index]
        camera, recipe = frame.cameras[name], self.recipe
        view = self._renderer(self.scene, camera, recipe, backend=self._backend)
        written = camera.scaled(recipe.render.scale)
        check_view(view, written, recipe)
        rgb = view.rgb
        if recipe.output.image != "png":
            rgb = decode_image(encode_image(rgb, recipe.output))
        has_labels = recipe.output.labels and frame.index in self._index.labelled
        boxes = self.scene.boxes(frame.index) if has_labels else None
        origin_m = self._index.world_origin_m
        return make_sample(
            pixels=Pixels(
                rgb,
                None if view.depth_m is None else quantise_depth(view.depth_m),
                view.semantic,
                view.instance,
                view.water,
                view.snow,
            ),
            image_type=self.image_type,
            camera=camera_record(written, origin_m),
            boxes=boxes,
            box_weather={} if boxes is None else measure_boxes(boxes, origin_m, written, view),
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
