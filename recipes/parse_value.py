"""One field of a file: a literal or a range, checked against the field's limits where it stands.

A range is a mapping: {uniform: [a, b]}, {log_uniform: [a, b]}, {normal: {mean, std, min, max}} or
{choice: [...], weights: [...]}. Both ends, the mean and every option must be allowed values.
"""

from __future__ import annotations

from pathlib import Path

from recipes.errors import Problems, short
from recipes.fields import ANY_NUMBER, FieldSpec, Kind
from recipes.files import file_below
from recipes.hints import hint, show, which_range
from recipes.values import (
    RANGE_KINDS,
    Channels,
    Choice,
    Fixed,
    LogUniform,
    Normal,
    TripleLine,
    Uniform,
    Value,
    as_number,
    as_triple,
)
from recipes.yaml_tree import ListNode, MapNode, Node, ScalarNode

NORMAL_KEYS = ("mean", "std", "min", "max")
MAX_STD_PER_WIDTH = 1000  # a wider normal is uniform for all purposes, and loses digits


class ValueParser:
    """Turns the node of a field into its Value.

    Every method returns None where something is wrong, which it has added to the problems. folder:
    where the files that the recipe names lie; None for a text that comes from no file.
    """

    def __init__(self, problems: Problems, folder: Path | None = None) -> None:
        self._problems, self._folder = problems, folder

    def parse(self, node: Node, spec: FieldSpec, path: str) -> Value | None:
        """The value of a field that may have a range."""
        if isinstance(node, MapNode):
            return self._range(node, spec, path)
        if isinstance(node, ListNode) and spec.channel is not None and len(node.items) == 3:
            return self._triple(node, spec.channel, path)
        return self.literal(node, spec, path)

    def literal(self, node: Node, spec: FieldSpec, path: str) -> Fixed | None:
        """The value of a field that must be written out."""
        if isinstance(node, MapNode) and not spec.rangeable:
            return self._bad(node, path, f"must be {spec.allowed()}; it cannot be a range")
        if not isinstance(node, ScalarNode):
            return self._bad(node, path, f"must be {spec.allowed()}")
        value = node.value
        if spec.kind.is_text and value is not None:
            value = node.text  # a name may look like a number
        if not spec.accepts(value):
            return self._bad(node, path, f"must be {spec.allowed(value)}{hint(node, spec)}")
        if spec.kind is Kind.PATH and value is not None:
            return self._file(node, path)
        if spec.kind is Kind.NUMBER and value is not None:
            return Fixed(float(as_number(value)))
        return Fixed(value)

    def _file(self, node: ScalarNode, path: str) -> Fixed | None:
        """The name of a file as it is written, where that file can be read."""
        if self._folder is None:
            text = "this text is in no file, so there is no folder to look in; save it as one"
            return self._bad(node, path, text)
        try:
            file_below(self._folder, node.text)
        except ValueError as error:
            return self._bad(node, path, str(error))
        return Fixed(node.text)

    def _bad(self, node: Node, path: str, text: str) -> None:
        self._problems.add(node.line, f"{path} = {show(node)}: {text}")

    def _number(self, node: Node, spec: FieldSpec, path: str) -> float | None:
        fixed = self.literal(node, spec.without_null, path)
        return None if fixed is None else as_number(fixed.value)

    def _triple(self, node: ListNode, spec: FieldSpec, path: str) -> Value | None:
        channels = [
            self.parse(item, spec, f"{path}[{index}]") for index, item in enumerate(node.items)
        ]
        red, green, blue = channels
        if red is None or green is None or blue is None:
            return None
        fixed = [channel.value for channel in channels if isinstance(channel, Fixed)]
        return Fixed(as_triple(fixed)) if len(fixed) == 3 else Channels((red, green, blue))

    def _range(self, node: MapNode, spec: FieldSpec, path: str) -> Value | None:
        kinds = [key for key in node.entries if key in RANGE_KINDS]
        if len(kinds) != 1:
            return self._bad(node, path, which_range(node, spec))
        kind = kinds[0]
        allowed = {kind, "weights"} if kind == "choice" else {kind}
        for key in node.entries.keys() - allowed:
            line = node.entries[key][0]
            self._problems.add(line, f"{path}.{short(key)}: no part of a range {kind!r}")
            return None
        body, below = node.entries[kind][1], f"{path}.{kind}"
        if kind == "choice":
            return self._choice(node, spec, path)
        if spec.channel is not None and kind == "uniform":
            return self._line(body, spec, below)
        if spec.kind not in (Kind.NUMBER, Kind.WHOLE):
            possible = "choice" if spec.channel is None else "uniform or choice"
            return self._bad(node, path, f"{kind} is for numbers; a range here is {possible}")
        if kind == "normal":
            return self._normal(body, spec, below)
        return self._interval(body, spec, below, log=kind == "log_uniform")

    def _interval(self, body: Node, spec: FieldSpec, path: str, *, log: bool) -> Value | None:
        if not isinstance(body, ListNode) or len(body.items) != 2:
            return self._bad(body, path, "must be [low, high]")
        low, high = (
            self._number(item, spec, f"{path}[{index}]") for index, item in enumerate(body.items)
        )
        if low is None or high is None:
            return None
        if low > high:
            return self._bad(body, path, "the low end comes first")
        if log and low <= 0:
            return self._bad(body.items[0], f"{path}[0]", "must be > 0: its logarithm is taken")
        whole = spec.kind is Kind.WHOLE
        return LogUniform(low, high, whole) if log else Uniform(low, high, whole)

    def _normal(self, body: Node, spec: FieldSpec, path: str) -> Value | None:
        if not isinstance(body, MapNode) or set(body.entries) != set(NORMAL_KEYS):
            form = ", ".join(f"{key}: ..." for key in NORMAL_KEYS)
            return self._bad(body, path, f"must be {{{form}}}, all four")
        # neither the mean nor the deviation of whole numbers need be whole
        specs = dict(zip(NORMAL_KEYS, (ANY_NUMBER, ANY_NUMBER, spec, spec), strict=True))
        mean, std, low, high = (
            self._number(body.entries[key][1], part, f"{path}.{key}") for key, part in specs.items()
        )
        if mean is None or std is None or low is None or high is None:
            return None
        if not low < high:
            return self._bad(body.entries["max"][1], f"{path}.max", "must be > min")
        if not low <= mean <= high:
            text = f"must be from min to max, {low:g} to {high:g}"
            return self._bad(body.entries["mean"][1], f"{path}.mean", text)
        if not 0 < std <= MAX_STD_PER_WIDTH * (high - low):
            text = f"must be > 0 and <= {MAX_STD_PER_WIDTH} (max - min); wider is uniform"
            return self._bad(body.entries["std"][1], f"{path}.std", text)
        return Normal(mean, std, low, high, spec.kind is Kind.WHOLE)

    def _choice(self, node: MapNode, spec: FieldSpec, path: str) -> Value | None:
        body, below = node.entries["choice"][1], f"{path}.choice"
        if not isinstance(body, ListNode) or not body.items:
            return self._bad(body, below, "must be a list of at least one option")
        count = len(body.items)
        parsed = [self.parse(item, spec, f"{below}[{i}]") for i, item in enumerate(body.items)]
        options = tuple(option for option in parsed if option is not None)
        weights: tuple[float, ...] | None = (1.0,) * count
        if "weights" in node.entries:
            weights = self._weights(node.entries["weights"][1], count, f"{path}.weights")
        if weights is None or len(options) < count:
            return None
        return Choice(options, weights)

    def _weights(self, node: Node, count: int, path: str) -> tuple[float, ...] | None:
        if not isinstance(node, ListNode) or len(node.items) != count:
            return self._bad(node, path, f"must be {count} numbers, one for each option")
        read = [self._number(item, ANY_NUMBER, f"{path}[{i}]") for i, item in enumerate(node.items)]
        weights = tuple(weight for weight in read if weight is not None)
        if len(weights) < count:
            return None
        # bounds keep the sum finite and every share representable
        if not any(weights) or any(w != 0 and not 1e-9 <= w <= 1e9 for w in weights):
            return self._bad(node, path, "each is 0 or from 1e-9 to 1e9, and one is above 0")
        return weights

    def _line(self, body: Node, spec: FieldSpec, path: str) -> Value | None:
        ends = "colours" if spec.kind is Kind.COLOUR else "triples of rates"
        if not isinstance(body, ListNode) or len(body.items) != 2:
            return self._bad(body, path, f"must be [from, to], two {ends}")
        start, end = (
            self.parse(item, spec, f"{path}[{index}]") for index, item in enumerate(body.items)
        )
        if start is None or end is None:
            return None
        if not (isinstance(start, Fixed) and isinstance(end, Fixed)):
            return self._bad(body, path, f"the two {ends} must be written out, without ranges")
        assert isinstance(start.value, tuple) and isinstance(end.value, tuple)
        return TripleLine(start.value, end.value)
