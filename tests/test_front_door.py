"""What newcomers read first is true of this tree: paths, names, links, dependencies, CI files."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
TOP_PAGES = ("README.md", "CONTRIBUTING.md", "SECURITY.md")
PAGES = [*(ROOT / name for name in TOP_PAGES), *sorted((ROOT / "docs").rglob("*.md"))]
# A path of this tree in a text: `augment/render/sh.py`, `recipes/presets/`. NAME is a placeholder.
TREE_PATH = re.compile(
    r"`((?:adapters|augment|docs|recipes|tests|tools)/[\w./-]*|\.ci/run|pyproject\.toml)`"
)
LINK = re.compile(r"\]\(([^)\s]+)\)")
REQUIREMENT = re.compile(r"[A-Za-z0-9._-]+")


def tree_paths(text: str) -> list[str]:
    """Paths of this tree that a page names, without those that stand for a new file."""
    return [path for path in TREE_PATH.findall(text) if "NAME" not in path]


@pytest.mark.parametrize("name", ["CONTRIBUTING.md", "SECURITY.md", "docs/dependencies.md"])
def test_paths_that_a_page_names_exist(name):
    paths = tree_paths((ROOT / name).read_text())
    assert len(paths) > 10
    assert [path for path in paths if not (ROOT / path).exists()] == []


def test_names_in_the_map_are_in_the_files_beside_them():
    section = (ROOT / "CONTRIBUTING.md").read_text().split("## Where to find things")[1]
    rows = [line.split("|") for line in section.split("\n## ")[0].splitlines() if "`" in line]
    checked = 0
    for row in rows:
        if len(row) != 5:  # of the table: empty, thing, files, names, empty
            continue
        files = [ROOT / path for path in tree_paths(row[2])]
        for name in re.findall(r"`(\w+)`", row[3]):
            text = "".join(file.read_text() for file in files)
            assert re.search(rf"^(?:(?:def|class) )?{name}\b", text, re.MULTILINE), (name, files)
            checked += 1
    assert checked > 20


def test_names_in_the_steps_are_somewhere_in_the_code():
    text = (ROOT / "CONTRIBUTING.md").read_text()
    steps = text.split("## Add a dataset")[1].split("## Tests")[0]
    names = set(re.findall(r"`(_?[A-Za-z]\w+)(?:\([^`]*\))?`", steps))
    folders = ("adapters", "augment", "recipes", "tests", "tools")
    files = (path for folder in folders for path in (ROOT / folder).rglob("*.py"))
    code = set(re.findall(r"\w+", "".join(file.read_text() for file in files)))
    placeholders = {name for name in names if "NAME" in name or name == "YourEffect"}
    assert len(names) > 30 and names - placeholders - code == set()


def anchors(page: Path) -> set[str]:
    """Anchors of a page's headings, as hosting services and editors make them."""
    headings = re.findall(r"^#+ (.*)$", page.read_text(), re.MULTILINE)
    words = (re.sub(r"[^\w\- ]", "", heading.lower()) for heading in headings)
    return {text.strip().replace(" ", "-") for text in words}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_somewhere(page):
    for target in LINK.findall(re.sub(r"```.*?```", "", page.read_text(), flags=re.DOTALL)):
        if "://" in target:
            continue
        path, _, anchor = target.partition("#")
        file = (page.parent / path).resolve() if path else page
        assert file.exists(), f"{page.name} links to {target}"
        if anchor and file.suffix == ".md":
            assert anchor in anchors(file), f"{page.name} links to {target}"


def test_every_page_is_linked_from_the_readme_or_another_page():
    linked = {
        (page.parent / target.partition("#")[0]).resolve()
        for page in PAGES
        for target in LINK.findall(page.read_text())
    }
    assert [page for page in PAGES if page.name != "README.md" and page not in linked] == []


def test_every_requirement_is_in_the_table_of_dependencies_and_no_other():
    requirements = list(PROJECT["dependencies"])
    for extra in PROJECT["optional-dependencies"].values():
        requirements += extra
    names = {REQUIREMENT.match(text)[0].lower() for text in requirements}
    page = (ROOT / "docs" / "dependencies.md").read_text()
    rows = re.findall(r"^\| `([^`]+)` \|", page, re.MULTILINE)
    assert sorted(rows) == sorted(names)


def test_extras_in_the_table_are_those_of_the_project():
    page = (ROOT / "docs" / "dependencies.md").read_text()
    rows = dict(re.findall(r"^\| `([^`]+)` \| `([^`]+)` \|", page, re.MULTILINE))
    extras = {
        REQUIREMENT.match(text)[0]: extra
        for extra, texts in PROJECT["optional-dependencies"].items()
        if extra != "test"
        for text in texts
    }
    assert rows == extras


def test_the_version_is_the_same_everywhere():
    import augment

    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert citation["cff-version"] == "1.2.0"
    assert citation["version"] == PROJECT["version"] == augment.__version__


def test_pre_commit_runs_what_make_lint_runs():
    makefile = (ROOT / "Makefile").read_text()
    lint = makefile.split("lint: setup-tests\n")[1].split("\n\n")[0]
    lines = (line.split() for line in lint.replace("$(BIN)", ".venv/bin").splitlines())
    commands = {" ".join(word for word in line if word != ".") for line in lines}
    config = yaml.safe_load((ROOT / ".pre-commit-config.yaml").read_text())
    hooks = [hook for repo in config["repos"] for hook in repo["hooks"]]
    assert {hook["entry"] for hook in hooks} == commands
    assert all(hook["language"] == "system" for hook in hooks)


def test_the_workflow_runs_what_every_change_must_pass():
    workflow = yaml.safe_load((ROOT / ".github/workflows/ci.yml").read_text())
    steps = workflow["jobs"]["test"]["steps"]
    assert steps[-1]["run"] == ".ci/run"
    actions = [step["uses"] for step in steps if "uses" in step]
    assert all(re.fullmatch(r"actions/[\w-]+@v\d+\.\d+\.\d+", action) for action in actions)


def test_issue_forms_ask_for_something():
    for path in (ROOT / ".github/ISSUE_TEMPLATE").glob("*_*.yml"):
        form = yaml.safe_load(path.read_text())
        assert form["name"] and form["description"]
        ids = [field["id"] for field in form["body"] if field["type"] != "markdown"]
        assert len(ids) == len(set(ids)) >= 3
