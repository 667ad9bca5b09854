"""Scenes, tracks and actors' colours, and what is worked out once for an owner."""

from __future__ import annotations

import dataclasses
import gc
import pickle
import threading
import weakref
from dataclasses import dataclass
from time import sleep

import numpy as np
import pytest
import torch

from augment.errors import SceneError
from augment.memo import SceneMemo, memo_of
from augment.render.sh import evaluate_sh
from augment.scene.cameras import Camera
from augment.scene.geometry import quat_from_rotmat, rigid, rotmat_from_quat, slerp
from augment.scene.scene import (
    Actor,
    ColorSeries,
    Gaussians,
    Scene,
    Track,
    check_gaussians,
    colors_at,
    drawable_rows,
    is_drawable,
)
from augment.scene.semantics import SemanticClass, class_of_label
from augment.scene.sky import ConstantSky


def some(count: int = 5) -> Gaussians:
    quats = torch.zeros(count, 4)
    quats[:, 0] = 1
    return Gaussians(
        means=torch.arange(count * 3, dtype=torch.float32).reshape(count, 3),
        quats=quats,
        scales=torch.full((count, 3), 0.1),
        opacities=torch.full((count,), 0.5),
        sh=torch.zeros(count, 4, 3),
    )


def named(name: str, timestamp_ns: int = 0) -> Camera:
    pose = torch.eye(4, dtype=torch.float64)
    return Camera(name, 4, 3, 4.0, 4.0, 2.0, 1.5, pose, timestamp_ns)


def track() -> Track:
    turn = torch.tensor([[1.0, 0, 0, 0], [0.5**0.5, 0, 0, 0.5**0.5]], dtype=torch.float64)
    places = torch.tensor([[0.0, 0, 0], [10.0, 0, 0]], dtype=torch.float64)
    poses = torch.stack([rigid(rotmat_from_quat(q), p) for q, p in zip(turn, places, strict=True)])
    return Track(torch.tensor([1_000, 2_000]), poses, hold_ns=100)


def test_wrong_shapes_name_the_field_and_both_shapes(unchecked):
    good = some()
    with pytest.raises(ValueError, match=r"scales must be \[5, 3\] with N=5 .*got \[5, 1\]"):
        dataclasses.replace(good, scales=torch.ones(5, 1))
    with pytest.raises(ValueError, match=r"sh must be .*got \[5, 5, 3\]"):
        dataclasses.replace(good, sh=torch.ones(5, 5, 3))
    with pytest.raises(ValueError, match="floating dtype of means"):
        dataclasses.replace(good, opacities=torch.ones(5, dtype=torch.float64))


def test_unusable_gaussians_are_left_out_and_counted():
    base = some(6)
    means, quats, scales = base.means.clone(), base.quats.clone() * 2, base.scales.clone()
    means[0, 1] = torch.nan
    means[1, 0] = torch.inf
    quats[2] = 0
    scales[3, 2] = 0
    hurt = dataclasses.replace(base, means=means, quats=quats, scales=scales)
    clean, problems = check_gaussians(hurt, where="scene.ply")
    assert torch.equal(clean.means, base.means[4:])
    assert torch.equal(clean.quats, base.quats[4:])  # normalised
    assert problems == (
        "scene.ply: left out 2 of 6 Gaussians with NaN or infinite values",
        "scene.ply: left out 1 of 6 Gaussians with a zero quaternion",
        "scene.ply: left out 1 of 6 Gaussians with a scale <= 0",
    )


def test_what_lies_beyond_ten_thousand_kilometres_is_left_out():
    base = some(6)
    for size in (1.01e7, 1e20, 3e38):
        means, scales = base.means.clone(), base.scales.clone()
        means[2, 1], scales[4, 0] = -size, size
        hurt = dataclasses.replace(base, means=means, scales=scales)
        clean, problems = check_gaussians(hurt, where="scene.ply")
        assert torch.equal(clean.means, base.means[[0, 1, 3, 5]])
        assert problems == (
            "scene.ply: left out 2 of 6 Gaussians with coordinates or scales beyond 1e+07 m; the "
            "first is number 2",
        )
        assert not is_drawable(hurt)
        assert drawable_rows(hurt).tolist() == [True, True, False, True, False, True]
    means, scales = base.means.clone(), base.scales.clone()
    means[2], scales[4] = -1e7, 1e7
    at_limit = dataclasses.replace(base, means=means, scales=scales)
    clean, problems = check_gaussians(at_limit, where="scene.ply")
    assert problems == () and is_drawable(at_limit) and drawable_rows(at_limit).all()
    assert torch.equal(clean.means, means) and torch.equal(clean.scales, scales)


def test_nothing_usable_is_an_error():
    bad = dataclasses.replace(some(2), means=torch.full((2, 3), torch.nan))
    with pytest.raises(SceneError, match=r"scene\.ply holds no usable Gaussians"):
        check_gaussians(bad, where="scene.ply")


def test_a_track_interpolates_holds_and_ends():
    t = track()
    middle = t.pose_at(1_500)
    assert middle is not None
    assert middle[:3, 3].tolist() == [5.0, 0.0, 0.0]
    eighth_turn = torch.tensor([0.5**0.5, 0.5**0.5, 0], dtype=torch.float64)
    assert torch.allclose(middle[:3, 0], eighth_turn)
    assert torch.equal(t.pose_at(950), t.world_from_actor[0])
    assert torch.equal(t.pose_at(2_100), t.world_from_actor[1])
    assert t.pose_at(899) is None and t.pose_at(2_101) is None


def pose_by_tensors(track: Track, time: int) -> torch.Tensor:
    """Between two samples, by the functions of augment.scene.geometry."""
    times, poses = track.timestamps_ns, track.world_from_actor
    after = int(torch.searchsorted(times, time, right=True))
    a, b = poses[after - 1], poses[after]
    fraction = torch.tensor(
        (time - int(times[after - 1])) / int(times[after] - times[after - 1]), dtype=torch.float64
    )
    quat = slerp(quat_from_rotmat(a[:3, :3]), quat_from_rotmat(b[:3, :3]), fraction)
    return rigid(rotmat_from_quat(quat), torch.lerp(a[:3, 3], b[:3, 3], fraction))


@pytest.mark.parametrize("turn_rad", [None, 0.0, 1e-9, 2e-6, 3.1])
def test_poses_are_those_of_the_geometry(turn_rad):
    """Random turns, none, tiny and nearly half ones; and times that a float64 does not hold."""
    generator = torch.Generator().manual_seed(1)
    quats = torch.randn(6, 4, generator=generator, dtype=torch.float64)
    if turn_rad is not None:
        half = torch.arange(6, dtype=torch.float64) * turn_rad / 2
        quats = torch.stack([half.cos(), 0 * half, 0.6 * half.sin(), 0.8 * half.sin()], -1)
    places = torch.randn(6, 3, generator=generator, dtype=torch.float64) * 1000
    start = 1_557_540_079_200_123_457
    times = start + torch.tensor([0, 7, 100_000_001, 200_000_000, 300_000_000, 300_000_001])
    moving = Track(times, rigid(rotmat_from_quat(quats), places))
    for time in [*times[:-1].tolist(), *range(start + 1, start + 300_000_000, 9_999_991)]:
        got = moving.pose_at(time)
        if time == start:  # the sample itself
            assert torch.equal(got, moving.world_from_actor[0])
            continue
        assert got.dtype == torch.float64
        # Float64 rounding of positions below 10 km, and of rotations.
        torch.testing.assert_close(got, pose_by_tensors(moving, time), atol=1e-11, rtol=0)


def test_poses_of_all_actors_at_once_are_those_of_their_tracks_to_the_bit():
    rng = np.random.default_rng(0)
    tracks = []
    for number in range(40):
        count = int(rng.integers(1, 7))
        times = torch.from_numpy(10**18 + np.cumsum(rng.integers(1, 10**9, count)))
        quats = torch.from_numpy(rng.normal(size=(count, 4)))
        if number % 4 == 0:
            quats = quats[:1] + 1e-7 * quats  # hardly any turn
        poses = rigid(rotmat_from_quat(quats), torch.from_numpy(rng.normal(size=(count, 3))))
        gap = None if number % 3 else 400_000_000
        tracks.append(Track(times, poses, hold_ns=number * 10**7, max_gap_ns=gap))
    gone = scene(
        tuple(Actor(str(n), "car", some(), t, (4.0, 2.0, 1.0)) for n, t in enumerate(tracks))
    )
    samples = [time for t in tracks for time in t.timestamps_ns.tolist()]
    for time in [*samples, *rng.integers(10**18, 10**18 + 4 * 10**9, 400).tolist()]:
        expected = {n: t.pose_at(time) for n, t in enumerate(tracks, start=1)}
        expected = {n: pose.numpy() for n, pose in expected.items() if pose is not None}
        got = gone.poses_at(time)
        assert got.keys() == expected.keys()
        for number, pose in expected.items():
            np.testing.assert_array_equal(got[number], pose)
    assert scene().poses_at(0) == {}


def test_track_times_must_increase():
    with pytest.raises(ValueError, match="strictly increasing"):
        Track(torch.tensor([5, 5]), torch.eye(4, dtype=torch.float64).repeat(2, 1, 1))


def scene(actors: tuple[Actor, ...] = (), background: Gaussians | None = None) -> Scene:
    return Scene(
        name="s",
        source="test:",
        background=some() if background is None else background,
        actors=actors,
        sky=ConstantSky(torch.zeros(3)),
        frames=(),
    )


def test_actors_take_part_only_while_their_track_lasts():
    actor = Actor("car", "Car", some(3), track(), (4.0, 2.0, 1.5))
    s = scene((actor,))
    assert [p.instance_id for p in s.parts_at(1_500)] == [0, 1]
    assert [p.instance_id for p in s.parts_at(5_000)] == [0]


def test_empty_scenes_repeated_tracks_and_missing_frames_are_errors():
    with pytest.raises(SceneError, match="holds no Gaussians"):
        scene(background=Gaussians.empty())
    actor = Actor("car", "Car", some(3), track(), (4.0, 2.0, 1.5))
    with pytest.raises(ValueError, match=r"track_ids repeat: \['car'\]"):
        scene((actor, actor))
    with pytest.raises(SceneError, match="has no frame 7; it has none"):
        scene().frame(7)


def test_a_colour_map_of_an_image_goes_before_that_of_its_camera():
    image_map, camera_map = torch.eye(3, 4) * 0.5, torch.eye(3, 4) * 0.7
    s = dataclasses.replace(
        scene(), color_maps={"front": camera_map}, image_color_maps={("front", 5): image_map}
    )
    assert s.color_map(named("front", 5)) is image_map
    assert s.color_map(named("front", 6)) is camera_map
    assert s.color_map(named("rear", 5)) is None


def waves(count: int = 3) -> ColorSeries:
    times, phases = torch.tensor([1_000, 2_000]), torch.tensor([0.0, 1.0], dtype=torch.float64)
    coefficients = torch.arange(count * 12, dtype=torch.float32).reshape(count, 4, 3) / 10
    return ColorSeries(coefficients, times, phases)


def test_an_actors_colours_follow_its_waves():
    actor = Actor("a", "car", some(3), track(), (4.0, 2.0, 1.5), waves())
    (_, part) = scene((actor,)).parts_at(1_250)
    c = actor.color_waves.coefficients
    # At t = 1/4: sin(2 pi t) = 1, cos(2 pi t) = 0, sin(4 pi t) = 0, cos(4 pi t) = -1.
    expected = actor.gaussians.sh[:, 0] + c[:, 0] - c[:, 3]
    assert torch.allclose(part.gaussians.sh[:, 0], expected, atol=1e-6)
    assert torch.equal(part.gaussians.sh[:, 1:], actor.gaussians.sh[:, 1:])
    with pytest.raises(ValueError, match="row for each of its 3 Gaussians; got 2"):
        dataclasses.replace(actor, color_waves=waves(2))


def test_colours_in_the_world_stand_still_while_an_actor_turns():
    gaussians = dataclasses.replace(
        some(3), sh=torch.randn(3, 16, 3, generator=torch.Generator().manual_seed(1))
    )
    actor = Actor("a", "car", gaussians, track(), (4.0, 2.0, 1.5), colors_in_world=True)
    directions = torch.nn.functional.normalize(torch.tensor([[1.0, 2, 3], [-1, 0.5, 0]]), dim=1)
    for timestamp_ns in (1_000, 1_600, 2_000):
        (_, part) = scene((actor,)).parts_at(timestamp_ns)
        actor_directions = (
            directions @ part.world_from_part[:3, :3].float()
        )  # as its own frame sees them
        for k in range(3):
            sh = gaussians.sh[k].expand(2, 16, 3)
            expected = evaluate_sh(sh, directions)
            actor_colors = evaluate_sh(part.gaussians.sh[k].expand(2, 16, 3), actor_directions)
            assert torch.allclose(actor_colors, expected, atol=1e-5)
    fixed = dataclasses.replace(actor, colors_in_world=False)
    assert fixed.gaussians_at(1_600) is gaussians


def test_cameras_of_a_moment_share_an_actors_colours():
    gaussians = dataclasses.replace(some(3), sh=torch.ones(3, 4, 3))
    actor = Actor("a", "car", gaussians, track(), (4.0, 2.0, 1.5), waves(), colors_in_world=True)
    first = actor.gaussians_at(1_250)
    assert actor.gaussians_at(1_250) is first
    later = actor.gaussians_at(1_600)
    assert not torch.equal(later.sh, first.sh)
    assert torch.equal(actor.gaussians_at(1_250).sh, first.sh)
    gaussians.sh.mul_(2)  # in place: what was kept is no longer true
    assert not torch.equal(actor.gaussians_at(1_250).sh, first.sh)
    gaussians.sh.requires_grad_()
    assert all(actor.gaussians_at(1_250).sh.requires_grad for _ in range(2))


@pytest.mark.parametrize("bands", [1, 4, 9, 16])
@pytest.mark.parametrize("has_waves", [False, True])
@pytest.mark.parametrize("turns", [False, True])
def test_the_kernel_of_colours_equals_their_definition(bands, has_waves, turns):
    count = 5_000  # more than two blocks
    sh = torch.randn(count, bands, 3, generator=torch.Generator().manual_seed(4))
    changing = waves(count) if has_waves else None
    turn = track().pose_at(1_700)[:3, :3] if turns else None
    got = colors_at(sh, changing, 1_300, turn)
    expected = colors_at(sh, changing, 1_300, turn, fast=False)
    torch.testing.assert_close(got, expected, rtol=1e-5, atol=1e-5)
    assert bands == 1 or turns != torch.equal(got[:, 1:], sh[:, 1:])


def test_an_actor_is_absent_in_a_gap_of_its_track():
    gapless_track = track()
    gappy = dataclasses.replace(gapless_track, max_gap_ns=500)
    assert gapless_track.pose_at(1_500) is not None and gappy.pose_at(1_500) is None
    assert torch.equal(gappy.pose_at(1_100), gapless_track.world_from_actor[0])
    assert torch.equal(gappy.pose_at(1_900), gapless_track.world_from_actor[1])
    assert dataclasses.replace(gapless_track, max_gap_ns=1_000).pose_at(1_500) is not None


def test_datasets_names_for_objects_have_classes():
    names = {
        "vehicle.bus.rigid": SemanticClass.VEHICLE,
        "Pickup Truck": SemanticClass.VEHICLE,
        "human.pedestrian.adult": SemanticClass.PEDESTRIAN,
        "vehicle.bicycle": SemanticClass.TWO_WHEELER,
        "Cyclist": SemanticClass.TWO_WHEELER,
        "Pylons": SemanticClass.UNKNOWN,
        "carrot": SemanticClass.UNKNOWN,
    }
    assert {name: class_of_label(name) for name in names} == names


# ---- what is worked out once for an owner --------------------------------------------------------


class Owner:
    """Hashed by identity."""


@dataclass(frozen=True)
class InFile:
    number: int

    def load(self) -> list[int]:
        return [self.number]


def test_a_value_is_made_once_and_forgotten_when_too_many_bytes_came_after_it():
    memo, made_keys = SceneMemo(max_bytes=400), []  # for one more beside the largest

    def get(key: str) -> np.ndarray:
        return memo.get((key,), lambda: made_keys.append(key) or np.zeros(100, np.float32))

    assert get("a") is get("a")
    get("b")
    get("a")  # used again: "b" is the one unused for longest
    get("c")
    get("a"), get("c")
    assert made_keys == ["a", "b", "c"]
    get("b")
    assert made_keys == ["a", "b", "c", "b"]


def test_threads_wait_for_the_one_that_makes_a_value():
    memo, made_keys = SceneMemo(), []

    def make() -> object:
        sleep(0.05)
        made_keys.append(1)
        return object()

    values = []
    threads = [
        threading.Thread(target=lambda: values.append(memo.get(("slow",), make))) for _ in range(4)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(made_keys) == 1 and len({id(value) for value in values}) == 1


def test_what_is_shared_is_found_by_another_process_memo():
    parent_memo, worker_memo = SceneMemo(), SceneMemo(max_bytes=1)
    parent_memo.put(("own",), 1)
    parent_memo.put(("plain",), 2, shared=True)
    parent_memo.put(("stored",), InFile(3), shared=True)
    worker_memo.take_shared(pickle.loads(pickle.dumps(parent_memo.shared())))
    assert worker_memo.has(("plain",)) and not worker_memo.has(("own",))

    def refuse() -> None:
        raise AssertionError("it was handed over")

    assert worker_memo.get(("plain",), refuse) == 2
    first = worker_memo.get(("stored",), refuse)
    assert first == [3] and parent_memo.get(("stored",), refuse) == [3]
    worker_memo.get(("other",), lambda: torch.zeros(1000))  # what is shared is found again
    assert worker_memo.get(("stored",), refuse) == [3]


def test_a_memo_goes_with_its_owner():
    owner = Owner()
    memo_of(owner).put(("value",), 1)
    assert memo_of(owner) is memo_of(owner)
    gone = weakref.ref(memo_of(owner))
    del owner
    gc.collect()
    assert gone() is None
