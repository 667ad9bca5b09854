"""Training of the style network, one step at a time.

Contents are photographs and views of scenes. A map (M, b) takes a Gaussian's colour c to M c + b,
and blending is linear in the colours: with the weights w of a pixel's splats, which depend on
geometry alone,

    R(F(Y)) = sum w (M c + b) = M R(Y) + b alpha

wherever no colour is clamped at 0. The sky is mapped with the same map, (1 - alpha)(M sky + b):
together M I + b of the whole picture I. So a scene is rendered once, and R(.) of every step after
that is a 3 x 4 product a pixel, whose gradients are those of the renderer's backward pass.

Which pictures a step sees, and how they are recoloured, follows from the seed and the step's number
alone, so a training that was stopped goes on to the same bits. torch runs in one thread, since sums
are split among threads, and what is split here is so small that two on two busy cores took four
times as long.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor, nn
from torch.nn import functional

from augment.cameras import Camera
from augment.effects.style.content import select_views
from augment.effects.style.images import read_style_image
from augment.effects.style.losses import (
    FeatureExtractor,
    GaussianColors,
    color_distance,
    picture_distance,
    style_loss,
    weighted_sum,
)
from augment.effects.style.network import Gscm, compose, in_use, one_thread
from augment.effects.style.pairs import (
    PAIR_WEIGHTS,
    closed_method,
    network_method,
    pair_losses,
    recolor,
    sample_pairs,
    score_pairs,
)
from augment.errors import SceneError, StyleError
from augment.render.buffers import ALPHA, RGB
from augment.render.rasterize import rasterize
from augment.render.sh import SH_C0
from augment.scene import Scene

# ---- Contents: views of scenes, and photographs as scenes of one Gaussian a pixel ----------------

KEPT_COLORS = 65536  # most Gaussians of a scene whose colours are stored to draw samples from
SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".webp", ".bmp")
MIN_TO_HOLD_OUT = 5  # of fewer photos none is spared


class Content(NamedTuple):
    """A picture that styles are put on, and colours [1, N, ...] of its Gaussians or pixels."""

    picture: Float[Tensor, "3 S S"]
    colors: GaussianColors


def scene_contents(
    scene: Scene, count: int, size_px: int, *, seed: int, device: str = "cpu"
) -> list[Content]:
    """At most `count` views of a scene, cameras in turn and spread over the drive, whole pictures
    squeezed into squares, as an encoder sees them. They share the scene's colours.

    Raises:
        SceneError: the scene has no cameras.
    """
    cameras = select_views(scene, None, count)
    if not cameras:
        raise SceneError(
            f"scene {scene.name!r} ({scene.source}) has no cameras to look through; name some with "
            f"camera_path=FILE in its URI"
        )
    colors = colors_of(scene, seed=seed).to(device)
    squeezed = (camera.resized(size_px, size_px) for camera in cameras)
    return [Content(view_picture(scene, camera).to(device), colors) for camera in squeezed]


def view_picture(scene: Scene, camera: Camera) -> Float[Tensor, "3 H W"]:
    """Return a camera's picture of the scene and its sky, display-encoded, not clamped."""
    output = rasterize(scene.parts_for(camera), camera, buffers=(RGB, ALPHA))
    assert output.rgb is not None and output.alpha is not None
    sky = scene.sky.sample(camera.ray_directions()).permute(2, 0, 1).contiguous()
    return output.rgb.permute(2, 0, 1) + (1 - output.alpha[None]) * sky


def colors_of(scene: Scene, *, count: int = KEPT_COLORS, seed: int = 0) -> GaussianColors:
    """Colours [1, N, ...] of the scene's Gaussians, actors among them: of `count` drawn evenly, or
    of all. Parts of a lower degree than others have bands of 0.
    """
    parts = scene.all_gaussians
    k = max(part.sh.shape[1] for part in parts)
    ends = torch.tensor([len(part) for part in parts]).cumsum(0)
    total = int(ends[-1])
    index = torch.arange(total)
    if total > count:
        generator = torch.Generator().manual_seed(seed)
        index = torch.randint(total, (count,), generator=generator).sort().values
    chosen = []
    for part, end in zip(parts, ends.tolist(), strict=True):
        part_index = index[(index >= end - len(part)) & (index < end)] - (end - len(part))
        sh = part.sh[part_index].float()
        chosen.append(functional.pad(sh, (0, 0, 0, k - sh.shape[1])))
    values = SH_C0 * torch.cat(chosen)[None]
    return GaussianColors(values[:, :, 0] + 0.5, values[:, :, 1:])


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
    if files and not squares:
        raise StyleError(f"none of {len(files)} images can be read; the first: {problems[0]}")
    if problems:
        problems.append(f"{len(problems)} of {len(files)} images were left out")
    pixels = torch.zeros(0, 3, size_px, size_px, dtype=torch.uint8)
    if squares:
        pixels = torch.from_numpy(np.stack(squares))
    is_held_out = torch.zeros(len(pixels), dtype=torch.bool)
    if holdout and len(pixels) >= MIN_TO_HOLD_OUT:
        is_held_out[holdout - 1 :: holdout] = True
    return Photos(pixels[~is_held_out], pixels[is_held_out], tuple(problems))


def _find(paths: Sequence[Path]) -> list[Path]:
    files: dict[Path, None] = {}
    for path in paths:
        if path.is_file():
            files[path] = None
            continue
        if not path.is_dir():
            raise StyleError(f"photos: there is no file or folder {path}")
        inside = sorted(p for p in path.rglob("*") if p.suffix.lower() in SUFFIXES and p.is_file())
        if not inside:
            raise StyleError(
                f"photos: {path} holds no images ({', '.join(SUFFIXES)}), nor do folders in it"
            )
        files.update(dict.fromkeys(inside))
    return list(files)


# ---- Pictures of a training step -----------------------------------------------------------------

SCENE_SHARE = 0.5  # share of scenes among the contents, if there are both scenes and photos
PERTURBED = 0.5  # share of the styles that are recoloured first
COLORS = 1024  # Gaussians, or pixels, of an item whose colours are compared


@dataclass(frozen=True, eq=False)
class Draw:
    """One step's contents and their styles, in about [0, 1], on the pool's device."""

    pictures: Float[Tensor, "B 3 S S"]
    colors: GaussianColors
    styles: Float[Tensor, "B 3 S S"]


@dataclass(frozen=True, eq=False)
class TrainingPool:
    """views: of scenes. photos: uint8 [P, 3, S, S], of the same size and on the same device; P may
    be 0.

    Raises:
        StyleError: there is nothing in it.
    """

    views: Sequence[Content]
    photos: UInt8[Tensor, "P 3 S S"]

    def __post_init__(self) -> None:
        if not len(self):
            raise StyleError("there are no views of scenes, and no photos that are not held out")

    def __len__(self) -> int:
        return len(self.views) + len(self.photos)

    @property
    def device(self) -> torch.device:
        return self.photos.device

    def pictures(self) -> Float[Tensor, "P 3 S S"]:
        """Return the pictures of views, then of photos, float32."""
        return torch.stack([self._picture(number) for number in range(len(self))]).clamp(0, 1)

    def draw(self, generator: torch.Generator, batch: int) -> Draw:
        """Contents and styles of one step; the same for the same state of the CPU's generator.

        A style is another picture than its content; where there is only one, it is recoloured.
        """
        contents: list[Content] = []
        styles: list[Tensor] = []
        for _ in range(batch):
            wants_view, wants_recolor = torch.rand(2, generator=generator).tolist()
            is_view = bool(self.views) and (not len(self.photos) or wants_view < SCENE_SHARE)
            content_number = _integer(len(self.views) if is_view else len(self.photos), generator)
            content_number += 0 if is_view else len(self.views)
            style_number = _integer(max(len(self) - 1, 1), generator)
            style_number = (style_number + (style_number >= content_number)) % len(self)
            contents.append(self._content(content_number))
            style = self._picture(style_number)[None]
            if wants_recolor < PERTURBED or style_number == content_number:
                style = recolor(style, generator)
            styles.append(style[0])
        return Draw(
            torch.stack([content.picture for content in contents]),
            stacked([_sample(content.colors, generator) for content in contents]),
            torch.stack(styles),
        )

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


def _sample(colors: GaussianColors, generator: torch.Generator) -> GaussianColors:
    index = torch.randint(colors.base.shape[1], (COLORS,), generator=generator)
    index = index.to(colors.base.device)
    return GaussianColors(colors.base[:, index], colors.bands[:, index])


def _integer(below: int, generator: torch.Generator) -> int:
    return int(torch.randint(below, (1,), generator=generator))


# ---- The losses of a step, in the letters of augment.effects.style.losses ------------------------


class Transfer(NamedTuple):
    """The maps of one training step, [B, 3, 4] each: all are of Y_o."""

    content: Tensor  # Z_c
    styled: Tensor  # Y_s
    returned: Tensor  # Z_s
    cycled: Tensor  # Y_c


def folded_pictures(
    pictures: Float[Tensor, "B 3 H W"], maps: Float[Tensor, "B 3 4"]
) -> Float[Tensor, "B 3 H W"]:
    """R(.) of Gaussians under a map each: M I + b. Nothing is clamped."""
    batch, _, height, width = pictures.shape
    flat = torch.baddbmm(maps[:, :, 3:], maps[:, :, :3], pictures.reshape(batch, 3, -1))
    return flat.reshape(batch, 3, height, width)


def transfer_maps(
    net: Gscm, draw: Draw, *, only_cycle: bool = False
) -> tuple[Transfer, Tensor | None]:
    """The maps of every item, and R(Y_s); of the cycle alone where asked."""
    f_c, f_s = net.encode(torch.cat([draw.pictures, draw.styles.clamp(0, 1)]))
    count = len(draw.pictures)
    content = net.content_map(f_c[:count])
    cycled = compose(net.style_map(f_s[:count]), content)
    if only_cycle:
        return Transfer(content, content, content, cycled), None
    styled = compose(net.style_map(f_s[count:]), content)
    rendered = folded_pictures(draw.pictures, styled)
    # No gradient passes a picture's moments, so a map that Z_s follows would not be seen to do
    # so, and L_con would bend Y_s instead (by 2 dB of `same`): it teaches the way back alone.
    back, _ = net.encode(rendered.detach().clamp(0, 1))  # an encoder's pictures end at 0 and 1
    returned = compose(net.content_map(back), styled.detach())
    return Transfer(content, styled, returned, cycled), rendered


def paper_terms(
    net: Gscm, draw: Draw, features: FeatureExtractor, *, only_cycle: bool = False
) -> dict[str, Tensor]:
    """L_cyc, and unless it is to be alone L_con and L_s, of one step's items."""
    maps, rendered = transfer_maps(net, draw, only_cycle=only_cycle)
    cycled = folded_pictures(draw.pictures, maps.cycled)
    terms = {
        "cycle": color_distance(draw.colors.mapped(maps.cycled), draw.colors)
        + picture_distance(cycled, draw.pictures)
    }
    if rendered is None:
        return terms
    both = (maps.content, maps.returned)
    terms["consistency"] = color_distance(
        *(draw.colors.mapped(m) for m in both)
    ) + picture_distance(*(folded_pictures(draw.pictures, m) for m in both))
    terms["style"] = style_loss(features(rendered), features(draw.styles))
    return terms


# ---- The trainer ---------------------------------------------------------------------------------

DECAY = 0.1  # the learning rate's, after each third of the steps
WARM_UP = 0.1  # share of the steps in which the cycle loss is alone
GRADIENT_LIMIT = 10.0  # a step's greatest gradient norm


class StepRecord(NamedTuple):
    """step: how many are done now. terms: the losses that counted, before their weights."""

    step: int
    loss: float
    terms: Mapping[str, float]


def new_network(encoder: str, *, seed: int) -> Gscm:
    """A network as the seed begins it; torch's global generator is left as it was."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return Gscm(encoder)


class StyleTrainer:
    """Trains `net` in place by Adam, with pairs of the pool's pictures where it holds two.

    weights: of the losses style, consistency, cycle and pairs in their sum, and of the range in
    that of pairs. batch, pair_batch: contents with a style each, and pairs, a step. frozen_norm:
    keep the statistics of batch normalisation, of an encoder that came with some. The pool's device
    computes; what a step draws is the same everywhere, bits are promised on the CPU.
    """

    def __init__(
        self,
        net: Gscm,
        pool: TrainingPool,
        features: FeatureExtractor,
        *,
        steps: int,
        seed: int,
        learning_rate: float,
        weights: Mapping[str, float],
        batch: int,
        pair_batch: int,
        frozen_norm: bool = False,
    ) -> None:
        self.net = net.to(pool.device)
        self.pool = pool
        self.step = 0
        self._features = features.to(pool.device)
        self._steps = steps
        self._seed = seed
        self._learning_rate = learning_rate
        self._weights = weights
        self._batch = batch
        self._pair_batch = pair_batch
        self._paired = pool.pictures() if weights["pairs"] > 0 and len(pool) > 1 else None
        self._frozen_norm = frozen_norm
        self._parameters = {n: p for n, p in net.named_parameters() if p.requires_grad}
        self._adam = torch.optim.Adam(self._parameters.values(), lr=learning_rate)

    def learning_rate_at(self, step: int) -> float:
        """Return the learning rate of the step with this number, counted from 0."""
        return self._learning_rate * DECAY ** (3 * step // self._steps)

    def is_warming_up(self, step: int) -> bool:
        """Return True if this step has the cycle loss alone; never if that loss has no weight."""
        return self._weights["cycle"] > 0 and step < WARM_UP * self._steps

    @one_thread()
    def run_step(self) -> StepRecord:
        """One step.

        Raises:
            StyleError: the loss is no longer a number; the network is as it was before the step.
        """
        self._train_mode()
        with self._own_generator():
            try:
                terms = self._terms()
            except torch.linalg.LinAlgError as error:  # pyright: ignore[reportPrivateImportUsage]
                raise StyleError(
                    f"the pictures are no longer numbers in step {self.step + 1} ({error}): train "
                    f"with a smaller learning rate"
                ) from error
            loss = weighted_sum(terms, self._weights)
            value = float(loss.detach())
            facts = {name: float(term.detach()) for name, term in terms.items()}
            if not math.isfinite(value):
                parts = ", ".join(f"{name} {fact:.4g}" for name, fact in facts.items())
                raise StyleError(
                    f"the loss became {value} in step {self.step + 1} ({parts}): train with a "
                    f"smaller learning rate"
                )
            self._adam.zero_grad(set_to_none=True)
            loss.backward()
            nn.utils.clip_grad_norm_(self._parameters.values(), GRADIENT_LIMIT)
            for group in self._adam.param_groups:
                group["lr"] = self.learning_rate_at(self.step)
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
        expected_shapes = {n: tuple(t.shape) for n, t in self.net.state_dict().items()}
        net_arrays = {n.removeprefix("net."): a for n, a in arrays.items() if n.startswith("net.")}
        if {n: tuple(a.shape) for n, a in net_arrays.items()} != expected_shapes:
            raise StyleError("the state to go on from is of another network")
        self.net.load_state_dict({n: torch.from_numpy(a.copy()) for n, a in net_arrays.items()})
        for name, parameter in self._parameters.items():
            start = f"adam.{name}:"
            parts = {n.removeprefix(start): a for n, a in arrays.items() if n.startswith(start)}
            if parts:
                self._adam.state[parameter] = {
                    part: torch.from_numpy(a.copy()).to(
                        "cpu" if part == "step" else self.pool.device
                    )
                    for part, a in parts.items()
                }
        self.step = int(facts["step"])

    def _terms(self) -> dict[str, Tensor]:
        draw = self.pool.draw(generator_for(self._seed, self.step, "pictures"), self._batch)
        warming_up = self.is_warming_up(self.step)
        terms = paper_terms(self.net, draw, self._features, only_cycle=warming_up)
        if self._paired is not None and not warming_up:
            generator = generator_for(self._seed, self.step, "pairs")
            size_px = draw.styles.shape[2]
            pairs = sample_pairs(self._paired, generator, self._pair_batch, size_px=size_px)
            weights = PAIR_WEIGHTS | {"range": self._weights["range"]}
            terms["pairs"] = weighted_sum(pair_losses(self.net, pairs), weights)
        return terms

    def _train_mode(self) -> None:
        self.net.train()
        if self._frozen_norm:
            for module in self.net.modules():
                if isinstance(module, nn.modules.batchnorm._BatchNorm):
                    module.eval()

    @contextmanager
    def _own_generator(self) -> Iterator[None]:
        """torch's global generators, which encoders may use, as the step has them while entered."""
        device = self.pool.device
        with torch.random.fork_rng(devices=[device] if device.type == "cuda" else []):
            torch.manual_seed(generator_for(self._seed, self.step, "network").initial_seed())
            yield


def _array(tensor: Tensor) -> np.ndarray:
    return tensor.detach().cpu().numpy().copy()


# ---- What a network is worth: by its own losses, on one fixed draw, and on held-out photos -------

DEFINITIONS = {
    "content_rmse": "root mean square difference of R(Z_c) and R(Z_s), in units of the deviation "
    "of R(Z_c): 0 where the content space knows nothing of the style; a space that was shrunk "
    "gains nothing",
    "restoration_psnr": "dB, of R(Y_c), clamped to [0, 1], against the original picture; mean over "
    "the pictures",
    "style_loss": "L_s of R(Y_s), clamped to [0, 1], against the style picture",
    "same, half, below, look": "PSNR, dB, of held-out photos in styles with a known right result "
    "(augment.effects.style.pairs); mkl_* are the closed form's",
}


def score_training(net: Gscm, draw: Draw, features: FeatureExtractor) -> dict[str, float]:
    """The measures above, by name. The network's mode is as before afterwards."""
    with in_use(net):
        maps, rendered = transfer_maps(net, draw)
        assert rendered is not None
        content, returned, cycled = (
            folded_pictures(draw.pictures, m) for m in (maps.content, maps.returned, maps.cycled)
        )
        deviation = content.std((2, 3), correction=0).mean(1)
        rmse = (content - returned).square().mean((1, 2, 3)).sqrt()
        errors = (cycled.clamp(0, 1) - draw.pictures).square().mean((1, 2, 3)).clamp_min(1e-6)
        return {
            "content_rmse": float((rmse / deviation.clamp_min(1e-6)).mean()),
            "restoration_psnr": float((-10 / math.log(10) * errors.log()).mean()),
            "style_loss": float(style_loss(features(rendered.clamp(0, 1)), features(draw.styles))),
        }


def score_photos(net: Gscm, photos: UInt8[Tensor, "P 3 S S"]) -> dict[str, float]:
    """PSNR of photos with a known right result, and the closed form's beside it; nothing of fewer
    than two photos. The network goes to the CPU.
    """
    if len(photos) < 2:
        return {}
    pictures = photos.float() / 255
    with in_use(net.cpu()):
        ours = score_pairs(network_method(net), pictures, repeats=2)
        closed = score_pairs(closed_method(), pictures, repeats=2)
    return ours | {f"mkl_{name}": value for name, value in closed.items()}
