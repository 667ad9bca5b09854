"""The sky behind the splats, a camera's colour map, and the step to 8 bits: the torch definition.

out = rgb + (1 - alpha) sky(direction),   sky seen through the fog that lies before it
"""

from __future__ import annotations

import functools

import numpy as np
import torch
from jaxtyping import Float, UInt8
from numpy.polynomial import Chebyshev, Polynomial
from torch import Tensor

from augment.cameras import Camera
from augment.render import composite_kernels, picture_kernels
from augment.render.buffers import AUTO, CPU, RenderOutput, kernels_for
from augment.render.fog import (
    Fog,
    airlight_gain,
    blend_airlight,
    optical_depth,
    sky_optical_depth,
    vertical_optical_depth,
    ways_of_raster,
)
from augment.render.threads import kernel_threads
from augment.sky import (
    ConstantSky,
    CubemapSky,
    Sky,
    bordered_faces,
    directions_of_cubemap,
    sample_at,
)

ROWS = 32  # image rows a thread takes at a time
NUM_GAINS = 8  # coefficients of airlight's growth with the slope, which then errs by 1e-6
AIRLIGHT_SIZE = 64  # texels along a face of airlight by elevation, which then errs by 1e-4


def sky_behind(sky: Sky, fog: Fog | None) -> tuple[Sky, Fog | None]:
    """What has to be evaluated per pixel: the sky and the fog before it, or less.

    Uniform fog hides the sky altogether (infinite distance), so only its airlight is left; fog
    without density changes nothing.
    """
    if fog is None or fog.sigma_per_m == 0:
        return sky, None
    if fog.scale_height_m is None:
        return _airlight(fog), None
    return sky, fog


@functools.lru_cache(maxsize=16)
def _airlight(fog: Fog) -> Sky:
    """The airlight of endless fog in every direction."""
    horizon = torch.tensor(fog.rgb, dtype=torch.float32)
    if fog.overcast == 0:
        return ConstantSky(horizon)
    slopes = directions_of_cubemap(AIRLIGHT_SIZE)[..., 2]
    return CubemapSky(horizon + airlight_gain(fog, slopes))


@functools.lru_cache(maxsize=16)
def _gains(overcast: float) -> np.ndarray:
    """c of what varying airlight is multiplied by, less 1, at a slope s >= 0: s (c0 + c1 s + ...);
    float32 [NUM_GAINS], zeros without overcast.
    """

    def per_slope(slopes: np.ndarray) -> np.ndarray:
        fog = Fog(0.0, (1.0, 1.0, 1.0), overcast=overcast)
        return airlight_gain(fog, torch.from_numpy(slopes))[:, 0].numpy() / slopes

    found = Chebyshev.interpolate(per_slope, NUM_GAINS - 1, [0, 1]).convert(kind=Polynomial)
    return np.resize(np.append(found.coef, np.zeros(NUM_GAINS)), NUM_GAINS).astype(np.float32)


def pixels_at_unit_depth(camera: Camera) -> tuple[Float[np.ndarray, " W"], Float[np.ndarray, " H"]]:
    """Where columns and rows lie in the plane at z = 1, float32."""
    u = (np.arange(camera.width) + 0.5 - camera.cx) / camera.fx
    v = (np.arange(camera.height) + 0.5 - camera.cy) / camera.fy
    return u.astype(np.float32), v.astype(np.float32)


def add_elevation(
    raster: RenderOutput, camera: Camera, fog: Fog, *, behind: bool = False, backend: str = CPU
) -> Float[Tensor, "H W 3"]:
    """Colours in fog that were drawn with the airlight of the horizon, with that of their rays.

    raster: colour, alpha and expected depth, by which the fog's share of a pixel is judged, as
    deferred fog does; hence exact for one surface a pixel. behind: with the endless fog behind
    them, too. backend: as of `map_colors`.
    """
    rgb, alpha, depth = raster.rgb, raster.alpha, raster.expected_depth
    assert rgb is not None and alpha is not None and depth is not None
    if kernels_for(backend, rgb, alpha) != CPU or not rgb.is_contiguous():
        tau = optical_depth(fog, *ways_of_raster(raster, camera, fog))
        rays = camera.ray_directions(rgb.dtype, rgb.device)
        gain = airlight_gain(fog, rays[..., 2] / rays.norm(dim=-1))
        seen = rgb + (alpha * -torch.expm1(-tau))[..., None] * gain
        return seen + (1 - alpha)[..., None] * (rgb.new_tensor(fog.rgb) + gain) if behind else seen
    eye, per_height = 0.0, 0.0
    if fog.scale_height_m is not None:
        eye, per_height = float(camera.centre[2]) - fog.base_z_m, 1 / fog.scale_height_m
    medium = fog.sigma_per_m, eye * per_height, per_height
    numbers = camera.world_from_camera[2, :3].numpy(), medium, _gains(fog.overcast)
    numbers = (
        *pixels_at_unit_depth(camera),
        *numbers,
        fog.varying_rgb or fog.rgb,
        fog.rgb if behind else (),
    )
    with kernel_threads(ROWS):
        picture_kernels.add_elevation(
            rgb.detach().numpy(), alpha.detach().contiguous().numpy(),
            depth.detach().contiguous().numpy(),
            *(np.ascontiguousarray(n, np.float32) for n in numbers),
        )  # fmt: skip
    return rgb


def composite_sky(
    rgb: Float[Tensor, "H W 3"],
    alpha: Float[Tensor, "H W"],
    camera: Camera,
    sky: Sky,
    *,
    fog: Fog | None = None,
    backend: str = CPU,
) -> Float[Tensor, "H W 3"]:
    """The finished display-encoded image, not clamped.

    fog: with it the sky is seen through the fog up to infinity. backend: on the CPU, cube maps in
    float32 go through a kernel, equal to this definition within float rounding, unless gradients
    are recorded, which it has none of.
    """
    sky, fog = sky_behind(sky, fog)
    if isinstance(sky, ConstantSky) and fog is None:  # no direction matters
        if kernels_for(backend, rgb, alpha) == CPU:
            return _composite_constant(rgb, alpha, sky)
        return rgb + (1 - alpha)[..., None] * sky.rgb.to(rgb.device, rgb.dtype)
    if camera.is_orthographic:
        raise ValueError(
            f"camera {camera.name!r} is orthographic: its rays are parallel and see the sky in one "
            f"direction only; composite a ConstantSky, without layered fog"
        )
    if isinstance(sky, CubemapSky) and kernels_for(backend, rgb, alpha) == CPU:
        return _composite_cubemap(rgb, alpha, camera, bordered_faces(sky), fog)
    directions = camera.ray_directions(rgb.dtype, rgb.device)
    color = sample_at(sky, directions)
    if fog is not None:
        slope = directions[..., 2] / directions.norm(dim=-1)
        tau = sky_optical_depth(fog, slope, float(camera.centre[2]))
        color = blend_airlight(color, tau, fog, slope)
    return rgb + (1 - alpha)[..., None] * color


def _composite_constant(rgb: Tensor, alpha: Tensor, sky: ConstantSky) -> Tensor:
    out = np.empty((*alpha.shape, 3), np.float32)
    color = sky.rgb.detach().to(torch.float32).numpy()
    with kernel_threads(ROWS):
        composite_kernels.composite_constant(
            rgb.detach().contiguous().numpy(), alpha.detach().contiguous().numpy(), color, out
        )
    return torch.from_numpy(out)


def _composite_cubemap(
    rgb: Tensor, alpha: Tensor, camera: Camera, faces: Tensor, fog: Fog | None
) -> Tensor:
    out = np.empty((camera.height, camera.width, 3), np.float32)
    strength, gains, airlight, varying = -1.0, _gains(0.0), (0.0, 0.0, 0.0), None
    if fog is not None:
        strength = vertical_optical_depth(fog, float(camera.centre[2]))
        gains, airlight, varying = _gains(fog.overcast), fog.rgb, fog.varying_rgb
    with kernel_threads(ROWS):
        composite_kernels.composite_cubemap(
            rgb.detach().contiguous().numpy(), alpha.detach().contiguous().numpy(),
            faces.contiguous().numpy(), camera.world_from_camera[:3, :3].numpy().astype(np.float32),
            np.float32(1 / camera.fx), np.float32(1 / camera.fy), np.float32(camera.cx),
            np.float32(camera.cy), np.float32(min(strength, 1e30)), gains,
            np.asarray(airlight, np.float32), np.asarray(varying or airlight, np.float32), out,
        )  # fmt: skip
    return torch.from_numpy(out)


def map_colors(
    rgb: Float[Tensor, "H W 3"], color_map: Float[Tensor, "3 4"], *, backend: str = CPU
) -> Float[Tensor, "H W 3"]:
    """M[:, :3] @ rgb + M[:, 3] at every pixel, not clamped.

    backend: on the CPU, float32 without gradients goes through a kernel, equal to this definition
    within float rounding, and `rgb` is overwritten: fresh memory would take as long as the
    arithmetic.
    """
    if kernels_for(backend, rgb, color_map) != CPU or not rgb.is_contiguous():
        color_map = color_map.to(rgb.device, rgb.dtype)
        return rgb @ color_map[:, :3].T + color_map[:, 3]
    with kernel_threads(ROWS):
        composite_kernels.map_colors(rgb.detach().numpy(), color_map.detach().contiguous().numpy())
    return rgb


def to_bytes(rgb: Float[Tensor, "H W 3"]) -> UInt8[Tensor, "H W 3"]:
    """Clamped to [0, 1], times 255, rounded to the nearest; where rgb lies."""
    rgb = rgb.detach()
    if kernels_for(AUTO, rgb) != CPU:
        return (rgb.clamp(0, 1) * 255 + 0.5).to(torch.uint8)
    out, rows = np.empty(tuple(rgb.shape), np.uint8), rgb.contiguous().numpy()
    with kernel_threads(ROWS):
        composite_kernels.quantise(rows.reshape(len(rows), -1), out.reshape(len(rows), -1))
    return torch.from_numpy(out)


def quantise(rgb: Float[Tensor, "H W 3"]) -> np.ndarray:
    """`to_bytes` as an array."""
    return to_bytes(rgb).cpu().numpy()
