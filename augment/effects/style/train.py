"""Training of the style network, one step at a time.

`tools.style` makes a `TrainingPool` of scenes and photographs and runs a `StyleTrainer`; scores of
the network come from `score_training` and `score_photos`.

Contents are photographs and views of scenes. A map (M, b) takes a Gaussian's colour c to M c + b,
and blending is linear in the colours: with the weights w of a pixel's splats, which depend on
geometry alone,

    R(F(Y)) = sum w (M c + b) = M R(Y) + b alpha

wherever no colour is clamped at 0. The sky is mapped with the same map, (1 - alpha)(M sky + b):
together M I + b of the whole picture I. So a scene is rendered once, and R(.) of every step after
that is a 3 x 4 product a pixel, whose gradients are those of the renderer's backward pass.

The pictures of a step and their recolourings depend on the seed and the step's number alone, so a
training that was stopped goes on to the same bits. torch runs in one thread, because sums are split
among threads. The sums are so small that two threads on two busy cores took four times as long.
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
from augment.effects.style.network import Gscm, compose, inference, one_thread
from augment.effects.style.pairs import (
    PAIR_WEIGHTS,
    closed_form_method,
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
from augment.scene.cameras import Camera
from augment.scene.scene import Scene

# ---- Contents: views of scenes, and photographs as scenes of one Gaussian a pixel ----------------

# Largest number of Gaussians of a scene whose colours are stored to draw samples from.
MAX_SCENE_COLORS = 65536
# Endings of the image files that are searched for in folders.
IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".webp", ".bmp")
# Number of photos from which some are held out.
MIN_PHOTOS_TO_HOLD_OUT = 5


class Content(NamedTuple):
    """A picture that styles are put on."""

    picture: Float[Tensor, "3 S S"]
    """The picture, display-encoded."""

    colors: GaussianColors
    """Colours [1, N, ...] of the scene's Gaussians or of the photo's pixels."""


def scene_contents(
    scene: Scene, count: int, size_px: int, *, seed: int, device: str = "cpu"
) -> list[Content]:
    """Return views of a scene as contents, which share the scene's colours.

    Args:
        scene: the scene, with cameras.
        count: largest number of views; they alternate between cameras and are spread over time.
        size_px: side of the squares that the whole pictures are squeezed to, for an encoder.
        seed: seed of the sample of the scene's colours.
        device: device of the contents.

    Raises:
        SceneError: the scene has no cameras.
    """
    cameras = select_views(scene, None, count)
    if not cameras:
        raise SceneError(
            f"scene {scene.name!r} ({scene.source}) has no cameras to look through; name some with "
            f"camera_path=FILE in its URI"
        )
    colors = scene_colors(scene, seed=seed).to(device)
    square_cameras = (camera.resized(size_px, size_px) for camera in cameras)
    return [Content(view_picture(scene, camera).to(device), colors) for camera in square_cameras]


def view_picture(scene: Scene, camera: Camera) -> Float[Tensor, "3 H W"]:
    """Return a camera's picture of the scene and its sky, display-encoded, not clamped."""
    output = rasterize(scene.parts_for(camera), camera, buffers=(RGB, ALPHA))
    assert output.rgb is not None and output.alpha is not None
    sky = scene.sky.sample(camera.ray_directions()).permute(2, 0, 1).contiguous()
    return output.rgb.permute(2, 0, 1) + (1 - output.alpha[None]) * sky


def scene_colors(scene: Scene, *, count: int = MAX_SCENE_COLORS, seed: int = 0) -> GaussianColors:
    """Return colours [1, N, ...] of the scene's Gaussians, actors included.

    Parts of a lower SH degree than others have higher bands of 0.

    Args:
        scene: the scene.
        count: if there are more Gaussians, this many are drawn with equal probability.
        seed: seed of the draw.
    """
    parts = scene.all_gaussians
    num_bands = max(part.sh.shape[1] for part in parts)
    part_ends = torch.tensor([len(part) for part in parts]).cumsum(0)
    total = int(part_ends[-1])
    sample_index = torch.arange(total)
    if total > count:
        generator = torch.Generator().manual_seed(seed)
        sample_index = torch.randint(total, (count,), generator=generator).sort().values
    selected_sh = []
    for part, part_end in zip(parts, part_ends.tolist(), strict=True):
        part_index = sample_index[
            (sample_index >= part_end - len(part)) & (sample_index < part_end)
        ] - (part_end - len(part))
        sh = part.sh[part_index].float()
        selected_sh.append(functional.pad(sh, (0, 0, 0, num_bands - sh.shape[1])))
    values = SH_C0 * torch.cat(selected_sh)[None]
    return GaussianColors(values[:, :, 0] + 0.5, values[:, :, 1:])


@dataclass(frozen=True, eq=False)
class Photos:
    """Photographs as RGB squares."""

    train: UInt8[Tensor, "P 3 S S"]
    """Photos to train with."""

    held_out: UInt8[Tensor, "Q 3 S S"]
    """Photos to score with."""

    problems: tuple[str, ...] = ()
    """A sentence for each file that could not be read."""


def read_photos(paths: Sequence[Path], size_px: int, *, holdout: int) -> Photos:
    """Read images from files and folders, and squeeze them to squares.

    Args:
        paths: image files, and folders that are searched with all folders inside.
        size_px: side of the squares.
        holdout: every holdout-th image, in order of the paths, is held out; 0 for none.

    Raises:
        StyleError: a file or folder does not exist, a folder has no images, or no image can be
            read.
    """
    files = _find_images(paths)
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
    if holdout and len(pixels) >= MIN_PHOTOS_TO_HOLD_OUT:
        is_held_out[holdout - 1 :: holdout] = True
    return Photos(pixels[~is_held_out], pixels[is_held_out], tuple(problems))


def _find_images(paths: Sequence[Path]) -> list[Path]:
    """Return all image files among the paths and in folders, without duplicates."""
    files: dict[Path, None] = {}
    for path in paths:
        if path.is_file():
            files[path] = None
            continue
        if not path.is_dir():
            raise StyleError(f"photos: there is no file or folder {path}")
        images = sorted(
            p for p in path.rglob("*") if p.suffix.lower() in IMAGE_SUFFIXES and p.is_file()
        )
        if not images:
            raise StyleError(
                f"photos: {path} holds no images ({', '.join(IMAGE_SUFFIXES)}), "
                "nor do folders in it"
            )
        files.update(dict.fromkeys(images))
    return list(files)


# ---- Pictures of a training step -----------------------------------------------------------------

# Share of scenes among the contents, if there are both scenes and photos.
SCENE_SHARE = 0.5
# Share of the styles that are recoloured first.
RECOLORED_SHARE = 0.5
# Number of Gaussians, or pixels, of an item whose colours are compared.
NUM_COLORS = 1024


@dataclass(frozen=True, eq=False)
class Draw:
    """Contents and styles of one step, in about [0, 1], on the pool's device."""

    pictures: Float[Tensor, "B 3 S S"]
    """Pictures of the contents."""

    colors: GaussianColors
    """Colours of NUM_COLORS Gaussians or pixels of each content."""

    styles: Float[Tensor, "B 3 S S"]
    """Style picture of each content."""


@dataclass(frozen=True, eq=False)
class TrainingPool:
    """Pictures that a training draws contents and styles from.

    Raises:
        StyleError: the pool is empty.
    """

    views: Sequence[Content]
    """Views of scenes."""

    photos: UInt8[Tensor, "P 3 S S"]
    """Photos of the views' size, on their device; P may be 0."""

    def __post_init__(self) -> None:
        if not len(self):
            raise StyleError("there are no views of scenes, and no photos that are not held out")

    def __len__(self) -> int:
        return len(self.views) + len(self.photos)

    @property
    def device(self) -> torch.device:
        """Device of all pictures."""
        return self.photos.device

    def pictures(self) -> Float[Tensor, "P 3 S S"]:
        """Return the pictures of views, then of photos, float32."""
        return torch.stack([self._picture(number) for number in range(len(self))]).clamp(0, 1)

    def draw(self, generator: torch.Generator, batch: int) -> Draw:
        """Draw contents and styles of one step; the same for the same generator state.

        The style of a content is another picture. If the pool has only one, it is recoloured.

        Args:
            generator: random numbers of the CPU.
            batch: number B of contents.
        """
        contents: list[Content] = []
        styles: list[Tensor] = []
        for _ in range(batch):
            view_draw, recolor_draw = torch.rand(2, generator=generator).tolist()
            is_view = bool(self.views) and (not len(self.photos) or view_draw < SCENE_SHARE)
            content_number = _random_integer(
                len(self.views) if is_view else len(self.photos), generator
            )
            content_number += 0 if is_view else len(self.views)
            style_number = _random_integer(max(len(self) - 1, 1), generator)
            style_number = (style_number + (style_number >= content_number)) % len(self)
            contents.append(self._content(content_number))
            style = self._picture(style_number)[None]
            if recolor_draw < RECOLORED_SHARE or style_number == content_number:
                style = recolor(style, generator)
            styles.append(style[0])
        return Draw(
            torch.stack([content.picture for content in contents]),
            stack_colors([_sample_colors(content.colors, generator) for content in contents]),
            torch.stack(styles),
        )

    def _content(self, number: int) -> Content:
        """Return the content with this number, views first."""
        if number < len(self.views):
            return self.views[number]
        picture = self._picture(number)
        pixels = picture.flatten(1).T[None]
        return Content(picture, GaussianColors(pixels, pixels.new_zeros(1, pixels.shape[1], 0, 3)))

    def _picture(self, number: int) -> Tensor:
        """Return the picture with this number, views first, float32."""
        if number < len(self.views):
            return self.views[number].picture
        return self.photos[number - len(self.views)].float() / 255


def stack_colors(colors: Sequence[GaussianColors]) -> GaussianColors:
    """Return items with the same number of Gaussians as a batch; missing higher bands are 0."""
    num_bands = max(item.bands.shape[2] for item in colors)
    return GaussianColors(
        torch.cat([item.base for item in colors]),
        torch.cat(
            [
                functional.pad(item.bands, (0, 0, 0, num_bands - item.bands.shape[2]))
                for item in colors
            ]
        ),
    )


def generator_for(seed: int, step: int, use: str) -> torch.Generator:
    """Return the generator of one step and one use, so that no state is kept between steps."""
    digest = hashlib.sha256(f"climategs style training 1, {seed}, {step}, {use}".encode()).digest()
    return torch.Generator().manual_seed(int.from_bytes(digest[:7], "big"))


def _sample_colors(colors: GaussianColors, generator: torch.Generator) -> GaussianColors:
    """Draw NUM_COLORS Gaussians or pixels of an item."""
    index = torch.randint(colors.base.shape[1], (NUM_COLORS,), generator=generator)
    index = index.to(colors.base.device)
    return GaussianColors(colors.base[:, index], colors.bands[:, index])


def _random_integer(limit: int, generator: torch.Generator) -> int:
    """Draw an integer in [0, limit)."""
    return int(torch.randint(limit, (1,), generator=generator))


# ---- The losses of a step, in the letters of augment.effects.style.losses ------------------------


class Transfer(NamedTuple):
    """Maps of one training step, [B, 3, 4] each; all are applied to Y_o."""

    content: Tensor  # map to Z_c
    styled: Tensor  # map to Y_s
    returned: Tensor  # map to Z_s
    cycled: Tensor  # map to Y_c


def folded_pictures(
    pictures: Float[Tensor, "B 3 H W"], maps: Float[Tensor, "B 3 4"]
) -> Float[Tensor, "B 3 H W"]:
    """Return R(.) of Gaussians under the map of their batch item, M I + b, not clamped."""
    batch, _, height, width = pictures.shape
    flat = torch.baddbmm(maps[:, :, 3:], maps[:, :, :3], pictures.reshape(batch, 3, -1))
    return flat.reshape(batch, 3, height, width)


def transfer_maps(
    net: Gscm, draw: Draw, *, only_cycle: bool = False
) -> tuple[Transfer, Tensor | None]:
    """Return the maps of every item, and R(Y_s).

    Args:
        net: the network.
        draw: contents and styles of the step.
        only_cycle: if True, only the maps to Z_c and Y_c are computed. The others are then copies
            of Z_c's, and R(Y_s) is None.
    """
    f_c, f_s = net.encode(torch.cat([draw.pictures, draw.styles.clamp(0, 1)]))
    count = len(draw.pictures)
    content = net.content_map(f_c[:count])
    cycled = compose(net.style_map(f_s[:count]), content)
    if only_cycle:
        return Transfer(content, content, content, cycled), None
    styled = compose(net.style_map(f_s[count:]), content)
    rendered = folded_pictures(draw.pictures, styled)
    # No gradient passes through a picture's moments, so L_con cannot see that Z_s follows Y_s, and
    # would change Y_s instead (by 2 dB of `same`). Y_s is detached, so that L_con trains only the
    # map back to the content space.
    returned_code, _ = net.encode(rendered.detach().clamp(0, 1))  # encoders take [0, 1]
    returned = compose(net.content_map(returned_code), styled.detach())
    return Transfer(content, styled, returned, cycled), rendered


def paper_terms(
    net: Gscm, draw: Draw, features: FeatureExtractor, *, only_cycle: bool = False
) -> dict[str, Tensor]:
    """Return the losses of one step by name: L_cyc, and unless only_cycle L_con and L_s."""
    transfer, rendered = transfer_maps(net, draw, only_cycle=only_cycle)
    cycled = folded_pictures(draw.pictures, transfer.cycled)
    terms = {
        "cycle": color_distance(draw.colors.mapped(transfer.cycled), draw.colors)
        + picture_distance(cycled, draw.pictures)
    }
    if rendered is None:
        return terms
    content_space_maps = (transfer.content, transfer.returned)
    terms["consistency"] = color_distance(
        *(draw.colors.mapped(color_map) for color_map in content_space_maps)
    ) + picture_distance(
        *(folded_pictures(draw.pictures, color_map) for color_map in content_space_maps)
    )
    terms["style"] = style_loss(features(rendered), features(draw.styles))
    return terms


# ---- The trainer ---------------------------------------------------------------------------------

# Factor on the learning rate after each third of the steps.
LEARNING_RATE_DECAY = 0.1
# Share of the steps, at the beginning, that have the cycle loss alone.
WARM_UP_SHARE = 0.1
# Largest norm of a step's gradient; larger gradients are scaled down.
MAX_GRADIENT_NORM = 10.0


class StepRecord(NamedTuple):
    """Result of one training step."""

    step: int
    """Number of steps done, this one included."""

    loss: float
    """Weighted sum of the losses."""

    terms: Mapping[str, float]
    """Unweighted losses of the step, by name."""


def new_network(encoder: str, *, seed: int) -> Gscm:
    """Return a network with random weights of the seed; torch's global generator is unchanged."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return Gscm(encoder)


class StyleTrainer:
    """Trains a network in place by Adam, on the device of the pool.

    If the pool has two or more pictures, each step also has pairs of them. A step draws the same on
    every device; equal bits are promised on the CPU only.

    Args:
        net: the network to train.
        pool: pictures that contents and styles are drawn from.
        features: extractor of the features that L_s compares.
        steps: number of steps of the whole training.
        seed: seed of all draws.
        learning_rate: learning rate of the first steps.
        weights: weights of the losses style, consistency, cycle and pairs in their sum, and of the
            loss range in that of pairs.
        batch: number of contents with their styles per step.
        pair_batch: number of pairs per step.
        frozen_norm: if True, the statistics of batch normalisation are kept, for an encoder with
            pretrained weights.
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
        self._pair_photos = pool.pictures() if weights["pairs"] > 0 and len(pool) > 1 else None
        self._frozen_norm = frozen_norm
        self._parameters = {n: p for n, p in net.named_parameters() if p.requires_grad}
        self._adam = torch.optim.Adam(self._parameters.values(), lr=learning_rate)

    def learning_rate_at(self, step: int) -> float:
        """Return the learning rate of the step with this number, counted from 0."""
        return self._learning_rate * LEARNING_RATE_DECAY ** (3 * step // self._steps)

    def is_warming_up(self, step: int) -> bool:
        """Return True if this step has the cycle loss alone; never if that loss has no weight."""
        return self._weights["cycle"] > 0 and step < WARM_UP_SHARE * self._steps

    @one_thread()
    def run_step(self) -> StepRecord:
        """Run one step and return its losses.

        Raises:
            StyleError: the loss is no longer a number; the network is as it was before the step.
        """
        self._set_train_mode()
        with self._step_generator():
            try:
                terms = self._compute_terms()
            except torch.linalg.LinAlgError as error:  # pyright: ignore[reportPrivateImportUsage]
                raise StyleError(
                    f"the pictures are no longer numbers in step {self.step + 1} ({error}): train "
                    f"with a smaller learning rate"
                ) from error
            loss = weighted_sum(terms, self._weights)
            loss_value = float(loss.detach())
            term_values = {name: float(term.detach()) for name, term in terms.items()}
            if not math.isfinite(loss_value):
                terms_text = ", ".join(
                    f"{name} {term_value:.4g}" for name, term_value in term_values.items()
                )
                raise StyleError(
                    f"the loss became {loss_value} in step {self.step + 1} ({terms_text}): "
                    "train with a smaller learning rate"
                )
            self._adam.zero_grad(set_to_none=True)
            loss.backward()
            nn.utils.clip_grad_norm_(self._parameters.values(), MAX_GRADIENT_NORM)
            for group in self._adam.param_groups:
                group["lr"] = self.learning_rate_at(self.step)
            self._adam.step()
        self.step += 1
        return StepRecord(self.step, loss_value, term_values)

    def state(self) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Return copies of all arrays, and facts, from which `load_state` goes on to equal bits."""
        arrays = {f"net.{n}": _to_array(t) for n, t in self.net.state_dict().items()}
        for name, parameter in self._parameters.items():
            for part, value in self._adam.state.get(parameter, {}).items():
                arrays[f"adam.{name}:{part}"] = _to_array(value)
        return arrays, {"step": self.step}

    def load_state(self, arrays: Mapping[str, np.ndarray], facts: Mapping[str, Any]) -> None:
        """Continue from the `state` of a trainer that was made with the same arguments.

        Raises:
            StyleError: the arrays are of another network.
        """
        expected_shapes = {key: tuple(t.shape) for key, t in self.net.state_dict().items()}
        net_arrays = {
            key.removeprefix("net."): array
            for key, array in arrays.items()
            if key.startswith("net.")
        }
        if {key: tuple(array.shape) for key, array in net_arrays.items()} != expected_shapes:
            raise StyleError("the state to go on from is of another network")
        self.net.load_state_dict(
            {key: torch.from_numpy(array.copy()) for key, array in net_arrays.items()}
        )
        for name, parameter in self._parameters.items():
            prefix = f"adam.{name}:"
            moments = {
                key.removeprefix(prefix): array
                for key, array in arrays.items()
                if key.startswith(prefix)
            }
            if moments:
                self._adam.state[parameter] = {
                    moment_name: torch.from_numpy(array.copy()).to(
                        "cpu" if moment_name == "step" else self.pool.device
                    )
                    for moment_name, array in moments.items()
                }
        self.step = int(facts["step"])

    def _compute_terms(self) -> dict[str, Tensor]:
        """Return this step's unweighted losses by name."""
        draw = self.pool.draw(generator_for(self._seed, self.step, "pictures"), self._batch)
        warming_up = self.is_warming_up(self.step)
        terms = paper_terms(self.net, draw, self._features, only_cycle=warming_up)
        if self._pair_photos is not None and not warming_up:
            generator = generator_for(self._seed, self.step, "pairs")
            size_px = draw.styles.shape[2]
            pairs = sample_pairs(self._pair_photos, generator, self._pair_batch, size_px=size_px)
            weights = PAIR_WEIGHTS | {"range": self._weights["range"]}
            terms["pairs"] = weighted_sum(pair_losses(self.net, pairs), weights)
        return terms

    def _set_train_mode(self) -> None:
        """Put the network in training mode, with frozen statistics where wanted."""
        self.net.train()
        if self._frozen_norm:
            for module in self.net.modules():
                if isinstance(module, nn.modules.batchnorm._BatchNorm):
                    module.eval()

    @contextmanager
    def _step_generator(self) -> Iterator[None]:
        """Seed torch's global generators, which encoders may use, and restore them afterwards."""
        device = self.pool.device
        with torch.random.fork_rng(devices=[device] if device.type == "cuda" else []):
            torch.manual_seed(generator_for(self._seed, self.step, "network").initial_seed())
            yield


def _to_array(tensor: Tensor) -> np.ndarray:
    """Copy a tensor to the CPU."""
    return tensor.detach().cpu().numpy().copy()


# ---- Scores of a network: its losses on one fixed draw, and PSNR of held-out photos --------------

# Definitions of the scores, by name, for reports.
SCORE_DEFINITIONS = {
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
    """Return the scores of a fixed draw by name (see SCORE_DEFINITIONS)."""
    with inference(net):
        transfer, rendered = transfer_maps(net, draw)
        assert rendered is not None
        content, returned, cycled = (
            folded_pictures(draw.pictures, color_map)
            for color_map in (transfer.content, transfer.returned, transfer.cycled)
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
    """Return mean PSNR (dB) of photos in styles with a known right result, by name.

    Scores of the closed form have the prefix mkl_. With fewer than two photos the result is empty.
    The network is moved to the CPU.
    """
    if len(photos) < 2:
        return {}
    pictures = photos.float() / 255
    with inference(net.cpu()):
        network_scores = score_pairs(network_method(net), pictures, repeats=2)
        closed_form_scores = score_pairs(closed_form_method(), pictures, repeats=2)
    return network_scores | {f"mkl_{name}": value for name, value in closed_form_scores.items()}
