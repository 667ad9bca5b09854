"""The recording car's own body, seen by a camera that drives a curve."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import torch

from adapters.lidar_scene.depth import read_returns
from adapters.training_views.starting_scene import ego_body
from augment.reconstruct.view import RecordedView, ViewKey
from augment.render.rasterize import rasterize
from augment.scene.cameras import Camera, Frame
from augment.scene.geometry import transform_points
from augment.scene.labels import EGO_VEHICLE, Boxes, LidarSweep
from augment.scene.scene import PosedGaussians, Scene
from augment.scene.sky import ConstantSky
from tests.scenes import camera_ahead, one_gaussian

WIDTH, HEIGHT, FIRST_ROW = 320, 200, 150
FRAME_NS = 100_000_000


def camera_in(frame: int, name: str = "rear", turned: float = 0.0) -> Camera:
    camera = camera_ahead(
        WIDTH,
        HEIGHT,
        160.0,
        position=(3.0 * frame, 0.2 * frame**2, 1.6),
        yaw=0.1 * frame + turned,
        timestamp_ns=frame * FRAME_NS,
    )
    return dataclasses.replace(camera, name=name)


@dataclasses.dataclass(frozen=True)
class OneReturn:
    """A LiDAR return in the middle of the body."""

    point: np.ndarray

    def boxes(self, frame_index: int) -> Boxes:
        return Boxes.empty()

    def lidar(self, frame_index: int) -> LidarSweep:
        x, y, z = (np.array([v]) for v in self.point)
        return LidarSweep({"x": x, "y": y, "z": z, "timestamp_ns": np.array([0])})


@pytest.fixture
def scene() -> Scene:
    frames = tuple(
        Frame(
            index,
            index * FRAME_NS,
            torch.eye(4, dtype=torch.float64),
            {"rear": camera_in(index), "front": camera_in(index, "front", math.pi)},
        )
        for index in range(5)
    )
    return Scene("drive", "test:", one_gaussian(), (), ConstantSky(torch.zeros(3)), frames)


MASK = np.zeros((HEIGHT, WIDTH), np.bool_)
MASK[FIRST_ROW:] = True


def mirror_mask() -> np.ndarray:
    """A part of the car that reaches above the horizon."""
    mask = np.zeros_like(MASK)
    mask[40:, :60] = True
    return mask


PAINT = np.linspace(40, 220, WIDTH)  # brighter to the right


class Images:
    """Views whose lower part shows the body; a reflection runs over it in one frame."""

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        self.train = tuple(ViewKey(f.index, name) for f in scene.frames for name in f.cameras)
        self.test = ()

    def camera(self, key: ViewKey) -> Camera:
        return self.scene.frame(key.frame).cameras[key.camera]

    def load(self, key: ViewKey) -> RecordedView:
        camera = self.camera(key)
        rgb = np.full((HEIGHT, WIDTH, 3), 30 * key.frame, np.uint8)
        rgb[FIRST_ROW:] = PAINT.astype(np.uint8)[None, :, None]
        if key.frame == 2:
            rgb[FIRST_ROW:] = 255
        weight, empty = np.ones((HEIGHT, WIDTH), np.float32), np.zeros(0, np.float32)
        return RecordedView(camera, rgb, weight, weight < 0, np.zeros(0, np.int32), empty, empty)


def drawn(actor, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    pose = actor.track.pose_at(camera.timestamp_ns)
    out = rasterize([PosedGaussians(actor.gaussians, pose)], camera)
    return out.rgb.numpy(), out.alpha.numpy()


def test_the_body_fills_its_mask_and_stands_still(scene):
    actor = ego_body(scene, "rear", MASK, Images(scene))
    assert (actor.label, actor.track_id) == (EGO_VEHICLE, "ego_vehicle:rear")
    first, _ = drawn(actor, camera_in(0))
    for frame in range(5):
        rgb, alpha = drawn(actor, camera_in(frame))
        # Two pixels at the edge are shared with what lies behind.
        assert alpha[FIRST_ROW + 2 :].min() > 0.9
        assert alpha[: FIRST_ROW - 4].max() < 0.02
        # float32 poses: no more than rounding, which may move a splat over a cut-off.
        assert np.abs(rgb - first).max() < 5e-3
        # 1 - alpha is what a splat of opacity 0.95 lets through; its colour is the grid's, 2 px.
        np.testing.assert_allclose(
            rgb[FIRST_ROW + 4 : -4, 4:-4, 1],
            np.broadcast_to(PAINT[4:-4] / 255, (HEIGHT - FIRST_ROW - 8, WIDTH - 8)),
            atol=0.06,
        )


def test_the_box_holds_the_body_below_its_camera_and_off_other_views(scene):
    actor = ego_body(scene, "rear", MASK, Images(scene))
    means = actor.gaussians.means
    half = torch.tensor(actor.size_m) / 2
    assert bool((means.abs() <= half).all())
    assert actor.size_m[1] < 2.2  # metres: no wider than a car
    pose = actor.track.pose_at(0)
    world = transform_points(pose, means.double())
    assert world[:, 2].max() < 1.6 and world[:, 0].min() > 0.1  # below the camera, ahead of it
    for frame in range(5):
        _, alpha = drawn(actor, camera_in(frame, "front", math.pi))
        assert alpha.max() == 0


def test_a_mask_of_another_scale_and_one_that_reaches_the_horizon(scene):
    small = ego_body(scene, "rear", MASK[::2, ::2], Images(scene))
    assert len(small.gaussians) == len(ego_body(scene, "rear", MASK, Images(scene)).gaussians)
    mirror = ego_body(scene, "rear", mirror_mask(), Images(scene))
    _, alpha = drawn(mirror, camera_in(1))
    assert alpha[42:, :58].min() > 0.9 and alpha[:, 66:].max() < 0.02


def test_it_captures_no_lidar_returns(scene):
    actor = ego_body(scene, "rear", mirror_mask(), Images(scene))  # a box tall enough to hold any
    centre = actor.track.pose_at(0)[:3, 3].numpy()
    seen = dataclasses.replace(scene, labels=OneReturn(centre))
    with_body = dataclasses.replace(seen, actors=(actor,))
    camera = camera_in(0)
    later = dataclasses.replace(camera, timestamp_ns=FRAME_NS)  # by then the car has moved on
    for view in (camera, later):
        plain, other = (read_returns(s, 0).seen_by(view) for s in (seen, with_body))
        np.testing.assert_array_equal(plain.depth_m, other.depth_m)
        assert len(plain) == 1


def test_nothing_to_show(scene):
    source = Images(scene)
    assert ego_body(scene, "rear", np.zeros_like(MASK), source) is None
    speck = np.zeros_like(MASK)
    speck[-4:, :4] = True
    assert ego_body(scene, "rear", speck, source) is None
    for trained_on in ([], [ViewKey(0, "front")]):
        source.train = trained_on
        assert ego_body(scene, "rear", MASK, source) is None


def test_images_of_one_time_make_one_pose(scene):
    frames = tuple(
        dataclasses.replace(
            f, cameras={n: dataclasses.replace(c, timestamp_ns=7) for n, c in f.cameras.items()}
        )
        for f in scene.frames
    )
    still = dataclasses.replace(scene, frames=frames)
    assert len(ego_body(still, "rear", MASK, Images(still)).track.timestamps_ns) == 1
