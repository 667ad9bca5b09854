"""Measure how consistent the images of an output are: between frames, and between cameras.

The protocol is in docs/evaluation.md; warping is `augment.metrics.consistency`'s.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import math
import time
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import cv2
import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from pydantic import ValidationError
from tqdm import tqdm

from augment.dataset.clips_pairs import masks_of
from augment.dataset.weather_dataset import RowReader, Rows
from augment.errors import OutputError
from augment.metrics.consistency import (
    ActorPaths,
    DepthView,
    Warp,
    consistency_of,
    find_warp,
    move_surfaces,
)
from augment.metrics.lpips import Lpips, load_lpips, picture_lpips
from augment.output.codecs import depth_in_metres
from augment.output.layout import variant_folder
from augment.output.manifest import OK, read_manifest_rows
from augment.output.names import folder_name
from augment.output.store import Store, open_store
from augment.output.tables import read_boxes
from augment.render.sensor import noise_variance
from augment.scene.cameras import Camera
from augment.scene.geometry import invert_rigid
from recipes.errors import RecipeError
from recipes.schema import Output, Sensor
from recipes.template import readable
from recipes.yaml_tree import read_plain
from tools.chosen_images import evenly
from tools.options import names_in
from tools.output import duration_text, print_note
from tools.pictures import GAP_PX, captioned, color_mapped, resized, strip, write_rgb

if TYPE_CHECKING:
    from tools.cli import EvaluateOptions

SHORT = "short"  # pairs of one camera whose frames are close
LONG = "long"  # pairs of one camera whose frames are far apart
CAMERAS = "cameras"  # pairs of neighbouring cameras of one frame
KINDS = (SHORT, LONG, CAMERAS)
MAX_ANGLE_DEG = 90.0  # between the optical axes of neighbouring cameras
# Masks of what passes between camera and scene within one exposure, or sits on the lens: no view of
# another moment or camera shows it.
PASSING = ("rain", "snowfall", "lens_drops")
_BUFFERS = ("image", "depth", "water", "instance", *PASSING)
_KEPT = 12  # decoded views; a pair of frames needs 2, the cameras of a frame mostly 6 or 7
MIN_SHARE = 0.01  # of a picture's pixels; of fewer there is nothing to say
ALL = "all"  # all pixels that count
DRY = "dry"  # the pixels that count and show no water
WATER = "water"  # the pixels that count and show water
_NUMBERS = ("rmse", "relative", "share", "noise")
_TIMED_PAIR = 2  # the first pair also loads what all of them need
_MIN_SAID_S = 20.0  # what takes less is not said
PANEL_PX = 640  # wide
ERROR_GAIN = 5.0  # of the error's picture: white is a fifth of the range
# Colours of the mask in RGB, 0 to 255; pixels that do not count are black.
_COUNTS = (190, 190, 190)  # pixels that count
_MOVED = (240, 160, 30)  # pixels that went along with a box
_WATER = (60, 120, 230)  # pixels that show water
_PARTS = {ALL: "", DRY: "without water", WATER: "water only"}


def evaluate_output(options: EvaluateOptions, *, progress: bool = True) -> dict[str, Any]:
    """Measure the consistency of an output's images; return facts for `evaluation_text` and JSON.

    Raises:
        OutputError: nothing is finished there, a file is missing or damaged, there is no pair, or
            a picture cannot be written.
        MetricError: the weights cannot be used.
    """
    out = options.out
    short = options.short
    long = options.long
    network = options.lpips and load_lpips(options.lpips, options.lpips_heads)
    views = Views(open_store(out), names_in(options.scenes), names_in(options.recipes))
    drives = views.drives()
    drive_pairs = [
        (drive, pair)
        for drive in drives
        for pair in pairs_of(views, drive, short, long, options.pairs)
    ]
    notes = _notes(drives, {pair.kind for _, pair in drive_pairs}, short, long)
    if not drive_pairs:
        hint = "".join(f" ({note})" for note in notes)
        raise OutputError(
            f"{out} has no two images to compare: neither frames {short} or {long} apart of one "
            f"camera, nor cameras of one frame whose axes are less than 90 degrees apart. Render "
            f"consecutive frames{hint}"
        )
    if progress:
        for note in notes:
            print_note(f"note: {note}")
    records: list[dict[str, Any]] = []
    for drive, pair in tqdm(drive_pairs, unit="pair", disable=not progress):
        start_s = time.perf_counter()
        records.append(_record(views, drive, pair, network))
        if progress and len(records) == _TIMED_PAIR:
            _say_duration(len(drive_pairs), time.perf_counter() - start_s)
    worst = _worst(records)
    if options.pictures is not None:
        for record in worst:
            name = f"{folder_name(record['recipe'])}-{record['kind']}.png"
            write_rgb(options.pictures / name, pair_picture(views, record))
    for record in records:
        del record["rows"]
    return {
        "out": out,
        "frames_apart": {"short": short, "long": long},
        "notes": notes,
        "lpips": None if network is None else network.name,
        "recipes": _summaries(records, ("recipe",)),
        "variants": _summaries(records, ("scene", "variant", "recipe")),
        "worst": worst,
        "pairs": records,
    }


def _notes(drives: Sequence[Drive], kinds: Collection[str], short: int, long: int) -> list[str]:
    """Explain why tables are empty. kinds: the kinds of pairs that the output has."""
    distances = {SHORT: short, LONG: long}
    missing_kinds = [kind for kind in distances if kind not in kinds]
    by_camera = [
        sorted(frame for frame, name in drive.rows if name == camera)
        for drive in drives
        for camera in {camera for _, camera in drive.rows}
    ]
    steps = Counter(b - a for frames in by_camera for a, b in itertools.pairwise(frames))
    if not missing_kinds or not steps:
        return []
    step = steps.most_common(1)[0][0]
    span = max(frames[-1] - frames[0] for frames in by_camera)
    distance = min(math.ceil(long / step), span // step) * step
    hint = "render more frames"
    if distance > step:
        hint = f"add --short {step} --long {distance}, or render consecutive frames"
    distance_text = " or ".join(str(distances[kind]) for kind in missing_kinds)
    return [
        f"no two frames of a camera are {distance_text} apart, so the tables of "
        f"{' and '.join(missing_kinds)} range are empty: the numbers of most are {step} apart, of "
        f"the first and last {span}; "
        f"{hint}"
    ]


def _say_duration(pairs: int, pair_s: float) -> None:
    """Print how long a long evaluation will take, after one pair has been timed."""
    total_s = pairs * pair_s
    if total_s > _MIN_SAID_S:
        print_note(
            f"{pairs} pairs of images, {pair_s:.1f} s each: about {duration_text(total_s)}. "
            f"--pairs N takes N evenly chosen ones of each kind and variant"
        )


class View(NamedTuple):
    """An image with its depth and masks."""

    depth_view: DepthView
    """The image, its depth and its camera."""
    shows_water: np.ndarray | None
    """[H, W], bool. True where the image shows water; None without such a file."""
    shows_actor: np.ndarray | None
    """[H, W], bool. True where the image shows an actor; None without such a file."""


class Pair(NamedTuple):
    """Two rows of the manifest. The view of row b is warped into that of row a."""

    kind: str
    """The kind of the pair: which frames or cameras it compares."""
    a: int
    """The row of the view that is compared with the warped one."""
    b: int
    """The row of the view that is warped."""


class Drive(NamedTuple):
    """The images of one variant of one scene."""

    scene: str
    """The name of the scene."""
    variant: str
    """The name of the variant."""
    recipe: str
    """The name of the recipe."""
    effects: str
    """The names of the recipe's effects."""
    rows: dict[tuple[int, str], int]
    """The rows of the manifest by frame and camera."""


class Views:
    """Reads the views of an output and caches the last ones. scenes, recipes: names; None for all.

    Raises:
        OutputError: nothing is finished there, or nothing of these scenes and recipes.
    """

    def __init__(
        self,
        store: Store,
        scenes: Sequence[str] | None = None,
        recipes: Sequence[str] | None = None,
    ) -> None:
        table = read_manifest_rows(store)
        table = table.filter(pc.equal(table["status"], OK))
        for column, names in (("scene", scenes), ("recipe", recipes)):
            if names is None:
                continue
            column_values = set(pc.unique(table[column]).to_pylist())
            if unknown := sorted(set(names) - column_values):
                raise OutputError(
                    f"{store.uri} has no {column} {unknown}; finished are: "
                    f"{', '.join(sorted(column_values)) or 'none'}"
                )
            table = table.filter(pc.is_in(table[column], pa.array(names, pa.string())))
        self.rows = Rows.from_table(table)
        self._store = store
        self._reader = RowReader(store, verify=False)
        self.view = functools.lru_cache(_KEPT)(self._read)
        self._noise = functools.cache(self._read_noise)

    def drives(self) -> list[Drive]:
        """Return the drives in the manifest's order."""
        drives: dict[tuple[str, str], Drive] = {}
        masks = masks_of(self.rows)
        names = ("scene", "variant", "recipe", "frame", "camera")
        columns = (self.rows[name].to_pylist() for name in names)
        for row, (scene, variant, recipe, *item) in enumerate(zip(*columns, strict=True)):
            if (scene, variant) not in drives:
                effects = " + ".join(name for name, mask in masks.items() if mask[row]) or "clean"
                drives[scene, variant] = Drive(scene, variant, recipe, effects, {})
            drives[scene, variant].rows[item[0], item[1]] = row
        return list(drives.values())

    def camera(self, row: int) -> Camera:
        """Return the row's camera in the dataset's world, the world of the boxes."""
        manifest_row = self.rows.row(row)
        record, _ = self._reader.camera(manifest_row)
        if record.lens is not None or record.shutter is not None:
            raise OutputError(
                f"{self._store.uri}: camera {record.name!r} has a lens or a rolling shutter, and "
                f"views are compared as pinholes show them; render without lens=recorded in the "
                f"scene's URI to measure how they agree"
            )
        try:
            return Camera(
                record.name,
                record.width,
                record.height,
                float(record.K[0, 0]),
                float(record.K[1, 1]),
                float(record.K[0, 2]),
                float(record.K[1, 2]),
                invert_rigid(record.world_from_camera),
                record.timestamp_ns,
            )
        except (RuntimeError, TypeError, ValueError) as error:
            raise OutputError(
                f"{self._store.uri}: {manifest_row['calibration_path']} is damaged (frame "
                f"{manifest_row['frame']}, camera {record.name!r}: {error}); delete it and run "
                f"the job again, which makes it anew"
            ) from error

    def noise(self, row: int) -> float:
        """Return the sigma of the camera noise in the row's recipe.

        It is 0 for JPEG files, which lose some of the noise, and for variants without a recipe.

        """
        manifest_row = self.rows.row(row)
        return self._noise(
            f"{variant_folder(manifest_row['scene'], manifest_row['variant'])}/recipe.yaml"
        )

    def _read_noise(self, path: str) -> float:
        if not self._store.exists(path):
            return 0.0
        try:
            recipe: Any = read_plain(self._store.read(path).decode(), source=path)
            output = Output.model_validate(recipe.get("output", {}))
            sensor = Sensor.model_validate(recipe.get("camera", {}))
        except (AttributeError, ValueError, RecipeError) as error:
            why = "; ".join(readable(error)) if isinstance(error, ValidationError) else error
            raise OutputError(
                f"{self._store.uri}: {path} is damaged ({why}); delete it and run the job again, "
                f"which makes it anew"
            ) from error
        return sensor.noise if output.image == "png" else 0.0

    def paths(self, row: int) -> ActorPaths:
        """Return the paths of the boxes of the row's drive; none where it has no labels."""
        path = self.rows.row(row)["labels_path"]
        if path is None:
            return ActorPaths({})
        return self._reader.read_parsed(
            "actors", path, lambda file: (ActorPaths(read_boxes(file)),)
        )[0]

    def _read(self, row: int) -> View:
        """Read the view that the row's files hold.

        Raises:
            OutputError: the row has no depth, or a file is missing or damaged.
        """
        manifest_row = self.rows.row(row)
        images = self._reader.images(manifest_row, _BUFFERS)
        if "depth" not in images:
            raise OutputError(
                f"{self._store.uri}: variant {manifest_row['variant']!r} of scene "
                f"{manifest_row['scene']!r} has no depth images, by which views are compared; "
                f"render it with output: {{depth: median}}"
            )
        depth_m = depth_in_metres(images["depth"])
        counts = depth_m > 0
        for name in PASSING:
            if name in images:
                counts &= images[name] == 0
        return View(
            DepthView(
                self.camera(row),
                images["image"].astype(np.float32) / np.float32(255),
                depth_m,
                counts.astype(np.float32),
            ),
            images[WATER] > 0 if WATER in images else None,
            images["instance"] > 0 if "instance" in images else None,
        )


def pairs_of(views: Views, drive: Drive, short: int, long: int, most: int | None) -> list[Pair]:
    """The pairs of a drive: of one camera, `short` and `long` frame numbers apart (the later one is
    warped into the earlier), and of neighbouring cameras of one frame (the second by name into the
    first). most: of each kind at most so many, evenly chosen.
    """
    rows = drive.rows
    pairs_by_kind = dict[str, list[Pair]]()
    frames = sorted({frame for frame, _ in rows})
    cameras = sorted({camera for _, camera in rows})
    for kind, distance in ((SHORT, short), (LONG, long)):
        items = [((n, camera), (n + distance, camera)) for camera in cameras for n in frames]
        pairs_by_kind[kind] = [
            Pair(kind, rows[a], rows[b]) for a, b in items if a in rows and b in rows
        ]
    pairs_by_kind[CAMERAS] = [
        Pair(CAMERAS, a, b)
        for frame in frames
        for a, b in _neighbours(views, [rows[frame, c] for c in cameras if (frame, c) in rows])
    ]
    limit = most or len(rows) ** 2
    return [pair for pairs in pairs_by_kind.values() for pair in evenly(pairs, limit)]


def _neighbours(views: Views, rows: Sequence[int]) -> list[tuple[int, int]]:
    axes = {row: views.camera(row).world_from_camera[:3, 2].numpy() for row in rows}
    min_cosine = math.cos(math.radians(MAX_ANGLE_DEG)) - 1e-9
    return [
        (a, b) for a, b in itertools.combinations(rows, 2) if float(axes[a] @ axes[b]) >= min_cosine
    ]


class Compared(NamedTuple):
    """A view A, and a view B that is warped into A."""

    a: View
    """The view A."""
    warped: np.ndarray
    """[H, W, 3], float64. The picture of B, warped into A."""
    warp: Warp
    """The warp, with the pixels that count."""
    moved: np.ndarray
    """[H, W], bool. True where a pixel was moved with a box."""
    water: np.ndarray | None
    """[H, W], bool. True where A or B shows water; None without such files."""
    noise: np.ndarray | None
    """[H, W, 2], float64. Variance of camera noise in A and in `warped`; None without noise."""


def compare(views: Views, pair: Pair) -> Compared:
    """Compare two views by the protocol.

    Raises:
        OutputError: a file is missing or damaged.
    """
    view_a = views.view(pair.a)
    view_b = views.view(pair.b)
    a = view_a.depth_view
    b = view_b.depth_view
    carried = move_surfaces(views.paths(pair.a), a, b, view_a.shows_actor)
    alpha = np.where(carried.is_unclear_in_b, np.float32(0), b.alpha)
    warp = find_warp(a, dataclasses.replace(b, alpha=alpha), carried.points_m)
    water = None
    if view_a.shows_water is not None and view_b.shows_water is not None:
        # Bilinear: above 0 where any of the four neighbours is water.
        in_b = warp.sample(view_b.shows_water[..., None].astype(np.float64))[..., 0] > 0
        water = view_a.shows_water | in_b
    warped_picture = warp.sample(b.picture)
    moved_mask = carried.is_moved & warp.is_counted
    noise = None
    sigma = views.noise(pair.a)
    if sigma > 0:
        noise = np.zeros((*warp.is_counted.shape, 2))
        zero_offsets = np.zeros(len(warp.rows))
        offsets = warp.rows % 1, warp.columns % 1
        noise[warp.is_counted, 0] = noise_variance(
            a.picture[warp.is_counted], zero_offsets, zero_offsets, sigma
        )
        noise[warp.is_counted, 1] = noise_variance(warped_picture[warp.is_counted], *offsets, sigma)
    return Compared(view_a, warped_picture, warp, moved_mask, water, noise)


def _record(views: Views, drive: Drive, pair: Pair, network: Lpips | None) -> dict[str, Any]:
    """Compute the numbers of one pair."""
    comparison = compare(views, pair)
    counts = comparison.warp.is_counted
    cameras = [views.camera(row) for row in (pair.a, pair.b)]
    parts = {ALL: counts}
    if comparison.water is not None:
        parts |= {DRY: counts & ~comparison.water, WATER: counts & comparison.water}
    record: dict[str, Any] = {
        "scene": drive.scene,
        "variant": drive.variant,
        "recipe": drive.recipe,
        "effects": drive.effects,
        "kind": pair.kind,
        "frames": [views.rows.row(row)["frame"] for row in (pair.a, pair.b)],
        "cameras": [camera.name for camera in cameras],
        "seconds_apart": abs(cameras[1].timestamp_ns - cameras[0].timestamp_ns) * 1e-9,
        "meters_apart": float((cameras[1].centre - cameras[0].centre).norm()),
        "moved_share": float(comparison.moved.mean()),
        "rows": pair,
    }
    for name, part in parts.items():
        numbers = consistency_of(comparison.a.depth_view, comparison.warped, part, comparison.noise)
        is_usable = numbers.share >= MIN_SHARE
        record[name] = {
            "share": numbers.share,
            "rmse": numbers.rmse if is_usable else None,
            "relative": numbers.relative
            if is_usable and not math.isnan(numbers.relative)
            else None,
            "noise": numbers.noise if is_usable and comparison.noise is not None else None,
        }
    if network is not None and record[ALL]["rmse"] is not None:
        distance = picture_lpips(
            network, comparison.warped, comparison.a.depth_view.picture, counts
        )
        record[ALL] |= {"lpips": distance, "lpips_counted": distance / record[ALL]["share"]}
    return record


def _summaries(records: Iterable[dict[str, Any]], names: Sequence[str]) -> list[dict[str, Any]]:
    """Return means over the pairs that share the values of some columns."""
    groups: dict[tuple, list[dict[str, Any]]] = {}
    for record in records:
        groups.setdefault(tuple(record[name] for name in names), []).append(record)
    return [
        {
            **{name: group[0][name] for name in (*names, "effects")},
            **{kind: _summarise_pairs([r for r in group if r["kind"] == kind]) for kind in KINDS},
        }
        for group in groups.values()
    ]


def _summarise_pairs(records: list[dict[str, Any]]) -> dict[str, Any] | None:
    """Summarise the pairs of one kind (between frames, or between cameras); None without pairs.

    A pair without an error over all pixels had nothing to compare: it is counted as left out.
    """
    if not records:
        return None
    usable_records = [r for r in records if r[ALL]["rmse"] is not None]
    return {
        "pairs": len(usable_records),
        "left_out": len(records) - len(usable_records),
        **{
            name: float(np.mean([r[name] for r in usable_records])) if usable_records else None
            for name in ("seconds_apart", "meters_apart", "moved_share")
        },
        **{part: _of_part(usable_records, part) for part in (ALL, DRY, WATER)},
    }


def _of_part(records: list[dict[str, Any]], part: str) -> dict[str, Any] | None:
    """Summarise one part of the pixels; None where no pair has enough such pixels."""
    entries = [r[part] for r in records if part in r and r[part]["rmse"] is not None]
    if not entries:
        return None
    summary: dict[str, Any] = {"pairs": len(entries)}
    for name in (*_NUMBERS, "lpips", "lpips_counted"):
        values = [entry[name] for entry in entries if entry.get(name) is not None]
        if values:
            summary[name] = {
                "mean": float(np.mean(values)),
                "std": float(np.std(values)),
                "p90": float(np.quantile(values, 0.9)),
            }
    return summary


def _worst(records: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the pair with the largest error of each recipe and kind."""
    worst_records: dict[tuple[str, str], dict[str, Any]] = {}
    for record in records:
        rmse = record[ALL]["rmse"]
        key = record["recipe"], record["kind"]
        if rmse is not None and (
            key not in worst_records or rmse > worst_records[key][ALL]["rmse"]
        ):
            worst_records[key] = record
    return list(worst_records.values())


def pair_picture(views: Views, record: dict[str, Any]) -> np.ndarray:
    """Draw a pair: its frame, the other warped, their error and the mask, uint8 [H', W', 3]."""
    comparison = compare(views, record["rows"])
    picture = comparison.a.depth_view.picture
    counts = comparison.warp.is_counted
    error = np.abs(comparison.warped - picture).mean(2) * counts
    mask = np.zeros(picture.shape, np.uint8)
    mask[counts] = _COUNTS
    if comparison.water is not None:
        mask[counts & comparison.water] = _WATER
    mask[comparison.moved] = _MOVED
    numbers = record[ALL]
    a, b = (f"{c}, frame {f}" for c, f in zip(record["cameras"], record["frames"], strict=True))
    distance_text = f"{record['meters_apart']:.2f} m and {record['seconds_apart']:.2f} s apart"
    shares = f"what counts: {100 * numbers['share']:.0f} % of the pixels"
    error_map = color_mapped(ERROR_GAIN * error, cv2.COLORMAP_INFERNO)
    warped_image = _bytes(np.where(counts[..., None], comparison.warped, 0.0))
    panels = (
        (_bytes(picture), a, f"{record['scene']}, {record['variant']}"),
        (warped_image, f"{b}, warped into it", distance_text),
        (error_map, f"error, x{ERROR_GAIN:g}", f"RMSE {numbers['rmse']:.4f}"),
        (mask, shares, "blue: water; orange: went along with a box"),
    )
    interpolation = cv2.INTER_NEAREST if picture.shape[1] < PANEL_PX else cv2.INTER_AREA
    panel_images = [
        captioned(resized(image, PANEL_PX, interpolation), *texts) for image, *texts in panels
    ]
    gap_image = np.full((GAP_PX, 2 * panel_images[0].shape[1] + GAP_PX, 3), 255, np.uint8)
    return np.concatenate([strip(panel_images[:2]), gap_image, strip(panel_images[2:])])


def _bytes(picture: np.ndarray) -> np.ndarray:
    return (np.clip(picture, 0, 1) * 255).round().astype(np.uint8)


def evaluation_text(facts: dict[str, Any]) -> str:
    """Return all tables of an evaluation as text."""
    titles = {k: f"{n} frame{'s' * (n != 1)} apart" for k, n in facts["frames_apart"].items()}
    with_lpips = facts["lpips"] is not None
    lines = [line for note in facts["notes"] for line in (f"Note: {note}", "")]
    for kind, title in (*titles.items(), (CAMERAS, "Neighbouring cameras")):
        lines += [title, "", *_table(facts, kind, with_lpips), ""]
    noises = _noises(facts)
    if noises:
        lines += [f"The cameras' noise is taken out of RMSE and relative: {noises}.", ""]
    if with_lpips:
        lines += [
            f"LPIPS is of {facts['lpips']}, over the whole picture, in which pixels that do not "
            f"count are taken to agree; `counted` is it divided by the share that counts.",
            "",
        ]
    return "\n".join(lines).rstrip()


def _noises(facts: dict[str, Any]) -> str:
    """Return the noise's root mean square in a pair, by recipe, as text."""
    texts = []
    for row in facts["recipes"]:
        parts = [row[kind][ALL] for kind in KINDS if row[kind] is not None]
        noises = [p["noise"]["mean"] for p in parts if p is not None and "noise" in p]
        texts += [f"{row['recipe']} {np.mean(noises):.4f}"] if noises else []
    return ", ".join(texts)


def _table(facts: dict[str, Any], kind: str, with_lpips: bool) -> list[str]:
    titles = ["recipe", "effects", "pairs", "left out", "apart", "pixels that count"]
    titles += ["RMSE", "p90", "relative"] + ["LPIPS", "counted"] * with_lpips
    lines = [f"| {' | '.join(titles)} |", "|---" * len(titles) + "|"]
    for row in facts["recipes"]:
        lines += [f"| {' | '.join(cells)} |" for cells in _rows(row, kind, with_lpips)]
    return lines


def _rows(row: dict[str, Any], kind: str, with_lpips: bool) -> Iterator[list[str]]:
    """Return the cells of one recipe: all pixels, then pixels without and with water."""
    summary = row[kind]
    names = [row["recipe"], row["effects"]]
    if summary is None or summary[ALL] is None:
        left_out_text = "0" if summary is None else str(summary["left_out"])
        yield [*names, "0", left_out_text, *["–"] * (5 + 2 * with_lpips)]
        return
    distance_text = f"{summary['meters_apart']:.2f} m, {summary['seconds_apart']:.2f} s"
    for part, title in _PARTS.items():
        part_summary = summary[part]
        if part_summary is None:
            continue
        share = part_summary["share"]["mean"]
        rmse = part_summary["rmse"]
        relative = f"{part_summary['relative']['mean']:.3f}" if "relative" in part_summary else "–"
        numbers = [f"{100 * share:.0f} %", f"{rmse['mean']:.4f} ± {rmse['std']:.4f}"]
        numbers += [f"{rmse['p90']:.4f}", relative]
        if with_lpips:
            keys = ("lpips", "lpips_counted")
            numbers += [
                f"{part_summary[k]['mean']:.4f}" if k in part_summary else "–" for k in keys
            ]
        pairs = str(part_summary["pairs"])
        if part == ALL:
            yield [*names, pairs, str(summary["left_out"]), distance_text, *numbers]
        else:
            yield [title, "", pairs, "", "", *numbers]
