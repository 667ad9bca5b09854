"""Moving objects without a label: their returns are followed from sweep to sweep.

Returns whose places are free in other sweeps (`adapters.lidar_scene.free_space`) are seeds.
With the returns of vehicles and people around them they make clusters, one a sweep and object.
Clusters of consecutive sweeps are linked by their places, and aligned to each other (iterated
closest points, Besl and McKay 1992, in plan). An object that can be followed over some sweeps
becomes an actor with a track of its own, as if it had been labelled. The returns of all others go.
The caller is `adapters.lidar_scene.scene`.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from adapters.lidar_scene.free_space import MOVABLE, in_still_boxes
from adapters.lidar_scene.split import ObjectTrack, PointSet
from adapters.raw_drive import BoxSample, Sweep
from augment.scene.scene import Track
from augment.scene.semantics import SemanticClass as Class

_LABELS = {Class.VEHICLE: "Car", Class.PEDESTRIAN: "Pedestrian", Class.TWO_WHEELER: "Bicycle"}
_OTHER_LABEL = "Other"  # label of a mover without a class
_VOXEL_M = 0.25  # edge of the voxels that are joined to clusters
_JOIN_M = 0.8  # largest distance between voxels' means of one cluster
_REACH_M = 8.0  # distance from a seed up to which a cluster may go
_MIN_SEEDS = 5  # fewest seeds of a cluster
_SEED_PART = 0.12  # least part of seeds among a cluster's returns
_MAX_LENGTH_M = 15.0  # longest side in plan of a cluster
_MAX_GAP_S = 0.35  # longest time without a cluster in a chain
_MAX_SPEED_MPS = 40.0  # fastest object
_GATE_M = 2.0  # distance from the predicted place up to which a cluster is linked
_MIN_SWEEPS = 4  # shortest chain that becomes an actor
_MIN_RETURNS = 30  # fewest returns of a chain that becomes an actor
_MIN_TRAVEL_M = 1.0  # shortest way of a chain that becomes an actor
_MAX_RESIDUAL_M = 0.2  # largest median distance between aligned clusters
_ICP_STEPS = 12  # steps of the alignment
_ICP_POINTS = 600  # returns of a cluster that are aligned
_ICP_REACH_M = 0.8  # distance up to which points are pairs
_MARGIN_M = 0.05  # from the outermost returns to an actor's box


@dataclass(frozen=True, eq=False)
class _Cluster:
    """Returns of one object in one sweep.

    Attributes:
        sweep: number of the sweep.
        rows: int64 [N], its returns.
        points: float64 [N, 3], scene world.
        times_s: float64 [N], since the drive's first return.
        semantic: int16 [N], classes.
    """

    sweep: int
    rows: np.ndarray
    points: np.ndarray
    times_s: np.ndarray
    semantic: np.ndarray

    @property
    def centre(self) -> np.ndarray:
        """Return the middle of its bounds, float64 [3]."""
        return (self.points.min(axis=0) + self.points.max(axis=0)) / 2

    def overlaps(self, other: _Cluster, step: np.ndarray) -> bool:
        """Return True if its bounds overlap those of another cluster that is moved by step [3]."""
        low = np.maximum(self.points.min(axis=0), other.points.min(axis=0) + step)
        high = np.minimum(self.points.max(axis=0), other.points.max(axis=0) + step)
        return bool((low <= high).all())

    @property
    def time_s(self) -> float:
        return float(np.median(self.times_s))


@dataclass(eq=False)
class _Chain:
    """Clusters of one object, in order of time."""

    clusters: list[_Cluster] = field(default_factory=list)

    def predicted(self, time_s: float) -> np.ndarray:
        """Return the place at a time by the last clusters, float64 [3]."""
        last = self.clusters[-1]
        if len(self.clusters) < 2:
            return last.centre
        return last.centre + (time_s - last.time_s) * self.velocity()

    def stands_still(self) -> bool:
        """Return True for a chain of several clusters that goes less than _MIN_TRAVEL_M."""
        return (
            len(self.clusters) > 1
            and np.ptp([c.centre[:2] for c in self.clusters], axis=0).max() < _MIN_TRAVEL_M
        )

    def velocity(self) -> np.ndarray:
        """Return the median velocity over the last clusters, float64 [3].

        Not the mean: the middle jumps where a side comes into view or leaves it.
        """
        last = self.clusters[-5:]
        seconds = np.diff([cluster.time_s for cluster in last])
        steps = np.diff([cluster.centre for cluster in last], axis=0)
        return np.median(steps / np.maximum(seconds, 1e-3)[:, None], axis=0)


@dataclass(frozen=True, eq=False)
class Mover:
    """One object that was followed.

    Attributes:
        track: its track, with a name and a label of our own.
        points: its returns in its own frame.
    """

    track: ObjectTrack
    points: PointSet


def follow_movers(
    sweeps: Sequence[Sweep],
    is_static: Sequence[np.ndarray],
    is_transient: Sequence[np.ndarray],
    still: Sequence[BoxSample],
) -> tuple[list[np.ndarray], tuple[Mover, ...]]:
    """Return a mask of each sweep's returns that stay in the static world, and the movers.

    Args:
        sweeps: all sweeps, in order of time.
        is_static: bool [N] of each sweep, returns outside of labelled moving objects.
        is_transient: bool [N] of each sweep, returns of things that have gone.
        still: boxes of objects that stand still, whose returns are no part of a mover.
    """
    stays = [mask & ~transient for mask, transient in zip(is_static, is_transient, strict=True)]
    if not any(mask.any() for mask in is_transient):
        return stays, ()
    start_ns = min(int(sweep.timestamps_ns.min()) for sweep in sweeps if len(sweep))
    clusters: list[list[_Cluster]] = []
    for number, sweep in enumerate(sweeps):
        sweep_clusters = _clusters(
            number, sweep, is_static[number], is_transient[number], still, start_ns
        )
        clusters.append(sweep_clusters)
    good: list[Mover] = []
    for chain in _link(clusters):
        mover = _mover(chain, f"unlabelled-{len(good)}", start_ns)
        if mover is not None:
            good.append(mover)
        # What hardly moves is as much of the world as it is a mover: only its seeds go.
        if mover is not None or not chain.stands_still():
            for cluster in chain.clusters:
                stays[cluster.sweep][cluster.rows] = False
    return stays, tuple(good)


def _clusters(
    number: int,
    sweep: Sweep,
    is_static: np.ndarray,
    is_transient: np.ndarray,
    still: Sequence[BoxSample],
    start_ns: int,
) -> list[_Cluster]:
    """Return the clusters of seeds with the movable returns around them."""
    seeds = np.flatnonzero(is_transient)
    if len(seeds) < _MIN_SEEDS:
        return []
    rows = np.flatnonzero((is_static & np.isin(sweep.semantic, MOVABLE)) | is_transient)
    points = sweep.points[rows].astype(np.float64)
    is_near = cKDTree(sweep.points[seeds, :2]).query(points[:, :2], distance_upper_bound=_REACH_M)
    keep = np.isfinite(is_near[0]) & ~(in_still_boxes(points, still) & ~is_transient[rows])
    rows = rows[keep]
    points = points[keep]
    labels = _joined(points)
    is_seed = is_transient[rows]
    clusters = []
    for label in np.unique(labels[is_seed]):
        members = labels == label
        num_seeds = int(is_seed[members].sum())
        if num_seeds < _MIN_SEEDS or num_seeds < _SEED_PART * members.sum():
            continue
        if np.ptp(points[members, :2], axis=0).max() > _MAX_LENGTH_M:
            members &= is_seed
        cluster_rows = rows[members]
        times_s = (sweep.timestamps_ns[cluster_rows] - start_ns) * 1e-9
        clusters.append(
            _Cluster(number, cluster_rows, points[members], times_s, sweep.semantic[cluster_rows])
        )
    return clusters


def _joined(points: np.ndarray) -> np.ndarray:
    """Return the number of the cluster of each point [N, 3]: voxels near each other are joined."""
    cells = np.floor(points / _VOXEL_M).astype(np.int64)
    _, voxel = np.unique(cells, axis=0, return_inverse=True)
    voxel = voxel.ravel()
    count = int(voxel.max()) + 1
    size = np.bincount(voxel, minlength=count)
    means = np.stack([np.bincount(voxel, points[:, a], count) / size for a in range(3)], axis=1)
    pairs = cKDTree(means).query_pairs(_JOIN_M, output_type="ndarray")
    graph = coo_array((np.ones(len(pairs), np.int8), pairs.T), shape=(count, count))
    return connected_components(graph, directed=False)[1][voxel]


def _link(clusters: Sequence[Sequence[_Cluster]]) -> list[_Chain]:
    """Link the clusters of consecutive sweeps. Of possible links the shortest come first."""
    chains: list[_Chain] = []
    for sweep_clusters in clusters:
        links = []
        for i, cluster in enumerate(sweep_clusters):
            for j, chain in enumerate(chains):
                gap_s = cluster.time_s - chain.clusters[-1].time_s
                if not 0 < gap_s <= _MAX_GAP_S:
                    continue
                reach = _GATE_M if len(chain.clusters) > 1 else gap_s * _MAX_SPEED_MPS
                step = chain.predicted(cluster.time_s) - chain.clusters[-1].centre
                distance = float(np.linalg.norm(cluster.centre - chain.clusters[-1].centre - step))
                # A side that comes into view moves the middle: then the bounds still overlap.
                if distance <= reach or cluster.overlaps(chain.clusters[-1], step):
                    links.append((distance, i, j))
        linked_clusters: set[int] = set()
        linked_chains: set[int] = set()
        for _, i, j in sorted(links):
            if i not in linked_clusters and j not in linked_chains:
                chains[j].clusters.append(sweep_clusters[i])
                linked_clusters.add(i)
                linked_chains.add(j)
        chains += [_Chain([c]) for i, c in enumerate(sweep_clusters) if i not in linked_clusters]
    return chains


def _mover(chain: _Chain, track_id: str, start_ns: int) -> Mover | None:
    """Return the object of a chain, or None if it cannot be followed."""
    clusters = chain.clusters
    num_returns = sum(len(cluster.rows) for cluster in clusters)
    if len(clusters) < _MIN_SWEEPS or num_returns < _MIN_RETURNS:
        return None
    if np.linalg.norm(clusters[-1].centre[:2] - clusters[0].centre[:2]) < _MIN_TRAVEL_M:
        return None
    poses, frozen, residual_m = _align(clusters)
    travel_m = (poses[-1] - poses[0])[:2, 3]
    if residual_m > _MAX_RESIDUAL_M or np.linalg.norm(travel_m) < _MIN_TRAVEL_M:
        return None
    turn = _turn(float(np.arctan2(travel_m[1], travel_m[0])))
    local = [
        (points - pose[:3, 3]) @ pose[:3, :3] for points, pose in zip(frozen, poses, strict=True)
    ]  # in the frame of the first cluster, which has the world's axes
    joined = np.concatenate(local) @ turn
    low = joined.min(axis=0) - _MARGIN_M
    high = joined.max(axis=0) + _MARGIN_M
    middle = (low + high) / 2
    chain_from_actor = np.eye(4)
    chain_from_actor[:3, :3] = turn
    chain_from_actor[:3, 3] = turn @ middle
    times_ns = [start_ns + round(cluster.time_s * 1e9) for cluster in clusters]
    track = Track(
        torch.tensor(times_ns, dtype=torch.int64),
        torch.from_numpy(np.stack([pose @ chain_from_actor for pose in poses])),
    )
    semantic = np.concatenate([cluster.semantic for cluster in clusters])
    votes = Counter(int(s) for s in semantic if s in MOVABLE)
    label = _LABELS[Class(votes.most_common(1)[0][0])] if votes else _OTHER_LABEL
    return Mover(
        ObjectTrack(track_id, label, track, high - low),
        PointSet((joined - middle).astype(np.float32), semantic),
    )


def _align(clusters: Sequence[_Cluster]) -> tuple[list[np.ndarray], list[np.ndarray], float]:
    """Align every cluster to those before it.

    Returns:
        world_from_chain of each cluster, float64 [4, 4]: the chain's frame has its origin at the
        first cluster's centre; the clusters' points, each carried to its cluster's time; and the
        median distance between aligned points, metres.
    """
    velocity = (clusters[-1].centre - clusters[0].centre) / max(
        clusters[-1].time_s - clusters[0].time_s, 1e-3
    )
    velocity[2] = 0
    frozen = [
        cluster.points - (cluster.times_s - cluster.time_s)[:, None] * velocity
        for cluster in clusters
    ]
    pose = np.eye(4)
    pose[:3, 3] = clusters[0].centre
    poses = [pose]
    model = _sampled(frozen[0]) - pose[:3, 3]
    residuals = []
    for number in range(1, len(clusters)):
        guess = poses[-1].copy()
        seconds = clusters[number].time_s - clusters[number - 1].time_s
        if number > 1:
            before = clusters[number - 1].time_s - clusters[number - 2].time_s
            guess[:3, 3] += (poses[-1] - poses[-2])[:3, 3] * seconds / max(before, 1e-3)
        else:
            guess[:3, 3] += velocity * seconds
        points = _sampled(frozen[number])
        pose, residual = _closest_points(points, model, guess)
        poses.append(pose)
        residuals.append(residual)
        model = np.concatenate([model, (points - pose[:3, 3]) @ pose[:3, :3]])[-4 * _ICP_POINTS :]
    return poses, frozen, float(np.median(residuals))


def _closest_points(
    points: np.ndarray, model: np.ndarray, guess: np.ndarray
) -> tuple[np.ndarray, float]:
    """Return world_from_chain that lays points [N, 3] on the model [M, 3], and the residual.

    The pose turns about the vertical only, and keeps its height.
    """
    tree = cKDTree(model)
    pose = guess
    residual = np.inf
    for _ in range(_ICP_STEPS):
        local = (points - pose[:3, 3]) @ pose[:3, :3]
        distance, index = tree.query(local)
        near = distance < _ICP_REACH_M
        if near.sum() < 6:
            return guess, np.inf
        # The best four fifths of the pairs: new sides of the object have no partner yet.
        near &= distance <= np.quantile(distance[near], 0.8)
        residual = float(np.median(distance[near]))
        source = local[near, :2]
        target = model[index[near], :2]
        source_mean = source.mean(axis=0)
        target_mean = target.mean(axis=0)
        a = source - source_mean
        b = target - target_mean
        angle = np.arctan2((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum(), (a * b).sum())
        angle = float(np.clip(angle, -0.05, 0.05))
        step = np.eye(4)
        step[:3, :3] = _turn(angle)
        step[:2, 3] = target_mean - step[:2, :2] @ source_mean
        pose = pose @ np.linalg.inv(step)
    return pose, residual


def _sampled(points: np.ndarray) -> np.ndarray:
    return points[:: max(1, len(points) // _ICP_POINTS)]


def _turn(yaw: float) -> np.ndarray:
    """Return the rotation about the vertical, float64 [3, 3]."""
    cosine = np.cos(yaw)
    sine = np.sin(yaw)
    return np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
