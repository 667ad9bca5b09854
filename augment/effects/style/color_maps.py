"""Apply a style's colour maps to Gaussians, actors and skies.

The maps come from `augment.effects.style.style`, which also calls the functions here. A map (M, b)
takes a display-encoded colour c to M c + b. It is folded into the SH of every Gaussian.

A Gaussian's colour is c = 0.5 + sum sh_lm Y_lm(direction), and Y_00 = C0 is constant. So
c' = M c + b holds in every direction where
    sh_00' = (M (C0 sh_00 + 0.5) + b - 0.5) / C0 = M sh_00 + (0.5 M 1 + b - 0.5) / C0,
    sh_lm' = M sh_lm  otherwise.
Renderers clamp c to >= 0 before they blend, and a map does not commute with a clamp. If a colour
that changes with the direction is clamped before or after the map, then the picture of the mapped
scene is not the map of the scene's picture.
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
from augment.render.buffers import AUTO, CPU, CUDA, choose_kernels
from augment.render.cuda import runtime
from augment.render.sh import SH_C0
from augment.render.threads import kernel_threads
from augment.scene.scene import Actor, Gaussians, Scene
from augment.scene.semantics import SemanticClass
from augment.scene.sky import ConstantSky, CubemapSky, LatLongSky, Sky, is_unknown_sky

# Number of semantic classes, UNKNOWN included.
NUM_CLASSES = max(SemanticClass) + 1


@dataclass(frozen=True, eq=False)
class StyleMaps:
    """Float32 maps (M, b) of display-encoded colours."""

    splats: Float[Tensor, "C 3 4"]
    """Maps of Gaussians: one for all (C = 1), or one per SemanticClass value (C = NUM_CLASSES)."""

    sky: Float[Tensor, "3 4"]
    """Map of the sky."""

    picture: Float[Tensor, "3 4"]
    """Map of a finished picture, with its weather."""

    sky_moments: Float[Tensor, "3 4"] | None = None
    """Covariance [:, :3] and mean [:, 3] of the sky's colours, as the cameras see them before they
    are mapped. None if the sky has no map of its own.
    """

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if value is not None:
                _check_maps(name, value, (len(value), 3, 4) if name == "splats" else (3, 4))
        if len(self.splats) not in (1, NUM_CLASSES):
            raise ValueError(
                f"splats must hold one map, or one for each of {NUM_CLASSES} classes; "
                f"got {len(self.splats)}"
            )


def _check_maps(name: str, value: Tensor, shape: tuple[int, ...]) -> None:
    """Raise ValueError unless a field of StyleMaps is finite float32 of this shape."""
    if tuple(value.shape) != shape or value.dtype != torch.float32:
        raise ValueError(
            f"{name} must be float32 {list(shape)}; got {value.dtype} {list(value.shape)}"
        )
    if not bool(torch.isfinite(value).all()):
        raise ValueError(f"{name} must be finite; got {value.tolist()}")


# ---- Splats that paint sky -----------------------------------------------------------------------
# A fit fills gaps at the skyline, between wires, branches and roofs, with splats of the sky's
# colour. Under the land's map they would stay behind as halos. A splat that paints sky stands above
# the horizon and has the colour of the sky behind it. This colour must also be one that the cameras
# see as sky: a cube map behind a wall holds whatever the fit left there. A wall as pale as the
# clouds beside it may still differ from the sky behind it.

# Level of a splat that is all sky; level 0 is all land.
MAX_SKY_LEVEL = 8
# Largest difference of a channel from the sky behind, up to which a splat is all sky.
_SKY_COLOR_DIFFERENCE = 0.06
# Largest difference of a channel from the sky behind, from which a splat is all land.
_LAND_COLOR_DIFFERENCE = 0.16
# Squared Mahalanobis distance from the visible sky's colours, up to which a colour is all sky.
_SKY_DISTANCE2 = 7.0
# Squared Mahalanobis distance from the visible sky's colours, from which a colour is all land.
_LAND_DISTANCE2 = 14.0
# Elevation above the nearest camera up to which a splat is all land.
_LAND_ELEVATION_DEG = 0.5
# Elevation above the nearest camera from which a splat may be all sky.
_SKY_ELEVATION_DEG = 3.0
# Standard deviation added to that of the visible sky, so that a plain sky is not a point.
_FLOOR_STD = 0.01
# Largest number of camera centres from which the sky is looked at.
_MAX_CENTRES = 64


def sky_levels(scene: Scene, maps: StyleMaps) -> Int16[Tensor, "N"] | None:
    """Return how much of every background splat is sky, seen from the nearest camera.

    The result is kept in the scene's memo: it is the same for every style.

    Args:
        scene: the unstyled scene.
        maps: a style's maps; only `sky_moments` is used.

    Returns:
        Levels [N] from 0 (land) to MAX_SKY_LEVEL (sky). None if no splat is sky. None also if that
        cannot be decided: without cameras, without a known direction of gravity, or in front of a
        grey that stands in for an unknown sky.
    """
    sky_moments = maps.sky_moments
    if sky_moments is None or is_unknown_sky(scene.sky):
        return None
    return memo_of(scene).get(
        ("sky levels", sky_moments.numpy().tobytes()), lambda: _find_sky_levels(scene, sky_moments)
    )


def _find_sky_levels(scene: Scene, sky_moments: Float[Tensor, "3 4"]) -> Int16[Tensor, "N"] | None:
    """Compute the sky levels (see `sky_levels`) without the memo."""
    background = scene.background
    centres = _camera_centres(scene)
    if len(centres) == 0 or len(background) == 0 or not scene.has_known_gravity:
        return None
    rgb = np.clip(0.5 + SH_C0 * background.sh[:, 0].double().numpy(), 0, 1)
    sky_likelihood = _ramp(_color_distance2(rgb, sky_moments), _LAND_DISTANCE2, _SKY_DISTANCE2)
    candidates = np.flatnonzero(
        (sky_likelihood > 0) & (background.means[:, 2].numpy() > centres[:, 2].min())
    )
    if len(candidates) == 0:
        return None
    means = background.means[candidates].double().numpy()
    offsets = means - centres[KDTree(centres).query(means)[1]]
    distance = np.maximum(np.linalg.norm(offsets, axis=1), 1e-9)
    elevation_deg = np.degrees(np.arcsin(np.clip(offsets[:, 2] / distance, -1, 1)))
    sky_rgb = scene.sky.sample(torch.from_numpy(offsets.astype(np.float32))).double().numpy()
    sky_share = (
        sky_likelihood[candidates]
        * _ramp(elevation_deg, _LAND_ELEVATION_DEG, _SKY_ELEVATION_DEG)
        * _ramp(
            np.abs(rgb[candidates] - sky_rgb).max(1), _LAND_COLOR_DIFFERENCE, _SKY_COLOR_DIFFERENCE
        )
        * _ramp(_color_distance2(sky_rgb, sky_moments), _LAND_DISTANCE2, _SKY_DISTANCE2)
    )
    levels = np.zeros(len(background), np.int16)
    levels[candidates] = np.round(MAX_SKY_LEVEL * sky_share)
    return torch.from_numpy(levels) if levels.any() else None


def level_maps(maps: StyleMaps) -> Float[Tensor, "R 3 4"]:
    """Return the splats' maps at every sky level, in row C level + class.

    Level 0 has the maps of the splats, level MAX_SKY_LEVEL that of the sky.
    """
    steps = torch.arange(MAX_SKY_LEVEL + 1) / MAX_SKY_LEVEL
    return torch.cat([torch.lerp(maps.splats, maps.sky, step) for step in steps])


def map_rows(
    levels: Int16[Tensor, "N"], classes: Int16[Tensor, "N"] | None, num_maps: int
) -> Int16[Tensor, "N"]:
    """Return the row of `level_maps` for every splat.

    Args:
        levels: sky levels of the splats, [N].
        classes: semantic classes of the splats, [N]; None if they have none.
        num_maps: number C of the splats' maps.
    """
    if num_maps == 1 or classes is None:
        return num_maps * levels
    class_rows = torch.where((classes >= 0) & (classes < num_maps), classes, 0)
    return (num_maps * levels + class_rows).to(torch.int16)


def _camera_centres(scene: Scene) -> np.ndarray:
    """Return centres of at most _MAX_CENTRES cameras, spread over the frames, float64 [P, 3]."""
    centres = [c.centre.numpy() for f in scene.frames for c in f.cameras.values()]
    step = max(1, -(-len(centres) // _MAX_CENTRES))
    return np.asarray(centres[::step], np.float64).reshape(-1, 3)


def _color_distance2(rgb: np.ndarray, sky_moments: Float[Tensor, "3 4"]) -> np.ndarray:
    """Return squared Mahalanobis distances of colours [N, 3] from the visible sky's colours."""
    mean = sky_moments[:, 3].double().numpy()
    covariance = sky_moments[:, :3].double().numpy()
    inverse = np.linalg.inv(covariance + _FLOOR_STD**2 * np.eye(3))
    difference = rgb - mean
    return np.einsum("ni,ij,nj->n", difference, inverse, difference)


def _ramp(value: np.ndarray, zero_at: float, one_at: float) -> np.ndarray:
    """Return a linear ramp: 0 at `zero_at` and beyond, 1 at `one_at` and beyond."""
    return np.clip((value - zero_at) / (one_at - zero_at), 0, 1)


# Number of blocks of Gaussians that a thread takes at a time.
BLOCKS_PER_THREAD = 4


def style_gaussians(
    gaussians: Gaussians,
    maps: StyleMaps,
    *,
    levels: Tensor | None = None,
    out: Tensor | None = None,
    backend: str = AUTO,
) -> Gaussians:
    """Return the Gaussians with mapped SH.

    Every other tensor is shared. If no map changes anything, the Gaussians themselves are returned.

    Args:
        gaussians: Gaussians whose SH are mapped.
        maps: the style's maps.
        levels: sky levels [N] of the Gaussians (see `sky_levels`); None for all land.
        out: memory for the mapped SH, contiguous, with their shape and dtype. It may be
            `gaussians.sh` itself. By default it is new memory, whose first touch takes as long as
            the mapping.
        backend: "cpu" maps float32 without gradients by a kernel, equal to `map_sh` within float
            rounding. "cuda" takes SH on the CPU or the GPU and returns new SH on the GPU. "auto"
            works where the SH are.

    Raises:
        ValueError: there is one map per class, and a class has none; or out does not fit.
    """
    sh = gaussians.sh
    if out is not None:
        _check_out(out, sh)
    splats = maps.splats
    map_of_gaussian = _map_indices(gaussians, len(maps.splats))
    if levels is not None:
        map_of_gaussian = map_rows(levels, gaussians.semantic, len(splats))
        splats = level_maps(maps)
    if out is None and not bool(_change_masks(splats).any()):
        return gaussians
    kernels = choose_kernels(backend, sh)
    if kernels == CPU:
        return dataclasses.replace(
            gaussians, sh=_map_sh_on_cpu(sh, out, map_of_gaussian, fold_maps(splats))
        )
    sh = runtime.gpu_copy(sh) if kernels == CUDA else sh
    if out is not None and out.device != sh.device:
        raise ValueError(f"out must lie on {sh.device}, as what is mapped; got {out.device}")
    mapped = map_sh(sh, splats, map_of_gaussian)
    return dataclasses.replace(gaussians, sh=mapped if out is None else out.copy_(mapped))


def _map_sh_on_cpu(
    sh: Float[Tensor, "N K 3"],
    out: Tensor | None,
    classes: Tensor | None,
    folded_maps: Float[Tensor, "C 13"],
) -> Float[Tensor, "N K 3"]:
    """Map SH by the CPU's kernel, with maps from `fold_maps`."""
    target = _new_memory(sh.shape) if out is None else out
    # A view may begin at any address.
    is_aligned = target.data_ptr() % composite_kernels.ALIGNMENT_BYTES == 0
    kernel_output = target if is_aligned else _new_memory(sh.shape)
    with kernel_threads(BLOCKS_PER_THREAD):
        composite_kernels.apply_color_maps(
            sh.detach().contiguous().numpy().reshape(-1),
            kernel_output.detach().numpy().reshape(-1),
            sh.shape[1],
            np.empty(0, np.int16) if classes is None else classes.contiguous().numpy(),
            folded_maps.numpy(),
        )
    return target if is_aligned else target.copy_(kernel_output)


def style_actor(actor: Actor, maps: StyleMaps) -> Actor:
    """Return the actor with mapped colours at all times.

    Its colour waves add to sh_00, so only the linear part M acts on them.
    """
    waves = actor.color_waves
    splats = maps.splats
    if waves is not None:
        matrices = fold_maps(splats, waves.coefficients.dtype)[:, :9].reshape(-1, 3, 3)
        classes = _map_indices(actor.gaussians, len(splats))
        actor_matrices = matrices[:1] if classes is None else matrices[classes.long()]
        coefficients = torch.einsum(
            "nij,ntj->nti", actor_matrices.expand(len(actor.gaussians), 3, 3), waves.coefficients
        )
        waves = dataclasses.replace(waves, coefficients=coefficients)
    gaussians = style_gaussians(actor.gaussians, maps)
    return dataclasses.replace(actor, gaussians=gaussians, color_waves=waves)


def map_sh(
    sh: Float[Tensor, "N K 3"], maps: Float[Tensor, "C 3 4"], classes: Tensor | None = None
) -> Float[Tensor, "N K 3"]:
    """Return SH of the mapped colours, in plain torch: the definition of the mapping.

    A map that changes nothing leaves every bit of its splats. With SH of degree 0, a colour below 0
    is mapped as black, which is the colour that it shows.

    Args:
        sh: SH coefficients of N Gaussians.
        maps: C maps (M, b).
        classes: row of `maps` for each Gaussian, [N]; None for the first row.
    """
    folded_maps = fold_maps(maps, sh.dtype).to(sh.device)
    if classes is None:
        rows = folded_maps[:1].expand(len(sh), sh_layout.NUM_FOLDED)
    else:
        rows = folded_maps[classes.long().to(sh.device)]
    visible_sh = sh.clamp_min(float(sh_layout.BLACK_SH_00)) if sh.shape[1] == 1 else sh
    mapped = torch.einsum("nij,nkj->nki", rows[:, :9].reshape(-1, 3, 3), visible_sh)
    first_band = mapped[:, :1] + rows[:, None, 9:12]
    mapped = torch.cat([first_band, mapped[:, 1:]], 1)
    return torch.where(rows[:, 12, None, None] != 0, mapped, sh)


def fold_maps(
    maps: Float[Tensor, "C 3 4"], dtype: torch.dtype = torch.float32
) -> Float[Tensor, "C 13"]:
    """Return maps of colours as maps of SH, computed in float64.

    Returns:
        For each map [13]: M row by row (9), the offset of sh_00 (3), and 1 if the map changes
        anything, else 0.
    """
    maps64 = maps.detach().double()
    matrix = maps64[:, :, :3]
    offset = maps64[:, :, 3]
    first_band_offset = (0.5 * matrix.sum(2) + offset - 0.5) / SH_C0
    change_masks = _change_masks(maps).double()[:, None]
    return torch.cat([matrix.reshape(-1, 9), first_band_offset, change_masks], 1).to(dtype)


def style_sky(sky: Sky, color_map: Float[Tensor, "3 4"]) -> Sky:
    """Return the sky with mapped colours, clamped to [0, 1]; the same sky if nothing changes.

    Skies made of texels are mapped texel by texel. A map is affine, as interpolation is, so the two
    commute except where the clamp acts.
    """
    if not bool(_change_masks(color_map[None])):
        return sky
    for sky_type, texel_field in (
        (ConstantSky, "rgb"),
        (LatLongSky, "image"),
        (CubemapSky, "faces"),
    ):
        if isinstance(sky, sky_type):
            return sky_type(_apply_clamped(getattr(sky, texel_field), color_map))
    return MappedSky(sky, color_map)


@dataclass(frozen=True, eq=False)
class MappedSky:
    """A sky of any type whose samples are mapped."""

    sky: Sky
    """The unmapped sky."""

    color_map: Float[Tensor, "3 4"]
    """Map (M, b) of its colours."""

    def sample(self, directions: Float[Tensor, "*B 3"]) -> Float[Tensor, "*B 3"]:
        """Return the mapped colours of the sky in the given directions."""
        return _apply_clamped(self.sky.sample(directions), self.color_map)


def style_scene(scene: Scene, maps: StyleMaps) -> Scene:
    """Return the scene with mapped background, actors and sky.

    Background splats that paint sky take the sky's map (see `sky_levels`).
    """
    return dataclasses.replace(
        scene,
        background=style_gaussians(scene.background, maps, levels=sky_levels(scene, maps)),
        actors=tuple(style_actor(actor, maps) for actor in scene.actors),
        sky=style_sky(scene.sky, maps.sky),
    )


def _new_memory(shape: tuple[int, ...]) -> Tensor:
    """Return uninitialised float32 memory, aligned for the kernel.

    NumPy allocates it, because NumPy asks the system for huge pages: the first touch of memory from
    torch takes several times as long as the mapping.
    """
    count = math.prod(shape)
    num_spare = composite_kernels.ALIGNMENT_BYTES // 4
    memory = np.empty(count + num_spare, np.float32)
    first_aligned = -memory.ctypes.data % composite_kernels.ALIGNMENT_BYTES // 4
    return torch.from_numpy(memory[first_aligned : first_aligned + count]).view(tuple(shape))


def _apply_clamped(rgb: Tensor, color_map: Tensor) -> Tensor:
    """Return colours [..., 3] under the map, clamped to [0, 1]."""
    color_map = color_map.to(rgb.dtype)
    return (rgb @ color_map[:, :3].T + color_map[:, 3]).clamp(0, 1)


def _change_masks(maps: Tensor) -> Tensor:
    """Return True for each map that is not the identity, bool [C]."""
    return (maps != torch.eye(3, 4, dtype=maps.dtype)).flatten(1).any(1)


def _map_indices(gaussians: Gaussians, num_maps: int) -> Tensor | None:
    """Return every Gaussian's row among the maps, [N]; None if all take the first."""
    classes = gaussians.semantic
    if num_maps == 1 or classes is None or not len(classes):
        return None
    values = classes.cpu().numpy()  # torch's min and max take longer on the CPU
    min_class = int(values.min())
    max_class = int(values.max())
    if min_class < 0 or max_class >= num_maps:
        raise ValueError(
            f"the style has maps for classes 0 to {num_maps - 1}; the Gaussians' classes are "
            f"{min_class} to {max_class}"
        )
    return classes


def _check_out(out: Tensor, sh: Tensor) -> None:
    """Raise ValueError unless `out` can hold the mapped SH."""
    if tuple(out.shape) != tuple(sh.shape) or out.dtype != sh.dtype or not out.is_contiguous():
        raise ValueError(
            f"out must be contiguous {sh.dtype} {list(sh.shape)}, as the SH; got "
            f"{'' if out.is_contiguous() else 'strided '}{out.dtype} {list(out.shape)}"
        )
