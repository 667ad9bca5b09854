"""YAML text -> tree: what is read as what, what is refused, and that hostile text stays cheap."""

from __future__ import annotations

import math
import time

import pytest

from recipes.errors import Problems, RecipeError
from recipes.yaml_tree import ListNode, MapNode, Node, ScalarNode, plain_value, read_tree


def plain(node: Node) -> object:
    if isinstance(node, ScalarNode):
        return node.value
    if isinstance(node, ListNode):
        return [plain(item) for item in node.items]
    return {key: plain(value) for key, (_, value) in node.entries.items()}


def read(text: str) -> object:
    problems = Problems("f.yaml")
    tree = read_tree(text, problems)
    problems.raise_if_any()
    return plain(tree)


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("1e-3", 0.001),  # YAML 1.1 reads this as text
        ("1E3", 1000.0),
        ("-.5", -0.5),
        ("3.", 3.0),
        ("+7", 7),
        ("010", 10),  # octal in YAML 1.1
        ("0x1F", 31),
        ("0o17", 15),
        ("-inf", "-inf"),
        ("-.inf", -math.inf),
        ("true", True),
        ("False", False),
        ("yes", "yes"),
        ("on", "on"),
        ("12:30", "12:30"),  # base 60 in YAML 1.1
        ("1_000", "1_000"),
        ("2024-01-01", "2024-01-01"),
        ("~", None),
        ("", None),
        ("null", None),
        ("1" * 401, "1" * 401),
    ],
)
def test_plain_scalars_follow_yaml_1_2(text: str, value: object) -> None:
    got = plain_value(text)
    assert got == value and type(got) is type(value)


def test_keys_are_text_whatever_they_look_like() -> None:
    assert read("on: 1\nyes: 2\n5: 3\nnull: 4\n") == {"on": 1, "yes": 2, "5": 3, "null": 4}


def test_lines_count_from_one() -> None:
    tree = read_tree("# comment\na: 1\nb:\n  - x\n  - y\n", Problems("f"))
    assert isinstance(tree, MapNode)
    line, items = tree.entries["b"]
    assert line == 3 and isinstance(items, ListNode)
    assert [item.line for item in items.items] == [4, 5]


def test_aliases_stand_for_their_anchor() -> None:
    assert read("a: &x [1, 2]\nb: *x\n") == {"a": [1, 2], "b": [1, 2]}


def test_a_byte_order_mark_is_ignored() -> None:
    assert read("\ufeffa: 1") == {"a": 1}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "f.yaml:1: the file is empty"),
        ("# only a comment\n", "f.yaml:1: the file is empty"),
        ("a: 1\na: 2\n", "f.yaml:2: a is given twice (first on line 1)"),
        ("w:\n  s: {v: 1, v: 2}\n", "f.yaml:2: w.s.v is given twice (first on line 2)"),
        ("a:\n\tb: 1\n", "f.yaml:2: not valid YAML: while scanning"),
        ("a:\n\tb: 1\n", "the line holds a tab: indent and separate with spaces"),
        ("a: [1\nb: 2", "f.yaml:2: not valid YAML: while parsing a flow sequence"),
        ("a: 'x", "found unexpected end of stream"),
        ("a: 1\n---\nb: 1", "f.yaml:2: one document a file"),
        ("a: !!python/object:os.system x", "f.yaml:1: the tag 'tag:yaml.org,2002:python/"),
        ("a: !!float 3", "tags are not allowed"),
        ("!x {a: 1}", "f.yaml:1: the tag '!x': tags are not allowed"),
        ("a: 1\n<<: {b: 1}", "f.yaml:2: merge keys (<<) are not read"),
        ("? [a]\n: 1", "f.yaml:1: a key must be plain text"),
        ("a: *q", "f.yaml:1: *q refers to no anchor above it"),
        ("a: &q [*q]", "f.yaml:1: *q stands inside its own anchor"),
        ("a: 1\nb: \x01", "f.yaml:2: not valid YAML: it holds the character U+0001"),
        ('a: "\\UFFFFFFFF"', "f.yaml:1: not valid YAML"),  # PyYAML lets chr() raise
        ("%YAML 9.1\n--- a", "incompatible YAML document"),
        ("[" * 40 + "]" * 40, "f.yaml:1: nested more than 32 levels deep"),
        ("a: [" + "1, " * 20_001 + "]", "more than 20000 values"),
    ],
)
def test_what_is_refused(text: str, message: str) -> None:
    with pytest.raises(RecipeError) as caught:
        read(text)
    assert message in str(caught.value)


def test_nested_aliases_cannot_multiply() -> None:
    lines = ["a0: &a0 [x, x, x, x, x, x, x, x, x, x]"]
    for i in range(1, 10):
        lines.append(f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 10)}]")
    with pytest.raises(RecipeError, match="more than 20000 values, aliases expanded"):
        read("\n".join(lines))


def test_aliases_cannot_deepen_the_tree() -> None:
    lines = ["a0: &a0 [x]"] + [f"a{i}: &a{i} [*a{i - 1}]" for i in range(1, 40)]
    with pytest.raises(RecipeError, match="nested more than 32 levels deep"):
        read("\n".join(lines))


@pytest.mark.parametrize(
    "text",
    ["[" * 65_000, "a: " + "x " * 32_000, "? " * 32_000, "{" + "a: b, " * 10_000, "a:" * 32_000],
    ids=["brackets", "words", "keys", "flow", "colons"],
)
def test_hostile_text_is_refused_or_read_quickly(text: str) -> None:
    start = time.perf_counter()
    try:
        read(text)
    except RecipeError as error:
        assert len(str(error)) < 400, "a message stays one readable line"
    assert time.perf_counter() - start < 10  # about 0.3 s on an idle core; a hang would be minutes
