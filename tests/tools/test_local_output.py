"""Commands that need a folder of this machine refuse what is none."""

from __future__ import annotations

import pytest

from tools.cli import main

COMMANDS = [
    ["render", "clear", "--scene", "procedural:street", "--out", "s3://bucket/path"],
    ["sheet", "s3://bucket/path"],
    ["mirror", "gs://bucket/path"],
]


@pytest.mark.parametrize("words", COMMANDS, ids=lambda words: words[0])
def test_an_object_store_is_no_folder(words, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(words) == 2
    assert "is not on this machine" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
