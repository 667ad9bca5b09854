"""Weights and configurations of Street Gaussians models: values, memory, damage, hostility."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml

from adapters.street_gaussians.data import ModelConfig
from adapters.street_gaussians.model import (
    Part,
    TrainedModel,
    newest_config,
    read_checkpoint,
    read_config,
    read_ply_model,
)
from augment.errors import AdapterError
from tests.adapters.street_gaussians_models import (
    RawModel,
    RawPart,
    checkpoint,
    config_tree,
    ply_bytes,
    random_part,
    write_model,
)

PLAIN = ModelConfig()


def raw_model(**changes) -> RawModel:
    raw = RawModel(
        background=random_part(0, 50),
        actors={3: random_part(1, 20, terms=5), 12: random_part(2, 30, terms=5)},
        opt_trans=np.random.default_rng(0).normal(size=(4, 2, 3)),
        opt_rots=np.random.default_rng(1).normal(size=(4, 2, 1)),
    )
    return dataclasses.replace(raw, **changes)


def saved(folder: Path, content: object) -> Path:
    torch.save(content, folder / "model.pth")
    return folder / "model.pth"


def opened(folder: Path, raw: RawModel, config: ModelConfig = PLAIN, **how) -> TrainedModel:
    return read_checkpoint(saved(folder, checkpoint(raw, 50000, **how)), config)


def check_part(part: Part, raw: RawPart) -> None:
    """Activated as the formats say, in this test's own words."""
    g = part.gaussians
    np.testing.assert_array_equal(g.means, raw.xyz)
    np.testing.assert_allclose(g.scales, np.exp(raw.scaling.astype(float)), rtol=1e-6)
    np.testing.assert_allclose(
        g.opacities, 1 / (1 + np.exp(-raw.opacity[:, 0].astype(float))), rtol=1e-6
    )
    lengths = np.sqrt((raw.rotation.astype(float) ** 2).sum(1))
    np.testing.assert_allclose(g.quats, raw.rotation / lengths[:, None], atol=1e-6)
    np.testing.assert_array_equal(g.sh[:, 0], raw.dc[:, 0])
    np.testing.assert_array_equal(g.sh[:, 1:], raw.rest)
    if raw.dc.shape[1] == 1:
        assert part.terms is None
    else:
        np.testing.assert_array_equal(part.terms, raw.dc[:, 1:])


@pytest.mark.parametrize("is_final", [True, False])
def test_a_checkpoint_is_read_as_it_was_trained(tmp_path: Path, is_final: bool) -> None:
    raw = raw_model()
    model = opened(tmp_path, raw, is_final=is_final)
    assert list(model.actors) == [3, 12] and list(model.problems) == []
    check_part(model.background, raw.background)
    for number, part in raw.actors.items():
        check_part(model.actors[number], part)
    np.testing.assert_allclose(model.pose_changes.positions, raw.opt_trans, rtol=1e-6)
    np.testing.assert_allclose(model.pose_changes.half_turns, raw.opt_rots[..., 0], rtol=1e-6)
    assert model.sky is None and model.color_maps is None and model.camera_changes is None


@pytest.mark.parametrize(("byte_order", "degree"), [("little", 0), ("big", 1), ("little", 3)])
def test_a_point_cloud_is_read_as_it_was_trained(tmp_path: Path, byte_order, degree) -> None:
    raw = raw_model(
        background=random_part(0, 50, degree=degree),
        actors={7: random_part(1, 20, terms=3, degree=degree)},
    )
    path = tmp_path / "point_cloud.ply"
    path.write_bytes(ply_bytes(raw.parts, byte_order))
    model = read_ply_model(path, PLAIN)
    check_part(model.background, raw.background)
    check_part(model.actors[7], raw.actors[7])
    assert len(model.problems) == 1 and "the actors' learnt poses" in model.problems[0]


def test_many_gaussians_are_taken_in_pieces(tmp_path: Path) -> None:
    """More than a piece, in files and in memory."""
    raw = raw_model(background=random_part(0, 40_001), actors={1: random_part(1, 35_003, terms=5)})
    for model in (opened(tmp_path, raw), _cloud(tmp_path, raw)):
        check_part(model.background, raw.background)
        check_part(model.actors[1], raw.actors[1])


def test_tables_beside_the_gaussians(tmp_path: Path) -> None:
    rng = np.random.default_rng(4)
    raw = raw_model(
        sky=rng.uniform(-0.2, 1.2, (6, 8, 8, 3)),
        affine=rng.normal(size=(12, 3, 4)),
        moves=rng.normal(size=(4, 3)),
        turns=np.array([[2.0, 0, 0, 2.0], [0.5, 0, 0, 0], [1, 0, 0, 0], [-3, 0, 0, 0]]),
    )
    config = ModelConfig(include_sky=True, use_color_correction=True, use_pose_correction=True)
    model = opened(tmp_path, raw, config)
    assert list(model.problems) == []
    np.testing.assert_allclose(model.sky, raw.sky.astype(np.float32).clip(0, 1))
    np.testing.assert_allclose(model.color_maps, raw.affine, rtol=1e-6)
    quarter = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    np.testing.assert_allclose(model.camera_changes[0, :3, :3], quarter, atol=1e-6)
    np.testing.assert_allclose(model.camera_changes[1:, :3, :3], [np.eye(3)] * 3, atol=1e-6)
    np.testing.assert_allclose(model.camera_changes[:, :3, 3], raw.moves, rtol=1e-6)
    unused = opened(tmp_path, raw)
    assert unused.sky is None and unused.color_maps is None and unused.camera_changes is None
    assert [problem.split(": ")[1].split()[0] for problem in unused.problems] == [
        "sky_cubemap", "color_correction", "pose_correction",
    ]  # fmt: skip


def test_poses_that_were_not_trained_are_left_alone(tmp_path: Path) -> None:
    fixed = ModelConfig(opt_track=False)
    bare = opened(tmp_path, raw_model(opt_trans=None, extra={"actor_pose": {}}), fixed)
    assert bare.pose_changes is None and list(bare.problems) == []
    unused = opened(tmp_path, raw_model(), fixed)
    assert unused.pose_changes is None
    assert "actor_pose is left out, as the configuration has not" in unused.problems[0]


def test_networks_are_left_out_with_a_sentence(tmp_path: Path) -> None:
    content = checkpoint(raw_model(), 1)
    content["sky_cubemap"] = {
        "params": {"sky_cube_map": torch.zeros(6, 4, 4, 1), "sky_codebook": torch.zeros(32, 12)}
    }
    content["color_correction"] = {"params": {"affine_trans.0.weight": torch.zeros(64, 6)}}
    config = ModelConfig(include_sky=True, use_color_correction=True)
    model = read_checkpoint(saved(tmp_path, content), config)
    assert model.sky is None and model.color_maps is None
    assert "a codebook and a network is not supported" in model.problems[0]
    assert "colour correction by a network is not supported" in model.problems[1]


def test_what_is_unknown_is_named(tmp_path: Path) -> None:
    content = checkpoint(raw_model(extra={"trees": {"xyz": torch.zeros(2, 3)}}), 1)
    content["obj_003"]["semantic"] = torch.zeros(20, 4)
    content["obj_003"]["colour_of_luck"] = torch.zeros(20)
    model = read_checkpoint(saved(tmp_path, content), PLAIN)
    assert len(model.problems) == 3
    assert "obj_003: its semantic features are not used" in model.problems[0]
    assert "colour_of_luck" in model.problems[1]
    assert "also holds trees" in model.problems[2]


def test_what_cannot_be_drawn_is_left_out_with_its_terms(tmp_path: Path) -> None:
    raw = raw_model()
    actor = raw.actors[3]
    actor.xyz[1] = np.nan
    actor.rotation[4] = 0
    actor.scaling[5] = -200
    actor.dc[7, 3, 1] = np.inf
    raw.background.opacity[9] = np.nan
    keep = np.setdiff1d(np.arange(20), [1, 4, 5, 7])
    model = opened(tmp_path, raw)
    check_part(
        model.actors[3], RawPart(**{n: v[keep] for n, v in dataclasses.asdict(actor).items()})
    )
    assert len(model.background.gaussians) == 49
    texts = "\n".join(model.problems)
    assert "obj_003: left out 2 of 20 Gaussians with NaN" in texts
    assert "with a zero quaternion" in texts and "with a scale <= 0" in texts
    assert "background: left out 1 of 50 Gaussians with NaN" in texts


def test_actors_without_gaussians_are_left_out(tmp_path: Path) -> None:
    bad = random_part(5, 4, terms=5)
    bad.xyz[:] = np.nan
    raw = raw_model(actors={3: random_part(1, 0, terms=5), 4: bad, 5: random_part(3, 6, terms=5)})
    for model in (opened(tmp_path, raw), _cloud(tmp_path, raw)):
        assert list(model.actors) == [5]
        assert any("obj_003: it has no Gaussians" in problem for problem in model.problems)
        assert any("obj_004" in p and "no usable" in p for p in model.problems)


def _cloud(folder: Path, raw: RawModel) -> TrainedModel:
    (folder / "a.ply").write_bytes(ply_bytes(raw.parts))
    return read_ply_model(folder / "a.ply", PLAIN)


def put(value: object, *keys: str):
    """A change of a checkpoint; None takes the entry out."""

    def change(content: dict) -> dict:
        place = content
        for key in keys[:-1]:
            place = place[key]
        if value is None:
            del place[keys[-1]]
        else:
            place[keys[-1]] = value
        return content

    return change


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (put(None, "background"), "lacks 'background'.*no Street Gaussians model"),
        (put(None, "actor_pose"), "lacks 'actor_pose'.*opt_track"),
        (put(None, "obj_003", "scaling"), "obj_003 lacks the tensor 'scaling'"),
        (put(None, "actor_pose", "params", "opt_rots"), "lacks the tensor 'opt_rots'"),
        (put(3, "background"), "no dictionary 'background'"),
        (put(torch.zeros(50, 2), "background", "xyz"), r"xyz must be float32"),
        (put(torch.zeros(20, 3), "background", "scaling"), r"\[50, 3\]"),
        (put(torch.zeros(50, 5, 3), "background", "feature_dc"), "must have 1 colour term"),
        (put(torch.zeros(20, 0, 3), "obj_003", "feature_dc"), "1 colour term or more; got 0"),
        (put(torch.zeros(20, 5, 3), "obj_003", "feature_rest"), "0, 3, 8, 15 coeff.*got 5"),
        (put(torch.full((50, 3), torch.nan), "background", "xyz"), "no usable Gaussians"),
        (put(torch.zeros(1, 3).expand(10**9, 3), "background", "xyz"), "xyz says it is .*not hold"),
        (put(torch.zeros(4, 3, 1), "actor_pose", "params", "opt_rots"), r"float32 \[4, 2, 1\]"),
        (
            put(torch.full((4, 2, 3), torch.inf), "actor_pose", "params", "opt_trans"),
            "opt_trans holds NaN or infinite",
        ),
        (put(np.float64(1), "background", "xyz"), "lacks the tensor 'xyz'"),
        (lambda c: [c], "must hold a dictionary"),
    ],
)
def test_wrong_checkpoints(tmp_path: Path, change, message: str) -> None:
    path = saved(tmp_path, change(checkpoint(raw_model(), 1)))
    with pytest.raises(AdapterError, match=message) as caught:
        read_checkpoint(path, PLAIN)
    assert str(path) in str(caught.value)


def test_wrong_tables(tmp_path: Path) -> None:
    turns = {"moves": np.zeros((4, 3)), "turns": np.zeros((4, 4))}
    for switch, change, message in (
        ("include_sky", {}, "lacks 'sky_cubemap'.*include_sky"),
        ("use_color_correction", {}, "lacks 'color_correction'"),
        ("include_sky", {"sky": np.zeros((6, 4, 5, 3))}, r"\[6, R, R, 3\]"),
        ("include_sky", {"sky": np.full((6, 4, 4, 3), np.nan)}, "sky_cube_map holds NaN"),
        ("use_pose_correction", turns, "a quaternion of zeros"),
    ):
        with pytest.raises(AdapterError, match=message):
            opened(tmp_path, raw_model(**change), ModelConfig(**{switch: True}))


def test_damaged_files(tmp_path: Path) -> None:
    path = saved(tmp_path, checkpoint(raw_model(), 1))
    path.write_bytes(path.read_bytes()[:-2000])
    with pytest.raises(AdapterError, match="no whole checkpoint"):
        read_checkpoint(path, PLAIN)
    with pytest.raises(AdapterError, match="does not exist"):
        read_checkpoint(tmp_path / "none.pth", PLAIN)
    cloud = tmp_path / "a.ply"
    cloud.write_bytes(ply_bytes(raw_model().parts)[:-100])
    with pytest.raises(AdapterError, match=r"announces 30 rows of 'vertex_obj_012'"):
        read_ply_model(cloud, PLAIN)


def test_wrong_point_clouds(tmp_path: Path) -> None:
    data, path = ply_bytes(raw_model().parts), tmp_path / "a.ply"
    for old, new, message in (
        (b"element vertex_background ", b"element vertex ", "opens as gaussians:"),
        (b"element vertex_background ", b"element vertex_sky ", "expected an element vertex_b"),
        (b"property float scale_1\n", b"property float scale_9\n", "misses scale_1"),
        (b"property float f_dc_2\n", b"property float f_dc_3\n", "f_dc_0, f_dc_1"),
        (b"property float f_rest_8\n", b"property float f_rest_9\n", "f_rest_0, f_rest_1"),
        (b"ply\n", b"plo\n", "not a .ply file"),
    ):
        path.write_bytes(data.replace(old, new, 1))
        with pytest.raises(AdapterError, match=message):
            read_ply_model(path, PLAIN)


def test_other_elements_are_named(tmp_path: Path) -> None:
    parts = raw_model().parts
    parts["sky"] = random_part(9, 5)
    (tmp_path / "a.ply").write_bytes(ply_bytes(parts) + b"surplus")
    model = read_ply_model(tmp_path / "a.ply", PLAIN)
    assert any("also holds vertex_sky" in problem for problem in model.problems)
    assert any("7 bytes follow" in problem for problem in model.problems)


def test_configurations(tmp_path: Path) -> None:
    tree = config_tree(**{
        "source_path": "data/002", "data.cameras": [0, 3], "data.selected_frames": [5, 90],
        "data.split_test": 4, "model.gaussian.fourier_scale": 2, "model.use_pose_correction": True,
        "model.pose_correction.mode": "frame", "model.color_correction.mode": "sensor",
    })  # fmt: skip
    path = tmp_path / "config_000000.yaml"
    path.write_text(yaml.safe_dump(tree))
    assert read_config(path) == ModelConfig(
        source_path="data/002", cameras=(0, 3), selected_frames=(5, 90), split_test=4,
        split_train=1, fourier_scale=2.0,
        include_sky=True, use_pose_correction=True, pose_correction_mode="frame",
        color_correction_mode="sensor",
    )  # fmt: skip
    path.write_text("task: waymo\ndata:\nmodel: {nsg: }\n")
    assert read_config(path) == ModelConfig()


def test_the_newest_configuration_is_taken(tmp_path: Path) -> None:
    folder = write_model(tmp_path, raw_model(), config_tree())
    for name in ("config_030000.yaml", "config_9.yaml", "config_old.yaml"):
        (folder / "configs" / name).write_text("{}")
    assert newest_config(folder).name == "config_030000.yaml"
    with pytest.raises(AdapterError, match=r"config_\*.yaml; which column.*Copy the folder"):
        newest_config(tmp_path / "configs")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"data.cameras": [0, 7]}, "data.cameras: .*must be different camera numbers"),
        ({"data.cameras": []}, "data.cameras: .*must be different camera numbers"),
        ({"data.cameras": "FRONT"}, "data.cameras: Input should be a valid tuple"),
        ({"data.selected_frames": [9, 3]}, r"data.selected_frames: .*must be \[first, last\]"),
        ({"data.selected_frames": [9]}, "data.selected_frames.1: Field required"),
        ({"data.split_test": "four"}, "data.split_test: Input should be a valid int.*got four"),
        ({"model.gaussian.fourier_scale": math.nan}, "fourier_scale: .*finite number"),
        ({"model.nsg.opt_track": 1}, "opt_track: Input should be a valid boolean"),
        ({"model.color_correction.mode": "frame"}, "should be 'image' or 'sensor'"),
        ({"model.nsg": 3}, "model.nsg.* must be a key inside a section"),
    ],
)
def test_wrong_configurations(tmp_path: Path, change: dict, words: str) -> None:
    path = tmp_path / "config_000000.yaml"
    path.write_text(yaml.safe_dump(config_tree(**change)))
    with pytest.raises(AdapterError, match=words):
        read_config(path)
