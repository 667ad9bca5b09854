"""Program that computes NDS, for the Python that has nuscenes-devkit.

`augment.scores.nuscenes_metric` starts it in another process: the devkit needs NumPy 1, this
package's OpenCV needs NumPy 2. So it imports the standard library and the devkit alone, and runs on
every Python from 3.8 on.

    python nuscenes_evaluation.py request.json answer.json

In: a `Request` as JSON. Out: a JSON object with `score`, `by_class` and `errors`, or with `missing`
(the devkit cannot be imported) or `refused` (it refuses the results), a text.
"""

from __future__ import annotations

import contextlib
import importlib
import json
import os
import sys
import tempfile
from typing import Any

# Entries of `meta` that the devkit demands, and which do not change the score.
META_NAMES = ("use_camera", "use_lidar", "use_radar", "use_map", "use_external")


def evaluate(request: dict[str, Any]) -> dict[str, Any]:
    """Return the scores of a file of results.

    Args:
        request: `root` (folder of the dataset), `version` (of its tables), `split`,
            `configuration` (of the benchmark), `results` (path of the results), `rendered_scenes`
            (names of the scenes that the results are of) and `omitted_scenes` (names of those that
            do not count).
    """
    try:
        nuscenes = importlib.import_module("nuscenes")
        config = importlib.import_module("nuscenes.eval.common.config")
        detection = importlib.import_module("nuscenes.eval.detection.evaluate")
    except ImportError as error:
        return {"missing": str(error)}
    with tempfile.TemporaryDirectory() as folder:
        with open(request["results"], "rb") as file:
            results = json.load(file)
        meta = {**dict.fromkeys(META_NAMES, False), **(results.get("meta") or {})}
        path = os.path.join(folder, "results.json")
        with open(path, "w") as file:
            json.dump({"meta": meta, "results": results["results"]}, file)
        try:
            tables = nuscenes.NuScenes(request["version"], request["root"], verbose=False)
            evaluation = detection.DetectionEval(
                tables, config.config_factory(request["configuration"]), path, request["split"],
                output_dir=folder, verbose=False,
            )  # fmt: skip
            names = {token: _scene_name(tables, token) for token in evaluation.sample_tokens}
            unknown = sorted(set(names.values()) - set(request["rendered_scenes"]))
            if unknown:
                return {
                    "refused": f"{len(unknown)} scenes of {request['split']} are not in the suite, "
                    f"the first of them {unknown[0]}: render them, or name a split of your own "
                    f"(`splits.json` beside the dataset's tables)"
                }
            omitted_scenes = set(request["omitted_scenes"])
            tokens = [token for token, name in names.items() if name not in omitted_scenes]
            for boxes in (evaluation.gt_boxes, evaluation.pred_boxes):
                boxes.boxes = {token: boxes[token] for token in tokens}
            metrics, _ = evaluation.evaluate()
        except Exception as error:  # the devkit raises what it likes, AssertionError most of all
            return {"refused": f"{type(error).__name__}: {error}"}
    return {
        "score": float(metrics.nd_score),
        "by_class": {name: float(value) for name, value in metrics.mean_dist_aps.items()},
        "errors": {name: float(value) for name, value in metrics.tp_errors.items()},
    }


def _scene_name(tables: Any, sample_token: str) -> str:
    """Return the name of the scene of a sample."""
    sample = tables.get("sample", sample_token)
    return str(tables.get("scene", sample["scene_token"])["name"])


def main(request_path: str, answer_path: str) -> None:
    """Evaluate a request and write the answer. The devkit's own prints go to stderr."""
    with open(request_path, "rb") as file:
        request = json.load(file)
    with contextlib.redirect_stdout(sys.stderr):
        answer = evaluate(request)
    with open(answer_path, "w") as file:
        json.dump(answer, file)


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2])
