"""What the style network's training is worth, by the losses' own measures: for curves, ablations.

They are defined on one fixed draw of contents and styles, so that networks can be compared.
"""

from __future__ import annotations

import math
from dataclasses import asdict

import torch
from torch import Tensor

from augment.style.features import FeatureExtractor
from augment.style.losses import style_loss
from augment.style.network import Gscm
from augment.style.scene_views import folded_pictures
from augment.style.scores import closed_method, network_method, score_pairs
from augment.style.train_pool import Draw
from augment.style.trainer import transfer_maps

DEFINITIONS = {
    "content_rmse": "root mean square difference of R(Z_c) and R(Z_s), in units of the deviation "
    "of R(Z_c): 0 where the content space knows nothing of the style; a space that was shrunk "
    "gains nothing",
    "restoration_psnr": "dB, of R(Y_c), clamped to [0, 1], against the original picture; mean over "
    "the pictures",
    "style_loss": "L_s of R(Y_s), clamped to [0, 1], against the style picture",
    "same, half, below, look": "PSNR, dB, of held-out photos in styles with a known right result "
    "(augment.style.scores); mkl_* are the closed form's",
}


def score_training(net: Gscm, draw: Draw, features: FeatureExtractor) -> dict[str, float]:
    """The measures above, by name. The network's mode is as before afterwards."""
    training = net.training
    net.eval()
    try:
        with torch.no_grad():
            maps, rendered = transfer_maps(net, draw, through="picture")
            assert rendered is not None
            content, returned, cycled = (
                folded_pictures(draw.pictures, m)
                for m in (maps.content, maps.returned, maps.cycled)
            )
            deviation = content.std((2, 3), correction=0).mean(1)
            rmse = (content - returned).square().mean((1, 2, 3)).sqrt()
            return {
                "content_rmse": float((rmse / deviation.clamp_min(1e-6)).mean()),
                "restoration_psnr": _psnr(cycled.clamp(0, 1), draw.pictures),
                "style_loss": float(
                    style_loss(features(rendered.clamp(0, 1)), features(draw.styles))
                ),
            }
    finally:
        net.train(training)


def score_photos(net: Gscm, photos: Tensor, *, repeats: int = 2) -> dict[str, float]:
    """PSNR of photos uint8 [P, 3, S, S] with a known right result, and the closed form's beside it;
    nothing of fewer than two photos. The network is left in the mode for use.
    """
    if len(photos) < 2:
        return {}
    net = net.cpu().eval()
    pictures = photos.float() / 255
    ours = score_pairs(network_method(net), pictures, repeats=repeats)
    closed = score_pairs(closed_method("mkl"), pictures, repeats=repeats)
    return asdict(ours) | {f"mkl_{name}": value for name, value in asdict(closed).items()}


def _psnr(found: Tensor, wanted: Tensor) -> float:
    errors = (found - wanted).square().mean((1, 2, 3)).clamp_min(1e-6)  # 60 dB at most
    return float((-10 / math.log(10) * errors.log()).mean())
