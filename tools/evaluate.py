"""How consistent the images of an output are: between frames, and between cameras.

The protocol is in docs/evaluation.md; warping is `augment.metrics.consistency`'s.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from augment.errors import OutputError
from augment.jobs.store import open_store
from augment.metrics.consistency import Warp, carry, consistency_of, find_warp
from augment.metrics.lpips import Lpips, load_lpips, picture_lpips
from tools.evaluate_views import KINDS, Drive, Pair, View, Views, pairs_of

MIN_SHARE = 0.01  # of a picture's pixels; of fewer there is nothing to say
ALL, DRY, WATER = "all", "dry", "water"
_NUMBERS = ("rmse", "relative", "share")


@dataclass(frozen=True, eq=False)
class Compared:
    """B warped into A. warped: float64 [H, W, 3]. warp: which pixels count. moved: bool [H, W],
    carried along with a box. water: bool [H, W], where either shows water; None where no file says.
    """

    a: View
    warped: np.ndarray
    warp: Warp
    moved: np.ndarray
    water: np.ndarray | None


def evaluate_output(
    out: str | Path,
    *,
    short: int = 1,
    long: int = 7,
    scenes: Sequence[str] | None = None,
    recipes: Sequence[str] | None = None,
    pairs: int | None = None,
    lpips: Path | None = None,
    lpips_heads: Path | None = None,
    pictures: Path | None = None,
    progress: bool = True,
) -> dict[str, Any]:
    """The consistency of an output's images, as facts for `evaluate_text` and for JSON.

    short, long: how many frame numbers apart. pairs: at most so many of each kind from each variant
    of a scene. lpips, lpips_heads: weights (`augment.metrics.lpips.load_lpips`). pictures: a folder
    for pictures of the worst pair of each recipe and kind.

    Raises:
        OutputError: nothing is finished there, a file is missing or damaged, there is no pair, or
            a picture cannot be written.
        MetricError: the weights cannot be used.
    """
    if short < 1 or long <= short or (pairs is not None and pairs < 1):
        raise OutputError(
            f"expected 1 <= short < long and pairs >= 1; got short={short}, long={long}, "
            f"pairs={pairs}"
        )
    network = None if lpips is None else load_lpips(lpips, lpips_heads)
    views = Views(open_store(out), scenes, recipes)
    drives = views.drives()
    found = [
        (drive, pair) for drive in drives for pair in pairs_of(views, drive, short, long, pairs)
    ]
    if not found:
        raise OutputError(
            f"{out} has no two images to compare: neither frames {short} or {long} apart of one "
            f"camera, nor cameras of one frame whose axes are less than 90 degrees apart. Render "
            f"consecutive frames"
        )
    shown = tqdm(found, unit="pair", disable=not progress)
    records = [_record(views, drive, pair, network) for drive, pair in shown]
    worst = _worst(records)
    if pictures is not None:
        from tools.evaluate_pictures import write_pictures

        write_pictures(pictures, views, worst)
    return {
        "out": str(out),
        "frames_apart": {"short": short, "long": long},
        "lpips": None if network is None else network.name,
        "recipes": _summaries(records, lambda r: (r["recipe"],), ("recipe",)),
        "variants": _summaries(
            records, lambda r: (r["scene"], r["variant"]), ("scene", "variant", "recipe")
        ),
        "worst": [{k: v for k, v in each.items() if k != "rows"} for each in worst],
        "pairs": [{k: v for k, v in each.items() if k != "rows"} for each in records],
    }


def compare(views: Views, pair: Pair) -> Compared:
    """Two views by the protocol.

    Raises:
        OutputError: a file is missing or damaged.
    """
    one, other = views.view(pair.a), views.view(pair.b)
    a, b = one.depth_view, other.depth_view
    carried = carry(views.paths(pair.a), a, b, one.shows_actor)
    alpha = np.where(carried.unclear_b, np.float32(0), b.alpha)
    warp = find_warp(a, dataclasses.replace(b, alpha=alpha), carried.points_m)
    water = None
    if one.shows_water is not None and other.shows_water is not None:
        # Bilinear: above 0 where any of the four neighbours is water.
        in_b = warp.sample(other.shows_water[..., None].astype(np.float64))[..., 0] > 0
        water = one.shows_water | in_b
    return Compared(one, warp.sample(b.picture), warp, carried.moved & warp.counts, water)


def _record(views: Views, drive: Drive, pair: Pair, network: Lpips | None) -> dict[str, Any]:
    """The numbers of one pair."""
    seen = compare(views, pair)
    counts = seen.warp.counts
    cameras = [views.camera(row) for row in (pair.a, pair.b)]
    parts = {ALL: counts}
    if seen.water is not None:
        parts |= {DRY: counts & ~seen.water, WATER: counts & seen.water}
    record: dict[str, Any] = {
        "scene": drive.scene,
        "variant": drive.variant,
        "recipe": drive.recipe,
        "effects": drive.effects,
        "kind": pair.kind,
        "frames": [views.rows["frame"][row] for row in (pair.a, pair.b)],
        "cameras": [camera.name for camera in cameras],
        "seconds_apart": abs(cameras[1].timestamp_ns - cameras[0].timestamp_ns) * 1e-9,
        "meters_apart": float((cameras[1].centre - cameras[0].centre).norm()),
        "moved_share": float(seen.moved.mean()),
        "rows": pair,
    }
    for name, part in parts.items():
        each = consistency_of(seen.a.depth_view, seen.warped, part)
        enough = each.share >= MIN_SHARE
        record[name] = {
            "share": each.share,
            "rmse": each.rmse if enough else None,
            "relative": each.relative if enough and not math.isnan(each.relative) else None,
        }
    if network is not None and record[ALL]["rmse"] is not None:
        distance = picture_lpips(network, seen.warped, seen.a.depth_view.picture, counts)
        record[ALL] |= {"lpips": distance, "lpips_counted": distance / record[ALL]["share"]}
    return record


def _summaries(
    records: Iterable[dict[str, Any]], key: Callable[[dict[str, Any]], tuple], named: Sequence[str]
) -> list[dict[str, Any]]:
    """Means over pairs with equal keys. named: what of a record its summary repeats."""
    grouped: dict[tuple, list[dict[str, Any]]] = {}
    for record in records:
        grouped.setdefault(key(record), []).append(record)
    return [
        {
            **{name: each[0][name] for name in named},
            "effects": each[0]["effects"],
            **{kind: _of_kind([r for r in each if r["kind"] == kind]) for kind in KINDS},
        }
        for each in grouped.values()
    ]


def _of_kind(records: list[dict[str, Any]]) -> dict[str, Any] | None:
    """None where there are no pairs."""
    if not records:
        return None
    used = [r for r in records if r[ALL]["rmse"] is not None]
    return {
        "pairs": len(used),
        "left_out": len(records) - len(used),
        "seconds_apart": _mean([r["seconds_apart"] for r in used]),
        "meters_apart": _mean([r["meters_apart"] for r in used]),
        "moved_share": _mean([r["moved_share"] for r in used]),
        **{part: _of_part(used, part) for part in (ALL, DRY, WATER)},
    }


def _of_part(records: list[dict[str, Any]], part: str) -> dict[str, Any] | None:
    """None where no pair has enough such pixels."""
    used = [r[part] for r in records if part in r and r[part]["rmse"] is not None]
    if not used:
        return None
    found: dict[str, Any] = {"pairs": len(used)}
    for name in (*_NUMBERS, "lpips", "lpips_counted"):
        values = [each[name] for each in used if each.get(name) is not None]
        if values:
            found[name] = {
                "mean": float(np.mean(values)),
                "std": float(np.std(values)),
                "p90": float(np.quantile(values, 0.9)),
            }
    return found


def _mean(values: list[float]) -> float | None:
    return float(np.mean(values)) if values else None


def _worst(records: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Of each recipe and kind the pair with the largest error."""
    found: dict[tuple[str, str], dict[str, Any]] = {}
    for record in records:
        rmse = record[ALL]["rmse"]
        key = record["recipe"], record["kind"]
        if rmse is not None and (key not in found or rmse > found[key][ALL]["rmse"]):
            found[key] = record
    return list(found.values())
