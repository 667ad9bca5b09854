"""Opens what a reconstruction learns from, with nothing of the held-out frames in it."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from adapters.training_views.views import holdout_step
from adapters.uri import format_uri
from augment.cameras import Camera
from augment.errors import AdapterError, ClimateGSError
from augment.reconstruct.view import RecordedView, ViewKey, ViewSource
from augment.scene import Scene
from tools.fit_options import FitOptions, resolved_uri

HELD_OUT_KEY = "held_out"
_HELD_OUT_SCHEMES = ("pandaset", "recording", "nuscenes", "kitti")


def open_to_fit(
    options: FitOptions, open_scene: Callable[[str], Scene]
) -> tuple[Scene, tuple[str, ...]]:
    """The scene to start from, and a sentence if held-out frames may have gone into it.

    Raises:
        AdapterError: as open_scene. ClimateGSError: nothing recorded to learn from, or a URI that
            holds out frames itself.
    """
    scheme, path, query = resolved_uri(options.scene)
    if HELD_OUT_KEY in query:
        raise ClimateGSError(
            f"{options.scene}: leave {HELD_OUT_KEY}={query[HELD_OUT_KEY]} out of the URI; "
            f"--holdout says which frames are held out, of the scene and of the views alike"
        )
    step = holdout_step(options.holdout)
    if step is None or not can_hold_out(scheme, path):
        scene = open_scene(format_uri(scheme, path, query))
        check_recorded(scene)
        warning = f"{scheme} scenes cannot be built without them"
        return scene, () if step is None else (_seen(options.holdout, warning),)
    guess = f"{_first_frame(query) + step - 1}::{step}"
    try:
        scene = open_scene(format_uri(scheme, path, {**query, HELD_OUT_KEY: guess}))
    except AdapterError:  # the guess may have held out all frames; another reason comes again
        scene, guess = open_scene(format_uri(scheme, path, query)), None
    check_recorded(scene)
    numbers = [frame.index for frame in scene.frames]
    better = held_out_range(numbers, step)
    if better is None and len(numbers) >= step:
        warning = "their numbers are at uneven steps"
        return scene, (_seen(options.holdout, warning),)
    if better is not None and (guess is None or holds(better, numbers) != holds(guess, numbers)):
        scene = open_scene(format_uri(scheme, path, {**query, HELD_OUT_KEY: better}))
    return scene, ()


def can_hold_out(scheme: str, path: str) -> bool:
    """Whether such a scene can be built without some of its frames."""
    if scheme == "street_gaussians":
        from adapters.street_gaussians.model import is_dataset

        return is_dataset(Path(path))
    return scheme in _HELD_OUT_SCHEMES


def check_recorded(scene: Scene) -> None:
    """Refuse a scene that no camera has recorded.

    Raises:
        ClimateGSError: it has no images; says how to make some.
    """
    if any(frame.image_paths for frame in scene.frames):
        return
    from augment.jobs.layout import folder_name, variant_name
    from recipes.load import load_recipe

    folder = f"raw/{folder_name(scene.name)}/{variant_name(load_recipe('clear').resolve(0))}"
    raise ClimateGSError(
        f"{scene.source} has no recorded images, so there is nothing to fit it to. Render it "
        f"first, then fit what was rendered:\n"
        f"  climategs render clear --scene '{scene.source}' --out raw\n"
        f"  climategs fit recording:{folder} --out fitted"
    )


def held_out_range(numbers: Sequence[int], step: int) -> str | None:
    """start::step over frame numbers for the frames at positions step - 1, 2 step - 1, ...; None
    where there are none, or no such range holds just them.
    """
    held = list(numbers[step - 1 :: step])
    if not held:
        return None
    stride = held[1] - held[0] if len(held) > 1 else max(numbers) - held[0] + 1
    text = f"{held[0]}::{stride}"
    return text if holds(text, numbers) == held else None


def holds(held_out: str, numbers: Sequence[int]) -> list[int]:
    """The frame numbers that start::step holds out."""
    start, _, step = held_out.split(":")
    return [n for n in numbers if n >= int(start) and (n - int(start)) % int(step) == 0]


def data_facts(scene: Scene, source: ViewSource) -> dict[str, Any]:
    """What was found in the data, to notice when it is no longer the same."""
    digest = hashlib.sha256()
    for key in (*source.train, *source.test):
        camera = source.camera(key)
        numbers = (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)
        digest.update(repr((key.frame, key.camera, camera.timestamp_ns, numbers)).encode())
        digest.update(camera.camera_from_world.numpy().tobytes())
    return {
        "frames": len(scene.frames),
        "train views": len(source.train),
        "held-out views": len(source.test),
        "Gaussians to start from": splat_count(scene),
        "actors": len(scene.actors),
        "cameras' poses (SHA-256)": digest.hexdigest(),
    }


@dataclass(frozen=True)
class FewerTestViews:
    """A ViewSource of which only some views are held out, to be evaluated sooner."""

    source: ViewSource
    test: tuple[ViewKey, ...]

    @property
    def train(self) -> tuple[ViewKey, ...]:
        return self.source.train

    def camera(self, key: ViewKey) -> Camera:
        return self.source.camera(key)

    def load(self, key: ViewKey) -> RecordedView:
        return self.source.load(key)


def splat_count(scene: Scene) -> int:
    """Gaussians of the background and of all actors."""
    return len(scene.background) + sum(len(actor.gaussians) for actor in scene.actors)


def _first_frame(query: dict[str, str]) -> int:
    first = query.get("frames", "").partition(":")[0]
    return int(first) if first.isdigit() else 0


def _seen(holdout: str, reason: str) -> str:
    return (
        f"--holdout {holdout} keeps frames from the optimiser, not from what it starts with, since "
        f"{reason}: figures on held-out views may be too good"
    )
