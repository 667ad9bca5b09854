"""What `climategs style train` can be asked for. Imports stay inside functions, so that `--help`
answers at once.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from tyro.conf import arg

from tools.fit_options import check_choice, check_length, check_range, resolved_uri, value_or
from tools.output import JsonFile, write_json

if TYPE_CHECKING:
    from augment.effects.style.pairs import PairWeights
    from augment.effects.style.train import StyleTrainConfig

SIZES_PX = {"small": 128, "b0": 256}  # the small encoder looks at 64 px, whatever it is given
_Files = Annotated[tuple[Path, ...], arg(metavar="PATH [PATH ...]")]
_Scenes = Annotated[tuple[str, ...], arg(name="scene", metavar="URI [URI ...]")]


@dataclass(frozen=True)
class StyleTrainOptions:
    """Train the network that turns a style image into a colour map, on photos and scenes.

    Run it again to go on after an interruption; the result is the same to the bit. Ctrl-C stops
    after the current step and keeps what is there.

    Args:
        out: The folder for the network, its checkpoint, curves and report.
        photos: Image files, and folders of them.
        scenes: Scenes whose views are learnt from, as for render.
        minutes: How long to train, 10 by default.
        steps: How many steps instead. The same steps and seed give the same bytes.
        encoder: The small one for a CPU, or EfficientNet-B0.
        matrix: 3x4 maps with an offset, or 3x3 as in the paper.
        encoder_weights: EfficientNet-B0's weights, trained on ImageNet.
        vgg: Weights of VGG-19 for the style loss; without them a bank of filters stands in.
        size_px: Of the square pictures; the encoder's usual one by default.
        views: Most views of a scene.
        seed: Of everything random.
        learning_rate: Adam's; the encoder's usual one by default.
        decay: What the learning rate is multiplied by after each third of the steps.
        warm_up: Share of the steps that learn the cycle alone.
        style: Weight of the style loss.
        consistency: Weight of the loss in content space.
        cycle: Weight of the cycle's loss.
        pairs: Weight of recoloured pairs of photos, whose perfect result is known.
        pair_weights: Of the losses of pairs, as same=1,look=2; the others keep theirs.
        batch: Transfers a step.
        pair_batch: Pairs a step.
        scene_share: Share of the transfers whose content is a view of a scene.
        holdout: Every so many photos are kept for scores; 0 for none.
        half_precision: Write the network's numbers in 16 bits.
        through: Render mapped Gaussians for every step, or map pictures rendered once.
        device: Where torch trains: cpu, or cuda, where through renderer renders on the GPU, too.
        overwrite: Begin anew and replace what is there.
        json_file: Also write the report to this file.
    """

    out: Path
    photos: _Files = ()
    scenes: _Scenes = ()
    minutes: float | None = None
    steps: int | None = None
    encoder: Literal["small", "b0"] = "small"
    matrix: Literal["3x4", "3x3"] = "3x4"
    encoder_weights: Path | None = None
    vgg: Path | None = None
    size_px: int | None = None
    views: int = 24
    seed: int = 0
    learning_rate: float | None = None
    decay: float = 0.1
    warm_up: float = 0.1
    style: float = 1.0
    consistency: float = 10.0
    cycle: float = 10.0
    pairs: float = 1.0
    pair_weights: str = ""
    batch: int = 2
    pair_batch: int = 4
    scene_share: float = 0.5
    holdout: int = 8
    half_precision: bool = False
    through: Literal["picture", "renderer"] = "picture"
    device: str = "cpu"
    overwrite: bool = False
    json_file: JsonFile = None

    def __post_init__(self) -> None:
        from augment.errors import ClimateGSError

        if not self.scenes and not self.photos:
            raise ClimateGSError(
                "there is nothing to learn from: give --photos FOLDER, --scene URI, or both"
            )
        check_length(self)
        check_choice(self, "encoder", tuple(SIZES_PX))
        if self.encoder_weights is not None and self.encoder != "b0":
            raise ClimateGSError("--encoder-weights are EfficientNet-B0's: add --encoder b0")
        for name in ("encoder_weights", "vgg"):
            path = getattr(self, name)
            if path is not None and not path.is_file():
                raise ClimateGSError(f"--{name.replace('_', '-')}: there is no file {path}")
        check_choice(self, "matrix", ("3x4", "3x3"))
        lowest = {"steps": 1, "size_px": 16, "views": 1, "holdout": 0, "seed": 0}
        for name, low in lowest.items():
            check_range(self, name, f"at least {low}", low)
        if self.through == "renderer" and not self.scenes:
            raise ClimateGSError("--through renderer is for scenes: add --scene URI")
        try:
            self.config(self.steps or 1)
        except ValueError as error:
            raise ClimateGSError(f"--{error}") from error

    def run(self) -> int:
        """The command. Returns its exit code."""
        from tools.style_train import train_style

        outcome = train_style(self)
        write_json(self.json_file, outcome.report)
        return outcome.code

    @property
    def picture_px(self) -> int:
        return self.size_px or SIZES_PX[self.encoder]

    def config(self, steps: int) -> StyleTrainConfig:
        """The trainer's configuration for this many steps."""

        from augment.effects.style.train import LEARNING_RATES, StyleTrainConfig

        known = {field.name for field in dataclasses.fields(StyleTrainConfig)}
        own = {f.name: getattr(self, f.name) for f in dataclasses.fields(self) if f.name in known}
        rate = value_or(self.learning_rate, LEARNING_RATES[self.encoder])
        weights = parse_pair_weights(self.pair_weights)
        own |= {"steps": steps, "learning_rate": rate, "pair_weights": weights}
        return StyleTrainConfig(**own)

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


def parse_pair_weights(text: str) -> PairWeights:
    """`same=1,look=2`: the default weights but for those.

    Raises:
        ClimateGSError: not of this form, or a loss of another name.
    """
    from augment.effects.style.pairs import PairWeights
    from augment.errors import ClimateGSError

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
