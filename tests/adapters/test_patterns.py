"""Scenes of a job: patterns taken apart, relative paths made absolute."""

from __future__ import annotations

from pathlib import Path

import pytest

from adapters.base import scenes_of
from augment.errors import AdapterError
from recipes.job import JobScene


def uris(folder: Path, *entries: str | JobScene) -> list[str]:
    given = [JobScene(uri=e) if isinstance(e, str) else e for e in entries]
    return [scene.uri for scene in scenes_of(given, folder)]


@pytest.fixture(params=["plain", "odd [1] *"])
def folder(tmp_path: Path, request: pytest.FixtureRequest) -> Path:
    """Of a job; its own name may look like a pattern."""
    root = tmp_path / request.param
    for name in ("runs/b", "runs/a", "runs/c/deep", "other"):
        (root / name).mkdir(parents=True)
    return root


def test_patterns_stand_for_all_that_match_in_order(folder: Path) -> None:
    assert uris(folder, "runs/*") == [str(folder / "runs" / name) for name in "abc"]
    assert uris(folder, "runs/[ab]") == [str(folder / "runs" / name) for name in "ab"]
    assert uris(folder, "**/deep") == [str(folder / "runs/c/deep")]
    found = uris(folder, "pandaset:runs/*?k=v")
    assert [uri.split("/")[-1] for uri in found] == ["a?k=v", "b?k=v", "c?k=v"]
    assert all(uri.startswith("pandaset:/") for uri in found)


def test_each_keeps_what_the_entry_says(folder: Path) -> None:
    entry = JobScene(uri="runs/*", frames="::5", cameras=("front",), recipes=("fog",))
    for scene in scenes_of([entry], folder):
        assert (scene.frames, scene.cameras, scene.recipes) == ("::5", ("front",), ("fog",))


def test_paths_are_the_jobs_and_not_the_shells(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert uris(folder, "other") == [str(folder / "other")]
    assert uris(folder, "missing") == [str(folder / "missing")]  # told where it is opened
    monkeypatch.chdir(folder.parent)
    assert uris(Path(folder.name), "runs/a") == [str(folder / "runs/a")]


def test_files_that_the_query_names_lie_beside_the_job(folder: Path) -> None:
    (folder / "path.json").write_text("{}")
    for uri in ("procedural:street?seed=3&camera_path=path.json",
                "pandaset:runs/a?seed=3&camera_path=path.json"):  # fmt: skip
        (found,) = uris(folder, uri)
        assert found.partition("?")[2].startswith("seed=3&camera_path=/")
        assert "path.json" in found
    assert uris(folder, "procedural:street?seed=3") == ["procedural:street?seed=3"]
    assert uris(folder, "unheard:of?x=1") == ["unheard:of?x=1"]


def test_what_is_refused(folder: Path) -> None:
    with pytest.raises(AdapterError, match=r"'none/\*': nothing matches"):
        uris(folder, "none/*")
    with pytest.raises(AdapterError, match="stands for 3 scenes, which cannot all be called 'x'"):
        uris(folder, JobScene(uri="runs/*", name="x"))
    with pytest.raises(AdapterError, match=r"names the scene '.*runs/a' twice \(by 'runs/a'\)"):
        uris(folder, "runs/*", "runs/a")


def test_a_pattern_that_would_look_through_too_much_is_refused(tmp_path, monkeypatch, ends_soon):
    for place in ("a", "b"):  # links back to the top: 2^40 ways down
        (tmp_path / place / "deep").mkdir(parents=True)
        for link in ("one", "two"):
            (tmp_path / place / link).symlink_to(tmp_path)
    assert uris(tmp_path, "**/deep") == [str(tmp_path / p / "deep") for p in ("a", "b")]
    assert uris(tmp_path, "a/*/b/deep") == [str(tmp_path / f"a/{n}/b/deep") for n in ("one", "two")]
    (tmp_path / ".hidden" / "deep").mkdir(parents=True)
    assert len(uris(tmp_path, "*/deep")) == 2 and len(uris(tmp_path, ".*/deep")) == 1
    assert set(uris(tmp_path, "**")) == {str(tmp_path / n) for n in (
        "", "a", "a/deep", "a/one", "a/two", "b", "b/deep", "b/one", "b/two"
    )}  # fmt: skip
    monkeypatch.setattr("adapters.base.MAX_ENTRIES", 5)
    with pytest.raises(AdapterError, match=r"'\*\*/no': looked at 5 files and folders and saw no"):
        uris(tmp_path, "**/no")
