"""GSCM: the style network, two linear colour maps whose middle matrix an encoder predicts.

Ke et al. 2023 and ClimateGS, "3D Gaussian Color Mapping". A colour c (a row) becomes c P T Q, with
P and Q trained and T = E(picture), k x k. The content stage (nGSCM, T = f_c of the content) takes
colours to a common space, the style stage (sGSCM, T = f_s of the style) from there to the style's.
Nothing in between is nonlinear, so each stage folds to a 3x4 map and both to one.

Two departures, both to switch off. offset: c carries a homogeneous 1, so that maps move the mean
(False: the paper's 3x3). moments: T starts at the transport between the picture's colour moments
and a mean photo's, and the encoder predicts what to multiply it with (False: T starts at the
identity).
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch
from jaxtyping import Float
from torch import Tensor, nn

from augment.style.encoder import build_encoder
from augment.style.moments import MOMENT_FEATURES, Moments, image_moments

SIZE_PX = 256  # of the pictures that the encoder is given
LATENT = 16  # the paper's k
HIDDEN = 96  # of the layer between features and T
HEAD_SCALE = 0.1  # of T, so that a step of the optimiser is a small step of the map


class Gscm(nn.Module):
    """The network. encoder: "small" or "b0". k: width of T. offset, moments: see above."""

    def __init__(
        self, encoder: str = "small", k: int = LATENT, offset: bool = True, moments: bool = True
    ) -> None:
        super().__init__()
        rows = 4 if offset else 3
        if k < rows:
            raise ValueError(f"k must be at least {rows}, the width of a colour; got {k}")
        self.encoder_name, self.k, self.offset, self.moments = encoder, k, offset, moments
        self.size = SIZE_PX
        self.encoder = build_encoder(encoder)
        self.hidden = nn.Linear(self.encoder.width + MOMENT_FEATURES, HIDDEN)
        self.head = nn.Linear(HIDDEN, 2 * k * k)
        self.direct = nn.Linear(MOMENT_FEATURES, 2 * k * k, bias=False)
        for value in (self.head.weight, self.head.bias, self.direct.weight):
            nn.init.zeros_(value)
        basis = _basis(rows, k)
        self.basis = nn.Buffer(basis)  # [rows, k], orthonormal: how T holds a map of colours
        self.content_p, self.style_p = nn.Parameter(basis.clone()), nn.Parameter(basis.clone())
        self.content_q = nn.Parameter(basis[:3].T.clone())
        self.style_q = nn.Parameter(basis[:3].T.clone())

    def encode(
        self, images: Float[Tensor, "B 3 S S"]
    ) -> tuple[Float[Tensor, "B k k"], Float[Tensor, "B k k"]]:
        """f_c and f_s: the content stage's T and the style stage's. images: in [0, 1]."""
        found = image_moments(images, offset=self.offset)
        features = torch.cat([self.encoder(images, found.normal), found.features], dim=1)
        predicted = self.head(nn.functional.silu(self.hidden(features)))
        predicted = HEAD_SCALE * (predicted + self.direct(found.features))
        content, style = predicted.unflatten(1, (2, self.k, self.k)).unbind(1)
        eye = torch.eye(self.k, device=images.device)
        if not self.moments:
            return eye + content, eye + style
        normalise, restore = self._lifted(found)
        # Rows: the moments act first on the content and last on the style.
        return normalise @ (eye + content), (eye + style) @ restore

    def content_map(self, f_c: Float[Tensor, "B k k"]) -> Float[Tensor, "B 3 4"]:
        """nGSCM, folded."""
        return self._fold(self.content_p, f_c, self.content_q)

    def style_map(self, f_s: Float[Tensor, "B k k"]) -> Float[Tensor, "B 3 4"]:
        """sGSCM, folded."""
        return self._fold(self.style_p, f_s, self.style_q)

    def apply_factors(
        self,
        f_c: Float[Tensor, "B k k"],
        f_s: Float[Tensor, "B k k"],
        colors: Float[Tensor, "B N 3"],
    ) -> Float[Tensor, "B N 3"]:
        """Both stages factor by factor: what the folded maps must agree with."""
        content = self._homogeneous(colors) @ self.content_p @ f_c @ self.content_q
        return self._homogeneous(content) @ self.style_p @ f_s @ self.style_q

    def _homogeneous(self, colors: Float[Tensor, "B N 3"]) -> Float[Tensor, "B N rows"]:
        return nn.functional.pad(colors, (0, 1), value=1.0) if self.offset else colors

    def _fold(
        self, p: Float[Tensor, "rows k"], t: Float[Tensor, "B k k"], q: Float[Tensor, "k 3"]
    ) -> Float[Tensor, "B 3 4"]:
        folded = (p @ t @ q).transpose(1, 2)  # [B, 3, rows]
        return folded if self.offset else nn.functional.pad(folded, (0, 1))

    def _lifted(self, found: Moments) -> tuple[Float[Tensor, "B k k"], Float[Tensor, "B k k"]]:
        """The moments' maps of colours, as T's that leave the rest of the space alone."""
        eye = torch.eye(self.k, device=self.basis.device)
        small = torch.eye(len(self.basis), device=self.basis.device)
        lift = self.basis.T  # [k, rows]
        maps = (found.normalise, found.restore)
        first, second = (eye + lift @ (m.transpose(1, 2) - small) @ lift.T for m in maps)
        return first, second


def compose(
    second: Float[Tensor, "*B 3 4"], first: Float[Tensor, "*B 3 4"]
) -> Float[Tensor, "*B 3 4"]:
    """The map that does `first`, then `second`."""
    matrix = second[..., :3] @ first[..., :3]
    offset = second[..., :3] @ first[..., 3:] + second[..., 3:]
    return torch.cat([matrix, offset], dim=-1)


def apply_map(
    maps: Float[Tensor, "B 3 4"], colors: Float[Tensor, "B *N 3"]
) -> Float[Tensor, "B *N 3"]:
    """Colours under their own map each, not clamped."""
    flat = colors.flatten(1, -2) @ maps[:, :, :3].transpose(1, 2) + maps[:, None, :, 3]
    return flat.view(colors.shape)


def gscm_map(
    net: Gscm, content: Float[Tensor, "B 3 S S"], style: Float[Tensor, "1 3 S S"]
) -> Float[Tensor, "3 4"]:
    """The one map of a scene and a style picture."""
    return compose(style_side(net, style), content_side(net, content))


def content_side(net: Gscm, content: Float[Tensor, "B 3 S S"]) -> Float[Tensor, "3 4"]:
    """nGSCM of a scene, the same for every style; f_c is the mean over the scene's pictures."""
    with _one_thread(net):
        f_c, _ = net.encode(content)
        return net.content_map(f_c.mean(0, keepdim=True))[0]


def style_side(net: Gscm, style: Float[Tensor, "1 3 S S"]) -> Float[Tensor, "3 4"]:
    """sGSCM of a style picture, the same for every scene."""
    with _one_thread(net):
        _, f_s = net.encode(style)
        return net.style_map(f_s)[0]


@contextmanager
def _one_thread(net: Gscm) -> Iterator[None]:
    """Without gradients, and so that bits do not depend on how many threads there are."""
    threads, training = torch.get_num_threads(), net.training
    try:
        torch.set_num_threads(1)
        net.eval()
        with torch.no_grad():
            yield
    finally:
        torch.set_num_threads(threads)
        net.train(training)


def _basis(rows: int, k: int) -> Float[Tensor, "rows k"]:
    """Orthonormal rows of cosines (the DCT-II's first): a fixed start that mixes all of k."""
    place = (torch.arange(k, dtype=torch.float64) + 0.5) * torch.pi / k
    basis = torch.stack([torch.cos(row * place) for row in range(rows)])
    return (basis / basis.norm(dim=1, keepdim=True)).float()
