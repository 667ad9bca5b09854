"""Training of the style network: contents and styles, the losses of a step, the loop.

`tools.style` makes a `TrainingPool` of scenes and photographs and iterates over `train_network`;
held-out photos are scored by `score_photos`. The losses have the letters of
`augment.effects.style.losses`.

Contents are photographs and views of scenes. A map (M, b) takes a Gaussian's colour c to M c + b,
and blending is linear in the colours: with the weights w of a pixel's splats, which depend on
geometry alone,

    R(F(Y)) = sum w (M c + b) = M R(Y) + b alpha

wherever no colour is clamped at 0. The sky is mapped with the same map, (1 - alpha)(M sky + b):
together M I + b of the whole picture I. So a scene is rendered once, and R(.) of every step after
that is a 3 x 4 product a pixel, whose gradients are those of the renderer's backward pass.

The pictures of a step and their recolourings depend on the seed and the step's number alone. torch
runs in one thread, because sums are split among threads. The sums are so small that two threads on
two busy cores took four times as long.
"""

from __future__ import annotations

import hashlib
import itertools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

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


def scene_colors(scene: Scene, *, seed: int) -> GaussianColors:
    """Return colours [1, N, ...] of the scene's Gaussians, actors included.

    Of more than MAX_SCENE_COLORS Gaussians, that many are drawn with equal probability. Parts of a
    lower SH degree than others have higher bands of 0.
    """
    parts = scene.all_gaussians
    num_bands = max(part.sh.shape[1] for part in parts)
    total = sum(map(len, parts))
    sample_index = torch.arange(total)
    if total > MAX_SCENE_COLORS:
        generator = torch.Generator().manual_seed(seed)
        sample_index = torch.randint(total, (MAX_SCENE_COLORS,), generator=generator).sort().values
    part_sh = []
    part_start = 0
    for part in parts:
        part_index = sample_index - part_start
        sh = part.sh[part_index[(part_index >= 0) & (part_index < len(part))]].float()
        part_sh.append(functional.pad(sh, (0, 0, 0, num_bands - sh.shape[1])))
        part_start += len(part)
    values = SH_C0 * torch.cat(part_sh)[None]
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


def photo_contents(
    photos: UInt8[Tensor, "P 3 S S"], *, device: str | torch.device = "cpu"
) -> list[Content]:
    """Return photos as contents: scenes of one Gaussian a pixel, without higher bands."""
    contents = []
    for picture in photos.to(device).float() / 255:
        pixels = picture.flatten(1).T[None]
        no_bands = pixels.new_zeros(1, pixels.shape[1], 0, 3)
        contents.append(Content(picture, GaussianColors(pixels, no_bands)))
    return contents


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

    photos: Sequence[Content]
    """Photos, as scenes of one Gaussian a pixel, of the views' size, on their device."""

    def __post_init__(self) -> None:
        if not self.contents:
            raise StyleError("there are no views of scenes, and no photos that are not held out")

    @property
    def contents(self) -> list[Content]:
        """Views, then photos."""
        return [*self.views, *self.photos]

    def draw(self, generator: torch.Generator, batch: int) -> Draw:
        """Draw contents and styles of one step; the same for the same generator state.

        The style of a content is another picture. If the pool has only one, it is recoloured.

        Args:
            generator: random numbers of the CPU.
            batch: number B of contents.
        """
        contents = self.contents
        num_views = len(self.views)
        drawn_contents: list[Content] = []
        styles: list[Tensor] = []
        for _ in range(batch):
            view_draw, recolor_draw = torch.rand(2, generator=generator).tolist()
            is_view = num_views > 0 and (not self.photos or view_draw < SCENE_SHARE)
            limits = (0, num_views) if is_view else (num_views, len(contents))
            content_number = int(torch.randint(*limits, (1,), generator=generator))
            shift = int(torch.randint(max(len(contents) - 1, 1), (1,), generator=generator))
            style_number = (shift + (shift >= content_number)) % len(contents)
            drawn_contents.append(contents[content_number])
            style = contents[style_number].picture[None]
            if recolor_draw < RECOLORED_SHARE or style_number == content_number:
                style = recolor(style, generator)
            styles.append(style[0])
        return Draw(
            torch.stack([content.picture for content in drawn_contents]),
            _sample_colors([content.colors for content in drawn_contents], generator),
            torch.stack(styles),
        )


def _sample_colors(items: Sequence[GaussianColors], generator: torch.Generator) -> GaussianColors:
    """Draw NUM_COLORS Gaussians or pixels of each item, as a batch; missing higher bands are 0."""
    num_bands = max(item.bands.shape[2] for item in items)
    base: list[Tensor] = []
    bands: list[Tensor] = []
    for item in items:
        index = torch.randint(item.base.shape[1], (NUM_COLORS,), generator=generator)
        index = index.to(item.base.device)
        base.append(item.base[:, index])
        padding = (0, 0, 0, num_bands - item.bands.shape[2])
        bands.append(functional.pad(item.bands[:, index], padding))
    return GaussianColors(torch.cat(base), torch.cat(bands))


def generator_for(seed: int, step: int, use: str) -> torch.Generator:
    """Return the generator of one step and one use, so that no state is kept between steps."""
    digest = hashlib.sha256(f"climategs style training 1, {seed}, {step}, {use}".encode()).digest()
    return torch.Generator().manual_seed(int.from_bytes(digest[:7], "big"))


# ---- The losses of a step ------------------------------------------------------------------------


def paper_losses(
    net: Gscm, draw: Draw, features: FeatureExtractor, *, only_cycle: bool = False
) -> dict[str, Tensor]:
    """Return L_cyc, and unless only_cycle L_con and L_s, by name.

    All maps [B, 3, 4] are applied to Y_o.
    """
    f_c, f_s = net.encode(torch.cat([draw.pictures, draw.styles.clamp(0, 1)]))
    count = len(draw.pictures)
    to_content = net.content_map(f_c[:count])  # Z_c
    cycled = compose(net.style_map(f_s[:count]), to_content)  # Y_c
    losses = {
        "cycle": color_distance(draw.colors.mapped(cycled), draw.colors)
        + picture_distance(folded_pictures(draw.pictures, cycled), draw.pictures)
    }
    if only_cycle:
        return losses
    styled = compose(net.style_map(f_s[count:]), to_content)  # Y_s
    rendered = folded_pictures(draw.pictures, styled)
    # No gradient passes through a picture's moments, so L_con cannot see that Z_s follows Y_s, and
    # would change Y_s instead (by 2 dB of `same`). Y_s is detached, so that L_con trains only the
    # map back to the content space.
    returned_code, _ = net.encode(rendered.detach().clamp(0, 1))  # encoders take [0, 1]
    returned = compose(net.content_map(returned_code), styled.detach())  # Z_s
    losses["consistency"] = color_distance(
        draw.colors.mapped(to_content), draw.colors.mapped(returned)
    ) + picture_distance(
        folded_pictures(draw.pictures, to_content), folded_pictures(draw.pictures, returned)
    )
    losses["style"] = style_loss(features(rendered), features(draw.styles))
    return losses


def folded_pictures(
    pictures: Float[Tensor, "B 3 H W"], maps: Float[Tensor, "B 3 4"]
) -> Float[Tensor, "B 3 H W"]:
    """Return R(.) of Gaussians under the map of their batch item, M I + b, not clamped."""
    batch, _, height, width = pictures.shape
    flat = torch.baddbmm(maps[:, :, 3:], maps[:, :, :3], pictures.reshape(batch, 3, -1))
    return flat.reshape(batch, 3, height, width)


# ---- The loop ------------------------------------------------------------------------------------

# Weights of the losses in their sum: those of the paper, and that of recoloured pairs.
LOSS_WEIGHTS = {"style": 1.0, "consistency": 10.0, "cycle": 10.0, "pairs": 1.0}
# Number of contents with their styles per step.
BATCH = 2
# Number of pairs per step.
PAIR_BATCH = 4
# Factor on the learning rate after each third of the training.
LEARNING_RATE_DECAY = 0.1
# Share of the training, at its beginning, that has the cycle loss alone.
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


def train_network(
    net: Gscm,
    pool: TrainingPool,
    features: FeatureExtractor,
    *,
    progress: Callable[[int], float],
    seed: int,
    learning_rate: float,
    frozen_norm: bool = False,
) -> Iterator[StepRecord]:
    """Train the network in place by Adam, on the pool's device; each iteration is one step.

    If the pool has two or more pictures, steps after the warm-up also have pairs of them.

    Args:
        net: the network to train.
        pool: pictures that contents and styles are drawn from.
        features: extractor of the features that L_s compares.
        progress: share of the training before the step with this number, which counts from 0. The
            training ends where it is 1.
        seed: seed of all draws. A step draws the same on every device.
        learning_rate: learning rate of the first third.
        frozen_norm: if True, the statistics of batch normalisation are kept, for an encoder with
            pretrained weights.

    Raises:
        StyleError: the loss is no longer a number; the network is as it was before the step.
    """
    device = pool.contents[0].picture.device
    net.to(device)
    features.to(device)
    pictures = torch.stack([content.picture for content in pool.contents]).clamp(0, 1)
    parameters = [parameter for parameter in net.parameters() if parameter.requires_grad]
    optimizer = torch.optim.Adam(parameters)
    for step in itertools.count():
        done_share = progress(step)
        if done_share >= 1:
            return
        is_warm_up = done_share < WARM_UP_SHARE
        with _training_step(net, seed, step, device, frozen_norm=frozen_norm):
            draw = pool.draw(generator_for(seed, step, "pictures"), BATCH)
            terms = paper_losses(net, draw, features, only_cycle=is_warm_up)
            if len(pictures) > 1 and not is_warm_up:
                generator = generator_for(seed, step, "pairs")
                size_px = pictures.shape[2]
                pairs = sample_pairs(pictures, generator, PAIR_BATCH, size_px=size_px)
                terms["pairs"] = weighted_sum(pair_losses(net, pairs), PAIR_WEIGHTS)
            loss = weighted_sum(terms, LOSS_WEIGHTS)
            _check_loss(loss, terms, step)
            optimizer.zero_grad(set_to_none=True)
            loss.backward()
            nn.utils.clip_grad_norm_(parameters, MAX_GRADIENT_NORM)
            optimizer.param_groups[0]["lr"] = learning_rate_at(learning_rate, done_share)
            optimizer.step()
        yield StepRecord(step + 1, loss.item(), {n: term.item() for n, term in terms.items()})


def learning_rate_at(first_rate: float, progress: float) -> float:
    """Return the learning rate after this share of the training."""
    return first_rate * LEARNING_RATE_DECAY ** int(3 * progress)


@contextmanager
def _training_step(
    net: Gscm, seed: int, step: int, device: torch.device, *, frozen_norm: bool
) -> Iterator[None]:
    """Prepare network and torch for one step, and restore torch's threads and random numbers.

    Encoders may use torch's global generators, which are seeded here.
    """
    net.train()
    if frozen_norm:
        for module in net.modules():
            if isinstance(module, nn.modules.batchnorm._BatchNorm):
                module.eval()
    devices = [device] if device.type == "cuda" else []
    with one_thread(), torch.random.fork_rng(devices=devices):
        torch.manual_seed(generator_for(seed, step, "network").initial_seed())
        try:
            yield
        except torch.linalg.LinAlgError as error:  # pyright: ignore[reportPrivateImportUsage]
            raise StyleError(
                f"the pictures are no longer numbers in step {step + 1} ({error}): train with a "
                f"smaller learning rate"
            ) from error


def _check_loss(loss: Tensor, terms: Mapping[str, Tensor], step: int) -> None:
    """Refuse a loss that is not a number."""
    if not math.isfinite(loss.item()):
        terms_text = ", ".join(f"{name} {term.item():.4g}" for name, term in terms.items())
        raise StyleError(
            f"the loss became {loss.item()} in step {step + 1} ({terms_text}): train with a "
            f"smaller learning rate"
        )


def score_photos(net: Gscm, photos: UInt8[Tensor, "P 3 S S"]) -> dict[str, float]:
    """Return mean PSNR (dB) of photos in styles with a known right result, by name.

    The names are those of `augment.effects.style.pairs`; scores of the closed form have the prefix
    mkl_. With fewer than two photos the result is empty. The network is moved to the CPU.
    """
    if len(photos) < 2:
        return {}
    pictures = photos.float() / 255
    with inference(net.cpu()):
        network_scores = score_pairs(network_method(net), pictures, repeats=2)
        closed_form_scores = score_pairs(closed_form_method(), pictures, repeats=2)
    return network_scores | {f"mkl_{name}": value for name, value in closed_form_scores.items()}
