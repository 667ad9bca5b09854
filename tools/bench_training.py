"""The worked example: a network trained on clean images, and one on weather, tested on both."""

from __future__ import annotations

import dataclasses
import os
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tqdm import tqdm

from adapters.base import open_scene
from augment.jobs.render_job import SceneLoader
from tools.machine import load_average, machine_facts
from tools.training_case import WHOLE, TrainingCase
from tools.training_data import CLASSES, Views, generate, read_views
from tools.training_network import SmallUNet, new_network
from tools.training_run import REGIMES, deterministic, train
from tools.training_scores import evaluate, summarise


@dataclass(frozen=True, eq=False)
class Trained:
    """figures: plain numbers, for JSON. test: the views tested on. networks: by regime, of the
    first seed, for pictures.
    """

    figures: dict[str, Any]
    test: Views
    networks: dict[str, SmallUNet]


def bench_training(
    folder: Path,
    case: TrainingCase = WHOLE,
    *,
    scene_loader: SceneLoader = open_scene,
    at_once: int | None = None,
    progress: bool = True,
) -> Trained:
    """Render what is missing, train every regime from every seed, and test on other scenes.

    folder: of the images. at_once: how many trainings run side by side, each in one thread, so
    that the figures do not depend on it; None for as many as there are cores.
    """
    machine = machine_facts()
    clock = _Clock()
    generated = generate(case, folder, scene_loader=scene_loader, progress=progress)
    clock.timed("generate")
    views = read_views(folder, case.train_scenes)
    test = read_views(folder, case.test_scenes)
    clock.timed("read")
    runs = _train_all(case, views, test, at_once or machine.cores, progress)
    clock.timed("train and test")
    scores = {regime: [runs[regime, seed].scores for seed in case.seeds] for regime in REGIMES}
    first = {regime: runs[regime, case.seeds[0]].network for regime in REGIMES}
    figures = {
        "machine": dataclasses.asdict(machine),
        "case": dataclasses.asdict(case),
        "generated": dataclasses.asdict(generated),
        "views": {"train": len(views), "test": len(test)},
        "parameters": sum(p.numel() for p in first[REGIMES[0]].parameters()),
        "class_shares": {"train": _shares(views), "test": _shares(test)},
        "draws": {"train": _draws(views), "test": _draws(test)},
        "seconds": clock.seconds,
        "cpu_seconds": clock.cpu_seconds,
        "runs": [
            {
                "regime": regime,
                "seed": seed,
                "last_loss": float(run.losses[-max(len(run.losses) // 10, 1) :].mean()),
                "seconds": run.seconds,
                "scores": run.scores,
            }
            for (regime, seed), run in runs.items()
        ],
        "summary": summarise(scores, case),
        "load_after": load_average(),
    }
    return Trained(figures, test, first)


@dataclass(frozen=True, eq=False)
class _Run:
    """seconds: of the training alone."""

    network: SmallUNet
    losses: np.ndarray
    scores: dict[str, Any]
    seconds: float


def _train_all(
    case: TrainingCase, views: Views, test: Views, at_once: int, progress: bool
) -> dict[tuple[str, int], _Run]:
    """By regime and seed."""

    def one(regime: str, seed: int, network: SmallUNet) -> _Run:
        started = time.perf_counter()
        losses = train(network, views, case, regime, seed)
        return _Run(network, losses, evaluate(network, test, case), time.perf_counter() - started)

    work = [(regime, seed) for seed in case.seeds for regime in REGIMES]
    # Made here, one after the other: all threads share the random state that makes first weights.
    networks = [new_network(len(CLASSES), case.widths, seed) for _, seed in work]
    # One thread for each training: two small ones side by side finish sooner than one after the
    # other with two threads each, which mostly wait for each other.
    with (
        deterministic(),
        ThreadPoolExecutor(at_once, initializer=torch.set_num_threads, initargs=(1,)) as pool,
    ):
        runs = list(
            tqdm(
                pool.map(one, *zip(*work, strict=True), networks),
                total=len(work),
                unit="training",
                disable=not progress,
            )
        )
    return dict(zip(work, runs, strict=True))


def _shares(views: Views) -> dict[str, float]:
    """Of the pixels that count, how many are of each class."""
    counts = torch.bincount(views.labels[:, 0].flatten().long(), minlength=256)[: len(CLASSES)]
    return dict(zip(CLASSES, (counts / counts.sum()).tolist(), strict=True))


def _draws(views: Views) -> dict[str, list[str]]:
    """Variants of each scene."""
    return {name[0]: list(own) for name, own in zip(views.names, views.variants, strict=True)}


class _Clock:
    """Wall and processor seconds of one part after the other."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self.cpu_seconds: dict[str, float] = {}
        self._last = self._now()

    def timed(self, part: str) -> None:
        now = self._now()
        self.seconds[part] = now[0] - self._last[0]
        self.cpu_seconds[part] = now[1] - self._last[1]
        self._last = now

    @staticmethod
    def _now() -> tuple[float, float]:
        return time.perf_counter(), sum(os.times()[:4])
