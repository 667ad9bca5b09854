import dataclasses

import pytest
import torch

from augment.errors import SceneError
from augment.scene.cameras import Camera, Frame
from augment.scene.labels import Boxes, LidarSweep
from augment.scene.scene import Gaussians, Scene
from augment.scene.sky import ConstantSky
from augment.view.plan import Plan, make_plan
from recipes.schema import Output, Recipe, Render, Smog, Weather


def scene(**changes) -> Scene:
    gaussians = Gaussians(
        means=torch.zeros(1, 3),
        quats=torch.tensor([[1.0, 0, 0, 0]]),
        scales=torch.ones(1, 3),
        opacities=torch.ones(1),
        sh=torch.zeros(1, 1, 3),
    )
    base = Scene("s", "test:", gaussians, (), ConstantSky(torch.zeros(3)), (), ground_z_m=0.25)
    return dataclasses.replace(base, **changes)


def plan_of(smog: Smog | None = None, **output) -> Plan:
    output.setdefault("depth", "none")
    return make_plan(Recipe(weather=Weather(smog=smog), output=Output(**output)), scene())


RGBA, DRAWN = {"rgb", "alpha"}, {"rasterise", "sky"}


@pytest.mark.parametrize(
    ("smog", "output", "buffers", "steps"),
    [
        (None, {}, RGBA, DRAWN),
        (Smog(extinction_per_m=0.0), {}, RGBA, DRAWN),
        (Smog(visibility_m=100), {}, RGBA, {"rasterise", "smog per Gaussian"}),
        (Smog(visibility_m=100, scale_height_m=30), {}, RGBA, {*DRAWN, "smog per Gaussian"}),
        (
            Smog(visibility_m=100, model="deferred"),
            {},
            {*RGBA, "expected_depth"},
            {"rasterise", "smog on buffers"},
        ),
        (None, {"depth": "median"}, {*RGBA, "median_depth"}, {*DRAWN, "depth image"}),
        (None, {"depth": "expected"}, {*RGBA, "expected_depth"}, {*DRAWN, "depth image"}),
        (None, {"semantic": True}, {*RGBA, "splat_ids"}, {*DRAWN, "semantic image"}),
        (None, {"instance": True}, {*RGBA, "splat_ids"}, {*DRAWN, "instance image"}),
    ],
)
def test_a_plan_asks_for_what_the_picture_needs(smog, output, buffers, steps):
    plan = plan_of(smog, **output)
    assert plan.buffers == buffers
    assert {step.name for step in plan.steps if step.runs} == steps


class Labels:
    """A source that is asked nothing."""

    def boxes(self, frame_index: int) -> Boxes:
        raise AssertionError("no plan reads boxes")

    def lidar(self, frame_index: int) -> LidarSweep | None:
        raise AssertionError("no plan reads sweeps")


@pytest.mark.parametrize(
    ("depth", "labels", "extinction_per_m", "buffers"),
    [
        ("none", True, 0.1, {"rgb", "alpha", "expected_depth"}),
        ("median", True, 0.1, {"rgb", "alpha", "median_depth"}),
        ("expected", True, 0.1, {"rgb", "alpha", "expected_depth"}),
        ("none", False, 0.1, {"rgb", "alpha"}),
        ("none", True, 0.0, {"rgb", "alpha", "expected_depth"}),
    ],
)
def test_boxes_need_a_depth_and_any_will_do(depth, labels, extinction_per_m, buffers):
    weather = Weather(smog=Smog(extinction_per_m=extinction_per_m))
    recipe = Recipe(weather=weather, output=Output(depth=depth, labels=labels))
    plan = make_plan(recipe, scene(labels=Labels()))
    assert plan.buffers == buffers
    assert plan.finds_boxes == labels
    assert not make_plan(recipe, scene()).finds_boxes


def test_instance_images_need_the_depth_and_class_of_boxes_without_an_actor():
    recipe = Recipe(output=Output(depth="none", instance=True, labels=False))
    plan = make_plan(recipe, scene(labels=Labels()))
    assert plan.buffers == {"rgb", "alpha", "splat_ids", "expected_depth"}
    assert plan.finds_boxes and not plan.has_semantic
    assert make_plan(recipe, scene()).buffers == {"rgb", "alpha", "splat_ids"}


def test_smog_stands_on_the_road():
    plan = plan_of(Smog(visibility_m=100, scale_height_m=30, base_height_m=2))
    fog = plan.effect_plans["smog"].data.fog
    assert fog.base_z_m == 2.25
    assert fog.extinction_per_m == pytest.approx(0.03912)


def test_a_scale_height_over_an_unknown_road_is_an_error_that_says_what_to_do():
    recipe = Recipe(weather=Weather(smog=Smog(visibility_m=100, scale_height_m=30)))
    with pytest.raises(SceneError, match="ground_z=HEIGHT"):
        make_plan(recipe, scene(ground_z_m=None))


def test_an_unknown_unit_is_said():
    plan = make_plan(
        Recipe(weather=Weather(smog=Smog(visibility_m=100))), scene(has_metric_scale=False)
    )
    assert any("not known to be a metre" in step.why for step in plan.steps)


def test_a_plan_is_plain_data():
    facts = plan_of(Smog(visibility_m=100)).as_dict()
    assert facts["buffers"] == ["alpha", "rgb"]
    assert {"name", "runs", "why"} == set(facts["steps"][0])


def test_colour_maps_apply_where_cameras_have_them_and_the_recipe_lets_them():
    pose = torch.eye(4, dtype=torch.float64)
    cameras = {name: Camera(name, 4, 3, 5.0, 5.0, 2.0, 1.5, pose) for name in ("front", "back")}
    frames = (Frame(0, 0, pose, cameras),)

    def step(recipe: Recipe, **color_maps):
        plan = make_plan(recipe, scene(frames=frames, color_maps=color_maps))
        [exposure_step] = [s for s in plan.steps if s.name == "camera colour map"]
        assert exposure_step.runs == plan.uses_recorded_exposure
        return exposure_step

    dark = torch.eye(3, 4) * 0.5
    assert not step(Recipe()).runs
    assert not step(Recipe(), front=torch.eye(3, 4), elsewhere=dark).runs
    used = step(Recipe(), front=dark, back=torch.eye(3, 4))
    assert used.runs and used.why.startswith("1 of 2 cameras")
    neutral = step(Recipe(render=Render(exposure="neutral")), front=dark)
    assert not neutral.runs and "neutral" in neutral.why
