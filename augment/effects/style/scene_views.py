"""Views of a scene under colour maps that are being learnt: rendered, or folded into a picture.

A map (M, b) takes a Gaussian's colour c to M c + b. Blending is linear in the colours: with the
weights w of a pixel's splats, which depend on geometry alone,

    R(F(Y)) = sum w (M c + b) = M R(Y) + b alpha

wherever no colour is clamped at 0, before or after the map. The transposed blend of the gradient,
which is what the renderer's backward pass hands to every colour, adds up over the Gaussians to
exactly the gradients of the right side:

    dL/dM = sum_i (sum_p w_ip dL/dR_p) c_i^T = sum_p dL/dR_p R(Y)_p^T
    dL/db = sum_p alpha_p dL/dR_p

So a scene is rendered once, and every step after that costs a 3 x 4 product a pixel
(`folded_pictures`). `rendered_pictures` is the definition that this is checked against. The sky is
mapped with the same map, (1 - alpha)(M sky + b): together M I + b of the whole picture I.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from augment.cameras import Camera
from augment.effects.style.content import select_views
from augment.effects.style.losses import GaussianColors
from augment.errors import SceneError
from augment.render.buffers import ALPHA, RGB
from augment.render.rasterize import rasterize
from augment.render.sh import SH_C0
from augment.scene import Gaussians, PosedGaussians, Scene

KEPT_COLORS = 65536  # Gaussians of a scene that are remembered to draw samples from


@dataclass(frozen=True, eq=False)
class SceneView:
    """What a camera sees of a scene, float32, display-encoded.

    picture [3, H, W]: with the sky. alpha [1, H, W]: of the Gaussians. sky [3, H, W]: of the sky
    alone, everywhere. parts: the Gaussians that the picture shows, for `rendered_pictures`.
    """

    camera: Camera
    picture: Float[Tensor, "3 H W"]
    alpha: Float[Tensor, "1 H W"]
    sky: Float[Tensor, "3 H W"]
    parts: tuple[PosedGaussians, ...]

    def to(self, device: str | torch.device) -> SceneView:
        """The same on the device, where `rendered_pictures` then renders it."""
        images = (self.picture.to(device), self.alpha.to(device), self.sky.to(device))
        return SceneView(self.camera, *images, tuple(_moved(part, device) for part in self.parts))


def views_of(
    scene: Scene, count: int, size_px: int, *, with_parts: bool = False
) -> list[SceneView]:
    """At most `count` views, cameras in turn and spread over the drive, squeezed into squares.

    The whole picture is rendered into size_px x size_px pixels, as an encoder sees pictures.
    with_parts: keep the Gaussians too; a view without them cannot be rendered again.

    Raises:
        SceneError: the scene has no cameras.
    """
    cameras = select_views(scene, None, count)
    if not cameras:
        raise SceneError(
            f"scene {scene.name!r} ({scene.source}) has no cameras to look through; name some with "
            f"camera_path=FILE in its URI"
        )
    squeezed = (camera.resized(size_px, size_px) for camera in cameras)
    return [open_view(scene, camera, with_parts=with_parts) for camera in squeezed]


def open_view(scene: Scene, camera: Camera, *, with_parts: bool = True) -> SceneView:
    """Renders one view. with_parts: see `views_of`."""
    parts = scene.parts_for(camera)
    output = rasterize(parts, camera, buffers=(RGB, ALPHA))
    assert output.rgb is not None and output.alpha is not None
    sky = scene.sky.sample(camera.ray_directions()).permute(2, 0, 1).contiguous()
    alpha = output.alpha[None]
    picture = output.rgb.permute(2, 0, 1) + (1 - alpha) * sky
    return SceneView(camera, picture, alpha, sky, _seen(parts, camera) if with_parts else ())


def folded_pictures(
    pictures: Float[Tensor, "B 3 H W"], maps: Float[Tensor, "B 3 4"]
) -> Float[Tensor, "B 3 H W"]:
    """Views' pictures with the Gaussians and the sky mapped, one map each: M I + b.

    Differentiable in the maps. Nothing is clamped: values below 0 or above 1 stay.
    """
    batch, _, height, width = pictures.shape
    flat = torch.baddbmm(maps[:, :, 3:], maps[:, :, :3], pictures.reshape(batch, 3, -1))
    return flat.reshape(batch, 3, height, width)


def rendered_pictures(
    views: Sequence[SceneView], maps: Float[Tensor, "B 3 4"]
) -> Float[Tensor, "B 3 H W"]:
    """As `folded_pictures`, by mapping the spherical harmonics and rendering: the definition.

    Differentiable in the maps through the renderer's backward pass, which works out the geometry's
    gradients beside the colours' (about a forward pass more than the transposed blend alone would).
    """
    return torch.stack([_rendered(view, m) for view, m in zip(views, maps, strict=True)])


def map_sh(sh: Float[Tensor, "N K 3"], color_map: Float[Tensor, "3 4"]) -> Float[Tensor, "N K 3"]:
    """Spherical harmonics of the mapped colours, differentiable in the map.

    Colour is 0.5 + sum sh Y: the lowest band takes the offset, M (C0 sh + 0.5) + b = C0 sh' + 0.5.
    """
    linear, offset = color_map[:, :3], color_map[:, 3]
    shift = (linear.sum(1) / 2 + offset - 0.5) / SH_C0  # M 0.5 + b - 0.5
    mapped = sh @ linear.T
    return torch.cat([mapped[:, :1] + shift, mapped[:, 1:]], 1)


def colors_of(scene: Scene, *, count: int = KEPT_COLORS, seed: int = 0) -> GaussianColors:
    """Colours of the scene's Gaussians, actors among them: of `count` drawn evenly, or of all.

    Shapes are [1, N, ...]; bands are those of the background's degree.
    """
    parts = scene.all_gaussians
    k = max(part.sh.shape[1] for part in parts)
    sizes = torch.tensor([len(part) for part in parts])
    total = int(sizes.sum())
    if total > count:
        generator = torch.Generator().manual_seed(seed)
        index = torch.randint(total, (count,), generator=generator).sort().values
    else:
        index = torch.arange(total)
    ends = sizes.cumsum(0)
    chosen = []
    for part, end in zip(parts, ends.tolist(), strict=True):
        own = index[(index >= end - len(part)) & (index < end)] - (end - len(part))
        sh = part.sh[own].float()
        chosen.append(torch.nn.functional.pad(sh, (0, 0, 0, k - sh.shape[1])))
    values = SH_C0 * torch.cat(chosen)[None]
    return GaussianColors(values[:, :, 0] + 0.5, values[:, :, 1:])


def _rendered(view: SceneView, color_map: Tensor) -> Tensor:
    if not view.parts:
        raise ValueError("a view without its Gaussians cannot be rendered: open it with_parts")
    parts = [_with_sh(part, map_sh(part.gaussians.sh, color_map)) for part in view.parts]
    output = rasterize(parts, view.camera, buffers=(RGB, ALPHA))
    assert output.rgb is not None
    sky = folded_pictures(view.sky[None], color_map[None])[0]
    return output.rgb.permute(2, 0, 1) + (1 - view.alpha) * sky


def _with_sh(part: PosedGaussians, sh: Tensor) -> PosedGaussians:
    return dataclasses.replace(part, gaussians=dataclasses.replace(part.gaussians, sh=sh))


def _moved(part: PosedGaussians, device: str | torch.device) -> PosedGaussians:
    own = part.gaussians
    columns = (own.means, own.quats, own.scales, own.opacities, own.sh)
    semantic = None if own.semantic is None else own.semantic.to(device)
    there = Gaussians(*(column.to(device) for column in columns), semantic=semantic)
    return dataclasses.replace(part, gaussians=there)


def _seen(parts: Sequence[PosedGaussians], camera: Camera) -> tuple[PosedGaussians, ...]:
    """The parts without the Gaussians that no pixel shows: the same picture from far fewer.

    A Gaussian is shown where its colour has a gradient; all are grey here, so that none is clamped.
    """
    grey = [
        torch.zeros(len(part.gaussians), 1, 3, dtype=part.gaussians.sh.dtype, requires_grad=True)
        for part in parts
    ]
    probes = [_with_sh(part, sh) for part, sh in zip(parts, grey, strict=True)]
    output = rasterize(probes, camera, buffers=(RGB, ALPHA))
    assert output.rgb is not None
    output.rgb.sum().backward()
    kept = []
    for part, sh in zip(parts, grey, strict=True):
        assert sh.grad is not None
        index = torch.nonzero(sh.grad[:, 0, 0] != 0)[:, 0]
        if len(index):
            kept.append(dataclasses.replace(part, gaussians=part.gaussians.select(index)))
    return tuple(kept) or tuple(parts[:1])
