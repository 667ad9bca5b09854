"""What the style network is trained on: views of scenes and photographs, drawn step by step.

A photograph is taken for a scene of one Gaussian a pixel, so that the same losses hold for it.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, UInt8
from torch import Tensor
from torch.nn import functional

from augment.scene import Scene
from augment.style.losses import GaussianColors
from augment.style.scene_views import SceneView, colors_of, views_of

Recolor = Callable[[Tensor, torch.Generator], Tensor]  # [B, 3, H, W] in [0, 1] to the same


@dataclass(frozen=True, eq=False)
class Content:
    """A picture that styles are put on. picture: float32 [3, S, S]. colors: [1, N, ...], of its
    Gaussians or pixels. view: None of a photograph.
    """

    picture: Float[Tensor, "3 S S"]
    colors: GaussianColors
    view: SceneView | None = None


@dataclass(frozen=True, eq=False)
class Draw:
    """One step's contents and, item by item, their styles, float32 [B, 3, S, S] in about [0, 1];
    all on the pool's device.
    """

    contents: tuple[Content, ...]
    pictures: Float[Tensor, "B 3 S S"]
    colors: GaussianColors
    styles: Float[Tensor, "B 3 S S"]


@dataclass(frozen=True, eq=False)
class TrainingPool:
    """views: of scenes. photos: uint8 [P, 3, S, S], of the same size; P may be 0.

    Raises:
        ValueError: there is nothing in it.
    """

    views: tuple[Content, ...]
    photos: UInt8[Tensor, "P 3 S S"]

    def __post_init__(self) -> None:
        if not self.views and not len(self.photos):
            raise ValueError("a training needs views of scenes, or photos; got neither")

    @property
    def size_px(self) -> int:
        return self.views[0].picture.shape[1] if self.views else self.photos.shape[2]

    def to(self, device: str | torch.device) -> TrainingPool:
        """The same on the device, Gaussians too, so that a step copies nothing but the few numbers
        that it draws: those come from the CPU's generators wherever pictures lie.
        """
        moved: dict[int, GaussianColors] = {}  # views of a scene share its colours

        def there(content: Content) -> Content:
            colors = content.colors
            if id(colors) not in moved:
                own = GaussianColors(colors.base.to(device), colors.bands.to(device))
                moved[id(colors)] = own
            view = None if content.view is None else content.view.to(device)
            return Content(content.picture.to(device), moved[id(colors)], view)

        return TrainingPool(tuple(map(there, self.views)), self.photos.to(device))

    def pictures(self) -> Float[Tensor, "P 3 S S"]:
        """Of views, then photos, float32."""
        return torch.stack([self._picture(number) for number in range(self._count)]).clamp(0, 1)

    def draw(
        self,
        generator: torch.Generator,
        batch: int,
        *,
        scene_share: float,
        perturbed: float,
        colors: int,
        recolor: Recolor,
    ) -> Draw:
        """Contents and styles of one step; the same for the same state of the generator.

        A style is another picture than its content; where there is only one, it is recoloured.
        """
        contents: list[Content] = []
        styles: list[Tensor] = []
        for _ in range(batch):
            wants_view, wants_recolor = torch.rand(2, generator=generator).tolist()
            is_view = bool(self.views) and (not len(self.photos) or wants_view < scene_share)
            own = _integer(len(self.views) if is_view else len(self.photos), generator)
            own += 0 if is_view else len(self.views)
            other = _integer(max(self._count - 1, 1), generator)
            other = (other + (other >= own)) % self._count
            contents.append(self._content(own))
            style = self._picture(other)[None]
            if wants_recolor < perturbed or other == own:
                style = recolor(style, generator)
            styles.append(style[0])
        return Draw(
            tuple(contents),
            torch.stack([content.picture for content in contents]),
            stacked([_sample(content.colors, colors, generator) for content in contents]),
            torch.stack(styles),
        )

    @property
    def _count(self) -> int:
        return len(self.views) + len(self.photos)

    def _content(self, number: int) -> Content:
        if number < len(self.views):
            return self.views[number]
        picture = self._picture(number)
        pixels = picture.flatten(1).T[None]
        return Content(picture, GaussianColors(pixels, pixels.new_zeros(1, pixels.shape[1], 0, 3)))

    def _picture(self, number: int) -> Tensor:
        if number < len(self.views):
            return self.views[number].picture
        return self.photos[number - len(self.views)].float() / 255


def scene_contents(
    scene: Scene, count: int, size_px: int, *, with_parts: bool, seed: int
) -> tuple[Content, ...]:
    """At most `count` views of a scene, which share its colours."""
    colors = colors_of(scene, seed=seed)
    views = views_of(scene, count, size_px, with_parts=with_parts)
    return tuple(Content(view.picture, colors, view) for view in views)


def stacked(colors: Sequence[GaussianColors]) -> GaussianColors:
    """Items of one number of Gaussians as a batch; bands that one lacks are 0."""
    most = max(c.bands.shape[2] for c in colors)
    return GaussianColors(
        torch.cat([c.base for c in colors]),
        torch.cat([functional.pad(c.bands, (0, 0, 0, most - c.bands.shape[2])) for c in colors]),
    )


def generator_for(seed: int, step: int, use: str) -> torch.Generator:
    """A generator of one step and one use, so that none has a state to keep between steps."""
    digest = hashlib.sha256(f"climategs style training 1, {seed}, {step}, {use}".encode()).digest()
    return torch.Generator().manual_seed(int.from_bytes(digest[:7], "big"))


def _sample(colors: GaussianColors, count: int, generator: torch.Generator) -> GaussianColors:
    index = torch.randint(colors.base.shape[1], (count,), generator=generator)
    index = index.to(colors.base.device)
    return GaussianColors(colors.base[:, index], colors.bands[:, index])


def _integer(below: int, generator: torch.Generator) -> int:
    return int(torch.randint(below, (1,), generator=generator))
