"""The network that is measured: a checkpoint, or a random one where there is none."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import nn

from augment.effects.style.network import SHIPPED, Gscm, load_network, network_facts

_SEED = 0
_HEAD = 0.02  # standard deviation of a random head's weights; a new one's are 0, and map nothing


@dataclass(frozen=True, eq=False)
class BenchNetwork:
    """is_trained: whether it is a checkpoint. facts: what to say of it. held_out: names of photos
    with their folder's, such as kodak/01.jpg, that it was not trained on, where its file says so.
    """

    net: Gscm
    is_trained: bool
    facts: dict[str, Any]
    held_out: tuple[str, ...] = ()


def bench_network(checkpoint: Path | None) -> BenchNetwork:
    """Of a checkpoint; None for the shipped one, and for a random one where none is shipped.

    Raises:
        StyleError: there is no such checkpoint, or it is none.
    """
    if checkpoint is None and not SHIPPED.is_file():
        return BenchNetwork(random_network(), False, {"name": "random weights", "encoder": "small"})
    net, found = load_network(checkpoint), network_facts(checkpoint)
    name = (checkpoint or SHIPPED).name
    weights = sum(value.numel() for value in net.state_dict().values())
    facts = {"name": name, "weights": weights, **{k: found[k] for k in ("encoder", "k", "offset")}}
    data = found["about"].get("data", {}) if isinstance(found.get("about"), dict) else {}
    held_out = data.get("held_out", ()) if isinstance(data, dict) else ()
    names = tuple(map(str, held_out)) if isinstance(held_out, list) else ()
    return BenchNetwork(net, True, facts, names)


def random_network(encoder: str = "small", *, offset: bool = True) -> Gscm:
    """One that maps pictures to something else each, the same every time; torch's global generator
    is left as it was.
    """
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(_SEED)
        net = Gscm(encoder, offset=offset)
        nn.init.normal_(net.head.weight, std=_HEAD)
    return net.eval().requires_grad_(False)
