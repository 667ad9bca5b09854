"""Stand-ins for the parts of a reconstruction: a trainer that learns one colour, and its views."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from augment.files.scene_file import FORMAT
from augment.reconstruct.config import FitConfig
from augment.reconstruct.trainer import StepRecord
from augment.reconstruct.view import RecordedView, ViewKey
from augment.scene.cameras import Camera, Frame
from augment.scene.scene import Scene
from augment.scene.sky import ConstantSky
from tests.scenes import one_gaussian
from tools import fit

SIZE = (6, 8)


class FakeTrainer:
    """Moves a colour towards the views' by random amounts: state, seed and order all matter."""

    def __init__(self, scene: Scene, source: FakeViews, config: FitConfig, steps: int) -> None:
        self.step, self._steps = 0, steps
        self._scene, self._source = scene, source
        self._rng = np.random.default_rng(config.seed)
        self._colour = np.zeros(3, np.float32)
        self._order: list[int] = []
        self.before_step: Callable[[int], None] = lambda step: None

    def run_step(self) -> StepRecord:
        self.before_step(self.step)
        if not self._order:
            self._order = self._rng.permutation(len(self._source.train)).tolist()
        key = self._source.train[self._order.pop()]
        target = self._source.load(key).rgb.mean((0, 1)) / np.float32(255)
        rate = np.float32(self._rng.random() * (1 - self.step / self._steps))
        self._colour += rate * (target - self._colour).astype(np.float32)
        self.step += 1
        loss = float(np.abs(target - self._colour).mean())
        times = {"load": 0.001, "forward": 0.002}
        return StepRecord(self.step, key, loss, loss, 0.5, 0.1, 0.0, 400, times)

    def scene(self) -> Scene:
        sh = torch.from_numpy(self._colour.copy()).expand(1, 1, 3).contiguous()
        return dataclasses.replace(
            self._scene, background=dataclasses.replace(self._scene.background, sh=sh)
        )

    def state(self) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        facts = {"rng": self._rng.bit_generator.state, "order": self._order, "step": self.step}
        return {"colour": self._colour, "empty": np.zeros((0, 3), np.int16)}, facts

    def load_state(self, arrays: dict[str, np.ndarray], facts: dict[str, Any]) -> None:
        self._colour = arrays["colour"]
        self._order, self.step = facts["order"], facts["step"]
        self._rng.bit_generator.state = facts["rng"]


class FakeViews:
    """Images of one colour each; every second frame is held out where `holdout` says so."""

    def __init__(self, scene: Scene, holdout: str) -> None:
        keys = [ViewKey(f.index, name) for f in scene.frames for name in f.cameras]
        held = {f.index for f in scene.frames[1::2]} if holdout == "every-2nd" else set()
        self.train = tuple(k for k in keys if k.frame not in held)
        self.test = tuple(k for k in keys if k.frame in held)
        self.problems = ("a view lacks its mask",)
        self._scene = scene

    def camera(self, key: ViewKey) -> Camera:
        return self._scene.frame(key.frame).cameras[key.camera]

    def load(self, key: ViewKey) -> RecordedView:
        shade = 40 + 10 * key.frame + (5 if key.camera == "left" else 0)
        return RecordedView(
            camera=self.camera(key),
            rgb=np.full((*SIZE, 3), shade, np.uint8),
            weight=np.ones(SIZE, np.float32),
            sky=np.zeros(SIZE, bool),
            depth_pixels=np.zeros(0, np.int32),
            depth_m=np.zeros(0, np.float32),
            depth_weight=np.zeros(0, np.float32),
        )


def fake_scene(source: str, numbers: Sequence[int] = range(6), recorded: bool = True) -> Scene:
    pose = torch.eye(4, dtype=torch.float64)

    def frame(number: int) -> Frame:
        cameras = {
            name: Camera(name, SIZE[1], SIZE[0], 8.0, 8.0, 4.0, 3.0, pose)
            for name in ("front", "left")
        }
        paths = {name: f"{number}-{name}.png" for name in cameras} if recorded else {}
        return Frame(number, number, pose, cameras, paths)

    return Scene(
        name="street",
        source=source,
        background=one_gaussian(),
        actors=(),
        sky=ConstantSky(torch.zeros(3)),
        frames=tuple(frame(n) for n in numbers),
        problems=("frame 3 has no sweep", "a view lacks its mask"),
    )


@dataclass
class Fakes:
    """Stand-ins in `tools.fit` over one fake drive, and what was asked of them."""

    numbers: Sequence[int] = range(6)
    recorded: bool = True
    before_step: Callable[[int], None] = lambda step: None
    opened: list[str] = field(default_factory=list)
    trainers: list[FakeTrainer] = field(default_factory=list)

    def install(self, patch: pytest.MonkeyPatch) -> None:
        stand_ins = {
            "open_scene": self._open,
            "RecordedViews": lambda scene, **options: FakeViews(scene, options["holdout"]),
            "check_views": lambda *_: SimpleNamespace(
                time_offset_s=None, problems=(), report_facts={}
            ),
            "complete_starting_scene": lambda scene, source: scene,
            "Trainer": self._trainer,
            "evaluate_views": lambda *asked, with_flip: asked,
            "mean_scores": _mean_scores,
            "save_scene": _save,
            "write_report": self._report,
        }
        for name, stand_in in stand_ins.items():
            patch.setattr(fit, name, stand_in)

    def _open(self, uri: str) -> Scene:
        self.opened.append(uri)
        return fake_scene(uri, self.numbers, self.recorded)

    def _trainer(
        self, scene: Scene, source: FakeViews, config: FitConfig, steps: int, device: str
    ) -> FakeTrainer:
        trainer = FakeTrainer(scene, source, config, steps)
        trainer.before_step = self.before_step
        self.trainers.append(trainer)
        return trainer

    def _report(
        self,
        folder: Path,
        scene: Scene,
        source: FakeViews,
        history: list,
        facts: dict,
        *,
        test: Any,
    ) -> dict[str, Any]:
        report = {"history": [dict(row) for row in history], **facts}
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "report.json").write_text(json.dumps(report))
        (folder / "report.md").write_text("# Report\n\n| views | PSNR |\n|---|---|\n| 6 | 20.0 |\n")
        return report


def _mean_scores(asked: tuple[Scene, FakeViews, Sequence[ViewKey]]) -> dict[str, float]:
    scene, source, keys = asked
    shades = [source.load(key).rgb.mean() / 255 for key in keys]
    error = np.mean((np.array(shades) - float(scene.background.sh.mean())) ** 2)
    return {"psnr": float(-10 * np.log10(error + 1e-12)), "ssim": 0.5, "depth_median_m": 0.1}


def _save(scene: Scene, folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    colour = scene.background.sh.numpy()
    (folder / "scene.json").write_text(json.dumps({"format": FORMAT, "source": scene.source}))
    (folder / "gaussians.bin").write_bytes(colour.tobytes())
