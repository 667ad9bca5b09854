"""The sky behind the splats, a camera's colour map, and the step to 8 bits: the torch definition.

    out = rgb + (1 - alpha) sky(direction),   with the sky seen through the fog that lies before it

`views` and the effects call these functions on rendered images. On the CPU, float32 images go
through the kernels of `composite_kernels` and `picture_kernels`.
"""

from __future__ import annotations

import functools

import numpy as np
import torch
from jaxtyping import Float, UInt8
from numpy.polynomial import Chebyshev, Polynomial
from torch import Tensor

from augment.render import composite_kernels, picture_kernels
from augment.render.buffers import AUTO, CPU, RenderOutput, choose_kernels
from augment.render.fog import Fog, airlight_gain, blend_airlight, vertical_optical_depth
from augment.render.fog_image import (
    fits_plain_kernels,
    image_optical_depth,
    plain_fog_depth,
    sky_image_means,
    sky_ray_depth,
)
from augment.render.threads import kernel_threads
from augment.scene.cameras import Camera
from augment.scene.sky import (
    ConstantSky,
    CubemapSky,
    Sky,
    bordered_faces,
    directions_of_cubemap,
    sample_at,
)

# Image rows that a thread takes at a time.
ROWS_PER_CHUNK = 32
# Number of coefficients of the airlight's growth with the slope; it then errs by 1e-6.
NUM_GAINS = 8
# Texels along a face of the airlight by elevation; it then errs by 1e-4.
AIRLIGHT_SIZE = 64


def simplify_sky(sky: Sky, fog: Fog | None) -> tuple[Sky, Fog | None]:
    """Return the sky and the fog that have to be evaluated per pixel, simplified where possible.

    Uniform fog hides the sky altogether (infinite distance), so only its airlight is left. Fog
    without density changes nothing.
    """
    if fog is None or fog.extinction_per_m == 0:
        return sky, None
    if fog.scale_height_m is None:
        return _airlight(fog), None
    return sky, fog


@functools.lru_cache(maxsize=16)
def _airlight(fog: Fog) -> Sky:
    """Return the airlight of endless fog in every direction, as a sky."""
    horizon = torch.tensor(fog.airlight_rgb, dtype=torch.float32)
    if fog.elevation_gain == 0:
        return ConstantSky(horizon)
    slopes = directions_of_cubemap(AIRLIGHT_SIZE)[..., 2]
    return CubemapSky(horizon + airlight_gain(fog, slopes))


@functools.lru_cache(maxsize=16)
def airlight_gains(elevation_gain: float) -> np.ndarray:
    """Return coefficients c of the varying airlight's growth with the slope, float32 [NUM_GAINS].

    At a slope s >= 0 the varying airlight is multiplied by 1 + s (c0 + c1 s + ...). The
    coefficients are zeros if elevation_gain is 0.
    """

    def per_slope(slopes: np.ndarray) -> np.ndarray:
        """Return the growth of the airlight at slopes, over the slope."""
        fog = Fog(0.0, (1.0, 1.0, 1.0), elevation_gain=elevation_gain)
        return airlight_gain(fog, torch.from_numpy(slopes))[:, 0].numpy() / slopes

    series = Chebyshev.interpolate(per_slope, NUM_GAINS - 1, [0, 1]).convert(kind=Polynomial)
    return np.resize(np.append(series.coef, np.zeros(NUM_GAINS)), NUM_GAINS).astype(np.float32)


def unit_depth_coordinates(
    camera: Camera,
) -> tuple[Float[np.ndarray, " W"], Float[np.ndarray, " H"]]:
    """Return the positions of columns and rows in the plane at z = 1, float32."""
    u = (np.arange(camera.width) + 0.5 - camera.cx) / camera.fx
    v = (np.arange(camera.height) + 0.5 - camera.cy) / camera.fy
    return u.astype(np.float32), v.astype(np.float32)


def add_airlight_elevation(
    raster: RenderOutput,
    camera: Camera,
    fog: Fog,
    *,
    has_fog_behind: bool = False,
    backend: str = CPU,
) -> Float[Tensor, "H W 3"]:
    """Return colours whose airlight is that of their rays, from colours with the airlight of the
    horizon.

    The fog's share of a pixel is judged by its expected depth, as in deferred fog. So the result is
    exact for one surface per pixel.

    Args:
        raster: render with colour, alpha and expected depth; on the CPU its colour is overwritten.
        camera: camera of the render.
        fog: fog of the render.
        has_fog_behind: if True, the endless fog behind the surfaces is added, too.
        backend: as in `map_colors`.
    """
    rgb = raster.rgb
    alpha = raster.alpha
    depth = raster.expected_depth
    assert rgb is not None and alpha is not None and depth is not None
    uses_kernel = choose_kernels(backend, rgb, alpha) == CPU and rgb.is_contiguous()
    if not (uses_kernel and fits_plain_kernels(fog)):
        tau = image_optical_depth(fog, camera, depth, backend=backend)
        rays = camera.ray_directions(rgb.dtype, rgb.device)
        gain = airlight_gain(fog, rays[..., 2] / rays.norm(dim=-1))
        colors = rgb + (alpha * -torch.expm1(-tau))[..., None] * gain
        return (
            colors + (1 - alpha)[..., None] * (rgb.new_tensor(fog.airlight_rgb) + gain)
            if has_fog_behind
            else colors
        )
    eye_above_base_m = 0.0
    per_height = 0.0
    if fog.scale_height_m is not None:
        eye_above_base_m = float(camera.centre[2]) - fog.base_z_m
        per_height = 1 / fog.scale_height_m
    fog_numbers = fog.extinction_per_m, eye_above_base_m * per_height, per_height
    kernel_inputs = (
        camera.world_from_camera[2, :3].numpy(),
        fog_numbers,
        airlight_gains(fog.elevation_gain),
    )
    kernel_inputs = (
        *unit_depth_coordinates(camera),
        *kernel_inputs,
        fog.varying_airlight_rgb or fog.airlight_rgb,
        fog.airlight_rgb if has_fog_behind else (),
    )
    with kernel_threads(ROWS_PER_CHUNK):
        picture_kernels.add_elevation(
            rgb.detach().numpy(),
            alpha.detach().contiguous().numpy(),
            plain_fog_depth(fog, camera, depth.detach()).contiguous().numpy(),
            *(np.ascontiguousarray(n, np.float32) for n in kernel_inputs),
        )
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
    """Return the finished display-encoded image, not clamped.

    Args:
        rgb: premultiplied colour of the splats.
        alpha: alpha of the splats.
        camera: the camera.
        sky: the sky behind the splats.
        fog: fog through which the sky is seen, up to infinity; None for clear air.
        backend: on the CPU, cube maps in float32 go through a kernel, equal to this definition
            within float rounding. Kernels have no gradients, so torch does the work if any are
            recorded.

    Raises:
        ValueError: the camera is orthographic and the sky depends on the direction.
    """
    sky, fog = simplify_sky(sky, fog)
    if isinstance(sky, ConstantSky) and fog is None:  # the sky is the same in all directions
        if choose_kernels(backend, rgb, alpha) == CPU:
            return _composite_constant(rgb, alpha, sky)
        return rgb + (1 - alpha)[..., None] * sky.rgb.to(rgb.device, rgb.dtype)
    if camera.is_orthographic:
        raise ValueError(
            f"camera {camera.name!r} is orthographic: its rays are parallel and see the sky in one "
            f"direction only; composite a ConstantSky, without layered fog"
        )
    if isinstance(sky, CubemapSky) and choose_kernels(backend, rgb, alpha) == CPU:
        return _composite_cubemap(rgb, alpha, camera, bordered_faces(sky), fog)
    directions = camera.ray_directions(rgb.dtype, rgb.device)
    color = sample_at(sky, directions)
    if fog is not None:
        directions = directions / directions.norm(dim=-1, keepdim=True)
        tau = sky_ray_depth(fog, camera, directions)
        color = blend_airlight(color, tau, fog, directions[..., 2])
    return rgb + (1 - alpha)[..., None] * color


def _composite_constant(rgb: Tensor, alpha: Tensor, sky: ConstantSky) -> Tensor:
    """Return the image over a constant sky, by a kernel."""
    out = np.empty((*alpha.shape, 3), np.float32)
    color = sky.rgb.detach().to(torch.float32).numpy()
    with kernel_threads(ROWS_PER_CHUNK):
        composite_kernels.composite_constant(
            rgb.detach().contiguous().numpy(), alpha.detach().contiguous().numpy(), color, out
        )
    return torch.from_numpy(out)


def _composite_cubemap(
    rgb: Tensor, alpha: Tensor, camera: Camera, faces: Tensor, fog: Fog | None
) -> Tensor:
    """Return the image over a cube map, through fog if there is any, by a kernel."""
    out = np.empty((camera.height, camera.width, 3), np.float32)
    strength = -1.0
    gains = airlight_gains(0.0)
    airlight = (0.0, 0.0, 0.0)
    varying = None
    if fog is not None:
        strength = vertical_optical_depth(fog, float(camera.centre[2]))
        gains = airlight_gains(fog.elevation_gain)
        airlight = fog.airlight_rgb
        varying = fog.varying_airlight_rgb
    bank_means = np.empty((0, 0), np.float32)
    if fog is not None and fog.banks is not None:
        bank_means = sky_image_means(fog, camera, alpha).numpy()
    with kernel_threads(ROWS_PER_CHUNK):
        composite_kernels.composite_cubemap(
            rgb.detach().contiguous().numpy(),
            alpha.detach().contiguous().numpy(),
            faces.contiguous().numpy(),
            camera.world_from_camera[:3, :3].numpy().astype(np.float32),
            np.float32(1 / camera.fx),
            np.float32(1 / camera.fy),
            np.float32(camera.cx),
            np.float32(camera.cy),
            np.float32(min(strength, 1e30)),
            gains,
            np.asarray(airlight, np.float32),
            np.asarray(varying or airlight, np.float32),
            bank_means,
            out,
        )
    return torch.from_numpy(out)


def apply_color_map(
    rgb: Float[Tensor, "H W 3"], color_map: Float[Tensor, "3 4"], *, backend: str = CPU
) -> Float[Tensor, "H W 3"]:
    """Return M[:, :3] @ rgb + M[:, 3] at every pixel, not clamped.

    backend: on the CPU, float32 without gradients goes through a kernel, equal to this definition
    within float rounding. Then `rgb` is overwritten: fresh memory would take as long as the
    arithmetic.
    """
    if choose_kernels(backend, rgb, color_map) != CPU or not rgb.is_contiguous():
        color_map = color_map.to(rgb.device, rgb.dtype)
        return rgb @ color_map[:, :3].T + color_map[:, 3]
    with kernel_threads(ROWS_PER_CHUNK):
        composite_kernels.map_colors(rgb.detach().numpy(), color_map.detach().contiguous().numpy())
    return rgb


def to_bytes(rgb: Float[Tensor, "H W 3"]) -> UInt8[Tensor, "H W 3"]:
    """Return the image clamped to [0, 1], times 255, rounded to the nearest, on the same device."""
    rgb = rgb.detach()
    if choose_kernels(AUTO, rgb) != CPU:
        return (rgb.clamp(0, 1) * 255 + 0.5).to(torch.uint8)
    out = np.empty(tuple(rgb.shape), np.uint8)
    rows = rgb.contiguous().numpy()
    with kernel_threads(ROWS_PER_CHUNK):
        composite_kernels.quantise(rows.reshape(len(rows), -1), out.reshape(len(rows), -1))
    return torch.from_numpy(out)


def to_byte_array(rgb: Float[Tensor, "H W 3"]) -> np.ndarray:
    """Return `to_bytes` as an array."""
    return to_bytes(rgb).cpu().numpy()
