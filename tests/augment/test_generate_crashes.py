"""Dataset jobs that are killed, stopped, starved of disk, or run several times at once."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest


def found_by(folder: Path, *scenarios: str) -> dict[str, dict]:
    """What has to hold is in the script, which ends with a message where it does not."""
    script = Path(__file__).with_name("generate_crashes.py")
    done = subprocess.run(
        [sys.executable, script, folder, *scenarios], capture_output=True, text=True, timeout=600
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def test_a_driver_killed_twice_goes_on_to_identical_files(quick_folder: Path) -> None:
    assert found_by(quick_folder, "kill_the_driver_twice")["kill_the_driver_twice"]["kills"] >= 2


@pytest.mark.long
def test_killed_jobs_go_on_to_identical_files(quick_folder: Path) -> None:
    found = found_by(quick_folder)
    assert found["kill_the_driver"]["kills"] >= 12
    assert found["kill_the_driver"]["seen"] >= 2  # readers met outputs of as many sizes
    assert found["fill_the_disk"]["failures"] >= 2
    assert sum(found["kill_workers"][who] for who in ("workers_killed", "drivers_killed")) >= 2
    assert len(found["stop_a_job_with_workers"]["finished"]) == 2
    assert found["die_at_one_image"]["rendered_again"] == 1
    assert {"run_several_drivers", "die_while_opening", "kill_an_idle_worker"} <= found.keys()
