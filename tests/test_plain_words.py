"""Names and docstrings that a stranger stumbles over: their number may only fall.

Three kinds of places are counted in the code of the product, folder by folder:

    vague       a variable, parameter, function, class or field whose whole name is a participle, a
                pronoun or another word that does not say what it holds: `own`, `found`, `each`
    packed      one assignment of several unrelated values: `width, height = 640, 480`. A swap is
                none, nor is the unpacking of a call, a shape or a pair.
    riddling    a docstring that begins with "What", "Of", "Whether", "That", "Where" or "Which" and
                so has no subject

STUMBLES holds how many there are left. CONTRIBUTING.md says how we name and write.
"""

from __future__ import annotations

import ast
from collections import Counter, defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("adapters", "augment", "recipes", "tools")

# A name that is one of these says nothing about the thing that it holds.
VAGUE_WORDS = (
    "alike another anything apart asked besides drawn each every everything found given "
    "hidden held here it kept known left_out lone made met much nothing one others own "
    "placed read rest seen shown some something spent taken that there these thing things "
    "this those told wanted way ways what whole"
)
VAGUE = frozenset(VAGUE_WORDS.split())
# Words that name a function well: they are verbs, too.
VERBS = frozenset({"read"})
RIDDLING = ("What ", "Of ", "Whether ", "That ", "Where ", "Which ")

# How many places of each kind are left in a folder; a folder that is not here has none.
STUMBLES: dict[str, dict[str, int]] = {
    "adapters/camera_files": {"packed": 1},
    "adapters/drivestudio": {"packed": 1},
    "augment/dataset": {"vague": 2},
    "augment/effects": {"packed": 9},
    "augment/files": {"packed": 2},
    "augment/render": {"packed": 2},
}


class Place(NamedTuple):
    """A place that a reader stumbles over."""

    # Kind of the place, a key of STUMBLES' rows.
    kind: str
    # Line of the file, from 1.
    line: int
    # Text of the place, as it is shown to whoever has to mend it.
    text: str


def places_in(tree: ast.Module) -> Iterator[Place]:
    """Yield every place of a module, in no order."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store) and node.id in VAGUE:
            yield Place("vague", node.lineno, node.id)
        elif isinstance(node, ast.arg) and node.arg in VAGUE:
            yield Place("vague", node.lineno, node.arg)
        elif isinstance(node, ast.Assign) and is_packed(node):
            yield Place("packed", node.lineno, ast.unparse(node))
        elif isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            if node.name in VAGUE - VERBS:
                yield Place("vague", node.lineno, node.name)
            docstring = ast.get_docstring(node) or ""
            if docstring.startswith(RIDDLING):
                yield Place("riddling", node.lineno, docstring.splitlines()[0])


def is_packed(assignment: ast.Assign) -> bool:
    """Return True if an assignment gives several names a value each, and is no swap."""
    target, value = assignment.targets[0], assignment.value
    if not (isinstance(target, ast.Tuple) and isinstance(value, ast.Tuple)):
        return False
    names = {ast.unparse(element) for element in target.elts}
    is_swap = names == {ast.unparse(element) for element in value.elts}
    return len(target.elts) == len(value.elts) and not is_swap


def folder_of(path: Path) -> str:
    """Return the folder that a file is counted in: one level below its package, if it has one."""
    parts = path.relative_to(ROOT).parts
    return "/".join(parts[:2]) if len(parts) > 2 else parts[0]


def test_no_folder_has_more_stumbling_places_than_before():
    texts = defaultdict(list)
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*.py")):
            for place in places_in(ast.parse(path.read_text(encoding="utf-8"))):
                texts[folder_of(path), place.kind].append(
                    f"{path.relative_to(ROOT)}:{place.line}: {place.text}"
                )
    limits = Counter(
        {(folder, kind): n for folder, kinds in STUMBLES.items() for kind, n in kinds.items()}
    )
    problems = []
    for key in sorted({*texts, *limits}):
        folder, kind = key
        count = len(texts[key])
        if count > limits[key]:
            head = f"{folder} has {count} {kind} places, at most {limits[key]} are allowed:"
            problems.append("\n  ".join([head, *sorted(texts[key])]))
        elif count < limits[key]:
            problems.append(f"{folder} has {count} {kind} places: lower its {limits[key]}")
    assert not problems, "\n".join(problems)


@pytest.mark.parametrize(
    ("source", "kinds"),
    [
        ("found = 1", ["vague"]),
        ("def f(own): pass", ["vague"]),
        ("for each in (): pass", ["vague"]),
        ("class A:\n    rest: int = 0", ["vague"]),
        ("found_masks = 1", []),
        ("width, height = 640, 480", ["packed"]),
        ("width, height = size", []),
        ("width, height = height, width", []),
        ("rows, columns = image.shape", []),
        ('def f():\n    """Whether it rains."""', ["riddling"]),
        ('def f():\n    """Return True if it rains."""', []),
    ],
)
def test_places_are_recognised(source, kinds):
    assert [place.kind for place in places_in(ast.parse(source))] == kinds
