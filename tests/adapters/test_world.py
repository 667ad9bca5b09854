"""Axes, unit and origin: geometry and appearance turn together."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from adapters.world import WorldChange, nearest_axis, parse_up, rotation_to_z_up
from augment.errors import AdapterError
from augment.geometry import rotmat_from_quat
from augment.render.sh import evaluate_sh
from augment.scene import Gaussians


def test_parse_up() -> None:
    assert parse_up("-y").tolist() == [0, -1, 0]
    assert parse_up("Z").tolist() == parse_up("+z").tolist() == [0, 0, 1]
    np.testing.assert_allclose(parse_up("0, -3, 4"), [0, -0.6, 0.8])
    for text in ("", "up", "+w", "--z", "0,0,0", "1,2", "nan,0,1", "1e999,0,0"):
        with pytest.raises(AdapterError, match="up must be"):
            parse_up(text)


@pytest.mark.parametrize("axis", ["+x", "-x", "+y", "-y", "+z", "-z"])
def test_axes_turn_exactly(axis: str) -> None:
    rotation = rotation_to_z_up(parse_up(axis))
    assert (rotation @ parse_up(axis)).tolist() == [0, 0, 1]
    assert np.linalg.det(rotation) == 1
    assert set(np.abs(rotation).ravel()) == {0, 1}
    assert nearest_axis(parse_up(axis)) == axis


@pytest.mark.parametrize("tilt", [1e-9, 1e-7, 1e-5, 0.1, 1.5, 3.0])
def test_any_direction_turns_to_up(tilt: float) -> None:
    """Also next to -z, where the half-way direction almost vanishes."""
    up = np.array([np.sin(tilt), 0, -np.cos(tilt)])
    rotation = rotation_to_z_up(up)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) > 0
    np.testing.assert_allclose(rotation @ up, [0, 0, 1], atol=2e-8)


def test_gaussians_turn_with_their_colours() -> None:
    """Shape, place, and the colour seen from a direction that turns along."""
    rng = torch.Generator().manual_seed(3)
    quats = torch.nn.functional.normalize(torch.randn(6, 4, generator=rng), dim=1)
    source = Gaussians(
        means=torch.randn(6, 3, generator=rng),
        quats=quats,
        scales=torch.rand(6, 3, generator=rng) + 0.1,
        opacities=torch.rand(6, generator=rng),
        sh=torch.randn(6, 16, 3, generator=rng),
    )
    change = WorldChange(rotation_to_z_up(parse_up("0.3,-0.9,0.1")), 2.5, np.array([1.0, 2, 3]))
    moved = change.gaussians(source, np.array([100.0, 0, 0]))
    rotation = torch.from_numpy(change.rotation).float()
    expected = change.points(source.means.double().numpy() + np.array([100.0, 0, 0]))
    np.testing.assert_allclose(moved.means, expected, rtol=1e-6)  # float32 rounding
    torch.testing.assert_close(moved.scales, 2.5 * source.scales)

    def covariances(g: Gaussians) -> torch.Tensor:
        axes = rotmat_from_quat(g.quats) * g.scales[:, None]
        return axes @ axes.transpose(1, 2)

    turned = 2.5**2 * rotation @ covariances(source) @ rotation.T
    torch.testing.assert_close(covariances(moved), turned, rtol=1e-5, atol=1e-6)
    seen = torch.nn.functional.normalize(torch.randn(6, 3, generator=rng), dim=1)
    colours = evaluate_sh(source.sh, seen)
    torch.testing.assert_close(
        evaluate_sh(moved.sh, seen @ rotation.T), colours, rtol=1e-4, atol=1e-5
    )


def test_no_change_keeps_the_bits() -> None:
    source = Gaussians.empty()
    assert WorldChange().gaussians(source, np.zeros(3)) is source
