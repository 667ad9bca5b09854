"""The procedural street as a scene: parameters, labels, and its splats against the truth."""

from __future__ import annotations

import pickle

import cv2
import numpy as np
import pytest
import torch

from adapters.base import open_scene
from adapters.procedural import ExactView, StreetTruth, open_procedural, open_truth
from adapters.street.forms import (
    ALL_EDGES,
    U0,
    U1,
    V0,
    V1,
    Kind,
    Look,
    Shapes,
    ball,
    boxes,
    cut,
    disc,
    fractal_noise,
    hashed,
    join,
    parallelograms,
    quads,
    triangles,
    tube,
    value_noise,
)
from adapters.street.layout import (
    CAMERA_MOUNTS,
    ROAD_HALF_M,
    START_NS,
    StreetParameters,
    camera_offset_ns,
    draw_layout,
    motion_of,
    parse_parameters,
    pavement_z,
    road_z,
)
from adapters.street.light import build_sky
from adapters.street.raycast import build_tree
from adapters.street.splats import Cells, SplatPlan, make_cells
from adapters.street.world import build_street
from augment.errors import AdapterError, SceneError
from augment.render.rasterize import rasterize
from augment.scene.scene import Scene
from augment.scene.semantics import SemanticClass
from tests.adapters.shown import assert_same_bits
from tests.streets import open_street

QUERY = {"seed": "3", "width": "480", "height": "270"}


@pytest.fixture(scope="module")
def scene() -> Scene:
    return open_procedural(QUERY)


@pytest.fixture(scope="module")
def truth() -> StreetTruth:
    return open_truth(QUERY)


def test_invalid_queries_say_what_is_wrong():
    for query, message in (
        ({"sede": "3"}, "unknown option 'sede'; .* seed: .*; frames: "),
        ({"seed": "three"}, "seed: Input should be a valid integer.*got three"),
        ({"seed": "-1"}, "seed: Input should be greater than or equal to 0"),
        ({"frames": "301"}, "frames: Input should be less than or equal to 300 .got 301"),
        ({"frames": "2.5"}, "frames: Input should be a valid integer"),
        ({"speed_mps": "nan"}, "speed_mps: Input should be"),
    ):
        with pytest.raises(AdapterError, match=message):
            open_procedural(query)


def test_canonical_uri_opens_the_same_parameters():
    query = {"frames": "7", "seed": "4", "speed_mps": "8"}
    parameters = parse_parameters(query)
    assert parameters.uri == "procedural:street?seed=4&frames=7"
    text = parameters.uri.split("?")[1]
    assert parse_parameters(dict(pair.split("=") for pair in text.split("&"))) == parameters


def test_same_query_gives_the_same_bits_and_another_seed_does_not():
    scene = open_street()
    state = torch.random.get_rng_state(), np.random.get_state()[1].copy()  # noqa: NPY002
    build_street.cache_clear()
    build_sky.cache_clear()
    assert_same_bits(scene, open_scene(scene.source))
    other, own = (draw_layout(StreetParameters(seed=seed)) for seed in (9, 8))
    assert not np.array_equal(other.trees, own.trees)
    assert torch.equal(state[0], torch.random.get_rng_state())
    assert np.array_equal(state[1], np.random.get_state()[1])  # noqa: NPY002


def test_scene_is_complete_and_finite(scene):
    assert scene.name == "street-seed3"
    assert scene.source == "procedural:street?seed=3&width=480&height=270"
    every = [scene.background, *(actor.gaussians for actor in scene.actors)]
    assert 280_000 <= sum(len(gaussians) for gaussians in every) <= 300_000
    for gaussians in every:
        for name in ("means", "quats", "scales", "opacities", "sh"):
            assert torch.isfinite(getattr(gaussians, name)).all(), name
        assert gaussians.scales.min() > 0
        assert (gaussians.quats.norm(dim=1) - 1).abs().max() < 1e-5
        assert gaussians.semantic is not None
        colour = 0.5 + 0.28209479 * gaussians.sh[:, 0]
        assert colour.min() >= -1e-6 and colour.max() <= 1 + 1e-6
    classes = set(scene.background.semantic.unique().tolist())
    names = "ROAD LANE_MARKING SIDEWALK TERRAIN VEGETATION BUILDING POLE SIGN VEHICLE"
    assert {SemanticClass[name] for name in names.split()} <= classes
    assert len(scene.frames) == 20 and len(scene.camera_names) == 6
    assert -0.05 < scene.ground_z_m < 0


def test_cameras_ride_on_the_ego_car(scene):
    for index in (0, 19):
        frame = scene.frames[index]
        for camera in frame.cameras.values():
            assert abs(camera.timestamp_ns - frame.timestamp_ns) <= 50_000_000
            assert camera.centre[2] == pytest.approx(1.6 - 0.034, abs=0.01)
        ahead = frame.cameras["front"].world_from_camera[:3, 2]
        behind = frame.cameras["back"].world_from_camera[:3, 2]
        left = frame.cameras["left"].world_from_camera[:3, 2]
        assert ahead[0] > 0.99 and behind[0] < -0.99 and left[1] > 0.9
    moved = scene.frames[19].world_from_ego[:3, 3] - scene.frames[0].world_from_ego[:3, 3]
    assert moved[0].item() == pytest.approx(8.0 * 1.9)


def test_moving_actors_move_and_stay_in_their_boxes(scene):
    for number in (0, 11):
        boxes = scene.boxes(number)
        for actor in scene.actors:
            row = boxes.track_ids.index(actor.track_id)
            pose = actor.track.pose_at(scene.frames[number].timestamp_ns)
            assert np.allclose(boxes.centers_m[row], pose[:3, 3].numpy(), atol=1e-12)
            assert tuple(boxes.sizes_m[row]) == actor.size_m
            own = actor.gaussians.semantic != SemanticClass.ROAD  # the rest is its shadow
            reach = actor.gaussians.means[own].abs().amax(0)
            assert (reach <= torch.tensor(actor.size_m) / 2).all(), actor.track_id
            assert own.sum() > 200
    for actor in scene.actors:
        first, last = (actor.track.pose_at(scene.frames[i].timestamp_ns) for i in (0, 19))
        assert (first[:3, 3] - last[:3, 3]).norm() > 1.0
    parked = [i for i, name in enumerate(boxes.track_ids) if name.startswith("parked")]
    assert len(parked) == 12 and boxes.attributes["is_parked"][parked].all()


def test_lidar_returns_lie_on_the_surfaces_they_name(scene):
    sweep = scene.lidar(4)
    points, semantic = sweep.points_m, sweep.columns["semantic"]
    assert points.dtype == np.float64 and 40_000 < len(points) <= 65_536
    flat = np.isin(semantic, [SemanticClass.ROAD, SemanticClass.LANE_MARKING])
    flat &= (points[:, 0] > -60) & (points[:, 0] < 90)
    assert flat.sum() > 5000
    # Exact planes; what remains is rounding of coordinates of some ten metres.
    assert np.abs(points[flat, 2] - road_z(points[flat, 1])).max() < 1e-9
    paved = (semantic == SemanticClass.SIDEWALK) & (np.abs(points[:, 1]) > ROAD_HALF_M + 1e-6)
    paved &= (points[:, 0] > -60) & (points[:, 0] < 90)
    assert np.abs(points[paved, 2] - pavement_z(points[paved, 1])).max() < 1e-9
    assert np.isfinite(sweep.columns["intensity"]).all()


def test_boxes_hold_the_lidar_returns_of_their_actors_at_each_point_s_time(scene):
    sweep = scene.lidar(4)
    found = 0
    for number, actor in enumerate(scene.actors, start=1):
        index = np.flatnonzero(sweep.columns["instance"] == number)
        for i in index[:: max(1, len(index) // 50)]:
            pose = actor.track.pose_at(int(sweep.columns["timestamp_ns"][i])).numpy()
            local = pose[:3, :3].T @ (sweep.points_m[i] - pose[:3, 3])
            assert (np.abs(local) <= np.array(actor.size_m) / 2 + 1e-9).all(), actor.track_id
            found += 1
    assert found > 50
    boxes = scene.boxes(4)
    inside = np.zeros(len(sweep), bool)
    for centre, size in zip(boxes.centers_m, boxes.sizes_m, strict=True):
        inside |= (np.abs(sweep.points_m - centre) <= size / 2 + 1e-9).all(1)
    still = (sweep.columns["semantic"] == SemanticClass.VEHICLE) & (sweep.columns["instance"] == 0)
    assert inside[still].all()  # parked cars: every return is in a box, all are axis-aligned


def test_labels_survive_pickling_and_name_a_missing_frame(scene):
    labels = pickle.loads(pickle.dumps(scene.labels))
    a, b = labels.boxes(3), scene.boxes(3)
    assert a.track_ids == b.track_ids and np.array_equal(a.centers_m, b.centers_m)
    with pytest.raises(SceneError, match="frames 0 to 19; got 20"):
        scene.lidar(20)


@pytest.mark.long
@pytest.mark.parametrize(("frame", "name"), [(0, "front"), (10, "left")])
def test_splats_agree_with_the_truth(scene, truth, frame, name):
    camera = scene.frames[frame].cameras[name]
    view = truth.render(camera)
    out = rasterize(
        scene.parts_for(camera), camera, buffers=("rgb", "alpha", "expected_depth", "splat_ids")
    )
    sky = scene.sky.sample(camera.ray_directions())
    rgb = (out.rgb + (1 - out.alpha)[..., None] * sky).numpy()
    smooth = _smooth_pixels(view) & (view.depth < 30)
    classes = [SemanticClass.ROAD, SemanticClass.BUILDING]
    chosen = smooth & np.isin(view.semantic, classes)
    assert chosen.sum() > 20_000
    # Blending takes nearer splats first; splats lie deeper to make up for it, which fits some
    # viewing angles better than others and leaves about a centimetre or two at this resolution.
    error_m = np.abs(out.expected_depth.numpy() - view.depth)[chosen]
    assert np.median(error_m) < 0.025
    assert np.median(np.abs(rgb - view.rgb).max(-1)[chosen]) < 2 / 255
    assert np.mean(out.alpha.numpy()[chosen] > 0.99) > 0.97
    solid = cv2.erode(np.isfinite(view.depth).astype(np.uint8), np.ones((9, 9), np.uint8)) > 0
    solid &= view.semantic != SemanticClass.VEGETATION  # crowns have gaps
    assert out.alpha.numpy()[solid].min() > 0.9  # silhouettes fade; nothing within them is open
    own = torch.cat([p.gaussians.semantic for p in scene.parts_for(camera)]).numpy()
    seen = own[out.splat_ids.numpy()[chosen]]
    assert np.mean(seen == view.semantic[chosen]) > 0.99


def test_parts_of_the_sky_that_truth_sees_are_left_open(scene, truth):
    camera = scene.frames[0].cameras["front"]
    view = truth.render(camera)
    is_sky = np.isinf(view.depth)
    deep = cv2.erode(is_sky.astype(np.uint8), np.ones((31, 31), np.uint8)) > 0
    out = rasterize(scene.parts_for(camera), camera, buffers=("alpha",))
    assert deep.sum() > 1000
    assert out.alpha.numpy()[deep].max() < 0.02


def test_truth_sees_moving_things_where_they_are(truth):
    mover = truth.street.movers[0]
    for time in mover.motion.times_ns[[1, 5]]:
        centre = mover.motion.at(np.array([time]))[0][0]
        origin = centre + np.array([0.0, 0.0, 10.0])
        hits = truth.cast(origin, np.array([[0.0, 0.0, -1.0]]), int(time))
        assert hits.instance[0] == 1 and hits.semantic[0] == SemanticClass.VEHICLE
        assert 10 - mover.size_m[2] / 2 - 1e-9 < hits.distance[0] < 10
        assert hits.normal[0, 2] > 0.5


def _smooth_pixels(view: ExactView) -> np.ndarray:
    """Pixels whose 5x5 neighbourhood is one surface: one class and instance, colour within 8/255,
    and inverse depth (linear on a plane) without a bend or a step.
    """
    kernel = np.ones((5, 5), np.uint8)
    code = (view.semantic.astype(np.int32) * 64 + view.instance).astype(np.uint16)
    smooth = cv2.erode(code, kernel) == cv2.dilate(code, kernel)
    span = cv2.dilate(view.rgb, kernel) - cv2.erode(view.rgb, kernel)
    smooth &= span.max(-1) < 8 / 255
    inverse = 1 / np.where(np.isinf(view.depth), 1e4, view.depth)
    bend = np.zeros_like(inverse)
    bend[1:-1] = np.abs(np.diff(inverse, 2, axis=0))
    bend[:, 1:-1] = np.maximum(bend[:, 1:-1], np.abs(np.diff(inverse, 2, axis=1)))
    return smooth & (cv2.dilate(bend / inverse, kernel) < 2e-3)


LOOK = Look((0.5, 0.5, 0.5), SemanticClass.OTHER)


def _some_shapes(rng: np.random.Generator, copies: int) -> Shapes:
    """Shapes of every kind, scattered and turned about z."""
    one = [
        boxes((-0.5, -0.3, 0.0), (0.5, 0.3, 0.8), LOOK),
        disc((0, 0, 1.0), (0.3, 0.2, 1.0), 0.6, LOOK),
        tube((0.2, 0, 0), (0.5, 0.4, 1.3), 0.15, LOOK),
        ball((0, 0.5, 0.4), (0.5, 0.2, 0.3), LOOK),
        triangles(np.zeros(3), np.array([1, 0, 0.2]), np.array([0, 1, 0.4]), LOOK),
        quads(np.array([[[0, 0, 0], [1, 0, 0], [0.8, 1, 0.3], [0.1, 1, 0.3]]]), LOOK),
    ]
    parts = []
    for _ in range(copies):
        parts += [s.moved(rng.uniform(-4, 4, 3), rng.uniform(0, 7)) for s in one]
    return join(parts)


def _plan(shapes: Shapes, *spacing: float, hidden: bool = False) -> SplatPlan:
    """Splats this far apart along both axes of all shapes."""
    spacings = np.full((len(shapes), 2), spacing)
    is_hidden = np.full(len(shapes), hidden)
    return SplatPlan(None, shapes, spacings, None, is_hidden)


def _cells(plan: SplatPlan) -> tuple[Cells, np.ndarray]:
    """Cells, and their sides in metres [N, 2, 3]."""
    cells = make_cells(plan.shapes, plan.counts(1.0), plan.is_hidden)
    return cells, cells.sides @ plan.shapes.axes[cells.shape]


def _brute_force(shapes: Shapes, origin: np.ndarray, direction: np.ndarray) -> float:
    """Nearest hit of one ray, by trying each shape with equations of its own kind."""
    best = np.inf
    for i in range(len(shapes)):
        u, v, w = shapes.axes[i]
        p = origin - shapes.origin[i]
        candidates: list[float] = []
        if shapes.kind[i] <= Kind.DISC:
            normal = np.cross(u, v)
            if abs(direction @ normal) > 1e-12:
                t = -(p @ normal) / (direction @ normal)
                q = np.linalg.lstsq(np.stack([u, v], 1), p + t * direction, rcond=None)[0]
                inside = {
                    Kind.PARALLELOGRAM: (q >= 0).all() and (q <= 1).all(),
                    Kind.TRIANGLE: (q >= 0).all() and q.sum() <= 1,
                    Kind.DISC: q @ q <= 1,
                }[Kind(int(shapes.kind[i]))]
                candidates = [t] if inside else []
        else:
            matrix = np.stack([u, v, w], 1)
            a, b = np.linalg.solve(matrix, p), np.linalg.solve(matrix, direction)
            tube_like = shapes.kind[i] == Kind.CYLINDER
            n = 2 if tube_like else 3
            roots = np.roots([b[:n] @ b[:n], 2 * a[:n] @ b[:n], a[:n] @ a[:n] - 1])
            real = [r.real for r in roots if abs(r.imag) < 1e-12]
            candidates = [r for r in real if not tube_like or abs(a[2] + r * b[2]) <= 1]
        best = min([best, *(t for t in candidates if t > 1e-7)])
    return best


def test_ray_casting_matches_brute_force():
    rng = np.random.default_rng(5)
    shapes = _some_shapes(rng, 6)
    origins, targets = rng.uniform(-6, 6, (150, 3)), rng.uniform(-3, 3, (150, 3))
    directions = targets - origins
    directions[0] = [0.0, 0.0, -1.0]  # parallel to an axis
    tree = build_tree(shapes)
    hits = tree.cast(origins, directions)
    expected = [_brute_force(shapes, o, d) for o, d in zip(origins, directions, strict=True)]
    # A ray that grazes an edge may fall on either side of it by rounding; none of these does.
    assert np.allclose(hits.distance, expected, rtol=1e-9, equal_nan=False)
    assert 20 < np.isfinite(hits.distance).sum() < 150
    assert np.array_equal(tree.occluded(origins, directions, 0.7), hits.distance < 0.7)
    found = np.flatnonzero(hits.shape >= 0)
    points = shapes.points(hits.shape[found], hits.local[found])
    reached = origins[found] + hits.distance[found, None] * directions[found]
    assert np.allclose(points, reached, atol=1e-9)


def test_normals_are_unit_and_at_right_angles_to_the_cells():
    shapes = _some_shapes(np.random.default_rng(1), 1)
    cells, edges = _cells(_plan(shapes, 0.05))
    normals = shapes.normals(cells.shape, cells.local)
    assert np.allclose(np.linalg.norm(normals, axis=1), 1)
    assert np.abs(np.einsum("nak,nk->na", edges, normals)).max() < 1e-9


@pytest.mark.parametrize(
    ("shape", "area", "tolerance"),
    [
        (parallelograms((0, 0, 0), (2, 0, 0), (0.3, 1, 0), LOOK), 2.0, 1e-9),
        (disc((0, 0, 0), (0, 0, 1), 0.7, LOOK), np.pi * 0.49, 1e-9),
        (tube((0, 0, 0), (0, 0, 2), 0.3, LOOK), 2 * np.pi * 0.3 * 2, 1e-9),
        (ball((0, 0, 0), (0.5, 0.5, 0.5), LOOK), np.pi, 1e-9),
        # A diagonal's cells belong to the triangle whole; Thomsen's formula is good to 1.1 %.
        (triangles(np.zeros(3), np.array([1, 0, 0]), np.array([0, 1, 0]), LOOK), 0.5, 0.05),
        (ball((0, 0, 0), (0.9, 0.5, 0.3), LOOK), 3.845, 0.02),
    ],
)
def test_cells_cover_each_surface_once(shape, area, tolerance):
    _, edges = _cells(_plan(shape, 0.04))
    covered = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1).sum()
    assert covered == pytest.approx(area, rel=max(tolerance, 1e-9))


def test_lattices_narrow_towards_crisp_edges_only():
    shape = parallelograms((0, 0, 0), (1, 0, 0), (0, 1, 0), LOOK, edges=U0)
    plan = _plan(shape, 0.1, 1.0)
    cells, _ = _cells(plan)
    order = np.argsort(cells.local[:, 0])
    width = cells.sides[order, 0, 0]
    borders = np.concatenate([[0], np.cumsum(width)])
    assert width[0] < width[1] < width[2] < width[3] == pytest.approx(0.1)
    assert width[-1] == pytest.approx(0.1) and borders[-1] == pytest.approx(1)
    assert np.allclose(cells.local[order, 0], (borders[1:] + borders[:-1]) / 2)
    assert plan.total(1.0) == len(width)


def test_hidden_panels_keep_their_cells_clear_of_crisp_edges():
    shape = parallelograms((0, 0, 0), (3, 0, 0), (0, 3, 0), LOOK, edges=ALL_EDGES)
    cells, _ = _cells(_plan(shape, 0.5, hidden=True))
    assert cells.local[:, :2].min() > 0.1 and cells.local[:, :2].max() < 0.9
    small = parallelograms((0, 0, 0), (0.2, 0, 0), (0, 0.2, 0), LOOK)
    assert _plan(small, 0.5, hidden=True).counts(1.0).sum() == 0


def test_cutting_leaves_exactly_what_lies_outside_the_holes():
    holes = [(1.0, 1.0, 2.0, 3.0), (2.0, 2.0, 2.5, 4.0), (-1.0, 0.0, 0.5, 0.5)]
    pieces, edges = cut((0.0, 0.0, 4.0, 5.0), holes)
    rng = np.random.default_rng(2)
    points = rng.uniform((0, 0), (4, 5), (4000, 2))

    def count(rectangles: np.ndarray) -> np.ndarray:
        r = np.array(rectangles)[None]
        x, y = points[:, None, 0], points[:, None, 1]
        return ((x > r[..., 0]) & (x < r[..., 2]) & (y > r[..., 1]) & (y < r[..., 3])).sum(1)

    assert np.array_equal(count(pieces) + (count(holes) > 0), np.ones(4000))
    beside = pieces[:, 2] == 1.0
    assert beside.any() and (edges[beside] & U1).all()
    assert ((edges & V0) > 0)[pieces[:, 1] == 0].all()
    whole, bits = cut((0.0, 0.0, 1.0, 1.0), [], rim=V1)
    assert whole.tolist() == [[0, 0, 1, 1]] and bits.tolist() == [V1]


def test_noise_depends_on_place_and_seed_alone():
    integers = np.array([[0, 0], [1, 0], [-5, 7]], np.int32)
    assert hashed(integers, 3).tolist() == [
        0.14758598804473877,
        0.8087420463562012,
        0.3701316714286804,
    ]
    pinned = value_noise(np.array([[0.5, 0.25, 0.1], [7.2, -3.1, 2.0]]), 4)
    assert np.allclose(pinned, [0.389884, 0.735432], atol=1e-5)  # float32 products
    points = np.random.default_rng(0).uniform(-50, 50, (2000, 3))
    noise = value_noise(points, 4)
    assert np.array_equal(noise[::-1], value_noise(points[::-1], 4))
    assert not np.array_equal(noise, value_noise(points, 5))
    assert np.abs(noise).max() <= 1 and noise.std() > 0.2
    step = np.abs(value_noise(points + 1e-3, 4) - noise)
    assert step.max() < 0.02  # smooth: at most 3/2 per cell along each axis, twice over
    assert np.abs(fractal_noise(points[:, :2], 4, 1)).max() <= 1


def test_cameras_fire_as_the_beam_passes():
    offsets = {name: camera_offset_ns(name) for name in CAMERA_MOUNTS}
    assert offsets["front"] == 0
    assert offsets["front_right"] == -offsets["front_left"] > 0
    assert offsets["right"] == -offsets["left"] == 30_555_556
    assert abs(offsets["back"]) == 50_000_000


def test_motion_agrees_with_its_track():
    layout = draw_layout(StreetParameters(seed=1, frames=3, moving=2, pedestrians=1))
    times = START_NS + np.array([-350_000_000, -90_000_000, 0, 37_000_001, 1_000_000_000])
    for mover in layout.movers:
        motion = motion_of(mover, layout, 1.5, 0.0)
        for time, centre, there in zip(times, *motion.at(times), strict=True):
            pose = motion.track.pose_at(int(time))
            assert (pose is not None) == there
            if pose is not None:
                # Both interpolate linearly; they differ by the rounding of times in seconds.
                assert np.allclose(pose[:3, 3].numpy(), centre, atol=1e-7)


def test_motion_ends_where_the_street_does():
    layout = draw_layout(StreetParameters(seed=1, frames=300, moving=2, pedestrians=0))
    oncoming = motion_of(layout.movers[1], layout, 1.5, 0.0)
    assert len(oncoming.times_ns) < 302
    assert oncoming.centres[:, 0].min() > layout.x0
