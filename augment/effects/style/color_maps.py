"""A style put on a scene: its colour maps folded into every Gaussian's SH, and into the sky.

A Gaussian's colour is c = 0.5 + sum sh_lm Y_lm(direction), and Y_00 = C0 is constant. So
c' = M c + b holds in every direction where
    sh_00' = (M (C0 sh_00 + 0.5) + b - 0.5) / C0 = M sh_00 + (0.5 M 1 + b - 0.5) / C0,
    sh_lm' = M sh_lm  otherwise.
Renderers clamp c to >= 0 before they blend, which a map does not commute with: where a colour that
changes with the direction was clamped, or is after it, the picture is not the map of the picture.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int16
from scipy.spatial import KDTree
from torch import Tensor

from augment.memo import memo_of
from augment.render import composite_kernels
from augment.render import sh as sh_layout
from augment.render.buffers import AUTO, CPU, CUDA, kernels_for
from augment.render.cuda import runtime
from augment.render.sh import SH_C0
from augment.render.threads import kernel_threads
from augment.scene import Actor, Gaussians, Scene
from augment.semantics import SemanticClass
from augment.sky import ConstantSky, CubemapSky, LatLongSky, Sky, is_stand_in

CLASSES = max(SemanticClass) + 1


@dataclass(frozen=True, eq=False)
class StyleMaps:
    """Float32 maps of display-encoded colours.

    splats [C, 3, 4]: of Gaussians; one for all (C = 1), or one a SemanticClass value (C = CLASSES).
    sky [3, 4]: of the sky. picture [3, 4]: of a finished picture, weather and all. seen_sky [3, 4]:
    where the sky has a map of its own, covariance [:, :3] and mean [:, 3] of its colours as the
    cameras see them before they are mapped (see augment.effects.style.color_maps); else None.
    """

    splats: Float[Tensor, "C 3 4"]
    sky: Float[Tensor, "3 4"]
    picture: Float[Tensor, "3 4"]
    seen_sky: Float[Tensor, "3 4"] | None = None

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if value is not None:
                _check(name, value, (len(value), 3, 4) if name == "splats" else (3, 4))
        if len(self.splats) not in (1, CLASSES):
            raise ValueError(
                f"splats must hold one map, or one for each of {CLASSES} classes; "
                f"got {len(self.splats)}"
            )


def _check(name: str, value: Tensor, shape: tuple[int, ...]) -> None:
    if tuple(value.shape) != shape or value.dtype != torch.float32:
        raise ValueError(
            f"{name} must be float32 {list(shape)}; got {value.dtype} {list(value.shape)}"
        )
    if not bool(torch.isfinite(value).all()):
        raise ValueError(f"{name} must be finite; got {value.tolist()}")


# ---- Splats that paint sky -----------------------------------------------------------------------
# A fit fills gaps at the skyline, between wires, branches and roofs, with splats of the sky's
# colour; under the land's map they would stay behind as halos. What paints sky stands above the
# horizon and has the colour of the sky behind it, where that is what the cameras see as sky: a cube
# map behind a wall holds whatever the fit left there, and a wall as pale as the clouds beside it
# may still differ from the sky behind it.

LEVELS = 8  # steps from a splat of the land to one of the sky
_NEAR = 0.06
_FAR = 0.16  # greatest difference of a channel: sky up to here, none from there
_LIKELY = 7.0
_UNLIKELY = 14.0  # squared Mahalanobis distance from the colours of the seen sky
_LOW_DEG = 0.5
_HIGH_DEG = 3.0  # elevation: none up to here, all from there
_FLOOR = 0.01  # standard deviation added to the seen sky's, so that a plain one is not a point
_MAX_PLACES = 64  # that the sky is looked at from


def sky_levels(scene: Scene, maps: StyleMaps) -> Int16[Tensor, "N"] | None:
    """How much of every background splat is sky, 0 to LEVELS, seen from the nearest camera; None
    where none is any, or where it cannot be told: without cameras, without knowing where up is, or
    in front of a grey stand-in. Remembered while the scene lives: it is the same for every style.
    """
    seen = maps.seen_sky
    if seen is None or is_stand_in(scene.sky):
        return None
    return memo_of(scene).get(("sky levels", seen.numpy().tobytes()), lambda: _find(scene, seen))


def _find(scene: Scene, seen: Float[Tensor, "3 4"]) -> Int16[Tensor, "N"] | None:
    g = scene.background
    places = _places(scene)
    if len(places) == 0 or len(g) == 0 or not scene.has_known_gravity:
        return None
    rgb = np.clip(0.5 + SH_C0 * g.sh[:, 0].double().numpy(), 0, 1)
    likely = _ramp(_distance(rgb, seen), _UNLIKELY, _LIKELY)
    found = np.flatnonzero((likely > 0) & (g.means[:, 2].numpy() > places[:, 2].min()))
    if len(found) == 0:
        return None
    means = g.means[found].double().numpy()
    away = means - places[KDTree(places).query(means)[1]]
    length = np.maximum(np.linalg.norm(away, axis=1), 1e-9)
    elevation_deg = np.degrees(np.arcsin(np.clip(away[:, 2] / length, -1, 1)))
    behind = scene.sky.sample(torch.from_numpy(away.astype(np.float32))).double().numpy()
    share = (
        likely[found]
        * _ramp(elevation_deg, _LOW_DEG, _HIGH_DEG)
        * _ramp(np.abs(rgb[found] - behind).max(1), _FAR, _NEAR)
        * _ramp(_distance(behind, seen), _UNLIKELY, _LIKELY)
    )
    levels = np.zeros(len(g), np.int16)
    levels[found] = np.round(LEVELS * share)
    return torch.from_numpy(levels) if levels.any() else None


def level_maps(maps: StyleMaps) -> Float[Tensor, "R 3 4"]:
    """The splats' maps at every level, those of level 0 first: row C level + class."""
    steps = torch.arange(LEVELS + 1) / LEVELS
    return torch.cat([torch.lerp(maps.splats, maps.sky, step) for step in steps])


def map_rows(
    levels: Int16[Tensor, "N"], classes: Int16[Tensor, "N"] | None, count: int
) -> Int16[Tensor, "N"]:
    """The row of level_maps for every splat. count: of the splats' maps, C."""
    if count == 1 or classes is None:
        return count * levels
    known = torch.where((classes >= 0) & (classes < count), classes, 0)
    return (count * levels + known).to(torch.int16)


def _places(scene: Scene) -> np.ndarray:
    """Centres of the scene's cameras, float64 [P, 3], a few spread over its frames."""
    centres = [c.centre.numpy() for f in scene.frames for c in f.cameras.values()]
    step = max(1, -(-len(centres) // _MAX_PLACES))
    return np.asarray(centres[::step], np.float64).reshape(-1, 3)


def _distance(rgb: np.ndarray, seen: Float[Tensor, "3 4"]) -> np.ndarray:
    """Squared, in standard deviations of the seen sky's colours."""
    mean = seen[:, 3].double().numpy()
    covariance = seen[:, :3].double().numpy()
    inverse = np.linalg.inv(covariance + _FLOOR**2 * np.eye(3))
    apart = rgb - mean
    return np.einsum("ni,ij,nj->n", apart, inverse, apart)


def _ramp(value: np.ndarray, none: float, full: float) -> np.ndarray:
    """0 at `none` and beyond, 1 at `full` and beyond, straight between."""
    return np.clip((value - none) / (full - none), 0, 1)


BLOCKS = 4  # pieces of work that a thread takes at a time


def style_gaussians(
    gaussians: Gaussians,
    maps: StyleMaps,
    *,
    levels: Tensor | None = None,
    out: Tensor | None = None,
    backend: str = AUTO,
) -> Gaussians:
    """The same Gaussians with mapped SH; every other tensor is shared, and all of them where no
    map changes anything.

    levels [N]: how much of each is sky (see sky_levels). out: where the SH are written, contiguous
    and of their shape and dtype; may be `gaussians.sh` itself. New memory by default, whose first
    touch takes as long as the mapping. backend: "cpu" maps float32 without gradients by a kernel,
    equal to `map_sh` within float rounding; "cuda" takes SH of either side and gives new ones on
    the GPU, "auto" goes where the SH lie.

    Raises:
        ValueError: maps by class, and a class that has none; or out does not fit.
    """
    sh = gaussians.sh
    if out is not None:
        _check_out(out, sh)
    splats = maps.splats
    classes = _rows_of(gaussians, len(maps.splats))
    if levels is not None:
        splats, classes = level_maps(maps), map_rows(levels, gaussians.semantic, len(splats))
    if out is None and not bool(_changes(splats).any()):
        return gaussians
    kernels = kernels_for(backend, sh)
    if kernels == CPU:
        return dataclasses.replace(gaussians, sh=_on_cpu(sh, out, classes, fold_maps(splats)))
    sh = runtime.resident(sh) if kernels == CUDA else sh
    if out is not None and out.device != sh.device:
        raise ValueError(f"out must lie on {sh.device}, as what is mapped; got {out.device}")
    mapped = map_sh(sh, splats, classes)
    return dataclasses.replace(gaussians, sh=mapped if out is None else out.copy_(mapped))


def _on_cpu(
    sh: Float[Tensor, "N K 3"],
    out: Tensor | None,
    classes: Tensor | None,
    folded: Float[Tensor, "C 13"],
) -> Float[Tensor, "N K 3"]:
    target = _new_memory(sh.shape) if out is None else out
    aligned = target.data_ptr() % composite_kernels.ALIGNMENT == 0  # a view may begin anywhere
    written = target if aligned else _new_memory(sh.shape)
    with kernel_threads(BLOCKS):
        composite_kernels.map_sh(
            sh.detach().contiguous().numpy().reshape(-1),
            written.detach().numpy().reshape(-1),
            sh.shape[1],
            np.empty(0, np.int16) if classes is None else classes.contiguous().numpy(),
            folded.numpy(),
        )
    return target if aligned else target.copy_(written)


def style_actor(actor: Actor, maps: StyleMaps) -> Actor:
    """The actor in mapped colours, at all times: its waves add to sh_00, so only M acts on them."""
    waves = actor.color_waves
    splats = maps.splats
    if waves is not None:
        matrices = fold_maps(splats, waves.coefficients.dtype)[:, :9].reshape(-1, 3, 3)
        classes = _rows_of(actor.gaussians, len(splats))
        rows = matrices[:1] if classes is None else matrices[classes.long()]
        mapped = torch.einsum(
            "nij,ntj->nti", rows.expand(len(actor.gaussians), 3, 3), waves.coefficients
        )
        waves = dataclasses.replace(waves, coefficients=mapped)
    gaussians = style_gaussians(actor.gaussians, maps)
    return dataclasses.replace(actor, gaussians=gaussians, color_waves=waves)


def map_sh(
    sh: Float[Tensor, "N K 3"], maps: Float[Tensor, "C 3 4"], classes: Tensor | None = None
) -> Float[Tensor, "N K 3"]:
    """The torch definition: SH of the mapped colours. classes [N]: rows of maps; None: the first.

    A map that changes nothing leaves every bit of its splats. Of degree 0, a colour below 0 is
    mapped as the black that it shows.
    """
    folded = fold_maps(maps, sh.dtype).to(sh.device)
    if classes is None:
        rows = folded[:1].expand(len(sh), sh_layout.FOLDED)
    else:
        rows = folded[classes.long().to(sh.device)]
    shown = sh.clamp_min(float(sh_layout.BLACK)) if sh.shape[1] == 1 else sh
    mapped = torch.einsum("nij,nkj->nki", rows[:, :9].reshape(-1, 3, 3), shown)
    first = mapped[:, :1] + rows[:, None, 9:12]
    mapped = torch.cat([first, mapped[:, 1:]], 1)
    return torch.where(rows[:, 12, None, None] != 0, mapped, sh)


def fold_maps(
    maps: Float[Tensor, "C 3 4"], dtype: torch.dtype = torch.float32
) -> Float[Tensor, "C 13"]:
    """Maps of colours as maps of SH: M row by row, what sh_00 gets besides, and 0 where the map
    changes nothing, else 1. Worked out in float64.
    """
    wide = maps.detach().double()
    matrix = wide[:, :, :3]
    offset = wide[:, :, 3]
    first = (0.5 * matrix.sum(2) + offset - 0.5) / SH_C0
    changes = _changes(maps).double()[:, None]
    return torch.cat([matrix.reshape(-1, 9), first, changes], 1).to(dtype)


def style_sky(sky: Sky, color_map: Float[Tensor, "3 4"]) -> Sky:
    """The sky with mapped colours, clamped to [0, 1]; the same sky where the map changes nothing.

    Skies made of texels are mapped texel by texel: a map is affine and so is interpolation, so they
    commute but where the clamp acts.
    """
    if not bool(_changes(color_map[None])):
        return sky
    for kind, texels in ((ConstantSky, "rgb"), (LatLongSky, "image"), (CubemapSky, "faces")):
        if isinstance(sky, kind):
            return kind(_mapped(getattr(sky, texels), color_map))
    return MappedSky(sky, color_map)


@dataclass(frozen=True, eq=False)
class MappedSky:
    """Any other sky, mapped where it is looked at."""

    sky: Sky
    color_map: Float[Tensor, "3 4"]

    def sample(self, directions: Float[Tensor, "*B 3"]) -> Float[Tensor, "*B 3"]:
        return _mapped(self.sky.sample(directions), self.color_map)


def styled_scene(scene: Scene, maps: StyleMaps) -> Scene:
    """Background, actors and sky mapped; what of the background paints sky changes with that."""
    return dataclasses.replace(
        scene,
        background=style_gaussians(scene.background, maps, levels=sky_levels(scene, maps)),
        actors=tuple(style_actor(actor, maps) for actor in scene.actors),
        sky=style_sky(scene.sky, maps.sky),
    )


def _new_memory(shape: tuple[int, ...]) -> Tensor:
    """Float32 of any values, aligned for the kernel. From NumPy, which asks the system for huge
    pages: the first touch of memory from torch takes several times as long as the mapping.
    """
    count = math.prod(shape)
    spare = composite_kernels.ALIGNMENT // 4
    memory = np.empty(count + spare, np.float32)
    first = -memory.ctypes.data % composite_kernels.ALIGNMENT // 4
    return torch.from_numpy(memory[first : first + count]).view(tuple(shape))


def _mapped(rgb: Tensor, color_map: Tensor) -> Tensor:
    color_map = color_map.to(rgb.dtype)
    return (rgb @ color_map[:, :3].T + color_map[:, 3]).clamp(0, 1)


def _changes(maps: Tensor) -> Tensor:
    """bool [C]: whether each map is anything else than the identity."""
    return (maps != torch.eye(3, 4, dtype=maps.dtype)).flatten(1).any(1)


def _rows_of(gaussians: Gaussians, count: int) -> Tensor | None:
    """Every Gaussian's row among the maps; None where all take the first."""
    classes = gaussians.semantic
    if count == 1 or classes is None or not len(classes):
        return None
    values = classes.cpu().numpy()  # torch's own least and greatest take longer on the CPU
    low = int(values.min())
    high = int(values.max())
    if low < 0 or high >= count:
        raise ValueError(
            f"the style has maps for classes 0 to {count - 1}; the Gaussians' classes are "
            f"{low} to {high}"
        )
    return classes


def _check_out(out: Tensor, sh: Tensor) -> None:
    if tuple(out.shape) != tuple(sh.shape) or out.dtype != sh.dtype or not out.is_contiguous():
        raise ValueError(
            f"out must be contiguous {sh.dtype} {list(sh.shape)}, as the SH; got "
            f"{'' if out.is_contiguous() else 'strided '}{out.dtype} {list(out.shape)}"
        )
