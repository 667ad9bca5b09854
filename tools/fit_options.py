"""What `climategs fit` was asked for: checked, turned into a FitConfig, and comparable with what an
earlier run of the same folder was asked for.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from adapters.base import recognise
from adapters.training_views.depth_priors import DepthPriors
from adapters.training_views.views import holdout_step
from adapters.uri import format_uri, parse_uri
from augment.errors import ClimateGSError
from augment.reconstruct.config import DensifyConfig, FitConfig
from augment.reconstruct.renderers import DEVICES
from tools.fit_truth import open_street

DEFAULT_MINUTES = 10.0
DENSIFY = ("absgrad", "mcmc", "none")
DEPTH_KINDS = ("sparse", "metric", "relative")

_Number = TypeVar("_Number", int, float)


@dataclass(frozen=True)
class FitOptions:
    """The options of one reconstruction; see `climategs fit --help`.

    scene: URI of the raw data. minutes, steps: one of them or neither (10 minutes). cameras: names,
    None for all. depth_weight, sh_degree, max_splats: None for FitConfig's. depth: see parse_depth.
    device: where views are rendered, cpu, or cuda by gsplat.
    truth: URI of the street a recording shows, for the report alone.

    Raises:
        ClimateGSError: a value outside its range, or two that exclude each other.
    """

    scene: str
    out: Path
    minutes: float | None = None
    steps: int | None = None
    scale: float = 0.25
    cameras: tuple[str, ...] | None = None
    holdout: str = "every-2nd"
    seed: int = 0
    depth_weight: float | None = None
    sh_degree: int | None = None
    max_splats: int | None = None
    densify: str = "absgrad"
    image_cache_mb: int = 1024
    depth: str = "lidar"
    ego_masks: Path | None = None
    truth: str | None = None
    device: str = "cpu"
    overwrite: bool = False

    def __post_init__(self) -> None:
        if self.minutes is not None and self.steps is not None:
            raise ClimateGSError("give --minutes or --steps, not both")
        holdout_step(self.holdout)
        self._check("--minutes", self.minutes, 0, math.inf, "a number of minutes > 0", above=True)
        self._check("--steps", self.steps, 1, math.inf, "a number of steps >= 1")
        self._check("--scale", self.scale, 0, 1, "above 0 and at most 1", above=True)
        self._check("--seed", self.seed, 0, math.inf, ">= 0")
        self._check("--depth-weight", self.depth_weight, 0, math.inf, ">= 0 (0 switches it off)")
        self._check("--sh-degree", self.sh_degree, 0, 3, "0, 1, 2 or 3")
        self._check("--max-splats", self.max_splats, 1, math.inf, "a number of splats >= 1")
        self._check("--image-cache-mb", self.image_cache_mb, 0, math.inf, "megabytes, >= 0")
        if self.densify not in DENSIFY:
            raise ClimateGSError(f"--densify is one of {', '.join(DENSIFY)}; got {self.densify!r}")
        if self.device not in DEVICES:
            raise ClimateGSError(f"--device is one of {', '.join(DEVICES)}; got {self.device!r}")
        if self.cameras is not None and not all(self.cameras):
            raise ClimateGSError("--cameras is names separated by commas, or all")
        parse_depth(self.depth)
        if self.truth is not None:
            open_street(self.truth)
        if self.ego_masks is not None and not self.ego_masks.is_dir():
            raise ClimateGSError(f"--ego-masks: there is no folder {self.ego_masks}")

    @staticmethod
    def _check(
        name: str, value: float | None, low: float, high: float, wanted: str, above: bool = False
    ) -> None:
        if value is None:
            return
        inside = low < value <= high if above else low <= value <= high
        if not inside or value == math.inf:  # NaN is not inside either
            raise ClimateGSError(f"{name} must be {wanted}; got {value}")

    @property
    def budget_s(self) -> float | None:
        """Seconds to optimise for; None where the number of steps is given."""
        if self.steps is not None:
            return None
        return 60 * (DEFAULT_MINUTES if self.minutes is None else self.minutes)

    def config(self, steps: int) -> FitConfig:
        """The optimiser's configuration for this many steps."""
        default = FitConfig()
        growth = dataclasses.replace(
            default.densify, max_splats=_or(self.max_splats, default.densify.max_splats)
        )
        if self.densify == "none":
            growth = without_growth(growth)
        else:
            growth = dataclasses.replace(growth, method=self.densify)
        return dataclasses.replace(
            default,
            steps=steps,
            seed=self.seed,
            sh_degree=_or(self.sh_degree, default.sh_degree),
            loss=dataclasses.replace(
                default.loss, depth=_or(self.depth_weight, default.loss.depth)
            ),
            densify=growth,
        )

    def settings(self) -> dict[str, Any]:
        """All that decides the result, flat and as JSON keeps it; not how long it is fitted."""
        config = dataclasses.asdict(self.config(1))
        del config["steps"]
        return {
            "scene": format_uri(*resolved_uri(self.scene)),
            "cameras": "all" if self.cameras is None else ",".join(self.cameras),
            "scale": self.scale,
            "holdout": self.holdout,
            "densify": self.densify,
            "depth": _depth_text(parse_depth(self.depth)),
            "ego_masks": None if self.ego_masks is None else str(self.ego_masks.absolute()),
            **({} if self.device == "cpu" else {"device": self.device}),
            **_flat(config),
        }

    def length(self) -> dict[str, float]:
        """How long it was asked to be fitted: {"steps": N} or {"minutes": M}."""
        if self.steps is not None:
            return {"steps": self.steps}
        return {"minutes": DEFAULT_MINUTES if self.minutes is None else self.minutes}


def without_growth(config: DensifyConfig) -> DensifyConfig:
    """No splats are added or removed: the part of the run for it ends before it starts."""
    return dataclasses.replace(config, start=1.0, stop=0.0)


def parse_depth(text: str) -> DepthPriors:
    """`lidar`, `none`, or kinds separated by commas: lidar, sparse:DIR, metric:DIR, relative:DIR; a
    DIR alone is metric. What they are: `adapters.training_views.depth_priors.DepthPriors`.

    Raises:
        ClimateGSError: another kind, one given twice, or no such folder.
    """
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
    scheme, path, query = parse_uri(uri)
    if scheme is None:
        scheme = recognise(Path(path))
    if Path(path).exists():
        path = str(_absolute(Path(path)))
    return scheme, path, query


def differences(before: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    """Every setting that is not the same: `scale was 0.25, now 0.5`."""
    return [
        f"{name} was {before.get(name)}, now {now.get(name)}"
        for name in dict.fromkeys([*before, *now])
        if before.get(name) != now.get(name)
    ]


def _absolute(path: Path) -> Path:
    """Without `..`, but with the last name as given, even of a link: it names the scene."""
    if path.name in ("", ".."):
        return path.resolve()
    return path.parent.resolve() / path.name


def _or(value: _Number | None, default: _Number) -> _Number:
    return default if value is None else value


def _flat(nested: Mapping[str, Any], above: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for name, value in nested.items():
        if isinstance(value, Mapping):
            flat.update(_flat(value, f"{above}{name}."))
        else:
            flat[f"{above}{name}"] = value
    return flat


def _depth_text(priors: DepthPriors) -> str:
    folders = {kind: getattr(priors, f"{kind}_dir") for kind in DEPTH_KINDS}
    named = [f"{kind}:{folder}" for kind, folder in folders.items() if folder is not None]
    return ",".join((["lidar"] if priors.lidar else []) + named) or "none"
