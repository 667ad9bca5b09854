"""Training of the style network, one step at a time, with the losses of augment.style.losses.

Which pictures a step sees, and how they are recoloured, follows from the seed and the step's number
alone, so a training that was stopped goes on to the same bits. Sums are split among threads, so
torch runs in THREADS of them, however many there are: in one, since what is split here is so small
that two on two busy cores took four times as long.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np
import torch
from torch import Tensor, nn

from augment.errors import StyleError
from augment.style.features import FeatureExtractor
from augment.style.losses import (
    Transfer,
    color_distance,
    picture_distance,
    style_loss,
    weighted_sum,
)
from augment.style.network import Gscm, compose
from augment.style.scene_views import folded_pictures, rendered_pictures
from augment.style.train_config import StyleTrainConfig, Through
from augment.style.train_pool import Draw, Recolor, TrainingPool, generator_for

THREADS = 1
CYCLE, CONSISTENCY, STYLE, PAIRS = "cycle", "consistency", "style", "pairs"


@runtime_checkable
class PairLoss(Protocol):
    """The loss of a batch of self-supervised pairs of pictures, drawn with the generator."""

    def __call__(self, net: Gscm, generator: torch.Generator, batch: int) -> Tensor: ...


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
    """Trains `net` in place.

    pairs: None where there are no photos. frozen_norm: keep the statistics of batch normalisation,
    of an encoder that came with some. device: torch's name of where to compute and to keep the
    pool; on a GPU it must be the current one, whose kernels render. What a step draws is the same
    everywhere; bits are promised on "cpu" alone.
    """

    def __init__(
        self,
        net: Gscm,
        pool: TrainingPool,
        config: StyleTrainConfig,
        features: FeatureExtractor,
        *,
        recolor: Recolor,
        pairs: PairLoss | None = None,
        frozen_norm: bool = False,
        device: str = "cpu",
    ) -> None:
        self.net = net.to(device)
        self.pool = pool.to(device)
        self.config = config
        self.step = 0
        self._features = features.to(device)
        self._recolor = recolor
        self._pairs = pairs if config.pairs > 0 else None
        self._frozen_norm = frozen_norm
        self._device = device
        self._names = [name for name, p in net.named_parameters() if p.requires_grad]
        self._parameters = [p for p in net.parameters() if p.requires_grad]
        self._adam = torch.optim.Adam(self._parameters, lr=config.learning_rate)

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
            loss = weighted_sum(terms, self._weights(step))
            value = float(loss.detach())
            if not math.isfinite(value):
                raise StyleError(
                    f"the loss became {value} in step {step + 1} ("
                    + ", ".join(
                        f"{name} {float(term.detach()):.4g}" for name, term in terms.items()
                    )
                    + "): train with a smaller learning rate"
                )
            self._adam.zero_grad(set_to_none=True)
            loss.backward()
            nn.utils.clip_grad_norm_(self._parameters, config.gradient_limit)
            for group in self._adam.param_groups:
                group["lr"] = config.learning_rate_at(step)
            self._adam.step()
        self.step += 1
        facts = {name: float(term.detach()) for name, term in terms.items()}
        return StepRecord(self.step, value, facts)

    def state(self) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Copies of all arrays, and facts, from which `load_state` goes on to the same bits."""
        arrays = {f"net.{n}": _array(t) for n, t in self.net.state_dict().items()}
        for name, parameter in zip(self._names, self._parameters, strict=True):
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
        for name, parameter in zip(self._names, self._parameters, strict=True):
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
            recolor=self._recolor,
        )
        warming_up = config.is_warming_up(step)
        terms = paper_terms(
            self.net, draw, self._features, only_cycle=warming_up, through=config.through
        )
        if self._pairs is not None and not warming_up:
            generator = generator_for(config.seed, step, "pairs")
            terms[PAIRS] = self._pairs(self.net, generator, config.pair_batch)
        return terms

    def _weights(self, step: int) -> dict[str, float]:
        config = self.config
        if config.is_warming_up(step):
            return {CYCLE: config.cycle}
        return {
            CYCLE: config.cycle,
            CONSISTENCY: config.consistency,
            STYLE: config.style,
            PAIRS: config.pairs,
        }

    def _train_mode(self) -> None:
        self.net.train()
        if self._frozen_norm:
            for module in self.net.modules():
                if isinstance(module, nn.modules.batchnorm._BatchNorm):
                    module.eval()


def transfer_maps(
    net: Gscm, draw: Draw, *, through: Through, only_cycle: bool = False
) -> tuple[Transfer, Tensor | None]:
    """The maps of every item (augment.style.losses), and R(Y_s); of the cycle alone where asked."""
    f_c, f_s = net.encode(torch.cat([draw.pictures, draw.styles.clamp(0, 1)]))
    count = len(draw.pictures)
    content, own, other = (
        net.content_map(f_c[:count]),
        net.style_map(f_s[:count]),
        net.style_map(f_s[count:]),
    )
    cycled = compose(own, content)
    if only_cycle:
        return Transfer(content, content, content, cycled), None
    styled = compose(other, content)
    rendered = _pictures(draw, styled, through)
    seen, transferred = rendered.clamp(0, 1), styled  # an encoder's pictures end at 0 and 1
    if net.moments:
        # No gradient passes a picture's moments, so a map that Z_s follows would not be seen to do
        # so, and L_con would bend Y_s instead (by 2 dB of `same`): it teaches the way back alone.
        seen, transferred = seen.detach(), styled.detach()
    back, _ = net.encode(seen)
    returned = compose(net.content_map(back), transferred)
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
        CYCLE: color_distance(draw.colors.mapped(maps.cycled), draw.colors)
        + picture_distance(cycled, draw.pictures)
    }
    if rendered is None:
        return terms
    colors = draw.colors.mapped(maps.content), draw.colors.mapped(maps.returned)
    pictures = _pictures(draw, maps.content, through), _pictures(draw, maps.returned, through)
    terms[CONSISTENCY] = color_distance(*colors) + picture_distance(*pictures)
    terms[STYLE] = style_loss(features(rendered), features(draw.styles))
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
