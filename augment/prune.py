"""Splats of the background that no recorded view would miss, left out of views from nearby.

Without splat i, of colour c_i and weight w_i = alpha_i T_i at a pixel, the pixel shows more of what
is behind it, B_i, and changes by w_i (B_i - c_i): to first order alpha_i dL/dalpha_i, which the
rasteriser's backward pass adds up over a view. A splat's change in a view is

    max(|sum of w_i L(B_i - c_i)|, LEAST_CONTRAST sum of w_i) / pixels,    L: luma,

and counts by the view that would change most. LEAST_CONTRAST stands for what changes of both signs
hide, and for the changes that neighbours make when they go together. Those that change least go
first, until what they change adds up to the error that is allowed in some view. After each of the
ROUNDS the views are looked at without what has gone, since what it covered counts more then: a far
front of many small splats would go as a whole. (Fan et al. 2024, "LightGaussian", and Niemeyer et
al. 2024, "RadSplat", leave out by weight alone, which at the same error leaves out less.)
"""

from __future__ import annotations

import math
import threading
from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, Int32

from augment.base_photo import RECORDED
from augment.cameras import Camera
from augment.lod import keeps_levels
from augment.memo import memo_of
from augment.progress import ProgressBar
from augment.render.constants import RasterSettings
from augment.render.cpu.order import known_of
from augment.render.threads import divided_threads, views_at_once
from augment.scene import Gaussians, PosedGaussians, Scene
from augment.timing import counted
from recipes.schema import Render

MIN_VIEWS, MAX_VIEWS, MAX_WIDTH_PX = 8, 24, 320  # that are looked at
MAX_NUMBERS = 200_000_000  # of views and splats: fewer views of larger backgrounds
# From farther away than this from all recorded cameras, a view may show what none of them did.
FARTHEST_M = 2.0
LUMA = (0.299, 0.587, 0.114)
SKY = 0.7  # luma behind all splats
LEAST_CONTRAST = 0.05
# The errors up to which splats go in each.
ROUNDS = (0.0002, 0.0004, 0.0008, 0.0016, 0.0032, math.inf)
_ALPHA_MAX = 0.9999  # nothing is known of what is behind a splat whose alpha is clamped
_ERRORS = ("errors without splats",)
_finding = threading.RLock()  # views drawn at once want the same

Changes = tuple[Int32[np.ndarray, "_"], Float[np.ndarray, "_"]]  # which splats, what each changes


def pruned_share(render: Render) -> float:
    """The recipe's, or 0 where nothing is pruned: of merged splats and on recorded images."""
    return 0.0 if render.base == RECORDED or render.lod_px > 0 else render.prune


def prune_parts(
    parts: Sequence[PosedGaussians], scene: Scene, camera: Camera, error: float
) -> tuple[PosedGaussians, ...]:
    """The parts as `camera` needs them: opacities of splats are 0 of which each alone changes the
    mean of a recorded view so little that it adds up to no more than this share of white. parts: as
    the effects have left them.
    """
    if error <= 0 or not _is_near(camera, scene):
        return tuple(parts)
    return tuple(
        _pruned(part, scene, error) if _is_background(part, scene) else part for part in parts
    )


def share_errors(scene: Scene, most: float = math.inf, *, progress: bool = False) -> None:
    """Find the errors up to `most` now, so that other processes take them over."""
    if not keeps_levels(scene.background):
        errors_of(scene, most, progress=progress)
        memo_of(scene).put(_ERRORS, _found_of(scene), shared=True)


def errors_of(
    scene: Scene, most: float = math.inf, *, progress: bool = False
) -> Float[np.ndarray, "N"]:
    """The changes by each splat of the background and all that change less, added up in the worst
    recorded view, share of white, float32; infinite where no view has it in its frame, and where
    the sum is beyond `most`, as far as nobody has asked for more. Found once a scene. progress: a
    bar on stderr.
    """
    found, rounds = _found_of(scene), min(bisect_left(ROUNDS, most) + 1, len(ROUNDS))
    with _finding:
        if found.rounds < rounds:
            _find_errors(scene, found, rounds, progress)
    return found.errors


def _is_background(part: PosedGaussians, scene: Scene) -> bool:
    g = part.gaussians
    is_plain = part.instance_id == 0 and not part.is_overlay and len(g) == len(scene.background)
    return is_plain and not keeps_levels(scene.background)


def _is_near(camera: Camera, scene: Scene) -> bool:
    centres = memo_of(scene).get(("camera centres",), lambda: _centres_of(scene))
    away_m = np.linalg.norm(centres - camera.centre.numpy(), axis=1)
    return bool(away_m.min(initial=np.inf) <= FARTHEST_M)


def _centres_of(scene: Scene) -> Float[np.ndarray, "C 3"]:
    return np.array([camera.centre.numpy() for camera in _recorded(scene)]).reshape(-1, 3)


def _pruned(part: PosedGaussians, scene: Scene, error: float) -> PosedGaussians:
    own, errors = part.gaussians.opacities, errors_of(scene, error)

    def prune() -> tuple[np.ndarray, torch.Tensor]:
        is_missed = torch.from_numpy(errors > error).to(own.device)
        return errors, torch.where(is_missed, own, 0.0)

    # Of the same tensor as long as that lives, so that the rasteriser knows it again.
    by, opacities = known_of(own, f"pruned at {error}", prune)
    if by is not errors:  # the same tensor in a scene of other views
        opacities = prune()[1]
    return replace(part, gaussians=replace(part.gaussians, opacities=opacities))


@dataclass(eq=False)
class _Found:
    """errors, as of `errors_of`, finite of what has gone; gone: what that changes in each view;
    rounds: how many there have been.
    """

    errors: np.ndarray
    gone: np.ndarray
    rounds: int = 0

    def leave_out(self, views: Sequence[Changes]) -> None:
        """One more round, by what each splat that is left changes in each view."""
        count = len(self.errors)
        order = _least_first(views, np.isinf(self.errors))
        sums = np.zeros(len(order))
        for view, gone in zip(views, self.gone, strict=True):
            np.maximum(sums, gone + _of_all(view, count)[order].cumsum(), out=sums)
        goes = order[: np.searchsorted(sums, ROUNDS[self.rounds], side="right")]
        self.errors[goes] = sums[: len(goes)]
        self.gone += [_of_all(view, count)[goes].sum() for view in views]
        self.rounds += 1


def _found_of(scene: Scene) -> _Found:
    def begin() -> _Found:
        errors = np.full(len(scene.background), np.inf, np.float32)
        return _Found(errors, np.zeros(len(_views(scene))))

    return memo_of(scene).get(_ERRORS, begin)


def _find_errors(scene: Scene, found: _Found, rounds: int, progress: bool) -> None:
    """Until there have been so many rounds."""
    from augment.render.cpu.driver import Scratch

    cameras, spaces = _views(scene), threading.local()
    opacities = scene.background.opacities.detach().cpu()
    opaque = opacities.numpy() >= _ALPHA_MAX
    steps, told = (rounds - found.rounds) * len(cameras), "finding splats to leave out"
    count = min(views_at_once(len(opaque)), len(cameras))
    pool = divided_threads(count) if count > 1 else None
    with (
        ProgressBar(desc=told, total=steps, unit="view", disable=not progress) as bar,
        counted(told, steps) as advance,
    ):

        def look(camera: Camera) -> Changes:
            if not hasattr(spaces, "scratch"):
                spaces.scratch = Scratch()
            return _changes_in(rest, camera, opaque, spaces.scratch)

        try:
            while found.rounds < rounds:
                left = torch.where(torch.from_numpy(np.isinf(found.errors)), opacities, 0.0)
                own = replace(scene.background, opacities=left)
                rest, views = replace(scene, background=own), list[Changes]()
                for view in (pool.map if pool else map)(look, cameras):
                    views.append(view)
                    bar.update()
                    advance()
                found.leave_out(views)
        finally:
            if pool:
                pool.shutdown(cancel_futures=True)


def _of_all(view: Changes, count: int) -> Float[np.ndarray, "N"]:
    """What each of all splats changes, float64; 0 where it is not in the frame."""
    ids, changes = view
    own = np.zeros(count)
    own[ids] = changes
    return own


def _least_first(views: Sequence[Changes], which: Bool[np.ndarray, "N"]) -> Int[np.ndarray, "M"]:
    """Those of `which` that a view has in its frame, by the most that they change in any."""
    most = np.full(len(which), -1, np.float32)
    for ids, changes in views:
        most[ids] = np.maximum(most[ids], changes)
    framed = np.flatnonzero(which & (most >= 0))
    return framed[np.argsort(most[framed], kind="stable")]


def _changes_in(scene: Scene, camera: Camera, opaque: np.ndarray, scratch: Any) -> Changes:
    """The background's splats in the camera's frame, and each one's change of the view's mean."""
    from augment.render.cpu.backward import record
    from augment.render.cpu.driver import gather_inputs

    settings = RasterSettings(alpha_max=_ALPHA_MAX)
    parts = [_on_cpu(part) for part in scene.parts_for(camera)]
    inputs = gather_inputs(parts, camera, settings, None, with_color=True, culled=True)
    tape = record(inputs, camera, settings, scratch, with_depth=False)
    d_rgb = np.broadcast_to(np.array(LUMA, np.float32), tape.rgb.shape).copy()
    ids, weights, effects = tape.splat_effects(d_rgb, np.full_like(tape.alpha, -SKY))
    own = (ids >= 0) & (ids < len(opaque))
    ids, weights = ids[own], weights[own] / np.float32(LUMA[0])
    least = np.where(opaque[ids], np.float32(1), np.float32(LEAST_CONTRAST)) * weights
    return ids, np.maximum(np.abs(effects[own]), least) / np.float32(tape.alpha.size)


def _recorded(scene: Scene) -> list[Camera]:
    frames = scene.seen_frames or scene.frames  # those of a camera path may see less
    return [camera for frame in frames for camera in frame.cameras.values()]


def _views(scene: Scene) -> list[Camera]:
    """Spread over all recorded images, small."""
    cameras = _recorded(scene)
    room = max(MIN_VIEWS, MAX_NUMBERS // max(len(scene.background), 1))
    count = min(MAX_VIEWS, room, len(cameras))
    places = np.linspace(0, len(cameras) - 1, count).round().astype(int)
    chosen = [cameras[place] for place in places if not cameras[place].is_orthographic]
    return [camera.scaled(min(1.0, MAX_WIDTH_PX / camera.width)) for camera in chosen]


def _on_cpu(part: PosedGaussians) -> PosedGaussians:
    g = part.gaussians
    if g.means.device.type == "cpu":
        return part
    fields = (g.means, g.quats, g.scales, g.opacities, g.sh)
    return replace(part, gaussians=Gaussians(*(tensor.detach().cpu() for tensor in fields)))
