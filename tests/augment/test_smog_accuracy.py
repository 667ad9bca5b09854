"""Both smog models against exact per-pixel smog, on surfaces that are known exactly."""

import numpy as np
import pytest

from adapters.procedural import open_truth
from adapters.uri import parse_uri
from tests.streets import open_street
from tools.bench.scenes import recipe_of
from tools.bench.smog import smog_error, truth_view

STREET = "procedural:street?seed=3&frames=1&gaussians=150000&parked=4&moving=1&pedestrians=1"


@pytest.fixture(scope="module")
def street():
    scene = open_street(STREET)
    camera = scene.frames[0].cameras["front"].scaled(0.25)
    return scene, truth_view(scene, open_truth(parse_uri(STREET)[2]), camera)


@pytest.mark.long
@pytest.mark.parametrize("model", ["per_gaussian", "deferred"])
@pytest.mark.parametrize("scale_height_m", [None, 15.0])
def test_smog_is_within_a_grey_level_away_from_silhouettes(street, model, scale_height_m):
    scene, view = street
    smog = {"visibility_m": 80, "scale_height_m": scale_height_m, "model": model}
    error = smog_error(recipe_of({"smog": smog}), scene, view)
    smooth = error[view.regions["smooth"]]
    assert len(smooth) > 10_000  # most of the picture that is not sky is measured
    # The bounds a viewer cannot see: one grey level at the median, four at the worst hundredth.
    assert np.median(smooth) <= 1.0
    assert np.quantile(smooth, 0.99) <= 4.0
    # And it is smog that is measured: silhouettes, where two distances mix, do differ.
    assert np.quantile(error[view.regions["silhouette"]], 0.99) > 4.0
