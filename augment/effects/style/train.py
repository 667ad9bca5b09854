"""Training of the style network, one step at a time, with the losses of
augment.effects.style.losses.

Which pictures a step sees, and how they are recoloured, follows from the seed and the step's number
alone, so a training that was stopped goes on to the same bits. Sums are split among threads, so
torch runs in THREADS of them, however many there are: in one, since what is split here is so small
that two on two busy cores took four times as long.
"""

from __future__ import annotations

import contextlib
import hashlib
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor, nn
from torch.nn import functional

from augment.effects.style.images import read_style_image
from augment.effects.style.losses import (
    FeatureExtractor,
    GaussianColors,
    Transfer,
    color_distance,
    picture_distance,
    style_loss,
    weighted_sum,
)
from augment.effects.style.network import Gscm, compose
from augment.effects.style.pairs import PairWeights, pair_losses, recolor, sample_pairs, weighted
from augment.effects.style.scene_views import (
    SceneView,
    colors_of,
    folded_pictures,
    rendered_pictures,
    views_of,
)
from augment.errors import StyleError
from augment.scene import Scene

Through = Literal["picture", "renderer"]
LEARNING_RATES = {"small": 1e-3, "b0": 1e-4}  # the paper's is B0's, which starts from ImageNet


@dataclass(frozen=True)
class StyleTrainConfig:
    """One training.

    steps: of Adam; the paper takes 300,000. learning_rate is multiplied by `decay` after each third
    of them. warm_up: share of the steps in which the cycle loss is alone. style, consistency,
    cycle: weights of L_s, L_con and L_cyc; pairs: of the sum that pair_weights make. batch:
    contents with a style each, a step; pair_batch: pairs. scene_share: of the contents, where there
    are both scenes and photos. perturbed: share of the styles that are recoloured first. colors:
    Gaussians, or pixels, whose colours are compared, an item. through: see
    augment.effects.style.scene_views. gradient_limit: a step's greatest gradient norm.

    Raises:
        ValueError: a value outside its range.
    """

    steps: int
    seed: int = 0
    learning_rate: float = LEARNING_RATES["small"]
    decay: float = 0.1
    warm_up: float = 0.1
    style: float = 1.0
    consistency: float = 10.0
    cycle: float = 10.0
    pairs: float = 1.0
    pair_weights: PairWeights = field(default_factory=PairWeights)
    batch: int = 2
    pair_batch: int = 4
    scene_share: float = 0.5
    perturbed: float = 0.5
    colors: int = 1024
    through: Through = "picture"
    gradient_limit: float = 10.0

    def __post_init__(self) -> None:
        weights = {f"pair_weights.{name}": v for name, v in vars(self.pair_weights).items()}
        values = vars(self) | weights
        losses = ("style", "consistency", "cycle", "pairs")
        for expected, is_good, names in (
            ("at least 1", lambda v: v >= 1, ("steps", "batch", "pair_batch", "colors")),
            ("between 0 and 1", lambda v: 0 <= v <= 1, ("warm_up", "scene_share", "perturbed")),
            ("finite and at least 0", lambda v: 0 <= v < math.inf, (*losses, *weights)),
            ("finite and above 0", lambda v: 0 < v < math.inf, ("learning_rate", "gradient_limit")),
            ("above 0 and at most 1", lambda v: 0 < v <= 1, ("decay",)),
            ("picture or renderer", lambda v: v in ("picture", "renderer"), ("through",)),
        ):
            for name in names:
                if not is_good(values[name]):
                    raise ValueError(f"{name} must be {expected}; got {values[name]!r}")
        if not any(values[name] for name in losses):
            raise ValueError("all losses weigh 0: nothing would be learnt")

    def learning_rate_at(self, step: int) -> float:
        """Of the step with this number, counted from 0."""
        return self.learning_rate * self.decay ** (3 * step // self.steps)

    def is_warming_up(self, step: int) -> bool:
        """Whether the cycle loss is alone in this step; never, where it weighs nothing."""
        return self.cycle > 0 and step < self.warm_up * self.steps


# ---- Views of scenes, and photographs as scenes of one Gaussian a pixel, drawn step by step ------


@dataclass(frozen=True, eq=False)
class Content:
    """A picture that styles are put on. colors: [1, N, ...], of its Gaussians or pixels. view: None
    of a photograph.
    """

    picture: Float[Tensor, "3 S S"]
    colors: GaussianColors
    view: SceneView | None = None


@dataclass(frozen=True, eq=False)
class Draw:
    """One step's contents and their styles, in about [0, 1], on the pool's device."""

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
        """The same on the device; what is drawn from it comes from the CPU's generators."""
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
    """At most `count` views of a scene, which share its colours. with_parts: see `views_of`."""
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


THREADS = 1


@dataclass(frozen=True)
class StepRecord:
    """step: how many are done now. terms: the losses that counted, before their weights."""

    step: int
    loss: float
    terms: Mapping[str, float]


def new_network(encoder: str, *, offset: bool, seed: int) -> Gscm:
    """A network as the seed begins it; torch's global generator is left as it was."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return Gscm(encoder, offset=offset)


class StyleTrainer:
    """Trains `net` in place; with pairs of the pool's pictures, where it holds at least two.

    frozen_norm: keep the statistics of batch normalisation, of an encoder that came with some.
    device: torch's name of where to compute and to keep the pool; a GPU must be the current one,
    whose kernels render. What a step draws is the same everywhere; bits are promised on "cpu".
    """

    def __init__(
        self,
        net: Gscm,
        pool: TrainingPool,
        config: StyleTrainConfig,
        features: FeatureExtractor,
        *,
        frozen_norm: bool = False,
        device: str = "cpu",
    ) -> None:
        self.net = net.to(device)
        self.pool = pool.to(device)
        self.config = config
        self.step = 0
        self._features = features.to(device)
        has_pairs = config.pairs > 0 and len(pool.views) + len(pool.photos) > 1
        self._paired = self.pool.pictures() if has_pairs else None
        self._frozen_norm = frozen_norm
        self._device = device
        self._parameters = {n: p for n, p in net.named_parameters() if p.requires_grad}
        self._adam = torch.optim.Adam(self._parameters.values(), lr=config.learning_rate)

    def run_step(self) -> StepRecord:
        """One step.

        Raises:
            StyleError: the loss is no longer a number; the network is as it was before the step.
        """
        config, step = self.config, self.step
        self._train_mode()
        with fixed_threads(), _own_generator(config.seed, step, self._device):
            try:
                terms = self._terms(step)
            except torch.linalg.LinAlgError as error:  # pyright: ignore[reportPrivateImportUsage]
                raise StyleError(
                    f"the pictures are no longer numbers in step {step + 1} ({error}): train with "
                    f"a smaller learning rate"
                ) from error
            loss = weighted_sum(terms, {name: getattr(config, name) for name in terms})
            value = float(loss.detach())
            facts = {name: float(term.detach()) for name, term in terms.items()}
            if not math.isfinite(value):
                parts = ", ".join(f"{name} {fact:.4g}" for name, fact in facts.items())
                raise StyleError(
                    f"the loss became {value} in step {step + 1} ({parts}): train with a smaller "
                    f"learning rate"
                )
            self._adam.zero_grad(set_to_none=True)
            loss.backward()
            nn.utils.clip_grad_norm_(self._parameters.values(), config.gradient_limit)
            for group in self._adam.param_groups:
                group["lr"] = config.learning_rate_at(step)
            self._adam.step()
        self.step += 1
        return StepRecord(self.step, value, facts)

    def state(self) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Copies of all arrays, and facts, from which `load_state` goes on to the same bits."""
        arrays = {f"net.{n}": _array(t) for n, t in self.net.state_dict().items()}
        for name, parameter in self._parameters.items():
            for part, value in self._adam.state.get(parameter, {}).items():
                arrays[f"adam.{name}:{part}"] = _array(value)
        return arrays, {"step": self.step}

    def load_state(self, arrays: Mapping[str, np.ndarray], facts: Mapping[str, Any]) -> None:
        """Go on from a `state` of a trainer that was made the same way.

        Raises:
            StyleError: the arrays are of another network.
        """
        own = self.net.state_dict()
        found = {n.removeprefix("net."): a for n, a in arrays.items() if n.startswith("net.")}
        if {n: tuple(a.shape) for n, a in found.items()} != {
            n: tuple(t.shape) for n, t in own.items()
        }:
            raise StyleError("the state to go on from is of another network")
        self.net.load_state_dict({n: torch.from_numpy(a.copy()) for n, a in found.items()})
        for name, parameter in self._parameters.items():
            start = f"adam.{name}:"
            parts = {n.removeprefix(start): a for n, a in arrays.items() if n.startswith(start)}
            if parts:
                self._adam.state[parameter] = {
                    part: torch.from_numpy(a.copy()).to("cpu" if part == "step" else self._device)
                    for part, a in parts.items()
                }
        self.step = int(facts["step"])

    def _terms(self, step: int) -> dict[str, Tensor]:
        config = self.config
        draw = self.pool.draw(
            generator_for(config.seed, step, "pictures"),
            config.batch,
            scene_share=config.scene_share,
            perturbed=config.perturbed,
            colors=config.colors,
        )
        warming_up = config.is_warming_up(step)
        terms = paper_terms(
            self.net, draw, self._features, only_cycle=warming_up, through=config.through
        )
        if self._paired is not None and not warming_up:
            generator = generator_for(config.seed, step, "pairs")
            size_px = self.pool.size_px
            pairs = sample_pairs(self._paired, generator, config.pair_batch, size_px=size_px)
            terms["pairs"] = weighted(pair_losses(self.net, pairs), config.pair_weights)
        return terms

    def _train_mode(self) -> None:
        self.net.train()
        if self._frozen_norm:
            for module in self.net.modules():
                if isinstance(module, nn.modules.batchnorm._BatchNorm):
                    module.eval()


def transfer_maps(
    net: Gscm, draw: Draw, *, through: Through, only_cycle: bool = False
) -> tuple[Transfer, Tensor | None]:
    """The maps of every item (augment.effects.style.losses), and R(Y_s); of the cycle alone where
    asked."""
    f_c, f_s = net.encode(torch.cat([draw.pictures, draw.styles.clamp(0, 1)]))
    count = len(draw.pictures)
    content = net.content_map(f_c[:count])
    cycled = compose(net.style_map(f_s[:count]), content)
    if only_cycle:
        return Transfer(content, content, content, cycled), None
    styled = compose(net.style_map(f_s[count:]), content)
    rendered = _pictures(draw, styled, through)
    # No gradient passes a picture's moments, so a map that Z_s follows would not be seen to do
    # so, and L_con would bend Y_s instead (by 2 dB of `same`): it teaches the way back alone.
    back, _ = net.encode(rendered.detach().clamp(0, 1))  # an encoder's pictures end at 0 and 1
    returned = compose(net.content_map(back), styled.detach())
    return Transfer(content, styled, returned, cycled), rendered


def paper_terms(
    net: Gscm,
    draw: Draw,
    features: FeatureExtractor,
    *,
    only_cycle: bool = False,
    through: Through = "picture",
) -> dict[str, Tensor]:
    """L_cyc, and unless it is to be alone L_con and L_s, of one step's items."""
    maps, rendered = transfer_maps(net, draw, through=through, only_cycle=only_cycle)
    cycled = _pictures(draw, maps.cycled, through)
    terms = {
        "cycle": color_distance(draw.colors.mapped(maps.cycled), draw.colors)
        + picture_distance(cycled, draw.pictures)
    }
    if rendered is None:
        return terms
    colors = draw.colors.mapped(maps.content), draw.colors.mapped(maps.returned)
    pictures = _pictures(draw, maps.content, through), _pictures(draw, maps.returned, through)
    terms["consistency"] = color_distance(*colors) + picture_distance(*pictures)
    terms["style"] = style_loss(features(rendered), features(draw.styles))
    return terms


def _pictures(draw: Draw, maps: Tensor, through: Through) -> Tensor:
    """The items' renders under their maps: R(.) of the paper."""
    folded = folded_pictures(draw.pictures, maps)
    if through == "picture":
        return folded
    pictures = list(folded)
    for number, content in enumerate(draw.contents):
        if content.view is not None:  # a photograph has no other way
            pictures[number] = rendered_pictures([content.view], maps[number : number + 1])[0]
    return torch.stack(pictures)


def _array(tensor: Tensor) -> np.ndarray:
    return tensor.detach().cpu().numpy().copy()


@contextlib.contextmanager
def fixed_threads() -> Iterator[None]:
    """torch computes in THREADS threads while this is entered."""
    before = torch.get_num_threads()
    torch.set_num_threads(THREADS)
    try:
        yield
    finally:
        torch.set_num_threads(before)


@contextlib.contextmanager
def _own_generator(seed: int, step: int, device: str) -> Iterator[None]:
    """torch's global generators, which encoders may use, as the step has them; then as before."""
    gpus = [torch.device(device)] if device.startswith("cuda") else []
    with torch.random.fork_rng(devices=gpus):
        torch.manual_seed(generator_for(seed, step, "network").initial_seed())
        yield


# ---- Photographs to train on, and to score with --------------------------------------------------

SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".webp", ".bmp")
MIN_TO_HOLD_OUT = 5  # of fewer photos none is spared


@dataclass(frozen=True, eq=False)
class Photos:
    """Photographs as squares. train, held_out: uint8 [P, 3, S, S], RGB. problems: a sentence for
    each file that could not be read.
    """

    train: UInt8[Tensor, "P 3 S S"]
    held_out: UInt8[Tensor, "Q 3 S S"]
    problems: tuple[str, ...] = ()


def read_photos(paths: Sequence[Path], size_px: int, *, holdout: int) -> Photos:
    """The images of files and folders, searched through, squeezed to size_px x size_px.

    holdout: every so many of them, in order of their paths, is kept apart; 0 for none.

    Raises:
        StyleError: no such file or folder, one without images, or no image that can be read.
    """
    files = _find(paths)
    squares: list[np.ndarray] = []
    problems: list[str] = []
    for file in files:
        try:
            rgb = read_style_image(file).rgb
        except StyleError as error:
            problems.append(f"left out: {error}")
            continue
        small = cv2.resize(rgb, (size_px, size_px), interpolation=cv2.INTER_AREA)
        squares.append((small.clip(0, 1) * 255).round().astype(np.uint8).transpose(2, 0, 1))
    if problems:
        problems.append(f"{len(problems)} of {len(files)} images were left out")
    if files and not squares:
        raise StyleError(f"none of {len(files)} images can be read; the first: {problems[0]}")
    if not squares:
        empty = torch.zeros(0, 3, size_px, size_px, dtype=torch.uint8)
        return Photos(empty, empty)
    pixels = torch.from_numpy(np.stack(squares))
    apart = torch.zeros(len(pixels), dtype=torch.bool)
    if holdout and len(pixels) >= MIN_TO_HOLD_OUT:
        apart[holdout - 1 :: holdout] = True
    return Photos(pixels[~apart], pixels[apart], tuple(problems))


def _find(paths: Sequence[Path]) -> list[Path]:
    found: dict[Path, None] = {}
    for path in paths:
        if path.is_file():
            found[path] = None
            continue
        if not path.is_dir():
            raise StyleError(f"photos: there is no file or folder {path}")
        inside = sorted(p for p in path.rglob("*") if p.suffix.lower() in SUFFIXES and p.is_file())
        if not inside:
            raise StyleError(
                f"photos: {path} holds no images ({', '.join(SUFFIXES)}), nor do folders in it"
            )
        found.update(dict.fromkeys(inside))
    return list(found)
