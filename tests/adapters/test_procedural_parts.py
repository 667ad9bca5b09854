"""The street's building blocks: ray casting against brute force, cells, cutting, noise, motion."""

from __future__ import annotations

import numpy as np
import pytest

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
    triangle,
    tube,
    value_noise,
)
from adapters.street.layout import MOUNTS, START_NS, StreetParameters, camera_offset_ns, motion_of
from adapters.street.raycast import build_tree
from adapters.street.splats import cell_counts, make_cells, total_cells
from adapters.street.world import build_street
from augment.semantics import SemanticClass

LOOK = Look((0.5, 0.5, 0.5), SemanticClass.OTHER)


def _some_shapes(rng: np.random.Generator, copies: int) -> Shapes:
    """Shapes of every kind, scattered and turned about z."""
    one = [
        boxes((-0.5, -0.3, 0.0), (0.5, 0.3, 0.8), LOOK),
        disc((0, 0, 1.0), (0.3, 0.2, 1.0), 0.6, LOOK),
        tube((0.2, 0, 0), (0.5, 0.4, 1.3), 0.15, LOOK),
        ball((0, 0.5, 0.4), (0.5, 0.2, 0.3), LOOK),
        triangle(np.array([[0, 0, 0], [1, 0, 0.2], [0, 1, 0.4]]), LOOK),
        quads(np.array([[[0, 0, 0], [1, 0, 0], [0.8, 1, 0.3], [0.1, 1, 0.3]]]), LOOK),
    ]
    parts = []
    for _ in range(copies):
        parts += [s.moved(rng.uniform(-4, 4, 3), rng.uniform(0, 7)) for s in one]
    return join(parts)


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
    counts = cell_counts(shapes, np.full((len(shapes), 2), 0.05), np.zeros(len(shapes), bool))
    cells = make_cells(shapes, counts, np.zeros(len(shapes), bool))
    normals = shapes.normals(cells.shape, cells.local)
    assert np.allclose(np.linalg.norm(normals, axis=1), 1)
    assert np.abs(np.einsum("nak,nk->na", cells.edges, normals)).max() < 1e-9


@pytest.mark.parametrize(
    ("shape", "area", "tolerance"),
    [
        (parallelograms((0, 0, 0), (2, 0, 0), (0.3, 1, 0), LOOK), 2.0, 1e-9),
        (disc((0, 0, 0), (0, 0, 1), 0.7, LOOK), np.pi * 0.49, 1e-9),
        (tube((0, 0, 0), (0, 0, 2), 0.3, LOOK), 2 * np.pi * 0.3 * 2, 1e-9),
        (ball((0, 0, 0), (0.5, 0.5, 0.5), LOOK), np.pi, 1e-9),
        # A diagonal's cells belong to the triangle whole; Thomsen's formula is good to 1.1 %.
        (triangle(np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]]), LOOK), 0.5, 0.05),
        (ball((0, 0, 0), (0.9, 0.5, 0.3), LOOK), 3.845, 0.02),
    ],
)
def test_cells_cover_each_surface_once(shape, area, tolerance):
    none = np.zeros(1, bool)
    counts = cell_counts(shape, np.full((1, 2), 0.04), none)
    cells = make_cells(shape, counts, none)
    covered = np.linalg.norm(np.cross(cells.edges[:, 0], cells.edges[:, 1]), axis=1).sum()
    assert covered == pytest.approx(area, rel=max(tolerance, 1e-9))


def test_lattices_narrow_towards_crisp_edges_only():
    shape = parallelograms((0, 0, 0), (1, 0, 0), (0, 1, 0), LOOK, edges=U0)
    none = np.zeros(1, bool)
    cells = make_cells(shape, np.array([[10, 1]]), none)
    order = np.argsort(cells.local[:, 0])
    width = cells.sides[order, 0, 0]
    borders = np.concatenate([[0], np.cumsum(width)])
    assert width[0] < width[1] < width[2] < width[3] == pytest.approx(0.1)
    assert width[-1] == pytest.approx(0.1) and borders[-1] == pytest.approx(1)
    assert np.allclose(cells.local[order, 0], (borders[1:] + borders[:-1]) / 2)
    assert total_cells(shape, np.array([[10, 1]]), none) == len(width)


def test_hidden_panels_keep_their_cells_clear_of_crisp_edges():
    shape = parallelograms((0, 0, 0), (3, 0, 0), (0, 3, 0), LOOK, edges=ALL_EDGES)
    hidden = np.ones(1, bool)
    cells = make_cells(shape, cell_counts(shape, np.full((1, 2), 0.5), hidden), hidden)
    assert cells.local[:, :2].min() > 0.1 and cells.local[:, :2].max() < 0.9
    small = parallelograms((0, 0, 0), (0.2, 0, 0), (0, 0.2, 0), LOOK)
    assert cell_counts(small, np.full((1, 2), 0.5), hidden).sum() == 0


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
    offsets = {name: camera_offset_ns(name) for name in MOUNTS}
    assert offsets["front"] == 0
    assert offsets["front_right"] == -offsets["front_left"] > 0
    assert offsets["right"] == -offsets["left"] == 30_555_556
    assert abs(offsets["back"]) == 50_000_000


def test_motion_agrees_with_its_track():
    street = build_street(StreetParameters(seed=1, frames=3, moving=2, pedestrians=1))
    for mover in street.movers:
        track = mover.motion.track
        times = START_NS + np.array([-350_000_000, -90_000_000, 0, 37_000_001, 1_000_000_000])
        centres, present = mover.motion.at(times)
        for time, centre, there in zip(times, centres, present, strict=True):
            pose = track.pose_at(int(time))
            assert (pose is not None) == there
            if pose is not None:
                # Both interpolate linearly; they differ by the rounding of times in seconds.
                assert np.allclose(pose[:3, 3].numpy(), centre, atol=1e-7)


def test_motion_ends_where_the_street_does():
    parameters = StreetParameters(seed=1, frames=300, moving=2, pedestrians=0)
    street = build_street(parameters)
    oncoming = street.movers[1]
    assert len(oncoming.motion.times_ns) < 302
    assert oncoming.motion.centres[:, 0].min() > street.layout.x0
    again = motion_of(street.layout.movers[1], street.layout, oncoming.size_m[2], 0.0)
    assert np.array_equal(again.times_ns, oncoming.motion.times_ns)
