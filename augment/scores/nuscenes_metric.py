"""nuScenes detection score by nuscenes-devkit, an optional package."""

from __future__ import annotations

import contextlib
import importlib
import io
import json
import tempfile
from pathlib import Path
from typing import Any

from augment.errors import ScoreError
from augment.scores.predictions import RESULTS_FILE, Predictions

# The benchmark's configuration.
CONFIGURATION = "detection_cvpr_2019"


def detection_score(
    predictions: Predictions, root: Path, version: str, split: str
) -> tuple[float, dict[str, float | None]]:
    """Return NDS, and the AP of each class.

    Args:
        predictions: nuScenes results of all samples of the split.
        root: Folder of the nuScenes dataset.
        version: Version of its tables, such as v1.0-trainval.
        split: Name of a split, such as val or mini_val.

    Raises:
        ScoreError: nuscenes-devkit is not installed, or refuses the results.
    """
    try:
        nuscenes: Any = importlib.import_module("nuscenes")
        config: Any = importlib.import_module("nuscenes.eval.common.config")
        evaluate: Any = importlib.import_module("nuscenes.eval.detection.evaluate")
    except ImportError as error:
        raise ScoreError(
            f"NDS is computed by nuscenes-devkit, which cannot be imported here ({error}); install "
            f"it beside ClimateGS: pip install nuscenes-devkit"
        ) from error
    path = predictions.folder / RESULTS_FILE
    with contextlib.redirect_stdout(io.StringIO()), tempfile.TemporaryDirectory() as folder:
        # The devkit needs `meta` with five entries that do not change the score.
        results = json.loads(path.read_bytes())
        sensors = ("use_camera", "use_lidar", "use_radar", "use_map", "use_external")
        results["meta"] = dict.fromkeys(sensors, False) | (results.get("meta") or {})
        completed_path = Path(folder) / RESULTS_FILE
        completed_path.write_text(json.dumps(results))
        try:
            tables = nuscenes.NuScenes(version=version, dataroot=str(root), verbose=False)
            evaluation = evaluate.DetectionEval(
                tables, config.config_factory(CONFIGURATION), str(completed_path), split,
                output_dir=folder, verbose=False,
            )  # fmt: skip
            metrics, _ = evaluation.evaluate()
        except (AssertionError, LookupError, OSError, ValueError) as error:
            raise ScoreError(f"{path}: nuscenes-devkit refuses these results: {error}") from error
    return float(metrics.nd_score), {k: float(ap) for k, ap in metrics.mean_dist_aps.items()}
