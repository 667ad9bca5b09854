"""The records of the datasets agree with each other, with the code and with the user's pages."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path
from pkgutil import resolve_name

import pytest

from adapters.datasets import DATASETS, RECOGNITION_ORDER
from adapters.uri import parse_uri

ROOT = Path(__file__).resolve().parents[2]
ROW = re.compile(r"^\| (.+?) \| `(\w+):.*? \| \[.*?\]\(datasets/(.+?)\)", re.MULTILINE)


@pytest.mark.parametrize("scheme", DATASETS)
def test_a_record_names_what_exists(scheme: str) -> None:
    dataset = DATASETS[scheme]
    assert parse_uri(dataset.example)[0] == scheme
    assert callable(resolve_name(dataset.opener))
    assert dataset.labels is None or callable(resolve_name(dataset.labels))
    row = (dataset.description, scheme, dataset.page)
    assert row in ROW.findall((ROOT / "docs/scenes.md").read_text())
    assert (ROOT / "docs/datasets" / dataset.page).is_file()


def test_every_dataset_in_files_is_recognised() -> None:
    in_files = [dataset.scheme for dataset in DATASETS.values() if not dataset.builtin]
    assert sorted(dataset.scheme for dataset in RECOGNITION_ORDER) == sorted(in_files)
    assert all(dataset.folder is not None for dataset in RECOGNITION_ORDER)


def test_the_list_of_datasets_loads_no_reader() -> None:
    code = (
        "import sys, adapters.uri\n"
        "print({'torch', 'numba', 'numpy', 'cv2', 'pyarrow', 'pandas'} & set(sys.modules))\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == "set()"
