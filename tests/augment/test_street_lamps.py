"""Street lamps: on masts, by the rule, and from a list."""

from __future__ import annotations

import dataclasses
import functools

import numpy as np
import pytest
import torch

from adapters.street.layout import draw_layout, parse_parameters
from augment.errors import LampError
from augment.lamps.ies import parse_ies
from augment.lamps.lamp import LampKind
from augment.lamps.street_lamps import (
    MAX_LISTED_LAMPS,
    ListedLamp,
    StreetLampSettings,
    listed_lamps,
    street_lamps,
)
from augment.scene.cameras import Frame
from augment.scene.scene import Gaussians, Scene
from augment.scene.semantics import SemanticClass
from augment.scene.sky import ConstantSky
from tests.augment.test_ies import ies_text
from tests.scenes import camera_ahead
from tests.streets import SMALL_STREET, open_street

# Distance between the Gaussians of a made-up surface, metres.
STEP_M = 0.5


def surface(points: np.ndarray, scales, label: SemanticClass) -> Gaussians:
    count = len(points)
    return Gaussians(
        means=torch.tensor(points, dtype=torch.float32),
        quats=torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(count, 1),
        scales=torch.tensor(scales, dtype=torch.float32).repeat(count, 1),
        opacities=torch.full((count,), 0.95),
        sh=torch.zeros(count, 1, 3),
        semantic=torch.full((count,), int(label), dtype=torch.int16),
    )


def grid(x, y, z) -> np.ndarray:
    return np.stack(np.meshgrid(x, y, z, indexing="ij"), -1).reshape(-1, 3)


def road_scene(*, wall_y: float | None = None, frames: int = 11) -> Scene:
    """A level road along +x at height 0.2 m, with a front at y = wall_y."""
    along = np.arange(-140, 260, STEP_M * 2)
    parts = [
        surface(grid(along, np.arange(-9, 9, 1.0), [0.2]), [0.5, 0.5, 0.01], SemanticClass.ROAD)
    ]
    if wall_y is not None:
        points = grid(np.arange(-140, 260, STEP_M), [wall_y], np.arange(0.2, 12, STEP_M))
        parts.append(surface(points, [0.3, 0.02, 0.3], SemanticClass.BUILDING))
    names = ("means", "quats", "scales", "opacities", "sh", "semantic")
    background = Gaussians(**{n: torch.cat([getattr(part, n) for part in parts]) for n in names})
    frame_list = []
    for i in range(frames):
        ego = torch.eye(4, dtype=torch.float64)
        ego[:3, 3] = torch.tensor([10.0 * i, 0.0, 0.2])
        camera = camera_ahead(position=(10.0 * i, 0.0, 1.7), timestamp_ns=i)
        frame_list.append(Frame(i, i, ego, {"ahead": camera}))
    return Scene(
        name="road",
        source="test:road",
        background=background,
        actors=(),
        sky=ConstantSky(torch.full((3,), 0.5)),
        frames=tuple(frame_list),
        world_origin_m=np.array([1000.0, 2000.0, 50.0]),
    )


@functools.cache
def open_road() -> Scene:
    return road_scene()


def test_masts_of_the_procedural_street_hold_the_lamps_of_its_plan():
    lamps = street_lamps(open_street(), StreetLampSettings())
    query = dict(term.split("=") for term in SMALL_STREET.partition("?")[2].split("&"))
    masts = draw_layout(parse_parameters(query)).lamps
    # Lanterns hang 1.7 m from the mast over the road.
    lanterns = np.stack([masts[:, 0], masts[:, 1] - 1.7 * np.sign(masts[:, 1])], 1)
    distances = np.hypot(*(lanterns[:, None] - lamps.positions_m[None, :, :2]).transpose(2, 0, 1))
    nearest = distances.min(1)
    # Lanterns are known to 0.2 m; a mast whose arm has no splats has its lamp at the top.
    assert len(lamps) == len(masts)
    assert (nearest < 0.25).sum() >= 0.8 * len(masts) and nearest.max() < 2.0
    assert np.all((lamps.positions_m[:, 2] > 6.0) & (lamps.positions_m[:, 2] < 6.8))
    assert np.abs(lamps.axes[:, 0]).min() > 0.95  # along the road
    assert set(lamps.kinds) == {int(LampKind.STREET)}


def test_the_rule_sets_lamps_every_30_m_on_alternate_sides_8_m_over_the_road():
    lamps = street_lamps(open_road(), StreetLampSettings())
    x, y, z = lamps.positions_m[np.argsort(lamps.positions_m[:, 0])].T
    np.testing.assert_allclose(np.diff(x), 30, atol=1e-9)
    np.testing.assert_allclose(np.abs(y), 6, atol=1e-9)
    assert (np.diff(np.sign(y)) != 0).all()
    np.testing.assert_allclose(z, 8.2, atol=1e-5)  # float32 of the road's splats
    # The path of 100 m and 120 m beyond both of its ends.
    assert x.min() == -120 and x.max() == 210
    rights = np.cross(lamps.axes, lamps.ups)
    assert (rights[:, 1] * lamps.positions_m[:, 1] < 0).all()  # the road lies to the right


def test_lamps_of_the_rule_do_not_depend_on_where_the_drive_is_cut_off():
    whole = street_lamps(open_road(), StreetLampSettings()).positions_m
    first_half = street_lamps(road_scene(frames=6), StreetLampSettings()).positions_m
    shared = first_half[first_half[:, 0] <= 50 + 120]
    assert {tuple(row) for row in shared.round(6)} <= {tuple(row) for row in whole.round(6)}


def test_lamps_of_the_rule_step_before_a_front_and_never_behind_it():
    scene = road_scene(wall_y=4.5)
    lamps = street_lamps(scene, StreetLampSettings())
    y = lamps.positions_m[:, 1]
    assert set(y.round(6)) == {4.0, -6.0}
    assert len(lamps) == len(street_lamps(open_road(), StreetLampSettings()))
    narrow = street_lamps(road_scene(wall_y=0.9), StreetLampSettings())
    assert (narrow.positions_m[:, 1] < 0).all()  # no place is free on the left


def test_flux_and_colour_are_those_of_the_settings():
    settings = StreetLampSettings(flux_lm=5_000.0, temperature_k=2_000.0)
    lamps = street_lamps(open_road(), settings)
    np.testing.assert_allclose(4 * np.pi * lamps.mean_intensities_cd, 5_000, rtol=0.01)
    assert lamps.colors[0, 0] > 3 * lamps.colors[0, 2]
    # 8 m below the lamp: 250 cd/klm / h².
    assert lamps.intensities_cd[0] * (250 / 490) / 8**2 == pytest.approx(5 * 250 / 64, rel=1e-6)


def test_luminaires_of_files_replace_the_batwing():
    luminaire = parse_ies(ies_text(), "lamp.ies")
    lamps = street_lamps(open_road(), StreetLampSettings(luminaire=luminaire))
    # The brightest node of the table is near the file's 60 degrees.
    assert lamps.intensities_cd == pytest.approx(400.0, rel=0.02) and len(lamps.tables) == 1
    assert lamps.radii_m[0] == pytest.approx(luminaire.radius_m)


@pytest.mark.parametrize(
    "changes", [{"spacing_m": 0.1}, {"height_m": float("nan")}, {"flux_lm": -1.0}]
)
def test_settings_outside_their_limits_are_refused(changes):
    with pytest.raises(ValueError, match=next(iter(changes))):
        StreetLampSettings(**changes)


def lamp_at(x: float, y: float, z: float, **changes) -> ListedLamp:
    """A lamp at a place of the scene's world, in the dataset's."""
    entry = ListedLamp((1000.0 + x, 2000.0 + y, 50.0 + z), (0.0, 0.0, -1.0), 100.0)
    return dataclasses.replace(entry, **changes)


def test_listed_lamps_lie_in_the_datasets_world():
    kinds = (LampKind.OTHER, LampKind.STREET, LampKind.STOP)
    lamps = listed_lamps(open_road(), [lamp_at(3, 2, 4, kind=kind) for kind in kinds])
    np.testing.assert_allclose(lamps.positions_m, [[3, 2, 4]] * 3)
    assert lamps.kinds.tolist() == [int(kind) for kind in kinds]
    np.testing.assert_allclose(lamps.axes[1], [1, 0, 0])  # a street lamp hangs level
    assert lamps.colors[2, 0] > 4 and (lamps.intensities_cd == 100).all()
    assert len(listed_lamps(open_road(), [])) == 0


BAD_LAMPS = (
    (lamp_at(0, 0, 3, intensity_cd=-5.0), r"lamp 0 .*candela must be >= 0; got -5"),
    (lamp_at(0, 0, 3, intensity_cd=float("inf")), "must be finite"),
    (lamp_at(float("nan"), 0, 3), "must be finite"),
    (lamp_at(0, 0, 3, direction=(0.0, 0.0, 0.0)), "direction must not be zero"),
    (lamp_at(5, 1, -0.8), r"lies 1.00 m under the road.* height 50.20 m"),
    (lamp_at(5, 4.5, 3.2), "lies within a surface"),
)


@pytest.mark.parametrize(("entry", "message"), BAD_LAMPS)
def test_lamps_that_cannot_be_there_are_refused_with_the_reason(entry, message):
    scene = road_scene(wall_y=4.5)
    with pytest.raises(LampError, match=message):
        listed_lamps(scene, [entry])
    assert len(listed_lamps(scene, [lamp_at(5, 4.3, 3.2)])) == 1  # 20 cm before the wall


def test_ten_thousand_listed_lamps_are_refused_with_the_limit():
    with pytest.raises(LampError, match=f"at most {MAX_LISTED_LAMPS} lamps; got 10000"):
        listed_lamps(open_road(), [lamp_at(0, 0, 3)] * 10_000)
