"""The tracked objects of a drive, in the columns in which a trained model has them.

Nothing in a model says which column of its actors' poses is whose. The columns are had again by
going over the track file as it was gone over for training: rows in the file's order, each into the
first free column of its frame; objects that hardly move are then taken out.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from adapters.plain_files import read_json, read_text
from adapters.street_gaussians.records import TrackedObject, Tracklets
from augment.errors import AdapterError

NOT_TRACKED = ("sign", "misc")  # classes
_COLUMNS = (
    "frame_id track_id object_class alpha box_height box_width box_length "
    "box_center_x box_center_y box_center_z box_heading"
)
_WORDS = len(_COLUMNS.split())  # of a row; a further one is the speed
_SPREAD_M = 0.5  # standard deviation along an axis of the world above which an object moves
_TRAVEL_M = 2.0  # or distance between its first place and its last
_HOLD_S = 0.1  # an object is drawn so long before its first frame and after its last


@dataclass(frozen=True, eq=False)
class TrackTable:
    """A track file of N rows in its order. All in the vehicle's frame at the frame's time.

    lines: int64 [N], for messages. frames, ids: int64 [N]. labels: N. alphas: float64 [N].
    sizes_m: float64 [N, 3], length, width, height. centers_m: float64 [N, 3]. headings: float64
    [N], about z. speeds_mps: float64 [N], or None where the file has none. problems: one sentence
    each.
    """

    path: Path
    lines: np.ndarray
    frames: np.ndarray
    ids: np.ndarray
    labels: tuple[str, ...]
    alphas: np.ndarray
    sizes_m: np.ndarray
    centers_m: np.ndarray
    headings: np.ndarray
    speeds_mps: np.ndarray | None
    problems: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.labels)


def track_files(root: Path, *, use_tracker: bool) -> tuple[Path, Path]:
    """The track file and the one that says which cameras see its objects."""
    suffix = "_castrack" if use_tracker else ""
    folder = root / "track"
    return folder / f"track_info{suffix}.txt", folder / f"track_camera_vis{suffix}.json"


def read_track_table(path: Path) -> TrackTable:
    """A track file.

    Raises:
        AdapterError: missing; a row is too short, holds something that is no finite number, or is
            the second one of its object and frame. The message names the line.
    """
    texts = read_text(path).splitlines()
    rows, words_of = [], []
    for line, text in enumerate(texts[1:], start=2):
        words = text.split()
        if words:
            rows.append((line, *_row(path, line, words)))
            words_of.append(len(words) > _WORDS)
    if len(set(words_of)) > 1:
        odd = rows[words_of.index(not words_of[0])][0]
        raise AdapterError(
            f"{path}, line {odd}: all rows must hold a speed in column {_WORDS + 1}, or none; it "
            f"differs from the first row"
        )
    _check_single(path, rows)
    has_speed = bool(words_of and words_of[0])
    numbers = np.array([row[4] for row in rows], np.float64).reshape(len(rows), 8 + has_speed)
    return TrackTable(
        path=path,
        lines=np.array([row[0] for row in rows], np.int64),
        frames=np.array([row[1] for row in rows], np.int64),
        ids=np.array([row[2] for row in rows], np.int64),
        labels=tuple(row[3] for row in rows),
        alphas=numbers[:, 0],
        sizes_m=numbers[:, 3:0:-1].copy(),
        centers_m=numbers[:, 4:7],
        headings=numbers[:, 7],
        speeds_mps=numbers[:, 8] if has_speed else None,
        problems=_headless(path, texts),
    )


def _row(path: Path, line: int, words: Sequence[str]) -> tuple[int, int, str, list[float]]:
    """Frame, object, class and the numbers after it."""
    where = f"{path}, line {line}"
    if len(words) < _WORDS:
        raise AdapterError(
            f"{where}: a row must hold the {_WORDS} columns {_COLUMNS}; it holds {len(words)}"
        )
    frame, track_id = words[0], words[1]
    if not all(re.fullmatch(r"[0-9]{1,9}", word) for word in (frame, track_id)):
        raise AdapterError(
            f"{where}: frame_id and track_id must be whole numbers >= 0; got {frame!r}, "
            f"{track_id!r}"
        )
    values = []
    names = [*_COLUMNS.split()[3:], "speed"]
    for name, word in zip(names, words[3 : _WORDS + 1], strict=False):
        try:
            value = float(word)
        except ValueError:
            value = np.nan
        needs_size = name in ("box_height", "box_width", "box_length")
        if not np.isfinite(value) or (needs_size and value <= 0):
            kind = "a number of metres > 0" if needs_size else "a finite number"
            raise AdapterError(f"{where}: {name} must be {kind}; got {word!r}")
        values.append(value)
    return int(frame), int(track_id), words[2], values


def _check_single(path: Path, rows: Sequence[tuple]) -> None:
    first: dict[tuple[int, int], int] = {}
    for line, frame, track_id, *_ in rows:
        before = first.setdefault((frame, track_id), line)
        if before != line:
            raise AdapterError(
                f"{path}, line {line}: object {track_id} is already in frame {frame} by line "
                f"{before}; delete one of them"
            )


def _headless(path: Path, texts: Sequence[str]) -> tuple[str, ...]:
    """A sentence where the first line, which is never read, holds an object."""
    words = texts[0].split() if texts else []
    if len(words) < _WORDS or not words[0].isdigit():
        return ()
    return (f"{path}: line 1, which is not read, should name the columns; it holds an object",)


Visibility = Mapping[tuple[int, int], frozenset[int]]


def read_visibility(path: Path) -> Visibility:
    """The cameras that see an object, by object and frame.

    Raises:
        AdapterError: missing, or something else in it than cameras by object and frame.
    """
    visible: dict[tuple[int, int], frozenset[int]] = {}
    for track_id, frames in read_json(path).items():
        entries = frames.items() if isinstance(frames, dict) else [("?", frames)]
        for frame, cams in entries:
            is_list = isinstance(cams, list) and all(type(cam) is int for cam in cams)
            if not (is_list and _is_number(track_id) and _is_number(frame)):
                raise AdapterError(
                    f"{path}: object {track_id!r}, frame {frame!r} must be whole numbers with a "
                    f"list of camera numbers; got {cams!r:.80}"
                )
            visible[int(track_id), int(frame)] = frozenset(cams)
    return visible


def _is_number(text: str) -> bool:
    return re.fullmatch(r"[0-9]{1,9}", text) is not None


def seen_rows(
    table: TrackTable, visible: Visibility, visible_path: Path, cams: Sequence[int]
) -> np.ndarray:
    """Indices of the rows of tracked classes that one of the cameras sees, int64 [R].

    Raises:
        AdapterError: of such a row it is not said who sees it.
    """
    kept = []
    wanted = frozenset(cams)
    for row, label in enumerate(table.labels):
        if label in NOT_TRACKED:
            continue
        track_id, frame = int(table.ids[row]), int(table.frames[row])
        if (track_id, frame) not in visible:
            raise AdapterError(
                f"{table.path}, line {table.lines[row]}: {visible_path} does not say which cameras "
                f"see object {track_id} in frame {frame}; both must be of one conversion"
            )
        if visible[track_id, frame] & wanted:
            kept.append(row)
    return np.array(kept, np.int64)


def place_rows(
    table: TrackTable, rows: np.ndarray, frames: Sequence[int], world_from_ego: np.ndarray
) -> np.ndarray:
    """The row of the table in every frame and column, int64 [F, M], -1 for none.

    rows: those that were seen. frames: consecutive. world_from_ego: float64 [F, 4, 4].
    """
    steps = table.frames[rows] - frames[0]
    inside = (steps >= 0) & (steps < len(frames))
    rows, steps = rows[inside], steps[inside]
    columns = np.bincount(steps, minlength=len(frames)).max() if len(rows) else 0
    placed = np.full((len(frames), columns), -1, np.int64)
    used = np.zeros(len(frames), np.int64)
    for row, step in zip(rows, steps, strict=True):
        placed[step, used[step]] = row
        used[step] += 1
    placed = np.where(_moves(table, placed, world_from_ego), placed, -1)
    most = int((placed >= 0).sum(1).max()) if columns else 0
    if most < columns:
        placed = _compacted(placed, most)
    return placed if placed.shape[1] else np.full((len(frames), 1), -1, np.int64)


def _moves(table: TrackTable, placed: np.ndarray, world_from_ego: np.ndarray) -> np.ndarray:
    """Whether the object in each place moves, bool [F, M]."""
    steps, columns = np.nonzero(placed >= 0)  # by frame, then column
    rows = placed[steps, columns]
    poses = world_from_ego[steps]
    world = np.einsum("nij,nj->ni", poses[:, :3, :3], table.centers_m[rows]) + poses[:, :3, 3]
    moving = np.zeros(placed.shape, bool)
    for track_id in np.unique(table.ids[rows]):
        own = table.ids[rows] == track_id
        places = world[own]
        spread = places.std(axis=0).max()
        travel = np.linalg.norm(places[-1] - places[0])
        moving[steps[own], columns[own]] = spread > _SPREAD_M or travel > _TRAVEL_M
    return moving


def _compacted(placed: np.ndarray, columns: int) -> np.ndarray:
    """Every frame's rows in its first columns, in the same order, int64 [F, columns]."""
    compact = np.full((len(placed), columns), -1, np.int64)
    for step, row in enumerate(placed):
        kept = row[row >= 0]
        compact[step, : len(kept)] = kept
    return compact


def tracklets_of(table: TrackTable, placed: np.ndarray) -> Tracklets:
    """What the placed rows say, zeros and no rotation in empty places."""
    there = placed >= 0
    if not len(table):
        empty = np.zeros((*placed.shape, 3))
        return Tracklets(placed, empty, np.tile([1.0, 0, 0, 0], (*placed.shape, 1)))
    half = np.where(there, table.headings[placed], 0.0) / 2
    zero = np.zeros_like(half)
    return Tracklets(
        ids=np.where(there, table.ids[placed], -1),
        positions=np.where(there[..., None], table.centers_m[placed], 0.0),
        quats=np.stack([np.cos(half), zero, zero, np.sin(half)], -1),
    )


def tracked_objects(
    table: TrackTable,
    rows: np.ndarray,
    ids: np.ndarray,
    frames: Sequence[int],
    frame_times_s: np.ndarray,
    drawn_s: tuple[float, float],
) -> tuple[TrackedObject, ...]:
    """The objects that have a column, in the order of the rows.

    rows: those that were seen, in all frames of the file; sizes are the largest of them. ids:
    int64 [F, M]. drawn_s: the first and last moment of any image or frame.
    """
    objects = []
    for track_id in dict.fromkeys(table.ids[rows].tolist()):
        steps = np.flatnonzero((ids == track_id).any(axis=1))
        if len(steps) == 0:
            continue
        own = rows[table.ids[rows] == track_id]
        length, width, height = (table.sizes_m[own].max(axis=0)).tolist()
        start, end = frame_times_s[steps[0]] - _HOLD_S, frame_times_s[steps[-1]] + _HOLD_S
        objects.append(
            TrackedObject(
                track_id=track_id,
                label=table.labels[own[0]],
                size_m=(length, width, height),
                start_frame=frames[steps[0]],
                end_frame=frames[steps[-1]],
                start_s=float(np.clip(start, *drawn_s)),
                end_s=float(np.clip(end, *drawn_s)),
            )
        )
    return tuple(objects)
