"""The dataset that renders a variant of a suite when a sample is asked for.

Nothing is stored. Pixels, seeds and bytes are those of the files that `climategs suite` writes, and
`check` compares them with the hashes of a `suite.json`.
"""

from __future__ import annotations

import hashlib
from bisect import bisect_right
from collections.abc import Mapping, Sequence
from itertools import accumulate, groupby
from typing import Any

from torch.utils.data import Dataset

from augment.dataset.live import SceneDataset
from augment.dataset.samples import check_index
from augment.errors import OutputError
from augment.output.layout import item_paths
from augment.scene.scene import Scene
from augment.suite.suite_file import SuiteFile
from recipes.job import scaled_recipe
from recipes.schema import parse_frames
from recipes.suite import QUARTER_ENDING, QUARTER_FRAMES, SuiteVariant, load_suite


class SuiteDataset(Dataset):
    """Samples of one variant of a suite in one or more scenes, rendered on the fly.

    Samples are those of `augment.dataset.live.SceneDataset`, scene after scene.

    Args:
        scenes: open scenes. All of them stay in memory.
        variant: name of the variant, such as `fog-3`, or `clean-0`.
        suite: name of the suite, or of its quarter.
        frames: frame numbers, as in a recipe job: `all`, `0,5,9`, `0:20:2`, `::4`.
        cameras: names of the cameras; None for all.
        scale: resolution over that of the suite's definition.
        changes: fields of `render` and `output` that differ from the definition, by dotted path.
        options: further options of `SceneDataset`, for all scenes.

    Raises:
        RecipeError: there is no such suite or variant, or a change is not allowed.
        SceneError: an unknown frame or camera.
        ValueError: two scenes have the same name, there is no scene, or a quarter has other frames.
    """

    def __init__(
        self,
        scenes: Sequence[Scene],
        variant: str,
        *,
        suite: str = "weather-c-v1",
        frames: str = "all",
        cameras: Sequence[str] | None = None,
        scale: float = 1.0,
        changes: Mapping[str, object] | None = None,
        **options: Any,
    ) -> None:
        names = [scene.name for scene in scenes]
        if not scenes or len(set(names)) < len(names):
            raise ValueError(f"scenes must be one or more, each of another name; got {names}")
        if suite.endswith(QUARTER_ENDING):
            if frames != "all":
                raise ValueError(f"{suite} has the frames {QUARTER_FRAMES}; got frames={frames!r}")
            frames = QUARTER_FRAMES
        self.suite = suite
        self.variant = SuiteVariant.parse(variant)
        definition = load_suite(suite)
        pattern = parse_frames(frames)
        self.scene_datasets = [
            SceneDataset(
                scene,
                scaled_recipe(definition.recipe(self.variant, scene.name, changes), scale),
                frames=pattern.select([frame.index for frame in scene.frames], clip=True),
                cameras=cameras,
                **options,
            )
            for scene in scenes
        ]
        self._ends = list(accumulate(len(dataset) for dataset in self.scene_datasets))

    def __len__(self) -> int:
        return self._ends[-1]

    def __getitem__(self, index: int) -> Any:
        return self.__getitems__([index])[0]

    def __getitems__(self, indices: Sequence[int]) -> list[Any]:
        """Return the samples of a batch; images of one scene in a row are rendered together."""
        places = [self._place(index) for index in indices]
        samples: list[Any] = []
        for dataset, group in groupby(places, key=lambda place: place[0]):
            samples += dataset.__getitems__([number for _, number in group])
        return samples

    def image_path(self, index: int) -> str:
        """Return the path that the image of a sample has in an output of the suite."""
        dataset, number = self._place(index)
        frame, camera = dataset.images[number]
        path = item_paths(dataset.scene.name, dataset.recipe, camera, frame)["image"]
        assert path is not None, "every image has a path"
        return path

    def image_bytes(self, index: int) -> bytes:
        """Return the bytes of the image file of a sample."""
        dataset, number = self._place(index)
        return dataset.image_bytes(number)

    def check(self, index: int, suite_file: SuiteFile) -> None:
        """Compare the image of a sample with the hash that a `suite.json` states.

        Raises:
            OutputError: The suite is another one, has no such image, or an image of other bytes.
        """
        path = self.image_path(index)
        stated_hash = suite_file.files.get(path)
        if suite_file.suite != self.suite or stated_hash is None:
            raise OutputError(
                f"the suite.json is of {suite_file.suite}, and has "
                f"{'no ' if stated_hash is None else ''}image {path}; this dataset renders "
                f"{self.suite}: give it the same suite, scenes, frames and cameras"
            )
        rendered_hash = hashlib.sha256(self.image_bytes(index)).hexdigest()
        if rendered_hash != stated_hash:
            raise OutputError(
                f"{path} is rendered with other bytes here: SHA-256 {rendered_hash}, and "
                f"suite.json states {stated_hash}. Scale, changes, backend "
                f"({', '.join(suite_file.backends)}), version ({suite_file.code_version}) and the "
                f"scene's files must be the same"
            )

    def _place(self, index: int) -> tuple[SceneDataset, int]:
        """Return the scene's dataset of a sample, and the sample's number in it."""
        index = check_index(index, len(self))
        number = bisect_right(self._ends, index)
        dataset = self.scene_datasets[number]
        return dataset, index - (self._ends[number] - len(dataset))
