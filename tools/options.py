"""What the longer commands can be asked for. Heavy imports stay inside functions, so that `--help`
answers at once.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self, TypeVar, get_args

from pydantic import BaseModel, ConfigDict, ValidationError, model_validator
from tyro.conf import Positional, arg

from tools.output import JsonFile, write_json

if TYPE_CHECKING:
    from pydantic import ModelWrapValidatorHandler
    from pydantic_core import ErrorDetails

    from adapters.training_views.depth_priors import DepthPriors
    from augment.effects.style.pairs import PairWeights
    from augment.effects.style.train import StyleTrainConfig
    from augment.reconstruct.config import FitConfig

DEFAULT_MINUTES = 10.0
DEPTH_KINDS = ("sparse", "metric", "relative")
Densify = Literal["absgrad", "mcmc", "none"]
Device = Literal["cpu", "cuda"]
_Value = TypeVar("_Value")


class Command(BaseModel):
    """What a command can be asked for: each field is an option, and says which values it takes.

    The docstring of each command is its help. `run` does it and returns the exit code.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, defer_build=True)

    @model_validator(mode="wrap")
    @classmethod
    def _name_options(cls, values: Any, handler: ModelWrapValidatorHandler[Self]) -> Self:
        """Refuses what is wrong in the words of the command line."""
        try:
            return handler(values)
        except ValidationError as error:
            from augment.errors import ClimateGSError

            raise ClimateGSError("; ".join(map(cls._refusal, error.errors()))) from None

    @classmethod
    def _refusal(cls, error: ErrorDetails) -> str:
        text = error["msg"].removeprefix("Value error, ")
        if not error["loc"]:  # of several options together
            return text
        name = str(error["loc"][0])
        known = cls.model_fields.get(name)
        named = [getattr(each, "name", None) for each in (known.metadata if known else ())]
        option = next(filter(None, named), name).replace("_", "-")
        if (rule := text.removeprefix("Input should be ")) == text:
            return f"--{option} {text}"
        return f"--{option} must be {rule}; got {error['input']}"

    def run(self) -> int:
        """The command. Returns its exit code."""
        raise NotImplementedError


@dataclass(frozen=True)
class FitOptions:
    """Reconstruct a scene of Gaussians from recorded images, LiDAR and boxes.

    Run it again to go on after an interruption; the result is the same to the bit. Ctrl-C stops
    after the current step, and the scene as far as it is fitted is written.

    Args:
        scene: Raw data: pandaset:PATH/002, recording:PATH, or a path that is recognised.
        out: The scene's folder; OUT.fit beside it holds the checkpoint and the report.
        minutes: How long to optimise, 10 by default. Opening and the report come on top.
        steps: How many steps instead. The same steps and seed give the same bytes.
        scale: Resolution of the images that are learnt from, relative to the recorded.
        cameras: Camera names separated by commas, or all.
        holdout: Which frames are kept for the report: every-2nd, every-8th, ..., or none.
        seed: Of everything random.
        depth_weight: How much depth priors count. 0 switches them off.
        sh_degree: Highest band of spherical harmonics, 0 to 3.
        max_splats: Splats are not added beyond this number.
        densify: How splats are added.
        image_cache_mb: Memory for decoded images. The result does not depend on it.
        depth: Depth priors: none, or kinds separated by commas: lidar, metric:DIR (depth maps as
            render writes them), relative:DIR (monocular networks), sparse:DIR (lidar_depth).
        ego_masks: A folder of CAMERA.png, white where the image shows the recording car.
        truth: The procedural street that a recording was rendered from: the report then holds
            the error against its exact depth.
        device: Where views are rendered: cpu, or cuda by gsplat (an extra), of which no two runs
            give the same bytes.
        overwrite: Begin anew and replace what is there.
        json_file: Also write the report to this file.
    """

    scene: Positional[str]
    out: Path
    minutes: float | None = None
    steps: int | None = None
    scale: float = 0.25
    cameras: str = "all"
    holdout: str = "every-2nd"
    seed: int = 0
    depth_weight: float | None = None
    sh_degree: int | None = None
    max_splats: int | None = None
    densify: Densify = "absgrad"
    image_cache_mb: int = 1024
    depth: str = "lidar"
    ego_masks: Path | None = None
    truth: str | None = None
    device: Device = "cpu"
    overwrite: bool = False
    json_file: JsonFile = None

    def __post_init__(self) -> None:
        from adapters.training_views.views import holdout_step
        from augment.errors import ClimateGSError

        check_length(self)
        holdout_step(self.holdout)
        check_range(self, "steps", "a number of steps >= 1", 1)
        check_range(self, "scale", "above 0 and at most 1", 0, 1, above=True)
        check_range(self, "seed", ">= 0", 0)
        check_range(self, "depth_weight", ">= 0 (0 switches it off)", 0)
        check_range(self, "sh_degree", "0, 1, 2 or 3", 0, 3)
        check_range(self, "max_splats", "a number of splats >= 1", 1)
        check_range(self, "image_cache_mb", "megabytes, >= 0", 0)
        check_choice(self, "densify", get_args(Densify))
        check_choice(self, "device", get_args(Device))
        if not all(self.cameras.split(",")):
            raise ClimateGSError("--cameras is names separated by commas, or all")
        parse_depth(self.depth)
        if self.truth is not None:
            from tools.fit_report import open_street

            open_street(self.truth)
        if self.ego_masks is not None and not self.ego_masks.is_dir():
            raise ClimateGSError(f"--ego-masks: there is no folder {self.ego_masks}")

    def run(self) -> int:
        """The command. Returns its exit code."""
        from tools.fit import fit_scene

        outcome = fit_scene(self)
        write_json(self.json_file, outcome.report)
        return outcome.code

    @property
    def camera_names(self) -> tuple[str, ...] | None:
        """None for all."""
        return None if self.cameras == "all" else tuple(self.cameras.split(","))

    def config(self, steps: int) -> FitConfig:
        """The optimiser's configuration for this many steps."""
        from augment.reconstruct.config import FitConfig

        default = FitConfig()
        most = value_or(self.max_splats, default.densify.max_splats)
        growth = dataclasses.replace(default.densify, max_splats=most)
        if self.densify == "none":
            # Its part of the run ends before it starts.
            growth = dataclasses.replace(growth, start=1.0, stop=0.0)
        else:
            growth = dataclasses.replace(growth, method=self.densify)
        depth = value_or(self.depth_weight, default.loss.depth)
        return dataclasses.replace(
            default,
            steps=steps,
            seed=self.seed,
            sh_degree=value_or(self.sh_degree, default.sh_degree),
            loss=dataclasses.replace(default.loss, depth=depth),
            densify=growth,
        )

    def settings(self) -> dict[str, Any]:
        """All that decides the result, flat and as JSON keeps it; not how long it is fitted."""
        from adapters.uri import format_uri

        config = dataclasses.asdict(self.config(1))
        del config["steps"]
        return {
            "scene": format_uri(*resolved_uri(self.scene)),
            "cameras": self.cameras,
            "scale": self.scale,
            "holdout": self.holdout,
            "densify": self.densify,
            "depth": _depth_text(parse_depth(self.depth)),
            "ego_masks": None if self.ego_masks is None else str(self.ego_masks.absolute()),
            **({} if self.device == "cpu" else {"device": self.device}),
            **_flat(config),
        }


def names_in(text: str) -> tuple[str, ...] | None:
    """Of names separated by commas; None for all."""
    return None if text == "all" else tuple(text.split(","))


def check_range(
    options: Any, name: str, text: str, low: float, high: float = math.inf, above: bool = False
) -> None:
    """Refuse an option outside [low, high], or (low, high] where it is to be above; None is none.

    Raises:
        ClimateGSError: it is outside, infinite or no number; text says what it must be.
    """
    from augment.errors import ClimateGSError

    value = getattr(options, name)
    if value is None:
        return
    inside = low < value <= high if above else low <= value <= high
    if not inside or value == math.inf:  # NaN is not inside either
        raise ClimateGSError(f"--{name.replace('_', '-')} must be {text}; got {value}")


def check_choice(options: Any, name: str, choices: tuple[str, ...]) -> None:
    """Refuse an option that is none of the choices.

    Raises:
        ClimateGSError: it is none.
    """
    from augment.errors import ClimateGSError

    if (value := getattr(options, name)) not in choices:
        raise ClimateGSError(f"--{name} is one of {', '.join(choices)}; got {value!r}")


def check_length(options: Any) -> None:
    """Refuse minutes beside steps, and minutes that are no time.

    Raises:
        ClimateGSError: they are.
    """
    from augment.errors import ClimateGSError

    if options.minutes is not None and options.steps is not None:
        raise ClimateGSError("give --minutes or --steps, not both")
    check_range(options, "minutes", "a number of minutes > 0", 0, above=True)


def length_of(options: Any) -> dict[str, float]:
    """How long a training was asked to take: {"steps": N} or {"minutes": M}."""
    if options.steps is not None:
        return {"steps": options.steps}
    return {"minutes": value_or(options.minutes, DEFAULT_MINUTES)}


def parse_depth(text: str) -> DepthPriors:
    """`lidar`, `none`, or kinds separated by commas: lidar, sparse:DIR, metric:DIR, relative:DIR; a
    DIR alone is metric. What they are: `adapters.training_views.depth_priors.DepthPriors`.

    Raises:
        ClimateGSError: another kind, one given twice, or no such folder.
    """
    from adapters.training_views.depth_priors import DepthPriors
    from augment.errors import ClimateGSError

    if text == "none":
        return DepthPriors(lidar=False)
    found: dict[str, Path | bool] = {}
    for item in text.split(","):
        kind, colon, folder = item.partition(":")
        if item == "lidar":
            name, value = "lidar", True
        else:
            if not colon or kind not in DEPTH_KINDS:
                kind, folder = "metric", item
            name, value = f"{kind}_dir", Path(folder).absolute()
            if not folder or not value.is_dir():
                raise ClimateGSError(
                    f"--depth is lidar, none, or lidar and folders of depth maps such as "
                    f"lidar,relative:DIR (kinds: {', '.join(DEPTH_KINDS)}); there is no folder "
                    f"{folder!r}"
                )
        if name in found:
            raise ClimateGSError(f"--depth {text}: {kind} is given twice")
        found[name] = value
    return DepthPriors(**{"lidar": False, **found})


def resolved_uri(uri: str) -> tuple[str, str, dict[str, str]]:
    """Scheme, absolute path and query: the same scene from whatever folder it is named.

    Raises:
        AdapterError: no such path, or a path that is recognised as no scene.
    """
    from adapters.base import recognise
    from adapters.uri import parse_uri

    scheme, path, query = parse_uri(uri)
    if scheme is None:
        scheme = recognise(Path(path))
    place = Path(path)
    if place.exists():
        # Without `..`, but with the last name as given, even of a link: it names the scene.
        whole = place.name in ("", "..")
        path = str(place.resolve() if whole else place.parent.resolve() / place.name)
    return scheme, path, query


def value_or(value: _Value | None, default: _Value) -> _Value:
    return default if value is None else value


def _flat(nested: Mapping[str, Any], above: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for name, value in nested.items():
        if isinstance(value, Mapping):
            flat |= _flat(value, f"{above}{name}.")
        else:
            flat[f"{above}{name}"] = value
    return flat


def _depth_text(priors: DepthPriors) -> str:
    folders = {kind: getattr(priors, f"{kind}_dir") for kind in DEPTH_KINDS}
    named = [f"{kind}:{folder}" for kind, folder in folders.items() if folder is not None]
    return ",".join((["lidar"] if priors.lidar else []) + named) or "none"


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
        from tools.style import train_style

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
