"""`climategs score`: predictions on a robustness suite become scores, a page and JSON."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import TYPE_CHECKING

from pydantic import ValidationError

from augment.errors import ScoreError
from augment.output.atomic import write_atomic
from augment.output.store import open_store
from augment.scores.nuscenes_metric import NuScenesSplit
from augment.scores.score_suite import ScoreOptions, score_suite
from augment.scores.suite_facts import read_suite
from augment.scores.suite_scores import Interval, SuiteScores
from augment.scores.truth import coco_truth, read_truth
from recipes.schema import Category
from tools.output import print_note, write_json
from tools.score_page import make_score_page

if TYPE_CHECKING:
    from tools.cli import ScoreCommand

PAGE = "score.html"


def score_predictions(options: ScoreCommand) -> int:
    """Score predictions, print a table, write the page and the JSON. Return the exit code."""
    assert options.predictions is not None, "checked by the options"
    store = open_store(options.out)
    scores = score_suite(
        store,
        options.predictions,
        options.baseline,
        ScoreOptions(
            effects=None if options.effects == "all" else tuple(options.effects.split(",")),
            categories=parse_categories(options.categories),
            kitti_view=options.kitti_view,
            kitti_difficulty=options.kitti_difficulty,
            nuscenes=None
            if options.nuscenes is None
            else NuScenesSplit(
                options.nuscenes,
                options.nuscenes_version,
                options.nuscenes_split,
                options.nuscenes_python,
            ),
        ),
    )
    print("\n".join(score_lines(scores)))
    for warning in scores.warnings:
        print_note(f"warning: {warning}")
    for note in scores.notes:
        print_note(f"note: {note}")
    html = options.html or options.predictions / PAGE
    write_atomic(html.absolute(), make_score_page(scores, store).encode())
    print(f"page: {html}")
    write_json(options.json_file, scores.model_dump(mode="json"))
    return 0


def write_truth(options: ScoreCommand) -> int:
    """Write the truth of every variant as a COCO file. Return the exit code."""
    assert options.truth is not None, "checked by the options"
    suite = read_suite(open_store(options.out))
    truth = read_truth(suite, parse_categories(options.categories))
    for variant in suite.rows:
        path = options.truth.absolute() / f"{variant}.json"
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomic(path, (json.dumps(coco_truth(suite, truth, variant)) + "\n").encode())
    counted = truth.count(range(len(suite.images)))
    print(
        f"{options.truth}: {len(suite.rows)} variants of {len(suite.images)} images, {counted} "
        f"objects that count; categories {', '.join(truth.categories)}"
    )
    return 0


def parse_categories(texts: Sequence[str]) -> tuple[Category, ...] | None:
    """Return the table of categories of texts such as `Car=vehicle.car`; None for none.

    Raises:
        ScoreError: A text is no such entry.
    """
    rows = []
    for text in texts:
        name, _, label = text.partition("=")
        try:
            rows.append(Category(name=name, label=label))
        except ValidationError as error:
            raise ScoreError(
                f"--categories {text}: write NAME=LABEL, as in Car=vehicle.*"
            ) from error
    return tuple(rows) or None


def score_lines(scores: SuiteScores) -> list[str]:
    """Return the scores as lines of text."""
    lines = [
        f"{scores.suite}: {scores.metric}; {scores.images} images of {scores.scenes} scenes each",
        f"  clean {scores.clean:.4f}{_range_text(scores.clean_interval)}"
        + ("" if scores.recorded is None else f" (recorded images {scores.recorded:.4f})"),
    ]
    width = max(len(name) for name in scores.effects)
    for name, effect in scores.effects.items():
        values = "  ".join(f"{level.metric:.4f}" for level in effect.levels)
        half = effect.half_recall
        v50 = "" if half is None else f"  V50 {half.text}"
        if half is not None and half.interval is not None:
            v50 += f" ({half.interval[0]} to {half.interval[1]})"
        lines.append(f"  {name:{width}}  {values}  RR {effect.resilience:.3f}{v50}")
    means = scores.robustness
    lines.append(
        f"  mPC {means.mpc:.4f}  rPC {means.rpc:.3f}  mRR {means.mrr:.3f}  mRA {means.mra:.3f}"
        + ("" if means.mce is None else f"  mCE {means.mce:.3f}")
        + ("" if means.mrra is None else f"  mRRA {means.mrra:+.3f}")
    )
    if means.mpc_interval is not None:
        intervals = {
            "mPC": means.mpc_interval,
            "mRR": means.mrr_interval,
            "mCE": means.mce_interval,
            "mRRA": means.mrra_interval,
        }
        texts = [
            f"{name}{_range_text(interval)}"
            for name, interval in intervals.items()
            if interval is not None
        ]
        lines.append(f"  95 %, by scene: {', '.join(texts)}")
    return lines


def _range_text(interval: Interval | None) -> str:
    """Return an interval as a text after its value; empty for none."""
    return "" if interval is None else f" ({interval[0]:.3f} to {interval[1]:.3f})"
