"""Pruning: splats of the background that no recorded view would miss, left out of near views.

In: the parts of a view, a scene and an error (`prune_parts`, called by `augment.view.render_view`).
Out: the parts with the opacities of such splats set to 0. `precompute_errors` finds the errors of
all splats once, before a job's processes would.

Without splat i, of colour c_i and weight w_i = alpha_i T_i at a pixel, the pixel shows more of what
is behind it, B_i, and changes by w_i (B_i - c_i). To first order this is alpha_i dL/dalpha_i, which
the rasteriser's backward pass adds up over a view. A splat's change in a view is

    max(|sum of w_i L(B_i - c_i)|, MIN_CONTRAST sum of w_i) / pixels,    L: luma,

and the view that would change most counts. MIN_CONTRAST stands for what changes of both signs hide,
and for the changes that neighbours make when they go together. Splats that change least go first,
until their changes add up to the error that is allowed in some view. After each of the ROUND_ERRORS
the views are rendered again without the splats that have gone, since what these covered counts more
then: a far front of many small splats would go as a whole otherwise. (Fan et al. 2024,
"LightGaussian", and Niemeyer et al. 2024, "RadSplat", leave out by weight alone, which at the same
error leaves out less.)
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

from augment.detail.lod import has_stored_levels
from augment.memo import memo_of
from augment.progress import ProgressBar
from augment.render.constants import RasterSettings
from augment.render.cpu.order import cached_of_tensor
from augment.render.threads import num_concurrent_views, split_threads
from augment.scene.cameras import Camera
from augment.scene.scene import Gaussians, PosedGaussians, Scene
from augment.timing import counted_steps
from recipes.schema import Render

# Recorded views that are rendered, at least, where there are as many.
MIN_VIEWS = 8
# Recorded views that are rendered, at most.
MAX_VIEWS = 24
# Width of these views, at most, pixels.
MAX_WIDTH_PX = 320
# Product of views and splats, at most: larger backgrounds are rendered in fewer views.
MAX_NUMBERS = 200_000_000
# Distance from all recorded cameras beyond which a view may show what none of them did, metres.
MAX_DISTANCE_M = 2.0
# Weights of red, green and blue in luma.
LUMA = (0.299, 0.587, 0.114)
# Luma behind all splats.
SKY_LUMA = 0.7
# Contrast that a splat has at least, of 1.
MIN_CONTRAST = 0.05
# Errors up to which splats go in each round, shares of white.
ROUND_ERRORS = (0.0002, 0.0004, 0.0008, 0.0016, 0.0032, math.inf)
# Alpha that is not clamped: nothing is known of what is behind a splat whose alpha is clamped.
_ALPHA_MAX = 0.9999
# Key of the errors in a scene's memo.
_ERRORS = ("errors without splats",)
# Lock for the search: views that are rendered at once need the same errors.
_search_lock = threading.RLock()

# Indices of splats, and the change that each makes.
SplatChanges = tuple[Int32[np.ndarray, "_"], Float[np.ndarray, "_"]]


def prune_error_of(render: Render) -> float:
    """Return the recipe's error, or 0 where nothing is pruned: merged splats, recorded images."""
    has_pruning = not render.is_on_recorded and render.speed.lod_px == 0
    return render.speed.prune if has_pruning else 0.0


def prune_parts(
    parts: Sequence[PosedGaussians], scene: Scene, camera: Camera, error: float
) -> tuple[PosedGaussians, ...]:
    """Return the parts as a camera needs them, with the opacities of pruned splats set to 0.

    Splats are left out whose changes of the mean of any recorded view add up to no more than
    `error`.

    Args:
        parts: the parts, as the effects have left them.
        scene: the scene.
        camera: the view.
        error: allowed error, share of white.
    """
    if error <= 0 or not _is_near(camera, scene):
        return tuple(parts)
    return tuple(
        _prune_part(part, scene, error) if _is_background(part, scene) else part for part in parts
    )


def precompute_errors(scene: Scene, max_error: float = math.inf, *, progress: bool = False) -> None:
    """Find the errors up to `max_error` now, so that other processes take them over.

    Args:
        scene: the scene.
        max_error: largest error that is needed, share of white.
        progress: if True, show a bar on stderr.
    """
    scene = scene.as_recorded
    if not has_stored_levels(scene.background):
        errors_of(scene, max_error, progress=progress)
        memo_of(scene).put(_ERRORS, _search_of(scene), shared=True)


def errors_of(
    scene: Scene, max_error: float = math.inf, *, progress: bool = False
) -> Float[np.ndarray, "N"]:
    """Return the error that leaving out each splat of the background makes, share of white,
    float32.

    It adds up the changes by the splat and by all splats that change less, in the worst recorded
    view. It is infinite for splats that no view has in its frame, and beyond `max_error` unless
    somebody has asked for more. Errors are found once a scene.

    Args:
        scene: the scene.
        max_error: largest error that is needed, share of white.
        progress: if True, show a bar on stderr.
    """
    scene = scene.as_recorded
    search = _search_of(scene)
    num_rounds = min(bisect_left(ROUND_ERRORS, max_error) + 1, len(ROUND_ERRORS))
    with _search_lock:
        if search.rounds < num_rounds:
            _find_errors(scene, search, num_rounds, progress)
    return search.errors


def _is_background(part: PosedGaussians, scene: Scene) -> bool:
    """Return True if a part is the scene's background, without levels in a file."""
    g = part.gaussians
    is_plain = part.instance_id == 0 and not part.is_overlay and len(g) == len(scene.background)
    return is_plain and not has_stored_levels(scene.background)


def _is_near(camera: Camera, scene: Scene) -> bool:
    """Return True if a camera is near a recorded one."""
    scene = scene.as_recorded
    centres = memo_of(scene).get(("camera centres",), lambda: _centres_of(scene))
    distances_m = np.linalg.norm(centres - camera.centre.numpy(), axis=1)
    return bool(distances_m.min(initial=np.inf) <= MAX_DISTANCE_M)


def _centres_of(scene: Scene) -> Float[np.ndarray, "C 3"]:
    """Return the centres of the recorded cameras."""
    return np.array([camera.centre.numpy() for camera in _recorded_cameras(scene)]).reshape(-1, 3)


def _prune_part(part: PosedGaussians, scene: Scene, error: float) -> PosedGaussians:
    """Return the background with the opacities of pruned splats set to 0."""
    opacities = part.gaussians.opacities
    errors = errors_of(scene, error)

    def prune() -> tuple[np.ndarray, torch.Tensor]:
        is_pruned = torch.from_numpy(errors > error).to(opacities.device)
        return errors, torch.where(is_pruned, opacities, 0.0)

    # One pruned tensor for one tensor of opacities, so that the rasteriser knows it again.
    known_errors, pruned_opacities = cached_of_tensor(opacities, f"pruned at {error}", prune)
    if known_errors is not errors:  # the same tensor in a scene of other views
        pruned_opacities = prune()[1]
    return replace(part, gaussians=replace(part.gaussians, opacities=pruned_opacities))


@dataclass(eq=False)
class _ErrorSearch:
    """State of the search for errors."""

    errors: np.ndarray
    """Errors, as of `errors_of`; finite for splats that have gone."""
    gone: np.ndarray
    """Change of each view by the splats that have gone."""
    rounds: int = 0
    """Number of rounds that there have been."""

    def leave_out(self, views: Sequence[SplatChanges]) -> None:
        """Do one more round, by the changes that each remaining splat makes in each view."""
        count = len(self.errors)
        order = _order_by_change(views, np.isinf(self.errors))
        sums = np.zeros(len(order))
        for view, view_change in zip(views, self.gone, strict=True):
            np.maximum(sums, view_change + _changes_of_all(view, count)[order].cumsum(), out=sums)
        leaving = order[: np.searchsorted(sums, ROUND_ERRORS[self.rounds], side="right")]
        self.errors[leaving] = sums[: len(leaving)]
        self.gone += [_changes_of_all(view, count)[leaving].sum() for view in views]
        self.rounds += 1


def _search_of(scene: Scene) -> _ErrorSearch:
    """Return the state of the search for errors in a scene."""

    def begin() -> _ErrorSearch:
        errors = np.full(len(scene.background), np.inf, np.float32)
        return _ErrorSearch(errors, np.zeros(len(_recorded_views(scene))))

    return memo_of(scene).get(_ERRORS, begin)


def _find_errors(scene: Scene, search: _ErrorSearch, num_rounds: int, progress: bool) -> None:
    """Search until there have been `num_rounds` rounds."""
    from augment.render.cpu.driver import Scratch

    cameras = _recorded_views(scene)
    spaces = threading.local()
    opacities = scene.background.opacities.detach().cpu()
    is_opaque = opacities.numpy() >= _ALPHA_MAX
    num_steps = (num_rounds - search.rounds) * len(cameras)
    title = "finding splats to leave out"
    count = min(num_concurrent_views(len(is_opaque)), len(cameras))
    pool = split_threads(count) if count > 1 else None
    with (
        ProgressBar(desc=title, total=num_steps, unit="view", disable=not progress) as bar,
        counted_steps(title, num_steps) as advance,
    ):

        def find_changes(camera: Camera) -> SplatChanges:
            if not hasattr(spaces, "scratch"):
                spaces.scratch = Scratch()
            return _find_changes(remaining_scene, camera, is_opaque, spaces.scratch)

        try:
            while search.rounds < num_rounds:
                opacities_left = torch.where(
                    torch.from_numpy(np.isinf(search.errors)), opacities, 0.0
                )
                background = replace(scene.background, opacities=opacities_left)
                remaining_scene = replace(scene, background=background)
                views = list[SplatChanges]()
                for view in (pool.map if pool else map)(find_changes, cameras):
                    views.append(view)
                    bar.update()
                    advance()
                search.leave_out(views)
        finally:
            if pool:
                pool.shutdown(cancel_futures=True)


def _changes_of_all(view: SplatChanges, count: int) -> Float[np.ndarray, "N"]:
    """Return the change by every splat, float64; 0 where it is not in the frame."""
    ids, changes = view
    all_changes = np.zeros(count)
    all_changes[ids] = changes
    return all_changes


def _order_by_change(
    views: Sequence[SplatChanges], is_candidate: Bool[np.ndarray, "N"]
) -> Int[np.ndarray, "M"]:
    """Return the indices of splats in a view's frame, by the largest change that they make in any.

    Args:
        views: changes by view.
        is_candidate: mask of the splats that count.
    """
    largest = np.full(len(is_candidate), -1, np.float32)
    for ids, changes in views:
        largest[ids] = np.maximum(largest[ids], changes)
    framed = np.flatnonzero(is_candidate & (largest >= 0))
    return framed[np.argsort(largest[framed], kind="stable")]


def _find_changes(
    scene: Scene, camera: Camera, is_opaque: np.ndarray, scratch: Any
) -> SplatChanges:
    """Return the background's splats in a camera's frame, and each one's change of the view's
    mean.
    """
    from augment.render.cpu.backward import record_render
    from augment.render.cpu.driver import gather_inputs

    settings = RasterSettings(alpha_max=_ALPHA_MAX)
    parts = [_on_cpu(part) for part in scene.parts_for(camera)]
    inputs = gather_inputs(parts, camera, settings, None, with_color=True, is_culled=True)
    tape = record_render(inputs, camera, settings, scratch, with_depth=False)
    d_rgb = np.broadcast_to(np.array(LUMA, np.float32), tape.rgb.shape).copy()
    ids, weights, effects = tape.sum_splat_effects(d_rgb, np.full_like(tape.alpha, -SKY_LUMA))
    is_background = (ids >= 0) & (ids < len(is_opaque))
    ids = ids[is_background]
    weights = weights[is_background] / np.float32(LUMA[0])
    min_changes = np.where(is_opaque[ids], np.float32(1), np.float32(MIN_CONTRAST)) * weights
    return ids, np.maximum(np.abs(effects[is_background]), min_changes) / np.float32(
        tape.alpha.size
    )


def _recorded_cameras(scene: Scene) -> list[Camera]:
    """Return all cameras of the frames that the scene was made from."""
    frames = scene.seen_frames or scene.frames  # frames of a camera path may see less
    return [camera for frame in frames for camera in frame.cameras.values()]


def _recorded_views(scene: Scene) -> list[Camera]:
    """Return small cameras spread over all recorded images."""
    cameras = _recorded_cameras(scene)
    max_views = max(MIN_VIEWS, MAX_NUMBERS // max(len(scene.background), 1))
    count = min(MAX_VIEWS, max_views, len(cameras))
    indices = np.linspace(0, len(cameras) - 1, count).round().astype(int)
    chosen_cameras = [cameras[index] for index in indices if not cameras[index].is_orthographic]
    return [camera.scaled(min(1.0, MAX_WIDTH_PX / camera.width)) for camera in chosen_cameras]


def _on_cpu(part: PosedGaussians) -> PosedGaussians:
    """Return a part with its Gaussians on the CPU."""
    g = part.gaussians
    if g.means.device.type == "cpu":
        return part
    fields = (g.means, g.quats, g.scales, g.opacities, g.sh)
    return replace(part, gaussians=Gaussians(*(tensor.detach().cpu() for tensor in fields)))
