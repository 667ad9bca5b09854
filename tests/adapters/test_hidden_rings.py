"""Depth beyond the LiDAR's view on PandaSet: returns that the scene was built without."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from adapters.lidar_scene.scene import build_lidar_scene
from adapters.pandaset.adapter import read_pandaset
from adapters.raw_drive import DriveOptions
from tests.adapters.hidden_rings import errors_at_hidden, hide_top_returns

DRIVE = Path(__file__).resolve().parents[3] / "shared/data/pandaset_mini/002"


@pytest.mark.long
@pytest.mark.skipif(not DRIVE.exists(), reason="needs the PandaSet mini sample beside the project")
def test_hidden_returns_get_a_surface_at_about_their_depth():
    options = DriveOptions()
    drive, hidden_points = hide_top_returns(read_pandaset(str(DRIVE), {}, options), 0.85)
    errors = errors_at_hidden(build_lidar_scene(drive, options), drive.used[1::8], hidden_points)
    joined = np.concatenate(list(errors.values()))
    # Measured in every fourth frame: 0.1 % without a surface, median 1.3 %, 16.7 % beyond 20 %.
    assert np.isinf(joined).mean() < 0.01
    assert np.median(joined) < 0.05
    assert (joined > 0.2).mean() < 0.2
    assert all(np.median(error) < 0.05 for error in errors.values())
