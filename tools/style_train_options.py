"""What `climategs style train` was asked for: checked, and comparable with an earlier run's."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from augment.effects.style.network import ENCODERS
from augment.effects.style.pairs import PairWeights
from augment.effects.style.train import LEARNING_RATES, StyleTrainConfig
from augment.errors import ClimateGSError
from tools.fit_options import resolved_uri

DEFAULT_MINUTES = 10.0
SIZES_PX = {"small": 128, "b0": 256}  # the small encoder looks at 64 px, whatever it is given
_FILES = ("encoder_weights", "vgg")


@dataclass(frozen=True)
class StyleTrainOptions:
    """The options of one training; see `climategs style train --help`.

    out: the folder to write. scenes: URIs. photos: files and folders; one of the two at least.
    minutes, steps: one of them or neither (10 minutes). matrix: 3x4, or 3x3 as in the paper.
    encoder_weights: of B0, trained on ImageNet. vgg: weights of VGG-19 for L_s; None for the bank
    of filters. size_px: of the square pictures; None for the encoder's usual one. views: most of a
    scene. learning_rate: None for the encoder's usual one. pair_weights: of the losses of pairs, as
    same=1,look=2; what is not named keeps its weight. holdout: every so many photos are kept for
    scores; 0 for none. half_precision: of the file, not of the training. ablations: train without
    each loss, and 3x3, too. The rest is as augment.effects.style.train.StyleTrainConfig has it.

    Raises:
        ClimateGSError: a value outside its range, or two that exclude each other.
    """

    out: Path
    scenes: tuple[str, ...] = ()
    photos: tuple[Path, ...] = ()
    minutes: float | None = None
    steps: int | None = None
    encoder: str = "small"
    matrix: Literal["3x4", "3x3"] = "3x4"
    encoder_weights: Path | None = None
    vgg: Path | None = None
    size_px: int | None = None
    views: int = 24
    seed: int = 0
    learning_rate: float | None = None
    decay: float = StyleTrainConfig.decay
    warm_up: float = StyleTrainConfig.warm_up
    style: float = StyleTrainConfig.style
    consistency: float = StyleTrainConfig.consistency
    cycle: float = StyleTrainConfig.cycle
    pairs: float = StyleTrainConfig.pairs
    pair_weights: str = ""
    batch: int = StyleTrainConfig.batch
    pair_batch: int = StyleTrainConfig.pair_batch
    scene_share: float = StyleTrainConfig.scene_share
    through: Literal["picture", "renderer"] = "picture"
    holdout: int = 8
    device: str = "cpu"
    half_precision: bool = False
    ablations: bool = False
    overwrite: bool = False

    def __post_init__(self) -> None:
        if not self.scenes and not self.photos:
            raise ClimateGSError(
                "there is nothing to learn from: give --photos FOLDER, --scene URI, or both"
            )
        if self.minutes is not None and self.steps is not None:
            raise ClimateGSError("give --minutes or --steps, not both")
        if self.encoder not in ENCODERS:
            raise ClimateGSError(f"--encoder is one of {', '.join(ENCODERS)}; got {self.encoder!r}")
        if self.encoder_weights is not None and self.encoder != "b0":
            raise ClimateGSError("--encoder-weights are EfficientNet-B0's: add --encoder b0")
        for name in _FILES:
            path = getattr(self, name)
            if path is not None and not path.is_file():
                raise ClimateGSError(f"--{name.replace('_', '-')}: there is no file {path}")
        if self.matrix not in ("3x4", "3x3"):
            raise ClimateGSError(f"--matrix is 3x4 or 3x3; got {self.matrix!r}")
        if self.minutes is not None and not (self.minutes > 0 and math.isfinite(self.minutes)):
            raise ClimateGSError(f"--minutes must be a number of minutes > 0; got {self.minutes}")
        for name, least in (
            ("steps", 1),
            ("size_px", 16),
            ("views", 1),
            ("holdout", 0),
            ("seed", 0),
        ):
            value = getattr(self, name)
            if value is not None and value < least:
                raise ClimateGSError(
                    f"--{name.replace('_', '-')} must be at least {least}; got {value}"
                )
        if self.through == "renderer" and not self.scenes:
            raise ClimateGSError("--through renderer is for scenes: add --scene URI")
        try:
            self.config(self.steps or 1)
        except ValueError as error:
            raise ClimateGSError(f"--{error}") from error

    @property
    def picture_px(self) -> int:
        return self.size_px or SIZES_PX[self.encoder]

    @property
    def budget_s(self) -> float | None:
        """Seconds to train for; None where the number of steps is given."""
        if self.steps is not None:
            return None
        return 60 * (DEFAULT_MINUTES if self.minutes is None else self.minutes)

    def config(self, steps: int) -> StyleTrainConfig:
        """The trainer's configuration for this many steps."""
        return StyleTrainConfig(
            steps=steps,
            seed=self.seed,
            learning_rate=LEARNING_RATES[self.encoder]
            if self.learning_rate is None
            else self.learning_rate,
            decay=self.decay,
            warm_up=self.warm_up,
            style=self.style,
            consistency=self.consistency,
            cycle=self.cycle,
            pairs=self.pairs,
            pair_weights=parse_pair_weights(self.pair_weights),
            batch=self.batch,
            pair_batch=self.pair_batch,
            scene_share=self.scene_share,
            through=self.through,
        )

    def settings(self) -> dict[str, Any]:
        """All that decides the result, flat and as JSON keeps it; not how long it is trained."""
        config = dataclasses.asdict(self.config(1))
        del config["steps"]
        config |= {f"pair_weights.{n}": v for n, v in config.pop("pair_weights").items()}
        return {
            "scenes": [uri_text(uri) for uri in self.scenes],
            "photos": [path.resolve().name for path in self.photos],
            "encoder": self.encoder,
            "matrix": self.matrix,
            "encoder_weights": None if self.encoder_weights is None else self.encoder_weights.name,
            "vgg": None if self.vgg is None else self.vgg.name,
            "size_px": self.picture_px,
            "views": self.views,
            "holdout": self.holdout,
            "device": self.device,
            "half_precision": self.half_precision,
            **config,
        }

    def length(self) -> dict[str, float]:
        """How long it was asked to be trained: {"steps": N} or {"minutes": M}."""
        if self.steps is not None:
            return {"steps": self.steps}
        return {"minutes": DEFAULT_MINUTES if self.minutes is None else self.minutes}


def parse_pair_weights(text: str) -> PairWeights:
    """`same=1,look=2`: the default weights but for those.

    Raises:
        ClimateGSError: not of this form, or a loss of another name.
    """
    weights: dict[str, float] = {}
    known = [field.name for field in dataclasses.fields(PairWeights)]
    for item in filter(None, text.split(",")):
        name, _, number = item.partition("=")
        try:
            weights[name] = float(number)
        except ValueError:
            name = ""
        if name not in known:
            raise ClimateGSError(
                f"--pair-weights is LOSS=WEIGHT separated by commas, with LOSS one of "
                f"{', '.join(known)}; got {item!r}"
            )
    return PairWeights(**weights)


def uri_text(uri: str) -> str:
    """A scene's URI without the folders above it: enough to know it by, the same everywhere.

    Raises:
        AdapterError: no such path, or one that is recognised as no scene.
    """
    scheme, path, query = resolved_uri(uri)
    keys = "&".join(f"{name}={value}" for name, value in query.items())
    return f"{scheme}:{Path(path).name}" + (f"?{keys}" if keys else "")
