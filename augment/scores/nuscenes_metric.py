"""nuScenes detection score (NDS) by nuscenes-devkit, which a Python of its own runs.

In: a file of nuScenes results and the dataset. Out: `DetectionScore`. The program that runs in that
Python is `augment/scores/nuscenes_evaluation.py`.
"""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from augment.errors import ScoreError
from augment.scores import nuscenes_evaluation

# The benchmark's configuration.
CONFIGURATION = "detection_cvpr_2019"
# Number of last characters of the program's messages that an error quotes.
_MAX_MESSAGE = 600


@dataclass(frozen=True)
class NuScenesSplit:
    """Samples of nuScenes that are scored."""

    root: Path
    """Folder of the nuScenes dataset, which has the annotations."""
    version: str
    """Version of its tables, such as v1.0-trainval."""
    split: str
    """Split whose samples the predictions have, such as val or mini_val."""
    python: Path | None = None
    """Python that has nuscenes-devkit; None for the one that runs this."""


@dataclass(frozen=True)
class DetectionScore:
    """Scores of a file of results."""

    score: float
    """NDS, 0 to 1."""
    by_class: dict[str, float]
    """AP of each class, 0 to 1."""
    errors: dict[str, float]
    """Mean errors of true positives: `trans_err` in m, `scale_err`, `orient_err` in rad, `vel_err`
    in m/s, `attr_err`."""


def detection_score(
    results: Path,
    split: NuScenesSplit,
    rendered_scenes: Iterable[str],
    omitted_scenes: Iterable[str] = (),
) -> DetectionScore:
    """Return NDS of a file of results.

    Args:
        results: nuScenes results of all samples of the split.
        split: The samples.
        rendered_scenes: Names of the scenes that the suite has.
        omitted_scenes: Names of the scenes that do not count.

    Raises:
        ScoreError: The Python has no nuscenes-devkit or cannot be run, or the devkit refuses the
            results, or the suite lacks scenes of the split.
    """
    named_python = str(split.python or sys.executable)
    # The program runs in another folder, where a relative path would lead elsewhere.
    python = str(Path(shutil.which(named_python) or named_python).absolute())
    with tempfile.TemporaryDirectory() as folder:
        request_path = Path(folder) / "request.json"
        answer_path = Path(folder) / "answer.json"
        request_path.write_text(
            json.dumps({
                "root": str(split.root.absolute()),
                "version": split.version,
                "split": split.split,
                "configuration": CONFIGURATION,
                "results": str(results.absolute()),
                "rendered_scenes": sorted(rendered_scenes),
                "omitted_scenes": sorted(omitted_scenes),
            })
        )  # fmt: skip
        # By its text, and not by its path: the folder of a program is searched for modules.
        program = Path(nuscenes_evaluation.__file__).read_text()
        command = [python, "-c", program, str(request_path), str(answer_path)]
        try:
            done = subprocess.run(
                command, cwd=folder, stdin=subprocess.DEVNULL, capture_output=True, check=False
            )
        except OSError as error:
            raise ScoreError(f"{python} cannot be run to compute NDS: {error}") from error
        if not answer_path.is_file():
            text = done.stderr.decode(errors="replace").strip()[-_MAX_MESSAGE:]
            raise ScoreError(f"{python} ended with {done.returncode} and computed no NDS: {text}")
        answer = json.loads(answer_path.read_bytes())
    if "missing" in answer:
        raise ScoreError(
            f"NDS is computed by nuscenes-devkit, which {python} cannot import "
            f"({answer['missing']}). Install it into an environment of its own, since it needs "
            f"another NumPy, and name its Python: --nuscenes-python PATH/bin/python"
        )
    if "refused" in answer:
        raise ScoreError(f"{results}: nuscenes-devkit gives no NDS: {answer['refused']}")
    return DetectionScore(**answer)
