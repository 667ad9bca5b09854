"""What the longer commands can be asked for. Heavy imports stay inside functions, so that `--help`
answers at once.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self, TypeVar

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError, model_validator
from tyro.conf import Positional, UseAppendAction, arg

from augment.reconstruct.config import FitConfig
from tools.output import JsonFile, write_json

if TYPE_CHECKING:
    from pydantic_core import ErrorDetails

    from adapters.training_views.depth_priors import DepthPriors

DEFAULT_MINUTES = 10.0
DEPTH_KINDS = ("sparse", "metric", "relative")
Device = Literal["cpu", "cuda"]
_Value = TypeVar("_Value")
Overrides = Annotated[tuple[str, ...], UseAppendAction, arg(name="set", metavar="FIELD=VALUE")]


class Command(BaseModel):
    """A command and its options: each field is an option, and says which values it takes.

    The docstring of each command is its help. `run` does it and returns the exit code.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, defer_build=True)

    def __init__(self, **values: Any) -> None:
        """Refuses what is wrong in the words of the command line."""
        try:
            super().__init__(**values)
        except ValidationError as error:
            from augment.errors import ClimateGSError

            raise ClimateGSError("; ".join(map(self._refusal, error.errors()))) from None

    @classmethod
    def _refusal(cls, error: ErrorDetails) -> str:
        text = error["msg"].removeprefix("Value error, ")
        if not error["loc"]:  # of several options together
            return text
        name = str(error["loc"][0])
        field = cls.model_fields.get(name)
        metadata_names = [getattr(item, "name", None) for item in (field.metadata if field else ())]
        option = next(filter(None, metadata_names), name).replace("_", "-")
        if (rule := text.removeprefix("Input should be ")) == text:
            return f"--{option} {text}"
        return f"--{option} must be {rule}; got {error['input']}"

    def run(self) -> int:
        """Run the command and return its exit code."""
        raise NotImplementedError


class SceneCommand(Command):
    """A command that opens scenes.

    Args:
        cache: Take a scene that was built from raw data before from the user's cache folder, and
            keep it there (docs/scenes.md).
    """

    cache: bool = True


class RecipeCommand(SceneCommand):
    """A command that takes recipes.

    Args:
        overrides: Replace a field of each recipe: weather.smog.visibility_m=60, or of a range
            "weather.smog.visibility_m={uniform: [40, 80]}"; weather.smog=null takes the effect out.
    """

    overrides: Overrides = ()


class FitOptions(FitConfig, SceneCommand):
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
        image_cache_mb: Memory for decoded images. The result does not depend on it.
        depth: Depth priors: none, or kinds separated by commas: lidar, metric:DIR (depth maps as
            render writes them), relative:DIR (monocular networks), sparse:DIR (lidar_depth).
        ego_masks: A folder of masks of the recording car (docs/scenes.md): CAMERA.png, white on it,
            or CAMERA.json with polygons.
        truth: The procedural street that a recording was rendered from: the report then holds
            the error against its exact depth.
        device: Where views are rendered: cpu, or cuda by gsplat (an extra), of which no two runs
            give the same bytes.
        overwrite: Begin anew and replace what is there.
        json_file: Also write the report to this file.
    """

    scene: Positional[str]
    out: Path
    minutes: float | None = Field(default=None, gt=0)
    steps: int | None = Field(default=None, ge=1)
    scale: float = Field(default=0.25, gt=0, le=1)
    cameras: str = "all"
    holdout: str = "every-2nd"
    image_cache_mb: int = Field(default=1024, ge=0)
    depth: str = "lidar"
    ego_masks: Path | None = None
    truth: str | None = None
    device: Device = "cpu"
    overwrite: bool = False
    json_file: JsonFile = None

    @model_validator(mode="after")
    def _check(self) -> Self:
        from adapters.training_views.views import holdout_step
        from augment.errors import ClimateGSError

        if self.minutes is not None and self.steps is not None:
            raise ClimateGSError("give --minutes or --steps, not both")
        holdout_step(self.holdout)
        if not all(self.cameras.split(",")):
            raise ClimateGSError("--cameras is names separated by commas, or all")
        parse_depth(self.depth)
        if self.truth is not None:
            from tools.fit_report import open_street

            open_street(self.truth)
        if self.ego_masks is not None and not self.ego_masks.is_dir():
            raise ClimateGSError(f"--ego-masks: there is no folder {self.ego_masks}")
        return self

    def run(self) -> int:
        from tools.fit import fit_scene

        outcome = fit_scene(self)
        write_json(self.json_file, outcome.report)
        return outcome.code

    @property
    def camera_names(self) -> tuple[str, ...] | None:
        """Names of the cameras; None for all."""
        return names_in(self.cameras)

    def settings(self) -> dict[str, Any]:
        """All that decides the result, as JSON keeps it; not how long it is fitted."""
        from adapters.uri import format_uri

        asides = {"out", "minutes", "steps", "image_cache_mb", "truth", "overwrite", "json_file"}
        asides.add("cache")
        return self.model_dump(exclude=asides) | {
            "scene": format_uri(*resolved_uri(self.scene)),
            "depth": _depth_text(parse_depth(self.depth)),
            "ego_masks": None if self.ego_masks is None else str(self.ego_masks.absolute()),
        }


FITTED = "fitted"  # cameras that a scene was made from


def names_in(text: str) -> tuple[str, ...] | None:
    """Split names separated by commas; None for all."""
    return None if text == "all" else tuple(text.split(","))


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
    fields: dict[str, Path | bool] = {}
    for item in text.split(","):
        kind, colon, folder = item.partition(":")
        if item == "lidar":
            name = "lidar"
            value = True
        else:
            if not colon or kind not in DEPTH_KINDS:
                kind = "metric"
                folder = item
            name = f"{kind}_dir"
            value = Path(folder).absolute()
            if not folder or not value.is_dir():
                raise ClimateGSError(
                    f"--depth is lidar, none, or lidar and folders of depth maps such as "
                    f"lidar,relative:DIR (kinds: {', '.join(DEPTH_KINDS)}); there is no folder "
                    f"{folder!r}"
                )
        if name in fields:
            raise ClimateGSError(f"--depth {text}: {kind} is given twice")
        fields[name] = value
    return DepthPriors(**{"lidar": False, **fields})


def resolved_uri(uri: str) -> tuple[str, str, dict[str, str]]:
    """Scheme, absolute path and query: the same scene from whatever folder it is named.

    Raises:
        AdapterError: no such path, or a path that is recognised as no scene.
    """
    from adapters.base import detect_scheme_of_path
    from adapters.uri import parse_uri

    scheme, path, query = parse_uri(uri)
    if scheme is None:
        scheme = detect_scheme_of_path(Path(path))
    place = Path(path)
    if place.exists():
        # Without `..`, but with the last name as given, even of a link: it names the scene.
        has_no_name = place.name in ("", "..")
        path = str(place.resolve() if has_no_name else place.parent.resolve() / place.name)
    return scheme, path, query


def with_ego_masks_key(uri: str, folder: Path | None) -> str:
    """The URI of a scene with the masks of a folder; the URI itself without a folder.

    Raises:
        AdapterError: the URI names a folder of masks already, or is not recognised.
    """
    from adapters.uri import EGO_MASKS_KEY

    return _with_key(uri, EGO_MASKS_KEY, folder, "--ego-masks", "give masks of the recording car")


def with_tracks_key(uri: str, file: Path | None) -> str:
    """The URI of a scene whose actors a file moves; the URI itself without a file.

    Raises:
        AdapterError: the URI names a file of tracks already, or is not recognised.
    """
    from adapters.uri import TRACKS_KEY

    return _with_key(uri, TRACKS_KEY, file, "--tracks", "move actors")


def _with_key(uri: str, key: str, path: Path | None, option: str, purpose: str) -> str:
    """The URI of a scene with a key that names a path; the URI itself without a path."""
    if path is None:
        return uri
    from adapters.uri import format_uri
    from augment.errors import AdapterError

    scheme, scene_path, query = resolved_uri(uri)
    if key in query:
        raise AdapterError(
            f"{option} {path} and {key}={query[key]} in the scene's URI both {purpose}; keep one"
        )
    return format_uri(scheme, scene_path, {**query, key: str(path.absolute())})


def value_or(value: _Value | None, default: _Value) -> _Value:
    return default if value is None else value


def _depth_text(priors: DepthPriors) -> str:
    folders = {kind: getattr(priors, f"{kind}_dir") for kind in DEPTH_KINDS}
    texts = [f"{kind}:{folder}" for kind, folder in folders.items() if folder is not None]
    return ",".join((["lidar"] if priors.lidar else []) + texts) or "none"


# By encoder. The small one looks at 32 px, whatever it is given; the paper's rate is B0's.
SIZES_PX = {"small": 128, "b0": 256}
LEARNING_RATES = {"small": 1e-3, "b0": 1e-4}


def _check_file(path: Path) -> Path:
    if not path.is_file():
        raise ValueError(f"there is no file {path}")
    return path


_Files = Annotated[tuple[Path, ...], arg(metavar="PATH [PATH ...]")]
_Scenes = Annotated[tuple[str, ...], arg(name="scene", metavar="URI [URI ...]")]
_Weights = Annotated[Path, AfterValidator(_check_file)]


class StyleTrainOptions(SceneCommand):
    """Train the network that turns a style image into a colour map, on photos and scenes.

    Ctrl-C stops after the current step and keeps the network as it is then.

    Args:
        out: The folder for the network and its report.
        photos: Image files, and folders of them.
        scenes: Scenes whose views are learnt from, as for render.
        minutes: How long to train, 10 by default.
        steps: How many steps instead. The same steps and seed give the same bytes.
        encoder: The small one for a CPU, or EfficientNet-B0.
        encoder_weights: EfficientNet-B0's weights, trained on ImageNet.
        vgg: Weights of VGG-19 for the style loss; without them a bank of filters stands in.
        size_px: Of the square pictures; the encoder's usual one by default.
        seed: Of everything random.
        learning_rate: Adam's; the encoder's usual one by default.
        device: Where torch trains: cpu, or cuda.
        overwrite: Replace the network that is there.
    """

    out: Path
    photos: _Files = ()
    scenes: _Scenes = ()
    minutes: Annotated[float, Field(gt=0)] | None = None
    steps: Annotated[int, Field(ge=1)] | None = None
    encoder: Literal["small", "b0"] = "small"
    encoder_weights: _Weights | None = None
    vgg: _Weights | None = None
    size_px: Annotated[int, Field(ge=16)] | None = None
    seed: Annotated[int, Field(ge=0)] = 0
    learning_rate: Annotated[float, Field(gt=0)] | None = None
    device: str = "cpu"
    overwrite: bool = False

    @model_validator(mode="after")
    def _fits_together(self) -> Self:
        if not self.scenes and not self.photos:
            raise ValueError(
                "there is nothing to learn from: give --photos FOLDER, --scene URI, or both"
            )
        if self.minutes is not None and self.steps is not None:
            raise ValueError("give --minutes or --steps, not both")
        if self.encoder_weights is not None and self.encoder != "b0":
            raise ValueError("--encoder-weights are EfficientNet-B0's: add --encoder b0")
        return self

    def run(self) -> int:
        from tools.style import train_style

        return 0 if train_style(self)["complete"] else 130

    def settings(self) -> dict[str, Any]:
        """All that decides the result, as JSON keeps it; not how long it is trained."""
        weights = {name: getattr(self, name) for name in ("encoder_weights", "vgg")}
        return {
            **self.model_dump(exclude={"out", "minutes", "steps", "overwrite", "cache"}),
            **{name: None if path is None else path.name for name, path in weights.items()},
            "scenes": [uri_text(uri) for uri in self.scenes],
            "photos": [path.resolve().name for path in self.photos],
            "size_px": value_or(self.size_px, SIZES_PX[self.encoder]),
            "learning_rate": value_or(self.learning_rate, LEARNING_RATES[self.encoder]),
        }


def uri_text(uri: str) -> str:
    """A scene's URI without the folders above it: enough to know it by, the same everywhere.

    Raises:
        AdapterError: no such path, or one that is recognised as no scene.
    """
    scheme, path, query = resolved_uri(uri)
    keys = "&".join(f"{name}={value}" for name, value in query.items())
    return f"{scheme}:{Path(path).name}" + (f"?{keys}" if keys else "")
