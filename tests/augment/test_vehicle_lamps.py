"""Lamps of vehicles: places, braking, and which are lit."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

from augment.lamps.braking import is_braking, motion_at, travels
from augment.lamps.lamp import EGO_OWNER, LampKind, Lamps
from augment.lamps.vehicle_lamps import (
    OwnLampSettings,
    VehicleLampSettings,
    own_lamps,
    vehicle_lamps,
)
from augment.lamps.vehicle_places import Body, body_of, places_of, points_of
from augment.scene.cameras import Frame
from augment.scene.labels import Boxes
from augment.scene.scene import Actor, Scene, Track
from augment.scene.sky import ConstantSky
from tests.scenes import camera_ahead, one_gaussian

CAR_M = (4.5, 1.8, 1.45)
FRAME_NS = 100_000_000


def straight_track(distance_of_s, *, frames: int = 40, y: float = 0.0, noise_m: float = 0.0):
    """Poses that go along +x, 0.725 m high, by a function of time in seconds."""
    times_ns = torch.arange(frames) * FRAME_NS
    poses = torch.eye(4, dtype=torch.float64).repeat(frames, 1, 1)
    rng = np.random.default_rng(0)
    for i in range(frames):
        poses[i, :3, 3] = torch.tensor([distance_of_s(i / 10), y, CAR_M[2] / 2])
        poses[i, :2, 3] += torch.from_numpy(rng.normal(0, noise_m, 2))
    return Track(times_ns, poses)


def scene_of(actors=(), *, labels=None, frames: int = 21) -> Scene:
    """A drive along +x at 10 m/s with a camera 1.5 m high."""
    frame_list = []
    for i in range(frames):
        ego = torch.eye(4, dtype=torch.float64)
        ego[0, 3] = float(i)
        camera = camera_ahead(position=(i + 0.5, 0.0, 1.5), timestamp_ns=i * FRAME_NS)
        frame_list.append(Frame(i, i * FRAME_NS, ego, {"ahead": camera}))
    return Scene(
        name="road",
        source="test:road",
        background=one_gaussian((5.0, 0.0, 0.0)),
        actors=tuple(actors),
        sky=ConstantSky(torch.full((3,), 0.5)),
        frames=tuple(frame_list),
        labels=labels,
        ground_z_m=0.0,
    )


def car(track_id: str, track: Track, label: str = "Car", size=CAR_M) -> Actor:
    return Actor(track_id, label, one_gaussian((0.0, 0.0, 0.0)), track, size)


def kinds_of(lamps: Lamps) -> list[str]:
    return sorted(LampKind(kind).name for kind in lamps.kinds)


@pytest.mark.parametrize("size", [(3.6, 1.6, 1.4), CAR_M, (5.1, 2.0, 1.95)])
def test_lamps_of_cars_keep_the_heights_and_insets_of_un_r48(size):
    for place in places_of(Body.CAR):
        for x, y, z in points_of(place, size, left_hand_traffic=False):
            height = z + size[2] / 2
            kind = place.lamp_type.kind
            if kind == LampKind.DIPPED:
                assert 0.5 <= height <= 1.2 and x > 0
            if kind in (LampKind.TAIL, LampKind.STOP) and place.inset_m is not None:
                assert 0.35 <= height <= 1.5 and x < 0
            if kind == LampKind.REAR_FOG:
                assert 0.25 <= height <= 1.0 and y > 0
            if place.inset_m is not None and kind != LampKind.REAR_FOG:
                assert size[1] / 2 - abs(y) <= 0.4 and abs(y) >= 0.3


@pytest.mark.parametrize(
    ("label", "size", "body"),
    [
        ("Car", CAR_M, Body.CAR),
        ("vehicle.bus.rigid", (11.0, 2.5, 3.2), Body.TRUCK),
        ("Medium-sized Truck", (5.8, 2.4, 2.5), Body.TRUCK),
        ("Pickup Truck", (5.6, 2.0, 1.9), Body.CAR),
        ("vehicle.trailer", (8.0, 2.5, 3.0), Body.TRAILER),
        ("Motorcycle", (2.0, 0.8, 1.5), Body.MOTORCYCLE),
        ("vehicle.bicycle", (1.7, 0.6, 1.3), Body.BICYCLE),
        ("Cyclist", (1.8, 0.6, 1.7), Body.BICYCLE),
        ("Pedestrian", (0.6, 0.6, 1.8), None),
        ("ego_vehicle", CAR_M, None),
        ("Cones", (0.4, 0.4, 0.8), None),
    ],
)
def test_body_follows_from_label_and_size(label, size, body):
    assert body_of(label, size) is body


def test_deceleration_is_measured_through_the_noise_of_labels():
    slowing = straight_track(lambda s: 15 * s - 1.5 * s**2, noise_m=0.04)
    motion = motion_at(slowing, 2_000_000_000)
    assert motion is not None
    # Twice the standard error that 4 cm of noise give.
    assert motion.deceleration_mps2 == pytest.approx(3.0, abs=0.4)
    assert motion.speed_mps == pytest.approx(9.0, abs=0.2)
    assert is_braking(slowing, 2_000_000_000)


def test_steady_and_slowly_slowing_cars_do_not_brake():
    steady = straight_track(lambda s: 12 * s, noise_m=0.05)
    rolling = straight_track(lambda s: 12 * s - 0.35 * s**2)  # 0.7 m/s²
    faster = straight_track(lambda s: 2 * s + 1.5 * s**2)
    for track in (steady, rolling, faster):
        assert not any(is_braking(track, ns) for ns in range(0, 3_900_000_000, FRAME_NS))


def test_cars_that_stand_in_a_drive_brake_and_parked_ones_do_not():
    waiting = straight_track(lambda s: 3 * max(s - 2.5, 0.0))
    parked = straight_track(lambda s: 0.0, noise_m=0.03)
    assert is_braking(waiting, 1_000_000_000)
    assert travels(parked) is False and not is_braking(parked, 1_000_000_000)
    assert travels(straight_track(lambda s: 0.0, frames=5)) is None


def test_lamps_lie_on_the_box_and_turn_with_it():
    track = straight_track(lambda s: 12 * s)
    turned = dataclasses.replace(track, world_from_actor=track.world_from_actor.clone())
    turned.world_from_actor[:, :2, :2] = torch.tensor([[0.0, -1.0], [1.0, 0.0]])
    for poses, forward in ((track, [1.0, 0.0, 0.0]), (turned, [0.0, 1.0, 0.0])):
        scene = scene_of([car("a", poses)])
        lamps = vehicle_lamps(scene, 1_000_000_000, VehicleLampSettings())
        assert kinds_of(lamps) == ["DIPPED", "DIPPED", "TAIL", "TAIL"]
        fronts = lamps.select(lamps.kinds == LampKind.DIPPED)
        offset = fronts.positions_m.mean(0) - np.array([12.0, 0.0, 0.725])
        np.testing.assert_allclose(offset[:2], 0.9 * 2.25 * np.array(forward)[:2], atol=1e-9)
        np.testing.assert_allclose(fronts.positions_m[:, 2], 0.48 * 1.45)
        np.testing.assert_allclose(fronts.axes, [forward] * 2, atol=1e-12)
        assert lamps.owners.tolist() == [1] * 4


def test_braking_cars_have_stop_lamps_in_place_of_tail_lamps():
    scene = scene_of([car("a", straight_track(lambda s: 15 * s - 1.5 * s**2))])
    lamps = vehicle_lamps(scene, 2_000_000_000, VehicleLampSettings())
    assert kinds_of(lamps) == ["DIPPED", "DIPPED", "STOP", "STOP", "STOP"]
    day = vehicle_lamps(scene, 2_000_000_000, VehicleLampSettings(beam=LampKind.DAYTIME))
    assert kinds_of(day) == ["DAYTIME", "DAYTIME", "STOP", "STOP", "STOP"]


def test_lamps_are_drawn_to_the_surface_of_the_vehicles_splats():
    actor = car("a", straight_track(lambda s: 12 * s))
    wall = one_gaussian((2.1, 0.6, -0.03))
    points = torch.tensor([2.1, 0.6, -0.03]).repeat(20, 1)
    count = len(points)
    gaussians = dataclasses.replace(
        wall,
        means=points,
        quats=wall.quats.repeat(count, 1),
        scales=wall.scales.repeat(count, 1),
        opacities=wall.opacities.repeat(count),
        sh=wall.sh.repeat(count, 1, 1),
    )
    scene = scene_of([dataclasses.replace(actor, gaussians=gaussians)])
    lamps = vehicle_lamps(scene, 0, VehicleLampSettings())
    fronts = lamps.positions_m[lamps.kinds == LampKind.DIPPED]
    # The left lamp is 3 cm before the splats, the right one on its box.
    np.testing.assert_allclose(sorted(fronts[:, 0]), [0.9 * 2.25, 2.13], atol=1e-6)


def test_shares_choose_vehicles_by_their_names_alone():
    tracks = [straight_track(lambda s: 12 * s, y=4.0 * i) for i in range(60)]
    actors = [car(f"car {i}", track) for i, track in enumerate(tracks)]
    settings = VehicleLampSettings(lit_share=0.4)
    owners = vehicle_lamps(scene_of(actors), 0, settings).owners
    lit = {actors[owner - 1].track_id for owner in owners}
    assert 12 <= len(lit) <= 36  # 24 of 60, within three standard deviations
    backwards = actors[::-1]
    again = vehicle_lamps(scene_of(backwards), 500_000_000, settings).owners
    assert lit == {backwards[owner - 1].track_id for owner in again}
    more = vehicle_lamps(scene_of(actors), 0, VehicleLampSettings(lit_share=0.7)).owners
    assert lit < {actors[owner - 1].track_id for owner in more}
    other = vehicle_lamps(scene_of(actors), 0, VehicleLampSettings(lit_share=0.4, seed=1)).owners
    assert lit != {actors[owner - 1].track_id for owner in other}


class ParkedLabels:
    """Boxes of cars that stand beside the road, the same in all frames."""

    def __init__(self, count: int, motion: str) -> None:
        self.count = count
        self.motion = motion

    def boxes(self, frame_index: int) -> Boxes:
        count = self.count
        centres = np.stack([6.0 * np.arange(count), np.full(count, 4.0), np.full(count, 0.72)], 1)
        quats = np.tile([1.0, 0.0, 0.0, 0.0], (count, 1))
        motions = np.array([self.motion] * count, object)
        return Boxes(
            tuple(f"parked {i}" for i in range(count)),
            ("Car",) * count,
            centres,
            np.tile(CAR_M, (count, 1)),
            quats,
            {"attributes.object_motion": motions},
        )

    def lidar(self, frame_index: int):
        return None


def test_parked_cars_are_dark_but_for_exceptions_and_stopped_ones_are_lit():
    settings = VehicleLampSettings()
    parked = vehicle_lamps(scene_of(labels=ParkedLabels(200, "Parked")), 0, settings)
    num_lit = int((parked.kinds == LampKind.DIPPED).sum()) // 2
    assert 2 <= num_lit <= 20  # 5 % of 200, within three standard deviations
    stopped = vehicle_lamps(scene_of(labels=ParkedLabels(20, "Stopped")), 0, settings)
    assert kinds_of(stopped) == ["DIPPED"] * 40 + ["STOP"] * 60
    assert len(vehicle_lamps(scene_of(), 0, settings)) == 0


def test_drives_too_short_to_tell_light_a_share_of_standing_cars():
    labels = ParkedLabels(200, "")
    lamps = vehicle_lamps(scene_of(labels=labels, frames=1), 0, VehicleLampSettings())
    assert 75 <= int((lamps.kinds == LampKind.DIPPED).sum()) // 2 <= 125
    assert "STOP" not in kinds_of(lamps)


def test_left_hand_traffic_mirrors_beams_and_the_rear_fog_lamp():
    scene = scene_of([car("a", straight_track(lambda s: 12 * s))])
    right = VehicleLampSettings(rear_fog_share=1.0, front_fog_share=1.0)
    left = dataclasses.replace(right, left_hand_traffic=True)
    a, b = (vehicle_lamps(scene, 0, settings) for settings in (right, left))
    is_fog = a.kinds == LampKind.REAR_FOG
    assert a.positions_m[is_fog, 1] == pytest.approx(-b.positions_m[is_fog, 1])
    assert set(a.patterns[a.kinds == LampKind.DIPPED]) != set(
        b.patterns[b.kinds == LampKind.DIPPED]
    )
    assert kinds_of(a).count("FRONT_FOG") == 2


@pytest.mark.parametrize("share", [-0.1, 1.5, float("nan")])
def test_shares_outside_0_to_1_are_refused(share):
    with pytest.raises(ValueError, match=r"lit_share must be a share from 0 to 1"):
        VehicleLampSettings(lit_share=share)


def test_own_lamps_move_with_the_car_at_the_moment_of_the_image():
    scene = scene_of()
    for time_ns, ego_x in ((0, 0.0), (150_000_000, 1.5), (2_050_000_000, 20.5)):
        camera = camera_ahead(position=(ego_x + 0.5, 0.0, 1.5), timestamp_ns=time_ns)
        lamps = own_lamps(scene, camera, OwnLampSettings())
        fronts = lamps.select(lamps.kinds == LampKind.DIPPED)
        # 1.9 m ahead of the camera that looks ahead, which is 0.5 m ahead of the car's origin.
        np.testing.assert_allclose(fronts.positions_m[:, 0], ego_x + 0.5 + 1.9, atol=1e-9)
        np.testing.assert_allclose(sorted(fronts.positions_m[:, 1]), [-0.62, 0.62], atol=1e-9)
        np.testing.assert_allclose(fronts.positions_m[:, 2], 0.65, atol=1e-9)
        assert set(lamps.owners) == {EGO_OWNER} and kinds_of(lamps).count("TAIL") == 2
    high = own_lamps(scene, camera, OwnLampSettings(beam=LampKind.HIGH))
    assert kinds_of(high) == ["DIPPED", "DIPPED", "HIGH", "HIGH", "TAIL", "TAIL"]
    assert len(own_lamps(scene, camera, OwnLampSettings(beam=None))) == 0
