"""Tables and curves of `climategs bench detector`, from scores and from objects that are found.

Objects of all seeds are counted together. Intervals are those of 95 % of a bootstrap by scene: the
scenes are drawn, the seeds are not.
"""

from __future__ import annotations

import itertools
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float64

from augment.scores.half_recall import Levels, find_half_recall
from augment.scores.predictions import ExpectedImages, read_predictions
from augment.scores.recall import best_threshold, match_image
from augment.scores.scene_bootstrap import interval_ends, recall_interval, resample_scenes
from augment.scores.suite_facts import CLEAN_VARIANT, RenderedSuite
from augment.scores.suite_scores import SuiteScores
from augment.scores.truth import read_truth
from tools.bench.harness import Cell, Table

# The seed of the bootstraps.
BOOTSTRAP_SEED = 46


@dataclass(frozen=True, eq=False)
class Hits:
    """Objects that a detector finds at its clean threshold, by scene."""

    objects: Float64[np.ndarray, " S"]
    """Number of objects that count in each scene."""
    num_found: Mapping[str, Float64[np.ndarray, " S"]]
    """Number of them that are found, by variant."""


class Rise(NamedTuple):
    """The largest rise of recall from one level of an effect to the next, or the surest one of
    those whose interval lies above 0."""

    variant: str
    """The harsher variant of the two."""
    points: float
    """The rise, in points of percent; below 0 if recall falls at every step."""
    interval: tuple[float, float]
    """Its interval; NaN with a single scene."""
    num_significant: int
    """Number of the effect's steps with a rise whose interval lies above 0."""


class BenchTables(NamedTuple):
    """Tables to print, and curves to draw."""

    tables: list[Table]
    """The tables."""
    curves: dict[str, Any]
    """Recall by level, by effect and arm, with intervals; JSON."""


def count_hits(suite: RenderedSuite, folder: Path) -> Hits:
    """Return the objects that are found in a folder of predictions in COCO's format."""
    truth = read_truth(suite)
    matched = {}
    for variant, rows in suite.rows.items():
        paths = tuple(row["image_path"] for row in rows)
        expected = ExpectedImages(suite.images, paths, truth.categories)
        predictions = read_predictions(folder / variant, "coco", expected)
        matched[variant] = [
            match_image(objects, boxes, "coco")
            for objects, boxes in zip(truth.images, predictions.detections, strict=True)
        ]
    threshold = best_threshold(matched[CLEAN_VARIANT])
    _, places = np.unique([image.scene for image in suite.images], return_inverse=True)
    counts = [int(image.is_counted.sum()) for image in matched[CLEAN_VARIANT]]
    return Hits(
        np.bincount(places, weights=counts),
        {
            variant: np.bincount(places, weights=[i.are_found(threshold).sum() for i in images])
            for variant, images in matched.items()
        },
    )


def pool_hits(runs: Sequence[Hits]) -> Hits:
    """Return the sums over several seeds."""
    num_found = {
        name: np.sum([run.num_found[name] for run in runs], axis=0) for name in runs[0].num_found
    }
    return Hits(np.sum([run.objects for run in runs], axis=0), num_found)


def largest_rise(hits: Hits, variants: Sequence[str]) -> Rise:
    """Return the largest rise of recall between neighbours of some variants, mildest first.

    Intervals are of paired differences, each for itself: of nine effects with five steps each, one
    such interval lies above 0 by chance.
    """
    differences = np.stack(
        [
            hits.num_found[harsher] - hits.num_found[milder]
            for milder, harsher in itertools.pairwise(variants)
        ],
        axis=1,
    )
    rises = 100 * differences.sum(axis=0) / hits.objects.sum()
    step = int(rises.argmax())
    if len(hits.objects) < 2:
        return Rise(variants[step + 1], float(rises[step]), (np.nan, np.nan), 0)
    weights = resample_scenes(len(hits.objects), np.random.default_rng(BOOTSTRAP_SEED))
    resampled = 100 * (weights @ differences) / np.maximum(weights @ hits.objects, 1)[:, None]
    intervals = [interval_ends(of_step) for of_step in resampled.T]
    num_significant = sum(lower > 0 for lower, _ in intervals)
    if num_significant:  # the surest of those
        step = int(np.argmax([lower for lower, _ in intervals]))
    return Rise(variants[step + 1], float(rises[step]), intervals[step], num_significant)


def make_tables(
    suite: RenderedSuite,
    scores: Mapping[str, Sequence[SuiteScores]],
    hits: Mapping[str, Sequence[Hits]],
    titles: Mapping[str, str],
    unknown_effects: Sequence[str],
    parts_s: Mapping[str, float],
) -> BenchTables:
    """Return the tables and curves.

    Args:
        suite: The suite.
        scores: The scores of each seed, by arm.
        hits: The objects that are found, of each seed, by arm.
        titles: The headings of the arms.
        unknown_effects: Effects that no training shows.
        parts_s: Processor time of the parts, seconds.
    """
    pooled = {arm: pool_hits(runs) for arm, runs in hits.items()}
    curves = {arm: _curves(suite, pooled[arm]) for arm in pooled}
    num_objects = int(next(iter(hits.values()))[0].objects.sum())
    size = next(iter(suite.rows.values()))[0]
    images_text = (
        f"{len(suite.images)} images of {len(suite.entries.scenes)} streets, {num_objects} "
        f"objects, {size['width']}x{size['height']}, {len(next(iter(hits.values())))} seeds"
    )
    tables = [
        _recall_table(curves, titles, unknown_effects, images_text),
        _metric_table(suite, scores, titles, unknown_effects),
        _monotone_table(suite, pooled, titles),
        _half_recall_table(suite, pooled, titles),
        _means_table(scores, titles),
        Table("Processor time", tuple(f"{part} s" for part in parts_s), [tuple(parts_s.values())]),
    ]
    return BenchTables(tables, curves)


def _curves(suite: RenderedSuite, hits: Hits) -> dict[str, list[dict[str, Any]]]:
    """Return recall and its interval at every level, from the clean render on, by effect."""
    curves: dict[str, list[dict[str, Any]]] = {}
    for effect, names in suite.effects.items():
        curves[effect] = [
            {
                "variant": name,
                "level": suite.entries.variants[name].level,
                "recall": float(hits.num_found[name].sum() / hits.objects.sum()),
                "interval": recall_interval(
                    hits.num_found[name], hits.objects, np.random.default_rng(BOOTSTRAP_SEED)
                ),
            }
            for name in (CLEAN_VARIANT, *names)
        ]
    return curves


def _effect_title(effect: str, unknown_effects: Sequence[str]) -> str:
    """Return the name of an effect, with a remark if no training shows it."""
    return f"{effect}; learnt by none" if effect in unknown_effects else effect


def _recall_table(
    curves: Mapping[str, Mapping[str, Sequence[Mapping[str, Any]]]],
    titles: Mapping[str, str],
    unknown_effects: Sequence[str],
    images_text: str,
) -> Table:
    """Return the table of recall by level."""
    rows = list[tuple[Cell, ...]]()
    first = next(iter(curves.values()))
    levels = [point["level"] for point in next(iter(first.values()))]
    for effect in first:
        for arm, of_arm in curves.items():
            cells = [_share_text(point["recall"], point["interval"]) for point in of_arm[effect]]
            rows.append((_effect_title(effect, unknown_effects), titles[arm], *cells))
    columns = ("effect", "network", *("clean" if k == 0 else f"level {k}" for k in levels))
    title = f"Recall in % (interval of 95 %) at the clean threshold: {images_text}"
    return Table(title, columns, rows)


def _share_text(share: float, interval: tuple[float, float] | None) -> str:
    """Return a share in percent, with its interval."""
    if interval is None:
        return f"{100 * share:.0f}"
    return f"{100 * share:.0f} ({100 * interval[0]:.0f} to {100 * interval[1]:.0f})"


def _metric_table(
    suite: RenderedSuite,
    scores: Mapping[str, Sequence[SuiteScores]],
    titles: Mapping[str, str],
    unknown_effects: Sequence[str],
) -> Table:
    """Return the table of mAP by level, RR and CE, the means of the seeds."""
    rows = list[tuple[Cell, ...]]()
    num_levels = max(len(names) for names in suite.effects.values())
    for effect in suite.effects:
        for arm, runs in scores.items():
            of_effect = [run.effects[effect] for run in runs]
            levels = zip(*(values.levels for values in of_effect), strict=True)
            cells = [f"{100 * statistics.fmean(run.metric for run in runs):.1f}" for runs in levels]
            errors = [values.corruption_error for values in of_effect]
            rows.append(
                (
                    _effect_title(effect, unknown_effects),
                    titles[arm],
                    f"{100 * statistics.fmean(values.clean for values in of_effect):.1f}",
                    *cells,
                    f"{statistics.fmean(values.resilience for values in of_effect):.2f}",
                    f"{statistics.fmean(error or 0.0 for error in errors):.2f}",
                )
            )
    levels_text = tuple(f"level {k + 1}" for k in range(num_levels))
    columns = ("effect", "network", "clean", *levels_text, "RR", "CE")
    return Table(
        "mAP in %, RR, and CE against the first network: means of the seeds", columns, rows
    )


def _monotone_table(
    suite: RenderedSuite, pooled: Mapping[str, Hits], titles: Mapping[str, str]
) -> Table:
    """Return the table of the largest rises of recall."""
    rows = list[tuple[Cell, ...]]()
    for effect, names in suite.effects.items():
        for arm, hits in pooled.items():
            rise = largest_rise(hits, (CLEAN_VARIANT, *names))
            change = hits.num_found[names[-1]].sum() - hits.num_found[CLEAN_VARIANT].sum()
            rows.append(
                (
                    effect,
                    titles[arm],
                    f"{100 * change / hits.objects.sum():+.1f}",
                    f"{rise.points:+.1f} ({rise.interval[0]:+.1f} to {rise.interval[1]:+.1f})",
                    rise.variant,
                    "NO" if rise.num_significant else "yes",
                )
            )
    columns = ("effect", "network", "clean to last level", "largest rise", "at", "falls or holds")
    note = "falls or holds: no step has a rise whose interval lies above 0"
    return Table("Recall from level to level, points of percent", columns, rows, note)


def _half_recall_table(
    suite: RenderedSuite, pooled: Mapping[str, Hits], titles: Mapping[str, str]
) -> Table:
    """Return the table of V50."""
    rows = list[tuple[Cell, ...]]()
    for effect, names in suite.effects.items():
        facts = [suite.entries.variants[name] for name in names]
        values = tuple(entry.value for entry in facts if entry.value is not None)
        if not facts[0].unit or len(values) < len(names):
            continue
        cells = list[str]()
        for hits in pooled.values():
            half = find_half_recall(
                np.stack([hits.num_found[name] for name in names], axis=1),
                hits.num_found[CLEAN_VARIANT],
                hits.objects,
                Levels(names, values, facts[0].unit),
                np.random.default_rng(BOOTSTRAP_SEED),
            )
            interval = None if half is None else half.interval
            text = "" if half is None else half.text
            cells.append(text if interval is None else f"{text} ({interval[0]} to {interval[1]})")
        rows.append((effect, *cells))
    return Table("V50", ("effect", *titles.values()), rows)


def _means_table(scores: Mapping[str, Sequence[SuiteScores]], titles: Mapping[str, str]) -> Table:
    """Return the table of the means over effects: the mean of the seeds, least and greatest."""
    rows = list[tuple[Cell, ...]]()
    for arm, runs in scores.items():
        means = [run.robustness for run in runs]
        rows.append(
            (
                titles[arm],
                _spread_text([100 * run.clean for run in runs], 1),
                _spread_text([100 * mean.mpc for mean in means], 1),
                _spread_text([mean.mrr for mean in means], 3),
                _spread_text([mean.mce or 0.0 for mean in means], 3),
            )
        )
    columns = ("network", "clean mAP %", "mPC %", "mRR", "mCE")
    return Table("Means over effects and levels (least to greatest seed)", columns, rows)


def _spread_text(values: Sequence[float], digits: int) -> str:
    """Return the mean of values, with the least and the greatest."""
    mean = statistics.fmean(values)
    return f"{mean:.{digits}f} ({min(values):.{digits}f} to {max(values):.{digits}f})"


def draw_curves(path: Path, curves: Mapping[str, Any], titles: Mapping[str, str]) -> None:
    """Draw recall against level, a panel for each effect, a line with its interval for each arm."""
    from matplotlib.figure import Figure

    effects = list(next(iter(curves.values())))
    num_columns = min(3, len(effects))
    num_rows = -(-len(effects) // num_columns)
    figure = Figure(figsize=(3.4 * num_columns, 2.4 * num_rows), layout="constrained")
    for number, effect in enumerate(effects, 1):
        axes = figure.add_subplot(num_rows, num_columns, number, title=effect)
        for arm, of_arm in curves.items():
            points = of_arm[effect]
            levels = [point["level"] for point in points]
            (line,) = axes.plot(
                levels, [100 * point["recall"] for point in points], marker=".", label=titles[arm]
            )
            if all(point["interval"] for point in points):
                bounds = [[100 * end for end in point["interval"]] for point in points]
                lower, upper = zip(*bounds, strict=True)
                axes.fill_between(levels, lower, upper, color=line.get_color(), alpha=0.15)
        axes.set_ylim(0, 100)
        axes.set_xticks(levels)
        axes.grid(alpha=0.3)
        if number > len(effects) - num_columns:
            axes.set_xlabel("level")
        if number % num_columns == 1:
            axes.set_ylabel("recall, %")
        if number == 1:
            axes.legend(fontsize="x-small", loc="lower left")
    figure.savefig(path, dpi=110)
