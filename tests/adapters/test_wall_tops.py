"""A wall that LiDAR knows to 15 degrees of elevation and images show further up."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import torch

from adapters.training_views.starting_scene import wall_tops
from augment.cameras import Camera, Frame
from augment.geometry import rigid
from augment.reconstruct.view import RecordedView, ViewKey
from augment.render.sh import SH_C0
from augment.scene import Actor, Gaussians, Scene, Track
from augment.semantics import SemanticClass
from augment.sky import ConstantSky

WALL_X_M, HALF_M, EYE_M = 10.0, 5.0, 1.6
RIM_M = EYE_M + WALL_X_M * math.tan(math.radians(15))  # where the LiDAR's view meets the wall
BRICK, SKY = (150, 70, 50), (190, 210, 235)


def wall_splats(top_m: float, step_m: float = 0.2) -> Gaussians:
    y, z = np.meshgrid(np.arange(-HALF_M, HALF_M, step_m), np.arange(0, top_m, step_m))
    count = y.size
    means = np.stack([np.full(count, WALL_X_M), y.ravel(), z.ravel()], 1)
    colour = (torch.tensor(BRICK) / 255 - 0.5) / SH_C0
    return Gaussians(
        means=torch.from_numpy(means).float(),
        quats=torch.tensor([1.0, 0, 0, 0]).repeat(count, 1),
        scales=torch.tensor([0.01, step_m / 2, step_m / 2]).repeat(count, 1),
        opacities=torch.full((count,), 0.95),
        sh=colour.repeat(count, 1)[:, None],
        semantic=torch.full((count,), int(SemanticClass.BUILDING), dtype=torch.int16),
    )


def camera_at(y_m: float) -> Camera:
    rotation = torch.tensor([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]], dtype=torch.float64)
    centre = torch.tensor([0.0, y_m, EYE_M], dtype=torch.float64)
    return Camera("side", 160, 120, 90.0, 90.0, 80.0, 60.0, rigid(rotation, -rotation @ centre))


def scene_of(background: Gaussians, actors: tuple[Actor, ...] = ()) -> Scene:
    def frame(index: int) -> Frame:
        camera = camera_at(0.4 * index - 1.2)
        ego = torch.eye(4, dtype=torch.float64)
        ego[:3, 3] = camera.centre
        return Frame(index, 0, ego, {"side": camera})

    frames = tuple(frame(index) for index in range(7))
    return Scene("wall", "test:", background, actors, ConstantSky(torch.zeros(3)), frames)


class Images:
    """Views of a wall that really ends at top_m; without sky_known no mask tells sky."""

    def __init__(self, scene: Scene, top_m: float, *, sky_known: bool = True) -> None:
        self.scene, self.top_m, self.sky_known = scene, top_m, sky_known
        self.train = tuple(ViewKey(frame.index, "side") for frame in scene.frames)
        self.test = ()

    def camera(self, key: ViewKey) -> Camera:
        return self.scene.frame(key.frame).cameras[key.camera]

    def load(self, key: ViewKey) -> RecordedView:
        camera = self.camera(key)
        hit = camera.centre.numpy() + WALL_X_M * camera.ray_directions().numpy()
        wall = (np.abs(hit[..., 1]) < HALF_M) & (hit[..., 2] < self.top_m)
        rgb = np.where(wall[..., None], BRICK, SKY).astype(np.uint8)
        # Only the columns beside the wall are sure to show sky.
        sky = (np.abs(hit[..., 1]) > HALF_M + 0.2) & self.sky_known
        empty = np.zeros(0, np.float32)
        weight = np.ones(wall.shape, np.float32)
        return RecordedView(camera, rgb, weight, sky, np.zeros(0, np.int32), empty, empty)


def test_a_wall_goes_on_up_to_where_the_images_end_it():
    scene = scene_of(wall_splats(RIM_M))
    top_m = 6.5
    new = wall_tops(scene, Images(scene, top_m))
    means = new.means.numpy()
    # A piece is 0.11 m high here and a coarse pixel 0.11 m: two of them either way.
    assert means[:, 2].max() == pytest.approx(top_m, abs=0.25)
    assert means[:, 2].min() > RIM_M - 0.4
    np.testing.assert_allclose(means[:, 0], WALL_X_M, atol=0.05)
    cells = {(round(y / 0.2), round(z / 0.2)) for _, y, z in means if abs(y) < 3}
    assert len(cells) > 0.9 * (6 / 0.2) * (top_m - RIM_M) / 0.2  # no holes
    colours = new.sh[:, 0].numpy() * SH_C0 + 0.5
    np.testing.assert_allclose(colours, np.tile(BRICK, (len(new), 1)) / 255, atol=0.05)
    assert (new.semantic == int(SemanticClass.BUILDING)).all()
    assert bool((new.opacities == 0.6).all())
    thin = new.scales.numpy().argmin(axis=1)
    assert (thin == 2).all()  # flattened along the wall's normal, the third axis of a surfel


def test_nothing_is_put_into_the_sky():
    scene = scene_of(wall_splats(RIM_M))
    new = wall_tops(scene, Images(scene, RIM_M))
    assert len(new) == 0 or new.means[:, 2].max() < RIM_M + 0.25


def test_a_wall_the_lidar_looked_over_has_no_more_to_it():
    low_m = EYE_M + WALL_X_M * math.tan(math.radians(6))
    scene = scene_of(wall_splats(low_m))
    assert len(wall_tops(scene, Images(scene, 6.5))) == 0


def test_ground_and_moving_objects_do_not_grow():
    wall = wall_splats(RIM_M)
    far = dataclasses.replace(wall.select(torch.arange(4)), means=torch.full((4, 3), -50.0))
    track = Track(torch.zeros(1, dtype=torch.int64), torch.eye(4, dtype=torch.float64)[None])
    moving = scene_of(far, (Actor("bus", "Bus", wall, track, (1.0, 1.0, 1.0)),))
    assert len(wall_tops(moving, Images(moving, 6.5))) == 0
    road = torch.full_like(wall.semantic, int(SemanticClass.ROAD))
    flat = scene_of(dataclasses.replace(wall, semantic=road))
    assert len(wall_tops(flat, Images(flat, 6.5))) == 0


def test_without_known_sky_only_what_is_not_white_goes_on():
    scene = scene_of(wall_splats(RIM_M))
    new = wall_tops(scene, Images(scene, 6.5, sky_known=False))
    assert len(new) > 100


def test_budget_repetition_and_no_views(monkeypatch):
    scene = scene_of(wall_splats(RIM_M))
    source = Images(scene, 6.5)
    full, again = wall_tops(scene, source), wall_tops(scene, source)
    assert torch.equal(full.means, again.means) and torch.equal(full.sh, again.sh)
    source.train = source.train[:1]
    one = wall_tops(scene, source)  # its own only witness
    assert len(one) > 0
    source.train = ()
    assert len(wall_tops(scene, source)) == 0
    monkeypatch.setattr("adapters.training_views.starting_scene._MAX_GAUSSIANS", len(full) // 3)
    few = wall_tops(scene, Images(scene, 6.5))
    assert 0 < len(few) <= len(full) // 3
    assert few.means[:, 2].max() == pytest.approx(6.5, abs=0.5)


def test_a_scene_without_classes_and_masked_out_images():
    scene = scene_of(dataclasses.replace(wall_splats(RIM_M), semantic=None))
    source = Images(scene, 6.5)
    assert len(wall_tops(scene, source)) > 100

    class Masked(Images):
        def load(self, key: ViewKey) -> RecordedView:
            view = super().load(key)
            return dataclasses.replace(view, weight=np.zeros_like(view.weight))

    assert len(wall_tops(scene, Masked(scene, 6.5))) == 0
